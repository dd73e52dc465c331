// One round of the chain that fills a vehicle's drive (vehicle/chain.py has its residuals): filter and smoother of drives
// that are linearised about given azimuths, and the expected squares of their residuals, from which noise is learnt.
//
//     z[t] = A z[t-1] + b + w[t],   w ~ N(0, Q),     fix[t] = (E + offset E, N + offset N) + e,   e ~ N(0, r I)
//
//     z = east, north, azimuth, offset east and north, scale, bias, drift east and north; and turn, where a yaw rate was
//     silent
//
// with S, C sine and cosine of the azimuth in the middle of a step of h seconds and d metres, and k = d / 2:
//
//     along    S dE + C dN - scale d = 0            aside    C dE - S dN - k d azimuth + d middle = k (what of it is yaw)
//     yaw      d azimuth - h (bias - size turn) + h w = 0
//     offset   offset[t] - keep offset[t-1] - h drift[t-1],      drift[t] - fade drift[t-1],      turn[t] - stay turn[t-1]
//
// The same sums of congruences as in kalman.hpp, so that nothing loses its sign: P <- Z P Z' + K r K' with Z = I - K C, and
// back P_s <- Z P Z' + G (P_s+ + Q) G' with Z = I - G A. The square of a residual g'w, given all fixes, is
//
//     E (g'w)^2 = (g'w of the means)^2 + u' (P_s+ + A P A') u + (g - u)' Q (g - u),     u = g - G' A' g
//
// (u is H'g with H = I - A G, and A G = I - H): the square of its mean, and its variance. A has about three entries a row
// and is never written down; what is symmetric is found once. Four drives go side by side, one in each lane, whatever
// their lengths: a drive that has ended repeats its last row and says nothing more.
#pragma once

#include "drive_entry.hpp"
#include "lane.hpp"
#include "lanes.hpp"

namespace hw {
namespace HW_ISA {

enum DriveState { d_e, d_n, d_azimuth, d_oe, d_on, d_scale, d_bias, d_de, d_dn, d_turn };

constexpr int abreast = drive_abreast;
using DriveLane = Lanes<abreast>;

// Numbers kept of each row for the way back: the filtered mean, and the lower half of its covariance.
constexpr int drive_row(int n) { return n + n * (n + 1) / 2; }

// A number of each lane's row.
template <class X>
inline DriveLane gathered(const X* a, const std::int64_t* at, int stride = 1, int first = 0) {
    static_assert(abreast == 4, "one entry for each lane");
    return DriveLane::of(DriveLane::Raw{double(a[at[0] * stride + first]), double(a[at[1] * stride + first]),
                                        double(a[at[2] * stride + first]), double(a[at[3] * stride + first])});
}

// The step into one row, of each lane.
template <int N>
struct DriveStep {
    using V = DriveLane;
    V h, d, w, middle, S, C, along, aside, yaw, keep, fade, q_offset, q_drift, q_scale, q_bias, turn, stay, q_turn;
    V E_azimuth, E_scale, E_bias, N_azimuth, N_scale, N_bias, half, aimed;  // entries of A; k; what b has along C, -S

