// The Kalman family: filter, Rauch-Tung-Striebel smoother, fixed-lag smoother and the sums that learn a model, for
//
//     x[t] = A x[t-1] + B u[t] + b[t] + w[t],    w ~ N(0, Q)
//     y[t] = C x[t]   + d[t]   + e[t],           e ~ N(0, R),     t = 0..T-1,   x[-1] ~ N(x0, P0)
//
// with any entry of any y[t] missing (`seen` is the mask; the values there are never read into a result). E and F of the
// papers are folded into A, B, Q and C, R by the caller. Every matrix may be one for all rows, one per row, or a stack
// with an index per row.
//
// How. The update is Joseph's, P <- Z P Z' + K R K' with Z = I - K C, and the smoother is its mirror image,
// P_s <- Z P Z' + G (Q + P_s+) G' with Z = I - G A: sums of congruences, so covariances stay symmetric and positive
// semidefinite over millions of rows. The short forms (P - K C P, P + G (P_s+ - P_p) G') are differences and do not.
// A missing entry is a zero row of C with an uncorrelated unit row of R: exact, also under a full R.
//
// Singular systems. S = C P C' + R or P_p = A P A' + Q may be singular (R = 0, Q = 0, P0 = 0). A direction whose pivot
// is only rounding noise is left out (small.hpp): an output without any variance cannot move the state. Such rows count as
// `reduced`; when the output contradicts a certain prediction (beyond 1e-6 of its size) or an uncertain one (beyond a
// million standard deviations) the code is `contradicted`.
// When a belief leaves the range of floating point the pass stops: the rows from there on repeat the last finite belief
// and the code is `broken`. No output is ever NaN.
//
// Kalman (1960); Joseph form: Bucy and Joseph (1968); Rauch, Tung and Striebel (1965); sums: Shumway and Stoffer (1982).
#pragma once

#include "isa.hpp"
#include "small.hpp"

