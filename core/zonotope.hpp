// Zonotopes, and zonotopes cut by strips: sets {c + G xi : |xi_j| <= 1, |A xi - b| <= t}, the last part absent in a zonotope.
//
// Motion is a linear map and a few more generators. Of an output, a strip |z - h x| <= r, a zonotope keeps what the best gain
// leaves: x = x + K (z - h x - r eta), with the K that makes the generators least in the Frobenius norm [1]. A constrained
// zonotope keeps the strip itself as a row of A, and its oldest row turns into generators by the same formula when there are
// too many; until then the set is exact [2]. Too many generators: the least ones are boxed, in a constrained zonotope together
// with their entries in A, which widens t.
//
// Whatever K, whatever is boxed, the set contains; rounding is bounded from above by `slack` and added where it belongs, so it
// contains in floating point too. The box of a constrained zonotope is bounded by multipliers y of its strips, whatever they are,
//
//     max g xi  <=  y b + t |y| + |g - y A|_1,
//
// and core/multipliers.hpp makes them good: a poor y loosens the box and breaks nothing.
//
// [1] Combastel (2015), Automatica 55. [2] Scott, Raimondo, Marseglia and Braatz (2016), Automatica 69.
#pragma once

#include "box.hpp"
#include "multipliers_entry.hpp"
#include "sets_entry.hpp"

namespace hw {
namespace HW_ISA {

// What rounding can do to a sum of k terms, each a product of a few factors, whose absolute values add up to s.
inline double slack(int k, double s) { return (2 * k + 8) * eps * s + k * 1e-321; }

// Sums in whole vectors and a tail: the order of a sum is no matter where its rounding is bounded
inline double sum_abs(int k, const double* a) {
    V4 s{};
    int j = 0;
    for (; j + 4 <= k; j += 4) {
        const V4 x = *reinterpret_cast<const V4u*>(a + j);
        s += x < 0.0 ? -x : x;
    }
    double total = (s[0] + s[1]) + (s[2] + s[3]);
    for (; j < k; j++) total += size_of(a[j]);
    return total;
}
inline double product(int k, const double* a, const double* b) {
    V4 s{};
    int j = 0;
    for (; j + 4 <= k; j += 4) s += *reinterpret_cast<const V4u*>(a + j) * *reinterpret_cast<const V4u*>(b + j);
    double total = (s[0] + s[1]) + (s[2] + s[3]);
    for (; j < k; j++) total += a[j] * b[j];
    return total;
}

struct Coefficient {
    double mid, rad;
};
inline Coefficient coefficient(const double* lo, const double* hi, int i) {
    if (!hi || lo[i] == hi[i]) return {lo[i], 0.0};
    const double m = 0.5 * lo[i] + 0.5 * hi[i];
    return {m, up(max2(up(hi[i] - m), up(m - lo[i])))};
}
inline double furthest(double lo, double hi) { return max2(size_of(lo), size_of(hi)); }

// The rows of one motion E x - A x_ in [b], with the boxes of x_ and x.
struct Motion {
    int n;
    const double *E_lo, *E_hi, *A_lo, *A_hi, *b_lo, *b_hi;
    const double *was_lo, *was_hi, *lo, *hi;
    Coefficient A(int i, int j) const { return coefficient(A_lo, A_hi, i * n + j); }
    Coefficient E(int i, int j) const { return E_lo ? coefficient(E_lo, E_hi, i * n + j) : Coefficient{0.0, 0.0}; }
    Coefficient b(int i) const { return coefficient(b_lo, b_hi, i); }
    // half-width of what interval entries of E and A add to row i
    double unknown(int i) const {
        double s = 0.0;
        for (int j = 0; j < n; j++) {
            const double a = A(i, j).rad, e = j > i ? E(i, j).rad : 0.0;
            if (a > 0.0) s += a * furthest(was_lo[j], was_hi[j]);
            if (e > 0.0) s += e * furthest(lo[j], hi[j]);
        }
        return s > 0.0 ? s + slack(2 * n, s) : 0.0;
    }
};

enum class Strip { folded, idle, contradicts };

struct Zonotope {
    int n, most, rows_most;  // states, generators and constraints between rows
    int cap, rows_cap;       // the same within a row
    int rounds;              // of the search for multipliers
    // state: generators and constraints in use are kept as numbers, so that a state is one array of doubles
    double *count, *c, *G, *A, *b, *t;
    // work: new generators (n,cap), row sums, remainder; then multipliers (2n,rows), sums of |A| and the work of their search
    double *N, *sum, *rest, *g, *K, *score, *y, *sum_of, *aside;
    double carried = 0.0;  // |h| rest of the row being folded
    bool summed = false;   // whether `sum` holds the row sums of G as it stands

