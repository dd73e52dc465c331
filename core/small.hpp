// Small dense algebra on raw row-major arrays: one set of functions for sizes known when compiling and for sizes known
// only when running.
//
// A size is a `Dim<N>`: `Dim<4>` converts to the constant 4, so every loop unrolls and rows live in registers; `Dim<0>`
// carries a run-time number. The functions take sizes first, then inputs, then outputs; outputs never alias inputs
// unless the name says "in place". Nothing allocates, nothing throws.
//
// Symmetric positive semidefinite systems are factored as L D L' without pivoting. A pivot that has fallen below
// `tiny_pivot` times its own diagonal entry is rounding noise, not information: its reciprocal is taken as 0, so the
// direction is left out of every solve (a generalised inverse, exact for right-hand sides in the range). Nothing is
// divided by zero and no NaN is born here.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

#include "isa.hpp"

#if defined(__SSE2__)
#include <xmmintrin.h>
#endif

namespace hw {
namespace HW_ISA {

// Within its scope numbers too small to be normal (below 2e-308) count as 0. Covariances of things that never meet decay
// into that range, where each operation costs a hundred times more. Made at the entry of a kernel.
struct FlushTiny {
#if defined(__SSE2__)
    unsigned was = _mm_getcsr();
    FlushTiny() { _mm_setcsr(was | 0x8040u); }
    ~FlushTiny() { _mm_setcsr(was); }
#else
    FlushTiny() {}
    ~FlushTiny() {}
#endif
    FlushTiny(const FlushTiny&) = delete;
};

template <int N>
struct Dim {
    static constexpr bool fixed = true;
    static constexpr int cap = N;  // an upper limit for local arrays
    constexpr Dim(int = N) {}
    constexpr operator int() const { return N; }
};
template <>
struct Dim<0> {
    static constexpr bool fixed = false;
    static constexpr int cap = 1;
    int n;
    constexpr Dim(int n_) : n(n_) {}
    constexpr operator int() const { return n; }
};

enum class Op { set, add, sub };

constexpr double eps = 2.220446049250313e-16;
constexpr double smallest = 2.2250738585072014e-308;  // normal number
constexpr double log_2pi = 1.8378770664093454836;

inline double max2(double a, double b) { return a > b ? a : b; }
inline double min2(double a, double b) { return a < b ? a : b; }
inline bool finite(double a) { return a - a == 0.0; }

// ---- a row of N doubles kept in vector registers -----------------------------------------------------------------

typedef double V2 __attribute__((vector_size(16)));
typedef double V4 __attribute__((vector_size(32)));
typedef double V2u __attribute__((vector_size(16), aligned(8), may_alias));
typedef double V4u __attribute__((vector_size(32), aligned(8), may_alias));

template <int N>
struct Row {
    V4 h;
    Row<N - 4> t;
    static inline Row zero() { return {V4{}, Row<N - 4>::zero()}; }
    static inline Row load(const double* a) { return {*reinterpret_cast<const V4u*>(a), Row<N - 4>::load(a + 4)}; }
    inline void store(double* a) const { *reinterpret_cast<V4u*>(a) = h; t.store(a + 4); }
    inline void axpy(double s, const Row& b) { h += s * b.h; t.axpy(s, b.t); }
    inline void axmy(double s, const Row& b) { h -= s * b.h; t.axmy(s, b.t); }
    inline void scale(double s) { h *= s; t.scale(s); }
};
template <>
struct Row<0> {
    static inline Row zero() { return {}; }
    static inline Row load(const double*) { return {}; }
    inline void store(double*) const {}
    inline void axpy(double, const Row&) {}
    inline void axmy(double, const Row&) {}
    inline void scale(double) {}
};
template <>
struct Row<1> {
    double h;
    static inline Row zero() { return {0.0}; }
    static inline Row load(const double* a) { return {*a}; }
    inline void store(double* a) const { *a = h; }
    inline void axpy(double s, const Row& b) { h += s * b.h; }
    inline void axmy(double s, const Row& b) { h -= s * b.h; }
    inline void scale(double s) { h *= s; }
};
template <>
struct Row<2> {
    V2 h;
    static inline Row zero() { return {V2{}}; }
    static inline Row load(const double* a) { return {*reinterpret_cast<const V2u*>(a)}; }
    inline void store(double* a) const { *reinterpret_cast<V2u*>(a) = h; }
    inline void axpy(double s, const Row& b) { h += s * b.h; }
    inline void axmy(double s, const Row& b) { h -= s * b.h; }
    inline void scale(double s) { h *= s; }
};
template <>
struct Row<3> {
    V2 h;
    double t;
    static inline Row zero() { return {V2{}, 0.0}; }
    static inline Row load(const double* a) { return {*reinterpret_cast<const V2u*>(a), a[2]}; }
    inline void store(double* a) const { *reinterpret_cast<V2u*>(a) = h; a[2] = t; }
    inline void axpy(double s, const Row& b) { h += s * b.h; t += s * b.t; }
    inline void axmy(double s, const Row& b) { h -= s * b.h; t -= s * b.t; }
    inline void scale(double s) { h *= s; t *= s; }
};

// ---- vectors ------------------------------------------------------------------------------------------------------

template <class N>
inline void copy(N n, const double* a, double* out) {
    if constexpr (N::fixed) {
        Row<N::cap>::load(a).store(out);
    } else {
        for (int i = 0; i < n; i++) out[i] = a[i];
    }
}

template <class N>
inline void fill(N n, double s, double* out) {
    for (int i = 0; i < n; i++) out[i] = s;
}

// y += s x
template <class N>
inline void axpy(N n, double s, const double* x, double* y) {
    if constexpr (N::fixed) {
        auto r = Row<N::cap>::load(y);
        r.axpy(s, Row<N::cap>::load(x));
        r.store(y);
    } else {
        for (int i = 0; i < n; i++) y[i] += s * x[i];
    }
}

template <class N>
inline double dot(N n, const double* a, const double* b) {
    double s = 0.0;
    for (int i = 0; i < n; i++) s += a[i] * b[i];
    return s;
}

template <class N>
inline bool all_finite(N n, const double* a) {
    double s = 0.0;  // a sum of zeros unless some entry is inf or NaN
    for (int i = 0; i < n; i++) s += a[i] * 0.0;
    return s == 0.0;
}

// ---- products: C (m,n) =, +=, -= ... -------------------------------------------------------------------------------

// C (m,n) op A (m,k) B (k,n), where entry (i,l) of A stands at A[i * down + l * right]
template <Op op, class M, class K, class N, class Down, class Right>
inline void mul_strided(M m, K k, N n, const double* A, Down down, Right right, const double* B, double* C) {
    if constexpr (N::fixed) {
        constexpr int c = N::cap;
        for (int i = 0; i < m; i++) {
            Row<c> s = op == Op::set ? Row<c>::zero() : Row<c>::load(C + i * c);
            for (int l = 0; l < k; l++) {
                if constexpr (op == Op::sub) s.axmy(A[i * down + l * right], Row<c>::load(B + l * c));
                else s.axpy(A[i * down + l * right], Row<c>::load(B + l * c));
            }
            s.store(C + i * c);
        }
    } else {
        for (int i = 0; i < m; i++) {
            double* __restrict c = C + static_cast<std::ptrdiff_t>(i) * n;
            if (op == Op::set) for (int j = 0; j < n; j++) c[j] = 0.0;
            for (int l = 0; l < k; l++) {
                const double s = op == Op::sub ? -A[i * down + l * right] : A[i * down + l * right];
                const double* __restrict b = B + static_cast<std::ptrdiff_t>(l) * n;
                for (int j = 0; j < n; j++) c[j] += s * b[j];
            }
        }
    }
}

// C (m,n) op A B, A (m,k), B (k,n)
template <Op op = Op::set, class M, class K, class N>
inline void mul(M m, K k, N n, const double* A, const double* B, double* C) {
    mul_strided<op>(m, k, n, A, k, Dim<1>(), B, C);
}

// C (m,n) op A' B, A (k,m), B (k,n)
template <Op op = Op::set, class M, class K, class N>
inline void mul_tn(M m, K k, N n, const double* A, const double* B, double* C) {
    mul_strided<op>(m, k, n, A, Dim<1>(), m, B, C);
}

// C (m,n) op A B', A (m,k), B (n,k)
template <Op op = Op::set, class M, class K, class N>
inline void mul_nt(M m, K k, N n, const double* A, const double* B, double* C) {
    for (int i = 0; i < m; i++) {
        for (int j = 0; j < n; j++) {
            double s = 0.0;
            for (int l = 0; l < k; l++) s += A[i * k + l] * B[j * k + l];
            if (op == Op::set) C[i * n + j] = s;
            else if (op == Op::add) C[i * n + j] += s;
            else C[i * n + j] -= s;
        }
    }
}

// y (m) op A (m,n) x (n)
template <Op op = Op::set, class M, class N>
inline void mul_v(M m, N n, const double* A, const double* x, double* y) {
    for (int i = 0; i < m; i++) {
        double s = 0.0;
        for (int j = 0; j < n; j++) s += A[i * n + j] * x[j];
        if (op == Op::set) y[i] = s;
        else if (op == Op::add) y[i] += s;
        else y[i] -= s;
    }
}

// y (n) op A' x, A (m,n), x (m)
template <Op op = Op::set, class M, class N>
inline void mul_tv(M m, N n, const double* A, const double* x, double* y) {
    mul<op>(Dim<1>(), m, n, x, A, y);
}

template <class M, class N>
inline void transpose(M m, N n, const double* A, double* At) {  // A (m,n) -> At (n,m)
    for (int i = 0; i < m; i++)
        for (int j = 0; j < n; j++) At[j * m + i] = A[i * n + j];
}

// P (n,n) <- (P + P') / 2, in place
template <class N>
inline void symmetrise(N n, double* P) {
    if constexpr (N::fixed && N::cap == 4) {
        // Through registers: scalar stores followed by vector loads of the same row would stall.
        typedef long long I4 __attribute__((vector_size(32)));
        V4 a = *reinterpret_cast<V4u*>(P), b = *reinterpret_cast<V4u*>(P + 4);
        V4 c = *reinterpret_cast<V4u*>(P + 8), d = *reinterpret_cast<V4u*>(P + 12);
        const V4 e = __builtin_shuffle(a, b, I4{0, 4, 2, 6}), f = __builtin_shuffle(a, b, I4{1, 5, 3, 7});
        const V4 g = __builtin_shuffle(c, d, I4{0, 4, 2, 6}), h = __builtin_shuffle(c, d, I4{1, 5, 3, 7});
        a = 0.5 * (a + __builtin_shuffle(e, g, I4{0, 1, 4, 5}));
        b = 0.5 * (b + __builtin_shuffle(f, h, I4{0, 1, 4, 5}));
        c = 0.5 * (c + __builtin_shuffle(e, g, I4{2, 3, 6, 7}));
        d = 0.5 * (d + __builtin_shuffle(f, h, I4{2, 3, 6, 7}));
        *reinterpret_cast<V4u*>(P) = a;
        *reinterpret_cast<V4u*>(P + 4) = b;
        *reinterpret_cast<V4u*>(P + 8) = c;
        *reinterpret_cast<V4u*>(P + 12) = d;
    } else {
        for (int i = 1; i < n; i++)
            for (int j = 0; j < i; j++) {
                const double s = 0.5 * P[i * n + j] + 0.5 * P[j * n + i];
                P[i * n + j] = s;
                P[j * n + i] = s;
            }
    }
}

// out (m,m) = A P A' [+ Q], symmetrised; A (m,n), At = A' (n,m), P (n,n), Q (m,m) or null; work (m,n)
template <class M, class N>
inline void congruence(M m, N n, const double* A, const double* At, const double* P, const double* Q, double* out,
                       double* work) {
    mul(m, n, n, A, P, work);
    if (Q) {
        for (int i = 0; i < m; i++) copy(m, Q + i * m, out + i * m);
        mul<Op::add>(m, n, m, work, At, out);
    } else {
        mul(m, n, m, work, At, out);
    }
    symmetrise(m, out);
}

// ---- symmetric positive semidefinite systems ----------------------------------------------------------------------

template <class N>
inline double tiny_pivot(N n) { return 16.0 * eps * (n + 1); }

// One column of `ldl` for a fixed size, all in registers: entries stored one by one and loaded again in pairs would stall.
template <int N, int J>
[[gnu::always_inline]] inline void ldl_column(const double* S, double (&l)[N][N], double (&p)[N], double (&r)[N],
                                              int& vanished, bool& bad) {
    if constexpr (J < N) {
        constexpr double tol = 16.0 * eps * (N + 1);
        const double sjj = S[J * N + J];
        double s = sjj, lp[N];
        for (int k = 0; k < J; k++) {
            lp[k] = l[J][k] * p[k];
            s -= l[J][k] * lp[k];
        }
        const bool fine = s > tol * sjj && s >= smallest && finite(s);
        p[J] = fine ? s : 0.0;
        r[J] = fine ? 1.0 / s : 0.0;
        vanished += !fine;
        bad = bad || (!fine && (!(s >= -1e3 * tol * std::fabs(sjj)) || !finite(s)));
        for (int i = J + 1; i < N; i++) {
            double v = S[i * N + J];
            for (int k = 0; k < J; k++) v -= l[i][k] * lp[k];
            l[i][J] = v * r[J];
        }
        ldl_column<N, J + 1>(S, l, p, r, vanished, bad);
    }
}

// S (n,n) = L D L', L unit lower (n,n; only below the diagonal is written), d (n) pivots, di (n) their reciprocals.
// Returns how many pivots vanished (d = di = 0 there), or -1 if one is clearly negative or not finite (taken as
// vanished too, so that what follows stays finite).
template <class N>
inline int ldl(N n, const double* S, double* L, double* d, double* di) {
    int vanished = 0;
    bool bad = false;
    if constexpr (N::fixed) {
        constexpr int c = N::cap;
        double l[c][c], p[c], r[c];
        ldl_column<c, 0>(S, l, p, r, vanished, bad);
        for (int i = 0; i < c; i++) {
            d[i] = p[i];
            di[i] = r[i];
            for (int j = 0; j < i; j++) L[i * c + j] = l[i][j];
        }
    } else {
        const double tol = tiny_pivot(n);
        for (int j = 0; j < n; j++) {
            const double sjj = S[j * n + j];
            double p = sjj;
            for (int k = 0; k < j; k++) p -= L[j * n + k] * L[j * n + k] * d[k];
            if (p > tol * sjj && p >= smallest && finite(p)) {
                d[j] = p;
                di[j] = 1.0 / p;
            } else {
                bad = bad || !(p >= -1e3 * tol * std::fabs(sjj)) || !finite(p);
                vanished++;
                d[j] = di[j] = 0.0;
            }
            for (int i = j + 1; i < n; i++) {
                double s = S[i * n + j];
                for (int k = 0; k < j; k++) s -= L[i * n + k] * (L[j * n + k] * d[k]);
                L[i * n + j] = s * di[j];
            }
        }
    }
    return bad ? -1 : vanished;
}

// X (n,k) <- (L D L')^-1 X in place, with L, di from `ldl`
template <class N, class K>
inline void ldl_solve(N n, K k, const double* L, const double* di, double* X) {
    if constexpr (K::fixed) {
        constexpr int c = K::cap;
        for (int i = 1; i < n; i++) {
            Row<c> r = Row<c>::load(X + i * c);
            for (int j = 0; j < i; j++) r.axmy(L[i * n + j], Row<c>::load(X + j * c));
            r.store(X + i * c);
        }
        for (int i = n - 1; i >= 0; i--) {
            Row<c> r = Row<c>::load(X + i * c);
            r.scale(di[i]);
            for (int j = i + 1; j < n; j++) r.axmy(L[j * n + i], Row<c>::load(X + j * c));
            r.store(X + i * c);
        }
    } else {
        for (int i = 1; i < n; i++)
            for (int j = 0; j < i; j++)
                for (int l = 0; l < k; l++) X[i * k + l] -= L[i * n + j] * X[j * k + l];
        for (int i = n - 1; i >= 0; i--) {
            for (int l = 0; l < k; l++) X[i * k + l] *= di[i];
            for (int j = i + 1; j < n; j++)
                for (int l = 0; l < k; l++) X[i * k + l] -= L[j * n + i] * X[j * k + l];
        }
    }
}

// S (n,n) = L L', L (n,n) lower, zeros above; li (n) = reciprocals of its diagonal (0 where the pivot vanished).
// Returns as `ldl`.
template <class N>
inline int cholesky(N n, const double* S, double* L, double* li) {
    int vanished = 0;
    bool bad = false;
    const double tol = tiny_pivot(n);
    for (int j = 0; j < n; j++) {
        const double sjj = S[j * n + j];
        double p = sjj;
        for (int k = 0; k < j; k++) p -= L[j * n + k] * L[j * n + k];
        if (p > tol * sjj && p >= smallest && finite(p)) {
            L[j * n + j] = std::sqrt(p);
            li[j] = 1.0 / L[j * n + j];
        } else {
            bad = bad || !(p >= -1e3 * tol * std::fabs(sjj)) || !finite(p);
            vanished++;
            L[j * n + j] = li[j] = 0.0;
        }
        for (int i = 0; i < j; i++) L[i * n + j] = 0.0;
        for (int i = j + 1; i < n; i++) {
            double s = S[i * n + j];
            for (int k = 0; k < j; k++) s -= L[i * n + k] * L[j * n + k];
            L[i * n + j] = s * li[j];
        }
    }
    return bad ? -1 : vanished;
}

// X (n,k) <- L^-1 X in place
template <class N, class K>
inline void solve_lower(N n, K k, const double* L, const double* li, double* X) {
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < i; j++) axpy(k, -L[i * n + j], X + j * k, X + i * k);
        for (int l = 0; l < k; l++) X[i * k + l] *= li[i];
    }
}

