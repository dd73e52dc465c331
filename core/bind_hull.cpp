// Python's door to core/hull.cpp: converts once, releases the GIL, holds no logic.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cstdlib>
#include <cstring>
#include <memory>
#include <new>
#include <optional>
#include <stdexcept>

#include "bind_array.hpp"
#include "hull_entry.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Array = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Maybe = std::optional<Array>;
using Index = nb::ndarray<const int, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// memory that outlives a call, so that a sliding window does not ask the system for pages at every step
struct Scratch {
    void* data = nullptr;
    std::size_t size = 0;
    void* get(std::size_t bytes) {
        if (bytes > size) {
            std::free(data);
            size = (bytes + 63) / 64 * 64;
            data = std::aligned_alloc(64, size);
            if (!data) {
                size = 0;
                throw std::bad_alloc();
            }
        }
        return data;
    }
    ~Scratch() { std::free(data); }
};
thread_local Scratch scratch;

void need(bool ok, const char* what) {
    if (!ok) throw std::invalid_argument(what);
}

// The rows of a record or window from the arrays that state them.
hw::HullWindow rows_of(const Maybe& E, const Array& A, const Array& C, const Array& bx_lo, const Array& bx_hi,
                       const Array& by_lo, const Array& by_hi, const Maybe& E_hi, const Maybe& A_hi, const Maybe& C_hi) {
    need(bx_lo.ndim() == 2 && by_lo.ndim() == 2, "bx (K,n), by (K,m) expected");
    const std::size_t K = bx_lo.shape(0), n = bx_lo.shape(1), m = by_lo.shape(1);
    need(n >= 1 && by_lo.shape(0) == K, "bx (K,n), by (K,m) expected");
    need(bx_hi.size() == K * n && by_hi.size() == K * m, "ends come in pairs");
    hw::HullWindow win{};
    win.K = static_cast<int>(K);
    win.n = static_cast<int>(n);
    win.m = static_cast<int>(m);
    auto matrix = [&](const Array& a, const Maybe& end, std::size_t rows, const double*& l, const double*& h, bool& moving) {
        moving = a.ndim() == 3;
        need(a.ndim() >= 2 && a.size() == (moving ? K : 1) * rows * n, "matrices (r,n) or (K,r,n) expected");
        need(!end || end->size() == a.size(), "both ends of a matrix have one shape");
        l = a.data();
        h = end ? end->data() : nullptr;
    };
    if (E) matrix(*E, E_hi, n, win.E_lo, win.E_hi, win.E_t);
    matrix(A, A_hi, n, win.A_lo, win.A_hi, win.A_t);
    matrix(C, C_hi, m, win.C_lo, win.C_hi, win.C_t);
    win.bx_lo = bx_lo.data();
    win.bx_hi = bx_hi.data();
    win.by_lo = by_lo.data();
    win.by_hi = by_hi.data();
    return win;
}

nb::tuple hull_window(Maybe E, Array A, Array C, Array bx_lo, Array bx_hi, Array by_lo, Array by_hi, Array lo, Array hi, Array c,
                      Index k, Maybe y, int sweeps, double tol, int max_iter, Maybe E_hi, Maybe A_hi, Maybe C_hi) {
    hw::HullTask task{};
    hw::HullWindow& win = task.win;
    win = rows_of(E, A, C, bx_lo, bx_hi, by_lo, by_hi, E_hi, A_hi, C_hi);
    const std::size_t K = win.K, n = win.n, m = win.m;
    need(c.ndim() == 2 && c.shape(1) == n && k.size() == c.shape(0), "c (costs,n), k (costs) expected");
    const std::size_t costs = c.shape(0);
    need(lo.ndim() == 2 && lo.shape(0) == K + 1 && lo.shape(1) == n && hi.size() == lo.size(), "lo, hi (K+1,n) expected");
    for (std::size_t p = 0; p < costs; p++) need(k.data()[p] >= 0 && k.data()[p] <= win.K, "k out of range");
    nb::object box_lo = fresh({K + 1, n}, &task.lo, lo.data()), box_hi = fresh({K + 1, n}, &task.hi, hi.data());
    win.lo = task.lo;
    win.hi = task.hi;
    task.sweeps = sweeps;
    task.costs = static_cast<int>(costs);
    task.c = c.data();
    task.k = k.data();
    task.given = y.has_value();
    need(!y || y->size() == costs * K * (n + m), "y (costs, K, n+m) expected");
    nb::object ys = fresh({costs, K, n + m}, &task.y, y ? y->data() : nullptr), bound = fresh({costs}, &task.bound);
    nb::object value = fresh({costs}, &task.value), gap = fresh({costs}, &task.gap);
    hw::HullSettings set;
    set.tol = tol;
    set.max_iter = max_iter;
    std::ptrdiff_t code;
    {
        nb::gil_scoped_release release;
        void* work = scratch.get(HW_PICK(hull_bytes)(win.K, win.n, win.m));
        code = HW_PICK(hull_run)(task, set, work);
    }
    return nb::make_tuple(bound, ys, value, gap, box_lo, box_hi, task.iterations, code);
}

