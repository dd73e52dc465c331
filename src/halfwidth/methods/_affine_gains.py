"""Gains of the optimal affine estimator for mixed noise over one window, by second-order cone programming.

Of all estimates that are affine in the outputs of a window, ``x = sum_j D_j b_j + D_0 m + L y``, the one is taken whose
worst half-width is least. With the coefficients of its error, ``D_j = D_{j+1} A_{j+1} - L_j C_j``, plus the identity
where j is the row asked for,

    minimise  sum_j |D_j G_j| + |L| half + |X^{1/2} D_0'|  +  kappa |(P^{1/2} D_0', Q_j^{1/2} D_j', r^{1/2} L')|

for each state [1]_. The first terms bound what the bounded noises can do, whatever it is; the last is the standard
deviation. The program knows no data.

References
----------
.. [1] Donoho (1994), Statistical estimation and optimal recovery, Ann. Statist. 22(1).
"""

import contextlib
import hashlib
from collections import OrderedDict
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.errors import Missing
from halfwidth.methods.mixed import MixedBelief


class Window(NamedTuple):
    """The matrices of a window's rows, (rows, ., .), its outputs that are seen (rows, ny), and the row asked for."""

    A: Array
    Q: Array
    G: Array
    C: Array
    r: Array  # (rows, ny)
    half: Array  # (rows, ny)
    seen: NDArray[np.bool_]
    target: int

    @property
    def rows(self) -> int:
        return len(self.A)


class Design(NamedTuple):
    """Gains of one window and what they make of the errors; see the module.

    D0 (nx, nx) belongs to the belief before the window, D (nx, rows nx) to its inputs, L (nx, outputs seen) to its
    outputs; P (nx, nx) and half (nx,) are covariance and half-widths of the error, that belief's part left out.
    """

    D0: Array
    D: Array
    L: Array
    P: Array
    half: Array

    def apply(self, before: MixedBelief, y: Array, b: Array | None) -> tuple[Array, Array, Array]:
        """Return estimates (k, nx), covariances and half-widths of k windows with these gains.

        `before` holds the beliefs before the windows, (k, nx) and (k, nx, nx), or one prior with its generators; y are
        the outputs seen in them (k, .), b what inputs add to their states (k, rows nx).
        """
        x = before.m @ self.D0.T + y @ self.L.T
        x = x if b is None else x + b @ self.D.T
        P = self.D0 @ before.P @ self.D0.T + self.P
        if len(before.Z):
            reach = np.abs(self.D0 @ before.Z.T).sum(axis=1)
        else:
            reach = np.sqrt(np.maximum(np.einsum("ia,kab,ib->ki", self.D0, before.X, self.D0), 0.0))
        return x, 0.5 * (P + np.swapaxes(P, 1, 2)), reach + self.half


#: Designs that are held for other records of the same model, least recently used away first.
_HELD = 4096
_held: OrderedDict[bytes, Design | None] = OrderedDict()


def design(window: Window, before: MixedBelief, kappa: float) -> Design | None:
    """Return the best gains of one window, held from an earlier call if they were found before.

    A design depends on nothing but its arguments, so whether it was held makes no difference but to the time.
    """
    mark = hashlib.blake2b(
        np.array([kappa, window.target, *window.A.shape, *window.C.shape, *window.G.shape, len(before.Z)]).tobytes()
    )
    for part in (*window[:-1], *before[1:]):
        mark.update(part.tobytes())
    key = mark.digest()
    if key in _held:
        with contextlib.suppress(KeyError):  # another thread may have dropped it meanwhile
            _held.move_to_end(key)
            return _held[key]
    found = optimal(window, before, kappa)
    _held[key] = found
    while len(_held) > _HELD:
        with contextlib.suppress(KeyError):
            _held.popitem(last=False)
    return found


