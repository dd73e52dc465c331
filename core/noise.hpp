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
//     narrow    little changes between the ends (a quarter in log density): Gauss-Legendre quadrature of six points, exact
//               to rounding and free of cancellation; a width of 0 is no special case
//     tail      0 <= a: I_k(a) = int_0^inf t^k exp(-a t - t^2/2) dt, k = 0, 1, 2 (I_0 is Mills' ratio); far out as
//               (a+5)^-(k+1) P_k((a-5)/(a+5)), one polynomial each over the whole half line, near by I_1 = 1 - a I_0,
//               I_2 = I_0 - a I_1
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

// sum of p[k] y^k, even and odd powers side by side
template <int D>
inline V4 polynomial4(const double (&p)[D], V4 y) {
    const V4 y2 = y * y;
    V4 even = all4(p[(D - 1) / 2 * 2]), odd = all4(p[D / 2 * 2 - 1]);
    for (int k = (D - 1) / 2 * 2 - 2; k >= 0; k -= 2) even = even * y2 + all4(p[k]);
    for (int k = D / 2 * 2 - 3; k >= 0; k -= 2) odd = odd * y2 + all4(p[k]);
    return even + y * odd;
}

constexpr double tail_0[] = {
    1.92808104715315765, -1.66786659518896005, 1.24154706157386642, -0.78591107554654524,
    0.413644715732683773, -0.17325473408715042, 0.052125502412278802, -0.0075032828206787589,
    -0.00199996197498436585, 0.00136585916094243608, -0.000148833052323398007, -0.000124735658187210807,
    0.0000418145858663246277, 9.9747800855427326e-6, -6.94503313849162836e-6, -8.36067598018140689e-7,
    1.09366335235939413e-6, 9.66842835721632527e-8, -1.76412396897719028e-7, -1.7398124277679195e-8,
    2.81720119754430307e-8, 3.18686684386651307e-9, -3.84418406496492043e-9, -3.33685048792316821e-10,
    3.12560544716041261e-10};
constexpr double tail_1[] = {
    3.59594764234211754, -5.81882731352565199, 6.08237441136128432, -4.79822316511704847,
    2.93449724909663813, -1.35228141899148378, 0.417401496681359652, -0.0440265668527649204,
    -0.030292390744381829, 0.0151469229461233513, -0.000265068186097029449, -0.00199860752421502739,
    0.000413905450164414663, 0.000236894082368849608, -0.0000916043545713771066, -0.0000309159691915661127,
    0.0000168984299431742442, 4.98087425378471951e-6, -2.96613399021828392e-6, -9.81197943232230321e-7,
    4.86382210803915168e-7, 2.02202574935222778e-7, -6.5485473041902192e-8, -3.41163051130826626e-8,
    5.16079547354143307e-9, 3.18928319056989885e-9};
constexpr double tail_2[] = {
    13.0107225982098868, -29.6212307632995115, 38.7241671407963577, -35.729104821973336,
    24.3683905895333499, -11.9703789129748712, 3.64739794149934782, -0.153899976589160333,
    -0.439246214787278242, 0.16926684219218528, 0.018803869650302546, -0.0309488082078260654,
    0.00271503315256296136, 0.00483604097170943461, -0.00100187802055734609, -0.000796378874257673808,
    0.000219405802412529844, 0.000148795953730778821, -0.0000405729711286423998, -0.000031280254917053162,
    6.37181283833868862e-6, 6.8848525311977615e-6, -7.47777131954942994e-7, -1.40755764497391215e-6,
    4.42895604305481659e-8, 2.2275669454504871e-7, 1.02824287489289391e-9, -1.92140920798082692e-8};

// I_0, I_1, I_2 of the tail beyond a >= 0
struct Tail4 {
    V4 i0, i1, i2;
};

// near: by recurrence, for a <= 4 or where a factor exp(-a^2/2) follows; far: all three to full precision
inline Tail4 tail4(V4 a, bool far) {
    const V4 g = 1.0 / (a + 5.0), y = (a - 5.0) * g;
    Tail4 r;
    r.i0 = g * polynomial4(tail_0, y);
    if (far) {
        r.i1 = g * g * polynomial4(tail_1, y);
        r.i2 = g * g * g * polynomial4(tail_2, y);
    } else {
        r.i1 = 1.0 - a * r.i0;
        r.i2 = r.i0 - a * r.i1;
    }
    return r;
}

