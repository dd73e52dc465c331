"""The outage benchmark: hide fixes of a log, fill the hole, measure how far off the filling is.

Starts are drawn at random and are the same for every method. Only the fixes (and courses) inside the outage are hidden;
speed and yaw rate stay. A start counts only if the vehicle averages more than 1 m/s in the outage, since standing still
is no test. The error is the distance to each hidden fix. A cell of the table is the mean over all hidden fixes and the
mean over starts of the largest error of each outage. `coverage` is the share of hidden fixes, east and north counted
apart, inside the interval at `level` of a method that claims one: its own interval, before `fill` sizes it by what
hiding fixes shows. `held` is the share inside once each outage's interval is sized by the other outages of its length
that do not overlap with it, as `fill` sizes gaps by stretches elsewhere in the log.

Clocks and scales of the sensors are found from the whole log, hidden fixes included: a handful of numbers. Speeds and
yaw rates that leap away or contradict the fixes for a while are put right or left out before, as `fill` does
(`judged`), for no method is made for them; fixes count as they are. A log that was written late is put right as well
(`stamps`), and a fix counts at the time at which it was taken.
"""

from collections.abc import Callable, Mapping, Sequence
from statistics import NormalDist
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadLog, BadValue
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.estimators import METHODS, Method, method, usable
from halfwidth.vehicle.grid import Grid, sampled
from halfwidth.vehicle.judged import sensed
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.outage_table import Cell, Outages
from halfwidth.vehicle.path import Path, sized
from halfwidth.vehicle.stamps import restamped
from halfwidth.vehicle.units import azimuth_put_right

Floats = NDArray[np.float64]

#: Lengths of the outages of the full benchmark, s.
LENGTHS: tuple[float, ...] = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0)

#: Fixes that must be left before and after an outage, s.
MARGIN = 20.0

#: The vehicle must average more than this in an outage, m/s.
MIN_SPEED = 1.0

Progress = Callable[[float, str], None]


def outages(
    log: Any,
    lengths: Sequence[float] = LENGTHS,
    starts: int = 20,
    seed: int = 1,
    methods: Sequence[str] | None = None,
    *,
    clock_offset: float | None = None,
    level: float = 0.9,
    progress: Progress | None = None,
) -> Outages:
    """Hide fixes of a log at random places and measure how well each method fills the hole.

    Parameters
    ----------
    log : Log, path or frame
        As for `fill`.
    lengths : sequence of float
        Lengths of the outages, s.
    starts : int
        Outages of each length.
    seed : int
        Seed of the starts; the same seed gives the same starts, whatever the methods.
    methods : sequence of str, optional
        Names of estimators; all that the log's sensors allow if absent.
    clock_offset : float, optional
        Seconds to add to the time stamps of speed and yaw rate; found from the log, for each by itself, if absent.
    level : float
        Level of the intervals whose coverage is counted.
    progress : function (share, words), optional
        Called with the share done, 0 to 1, and what is being done.

    Returns
    -------
    Outages

    Raises
    ------
    BadValue
        If a length is not positive, `starts` is not a positive whole number, `level` or `clock_offset` is none, a
        method has no such name, or every length is longer than the log allows.
    BadLog
        If the log has fewer than three fixes, the vehicle does not move, or no method of those asked for can use its
        sensors: if nothing at all could be tried.
    """
    from halfwidth.vehicle.fill import as_log, clock_offset_of, level_of

    try:
        given = tuple(float(length) for length in lengths)
    except (TypeError, ValueError):
        given = ()
    if not given or not all(np.isfinite(length) and length > 0 for length in given):
        raise BadValue(f"`lengths` is {lengths!r}, positive numbers of seconds are expected", hint="lengths=(1, 5, 30)")
    if not isinstance(starts, int) or starts < 1:
        raise BadValue(f"`starts` is {starts!r}, a whole number from 1 is expected", hint="starts=20")
    level = level_of(level)
    offset = None if clock_offset is None else clock_offset_of(clock_offset)
    first = sensed(as_log(log)[0], clock=offset is None)
    put_right, said = azimuth_put_right(first.log)
    messages = (*first.messages, *([f"{said}: put right"] if said else []))
    drive_log: Log = restamped(put_right)[0]
    chosen = [method(name) for name in (METHODS if methods is None else methods)]
    sensors = calibrated(drive_log, clock_offset=offset)
    drive = sampled(drive_log, sensors=sensors)
    if int(drive.seen.sum()) < 3:
        n = int(drive.seen.sum())
        raise BadLog(f"the log has {n} fixes, at least 3 are expected to hide some", hint="halfwidth check LOG")
    skipped = {m.name: f"the log has no {lack}" for m in chosen if (lack := m.lacks(drive))}
    usable_methods = [m for m in chosen if m.name not in skipped]
    places = {length: _starts(drive, length, starts, seed) for length in given}
    for length in given:
        if places[length].size == 0:
            skipped[f"{length:g} s"] = "no place in the log has fixes on both sides and a moving vehicle"
        elif places[length].size < starts:
            skipped[f"{length:g} s"] = f"only {places[length].size} of {starts} starts found a place"
    tried = [length for length in given if places[length].size]
    if not usable_methods:
        raise BadLog("; ".join(f"`{m.name}`: {skipped[m.name]}" for m in chosen), hint="methods=('linear', 'cv')")
    if not tried:
        raise _nothing_to_try(drive, given)
    total = len(usable_methods) * len(tried)
    cells: list[Cell] = []
    for m in usable_methods:
        tuned = m.tune(drive) if tried else {}
        for length in tried:
            if progress is not None:
                progress(len(cells) / total, f"{m.name}, {length:g} s")
            cells.append(_cell(drive, m, tuned, length, places[length], level))
    if progress is not None:
        progress(1.0, "done")
    given_offset = float("nan") if offset is None else offset
    known = MappingProxyType(sensors.to_dict())
    return Outages(
        drive_log.source, tuple(cells), level, seed, given_offset, MappingProxyType(skipped), known, messages
    )


