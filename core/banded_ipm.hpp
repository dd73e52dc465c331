// The linear program of bounded noise, solved along its structure by a primal-dual interior point.
//
//     min c's   over states x_0..x_T (n), parameters theta (p0), half-widths s (ns)
//     s.t.      |rho_k| <= h_j s_g(j) [+ e_k]       for every seen row k, of kind j
//               rho = E x_k - A x_{k-1} + Gx theta - bx     (n rows, k = 1..T)
//               rho = C x_k             + Gy theta - by     (m rows, k = 1..T, missing ones dropped)
//               boxes on x, theta, s;  slack e_k >= 0 at a cost, where asked for
//
// after Pavelkova (2011), eq. (16), and Pavelkova & Karny (2013), eq. (22). Each row is a pair w+ = s - rho >= 0 with
// multiplier l+, w- = s + rho >= 0 with l-. With d = l / w, W = d+ + d-, S = d- - d+, Newton's matrix is a
// block-tridiagonal chain in x (sum W a a'), with dense border columns for theta (sum W a g) and s (sum S a) and the
// corner K; core/chain.hpp eliminates it in O(T (n^3 + n^2 p + n p^2)).
//
// The chain is cut into P stretches that run side by side in the lanes of a vector register (core/lanes.hpp). State k
// lives in lane k / H at place k % H; the last state of a stretch is a separator: it is the left border of the next
// stretch, and the P separators form a short chain of their own, solved in plain doubles.
//
// One iteration (Mehrotra's predictor and corrector, the corrector shortened where the affine step is: Colombo and
// Gondzio, 2008) is five sweeps: forwards to take the last step and measure; forwards to assemble and factor; backwards
// for the affine direction, whose right-hand side is only -c; forwards for the corrected right-hand side; backwards for
// the direction. Rows stay feasible by construction (s can always grow), so only caps on s carry a
// primal residual. Directions are kept relative, u = dw / w and v = dl / l: a step is w (1 + alpha u).
//
// Units: row k of kind j is multiplied by kappa_j = c_g / h_j, columns of x and theta are divided by their norms, and
// after the least-squares start everything is measured from it, in units S of its largest residual.
#pragma once

#include "carver.hpp"
#include "chain.hpp"
#include "lp_types.hpp"

namespace hw {
namespace HW_ISA {

constexpr double lp_inf = 1e300;     // bounds at or beyond this are absent
constexpr double lp_warm_gap = 0.1;  // relative gap of the iterate that the next window starts from
constexpr double lp_pinned = 1e100;  // added to the diagonal of a variable that must not move

// The sizes that are compiled for: n alone (0: not even that), or all of a plain program, which has no theta, no E, no
// slacks and a half-width of its own for every kind of row; boxes on its states or none.
template <int N, int Y, bool Boxed>
struct Shape {
    static constexpr int m = Y, rows = N + Y, p0 = 0, ns = N + Y, p = N + Y;
    static constexpr bool soft = false, unit_E = true, boxed = Boxed;
    static constexpr int G = rows + (Boxed ? N : 0);      // pairs a state: rows, then boxes
    static constexpr std::ptrdiff_t pw = 2 * G;           // pair entries a state: 2 G, then a slack a row
    static constexpr std::ptrdiff_t zq = N * (N + p);     // entries of Z a state
    explicit Shape(const LpProblem&) {}
    static int kind(int j) { return j; }
    static bool fits(const LpProblem& lp) {
        bool own = lp.ns == N + Y;
        for (int j = 0; own && j < N + Y; j++) own = lp.group[j] == j;
        return own && lp.n == N && lp.m == Y && lp.p0 == 0 && !lp.E && !lp.slack && Boxed == (lp.lo || lp.x0_lo);
    }
};
template <int N>
struct Shape<N, 0, false> {
    const int m, rows, p0, ns, p;  // p = p0 + ns border columns
    const bool soft, unit_E, boxed;
    const int G;
    const std::ptrdiff_t pw, zq;
    const int* const group;
    explicit Shape(const LpProblem& lp)
        : m(lp.m), rows(lp.n + lp.m), p0(lp.p0), ns(lp.ns), p(lp.p0 + lp.ns), soft(lp.slack), unit_E(!lp.E),
          boxed(lp.lo || lp.x0_lo), G(rows + (boxed ? lp.n : 0)), pw(2 * G + (soft ? rows : 0)),
          zq(std::ptrdiff_t(lp.n) * (lp.n + p)), group(lp.group) {}
    int kind(int j) const { return group[j]; }
};

template <int P, int N, int Y = 0, bool Boxed = false>
struct BandedIpm : Shape<N, Y, Boxed> {
    using V = Lanes<P>;
    using I = std::ptrdiff_t;
    using Size = Shape<N, Y, Boxed>;
    using Size::m, Size::rows, Size::p0, Size::ns, Size::p, Size::soft, Size::unit_E, Size::boxed, Size::G, Size::pw,
        Size::zq, Size::kind;
    const LpProblem& lp;
    const LpSettings& set;
    Dim<N> n;
    const int H;
    bool capped;

    // the problem in scaled units, lane by lane; a stride of 0 marks a constant matrix
    V *E, *Ed, *A, *C, *Gt, *b, *base, *xlo, *xhi;
    I dE, dA, dC;
    // iterate, directions, the reference that b is relative to, the best iterate so far
    V *x, *w, *l, *u, *v, *dx, *px, *xref, *xbest, *lbest, *wbest, *xwarm, *lwarm;
    V* inv;  // 1 / (w l), and 0 where there is no row: whatever is multiplied by it leaves such a pair out
    // factor and right-hand side
    V *L, *O, *Z, *f, *Q, *K, *acc, *zacc;
    // one state's worth of scratch
    V *W, *Sg, *Ws, *nu, *rho, *own, *bef, *bef0, *back, *back0, *Bb, *Bb0, *wk, *dres, *lz, *left, *dzv;
    // the dense end: z = (theta, s), its bounds as pairs, its Schur complement, the chain of separators
    double *sx, *kappa, *cz, *sz, *z, *dz, *zref, *kz, *zbest, *zlo, *zhi, *zw, *zl, *zu, *zv, *ze, *zrp, *zinv, *zlbest, *zwarm, *zlwarm;
    double *Kd, *KL, *Kpiv, *Kinv, *Korig, *zcg, *pz, *rM, *rO, *rZ, *rQ, *rf, *rx, *racc, *rw, *hmax, *count;
    double S, reg, drop, mu_pairs, rounding;  // what the largest state leaves of a residual, in units S
    double objective, comp, dinf, pinf, dual;  // of the current iterate, set by `assemble`

    BandedIpm(const LpProblem& lp_, const LpSettings& set_)
        : Size(lp_), lp(lp_), set(set_), n(lp_.n), H((lp_.T + P) / P) {
        dE = lp.E_t ? n * n : 0;
        dA = lp.A_t ? n * n : 0;
        dC = lp.C_t ? m * n : 0;
        S = 1.0;
        drop = 1e-15;
    }

    void carve(Carver& c) {
        const I h = H, nn = I(n) * n;
        E = unit_E ? nullptr : c.take<V>(dE ? h * nn : nn);
        Ed = c.take<V>(n);  // E's diagonal, scaled
        A = c.take<V>(dA ? h * nn : nn);
        C = c.take<V>((dC ? h : 1) * m * n);
        Gt = c.take<V>(h * rows * p0);
        b = c.take<V>(h * rows);
        base = c.take<V>(h * n);
        xlo = c.take<V>(boxed ? h * n : 0);
        xhi = c.take<V>(boxed ? h * n : 0);
        c.many(h * n, x, dx, xref, xbest, f, px);
        c.many(h * pw, w, l, u, v, inv, lbest);
        wbest = c.take<V>(soft ? h * pw : 0);
        xwarm = c.take<V>(set.warm ? h * n : 0);
        lwarm = c.take<V>(set.warm ? h * pw : 0);
        L = c.take<V>(h * nn);
        O = c.take<V>(h * nn);
        Z = c.take<V>(h * zq);
        Q = c.take<V>(tri(n + p, 0));
        K = c.take<V>(I(p) * p);
        c.many(n + p, acc, lz);
        c.many(p, zacc, dzv);
        c.many(G, W, Sg, Ws, nu, rho);
        c.many(n, own, bef, bef0, dres, left);
        c.many(nn, back, back0);
        c.many(I(n) * p, Bb, Bb0);
        wk = c.take<V>(2 * n);
        sx = c.take<double>(n);
        c.many(rows, kappa, hmax, count);
        c.many(p, cz, sz, z, dz, zref, kz, zbest, zlo, zhi, Kpiv, Kinv, racc, Korig, zcg, pz, zwarm);
        c.many(2 * p, zw, zl, zu, zv, ze, zrp, zinv, zlbest, zlwarm);
        c.many(I(p) * p, Kd, KL);
        c.many(P * nn, rM, rO);
        rZ = c.take<double>(I(P) * n * p);
        rQ = c.take<double>(tri(p, 0) + 1);
        c.many(I(P) * n, rf, rx);
        rw = c.take<double>(n);
    }

