"""What is said about doubtful fixes: how far they are off, and whether that is wrong."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import chain
from halfwidth.vehicle.doubts import Doubt
from halfwidth.vehicle.grid import Grid

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: A fix is stray if it is this many standard deviations off where it should be, and this far, m. The fixes agree again
#: once they are this many off, and must do so for this share of the time in doubt.
FAR, FAR_M, NEAR, AGREED = 4.0, 0.5, 2.0, 0.15

#: Places where nobody doubts are enough from so many on; the quantile of how far they are off that counts, and how many
#: times that a stray fix is off; how many times `FAR` where there are too few such places.
FEWEST_CONTROLS, _QUANTILE, _MARGIN, _UNKNOWN = 8, 0.75, 1.6, 2.0


@dataclass(frozen=True, eq=False)
class Answer:
    """What was said about one doubt at one length."""

    doubt: Doubt
    length: float
    nodes: NDArray[np.intp]  # of the doubtful fixes
    off: list[tuple[Floats, Floats]]  # how far they are off, and the standard deviation of that, for each side asked
    apart: Floats  # how far what the sides say is apart, 0 where one was asked


def furthest(answer: Answer) -> float:
    """Return how many standard deviations the furthest of the fixes is off, by the side that says the least."""
    return float(np.min([distance / sd for distance, sd in answer.off], axis=0).max())


def unusual(usual: Floats) -> float:
    """Return how many times further off than `FAR` fixes must be, from how far off others are."""
    enough = usual.size >= FEWEST_CONTROLS
    return max(1.0, _MARGIN * float(np.quantile(usual, _QUANTILE)) / FAR if enough else _UNKNOWN)


def apart_of(nodes: NDArray[np.intp], parts: Sequence[slice], fits: Sequence[chain.Fit]) -> Floats:
    """Return how far the first and the last of some paths are apart at some nodes, m."""
    first, last = (
        np.column_stack((fit.path.east, fit.path.north))[nodes - part.start]
        for fit, part in ((fits[0], parts[0]), (fits[-1], parts[-1]))
    )
    return np.asarray(np.nan_to_num(np.hypot(*(last - first).T), nan=np.inf))


def off_path(grid: Grid, nodes: NDArray[np.intp], part: slice, fit: chain.Fit) -> tuple[Floats, Floats]:
    """Return how far the fixes at some nodes are off a path, and the standard deviation of that, m."""
    path, own = fit.path, nodes - part.start
    if not path.finite or path.variance is None or not path.status.good:
        return np.zeros(nodes.size), np.ones(nodes.size)
    distance = np.hypot(path.east[own] - grid.east[nodes], path.north[own] - grid.north[nodes])
    return distance, np.sqrt(path.variance[own].mean(axis=1) + path.fix_variance)


def wrong_of(answer: Answer, times: float) -> Mask:
    """Return which of the doubted fixes are wrong: from the first on, up to where they agree again.

    They are wrong if all that were asked say so, by so many times the usual; the last one asked says where they agree.
    Where the sides contradict each other more than the fixes, it is the reckoning that is wrong.
    """
    far = np.all(
        [(distance > times * FAR * sd) & (distance > np.maximum(FAR_M, answer.apart)) for distance, sd in answer.off],
        axis=0,
    )
    distance, sd = answer.off[-1]
    near = distance < np.maximum(times * NEAR * sd, FAR_M)
    if answer.doubt.backwards:
        far, near = far[::-1], near[::-1]
    wrong = np.zeros(far.size, dtype=bool)
    if far.any():
        again = int(np.flatnonzero(far)[-1]) + 1
        again += int(np.argmax(near[again:])) if near[again:].any() else far.size
        agreed = near[again:]
        # where they do not agree again for a while, or most before that do, it is no fault that came and went
        if agreed.size >= max(1, AGREED * far.size) and agreed.mean() > 0.8 and (~near[:again]).mean() > 0.5:
            wrong[:again] = ~near[:again] | far[:again]
    return wrong[::-1] if answer.doubt.backwards else wrong
