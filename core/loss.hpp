// The switching-measurement linear Gaussian model: filters and smoothers for outputs that may not be what they claim.
//
//     x_t = A x_{t-1} + b + w,  w ~ N(0, Q)                     one motion for all modes
//     y_t = d_s + C_s x_t + v,  v ~ N(0, R_s)                   s_t in 0 .. M-1, nobody tells which
//     P(s_t = j | s_{t-1} = i) = Pi(i, j)                       equal rows: independent
//
// Given the modes' history everything is Gaussian, so the belief is a mixture of Kalman filters (Rao-Blackwellised
// components). Each row splits every component into one child per mode, weighs the children in the log domain, and
// brings their number down again by one of six rules:
//
//     decide     keep the likeliest child: a hard decision                          BKF-I, Zhang & You 2016, (5), (6)
//     average    merge children that agree on the last `depth` modes, by moments    generalised pseudo-Bayes; depth 0 = BKF-II
//     sample     draw one child per component; resample when the weights degenerate Rao-Blackwellised particle filter
//     resample   unbiased optimal resampling of all children                        Fearnhead & Clifford 2003
//     merge      join the closest pairs                                             Runnalls 2007
//     beam       keep the likeliest histories                                       decide = beam of width 1
//
// Components lie four to a block (lane.hpp). An output row is whitened once per mode, with R_s = L L', and folded in
// entry by entry in Joseph form, so no matrix is inverted and correlated output noise costs nothing extra.
#pragma once

#include <cstdint>

#include "isa.hpp"

namespace hw {

enum LossRule { loss_decide = 0, loss_average, loss_sample, loss_resample, loss_merge, loss_beam };
enum LossLearn { learn_nothing = 0, learn_bernoulli, learn_markov };

// What a filter is made of: sizes, settings, and the places of its arrays inside two buffers (loss_place).
struct LossState {
    int n = 0, m = 0, M = 0;   // states, outputs, modes
    int G = 1;                 // sensors lost separately; mode s has bit g set when sensor g was received
    int K = 1;                 // components at most
    int rule = 0, depth = 0, spread = 1, learn = 0;
    double threshold = 0.5;    // resample when the effective number falls below this part of K
    std::uint64_t rng = 0;
    int live = 1;              // components in use, the first of K
    int started = 0;           // rows seen so far, counted to 1
    int fresh = 1;             // whitened rows are out of date
    double *x, *P;             // components (blocks, n, 4), (blocks, n, n, 4)
    double *x2, *P2;           // the same, where a rule builds the next ones
    double *logw;              // (blocks, 4)
    double *cx, *cP;           // children (M, blocks, n, 4), (M, blocks, n, n, 4)
    double *a, *w;             // their log weights and weights (M, blocks, 4)
    double *lw;                // (blocks, 4) log weight of a component, its children together
    double *count, *count2;    // (K, G, 2, 2) transitions seen by a component, pseudo-counts included
    double *mix;               // (M) probability of the last mode, where components do not remember it (depth 0)
    double *rows, *L, *li;     // whitened output rows (M, m, n), factors (M, m, m), reciprocal diagonals (M, m)
    double *z, *konst;         // whitened outputs (M, m), constants of the log density (M)
    double *logPi, *logpi0;    // (M, M), (M)
    double *work;              // scratch
    int *mode, *mode2;         // (K) last mode of each component
    int *used;                 // (M) whitened rows of a mode
    int *moves;                // (M, m) whether such a row touches the state
    int *still;                // (M) whether none does: the child is the component itself
    int *order;                // (M K) scratch
    int *seen;                 // (m) entries seen when the rows were whitened
};

// One row of the record. Arrays as in the equations above; C, d, R hold the modes one after another.
struct LossRow {
    const double *A, *b, *Q;   // (n,n), (n) or null, (n,n); A null: no time update
    const double *C, *d, *R;   // (M,m,n), (M,m) or null, (M,m,m)
    const double* y;           // (m)
    const bool* seen;          // (m)
    const double* logPi;       // (M,M) logarithms
};

// What a row says. Null pointers are not filled.
struct LossOut {
    double *x, *P;             // (n), (n,n) of the mixture
    double* modes;             // (M) probabilities
    double* law;               // (G,2) P(received | lost), P(received | received), where learned
    double loglik;             // log p(y_t | before)
};

// The children of past rows, kept for the smoother: (slots, C), (slots, C, n), (slots, C, n, n).
struct LossPast {
    double *a, *x, *P;
    int cells, slots;
};

// A whole record. Strides are 0 for a constant array, else the size of one row's part.
struct LossArgs {
    int T;
    const double *A, *b, *Q, *C, *d, *R, *y, *Pi;
    long sA, sb, sQ, sC, sd, sR, sPi;
    const bool* seen;
    int prior_predicted;       // N(x0, P0) is the prediction of row 0
    int smooth;                // 0 filter, 1 full smoothing, 2 fixed lag
    int lag;
    LossPast past;
    double *sw, *sx, *sP;      // smoother cells (cells), (cells, n), (cells, n, n)
    double *pw, *px, *pP;      // smoother parents (K), (K, n), (K, n, n)
    double *x, *P, *modes, *loglik, *law;  // out: (T,n), (T,n,n), (T,M), (T), (T,G,2)
    double* pairs;             // out: (M,M) expected transitions, full smoothing only
    int* bad_row;              // out: first row without a finite answer, or -1
    int* void_rows;            // out: rows that no mode could explain; they were left unused
};

enum LossCode { loss_ok = 0, loss_void = 1, loss_bad_noise = 2, loss_not_finite = 3 };

}  // namespace hw

HW_KERNEL(long, loss_place, LossState& s, double* d, int* i, long* n_int)
HW_KERNEL(void, loss_start, LossState& s, const double* x0, const double* P0, const double* pi0, const double* count)
HW_KERNEL(int, loss_step, LossState& s, const LossRow& r, LossOut& o, LossPast* past, int slot)
HW_KERNEL(int, loss_filter, LossState& s, LossArgs& k)

#ifdef HW_LOSS_KERNEL  // the algorithm itself, compiled by loss.cpp once per instruction set
#include "lane.hpp"