    // ---- rows -----------------------------------------------------------------------------------------------------

    // rho (G) = a'x + g'theta of every pair at place i, from x_i, x_{i-1} and theta (p0 lanes, or null for none)
    inline void apply(I i, const V* xi, const V* xb, const V* th, V* out) const {
        const V *Ei = unit_E ? nullptr : E + i * dE, *Ai = A + i * dA, *Ci = C + i * dC;
        for (int j = 0; j < n; j++) {
            V s = Ed[j] * xi[j];
            if (!unit_E)
                for (int k = j + 1; k < n; k++) s += Ei[j * n + k] * xi[k];
            for (int k = 0; k < n; k++) s -= Ai[j * n + k] * xb[k];
            out[j] = s;
        }
        for (int j = 0; j < m; j++) {
            V s = V(0.0);
            for (int k = 0; k < n; k++) s += Ci[j * n + k] * xi[k];
            out[n + j] = s;
        }
        if (th)
            for (int j = 0; j < rows; j++) {
                V s = out[j];
                for (int c = 0; c < p0; c++) s += Gt[(i * rows + j) * p0 + c] * th[c];
                out[j] = s;
            }
        if (boxed)
            for (int k = 0; k < n; k++) out[rows + k] = xi[k];
    }

    // the transpose: own (n) = sum a nu over place i on x_i, bef (n) on x_{i-1}, zacc[theta] -= g nu
    inline void adjoint(I i, const V* nu_, V* own_, V* bef_, bool theta) {
        const V *Ei = unit_E ? nullptr : E + i * dE, *Ai = A + i * dA, *Ci = C + i * dC;
        for (int k = 0; k < n; k++) {
            V s = Ed[k] * nu_[k], t = V(0.0);
            if (!unit_E)
                for (int j = 0; j < k; j++) s += Ei[j * n + k] * nu_[j];
            for (int j = 0; j < n; j++) t -= Ai[j * n + k] * nu_[j];
            for (int j = 0; j < m; j++) s += Ci[j * n + k] * nu_[n + j];
            if (boxed) s += nu_[rows + k];
            own_[k] = s;
            bef_[k] = t;
        }
        if (theta)
            for (int j = 0; j < rows; j++)
                for (int c = 0; c < p0; c++) zacc[c] -= Gt[(i * rows + j) * p0 + c] * nu_[j];
    }

    // weights of row or box j at place i: W on (rho,rho), Sj on (rho,s), Wsj on (s,s); a slack is eliminated here
    inline void weigh(I i, int j, V& Wj, V& Sj, V& Wsj) const {
        V Wd, Sd, de;
        slopes(i, j, Wd, Sd, de);
        Wj = Wsj = Wd;
        Sj = Sd;
        if (soft && j < rows) {
            const V over = V(1.0) / larger(Wd + de, V(1e-300));
            Wj = Wd - Sd * Sd * over;
            Sj = Sd * de * over;
            Wsj = Wd * de * over;
        }
    }

    // d = l / w of a pair, as sum and difference, and of its slack
    inline void slopes(I i, int j, V& Wd, V& Sd, V& de) const {
        const V dp = slope(i * pw + 2 * j), dm = slope(i * pw + 2 * j + 1);
        Wd = dp + dm;
        Sd = dm - dp;
        de = soft && j < rows ? slope(i * pw + 2 * G + j) : V(0.0);
    }
    inline V slope(I k) const { return l[k] * (l[k] * inv[k]); }

    // ---- forward: assemble and factor -----------------------------------------------------------------------------

    // Take the step (ap, ad) along (u, v) and measure the new iterate.
    void advance(double ap, double ad, bool step) {
        for (int c = 0; c < p; c++) zacc[c] = V(0.0);
        V gap_sum(0.0), res_sum(0.0), dual_sum(0.0), slack_sum(0.0);
        const V a_p(ap), a_d(ad);
        for (I i = 0; i < H; i++) {
            V *wi = w + i * pw, *li = l + i * pw, *xi = x + i * n;
            if (step) {
                const V *ui = u + i * pw, *vi = v + i * pw;
                for (I k = 0; k < pw; k++) {
                    wi[k] *= V(1.0) + a_p * ui[k];
                    li[k] *= V(1.0) + a_d * vi[k];
                }
                for (int k = 0; k < n; k++) xi[k] += a_p * dx[i * n + k];
            }
            for (I k = 0; k < pw; k++) gap_sum += wi[k] * li[k];
            for (int j = 0; j < G; j++) nu[j] = li[2 * j] - li[2 * j + 1];
            adjoint(i, nu, own, bef, true);
            if (i > 0) res_sum += residual_of(i - 1, bef);
            else for (int k = 0; k < n; k++) bef0[k] = bef[k];
            for (int k = 0; k < n; k++) dres[k] = own[k];
            for (int j = 0; j < rows; j++) zacc[p0 + kind(j)] += li[2 * j] + li[2 * j + 1];
            if (capped) {
                for (int j = 0; j < rows; j++) dual_sum -= b[i * rows + j] * nu[j];
                if (boxed)
                    for (int k = 0; k < n; k++) {
                        const int j = 2 * (rows + k);  // bounds are x + w+ above and x - w- below
                        dual_sum += li[j + 1] * (xi[k] - wi[j + 1]) - li[j] * (xi[k] + wi[j]);
                    }
            }
            if (soft)
                for (int j = 0; j < rows; j++)
                    slack_sum += where_positive(li[2 * G + j], V(lp.slack[j] / kappa[j]) * wi[2 * G + j], V(0.0));
        }
        for (int k = 0; k < n; k++) bef[k] = from_after(bef0[k]);
        res_sum += residual_of(H - 1, bef);
        measure_dense(sum_lanes(gap_sum), sum_lanes(res_sum), sum_lanes(dual_sum), sum_lanes(slack_sum));
    }

    inline void invert(I i) {
        for (I k = i * pw; k < (i + 1) * pw; k++) {
            const V product = w[k] * l[k];
            inv[k] = where_positive(product - V(1e-290), V(1.0) / product, V(0.0));
        }
    }

    // Newton's matrix at the iterate, factored.
    void assemble() {
        const I nn = I(n) * n;
        const int q = n + p;
        for (int c = 0; c < tri(q, 0); c++) Q[c] = V(0.0);
        for (int c = 0; c < p * p; c++) K[c] = V(0.0);
        invert(0);
        for (I i = 0; i < H; i++) {
            if (i + 1 < H) invert(i + 1);  // ahead of its use: divisions are slow, and nothing here waits for these
            for (int j = 0; j < G; j++) weigh(i, j, W[j], Sg[j], Ws[j]);
            blocks(i);
            if (i > 0) {
                V *Lb = L + (i - 1) * nn, *Zb = Z + (i - 1) * zq;
                add_lower(back, Lb);
                for (int k = 0; k < n * p; k++) Zb[nn + k] += Bb[k];
                chain_close(n, q, Lb, Zb, Q, drop, wk);
                chain_link(n, q, O + i * nn, Lb, Zb, L + i * nn, Z + i * zq, wk);
            } else {
                for (int k = 0; k < nn; k++) back0[k] = back[k];
                for (int k = 0; k < n * p; k++) Bb0[k] = Bb[k];
            }
        }
        separators();
    }

    inline V residual_of(I i, const V* after) const {
        V s(0.0);
        for (int k = 0; k < n; k++) {
            const V r = magnitude(dres[k] + after[k]) * (V(1.0) + magnitude(x[i * n + k]));
            s += where_positive(V(0.5) - base[i * n + k], r, V(0.0));
        }
        return s;
    }

    inline void add_lower(const V* a, V* M) const {
        for (int r = 0; r < n; r++)
            for (int c = 0; c <= r; c++) M[r * n + c] += a[r * n + c];
    }

