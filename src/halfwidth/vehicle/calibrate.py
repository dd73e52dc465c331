"""How far to trust an interval: hide fixes of the log itself, see how often the interval holds, widen it until it does.

A model's variance in a gap is too small where its errors are not as independent as it takes them (measured on real
logs: a 90 % interval held 45 to 98 % of hidden fixes). So stretches of the log that do have fixes are hidden, many at
once and far enough apart, filled with what was learnt, and compared. For each hidden fix there is a factor on the
standard deviation that would just have covered it; the wanted quantile of these factors is the inflation. With n
independent errors the quantile is taken at ``level (n + 1) / n``, the correction of split conformal prediction, so
that few stretches give a wide interval and not a lucky one; each stretch counts as four (two axes, two halves), and
as one where a sensor is missing. This is an observed frequency on this log, no guarantee.

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

Floats = NDArray[np.float64]

#: Lengths at most at which the log is tested, and shifted repetitions of each test.
MOST_LENGTHS, PHASES = 3, 3

#: Fixes left between hidden stretches and at the ends, s, at least; and stretches needed for a quantile.
BETWEEN, EDGE, FEWEST = 15.0, 3.0, 3

#: Windows cut out of a log to test how far off a path gets beyond the last fix, about, and their fixes, s.
END_WINDOWS, END_CONTEXT = 16, 30.0

#: Nodes of the parts of a log that are tested, about.
MOST_NODES = 20_000

#: Errors of one stretch that count as independent: where sensors carry the path through it, and where what the
#: vehicle did is guessed, so that one wrong guess makes all of the stretch wrong.
_PER_STRETCH, _PER_GUESS = 4, 1

#: Factor on the standard deviation where a log has too few fixes to test it: on real logs thinned to 8 to 12 fixes a
#: model's own 90 % interval held 60 to 80 % of the rest.
UNTESTED = 2.0

#: A test narrows no interval further than by this factor.
LEAST = 0.1

#: Shorter gaps than this are not tested by themselves, s.
_SHORTEST = 1.0


@dataclass(frozen=True)
class Tested:
    """What hiding fixes for one length showed.

    Parameters
    ----------
    length_s : float
        Length of the hidden stretches, s.
    stretches : int
        How many there were.
    mean_m, max_m : float
        Mean error, and mean over stretches of the largest one, m.
    coverage : float
        Share of hidden fixes inside the interval before it was widened, each axis by itself.
    inflation : float
        Factor on the standard deviation that makes the interval hold.
    silent : tuple of str
        Sensors that were hidden together with the fixes.
    by : str
        What filled the stretches.
    half_m : float
        Mean half-width at the hidden fixes with the inflation, m.
    side : str
        ``"both"`` where fixes stand on both sides of the stretches, ``"one"`` beyond the first or last fix.
    """

    length_s: float
    stretches: int
    mean_m: float
    max_m: float
    coverage: float
    inflation: float
    silent: tuple[str, ...] = ()
    by: str = ""
    half_m: float = 0.0
    side: str = "both"


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
    steps = [float(np.median(np.diff(drive.t[drive.seen]))) for drive in drives if drive.seen.sum() > 1]
    if not steps:
        return []
    low, high = max(1.5 * min(steps), _SHORTEST), max(spans) / 5
    if high <= low:
        return []
    shortest, longest = np.clip([gaps.min(), gaps.max()], low, high)
    ends = [shortest, np.sqrt(shortest * longest), longest]
    chosen = [float(ends[0])]
    for end in ends[1:]:
        if end > 1.6 * chosen[-1]:
            chosen.append(float(end))
    return chosen[:MOST_LENGTHS]


def tested(
    drives: Sequence[Grid],
    rerun: Callable[[Sequence[int], Sequence[Grid]], Mapping[str, list[Path]]],
    lengths: Sequence[float],
    level: float,
    z: float,
    silent: tuple[str, ...],
    *,
    guessed: bool,
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

    Returns
    -------
    dict of str to list of Tested
        For each way one for each length that had enough stretches.
    """
    found: dict[str, list[Tested]] = {}
    # a long log is tested on parts of it, evenly spread
    every = max(1, round(sum(len(drive) for drive in drives) / MOST_NODES))
    for length in lengths:
        cases = [
            (i, drive, *hidden)
            for i, drive in list(enumerate(drives))[::every]
            for phase in range(PHASES)
            if (hidden := _hidden(drive, length, phase / PHASES, silent)) is not None
        ]
        if not cases:
            continue
        for by, paths in rerun([case[0] for case in cases], [case[2] for case in cases]).items():
            one = _judged(cases, paths, length, level, z, _PER_GUESS if guessed else _PER_STRETCH)
            if one is not None:
                found.setdefault(by, []).append(replace(one, silent=silent, by=by))
    return found