namespace hw {
namespace HW_ISA {

inline V4* v4(double* p) { return reinterpret_cast<V4*>(p); }
inline const V4* v4(const double* p) { return reinterpret_cast<const V4*>(p); }

inline double uniform(std::uint64_t& state) {  // splitmix64, in [0, 1)
    state += 0x9e3779b97f4a7c15ULL;
    std::uint64_t z = state;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
    return static_cast<double>((z ^ (z >> 31)) >> 11) * 0x1.0p-53;
}

inline double log_or_minus_inf(double p) { return p > 0.0 ? std::log(p) : minus_inf; }

// ---- one component of a bank, out of and into its lane -------------------------------------------------------------

template <class N>
inline void take(N n, const double* x, const double* P, int i, double* xi, double* Pi) {
    const double* a = x + static_cast<long>(i / lanes) * n * lanes + i % lanes;
    const double* B = P + static_cast<long>(i / lanes) * n * n * lanes + i % lanes;
    for (int j = 0; j < n; j++) xi[j] = a[j * lanes];
    for (int j = 0; j < n * n; j++) Pi[j] = B[j * lanes];
}

template <class N>
inline void put(N n, const double* xi, const double* Pi, int i, double* x, double* P) {
    double* a = x + static_cast<long>(i / lanes) * n * lanes + i % lanes;
    double* B = P + static_cast<long>(i / lanes) * n * n * lanes + i % lanes;
    for (int j = 0; j < n; j++) a[j * lanes] = xi[j];
    for (int j = 0; j < n * n; j++) B[j * lanes] = Pi[j];
}

template <class N>
inline void move(N n, const double* x, const double* P, int i, double* xo, double* Po, int o) {
    const double* a = x + static_cast<long>(i / lanes) * n * lanes + i % lanes;
    const double* B = P + static_cast<long>(i / lanes) * n * n * lanes + i % lanes;
    double* c = xo + static_cast<long>(o / lanes) * n * lanes + o % lanes;
    double* D = Po + static_cast<long>(o / lanes) * n * n * lanes + o % lanes;
    for (int j = 0; j < n; j++) c[j * lanes] = a[j * lanes];
    for (int j = 0; j < n * n; j++) D[j * lanes] = B[j * lanes];
}

// Where the children of mode s lie: a mode that says nothing of the state leaves the component as it is.
template <class N>
inline const double* child_x(N n, const LossState& s, int mode) {
    return s.still[mode] ? s.x : s.cx + static_cast<long>(mode) * blocks(s.K) * n * lanes;
}
template <class N>
inline const double* child_P(N n, const LossState& s, int mode) {
    return s.still[mode] ? s.P : s.cP + static_cast<long>(mode) * blocks(s.K) * n * n * lanes;
}
inline double child_a(const LossState& s, int c) {  // child c = mode * live + component
    return s.a[static_cast<long>(c / s.live) * blocks(s.K) * lanes + c % s.live];
}
inline double child_w(const LossState& s, int c) {
    return s.w[static_cast<long>(c / s.live) * blocks(s.K) * lanes + c % s.live];
}

// ---- four components at once --------------------------------------------------------------------------------------

// x, P <- A x + b, A P A' + Q, in place; t is scratch (n n)
template <class N>
inline void predict4(N n, const double* A, const double* b, const double* Q, V4* x, V4* P, V4* t) {
    for (int i = 0; i < n; i++) {
        V4 v = all4(b ? b[i] : 0.0);
        for (int k = 0; k < n; k++) v += A[i * n + k] * x[k];
        t[i] = v;
    }
    for (int i = 0; i < n; i++) x[i] = t[i];
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) t[i * n + j] = V4{};
        for (int k = 0; k < n; k++) {
            const double aik = A[i * n + k];
            if (aik == 0.0) continue;
            for (int j = 0; j < n; j++) t[i * n + j] += aik * P[k * n + j];
        }
    }
    for (int j = 0; j < n; j++) {
        for (int i = j; i < n; i++) P[i * n + j] = all4(0.5 * (Q[i * n + j] + Q[j * n + i]));
        for (int k = 0; k < n; k++) {
            const double ajk = A[j * n + k];
            if (ajk == 0.0) continue;
            for (int i = j; i < n; i++) P[i * n + j] += ajk * t[i * n + k];
        }
        for (int i = j + 1; i < n; i++) P[j * n + i] = P[i * n + j];
    }
}

// Fold the whitened rows of one mode into four components, entry by entry, Joseph form; returns log densities.
// rows (u,n), z (u), moves (u); t is scratch (2n)
template <class N>
inline V4 correct4(N n, int u, const double* rows, const double* z, const int* moves, double konst, V4* x, V4* P,
                   V4* t) {
    V4 quad{}, prod = all4(1.0), logdet{};
    V4 *b = t, *k = t + n;
    int since = 0;
    for (int r = 0; r < u; r++) {
        if (!moves[r]) {
            quad += all4(z[r] * z[r]);
            continue;
        }
        const double* c = rows + static_cast<long>(r) * n;
        for (int i = 0; i < n; i++) b[i] = V4{};
        for (int j = 0; j < n; j++) {
            if (c[j] == 0.0) continue;
            for (int i = 0; i < n; i++) b[i] += c[j] * P[j * n + i];
        }
        V4 S = all4(1.0), e = all4(z[r]);
        for (int i = 0; i < n; i++) {
            S += c[i] * b[i];
            e -= c[i] * x[i];
        }
        const V4 inv = 1.0 / S;
        quad += e * e * inv;
        prod *= S;
        if (++since == 4) {
            logdet += log4(prod);
            prod = all4(1.0);
            since = 0;
        }
        for (int i = 0; i < n; i++) {
            k[i] = b[i] * inv;
            x[i] += k[i] * e;
        }
        // P <- D (I - c k') + k k' with D = (I - k c) P, so P + (k - D c) k' on top of D
        for (int i = 0; i < n; i++) {
            V4 v = k[i];
            for (int j = 0; j < n; j++) {
                if (c[j] == 0.0) continue;
                v -= c[j] * (P[i * n + j] - k[i] * b[j]);
            }
            for (int j = 0; j <= i; j++) P[i * n + j] += v * k[j] - k[i] * b[j];
        }
        for (int i = 0; i < n; i++)
            for (int j = 0; j < i; j++) P[j * n + i] = P[i * n + j];
    }
    if (since) logdet += log4(prod);
    return all4(konst) - 0.5 * (quad + logdet);
}

// ---- the modes of a row --------------------------------------------------------------------------------------------

// Whiten the seen rows of every mode: R_s = L L', rows = L^-1 C_s. Done again only when C, R or `seen` changed.
template <class N>
inline int whiten(N n, LossState& s, const LossRow& r) {
    const int m = s.m;
    int code = loss_ok;
    for (int j = 0; j < m; j++) s.seen[j] = r.seen[j];
    for (int q = 0; q < s.M; q++) {
        double* L = s.L + static_cast<long>(q) * m * m;
        double* li = s.li + q * m;
        double* rows = s.rows + static_cast<long>(q) * m * n;
        double* S = s.work;
        int u = 0;
        for (int i = 0; i < m; i++) {
            if (!s.seen[i]) continue;
            int v = 0;
            for (int j = 0; j < m; j++)
                if (s.seen[j]) S[u * m + v++] = r.R[(static_cast<long>(q) * m + i) * m + j];
            copy(Dim<0>(n), r.C + (static_cast<long>(q) * m + i) * n, rows + static_cast<long>(u) * n);
            u++;
        }
        for (int i = 1; i < u; i++)  // from stride m to stride u
            for (int j = 0; j < u; j++) S[i * u + j] = S[i * m + j];
        if (u && cholesky(Dim<0>(u), S, L, li) != 0) code = loss_bad_noise;
        solve_lower(Dim<0>(u), n, L, li, rows);
        double logdet = 0.0;
        s.used[q] = u;
        s.still[q] = 1;
        for (int i = 0; i < u; i++) {
            logdet += log_or_minus_inf(L[i * u + i]);
            int moves = 0;
            for (int j = 0; j < n; j++) moves |= rows[static_cast<long>(i) * n + j] != 0.0;
            s.moves[q * m + i] = moves;
            if (moves) s.still[q] = 0;
        }
        s.konst[q] = -logdet - 0.5 * u * log_2pi;
    }
    return code;
}

