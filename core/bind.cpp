// The one extension module: converts once, releases the GIL, holds no logic.
#include <nanobind/nanobind.h>

#include "isa.hpp"

namespace nb = nanobind;

void bind_kalman(nb::module_& m);
void bind_drive(nb::module_& m);
void bind_tape(nb::module_& m);
void bind_nonlinear(nb::module_& m);
void bind_loss(nb::module_& m);
void bind_lp(nb::module_& m);
void bind_chain(nb::module_& m);
void bind_enclose(nb::module_& m);
void bind_sets(nb::module_& m);
void bind_box(nb::module_& m);
void bind_hull(nb::module_& m);
void bind_constrain(nb::module_& m);
void bind_noise(nb::module_& m);
void bind_ep(nb::module_& m);
void bind_ep_learn(nb::module_& m);
void bind_window(nb::module_& m);
void bind_sampler(nb::module_& m);
void bind_mixed(nb::module_& m);

NB_MODULE(_core, m) {
    m.doc() = "Kernels of halfwidth: arrays in, arrays out, the papers' symbols.";
    m.def("isa", [] { return hw::isa() == hw::Isa::avx2 ? "avx2" : "base"; },
          "The instruction set the kernels run with: \"avx2\" or \"base\".");
    m.def("use_isa", [](bool avx2) { return hw::use_isa(avx2 ? hw::Isa::avx2 : hw::Isa::base); }, nb::arg("avx2"),
          "Run the kernels with AVX2 or without; False if this machine cannot. For tests.");
    bind_kalman(m);
    bind_drive(m);
    bind_tape(m);
    bind_nonlinear(m);
    bind_loss(m);
    bind_lp(m);
    bind_chain(m);
    bind_enclose(m);
    bind_sets(m);
    bind_box(m);
    bind_hull(m);
    bind_constrain(m);
    bind_noise(m);
    bind_ep(m);
    bind_ep_learn(m);
    bind_window(m);
    bind_sampler(m);
    bind_mixed(m);
}