namespace hw {

// One matrix for all rows (step 0), one per row (step = its entries), or a stack chosen by index (T).
struct Stack {
    const double* a = nullptr;
    const std::int32_t* index = nullptr;
    std::ptrdiff_t step = 0;
    inline std::int64_t entry(std::int64_t t) const { return index ? index[t] : (step ? t : 0); }
    inline const double* at(std::int64_t t) const { return a + step * (index ? index[t] : t); }
};

enum KalmanCode { kalman_ok = 0, kalman_reduced = 1, kalman_contradicted = 2, kalman_broken = 3 };

// Expected sums over rows given all outputs, around the current matrices: with w[t] = x[t] - A x[t-1] - B u[t] - b[t] and
// e[t] = y[t] - d[t] - C x[t] (its unseen part replaced by its expectation given the seen part). Rows without any seen
// output say nothing of C and R and are left out of the lower half.
struct KalmanSums {
    double* W = nullptr;    // (KQ, nx, nx)  sum E w w', for each entry of the stack Q
    double* nW = nullptr;   // (KQ,)         rows
    double* Wx = nullptr;   // (nx, nx)      sum E w x[t-1]'
    double* Wu = nullptr;   // (nx, nu)      sum E w u'
    double* Xx = nullptr;   // (nx, nx)      sum E x[t-1] x[t-1]'
    double* Xu = nullptr;   // (nx, nu)      sum E x[t-1] u'
    double* Uu = nullptr;   // (nu, nu)      sum u u'
    double* V = nullptr;    // (KR, ny, ny)  sum E e e', for each entry of the stack R
    double* nV = nullptr;   // (KR,)         rows
    double* Vx = nullptr;   // (ny, nx)      sum E e x'
    double* Xy = nullptr;   // (nx, nx)      sum E x x'
};

struct Kalman {
    // in
    std::int64_t T = 0;
    int nx = 0, ny = 0, nu = 0;
    Stack A, B, C, Q, R;                 // (nx,nx) (nx,nu) (ny,nx) (nx,nx) (ny,ny)
    const double* u = nullptr;           // (T, nu) or null
    const double* b = nullptr;           // (T, nx) or null
    const double* d = nullptr;           // (T, ny) or null
    const double* y = nullptr;           // (T, ny)
    const std::uint8_t* seen = nullptr;  // (T, ny)
    const double* x0 = nullptr;          // (nx,)
    const double* P0 = nullptr;          // (nx, nx)
    std::int64_t lag = -1;               // of `kalman_lag`
    // out; those marked * may be null
    double* x = nullptr;    // (T, nx)      filtered, then overwritten by the smoothed
    double* P = nullptr;    // (T, nx, nx)
    double* xp = nullptr;   // (T, nx)      * predicted
    double* Pp = nullptr;   // (T, nx, nx)  *
    double* yp = nullptr;   // (T, ny)      * predicted output
    double* S = nullptr;    // (T, ny, ny)  * its covariance
    double* ll = nullptr;   // (T,)         * log-likelihood of each row
    double* nis = nullptr;  // (T,)         * v' S^-1 v of the seen entries
    double* x0s = nullptr;  // (nx,)        * smoothed state one step before row 0
    double* P0s = nullptr;  // (nx, nx)     *
    double* Pl = nullptr;   // (T, nx, nx)  * cov(x[t], x[t-1]) given all
    KalmanSums* sums = nullptr;
    double loglik = 0.0;
    std::int64_t n_seen = 0, n_reduced = 0;
    int code = kalman_ok;
    std::int64_t row = -1;  // where the code was first met
    // workspace
    double* work = nullptr;  // kalman_work(...) entries
};

// Entries of workspace for these sizes (lag < 0: no lag).
inline std::int64_t kalman_work(std::int64_t nx, std::int64_t ny, std::int64_t lag = -1) {
    const std::int64_t n = nx > 0 ? nx : 1, m = ny > 0 ? ny : 1;
    return 16 * n * n + 16 * n + 10 * m * m + 8 * n * m + 12 * m + 64 + (lag > 0 ? lag * (2 * n * n + 2 * n) : 0);
}

namespace HW_ISA {

// Buffers: on the stack where the size is known when compiling, else carved from the caller's workspace.
struct Arena {
    double* next;
    inline double* take(std::ptrdiff_t n) {
        double* a = next;
        next += n;
        return a;
    }
};
template <int N>
struct Room {
    alignas(32) double a[N];
    inline double* get(Arena&, std::ptrdiff_t) { return a; }
};
template <>
struct Room<0> {
    inline double* get(Arena& w, std::ptrdiff_t n) { return w.take(n); }
};
template <class M, class N = Dim<1>>
constexpr int room = M::fixed && N::fixed ? M::cap * N::cap : 0;

constexpr double rounding = 64.0 * eps;

// Whether some variance fell to rounding noise of what it was: that state is now certain, up to what R (or Q) adds.
template <class NX>
inline bool determined(NX nx, const double* P, const double* was) {
    bool any = false;
    for (int i = 0; i < nx; i++) any = any || P[i * nx + i] < rounding * was[i];
    return any;
}

// Of such states keep the part M that was not found by cancellation: P stays positive semidefinite.
template <class NX>
inline void clear(NX nx, const double* M, const double* was, double* P) {
    for (int i = 0; i < nx; i++) {
        if (!(P[i * nx + i] < rounding * was[i])) continue;
        for (int j = 0; j < nx; j++) P[i * nx + j] = P[j * nx + i] = M[i * nx + j];
    }
}

// The correction by one output. Holds C', reused while C stays the same matrix.
template <class NX, class NY>
struct Correction {
    NX nx;
    NY ny;
    Room<room<NY, NX>> Ct_, CP_, Kt_, Cm_, Cmt_;
    Room<room<NY, NY>> S_, L_, Rm_, RK_;
    Room<room<NX, NX>> Zt_, PZ_;
    Room<room<NY>> d_, di_, v_, z_, floor_;
    Room<room<NX>> var_;
    Room<room<NY, NX>> RKt_;
    double *Ct, *CP, *Kt, *Cm, *Cmt, *S, *L, *Rm, *Zt, *PZ, *d, *di, *v, *z, *floor, *var, *RKt;
    const double* C_of_Ct = nullptr;
    LogProduct dets;
    double ll_quad = 0.0;  // sum of v' S^-1 v
    std::int64_t n_used = 0;

    Correction(NX n, NY m, Arena& w) : nx(n), ny(m) {
        const int nm = n * m, mm = m * m, nn = n * n;
        Ct = Ct_.get(w, nm); CP = CP_.get(w, nm); Kt = Kt_.get(w, nm); Cm = Cm_.get(w, nm); Cmt = Cmt_.get(w, nm);
        RKt = RKt_.get(w, nm);
        S = S_.get(w, mm); L = L_.get(w, mm); Rm = Rm_.get(w, mm);
        Zt = Zt_.get(w, nn); PZ = PZ_.get(w, nn);
        d = d_.get(w, m); di = di_.get(w, m); v = v_.get(w, m); z = z_.get(w, m); floor = floor_.get(w, m);
        var = var_.get(w, n);
    }

    // log-likelihood of all rows since the last call of `forget`
    double loglik() const { return -0.5 * (ll_quad + dets.log() + log_2pi * static_cast<double>(n_used)); }

