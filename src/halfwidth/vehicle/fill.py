"""Fill a drive: a position with a half-width for every row of a log that had, or could have had, a fix.

A log that was written late is put at the times at which its sensors spoke (`stamps`); the track has the stamps of the
log. It is put on one clock, cut into pieces of some minutes with a minute of context on both sides (never inside a
gap), each piece is estimated by the best method that the log's sensors allow, and the half-widths are widened or
narrowed by what hiding the log's own fixes shows (`calibrate`). Gaps in which the log lacks the speed or the yaw rate
too are tested by hiding these as well, and bridged by constant velocity where hidden fixes show that to be better;
where they speak, the chain whose fixes are wrong by white noise only competes in the same way. A method that fails on a
piece is replaced by a simpler one there, and the track says so.

Positions are those that the receiver would have reported, and the half-widths say how far off they are: hidden fixes
lie within them as often as `level` says, on this log. What the receiver is wrong by for minutes at a time is in the
fixes on both sides of a gap and in the filling between them, and hiding fixes cannot show it. How large that slow error
is shows in how fixes and dead reckoning disagree (`slow`): the messages name it, and `Track.truth_half_m` has it.

    half = z inflation sqrt(variance of the path + variance of a fix)
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadLog, BadValue
from halfwidth.vehicle import calibrate, chain, proven
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.distrust import distrusted
from halfwidth.vehicle.estimators import COLOURS, METHODS, Method, heading_of, usable, with_limits
from halfwidth.vehicle.estimators import method as method_of
from halfwidth.vehicle.frames import wrapped
from halfwidth.vehicle.grid import Grid, sampled
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.path import Path, sized
from halfwidth.vehicle.roads import roads_of
from halfwidth.vehicle.slow import Slow, slow_error
from halfwidth.vehicle.spikes import spikes
from halfwidth.vehicle.stamps import Stamps, restamped
from halfwidth.vehicle.stray import strays
from halfwidth.vehicle.track import Track, gaps_of, since_fix_of

Floats = NDArray[np.float64]

#: A piece is about this long, with this much context on both sides; a pause of the whole log ends a piece, s.
PIECE, CONTEXT, PAUSE = 600.0, 60.0, 60.0

#: A pause between fixes of this length is a gap even where it is usual in the log, s.
LONG = 5.0

#: A pause of the whole log of more than this many usual fix intervals, and of `PAUSE` at most, gets rows of its own.
ROWLESS = 2.5

#: Fixes that a method with a model of motion needs.
FEWEST = 5

#: Times that fixes are screened for strays at most.
_SCREENINGS = 3

#: The chain that screens fixes: one whose fixes neither drift nor jump, so that it does not follow strays.
_STIFF = chain.Chain(rounds=8, tail=np.inf, drifting=False)

#: Rounds in which the chain is solved again with hidden fixes, its scales kept: from the azimuths found with all fixes
#: or, where a gap has no yaw rate or speed to find them by, from what is known without the hidden ones.
_AGAIN, _AFRESH = 2, 10

#: Constant velocity bridges a gap that lacks sensors if its error times its half-width is below this share of the
#: chain's: the nearer path with the narrower interval that holds, as a single one of them may be luck.
_BETTER = 0.8


def fill(
    log: Any,
    *,
    method: str | None = None,
    level: float = 0.9,
    clock_offset: float | None = None,
    distrust: bool = True,
    second: Any = None,
    roads: Any = None,
    limits: Mapping[str, Any] | None = None,
    guaranteed: tuple[float, float] | None = None,
) -> Track:
    """Fill the gaps of a log.

    Parameters
    ----------
    log : Log, path or frame
        What `halfwidth.vehicle.read` returns or takes, or a pandas, polars or pyarrow frame with such columns. Rows
        with a time but no fix are where a position is wanted.
    method : str, optional
        Name of an estimator; if absent the best that the log's sensors allow.
    level : float
        Probability of the half-widths, between 0 and 1.
    clock_offset : float, optional
        Seconds to add to the time stamps of speed and yaw rate so that they agree with those of the fixes; found from
        the log, for each by itself, if absent.
    distrust : bool
        Whether samples are looked for that are not what they claim, and left out: fixes that only repeat the one
        before while the car moves or lie where it cannot have been, speeds and yaw rates that leap away and come back.
        The track's messages name them.
    second : Log, path or frame, optional
        Fixes of a second antenna, on the clock of the first one's. This, `roads` and `limits` are for the two-antenna
        model, which is the method where one of them is given and `method` is absent.
    roads : path, dict or Roads, optional
        GeoJSON with lines: inside gaps the track stays on them, within `half_width` or half the `width` of their
        properties, or 5 m. A gap beside which the fixes are off the roads is left as it is, and the messages say so.
    limits : mapping of str to float or (float, float), optional
        Largest size, or least and largest value, of ``speed`` (m/s), ``acceleration`` (m/s^2), ``yaw_rate`` (rad/s),
        ``altitude`` (m) and ``pitch`` (rad).
    guaranteed : (float, float), optional
        Declared half-widths: the acceleration that the car never passes, m/s^2, and the error that no fix passes, m,
        each east and north. The track then has a band that must contain the car if both are true, in `Track.proven`;
        it does not touch the half-widths. Fixes that contradict the two are named, and there is no band.

    Returns
    -------
    Track
        Every fix, every row between fixes that are further apart than 1.5 times the usual, and every row before the
        first and after the last fix. Where the whole log pauses between two fixes, as a receiver's own log does in a
        tunnel, rows are added at the usual rate of the fixes; a pause of more than a minute is left open.

    Raises
    ------
    BadLog
        If the log cannot be read or has no fix.
    BadValue
        If `level`, `method`, `clock_offset`, `roads` or one of `limits` is none, or the method does not take them.
    """
    level, offset = level_of(level), clock_offset_of(clock_offset)
    bounds = None if guaranteed is None else proven.declared(guaranteed)
    asked = None if method is None else method_of(method)
    held = second is not None or roads is not None or limits is not None
    asked = with_limits(asked, limits, None) if held else asked
    known_roads = None if roads is None else roads_of(roads)
    beside = None if second is None else as_log(second)[0]
    drive_log, native = as_log(log)
    if not drive_log.fixed.any():
        raise BadLog("the log has no fix, at least one position is expected", hint="halfwidth check LOG")
    messages: list[str] = []
    if distrust:
        leaps = spikes(drive_log)
        messages.extend(leaps.words(drive_log))
        drive_log = leaps.masked(drive_log)
        # stray fixes show best against speed and yaw rate, later
        sensed = all(np.isfinite(getattr(drive_log, name)).any() for name in ("speed_mps", "yaw_rate_radps"))
        doubtful = distrusted(drive_log, jumps=not sensed)
        messages.extend(doubtful.words(drive_log))
        drive_log = doubtful.masked(drive_log)
    # a second antenna's log is on the clock of the first one as written
    stamps = Stamps(drive_log.t, drive_log.t)
    if beside is None:
        drive_log, stamps = restamped(drive_log)
    messages.extend(filter(None, [stamps.words()]))
    drive_log = _with_pauses_filled(drive_log, messages)
    sensors = calibrated(drive_log, clock_offset=None if clock_offset is None else offset)
    messages.extend(sensors.words())
    grid = sampled(drive_log, sensors=sensors, second=beside)
    if known_roads is not None:
        asked = with_limits(asked, limits, known_roads.local(grid.frame))
    chosen = _chosen(grid, asked, messages)
    wanted, quality = _wanted(drive_log)
    t = drive_log.t[wanted]
    believed = grid.seen
    if distrust:
        stray = strays(grid, sensors)
        messages.extend(filter(None, [stray.words(grid)]))
        grid = stray.masked(grid)
    pieces = _pieces(grid, drive_log)
    spans = _spans(drive_log, grid, chosen, t, quality)
    free = asked is None or asked.name != chosen.name
    answers = _estimated(pieces, chosen, spans, level, messages, free=free)
    columns = _read(answers, pieces, t)
    away = _distance_in_time(drive_log, t)
    half = _half_widths(columns, answers, grid, away, level, t, quality)
    arm_east, arm_north = sensors.arm(t)
    east, north = columns.east + arm_east, columns.north + arm_north
    lat, lon = grid.frame.to_geodetic(east, north)
    written = stamps.back(t)
    gaps = gaps_of(written, lat, lon, half.max(axis=1), quality)
    settings: dict[str, object] = {"context": CONTEXT, "sensors": sensors.to_dict()}
    settings.update(answers.settings)
    band = None
    if bounds is not None:
        off = np.isin(t, grid.t[believed & ~grid.seen])  # what is not believed bounds nothing
        band = _proven(drive_log, wanted, off, grid, np.column_stack((east, north)), bounds, messages)
    return Track(
        t_s=written,
        lat_deg=lat,
        lon_deg=lon,
        alt_m=_altitude(drive_log, t, answers.paths),
        azimuth_rad=np.mod(columns.azimuth, 2 * np.pi),
        speed_mps=columns.speed,
        east_half_m=half[:, 0],
        north_half_m=half[:, 1],
        quality=quality,
        since_fix_s=since_fix_of(written, quality),
        level=level,
        method=chosen.name,
        log=replace(drive_log, t=stamps.back(drive_log.t)),
        gaps=gaps,
        # where nothing could be tested, a model's own variance is a size and no probability
        guarantee="credible" if all(bridge.tested for bridge in answers.bridges) else "none",
        benchmark=tuple(asdict(one) for one in answers.tested) or None,
        settings=settings,
        messages=tuple(messages),
        native=native,
        proven=band,
        slow_m=None if answers.slow is None else answers.slow.at(t),
    )


def _proven(
    log: Log,
    wanted: NDArray[np.intp],
    off: NDArray[np.bool_],
    grid: Grid,
    track: Floats,
    bounds: tuple[float, float],
    messages: list[str],
) -> proven.Proven | None:
    """Return the band of the declared half-widths about a track (M, 2), or say which fixes contradict them."""
    east, north = grid.frame.to_local(log.lat_deg[wanted], log.lon_deg[wanted])
    fixes = np.column_stack((east, north))
    fixes[off] = np.nan
    found = proven.band(log.t[wanted], fixes, *bounds)
    if isinstance(found, str):
        messages.append(f"no guaranteed band: the log contradicts the declared half-widths: {found}")
        return None
    return proven.about(track[:, 0], track[:, 1], *found, *bounds)


def level_of(given: Any) -> float:
    """Return a level as a number between 0 and 1, or raise BadValue."""
    level = _number(given)
    if level is None or not 0 < level < 1:
        raise BadValue(f"`level` is {given!r}, a probability between 0 and 1 is expected", hint="level=0.9")
    return level


def clock_offset_of(given: Any) -> float:
    """Return a clock offset in seconds, 0 if it is None, or raise BadValue."""
    offset = 0.0 if given is None else _number(given)
    if offset is None or not np.isfinite(offset):
        raise BadValue(f"`clock_offset` is {given!r}, a finite number of seconds is expected", hint="clock_offset=0.0")
    return offset


def _number(given: Any) -> float | None:
    """Return a number as a float; None for text and whatever else is no number."""
    if isinstance(given, str | bytes):
        return None
    try:
        return float(given)
    except (TypeError, ValueError):
        return None


def as_log(given: Any) -> tuple[Log, str]:
    """Return a log from a log, a path or a frame, and the name of the library that its frames come from."""
    if isinstance(given, Log):
        return given, "pandas"
    from halfwidth.vehicle.formats import from_frame, read

    if isinstance(given, str | os.PathLike):
        return read(given), "pandas"
    library = type(given).__module__.partition(".")[0]
    return from_frame(given), library if library in ("pandas", "polars", "pyarrow") else "pandas"


# ---- which method, which rows, which pieces ------------------------------------------------------------------------


def _chosen(grid: Grid, asked: Method | None, messages: list[str]) -> Method:
    """Choose the best method that the sensors allow, and say why it is not the usual one."""
    lacks = None if asked is None else asked.lacks(grid)
    if asked is not None and lacks is None:
        return asked
    if asked is not None:
        messages.append(f"`{asked.name}` needs the {lacks}, which the log does not have")
    n = int(grid.seen.sum())
    if n < FEWEST:
        messages.append(f"the log has only {n} fix{'es' if n > 1 else ''}: straight lines between them")
        return METHODS["linear"]
    if not grid.has_speed and not grid.has_yaw_rate:
        messages.append("the log has neither speed nor yaw rate: gaps are filled by constant velocity")
        return METHODS["cv"]
    if not grid.has_speed:
        messages.append("the log has no speed: in gaps it is taken to change evenly from one side to the other")
    if not grid.has_yaw_rate:
        messages.append("the log has no yaw rate: in gaps the turning is guessed from both sides")
    return METHODS["em"]


def _words(name: str) -> str:
    return name.replace("_", " ")


def _with_pauses_filled(log: Log, messages: list[str]) -> Log:
    """Add rows where nothing at all arrived between two fixes although at least two fixes were due."""
    fixes = log.t[log.fixed]
    if fixes.size < 3:
        return log
    usual = float(np.median(np.diff(fixes)))
    step = np.diff(log.t)
    pauses = np.flatnonzero((step > ROWLESS * usual) & (log.t[:-1] >= fixes[0]) & (log.t[1:] <= fixes[-1]))
    open_ = [k for k in pauses if step[k] > PAUSE]
    messages.extend(
        f"nothing arrived for {step[k]:.0f} s from {log.t[k]:.1f} s on: longer than {PAUSE:.0f} s, left open"
        for k in open_
    )
    added = [np.linspace(log.t[k], log.t[k + 1], round(step[k] / usual) + 1)[1:-1] for k in pauses if step[k] <= PAUSE]
    if not added:
        return log
    times = np.concatenate(added)
    total = sum(step[k] for k in pauses if step[k] <= PAUSE)
    messages.append(
        f"nothing arrived in {len(added)} pause{'s' if len(added) > 1 else ''} of the log, {total:.1f} s in all:"
        f" {times.size} rows were added there"
    )
    return log.with_rows(times)


def _wanted(log: Log) -> tuple[NDArray[np.intp], NDArray[np.str_]]:
    """Return the rows that a track has, and the quality of each."""
    t, fixed = log.t, log.fixed
    times = t[fixed]
    quality = np.where(fixed, "fix", "").astype("<U12")
    quality[~fixed & ((t < times[0]) | (t > times[-1]))] = "extrapolated"
    for start, stop in _gaps(log):
        a, b = np.searchsorted(t, start, side="right"), np.searchsorted(t, stop)
        quality[a:b] = "bridged"
    rows = np.flatnonzero(quality != "")
    return rows, quality[rows]


def _gaps(log: Log) -> list[tuple[float, float]]:
    """Return the log's gaps and every other pause between fixes that is long for any receiver."""
    times = log.t[log.fixed]
    long = np.flatnonzero(np.diff(times) > LONG)
    return sorted({*log.gaps(), *((float(times[k]), float(times[k + 1])) for k in long)})


