// Multipliers of the hull of a window: one primal-dual interior point, four costs side by side.
//
//     min -c'v   s.t.   |M v - b| <= h  (rows of the chain, seen ones),   |v| <= s  (boxes),
//
// The 2n programs of a window differ in their cost alone, so each lane of a vector register carries the iterates of one
// cost through the same rows (core/lanes.hpp); Newton's matrix is block-tridiagonal in time and core/chain.hpp
// eliminates it. In units of the boxes (z = v / s) and of the half-widths every row reads |rho| <= 1, with slacks
// w+ = 1 - rho, w- = 1 + rho and multipliers l+, l-:
//
//     -c + M'(l+ - l-) = 0,   w l = mu,    W = l+/w+ + l-/w-,    M'W M dz = c - M'(t+ - t-),
//     t = (sigma mu - dw dl) / w - (l / w) r,     r+ = 1 - rho - w+,  r- = 1 + rho - w-  (Mehrotra 1992).
//
// A row of next to no width is an equation rho = 0 with a free multiplier y, whose weight is a fixed number and whose
// residual vanishes as y takes it up (a proximal step): dy = W (M dz + rho), which keeps Newton's matrix well scaled.
//
// Nothing here is trusted: core/hull.hpp bounds the functional whatever y comes out.
#pragma once

#include "carver.hpp"
#include "chain.hpp"
#include "hull_types.hpp"

namespace hw {
namespace HW_ISA {

constexpr double inf = __builtin_inf();
constexpr double hull_narrow = 3e-8;  // half-width over span below which a row is an equation
constexpr double hull_stiff = 1e8;    // its weight
constexpr int hull_patience = 8;      // iterations without gain after which a lane stops

template <int N>
struct HullIpm {
    static constexpr int P = 4;
    using V = Lanes<P>;
    using I = std::ptrdiff_t;

    const HullRows& r;
    const HullSettings& set;
    Dim<N> n;
    int m, K, G;     // rows a state: n boxes, n dynamics, m outputs
    bool unit;
    // the window in units of its boxes and half-widths, shared by all costs
    double *S, *E, *A, *C, *b, *scale;  // (K+1,n), (K,n,n), (K,n,n), (K,m,n), (K+1,G), (K+1,G)
    double* share;                      // (K+1,G) half-width over what the row can span: of a narrow row a violation counts
                                        // by what it means for the states
    bool *live, *stiff;                 // (K+1,G) rows in use; those that are equations
    // per lane
    V *z, *dz, *f, *c;   // (K+1,n)
    V *w, *l, *iw, *u;   // (K+1,2G)
    V *W, *g, *d;        // (K+1,G) d = M z - b
    V *now, *best;       // (K+1,G) -y of the iterate and of the best one, 0 for boxes
    V *L, *O;            // (K+1,n,n)
    V* work;             // 4 n

    HullIpm(const HullRows& r_, const HullSettings& set_) : r(r_), set(set_), n(r_.n) {
        m = r.m;
        K = r.K;
        G = 2 * n + m;
        unit = r.E == nullptr;
    }

    void carve(Carver& k) {
        const I s = K + 1, nn = I(n) * n;
        k.many(s * n, S, z, dz, f, c);
        k.many(K * nn, E, A);
        C = k.take<double>(I(K) * m * n);
        k.many(s * G, b, scale, share, live, stiff, W, g, d, now, best);
        k.many(s * 2 * G, w, l, iw, u);
        k.many(s * nn, L, O);
        work = k.take<V>(4 * n);
    }