    // Newton's blocks at place i: M into L, coupling into O, border into Z; back, Bb are what its rows add at i - 1.
    inline void blocks(I i) {
        const I nn = I(n) * n;
        const V *Ei = unit_E ? nullptr : E + i * dE, *Ai = A + i * dA, *Ci = C + i * dC, *g = Gt + i * rows * p0;
        V *M = L + i * nn, *Oi = O + i * nn, *Zi = Z + i * zq, *B = Zi + nn;
        for (int r = 0; r < n; r++)
            for (int c = 0; c <= r; c++) {
                V s = r == c ? base[i * n + r] + V(reg) : V(0.0), t(0.0);
                if (unit_E) {
                    if (r == c) s += W[r] * Ed[r] * Ed[r];
                } else {
                    for (int j = 0; j <= c; j++) s += W[j] * Ei[j * n + r] * Ei[j * n + c];
                }
                for (int j = 0; j < m; j++) s += W[n + j] * Ci[j * n + r] * Ci[j * n + c];
                if (boxed && r == c) s += W[rows + r];
                for (int j = 0; j < n; j++) t += W[j] * Ai[j * n + r] * Ai[j * n + c];
                M[r * n + c] = s;
                back[r * n + c] = t;
            }
        for (int r = 0; r < n; r++)
            for (int c = 0; c < n; c++) {
                V s(0.0);
                if (unit_E) s -= Ed[r] * W[r] * Ai[r * n + c];
                else
                    for (int j = 0; j <= r; j++) s -= Ei[j * n + r] * W[j] * Ai[j * n + c];
                Oi[r * n + c] = s;
                Zi[c * n + r] = i == 0 ? s : V(0.0);
            }
        for (int k = 0; k < n * p; k++) B[k] = Bb[k] = V(0.0);
        for (int c = 0; c < p0; c++)
            for (int j = 0; j < rows; j++) {
                const V wg = W[j] * g[j * p0 + c];
                for (int k = 0; k < n; k++) {
                    if (j >= n) B[c * n + k] += Ci[(j - n) * n + k] * wg;
                    else if (unit_E) B[c * n + k] += j == k ? Ed[k] * wg : V(0.0);
                    else B[c * n + k] += Ei[j * n + k] * wg;
                    if (j < n) Bb[c * n + k] -= Ai[j * n + k] * wg;
                }
                for (int d = 0; d <= c; d++) K[c * p + d] += wg * g[j * p0 + d];
            }
        for (int j = 0; j < n; j++) {
            const int s = p0 + kind(j);
            for (int k = 0; k < n; k++) {
                if (unit_E) {
                    if (k == j) B[s * n + k] += Ed[k] * Sg[j];
                } else {
                    B[s * n + k] += Ei[j * n + k] * Sg[j];
                }
                Bb[s * n + k] -= Ai[j * n + k] * Sg[j];
            }
        }
        for (int j = 0; j < m; j++)
            for (int k = 0; k < n; k++) B[(p0 + kind(n + j)) * n + k] += Ci[j * n + k] * Sg[n + j];
        for (int j = 0; j < rows; j++) {
            const int s = p0 + kind(j);
            K[s * p + s] += Ws[j];
            for (int c = 0; c < p0; c++) K[s * p + c] += Sg[j] * g[j * p0 + c];
        }
    }

    // The separators' own chain, and the corner that is left when it too is eliminated.
    void separators() {
        const I nn = I(n) * n;
        const V *M = L + (H - 1) * nn, *Zs = Z + (H - 1) * zq;
        for (int r = 0; r < n; r++)
            for (int c = 0; c <= r; c++) {
                const V s = M[r * n + c] + from_after(back0[r * n + c] - Q[tri(r, c)]);
                for (int k = 0; k < P; k++) rM[k * nn + r * n + c] = s[k];
            }
        for (int r = 0; r < n; r++)
            for (int c = 0; c < n; c++)
                for (int k = 0; k < P; k++) rO[k * nn + r * n + c] = Zs[c * n + r][k];
        for (int c = 0; c < p; c++)
            for (int r = 0; r < n; r++) {
                const V s = Zs[nn + c * n + r] + from_after(Bb0[c * n + r] - Q[tri(n + c, r)]);
                for (int k = 0; k < P; k++) rZ[(I(k) * p + c) * n + r] = s[k];
            }
        for (int c = 0; c < tri(p, 0); c++) rQ[c] = 0.0;
        chain_factor(n, P, p, rM, rO, rZ, rQ, drop, rw);
        for (int k = 0; k < 2 * p; k++) zinv[k] = zl[k] > 0 ? 1.0 / (zw[k] * zl[k]) : 0.0;
        for (int c = 0; c < p; c++)
            for (int d = 0; d <= c; d++) {
                double s = sum_lanes(K[c * p + d] - Q[tri(n + c, n + d)]) - rQ[tri(c, d)];
                if (c == d) {
                    Korig[c] = sum_lanes(K[c * p + c]);
                    s += reg;
                    s += zslope(2 * c) + zslope(2 * c + 1);
                    if (zhi[c] == zlo[c]) s += lp_pinned;
                }
                Kd[c * p + d] = Kd[d * p + c] = s;
            }
        dense_factor();
    }

    double zslope(int k) const { return zl[k] * (zl[k] * zinv[k]); }

    // Kd = L D L' of the corner. A pivot lost to rounding is held at what rounding leaves of its diagonal entry: its
    // half-width then moves too little, never too far.
    void dense_factor() {
        const double tiny = 1e-15;
        for (int j = 0; j < p; j++) {
            double d = Kd[j * p + j];
            for (int k = 0; k < j; k++) d -= KL[j * p + k] * KL[j * p + k] * Kpiv[k];
            d = max2(d, tiny * std::fabs(Korig[j]));
            Kpiv[j] = d;
            Kinv[j] = 1.0 / d;
            for (int i = j + 1; i < p; i++) {
                double s = Kd[i * p + j];
                for (int k = 0; k < j; k++) s -= KL[i * p + k] * KL[j * p + k] * Kpiv[k];
                KL[i * p + j] = s * Kinv[j];
            }
        }
    }

    // ---- right-hand sides -----------------------------------------------------------------------------------------

    // f and kz from row(i, j, nu, t): nu enters -sum a nu, t enters sum t of the half-width's row.
    template <class RowFn>
    void forward(RowFn row) {
        const I nn = I(n) * n;
        const int q = n + p;
        for (int c = 0; c < q; c++) acc[c] = V(0.0);
        for (int c = 0; c < p; c++) zacc[c] = V(0.0);
        for (I i = 0; i < H; i++) {
            for (int j = 0; j < G; j++) {
                V t(0.0);
                row(i, j, nu[j], t);
                if (j < rows) zacc[p0 + kind(j)] += t;
            }
            adjoint(i, nu, own, bef, true);
            V* fi = f + i * n;
            for (int k = 0; k < n; k++) fi[k] = -own[k];
            if (i > 0) {
                V* fb = fi - int(n);
                for (int k = 0; k < n; k++) fb[k] -= bef[k];
                chain_close_rhs(n, q, L + (i - 1) * nn, Z + (i - 1) * zq, fb, acc, wk);
                chain_link_rhs(n, O + i * nn, fb, fi);
            } else {
                for (int k = 0; k < n; k++) bef0[k] = -bef[k];
            }
        }
        for (int k = 0; k < n; k++) {
            const V s = f[(H - 1) * n + k] + from_after(bef0[k] - acc[k]);
            for (int t = 0; t < P; t++) rf[t * n + k] = s[t];
        }
        for (int c = 0; c < p; c++) racc[c] = 0.0;
        chain_forward(n, P, p, rM, rO, rZ, rf, racc, rw);
        for (int c = 0; c < p; c++) kz[c] = sum_lanes(zacc[c] - acc[n + c]) - racc[c] - cz[c];
    }

    // ---- solutions ------------------------------------------------------------------------------------------------

    // dz from kz, then dx backwards; after(i) is called when x_i and x_{i-1} of the direction are both known.
    template <class AfterFn>
    void backward(bool zero_rhs, V* out, double* zout, AfterFn after) {
        const I nn = I(n) * n;
        const int q = n + p;
        for (int c = 0; c < p; c++) zout[c] = kz[c];
        ldl_solve(Dim<0>(p), Dim<1>(), KL, Kinv, zout);
        if (zero_rhs)
            for (int k = 0; k < P * n; k++) rf[k] = 0.0;
        chain_backward(n, P, p, rM, rO, rZ, rf, zout, rx);
        V* last = out + (H - 1) * n;
        for (int k = 0; k < n; k++) {
            for (int t = 0; t < P; t++) last[k].set(t, rx[t * n + k]);
            left[k] = from_before(last[k]);
            lz[k] = left[k];
        }
        for (int c = 0; c < p; c++) lz[n + c] = dzv[c] = V(zout[c]);
        for (I i = H - 2; i >= 0; i--) {
            V* xi = out + i * n;
            chain_back(n, q, L + i * nn, Z + i * zq, zero_rhs ? nullptr : f + i * n, lz,
                       O + (i + 1) * nn, out + (i + 1) * n, xi);
            after(i + 1, out + (i + 1) * n, xi);
        }
        after(0, out, left);
    }

    // ---- setting up -----------------------------------------------------------------------------------------------

    inline I state_of(int lane, I i) const { return I(lane) * H + i; }

