// What a run over beliefs held inside constraints is given and gives back: raw arrays, shapes beside them.
#pragma once
#include "isa.hpp"

namespace hw {

enum { constrain_by_ep = 0, constrain_by_truncation = 1, constrain_by_projection = 2, constrain_by_nearest = 3 };

struct ConstrainArgs {
    long T;                     // beliefs
    int n, m;                   // states, rows of D
    int by;                     // one of the above
    const double *D, *lo, *hi;  // (m,n), (m,): lo <= D x <= hi, infinite where there is no side, equal where equality
    double *x, *P;              // (T,n), (T,n,n): beliefs, in place
    double* distance;           // (T,) standard deviations from x to the farthest constraint that it breaks
    int *code, *row;            // (T,): see constrain_row in constrain.hpp; row of D, or -1
};

}  // namespace hw

// Number of doubles and ints of workspace that `constrain_run` needs.
HW_KERNEL(long, constrain_workspace, int n, int m, long* ints)
HW_KERNEL(void, constrain_run, const hw::ConstrainArgs& a, double* work, int* iwork)
