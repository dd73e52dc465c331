// Python names of the tape kernels: tape_operations, tape_evaluate, tape_jacobian.
#include "bind_tape.hpp"

#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <string>
#include <utility>

#include "tape_kernels.hpp"

using namespace hw;

void bind_tape(nb::module_& m) {
    m.def("tape_operations", [] {
        std::vector<std::pair<std::string, int>> names;
#define HW_X(name, arity) names.emplace_back(#name, arity);
        HW_TAPE_OPERATIONS(HW_X)
#undef HW_X
        return names;
    }, "Names and numbers of arguments of the operations of a tape, in the order of their codes.");

    m.def("tape_evaluate", [](CodeArray code, VectorIn constant, SlotArray out, MatrixIn points) {
        const int n_in = (int)points.shape(1);
        OwnedTape owned = own_tape(code, constant, out, n_in, 0);
        auto answer = fresh<double>({points.shape(0), out.shape(0)});
        std::vector<double> work((size_t)(n_in + owned.tape.n) * tape_lanes);
        {
            nb::gil_scoped_release free;
            HW_PICK(tape_evaluate)(owned.tape, (long)points.shape(0), points.data(), answer.data(), work.data());
        }
        return answer;
    }, nb::arg("code"), nb::arg("constant"), nb::arg("out"), nb::arg("points"),
       "Values (N, n_out) of a tape at points (N, n_in).");

    m.def("tape_jacobian", [](CodeArray code, VectorIn constant, SlotArray out, MatrixIn points, int n_d) {
        const int n_in = (int)points.shape(1);
        if (n_d < 0 || n_d > n_in) throw nb::value_error("tape_jacobian: n_d must be 0...n_in");
        OwnedTape owned = own_tape(code, constant, out, n_in, n_d);
        auto answer = fresh<double>({points.shape(0), out.shape(0)});
        auto slope = fresh<double>({points.shape(0), out.shape(0), (size_t)n_d});
        std::vector<double> work((size_t)owned.tape.n * (1 + n_d));
        {
            nb::gil_scoped_release free;
            HW_PICK(tape_differentiate)(owned.tape, n_d, (long)points.shape(0), points.data(), answer.data(), slope.data(),
                                        work.data());
        }
        return nb::make_tuple(answer, slope);
    }, nb::arg("code"), nb::arg("constant"), nb::arg("out"), nb::arg("points"), nb::arg("n_d"),
       "Values (N, n_out) and Jacobians (N, n_out, n_d) along the first n_d inputs of a tape at points (N, n_in).");
}
