"""Slow, obvious twins of core/ep_handover.hpp: what a solved window takes over and hands on."""

import numpy as np


def known(free, pull, precision):
    """Return pull and precision of the free half-widths alone, whatever the others are, as a proper Gaussian."""
    f, rest = np.flatnonzero(free), np.flatnonzero(~free)
    H, h = precision[np.ix_(f, f)], pull[f]
    if rest.size and precision[rest].any():
        gain = precision[np.ix_(f, rest)] @ np.linalg.pinv(precision[np.ix_(rest, rest)], hermitian=True)
        H, h = H - gain @ precision[np.ix_(rest, f)], h - gain @ pull[rest]
    d = np.sqrt(np.abs(np.diagonal(H)))
    unit = np.where(d > 0, d, 1.0)
    value, vector = np.linalg.eigh(H / unit / unit[:, None])
    keep = value > 0
    basis = vector[:, keep] * unit[:, None]
    found_pull, found = np.zeros(len(free)), np.zeros((len(free), len(free)))
    found[np.ix_(f, f)] = (basis * value[keep]) @ basis.T
    found_pull[f] = basis @ (vector[:, keep].T @ (h / unit))
    return found_pull, found


def taken(free, start, pull, precision, power):
    """Return pull, precision and power of the free half-widths alone, proper, the powers to second order about `start`."""
    curve = np.where(free & (power > 0), power / start**2, 0.0)
    found_pull, found = known(free, pull + 2 * curve * start, precision + np.diag(curve))
    keep = (curve > 0) & (np.diagonal(found) >= curve)
    return found_pull - np.where(keep, 2 * curve * start, 0), found - np.diag(keep * curve), np.where(keep, power, 0.0)


def told(free, found, before=None):
    """Return pull, precision and power of what a window tells; `before`: precision and power known already, for one node."""
    f = np.flatnonzero(free)
    q, K = f.size, int(found["nodes"])
    pull, precision, power = np.zeros(len(free)), np.zeros((len(free), len(free))), np.zeros(len(free))
    log_weight = found["log_weight"][:K]
    s = np.exp(found["phi"][:K, :q])
    g = found["slope"][:K, :q] / s
    if K == 1:
        H = found["H"][:q, :q] / (s[0][:, None] * s[0])
        if before is not None:
            H = H - before[0][np.ix_(f, f)] - np.diag(before[1][f] / s[0] ** 2)
        h = g[0] + H @ s[0]
    else:
        sound = np.isfinite(log_weight) & np.isfinite(g).all(axis=1)
        s, g, log_weight, second = s[sound], g[sound], log_weight[sound], found["second"][:K][sound]
        if len(s) < 2 * q + 2:
            return pull, precision, power
        for flat in (1.0, 0.5, 0.25, 0.0):
            w = np.exp(flat * (log_weight - log_weight.max()))
            w /= w.sum()
            if 1.0 / (w @ w) > 2 * q + 2:
                break
        mean = w @ s
        ds = s - mean
        S = (w[:, None] * ds).T @ ds
        S[np.diag_indices(q)] *= 1.0 + 1e-6
        for j in range(q):  # the part of 1 / s_j that no line in s explains
            over = 1.0 / s[:, j] - w @ (1.0 / s[:, j])
            line = np.linalg.solve(S, ds.T @ (w * over))
            left, felt = w @ over**2 - (ds.T @ (w * over)) @ line, w @ (over * (g[:, j] - w @ g[:, j]))
            felt -= (ds.T @ (w * (g[:, j] - w @ g[:, j]))) @ line
            own = np.linalg.solve(S, ds.T @ (w * (g[:, j] - w @ g[:, j])))[j]
            if len(s) >= 2 * q + 4 and left > 1e-3 * (w @ over**2) and felt > 0 and own < 0 and line[j] < 0:
                power[f[j]] = min(felt / left, own / line[j])
        g = g - power[f] / s
        level = w @ g
        H = -np.linalg.solve(S, (w[:, None] * ds).T @ (g - level))
        H = 0.5 * (H + H.T)
        h = level + np.linalg.solve(S, ds.T @ (w * second)) + H @ mean
    precision[np.ix_(f, f)] = H
    pull[f] = h
    return pull, precision, power


def widths(free, found):
    """Return mean, sd, 5 and 95 % quantile of the free half-widths, and the effective number of nodes."""
    f = np.flatnonzero(free)
    K, phi = int(found["nodes"]), found["phi"][: int(found["nodes"])]
    s = np.exp(phi[:, : f.size])
    if K == 1:
        blur = np.diagonal(np.linalg.inv(found["H"]))[: f.size]
        sd = s[0] * np.sqrt(blur)
        return s[0], sd, np.maximum(s[0] - 1.645 * sd, 0.0), s[0] + 1.645 * sd, 1.0
    w = np.exp(found["log_weight"][:K] - found["log_weight"][:K].max())
    w /= w.sum()
    mean = w @ s
    lo, hi = np.zeros(f.size), np.zeros(f.size)
    for j in range(f.size):
        order = np.argsort(s[:, j])
        below = np.cumsum(w[order])
        lo[j] = s[order[np.searchsorted(below, 0.05)], j]
        hi[j] = s[order[min(int(np.searchsorted(below, 0.95)), K - 1)], j]
    return mean, np.sqrt(w @ (s - mean) ** 2), lo, hi, float(1.0 / (w @ w))


def edge(problem, sites):
    """Return mean and covariance of every state of a chain given what lies up to it, by its sites."""
    n = len(problem["m0"])
    m, D = (np.asarray(v).reshape(-1, n) for v in sites[:2])
    tau, nu = (np.ravel(v) for v in sites[2:])

    def at(name, t):
        stack = problem.get(name)
        if stack is None:
            return None
        index = problem.get(f"{name}_index")
        return stack[index[t] if index is not None else t if len(stack) > 1 else 0]

    x, P = problem["m0"] + m[0], problem["P0"] + np.diag(D[0])
    means, covs = [], []
    for t in range(len(m)):
        if t:
            A, G, Q = at("A", t - 1), at("G", t - 1), at("Q", t - 1)
            x = A @ x + problem["b"][t - 1] + (m[t] if G is None else G @ m[t])
            P = A @ P @ A.T + (np.diag(D[t]) if G is None else (G * D[t]) @ G.T)
            P = P if Q is None else P + Q
        for k in range(int(problem["start"][t]), int(problem["start"][t + 1])):
            h = problem["h"][k]
            Ph = P @ h
            left = 1.0 + tau[k] * float(h @ Ph)
            if left > 1e-9:
                x = x + Ph * ((nu[k] - tau[k] * float(h @ x - problem["y"][k])) / left)
                P = P - np.outer(Ph, Ph) * (tau[k] / left)
        means.append(x)
        covs.append(0.5 * (P + P.T))
    return np.array(means), np.array(covs)
