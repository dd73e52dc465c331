// Filter for noise that is partly bounded and partly Gaussian.
//
// The state is x = m + v + b with v ~ N(0, P) and b in a set: the ellipsoid {b : b b' <= X}, the zonotope {Z' xi, |xi| <= 1},
// or both at once. Each step adds the noises to both parts; each scalar output y = c'x + v + e, v ~ N(0, r), |e| <= half,
// is folded in by the gain that is best for a weighted sum of the two parts. For a fixed a in (0, 1)
//
//     X+ = (I - K c') X/a (I - K c')' + half^2/(1-a) K K'   contains the new set for every K,
//     P+ = (I - K c') P (I - K c')' + r K K',
//     K(a) = (kappa^2 P c + X c/a) / (c'(kappa^2 P + X/a) c + kappa^2 r + half^2/(1-a))
//
// minimises kappa^2 P+ + X+ in the order of matrices, and its trace with any W is convex in a. Without sets K is the
// Kalman gain; without covariances it is that of the bounding ellipsoid. The scalar case with the gain of the sets alone
// is Hanebeck, Horn and Schmidt, eqs. (29) to (31).
#pragma once

#include "mixed_args.hpp"
#include "noise.hpp"
#include "small.hpp"

namespace hw {
namespace HW_ISA {

constexpr double mixed_least = 1e-9;   // a stays this far from 0 and 1: the set grows by as much at most
constexpr double mixed_far = 38.0;     // standard deviations beyond which a density is 0 in floating point
constexpr int mixed_halvings = 6;      // of the odds a / (1 - a), from 1e-9 to 1e9, before the slope is followed
constexpr int mixed_steps = 40;
constexpr int mixed_nodes = 33;        // first look where there may be several minima
constexpr int mixed_golden = 40;

struct MixedBuffers {
    double *F, *Ft, *out, *work;         // (n, n) each
    double *w, *Pc, *Xc, *K, *g, *row;   // (n,) each
    double *last, *root;                 // (n,): half-widths after the row before, roots of a diagonal
    double* key;                         // (capacity + ng + ny,)
    double *P, *X, *m;                   // the belief
};

// One correction: everything the cost of a needs, in numbers.
template <class N>
struct MixedRow {
    N n;
    const double *P, *X, *w, *Pc, *Xc;
    double kappa2, sp, sx, r, E;  // sp = c'Pc, sx = c'Xc, E = half^2
    double weight = 0.0;          // of the output's direction
    double tau = 0.0;             // P+ = P_kalman + tau g g', g = K (sp + r) - P c: 1/(sp + r) without truncation
    // With u = kappa^2 P c, v = X c and t = u - v c'u / c'v, which c does not see: u'Wu, u'Wv, v'Wv, v'Wt, t'Wt, and
    // tr(W (X - v v' / c'v)), the set that no gain reaches.
    double uu = 0.0, uv = 0.0, vv = 0.0, vt = 0.0, tt = 0.0, rest = 0.0;

    void prepare(const double* weights, double output) {
        w = weights;
        const double norm = kappa2 * sp + sx, share = sx > 0.0 ? kappa2 * sp / sx : 0.0;
        weight = norm > 0.0 ? output / norm : 0.0;
        uu = weight * kappa2 * sp * kappa2 * sp;
        uv = weight * kappa2 * sp * sx;
        vv = weight * sx * sx;
        double trace = weight * sx;
        vt = tt = 0.0;
        for (int i = 0; i < n; i++) {
            const double u = kappa2 * Pc[i], v = Xc[i], t = u - share * v;
            trace += w[i] * X[i * n + i];
            uu += w[i] * u * u;
            uv += w[i] * u * v;
            vv += w[i] * v * v;
            vt += w[i] * v * t;
            tt += w[i] * t * t;
        }
        rest = sx > 0.0 ? trace - vv / sx : trace;
        if (rest < 1e-14 * trace) rest = 0.0;  // rounding: the set is a segment along v
    }

