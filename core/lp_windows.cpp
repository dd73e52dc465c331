// A window sliding over a record: one linear program a row, each from where the one before ended.
#include <time.h>

#include "lp.hpp"
#include "small.hpp"

namespace hw {
namespace HW_ISA {

constexpr double none = 1e300;  // bounds at or beyond this are absent

static double seconds() {
    timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
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
    static const double any = 0.0;
    lp.x0_lo = lp.x0_hi = &any;  // as if bounded: never less than any window needs
    return lp_workspace(lp, set);
}

static bool any_seen(const LpProblem& lp, std::ptrdiff_t t) {
    for (int j = 0; j < lp.m; j++)
        if (lp.seen[t * lp.m + j]) return true;
    return false;
}

// the state of row t that the model alone expects after x, inside its box
static void ahead(const LpProblem& lp, std::ptrdiff_t t, const double* x, double* next) {
    const std::ptrdiff_t n = lp.n;
    const double *A = lp.A + (lp.A_t ? t * n * n : 0), *E = lp.E ? lp.E + (lp.E_t ? t * n * n : 0) : nullptr;
    for (std::ptrdiff_t j = n - 1; j >= 0; j--) {
        double s = lp.bx[t * n + j];
        for (std::ptrdiff_t c = 0; c < n; c++) s += A[j * n + c] * x[c];
        for (std::ptrdiff_t c = j + 1; E && c < n; c++) s -= E[j * n + c] * next[c];
        next[j] = s;
    }
    for (std::ptrdiff_t j = 0; j < n && lp.lo; j++) {
        const std::ptrdiff_t k = (lp.box_t ? (t + 1) * n : 0) + j;
        next[j] = max2(lp.lo[k], min2(lp.hi[k], next[j]));
    }
}

// the window that ends at row t estimates state k as x
static void note(const LpWindows& win, int t, std::ptrdiff_t k, const double* x) {
    const std::ptrdiff_t n = win.whole.n;
    for (std::ptrdiff_t j = 0; j < n; j++) {
        win.smoothed[k * n + j] = x[j];
        if (t > win.last[k]) continue;
        win.low[k * n + j] = min2(win.low[k * n + j], x[j]);
        win.high[k * n + j] = max2(win.high[k * n + j], x[j]);
    }
}

int lp_windows(const LpWindows& win, const LpSettings& set, void* workspace) {
    const LpProblem& all = win.whole;
    const std::ptrdiff_t n = all.n;
    double *x0_lo = win.scratch, *x0_hi = x0_lo + n, *x = x0_hi + n;
    int unsolved = 0;
    for (std::ptrdiff_t k = 0; k < (all.T + 1) * n; k++) win.low[k] = none, win.high[k] = -none, win.smoothed[k] = 0.0;
    for (int t = 0; t < all.T; t++) {
        const int a = win.start[t];
        double* newest = win.filtered + static_cast<std::ptrdiff_t>(t) * n;
        double* s = win.s + static_cast<std::ptrdiff_t>(t) * all.ns;
        if (set.warm && t > 0) win.warm->drop += a - win.start[t - 1];
        if (t > 0 && !any_seen(all, t)) {  // says nothing new: the estimate moves on along the model
            ahead(all, t, newest - n, newest);
            for (int j = 0; j < all.ns; j++) s[j] = s[j - all.ns];
            win.status[t] = win.status[t - 1];
            win.iterations[t] = 0;
            win.seconds[t] = 0.0;
            note(win, t, t + 1, newest);
            continue;
        }
        LpProblem lp = part(all, a, t);
        const double stretch = win.memory > 2 ? win.carry * win.memory / (win.memory - 2.0) : win.carry;
        if (win.carry > 0.0 && a > 0 && t >= win.last[a]) {
            // The state before the window is known by an interval: the one its own windows agreed on.
            for (int j = 0; j < n; j++) {
                const double lo = win.low[a * n + j], hi = win.high[a * n + j];
                const double mid = 0.5 * (lo + hi), half = 0.5 * stretch * (hi - lo);
                const double box_lo = lp.lo ? lp.lo[j] : -none, box_hi = lp.hi ? lp.hi[j] : none;
                x0_lo[j] = max2(box_lo, mid - half);
                x0_hi[j] = min2(box_hi, mid + half);
                if (!(x0_lo[j] < x0_hi[j])) x0_lo[j] = box_lo, x0_hi[j] = box_hi;
            }
            lp.x0_lo = x0_lo;
            lp.x0_hi = x0_hi;
        }
        if (t < win.early_rows) lp.c = win.early + static_cast<std::ptrdiff_t>(t) * all.ns;
        LpOut out{};
        out.warm = win.warm;
        double theta = 0.0;
        out.x = x;
        out.theta = &theta;
        out.s = s;
        const double begin = seconds();
        win.status[t] = lp_solve(lp, set, out, workspace);
        win.seconds[t] = seconds() - begin;
        win.iterations[t] = out.info.iterations;
        unsolved += win.status[t] > lp_reduced;
        for (int i = 0; i <= lp.T; i++) note(win, t, a + i, x + i * n);
        for (int j = 0; j < n; j++) newest[j] = x[lp.T * n + j];
    }
    return unsolved;
}

}  // namespace HW_ISA
}  // namespace hw
