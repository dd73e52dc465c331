// Four numbers side by side: lane l of a V4 belongs to component l of a block, so one instruction works on four
// components of a mixture at once. Only what four-at-a-time code needs beyond small.hpp: exponential, logarithm, sums.
// The elementwise ones take a vector of eight (`Lanes<8>::Raw`) as well.
#pragma once

#include "small.hpp"

#if defined(__AVX__)
#include <immintrin.h>
#endif

namespace hw {
namespace HW_ISA {

constexpr int lanes = 4;
typedef std::int64_t I4 __attribute__((vector_size(32)));

constexpr double minus_inf = -__builtin_inf();

template <class X>
inline X all(double a) {
    return a - X{};
}
inline V4 all4(double a) { return all<V4>(a); }
template <class X>
inline X max4(X a, X b) {
#if defined(__AVX512F__)
    if constexpr (sizeof(X) == 64) return X(_mm512_max_pd((__m512d)a, (__m512d)b));
#endif
#if defined(__AVX__)
    if constexpr (sizeof(X) == 32) return X(_mm256_max_pd((__m256d)a, (__m256d)b));
#endif
    return a > b ? a : b;
}
template <class X>
inline X min4(X a, X b) {
#if defined(__AVX512F__)
    if constexpr (sizeof(X) == 64) return X(_mm512_min_pd((__m512d)a, (__m512d)b));
#endif
#if defined(__AVX__)
    if constexpr (sizeof(X) == 32) return X(_mm256_min_pd((__m256d)a, (__m256d)b));
#endif
    return a < b ? a : b;
}
template <class X>
inline X abs4(X a) {
    return max4(a, -a);
}
template <class X>
inline X sqrt4(X a) {
#if defined(__AVX512F__)
    if constexpr (sizeof(X) == 64) return X(_mm512_sqrt_pd((__m512d)a));
#endif
#if defined(__AVX__)
    if constexpr (sizeof(X) == 32) return X(_mm256_sqrt_pd((__m256d)a));
#endif
    X r;
    for (unsigned l = 0; l < sizeof(X) / sizeof(double); l++) r[l] = std::sqrt(a[l]);
    return r;
}
// whether a comparison holds in any lane
template <class M>
inline bool any4(M m) {
#if defined(__AVX512DQ__)
    if constexpr (sizeof(M) == 64) return _mm512_movepi64_mask((__m512i)m) != 0;
#endif
#if defined(__AVX__)
    if constexpr (sizeof(M) == 32) return _mm256_movemask_pd((__m256d)m) != 0;
#endif
    bool r = false;
    for (unsigned l = 0; l < sizeof(M) / sizeof(double); l++) r |= m[l] != 0;
    return r;
}
inline double sum4(V4 a) { return (a[0] + a[2]) + (a[1] + a[3]); }
inline double top4(V4 a) { return max2(max2(a[0], a[1]), max2(a[2], a[3])); }
inline int blocks(int k) { return (k + lanes - 1) / lanes; }

// exp of each lane within 2 ulp; 0 below -708 (and at minus infinity), as large as can be above 709.
template <class X>
inline X exp4(X x) {
    typedef decltype(x < x) Whole;
    const X magic = all<X>(0x1.8p52);
    const auto gone = x < all<X>(-708.0);
    x = min4(max4(x, all<X>(-708.0)), all<X>(709.0));
    const X t = x * all<X>(1.4426950408889634074) + magic;  // the rounded quotient sits in the low bits of t
    const X n = t - magic;
    X r = x - n * all<X>(0x1.62e42feep-1);
    r = r - n * all<X>(0x1.a39ef35793c76p-33);
    const X r2 = r * r, r4 = r2 * r2;  // pairs of powers: a short chain of dependent operations
    const X a = (all<X>(1.0) + r) + r2 * (all<X>(0.5) + r * all<X>(1.0 / 6));
    const X b = (all<X>(1.0 / 24) + r * all<X>(1.0 / 120)) + r2 * (all<X>(1.0 / 720) + r * all<X>(1.0 / 5040));
    const X c = (all<X>(1.0 / 40320) + r * all<X>(1.0 / 362880)) +
                r2 * (all<X>(1.0 / 3628800) + r * all<X>(1.0 / 39916800)) + r4 * all<X>(1.0 / 479001600);
    const X p = a + r4 * (b + r4 * c);
    const Whole k = reinterpret_cast<Whole>(t) - reinterpret_cast<Whole>(magic);
    const X scale = reinterpret_cast<X>((k + 1023) << 52);
    return gone ? X{} : p * scale;
}

// log of each lane within 2 ulp of 1; minus infinity where the lane is 0 or below the normal numbers.
template <class X>
inline X log4(X x) {
    typedef decltype(x < x) Whole;
    const Whole bits = reinterpret_cast<Whole>(x);
    Whole e = (bits >> 52) & 0x7ff;
    X f = reinterpret_cast<X>((bits & 0x000fffffffffffffLL) | 0x3ff0000000000000LL);
    const auto high = f > all<X>(1.4142135623730950488);
    f = high ? f * 0.5 : f;
    e = e - high;
    const X magic = all<X>(0x1.0p52);
    const X k = reinterpret_cast<X>(e | reinterpret_cast<Whole>(magic)) - all<X>(0x1.0p52 + 1023.0);
    const X q = (f - 1.0) / (f + 1.0);
    const X s = q * q;
    X p = all<X>(2.0 / 21);
    p = p * s + all<X>(2.0 / 19);
    p = p * s + all<X>(2.0 / 17);
    p = p * s + all<X>(2.0 / 15);
    p = p * s + all<X>(2.0 / 13);
    p = p * s + all<X>(2.0 / 11);
    p = p * s + all<X>(2.0 / 9);
    p = p * s + all<X>(2.0 / 7);
    p = p * s + all<X>(2.0 / 5);
    p = p * s + all<X>(2.0 / 3);
    const X y = k * all<X>(0.69314718055994530942) + (q * 2.0 + q * s * p);
    return x < all<X>(2.2250738585072014e-308) ? all<X>(minus_inf) : y;
}

}  // namespace HW_ISA
}  // namespace hw
