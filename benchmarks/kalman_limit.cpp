// The limit: Kalman filter and Rauch-Tung-Striebel smoother as one writes them by hand for fixed sizes, compiled with
// g++ -O3. Short update, symmetrised; the predictions are stored, so that the smoother need not repeat them. It writes
// the same smoothed means and covariances as the library, into buffers that are already in memory.
#include <cmath>
#include <cstring>

namespace {

constexpr int n = 4, m = 2;

// S (m,m) symmetric positive definite, inverted in closed form
inline double inverse(const double (&S)[m][m], double (&Si)[m][m]) {
    const double det = S[0][0] * S[1][1] - S[0][1] * S[1][0], r = 1.0 / det;
    Si[0][0] = S[1][1] * r;
    Si[1][1] = S[0][0] * r;
    Si[0][1] = -S[0][1] * r;
    Si[1][0] = -S[1][0] * r;
    return det;
}

}  // namespace

// y (T,m), seen (T) rows; xf, xp, xs (T,n); Pf, Pp, Ps (T,n,n). Returns the log-likelihood.
extern "C" double kf_rts(long T, const double* A, const double* C, const double* Q, const double* R, const double* y,
                         const unsigned char* seen, const double* x0, const double* P0, double* xf, double* Pf, double* xp,
                         double* Pp, double* xs, double* Ps) {
    double x[n], P[n][n], ll = 0.0;
    std::memcpy(x, x0, sizeof x);
    std::memcpy(P, P0, sizeof P);
    for (long t = 0; t < T; t++) {
        double a[n], AP[n][n];
        for (int i = 0; i < n; i++) {
            a[i] = 0.0;
            for (int k = 0; k < n; k++) a[i] += A[i * n + k] * x[k];
            for (int j = 0; j < n; j++) {
                AP[i][j] = 0.0;
                for (int k = 0; k < n; k++) AP[i][j] += A[i * n + k] * P[k][j];
            }
        }
        for (int i = 0; i < n; i++) {
            x[i] = a[i];
            for (int j = 0; j <= i; j++) {
                double s = Q[i * n + j];
                for (int k = 0; k < n; k++) s += AP[i][k] * A[j * n + k];
                P[i][j] = P[j][i] = s;
            }
        }
        std::memcpy(xp + t * n, x, sizeof x);
        std::memcpy(Pp + t * n * n, P, sizeof P);
        if (seen[t]) {
            double PC[n][m], S[m][m], Si[m][m], K[n][m], v[m];
            for (int i = 0; i < n; i++)
                for (int j = 0; j < m; j++) {
                    PC[i][j] = 0.0;
                    for (int k = 0; k < n; k++) PC[i][j] += P[i][k] * C[j * n + k];
                }
            for (int i = 0; i < m; i++) {
                v[i] = y[t * m + i];
                for (int k = 0; k < n; k++) v[i] -= C[i * n + k] * x[k];
                for (int j = 0; j < m; j++) {
                    S[i][j] = R[i * m + j];
                    for (int k = 0; k < n; k++) S[i][j] += C[i * n + k] * PC[k][j];
                }
            }
            const double det = inverse(S, Si);
            double q = 0.0;
            for (int i = 0; i < m; i++)
                for (int j = 0; j < m; j++) q += v[i] * Si[i][j] * v[j];
            ll -= 0.5 * (q + std::log(det) + m * 1.8378770664093454836);
            for (int i = 0; i < n; i++)
                for (int j = 0; j < m; j++) {
                    K[i][j] = 0.0;
                    for (int k = 0; k < m; k++) K[i][j] += PC[i][k] * Si[k][j];
                }
            for (int i = 0; i < n; i++) {
                for (int j = 0; j < m; j++) x[i] += K[i][j] * v[j];
                for (int j = 0; j <= i; j++) {
                    double s = P[i][j];
                    for (int k = 0; k < m; k++) s -= K[i][k] * PC[j][k];
                    P[i][j] = P[j][i] = s;
                }
            }
        }
        std::memcpy(xf + t * n, x, sizeof x);
        std::memcpy(Pf + t * n * n, P, sizeof P);
    }
    std::memcpy(xs + (T - 1) * n, x, sizeof x);
    std::memcpy(Ps + (T - 1) * n * n, P, sizeof P);
    for (long t = T - 2; t >= 0; t--) {
        const double *F = Pf + t * n * n, *M = Pp + (t + 1) * n * n, *N = Ps + (t + 1) * n * n;
        // G' = M^-1 A F by Cholesky
        double L[n][n], G[n][n], D[n][n], GD[n][n];
        for (int j = 0; j < n; j++) {
            double s = M[j * n + j];
            for (int k = 0; k < j; k++) s -= L[j][k] * L[j][k];
            L[j][j] = std::sqrt(s);
            for (int i = j + 1; i < n; i++) {
                double r = M[i * n + j];
                for (int k = 0; k < j; k++) r -= L[i][k] * L[j][k];
                L[i][j] = r / L[j][j];
            }
        }
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                G[i][j] = 0.0;
                for (int k = 0; k < n; k++) G[i][j] += A[i * n + k] * F[k * n + j];
            }
        for (int i = 0; i < n; i++) {
            for (int k = 0; k < i; k++)
                for (int j = 0; j < n; j++) G[i][j] -= L[i][k] * G[k][j];
            for (int j = 0; j < n; j++) G[i][j] /= L[i][i];
        }
        for (int i = n - 1; i >= 0; i--) {
            for (int k = i + 1; k < n; k++)
                for (int j = 0; j < n; j++) G[i][j] -= L[k][i] * G[k][j];
            for (int j = 0; j < n; j++) G[i][j] /= L[i][i];
        }
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) D[i][j] = N[i * n + j] - M[i * n + j];
        for (int i = 0; i < n; i++) {
            xs[t * n + i] = xf[t * n + i];
            for (int k = 0; k < n; k++) xs[t * n + i] += G[k][i] * (xs[(t + 1) * n + k] - xp[(t + 1) * n + k]);
            for (int j = 0; j < n; j++) {
                GD[i][j] = 0.0;
                for (int k = 0; k < n; k++) GD[i][j] += G[k][i] * D[k][j];
            }
        }
        for (int i = 0; i < n; i++)
            for (int j = 0; j <= i; j++) {
                double s = F[i * n + j];
                for (int k = 0; k < n; k++) s += GD[i][k] * G[k][j];
                Ps[t * n * n + i * n + j] = Ps[t * n * n + j * n + i] = s;
            }
    }
    return ll;
}
