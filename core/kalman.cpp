// Entry points of the Kalman family: sizes to templates, once per instruction set.
#include "kalman.hpp"

namespace hw {
namespace HW_ISA {
namespace {

// f(Dim<nx>, Dim<ny>) with both sizes fixed for nx <= 8, ny <= 4, and for those that calibrate a vehicle's sensors;
// at run time otherwise. A sanitizer build, which takes ten times longer to compile, has a few of the same
// templates.
template <int N, class F>
inline void with_outputs(int ny, F f) {
    switch (ny) {
        case 1: return f(Dim<N>(), Dim<1>());
        case 2: return f(Dim<N>(), Dim<2>());
#ifndef HW_FEW_SIZES
        case 3: return f(Dim<N>(), Dim<3>());
        case 4: return f(Dim<N>(), Dim<4>());
#endif
        default: return f(Dim<0>(N), Dim<0>(ny));
    }
}

template <class F>
inline void with_sizes(int nx, int ny, F f) {
    if (ny >= 1 && ny <= 4) switch (nx) {
        case 1: return with_outputs<1>(ny, f);
        case 2: return with_outputs<2>(ny, f);
        case 4: return with_outputs<4>(ny, f);
#ifndef HW_FEW_SIZES
        case 3: return with_outputs<3>(ny, f);
        case 5: return with_outputs<5>(ny, f);
        case 6: return with_outputs<6>(ny, f);
        case 7: return with_outputs<7>(ny, f);
        case 8: return with_outputs<8>(ny, f);
        case 9:  // what calibrates the sensors of a vehicle
            if (ny == 3) return f(Dim<9>(), Dim<3>());
            break;
        case 11:  // the same with an antenna off the axle
            if (ny == 3) return f(Dim<11>(), Dim<3>());
            break;
#endif
        default: break;
    }
    f(Dim<0>(nx), Dim<0>(ny));
}

template <class NX, class NY>
void push(NX nx, NY ny, KalmanPush& k) {
    Arena w{k.work};
    Correction<NX, NY> correct(nx, ny, w);
    Prediction<NX> predict(nx, w);
    Room<room<NX>> x_;
    Room<room<NX, NX>> P_;
    double *x = x_.get(w, nx), *P = P_.get(w, nx * nx);
    copy(nx, k.x, x);
    for (int i = 0; i < nx; i++) copy(nx, k.P + i * nx, P + i * nx);
    predict(k.A, k.B, k.u, k.nu, nullptr, k.Q, x, P);
    if (!sound(nx, x, P)) {
        k.code = kalman_broken;
        return;
    }
    if (k.lag > 0 && k.t > 0) {
        Retrodiction<NX> back(nx, w);
        LagRing<NX> ring{nx, k.lag, k.ring};
        copy(nx, x, back.xp);
        ring.put(k.t, back, k.A, predict.At, k.Q, k.x, k.P);
    }
    k.code = correct(k.C, k.R, nullptr, k.y, k.seen, x, P, &k.ll, &k.nis);
    if (k.code == kalman_broken || !sound(nx, x, P)) {
        k.code = kalman_broken;
        return;
    }
    copy(nx, x, k.x);
    for (int i = 0; i < nx; i++) copy(nx, P + i * nx, k.P + i * nx);
    if (k.lag > 0) {
        Retrodiction<NX> back(nx, w);
        LagRing<NX> ring{nx, k.lag, k.ring};
        copy(nx, x, k.xl);
        for (int i = 0; i < nx; i++) copy(nx, P + i * nx, k.Pl + i * nx);
        ring.walk(k.t, k.t > k.lag ? k.t - k.lag : 0, back, k.xl, k.Pl);
    }
}

}  // namespace

void kalman_filter(Kalman& k, Kalman* k2) {
    FlushTiny scope;
    with_sizes(k.nx, k.ny, [&](auto nx, auto ny) {
        std::int64_t good[2];
        filter(nx, ny, k, k2, good);
    });
}

void kalman_smooth(Kalman& k, Kalman* k2) {
    FlushTiny scope;
    with_sizes(k.nx, k.ny, [&](auto nx, auto ny) {
        std::int64_t good[2];
        filter(nx, ny, k, k2, good);
        smooth(nx, k, k2, good);
    });
}

void kalman_lag(Kalman& k, Kalman* k2) {
    FlushTiny scope;
    with_sizes(k.nx, k.ny, [&](auto nx, auto ny) {
        std::int64_t good[2];
        filter(nx, ny, k, k2, good);
        smooth_lag(nx, k, good[0], Arena{k.work});
        if (k2) smooth_lag(nx, *k2, good[1], Arena{k2->work});
    });
}

void kalman_push(KalmanPush& k) {
    FlushTiny scope;
    with_sizes(k.nx, k.ny, [&](auto nx, auto ny) { push(nx, ny, k); });
}

}  // namespace HW_ISA
}  // namespace hw
