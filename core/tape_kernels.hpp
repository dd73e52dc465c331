// What the binding of tapes calls: one entry per kernel, compiled once per instruction set.
#pragma once
#include "isa.hpp"
#include "tape_code.hpp"

namespace hw {
constexpr int tape_lanes = 16;
}

// Values at n_points points. in: (n_points, n_in), out: (n_points, n_out), work: ((n_in + n) * tape_lanes,).
HW_KERNEL(void, tape_evaluate, const hw::Tape& tape, long n_points, const double* in, double* out, double* work)
// Values and Jacobians along the first n_d inputs. slope: (n_points, n_out, n_d), work: (n * (1 + n_d),).
HW_KERNEL(void, tape_differentiate, const hw::Tape& tape, int n_d, long n_points, const double* in, double* out,
          double* slope, double* work)
