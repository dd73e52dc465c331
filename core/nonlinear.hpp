// Extended and unscented Kalman filter and smoother.
//
// A Gaussian belief is carried as a mean and *deviations*: a matrix D (n, L) with P = D W D'. The linearised filter has
// the columns of the Cholesky factor of P, all with weight 1; the unscented filter has its sigma points. A function
// turns deviations DX of x into deviations DY of its value, and then one step of algebra does everything:
//
//     S = DY W DY' + R,  K = DX W DY' S^-1,  M = (DX - K DY) W (DX - K DY)' + K R K'            (`condition`)
//
// is the correction by an output with noise R, and, with g and Q in the place of h and R, the smoother's gain and what
// is left of P once the next state is known. The last form is Joseph's: a sum of squares, so P stays positive
// semidefinite whatever the gain. The smoother then adds K P[t+1] K' only (Rauch, Tung and Striebel 1965).
// Sigma points: Julier and Uhlmann (2004), scaled as in Wan and van der Merwe (2000), eq. (15); iterations: Bell and
// Cathey (1993), eq. (3).
#pragma once
#include "nonlinear_args.hpp"
#include "small.hpp"
#include "tape.hpp"

namespace hw {
namespace HW_ISA {

constexpr double pi = 3.14159265358979323846;

// Into (-pi, pi].
inline double wrapped(double a) {
    if (a > -pi && a <= pi) return a;
    const double r = remainder_np(a, 2.0 * pi);  // [0, 2 pi)
    return r > pi ? r - 2.0 * pi : r;
}

inline int padded(int n) { return (n + 3) / 4 * 4; }

// Lanes: number of deviations, a multiple of four; spare ones are zero.
template <class L>
inline double lanes_dot(L lanes, const double* a, const double* b) {
    V4 s{};
    for (int l = 0; l < lanes; l += 4) s += *reinterpret_cast<const V4u*>(a + l) * *reinterpret_cast<const V4u*>(b + l);
    return (s[0] + s[2]) + (s[1] + s[3]);
}

// out (n, n) = D W D' [+ Q]; D (n, L); W (L) or null for ones; work (L)
template <class N, class L>
inline void gram(N n, L lanes, const double* D, const double* W, const double* Q, double* out, double* work) {
    for (int i = 0; i < n; ++i) {
        const double* d = D + i * lanes;
        if (W) {
            for (int l = 0; l < lanes; ++l) work[l] = W[l] * d[l];
            d = work;
        }
        for (int j = 0; j <= i; ++j) {
            const double s = lanes_dot(lanes, d, D + j * lanes) + (Q ? Q[i * n + j] : 0.0);
            out[i * n + j] = s;
            out[j * n + i] = s;
        }
    }
}

// Workspaces of one step; m stands for the larger of nx and ny.
struct Buffers {
    double *points, *slots, *value, *slope;           // (n_in, L), (n, L), (n), (n, nx)
    double *DX, *DY, *E, *row;                        // (nx, L), (m, L), (nx, L), (L)
    double *F, *Fi;                                   // (nx, nx), (nx): Cholesky factor of P
    double *S, *SL, *d, *di, *Kt, *KR, *J, *Rs;       // (m, m) twice, (m) twice, (m, nx), (nx, m), (m, nx), (m, m)
    double *ym, *v, *z, *size, *xi, *in, *x, *xp, *Pp, *Pn, *W, *W_safe;
};

// DX of the belief with Cholesky factor F (nx, nx).
template <bool Sigma, class N, class L>
inline void deviations(N n, L lanes, double spread, const double* F, double* DX) {
    for (int i = 0; i < n; ++i) {
        double* d = DX + i * lanes;
        for (int l = 0; l < lanes; ++l) d[l] = 0.0;
        for (int j = 0; j <= i; ++j) {
            if (Sigma) {
                d[1 + j] = spread * F[i * n + j];
                d[1 + n + j] = -spread * F[i * n + j];
            } else {
                d[j] = F[i * n + j];
            }
        }
    }
}

// Mean ym (m) and deviations DY (m, L) of f(x, row), where x has mean x and deviations DX. Returns false if f or its
// Jacobian is not finite somewhere. `point` is where to linearise.
template <bool Sigma, class N, class L>
inline bool propagate(N n, int m, L lanes, const NonlinearArgs& a, const Tape& f, const double* row, const double* x,
                      const double* point, const uint8_t* wrap_x, const uint8_t* wrap_y, const Buffers& b) {
    const int extra = f.n_in - n;
    if constexpr (Sigma) {
        for (int i = 0; i < n; ++i)
            for (int l = 0; l < lanes; ++l) b.points[i * lanes + l] = x[i] + b.DX[i * lanes + l];
        for (int i = 0; i < extra; ++i)
            for (int l = 0; l < lanes; ++l) b.points[(n + i) * lanes + l] = row[i];
        tape_values<L::fixed ? L::cap : 0>(f, lanes, b.points, b.slots);
        double all = 0.0;
        for (int i = 0; i < m; ++i) {
            const double* y = b.slots + (size_t)f.out[i] * lanes;
            double* d = b.DY + i * lanes;
            // Differences from the centre first: weights of large size cancel exactly, and angles do not jump.
            double shift = 0.0;
            for (int l = 0; l < lanes; ++l) {
                d[l] = y[l] - y[0];
                if (wrap_y[i]) d[l] = wrapped(d[l]);
                all += d[l] * 0.0;
            }
            for (int l = 1; l < 2 * n + 1; ++l) shift += d[l];
            shift *= a.weight;
            for (int l = 0; l < lanes; ++l) d[l] -= shift;
            b.ym[i] = y[0] + shift;
            all += b.ym[i] * 0.0;
        }
        return all == 0.0;
    } else {
        copy(n, point, b.in);
        for (int i = 0; i < extra; ++i) b.in[n + i] = row[i];
        tape_jacobian(n, f, b.in, b.value, b.slope);
        bool good = true;
        for (int i = 0; i < m; ++i) {
            copy(n, b.slope + (size_t)f.out[i] * n, b.J + i * n);
            b.ym[i] = b.value[f.out[i]];
            good = good && finite(b.ym[i]) && all_finite(n, b.J + i * n);
        }
        if (!good) return false;
        if (point != x)
            for (int j = 0; j < n; ++j) {
                const double s = wrap_x[j] ? wrapped(x[j] - point[j]) : x[j] - point[j];
                for (int i = 0; i < m; ++i) b.ym[i] += b.J[i * n + j] * s;
            }
        for (int i = 0; i < m; ++i) {
            for (int l = 0; l < lanes; ++l) b.row[l] = 0.0;
            for (int j = 0; j < n; ++j) axpy(lanes, b.J[i * n + j], b.DX + j * lanes, b.row);
            copy(lanes, b.row, b.DY + i * lanes);
        }
        return true;
    }
}

// Condition x on a value with deviations DY (m, L) and noise R (m, m): S, its factor (SL, d, di), K' (m, n), M (n, n) and
// the Cholesky factor F of M. Returns false if S or M is not positive semidefinite (negative weights only).
template <class N, class L>
inline bool condition(N n, int m, L lanes, const double* W, const double* DY, const double* R, double* M, double* F, double* Fi,
                      const Buffers& b) {
    gram(Dim<0>(m), lanes, DY, W, R, b.S, b.row);
    bool good = ldl(Dim<0>(m), b.S, b.SL, b.d, b.di) >= 0;
    for (int j = 0; j < m; ++j) {
        const double* d = DY + j * lanes;
        if (W) {
            for (int l = 0; l < lanes; ++l) b.row[l] = W[l] * d[l];
            d = b.row;
        }
        for (int i = 0; i < n; ++i) b.Kt[j * n + i] = lanes_dot(lanes, b.DX + i * lanes, d);
    }
    ldl_solve(Dim<0>(m), n, b.SL, b.di, b.Kt);
    for (int i = 0; i < n; ++i) {
        copy(lanes, b.DX + i * lanes, b.E + i * lanes);
        for (int j = 0; j < m; ++j) axpy(lanes, -b.Kt[j * n + i], DY + j * lanes, b.E + i * lanes);
    }
    gram(n, lanes, b.E, W, nullptr, M, b.row);
    mul(Dim<0>(m), Dim<0>(m), n, R, b.Kt, b.KR);          // (R K')
    mul_tn<Op::add>(n, Dim<0>(m), n, b.Kt, b.KR, M);      // + K R K'
    symmetrise(n, M);
    if (F) good = cholesky(n, M, F, Fi) >= 0 && good;
    return good;
}

template <bool Sigma, class N, class L>
void nonlinear_scan(N n, L lanes, NonlinearArgs& a, const Buffers& b) {
    const int m = a.ny;
    const size_t nn = (size_t)n * n;
    const double* W = Sigma ? b.W : nullptr;
    if constexpr (Sigma) {
        for (int l = 0; l < lanes; ++l) b.W[l] = b.W_safe[l] = l < 2 * n + 1 ? a.weight : 0.0;
        b.W[0] = a.centre;
        b.W_safe[0] = max2(a.centre, 0.0);
    }
    double* x = b.x;
    copy(n, a.x0, x);
    if (cholesky(n, a.P0, b.F, b.Fi) < 0) a.repaired.add(0);
    const double* P = a.P0;

    for (long t = 0; t < a.T; ++t) {
        const double* Q = a.Q.at(t);
        const double* R = a.R.at(t);
        bool repaired = false, contradicted = false;

        // Prediction: xp, Pp and its factor.
        deviations<Sigma>(n, lanes, a.spread, b.F, b.DX);
        const double* at = a.about ? a.about + t * n : x;
        bool good = propagate<Sigma>(n, n, lanes, a, a.g, a.gu + t * (a.g.n_in - n), x, at, a.wrap_x, a.wrap_x, b);
        if (good) {
            gram(n, lanes, b.DY, W, Q, b.Pp, b.row);
            good = all_finite(Dim<0>(n * n), b.Pp);
        }
        if (!good) {  // hold: g is taken as the identity
            a.bad_g.add(t);
            copy(n, x, b.ym);
            copy(Dim<0>(n * lanes), b.DX, b.DY);
            for (size_t i = 0; i < nn; ++i) b.Pp[i] = P[i] + Q[i];
        }
        for (int i = 0; i < n; ++i) b.xp[i] = a.wrap_x[i] ? wrapped(b.ym[i]) : b.ym[i];
        if (a.smooth) {
            double* M = a.M + t * nn;
            if (!condition(n, n, lanes, W, b.DY, Q, M, Sigma ? b.Pn : nullptr, b.Fi, b) && Sigma) {
                repaired = true;
                condition(n, n, lanes, b.W_safe, b.DY, Q, M, (double*)nullptr, b.Fi, b);
            }
            for (int i = 0; i < n; ++i)
                for (int j = 0; j < n; ++j) a.G[t * nn + i * n + j] = b.Kt[j * n + i];
            copy(n, b.xp, a.xp + t * n);
        }
        if (cholesky(n, b.Pp, b.F, b.Fi) < 0) {
            repaired = true;
            if (Sigma) {
                gram(n, lanes, b.DY, b.W_safe, Q, b.Pp, b.row);
                cholesky(n, b.Pp, b.F, b.Fi);
            }
        }

        // Correction by the entries that were seen.
        double* xt = a.x + t * n;
        double* Pt = a.P + t * nn;
        const uint8_t* seen = a.seen + (size_t)t * m;
        int used = 0;
        for (int i = 0; i < m; ++i) used += seen[i] != 0;
        copy(n, b.xp, x);
        for (size_t i = 0; i < nn; ++i) Pt[i] = b.Pp[i];
        a.loglik[t] = a.nis[t] = 0.0;
        if (used > 0) {
            const double* y = a.y + (size_t)t * m;
            const double* Rt = R;
            if (used < m) {
                for (int i = 0, r = 0; i < m; ++i) {
                    if (!seen[i]) continue;
                    for (int j = 0, c = 0; j < m; ++j)
                        if (seen[j]) b.Rs[r * used + c++] = R[i * m + j];
                    ++r;
                }
                Rt = b.Rs;
            }
            deviations<Sigma>(n, lanes, a.spread, b.F, b.DX);
            copy(n, b.xp, b.xi);
            const int rounds = Sigma || a.about ? 1 : a.iterations;
            for (int k = 0; k < rounds; ++k) {
                const double* point = a.about ? a.about + (t + 1) * n : k > 0 ? b.xi : b.xp;
                good = propagate<Sigma>(n, m, lanes, a, a.h, a.hu + t * (a.h.n_in - n), b.xp, point, a.wrap_x, a.wrap_y, b);
                if (!good) break;
                for (int i = 0, r = 0; i < m; ++i) {
                    if (!seen[i]) continue;
                    b.v[r] = a.wrap_y[i] ? wrapped(y[i] - b.ym[i]) : y[i] - b.ym[i];
                    b.size[r] = std::fabs(y[i]) + std::fabs(b.ym[i]);
                    if (r != i) copy(lanes, b.DY + i * lanes, b.DY + r * lanes);
                    ++r;
                }
                const bool fine = condition(n, used, lanes, W, b.DY, Rt, b.Pn, b.F, b.Fi, b);
                if (!fine) {
                    repaired = true;
                    if (Sigma) condition(n, used, lanes, b.W_safe, b.DY, Rt, b.Pn, b.F, b.Fi, b);
                }
                for (int i = 0; i < n; ++i) {
                    double s = b.xp[i];
                    for (int r = 0; r < used; ++r) s += b.Kt[r * n + i] * b.v[r];
                    b.xi[i] = s;
                }
                if (k == 0) {  // the innovation's density, before any iteration
                    double quadratic = 0.0, logdet = 0.0;
                    for (int r = 0; r < used; ++r) {
                        double s = b.v[r];
                        for (int c = 0; c < r; ++c) s -= b.SL[r * used + c] * b.z[c];
                        b.z[r] = s;
                        quadratic += s * s * b.di[r];
                        if (b.d[r] > 0.0) {
                            logdet += std::log(b.d[r]) + log_2pi;
                        } else if (std::fabs(s) > 1e-6 * (b.size[r] + std::sqrt(std::fabs(b.S[r * used + r])))) {
                            contradicted = true;
                        }
                    }
                    a.nis[t] = quadratic;
                    a.loglik[t] = -0.5 * (quadratic + logdet);
                }
            }
            if (good && all_finite(n, b.xi) && all_finite(Dim<0>(n * n), b.Pn) && finite(a.loglik[t])) {
                for (int i = 0; i < n; ++i) x[i] = a.wrap_x[i] ? wrapped(b.xi[i]) : b.xi[i];
                for (size_t i = 0; i < nn; ++i) Pt[i] = b.Pn[i];
            } else {  // the output is left out
                a.bad_h.add(t);
                a.loglik[t] = a.nis[t] = 0.0;
                contradicted = false;
                cholesky(n, b.Pp, b.F, b.Fi);
            }
        }
        if (repaired) a.repaired.add(t);
        if (contradicted) a.contradicted.add(t);
        copy(n, x, xt);
        P = Pt;
    }

    if (!a.smooth) return;
    // x[t-1] given everything: x, P are overwritten from the end; the last turn gives x0.
    for (long t = a.T - 1; t >= 0; --t) {
        const double *xs = a.x + t * n, *Ps = a.P + t * nn, *G = a.G + t * nn, *M = a.M + t * nn;
        const double* xf = t > 0 ? a.x + (t - 1) * n : a.x0;
        double* xo = t > 0 ? a.x + (t - 1) * n : a.x0s;
        double* Po = t > 0 ? a.P + (t - 1) * nn : a.P0s;
        for (int i = 0; i < n; ++i) {
            const double s = xs[i] - a.xp[t * n + i];
            b.xi[i] = a.wrap_x[i] ? wrapped(s) : s;
        }
        copy(n, xf, b.x);
        mul_v<Op::add>(n, n, G, b.xi, b.x);
        for (int i = 0; i < n; ++i) xo[i] = a.wrap_x[i] ? wrapped(b.x[i]) : b.x[i];
        mul(n, n, n, G, Ps, b.Pp);
        for (size_t i = 0; i < nn; ++i) b.Pn[i] = M[i];
        mul_nt<Op::add>(n, n, n, b.Pp, G, b.Pn);
        symmetrise(n, b.Pn);
        for (size_t i = 0; i < nn; ++i) Po[i] = b.Pn[i];
    }
}

}  // namespace HW_ISA
}  // namespace hw
