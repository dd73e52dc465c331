// Ellipsoids {c + X^(1/2) z : |z| <= 1} that must contain: sums and intersections of least weighted trace.
//
// Motion adds terms T_i of trace t_i (Schweppe 1973; Maksarov and Norton 1996):
//
//     X = (sum sqrt t_i) (sum T_i / sqrt t_i)
//
// and a strip |z - h x| <= r is folded in with weight a in (0, 1) (Fogel and Huang 1982, Automatica 18):
//
//     v = X h, g = h v, D = g / a + r^2 / (1 - a), K = v / (a D), nu = z - h c
//     c = c + K nu,  X = (1 - nu^2 / D) (X / a - v v' / (a^2 D))
//
// a minimises the trace of the result. Each coordinate is weighed by its own width, so units do not matter. What rounding can do
// is bounded and added: |E_ij| <= e sqrt(d_i d_j) implies E <= n e diag(d).
#pragma once

#include "zonotope.hpp"

namespace hw {
namespace HW_ISA {

struct Ellipsoid {
    int n;
    double *c, *X;                                // state
    double *M, *rM, *W, *rW, *rest, *v, *d, *wt, *roots;  // work

    static std::size_t state(const SetSizes& z) { return 2 + z.n + std::size_t(z.n) * z.n; }
    static std::size_t work(const SetSizes& z) { return 6 * std::size_t(z.n) * z.n + 10 * z.n; }
    Ellipsoid(const SetSizes& z, double* s, double* w) : n(z.n), c(s + 2), X(c + n) {
        const std::size_t nn = std::size_t(n) * n;
        M = w;
        rM = M + nn;
        W = rM + nn;
        rW = W + nn;
        rest = rW + nn;
        v = rest + 3 * n;
        d = v + n;
        wt = d + n;
        roots = wt + n;
    }

    void start(const double* lo, const double* hi) {
        for (int i = 0; i < n * n; i++) X[i] = 0.0;
        for (int i = 0; i < n; i++) {
            const Coefficient x = coefficient(lo, hi, i);
            c[i] = x.mid;
            X[i * n + i] = (1.0 + 8.0 * eps) * n * x.rad * x.rad;
        }
    }

