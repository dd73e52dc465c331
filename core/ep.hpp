// Expectation propagation on a chain: Gaussian beliefs about x_0 .. x_T where every factor acts on one linear functional.
//
//     x_t = A x_{t-1} + b_t + G (w_t + g_t),  g_t ~ N(0, Q)          G = E^-1, A and b already multiplied by it
//     h_k' x_t - b_k = e_k                                           rows: outputs, bounds, half-spaces
//
// Each w_ti has a factor f (uniform) that is replaced by a Gaussian site N(w; m, D), each row one that is replaced by
// exp(nu z - tau z^2 / 2) of its residual z. A site is renewed by taking it out of the belief (the cavity N(mu, c)),
// asking the noise for the moments of f(z) N(z; mu, c) (core/noise.hpp), and choosing the site that reproduces them.
// Gaussian factors are their own sites, so without others one sweep is a Kalman filter and a Rauch-Tung-Striebel smoother.
//
// A sweep goes forwards and backwards and renews every site once, each with what its neighbours have just become:
//
//   forwards   predicted moments (m_p, P_p), joined with the future's message exp(eta_b' x - x' Lambda_b x / 2):
//              P_s = (P_p^-1 + Lambda)^-1; the rows of t are renewed one after the other, P_s follows by rank one
//   backwards  the future and the rows of t as Lambda, eta; N = (Lambda^-1 + P_p)^-1, r = (I + Lambda P_p)^-1 (eta - Lambda m_p),
//              so that w_t has posterior mean m + D r and covariance D - D N D (with G: G' r, G' N G), and its cavity is
//              c = 1/N_ii - D_i, mu = m_i + r_i / N_ii; N and r follow each renewed site by rank one. Then
//              Lambda_b <- A' (Lambda^-1 + Q + G D G')^-1 A one step back.
//
// Moments forwards and information backwards: noise of variance 0 and outputs that say nothing are no special cases.
// Evidence: log Z = sum over sites of (log Z_k - log of the site's integral under its cavity) + the Gaussian's own; at a
// fixed point its derivative in a parameter of f_k is that of log Z_k alone.
//
// Members (same rows, other half-widths or matrices) run side by side, one a lane.
#pragma once

#include "chain.hpp"
#include "ep_entry.hpp"
#include "lane.hpp"
#include "noise.hpp"

namespace hw {
namespace HW_ISA {

typedef Lanes<wide_lanes> V;
typedef V::Raw X;

inline V of(X a) { return V::of(a); }
inline V smaller(const V& a, const V& b) { return V::of(min4(a.v, b.v)); }
inline V root(const V& a) { return V::of(root4(a.v)); }
inline V over(const V& a) { return V::of(over4(a.v)); }
inline V log_of(const V& a) { return V::of(log4(a.v)); }
inline V either(decltype(X{} < X{}) test, const V& a, const V& b) { return V::of(test ? a.v : b.v); }

constexpr int shape_reach = 4;  // rows over which factors that are not Gaussian act together

// sizes of local arrays
template <class N>
constexpr int ep_cap = N::fixed ? N::cap : ep_states;

// L (n,n) = the unit lower factor of a positive semidefinite M (n,n), M = L D L', with D on its diagonal; directions below
// rounding are left out
template <class N>
inline void ep_parts(N n, const V* M, V* L) {
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) L[i * n + j] = M[i * n + j];
    for (int j = 0; j < n; j++) {
        const V p = L[j * n + j], floor = V(1e-14) * M[j * n + j] + V(1e-300);
        const V inverse = either(p.v > floor.v, over(p), V(0.0));
        L[j * n + j] = either(p.v > floor.v, p, V(0.0));
        for (int i = j + 1; i < n; i++) {
            const V share = L[i * n + j] * inverse;
            for (int k = j + 1; k <= i; k++) L[i * n + k] -= share * L[k * n + j];
        }
        for (int i = j + 1; i < n; i++) L[i * n + j] *= inverse;
    }
}

// out (n,n) = ((L D L')^-1 + M)^-1 = L (D^-1 + L' M L)^-1 L' for the parts of `ep_parts` and a symmetric M >= 0. With
// X = L' M L, D^-1 + X has the pivots (1 + D_j X_jj) / D_j: nothing is divided by but what is at least 1.
template <class N>
inline void ep_join(N n, const V* L, const V* M, V* out) {
    constexpr int c = ep_cap<N>;
    V S[c * c], Y[c * c];
    for (int i = 0; i < n; i++)  // Y = M L
        for (int j = 0; j < n; j++) {
            V s = M[i * n + j];
            for (int k = j + 1; k < n; k++) s += M[i * n + k] * L[k * n + j];
            Y[i * n + j] = s;
        }
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) {
            V s = Y[i * n + j];
            for (int k = i + 1; k < n; k++) s += L[k * n + i] * Y[k * n + j];
            S[i * n + j] = s;
        }
    for (int j = 0; j < n; j++) {  // S = unit lower factor of D^-1 + X below the diagonal, 1 / pivot on it
        const V pivot = V(1.0) + L[j * n + j] * S[j * n + j];
        const V part = either(pivot.v > X{}, L[j * n + j] * over(pivot), V(0.0));  // lost to rounding: left out
        for (int i = j + 1; i < n; i++) {
            const V share = S[i * n + j] * part;
            for (int k = j + 1; k <= i; k++) S[i * n + k] -= share * S[k * n + j];
        }
        for (int i = j + 1; i < n; i++) S[i * n + j] *= part;
        S[j * n + j] = part;
    }
    for (int j = 0; j < n; j++) {  // row j of L is column j of L'
        V* y = Y + j * n;
        for (int i = 0; i < n; i++) y[i] = i < j ? L[j * n + i] : V(i == j ? 1.0 : 0.0);
        unit_lower(n, S, y);
    }
    for (int i = 0; i < n; i++) {
        V scaled[c];
        for (int k = 0; k < n; k++) scaled[k] = Y[i * n + k] * S[k * n + k];
        for (int j = 0; j <= i; j++) {
            V s(0.0);
            for (int k = 0; k < n; k++) s += scaled[k] * Y[j * n + k];
            out[i * n + j] = out[j * n + i] = s;
        }
    }
}

// A sum of logarithms: of products as far as they neither overflow nor lose digits.
struct Logs {
    V sum, product;
    inline void clear() {
        sum = V(0.0);
        product = V(1.0);
    }
    inline void add(const V& a) {
        const V p = product * a;
        if (any4(~((p.v > all<X>(1e-200)) & (p.v < all<X>(1e200))))) {
            sum += log_of(product) + log_of(a);
            product = V(1.0);
        } else {
            product = p;
        }
    }
    inline V value() const { return sum + log_of(product); }
};

// A stack of matrices for one block of members, brought into lanes.
struct EpBlock {
    int first, last;  // members first, first + 1, ..., held at `last`
    inline V load(const EpStack& s, std::ptrdiff_t at) const {
        if (s.member == 0) return V(s.data[at]);
        V v;
        for (int l = 0; l < wide_lanes; l++) {
            const int k = first + l < last ? first + l : last;
            v.set(l, s.data[k * s.member + at]);
        }
        return v;
    }
    inline void loads(const EpStack& s, int t, int size, V* out) const {
        const std::ptrdiff_t k = s.index ? s.index[t] : s.count == 1 ? 0 : t;
        for (int i = 0; i < size; i++) out[i] = load(s, k * size + i);
    }
};

// What a block of members holds between sweeps; symmetric matrices as packed lower triangles. Workspace of the caller.
struct EpState {
    V *mp, *Pp;    // (T+1, n), (T+1, n(n+1)/2): predicted
    V *eb, *Lb;    // (T+1, n), (T+1, n(n+1)/2): the future's message
    V *m, *D;      // (T+1, n): sites of w; those of x_0 in row 0
    V *tau, *nu;   // (rows,): sites of rows, of the residual
    V *s;          // (groups,)
    V *log_box;    // (groups,): log of the width of a box of each, while evidence is looked at
    V eps;         // rate of outliers or losses
    signed char *axis;   // (rows,): the state that a row is a residual of, -1: of several
    signed char *bends;  // (rows,): whether its tilted cumulants count
};

