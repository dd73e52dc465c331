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

// Windows of one record, one after the other: states a..b of the record, both sides of every entry of state k.
struct HullSweep {
    HullWindow whole;          // rows of the whole record; lo, hi unused
    double *lo, *hi;           // (T+1,n) boxes, narrowed in place
    int tasks;
    const int *a, *b, *k;      // (tasks) a <= k <= b
    double *out_lo, *out_hi;   // (tasks,n) box of k as its task left it
    double loose, least;       // a bound may be above the solver's objective by loose widths and least sizes
};

}  // namespace hw

// proposes multipliers; nothing it returns is trusted
HW_KERNEL(std::size_t, hull_solve_bytes, int K, int n, int m)
HW_KERNEL(int, hull_solve, const HullRows& rows, const HullSettings& set, int costs, const double* c, const int* k, double* y,
          double* value, double* gap, void* workspace)
HW_KERNEL(std::size_t, hull_bytes, int K, int n, int m)
// 0, or 1 + t (n+m) + i where row i of time t+1 leaves no box: the window is empty, proved
HW_KERNEL(std::ptrdiff_t, hull_run, HullTask& task, const HullSettings& set, void* workspace)
// Runs the tasks from `from` on until one is not clean: a window that is empty, unbounded or loose is left untouched.
// Returns how many tasks are done.
HW_KERNEL(std::size_t, hull_sweep_bytes, int longest, int n, int m)
HW_KERNEL(int, hull_sweep, HullSweep& sweep, int from, const HullSettings& set, int longest, void* workspace)
