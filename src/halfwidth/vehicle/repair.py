"""From columns as they came to a `Log`: time put in order, units applied, impossible values dropped.

Whatever is changed is written down in the log's notes with a count. What cannot be repaired without
guessing is refused. A unit or sign that the file states is overruled only where the fixes contradict
it beyond doubt, and never where the user stated it.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadLog
from halfwidth.vehicle import evidence
from halfwidth.vehicle.formats.cells import NO_TIME, seconds
from halfwidth.vehicle.formats.layout import FACTORS, KIND, ROLES, SEMICIRCLE, Use
from halfwidth.vehicle.formats.raw import Raw
from halfwidth.vehicle.log import STREAMS, Log
from halfwidth.vehicle.rows import Rows, counted
from halfwidth.vehicle.units import azimuth_put_right, contradicted_yaw, matched_factor, misfit, swapped_columns

Floats = NDArray[np.float64]

#: Beyond these no road vehicle goes: m/s, rad/s, m/s^2, m.
_MOST = {
    "speed_mps": 150.0,
    "yaw_rate_radps": 20.0,
    "ax_mps2": 500.0,
    "ay_mps2": 500.0,
    "alt_m": 20_000.0,
}

#: No quantity in whatever unit is this large; sums of larger ones would overflow.
_ABSURD = 1e12

#: A unit mistake makes values this much larger, at most; left alone where it is to be reported.
_MISTAKE = 180 / np.pi

#: Speed no fix-to-fix step of a car exceeds (m/s), and the distance that fix errors explain (m).
TOP_SPEED, FIX_SLACK = 100.0, 30.0

_GPS_EPOCH = 315_964_800
_LEAP_SECONDS = 18  # GPS minus UTC, unchanged since 2017


def to_log(raw: Raw, *, repair: bool = True) -> Log:
    """Make a log of raw columns.

    Parameters
    ----------
    raw : Raw
        Columns by role in the file's units.
    repair : bool
        Whether stated units and signs that the fixes contradict are put right.

    Returns
    -------
    Log

    Raises
    ------
    BadLog
        If no usable time or fewer than two fixes are left, if the clock restarts, or if most of a
        needed column is text.
    """
    _refuse_text(raw)
    notes = list(raw.notes)
    _note_cells(raw, notes)
    t, epoch = _time(raw, notes)
    streams = {ROLES[role]: _in_units(role, raw, notes) for role in KIND if role in raw.values and role != "time"}
    for name in STREAMS:
        streams.setdefault(name, np.full(t.size, np.nan))
    _drop_infinite(streams, notes)
    _drop_invalid(raw, streams, notes)
    _positions(raw, streams, notes)
    rows = Rows(raw.source, t, streams, notes)
    rows.drop_untimed()
    rows.unwrap()
    rows.drop_before_clock_was_set()
    rows.sort()
    rows.spread_coarse_stamps()
    rows.join_equal_times()
    columns = {role: use.column for role, use in raw.uses.items()}
    given: dict[str, Any] = dict(rows.streams)
    log = Log(t=rows.t, **given, source=raw.source, epoch_s=epoch, columns=columns)
    if log.t.size and epoch is not None and log.t[0] != 0:
        log = replace(log, t=log.t - log.t[0], epoch_s=epoch + float(log.t[0]))
    log = _unstated_units(log, raw, notes)
    if repair:
        log = _contradicted(log, raw, notes)
    log = _limits(log, notes, 1.0 if repair else _MISTAKE)
    log = _held_fixes(log, notes)
    log = _impossible(log, notes)
    _enough(log, raw, notes)
    return replace(log, notes=tuple(notes))


def _refuse_text(raw: Raw) -> None:
    """Refuse a needed column that is mostly no numbers."""
    for role in ("time", "lat", "lon"):
        tally = raw.tallies.get(role)
        if tally is None or tally.n_text * 2 <= tally.n_cells or tally.n_text == 0:
            continue
        column = raw.uses[role].column
        what = "times" if role == "time" else "numbers"
        raise BadLog(
            f"column `{column}` of `{raw.source}` holds text in {tally.n_text} of {tally.n_cells} rows, the first"
            f" {tally.first_text[:40]!r} in row {tally.first_row}; {what} are expected",
            hint=f"name another column: --columns {role}=NAME",
        )


def _note_cells(raw: Raw, notes: list[str]) -> None:
    n_comma = sum(tally.n_comma for tally in raw.tallies.values())
    if n_comma:
        notes.append(f"decimal commas in {counted(n_comma, 'cell')} read as points")
    for role, tally in raw.tallies.items():
        if tally.n_text:
            notes.append(
                f"{counted(tally.n_text, 'cell')} of `{raw.uses[role].column}` are text, left empty"
                f" (the first {tally.first_text[:40]!r} in row {tally.first_row})"
            )


def _time(raw: Raw, notes: list[str]) -> tuple[Floats, float | None]:
    """Turn the time column into seconds, and find the Unix time of its zero."""
    use = raw.uses["time"]
    if raw.stamps is not None:
        stamps = raw.stamps
        if raw.times.of_day and not raw.times.absolute:
            held = stamps != NO_TIME
            stamps = stamps.copy()
            clock = stamps[held]
            wraps = np.cumsum(np.concatenate(([0], np.diff(clock) < -43_200 * 10**9)))
            if wraps.size and wraps[-1]:
                notes.append(f"{counted(int(wraps[-1]), 'midnight')} passed")
            stamps[held] = clock + wraps * 86_400 * 10**9
            return seconds(stamps)[0], None
        if raw.times.zoneless:
            notes.append("time stamps without a zone taken as UTC")
        t, base = seconds(stamps)
        return t, base
    values = np.where(np.abs(raw.values["time"]) > 1e20, np.nan, raw.values["time"])
    if not np.isfinite(values).any():
        raise BadLog(
            f"column `{use.column}` of `{raw.source}` holds no time in any row",
            hint="--columns time=NAME names another",
        )
    first = float(values[np.isfinite(values)][0])
    if "week" in raw.values:
        week = raw.values["week"]
        scale = FACTORS["time"][use.unit] if use.unit else 1e-3 if np.nanmax(values) > 1e6 else 1.0
        base = np.nanmin(week) if np.isfinite(week).any() else 0.0
        t = (week - base) * 604_800 + values * scale
        start = float(t[np.isfinite(t)][0]) if np.isfinite(t).any() else 0.0
        notes.append(f"GPS week and time of week joined, {_LEAP_SECONDS} leap seconds taken off")
        return t - start, float(_GPS_EPOCH + base * 604_800 - _LEAP_SECONDS + start)
    unit = use.unit or _time_unit(values, raw, notes)
    scale = FACTORS["time"][unit]
    middle = float(np.nanmedian(np.abs(values))) * scale
    if 3e8 < middle < 1e11:  # 1979 to 5138: seconds since 1970
        # a double holds seconds since 1970 to a quarter of a microsecond: no more is kept
        return np.round((values - first) * scale, 6), first * scale
    return values * scale, None


def _time_unit(values: Floats, raw: Raw, notes: list[str]) -> str:
    """Tell the unit of unlabelled times from their size, or from how fast the car would be."""
    size = float(np.nanmedian(np.abs(values)))
    for unit, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11)):
        if least < size < least * 1e3:
            notes.append(f"times near {size:.3g} read as {unit} since 1970")
            return unit
    held = values[np.isfinite(values)]
    step = np.diff(held)
    step = step[step > 0]
    if step.size == 0 or float(np.median(step)) < 5 or not np.array_equal(held, np.round(held)):
        return "s"
    # whole numbers in large steps: the smallest unit in which the car is no rocket
    lat, lon = raw.values["lat"], raw.values["lon"]
    seen = np.isfinite(values) & np.isfinite(lat) & np.isfinite(lon) & (np.abs(lat) <= 90)
    east, north = evidence.local_metres(lat[seen], lon[seen])
    path = float(np.hypot(np.diff(east), np.diff(north)).sum())
    span = float(np.ptp(values[seen])) if seen.any() else 0.0
    for unit in ("ns", "us", "ms"):
        if span > 0 and path > 20 and path / (span * FACTORS["time"][unit]) < 90:
            notes.append(f"times in whole steps of {np.median(step):.6g} without a unit read as {unit}")
            return unit
    return "s"


def _in_units(role: str, raw: Raw, notes: list[str]) -> Floats:
    """Apply the stated unit and sign."""
    use: Use = raw.uses[role]
    values = raw.values[role] * use.sign
    if use.unit is None:
        return values
    if role in ("lat", "lon") and use.unit == "deg" and _is_scaled(values):
        return values
    factor = FACTORS[KIND[role]][use.unit]
    if factor != 1:
        notes.append(f"`{use.column}` converted from {use.unit}")
    return values * factor


def _is_scaled(values: Floats) -> bool:
    held = np.abs(values[np.isfinite(values)])
    return held.size > 0 and float(np.median(held)) > 1e6


def _drop_infinite(streams: dict[str, Floats], notes: list[str]) -> None:
    for words, most in (("infinite value", np.finfo(float).max), (f"value beyond {_ABSURD:g}", _ABSURD)):
        n = 0
        for name, values in streams.items():
            beyond = np.abs(values) > most
            if beyond.any():
                n += int(beyond.sum())
                streams[name] = np.where(beyond, np.nan, values)
        if n:
            notes.append(f"{n} {words.replace('value', 'value' + 's' * (n != 1))} dropped")


def _drop_invalid(raw: Raw, streams: dict[str, Floats], notes: list[str]) -> None:
    """Drop fixes that the file itself marks as none."""
    if "valid" not in raw.values:
        return
    bad = (raw.values["valid"] == 0) & np.isfinite(streams["lat_deg"])
    if bad.all() or not bad.any():
        return
    for name in ("lat_deg", "lon_deg", "alt_m", "azimuth_rad"):
        streams[name] = np.where(bad, np.nan, streams[name])
    notes.append(f"{counted(int(bad.sum()), 'fix')} marked invalid by `{raw.uses['valid'].column}` dropped")


def _positions(raw: Raw, streams: dict[str, Floats], notes: list[str]) -> None:
    """Bring latitude and longitude into degrees and drop what is not on Earth."""
    lat, lon = streams["lat_deg"], streams["lon_deg"]
    both = np.isfinite(lat) & np.isfinite(lon)
    alone = int((np.isfinite(lat) ^ np.isfinite(lon)).sum())
    if alone:
        notes.append(f"{counted(alone, 'row')} with only one of latitude and longitude: position dropped")
    lat, lon = np.where(both, lat, np.nan), np.where(both, lon, np.nan)
    if both.any() and _is_scaled(lat) and _is_scaled(lon):
        lat, lon = lat * 1e-7, lon * 1e-7
        notes.append("latitude and longitude read as 1e-7 degrees")
    elif both.any() and _is_ddmm(lat[both], 90) and _is_ddmm(lon[both], 180):
        lat, lon = _from_ddmm(lat), _from_ddmm(lon)
        notes.append("latitude and longitude read as degrees and minutes (ddmm.mmmm)")
    if both.any():
        off = np.abs(lat[both]) > 90
        would_fit = (np.abs(lat[both]) <= 180) & (np.abs(lon[both]) <= 90)
        if off.mean() > 0.5 and would_fit.mean() > 0.9:
            lat, lon = lon, lat
            notes.append("latitude and longitude were swapped: put right")
    null = (lat == 0) & (lon == 0)
    if null.any():
        notes.append(f"{counted(int(null.sum()), 'fix')} at latitude 0, longitude 0 dropped")
    off = (np.abs(lat) > 90) | (np.abs(lon) > 360)
    if off.any():
        k = int(np.flatnonzero(off)[0])
        notes.append(
            f"{counted(int(off.sum()), 'fix')} off the Earth dropped (the first: latitude {lat[k]:.6g},"
            f" longitude {lon[k]:.6g})"
        )
    drop = null | off
    lat, lon = np.where(drop, np.nan, lat), np.where(drop, np.nan, lon)
    if (np.abs(lon) > 180).any():
        lon = np.where(np.isnan(lon), np.nan, (lon + 180) % 360 - 180)
        notes.append("longitudes beyond 180 degrees brought into -180 to 180")
    streams["lat_deg"], streams["lon_deg"] = lat, lon
    for name in ("alt_m", "azimuth_rad"):
        streams[name] = np.where(drop, np.nan, streams[name])
    if both.any() and not np.isfinite(lat).any():
        raise BadLog(
            f"`{raw.source}` has {int(both.sum())} positions and none is on Earth (latitude {_range(raw, 'lat')},"
            f" longitude {_range(raw, 'lon')}), degrees are expected",
            hint="name the columns: --columns lat=NAME,lon=NAME",
        )


def _range(raw: Raw, role: str) -> str:
    """Say from where to where a column goes."""
    held = raw.values[role][np.isfinite(raw.values[role])]
    return f"{held.min():.6g} to {held.max():.6g}"


def _is_ddmm(values: Floats, most: float) -> bool:
    size = np.abs(values)
    return bool((size > most).mean() > 0.5 and (size < (most + 1) * 100).all() and (size % 100 < 60).all())


def _from_ddmm(values: Floats) -> Floats:
    size = np.abs(values)
    out: Floats = np.sign(values) * (size // 100 + size % 100 / 60)
    return out


def _asked(raw: Raw, role: str) -> bool:
    use = raw.uses.get(role)
    return use is not None and use.asked and use.unit is not None


def _stated(raw: Raw, role: str) -> bool:
    use = raw.uses.get(role)
    return use is not None and use.unit is not None


def _unstated_units(log: Log, raw: Raw, notes: list[str]) -> Log:
    """Settle units that nobody stated: from the fixes where possible, else from the size."""
    if not _stated(raw, "azimuth") and np.isfinite(log.azimuth_rad).any():
        errors = evidence.course_errors(log)
        rad, deg = errors["radians clockwise from north"], errors["degrees clockwise from north"]
        far = float(np.nanmax(np.abs(log.azimuth_rad))) > 2 * np.pi + 0.01
        if far or (rad.enough and deg.value < 0.5 * rad.value):
            log = replace(log, azimuth_rad=np.radians(log.azimuth_rad))
            notes.append("azimuth without a unit read as degrees")
    scaled = "latitude and longitude read as 1e-7 degrees"
    if scaled in notes and not _stated(raw, "lat"):
        factor = SEMICIRCLE / 1e-7
        other = replace(log, lat_deg=log.lat_deg * factor, lon_deg=log.lon_deg * factor)
        given, tried = evidence.speed_ratio(log), evidence.speed_ratio(other)
        nearer = misfit(tried) < 0.05 < misfit(given)
        if tried.enough and nearer and tried.spread < given.spread:
            log = other
            notes[notes.index(scaled)] = "latitude and longitude read as semicircles, as the speed says"
    if not _stated(raw, "speed") and np.isfinite(log.speed_mps).any():
        row = matched_factor(evidence.speed_ratio(log))
        if row is not None and row[3] == 1:
            log = replace(log, speed_mps=log.speed_mps * row[2])
            notes.append(f"{row[1]}, as distances between fixes say (ratio {row[0]:.3g})")
    if not _stated(raw, "yaw_rate") and np.isfinite(log.yaw_rate_radps).any():
        found = evidence.turning(log)
        degrees = found.enough and abs(np.log(abs(found.slope) * 180 / np.pi)) < 0.7
        blind = not found.enough and float(np.nanquantile(np.abs(log.yaw_rate_radps), 0.99)) > 3.5
        if degrees or blind:
            log = replace(log, yaw_rate_radps=np.radians(log.yaw_rate_radps))
            notes.append("yaw rate without a unit read as deg/s")
    for role in ("ax", "ay"):
        if role in raw.uses and not _stated(raw, role):
            notes.append(f"`{raw.uses[role].column}` without a unit read as m/s2")
    return log


def _contradicted(log: Log, raw: Raw, notes: list[str]) -> Log:
    """Put right what the fixes contradict beyond doubt."""
    row = matched_factor(evidence.speed_ratio(log)) if np.isfinite(log.speed_mps).any() else None
    if row is not None and row[3] != 1 and not _asked(raw, "time"):
        start = float(log.t[0])
        log = replace(log, t=(log.t - start) * row[3] + (start * row[3] if log.epoch_s is None else 0.0))
        notes.append(f"{row[1]}, as speed and distances between fixes say (ratio {row[0]:.3g}): put right")
    elif row is not None and row[3] == 1 and not _asked(raw, "speed"):
        log = replace(log, speed_mps=log.speed_mps * row[2])
        notes.append(f"{row[1]}, as distances between fixes say (ratio {row[0]:.3g}): put right")
    log = _unswapped(log, notes)
    if not _asked(raw, "azimuth"):
        log, said = azimuth_put_right(log)
        if said:
            notes.append(f"{said}: put right")
    factor = contradicted_yaw(evidence.turning(log))
    if factor is not None and not _asked(raw, "yaw_rate"):
        log = replace(log, yaw_rate_radps=log.yaw_rate_radps * factor)
        words = "in deg/s" if abs(factor) < 0.5 else "in rad/s, not deg/s" if abs(factor) > 2 else ""
        words += (" and " if words else "") + "positive to the right" if factor < 0 else ""
        notes.append(f"yaw rate is {words}, as courses between fixes say: put right")
    return log


def _unswapped(log: Log, notes: list[str]) -> Log:
    """Swap latitude and longitude back where both are on Earth but distances and courses say so."""
    if not swapped_columns(log):
        return log
    notes.append("latitude and longitude were swapped, as speed and course say: put right")
    return replace(log, lat_deg=log.lon_deg, lon_deg=log.lat_deg)


def _limits(log: Log, notes: list[str], room: float) -> Log:
    """Drop values beyond `room` times what a vehicle does: sentinels such as 9999, broken cells."""
    changed: dict[str, Any] = {}
    for name, most in _MOST.items():
        values = getattr(log, name)
        beyond = np.abs(values) > most * room
        if beyond.any():
            k = int(np.flatnonzero(beyond)[0])
            notes.append(
                f"{counted(int(beyond.sum()), 'value')} of {name} beyond {most * room:g} dropped"
                f" (the first {values[k]:.6g})"
            )
            changed[name] = np.where(beyond, np.nan, values)
    azimuth = log.azimuth_rad
    wild = np.abs(azimuth) > 4 * np.pi * room
    if wild.any():
        notes.append(f"{counted(int(wild.sum()), 'value')} of azimuth_rad beyond two turns dropped")
        changed["azimuth_rad"] = np.where(wild, np.nan, azimuth)
    return replace(log, **changed) if changed else log


def _held_fixes(log: Log, notes: list[str]) -> Log:
    """Blank positions that were only repeated while the car moved: held by the logger, or frozen."""
    rows = np.flatnonzero(log.fixed)
    t_speed, speed = log.stream("speed_mps")
    if rows.size < 3 or t_speed.size < 2:
        return log
    lat, lon, t = log.lat_deg[rows], log.lon_deg[rows], log.t[rows]
    same = np.concatenate(([False], (np.diff(lat) == 0) & (np.diff(lon) == 0)))
    if not same.any():
        return log
    anchor = np.maximum.accumulate(np.where(same, 0, np.arange(rows.size)))
    moved = evidence.integral(t_speed, np.abs(speed), t[anchor], t)
    moved = np.where(np.isnan(moved), 0.0, moved)
    v = np.interp(t, t_speed, np.abs(speed))
    fast = v > 3
    # a logger that holds the last fix repeats it in most rows even at speed
    held = fast.any() and float(same[fast].mean()) > 0.45
    east, north = evidence.local_metres(lat, lon)
    hop = np.hypot(np.diff(east), np.diff(north))
    quantum = float(np.quantile(hop[hop > 0], 0.05)) if (hop > 0).any() else 0.0
    far = moved > max(1.0, 5 * quantum)
    blank = same & (far | (held & (v > 0.5)))
    if held and not fast.all():
        # standing still, fixes do repeat: one for every usual interval between new ones
        fresh = t[~same & fast]
        usual = float(np.median(np.diff(fresh))) if fresh.size > 2 else 0.0
        number = np.floor((t - t[anchor]) / usual + 1e-6) if usual > 0 else np.zeros(t.size)
        first = np.concatenate(([True], (np.diff(number) != 0) | (np.diff(anchor) != 0)))
        blank |= same & ~first
    if not blank.any():
        return log
    gone = np.zeros(len(log), dtype=bool)
    gone[rows[blank]] = True
    why = "repeated by the logger" if held else f"frozen while the car moved, at {evidence.times_of(t, blank)}"
    notes.append(f"{counted(int(blank.sum()), 'fix')} {why}: dropped")
    changed: dict[str, Any] = {
        name: np.where(gone, np.nan, getattr(log, name)) for name in ("lat_deg", "lon_deg", "alt_m", "azimuth_rad")
    }
    return replace(log, **changed)


def _impossible(log: Log, notes: list[str]) -> Log:
    """Drop the few fixes that no car could have reached."""
    rows = np.flatnonzero(log.fixed)
    t, lat, lon = log.t[rows], log.lat_deg[rows], log.lon_deg[rows]
    bad = evidence.impossible_fixes(t, lat, lon, TOP_SPEED, FIX_SLACK)
    if not bad.any():
        return log
    off = evidence.off_line(t, lat, lon, bad)
    when = evidence.times_of(t, bad, off)
    if bad.mean() > 0.2:
        notes.append(f"{int(bad.sum())} of {bad.size} fixes lie where no car gets in the time, at {when}: kept")
        return log
    gone = np.zeros(len(log), dtype=bool)
    gone[rows[bad]] = True
    notes.append(f"{counted(int(bad.sum()), 'fix')} dropped that no car could reach, at {when}")
    changed: dict[str, Any] = {
        name: np.where(gone, np.nan, getattr(log, name)) for name in ("lat_deg", "lon_deg", "alt_m", "azimuth_rad")
    }
    return replace(log, **changed)


def _enough(log: Log, raw: Raw, notes: list[str]) -> None:
    n = int(log.fixed.sum())
    if n >= 2:
        return
    what = "no row has a position" if n == 0 else "only one row has a position"
    lost = [note for note in notes if note.endswith("dropped") or "joined" in note]
    if lost:
        what += f" after reading ({'; '.join(lost)})"
    untimely = len(log) < 2 <= raw.n_rows
    raise BadLog(
        f"`{raw.source}` has {counted(len(log), 'row')} and {what} (`{raw.uses['lat'].column}`,"
        f" `{raw.uses['lon'].column}`), at least two fixes are expected",
        hint=f"--columns {'time=NAME' if untimely else 'lat=NAME,lon=NAME'} names other columns",
    )
