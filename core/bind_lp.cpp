// Python's door to core/lp.cpp: converts once, releases the GIL, holds no logic.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cstdlib>
#include <memory>
#include <new>
#include <optional>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "bind_array.hpp"
#include "lp.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Array = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Maybe = std::optional<Array>;
using Mask = nb::ndarray<const bool, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Index = nb::ndarray<const int, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// memory that outlives a call, so that a sliding window does not ask the system for pages at every step
class Scratch {
  public:
    void* get(std::size_t bytes) {
        if (bytes > size_) {
            std::free(data_);
            size_ = (bytes + 63) / 64 * 64;
            data_ = std::aligned_alloc(64, size_);
            if (!data_) {
                size_ = 0;
                throw std::bad_alloc();
            }
        }
        return data_;
    }
    void trim() {
        if (size_ > (std::size_t(64) << 20)) {
            std::free(data_);
            data_ = nullptr;
            size_ = 0;
        }
    }
    ~Scratch() { std::free(data_); }

  private:
    void* data_ = nullptr;
    std::size_t size_ = 0;
};
thread_local Scratch scratch;

void need(bool ok, const char* what) {
    if (!ok) throw std::invalid_argument(what);
}

// Where a problem may start and where the next one may: x, theta, s, lam, box, ends of hw::LpWarm.
using Start = std::tuple<Array, Array, Array, Array, Array, Array>;

class Warm {
  public:
    Warm(std::size_t rows_, const hw::LpProblem& lp) : n(lp.n), kinds(lp.n + lp.m), p0(lp.p0), ns(lp.ns) {
        const std::size_t parts[6] = {(rows_ + 1) * n, p0, ns, rows_ * kinds * 2, (rows_ + 1) * n * 2, (p0 + ns) * 2};
        double** places[6] = {&warm.x, &warm.theta, &warm.s, &warm.lam, &warm.box, &warm.ends};
        std::size_t count = 0;
        for (std::size_t part : parts) count += part;
        data.resize(count);
        count = 0;
        for (int k = 0; k < 6; k++) *places[k] = data.data() + count, count += parts[k];
    }
    void take(const Start& given, int drop) {
        const auto& [x, theta, s, lam, box, ends] = given;
        const std::size_t T = lam.shape(0);
        const Array* arrays[6] = {&x, &theta, &s, &lam, &box, &ends};
        const std::size_t sizes[6] = {(T + 1) * n, p0, ns, T * kinds * 2, (T + 1) * n * 2, (p0 + ns) * 2};
        double* places[6] = {warm.x, warm.theta, warm.s, warm.lam, warm.box, warm.ends};
        for (int k = 0; k < 6; k++) {
            need(arrays[k]->size() == sizes[k], "a start of the same n, m, theta and half-widths expected");
            std::copy(arrays[k]->data(), arrays[k]->data() + sizes[k], places[k]);
        }
        need(drop >= 0, "drop >= 0 expected");
        warm.T = static_cast<int>(T);
        warm.drop = drop;
    }
    nb::object give() const {
        if (warm.T == 0) return nb::none();
        const std::size_t T = warm.T;
        auto copy = [](std::initializer_list<std::size_t> shape, const double* from) {
            double* to = nullptr;
            nb::object array = fresh(shape, &to);
            std::size_t count = 1;
            for (std::size_t s : shape) count *= s;
            std::copy(from, from + count, to);
            return array;
        };
        return nb::make_tuple(copy({T + 1, n}, warm.x), copy({p0}, warm.theta), copy({ns}, warm.s),
                              copy({T, kinds, 2}, warm.lam), copy({T + 1, n, 2}, warm.box), copy({p0 + ns, 2}, warm.ends));
    }
    hw::LpWarm warm{};

  private:
    std::size_t n, kinds, p0, ns;
    std::vector<double> data;
};

const double* data_of(const Maybe& a) { return a ? a->data() : nullptr; }

struct Given {
    Maybe E;
    Array A, C;
    Maybe G;
    Array bx, by;
    Mask seen;
    Maybe lo, hi, x0_lo, x0_hi, theta_lo, theta_hi;
    Index group;
    Array h, c, floor, cap;
    Maybe slack;
};

