"""The linear program of bounded noise as a chain in time: its arrays, and how a model and a record give them.

::

    minimise  c's    over states x_0 .. x_T, parameters theta, half-widths s
    s.t.      |E x_k - A x_{k-1} + G theta - bx| <= h s,   |C x_k + G theta - by| <= h s,   boxes on x, theta, s

References
----------
Pavelková (2011), ÚTIA report 2296, eqs. (16)-(19); Pavelková and Kárný (2013), eqs. (22)-(26).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.model import Linear
from halfwidth.record import Record
from halfwidth.solvers.program import Program
from halfwidth.spread import Box
from halfwidth.varying import Varying


@dataclass(frozen=True, eq=False)
class Chain:
    """The arrays of the program, in the user's units.

    Parameters
    ----------
    A, C : (nx, nx) and (ny, nx), or stacked (T, ., .)
    bx, by : (T, nx) and (T, ny)
        ``B u`` and ``F y``; unseen entries may hold any finite number.
    seen : (T, ny) bool
    group : (nx + ny,) int32
        Half-width that bounds the rows of each kind, states first.
    h : (nx + ny,)
        Factor on that half-width.
    c, floor, cap : (ns,)
        Cost, floor and cap of each half-width; where floor and cap agree it is known.
    E : (nx, nx) or (T, nx, nx), or None for the identity
    G : (T, nx + ny, p0) or None
        Columns of theta.
    lo, hi : (nx,) or (T + 1, nx), or None
        Box of the states.
    x0_lo, x0_hi : (nx,) or None
        Box of x_0 in place of `lo`, `hi` there.
    theta_lo, theta_hi : (p0,) or None
    slack : (nx + ny,) or None
        Cost of a slack of each row of a kind.
    """

    A: Array
    C: Array
    bx: Array
    by: Array
    seen: NDArray[np.bool_]
    group: NDArray[np.int32]
    h: Array
    c: Array
    floor: Array
    cap: Array
    E: Array | None = None
    G: Array | None = None
    lo: Array | None = None
    hi: Array | None = None
    x0_lo: Array | None = None
    x0_hi: Array | None = None
    theta_lo: Array | None = None
    theta_hi: Array | None = None
    slack: Array | None = None

    @property
    def T(self) -> int:
        """Number of rows of the record."""
        return len(self.bx)

    def part(self, a: int, b: int) -> "Chain":
        """Return the chain of rows a to b - 1; the box of x_0 stays with row 0 alone."""

        def cut(matrix: Any, rows: int = 3, more: int = 0) -> Any:
            return matrix if matrix is None or matrix.ndim < rows else matrix[a : b + more]

        return replace(
            self,
            A=cut(self.A),
            C=cut(self.C),
            E=cut(self.E),
            G=cut(self.G),
            bx=self.bx[a:b],
            by=self.by[a:b],
            seen=self.seen[a:b],
            lo=cut(self.lo, 2, 1),
            hi=cut(self.hi, 2, 1),
            x0_lo=self.x0_lo if a == 0 else None,
            x0_hi=self.x0_hi if a == 0 else None,
        )

    def program(self) -> Program:
        """Return the same program as sparse rows, for solvers that know nothing of time."""
        import scipy.sparse as sp

        T, nx = self.bx.shape
        ny, p0, ns = self.by.shape[1], 0 if self.G is None else self.G.shape[2], len(self.c)
        n = (T + 1) * nx
        A, C = np.broadcast_to(self.A, (T, nx, nx)), np.broadcast_to(self.C, (T, ny, nx))
        E = np.broadcast_to(np.eye(nx) if self.E is None else self.E, (T, nx, nx))
        t, i, j = (a.ravel() for a in np.meshgrid(range(T), range(nx), range(nx), indexing="ij"))
        seen_t, seen_j = np.nonzero(self.seen)
        K = T * nx + seen_t.size
        kind = np.r_[np.tile(np.arange(nx), T), nx + seen_j]
        rows = [t * nx + i, t * nx + i, np.repeat(np.arange(T * nx, K), nx)]
        columns = [t * nx + j, (t + 1) * nx + j, ((seen_t + 1)[:, None] * nx + np.arange(nx)).ravel()]
        values = [-A[t, i, j], E[t, i, j], C[seen_t, seen_j].ravel()]
        M = sp.csr_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(K, n))
        M.eliminate_zeros()
        b = np.r_[self.bx.ravel(), self.by[seen_t, seen_j]]
        if self.G is not None:
            Gk = np.concatenate([self.G[:, :nx].reshape(-1, p0), self.G[seen_t, nx + seen_j]])
            M = sp.csr_array(sp.hstack([M, sp.csr_array(Gk)]))
        S = sp.csr_array((self.h[kind], (np.arange(K), self.group[kind])), shape=(K, ns))
        free = np.full(n, np.inf)
        lo = -free if self.lo is None else np.broadcast_to(self.lo, (T + 1, nx)).ravel().copy()
        hi = free if self.hi is None else np.broadcast_to(self.hi, (T + 1, nx)).ravel().copy()
        if self.x0_lo is not None and self.x0_hi is not None:
            lo[:nx], hi[:nx] = self.x0_lo, self.x0_hi
        theta_lo = np.zeros(0) if self.theta_lo is None else self.theta_lo
        theta_hi = np.zeros(0) if self.theta_hi is None else self.theta_hi
        known = self.cap <= self.floor
        none = np.full(K, np.inf)
        c = np.r_[np.zeros(n + p0), np.where(known, 0.0, self.c)]
        lows, highs = [lo, theta_lo, self.floor], [hi, theta_hi, self.cap]
        upper, lower = [M, -S], [M, S]
        if self.slack is not None:
            upper.append(-sp.eye_array(K))
            lower.append(sp.eye_array(K))
            c = np.r_[c, self.slack[kind]]
            lows.append(np.zeros(K))
            highs.append(none)
        return Program(
            c=c,
            G=sp.csr_array(sp.vstack([sp.hstack(upper), sp.hstack(lower)])),
            row_lo=np.r_[-none, b],
            row_hi=np.r_[b, none],
            lo=np.concatenate(lows),
            hi=np.concatenate(highs),
            floor=1e-9 * float(np.abs(self.c).max(initial=0.0)),
            chain=self,
        )


def chain_of(model: Linear, record: Record, c: Array, floor: Array, cap: Array) -> Chain | None:
    """Return the chain of a linear model without unknown entries over a record.

    None where F couples a seen output with an unseen one: such a row is bounded by a sum of half-widths, which the
    chain does not express.
    """
    dt = record.steps(model.dt)
    T, nx, ny = len(record), model.nx, model.ny
    seen = record.seen
    y = np.where(seen, record.y, 0.0)
    if model.F is not None:
        F = model.F.each(record.t, dt)
        off = np.where(np.eye(ny, dtype=bool), 0.0, F)
        if np.any((off != 0) & seen[:, :, None] & ~seen[:, None, :]):
            return None
        y = np.einsum("tij,tj->ti", F, y)
    drive = np.zeros((T, nx))
    if model.B is not None and record.u is not None:
        drive = np.einsum("tij,tj->ti", model.B.each(record.t, dt), record.u)
    assert isinstance(model.x0, Box)
    box = model.bounds
    bounded = np.isfinite(model.x0.lo).any() or np.isfinite(model.x0.hi).any()
    return Chain(
        A=_whole(model.A, record, dt),
        C=_whole(model.C, record, dt),
        E=None if model.E is None else _whole(model.E, record, dt),
        bx=np.ascontiguousarray(drive),
        by=np.ascontiguousarray(y),
        seen=np.ascontiguousarray(seen),
        group=np.arange(nx + ny, dtype=np.int32),
        h=np.ones(nx + ny),
        c=np.array(c, dtype=float),
        floor=np.array(floor, dtype=float),
        cap=np.array(cap, dtype=float),
        lo=None if box is None else np.array(box.lo, dtype=float),
        hi=None if box is None else np.array(box.hi, dtype=float),
        x0_lo=np.array(model.x0.lo, dtype=float) if bounded or box is not None else None,
        x0_hi=np.array(model.x0.hi, dtype=float) if bounded or box is not None else None,
    )


def _whole(matrix: Varying, record: Record, dt: Array) -> Array:
    """Return a matrix that is the same for every row as one (., .), else that of each row (T, ., .); contiguous."""
    stack, index = matrix.stack(record.t, dt)
    if index is not None:
        return np.ascontiguousarray(stack[index])
    return np.ascontiguousarray(stack[0] if len(stack) == 1 else stack)
