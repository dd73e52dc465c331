"""Where fixes of a drive are doubted: at the ends of gaps, and after a step that the sensors did not see."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.pointing import azimuth_of

#: A pause between fixes from this length on may end with wrong ones, s.
GAP = 3.0

#: Fixes are doubted for so long after a gap or jump, and before a gap, s, where the length that speaks the clearest
#: counts.
DOUBTED = (2.0, 6.0, 12.0, 20.0)

#: A jump is a step between fixes that differs from what the sensors say by this many usual differences and metres.
JUMP, JUMP_M = 8.0, 1.0


@dataclass(frozen=True)
class Doubt:
    """Fixes that may be wrong, as numbers among those seen."""

    first: int  # the first one, or the last one if they are doubted backwards
    most: float  # at most so many seconds of them
    block: tuple[int, int]  # fixes without a gap among them
    before: bool  # whether the fixes before them are asked where they should have been
    after: bool  # and those after them
    known: bool = False  # whether others beside them are known to be wrong

    @property
    def backwards(self) -> bool:
        """Whether the trouble ends a stretch of fixes instead of beginning one."""
        return self.before and not self.after

    @property
    def gap(self) -> int:
        """Return which gap a doubt at one of its ends is about: the number of the first fix after it."""
        return self.block[1] if self.backwards else self.block[0]


def at_gaps(grid: Grid, seen: NDArray[np.intp]) -> list[Doubt]:
    """Return the doubts about the first fixes after each gap and the last ones before it."""
    found = []
    blocks = stretches(grid, seen)
    for k, (a, b) in enumerate(blocks):
        half = float(grid.t[seen[b - 1]] - grid.t[seen[a]]) / 2
        if k > 0:
            found.append(Doubt(a, half, (a, b), before=False, after=True))
        if k < len(blocks) - 1:
            found.append(Doubt(b - 1, min(half, DOUBTED[1]), (a, b), before=True, after=False))
    return found


def stretches(grid: Grid, seen: NDArray[np.intp]) -> list[tuple[int, int]]:
    """Return the stretches of fixes without a gap: the first one and the one after the last, among those seen."""
    step = np.diff(grid.t[seen])
    cut = np.flatnonzero(step > max(GAP, 3.0 * float(np.median(step)))) + 1
    return list(pairwise([0, *cut.tolist(), seen.size]))


def after_jumps(grid: Grid, seen: NDArray[np.intp]) -> list[Doubt]:
    """Return the doubts about what follows a step between fixes that the sensors did not see."""
    azimuth = azimuth_of(grid)
    middle = 0.5 * (azimuth + np.concatenate((azimuth[:1], azimuth[:-1])))
    way = grid.speed * grid.h
    moved = np.column_stack((np.cumsum(way * np.sin(middle)), np.cumsum(way * np.cos(middle))))[seen]
    fixes = np.column_stack((grid.east, grid.north))[seen]
    odd = np.hypot(*(np.diff(fixes, axis=0) - np.diff(moved, axis=0)).T)
    jumps = np.flatnonzero(odd > max(JUMP * float(np.median(odd)), JUMP_M)) + 1
    found: list[Doubt] = []
    clear = -np.inf
    for a, b in stretches(grid, seen):
        half = float(grid.t[seen[b - 1]] - grid.t[seen[a]]) / 2
        for j in jumps[(jumps > a) & (jumps < b)].tolist():
            if grid.t[seen[j]] > clear:
                found.append(Doubt(j, half, (a, b), before=True, after=True))
                clear = grid.t[seen[j]] + 1.0
    return found
