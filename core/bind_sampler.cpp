// Python's door to core/sampler.cpp: copies what the kernel changes, releases the GIL, holds no logic.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstring>
#include <memory>
#include <new>
#include <stdexcept>

#include "sampler_entry.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Reals = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Whole = nb::ndarray<const long, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

nb::object filled(std::size_t rows, std::size_t columns, double** data) {
    *data = new double[rows * columns + 1]();
    nb::capsule owner(*data, [](void* q) noexcept { delete[] static_cast<double*>(q); });
    return nb::cast(nb::ndarray<nb::numpy, double>(*data, {rows, columns}, owner));
}

std::unique_ptr<double[]> copied(const Reals& from) {
    std::unique_ptr<double[]> to(new double[from.size() + 1]);
    if (from.size()) std::memcpy(to.get(), from.data(), from.size() * sizeof(double));
    return to;
}

void expect(bool fits) {
    if (!fits) throw std::invalid_argument("arrays of matching sizes were expected; see core/sampler_entry.hpp");
}

nb::tuple sampler_run(Whole start, Whole column, Reals value, Reals b, Whole place, Whole first, Whole state, Reals weight,
                      Whole count, Reals ends, Reals prior, double power, Reals box, Whole column_start, Whole column_at,
                      Whole column_place, Reals x0, Reals s0, Whole theta_start,
                      Whole theta_row, Whole theta_at, Reals theta_slope, Reals theta_ends, Reals theta, long n, long band,
                      long scatter, long warm, long draws, long thin, long whitened, long scale_every, std::uint64_t seed) {
    hw::SamplerArgs a{};
    a.K = static_cast<long>(b.size());
    a.N = static_cast<long>(x0.size());
    a.R = static_cast<long>(weight.size());
    a.p = static_cast<long>(count.size());
    a.n = n;
    a.T = n ? static_cast<long>(state.size()) / n : 0;
    a.n_theta = static_cast<long>(theta.size());
    const std::size_t p = count.size(), N = x0.size(), q = theta.size();
    expect(a.N > 0 && column_start.size() == N + 1 && column_at.size() == value.size() && column_place.size() == value.size());
    expect(start.size() == b.size() + 1 && column.size() == value.size() && place.size() == b.size() && first.size() == p + 1);
    expect(ends.size() == 3 * p && prior.size() == 2 * p && box.size() == 2 * N && theta_start.size() == q + 1);
    expect(s0.size() == p && theta_ends.size() == 2 * q && theta_row.size() == theta_at.size() && theta_slope.size() == theta_at.size());
    a.band = band;
    a.start = start.data(), a.column = column.data(), a.place = place.data(), a.first = first.data(), a.state = state.data();
    a.weight = weight.data(), a.count = count.data();
    a.floor = ends.data(), a.cap = a.floor + p, a.tiny = a.cap + p;
    a.prior_mean = prior.data(), a.prior_sd = a.prior_mean + p;
    a.power = power;
    a.lo = box.data(), a.hi = a.lo + N, a.x0 = x0.data(), a.s0 = s0.data();
    a.column_start = column_start.data(), a.column_at = column_at.data(), a.column_place = column_place.data();
    a.theta_start = theta_start.data(), a.theta_row = theta_row.data(), a.theta_at = theta_at.data();
    a.theta_slope = theta_slope.data();
    a.theta_lo = theta_ends.data(), a.theta_hi = a.theta_lo + q;
    a.scatter = scatter, a.warm = warm, a.draws = draws, a.thin = thin > 0 ? thin : 1, a.seed = seed;
    a.whitened = whitened, a.scale_every = scale_every > 0 ? scale_every : 1;
    const auto values = copied(value), offsets = copied(b), entries = copied(theta);
    a.value = values.get(), a.b = offsets.get(), a.theta = entries.get();
    const std::size_t rows = draws > 0 ? draws : 0;
    nb::object x = filled(rows, N, &a.out_x), s = filled(rows, p, &a.out_s), th = filled(rows, q, &a.out_theta);
    const std::size_t size = 3 * weight.size() + 3 * N + 2 * p + n + N * (band + 1) + 40;
    std::unique_ptr<double[]> work(new double[size + 4]);
    a.work = reinterpret_cast<double*>((reinterpret_cast<std::uintptr_t>(work.get()) + 31) & ~std::uintptr_t(31));
    int code;
    {
        nb::gil_scoped_release release;
        code = HW_PICK(sampler_run)(a);
    }
    return nb::make_tuple(x, s, th, code);
}

}  // namespace

void bind_sampler(nb::module_& m) {
    m.def("sampler_run", &sampler_run, "start"_a, "column"_a, "value"_a, "b"_a, "place"_a, "first"_a, "state"_a, "weight"_a,
          "count"_a, "ends"_a, "prior"_a, "power"_a, "box"_a, "column_start"_a, "column_at"_a, "column_place"_a, "x0"_a, "s0"_a, "theta_start"_a, "theta_row"_a, "theta_at"_a,
          "theta_slope"_a, "theta_ends"_a, "theta"_a, "n"_a, "band"_a, "scatter"_a, "warm"_a, "draws"_a, "thin"_a, "whitened"_a, "scale_every"_a, "seed"_a,
          "Draw one chain of trajectories, half-widths and unknown entries: (X, s, theta, code); see core/sampler_entry.hpp.");
}
