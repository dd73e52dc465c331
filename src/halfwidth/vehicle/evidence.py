"""What the fixes say about the other streams: units, signs, conventions.

Fixes a few seconds apart give distance and course that owe nothing to any other sensor. Comparing
the distance with the integral of the speed, the course with the azimuth, and the change of course
with the integral of the yaw rate shows a wrong unit or sign as a factor that no sensor error comes
near: 3.6, 57.3, -1. Medians over windows make single bad fixes harmless.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle.log import Log

Floats = NDArray[np.float64]

#: Axes of WGS-84 (m) and its first eccentricity squared.
_A, _E2 = 6378137.0, 6.69437999014e-3

#: Windows a statement rests on, at least.
ENOUGH = 8

#: Windows looked at, at most; more add nothing to a median.
_MOST = 4000


@dataclass(frozen=True)
class Finding:
    """A median over windows.

    Attributes
    ----------
    value : float
        The median; NaN where there are no windows.
    spread : float
        Half the distance between the quartiles.
    n : int
        Windows.
    """

    value: float
    spread: float
    n: int

    @property
    def enough(self) -> bool:
        """Whether enough windows were there."""
        return self.n >= ENOUGH


def _finding(values: Floats) -> Finding:
    values = values[np.isfinite(values)]
    if values.size == 0:
        return Finding(float("nan"), float("nan"), 0)
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    return Finding(float(middle), float(high - low) / 2, int(values.size))


def local_metres(lat_deg: Floats, lon_deg: Floats) -> tuple[Floats, Floats]:
    """Lay positions out in metres east and north of their median; good to 1e-3 over 100 km."""
    if lat_deg.size == 0:
        return lat_deg, lon_deg
    lat0, lon0 = float(np.median(lat_deg)), float(np.median(lon_deg))
    across = 1 - _E2 * np.sin(np.radians(lat0)) ** 2
    north = np.radians(lat_deg - lat0) * _A * (1 - _E2) / across**1.5
    turned = (lon_deg - lon0 + 180) % 360 - 180
    east = np.radians(turned) * _A / np.sqrt(across) * np.cos(np.radians(lat_deg))
    return east, north


@dataclass(frozen=True)
class Windows:
    """Pairs of fixes a baseline apart.

    Attributes
    ----------
    start, stop : (n,) arrays
        Times of the two fixes, s.
    distance : (n,) array
        Straight line between them, m.
    course : (n,) array
        Its direction, rad, clockwise from north.
    """

    start: Floats
    stop: Floats
    distance: Floats
    course: Floats


def baseline(log: Log, least: float) -> float:
    """Return how long windows have to be, s: `least`, or the usual step between fixes where these come less often."""
    t = log.t[log.fixed]
    return max(least, float(np.median(np.diff(t)))) if t.size > 1 else least


def windows(log: Log, baseline: float, *, swapped: bool = False) -> Windows:
    """Pair every fix with the first one at least `baseline` seconds later, at most twice as late."""
    seen = log.fixed
    t = log.t[seen]
    lat, lon = log.lat_deg[seen], log.lon_deg[seen]
    east, north = local_metres(lon, lat) if swapped else local_metres(lat, lon)
    first = np.arange(0, t.size, max(1, t.size // _MOST))
    second = np.searchsorted(t, t[first] + baseline * (1 - 1e-6))
    good = second < t.size
    first, second = first[good], second[good]
    good = t[second] - t[first] <= 2 * baseline
    first, second = first[good], second[good]
    dx, dy = east[second] - east[first], north[second] - north[first]
    return Windows(t[first], t[second], np.hypot(dx, dy), np.arctan2(dx, dy))


def integral(t: Floats, values: Floats, start: Floats, stop: Floats) -> Floats:
    """Integrate a sampled stream over windows by the trapezoidal rule.

    A window that reaches beyond the samples, or over a pause of more than a second and three of
    the usual steps, gives NaN.
    """
    return integrals(t, values, start, stop, np.zeros(1))[:, 0]


def integrals(t: Floats, values: Floats, start: Floats, stop: Floats, late: Floats) -> Floats:
    """Integrate a stream whose samples came so many seconds (L,) later, over windows (n,), as `integral`: (n, L)."""
    out = np.full((start.size, late.size), np.nan)
    if t.size < 2:
        return out
    step = np.diff(t)
    total = np.concatenate(([0.0], np.cumsum(step * (values[1:] + values[:-1]) / 2)))
    pause = np.concatenate(([0.0], np.cumsum(step > max(1.0, 3 * float(np.median(step))))))

    def upto(clock: Floats, k: NDArray[np.intp], when: Floats) -> Floats:  # the running integral between samples
        k = k.clip(0, t.size - 2)
        part = when - clock[k]
        return np.asarray(total[k] + part * (values[k] + (values[k + 1] - values[k]) / step[k] * part / 2))

    for i in range(late.size):
        clock = t + late[i]
        first, last = (np.searchsorted(clock, when, side="right") - 1 for when in (start, stop))
        # a window that ends with a sample does not reach into the step after it
        reached = np.where(clock[last] < stop, last + 1, last).clip(0, t.size - 1)
        good = (start >= clock[0]) & (stop <= clock[-1]) & (pause[reached] == pause[first.clip(0)])
        out[good, i] = (upto(clock, last, stop) - upto(clock, first, start))[good]
    return out


def _moving(log: Log, baselines: tuple[float, ...], least: float, *, swapped: bool = False) -> Windows | None:
    """Give windows long enough that the fixes' own error hardly matters."""
    for baseline in baselines:
        found = windows(log, baseline, swapped=swapped)
        far = found.distance >= least
        if int(far.sum()) >= ENOUGH:
            return Windows(found.start[far], found.stop[far], found.distance[far], found.course[far])
    return None


