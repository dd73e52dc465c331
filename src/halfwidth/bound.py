"""Guaranteed intervals of functionals c'x: where an output must lie, and whether a value can be at all.

The window of a state and the boxes around it are those of `Hull`; the functional is one more program over them. A value
outside its interval contradicts the bounds or the data, and `Bound.excess` says by how much: a fix that cannot be.
"""

import numpy as np
from numpy.typing import ArrayLike

from halfwidth.array import Array
from halfwidth.errors import BadValue, Refused
from halfwidth.estimate import choose, fits
from halfwidth.methods._bounds import interval_rows
from halfwidth.methods._boxes import Boxes
from halfwidth.methods._functional import Bound, functional_of
from halfwidth.methods.hull import GAIN, PROPOSERS, REACH, Hull, narrowed, outer, run
from halfwidth.model import Linear
from halfwidth.record import Record


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
    method = Hull()
    if not isinstance(model, Linear):
        raise Refused("`bound` needs a linear model but the model is nonlinear", hint="estimate(model, record, Hull())")
    choose(model, method)
    fits(model, record)
    row = functional_of(c, model.nx)
    T = len(record)
    if at is not None and not -T <= at < T:
        raise BadValue(f"`at` is {at!r}, a row from {-T} to {T - 1} was expected")
    lo, hi = outer(model, T)
    boxes = Boxes(interval_rows(model, record), lo, hi, PROPOSERS)
    _, _, empty = narrowed(method, boxes, record.seen)
    if empty is not None:
        run(method, model, record).check()
    wanted = range(T) if at is None else [at % T]
    found = np.array([_widened(boxes, row, k + 1) for k in wanted])
    return Bound(found[:, 0], found[:, 1]) if at is None else Bound(float(found[0, 0]), float(found[0, 1]))


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