    // the shared numbers
    void prepare() {
        const int kinds = n + m;
        for (int t = 0; t <= K; t++)
            for (int j = 0; j < n; j++) {
                const double lo = r.v_lo[I(t) * n + j], hi = r.v_hi[I(t) * n + j];
                const bool both = finite(lo) && finite(hi);
                const double half = both ? 0.5 * hi - 0.5 * lo : 1.0;
                S[I(t) * n + j] = half > smallest ? half : smallest;
                live[I(t) * G + j] = both;
                b[I(t) * G + j] = 0.0;
                scale[I(t) * G + j] = share[I(t) * G + j] = 1.0;
            }
        for (I at = 0; at < I(K + 1) * G; at++) stiff[at] = false;
        for (int k = n; k < G; k++) live[k] = false;
        for (int t = 0; t < K; t++) {
            const I nn = I(n) * n, mn = I(m) * n;
            const double *s0 = S + I(t) * n, *s1 = s0 + n;
            const double* Er = unit ? nullptr : r.E + (r.E_t ? t * nn : 0);
            const double *Ar = r.A + (r.A_t ? t * nn : 0), *Cr = r.C + (r.C_t ? t * mn : 0);
            for (int i = 0; i < kinds; i++) {
                double lo = r.r_lo[I(t) * kinds + i], hi = r.r_hi[I(t) * kinds + i];
                const I at = I(t + 1) * G + n + i;
                double* own = i < n ? E + t * nn + i * n : C + t * mn + (i - n) * n;
                double* bef = A + t * nn + i * n;
                double reach = 0.0;
                for (int j = 0; j < n; j++) {
                    own[j] = i < n ? (Er ? Er[i * n + j] : double(i == j)) * s1[j] : Cr[(i - n) * n + j] * s1[j];
                    reach += magnitude(own[j]);
                    if (i < n) {
                        bef[j] = Ar[i * n + j] * s0[j];
                        reach += magnitude(bef[j]);
                    }
                }
                live[at] = (finite(lo) || finite(hi)) && reach > 0.0 && finite(reach);
                if (!live[at]) {
                    scale[at] = 1.0;
                    b[at] = 0.0;
                    for (int j = 0; j < n; j++) {
                        own[j] = 0.0;
                        if (i < n) bef[j] = 0.0;
                    }
                    continue;
                }
                if (!finite(lo)) lo = min2(-1.01 * reach, 1.01 * hi);  // a side without end ends where the boxes do
                if (!finite(hi)) hi = max2(1.01 * reach, 1.01 * lo);
                const double half = 0.5 * hi - 0.5 * lo;
                stiff[at] = !(half > hull_narrow * reach);
                const double h = stiff[at] ? reach : half, ih = 1.0 / h;
                scale[at] = h;
                share[at] = min2(1.0, h / reach);
                b[at] = (0.5 * hi + 0.5 * lo) * ih;
                for (int j = 0; j < n; j++) {
                    own[j] *= ih;
                    if (i < n) bef[j] *= ih;
                }
            }
        }
    }

    // rho of row i of state t from x: boxes, dynamics, outputs
    inline V rho(const V* x, int t, int i) const {
        const V* own = x + I(t) * n;
        if (i < n) return own[i];
        V s = V(0.0);
        if (i < 2 * n) {
            const int k = i - n;
            const double *Ei = E + (I(t - 1) * n + k) * n, *Ai = A + (I(t - 1) * n + k) * n;
            const V* bef = own - int(n);
            if (unit) s = V(Ei[k]) * own[k];
            else
                for (int j = k; j < n; j++) s += V(Ei[j]) * own[j];
            for (int j = 0; j < n; j++) s -= V(Ai[j]) * bef[j];
            return s;
        }
        const double* Ci = C + (I(t - 1) * m + i - 2 * n) * n;
        for (int j = 0; j < n; j++) s += V(Ci[j]) * own[j];
        return s;
    }

    // c + M'v at state t
    inline void adjoint(int t, const V* v, V* out) const {
        const V* gt = v + I(t) * G;
        for (int j = 0; j < n; j++) out[j] = c[I(t) * n + j] + gt[j];
        if (t > 0) {
            const double *Et = E + I(t - 1) * n * n, *Ct = C + I(t - 1) * m * n;
            for (int i = 0; i < n; i++) {
                if (unit) out[i] += V(Et[i * n + i]) * gt[n + i];
                else
                    for (int j = i; j < n; j++) out[j] += V(Et[i * n + j]) * gt[n + i];
            }
            for (int i = 0; i < m; i++) {
                if (!live[I(t) * G + 2 * n + i]) continue;
                for (int j = 0; j < n; j++) out[j] += V(Ct[i * n + j]) * gt[2 * n + i];
            }
        }
        if (t < K) {
            const double* At = A + I(t) * n * n;
            const V* next = gt + G;
            for (int i = 0; i < n; i++)
                for (int j = 0; j < n; j++) out[j] -= V(At[i * n + j]) * next[n + i];
        }
    }