def speed_ratio(log: Log, *, swapped: bool = False) -> Finding:
    """Give the logged speed over the speed between fixes: 1 where units agree.

    3.6 means km/h where m/s is claimed, 2.24 mph, 1.94 knots; a factor of a thousand means that
    the times are in another unit.
    """
    t, speed = log.stream("speed_mps")
    found = _moving(log, (2.0, 5.0, 10.0, 30.0), 12.0, swapped=swapped)
    if found is None:  # a wrong time unit stretches or squeezes the baseline
        found = _moving(log, (0.002, 0.02, 2e3, 1e4, 2e6, 1e7, 2e9, 1e10), 12.0, swapped=swapped)
    if found is None:
        return _finding(np.empty(0))
    return _finding(integral(t, np.abs(speed), found.start, found.stop) / found.distance)


@dataclass(frozen=True)
class Turning:
    """How the change of course follows the yaw rate.

    Attributes
    ----------
    slope : float
        Change of course over minus the integral of the yaw rate; NaN where nothing is known.
    correlation : float
        Of the two, over all windows.
    n : int
        Windows in which the car turned by at least 0.15 rad.
    """

    slope: float
    correlation: float
    n: int

    @property
    def enough(self) -> bool:
        """Whether the car turned often enough, and clearly enough, to say anything."""
        return self.n >= ENOUGH and abs(self.correlation) > 0.6


def turning(log: Log) -> Turning:
    """Compare changes of course with the yaw rate.

    The slope is 1 where unit and sign are right, -1 where the sign is wrong, 0.01745 where the unit
    is deg/s. Of several baselines the one with the clearest answer counts: short ones drown in the
    fixes' error, long ones cut the corners.
    """
    t, rate = log.stream("yaw_rate_radps")
    best = Turning(float("nan"), 0.0, 0)
    if t.size < 2:
        return best
    for baseline in (1.0, 2.0, 4.0):
        start, stop, turned = turns(log, baseline)
        expected = -integral(t, rate, start, stop)
        known = np.isfinite(expected)
        expected, turned = expected[known], turned[known]
        n = int((np.abs(turned) > 0.15).sum())
        if n < ENOUGH or not np.ptp(expected) > 0:
            continue
        slope, correlation = _line(expected, turned)
        off = np.abs(turned - slope * expected)
        calm = off <= 6 * float(np.median(off)) + 1e-12  # course of a standing car is anything
        if int(calm.sum()) >= ENOUGH and np.ptp(expected[calm]) > 0:
            slope, correlation = _line(expected[calm], turned[calm])
        if abs(correlation) > abs(best.correlation):
            best = Turning(slope, correlation, n)
    return best


def _line(x: Floats, y: Floats) -> tuple[float, float]:
    """Fit y = a + slope x and give slope and correlation."""
    dx, dy = x - x.mean(), y - y.mean()
    sxy, sxx, syy = float(dx @ dy), float(dx @ dx), float(dy @ dy)
    return sxy / sxx, sxy / float(np.sqrt(sxx * syy)) if syy > 0 else 0.0


def turns(log: Log, baseline: float) -> tuple[Floats, Floats, Floats]:
    """Give changes of course between successive chords, from the middle of one to that of the next."""
    found = windows(log, baseline)
    far = found.distance >= max(3.0, 2.0 * baseline)
    start, stop, course = found.start[far], found.stop[far], found.course[far]
    follower = np.searchsorted(start, stop - 1e-6)
    first = np.flatnonzero(follower < start.size)
    second = follower[first]
    near = start[second] - stop[first] < 0.5
    first, second = first[near], second[near]
    turned = wrapped(course[second] - course[first])
    # the chord's course is the car's course half way along it
    before, after = (start[first] + stop[first]) / 2, (start[second] + stop[second]) / 2
    real = np.abs(turned) < 2.5
    return before[real], after[real], turned[real]