    inline void read(const DriveArgs& a, const std::int64_t* at) {
        h = gathered(a.h, at);
        d = gathered(a.d, at);
        w = gathered(a.w, at);
        middle = gathered(a.middle, at);
        S = gathered(a.S, at);
        C = gathered(a.C, at);
        along = gathered(a.along, at);
        aside = gathered(a.aside, at);
        yaw = gathered(a.yaw, at);
        keep = gathered(a.keep, at);
        fade = gathered(a.fade, at);
        q_offset = gathered(a.q_offset, at);
        q_drift = gathered(a.q_drift, at);
        if constexpr (N > d_turn) {
            turn = gathered(a.turn, at);
            stay = gathered(a.stay, at);
            q_turn = gathered(a.q_turn, at);
        }
        q_scale = V(a.scale_walk) * h;
        q_bias = V(a.bias_walk) * h;
        half = V(0.5) * d;
        E_azimuth = C * d; E_scale = S * d; E_bias = half * C * h;
        N_azimuth = -(S * d); N_scale = C * d; N_bias = -(half * S * h);
        aimed = d * (V(-0.5) * h * w - middle);
    }
    // to = A from
    template <class From, class To>
    inline void forward(From from, To to) const {
        V bias = from(d_bias);
        if constexpr (N > d_turn) bias -= turn * from(d_turn);
        to(d_e, from(d_e) + E_azimuth * from(d_azimuth) + E_scale * from(d_scale) + E_bias * bias);
        to(d_n, from(d_n) + N_azimuth * from(d_azimuth) + N_scale * from(d_scale) + N_bias * bias);
        to(d_azimuth, from(d_azimuth) + h * bias);
        to(d_oe, keep * from(d_oe) + h * from(d_de));
        to(d_on, keep * from(d_on) + h * from(d_dn));
        to(d_scale, from(d_scale));
        to(d_bias, from(d_bias));
        to(d_de, fade * from(d_de));
        to(d_dn, fade * from(d_dn));
        if constexpr (N > d_turn) to(d_turn, stay * from(d_turn));
    }
    // to = A' from
    template <class From, class To>
    inline void back(From from, To to) const {
        const V bias = E_bias * from(d_e) + N_bias * from(d_n) + h * from(d_azimuth);
        to(d_e, from(d_e));
        to(d_n, from(d_n));
        to(d_azimuth, from(d_azimuth) + E_azimuth * from(d_e) + N_azimuth * from(d_n));
        to(d_oe, keep * from(d_oe));
        to(d_on, keep * from(d_on));
        to(d_scale, from(d_scale) + E_scale * from(d_e) + N_scale * from(d_n));
        to(d_bias, from(d_bias) + bias);
        to(d_de, h * from(d_oe) + fade * from(d_de));
        to(d_dn, h * from(d_on) + fade * from(d_dn));
        if constexpr (N > d_turn) to(d_turn, stay * from(d_turn) - turn * bias);
    }
    // to += b
    inline void add_b(V* to) const {
        to[d_e] += C * aimed;
        to[d_n] -= S * aimed;
        to[d_azimuth] -= h * w;
    }
    // P (N,N) += Q; the noise of the rotated residuals, in the axes of the state
    inline void add_Q(V (*P)[N]) const {
        const V across = aside + half * half * yaw, both = S * C * (along - across), turned = half * yaw;
        P[d_e][d_e] += S * S * along + C * C * across;
        P[d_n][d_n] += C * C * along + S * S * across;
        P[d_e][d_n] += both;
        P[d_n][d_e] += both;
        P[d_e][d_azimuth] += C * turned;
        P[d_azimuth][d_e] += C * turned;
        P[d_n][d_azimuth] -= S * turned;
        P[d_azimuth][d_n] -= S * turned;
        P[d_azimuth][d_azimuth] += yaw;
        P[d_oe][d_oe] += q_offset;
        P[d_on][d_on] += q_offset;
        P[d_scale][d_scale] += q_scale;
        P[d_bias][d_bias] += q_bias;
        P[d_de][d_de] += q_drift;
        P[d_dn][d_dn] += q_drift;
        if constexpr (N > d_turn) P[d_turn][d_turn] += q_turn;
    }
    // g' Q g
    inline V noise(const V* g) const {
        const V l = S * g[d_e] + C * g[d_n], s = C * g[d_e] - S * g[d_n], y = g[d_azimuth] + half * s;
        V sum = along * l * l + aside * s * s + yaw * y * y;
        sum += q_offset * (g[d_oe] * g[d_oe] + g[d_on] * g[d_on]) + q_drift * (g[d_de] * g[d_de] + g[d_dn] * g[d_dn]);
        sum += q_scale * g[d_scale] * g[d_scale] + q_bias * g[d_bias] * g[d_bias];
        if constexpr (N > d_turn) sum += q_turn * g[d_turn] * g[d_turn];
        return sum;
    }
    // P <- A P A', and AP of the P that was
    inline void predict(V (*P)[N], V (*AP)[N]) const {
        for (int j = 0; j < N; j++)
            forward([&](int k) { return P[k][j]; }, [&](int k, V v) { AP[k][j] = v; });
        for (int i = 0; i < N; i++)
            forward([&](int k) { return AP[i][k]; }, [&](int k, V v) { if (k <= i) P[i][k] = v; });
        for (int i = 0; i < N; i++)
            for (int j = 0; j < i; j++) P[j][i] = P[i][j];
    }
};

// Adds the lower half of X'Y, which is symmetric, to both halves of P (N,N).
template <int N, int I = 0>
[[gnu::always_inline]] inline void add_half(const DriveLane (*X)[N], const DriveLane (*Y)[N], DriveLane (*P)[N]) {
    if constexpr (I < N) {
        DriveLane row[I + 1];
        for (int j = 0; j <= I; j++) row[j] = P[I][j];
        for (int k = 0; k < N; k++)
            for (int j = 0; j <= I; j++) row[j] += X[k][I] * Y[k][j];
        for (int j = 0; j <= I; j++) P[I][j] = P[j][I] = row[j];
        add_half<N, I + 1>(X, Y, P);
    }
}

// to = X Y
template <int N>
inline void product(const DriveLane (*X)[N], const DriveLane (*Y)[N], DriveLane (*to)[N]) {
    for (int i = 0; i < N; i++) {
        DriveLane row[N];
        for (int j = 0; j < N; j++) row[j] = X[i][0] * Y[0][j];
        for (int k = 1; k < N; k++)
            for (int j = 0; j < N; j++) row[j] += X[i][k] * Y[k][j];
        for (int j = 0; j < N; j++) to[i][j] = row[j];
    }
}

// 1 / pivot, or 0 where it is only rounding noise of the diagonal entry it is what is left of, as in small.hpp.
inline DriveLane pivot(int n, DriveLane left, DriveLane was) {
    const DriveLane least = larger(DriveLane(16.0 * eps * (n + 1)) * was, DriveLane(smallest));
    return where_positive(left - least, DriveLane(1.0) / left, DriveLane(0.0));
}

// Where a variance fell to rounding noise of what it was that state is now certain, and what cancelled is taken for 0:
// its row and column are those of `rest` (i, j), which was not found by cancellation.
template <int N, class Rest>
inline void clear(const DriveLane* was, DriveLane (*P)[N], Rest rest) {
    constexpr double rounding = 64.0 * eps;
    for (int i = 0; i < N; i++) {
        if (!any4(P[i][i].v < rounding * was[i].v)) continue;
        const DriveLane gone = DriveLane(rounding) * was[i] - P[i][i];
        for (int j = 0; j < N; j++) P[i][j] = P[j][i] = where_positive(gone, rest(i, j), P[i][j]);
    }
}

// X <- P^-1 X; P (N,N) is left as its factor L D L'.
template <int N>
inline void solve_in_place(DriveLane (*P)[N], DriveLane (*X)[N]) {
    DriveLane inverse[N];
    for (int j = 0; j < N; j++) {
        DriveLane left = P[j][j], scaled[N];
        for (int k = 0; k < j; k++) {
            scaled[k] = P[j][k] * P[k][k];
            left -= P[j][k] * scaled[k];
        }
        inverse[j] = pivot(N, left, P[j][j]);
        P[j][j] = where_positive(inverse[j], left, DriveLane(0.0));
        for (int i = j + 1; i < N; i++) {
            DriveLane v = P[i][j];
            for (int k = 0; k < j; k++) v -= P[i][k] * scaled[k];
            P[i][j] = v * inverse[j];
        }
    }
    for (int i = 0; i < N; i++) {
        DriveLane row[N];
        for (int j = 0; j < N; j++) row[j] = X[i][j];
        for (int k = 0; k < i; k++)
            for (int j = 0; j < N; j++) row[j] -= P[i][k] * X[k][j];
        for (int j = 0; j < N; j++) X[i][j] = row[j];
    }
    for (int i = N - 1; i >= 0; i--) {
        DriveLane row[N];
        for (int j = 0; j < N; j++) row[j] = X[i][j] * inverse[i];
        for (int k = i + 1; k < N; k++)
            for (int j = 0; j < N; j++) row[j] -= P[k][i] * X[k][j];
        for (int j = 0; j < N; j++) X[i][j] = row[j];
    }
}

// Up to four drives, from number `first` on.
template <int N>
struct Drives {
    using V = DriveLane;
    const DriveArgs& a;
    int which[abreast];                          // drive of each lane; the last one again where there are fewer
    int used;                                    // lanes that count
    std::int64_t begin[abreast], rows[abreast];
    std::int64_t T = 0;                          // rows of the longest
    V x[N], P[N][N], M[N][N], G[N][N], Z[N][N], r;
    DriveStep<N> step;