    // Derivative in a of kappa^2 tr(W P+) + tr(W X+), times S^2: by the envelope theorem
    // -alpha^2 tr(W F X F') + beta^2 E K'WK with F = I - K c', alpha = 1/a, beta = 1/(1-a), and free of cancellation.
    double slope(double alpha, double beta) const {
        const double S = kappa2 * (sp + r) + alpha * sx + beta * E, left = kappa2 * r + beta * E;
        const double reached = sx > 0.0 ? (left * (left * vv / sx - 2.0 * vt) + tt * sx) : 0.0;
        return beta * beta * E * (uu + alpha * (2.0 * uv + alpha * vv)) - alpha * alpha * (rest * S * S + reached);
    }

    // K of one alpha, beta; false if nothing is left to divide by.
    bool gain(double alpha, double beta, bool set, double* K) const {
        double k2 = kappa2, S = alpha * sx + beta * E;
        if (set && S > smallest) k2 = 0.0;  // where no set is left its gain is the Kalman gain
        S += k2 * (sp + r);
        if (!(S > smallest) || !finite(S)) return false;
        const double f = 1.0 / S;
        for (int i = 0; i < n; i++) K[i] = (k2 * Pc[i] + alpha * Xc[i]) * f;
        return true;
    }

    // The criterion after the correction with K, sizes as the square roots of variances and of squared half-widths.
    double cost(double alpha, double beta, bool width, const double* c, const double* K) const {
        const double S = sp + r, ck = dot(n, c, K);
        double total = 0.0;
        for (int i = 0; i <= n; i++) {
            double p, x, weigh;
            if (i < n) {
                const double g = K[i] * S - Pc[i], k = K[i];
                p = S > 0.0 ? P[i * n + i] - Pc[i] * Pc[i] / S + tau * g * g : P[i * n + i];
                x = alpha * (X[i * n + i] - 2.0 * k * Xc[i] + k * k * sx) + beta * E * k * k;
                weigh = w[i];
            } else {
                const double g = ck * S - sp;
                p = S > 0.0 ? sp - sp * sp / S + tau * g * g : sp;
                x = alpha * (1.0 - ck) * (1.0 - ck) * sx + beta * E * ck * ck;
                weigh = weight;
            }
            p = max2(p, 0.0);
            x = max2(x, 0.0);
            total += width ? std::sqrt(weigh) * (std::sqrt(x) + std::sqrt(kappa2 * p)) : weigh * (kappa2 * p + x);
        }
        return total;
    }
};

// The a that minimises the convex criterion: the root of its slope in the odds a / (1 - a), first halved, then by regula
// falsi with the Illinois rule.
template <class N>
double mixed_convex(const MixedRow<N>& row) {
    double lo = mixed_least, hi = 1.0 / mixed_least, odds = lo;
    double at_lo = row.slope(1.0 + 1.0 / lo, 1.0 + lo), at_hi = row.slope(1.0 + 1.0 / hi, 1.0 + hi);
    if (at_lo >= 0.0) return lo;
    if (at_hi <= 0.0) return 1.0 - lo;
    for (int k = 0; k < mixed_steps; k++) {
        const double before = odds, middle = std::sqrt(lo * hi);
        odds = (lo * at_hi - hi * at_lo) / (at_hi - at_lo);
        if (k < mixed_halvings || !(odds > lo && odds < hi)) odds = middle;
        const double at = row.slope(1.0 + 1.0 / odds, 1.0 + odds);
        if (at < 0.0) {
            if (before <= lo) at_hi *= 0.5;
            lo = odds;
            at_lo = at;
        } else {
            if (before >= hi) at_lo *= 0.5;
            hi = odds;
            at_hi = at;
        }
        if (std::fabs(odds - before) <= 1e-9 * odds) break;
    }
    return odds / (1.0 + odds);
}

// The a that minimises a criterion with several minima: a grid with both ends, then golden section around the best.
template <class N>
double mixed_search(const MixedRow<N>& row, bool width, bool set, const double* c, double* K) {
    auto at = [&](double a) {
        const double alpha = 1.0 / a, beta = 1.0 / (1.0 - a);
        return row.gain(alpha, beta, set, K) ? row.cost(alpha, beta, width, c, K) : HUGE_VAL;
    };
    auto node = [](int k) {  // 0, 1/20, ..., 1, and towards both ends a node a decade
        constexpr double ends[] = {mixed_least, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2};
        return k < 7 ? ends[k] : k >= mixed_nodes - 7 ? 1.0 - ends[mixed_nodes - 1 - k] : 0.05 * (k - 6);
    };
    int best = 0;
    double least = HUGE_VAL;
    for (int k = 0; k < mixed_nodes; k++) {
        const double found = at(node(k));
        if (found < least) {
            least = found;
            best = k;
        }
    }
    constexpr double golden = 0.61803398874989485;
    double lo = node(best > 0 ? best - 1 : 0), hi = node(best < mixed_nodes - 1 ? best + 1 : best);
    double l = hi - golden * (hi - lo), r = lo + golden * (hi - lo), cl = at(l), cr = at(r);
    for (int k = 0; k < mixed_golden; k++) {
        if (cl <= cr) {
            hi = r;
            r = l;
            cr = cl;
            l = hi - golden * (hi - lo);
            cl = at(l);
        } else {
            lo = l;
            l = r;
            cl = cr;
            r = lo + golden * (hi - lo);
            cr = at(r);
        }
    }
    const double a = cl <= cr ? l : r;
    return min2(cl, cr) <= least ? a : node(best);
}

// Weights of the states, (n,): one over the squared size of each, so that units do not matter. Z counts where it is all
// there is of the set.
template <class N>
void mixed_weights(N n, double kappa2, const double* P, const double* X, const double* Z, int count, double* w) {
    for (int i = 0; i < n; i++) {
        double size = kappa2 * P[i * n + i];
        if (X) size += X[i * n + i];
        else
            for (int j = 0; j < count; j++) size += Z[j * n + i] * Z[j * n + i];
        w[i] = size > smallest && finite(size) ? 1.0 / size : 0.0;
    }
}

// Boxes the generators that are closest to an axis and smallest, so that `capacity` are left; Z (count, n) in place.
template <class N>
int mixed_reduce(N n, int capacity, int count, const double* w, double* Z, double* key, double* box) {
    if (count <= capacity) return count;
    for (int j = 0; j < count; j++) {
        double sum = 0.0, most = 0.0;
        for (int i = 0; i < n; i++) {
            const double s = std::fabs(Z[j * n + i]) * std::sqrt(w[i]);
            sum += s;
            most = max2(most, s);
        }
        key[j] = sum - most + 1e-6 * sum;  // what boxing it alone would add (Girard 2005); of equals the smallest
    }
    fill(n, 0.0, box);
    for (int away = count - (capacity - n); away > 0; away--) {
        int least = 0;
        for (int j = 1; j < count; j++)
            if (key[j] < key[least]) least = j;
        for (int i = 0; i < n; i++) box[i] += std::fabs(Z[least * n + i]);
        count--;
        key[least] = key[count];
        if (least != count) copy(n, Z + count * n, Z + least * n);
    }
    for (int i = 0; i < n; i++) {
        fill(n, 0.0, Z + count * n);
        Z[count * n + i] = box[i];
        if (box[i] > 0.0) count++;
    }
    return count;
}

// x c (n,) and c'x c, both 0 where c'x c is nothing but rounding: c sees nothing of what x holds.
template <class N>
double mixed_seen(N n, const double* x, const double* c, double* xc) {
    mul_v(n, n, x, c, xc);
    const double s = dot(n, c, xc);
    double reach = 0.0;
    for (int i = 0; i < n; i++) reach += std::fabs(c[i]) * std::sqrt(max2(x[i * n + i], 0.0));
    if (s > tiny_pivot(n) * reach * reach) return s;
    fill(n, 0.0, xc);
    return 0.0;
}

// x <- scale F x F' + s k k', symmetric (n, n), in place. An entry that is left with rounding alone is known exactly.
template <class N>
void mixed_joseph(N n, const MixedBuffers& b, double s, const double* k, double scale, double* x) {
    for (int i = 0; i < n; i++) b.root[i] = std::sqrt(max2(x[i * n + i], 0.0));
    congruence(n, n, b.F, b.Ft, x, nullptr, b.out, b.work);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) x[i * n + j] = scale * b.out[i * n + j] + s * (k[i] * k[j]);
    for (int i = 0; i < n; i++) {
        double reach = 0.0;
        for (int j = 0; j < n; j++) reach += std::fabs(b.F[i * n + j]) * b.root[j];
        if (x[i * n + i] > tiny_pivot(n) * scale * reach * reach) continue;
        for (int j = 0; j < n; j++) x[i * n + j] = x[j * n + i] = 0.0;
    }
}

template <class N>
void mixed_project(N n, const double* K, const double* c, const MixedBuffers& b) {
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            const double f = (i == j) - K[i] * c[j];
            b.F[i * n + j] = f;
            b.Ft[j * n + i] = f;
        }
}