    // the problem, scaled, into lanes
    void pack() {
        const int T = lp.T;
        for (int c = 0; c < ns; c++) {
            const bool fixed = lp.cap[c] <= lp.floor[c];
            const double cost = fixed ? 0.0 : lp.c[c];
            sz[p0 + c] = cost > 0.0 ? 1.0 / cost : (lp.cap[c] > 0.0 && lp.cap[c] < lp_inf ? lp.cap[c] : 1.0);
            cz[p0 + c] = cost > 0.0 ? 1.0 : 0.0;
            zlo[p0 + c] = fixed ? 0.0 : lp.floor[c] / sz[p0 + c];
            zhi[p0 + c] = lp.cap[c] >= lp_inf ? 2 * lp_inf : lp.cap[c] / sz[p0 + c];
            zref[p0 + c] = 0.0;
        }
        for (int j = 0; j < rows; j++) kappa[j] = 1.0 / (lp.h[j] * sz[p0 + kind(j)]);
        for (int j = 0; j < m; j++) {  // share of the rows in which an output is seen
            int c = 0;
            for (I t = 0; t < T; t++) c += lp.seen[t * m + j];
            count[n + j] = double(c) / T;
        }
        // columns of x by their norm over one row of the record, the mean over time where matrices move
        const int TA = lp.A_t ? T : 1, TC = lp.C_t ? T : 1, TE = lp.E_t ? T : 1;
        for (int k = 0; k < n; k++) {
            double a = 0.0, c = 0.0, e = 0.0;
            for (int t = 0; t < TA; t++)
                for (int j = 0; j < n; j++) a += square(kappa[j] * lp.A[(I(t) * n + j) * n + k]);
            for (int t = 0; t < TC; t++)
                for (int j = 0; j < m; j++) {
                    const double share = TC > 1 ? double(lp.seen[I(t) * m + j]) : count[n + j];
                    c += share * square(kappa[n + j] * lp.C[(I(t) * m + j) * n + k]);
                }
            if (unit_E) e = square(kappa[k]);
            else
                for (int t = 0; t < TE; t++)
                    for (int j = 0; j < n; j++) e += square(kappa[j] * lp.E[(I(t) * n + j) * n + k]);
            const double norm = a / TA + c / TC + (unit_E ? e : e / TE);
            sx[k] = norm > 1e-280 && norm < 1e280 ? 1.0 / std::sqrt(norm) : 1.0;
            Ed[k] = V(kappa[k] * sx[k]);
        }
        for (int c = 0; c < p0; c++) {
            double s = 0.0;
            for (I t = 0; t < T; t++)
                for (int j = 0; j < rows; j++)
                    if (j < n || lp.seen[t * m + j - n]) s += square(kappa[j] * lp.G[(t * rows + j) * p0 + c]);
            s /= T;
            sz[c] = s > 1e-280 && s < 1e280 ? 1.0 / std::sqrt(s) : 1.0;
            cz[c] = 0.0;
            const double lo = lp.theta_lo[c], hi = lp.theta_hi[c];
            zlo[c] = lo <= -lp_inf ? -2 * lp_inf : lo / sz[c];
            zhi[c] = hi >= lp_inf ? 2 * lp_inf : hi / sz[c];
            zref[c] = zlo[c] > -lp_inf && zhi[c] < lp_inf ? 0.5 * (zlo[c] + zhi[c])
                                                          : max2(zlo[c], min2(zhi[c], 0.0));
        }
        for (I i = 0; i < H; i++)
            for (int lane = 0; lane < P; lane++) {
                const I k = state_of(lane, i);
                const bool real = k <= T, row = k >= 1 && real;
                const I t = row ? k - 1 : 0;
                if (!unit_E && (dE || (i == 0 && lane == 0)))
                    put(n, n, lp.E + (dE ? t * dE : 0), kappa, E + i * dE, lane, dE != 0);
                if (dA || (i == 0 && lane == 0)) put(n, n, lp.A + (dA ? t * dA : 0), kappa, A + i * dA, lane, dA != 0);
                if (m && (dC || (i == 0 && lane == 0)))
                    put(m, n, lp.C + (dC ? t * dC : 0), kappa + n, C + i * dC, lane, dC != 0);
                for (int j = 0; j < rows; j++) {
                    const bool on = row && (j < n || lp.seen[t * m + j - n]);
                    const double bj = on ? (j < n ? lp.bx[t * n + j] : lp.by[t * m + j - n]) : 0.0;
                    b[i * rows + j].set(lane, kappa[j] * bj);
                    for (int c = 0; c < p0; c++)
                        Gt[(i * rows + j) * p0 + c].set(lane, on ? kappa[j] * sz[c] * lp.G[(t * rows + j) * p0 + c] : 0.0);
                    const double half = on ? 0.5 : 0.0;
                    for (int side = 0; side < 2; side++) {
                        l[i * pw + 2 * j + side].set(lane, half);
                        w[i * pw + 2 * j + side].set(lane, 1.0);
                    }
                    if (soft) {
                        l[i * pw + 2 * G + j].set(lane, on ? 1e30 : 0.0);  // no slack in the least-squares start
                        w[i * pw + 2 * G + j].set(lane, 1.0);
                    }
                }
                for (int j = 0; j < n; j++) {
                    double pin = real ? 0.0 : 1.0, at = 0.0;
                    if (boxed) {
                        double lo = -lp_inf, hi = lp_inf;
                        if (real && lp.lo) lo = lp.lo[(lp.box_t ? k * n : 0) + j], hi = lp.hi[(lp.box_t ? k * n : 0) + j];
                        if (k == 0 && lp.x0_lo) lo = lp.x0_lo[j], hi = lp.x0_hi[j];
                        lo = lo <= -lp_inf ? -2 * lp_inf : lo / sx[j];
                        hi = hi >= lp_inf ? 2 * lp_inf : hi / sx[j];
                        const bool low = lo > -lp_inf, high = hi < lp_inf;
                        at = low && high ? 0.5 * (lo + hi) : max2(lo, min2(hi, 0.0));
                        if (low && high && hi - lo <= 1e-12 * (1.0 + std::fabs(at))) {
                            pin = lp_pinned;
                            lo = -2 * lp_inf, hi = 2 * lp_inf;
                        }
                        xlo[i * n + j].set(lane, lo);
                        xhi[i * n + j].set(lane, hi);
                        for (int side = 0; side < 2; side++) {
                            l[i * pw + 2 * (rows + j) + side].set(lane, 0.0);
                            w[i * pw + 2 * (rows + j) + side].set(lane, 1.0);
                        }
                    }
                    base[i * n + j].set(lane, pin);
                    dx[i * n + j].set(lane, at);
                    xref[i * n + j].set(lane, 0.0);
                    x[i * n + j].set(lane, 0.0);
                }
            }
    }

    static inline double square(double a) { return a * a; }

    // one lane (or, for a constant matrix, all lanes) of a scaled (r, n) matrix
    inline void put(int r, int nc, const double* M, const double* k, V* out, int lane, bool moving) const {
        for (int i = 0; i < r; i++)
            for (int j = 0; j < nc; j++) {
                const double a = k[i] * M[i * nc + j] * sx[j];
                if (moving) out[i * nc + j].set(lane, a);
                else out[i * nc + j] = V(a);
            }
    }

    // measure rows from xref + dx from now on
    void recentre() {
        for (int c = 0; c < p0; c++) dzv[c] = V(dz[c]);
        for (int k = 0; k < n; k++) left[k] = from_before(dx[(H - 1) * n + k]);
        for (I i = 0; i < H; i++) {
            apply(i, dx + i * n, i ? dx + (i - 1) * n : left, p0 ? dzv : nullptr, rho);
            for (int j = 0; j < rows; j++)
                b[i * rows + j] = where_positive(l[i * pw + 2 * j], b[i * rows + j] - rho[j], V(0.0));
            for (int k = 0; k < n; k++) xref[i * n + k] += dx[i * n + k];
        }
        for (int c = 0; c < p0; c++) zref[c] += dz[c];
    }

    void least_squares() {
        reg = 1e-8;
        for (int k = 0; k < 2 * p; k++) zw[k] = 1.0, zl[k] = 0.0;
        assemble();
        forward([&](I i, int j, V& nu_, V&) { nu_ = j < rows ? -b[i * rows + j] : V(0.0); });
        backward(false, dx, dz, [](I, const V*, const V*) {});
        recentre();
        // The factor carries a small ridge; where the fit is near perfect the ridge is what is left of it: solve again.
        for (int k = 0; k < 3 && largest_residual() < 1e-4 * data_scale(); k++) {
            forward([&](I i, int j, V& nu_, V&) { nu_ = j < rows ? -b[i * rows + j] : V(0.0); });
            backward(false, dx, dz, [](I, const V*, const V*) {});
            recentre();
        }
    }

    double largest_residual() const {
        V top(0.0);
        for (I k = 0; k < I(H) * rows; k++) top = larger(top, magnitude(b[k]));
        return max_lanes(top);
    }

    // what rounding is relative to: the largest state in scaled units
    double data_scale() const {
        V top(0.0);
        for (I k = 0; k < I(H) * n; k++) top = larger(top, magnitude(xref[k]));
        return max_lanes(top);
    }

