// One call of expectation propagation on a chain; see core/ep.hpp.
#pragma once

#include <cstddef>
#include <cstdint>

#include "wide.hpp"
#include "noise_entry.hpp"

namespace hw {

constexpr int ep_truncation = noise_kinds;  // a row that keeps its residual in [lo, hi]: bounds, half-spaces
constexpr int ep_states = 16;               // most states
constexpr int ep_free = 16;                 // most free parameters
constexpr int ep_abreast = 8;               // most members in one register

// Matrices over time: one, one a row, or an index a row; the same for all members or one stack each.
struct EpStack {
    const double* data;        // (count, ...), or (members, count, ...); null: absent
    const std::int32_t* index; // (T,) or null
    int count;
    std::ptrdiff_t member;     // numbers from a member's stack to the next one's; 0: shared
};

struct EpArgs {
    int T, n, rows, groups, members;
    EpStack A, G, Q;  // (n,n): A and Q multiplied by G = E^-1 already; G null: identity, Q null: 0
    EpStack b;        // (T,n)
    const double *m0, *P0, *half0;  // (n,), (n,n), (n,): x_0 = N(m0, P0) + uniform on +- half0 (0: none)
    const std::int32_t* group_w;    // (n,): half-width of w_i; -1: no uniform part
    // groups that are standard deviations, for what is found by evidence; -1 none; null: none at all
    const std::int32_t* group_Q;    // (n,): of an independent Gaussian part of w_i, beside Q
    const std::int32_t* group_R;    // (rows,): of the Gaussian part, beside R
    // rows of stage t are start[t] .. start[t+1]-1
    const std::int32_t* start;  // (T+2,)
    EpStack h, y;               // (rows,n), (rows,): residual h'x - y
    const std::int8_t* kind;    // (rows,): NoiseKind or ep_truncation
    const std::int32_t* group;  // (rows,): half-width; -1: 0
    const double* R;            // (rows,): variance of the Gaussian part, above 0 for noise_gaussian unless group_R has it
    const double *lo, *hi;      // (rows,): of truncations
    const double* lost;         // (rows,): log density of a lost row, or null
    const double* mix;          // (rows,groups): variance added, in units of s^2, or null
    double wide;                // standard deviation of outliers over s
    const double *s, *eps;      // (members,groups), (members,)
    // sites: taken as they are if `warm`, left as they become
    bool warm;
    double *m, *D;     // (members,T+1,n)
    double *tau, *nu;  // (members,rows)
    int sweeps;        // at most
    double tol;        // on the largest distance of moments, in standard deviations
    double damping;    // of sites that may widen a belief
    // found
    double *x, *P;                 // (members,T+1,n), (members,T+1,n,n)
    double *k3, *k4;               // (members,T+1,n): standardised cumulants of the states; or null
    double *log_z, *slope;         // (members,), (members,groups+1)
    double* more;                  // (members,): what log Z lacks to second order; or null
    double* learned;               // (members,groups): sum of (1 - posterior / prior variance)^2
    double *residual, *worst;      // (members,)
    double* out;                   // (members,rows) probability that a row is an outlier or lost; or null
    std::int32_t* used;            // (members,) sweeps
    double* work;                  // ep_workspace doubles, on a 32-byte boundary
};

// What a solved window hands on; see core/ep_handover.hpp.
struct EpHeld {
    int stages;
    const std::int32_t* start;        // (stages+1,)
    double *m, *D, *tau, *nu;         // (stages,n), (start[stages],): sites of its mode
    double *lanes, *lane_phi;         // (2 sites, columns): m and nu, then D and tau, of each lane; (columns, q) its parameters, or NaN
    double *centre, *H;               // (q,), (q,q): of the nodes that the window after may begin with
    double *edge_x, *edge_P;          // (stages,n), (stages,n,n): x_t given what lies up to t
    double log_mode, log_prior;       // Z times prior, and the prior, at the mode
    double doubt;                     // about the states, were the window after a light one
    int since;                        // windows since the mode was searched for
};
// The window before as the next one finds it, which begins `drop` rows later.
struct EpBefore : EpHeld {
    int drop;                         // lanes are null where there are others
    int common, low, high, there;     // found by `ep_shift`: stages but the first that both hold; rows here, the first of them there
};

// Half-widths and the rate of outliers found by evidence; see core/ep_learn.hpp. `base` has a member for each node, up to a
// multiple of `ep_abreast` (its m, D, tau, nu hold one: the mode's).
struct EpLearnArgs {
    EpArgs base;
    const EpArgs* outside;                   // the chain with its bounds alone, or null
    double condition;                        // power of its evidence that the chain's is divided by
    const bool *free, *squared;              // (groups,): free ones; those of which the square is told: variances
    const double *floor, *cap, *scale;       // (groups,): bounds, and the order of size
    const double* start;                     // (groups,): first guess, and the half-widths that `before` belongs to
    const EpBefore* before;                  // sites to start from; or null
    int again, calm;                         // windows that may go without a search for their mode, one after the other; light ones
    int shaped;                              // first stage whose skewness and kurtosis are asked for
    const double* count;                     // (groups,): rows of each
    bool learn_eps;
    double rate, start_eps;                  // the rate where it is known; logit of the first guess
    double power, reference, warp;           // prior of log s: s^power told^reference; nodes are Gaussian in s^warp
    double beta_a, beta_b;                   // prior of the rate
    const double *pull, *precision, *known_power;  // (groups,), (groups,groups), (groups,): what is known already of s; or null
    int steps, few, many, most;              // Newton steps; sweeps of a step, of the first one, of a node
    // near: in standard deviations, the distance of the mode that does where sites are warm, and that of the nodes' mean from
    // their centre beyond which the window after begins about the mean
    double tol, tol_nodes, close, near, least, narrow;
    int nodes, light, stage;                 // at most so many points; those of a light window, first in z; so many a stage
    double usable;                           // disagreement of moments from which a point counts as not settled
    double enough;                           // doubt about the states, in standard deviations, that ends the stages
    const double* z;                         // (nodes, q): standard normal
    // found
    double *mode, *H, *phi, *log_weight;     // (q,), (q,q), (nodes,q), (nodes,)
    bool* tells;                             // whether there are nodes enough to tell a slope
    double *node_slope, *second;             // (nodes,q): d log Z / d phi at each node; (nodes,) what log Z lacks there
    double *value, *share, *residuals;       // (nodes,): log posterior, weight, disagreement of moments
    double *x, *P, *k3, *k4, *centre, *out;  // (T+1,n), (T+1,n,n), ...: of the mixture; out (rows,) or null
    double *log_evidence, *residual;         // of the data
    std::int32_t* used;                      // nodes
    long* sweeps_used;
    double *mean, *sd, *quantile_lo, *quantile_hi;           // (groups,), only the free ones written: half-widths, variances
    double *found_rate, *effective;                          // rate of outliers; effective number of nodes
    double *told_pull, *told_precision, *told_power;         // (groups,), (groups,groups), (groups,): what the rows tell; or 0
    int columns;                                             // nodes in whole registers
    bool* finite;                                            // whether x and P are
    EpHeld* held;                                            // for the window after; its sites are those of the base
};

}  // namespace hw

HW_WIDE_KERNEL(std::size_t, ep_workspace, const hw::EpArgs& args)
HW_WIDE_KERNEL(int, ep_run, const hw::EpArgs& args)
HW_WIDE_KERNEL(std::size_t, ep_learn_workspace, const hw::EpLearnArgs& args)
HW_WIDE_KERNEL(int, ep_learn, const hw::EpLearnArgs& args)
HW_WIDE_KERNEL(void, ep_taken_part, int p, const bool* free, const double* start, const double* pull, const double* precision, const double* power, double* found_pull, double* found_precision, double* found_power, double* work)
