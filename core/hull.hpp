// The guaranteed bound of a functional of the states in a window, whoever proposes the multipliers.
//
//     sup c'x   over   E x_t - A x_{t-1} in [bx_t],  C x_t in [by_t],  lo <= x <= hi
//
// For any multipliers y of the rows M x in [b], d = c - M'y gives (Neumaier and Shcherbina 2004)
//
//     c'x = y'(M x) + d'x  <=  sum_i sup y_i [b_i]  +  sum_j sup d_j [x_j],
//
// so a wrong y loosens the bound and cannot break it. Evaluated here with every rounding accounted for:
//
//  - everything is measured from the middle of the boxes, v = x - mid, so that the terms are of the size of the widths and
//    not of the states. The rows' right-hand sides b - M mid are sums of exact products and sums (two-sum, fused
//    multiply-add), whose own error is below 8 k^2 u^2 sum |terms|, u = 2^-53, k terms;
//  - an interval coefficient is its middle and a radius, and the radius times the largest |x| in the box widens the row;
//  - d is a sum of k + 1 rounded products: its error is below (k + 2) 2u sum |terms|;
//  - the final sum moves outwards at each operation (core/box.hpp).
//
// An unbounded variable with d_j != 0 gives an infinite bound. A bound below 0 at c = 0 proves that the window is empty.
#pragma once

#include "box.hpp"
#include "hull_types.hpp"