// z = L^-1 (y - d_s) for every mode
inline void whiten_output(LossState& s, const LossRow& r) {
    for (int q = 0; q < s.M; q++) {
        double* z = s.z + q * s.m;
        const double* d = r.d ? r.d + q * s.m : nullptr;
        int u = 0;
        for (int i = 0; i < s.m; i++)
            if (s.seen[i]) z[u++] = r.y[i] - (d ? d[i] : 0.0);
        const double* L = s.L + static_cast<long>(q) * s.m * s.m;
        for (int i = 0; i < u; i++) {
            for (int j = 0; j < i; j++) z[i] -= L[i * u + j] * z[j];
            z[i] *= s.li[q * s.m + i];
        }
    }
}

// Log probability of each mode before the row is seen, into a (M, blocks, 4).
inline void mode_priors(LossState& s, const double* logPi) {
    const long bank = static_cast<long>(blocks(s.K)) * lanes;
    double* lp = s.work;  // (M)
    if (!s.started || (s.rule == loss_average && s.depth == 0 && !s.learn)) {
        for (int q = 0; q < s.M; q++) {
            if (!s.started) {
                lp[q] = s.logpi0[q];
                continue;
            }
            double sum = 0.0;
            for (int j = 0; j < s.M; j++) sum += s.mix[j] * std::exp(logPi[j * s.M + q]);
            lp[q] = log_or_minus_inf(sum);
        }
        for (int q = 0; q < s.M; q++)
            for (int i = 0; i < s.live; i++) s.a[q * bank + i] = lp[q];
    } else if (!s.learn) {
        for (int q = 0; q < s.M; q++) {
            bool same = true;  // independent losses: nothing to look up
            for (int j = 1; j < s.M; j++) same = same && logPi[j * s.M + q] == logPi[q];
            if (same)
                for (int b = 0; b < blocks(s.live); b++) v4(s.a)[q * bank / lanes + b] = all4(logPi[q]);
            else
                for (int i = 0; i < s.live; i++) s.a[q * bank + i] = logPi[s.mode[i] * s.M + q];
        }
    } else {
        for (int i = 0; i < s.live; i++) {
            for (int q = 0; q < s.M; q++) lp[q] = 0.0;
            for (int g = 0; g < s.G; g++) {
                const int before = s.learn == learn_markov ? (s.mode[i] >> g) & 1 : 0;
                const double* c = s.count + ((static_cast<long>(i) * s.G + g) * 2 + before) * 2;
                const double total = std::log(c[0] + c[1]);
                const double l[2] = {std::log(c[0]) - total, std::log(c[1]) - total};
                for (int q = 0; q < s.M; q++) lp[q] += l[(q >> g) & 1];
            }
            for (int q = 0; q < s.M; q++) s.a[q * bank + i] = lp[q];
        }
    }
    for (int q = 0; q < s.M; q++)
        for (long i = s.live; i < bank; i++) s.a[q * bank + i] = minus_inf;
}

// Log weights a to weights w and log weights normalised; false if no child is possible.
inline bool weigh(LossState& s, double* loglik) {
    const int B = blocks(s.live), bank = blocks(s.K);
    V4 *a = v4(s.a), *w = v4(s.w), *lw = v4(s.lw);
    V4 top = all4(minus_inf);
    for (int b = 0; b < B; b++) {
        V4 most = a[b];
        for (int q = 1; q < s.M; q++) most = max4(most, a[q * bank + b]);
        most = most > all4(-1e300) ? most : V4{};
        V4 sum{};
        for (int q = 0; q < s.M; q++) sum += w[q * bank + b] = exp4(a[q * bank + b] - most);
        lw[b] = most + log4(sum);
        const V4 inv = sum > all4(0.0) ? 1.0 / sum : V4{};
        for (int q = 0; q < s.M; q++) w[q * bank + b] *= inv;
        top = max4(top, lw[b]);
    }
    const double g = top4(top);
    if (!(g > -1e300 && g < 1e300)) return false;
    V4 total{};
    for (int b = 0; b < B; b++) total += exp4(lw[b] - g);
    const double sum = sum4(total), lse = g + std::log(sum);
    for (int b = 0; b < B; b++) {
        lw[b] -= lse;
        const V4 W = exp4(lw[b]);
        for (int q = 0; q < s.M; q++) {
            w[q * bank + b] *= W;
            a[q * bank + b] -= lse;
        }
    }
    *loglik = lse;
    return true;
}

// ---- the mixture's moments -----------------------------------------------------------------------------------------

// Mean and covariance of all children; with spread = 0 the covariances alone are averaged. t: scratch (2 n n + n)
template <class N>
inline void moments(N n, LossState& s, double* x, double* P, V4* t) {
    const int B = blocks(s.live), bank = blocks(s.K);
    V4 *mean = t, *cov = t + n, *dx = t + n + n * n;
    for (int i = 0; i < n; i++) mean[i] = V4{};
    for (int i = 0; i < n * n; i++) cov[i] = V4{};
    for (int pass = 0; pass < 2; pass++) {
        for (int q = -1; q < s.M; q++) {  // q = -1: all modes that leave the component as it is
            if (q >= 0 && s.still[q]) continue;
            const V4* cx = v4(q < 0 ? s.x : child_x(n, s, q));
            const V4* cP = v4(q < 0 ? s.P : child_P(n, s, q));
            for (int b = 0; b < B; b++) {
                V4 w{};
                if (q < 0) {
                    for (int j = 0; j < s.M; j++)
                        if (s.still[j]) w += v4(s.w)[j * bank + b];
                } else {
                    w = v4(s.w)[q * bank + b];
                }
                if (top4(w) == 0.0) continue;
                if (pass == 0) {
                    for (int i = 0; i < n; i++) mean[i] += w * cx[b * n + i];
                    continue;
                }
                for (int i = 0; i < n; i++) dx[i] = s.spread ? cx[b * n + i] - x[i] : V4{};
                for (int i = 0; i < n; i++) {
                    const V4 wd = w * dx[i];
                    for (int j = 0; j <= i; j++)
                        cov[i * n + j] += w * cP[static_cast<long>(b) * n * n + i * n + j] + wd * dx[j];
                }
            }
        }
        if (pass == 0)
            for (int i = 0; i < n; i++) x[i] = sum4(mean[i]);
    }
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) P[i * n + j] = P[j * n + i] = sum4(cov[i * n + j]);
}

