// Python's door to core/box.cpp: copies what the kernel works on, releases the GIL, holds no logic.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cstring>
#include <memory>

#include "bind_box.hpp"
#include "box_entry.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Array = hw::BoxArray;
using Maybe = hw::MaybeArray;
using hw::need;

nb::object copied(const Array& from, double** data) {
    const std::size_t count = from.size();
    double* p = new double[count > 0 ? count : 1];
    std::memcpy(p, from.data(), count * sizeof(double));
    nb::capsule owner(p, [](void* q) noexcept { delete[] static_cast<double*>(q); });
    *data = p;
    return nb::cast(nb::ndarray<nb::numpy, double>(p, {from.shape(0), from.shape(1)}, owner));
}

nb::tuple box_contract(Maybe E, Array A, Array C, Array bx_lo, Array bx_hi, Array by_lo, Array by_hi, Array lo, Array hi,
                       int sweeps, Maybe E_hi, Maybe A_hi, Maybe C_hi) {
    need(bx_lo.ndim() == 2 && by_lo.ndim() == 2 && lo.ndim() == 2, "bx (T,n), by (T,m), lo (T+1,n) expected");
    const std::size_t T = bx_lo.shape(0), n = bx_lo.shape(1), m = by_lo.shape(1);
    need(n >= 1 && by_lo.shape(0) == T && lo.shape(0) == T + 1 && lo.shape(1) == n, "bx (T,n), by (T,m), lo (T+1,n) expected");
    need(bx_hi.size() == T * n && by_hi.size() == T * m && hi.ndim() == 2 && hi.size() == lo.size(), "ends come in pairs");
    hw::BoxChain b{};
    b.T = static_cast<int>(T);
    b.n = static_cast<int>(n);
    b.m = static_cast<int>(m);
    if (E) hw::box_matrix(*E, E_hi, T, n, n, b.E_lo, b.E_hi, b.E_t);
    need(E || !E_hi, "both ends of a matrix have one shape");
    hw::box_matrix(A, A_hi, T, n, n, b.A_lo, b.A_hi, b.A_t);
    hw::box_matrix(C, C_hi, T, m, n, b.C_lo, b.C_hi, b.C_t);
    b.bx_lo = bx_lo.data();
    b.bx_hi = bx_hi.data();
    b.by_lo = by_lo.data();
    b.by_hi = by_hi.data();
    b.sweeps = sweeps;
    nb::object out_lo = copied(lo, &b.lo), out_hi = copied(hi, &b.hi);
    std::unique_ptr<double[]> work(new double[HW_PICK(box_workspace)(b.n)]);
    b.work = work.get();
    std::ptrdiff_t code;
    {
        nb::gil_scoped_release release;
        code = HW_PICK(box_chain)(b);
    }
    return nb::make_tuple(out_lo, out_hi, code);
}

}  // namespace

void bind_box(nb::module_& mod) {
    mod.def("box_contract", &box_contract, "E"_a.none(), "A"_a, "C"_a, "bx_lo"_a, "bx_hi"_a, "by_lo"_a, "by_hi"_a, "lo"_a,
            "hi"_a, "sweeps"_a = 10, "E_hi"_a.none() = nb::none(), "A_hi"_a.none() = nb::none(), "C_hi"_a.none() = nb::none(),
            "Contract the boxes lo, hi (T+1,n) of a chain by its rows, rigorously: (lo, hi, code); sweeps = 0 goes forwards"
            " only; E, A, C are the lower ends of interval matrices if X_hi is given; code > 0 is 1 + t (n+m) + i of the row"
            " that leaves nothing. See core/box.hpp.");
}
