"""Guaranteed intervals of functionals c'x: where an output must lie, and whether a value can be at all.

The window of a state and the boxes around it are those of `Hull`; the functional is one more program over them. A value
outside its interval contradicts the bounds or the data, and `Bound.excess` says by how much: a fix that cannot be.

With `reach` only rows nearby count. The boxes of all states are then not sought first, and the functionals of
neighbouring rows share one window: much less work, for intervals that are guaranteed too and mostly as narrow.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.array import Array
from halfwidth.errors import BadValue, Refused, Unsolved
from halfwidth.estimate import choose, fits
from halfwidth.methods._bounds import interval_rows
from halfwidth.methods._boxes import LOOSE, Boxes, Empty, Question, bounded
from halfwidth.methods._conflict import conflict_of
from halfwidth.methods._functional import Bound, functional_of, functionals_of
from halfwidth.methods.hull import GAIN, PROPOSERS, REACH, Hull, names_of, narrowed, outer, run
from halfwidth.model import Linear
from halfwidth.record import Record

#: Rows from the first to the last state that share a window, at most.
_TOGETHER = 24


def bound(
    model: Linear,
    record: Record,
    c: ArrayLike,
    *,
    at: int | Sequence[int] | NDArray[np.integer] | None = None,
    reach: int | None = None,
) -> Bound:
    """Return the guaranteed interval of c'x[t] from the rows of a record.

    Parameters
    ----------
    model : Linear
        One that `Hull` takes.
    record : Record
    c : (nx,) or (n, nx) array_like
        The functional, such as a row of C for an output, or the difference of two states; or one for each row of `at`.
    at : int or (n,) sequence of int, optional
        Rows of the record, -1 for the last; all rows if absent. A row may be there more than once.
    reach : int, optional
        Rows with an output that count on each side of a row, and all between them. All rows if absent.

    Returns
    -------
    Bound
        Of floats where `at` is one row, else of (n,) arrays.

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
    method = Hull()
    if not isinstance(model, Linear):
        raise Refused("`bound` needs a linear model but the model is nonlinear", hint="estimate(model, record, Hull())")
    choose(model, method)
    fits(model, record)
    T = len(record)
    wanted = np.arange(T) if at is None else np.atleast_1d(np.asarray(at))
    if wanted.ndim != 1 or not np.issubdtype(wanted.dtype, np.integer) or not ((wanted >= -T) & (wanted < T)).all():
        raise BadValue(f"`at` is {at!r}, rows from {-T} to {T - 1} were expected")
    single = functional_of(c, model.nx) if np.ndim(c) < 2 else None
    rows = (
        functionals_of(c, wanted.size, model.nx) if single is None else np.broadcast_to(single, (wanted.size, model.nx))
    )
    wanted = wanted % T
    lo, hi = outer(model, T)
    boxes = Boxes(interval_rows(model, record), lo.copy(), hi.copy(), PROPOSERS)
    if reach is not None:
        if not isinstance(reach, int | np.integer) or reach < 1:
            raise BadValue(f"`reach` is {reach!r}, a positive whole number of rows or None was expected")
        found = _near(boxes, rows, wanted + 1, record, int(reach))
        if isinstance(found, Empty):
            names = (
                names_of(model.names.x, "x", model.nx),
                names_of(record.labels.outputs or model.names.y, "y", model.ny),
            )
            raise Unsolved(f"Status.INFEASIBLE: {conflict_of(boxes.rows, lo, hi, record.t, found, names).message}")
    else:
        _, _, empty = narrowed(method, boxes, record.seen)
        if empty is not None:
            run(method, model, record).check()
        found = np.array([_widened(boxes, row, k + 1) for row, k in zip(rows, wanted.tolist(), strict=True)])
    if at is not None and np.ndim(at) == 0:
        return Bound(float(found[0, 0]), float(found[0, 1]))
    return Bound(found[:, 0], found[:, 1])


def _near(boxes: Boxes, c: Array, states: NDArray[np.integer], record: Record, reach: int) -> Array | Empty:
    """Return bounds (n, 2) of c'x (n, nx) at n states from the rows around them, or the proof that there is none."""
    T, nx = boxes.rows.T, boxes.rows.nx
    empty = boxes.finite(0, T)
    if empty is not None:
        return empty
    known = np.flatnonzero(record.seen.any(axis=1))
    order = np.argsort(states, kind="stable")
    found = np.empty((states.size, 2))
    while order.size:
        first = int(states[order[0]])
        some = order[: int(np.searchsorted(states[order], first + _TOGETHER))]
        order, last = order[some.size :], int(states[some[-1]])
        # row k leads to state k + 1
        before, after = int(np.searchsorted(known, first)), int(np.searchsorted(known, last))
        a = int(known[before - reach]) if before >= reach else 0
        b = int(known[after + reach - 1]) + 1 if after + reach <= known.size else T
        # the rows after the last state without a box still hold; of that state itself they know nothing
        lost = np.flatnonzero(~(np.isfinite(boxes.lo[a : b + 1]) & np.isfinite(boxes.hi[a : b + 1])).all(axis=1)) + a
        rows, low, high = boxes.rows.part(a, b), boxes.lo[a : b + 1], boxes.hi[a : b + 1]
        if lost.size:
            a = int(lost[-1])
            found[some] = -np.inf, np.inf
            some = some[states[some] > a]
            if not some.size:
                continue
            rows, low, high = (
                boxes.rows.part(a, b).without_dynamics(0),
                boxes.lo[a : b + 1].copy(),
                boxes.hi[a : b + 1].copy(),
            )
            low[0] = high[0] = 0.0
        k = np.tile(states[some] - a, 2).astype(np.int32)
        ask = Question(rows, low, high, np.vstack((c[some], -c[some])), k)
        best, _, value, low, high, bad = bounded(ask, boxes.proposers[0], contract=True)
        if bad:
            return Empty(a, b, None, a * (nx + boxes.rows.ny) + bad - 1)
        upper, lower = best[: some.size], -best[some.size :]
        if (lower > upper).any():
            return Empty(a, b, None, None)
        found[some] = np.column_stack((lower, upper))
        if lost.size:
            continue
        boxes.lo[a : b + 1], boxes.hi[a : b + 1] = low, high
        loose = ~(np.abs(best - value) <= LOOSE * np.tile(upper - lower, 2) + 1e-13 * np.abs(best))
        for j in np.flatnonzero(loose[: some.size] | loose[some.size :]).tolist():
            one = boxes.functional(a, b, c[some[j]], int(states[some[j]]))
            found[some[j]] = max(lower[j], one[0]), min(upper[j], one[1])
    return found


def _widened(boxes: Boxes, c: Array, state: int) -> tuple[float, float]:
    """Return bounds of c'x at one state from ever wider windows, until that gains nothing."""
    T, reach = boxes.rows.T, REACH
    lo, hi = boxes.functional(max(0, state - reach), min(T, state + reach), c, state)
    while reach < max(state, T - state):
        reach *= 2
        before = hi - lo
        new = boxes.functional(max(0, state - reach), min(T, state + reach), c, state)
        lo, hi = max(lo, new[0]), min(hi, new[1])
        if before - (hi - lo) <= GAIN * before:
            break
    return lo, hi