// Mean and covariance of the components themselves; c holds one component (n + n n)
template <class N>
inline void moments_of_components(N n, const LossState& s, double* x, double* P, double* c) {
    double *xi = c, *Pi = c + n, total = 0.0;
    for (int i = 0; i < n; i++) x[i] = 0.0;
    for (int i = 0; i < n * n; i++) P[i] = 0.0;
    for (int i = 0; i < s.live; i++) {
        const double w = std::exp(s.logw[i]);
        if (w == 0.0) continue;
        total += w;
        take(n, s.x, s.P, i, xi, Pi);
        for (int j = 0; j < n; j++) x[j] += w * xi[j];
    }
    for (int j = 0; j < n; j++) x[j] /= total;
    for (int i = 0; i < s.live; i++) {
        const double w = std::exp(s.logw[i]) / total;
        if (w == 0.0) continue;
        take(n, s.x, s.P, i, xi, Pi);
        for (int j = 0; j < n; j++)
            for (int l = 0; l < n; l++) P[j * n + l] += w * (Pi[j * n + l] + (xi[j] - x[j]) * (xi[l] - x[l]));
    }
    symmetrise(n, P);
}

// ---- bringing the number of components down ------------------------------------------------------------------------

inline void count_child(LossState& s, const double* from, int before, int after, bool seen, double* to) {
    for (int g = 0; g < s.G; g++) {
        for (int j = 0; j < 4; j++) to[g * 4 + j] = from[g * 4 + j];
        const int row = s.learn == learn_markov ? (before >> g) & 1 : 0;
        // the first row has no predecessor; an unseen row of independent losses teaches nothing
        if (s.learn == learn_markov ? s.started : seen) to[g * 4 + row * 2 + ((after >> g) & 1)] += 1.0;
    }
}

inline void swap_banks(LossState& s) {
    double* t = s.x; s.x = s.x2; s.x2 = t;
    t = s.P; s.P = s.P2; s.P2 = t;
    t = s.count; s.count = s.count2; s.count2 = t;
    int* i = s.mode; s.mode = s.mode2; s.mode2 = i;
}

// Child c becomes component o of the next bank.
template <class N>
inline void inherit(N n, LossState& s, int c, int o, bool seen) {
    const int q = c / s.live, i = c % s.live;
    move(n, child_x(n, s, q), child_P(n, s, q), i, s.x2, s.P2, o);
    s.mode2[o] = q;
    if (s.learn)
        count_child(s, s.count + static_cast<long>(i) * s.G * 4, s.mode[i], q, seen,
                    s.count2 + static_cast<long>(o) * s.G * 4);
}

// order[0..k) to keys descending, equal keys by index (heap sort: no allocation, no worst case)
template <class Key>
inline void sort_down(int k, int* order, Key key) {
    auto before = [&](int a, int b) { return key(a) > key(b) || (key(a) == key(b) && a < b); };
    auto sift = [&](int root, int end) {
        for (int child = 2 * root + 1; child < end; child = 2 * root + 1) {
            if (child + 1 < end && before(order[child], order[child + 1])) child++;
            if (!before(order[root], order[child])) return;
            const int t = order[root]; order[root] = order[child]; order[child] = t;
            root = child;
        }
    };
    for (int i = k / 2 - 1; i >= 0; i--) sift(i, k);
    for (int end = k - 1; end > 0; end--) {
        const int t = order[0]; order[0] = order[end]; order[end] = t;
        sift(0, end);
    }
}

// Children that agree on the newest `depth` modes become one Gaussian with their first two moments. Component index
// = newest mode first, oldest last, base M; child (q, i) = q K + i, so the partners are M neighbours.
template <class N>
inline void average(N n, LossState& s, bool seen) {
    double *xm = s.work, *Pm = xm + n, *xc = Pm + n * n, *Pc = xc + n;
    int likeliest = 0;
    for (int c = 1; c < s.M * s.K; c++)
        if (child_a(s, c) > child_a(s, likeliest)) likeliest = c;
    for (int o = 0; o < s.K; o++) {
        const int first = s.depth ? o * s.M : 0;
        double most = minus_inf;
        int best = first;
        for (int c = first; c < first + s.M; c++)
            if (child_a(s, c) > most) most = child_a(s, best = c);
        inherit(n, s, best, o, seen);
        if (!(most > -1e300)) {  // an impossible history follows the likeliest one, so that nothing can overflow in it
            move(n, child_x(n, s, likeliest / s.K), child_P(n, s, likeliest / s.K), likeliest % s.K, s.x2, s.P2, o);
            s.logw[o] = minus_inf;
            continue;
        }
        double total = 0.0;
        for (int c = first; c < first + s.M; c++) total += std::exp(child_a(s, c) - most);
        s.logw[o] = most + std::log(total);
        for (int i = 0; i < n + n * n; i++) xm[i] = 0.0;
        for (int c = first; c < first + s.M; c++) {
            const double w = std::exp(child_a(s, c) - most) / total;
            if (w == 0.0) continue;
            take(n, child_x(n, s, c / s.K), child_P(n, s, c / s.K), c % s.K, xc, Pc);
            axpy(n, w, xc, xm);
            for (int j = 0; j < n * n; j++) Pm[j] += w * Pc[j];
        }
        for (int c = first; s.spread && c < first + s.M; c++) {
            const double w = std::exp(child_a(s, c) - most) / total;
            if (w == 0.0) continue;
            take(n, child_x(n, s, c / s.K), child_P(n, s, c / s.K), c % s.K, xc, Pc);
            for (int j = 0; j < n; j++) xc[j] -= xm[j];
            for (int j = 0; j < n; j++) axpy(n, w * xc[j], xc, Pm + j * n);
        }
        put(n, xm, Pm, o, s.x2, s.P2);
        if (s.learn) {
            double* to = s.count2 + static_cast<long>(o) * s.G * 4;
            double* one = xc;  // room for G 4: the scratch is larger
            for (int j = 0; j < s.G * 4; j++) to[j] = 0.0;
            for (int c = first; c < first + s.M; c++) {
                const double w = std::exp(child_a(s, c) - most) / total;
                const int i = c % s.K;
                count_child(s, s.count + static_cast<long>(i) * s.G * 4, s.mode[i], c / s.K, seen, one);
                for (int j = 0; j < s.G * 4; j++) to[j] += w * one[j];
            }
        }
    }
    if (s.depth == 0)
        for (int q = 0; q < s.M; q++) s.mix[q] = s.w[static_cast<long>(q) * blocks(s.K) * lanes];
    swap_banks(s);
}

