// Tilted moments: what a factor f makes of a Gaussian N(z; mu, c), four factors at a time (core/lane.hpp).
//
//     Z = int f(z) N(z; mu, c) dz,    mean and variance of f(z) N(z; mu, c) / Z,    d log Z / d log parameter
//
// This is all that expectation propagation, the truncated Kalman filter or the mixed-noise filter ask of a noise, so a
// noise is one function here. z is a residual: the factors of noises are centred at 0. Nothing overflows, nothing is
// NaN for finite mu, c >= 0 and lo <= hi (infinite ends allowed): c = 0 is taken as a variance of 1e-300, and a factor
// that the Gaussian misses by far gives a huge negative log Z and moments at the nearest end.
//
// The box needs Gaussian integrals from a point outwards. With the standardised ends a <= b turned so that a + b >= 0:
//
//     narrow    little changes between the ends (by a factor 3 at most): Gauss-Legendre quadrature of eight points,
//               exact to rounding and free of cancellation; a width of 0 is no special case
//     tail      0 <= a: I_k(a) = int_0^inf t^k exp(-a t - t^2/2) dt, k = 0, 1, 2 (I_0 is Mills' ratio), as
//               (1+a)^-(k+1) P_k((a-5)/(a+5)), one polynomial each over the whole half line
//     inside    a < 0: the complement of the two tails
#pragma once

#include "lane.hpp"

#if defined(__AVX__)
#include <immintrin.h>
#endif

