"""Slow, obvious twins of core/constrain.hpp."""

import itertools
import math

import numpy as np
from tests.naive_noise import truncated


def cut(a, b):
    """Mean and variance of a standard normal cut to [a, b], by quadrature."""
    if a == -math.inf and b == math.inf:
        return 0.0, 1.0
    _, mean, var, *_ = truncated(0.0, 1.0, a, b)
    return mean, var


def simon(x, P, f, lo, hi):
    """One constraint as the paper has it: P = T W T', and rho turns W^1/2 T' f into the first axis."""
    W, T = np.linalg.eigh(P)
    W = np.maximum(W, 0.0)
    root = np.sqrt(W)
    s = math.sqrt(f @ P @ f)
    first = root * (T.T @ f) / s
    # Gram-Schmidt from that direction over the unit vectors
    rows = [first]
    for e in np.eye(len(x)):
        r = e - sum((q @ e) * q for q in rows)
        r -= sum((q @ r) * q for q in rows)
        if np.linalg.norm(r) > 1e-8 and len(rows) < len(x):
            rows.append(r / np.linalg.norm(r))
    rho = np.array(rows)
    mean, var = cut((lo - f @ x) / s, (hi - f @ x) / s)
    back = T @ np.diag(root) @ rho.T
    z = np.zeros(len(x))
    z[0] = mean
    return x + back @ z, back @ np.diag([var] + [1.0] * (len(x) - 1)) @ back.T


def truncate(x, P, D, lo, hi):
    """One cut a constraint, the most broken first."""
    left = list(range(len(D)))
    while left:
        out = [max(lo[i] - D[i] @ x, D[i] @ x - hi[i]) / math.sqrt(D[i] @ P @ D[i]) for i in left]
        i = left.pop(int(np.argmax(out)))
        x, P = simon(x, P, D[i], lo[i], hi[i])
    return x, P


def ep(x, P, D, lo, hi, sweeps=200):
    """Expectation propagation in information form, every moment from a fresh inverse."""
    m = len(D)
    tau, nu = np.zeros(m), np.zeros(m)
    base = np.linalg.inv(P)
    for _ in range(sweeps):
        for i in range(m):
            others = np.arange(m) != i
            S = np.linalg.inv(base + (D[others].T * tau[others]) @ D[others])
            mean = S @ (base @ x + D[others].T @ nu[others])
            c, mu = D[i] @ S @ D[i], D[i] @ mean
            sd = math.sqrt(c)
            shift, var = cut((lo[i] - mu) / sd, (hi[i] - mu) / sd)
            tau[i] = (1.0 / var - 1.0) / c
            nu[i] = (mu + sd * shift) / (c * var) - mu / c
    S = np.linalg.inv(base + (D.T * tau) @ D)
    return S @ (base @ x + D.T @ nu), S


def project(x, M, D, lo, hi):
    """Nearest feasible point in the metric M = W^-1, trying every set of active rows; None if there is none."""
    best, found = math.inf, None
    choices = [[None] + [v for v in {lo[i], hi[i]} if math.isfinite(v)] for i in range(len(D))]
    for ends in itertools.product(*choices):
        active = [i for i, v in enumerate(ends) if v is not None]
        if len(active) > len(x):
            continue
        z = x.copy()
        if active:
            A, b = D[active], np.array([ends[i] for i in active])
            G = A @ M @ A.T
            lam = np.linalg.pinv(G, rcond=1e-10) @ (b - A @ x)
            z = x + M @ A.T @ lam
            if np.abs(A @ z - b).max() > 1e-8:
                continue
        s = D @ z
        if np.any(s < lo - 1e-9) or np.any(s > hi + 1e-9):
            continue
        far = 0.0 if not active else lam @ G @ lam
        if far < best:
            best, found = far, z
    return found


def box_moments(x, P, lo, hi, points=160):
    """Mean and covariance of N(x, P) in a box of three dimensions: quadrature over two, the third one in closed form."""
    from scipy.special import log_ndtr, ndtr

    node, weight = np.polynomial.legendre.leggauss(points)
    sd = np.sqrt(np.diag(P))
    ends = [(max(lo[i], x[i] - 12 * sd[i]), min(hi[i], x[i] + 12 * sd[i])) for i in range(3)]
    u, v = (0.5 * (b + a) + 0.5 * (b - a) * node for a, b in ends[:2])
    U, V = np.meshgrid(u, v, indexing="ij")
    top = np.stack([U, V], axis=-1) - x[:2]
    inverse = np.linalg.inv(P[:2, :2])
    log_f = -0.5 * np.einsum("ijk,kl,ijl->ij", top, inverse, top)
    gain = P[2, :2] @ inverse
    c = P[2, 2] - gain @ P[:2, 2]
    mu, s = x[2] + top @ gain, math.sqrt(c)
    a, b = (lo[2] - mu) / s, (hi[2] - mu) / s
    flip = a > 0
    a, b = np.where(flip, -b, a), np.where(flip, -a, b)
    # log of Phi(b) - Phi(a), without cancellation where both ends are on the left
    log_z = np.where(b < 0, log_ndtr(b) + np.log1p(-np.exp(log_ndtr(a) - log_ndtr(b))), np.log(ndtr(b) - ndtr(a)))

    def phi(t):
        return np.where(np.isfinite(t), np.exp(-0.5 * np.square(t) - log_z) / math.sqrt(2 * math.pi), 0.0)

    shift = phi(a) - phi(b)
    var = 1 + np.where(np.isfinite(a), a, 0) * phi(a) - np.where(np.isfinite(b), b, 0) * phi(b) - shift**2
    m3 = mu + s * np.where(flip, -shift, shift)
    v3 = c * var
    f = np.exp(log_f + log_z - (log_f + log_z).max()) * weight[:, None] * weight
    f /= f.sum()
    X = np.stack([U, V, m3], axis=-1)
    mean = np.einsum("ij,ijk->k", f, X)
    C = np.einsum("ij,ijk,ijl->kl", f, X - mean, X - mean)
    C[2, 2] += (f * v3).sum()
    density = np.exp(log_f + log_z) * weight[:, None] * weight
    area = 0.25 * np.prod([b - a for a, b in ends[:2]])
    mass = float(density.sum() * area / (2 * math.pi * math.sqrt(np.linalg.det(P[:2, :2]))))
    return mean, C, mass
