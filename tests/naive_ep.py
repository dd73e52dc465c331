"""A slow, obvious twin of core/ep.hpp: dense matrices, one site after the other, moments by quadrature."""

import itertools
import math

import numpy as np
from tests import naive_noise

_NODE, _WEIGHT = np.polynomial.legendre.leggauss(200)


def rows_of(problem, s):
    """Return dense rows a, offsets b, (kind, parameters) and stage of every factor on a'X - b, x0 first."""
    start, n = problem["start"], len(problem["m0"])
    T = len(start) - 2
    size = (T + 1) * n
    G = np.eye(n) if problem["G"] is None else problem["G"][0]
    back = np.linalg.inv(G)
    A = problem["A"]
    found = []
    for i in range(n):
        if problem["half0"][i] > 0:
            a = np.zeros(size)
            a[i] = 1
            found.append((a, problem["m0"][i], "box", problem["half0"][i], 0))
    for t in range(1, T + 1):
        At = A[0] if len(A) == 1 else A[t - 1]
        for i in range(n):
            a = np.zeros(size)
            a[t * n : (t + 1) * n] = back[i]
            a[(t - 1) * n : t * n] = -(back @ At)[i]
            if problem["group_w"][i] >= 0:
                found.append((a, (back @ problem["b"][t - 1])[i], "box", s[problem["group_w"][i]], t))
    for t in range(T + 1):
        for k in range(start[t], start[t + 1]):
            a = np.zeros(size)
            a[t * n : (t + 1) * n] = problem["h"][k]
            kind = int(problem["kind"][k])
            if kind == 0:
                own = -1 if problem["group_R"] is None else problem["group_R"][k]
                found.append((a, problem["y"][k], "gauss", problem["R"][k] + (s[own] ** 2 if own >= 0 else 0.0), t))
            elif kind == 1:
                found.append((a, problem["y"][k], "box", s[problem["group"][k]], t))
            else:
                assert kind == 5
                found.append((a, problem["y"][k], "cut", (problem["lo"][k], problem["hi"][k]), t))
    return found, size


