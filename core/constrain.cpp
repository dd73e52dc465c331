// Entry points of core/constrain.hpp.
#include "constrain.hpp"

namespace hw {
namespace HW_ISA {
namespace {

// Places of all arrays in a buffer of doubles and one of ints; with null buffers only counts.
long constrain_place(Constraints& c, int n, int m, double* d, int* i, long* ints) {
    const long N = n, K = m;
    long used = 0, used_ints = 0;
    auto take = [&](double*& p, long size) {
        p = d ? d + used : nullptr;
        used += size;
    };
    auto take_int = [&](int*& p) {
        p = i ? i + used_ints : nullptr;
        used_ints += K;
    };
    c.n = n;
    take(c.F, K * N);
    double** const rows[] = {&c.lo, &c.hi, &c.a, &c.b, &c.sd, &c.tol, &c.most, &c.tau, &c.nu, &c.lam, &c.rhs, &c.d, &c.di};
    double** const squares[] = {&c.G, &c.Ga, &c.Gf};
    int** const marks[] = {&c.of, &c.active, &c.side, &c.live, &c.alive};
    for (double** p : rows) take(*p, K);
    take(c.s, K > N ? K : N);
    take(c.M, N * N);
    take(c.g, N);
    take(c.away, N);
    for (double** p : squares) take(*p, K * K);
    take(c.kept, N + N * N);
    for (int** p : marks) take_int(*p);
    *ints = used_ints;
    return used;
}

}  // namespace

long constrain_workspace(int n, int m, long* ints) {
    Constraints c;
    return constrain_place(c, n, m, nullptr, nullptr, ints);
}

void constrain_run(const ConstrainArgs& a, double* work, int* iwork) {
    Constraints c;
    long ints;
    constrain_place(c, a.n, a.m, work, iwork, &ints);
    constrain_prepare(a.m, a.D, a.lo, a.hi, c);
    for (long t = 0; t < a.T; t++)
        a.code[t] = constrain_row(c, a.by, a.x + t * a.n, a.P + t * a.n * a.n, a.distance + t, a.row + t);
}

}  // namespace HW_ISA
}  // namespace hw
