// Entry points of the structured linear program: the size is chosen here, once; n <= 8 are compiled for it.
#include <time.h>

#include "banded_ipm.hpp"
#include "lp.hpp"

namespace hw {
namespace HW_ISA {
namespace {

constexpr int lanes = 4;

static double seconds() {
    timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

template <int N>
struct Run {
    static std::size_t bytes(const LpProblem& lp, const LpSettings& set) {
        BandedIpm<lanes, N> ipm(lp, set);
        Carver c{nullptr};
        ipm.carve(c);
        return c.used + 64;
    }
    static int solve(const LpProblem& lp, const LpSettings& set, LpOut& out, void* workspace) {
        BandedIpm<lanes, N> ipm(lp, set);
        Carver c{static_cast<char*>(workspace)};
        ipm.carve(c);
        return ipm.solve(out);
    }
};

}  // namespace

#define HW_BY_SIZE(what, ...)                        \
    switch (lp.n) {                                  \
        case 1: return Run<1>::what(__VA_ARGS__);    \
        case 2: return Run<2>::what(__VA_ARGS__);    \
        case 3: return Run<3>::what(__VA_ARGS__);    \
        case 4: return Run<4>::what(__VA_ARGS__);    \
        case 5: return Run<5>::what(__VA_ARGS__);    \
        case 6: return Run<6>::what(__VA_ARGS__);    \
        case 7: return Run<7>::what(__VA_ARGS__);    \
        case 8: return Run<8>::what(__VA_ARGS__);    \
        default: return Run<0>::what(__VA_ARGS__);   \
    }

std::size_t lp_workspace(const LpProblem& lp, const LpSettings& set) { HW_BY_SIZE(bytes, lp, set) }

int lp_solve(const LpProblem& lp, const LpSettings& set, LpOut& out, void* workspace) {
    HW_BY_SIZE(solve, lp, set, out, workspace)
}

// the problem of rows a..b of a record: pointers into the whole
static LpProblem part(const LpProblem& whole, int a, int b) {
    LpProblem lp = whole;
    const std::ptrdiff_t n = lp.n, m = lp.m;
    lp.T = b - a + 1;
    if (lp.E_t) lp.E += a * n * n;
    if (lp.A_t) lp.A += a * n * n;
    if (lp.C_t) lp.C += a * m * n;
    if (lp.p0) lp.G += a * (n + m) * lp.p0;
    lp.bx += a * n;
    lp.by += a * m;
    lp.seen += a * m;
    if (lp.lo && lp.box_t) lp.lo += a * n, lp.hi += a * n;
    if (a > 0) lp.x0_lo = lp.x0_hi = nullptr;
    return lp;
}

std::size_t lp_windows_workspace(const LpWindows& win, const LpSettings& set) {
    int longest = 0;
    for (int t = 0; t < win.whole.T; t++) longest = t - win.start[t] > longest ? t - win.start[t] : longest;
    LpProblem lp = part(win.whole, 0, longest);
    static const double none = 0.0;
    lp.x0_lo = lp.x0_hi = &none;  // as if bounded: never less than any window needs
    return lp_workspace(lp, set);
}

int lp_windows(const LpWindows& win, const LpSettings& set, void* workspace) {
    const LpProblem& all = win.whole;
    const std::ptrdiff_t n = all.n;
    double *x0_lo = win.scratch, *x0_hi = x0_lo + n, *x = x0_hi + n;
    int unsolved = 0;
    for (std::ptrdiff_t k = 0; k < (all.T + 1) * n; k++) win.low[k] = lp_inf, win.high[k] = -lp_inf, win.smoothed[k] = 0.0;
    for (int t = 0; t < all.T; t++) {
        const int a = win.start[t];
        LpProblem lp = part(all, a, t);
        const double stretch = win.memory > 2 ? win.carry * win.memory / (win.memory - 2.0) : win.carry;
        if (win.carry > 0.0 && a > 0 && t - a >= win.memory) {
            // The state before the window is known by an interval: the one its own windows agreed on.
            for (int j = 0; j < n; j++) {
                const double lo = win.low[a * n + j], hi = win.high[a * n + j];
                const double mid = 0.5 * (lo + hi), half = 0.5 * stretch * (hi - lo);
                const double box_lo = lp.lo ? lp.lo[j] : -lp_inf, box_hi = lp.hi ? lp.hi[j] : lp_inf;
                x0_lo[j] = max2(box_lo, mid - half);
                x0_hi[j] = min2(box_hi, mid + half);
                if (!(x0_lo[j] < x0_hi[j])) x0_lo[j] = box_lo, x0_hi[j] = box_hi;
            }
            lp.x0_lo = x0_lo;
            lp.x0_hi = x0_hi;
        }
        LpOut out{};
        double theta = 0.0;
        out.x = x;
        out.theta = &theta;
        out.s = win.s + static_cast<std::ptrdiff_t>(t) * all.ns;
        const double begin = seconds();
        win.status[t] = lp_solve(lp, set, out, workspace);
        win.seconds[t] = seconds() - begin;
        win.iterations[t] = out.info.iterations;
        unsolved += win.status[t] > lp_reduced;
        for (int i = 0; i <= lp.T; i++)
            for (int j = 0; j < n; j++) {
                const std::ptrdiff_t k = (a + i) * n + j;
                win.smoothed[k] = x[i * n + j];
                if (a + i < t + 1 - win.memory) continue;  // an interval is of the first windows that hold a state
                win.low[k] = min2(win.low[k], x[i * n + j]);
                win.high[k] = max2(win.high[k], x[i * n + j]);
            }
        for (int j = 0; j < n; j++) win.filtered[t * n + j] = x[lp.T * n + j];
    }
    return unsolved;
}

}  // namespace HW_ISA
}  // namespace hw
