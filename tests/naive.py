"""Textbook twins of the Kalman kernels: slow, short and obvious."""

import numpy as np


def at(stack, t):
    """The matrix of row t from a constant (m, n) or a stack (T, m, n)."""
    return stack if stack.ndim == 2 else stack[t]


def kf(A, B, C, Q, R, y, seen, x0, P0, u=None, b=None, d=None):
    """The Kalman filter; unseen entries are deleted. Returns x, P, xp, Pp, loglik of each row."""
    x, P, out = x0, P0, []
    for t in range(len(y)):
        x = at(A, t) @ x + (0 if u is None else at(B, t) @ u[t]) + (0 if b is None else b[t])
        P = at(A, t) @ P @ at(A, t).T + at(Q, t)
        s, xp, Pp, ll = seen[t], x, P, 0.0
        if s.any():
            c, r = at(C, t)[s], at(R, t)[np.ix_(s, s)]
            S = c @ P @ c.T + r
            v = y[t, s] - c @ x - (0 if d is None else d[t, s])
            K = np.linalg.solve(S, c @ P).T
            Z = np.eye(len(x)) - K @ c
            x, P = x + K @ v, Z @ P @ Z.T + K @ r @ K.T
            ll = -0.5 * (v @ np.linalg.solve(S, v) + np.linalg.slogdet(2 * np.pi * S)[1])
        out.append((x, P, xp, Pp, ll))
    return tuple(np.array(column) for column in zip(*out, strict=True))


def rts(A, Q, x, P, xp, Pp, x0, P0):
    """The Rauch-Tung-Striebel smoother. Returns x, P, their values one step before row 0, and cov(x[t], x[t-1])."""
    x, P = np.concatenate((x0[None], x)), np.concatenate((P0[None], P))
    lag_one = np.empty_like(xp[:, :, None] * xp[:, None])
    for t in range(len(xp) - 1, -1, -1):
        a = at(A, t)
        G = np.linalg.solve(Pp[t], a @ P[t]).T
        lag_one[t] = P[t + 1] @ G.T
        Z = np.eye(x.shape[1]) - G @ a
        x[t] = x[t] + G @ (x[t + 1] - xp[t])
        P[t] = Z @ P[t] @ Z.T + G @ (at(Q, t) + P[t + 1]) @ G.T
    return x[1:], P[1:], x[0], P[0], lag_one


def dense(A, B, C, Q, R, y, seen, x0, P0, u=None, b=None, d=None):
    """Mean and covariance of (x[-1], x[0], ..., x[T-1]) given y, as one Gaussian conditioned on one vector."""
    T, nx, ny = len(y), len(x0), y.shape[1]
    mean = np.zeros((T + 1, nx))
    cov = np.zeros(((T + 1) * nx, (T + 1) * nx))
    mean[0], cov[:nx, :nx] = x0, P0
    for t in range(T):
        a, i, j = at(A, t), slice(t * nx, (t + 1) * nx), slice((t + 1) * nx, (t + 2) * nx)
        mean[t + 1] = a @ mean[t] + (0 if u is None else at(B, t) @ u[t]) + (0 if b is None else b[t])
        cov[j, : j.start] = a @ cov[i, : j.start]
        cov[: j.start, j] = cov[j, : j.start].T
        cov[j, j] = a @ cov[i, i] @ a.T + at(Q, t)
    H, N = np.zeros((T * ny, (T + 1) * nx)), np.zeros((T * ny, T * ny))
    for t in range(T):
        k = slice(t * ny, (t + 1) * ny)
        H[k, (t + 1) * nx : (t + 2) * nx], N[k, k] = at(C, t), at(R, t)
    s = seen.ravel()
    H, N, v = H[s], N[np.ix_(s, s)], (y - (0 if d is None else d)).ravel()[s] - H[s] @ mean.ravel()
    S = H @ cov @ H.T + N
    K = np.linalg.solve(S, H @ cov).T
    loglik = -0.5 * (v @ np.linalg.solve(S, v) + np.linalg.slogdet(2 * np.pi * S)[1]) if s.any() else 0.0
    return mean + (K @ v).reshape(T + 1, nx), cov - K @ H @ cov, loglik


def fixed_lag(A, B, C, Q, R, y, seen, x0, P0, lag, **inputs):
    """Row t of the smoother run on rows 0..min(t + lag, T - 1)."""
    X, PP = [], []
    for t in range(len(y)):
        n = min(t + lag + 1, len(y))
        x, P, xp, Pp, _ = kf(A, B, C, Q, R, y[:n], seen[:n], x0, P0, **inputs)
        x, P, *_ = rts(A, Q, x, P, xp, Pp, x0, P0)
        X.append(x[t])
        PP.append(P[t])
    return np.array(X), np.array(PP)


def sums(A, B, C, Q, R, y, seen, x0, P0, u=None, b=None, d=None):
    """Expected sums of a constant model from the dense posterior; see KalmanSums in core/kalman.hpp."""
    mean, cov, _ = dense(A, B, C, Q, R, y, seen, x0, P0, u, b, d)
    nx, ny = len(x0), y.shape[1]
    W, Wx, Xx = np.zeros((nx, nx)), np.zeros((nx, nx)), np.zeros((nx, nx))
    V, Vx, Xy, nV = np.zeros((ny, ny)), np.zeros((ny, nx)), np.zeros((nx, nx)), 0
    nu = 0 if u is None else u.shape[1]
    Wu, Xu, Uu = np.zeros((nx, nu)), np.zeros((nx, nu)), np.zeros((nu, nu))
    for t in range(len(y)):
        i, j = slice(t * nx, (t + 1) * nx), slice((t + 1) * nx, (t + 2) * nx)
        J = np.hstack((-A, np.eye(nx)))
        pair = np.block([[cov[i, i], cov[i, j]], [cov[j, i], cov[j, j]]])
        w = mean[t + 1] - A @ mean[t] - (0 if u is None else B @ u[t]) - (0 if b is None else b[t])
        W += J @ pair @ J.T + np.outer(w, w)
        Wx += (J @ pair)[:, :nx] + np.outer(w, mean[t])
        Xx += cov[i, i] + np.outer(mean[t], mean[t])
        if u is not None:
            Wu, Xu, Uu = Wu + np.outer(w, u[t]), Xu + np.outer(mean[t], u[t]), Uu + np.outer(u[t], u[t])
        s = seen[t]
        if s.any():
            M = np.zeros((ny, ny))
            M[:, s] = R[:, s] @ np.linalg.inv(R[np.ix_(s, s)])
            v = np.where(s, y[t] - (0 if d is None else d[t]) - C @ mean[t + 1], 0.0)
            c = np.where(s[:, None], C, 0.0)
            P, x = cov[j, j], mean[t + 1]
            V += M @ (np.outer(v, v) + c @ P @ c.T) @ M.T + R - M @ np.where(s[:, None], R, 0.0)
            Vx += M @ (np.outer(v, x) - c @ P)
            Xy += P + np.outer(x, x)
            nV += 1
    return {"W": W, "Wx": Wx, "Wu": Wu, "Xx": Xx, "Xu": Xu, "Uu": Uu, "V": V, "Vx": Vx, "Xy": Xy, "nV": nV}