def optimal(window: Window, before: MixedBelief, kappa: float) -> Design | None:
    """Return the best gains of one window, or None if no program was solved.

    Parameters
    ----------
    window : the rows, laid out by `mixed_rows`
    before : MixedBelief
        What is known one step before the first: P and X, or P and the generators Z where there are any.
    kappa : float
    """
    N, n, ng = window.rows, window.A.shape[1], window.G.shape[2]
    rows, outputs = np.nonzero(window.seen)
    C, r, half = window.C[rows, outputs], window.r[rows, outputs], window.half[rows, outputs]
    p = len(rows)
    roots = np.array([root(S) for S in (before.P, *window.Q)])  # (N + 1, n, n)
    X = np.zeros((n, n)) if len(before.Z) else root(before.X)
    boxes = [before.Z.T, *window.G]  # (n, .) each
    # In units of the states' and outputs' own sizes, so that the solver sees numbers about 1.
    size = np.sqrt(
        kappa**2 * np.max(np.sum(roots**2, axis=2), axis=0) + np.sum(X**2, axis=1)
        + np.max([np.sum(box**2, axis=1) for box in boxes], axis=0)
    )  # fmt: skip
    size = np.where(size > 0, size, size.max() if size.any() else 1.0)
    weight = np.sqrt((C * size) ** 2 @ np.ones(n) + kappa**2 * r + half**2)
    weight = np.where(weight > 0, weight, 1.0)
    L = np.zeros((n, p))
    if p:
        problem = _Program(
            window.A, C / weight[:, None], np.sqrt(r) / weight, half / weight, rows, roots, X, boxes, size, kappa
        )  # fmt: skip
        for i in range(n):
            gains = problem.solve(window.target, i)
            if gains is None:
                return None
            L[i] = size[i] * gains / weight
    # From the gains to the coefficients of the error, exactly.
    D = np.zeros((N + 1, n, n))
    ahead = np.zeros((n, n))
    for j in range(N - 1, -1, -1):
        ahead = ahead @ window.A[j + 1] if j + 1 < N else np.zeros((n, n))
        if j == window.target:
            ahead = ahead + np.eye(n)
        here = rows == j
        ahead = ahead - L[:, here] @ C[here]
        D[j + 1] = ahead
    D[0] = D[1] @ window.A[0]
    P = np.einsum("jab,jbc,jdc->ad", D[1:], window.Q, D[1:]) + (L * r) @ L.T
    bias = np.abs(L) @ half + (np.abs(np.einsum("jab,jbc->jac", D[1:], window.G)).sum(axis=(0, 2)) if ng else 0.0)
    return Design(D[0], np.concatenate(list(D[1:]), axis=1), L, P, bias)


