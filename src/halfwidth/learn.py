"""Learning a model from records with gaps: noise covariances Q, R, unknown entries of A, B, C, and the mean of x0.

What is asked is checked here; the likelihood and the searches for its top stand in `halfwidth.methods._likelihood`.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from halfwidth.errors import BadRecord, BadValue, Refused, hinted
from halfwidth.estimate import fits
from halfwidth.methods._likelihood import Learned, Problem
from halfwidth.methods.kalman import not_gaussian
from halfwidth.model import Linear, Model
from halfwidth.record import Record

STRUCTURES = ("full", "diagonal", "scaled")
PARTS = ("Q", "R", "A", "B", "C", "theta", "x0")


def learn(
    model: Model,
    record: Record | Sequence[Record],
    *,
    what: Sequence[str] = ("Q", "R"),
    structure: Mapping[str, str] | None = None,
    method: str = "em",
    iterations: int = 500,
    tolerance: float = 1e-8,
) -> Learned:
    """Learn parts of a linear Gaussian model from one or several records.

    Parameters
    ----------
    model : Linear
        Gaussian noise; the values of what is to be learned are where the search starts.
    record : Record or sequence of Records
    what : sequence of str
        Some of ``"Q"``, ``"R"`` (covariances of w and e), ``"A"``, ``"B"``, ``"C"`` (whole constant matrices),
        ``"theta"`` (their NaN entries, within ``model.theta_bounds``) and ``"x0"`` (the mean of the prior).
    structure : mapping, optional
        For the keys Q and R one of ``"full"``, ``"diagonal"`` and ``"scaled"`` (a multiple of what the model gives,
        which may then vary with time or step); full if absent, scaled for a covariance that varies.
    method : {"em", "ml"}
        Expectation maximisation, or maximum likelihood (Q and R only), which needs fewer passes near the optimum.
    iterations : int
        At most so many.
    tolerance : float
        Converged when an iteration gains less than this share of the log-likelihood.

    Returns
    -------
    Learned

    Raises
    ------
    Refused
        If the model is not linear and Gaussian.
    BadValue, BadRecord
        If an argument cannot be used or nothing was seen.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Gaussian(1.0), hw.Gaussian(4.0), hw.Normal([0.0], 1.0))
    >>> _, record = hw.simulate(walk, T=5000, seed=1)
    >>> guess = hw.Linear([[1]], None, [[1]], hw.Gaussian(0.1), hw.Gaussian(0.1), walk.x0)
    >>> hw.learn(guess, record).check().model.e.cov().single.round(0)
    array([[4.]])
    """
    records = list(record) if isinstance(record, Iterable) else [record]
    if not records or not all(isinstance(r, Record) for r in records):
        raise BadRecord("`record` holds no Record, one or several were expected")
    what = (what,) if isinstance(what, str) else tuple(what)
    if not what or any(part not in PARTS for part in what):
        raise BadValue(f"`what` is {what!r}, some of {', '.join(PARTS)} were expected")
    if method not in ("em", "ml"):
        raise BadValue(f"`method` is {method!r}, 'em' or 'ml' was expected")
    if not isinstance(iterations, int) or iterations < 1:
        raise BadValue(f"`iterations` is {iterations!r}, a whole number from 1 was expected")
    if not tolerance > 0:
        raise BadValue(f"`tolerance` is {tolerance!r}, a positive number was expected")
    if not isinstance(model, Linear):
        raise Refused("`learn` needs a linear model but this one is `Nonlinear`", hint="SequentialLP(...)")
    free = _free(model, what)
    start = _started(model, free)
    reason = not_gaussian(start, "learn")
    if reason is not None:
        message, hint = hinted(reason)
        raise Refused(message, hint=hint)
    for one in records:
        fits(start, one)
    if not any(one.seen.any() for one in records):
        raise BadRecord("no output of `record` was seen, so there is nothing to learn from")
    problem = Problem(model, start, records, what, free, _structures(start, what, free, structure))
    if method == "em":
        return problem.em(iterations, tolerance)
    if set(what) - {"Q", "R"}:
        raise BadValue(f"`method` is 'ml' but `what` is {what!r}, only Q and R were expected", hint="method='em'")
    return problem.ml(iterations, tolerance)


def _free(model: Linear, what: Sequence[str]) -> dict[str, Any]:
    """Return the mask of the entries to learn of each matrix that has some."""
    free = {}
    for name, matrix in model.matrices.items():
        unknown = np.zeros(matrix.shape, dtype=bool)
        if matrix.value is not None and matrix.value.ndim == 2:
            unknown = np.isnan(matrix.value)
        whole = name in what
        if name in ("E", "F") and unknown.any():
            raise Refused(f"`learn` cannot find unknown entries of `{name}`", hint="give its entries")
        if unknown.any() and not whole and "theta" not in what:
            raise BadValue(
                f"`{name}` has unknown entries (NaN) but `what` is {tuple(what)!r}", hint='what=("Q", "R", "theta")'
            )
        if whole and not matrix.constant:
            raise BadValue(f"`{name}` varies with time, only a constant matrix can be learned")
        if whole or unknown.any():
            free[name] = np.ones(matrix.shape, dtype=bool) if whole else unknown
    if "theta" in what and not model.theta_entries:
        raise BadValue("`what` holds 'theta' but no entry of the model is unknown (NaN)")
    if "B" in what and model.B is None:
        raise BadValue("`what` holds 'B' but the model has no inputs")
    return free


def _started(model: Linear, free: Mapping[str, Any]) -> Linear:
    """Return the model with unknown entries at the middle of their bounds, 0 without bounds."""
    if not model.theta_entries:
        return model
    middle = np.zeros(len(model.theta_entries)) if model.theta_bounds is None else model.theta_bounds.mean
    new: dict[str, Any] = {name: model.matrices[name].single.copy() for name in free}
    for entry, value in zip(model.theta_entries, middle, strict=True):
        new[entry.matrix][entry.row, entry.column] = value
    return dataclasses.replace(model, **new, theta_bounds=None)


def _structures(
    model: Linear, what: Sequence[str], free: Mapping[str, Any], given: Mapping[str, str] | None
) -> dict[str, str]:
    given = dict(given or {})
    found = {}
    for name, noise in (("Q", model.w), ("R", model.e)):
        constant = noise.cov().constant
        kind = given.pop(name, "full" if constant else "scaled")
        if kind not in STRUCTURES:
            raise BadValue(f"`structure` of {name} is {kind!r}, one of {', '.join(STRUCTURES)} was expected")
        if name in what and kind != "scaled" and not constant:
            raise BadValue(
                f"`structure` of {name} is {kind!r} but {name} varies with time",
                hint=f'structure={{"{name}": "scaled"}}',
            )
        found[name] = kind
    if given:
        raise BadValue(f"`structure` has the keys {sorted(given)}, Q and R were expected")
    for name, noise, parts in (("Q", model.w, "AB"), ("R", model.e, "C")):
        if set(parts) & set(free) and not noise.cov().constant:
            raise Refused(
                f"`learn` cannot learn {', '.join(sorted(set(parts) & set(free)))} while {name} varies with time"
            )
    for name, matrix in (("Q", model.E), ("R", model.F)):
        if name in what and matrix is not None and not matrix.constant:
            raise Refused(f"`learn` cannot learn {name} while `{matrix.name}` varies with time")
    return found
