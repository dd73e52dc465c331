"""The rows of a model over a record as intervals that must contain, rounding included.

::

    E x[t] - A x[t-1] in B u[t] +- q,     C x[t] in F y[t] +- r

Numbers that a user gave are exact as they stand; every sum and product of them is moved outwards by a unit in the last
place. An unknown entry theta of a matrix becomes its interval from ``theta_bounds``, at every row anew.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.errors import Refused
from halfwidth.model import Linear, Model, needs_a_box
from halfwidth.noise import Uniform
from halfwidth.record import Record
from halfwidth.spread import Box, Halfspaces
from halfwidth.varying import Varying

Pair = tuple[Array, Array]


def down(value: Any) -> Array:
    """Return a number below each rounded result, and so not above the exact one."""
    return np.asarray(np.nextafter(value, -np.inf))


def up(value: Any) -> Array:
    """Return a number above each rounded result, and so not below the exact one."""
    return np.asarray(np.nextafter(value, np.inf))


def below(a: Any, b: Any) -> Array:
    """Return a number not above a + b, which is the rounded sum itself where that is not above."""
    total = np.add(a, b)
    part = total - a
    error = (a - (total - part)) + (b - part)  # exactly a + b - total, Knuth's two-sum
    return np.where(error >= 0, total, down(total))


def above(a: Any, b: Any) -> Array:
    """Return a number not below a + b."""
    return -below(-np.asarray(a), -np.asarray(b))


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a chain in time: ``E x[t] - A x[t-1]`` in [bx], ``C x[t]`` in [by].

    Parameters
    ----------
    A_lo, C_lo : (nx, nx) and (ny, nx), or stacked (T, ., .)
    bx_lo, bx_hi : (T, nx)
    by_lo, by_hi : (T, ny)
        Infinite where nothing is seen.
    E_lo : as A_lo, or None for the identity
    E_hi, A_hi, C_hi : as E_lo, A_lo, C_lo, or None
        Upper ends where entries are intervals.
    walls : int
        How many of the last rows of C are bounds of the state, which no noise widens.
    """

    A_lo: Array
    C_lo: Array
    bx_lo: Array
    bx_hi: Array
    by_lo: Array
    by_hi: Array
    E_lo: Array | None = None
    E_hi: Array | None = None
    A_hi: Array | None = None
    C_hi: Array | None = None
    walls: int = 0

    @property
    def T(self) -> int:
        """Number of rows."""
        return len(self.bx_lo)

    @property
    def nx(self) -> int:
        """Number of states."""
        return int(self.bx_lo.shape[1])

    @property
    def ny(self) -> int:
        """Number of outputs, and of half-spaces after them."""
        return int(self.by_lo.shape[1])

    def part(self, a: int, b: int) -> "Rows":
        """Return rows a to b - 1."""

        def cut(matrix: Any) -> Any:
            return matrix if matrix is None or matrix.ndim < 3 else matrix[a:b]

        return Rows(
            cut(self.A_lo), cut(self.C_lo), self.bx_lo[a:b], self.bx_hi[a:b], self.by_lo[a:b], self.by_hi[a:b],
            cut(self.E_lo), cut(self.E_hi), cut(self.A_hi), cut(self.C_hi), self.walls,
        )  # fmt: skip

    def without_dynamics(self, row: int) -> "Rows":
        """Return the rows with nothing known of how one of them moved."""
        bx_lo, bx_hi = self.bx_lo.copy(), self.bx_hi.copy()
        bx_lo[row], bx_hi[row] = -np.inf, np.inf
        return replace(self, bx_lo=bx_lo, bx_hi=bx_hi)

    def joined(self, other: "Rows", keep: int) -> "Rows":
        """Return the last `keep` of these rows with `other` after them; matrices constant in both stay so."""
        a = max(0, self.T - keep)

        def both(one: Any, two: Any) -> Any:
            if one is None or (one.ndim == 2 and two.ndim == 2 and np.array_equal(one, two)):
                return one
            left = np.broadcast_to(one, (self.T, *one.shape[-2:]))[a:]
            right = np.broadcast_to(two, (other.T, *two.shape[-2:]))
            return np.ascontiguousarray(np.concatenate((left, right)))

        def pair(low: str, high: str) -> tuple[Any, Any]:
            l0, h0, l1, h1 = getattr(self, low), getattr(self, high), getattr(other, low), getattr(other, high)
            if h0 is None and h1 is None:
                return both(l0, l1), None
            return both(l0, l1), both(l0 if h0 is None else h0, l1 if h1 is None else h1)

        (E_lo, E_hi), (A_lo, A_hi), (C_lo, C_hi) = (pair(f"{k}_lo", f"{k}_hi") for k in "EAC")
        bx_lo, bx_hi, by_lo, by_hi = (
            np.concatenate((getattr(self, k)[a:], getattr(other, k))) for k in ("bx_lo", "bx_hi", "by_lo", "by_hi")
        )
        return Rows(A_lo, C_lo, bx_lo, bx_hi, by_lo, by_hi, E_lo, E_hi, A_hi, C_hi, self.walls)

    def middle(self, name: str) -> Array:
        """Return E, A or C (T, ., .) with the middle of each interval."""
        low, high = getattr(self, f"{name}_lo"), getattr(self, f"{name}_hi")
        if low is None:
            low = np.eye(self.nx)
        mid = low if high is None else 0.5 * (low + high)
        return np.broadcast_to(mid, (self.T, *mid.shape[-2:]))

    def radius(self, name: str) -> Array:
        """Return how far the entries of E, A or C (T, ., .) may be from their middles."""
        low, high, mid = getattr(self, f"{name}_lo"), getattr(self, f"{name}_hi"), self.middle(name)
        if high is None:
            return np.zeros_like(mid)
        return np.where(low == high, 0.0, np.maximum(up(high - mid), up(mid - low)))


