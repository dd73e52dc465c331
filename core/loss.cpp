// Entry points of loss.hpp, one set per instruction set: sizes up to six states are known when compiling.
#define HW_LOSS_KERNEL
#include "loss.hpp"

namespace hw {
namespace HW_ISA {

// Places of all arrays in a buffer of doubles (32-byte aligned) and one of ints; with null buffers only counts.
long loss_place(LossState& s, double* d, int* i, long* n_int) {
    const long n = s.n, m = s.m, M = s.M, G = s.G, K = s.K, B = blocks(s.K);
    long used = 0, ints = 0;
    auto take = [&](double*& p, long size) {
        p = d ? d + used : nullptr;
        used += (size + lanes - 1) / lanes * lanes;
    };
    auto take_int = [&](int*& p, long size) {
        p = i ? i + ints : nullptr;
        ints += size;
    };
    take(s.x, B * n * lanes);
    take(s.P, B * n * n * lanes);
    take(s.x2, B * n * lanes);
    take(s.P2, B * n * n * lanes);
    take(s.logw, B * lanes);
    take(s.cx, M * B * n * lanes);
    take(s.cP, M * B * n * n * lanes);
    take(s.a, M * B * lanes);
    take(s.w, M * B * lanes);
    take(s.lw, B * lanes);
    take(s.count, K * G * 4);
    take(s.count2, K * G * 4);
    take(s.mix, M);
    take(s.rows, M * m * n);
    take(s.L, M * m * m);
    take(s.li, M * m);
    take(s.z, M * m);
    take(s.konst, M);
    take(s.logPi, M * M);
    take(s.logpi0, M);
    const long size = n + n * n, pool = M * K;
    long work = lanes * (2 * n * n + 2 * n);             // four at a time, sizes known when running
    auto need = [&](long w) { work = w > work ? w : work; };
    need(m * m);
    need(2 * size + 4 * G);
    need(8 * n * n + 6 * n);
    need(B * lanes);
    need(M);
    if (s.rule == loss_merge) need(pool * (size + 2 + 4 * G + pool) + 2 * size);
    take(s.work, work);
    take_int(s.mode, K);
    take_int(s.mode2, K);
    take_int(s.used, M);
    take_int(s.moves, M * m);
    take_int(s.still, M);
    take_int(s.order, 2 * M * K);
    take_int(s.seen, m);
    *n_int = ints;
    return used;
}

// One component N(x0, P0); the modes start from pi0, learned laws from pseudo-counts (G,2,2).
void loss_start(LossState& s, const double* x0, const double* P0, const double* pi0, const double* count) {
    const Dim<0> n(s.n);
    s.started = 0;
    s.fresh = 1;
    s.live = s.rule == loss_average ? s.K : 1;  // imaginary histories before the first row have weight 0
    for (int i = 0; i < blocks(s.K) * lanes; i++) {
        put(n, x0, P0, i, s.x, s.P);
        put(n, x0, P0, i, s.x2, s.P2);
        s.logw[i] = i ? minus_inf : 0.0;
    }
    for (int i = 0; i < s.K; i++) {
        s.mode[i] = s.mode2[i] = 0;
        if (s.learn)
            for (int j = 0; j < s.G * 4; j++) s.count[i * s.G * 4 + j] = s.count2[i * s.G * 4 + j] = count[j];
    }
    if (s.rule == loss_sample) {
        s.live = s.K;
        for (int i = 0; i < s.K; i++) s.logw[i] = -std::log(static_cast<double>(s.K));
    }
    for (int q = 0; q < s.M; q++) {
        s.logpi0[q] = log_or_minus_inf(pi0[q]);
        s.mix[q] = pi0[q];
    }
}

#define HW_BY_SIZE(call)                  \
    switch (s.n) {                        \
        case 1: { const Dim<1> n; call; } \
        case 2: { const Dim<2> n; call; } \
        case 3: { const Dim<3> n; call; } \
        case 4: { const Dim<4> n; call; } \
        case 5: { const Dim<5> n; call; } \
        case 6: { const Dim<6> n; call; } \
        default: { const Dim<0> n(s.n); call; } \
    }

int loss_step(LossState& s, const LossRow& r, LossOut& o, LossPast* past, int slot) {
    HW_BY_SIZE(return step(n, s, r, o, past, slot))
}

int loss_filter(LossState& s, LossArgs& k) { HW_BY_SIZE(return filter(n, s, k)) }

}  // namespace HW_ISA
}  // namespace hw
