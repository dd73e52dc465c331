"""Textbook twin of the mixed-noise kernel: one scalar output after the other, every matrix written out."""

import numpy as np
from tests.naive_noise import truncated


def ellipsoid_sum(X, G, weight):
    """The ellipsoid around the sum of one ellipsoid and segments whose weighted trace is least."""
    terms = [X, *(np.outer(g, g) for g in G.T)]
    sizes = [np.sqrt(weight @ np.diag(term)) for term in terms]
    return sum(sizes) * sum((t / size for t, size in zip(terms, sizes, strict=True) if size > 0), np.zeros_like(X))


def reduce(Z, capacity, weight):
    """Box the generators closest to an axis and smallest until `capacity` are left; rows are generators."""
    n = Z.shape[1]
    if len(Z) <= capacity:
        return Z
    scaled = np.abs(Z) * np.sqrt(weight)
    order = np.argsort((1 + 1e-6) * scaled.sum(axis=1) - scaled.max(axis=1), kind="stable")
    away, kept = order[: len(Z) - (capacity - n)], order[len(Z) - (capacity - n) :]
    box = np.diag(np.abs(Z[away]).sum(axis=0))
    return np.vstack([Z[kept], box[box.any(axis=1)]])


def scales(a):
    """1/a and 1/(1-a); a = 0 and a = 1 leave the state's or the output's set out."""
    return (0.0 if a == 0 else 1 / a), (0.0 if a == 1 else 1 / (1 - a))


def gain(P, X, c, r, half, kappa, a, set_gain=False):
    """K of one a."""
    alpha, beta = scales(a)
    S = alpha * c @ X @ c + beta * half**2
    if set_gain and S > 0:
        return alpha * X @ c / S
    return (kappa**2 * P @ c + alpha * X @ c) / (S + kappa**2 * (c @ P @ c + r))


def corrected(P, X, c, r, half, K, a):
    """P and X after the correction by any gain."""
    alpha, beta = scales(a)
    F = np.eye(len(c)) - np.outer(K, c)
    return F @ P @ F.T + r * np.outer(K, K), alpha * F @ X @ F.T + beta * half**2 * np.outer(K, K)


def cost(P, X, c, r, half, kappa, a, *, criterion="trace", set_gain=False, output=3.0, tau=None):
    """What the scalar a is chosen by."""
    K = gain(P, X, c, r, half, kappa, a, set_gain)
    Pn, Xn = corrected(P, X, c, r, half, K, a)
    S = c @ P @ c + r
    if tau is not None:
        g = K * S - P @ c
        Pn = Pn + (tau - 1 / S) * np.outer(g, g)
    size = np.diag(kappa**2 * P + X)
    weight = np.where(size > 0, 1 / np.where(size > 0, size, 1), 0)
    along = output / (c @ (kappa**2 * P + X) @ c)
    pairs = [*zip(weight, np.diag(Pn), np.diag(Xn), strict=True), (along, c @ Pn @ c, c @ Xn @ c)]
    if criterion == "trace":
        return sum(w * (kappa**2 * p + x) for w, p, x in pairs)
    return sum(np.sqrt(w) * (np.sqrt(max(x, 0)) + kappa * np.sqrt(max(p, 0))) for w, p, x in pairs)


def run(A, b, Q, G, C, r, half, y, seen, m, P, X, Z, *, form, kappa, a_used, capacity, set_gain=False, truncate=False,
        shrink=False):  # fmt: skip
    """The filter with the scalars `a_used` given. Returns m, P, X and half-widths of each row, and Z of the last."""
    out = []
    for t in range(len(y)):
        m, P = A @ m + b[t], A @ P @ A.T + Q
        moved = A @ X @ A.T
        size = np.diag(kappa**2 * P + moved) + (G**2).sum(axis=1)
        X = ellipsoid_sum(moved, G, np.where(size > 0, 1 / np.where(size > 0, size, 1), 0))
        Z = np.vstack([Z @ A.T, G.T[np.abs(G.T).sum(axis=1) > 0]])
        for i in np.flatnonzero(seen[t]):
            c, a = C[i], a_used[t, i]
            reach = np.sqrt(max(c @ X @ c, 0)) if form == "ellipsoid" else np.abs(Z @ c).sum()
            if form == "combined":
                reach = min(reach, np.sqrt(max(c @ X @ c, 0)))
            S, nu, B = c @ P @ c + r[i], y[t, i] - c @ m, reach + half[i]
            if form == "zonotope":
                K = _covariation(P, Z, c, r[i], half[i], kappa)
                Pn = corrected(P, X, c, r[i], half[i], K, 1.0)[0]
            else:
                K = gain(P, X, c, r[i], half[i], kappa, a, set_gain)
                Pn, Xn = corrected(P, X, c, r[i], half[i], K, a)
                if shrink:
                    apart = max(0.0, abs(nu) - kappa * np.sqrt(S))
                    room = np.array(scales(a)) @ [c @ X @ c, half[i] ** 2]
                    Xn = Xn * (1 - apart**2 / room) if apart**2 < room else Xn
                X = Xn
            m = m + K * nu
            if truncate:
                _, mean, var = truncated(nu, S, -B, B)[:3]
                g = K * S - P @ c
                m = m + g / S * (mean - nu)
                Pn = Pn - np.outer(g, g) * (1 - var / S) / S
            P = Pn
            Z = Z - np.outer(Z @ c, K)
            if half[i] > 0:
                Z = np.vstack([Z, half[i] * K])
        size = np.diag(kappa**2 * P) + (Z**2).sum(axis=0)
        Z = reduce(Z, capacity, np.where(size > 0, 1 / np.where(size > 0, size, 1), 0))
        widths = {"ellipsoid": np.sqrt(np.diag(X)), "zonotope": np.abs(Z).sum(axis=0)}
        widths["combined"] = np.minimum(*widths.values())
        out.append((m, P, X, widths[form]))
    return (*(np.array(column) for column in zip(*out, strict=True)), Z)


def _covariation(P, Z, c, r, half, kappa):
    M = kappa**2 * P + Z.T @ Z
    return M @ c / (c @ M @ c + kappa**2 * r + half**2)