    void move(const Motion& q) {
        // x = M x_ + W (b + noise), rows solved from the last up; rM, rW bound what rounding did to M, W
        double *w = v, *centre = d;
        for (int i = n - 1; i >= 0; i--) {
            for (int j = 0; j < n; j++) {
                double m = q.A(i, j).mid, u = i == j, sm = size_of(m), su = 0.0, em = 0.0, eu = 0.0;
                for (int l = i + 1; l < n && q.E_lo; l++) {
                    const double e = q.E(i, l).mid;
                    m -= e * M[l * n + j];
                    u -= e * W[l * n + j];
                    sm += size_of(e * M[l * n + j]);
                    su += size_of(e * W[l * n + j]);
                    em += size_of(e) * rM[l * n + j];
                    eu += size_of(e) * rW[l * n + j];
                }
                M[i * n + j] = m;
                W[i * n + j] = u;
                rM[i * n + j] = q.E_lo ? up(em + slack(n, sm + em)) : 0.0;
                rW[i * n + j] = q.E_lo ? up(eu + slack(n, su + eu)) : 0.0;
            }
            const Coefficient shift = q.b(i);
            w[i] = up(up(shift.rad + q.unknown(i)));
            double size = 0.0, far = 0.0;
            centre[i] = 0.0;
            for (int j = 0; j < n; j++) {
                centre[i] += M[i * n + j] * c[j];
                size += size_of(M[i * n + j] * c[j]);
                if (rM[i * n + j] > 0.0) far += rM[i * n + j] * furthest(q.was_lo[j], q.was_hi[j]);
            }
            for (int j = i; j < n; j++) {
                const double b = q.b(j).mid;
                centre[i] += W[i * n + j] * b;
                size += size_of(W[i * n + j] * b);
                far += rW[i * n + j] * (size_of(b) + w[j]);
            }
            rest[i] = up(far + slack(2 * n, far + size));
        }
        for (int i = 0; i < n; i++) c[i] = centre[i];
        // terms: M X M', the columns of W by their half-widths, the remainder's segments
        double *Y = rM, *reach = rest + n, *d2 = rest + 2 * n;  // rM is used up
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                double s = 0.0;
                for (int k = 0; k < n; k++) s += M[i * n + k] * X[k * n + j];
                rW[i * n + j] = s;
            }
        for (int i = 0; i < n; i++) {
            reach[i] = 0.0;
            for (int k = 0; k < n; k++) reach[i] += size_of(M[i * n + k]) * std::sqrt(X[k * n + k]);
            for (int j = 0; j < n; j++) {
                double s = 0.0;
                for (int k = 0; k < n; k++) s += rW[i * n + k] * M[j * n + k];
                Y[i * n + j] = s;
            }
        }
        for (int i = 0; i < n; i++) {
            double s = max2(Y[i * n + i], 0.0) + rest[i] * rest[i];
            for (int k = i; k < n; k++) s += W[i * n + k] * W[i * n + k] * w[k] * w[k];
            wt[i] = s > 0.0 && finite(1.0 / s) ? 1.0 / s : 0.0;
        }
        double root = 0.0, t0 = 0.0;
        for (int i = 0; i < n; i++) t0 += wt[i] * max2(Y[i * n + i], 0.0);
        // a term of trace 0 is 0 in every weighed direction; its root stands in the denominator, so it is kept from 0
        const double floor_of = 1e-30;
        t0 = std::sqrt(t0) + floor_of;
        root = t0;
        for (int k = 0; k < n; k++) {
            double t = 0.0;
            for (int i = 0; i <= k; i++) t += wt[i] * W[i * n + k] * W[i * n + k];
            const double a = w[k] > 0.0 ? std::sqrt(t) * w[k] + floor_of : 0.0, b = rest[k] > 0.0 ? std::sqrt(wt[k]) * rest[k] + floor_of : 0.0;
            root += a + b;
            roots[k] = a;
            roots[n + k] = b;
        }
        for (int i = 0; i < n; i++) {
            d2[i] = reach[i] * reach[i] / t0;
            for (int j = 0; j < n; j++) X[i * n + j] = Y[i * n + j] / t0;
        }
        for (int k = 0; k < n; k++) {
            if (roots[k] > 0.0)
                for (int i = 0; i <= k; i++) {
                    const double f = W[i * n + k] * w[k] * (w[k] / roots[k]);
                    d2[i] += f * W[i * n + k];
                    for (int j = 0; j <= k; j++) X[i * n + j] += f * W[j * n + k];
                }
            if (roots[n + k] > 0.0) {
                const double f = rest[k] * (rest[k] / roots[n + k]);
                d2[k] += f;
                X[k * n + k] += f;
            }
        }
        settle(root, d2, (6 * n + 30) * eps);
    }

    // X = s X, symmetric, more by n e diag(s d)
    void settle(double s, const double* dd, double e) {
        for (int i = 0; i < n; i++)
            for (int j = i; j < n; j++) {
                const double m = s * (0.5 * X[i * n + j] + 0.5 * X[j * n + i]);
                X[i * n + j] = X[j * n + i] = m;
            }
        for (int i = 0; i < n; i++) X[i * n + i] = max2(X[i * n + i], 0.0) + n * e * s * max2(dd[i], 0.0) + 1e-307;
    }

