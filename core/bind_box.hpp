// Matrices of a chain at the border: one for all rows or stacked over time, exact or with upper ends of their own.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <optional>
#include <stdexcept>

namespace hw {

namespace nb = nanobind;
using BoxArray = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using MaybeArray = std::optional<BoxArray>;

inline void need(bool ok, const char* what) {
    if (!ok) throw std::invalid_argument(what);
}

// Judge a matrix (rows, n) or (T, rows, n) and point lo, hi to its ends; moving: it is stacked.
inline void box_matrix(const BoxArray& a, const MaybeArray& hi_end, std::size_t T, std::size_t rows, std::size_t n, const double*& lo,
                       const double*& hi, bool& moving) {
    moving = a.ndim() == 3;
    need(a.ndim() >= 2 && a.size() == (moving ? T : 1) * rows * n, "matrices (r,n) or (T,r,n) expected");
    need(!hi_end || hi_end->size() == a.size(), "both ends of a matrix have one shape");
    lo = a.data();
    hi = hi_end ? hi_end->data() : nullptr;
}

}  // namespace hw