def not_bounded(model: Model, name: str, *, walls: bool = False) -> str | None:
    """Return why a method for known half-widths cannot take a model, with a hint, or None.

    `walls` says whether it takes half-spaces.
    """
    if not walls and isinstance(model.bounds, Halfspaces):
        return needs_a_box(model, name)
    for symbol, noise in (("w", model.w), ("e", model.e)):
        if not isinstance(noise, Uniform):
            kind = type(noise).__name__
            return (
                f"`{name}` needs bounded noise but `{symbol}` is `{kind}`, which may be of any size"
                f"\nhint: {symbol}=Uniform(half-widths)"
            )
        if not noise.known:
            return f"`{name}` needs known half-widths but those of `{symbol}` are unknown\nhint: BatchLP()"
    if not isinstance(model.x0, Box):
        return f"`{name}` needs a box as prior but `x0` is `Normal`\nhint: x0=Box(lo, hi), or None for no bounds"
    if model.loss is not None:
        return f"`{name}` takes lost outputs as NaN in the record but the model has a hidden loss\nhint: loss=None"
    if isinstance(model, Linear):
        ends = model.theta_bounds
        known = [] if ends is None else (np.isfinite(ends.lo) & np.isfinite(ends.hi)).tolist()
        for k, entry in enumerate(model.theta_entries):
            if k >= len(known) or not known[k]:
                return (
                    f"`{name}` needs an interval for every unknown entry but `{entry.matrix}[{entry.row}, "
                    f"{entry.column}]` has none\nhint: theta_bounds=(lo, hi)"
                )
    return None


def interval_rows(model: Linear, record: Record) -> Rows:
    """Return the rows of a model with known uniform noise over a record."""
    t, dt = record.t, record.steps(model.dt)
    ends = theta_ends(model)
    pairs = {name: _pair(m, *(m.stack(t, dt)), ends.get(name), len(record)) for name, m in model.matrices.items()}
    u = None if record.u is None else np.asarray(record.u)
    return rows_of(model, pairs, u, np.asarray(record.y), record.seen)


def one_row(model: Linear, y: Array, u: Array | None, t: float, dt: float, row: int) -> Rows:
    """Return the rows of one time: outputs (ny,), inputs (nu,), its number for matrices that are stacked."""
    ends, pairs = theta_ends(model), {}
    for name, matrix in model.matrices.items():
        value = matrix.at(t, dt, row)
        pairs[name] = ends_of(matrix, value if matrix.constant else value[None], ends.get(name))
    return rows_of(model, pairs, None if u is None else u[None], y[None], ~np.isnan(y)[None])


def rows_of(
    model: Linear, pairs: dict[str, tuple[Array, Array | None]], u: Array | None, y: Array, seen: NDArray[np.bool_]
) -> Rows:
    """Return the rows from the ends of the matrices, inputs (T, nu) and outputs (T, ny)."""
    assert isinstance(model.w, Uniform)
    assert isinstance(model.e, Uniform)
    T, q, r = len(y), model.w.q, model.e.q
    lo, hi = np.zeros((T, model.nx)), np.zeros((T, model.nx))
    if "B" in pairs and u is not None:
        lo, hi = _dot(pairs["B"], u)
    bx = below(lo, -q), above(hi, q)
    C_lo, C_hi = pairs["C"]
    if "F" not in pairs:
        known = np.where(seen, y, 0.0)
        by: tuple[Array, ...] = (np.where(seen, below(known, -r), -np.inf), np.where(seen, above(known, r), np.inf))
    else:
        C_lo, C_hi, by = _folded(pairs["F"], (C_lo, C_hi), y, seen, r)
    E = pairs.get("E", (None, None))
    A, walls = pairs["A"], 0
    if isinstance(model.bounds, Halfspaces):
        D, low, high = model.bounds.rows
        walls = len(D)
        C_lo, C_hi = _stacked(C_lo, D), None if C_hi is None else _stacked(C_hi, D)
        by = tuple(np.hstack((end, np.tile(wall, (T, 1)))) for end, wall in zip(by, (low, high), strict=True))
    return Rows(A[0], C_lo, *bx, by[0], by[1], E[0], E[1], A[1], C_hi, walls)


def _stacked(C: Array, D: Array) -> Array:
    """Return C with the rows of D below, at every row of the record where C varies."""
    return np.ascontiguousarray(np.concatenate((C, np.broadcast_to(D, (*C.shape[:-2], *D.shape))), axis=-2))


