// Python's door to core/constrain.cpp: copies what the kernel works on, releases the GIL, holds no logic.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstring>
#include <memory>
#include <stdexcept>

#include "bind_array.hpp"
#include "constrain_entry.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Array = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;

nb::tuple constrain_run(int by, Array x, Array P, Array D, Array lo, Array hi) {
    if (x.ndim() != 2 || P.ndim() != 3 || D.ndim() != 2 || by < 0 || by > hw::constrain_by_nearest)
        throw std::invalid_argument("x (T,n), P (T,n,n), D (m,n), lo, hi (m,) expected");
    const std::size_t T = x.shape(0), n = x.shape(1), m = D.shape(0);
    if (P.shape(0) != T || P.shape(1) != n || P.shape(2) != n || D.shape(1) != n || lo.size() != m || hi.size() != m)
        throw std::invalid_argument("x (T,n), P (T,n,n), D (m,n), lo, hi (m,) expected");
    hw::ConstrainArgs a{};
    a.T = static_cast<long>(T);
    a.n = static_cast<int>(n);
    a.m = static_cast<int>(m);
    a.by = by;
    a.D = D.data();
    a.lo = lo.data();
    a.hi = hi.data();
    nb::object mean = fresh({T, n}, &a.x, x.data()), cov = fresh({T, n, n}, &a.P, P.data());
    nb::object distance = fresh({T}, &a.distance), code = fresh({T}, &a.code), row = fresh({T}, &a.row);
    long ints = 0;
    const long doubles = HW_PICK(constrain_workspace)(a.n, a.m, &ints);
    std::unique_ptr<double[]> work(new double[doubles > 0 ? doubles : 1]);
    std::unique_ptr<int[]> iwork(new int[ints > 0 ? ints : 1]);
    {
        nb::gil_scoped_release release;
        HW_PICK(constrain_run)(a, work.get(), iwork.get());
    }
    return nb::make_tuple(mean, cov, distance, code, row);
}

}  // namespace

void bind_constrain(nb::module_& mod) {
    mod.def("constrain_run", &constrain_run, "by"_a, "x"_a, "P"_a, "D"_a, "lo"_a, "hi"_a,
            "Hold beliefs N(x, P) inside lo <= D x <= hi: (x, P, distance, code, row); see core/constrain_entry.hpp.");
}
