// Many points through one tape: values in blocks of lanes, Jacobians point by point.
#include "tape.hpp"
#include "tape_kernels.hpp"

namespace hw {
namespace HW_ISA {

void tape_evaluate(const Tape& tape, long n_points, const double* in, double* out, double* work) {
    constexpr int L = tape_lanes;
    double* lanes = work;                         // (n_in, L)
    double* slots = work + (size_t)tape.n_in * L;  // (n, L)
    for (long start = 0; start < n_points; start += L) {
        const int used = n_points - start < L ? (int)(n_points - start) : L;
        for (int i = 0; i < tape.n_in; ++i)
            for (int l = 0; l < L; ++l)  // spare lanes repeat the first point of the block
                lanes[i * L + l] = in[(size_t)(start + (l < used ? l : 0)) * tape.n_in + i];
        tape_values<L>(tape, L, lanes, slots);
        for (int l = 0; l < used; ++l)
            for (int i = 0; i < tape.n_out; ++i)
                out[(size_t)(start + l) * tape.n_out + i] = slots[(size_t)tape.out[i] * L + l];
    }
}

void tape_differentiate(const Tape& tape, int n_d, long n_points, const double* in, double* out, double* slope, double* work) {
    double* value = work;           // (n,)
    double* along = work + tape.n;  // (n, n_d)
    for (long k = 0; k < n_points; ++k) {
        tape_jacobian(Dim<0>(n_d), tape, in + (size_t)k * tape.n_in, value, along);
        for (int i = 0; i < tape.n_out; ++i) {
            const size_t o = (size_t)k * tape.n_out + i;
            out[o] = value[tape.out[i]];
            for (int j = 0; j < n_d; ++j) slope[o * n_d + j] = along[(size_t)tape.out[i] * n_d + j];
        }
    }
}

}  // namespace HW_ISA
}  // namespace hw
