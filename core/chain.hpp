// Block-tridiagonal symmetric systems with a dense border: the algebra of everything that is a chain in time.
//
//     | M_0  O_1'            B_0 |         M_t   (n,n)  diagonal blocks
//     | O_1  M_1  O_2'       B_1 |         O_t   (n,n)  coupling of t to t-1
//     |      O_2  M_2   ...  B_2 |         B_t   (n,q)  border: what all times share (parameters, half-widths)
//     | B_0' B_1' B_2'  ...   K  |         K     (q,q)
//
// Time is eliminated forwards, M_t = L_t D_t L_t':
//
//     M_t <- M_t - O_t M_{t-1}^-1 O_t',    B_t <- L_t^-1 (B_t - Obar_t B_{t-1}),    K <- K - sum B_t' D_t^-1 B_t,
//     Obar_t = O_t L_{t-1}^-T D_{t-1}^-1,
//
// which costs O(T (n^3 + n^2 q + n q^2)). A step is `chain_link` (t meets t-1) then `chain_close` (t is eliminated);
// a caller that assembles blocks as it goes calls these two, the others call `chain_factor` on stored blocks. The same
// steps work on `double` and on `Lanes<P>` (several stretches of a series at once, core/lanes.hpp).
//
// Storage: blocks row-major, of M only the lower triangle is read; after factoring M_t holds L_t below the diagonal and
// 1/D_t on it. Border columns are stored one after the other: B_t[c * n + i]. A pivot below `drop` times its own
// diagonal entry is rounding noise: its reciprocal is 0 and the direction is left out (generalised inverse).
#pragma once

#include "lanes.hpp"

