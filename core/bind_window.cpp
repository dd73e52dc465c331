// Python's door to core/window.hpp: converts once, holds no logic.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <stdexcept>
#include <vector>

#include "window.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using In = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Column = nb::ndarray<const double, nb::ndim<1>, nb::device::cpu>;
using InOut = nb::ndarray<double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

void want(bool ok, const char* what) {
    if (!ok) throw std::invalid_argument(what);
}

void forecast(InOut x, In A, const std::optional<In>& B, const std::optional<In>& u, const std::optional<In>& lo,
              const std::optional<In>& hi) {
    const std::size_t n = x.shape(1), nu = B && u ? u->size() : 0;
    want(A.size() == n * n && (nu == 0 || B->size() == n * nu) && lo.has_value() == hi.has_value() &&
             (!lo || (lo->size() == n && hi->size() == n)),
         "x (rows,n), A (n,n), B (n,nu), u (nu,), lo, hi (n,)");
    std::vector<double> work(2 * n);
    hw::window_forecast(x.shape(0), n, nu, x.data(), A.data(), nu ? B->data() : nullptr, nu ? u->data() : nullptr,
                        lo ? lo->data() : nullptr, hi ? hi->data() : nullptr, work.data());
}

nb::object ends(InOut x, In grown) {
    const std::size_t n = x.shape(1), shape[3] = {2, 1, n};
    want(grown.size() == n, "x (rows,n), grown (n,)");
    double* found = new double[2 * n];
    nb::capsule owner(found, [](void* p) noexcept { delete[] static_cast<double*>(p); });
    hw::window_ends(x.shape(0), n, x.data(), grown.data(), found, found + n);
    return nb::cast(nb::ndarray<nb::numpy, double>(found, 3, shape, owner));
}

void note(In x, InOut low, InOut high) {
    want(x.size() == low.size() && low.size() == high.size(), "x, low, high (rows,n)");
    hw::window_note(x.size(), x.data(), low.data(), high.data());
}

nb::object sizes(In effect, const std::vector<Column>& seen) {
    const std::size_t ny = seen.size(), nx = ny ? effect.size() / ny : 0;
    want(effect.ndim() == 2 && effect.size() == nx * ny && effect.shape(0) == ny, "effect (ny,nx), seen: ny arrays");
    const std::size_t shape[1] = {nx + ny};
    double* found = new double[nx + ny];
    nb::capsule owner(found, [](void* p) noexcept { delete[] static_cast<double*>(p); });
    std::vector<std::size_t> counts(ny);
    for (std::size_t j = 0; j < ny; j++) {
        counts[j] = seen[j].size();
        found[nx + j] = hw::window_size(counts[j], seen[j].stride(0), seen[j].data());
    }
    hw::window_sizes(nx, ny, effect.data(), counts.data(), found + nx, found);
    return nb::cast(nb::ndarray<nb::numpy, double>(found, 1, shape, owner));
}

}  // namespace

void bind_window(nb::module_& mod) {
    mod.def("window_forecast", &forecast, "x"_a, "A"_a, "B"_a.none(), "u"_a.none(), "lo"_a.none(), "hi"_a.none(),
            "Move states along a linear model, in place; see core/window.hpp.");
    mod.def("window_ends", &ends, "x"_a, "grown"_a, "Least and largest of rows of states, moved apart, as (2, 1, n).");
    mod.def("window_sizes", &sizes, "effect"_a, "seen"_a, "Order of size of each state and output, by the seen outputs.");
    mod.def("window_note", &note, "x"_a, "low"_a, "high"_a, "Let low and high take in x, in place.");
}