template <class N>
void mixed_predict(N n, MixedArgs& a, const MixedBuffers& b, long t) {
    const double *A = a.A.at(t), *G = a.G.at(t);
    const bool ellipsoid = a.form != mixed_zonotope, zonotope = a.form != mixed_ellipsoid;
    const double kappa2 = a.kappa * a.kappa;
    mul_v(n, n, A, b.m, b.row);
    copy(n, b.row, b.m);
    if (a.b) axpy(n, 1.0, a.b + t * n, b.m);
    transpose(n, n, A, b.Ft);
    congruence(n, n, A, b.Ft, b.P, a.Q.at(t), b.out, b.work);
    copy(Dim<0>(n * n), b.out, b.P);
    if (ellipsoid) {
        congruence(n, n, A, b.Ft, b.X, nullptr, b.out, b.work);
        // The sum of ellipsoids of least weighted trace: (sum sqrt t_j) sum X_j / sqrt t_j.
        for (int i = 0; i < n; i++) {
            double size = kappa2 * b.P[i * n + i] + b.out[i * n + i];
            for (int j = 0; j < a.ng; j++) size += G[i * a.ng + j] * G[i * a.ng + j];
            b.w[i] = size > smallest && finite(size) ? 1.0 / size : 0.0;
        }
        double sum = 0.0, t0 = 0.0;
        for (int i = 0; i < n; i++) t0 += b.w[i] * b.out[i * n + i];
        sum += std::sqrt(max2(t0, 0.0));
        for (int j = 0; j < a.ng; j++) {
            double tj = 0.0;
            for (int i = 0; i < n; i++) tj += b.w[i] * G[i * a.ng + j] * G[i * a.ng + j];
            b.key[j] = std::sqrt(tj);
            sum += b.key[j];
        }
        const double s0 = t0 > smallest ? sum / std::sqrt(t0) : 1.0;
        for (int k = 0; k < n * n; k++) b.X[k] = s0 * b.out[k];
        for (int j = 0; j < a.ng; j++) {
            if (!(b.key[j] > 0.0)) continue;
            const double s = sum / b.key[j];
            for (int i = 0; i < n; i++)
                for (int l = 0; l < n; l++) b.X[i * n + l] += s * (G[i * a.ng + j] * G[l * a.ng + j]);
        }
    }
    if (zonotope) {
        for (int j = 0; j < a.count; j++) {
            mul_tv(n, n, b.Ft, a.Z + j * n, b.row);
            copy(n, b.row, a.Z + j * n);
        }
        for (int j = 0; j < a.ng; j++) {
            double size = 0.0;
            for (int i = 0; i < n; i++) size += std::fabs(a.Z[a.count * n + i] = G[i * a.ng + j]);
            if (size > 0.0) a.count++;
        }
    }
}

