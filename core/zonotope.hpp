// Zonotopes, and zonotopes cut by strips: sets {c + G xi : |xi_j| <= 1, |A xi - b| <= t}, the last part absent in a zonotope.
//
// Motion is a linear map and a few more generators. Of an output, a strip |z - h x| <= r, a zonotope keeps what the best gain
// leaves: x = x + K (z - h x - r eta), with the K that makes the generators least in the Frobenius norm [1]. A constrained
// zonotope keeps the strip itself as a row of A, and its oldest row turns into generators by the same formula when there are
// too many; until then the set is exact [2]. Too many generators: the least ones are boxed, in a constrained zonotope together
// with their entries in A, which widens t.
//
// Whatever K, whatever is boxed, the set contains; rounding is bounded from above by `slack` and added where it belongs, so it
// contains in floating point too. The box of a constrained zonotope comes from a dual simplex, whose multipliers y bound the
// programme whatever they are,
//
//     max g xi  <=  y b + t |y| + |g - y A|_1,
//
// so that stopping early or rounding loosens it and breaks nothing.
//
// [1] Combastel (2015), Automatica 55. [2] Scott, Raimondo, Marseglia and Braatz (2016), Automatica 69.
#pragma once

#include "box.hpp"
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
    // state: generators and constraints in use are kept as numbers, so that a state is one array of doubles
    double *count, *c, *G, *A, *b, *t;
    // work: new generators (n,cap), row sums, remainder; then the tableau of the dual simplex
    double *N, *sum, *rest, *g, *K, *score, *lp;
    double carried = 0.0;  // |h| rest of the row being folded

    int generators() const { return static_cast<int>(count[0]); }
    int constraints() const { return static_cast<int>(count[1]); }

    static int columns(const SetSizes& z) { return z.generators + 3 * z.n + 2 * z.m; }
    static int rows(const SetSizes& z) { return z.kind == SetKind::constrained ? z.constraints + z.m + z.n : 0; }
    static std::size_t state(const SetSizes& z) {
        return 2 + z.n + std::size_t(z.n + rows(z)) * columns(z) + 2 * std::size_t(rows(z));
    }
    static std::size_t work(const SetSizes& z) {
        const std::size_t w = columns(z) + 4, k = rows(z);
        return z.n * w + 4 * z.n + 3 * w + k * w + 8 * w + 5 * k;
    }
    Zonotope(const SetSizes& z, double* s, double* w)
        : n(z.n), most(z.generators), rows_most(z.kind == SetKind::constrained ? z.constraints : 0), cap(columns(z)), rows_cap(rows(z)) {
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
        lp = score + 2 * cap;
    }

    void start(const double* lo, const double* hi) {
        count[0] = n;
        count[1] = 0;
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

    void move(const Motion& q) {
        const int k = generators();
        for (int i = 0; i < n; i++) sum[i] = size_of(c[i]) + row_sum(G + std::size_t(i) * cap);
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
                size += size_of(a) * sum[l];
            }
            for (int l = i + 1; l < n && q.E_lo; l++) {
                const double e = q.E(i, l).mid;
                if (e == 0.0) continue;
                const double* below_it = N + std::size_t(l) * cap;
                for (int j = 0; j < k + n; j++) row[j] -= e * below_it[j];
                centre -= e * fresh_c[l];
                size += size_of(e) * fresh_sum[l];
            }
            // the noise of the row, and all that rounding and unknown entries did to it: one generator
            row[k + i] = up(up(shift.rad + q.unknown(i)) + slack(2 * n + 1, size));
            fresh_c[i] = centre;
            const double s = size_of(centre) + sum_abs(k + n, row);
            fresh_sum[i] = s + slack(k + n, s);
        }
        for (int i = 0; i < n; i++) {
            c[i] = fresh_c[i];
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
        for (int i = 0; i < n; i++) sum[i] = row_sum(G + std::size_t(i) * cap);
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
        double* row = A + std::size_t(l) * cap;
        for (int j = 0; j < k; j++) row[j] = std::ldexp(g[j], -exponent);
        b[l] = std::ldexp(strip.mid - middle, -exponent);
        const double off = slack(2, size_of(strip.mid) + size_of(middle)) + 2.0 * rounding + carried;
        t[l] = up(std::ldexp(up(strip.rad + off), -exponent));
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
            while (k > kept_most) {
                int least = 0;
                for (int j = 1; j < k; j++) least = score[j] < score[least] ? j : least;
                k--;
                for (int i = 0; i < n; i++) {
                    double* row = G + std::size_t(i) * cap;
                    rest[i] = up(rest[i] + size_of(row[least]));
                    row[least] = row[k];
                }
                for (int l = 0; l < rows; l++) {
                    double* row = A + std::size_t(l) * cap;
                    t[l] = up(t[l] + size_of(row[least]));
                    row[least] = row[k];
                }
                score[least] = score[k];
            }
        }
        for (int i = 0; i < n; i++) {
            double* row = G + std::size_t(i) * cap;
            for (int j = 0; j < n; j++) row[k + j] = j == i ? rest[i] : 0.0;
            rest[i] = 0.0;
        }
        for (int l = 0; l < rows; l++)
            for (int j = 0; j < n; j++) A[std::size_t(l) * cap + k + j] = 0.0;
        count[0] = k + n;
    }

    // The box of the set, met with lo, hi; false: nothing is left.
    bool meet(double* lo, double* hi) {
        const int rows = constraints();
        bool feasible = true;
        if (rows > 0) open();
        for (int i = 0; i < n; i++) {
            const double* row = G + std::size_t(i) * cap;
            const double s = up(row_sum(row) + rest[i]);
            lo[i] = max2(lo[i], down(c[i] - s));
            hi[i] = min2(hi[i], up(c[i] + s));
            if (rows > 0 && feasible) {
                hi[i] = min2(hi[i], up(up(c[i] + most_of(row, 1.0, feasible)) + rest[i]));
                if (feasible) lo[i] = max2(lo[i], down(down(c[i] - most_of(row, -1.0, feasible)) - rest[i]));
            }
            if (!(lo[i] <= hi[i])) return false;
        }
        return feasible;
    }

    // ---- dual simplex on max g xi, A xi + sigma = b, |xi| <= 1, |sigma| <= t --------------------------------------------
    // x_B = beta - T x_N; basic and nonbasic variables by number, xi first. A nonbasic variable stands at the end of its
    // range that its reduced cost d prefers, which is dual feasible in any basis, so each programme starts where the last ended.
    // Rows are padded with zeros to whole vectors.

    struct Turn {
        double at, weight;
        int variable;
    };
    struct Tableau {
        double *T, *beta, *d, *at, *range, *limit, *cost, *y;
        int *basic, *free;
        Turn* turn;
    };
    static int padded(int k) { return (k + 3) & ~3; }
    Tableau tableau() const {
        const std::size_t w = padded(cap), k = rows_cap;
        Tableau q;
        q.T = lp;
        q.beta = q.T + k * w;
        q.limit = q.beta + k;
        q.y = q.limit + k;
        q.d = q.y + k;
        q.at = q.d + w;
        q.range = q.at + w;
        q.cost = q.range + w;
        q.turn = reinterpret_cast<Turn*>(q.cost + w + k);
        q.basic = reinterpret_cast<int*>(q.turn + w);
        q.free = q.basic + k;
        return q;
    }
    void open() {
        const Tableau q = tableau();
        const int k = generators(), rows = constraints(), w = padded(cap), pad = padded(k);
        for (int l = 0; l < rows; l++) {
            for (int j = 0; j < pad; j++) q.T[std::size_t(l) * w + j] = j < k ? A[std::size_t(l) * cap + j] : 0.0;
            q.beta[l] = b[l];
            q.limit[l] = t[l];
            q.basic[l] = k + l;
        }
        for (int j = 0; j < pad; j++) {
            q.free[j] = j < k ? j : 0;
            q.range[j] = j < k ? 1.0 : 0.0;
            q.d[j] = q.at[j] = 0.0;
        }
    }
    // a . b and a . a of padded rows
    static void products(int k, const double* a, const double* b, double& ab, double& aa) {
        V4 s{}, z{};
        for (int j = 0; j < k; j += 4) {
            const V4 x = *reinterpret_cast<const V4u*>(a + j);
            s += x * *reinterpret_cast<const V4u*>(b + j);
            z += x * x;
        }
        ab = (s[0] + s[1]) + (s[2] + s[3]);
        aa = (z[0] + z[1]) + (z[2] + z[3]);
    }
    static void subtract(int k, double f, const double* a, double* out) {
        for (int j = 0; j < k; j += 4) *reinterpret_cast<V4u*>(out + j) -= f * *reinterpret_cast<const V4u*>(a + j);
    }

    // Pass breakpoints in their order, flipping what is passed, until the slope is used up: the variable it ends at, or -1.
    // By partition, as the middle of a list is found: which ones are passed matters, not their order.
    static int passed(Turn* turn, int points, double slope, double* at) {
        int from = 0, to = points;
        while (from < to) {
            const double x = turn[from].at, y = turn[(from + to) / 2].at, z = turn[to - 1].at;
            const double pivot = max2(min2(x, y), min2(max2(x, y), z));
            int m = from;
            double weight = 0.0;
            for (int i = from; i < to; i++) {
                const Turn one = turn[i];
                turn[i] = turn[m];
                turn[m] = one;
                m += one.at < pivot;
                weight += one.at < pivot ? one.weight : 0.0;
            }
            if (m == from) {  // the pivot is the least: those equal to it, one by one
                for (int i = from; i < to; i++) {
                    if (turn[i].at > pivot) continue;
                    slope -= turn[i].weight;
                    if (slope <= 0.0) return turn[i].variable;
                    at[turn[i].variable] = -at[turn[i].variable];
                    turn[i] = turn[from++];
                }
            } else if (slope <= weight) {
                to = m;
            } else {
                for (; from < m; from++) at[turn[from].variable] = -at[turn[from].variable];
                slope -= weight;
            }
        }
        return -1;
    }

    // a safe bound on max s g xi
    double most_of(const double* objective, double s, bool& feasible) {
        const Tableau q = tableau();
        const int k = generators(), rows = constraints(), w = padded(cap), pad = padded(k);
        for (int j = 0; j < k; j++) q.cost[j] = s * objective[j];
        for (int l = 0; l < rows; l++) q.cost[k + l] = 0.0;
        for (int j = 0; j < k; j++) q.d[j] = q.cost[q.free[j]];
        for (int l = 0; l < rows; l++)
            if (q.cost[q.basic[l]] != 0.0) subtract(pad, q.cost[q.basic[l]], q.T + std::size_t(l) * w, q.d);
        for (int j = 0; j < k; j++) q.at[j] = q.d[j] > 0.0 ? q.range[j] : -q.range[j];
        for (int round = 0; round < 3 * rows + 8; round++) {
            int out = -1;
            double worst = 0.0, side = 1.0, slope = 0.0;
            for (int l = 0; l < rows; l++) {
                double p, size;
                products(pad, q.T + std::size_t(l) * w, q.at, p, size);
                const double v = q.beta[l] - p, over = size_of(v) - q.limit[l];
                // steepest edge: violation by the length of its row
                if (over > 1e-10 && over * over > worst * (1.0 + size)) {
                    worst = over * over / (1.0 + size);
                    out = l, slope = over, side = v > 0.0 ? 1.0 : -1.0;
                }
            }
            if (out < 0) break;
            double* row = q.T + std::size_t(out) * w;
            // where reduced costs change sign; pass these points in order until the slope turns
            double tall = 0.0;
            for (int j = 0; j < k; j++) tall = max2(tall, size_of(row[j]));
            int points = 0;
            for (int j = 0; j < k; j++) {
                const double a = side * row[j];
                // a variable without a range has no end to flip to, and d of either sign
                if (a * q.at[j] < 0.0 && size_of(a) > 1e-9 * tall)
                    q.turn[points++] = {size_of(q.d[j] / a), 2.0 * size_of(a) * q.range[j], j};
            }
            const int in = passed(q.turn, points, slope, q.at);
            if (in < 0) {
                if (empty(q, out)) feasible = false;
                break;
            }
            const double inverse = 1.0 / row[in];
            row[in] = 1.0;
            for (int j = 0; j < pad; j++) row[j] *= inverse;
            q.beta[out] *= inverse;
            for (int l = 0; l < rows; l++) {
                double* other = q.T + std::size_t(l) * w;
                const double f = other[in];
                if (l == out || f == 0.0) continue;
                other[in] = 0.0;
                subtract(pad, f, row, other);
                q.beta[l] -= f * q.beta[out];
            }
            const double f = q.d[in];
            q.d[in] = 0.0;
            subtract(pad, f, row, q.d);
            const int entered = q.free[in];
            const double entered_range = q.range[in];
            q.free[in] = q.basic[out];
            q.range[in] = q.limit[out];
            q.at[in] = side * q.limit[out];
            q.basic[out] = entered;
            q.limit[out] = entered_range;
        }
        for (int l = 0; l < rows; l++) q.y[l] = 0.0;
        for (int j = 0; j < k; j++)
            if (q.free[j] >= k) q.y[q.free[j] - k] = -q.d[j];
        const double safe = feasible ? bound(q.cost, q.y) : inf;
        return safe == safe ? safe : inf;
    }

    // y b + t |y| + |g - y A|_1, rounded up; of any y, g = 0 where it is null
    double bound(const double* objective, const double* y) {
        const int k = generators(), rows = constraints();
        double total = 0.0, size = 0.0;
        for (int j = 0; j < k; j++) g[j] = objective ? objective[j] : 0.0, score[j] = size_of(g[j]);
        for (int l = 0; l < rows; l++) {
            if (y[l] == 0.0) continue;
            const double* row = A + std::size_t(l) * cap;
            const double s = size_of(y[l]);
            for (int j = 0; j < k; j++) {
                g[j] -= y[l] * row[j];
                score[j] += s * size_of(row[j]);
            }
            total += y[l] * b[l] + s * t[l];
            size += s * (size_of(b[l]) + t[l]);
        }
        return up(total + sum_abs(k, g) + slack(k + rows + 4, size + sum_abs(k, score)));
    }

    // whether row `out` of the tableau proves that no xi fits
    bool empty(const Tableau& q, int out) {
        const int k = generators(), rows = constraints();
        const double* row = q.T + std::size_t(out) * padded(cap);
        for (int l = 0; l < rows; l++) q.y[l] = 0.0;
        for (int j = 0; j < k; j++)
            if (q.free[j] >= k) q.y[q.free[j] - k] = row[j];
        if (q.basic[out] >= k) q.y[q.basic[out] - k] = 1.0;
        if (bound(nullptr, q.y) < 0.0) return true;
        for (int l = 0; l < rows; l++) q.y[l] = -q.y[l];
        return bound(nullptr, q.y) < 0.0;
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