    int generators() const { return static_cast<int>(count[0]); }
    int constraints() const { return static_cast<int>(count[1]); }

    static int columns(const SetSizes& z) { return z.generators + 3 * z.n + 2 * z.m; }
    static int rows(const SetSizes& z) { return z.kind == SetKind::constrained ? z.constraints + z.m + z.n : 0; }
    static std::size_t state(const SetSizes& z) {
        return 2 + z.n + std::size_t(z.n + rows(z)) * columns(z) + 2 * std::size_t(rows(z));
    }
    static std::size_t work(const SetSizes& z) {
        const std::size_t w = columns(z), k = rows(z);
        return z.n * w + 4 * z.n + 3 * w + (2 * z.n + 1) * k + multipliers_workspace(z.n, columns(z), rows(z));
    }
    Zonotope(const SetSizes& z, double* s, double* w)
        : n(z.n), most(z.generators), rows_most(z.kind == SetKind::constrained ? z.constraints : 0), cap(columns(z)), rows_cap(rows(z)), rounds(z.rounds) {
        count = s;
        c = count + 2;
        G = c + n;
        A = G + std::size_t(n) * cap;
        b = A + std::size_t(rows_cap) * cap;
        t = b + rows_cap;
        N = w;
        sum = N + std::size_t(n) * cap;
        rest = sum + n;
        K = rest + n;
        g = K + 2 * n;
        score = g + cap;
        y = score + 2 * cap;
        sum_of = y + 2 * std::size_t(n) * rows_cap;
        aside = sum_of + rows_cap;
    }

    void start(const double* lo, const double* hi) {
        count[0] = n;
        count[1] = 0;
        summed = false;
        for (std::size_t i = 0; i < std::size_t(n) * cap; i++) G[i] = 0.0;
        for (int i = 0; i < n; i++) {
            const Coefficient x = coefficient(lo, hi, i);
            c[i] = x.mid;
            G[std::size_t(i) * cap + i] = x.rad;
        }
    }

    // sum_j |G_ij|, rounded up
    double row_sum(const double* row) const {
        const int k = generators();
        const double s = sum_abs(k, row);
        return s + slack(k, s);
    }

    void sum_rows() {
        if (!summed)
            for (int i = 0; i < n; i++) sum[i] = row_sum(G + std::size_t(i) * cap);
        summed = true;
    }

    void move(const Motion& q) {
        const int k = generators();
        sum_rows();
        double *fresh_c = K, *fresh_sum = K + n;
        for (int i = n - 1; i >= 0; i--) {
            double* row = N + std::size_t(i) * cap;
            const Coefficient shift = q.b(i);
            double centre = shift.mid;
            double size = size_of(shift.mid);
            for (int j = 0; j < k + n; j++) row[j] = 0.0;
            for (int l = 0; l < n; l++) {
                const double a = q.A(i, l).mid;
                if (a == 0.0) continue;
                const double* old = G + std::size_t(l) * cap;
                for (int j = 0; j < k; j++) row[j] += a * old[j];
                centre += a * c[l];
                size += size_of(a) * (size_of(c[l]) + sum[l]);
            }
            for (int l = i + 1; l < n && q.E_lo; l++) {
                const double e = q.E(i, l).mid;
                if (e == 0.0) continue;
                const double* below_it = N + std::size_t(l) * cap;
                for (int j = 0; j < k + n; j++) row[j] -= e * below_it[j];
                centre -= e * fresh_c[l];
                size += size_of(e) * (size_of(fresh_c[l]) + fresh_sum[l]);
            }
            // the noise of the row, and all that rounding and unknown entries did to it: one generator
            row[k + i] = up(up(shift.rad + q.unknown(i)) + slack(2 * n + 1, size));
            fresh_c[i] = centre;
            const double s = sum_abs(k + n, row);
            fresh_sum[i] = s + slack(k + n, s);
        }
        for (int i = 0; i < n; i++) {
            c[i] = fresh_c[i];
            sum[i] = fresh_sum[i];
            for (int j = 0; j < k + n; j++) G[std::size_t(i) * cap + j] = N[std::size_t(i) * cap + j];
            rest[i] = 0.0;
        }
        for (int l = 0; l < constraints(); l++)
            for (int j = 0; j < n; j++) A[std::size_t(l) * cap + k + j] = 0.0;
        count[0] = k + n;
    }