@dataclass(frozen=True, eq=False)
class _Piece:
    """A part of the drive: the span it answers for, and its grid, which reaches further."""

    start: float
    stop: float
    grid: Grid


def _pieces(grid: Grid, log: Log) -> list[_Piece]:
    """Cut a drive where the log pauses and, if it is long, every ten minutes at a fix."""
    rest = np.flatnonzero(np.diff(log.t) > PAUSE)
    blocks = [(log.t[a], log.t[b]) for a, b in zip([0, *(rest + 1)], [*rest, len(log) - 1], strict=True)]
    merged: list[tuple[float, float]] = []
    held = False
    for start, stop in blocks:
        has_fix = bool(grid.seen[(grid.t >= start) & (grid.t <= stop)].any())
        # a block without a fix cannot stand alone
        if merged and (held or not has_fix):
            merged[-1] = (merged[-1][0], stop)
            held = held and not has_fix
        else:
            merged.append((start, stop))
            held = not has_fix
    pieces = []
    for start, stop in merged:
        cuts = [start]
        fixes = grid.t[grid.seen & (grid.t > start) & (grid.t < stop)]
        while stop - cuts[-1] > 1.5 * PIECE:
            k = int(np.searchsorted(fixes, cuts[-1] + PIECE))
            if k >= fixes.size or stop - fixes[k] < 1.0:
                break
            cuts.append(float(fixes[k]))
        for a, b in zip(cuts, [*cuts[1:], stop], strict=True):
            part = grid.between(max(start, a - CONTEXT) - 1e-9, min(stop, b + CONTEXT) + 1e-9)
            pieces.append(_Piece(a, b, part))
    return pieces