hw::LpProblem problem(const Given& g) {
    const auto& [E, A, C, G, bx, by, seen, lo, hi, x0_lo, x0_hi, theta_lo, theta_hi, group, h, c, floor, cap, slack] = g;

    hw::LpProblem lp{};
    need(bx.ndim() == 2 && by.ndim() == 2 && A.ndim() >= 2 && C.ndim() >= 2, "bx (T,n), by (T,m), A, C expected");
    lp.T = static_cast<int>(bx.shape(0));
    lp.n = static_cast<int>(bx.shape(1));
    lp.m = static_cast<int>(by.shape(1));
    lp.p0 = G ? static_cast<int>(G->shape(2)) : 0;
    lp.ns = static_cast<int>(c.size());
    const std::size_t T = bx.shape(0), n = bx.shape(1), m = by.shape(1), rows = n + m;
    need(T >= 1 && n >= 1 && lp.ns >= 1, "at least one row, one state and one half-width expected");
    need(by.shape(0) == T && seen.shape(0) == T && seen.shape(1) == m, "by, seen (T,m) expected");
    auto matrix = [&](const Array& a, std::size_t r, bool& moving) {
        moving = a.ndim() == 3;
        need(a.size() == (moving ? T : 1) * r * n, "matrices (r,n) or (T,r,n) expected");
    };
    matrix(A, n, lp.A_t);
    matrix(C, m, lp.C_t);
    if (E) matrix(*E, n, lp.E_t);
    need(!G || G->size() == T * rows * G->shape(2), "G (T, n+m, p0) expected");
    need(group.shape(0) == rows && h.size() == rows, "group, h (n+m) expected");
    need(floor.size() == c.size() && cap.size() == c.size(), "c, floor, cap (ns) expected");
    need(!slack || slack->size() == rows, "slack (n+m) expected");
    need(!lo == !hi && !x0_lo == !x0_hi, "bounds come in pairs");
    lp.box_t = lo && lo->ndim() == 2;
    need(!lo || (lo->size() == hi->size() && lo->size() == (lp.box_t ? T + 1 : 1) * n), "lo, hi (n) or (T+1,n) expected");
    need(!x0_lo || (x0_lo->size() == n && x0_hi->size() == n), "x0_lo, x0_hi (n) expected");
    need(lp.p0 == 0 || (theta_lo && theta_hi && theta_lo->size() == std::size_t(lp.p0) && theta_hi->size() == std::size_t(lp.p0)),
         "theta_lo, theta_hi (p0) expected");
    for (std::size_t j = 0; j < rows; j++) need(group.data()[j] >= 0 && group.data()[j] < lp.ns, "group out of range");
    lp.E = data_of(E);
    lp.A = A.data();
    lp.C = C.data();
    lp.G = data_of(G);
    lp.bx = bx.data();
    lp.by = by.data();
    lp.seen = seen.data();
    lp.lo = data_of(lo);
    lp.hi = data_of(hi);
    lp.x0_lo = data_of(x0_lo);
    lp.x0_hi = data_of(x0_hi);
    lp.theta_lo = data_of(theta_lo);
    lp.theta_hi = data_of(theta_hi);
    lp.group = group.data();
    lp.h = h.data();
    lp.c = c.data();
    lp.floor = floor.data();
    lp.cap = cap.data();
    lp.slack = data_of(slack);
    return lp;
}

nb::tuple lp_solve(Maybe E, Array A, Array C, Maybe G, Array bx, Array by, Mask seen, Maybe lo, Maybe hi, Maybe x0_lo,
                   Maybe x0_hi, Maybe theta_lo, Maybe theta_hi, Index group, Array h, Array c, Array floor, Array cap,
                   Maybe slack, int point, double tol, double central_gap, int max_iter, bool multipliers,
                   std::optional<Start> start, int drop, bool keep) {
    const hw::LpProblem lp = problem({E, A, C, G, bx, by, seen, lo, hi, x0_lo, x0_hi, theta_lo, theta_hi, group, h, c,
                                      floor, cap, slack});
    const std::size_t T = lp.T, n = lp.n, rows = lp.n + lp.m;
    hw::LpSettings set;
    set.point = point;
    set.tol = tol;
    set.central_gap = central_gap;
    set.max_iter = max_iter;
    hw::LpOut out{};
    set.warm = keep || start;
    Warm warm(set.warm ? std::max(T, start ? std::get<3>(*start).shape(0) : 0) : 0, lp);
    if (start) warm.take(*start, drop);
    if (set.warm) out.warm = &warm.warm;
    nb::object x = fresh({T + 1, n}, &out.x), theta = fresh({std::size_t(lp.p0)}, &out.theta);
    nb::object s = fresh({std::size_t(lp.ns)}, &out.s), lam = nb::none(), e = nb::none();
    if (multipliers) lam = fresh({T, rows, 2}, &out.lam);
    if (slack) e = fresh({T, rows}, &out.slack);
    {
        nb::gil_scoped_release release;
        void* work = scratch.get(HW_PICK(lp_workspace)(lp, set));
        HW_PICK(lp_solve)(lp, set, out, work);
        scratch.trim();
    }
    nb::dict info;
    info["status"] = out.info.status;
    info["iterations"] = out.info.iterations;
    info["objective"] = out.info.objective;
    info["gap"] = out.info.gap;
    info["dual_residual"] = out.info.dual_residual;
    info["primal_residual"] = out.info.primal_residual;
    info["violation"] = out.info.violation;
    info["scale"] = out.info.scale;
    info["start"] = keep ? warm.give() : nb::none();
    return nb::make_tuple(x, theta, s, lam, e, info);
}