template <class N>
void mixed_correct(N n, MixedArgs& a, const MixedBuffers& b, long t, int i) {
    const double *c = a.C.at(t) + i * n, y = a.y[t * a.ny + i], r = a.r.at(t)[i], half = a.half.at(t)[i];
    const bool ellipsoid = a.form != mixed_zonotope, zonotope = a.form != mixed_ellipsoid;
    const double kappa2 = a.kappa * a.kappa;
    MixedRow<N> row{n, b.P, b.X, b.w, b.Pc, b.Xc, kappa2, 0.0, 0.0, r, half * half};
    row.sp = mixed_seen(n, b.P, c, b.Pc);
    double reach = 0.0;  // half-width of the set along c
    if (zonotope) {
        fill(n, 0.0, b.Xc);
        for (int j = 0; j < a.count; j++) {
            double s = 0.0, size = 0.0;
            for (int k = 0; k < n; k++) {
                const double part = c[k] * a.Z[j * n + k];
                s += part;
                size += std::fabs(part);
            }
            if (std::fabs(s) <= tiny_pivot(n) * size) s = 0.0;  // nothing but rounding
            b.key[j] = s;
            reach += std::fabs(s);
            axpy(n, s, a.Z + j * n, b.Xc);
        }
        row.sx = dot(n, c, b.Xc);
    }
    if (ellipsoid) {
        row.sx = mixed_seen(n, b.X, c, b.Xc);
        reach = zonotope ? min2(reach, std::sqrt(row.sx)) : std::sqrt(row.sx);
    }
    const double predicted = dot(n, c, b.m), nu = y - predicted, S = row.sp + r, B = reach + half;
    if (std::fabs(nu) > B + mixed_far * std::sqrt(S) + 1e-9 * (std::fabs(y) + std::fabs(predicted))) {
        if (a.contradicted++ == 0) a.first_contradicted = t;
    }
    // What is known of delta = y_v - c'x_v ~ N(nu, S) where the sets must meet: |delta| <= B.
    double mean = nu, variance = S;
    if (a.truncate && S > smallest) {
        const Truncated4 cut = truncated4(all4(nu), all4(S), all4(-B), all4(B));
        mean = cut.mean[0];
        variance = cut.var[0];
        row.tau = variance / (S * S);
    } else {
        row.tau = S > smallest ? 1.0 / S : 0.0;
    }
    // The scalar a: alpha = 1/a scales the state's set, beta = 1/(1-a) that of the output.
    double alpha = 1.0, beta = 1.0, chosen = std::nan("");
    if (ellipsoid) {
        double trace = 0.0;
        mixed_weights(n, kappa2, b.P, b.X, nullptr, 0, b.w);
        for (int k = 0; k < n; k++) trace += b.w[k] * b.X[k * n + k];
        if (!(trace > 0.0)) {
            chosen = 0.0;
            alpha = 0.0;
        } else if (!(row.E > 0.0)) {
            chosen = 1.0;
            beta = 0.0;
        } else {
            row.prepare(b.w, a.output);
            if (finite(a.a)) chosen = a.a;
            else if (a.criterion == mixed_trace && !a.set_gain) chosen = mixed_convex(row);
            else chosen = mixed_search(row, a.criterion == mixed_width, a.set_gain, c, b.K);
            alpha = 1.0 / chosen;
            beta = 1.0 / (1.0 - chosen);
        }
    }
    a.a_used[t * a.ny + i] = chosen;
    if (!row.gain(alpha, beta, a.set_gain, b.K)) return;  // nothing uncertain along c: the output says nothing new

    for (int k = 0; k < n; k++) {
        b.g[k] = b.K[k] * S - b.Pc[k];
        b.m[k] += b.K[k] * nu;
        if (a.truncate && S > smallest) b.m[k] += b.g[k] * ((mean - nu) / S);
    }
    mixed_project(n, b.K, c, b);
    if (ellipsoid) {
        double d = 1.0;
        if (a.shrink) {  // the sets overlap by less where the output is far off (Fogel and Huang 1982)
            const double apart = max2(0.0, std::fabs(nu) - a.kappa * std::sqrt(S)), room = alpha * row.sx + beta * row.E;
            if (apart > 0.0 && apart * apart < room) d = 1.0 - apart * apart / room;
        }
        mixed_joseph(n, b, d * beta * row.E, b.K, d * alpha, b.X);
    }
    if (zonotope) {
        for (int j = 0; j < a.count; j++) axpy(n, -b.key[j], b.K, a.Z + j * n);
        if (half > 0.0) {
            for (int k = 0; k < n; k++) a.Z[a.count * n + k] = half * b.K[k];
            a.count++;
        }
    }
    if (a.truncate && S > smallest) {  // P_kalman + tau g g'
        for (int k = 0; k < n; k++) b.row[k] = b.Pc[k] / S;
        mixed_project(n, b.row, c, b);
        mixed_joseph(n, b, r, b.row, 1.0, b.P);
        for (int k = 0; k < n; k++)
            for (int l = 0; l < n; l++) b.P[k * n + l] += row.tau * (b.g[k] * b.g[l]);
    } else {
        mixed_joseph(n, b, r, b.K, 1.0, b.P);
    }
}