@dataclass(frozen=True)
class _Span:
    """A stretch to be filled: between two fixes, or before the first or after the last one."""

    start: float
    stop: float
    silent: tuple[str, ...]  # sensors that the log has, but not there

    @property
    def length(self) -> float:
        return self.stop - self.start


def _spans(log: Log, grid: Grid, chosen: Method, t: Floats, quality: NDArray[np.str_]) -> list[_Span]:
    """Return the stretches to be filled, and which sensors are silent for most of each."""
    fixes = log.t[log.fixed]
    ends = [(start, stop) for start, stop in _gaps(log) if np.any((t > start) & (t < stop))]
    if np.any(quality == "extrapolated"):
        ends += [(a, b) for a, b in ((log.t[0], fixes[0]), (fixes[-1], log.t[-1])) if b > a]
    spans = []
    for start, stop in ends:
        steps = (grid.t > start) & (grid.t <= stop)
        took = grid.h[steps]
        silent = tuple(
            name
            for name in chosen.needs + chosen.one_of
            if getattr(grid, f"has_{name}") and took @ (getattr(grid, f"{name}_sd")[steps] > 0) > 0.5 * took.sum()
        )
        spans.append(_Span(float(start), float(stop), silent))
    return spans


def _distance_in_time(log: Log, t: Floats) -> Floats:
    """Return for each row the time to the nearest fix, s."""
    fixes = log.t[log.fixed]
    k = np.searchsorted(fixes, t)
    after = np.where(k < fixes.size, fixes[np.minimum(k, fixes.size - 1)] - t, np.inf)
    before = np.where(k > 0, t - fixes[np.maximum(k - 1, 0)], np.inf)
    return np.where(after == 0, 0.0, np.minimum(before, after))


