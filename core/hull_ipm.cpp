// Entry points of core/hull_ipm.hpp; the usual numbers of states are compiled for their size.
#include "hull_ipm.hpp"

#include "hull_entry.hpp"

namespace hw {
namespace HW_ISA {
namespace {

template <int N>
std::size_t bytes(const HullRows& rows) {
    Carver c{nullptr};
    HullSettings set;
    HullIpm<N>(rows, set).carve(c);
    return c.used + 64;
}

template <int N>
int solve(const HullRows& rows, const HullSettings& set, int costs, const double* c, const int* k, double* y, double* value,
          double* gap, void* workspace) {
    const FlushTiny flush;
    HullIpm<N> ipm(rows, set);
    Carver carver{static_cast<char*>(workspace)};
    ipm.carve(carver);
    ipm.prepare();
    constexpr int P = HullIpm<N>::P;
    const std::ptrdiff_t stride = std::ptrdiff_t(rows.K) * (rows.n + rows.m);
    int most = 0;
    for (int p = 0; p < costs; p += P) {
        const int count = costs - p < P ? costs - p : P;
        const double* cost[P];
        double* out[P];
        for (int q = 0; q < count; q++) {
            cost[q] = c + std::ptrdiff_t(p + q) * rows.n;
            out[q] = y + (p + q) * stride;
        }
        const int iterations = ipm.solve(cost, k + p, count, out, value + p, gap + p);
        most = iterations > most ? iterations : most;
    }
    return most;
}

}  // namespace

std::size_t hull_solve_bytes(int K, int n, int m) {
    HullRows rows{};
    rows.K = K;
    rows.n = n;
    rows.m = m;
    return bytes<0>(rows);
}

int hull_solve(const HullRows& rows, const HullSettings& set, int costs, const double* c, const int* k, double* y, double* value,
               double* gap, void* workspace) {
    switch (rows.n) {
#ifndef HW_FEW_SIZES
        case 1: return solve<1>(rows, set, costs, c, k, y, value, gap, workspace);
        case 2: return solve<2>(rows, set, costs, c, k, y, value, gap, workspace);
        case 3: return solve<3>(rows, set, costs, c, k, y, value, gap, workspace);
#endif
        case 4: return solve<4>(rows, set, costs, c, k, y, value, gap, workspace);
        default: return solve<0>(rows, set, costs, c, k, y, value, gap, workspace);
    }
}

}  // namespace HW_ISA
}  // namespace hw
