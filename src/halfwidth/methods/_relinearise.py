"""The posterior of a nonlinear model: linearise along the trajectory, solve, and again until it stays.

At a fixed point the mean is that of the model linearised at the mean itself, as in an iterated Kalman smoother; noise
keeps its own shape throughout.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from halfwidth.array import Array
from halfwidth.methods._residuals import first_scales
from halfwidth.methods._sites import gaussian_part, uniform_part
from halfwidth.model import Linear, Nonlinear, arity
from halfwidth.noise import Gaussian
from halfwidth.record import Record
from halfwidth.result import Status
from halfwidth.spread import Normal
from halfwidth.tape import Untraceable
from halfwidth.trace import compiled

if TYPE_CHECKING:
    from halfwidth.methods._carry import Known, Start
    from halfwidth.methods.posterior import Answer, Posterior

#: A step below this share of the standard deviations ends the iteration, and one below the second is good enough.
_CLOSE, _USABLE = 1e-3, 0.1


def relinearised(
    method: "Posterior", model: Nonlinear, record: Record, *, s: Array | None = None, known: "Known | None" = None
) -> "Answer":
    """Estimate the states of one record of a nonlinear model; `s` and `known` are as in `Posterior.answer`."""
    X = _first_path(model, record)
    start: Start | Array | None = s
    moved, rounds = np.inf, 0
    while True:
        linear, local = linearised(model, record, X)
        answer = method.answer(linear, local, start=start, known=known)
        est = answer.estimate
        rounds += 1
        if not est.status.good:
            break
        start = answer.start
        sd = np.sqrt(np.maximum(np.diagonal(np.asarray(est.P), axis1=1, axis2=2), 1e-300))
        moved = float(np.max(np.abs(est.x - X[1:]) / sd, initial=0.0))
        X = np.concatenate([est.info["x0"][None], est.x])
        if moved < _CLOSE or rounds >= method.rounds:
            break
    status, info = est.status, dict(est.info) | {"rounds": rounds, "moved": moved}
    if status.good and moved > _CLOSE:
        status = Status.REDUCED if moved < _USABLE else Status.STALLED
        info["message"] = f"{status.value}: after {rounds} linearisations the states still move by {moved:.2g} sd"
    est = replace(est, status=status, names=model.names.x, labels=record.labels, info=info)
    return answer._replace(estimate=est)


def linearised(model: Nonlinear, record: Record, X: Array) -> tuple[Linear, Record]:
    """Return the model along a path (T + 1, nx), x0 first, with what is left of `g` and `h` as inputs and outputs."""
    dt = record.steps(model.dt)
    u = record.u if model.nu else None
    g, A = _along(model, "g", X[:-1], (u, dt))
    h, C = _along(model, "h", X[1:], ())
    rest = g - np.einsum("tij,tj->ti", A, X[:-1])
    off = record.y - h
    angles = list(model.y_angles)
    off[:, angles] = np.mod(off[:, angles] + np.pi, 2 * np.pi) - np.pi
    y = off + np.einsum("tij,tj->ti", C, X[1:])
    linear = Linear(
        A, np.eye(model.nx), C, model.w, model.e, model.x0, bounds=model.bounds, dt=model.dt,
        names={"x": model.names.x, "y": model.names.y},
    )  # fmt: skip
    return linear, Record(record.t, y, rest)


def _along(model: Nonlinear, name: str, X: Array, more: tuple[Array | None, ...]) -> tuple[Array, Array]:
    """Return values and Jacobians of `g` or `h` at every point of a path, compiled where the function allows it."""
    f = getattr(model, name)
    given = more[: arity(f, 3 if name == "g" else 1) - 1]
    if getattr(model, f"{name}_x") is None:
        sizes = (model.nx, model.nu, None)[: 1 + len(given)]
        try:
            tape = compiled(f, sizes, [(X[0], *(None if a is None else a[0] for a in given))])
            value, slope = tape.jacobian(X, *(np.zeros((len(X), 0)) if a is None else a for a in given))
            if np.isfinite(value).all() and np.isfinite(slope).all():
                return value, slope
        except Untraceable:
            pass
    both = [
        model.linearise(x, None if not more or more[0] is None else more[0][t], _step(more, t)) for t, x in enumerate(X)
    ]
    values, slopes = [getattr(b, name) for b in both], [getattr(b, f"{name}_x") for b in both]
    return np.array(values), np.array(slopes)


def _step(more: tuple[Array | None, ...], t: int) -> float | None:
    return None if not more or more[1] is None else float(more[1][t])


def _first_path(model: Nonlinear, record: Record) -> Array:
    """Return a path (T + 1, nx) from an unscented smoother with noise of about the right size."""
    from halfwidth.methods.nonlinear import UnscentedKalman

    x0 = np.asarray(model.x0.mean, dtype=float)
    noises: dict[str, Gaussian] = {}
    at = model.linearise(x0, None if record.u is None else record.u[0], model.dt)
    local = Linear(at.g_x, None, at.h_x, model.w, model.e, Normal(x0, 1.0))
    scale = first_scales(local, [record.y[record.seen[:, j], j] for j in range(model.ny)])
    for name, noise, size in (("w", model.w, scale[: model.nx]), ("e", model.e, scale[model.nx :])):
        if noise.known:
            noises[name] = Gaussian(noise.cov())
            continue
        box, part = uniform_part(noise), gaussian_part(noise)
        var = np.zeros(len(size)) if box is None else np.clip(size, box.at_least, box.at_most) ** 2 / 3.0
        if part is not None and part.at_least is not None and part.at_most is not None:
            var = var + np.clip(size**2, part.at_least, part.at_most)
        noises[name] = Gaussian(var)
    prior = model.x0
    if not isinstance(prior, Normal):
        wide = np.where(np.isfinite(prior.hi - prior.lo), prior.hi - prior.lo, 1e3 * scale[: model.nx])
        prior = Normal(x0, wide**2 / 12.0)
    gaussian = replace(model, w=noises["w"], e=noises["e"], x0=prior, bounds=None, loss=None)
    smooth = UnscentedKalman(smooth=True).run(gaussian, record)
    path = smooth.x if np.isfinite(smooth.x).all() else np.broadcast_to(x0, smooth.x.shape)
    return np.concatenate([np.asarray(smooth.info.get("x0", x0))[None], path])
