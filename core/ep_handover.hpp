// What a solved window of a stream takes over from the one before, and what it hands on: plain numbers, no lanes.
//
// Half-widths: what other rows told of them is a factor s^power exp(pull's - s'precision s / 2) over all of them, of which
// a window takes the part of its free ones (`ep_taken`). What its own rows tell (`ep_told`) has
//
//     precision = -Cov(g - power / s, s) Cov(s)^-1,    pull = E (g - power / s) + precision E s,    g = d log Z / ds,
//
// the moments being those of the posterior over s, the weighted nodes, and power_j by regression of g_j on s and 1 / s_j, no
// less than 0 and no more than leaves a Gaussian that falls. A half-width that is well seen has a power and next to no
// precision. One that drowns in other noise has no power: it is felt through its variance, s^2. So what windows tell whose
// posterior is wide is true where later ones find it.
// What log Z lacks to second order has no slope of its own: pull gets that of a line through the nodes,
// Cov(s)^-1 Cov(s, second).
// State: the forwards message of the sites (`ep_edge`), of which a later window takes the one before its first row.
// Sites: those of the rows that two windows share (`ep_moved`).
#pragma once

#include "ep_entry.hpp"
#include "small.hpp"

namespace hw {
namespace HW_ISA {

// share of the variance of 1 / s that no line in s may explain, for the nodes to tell a power
constexpr double ep_bent = 1e-3;

// A (n,n) symmetric -> its eigenvalues on the diagonal, V (n,n) its eigenvectors as columns; cyclic rotations (Jacobi)
inline void ep_eigen(int n, double* A, double* V) {
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) V[i * n + j] = i == j ? 1.0 : 0.0;
    for (int round = 0; round < 30; round++) {
        double off = 0.0, on = 0.0;
        for (int i = 0; i < n; i++) {
            on += A[i * n + i] * A[i * n + i];
            for (int j = 0; j < i; j++) off += A[i * n + j] * A[i * n + j];
        }
        if (!(off > 1e-34 * on)) return;
        for (int p = 0; p < n; p++)
            for (int q = p + 1; q < n; q++) {
                const double apq = A[p * n + q];
                if (apq == 0.0) continue;
                const double theta = 0.5 * (A[q * n + q] - A[p * n + p]) / apq;
                const double t = (theta >= 0 ? 1.0 : -1.0) / (std::fabs(theta) + std::sqrt(theta * theta + 1.0));
                const double c = 1.0 / std::sqrt(t * t + 1.0), s = t * c;
                for (int k = 0; k < n; k++) {
                    const double x = A[k * n + p], y = A[k * n + q];
                    A[k * n + p] = c * x - s * y;
                    A[k * n + q] = s * x + c * y;
                }
                for (int k = 0; k < n; k++) {
                    const double x = A[p * n + k], y = A[q * n + k];
                    A[p * n + k] = c * x - s * y;
                    A[q * n + k] = s * x + c * y;
                }
                for (int k = 0; k < n; k++) {
                    const double x = V[k * n + p], y = V[k * n + q];
                    V[k * n + p] = c * x - s * y;
                    V[k * n + q] = s * x + c * y;
                }
            }
    }
}

// Whether A (n,n), symmetric with a diagonal of about 1, is safely positive definite; L (n,n)
inline bool ep_definite(int n, const double* A, double* L) {
    for (int j = 0; j < n; j++) {
        double pivot = A[j * n + j];
        for (int k = 0; k < j; k++) pivot -= L[j * n + k] * L[j * n + k];
        if (!(pivot > 1e-6)) return false;
        L[j * n + j] = std::sqrt(pivot);
        for (int i = j + 1; i < n; i++) {
            double s = A[i * n + j];
            for (int k = 0; k < j; k++) s -= L[i * n + k] * L[j * n + k];
            L[i * n + j] = s / L[j * n + j];
        }
    }
    return true;
}

// What is known of the free ones of p half-widths alone, whatever the others are, as a proper Gaussian: found_pull (p,),
// found_precision (p,p), 0 at the others. work (4 p^2 + 4 p)
inline void ep_marginal(int p, const bool* free, const double* pull, const double* precision, double* found_pull,
                     double* found_precision, double* work) {
    double *A = work, *V = A + p * p, *H = V + p * p, *gain = H + p * p, *h = gain + p * p, *unit = h + p, *turned = unit + p;
    int f = 0, r = 0, at[2] = {0, 0};
    bool any = false;
    for (int i = 0; i < p; i++) (free[i] ? f : r)++;
    // free ones first
    double* order = turned + p;
    for (int i = 0; i < p; i++) order[free[i] ? at[0]++ : f + at[1]++] = i;
    const auto old = [&](int i) { return static_cast<int>(order[i]); };
    for (int i = 0; i < p; i++) {
        found_pull[i] = 0.0;
        for (int j = 0; j < p; j++) found_precision[i * p + j] = 0.0;
    }
    for (int i = 0; i < f; i++) {
        h[i] = pull[old(i)];
        for (int j = 0; j < f; j++) H[i * f + j] = precision[old(i) * p + old(j)];
    }
    for (int i = 0; i < r; i++)
        for (int j = 0; j < p; j++) any = any || precision[old(f + i) * p + j] != 0.0;
    if (any) {  // Schur complement by the generalised inverse of the others' block
        double top = 0.0;
        for (int i = 0; i < r; i++)
            for (int j = 0; j < r; j++)
                A[i * r + j] = 0.5 * (precision[old(f + i) * p + old(f + j)] + precision[old(f + j) * p + old(f + i)]);
        ep_eigen(r, A, V);
        for (int k = 0; k < r; k++) top = max2(top, std::fabs(A[k * r + k]));
        for (int i = 0; i < f; i++)
            for (int j = 0; j < r; j++) {
                double g = 0.0;
                for (int k = 0; k < r; k++) {
                    if (!(std::fabs(A[k * r + k]) > 1e-15 * top)) continue;
                    double c = 0.0;
                    for (int l = 0; l < r; l++) c += precision[old(i) * p + old(f + l)] * V[l * r + k];
                    g += c / A[k * r + k] * V[j * r + k];
                }
                gain[i * r + j] = g;
            }
        for (int i = 0; i < f; i++)
            for (int k = 0; k < r; k++) {
                h[i] -= gain[i * r + k] * pull[old(f + k)];
                for (int j = 0; j < f; j++) H[i * f + j] -= gain[i * r + k] * precision[old(f + k) * p + old(j)];
            }
    }
    for (int i = 0; i < f; i++) {  // units in which eigenvalues compare
        const double d = std::sqrt(std::fabs(H[i * f + i]));
        unit[i] = d > 0.0 ? d : 1.0;
    }
    for (int i = 0; i < f; i++)
        for (int j = 0; j < f; j++) A[i * f + j] = 0.5 * (H[i * f + j] + H[j * f + i]) / (unit[i] * unit[j]);
    if (ep_definite(f, A, V)) {  // proper as it is
        for (int i = 0; i < f; i++) {
            found_pull[old(i)] = h[i];
            for (int j = 0; j < f; j++) found_precision[old(i) * p + old(j)] = 0.5 * (H[i * f + j] + H[j * f + i]);
        }
        return;
    }
    ep_eigen(f, A, V);
    for (int k = 0; k < f; k++) {
        turned[k] = 0.0;
        for (int i = 0; i < f; i++) turned[k] += V[i * f + k] * h[i] / unit[i];
    }
    for (int k = 0; k < f; k++) {
        const double value = A[k * f + k];
        if (!(value > 0.0)) continue;  // a direction that only curves the other way says nothing
        for (int i = 0; i < f; i++) {
            const double b = V[i * f + k] * unit[i];
            found_pull[old(i)] += b * turned[k];
            for (int j = 0; j < f; j++) found_precision[old(i) * p + old(j)] += b * value * V[j * f + k] * unit[j];
        }
    }
}

// What a window takes of what is known of p half-widths: found_pull (p,), found_precision (p,p), found_power (p,). It is made
// proper with the powers to second order in s about the start (p,); one stays a power where a falling Gaussian is left
// beside it. work (5 p (p + 1))
inline void ep_taken(int p, const bool* free, const double* start, const double* pull, const double* precision, const double* power,
                     double* found_pull, double* found_precision, double* found_power, double* work) {
    double *whole = work, *whole_precision = whole + p;
    const auto curve_of = [&](int i) {
        const double curve = power[i] / (start[i] * start[i]);
        return free[i] && power[i] > 0.0 && finite(curve) ? curve : 0.0;
    };
    for (int i = 0; i < p; i++) {
        whole[i] = pull[i] + 2.0 * curve_of(i) * start[i];
        for (int j = 0; j < p; j++) whole_precision[i * p + j] = precision[i * p + j] + (i == j ? curve_of(i) : 0.0);
    }
    ep_marginal(p, free, whole, whole_precision, found_pull, found_precision, work + p * (p + 1));
    for (int i = 0; i < p; i++) {
        found_power[i] = 0.0;
        const double curve = curve_of(i), left = found_precision[i * p + i] - curve;
        if (!(curve > 0.0 && left >= 0.0)) continue;
        found_power[i] = power[i];
        found_precision[i * p + i] = left;
        found_pull[i] -= 2.0 * curve * start[i];
    }
}

// Weights (count,) of nodes that sum to 1, the logarithms flattened by `flat`; returns their effective number.
inline double ep_weights(int count, const double* log_weight, const bool* keep, double flat, double* w) {
    double top = -__builtin_inf(), sum = 0.0, square = 0.0;
    for (int k = 0; k < count; k++)
        if (!keep || keep[k]) top = max2(top, log_weight[k]);
    for (int k = 0; k < count; k++) {
        w[k] = keep && !keep[k] ? 0.0 : std::exp(flat * (log_weight[k] - top));
        sum += w[k];
    }
    for (int k = 0; k < count; k++) {
        w[k] /= sum;
        square += w[k] * w[k];
    }
    return 1.0 / square;
}

// Mean, sd, 5 and 95 % quantile of the half-widths, each (groups,) of which only the free ones are written; rate of
// outliers if it is a parameter; the effective number of nodes. work (2 count)
inline void ep_widths(const EpLearnArgs& a, int q, double* work) {
    const int K = *a.used, p = a.base.groups;
    double *w = work, *order = w + K;
    w[0] = 1.0;
    *a.effective = K > 1 ? ep_weights(K, a.log_weight, nullptr, 1.0, w) : 1.0;
    double H[ep_free * ep_free], L[ep_free * ep_free], pivot[ep_free], inverse[ep_free];
    if (K == 1) {  // one node stands for a narrow posterior: its width is that of the Gaussian at the mode
        for (int i = 0; i < q * q; i++) H[i] = a.H[i];
        ldl(Dim<0>(q), H, L, pivot, inverse);
    }
    int j = 0;
    for (int g = 0; g < p; g++) {
        if (!a.free[g]) continue;
        const double power = a.squared[g] ? 2.0 : 1.0;
        const auto s = [&](int k) { return std::exp(power * a.phi[k * q + j]); };
        double m = 0.0, v = 0.0;
        for (int k = 0; k < K; k++) m += w[k] * s(k);
        for (int k = 0; k < K; k++) v += w[k] * (s(k) - m) * (s(k) - m);
        if (K == 1) {
            double column[ep_free] = {};
            column[j] = 1.0;
            ldl_solve(Dim<0>(q), Dim<1>(), L, inverse, column);
            v = power * power * m * m * column[j];
        }
        a.mean[g] = m;
        a.sd[g] = std::sqrt(v);
        a.quantile_lo[g] = max2(m - 1.645 * a.sd[g], 0.0);
        a.quantile_hi[g] = m + 1.645 * a.sd[g];
        if (K > 1) {
            for (int k = 0; k < K; k++) order[k] = k;
            const auto at = [&](int k) { return a.phi[static_cast<int>(order[k]) * q + j]; };
            for (int gap = K / 2; gap > 0; gap /= 2)  // Shell's sort
                for (int k = gap; k < K; k++)
                    for (int l = k; l >= gap && at(l - gap) > at(l); l -= gap) {
                        const double swap = order[l];
                        order[l] = order[l - gap];
                        order[l - gap] = swap;
                    }
            double below = 0.0;
            int low = -1, high = K - 1;
            for (int k = 0; k < K; k++) {
                below += w[static_cast<int>(order[k])];
                if (low < 0 && below >= 0.05) low = k;
                if (below >= 0.95) {
                    high = k;
                    break;
                }
            }
            a.quantile_lo[g] = std::exp(power * at(low < 0 ? high : low));
            a.quantile_hi[g] = std::exp(power * at(high));
        }
        j++;
    }
    if (a.learn_eps) {
        *a.found_rate = 0.0;
        for (int k = 0; k < K; k++) *a.found_rate += w[k] / (1.0 + std::exp(-a.phi[k * q + j]));
    }
}

// What the rows of the window tell of its half-widths: told_pull (groups,), told_precision (groups,groups), told_power.
// work (count (2 q + 2))
inline void ep_told(const EpLearnArgs& a, int q, double* work) {
    const int K = *a.used, p = a.base.groups;
    int group[ep_free], f = 0;
    for (int g = 0; g < p; g++) {
        if (a.free[g]) group[f++] = g;
        a.told_pull[g] = a.told_power[g] = 0.0;
        for (int i = 0; i < p; i++) a.told_precision[g * p + i] = 0.0;
    }
    if (f == 0) return;
    double *w = work, *s = w + K, *d = s + std::ptrdiff_t(K) * f;
    bool* keep = reinterpret_cast<bool*>(d + std::ptrdiff_t(K) * f);
    int sound = 0;
    for (int k = 0; k < K; k++) {
        keep[k] = finite(a.log_weight[k]);
        for (int j = 0; j < f; j++) {
            s[k * f + j] = std::exp(a.phi[k * q + j]);
            d[k * f + j] = a.node_slope[k * q + j] / s[k * f + j];
            keep[k] = keep[k] && finite(d[k * f + j]);
        }
        sound += keep[k];
    }
    double H[ep_free * ep_free] = {}, pull[ep_free] = {}, power[ep_free] = {};
    if (K == 1) {
        for (int i = 0; i < f; i++)
            for (int j = 0; j < f; j++) {
                H[i * f + j] = a.H[i * q + j] / (s[i] * s[j]);
                if (!a.pull) continue;
                H[i * f + j] -= a.precision[group[i] * p + group[j]] + (i == j ? a.known_power[group[i]] / (s[i] * s[i]) : 0.0);
            }
        for (int i = 0; i < f; i++) {
            pull[i] = d[i];
            for (int j = 0; j < f; j++) pull[i] += H[i * f + j] * s[j];
        }
    } else {
        if (sound < 2 * f + 2) return;  // so few would be gone through, not averaged
        constexpr double flatter[4] = {1.0, 0.5, 0.25, 0.0};
        for (const double flat : flatter)  // few nodes carry the weight: they alone cannot tell a slope
            if (ep_weights(K, a.log_weight, keep, flat, w) > 2.0 * f + 2.0) break;
        // moments: means of s, d and 1 / s; covariances of s with second, s, d and 1 / s; of 1 / s_j with itself and with d_j
        double mean[ep_free] = {}, level[ep_free] = {}, over[ep_free] = {}, more[ep_free] = {}, own[ep_free] = {}, with[ep_free] = {};
        double S[ep_free * ep_free] = {}, X[ep_free * ep_free] = {}, Y[ep_free * ep_free] = {}, B[ep_free * ep_free];
        double L[ep_free * ep_free], pivot[ep_free], inverse[ep_free];
        for (int k = 0; k < K; k++)
            if (keep[k])
                for (int j = 0; j < f; j++) {
                    mean[j] += w[k] * s[k * f + j];
                    level[j] += w[k] * d[k * f + j];
                    over[j] += w[k] / s[k * f + j];
                }
        for (int k = 0; k < K; k++)
            if (keep[k])
                for (int i = 0; i < f; i++)
                    for (int j = 0; j < f; j++) {
                        const double ds = w[k] * (s[k * f + i] - mean[i]), other = 1.0 / s[k * f + j] - over[j];
                        if (j == 0) more[i] += ds * a.second[k];
                        S[i * f + j] += ds * (s[k * f + j] - mean[j]);
                        X[i * f + j] += ds * (d[k * f + j] - level[j]);
                        Y[i * f + j] += ds * other;
                        if (i == j) {
                            own[j] += w[k] * other * other;
                            with[j] += w[k] * other * (d[k * f + j] - level[j]);
                        }
                    }
        for (int j = 0; j < f; j++) S[j * f + j] *= 1.0 + 1e-6;
        ldl(Dim<0>(f), S, L, pivot, inverse);
        for (int i = 0; i < f * f; i++) B[i] = Y[i];
        ldl_solve(Dim<0>(f), Dim<0>(f), L, inverse, B);
        ldl_solve(Dim<0>(f), Dim<0>(f), L, inverse, X);
        for (int j = 0; j < f && sound >= 2 * f + 4; j++) {
            double left = own[j], felt = with[j];  // of what no line in s explains
            for (int i = 0; i < f; i++) {
                left -= Y[i * f + j] * B[i * f + j];
                felt -= Y[i * f + j] * X[i * f + j];
            }
            const double falls = X[j * f + j] / B[j * f + j];  // a power that leaves no Gaussian beside it
            if (!(left > ep_bent * own[j] && felt > 0.0 && falls > 0.0 && B[j * f + j] < 0.0)) continue;
            power[j] = min2(felt / left, falls);
            level[j] -= power[j] * over[j];
            for (int i = 0; i < f; i++) X[i * f + j] -= power[j] * B[i * f + j];
        }
        ldl_solve(Dim<0>(f), Dim<1>(), L, inverse, more);
        for (int i = 0; i < f; i++)
            for (int j = 0; j < f; j++) H[i * f + j] = -0.5 * (X[i * f + j] + X[j * f + i]);
        for (int i = 0; i < f; i++) {
            pull[i] = level[i] + more[i];
            for (int j = 0; j < f; j++) pull[i] += H[i * f + j] * mean[j];
        }
    }
    for (int i = 0; i < f * f; i++)
        if (!finite(H[i])) return;
    for (int i = 0; i < f; i++)
        if (!finite(pull[i]) || !finite(power[i])) return;
    for (int i = 0; i < f; i++) {
        a.told_pull[group[i]] = pull[i];
        a.told_power[group[i]] = power[i];
        for (int j = 0; j < f; j++) a.told_precision[group[i] * p + group[j]] = H[i * f + j];
    }
}

// Whether the moments of the states are numbers; a shape that is none is that of a Gaussian.
inline bool ep_sound(const EpLearnArgs& a) {
    const std::ptrdiff_t size = std::ptrdiff_t(a.base.T + 1) * a.base.n;
    bool sound = true;
    for (std::ptrdiff_t k = 0; k < size; k++) {
        sound = sound && finite(a.x[k]);
        if (!finite(a.k3[k])) a.k3[k] = 0.0;
        if (!finite(a.k4[k])) a.k4[k] = 0.0;
    }
    for (std::ptrdiff_t k = 0; k < size * a.base.n; k++) sound = sound && finite(a.P[k]);
    return sound;
}

// Mean (T+1,n) and covariance (T+1,n,n) of x_t given what lies up to t, by the sites m, D, tau, nu of member 0; own (n,):
// variances of what w has besides. work (4 n^2 + 2 n)
inline void ep_edge(const EpArgs& a, const double* own, const double* m, const double* D, const double* tau, const double* nu, double* found_x,
                    double* found_P, double* work) {
    const int n = a.n;
    double *AP = work, *GD = AP + n * n, *x = GD + n * n, *P = x + n, *Ph = P + n * n;
    for (int i = 0; i < n; i++) {
        x[i] = a.m0[i] + m[i];
        for (int j = 0; j < n; j++) P[i * n + j] = a.P0[i * n + j] + (i == j ? D[i] : 0.0);
    }
    const auto at = [&](const EpStack& s, int t) { return s.data + std::ptrdiff_t(s.index ? s.index[t] : s.count == 1 ? 0 : t) * n * n; };
    for (int t = 0; t <= a.T; t++) {
        if (t > 0) {
            const double *A = at(a.A, t - 1), *G = a.G.data ? at(a.G, t - 1) : nullptr, *b = a.b.data + std::ptrdiff_t(t - 1) * n;
            const double *Dt = D + std::ptrdiff_t(t) * n, *mt = m + std::ptrdiff_t(t) * n;
            const double* before = found_x + std::ptrdiff_t(t - 1) * n;
            for (int i = 0; i < n; i++) {
                x[i] = b[i] + (G ? 0.0 : mt[i]);
                for (int j = 0; j < n; j++) {
                    x[i] += A[i * n + j] * before[j];
                    if (G) x[i] += G[i * n + j] * mt[j];
                    GD[i * n + j] = G ? G[i * n + j] * (Dt[j] + own[j]) : 0.0;
                    double s = 0.0;
                    for (int k = 0; k < n; k++) s += A[i * n + k] * P[k * n + j];
                    AP[i * n + j] = s;
                }
            }
            const double* Q = a.Q.data ? at(a.Q, t - 1) : nullptr;
            for (int i = 0; i < n; i++)
                for (int j = 0; j < n; j++) {
                    double s = (Q ? Q[i * n + j] : 0.0) + (!G && i == j ? Dt[i] + own[i] : 0.0);
                    for (int k = 0; k < n; k++) s += AP[i * n + k] * A[j * n + k] + (G ? GD[i * n + k] * G[j * n + k] : 0.0);
                    P[i * n + j] = s;
                }
        }
        for (int k = a.start[t]; k < a.start[t + 1]; k++) {
            const double* h = a.h.data + std::ptrdiff_t(k) * n;
            double v = 0.0, z = -a.y.data[k];
            for (int i = 0; i < n; i++) {
                double s = 0.0;
                for (int j = 0; j < n; j++) s += P[i * n + j] * h[j];
                Ph[i] = s;
                v += h[i] * s;
                z += h[i] * x[i];
            }
            const double left = 1.0 + tau[k] * v;
            if (!(left > 1e-9)) continue;
            const double shift = (nu[k] - tau[k] * z) / left, shrink = tau[k] / left;
            for (int i = 0; i < n; i++) {
                x[i] += Ph[i] * shift;
                for (int j = 0; j < n; j++) P[i * n + j] -= Ph[i] * Ph[j] * shrink;
            }
        }
        for (int i = 0; i < n; i++) {
            found_x[std::ptrdiff_t(t) * n + i] = x[i];
            for (int j = 0; j < n; j++) found_P[(std::ptrdiff_t(t) * n + i) * n + j] = 0.5 * (P[i * n + j] + P[j * n + i]);
        }
    }
}

// Which rows two windows share; false where they do not hold the same ones.
inline bool ep_shift(const EpArgs& b, EpBefore& w) {
    w.common = w.stages - 1 - w.drop;
    const bool first = w.drop == 0;  // the state before the first row is the same
    if ((w.common < 1 && !first) || w.common > b.T) return false;
    w.low = b.start[first ? 0 : 1];
    w.high = b.start[w.common + 1];
    w.there = w.start[first ? 0 : w.drop + 1];
    return w.high - w.low == w.start[w.stages] - w.there;
}
// place in the window before of w_ti, and of a row; -1: none
inline std::ptrdiff_t ep_origin(const EpBefore& w, int n, int t, int i) {
    return t > w.common || (t == 0 && w.drop > 0) ? -1 : std::ptrdiff_t(t + w.drop) * n + i;
}
inline std::ptrdiff_t ep_origin(const EpBefore& w, int k) { return k < w.low || k >= w.high ? -1 : w.there + k - w.low; }

// Sites of the mode of a window that begins `drop` rows after the one they are from, to the base's m, D, tau, nu: its new
// ones are the Gaussians of their variances.
inline void ep_moved(const EpLearnArgs& a) {
    const EpBefore& w = *a.before;
    const EpArgs& b = a.base;
    for (int t = 0; t <= b.T; t++)
        for (int i = 0; i < b.n; i++) {
            const std::ptrdiff_t to = std::ptrdiff_t(t) * b.n + i, from = ep_origin(w, b.n, t, i);
            const double s = t == 0 ? b.half0[i] : b.group_w[i] >= 0 ? a.start[b.group_w[i]] : 0.0;
            b.m[to] = from < 0 ? 0.0 : w.m[from];
            b.D[to] = from < 0 ? s * s / 3.0 : w.D[from];
        }
    for (int k = 0; k < b.rows; k++) {
        const std::ptrdiff_t from = ep_origin(w, k);
        const double s = b.group[k] >= 0 ? a.start[b.group[k]] : 0.0;
        const double r = b.group_R && b.group_R[k] >= 0 ? a.start[b.group_R[k]] : 0.0;
        const double first = b.kind[k] < noise_contaminated ? 1.0 / max2(s * s / 3.0 + r * r + b.R[k], 1e-300) : 0.0;
        b.tau[k] = from < 0 ? first : w.tau[from];
        b.nu[k] = from < 0 ? 0.0 : w.nu[from];
    }
}

}  // namespace HW_ISA
}  // namespace hw
