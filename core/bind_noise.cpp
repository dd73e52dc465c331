// Python's door to core/noise.cpp: one array a number, shapes equal, no logic.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>

#include <initializer_list>
#include <stdexcept>
#include <string>

#include "noise_entry.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

nb::object vector(std::size_t size, double** p) {
    *p = new double[size ? size : 1]();
    nb::capsule owner(*p, [](void* q) noexcept { delete[] static_cast<double*>(q); });
    return nb::cast(nb::ndarray<nb::numpy, double>(*p, {size}, owner));
}

std::size_t same(std::initializer_list<std::size_t> sizes) {
    for (std::size_t s : sizes)
        if (s != *sizes.begin()) throw std::invalid_argument("vectors of one length were expected");
    return *sizes.begin();
}

nb::tuple truncated(Vector mu, Vector c, Vector lo, Vector hi) {
    hw::TruncatedArgs a{};
    a.size = same({mu.shape(0), c.shape(0), lo.shape(0), hi.shape(0)});
    a.mu = mu.data();
    a.c = c.data();
    a.lo = lo.data();
    a.hi = hi.data();
    nb::object log_z = vector(a.size, &a.log_z), mean = vector(a.size, &a.mean), var = vector(a.size, &a.var);
    nb::object at_lo = vector(a.size, &a.at_lo), at_hi = vector(a.size, &a.at_hi);
    nb::object log_mean = vector(a.size, &a.log_mean);
    {
        nb::gil_scoped_release release;
        HW_PICK_WIDE(noise_truncated)(a);
    }
    return nb::make_tuple(log_z, mean, var, at_lo, at_hi, log_mean);
}

nb::tuple tilted(const std::string& kind, Vector mu, Vector c, Vector s, Vector R, Vector eps, Vector extra) {
    static const char* const names[] = {"gaussian", "uniform", "uniform_gaussian", "contaminated", "maybe_lost"};
    hw::TiltedArgs a{};
    a.kind = -1;
    for (int k = 0; k < hw::noise_kinds; k++)
        if (kind == names[k]) a.kind = k;
    if (a.kind < 0) throw std::invalid_argument("no such noise: " + kind);
    a.size = same({mu.shape(0), c.shape(0), s.shape(0), R.shape(0), eps.shape(0), extra.shape(0)});
    a.mu = mu.data();
    a.c = c.data();
    a.s = s.data();
    a.R = R.data();
    a.eps = eps.data();
    a.extra = extra.data();
    nb::object log_z = vector(a.size, &a.log_z), mean = vector(a.size, &a.mean), var = vector(a.size, &a.var);
    nb::object slope_s = vector(a.size, &a.slope_s), slope_R = vector(a.size, &a.slope_R);
    nb::object slope_eps = vector(a.size, &a.slope_eps), out = vector(a.size, &a.out);
    {
        nb::gil_scoped_release release;
        HW_PICK_WIDE(noise_tilted)(a);
    }
    return nb::make_tuple(log_z, mean, var, slope_s, slope_R, slope_eps, out);
}

}  // namespace

void bind_noise(nb::module_& m) {
    m.def("wide", &hw::wide, "Whether kernels that run members abreast run them with AVX-512, eight to a register.");
    m.def("use_wide", &hw::use_wide, "wanted"_a, "Run them so or not; False if this machine cannot. For tests.");
    m.def("noise_truncated", &truncated, "mu"_a, "c"_a, "lo"_a, "hi"_a,
          "N(mu, c) cut to [lo, hi], entry by entry: (log Z, mean, variance, tilted density at lo and at hi, log of the "
          "mean density in the box). Ends may be infinite, c may be 0; see core/noise.hpp.");
    m.def("noise_tilted", &tilted, "kind"_a, "mu"_a, "c"_a, "s"_a, "R"_a, "eps"_a, "extra"_a,
          "A residual N(mu, c) under a noise: (log Z, mean, variance, d log Z / d log s, d log R, d logit eps, probability "
          "that the row is an outlier or lost); see core/noise_entry.hpp for the kinds.");
}
