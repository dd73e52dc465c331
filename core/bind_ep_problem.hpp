// A problem of expectation propagation as Python gives it, and what its bindings share.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <cstring>
#include <new>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "bind_array.hpp"
#include "ep_entry.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using In = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using InInt = nb::ndarray<const std::int32_t, nb::c_contig, nb::device::cpu>;
using InByte = nb::ndarray<const std::int8_t, nb::c_contig, nb::device::cpu>;
using InBool = nb::ndarray<const bool, nb::c_contig, nb::device::cpu>;

void want(bool ok, const char* what) {
    if (!ok) throw std::invalid_argument(what);
}

struct Work {
    explicit Work(std::size_t size)
        : p(static_cast<double*>(::operator new((size + hw::ep_abreast) * sizeof(double), std::align_val_t(64)))) {}
    ~Work() { ::operator delete(p, std::align_val_t(64)); }
    Work(const Work&) = delete;
    Work& operator=(const Work&) = delete;
    double* p;
};

// The arrays of a chain, kept alive with it. `of_window` are those that change from window to window.
class Problem {
  public:
    hw::EpArgs a{};

    Problem(const nb::dict& given, std::size_t members) : given_(given) {
        const In R = array("R");
        const InInt group_w = typed<InInt>("group_w"), start = typed<InInt>("start"), group = typed<InInt>("group");
        const InByte kind = typed<InByte>("kind");
        const std::size_t n = group_w.size(), rows = kind.size();
        want(start.size() >= 2 && n >= 1 && n <= std::size_t(hw::ep_states), "start (T+2,), group_w (n,), n <= 16");
        const std::size_t T = start.size() - 2;
        a.T = static_cast<int>(T);
        a.n = static_cast<int>(n);
        a.rows = static_cast<int>(rows);
        a.groups = nb::cast<int>(given["groups"]);
        a.members = static_cast<int>(members);
        if (T) {
            a.A = stack("A", 3, n * n, T);
            want(a.A.data, "A is missing");
            a.G = stack("G", 3, n * n, T);
            a.Q = stack("Q", 3, n * n, T);
        }
        a.group_w = group_w.data();
        for (std::size_t i = 0; i < n; i++) want(a.group_w[i] < a.groups, "group_w out of range");
        if (has("group_Q")) {
            const InInt of = typed<InInt>("group_Q");
            want(of.size() == n, "group_Q (n,)");
            a.group_Q = of.data();
            for (std::size_t i = 0; i < n; i++) want(a.group_Q[i] < a.groups, "group_Q out of range");
        }
        if (has("group_R")) {
            const InInt of = typed<InInt>("group_R");
            want(of.size() == rows, "group_R (rows,)");
            a.group_R = of.data();
            for (std::size_t k = 0; k < rows; k++) want(a.group_R[k] < a.groups, "group_R out of range");
        }
        a.start = start.data();
        want(a.start[0] == 0 && a.start[T + 1] == static_cast<int>(rows), "start runs from 0 to the number of rows");
        for (std::size_t t = 0; t <= T; t++) want(a.start[t] <= a.start[t + 1], "start must not fall");
        const In lo = array("lo"), hi = array("hi");
        want(group.size() == rows && R.size() == rows && lo.size() == rows && hi.size() == rows, "one entry a row");
        if (rows) {
            a.h = stack("h", 2, rows * n, 1);
            want(a.h.data, "h is missing");
        }
        a.kind = kind.data();
        a.group = group.data();
        a.R = R.data();
        a.lo = lo.data();
        a.hi = hi.data();
        if (has("lost")) {
            const In lost = array("lost");
            want(lost.size() == rows, "lost (rows,)");
            a.lost = lost.data();
        }
        if (has("mix")) {
            const In mix = array("mix");
            want(mix.size() == rows * a.groups, "mix (rows,groups)");
            a.mix = mix.data();
        }
        for (std::size_t k = 0; k < rows; k++) {
            const int what = a.kind[k];
            want(what >= 0 && what <= hw::ep_truncation && a.group[k] < a.groups, "row out of range");
            want(what != hw::noise_maybe_lost || a.lost, "lost is missing");
            want(a.group[k] >= 0 || what == hw::noise_gaussian || what == hw::noise_maybe_lost || what == hw::ep_truncation,
                 "a row needs a half-width");
            want(what != hw::noise_gaussian || a.R[k] > 0 || (a.group_R && a.group_R[k] >= 0), "a Gaussian row needs a variance");
        }
        a.wide = nb::cast<double>(given["wide"]);
    }