// What a sweep finds.
struct EpFound {
    V residual;   // largest distance of a site's moments from the belief's, in standard deviations; its square in a sweep
    V log_z;      // evidence
    V* slope;     // (groups + 1,): d log Z / d log s, d log Z / d logit eps
    V* learned;   // (groups,): sum over the rows of a half-width of (1 - posterior / prior variance)^2
    V worst;      // smallest log of the share of a cavity that lies in its factor's box
    V top;        // what the evidence cannot exceed: every row as dense as its noise can be
    V far;        // largest squared distance of a site's mean from its cavity's, in the cavity's variances
    Logs above, below;  // of log Z: half of what these sum up to is added and taken off
};

// What the shapes of the beliefs need, filled by `look`; null pointers: not wanted.
struct EpCross {
    V *S, *Pf;  // (T+1, n, n): covariance of x_t given all; given what lies up to t, then the inverse of S
    V *B;       // (T+1, n, n): covariance of x_{t-1} with x_t
    V *X0, *X1; // (T+1, n, n): covariance of x_{t-1} and of x_t with w_t
    V *W;       // (T+1, n, n): covariance of w_t
    V *w3, *w4; // (T+1, n): cumulants of the sites of w over the variance's powers 3 and 4
    V *r3, *r4; // (rows,): of the rows
    V *x3, *x4; // (T+1, n): third and fourth cumulants of the states
};

template <class N>
struct Ep {
    static constexpr int cap = ep_cap<N>;
    static constexpr int abreast = 3;  // sites of a stage that are renewed at a time
    N n;
    const EpArgs& a;
    EpBlock block;
    EpState s;
    EpCross cross;
    int shaped = 0;  // first stage whose shape is asked for
    // A bound farther off than the root of `reach` standard deviations, or one that narrows its cavity's variance by a
    // share below `faint`, says nothing at the precision that is asked for.
    double reach = 72.0, faint = 1e-13;
    bool mixed = false;  // rows with two explanations
    bool lone = false;   // one member: its sites take the lanes

    // whether a shape that is asked for needs the cumulants of stage t
    inline bool bent(int) const { return cross.S; }  // `second` asks for all
    inline int packed() const { return n * (n + 1) / 2; }
    inline void unpack(const V* p, V* M) const {
        for (int i = 0; i < n; i++)
            for (int j = 0; j <= i; j++) M[i * n + j] = M[j * n + i] = p[tri(i, j)];
    }
    inline void pack(const V* M, V* p) const {
        for (int i = 0; i < n; i++)
            for (int j = 0; j <= i; j++) p[tri(i, j)] = M[i * n + j];
    }
    inline int kind(int k) const { return a.kind[k]; }

    // half-width of w_i at stage t (stage 0: of the box of x_0), 0: no site
    inline bool has_site(int t, int i) const { return t == 0 ? a.half0[i] > 0.0 : a.group_w[i] >= 0; }
    inline V width(int t, int i) const { return t == 0 ? V(a.half0[i]) : s.s[a.group_w[i]]; }

    // variance of the Gaussian part of w_i that has a group of its own
    inline bool fitted(int i) const { return a.group_Q && a.group_Q[i] >= 0; }
    inline V power(int i) const { return s.s[a.group_Q[i]] * s.s[a.group_Q[i]]; }

    // variance of a row's Gaussian part: its own, what its group has, and what unseen correlated outputs add
    inline V variance(int k) const {
        V R(a.R[k]);
        if (a.group_R && a.group_R[k] >= 0) R += s.s[a.group_R[k]] * s.s[a.group_R[k]];
        if (a.mix)
            for (int g = 0; g < a.groups; g++)
                if (a.mix[static_cast<std::ptrdiff_t>(k) * a.groups + g] != 0.0)
                    R += V(a.mix[static_cast<std::ptrdiff_t>(k) * a.groups + g]) * s.s[g] * s.s[g];
        return R;
    }

    template <int depth>
    inline Tilted<X> tilted(int k, const Cavity<X>& q) const {
        switch (kind(k)) {
            case ep_truncation: {
                const Truncated<X> t = cut4<depth>(q, all<X>(a.lo[k]), all<X>(a.hi[k]));
                Tilted<X> r{};
                r.mean = t.mean;
                r.var = t.var;
                if (depth >= evidence) r.log_z = t.log_z();
                if (depth == cumulants) {
                    r.k3 = t.k3;
                    r.k4 = t.k4;
                }
                return r;
            }
            case noise_uniform: return uniform4<depth>(q, s.s[a.group[k]].v);
            case noise_uniform_gaussian: return uniform_gaussian4<depth>(q, s.s[a.group[k]].v, variance(k).v);
            case noise_contaminated:
                return contaminated4<depth>(q, s.s[a.group[k]].v, variance(k).v, s.eps.v, all<X>(a.wide));
            default:
                return maybe_lost4<depth>(q, a.group[k] >= 0 ? s.s[a.group[k]].v : X{}, variance(k).v, s.eps.v,
                                          all<X>(a.lost[k]));
        }
    }

    // ---- start: every uniform as the Gaussian of its variance ----------------------------------------------------

    void start() {
        for (int t = 0; t <= a.T; t++)
            for (int i = 0; i < n; i++) start_noise(t, i);
        for (int k = 0; k < a.rows; k++) start_row(k);
        forget();
    }
    void start_noise(int t, int i) {
        const V w = has_site(t, i) ? width(t, i) : V(0.0);
        s.m[t * n + i] = V(0.0);
        s.D[t * n + i] = w * w * V(1.0 / 3.0);
    }
    void start_row(int k) {
        s.nu[k] = V(0.0);
        if (kind(k) == noise_gaussian) {
            s.tau[k] = V(1.0) / variance(k);
        } else if (kind(k) >= noise_contaminated) {  // bounds, and rows that may say nothing: not until they are asked
            s.tau[k] = V(0.0);
        } else {
            const V w = a.group[k] >= 0 ? s.s[a.group[k]] : V(0.0);
            s.tau[k] = V(1.0) / (w * w * V(1.0 / 3.0) + variance(k));
        }
    }

    // Gaussian rows are their own sites, whatever they were taken from
    void fix() {
        for (int k = 0; k < a.rows && (a.group_R || a.mix); k++)
            if (kind(k) == noise_gaussian) {
                s.tau[k] = V(1.0) / variance(k);
                s.nu[k] = V(0.0);
            }
    }

    // no message from the future
    void forget() {
        for (int k = 0; k < (a.T + 1) * n; k++) s.eb[k] = V(0.0);
        for (int k = 0; k < (a.T + 1) * packed(); k++) s.Lb[k] = V(0.0);
    }

    // ---- a stage -------------------------------------------------------------------------------------------------

    // predicted moments of x_0
    inline void prior(V* mp, V* Pp) const {
        for (int i = 0; i < n; i++) {
            mp[i] = V(a.m0[i]) + s.m[i];
            for (int j = 0; j < n; j++) Pp[i * n + j] = V(a.P0[i * n + j]);
            Pp[i * n + i] += s.D[i];
        }
    }

    // Q + G D G' of stage t >= 1 and the mean b + G m of what is added
    inline void noise(int t, const V* G, V* Q, V* d) const {
        const V *D = s.D + t * n, *m = s.m + t * n;
        if (a.Q.data) block.loads(a.Q, t - 1, n * n, Q);
        else
            for (int i = 0; i < n * n; i++) Q[i] = V(0.0);
        for (int i = 0; i < n; i++) d[i] = block.load(a.b, static_cast<std::ptrdiff_t>(t - 1) * n + i);
        V own[cap];
        if (a.group_Q) {
            for (int i = 0; i < n; i++) own[i] = fitted(i) ? D[i] + power(i) : D[i];
            D = own;
        }
        if (a.G.data) {
            for (int i = 0; i < n; i++)
                for (int k = 0; k < n; k++) {
                    const V g = G[i * n + k] * D[k];
                    d[i] += G[i * n + k] * m[k];
                    for (int j = 0; j < n; j++) Q[i * n + j] += g * G[j * n + k];
                }
        } else {
            for (int i = 0; i < n; i++) {
                Q[i * n + i] += D[i];
                d[i] += m[i];
            }
        }
    }