// X (n,k) <- L^-T X in place
template <class N, class K>
inline void solve_lower_t(N n, K k, const double* L, const double* li, double* X) {
    for (int i = n - 1; i >= 0; i--) {
        for (int j = i + 1; j < n; j++) axpy(k, -L[j * n + i], X + j * k, X + i * k);
        for (int l = 0; l < k; l++) X[i * k + l] *= li[i];
    }
}

// ---- sums of logarithms -------------------------------------------------------------------------------------------

// log(p1 p2 p3 ...) with one logarithm at the end: mantissas are multiplied, exponents are added.
struct LogProduct {
    double mantissa = 1.0;
    long long exponent = 0;
    inline void times(double p) {  // p > 0 and normal
        mantissa *= p_mantissa(p);
        mantissa = p_mantissa(mantissa);
    }
    inline double log() const { return std::log(mantissa) + 0.69314718055994530942 * static_cast<double>(exponent); }

  private:
    inline double p_mantissa(double p) {
        std::uint64_t b;
        std::memcpy(&b, &p, 8);
        exponent += static_cast<long long>((b >> 52) & 0x7ff) - 1023;
        b = (b & 0x000fffffffffffffULL) | 0x3ff0000000000000ULL;
        std::memcpy(&p, &b, 8);
        return p;
    }
};

}  // namespace HW_ISA
}  // namespace hw