def _hidden(drive: Grid, length: float, phase: float, silent: tuple[str, ...]) -> tuple[Grid, list[slice]] | None:
    """Hide stretches of one length, evenly spread; return the grid and the nodes of each stretch."""
    t, seen = drive.t, drive.seen
    fixes = t[seen]
    if fixes.size < 5:
        return None
    period = length + max(length, BETWEEN)
    begin = np.arange(fixes[0] + EDGE + phase * period, fixes[-1] - EDGE - length, period)
    usual = float(np.median(np.diff(fixes)))
    moved = np.concatenate(([0.0], np.cumsum(np.abs(drive.speed[1:]) * np.diff(t))))
    mask, stretches = np.zeros(t.size, dtype=bool), []
    for t0 in begin:
        a, b = int(np.searchsorted(t, t0)), int(np.searchsorted(t, t0 + length, side="right"))
        inside = t[a:b][seen[a:b]]
        # a stretch that already lacks fixes is no test, nor is standing still
        whole = inside.size > 0 and inside.size >= 0.8 * length / usual - 1
        moves = not drive.has_speed or moved[min(b, t.size) - 1] - moved[a] > length
        if whole and moves:
            mask[a:b] = True
            stretches.append(slice(a, b))
    return (drive.masked(mask, silent), stretches) if stretches else None


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
        cases = []
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
            one = _judged(cases, paths, length, level, z, _PER_GUESS)
            found += [] if one is None else [replace(one, silent=silent, by=by, side="one")]
    return found


def _evenly(drive: Grid, length: float, n: int) -> list[float]:
    """Return the beginnings of n windows, evenly spread over the fixes of a drive."""
    fixes = drive.t[drive.seen]
    if fixes.size < FEWEST or fixes[-1] - fixes[0] <= END_CONTEXT + length:
        return []
    return [float(t) for t in np.linspace(fixes[0], fixes[-1] - END_CONTEXT - length, n)]


def _judged(
    cases: Sequence[tuple[int, Grid, Grid, list[slice]]],
    paths: Sequence[Path],
    length: float,
    level: float,
    z: float,
    independent: int,
) -> Tested | None:
    factors, means, largest, inside, halves = [], [], [], [], []
    for (_, drive, _, stretches), path in zip(cases, paths, strict=True):
        if not path.finite or path.variance is None:
            continue
        for part in stretches:
            seen = drive.seen[part]
            error = np.column_stack((path.east[part] - drive.east[part], path.north[part] - drive.north[part]))[seen]
            sd = np.sqrt(np.maximum(path.variance[part][seen] + path.fix_variance, 1e-12))
            needed = np.abs(error / (z * sd)).ravel()
            factors.append(needed)
            distance = np.hypot(error[:, 0], error[:, 1])
            means.append(distance.mean())
            largest.append(distance.max())
            inside.append(np.mean(needed <= 1.0))
            halves.append(z * sd.mean())
    n = len(factors)
    if n < FEWEST:
        return None
    inflation = quantile(factors, level, independent)
    return Tested(
        length,
        n,
        float(np.mean(means)),
        float(np.mean(largest)),
        float(np.mean(inside)),
        inflation,
        half_m=inflation * float(np.mean(halves)),
    )


def quantile(needed: Sequence[Floats], level: float, independent: int = _PER_STRETCH) -> float:
    """Return the factor that covers a share of the hidden fixes, each stretch counting the same.

    Parameters
    ----------
    needed : sequence of arrays
        For each stretch the factors that just reach its fixes.
    level : float
        Wanted share.
    independent : int
        Errors of one stretch that count as independent.

    Returns
    -------
    float
    """
    n = len(needed)
    factor = np.concatenate(needed)
    weight = np.concatenate([np.full(one.size, 1.0 / max(one.size, 1)) for one in needed])
    order = np.argsort(factor)
    share = np.cumsum(weight[order]) / n
    at = min(int(np.searchsorted(share, min(level * (1 + 1 / (independent * n)), 1.0 - 1e-9))), factor.size - 1)
    return float(factor[order][at])


def inflation(found: Sequence[Tested], length: Floats, *, least: float = 1.0) -> Floats:
    """Return the factor on the standard deviation for gaps of these lengths.

    Between tested lengths it is interpolated in the logarithm of the length; beyond them the nearest counts. Below
    `least` it is not taken. Without a test it is `UNTESTED`.

    Parameters
    ----------
    found : sequence of Tested
        Ascending lengths.
    length : (n,) array
        s.
    least : float

    Returns
    -------
    (n,) array
    """
    if not found:
        return np.full(np.shape(length), UNTESTED)
    at = np.log([one.length_s for one in found])
    factor = np.maximum([one.inflation for one in found], max(least, LEAST))
    return np.exp(np.interp(np.log(np.maximum(length, 1e-3)), at, np.log(factor)))
