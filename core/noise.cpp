// Entry points of core/noise.hpp for arrays.
#include "noise.hpp"
#include "noise_entry.hpp"

namespace hw {
namespace HW_ISA {
namespace {

// lanes k .. k+3 of an array, `rest` beyond its end
inline V4 four(const double* p, std::size_t k, std::size_t size, double rest) {
    V4 v = all4(rest);
    for (std::size_t l = 0; l < lanes && k + l < size; l++) v[static_cast<int>(l)] = p[k + l];
    return v;
}

inline void put(double* p, std::size_t k, std::size_t size, V4 v) {
    for (std::size_t l = 0; l < lanes && k + l < size; l++) p[k + l] = v[static_cast<int>(l)];
}

inline Tilted4 tilted(int kind, V4 mu, V4 c, V4 s, V4 R, V4 eps, V4 extra) {
    switch (kind) {
        case noise_gaussian: return gaussian4(mu, c, R);
        case noise_uniform: return uniform4(mu, c, s);
        case noise_uniform_gaussian: return uniform_gaussian4(mu, c, s, R);
        case noise_contaminated: return contaminated4(mu, c, s, R, eps, extra);
        default: return maybe_lost4(mu, c, s, R, eps, extra);
    }
}

}  // namespace

void noise_truncated(const TruncatedArgs& a) {
    for (std::size_t k = 0; k < a.size; k += lanes) {
        const Truncated4 t = truncated4(four(a.mu, k, a.size, 0.0), four(a.c, k, a.size, 1.0),
                                        four(a.lo, k, a.size, -1.0), four(a.hi, k, a.size, 1.0));
        put(a.log_z, k, a.size, t.log_z);
        put(a.log_mean, k, a.size, t.log_mean);
        put(a.mean, k, a.size, t.mean);
        put(a.var, k, a.size, t.var);
        put(a.at_lo, k, a.size, t.at_lo);
        put(a.at_hi, k, a.size, t.at_hi);
    }
}

void noise_tilted(const TiltedArgs& a) {
    for (std::size_t k = 0; k < a.size; k += lanes) {
        const Tilted4 t = tilted(a.kind, four(a.mu, k, a.size, 0.0), four(a.c, k, a.size, 1.0), four(a.s, k, a.size, 1.0),
                                 four(a.R, k, a.size, 1.0), four(a.eps, k, a.size, 0.5), four(a.extra, k, a.size, 1.0));
        put(a.log_z, k, a.size, t.log_z);
        put(a.mean, k, a.size, t.mean);
        put(a.var, k, a.size, t.var);
        put(a.slope_s, k, a.size, t.slope_s);
        put(a.slope_R, k, a.size, t.slope_R);
        put(a.slope_eps, k, a.size, t.slope_eps);
        put(a.out, k, a.size, t.out);
    }
}

}  // namespace HW_ISA
}  // namespace hw