def theta_ends(model: Linear) -> dict[str, Pair]:
    """Return, by matrix, arrays (rows, columns) with the interval of each unknown entry."""
    found: dict[str, Pair] = {}
    for k, entry in enumerate(model.theta_entries):
        if entry.matrix not in found:
            shape = model.matrices[entry.matrix].shape
            found[entry.matrix] = np.full(shape, np.nan), np.full(shape, np.nan)
        for end, bound in zip(found[entry.matrix], ("lo", "hi"), strict=True):
            end[entry.row, entry.column] = getattr(model.theta_bounds, bound)[k]
    return found


def _pair(matrix: Varying, stack: Array, index: Any, ends: Pair | None, T: int) -> tuple[Array, Array | None]:
    """Return the lower and, where they differ, the upper ends of a matrix: (., .) or (T, ., .)."""
    value = stack[index] if index is not None else stack[0] if len(stack) == 1 and T != 1 else stack
    if matrix.constant:
        value = stack[0]
    return ends_of(matrix, value, ends)


def ends_of(matrix: Varying, value: Array, ends: Pair | None) -> tuple[Array, Array | None]:
    """Return the ends of a matrix whose unknown entries are NaN."""
    lost = np.isnan(value)
    if not lost.any():
        return np.ascontiguousarray(value), None
    if ends is None:
        raise Refused(
            f"`Hull` needs bounds of every unknown entry but `{matrix.name}` as a function returned NaN",
            hint="give the entry a value, or write the matrix as a constant with NaN and theta_bounds",
        )
    return tuple(np.ascontiguousarray(np.where(lost, end, value)) for end in ends)  # type: ignore[return-value]


def _dot(matrix: tuple[Array, Array | None], u: Array) -> Pair:
    """Return bounds (T, rows) of an interval matrix times exact vectors (T, columns)."""
    low = matrix[0]
    high = low if matrix[1] is None else matrix[1]
    lo = np.zeros((len(u), low.shape[-2]))
    hi = lo.copy()
    for k in range(u.shape[1]):
        p, s = low[..., k] * u[:, k, None], high[..., k] * u[:, k, None]
        some = ((low[..., k] != 0) | (high[..., k] != 0)) & (u[:, k, None] != 0)
        lo = np.where(some, below(lo, down(np.minimum(p, s))), lo)
        hi = np.where(some, above(hi, up(np.maximum(p, s))), hi)
    return lo, hi


def _folded(
    F: tuple[Array, Array | None], C: tuple[Array, Array | None], y: Array, seen: NDArray[np.bool_], r: Array
) -> tuple[Array, Array | None, Pair]:
    """Return C and bounds of C x where outputs are correlated by F.

    A row of F that meets an unseen output k is added to -F_ik times row k, which makes that output drop out and the
    half-widths add up. Where the unseen outputs of a row are coupled among themselves the row is left out: the bound
    stays true and gets wider.
    """
    T, ny = y.shape
    F_lo = np.broadcast_to(F[0], (T, ny, ny))
    F_hi = F_lo if F[1] is None else np.broadcast_to(F[1], (T, ny, ny))
    off = ((F_lo != 0) | (F_hi != 0)) & ~np.eye(ny, dtype=bool)
    known = np.where(seen, y, 0.0)
    lo, hi = _dot((F_lo, F_hi), known)
    by_lo, by_hi = np.where(seen, below(lo, -r), -np.inf), np.where(seen, above(hi, r), np.inf)
    meets = off & seen[:, :, None] & ~seen[:, None, :]
    if not meets.any():
        return C[0], C[1], (by_lo, by_hi)
    C_lo = np.array(np.broadcast_to(C[0], (T, *C[0].shape[-2:])))
    C_hi = C_lo.copy() if C[1] is None else np.array(np.broadcast_to(C[1], C_lo.shape))
    base_lo, base_hi = C_lo.copy(), C_hi.copy()
    for t, i in np.argwhere(meets.any(axis=2)):
        width, shift_lo, shift_hi = float(r[i]), lo[t, i], hi[t, i]
        lost = np.flatnonzero(meets[t, i])
        if any(off[t, k, j] for k in lost for j in np.flatnonzero(~seen[t])) or np.any(F_lo[t, i] != F_hi[t, i]):
            by_lo[t, i], by_hi[t, i] = -np.inf, np.inf
            continue
        for k in lost:
            f = F_lo[t, i, k]
            ends = np.sort([f * base_lo[t, k], f * base_hi[t, k]], axis=0)
            C_lo[t, i], C_hi[t, i] = down(C_lo[t, i] - up(ends[1])), up(C_hi[t, i] - down(ends[0]))
            moved = sorted((f * lo[t, k], f * hi[t, k]))
            shift_lo, shift_hi = down(shift_lo - up(moved[1])), up(shift_hi - down(moved[0]))
            width = float(up(width + up(abs(f) * r[k])))
        by_lo[t, i], by_hi[t, i] = down(shift_lo - width), up(shift_hi + width)
    return C_lo, C_hi, (by_lo, by_hi)
