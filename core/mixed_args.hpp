// What one run of the filter for bounded plus Gaussian noise is given and gives back: raw arrays, shapes beside them.
#pragma once
#include <cstdint>

#include "kalman.hpp"

namespace hw {

// How the bounded part of the state's error is carried.
enum MixedForm { mixed_ellipsoid = 0, mixed_zonotope = 1, mixed_combined = 2 };
// What the scalar a is chosen by: kappa^2 tr(W P) + tr(W X), or the weighted sum of sqrt(X_ii) + kappa sqrt(P_ii).
enum MixedCriterion { mixed_trace = 0, mixed_width = 1 };

struct MixedArgs {
    long T;         // rows of the record
    int n, ny, ng;  // states, outputs of a row, bounded noises of the state
    // x[t] = A x[t-1] + b[t] + w + G d, w ~ N(0, Q), |d_j| <= 1;  y_i = C_i x + v_i + e_i, v_i ~ N(0, r_i), |e_i| <= half_i,
    // everything independent of everything else.
    Stack A, Q, G;     // (n, n), (n, n), (n, ng)
    const double* b;   // (T, n) or null
    Stack C, r, half;  // (ny, n), (ny,), (ny,)
    const double* y;   // (T, ny)
    const uint8_t* seen;                // (T, ny)
    const double *m0, *P0, *X0, *Z0;    // (n,), (n, n), (n, n), (count0, n): one step before row 0
    int count0;                         // generators in Z0
    int form, criterion, set_gain, truncate, shrink;
    int capacity;   // generators that are kept after each row, at least n
    double kappa;   // standard deviations that count as much as a half-width
    double a;       // the scalar of every correction, or NaN: chosen
    double output;  // weight of the output's own direction beside the states'
    // Answers. m (T, n), P (T, n, n), X (T, n, n), width (T, n): half-widths of the set; Z (capacity + ng + ny, n) with
    // `count` generators after the last row; a_used (T, ny): the scalar of each correction, NaN where there was none.
    double *m, *P, *X, *width, *Z, *a_used;
    int count;
    // Rows whose output lies outside of what the belief holds possible, and whether the numbers left floating point.
    long contradicted, first_contradicted, broken;
};

}  // namespace hw

// Number of doubles of workspace that `mixed_run` needs.
HW_KERNEL(long, mixed_workspace, const hw::MixedArgs& a)
HW_KERNEL(void, mixed_run, hw::MixedArgs& a, double* work)
