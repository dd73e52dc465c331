"""How far to trust an interval: hide fixes of the log itself, see how often the interval holds, widen it until it does.

A model's variance in a gap is too small where its errors are not as independent as it takes them (measured on real
logs: a 90 % interval held 45 to 98 % of hidden fixes). So stretches of the log that do have fixes are hidden, many at
once and far enough apart, filled with what was learnt, and compared. For each hidden fix there is a factor on the
standard deviation that would just have covered it; the wanted quantile of these factors, each stretch counting the
same, is what they ask for.

A log has room for few stretches of a minute and for many of five seconds, and a model may be right about the edges of a
gap, where the error of a fix counts, and wrong about its middle, where the sensors do. So the hidden fixes of each
length are divided into `GROUPS` by the standard deviation s that the model states, and all groups of all lengths are
read together: the logarithm of the factor is taken to be

    log factor(s, L) = a + f(log s) + g(log L)

with a Gaussian, f and g Ornstein-Uhlenbeck processes (`_SIZE`, `_BY_SD`, `_BY_LENGTH`), seen in each group with the
variance of a sample quantile of n Gaussian errors, p (1 - p) / (2 z phi(z))^2 / n. For n a stretch counts as
three in each group (errors at one place of it are alike), or as one where a sensor is missing; groups near each other
share their noise, as they come from the same places. That gives the factor for any s and L, and the variance v of its
logarithm. A scale known from n independent errors has v = 1 / (2 n), and the interval is then Student's: the factor is
multiplied by t(level, 1 / (2 v)) / z, so that few stretches give a wide interval and not a lucky one. This is an
observed frequency on this log, no guarantee.

A hidden stretch stands for a gap as long as itself, from fix to fix, with fixes on both sides: none runs into a gap
that the log has, since that would be a longer one.

A gap in which the speed or the yaw rate is silent as well is another thing than one in which they speak: for such gaps
they are hidden together with the fixes. What lies beyond the first or the last fix is tested by windows of the log
whose own beginning or end is hidden. Where nothing can be hidden, the standard deviation is taken `UNTESTED` times.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path

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

#: Errors of one stretch that count as independent: where sensors carry the path through it (two axes, two halves),
#: those of them in one group (on real logs, by how much the shares inside differ between stretches: from 2 in the group
#: of the largest standard deviations to 5 in that of the smallest), and where what the vehicle did is guessed, so that
#: one wrong guess makes all of the stretch wrong.
_PER_STRETCH, _PER_GROUP, _PER_GUESS = 4, 3, 1

#: Groups of hidden fixes of one length; one where what the vehicle did is guessed.
GROUPS = 4

#: Standard deviations of the logarithm of the factor before anything is tested: of its size, of its change with the
#: stated standard deviation and of that with the length, where sensors carry the path and where what the vehicle did is
#: guessed; the change in either's logarithm over which these are felt.
_SIZE, _BY_SD, _BY_LENGTH, _BY_GUESS, _FELT = 1.0, 0.4, 0.2, 0.6, 1.5

#: Most that the noise of two groups has in common.
_SHARED = 0.95

#: Least degrees of freedom of Student's distribution.
_FEWEST_DEGREES = 2.5

#: Factor on the standard deviation where a log has too few fixes to test it: on real logs thinned to 8 to 12 fixes a
#: model's own 90 % interval held 60 to 80 % of the rest.
UNTESTED = 2.0

#: A test narrows no interval further than by this factor.
LEAST = 0.1

#: Shorter gaps than this are not tested by themselves, s.
_SHORTEST = 1.0


#: Number of a drive, the drive, the drive with stretches hidden, and the nodes of each stretch.
_Case = tuple[int, Grid, Grid, list[slice]]


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
        Factor on the standard deviation that makes the interval hold, all lengths read together; the mean over the
        hidden fixes.
    silent : tuple of str
        Sensors that were hidden together with the fixes.
    by : str
        What filled the stretches.
    half_m : float
        Mean half-width at the hidden fixes with the inflation, m.
    side : str
        ``"both"`` where fixes stand on both sides of the stretches, ``"one"`` beyond the first or last fix.
    asked : tuple of (float, float, float)
        For each group of hidden fixes its standard deviation, m, the factor that it asks for by itself, and how many
        independent errors that rests on.
    guessed : bool
        Whether what the vehicle did was guessed for lack of a sensor: longer gaps are then another thing.
    part : (float, float)
        From where to where these sensors were hidden, as shares of a stretch.
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
    asked: tuple[tuple[float, float, float], ...] = ()
    guessed: bool = False
    part: tuple[float, float] = (0.0, 1.0)


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
            one = _judged(cases, paths, length, level, z, _PER_GUESS if guessed else _PER_GROUP, room)
            if one is not None:
                by_way.setdefault(by, []).append(replace(one, silent=silent, by=by, guessed=guessed, part=part))
    return {by: _sized(found, level) for by, found in by_way.items() if _enough(found)}


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
            one = _judged(cases, paths, length, level, z, _PER_GUESS, np.inf)
            found += [] if one is None else [replace(one, silent=silent, by=by, side="one", guessed=True)]
    return _sized(found, level) if _enough(found) else []


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
    independent: int,
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
    groups = GROUPS if independent == _PER_GROUP else 1
    return Tested(
        length,
        n,
        float(np.mean(means)),
        float(np.mean(largest)),
        float(np.mean(inside)),
        1.0,
        half_m=float(np.mean(halves)),
        asked=_asked(factors, sds, level, _independent(n, length, room, independent), groups),
    )


def _asked(
    needed: Sequence[Floats], sds: Sequence[Floats], level: float, errors: float, groups: int
) -> tuple[tuple[float, float, float], ...]:
    """Divide hidden fixes by their standard deviations, and say what each group asks for; see `Tested.asked`."""
    sd, factor = np.concatenate(sds), np.concatenate(needed)
    weight = np.concatenate([np.full(one.size, 1.0 / (len(needed) * one.size)) for one in needed])
    order = np.argsort(sd, kind="stable")
    group = np.minimum(np.cumsum(weight[order]) * groups * (1 - 1e-9), groups - 1).astype(int)
    found = []
    for k in np.unique(group):
        mine = order[group == k]
        asks = quantile(factor[mine], weight[mine], level, errors)
        found.append((float(np.exp(np.log(sd[mine]).mean())), asks, errors))
    return tuple(found)


def _independent(n: int, length: float, room: float, each: int) -> float:
    """Return how many independent errors there are in n stretches in so many seconds, some of which may overlap."""
    return each * n / max(1.0, n * length / max(room, length))


def factor_for(needed: Sequence[Floats], length: float, level: float, room: float) -> float:
    """Return the factor that stretches of one length ask for in the next one of this length.

    Parameters
    ----------
    needed : sequence of arrays
        For each stretch the factors that just reach its fixes.
    length : float
        Of each stretch, s.
    level : float
        Wanted share.
    room : float
        How many seconds of the log they lie in.

    Returns
    -------
    float
    """
    errors = _independent(len(needed), length, room, _PER_STRETCH)
    weight = np.concatenate([np.full(one.size, 1.0 / one.size) for one in needed])
    asks = quantile(np.concatenate(needed), weight, level, errors)
    one = Tested(length, len(needed), 0.0, 0.0, 0.0, 1.0, asked=((1.0, asks, errors),))
    return float(inflation([one], length, np.ones(1), level, least=0.0)[0])


def _sized(found: Sequence[Tested], level: float) -> list[Tested]:
    """Give each test the factor that all of them together ask for."""
    sized = []
    for one in found:
        sd = np.array([sd for sd, _, _ in one.asked])
        factor = float(inflation(found, one.length_s, sd, level, least=0.0) @ sd / sd.sum())
        sized.append(replace(one, inflation=factor, half_m=one.half_m * factor))
    return sized


def quantile(factor: Floats, weight: Floats, level: float, errors: float) -> float:
    """Return the factor that covers a share of the hidden fixes.

    The largest of few errors is no high quantile: it is then enlarged to the one that is wanted as if the errors were
    Gaussian.

    Parameters
    ----------
    factor, weight : (n,) arrays
        Factors that just reach the fixes, and how much each counts.
    level : float
        Wanted share.
    errors : float
        How many of them are independent.

    Returns
    -------
    float
    """
    order = np.argsort(factor)
    share = np.cumsum(weight[order])
    # the i-th of N errors has median rank (i - 0.3) / (N + 0.4)
    at, beyond = (level * (errors + 0.4) + 0.3) / errors, 1.0
    if at > 1.0:
        beyond = max(1.0, _z(level) / _z(max((errors - 0.3) / (errors + 0.4), 0.5)))
    return beyond * float(np.interp(at, share / share[-1], factor[order]))


def inflation(found: Sequence[Tested], length: float, sd: Floats, level: float, *, least: float = 1.0) -> Floats:
    """Return the factors on standard deviations in a gap.

    Below `least` none is taken. Without a test each is `UNTESTED`.

    Parameters
    ----------
    found : sequence of Tested
    length : float
        Length of the gap, s.
    sd : (n,) array
        Standard deviations, m.
    level : float
        Wanted share.
    least : float

    Returns
    -------
    (n,) array
    """
    groups = [(one.length_s, *asked) for one in found for asked in one.asked]
    if not groups:
        return np.full(np.shape(sd), UNTESTED)
    lengths, sds, asked, errors = np.array(groups).T
    at = np.log(np.column_stack((np.maximum(sds, 1e-9), lengths)))
    to = np.log(np.column_stack((np.maximum(sd, 1e-9), np.full(np.shape(sd), max(length, 1e-3)))))
    z = _z(level)
    by_length = _BY_GUESS if any(one.guessed for one in found) else _BY_LENGTH
    noise = np.sqrt(level * (1 - level) / errors) / (2 * z * NormalDist().pdf(z))

    def apart(x: Floats, y: Floats) -> Floats:
        return np.abs(x[:, None] - y)  # of sd and of length, (n, m, 2)

    def alike(x: Floats, y: Floats) -> Floats:
        return np.asarray(_SIZE**2 + np.exp(-apart(x, y) / _FELT) @ np.array([_BY_SD**2, by_length**2]))

    shared = _SHARED * np.exp(-apart(at, at).sum(axis=-1)) + (1 - _SHARED) * np.eye(noise.size)
    seen = alike(at, at) + np.outer(noise, noise) * shared
    cross = alike(at, to)
    known = np.linalg.solve(seen, cross)
    variance = _SIZE**2 + _BY_SD**2 + by_length**2 - np.einsum("ij,ij->j", known, cross)
    degrees = np.maximum(0.5 / np.maximum(variance, 1e-9), _FEWEST_DEGREES)
    factor = np.exp(np.log(np.maximum(asked, LEAST)) @ known) * _student(level, degrees) / z
    half = np.maximum(factor, max(least, LEAST)) * sd
    # what is stated to be less sure is not shown as surer
    order = np.argsort(sd, kind="stable")
    half[order] = np.maximum.accumulate(half[order])
    return np.asarray(half / np.maximum(sd, 1e-300))


def _z(level: float) -> float:
    return NormalDist().inv_cdf(0.5 + level / 2)


def _student(level: float, degrees: Floats) -> Floats:
    """Return half-widths of Student's intervals by the series in 1 / degrees (Abramowitz and Stegun 26.7.5)."""
    z = _z(level)
    terms = (
        z,
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
    )
    return np.asarray(np.polynomial.polynomial.polyval(1 / degrees, terms))