def base(problem, s, size):
    """Return precision and shift of what is Gaussian from the start: a Normal x0 (half0 = 0) and the noise Q.

    Q has the squares of the standard deviations besides that are groups.
    """
    n = len(problem["m0"])
    K, h, log = np.zeros((size, size)), np.zeros(size), 0.0
    if not problem["half0"].any():
        W = np.linalg.inv(problem["P0"])
        K[:n, :n] += W
        h[:n] += W @ problem["m0"]
        log += -0.5 * (problem["m0"] @ W @ problem["m0"] + np.linalg.slogdet(2 * np.pi * problem["P0"])[1])
    Q = None if problem["Q"] is None else problem["Q"][0]
    if problem["group_Q"] is not None:
        G = np.eye(n) if problem["G"] is None else problem["G"][0]
        own = np.array([s[g] ** 2 if g >= 0 else 0.0 for g in problem["group_Q"]])
        Q = (G * own) @ G.T + (0.0 if Q is None else Q)
    if Q is not None:
        W = np.linalg.inv(Q)
        for t in range(1, size // n):
            J = np.zeros((n, size))
            J[:, t * n : (t + 1) * n] = np.eye(n)
            J[:, (t - 1) * n : t * n] = -problem["A"][0]
            b = problem["b"][t - 1]
            K += J.T @ W @ J
            h += J.T @ W @ b
            log += -0.5 * (b @ W @ b + np.linalg.slogdet(2 * np.pi * Q)[1])
    return K, h, log


def moments(kind, parameter, mu, c):
    """Return log Z, mean, variance of a factor under N(mu, c)."""
    if kind == "gauss":
        v = c + parameter
        return -0.5 * (math.log(2 * math.pi * v) + mu * mu / v), mu * parameter / v, c * parameter / v
    lo, hi = (-parameter, parameter) if kind == "box" else parameter
    log_z, mean, var = naive_noise.truncated(mu, c, lo, hi)[:3]
    return (log_z - math.log(2 * parameter) if kind == "box" else log_z), mean, var


def cumulants(kind, parameter, mu, c):
    """Return the third and fourth cumulant of N(mu, c) within a factor's ends."""
    lo, hi = (-parameter, parameter) if kind == "box" else parameter
    sd = math.sqrt(c)
    lo, hi = max(lo, mu - 12 * sd), min(hi, mu + 12 * sd)
    z = 0.5 * (lo + hi) + 0.5 * (hi - lo) * _NODE
    p = _WEIGHT * np.exp(-0.5 * ((z - mu) ** 2 - ((z - mu) ** 2).min()) / c)
    p /= p.sum()
    d = z - p @ z
    return p @ d**3, p @ d**4 - 3 * (p @ d**2) ** 2


def second(factors, S, a, found):
    """Return what log Z lacks to second order, of pairs of factors at most four rows apart."""
    total = 0.0
    for k, j in itertools.combinations([k for k, f in enumerate(factors) if f[2] != "gauss"], 2):
        if abs(factors[k][4] - factors[j][4]) > 4:
            continue
        c = a[k] @ S @ a[j] / (a[k] @ S @ a[k]) / (a[j] @ S @ a[j])
        (k3, k4), (j3, j4) = found[k], found[j]
        total += k3 * j3 * c**3 / 6 + k4 * j4 * c**4 / 24
    return total


def propagate(problem, s, sweeps=60):
    """Return mean (T + 1, n), covariances, log Z and what it lacks to second order."""
    factors, size = rows_of(problem, s)
    n = len(problem["m0"])
    K0, h0, log0 = base(problem, s, size)
    a = np.array([f[0] for f in factors])
    b = np.array([f[1] for f in factors])
    tau = np.array([3 / f[3] ** 2 if f[2] == "box" else 1 / f[3] if f[2] == "gauss" else 0.0 for f in factors])
    nu = np.zeros(len(factors))
    tau[[f[2] == "cut" for f in factors]] = 1e-9
    for _ in range(sweeps):
        for k, (row, off, kind, parameter, _) in enumerate(factors):
            S = np.linalg.inv(K0 + (a.T * tau) @ a)
            x = S @ (h0 + a.T @ (nu + tau * b))
            v, z = row @ S @ row, row @ x - off
            c = 1 / (1 / v - tau[k])
            mu = c * (z / v - nu[k])
            _, mean, var = moments(kind, parameter, mu, c)
            tau[k], nu[k] = 1 / var - 1 / c, mean / var - mu / c
    K = K0 + (a.T * tau) @ a
    h = h0 + a.T @ (nu + tau * b)
    S = np.linalg.inv(K)
    x = S @ h
    log_z = log0 + 0.5 * (h @ x + size * math.log(2 * math.pi) - np.linalg.slogdet(K)[1])
    bent = {}
    for k, (row, off, kind, parameter, _) in enumerate(factors):
        v, z = row @ S @ row, row @ x - off
        c = 1 / (1 / v - tau[k])
        mu = c * (z / v - nu[k])
        if kind != "gauss":
            bent[k] = cumulants(kind, parameter, mu, c)
        log_k = moments(kind, parameter, mu, c)[0]
        f = 1 + tau[k] * c
        inside = 0.5 * ((nu[k] ** 2 * c + 2 * nu[k] * mu - tau[k] * mu**2) / f - math.log(f))
        # the site exp(nu z - tau z^2 / 2) in z = row x - off, as a factor of X
        log_z += log_k - inside - (nu[k] * off + 0.5 * tau[k] * off**2)
    blocks = np.array([S[t * n : (t + 1) * n, t * n : (t + 1) * n] for t in range(size // n)])
    return x.reshape(-1, n), blocks, log_z, second(factors, S, a, bent)
