// Entry points of the extended and unscented filters: workspace, and the path compiled for the size of x.
#include "nonlinear.hpp"

namespace hw {
namespace HW_ISA {
namespace {

int lanes_of(const NonlinearArgs& a) { return padded(a.spread > 0.0 ? 2 * a.nx + 1 : a.nx); }

// Hands out pieces of `work`; with a null pointer it only counts.
struct Pieces {
    double* work;
    long used = 0;
    double* take(long size) {
        double* piece = work ? work + used : nullptr;
        used += size;
        return piece;
    }
};

long lay_out(const NonlinearArgs& a, double* work, Buffers& b) {
    Pieces p{work};
    const long n = a.nx, m = a.ny > a.nx ? a.ny : a.nx, lanes = lanes_of(a);
    const long n_in = a.g.n_in > a.h.n_in ? a.g.n_in : a.h.n_in, slots = a.g.n > a.h.n ? a.g.n : a.h.n;
    const bool sigma = a.spread > 0.0;
    b.points = p.take(sigma ? n_in * lanes : 0);
    b.slots = p.take(sigma ? slots * lanes : 0);
    b.value = p.take(sigma ? 0 : slots);
    b.slope = p.take(sigma ? 0 : slots * n);
    b.DX = p.take(n * lanes);
    b.DY = p.take(m * lanes);
    b.E = p.take(n * lanes);
    b.row = p.take(lanes);
    b.F = p.take(n * n);
    b.Fi = p.take(n);
    b.S = p.take(m * m);
    b.SL = p.take(m * m);
    b.d = p.take(m);
    b.di = p.take(m);
    b.Kt = p.take(m * n);
    b.KR = p.take(m * n);
    b.J = p.take(m * n);
    b.Rs = p.take(m * m);
    b.ym = p.take(m);
    b.v = p.take(m);
    b.z = p.take(m);
    b.size = p.take(m);
    b.xi = p.take(n);
    b.in = p.take(n_in);
    b.x = p.take(n);
    b.xp = p.take(n);
    b.Pp = p.take(n * n);
    b.Pn = p.take(n * n);
    b.W = p.take(lanes);
    b.W_safe = p.take(lanes);
    return p.used;
}

template <int N>
void scan_fixed(NonlinearArgs& a, const Buffers& b) {
    if (a.spread > 0.0) nonlinear_scan<true>(Dim<N>(), Dim<(2 * N + 4) / 4 * 4>(), a, b);
    else nonlinear_scan<false>(Dim<N>(), Dim<(N + 3) / 4 * 4>(), a, b);
}

}  // namespace

long nonlinear_workspace(const NonlinearArgs& a) {
    Buffers b;
    return lay_out(a, nullptr, b);
}

void nonlinear_run(NonlinearArgs& a, double* work) {
    Buffers b;
    lay_out(a, work, b);
    switch (a.nx) {
        case 1: return scan_fixed<1>(a, b);
        case 2: return scan_fixed<2>(a, b);
        case 3: return scan_fixed<3>(a, b);
        case 4: return scan_fixed<4>(a, b);
        case 5: return scan_fixed<5>(a, b);
        case 6: return scan_fixed<6>(a, b);
        case 7: return scan_fixed<7>(a, b);
        case 8: return scan_fixed<8>(a, b);
        default: break;
    }
    const Dim<0> n(a.nx), lanes(lanes_of(a));
    if (a.spread > 0.0) nonlinear_scan<true>(n, lanes, a, b);
    else nonlinear_scan<false>(n, lanes, a, b);
}

}  // namespace HW_ISA
}  // namespace hw