    // g = h G and what is known of h x: its middle and its half-width, both safe
    void project(const double* h, double& middle, double& half, double& rounding) {
        const int k = generators();
        for (int j = 0; j < k; j++) g[j] = 0.0;
        middle = 0.0;
        double size = 0.0, far = 0.0;
        for (int l = 0; l < n; l++) {
            if (h[l] == 0.0) continue;
            const double* row = G + std::size_t(l) * cap;
            for (int j = 0; j < k; j++) g[j] += h[l] * row[j];
            middle += h[l] * c[l];
            size += size_of(h[l]) * (size_of(c[l]) + sum[l]);
            far += size_of(h[l]) * rest[l];
        }
        const double s = sum_abs(k, g);
        rounding = slack(n, size);
        carried = far > 0.0 ? up(far + slack(n, far)) : 0.0;
        half = up(up(s + slack(k, s)) + up(carried + rounding));
    }

    // Fold a_lo <= h x <= a_hi in.
    Strip fold(const double* h, double a_lo, double a_hi) {
        double middle, half, rounding;
        sum_rows();
        project(h, middle, half, rounding);
        const double near = down(middle - half), far = up(middle + half);
        if (a_lo > far || a_hi < near) return Strip::contradicts;
        if (a_lo <= near && a_hi >= far) return Strip::idle;
        const double lo = max2(a_lo, near), hi = min2(a_hi, far);
        const Coefficient strip = coefficient(&lo, &hi, 0);
        return rows_most > 0 ? keep(strip, middle, rounding) : gain(strip, middle, rounding);
    }

    // x + K (z - h x - r eta)
    Strip gain(const Coefficient& strip, double middle, double rounding) {
        const int k = generators();
        const double S = strip.rad * strip.rad + product(k, g, g), size = sum_abs(k, g);
        if (!(S > 0.0) || !finite(S)) return Strip::idle;
        const double step = strip.mid - middle, off = slack(2, size_of(strip.mid) + size_of(middle)) + 2.0 * rounding;
        for (int i = 0; i < n; i++) K[i] = product(k, G + std::size_t(i) * cap, g) / S;
        for (int i = 0; i < n; i++) {
            double* row = G + std::size_t(i) * cap;
            const double gain = K[i];
            for (int j = 0; j < k; j++) row[j] -= gain * g[j];
            row[k] = gain * strip.rad;
            const double moved = gain * step;
            // the remainder goes through I - K h too
            rest[i] = up(up(rest[i] + up(size_of(gain) * up(off + carried))) +
                         slack(4, sum[i] + size_of(gain) * size + size_of(moved) + size_of(c[i])));
            c[i] += moved;
        }
        count[0] = k + 1;
        summed = false;
        return Strip::folded;
    }

    // keep the strip as a constraint, scaled by a power of two, which is exact
    Strip keep(const Coefficient& strip, double middle, double rounding) {
        const int k = generators(), l = constraints();
        double most_of_row = 0.0;
        for (int j = 0; j < k; j++) most_of_row = max2(most_of_row, size_of(g[j]));
        if (!(most_of_row > smallest) || !finite(most_of_row)) return Strip::idle;
        int exponent;
        std::frexp(most_of_row, &exponent);
        const double scale = std::ldexp(1.0, -exponent);
        double* row = A + std::size_t(l) * cap;
        for (int j = 0; j < k; j++) row[j] = scale * g[j];
        b[l] = scale * (strip.mid - middle);
        const double off = slack(2, size_of(strip.mid) + size_of(middle)) + 2.0 * rounding + carried;
        t[l] = up(up(scale * up(strip.rad + off)) + k * 1e-321);  // what is too small to scale
        count[1] = l + 1;
        return Strip::folded;
    }

