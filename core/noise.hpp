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
#include "wide.hpp"

namespace hw {
namespace HW_ISA {

template <class X>
struct Truncated {
    X log_top;       // log of the standard Gaussian's largest density in the box
    X mass, dense;   // the Gaussian's mass in the box and its mean density there, over that
    X mean, var;     // tilted
    X at_lo, at_hi;  // tilted density at the ends: -d log Z / d lo, d log Z / d hi
    X k3, k4;        // cumulants
    inline X log_z() const { return log_top + log4(mass); }
    inline X log_mean() const { return log_top + log4(dense); }  // minus infinity for an endless box
};
typedef Truncated<V4> Truncated4;

// What a noise makes of its cavity; slope[k] = d log Z / d log (parameter k), or d logit of a rate.
template <class X>
struct Tilted {
    X log_z, mean, var;
    X slope_s;    // of the half-width
    X slope_R;    // of the variance
    X slope_eps;  // of the rate of outliers or losses, by its logit
    X out;        // probability that the row is an outlier or lost
    X k3, k4;     // cumulants
};

// A cavity N(mu, c) with what its maker has at hand: sd^2 = c, scale = 1 / sd.
template <class X>
struct Cavity {
    X mu, c, sd, scale;
};
template <class X>
inline Cavity<X> cavity4(X mu, X c) {
    const X sd = sqrt4(min4(max4(c, all<X>(1e-300)), all<X>(1e300)));
    return {mu, c, sd, 1.0 / sd};
}

// sum of p[k] y^k, every fourth power a chain of its own
template <int D, class X>
inline X polynomial4(const double (&p)[D], X y) {
    const X y2 = y * y, y4 = y2 * y2;
    X part[4];
    for (int c = 0; c < 4; c++) {
        constexpr int whole = (D - 1) / 4 * 4;
        const int top = whole + c < D ? whole + c : whole + c - 4;
        part[c] = all<X>(p[top]);
        for (int k = top - 4; k >= 0; k -= 4) part[c] = part[c] * y4 + all<X>(p[k]);
    }
    return (part[0] + y * part[1]) + y2 * (part[2] + y * part[3]);
}

// 1 / a and the root of a within an ulp or two. Eight at a time the divider is slow: Newton steps from an estimate of 14 bits.
template <class X>
inline X over4(X a) {
#if defined(__AVX512F__)
    if constexpr (sizeof(X) == 64) {
        const X first = X(_mm512_rcp14_pd((__m512d)a)), second = first + first * (1.0 - a * first), e = 1.0 - a * second;
        return e == e ? second + second * e : first;
    }
#endif
    return 1.0 / a;
}
template <class X>
inline X root4(X a) {
#if defined(__AVX512F__)
    if constexpr (sizeof(X) == 64) {
        const X y = X(_mm512_rsqrt14_pd((__m512d)a));
        X g = a * y, h = 0.5 * y, e = 0.5 - g * h;
        g = g + g * e;
        h = h + h * e;
        e = 0.5 - g * h;
        return (a > X{}) & (a < all<X>(1e308)) ? g + g * e : sqrt4(a);
    }
#endif
    return sqrt4(a);
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
template <class X>
struct Tail {
    X i0, i1, i2;
};

// near: by recurrence, for a <= 4 or where a factor exp(-a^2/2) follows; far: all three to full precision. g = 1 / (a + 5)
template <class X>
inline Tail<X> tail4(X a, X g, bool far) {
    const X y = (a - 5.0) * g;
    Tail<X> r;
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

// Over a width w about m across which the log density falls by a quarter at most: S[j] = the sum over the nodes of
// exp(m^2/2 - x^2/2) t^j, t = (x - m) / w. Pairs of nodes make cosh and sinh of m (x - m), so series do.
template <class X>
inline void narrow4(X m, X w, X (&S)[5]) {
    // Gauss-Legendre on [-1/2, 1/2]
    constexpr double node[3] = {0.46623475710157597, 0.33060469323313224, 0.11930959304159845};
    constexpr double weight[3] = {0.08566224618958514, 0.18038078652406936, 0.23395696728634552};
    constexpr double bell[9] = {1.0, -1.0, 1.0 / 2, -1.0 / 6, 1.0 / 24, -1.0 / 120, 1.0 / 720, -1.0 / 5040, 1.0 / 40320};
    constexpr double even[5] = {1.0, 1.0 / 2, 1.0 / 24, 1.0 / 720, 1.0 / 40320};
    constexpr double odd[5] = {1.0, 1.0 / 6, 1.0 / 120, 1.0 / 5040, 1.0 / 362880};
    for (int j = 0; j < 5; j++) S[j] = X{};
    for (int k = 0; k < 3; k++) {
        const double t = node[k], t2 = t * t;
        const X u = w * t, mu = m * u, y = mu * mu;
        const X f = (2.0 * weight[k]) * polynomial4(bell, 0.5 * u * u);
        const X g = f * polynomial4(even, y), h = f * mu * polynomial4(odd, y);
        S[0] += g;
        S[1] -= t * h;
        S[2] += t2 * g;
        S[3] -= t * t2 * h;
        S[4] += t2 * t2 * g;
    }
}

// How much is asked of a factor: mean and variance; evidence and slopes as well; third and fourth cumulant as well.
enum Depth { moments, evidence, cumulants };

// N(mu, c) cut to [lo, hi]. A call within would spill every register: all of it is one body.
template <int depth, class X>
#if defined(__GNUC__)
__attribute__((flatten))
#endif
inline Truncated<X> cut4(const Cavity<X>& from, X lo, X hi) {
    constexpr double far = 1e90, half_log_2pi = 0.5 * log_2pi, root_2pi = 2.5066282746310005024;
    const X zero{}, sd = from.sd, scale = from.scale;
    const X width = hi - lo;
    const X lower = min4(max4((lo - from.mu) * scale, all<X>(-far)), all<X>(far));
    const X upper = min4(max4((hi - from.mu) * scale, all<X>(-far)), all<X>(far));
    const auto flip = lower + upper < zero;
    const X a = flip ? -upper : lower, b = flip ? -lower : upper;  // b >= |a|
    const X w = min4(width * scale, all<X>(2.0 * far));
    const X ref = max4(a, zero);  // where the Gaussian is highest in the box
    const auto beyond = a >= zero;
    const X drop = beyond ? w * (a + 0.5 * w) : 0.5 * b * b;
    const X Ea = exp4(0.5 * (ref - a) * (ref + a)), Eb = exp4(-drop);  // densities at the ends over that at ref
    const auto narrow = drop <= (beyond ? all<X>(0.25) : all<X>(0.03));

    const bool deep = any4((a > all<X>(4.0)) & ~narrow), thin = any4(narrow);
    const X near_5 = abs4(a) + 5.0, far_5 = b + 5.0, both = over4(near_5 * far_5);
    const Tail<X> A = tail4(abs4(a), far_5 * both, deep), B = tail4(b, near_5 * both, deep);
    X Z = beyond ? A.i0 - Eb * B.i0 : root_2pi - Ea * A.i0 - Eb * B.i0;  // over the density at ref
    X S[5];
    const X middle = beyond ? a + 0.5 * w : 0.5 * (a + b);
    if (thin) narrow4(middle, w, S);
    const X over = over4(thin ? (narrow ? S[0] : Z) : Z), pa = Ea * over, pb = Eb * over;
    // moments of the distance from the end a (or, inside, from mu), standardised
    const X t1 = beyond ? (A.i1 - Eb * (w * B.i0 + B.i1)) * over : pa - pb;
    const X t2 = beyond ? (A.i2 - Eb * (w * (w * B.i0 + 2.0 * B.i1) + B.i2)) * over : 1.0 + a * pa - b * pb;
    const X v = min4(max4(t2 - t1 * t1, zero), all<X>(1.0));
    const X sign = flip ? all<X>(-1.0) : all<X>(1.0), end = flip ? hi : lo;
    X mean = (beyond ? end : from.mu) + sign * sd * t1, var = from.c * v;
    Truncated<X> r;
    if (depth == cumulants) {  // by parts; skewness and kurtosis of what is log-concave are bounded
        const X t3 = 2.0 * t1 + (beyond ? -w * w * pb - a * t2 : a * a * pa - b * b * pb);
        const X t4 = 3.0 * t2 + (beyond ? -w * w * w * pb - a * t3 : a * a * a * pa - b * b * b * pb);
        const X v2 = v * v, m3 = t3 - 3.0 * t1 * t2 + 2.0 * t1 * t1 * t1;
        const X m4 = t4 - 4.0 * t1 * t3 + 6.0 * t1 * t1 * t2 - 3.0 * t1 * t1 * t1 * t1;
        const X most = 2.0 * v * sqrt4(v);
        r.k3 = sign * sd * from.c * min4(max4(m3, -most), most);
        r.k4 = from.c * from.c * min4(max4(m4 - 3.0 * v2, -1.2 * v2), 6.0 * v2);
    }
    X density = Z / w;  // mean one, over that at ref
    if (thin) {
        const X s1 = S[1] * over, s2 = S[2] * over, w2 = width * width;
        const X own = max4(s2 - s1 * s1, zero);
        mean = narrow ? end + sign * width * (0.5 + s1) : mean;
        var = narrow ? w2 * own : var;
        if (depth >= evidence) {
            density = narrow ? S[0] * exp4(beyond ? -0.5 * w * (a + 0.25 * w) : -0.5 * middle * middle) : density;
            Z = narrow ? w * density : Z;
        }
        if (depth == cumulants) {
            const X s3 = S[3] * over, s4 = S[4] * over;
            r.k3 = narrow ? sign * width * w2 * (s3 - 3.0 * s1 * s2 + 2.0 * s1 * s1 * s1) : r.k3;
            r.k4 = narrow ? w2 * w2 * (s4 - 4.0 * s1 * s3 + 6.0 * s1 * s1 * s2 - 3.0 * s1 * s1 * s1 * s1 - 3.0 * own * own)
                          : r.k4;
        }
    }
    r.mean = min4(max4(mean, lo), hi);
    r.var = from.c > zero ? var : zero;
    if (depth >= evidence) {
        r.log_top = -0.5 * ref * ref - half_log_2pi;
        r.mass = Z;
        r.dense = density * scale;
        const X one = scale / max4(Z, all<X>(smallest)), near = Ea * one, away = Eb * one;
        r.at_lo = flip ? away : near;
        r.at_hi = flip ? near : away;
    }
    return r;
}
template <class X>
inline Truncated<X> truncated4(X mu, X c, X lo, X hi) {
    return cut4<evidence>(cavity4(mu, c), lo, hi);
}

// d over the standard deviation, held where its square would overflow
template <class X>
inline X standardised4(X d, X scale) {
    return min4(max4(d * scale, all<X>(-1e90)), all<X>(1e90));
}

// f = N(z; 0, R): exact
template <int depth, class X>
inline Tilted<X> gaussian4(const Cavity<X>& q, X R) {
    const X over = 1.0 / max4(q.c + R, all<X>(1e-300)), share = R * over;
    Tilted<X> r{};
    r.mean = q.mu * share;
    r.var = q.c * share;
    if (depth >= evidence) {
        const X d = standardised4(q.mu, sqrt4(over)), d2 = d * d;
        r.log_z = -0.5 * (log_2pi - log4(over) + d2);
        r.slope_R = 0.5 * share * (d2 - 1.0);
    }
    return r;
}

// f = uniform on [-s, s]; s = 0 is the point 0
template <int depth, class X>
inline Tilted<X> uniform4(const Cavity<X>& q, X s) {
    const Truncated<X> t = cut4<depth>(q, -s, s);
    Tilted<X> r{};
    r.mean = t.mean;
    r.var = t.var;
    if (depth >= evidence) {
        r.log_z = t.log_mean();
        r.slope_s = s > X{} ? s * (t.at_lo + t.at_hi) - 1.0 : X{};
    }
    if (depth == cumulants) {
        r.k3 = t.k3;
        r.k4 = t.k4;
    }
    return r;
}

// f = uniform on [-s, s] plus N(0, R): v = z + noise is N(mu, c + R) cut to the box, and z given v is Gaussian
template <int depth, class X>
inline Tilted<X> uniform_gaussian4(const Cavity<X>& q, X s, X R) {
    const Cavity<X> sum = cavity4(q.mu, max4(q.c + R, all<X>(1e-300)));
    const X over = sum.scale * sum.scale, gain = q.c * over;
    const Truncated<X> t = cut4<depth>(sum, -s, s);
    Tilted<X> r{};
    const X d = t.mean - q.mu;
    r.mean = q.mu + gain * d;
    r.var = gain * (R + gain * t.var);
    if (depth >= evidence) {
        r.log_z = t.log_mean();
        r.slope_s = s > X{} ? s * (t.at_lo + t.at_hi) - 1.0 : X{};
        const X e = standardised4(d, sum.scale);
        r.slope_R = 0.5 * (R * over) * (e * e + t.var * over - 1.0);
    }
    if (depth == cumulants) {
        r.k3 = gain * gain * gain * t.k3;
        r.k4 = gain * gain * gain * gain * t.k4;
    }
    return r;
}

// two explanations of one row, the second with probability eps
template <int depth, class X>
inline Tilted<X> mixture4(const Tilted<X>& f, const Tilted<X>& g, X eps) {
    const X one = f.log_z + log4(1.0 - eps), two = g.log_z + log4(eps);
    const X top = max4(one, two), low = min4(one, two);
    const X e = exp4(low - top), less = e / (1.0 + e);
    const X p = two > one ? 1.0 - less : less, rest = 1.0 - p;
    Tilted<X> r{};
    r.log_z = top + log4(1.0 + e);
    const X d = g.mean - f.mean;
    r.mean = f.mean + p * d;
    r.var = rest * f.var + p * g.var + p * rest * d * d;
    r.slope_s = rest * f.slope_s + p * g.slope_s;
    r.slope_R = rest * f.slope_R + p * g.slope_R;
    r.slope_eps = p - eps;
    r.out = p;
    if (depth == cumulants) {
        const X a = f.mean - r.mean, b = g.mean - r.mean;
        const X f4 = f.k4 + 3.0 * f.var * f.var, g4 = g.k4 + 3.0 * g.var * g.var;
        r.k3 = rest * (f.k3 + 3.0 * a * f.var + a * a * a) + p * (g.k3 + 3.0 * b * g.var + b * b * b);
        r.k4 = rest * (f4 + 4.0 * a * f.k3 + 6.0 * a * a * f.var + a * a * a * a) +
               p * (g4 + 4.0 * b * g.k3 + 6.0 * b * b * g.var + b * b * b * b) - 3.0 * r.var * r.var;
    }
    return r;
}
// the weights of two explanations come from their evidence
constexpr int weighed(int depth) { return depth == moments ? int(evidence) : depth; }

// f = (1 - eps) (uniform on [-s, s] plus N(0, R)) + eps N(0, (wide s)^2 + R): outliers
template <int depth, class X>
inline Tilted<X> contaminated4(const Cavity<X>& q, X s, X R, X eps, X wide) {
    const X W = wide * wide * s * s, both = W + R;
    Tilted<X> g = gaussian4<weighed(depth)>(q, both);
    const X slope = g.slope_R / max4(both, all<X>(1e-300));
    g.slope_s = 2.0 * slope * W;
    g.slope_R = slope * R;
    return mixture4<depth>(uniform_gaussian4<weighed(depth)>(q, s, R), g, eps);
}

// f = (1 - eps) (uniform on [-s, s] plus N(0, R)) + eps exp(log_lost): a row that may say nothing of z
template <int depth, class X>
inline Tilted<X> maybe_lost4(const Cavity<X>& q, X s, X R, X eps, X log_lost) {
    Tilted<X> g{};
    g.log_z = log_lost;
    g.mean = q.mu;
    g.var = q.c;
    return mixture4<depth>(uniform_gaussian4<weighed(depth)>(q, s, R), g, eps);
}

}  // namespace HW_ISA
}  // namespace hw
