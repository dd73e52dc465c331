// Intervals that contain: every operation is rounded outward, so an enclosure stays one in floating point.
//
// No rounding mode is switched: a result is moved outward by two units in the last place, which is more than round-to-nearest
// can be off, and by eight for the functions of the C library (glibc states at most four). A function is taken on the part of
// an interval where it is defined; where that is empty nothing is known and the answer is the whole line. The derivatives of
// functions with kinks are the interval of Clarke's generalised gradient, for which the mean value theorem holds (Lebourg
// 1975); across a jump they are the whole line. Never NaN. Not for kernels that flush small numbers to zero.
//
// Moore, Kearfott and Cloud (2009), Introduction to Interval Analysis.
#pragma once
#include <cmath>

#include "box.hpp"
#include "tape_code.hpp"

namespace hw {
namespace HW_ISA {

struct Interval {
    double lo, hi;
};

constexpr Interval whole{-inf, inf};

inline double below(double x, double ulps) {
    if (x == inf) return largest;
    return x - (std::fabs(x) * (ulps * eps) + 1e-322);  // -inf stays
}
inline double above(double x, double ulps) { return -below(-x, ulps); }
// Round an operation of the processor, and one of the library, outward; NaN becomes the whole line.
inline Interval outward(double lo, double hi, double ulps = 2.0) {
    if (lo != lo || hi != hi) return whole;
    return {below(lo, ulps), above(hi, ulps)};
}
inline Interval library(double lo, double hi) { return outward(lo, hi, 8.0); }

inline bool is_zero(Interval a) { return a.lo == 0.0 && a.hi == 0.0; }
inline bool is_point(Interval a) { return a.lo == a.hi; }
inline bool is_bounded(Interval a) { return finite(a.lo) && finite(a.hi); }
inline bool contains(Interval a, double x) { return a.lo <= x && x <= a.hi; }
inline double magnitude(Interval a) { return max2(std::fabs(a.lo), std::fabs(a.hi)); }
inline Interval hull(Interval a, Interval b) { return {min2(a.lo, b.lo), max2(a.hi, b.hi)}; }
// The part of a in b; both contain the same number, so where rounding says otherwise a stays.
inline Interval clip(Interval a, double lo, double hi) {
    const Interval c{max2(a.lo, lo), min2(a.hi, hi)};
    return c.lo <= c.hi ? c : a;
}

inline Interval operator-(Interval a) { return {-a.hi, -a.lo}; }
inline Interval operator+(Interval a, Interval b) {
    if (is_zero(a)) return b;
    if (is_zero(b)) return a;
    return outward(a.lo + b.lo, a.hi + b.hi);
}
inline Interval operator-(Interval a, Interval b) { return a + (-b); }
inline Interval operator*(Interval a, Interval b) {
    if (is_zero(a) || is_zero(b)) return {0.0, 0.0};
    if (is_point(a) && a.lo == 1.0) return b;
    if (is_point(b) && b.lo == 1.0) return a;
    const double p = times(a.lo, b.lo), q = times(a.lo, b.hi), r = times(a.hi, b.lo), s = times(a.hi, b.hi);
    Interval c = outward(min2(min2(p, q), min2(r, s)), max2(max2(p, q), max2(r, s)));
    // the sign of a product is exact
    if ((a.lo >= 0.0 && b.lo >= 0.0) || (a.hi <= 0.0 && b.hi <= 0.0)) c.lo = max2(c.lo, 0.0);
    if ((a.lo >= 0.0 && b.hi <= 0.0) || (a.hi <= 0.0 && b.lo >= 0.0)) c.hi = min2(c.hi, 0.0);
    return c;
}
inline Interval operator*(double s, Interval a) { return Interval{s, s} * a; }

inline Interval square(Interval a) {
    if (is_zero(a)) return a;
    const double m = magnitude(a), least = contains(a, 0.0) ? 0.0 : min2(std::fabs(a.lo), std::fabs(a.hi));
    const Interval c = outward(least * least, m * m);
    return {max2(c.lo, 0.0), c.hi};
}
inline Interval inverse(Interval a) {
    if (a.lo < 0.0 && a.hi > 0.0) return whole;
    if (is_zero(a)) return whole;
    if (a.lo == 0.0) return {max2(below(1.0 / a.hi, 2.0), 0.0), inf};
    if (a.hi == 0.0) return {-inf, min2(above(1.0 / a.lo, 2.0), 0.0)};
    return outward(1.0 / a.hi, 1.0 / a.lo);
}
inline Interval operator/(Interval a, Interval b) { return is_zero(a) && !contains(b, 0.0) ? a : a * inverse(b); }

inline Interval sqrt_of(Interval a) {
    if (a.hi < 0.0) return whole;
    const Interval c = outward(std::sqrt(max2(a.lo, 0.0)), std::sqrt(a.hi));
    return {max2(c.lo, 0.0), c.hi};
}
inline Interval exp_of(Interval a) {
    const Interval c = library(std::exp(a.lo), std::exp(a.hi));
    return {max2(c.lo, 0.0), c.hi};
}
inline Interval log_of(Interval a) {
    if (a.hi <= 0.0) return whole;
    return {a.lo <= 0.0 ? -inf : below(std::log(a.lo), 8.0), above(std::log(a.hi), 8.0)};
}
// Whether a may hold a + 2 pi k, k any whole number; errs on the side of yes.
inline bool may_hold(Interval a, double angle) {
    const double turn = 6.28318530717958647692, slack = 1e-14 * (1.0 + magnitude(a));
    const double k = std::ceil((a.lo - slack - angle) / turn);
    return angle + k * turn <= a.hi + 2.0 * slack || angle + (k - 1.0) * turn >= a.lo - 2.0 * slack;
}
inline Interval cos_of(Interval a) {
    // where the argument is large its own rounding matters more than the waves of the cosine
    if (!is_bounded(a) || magnitude(a) > 1e9 || a.hi - a.lo >= 6.2831853) return {-1.0, 1.0};
    const double p = std::cos(a.lo), q = std::cos(a.hi);
    Interval c = library(min2(p, q), max2(p, q));
    if (may_hold(a, 0.0)) c.hi = 1.0;
    if (may_hold(a, 3.14159265358979323846)) c.lo = -1.0;
    return {max2(c.lo, -1.0), min2(c.hi, 1.0)};
}
inline Interval sin_of(Interval a) {
    if (!is_bounded(a) || magnitude(a) > 1e9 || a.hi - a.lo >= 6.2831853) return {-1.0, 1.0};
    const double p = std::sin(a.lo), q = std::sin(a.hi);
    Interval c = library(min2(p, q), max2(p, q));
    if (may_hold(a, 1.57079632679489661923)) c.hi = 1.0;
    if (may_hold(a, -1.57079632679489661923)) c.lo = -1.0;
    return {max2(c.lo, -1.0), min2(c.hi, 1.0)};
}
inline Interval cosh_of(Interval a) {
    const double least = contains(a, 0.0) ? 0.0 : min2(std::fabs(a.lo), std::fabs(a.hi));
    const Interval c = library(std::cosh(least), std::cosh(magnitude(a)));
    return {max2(c.lo, 1.0), c.hi};
}

// a^p for a number p.
inline Interval power_of(Interval a, double p) {
    if (p == 0.0) return {1.0, 1.0};
    if (p == 1.0) return a;
    if (p == 2.0) return square(a);
    if (p < 0.0) return inverse(power_of(a, -p));
    const bool whole_number = p == std::floor(p) && p < 1e15;
    if (whole_number && std::fmod(p, 2.0) == 1.0) return library(std::pow(a.lo, p), std::pow(a.hi, p));
    if (whole_number) {
        const double least = contains(a, 0.0) ? 0.0 : min2(std::fabs(a.lo), std::fabs(a.hi));
        const Interval c = library(std::pow(least, p), std::pow(magnitude(a), p));
        return {max2(c.lo, 0.0), c.hi};
    }
    if (a.hi < 0.0) return whole;
    const Interval c = library(std::pow(max2(a.lo, 0.0), p), std::pow(a.hi, p));
    return {max2(c.lo, 0.0), c.hi};
}

inline Interval arctan2_of(Interval a, Interval b) {
    const double pi = 3.14159265358979323846;
    const Interval all{-above(pi, 8.0), above(pi, 8.0)};
    if (b.lo < 0.0 && a.lo <= 0.0 && a.hi >= 0.0) return all;  // the cut, or the origin
    if (contains(a, 0.0) && contains(b, 0.0)) return all;
    // elsewhere the extremes are at corners
    const double p = std::atan2(a.lo, b.lo), q = std::atan2(a.lo, b.hi), r = std::atan2(a.hi, b.lo), s = std::atan2(a.hi, b.hi);
    const Interval c = library(min2(min2(p, q), min2(r, s)), max2(max2(p, q), max2(r, s)));
    return {max2(c.lo, all.lo), min2(c.hi, all.hi)};
}

// An operation of at most two arguments: its value, and first and second derivatives by each.
struct Enclosed {
    Interval v, a, b, aa, ab, bb;
};

inline double sign_of(double a) { return a > 0.0 ? 1.0 : a < 0.0 ? -1.0 : 0.0; }

// Steps: constant but for jumps. `v` is exact at its ends.
inline Enclosed steps(double lo, double hi) {
    const Interval z{0.0, 0.0}, d = lo == hi ? z : whole;
    return {{lo, hi}, d, z, d, z, z};
}

inline Enclosed verdict(bool surely, bool possibly) {
    const Interval z{0.0, 0.0}, d = surely == possibly ? z : whole;
    return {{surely ? 1.0 : 0.0, possibly ? 1.0 : 0.0}, d, d, d, d, d};
}

inline Enclosed enclosed(TapeOp op, Interval a, Interval b) {
    const Interval z{0.0, 0.0}, one{1.0, 1.0};
    Enclosed e{whole, z, z, z, z, z};
    switch (op) {
        case TapeOp::negative_: e.v = -a; e.a = {-1.0, -1.0}; break;
        case TapeOp::absolute_:
            if (a.lo >= 0.0) e.v = a, e.a = one;
            else if (a.hi <= 0.0) e.v = -a, e.a = {-1.0, -1.0};
            else e.v = {0.0, magnitude(a)}, e.a = {-1.0, 1.0}, e.aa = whole;
            break;
        case TapeOp::sqrt_: e.v = sqrt_of(a); e.a = 0.5 * inverse(e.v); e.aa = -0.25 * inverse(power_of(e.v, 3.0)); break;
        case TapeOp::cbrt_:
            e.v = library(std::cbrt(a.lo), std::cbrt(a.hi));
            e.a = inverse(3.0 * square(e.v));
            e.aa = -2.0 * inverse(9.0 * power_of(e.v, 5.0));
            break;
        case TapeOp::square_: e.v = square(a); e.a = 2.0 * a; e.aa = {2.0, 2.0}; break;
        case TapeOp::reciprocal_: e.v = inverse(a); e.a = -square(e.v); e.aa = 2.0 * power_of(e.v, 3.0); break;
        case TapeOp::sign_: return steps(sign_of(a.lo), sign_of(a.hi));
        case TapeOp::exp_: e.v = exp_of(a); e.a = e.aa = e.v; break;
        case TapeOp::exp2_: {
            e.v = library(std::exp2(a.lo), std::exp2(a.hi));
            e.v.lo = max2(e.v.lo, 0.0);
            const Interval k = library(0.69314718055994530942, 0.69314718055994530942);
            e.a = e.v * k;
            e.aa = e.a * k;
            break;
        }
        case TapeOp::expm1_:
            e.v = library(std::expm1(a.lo), std::expm1(a.hi));
            e.v.lo = max2(e.v.lo, -1.0);
            e.a = e.aa = exp_of(a);
            break;
        case TapeOp::log_: e.v = log_of(a); e.a = inverse(clip(a, 0.0, inf)); e.aa = -square(e.a); break;
        case TapeOp::log2_:
        case TapeOp::log10_: {
            const double k = op == TapeOp::log2_ ? 1.44269504088896340736 : 0.43429448190325182765;
            const Interval r = inverse(clip(a, 0.0, inf)), scale = library(k, k);
            e.v = scale * log_of(a);
            e.a = scale * r;
            e.aa = -(scale * square(r));
            break;
        }
        case TapeOp::log1p_: {
            const Interval s = clip(one + a, 0.0, inf);
            e.v = a.hi <= -1.0 ? whole
                               : Interval{a.lo <= -1.0 ? -inf : below(std::log1p(a.lo), 8.0), above(std::log1p(a.hi), 8.0)};
            e.a = inverse(s);
            e.aa = -square(e.a);
            break;
        }
        case TapeOp::sin_: e.v = sin_of(a); e.a = cos_of(a); e.aa = -e.v; break;
        case TapeOp::cos_: e.v = cos_of(a); e.a = -sin_of(a); e.aa = -e.v; break;
        case TapeOp::tan_: {
            const Interval c = cos_of(a);
            if (!contains(c, 0.0) && a.hi - a.lo < 3.2) e.v = library(std::tan(a.lo), std::tan(a.hi));
            e.a = one + square(e.v);
            e.aa = 2.0 * (e.v * e.a);
            break;
        }
        case TapeOp::arcsin_:
        case TapeOp::arccos_: {
            if (a.hi < -1.0 || a.lo > 1.0) {
                e.a = e.aa = whole;
                break;
            }
            const double lo = max2(a.lo, -1.0), hi = min2(a.hi, 1.0);
            const Interval r = clip((one - Interval{lo, hi}) * (one + Interval{lo, hi}), 0.0, 1.0), d = inverse(sqrt_of(r));
            const bool up = op == TapeOp::arcsin_;
            e.v = up ? library(std::asin(lo), std::asin(hi)) : library(std::acos(hi), std::acos(lo));
            e.a = up ? d : -d;
            e.aa = Interval{lo, hi} * power_of(d, 3.0);
            if (!up) e.aa = -e.aa;
            break;
        }
        case TapeOp::arctan_: {
            e.v = library(std::atan(a.lo), std::atan(a.hi));
            e.a = inverse(one + square(a));
            e.aa = -2.0 * (a * square(e.a));
            break;
        }
        case TapeOp::sinh_: e.v = library(std::sinh(a.lo), std::sinh(a.hi)); e.a = cosh_of(a); e.aa = e.v; break;
        case TapeOp::cosh_: e.v = cosh_of(a); e.a = library(std::sinh(a.lo), std::sinh(a.hi)); e.aa = e.v; break;
        case TapeOp::tanh_: {
            e.v = clip(library(std::tanh(a.lo), std::tanh(a.hi)), -1.0, 1.0);
            e.a = clip(one - square(e.v), 0.0, 1.0);
            e.aa = -2.0 * (e.v * e.a);
            break;
        }
        case TapeOp::arcsinh_: {
            e.v = library(std::asinh(a.lo), std::asinh(a.hi));
            e.a = inverse(sqrt_of(one + square(a)));
            e.aa = -(a * power_of(e.a, 3.0));
            break;
        }
        case TapeOp::arccosh_: {
            if (a.hi < 1.0) {
                e.a = e.aa = whole;
                break;
            }
            const Interval x{max2(a.lo, 1.0), a.hi};
            e.v = library(std::acosh(x.lo), std::acosh(x.hi));
            e.v.lo = max2(e.v.lo, 0.0);
            e.a = inverse(sqrt_of(clip((x - one) * (x + one), 0.0, inf)));
            e.aa = -(x * power_of(e.a, 3.0));
            break;
        }
        case TapeOp::arctanh_: {
            if (a.hi <= -1.0 || a.lo >= 1.0) {
                e.a = e.aa = whole;
                break;
            }
            const Interval x{max2(a.lo, -1.0), min2(a.hi, 1.0)};
            e.v = library(std::atanh(x.lo), std::atanh(x.hi));
            e.a = inverse(clip((one - x) * (one + x), 0.0, 1.0));
            e.aa = 2.0 * (x * square(e.a));
            break;
        }
        case TapeOp::floor_: return steps(std::floor(a.lo), std::floor(a.hi));
        case TapeOp::ceil_: return steps(std::ceil(a.lo), std::ceil(a.hi));
        case TapeOp::rint_: return steps(std::nearbyint(a.lo), std::nearbyint(a.hi));
        case TapeOp::trunc_: return steps(std::trunc(a.lo), std::trunc(a.hi));
        case TapeOp::add_: e.v = a + b; e.a = e.b = one; break;
        case TapeOp::subtract_: e.v = a - b; e.a = one; e.b = {-1.0, -1.0}; break;
        case TapeOp::multiply_: e.v = a * b; e.a = b; e.b = a; e.ab = one; break;
        case TapeOp::divide_: {
            const Interval r = inverse(b), rr = square(r);
            e.v = a / b;
            e.a = r;
            e.b = -(a * rr);
            e.ab = -rr;
            e.bb = 2.0 * (a * (rr * r));
            break;
        }
        case TapeOp::power_:
            if (is_point(b)) {
                const double p = b.lo;
                e.v = power_of(a, p);
                e.a = p * power_of(a, p - 1.0);
                e.aa = p == 1.0 ? z : (p * (p - 1.0)) * power_of(a, p - 2.0);
                if (p != std::floor(p)) e.aa = outward(e.aa.lo, e.aa.hi, 8.0);  // p (p - 1) was rounded
                if (a.lo > 0.0) {
                    const Interval l = log_of(a);
                    e.b = e.v * l;
                    e.ab = e.v * ((one + b * l) * inverse(a));
                    e.bb = e.v * square(l);
                } else {
                    e.b = e.ab = e.bb = whole;
                }
            } else if (a.lo > 0.0) {
                const Interval l = log_of(a), r = inverse(a);
                e.v = exp_of(b * l);
                e.a = e.v * (b * r);
                e.b = e.v * l;
                e.aa = e.v * (b * (b - one) * square(r));
                e.ab = e.v * ((one + b * l) * r);
                e.bb = e.v * square(l);
            } else {
                e.v = whole;
                e.a = e.b = e.aa = e.ab = e.bb = whole;
            }
            break;
        case TapeOp::arctan2_: {
            e.v = arctan2_of(a, b);
            if (b.lo < 0.0 && a.lo <= 0.0 && a.hi >= 0.0) {
                e.a = e.b = e.aa = e.ab = e.bb = whole;
                break;
            }
            const Interval r = inverse(square(a) + square(b)), rr = square(r);
            e.a = b * r;
            e.b = -(a * r);
            e.bb = 2.0 * (a * b * rr);
            e.aa = -e.bb;
            e.ab = (square(a) - square(b)) * rr;
            break;
        }
        case TapeOp::hypot_: {
            e.v = sqrt_of(square(a) + square(b));
            const Interval r = inverse(e.v), unit{-1.0, 1.0}, c = clip(a * r, -1.0, 1.0), d = clip(b * r, -1.0, 1.0);
            e.a = c;
            e.b = d;
            e.aa = square(d) * r;
            e.ab = -(c * d * r);
            e.bb = square(c) * r;
            if (!is_bounded(r)) {  // the origin is a kink
                e.a = contains(a, 0.0) ? unit : e.a;
                e.b = contains(b, 0.0) ? unit : e.b;
                e.aa = e.ab = e.bb = whole;
            }
            break;
        }
        case TapeOp::maximum_:
        case TapeOp::minimum_: {
            const bool most = op == TapeOp::maximum_;
            e.v = most ? Interval{max2(a.lo, b.lo), max2(a.hi, b.hi)} : Interval{min2(a.lo, b.lo), min2(a.hi, b.hi)};
            if (most ? a.lo > b.hi : a.hi < b.lo) {
                e.a = one;
            } else if (most ? a.hi < b.lo : a.lo > b.hi) {
                e.b = one;
            } else {
                e.a = e.b = {0.0, 1.0};
                e.aa = e.ab = e.bb = whole;
            }
            break;
        }
        case TapeOp::remainder_:
        case TapeOp::fmod_: {
            const bool floored = op == TapeOp::remainder_;
            const Interval q = contains(b, 0.0) ? whole : a / b;
            const double k = floored ? std::floor(q.lo) : std::trunc(q.lo), l = floored ? std::floor(q.hi) : std::trunc(q.hi);
            const double m = magnitude(b);
            const Interval range = floored ? Interval{min2(b.lo, 0.0), max2(b.hi, 0.0)}
                                           : Interval{a.lo >= 0.0 ? 0.0 : -m, a.hi <= 0.0 ? 0.0 : m};
            if (k == l && finite(k)) {
                e.v = clip(a - Interval{k, k} * b, range.lo, range.hi);
                e.a = one;
                e.b = {-k, -k};
            } else {
                e.v = range;
                e.a = e.b = e.aa = e.ab = e.bb = whole;
            }
            break;
        }
        case TapeOp::floor_divide_: {
            const Interval q = contains(b, 0.0) ? whole : a / b;
            e = steps(std::floor(q.lo), std::floor(q.hi));
            e.b = e.ab = e.bb = e.a;
            break;
        }
        case TapeOp::less_: return verdict(a.hi < b.lo, a.lo < b.hi);
        case TapeOp::less_equal_: return verdict(a.hi <= b.lo, a.lo <= b.hi);
        case TapeOp::equal_: return verdict(is_point(a) && is_point(b) && a.lo == b.lo, a.lo <= b.hi && b.lo <= a.hi);
        case TapeOp::not_equal_:
            return verdict(a.hi < b.lo || b.hi < a.lo, !(is_point(a) && is_point(b) && a.lo == b.lo));
        default: break;
    }
    return e;
}

}  // namespace HW_ISA
}  // namespace hw