    // A point strictly inside: least squares pushed into the boxes, half-widths above every residual. False if all
    // residuals there are rounding: nothing is left to minimise.
    bool start() {
        for (I i = 0; i < H; i++) {
            for (int k = 0; k < n; k++) {
                V d(0.0);
                if (boxed) {
                    const V lo = xlo[i * n + k] - xref[i * n + k], hi = xhi[i * n + k] - xref[i * n + k];
                    for (int t = 0; t < P; t++) d.set(t, inside(lo[t], hi[t], 0.0, 0.05));
                }
                dx[i * n + k] = d;
            }
        }
        const double biggest = data_scale();
        for (int c = 0; c < p0; c++) dz[c] = zhi[c] == zlo[c] ? 0.0 : inside(zlo[c] - zref[c], zhi[c] - zref[c], 0.0, 0.05);
        for (int c = 0; c < p0; c++) z[c] = 0.0;
        if (boxed || p0) recentre();
        if (!unit_of_residuals(biggest)) return false;
        for (int c = 0; c < ns; c++) {
            double top_c, n_c;
            if (!rows_of(c, top_c, n_c)) continue;
            z[p0 + c] = max2(1.2 * top_c + 1e-3, zlo[p0 + c] + 1e-3);
            kz[p0 + c] = max2(cz[p0 + c], soft ? 0.1 : 1e-2) / (2.0 * n_c);  // multiplier of a row
        }
        V sum(0.0);
        for (I i = 0; i < H; i++)
            for (int j = 0; j < rows; j++) {
                const double s = z[p0 + kind(j)], lam = kz[p0 + kind(j)];
                V *wi = w + i * pw + 2 * j, *li = l + i * pw + 2 * j;
                const V on = li[0], rj = -b[i * rows + j];
                V ws(s);
                if (soft) {  // half of the residual's room from the slack
                    V& ei = w[i * pw + 2 * G + j];
                    const V e0 = V(0.1 * s);
                    const double ce = lp.slack[j] / kappa[j];
                    ei = where_positive(on, e0, V(1.0));
                    l[i * pw + 2 * G + j] = where_positive(on, V(max2(ce - 2.0 * lam, 0.1 * ce)), V(0.0));
                    ws += e0;
                }
                wi[0] = where_positive(on, ws - rj, V(1.0));
                wi[1] = where_positive(on, ws + rj, V(1.0));
                li[0] = li[1] = where_positive(on, V(lam), V(0.0));
                sum += wi[0] * li[0] + wi[1] * li[1];
            }
        open_bounds(mu_pairs > 0 ? sum_lanes(sum) / mu_pairs : 1e-3, nullptr);
        return true;
    }

    // Measure everything in units S of the largest residual; false if all of them are rounding of `biggest`.
    bool unit_of_residuals(double biggest) {
        V top(0.0);
        for (int j = 0; j < rows; j++) {
            V mx(0.0), nr(0.0);
            for (I i = 0; i < H; i++) {
                mx = larger(mx, magnitude(b[i * rows + j]));
                nr += l[i * pw + 2 * j];
            }
            hmax[j] = max_lanes(mx);
            count[j] = 2.0 * sum_lanes(nr);
            top = larger(top, mx);
        }
        S = max_lanes(top);
        objective = comp = 0.0;
        if (!(S > 1e-12 * biggest) || S < 1e-290) return false;
        rounding = 4e-15 * biggest / S;
        const V over(1.0 / S);
        for (I i = 0; i < H; i++) {
            for (int j = 0; j < rows; j++) b[i * rows + j] *= over;
            for (int k = 0; k < n; k++) x[i * n + k] = V(0.0);
        }
        for (int c = 0; c < p; c++) {
            zlo[c] = zlo[c] <= -lp_inf ? -2 * lp_inf : (zlo[c] - zref[c]) / S;
            zhi[c] = zhi[c] >= lp_inf ? 2 * lp_inf : (zhi[c] - zref[c]) / S;
        }
        mu_pairs = 0.0;
        for (int j = 0; j < rows; j++) mu_pairs += 2.0 * count[j];
        reg = 1e-9 / (lp.T + 1.0);
        return true;
    }

    // Largest residual and number of the rows that half-width c bounds; without any it stays on its floor and is no part
    // of the path.
    bool rows_of(int c, double& top, double& number) {
        top = number = 0.0;
        for (int j = 0; j < rows; j++)
            if (kind(j) == c) top = max2(top, hmax[j] / S), number += count[j];
        if (number == 0.0) z[p0 + c] = zhi[p0 + c] = zlo[p0 + c];
        return number > 0.0;
    }

    // Pairs of the bounds of x, theta and s, with products mu or the multipliers of `from`.
    void open_bounds(double mu, const LpWarm* from) {
        if (soft) mu_pairs *= 1.5;
        if (boxed)
            for (I i = 0; i < H; i++)
                for (int k = 0; k < n; k++)
                    for (int t = 0; t < P; t++) {
                        const double at = xref[i * n + k][t], lo = xlo[i * n + k][t], hi = xhi[i * n + k][t];
                        V *wi = w + i * pw + 2 * (rows + k), *li = l + i * pw + 2 * (rows + k);
                        const I old = from ? state_of(t, i) + from->drop : 0;
                        for (int side = 0; side < 2; side++) {
                            if (side ? lo <= -lp_inf : hi >= lp_inf) continue;
                            const double room = (side ? at - lo : hi - at) / S;
                            double lam = mu / room;
                            if (from && old <= from->T) {
                                const double had = from->box[(old * n + k) * 2 + side] * sx[k];
                                lam = had > 0.0 ? had : lam;
                            }
                            wi[side].set(t, room);
                            li[side].set(t, lam);
                            mu_pairs += 1;
                        }
                    }
        capped = false;
        for (int c = 0; c < p; c++) {
            for (int k = 2 * c; k < 2 * c + 2; k++) zw[k] = 1.0, zl[k] = zu[k] = zv[k] = zrp[k] = 0.0;
            if (zhi[c] == zlo[c]) continue;
            for (int side = 0; side < 2; side++) {
                const int k = 2 * c + side;
                if (side ? zhi[c] >= lp_inf : zlo[c] <= -lp_inf) continue;
                const double room = side ? zhi[c] - z[c] : z[c] - zlo[c];
                zw[k] = max2(room, side && c >= p0 ? 0.1 * z[c] : 0.0);
                zrp[k] = room - zw[k];
                zl[k] = mu / zw[k];
                if (from && from->ends[k] > 0.0) zl[k] = from->ends[k] * sz[c];
                mu_pairs += 1;
                capped = capped || (side && c >= p0);
            }
        }
    }

    // ---- from the window before -----------------------------------------------------------------------------------

    // The states of `from`, moved to where this problem has them; newer ones follow the model.
    void recall(const LpWarm& from) {
        double *last = rx, *next = rw;
        for (I k = 0; k <= lp.T; k++) {
            const I old = k + from.drop;
            if (old <= from.T) {
                for (int j = 0; j < n; j++) last[j] = from.x[old * n + j];
            } else {
                const double *Ek = unit_E ? nullptr : lp.E + (k - 1) * dE, *Ak = lp.A + (k - 1) * dA;
                for (int j = n - 1; j >= 0; j--) {
                    double s = lp.bx[(k - 1) * n + j];
                    for (int c = 0; c < n; c++) s += Ak[j * n + c] * last[c];
                    for (int c = 0; c < p0; c++) s -= lp.G[((k - 1) * rows + j) * p0 + c] * from.theta[c];
                    if (!unit_E)
                        for (int c = j + 1; c < n; c++) s -= Ek[j * n + c] * next[c];
                    next[j] = s;
                }
                for (int j = 0; j < n; j++) last[j] = next[j];
            }
            const I i = k % H;
            const int lane = int(k / H);
            for (int j = 0; j < n; j++) {
                if (base[i * n + j][lane] > 0.5) continue;  // does not move
                double at = last[j] / sx[j];
                if (boxed) at = inside(xlo[i * n + j][lane], xhi[i * n + j][lane], at, old <= from.T ? 1e-9 : 1e-3);
                dx[i * n + j].set(lane, at);
            }
        }
        for (int c = 0; c < p0; c++) {
            zref[c] = 0.0;
            dz[c] = zhi[c] == zlo[c] ? zlo[c] : inside(zlo[c], zhi[c], from.theta[c] / sz[c], 1e-9);
        }
        recentre();
    }