    Drives(const DriveArgs& args, int first) : a(args), used(args.n - first < abreast ? args.n - first : abreast) {
        for (int l = 0; l < abreast; l++) {
            which[l] = a.order[first + (l < used ? l : used - 1)];
            begin[l] = a.offsets[which[l]];
            rows[l] = a.offsets[which[l] + 1] - begin[l];
            if (rows[l] > T) T = rows[l];
            r.set(l, a.r[which[l]]);
        }
    }
    inline void place(std::int64_t t, std::int64_t* at) const {
        for (int l = 0; l < abreast; l++) at[l] = begin[l] + (t < rows[l] ? t : rows[l] - 1);
    }
    // 1 where a lane has a fix
    inline V fixes(std::int64_t t, const std::int64_t* at) const {
        V there(0.0);
        for (int l = 0; l < abreast; l++) there.v[l] = t < rows[l] ? 1.0 : 0.0;
        return there * gathered(a.seen, at);
    }
    inline void store(std::int64_t t) const {
        double* to = a.work + t * drive_row(N) * abreast;
        auto put = [&](const V& v) {
            std::memcpy(to, &v, sizeof v);
            to += abreast;
        };
        for (int i = 0; i < N; i++) put(x[i]);
        for (int i = 0; i < N; i++)
            for (int j = 0; j <= i; j++) put(P[i][j]);
    }
    inline void recall(std::int64_t t, V* x1, V (*P1)[N]) const {
        const double* from = a.work + t * drive_row(N) * abreast;
        auto get = [&] {
            V v;
            std::memcpy(&v, from, sizeof v);
            from += abreast;
            return v;
        };
        for (int i = 0; i < N; i++) x1[i] = get();
        for (int i = 0; i < N; i++)
            for (int j = 0; j <= i; j++) P1[i][j] = P1[j][i] = get();
    }

