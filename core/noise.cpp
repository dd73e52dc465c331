// Entry points of core/noise.hpp for arrays.
#include "lanes.hpp"
#include "noise.hpp"
#include "noise_entry.hpp"

namespace hw {
namespace HW_ISA {
namespace {

// as many lanes as the kernels of the widest registers have
typedef Lanes<wide_lanes>::Raw X;

// lanes k, k+1, ... of an array, `rest` beyond its end
inline X some(const double* p, std::size_t k, std::size_t size, double rest) {
    X v = all<X>(rest);
    for (std::size_t l = 0; l < wide_lanes && k + l < size; l++) v[static_cast<int>(l)] = p[k + l];
    return v;
}

inline void put(double* p, std::size_t k, std::size_t size, X v) {
    for (std::size_t l = 0; l < wide_lanes && k + l < size; l++) p[k + l] = v[static_cast<int>(l)];
}

inline Tilted<X> tilted(int kind, const Cavity<X>& q, X s, X R, X eps, X extra) {
    switch (kind) {
        case noise_gaussian: return gaussian4<evidence>(q, R);
        case noise_uniform: return uniform4<evidence>(q, s);
        case noise_uniform_gaussian: return uniform_gaussian4<evidence>(q, s, R);
        case noise_contaminated: return contaminated4<evidence>(q, s, R, eps, extra);
        default: return maybe_lost4<evidence>(q, s, R, eps, extra);
    }
}

}  // namespace

void noise_truncated(const TruncatedArgs& a) {
    for (std::size_t k = 0; k < a.size; k += wide_lanes) {
        const Truncated<X> t = truncated4(some(a.mu, k, a.size, 0.0), some(a.c, k, a.size, 1.0),
                                        some(a.lo, k, a.size, -1.0), some(a.hi, k, a.size, 1.0));
        put(a.log_z, k, a.size, t.log_z());
        put(a.log_mean, k, a.size, t.log_mean());
        put(a.mean, k, a.size, t.mean);
        put(a.var, k, a.size, t.var);
        put(a.at_lo, k, a.size, t.at_lo);
        put(a.at_hi, k, a.size, t.at_hi);
    }
}

void noise_tilted(const TiltedArgs& a) {
    for (std::size_t k = 0; k < a.size; k += wide_lanes) {
        const Tilted<X> t = tilted(a.kind, cavity4(some(a.mu, k, a.size, 0.0), some(a.c, k, a.size, 1.0)), some(a.s, k, a.size, 1.0),
                                 some(a.R, k, a.size, 1.0), some(a.eps, k, a.size, 0.5), some(a.extra, k, a.size, 1.0));
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