    // Lambda, eta: the future's message and the rows of t
    [[gnu::always_inline]] inline void ahead(int t, V* Lambda, V* eta) const {
        const V* Lb = s.Lb + t * packed();
        for (int i = 0; i < n; i++)
            for (int j = 0; j <= i; j++) Lambda[i * n + j] = Lb[tri(i, j)];
        for (int i = 0; i < n; i++) eta[i] = s.eb[t * n + i];
        for (int k = a.start[t]; k < a.start[t + 1]; k++) {
            if (silent(k)) continue;
            const V lift = s.nu[k] + s.tau[k] * target(k);
            if (const int i = s.axis[k]; i >= 0) {
                eta[i] += lift;
                Lambda[i * n + i] += s.tau[k];
                continue;
            }
            V h[cap];
            row(k, h);
            for (int i = 0; i < n; i++) {
                const V th = s.tau[k] * h[i];
                eta[i] += lift * h[i];
                for (int j = 0; j <= i; j++) Lambda[i * n + j] += th * h[j];
            }
        }
        for (int i = 0; i < n; i++)
            for (int j = 0; j < i; j++) Lambda[j * n + i] = Lambda[i * n + j];
    }
    inline bool single(int k) const { return kind(k) < noise_contaminated || kind(k) == ep_truncation; }
    // a bound that no lane has come near
    inline bool silent(int k) const { return kind(k) == ep_truncation && !any4(s.tau[k].v != X{}); }
    inline void row(int k, V* h) const {
        const std::ptrdiff_t at = static_cast<std::ptrdiff_t>(k) * n;
        if (a.h.member == 0)
            for (int i = 0; i < n; i++) h[i] = V(a.h.data[at + i]);
        else
            for (int i = 0; i < n; i++) h[i] = block.load(a.h, at + i);
    }
    // which rows are residuals of one state
    void axes() {
        for (int k = 0; k < a.rows; k++) {
            int found = -1, others = a.h.member != 0;
            const double* h = a.h.data + static_cast<std::ptrdiff_t>(k) * n;
            for (int i = 0; i < n; i++) {
                if (h[i] == 1.0) found = i;
                else others += h[i] != 0.0;
            }
            for (int i = 0; i < n; i++) others += h[i] == 1.0 && i != found;
            s.axis[k] = static_cast<signed char>(others ? -1 : found);
        }
    }
    inline V target(int k) const { return block.load(a.y, k); }

    // log of the integral of exp(nu z - tau z^2 / 2) under N(mu, v) is half of this less log f, f = 1 + tau v
    static inline V integral(const V& tau, const V& nu, const V& mu, const V& v, const V& over_f) {
        return (nu * nu * v + V(2.0) * nu * mu - tau * mu * mu) * over_f;
    }

    // moments (mean, var) of the belief against those that its factor asks for; over = 1 / var of the factor
    static inline void note(EpFound& f, const V& mean, const V& var, const V& tm, const V& tv, const V& over, const Cavity<X>& q) {
        // a factor that would widen the belief has an empty site: nothing to agree on
        const V off = tm - of(q.mu), d = tm - mean, e = (tv - var) * over, scale = of(q.scale);
        f.far = larger(f.far, off * off * scale * scale);
        const V gap = larger(d * d * over, e * e);
        f.residual = larger(f.residual, either(tv.v >= q.c * (1.0 - 1e-9), V(0.0), gap));
    }

    // residual z, its variance v and covariance Ph with x_t, of row k in a belief
    [[gnu::always_inline]] inline void project(int k, const V* ms, const V* Ps, V* Ph, V* z, V* v) const {
        if (const int i = s.axis[k]; i >= 0) {
            *z = ms[i] - target(k);
            *v = Ps[i * n + i];
            for (int j = 0; j < n; j++) Ph[j] = Ps[i * n + j];
            return;
        }
        V h[cap], mean = -target(k), var(0.0);
        row(k, h);
        for (int i = 0; i < n; i++) {
            V q = Ps[i * n] * h[0];
            for (int j = 1; j < n; j++) q += Ps[i * n + j] * h[j];
            Ph[i] = q;
            var += h[i] * q;
            mean += h[i] * ms[i];
        }
        *z = mean;
        *v = var;
    }

    // what a site on a residual of covariance Ph with the state makes of its belief ms, Ps
    inline void turn_by(const V* Ph, const V& shift, const V& shrink, V* ms, V* Ps) const {
        for (int i = 0; i < n; i++) {
            ms[i] += Ph[i] * shift;
            const V g = Ph[i] * shrink;
            for (int j = 0; j <= i; j++) Ps[j * n + i] = Ps[i * n + j] -= g * Ph[j];
        }
    }

