"""The common clock of one drive: fixes as nodes, sensors averaged over the steps between them.

Every estimator of this package works on the same `Grid`. Its nodes are the fixes, thinned to at least 0.19 s apart
(5 Hz), and, where fixes are further apart than the sensors allow, nodes in between. Speed and yaw rate are averaged
over each step (their integral by the trapezoid rule, divided by the step), after they have been put right by what is
known of the sensors (`Calibration`). Where a sensor was silent its mean is an interpolation, of the yaw rate one that
goes back to 0; `speed_sd` and `yaw_rate_sd` say how wrong that may be.
"""

from bisect import bisect_left
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadLog, BadValue
from halfwidth.vehicle.frames import Frame
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.sensors import AS_LOGGED, Calibration

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Fixes closer together than this are thinned out, s.
MIN_STEP = 0.19

#: Longest row of nodes put into one pause between fixes; longer pauses get longer steps.
MAX_NODES = 3000

#: A course between two samples this far apart at most is turned evenly; else one this near is that of the node, s.
_APART, _CLOSE = 1.2, 0.06

#: How fast a car changes its mind while a sensor is silent: m/s^2 and rad/s^2, up to m/s and rad/s.
DRIFT = {"speed": (1.5, 10.0), "yaw_rate": (0.15, 0.3)}

#: A speed lasts and a turn ends: a yaw rate goes back to 0 within so many seconds of silence; samples of that, s.
_LASTS, _EVERY = {"speed": np.inf, "yaw_rate": 3.0}, 0.25