#: Names of what the chain finds, as the settings of a track have them.
_WORDS = {"speed_scale": "speed scale", "yaw_bias": "yaw bias", "slow_sd": "slow error of the fixes"}


# ---- estimating ----------------------------------------------------------------------------------------------------

#: Fills drives of which fixes were hidden; the numbers say which grid each comes from, the last argument whether the
#: azimuths that were found with all fixes may be used.
Rerun = Callable[[Sequence[int], Sequence[Grid], bool], list[Path]]


@dataclass(frozen=True, eq=False)
class _Bridge:
    """How one stretch is filled, and what hiding fixes showed of it."""

    span: _Span
    by: str
    tested: Sequence[calibrate.Tested]
    least: float


@dataclass(frozen=True, eq=False)
class _Rival:
    """Another way to fill: its paths by piece, and how to run it again."""

    paths: Mapping[int, Path]
    rerun: Rerun


@dataclass(frozen=True, eq=False)
class _Answers:
    """Paths of the pieces, what hiding fixes showed, and what was found on the way."""

    paths: list[Path]
    bridges: list[_Bridge]
    settings: dict[str, object]
    slow: Slow | None

    @property
    def tested(self) -> list[calibrate.Tested]:
        """All tests that a half-width rests on."""
        return list(dict.fromkeys(one for bridge in self.bridges for one in bridge.tested))


