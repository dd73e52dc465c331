// Python's door to core/chain.cpp: copies what the kernel works on, releases the GIL, holds no logic.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstring>
#include <memory>
#include <stdexcept>

#include "bind_array.hpp"
#include "chain_entry.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Array = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;

nb::tuple chain_solve(Array M, Array O, Array B, Array K, Array f, Array k, bool inverse, double drop) {
    if (M.ndim() != 3 || B.ndim() != 3 || f.ndim() != 2 || M.shape(0) < 1)
        throw std::invalid_argument("M, O (T,n,n), B (T,q,n), K (q,q), f (T,n), k (q) expected");
    const std::size_t T = M.shape(0), n = M.shape(1), q = B.shape(1);
    if (M.shape(2) != n || O.size() != M.size() || B.shape(0) != T || B.shape(2) != n || K.size() != q * q ||
        f.size() != T * n || k.size() != q)
        throw std::invalid_argument("M, O (T,n,n), B (T,q,n), K (q,q), f (T,n), k (q) expected");
    hw::ChainArgs a{};
    a.T = static_cast<int>(T);
    a.n = static_cast<int>(n);
    a.q = static_cast<int>(q);
    a.drop = drop;
    nb::object m = fresh({T, n, n}, &a.M, M.data()), o = fresh({T, n, n}, &a.O, O.data());
    nb::object b = fresh({T, q, n}, &a.B, B.data()), corner = fresh({q, q}, &a.K, K.data());
    nb::object g = fresh({T, n}, &a.f, f.data()), z = fresh({q}, &a.z, k.data()), x = fresh({T, n}, &a.x);
    nb::object S = nb::none(), C = nb::none(), H = nb::none();
    if (inverse) {
        S = fresh({T, n, n}, &a.S);
        C = fresh({T, n, n}, &a.C);
        H = fresh({T, n, q}, &a.H);
    }
    std::unique_ptr<double[]> work(new double[HW_PICK(chain_workspace)(a.T, a.n, a.q)]);
    a.work = work.get();
    int code;
    {
        nb::gil_scoped_release release;
        code = HW_PICK(chain_run)(a);
    }
    return nb::make_tuple(x, z, S, C, H, corner, code);
}

}  // namespace

void bind_chain(nb::module_& mod) {
    mod.def("chain_solve", &chain_solve, "M"_a, "O"_a, "B"_a, "K"_a, "f"_a, "k"_a, "inverse"_a = false, "drop"_a = 1e-15,
            "Solve a bordered block-tridiagonal system: (x, z, S, C, H, Ki, code); see core/chain_entry.hpp.");
}
