// Enclosures of tapes over boxes, from plain arrays.
#include "enclose.hpp"

#include "enclose_kernels.hpp"

namespace hw {
namespace HW_ISA {

static_assert(sizeof(Interval) == 2 * sizeof(double), "an interval is a pair of numbers");

void enclose_derivatives(const Tape& tape, int n_d, const double* in, double* value, double* slope, double* bend, double* work) {
    const int h = half_square(n_d);
    Interval* v = reinterpret_cast<Interval*>(work);
    Interval *d = v + tape.n, *dd = d + (std::size_t)tape.n * n_d;
    tape_intervals(tape, n_d, reinterpret_cast<const Interval*>(in), v, d, dd);
    for (int i = 0; i < tape.n_out; ++i) {
        const std::size_t o = (std::size_t)tape.out[i], at = (std::size_t)i;
        reinterpret_cast<Interval*>(value)[i] = v[o];
        for (int j = 0; j < n_d; ++j) reinterpret_cast<Interval*>(slope)[at * n_d + j] = d[o * n_d + j];
        for (int j = 0; j < h; ++j) reinterpret_cast<Interval*>(bend)[at * h + j] = dd[o * h + j];
    }
}

void enclose_affine(const Tape& tape, int n_d, const double* in, double* J, double* k, double* half, double* value, double* work) {
    tape_affine(tape, n_d, reinterpret_cast<const Interval*>(in), J, k, half, reinterpret_cast<Interval*>(value),
                reinterpret_cast<Interval*>(work));
}

}  // namespace HW_ISA
}  // namespace hw
