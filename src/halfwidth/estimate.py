"""The front door: match a record to a model, choose a method, run it."""

import warnings
from collections.abc import Sequence
from typing import Any, overload

import numpy as np

from halfwidth import methods
from halfwidth.errors import BadRecord, BadShape, BadValue, DataQualityWarning, Refused, hinted
from halfwidth.methods._protocol import Estimator
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.record import Record
from halfwidth.result import Estimate

#: Methods tried in this order when none is given; the first that does not refuse the model runs.
DEFAULTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("KalmanSmoother", {}),
    ("Hull", {}),
    ("UnscentedKalman", {"smooth": True}),
    ("GPB", {"depth": 5, "smooth": True}),
    ("MixedFilter", {}),
    ("Posterior", {}),
    ("BatchLP", {}),
    ("ParticleFilter", {}),
)


@overload
def estimate(model: Model, record: Record, method: Estimator | None = None, *, seed: int | None = None) -> Estimate: ...
@overload
def estimate(
    model: Model,
    record: Sequence[Record],
    method: Estimator | None = None,
    *,
    seed: int | None = None,
) -> list[Estimate]: ...
def estimate(
    model: Model,
    record: Record | Sequence[Record],
    method: Estimator | None = None,
    *,
    seed: int | None = None,
) -> Estimate | list[Estimate]:
    """Estimate the states of a record.

    Parameters
    ----------
    model : Linear or Nonlinear
    record : Record or sequence of Records
        A sequence is estimated side by side, on all cores where the method can.
    method : estimator, optional
        Such as ``KalmanSmoother()``; chosen from the model if absent.
    seed : int, optional
        Seed of a method that draws random numbers; kept in ``info["seed"]``.

    Returns
    -------
    Estimate, or a list of them for a sequence of records

    Raises
    ------
    BadShape, BadRecord
        If the record does not fit the model.
    Refused
        If the method cannot work on this model.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Gaussian(0.1), hw.Gaussian(1.0), hw.Normal([0.0], 1.0))
    >>> hw.estimate(walk, hw.Record([0.0, 1.0, 2.0], [0.1, None, 0.3])).status
    <Status.OK: 'solved'>
    """
    if not isinstance(model, Linear | Nonlinear):
        raise BadValue(f"`model` is {model!r}, Linear(...) or Nonlinear(...) was expected")
    if isinstance(record, Record):
        fits(model, record)
        return choose(model, method).run(model, record, seed=seed)
    if not isinstance(record, Sequence) or not all(isinstance(r, Record) for r in record):
        raise BadRecord(
            f"`record` is a {type(record).__name__}, a Record or a sequence of Records was expected",
            hint="Record(t, y), or Record.from_frame(frame, time=..., outputs=...)",
        )
    for one in record:
        fits(model, one)
    chosen = choose(model, method)
    run_many = getattr(chosen, "run_many", None)
    if run_many is not None:
        return list(run_many(model, record))
    return [chosen.run(model, one, seed=seed) for one in record]


def choose(model: Model, method: Estimator | None) -> Estimator:
    """Return the given method if it takes the model, or the first default that does.

    Raises
    ------
    Refused
        With the reason, and what to type instead.
    """
    if method is not None:
        if isinstance(method, type) or not isinstance(method, Estimator):
            raise BadValue(
                f"`method` is {method!r}, an estimator such as KalmanSmoother() was expected",
                hint=f"{method.__name__}()" if isinstance(method, type) else "leave it away",
            )
        reason = method.refuses(model)
        if reason is not None:
            message, hint = hinted(reason)
            raise Refused(message, hint=hint)
        return method
    reasons = []
    for name, settings in DEFAULTS:
        candidate: Estimator = methods.load(name)(**settings)
        reason = candidate.refuses(model)
        if reason is None:
            return candidate
        reasons.append(reason)
    message, hint = hinted(reasons[0]) if reasons else ("no estimator is installed", None)
    raise Refused(f"no default method takes this model; {message}", hint=hint)


def fits(model: Model, record: Record) -> None:
    """Check that a record has the columns and rows that a model expects.

    Raises
    ------
    BadShape
    """
    if record.ny != model.ny:
        of = f"`model.C` is {model.C.shape}" if isinstance(model, Linear) else "`model.h` returns as many"
        raise BadShape(f"`record.y` has {record.ny} columns but {of}, so {model.ny} outputs are expected")
    if record.nu != model.nu:
        of = "`model.B`" if isinstance(model, Linear) else "`model.nu`"
        raise BadShape(
            f"`record.u` has {record.nu} columns but {of} expects {model.nu} inputs",
            hint="Record(t, y, u)" if model.nu else "Record(t, y)",
        )
    if isinstance(model, Linear):
        for name, matrix in model.matrices.items():
            if matrix.value is not None and matrix.value.ndim == 3 and len(matrix.value) != len(record):
                raise BadShape(f"`{name}` is stacked for {len(matrix.value)} rows but the record has {len(record)}")
        _steps(model, record)


def _steps(model: Linear, record: Record) -> None:
    """Warn where every row counts as one step but the steps differ."""
    if len(record) < 3 or not model.A.constant:
        return
    step = np.diff(record.t)
    lo, hi = float(step.min()), float(step.max())
    # the median is not below the least step, so it is needed only where that one would warn
    if hi - lo > 0.5 * lo and hi - lo > 0.5 * float(np.median(step)):
        warnings.warn(
            f"time steps run from {lo:.3g} to {hi:.3g} s but `A` is constant, so each row counts"
            " as one step; give `A` (and the noise) as a function of dt, or insert the missing rows",
            DataQualityWarning,
            stacklevel=3,
        )