    // renew (or, for the evidence, look at) the rows of stage t given the belief ms, Ps about x_t; fold each into the
    // filtered mf, Pf. Rows are renewed `abreast` at a time from one belief, so that their moments do not wait for each
    // other, unless they have two explanations.
    template <bool renew>
    inline void rows(int t, V* ms, V* Ps, V* mf, V* Pf, EpFound& f, double damping) {
        const int end = a.start[t + 1];
        for (int k = a.start[t]; k < end;) {
            const int from = k;
            V Ph[abreast][cap], z[abreast], v[abreast];
            int says[abreast], count = 0;
            for (; k < end && k < from + abreast && (k == from || (single(k) && single(from))); k++) {
                if constexpr (!renew) {
                    f.top += densest(k);
                    if (bent(t)) cross.r3[k] = cross.r4[k] = V(0.0);
                    if (kind(k) == noise_gaussian) {
                        f.log_z -= V(0.5 * log_2pi);
                        f.below.add(variance(k));
                        if (a.group_R || a.mix) gaussian_slopes(k, ms, Ps, f);
                    }
                }
                if (kind(k) == noise_gaussian) {
                    fold<renew>(k, mf, Pf, f);
                    continue;
                }
                if (silent(k) && out_of_reach(k, ms, Ps)) continue;
                project(k, ms, Ps, Ph[count], z + count, v + count);
                says[count++] = k;
            }
            if constexpr (renew) {
                V dt[abreast], dn[abreast];
                if (!lone || !propose_lanes(count, says, z, v, dt, dn, f)) propose_each(count, says, z, v, dt, dn, f, damping);
                for (int c = 0; c < count; c++) {
                    if (c > 0) project(says[c], ms, Ps, Ph[c], z + c, v + c);
                    const V gain = over(larger(V(1.0) + dt[c] * v[c], V(1e-12)));
                    s.tau[says[c]] += dt[c];
                    s.nu[says[c]] += dn[c];
                    turn_by(Ph[c], (dn[c] - dt[c] * z[c]) * gain, dt[c] * gain, ms, Ps);
                    fold<renew>(says[c], mf, Pf, f);
                }
            } else {
                for (int c = 0; c < count; c++) {
                    look_at(t, says[c], z[c], v[c], cavity_of(s.tau[says[c]], s.nu[says[c]], z[c], larger(v[c], V(1e-300))), f);
                    fold<renew>(says[c], mf, Pf, f);
                }
            }
        }
    }
    // the changes of some rows' sites, one after the other
    inline void propose_each(int count, const int* says, const V* z, const V* v, V* dt, V* dn, EpFound& f, double damping) const {
        Cavity<X> cavity[abreast];
        V spread[abreast], mean[abreast], var[abreast];
        for (int c = 0; c < count; c++) {
            spread[c] = larger(v[c], V(1e-300));
            cavity[c] = cavity_of(s.tau[says[c]], s.nu[says[c]], z[c], spread[c]);
        }
        for (int c = 0; c < count; c++) {
            const int k = says[c];
            if (boxed(k)) {
                const Truncated<X> q = cut4<moments>(cavity[c], low(k).v, high(k).v);
                mean[c] = of(q.mean);
                var[c] = of(q.var);
            } else {
                const Tilted<X> q = tilted<moments>(k, cavity[c]);
                mean[c] = of(q.mean);
                var[c] = of(q.var);
            }
        }
        for (int c = 0; c < count; c++) {
            const int k = says[c];
            // by what the site changes: a site that stays leaves the belief as it is, whatever rounding made of v
            const V step(single(k) ? 1.0 : damping);
            propose(s.tau[k], s.nu[k], z[c], spread[c], cavity[c], mean[c], var[c], V(least(k)), dt + c, dn + c, f);
            dt[c] = step * dt[c];
            dn[c] = step * dn[c];
        }
    }
    // Those of one member, all at a time, a row a lane; false where they are no boxes.
    [[gnu::always_inline]] inline bool propose_lanes(int count, const int* says, const V* z, const V* v, V* dt, V* dn, EpFound& f) const {
        for (int c = 0; c < count; c++)
            if (!boxed(says[c])) return false;
        if (count == 0) return true;
        const auto lane = [&](const auto& each) { return in_lanes(count, [&](int c) { return each(says[c]); }); };
        const V own = lane([&](int k) { return s.tau[k]; }), first = lane([&](int k) { return s.nu[k]; });
        const V lo = lane([&](int k) { return low(k); }), hi = lane([&](int k) { return high(k); });
        const V share = lane([&](int k) { return V(least(k)); });
        const V at = in_lanes(count, [&](int c) { return z[c]; }), spread = in_lanes(count, [&](int c) { return larger(v[c], V(1e-300)); });
        const Cavity<X> cavity = cavity_of(own, first, at, spread);
        const Truncated<X> q = cut4<moments>(cavity, lo.v, hi.v);
        V turn, move;
        propose(own, first, at, spread, cavity, of(q.mean), of(q.var), share, &turn, &move, f);
        for (int c = 0; c < count; c++) {
            dt[c] = V(turn[c]);
            dn[c] = V(move[c]);
        }
        return true;
    }
    inline bool boxed(int k) const { return kind(k) == noise_uniform || kind(k) == ep_truncation; }
    // ends of its box
    inline V low(int k) const { return kind(k) == noise_uniform ? -s.s[a.group[k]] : V(a.lo[k]); }
    inline V high(int k) const { return kind(k) == noise_uniform ? s.s[a.group[k]] : V(a.hi[k]); }
    // of (0), of (1), ... each the same in all its lanes, one a lane; the others as the first
    template <class Each>
    static inline V in_lanes(int count, const Each& each) {
        typedef decltype(X{} < X{}) Whole;
        static const Whole lane[abreast] = {Whole{-1}, Whole{0, -1}, Whole{0, 0, -1}};
        V one = each(0);
        for (int c = 1; c < count; c++) one = either(lane[c], each(c), one);
        return one;
    }
    // share of a cavity's variance below which a factor must leave that of row k
    inline double least(int k) const { return 1.0 - (kind(k) == ep_truncation ? faint : 1e-13); }
    // d log Z / d log R = ((z^2 + v) / R - 1) / 2 of a Gaussian row whose residual has the posterior N(z, v)
    inline void gaussian_slopes(int k, const V* ms, const V* Ps, EpFound& f) const {
        V Ph[cap], z, v;
        project(k, ms, Ps, Ph, &z, &v);
        Tilted<X> q{};
        const V R = variance(k);
        q.slope_R = (V(0.5) * ((z * z + v) / R - V(1.0))).v;
        slopes(k, q, v, f);
    }
    // both ends of a bound out of reach in every lane
    inline bool out_of_reach(int k, const V* ms, const V* Ps) const {
        V z, v;
        if (const int i = s.axis[k]; i >= 0) {
            z = ms[i] - target(k);
            v = Ps[i * n + i];
        } else {
            V Ph[cap];
            project(k, ms, Ps, Ph, &z, &v);
        }
        const X up = a.hi[k] - z.v, down = z.v - a.lo[k], least = reach * v.v + 1e-300, near = min4(up, down);
        return !any4((near < X{}) | (near * near < least) | (v.v != v.v));
    }

    // the cavity of a row; a site that claims all that the belief has, or more, is a bad one and is taken as nothing
    static inline Cavity<X> cavity_of(const V& tau, const V& nu, const V& z, const V& v) {
        const V open = larger(V(1.0) - tau * v, V(1e-9)), over_open = over(open);
        const V c = smaller(v * over_open, V(1e300)), mu = (z - v * nu) * over_open, scale = root(open * over(v));
        return {mu.v, c.v, (c * scale).v, scale.v};
    }

    // the change of a row's site that reproduces the moments of its factor, which count where it leaves less than the share
    // `most` of the cavity's variance
    static inline void propose(const V& own, const V& first, const V& z, const V& v, const Cavity<X>& cavity, const V& mean, const V& var,
                               const V& most, V* dt, V* dn, EpFound& f) {
        const V scale = of(cavity.scale), w = scale * scale, tv = larger(var, V(1e-300)), over_tv = over(tv);
        note(f, z, v, mean, tv, over_tv, cavity);
        const auto says = tv.v < cavity.c * most.v;  // else the factor widens the belief: nothing for now
        *dt = either(says, over_tv - w, V(0.0)) - own;
        *dn = either(says, mean * over_tv - of(cavity.mu) * w, V(0.0)) - first;
    }

    inline void look_at(int t, int k, const V& z, const V& spread, const Cavity<X>& cavity, EpFound& f) {
        const V v = larger(spread, V(1e-300));
        const Tilted<X> q = bent(t) ? tilted<cumulants>(k, cavity) : tilted<evidence>(k, cavity);
        const V tv = larger(of(q.var), V(1e-300));
        note(f, z, v, of(q.mean), tv, over(tv), cavity);
        const V left = V(1.0) + s.tau[k] * of(cavity.c);
        f.log_z += of(q.log_z) - V(0.5) * integral(s.tau[k], s.nu[k], of(cavity.mu), of(cavity.c), over(left));
        f.above.add(left);
        f.worst = smaller(f.worst, of(q.log_z) + unit(k));
        slopes(k, q, v, f);
        if (bent(t)) ratios(q, v, cross.r3 + k, cross.r4 + k);
        if (a.out) {
            for (int l = 0; l < wide_lanes && block.first + l <= block.last; l++)
                a.out[static_cast<std::ptrdiff_t>(block.first + l) * a.rows + k] = q.out[l];
        }
    }

    // site of row k into the filtered moments mf, Pf
    template <bool renew>
    inline void fold(int k, V* mf, V* Pf, EpFound& f) {
        V Ph[cap], z, v;
        project(k, mf, Pf, Ph, &z, &v);
        const V tau = s.tau[k], left = V(1.0) + tau * v, gain = over(left);
        if constexpr (!renew) {
            f.log_z += V(0.5) * integral(tau, s.nu[k], z, v, gain);
            f.below.add(left);
        }
        turn_by(Ph, (s.nu[k] - tau * z) * gain, tau * gain, mf, Pf);
    }

    // log of the width of a row's box: with it the log of a density becomes that of a share
    inline V unit(int k) const { return kind(k) != ep_truncation && a.group[k] >= 0 ? s.log_box[a.group[k]] : V(0.0); }

    // log of the largest density of a row's noise
    inline V densest(int k) const {
        if (kind(k) == ep_truncation) return V(0.0);
        const V box = a.group[k] >= 0 ? -s.log_box[a.group[k]] : V(690.0);
        if (kind(k) == noise_uniform && !a.mix) return smaller(box, V(345.0));
        const V bell = V(-0.5) * log_of(V(6.283185307179586) * variance(k) + V(1e-300)), most = smaller(box, bell);
        return kind(k) == noise_maybe_lost ? larger(most, V(a.lost[k])) : most;
    }

