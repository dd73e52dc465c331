"""The posterior of a nonlinear model: linearise along the trajectory, solve, and again until it stays.

At a fixed point the mean is that of the model linearised at the mean itself, as in an iterated Kalman smoother; noise
keeps its own shape throughout. A long step is halved until the path is no worse by the noise that was found with it.
Where nodes lie depends a little on where they began, so that rounds of small steps could go in circles: they begin
where the second one did.

References
----------
Bell (1994), The iterated Kalman smoother as a Gauss-Newton method, SIAM Journal on Optimization 4(3). Skoglund, Hendeby
and Axehill (2015), Extended Kalman filter modifications based on an optimization view point, Fusion: the line search.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from halfwidth.array import Array
from halfwidth.methods._along import linearised, misfit, squares
from halfwidth.methods._first_path import LEAST, first_path
from halfwidth.methods._noise_parts import gaussian_part
from halfwidth.model import Linear, Nonlinear
from halfwidth.record import Record
from halfwidth.result import Estimate, Status

if TYPE_CHECKING:
    from halfwidth.methods._answer import Answer
    from halfwidth.methods._carry import Known, Start
    from halfwidth.methods.posterior import Posterior

#: A step below this share of the standard deviations ends the iteration, and one below the second is good enough.
_CLOSE, _USABLE = 1e-3, 0.1
#: Shares of a step that are tried.
_SHARES = (1.0, 0.5, 0.25, 0.125)
#: Rounds after which half-widths and nodes begin where they began before.
_SETTLED = 2
#: Rounds after which a step is half of what is asked for: what still moves then goes to and fro.
_PATIENT = 6


def relinearised(
    method: "Posterior", model: Nonlinear, record: Record, *, s: Array | None = None, known: "Known | None" = None,
    path: Array | None = None,
) -> "Answer":  # fmt: skip
    """Estimate the states of one record of a nonlinear model.

    `s` and `known` are as in `Posterior.answer`; `path` (T + 1, nx), x0 first, is one that may be near.
    """
    X, scale = first_path(model, record, path)
    start: Start | Array | None = s
    moved, rounds = np.inf, 0
    while True:
        linear, local = linearised(model, record, X)
        answer = method.answer(linear, local, start=start, known=known)
        est = answer.estimate
        rounds += 1
        if not est.status.good:
            break
        if rounds <= _SETTLED:
            start = answer.start
        sd = np.sqrt(np.maximum(np.diagonal(np.asarray(est.P), axis1=1, axis2=2), 1e-300))
        moved = float(np.max(np.abs(est.x - X[1:]) / sd, initial=0.0))
        new = np.concatenate([est.info["x0"][None], est.x])
        if moved > _USABLE:
            new = _shortened(model, record, X, new, _found(model, est, scale), linear, local)
        if rounds > _PATIENT:
            new = X + 0.5 * (new - X)
        X = new
        if moved < _CLOSE or rounds >= method.rounds:
            break
    status, info = est.status, dict(est.info) | {"rounds": rounds, "moved": moved}
    if status.good and moved > _CLOSE:
        status = Status.REDUCED if moved < _USABLE else Status.STALLED
        info["message"] = f"{status.value}: after {rounds} linearisations the states still move by {moved:.2g} sd"
    est = replace(est, status=status, names=model.names.x, labels=record.labels, info=info)
    return answer.amended(est)


def _shortened(
    model: Nonlinear, record: Record, X: Array, new: Array, variance: Array, linear: Linear, local: Record
) -> Array:
    """Return the longest step from path X towards another that is no worse, or about what `linear` says of it.

    With bounded noise the mean is not where squares are least, so a step is not asked to be better. If none will do the
    shortest one has to.
    """
    here, way = misfit(model, record, X, variance), new
    A, C, rest = linear.A.value, linear.C.value, local.u
    assert A is not None
    assert C is not None
    for share in _SHARES:
        way = X + share * (new - X)
        w = way[1:] - np.einsum("tij,tj->ti", A, way[:-1]) - rest
        said = squares(w, local.y - np.einsum("tij,tj->ti", C, way[1:]), variance)
        if misfit(model, record, way, variance) <= max(here, 2.0 * said + w.size):
            break
    return way


def _found(model: Nonlinear, est: Estimate, scale: Array) -> Array:
    """Return the variances of the noises (nx + ny,) as they were found, none of them nothing."""
    var = np.zeros(model.nx + model.ny)
    for noise, half, own, rows in (
        (model.w, est.q, est.Q, slice(0, model.nx)),
        (model.e, est.r, est.R, slice(model.nx, None)),
    ):
        if half is not None:
            var[rows] += half**2 / 3.0
        part = gaussian_part(noise)
        if own is not None:
            var[rows] += own
        elif part is not None:
            var[rows] += np.diagonal(part.cov().at(0.0, model.dt))
    return np.maximum(var, (LEAST * scale) ** 2)