namespace hw {
namespace HW_ISA {

// place of (i,j), j <= i, in a packed lower triangle
inline int tri(int i, int j) { return i * (i + 1) / 2 + j; }

// b (n) <- L^-1 b, unit lower
template <class V, class N>
inline void unit_lower(N n, const V* L, V* b) {
    for (int i = 1; i < n; i++) {
        V s = b[i];
        for (int j = 0; j < i; j++) s -= L[i * n + j] * b[j];
        b[i] = s;
    }
}

// b (n) <- L^-T b
template <class V, class N>
inline void unit_upper(N n, const V* L, V* b) {
    for (int i = n - 2; i >= 0; i--) {
        V s = b[i];
        for (int j = i + 1; j < n; j++) s -= L[j * n + i] * b[j];
        b[i] = s;
    }
}

// M (n,n) = L D L' in place; work (n)
template <class V, class N>
inline void unit_factor(N n, V* M, double drop, V* work) {
    for (int j = 0; j < n; j++) work[j] = V(drop) * M[j * n + j];
    for (int j = 0; j < n; j++) {
        const V di = where_positive(M[j * n + j] - work[j], V(1.0) / M[j * n + j], V(0.0));
        M[j * n + j] = di;
        for (int i = j + 1; i < n; i++) {
            const V li = M[i * n + j] * di;
            for (int k = j + 1; k <= i; k++) M[i * n + k] -= li * M[k * n + j];
        }
        for (int i = j + 1; i < n; i++) M[i * n + j] *= di;
    }
}

// t meets t-1: from the coupling O (n,n) = M_{t,t-1}, L, Z of t-1 (eliminated), make O <- Obar and carry M, Z of t on:
// M -= O M_{t-1}^-1 O', Z -= Obar Z_{t-1}; q border columns; work (n)
template <class V, class N>
inline void chain_link(N n, int q, V* O, const V* L, const V* Z_before, V* M, V* Z, V* work) {
    for (int i = 0; i < n; i++) {
        V* o = O + i * n;
        unit_lower(n, L, o);
        for (int k = 0; k < n; k++) {
            work[k] = o[k];
            o[k] = o[k] * L[k * n + k];
        }
        for (int j = 0; j <= i; j++) {  // rows j <= i of O are scaled by now: Obar_j D o_i
            V s = M[i * n + j];
            for (int k = 0; k < n; k++) s -= O[j * n + k] * work[k];
            M[i * n + j] = s;
        }
    }
    for (int c = 0; c < q; c++) {
        const V* b = Z_before + c * n;
        V* z = Z + c * n;
        for (int i = 0; i < n; i++) {
            V s = z[i];
            for (int k = 0; k < n; k++) s -= O[i * n + k] * b[k];
            z[i] = s;
        }
    }
}

// t is eliminated: M (n,n) -> L, 1/D; Z -> L^-1 Z; Q (packed q(q+1)/2) += Z' D^-1 Z; work (n)
template <class V, class N>
inline void chain_close(N n, int q, V* M, V* Z, V* Q, double drop, V* work) {
    unit_factor(n, M, drop, work);
    for (int c = 0; c < q; c++) {
        V* z = Z + c * n;
        unit_lower(n, M, z);
        for (int i = 0; i < n; i++) work[i] = z[i] * M[i * n + i];
        V* out = Q + tri(c, 0);
        for (int d = 0; d <= c; d++) {
            V s = out[d];
            for (int i = 0; i < n; i++) s += work[i] * Z[d * n + i];
            out[d] = s;
        }
    }
}

// right-hand side f (n) of t, complete: f <- L^-1 f, acc (q) += Z' D^-1 f; work (n)
template <class V, class N>
inline void chain_close_rhs(N n, int q, const V* L, const V* Z, V* f, V* acc, V* work) {
    unit_lower(n, L, f);
    for (int i = 0; i < n; i++) work[i] = f[i] * L[i * n + i];
    for (int c = 0; c < q; c++) {
        V s = acc[c];
        for (int i = 0; i < n; i++) s += Z[c * n + i] * work[i];
        acc[c] = s;
    }
}

// f (n) -= Obar f_before
template <class V, class N>
inline void chain_link_rhs(N n, const V* O, const V* f_before, V* f) {
    for (int i = 0; i < n; i++) {
        V s = f[i];
        for (int k = 0; k < n; k++) s -= O[i * n + k] * f_before[k];
        f[i] = s;
    }
}

// x (n) of t from f (or null for 0), the border's solution z (q), and Obar, x of t+1 (null at the end)
template <class V, class N>
inline void chain_back(N n, int q, const V* L, const V* Z, const V* f, const V* z, const V* O_after, const V* x_after,
                       V* x) {
    for (int i = 0; i < n; i++) {
        V s = f ? f[i] : V(0.0);
        for (int c = 0; c < q; c++) s -= Z[c * n + i] * z[c];
        x[i] = s * L[i * n + i];
    }
    if (x_after) {
        for (int k = 0; k < n; k++) {
            for (int i = 0; i < n; i++) x[i] -= O_after[k * n + i] * x_after[k];
        }
    }
    unit_upper(n, L, x);
}

// ---- stored chains of doubles ------------------------------------------------------------------------------------

// M (T,n,n) -> L, 1/D; O (T,n,n; O_0 unused) -> Obar; B (T,q,n) -> Z; Q packed (q(q+1)/2) += B' M^-1 B; work (n)
template <class N>
inline void chain_factor(N n, int T, int q, double* M, double* O, double* B, double* Q, double drop, double* work) {
    const std::ptrdiff_t nn = n * n, nq = static_cast<std::ptrdiff_t>(n) * q;
    for (int t = 0; t < T; t++) {
        if (t > 0) chain_link(n, q, O + t * nn, M + (t - 1) * nn, B + (t - 1) * nq, M + t * nn, B + t * nq, work);
        chain_close(n, q, M + t * nn, B + t * nq, Q, drop, work);
    }
}

// f (T,n): right-hand sides -> forward solution; acc (q) += B' M^-1 rhs
template <class N>
inline void chain_forward(N n, int T, int q, const double* L, const double* O, const double* Z, double* f, double* acc,
                          double* work) {
    const std::ptrdiff_t nn = n * n, nq = static_cast<std::ptrdiff_t>(n) * q;
    for (int t = 0; t < T; t++) {
        if (t > 0) chain_link_rhs(n, O + t * nn, f + (t - 1) * n, f + t * n);
        chain_close_rhs(n, q, L + t * nn, Z + t * nq, f + t * n, acc, work);
    }
}

// x (T,n) from f (T,n) and z (q)
template <class N>
inline void chain_backward(N n, int T, int q, const double* L, const double* O, const double* Z, const double* f,
                           const double* z, double* x) {
    const std::ptrdiff_t nn = n * n, nq = static_cast<std::ptrdiff_t>(n) * q;
    for (int t = T - 1; t >= 0; t--)
        chain_back(n, q, L + t * nn, Z + t * nq, f + t * n, z, t + 1 < T ? O + (t + 1) * nn : nullptr,
                   t + 1 < T ? x + (t + 1) * n : nullptr, x + t * n);
}

// Blocks of the inverse that lie on the pattern: S (T,n,n) diagonal blocks, C (T,n,n) blocks between t and t-1 (C_0 = 0),
// H (T,n,q) blocks between t and the border, given Ki (q,q), the inverse of the border's Schur complement; the
// border's own block is Ki. J (T,q,n), G (n,n), R (n) are work.
//
// From x_t = L^-T (D^-1 (f_t - Z_t z) - Obar' x_{t+1}): with G_t = -L^-T Obar_{t+1}' and J_t = dx_t / dz,
//     S_t = M_t^-1 + G_t S_{t+1} G_t' and cov(x_t, x_{t+1}) = G_t S_{t+1} without the border; J Ki J' is added to both.
template <class N>
inline void chain_inverse(N n, int T, int q, const double* L, const double* O, const double* Z, const double* Ki,
                          double* S, double* C, double* H, double* J, double* G, double* R) {
    const std::ptrdiff_t nn = n * n, nq = static_cast<std::ptrdiff_t>(n) * q;
    for (int t = T - 1; t >= 0; t--) {
        const double* Lt = L + t * nn;
        double* St = S + t * nn;
        double* Jt = J + t * nq;  // columns, as Z
        for (int c = 0; c < n; c++) {  // columns of M_t^-1 = L^-T D^-1 L^-1, kept as rows (symmetric)
            for (int i = 0; i < n; i++) G[i] = i == c ? 1.0 : 0.0;
            unit_lower(n, Lt, G);
            for (int i = 0; i < n; i++) G[i] *= Lt[i * n + i];
            unit_upper(n, Lt, G);
            for (int i = 0; i < n; i++) St[c * n + i] = G[i];
        }
        for (int c = 0; c < q; c++) {
            for (int i = 0; i < n; i++) Jt[c * n + i] = -Z[t * nq + c * n + i] * Lt[i * n + i];
            if (t + 1 < T)
                for (int k = 0; k < n; k++)
                    for (int i = 0; i < n; i++)
                        Jt[c * n + i] -= O[(t + 1) * nn + k * n + i] * J[(t + 1) * nq + c * n + k];
            unit_upper(n, Lt, Jt + c * n);
        }
        if (t + 1 < T) {
            const double* O1 = O + (t + 1) * nn;
            double* C1 = C + (t + 1) * nn;  // cov(x_{t+1}, x_t) = S_{t+1} G_t'
            for (int k = 0; k < n; k++) {   // row k of O is column k of G_t after -L^-T
                for (int i = 0; i < n; i++) R[i] = -O1[k * n + i];
                unit_upper(n, Lt, R);
                for (int i = 0; i < n; i++) G[i * n + k] = R[i];
            }
            mul_nt(n, n, n, S + (t + 1) * nn, G, C1);
            mul<Op::add>(n, n, n, G, C1, St);
            symmetrise(n, St);
        }
    }
    // the border's part, added once the recursion over S (without it) is complete
    for (int t = 0; t < T; t++) {
        for (int i = 0; i < n; i++)
            for (int c = 0; c < q; c++) {
                double s = 0.0;
                for (int d = 0; d < q; d++) s += J[t * nq + d * n + i] * Ki[d * q + c];
                H[(t * n + i) * static_cast<std::ptrdiff_t>(q) + c] = s;
            }
        const double* Ht = H + t * nq;
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                double s = 0.0, r = 0.0;
                for (int c = 0; c < q; c++) {
                    s += Ht[i * q + c] * J[t * nq + c * n + j];
                    if (t > 0) r += Ht[i * q + c] * J[(t - 1) * nq + c * n + j];
                }
                S[t * nn + i * n + j] += s;
                if (t > 0) C[t * nn + i * n + j] += r;
                else C[i * n + j] = 0.0;
            }
    }
}

}  // namespace HW_ISA
}  // namespace hw
