"""Boxes of states that must contain, narrowed window by window.

A window is a stretch of rows between boxes that are safe already. `Boxes.narrow` contracts them (core/box.hpp), bounds
both sides of every wanted entry by a linear program (core/hull.hpp) and keeps whatever is tighter. The multipliers come
from a solver that is not trusted: the bound is proved for any multipliers, so a wrong answer costs width only.
Where the bound and the solver's own objective disagree, the window is asked again from the narrower boxes, and in the
end of the stock solver.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.methods._bounds import Rows

#: A bound this far from the solver's objective, in widths of the box found, is asked for again.
LOOSE = 1e-7
_LEAST = 1e-13  # and this share of the state itself, which is rounding
#: Above this it is reported as loose.
_REPORT = 1e-6
_ROUNDS = 3
#: Most unknowns of the dense step that bounds states of an infinite box.
_DENSE = 90
#: Times that it is tried for a state.
_TRIES = 30


class Empty(NamedTuple):
    """A proof that no trajectory fits the rows a to b - 1 and the box before them.

    `y` (rows, nx + ny) are the multipliers of a Farkas ray, or None where a single row leaves no box.
    """

    a: int
    b: int
    y: Array | None
    row: int | None


class Question(NamedTuple):
    """A window and functionals to bound above: c[p]'x at state k[p] of the window."""

    rows: Rows
    lo: Array
    hi: Array
    c: Array
    k: NDArray[np.int32]


#: Proposes multipliers (functionals, rows, nx + ny) and the objective of each; neither is trusted.
Proposer = Callable[[Question], tuple[Array, Array]]


