"""Fixes that lie where the vehicle cannot have been: after a tunnel, before one, and wherever they jump.

A receiver that finds its satellites again may be off by tens of metres for many seconds, and a path that believes it is
bent all the way through the gap. Dead reckoning over a few seconds is far better than that. So wherever there is reason
to doubt (the first seconds after a gap, the last ones before it, and what follows a jump that the sensors did not see)
the doubtful fixes are hidden, and the chain, with the noise that the drive was found to have, says where they should
have been: after a gap from the fixes after them alone, before it from those before them, so that a gap badly bridged
proves nothing. What is further off than that can be wrong goes, up to the first fix that agrees again. If none agrees
the fixes are believed: then the reckoning is wrong, or they are all that is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import chain
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.sensors import Calibration

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: A pause between fixes from this length on may end with wrong ones, s.
GAP = 3.0

#: Fixes are doubted for so long after a gap or jump, and before a gap, s, where the length that speaks the clearest
#: counts; and what is around them for so long, s.
DOUBTED, AROUND = (2.0, 6.0, 12.0, 20.0), 40.0

#: A fix is stray if it is this many standard deviations off where it should be, and this far, m. The fixes agree again
#: once they are this many off, and must do so for this share of the time in doubt.
FAR, FAR_M, NEAR, AGREED = 4.0, 0.5, 2.0, 0.15

#: A jump is a step between fixes that differs from what the sensors say by this many usual differences and metres.
JUMP, JUMP_M = 8.0, 1.0

#: Doubts that are looked into at most, in one drive; how often, as what fades is seen bit by bit; rounds of the chain.
_MOST, _LOOKS, _ROUNDS = 150, 3, 5

#: Scale and bias are known to this many of their standard deviations, and no better than this.
_KNOWN, _SCALE, _BIAS = 3.0, 0.003, 0.001

#: Fixes that a doubt needs besides those it hides.
_FEWEST = 5


@dataclass(frozen=True, eq=False)
class Strays:
    """Which nodes of a grid have a fix that is not to be used.

    Parameters
    ----------
    at : (n,) int array
        Nodes.
    size : (n,) array
        How far each fix is off, m.
    """

    at: NDArray[np.intp]
    size: Floats

    def masked(self, grid: Grid) -> Grid:
        """Return the grid without these fixes."""
        if not self.at.size:
            return grid
        hidden = np.zeros(len(grid), dtype=bool)
        hidden[self.at] = True
        return grid.masked(hidden)

    def words(self, grid: Grid) -> str:
        """Say which fixes go, when they were and how far they are off; empty if none goes."""
        if not self.at.size:
            return ""
        run = np.concatenate(([0], np.cumsum(np.diff(self.at) > 1)))
        spans = []
        for k in range(int(run[-1]) + 1):
            t, size = grid.t[self.at[run == k]], self.size[run == k]
            when = f"{t[0]:.1f}" if t.size == 1 else f"{t[0]:.1f} to {t[-1]:.1f}"
            spans.append(f"{when} s by up to {size.max():.1f} m")
        more = f" and {len(spans) - 5} more" if len(spans) > 5 else ""
        some = "1 fix lies" if self.at.size == 1 else f"{self.at.size} fixes lie"
        return f"{some} where the vehicle cannot have been and {'is' if self.at.size == 1 else 'are'} left out: " + (
            ", ".join(spans[:5]) + more
        )


_NONE = Strays(np.empty(0, dtype=np.intp), np.empty(0))


def strays(grid: Grid, sensors: Calibration) -> Strays:
    """Find fixes that dead reckoning from the fixes around them contradicts.

    Parameters
    ----------
    grid : Grid
        With the sensors put right.
    sensors : Calibration
        What is known of them.

    Returns
    -------
    Strays
        None where the drive has too few fixes, or no speed or yaw rate to reckon with.
    """
    if int(grid.seen.sum()) < 2 * _FEWEST or not (grid.has_speed and grid.has_yaw_rate and sensors.noise):
        return _NONE
    settings = chain.Chain(
        rounds=_ROUNDS,
        scale_sd=float(np.clip(_KNOWN * sensors.scale_sd, _SCALE, 0.03)),
        bias_sd=float(np.clip(_KNOWN * sensors.bias_sd, _BIAS, 0.01)),
    )
    found = _Found(np.zeros(len(grid)), np.zeros(len(grid), dtype=bool))
    seen = np.flatnonzero(grid.seen)
    gaps, jumps = _gaps(grid, seen), _jumps(grid, seen)
    doubts = gaps[:_MOST]
    for _ in range(_LOOKS):
        doubts = found.look(grid, seen, doubts, settings, sensors)
    # what a stray stretch begins or ends with is a jump, too
    near = np.convolve(found.gone[seen], np.ones(3), mode="same") > 0
    found.look(grid, seen, [doubt for doubt in jumps if not near[doubt.first]][:_MOST], settings, sensors)
    at = np.flatnonzero(found.gone)
    return Strays(at, found.off[at]) if at.size <= 0.3 * seen.size else _NONE


@dataclass(frozen=True)
class _Doubt:
    """Fixes that may be wrong, as numbers among those seen."""

    first: int  # the first one, or the last one if they are doubted backwards
    most: float  # at most so many seconds of them
    block: tuple[int, int]  # fixes without a gap among them
    before: bool  # whether the fixes before them are asked where they should have been
    after: bool  # and those after them

    @property
    def backwards(self) -> bool:
        """Whether the trouble ends a stretch of fixes instead of beginning one."""
        return self.before and not self.after


@dataclass(frozen=True, eq=False)
class _Found:
    """What was found so far, written while looking."""

    off: Floats  # (T,)
    gone: Mask  # (T,)

    def look(
        self,
        grid: Grid,
        seen: NDArray[np.intp],
        doubts: Sequence[_Doubt],
        settings: chain.Chain,
        sensors: Calibration,
    ) -> list[_Doubt]:
        """Ask the fixes before, or after, or both, where the doubtful ones should have been; return what is left."""
        t = grid.t[seen]
        asked, hidden = [], []
        for doubt in doubts:
            for length in DOUBTED:
                lo, hi = np.searchsorted(t, t[doubt.first] + np.array([-length, length]) * (1 + 1e-9)).tolist()
                lo = max(lo, doubt.block[0]) if doubt.backwards else doubt.first
                hi = doubt.first + 1 if doubt.backwards else min(hi, doubt.block[1])
                start = max(doubt.block[0], int(np.searchsorted(t, t[lo] - AROUND)))
                stop = min(doubt.block[1], int(np.searchsorted(t, t[hi - 1] + AROUND)))
                enough = lo - start >= _FEWEST or not doubt.before, stop - hi >= _FEWEST or not doubt.after
                if length > doubt.most or not all(enough):
                    break
                sides = [(start, hi)] * doubt.before + [(lo, stop)] * doubt.after
                parts = [slice(int(seen[a]), int(seen[b - 1]) + 1) for a, b in sides]
                nodes = seen[lo:hi]
                mask = self.gone.copy()
                mask[nodes] = True
                asked.append((doubt, nodes, parts))
                hidden += [grid.rows(part).masked(mask[part]) for part in parts]
        fits = iter(chain.solve(hidden, settings, sigma=np.array(sensors.noise), learn=False) if hidden else [])
        clearest: dict[_Doubt, tuple[float, NDArray[np.intp], Floats]] = {}
        for doubt, nodes, parts in asked:
            off = [_off(grid, nodes, part, next(fits)) for part in parts]
            wrong = _wrong(off, backwards=doubt.backwards) & ~self.gone[nodes]
            if wrong.any():
                distance, sd = off[-1]
                clear = float((distance / sd)[wrong].max())
                if clear > clearest.get(doubt, (0.0,))[0]:
                    clearest[doubt] = clear, nodes[wrong], distance[wrong]
        left = []
        for doubt, (_, nodes, distance) in clearest.items():
            self.off[nodes], self.gone[nodes] = distance, True
            rest = np.flatnonzero(~self.gone[seen[doubt.block[0] : doubt.block[1]]]) + doubt.block[0]
            rest = rest[rest <= doubt.first] if doubt.backwards else rest[rest >= doubt.first]
            if rest.size:
                left.append(replace(doubt, first=int(rest[-1 if doubt.backwards else 0])))
        return left


def _off(grid: Grid, nodes: NDArray[np.intp], part: slice, fit: chain.Fit) -> tuple[Floats, Floats]:
    """Return how far the fixes at some nodes are off a path, and the standard deviation of that, m."""
    path, own = fit.path, nodes - part.start
    if not path.finite or path.variance is None or not path.status.good:
        return np.zeros(nodes.size), np.ones(nodes.size)
    distance = np.hypot(path.east[own] - grid.east[nodes], path.north[own] - grid.north[nodes])
    return distance, np.sqrt(path.variance[own].mean(axis=1) + path.fix_variance)


def _gaps(grid: Grid, seen: NDArray[np.intp]) -> list[_Doubt]:
    """Return the doubts about the first fixes after each gap and the last ones before it."""
    found = []
    blocks = _blocks(grid, seen)
    for k, (a, b) in enumerate(blocks):
        half = float(grid.t[seen[b - 1]] - grid.t[seen[a]]) / 2
        if k > 0:
            found.append(_Doubt(a, half, (a, b), before=False, after=True))
        if k < len(blocks) - 1:
            found.append(_Doubt(b - 1, min(half, DOUBTED[1]), (a, b), before=True, after=False))
    return found


def _blocks(grid: Grid, seen: NDArray[np.intp]) -> list[tuple[int, int]]:
    """Return the stretches of fixes without a gap: the first one and the one after the last, among those seen."""
    step = np.diff(grid.t[seen])
    cut = np.flatnonzero(step > max(GAP, 3.0 * float(np.median(step)))) + 1
    return list(pairwise([0, *cut.tolist(), seen.size]))


def _jumps(grid: Grid, seen: NDArray[np.intp]) -> list[_Doubt]:
    """Return the doubts about what follows a step between fixes that the sensors did not see."""
    azimuth = chain.azimuth_of(grid)
    middle = 0.5 * (azimuth + np.concatenate((azimuth[:1], azimuth[:-1])))
    way = grid.speed * grid.h
    moved = np.column_stack((np.cumsum(way * np.sin(middle)), np.cumsum(way * np.cos(middle))))[seen]
    fixes = np.column_stack((grid.east, grid.north))[seen]
    odd = np.hypot(*(np.diff(fixes, axis=0) - np.diff(moved, axis=0)).T)
    jumps = np.flatnonzero(odd > max(JUMP * float(np.median(odd)), JUMP_M)) + 1
    found: list[_Doubt] = []
    clear = -np.inf
    for a, b in _blocks(grid, seen):
        half = float(grid.t[seen[b - 1]] - grid.t[seen[a]]) / 2
        for j in jumps[(jumps > a) & (jumps < b)].tolist():
            if grid.t[seen[j]] > clear:
                found.append(_Doubt(j, half, (a, b), before=True, after=True))
                clear = grid.t[seen[j]] + 1.0
    return found


def _wrong(off: Sequence[tuple[Floats, Floats]], *, backwards: bool) -> Mask:
    """Return which of the doubted fixes are wrong: from the first on, up to where they agree again.

    They are wrong if all that were asked say so; the last one asked says where they agree.
    """
    far = np.all([(distance > FAR * sd) & (distance > FAR_M) for distance, sd in off], axis=0)
    distance, sd = off[-1]
    near = distance < np.maximum(NEAR * sd, FAR_M)
    if backwards:
        far, near = far[::-1], near[::-1]
    wrong = np.zeros(far.size, dtype=bool)
    if far.any():
        again = int(np.flatnonzero(far)[-1]) + 1
        again += int(np.argmax(near[again:])) if near[again:].any() else far.size
        agreed = near[again:]
        # where they do not agree again for a while, or most before that do, it is no fault that came and went
        if agreed.size >= max(1, AGREED * far.size) and agreed.mean() > 0.8 and (~near[:again]).mean() > 0.5:
            wrong[:again] = ~near[:again] | far[:again]
    return wrong[::-1] if backwards else wrong
