"""Textbook twins of the nonlinear family: short formulas, inverses written as inverses, one point at a time."""

import numpy as np


def wrap(a):
    return np.pi - np.remainder(np.pi - a, 2 * np.pi)


def wrapped(a, angles):
    a = np.array(a, dtype=float)
    a[list(angles)] = wrap(a[list(angles)])
    return a


def moments(f, x, P, spread, angles, jacobian=None):
    """Mean of f(x), its covariance without noise, and its covariance with x."""
    n = len(x)
    distance, centre, weight = spread
    if distance == 0:
        J = jacobian(x)
        return f(x), J @ P @ J.T, P @ J.T
    root = distance * np.linalg.cholesky(P)
    points = [x, *(x + root.T), *(x - root.T)]
    values = np.array([f(p) for p in points])
    away = np.array([wrapped(v - values[0], angles) for v in values])
    mean_weights = np.r_[1 - 2 * n * weight, np.full(2 * n, weight)]
    cov_weights = np.r_[centre, np.full(2 * n, weight)]
    shift = mean_weights @ away
    dy = away - shift
    dx = np.array(points) - x
    return values[0] + shift, (cov_weights[:, None] * dy).T @ dy, (cov_weights[:, None] * dx).T @ dy


def filter_smoother(g, h, Q, R, x0, P0, y, seen, spread, angles=((), ()), jacobians=(None, None)):
    """Filter and Rauch-Tung-Striebel smoother; g(x, t), h(x), Q(t), R(t)."""
    x, P, loglik = x0, P0, 0.0
    before, filtered = [], []
    for t in range(len(y)):
        old = x, P
        move = None if jacobians[0] is None else (lambda p, t=t: jacobians[0](p, t))
        xp, Pp, D = moments(lambda p, t=t: g(p, t), x, P, spread, angles[0], move)
        xp, Pp = wrapped(xp, angles[0]), Pp + Q(t)
        before.append((*old, xp, Pp, D))
        x, P = xp, Pp
        s = np.flatnonzero(seen[t])
        if len(s):
            ym, S, D = moments(h, x, P, spread, angles[1], jacobians[1])
            v = wrapped(y[t] - ym, angles[1])[s]
            S = (S + R(t))[np.ix_(s, s)]
            K = D[:, s] @ np.linalg.inv(S)
            x, P = wrapped(x + K @ v, angles[0]), P - K @ S @ K.T
            loglik += -0.5 * (v @ np.linalg.inv(S) @ v + np.linalg.slogdet(2 * np.pi * S)[1])
        filtered.append((x, P))
    smoothed = [filtered[-1]]
    for t in range(len(y) - 1, -1, -1):
        xf, Pf, xp, Pp, D = before[t]
        G = D @ np.linalg.inv(Pp)
        xs, Ps = smoothed[0]
        smoothed.insert(0, (wrapped(xf + G @ wrapped(xs - xp, angles[0]), angles[0]), Pf + G @ (Ps - Pp) @ G.T))
    return filtered, smoothed, loglik
