// A number that is P numbers: `Lanes<P>` behaves like a double in every formula and carries P independent values in one
// vector register. A recursion over time cannot use wide registers along time; written over `Lanes<P>` it walks P
// stretches of the series at once (core/chain.hpp glues them), so the same formula serves `double` and `Lanes<P>`.
#pragma once

#include "small.hpp"

#if defined(__AVX__) || defined(__SSE2__)
#include <immintrin.h>
#endif

namespace hw {
namespace HW_ISA {

template <int P>
struct Wide;
template <>
struct Wide<4> {
    typedef double type __attribute__((vector_size(32)));
};
template <>
struct Wide<8> {
    typedef double type __attribute__((vector_size(64)));
};

template <int P>
struct Lanes {
    typedef typename Wide<P>::type Raw;
    Raw v;
    Lanes() = default;
    inline Lanes(double a) : v(a - Raw{}) {}
    static inline Lanes of(Raw a) {
        Lanes r;
        r.v = a;
        return r;
    }
    inline double operator[](int p) const { return v[p]; }
    inline void set(int p, double a) { v[p] = a; }
    inline Lanes& operator+=(const Lanes& b) { v += b.v; return *this; }
    inline Lanes& operator-=(const Lanes& b) { v -= b.v; return *this; }
    inline Lanes& operator*=(const Lanes& b) { v *= b.v; return *this; }
    friend inline Lanes operator+(const Lanes& a, const Lanes& b) { return Lanes::of(a.v + b.v); }
    friend inline Lanes operator-(const Lanes& a, const Lanes& b) { return Lanes::of(a.v - b.v); }
    friend inline Lanes operator*(const Lanes& a, const Lanes& b) { return Lanes::of(a.v * b.v); }
    friend inline Lanes operator/(const Lanes& a, const Lanes& b) { return Lanes::of(a.v / b.v); }
    friend inline Lanes operator-(const Lanes& a) { return Lanes::of(-a.v); }
};

// where(test > 0, a, b) for doubles and lanes
inline double where_positive(double t, double a, double b) { return t > 0.0 ? a : b; }
template <int P>
inline Lanes<P> where_positive(const Lanes<P>& t, const Lanes<P>& a, const Lanes<P>& b) {
    return Lanes<P>::of(t.v > typename Lanes<P>::Raw{} ? a.v : b.v);
}
inline double larger(double a, double b) { return a > b ? a : b; }
template <int P>
inline Lanes<P> larger(const Lanes<P>& a, const Lanes<P>& b) {
#if defined(__AVX512F__)
    if constexpr (P == 8) return Lanes<P>::of(typename Lanes<P>::Raw(_mm512_max_pd((__m512d)a.v, (__m512d)b.v)));
#endif
#if defined(__AVX__)
    if constexpr (P == 4) return Lanes<P>::of(typename Lanes<P>::Raw(_mm256_max_pd((__m256d)a.v, (__m256d)b.v)));
#endif
    return Lanes<P>::of(a.v > b.v ? a.v : b.v);
}
inline double smaller(double a, double b) { return a < b ? a : b; }
template <int P>
inline Lanes<P> smaller(const Lanes<P>& a, const Lanes<P>& b) {
#if defined(__AVX512F__)
    if constexpr (P == 8) return Lanes<P>::of(typename Lanes<P>::Raw(_mm512_min_pd((__m512d)a.v, (__m512d)b.v)));
#endif
#if defined(__AVX__)
    if constexpr (P == 4) return Lanes<P>::of(typename Lanes<P>::Raw(_mm256_min_pd((__m256d)a.v, (__m256d)b.v)));
#endif
    return Lanes<P>::of(a.v < b.v ? a.v : b.v);
}
inline double magnitude(double a) { return a < 0 ? -a : a; }
template <int P>
inline Lanes<P> magnitude(const Lanes<P>& a) { return larger(a, -a); }

template <int P>
inline double sum_lanes(const Lanes<P>& a) {
    double s = 0.0;
    for (int p = 0; p < P; p++) s += a.v[p];
    return s;
}
template <int P>
inline double max_lanes(const Lanes<P>& a) {  // NaN anywhere gives NaN
    double s = a.v[0];
    for (int p = 1; p < P; p++) s = a.v[p] > s || a.v[p] != a.v[p] ? a.v[p] : s;
    return s;
}
template <int P>
inline double min_lanes(const Lanes<P>& a) { return -max_lanes(-a); }
// lane p takes the value of lane p-1, lane 0 takes 0: from a stretch to the one before it in time
template <int P>
inline Lanes<P> from_before(const Lanes<P>& a) {
    Lanes<P> r(0.0);
    for (int p = 1; p < P; p++) r.v[p] = a.v[p - 1];
    return r;
}
template <int P>
inline Lanes<P> from_after(const Lanes<P>& a) {
    Lanes<P> r(0.0);
    for (int p = 0; p + 1 < P; p++) r.v[p] = a.v[p + 1];
    return r;
}

}  // namespace HW_ISA
}  // namespace hw
