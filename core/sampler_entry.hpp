// Draws of one Markov chain over a trajectory, half-widths and unknown entries; see core/sampler.hpp.
#pragma once

#include <cstddef>
#include <cstdint>

#include "isa.hpp"

namespace hw {

struct SamplerArgs {
    long N, K, R, p, n, T, band, n_theta;  // unknowns, rows, places of rows, groups, states, steps, band of M'M, entries
    const long *start, *column;            // (K+1,), (nnz,): rows of M; the first T n are the state rows (t, i)
    double* value;                         // (nnz,) changed by unknown entries
    double* b;                             // (K,)
    const long *place;                     // (K,) place of a row among the residuals
    const long *first;                     // (p+1,) first place of each group, multiples of 4; Gaussian rows follow
    const long *state;                     // (T n,) the unknown x[t]_i of each state row
    const double* weight;                  // (R,) precision of Gaussian rows, by place
    const long* count;                     // (p,) rows of each group
    const double *floor, *cap, *tiny;      // (p,) of the half-widths; equal floor and cap: known
    const double *prior_mean, *prior_sd;   // (p,) normal prior of log s; prior_sd 0: s^(power - 1)
    double power;
    const double *lo, *hi;                 // (N,) boxes
    const long *column_start, *column_at, *column_place;  // (N+1,), (nnz,): entries of each column of M: in `value`, row's place
    const double *x0, *s0;                 // (N,), (p,) start, inside boxes and caps
    const long *theta_start, *theta_row, *theta_at;      // (n_theta+1,), rows and places in `value` (-1: constant)
    const double *theta_slope, *theta_lo, *theta_hi;
    double* theta;                         // (n_theta,)
    long scatter, warm, draws, thin;       // moves that scatter the start, draws thrown away, draws kept, sweeps a draw
    long whitened, scale_every;            // whitened moves every fourth sweep; sweeps from one scale move to the next
    std::uint64_t seed;
    double *out_x, *out_s, *out_theta;     // (draws, N), (draws, p), (draws, n_theta)
    double* work;                          // 3 R + 3 N + 2 p + n + N (band + 1) + 40 doubles, aligned to 32 bytes
};

}  // namespace hw

// 1: the warm-up found no trajectory within the caps
HW_KERNEL(int, sampler_run, const hw::SamplerArgs& args)
