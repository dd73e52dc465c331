// Four numbers side by side: lane l of a V4 belongs to component l of a block, so one instruction works on four
// components of a mixture at once. Only what four-at-a-time code needs beyond small.hpp: exponential, logarithm, sums.
#pragma once

#include "small.hpp"

namespace hw {
namespace HW_ISA {

constexpr int lanes = 4;
typedef std::int64_t I4 __attribute__((vector_size(32)));
typedef std::uint64_t U4 __attribute__((vector_size(32)));

constexpr double minus_inf = -__builtin_inf();

inline V4 all4(double a) { return V4{a, a, a, a}; }
inline V4 max4(V4 a, V4 b) { return a > b ? a : b; }
inline double sum4(V4 a) { return (a[0] + a[2]) + (a[1] + a[3]); }
inline double top4(V4 a) { return max2(max2(a[0], a[1]), max2(a[2], a[3])); }
inline int blocks(int k) { return (k + lanes - 1) / lanes; }

// exp of each lane within 2 ulp; 0 below -708 (and at minus infinity), as large as can be above 709.
inline V4 exp4(V4 x) {
    const V4 magic = all4(0x1.8p52);
    const auto gone = x < all4(-708.0);
    x = max4(x, all4(-708.0));
    x = x < all4(709.0) ? x : all4(709.0);
    const V4 t = x * all4(1.4426950408889634074) + magic;  // the rounded quotient sits in the low bits of t
    const V4 n = t - magic;
    V4 r = x - n * all4(0x1.62e42feep-1);
    r = r - n * all4(0x1.a39ef35793c76p-33);
    V4 p = all4(1.0 / 479001600);
    p = p * r + all4(1.0 / 39916800);
    p = p * r + all4(1.0 / 3628800);
    p = p * r + all4(1.0 / 362880);
    p = p * r + all4(1.0 / 40320);
    p = p * r + all4(1.0 / 5040);
    p = p * r + all4(1.0 / 720);
    p = p * r + all4(1.0 / 120);
    p = p * r + all4(1.0 / 24);
    p = p * r + all4(1.0 / 6);
    p = p * r + all4(0.5);
    p = p * r + all4(1.0);
    p = p * r + all4(1.0);
    const I4 k = reinterpret_cast<I4>(t) - reinterpret_cast<I4>(magic);
    const V4 scale = reinterpret_cast<V4>((k + 1023) << 52);
    return gone ? V4{} : p * scale;
}

// log of each lane within 2 ulp of 1; minus infinity where the lane is 0 or below the normal numbers.
inline V4 log4(V4 x) {
    const U4 bits = reinterpret_cast<U4>(x);
    U4 e = (bits >> 52) & 0x7ff;
    V4 f = reinterpret_cast<V4>((bits & 0x000fffffffffffffULL) | 0x3ff0000000000000ULL);
    const auto high = f > all4(1.4142135623730950488);
    f = high ? f * 0.5 : f;
    e = e + (reinterpret_cast<U4>(high) & 1);
    const V4 magic = all4(0x1.0p52);
    const V4 k = reinterpret_cast<V4>(e | reinterpret_cast<U4>(magic)) - all4(0x1.0p52 + 1023.0);
    const V4 q = (f - 1.0) / (f + 1.0);
    const V4 s = q * q;
    V4 p = all4(2.0 / 21);
    p = p * s + all4(2.0 / 19);
    p = p * s + all4(2.0 / 17);
    p = p * s + all4(2.0 / 15);
    p = p * s + all4(2.0 / 13);
    p = p * s + all4(2.0 / 11);
    p = p * s + all4(2.0 / 9);
    p = p * s + all4(2.0 / 7);
    p = p * s + all4(2.0 / 5);
    p = p * s + all4(2.0 / 3);
    const V4 y = k * all4(0.69314718055994530942) + (q * 2.0 + q * s * p);
    return x < all4(2.2250738585072014e-308) ? all4(minus_inf) : y;
}

}  // namespace HW_ISA
}  // namespace hw
