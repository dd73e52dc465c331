"""A loss process as the kernel sees it: modes, one a pattern of sensor states, each with its own C, offset and R."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.loss import Loss


class Modes(NamedTuple):
    """A loss process as the kernel sees it, for the T rows of one record and M modes."""

    C: Array  # (1 or T, M, ny, nx)
    d: Array | None  # (1 or T, M, ny)
    R: Array  # (1 or T, M, ny, ny)
    Pi: Array  # (1 or T, M, M)
    pi0: Array  # (M,)
    prior: Array | None  # (G, 2, 2) pseudo-counts of a law to be learned
    carries: NDArray[np.bool_]  # (M, ny) whether an output carries the state


def modes_of(loss: Loss, C: Array, R: Array, y: Array, seen: NDArray[np.bool_]) -> Modes:
    """Return the modes of a record.

    Parameters
    ----------
    loss : Bernoulli or Markov
    C : (1 or T, ny, nx) array
    R : (1 or T, ny, ny) array
        Covariance of received outputs, positive definite.
    y : (T, ny) array
    seen : (T, ny) bool array
    """
    T, ny = y.shape
    groups = loss.groups(ny)
    patterns = loss.patterns(len(groups))
    owner = np.empty(ny, dtype=int)
    for g, members in enumerate(groups):
        owner[list(members)] = g
    state = patterns[:, owner]  # (M, ny)
    received = state == len(loss.kind)
    carries = received.copy()
    lost = {kind: state == k for k, kind in enumerate(loss.kind)}
    if "garbage" in lost:
        carries |= lost["garbage"]
    Cm = np.where(carries[:, :, None], C[:, None], 0.0)
    both = received[:, :, None] & received[:, None, :]
    Rm = np.where(both, R[:, None], 0.0)
    for kind, where in lost.items():
        pair = where[:, :, None] & where[:, None, :]
        if (
            kind == "noise" and loss.noise is None and "noise" not in loss.noise_of
        ):  # the same noise, whether or not the sample is in it
            pair |= (where | received)[:, :, None] & (where | received)[:, None, :]
        Rm = np.where(pair, loss.cov(kind, R)[:, None], Rm)
    d: Array | None = None
    if "noise" in lost and np.any(loss.center != 0.0):
        d = np.where(lost["noise"], loss.center, 0.0)[None]
    Pi, pi0 = loss.chain(T, len(groups))
    if "stale" in lost:
        last = last_reported(y, seen)
        d = np.where(lost["stale"], np.nan_to_num(last)[:, None, :], 0.0 if d is None else d)
        unable = (np.isnan(last) & seen)[:, None, :] & lost["stale"]  # nothing was reported yet
        Pi, pi0 = _without(Pi, pi0, unable.any(axis=2))
    return Modes(
        np.ascontiguousarray(Cm),
        None if d is None else np.ascontiguousarray(d),
        np.ascontiguousarray(Rm),
        np.ascontiguousarray(Pi),
        np.ascontiguousarray(pi0),
        loss.prior_counts(len(groups)),
        carries,
    )


def last_reported(y: Array, seen: NDArray[np.bool_]) -> Array:
    """Return for each entry of y (T, ny) the value reported last before it, NaN where there is none."""
    T, ny = y.shape
    row = np.where(seen, np.arange(T)[:, None], -1)
    before = np.full((T, ny), -1)
    before[1:] = np.maximum.accumulate(row, axis=0)[:-1]
    values = np.take_along_axis(y, np.maximum(before, 0), axis=0)
    return np.where(before >= 0, values, np.nan)


def _without(Pi: Array, pi0: Array, unable: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Give the probability of modes that cannot be, (T, M), to the others."""
    if not unable.any():
        return Pi, pi0
    Pi = np.array(np.broadcast_to(Pi, (len(unable), *Pi.shape[1:])))
    able = ~unable
    rest = np.where(able[:, None, :], Pi, 0.0)
    total = rest.sum(axis=-1, keepdims=True)
    Pi = np.where(
        total > 0, rest / np.where(total > 0, total, 1.0), able[:, None, :] / able.sum(axis=-1)[:, None, None]
    )
    first = np.where(able[0], pi0, 0.0)
    return Pi, first / first.sum() if first.sum() > 0 else able[0] / able[0].sum()