    void filter() {
        for (int i = 0; i < N; i++) {
            for (int l = 0; l < abreast; l++) x[i].set(l, a.x0[which[l] * N + i]);
            for (int j = 0; j < N; j++) P[i][j] = V(0.0);
            for (int l = 0; l < abreast; l++) P[i][i].set(l, a.P0[which[l] * N + i]);
        }
        V loglik(0.0);
        for (std::int64_t t = 0; t < T; t++) {
            std::int64_t at[abreast];
            place(t, at);
            if (t) {
                step.read(a, at);
                V xn[N];
                step.forward([&](int k) { return x[k]; }, [&](int k, V v) { xn[k] = v; });
                step.add_b(xn);
                for (int i = 0; i < N; i++) x[i] = xn[i];
                step.predict(P, M);
                step.add_Q(P);
            }
            const V y[2] = {gathered(a.y, at, 2, 0), gathered(a.y, at, 2, 1)}, seen = fixes(t, at);
            loglik += seen * correct(y, seen);
            store(t);
        }
        for (int l = 0; l < used; l++) a.loglik[which[l]] = loglik[l];
    }

    // Fold the fixes of a row into x, P where they are seen; return their log-likelihood.
    inline V correct(const V* y, V seen) {
        V CP[2][N], K[2][N], CM[2][N], was[N];
        for (int i = 0; i < N; i++) was[i] = P[i][i];
        for (int j = 0; j < N; j++) {
            CP[0][j] = P[d_e][j] + P[d_oe][j];
            CP[1][j] = P[d_n][j] + P[d_on][j];
        }
        const V s00 = CP[0][d_e] + CP[0][d_oe] + r, s01 = CP[0][d_n] + CP[0][d_on], s11 = CP[1][d_n] + CP[1][d_on] + r;
        const V i0 = pivot(2, s00, s00), l = s01 * i0, p1 = s11 - l * s01, i1 = pivot(2, p1, s11);
        const V v0 = y[0] - x[d_e] - x[d_oe], v1 = y[1] - x[d_n] - x[d_on], z1 = v1 - l * v0;
        const V dets = V::of(log4((where_positive(i0, s00, V(1.0)) * where_positive(i1, p1, V(1.0))).v));
        for (int j = 0; j < N; j++) {
            const V k1 = (CP[1][j] - l * CP[0][j]) * i1;
            K[1][j] = seen * k1;
            K[0][j] = seen * (CP[0][j] * i0 - l * k1);
        }
        for (int j = 0; j < N; j++) x[j] += K[0][j] * v0 + K[1][j] * v1;
        // M = P Z', then P = Z M + K r K'
        for (int i = 0; i < N; i++)
            for (int j = 0; j < N; j++) M[i][j] = P[i][j] - (CP[0][i] * K[0][j] + CP[1][i] * K[1][j]);
        for (int j = 0; j < N; j++) {
            CM[0][j] = r * K[0][j] - (M[d_e][j] + M[d_oe][j]);
            CM[1][j] = r * K[1][j] - (M[d_n][j] + M[d_on][j]);
        }
        for (int i = 0; i < N; i++)
            for (int j = 0; j <= i; j++) P[i][j] = P[j][i] = M[i][j] + (K[0][i] * CM[0][j] + K[1][i] * CM[1][j]);
        clear<N>(was, P, [&](int i, int j) { return r * (K[0][i] * K[0][j] + K[1][i] * K[1][j]); });
        return V(-0.5) * (v0 * v0 * i0 + z1 * z1 * i1 + dets + V(2 * log_2pi));
    }

