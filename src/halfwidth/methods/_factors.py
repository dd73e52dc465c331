"""The factors of a chain on its states: one row for each seen output, ``h'x - y = e``, and each bound.

An unseen output that a seen one is correlated with through F is eliminated, and its half-width counts as variance of
that row (as in `_residuals`). The rows of a Gaussian part of unknown variances are taken as they are, since nothing can
be whitened that is not known.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.methods._noise_parts import ends_of, gaussian_part, given, groups, uniform_part
from halfwidth.methods._residuals import _eliminate
from halfwidth.model import Linear
from halfwidth.record import Record
from halfwidth.spread import Box

GAUSSIAN, UNIFORM, UNIFORM_GAUSSIAN, CONTAMINATED, MAYBE_LOST, TRUNCATION = range(6)
#: Variances below this share of the output's own scale, squared, count as no noise: information must stay finite.
EXACT = 1e-12


@dataclass(frozen=True, eq=False)
class Factors:
    """Factors of one kind, each on one linear functional of a state; see core/ep_entry.hpp."""

    stage: NDArray[np.intp]
    h: Array
    Y: Array  # (K, ny): seen outputs of the row to the target
    kind: NDArray[np.int8]
    group: NDArray[np.int32]
    R: Array
    lo: Array
    hi: Array
    lost: Array
    mix: Array
    output: NDArray[np.intp]
    deviation: NDArray[np.int32]

    @classmethod
    def of(cls, model: Linear, stage: NDArray[np.intp], h: Array, kind: Any, **more: Any) -> "Factors":
        """Fill in what a kind of row does not have."""
        K, p = len(stage), groups(model)
        none = {
            "Y": np.zeros((K, model.ny)),
            "group": np.full(K, -1),
            "R": np.zeros(K),
            "lo": np.zeros(K),
            "hi": np.zeros(K),
        }
        none |= {"lost": np.zeros(K), "mix": np.zeros((K, p)), "output": np.full(K, -1), "deviation": np.full(K, -1)}
        return cls(stage=stage, h=h, kind=np.broadcast_to(np.asarray(kind, dtype=np.int8), (K,)), **(none | more))


def outputs(model: Linear, record: Record, dt: Array, scale: Array, outliers: bool) -> list[Factors]:
    """Return those of the seen outputs; `scale` (p,) is the order of size of each group."""
    T, nx, ny = len(record), model.nx, model.ny
    p, once = groups(model), nx + ny
    box, part = uniform_part(model.e), gaussian_part(model.e)
    if box is None and part is not None and part.known:
        return _gaussian(model, record, dt, scale)
    C, seen = model.C.each(record.t, dt), record.seen
    t, j = np.nonzero(seen)
    Y = np.eye(ny)[j]
    R = np.zeros((T, ny))
    own = None if part is None else given(part, ny)
    if own is not None:
        R = np.diagonal(own.each(record.t, dt), axis1=1, axis2=2)
    lo, hi = ends_of(part, ny)
    deviation = np.where(lo < hi, once + nx + np.arange(ny), -1)[j]
    mix = np.zeros((len(t), p))
    if model.F is not None:
        F = model.F.each(record.t, dt)
        N = _eliminate(F, seen)
        C, Y = N @ C, (N @ F)[t, j]
        R = np.einsum("tij,tj->ti", N**2, R)
        others = np.where(np.eye(ny)[j] > 0, 0.0, N[t, j] ** 2)
        if box is not None:
            mix[:, nx:once] = others / 3.0
        if p > once:
            mix[:, once + nx :] = np.where(lo < hi, others, 0.0)
    more: dict[str, Any] = {"lost": np.zeros(len(t))}
    if model.loss is not None:
        kind: Any = np.full(len(t), MAYBE_LOST)
        more["lost"] = _lost(model, record, dt, t, j)
    elif outliers:
        kind = np.full(len(t), CONTAMINATED)
    elif box is None:
        kind = np.full(len(t), GAUSSIAN)
        floor = EXACT * scale[nx + j] ** 2  # of a known variance beside unknown ones
        R = R.copy()
        R[t, j] = np.where(deviation < 0, np.maximum(R[t, j], floor), R[t, j])
    else:
        kind = np.where((R[t, j] > 0) | (deviation >= 0) | mix.any(axis=1), UNIFORM_GAUSSIAN, UNIFORM)
    more |= {"R": np.array(R[t, j]), "group": nx + j if box is not None else np.full(len(t), -1)}
    return [Factors.of(model, t + 1, C[t, j], kind, Y=Y, mix=mix, output=j, deviation=deviation, **more)]


def _gaussian(model: Linear, record: Record, dt: Array, scale: Array) -> list[Factors]:
    """Whiten the seen outputs of each row."""
    nx, ny = model.nx, model.ny
    part = gaussian_part(model.e)
    assert part is not None
    C, R = model.C.each(record.t, dt), part.cov().each(record.t, dt)
    y = np.where(record.seen, record.y, 0.0)
    if model.F is not None:
        inverse = np.linalg.inv(model.F.each(record.t, dt))
        C = inverse @ C
        R = inverse @ R @ np.swapaxes(inverse, 1, 2)
    found = []
    patterns, which = np.unique(record.seen, axis=0, return_inverse=True)
    for k, pattern in enumerate(patterns):
        s = np.flatnonzero(pattern)
        if not s.size:
            continue
        t = np.flatnonzero(which.ravel() == k)
        part_R = np.array(R[t][:, s][:, :, s])
        least = EXACT * np.maximum(scale[nx + s] ** 2, np.abs(y[t][:, s]).max(axis=0) ** 2 * EXACT)
        part_R[:, np.arange(s.size), np.arange(s.size)] += np.where(
            np.diagonal(part_R, axis1=1, axis2=2) <= least, least, 0.0
        )
        if model.loss is not None:  # a loss strikes one sensor: `refused` has seen to a diagonal R
            for a, j in enumerate(s):
                more = {"Y": np.tile(np.eye(ny)[j], (t.size, 1)), "R": part_R[:, a, a], "output": np.full(t.size, j)}
                more["lost"] = _lost(model, record, dt, t, np.full(t.size, j))
                found.append(Factors.of(model, t + 1, C[t, j], MAYBE_LOST, **more))
            continue
        try:
            L = np.linalg.cholesky(part_R)
        except np.linalg.LinAlgError:
            spread = np.einsum("tii->t", part_R)[:, None, None] * 1e-12
            L = np.linalg.cholesky(part_R + spread * np.eye(s.size))
        h = np.linalg.solve(L, C[t][:, s])
        white = np.zeros((t.size, s.size, ny))
        white[:, :, s] = np.linalg.inv(L)
        # the whitened row keeps the unit of its output, so that its density is the output's own
        d = np.diagonal(L, axis1=1, axis2=2)
        for a, j in enumerate(s):
            found.append(
                Factors.of(
                    model, t + 1, h[:, a] * d[:, a, None], GAUSSIAN, Y=white[:, a] * d[:, a, None], R=d[:, a] ** 2,
                    output=np.full(t.size, j),
                )
            )  # fmt: skip
    return found


def _lost(model: Linear, record: Record, dt: Array, t: NDArray[np.intp], j: NDArray[np.intp]) -> Array:
    """Return the log density of each seen output if it was lost."""
    # unknown noise says nothing here: the noise of lost samples is given then
    R = model.e.cov().each(record.t, dt) if model.e.known else np.zeros((len(record), model.ny, model.ny))
    kind = model.loss.kind[0]
    found = np.zeros(len(t))
    center = np.broadcast_to(np.asarray(model.loss.center, dtype=float), (model.ny,))
    for k, (a, b) in enumerate(zip(t.tolist(), j.tolist(), strict=True)):
        v = float(model.loss.cov(kind, R[a])[b, b])
        found[k] = -0.5 * (np.log(2 * np.pi * v) + (record.y[a, b] - center[b]) ** 2 / v)
    return found


def bounds(model: Linear, T: int) -> list[Factors]:
    """Return those of the bounds of T rows."""
    if model.bounds is None:
        return []
    D, lo, hi = model.bounds.rows
    keep = np.isfinite(lo) | np.isfinite(hi)
    D, lo, hi = D[keep], lo[keep], hi[keep]
    if not keep.any():
        return []
    K = len(D)
    stage, h = np.repeat(np.arange(1, T + 1), K), np.broadcast_to(D, (T, K, model.nx)).reshape(-1, model.nx)
    return [Factors.of(model, stage, h, TRUNCATION, lo=np.tile(lo, T), hi=np.tile(hi, T))]


def first_bounds(model: Linear) -> list[Factors]:
    """Return those of x0: one end of its box without the other is a bound of stage 0."""
    if not isinstance(model.x0, Box):
        return []
    nx = model.nx
    one = np.flatnonzero(np.isfinite(model.x0.lo) ^ np.isfinite(model.x0.hi))
    if not one.size:
        return []
    stage = np.zeros(one.size, dtype=np.intp)
    return [Factors.of(model, stage, np.eye(nx)[one], TRUNCATION, lo=model.x0.lo[one], hi=model.x0.hi[one])]
