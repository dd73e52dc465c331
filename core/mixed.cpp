// Entry points of the filter for bounded plus Gaussian noise: workspace, and the path compiled for the size of x.
#include "mixed.hpp"

namespace hw {
namespace HW_ISA {

long mixed_workspace(const MixedArgs& a) {
    const long n = a.n;
    return 6 * n * n + 9 * n + a.capacity + a.ng + a.ny;
}

void mixed_run(MixedArgs& a, double* work) {
    const long n = a.n, nn = n * n;
    auto take = [&work](long size) {
        double* piece = work;
        work += size;
        return piece;
    };
    MixedBuffers b;
    double** const square[] = {&b.F, &b.Ft, &b.out, &b.work, &b.P, &b.X};
    double** const vector[] = {&b.w, &b.Pc, &b.Xc, &b.K, &b.g, &b.row, &b.last, &b.root, &b.m};
    for (double** one : square) *one = take(nn);
    for (double** one : vector) *one = take(n);
    b.key = take(a.capacity + a.ng + a.ny);
    switch (a.n) {
        case 1: return mixed_scan(Dim<1>(), a, b);
        case 2: return mixed_scan(Dim<2>(), a, b);
        case 4: return mixed_scan(Dim<4>(), a, b);
        default: return mixed_scan(Dim<0>(a.n), a, b);
    }
}

}  // namespace HW_ISA
}  // namespace hw