@dataclass(eq=False)
class Boxes:
    """Safe boxes lo, hi (T + 1, nx) of the states of a chain; narrowed in place.

    Parameters
    ----------
    rows : Rows
    lo, hi : (T + 1, nx)
    proposers : sequence
        Who is asked for multipliers, in turn; None is the core itself.
    """

    rows: Rows
    lo: Array
    hi: Array
    proposers: Sequence[Proposer | None]
    loose: int = 0
    asked: int = 0
    tries: dict[int, int] = field(default_factory=dict, repr=False)

    def sweep(self, windows: Sequence[tuple[int, int, int]]) -> tuple[Array, Array, int, Empty | None]:
        """Narrow the states k by windows (a, b, k), one after the other.

        Returns the boxes of k as each window left them, (windows, nx) each, how many windows were done, and the proof
        where one is empty.
        """
        todo = np.array(windows, dtype=np.int32).reshape(-1, 3)
        a, b, k = (np.ascontiguousarray(column) for column in todo.T)
        out_lo, out_hi, done = np.zeros((len(todo), self.rows.nx)), np.zeros((len(todo), self.rows.nx)), 0
        r = self.rows
        while done < len(todo):
            if self.proposers[0] is None:
                before = done
                done = _core.hull_sweep(
                    r.E_lo, r.A_lo, r.C_lo, r.bx_lo, r.bx_hi, r.by_lo, r.by_hi, self.lo, self.hi, a, b, k, out_lo,
                    out_hi, done, LOOSE, _LEAST, E_hi=r.E_hi, A_hi=r.A_hi, C_hi=r.C_hi,
                )  # fmt: skip
                self.asked += 2 * r.nx * (done - before)
            if done < len(todo):  # this one is not clean
                empty = self.narrow(int(a[done]), int(b[done]), int(k[done]))
                if empty is not None:
                    return out_lo, out_hi, done, empty
                out_lo[done], out_hi[done] = self.lo[k[done]], self.hi[k[done]]
                done += 1
        return out_lo, out_hi, done, None

    def narrow(self, a: int, b: int, state: int) -> Empty | None:
        """Narrow the boxes of the window of states a to b, and fully that of one state, by rows a to b - 1."""
        first, known = a, 0  # the window's first state, and how many states before the first that rows speak of
        found = self._solved(self._question(a, b, state), a)
        if found is None:
            # Contraction alone leaves a state without a bound. What a few tries with ever more rows leave so, stays so.
            lo, hi = self.lo[a : b + 1], self.hi[a : b + 1]
            lost = np.flatnonzero(~(np.isfinite(lo) & np.isfinite(hi)).all(axis=1)) + a
            if any(self.tries.get(k, 0) < _TRIES for k in lost.tolist()):
                failed = self.finite(a, b)
                if failed is not None:
                    return failed
                self.tries.update({k: self.tries.get(k, 0) + 1 for k in lost.tolist()})
            lost = np.flatnonzero(~(np.isfinite(lo) & np.isfinite(hi)).all(axis=1))
            if lost.size:
                # Rows after the last unbounded state still hold all that they say of the states after it: it becomes a
                # state that no row knows.
                first, known = a + int(lost[-1]), 1
                if state <= first:
                    return None
            ask = self._question(first, b, state)
            if known:
                lo, hi = ask.lo.copy(), ask.hi.copy()
                lo[0] = hi[0] = 0.0
                ask = Question(ask.rows.without_dynamics(0), lo, hi, ask.c, ask.k)
            found = self._solved(ask, first)
        if found is None:
            return None
        if isinstance(found, Empty):
            return found
        lo, hi = found
        np.maximum(self.lo[first + known : b + 1], lo[known:], out=self.lo[first + known : b + 1])
        np.minimum(self.hi[first + known : b + 1], hi[known:], out=self.hi[first + known : b + 1])
        return None

    def _question(self, a: int, b: int, state: int) -> Question:
        c, k = sides(self.rows.nx, state - a)
        return Question(self.rows.part(a, b), self.lo[a : b + 1], self.hi[a : b + 1], c, k)

    def _solved(self, ask: Question, a: int) -> "Empty | tuple[Array, Array] | None":
        """Return the boxes of a window with the sides that are asked for, asking again until they are tight.

        None if a state stays without a bound.
        """
        nx, kinds, T = self.rows.nx, self.rows.nx + self.rows.ny, ask.rows.T
        k = int(ask.k[0])
        best, y, value, lo, hi, bad = bounded(ask, self.proposers[0], contract=True)
        if bad:
            return Empty(a, a + T, None, a * kinds + bad - 1)
        if not (np.isfinite(lo).all() and np.isfinite(hi).all()):
            return None
        self.asked += len(best)
        rest = [self.proposers[0]] * _ROUNDS + list(self.proposers[1:])
        for step in range(len(rest) + 1):
            upper, lower = best[:nx], -best[nx:]
            if (lower > upper).any():
                j = int(np.argmax(lower > upper))
                return Empty(a, a + T, y[j] + y[nx + j], None)
            lower, upper = np.maximum(lower, lo[k]), np.minimum(upper, hi[k])
            if (lower > upper).any():
                return Empty(a, a + T, None, None)
            lo[k], hi[k] = lower, upper
            width, size = upper - lower, np.maximum(np.abs(lower), np.abs(upper))
            # An objective above the bound is a lie, one far below it a bad answer.
            off = np.abs(best - value)
            wrong = ~(off <= np.tile(LOOSE * width + _LEAST * size, 2))
            if not wrong.any():
                return lo, hi
            if step == len(rest):
                break
            some = np.flatnonzero(wrong)
            now = Question(ask.rows, lo, hi, np.ascontiguousarray(ask.c[some]), np.ascontiguousarray(ask.k[some]))
            bound, new, claim, lo, hi, _ = bounded(now, rest[step], contract=False)
            better = bound < best[some]
            best[some[better]], y[some[better]], value[some] = bound[better], new[better], claim
        self.loose += int(np.count_nonzero(~(off <= np.tile(_REPORT * width + 10 * _LEAST * size, 2))))
        return lo, hi

    def functional(self, a: int, b: int, c: Array, state: int) -> tuple[float, float]:
        """Return bounds of c'x at one state by rows a to b - 1; infinite where there is none."""
        part, lo, hi = self.rows.part(a, b), self.lo[a : b + 1].copy(), self.hi[a : b + 1].copy()
        k = np.full(2, state - a, dtype=np.int32)
        best = np.full(2, np.inf)
        for proposer in self.proposers:
            bound, _, value, _, _, bad = bounded(
                Question(part, lo, hi, np.vstack((c, -c)), k), proposer, contract=False
            )
            best = best if bad else np.minimum(best, bound)
            if np.all(best - value <= LOOSE * max(float(best.sum()), 0.0) + 1e-13 * np.abs(best)):
                break
        return float(-best[1]), float(best[0])

    def finite(self, a: int, b: int) -> Empty | None:
        """Try to give every state of a window a finite box: by contraction, then by a left inverse of its rows."""
        if np.isfinite(self.lo[a : b + 1]).all() and np.isfinite(self.hi[a : b + 1]).all():
            return None
        states = far_back(self.rows.nx)
        a = max(0, min(a, b - states))  # rows before the window may say what those in it do not
        for again in (True, False):
            part = self.rows.part(a, b)
            lo, hi, bad = _core.box_contract(
                part.E_lo, part.A_lo, part.C_lo, part.bx_lo, part.bx_hi, part.by_lo, part.by_hi,
                np.ascontiguousarray(self.lo[a : b + 1]), np.ascontiguousarray(self.hi[a : b + 1]), 20,
                part.E_hi, part.A_hi, part.C_hi,
            )  # fmt: skip
            if bad:
                return Empty(a, b, None, a * (self.rows.nx + self.rows.ny) + bad - 1)
            self.lo[a : b + 1], self.hi[a : b + 1] = lo, hi
            if not again or (np.isfinite(lo).all() and np.isfinite(hi).all()):
                return None
            for first in (max(a, b - states), max(a, b - states) + 1):
                if first <= b and self._enclose(first, b):
                    break
        return None

    def _enclose(self, a: int, b: int) -> bool:
        """Bound the states a to b by a left inverse Y of their rows; say whether that worked.

        With Y M = I - R, |x| <= |Y b| + |R| |x|, so that |x| <= g / (1 - |R|) in the largest norm. R and the products
        are computed with a bound of their rounding; an interval entry of M adds |Y| times its radius to R.
        """
        rows, box_lo, box_hi = self.rows.part(a, b), self.lo[a : b + 1].ravel(), self.hi[a : b + 1].ravel()
        M, low, high = sparse_rows(rows)
        box, there = np.isfinite(box_lo) & np.isfinite(box_hi), np.isfinite(low) & np.isfinite(high)
        M = np.concatenate((np.eye(box.size)[box], M.toarray()[there]))
        low, high = np.concatenate((box_lo[box], low[there])), np.concatenate((box_hi[box], high[there]))
        radius = np.zeros_like(M)
        if rows.A_hi is not None or rows.C_hi is not None or rows.E_hi is not None:
            off = _sparse(rows.radius("A"), rows.radius("E"), rows.radius("C")).toarray()
            radius[int(box.sum()) :] = off[there]
        size = M.shape[1]
        if len(M) < size:
            return False
        scale = np.abs(M).sum(axis=1)
        scale = np.where(scale > 0, scale, 1.0)
        Q, T = np.linalg.qr(M / scale[:, None])
        if not np.abs(np.diagonal(T)).min() > 1e-12:
            return False
        Y = np.linalg.solve(T, Q.T) / scale
        gamma = (len(M) + size + 8) * 4.5e-16
        R = np.abs(np.eye(size) - Y @ M) + np.abs(Y) @ radius * (1.0 + gamma)
        R = (R + gamma * (np.abs(Y) @ np.abs(M) + np.eye(size)) + 1e-290) * (1.0 + gamma)
        norm = R.sum(axis=1) * (1.0 + gamma)
        if not norm.max() < 0.1:
            return False
        g = (np.abs(Y) @ np.maximum(np.abs(low), np.abs(high)) + 1e-290) * (1.0 + gamma)
        reach = g.max() / (1.0 - norm.max()) * (1.0 + gamma)
        each = ((g + norm * reach) * (1.0 + gamma)).reshape(-1, self.rows.nx)
        if not np.isfinite(each).all():
            return False
        self.lo[a : b + 1] = np.maximum(self.lo[a : b + 1], -each)
        self.hi[a : b + 1] = np.minimum(self.hi[a : b + 1], each)
        return True


