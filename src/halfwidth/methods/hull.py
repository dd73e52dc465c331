"""Hull: the exact interval of every state that the bounds and the data leave, proved in floating point.

With known half-widths the data leave a polytope of trajectories,

    |E x[t] - A x[t-1] - B u[t]| <= q,     |F y[t] - C x[t]| <= r   (seen rows),     x0 in its box,

and the hull is the least box around the states x[t] of it. Each of its 2 nx sides is a linear program; a missing output
is a row left out. Whatever solver runs, what is reported is the dual bound of Neumaier and Shcherbina with every rounding
accounted for (core/hull.hpp): a poor answer loosens it by its own error and cannot put it inside the truth. Data that
contradict the bounds are a certified `Status.INFEASIBLE` that names rows and times, never a bound.

A nonlinear model is taken where `g` and `h` can be recorded: over boxes that a cheap set found they are affine functions
with a proved distance (`halfwidth.enclosure`), which widens the noise; the box is then safe and near the least.

An entry of A, B, C, E or F known only to an interval is NaN with ``theta_bounds``. It may be another number at every
row; its product with a state is bounded over the state's box, so the answer contains and is no longer the least.

References
----------
Milanese and Vicino (1991), Automatica 27(6). Neumaier and Shcherbina (2004), Math. Program. 99.
Benhamou, Goualard, Granvilliers and Puget (1999), ICLP: forward-backward contraction.
"""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.array import Array, of_size, real
from halfwidth.errors import BadShape, BadValue, Refused
from halfwidth.methods._affine import affine_rows, not_recorded
from halfwidth.methods._bounds import Rows, ends_of, interval_rows, not_bounded, rows_of, theta_ends
from halfwidth.methods._boxes import Boxes, Empty, Proposer, far_back, stock
from halfwidth.methods._conflict import Conflict, conflict_of
from halfwidth.methods._protocol import pushed_row, typed
from halfwidth.methods.sets import ZonotopeFilter
from halfwidth.methods.window import window_starts
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Box

#: A window reaches back until it holds this many seen entries of every output, but at most so many memories.
_FIXES, _STRETCH = 2, 10
#: Without a memory, the first reach of a window; it doubles until a state gains less than _GAIN of its width.
_REACH, _GAIN = 10, 1e-5

#: Times that a nonlinear model is replaced by affine rows.
_AFFINE = 2

_PROPOSERS: tuple[Proposer | None, ...] = (None, stock)


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
    ``sides``; of an infeasible record ``conflict`` and its ``growth``, the factor on all half-widths that reconciles it.

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
        reason = not_bounded(model, "Hull")
        return not_recorded(model, "Hull") if reason is None and isinstance(model, Nonlinear) else reason

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:  # noqa: ARG002
        """Bound the states of one record."""
        return run(self, model, record)

    def stream(self, model: Linear, t: float) -> "_Live":
        """Return the on-line form, for `halfwidth.stream`.

        Raises
        ------
        Refused
            Without a memory, since the cost of a row would grow without end.
        """
        if self.memory is None:
            raise Refused(f"`{typed(self)}` has no online form: it keeps all rows", hint="Hull(memory=10)")
        return _Live(self, model, t)


def run(
    method: Hull, model: Model, record: Record, proposers: Sequence[Proposer | None] = _PROPOSERS
) -> Estimate:
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
    out_lo, out_hi, empty = _narrowed(method, boxes, record.seen)
    info: dict[str, Any] = {"loose": boxes.loose, "sides": boxes.asked, "x0_lo": boxes.lo[0], "x0_hi": boxes.hi[0]}
    if empty is not None:
        names = (_names(model.names.x, "x", nx), _names(record.labels.outputs or model.names.y, "y", model.ny))
        conflict = conflict_of(rows, lo, hi, record.t, empty, names)
        info |= {"message": conflict.message, "conflict": conflict.rows, "growth": conflict.growth}
        info |= {"proved": conflict.proved, "hint": _hint(conflict)}
        x = _somewhere(out_lo, out_hi, empty.b, conflict)
        return Estimate(
            record.t, x, None, Status.INFEASIBLE, typed(method), q=model.w.q, r=model.e.q,  # type: ignore[union-attr]
            names=model.names.x, labels=record.labels, info=info,
        )  # fmt: skip
    box = Box(out_lo, out_hi, guaranteed=True)
    status = Status.REDUCED if boxes.loose else Status.OK
    if boxes.loose:
        info["message"] = f"{status.value}: {boxes.loose} of {boxes.asked} sides are proved but loose"
    return Estimate(
        record.t, _middle(box), box, status, typed(method), q=model.w.q, r=model.e.q,  # type: ignore[union-attr]
        names=model.names.x, labels=record.labels, info=info,
    )  # fmt: skip


