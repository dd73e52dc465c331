// A tape: a straight-line program of elementary operations, with its exact Jacobian.
//
// A tape stands for a function R^n_in -> R^n_out. Row k of `code` is (op, a, b, c): operation and the slots of its
// arguments, all smaller than k; the result is slot k. Values are computed for many points at once, the points of one
// slot side by side in memory (lanes), so that one decoded operation serves all sigma points. Jacobians are forward
// mode: every slot carries its derivatives along n_d directions (Griewank and Walther, Evaluating Derivatives, ch. 3).
#pragma once
#include <cmath>

#include "small.hpp"
#include "tape_code.hpp"

namespace hw {

namespace HW_ISA {

// NumPy's remainder: the sign of the divisor, so (a + pi) % (2 pi) - pi wraps an angle.
inline double remainder_np(double a, double b) {
    double m = std::fmod(a, b);
    if (m != 0.0) {
        if ((b < 0.0) != (m < 0.0)) m += b;
    } else {
        m = std::copysign(0.0, b);
    }
    return m;
}

inline double floor_divide_np(double a, double b) {
    const double m = remainder_np(a, b);
    const double d = (a - m) / b;
    double f = std::floor(d);
    if (d - f > 0.5) f += 1.0;
    return f;
}

inline double sign_np(double a) { return a > 0.0 ? 1.0 : a < 0.0 ? -1.0 : a; }
// NaN wins, as in NumPy.
inline double maximum_np(double a, double b) { return (a >= b || a != a) ? a : b; }
inline double minimum_np(double a, double b) { return (a <= b || a != a) ? a : b; }

// Values at L points. in: (n_in, L), slots: workspace (n, L), lanes contiguous. The answer stays in `slots`, at rows tape.out.
// N > 0 fixes the number of lanes at compile time.
template <int N>
inline void tape_values(const Tape& tape, int lanes, const double* in, double* __restrict__ slots) {
    const int L = N > 0 ? N : lanes;
    for (int k = 0; k < tape.n; ++k) {
        const int32_t* row = tape.code + 4 * k;
        double* __restrict__ o = slots + (size_t)k * L;
        const double* a = slots + (size_t)row[1] * L;
        const double* b = slots + (size_t)row[2] * L;
        const double* c = slots + (size_t)row[3] * L;
#define HW_CASE(name, expression)                                                                                      \
    case TapeOp::name##_:                                                                                                  \
        for (int l = 0; l < L; ++l) o[l] = expression;                                                                 \
        break;
        switch ((TapeOp)row[0]) {
            HW_CASE(constant, tape.constant[k])
            case TapeOp::input_: {
                const double* x = in + (size_t)row[1] * L;
                for (int l = 0; l < L; ++l) o[l] = x[l];
                break;
            }
            HW_CASE(negative, -a[l])
            HW_CASE(absolute, std::fabs(a[l]))
            HW_CASE(sqrt, std::sqrt(a[l]))
            HW_CASE(cbrt, std::cbrt(a[l]))
            HW_CASE(square, a[l] * a[l])
            HW_CASE(reciprocal, 1.0 / a[l])
            HW_CASE(sign, sign_np(a[l]))
            HW_CASE(exp, std::exp(a[l]))
            HW_CASE(exp2, std::exp2(a[l]))
            HW_CASE(expm1, std::expm1(a[l]))
            HW_CASE(log, std::log(a[l]))
            HW_CASE(log2, std::log2(a[l]))
            HW_CASE(log10, std::log10(a[l]))
            HW_CASE(log1p, std::log1p(a[l]))
            HW_CASE(sin, std::sin(a[l]))
            HW_CASE(cos, std::cos(a[l]))
            HW_CASE(tan, std::tan(a[l]))
            HW_CASE(arcsin, std::asin(a[l]))
            HW_CASE(arccos, std::acos(a[l]))
            HW_CASE(arctan, std::atan(a[l]))
            HW_CASE(sinh, std::sinh(a[l]))
            HW_CASE(cosh, std::cosh(a[l]))
            HW_CASE(tanh, std::tanh(a[l]))
            HW_CASE(arcsinh, std::asinh(a[l]))
            HW_CASE(arccosh, std::acosh(a[l]))
            HW_CASE(arctanh, std::atanh(a[l]))
            HW_CASE(floor, std::floor(a[l]))
            HW_CASE(ceil, std::ceil(a[l]))
            HW_CASE(rint, std::nearbyint(a[l]))
            HW_CASE(trunc, std::trunc(a[l]))
            HW_CASE(add, a[l] + b[l])
            HW_CASE(subtract, a[l] - b[l])
            HW_CASE(multiply, a[l] * b[l])
            HW_CASE(divide, a[l] / b[l])
            HW_CASE(power, std::pow(a[l], b[l]))
            HW_CASE(arctan2, std::atan2(a[l], b[l]))
            HW_CASE(hypot, std::hypot(a[l], b[l]))
            HW_CASE(maximum, maximum_np(a[l], b[l]))
            HW_CASE(minimum, minimum_np(a[l], b[l]))
            HW_CASE(remainder, remainder_np(a[l], b[l]))
            HW_CASE(fmod, std::fmod(a[l], b[l]))
            HW_CASE(floor_divide, floor_divide_np(a[l], b[l]))
            HW_CASE(less, a[l] < b[l] ? 1.0 : 0.0)
            HW_CASE(less_equal, a[l] <= b[l] ? 1.0 : 0.0)
            HW_CASE(equal, a[l] == b[l] ? 1.0 : 0.0)
            HW_CASE(not_equal, a[l] != b[l] ? 1.0 : 0.0)
            HW_CASE(where, a[l] != 0.0 ? b[l] : c[l])
            case TapeOp::count_: break;
        }
#undef HW_CASE
    }
}

// Value v = f and the partial derivatives pa, pb of one operation of two arguments at most.
inline void tape_partials(TapeOp op, double a, double b, double& v, double& pa, double& pb) {
    pa = 0.0;
    pb = 0.0;
    switch (op) {
        case TapeOp::negative_: v = -a; pa = -1.0; break;
        case TapeOp::absolute_: v = std::fabs(a); pa = sign_np(a); break;
        case TapeOp::sqrt_: v = std::sqrt(a); pa = 0.5 / v; break;
        case TapeOp::cbrt_: v = std::cbrt(a); pa = 1.0 / (3.0 * v * v); break;
        case TapeOp::square_: v = a * a; pa = 2.0 * a; break;
        case TapeOp::reciprocal_: v = 1.0 / a; pa = -v * v; break;
        case TapeOp::sign_: v = sign_np(a); break;
        case TapeOp::exp_: v = std::exp(a); pa = v; break;
        case TapeOp::exp2_: v = std::exp2(a); pa = v * 0.69314718055994530942; break;
        case TapeOp::expm1_: v = std::expm1(a); pa = std::exp(a); break;
        case TapeOp::log_: v = std::log(a); pa = 1.0 / a; break;
        case TapeOp::log2_: v = std::log2(a); pa = 1.44269504088896340736 / a; break;
        case TapeOp::log10_: v = std::log10(a); pa = 0.43429448190325182765 / a; break;
        case TapeOp::log1p_: v = std::log1p(a); pa = 1.0 / (1.0 + a); break;
        case TapeOp::sin_: v = std::sin(a); pa = std::cos(a); break;
        case TapeOp::cos_: v = std::cos(a); pa = -std::sin(a); break;
        case TapeOp::tan_: v = std::tan(a); pa = 1.0 + v * v; break;
        case TapeOp::arcsin_: v = std::asin(a); pa = 1.0 / std::sqrt((1.0 - a) * (1.0 + a)); break;
        case TapeOp::arccos_: v = std::acos(a); pa = -1.0 / std::sqrt((1.0 - a) * (1.0 + a)); break;
        case TapeOp::arctan_: v = std::atan(a); pa = 1.0 / (1.0 + a * a); break;
        case TapeOp::sinh_: v = std::sinh(a); pa = std::cosh(a); break;
        case TapeOp::cosh_: v = std::cosh(a); pa = std::sinh(a); break;
        case TapeOp::tanh_: v = std::tanh(a); pa = (1.0 - v) * (1.0 + v); break;
        case TapeOp::arcsinh_: v = std::asinh(a); pa = 1.0 / std::hypot(a, 1.0); break;
        case TapeOp::arccosh_: v = std::acosh(a); pa = 1.0 / std::sqrt((a - 1.0) * (a + 1.0)); break;
        case TapeOp::arctanh_: v = std::atanh(a); pa = 1.0 / ((1.0 - a) * (1.0 + a)); break;
        case TapeOp::floor_: v = std::floor(a); break;
        case TapeOp::ceil_: v = std::ceil(a); break;
        case TapeOp::rint_: v = std::nearbyint(a); break;
        case TapeOp::trunc_: v = std::trunc(a); break;
        case TapeOp::add_: v = a + b; pa = 1.0; pb = 1.0; break;
        case TapeOp::subtract_: v = a - b; pa = 1.0; pb = -1.0; break;
        case TapeOp::multiply_: v = a * b; pa = b; pb = a; break;
        case TapeOp::divide_: v = a / b; pa = 1.0 / b; pb = -v / b; break;
        case TapeOp::power_:
            v = std::pow(a, b);
            pa = b == 0.0 ? 0.0 : b * std::pow(a, b - 1.0);
            // the exponent's derivative is 0 * log(0) = 0 at a = 0 < b
            pb = (a == 0.0 && b > 0.0) ? 0.0 : v * std::log(a);
            break;
        case TapeOp::arctan2_: {
            v = std::atan2(a, b);
            const double s = std::hypot(a, b);
            pa = (b / s) / s;
            pb = -(a / s) / s;
            break;
        }
        case TapeOp::hypot_:
            v = std::hypot(a, b);
            pa = v > 0.0 ? a / v : 0.0;  // the subgradient nearest to zero at the origin
            pb = v > 0.0 ? b / v : 0.0;
            break;
        case TapeOp::maximum_: v = maximum_np(a, b); pa = a >= b ? 1.0 : 0.0; pb = 1.0 - pa; break;
        case TapeOp::minimum_: v = minimum_np(a, b); pa = a <= b ? 1.0 : 0.0; pb = 1.0 - pa; break;
        case TapeOp::remainder_: v = remainder_np(a, b); pa = 1.0; pb = -floor_divide_np(a, b); break;
        case TapeOp::fmod_: v = std::fmod(a, b); pa = 1.0; pb = -std::trunc(a / b); break;
        case TapeOp::floor_divide_: v = floor_divide_np(a, b); break;
        case TapeOp::less_: v = a < b ? 1.0 : 0.0; break;
        case TapeOp::less_equal_: v = a <= b ? 1.0 : 0.0; break;
        case TapeOp::equal_: v = a == b ? 1.0 : 0.0; break;
        case TapeOp::not_equal_: v = a != b ? 1.0 : 0.0; break;
        default: v = 0.0; break;
    }
}

// d (n_d) += p s; a zero partial or a zero direction counts as zero even beside an infinite factor.
template <class D>
inline void tape_chain(D n_d, double p, const double* s, double* d) {
    if (p == 0.0) return;
    if (finite(p)) {
        axpy(n_d, p, s, d);
    } else {
        for (int j = 0; j < n_d; ++j)
            if (s[j] != 0.0) d[j] += p * s[j];
    }
}

// Value and Jacobian at one point, along the first n_d inputs. in: (n_in,), value: workspace (n,), slope: workspace (n, n_d).
// The answer stays in rows tape.out.
template <class D>
inline void tape_jacobian(D n_d, const Tape& tape, const double* in, double* value, double* slope) {
    for (int k = 0; k < tape.n; ++k) {
        const int32_t* row = tape.code + 4 * k;
        const TapeOp op = (TapeOp)row[0];
        double* d = slope + (size_t)k * n_d;
        const double* da = slope + (size_t)row[1] * n_d;
        const double* db = slope + (size_t)row[2] * n_d;
        if (op == TapeOp::constant_) {
            value[k] = tape.constant[k];
            fill(n_d, 0.0, d);
        } else if (op == TapeOp::input_) {
            value[k] = in[row[1]];
            fill(n_d, 0.0, d);
            if (row[1] < n_d) d[row[1]] = 1.0;
        } else if (op == TapeOp::where_) {
            const int32_t pick = value[row[1]] != 0.0 ? row[2] : row[3];
            value[k] = value[pick];
            copy(n_d, slope + (size_t)pick * n_d, d);
        } else {
            double pa, pb;
            tape_partials(op, value[row[1]], value[row[2]], value[k], pa, pb);
            fill(n_d, 0.0, d);
            if (tape.active[row[1]]) tape_chain(n_d, pa, da, d);
            if (tape.active[row[2]]) tape_chain(n_d, pb, db, d);
        }
    }
}

}  // namespace HW_ISA
}  // namespace hw