def far_back(nx: int) -> int:
    """Return how many rows are looked at to bound states of an infinite box."""
    return max(1, _DENSE // nx)


@functools.lru_cache(maxsize=256)
def sides(nx: int, state: int) -> tuple[Array, NDArray[np.int32]]:
    """Return the functionals +x_j, -x_j of one state of a window, and the state of each; not to be changed."""
    return np.vstack((np.eye(nx), -np.eye(nx))), np.full(2 * nx, state, dtype=np.int32)


def bounded(
    ask: Question, proposer: Proposer | None, *, contract: bool
) -> tuple[Array, Array, Array, Array, Array, int]:
    """Return proved bounds (functionals,), multipliers, proposed objectives, the boxes, and 1 + the row at fault."""
    r = ask.rows
    given = [r.E_lo, r.A_lo, r.C_lo, r.bx_lo, r.bx_hi, r.by_lo, r.by_hi]
    last = {"E_hi": r.E_hi, "A_hi": r.A_hi, "C_hi": r.C_hi}
    sweeps = 1 if contract else 0
    if proposer is None:
        bound, y, value, _, lo, hi, _, bad = _core.hull_window(
            *given, ask.lo, ask.hi, ask.c, ask.k, sweeps=sweeps, **last
        )
        return bound, y, value, lo, hi, int(bad)
    y, value = proposer(ask)
    shape = (len(ask.c), r.T, r.nx + r.ny)
    try:
        y = np.ascontiguousarray(np.broadcast_to(np.asarray(y, dtype=np.float64), shape))
        value = np.array(np.broadcast_to(np.asarray(value, dtype=np.float64), (len(ask.c),)))
    except (TypeError, ValueError):
        y, value = np.zeros(shape), np.full(len(ask.c), -np.inf)
    bound, y, _, _, lo, hi, _, bad = _core.hull_window(*given, ask.lo, ask.hi, ask.c, ask.k, y=y, sweeps=sweeps, **last)
    return bound, y, value, lo, hi, int(bad)


def stock(ask: Question) -> tuple[Array, Array]:
    """Ask the stock linear programming solver for multipliers."""
    from halfwidth.solvers.lp import solve
    from halfwidth.solvers.program import Program
    from halfwidth.solvers.stock import HIGHS

    M, low, high = sparse_rows(ask.rows)
    nx = ask.rows.nx
    y, value = np.zeros((len(ask.c), ask.rows.T, nx + ask.rows.ny)), np.full(len(ask.c), -np.inf)
    seen = np.isfinite(low) | np.isfinite(high)
    if not seen.any():
        return y, value
    for p, (c, k) in enumerate(zip(ask.c, ask.k, strict=True)):
        cost = np.zeros(M.shape[1])
        cost[k * nx : (k + 1) * nx] = -c
        found = solve(
            Program(cost, M[seen], low[seen], high[seen], ask.lo.ravel().copy(), ask.hi.ravel().copy()), (HIGHS,)
        )
        if found.z is not None:
            y[p].reshape(-1)[seen] = -found.z
            value[p] = -found.objective if found.solved else -np.inf
    return y, value


def sparse_rows(rows: Rows) -> tuple[Any, Array, Array]:
    """Return M (K (nx + ny), (K + 1) nx) as CSR and the ends of its rows, time by time, dynamics first.

    Interval entries are taken at their middle.
    """
    M = _sparse(-rows.middle("A"), rows.middle("E"), rows.middle("C"))
    low = np.concatenate((rows.bx_lo, rows.by_lo), axis=1).ravel()
    high = np.concatenate((rows.bx_hi, rows.by_hi), axis=1).ravel()
    return M, low, high


def _sparse(A: Array, E: Array, C: Array) -> Any:
    """Return the chain with A (K, nx, nx) on the states before, E and C (K, ny, nx) on those after, as CSR."""
    import scipy.sparse as sp

    K, ny, nx = C.shape
    t, i, j = (v.ravel() for v in np.meshgrid(np.arange(K), np.arange(nx), np.arange(nx), indexing="ij"))
    s, o, h = (v.ravel() for v in np.meshgrid(np.arange(K), np.arange(ny), np.arange(nx), indexing="ij"))
    row = np.concatenate((t * (nx + ny) + i, t * (nx + ny) + i, s * (nx + ny) + nx + o))
    column = np.concatenate((t * nx + j, (t + 1) * nx + j, (s + 1) * nx + h))
    value = np.concatenate((A[t, i, j], E[t, i, j], C[s, o, h]))
    M = sp.csr_array((value, (row, column)), shape=(K * (nx + ny), (K + 1) * nx))
    M.eliminate_zeros()
    return M