def _estimated(
    pieces: Sequence[_Piece],
    chosen: Method,
    spans: Sequence[_Span],
    level: float,
    messages: list[str],
    *,
    free: bool,
) -> _Answers:
    """Estimate every piece, with simpler methods where the chosen one fails, and test the intervals."""
    grids = [piece.grid for piece in pieces]  # of which the chain takes away the fixes it cannot believe
    able = [i for i, grid in enumerate(grids) if chosen.name == "linear" or int(grid.seen.sum()) >= FEWEST]
    found, rerun, settings, slow = _ran(chosen, grids, able, messages)
    messages.extend(dict.fromkeys(note for path in found.values() for note in path.info.get("notes", ())))
    failed = [i for i in range(len(grids)) if i not in found or not _plausible(found[i], grids[i])]
    if failed and chosen.name != "linear":
        messages.append(_failed_words(chosen, [pieces[i] for i in failed], len(pieces)))
    paths = [_spare(grid, chosen) if i in failed else found[i] for i, grid in enumerate(grids)]
    good = [i for i in range(len(grids)) if i not in failed]
    sensed = all(grid.has_speed and grid.has_yaw_rate for grid in grids)
    # where sensors are lacking the chain guesses what they would have said, and constant velocity may do better;
    # where they speak, fixes may be wrong by white noise and nothing else
    rivals: dict[str, _Rival] = {}
    if free and chosen.name == "em" and good:
        blind = any(span.silent or not sensed for span in spans)
        names = [
            *(["em-white"] if any(not span.silent for span in spans) and sensed else []),
            *(["cv"] if blind else []),
        ]
        for name in names:
            own, again, _, _ = _ran(METHODS[name], grids, good, None)
            if all(_plausible(path, grids[i]) for i, path in own.items()):
                rivals[name] = _Rival(own, again)
    bridges: list[_Bridge] = []
    for silent in sorted({span.silent for span in spans}):
        alike = [span for span in spans if span.silent == silent]
        guessed = bool(silent) or not sensed
        against = {name: one for name, one in rivals.items() if (name == "cv") == guessed}

        def filled(
            which: Sequence[int],
            hidden: Sequence[Grid],
            guessed: bool = guessed,
            against: Mapping[str, _Rival] = against,
        ) -> dict[str, list[Path]]:
            own = [good[k] for k in which]
            first = rerun(own, hidden, guessed)
            ways = {chosen.name: first}
            for name, rival in against.items():
                both = zip(first, rival.rerun(own, hidden, guessed), hidden, strict=True)
                ways[name] = [_bridged(a, b, grid, _pauses(grid)) for a, b, grid in both]
            return ways

        tests: dict[str, list[calibrate.Tested]] = {}
        if good:
            whole = [grids[i] for i in good]
            lengths = calibrate.lengths_to_test(whole, np.array([span.length for span in alike]))
            z = NormalDist().inv_cdf(0.5 + level / 2)
            tests = calibrate.tested(whole, filled, lengths, level, z, silent, guessed=guessed)
        fixes = [grid.t[grid.seen] for grid in grids if grid.seen.any()]
        first_fix, last_fix = min(t[0] for t in fixes), max(t[-1] for t in fixes)
        inner = [s for s in alike if s.start >= first_fix - 1e-6 and s.stop <= last_fix + 1e-6]
        outer = [span for span in alike if span not in inner]
        ends = _end_tests(chosen.name, [grids[i] for i in good], good, rerun, outer, level)
        mine = []
        for span in inner:
            by = _nearest(tests, chosen.name, span.length)
            mine.append(_Bridge(span, by, tuple(tests.get(by, [])), 0.0))
        for span in outer:
            # without a test of its own, an end is at least as uncertain as a model says
            own_test = ends or tests.get(chosen.name, [])
            mine.append(_Bridge(span, chosen.name, tuple(own_test), 0.0 if ends else 1.0))
        bridges += mine
        messages.extend(_choice_words(tests, mine))
        messages.extend(_test_words(mine, level, chosen.name))
    for name, rival in rivals.items():
        taken = [(bridge.span.start, bridge.span.stop) for bridge in bridges if bridge.by == name]
        for i, path in rival.paths.items():
            paths[i] = _bridged(paths[i], path, grids[i], taken)
    answers = _Answers(paths, bridges, settings, slow)
    settings.update(
        {
            f"inflation at {one.length_s:.3g} s{_beyond(one)}{_without(one.silent)}{_by(one.by, chosen.name)}": round(
                one.inflation, 3
            )
            for one in answers.tested
        }
    )
    return answers


def _end_tests(
    name: str, grids: Sequence[Grid], good: Sequence[int], rerun: Rerun, spans: Sequence[_Span], level: float
) -> list[calibrate.Tested]:
    """Test half-widths beyond the first and the last fix of a log."""
    if not spans or not good:
        return []
    lengths = calibrate.lengths_to_test(grids, np.array([span.length for span in spans]))
    z = NormalDist().inv_cdf(0.5 + level / 2)
    return calibrate.tested_ends(
        grids,
        lambda which, hidden: rerun([good[k] for k in which], hidden, True),
        lengths,
        level,
        z,
        spans[0].silent,
        by=name,
    )


def _nearest(tests: Mapping[str, Sequence[calibrate.Tested]], usual: str, length: float) -> str:
    """Return which way came nearest to hidden fixes, and was surest, in stretches about as long as this.

    Another way than the usual one has to be clearly better. Where the sensors speak, it has to be so in the stretches
    of all lengths together, too: what fixes are wrong by is the same in all, and a few long ones are soon luck.
    """
    size = {name: {one.length_s: one.mean_m * one.half_m for one in row} for name, row in tests.items()}
    if usual not in size:
        return min(size, key=lambda name: min(size[name].values()), default=usual)

    def share(name: str) -> float:
        common = [(at, own / max(size[usual][at], 1e-12)) for at, own in size[name].items() if at in size[usual]]
        if not common:
            return np.inf
        near = min(common, key=lambda one: abs(np.log(one[0] / max(length, 1e-3))))[1]
        guessed = any(one.guessed for one in tests[name])
        return near if guessed else max(near, float(np.exp(np.mean(np.log([max(r, 1e-12) for _, r in common])))))

    best = min((name for name in size if name != usual), key=share, default=usual)
    return best if best != usual and share(best) < _BETTER else usual


def _pauses(grid: Grid) -> list[tuple[float, float]]:
    """Return the stretches of a grid between fixes that are not neighbours."""
    seen = np.flatnonzero(grid.seen)
    apart = np.flatnonzero(np.diff(seen) > 1)
    return [(float(grid.t[seen[k]]), float(grid.t[seen[k + 1]])) for k in apart]