// Keep the `keep` likeliest children, normalised.
template <class N>
inline void keep_likeliest(N n, LossState& s, int keep, bool seen) {
    const int children = s.M * s.live;
    for (int c = 0; c < children; c++) s.order[c] = c;
    sort_down(children, s.order, [&](int c) { return child_a(s, c); });
    int k = 0;
    while (k < children && k < keep && child_a(s, s.order[k]) > -1e300) k++;
    double total = 0.0;
    const double most = child_a(s, s.order[0]);
    for (int i = 0; i < k; i++) {
        inherit(n, s, s.order[i], i, seen);
        total += std::exp(child_a(s, s.order[i]) - most);
    }
    for (int i = 0; i < k; i++) s.logw[i] = child_a(s, s.order[i]) - most - std::log(total);
    swap_banks(s);
    s.live = k;
}

// Optimal resampling (Fearnhead & Clifford 2003): children of weight c or more stay, the others survive with
// probability w / c and then weigh c, where sum min(w / c, 1) = K. Unbiased, and no two components are alike.
template <class N>
inline void resample_children(N n, LossState& s, bool seen) {
    const int children = s.M * s.live;
    double most = 0.0;
    for (int c = 0; c < children; c++) most = max2(most, child_w(s, c));
    int alive = 0;
    for (int c = 0; c < children; c++)
        if (child_w(s, c) > 1e-14 * most) s.order[alive++] = c;
    int k = 0;
    double* logw = s.work;  // (K)
    if (alive <= s.K) {
        for (; k < alive; k++) {
            inherit(n, s, s.order[k], k, seen);
            logw[k] = child_a(s, s.order[k]);
        }
    } else {
        sort_down(alive, s.order, [&](int c) { return child_w(s, c); });
        double rest = 0.0;
        for (int i = alive - 1; i >= 0; i--) rest += child_w(s, s.order[i]);
        int sure = 0;
        while (sure < s.K - 1 && child_w(s, s.order[sure]) * (s.K - sure) >= rest) rest -= child_w(s, s.order[sure++]);
        const double c = rest / (s.K - sure);
        // In the children's own order, not by weight: equal weights must not make the draw hang on rounding.
        double u = c * uniform(s.rng);
        for (int i = 0; i < children && k < s.K; i++) {
            const double w = child_w(s, i);
            if (!(w > 1e-14 * most)) continue;
            const bool stays = w >= c;
            if (!stays && (u -= w) >= 0.0) continue;
            inherit(n, s, i, k, seen);
            logw[k++] = stays ? child_a(s, i) : std::log(c);
            if (!stays) u += c;
        }
    }
    double total = 0.0;
    for (int i = 0; i < k; i++) total += std::exp(logw[i]);
    for (int i = 0; i < k; i++) s.logw[i] = logw[i] - std::log(total);
    swap_banks(s);
    s.live = k;
}

// One child is drawn for each component, with its exact probability (the optimal proposal), so the weight does not
// depend on the draw; systematic resampling when the effective number has fallen.
template <class N>
inline void draw(N n, LossState& s, bool seen) {
    const int B = blocks(s.live), bank = blocks(s.K);
    double* W = s.work;  // (K)
    for (int b = 0; b < B; b++) {
        V4 u, sum{};
        for (int l = 0; l < lanes; l++) u[l] = uniform(s.rng);
        for (int q = 0; q < s.M; q++) sum += v4(s.w)[static_cast<long>(q) * bank + b];
        v4(W)[b] = sum;
        u *= sum;
        I4 chosen{};
        V4 below{};
        for (int q = 1; q < s.M; q++) {  // the last mode that starts below u and is possible
            below += v4(s.w)[static_cast<long>(q - 1) * bank + b];
            const I4 here = (u >= below) & (v4(s.w)[static_cast<long>(q) * bank + b] > V4{});
            chosen = here ? I4{q, q, q, q} : chosen;
        }
        for (int l = 0; l < lanes && b * lanes + l < s.live; l++) {
            const int i = b * lanes + l, q = static_cast<int>(chosen[l]);
            if (s.learn) {
                double* c = s.count + static_cast<long>(i) * s.G * 4;
                count_child(s, c, s.mode[i], q, seen, c);
            }
            s.mode[i] = q;
        }
        for (int q = 0; q < s.M; q++) {
            if (s.still[q]) continue;
            const I4 mine = chosen == q;
            const V4* cx = v4(child_x(n, s, q)) + static_cast<long>(b) * n;
            const V4* cP = v4(child_P(n, s, q)) + static_cast<long>(b) * n * n;
            V4 *x = v4(s.x) + static_cast<long>(b) * n, *P = v4(s.P) + static_cast<long>(b) * n * n;
            for (int i = 0; i < n; i++) x[i] = mine ? cx[i] : x[i];
            for (int i = 0; i < n * n; i++) P[i] = mine ? cP[i] : P[i];
        }
    }
    double sum = 0.0, squares = 0.0;
    bool dead = false;
    for (int i = 0; i < s.live; i++) {
        s.logw[i] = s.lw[i];
        sum += W[i];
        squares += W[i] * W[i];
        dead = dead || W[i] == 0.0;
    }
    if (!dead && sum * sum >= s.threshold * s.live * squares) return;
    const double u = uniform(s.rng), each = -std::log(static_cast<double>(s.K));
    double reached = 0.0;
    int from = -1;
    for (int i = 0; i < s.K; i++) {
        while (from < s.live - 1 && reached * s.K <= (i + u) * sum) reached += W[++from];
        while (W[from] == 0.0) from--;  // rounding at the top end
        move(n, s.x, s.P, from, s.x2, s.P2, i);
        s.mode2[i] = s.mode[from];
        for (int j = 0; s.learn && j < s.G * 4; j++)
            s.count2[static_cast<long>(i) * s.G * 4 + j] = s.count[static_cast<long>(from) * s.G * 4 + j];
        s.logw[i] = each;
    }
    swap_banks(s);
    s.live = s.K;
}

// log det of a covariance, a vanished pivot counting as the smallest number; L (n,n), li (n) scratch
template <class N>
inline double log_det(N n, const double* P, double* L, double* li) {
    cholesky(n, P, L, li);
    LogProduct det;
    for (int i = 0; i < n; i++) det.times(L[i * n + i] > 1e-150 ? L[i * n + i] : 1e-150);
    return 2.0 * det.log();
}

