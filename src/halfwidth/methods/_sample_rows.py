"""The rows of a linear model as the sampler takes them: sparse, in the order of time, Gaussian ones whitened."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.methods._linearised import filled
from halfwidth.methods._residuals import Residuals, residuals
from halfwidth.model import Linear
from halfwidth.noise import Gaussian, Noise
from halfwidth.record import Record
from halfwidth.spread import Box, Normal

#: A matrix entry that is unknown stands at this value while the pattern of the rows is built: any number but 0 and 1.
_PLACE = 0.7310585786300049


class Rows:
    """Rows of the sampler: sparse M, b, group of each row (-1: Gaussian, whitened), boxes, and the unknown entries."""

    M: Any
    b: Array
    group: NDArray[np.int64]
    lo: Array
    hi: Array
    state: NDArray[np.int64]
    states: NDArray[np.int64]
    base: Residuals
    theta_start: NDArray[np.int64]
    theta_row: NDArray[np.int64]
    theta_at: NDArray[np.int64]
    theta_slope: Array
    theta_lo: Array
    theta_hi: Array

    @property
    def N(self) -> int:
        """Number of unknowns."""
        return int(self.M.shape[1])

    def set(self, theta: Array) -> None:
        """Put the entries into M and b, which hold `_PLACE` for each."""
        for m, value in enumerate(theta):
            mine = slice(self.theta_start[m], self.theta_start[m + 1])
            at, slope, row = self.theta_at[mine], self.theta_slope[mine], self.theta_row[mine]
            inside = at >= 0
            np.add.at(self.M.data, at[inside], (value - _PLACE) * slope[inside])
            np.subtract.at(self.b, row[~inside], (value - _PLACE) * slope[~inside])


def laid_out(model: Linear, record: Record) -> Rows:
    """Build the rows. Unseen outputs that a seen one is correlated with become unknowns of their own."""
    import scipy.sparse as sp

    T, nx, ny = len(record), model.nx, model.ny
    dt = record.steps(model.dt)
    entries = model.theta_entries
    fixed = filled(model, np.full(len(entries), _PLACE)) if entries else model
    F = np.broadcast_to(np.eye(ny), (T, ny, ny))
    if fixed.F is not None:
        F = fixed.F.each(record.t, dt)
    needed = _needed(F, record.seen, fixed.e, record)
    y = np.where(record.seen, record.y, np.where(needed, 0.0, np.nan))
    whole = replace(record, y=y)
    base = residuals(replace(fixed, F=None), whole)
    # Row (t, i) of F y: the seen entries go to the right-hand side, the needed ones are unknowns.
    there = record.seen | needed
    tj = np.argwhere(there)
    place = np.full((T, ny), -1)
    place[tj[:, 0], tj[:, 1]] = T * nx + np.arange(len(tj))
    b = base.b.copy()
    known = np.where(record.seen, record.y, 0.0)
    b[T * nx :] = np.einsum("tij,tj->ti", F, known)[there]
    latent = np.full((T, ny), -1)
    tl, jl = np.nonzero(needed)
    latent[tl, jl] = (T + 1) * nx + np.arange(tl.size)
    tf, i_f, jf = np.nonzero((F != 0) & needed[:, None, :] & there[:, :, None])
    extra = sp.coo_array((-F[tf, i_f, jf], (place[tf, i_f], latent[tf, jf])), shape=(b.size, (T + 1) * nx + tl.size))
    M = sp.coo_array(base.M)
    coords = np.hstack([np.array(M.coords), np.array(extra.coords)])
    M = sp.csr_array((np.r_[M.data, extra.data], (coords[0], coords[1])), shape=extra.shape)

    # Unknowns in the order of time, so that the look-alike has a band.
    when = np.r_[np.repeat(np.arange(T + 1), nx), tl + 1.5]
    order = np.argsort(when, kind="stable")
    back = np.argsort(order)
    M = sp.csr_array(M[:, order])
    M.sort_indices()
    free = Box(np.full(nx, -np.inf), np.full(nx, np.inf))
    box = model.bounds if isinstance(model.bounds, Box) else free
    prior = model.x0 if isinstance(model.x0, Box) else Box(np.full(nx, -np.inf), np.full(nx, np.inf))
    lo = np.r_[prior.lo, np.tile(box.lo, T), np.full(tl.size, -np.inf)][order]
    hi = np.r_[prior.hi, np.tile(box.hi, T), np.full(tl.size, np.inf)][order]

    rows = Rows()
    rows.base, rows.lo, rows.hi = base, lo, hi
    rows.states = back[: (T + 1) * nx]
    rows.state = rows.states[nx:].astype(np.int64)
    rows.group = base.group.astype(np.int64)
    rows.M, rows.b = M, b
    _entries(rows, model, record, place, latent, back)
    for name, noise in (("w", model.w), ("e", model.e)):
        if isinstance(noise, Gaussian):
            _whiten(rows, noise, name, whole, dt, nx)
    if isinstance(model.x0, Normal):
        root = np.linalg.cholesky(_definite(model.x0.P))
        inverse = np.linalg.inv(root)
        i, j = np.nonzero(inverse)
        block = sp.csr_array((inverse[i, j], (i, rows.states[j])), shape=(nx, M.shape[1]))
        rows.M = sp.csr_array(sp.vstack([rows.M, block]))
        rows.b = np.r_[rows.b, inverse @ model.x0.mean]
        rows.group = np.r_[rows.group, np.full(nx, -1)]
    return rows


def _needed(F: Array, seen: NDArray[np.bool_], e: Noise, record: Record) -> NDArray[np.bool_]:
    """Return the unseen outputs that a seen one depends on, through F or through the covariance of e; (T, ny)."""
    ny = seen.shape[1]
    needed = np.zeros_like(seen)
    linked = (F != 0) & ~np.eye(ny, dtype=bool)
    if isinstance(e, Gaussian):
        stack, _ = e.cov().stack(record.t, record.steps(1.0))
        if np.any(stack * (1 - np.eye(ny)) != 0):
            linked = np.ones_like(linked)
    for _ in range(ny):
        needed = ~seen & np.einsum("tij,ti->tj", linked, seen | needed)
    return np.asarray(needed)


def _entries(
    rows: Rows, model: Linear, record: Record, place: NDArray[Any], latent: NDArray[Any], back: NDArray[Any]
) -> None:
    """Find where each unknown entry stands in M, or that it stands in b."""
    T, nx = rows.base.T, rows.base.nx
    t = np.arange(T)
    start, row_of, at, slope = [0], [], [], []
    M = rows.M
    for entry in model.theta_entries:
        i, j = entry.row, entry.column
        if entry.matrix in "ABE":
            row = t * nx + i
            if entry.matrix == "B":
                column, value = np.full(T, -1), -np.asarray(record.u)[:, j]
            else:
                column = back[(t + (entry.matrix == "E")) * nx + j]
                value = np.full(T, 1.0 if entry.matrix == "E" else -1.0)
        else:
            there = np.flatnonzero(place[:, i] >= 0)
            row = place[there, i]
            if entry.matrix == "C":
                column, value = back[(there + 1) * nx + j], np.ones(there.size)
            else:
                inside = latent[there, j] >= 0
                column = np.where(inside, back[latent[there, j]], -1)
                value = np.where(inside, -1.0, -np.where(record.seen[there, j], record.y[there, j], 0.0))
        where = np.full(row.size, -1)
        for k, (a, c) in enumerate(zip(row, column, strict=True)):
            if c >= 0:
                where[k] = M.indptr[a] + np.searchsorted(M.indices[M.indptr[a] : M.indptr[a + 1]], c)
        start.append(start[-1] + row.size)
        row_of.append(row)
        at.append(where)
        slope.append(value)
    count = len(model.theta_entries)
    rows.theta_start = np.array(start, dtype=np.int64)
    rows.theta_row = np.concatenate([*row_of, np.zeros(0)]).astype(np.int64)
    rows.theta_at = np.concatenate([*at, np.zeros(0)]).astype(np.int64)
    rows.theta_slope = np.concatenate([*slope, np.zeros(0)])
    box = model.theta_bounds or Box(np.full(count, -np.inf), np.full(count, np.inf))
    rows.theta_lo, rows.theta_hi = np.array(box.lo, dtype=float), np.array(box.hi, dtype=float)


def _whiten(rows: Rows, noise: Gaussian, name: str, record: Record, dt: Array, nx: int) -> None:
    """Turn the rows of a Gaussian noise into independent ones of variance 1."""
    import scipy.sparse as sp

    T, seen = rows.base.T, record.seen
    Q = noise.cov().each(record.t, dt)
    blocks = []
    for t in range(T):
        part = Q[t] if name == "w" else Q[t][np.ix_(seen[t], seen[t])]
        if part.size:
            blocks.append(np.linalg.inv(np.linalg.cholesky(_definite(part))))
    n_w = T * nx
    one = sp.block_diag(blocks) if blocks else sp.csr_array((0, 0))
    rest = rows.M.shape[0] - n_w
    white = sp.block_diag([one, sp.eye_array(rest)]) if name == "w" else sp.block_diag([sp.eye_array(n_w), one])
    rows.M = sp.csr_array(white @ rows.M)
    rows.M.sort_indices()
    rows.b = white @ rows.b
    mine = slice(0, n_w) if name == "w" else slice(n_w, None)
    rows.group[mine] = -1


def _definite(P: Array) -> Array:
    """Return a covariance with a floor under its eigenvalues, so that it has an inverse."""
    scale = np.sqrt(np.maximum(np.diagonal(P), 1e-300))
    return np.asarray(P + np.diag(1e-12 * scale**2))
