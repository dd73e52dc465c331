// Draws from the joint posterior of a trajectory, unknown half-widths and unknown model entries: the truth that faster
// estimators are held against.
//
// Rows rho = M X - b of the unknowns X (states, and outputs that are needed but were not seen). A row of group j >= 0
// obeys |rho| <= s_j with the uniform density of that box; a row of group -1 is Gaussian with precision w. With M_j the
// largest |rho| of the N_j rows of group j the conditional of a half-width is
//
//     p(s_j | X) ~ s_j^-N_j prior(s_j) on s_j >= M_j;     the prior is s^(power - 1) between floor and cap, or normal in log s.
//
// Given s, X fills a polytope (under a Gaussian where rows are Gaussian), and every move along a line has a closed
// draw: uniform, or normal between two ends.
//
//     coordinate  each unknown in turn, forth and back in time
//     whitened    d = L^-T z, LL' the precision of a Gaussian look-alike at the present s: long in the directions that
//                 are open, slow where single unknowns hinder each other
//     entry       one unknown entry of A, B, C, E or F: a line too, since rho is linear in it
//     scale       all disturbances of one state grow by lambda and their half-width with them, all half-widths
//                 integrated out: a chain does not stick where one is small. In log lambda the density gains the
//                 Jacobian T log lambda; a slice along it (Neal 2003) needs no tuning
#pragma once

#include "sampler_entry.hpp"

#ifdef HW_SAMPLER_KERNEL
#include "noise.hpp"

namespace hw {
namespace HW_ISA {

inline std::uint64_t bits(std::uint64_t& state) {  // splitmix64
    state += 0x9e3779b97f4a7c15ULL;
    std::uint64_t z = state;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
    return z ^ (z >> 31);
}
inline double uniform01(std::uint64_t& state) { return (static_cast<double>(bits(state) >> 11) + 0.5) * 0x1.0p-53; }

// log of int exp(-k u) du from u = low to `length` above it: what a prior s^(power - 1) leaves of N = k + power rows
inline double log_exponential(double k, double low, double length) {
    if (length <= 0.0) return minus_inf;
    const double kl = k * length;
    if (kl > 1e-8 || kl < -1e-8) return -k * low + std::log((kl > 700.0 ? 1.0 : -std::expm1(-kl)) / k);
    return -k * low + std::log(length);
}

// log int of the half-width's conditional above `largest`; u = log s
inline double log_mass(const SamplerArgs& a, long j, double cap, double largest) {
    const double low = std::log(max2(max2(largest, a.floor[j]), a.tiny[j]));
    const double high = cap < __builtin_inf() ? std::log(cap) : 1e300;
    if (low > high) return minus_inf;
    const double N = static_cast<double>(a.count[j]), d = a.prior_sd[j];
    if (!(d > 0.0)) return log_exponential(N - a.power, low, high - low);
    const double m = a.prior_mean[j] - N * d * d;
    const Truncated4 t = truncated4(all4(m), all4(d * d), all4(low), all4(high));
    return t.log_z()[0] - N * a.prior_mean[j] + 0.5 * N * N * d * d;
}

// A draw of a standard normal between two ends.
inline double draw_between(double lo, double hi, std::uint64_t& rng) {
    if (!(lo < hi)) return lo;
    for (int attempt = 0; attempt < 10000; attempt++) {
        double z, keep;
        if (hi - lo < 2.5) {  // little changes: a uniform proposal
            z = lo + (hi - lo) * uniform01(rng);
            const double top = lo > 0.0 ? lo : (hi < 0.0 ? hi : 0.0);
            keep = 0.5 * (top * top - z * z);
        } else if (lo > 0.5 || hi < -0.5) {  // a tail: an exponential proposal
            const double near = lo > 0.5 ? lo : -hi, rate = 0.5 * (near + std::sqrt(near * near + 4.0));
            z = near - std::log(uniform01(rng)) / rate;
            keep = -0.5 * (z - rate) * (z - rate);
            if (lo <= 0.5) z = -z;
        } else {
            z = std::sqrt(-2.0 * std::log(uniform01(rng))) * std::cos(6.283185307179586477 * uniform01(rng));
            keep = 0.0;
        }
        if (z >= lo && z <= hi && std::log(uniform01(rng)) <= keep) return z;
    }
    return lo > 0.0 ? lo : (hi < 0.0 ? hi : 0.0);
}

// A draw of log s above `largest`.
inline double draw_log_s(const SamplerArgs& a, long j, double cap, double largest, std::uint64_t& rng) {
    const double low = std::log(max2(max2(largest, a.floor[j]), a.tiny[j]));
    const double high = cap < __builtin_inf() ? std::log(cap) : 1e300;
    if (!(low < high)) return low;
    const double N = static_cast<double>(a.count[j]), d = a.prior_sd[j];
    if (!(d > 0.0)) {
        const double k = N - a.power, kl = k * (high - low), u = uniform01(rng);
        if (kl < 1e-8 && kl > -1e-8) return low + u * (high - low);
        return low - std::log1p(u * (kl > 700.0 ? -1.0 : std::expm1(-kl))) / k;
    }
    const double m = a.prior_mean[j] - N * d * d;
    return m + d * draw_between((low - m) / d, (high - m) / d, rng);
}

// State of one chain. Residuals stand by group, each group filled to a multiple of four with zeros; Gaussians last.
struct Chain {
    double *rho, *step;  // (R,) residuals, and their change along the line
    double *edge;        // (R,) half-width of each row, infinite for Gaussian ones and for filling
    double *x, *d;       // (N,) unknowns, direction
    double *s, *cap;     // (p,) half-widths; caps, wider than asked for until a trajectory fits
    double *L, *inv;     // (N, band+1), (N,) look-alike at s by columns, and reciprocals of its diagonal
    double *width;       // (n,) first stretch of the slice of each scale
    std::uint64_t rng;
};

// rho of every row at x, in its place
inline void rows_at(const SamplerArgs& a, const double* x, bool offset, double* out) {
    for (long k = 0; k < a.K; k++) {
        double v = offset ? -a.b[k] : 0.0;
        for (long e = a.start[k]; e < a.start[k + 1]; e++) v += a.value[e] * x[a.column[e]];
        out[a.place[k]] = v;
    }
}

// Log density of log lambda = alpha, half-widths integrated out, without what does not change.
struct Line {
    const SamplerArgs& a;
    const Chain& c;
    double linear, square;  // of the Gaussian rows