// Join the pair whose joining costs least, an upper bound of the Kullback-Leibler divergence (Runnalls 2007, (21)),
// until K are left. Only pairs with the same last mode when the next mode depends on it.
template <class N>
inline void join(N n, LossState& s, bool independent, bool seen) {
    const int children = s.M * s.live, size = n + n * n;
    double most = 0.0;
    for (int c = 0; c < children; c++) most = max2(most, child_w(s, c));
    int J = 0;
    for (int c = 0; c < children; c++)
        if (child_w(s, c) > 1e-8 * most) s.order[J++] = c;
    double* pool = s.work;                                 // (J, n + n n)
    double* ld = pool + static_cast<long>(s.M) * s.K * size;  // (J)
    double* w = ld + s.M * s.K;                            // (J)
    double* counts = w + s.M * s.K;                        // (J, G, 4)
    double* cost = counts + static_cast<long>(s.M) * s.K * s.G * 4;  // (J, J), i < j
    double* one = cost + static_cast<long>(s.M) * s.K * s.M * s.K;   // (size)
    double *L = one + size, *li = L + n * n;
    int* mode = s.order + s.M * s.K;                       // (J)
    const int stride = s.M * s.K;
    for (int i = 0; i < J; i++) {
        const int c = s.order[i], q = c / s.live, from = c % s.live;
        double* p = pool + static_cast<long>(i) * size;
        take(n, child_x(n, s, q), child_P(n, s, q), from, p, p + n);
        ld[i] = log_det(n, p + n, L, li);
        w[i] = child_w(s, c);
        mode[i] = q;
        if (s.learn)
            count_child(s, s.count + static_cast<long>(from) * s.G * 4, s.mode[from], q, seen,
                        counts + static_cast<long>(i) * s.G * 4);
    }
    auto joined = [&](int i, int j) {  // moments of i and j together, into `one`
        const double *a = pool + static_cast<long>(i) * size, *b = pool + static_cast<long>(j) * size;
        const double f = w[i] / (w[i] + w[j]), g = 1.0 - f;
        for (int k = 0; k < size; k++) one[k] = f * a[k] + g * b[k];
        for (int k = 0; k < n; k++)
            for (int l = 0; l < n; l++) one[n + k * n + l] += f * g * (a[k] - b[k]) * (a[l] - b[l]);
    };
    auto price = [&](int i, int j) {
        double B = __builtin_inf();
        if (independent || mode[i] == mode[j]) {
            joined(i, j);
            B = 0.5 * ((w[i] + w[j]) * log_det(n, one + n, L, li) - w[i] * ld[i] - w[j] * ld[j]);
        }
        cost[static_cast<long>(i) * stride + j] = B;
    };
    if (J > s.K)
        for (int i = 0; i < J; i++)
            for (int j = i + 1; j < J; j++) price(i, j);
    while (J > s.K) {
        int a = -1, b = -1;
        double least = __builtin_inf();
        for (int i = 0; i < J; i++)
            for (int j = i + 1; j < J; j++)
                if (cost[static_cast<long>(i) * stride + j] < least) least = cost[static_cast<long>(a = i) * stride + (b = j)];
        if (a < 0) break;  // no two may be joined: fewer components than modes were asked for
        joined(a, b);
        copy(Dim<0>(size), one, pool + static_cast<long>(a) * size);
        ld[a] = log_det(n, one + n, L, li);
        for (int k = 0; s.learn && k < s.G * 4; k++) {
            double *ca = counts + static_cast<long>(a) * s.G * 4, *cb = counts + static_cast<long>(b) * s.G * 4;
            ca[k] = (w[a] * ca[k] + w[b] * cb[k]) / (w[a] + w[b]);
        }
        w[a] += w[b];
        const int last = --J;  // the last one moves into the place of b
        if (b != last) {
            copy(Dim<0>(size), pool + static_cast<long>(last) * size, pool + static_cast<long>(b) * size);
            ld[b] = ld[last];
            w[b] = w[last];
            mode[b] = mode[last];
            for (int k = 0; s.learn && k < s.G * 4; k++)
                counts[static_cast<long>(b) * s.G * 4 + k] = counts[static_cast<long>(last) * s.G * 4 + k];
        }
        for (int k = 0; k < J; k++) {
            if (k != a) price(k < a ? k : a, k < a ? a : k);
            if (b != last && k != a && k != b) price(k < b ? k : b, k < b ? b : k);
        }
    }
    J = J < s.K ? J : s.K;
    double total = 0.0;
    for (int i = 0; i < J; i++) total += w[i];
    for (int i = 0; i < J; i++) {
        put(n, pool + static_cast<long>(i) * size, pool + static_cast<long>(i) * size + n, i, s.x2, s.P2);
        s.logw[i] = std::log(w[i] / total);
        s.mode2[i] = mode[i];
        for (int k = 0; s.learn && k < s.G * 4; k++)
            s.count2[static_cast<long>(i) * s.G * 4 + k] = counts[static_cast<long>(i) * s.G * 4 + k];
    }
    swap_banks(s);
    s.live = J;
}

// Lanes past the last component repeat component 0, so that no rubbish can grow in them.
template <class N>
inline void pad(N n, LossState& s) {
    for (int i = s.live; i < blocks(s.live) * lanes; i++) {
        move(n, s.x, s.P, 0, s.x, s.P, i);
        s.logw[i] = minus_inf;
    }
}

// P(received | before), averaged over the components, sensor by sensor
inline void learned_law(const LossState& s, double* law) {
    for (int g = 0; g < s.G; g++)
        for (int before = 0; before < 2; before++) {
            const int row = s.learn == learn_markov ? before : 0;
            double p = 0.0, total = 0.0;
            for (int i = 0; i < s.live; i++) {
                const double w = std::exp(s.logw[i]);
                const double* c = s.count + ((static_cast<long>(i) * s.G + g) * 2 + row) * 2;
                p += w * c[1] / (c[0] + c[1]);
                total += w;
            }
            law[g * 2 + before] = p / total;
        }
}

// ---- one row -------------------------------------------------------------------------------------------------------