def outer(model: Model, T: int) -> tuple[Array, Array]:
    """Return what is known of the states x_0 .. x_T without any row, each (T + 1, nx)."""
    assert isinstance(model.x0, Box)
    lo, hi = np.full((T + 1, model.nx), -np.inf), np.full((T + 1, model.nx), np.inf)
    if model.bounds is not None:
        lo[1:], hi[1:] = model.bounds.lo, model.bounds.hi
    lo[0], hi[0] = model.x0.lo, model.x0.hi
    return lo, hi


def _narrowed(method: Hull, boxes: Boxes, seen: NDArray[np.bool_]) -> tuple[Array, Array, Empty | None]:
    """Narrow all boxes; return those of x_1 .. x_T as of the rows that count for each, or the proof that there is none."""
    memory, lag = method.memory, 0 if method.lag is None else int(method.lag)
    reach = _REACH if memory is None else int(memory)
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
            live &= ~np.all(before - (hi - lo) <= _GAIN * before, axis=1)
    return lo, hi, empty


def _forward(
    boxes: Boxes, seen: NDArray[np.bool_], reach: int, lag: int, live: NDArray[np.bool_] | None = None
) -> tuple[Array, Array, Empty | None]:
    """Go through the rows once; return the boxes of x_1 .. x_T when their rows were complete."""
    T = boxes.rows.T
    out_lo, out_hi = boxes.lo[1:].copy(), boxes.hi[1:].copy()
    start = window_starts(seen, reach, fixes=_FIXES, stretch=max(reach * _STRETCH, 1))
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
        longest = max(reach * _STRETCH, 1)
        start = window_starts(seen, reach, fixes=_FIXES, stretch=longest)
        stop = T - window_starts(seen[::-1], reach, fixes=_FIXES, stretch=longest)[::-1]
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
            gained = ~(before - (boxes.hi - boxes.lo) <= _GAIN * before)
        live = live & (gained.any(axis=1) | (reach == _REACH))
        if not live.any():
            return None
        reach *= 2


def _middle(box: Box) -> Array:
    """Return the middle of every box; where an end is infinite the finite end, or 0."""
    return np.clip(box.mean, box.lo, box.hi)


def _somewhere(lo: Array, hi: Array, b: int, conflict: Conflict) -> Array:
    """Return finite states of an infeasible record: a trajectory that needs the growth, else the last safe boxes."""
    T = len(lo)
    x = _middle(Box(np.minimum(lo, hi), np.maximum(lo, hi)))
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


def _names(given: Sequence[str], symbol: str, n: int) -> tuple[str, ...]:
    return tuple(given) if len(given) == n else tuple(f"{symbol}{k}" for k in range(n))


# ---- functionals ------------------------------------------------------------------------------------------------------


class Bound(NamedTuple):
    """Guaranteed interval of a functional c'x.

    Attributes
    ----------
    lo, hi : float or (T,) array
    """

    lo: Any
    hi: Any

    def excess(self, value: ArrayLike, half_width: ArrayLike = 0.0) -> Any:
        """Return how far ``value +- half_width`` lies outside, 0 where it does not.

        Above 0 it cannot be: no trajectory that obeys the bounds gives this value. So much wider would the half-width
        have to be.
        """
        below = np.nextafter(np.nextafter(np.asarray(self.lo) - value, -np.inf) - half_width, -np.inf)
        above = np.nextafter(np.nextafter(np.asarray(value) - self.hi, -np.inf) - half_width, -np.inf)
        found = np.maximum(np.maximum(below, above), 0.0)
        return float(found) if found.ndim == 0 else found