#: Ways to write a course, and how each becomes radians clockwise from north.
CONVENTIONS: Mapping[str, Callable[[Floats], Floats]] = {
    "radians clockwise from north": lambda a: a,
    "degrees clockwise from north": np.radians,
    "radians counter-clockwise from east": lambda a: np.pi / 2 - a,
    "degrees counter-clockwise from east": lambda a: np.pi / 2 - np.radians(a),
    "radians counter-clockwise from north": lambda a: -a,
    "degrees counter-clockwise from north": lambda a: -np.radians(a),
    "radians clockwise from south": lambda a: a + np.pi,
    "degrees clockwise from south": lambda a: np.radians(a) + np.pi,
}


def course_errors(log: Log, *, swapped: bool = False) -> dict[str, Finding]:
    """Give the distance between azimuth and course between fixes under each convention, rad."""
    t, azimuth = log.stream("azimuth_rad")
    found = _moving(log, (1.0, 2.0, 5.0), 5.0, swapped=swapped)
    if found is None or t.size == 0:
        return {name: _finding(np.empty(0)) for name in CONVENTIONS}
    middle = (found.start + found.stop) / 2
    nearest = np.searchsorted(t, middle).clip(1, max(t.size - 1, 1))
    nearest = np.where(
        np.abs(t[nearest - 1] - middle) < np.abs(t[nearest.clip(max=t.size - 1)] - middle),
        nearest - 1,
        nearest.clip(max=t.size - 1),
    )
    close = np.abs(t[nearest] - middle) < 0.6 * (found.stop - found.start)
    heading, course = azimuth[nearest[close]], found.course[close]
    return {name: _finding(np.abs(wrapped(turn(heading) - course))) for name, turn in CONVENTIONS.items()}


def wrapped(angle: Floats) -> Floats:
    """Bring angles into (-pi, pi]."""
    out: Floats = np.pi - (np.pi - angle) % (2 * np.pi)
    return out


def impossible_fixes(t: Floats, lat_deg: Floats, lon_deg: Floats, top_speed: float, slack: float) -> NDArray[np.bool_]:
    """Find fixes that no plausible speed connects with the rest.

    Fixes are cut into stretches wherever two neighbours are too far apart; the longest stretch
    stays, and its neighbours stay if they can be reached from what stays.

    Parameters
    ----------
    t, lat_deg, lon_deg : (n,) arrays
        The fixes.
    top_speed : float
        No car is faster, m/s.
    slack : float
        Distance that fix errors explain, m.

    Returns
    -------
    (n,) bool array
        True where a fix is impossible.
    """
    out = np.zeros(t.size, dtype=bool)
    if t.size < 2:
        return out
    east, north = local_metres(lat_deg, lon_deg)

    def reachable(i: int, j: int) -> bool:
        apart = float(np.hypot(east[j] - east[i], north[j] - north[i]))
        return apart <= top_speed * abs(float(t[j] - t[i])) + slack

    step = np.hypot(np.diff(east), np.diff(north))
    cuts = np.flatnonzero(step > top_speed * np.diff(t) + slack) + 1
    if cuts.size == 0:
        return out
    edges = np.concatenate(([0], cuts, [t.size]))
    longest = int(np.argmax(np.diff(edges)))
    last = int(edges[longest + 1]) - 1
    for k in range(longest + 1, edges.size - 1):
        if reachable(last, int(edges[k])):
            last = int(edges[k + 1]) - 1
        else:
            out[edges[k] : edges[k + 1]] = True
    first = int(edges[longest])
    for k in range(longest - 1, -1, -1):
        if reachable(int(edges[k + 1]) - 1, first):
            first = int(edges[k])
        else:
            out[edges[k] : edges[k + 1]] = True
    return out


def spans(flagged: NDArray[np.bool_]) -> list[slice]:
    """Return the runs of neighbours that are flagged."""
    edge = np.diff(np.concatenate(([0], flagged.astype(np.int8), [0])))
    return [slice(a, b) for a, b in zip(np.flatnonzero(edge == 1), np.flatnonzero(edge == -1), strict=True)]


def times_of(t: Floats, flagged: NDArray[np.bool_], off: Floats | None = None) -> str:
    """Say when neighbours (n,) are flagged, and by up to how many metres each run is off, the first five runs."""
    said = []
    runs = spans(flagged)
    for run in runs[:5]:
        first, last = float(t[run][0]), float(t[run][-1])
        when = f"{first:.1f}" if first == last else f"{first:.1f} to {last:.1f}"
        most = 0.0 if off is None else float(off[run].max())
        said.append(when if off is None else f"{when} s by up to {most:{'.0f' if most > 100 else '.2g'}} m")
    return ", ".join(said) + (", ..." if len(runs) > 5 else "") + (" s" if off is None else "")


def off_line(t: Floats, lat_deg: Floats, lon_deg: Floats, flagged: NDArray[np.bool_]) -> Floats:
    """Return how far fixes (n,) are off the straight line in time between those that are not flagged, m."""
    east, north = local_metres(lat_deg, lon_deg)
    kept = ~flagged
    if not kept.any():
        return np.zeros(t.size)
    return np.hypot(east - np.interp(t, t[kept], east[kept]), north - np.interp(t, t[kept], north[kept]))
