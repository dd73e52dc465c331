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
    hull_rows_of(win, space.rows, space.extra);
    if (!task.given)
        task.iterations = hull_solve(space.rows, set, task.costs, task.c, task.k, task.y, task.value, task.gap, space.solver);
    const std::ptrdiff_t stride = std::ptrdiff_t(win.K) * (win.n + win.m);
    for (int p = 0; p < task.costs; p++)
        task.bound[p] = hull_sup(space.rows, task.c + std::ptrdiff_t(p) * win.n, task.k[p], task.y + p * stride, space.d);
    return 0;
}

}  // namespace HW_ISA
}  // namespace hw