def bound(model: Linear, record: Record, c: ArrayLike, *, at: int | None = None) -> Bound:
    """Return the guaranteed interval of c'x[t] from all rows of a record.

    Parameters
    ----------
    model : Linear
        One that `Hull` takes.
    record : Record
    c : (nx,) array_like
        The functional, such as a row of C for an output, or the difference of two states.
    at : int, optional
        Row of the record, -1 for the last; all rows if absent.

    Returns
    -------
    Bound
        Of floats, or of (T,) arrays without `at`.

    Raises
    ------
    Refused
        If `Hull` does not take the model.
    Unsolved
        If no trajectory fits the data at all.

    Examples
    --------
    The outputs say 0 +- 0.5 and, two steps of at most 1 later, cannot be 4:

    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Uniform(1.0), hw.Uniform(0.5), None)
    >>> where = hw.bound(walk, hw.Record([0.0, 1.0, 2.0], [0.0, None, None]), [1.0], at=2)
    >>> round(where.hi, 6), round(where.excess(4.0, 0.5), 6)
    (2.5, 1.0)
    """
    from halfwidth.estimate import choose, fits

    method = Hull()
    if not isinstance(model, Linear):
        raise Refused("`bound` needs a linear model but the model is nonlinear", hint="estimate(model, record, Hull())")
    choose(model, method)
    fits(model, record)
    row = _functional(c, model.nx)
    T = len(record)
    if at is not None and not -T <= at < T:
        raise BadValue(f"`at` is {at!r}, a row from {-T} to {T - 1} was expected")
    lo, hi = outer(model, T)
    boxes = Boxes(interval_rows(model, record), lo, hi, _PROPOSERS)
    _, _, empty = _narrowed(method, boxes, record.seen)
    if empty is not None:
        run(method, model, record).check()
    wanted = range(T) if at is None else [at % T]
    found = np.array([_widened(boxes, row, k + 1) for k in wanted])
    return Bound(found[:, 0], found[:, 1]) if at is None else Bound(float(found[0, 0]), float(found[0, 1]))


def _functional(c: ArrayLike, nx: int) -> Array:
    row = np.atleast_1d(real(c, "c"))
    if row.shape != (nx,):
        raise BadShape(f"`c` has shape {row.shape}, ({nx},) was expected from the model")
    return of_size(row, nx, "c", "the model")


def _widened(boxes: Boxes, c: Array, state: int) -> tuple[float, float]:
    """Return bounds of c'x at one state from ever wider windows, until that gains nothing."""
    T, reach = boxes.rows.T, _REACH
    lo, hi = boxes.functional(max(0, state - reach), min(T, state + reach), c, state)
    while reach < max(state, T - state):
        reach *= 2
        before = hi - lo
        new = boxes.functional(max(0, state - reach), min(T, state + reach), c, state)
        lo, hi = max(lo, new[0]), min(hi, new[1])
        if before - (hi - lo) <= _GAIN * before:
            break
    return lo, hi


# ---- on line ----------------------------------------------------------------------------------------------------------


