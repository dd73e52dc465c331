"""Fill a drive: a position with a half-width for every row of a log that had, or could have had, a fix.

A log that was written late is put at the times at which its sensors spoke (`stamps`); the track has the stamps of the
log. It is put on one clock, cut into pieces of some minutes with a minute of context on both sides (never inside a
gap), each piece is estimated by the best method that the log's sensors allow, and the half-widths are widened or
narrowed by what hiding the log's own fixes shows (`calibrate`, `widening`). Gaps in which the log lacks the speed or
the yaw rate too are tested by hiding these as well, and filled where they are silent by the mean of the chain and of
constant velocity, weighted by what came nearest to hidden fixes; where they speak, the chain whose fixes are wrong by
white noise only is taken if hidden fixes show that to be clearly better (`choice`). A method that fails on a piece is
replaced by a simpler one there, and the track says so.

Positions are those that the receiver would have reported, and the half-widths say how far off they are: hidden fixes
lie within them as often as `level` says, on this log. What the receiver is wrong by for minutes at a time is in the
fixes on both sides of a gap and in the filling between them, and hiding fixes cannot show it. How large that slow error
is shows in how fixes and dead reckoning disagree (`slow`): the messages name it, and `Track.truth_half_m` has it.

    half = z inflation sqrt(variance of the path + variance of a fix)
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadLog, BadValue
from halfwidth.vehicle import proven, widening
from halfwidth.vehicle.adrift import adrift, moved
from halfwidth.vehicle.adrift import words as adrift_words
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.choice import Answers, estimated
from halfwidth.vehicle.distrust import distrusted
from halfwidth.vehicle.estimators import METHODS, Method, heading_of, with_limits
from halfwidth.vehicle.estimators import method as method_of
from halfwidth.vehicle.grid import Grid, sampled
from halfwidth.vehicle.lapse import put_right
from halfwidth.vehicle.lapse import words as lapse_words
from halfwidth.vehicle.lapses import lapses
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.path import Path
from halfwidth.vehicle.pieces import CONTEXT, Piece, pieces_of, spans_of, wanted_rows, with_pauses_filled
from halfwidth.vehicle.roads import roads_of
from halfwidth.vehicle.rows import counted
from halfwidth.vehicle.running import FEWEST, top_speed
from halfwidth.vehicle.sensors import Calibration
from halfwidth.vehicle.spikes import spikes
from halfwidth.vehicle.stamps import Stamps, restamped
from halfwidth.vehicle.stray import strays
from halfwidth.vehicle.track import Track, gaps_of, since_fix_of
from halfwidth.vehicle.units import azimuth_put_right

Floats = NDArray[np.float64]


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
    given, native = as_log(log)
    messages: list[str] = []
    ready = prepared(given, messages, None if clock_offset is None else offset, distrust=distrust, second=beside)
    drive_log, grid, pieces, quality, t = ready.log, ready.grid, ready.pieces, ready.quality, ready.t
    if known_roads is not None:
        asked = with_limits(asked, limits, known_roads.local(grid.frame))
    chosen = _chosen(drive_log, grid, asked, messages)
    spans = spans_of(drive_log, grid, chosen, t, quality)
    free = asked is None or asked.name != chosen.name
    answers = estimated(pieces, chosen, spans, level, messages, free=free)
    columns = read_off(answers, pieces, t)
    away = _distance_in_time(drive_log, t)
    half = _half_widths(columns, answers, grid, away, level, t, quality)
    east, north = ready.antenna(columns.east, columns.north)
    lat, lon = grid.frame.to_geodetic(east, north)
    written = ready.stamps.back(t)
    gaps = gaps_of(written, lat, lon, half.max(axis=1), quality)
    settings: dict[str, object] = {"context": CONTEXT, "sensors": ready.sensors.to_dict()}
    settings.update(answers.settings)
    band = None
    if bounds is not None:
        off = np.isin(t, grid.t[ready.seen & ~grid.seen])  # what is not believed bounds nothing
        band = _proven(drive_log, ready.wanted, off, grid, np.column_stack((east, north)), bounds, messages)
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
        log=given,
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


@dataclass(frozen=True, eq=False)
class Prepared:
    """A log made ready to be filled: one clock, what is not believed left out, cut into pieces.

    Parameters
    ----------
    log : Log
        On the clock of its fixes.
    stamps : Stamps
        Which times of the log as written its times are.
    sensors : Calibration
    grid : Grid
    seen : (T,) array
        Which nodes of the grid had a fix before strays were left out.
    pieces : list of Piece
    wanted : (M,) array
        Rows of the log that a track has.
    quality : (M,) array
        Quality of each.
    """

    log: Log
    stamps: Stamps
    sensors: Calibration
    grid: Grid
    seen: NDArray[np.bool_]
    pieces: list[Piece]
    wanted: NDArray[np.intp]
    quality: NDArray[np.str_]

    @property
    def t(self) -> Floats:
        """Times of the rows that a track has, (M,), s."""
        return self.log.t[self.wanted]

    def antenna(self, east: Floats, north: Floats) -> tuple[Floats, Floats]:
        """Return where the antenna is at these times if what the estimators follow is at `east` and `north`, m."""
        arm_east, arm_north = self.sensors.arm(self.t)
        return east + arm_east, north + arm_north


def prepared(
    log: Log, messages: list[str], offset: float | None = None, *, distrust: bool = True, second: Log | None = None
) -> Prepared:
    """Make a log ready to be filled, whatever the method; parameters and errors as for `fill`."""
    if not log.fixed.any():
        raise BadLog("the log has no fix, at least one position is expected", hint="halfwidth check LOG")
    if distrust:
        leaps = spikes(log)
        messages.extend(leaps.words(log))
        log = leaps.masked(log)
    far = adrift(log) if offset is None else None
    if far is not None:
        messages.append(adrift_words(far))
        log = moved(log, far)
    if distrust:
        lapsed = lapses(log)
        messages.extend(lapse_words(log, lapsed))
        log = put_right(log, lapsed)
        log, said = azimuth_put_right(log)
        messages.extend([f"{said}: put right"] if said else [])
        # stray fixes show best against speed and yaw rate, later
        sensed = all(np.isfinite(getattr(log, name)).any() for name in ("speed_mps", "yaw_rate_radps"))
        doubtful = distrusted(log, jumps=not sensed)
        messages.extend(doubtful.words(log))
        log = doubtful.masked(log)
    # a second antenna's log is on the clock of the first one as written
    stamps = Stamps(log.t, log.t)
    if second is None:
        log, stamps = restamped(log)
    messages.extend(filter(None, [stamps.words()]))
    log = with_pauses_filled(log, messages)
    sensors = calibrated(log, clock_offset=offset)
    messages.extend(sensors.words())
    grid = sampled(log, sensors=sensors, second=second)
    seen = grid.seen
    if distrust:
        stray = strays(grid, sensors)
        messages.extend(filter(None, [stray.words(grid)]))
        grid = stray.masked(grid)
    wanted, quality = wanted_rows(log)
    return Prepared(log, stamps, sensors, grid, seen, pieces_of(grid, log), wanted, quality)


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


def _chosen(log: Log, grid: Grid, asked: Method | None, messages: list[str]) -> Method:
    """Choose the best method that the sensors allow, and say why it is not the usual one."""
    lacks = None if asked is None else asked.lacks(grid)
    if asked is not None and lacks is None:
        return asked
    if asked is not None:
        messages.append(f"`{asked.name}` needs the {lacks}, which the log does not have")
    n = int(grid.seen.sum())
    if n < FEWEST:
        given = int(log.fixed.sum())
        few = f"the log has only {counted(given, 'fix')}" + (f", {n} of them of use" if given > n else "")
        messages.append(f"{few}: straight lines between them")
        return METHODS["linear"]
    if not grid.has_speed and not grid.has_yaw_rate:
        messages.append("the log has neither speed nor yaw rate: gaps are filled by constant velocity")
        return METHODS["cv"]
    if not grid.has_speed:
        messages.append("the log has no speed: in gaps it is taken to change evenly from one side to the other")
    if not grid.has_yaw_rate:
        messages.append("the log has no yaw rate: in gaps the turning is guessed from both sides")
    return METHODS["em"]


def _distance_in_time(log: Log, t: Floats) -> Floats:
    """Return for each row the time to the nearest fix, s."""
    fixes = log.t[log.fixed]
    k = np.searchsorted(fixes, t)
    after = np.where(k < fixes.size, fixes[np.minimum(k, fixes.size - 1)] - t, np.inf)
    before = np.where(k > 0, t - fixes[np.maximum(k - 1, 0)], np.inf)
    return np.where(after == 0, 0.0, np.minimum(before, after))


# ---- reading the track off the paths -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Columns:
    """What the track needs at its rows."""

    east: Floats
    north: Floats
    azimuth: Floats
    speed: Floats
    variance: Floats  # (M, 2)
    fix_variance: Floats  # (M,)


def read_off(answers: Answers, pieces: Sequence[Piece], t: Floats) -> Columns:
    """Read each row off the path of its piece."""
    east, north, azimuth, speed_at = (np.full(t.size, np.nan) for _ in range(4))
    columns = Columns(east, north, azimuth, speed_at, np.zeros((t.size, 2)), np.zeros(t.size))
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
    columns: Columns,
    answers: Answers,
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
            half[rows, axis] *= widening.inflation(bridge.tested, bridge.span.length, own, level, least=bridge.least)
    # twice: both the estimate and the vehicle are within reach of the nearest fix
    limit = 2 * top_speed(grid) * away + z * np.sqrt(columns.fix_variance) + 10.0
    return np.minimum(half, limit[:, None])


def _altitude(log: Log, t: Floats, paths: Sequence[Path]) -> Floats:
    """Return the heights that the method found, or else interpolate those that the log has."""
    if paths and all("altitude" in path.info for path in paths):
        at, found = (np.concatenate(parts) for parts in zip(*((p.t, p.info["altitude"]) for p in paths), strict=True))
        order = np.argsort(at, kind="stable")
        return np.asarray(np.interp(t, at[order], found[order]))
    clock, height = log.stream("alt_m")
    return np.interp(t, clock, height) if clock.size else np.full(t.size, np.nan)