    // the same with the data of the dictionary
    static Problem whole(const nb::dict& given, std::size_t members) {
        Problem p(given, members);
        const In m0 = p.array("m0"), P0 = p.array("P0"), half0 = p.array("half0");
        p.of_window(p.a, m0, P0, half0);
        if (p.a.T) p.a.b = p.stack("b", 2, std::size_t(p.a.n) * p.a.T, 1);
        if (p.a.rows) p.a.y = p.stack("y", 1, p.a.rows, 1);
        want((p.a.b.data || !p.a.T) && (p.a.y.data || !p.a.rows), "b, y are missing");
        return p;
    }

    static void of_window(hw::EpArgs& a, const In& m0, const In& P0, const In& half0) {
        const std::size_t n = a.n;
        want(m0.size() == n && P0.size() == n * n && half0.size() == n, "m0, half0 (n,), P0 (n,n)");
        a.m0 = m0.data();
        a.P0 = P0.data();
        a.half0 = half0.data();
    }
    static void of_window(hw::EpArgs& a, const In& m0, const In& P0, const In& half0, const In& b, const In& y) {
        of_window(a, m0, P0, half0);
        want(b.size() == std::size_t(a.T) * a.n && y.size() == std::size_t(a.rows), "b (T,n), y (rows,)");
        a.b = {b.data(), nullptr, 1, 0};
        a.y = {y.data(), nullptr, 1, 0};
    }

    // the sites: given ones are copied
    nb::tuple sites(const std::optional<nb::tuple>& from, std::size_t members) {
        const std::size_t stages = a.T + 1, n = a.n, rows = a.rows;
        const std::size_t sizes[4] = {members * stages * n, members * stages * n, members * rows, members * rows};
        const double* p[4] = {};
        a.warm = from.has_value();
        if (from) {
            want(from->size() == 4, "sites: (m, D, tau, nu)");
            for (std::size_t k = 0; k < 4; k++) {
                reals_.push_back(nb::cast<In>((*from)[k]));
                want(reals_.back().size() == sizes[k], "sites: (m, D, tau, nu)");
                p[k] = reals_.back().data();
            }
        }
        return nb::make_tuple(fresh({members, stages, n}, &a.m, p[0]), fresh({members, stages, n}, &a.D, p[1]),
                              fresh({members, rows}, &a.tau, p[2]), fresh({members, rows}, &a.nu, p[3]));
    }

  private:
    bool has(const char* name) const { return given_.contains(name) && !given_[name].is_none(); }
    In array(const char* name) {
        reals_.push_back(nb::cast<In>(given_[name]));
        return reals_.back();
    }
    template <class Kind>
    Kind typed(const char* name) {
        Kind k = nb::cast<Kind>(given_[name]);
        others_.push_back(nb::cast(k));
        return k;
    }
    // (count, ...) shared by all members, or with one dimension more: (members, count, ...)
    hw::EpStack stack(const char* name, std::size_t ndim, std::size_t size, std::size_t rows) {
        hw::EpStack s{};
        if (!has(name)) return s;
        const std::size_t members = a.members;
        const In given = array(name);
        s.data = given.data();
        want(given.ndim() == ndim || (given.ndim() == ndim + 1 && given.shape(0) == members), name);
        std::size_t total = given.size();
        if (given.ndim() == ndim + 1) {
            total /= members;
            s.member = static_cast<std::ptrdiff_t>(total);
        }
        want(size > 0 && total % size == 0, name);
        s.count = static_cast<int>(total / size);
        const std::string index_name = std::string(name) + "_index";
        if (has(index_name.c_str())) {
            const InInt index = typed<InInt>(index_name.c_str());
            want(index.size() == rows, name);
            s.index = index.data();
            for (std::size_t k = 0; k < rows; k++) want(s.index[k] >= 0 && s.index[k] < s.count, name);
        } else {
            want(s.count == 1 || static_cast<std::size_t>(s.count) == rows, name);
        }
        return s;
    }

    nb::dict given_;
    std::vector<In> reals_;
    std::vector<nb::object> others_;
};

}  // namespace
