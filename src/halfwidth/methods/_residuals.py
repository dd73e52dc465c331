"""The residuals of a linear model over one record: rows of a sparse matrix, and what they can tell.

With X = (x0, x[0], ..., x[T-1]) stacked, the noise that a trajectory needs is ``M X - b``: row by row

    E x[t] - A x[t-1] - B u[t]   = w[t]            state rows, group i of the state
    C x[t] - F y[t]              = -e[t]           output rows, group nx + j

A half-width s = (q, r) bounds the rows of its group, ``|M X - b| <= S s``. An unseen output that a seen one is
correlated with through F is eliminated, so that row's bound is a sum of half-widths: that is the projection of the
unseen entry, row by row.

Beside the rows this module finds what every bounded estimator needs first: a least-squares trajectory to start from,
the scale sigma of each group (its noise level by variance components, so that units do not matter), the groups whose
noise leaves no trace in the data (redundancy 0), and the directions of the state that no output sees.

References
----------
Pavelková (2011), ÚTIA report 2296, eqs. (7), (8), (14), (18); Pavelková and Kárný (2013), eqs. (1), (2), (25).
Redundancy and variance components: Förstner (1979), Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.model import Linear, Model
from halfwidth.noise import Uniform
from halfwidth.record import Record
from halfwidth.varying import Varying

#: Rows whose group keeps less than this share of their noise in the residuals say nothing of its half-width.
TRACE = 1e-9
_ROUNDS = 3
_RIDGE = 1e-10


@dataclass(frozen=True, eq=False)
class Residuals:
    """Rows ``M X - b`` with ``|M X - b| <= S s``, over n = (T + 1) nx unknowns and p = nx + ny half-widths.

    Parameters
    ----------
    M : (K, n) CSR array
    b : (K,) array
    S : (K, p) CSR array
        Not negative; row k holds 1 at its own group.
    row, group : (K,) int arrays
        Row of the record and group of each residual.
    T, nx, ny : int
    """

    M: Any
    b: Array
    S: Any
    row: NDArray[np.intp]
    group: NDArray[np.intp]
    T: int
    nx: int
    ny: int

    @property
    def count(self) -> Array:
        """Number of rows of each group, (p,)."""
        return np.bincount(self.group, minlength=self.nx + self.ny).astype(float)

    def at(self, X: Array) -> Array:
        """Return ``M X - b``, (K,)."""
        return np.asarray(self.M @ X - self.b)

    def largest(self, rho: Array) -> Array:
        """Return the largest |rho| of each group, 0 where it has no row; (p,)."""
        top = np.zeros(self.nx + self.ny)
        np.maximum.at(top, self.group, np.abs(rho))
        return top


def residuals(model: Linear, record: Record) -> Residuals:
    """Build the rows of a linear model over a record.

    Parameters
    ----------
    model : Linear
        Without unknown entries.
    record : Record
    """
    import scipy.sparse as sp

    T, nx, ny = len(record), model.nx, model.ny
    dt = record.steps(model.dt)

    A, C = model.A.each(record.t, dt), model.C.each(record.t, dt)
    E = np.broadcast_to(np.eye(nx), (T, nx, nx)) if model.E is None else model.E.each(record.t, dt)
    drive = np.zeros((T, nx))
    if model.B is not None and record.u is not None:
        drive = np.einsum("tij,tj->ti", model.B.each(record.t, dt), record.u)
    y = np.where(record.seen, record.y, 0.0)
    if model.F is None:
        N, Cy, Fy = None, C, y
    else:
        F = model.F.each(record.t, dt)
        N = _eliminate(F, record.seen)
        Cy, Fy = N @ C, np.einsum("tij,tj->ti", N @ F, y)

    # State rows t nx + i on columns t nx + j (x[t-1]) and (t + 1) nx + j (x[t]).
    ta, ia, ja = np.nonzero(A)
    te, ie, je = np.nonzero(E)
    # Output rows, in the order of the seen entries.
    seen_t, seen_j = np.nonzero(record.seen)
    place = np.full((T, ny), -1)
    place[seen_t, seen_j] = T * nx + np.arange(seen_t.size)
    tc, ic, jc = np.nonzero(np.where(record.seen[:, :, None], Cy, 0.0))
    K, n, p = T * nx + seen_t.size, (T + 1) * nx, nx + ny
    M = sp.csr_array(
        (
            np.r_[-A[ta, ia, ja], E[te, ie, je], Cy[tc, ic, jc]],
            (
                np.r_[ta * nx + ia, te * nx + ie, place[tc, ic]],
                np.r_[ta * nx + ja, (te + 1) * nx + je, (tc + 1) * nx + jc],
            ),
        ),
        shape=(K, n),
    )
    group = np.r_[np.tile(np.arange(nx), T), nx + seen_j]
    if N is None:
        S = sp.csr_array((np.ones(K), (np.arange(K), group)), shape=(K, p))
    else:
        tn, jn, kn = np.nonzero(np.where(record.seen[:, :, None], N, 0.0))
        S = sp.csr_array(
            (
                np.r_[np.ones(T * nx), np.abs(N[tn, jn, kn])],
                (np.r_[np.arange(T * nx), place[tn, jn]], np.r_[group[: T * nx], nx + kn]),
            ),
            shape=(K, p),
        )
    row = np.r_[np.repeat(np.arange(T), nx), seen_t]
    return Residuals(M, np.r_[drive.ravel(), Fy[seen_t, seen_j]], S, row, group, T, nx, ny)


def _eliminate(F: Array, seen: NDArray[np.bool_]) -> Array:
    """Return N (T, ny, ny), unit upper triangular, such that seen rows of N F are 0 in the unseen columns."""
    T, ny = seen.shape
    N = np.array(np.broadcast_to(np.eye(ny), (T, ny, ny)))
    G = np.array(F)
    for j in range(ny):
        lost = ~seen[:, j]
        if lost.any():
            factor = np.where(np.arange(ny) < j, G[lost, :, j], 0.0)
            # Row j of F still stands unreduced: it is subtracted before its own unseen columns are.
            N[lost] -= factor[:, :, None] * N[lost, j][:, None, :]
            G[lost] -= factor[:, :, None] * G[lost, j][:, None, :]
    return N


@dataclass(frozen=True, eq=False)
class Reference:
    """A least-squares trajectory, and what it says of the rows.

    Parameters
    ----------
    X : (n,) array
        Trajectory of least weighted squares.
    sigma : (p,) array
        Scale of each group, in its unit; positive.
    column : (n,) array
        Scale of each unknown: how far it moves when its rows change by one sigma.
    redundancy : (p,) array
        How many rows' worth of each group's noise shows in the residuals, 0 to its number of rows.
    traceless : (p,) bool array
        Groups with rows whose noise the trajectory absorbs entirely, whatever the scales.
    """

    X: Array
    sigma: Array
    column: Array
    redundancy: Array
    traceless: NDArray[np.bool_]


@np.errstate(over="ignore")  # beyond 1e154 a square is infinite, and nothing fits
def reference(rows: Residuals, model: Linear, known: Array) -> Reference:
    """Find the least-squares trajectory and the scale of each group.

    Parameters
    ----------
    rows : Residuals
    model : Linear
    known : (p,) array
        Scale of the groups whose noise level is known, 0 for the others.

    The variance of a group is the sum of its squared residuals over its redundancy, found in a few rounds of least
    squares from a start that scales with the units of every state and output. The redundancy is the trace of a
    projection, estimated by one seeded draw of signs a group.
    """
    p = rows.nx + rows.ny
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=rows.b.size)
    count = rows.count
    sigma = np.where(known > 0, known, _first_scales(rows, model))
    X = np.zeros(rows.M.shape[1])
    share, best = np.zeros(p), np.zeros(p)
    for _ in range(_ROUNDS):
        solve, column = _least_squares(rows, sigma)
        scale = rows.S @ sigma
        X = X - solve(rows.at(X) / scale)
        rho = rows.at(X)
        # Size of the numbers behind each residual: rounding makes anything below this meaningless.
        size = rows.largest(abs(rows.M) @ np.abs(X) + np.abs(rows.b))
        square = np.bincount(rows.group, rho**2, minlength=p)
        for j in np.flatnonzero(count):
            mine = rows.group == j
            noise = np.where(mine, signs, 0.0)
            left = noise - (rows.M @ solve(noise)) / scale
            share[j] = np.clip(signs[mine] @ left[mine] / count[j], 0.0, 1.0)
        # The scale so far counts as one more residual, so that few or exact residuals do not make it collapse.
        level = np.maximum(np.sqrt((square + sigma**2) / (share * count + 1.0)), 1e-12 * size)
        sigma = np.where((count > 0) & (known == 0), level, sigma)
        sigma = np.where(sigma > 0, sigma, 1.0)
        best = np.maximum(best, share)
    return Reference(X, sigma, column, share * count, (count > 0) & (best <= TRACE))


def _first_scales(rows: Residuals, model: Linear) -> Array:
    nx = rows.nx
    return first_scales(model, [rows.b[rows.group == nx + j] for j in range(rows.ny)])


def first_scales(model: Linear, seen: Sequence[Array]) -> Array:
    """Return a first scale of each group (p,) that follows the unit of its state or output.

    An output's is its typical step from one seen row to the next; a state's is the disturbance that moves the outputs
    of the next rows by one such step.

    Parameters
    ----------
    model : Linear
    seen : sequence of arrays
        The seen values of each output, in order.
    """
    return _core.window_sizes(felt(model), seen)  # type: ignore[no-any-return]


def felt(model: Linear) -> Array:
    """Return what a unit disturbance of each state does to each output: sums of squares over later rows, (ny, nx)."""
    nx = model.nx

    def typical(matrix: Varying | None) -> bytes:
        if matrix is None:
            return np.eye(nx).tobytes()
        one = matrix.value if matrix.value is not None else matrix.at(0.0, model.dt)
        return np.ascontiguousarray(one if one.ndim == 2 else one.mean(axis=0), dtype=float).tobytes()

    return _felt(nx, typical(model.E), typical(model.A), typical(model.C))


@functools.lru_cache(maxsize=256)
def _felt(nx: int, E: bytes, A: bytes, C: bytes) -> Array:
    inverse = np.linalg.inv(np.frombuffer(E).reshape(nx, nx))
    Phi = inverse @ np.frombuffer(A).reshape(nx, nx)
    H = np.frombuffer(C).reshape(-1, nx)
    # A model that grows is discounted by its growth: what a disturbance does after many rows says nothing of its size.
    growth = max(1.0, float(np.abs(np.linalg.eigvals(Phi)).max(initial=0.0)))
    found, step, keep = np.zeros(H.shape), inverse, 1.0
    for _ in range(50):
        found += keep * (H @ step) ** 2
        step, keep = Phi @ step / growth, 0.9 * keep
    return found


def _least_squares(rows: Residuals, sigma: Array) -> tuple[Any, Array]:
    """Return the solver ``rhs -> argmin |M X / scale - rhs|`` and the scale of each unknown.

    A ridge keeps unseen directions at 0, and two steps of refinement take it out of all others.
    """
    import scipy.linalg as sl
    import scipy.sparse as sp

    W = sp.csr_array(sp.diags_array(1.0 / (rows.S @ sigma)) @ rows.M)
    diagonal = np.asarray((W.multiply(W)).sum(axis=0)).ravel()
    column = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    W = sp.csr_array(W @ sp.diags_array(column))
    H = sp.coo_array(sp.tril(W.T @ W))
    width = 2 * rows.nx
    band = np.zeros((width, H.shape[0]))
    i, j = H.coords
    band[i - j, j] = H.data
    band[0] += _RIDGE
    factor = sl.cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)

    def solve(rhs: Array) -> Array:
        x = np.zeros(H.shape[0])
        for _ in range(3):
            x = x + sl.cho_solve_banded((factor, True), W.T @ (rhs - W @ x), check_finite=False)
        return column * x

    return solve, column


def unseen_directions(rows: Residuals, model: Linear, record: Record) -> Array:
    """Return the directions of x0 that leave no trace in any seen output, unit vectors as rows (k, nx).

    The undisturbed outputs ``C Phi(t) x0`` of all rows are compressed pairwise, T to T/2 and so on, by QR; each half
    may be rescaled freely because only the null space counts.
    """
    T, nx = rows.T, rows.nx
    dt = record.steps(model.dt)

    Phi = np.array(model.A.each(record.t, dt))
    if model.E is not None:
        Phi = np.array(np.linalg.solve(model.E.each(record.t, dt), Phi), dtype=np.float64)
    # Rows of seen outputs with their unseen partners eliminated, straight from the residual matrix.
    C = np.zeros((T, rows.ny, nx))
    outputs = rows.M[T * nx :].tocoo()
    k, j = outputs.coords
    C[rows.row[T * nx + k], rows.group[T * nx + k] - nx, j % nx] = outputs.data
    unit = np.abs(C).max(axis=(0, 2))
    C = C / np.where(unit > 0, unit, 1.0)[:, None]
    R = _compressed(C @ Phi)
    while len(Phi) > 1:
        half = len(Phi) // 2
        first, second = slice(0, 2 * half, 2), slice(1, 2 * half, 2)
        both = np.concatenate([_unit(R[first]), _unit(R[second] @ Phi[first])], axis=1)
        joined = _compressed(both)
        forward = _unit(Phi[second] @ Phi[first])
        if len(Phi) % 2:
            joined = np.concatenate([_tall(joined, nx), _tall(R[-1:], nx)])
            forward = np.concatenate([forward, Phi[-1:]])
        R, Phi = joined, forward
    column = np.abs(R[0]).max(axis=0)
    column = np.where(column > 0, column, 1.0)
    _, value, right = np.linalg.svd(_tall(R, nx)[0] / column)
    lost = right[value <= 1e-9 * max(float(value[0]), 1e-300)] / column
    return np.asarray(lost / np.linalg.norm(lost, axis=1, keepdims=True)) if len(lost) else lost.reshape(0, nx)


def _compressed(stack: Array) -> Array:
    """Reduce tall matrices to as many rows as columns, with the same null space."""
    return np.asarray(np.linalg.qr(stack, mode="r")) if stack.shape[1] > stack.shape[2] else stack


def _unit(stack: Array) -> Array:
    """Scale each matrix of a stack to a largest entry of 1; zero stays zero."""
    top = np.abs(stack).max(axis=(1, 2), keepdims=True)
    return np.asarray(stack / np.where(top > 0, top, 1.0))


def _tall(stack: Array, rows: int) -> Array:
    """Pad the matrices of a stack with zero rows, at least to the number given."""
    lack = max(0, rows - stack.shape[1])
    return np.pad(stack, ((0, 0), (0, lack), (0, 0)))


def half_width_bounds(model: Model) -> tuple[Array, Array]:
    """Return floors and caps of the half-widths (q, r), each (p,)."""
    assert isinstance(model.w, Uniform)
    assert isinstance(model.e, Uniform)
    return (
        np.r_[np.broadcast_to(model.w.at_least, model.nx), np.broadcast_to(model.e.at_least, model.ny)].astype(float),
        np.r_[np.broadcast_to(model.w.at_most, model.nx), np.broadcast_to(model.e.at_most, model.ny)].astype(float),
    )
