"""How far to trust an interval: hide fixes of the log itself, see how often the interval holds, widen it until it does.

Stretches of the log that do have fixes are hidden, many at once and far enough apart, filled with what was learnt, and
compared; `widening` says what the errors at the hidden fixes ask of the intervals in the gaps.

A hidden stretch stands for a gap as long as itself, from fix to fix, with fixes on both sides: none runs into a gap
that the log has, since that would be a longer one.

A gap in which the speed or the yaw rate is silent as well is another thing than one in which they speak: for such gaps
they are hidden together with the fixes. What lies beyond the first or the last fix is tested by windows of the log
whose own beginning or end is hidden. Where nothing can be hidden, the standard deviation is taken `UNTESTED` times.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path
from halfwidth.vehicle.widening import GROUPS, PER_GROUP, PER_GUESS, Tested, asked, independent, sized, tail_of

Floats = NDArray[np.float64]

#: Lengths at most at which the log is tested, each this many times the next; shifted repetitions of each test at most,
#: and stretches that are enough without another one.
MOST_LENGTHS, RATIO, PHASES, ENOUGH = 5, 2.0, 5, 40

#: Fixes that a log needs for a test.
FEWEST_FIXES = 16

#: Fixes left between hidden stretches and at the ends, s, at least; and stretches of one length that are a test.
BETWEEN, EDGE, FEWEST = 15.0, 3.0, 3

#: Fixes of a drive without which nothing of it is hidden.
_FEWEST_HIDDEN = 5

#: Windows cut out of a log to test how far off a path gets beyond the last fix, about, and their fixes, s.
END_WINDOWS, END_CONTEXT = 16, 30.0

#: Nodes of the parts of a log that are tested, about.
MOST_NODES = 20_000

#: Shorter gaps than this are not tested by themselves, s.
_SHORTEST = 1.0


#: Number of a drive, the drive, the drive with stretches hidden, and the nodes of each stretch.
_Case = tuple[int, Grid, Grid, list[slice]]


def lengths_to_test(drives: Sequence[Grid], gaps: Floats) -> list[float]:
    """Choose a few lengths that stand for the gaps of a log and that its fixes can test.

    Parameters
    ----------
    drives : sequence of Grid
    gaps : (n,) array
        Lengths of the gaps, s.

    Returns
    -------
    list of float
        Ascending, s; empty if nothing can be tested.
    """
    spans = [np.ptp(drive.t[drive.seen]) for drive in drives if drive.seen.any()]
    if not spans or gaps.size == 0:
        return []
    if sum(int(drive.seen.sum()) for drive in drives) < FEWEST_FIXES:
        return []
    steps = [float(np.median(np.diff(drive.t[drive.seen]))) for drive in drives if drive.seen.sum() > 1]
    if not steps:
        return []
    low, high = max(1.5 * min(steps), _SHORTEST), max(spans) / 3
    if high <= low:
        return []
    shortest, longest = np.clip([gaps.min(), gaps.max()], low, high)
    ratio = max(RATIO, (longest / shortest) ** (1 / (MOST_LENGTHS - 1)))
    chosen, stretches = [], 0
    for k in range(MOST_LENGTHS):
        length = float(longest / ratio**k)
        # shorter ones than any gap only help where there is no room for many of its length
        if length < low * (1 - 1e-9) or (length < shortest * (1 - 1e-9) and stretches >= ENOUGH):
            break
        chosen.append(length)
        stretches += sum(run.begins(length, 0.0).size for drive in drives for run in _runs(drive, length))
    return chosen[::-1]


def _period(length: float) -> float:
    """Return how far apart hidden stretches of one length begin, s."""
    return length + max(length, BETWEEN)


def tested(
    drives: Sequence[Grid],
    rerun: Callable[[Sequence[int], Sequence[Grid]], Mapping[str, list[Path]]],
    lengths: Sequence[float],
    level: float,
    z: float,
    silent: tuple[str, ...],
    *,
    guessed: bool,
    part: tuple[float, float],
) -> dict[str, list[Tested]]:
    """Hide stretches of each length and see what widening the interval needs.

    Parameters
    ----------
    drives : sequence of Grid
    rerun : function (indices, hidden drives) -> mapping of str to list of Path
        Fills drives of which fixes were hidden, in one or more ways, each with its name; `indices` says which drive
        each comes from.
    lengths : sequence of float
        s.
    level : float
        Wanted share.
    z : float
        Half-width of the interval in standard deviations at that level.
    silent : tuple of str
        Sensors that are hidden with the fixes.
    guessed : bool
        Whether what the vehicle does in a stretch is guessed for lack of a sensor.
    part : (float, float)
        From where to where the sensors are hidden, as shares of a stretch.

    Returns
    -------
    dict of str to list of Tested
        For each way one for each length that had enough stretches.
    """
    by_way: dict[str, list[Tested]] = {}
    # a long log is tested on parts of it, evenly spread
    every = max(1, round(sum(len(drive) for drive in drives) / MOST_NODES))
    parts = list(enumerate(drives))[::every]
    for length in lengths:
        room = sum(float(np.ptp(run.fixes)) for _, drive in parts for run in _runs(drive, length))
        cases: list[_Case] = []
        for phase in range(PHASES):
            if sum(len(case[3]) for case in cases) >= ENOUGH:
                break
            every_part = [(i, drive, _hidden(drive, length, phase / PHASES, silent, part)) for i, drive in parts]
            cases += [(i, drive, *hidden) for i, drive, hidden in every_part if hidden is not None]
        if not cases:
            continue
        for by, paths in rerun([case[0] for case in cases], [case[2] for case in cases]).items():
            one = _judged(cases, paths, length, level, z, PER_GUESS if guessed else PER_GROUP, room)
            if one is not None:
                by_way.setdefault(by, []).append(replace(one, silent=silent, by=by, guessed=guessed, part=part))
    return {by: sized(found, level) for by, found in by_way.items() if _enough(found)}


def _enough(found: Sequence[Tested]) -> bool:
    return max((one.stretches for one in found), default=0) >= FEWEST


def _hidden(
    drive: Grid, length: float, phase: float, silent: tuple[str, ...], part: tuple[float, float] = (0.0, 1.0)
) -> tuple[Grid, list[slice]] | None:
    """Hide stretches of one length, evenly spread; return the grid and the nodes of each stretch."""
    t, seen = drive.t, drive.seen
    runs = _runs(drive, length)
    if not runs:
        return None
    usual = float(np.median(np.diff(t[seen])))
    # from one fix to the next that is left it is as long as a gap of this length: the nodes between them are hidden
    begin = np.concatenate([run.begins(length, phase) for run in runs])
    slack = 1e-3 * usual
    moved = np.concatenate(([0.0], np.cumsum(np.abs(drive.speed[1:]) * np.diff(t))))
    mask, stretches = np.zeros(t.size, dtype=bool), []
    for t0 in begin:
        a, b = int(np.searchsorted(t, t0 + slack)), int(np.searchsorted(t, t0 + length - slack))
        inside = t[a:b][seen[a:b]]
        # a stretch that already lacks fixes is no test, nor is standing still
        whole = inside.size > 0 and inside.size >= 0.8 * length / usual - 1
        moves = not drive.has_speed or moved[min(b, t.size - 1)] - moved[max(a - 1, 0)] > length
        if whole and moves:
            mask[a:b] = True
            stretches.append(slice(a, b))
    if not stretches:
        return None
    lost = np.zeros(t.size, dtype=bool)
    for own in stretches:
        share = (t[own] - t[own][0]) / max(length, 1e-9)
        lost[own] = (share >= part[0] - 1e-9) & (share <= part[1] + 1e-9)
    return drive.masked(lost, silent).masked(mask), stretches


@dataclass(frozen=True, eq=False)
class _Run:
    """Fixes of which none is missing for long, and how much of each side is left alone, s."""

    fixes: Floats
    before: float
    after: float

    def begins(self, length: float, phase: float) -> Floats:
        """Return the fixes at which stretches begin, evenly spread."""
        first, last, period = self.fixes[0] + self.before, self.fixes[-1] - self.after - length, _period(length)
        # where there is room for one only, the phases move it through that
        even = np.arange(first + phase * min(period, max(last - first, 0.0)), last, period)
        return np.asarray(self.fixes[np.searchsorted(self.fixes, even)])


def _runs(drive: Grid, length: float) -> list[_Run]:
    """Divide the fixes of a drive where it lacks more of them than a stretch may lack."""
    fixes = drive.t[drive.seen]
    if fixes.size < _FEWEST_HIDDEN:
        return []
    step = np.diff(fixes)
    usual = float(np.median(step))
    broken = np.flatnonzero(step > max(2.5 * usual, 0.2 * length + usual)) + 1
    beside = max(EDGE, min(BETWEEN, length))
    return [
        _Run(run, beside if k else EDGE, beside if k < broken.size else EDGE)
        for k, run in enumerate(np.split(fixes, broken))
    ]


def tested_ends(
    drives: Sequence[Grid],
    rerun: Callable[[Sequence[int], Sequence[Grid]], list[Path]],
    lengths: Sequence[float],
    level: float,
    z: float,
    silent: tuple[str, ...],
    *,
    by: str,
) -> list[Tested]:
    """Cut windows out of drives, hide the end or the beginning of each, and see what widening the interval needs.

    A path beyond the last fix is held from one side only; no gap says how far off it gets.

    Parameters
    ----------
    drives : sequence of Grid
    rerun : function (indices, hidden windows) -> list of Path
        Fills windows; `indices` says which drive each comes from.
    lengths : sequence of float
        How much is hidden, s.
    level, z, silent
        As in `tested`.
    by : str
        Name of what fills.

    Returns
    -------
    list of Tested
        One for each length that had enough windows.
    """
    found = []
    for length in lengths:
        places = [
            (i, begin, last)
            for i, drive in enumerate(drives)
            for begin in _evenly(drive, length, max(2, END_WINDOWS // len(drives)))
            for last in (True, False)
        ]
        cases: list[_Case] = []
        for i, begin, last in places[:: max(1, len(places) // END_WINDOWS)]:
            window = drives[i].between(begin, begin + END_CONTEXT + length)
            cut = begin + END_CONTEXT if last else begin + length
            mask = window.t > cut if last else window.t < cut
            hidden = window.masked(mask, silent)
            moves = not window.has_speed or float((np.abs(window.speed) * window.h)[mask].sum()) > length
            if window.seen[mask].any() and int(hidden.seen.sum()) > FEWEST and moves:
                at = np.flatnonzero(mask)
                cases.append((i, window, hidden, [slice(int(at[0]), int(at[-1]) + 1)]))
        if len(cases) >= FEWEST:
            paths = rerun([case[0] for case in cases], [case[2] for case in cases])
            one = _judged(cases, paths, length, level, z, PER_GUESS, np.inf)
            found += [] if one is None else [replace(one, silent=silent, by=by, side="one", guessed=True)]
    return sized(found, level) if _enough(found) else []


def _evenly(drive: Grid, length: float, n: int) -> list[float]:
    """Return the beginnings of n windows, evenly spread over the fixes of a drive."""
    fixes = drive.t[drive.seen]
    if fixes.size < FEWEST or fixes[-1] - fixes[0] <= END_CONTEXT + length:
        return []
    return [float(t) for t in np.linspace(fixes[0], fixes[-1] - END_CONTEXT - length, n)]


def _judged(
    cases: Sequence[_Case],
    paths: Sequence[Path],
    length: float,
    level: float,
    z: float,
    each: int,
    room: float,
) -> Tested | None:
    """Compare the paths with the hidden fixes; `room` is how many seconds of fixes the stretches lie in."""
    factors, sds, means, largest, inside, halves = [], [], [], [], [], []
    for (_, drive, _, stretches), path in zip(cases, paths, strict=True):
        if not path.finite or path.variance is None:
            continue
        for part in stretches:
            seen = drive.seen[part]
            error = np.column_stack((path.east[part] - drive.east[part], path.north[part] - drive.north[part]))[seen]
            sd = np.sqrt(np.maximum(path.variance[part][seen] + path.fix_variance, 1e-12))
            needed = np.abs(error / (z * sd)).ravel()
            factors.append(needed)
            sds.append(sd.ravel())
            distance = np.hypot(error[:, 0], error[:, 1])
            means.append(distance.mean())
            largest.append(distance.max())
            inside.append(np.mean(needed <= 1.0))
            halves.append(z * sd.mean())
    n = len(factors)
    if n == 0:
        return None
    groups = GROUPS if each == PER_GROUP else 1
    return Tested(
        length,
        n,
        float(np.mean(means)),
        float(np.mean(largest)),
        float(np.mean(inside)),
        1.0,
        half_m=float(np.mean(halves)),
        asked=asked(factors, sds, level, independent(n, length, room, each), groups),
        tail=tail_of(factors, level),
    )
