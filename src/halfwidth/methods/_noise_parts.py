"""The bounded and the Gaussian part of a noise, and the groups that a chain has one size for.

There are p = nx + ny groups, the half-widths (q, r), or twice as many: then the other half are the standard deviations
of Gaussian parts of w and e whose variances are unknown.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.model import Linear, Model
from halfwidth.noise import Gaussian, Mixed, Noise, Uniform
from halfwidth.spread import Box
from halfwidth.varying import Varying, varying


def groups(model: Model) -> int:
    """Return the number of groups that the chain of a model has."""
    once = model.nx + model.ny
    return once if all(part is None or part.known for part in map(gaussian_part, (model.w, model.e))) else 2 * once


def unknowns(model: Model) -> int:
    """Return how many half-widths and variances of a model are to be found."""
    count = 0
    for noise, n in ((model.w, model.nx), (model.e, model.ny)):
        for part in (uniform_part(noise), gaussian_part(noise)):
            if part is not None and part.at_least is not None and part.at_most is not None:
                apart = np.less(part.at_least, part.at_most, out=np.empty(n, dtype=bool))
                count += int(np.count_nonzero(apart))
    return count


def all_groups(model: Linear) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return floors and caps of all groups, which are half-widths and which unknown deviations; each (p,)."""
    floor, cap, uniform = _half_widths(model)
    if groups(model) == len(floor):
        return floor, cap, uniform, np.zeros(len(floor), dtype=bool)
    of = [(gaussian_part(noise), n) for noise, n in ((model.w, model.nx), (model.e, model.ny))]
    lo, hi = np.sqrt(np.concatenate([ends_of(part, n) for part, n in of], axis=1))
    asked = np.concatenate([np.full(n, part is not None and not part.known) for part, n in of])
    no = np.zeros(len(floor), dtype=bool)
    return np.r_[floor, lo], np.r_[cap, hi], np.r_[uniform, no], np.r_[no, asked]


def ends_of(part: Gaussian | None, n: int) -> Array:
    """Return the variances between which unknown ones lie, (2, n); 0 for a noise that has none."""
    if part is None or part.at_least is None or part.at_most is None:
        return np.zeros((2, n))
    return np.array([part.at_least, part.at_most])


def _half_widths(model: Linear) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return floors and caps of the half-widths (q, r), 0 where a noise has none, and which have one, (nx + ny,)."""
    parts: list[tuple[Array, Array, NDArray[np.bool_]]] = []
    for noise, n in ((model.w, model.nx), (model.e, model.ny)):
        box = uniform_part(noise)
        if box is None:
            parts.append((np.zeros(n), np.zeros(n), np.zeros(n, dtype=bool)))
        else:
            parts.append((np.atleast_1d(box.at_least), np.atleast_1d(box.at_most), np.ones(n, dtype=bool)))
    return (
        np.concatenate([f[0] for f in parts]),
        np.concatenate([f[1] for f in parts]),
        np.concatenate([f[2] for f in parts]),
    )


def bounded_only(model: Linear) -> Linear:
    """Return the model with bounded noise of unknown size instead of Gaussian noise, and a box as prior."""
    free = [
        noise if isinstance(noise, Uniform) else Uniform.unknown().sized(n, "noise")
        for noise, n in ((model.w, model.nx), (model.e, model.ny))
    ]
    prior = model.x0 if isinstance(model.x0, Box) else Box(np.full(model.nx, -np.inf), np.full(model.nx, np.inf))
    return replace(model, w=free[0], e=free[1], x0=prior)


def uniform_part(noise: Noise) -> Uniform | None:
    """Return the bounded part of a noise, if it has one."""
    return noise if isinstance(noise, Uniform) else noise.uniform if isinstance(noise, Mixed) else None


def gaussian_part(noise: Noise) -> Gaussian | None:
    """Return the Gaussian part of a noise, if it has one."""
    return noise if isinstance(noise, Gaussian) else noise.gaussian if isinstance(noise, Mixed) else None


def given(part: Gaussian, n: int) -> Varying | None:
    """Return the covariance of a Gaussian part without entries whose variance is to be found, None if none is left."""
    if part.known:
        return part.cov()
    lo, hi = ends_of(part, n)
    kept = np.where(lo < hi, 0.0, lo)
    return varying(np.diag(kept), "Q", (n, n)) if kept.any() else None
