"""What to say when no trajectory fits: which rows disagree, and how much wider the bounds would have to be.

One linear program minimises the common factor s by which all half-widths grow until some trajectory fits. Its
multipliers are a Farkas ray of the original rows: the rows they name cannot all hold, which is proved again by the
guaranteed bound of core/hull.hpp, and s is what would reconcile them.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.methods._bounds import Rows
from halfwidth.methods._boxes import Boxes, Empty, Question, bounded, sparse_rows

#: A row's share of the ray below which it is not named.
_SHARE = 1e-6
#: A growth beyond this reconciles nothing that was meant.
_ABSURD = 1e9
#: Most rows that the program looks at.
_MOST = 2000


class Culprit(NamedTuple):
    """One row of a contradiction: its time, the output or state it is about, and its share of the proof."""

    t: float
    kind: str
    name: str
    share: float


@dataclass(frozen=True, eq=False)
class Conflict:
    """Why no trajectory fits.

    Parameters
    ----------
    rows : tuple of Culprit
        The rows that contradict each other, in the order of time.
    growth : float or None
        Factor on all half-widths with which everything fits; None where no factor does or it was not found.
    proved : bool
        Whether these rows alone, with the box before them, are proved to contradict each other.
    x : (K, nx) array or None
        States of rows `first`, `first` + 1, ... of a trajectory that needs the growth.
    first : int
    """

    rows: tuple[Culprit, ...]
    growth: float | None
    proved: bool
    x: Array | None
    first: int

    @property
    def message(self) -> str:
        """The conflict in words."""
        text = "no trajectory fits the bounds"
        if self.rows:
            t0, t1 = self.rows[0].t, self.rows[-1].t
            text += f" at t = {t0:g} s" if t0 == t1 else f" between t = {t0:g} s and t = {t1:g} s"
        if self.growth is not None:
            # Rounded upwards, so that what is said is enough.
            text += f"; they fit if all half-widths grow {_rounded_up(self.growth):g} times"
        if self.rows:
            worst = max(self.rows, key=lambda one: one.share)
            text += f"; most at odds: {worst.kind} `{worst.name}` at t = {worst.t:g} s"
        return text


def conflict_of(
    rows: Rows, lo: Array, hi: Array, t: Array, empty: Empty, names: tuple[tuple[str, ...], tuple[str, ...]]
) -> Conflict:
    """Explain an empty set.

    Parameters
    ----------
    rows : Rows
        All rows there are, of times `t` (T,).
    lo, hi : (T + 1, nx)
        Boxes that do not come from the rows: prior, bounds of the states, boxes safe before these rows.
    empty : Empty
        The proof that was found.
    names : (states, outputs)
    """
    first = max(0, empty.b - _MOST) if rows.T > _MOST else 0
    last = min(rows.T, first + _MOST)
    part = rows.part(first, last)
    found = _least_growth(part, lo[first : last + 1], hi[first : last + 1])
    if found is not None:
        growth, y, x = found
        culprits = _named(part, y, t[first:last], names)
        proved = _refuted(part, lo[first : last + 1], hi[first : last + 1], y)
        if growth > 1.0 and culprits:
            return Conflict(culprits, growth, proved, x, first)
    culprits = ()
    if empty.y is not None:
        part = rows.part(empty.a, empty.b)
        culprits = _named(part, empty.y, t[empty.a : empty.b], names)
    elif empty.row is not None:
        step, kind = divmod(empty.row, rows.nx + rows.ny)
        culprits = (Culprit(float(t[step]), *_kind(kind, rows.nx, names), 1.0),)
    return Conflict(culprits, None, True, None, first)


def _least_growth(rows: Rows, lo: Array, hi: Array) -> tuple[float, Array, Array] | None:
    """Return the least factor on the half-widths, the multipliers (T, nx + ny) of its proof, and the states."""
    import scipy.sparse as sp

    from halfwidth.solvers.lp import solve
    from halfwidth.solvers.program import Program
    from halfwidth.solvers.stock import HIGHS

    M, low, high = sparse_rows(rows)
    noise = np.tile(np.arange(rows.nx + rows.ny) < rows.nx + rows.ny - rows.walls, rows.T)
    seen: NDArray[np.bool_] = np.isfinite(low) | np.isfinite(high)
    M, low, high, noise = M[seen], low[seen], high[seen], noise[seen]
    with np.errstate(invalid="ignore"):
        mid = 0.5 * (low + high)
        half = np.where(noise, 0.5 * (high - low), 0.0)
    column = sp.csr_array(half[:, None])
    none = np.full(len(low), np.inf)
    cost = np.zeros(M.shape[1] + 1)
    cost[-1] = 1.0
    program = Program(
        cost,
        sp.csr_array(sp.vstack((sp.hstack((M, -column)), sp.hstack((M, column))))),
        np.r_[-none, np.where(noise, mid, low)],
        np.r_[np.where(noise, mid, high), none],
        np.r_[lo.ravel(), 0.0],
        np.r_[hi.ravel(), np.inf],
    )
    answer = solve(program, (HIGHS,))
    if not answer.solved or answer.x is None or answer.z is None or not answer.x[-1] < _ABSURD:
        return None
    y = np.zeros(rows.T * (rows.nx + rows.ny))
    y[seen] = -(answer.z[: len(low)] + answer.z[len(low) :])
    return float(answer.x[-1]), y.reshape(rows.T, -1), answer.x[:-1].reshape(-1, rows.nx)[1:]


def _refuted(rows: Rows, lo: Array, hi: Array, y: Array) -> bool:
    """Say whether multipliers prove that no trajectory fits: a bound of 0'x below 0."""
    boxes = Boxes(rows, lo.copy(), hi.copy(), ())
    # To an unbounded state any rounding is infinite, so such states are given boxes first.
    if boxes.finite(0, rows.T) is not None:
        return True
    ask = Question(rows, boxes.lo, boxes.hi, np.zeros((1, rows.nx)), np.zeros(1, dtype=np.int32))
    bound, _, _, _, _, bad = bounded(ask, lambda _: (y[None], np.zeros(1)), contract=True)
    return bool(bad) or bool(bound[0] < 0.0)


def _named(rows: Rows, y: Array, t: Array, names: tuple[tuple[str, ...], tuple[str, ...]]) -> tuple[Culprit, ...]:
    """Return the rows with a share in the ray, weighed by their half-widths where they have one."""
    low, high = (
        np.concatenate((getattr(rows, f"bx_{end}"), getattr(rows, f"by_{end}")), axis=1) for end in ("lo", "hi")
    )
    there = np.isfinite(low) & np.isfinite(high)
    half = 0.5 * (np.where(there, high, 0.0) - np.where(there, low, 0.0))
    weight = np.abs(y) * half
    if not weight.sum() > 0:
        weight = np.abs(y)
    total = float(weight.sum())
    if not (total > 0 and np.isfinite(total)):
        return ()
    share = weight / total
    return tuple(
        Culprit(float(t[k]), *_kind(int(j), rows.nx, names), float(share[k, j])) for k, j in np.argwhere(share > _SHARE)
    )


def _kind(j: int, nx: int, names: tuple[tuple[str, ...], tuple[str, ...]]) -> tuple[str, str]:
    if j < nx:
        return "motion of", names[0][j]
    ny = len(names[1])
    return ("output", names[1][j - nx]) if j < nx + ny else ("bound", f"row {j - nx - ny} of D")


def _rounded_up(value: float) -> float:
    """Return a number of four digits not below `value`."""
    unit = 10.0 ** (np.floor(np.log10(value)) - 3)
    return float(np.ceil(value / unit) * unit)