@dataclass(frozen=True, eq=False)
class Grid:
    """One drive, or a part of it, on one clock.

    Parameters
    ----------
    t : (T,) array
        Time of each node, s, strictly increasing.
    east, north : (T,) arrays
        Fixes in metres of `frame`; whatever stands where `seen` is False is not used.
    seen : (T,) bool array
        Whether the node has a fix.
    course : (T,) array
        Course over ground that the receiver gave at the node, rad; NaN where it gave none.
    speed, yaw_rate : (T,) arrays
        Mean over the step that ends in the node, m/s and rad/s; the first repeats the second.
    speed_sd, yaw_rate_sd : (T,) arrays
        Standard deviation of those means where the sensor was silent, 0 where it spoke.
    has_speed, has_yaw_rate : bool
        Whether the log has the sensor at all; without it the means are 0.
    frame : Frame
    second : (T, 2) array or None
        East and north of a second antenna's fixes at the nodes, NaN where there is none.
    height : (T,) array or None
        Height of the fixes, m, NaN where there is none.
    steps : mapping of str to float
        Quantisation steps of the streams that have one.
    """

    t: Floats
    east: Floats
    north: Floats
    seen: Mask
    course: Floats
    speed: Floats
    yaw_rate: Floats
    speed_sd: Floats
    yaw_rate_sd: Floats
    has_speed: bool
    has_yaw_rate: bool
    frame: Frame
    second: Floats | None = None
    height: Floats | None = None
    steps: Mapping[str, float] = field(default_factory=dict)

    def __len__(self) -> int:
        return int(self.t.size)

    @property
    def h(self) -> Floats:
        """(T,) array: the step that ends in each node, s; the first repeats the second."""
        step = np.diff(self.t)
        return np.concatenate((step[:1] if step.size else np.ones(1), step))

    def between(self, t0: float, t1: float) -> "Grid":
        """Return the nodes of ``t0 <= t <= t1``."""
        return self.rows(slice(int(np.searchsorted(self.t, t0)), int(np.searchsorted(self.t, t1, side="right"))))

    def rows(self, rows: slice) -> "Grid":
        """Return a stretch of nodes."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _ARRAYS if getattr(self, name) is not None})

    def without(self, t0: float, t1: float) -> "Grid":
        """Return the grid with fixes and courses of ``t0 <= t <= t1`` hidden."""
        return self.masked((self.t >= t0) & (self.t <= t1))

    def masked(self, hidden: Mask, silent: Iterable[str] = ()) -> "Grid":
        """Return the grid with the fixes and courses of some nodes, (T,), hidden.

        The sensors named in `silent`, ``"speed"`` or ``"yaw_rate"``, are taken away there as well: their means are
        interpolated from node to node around it, as `sampled` does where a log lacks them.
        """
        grid = replace(self, seen=self.seen & ~hidden, course=np.where(hidden, np.nan, self.course))
        if self.second is not None:
            grid = replace(grid, second=np.where(hidden[:, None], np.nan, self.second))
        if self.height is not None:
            grid = replace(grid, height=np.where(hidden, np.nan, self.height))
        for name in silent:
            if getattr(self, f"has_{name}"):
                mean, sd = _silenced(self.t, hidden, getattr(self, name), getattr(self, f"{name}_sd"), name)
                changed: dict[str, Any] = {name: mean, f"{name}_sd": sd}
                grid = replace(grid, **changed)
        return grid


_ARRAYS = ("t", "east", "north", "seen", "course", "speed", "yaw_rate", "speed_sd", "yaw_rate_sd", "second", "height")


def sampled(
    log: Log,
    *,
    clock_offset: float = 0.0,
    frame: Frame | None = None,
    sensors: Calibration = AS_LOGGED,
    second: Log | None = None,
) -> Grid:
    """Put a log on one clock.

    Parameters
    ----------
    log : Log
    clock_offset : float
        Seconds to add to the time stamps of speed and yaw rate so that they agree with those of the fixes: positive
        where a fix comes later than the sensors that saw the same moment.
    frame : Frame, optional
        Local axes; `Frame.of` the log if absent.
    sensors : Calibration
        What is known of the sensors, each put right by it. Where it knows the place of the antenna, the nodes are
        those of the axle: `Calibration.arm` leads back.
    second : Log, optional
        Fixes of a second antenna, on the clock of the first one's.

    Returns
    -------
    Grid

    Raises
    ------
    BadLog
        If the log has no fix.
    BadValue
        If `clock_offset` is not a finite number.
    """
    if not np.isfinite(clock_offset):
        raise BadValue(f"`clock_offset` is {clock_offset!r}, a finite number of seconds is expected", hint="0.0")
    fixed = np.flatnonzero(log.fixed)
    if fixed.size == 0:
        raise BadLog("the log has no fix, at least one position is expected", hint="halfwidth check LOG")
    frame = Frame.of(log) if frame is None else frame
    kept = fixed[_thinned(log.t[fixed])]
    t_fix = log.t[kept]
    streams = {name: _spoken(*sensors.stream(log, name)) for name in DRIFT}
    t = _nodes(log, t_fix, [clock for clock, _ in streams.values()])
    at = np.searchsorted(t, t_fix)
    T = t.size
    east, north, seen = np.zeros(T), np.zeros(T), np.zeros(T, dtype=bool)
    east[at], north[at] = frame.to_local(log.lat_deg[kept], log.lon_deg[kept])
    seen[at] = True
    arm_east, arm_north = sensors.arm(t)
    streams = {name: (clock + clock_offset, values) for name, (clock, values) in streams.items()}
    sd = {name: silence(t, clock, *DRIFT[name]) for name, (clock, _) in streams.items()}
    return Grid(
        t=t,
        east=east - arm_east,
        north=north - arm_north,
        seen=seen,
        course=_course(*sensors.stream(log, "azimuth"), t, seen),
        speed=means(t, *streams["speed"]),
        yaw_rate=means(t, *bridged(*streams["yaw_rate"])),
        speed_sd=sd["speed"],
        yaw_rate_sd=sd["yaw_rate"],
        has_speed=streams["speed"][0].size > 0,
        has_yaw_rate=streams["yaw_rate"][0].size > 0,
        frame=frame,
        second=None if second is None else _beside(second, t, seen, frame) - np.column_stack((arm_east, arm_north)),
        height=_at_nodes(*log.stream("alt_m"), t, seen),
        steps=dict(sensors.steps),
    )


def _beside(log: Log, t: Floats, seen: Mask, frame: Frame) -> Floats:
    """Return east and north (T, 2) of another log's fixes at the nodes that have one; NaN where it has none."""
    fixed = log.fixed
    places = frame.to_local(log.lat_deg[fixed], log.lon_deg[fixed])
    return np.column_stack([_at_nodes(log.t[fixed], values, t, seen) for values in places])


def _at_nodes(clock: Floats, values: Floats, t: Floats, seen: Mask) -> Floats:
    """Return a stream at the nodes with a fix, interpolated between samples that are close together; NaN elsewhere."""
    if clock.size == 0:
        return np.full(t.size, np.nan)
    k = np.clip(np.searchsorted(clock, t), 1, max(clock.size - 1, 1))
    left, right = np.maximum(k - 1, 0), np.minimum(k, clock.size - 1)
    nearest = np.minimum(np.abs(t - clock[left]), np.abs(clock[right] - t))
    between = (t >= clock[left]) & (t <= clock[right]) & (clock[right] - clock[left] <= _APART)
    return np.where(seen & (between | (nearest <= _CLOSE)), np.interp(t, clock, values), np.nan)


def _thinned(t: Floats) -> list[int]:
    """Return the fixes that are at least MIN_STEP after the one kept before."""
    times = t.tolist()
    kept = [0]
    while True:
        k = bisect_left(times, times[kept[-1]] + MIN_STEP - 1e-9, kept[-1] + 1)
        if k >= len(times):
            return kept
        kept.append(k)