    // Start from `from` instead of least squares; false where that is no start.
    bool warm_start(const LpWarm& from) {
        if (!boxed)
            for (I k = 0; k < I(H) * n; k++) dx[k] = V(0.0);
        recall(from);
        if (!unit_of_residuals(data_scale())) return false;
        for (int c = 0; c < p; c++) z[c] = 0.0;
        for (int c = 0; c < ns; c++) {
            double top_c, n_c;
            if (rows_of(c, top_c, n_c)) z[p0 + c] = max2(max2(1.05 * from.s[c] / (sz[p0 + c] * S), (1 + 1e-9) * top_c), zlo[p0 + c] + 1e-6);
        }
        for (I k = max2(I(1), from.T - from.drop + 1); k <= lp.T; k++)  // room for the new rows
            for (int j = 0; j < rows; j++) {
                double& zj = z[p0 + kind(j)];
                zj = max2(zj, 1.2 * std::fabs(b[k % H * rows + j][k / H]) + 1e-3);
            }
        double sum = 0.0, known = 0.0;
        for (I i = 0; i < H; i++)
            for (int j = 0; j < rows; j++) {
                V *wi = w + i * pw + 2 * j, *li = l + i * pw + 2 * j;
                const V on = li[0], rj = -b[i * rows + j], s(z[p0 + kind(j)]);
                wi[0] = where_positive(on, s - rj, V(1.0));
                wi[1] = where_positive(on, s + rj, V(1.0));
                for (int t = 0; t < P; t++) {
                    const I old = state_of(t, i) - 1 + from.drop;
                    for (int side = 0; side < 2; side++) {
                        const double had = on[t] > 0.0 && old < from.T ? from.lam[(old * rows + j) * 2 + side] / kappa[j] : 0.0;
                        li[side].set(t, had);
                        if (had > 0.0) sum += had * wi[side][t], known += 1.0;
                    }
                }
            }
        if (!(known > 0.0)) return false;
        const double mu = sum / known;
        for (I i = 0; i < H; i++)
            for (int j = 0; j < rows; j++) {
                V *wi = w + i * pw + 2 * j, *li = l + i * pw + 2 * j;
                for (int t = 0; t < P; t++) {
                    const I k = state_of(t, i);
                    if (k < 1 || k > lp.T || (j >= n && !lp.seen[(k - 1) * m + j - n])) continue;
                    for (int side = 0; side < 2; side++)
                        if (!(li[side][t] > 0.0)) li[side].set(t, mu / wi[side][t]);
                }
            }
        open_bounds(mu, &from);
        return true;
    }

    // What the next window starts from.
    void hand_on(LpWarm& to) const {
        to.T = lp.T;
        to.drop = 0;
        for (int c = 0; c < p0; c++) to.theta[c] = sz[c] * (zref[c] + S * zwarm[c]);
        for (int c = 0; c < ns; c++) to.s[c] = sz[p0 + c] * S * zwarm[p0 + c];
        for (int c = 0; c < p; c++)
            for (int side = 0; side < 2; side++) to.ends[2 * c + side] = zlwarm[2 * c + side] / sz[c];
        for (int lane = 0; lane < P; lane++)
            for (I i = 0; i < H; i++) {
                const I k = state_of(lane, i);
                if (k > lp.T) continue;
                for (int j = 0; j < n; j++) {
                    to.x[k * n + j] = sx[j] * (xref[i * n + j][lane] + S * xwarm[i * n + j][lane]);
                    for (int side = 0; side < 2; side++)
                        to.box[(k * n + j) * 2 + side] = boxed ? lwarm[i * pw + 2 * (rows + j) + side][lane] / sx[j] : 0.0;
                }
                for (int j = 0; j < rows && k > 0; j++)
                    for (int side = 0; side < 2; side++)
                        to.lam[((k - 1) * rows + j) * 2 + side] = lwarm[i * pw + 2 * j + side][lane] * kappa[j];
            }
    }

    // where to start between two bounds: at a, at least a share `rim` of the width (or of 1) away from either
    static inline double inside(double lo, double hi, double a, double rim) {
        const bool low = lo > -lp_inf, high = hi < lp_inf;
        if (low && high) {
            const double edge = rim * (hi - lo);
            return max2(lo + edge, min2(hi - edge, a));
        }
        if (low) return max2(lo + rim * min2(1.0, 1.0 + std::fabs(lo)), a);
        if (high) return min2(hi - rim * min2(1.0, 1.0 + std::fabs(hi)), a);
        return a;
    }

    // ---- one iteration --------------------------------------------------------------------------------------------

    void measure_dense(double gap_sum, double res_sum, double dual_sum, double slack_sum) {
        comp = gap_sum;
        dinf = res_sum;
        pinf = 0.0;
        dual = dual_sum;
        objective = slack_sum;
        double beyond = 0.0;  // what the multipliers, read as a ray, leave unexplained
        for (int c = 0; c < p; c++) {
            for (int k = 2 * c; k < 2 * c + 2; k++) {
                comp += zw[k] * zl[k];
                pinf = max2(pinf, std::fabs(zrp[k]));
            }
            if (zhi[c] == zlo[c]) continue;
            const double r = cz[c] - sum_lanes(zacc[c]) - zl[2 * c] + zl[2 * c + 1];
            dinf += std::fabs(r) * (1.0 + std::fabs(z[c]));
            objective += cz[c] * z[c];
            if (zl[2 * c] > 0) dual += zl[2 * c] * zlo[c];
            if (zl[2 * c + 1] > 0) dual -= zl[2 * c + 1] * zhi[c];
            const double ray = r - cz[c];
            if (c < p0 || zhi[c] >= lp_inf) beyond += std::fabs(ray) * (1.0 + std::fabs(z[c]));
            else dual += min2(ray * max2(zlo[c], 0.0), ray * zhi[c]);
        }
        // No point within a thousand times today's size satisfies the rows: their combination by these multipliers fails.
        certificate = capped && dual > 1e3 * (res_sum + beyond) && dual > 10.0 * (1.0 + std::fabs(objective));
    }
    bool certificate = false;

    // A direction (u, v) = (dw / w, dl / l) of a pair solves u + v = e - 1: e = 0 is the affine direction, and what is
    // asked beyond it goes into the right-hand side as l e.
    void dense_rhs() {
        for (int k = 0; k < 2 * p; k++)
            kz[k / 2] += (k & 1 ? -1.0 : 1.0) * zl[k] * (ze[k] - zrp[k] * zl[k] * zinv[k]);
    }

    void dense_steps(double& block_p, double& block_d) {
        for (int k = 0; k < 2 * p; k++) {
            if (!(zl[k] > 0)) continue;
            zu[k] = ((k & 1 ? -dz[k / 2] : dz[k / 2]) + zrp[k]) * zl[k] * zinv[k];
            zv[k] = ze[k] - 1.0 - zu[k];
            block_p = max2(block_p, -zu[k]);
            block_d = max2(block_d, -zv[k]);
        }
    }

    // the slack's own step at row j: de = (t - Wd ds - Sd drho) / (Wd + de)
    inline V slack_step(I i, int j, const V& t, const V& ds, const V& drho) const {
        V Wd, Sd, de;
        slopes(i, j, Wd, Sd, de);
        return (t - Wd * ds - Sd * drho) * (V(1.0) / larger(Wd + de, V(1e-300)));
    }

    // what is asked of the slack at row j: its cost, and e of the pair and of itself
    inline V slack_rhs(const V* li, int j, const V& asked) const {
        const int k = 2 * G + j;
        return where_positive(li[k], asked - V(lp.slack[j] / kappa[j]), V(0.0));
    }

    // The right-hand side of a direction, e(i, k) of every pair entry.
    template <class AskFn>
    void ask(AskFn e) {
        forward([&](I i, int j, V& nu_, V& t) {
            const V* li = l + i * pw;
            const V zp = li[2 * j] * e(i, 2 * j), zm = li[2 * j + 1] * e(i, 2 * j + 1);
            nu_ = zp - zm;
            t = zp + zm;
            if (soft && j < rows) {
                V Wd, Sd, de;
                slopes(i, j, Wd, Sd, de);
                const V own_ = slack_rhs(li, j, t + li[2 * G + j] * e(i, 2 * G + j)) * (V(1.0) / larger(Wd + de, V(1e-300)));
                nu_ += Sd * own_;
                t -= Wd * own_;
            }
        });
        dense_rhs();
    }

    // Solve for the direction: take(i, k, dw) is called for every pair entry.
    template <class AskFn, class TakeFn>
    void answer(bool zero_rhs, AskFn e, TakeFn take) {
        backward(zero_rhs, dx, dz, [&](I i, const V* xi, const V* xb) {
            const V* li = l + i * pw;
            apply(i, xi, xb, p0 ? dzv : nullptr, rho);
            for (int j = 0; j < G; j++) {
                V ds = j < rows ? dzv[p0 + kind(j)] : V(0.0);
                if (soft && j < rows) {
                    const V asked = li[2 * j] * e(i, 2 * j) + li[2 * j + 1] * e(i, 2 * j + 1) + li[2 * G + j] * e(i, 2 * G + j);
                    const V de = slack_step(i, j, slack_rhs(li, j, asked), ds, rho[j]);
                    take(i, 2 * G + j, de);
                    ds += de;
                }
                take(i, 2 * j, ds - rho[j]);
                take(i, 2 * j + 1, ds + rho[j]);
            }
        });
    }