    // M_t and O_t of Newton's matrix from W
    inline void assemble(int t) {
        const I nn = I(n) * n;
        V *M = L + t * nn, *Ot = O + t * nn;
        const V* Wt = W + I(t) * G;
        for (int i = 0; i < n; i++)
            for (int j = 0; j <= i; j++) M[i * n + j] = i == j ? Wt[i] : V(0.0);
        if (t > 0) {
            const double *Et = E + (t - 1) * nn, *At = A + (t - 1) * nn, *Ct = C + I(t - 1) * m * n;
            if (unit) {
                for (int i = 0; i < n; i++) {
                    const V We = Wt[n + i] * V(Et[i * n + i]);
                    M[i * n + i] += We * V(Et[i * n + i]);
                    for (int j = 0; j < n; j++) Ot[i * n + j] = -(We * V(At[i * n + j]));
                }
            } else {
                for (int i = 0; i < n; i++)
                    for (int j = 0; j < n; j++) Ot[i * n + j] = V(0.0);
                for (int k = 0; k < n; k++)
                    for (int i = k; i < n; i++) {
                        const V We = Wt[n + k] * V(Et[k * n + i]);
                        for (int j = k; j <= i; j++) M[i * n + j] += We * V(Et[k * n + j]);
                        for (int j = 0; j < n; j++) Ot[i * n + j] -= We * V(At[k * n + j]);
                    }
            }
            for (int k = 0; k < m; k++) {
                if (!live[I(t) * G + 2 * n + k]) continue;
                for (int i = 0; i < n; i++) {
                    const V Wc = Wt[2 * n + k] * V(Ct[k * n + i]);
                    for (int j = 0; j <= i; j++) M[i * n + j] += Wc * V(Ct[k * n + j]);
                }
            }
        }
        if (t < K) {
            const double* At = A + t * nn;
            const V* Wn = Wt + G + n;
            for (int k = 0; k < n; k++)
                for (int i = 0; i < n; i++) {
                    const V Wa = Wn[k] * V(At[k * n + i]);
                    for (int j = 0; j <= i; j++) M[i * n + j] += Wa * V(At[k * n + j]);
                }
        }
    }

    inline void forward(bool factor) {
        const I nn = I(n) * n;
        for (int t = 0; t <= K; t++) {
            V *M = L + t * nn, *ft = f + I(t) * n;
            adjoint(t, g, ft);
            if (factor) {
                assemble(t);
                if (t > 0) chain_link(n, 0, O + t * nn, M - nn, static_cast<const V*>(nullptr), M, static_cast<V*>(nullptr), work);
                chain_close(n, 0, M, static_cast<V*>(nullptr), static_cast<V*>(nullptr), 1e-15, work);
            }
            if (t > 0) chain_link_rhs(n, O + t * nn, ft - int(n), ft);
            chain_close_rhs(n, 0, M, static_cast<const V*>(nullptr), ft, static_cast<V*>(nullptr), work);
        }
    }

    inline void backward() {
        const I nn = I(n) * n;
        for (int t = K; t >= 0; t--)
            chain_back(n, 0, L + t * nn, static_cast<const V*>(nullptr), f + I(t) * n, static_cast<const V*>(nullptr),
                       t < K ? O + (t + 1) * nn : nullptr, t < K ? dz + I(t + 1) * n : nullptr, dz + I(t) * n);
    }