    // Fold y into the belief x (nx), P (nx,nx), both in place. Returns a KalmanCode; `ll`, `nis` may be null.
    inline int operator()(const double* C, const double* R, const double* off, const double* y, const std::uint8_t* seen,
                          double* x, double* P, double* ll, double* nis) {
        int k = 0;
        for (int i = 0; i < ny; i++) k += seen[i] != 0;
        if (k == 0) {
            if (ll) *ll = 0.0;
            if (nis) *nis = 0.0;
            return kalman_ok;
        }
        if (C != C_of_Ct) {
            transpose(ny, nx, C, Ct);
            C_of_Ct = C;
        }
        const double* c = C;
        const double* ct = Ct;
        const double* r = R;
        if (k == ny) {
            copy(ny, y, v);
            if (off) axpy(ny, -1.0, off, v);
        } else {  // unseen entries: no row of C, an uncorrelated unit of R
            for (int i = 0; i < ny; i++) {
                const bool s = seen[i] != 0;
                v[i] = s ? (off ? y[i] - off[i] : y[i]) : 0.0;
                for (int j = 0; j < nx; j++) Cm[i * nx + j] = s ? C[i * nx + j] : 0.0;
                for (int j = 0; j < ny; j++) Rm[i * ny + j] = s && seen[j] ? R[i * ny + j] : (i == j ? 1.0 : 0.0);
            }
            transpose(ny, nx, Cm, Cmt);
            c = Cm;
            ct = Cmt;
            r = Rm;
        }
        mul<Op::sub>(Dim<1>(), nx, ny, x, ct, v);  // innovation
        mul(ny, nx, nx, c, P, CP);
        for (int i = 0; i < ny; i++) copy(ny, r + i * ny, S + i * ny);
        mul<Op::add>(ny, nx, ny, CP, ct, S);
        for (int i = 0; i < nx; i++) var[i] = P[i * nx + i];
        for (int i = 0; i < ny; i++) {  // what is left of C P C' after cancellation may be rounding only
            floor[i] = 0.0;
            if (r[i * ny + i] < 0.5 * S[i * ny + i] || !(S[i * ny + i] > 0.0)) {
                for (int j = 0; j < nx; j++) floor[i] += c[i * nx + j] * c[i * nx + j] * var[j];
                floor[i] *= rounding * nx;
                if (!(S[i * ny + i] > floor[i])) for (int j = 0; j < ny; j++) S[i * ny + j] = S[j * ny + i] = 0.0;
            }
        }
        const int vanished = ldl(ny, S, L, d, di);

        // A negative pivot is rounding of a belief already certain: left out as well. Overflow shows in x and P.
        int code = vanished ? kalman_reduced : kalman_ok;
        double quad = 0.0, det = 0.0;
        for (int i = 0; i < ny; i++) {
            double s = v[i];
            for (int j = 0; j < i; j++) s -= L[i * ny + j] * z[j];
            z[i] = s;
            quad += s * s * di[i];
            if (d[i] > 0.0) {
                dets.times(d[i]);
                n_used++;
                if (ll) det += std::log(d[i]) + log_2pi;
            } else if (code == kalman_reduced) {
                const double size = std::fabs(y[i]) + std::fabs(y[i] - v[i]) + std::sqrt(std::fabs(S[i * ny + i]));
                if (std::fabs(s) > 1e-6 * size + 1e3 * std::sqrt(floor[i])) code = kalman_contradicted;
            }
        }
        if (quad > 1e12) code = kalman_contradicted;
        if (k < ny) {  // the unit pivots of unseen entries are no data
            n_used -= ny - k;
            if (ll) det -= (ny - k) * log_2pi;
        }
        ll_quad += quad;
        if (ll) *ll = -0.5 * (quad + det);
        if (nis) *nis = quad;

        for (int i = 0; i < ny; i++) copy(nx, CP + i * nx, Kt + i * nx);
        ldl_solve(ny, nx, L, di, Kt);  // K' = S^-1 C P
        mul<Op::add>(Dim<1>(), ny, nx, v, Kt, x);
        for (int i = 0; i < nx; i++) {
            fill(nx, 0.0, Zt + i * nx);
            Zt[i * nx + i] = 1.0;
        }
        mul_tn<Op::sub>(nx, ny, nx, c, Kt, Zt);  // Z' = I - C' K'
        mul(nx, nx, nx, P, Zt, PZ);
        mul(ny, ny, nx, r, Kt, RKt);
        mul_tn(nx, nx, nx, Zt, PZ, P);
        mul_tn<Op::add>(nx, ny, nx, Kt, RKt, P);
        symmetrise(nx, P);
        if (determined(nx, P, var)) {
            mul_tn(nx, ny, nx, Kt, RKt, PZ);
            symmetrise(nx, PZ);
            clear(nx, PZ, var, P);
        }
        return code;
    }
};

// x <- A x + B u + b, P <- A P A' + Q, in place. Holds A', reused while A stays the same matrix.
template <class NX>
struct Prediction {
    NX nx;
    Room<room<NX, NX>> At_, AP_;
    Room<room<NX>> xn_;
    double *At, *AP, *xn;
    const double* A_of_At = nullptr;