    // the direction that ignores centring, how far it may be followed, and the mean product there
    void affine(double& ap, double& ad, double& mu_affine) {
        auto none = [](I, I) { return V(0.0); };
        for (int k = 0; k < 2 * p; k++) ze[k] = 0.0;
        if (soft) {
            ask(none);
        } else {
            for (int c = 0; c < p; c++) kz[c] = -cz[c];
            dense_rhs();
        }
        V least(0.0), most(-1.0), Su(0.0), Suu(0.0);
        answer(!soft, none, [&](I i, I k_, const V& dw) {
            const I k = i * pw + k_;
            const V t = dw * l[k], a = t * inv[k];  // w l u = l dw
            u[k] = a;
            least = smaller(least, a);
            most = larger(most, a);
            Su += t;
            Suu += t * a;
        });
        double bp = -min_lanes(least), bd = 1.0 + max_lanes(most);
        dense_steps(bp, bd);
        ap = min2(1.0, 1.0 / max2(bp, 1e-300));
        ad = min2(1.0, 1.0 / max2(bd, 1e-300));
        // sum (w + ap dw)(l + ad dl) without another sweep: v = -1 - u, so only sums of u and u^2 are needed
        double s0 = comp, su = sum_lanes(Su), suu = sum_lanes(Suu), dense = 0.0;
        for (int k = 0; k < 2 * p; k++) {
            s0 -= zw[k] * zl[k];
            if (zl[k] > 0) dense += zw[k] * (1.0 + ap * zu[k]) * zl[k] * (1.0 + ad * zv[k]);
        }
        mu_affine = (s0 + ap * su - ad * (s0 + su) - ap * ad * (su + suu) + dense) / mu_pairs;
    }

    // (u, v) of the e that `v` and `ze` hold
    void direction(double& block_p_, double& block_d_) {
        V least_p(0.0), least_d(0.0);
        answer(false, [&](I i, I k) { return v[i * pw + k]; }, [&](I i, I k_, const V& dw) {
            const I k = i * pw + k_;
            const V un = dw * l[k] * inv[k], vn = where_positive(l[k], v[k] - V(1.0) - un, V(0.0));
            u[k] = un;
            v[k] = vn;
            least_p = smaller(least_p, un);
            least_d = smaller(least_d, vn);
        });
        block_p_ = -min_lanes(least_p);
        block_d_ = -min_lanes(least_d);
        dense_steps(block_p_, block_d_);
    }

    // products of `target` in every pair, less a share of the affine direction's own product dw dl
    void corrected(double target_, double share_, double& block_p, double& block_d) {
        const V target(target_);
        const V share(share_);
        for (int k = 0; k < 2 * p; k++) ze[k] = target_ * zinv[k] - share_ * zu[k] * zv[k];
        ask([&](I i, I k_) {
            const I k = i * pw + k_;
            return v[k] = target * inv[k] + share * u[k] * (V(1.0) + u[k]);
        });
        direction(block_p, block_d);
    }

    // After a full step the dual equations should hold; what is missing is solved for by conjugate gradients on the
    // unfactored matrix, with the factor (which carries the ridge and its own rounding) as preconditioner.
    void refine(int steps, double& block_p_, double& block_d_) {
        double before = 0.0;
        for (int step = 0; step < steps; step++) {
            forward([&](I i, int j, V& nu_, V& t) {
                const V *li = l + i * pw + 2 * j, *vi = v + i * pw + 2 * j;
                const V a = li[0] + li[0] * vi[0], c = li[1] + li[1] * vi[1];
                nu_ = a - c;
                t = a + c;
            });
            for (int k = 0; k < 2 * p; k++) kz[k / 2] += (k & 1 ? -1.0 : 1.0) * (zl[k] + zl[k] * zv[k]);
            const double now = preconditioned_norm();
            if (!(now > 0.0) || now > 1e200) return;
            const double beta = step ? now / before : 0.0;
            before = now;
            V energy(0.0);
            backward(false, f, zcg, [](I, const V*, const V*) {});
            for (int c = 0; c < p; c++) {
                pz[c] = step ? zcg[c] + beta * pz[c] : zcg[c];
                dzv[c] = V(pz[c]);
            }
            for (I k = 0; k < I(H) * n; k++) px[k] = step ? f[k] + V(beta) * px[k] : f[k];
            for (int k = 0; k < n; k++) left[k] = from_before(px[(H - 1) * n + k]);
            for (I i = 0; i < H; i++) {
                apply(i, px + i * n, i ? px + (i - 1) * n : left, p0 ? dzv : nullptr, rho);
                for (int j = 0; j < G; j++) {
                    const V ds = j < rows ? dzv[p0 + kind(j)] : V(0.0);
                    V Wj, Sj, Wsj;
                    weigh(i, j, Wj, Sj, Wsj);
                    energy += Wj * rho[j] * rho[j] + V(2.0) * Sj * rho[j] * ds + Wsj * ds * ds;
                }
            }
            double e = sum_lanes(energy);
            for (int c = 0; c < p; c++) e += pz[c] * pz[c] * (zslope(2 * c) + zslope(2 * c + 1));
            const double gamma = now / e;
            if (!(gamma > 0.0) || gamma > 1e12) return;
            amend(gamma, block_p_, block_d_);
        }
    }

    // (u, v) and (dx, dz) take gamma times (px, pz)
    void amend(double gamma, double& block_p_, double& block_d_) {
        V least_p(0.0), least_d(0.0);
        const V g(gamma);
        for (I i = 0; i < H; i++) {
            V *li = l + i * pw, *ui = u + i * pw, *vi = v + i * pw;
            apply(i, px + i * n, i ? px + (i - 1) * n : left, p0 ? dzv : nullptr, rho);
            auto take = [&](const V& dw, int k) {
                const V du = g * dw * (li[k] * inv[i * pw + k]);
                ui[k] += du;
                vi[k] -= du;
                least_p = smaller(least_p, ui[k]);
                least_d = smaller(least_d, vi[k]);
            };
            for (int j = 0; j < G; j++) {
                V ds = j < rows ? dzv[p0 + kind(j)] : V(0.0);
                if (soft && j < rows) {
                    const V de = slack_step(i, j, V(0.0), ds, rho[j]);
                    take(de, 2 * G + j);
                    ds += de;
                }
                take(ds - rho[j], 2 * j);
                take(ds + rho[j], 2 * j + 1);
            }
            for (int k = 0; k < n; k++) dx[i * n + k] += g * px[i * n + k];
        }
        block_p_ = -min_lanes(least_p);
        block_d_ = -min_lanes(least_d);
        for (int c = 0; c < p; c++) {
            dz[c] += gamma * pz[c];
            for (int side = 0; side < 2; side++) {
                const int k = 2 * c + side;
                if (!(zl[k] > 0)) continue;
                const double du = gamma * (side ? -pz[c] : pz[c]) * zl[k] * zinv[k];
                zu[k] += du;
                zv[k] -= du;
                block_p_ = max2(block_p_, -zu[k]);
                block_d_ = max2(block_d_, -zv[k]);
            }
        }
    }

    // r' M^-1 r of the right-hand side left by `forward`
    double preconditioned_norm() {
        const I nn = I(n) * n;
        V s(0.0);
        for (I i = 0; i + 1 < H; i++)
            for (int k = 0; k < n; k++) s += f[i * n + k] * f[i * n + k] * L[i * nn + k * n + k];
        double total = sum_lanes(s);
        for (int t = 0; t < P; t++)
            for (int k = 0; k < n; k++) total += square(rf[t * n + k]) * rM[t * nn + k * n + k];
        for (int c = 0; c < p; c++) zcg[c] = kz[c];
        ldl_solve(Dim<0>(p), Dim<1>(), KL, Kinv, zcg);
        for (int c = 0; c < p; c++) total += kz[c] * zcg[c];
        return total;
    }

    void dense_take(double ap, double ad) {
        for (int c = 0; c < p; c++) z[c] += ap * dz[c];
        for (int k = 0; k < 2 * p; k++) {
            zw[k] *= 1.0 + ap * zu[k];
            zl[k] *= 1.0 + ad * zv[k];
            zrp[k] *= 1.0 - ap;
        }
    }

    // ---- the loop -------------------------------------------------------------------------------------------------

    int solve(LpOut& out) {
        LpInfo& info = out.info;
        info = LpInfo{0, 0, 0, 0, 0, 0, 0, lp_stalled};
        LpWarm* warm = set.warm && set.point == lp_optimal && !soft ? out.warm : nullptr;
        int before = 0;
        // Where more than an eighth of the rows are new, a cold start is as near.
        if (warm && 8 * (lp.T - warm->T + warm->drop) <= lp.T && warm->drop <= warm->T / 8) {
            pack();
            if (warm_start(*warm) && follow(out, warm) == lp_ok) return lp_ok;
            before = info.iterations;
        }
        if (warm) warm->T = 0;
        pack();
        for (int c = 0; c < p; c++) z[c] = dz[c] = 0.0;
        if (boxed) {
            for (int c = 0; c < p0; c++) dz[c] = zref[c], zref[c] = 0.0;
            recentre();
        } else if (p0) {
            for (I k = 0; k < I(H) * n; k++) dx[k] = V(0.0);
            for (int c = 0; c < p0; c++) dz[c] = zref[c], zref[c] = 0.0;
            recentre();
        }
        least_squares();
        const bool worth = start();
        if (!worth || set.point == lp_least_squares) {
            for (I k = 0; k < I(H) * n; k++) x[k] = V(0.0);
            for (int c = 0; c < p; c++) z[c] = 0.0;
            info.scale = S;
            info.status = finish(out, x, l, z, true);
        } else {
            follow(out, warm);
        }
        info.iterations += before;
        return info.status;
    }