template <class N>
inline int step(N n, LossState& s, const LossRow& r, LossOut& o, LossPast* past, int slot) {
    const int B = blocks(s.live), bank = blocks(s.K);
    V4 own[N::fixed ? 2 * N::cap * N::cap + 2 * N::cap : 1];
    V4* t = N::fixed ? own : v4(s.work);
    if (r.A)
        for (int b = 0; b < B; b++)
            predict4(n, r.A, r.b, r.Q, v4(s.x) + static_cast<long>(b) * n, v4(s.P) + static_cast<long>(b) * n * n, t);
    bool any = false;
    for (int j = 0; j < s.m; j++) {
        s.fresh |= s.seen[j] != static_cast<int>(r.seen[j]);
        any = any || r.seen[j];
    }
    if (s.fresh) {
        const int code = whiten(n, s, r);
        if (code != loss_ok) return code;
        s.fresh = 0;
    }
    whiten_output(s, r);
    mode_priors(s, r.logPi);
    for (int q = 0; q < s.M; q++) {
        const double* z = s.z + q * s.m;
        const int *moves = s.moves + q * s.m, u = s.used[q];
        V4* a = v4(s.a) + static_cast<long>(q) * bank;
        if (s.still[q]) {
            double quad = 0.0;
            for (int i = 0; i < u; i++) quad += z[i] * z[i];
            for (int b = 0; b < B; b++) a[b] += v4(s.logw)[b] + all4(s.konst[q] - 0.5 * quad);
            continue;
        }
        V4* cx = v4(s.cx) + static_cast<long>(q) * bank * n;
        V4* cP = v4(s.cP) + static_cast<long>(q) * bank * n * n;
        for (int b = 0; b < B; b++) {
            const V4 *x = v4(s.x) + static_cast<long>(b) * n, *P = v4(s.P) + static_cast<long>(b) * n * n;
            V4 *xo = cx + static_cast<long>(b) * n, *Po = cP + static_cast<long>(b) * n * n;
            for (int i = 0; i < n; i++) xo[i] = x[i];
            for (int i = 0; i < n * n; i++) Po[i] = P[i];
            a[b] += v4(s.logw)[b] +
                    correct4(n, u, s.rows + static_cast<long>(q) * s.m * n, z, moves, s.konst[q], xo, Po, t);
        }
    }
    int code = loss_ok;
    if (!weigh(s, &o.loglik)) {
        // No mode explains the row (or a number overflowed): the row is left unused, the chain keeps its prior.
        code = loss_void;
        o.loglik = 0.0;
        mode_priors(s, r.logPi);
        for (int q = 0; q < s.M; q++) {
            s.still[q] = 1;
            for (int b = 0; b < B; b++) v4(s.a)[static_cast<long>(q) * bank + b] += v4(s.logw)[b];
        }
        s.fresh = 1;
        double ignored;
        if (!weigh(s, &ignored)) return loss_not_finite;
    }
    if (o.modes)
        for (int q = 0; q < s.M; q++) {
            V4 sum{};
            for (int b = 0; b < B; b++) sum += v4(s.w)[static_cast<long>(q) * bank + b];
            o.modes[q] = code == loss_void ? (q == 0) : sum4(sum);
        }
    const bool before = s.rule != loss_decide && s.rule != loss_beam;  // output before the reduction: no extra noise
    if (before && o.x) moments(n, s, o.x, o.P, t);
    if (past && s.rule == loss_average)
        for (int c = 0; c < s.M * s.K; c++) {
            const long at = static_cast<long>(slot) * past->cells + c;
            past->a[at] = child_a(s, c);
            take(n, child_x(n, s, c / s.K), child_P(n, s, c / s.K), c % s.K, past->x + at * n, past->P + at * n * n);
        }
    switch (s.rule) {
        case loss_average: average(n, s, any); break;
        case loss_sample: draw(n, s, any); break;
        case loss_resample: resample_children(n, s, any); break;
        case loss_merge: {
            bool independent = s.learn != learn_markov;
            for (int i = 1; independent && !s.learn && i < s.M; i++)
                for (int j = 0; j < s.M; j++) independent = independent && r.logPi[i * s.M + j] == r.logPi[j];
            join(n, s, independent, any);
            break;
        }
        default: keep_likeliest(n, s, s.K, any);
    }
    s.started = 1;
    pad(n, s);
    if (!before) {
        if (o.x) moments_of_components(n, s, o.x, o.P, s.work);
        if (o.modes && code != loss_void) {
            for (int q = 0; q < s.M; q++) o.modes[q] = 0.0;
            for (int i = 0; i < s.live; i++) o.modes[s.mode[i]] += std::exp(s.logw[i]);
        }
        if (past && s.rule == loss_decide) {
            past->a[slot] = 0.0;
            take(n, s.x, s.P, 0, past->x + static_cast<long>(slot) * n, past->P + static_cast<long>(slot) * n * n);
        }
    }
    if (o.law && s.learn) learned_law(s, o.law);
    if (o.x && !(all_finite(n, o.x) && all_finite(Dim<0>(n * n), o.P))) return loss_not_finite;
    return code;
}

// ---- smoothing: Kim's backward pass over cells that remember `depth` + 1 modes ----------------------------------------

struct Smoother {
    int M, K;         // of the cells: child c = newest mode * K + i, partners before merging = M neighbours
    bool decided;     // hard decisions: one cell a row, the modes stay as they were
    double *sw, *sx, *sP, *pw, *px, *pP, *work;
};

// Cells of the last row: what the filter said.
template <class N>
inline void smooth_begin(N n, const LossPast& past, int slot, Smoother& f) {
    for (int c = 0; c < f.M * f.K; c++) {
        const long at = static_cast<long>(slot) * past.cells + c;
        f.sw[c] = std::exp(past.a[at]);
        copy(n, past.x + at * n, f.sx + static_cast<long>(c) * n);
        copy(Dim<0>(n * n), past.P + at * n * n, f.sP + static_cast<long>(c) * n * n);
    }
}

// First two moments of cells c = first, first + stride, ... with weights sw; returns their total weight.
template <class N>
inline double collapse(N n, const Smoother& f, int first, int stride, int cells, double* x, double* P, double* dx) {
    double total = 0.0;
    for (int c = first; c < cells; c += stride) total += f.sw[c];
    for (int i = 0; i < n; i++) x[i] = 0.0;
    for (int i = 0; i < n * n; i++) P[i] = 0.0;
    if (!(total > 0.0)) {
        copy(n, f.sx + static_cast<long>(first) * n, x);
        copy(Dim<0>(n * n), f.sP + static_cast<long>(first) * n * n, P);
        return 0.0;
    }
    for (int c = first; c < cells; c += stride)
        if (f.sw[c] > 0.0) axpy(n, f.sw[c] / total, f.sx + static_cast<long>(c) * n, x);
    for (int c = first; c < cells; c += stride) {
        const double w = f.sw[c] / total;
        if (!(w > 0.0)) continue;
        for (int i = 0; i < n; i++) dx[i] = f.sx[static_cast<long>(c) * n + i] - x[i];
        for (int i = 0; i < n; i++) axpy(n, w * dx[i], dx, P + i * n);
        axpy(Dim<0>(n * n), w, f.sP + static_cast<long>(c) * n * n, P);
    }
    symmetrise(n, P);
    return total;
}