class _Program:
    """The cone program of one window; only the target changes between its states.

    Variables: the error's coefficients D_0 ... D_N (n each, in units of the states), the gains l, absolute values u,
    the reach v of the ellipsoid and the standard deviation s. Constraints, in this order: the recursion of D as
    equations, u >= |.|, the two cones.
    """

    def __init__(
        self, A: Array, C: Array, sd: Array, half: Array, rows: NDArray[np.int64], roots: Array, X: Array,
        boxes: list[Array], size: Array, kappa: float,
    ) -> None:  # fmt: skip
        from scipy import sparse

        c = _clarabel()
        N, n, p = len(A), A.shape[1], len(rows)
        put = _Entries()
        d = np.arange((N + 1) * n).reshape(N + 1, n)  # columns of D
        gain = (N + 1) * n + np.arange(p)
        # D_j - A_{j+1}' D_{j+1} + [C_j' l_j] = [target] e_i, all scaled by the states' sizes: D~ = D diag(size)
        put.diagonal(d.ravel(), d.ravel(), 1.0)
        for j in range(N):
            put.block(d[j], d[j + 1], -(A[j] * size / size[:, None]).T)
        for j in range(N):
            here = np.flatnonzero(rows == j)
            put.block(d[j + 1], gain[here], (C[here] * size).T)
        row = (N + 1) * n
        # absolute values
        column = row + p
        absolute = []
        for j, box in enumerate(boxes):
            for g in box.T[np.abs(box.T).sum(axis=1) > 0]:
                absolute.append((d[j], g / size))
        bounded = np.flatnonzero(half > 0)
        absolutes = len(absolute) + len(bounded)
        cost = np.concatenate([np.ones(len(absolute)), half[bounded]])
        for sign in (1.0, -1.0):
            for k, (columns, g) in enumerate(absolute):
                put.block(np.array([row + k]), columns, sign * g[None])
            at = row + len(absolute) + np.arange(len(bounded))
            put.diagonal(at, gain[bounded], sign)
            put.diagonal(row + np.arange(absolutes), column + np.arange(absolutes), -1.0)
            row += absolutes
        v, s = column + absolutes, column + absolutes + 1
        # |X^{1/2}' D_0'| <= v
        cones = [c.ZeroConeT(row - 2 * absolutes), c.NonnegativeConeT(2 * absolutes)]
        put.diagonal(np.array([row]), np.array([v]), -1.0)
        if X.any():
            put.block(row + 1 + np.arange(n), d[0], -(X / size[:, None]).T)
        cones.append(c.SecondOrderConeT(n + 1 if X.any() else 1))
        row += n + 1 if X.any() else 1
        # |(roots' D', sd l)| <= s
        put.diagonal(np.array([row]), np.array([s]), -1.0)
        used = row + 1
        for j in range(N + 1):
            if roots[j].any():
                put.block(used + np.arange(n), d[j], -(roots[j] / size[:, None]).T)
                used += n
        noisy = np.flatnonzero(sd > 0)
        put.diagonal(used + np.arange(len(noisy)), gain[noisy], -sd[noisy])
        used += len(noisy)
        cones.append(c.SecondOrderConeT(used - row))
        q = np.zeros(s + 1)
        q[column : column + absolutes] = cost
        q[v], q[s] = 1.0, kappa
        settings = c.DefaultSettings()
        settings.verbose, settings.max_iter, settings.presolve_enable = False, 100, False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
        self.b, self.gain, self.n = np.zeros(used), gain, n
        quadratic = sparse.csc_matrix((s + 1, s + 1))
        self.solver = c.DefaultSolver(quadratic, q, put.matrix(used, s + 1), self.b, cones, settings)

    def solve(self, target: int, state: int) -> Array | None:
        """Return the gains for one state of the target row, in its own units; None if the solver gives up."""
        self.b[:] = 0.0
        self.b[(target + 1) * self.n + state] = 1.0
        self.solver.update(b=self.b)
        found = self.solver.solve()
        gains = np.asarray(found.x, dtype=np.float64)[self.gain]
        if str(found.status) not in ("Solved", "AlmostSolved") or not np.isfinite(gains).all():
            return None
        return np.asarray(gains)


class _Entries:
    """Entries of a sparse matrix, collected block by block."""

    def __init__(self) -> None:
        self.i: list[Array] = []
        self.j: list[Array] = []
        self.v: list[Array] = []

    def block(self, i: Any, j: Any, value: Array) -> None:
        self.i.append(np.repeat(i, len(j)))
        self.j.append(np.tile(j, len(i)))
        self.v.append(value.ravel())

    def diagonal(self, i: Any, j: Any, value: Any) -> None:
        self.i.append(i)
        self.j.append(j)
        self.v.append(np.broadcast_to(value, len(i)))

    def matrix(self, height: int, width: int) -> Any:
        from scipy import sparse

        v, i, j = (np.concatenate(part) for part in (self.v, self.i, self.j))
        return sparse.csc_matrix((v, (i, j)), shape=(height, width))


def _clarabel() -> Any:
    try:
        import clarabel
    except ImportError:
        raise Missing("`MixedWindow` needs the library clarabel", hint="pip install 'halfwidth[mixed]'") from None
    return clarabel


def root(S: Array) -> Array:
    """Return a square root F of a positive semidefinite S = F F'."""
    value, vector = np.linalg.eigh(S)
    return np.asarray(vector * np.sqrt(np.maximum(value, 0.0)))
