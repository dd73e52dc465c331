// Recursions of sets that must contain the state; see core/sets.hpp.
#pragma once

#include "box_entry.hpp"

namespace hw {

enum class SetKind { interval = 0, zonotope = 1, constrained = 2, ellipsoid = 3 };

// What a recursion carries from row to row, beside the newest box: all in one array of set_state doubles.
struct SetSizes {
    SetKind kind;
    int n, m;         // states, outputs
    int generators;   // most generators between rows, n at least
    int constraints;  // most constraints between rows
    int rounds;       // of the search for their multipliers
};

struct SetRun {
    BoxChain box;   // rows of the chain; lo[0], hi[0] the newest box; the boxes of every row come out; `sweeps` unused
    SetSizes size;
    double* state;  // (set_state,) carried over
    double* x;      // (T+1,n) point: middle of the box, or the motion of the last one where the box has no ends; x[0] given
    double* work;   // (set_workspace,)
};

}  // namespace hw

HW_KERNEL(std::size_t, set_state, const hw::SetSizes& size)
HW_KERNEL(std::size_t, set_workspace, const hw::SetSizes& size)
// 0, or 1 + t (n+m) + i of the first row that contradicts the rows before it. From there on nothing is known but what later rows say.
HW_KERNEL(std::ptrdiff_t, set_run, const hw::SetRun& run)