    Prediction(NX n, Arena& w) : nx(n) {
        At = At_.get(w, n * n); AP = AP_.get(w, n * n); xn = xn_.get(w, n);
        fill(Dim<0>(n * n), 0.0, At);
    }
    inline void transition(const double* A) {
        if (A != A_of_At) {
            transpose(nx, nx, A, At);
            A_of_At = A;
        }
    }
    inline void mean(const double* B, const double* u, int nu, const double* b, const double* x, double* out) {
        mul(Dim<1>(), nx, nx, x, At, out);
        if (u) mul_v<Op::add>(nx, Dim<0>(nu), B, u, out);
        if (b) axpy(nx, 1.0, b, out);
    }
    inline void operator()(const double* A, const double* B, const double* u, int nu, const double* b, const double* Q,
                           double* x, double* P) {
        transition(A);
        mean(B, u, nu, b, x, xn);
        copy(nx, xn, x);
        mul(nx, nx, nx, A, P, AP);
        for (int i = 0; i < nx; i++) copy(nx, Q + i * nx, P + i * nx);
        mul<Op::add>(nx, nx, nx, AP, At, P);
        symmetrise(nx, P);
    }
};

// One step back: the gain G = P A' (A P A' + Q)^-1 of x[t-1] on x[t], from the filtered P of x[t-1].
template <class NX>
struct Retrodiction {
    NX nx;
    Room<room<NX, NX>> AP_, Pp_, L_, Gt_, Zt_, W_, T_;
    Room<room<NX>> d_, di_, xp_, dx_, var_;
    double *AP, *Pp, *L, *Gt, *Zt, *W, *T, *d, *di, *xp, *dx, *var;

    Retrodiction(NX n, Arena& w) : nx(n) {
        const int nn = n * n;
        AP = AP_.get(w, nn); Pp = Pp_.get(w, nn); L = L_.get(w, nn); Gt = Gt_.get(w, nn); Zt = Zt_.get(w, nn);
        W = W_.get(w, nn); T = T_.get(w, nn);
        d = d_.get(w, n); di = di_.get(w, n); xp = xp_.get(w, n); dx = dx_.get(w, n);
        var = var_.get(w, n);
    }
    // Gt (nx,nx) = G', Zt = I - A' G'
    inline void gain(const double* A, const double* At, const double* P, const double* Q) {
        mul(nx, nx, nx, A, P, AP);
        for (int i = 0; i < nx; i++) copy(nx, Q + i * nx, Pp + i * nx);
        mul<Op::add>(nx, nx, nx, AP, At, Pp);
        ldl(nx, Pp, L, d, di);
        for (int i = 0; i < nx; i++) copy(nx, AP + i * nx, Gt + i * nx);
        ldl_solve(nx, nx, L, di, Gt);
        for (int i = 0; i < nx; i++) {
            fill(nx, 0.0, Zt + i * nx);
            Zt[i * nx + i] = 1.0;
        }
        mul_tn<Op::sub>(nx, nx, nx, A, Gt, Zt);
    }
    // out = Z P Z' + G W G', after `gain`
    inline void covariance(const double* P, const double* W_, double* out) {
        for (int i = 0; i < nx; i++) var[i] = P[i * nx + i];
        mul(nx, nx, nx, P, Zt, T);
        mul_tn(nx, nx, nx, Zt, T, AP);  // AP is free again; out may be P itself
        mul(nx, nx, nx, W_, Gt, T);
        mul_tn<Op::add>(nx, nx, nx, Gt, T, AP);
        for (int i = 0; i < nx; i++) copy(nx, AP + i * nx, out + i * nx);
        symmetrise(nx, out);
        if (determined(nx, out, var)) {
            mul_tn(nx, nx, nx, Gt, T, AP);
            symmetrise(nx, AP);
            clear(nx, AP, var, out);
        }
    }
    // x <- x + G (xs - xp), in place
    inline void mean(const double* xs, double* x) {
        for (int i = 0; i < nx; i++) dx[i] = xs[i] - xp[i];
        mul<Op::add>(Dim<1>(), nx, nx, dx, Gt, x);
    }
};

inline void note(Kalman& k, int code, std::int64_t t) {
    if (code > k.code) {
        k.code = code;
        k.row = t;
    }
}

template <class NX>
inline bool sound(NX nx, const double* x, const double* P) {  // for a PSD matrix the diagonal bounds the rest
    double s = 0.0;
    for (int i = 0; i < nx; i++) s += x[i] * 0.0 + P[i * nx + i] * 0.0;
    return s == 0.0;
}

// The filter, row by row. Writes x, P and what else is asked.
template <class NX, class NY>
struct FilterPass {
    NX nx;
    NY ny;
    Kalman& k;
    Correction<NX, NY> correct;
    Prediction<NX> predict;
    Room<room<NX>> x_;
    Room<room<NX, NX>> P_;
    Room<room<NY, NX>> CP_;
    double *x, *P, *CP;
    std::ptrdiff_t nn, mm;

    FilterPass(NX n, NY m, Kalman& k_, Arena w) : nx(n), ny(m), k(k_), correct(n, m, w), predict(n, w), nn(n * n), mm(m * m) {
        x = x_.get(w, n); P = P_.get(w, n * n); CP = CP_.get(w, n * m);
        copy(nx, k.x0, x);
        for (int i = 0; i < nx; i++) copy(nx, k.P0 + i * nx, P + i * nx);
    }
    FilterPass(const FilterPass&) = delete;