    double operator()(double alpha) const {
        const double move = std::expm1(alpha);
        double f = alpha * static_cast<double>(a.T) - move * (linear + 0.5 * move * square);
        for (long j = 0; j < a.p; j++) {
            if (a.count[j] == 0) continue;
            const V4 m = all4(move);
            V4 top = {};
            const V4* r = reinterpret_cast<const V4*>(c.rho + a.first[j]);
            const V4* s = reinterpret_cast<const V4*>(c.step + a.first[j]);
            for (long k = 0; k < (a.first[j + 1] - a.first[j]) / 4; k++) top = max4(top, abs4(r[k] + m * s[k]));
            const double M = top4(top);
            if (a.floor[j] == a.cap[j]) {
                if (M > c.cap[j]) return minus_inf;
            } else {
                f += log_mass(a, j, c.cap[j], M);
                if (f == minus_inf) return f;
            }
        }
        return f;
    }
};

// The part of alpha that a row or box leaves: low <= at + slope alpha <= high.
inline void cut(double at, double slope, double low, double high, double& lo, double& hi) {
    if (slope == 0.0) return;
    const double u = (low - at) / slope, v = (high - at) / slope;
    lo = max2(lo, min2(u < v ? u : v, 0.0));
    hi = min2(hi, max2(u < v ? v : u, 0.0));
}

inline void cut_boxes(const SamplerArgs& a, const Chain& c, double& lo, double& hi) {
    for (long i = 0; i < a.N; i++) cut(c.x[i], c.d[i], a.lo[i], a.hi[i], lo, hi);
}

// A draw along the line given s: uniform between the ends that the rows leave, or normal where rows are Gaussian.
inline double along(const SamplerArgs& a, Chain& c, double lo, double hi) {
    const V4* r = reinterpret_cast<const V4*>(c.rho);
    const V4* d = reinterpret_cast<const V4*>(c.step);
    const V4* e = reinterpret_cast<const V4*>(c.edge);
    V4 down = all4(-lo), up = all4(hi);
    for (long k = 0; k < a.first[a.p] / 4; k++) {
        const V4 size = max4(abs4(d[k]), all4(1e-300)), toward = d[k] < all4(0.0) ? -r[k] : r[k];
        up = min4(up, (e[k] - toward) / size);
        down = min4(down, (e[k] + toward) / size);
    }
    hi = max2(0.0, min2(min2(up[0], up[1]), min2(up[2], up[3])));
    lo = -max2(0.0, min2(min2(down[0], down[1]), min2(down[2], down[3])));
    double linear = 0.0, square = 0.0;
    for (long k = a.first[a.p]; k < a.R; k++) {
        linear += a.weight[k] * c.rho[k] * c.step[k];
        square += a.weight[k] * c.step[k] * c.step[k];
    }
    if (square > 0.0) {
        const double sd = 1.0 / std::sqrt(square), mean = -linear / square;
        return mean + sd * draw_between((lo - mean) / sd, (hi - mean) / sd, c.rng);
    }
    if (hi - lo > 1e200) return 0.0;  // nothing holds this direction
    return lo + (hi - lo) * uniform01(c.rng);
}

// A slice of f on [lo, hi] around 0; `width` is the first stretch tried.
template <class F>
double sliced(const F& f, double lo, double hi, double width, std::uint64_t& rng) {
    const double level = f(0.0) + std::log(uniform01(rng));
    double left = -width * uniform01(rng), right = left + width;
    for (int k = 0; k < 32 && left > lo && f(left) > level; k++) left -= width;
    for (int k = 0; k < 32 && right < hi && f(right) > level; k++) right += width;
    left = max2(left, lo);
    right = min2(right, hi);
    for (int k = 0; k < 200; k++) {
        const double alpha = left + (right - left) * uniform01(rng);
        if (f(alpha) >= level) return alpha;
        (alpha < 0.0 ? left : right) = alpha;
    }
    return 0.0;
}

inline void advance(const SamplerArgs& a, Chain& c, double alpha) {
    for (long i = 0; i < a.N; i++) c.x[i] += alpha * c.d[i];
    for (long k = 0; k < a.R; k++) c.rho[k] += alpha * c.step[k];
}

inline void coordinate_move(const SamplerArgs& a, Chain& c, long i) {
    double lo = a.lo[i] - c.x[i], hi = a.hi[i] - c.x[i], linear = 0.0, square = 0.0;
    for (long e = a.column_start[i]; e < a.column_start[i + 1]; e++) {
        const double v = a.value[a.column_at[e]];
        const long k = a.column_place[e];
        if (v == 0.0) continue;
        if (k < a.first[a.p]) {
            const double size = v < 0.0 ? -v : v, toward = v < 0.0 ? -c.rho[k] : c.rho[k];
            hi = min2(hi, (c.edge[k] - toward) / size);
            lo = max2(lo, -(c.edge[k] + toward) / size);
        } else {
            linear += a.weight[k] * c.rho[k] * v;
            square += a.weight[k] * v * v;
        }
    }
    lo = min2(lo, 0.0);
    hi = max2(hi, 0.0);
    double delta;
    if (square > 0.0) {
        const double sd = 1.0 / std::sqrt(square), mean = -linear / square;
        delta = mean + sd * draw_between((lo - mean) / sd, (hi - mean) / sd, c.rng);
    } else if (hi - lo > 1e200) {
        return;
    } else {
        delta = lo + (hi - lo) * uniform01(c.rng);
    }
    c.x[i] += delta;
    for (long e = a.column_start[i]; e < a.column_start[i + 1]; e++) c.rho[a.column_place[e]] += delta * a.value[a.column_at[e]];
}

inline void draw_half_widths(const SamplerArgs& a, Chain& c) {
    for (long j = 0; j < a.p; j++) {
        double top = 0.0;
        for (long k = a.first[j]; k < a.first[j + 1]; k++) top = max2(top, max2(c.rho[k], -c.rho[k]));
        if (c.cap[j] > a.cap[j]) c.cap[j] = max2(top, a.cap[j]);
        const bool unknown = a.count[j] && a.floor[j] < a.cap[j] && a.floor[j] < c.cap[j];
        c.s[j] = unknown ? max2(std::exp(draw_log_s(a, j, c.cap[j], top, c.rng)), top) : c.cap[j];
        for (long k = a.first[j]; k < a.first[j] + a.count[j]; k++) c.edge[k] = c.s[j];
    }
}

// The look-alike at s: rows weighed as if each box were a normal of its variance s^2 / 3.
inline void factor(const SamplerArgs& a, Chain& c) {
    const long N = a.N, w = a.band + 1;
    for (long i = 0; i < N * w; i++) c.L[i] = 0.0;
    for (long i = 0; i < N; i++) {
        const double span = a.hi[i] - a.lo[i];
        if (span < __builtin_inf()) c.L[i * w] = 3.0 / max2(span * span, 1e-280);
    }
    for (long k = 0; k < a.K; k++) {
        const long at = a.place[k];
        const double weight = at < a.first[a.p] ? 3.0 / max2(c.edge[at] * c.edge[at], 1e-280) : a.weight[at];
        for (long e = a.start[k]; e < a.start[k + 1]; e++)
            for (long f = a.start[k]; f <= e; f++)
                c.L[a.column[f] * w + a.column[e] - a.column[f]] += weight * a.value[e] * a.value[f];
    }
    for (long i = 0; i < N; i++) {
        double* col = c.L + i * w;
        if (!(col[0] > 0.0)) col[0] = 1.0;
        col[0] *= 1.0 + 1e-9;
    }
    for (long i = 0; i < N; i++) {
        double* col = c.L + i * w;
        c.inv[i] = 1.0 / std::sqrt(max2(col[0], 1e-290));
        const long end = i + w - 1 < N - 1 ? w - 1 : N - 1 - i;
        for (long k = 1; k <= end; k++) col[k] *= c.inv[i];
        for (long k = 1; k <= end; k++) {
            double* other = c.L + (i + k) * w;
            const double v = col[k];
            for (long l = k; l <= end; l++) other[l - k] -= v * col[l];
        }
    }
}

inline void whitened_move(const SamplerArgs& a, Chain& c, bool scatter) {
    const long N = a.N, w = a.band + 1;
    for (long i = 0; i < N; i++)  // a sum of 64 signs: any distribution of directions that ignores x will do
        c.d[i] = 0.25 * static_cast<double>(__builtin_popcountll(bits(c.rng)) - 32);
    for (long i = N - 1; i >= 0; i--) {  // L' d = z
        const double* col = c.L + i * w;
        double v = c.d[i];
        const long end = i + w - 1 < N - 1 ? w - 1 : N - 1 - i;
        for (long k = 1; k <= end; k++) v -= col[k] * c.d[i + k];
        c.d[i] = v * c.inv[i];
    }
    rows_at(a, c.d, false, c.step);
    double lo = -1e300, hi = 1e300;
    cut_boxes(a, c, lo, hi);
    if (scatter) {  // a start of its own: anywhere within the caps, a few deviations away
        for (long j = 0; j < a.p; j++)
            if (c.cap[j] < __builtin_inf())
                for (long k = a.first[j]; k < a.first[j] + a.count[j]; k++) cut(c.rho[k], c.step[k], -c.cap[j], c.cap[j], lo, hi);
        lo = max2(lo, -2.0);
        hi = min2(hi, 2.0);
        advance(a, c, 0.98 * (lo + (hi - lo) * uniform01(c.rng)));
    } else {
        advance(a, c, along(a, c, lo, hi));
    }
}

// The disturbances of state j grow by lambda = exp(alpha): d is the part of the trajectory they make.
inline void scale_move(const SamplerArgs& a, Chain& c, long j, bool warm) {
    for (long i = 0; i < a.N; i++) c.d[i] = 0.0;
    for (long t = 0; t < a.T; t++)
        for (long i = a.n - 1; i >= 0; i--) {  // E is unit upper triangular
            const long k = t * a.n + i, mine = a.state[k];
            double v = i == j ? c.rho[a.place[k]] : 0.0;
            for (long e = a.start[k]; e < a.start[k + 1]; e++)
                if (a.column[e] != mine) v -= a.value[e] * c.d[a.column[e]];
            c.d[mine] = v;
        }
    rows_at(a, c.d, false, c.step);
    for (long t = 0; t < a.T; t++)
        for (long i = 0; i < a.n; i++) {  // free of rounding: the other disturbances stay as they are
            const long at = a.place[t * a.n + i];
            c.step[at] = i == j ? c.rho[at] : 0.0;
        }
    double lo = -1e300, hi = 1e300;
    cut_boxes(a, c, lo, hi);
    for (long i = 0; i < a.p; i++)
        if (c.cap[i] < __builtin_inf() && i != j)
            for (long k = a.first[i]; k < a.first[i] + a.count[i]; k++) cut(c.rho[k], c.step[k], -c.cap[i], c.cap[i], lo, hi);
    lo = lo > -1.0 ? std::log1p(lo) : -700.0;
    hi = hi < 1e300 ? std::log1p(hi) : 700.0;
    Line line{a, c, 0.0, 0.0};
    for (long k = a.first[a.p]; k < a.R; k++) {
        line.linear += a.weight[k] * c.rho[k] * c.step[k];
        line.square += a.weight[k] * c.step[k] * c.step[k];
    }
    double& width = c.width[j];
    const double alpha = sliced(line, lo, hi, width, c.rng);
    if (warm) width += 0.05 * (3.0 * (alpha < 0.0 ? -alpha : alpha) - width) + 1e-6;
    advance(a, c, std::expm1(alpha));
}

// One unknown entry: rho moves by its coefficient, and the matrix with it.
inline void entry_move(const SamplerArgs& a, Chain& c, long m) {
    for (long k = 0; k < a.R; k++) c.step[k] = 0.0;
    for (long e = a.theta_start[m]; e < a.theta_start[m + 1]; e++) {
        const long at = a.theta_at[e];
        c.step[a.place[a.theta_row[e]]] += a.theta_slope[e] * (at >= 0 ? c.x[a.column[at]] : 1.0);
    }
    const double lo = min2(a.theta_lo[m] - a.theta[m], 0.0), hi = max2(a.theta_hi[m] - a.theta[m], 0.0);
    const double alpha = along(a, c, max2(lo, -1e300), min2(hi, 1e300));
    a.theta[m] += alpha;
    for (long k = 0; k < a.R; k++) c.rho[k] += alpha * c.step[k];
    for (long e = a.theta_start[m]; e < a.theta_start[m + 1]; e++) {
        const long at = a.theta_at[e];
        if (at >= 0) a.value[at] += alpha * a.theta_slope[e];
        else a.b[a.theta_row[e]] -= alpha * a.theta_slope[e];
    }
}

inline int sampler(const SamplerArgs& a) {
    Chain c;
    double* p = a.work;
    auto take = [&](long size) {
        double* at = p;
        p += (size + 3) / 4 * 4;
        return at;
    };
    c.rho = take(a.R), c.step = take(a.R), c.edge = take(a.R);
    c.x = take(a.N), c.d = take(a.N), c.s = take(a.p), c.cap = take(a.p), c.width = take(a.n);
    c.L = take(a.N * (a.band + 1)), c.inv = take(a.N);
    c.rng = a.seed;
    for (long k = 0; k < a.R; k++) c.rho[k] = c.step[k] = 0.0, c.edge[k] = __builtin_inf();
    for (long i = 0; i < a.N; i++) c.x[i] = a.x0[i];
    for (long j = 0; j < a.n; j++) c.width[j] = 0.5;
    rows_at(a, c.x, true, c.rho);
    for (long j = 0; j < a.p; j++) {
        double top = 0.0;
        for (long k = a.first[j]; k < a.first[j + 1]; k++) top = max2(top, max2(c.rho[k], -c.rho[k]));
        c.cap[j] = max2(a.cap[j], top);
        for (long k = a.first[j]; k < a.first[j] + a.count[j]; k++) c.edge[k] = min2(max2(a.s0[j], top), c.cap[j]);
    }
    factor(a, c);
    for (long m = 0; m < a.scatter; m++) whitened_move(a, c, true);
    draw_half_widths(a, c);
    for (long sweep = 0; sweep < (a.warm + a.draws) * a.thin; sweep++) {
        const bool warm = sweep < a.warm * a.thin;
        for (long i = 0; i < a.N; i++) coordinate_move(a, c, sweep % 2 ? a.N - 1 - i : i);
        for (long k = 0; k < a.n_theta; k++) entry_move(a, c, k);
        if (sweep % 4 == 3) {
            factor(a, c);
            for (int m = 0; m < a.whitened; m++) whitened_move(a, c, false);
        }
        for (long j = 0; j < a.n; j++)
            if ((sweep + j) % a.scale_every == 0 && a.count[j] && a.floor[j] < a.cap[j]) scale_move(a, c, j, warm);
        draw_half_widths(a, c);
        if (sweep % 64 == 63) rows_at(a, c.x, true, c.rho);  // rounding does not add up
        if (warm || sweep % a.thin != a.thin - 1) continue;
        const long at = sweep / a.thin - a.warm;
        for (long i = 0; i < a.N; i++) a.out_x[at * a.N + i] = c.x[i];
        for (long m = 0; m < a.n_theta; m++) a.out_theta[at * a.n_theta + m] = a.theta[m];
        for (long j = 0; j < a.p; j++) a.out_s[at * a.p + j] = c.s[j];
        if (at > 0) continue;
        for (long j = 0; j < a.p; j++)
            if (c.cap[j] > a.cap[j] * (1.0 + 1e-9)) return 1;
    }
    return 0;
}

}  // namespace HW_ISA
}  // namespace hw
#endif