def _bridged(path: Path, other: Path, grid: Grid, spans: Sequence[tuple[float, float]]) -> Path:
    """Take another path between the fixes on both sides of some stretches, shifted so that it meets this one there."""
    seen = np.flatnonzero(grid.seen)
    t = grid.t[seen]
    columns: dict[str, Any] = {name: np.array(getattr(path, name)) for name in ("east", "north", "azimuth", "speed")}
    if path.variance is None or other.variance is None:
        return path
    variance = path.variance.copy()
    for start, stop in spans:
        left = int(np.searchsorted(t, start + 1e-6, side="right")) - 1
        right = int(np.searchsorted(t, stop - 1e-6))
        if left < 0 or right >= seen.size or seen[right] - seen[left] < 2:
            continue
        a, b = seen[left], seen[right]
        inside = slice(a + 1, b)
        share = (grid.t[inside] - grid.t[a]) / (grid.t[b] - grid.t[a])
        for name, own in columns.items():
            new = getattr(other, name)
            before, after = own[a] - new[a], own[b] - new[b]
            if name == "azimuth":
                before, after = float(wrapped(before)), float(wrapped(after))
            own[inside] = new[inside] + (1 - share) * before + share * after
        # a path says by itself how far fixes lie about it; what is kept is the sum
        variance[inside] = np.maximum(other.variance[inside] + other.fix_variance - path.fix_variance, 0.0)
    return replace(path, **columns, variance=variance)


def _ran(
    chosen: Method, grids: list[Grid], able: Sequence[int], messages: list[str] | None
) -> tuple[dict[int, Path], Rerun, dict[str, object], Slow | None]:
    """Run a method on the pieces that have enough fixes."""
    if chosen.name in COLOURS:
        return _chain(chosen, grids, able, messages)
    return *_plain(chosen, grids, able), None


def _chain(
    chosen: Method, grids: list[Grid], able: Sequence[int], messages: list[str] | None
) -> tuple[dict[int, Path], Rerun, dict[str, object], Slow | None]:
    """Solve the chain without the fixes that it cannot believe; where `messages` is None they are gone already."""
    colour = COLOURS[chosen.name]
    stray: list[float] = []
    todo = list(able) if messages is not None else []
    messages = [] if messages is None else messages
    stiff: dict[int, chain.Fit] = {}
    for _ in range(_SCREENINGS):
        stiff.update(zip(todo, chain.solve([grids[i] for i in todo], _STIFF), strict=True))
        hidden = {i: _stray(stiff[i].path, grids[i]) for i in todo}
        todo = [i for i in todo if hidden[i].any()]
        for i in todo:
            stray += grids[i].t[hidden[i]].tolist()
            grids[i] = grids[i].masked(hidden[i])
    fits = dict(zip(able, chain.solve([grids[i] for i in able], colour), strict=True))
    if stray:
        times = sorted(set(stray))
        words = ", ".join(f"{t:.1f}" for t in times[:5]) + (" ..." if len(times) > 5 else "")
        some = "1 fix is" if len(times) == 1 else f"{len(times)} fixes are"
        messages.append(f"{some} far from where the vehicle can have been and left out: t = {words} s")

    def rerun(which: Sequence[int], hidden: Sequence[Grid], afresh: bool) -> list[Path]:
        return [
            fit.path
            for fit in chain.solve(
                hidden,
                replace(colour, rounds=_AFRESH if afresh else _AGAIN),
                sigma=np.array([fits[i].sigma for i in which]),
                azimuth=None if afresh else [fits[i].z[:, chain.AZIMUTH] for i in which],
                weight=None if afresh else [fits[i].weight for i in which],
                learn=False,
            )
        ]

    settings: dict[str, object] = {}
    if fits:
        weight = [len(grids[i]) for i in fits]
        sigma = np.sqrt(np.average([fit.sigma**2 for fit in fits.values()], axis=0, weights=weight))
        settings.update(
            {f"{name} noise": float(f"{value:.3g}") for name, value in zip(chain.GROUPS, sigma, strict=True)}
        )
        for name in ("speed_scale", "yaw_bias"):
            value = np.average([fit.path.info[name] for fit in fits.values()], weights=weight)
            settings[_WORDS[name]] = float(f"{value:.4g}")
    slow = None
    if stiff and colour.slow:
        slow = slow_error([grids[i] for i in fits], [stiff[i] for i in fits], list(fits.values()))
    if slow is not None:
        settings[_WORDS["slow_sd"]] = float(f"{slow.sd:.3g}")
        messages.append(_slow_words(slow))
    return {i: fit.path for i, fit in fits.items()}, rerun, settings, slow


def _slow_words(slow: Slow) -> str:
    """Say what the half-widths are about, and how far off that the truth may be."""
    promise = "the half-widths hold where the receiver would have seen the vehicle, not where it was"
    if not slow.seen:
        return f"{promise}; no error of the fixes that lasts for minutes shows in the drive"
    return (
        f"{promise}: the fixes are wrong by {slow.sd:.2g} m for minutes at a time (1 sigma, as they and the sensors"
        " disagree), which hiding fixes cannot show; `truth_half_m` of the track has it"
    )


