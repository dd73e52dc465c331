"""Which model? Evidence beside a score that hides outputs: memory, noise kinds, fix-error models.

The evidence of a model integrates over all that is unknown and so charges for what it adds; the left-out score asks
how well hidden outputs are foretold. Where they disagree the model is wrong in a way the data can see.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from halfwidth.array import Array, generator, wrapped
from halfwidth.errors import BadValue, Refused, hinted
from halfwidth.methods._along import outputs_along
from halfwidth.methods._linearised import filled
from halfwidth.methods._noise_parts import gaussian_part, uniform_part
from halfwidth.methods._protocol import Estimator
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.record import Record
from halfwidth.result import Estimate, Status


@dataclass(frozen=True, eq=False)
class Comparison:
    """Candidates side by side.

    Parameters
    ----------
    names : tuple of str
    loglik : (k,) array
        Log evidence; NaN where a method gives none or the estimate is not good.
    score : (k,) array
        Mean log predictive density of the left-out outputs, higher is better.
    error : (k,) array
        Mean absolute error of the same, in units of each output's own scale.
    statuses : tuple of Status
    best : str
        Highest evidence.
    foretells : str
        Highest score.
    """

    names: tuple[str, ...]
    loglik: Array
    score: Array
    error: Array
    statuses: tuple[Status, ...]
    best: str
    foretells: str

    def __str__(self) -> str:
        width = max(len(n) for n in self.names)
        lines = [f"{'':<{width}}  log evidence  left-out score  left-out error"]
        lines += [
            f"{n:<{width}}  {a:12.2f}  {b:14.3f}  {c:14.3f}"
            for n, a, b, c in zip(self.names, self.loglik, self.score, self.error, strict=True)
        ]
        return "\n".join(lines)


def compare(
    models: Mapping[str, Model],
    record: Record,
    method: Estimator | None = None,
    *,
    left_out: float = 0.2,
    folds: int = 3,
    seed: int | None = None,
) -> Comparison:
    """Compare models of one record by evidence and by how well they foretell outputs that they do not see.

    Parameters
    ----------
    models : mapping of name to Linear or Nonlinear
        With the same outputs.
    record : Record
    method : estimator, optional
        ``Posterior()`` if absent.
    left_out : float
        Share of the seen outputs that is hidden in each fold.
    folds : int
    seed : int, optional

    Raises
    ------
    BadValue
        If there is no model, one is none, or a setting is out of its domain.
    Refused
        If the method cannot work on one of the models.

    Examples
    --------
    >>> import halfwidth as hw
    >>> box = hw.Uniform.unknown(at_most=10.0)
    >>> still = hw.Linear([[1]], None, [[1]], hw.Uniform(0.0), box, hw.Box(-5, 5))
    >>> moving = hw.Linear([[1]], None, [[1]], box, box, hw.Box(-5, 5))
    >>> true = hw.Linear([[1]], None, [[1]], hw.Uniform(1), hw.Uniform(0.2), hw.Box(0, 0))
    >>> _, record = hw.simulate(true, T=40, seed=1)
    >>> hw.compare({"still": still, "moving": moving}, record, seed=1).best
    'moving'
    """
    if not models:
        raise BadValue("`models` is empty, at least one named model was expected")
    if not isinstance(models, Mapping):
        raise BadValue(f"`models` is a {type(models).__name__}, models by name were expected", hint='{"still": model}')
    for name, model in models.items():
        if not isinstance(model, Linear | Nonlinear):
            raise BadValue(f"`models` has {model!r} under {name!r}, a Linear or Nonlinear was expected")
    if not 0 < left_out < 1 or folds < 1:
        raise BadValue(f"`left_out` is {left_out!r} and `folds` {folds!r}: a share below 1 and a positive number")
    from halfwidth.methods.posterior import Posterior

    method = Posterior() if method is None else method
    for name, model in models.items():
        reason = method.refuses(model)
        if reason is not None:
            message, hint = hinted(reason)
            raise Refused(f"the model {name!r}: {message}", hint=hint)
    rng = generator(seed)
    hidden = [record.seen & (rng.random(record.y.shape) < left_out) for _ in range(folds)]
    unit = np.nanstd(record.y, axis=0)
    unit = np.where(unit > 0, unit, 1.0)
    loglik, score, error, statuses = [], [], [], []
    for model in models.values():
        whole = method.run(model, record, seed=seed)
        statuses.append(whole.status)
        loglik.append(math.nan if whole.loglik is None or not whole.status.good else whole.loglik)
        log_p, off = [], []
        for mask in hidden:
            part = Record(record.t, np.where(mask, np.nan, record.y), record.u)
            est = method.run(model, part, seed=seed)
            if not est.status.good or est.P is None or not mask.any():
                continue
            mean, S = foretold(model, est, part)
            d = wrapped(record.y - mean, getattr(model, "y_angles", ()))[mask]
            v = np.diagonal(S, axis1=1, axis2=2)[mask]
            log_p.append(-0.5 * (np.log(2 * np.pi * v) + d**2 / v))
            off.append(np.abs(d) / np.broadcast_to(unit, mask.shape)[mask])
        score.append(float(np.mean(np.concatenate(log_p))) if log_p else math.nan)
        error.append(float(np.mean(np.concatenate(off))) if off else math.nan)
    names = tuple(models)
    a, b = np.array(loglik), np.array(score)
    return Comparison(names, a, b, np.array(error), tuple(statuses), names[_top(a)], names[_top(b)])


def _top(values: Array) -> int:
    return int(np.argmax(np.where(np.isnan(values), -np.inf, values)))


def foretold(model: Model, est: Estimate, record: Record) -> tuple[Array, Array]:
    """Return mean (T, ny) and covariance (T, ny, ny) of every output, seen or not.

    The half-widths of the output noise count as variances r^2 / 3, unknown ones and unknown entries as estimated. A
    nonlinear `h` is that of the mean state, with its slope there.
    """
    dt = record.steps(model.dt)
    if isinstance(model, Nonlinear):
        mean, C = outputs_along(model, est.x)
    else:
        if model.theta_entries and est.theta is not None:
            model = filled(model, est.theta)
        C = model.C.each(record.t, dt)
        mean = np.einsum("tij,tj->ti", C, est.x)
    R = np.zeros((len(record), model.ny, model.ny))
    box, part = uniform_part(model.e), gaussian_part(model.e)
    if box is not None:
        R = R + np.diag((box.q if box.known else np.asarray(est.r)) ** 2 / 3.0)
    if part is not None and not part.known:
        R = R + np.diag(np.asarray(est.R))
    elif part is not None:
        R = R + part.cov().each(record.t, dt)
    var = C @ np.asarray(est.P) @ np.swapaxes(C, 1, 2) + R
    if isinstance(model, Linear) and model.F is not None:
        back = np.linalg.inv(model.F.each(record.t, dt))
        mean = np.einsum("tij,tj->ti", back, mean)
        var = back @ var @ np.swapaxes(back, -1, -2)
    return mean, var