    inline void slopes(int k, const Tilted<X>& q, const V& v, EpFound& f) const {
        if (kind(k) == ep_truncation) return;
        if (a.group[k] >= 0) {
            f.slope[a.group[k]] += of(q.slope_s);
            const V own = s.s[a.group[k]] * s.s[a.group[k]] * V(1.0 / 3.0), all = larger(own + variance(k), V(1e-300));
            const V share = larger(V(1.0) - v / all, V(0.0)) * own / all;
            f.learned[a.group[k]] += share * share;
        }
        if (a.group_R && a.group_R[k] >= 0) {
            const V own = s.s[a.group_R[k]] * s.s[a.group_R[k]], R = larger(variance(k), V(1e-300));
            const V box = a.group[k] >= 0 ? s.s[a.group[k]] * s.s[a.group[k]] * V(1.0 / 3.0) : V(0.0), all = box + R;
            f.slope[a.group_R[k]] += of(q.slope_R) * V(2.0) * own / R;
            const V share = larger(V(1.0) - v / all, V(0.0)) * own / all;
            f.learned[a.group_R[k]] += share * share;
        }
        if (a.mix) {
            const V R = larger(variance(k), V(1e-300));
            for (int g = 0; g < a.groups; g++) {
                const double w = a.mix[static_cast<std::ptrdiff_t>(k) * a.groups + g];
                if (w != 0.0) f.slope[g] += of(q.slope_R) * V(2.0 * w) * s.s[g] * s.s[g] / R;
            }
        }
        f.slope[a.groups] += of(q.slope_eps);
    }

