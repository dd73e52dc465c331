// Python's door to core/ep.cpp: gathers the arrays of a problem, releases the GIL, holds no logic.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cstring>
#include <initializer_list>
#include <new>
#include <optional>
#include <stdexcept>
#include <vector>

#include "ep_entry.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using In = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using InInt = nb::ndarray<const std::int32_t, nb::c_contig, nb::device::cpu>;
using InByte = nb::ndarray<const std::int8_t, nb::c_contig, nb::device::cpu>;

void want(bool ok, const char* what) {
    if (!ok) throw std::invalid_argument(what);
}

nb::object fresh(std::vector<std::size_t> shape, double** p, const double* from = nullptr) {
    std::size_t size = 1;
    for (std::size_t s : shape) size *= s;
    *p = new double[size ? size : 1]();
    if (from && size) std::memcpy(*p, from, size * sizeof(double));
    nb::capsule owner(*p, [](void* q) noexcept { delete[] static_cast<double*>(q); });
    return nb::cast(nb::ndarray<nb::numpy, double>(*p, shape.size(), shape.data(), owner));
}

struct Work {
    explicit Work(std::size_t size)
        : p(static_cast<double*>(::operator new((size + 4) * sizeof(double), std::align_val_t(32)))) {}
    ~Work() { ::operator delete(p, std::align_val_t(32)); }
    Work(const Work&) = delete;
    Work& operator=(const Work&) = delete;
    double* p;
};

// (count, ...) shared by all members, or with one dimension more: (members, count, ...)
hw::EpStack stack(const std::optional<In>& given, const std::optional<InInt>& index, std::size_t ndim, std::size_t size,
                  std::size_t rows, std::size_t members, const char* what) {
    hw::EpStack s{};
    if (!given) return s;
    s.data = given->data();
    want(given->ndim() == ndim || (given->ndim() == ndim + 1 && given->shape(0) == members), what);
    std::size_t total = given->size();
    if (given->ndim() == ndim + 1) {
        total /= members;
        s.member = static_cast<std::ptrdiff_t>(total);
    }
    want(size > 0 && total % size == 0, what);
    s.count = static_cast<int>(total / size);
    if (index) {
        want(index->size() == rows, what);
        s.index = index->data();
        for (std::size_t k = 0; k < rows; k++) want(s.index[k] >= 0 && s.index[k] < s.count, what);
    } else {
        want(s.count == 1 || static_cast<std::size_t>(s.count) == rows, what);
    }
    return s;
}

