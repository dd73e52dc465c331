"""Errors of fixes that fade: large where a receiver finds its satellites again, gone some seconds later.

The fixes beside a gap are those of the chain plus ``a exp(-s / tau)``, s the seconds from the gap: three numbers. With
the chain's noise learnt without these fixes the residuals r of all fixes, given the past, have a covariance S, and with
the shape D of one tau the gain of the log-likelihood is quadratic in a (generalised least squares):

    gain(a) = a' D' S^-1 r - a' D' S^-1 D a / 2

What S^-1 makes of fixes is what the smoother leaves of them over the variance of a fix, so each tau costs two runs of
the smoother, whatever the number of fixes. The best fade is then held against the receiver's own slow error, which may
jump: with noise and jumps learnt anew with the fade and without it. Inside the gap nothing tells a jump, so one there
is a rival of its own: of two numbers, it moves all fixes on that side and is forgotten as the slow error is.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import chain
from halfwidth.vehicle.chain_rows import in_gap
from halfwidth.vehicle.grid import Grid

Floats = NDArray[np.float64]

#: Time constants, s, that are tried first, and what the best of them is multiplied by then.
_TAU, _FINER = 2.0 ** np.arange(-1.0, 4.0), 2.0 ** np.array([-0.75, -0.5, -0.25, 0.25, 0.5, 0.75])

#: How far off a fade begins, m, a standard deviation of each axis.
_WIDE = 10.0

#: The chain that is asked whether it was a fault or a jump of the slow error.
JUDGE = chain.Chain()

#: Half of the worth is hope enough to look closer.
_HOPE = 0.5


@dataclass(frozen=True)
class Fade:
    """What a fade of the fixes beside a gap would be.

    Parameters
    ----------
    east, north : float
        How far it begins, m.
    tau : float
        Its time constant, s.
    gain : float
        By how much it raises the log-likelihood of the fixes.
    worth : float
        What its three numbers cost: the logarithm of how little of what they could have been is left for them.
    rival : float
        By how much more than it costs a jump of the slow error in the gap raises it; 0 where it does not.
    """

    east: float
    north: float
    tau: float
    gain: float
    worth: float
    rival: float = 0.0

    @property
    def size(self) -> float:
        """How far off it begins, m."""
        return float(np.hypot(self.east, self.north))

    def left(self, since: Floats) -> Floats:
        """Return what is left of it so many seconds from the gap, m."""
        return np.asarray(self.size * np.exp(-since / self.tau))

    def removed(self, drive: Grid, own: NDArray[np.intp], since: Floats) -> Grid:
        """Return a drive without the fade in the fixes of some nodes, so many seconds from the gap."""
        return _moved(drive, own, -np.exp(-since / self.tau)[:, None] * np.array([self.east, self.north]))


def fades(drives: Sequence[Grid], own: Sequence[NDArray[np.intp]], since: Sequence[Floats]) -> list[Fade]:
    """Find the fade that explains the fixes of some nodes best.

    Parameters
    ----------
    drives : sequence of Grid
        What is around each gap.
    own : sequence of (m,) int arrays
        Nodes of a drive whose fixes may fade.
    since : sequence of (m,) arrays
        How many seconds from the gap they are.

    Returns
    -------
    list of Fade
        Gain and rival are those of `likely` where there is hope that the gain exceeds the worth, else 0.
    """
    hidden = [drive.masked(np.isin(np.arange(len(drive)), k)) for drive, k in zip(drives, own, strict=True)]
    learnt = chain.solve(hidden, JUDGE)
    places = [_Place(*place) for place in zip(drives, own, since, learnt, strict=True)]
    found = _best(places, [_TAU] * len(places))
    hope = [i for i, fade in enumerate(found) if fade.gain > _HOPE * fade.worth]
    for i, fade in zip(hope, _best([places[i] for i in hope], [_FINER * found[i].tau for i in hope]), strict=True):
        found[i] = max(found[i], fade, key=lambda one: one.gain - one.worth)
    hope = [i for i in hope if found[i].gain > found[i].worth]
    after = [bool(since[i][0] <= since[i][-1]) for i in hope]
    jumps = jumped([drives[i] for i in hope], [own[i] for i in hope], after, [learnt[i] for i in hope])
    without = [found[i].removed(drives[i], own[i], since[i]) for i in hope]
    said = likely([drives[i] for i in hope] + without + [drive for drive, _ in jumps])
    usual, faded, other = np.array(said).reshape(3, len(hope))
    for n, i in enumerate(hope):
        rival = max(float(other[n] - usual[n]) - jumps[n][1], 0.0)
        found[i] = replace(found[i], gain=float(faded[n] - usual[n]), rival=rival)
    return [fade if i in hope else replace(fade, gain=0.0) for i, fade in enumerate(found)]


def jumped(
    drives: Sequence[Grid], own: Sequence[NDArray[np.intp]], after: Sequence[bool], learnt: Sequence[chain.Fit]
) -> list[tuple[Grid, float]]:
    """Take the best jump of the slow error in a gap off the fixes on one side of it.

    Parameters
    ----------
    drives : sequence of Grid
        What is around each gap.
    own : sequence of (m,) int arrays
        Nodes of doubtful fixes beside it.
    after : sequence of bool
        Whether they are after the gap.
    learnt : sequence of Fit
        The chain without these fixes.

    Returns
    -------
    list of (Grid, float)
        The drive without the jump, and what the two numbers of the jump cost.
    """
    found = []
    for drive, k, later, fit in zip(drives, own, after, learnt, strict=True):
        nodes = np.arange(len(drive))
        side = np.flatnonzero(drive.seen & ((nodes >= k[0]) if later else (nodes <= k[-1])))
        since = np.abs(drive.t[side] - drive.t[k[0 if later else -1]])
        jump = _best_of(_Place(drive, side, since, fit), np.array([JUDGE.memory]))
        found.append((jump.removed(drive, side, since), jump.worth))
    return found


def likely(drives: Sequence[Grid]) -> list[float]:
    """Return the log-likelihood of the fixes of drives under a chain whose offset jumps, but not inside gaps.

    The scales and the weights w of the increments of the offset are learnt first. To the likelihood given the weights
    comes what they cost, (tail / 2) (log w - w + 1) each: with the best weight it is the logarithm of Student's density
    but for a constant. In a gap nothing tells a jump, and what is a fault would hide in one there.
    """
    if not drives:
        return []
    learnt = chain.solve(drives, JUDGE)
    gaps = [in_gap(drive) for drive in drives]
    weights = [np.where(gap, 1.0, fit.weight) for gap, fit in zip(gaps, learnt, strict=True)]
    fits = chain.solve(
        drives,
        replace(JUDGE, tail=np.inf, rounds=2),
        sigma=np.array([fit.sigma for fit in learnt]),
        azimuth=[fit.z[:, chain.AZIMUTH] for fit in learnt],
        weight=weights,
        learn=False,
    )
    costs = [0.5 * JUDGE.tail * float(np.sum(np.log(w[1:]) - w[1:] + 1.0)) for w in weights]
    return [fit.loglik + cost for fit, cost in zip(fits, costs, strict=True)]


@dataclass(frozen=True, eq=False)
class _Place:
    """What is around a gap, the nodes whose fixes may fade, their seconds from the gap, and the chain without them."""

    drive: Grid
    own: NDArray[np.intp]
    since: Floats
    learnt: chain.Fit

    def left(self, drive: Grid, fit: chain.Fit) -> Floats:
        """Return S^-1 (y - expected) of the nodes' fixes, (m, 2): what the smoother leaves over the variance."""
        if not fit.path.status.good:
            return np.full((self.own.size, 2), np.nan)
        left = np.column_stack((drive.east - fit.path.east, drive.north - fit.path.north))[self.own]
        return np.asarray(left / fit.path.fix_variance)