nb::tuple lp_windows(Maybe E, Array A, Array C, Array bx, Array by, Mask seen, Maybe lo, Maybe hi, Maybe x0_lo,
                     Maybe x0_hi, Index group, Array h, Array c, Array floor, Array cap, Array early, Index start, Index last, int memory,
                     double carry, int point, double tol, double central_gap, int max_iter, bool warm) {
    hw::LpWindows win{};
    win.whole = problem({E, A, C, std::nullopt, bx, by, seen, lo, hi, x0_lo, x0_hi, std::nullopt, std::nullopt, group, h,
                         c, floor, cap, std::nullopt});
    const std::size_t T = win.whole.T, n = win.whole.n, ns = win.whole.ns;
    need(start.shape(0) == T && last.shape(0) == T + 1, "start (T), last (T+1) expected");
    int longest = 0;
    for (int t = 0; t < win.whole.T; t++) {
        need(start.data()[t] >= 0 && start.data()[t] <= t, "0 <= start[t] <= t expected");
        longest = std::max(longest, t - start.data()[t]);
    }
    win.start = start.data();
    win.last = last.data();
    need(early.ndim() == 2 && early.shape(1) == ns, "early (rows, ns) expected");
    win.early = early.data();
    win.early_rows = static_cast<int>(early.shape(0));
    win.memory = memory;
    win.carry = carry;
    hw::LpSettings set;
    set.point = point;
    set.tol = tol;
    set.central_gap = central_gap;
    set.max_iter = max_iter;
    nb::object filtered = fresh({T, n}, &win.filtered), smoothed = fresh({T + 1, n}, &win.smoothed);
    nb::object s = fresh({T, ns}, &win.s), low = fresh({T + 1, n}, &win.low), high = fresh({T + 1, n}, &win.high);
    nb::object seconds = fresh({T}, &win.seconds);
    int* codes = new int[2 * T]();
    nb::capsule owner(codes, [](void* q) noexcept { delete[] static_cast<int*>(q); });
    nb::object both = nb::cast(nb::ndarray<nb::numpy, int>(codes, {std::size_t(2), T}, owner));
    win.status = codes;
    win.iterations = codes + T;
    std::unique_ptr<double[]> extra(new double[(longest + 4) * n]);
    win.scratch = extra.get();
    set.warm = warm;
    Warm start_of(warm ? longest + 1 : 0, win.whole);
    win.warm = &start_of.warm;
    {
        nb::gil_scoped_release release;
        void* work = scratch.get(HW_PICK(lp_windows_workspace)(win, set));
        HW_PICK(lp_windows)(win, set, work);
        scratch.trim();
    }
    return nb::make_tuple(filtered, smoothed, s, low, high, both, seconds);
}

}  // namespace

void bind_lp(nb::module_& mod) {
    mod.def("lp_solve", &lp_solve, "E"_a.none(), "A"_a, "C"_a, "G"_a.none(), "bx"_a, "by"_a, "seen"_a, "lo"_a.none(),
            "hi"_a.none(), "x0_lo"_a.none(), "x0_hi"_a.none(), "theta_lo"_a.none(), "theta_hi"_a.none(), "group"_a, "h"_a,
            "c"_a, "floor"_a, "cap"_a, "slack"_a.none(), "point"_a = 1, "tol"_a = 1e-9, "central_gap"_a = 0.3,
            "max_iter"_a = 100, "multipliers"_a = false, "start"_a.none() = nb::none(), "drop"_a = 0, "keep"_a = false,
            "Solve the linear program of bounded noise: (x, theta, s, multipliers, slack, info); see core/lp_types.hpp."
            " An optimal point may begin at `start`, what info['start'] of a problem that began `drop` rows earlier was"
            " with `keep`.");
    mod.def("lp_windows", &lp_windows, "E"_a.none(), "A"_a, "C"_a, "bx"_a, "by"_a, "seen"_a, "lo"_a.none(), "hi"_a.none(),
            "x0_lo"_a.none(), "x0_hi"_a.none(), "group"_a, "h"_a, "c"_a, "floor"_a, "cap"_a, "early"_a, "start"_a, "last"_a, "memory"_a,
            "carry"_a = 0.0, "point"_a = 1, "tol"_a = 1e-9, "central_gap"_a = 0.3, "max_iter"_a = 100, "warm"_a = true,
            "Solve the window start[t]..t for every row t: (filtered, smoothed, s, low, high, (status, iterations),"
            " seconds), optimal points each from the one before if `warm`; see core/lp_types.hpp.");
}
