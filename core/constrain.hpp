// A Gaussian N(x, P) held inside lo <= D x <= hi: the moments of what is left of it, or the nearest point.
//
// Truncation, one constraint f at a time (Simon and Simon 2010): with s^2 = f' P f and mean mu and variance v of a
// standard normal cut to [(lo - f' x) / s, (hi - f' x) / s],
//
//     x <- x + P f mu / s,    P <- P - (1 - v) P f f' P / s^2,
//
// exact for one constraint; it needs no decomposition of P, which may be singular. Expectation propagation repeats this
// with each constraint's own share taken out first, until all agree, so their order does not matter (Cunningham, Hennig
// and Lacoste-Julien 2011). Projection takes the feasible point nearest to x in the metric of P, or in the user's own
// units, by a dual active set (Goldfarb and Idnani 1983) that starts from x and works on the rows' own matrix F M F'.
//
// An equality is conditioned on first. A direction without variance is left alone where it obeys and is infeasible
// where it does not. All thresholds are relative to the row's own variance, so units do not matter.
#pragma once
#include "constrain_entry.hpp"
#include "noise.hpp"
#include "small.hpp"

namespace hw {
namespace HW_ISA {
namespace {

constexpr double constrain_far = 30.0;       // sd between the belief and a constraint from which on they contradict
constexpr double constrain_slack = 1e-11;    // of numbers that differ by rounding only, relative
constexpr double constrain_flat = 1e-13;     // a row's variance below this share of what it could be is none
constexpr double constrain_rounding = 1e-14;  // a pivot below this share of the variance before is none
constexpr double constrain_pinned = 1e-8;    // a cavity below this share of its belief cannot be found by subtraction
constexpr double constrain_hopeless = 1e3;     // times what rounding explains that a mean may be left outside
constexpr double constrain_idle = 8.5;          // sd beyond which a bound cuts off less than rounding
constexpr double constrain_settled = 1e-5;      // of mean and variance, relative to the belief
constexpr int constrain_sweeps = 60, constrain_undamped = 25;

// The rows that bound something, equal directions merged, and the workspace of one belief.
struct Constraints {
    int n, k, n_equal;          // states, rows, the first n_equal of which are equalities
    double *F, *lo, *hi;        // (k,n), (k,)
    int* of;                    // (k,) row of D it came from
    int infeasible;             // row of D that nothing fulfils, or -1
    // workspace of one belief
    double *M, *g, *away;                     // (n,n) metric of the projection, (n,), (n,)
    double *a, *b;                            // (k,) bounds of F (x - its mean): a small move of a large number keeps its digits
    double *s, *sd, *tol, *most, *tau, *nu, *lam;  // (k,) each
    double *G, *Ga, *Gf, *rhs, *d, *di;       // (k,k) three times, (k,) each
    double* kept;                             // (n + n n,)
    int *active, *side, *live, *alive;        // (k,) each
};

inline double constrain_dot(int n, const double* a, const double* b) {
    double s = 0.0;
    for (int i = 0; i < n; i++) s += a[i] * b[i];
    return s;
}

inline void constrain_times(int n, const double* S, const double* f, double* g) {  // g = S f
    for (int i = 0; i < n; i++) g[i] = constrain_dot(n, S + i * n, f);
}

inline void constrain_downdate(int n, double c, const double* g, double* S) {  // S -= c g g', symmetric to the bit
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) S[j * n + i] = S[i * n + j] -= c * (g[i] * g[j]);
}

// The variance that f' x could have if its entries moved together: what rounding in f' S f is measured by.
inline double constrain_most(int n, const double* S, const double* f) {
    double s = 0.0;
    for (int i = 0; i < n; i++) s += std::fabs(f[i]) * std::sqrt(max2(S[i * n + i], 0.0));
    return s * s;
}

inline double constrain_size(int n, const double* f, const double* x) {
    double s = 0.0;
    for (int i = 0; i < n; i++) s += std::fabs(f[i] * x[i]);
    return s;
}

inline double constrain_outside(double s, double lo, double hi) { return s < lo ? lo - s : s > hi ? s - hi : 0.0; }

// Is b (n) = factor * a (n), entry by entry?
inline bool constrain_parallel(int n, const double* a, const double* b, double* factor) {
    int top = 0;
    for (int i = 1; i < n; i++)
        if (std::fabs(a[i]) > std::fabs(a[top])) top = i;
    const double r = b[top] / a[top];
    if (r == 0.0) return false;
    for (int i = 0; i < n; i++)
        if (std::fabs(b[i] - r * a[i]) > 4 * eps * std::fabs(b[i])) return false;
    *factor = r;
    return true;
}

// Fill `c` from D (m,n), lo, hi (m): rows without a side are left out, parallel ones become one, equalities come first.
inline void constrain_prepare(int m, const double* D, const double* lo, const double* hi, Constraints& c) {
    const int n = c.n;
    c.k = c.n_equal = 0;
    c.infeasible = -1;
    for (int i = 0; i < m; i++) {
        const double* f = D + i * n;
        bool empty = true;
        for (int j = 0; j < n; j++) empty = empty && f[j] == 0.0;
        if (empty && constrain_outside(0.0, lo[i], hi[i]) > 0.0 && c.infeasible < 0) c.infeasible = i;
        if (empty || (!finite(lo[i]) && !finite(hi[i]))) continue;
        int j = 0;
        double r = 1.0;
        while (j < c.k && !constrain_parallel(n, c.F + j * n, f, &r)) j++;
        if (j == c.k) {
            for (int l = 0; l < n; l++) c.F[j * n + l] = f[l];
            c.lo[j] = lo[i];
            c.hi[j] = hi[i];
            c.of[j] = i;
            c.k++;
            continue;
        }
        c.lo[j] = max2(c.lo[j], (r > 0 ? lo[i] : hi[i]) / r);
        c.hi[j] = min2(c.hi[j], (r > 0 ? hi[i] : lo[i]) / r);
        if (c.lo[j] > c.hi[j]) {
            const bool rounding = c.lo[j] - c.hi[j] <= constrain_slack * (std::fabs(c.lo[j]) + std::fabs(c.hi[j]));
            if (!rounding && c.infeasible < 0) c.infeasible = i;
            c.lo[j] = c.hi[j] = 0.5 * c.lo[j] + 0.5 * c.hi[j];
        }
    }
    for (int i = 0; i < c.k; i++) {
        if (c.lo[i] != c.hi[i]) continue;
        const int to = c.n_equal++;
        for (int l = 0; l < n && to != i; l++) {
            const double t = c.F[to * n + l];
            c.F[to * n + l] = c.F[i * n + l];
            c.F[i * n + l] = t;
        }
        const double a = c.lo[to], b = c.hi[to];
        const int o = c.of[to];
        c.lo[to] = c.lo[i], c.hi[to] = c.hi[i], c.of[to] = c.of[i];
        c.lo[i] = a, c.hi[i] = b, c.of[i] = o;
    }
}

// What the variance of row i in the metric is measured by.
inline double constrain_most_of(const Constraints& c, bool nearest, int i) {
    return nearest ? constrain_dot(c.n, c.F + i * c.n, c.F + i * c.n) : c.most[i];
}

// x (n) <- the point nearest to it in the metric M (n,n) that fulfils the rows from `first` on; rows that M cannot move are
// left out. Returns 0; 1 if it stopped before it was done; or 4 with the row that cannot be fulfilled.
inline int constrain_project(Constraints& c, bool nearest, const double* M, int first_row, double* x, int* row) {
    constexpr int free = 0, dependent = 2, fixed = 3;  // sides beside -1 and 1, those of rows that hold at an end
    const int n = c.n, k = c.k;
    int count = 0, code = 1;
    for (int i = first_row; i < k; i++) {
        const double* f = c.F + i * n;
        c.lam[i] = 0.0;
        c.s[i] = constrain_dot(n, f, x);
        constrain_times(n, M, f, c.g);
        for (int j = first_row; j <= i; j++) c.G[i * k + j] = c.G[j * k + i] = constrain_dot(n, c.F + j * n, c.g);
        c.side[i] = c.G[i * k + i] > constrain_flat * constrain_most_of(c, nearest, i) ? free : fixed;
    }
    for (int round = 0; round < 20 * (k + 1); round++) {
        int p = -1;
        double worst = 0.0;
        for (int i = first_row; i < k; i++) {
            if (c.side[i] != free) continue;
            const double sd = std::sqrt(max2(c.G[i * k + i], smallest));
            const double out = constrain_outside(c.s[i], c.a[i], c.b[i]);
            if (out > 1e-14 * sd + c.tol[i] && out / sd > worst) worst = out / sd, p = i;
        }
        if (p < 0) {
            code = 0;
            break;
        }
        const double sign = c.s[p] < c.a[p] ? 1.0 : -1.0, Gpp = c.G[p * k + p];
        for (;;) {  // ends: each turn but the last drops a row
            const int A = count;
            for (int a = 0; a < A; a++) {
                c.rhs[a] = c.G[c.active[a] * k + p];
                for (int b = 0; b < A; b++) c.Ga[a * A + b] = c.G[c.active[a] * k + c.active[b]];
            }
            ldl(Dim<0>(A), c.Ga, c.Gf, c.d, c.di);
            ldl_solve(Dim<0>(A), Dim<1>(), c.Gf, c.di, c.rhs);
            double kappa = Gpp, first = HUGE_VAL, reach = std::sqrt(constrain_most_of(c, nearest, p));
            int leaves = -1;
            for (int a = 0; a < A; a++) {
                const int j = c.active[a];
                kappa -= c.G[j * k + p] * c.rhs[a];
                reach += std::fabs(c.rhs[a]) * std::sqrt(constrain_most_of(c, nearest, j));
                if (j >= c.n_equal && sign * c.rhs[a] * c.side[j] > 0.0) {  // its multiplier falls towards 0
                    const double t = std::fabs(c.lam[j] / c.rhs[a]);
                    if (t < first) first = t, leaves = a;
                }
            }
            const double out = sign > 0 ? c.a[p] - c.s[p] : c.s[p] - c.b[p];
            const bool moves = kappa > constrain_flat * reach * reach;  // kappa's own rounding grows with what it is left of
            const double full = moves ? out / kappa : HUGE_VAL, t = min2(first, full);
            if (t == HUGE_VAL) {
                if (out <= 1e-9 * std::sqrt(Gpp) + 1e3 * c.tol[p]) {  // rounding, of rows that nearly depend on each other
                    c.side[p] = dependent;
                    break;
                }
                *row = c.of[p];
                return 4;
            }
            c.lam[p] += sign * t;
            for (int a = 0; a < A; a++) c.lam[c.active[a]] -= sign * t * c.rhs[a];
            for (int i = first_row; i < k; i++) {
                if (c.side[i] == dependent) c.side[i] = free;
                double step = c.G[i * k + p];
                for (int a = 0; a < A; a++) step -= c.G[i * k + c.active[a]] * c.rhs[a];
                c.s[i] += sign * t * step;
            }
            if (full <= first) {
                c.side[p] = sign > 0 ? 1 : -1;
                c.active[count++] = p;
                break;
            }
            c.lam[c.active[leaves]] = 0.0;
            c.side[c.active[leaves]] = free;
            for (int a = leaves; a + 1 < count; a++) c.active[a] = c.active[a + 1];
            count--;
        }
    }
    for (int i = first_row; i < k; i++) {
        if (c.lam[i] == 0.0) continue;
        constrain_times(n, M, c.F + i * n, c.g);
        for (int j = 0; j < n; j++) x[j] += c.lam[i] * c.g[j];
    }
    return code;
}

// How far x is outside, beside what rounding explains: at most 1 where it obeys. `row`: the row of D that is broken most.
inline double constrain_broken(const Constraints& c, const double* x, int* row) {
    double worst = 0.0;
    for (int i = 0; i < c.k; i++) {
        const double slack = 1e-10 * c.sd[i] + constrain_slack * std::sqrt(c.most[i]) + 100 * c.tol[i];
        const double out = constrain_outside(constrain_dot(c.n, c.F + i * c.n, x), c.a[i], c.b[i]) / max2(slack, smallest);
        if (out > worst) worst = out, *row = c.of[i];
    }
    return worst;
}

// Rows of one entry hold to the last bit.
inline void constrain_clip(const Constraints& c, double* x) {
    for (int i = 0; i < c.k; i++) {
        int entry = -1, count = 0;
        for (int j = 0; j < c.n; j++)
            if (c.F[i * c.n + j] != 0.0) entry = j, count++;
        if (count != 1) continue;
        const double f = c.F[i * c.n + entry], lo = c.lo[i] / f, hi = c.hi[i] / f;
        x[entry] = min2(max2(x[entry], f > 0 ? lo : hi), f > 0 ? hi : lo);
    }
}

// One cut of N(away, P) by row i, whose share so far has precision tau and information nu: the moments without the share
// are cut, and mean, P and the share follow. `part` < 1 damps. Returns how far the belief moved, in its own units.
inline double constrain_cut(Constraints& c, int i, double part, double* P) {
    const int n = c.n;
    const double* f = c.F + i * n;
    constrain_times(n, P, f, c.g);
    const double v = constrain_dot(n, f, c.g), rest = 1.0 - c.tau[i] * v;
    if (!(v > constrain_flat * c.most[i]) || !(rest > constrain_pinned)) return 0.0;
    const double mu = constrain_dot(n, f, c.away), vc = v / rest, mc = (mu - c.nu[i] * v) / rest, sd = std::sqrt(vc);
    const double lower = (c.a[i] - mc) / sd, upper = (c.b[i] - mc) / sd;
    double shift = 0.0, kept = 1.0;
    if (lower > -constrain_idle || upper < constrain_idle) {
        const Truncated4 cut = truncated4(V4{}, all4(1.0), all4(lower), all4(upper));
        shift = cut.mean[0];
        kept = max2(cut.var[0], 1e-30);
    }
    const double more = (1.0 / kept - 1.0) / vc;  // precision that the cut adds
    const double dtau = part * (more - c.tau[i]), dnu = part * (mc * more + sd * shift / (vc * kept) - c.nu[i]);
    const double den = 1.0 + dtau * v, move = (dnu - dtau * mu) / den;
    c.tau[i] += dtau;
    c.nu[i] += dnu;
    for (int j = 0; j < n; j++) c.away[j] += c.g[j] * move;
    constrain_downdate(n, dtau / den, c.g, P);
    return max2(std::fabs(move) * std::sqrt(v), std::fabs(dtau) * v / den);
}

// Condition N(away, P) and the metric M on the equalities. `nearest`: move in the metric M alone, and P is that of the
// moved point. Returns 0, or 4 with the row that cannot hold.
inline int constrain_equal(Constraints& c, bool nearest, double* P, int* row) {
    const int n = c.n;
    for (int i = 0; i < c.n_equal; i++) {
        const double* f = c.F + i * n;
        constrain_times(n, c.M, f, c.g);
        const double v = constrain_dot(n, f, c.g), out = c.a[i] - constrain_dot(n, f, c.away);
        if (!(v > constrain_flat * constrain_most_of(c, nearest, i))) {  // nothing is left to move: it holds already, or never
            if (std::fabs(out) > constrain_slack * std::sqrt(c.most[i]) + 1e3 * c.tol[i]) {
                *row = c.of[i];
                return 4;
            }
            continue;
        }
        for (int j = 0; j < n; j++) c.away[j] += c.g[j] * (out / v);
        constrain_downdate(n, 1.0 / v, c.g, c.M);
        if (!nearest) continue;
        // P <- (I - g f' / v) P (I - g f' / v)'
        double* Pf = c.s;  // at least n long
        constrain_times(n, P, f, Pf);
        const double fPf = constrain_dot(n, f, Pf);
        for (int j = 0; j < n; j++)
            for (int l = 0; l <= j; l++)
                P[l * n + j] = P[j * n + l] += c.g[j] * c.g[l] * fPf / (v * v) - (c.g[j] * Pf[l] + Pf[j] * c.g[l]) / v;
    }
    if (!nearest) copy(Dim<0>(n * n), c.M, P);
    return 0;
}

// Move P and the mean into the constraints by cuts. Returns 0, or 1 if the iteration stopped before it settled.
inline int constrain_cuts(Constraints& c, int by, double* P) {
    const int n = c.n, k = c.k;
    int live = 0;
    for (int i = c.n_equal; i < k; i++) live += c.live[i];
    if (by == constrain_by_truncation || live == 1) {  // the most broken one first, each once
        for (int done = 0; done < live; done++) {
            int p = -1;
            double worst = -HUGE_VAL;
            for (int i = c.n_equal; i < k; i++) {
                if (!c.live[i]) continue;
                constrain_times(n, P, c.F + i * n, c.g);
                const double v = max2(constrain_dot(n, c.F + i * n, c.g), smallest), s = constrain_dot(n, c.F + i * n, c.away);
                const double out = max2(c.a[i] - s, s - c.b[i]) / std::sqrt(v);
                if (out > worst) worst = out, p = i;
            }
            constrain_cut(c, p, 1.0, P);
            c.live[p] = 0;
        }
        for (int i = c.n_equal; i < k; i++) c.live[i] = c.alive[i];
        return 0;
    }
    for (int sweep = 0; sweep < constrain_sweeps; sweep++) {
        double moved = 0.0;
        for (int i = c.n_equal; i < k; i++)
            if (c.live[i]) moved = max2(moved, constrain_cut(c, i, sweep < constrain_undamped ? 1.0 : 0.5, P));
        if (moved < constrain_settled) return 0;
    }
    return 1;
}

// Where cuts took nearly all variance of a direction, what is left is rounding and may be negative: S <- L L' without the
// pivots that are nothing beside P, the covariance before.
inline void constrain_repair(int n, const double* P, double* S, double* L) {
    bool noise = false;
    for (int j = 0; j < n; j++) {
        double p = S[j * n + j];
        for (int k = 0; k < j; k++) p -= L[j * n + k] * L[j * n + k];
        const bool real = p > constrain_rounding * P[j * n + j];
        noise = noise || !real;
        const double root = real ? std::sqrt(p) : 0.0;
        L[j * n + j] = root;
        for (int i = j + 1; i < n; i++) {
            double s = S[i * n + j];
            for (int k = 0; k < j; k++) s -= L[i * n + k] * L[j * n + k];
            L[i * n + j] = real ? s / root : 0.0;
        }
    }
    if (!noise) return;
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) {
            double s = 0.0;
            for (int k = 0; k <= j; k++) s += L[i * n + k] * L[j * n + k];
            S[i * n + j] = S[j * n + i] = s;
        }
}

// One belief N(x, P), in place. `distance`: the standard deviations from x to the farthest constraint that it breaks.
// Returns 0; 1 if the iteration stopped before it settled or rounding left the mean outside; 2 if a constraint lies more than `constrain_far` standard
// deviations away; 4 if nothing fulfils row `row` of D, and then x and P stay. Codes 2 and 4 name the row.
inline int constrain_row(Constraints& c, int by, double* x, double* P, double* distance, int* row) {
    const int n = c.n, k = c.k;
    const bool nearest = by == constrain_by_nearest;
    *distance = 0.0;
    *row = c.infeasible;
    if (c.infeasible >= 0) return 4;
    for (int i = 0; i < n * n; i++)
        if (!finite(P[i]) || !finite(x[i / n])) return 0;  // the method that gave it says why
    for (int i = 0; i < n; i++) {
        c.away[i] = 0.0;
        for (int j = 0; j < n; j++) c.M[i * n + j] = nearest ? double(i == j) : P[i * n + j];
    }
    for (int i = 0; i < k; i++) {
        const double* f = c.F + i * n;
        const double s = constrain_dot(n, f, x);
        c.a[i] = c.lo[i] - s;
        c.b[i] = c.hi[i] - s;
        c.tau[i] = c.nu[i] = 0.0;
        c.tol[i] = 8 * eps * (constrain_size(n, f, x) + min2(std::fabs(c.lo[i]), std::fabs(c.hi[i])));
        c.most[i] = constrain_most(n, P, f);
        c.live[i] = 1;
        constrain_times(n, P, f, c.g);
        const double v = constrain_dot(n, f, c.g), out = constrain_outside(0.0, c.a[i], c.b[i]);
        c.sd[i] = v > constrain_flat * c.most[i] ? std::sqrt(v) : 0.0;
        if (out > c.tol[i] && out > *distance * c.sd[i] && c.sd[i] > 0.0) {
            *distance = out / c.sd[i];
            *row = c.of[i];
        }
    }
    double* kept = c.kept;  // what to return to: mean, then P
    copy(Dim<0>(n * n), P, kept + n);
    if (constrain_equal(c, nearest, P, row)) {
        copy(Dim<0>(n * n), kept + n, P);
        return 4;
    }
    for (int i = c.n_equal; i < k; i++) {  // what has no variance left cannot be moved
        const double* f = c.F + i * n;
        constrain_times(n, c.M, f, c.g);
        const double most = constrain_most_of(c, nearest, i);
        c.live[i] = c.alive[i] = constrain_dot(n, f, c.g) > constrain_flat * most;
        const double out = constrain_outside(constrain_dot(n, f, c.away), c.a[i], c.b[i]);
        if (!c.live[i] && out > constrain_slack * std::sqrt(c.most[i]) + 1e3 * c.tol[i]) {
            *row = c.of[i];
            copy(Dim<0>(n * n), kept + n, P);
            return 4;
        }
    }
    // The projection is also what proves that something fulfils all rows, and the answer where cuts end outside.
    copy(Dim<0>(n), c.away, kept);
    if (constrain_project(c, nearest, c.M, c.n_equal, kept, row) == 4) {
        copy(Dim<0>(n * n), kept + n, P);
        return 4;
    }
    int code = 0, at;
    const bool cuts = by == constrain_by_ep || by == constrain_by_truncation;
    if (cuts) {
        code = constrain_cuts(c, by, P);
        // Cuts one after the other may leave an earlier constraint; the mean is moved back, in the metric of what is left.
        if (constrain_broken(c, c.away, &at) > 1.0) constrain_project(c, false, P, c.n_equal, c.away, &at);
    }
    if (!cuts || constrain_broken(c, c.away, &at) > 1.0) {
        // Rows that nearly depend on each other lose digits: all of them are projected on once more.
        for (int i = 0; nearest && i < n; i++)
            for (int j = 0; j < n; j++) c.M[i * n + j] = double(i == j);
        for (int again = 0; again < 3 && constrain_broken(c, kept, &at) > 1.0; again++)
            constrain_project(c, nearest, nearest ? c.M : kept + n, 0, kept, &at);
        copy(Dim<0>(n), kept, c.away);
        const double broken = constrain_broken(c, c.away, &at);
        if (broken > constrain_hopeless) {  // no proof, but P leaves no way in that numbers can show
            *row = at;
            copy(Dim<0>(n * n), kept + n, P);
            return 4;
        }
        if (broken > 1.0) code = 1;
    }
    if (c.n_equal || cuts) constrain_repair(n, kept + n, P, c.M);
    for (int i = 0; i < n; i++) x[i] += c.away[i];
    constrain_clip(c, x);
    return *distance > constrain_far ? 2 : code;
}

}  // namespace
}  // namespace HW_ISA
}  // namespace hw