    // False when the belief broke at this row. Not inlined: two series run row by row in turns, and while one waits for
    // its own last row the machine works on the other; both must round alike, alone or in company.
    [[gnu::noinline]] bool row(std::int64_t t) {
        const double *A = k.A.at(t), *C = k.C.at(t), *R = k.R.at(t);
        const double *off = k.d ? k.d + t * ny : nullptr, *y = k.y + t * ny;
        const std::uint8_t* seen = k.seen + t * ny;
        predict(A, k.u ? k.B.at(t) : nullptr, k.u ? k.u + t * k.nu : nullptr, k.nu, k.b ? k.b + t * nx : nullptr,
                k.Q.at(t), x, P);
        if (k.xp) {
            copy(nx, x, k.xp + t * nx);
            for (int i = 0; i < nx; i++) copy(nx, P + i * nx, k.Pp + t * nn + i * nx);
        }
        if (k.yp) {
            for (int i = 0; i < ny; i++) k.yp[t * ny + i] = dot(nx, C + i * nx, x) + (off ? off[i] : 0.0);
            double* S = k.S + t * mm;
            mul(ny, nx, nx, C, P, CP);
            mul_nt(ny, nx, ny, CP, C, S);
            for (int i = 0; i < ny * ny; i++) S[i] += R[i];
            symmetrise(ny, S);
        }
        double *ll = k.ll ? k.ll + t : nullptr, *nis = k.nis ? k.nis + t : nullptr;
        int code = sound(nx, x, P) ? correct(C, R, off, y, seen, x, P, ll, nis) : static_cast<int>(kalman_broken);
        if (code) {
            k.n_reduced += code == kalman_reduced || code == kalman_contradicted;
            note(k, code, t);
        }
        if (code == kalman_broken || !sound(nx, x, P)) {
            note(k, kalman_broken, t);
            return false;
        }
        copy(nx, x, k.x + t * nx);
        for (int i = 0; i < nx; i++) copy(nx, P + i * nx, k.P + t * nn + i * nx);
        return true;
    }

    // Ends the pass after `t` rows with a sound belief: the rows from there on hold the last one.
    std::int64_t finish(std::int64_t t) {
        k.loglik = correct.loglik();
        k.n_seen = correct.n_used;
        const std::int64_t good = t;
        const double* x_last = good ? k.x + (good - 1) * nx : k.x0;
        const double* P_last = good ? k.P + (good - 1) * nn : k.P0;
        for (; t < k.T; t++) {  // broken: hold the last finite belief
            for (int i = 0; i < nx; i++) k.x[t * nx + i] = x_last[i];
            for (int i = 0; i < nn; i++) k.P[t * nn + i] = P_last[i];
            if (k.xp) {
                for (int i = 0; i < nx; i++) k.xp[t * nx + i] = x_last[i];
                for (int i = 0; i < nn; i++) k.Pp[t * nn + i] = P_last[i];
            }
            if (k.yp) {
                for (int i = 0; i < ny; i++) k.yp[t * ny + i] = 0.0;
                for (int i = 0; i < mm; i++) k.S[t * mm + i] = 0.0;
            }
            if (k.ll) k.ll[t] = 0.0;
            if (k.nis) k.nis[t] = 0.0;
        }
        return good;
    }
};

// Adds E[e e'] and its companions of row t; x, P are the smoothed belief.
template <class NX>
struct OutputSums {
    using NY = Dim<0>;
    NX nx;
    NY ny;
    Room<room<NY, NX>> CP_;
    Room<room<NY, NY>> E_, Rm_, L_, Rs_, Mt_, T_;
    Room<room<NY>> v_, d_, di_;
    Room<room<NY, NX>> ex_;
    double *CP, *E, *Rm, *L, *Rs, *Mt, *T, *v, *d, *di, *ex;

