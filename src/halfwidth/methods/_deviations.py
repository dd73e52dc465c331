"""Extended and unscented Kalman filter and smoother in NumPy, for functions that cannot be compiled.

A belief is a mean and deviations D with P = D W D': the columns of the Cholesky factor of P (extended) or the sigma
points (unscented). A function turns deviations DX of x into deviations DY of its value; then

    S = DY W DY' + R,  K = DX W DY' S^-1,  M = (DX - K DY) W (DX - K DY)' + K R K'

is the correction by an output with noise R and, with g and Q in the place of h and R, the smoother's gain and what is
left of P once the next state is known. The core's ``nonlinear_run`` is the same algorithm on tapes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from halfwidth.array import Array

_EPS = float(np.finfo(np.float64).eps)
_LOG_2PI = float(np.log(2.0 * np.pi))


class Function(NamedTuple):
    """One of g and h on a row: its value (m,), its Jacobian (m, n), and which of its values are angles (m,)."""

    value: Callable[[Array, int], Array]
    jacobian: Callable[[Array, int, Array], Array]
    wrap: Any


class Spread(NamedTuple):
    """Sigma points: distance in standard deviations, covariance weight of the centre, weight of each other one.

    A distance of 0 means linearise.
    """

    distance: float
    centre: float
    weight: float


def wrapped(a: Array, wrap: Any) -> Array:
    """Return `a` with the entries flagged in `wrap` in (-pi, pi]."""
    if not np.any(wrap):
        return a
    turned = np.remainder(a, 2.0 * np.pi)
    turned = np.where(turned > np.pi, turned - 2.0 * np.pi, turned)
    return np.where(wrap & ~((a > -np.pi) & (a <= np.pi)), turned, a)


def factor(S: Array) -> tuple[Array, bool]:
    """Return the Cholesky factor of a semidefinite matrix, vanished pivots left out, and whether it is one."""
    n = len(S)
    tol = 16.0 * _EPS * (n + 1)
    try:
        L: Array = np.linalg.cholesky(S).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:
        pass
    else:
        if np.all(np.diag(L) ** 2 > np.maximum(tol * np.diag(S), 1e-300)) and np.isfinite(L).all():
            return L, True
    L = np.zeros((n, n))
    good = True
    for j in range(n):
        p = S[j, j] - L[j, :j] @ L[j, :j]
        if p > tol * S[j, j] and p >= 1e-300 and np.isfinite(p):
            L[j, j] = np.sqrt(p)
            L[j + 1 :, j] = (S[j + 1 :, j] - L[j + 1 :, :j] @ L[j, :j]) / L[j, j]
        else:
            good = good and bool(p >= -1e3 * tol * abs(S[j, j]))
    return L, good


def _solve(L: Array, b: Array) -> tuple[Array, Array]:
    """Return L^-1 b and (L L')^-1 b, zero along vanished pivots."""
    if np.all(np.diag(L) > 0):
        first: Array = np.linalg.solve(L, b).astype(np.float64, copy=False)
        return first, np.asarray(np.linalg.solve(L.T, first), dtype=np.float64)
    half = np.array(b, dtype=np.float64)
    n = len(L)
    for i in range(n):
        half[i] = (half[i] - L[i, :i] @ half[:i]) / L[i, i] if L[i, i] > 0 else 0.0
    whole = half.copy()
    for i in range(n - 1, -1, -1):
        whole[i] = (whole[i] - L[i + 1 :, i] @ whole[i + 1 :]) / L[i, i] if L[i, i] > 0 else 0.0
    return half, whole


def _symmetric(P: Array) -> Array:
    return np.asarray(0.5 * P + 0.5 * P.T)


@np.errstate(all="ignore")  # what leaves the range of numbers is caught where it would be used
def scan(
    g: Function,
    h: Function,
    Q: Callable[[int], Array],
    R: Callable[[int], Array],
    x0: Array,
    P0: Array,
    y: Array,
    seen: Any,
    spread: Spread,
    *,
    iterations: int = 1,
    about: Array | None = None,
    smooth: bool = False,
) -> dict[str, Any]:
    """Run the filter, and the smoother if asked; arguments and answer as the core's ``nonlinear_run``."""
    T, n = len(y), len(x0)
    sigma = spread.distance > 0.0
    if sigma:
        W = np.full(2 * n + 1, spread.weight)
        W[0] = spread.centre
    else:
        W = np.ones(n)
    safe = np.maximum(W, 0.0)
    counts: dict[str, list[int]] = {k: [0, -1] for k in ("bad_g", "bad_h", "repaired", "contradicted")}

    def count(name: str, t: int) -> None:
        counts[name] = [counts[name][0] + 1, t if counts[name][0] == 0 else counts[name][1]]

    def deviations(L: Array) -> Array:
        return np.hstack([np.zeros((n, 1)), spread.distance * L, -spread.distance * L]) if sigma else L

    def propagate(f: Function, x: Array, DX: Array, point: Array, k: int, P: Array) -> tuple[Array, Array] | None:
        if sigma:
            values = np.array([f.value(x + d, k) for d in DX.T]).T
            away = wrapped(values - values[:, :1], np.broadcast_to(f.wrap[:, None], values.shape))
            shift = spread.weight * away[:, 1:].sum(axis=1)
            mean, DY = values[:, 0] + shift, away - shift[:, None]
        else:
            J = f.jacobian(point, k, P)
            mean = f.value(point, k)
            if not np.isfinite(J).all():
                return None
            if point is not x:
                mean = mean + J @ wrapped(x - point, g.wrap)
            DY = J @ DX
        return (mean, DY) if np.isfinite(mean).all() and np.isfinite(DY).all() else None

    def condition(V: Array, DX: Array, DY: Array, noise: Array) -> tuple[Array, Array, Array, Array, bool]:
        S = _symmetric((DY * V) @ DY.T + noise)
        L, good = factor(S)
        K = _solve(L, (DY * V) @ DX.T)[1].T
        E = DX - K @ DY
        M = _symmetric((E * V) @ E.T + K @ noise @ K.T)
        F, fine = factor(M)
        return L, K, M, F, good and fine

    x, P = np.array(x0), np.array(P0)
    L, good = factor(P)
    if not good:
        count("repaired", 0)
    xs, Ps = np.empty((T, n)), np.empty((T, n, n))
    xps, Gs, Ms = np.empty((T, n)), np.empty((T, n, n)), np.empty((T, n, n))
    loglik, nis = np.zeros(T), np.zeros(T)
    for t in range(T):
        Qt, Rt = Q(t), R(t)
        repaired = contradicted = False
        DX = deviations(L)
        moved = propagate(g, x, DX, x if about is None else about[t], t, P)
        if moved is not None:
            xp, DY = moved
            Pp = _symmetric((DY * W) @ DY.T + Qt)
            if not np.isfinite(Pp).all():
                moved = None
        if moved is None:
            count("bad_g", t)
            xp, DY, Pp = x, DX, _symmetric(P + Qt)
        xp = wrapped(xp, g.wrap)
        if smooth:
            *_, fine = found = condition(W, DX, DY, Qt)
            if not fine and sigma:
                repaired = True
                found = condition(safe, DX, DY, Qt)
            Gs[t], Ms[t], xps[t] = found[1], found[2], xp
        L, good = factor(Pp)
        if not good:
            repaired = True
            if sigma:
                Pp = _symmetric((DY * safe) @ DY.T + Qt)
                L, _ = factor(Pp)
        x, P = xp, Pp
        there = np.flatnonzero(seen[t])
        if len(there):
            DX = deviations(L)
            xi = xp
            noise = Rt[np.ix_(there, there)]
            row_loglik = row_nis = 0.0
            for k in range(1 if sigma or about is not None else iterations):
                point = about[t + 1] if about is not None else xi if k else xp
                out = propagate(h, xp, DX, point, t, Pp)
                if out is None:
                    break
                mean, DY = out[0][there], out[1][there]
                v = wrapped(y[t, there] - mean, h.wrap[there])
                SL, K, Pn, F, fine = condition(W, DX, DY, noise)
                if not fine:
                    repaired = True
                    if sigma:
                        SL, K, Pn, F, _ = condition(safe, DX, DY, noise)
                xi = xp + K @ v
                if k == 0:
                    z, _ = _solve(SL, v)
                    pivots = np.diag(SL)
                    for r in np.flatnonzero(pivots == 0.0):
                        size = abs(y[t, there[r]]) + abs(mean[r]) + np.sqrt(noise[r, r] + W @ DY[r] ** 2)
                        left = v[r] - SL[r, :r] @ z[:r]
                        contradicted = contradicted or bool(abs(left) > 1e-6 * size)
                    kept = pivots[pivots > 0]
                    row_nis = float(z @ z)
                    row_loglik = -0.5 * (row_nis + 2.0 * float(np.log(kept).sum()) + len(kept) * _LOG_2PI)
            if out is not None and np.isfinite(xi).all() and np.isfinite(Pn).all() and np.isfinite(row_loglik):
                x, P, L = wrapped(xi, g.wrap), Pn, F
                loglik[t], nis[t] = row_loglik, row_nis
            else:
                count("bad_h", t)
                contradicted = False
        if repaired:
            count("repaired", t)
        if contradicted:
            count("contradicted", t)
        xs[t], Ps[t] = x, P
    answer: dict[str, Any] = {"x": xs, "P": Ps, "loglik": loglik, "nis": nis}
    if smooth:
        for t in range(T - 1, -1, -1):
            before = xs[t - 1] if t else np.asarray(x0)
            mean = wrapped(before + Gs[t] @ wrapped(xs[t] - xps[t], g.wrap), g.wrap)
            cov = _symmetric(Ms[t] + Gs[t] @ Ps[t] @ Gs[t].T)
            if t:
                xs[t - 1], Ps[t - 1] = mean, cov
            else:
                answer["x0"], answer["P0"] = mean, cov
    return answer | {k: tuple(v) for k, v in counts.items()}