    // the path from where `start` or `warm_start` has put the iterate
    int follow(LpOut& out, LpWarm* warm) {
        LpInfo& info = out.info;
        info.scale = S;
        bool saved = false;
        double best = 1e300, ap = 0, ad = 0, free_cost = 1.0;
        for (int c = 0; c < p; c++) free_cost = cz[c] > 0 ? 0.0 : free_cost;
        int since = 0, it = 0;
        double promised = 1e300;
        bool kept = false, step = false;
        for (;; it++) {
            if (step) dense_take(ap, ad);
            advance(ap, ad, step);
            step = true;
            const double size = std::fabs(objective) + 1e-6 + free_cost + (set.point == lp_central ? 0.0 : rounding / set.tol);
            const double slip = (dinf - promised) / size;  // what the last direction's dual residual lacks
            const double gap = comp / size, worst = max2(gap, max2(dinf / size, pinf / size));
            const double merit = comp + dinf + pinf < 1e300 ? worst : 1e300;  // NaN is no merit
            info.iterations = it;
            if (merit < best) {
                best = merit;
                since = 0;
                info.objective = objective;
                info.gap = gap;
                info.dual_residual = dinf / size;
                info.primal_residual = pinf;
                if (merit < 1e-4 && set.point == lp_optimal) {
                    keep();
                    kept = true;
                }
            } else {
                since++;
            }
            if (set.point == lp_central && gap <= set.central_gap && pinf <= 1e-9) {
                info.objective = objective;
                info.gap = gap;
                info.status = finish(out, x, l, z, false);
                return info.status;
            }
            if (warm && !saved && it >= 2 && merit <= lp_warm_gap) {
                for (I k = 0; k < I(H) * n; k++) xwarm[k] = x[k];
                for (I k = 0; k < I(H) * pw; k++) lwarm[k] = l[k];
                for (int c = 0; c < p; c++) zwarm[c] = z[c];
                for (int k = 0; k < 2 * p; k++) zlwarm[k] = zl[k];
                saved = true;
            }
            if (merit <= set.tol) break;
            if (certificate) {
                info.status = lp_infeasible;
                finish(out, x, l, z, false);
                return info.status = lp_infeasible;
            }
            if (it >= set.max_iter || !(merit < 1e4 * best || it < 10) || (since >= 8 && best < 1e-5) || since >= 30) break;
            assemble();
            const double mu = comp / mu_pairs;
            double mu_affine;
            affine(ap, ad, mu_affine);
            double sigma = mu_affine / mu;
            sigma = sigma > 0 ? sigma * sigma * sigma : 0.0;
            sigma = sigma < 1.0 ? sigma : 1.0;
            double fraction = max2(0.99, 1.0 - mu);
            if (set.point == lp_central) sigma = max2(sigma, 0.2), fraction = 0.9;
            // What the affine direction's product would be after a step of which little can be taken is no correction.
            double bp, bd;
            corrected(sigma * mu, min2(1.0, 2.0 * std::sqrt(ap * ad)), bp, bd);
            // Refinement where the last direction was not accurate.
            if (set.point != lp_central && slip > set.tol && slip > 0.1 * gap) refine(3, bp, bd);
            ap = min2(1.0, fraction / max2(bp, 1e-300));
            ad = min2(1.0, fraction / max2(bd, 1e-300));
            promised = (1.0 - ad) * dinf;
            if (!(bp - bp == 0.0) || !(bd - bd == 0.0)) break;
        }
        const bool good = best <= max2(set.tol, 1e-8), fair = best <= 1e-6;
        info.status = good ? lp_ok : fair ? lp_reduced : lp_stalled;
        const int verdict = kept ? finish(out, xbest, lbest, zbest, false) : finish(out, x, l, z, false);
        if (verdict == lp_stalled) info.status = lp_stalled;
        if (saved && info.status == lp_ok) hand_on(*warm);
        return info.status;
    }

    void keep() {
        for (I k = 0; k < I(H) * n; k++) xbest[k] = x[k];
        for (I k = 0; k < I(H) * pw; k++) lbest[k] = l[k];
        if (soft)
            for (I k = 0; k < I(H) * pw; k++) wbest[k] = w[k];
        for (int c = 0; c < p; c++) zbest[c] = z[c];
    }

    static bool finite_all(const double* a, I count) {
        double s = 0.0;
        for (I k = 0; k < count; k++) s += a[k] * 0.0;
        return s == 0.0;
    }

    // Back to the caller's units, and a last look at the rows themselves: lp_ok, or lp_stalled if they are broken.
    int finish(LpOut& out, const V* xs, const V* ls, const double* zs, bool grow) {
        for (int c = 0; c < p0; c++) out.theta[c] = sz[c] * (zref[c] + S * zs[c]);
        for (int c = 0; c < ns; c++) out.s[c] = lp.cap[c] <= lp.floor[c] ? lp.cap[c] : sz[p0 + c] * S * zs[p0 + c];
        if (grow)
            for (int c = 0; c < ns; c++) out.s[c] = lp.floor[c];
        for (int lane = 0; lane < P; lane++)
            for (I i = 0; i < H; i++) {
                const I k = state_of(lane, i);
                if (k > lp.T) continue;
                for (int j = 0; j < n; j++) out.x[k * n + j] = sx[j] * (xref[i * n + j][lane] + S * xs[i * n + j][lane]);
                if (k == 0) continue;
                for (int j = 0; j < rows && out.lam; j++)
                    for (int side = 0; side < 2; side++)
                        out.lam[((k - 1) * rows + j) * 2 + side] = grow ? 0.0 : ls[i * pw + 2 * j + side][lane] * kappa[j];
                for (int j = 0; j < rows && out.slack; j++)
                    out.slack[(k - 1) * rows + j] =
                        soft && !grow && ls[i * pw + 2 * j][lane] > 0
                            ? S * (xs == xbest ? wbest : w)[i * pw + 2 * G + j][lane] / kappa[j] : 0.0;
            }
        double worst = 0.0;
        for (I t = 0; t < lp.T; t++)
            for (int j = 0; j < rows; j++) {
                const bool state = j < n;
                if (!state && !lp.seen[t * m + j - n]) continue;
                double r = state ? -lp.bx[t * n + j] : -lp.by[t * m + j - n], big = std::fabs(r);
                for (int k = 0; k < n; k++) {
                    double term = (state ? (unit_E ? (k == j ? 1.0 : 0.0) : lp.E[t * dE + j * n + k])
                                         : lp.C[t * dC + (j - n) * n + k]) * out.x[(t + 1) * n + k];
                    r += term;
                    big = max2(big, std::fabs(term));
                    if (state) {
                        term = -lp.A[t * dA + j * n + k] * out.x[t * n + k];
                        r += term;
                        big = max2(big, std::fabs(term));
                    }
                }
                for (int c = 0; c < p0; c++) r += lp.G[(t * rows + j) * p0 + c] * out.theta[c];
                const int g = kind(j);
                const double a = std::fabs(r) / lp.h[j];
                if (grow) {
                    out.s[g] = max2(out.s[g], a);
                    continue;
                }
                const double e = soft && out.slack ? out.slack[t * rows + j] / lp.h[j] : 0.0;
                const double over = a - out.s[g] - e - 1e-13 * big / lp.h[j];
                if (over > 0.0 && !(soft && !out.slack)) worst = max2(worst, over / (sz[p0 + g] * S));
            }
        out.info.violation = worst;
        bool capped_out = false;
        if (grow)
            for (int c = 0; c < ns; c++) capped_out = capped_out || out.s[c] > lp.cap[c] * (1.0 + 1e-9);
        double obj = 0.0;
        for (int c = 0; c < ns; c++) obj += lp.c[c] * out.s[c];
        if (soft && out.slack)
            for (I t = 0; t < lp.T; t++)
                for (int j = 0; j < rows; j++) obj += lp.slack[j] * out.slack[t * rows + j];
        out.info.objective = obj;
        bool broken = !(obj - obj == 0.0) || !finite_all(out.x, (I(lp.T) + 1) * n) || !finite_all(out.theta, p0) ||
                      !finite_all(out.s, ns);
        if (broken) {  // a failure is a status, never a NaN
            for (I k = 0; k < (I(lp.T) + 1) * n; k++) out.x[k] = 0.0;
            for (int c = 0; c < p0; c++) out.theta[c] = 0.0;
            for (int c = 0; c < ns; c++) out.s[c] = 0.0;
            for (I k = 0; out.lam && k < 2 * I(lp.T) * rows; k++) out.lam[k] = 0.0;
            for (I k = 0; out.slack && k < I(lp.T) * rows; k++) out.slack[k] = 0.0;
            out.info.objective = 0.0;
            out.info.violation = 1.0;
        }
        return worst <= 1e-7 && !capped_out && !broken ? lp_ok : lp_stalled;
    }
};

}  // namespace HW_ISA
}  // namespace hw
