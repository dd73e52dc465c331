// Contract boxes x_0..x_T by the rows E x_t - A x_{t-1} in [bx], C x_t in [by]; see core/box.hpp.
#pragma once

#include <cstddef>

#include "isa.hpp"

namespace hw {

struct BoxChain {
    int T, n, m;
    // matrices as intervals, (rows,n) or, if X_t, stacked over time; X_hi null: exact
    const double *E_lo, *E_hi;  // (n,n) unit upper triangular; null: identity
    const double *A_lo, *A_hi;  // (n,n)
    const double *C_lo, *C_hi;  // (m,n)
    bool E_t, A_t, C_t;
    const double *bx_lo, *bx_hi;  // (T,n)
    const double *by_lo, *by_hi;  // (T,m) infinite where unseen
    double *lo, *hi;              // (T+1,n) boxes of x_0..x_T, contracted in place
    int sweeps;                   // most sweeps forwards and backwards; 0: forwards alone, each box from the past
    double* work;                 // box_workspace doubles
};

}  // namespace hw

HW_KERNEL(std::size_t, box_workspace, int n)
// 0, or 1 + t (n+m) + i where row i of time t+1 (dynamics first) leaves no box
HW_KERNEL(std::ptrdiff_t, box_chain, const BoxChain& chain)
