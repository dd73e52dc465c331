"""Forecasts: the estimate of rows that are still missing.

A record is extended by rows without outputs; whatever estimates the states of a gap estimates those rows too.
"""

from typing import Any

from numpy.typing import ArrayLike

from halfwidth.errors import BadValue
from halfwidth.estimate import estimate
from halfwidth.methods.choose import foretold
from halfwidth.model import Linear, Model
from halfwidth.record import Record
from halfwidth.result import Estimate
from halfwidth.spread import part


def forecast(
    model: Model,
    record: Record,
    steps: int,
    *,
    u: ArrayLike | None = None,
    dt: float | None = None,
    method: Any = None,
) -> Estimate:
    """Estimate the states and the outputs of the rows after a record.

    Parameters
    ----------
    model : Linear or Nonlinear
    record : Record
    steps : int
        Number of rows ahead.
    u : (steps, nu) array_like, optional
        Inputs of those rows; needed if the model has inputs.
    dt : float, optional
        Step between them, s; the median step of the record if absent.
    method : estimator, optional
        As in `estimate`.

    Returns
    -------
    Estimate
        Of the new rows only; ``info["y"]`` (steps, ny) and ``info["S"]`` (steps, ny, ny) are mean and covariance of
        their outputs where the spread has a covariance; a nonlinear output is that of the mean state.

    Raises
    ------
    BadValue, BadRecord
        If `steps` is no whole number from 1 or inputs are absent.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0.0], 1.0))
    >>> ahead = hw.forecast(walk, hw.Record([0.0, 1.0], [1.0, 2.0]), 2)
    >>> ahead.P.ravel().round(3), ahead.info["S"].ravel().round(3)
    (array([1.625, 2.625]), array([2.625, 3.625]))
    """
    stacked = [name for name, m in model.matrices.items() if m.stacked] if isinstance(model, Linear) else []
    if stacked:
        raise BadValue(
            f"`{stacked[0]}` is stacked row by row, so nothing is known of it beyond the record",
            hint=f"give `{stacked[0]}` as a function of t",
        )
    longer = record.extended(steps, dt=dt, u=u)
    est = estimate(model, longer, method)
    s = slice(len(record), len(longer))
    info: dict[str, Any] = {"message": est.message, "n_seen": int(record.seen.sum())}
    if est.P is not None and est.status.good:
        y, S = foretold(model, est, longer)
        info |= {"y": y[s], "S": S[s]}
    return Estimate(
        est.t[s],
        est.x[s],
        part(est.spread, s),
        est.status,
        est.method,
        q=est.q,
        r=est.r,
        Q=est.Q,
        R=est.R,
        theta=est.theta,
        loglik=est.loglik,
        names=est.names,
        labels=longer.labels,
        info=info,
    )
