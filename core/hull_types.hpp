// What goes into the hull of a window: raw arrays and their shapes; see core/hull.hpp.
#pragma once

#include <cstddef>

namespace hw {

// Rows E x_t - A x_{t-1} in [bx], C x_t in [by], t = 1..K, and boxes of x_0..x_K.
struct HullWindow {
    int K, n, m;
    // matrices as intervals, (rows,n) or, if X_t, stacked over time; X_hi null: exact
    const double *E_lo, *E_hi;  // (n,n) unit upper triangular; null: identity
    const double *A_lo, *A_hi;  // (n,n)
    const double *C_lo, *C_hi;  // (m,n)
    bool E_t, A_t, C_t;
    const double *bx_lo, *bx_hi;  // (K,n)
    const double *by_lo, *by_hi;  // (K,m) infinite where unseen
    const double *lo, *hi;        // (K+1,n)
};

// The same window about the middle of its boxes, v_t = x_t - mid_t: coefficients are numbers, rows are intervals.
struct HullRows {
    int K, n, m;
    const double *E, *A, *C;  // E null: identity
    bool E_t, A_t, C_t;
    double* mid;         // (K+1,n)
    double *v_lo, *v_hi;  // (K+1,n)
    double *r_lo, *r_hi;  // (K, n+m) dynamics first; infinite where unseen
    double *Em, *Am, *Cm;  // (K,n,n), (K,n,n), (K,m,n) middles of interval matrices
};

struct HullSettings {
    int max_iter = 60;
    double tol = 1e-10;  // gap, in units of the box's half-width along the cost
};

}  // namespace hw
