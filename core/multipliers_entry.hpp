// Multipliers that make the bounds of a zonotope cut by strips small; see core/multipliers.hpp.
#pragma once

#include <cstddef>

#include "isa.hpp"

namespace hw {

struct StripSides {
    int n, k, rows;         // objectives, generators, strips
    std::ptrdiff_t stride;  // from row to row of G and A
    int rounds;
    const double *G, *A;  // (n,k), (rows,k)
    const double *b, *t;  // (rows,)
    double* y;            // (2n,rows) out: side 2i for the most of G_i xi, 2i+1 for the least
    double* work;         // multipliers_workspace doubles
};

}  // namespace hw

HW_KERNEL(std::size_t, multipliers_workspace, int n, int k, int rows)
HW_KERNEL(void, multipliers, const hw::StripSides& s)