namespace hw {
namespace HW_ISA {

// a sum of numbers and products, held as s + e
struct Exact {
    double s = 0.0, e = 0.0, size = 0.0;
    int terms = 0;
    inline void add(double p) {
        const double t = s + p, b = t - s;
        e += (s - (t - b)) + (p - b);
        s = t;
        size += size_of(p);
        terms++;
    }
    inline void product(double a, double x) {
        const double p = a * x;
        e += __builtin_fma(a, x, -p);
        add(p);
    }
    inline double slack() const {  // 3e-31 > 8 u^2 4: the terms of e and their roundings; subnormal products below 1e-300
        return up(up(size * (double(terms + 1) * double(terms + 1) * 3e-31)) + 1e-300);
    }
    inline double low() const { return finite(s) && finite(e) ? down(down(s + e) - slack()) : -inf; }
    inline double high() const { return finite(s) && finite(e) ? up(up(s + e) + slack()) : inf; }
};

inline double largest_of(double lo, double hi) { return max2(size_of(lo), size_of(hi)); }

// middle of an interval matrix's entries [lo, hi] (count), and what its radius can add over the box: extra[row] for
// `rows` rows of n entries against |x| <= reach (n)
inline void middles(int rows, int n, const double* lo, const double* hi, const double* x_lo, const double* x_hi,
                    double* mid, double* extra) {
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < n; j++) {
            const double a = lo[i * n + j], b = hi[i * n + j];
            mid[i * n + j] = a == b ? a : 0.5 * a + 0.5 * b;
            const double radius = a == b ? 0.0 : max2(up(b - mid[i * n + j]), up(mid[i * n + j] - a));
            if (radius > 0.0) extra[i] = add_hi(extra[i], up(radius * largest_of(x_lo[j], x_hi[j])));
        }
}

inline void hull_rows_of(const HullWindow& win, HullRows& r, double* work) {
    const int n = win.n, m = win.m, kinds = n + m;
    r.K = win.K;
    r.n = n;
    r.m = m;
    const bool interval = win.E_hi || win.A_hi || win.C_hi;
    r.E = win.E_hi ? r.Em : win.E_lo;
    r.A = win.A_hi ? r.Am : win.A_lo;
    r.C = win.C_hi ? r.Cm : win.C_lo;
    r.E_t = win.E_t || win.E_hi;
    r.A_t = win.A_t || win.A_hi;
    r.C_t = win.C_t || win.C_hi;
    for (std::ptrdiff_t k = 0; k < std::ptrdiff_t(win.K + 1) * n; k++) {
        const double lo = win.lo[k], hi = win.hi[k];
        const double mid = finite(lo) && finite(hi) ? 0.5 * lo + 0.5 * hi : finite(lo) ? lo : finite(hi) ? hi : 0.0;
        r.mid[k] = mid;
        r.v_lo[k] = lo == -inf ? -inf : down(lo - mid);
        r.v_hi[k] = hi == inf ? inf : up(hi - mid);
    }
    double* extra = work;  // (n+m)
    for (int t = 0; t < win.K; t++) {
        const std::ptrdiff_t nn = n * n, mn = m * n;
        const double *before = r.mid + std::ptrdiff_t(t) * n, *after = before + n;
        for (int i = 0; i < kinds; i++) extra[i] = 0.0;
        if (interval) {
            const double *lo = win.lo + std::ptrdiff_t(t) * n, *hi = win.hi + std::ptrdiff_t(t) * n;
            if (win.E_hi)
                middles(n, n, win.E_lo + (win.E_t ? t * nn : 0), win.E_hi + (win.E_t ? t * nn : 0), lo + n, hi + n, r.Em + t * nn, extra);
            if (win.A_hi)
                middles(n, n, win.A_lo + (win.A_t ? t * nn : 0), win.A_hi + (win.A_t ? t * nn : 0), lo, hi, r.Am + t * nn, extra);
            if (win.C_hi)
                middles(m, n, win.C_lo + (win.C_t ? t * mn : 0), win.C_hi + (win.C_t ? t * mn : 0), lo + n, hi + n, r.Cm + t * mn, extra + n);
        }
        const double *E = r.E ? r.E + (r.E_t ? t * nn : 0) : nullptr, *A = r.A + (r.A_t ? t * nn : 0);
        const double* C = r.C + (r.C_t ? t * mn : 0);
        for (int i = 0; i < kinds; i++) {
            double& lo = r.r_lo[std::ptrdiff_t(t) * kinds + i];
            double& hi = r.r_hi[std::ptrdiff_t(t) * kinds + i];
            const double b_lo = i < n ? win.bx_lo[std::ptrdiff_t(t) * n + i] : win.by_lo[std::ptrdiff_t(t) * m + i - n];
            const double b_hi = i < n ? win.bx_hi[std::ptrdiff_t(t) * n + i] : win.by_hi[std::ptrdiff_t(t) * m + i - n];
            if (b_lo == -inf && b_hi == inf) {
                lo = -inf;
                hi = inf;
                continue;
            }
            for (int side = 0; side < 2; side++) {
                Exact sum;
                sum.add(side ? b_hi : b_lo);
                if (i < n) {
                    for (int j = 0; j < n; j++) {
                        if (!E && j == i) sum.add(-after[j]);
                        if (E && j >= i) sum.product(-E[i * n + j], after[j]);
                        sum.product(A[i * n + j], before[j]);
                    }
                } else {
                    for (int j = 0; j < n; j++) sum.product(-C[(i - n) * n + j], after[j]);
                }
                if (side) hi = b_hi == inf ? inf : add_hi(sum.high(), extra[i]);
                else lo = b_lo == -inf ? -inf : add_lo(sum.low(), -extra[i]);
            }
        }
    }
}

// sup of c'x_k, c (n), from multipliers y (K, n+m); not a number in y counts as 0. d (n) is work.
inline double hull_sup(const HullRows& r, const double* c, int k, const double* y, double* d) {
    const int n = r.n, m = r.m, kinds = n + m;
    const std::ptrdiff_t nn = n * n, mn = m * n;
    auto of = [&](int t, int i) {  // multiplier of row i of time t+1
        const std::ptrdiff_t at = std::ptrdiff_t(t) * kinds + i;
        const double v = y[at];
        if (!finite(v) || v == 0.0) return 0.0;
        return finite(v > 0.0 ? r.r_hi[at] : r.r_lo[at]) ? v : 0.0;  // a side without end has no multiplier
    };
    double total = 0.0;
    for (int t = 0; t <= r.K; t++) {
        double* size = d + n;
        for (int j = 0; j < n; j++) {
            d[j] = t == k ? c[j] : 0.0;
            size[j] = size_of(d[j]);
        }
        if (t < r.K) {  // rows of t+1 hold -A x_t
            const double* A = r.A + (r.A_t ? t * nn : 0);
            for (int i = 0; i < n; i++) {
                const double v = of(t, i);
                for (int j = 0; j < n; j++) {
                    const double p = v * A[i * n + j];
                    d[j] += p;
                    size[j] += size_of(p);
                }
            }
        }
        if (t > 0) {
            const double* E = r.E ? r.E + (r.E_t ? (t - 1) * nn : 0) : nullptr;
            const double* C = r.C + (r.C_t ? (t - 1) * mn : 0);
            for (int i = 0; i < n; i++) {
                const double v = of(t - 1, i);
                for (int j = i; j < n; j++) {
                    const double p = E ? v * E[i * n + j] : (i == j ? v : 0.0);
                    d[j] -= p;
                    size[j] += size_of(p);
                }
                const std::ptrdiff_t at = std::ptrdiff_t(t - 1) * kinds + i;
                if (v != 0.0) total = up(total + up(v * (v > 0.0 ? r.r_hi[at] : r.r_lo[at])));
            }
            for (int i = 0; i < m; i++) {
                const double v = of(t - 1, n + i);
                if (v == 0.0) continue;
                for (int j = 0; j < n; j++) {
                    const double p = v * C[i * n + j];
                    d[j] -= p;
                    size[j] += size_of(p);
                }
                const std::ptrdiff_t at = std::ptrdiff_t(t - 1) * kinds + n + i;
                total = up(total + up(v * (v > 0.0 ? r.r_hi[at] : r.r_lo[at])));
            }
        }
        for (int j = 0; j < n; j++) {
            const double lo = r.v_lo[std::ptrdiff_t(t) * n + j], hi = r.v_hi[std::ptrdiff_t(t) * n + j];
            const double err = size[j] == 0.0 ? 0.0 : up(size[j] * (2.0 * n + m + 3.0) * eps + 1e-300);
            if (d[j] == 0.0 && err == 0.0) continue;
            if (lo == -inf || hi == inf) {
                if (d[j] + err > 0.0 && hi == inf) return inf;
                if (d[j] - err < 0.0 && lo == -inf) return inf;
            }
            const double most = d[j] > 0.0 ? up(d[j] * hi) : d[j] < 0.0 ? up(d[j] * lo) : 0.0;
            const double reach = up(err * (lo == -inf ? size_of(hi) : hi == inf ? size_of(lo) : largest_of(lo, hi)));
            total = up(up(total + most) + reach);
        }
    }
    Exact middle;  // c'mid
    for (int j = 0; j < n; j++) middle.product(c[j], r.mid[std::ptrdiff_t(k) * n + j]);
    const double bound = up(middle.high() + total);
    return bound == bound ? bound : inf;
}

}  // namespace HW_ISA
}  // namespace hw
