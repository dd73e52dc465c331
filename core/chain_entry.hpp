// Solve a block-tridiagonal system with a dense border, and the blocks of its inverse on the pattern.
#pragma once

#include <cstddef>

#include "isa.hpp"

namespace hw {

struct ChainArgs {
    int T, n, q;
    double* M;  // (T,n,n) diagonal blocks -> factor
    double* O;  // (T,n,n) coupling of t to t-1, O_0 unused -> Obar
    double* B;  // (T,q,n) border columns -> solved
    double* K;  // (q,q) corner -> inverse of its Schur complement, the border's block of the inverse
    double* f;  // (T,n) right-hand side -> forward solution
    double* z;  // (q)   right-hand side -> solution
    double* x;  // (T,n) solution
    double *S, *C, *H;  // (T,n,n), (T,n,n), (T,n,q): inverse at (t,t), (t,t-1), (t,border); null: not wanted
    double drop;        // directions whose pivot is below this share of its diagonal entry are left out
    double* work;       // chain_workspace doubles
};

}  // namespace hw

HW_KERNEL(std::size_t, chain_workspace, int T, int n, int q)
HW_KERNEL(int, chain_run, const ChainArgs& args)
