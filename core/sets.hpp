// One recursion for all sets: move, contract the box, fold the seen outputs in, meet the box.
//
// Beside the shape (zonotope, constrained zonotope, ellipsoid, or nothing) runs the box of core/box.hpp; each tightens the other,
// so every answer lies inside that of the box alone. A shape begins when its box is bounded, and begins again if it leaves the
// range of floating point. A row that contradicts everything before it is named and ends what is known: from there on box and
// shape begin anew.
#pragma once

#include <type_traits>

#include "ellipsoid.hpp"

namespace hw {
namespace HW_ISA {

struct NoShape {
    NoShape(const SetSizes&, double*, double*) {}
    static std::size_t state(const SetSizes&) { return 2; }
    static std::size_t work(const SetSizes&) { return 0; }
    void start(const double*, const double*) {}
    void move(const Motion&) {}
    Strip fold(const double*, double, double) { return Strip::idle; }
    bool meet(double*, double*) { return true; }
    void reduce() {}
    bool sound() const { return false; }
};

// Boxes within this share of the shape's own width along a coordinate are worth a strip, for the rows to come.
constexpr double worth = 0.7;

template <class Shape>
std::ptrdiff_t run_sets(const SetRun& r) {
    const BoxChain& b = r.box;
    const int n = b.n, m = b.m;
    double *two_lo = r.work, *two_hi = two_lo + 2 * n, *h = two_hi + 2 * n, *own = h + n, *box_work = own + 2 * n;
    double* rest = box_work + box_doubles(n);
    Shape shape(r.size, r.state, rest);
    double& born = r.state[1];  // shared with the number of constraints: -1 where there is no shape
    std::ptrdiff_t first = 0;
    for (int t = 0; t < b.T; t++) {
        const double *was_lo = b.lo + std::ptrdiff_t(t) * n, *was_hi = b.hi + std::ptrdiff_t(t) * n;
        double *lo = b.lo + std::ptrdiff_t(t + 1) * n, *hi = b.hi + std::ptrdiff_t(t + 1) * n;
        for (int j = 0; j < n; j++) {
            two_lo[j] = was_lo[j], two_hi[j] = was_hi[j];
            two_lo[n + j] = lo[j], two_hi[n + j] = hi[j];  // bounds of the state come in here
        }
        if (born < 0.0 && all_finite(Dim<0>(n), was_lo) && all_finite(Dim<0>(n), was_hi)) {
            shape.start(was_lo, was_hi);
            born = shape.sound() ? 0.0 : -1.0;
        }
        int bad = 0;
        for (int j = 0; j < n; j++)
            if (!(two_lo[n + j] <= two_hi[n + j])) bad = 1 + j;
        for (int round = 0; round < 3 && !bad; round++) {  // the last carries what the outputs said of x_ on to x
            bad = box_dynamics(b, t, two_lo, two_hi, box_work);
            if (!bad) bad = box_outputs(b, t, two_lo + n, two_hi + n, box_work);
        }
        const std::ptrdiff_t e = b.E_t ? std::ptrdiff_t(t) * n * n : 0, a = b.A_t ? std::ptrdiff_t(t) * n * n : 0;
        const Motion motion{n,
                            b.E_lo ? b.E_lo + e : nullptr,
                            b.E_hi ? b.E_hi + e : nullptr,
                            b.A_lo + a,
                            b.A_hi ? b.A_hi + a : nullptr,
                            b.bx_lo + std::ptrdiff_t(t) * n,
                            b.bx_hi + std::ptrdiff_t(t) * n,
                            was_lo,
                            was_hi,
                            two_lo + n,
                            two_hi + n};
        if (!bad && born >= 0.0) {
            shape.move(motion);
            if (!shape.sound()) born = -1.0;  // numbers that are none prove nothing
        }
        if (!bad && born >= 0.0) {
            const std::ptrdiff_t c = b.C_t ? std::ptrdiff_t(t) * m * n : 0;
            int last = 0;
            for (int i = 0; i < m && !bad; i++) {
                double near = b.by_lo[std::ptrdiff_t(t) * m + i], far = b.by_hi[std::ptrdiff_t(t) * m + i], unknown = 0.0;
                if (near == -inf && far == inf) continue;
                last = i;
                for (int j = 0; j < n; j++) {
                    const Coefficient q = coefficient(b.C_lo + c, b.C_hi ? b.C_hi + c : nullptr, i * n + j);
                    h[j] = q.mid;
                    if (q.rad > 0.0) unknown += q.rad * furthest(two_lo[n + j], two_hi[n + j]);
                }
                if (unknown > 0.0) {
                    unknown += slack(n, unknown);
                    near = down(near - unknown);
                    far = up(far + unknown);
                }
                if (shape.fold(h, near, far) == Strip::contradicts) bad = 1 + n + i;
            }
            // where the box is narrower it is a strip along the coordinate
            for (int j = 0; j < n; j++) own[j] = -inf, own[n + j] = inf;
            if (!bad && !shape.sound()) born = -1.0;
            if (!bad && born >= 0.0 && !shape.meet(own, own + n)) bad = 1 + n + last;
            bool folded = false;
            for (int j = 0; j < n && !bad && born >= 0.0; j++) {
                const double width = two_hi[n + j] - two_lo[n + j];
                if (!(width < worth * (own[n + j] - own[j]))) continue;
                for (int l = 0; l < n; l++) h[l] = l == j;
                const Strip what = shape.fold(h, two_lo[n + j], two_hi[n + j]);
                folded = folded || what == Strip::folded;
                if (what == Strip::contradicts) bad = 1 + n + last;
            }
            if (folded && !shape.sound()) born = -1.0;
            if (!bad && born >= 0.0) {
                shape.reduce();
                if (!shape.sound()) born = -1.0;
            }
            for (int j = 0; j < n && !bad; j++) {
                two_lo[n + j] = max2(two_lo[n + j], own[j]);
                two_hi[n + j] = min2(two_hi[n + j], own[n + j]);
                if (!(two_lo[n + j] <= two_hi[n + j])) bad = 1 + n + last;
            }
        }
        if (bad) {
            if (!first) first = std::ptrdiff_t(t) * (n + m) + bad;
            born = -1.0;
            for (int j = 0; j < n; j++) two_lo[n + j] = -inf, two_hi[n + j] = inf;
        }
        const double* x_was = r.x + std::ptrdiff_t(t) * n;
        double* x = r.x + std::ptrdiff_t(t + 1) * n;
        for (int j = n - 1; j >= 0; j--) {
            lo[j] = two_lo[n + j];
            hi[j] = two_hi[n + j];
            const double middle = 0.5 * lo[j] + 0.5 * hi[j];
            double s = 0.5 * motion.b_lo[j] + 0.5 * motion.b_hi[j];
            for (int l = 0; l < n; l++) s += motion.A(j, l).mid * x_was[l];
            for (int l = j + 1; l < n; l++) s -= motion.E(j, l).mid * x[l];
            x[j] = finite(middle) ? middle : finite(s) ? min2(max2(s, lo[j]), hi[j]) : finite(x_was[j]) ? x_was[j] : 0.0;
        }
    }
    return first;
}

template <class F>
auto with_shape(const SetSizes& z, F f) {
    switch (z.kind) {
        case SetKind::zonotope:
        case SetKind::constrained: return f(static_cast<Zonotope*>(nullptr));
        case SetKind::ellipsoid: return f(static_cast<Ellipsoid*>(nullptr));
        default: return f(static_cast<NoShape*>(nullptr));
    }
}

}  // namespace HW_ISA
}  // namespace hw
