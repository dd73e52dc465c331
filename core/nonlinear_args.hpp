// What one run of a nonlinear filter is given and gives back: raw arrays, shapes beside them.
#pragma once
#include <cstdint>

#include "kalman.hpp"
#include "tape_code.hpp"

namespace hw {

struct NonlinearArgs {
    long T;      // rows of the record
    int nx, ny;  // sizes
    Tape g, h;   // x[t] = g(x[t-1], gu[t]) + w[t], y[t] = h(x[t], hu[t]) + e[t]; inputs of a tape: x, then its row
    const double *gu, *hu;      // (T, g.n_in - nx), (T, h.n_in - nx)
    Stack Q, R;                 // (nx, nx) and (ny, ny)
    const double *x0, *P0;      // (nx,), (nx, nx): one step before row 0
    const double* y;            // (T, ny)
    const uint8_t* seen;        // (T, ny)
    const uint8_t *wrap_x, *wrap_y;  // (nx,), (ny,): 1 where the entry is an angle
    // Unscented: distance of the sigma points in standard deviations, weight of the centre in covariances, weight of each
    // of the others (in means the centre has what is left to 1). spread = 0: linearise (extended Kalman filter).
    double spread, centre, weight;
    int iterations;             // of one correction by linearisation: 1 is the extended Kalman filter
    const double* about;        // (T + 1, nx) trajectory to linearise about, or null: about the estimate itself
    int smooth;
    // Answers. x, P: (T, nx), (T, nx, nx), filtered, or smoothed if `smooth`; x0s, P0s: the smoothed state x0.
    double *x, *P, *x0s, *P0s;
    double *loglik, *nis;       // (T,) each: log-likelihood and v' S^-1 v of the entries seen in the row
    double *xp, *G, *M;         // (T, nx), (T, nx, nx) twice: workspace of the smoother, null otherwise
    // Rows where g was not finite (the state was held), where h was not (the output was left out), where a covariance had
    // to be kept positive by leaving out a negative weight, and where an output without variance contradicts its certain
    // prediction.
    struct Count {
        long rows = 0, first = -1;
        void add(long t) {
            if (rows++ == 0) first = t;
        }
    } bad_g, bad_h, repaired, contradicted;
};

}  // namespace hw

// Number of doubles of workspace that `nonlinear_run` needs.
HW_KERNEL(long, nonlinear_workspace, const hw::NonlinearArgs& a)
HW_KERNEL(void, nonlinear_run, hw::NonlinearArgs& a, double* work)
