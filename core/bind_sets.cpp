// Python's door to core/sets.cpp: copies what the kernel works on, releases the GIL, holds no logic.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <cstring>
#include <memory>
#include <string>

#include "bind_array.hpp"
#include "bind_box.hpp"
#include "sets_entry.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Array = hw::BoxArray;
using Maybe = hw::MaybeArray;
using hw::need;

hw::SetSizes sizes(const std::string& kind, std::size_t n, std::size_t m, int generators, int constraints, int rounds = 0) {
    hw::SetSizes z{};
    if (kind == "interval") z.kind = hw::SetKind::interval;
    else if (kind == "zonotope") z.kind = hw::SetKind::zonotope;
    else if (kind == "constrained") z.kind = hw::SetKind::constrained;
    else if (kind == "ellipsoid") z.kind = hw::SetKind::ellipsoid;
    else throw std::invalid_argument("kind is interval, zonotope, constrained or ellipsoid");
    need(n >= 1 && n <= 4096 && m <= 4096, "between 1 and 4096 states and at most as many outputs");
    const bool counted = z.kind == hw::SetKind::zonotope || z.kind == hw::SetKind::constrained;
    need(!counted || (generators >= static_cast<int>(n) && generators <= 100000), "generators: n at least");
    need(constraints >= 0 && constraints <= 100000, "constraints: not below 0");
    z.n = static_cast<int>(n);
    z.m = static_cast<int>(m);
    z.generators = generators;
    need(rounds >= 0, "rounds: not below 0");
    z.constraints = constraints;
    z.rounds = rounds;
    return z;
}

nb::object set_start(const std::string& kind, int n, int m, int generators, int constraints) {
    double* state;
    nb::object out = fresh({HW_PICK(set_state)(sizes(kind, n, m, generators, constraints))}, &state);
    state[1] = -1.0;  // no shape yet: it begins when its box is bounded
    return out;
}

nb::tuple set_run(const std::string& kind, Maybe E, Array A, Array C, Array bx_lo, Array bx_hi, Array by_lo, Array by_hi,
                  Array lo, Array hi, Array x, Array state, int generators, int constraints, int rounds, Maybe bounds_lo,
                  Maybe bounds_hi, Maybe E_hi, Maybe A_hi, Maybe C_hi) {
    need(bx_lo.ndim() == 2 && by_lo.ndim() == 2 && lo.ndim() == 1, "bx (T,n), by (T,m), lo (n,) expected");
    const std::size_t T = bx_lo.shape(0), n = bx_lo.shape(1), m = by_lo.shape(1);
    hw::SetRun r{};
    r.size = sizes(kind, n, m, generators, constraints, rounds);
    need(by_lo.shape(0) == T && lo.shape(0) == n && hi.size() == n && x.size() == n, "bx (T,n), by (T,m), lo (n,) expected");
    need(bx_hi.size() == T * n && by_hi.size() == T * m, "ends come in pairs");
    need(!bounds_lo == !bounds_hi && (!bounds_lo || (bounds_lo->size() == n && bounds_hi->size() == n)), "bounds (n,) in pairs");
    need(state.size() == HW_PICK(set_state)(r.size), "the state is of other sizes");
    const double most[2] = {double(generators), double(constraints)};
    const bool counted = r.size.kind == hw::SetKind::zonotope || r.size.kind == hw::SetKind::constrained;
    for (int k = 0; k < 2 && counted && !(state.data()[1] < 0.0); k++)  // a state may come from a snapshot
        need(state.data()[k] >= 0.0 && state.data()[k] <= most[k], "the state holds more than its sizes allow");
    hw::BoxChain& b = r.box;
    b.T = static_cast<int>(T);
    b.n = r.size.n;
    b.m = r.size.m;
    if (E) hw::box_matrix(*E, E_hi, T, n, n, b.E_lo, b.E_hi, b.E_t);
    need(E || !E_hi, "both ends of a matrix have one shape");
    hw::box_matrix(A, A_hi, T, n, n, b.A_lo, b.A_hi, b.A_t);
    hw::box_matrix(C, C_hi, T, m, n, b.C_lo, b.C_hi, b.C_t);
    b.bx_lo = bx_lo.data();
    b.bx_hi = bx_hi.data();
    b.by_lo = by_lo.data();
    b.by_hi = by_hi.data();
    nb::object out_lo = fresh({T + 1, n}, &b.lo), out_hi = fresh({T + 1, n}, &b.hi), out_x = fresh({T + 1, n}, &r.x);
    nb::object out_state = fresh({state.size()}, &r.state);
    for (std::size_t j = 0; j < n; j++) {
        b.lo[j] = lo.data()[j];
        b.hi[j] = hi.data()[j];
        r.x[j] = x.data()[j];
        for (std::size_t t = 1; t <= T; t++) {
            b.lo[t * n + j] = bounds_lo ? bounds_lo->data()[j] : -__builtin_inf();
            b.hi[t * n + j] = bounds_hi ? bounds_hi->data()[j] : __builtin_inf();
        }
    }
    std::memcpy(r.state, state.data(), state.size() * sizeof(double));
    std::unique_ptr<double[]> work(new double[HW_PICK(set_workspace)(r.size)]());
    r.work = work.get();
    std::ptrdiff_t code;
    {
        nb::gil_scoped_release release;
        code = HW_PICK(set_run)(r);
    }
    return nb::make_tuple(out_lo, out_hi, out_x, out_state, code);
}

}  // namespace

void bind_sets(nb::module_& mod) {
    mod.def("sets_start", &set_start, "kind"_a, "n"_a, "m"_a, "generators"_a = 0, "constraints"_a = 0,
            "The state of a recursion before its first row.");
    mod.def("sets_run", &set_run, "kind"_a, "E"_a.none(), "A"_a, "C"_a, "bx_lo"_a, "bx_hi"_a, "by_lo"_a, "by_hi"_a, "lo"_a,
            "hi"_a, "x"_a, "state"_a, "generators"_a = 0, "constraints"_a = 0, "rounds"_a = 0,
            "bounds_lo"_a.none() = nb::none(), "bounds_hi"_a.none() = nb::none(), "E_hi"_a.none() = nb::none(), "A_hi"_a.none() = nb::none(),
            "C_hi"_a.none() = nb::none(),
            "Run the rows E x_t - A x_{t-1} in [bx], C x_t in [by] from the box lo, hi (n,): (lo, hi, x (T+1,n), state, code); code"
            " > 0 is 1 + t (n+m) + i of the first row that contradicts. E, A, C are lower ends if X_hi is given. See core/sets.hpp.");
}