class _Live:
    """A hull fed row by row: it keeps the rows and boxes that the next window may need, nothing else."""

    def __init__(self, hull: Hull, model: Linear, t: float) -> None:
        self.hull, self.model, self.t, self.pushed = hull, model, t, 0
        self.method, self.ends = typed(hull), theta_ends(model)
        self.times: list[float] = []
        self.seen = np.zeros((0, model.ny), dtype=bool)
        lo, hi = outer(model, 1)
        self.free = lo[1:], hi[1:]
        self.lo, self.hi = lo[:1], hi[:1]
        self.rows: Rows | None = None
        self.empty: str | None = None

    def push(self, y: ArrayLike | None, u: ArrayLike | None = None, dt: float | None = None) -> Estimate:
        """Fold one row in and return the newest estimate, of `lag` rows ago."""
        model = self.model
        row, inputs, step = pushed_row(model, y, u, dt)
        t = self.t + step
        rows = self._with(row, inputs, t, step)
        self.t = t
        self.pushed += 1
        if self.empty is not None:
            return self._infeasible(self.empty)
        times, seen = [*self.times, t], np.vstack((self.seen, ~np.isnan(row)))
        lag, newest = 0 if self.hull.lag is None else int(self.hull.lag), len(times) - 1
        wanted = max(newest - lag, 0)
        start = self._starts(seen)
        boxes = Boxes(rows, np.vstack((self.lo, self.free[0])), np.vstack((self.hi, self.free[1])), _PROPOSERS)
        given = boxes.lo.copy(), boxes.hi.copy()
        done = [wanted] if self.pushed > lag else []
        a = int(start[wanted]) if done else 0
        empty = boxes.sweep([(a, newest + 1, k + 1) for k in sorted({newest, *done}, reverse=True)])[3]
        if empty is not None:
            names = (_names(model.names.x, "x", model.nx), _names(model.names.y, "y", model.ny))
            self.empty = conflict_of(rows, *given, np.array(times), empty, names).message
            return self._infeasible(self.empty)
        self.rows, self.times, self.seen, self.lo, self.hi = rows, times, seen, boxes.lo, boxes.hi
        state = wanted + 1
        box = Box(self.lo[state : state + 1].copy(), self.hi[state : state + 1].copy(), guaranteed=True)
        when = np.array([self.times[wanted]])
        info = {"rows": self.pushed, "loose": boxes.loose, "sides": boxes.asked}
        self._forget(a)
        status = Status.REDUCED if boxes.loose else Status.OK
        return Estimate(when, _middle(box), box, status, self.method, q=model.w.q, r=model.e.q,  # type: ignore[union-attr]
                        names=model.names.x, info=info)  # fmt: skip

    def bound(self, c: ArrayLike, u: ArrayLike | None = None, dt: float | None = None) -> Bound:
        """Return the guaranteed interval of c'x at the next row, before its outputs are seen."""
        row, inputs, step = pushed_row(self.model, None, u, dt)
        c = _functional(c, self.model.nx)
        if self.empty is not None:
            self._infeasible(self.empty).check()
        rows = self._with(row, inputs, self.t + step, step)
        boxes = Boxes(rows, np.vstack((self.lo, self.free[0])), np.vstack((self.hi, self.free[1])), _PROPOSERS)
        last = rows.T
        boxes.narrow(max(0, last - int(self.hull.memory or last)), last, last)
        return Bound(*boxes.functional(0, last, c, last))

    def _with(self, y: Array, u: Array | None, t: float, dt: float) -> Rows:
        """Return the rows held and a new one after them."""
        pairs = {}
        for name, matrix in self.model.matrices.items():
            if matrix.stacked and matrix.value is not None and self.pushed >= len(matrix.value):
                raise BadValue(f"`{name}` is stacked for {len(matrix.value)} rows, and so many have been pushed")
            value = matrix.at(t, dt, self.pushed)
            pairs[name] = ends_of(matrix, value if matrix.constant else value[None], self.ends.get(name))
        new = rows_of(self.model, pairs, None if u is None else u[None], y[None], ~np.isnan(y)[None])
        return new if self.rows is None else self.rows.joined(new, self.rows.T)

    def _starts(self, seen: NDArray[np.bool_]) -> NDArray[np.int32]:
        memory = int(self.hull.memory or 1)
        return window_starts(seen, memory, fixes=_FIXES, stretch=memory * _STRETCH)

    def _forget(self, a: int) -> None:
        """Drop what lies before the window: starts never move back, but for states without a bound."""
        if not (np.isfinite(self.lo[a:]).all() and np.isfinite(self.hi[a:]).all()):
            a = min(a, max(0, len(self.times) - far_back(self.model.nx)))
        if a > 0 and self.rows is not None:
            self.rows = self.rows.part(a, self.rows.T)
            self.lo, self.hi, self.seen = self.lo[a:], self.hi[a:], self.seen[a:]
            del self.times[:a]

    def _infeasible(self, message: str) -> Estimate:
        """Return the answer of a stream whose rows contradict the bounds; it stays so, since nothing is safe any more."""
        box = Box(self.lo[-1:], self.hi[-1:])
        model, x = self.model, np.nan_to_num(_middle(box))
        info = {"rows": self.pushed, "message": message, "hint": "resume a snapshot from before, and push None instead"}
        return Estimate(np.array([self.t]), x, None, Status.INFEASIBLE, self.method, q=model.w.q, r=model.e.q,  # type: ignore[union-attr]
                        names=model.names.x, info=info)  # fmt: skip

    def snapshot(self) -> bytes:
        """Return the rows and boxes held, as bytes; every number exactly."""
        arrays: dict[str, Any] = {"lo": self.lo, "hi": self.hi}
        if self.rows is not None:
            arrays |= {f.name: getattr(self.rows, f.name) for f in dataclasses.fields(self.rows)}
        held = {name: None if v is None else [list(v.shape), [n.hex() for n in v.ravel().tolist()]] for name, v in arrays.items()}
        plain = {
            "t": self.t.hex(), "pushed": self.pushed, "times": [v.hex() for v in self.times], "empty": self.empty,
            "seen": self.seen.astype(int).tolist(), "arrays": held,
        }  # fmt: skip
        return json.dumps(plain).encode()

    def restore(self, saved: bytes) -> None:
        """Take up the rows and boxes of a snapshot."""
        plain = json.loads(saved)
        self.t, self.pushed, self.empty = float.fromhex(plain["t"]), int(plain["pushed"]), plain["empty"]
        self.times = [float.fromhex(v) for v in plain["times"]]
        self.seen = np.array(plain["seen"], dtype=bool).reshape(len(self.times), self.model.ny)
        arrays = {
            name: None if v is None else np.array([float.fromhex(n) for n in v[1]]).reshape(v[0])
            for name, v in plain["arrays"].items()
        }
        self.lo, self.hi = arrays.pop("lo"), arrays.pop("hi")
        self.rows = Rows(**arrays) if arrays else None
        if self.lo.shape != (len(self.times) + 1, self.model.nx) or self.hi.shape != self.lo.shape:
            raise ValueError("its boxes do not fit the model")




__all__ = ["Bound", "Hull", "bound"]
