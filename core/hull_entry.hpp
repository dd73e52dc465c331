// Bound functionals of the states in a window: contract its boxes, propose multipliers, evaluate the guaranteed bound.
#pragma once

#include "hull_types.hpp"
#include "isa.hpp"

namespace hw {

struct HullTask {
    HullWindow win;
    double *lo, *hi;      // (K+1,n) boxes, contracted in place; win.lo, win.hi are these
    int sweeps;           // of the contraction
    int costs;
    const double* c;      // (costs,n) functionals
    const int* k;         // (costs) the state of each, 0..K
    bool given;           // y is given: no solver runs
    double* y;            // (costs, K, n+m) multipliers, dynamics first
    double* bound;        // (costs) c'x_k is at most this, proved
    double *value, *gap;  // (costs) what the solver found, not proved
    int iterations;
};

}  // namespace hw

// proposes multipliers; nothing it returns is trusted
HW_KERNEL(std::size_t, hull_solve_bytes, int K, int n, int m)
HW_KERNEL(int, hull_solve, const HullRows& rows, const HullSettings& set, int costs, const double* c, const int* k, double* y,
          double* value, double* gap, void* workspace)
HW_KERNEL(std::size_t, hull_bytes, int K, int n, int m)
// 0, or 1 + t (n+m) + i where row i of time t+1 leaves no box: the window is empty, proved
HW_KERNEL(std::ptrdiff_t, hull_run, HullTask& task, const HullSettings& set, void* workspace)