    OutputSums(NX n, int m, Arena& w) : nx(n), ny(m) {
        const int nm = n * m, mm = m * m;
        CP = CP_.get(w, nm); ex = ex_.get(w, nm);
        E = E_.get(w, mm); Rm = Rm_.get(w, mm); L = L_.get(w, mm); Rs = Rs_.get(w, mm); Mt = Mt_.get(w, mm); T = T_.get(w, mm);
        v = v_.get(w, m); d = d_.get(w, m); di = di_.get(w, m);
    }
    inline void add(const Kalman& k, std::int64_t t, const double* x, const double* P) {
        const std::uint8_t* seen = k.seen + t * ny;
        int n_seen = 0;
        for (int i = 0; i < ny; i++) n_seen += seen[i] != 0;
        if (n_seen == 0) return;
        const double *C = k.C.at(t), *R = k.R.at(t), *y = k.y + t * ny, *off = k.d ? k.d + t * ny : nullptr;
        for (int i = 0; i < ny; i++)
            v[i] = seen[i] ? y[i] - (off ? off[i] : 0.0) - dot(nx, C + i * nx, x) : 0.0;
        mul(ny, nx, nx, C, P, CP);
        mul_nt(ny, nx, ny, CP, C, E);
        for (int i = 0; i < ny; i++)
            for (int j = 0; j < ny; j++) E[i * ny + j] = seen[i] && seen[j] ? E[i * ny + j] + v[i] * v[j] : 0.0;
        for (int i = 0; i < ny; i++)
            for (int j = 0; j < nx; j++) ex[i * nx + j] = seen[i] ? v[i] * x[j] - CP[i * nx + j] : 0.0;
        KalmanSums& s = *k.sums;
        double* V = s.V + k.R.entry(t) * ny * ny;
        if (n_seen == ny) {
            for (int i = 0; i < ny * ny; i++) V[i] += E[i];
            for (int i = 0; i < ny * nx; i++) s.Vx[i] += ex[i];
        } else {
            // e = M e_seen + (what R leaves of the unseen part): M' = R_ss^-1 R_s, with seen columns the identity
            for (int i = 0; i < ny; i++)
                for (int j = 0; j < ny; j++) {
                    Rm[i * ny + j] = seen[i] && seen[j] ? R[i * ny + j] : (i == j ? 1.0 : 0.0);
                    Rs[i * ny + j] = Mt[i * ny + j] = seen[i] && !seen[j] ? R[i * ny + j] : 0.0;
                }
            ldl(ny, Rm, L, d, di);
            ldl_solve(ny, ny, L, di, Mt);
            for (int i = 0; i < ny; i++)
                if (!seen[i]) for (int j = 0; j < ny; j++) V[i * ny + j] += seen[j] ? 0.0 : R[i * ny + j];
            mul_tn<Op::sub>(ny, ny, ny, Rs, Mt, V);
            for (int i = 0; i < ny; i++) if (seen[i]) Mt[i * ny + i] = 1.0;
            mul(ny, ny, ny, E, Mt, T);
            mul_tn<Op::add>(ny, ny, ny, Mt, T, V);
            mul_tn<Op::add>(ny, ny, nx, Mt, ex, s.Vx);
        }
        for (int i = 0; i < nx; i++)
            for (int j = 0; j < nx; j++) s.Xy[i * nx + j] += P[i * nx + j] + x[i] * x[j];
        s.nV[k.R.entry(t)] += 1.0;
    }
};

// Adds E[w w'] and its companions of the step into row t: x, P smoothed at t; x1, P1 at t-1; S the covariance of x[t-1]
// given x[t] and the outputs before t; G' the gain.
template <class NX>
struct StateSums {
    NX nx;
    Room<room<NX, NX>> Ht_, T_, M_;
    Room<room<NX>> m_;
    double *Ht, *T, *M, *m;

    StateSums(NX n, Arena& w) : nx(n) {
        Ht = Ht_.get(w, n * n); T = T_.get(w, n * n); M = M_.get(w, n * n); m = m_.get(w, n);
    }
    inline void add(const Kalman& k, std::int64_t t, const double* x, const double* P, const double* x1, const double* P1,
                    const double* S, const double* At, const double* Gt) {
        KalmanSums& s = *k.sums;
        const double* A = k.A.at(t);
        // mean of w
        for (int i = 0; i < nx; i++) m[i] = x[i] - (k.b ? k.b[t * nx + i] : 0.0) - dot(nx, A + i * nx, x1);
        const double* u = k.u ? k.u + t * k.nu : nullptr;
        if (u) mul_v<Op::sub>(nx, Dim<0>(k.nu), k.B.at(t), u, m);
        // cov of w = H P H' + A S A', H = I - A G
        for (int i = 0; i < nx; i++)
            for (int j = 0; j < nx; j++) Ht[i * nx + j] = i == j ? 1.0 : 0.0;
        mul<Op::sub>(nx, nx, nx, Gt, At, Ht);
        mul(nx, nx, nx, P, Ht, T);
        mul_tn(nx, nx, nx, Ht, T, M);
        mul(nx, nx, nx, S, At, T);
        mul<Op::add>(nx, nx, nx, A, T, M);
        double* W = s.W + k.Q.entry(t) * nx * nx;
        for (int i = 0; i < nx; i++)
            for (int j = 0; j < nx; j++) W[i * nx + j] += 0.5 * (M[i * nx + j] + M[j * nx + i]) + m[i] * m[j];
        s.nW[k.Q.entry(t)] += 1.0;
        // cov of w with x[t-1] = P G' - A P1
        mul(nx, nx, nx, P, Gt, M);
        mul<Op::sub>(nx, nx, nx, A, P1, M);
        for (int i = 0; i < nx; i++)
            for (int j = 0; j < nx; j++) {
                s.Wx[i * nx + j] += M[i * nx + j] + m[i] * x1[j];
                s.Xx[i * nx + j] += P1[i * nx + j] + x1[i] * x1[j];
            }
        if (u) {
            for (int i = 0; i < nx; i++)
                for (int j = 0; j < k.nu; j++) {
                    s.Wu[i * k.nu + j] += m[i] * u[j];
                    s.Xu[i * k.nu + j] += x1[i] * u[j];
                }
            for (int i = 0; i < k.nu; i++)
                for (int j = 0; j < k.nu; j++) s.Uu[i * k.nu + j] += u[i] * u[j];
        }
    }
};

// The smoother, row by row back over the filtered rows 0..good-1, in place.
template <class NX>
struct SmootherPass {
    NX nx;
    Kalman& k;
    Prediction<NX> predict;
    Retrodiction<NX> back;
    OutputSums<NX> output;
    StateSums<NX> state;
    Room<room<NX>> x_;
    Room<room<NX, NX>> P_, S_;
    double *x, *P, *S;
    std::ptrdiff_t nn;
    std::int64_t last;  // down to this row: 0 if the step from row -1 is wanted, else 1

