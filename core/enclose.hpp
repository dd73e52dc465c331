// A tape over a box: what its value, its Jacobian and its Hessian can be, and an affine function that stays near it.
//
// Natural interval extension for the values, forward mode in intervals for the derivatives. With m the middle of the box X,
//
//     f(x) in f(m) + [f'](X) (x - m)                                      mean value form, and
//     f(x) in f(m) + f'(m) (x - m) + 1/2 (x - m)' [f''](X) (x - m)        second order,
//
// so f(x) is within `half` of J x + k for every x in X, the smaller half-width of both taken row by row. Where neither is
// finite (a jump, a pole, a function that bends over a box without ends) J is 0 and the value alone is enclosed.
//
// Moore, Kearfott and Cloud (2009), ch. 6; Combastel (2005), CDC, for the use in state bounding.
#pragma once
#include "interval.hpp"

namespace hw {
namespace HW_ISA {

inline int half_square(int n) { return n * (n + 1) / 2; }

// d += p s, in intervals; a zero direction stays zero whatever the factor.
inline void chain_interval(int n, Interval p, const Interval* s, Interval* d) {
    if (is_zero(p)) return;
    for (int j = 0; j < n; ++j)
        if (!is_zero(s[j])) d[j] = d[j] + p * s[j];
}

// Values, gradients (n, n_d) and, unless null, upper triangles of Hessians (n, n_d (n_d + 1) / 2) of all slots; in: (n_in,).
inline void tape_intervals(const Tape& tape, int n_d, const Interval* in, Interval* value, Interval* slope, Interval* bend) {
    const int h = half_square(n_d);
    const Interval zero{0.0, 0.0};
    for (int k = 0; k < tape.n; ++k) {
        const int32_t* row = tape.code + 4 * k;
        const TapeOp op = (TapeOp)row[0];
        Interval* d = slope + (std::size_t)k * n_d;
        Interval* dd = bend ? bend + (std::size_t)k * h : nullptr;
        for (int j = 0; j < n_d; ++j) d[j] = zero;
        if (dd)
            for (int j = 0; j < h; ++j) dd[j] = zero;
        if (op == TapeOp::constant_) {
            value[k] = {tape.constant[k], tape.constant[k]};
            if (!finite(tape.constant[k])) value[k] = whole;
            continue;
        }
        if (op == TapeOp::input_) {
            value[k] = in[row[1]];
            if (row[1] < n_d) d[row[1]] = {1.0, 1.0};
            continue;
        }
        if (op == TapeOp::where_) {
            const Interval c = value[row[1]];
            const bool yes = !contains(c, 0.0), no = is_zero(c);
            const int32_t a = no ? row[3] : row[2], b = yes ? row[2] : row[3];
            value[k] = hull(value[a], value[b]);
            const Interval* dc = slope + (std::size_t)row[1] * n_d;
            for (int j = 0; j < n_d; ++j) {
                d[j] = hull(slope[(std::size_t)a * n_d + j], slope[(std::size_t)b * n_d + j]);
                if (a != b && !is_zero(dc[j])) d[j] = whole;  // the choice itself may jump along j
            }
            if (!dd) continue;
            for (int i = 0, l = 0; i < n_d; ++i)
                for (int j = i; j < n_d; ++j, ++l) {
                    dd[l] = hull(bend[(std::size_t)a * h + l], bend[(std::size_t)b * h + l]);
                    if (a != b && !(is_zero(dc[i]) && is_zero(dc[j]))) dd[l] = whole;
                }
            continue;
        }
        const Enclosed e = enclosed(op, value[row[1]], value[row[2]]);
        value[k] = e.v;
        const Interval *da = slope + (std::size_t)row[1] * n_d, *db = slope + (std::size_t)row[2] * n_d;
        const bool on_a = tape.active[row[1]], on_b = tape.active[row[2]];
        if (on_a) chain_interval(n_d, e.a, da, d);
        if (on_b) chain_interval(n_d, e.b, db, d);
        if (!dd) continue;
        if (on_a) chain_interval(h, e.a, bend + (std::size_t)row[1] * h, dd);
        if (on_b) chain_interval(h, e.b, bend + (std::size_t)row[2] * h, dd);
        for (int i = 0, l = 0; i < n_d; ++i)
            for (int j = i; j < n_d; ++j, ++l) {
                if (on_a && !is_zero(e.aa)) dd[l] = dd[l] + e.aa * (i == j ? square(da[i]) : da[i] * da[j]);
                if (on_b && !is_zero(e.bb)) dd[l] = dd[l] + e.bb * (i == j ? square(db[i]) : db[i] * db[j]);
                if (on_a && on_b && !is_zero(e.ab)) dd[l] = dd[l] + e.ab * (da[i] * db[j] + da[j] * db[i]);
            }
    }
}

// A number of a, in the middle if a has one.
inline double middle(Interval a) {
    if (finite(a.lo) && finite(a.hi)) return min2(max2(0.5 * a.lo + 0.5 * a.hi, a.lo), a.hi);
    return finite(a.lo) ? a.lo : finite(a.hi) ? a.hi : 0.0;
}
// How far a reaches from m, rounded up.
inline double reach(Interval a, double m) { return max2(above(m - a.lo, 2.0), above(a.hi - m, 2.0)); }

// For x in the box of the first n_d inputs, the others being what `in` says: |f_i(x) - J_i x - k_i| <= half_i, and f_i(x) in
// v_i. J: (n_out, n_d), k, half: (n_out,), v: (n_out,). work: tape.n (1 + n_d + n_d (n_d + 1) / 2) + tape.n (1 + n_d) +
// tape.n_in Intervals.
inline void tape_affine(const Tape& tape, int n_d, const Interval* in, double* J, double* k, double* half, Interval* v,
                        Interval* work) {
    const int h = half_square(n_d), n = tape.n;
    Interval *value = work, *slope = value + n, *bend = slope + (std::size_t)n * n_d;
    Interval *at = bend + (std::size_t)n * h, *at_slope = at + n, *point = at_slope + (std::size_t)n * n_d;
    for (int i = 0; i < tape.n_in; ++i) {
        point[i] = in[i];
        if (i < n_d) {
            const double m = middle(in[i]);
            point[i] = {m, m};
        }
    }
    tape_intervals(tape, n_d, in, value, slope, bend);
    tape_intervals(tape, n_d, point, at, at_slope, nullptr);
    for (int i = 0; i < tape.n_out; ++i) {
        const int32_t o = tape.out[i];
        v[i] = value[o];
        double* Ji = J + (std::size_t)i * n_d;
        half[i] = inf;
        for (int order = 1; order <= 2; ++order) {
            // what is left of f(x) - Jt x over the box
            Interval rest = at[o];
            double Jt[64];
            for (int j = 0; j < n_d; ++j) {
                const Interval s = order == 1 ? slope[(std::size_t)o * n_d + j] : at_slope[(std::size_t)o * n_d + j];
                Jt[j] = is_bounded(s) ? middle(s) : 0.0;
                if (!is_point(s)) rest = rest + (s - Interval{Jt[j], Jt[j]}) * (in[j] - point[j]);
                rest = rest - Interval{Jt[j], Jt[j]} * point[j];
            }
            if (order == 2)
                for (int p = 0, l = 0; p < n_d; ++p)
                    for (int q = p; q < n_d; ++q, ++l) {
                        const Interval H = bend[(std::size_t)o * h + l];
                        const Interval rp = in[p] - point[p], rq = in[q] - point[q];
                        if (!is_zero(H)) rest = rest + H * (p == q ? 0.5 * square(rp) : rp * rq);
                    }
            if (!is_bounded(rest)) continue;
            const double m = middle(rest), w = reach(rest, m);
            if (w < half[i]) {
                half[i] = w;
                k[i] = m;
                for (int j = 0; j < n_d; ++j) Ji[j] = Jt[j];
            }
        }
        if (half[i] == inf) {
            for (int j = 0; j < n_d; ++j) Ji[j] = 0.0;
            k[i] = middle(v[i]);
            half[i] = is_bounded(v[i]) ? reach(v[i], k[i]) : inf;
        }
    }
}

}  // namespace HW_ISA
}  // namespace hw
