"""What all fixes around a gap share: how far the receiver itself is off, for minutes at a time.

Hiding fixes shows where the receiver would have seen the vehicle, not where the vehicle was. But a receiver whose error
wanders does not agree with dead reckoning, and that is in the log: the chain with Gaussian increments of the fix offset
(`chain`, no drift) has a likelihood, and here it is made largest over the scale of these increments alone. Expectation
maximisation moves this scale so slowly that it stays near where it began.

How long an error lasts is not in the log: a receiver that is off by the same all along agrees with itself. `MEMORY` is
an assumption, twice the chain's 60 s to be rather too wide than too narrow; an error that lasts longer is only found in
part. And what the sensors are wrong by for as long as that is taken for the fixes' error: on logs with poor sensors the
number is too large, not too small.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import chain
from halfwidth.vehicle.grid import Grid

Floats = NDArray[np.float64]

#: Factors on the learnt scale that are tried first, and then about the best one.
_COARSE = (1 / 64, 1 / 16, 1 / 4, 1.0, 4.0)
_FINE = (0.5, 2.0)

#: Rounds of the chain for each, and nodes on which they are compared, about.
_ROUNDS, _NODES = 2, 4000

#: How long an error is taken to last, s.
MEMORY = 120.0

#: Logarithm of the likelihood by which an offset has to be better than next to none.
_CLEAR = 2.0


@dataclass(frozen=True, eq=False)
class Slow:
    """The slow error of the fixes of one log.

    Parameters
    ----------
    sd : float
        Root mean square over the fixes, each axis, m.
    seen : bool
        Whether the log shows it, or is explained as well by white noise.
    t : (T,) array
        Times of fixes, s.
    variance : (T, 2) array
        Expected square of how far the receiver's position is off the truth there, its white noise apart, m^2.
    """

    sd: float
    seen: bool
    t: Floats
    variance: Floats

    def at(self, t: Floats) -> Floats:
        """Return the standard deviations (M, 2) at some times, m; across a gap those of its edges."""
        return np.sqrt(np.column_stack([np.interp(t, self.t, self.variance[:, axis]) for axis in (0, 1)]))


def slow_error(grids: Sequence[Grid], fits: Sequence[chain.Fit], shown: Sequence[chain.Fit]) -> Slow | None:
    """Find the slow error of the fixes.

    Parameters
    ----------
    grids : sequence of Grid
        The parts of the drive.
    fits : sequence of Fit
        Of each, by a chain with Gaussian increments of the offset and no drift: where the search starts.
    shown : sequence of Fit
        Of each, the one whose path, offset included, is shown.

    Returns
    -------
    Slow or None
        None where the numbers broke down.
    """
    settings = chain.Chain(rounds=_ROUNDS, tail=np.inf, drifting=False, memory=MEMORY)
    found: dict[float, float] = {}
    enough = max(1, int(np.searchsorted(np.cumsum([len(grid) for grid in grids]), _NODES)))

    def solved(which: int, factors: Sequence[float]) -> list[chain.Fit]:
        sigma = np.repeat(fits[which].sigma[None], len(factors), axis=0)
        sigma[:, chain.OFFSET] = [_scale(fits, factor) for factor in factors]
        start = [fits[which].z[:, chain.AZIMUTH]] * len(factors)
        return chain.solve([grids[which]] * len(factors), settings, sigma=sigma, azimuth=start, learn=False)

    def look(factors: Sequence[float]) -> float:
        totals = np.sum([[fit.loglik for fit in solved(i, factors)] for i in range(min(enough, len(grids)))], axis=0)
        found.update(zip(factors, np.where(np.isfinite(totals), totals, -np.inf).tolist(), strict=True))
        return max(found, key=lambda factor: found[factor])

    best = look(_COARSE)
    best = look([best * factor for factor in _FINE])
    if not np.isfinite(found[best]):
        return None
    t, variance = [], []
    for i, (grid, one) in enumerate(zip(grids, shown, strict=True)):
        (fit,) = solved(i, [best])
        both = ((chain.E, chain.OFFSET_E), (chain.N, chain.OFFSET_N))
        off = np.column_stack([one.z[:, a] + one.z[:, o] - fit.z[:, a] for a, o in both])
        own = off**2 + np.column_stack([fit.P[:, a, a] for a, _ in both])
        good = grid.seen & np.isfinite(own).all(axis=1)
        t.append(grid.t[good])
        variance.append(np.maximum(own[good], 0.0))
    times = np.concatenate(t)
    if not times.size:
        return None
    order = np.argsort(times, kind="stable")
    squares = np.concatenate(variance)[order]
    seen = found[best] > found[_COARSE[0]] + _CLEAR
    return Slow(float(np.sqrt(squares.mean())), seen, times[order], squares)


def _scale(fits: Sequence[chain.Fit], factor: float) -> float:
    """Return a scale of the increments of the offset: the same for all parts of a drive."""
    return factor * float(np.median([fit.sigma[chain.OFFSET] for fit in fits]))