    Strip fold(const double* h, double a_lo, double a_hi) {
        double g = 0.0, far = 0.0, middle = 0.0, size = 0.0;
        for (int i = 0; i < n; i++) {
            double s = 0.0;
            for (int j = 0; j < n; j++) s += X[i * n + j] * h[j];
            v[i] = s;
            g += h[i] * s;
            far += size_of(h[i]) * std::sqrt(X[i * n + i]);
            middle += h[i] * c[i];
            size += size_of(h[i] * c[i]);
        }
        const double e = (6 * n + 30) * eps;
        g = max2(g, 0.0);
        const double rounding = slack(n, size), half = up(std::sqrt(g + e * far * far) * (1.0 + 4.0 * eps)) + rounding;
        const double near = down(middle - half), top = up(middle + half);
        if (a_lo > top || a_hi < near) return Strip::contradicts;
        if (a_lo <= near && a_hi >= top) return Strip::idle;
        const double lo = max2(a_lo, near), hi = min2(a_hi, top);
        const Coefficient strip = coefficient(&lo, &hi, 0);
        const double r2 = strip.rad * strip.rad * (1.0 + 4.0 * eps), nu = strip.mid - middle;
        const double off = rounding + slack(2, size_of(strip.mid) + size_of(middle)), sure = max2(size_of(nu) - off, 0.0);
        double tau = 0.0, sigma = 0.0;
        for (int i = 0; i < n; i++) {
            wt[i] = X[i * n + i] > 0.0 && finite(1.0 / X[i * n + i]) ? 1.0 / X[i * n + i] : 0.0;
            tau += wt[i] * X[i * n + i];
            sigma += wt[i] * v[i] * v[i];
        }
        if (!(g > 0.0) || !finite(g) || !finite(sigma)) return Strip::idle;
        auto trace = [&](double a) {
            const double D = g / a + r2 / (1.0 - a);
            return max2(1.0 - sure * sure / D, 0.0) * (tau / a - sigma / (a * a * D));
        };
        // golden section; whatever weight it ends at, the ellipsoid contains
        double p = 1e-6, q = 1.0 - 1e-9;
        const double golden = 0.61803398874989485;
        double x1 = q - golden * (q - p), x2 = p + golden * (q - p), f1 = trace(x1), f2 = trace(x2);
        for (int k = 0; k < 22; k++) {
            if (f1 < f2) {
                q = x2, x2 = x1, f2 = f1, x1 = q - golden * (q - p), f1 = trace(x1);
            } else {
                p = x1, x1 = x2, f1 = f2, x2 = p + golden * (q - p), f2 = trace(x2);
            }
        }
        const double a = f1 < f2 ? x1 : x2;
        if (!(min2(f1, f2) < tau)) return Strip::idle;
        const double D = g / a + r2 / (1.0 - a), ill = far * far / (a * D);
        if (!(ill < 1e6)) return Strip::idle;
        const double more = 4.0 * e * (1.0 + ill);
        const double shrink = min2(1.0, 1.0 - sure * sure / D + more);
        double width = 0.0;
        for (int i = 0; i < n; i++) {
            const double K = v[i] / (a * D), wide = std::sqrt(X[i * n + i]);
            rest[i] = up(size_of(K) * off + size_of(nu) * more * (size_of(K) + wide * far / (a * D)) +
                         slack(3, size_of(c[i]) + size_of(K * nu)));
            c[i] += K * nu;
            width += wt[i] * rest[i] * rest[i];
            d[i] = X[i * n + i] / a;
        }
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) X[i * n + j] = X[i * n + j] / a - (v[i] / a) * (v[j] / (a * D));
        settle(max2(shrink, 0.0), d, 2.0 * more);
        // a centre off by the remainder: a sum with the ellipsoid around its box
        double all = 0.0;
        for (int i = 0; i < n; i++) all += wt[i] * X[i * n + i];
        const double ratio = all > 0.0 ? std::sqrt(n * width / all) : 1.0, grow = max2(ratio, 1e-12);
        for (int i = 0; i < n * n; i++) X[i] *= 1.0 + grow;
        for (int i = 0; i < n; i++)
            X[i * n + i] = X[i * n + i] * (1.0 + 4.0 * n * eps) + (1.0 + 1.0 / grow) * n * rest[i] * rest[i] * (1.0 + 8.0 * eps);
        return Strip::folded;
    }

    void reduce() {}

    bool meet(double* lo, double* hi) {
        for (int i = 0; i < n; i++) {
            const double s = up(std::sqrt(X[i * n + i]) * (1.0 + 4.0 * eps));
            lo[i] = max2(lo[i], down(c[i] - s));
            hi[i] = min2(hi[i], up(c[i] + s));
            if (!(lo[i] <= hi[i])) return false;
        }
        return true;
    }

    bool sound() const {
        double s = 0.0;
        for (int i = 0; i < n; i++) s += 0.0 * c[i];
        for (int i = 0; i < n * n; i++) s += 0.0 * X[i];
        return s == 0.0;
    }
};

}  // namespace HW_ISA
}  // namespace hw