    // The oldest constraint, A_0 xi = b_0 + t_0 eta, becomes a generator: L times it is added to each row of G and A.
    void absorb() {
        const int k = generators(), last = constraints() - 1;
        const double S = t[0] * t[0] + product(k, A, A), size = size_of(b[0]) + t[0] + sum_abs(k, A);
        for (int i = 0; i < n + last; i++) {
            const bool state = i < n;
            const int l = i - n + 1;
            double* row = state ? G + std::size_t(i) * cap : A + std::size_t(l) * cap;
            const double own = sum_abs(k, row), L = S > 0.0 ? product(k, row, A) / S : 0.0;
            for (int j = 0; j < k; j++) row[j] -= L * A[j];
            row[k] = L * t[0];
            const double off = slack(4, own + size_of(state ? c[i] : b[l]) + size_of(L) * size);
            if (state) {
                c[i] += L * b[0];
                rest[i] = up(rest[i] + off);
            } else {
                b[l] -= L * b[0];
                t[l] = up(t[l] + off);
            }
        }
        count[0] = k + 1;
        summed = false;
        drop(0);
    }

    void drop(int row) {
        const int k = generators(), last = constraints() - 1;
        for (int l = row; l < last; l++) {
            for (int j = 0; j < k; j++) A[std::size_t(l) * cap + j] = A[std::size_t(l + 1) * cap + j];
            b[l] = b[l + 1];
            t[l] = t[l + 1];
        }
        count[1] = last;
    }

    // The `gone` generators of least score leave: what they reach goes to the remainders and the strips' widths.
    void box(int gone) {
        const int k = generators(), left = k - gone, rows = constraints();
        double *least = score + cap, *where = g;
        for (int j = 0, held = 0; j < k; j++) {
            if (held == gone && !(score[j] < least[gone - 1])) continue;
            int at = held < gone ? held++ : gone - 1;
            for (; at > 0 && score[j] < least[at - 1]; at--) least[at] = least[at - 1], where[at] = where[at - 1];
            least[at] = score[j], where[at] = j;
        }
        for (int i = 0; i < n + rows; i++) {
            const double* row = i < n ? G + std::size_t(i) * cap : A + std::size_t(i - n) * cap;
            double s = 0.0;
            for (int q = 0; q < gone; q++) s += size_of(row[static_cast<int>(where[q])]);
            double& reach = i < n ? rest[i] : t[i - n];
            reach = up(reach + up(s + slack(gone, s)));
        }
        // the places that fall free below `left` are for those that stay beyond it
        for (int q = 0; q < gone; q++) score[static_cast<int>(where[q])] = -1.0;
        double *from = least, *to = where;
        int moves = 0;
        for (int q = 0, last = k - 1; q < gone; q++) {
            if (where[q] >= left) continue;
            while (score[last] < 0.0) last--;
            from[moves] = last--;
            to[moves++] = where[q];
        }
        for (int i = 0; i < n + rows; i++) {
            double* row = i < n ? G + std::size_t(i) * cap : A + std::size_t(i - n) * cap;
            for (int q = 0; q < moves; q++) row[static_cast<int>(to[q])] = row[static_cast<int>(from[q])];
        }
    }

