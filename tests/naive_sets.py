"""Slow, obvious twins of the set recursions: exact boxes by linear programming, one zonotope step, one ellipsoid step."""

import numpy as np
from scipy.optimize import linprog

from halfwidth.methods._residuals import residuals
from halfwidth.record import Record


def exact_box(model, record, k):
    """Smallest and largest value of each state at row k, from the rows up to it; two linear programs a state."""
    part = Record(record.t[: k + 1], record.y[: k + 1], None if record.u is None else record.u[: k + 1])
    rows = residuals(model, part)
    half = rows.S @ np.r_[np.broadcast_to(model.w.q, model.nx), np.broadcast_to(model.e.q, model.ny)]
    n = rows.M.shape[1]
    bounds = [
        (None if np.isinf(a) else a, None if np.isinf(b) else b) for a, b in zip(model.x0.lo, model.x0.hi, strict=True)
    ]
    bounds += [(None, None)] * (n - model.nx)
    M = rows.M.toarray()
    ends = []
    for sign in (1.0, -1.0):
        found = []
        for j in range(model.nx):
            c = np.zeros(n)
            c[n - model.nx + j] = sign
            answer = linprog(c, np.r_[M, -M], np.r_[rows.b + half, half - rows.b], bounds=bounds, method="highs")
            assert answer.status == 0, answer.message
            found.append(sign * answer.fun)
        ends.append(np.array(found))
    return ends[0], ends[1]


def zonotope_move(c, G, A, shift, q):
    """c, G of A x + shift + noise."""
    return A @ c + shift, np.c_[A @ G, np.diag(q)]


def zonotope_gain(c, G, h, z, r):
    """c, G after the strip |z - h x| <= r, with the gain of least Frobenius norm; the strip is first cut to the set."""
    g = h @ G
    lo, hi = max(z - r, h @ c - np.abs(g).sum()), min(z + r, h @ c + np.abs(g).sum())
    z, r = 0.5 * (lo + hi), 0.5 * (hi - lo)
    K = G @ g / (g @ g + r * r)
    return c + K * (z - h @ c), np.c_[G - np.outer(K, g), K * r]


def ellipsoid_fold(c, X, h, z, r, a):
    """c, X after the strip with weight a (Fogel and Huang 1982), the strip first cut to the set."""
    far = np.sqrt(h @ X @ h)
    lo, hi = max(z - r, h @ c - far), min(z + r, h @ c + far)
    z, r = 0.5 * (lo + hi), 0.5 * (hi - lo)
    D = h @ X @ h / a + r * r / (1 - a)
    K = X @ h / (a * D)
    nu = z - h @ c
    return c + K * nu, (1 - nu * nu / D) * (X / a - np.outer(K, K) * D)