def _spoken(clock: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return a stream, without its sample if it has one only: that says nothing of the rest of a drive."""
    return (clock, values) if clock.size > 1 else (clock[:0], values[:0])


def _nodes(log: Log, t_fix: Floats, clocks: list[Floats]) -> Floats:
    """Return the fixes and, in longer pauses, nodes as often as the sensors spoke, but not above 5 Hz."""
    usual = [float(np.median(np.diff(clock))) for clock in (t_fix, *clocks) if clock.size > 1]
    step = max(0.2, min(usual)) if usual else 1.0
    marks = np.unique(np.concatenate((log.t[:1], t_fix, log.t[-1:])))
    pause = np.diff(marks)
    inside = np.minimum(np.ceil(pause / step * (1 - 1e-6)) - 1, MAX_NODES)
    inside[pause <= 1.5 * step] = 0
    n = inside.astype(int)
    first = np.repeat(marks[:-1], n)
    k = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n) + 1
    return np.sort(np.concatenate((marks, first + k * np.repeat(pause / (n + 1), n))))


def means(t: Floats, clock: Floats, values: Floats) -> Floats:
    """Return the mean of a sensor over each step.

    Parameters
    ----------
    t : (T,) array
        Nodes, s.
    clock, values : (n,) arrays
        Times, s, and samples.

    Returns
    -------
    (T,) array
        Over the step that ends in each node; the first repeats the second.
    """
    if clock.size == 0 or t.size < 2:
        return np.full(t.size, float(values.mean()) if clock.size else 0.0)
    if clock.size == 1:
        clock, values = np.array([clock[0], clock[0] + 1e-3]), np.repeat(values, 2)
    step = np.diff(clock)
    area = np.concatenate(([0.0], np.cumsum(step * (values[1:] + values[:-1]) / 2)))
    k = np.clip(np.searchsorted(clock, t, side="right") - 1, 0, clock.size - 2)
    into = np.clip(t - clock[k], 0.0, step[k])
    total = area[k] + into * (values[k] + 0.5 * into * (values[k + 1] - values[k]) / step[k])
    # beyond its ends the sensor is taken to stay where it was
    total += np.minimum(t - clock[0], 0.0) * values[0] + np.maximum(t - clock[-1], 0.0) * values[-1]
    mean = np.diff(total) / np.diff(t)
    return np.concatenate((mean[:1], mean))


def bridged(clock: Floats, yaw_rate: Floats) -> tuple[Floats, Floats]:
    """Return a yaw rate with samples where it was silent: it goes back to 0 and comes from there.

    A straight line from one turn to the next would turn for the whole silence, a full circle in half a minute.

    Parameters
    ----------
    clock, yaw_rate : (n,) arrays
        Times, s, and samples, rad/s.

    Returns
    -------
    clock, yaw_rate : (m,) arrays
    """
    if clock.size < 2:
        return clock, yaw_rate
    lasts = _LASTS["yaw_rate"]
    step = np.diff(clock)
    long = np.flatnonzero(step > silent_from(step))
    away = np.arange(_EVERY, 6.0 * lasts, _EVERY)
    left = np.exp(-away / lasts) * (away < away[-1])
    times = [clock[0] - away[::-1], clock, clock[-1] + away]
    values = [yaw_rate[0] * left[::-1], yaw_rate, yaw_rate[-1] * left]
    for k in long.tolist():
        since = np.linspace(0.0, step[k], max(2, min(int(step[k] / _EVERY) + 1, MAX_NODES)))[1:-1]
        times.append(clock[k] + since)
        values.append(_bridge(since, np.full(since.size, step[k]), yaw_rate[k], yaw_rate[k + 1], lasts))
    t, rate = np.concatenate(times), np.concatenate(values)
    order = np.argsort(t, kind="stable")
    return t[order], rate[order]


def _bridge(since: Floats, length: Floats, first: Floats | float, last: Floats | float, lasts: float) -> Floats:
    """Return what a quantity is expected to be in a silence between two values, which it forgets in `lasts` seconds."""
    if not np.isfinite(lasts):
        return np.asarray(first + (last - first) * since / length)

    def share(left: Floats) -> Floats:  # sinh(left / lasts) / sinh(length / lasts), however long
        return np.asarray(np.exp((left - length) / lasts) * np.expm1(-2 * left / lasts) / np.expm1(-2 * length / lasts))

    return np.asarray(first * share(length - since) + last * share(since))


def silent_from(step: Floats) -> float:
    """Return how long a step between two samples must be to be a silence, s."""
    return max(3.0 * float(np.median(step)), 0.5)


def between(middle: Floats, h: Floats, clock: Floats, rate: float, most: float) -> tuple[Floats, Floats]:
    """Return the standard deviation of each step's mean by how far samples are, and the time between these, s.

    The steps of one silence err together, while an estimator takes them as independent. So each is given the share of
    variance that makes the whole silence come out right: sd^2 * (length of the silence) / (length of the step).

    Parameters
    ----------
    middle, h : (T,) arrays
        Middle and length of each step, s.
    clock : (n,) array
        Times of the samples, s.
    rate, most : float
        How fast the quantity changes, a second, and by how much at most.
    """
    k = np.searchsorted(clock, middle)
    before, after = clock[np.maximum(k - 1, 0)], clock[np.minimum(k, clock.size - 1)]
    outside = (k == 0) | (k == clock.size)
    far = np.where(
        outside, np.abs(middle - np.where(k == 0, after, before)), np.minimum(middle - before, after - middle)
    )
    length = np.where(outside, 2 * far, after - before)
    return np.minimum(rate * far, most) * np.sqrt(np.maximum(length / h, 1.0)), length


def silence(t: Floats, clock: Floats, rate: float, most: float, limit: float | None = None) -> Floats:
    """Return the standard deviation of each step's mean where the sensor was silent for long (`between`), else 0.

    Parameters
    ----------
    t : (T,) array
        Nodes, s.
    clock : (n,) array
        Times of the samples, s.
    rate, most : float
        How fast the quantity changes while the sensor is silent, a second, and by how much at most.
    limit : float, optional
        How long a step between two samples must be to be a silence, s; `silent_from` the samples if absent.

    Returns
    -------
    (T,) array
    """
    if clock.size < 2 or t.size < 2:
        return np.zeros(t.size)
    limit = silent_from(np.diff(clock)) if limit is None else limit
    middle = t.copy()
    middle[1:] -= np.diff(t) / 2
    h = np.concatenate((np.diff(t)[:1], np.diff(t)))
    sd, length = between(middle, h, clock, rate, most)
    return np.where(length > limit, sd, 0.0)


def _silenced(t: Floats, hidden: Mask, mean: Floats, sd: Floats, name: str) -> tuple[Floats, Floats]:
    """Return means and deviations of a sensor that says nothing from node to node around each hidden stretch."""
    rate, most = DRIFT[name]
    edges = np.flatnonzero(np.diff(np.concatenate(([False], hidden, [False]))))
    h = np.concatenate((np.diff(t)[:1], np.diff(t)))
    middle = t - h / 2
    lost, new = np.zeros(t.size, dtype=bool), sd.copy()
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        start, stop = t[max(a - 1, 0)], t[min(b, t.size - 1)]
        steps = slice(a, b + 1)  # the one that ends in the first node after it as well
        far = np.minimum(middle[steps] - start, stop - middle[steps])
        share = np.sqrt(np.maximum((stop - start) / h[steps], 1.0))
        lost[steps] = True
        new[steps] = np.maximum(sd[steps], np.minimum(rate * np.maximum(far, 0.0), most) * share)
    if lost.all():
        return mean, new
    there = np.flatnonzero(~lost)
    after = np.searchsorted(there, np.arange(t.size))
    a, b = there[np.maximum(after - 1, 0)], there[np.minimum(after, there.size - 1)]
    # before the first and after the last sample it is what it was, and goes on from there
    length = np.where(a < b, middle[b] - middle[a], np.inf)
    since = np.clip(np.abs(middle - middle[a]), 0.0, length)
    alone = mean[a] * np.exp(-since / _LASTS[name])
    inside = _bridge(since, np.where(a < b, length, 1.0), mean[a], mean[b], _LASTS[name])
    return np.where(lost, np.where(a < b, inside, alone), mean), new


def _course(clock: Floats, values: Floats, t: Floats, seen: Mask) -> Floats:
    """Return the receiver's course at the nodes with a fix, on the short way from the sample before to the next."""
    course = np.full(t.size, np.nan)
    if clock.size == 0:
        return course
    k = np.clip(np.searchsorted(clock, t), 1, max(clock.size - 1, 1))
    left = np.maximum(k - 1, 0)
    k = np.minimum(k, clock.size - 1)
    near = np.where(np.abs(clock[k] - t) < np.abs(t - clock[left]), k, left)
    close = seen & (np.abs(clock[near] - t) <= _CLOSE)
    course[close] = values[near[close]]
    between = seen & (t > clock[left]) & (t < clock[k]) & (clock[k] - clock[left] <= _APART)
    turned = np.mod(values[k] - values[left] + np.pi, 2 * np.pi) - np.pi
    share = (t - clock[left])[between] / (clock[k] - clock[left])[between]
    course[between] = values[left][between] + share * turned[between]
    return course