    SmootherPass(NX n, Kalman& k_, std::int64_t good, Arena w)
        : nx(n), k(k_), predict(n, w), back(n, w), output(n, k_.ny, w), state(n, w), nn(n * n) {
        x = x_.get(w, n); P = P_.get(w, n * n); S = S_.get(w, n * n);
        last = k.x0s || k.sums || k.Pl ? 0 : 1;
        copy(nx, k.x0, x);
        for (int i = 0; i < nx; i++) copy(nx, k.P0 + i * nx, P + i * nx);
        if (k.sums && good > 0) output.add(k, good - 1, k.x + (good - 1) * nx, k.P + (good - 1) * nn);
    }
    SmootherPass(const SmootherPass&) = delete;

    // The step from row t to row t - 1. Not inlined, as FilterPass::row.
    [[gnu::noinline]] void row(std::int64_t t) {
        const double *xs = k.x + t * nx, *Ps = k.P + t * nn, *A = k.A.at(t), *Q = k.Q.at(t);
        const double* x1 = t ? k.x + (t - 1) * nx : k.x0;
        const double* P1 = t ? k.P + (t - 1) * nn : k.P0;
        predict.transition(A);
        predict.mean(k.u ? k.B.at(t) : nullptr, k.u ? k.u + t * k.nu : nullptr, k.nu, k.b ? k.b + t * nx : nullptr, x1,
                     back.xp);
        back.gain(A, predict.At, P1, Q);
        if (k.sums) back.covariance(P1, Q, S);
        for (int i = 0; i < nx; i++) {
            copy(nx, Ps + i * nx, back.W + i * nx);
            axpy(nx, 1.0, Q + i * nx, back.W + i * nx);
        }
        double* xo = t ? k.x + (t - 1) * nx : x;
        double* Po = t ? k.P + (t - 1) * nn : P;
        back.covariance(P1, back.W, Po);
        back.mean(xs, xo);
        if (k.Pl) mul(nx, nx, nx, Ps, back.Gt, k.Pl + t * nn);
        if (k.sums) {
            state.add(k, t, xs, Ps, xo, Po, S, predict.At, back.Gt);
            if (t) output.add(k, t - 1, xo, Po);
        }
    }

    void finish() {
        if (!k.x0s) return;
        copy(nx, x, k.x0s);
        for (int i = 0; i < nx; i++) copy(nx, P + i * nx, k.P0s + i * nx);
    }
};

// The last `lag` steps back, kept in a ring: of the step into row t, G', the covariance of x[t-1] given x[t], and the
// means x[t-1] filtered and x[t] predicted.
template <class NX>
struct LagRing {
    NX nx;
    std::int64_t lag;
    double* a;  // (lag, 2 nx nx + 2 nx)

