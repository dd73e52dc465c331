// Multipliers of strips by reweighted least squares: for each side of a box, g = +-G_i, a y that makes
//
//     f(y) = y b + t |y| + |g - y A|_1
//
// small, which bounds g xi over |xi| <= 1, |A xi - b| <= t whatever y is. At the y at hand each |d| is at most
// d^2 / (2 w) + w / 2 with w = |d|; the y that makes these least solves a system as large as the strips are many
// (Weiszfeld's method), and going nearly twice as far halves the rounds. Four sides go side by side in a vector.
//
// Nothing here needs to be right: the caller bounds with what comes out, in arithmetic that is.
#pragma once

#include "lane.hpp"
#include "multipliers_entry.hpp"

namespace hw {
namespace HW_ISA {

constexpr double beyond = 1.8;    // step to the solution of a round, in all but the last
constexpr double floor_at = .01;  // of the weights, beside the mean of |g|, in the first round and in the last
constexpr double floor_ends = 1e-6;

inline V4 magnitude4(V4 a) { return a < 0.0 ? -a : a; }

// the k entries of a times those of b
inline double inner(int k, const double* a, const double* b) {
    V4 s{};
    int j = 0;
    for (; j + 4 <= k; j += 4) s += *reinterpret_cast<const V4u*>(a + j) * *reinterpret_cast<const V4u*>(b + j);
    double total = sum4(s);
    for (; j < k; j++) total += a[j] * b[j];
    return total;
}

// z (rows) of H z = r, all in lanes, H (rows,rows) lower half packed by rows, in place; directions that vanish are left out
template <class R>
inline void solve_lanes(R rows, V4* H, V4* r) {
    for (int a = 0; a < rows; a++) {
        V4* row = H + a * (a + 1) / 2;
        const V4 whole = row[a];
        for (int e = 0; e < a; e++) {  // row[e] <- L_ae p_e
            const V4* other = H + e * (e + 1) / 2;
            V4 s = row[e];
            for (int l = 0; l < e; l++) s -= row[l] * other[l];
            row[e] = s;
        }
        V4 p = whole;
        for (int e = 0; e < a; e++) {
            const V4 l = row[e] * H[e * (e + 1) / 2 + e];  // the diagonal holds 1 / p
            p -= l * row[e];
            row[e] = l;
            r[a] -= l * r[e];
        }
        row[a] = p > 1e-13 * whole ? 1.0 / p : V4{};
    }
    for (int a = rows - 1; a >= 0; a--) {
        r[a] *= H[a * (a + 1) / 2 + a];
        for (int l = a + 1; l < rows; l++) r[a] -= H[l * (l + 1) / 2 + a] * r[l];
    }
}

// The y of least f with squares in place of absolute values, the same for both signs: Y (rows,n); work 2 rows^2 + 2 rows
template <class R>
inline void least_squares(R rows, const StripSides& s, double* Y, double* work) {
    double *S = work, *L = S + rows * rows, *d = L + rows * rows, *di = d + rows;
    for (int a = 0; a < rows; a++) {
        const double* row = s.A + a * s.stride;
        for (int e = 0; e <= a; e++) S[a * rows + e] = S[e * rows + a] = inner(s.k, row, s.A + e * s.stride);
        S[a * rows + a] += s.t[a] * s.t[a];
        for (int i = 0; i < s.n; i++) Y[a * s.n + i] = inner(s.k, row, s.G + i * s.stride);
    }
    ldl(rows, S, L, d, di);
    ldl_solve(rows, Dim<0>(s.n), L, di, Y);
}

template <class R>
inline void four_sides(R rows, const StripSides& s, int i, const double* Y, double falls, V4* work) {
    constexpr int cap = R::cap;
    V4 own[R::fixed ? cap * (cap + 1) / 2 + 2 * cap : 1];
    V4* H = R::fixed ? own : work + s.k;
    V4 *r = H + rows * (rows + 1) / 2, *y = r + rows, *g = work;
    const int two = i + 1 < s.n ? i + 1 : i;  // of an odd number of objectives the last stands twice
    const double *p = s.G + i * s.stride, *q = s.G + two * s.stride;
    double unit[2] = {0.0, 0.0};
    for (int j = 0; j < s.k; j++) {
        g[j] = V4{p[j], -p[j], q[j], -q[j]};
        unit[0] += std::fabs(p[j]);
        unit[1] += std::fabs(q[j]);
    }
    for (double& u : unit) u = u > 0.0 && finite(s.k / u) ? u / s.k : 1.0;
    const V4 size{unit[0], unit[0], unit[1], unit[1]}, sign{1.0, -1.0, 1.0, -1.0}, per = 1.0 / size;
    for (int a = 0; a < rows; a++) {
        const double u = Y[a * s.n + i], v = Y[a * s.n + two];
        y[a] = V4{u, u, v, v} * sign * per;
    }
    for (int j = 0; j < s.k; j++) g[j] *= per;
    double floor = floor_at;
    for (int round = 0; round < s.rounds; round++) {
        for (int a = 0; a < rows; a++) {
            r[a] = all4(-s.b[a]);
            for (int e = 0; e < a; e++) H[a * (a + 1) / 2 + e] = V4{};
            const double t = s.t[a];
            H[a * (a + 1) / 2 + a] = t * t / max4(t * magnitude4(y[a]), all4(floor));
        }
        for (int j = 0; j < s.k; j++) {
            const double* column = s.A + j;
            V4 d = g[j];
            for (int a = 0; a < rows; a++) d -= y[a] * column[a * s.stride];
            const V4 w = 1.0 / max4(magnitude4(d), all4(floor));
            for (int a = 0; a < rows; a++) {
                const V4 weighed = w * column[a * s.stride];
                r[a] += weighed * g[j];
                for (int e = 0; e <= a; e++) H[a * (a + 1) / 2 + e] += weighed * column[e * s.stride];
            }
        }
        solve_lanes(rows, H, r);
        const double step = round + 1 < s.rounds ? beyond : 1.0;
        for (int a = 0; a < rows; a++) y[a] += step * (r[a] - y[a]);
        floor *= falls;
    }
    for (int a = 0; a < rows; a++) {
        const V4 out = y[a] * size;
        for (int l = 0; l < 4; l++) s.y[std::ptrdiff_t(2 * (l < 2 ? i : two) + l % 2) * rows + a] = out[l];
    }
}

template <class R>
inline void all_sides(R rows, const StripSides& s) {
    double* Y = s.work;
    double* rest = Y + std::size_t(rows) * s.n;
    while (reinterpret_cast<std::uintptr_t>(rest) % sizeof(V4)) rest++;
    least_squares(rows, s, Y, rest);
    const double falls = s.rounds > 1 ? std::pow(floor_ends / floor_at, 1.0 / (s.rounds - 1)) : 1.0;
    for (int i = 0; i < s.n; i += 2) four_sides(rows, s, i, Y, falls, reinterpret_cast<V4*>(rest));
}

}  // namespace HW_ISA
}  // namespace hw