def _starts(drive: Grid, length: float, n: int, seed: int) -> Floats:
    """Draw the beginnings of n outages: fixes on both sides, moving inside, the same for every method."""
    rng = np.random.default_rng([seed, round(1000 * length)])
    t = drive.t[drive.seen]
    lo, hi = t[0] + MARGIN, t[-1] - MARGIN - length
    if hi <= lo:
        return np.empty(0)
    moved = np.concatenate(([0.0], np.cumsum(_pace(drive)[1:] * np.diff(drive.t))))
    begin = rng.uniform(lo, hi, 50 * n)
    end = begin + length
    pace = (np.interp(end, drive.t, moved) - np.interp(begin, drive.t, moved)) / length
    hidden = np.searchsorted(t, end, side="right") - np.searchsorted(t, begin)
    before = np.searchsorted(t, begin) - np.searchsorted(t, begin - MARGIN)
    after = np.searchsorted(t, end + MARGIN, side="right") - np.searchsorted(t, end, side="right")
    good = (pace > MIN_SPEED) & (hidden > 0) & (before > 1) & (after > 1)
    return begin[good][:n]


def _nothing_to_try(drive: Grid, lengths: Sequence[float]) -> BadLog | BadValue:
    """Say why no outage of these lengths has a place in the log, and which lengths have."""
    fixes = drive.t[drive.seen]
    span = float(fixes[-1] - fixes[0])
    asked = ", ".join(f"{length:g}" for length in lengths)
    possible = [length for length in LENGTHS if _starts(drive, length, 1, 1).size]
    if not possible:
        return BadLog(
            f"the log has no place for an outage: its fixes span {span:.0f} s, and fixes within {MARGIN:g} s on both"
            f" sides of an outage and a vehicle faster than {MIN_SPEED:g} m/s in it are expected",
            hint="halfwidth check LOG",
        )
    words = ", ".join(f"{length:g}" for length in possible)
    longest = ",".join(f"{length:g}" for length in possible[-3:])
    return BadValue(
        f"`lengths` is {asked} s but the fixes of the log span {span:.0f} s, and {MARGIN:g} s of fixes on both sides of"
        f" an outage in which the vehicle moves are expected: {words} s can be tried",
        hint=f"--lengths {longest}, in Python lengths=({longest},)",
    )


def _pace(drive: Grid) -> Floats:
    """Return the speed over each step: the sensor's, or that of the fixes."""
    if drive.has_speed:
        return np.abs(drive.speed)
    seen = np.flatnonzero(drive.seen)
    east, north = (np.interp(drive.t, drive.t[seen], p[seen]) for p in (drive.east, drive.north))
    step = np.hypot(np.diff(east), np.diff(north)) / np.diff(drive.t)
    return np.concatenate((step[:1], step))


def _cell(drive: Grid, m: Method, tuned: Mapping[str, float], length: float, begin: Floats, level: float) -> Cell:
    from time import perf_counter

    whole = [drive.between(t0 - m.context, t0 + length + m.context) for t0 in begin]
    hidden = [part.without(t0, t0 + length) for part, t0 in zip(whole, begin, strict=True)]
    clock = perf_counter()
    paths = m.run(hidden, tuned)
    seconds = perf_counter() - clock
    z = NormalDist().inv_cdf(0.5 + level / 2)
    means, largest, counts, needed, halves, failed, claims = [], [], [], [], [], 0, True
    for full, part, found in zip(whole, hidden, paths, strict=True):
        path: Path = found
        if not usable(path):
            failed += 1
            path = METHODS["linear"].run([part], {})[0]
        out = full.seen & ~part.seen
        error = np.column_stack((path.east - full.east, path.north - full.north))[out]
        distance = np.hypot(error[:, 0], error[:, 1])
        means.append(distance.mean())
        largest.append(distance.max())
        counts.append(distance.size)
        claims = claims and path.variance is not None
        path = sized(path, part)
        spread = np.zeros((len(full), 2)) if path.variance is None else path.variance
        half = np.maximum(z * np.sqrt(spread[out] + path.fix_variance), 1e-9)
        needed.append((np.abs(error) / half).ravel())
        halves.append(half.mean())
    return Cell(
        method=m.name,
        length=length,
        start=begin,
        mean_error=np.array(means),
        max_error=np.array(largest),
        n_fixes=np.array(counts),
        needed=tuple(needed),
        claims=claims,
        level=level,
        half=np.array(halves),
        failed=failed,
        seconds=seconds,
    )