def _stray(path: Path, grid: Grid) -> NDArray[np.bool_]:
    """Return the nodes whose fix is far off the path, (T,): one multipath fix must not set the noise of the drive.

    Far is beyond 8 times the median distance, 5 standard deviations of a fix and 3 m. Where more than a tenth of the
    fixes would go it is the path that is wrong, and none goes.
    """
    off = np.hypot(path.east - grid.east, path.north - grid.north)
    far = grid.seen & ~(off <= max(8 * float(np.median(off[grid.seen])), 5 * path.fix_variance**0.5, 3.0))
    return far if path.finite and far.sum() <= 0.1 * grid.seen.sum() else np.zeros(len(grid), dtype=bool)


def _plain(
    chosen: Method, grids: Sequence[Grid], able: Sequence[int]
) -> tuple[dict[int, Path], Rerun, dict[str, object]]:
    """Run a method that learns from the longest piece, and from each piece with all its fixes what it keeps of it."""
    tuned = chosen.tune(grids[max(able, key=lambda i: len(grids[i]))]) if able else {}

    whole: dict[int, Path] = {}

    def rerun(which: Sequence[int], hidden: Sequence[Grid], afresh: bool) -> list[Path]:
        if afresh or chosen.again is None:
            paths = chosen.run(hidden, tuned)
        else:
            paths = chosen.again(hidden, [whole[i] for i in which], tuned)
        return [sized(path, grid) for path, grid in zip(paths, hidden, strict=True)]

    whole.update(zip(able, rerun(able, [grids[i] for i in able], True), strict=True))
    settings: dict[str, object] = {f"{_words(name)} noise": float(f"{value:.3g}") for name, value in tuned.items()}
    return whole, rerun, settings


def _spare(grid: Grid, chosen: Method) -> Path:
    """Estimate a piece on which the chosen method failed."""
    if chosen.name not in ("cv", "linear") and int(grid.seen.sum()) >= FEWEST:
        cv = METHODS["cv"]
        path = cv.run([grid], cv.tune(grid))[0]
        if _plausible(path, grid):
            return path
    if grid.seen.any():
        return METHODS["linear"].run([grid], {})[0]
    raise BadLog("a part of the log has no fix, at least one position is expected")


def _plausible(path: Path, grid: Grid) -> bool:
    """Whether a path can be shown: it has numbers, keeps near the fixes and does not stray between them.

    The nodes must stay within what a vehicle can reach from the straight line between two fixes: half of the distance
    that the top speed would take in the pause, and some metres.
    """
    if not usable(path):
        return False
    seen = np.flatnonzero(grid.seen)
    t, fixes = grid.t, grid.t[seen]
    off = np.hypot(*(p - np.interp(t, fixes, q[seen]) for p, q in ((path.east, grid.east), (path.north, grid.north))))
    after = np.minimum(np.searchsorted(fixes, t), fixes.size - 1)
    before = np.maximum(np.searchsorted(fixes, t, side="right") - 1, 0)
    near = np.where(
        (t < fixes[0]) | (t > fixes[-1]),
        np.abs(t - fixes[before]) + np.abs(t - fixes[after]),
        fixes[after] - fixes[before],
    )
    reach = _top_speed(grid) * near
    spread = np.median(off[seen])
    return bool(np.all(off <= 20.0 + 10.0 * spread + reach))


def _top_speed(grid: Grid) -> float:
    """Return a speed that the vehicle of this log surely did not exceed by much, m/s."""
    seen = np.flatnonzero(grid.seen)
    fastest = float(np.abs(grid.speed).max()) if grid.has_speed else 0.0
    if seen.size > 1:
        step = np.maximum(np.diff(grid.t[seen]), 1.0)
        moved = np.hypot(np.diff(grid.east[seen]), np.diff(grid.north[seen]))
        fastest = max(fastest, float(np.quantile(moved / step, 0.99)))
    return max(1.5 * fastest, 10.0)


def _failed_words(chosen: Method, pieces: Sequence[_Piece], n: int) -> str:
    spans = ", ".join(f"{piece.start:.0f} to {piece.stop:.0f} s" for piece in pieces[:3])
    more = f" and {len(pieces) - 3} more" if len(pieces) > 3 else ""
    return (
        f"`{chosen.name}` found no usable path in {len(pieces)} of {n} parts of the log ({spans}{more}):"
        " a simpler method filled them"
    )


def _choice_words(tests: Mapping[str, Sequence[calibrate.Tested]], bridges: Sequence[_Bridge]) -> list[str]:
    """Say how near each way came to hidden fixes, where there was a choice, and which was taken."""
    if len(tests) < 2:
        return []
    found = "; ".join(
        f"{row[0].length_s:.3g} s " + ", ".join(f"{one.by} {one.mean_m:.2f} m" for one in row)
        for row in zip(*tests.values(), strict=False)
    )
    taken = " and ".join(dict.fromkeys(bridge.by for bridge in bridges))
    return [f"chosen by hiding fixes{_without(bridges[0].span.silent)}: {taken}; mean errors {found}"]