using Boxes = nb::ndarray<double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

int hull_sweep(Maybe E, Array A, Array C, Array bx_lo, Array bx_hi, Array by_lo, Array by_hi, Boxes lo, Boxes hi, Index a,
               Index b, Index k, Boxes out_lo, Boxes out_hi, int from, double loose, double least, double tol, int max_iter,
               Maybe E_hi, Maybe A_hi, Maybe C_hi) {
    hw::HullSweep sweep{};
    sweep.whole = rows_of(E, A, C, bx_lo, bx_hi, by_lo, by_hi, E_hi, A_hi, C_hi);
    const std::size_t T = sweep.whole.K, n = sweep.whole.n, tasks = a.size();
    need(lo.shape(0) == T + 1 && lo.shape(1) == n && hi.size() == lo.size(), "lo, hi (T+1,n) expected");
    need(b.size() == tasks && k.size() == tasks && out_lo.size() == tasks * n && out_hi.size() == tasks * n,
         "a, b, k (tasks), out_lo, out_hi (tasks,n) expected");
    need(from >= 0, "from out of range");
    int longest = 0;
    for (std::size_t i = 0; i < tasks; i++) {
        const int first = a.data()[i], last = b.data()[i], at = k.data()[i];
        need(first >= 0 && last <= sweep.whole.K && first <= at && at <= last, "a <= k <= b out of range");
        longest = last - first > longest ? last - first : longest;
    }
    sweep.lo = lo.data();
    sweep.hi = hi.data();
    sweep.tasks = static_cast<int>(tasks);
    sweep.a = a.data();
    sweep.b = b.data();
    sweep.k = k.data();
    sweep.out_lo = out_lo.data();
    sweep.out_hi = out_hi.data();
    sweep.loose = loose;
    sweep.least = least;
    hw::HullSettings set;
    set.tol = tol;
    set.max_iter = max_iter;
    nb::gil_scoped_release release;
    void* work = scratch.get(HW_PICK(hull_sweep_bytes)(longest, sweep.whole.n, sweep.whole.m));
    return HW_PICK(hull_sweep)(sweep, from, set, longest, work);
}

}  // namespace

void bind_hull(nb::module_& mod) {
    mod.def("hull_window", &hull_window, "E"_a.none(), "A"_a, "C"_a, "bx_lo"_a, "bx_hi"_a, "by_lo"_a, "by_hi"_a, "lo"_a, "hi"_a,
            "c"_a, "k"_a, "y"_a.none() = nb::none(), "sweeps"_a = 1, "tol"_a = 1e-10, "max_iter"_a = 60,
            "E_hi"_a.none() = nb::none(), "A_hi"_a.none() = nb::none(), "C_hi"_a.none() = nb::none(),
            "Bound c'x_k over a window, proved whatever the multipliers y: (bound, y, value, gap, lo, hi, iterations, code);"
            " y None: they are solved for; code > 0: row 1 + t (n+m) + i proves the window empty. See core/hull_entry.hpp.");
    mod.def("hull_sweep", &hull_sweep, "E"_a.none(), "A"_a, "C"_a, "bx_lo"_a, "bx_hi"_a, "by_lo"_a, "by_hi"_a, "lo"_a, "hi"_a,
            "a"_a, "b"_a, "k"_a, "out_lo"_a, "out_hi"_a, "start"_a = 0, "loose"_a = 1e-7, "least"_a = 1e-13, "tol"_a = 1e-10,
            "max_iter"_a = 60, "E_hi"_a.none() = nb::none(), "A_hi"_a.none() = nb::none(), "C_hi"_a.none() = nb::none(),
            "Narrow lo, hi (T+1,n) in place by the windows a..b of a record, both sides of state k each, until one is empty,"
            " unbounded or loose; returns how many are done. See core/hull_entry.hpp.");
}
