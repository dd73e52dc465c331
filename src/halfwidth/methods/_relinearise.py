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

from halfwidth.array import Array, wrapped
from halfwidth.methods._noise_parts import gaussian_part, uniform_part
from halfwidth.methods._residuals import first_scales
from halfwidth.model import Linear, Nonlinear, arity
from halfwidth.noise import Gaussian
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Normal
from halfwidth.tape import Untraceable
from halfwidth.trace import compiled

if TYPE_CHECKING:
    from halfwidth.methods._answer import Answer
    from halfwidth.methods._carry import Known, Start
    from halfwidth.methods.posterior import Posterior

#: A step below this share of the standard deviations ends the iteration, and one below the second is good enough.
_CLOSE, _USABLE = 1e-3, 0.1
#: Shares of a step that are tried, and rounds after which half-widths and nodes begin where they began before.
_SHARES, _SETTLED = (1.0, 0.5, 0.25, 0.125), 2
#: Rounds after which a step is half of what is asked for: what still moves then goes to and fro.
_PATIENT = 6
#: The path of the window before stays unless another one fits so many times better.
_BETTER = 3.0
#: No noise counts as smaller than this share of what the data would make of it where paths are compared.
_LEAST = 1e-3


def relinearised(
    method: "Posterior", model: Nonlinear, record: Record, *, s: Array | None = None, known: "Known | None" = None,
    path: Array | None = None,
) -> "Answer":  # fmt: skip
    """Estimate the states of one record of a nonlinear model.

    `s` and `known` are as in `Posterior.answer`; `path` (T + 1, nx), x0 first, is one that may be near.
    """
    X, scale = _first_path(model, record, path)
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
    here, way = _misfit(model, record, X, variance), new
    A, C, rest = linear.A.value, linear.C.value, local.u
    assert A is not None
    assert C is not None
    for share in _SHARES:
        way = X + share * (new - X)
        w = way[1:] - np.einsum("tij,tj->ti", A, way[:-1]) - rest
        said = _squares(w, local.y - np.einsum("tij,tj->ti", C, way[1:]), variance)
        if _misfit(model, record, way, variance) <= max(here, 2.0 * said + w.size):
            break
    return way


def _misfit(model: Nonlinear, record: Record, X: Array, variance: Array) -> float:
    """Return the squared residuals of a path (T + 1, nx) over their variances (nx + ny,)."""
    off, _ = _outputs(model, record, X)
    moved, _ = _along(model, "g", X[:-1], _inputs(model, record))
    return _squares(X[1:] - moved, off, variance)


def _squares(w: Array, e: Array, variance: Array) -> float:
    nx = w.shape[1]
    total = float(np.sum(w**2 / variance[:nx])) + float(np.nansum(e**2 / variance[nx:]))
    return total if np.isfinite(total) else np.inf


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
    return np.maximum(var, (_LEAST * scale) ** 2)


def linearised(model: Nonlinear, record: Record, X: Array) -> tuple[Linear, Record]:
    """Return the model along a path (T + 1, nx), x0 first, with what is left of `g` and `h` as inputs and outputs."""
    g, A = _along(model, "g", X[:-1], _inputs(model, record))
    off, C = _outputs(model, record, X)
    rest = g - np.einsum("tij,tj->ti", A, X[:-1])
    y = off + np.einsum("tij,tj->ti", C, X[1:])
    linear = Linear(
        A, np.eye(model.nx), C, model.w, model.e, model.x0, bounds=model.bounds, dt=model.dt,
        names={"x": model.names.x, "y": model.names.y},
    )  # fmt: skip
    return linear, Record(record.t, y, rest)


def _inputs(model: Nonlinear, record: Record) -> tuple[Array | None, Array]:
    return record.u if model.nu else None, record.steps(model.dt)


def _outputs(model: Nonlinear, record: Record, X: Array) -> tuple[Array, Array]:
    """Return outputs less those of a path (T, ny), angles wrapped, and the Jacobians of `h` along it."""
    h, C = outputs_along(model, X[1:])
    return wrapped(record.y - h, model.y_angles), C


def outputs_along(model: Nonlinear, x: Array) -> tuple[Array, Array]:
    """Return outputs (T, ny) of states x (T, nx), and the Jacobians of `h` (T, ny, nx)."""
    return _along(model, "h", x, ())


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


def _first_path(model: Nonlinear, record: Record, near: Array | None) -> tuple[Array, Array]:
    """Return a path (T + 1, nx) and the scale of each noise (nx + ny,).

    The path is that of least misfit among those of Gaussian smoothers with noise of about the right size, one by sigma
    points and one by Jacobians, and the one that may be `near`.
    """
    from halfwidth.methods.nonlinear import ExtendedKalman, UnscentedKalman

    x0 = np.asarray(model.x0.mean, dtype=float)
    at = model.linearise(x0, None if record.u is None else record.u[0], model.dt)
    local = Linear(at.g_x, None, at.h_x, model.w, model.e, Normal(x0, 1.0))
    scale = first_scales(local, [record.y[record.seen[:, j], j] for j in range(model.ny)])
    noises: dict[str, Gaussian] = {}
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
    diagonal = [np.diagonal(noises[name].cov().at(0.0, model.dt)) for name in ("w", "e")]
    variance = np.maximum(np.concatenate(diagonal), (_LEAST * scale) ** 2)
    best, least = np.broadcast_to(x0, (len(record) + 1, model.nx)), np.inf
    for smoother in (UnscentedKalman(smooth=True), ExtendedKalman(smooth=True)):
        found = smoother.run(gaussian, record)
        X = np.concatenate([np.asarray(found.info.get("x0", x0))[None], found.x])
        misfit = _misfit(model, record, X, variance) if np.isfinite(X).all() else np.inf
        if misfit < least:
            best, least = X, misfit
    if near is not None and np.isfinite(near).all() and _misfit(model, record, near, variance) < _BETTER * least:
        best = near
    return best, scale
