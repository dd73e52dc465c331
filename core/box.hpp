// Boxes that must contain: forward-backward contraction of linear rows (HC4), rigorous in floating point.
//
//     b_lo <= sum_j a_j x_j <= b_hi,   a_j in [a_lo, a_hi],   x_j in [x_lo, x_hi]
//
// A row bounds each of its variables by the others, x_j in ([b] - sum_{k != j} a_k x_k) / a_j; a sweep takes the rows of
// a chain E x_t - A x_{t-1} in [bx], C x_t in [by] forwards and backwards in time (Benhamou et al. 1999). Every result
// of an operation is moved outwards by at least one unit in the last place, so a box never loses a point and an empty
// box is a proof. Infinite ends are ends like any other; the matrices are finite.
#pragma once

#include "box_entry.hpp"
#include "small.hpp"

namespace hw {
namespace HW_ISA {

constexpr double inf = __builtin_inf();
inline double size_of(double a) { return a < 0.0 ? -a : a; }
constexpr double largest = 1.7976931348623157e308;

// The number r is the nearest to an exact result: something not below, not above that result. |r| eps is at least one
// unit in the last place of a normal r, and 5e-324 is one of a subnormal r; adding it to a normal r changes nothing.
inline double up(double r) { return finite(r) ? (r + size_of(r) * eps) + 5e-324 : (r == -inf ? -largest : r); }
inline double down(double r) { return finite(r) ? (r - size_of(r) * eps) - 5e-324 : (r == inf ? largest : r); }

// a product where 0 times infinity is 0
inline double times(double a, double b) { return a == 0.0 || b == 0.0 ? 0.0 : a * b; }

// a_lo <= a <= a_hi times x in [x_lo, x_hi]; an exact 0 stays one
inline void box_times(double a_lo, double a_hi, double x_lo, double x_hi, double& lo, double& hi) {
    if (a_lo == a_hi) {
        if (a_lo == 0.0) {
            lo = hi = 0.0;
        } else if (a_lo > 0.0) {
            lo = x_lo == -inf ? -inf : down(a_lo * x_lo);
            hi = x_hi == inf ? inf : up(a_lo * x_hi);
        } else {
            lo = x_hi == inf ? -inf : down(a_lo * x_hi);
            hi = x_lo == -inf ? inf : up(a_lo * x_lo);
        }
        return;
    }
    const double p = times(a_lo, x_lo), q = times(a_lo, x_hi), r = times(a_hi, x_lo), s = times(a_hi, x_hi);
    lo = min2(min2(p, q), min2(r, s));
    hi = max2(max2(p, q), max2(r, s));
    lo = lo == -inf ? -inf : down(lo);
    hi = hi == inf ? inf : up(hi);
}

// [s] / [a] for an a that is not 0
inline void box_over(double s_lo, double s_hi, double a_lo, double a_hi, double& lo, double& hi) {
    if (a_hi < 0.0) {
        const double t = s_lo;
        s_lo = -s_hi;
        s_hi = -t;
        const double b = a_lo;
        a_lo = -a_hi;
        a_hi = -b;
    }
    lo = s_lo == -inf ? -inf : down(s_lo / (s_lo >= 0.0 ? a_hi : a_lo));
    hi = s_hi == inf ? inf : up(s_hi / (s_hi >= 0.0 ? a_lo : a_hi));
}

// lower + lower and upper + upper ends; infinite stays infinite
inline double add_lo(double a, double b) { return a == -inf || b == -inf ? -inf : down(a + b); }
inline double add_hi(double a, double b) { return a == inf || b == inf ? inf : up(a + b); }

// Contract x (k) by one row; work (4 k + 2). False: no x of the box fits the row.
inline bool box_row(int k, const double* a_lo, const double* a_hi, double b_lo, double b_hi, double* x_lo, double* x_hi,
                    double* work) {
    if (b_lo == -inf && b_hi == inf) return true;
    double *t_lo = work, *t_hi = t_lo + k, *s_lo = t_hi + k, *s_hi = s_lo + k + 1;
    s_lo[k] = s_hi[k] = 0.0;  // sums over the variables after j
    for (int j = k - 1; j >= 0; j--) {
        box_times(a_lo[j], a_hi[j], x_lo[j], x_hi[j], t_lo[j], t_hi[j]);
        const bool none = a_lo[j] == 0.0 && a_hi[j] == 0.0;
        s_lo[j] = none ? s_lo[j + 1] : add_lo(t_lo[j], s_lo[j + 1]);
        s_hi[j] = none ? s_hi[j + 1] : add_hi(t_hi[j], s_hi[j + 1]);
    }
    if (s_lo[0] > b_hi || s_hi[0] < b_lo) return false;
    double p_lo = 0.0, p_hi = 0.0;  // sums over the variables before j
    for (int j = 0; j < k; j++) {
        if (a_lo[j] == 0.0 && a_hi[j] == 0.0) continue;
        if (a_lo[j] > 0.0 || a_hi[j] < 0.0) {
            const double others_lo = add_lo(p_lo, s_lo[j + 1]), others_hi = add_hi(p_hi, s_hi[j + 1]);
            double lo, hi;
            box_over(add_lo(b_lo, -others_hi), add_hi(b_hi, -others_lo), a_lo[j], a_hi[j], lo, hi);
            if (lo > x_lo[j]) x_lo[j] = lo;
            if (hi < x_hi[j]) x_hi[j] = hi;
            if (x_lo[j] > x_hi[j]) return false;
        }
        p_lo = add_lo(p_lo, t_lo[j]);
        p_hi = add_hi(p_hi, t_hi[j]);
    }
    return true;
}

inline std::size_t box_doubles(int n) { return 16 * static_cast<std::size_t>(n) + 8; }

// rows of time t+1 between boxes before (n) and after it (n), which stand one after the other; 0, or 1 + the row at fault
inline int box_dynamics(const BoxChain& b, int t, double* lo, double* hi, double* work) {
    const int n = b.n;
    const std::ptrdiff_t e = b.E_t ? std::ptrdiff_t(t) * n * n : 0, a = b.A_t ? std::ptrdiff_t(t) * n * n : 0;
    const double *E_lo = b.E_lo ? b.E_lo + e : nullptr, *E_hi = b.E_hi ? b.E_hi + e : E_lo;
    const double *A_lo = b.A_lo + a, *A_hi = b.A_hi ? b.A_hi + a : A_lo;
    double *c_lo = work, *c_hi = c_lo + 2 * n, *rest = c_hi + 2 * n;
    for (int i = n - 1; i >= 0; i--) {  // from the end: E is upper triangular, so this solves it
        for (int j = 0; j < n; j++) {
            c_lo[j] = -A_hi[i * n + j];
            c_hi[j] = -A_lo[i * n + j];
            c_lo[n + j] = E_lo ? E_lo[i * n + j] : double(i == j);
            c_hi[n + j] = E_hi ? E_hi[i * n + j] : double(i == j);
        }
        if (!box_row(2 * n, c_lo, c_hi, b.bx_lo[std::ptrdiff_t(t) * n + i], b.bx_hi[std::ptrdiff_t(t) * n + i], lo, hi, rest))
            return 1 + i;
    }
    return 0;
}

inline int box_outputs(const BoxChain& b, int t, double* lo, double* hi, double* work) {
    const int n = b.n, m = b.m;
    const std::ptrdiff_t c = b.C_t ? std::ptrdiff_t(t) * m * n : 0;
    const double *C_lo = b.C_lo + c, *C_hi = b.C_hi ? b.C_hi + c : C_lo;
    for (int i = 0; i < m; i++)
        if (!box_row(n, C_lo + i * n, C_hi + i * n, b.by_lo[std::ptrdiff_t(t) * m + i], b.by_hi[std::ptrdiff_t(t) * m + i], lo,
                     hi, work))
            return 1 + n + i;
    return 0;
}

// 0, or 1 + t (n+m) + i where row i of time t+1 (dynamics first) leaves no box
inline std::ptrdiff_t box_contract(const BoxChain& b) {
    const int n = b.n, kinds = b.n + b.m;
    double *two_lo = b.work, *two_hi = two_lo + 2 * n, *work = two_hi + 2 * n;
    for (int t = 0; t < b.T && b.sweeps == 0; t++) {
        double *lo = b.lo + std::ptrdiff_t(t) * n, *hi = b.hi + std::ptrdiff_t(t) * n;
        for (int j = 0; j < 2 * n; j++) two_lo[j] = lo[j], two_hi[j] = hi[j];
        for (int round = 0; round < 2; round++) {  // outputs tighten what the dynamics say, once more
            int bad = box_dynamics(b, t, two_lo, two_hi, work);
            if (!bad) bad = box_outputs(b, t, two_lo + n, two_hi + n, work);
            if (bad) return std::ptrdiff_t(t) * kinds + bad;
        }
        for (int j = 0; j < n; j++) lo[n + j] = two_lo[n + j], hi[n + j] = two_hi[n + j];
    }
    for (int sweep = 0; sweep < b.sweeps; sweep++) {
        double gain = 0.0;
        for (int step = 0; step < 2 * b.T; step++) {
            const bool back = step >= b.T;
            const int t = back ? 2 * b.T - 1 - step : step;
            double *lo = b.lo + std::ptrdiff_t(t) * n, *hi = b.hi + std::ptrdiff_t(t) * n;
            for (int j = 0; j < 2 * n; j++) two_lo[j] = lo[j], two_hi[j] = hi[j];
            int bad = back ? box_outputs(b, t, lo + n, hi + n, work) : box_dynamics(b, t, lo, hi, work);
            if (!bad) bad = back ? box_dynamics(b, t, lo, hi, work) : box_outputs(b, t, lo + n, hi + n, work);
            if (bad) return std::ptrdiff_t(t) * kinds + bad;
            for (int j = 0; j < 2 * n; j++) {
                const double was = two_hi[j] - two_lo[j], is = hi[j] - lo[j];
                const double less = finite(was) ? (was - is) / max2(was, smallest) : double(is < was || lo[j] > two_lo[j] || hi[j] < two_hi[j]);
                gain = max2(gain, less);
            }
        }
        if (!(gain > 0.01)) break;
    }
    return 0;
}

}  // namespace HW_ISA
}  // namespace hw
