"""The path along which a nonlinear model is linearised first: the best of what Gaussian smoothers say."""

from dataclasses import replace

import numpy as np

from halfwidth.array import Array
from halfwidth.methods._along import misfit
from halfwidth.methods._noise_parts import gaussian_part, uniform_part
from halfwidth.methods._residuals import first_scales
from halfwidth.model import Linear, Nonlinear
from halfwidth.noise import Gaussian
from halfwidth.record import Record
from halfwidth.spread import Normal

#: The path of the window before stays unless another one fits so many times better.
_BETTER = 3.0
#: No noise counts as smaller than this share of what the data would make of it where paths are compared.
LEAST = 1e-3


def first_path(model: Nonlinear, record: Record, near: Array | None) -> tuple[Array, Array]:
    """Return a path (T + 1, nx) and the scale of each noise (nx + ny,).

    The path is that of least misfit among those of Gaussian smoothers with noise of about the right size, one by sigma
    points and one by Jacobians, and the one that may be `near`.
    """
    from halfwidth.methods.nonlinear import ExtendedKalman, UnscentedKalman

    x0 = np.asarray(model.x0.mean, dtype=float)
    at = model.linearise(x0, None if record.u is None else record.u[0], model.dt)
    local = Linear(at.g_x, None, at.h_x, model.w, model.e, Normal(x0, 1.0))
    scale = first_scales(local, [record.y[record.seen[:, j], j] for j in range(model.ny)])
    gaussian = _gaussian(model, scale)
    diagonal = [np.diagonal(noise.cov().at(0.0, model.dt)) for noise in (gaussian.w, gaussian.e)]
    variance = np.maximum(np.concatenate(diagonal), (LEAST * scale) ** 2)
    best, least = np.broadcast_to(x0, (len(record) + 1, model.nx)), np.inf
    for smoother in (UnscentedKalman(smooth=True), ExtendedKalman(smooth=True)):
        found = smoother.run(gaussian, record)
        X = np.concatenate([np.asarray(found.info.get("x0", x0))[None], found.x])
        off = misfit(model, record, X, variance) if np.isfinite(X).all() else np.inf
        if off < least:
            best, least = X, off
    if near is not None and np.isfinite(near).all() and misfit(model, record, near, variance) < _BETTER * least:
        best = near
    return best, scale


def _gaussian(model: Nonlinear, scale: Array) -> Nonlinear:
    """Return the model with Gaussian noise, of the scales (nx + ny,) where it is unknown, and a Gaussian prior."""
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
        prior = Normal(prior.mean, wide**2 / 12.0)
    return replace(model, w=noises["w"], e=noises["e"], x0=prior, bounds=None, loss=None)