def _best(places: Sequence[_Place], taus: Sequence[Floats]) -> list[Fade]:
    """Return the best fade of each place among some time constants."""
    return [_best_of(place, tau) for place, tau in zip(places, taus, strict=True)]


def _best_of(place: _Place, taus: Floats) -> Fade:
    """Return the best fade of one place: of all places together the chains of a long drive would fill the memory."""
    shapes = np.exp(-place.since / taus[:, None])
    moved = [_moved(place.drive, place.own, shape[:, None] * axis) for shape in shapes for axis in np.eye(2)]
    runs = [place.drive, *moved]
    fits = chain.solve(
        runs,
        chain.Chain(rounds=1, tail=np.inf),
        sigma=np.broadcast_to(place.learnt.sigma, (len(runs), len(chain.GROUPS))),
        azimuth=[place.learnt.z[:, chain.AZIMUTH]] * len(runs),
        weight=[place.learnt.weight] * len(runs),
        learn=False,
    )
    base, *left = (place.left(*solved) for solved in zip(runs, fits, strict=True))
    tried = []
    for k, shape in enumerate(shapes):
        # what is left of a fade of one metre to the east, and to the north: D' S^-1 D
        held = np.array([shape @ (off - base) for off in left[2 * k : 2 * k + 2]])
        tried.append(_fade(shape @ base, 0.5 * (held + held.T), float(taus[k])))
    return max(tried, key=lambda fade: fade.gain - fade.worth)


def _fade(pull: Floats, held: Floats, tau: float) -> Fade:
    """Return the fade of one time constant: of D' S^-1 r (2,) and D' S^-1 D (2, 2)."""
    if not (np.isfinite(pull).all() and np.isfinite(held).all() and np.linalg.eigvalsh(held)[0] > 0):
        return Fade(0.0, 0.0, tau, 0.0, np.inf)
    size = np.linalg.solve(held + np.eye(2) / _WIDE**2, pull)
    gain = float(size @ pull - 0.5 * size @ held @ size)
    given = 0.5 * float(size @ size) / _WIDE**2
    worth = given + 0.5 * float(np.linalg.slogdet(np.eye(2) + held * _WIDE**2)[1]) + float(np.log(_TAU.size))
    return Fade(float(size[0]), float(size[1]), tau, gain, worth)


def _moved(drive: Grid, own: NDArray[np.intp], by: Floats) -> Grid:
    """Return a drive with the fixes of some nodes moved, (m, 2) m."""
    east, north = drive.east.copy(), drive.north.copy()
    east[own] += by[:, 0]
    north[own] += by[:, 1]
    return replace(drive, east=east, north=north)
