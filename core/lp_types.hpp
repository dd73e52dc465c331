// What goes into and comes out of the linear program of core/banded_ipm.hpp: raw arrays and their shapes.
#pragma once

#include <cstddef>

namespace hw {

struct LpProblem {
    int T, n, m;  // rows of the record, states, outputs; states are x_0..x_T, row t links x_t (before) and x_{t+1}
    int p0, ns;   // unknown parameters theta, half-widths s
    // Matrices, row-major. X_t says whether X is stacked over time (T, ...) or constant.
    const double* E;  // (n,n) unit upper triangular; null: identity
    const double* A;  // (n,n)
    const double* C;  // (m,n)
    const double* G;  // (T, n+m, p0) columns of theta, state rows first; null if p0 == 0
    bool E_t, A_t, C_t;
    const double* bx;  // (T,n)   B u [+ what a linearisation adds]
    const double* by;  // (T,m)   F y; unseen entries may hold anything
    const bool* seen;  // (T,m)
    const double *lo, *hi;  // (T+1,n) or, if not box_t, (n): bounds of the states; null: none
    bool box_t;
    const double *x0_lo, *x0_hi;        // (n) bounds of x_0 alone, instead of lo, hi there; null: none
    const double *theta_lo, *theta_hi;  // (p0)
    const int* group;                   // (n+m) which half-width bounds rows of this kind
    const double* h;                    // (n+m) |rho| <= h s
    const double *c, *floor, *cap;      // (ns) cost, floor and cap of each half-width
    const double* slack;                // (n+m) cost of a row's own slack; null: no slacks
};

enum LpPoint { lp_optimal = 0, lp_central = 1, lp_least_squares = 2 };
enum LpStatus { lp_ok = 0, lp_reduced = 1, lp_infeasible = 2, lp_stalled = 3 };

struct LpSettings {
    int point = lp_central;
    double tol = 1e-9;       // relative gap asked of the optimal point
    double central_gap = 0.3;  // relative gap at which the central point stops
    int max_iter = 100;
    bool warm = false;       // LpOut::warm is in use
};

// A well-centred iterate of one problem, for the next to start from, in the caller's units. It is of T rows (0: there is
// none yet), of which the next problem no longer has the first `drop`. Arrays hold as many rows as either problem.
struct LpWarm {
    int T, drop;
    double *x, *theta, *s;  // (T+1, n), (p0), (ns)
    double* lam;            // (T, n+m, 2) multipliers of the rows
    double* box;            // (T+1, n, 2) of the states' upper and lower bounds
    double* ends;           // (p0+ns, 2) of the lower and upper bounds of theta and s
};

struct LpInfo {
    double objective, gap, dual_residual, primal_residual, violation, scale;
    int iterations, status;
};

struct LpOut {
    double* x;      // (T+1, n)
    double* theta;  // (p0)
    double* s;      // (ns)
    double* lam;    // (T, n+m, 2) multipliers of s - rho >= 0 and s + rho >= 0, or null
    double* slack;  // (T, n+m) or null
    LpWarm* warm;   // in: where to start, out: where the next may; or null
    LpInfo info;
};

// A window sliding over one record: at row t the problem of rows start[t]..t is solved.
struct LpWindows {
    LpProblem whole;     // of the whole record; x0_lo, x0_hi bound the state before its first row
    const int* start;    // (T) first row of each window
    const int* last;     // (T+1) the interval of state k is that of its estimates by the windows that end at k-1..last[k]
    const double* early;  // (early_rows, ns) costs of the first windows
    int early_rows;
    int memory;          // by how many windows more a finished interval is widened: n / (n - 2)
    double carry;        // kappa with which a finished interval bounds the state a window starts from; 0: not
    double* filtered;    // (T, n)  newest state of each window
    double* smoothed;    // (T+1, n)  last estimate of each state
    double* s;           // (T, ns)
    double *low, *high;  // (T+1, n)  least and largest estimate of each state by those windows
    int* status;         // (T)
    int* iterations;     // (T)
    double* seconds;     // (T) CPU time
    double* scratch;     // (longest window + 1) n + 2 n
    LpWarm* warm;        // of the longest window, if the settings ask for it
};

}  // namespace hw