// N(mu, c) cut to [lo, hi]
inline Truncated4 truncated4(V4 mu, V4 c, V4 lo, V4 hi) {
    // Gauss-Legendre on [-1/2, 1/2]
    constexpr double node[3] = {0.46623475710157597, 0.33060469323313224, 0.11930959304159845};
    constexpr double weight[3] = {0.08566224618958514, 0.18038078652406936, 0.23395696728634552};
    constexpr double far = 1e90, half_log_2pi = 0.5 * log_2pi, root_2pi = 2.5066282746310005024;
    const V4 zero{};
    const V4 sd = sqrt4(min4(max4(c, all4(1e-300)), all4(1e300))), scale = 1.0 / sd;
    const V4 width = hi - lo;
    const V4 lower = min4(max4((lo - mu) * scale, all4(-far)), all4(far));
    const V4 upper = min4(max4((hi - mu) * scale, all4(-far)), all4(far));
    const auto flip = lower + upper < zero;
    const V4 a = flip ? -upper : lower, b = flip ? -lower : upper;  // b >= |a|
    const V4 w = min4(width * scale, all4(2.0 * far));
    const V4 ref = max4(a, zero);  // where the Gaussian is highest in the box
    const auto beyond = a >= zero;
    const V4 drop = beyond ? w * (a + 0.5 * w) : 0.5 * b * b;
    const V4 Ea = exp4(0.5 * (ref - a) * (ref + a)), Eb = exp4(-drop);  // densities at the ends over that at ref
    const auto narrow = drop <= (beyond ? all4(0.25) : all4(0.03));
    const bool any_narrow = narrow[0] | narrow[1] | narrow[2] | narrow[3];
    const bool all_narrow = narrow[0] & narrow[1] & narrow[2] & narrow[3];

    V4 S0 = zero, S1 = zero, S2 = zero;  // narrow: moments of t = (z - middle) / width, over the mean density
    if (any_narrow) {
        const V4 shift = beyond ? a : zero, middle = 0.5 * (a + b);
        for (int k = 0; k < 3; k++) {
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
        const auto deep = (a > all4(4.0)) & ~narrow;
        const bool deep_tail = deep[0] | deep[1] | deep[2] | deep[3];
        const Tail4 A = tail4(abs4(a), deep_tail), B = tail4(b, deep_tail);
        const V4 tail_Z = A.i0 - Eb * B.i0, inside_Z = root_2pi - Ea * A.i0 - Eb * B.i0;
        Z = narrow ? Z : beyond ? tail_Z : inside_Z;
        const V4 over = 1.0 / Z, pa = Ea * over, pb = Eb * over;
        const V4 tail_1st = (A.i1 - Eb * (w * B.i0 + B.i1)) * over;
        const V4 tail_2nd = (A.i2 - Eb * (w * (w * B.i0 + 2.0 * B.i1) + B.i2)) * over;
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
    const V4 density = scale / max4(Z, floor), near = Ea * density, away = Eb * density;
    r.at_lo = flip ? away : near;
    r.at_hi = flip ? near : away;
    return r;
}

// Third and fourth cumulant of a tilted distribution, and its central moments.
struct Shape4 {
    V4 mean, m2, m3, m4;
    inline V4 k3() const { return m3; }
    inline V4 k4() const { return m4 - 3.0 * m2 * m2; }
};

// of N(mu, c) cut to [lo, hi], by quadrature over the part that carries mass; about six digits
inline Shape4 truncated_shape4(V4 mu, V4 c, V4 lo, V4 hi) {
    constexpr double node[10] = {0.4965642995925475, 0.4819859636389569, 0.456117214125663, 0.4195584859111094,
                                   0.3731659532300754, 0.3180268403632575, 0.25543350097541356, 0.18685304435770977,
                                   0.11389292557082253, 0.03826326056674867};
    constexpr double weight[10] = {0.008807003569575447, 0.020300714900193223, 0.031336024167054395, 0.04163837078835236,
                                     0.05096505990862035, 0.0590972659807593, 0.06584431922458844, 0.0710480546591912,
                                     0.07458649323630212, 0.07637669356536314};
    const V4 zero{}, sd = sqrt4(min4(max4(c, all4(1e-300)), all4(1e300)));
    const V4 lower = min4(max4((lo - mu) / sd, all4(-1e90)), all4(1e90));
    const V4 upper = min4(max4((hi - mu) / sd, all4(-1e90)), all4(1e90));
    const auto flip = lower + upper < zero;
    const V4 a = flip ? -upper : lower, b = flip ? -lower : upper, ref = max4(a, zero);
    const V4 left = max4(a, all4(-7.0));
    const V4 width = min4(b - left, ref - left + 50.0 / (ref + sqrt4(ref * ref + 50.0)));
    V4 s0 = zero, s1 = zero, s2 = zero, s3 = zero, s4 = zero;
    for (int k = 0; k < 10; k++)
        for (int side = -1; side <= 1; side += 2) {
            const V4 t = width * (0.5 + side * node[k]);
            const V4 d = left - ref;  // x^2 - ref^2 = (t + d) (t + d + 2 ref)
            const V4 f = weight[k] * exp4(-0.5 * (t + d) * (t + d + 2.0 * ref)), u = all4(side * node[k]);
            s0 += f;
            s1 += f * u;
            s2 += f * u * u;
            s3 += f * u * u * u;
            s4 += f * u * u * u * u;
        }
    const V4 over = 1.0 / max4(s0, all4(smallest)), m = s1 * over, q2 = s2 * over, q3 = s3 * over, q4 = s4 * over;
    const V4 unit = sd * width, sign = flip ? all4(-1.0) : all4(1.0);
    const V4 v = max4(q2 - m * m, zero);
    Shape4 r;
    r.mean = min4(max4((flip ? mu - sd * left : mu + sd * left) + sign * unit * (0.5 + m), lo), hi);
    r.m2 = unit * unit * v;
    r.m3 = sign * unit * unit * unit * (q3 - 3.0 * m * q2 + 2.0 * m * m * m);
    r.m4 = unit * unit * unit * unit * max4(q4 - 4.0 * m * q3 + 6.0 * m * m * q2 - 3.0 * m * m * m * m, zero);
    return r;
}

// of a uniform on [-s, s] plus N(0, R)
inline Shape4 uniform_gaussian_shape4(V4 mu, V4 c, V4 s, V4 R) {
    const V4 V = max4(c + R, all4(1e-300)), gain = c / V, g2 = gain * gain;
    const Shape4 t = truncated_shape4(mu, V, -s, s);
    Shape4 r;
    r.mean = mu + gain * (t.mean - mu);
    r.m2 = gain * R + g2 * t.m2;
    r.m3 = g2 * gain * t.k3();
    r.m4 = g2 * g2 * t.k4() + 3.0 * r.m2 * r.m2;
    return r;
}

inline Shape4 gaussian_shape4(V4 mu, V4 c, V4 R) {
    const V4 V = max4(c + R, all4(1e-300));
    Shape4 r{};
    r.mean = mu * (R / V);
    r.m2 = c * (R / V);
    r.m4 = 3.0 * r.m2 * r.m2;
    return r;
}

// of two explanations, the second with probability p
inline Shape4 mixture_shape4(const Shape4& f, const Shape4& g, V4 p) {
    const V4 one = 1.0 - p, mean = one * f.mean + p * g.mean, a = f.mean - mean, b = g.mean - mean;
    Shape4 r;
    r.mean = mean;
    r.m2 = one * (f.m2 + a * a) + p * (g.m2 + b * b);
    r.m3 = one * (f.m3 + 3.0 * a * f.m2 + a * a * a) + p * (g.m3 + 3.0 * b * g.m2 + b * b * b);
    r.m4 = one * (f.m4 + 4.0 * a * f.m3 + 6.0 * a * a * f.m2 + a * a * a * a) +
           p * (g.m4 + 4.0 * b * g.m3 + 6.0 * b * b * g.m2 + b * b * b * b);
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