// Half-widths of the set along the axes, to b.last
template <class N>
void mixed_half_widths(N n, const MixedArgs& a, const MixedBuffers& b) {
    for (int i = 0; i < n; i++) {
        double s = HUGE_VAL, z = 0.0;
        if (a.form != mixed_zonotope) s = std::sqrt(max2(b.X[i * n + i], 0.0));
        if (a.form != mixed_ellipsoid) {
            for (int j = 0; j < a.count; j++) z += std::fabs(a.Z[j * n + i]);
            s = min2(s, z);
        }
        b.last[i] = s;
    }
}

template <class N>
void mixed_scan(N n, MixedArgs& a, const MixedBuffers& b) {
    const FlushTiny tiny;
    const bool ellipsoid = a.form != mixed_zonotope, zonotope = a.form != mixed_ellipsoid;
    const Dim<0> nn(n * n);
    copy(n, a.m0, b.m);
    copy(nn, a.P0, b.P);
    copy(nn, a.X0, b.X);
    a.count = zonotope ? a.count0 : 0;
    if (zonotope) copy(Dim<0>(a.count0 * n), a.Z0, a.Z);
    a.contradicted = 0;
    a.first_contradicted = a.broken = -1;
    mixed_half_widths(n, a, b);
    for (long t = 0; t < a.T; ++t) {
        double *m = a.m + t * n, *P = a.P + t * n * n, *X = a.X + t * n * n;
        if (a.broken < 0) {
            mixed_predict(n, a, b, t);
            for (int i = 0; i < a.ny; i++) {
                if (a.seen[t * a.ny + i]) mixed_correct(n, a, b, t, i);
                else a.a_used[t * a.ny + i] = std::nan("");
            }
            if (zonotope && a.count > a.capacity) {
                mixed_weights(n, a.kappa * a.kappa, b.P, nullptr, a.Z, a.count, b.w);
                a.count = mixed_reduce(n, a.capacity, a.count, b.w, a.Z, b.key, b.row);
            }
            const bool good = all_finite(n, b.m) && all_finite(nn, b.P) && (!ellipsoid || all_finite(nn, b.X)) &&
                              (!zonotope || all_finite(Dim<0>(a.count * n), a.Z));
            if (!good) a.broken = t;
        } else {
            for (int i = 0; i < a.ny; i++) a.a_used[t * a.ny + i] = std::nan("");
        }
        if (a.broken < 0) {
            mixed_half_widths(n, a, b);
        } else if (t == a.broken) {  // from here on the last finite belief is repeated
            copy(n, t > 0 ? m - n : a.m0, b.m);
            copy(nn, t > 0 ? P - n * n : a.P0, b.P);
            copy(nn, t > 0 ? X - n * n : a.X0, b.X);
            a.count = 0;
        }
        copy(n, b.last, a.width + t * n);
        copy(n, b.m, m);
        copy(nn, b.P, P);
        copy(nn, b.X, X);
    }
}

}  // namespace HW_ISA
}  // namespace hw