    inline double* slot(std::int64_t t) const { return a + (t % lag) * (2 * nx * nx + 2 * nx); }
    inline void put(std::int64_t t, Retrodiction<NX>& back, const double* A, const double* At, const double* Q,
                    const double* x1, const double* P1) {
        double* s = slot(t);
        back.gain(A, At, P1, Q);
        for (int i = 0; i < nx; i++) copy(nx, back.Gt + i * nx, s + i * nx);
        back.covariance(P1, Q, s + nx * nx);
        copy(nx, x1, s + 2 * nx * nx);
        copy(nx, back.xp, s + 2 * nx * nx + nx);
    }
    // From the belief x, P of row t (in place) back to row `to`.
    inline void walk(std::int64_t t, std::int64_t to, Retrodiction<NX>& back, double* x, double* P) {
        for (; t > to; t--) {
            const double* s = slot(t);
            for (int i = 0; i < nx; i++) back.dx[i] = x[i] - s[2 * nx * nx + nx + i];
            copy(nx, s + 2 * nx * nx, x);
            mul<Op::add>(Dim<1>(), nx, nx, back.dx, s, x);
            mul(nx, nx, nx, P, s, back.T);
            for (int i = 0; i < nx; i++) copy(nx, s + nx * nx + i * nx, P + i * nx);
            mul_tn<Op::add>(nx, nx, nx, s, back.T, P);
            symmetrise(nx, P);
        }
    }
};

// One series, or two in turns (`k2` may be null); `good` counts the rows with a sound belief of each.
template <class NX, class NY>
[[gnu::noinline]] void filter(NX nx, NY ny, Kalman& k, Kalman* k2, std::int64_t* good) {
    FilterPass<NX, NY> a(nx, ny, k, Arena{k.work});
    std::int64_t t = 0;
    bool fine = true;
    if (k2) {
        FilterPass<NX, NY> b(nx, ny, *k2, Arena{k2->work});
        std::int64_t t2 = 0;
        bool fine2 = true;
        while (t < k.T && t2 < k2->T && fine && fine2) {
            fine = a.row(t);
            fine2 = b.row(t2);
            t += fine;
            t2 += fine2;
        }
        while (fine2 && t2 < k2->T) t2 += fine2 = b.row(t2);
        good[1] = b.finish(t2);
    }
    while (fine && t < k.T) t += fine = a.row(t);
    good[0] = a.finish(t);
}

template <class NX>
[[gnu::noinline]] void smooth(NX nx, Kalman& k, Kalman* k2, const std::int64_t* good) {
    SmootherPass<NX> a(nx, k, good[0], Arena{k.work});
    std::int64_t t = good[0] - 1;
    if (k2) {
        SmootherPass<NX> b(nx, *k2, good[1], Arena{k2->work});
        std::int64_t t2 = good[1] - 1;
        for (; t >= a.last && t2 >= b.last; t--, t2--) {
            a.row(t);
            b.row(t2);
        }
        for (; t2 >= b.last; t2--) b.row(t2);
        b.finish();
    }
    for (; t >= a.last; t--) a.row(t);
    a.finish();
}

// Fixed-lag smoother, in place over the filtered rows: row t becomes its belief given the rows up to min(t + lag, T - 1).
template <class NX>
[[gnu::noinline]] void smooth_lag(NX nx, Kalman& k, std::int64_t good, Arena w) {
    if (k.lag <= 0 || good < 2) return;
    Prediction<NX> predict(nx, w);
    Retrodiction<NX> back(nx, w);
    Room<room<NX>> x_;
    Room<room<NX, NX>> P_;
    double *x = x_.get(w, nx), *P = P_.get(w, nx * nx);
    const std::ptrdiff_t nn = nx * nx;
    LagRing<NX> ring{nx, k.lag, w.take(k.lag * (2 * nn + 2 * nx))};
    for (std::int64_t t = 1; t < good + k.lag; t++) {
        const std::int64_t head = t < good ? t : good - 1, to = t - k.lag;
        if (t < good) {
            const double *A = k.A.at(t), *x1 = k.x + (t - 1) * nx;
            predict.transition(A);
            predict.mean(k.u ? k.B.at(t) : nullptr, k.u ? k.u + t * k.nu : nullptr, k.nu, k.b ? k.b + t * nx : nullptr, x1,
                         back.xp);
            ring.put(t, back, A, predict.At, k.Q.at(t), x1, k.P + (t - 1) * nn);
        }
        if (to < 0 || to >= head) continue;
        copy(nx, k.x + head * nx, x);
        for (int i = 0; i < nx; i++) copy(nx, k.P + head * nn + i * nx, P + i * nx);
        ring.walk(head, to, back, x, P);
        copy(nx, x, k.x + to * nx);
        for (int i = 0; i < nx; i++) copy(nx, P + i * nx, k.P + to * nn + i * nx);
    }
}

}  // namespace HW_ISA

// One online step: the belief x, P in place, an optional ring of lag entries (see LagRing).
struct KalmanPush {
    int nx = 0, ny = 0, nu = 0;
    const double *A = nullptr, *B = nullptr, *C = nullptr, *Q = nullptr, *R = nullptr;
    const double* u = nullptr;
    const double* y = nullptr;
    const std::uint8_t* seen = nullptr;
    double *x = nullptr, *P = nullptr;    // newest belief, in and out
    std::int64_t t = 0, lag = 0;          // rows pushed before this one
    double* ring = nullptr;               // (lag, 2 nx nx + 2 nx)
    double *xl = nullptr, *Pl = nullptr;  // out: the belief of row max(t - lag, 0) (lag > 0)
    double ll = 0.0, nis = 0.0;
    int code = kalman_ok;
    double* work = nullptr;
};

}  // namespace hw

// One series, or two of equal sizes in turns (the second may be null), each with its own workspace.
HW_KERNEL(void, kalman_filter, ::hw::Kalman&, ::hw::Kalman*)
HW_KERNEL(void, kalman_smooth, ::hw::Kalman&, ::hw::Kalman*)
HW_KERNEL(void, kalman_lag, ::hw::Kalman&, ::hw::Kalman*)
HW_KERNEL(void, kalman_push, ::hw::KalmanPush&)