nb::dict run(In s, In b, In A, std::optional<InInt> A_index, std::optional<In> G, std::optional<InInt> G_index,
             std::optional<In> Q, std::optional<InInt> Q_index, In m0, In P0, In half0, InInt group_w, InInt start, In h,
             In y, InByte kind, InInt group, In R, In lo, In hi, std::optional<In> lost, std::optional<In> mix, In eps,
             double wide, int sweeps, double tol, double damping, std::optional<nb::tuple> sites) {
    hw::EpArgs a{};
    want(s.ndim() == 2, "s: (members, groups) was expected");
    const std::size_t members = s.shape(0), groups = s.shape(1), n = m0.size(), rows = kind.size();
    want(start.size() >= 2 && n >= 1 && members >= 1, "start: (T+2,) was expected");
    const std::size_t T = start.size() - 2;
    want(n <= static_cast<std::size_t>(hw::ep_states), "too many states");
    a.T = static_cast<int>(T);
    a.n = static_cast<int>(n);
    a.rows = static_cast<int>(rows);
    a.groups = static_cast<int>(groups);
    a.members = static_cast<int>(members);
    if (T) {
        a.A = stack(A, A_index, 3, n * n, T, members, "A: (1,n,n), (T,n,n), or (K,n,n) with an index");
        a.G = stack(G, G_index, 3, n * n, T, members, "G: as A");
        a.Q = stack(Q, Q_index, 3, n * n, T, members, "Q: as A");
        a.b = stack(b, {}, 2, n * T, 1, members, "b: (T,n) or (members,T,n)");
    }
    want(P0.size() == n * n && half0.size() == n && group_w.size() == n, "m0, half0, group_w (n,), P0 (n,n)");
    a.m0 = m0.data();
    a.P0 = P0.data();
    a.half0 = half0.data();
    a.group_w = group_w.data();
    for (std::size_t i = 0; i < n; i++) want(a.group_w[i] < static_cast<int>(groups), "group_w out of range");
    a.start = start.data();
    want(a.start[0] == 0 && a.start[T + 1] == static_cast<int>(rows), "start runs from 0 to the number of rows");
    for (std::size_t t = 0; t <= T; t++) want(a.start[t] <= a.start[t + 1], "start must not fall");
    want(group.size() == rows && R.size() == rows && lo.size() == rows && hi.size() == rows, "one entry a row");
    if (rows) {
        a.h = stack(h, {}, 2, rows * n, 1, members, "h: (rows,n) or (members,rows,n)");
        a.y = stack(y, {}, 1, rows, 1, members, "y: (rows,) or (members,rows)");
    }
    a.kind = kind.data();
    a.group = group.data();
    for (std::size_t k = 0; k < rows; k++) {
        want(a.kind[k] >= 0 && a.kind[k] <= hw::ep_truncation && a.group[k] < static_cast<int>(groups), "row out of range");
        want(a.kind[k] != hw::noise_maybe_lost || lost, "lost: (rows,) was expected");
        want(a.group[k] >= 0 || (a.kind[k] != hw::noise_uniform && a.kind[k] != hw::noise_uniform_gaussian &&
                                 a.kind[k] != hw::noise_contaminated), "a row needs a half-width");
        want(a.kind[k] != hw::noise_gaussian || R.data()[k] > 0, "a Gaussian row needs a variance");
    }
    a.R = R.data();
    a.lo = lo.data();
    a.hi = hi.data();
    want(!lost || lost->size() == rows, "lost: (rows,)");
    want(!mix || mix->size() == rows * groups, "mix: (rows,groups)");
    want(eps.size() == members, "eps: (members,)");
    a.lost = lost ? lost->data() : nullptr;
    a.mix = mix ? mix->data() : nullptr;
    a.eps = eps.data();
    a.s = s.data();
    a.wide = wide;
    a.sweeps = sweeps;
    a.tol = tol;
    a.damping = damping;
    a.warm = sites.has_value();
    const double* given[4] = {};
    const std::size_t sizes[4] = {members * (T + 1) * n, members * (T + 1) * n, members * rows, members * rows};
    std::vector<In> held;
    if (sites) {
        want(sites->size() == 4, "sites: (m, D, tau, nu)");
        for (std::size_t k = 0; k < 4; k++) {
            held.push_back(nb::cast<In>((*sites)[k]));
            want(held.back().size() == sizes[k], "sites: (m, D, tau, nu)");
            given[k] = held.back().data();
        }
    }
    nb::object m = fresh({members, T + 1, n}, &a.m, given[0]), D = fresh({members, T + 1, n}, &a.D, given[1]);
    nb::object tau = fresh({members, rows}, &a.tau, given[2]), nu = fresh({members, rows}, &a.nu, given[3]);
    nb::dict found;
    found["x"] = fresh({members, T + 1, n}, &a.x);
    found["P"] = fresh({members, T + 1, n, n}, &a.P);
    found["k3"] = fresh({members, T + 1, n}, &a.k3);
    found["k4"] = fresh({members, T + 1, n}, &a.k4);
    found["log_z"] = fresh({members}, &a.log_z);
    found["slope"] = fresh({members, groups + 1}, &a.slope);
    found["residual"] = fresh({members}, &a.residual);
    found["worst"] = fresh({members}, &a.worst);
    found["out"] = fresh({members, rows}, &a.out);
    std::vector<std::int32_t> used(members);
    a.used = used.data();
    {
        nb::gil_scoped_release release;
        Work work(HW_PICK(ep_workspace)(a));
        a.work = work.p;
        HW_PICK(ep_run)(a);
    }
    found["sites"] = nb::make_tuple(m, D, tau, nu);
    nb::list count;
    for (std::int32_t u : used) count.append(u);
    found["sweeps"] = count;
    return found;
}

}  // namespace

void bind_ep(nb::module_& mod) {
    mod.def("ep_run", &run, "s"_a, "b"_a, "A"_a, "A_index"_a.none(), "G"_a.none(), "G_index"_a.none(), "Q"_a.none(),
            "Q_index"_a.none(), "m0"_a, "P0"_a, "half0"_a, "group_w"_a, "start"_a, "h"_a, "y"_a, "kind"_a, "group"_a, "R"_a,
            "lo"_a, "hi"_a, "lost"_a.none(), "mix"_a.none(), "eps"_a, "wide"_a, "sweeps"_a, "tol"_a, "damping"_a,
            "sites"_a.none(), "Expectation propagation on a chain; see core/ep_entry.hpp.");
}