    // Four costs (n each, at states k): y (K, n+m) each, the largest objective of a point that obeys the rows (minus
    // infinity if none was found), its distance from the bound that y gives; returns the iterations taken.
    int solve(const double* const* cost, const int* k, int costs, double* const* y, double* value, double* gap) {
        const int kinds = n + m;
        double unit_of[P];
        for (I i = 0; i < I(K + 1) * n; i++) c[i] = V(0.0), z[i] = V(0.0);
        for (int p = 0; p < P; p++) {
            const int q = p < costs ? p : costs - 1;  // idle lanes repeat the last cost
            double size = 0.0;
            for (int j = 0; j < n; j++) size += magnitude(cost[q][j]) * S[I(k[q]) * n + j];
            unit_of[p] = size > 0.0 && finite(size) ? size : 1.0;
            for (int j = 0; j < n; j++) c[I(k[q]) * n + j].set(p, cost[q][j] * S[I(k[q]) * n + j] / unit_of[p]);
        }
        int pairs = 0;
        for (I at = 0; at < I(K + 1) * G; at++) {
            const double most = min2(1.0, 10.0 * share[at]);
            W[at] = V(!live[at] ? 0.0 : stiff[at] ? 1e6 : most * most);
            g[at] = live[at] ? W[at] * V(b[at]) : V(0.0);
            pairs += live[at] && !stiff[at];
        }
        // start: least squares of all rows, without the cost
        for (I i = 0; i < I(K + 1) * n; i++) f[i] = V(0.0);
        {
            V* keep = c;
            c = dz;  // zeros for the moment
            for (I i = 0; i < I(K + 1) * n; i++) dz[i] = V(0.0);
            forward(true);
            c = keep;
        }
        backward();
        for (I i = 0; i < I(K + 1) * n; i++) z[i] = dz[i];
        const double first = 1.0;
        for (int t = 0; t <= K; t++)
            for (int i = 0; i < G; i++) {
                const I at = I(t) * G + i;
                if (!live[at]) {
                    W[at] = g[at] = V(0.0);
                    continue;
                }
                d[at] = rho(z, t, i) - V(b[at]);
                if (stiff[at]) {
                    l[2 * at] = V(0.0);
                    continue;
                }
                w[2 * at] = larger(V(1.0) - d[at], V(0.5));
                w[2 * at + 1] = larger(V(1.0) + d[at], V(0.5));
                l[2 * at] = V(first / pairs) / w[2 * at];
                l[2 * at + 1] = V(first / pairs) / w[2 * at + 1];
            }
        // the least bound so far, and the largest objective of a point that obeys the rows
        V moving = V(1.0), low = V(inf), high = V(-inf);
        for (I at = 0; at < I(K + 1) * G; at++) best[at] = V(0.0);
        int iter = 0, since[P] = {0};
        double least[P] = {inf, inf, inf, inf};  // complementarity so far
        V mu_sum = V(0.0);
        for (; iter < set.max_iter; iter++) {
            // rows: weights, residuals, complementarity, and the bound that these multipliers give
            mu_sum = V(0.0);
            V pres = V(0.0), bound = V(0.0), value_now = V(0.0);
            for (int t = 0; t <= K; t++)
                for (int i = 0; i < G; i++) {
                    const I at = I(t) * G + i;
                    if (!live[at]) {
                        now[at] = V(0.0);
                        continue;
                    }
                    if (stiff[at]) {
                        now[at] = -l[2 * at];
                        bound += V(b[at]) * l[2 * at];
                        W[at] = V(hull_stiff);
                        g[at] = -(l[2 * at] + V(hull_stiff) * d[at]);
                        pres = larger(pres, magnitude(d[at]));
                        continue;
                    }
                    const V wp = w[2 * at], wm = w[2 * at + 1], lp = l[2 * at], lm = l[2 * at + 1];
                    const V ip = V(1.0) / wp, im = V(1.0) / wm;
                    const V dp = lp * ip, dm = lm * im, rp = V(1.0) - d[at] - wp, rm = V(1.0) + d[at] - wm;
                    iw[2 * at] = ip;
                    iw[2 * at + 1] = im;
                    W[at] = dp + dm;
                    g[at] = dp * rp - dm * rm;
                    mu_sum += wp * lp + wm * lm;
                    pres = larger(pres, larger(V(0.0), magnitude(d[at]) - V(1.0)) * V(share[at]));
                    now[at] = i < n ? V(0.0) : lm - lp;
                    bound += magnitude(now[at]) - V(b[at]) * now[at];
                }
            for (int t = 0; t <= K; t++) {
                V* left = work;
                adjoint(t, now, left);
                for (int j = 0; j < n; j++) {
                    bound += magnitude(left[j]);
                    value_now += c[I(t) * n + j] * z[I(t) * n + j];
                }
            }
            V better = V(-1.0);
            bool done = true;
            for (int p = 0; p < P; p++) {
                if (moving[p] == 0.0) continue;
                const double gap_was = low[p] - high[p];
                if (bound[p] < low[p]) {
                    better.set(p, 1.0);
                    low.set(p, bound[p]);
                }
                if (pres[p] <= 1e-8 && value_now[p] > high[p]) high.set(p, value_now[p]);
                const bool gains = low[p] - high[p] < 0.9 * gap_was || !finite(gap_was) || mu_sum[p] < 0.9 * least[p];
                since[p] = gains ? 0 : since[p] + 1;
                least[p] = min2(least[p], mu_sum[p]);
                if (low[p] - high[p] <= set.tol || since[p] > hull_patience || !finite(bound[p])) moving.set(p, 0.0);
                done = done && moving[p] == 0.0;
            }
            for (I at = 0; at < I(K + 1) * G; at++) best[at] = where_positive(better, now[at], best[at]);
            if (done) break;
            forward(true);
            backward();
            // affine direction: how far it goes, and what complementarity is left there
            V up_ = V(1e-30), ud = V(1e-30), s1 = V(0.0), s2 = V(0.0), s3 = V(0.0);
            for (int t = 0; t <= K; t++)
                for (int i = 0; i < G; i++) {
                    const I at = I(t) * G + i;
                    if (!live[at] || stiff[at]) continue;
                    const V dd = rho(dz, t, i), rest[2] = {V(1.0) - d[at] - dd, V(1.0) + d[at] + dd};
                    for (int side = 0; side < 2; side++) {
                        const V wk = w[2 * at + side], step = rest[side] - wk;
                        const V uk = step * iw[2 * at + side], vk = -V(1.0) - uk, p = wk * l[2 * at + side];
                        u[2 * at + side] = uk;
                        up_ = larger(up_, -uk);
                        ud = larger(ud, -vk);
                        s1 += p * uk;
                        s2 += p * vk;
                        s3 += p * uk * vk;
                    }
                }
            V target;
            for (int p = 0; p < P; p++) {
                const double ap = up_[p] > 1.0 ? 1.0 / up_[p] : 1.0, ad = ud[p] > 1.0 ? 1.0 / ud[p] : 1.0;
                const double after = mu_sum[p] + ap * s1[p] + ad * s2[p] + ap * ad * s3[p];
                const double ratio = mu_sum[p] > 0.0 ? max2(after, 0.0) / mu_sum[p] : 0.0;
                target.set(p, ratio * ratio * ratio * mu_sum[p] / (2.0 * pairs));
            }
            for (int t = 0; t <= K; t++)
                for (int i = 0; i < G; i++) {
                    const I at = I(t) * G + i;
                    if (!live[at] || stiff[at]) continue;
                    const V up0 = u[2 * at], um0 = u[2 * at + 1];
                    // (sigma mu - dw dl) / w = sigma mu / w - u v l, v = -1 - u
                    const V tp = target * iw[2 * at] + up0 * (V(1.0) + up0) * l[2 * at];
                    const V tm = target * iw[2 * at + 1] + um0 * (V(1.0) + um0) * l[2 * at + 1];
                    u[2 * at] = tp;
                    u[2 * at + 1] = tm;
                    g[at] = g[at] - tp + tm;
                }
            forward(false);
            backward();
            up_ = V(1e-30);
            ud = V(1e-30);
            for (int t = 0; t <= K; t++)
                for (int i = 0; i < G; i++) {
                    const I at = I(t) * G + i;
                    if (!live[at]) continue;
                    if (stiff[at]) {
                        W[at] = rho(dz, t, i);
                        u[2 * at] = V(hull_stiff) * (W[at] + d[at]);
                        continue;
                    }
                    const V dd = rho(dz, t, i), rest[2] = {V(1.0) - d[at] - dd, V(1.0) + d[at] + dd};
                    for (int side = 0; side < 2; side++) {
                        const V wk = w[2 * at + side], lk = l[2 * at + side];
                        const V dw = rest[side] - wk;
                        const V dl = u[2 * at + side] - lk - lk * iw[2 * at + side] * dw;
                        up_ = larger(up_, -(dw * iw[2 * at + side]));
                        ud = larger(ud, -(dl / lk));
                        u[2 * at + side] = dl;
                        iw[2 * at + side] = dw;
                    }
                    W[at] = dd;
                }
            V ap, ad;
            for (int p = 0; p < P; p++) {
                const double keep = max2(0.995, 1.0 - mu_sum[p]);
                const double a = keep / up_[p] < 1.0 ? keep / up_[p] : 1.0, q = keep / ud[p] < 1.0 ? keep / ud[p] : 1.0;
                const bool fine = moving[p] > 0.0 && finite(a) && finite(q);
                ap.set(p, fine ? a : 0.0);
                ad.set(p, fine ? q : 0.0);
                if (!fine) moving.set(p, 0.0);
            }
            for (I i = 0; i < I(K + 1) * n; i++) z[i] += where_positive(ap, ap * dz[i], V(0.0));
            for (I at = 0; at < I(K + 1) * G; at++) {
                if (!live[at]) continue;
                d[at] += where_positive(ap, ap * W[at], V(0.0));
                if (stiff[at]) {
                    l[2 * at] += where_positive(ad, ad * u[2 * at], V(0.0));
                    continue;
                }
                for (int side = 0; side < 2; side++) {
                    w[2 * at + side] += where_positive(ap, ap * iw[2 * at + side], V(0.0));
                    l[2 * at + side] += where_positive(ad, ad * u[2 * at + side], V(0.0));
                }
            }
        }
        for (int p = 0; p < costs; p++) {
            double middle = 0.0;
            for (int j = 0; j < n; j++) middle += cost[p][j] * r.mid[I(k[p]) * n + j];
            value[p] = middle + unit_of[p] * high[p];
            gap[p] = low[p] - high[p];
            for (int t = 0; t < K; t++)
                for (int i = 0; i < kinds; i++) {
                    const I at = I(t + 1) * G + n + i;
                    y[p][I(t) * kinds + i] = live[at] ? -best[at][p] * unit_of[p] / scale[at] : 0.0;
                }
        }
        return iter;
    }
};

}  // namespace HW_ISA
}  // namespace hw
