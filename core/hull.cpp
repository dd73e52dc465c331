// Entry points of core/hull.hpp.
#include "carver.hpp"
#include "hull.hpp"
#include "hull_entry.hpp"

namespace hw {
namespace HW_ISA {
namespace {

struct Space {
    HullRows rows{};
    double *box, *d, *extra;
    char* solver;
    std::size_t bytes;
    Space(int K, int n, int m, void* base) {
        Carver c{static_cast<char*>(base)};
        const std::ptrdiff_t states = std::ptrdiff_t(K) + 1, nn = std::ptrdiff_t(n) * n;
        c.many(states * n, rows.mid, rows.v_lo, rows.v_hi);
        c.many(std::ptrdiff_t(K) * (n + m), rows.r_lo, rows.r_hi);
        c.many(K * nn, rows.Em, rows.Am);
        rows.Cm = c.take<double>(std::ptrdiff_t(K) * m * n);
        box = c.take<double>(static_cast<std::ptrdiff_t>(box_doubles(n)));
        d = c.take<double>(2 * n);
        extra = c.take<double>(n + m);
        solver = c.take<char>(static_cast<std::ptrdiff_t>(hull_solve_bytes(K, n, m)));
        bytes = c.used;
    }
};

}  // namespace

std::size_t hull_bytes(int K, int n, int m) { return Space(K, n, m, nullptr).bytes + 64; }

std::ptrdiff_t hull_run(HullTask& task, const HullSettings& set, void* workspace) {
    const HullWindow& win = task.win;
    Space space(win.K, win.n, win.m, workspace);
    if (task.sweeps > 0) {
        BoxChain box{win.K, win.n, win.m, win.E_lo, win.E_hi, win.A_lo, win.A_hi, win.C_lo, win.C_hi, win.E_t, win.A_t, win.C_t,
                     win.bx_lo, win.bx_hi, win.by_lo, win.by_hi, task.lo, task.hi, task.sweeps, space.box};
        const std::ptrdiff_t bad = box_contract(box);
        if (bad) return bad;
    }
    bool bounded = true;
    for (std::ptrdiff_t i = 0; i < std::ptrdiff_t(win.K + 1) * win.n; i++) bounded = bounded && finite(task.lo[i]) && finite(task.hi[i]);
    const std::ptrdiff_t stride = std::ptrdiff_t(win.K) * (win.n + win.m);
    if (!bounded && !task.given) {  // any rounding of an unbounded state is infinite: the caller bounds it first
        for (int p = 0; p < task.costs; p++) {
            task.bound[p] = task.gap[p] = inf;
            task.value[p] = -inf;
            for (std::ptrdiff_t i = 0; i < stride; i++) task.y[p * stride + i] = 0.0;
        }
        return 0;
    }
    hull_rows_of(win, space.rows, space.extra);
    if (!task.given)
        task.iterations = hull_solve(space.rows, set, task.costs, task.c, task.k, task.y, task.value, task.gap, space.solver);
    for (int p = 0; p < task.costs; p++)
        task.bound[p] = hull_sup(space.rows, task.c + std::ptrdiff_t(p) * win.n, task.k[p], task.y + p * stride, space.d);
    return 0;
}

std::size_t hull_sweep_bytes(int longest, int n, int m) {
    Carver c{nullptr};
    const std::ptrdiff_t sides = 2 * n, kinds = n + m;
    double *a, *b;
    c.many((std::ptrdiff_t(longest) + 1) * n, a, b);
    c.many(sides * n, a);
    c.many(sides * longest * kinds, a);
    c.many(sides, a, b);
    c.many(sides, a);
    c.take<int>(sides);
    return c.used + 64 + hull_bytes(longest, n, m);
}

int hull_sweep(HullSweep& sweep, int from, const HullSettings& set, int longest, void* workspace) {
    const HullWindow& all = sweep.whole;
    const int n = all.n, m = all.m, sides = 2 * n;
    const std::ptrdiff_t nn = std::ptrdiff_t(n) * n, mn = std::ptrdiff_t(m) * n;
    Carver carver{static_cast<char*>(workspace)};
    HullTask task{};
    carver.many((std::ptrdiff_t(longest) + 1) * n, task.lo, task.hi);
    double* c = carver.take<double>(sides * n);
    task.y = carver.take<double>(std::ptrdiff_t(sides) * longest * (n + m));
    carver.many(sides, task.bound, task.value);
    task.gap = carver.take<double>(sides);
    int* k = carver.take<int>(sides);
    void* rest = carver.take<char>(0);
    for (int i = 0; i < sides * n; i++) c[i] = 0.0;
    for (int j = 0; j < n; j++) c[j * n + j] = 1.0, c[(n + j) * n + j] = -1.0;
    task.c = c;
    task.k = k;
    task.costs = sides;
    for (int one = from; one < sweep.tasks; one++) {
        const int a = sweep.a[one], b = sweep.b[one], at = sweep.k[one] - a;
        const std::ptrdiff_t first = std::ptrdiff_t(a) * n, count = std::ptrdiff_t(b - a + 1) * n;
        HullWindow& win = task.win;
        win = all;
        win.K = b - a;
        auto part = [&](const double*& lo, const double*& hi, bool moving, std::ptrdiff_t size) {
            if (lo && moving) lo += a * size;
            if (hi && moving) hi += a * size;
        };
        part(win.E_lo, win.E_hi, win.E_t, nn);
        part(win.A_lo, win.A_hi, win.A_t, nn);
        part(win.C_lo, win.C_hi, win.C_t, mn);
        part(win.bx_lo, win.bx_hi, true, n);
        part(win.by_lo, win.by_hi, true, m);
        win.lo = task.lo;
        win.hi = task.hi;
        for (std::ptrdiff_t i = 0; i < count; i++) task.lo[i] = sweep.lo[first + i], task.hi[i] = sweep.hi[first + i];
        for (int p = 0; p < sides; p++) k[p] = at;
        double *lo = task.lo + std::ptrdiff_t(at) * n, *hi = task.hi + std::ptrdiff_t(at) * n;
        bool tight = false;
        for (int round = 0; round < 3 && !tight; round++) {  // once more from the narrower box
            task.sweeps = round == 0;
            if (hull_run(task, set, rest)) return one;
            for (std::ptrdiff_t i = 0; i < count && round == 0; i++)
                if (!finite(task.lo[i]) || !finite(task.hi[i])) return one;
            tight = true;
            for (int j = 0; j < n; j++) {
                const double upper = task.bound[j], lower = -task.bound[n + j];
                if (!(lower <= upper)) return one;
                lo[j] = max2(lo[j], lower);
                hi[j] = min2(hi[j], upper);
                if (!(lo[j] <= hi[j])) return one;
                const double slack = sweep.loose * (hi[j] - lo[j]) + sweep.least * largest_of(lo[j], hi[j]);
                tight = tight && size_of(task.bound[j] - task.value[j]) <= slack;
                tight = tight && size_of(task.bound[n + j] - task.value[n + j]) <= slack;
            }
        }
        if (!tight) return one;
        for (std::ptrdiff_t i = 0; i < count; i++) {
            sweep.lo[first + i] = max2(sweep.lo[first + i], task.lo[i]);
            sweep.hi[first + i] = min2(sweep.hi[first + i], task.hi[i]);
        }
        for (int j = 0; j < n; j++) {
            sweep.out_lo[std::ptrdiff_t(one) * n + j] = lo[j];
            sweep.out_hi[std::ptrdiff_t(one) * n + j] = hi[j];
        }
    }
    return sweep.tasks;
}

}  // namespace HW_ISA
}  // namespace hw
