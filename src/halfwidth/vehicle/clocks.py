"""What the pieces of a drive say of its clocks: one offset each, a step or a drift; and where a step is suspected."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import reckoning
from halfwidth.vehicle.sensors import Offset

Floats = NDArray[np.float64]

#: An offset is observable when its standard deviation is below, s.
OBSERVABLE = 0.15

#: A change of a clock is believed if it makes the misfit of the pieces smaller by this much, and is this large, s.
CHANGE_GAIN, CHANGE_LEAST = 25.0, 0.05

#: The same for a step that the rough look saw; and how much worse one stream may fit with the step of the other than
#: without: a logger mostly has one clock.
SEEN_GAIN, SHARED = 9.0, 4.0

#: No piece knows an offset better than this, s.
LEAST_SD = 0.01


def marginal(piece: reckoning.Piece) -> Floats:
    """Return the standard deviations (5,) of what a piece says by itself, with the prior."""
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(piece.information + np.diag(reckoning.PRIOR**-2.0)))))


def offset_of(pieces: Sequence[reckoning.Piece], k: int, constant: Offset, cut: float | None) -> Offset:
    """Return an offset of one stream: the same for the drive, or stepping or drifting if the pieces say so.

    Few pieces cannot say how much they scatter: they are only asked about a step at `cut`, which the rough look saw.
    """
    value = np.array([piece.mean[k] for piece in pieces])
    own = np.array([marginal(piece)[k] for piece in pieces])
    sure = own < 0.5 * reckoning.PRIOR[k]
    ends = np.array([(piece.t[0], piece.t[-1]) for piece in pieces])[sure]
    t = np.array([piece.t.mean() for piece in pieces])[sure]
    seen = cut is not None and bool((t < cut).any() and (t > cut).any())
    if t.size < 4 and not seen:
        return constant
    value, own = value[sure], np.maximum(own[sure], LEAST_SD)

    def misfit(columns: Floats) -> tuple[float, Floats]:
        found = np.linalg.lstsq(columns / own[:, None], value / own, rcond=None)[0]
        return float(np.sum(np.minimum(((value - columns @ found) / own) ** 2, 25.0))), found

    ones = np.ones(t.size)
    flat, _ = misfit(ones[:, None])
    line, slope = misfit(np.column_stack((ones, t - t.mean())))
    between = (ends[:-1, 1] + ends[1:, 0]) / 2 if not seen else np.array([cut])
    tried = [misfit(np.column_stack((t < when, t >= when)).astype(float)) for when in between]
    best_cut = int(np.argmin([found[0] for found in tried]))
    step, levels = tried[best_cut]
    best = step if t.size < 4 else min(line, step)
    noise = max(1.0, best / max(t.size - 2, 1))
    if (flat - best) / noise < (SEEN_GAIN if seen else CHANGE_GAIN):
        return constant
    if (t.size < 4 or step < line - noise) and abs(levels[1] - levels[0]) > CHANGE_LEAST:
        when = float(between[best_cut])
        sides = [float(np.sum(own[side] ** -2.0) ** -0.5) for side in (t < when, t >= when)]
        at = ((when - 1e-3, float(levels[0])), (when, float(levels[1])))
        return Offset(constant.seconds, float(max(sides) * np.sqrt(noise)), True, at, "step")
    if t.size >= 4 and abs(slope[1]) * np.ptp(t) > CHANGE_LEAST:
        first, last = ((float(x), float(slope[0] + slope[1] * (x - t.mean()))) for x in (ends[0, 0], ends[-1, 1]))
        return Offset(float(slope[0]), constant.sd, True, (first, last), "drift")
    return constant


def alike(pieces: Sequence[reckoning.Piece], k: int, constant: Offset, other: Offset) -> Offset:
    """Return an offset that steps like that of the other stream unless the pieces clearly prefer one that does not."""
    (_, before), (when, after) = other.at
    value = np.array([piece.mean[k] for piece in pieces])
    weight = np.array([marginal(piece)[k] ** -2.0 for piece in pieces])
    late = np.where(np.array([piece.t.mean() for piece in pieces]) < when, 0.0, after - before)

    def fitted(value: Floats) -> tuple[float, float]:
        level = float(weight @ value / weight.sum())
        return level, float(weight @ (value - level) ** 2)

    level, misfit = fitted(value - late)
    if misfit > fitted(value)[1] + SHARED:
        return constant
    sd = max(float(weight.sum() ** -0.5), other.sd)
    return Offset(constant.seconds, sd, sd < OBSERVABLE, ((when - 1e-3, level), (when, level + after - before)), "step")


def suspected(pieces: Sequence[reckoning.Piece], which: Sequence[int]) -> tuple[float | None, float]:
    """Return between which pieces the clocks of all streams together step clearest, s, and what that explains.

    The time is None where it explains no more than chance does.

    Parameters
    ----------
    pieces : sequence of Piece
        In order of time.
    which : sequence of int
        Which numbers of a piece are the offsets of streams that the log has.
    """
    when, most = None, 0.0
    for i in range(1, len(pieces)):
        gain = 0.0
        for k in which:
            value = np.array([piece.mean[k] for piece in pieces])
            weight = np.maximum([marginal(piece)[k] for piece in pieces], LEAST_SD) ** -2.0
            sides = (value[:i], weight[:i]), (value[i:], weight[i:])
            gain += _scatter(value, weight) - sum(_scatter(*side) for side in sides)
        if gain > most:
            when, most = 0.5 * float(pieces[i - 1].t[-1] + pieces[i].t[0]), gain
    return (when if most > CHANGE_GAIN else None), most


def _scatter(value: Floats, weight: Floats) -> float:
    """Return how badly one value explains several, none of which counts by more than five standard deviations."""
    mean = float(weight @ value / weight.sum())
    return float(np.minimum(weight * (value - mean) ** 2, CHANGE_GAIN).sum())
