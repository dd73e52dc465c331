// Entry points of core/chain.hpp for stored chains of doubles; n <= 8 are compiled for their size.
#include "chain.hpp"
#include "chain_entry.hpp"

namespace hw {
namespace HW_ISA {
namespace {

template <class N>
int run(N n, const ChainArgs& a) {
    const std::ptrdiff_t q = a.q;
    double *Q = a.work, *acc = Q + q * (q + 1) / 2 + 1, *Kf = acc + q + 1, *piv = Kf + q * q, *inv = piv + q, *small = inv + q;
    for (std::ptrdiff_t k = 0; k < q * (q + 1) / 2; k++) Q[k] = 0.0;
    for (int c = 0; c < a.q; c++) acc[c] = 0.0;
    chain_factor(n, a.T, a.q, a.M, a.O, a.B, Q, a.drop, small);
    for (int c = 0; c < a.q; c++)
        for (int d = 0; d <= c; d++) {
            a.K[c * q + d] -= Q[tri(c, d)];
            a.K[d * q + c] = a.K[c * q + d];
        }
    const int code = a.q ? ldl(Dim<0>(a.q), a.K, Kf, piv, inv) : 0;
    chain_forward(n, a.T, a.q, a.M, a.O, a.B, a.f, acc, small);
    for (int c = 0; c < a.q; c++) a.z[c] -= acc[c];
    if (a.q) ldl_solve(Dim<0>(a.q), Dim<1>(), Kf, inv, a.z);
    chain_backward(n, a.T, a.q, a.M, a.O, a.B, a.f, a.z, a.x);
    for (int c = 0; c < a.q; c++)
        for (int d = 0; d < a.q; d++) a.K[c * q + d] = c == d ? 1.0 : 0.0;
    if (a.q) ldl_solve(Dim<0>(a.q), Dim<0>(a.q), Kf, inv, a.K);
    if (a.S) {
        double* J = small + 2 * n;
        double* G = J + a.T * n * q;
        chain_inverse(n, a.T, a.q, a.M, a.O, a.B, a.K, a.S, a.C, a.H, J, G, G + n * n);
    }
    return code;
}

}  // namespace

std::size_t chain_workspace(int T, int n, int q) {
    const std::size_t Q = q;
    return Q * (Q + 1) / 2 + 1 + Q + 1 + Q * Q + 2 * Q + 2 * n + std::size_t(T) * n * Q + std::size_t(n) * n + n + 8;
}

int chain_run(const ChainArgs& a) {
    switch (a.n) {
        case 1: return run(Dim<1>(), a);
        case 2: return run(Dim<2>(), a);
        case 3: return run(Dim<3>(), a);
        case 4: return run(Dim<4>(), a);
        case 5: return run(Dim<5>(), a);
        case 6: return run(Dim<6>(), a);
        case 7: return run(Dim<7>(), a);
        case 8: return run(Dim<8>(), a);
        default: return run(Dim<0>(a.n), a);
    }
}

}  // namespace HW_ISA
}  // namespace hw