// From the smoothed cells of row t+1 to those of row t; A, b, Q are those of row t+1.
template <class N>
inline void smooth_back(N n, const double* A, const double* b, const double* Q, const LossPast& past, int slot,
                        Smoother& f) {
    const int M = f.M, K = f.K;
    double* At = f.work;                         // (n,n)
    double *V = At + n * n, *L = V + n * n, *d = L + n * n, *di = d + n;
    double *J = di + n, *G = J + n * n, *W = G + n * n, *dx = W + n * n, *xm = dx + n;
    transpose(n, n, A, At);
    for (int i = 0; i < K; i++)
        f.pw[i] = collapse(n, f, i, K, M * K, f.px + static_cast<long>(i) * n, f.pP + static_cast<long>(i) * n * n, dx);
    for (int c = 0; c < M * K; c++) {
        const long at = static_cast<long>(slot) * past.cells + c;
        const int parent = K > 1 ? c / M : 0, first = parent * M;
        const double *x = past.x + at * n, *P = past.P + at * n * n;
        double *xs = f.sx + static_cast<long>(c) * n, *Ps = f.sP + static_cast<long>(c) * n * n;
        double most = minus_inf, total = 0.0;
        for (int j = 0; j < M; j++) most = max2(most, past.a[static_cast<long>(slot) * past.cells + first + j]);
        for (int j = 0; most > -1e300 && j < M; j++)
            total += std::exp(past.a[static_cast<long>(slot) * past.cells + first + j] - most);
        f.sw[c] = total > 0.0 ? f.pw[parent] * std::exp(past.a[at] - most) / total : 0.0;
        if (f.sw[c] < 1e-15) {
            f.sw[c] = 0.0;
            copy(n, x, xs);
            copy(Dim<0>(n * n), P, Ps);
            continue;
        }
        congruence(n, n, A, At, P, Q, V, G);      // P- = A P A' + Q
        mul(n, n, n, A, P, G);                    // (A P), and J' = P-^-1 A P
        ldl(n, V, L, d, di);
        ldl_solve(n, n, L, di, G);
        transpose(n, n, G, J);
        for (int i = 0; i < n; i++) xm[i] = b ? b[i] : 0.0;
        mul_v<Op::add>(n, n, A, x, xm);
        for (int i = 0; i < n; i++) dx[i] = f.px[static_cast<long>(parent) * n + i] - xm[i];
        copy(n, x, xs);
        mul_v<Op::add>(n, n, J, dx, xs);
        // (I - J A) P (I - J A)' + J (P_s + Q) J': a sum of squares, so it stays one
        mul(n, n, n, J, A, W);
        for (int i = 0; i < n * n; i++) W[i] = -W[i];
        for (int i = 0; i < n; i++) W[i * n + i] += 1.0;
        transpose(n, n, W, V);
        congruence(n, n, W, V, P, nullptr, L, At);
        for (int i = 0; i < n * n; i++) V[i] = f.pP[static_cast<long>(parent) * n * n + i] + Q[i];
        congruence(n, n, J, G, V, L, Ps, At);
        transpose(n, n, A, At);
    }
}

// What the smoothed cells of a row say: the mixture's moments and the modes.
template <class N>
inline bool smooth_out(N n, const Smoother& f, double* x, double* P, double* modes, double* pairs) {
    const int cells = f.M * f.K;
    double *xs = f.work + n, *Ps = xs + n;
    const double total = collapse(n, f, 0, 1, cells, xs, Ps, f.work);
    if (!(total > 0.0) || !all_finite(n, xs) || !all_finite(Dim<0>(n * n), Ps)) return false;  // the filter's answer stays
    copy(n, xs, x);
    copy(Dim<0>(n * n), Ps, P);
    if (f.decided) return true;
    for (int q = 0; q < f.M; q++) modes[q] = 0.0;
    for (int c = 0; c < cells; c++) modes[c / f.K] += f.sw[c] / total;
    if (pairs && f.K >= f.M)
        for (int c = 0; c < cells; c++) pairs[c % f.K / (f.K / f.M) * f.M + c / f.K] += f.sw[c] / total;
    return true;
}

// ---- a whole record ------------------------------------------------------------------------------------------------

template <class N>
inline int filter(N n, LossState& s, LossArgs& k) {
    int code = loss_ok;
    *k.bad_row = -1;
    *k.void_rows = 0;
    auto log_pi = [&](int t) {
        for (int i = 0; i < s.M * s.M; i++) s.logPi[i] = log_or_minus_inf(k.Pi[t * k.sPi + i]);
    };
    log_pi(0);
    Smoother f{s.rule == loss_decide ? 1 : s.M, s.rule == loss_decide ? 1 : s.K, s.rule == loss_decide,
               k.sw, k.sx, k.sP, k.pw, k.px, k.pP, s.work};
    auto back_to = [&](int t) {
        smooth_back(n, k.A + (t + 1) * k.sA, k.b ? k.b + (t + 1) * k.sb : nullptr, k.Q + (t + 1) * k.sQ, k.past,
                    t % k.past.slots, f);
    };
    auto tell = [&](int t, bool pairs) {
        if (!smooth_out(n, f, k.x + static_cast<long>(t) * n, k.P + static_cast<long>(t) * n * n,
                        k.modes + static_cast<long>(t) * s.M, pairs && t > 0 ? k.pairs : nullptr)) {
            code = loss_not_finite;
            if (*k.bad_row < 0 || t < *k.bad_row) *k.bad_row = t;
        }
    };
    int last = k.T - 1;
    for (int t = 0; t < k.T; t++) {
        if (k.sPi && t) log_pi(t);
        if (k.sC || k.sR) s.fresh = 1;
        const bool go = t || !k.prior_predicted;
        LossRow r{go ? k.A + t * k.sA : nullptr, k.b ? k.b + t * k.sb : nullptr, k.Q + t * k.sQ, k.C + t * k.sC,
                  k.d ? k.d + t * k.sd : nullptr, k.R + t * k.sR, k.y + static_cast<long>(t) * s.m,
                  k.seen + static_cast<long>(t) * s.m, s.logPi};
        LossOut o{k.x + static_cast<long>(t) * n, k.P + static_cast<long>(t) * n * n,
                  k.modes + static_cast<long>(t) * s.M,
                  s.learn ? k.law + static_cast<long>(t) * s.G * 2 : nullptr, 0.0};
        const int now = step(n, s, r, o, k.smooth ? &k.past : nullptr, k.smooth ? t % k.past.slots : 0);
        k.loglik[t] = o.loglik;
        if (now == loss_bad_noise) {
            *k.bad_row = t;
            return now;
        }
        if (now == loss_not_finite) {  // hold the last finite answer; the caller is told
            *k.bad_row = t;
            code = now;
            last = t - 1;
            for (int j = t; j < k.T; j++) {
                for (int i = 0; i < n; i++) k.x[static_cast<long>(j) * n + i] = t ? k.x[static_cast<long>(t - 1) * n + i] : 0.0;
                for (int i = 0; i < n * n; i++)
                    k.P[static_cast<long>(j) * n * n + i] = t ? k.P[static_cast<long>(t - 1) * n * n + i] : 0.0;
                for (int q = 0; q < s.M; q++) k.modes[static_cast<long>(j) * s.M + q] = q == 0;
                for (int i = 0; s.learn && i < 2 * s.G; i++) k.law[static_cast<long>(j) * s.G * 2 + i] = 0.5;
                k.loglik[j] = 0.0;
            }
            break;
        }
        if (now == loss_void) ++*k.void_rows;
        if (k.smooth == 2 && t >= k.lag) {
            smooth_begin(n, k.past, t % k.past.slots, f);
            for (int j = t - 1; j >= t - k.lag; j--) back_to(j);
            tell(t - k.lag, false);
        }
    }
    if (k.smooth && last >= 0) {
        const int first = k.smooth == 1 ? 0 : (last - k.lag + 1 > 0 ? last - k.lag + 1 : 0);
        smooth_begin(n, k.past, last % k.past.slots, f);
        tell(last, k.smooth == 1);
        for (int t = last - 1; t >= first; t--) {
            back_to(t);
            tell(t, k.smooth == 1);
        }
    }
    return code;
}

}  // namespace HW_ISA
}  // namespace hw
#endif
