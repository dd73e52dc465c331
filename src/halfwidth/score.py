"""Compare estimates with a known truth, over a whole record or inside its gaps."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.array import real
from halfwidth.errors import BadShape, BadValue
from halfwidth.record import Gap
from halfwidth.result import Estimate


@dataclass(frozen=True)
class Row:
    """Scores of one estimate, in the units of the states.

    Parameters
    ----------
    method : str
    max_error, rmse, mean_error : float
        Of the distance between estimate and truth over the chosen states.
    inside : float or None
        Share of entries inside the interval.
    mean_width, widest : float or None
        Width ``hi - lo`` of the interval.
    guaranteed : bool
    level : float
    """

    method: str
    max_error: float
    rmse: float
    mean_error: float
    inside: float | None
    mean_width: float | None
    widest: float | None
    guaranteed: bool
    level: float


@dataclass(frozen=True)
class Score:
    """Scores of several estimates side by side; prints as a table."""

    rows: tuple[Row, ...]

    def __getitem__(self, k: int) -> Row:
        return self.rows[k]

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        name = max([len(r.method) for r in self.rows] + [6])
        lines = [f"{'':{name}}  {'max error':>10}  {'rmse':>10}  {'inside':>8}  {'widest':>10}   level"]
        for r in self.rows:
            inside = "-" if r.inside is None else f"{100 * r.inside:.3g} %"
            widest = "-" if r.widest is None else f"{r.widest:.3g}"
            kind = "" if r.inside is None else "guaranteed" if r.guaranteed else f"{100 * r.level:g} %"
            lines.append(
                f"{r.method:{name}}  {r.max_error:>10.3g}  {r.rmse:>10.3g}  {inside:>8}  {widest:>10}   {kind}".rstrip()
            )
        return "\n".join(lines)


def score(
    estimates: Estimate | Sequence[Estimate],
    truth: ArrayLike | Any,
    during: Gap | tuple[float, float] | None = None,
    *,
    states: Sequence[int] | None = None,
    level: float = 0.9,
) -> Score:
    """Compare estimates with the truth.

    Parameters
    ----------
    estimates : Estimate or sequence of Estimates
    truth : (T, nx) array_like or Truth
    during : Gap or (t0, t1), optional
        Only rows of these times, s.
    states : sequence of int, optional
        Only these states; the error is the Euclidean distance over them.
    level : float
        Level of the interval that is judged.

    Returns
    -------
    Score

    Raises
    ------
    BadShape
        If the truth does not have the rows and states of an estimate.
    BadValue
        If no row lies in `during`, it is no span, or `states` are not those of the model.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Gaussian(0.1), hw.Gaussian(1.0), hw.Normal([0.0], 1.0))
    >>> truth, record = hw.simulate(walk, T=50, seed=1)
    >>> hw.score(hw.estimate(walk, record), truth)[0].rmse < 1.0
    True
    """
    several = [estimates] if isinstance(estimates, Estimate) else list(estimates)
    x = real(np.asarray(truth), "truth")
    return Score(tuple(_row(one, x, during, states, level) for one in several))


def _row(
    estimate: Estimate,
    x: NDArray[np.float64],
    during: Gap | tuple[float, float] | None,
    states: Sequence[int] | None,
    level: float,
) -> Row:
    if x.shape != estimate.x.shape:
        raise BadShape(f"`truth` has shape {x.shape}, {estimate.x.shape} was expected from the estimate")
    rows = np.ones(len(x), dtype=bool)
    if during is not None:
        if np.size(during) < 2:
            raise BadValue(f"`during` is {during!r}, two times in seconds were expected", hint="record.gaps()[0]")
        rows = (estimate.t >= during[0]) & (estimate.t <= during[1])
        if not rows.any():
            raise BadValue(f"no row lies between {during[0]:g} s and {during[1]:g} s")
    columns = np.arange(x.shape[1]) if states is None else np.asarray(states)
    if columns.ndim != 1 or not columns.size or not np.isin(columns, np.arange(-x.shape[1], x.shape[1])).all():
        raise BadValue(f"`states` is {states!r}, numbers of states from 0 to {x.shape[1] - 1} were expected")
    part = np.ix_(rows, columns)
    error = np.linalg.norm(estimate.x[part] - x[part], axis=1)
    inside = width = widest = None
    if estimate.spread is not None:
        lo, hi = estimate.interval(level)
        inside = float(np.mean((lo[part] <= x[part]) & (x[part] <= hi[part])))
        width, widest = float(np.mean(hi[part] - lo[part])), float(np.max(hi[part] - lo[part]))
    return Row(
        estimate.method,
        float(error.max()),
        float(np.sqrt(np.mean(error**2))),
        float(error.mean()),
        inside,
        width,
        widest,
        estimate.guaranteed,
        level,
    )
