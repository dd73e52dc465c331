// Tilted moments of arrays; see core/noise.hpp.
#pragma once

#include <cstddef>

#include "wide.hpp"

namespace hw {

// Kinds of noise of a row.
enum NoiseKind : int {
    noise_gaussian = 0,          // R
    noise_uniform = 1,           // s
    noise_uniform_gaussian = 2,  // s, R
    noise_contaminated = 3,      // s, R, eps, extra: the outliers' standard deviation over s
    noise_maybe_lost = 4,        // s, R, eps, extra: log density of a lost row
    noise_kinds = 5
};

struct TruncatedArgs {
    std::size_t size;
    const double *mu, *c, *lo, *hi;                          // (size,)
    double *log_z, *log_mean, *mean, *var, *at_lo, *at_hi;   // (size,)
};

struct TiltedArgs {
    int kind;
    std::size_t size;
    const double *mu, *c, *s, *R, *eps, *extra;                               // (size,)
    double *log_z, *mean, *var, *slope_s, *slope_R, *slope_eps, *out;         // (size,)
};

}  // namespace hw

HW_WIDE_KERNEL(void, noise_truncated, const hw::TruncatedArgs& args)
HW_WIDE_KERNEL(void, noise_tilted, const hw::TiltedArgs& args)