namespace hw {
namespace HW_ISA {

struct Truncated4 {
    V4 log_z;         // log of the Gaussian's mass in the box
    V4 log_mean;      // log of the Gaussian's mean density in the box; minus infinity for an endless box
    V4 mean, var;     // tilted
    V4 at_lo, at_hi;  // tilted density at the ends: -d log Z / d lo, d log Z / d hi
};

// What a noise makes of its cavity; slope[k] = d log Z / d log (parameter k), or d logit of a rate.
struct Tilted4 {
    V4 log_z, mean, var;
    V4 slope_s;    // of the half-width
    V4 slope_R;    // of the variance
    V4 slope_eps;  // of the rate of outliers or losses, by its logit
    V4 out;        // probability that the row is an outlier or lost
};

inline V4 min4(V4 a, V4 b) { return a < b ? a : b; }
inline V4 abs4(V4 a) { return max4(a, -a); }
inline V4 sqrt4(V4 a) {
#if defined(__AVX__)
    return V4(_mm256_sqrt_pd((__m256d)a));
#else
    return V4{std::sqrt(a[0]), std::sqrt(a[1]), std::sqrt(a[2]), std::sqrt(a[3])};
#endif
}

// I_0, I_1, I_2 of the tail, for a >= 0
struct Tail4 {
    V4 i0, i1, i2;
};

template <int D>
inline V4 horner4(const double (&p)[D], V4 y) {
    V4 s = all4(p[D - 1]);
    for (int k = D - 2; k >= 0; k--) s = s * y + all4(p[k]);
    return s;
}

constexpr double tail_0[] = {
    1.15684862829189458,     -0.229487538252113159,  0.0777815988687376876,   0.0250721793016388,
    -0.0661776007790963056,  0.0615050458401864988,  -0.0380265921858413864,  0.016348231281029381,
    -0.00420129032918730683, 1.95306383707907867e-5, 4.57043923579536555e-4,  -1.34374278557113508e-4,
    -2.48058384519231898e-5, 2.27096127092376818e-5, -1.76332392657367463e-7, -3.2772876332088651e-6,
    3.20543166525895722e-7,  4.91996233147834049e-7, -6.58897449110895375e-8, -7.75852023678634269e-8,
    9.09247613401914649e-9,  1.10320711515743365e-8, -7.07389857556158864e-10, -9.56483293471255114e-10};
constexpr double tail_1[] = {
    1.29454115124316233,      -0.368722964545018213,   -0.0280306996275151891,  0.261167007847162464,
    -0.273548203763396074,    0.15402166231123108,     -0.0293109824594179509,  -0.0318618727080392153,
    0.0347462267607072439,    -0.0161317058957564874,  0.00232831561284571287,  0.00157677561750293391,
    -8.52735088762075124e-4,  -3.58181709961819957e-5, 1.46952144651337827e-4,  -1.72039310611252654e-5,
    -2.34042514517484306e-5,  4.97163692047404182e-6,  4.01480618558878923e-6,  -9.98521477159800586e-7,
    -7.59346786017822974e-7,  1.66015111542045761e-7,  1.44644032828983654e-7,  -2.11849987156605411e-8,
    -2.26724760128017485e-8,  1.52941860635162062e-9,  1.99822003319566289e-9};
constexpr double tail_2[] = {
    2.81031608121333558,     -0.77755368244602266,    -0.684863479048936483,   1.31312534973286196,
    -0.914599548054578379,   0.129907397762453874,    0.348068046125197848,    -0.345458613497971853,
    0.122984384606231014,    0.0359175489438883416,   -0.0591675979578638681,  0.0220754163390445552,
    0.0034651606225369007,   -0.00549230452637681562, 6.73949287736454763e-4,  9.61632507235443914e-4,
    -2.75632089997548119e-4, -1.66374420325157321e-4, 6.76665925654839772e-5,  3.23243410330831253e-5,
    -1.4229878459683261e-5,  -7.04118283013479692e-6, 2.60818096786653041e-6,  1.50951001717518071e-6,
    -3.70344612779446017e-7, -2.55049697517498969e-7, 2.94036277469804258e-8,  2.33289395999572729e-8};

inline V4 mills4(V4 a) {
    const V4 g = 1.0 / (1.0 + a);
    return g * horner4(tail_0, (a - 5.0) / (a + 5.0));
}
inline Tail4 tail4(V4 a) {
    const V4 g = 1.0 / (1.0 + a), y = (a - 5.0) / (a + 5.0);
    return {g * horner4(tail_0, y), g * g * horner4(tail_1, y), g * g * g * horner4(tail_2, y)};
}

// N(mu, c) cut to [lo, hi]
inline Truncated4 truncated4(V4 mu, V4 c, V4 lo, V4 hi) {
    // Gauss-Legendre on [-1/2, 1/2]
    constexpr double node[4] = {0.4801449282487681, 0.39833323870681336, 0.2627662049581645, 0.09171732124782489};
    constexpr double weight[4] = {0.05061426814518853, 0.11119051722668721, 0.15685332293894344, 0.18134189168918083};
    constexpr double far = 1e90, half_log_2pi = 0.5 * log_2pi, root_2pi = 2.5066282746310005024;
    const V4 zero{};
    const V4 sd = sqrt4(min4(max4(c, all4(1e-300)), all4(1e300)));
    const V4 width = hi - lo;
    const V4 lower = min4(max4((lo - mu) / sd, all4(-far)), all4(far));
    const V4 upper = min4(max4((hi - mu) / sd, all4(-far)), all4(far));
    const auto flip = lower + upper < zero;
    const V4 a = flip ? -upper : lower, b = flip ? -lower : upper;  // b >= |a|
    const V4 w = min4(width / sd, all4(2.0 * far));
    const V4 ref = max4(a, zero);  // where the Gaussian is highest in the box
    const auto beyond = a >= zero;
    const V4 drop = beyond ? w * (a + 0.5 * w) : 0.5 * b * b;
    const V4 Ea = exp4(0.5 * (ref - a) * (ref + a)), Eb = exp4(-drop);  // densities at the ends over that at ref
    const auto narrow = drop <= (beyond ? all4(1.2) : all4(0.35));
    const bool any_narrow = narrow[0] | narrow[1] | narrow[2] | narrow[3];
    const bool all_narrow = narrow[0] & narrow[1] & narrow[2] & narrow[3];

    V4 S0 = zero, S1 = zero, S2 = zero;  // narrow: moments of t = (z - middle) / width, over the mean density
    if (any_narrow) {
        const V4 shift = beyond ? a : zero, middle = 0.5 * (a + b);
        for (int k = 0; k < 4; k++) {
            // exponent -(x^2 - ref^2) / 2 at x = a + w (1/2 +- node), without the cancellation of large a
            const V4 tp = w * (0.5 + node[k]), tm = w * (0.5 - node[k]);
            const V4 xp = middle + w * node[k], xm = middle - w * node[k];
            const V4 fp = exp4(beyond ? -tp * (shift + 0.5 * tp) : -0.5 * xp * xp);
            const V4 fm = exp4(beyond ? -tm * (shift + 0.5 * tm) : -0.5 * xm * xm);
            S0 += weight[k] * (fp + fm);
            S1 += weight[k] * node[k] * (fp - fm);
            S2 += weight[k] * node[k] * node[k] * (fp + fm);
        }
    }
    V4 Z = w * S0, t1 = zero, var = zero;  // Z over the density at ref; t1: mean from the end a (or from mu), standardised
    if (!all_narrow) {
        const Tail4 A = tail4(abs4(a)), B = tail4(b);
        const V4 tail_Z = A.i0 - Eb * B.i0, inside_Z = root_2pi - Ea * A.i0 - Eb * B.i0;
        Z = narrow ? Z : beyond ? tail_Z : inside_Z;
        const V4 pa = Ea / Z, pb = Eb / Z;
        const V4 tail_1st = (A.i1 - Eb * (w * B.i0 + B.i1)) / tail_Z;
        const V4 tail_2nd = (A.i2 - Eb * (w * (w * B.i0 + 2.0 * B.i1) + B.i2)) / tail_Z;
        t1 = beyond ? tail_1st : pa - pb;
        var = beyond ? tail_2nd - tail_1st * tail_1st : 1.0 + a * pa - b * pb - t1 * t1;
        var = min4(max4(var, zero), all4(1.0));
    }
    const V4 sign = flip ? all4(-1.0) : all4(1.0);
    const V4 edge = flip ? hi : lo;
    const V4 centre = S1 / S0;
    const V4 mean = narrow ? edge + sign * width * (0.5 + centre) : (beyond ? edge : mu) + sign * sd * t1;
    const V4 log_top = -0.5 * ref * ref - half_log_2pi;  // log density at ref, standardised
    const V4 floor = all4(smallest);

    Truncated4 r;
    r.log_z = log_top + log4(Z);
    const V4 mean_density = narrow ? S0 : Z / w;
    r.log_mean = log_top + log4(mean_density) - log4(sd);
    r.mean = min4(max4(mean, lo), hi);
    r.var = c > zero ? (narrow ? width * width * max4(S2 / S0 - centre * centre, zero) : sd * sd * var) : zero;
    const V4 near = Ea / max4(Z, floor) / sd, away = Eb / max4(Z, floor) / sd;
    r.at_lo = flip ? away : near;
    r.at_hi = flip ? near : away;
    return r;
}

// d / sqrt(V), held where its square would overflow
inline V4 standardised4(V4 d, V4 V) { return min4(max4(d / sqrt4(V), all4(-1e90)), all4(1e90)); }

// f = N(z; 0, R): exact
inline Tilted4 gaussian4(V4 mu, V4 c, V4 R) {
    const V4 V = max4(c + R, all4(1e-300)), share = R / V;
    Tilted4 r{};
    const V4 d = standardised4(mu, V), q = d * d;
    r.log_z = -0.5 * (log_2pi + log4(V) + q);
    r.mean = mu * share;
    r.var = c * share;
    r.slope_R = 0.5 * share * (q - 1.0);
    return r;
}

// f = uniform on [-s, s]; s = 0 is the point 0
inline Tilted4 uniform4(V4 mu, V4 c, V4 s) {
    const Truncated4 t = truncated4(mu, c, -s, s);
    Tilted4 r{};
    r.log_z = t.log_mean;
    r.mean = t.mean;
    r.var = t.var;
    r.slope_s = s > V4{} ? s * (t.at_lo + t.at_hi) - 1.0 : V4{};
    return r;
}

// f = uniform on [-s, s] plus N(0, R): v = z + noise is N(mu, c + R) cut to the box, and z given v is Gaussian
inline Tilted4 uniform_gaussian4(V4 mu, V4 c, V4 s, V4 R) {
    const V4 V = max4(c + R, all4(1e-300)), gain = c / V;
    const Truncated4 t = truncated4(mu, V, -s, s);
    Tilted4 r{};
    r.log_z = t.log_mean;
    const V4 d = t.mean - mu;
    r.mean = mu + gain * d;
    r.var = gain * (R + gain * t.var);
    r.slope_s = s > V4{} ? s * (t.at_lo + t.at_hi) - 1.0 : V4{};
    const V4 q = standardised4(d, V);
    r.slope_R = 0.5 * (R / V) * (q * q + t.var / V - 1.0);
    return r;
}

// two explanations of one row, the second with probability eps
inline Tilted4 mixture4(const Tilted4& f, const Tilted4& g, V4 eps) {
    const V4 one = f.log_z + log4(1.0 - eps), two = g.log_z + log4(eps);
    const V4 top = max4(one, two), low = min4(one, two);
    const V4 e = exp4(low - top), less = e / (1.0 + e);
    const V4 p = two > one ? 1.0 - less : less;
    Tilted4 r;
    r.log_z = top + log4(1.0 + e);
    const V4 d = g.mean - f.mean;
    r.mean = f.mean + p * d;
    r.var = (1.0 - p) * f.var + p * g.var + p * (1.0 - p) * d * d;
    r.slope_s = (1.0 - p) * f.slope_s + p * g.slope_s;
    r.slope_R = (1.0 - p) * f.slope_R + p * g.slope_R;
    r.slope_eps = p - eps;
    r.out = p;
    return r;
}

// f = (1 - eps) (uniform on [-s, s] plus N(0, R)) + eps N(0, (wide s)^2 + R): outliers
inline Tilted4 contaminated4(V4 mu, V4 c, V4 s, V4 R, V4 eps, V4 wide) {
    const V4 W = wide * wide * s * s, all = W + R;
    Tilted4 g = gaussian4(mu, c, all);
    const V4 slope = g.slope_R / max4(all, all4(1e-300));
    g.slope_s = 2.0 * slope * W;
    g.slope_R = slope * R;
    return mixture4(uniform_gaussian4(mu, c, s, R), g, eps);
}

// f = (1 - eps) (uniform on [-s, s] plus N(0, R)) + eps exp(log_lost): a row that may say nothing of z
inline Tilted4 maybe_lost4(V4 mu, V4 c, V4 s, V4 R, V4 eps, V4 log_lost) {
    Tilted4 g{};
    g.log_z = log_lost;
    g.mean = mu;
    g.var = c;
    return mixture4(uniform_gaussian4(mu, c, s, R), g, eps);
}

}  // namespace HW_ISA
}  // namespace hw
