"""Hull: the exact interval of every state that the bounds and the data leave, proved in floating point.

With known half-widths the data leave a polytope of trajectories,

    |E x[t] - A x[t-1] - B u[t]| <= q,     |F y[t] - C x[t]| <= r   (seen rows),     x0 in its box,

and the hull is the least box around the states x[t] of it. Each of its 2 nx sides is a linear program; a missing output
is a row left out. Whatever solver runs, what is reported is the dual bound of Neumaier and Shcherbina with all rounding
accounted for (core/hull.hpp): a poor answer loosens it by its own error and cannot put it inside the truth. Data that
contradict the bounds are a certified `Status.INFEASIBLE` that names rows and times, never a bound.

A nonlinear model is taken where `g` and `h` can be recorded: over boxes that a cheap set found they are affine with a
proved distance (`halfwidth.enclosure`), which widens the noise; the box is then safe and near the least.

An entry of A, B, C, E or F known only to an interval is NaN with ``theta_bounds``. It may be another number at every
row; its product with a state is bounded over the state's box, so the answer contains and is no longer the least.

References
----------
Milanese and Vicino (1991), Automatica 27(6). Neumaier and Shcherbina (2004), Math. Program. 99.
Benhamou, Goualard, Granvilliers and Puget (1999), ICLP: forward-backward contraction.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.errors import BadValue, Refused
from halfwidth.methods._affine import affine_rows, not_recorded
from halfwidth.methods._bounds import Rows, interval_rows, not_bounded
from halfwidth.methods._boxes import Boxes, Empty, Proposer, stock
from halfwidth.methods._conflict import Conflict, conflict_of
from halfwidth.methods._protocol import typed
from halfwidth.methods._rows import window_starts
from halfwidth.methods.sets import ZonotopeFilter
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.noise import Uniform
from halfwidth.record import Labels, Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Box

if TYPE_CHECKING:
    from halfwidth.methods._hull_live import Live

#: A window reaches back until it holds this many seen entries of every output, but at most so many memories.
FIXES, STRETCH = 2, 10
#: Without a memory, the first reach of a window; it doubles until a state gains less than GAIN of its width. What is
#: left falls at least as fast as the reach grows, so that is much less than the last gain.
REACH, GAIN = 10, 1e-3

PROPOSERS: tuple[Proposer | None, ...] = (None, stock)
#: Times that a nonlinear model is replaced by affine rows.
_AFFINE = 2


@dataclass(frozen=True)
class Hull:
    """The box that must contain each state, for noise in boxes of known half-widths.

    Parameters
    ----------
    memory : int or None
        Rows of the past that a state's box is found from, the box before them being safe already; more in an outage.
        None is all rows.
    lag : int or None
        Rows after a state that count for it. None is all of them without a `memory`, and 0 with one.

    Notes
    -----
    ``x`` is the middle of the box. In ``info``: ``x0_lo``, ``x0_hi`` (nx,), the box of the state one step before the
    first row; ``loose``, how many sides are wider than 1e-6 of the width above the least (status REDUCED), of how many
    ``sides``; of an infeasible record ``conflict``, its rows, and ``growth``, the factor on all half-widths that
    reconciles it.

    Raises
    ------
    BadValue
        If a setting is out of its domain.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Uniform(1.0), hw.Uniform(0.5), None)
    >>> est = hw.estimate(walk, hw.Record([0.0, 1.0, 2.0], [0.0, None, 2.0]), hw.Hull())
    >>> est.guaranteed, [[round(float(v), 6) for v in side.ravel()] for side in est.interval()]
    (True, [[-0.5, 0.5, 1.5], [0.5, 1.5, 2.5]])
    """

    memory: int | None = None
    lag: int | None = None

    def __post_init__(self) -> None:
        if self.memory is not None and (not isinstance(self.memory, int | np.integer) or self.memory < 1):
            raise BadValue(f"`memory` is {self.memory!r}, a positive whole number of rows or None was expected")
        if self.lag is not None and (not isinstance(self.lag, int | np.integer) or self.lag < 0):
            raise BadValue(f"`lag` is {self.lag!r}, a whole number of rows from 0 was expected", hint="lag=None")

    @property
    def smooth(self) -> bool:
        """Whether all later rows count for a state."""
        return self.memory is None and self.lag is None

    def refuses(self, model: Model) -> str | None:
        """Return why nothing can be guaranteed on the model, or None."""
        if isinstance(model, Nonlinear) and self.memory is not None:
            return (
                f"`{typed(self)}` needs a linear model but the model is nonlinear"
                "\nhint: Hull() for a whole record, ZonotopeFilter() on line"
            )
        reason = not_bounded(model, "Hull", walls=isinstance(model, Linear))
        return not_recorded(model, "Hull") if reason is None and isinstance(model, Nonlinear) else reason

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:  # noqa: ARG002
        """Bound the states of one record."""
        return run(self, model, record)

    def stream(self, model: Linear, t: float) -> "Live":
        """Return the on-line form, for `halfwidth.stream`.

        Raises
        ------
        Refused
            Without a memory, since the cost of a row would grow without end.
        """
        if self.memory is None:
            raise Refused(f"`{typed(self)}` has no online form: it keeps all rows", hint="Hull(memory=10)")
        from halfwidth.methods._hull_live import Live

        return Live(self, model, t)


def run(method: Hull, model: Model, record: Record, proposers: Sequence[Proposer | None] = PROPOSERS) -> Estimate:
    """Bound the states of a record with the given proposers of multipliers, none of which is trusted."""
    lo, hi = outer(model, len(record))
    if isinstance(model, Linear):
        return _bounded(method, model, record, interval_rows(model, record), lo, hi, proposers)
    # Affine rows over the boxes of a cheap set, and once more over those that they give.
    est = ZonotopeFilter().run(model, record)
    for _ in range(_AFFINE):
        if not est.status.good:
            return dataclasses.replace(est, method=typed(method))
        lo[1:], hi[1:] = est.interval()
        est = _bounded(method, model, record, affine_rows(model, record, lo, hi), lo, hi, proposers)
    return est


def _bounded(
    method: Hull,
    model: Model,
    record: Record,
    rows: Rows,
    lo: Array,
    hi: Array,
    proposers: Sequence[Proposer | None],
) -> Estimate:
    """Bound the states by rows, from boxes (T + 1, nx) that are safe already."""
    nx = model.nx
    boxes = Boxes(rows, lo.copy(), hi.copy(), proposers)
    out_lo, out_hi, empty = narrowed(method, boxes, record.seen)
    info: dict[str, Any] = {"loose": boxes.loose, "sides": boxes.asked, "x0_lo": boxes.lo[0], "x0_hi": boxes.hi[0]}
    if empty is not None:
        names = (names_of(model.names.x, "x", nx), names_of(record.labels.outputs or model.names.y, "y", model.ny))
        conflict = conflict_of(rows, lo, hi, record.t, empty, names)
        info |= {"message": conflict.message, "conflict": conflict.rows, "growth": conflict.growth}
        info |= {"proved": conflict.proved, "hint": _hint(conflict)}
        x = _somewhere(out_lo, out_hi, empty.b, conflict)
        return answer(method, model, record.t, x, None, Status.INFEASIBLE, info, record.labels)
    box = Box(out_lo, out_hi, guaranteed=True)
    status = Status.REDUCED if boxes.loose else Status.OK
    if boxes.loose:
        info["message"] = f"{status.value}: {boxes.loose} of {boxes.asked} sides are proved but loose"
    return answer(method, model, record.t, middle(box), box, status, info, record.labels)


def answer(
    method: Hull,
    model: Model,
    t: Array,
    x: Array,
    box: Box | None,
    status: Status,
    info: dict[str, Any],
    labels: Labels,
) -> Estimate:
    """Return the estimate of a hull: its half-widths are those of the model."""
    assert isinstance(model.w, Uniform)
    assert isinstance(model.e, Uniform)
    q, r = model.w.q, model.e.q
    return Estimate(t, x, box, status, typed(method), q=q, r=r, names=model.names.x, labels=labels, info=info)


def outer(model: Model, T: int) -> tuple[Array, Array]:
    """Return what is known of the states x_0 .. x_T without any row, each (T + 1, nx)."""
    assert isinstance(model.x0, Box)
    lo, hi = np.full((T + 1, model.nx), -np.inf), np.full((T + 1, model.nx), np.inf)
    if isinstance(model.bounds, Box):
        lo[1:], hi[1:] = model.bounds.lo, model.bounds.hi
    lo[0], hi[0] = model.x0.lo, model.x0.hi
    return lo, hi


def narrowed(method: Hull, boxes: Boxes, seen: NDArray[np.bool_]) -> tuple[Array, Array, Empty | None]:
    """Narrow all boxes; return those of x_1 .. x_T by the rows that count for each, or the proof that there is none."""
    memory, lag = method.memory, 0 if method.lag is None else int(method.lag)
    reach = REACH if memory is None else int(memory)
    lo, hi, empty = _forward(boxes, seen, reach, lag)
    if memory is not None or empty is not None:
        return lo, hi, empty
    if method.lag is None:
        lo, hi = boxes.lo[1:], boxes.hi[1:]
        return lo, hi, _backward(boxes, seen, reach)
    # All rows of the past: a wider window starts from fresh boxes where its rows end, so each reach runs by itself.
    T, prior = boxes.rows.T, (boxes.lo[0].copy(), boxes.hi[0].copy())
    live = np.ones(T, dtype=bool)
    while reach < T and live.any():
        reach *= 2
        wider = Boxes(boxes.rows, np.vstack((boxes.lo[:1], lo)), np.vstack((boxes.hi[:1], hi)), boxes.proposers)
        wider.lo[0], wider.hi[0] = prior
        with np.errstate(invalid="ignore"):
            before = hi - lo
        lo, hi, empty = _forward(wider, seen, reach, lag, live)
        boxes.loose, boxes.asked = boxes.loose + wider.loose, boxes.asked + wider.asked
        if empty is not None:
            break
        with np.errstate(invalid="ignore"):
            live &= ~np.all(before - (hi - lo) <= GAIN * before, axis=1)
    return lo, hi, empty


def _forward(
    boxes: Boxes, seen: NDArray[np.bool_], reach: int, lag: int, live: NDArray[np.bool_] | None = None
) -> tuple[Array, Array, Empty | None]:
    """Go through the rows once; return the boxes of x_1 .. x_T when their rows were complete."""
    T = boxes.rows.T
    out_lo, out_hi = boxes.lo[1:].copy(), boxes.hi[1:].copy()
    start = window_starts(seen, reach, fixes=FIXES, stretch=max(reach * STRETCH, 1))
    windows: list[tuple[int, int, int]] = []
    for row in range(T):
        done = range(max(0, row - lag), T) if row == T - 1 else [row - lag] if row >= lag else []
        if live is not None:
            done = [k for k in done if live[k]]
            if not done:
                continue
        a = int(start[min(done)]) if done else 0
        windows += [(a, row + 1, k + 1) for k in sorted({row, *done}, reverse=True)]
    lo, hi, count, empty = boxes.sweep(windows)
    for (_, b, k), low, high in zip(windows[:count], lo, hi, strict=False):
        if b - k == lag or b == T:  # all rows that count for k were there
            out_lo[k - 1], out_hi[k - 1] = low, high
    if empty is not None and count < len(windows):
        last = max(0, windows[count][2] - 1)
        out_lo[last:], out_hi[last:] = boxes.lo[last + 1 :], boxes.hi[last + 1 :]
    return out_lo, out_hi, empty


def _backward(boxes: Boxes, seen: NDArray[np.bool_], reach: int) -> Empty | None:
    """Narrow every box by the rows on both sides, further away until that gains nothing."""
    T = boxes.rows.T
    live = np.ones(T + 1, dtype=bool)
    while True:
        longest = max(reach * STRETCH, 1)
        start = window_starts(seen, reach, fixes=FIXES, stretch=longest)
        stop = T - window_starts(seen[::-1], reach, fixes=FIXES, stretch=longest)[::-1]
        with np.errstate(invalid="ignore"):
            before = boxes.hi - boxes.lo
        empty = boxes.sweep(
            [
                (int(start[k - 1]) if k else 0, int(stop[k]) if k < T else T, k)
                for k in np.flatnonzero(live)[::-1].tolist()
            ]
        )[3]
        if empty is not None:
            return empty
        if reach >= T:
            return None
        with np.errstate(invalid="ignore"):
            gained = ~(before - (boxes.hi - boxes.lo) <= GAIN * before)
        live = live & (gained.any(axis=1) | (reach == REACH))
        if not live.any():
            return None
        reach *= 2


def middle(box: Box) -> Array:
    """Return the middle of every box; where an end is infinite the finite end, or 0."""
    return np.clip(box.mean, box.lo, box.hi)


def _somewhere(lo: Array, hi: Array, b: int, conflict: Conflict) -> Array:
    """Return finite states of an infeasible record: a trajectory that needs the growth, else the last safe boxes."""
    T = len(lo)
    x = middle(Box(np.minimum(lo, hi), np.maximum(lo, hi)))
    if conflict.x is not None:
        x[conflict.first : conflict.first + len(conflict.x)] = conflict.x
        x[conflict.first + len(conflict.x) :] = conflict.x[-1]
    elif b < T:
        x[b:] = x[b - 1]
    return np.nan_to_num(x, nan=0.0, posinf=0.0, neginf=0.0)


def _hint(conflict: Conflict) -> str:
    if conflict.growth is None:
        return "leave the rows of info['conflict'] away, or declare wider half-widths"
    return "leave the rows of info['conflict'] away, or multiply the half-widths of w and e by the growth"


def names_of(given: Sequence[str], symbol: str, n: int) -> tuple[str, ...]:
    """Return n names: those given, or the symbol with numbers."""
    return tuple(given) if len(given) == n else tuple(f"{symbol}{k}" for k in range(n))