    // back to `most` generators and `rows_most` constraints
    void reduce() {
        for (int l = constraints() - 1; l >= 0; l--)  // what boxing has widened until it cuts nothing
            if (row_sum(A + std::size_t(l) * cap) + size_of(b[l]) <= t[l]) drop(l);
        while (constraints() > rows_most) absorb();
        int k = generators();
        const int rows = constraints(), kept_most = most - n;
        double any = 0.0;
        for (int i = 0; i < n; i++) any = max2(any, rest[i]);
        if (k <= most && any == 0.0) return;
        if (k > kept_most) {
            for (int j = 0; j < k; j++) score[j] = score[cap + j] = 0.0;
            for (int i = 0; i < n + rows; i++) {
                const double* row = i < n ? G + std::size_t(i) * cap : A + std::size_t(i - n) * cap;
                const double scale = row_sum(row) + (i < n ? 0.0 : t[i - n]);
                const double per = scale > 0.0 && finite(1.0 / scale) ? 1.0 / scale : 0.0;
                for (int j = 0; j < k; j++) {
                    const double s = size_of(row[j]) * per;
                    score[j] += s;
                    score[cap + j] = max2(score[cap + j], s);
                }
            }
            for (int j = 0; j < k; j++) score[j] -= score[cap + j];
            box(k - kept_most);
            k = kept_most;
        }
        for (int i = 0; i < n; i++) {
            double* row = G + std::size_t(i) * cap;
            for (int j = 0; j < n; j++) row[k + j] = j == i ? rest[i] : 0.0;
            rest[i] = 0.0;
        }
        for (int l = 0; l < rows; l++)
            for (int j = 0; j < n; j++) A[std::size_t(l) * cap + k + j] = 0.0;
        count[0] = k + n;
        summed = false;
    }

    // The box of the set, met with lo, hi; false: nothing is left.
    bool meet(double* lo, double* hi) {
        const int rows = constraints();
        sum_rows();
        if (rows > 0) {
            for (int l = 0; l < rows; l++) sum_of[l] = row_sum(A + std::size_t(l) * cap);
            multipliers({n, generators(), rows, cap, rounds, G, A, b, t, y, aside});
        }
        for (int i = 0; i < n; i++) {
            const double* row = G + std::size_t(i) * cap;
            const double s = sum[i], all = up(s + rest[i]);
            lo[i] = max2(lo[i], down(c[i] - all));
            hi[i] = min2(hi[i], up(c[i] + all));
            if (rows > 0) {
                const double *most = y + 2 * std::size_t(i) * rows, *least = most + rows;
                hi[i] = min2(hi[i], up(up(c[i] + bound(row, 1.0, s, most)) + rest[i]));
                lo[i] = max2(lo[i], down(down(c[i] - bound(row, -1.0, s, least)) - rest[i]));
            }
            if (!(lo[i] <= hi[i])) return false;
        }
        return true;
    }

    // y b + t |y| + |g - y A|_1 for g = sign * row, rounded up; inf where that is no number
    double bound(const double* row, double sign, double size_of_row, const double* y) const {
        const int k = generators(), rows = constraints();
        double total = 0.0, size = size_of_row;
        for (int l = 0; l < rows; l++) {
            const double s = size_of(y[l]);
            total += y[l] * b[l] + s * t[l];
            size += s * (size_of(b[l]) + t[l] + sum_of[l]);
        }
        V4 left{};
        int j = 0;
        for (; j + 4 <= k; j += 4) {
            V4 d = sign * *reinterpret_cast<const V4u*>(row + j);
            for (int l = 0; l < rows; l++) d -= y[l] * *reinterpret_cast<const V4u*>(A + std::size_t(l) * cap + j);
            left += d < 0.0 ? -d : d;
        }
        double rest_of_it = 0.0;
        for (; j < k; j++) {
            double d = sign * row[j];
            for (int l = 0; l < rows; l++) d -= y[l] * A[std::size_t(l) * cap + j];
            rest_of_it += size_of(d);
        }
        const double sum = (left[0] + left[1]) + (left[2] + left[3]) + rest_of_it;
        const double safe = up(total + sum + slack(k + rows + 4, size));
        return safe == safe ? safe : inf;
    }

    bool sound() const {
        double s = 0.0;
        for (int i = 0; i < n; i++) {
            s += 0.0 * c[i] + 0.0 * rest[i];
            for (int j = 0; j < generators(); j++) s += 0.0 * G[std::size_t(i) * cap + j];
        }
        for (int l = 0; l < constraints(); l++) {
            s += 0.0 * b[l] + 0.0 * t[l];
            for (int j = 0; j < generators(); j++) s += 0.0 * A[std::size_t(l) * cap + j];
        }
        return s == 0.0;
    }
};

}  // namespace HW_ISA
}  // namespace hw