    void smooth() {
        V misfit(0.0), unsure(0.0), counted(0.0), broken(0.0);
        for (std::int64_t t = T - 1;; t--) {
            std::int64_t at[abreast];
            place(t, at);
            for (int l = 0; l < used; l++)
                if (t == rows[l] - 1) start(t, l);
            const V seen = fixes(t, at);
            left(at, seen, &misfit, &unsure);
            counted += seen;
            V sound(0.0);
            for (int i = 0; i < N; i++) sound += x[i] * V(0.0) + P[i][i] * V(0.0);
            broken += sound;
            write(t, at);
            if (t == 0) break;
            back(t, at);
        }
        for (int l = 0; l < used; l++) {
            a.misfit[which[l]] = misfit[l];
            a.unsure[which[l]] = unsure[l];
            a.counted[which[l]] = counted[l];
            a.code[which[l]] = broken[l] == 0.0 ? 0 : drive_broken;
            if (a.squares)
                for (int g = 0; g < drive_groups; g++)
                    a.squares[begin[l] * drive_groups + g] = a.spread[begin[l] * drive_groups + g] = 0.0;
        }
    }
    // The way back of one lane begins: its belief is that of the filter.
    inline void start(std::int64_t t, int l) {
        const double* from = a.work + t * drive_row(N) * abreast + l;
        for (int i = 0; i < N; i++, from += abreast) x[i].set(l, *from);
        for (int i = 0; i < N; i++)
            for (int j = 0; j <= i; j++, from += abreast) {
                P[i][j].set(l, *from);
                P[j][i].set(l, *from);
            }
    }
    // Adds the square of what a row's fixes are off the path, and the variance of that, of both axes together.
    inline void left(const std::int64_t* at, V seen, V* misfit, V* unsure) const {
        const int e[2] = {d_e, d_n}, o[2] = {d_oe, d_on};
        for (int i = 0; i < 2; i++) {
            const V off = gathered(a.y, at, 2, i) - x[e[i]] - x[o[i]];
            *misfit += seen * off * off;
            *unsure += seen * (P[e[i]][e[i]] + P[e[i]][o[i]] + P[o[i]][e[i]] + P[o[i]][o[i]]);
        }
    }
    inline void write(std::int64_t t, const std::int64_t* at) const {
        for (int l = 0; l < used; l++) {
            if (t >= rows[l]) continue;
            for (int i = 0; i < N; i++) a.x[at[l] * N + i] = x[i][l];
            if (!a.P) continue;
            double* to = a.P + at[l] * N * N;
            for (int i = 0; i < N; i++)
                for (int j = 0; j < N; j++) to[i * N + j] = P[i][j][l];
        }
    }
    // From row t to row t - 1.
    inline void back(std::int64_t t, const std::int64_t* at) {
        V xs[N], xp[N], P1[N][N], D[N][N];
        recall(t - 1, xs, P1);
        step.read(a, at);
        step.forward([&](int k) { return xs[k]; }, [&](int k, V v) { xp[k] = v; });
        step.add_b(xp);
        for (int i = 0; i < N; i++)
            for (int j = 0; j < N; j++) M[i][j] = P1[i][j];
        step.predict(M, G);  // G = A P1
        if (a.squares)
            for (int i = 0; i < N; i++)
                for (int j = 0; j < N; j++) D[i][j] = M[i][j] + P[i][j];
        step.add_Q(M);
        solve_in_place<N>(M, G);  // now G'
        for (int i = 0; i < N; i++)
            for (int k = 0; k < N; k++) xs[i] += G[k][i] * (x[k] - xp[k]);
        if (a.squares) squares(t, at, xs, D);
        for (int i = 0; i < N; i++) x[i] = xs[i];
        for (int j = 0; j < N; j++)
            step.back([&](int k) { return G[k][j]; }, [&](int k, V v) { Z[k][j] = (k == j ? V(1.0) : V(0.0)) - v; });
        step.add_Q(P);
        product<N>(P, G, M);
        product<N>(P1, Z, D);
        for (int i = 0; i < N; i++)
            for (int j = 0; j < N; j++) P[i][j] = V(0.0);
        add_half<N>(Z, D, P);
        add_half<N>(G, M, P);
        V was[N];
        for (int i = 0; i < N; i++) was[i] = P1[i][i];
        clear<N>(was, P, [&](int i, int j) {
            V sum(0.0);
            for (int k = 0; k < N; k++) sum += G[k][i] * M[k][j];
            return sum;
        });
    }
    // The residuals into row t, of which xs, D are the smoothed mean before it and P + A P A': squares of their means, and
    // their variances.
    inline void squares(std::int64_t t, const std::int64_t* at, const V* xs, const V (*D)[N]) const {
        const DriveStep<N>& s = step;
        V found[drive_groups] = {V(0.0), V(0.0), V(0.0), V(0.0), V(0.0)}, spread[drive_groups];
        for (int g = 0; g < drive_groups; g++) spread[g] = V(0.0);
        V dz[N];  // w of the means
        s.forward([&](int k) { return xs[k]; }, [&](int k, V v) { dz[k] = v; });
        s.add_b(dz);
        for (int k = 0; k < N; k++) dz[k] = x[k] - dz[k];
        auto add = [&](int group, const V* g) {
            V u[N], rest[N], turned[N], mean(0.0), sum(0.0);
            s.back([&](int k) { return g[k]; }, [&](int k, V v) { turned[k] = v; });
            for (int i = 0; i < N; i++) {
                rest[i] = V(0.0);
                for (int k = 0; k < N; k++) rest[i] += G[i][k] * turned[k];
                u[i] = g[i] - rest[i];
                mean += g[i] * dz[i];
            }
            for (int i = 0; i < N; i++) {
                V row = V(0.5) * D[i][i] * u[i];
                for (int j = 0; j < i; j++) row += D[i][j] * u[j];
                sum += row * u[i];
            }
            found[group] += mean * mean;
            spread[group] += larger(V(2.0) * sum, V(0.0)) + s.noise(rest);
        };
        const V none(0.0), one(1.0);
        const V along[] = {s.S, s.C, none, none, none, none, none, none, none, none};
        const V aside[] = {s.C, -s.S, -s.half, none, none, none, none, none, none, none};
        add(0, along);
        add(1, aside);
        const int single[5] = {d_azimuth, d_oe, d_on, d_de, d_dn}, group[5] = {2, 3, 3, 4, 4};
        for (int i = 0; i < 5; i++) {
            V g[N];
            for (int k = 0; k < N; k++) g[k] = k == single[i] ? one : none;
            add(group[i], g);
        }
        for (int l = 0; l < used; l++)
            if (t < rows[l])
                for (int g = 0; g < drive_groups; g++) {
                    a.squares[at[l] * drive_groups + g] = found[g][l];
                    a.spread[at[l] * drive_groups + g] = spread[g][l];
                }
    }
};

}  // namespace HW_ISA
}  // namespace hw