def _test_words(bridges: Sequence[_Bridge], level: float, usual: str) -> list[str]:
    """Say what hiding fixes showed about gaps of one kind."""
    found = []
    without = _without(bridges[0].span.silent)
    groups: dict[object, list[_Bridge]] = {}
    for bridge in bridges:
        groups.setdefault((bridge.by, bridge.tested), []).append(bridge)
    for mine in groups.values():
        by, tested, least = mine[0].by, mine[0].tested, min(bridge.least for bridge in mine)
        beyond = _beyond(tested[0]) if tested else ""
        if not tested:
            found.append(
                f"too few fixes to test the half-widths{without} on this log: they are the model's own,"
                f" widened {calibrate.UNTESTED:g} times"
            )
            continue
        words = "; ".join(
            f"{one.length_s:.3g} s: {100 * one.coverage:.0f} % of hidden fixes inside, {_change(one.inflation, least)}"
            for one in tested
        )
        which = f"{beyond}{without}{_by(by, usual)}"
        stretches = sum(one.stretches for one in tested)
        found.append(f"{100 * level:g} % intervals{which} tested on {stretches} hidden stretches: {words}")
        longest, most = tested[-1].length_s, max(bridge.span.length for bridge in mine)
        if most > 1.2 * longest:
            found.append(
                f"the longest gap{without} lasts {most:.0f} s but this log can test intervals only up to"
                f" {longest:.0f} s"
            )
    return found


def _change(inflation: float, least: float) -> str:
    factor = max(inflation, least, calibrate.LEAST)
    return f"widened {factor:.2f} times" if factor >= 1 else f"narrowed to {factor:.2f} times"


def _beyond(one: calibrate.Tested) -> str:
    return " beyond the fixes" if one.side == "one" else ""


def _without(silent: Sequence[str]) -> str:
    return f" without {' and '.join(_words(name) for name in silent)}" if silent else ""


def _by(name: str, usual: str) -> str:
    return f" bridged by {name}" if name != usual else ""


# ---- reading the track off the paths -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Columns:
    """What the track needs at its rows."""

    east: Floats
    north: Floats
    azimuth: Floats
    speed: Floats
    variance: Floats  # (M, 2)
    fix_variance: Floats  # (M,)


def _read(answers: _Answers, pieces: Sequence[_Piece], t: Floats) -> _Columns:
    """Read each row off the path of its piece."""
    east, north, azimuth, speed_at = (np.full(t.size, np.nan) for _ in range(4))
    columns = _Columns(east, north, azimuth, speed_at, np.zeros((t.size, 2)), np.zeros(t.size))
    starts = np.array([piece.start for piece in pieces])
    of = np.clip(np.searchsorted(starts, t, side="right") - 1, 0, len(pieces) - 1)
    for i, path in enumerate(answers.paths):
        rows = of == i
        if not rows.any():
            continue
        at = t[rows]
        columns.east[rows], columns.north[rows] = _curve(path.t, path.east, at), _curve(path.t, path.north, at)
        heading, speed = heading_of(path), path.speed
        known = np.isfinite(heading)
        if known.any():
            columns.azimuth[rows] = np.interp(at, path.t[known], np.unwrap(heading[known]))
        if not np.isfinite(speed).all() and path.t.size > 1:
            speed = np.hypot(np.gradient(path.east, path.t), np.gradient(path.north, path.t))
        columns.speed[rows] = np.interp(at, path.t, speed)
        variance = path.variance if path.variance is not None else np.zeros((path.t.size, 2))
        for j in (0, 1):
            columns.variance[rows, j] = np.interp(at, path.t, variance[:, j])
        columns.fix_variance[rows] = path.fix_variance
    return columns


def _curve(t: Floats, p: Floats, at: Floats) -> Floats:
    """Read a path between its nodes by cubic pieces with the nodes' mean slopes; straight lines beyond its ends."""
    if t.size < 2:
        return np.full(at.size, p[0])
    slope = np.gradient(p, t)
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, t.size - 2)
    h = t[k + 1] - t[k]
    s = np.clip((at - t[k]) / h, 0.0, 1.0)
    return np.asarray(
        (1 + 2 * s) * (1 - s) ** 2 * p[k]
        + s * (1 - s) ** 2 * h * slope[k]
        + s**2 * (3 - 2 * s) * p[k + 1]
        - s**2 * (1 - s) * h * slope[k + 1]
    )


def _half_widths(
    columns: _Columns,
    answers: _Answers,
    grid: Grid,
    away: Floats,
    level: float,
    t: Floats,
    quality: NDArray[np.str_],
) -> Floats:
    """Return the half-widths (M, 2), m: the model's, widened as tested, and no wider than a vehicle can go."""
    z = NormalDist().inv_cdf(0.5 + level / 2)
    sd = np.sqrt(columns.variance + columns.fix_variance[:, None])
    half = z * sd
    for bridge in answers.bridges:
        rows = (quality != "fix") & (t >= bridge.span.start) & (t <= bridge.span.stop)
        for axis in (0, 1):
            own = sd[rows, axis]
            half[rows, axis] *= calibrate.inflation(bridge.tested, bridge.span.length, own, level, least=bridge.least)
    # twice: both the estimate and the vehicle are within reach of the nearest fix
    limit = 2 * _top_speed(grid) * away + z * np.sqrt(columns.fix_variance) + 10.0
    return np.minimum(half, limit[:, None])


def _altitude(log: Log, t: Floats, paths: Sequence[Path]) -> Floats:
    """Return the heights that the method found, or else interpolate those that the log has."""
    if paths and all("altitude" in path.info for path in paths):
        at, found = (np.concatenate(parts) for parts in zip(*((p.t, p.info["altitude"]) for p in paths), strict=True))
        order = np.argsort(at, kind="stable")
        return np.asarray(np.interp(t, at[order], found[order]))
    clock, height = log.stream("alt_m")
    return np.interp(t, clock, height) if clock.size else np.full(t.size, np.nan)