    // mp, Pp of stage t >= 1 from the filtered mf, Pf of the one before
    inline void predict(int t, const V* A, const V* G, const V* mf, const V* Pf, V* mp, V* Pp) const {
        V AP[cap * cap];
        noise(t, G, Pp, mp);
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                V q(0.0);
                for (int k = 0; k < n; k++) q += A[i * n + k] * Pf[k * n + j];
                AP[i * n + j] = q;
                mp[i] += A[i * n + j] * mf[j];
            }
        for (int i = 0; i < n; i++)
            for (int j = 0; j <= i; j++) {
                V q = Pp[i * n + j];
                for (int k = 0; k < n; k++) q += AP[i * n + k] * A[j * n + k];
                Pp[i * n + j] = Pp[j * n + i] = q;
            }
    }

    // the predicted moments of the sites as they are
    void filter() {
        V A[cap * cap], G[cap * cap] = {}, mf[cap] = {}, Pf[cap * cap] = {};
        EpFound none{};
        for (int t = 0; t <= a.T; t++) {
            V mp[cap], Pp[cap * cap];
            if (t == 0) {
                prior(mp, Pp);
            } else {
                block.loads(a.A, t - 1, n * n, A);
                if (a.G.data) block.loads(a.G, t - 1, n * n, G);
                predict(t, A, G, mf, Pf, mp, Pp);
            }
            for (int i = 0; i < n; i++) s.mp[t * n + i] = mf[i] = mp[i];
            pack(Pp, s.Pp + t * packed());
            for (int i = 0; i < n * n; i++) Pf[i] = Pp[i];
            for (int k = a.start[t]; k < a.start[t + 1]; k++) {
                if (!silent(k)) fold<true>(k, mf, Pf, none);
            }
        }
    }

    // ---- the two halves of a sweep -------------------------------------------------------------------------------

    // Whether every lane that is alive has agreed within `quiet` in a stage, after `before` in those gone over so far.
    bool still(EpFound& f, const V& before, double quiet) const {
        bool calm = quiet > 0.0;
        for (int l = 0; calm && l < wide_lanes; l++) calm = !alive(f, l) || f.residual[l] < quiet * quiet;
        f.residual = larger(before, f.residual);
        return calm;
    }

    // From stage `from` on, whose predicted moments are known where it is not the first, to the second of two in a row that
    // are still; returns it.
    template <bool renew>
    int forward(EpFound& f, double damping, int from = 0, double quiet = 0.0) {
        int calm = 0;
        V A[cap * cap], G[cap * cap], mf[cap] = {}, Pf[cap * cap] = {};
        if (a.A.count == 1 && a.T > 0) block.loads(a.A, 0, n * n, A);
        if (a.G.data && a.G.count == 1 && a.T > 0) block.loads(a.G, 0, n * n, G);
        for (int t = from; t <= a.T; t++) {
            V mp[cap], Pp[cap * cap];
            if (t == 0) {
                prior(mp, Pp);
            } else if (t == from) {
                for (int i = 0; i < n; i++) mp[i] = s.mp[t * n + i];
                unpack(s.Pp + t * packed(), Pp);
            } else {
                if (a.A.count != 1) block.loads(a.A, t - 1, n * n, A);
                if (a.G.data && a.G.count != 1) block.loads(a.G, t - 1, n * n, G);
                predict(t, A, G, mf, Pf, mp, Pp);
            }
            for (int i = 0; i < n; i++) s.mp[t * n + i] = mp[i];
            pack(Pp, s.Pp + t * packed());
            for (int i = 0; i < n; i++) mf[i] = mp[i];
            for (int i = 0; i < n * n; i++) Pf[i] = Pp[i];
            if (a.start[t] < a.start[t + 1] || !renew) {
                V Lambda[cap * cap], eta[cap], L[cap * cap], ms[cap], Ps[cap * cap];
                ahead(t, Lambda, eta);
                ep_parts(n, Pp, L);
                ep_join(n, L, Lambda, Ps);
                for (int i = 0; i < n; i++)
                    for (int j = 0; j < n; j++) eta[i] -= Lambda[i * n + j] * mp[j];
                for (int i = 0; i < n; i++) {
                    ms[i] = mp[i];
                    for (int j = 0; j < n; j++) ms[i] += Ps[i * n + j] * eta[j];
                }
                if (!renew && cross.S) {
                    give(t, ms, Ps);
                    for (int i = 0; i < n * n; i++) cross.S[t * n * n + i] = Ps[i];
                }
                const V before = f.residual;
                if (renew) f.residual = V(0.0);
                rows<renew>(t, ms, Ps, mf, Pf, f, damping);
                if (renew) {
                    calm = still(f, before, quiet) ? calm + 1 : 0;
                    if (calm == 2) return t;
                }
            }
            if (!renew && bent(t + 1))
                for (int i = 0; i < n * n; i++) cross.Pf[t * n * n + i] = Pf[i];
        }
        return a.T;
    }

    // From stage `from` back to the second of two in a row that are still; returns it.
    template <bool renew>
    int backward(EpFound& f, int from, double quiet = 0.0) {
        int calm = 0;
        V A[cap * cap], G[cap * cap];
        if (a.A.count == 1 && a.T > 0) block.loads(a.A, 0, n * n, A);
        if (a.G.data && a.G.count == 1 && a.T > 0) block.loads(a.G, 0, n * n, G);
        for (int t = from; t >= 0; t--) {
            V Lambda[cap * cap], eta[cap], Pp[cap * cap], U[cap * cap], W[cap * cap], r[cap], gap[cap];
            if (t > 0) {
                if (a.A.count != 1) block.loads(a.A, t - 1, n * n, A);
                if (a.G.data && a.G.count != 1) block.loads(a.G, t - 1, n * n, G);
            }
            ahead(t, Lambda, eta);
            unpack(s.Pp + t * packed(), Pp);
            ep_parts(n, Lambda, U);
            ep_join(n, U, Pp, W);
            for (int i = 0; i < n; i++) {
                gap[i] = eta[i];
                for (int j = 0; j < n; j++) gap[i] -= Lambda[i * n + j] * s.mp[t * n + j];
            }
            less(W, Pp, gap, r);
            if (!renew && bent(t)) {
                covariances(t, A, G, W, Pp);
                inverse(cross.S + t * n * n, cross.Pf + t * n * n);
            }
            if (t > 0 && a.G.data) turn(G, W, r);
            const V before = f.residual;
            if (renew) f.residual = V(0.0);
            sites<renew>(t, W, r, f);
            if (t > 0) pass_on(t, A, G, Lambda, eta, U);
            if (renew) {
                calm = still(f, before, quiet) ? calm + 1 : 0;
                if (calm == 2) return t;
            }
        }
        return 0;
    }

    // Lambda, eta of t and the root U of Lambda become the message to t - 1
    inline void pass_on(int t, const V* A, const V* G, const V* Lambda, V* eta, const V* U) {
        V Q[cap * cap], d[cap], W[cap * cap], WA[cap * cap], r[cap];
        noise(t, G, Q, d);
        ep_join(n, U, Q, W);
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) eta[i] -= Lambda[i * n + j] * d[j];
        less(W, Q, eta, r);
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                V q(0.0);
                for (int k = 0; k < n; k++) q += W[i * n + k] * A[k * n + j];
                WA[i * n + j] = q;
            }
        V *eb = s.eb + (t - 1) * n, *Lb = s.Lb + (t - 1) * packed();
        for (int i = 0; i < n; i++) {
            V q(0.0);
            for (int k = 0; k < n; k++) q += A[k * n + i] * r[k];
            eb[i] = q;
            for (int j = 0; j <= i; j++) {
                V p(0.0);
                for (int k = 0; k < n; k++) p += A[k * n + i] * WA[k * n + j];
                Lb[tri(i, j)] = p;
            }
        }
    }

    inline void nothing_after() {
        for (int i = 0; i < n; i++) s.eb[a.T * n + i] = V(0.0);
        for (int i = 0; i < packed(); i++) s.Lb[a.T * packed() + i] = V(0.0);
    }
    // the future's messages of the sites as they are
    void hear() {
        fix();
        V A[cap * cap], G[cap * cap] = {}, Lambda[cap * cap], eta[cap], U[cap * cap];
        nothing_after();
        for (int t = a.T; t > 0; t--) {
            block.loads(a.A, t - 1, n * n, A);
            if (a.G.data) block.loads(a.G, t - 1, n * n, G);
            ahead(t, Lambda, eta);
            ep_parts(n, Lambda, U);
            pass_on(t, A, G, Lambda, eta, U);
        }
    }

    // covariances of x_{t-1}, x_t and w_t, given W before it is turned by G
    inline void covariances(int t, const V* A, const V* G, const V* W, const V* Pp) const {
        V *B = cross.B + t * n * n, *X0 = cross.X0 + t * n * n, *X1 = cross.X1 + t * n * n, *own = cross.W + t * n * n;
        const V* D = s.D + t * n;
        V WG[cap * cap], left[cap * cap], PA[cap * cap];
        for (int i = 0; i < n; i++)  // W G D and (I - P W) G D
            for (int j = 0; j < n; j++) {
                V q = W[i * n + j];
                if (t > 0 && a.G.data) {
                    q = V(0.0);
                    for (int k = 0; k < n; k++) q += W[i * n + k] * G[k * n + j];
                }
                WG[i * n + j] = q * D[j];
            }
        for (int i = 0; i < n; i++)  // D - D G' W G D
            for (int j = 0; j < n; j++) {
                V q = WG[i * n + j];
                if (t > 0 && a.G.data) {
                    q = V(0.0);
                    for (int k = 0; k < n; k++) q += G[k * n + i] * WG[k * n + j];
                }
                own[i * n + j] = (i == j ? D[i] : V(0.0)) - D[i] * q;
            }
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                V q = t > 0 && a.G.data ? G[i * n + j] * D[j] : i == j ? D[j] : V(0.0);
                V p(i == j ? 1.0 : 0.0);
                for (int k = 0; k < n; k++) {
                    q -= Pp[i * n + k] * WG[k * n + j];
                    p -= W[i * n + k] * Pp[k * n + j];
                }
                X1[i * n + j] = q;
                left[i * n + j] = p;  // I - W P
            }
        if (t == 0) return;
        const V* Pf = cross.Pf + (t - 1) * n * n;
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                V q(0.0);
                for (int k = 0; k < n; k++) q += Pf[i * n + k] * A[j * n + k];
                PA[i * n + j] = q;
            }
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                V q(0.0), p(0.0);
                for (int k = 0; k < n; k++) {
                    q -= PA[i * n + k] * WG[k * n + j];
                    p += PA[i * n + k] * left[k * n + j];
                }
                X0[i * n + j] = q;
                B[i * n + j] = p;
            }
    }

    // What the factors' shapes add, whose tilted distributions have the cumulants k_r, r = 3 and 4. To log Z, to second
    // order (Opper, Paquet and Winther 2013; returned): every two of them k_r k_r' (Cov(z, z') / (Var(z) Var(z')))^r / r!.
    // To the cumulants of a state, to first order (from stage `shaped` on, into k3 and k4, standardised): each of them
    // (Cov(x, z) / Var(z))^r k_r. What is more than `shape_reach` rows away counts as Gaussian: it adds with the r-th power
    // of a small correlation. Log Z leaves out rows with two explanations: theirs is no small correction.
    V second(double* k3, double* k4) const {
        V total(0.0), R[shape_reach][cap * cap], C[shape_reach][cap * cap];
        for (int k = 0; k < a.rows; k++)
            s.bends[k] = kind(k) != noise_gaussian && any4((cross.r3[k].v != X{}) | (cross.r4[k].v != X{}));
        for (int k = 0; k < (a.T + 1) * n; k++) cross.x3[k] = cross.x4[k] = V(0.0);
        for (int t = 0; t <= a.T; t++) {
            V M[cap * cap], W[cap * cap], h[cap], cov[cap];
            int last = 0;
            for (int l = 1; l <= shape_reach && t + l <= a.T; l++) {
                const int u = t + l;
                if (l > 1) {
                    gain(R[l - 2], u - 1, M);
                    product(M, cross.X0 + u * n * n, C[l - 1]);
                    product(M, cross.B + u * n * n, R[l - 1]);
                } else {
                    for (int i = 0; i < n * n; i++) {
                        C[0][i] = cross.X0[u * n * n + i];
                        R[0][i] = cross.B[u * n * n + i];
                    }
                }
                last = l;
            }
            const V *S = cross.S + t * n * n, *X1 = cross.X1 + t * n * n;
            for (int i = 0; i < n; i++)
                for (int j = 0; j < n; j++) M[i * n + j] = X1[j * n + i];
            gain(M, t, W);  // w_t given x_t
            for (int i = 0; i < n; i++) {
                if (!has_site(t, i)) continue;
                const V w3 = cross.w3[t * n + i], w4 = cross.w4[t * n + i], own3 = w3 * V(1.0 / 6.0), own4 = w4 * V(1.0 / 24.0);
                bend(t, M + i * n, w3, w4);
                V sum = with_rows(t, a.start[t], M + i * n, own3, own4);
                for (int j = 0; j < i; j++)
                    sum += pair(cross.W[t * n * n + i * n + j], own3, own4, cross.w3[t * n + j], cross.w4[t * n + j]);
                total += sum + later(t, last, W + i * n, w3, w4, C, R);
            }
            for (int k = a.start[t]; k < a.start[t + 1]; k++) {
                if (!s.bends[k]) continue;
                const V r3 = cross.r3[k], r4 = cross.r4[k];
                row(k, h);
                along(S, h, cov);
                bend(t, cov, r3, r4);
                const V sum = with_rows(t, k + 1, cov, r3 * V(1.0 / 6.0), r4 * V(1.0 / 24.0)) + later(t, last, h, r3, r4, C, R);
                if (single(k)) total += sum;
            }
            for (int l = 0; l < last && t >= shaped; l++) {  // what comes later bends x_t
                const int u = t + l + 1;
                for (int j = 0; j < n; j++) {
                    if (!has_site(u, j)) continue;
                    for (int i = 0; i < n; i++) cov[i] = C[l][i * n + j];
                    bend(t, cov, cross.w3[u * n + j], cross.w4[u * n + j]);
                }
                for (int k = a.start[u]; k < a.start[u + 1]; k++) {
                    if (!s.bends[k]) continue;
                    row(k, h);
                    along(R[l], h, cov);
                    bend(t, cov, cross.r3[k], cross.r4[k]);
                }
            }
        }
        for (int t = shaped; t <= a.T; t++)
            for (int l = 0; l < wide_lanes && block.first + l <= block.last; l++) {
                const std::ptrdiff_t at = (static_cast<std::ptrdiff_t>(block.first + l) * (a.T + 1) + t) * n;
                for (int i = 0; i < n; i++) {
                    const double v = max2(cross.S[(t * n + i) * n + i][l], 1e-300), sd = std::sqrt(v);
                    k3[at + i] = cross.x3[t * n + i][l] / (v * sd);
                    k4[at + i] = cross.x4[t * n + i][l] / (v * v);
                }
            }
        return total;
    }
    // what a factor of covariance cov with x_t adds to the cumulants of x_t
    inline void bend(int t, const V* cov, const V& a3, const V& a4) const {
        if (t < shaped) return;
        for (int i = 0; i < n; i++) {
            const V cube = cov[i] * cov[i] * cov[i];
            cross.x3[t * n + i] += cube * a3;
            cross.x4[t * n + i] += cube * cov[i] * a4;
        }
    }
    // of a factor with the cumulants 6 a3 and 24 a4 and one with b3 and b4, of covariance c
    static inline V pair(const V& c, const V& a3, const V& a4, const V& b3, const V& b4) {
        return c * c * c * (a3 * b3 + c * (a4 * b4));
    }
    // with the rows of stage t from k on, given the covariance with x_t
    inline V with_rows(int t, int k, const V* cov, const V& a3, const V& a4) const {
        V sum(0.0);
        for (; k < a.start[t + 1]; k++) {
            if (!s.bends[k] || !single(k)) continue;
            if (s.axis[k] >= 0) {
                sum += pair(cov[s.axis[k]], a3, a4, cross.r3[k], cross.r4[k]);
                continue;
            }
            V h[cap], c(0.0);
            row(k, h);
            for (int j = 0; j < n; j++) c += cov[j] * h[j];
            sum += pair(c, a3, a4, cross.r3[k], cross.r4[k]);
        }
        return sum;
    }
    // with what comes later, of what acts on x_t as g does and has the cumulants k3 and k4; C, R: covariance of x_t with the
    // noise and the state of t + 1, ...
    inline V later(int t, int last, const V* g, const V& k3, const V& k4, const V (*C)[cap * cap], const V (*R)[cap * cap]) const {
        const V a3 = k3 * V(1.0 / 6.0), a4 = k4 * V(1.0 / 24.0);
        V sum(0.0);
        for (int l = 0; l < last; l++) {
            const int u = t + l + 1;
            V cov[cap];
            for (int j = 0; j < n; j++) {
                V c(0.0), q(0.0);
                for (int i = 0; i < n; i++) {
                    c += g[i] * C[l][i * n + j];
                    q += g[i] * R[l][i * n + j];
                }
                cov[j] = q;
                if (has_site(u, j)) sum += pair(c, a3, a4, cross.w3[u * n + j], cross.w4[u * n + j]);
            }
            bend(u, cov, k3, k4);
            sum += with_rows(u, a.start[u], cov, a3, a4);
        }
        return sum;
    }
    // out (n,) = R h
    inline void along(const V* R, const V* h, V* out) const {
        for (int i = 0; i < n; i++) {
            out[i] = V(0.0);
            for (int j = 0; j < n; j++) out[i] += R[i * n + j] * h[j];
        }
    }
    inline void product(const V* M, const V* B, V* out) const {
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                V q(0.0);
                for (int k = 0; k < n; k++) q += M[i * n + k] * B[k * n + j];
                out[i * n + j] = q;
            }
    }
    // M = R S_v^-1
    inline void gain(const V* R, int v, V* M) const { product(R, cross.Pf + v * n * n, M); }
    // out (n,n) = S^-1, symmetric
    inline void inverse(const V* S, V* out) const {
        V L[cap * cap], work[cap];
        for (int i = 0; i < n * n; i++) L[i] = S[i];
        unit_factor(n, L, 1e-12, work);
        for (int i = 0; i < n; i++) {
            V* b = out + i * n;
            for (int j = 0; j < n; j++) b[j] = V(i == j ? 1.0 : 0.0);
            unit_lower(n, L, b);
            for (int j = 0; j < n; j++) b[j] = b[j] * L[j * n + j];
            unit_upper(n, L, b);
        }
    }

    static inline void ratios(const Tilted<X>& q, const V& v, V* out3, V* out4) {
        const V w = over(larger(v, V(1e-60)));
        *out3 = of(q.k3) * w * w * w;
        *out4 = of(q.k4) * w * w * w * w;
    }

    // r = (I - W P) g = (I + Lambda P)^-1 g
    inline void less(const V* W, const V* P, const V* g, V* r) const {
        V Pg[cap];
        for (int i = 0; i < n; i++) {
            V q(0.0);
            for (int j = 0; j < n; j++) q += P[i * n + j] * g[j];
            Pg[i] = q;
        }
        for (int i = 0; i < n; i++) {
            V q = g[i];
            for (int j = 0; j < n; j++) q -= W[i * n + j] * Pg[j];
            r[i] = q;
        }
    }

    // W <- G' W G, r <- G' r
    inline void turn(const V* G, V* W, V* r) const {
        V WG[cap * cap], g[cap];
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                V q(0.0);
                for (int k = 0; k < n; k++) q += W[i * n + k] * G[k * n + j];
                WG[i * n + j] = q;
            }
        for (int i = 0; i < n; i++) {
            V q(0.0);
            for (int k = 0; k < n; k++) q += G[k * n + i] * r[k];
            g[i] = q;
            for (int j = 0; j < n; j++) {
                V p(0.0);
                for (int k = 0; k < n; k++) p += G[k * n + i] * WG[k * n + j];
                W[i * n + j] = p;
            }
        }
        for (int i = 0; i < n; i++) r[i] = g[i];
    }

    // renew (or look at) the sites of w_t given W, r; `abreast` at a time, as the rows
    template <bool renew>
    inline void sites(int t, V* W, V* r, EpFound& f) {
        V *m = s.m + t * n, *D = s.D + t * n;
        for (int i = 0; i < n;) {
            const int from = i;
            V half[abreast], know[abreast];
            int at[abreast], count = 0;
            for (; i < n && i < from + abreast; i++) {
                if constexpr (!renew) {
                    if (t > 0 && fitted(i)) {  // g_i has the posterior mean p r_i and variance p - p W_ii p
                        const V p = power(i), share = p * W[i * n + i];
                        f.slope[a.group_Q[i]] += p * r[i] * r[i] - share;
                        f.learned[a.group_Q[i]] += share * share;
                    }
                    if (bent(t)) cross.w3[t * n + i] = cross.w4[t * n + i] = V(0.0);
                }
                if (!has_site(t, i)) continue;
                half[count] = larger(width(t, i), V(1e-150));
                know[count] = W[i * n + i];
                at[count++] = i;
            }
            if (count == 0) continue;
            if constexpr (renew) {
                V dD[abreast], dm[abreast];
                if (lone) {
                    const auto lane = [&](const V* each) { return in_lanes(count, [&](int c) { return each[at[c]]; }); };
                    V wider, move;
                    renew_noise(in_lanes(count, [&](int c) { return half[c]; }), in_lanes(count, [&](int c) { return know[c]; }), lane(D),
                                lane(m), lane(r), &wider, &move, f);
                    for (int c = 0; c < count; c++) {
                        dD[c] = V(wider[c]);
                        dm[c] = V(move[c]);
                    }
                } else {
                    Cavity<X> cavity[abreast];
                    V told[abreast], mean[abreast], var[abreast];
                    for (int c = 0; c < count; c++) told[c] = noise_cavity(half[c], know[c], D[at[c]], m[at[c]], r[at[c]], cavity + c);
                    for (int c = 0; c < count; c++) {
                        const Truncated<X> q = cut4<moments>(cavity[c], -half[c].v, half[c].v);
                        mean[c] = of(q.mean);
                        var[c] = of(q.var);
                    }
                    for (int c = 0; c < count; c++)
                        propose_noise(cavity[c], told[c], mean[c], var[c], D[at[c]], m[at[c]], r[at[c]], dD + c, dm + c, f);
                }
                for (int c = 0; c < count; c++) {
                    const int j = at[c];
                    const V gain = over(larger(V(1.0) + dD[c] * W[j * n + j], V(1e-12)));
                    V column[cap];
                    for (int l = 0; l < n; l++) column[l] = W[j * n + l];
                    turn_by(column, -(r[j] * dD[c] + dm[c]) * gain, dD[c] * gain, r, W);
                    D[j] += dD[c];
                    m[j] += dm[c];
                }
            } else {
                for (int c = 0; c < count; c++) {
                    const int j = at[c];
                    Cavity<X> cavity;
                    const V told = noise_cavity(half[c], know[c], D[j], m[j], r[j], &cavity);
                    const Tilted<X> q = bent(t) ? uniform4<cumulants>(cavity, half[c].v) : uniform4<evidence>(cavity, half[c].v);
                    const V tv = larger(of(q.var), V(1e-300)), var = D[j] * (V(1.0) - told);
                    note(f, m[j] + D[j] * r[j], var, of(q.mean), tv, over(tv), cavity);
                    const V spread = D[j] + of(cavity.c), d = m[j] - of(cavity.mu);
                    f.log_z += of(q.log_z) + V(0.5) * (V(log_2pi) + d * d * over(spread));
                    f.above.add(spread);
                    f.worst = smaller(f.worst, of(q.log_z) + (t > 0 ? s.log_box[a.group_w[j]] : log_of(V(2.0) * half[c])));
                    if (t > 0) {
                        const V share = larger(V(1.0) - V(3.0) * var / (half[c] * half[c]), V(0.0));
                        f.slope[a.group_w[j]] += of(q.slope_s);
                        f.learned[a.group_w[j]] += share * share;
                    }
                    if (bent(t)) ratios(q, var, cross.w3 + t * n + j, cross.w4 + t * n + j);
                }
            }
        }
    }
    // The cavity of a site (m, D) of w_i of this half-width, given W_ii and r_i; returns D W_ii.
    static inline V noise_cavity(const V& half, const V& W, const V& D, const V& m, const V& r, Cavity<X>* cavity) {
        const V square = half * half;
        V know = W;
        if (any4(know.v * square.v < all<X>(1e-8))) know = larger(know, V(1e-8) / square);  // nothing known: a wide cavity
        const V over_know = over(know), share = D * know, open = larger(V(1.0) - share, V(1e-12) * share);
        const V c = open * over_know, mu = m + r * over_know, scale = root(know * over(open));
        *cavity = {mu.v, c.v, (c * scale).v, scale.v};
        return share;
    }
    // the change of that site that reproduces the moments of its factor
    static inline void propose_noise(const Cavity<X>& cavity, const V& told, const V& mean, const V& var, const V& D, const V& m, const V& r,
                                     V* dD, V* dm, EpFound& f) {
        const V mu = of(cavity.mu), scale = of(cavity.scale), floored = larger(var, V(1e-300));
        note(f, m + D * r, D * (V(1.0) - told), mean, floored, over(floored), cavity);
        const V wider = over(larger(V(1.0) - var * scale * scale, V(1e-6)));  // 1 - tilted variance over the cavity's
        *dD = var * wider - D;
        *dm = mu + (mean - mu) * wider - m;
    }
    // both, of one member's sites, one a lane
    static inline void renew_noise(const V& half, const V& W, const V& D, const V& m, const V& r, V* dD, V* dm, EpFound& f) {
        Cavity<X> cavity;
        const V told = noise_cavity(half, W, D, m, r, &cavity);
        const Truncated<X> q = cut4<moments>(cavity, -half.v, half.v);
        propose_noise(cavity, told, of(q.mean), of(q.var), D, m, r, dD, dm, f);
    }

    // belief about x_t to the caller
    inline void give(int t, const V* ms, const V* Ps) const {
        for (int l = 0; l < wide_lanes && block.first + l <= block.last; l++) {
            const std::ptrdiff_t at = static_cast<std::ptrdiff_t>(block.first + l) * (a.T + 1) + t;
            for (int i = 0; i < n; i++) a.x[at * n + i] = ms[i][l];
            if (a.P)
                for (int i = 0; i < n * n; i++) a.P[at * n * n + i] = Ps[i][l];
        }
    }

    // ---- the whole -----------------------------------------------------------------------------------------------

    void clear(EpFound& f) const {
        f.residual = V(0.0);
        f.top = V(0.0);
        f.far = V(0.0);
        f.log_z = V(0.0);
        f.worst = V(1e300);
        f.above.clear();
        f.below.clear();
        for (int g = 0; g <= a.groups; g++) f.slope[g] = V(0.0);
        for (int g = 0; g < a.groups; g++) f.learned[g] = V(0.0);
    }

    void sweep(EpFound& f, double damping) {
        clear(f);
        forward<true>(f, damping);
        backward<true>(f, a.T);
        if (lone)
            for (int l = 0; l < wide_lanes; l++) {
                f.residual = larger(f.residual, V(f.residual[l]));
                f.far = larger(f.far, V(f.far[l]));
            }
        f.residual = root(f.residual);
    }

    // Sweep until the moments agree within `tol` in every lane that is alive; returns the sweeps. A lane is dead when its
    // numbers are no longer finite or a factor lies thousands of standard deviations from where the others put it: no
    // trajectory fits, and its sites run away.
    int settle(EpFound& f, int sweeps, double tol, double damping) {
        fineness(tol);
        V before(1e300);
        for (int k = 1; k <= sweeps; k++) {
            sweep(f, damping);
            if (settled(f, before, tol)) return k;
            before = f.residual;
        }
        return sweeps;
    }
    // The same from sites that fit but for those near either end of the chain: each sweep goes as far as it changes
    // anything. Returns the stages gone over.
    int settle_ends(EpFound& f, int sweeps, double tol, double damping) {
        fineness(tol);
        fix();
        filter();
        nothing_after();
        const double quiet = 0.3 * tol;
        V before(1e300);
        int stages = 0;
        for (int k = 1; k <= sweeps; k++) {
            clear(f);
            const int from = backward<true>(f, a.T, quiet);
            forward<true>(f, damping, from);
            f.residual = root(f.residual);
            stages += a.T + 1 - from;
            if (settled(f, before, tol)) break;
            before = f.residual;
        }
        hear();
        before = V(1e300);
        for (int k = 1; k <= sweeps; k++) {
            clear(f);
            const int to = forward<true>(f, damping, 0, quiet);
            backward<true>(f, to);
            f.residual = root(f.residual);
            stages += to + 1;
            if (settled(f, before, tol)) break;
            before = f.residual;
        }
        return stages;
    }
    void fineness(double tol) {
        mixed = false;
        for (int k = 0; k < a.rows; k++) mixed = mixed || !single(k);
        reach = min2(max2(2.0 * std::log(1e3 / max2(tol, 1e-300)), 20.0), 72.0);
        faint = min2(max2(2e-3 * tol, 1e-13), 1e-4);
    }
    // What a sweep finds it then mends: what is left is expected to fall at the rate seen, at best to a fifth. Rows with
    // two explanations keep no rate.
    bool settled(const EpFound& f, const V& before, double tol) const {
        if (mixed) return within(f, f.residual, tol);
        V left = f.residual;
        for (int l = 0; l < wide_lanes; l++)
            if (before[l] < 1e300) left.set(l, left[l] * min2(max2(left[l] / before[l], 0.2), 1.0));
        return within(f, left, tol);
    }
    // whether `left` is below tol on average over the lanes that are alive, and not far above in any
    bool within(const EpFound& f, const V& left, double tol) const {
        double sum = 0.0;
        int count = 0;
        for (int l = 0; l < wide_lanes; l++) {
            if (!alive(f, l)) continue;
            if (!(left[l] < (mixed ? 1.0 : 3.0) * tol)) return false;
            sum += left[l];
            count++;
        }
        return sum <= count * tol;
    }
    static inline bool alive(const EpFound& f, int l) { return finite(f.residual[l]) && f.far[l] < 1e8; }

    // Evidence, its slopes and the belief of the sites as they are; both halves without renewing anything.
    void look(EpFound& f) {
        clear(f);
        for (int g = 0; g < a.groups; g++) s.log_box[g] = log_of(V(2.0) * s.s[g] + V(1e-300));
        forward<false>(f, 1.0);
        backward<false>(f, a.T);
        f.log_z += V(0.5) * (f.above.value() - f.below.value());
        f.residual = root(f.residual);
    }
    static inline bool sound(const EpFound& f, int l) {
        return finite(f.log_z[l]) && finite(f.residual[l]) && f.worst[l] > -60.0 && f.log_z[l] < f.top[l] + 10.0;
    }
};

}  // namespace HW_ISA
}  // namespace hw
