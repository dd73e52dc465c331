"""Stretches of fixes that begin or end with a step that no car can make: what a receiver says before it is sure.

A receiver that finds its satellites again may be off by the same tens of metres for seconds and then step to where it
is. Where speed and yaw rate are there, dead reckoning shows it (`stray`). Without them the step itself is the evidence:
between two neighbouring fixes the car moved by much more than with the velocity it had on either side of the step. A
step cuts a stretch of fixes without a gap in two, and the shorter part is wrong if it is short and stands at a gap, or
if it ends with a step back:

    off[k] = fix[k] - fix[k - 1] - velocity around k * (t[k] - t[k - 1])

What fades slowly makes no step and cannot be seen like this.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: A step is this many metres, usual differences of the log, and m/s^2 over the time between two fixes.
FAR_M, USUAL, HARD = 3.0, 10.0, 12.0

#: A pause between fixes of this many seconds, and of so many usual ones, is a gap.
_GAP, _GAPS = 3.0, 3.0

#: Wrong fixes last for so long at most, s, and at most for this share of the fixes that they step to.
LONGEST, SHARE = 20.0, 0.7

#: A step back leaves this share of the step away, at most.
_BACK = 0.35

#: Steps on each side that say how fast the car was, and fixes that make a log worth looking at.
_AROUND, _FEWEST = 4, 20


def stepped(t: Floats, y: Floats) -> Mask:
    """Find fixes that lie on the wrong side of a step.

    Parameters
    ----------
    t : (n,) array
        Times of the fixes, s.
    y : (n, 2) array
        Fixes, m.

    Returns
    -------
    (n,) bool array
    """
    wrong = np.zeros(t.size, dtype=bool)
    if t.size < _FEWEST:
        return wrong
    h = np.diff(t)
    usual_h = float(np.median(h))
    gap = h > max(_GAP, _GAPS * usual_h)
    off = np.diff(y, axis=0) - _velocity(np.diff(y, axis=0) / h[:, None], gap) * h[:, None]
    size = np.hypot(off[:, 0], off[:, 1])
    least = np.maximum(max(FAR_M, USUAL * float(np.median(size[~gap]))), HARD * h**2)
    step = (size > least) & ~gap
    # where steps are no exception they are how this receiver scatters
    if step.sum() > 0.02 * t.size + 4:
        return wrong
    block = np.concatenate(([0], np.flatnonzero(gap) + 1, [t.size]))
    for a, b in pairwise(block.tolist()):
        cuts = np.flatnonzero(step[a : b - 1]) + a
        if cuts.size:
            wrong[a:b] = _wrong_parts(t, a, b, cuts, off)
    return wrong


def _velocity(rate: Floats, gap: Mask) -> Floats:
    """Return how fast the car was around each step, (n - 1, 2) m/s: the middle of the steps beside it."""
    padded = np.pad(np.where(gap[:, None], np.nan, rate), ((_AROUND, _AROUND), (0, 0)), constant_values=np.nan)
    beside = np.stack([padded[k : k + rate.shape[0]] for k in range(2 * _AROUND + 1) if k != _AROUND])
    alone = np.isnan(beside).all(axis=0)
    return np.asarray(np.where(alone, 0.0, np.nanmedian(np.where(alone, 0.0, beside), axis=0)))


def _wrong_parts(t: Floats, a: int, b: int, cuts: NDArray[np.intp], off: Floats) -> Mask:
    """Return which fixes of a stretch without a gap, rows a to b, are wrong; `cuts` are the last rows before a step."""
    edges = [a, *(int(k) + 1 for k in cuts), b]
    away = {int(k) + 1: off[k] for k in cuts}
    wrong = np.zeros(b - a, dtype=bool)

    def length(first: int, last: int) -> float:
        return float(t[last - 1] - t[first])

    # a part between a step away and a step back, the shortest first; what is around it is then one part
    while len(edges) > 3:
        inner = [
            k
            for k in range(1, len(edges) - 2)
            if length(edges[k], edges[k + 1]) <= LONGEST
            and np.hypot(*(away[edges[k]] + away[edges[k + 1]])) <= _BACK * np.hypot(*away[edges[k]])
        ]
        if not inner:
            break
        k = min(inner, key=lambda k: length(edges[k], edges[k + 1]))
        wrong[edges[k] - a : edges[k + 1] - a] = True
        del edges[k : k + 2]
    parts = list(pairwise(edges))
    main = max(parts, key=lambda part: length(*part))
    room = min(LONGEST, SHARE * length(*main))
    for first, last in ((a, main[0]), (main[1], b)):
        if last > first and length(first, last) <= room:
            wrong[first - a : last - a] = True
    return wrong
