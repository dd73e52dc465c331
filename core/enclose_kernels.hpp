// What the binding of enclosures calls: one entry per kernel, compiled once per instruction set. Intervals are pairs (lo, hi).
#pragma once
#include "isa.hpp"
#include "tape_code.hpp"

namespace hw {
constexpr int enclose_most = 64;  // entries along which a tape can be differentiated over a box
}

// in: (n_in, 2); value: (n_out, 2), slope: (n_out, n_d, 2), bend: (n_out, n_d (n_d + 1) / 2, 2) upper triangle row by row.
// work: (n (1 + n_d + n_d (n_d + 1) / 2), 2).
HW_KERNEL(void, enclose_derivatives, const hw::Tape& tape, int n_d, const double* in, double* value, double* slope,
          double* bend, double* work)
// |f - J x - k| <= half and f in value over the box; J: (n_out, n_d), k, half: (n_out,), value: (n_out, 2).
// work: (n (2 + 2 n_d + n_d (n_d + 1) / 2) + n_in, 2).
HW_KERNEL(void, enclose_affine, const hw::Tape& tape, int n_d, const double* in, double* J, double* k, double* half,
          double* value, double* work)
