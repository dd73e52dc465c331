"""What is wrong with a log, each point with a verdict, the number it rests on and what to type.

Nothing is repaired here. Units, signs and conventions are judged against the fixes (`evidence`),
times against themselves, values against what a car does. What `fill` would do of its own is done here in
the same order before the sensors are judged: leaps, frozen fixes and late stamps spoil a calibration. What the
log cannot tell is said to be not checked, never guessed.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import check_sensors, evidence
from halfwidth.vehicle.align import calibrated, steps_of
from halfwidth.vehicle.check_sensors import Item as Item
from halfwidth.vehicle.distrust import NOTHING, Distrust, distrusted
from halfwidth.vehicle.log import STREAMS, Log
from halfwidth.vehicle.sensors import Calibration
from halfwidth.vehicle.spikes import spikes
from halfwidth.vehicle.stamps import Stamps, delays, restamped
from halfwidth.vehicle.units import (
    azimuth_put_right,
    contradicted_convention,
    contradicted_yaw,
    matched_factor,
    swapped_columns,
)

Floats = NDArray[np.float64]

#: Version of what `Check.to_dict` gives.
SCHEMA_VERSION = 1

#: Steps coarser than these are worth a warning: (step, its unit, how it is said).
_COARSE = {
    "lat_deg": (1e-5, "deg", "about 1 m"),
    "lon_deg": (1e-5, "deg", "about 1 m"),
    "azimuth_rad": (0.0175, "rad", "1 degree"),
    "speed_mps": (0.2, "m/s", "0.7 km/h"),
    "yaw_rate_radps": (0.005, "rad/s", "0.3 deg/s"),
    "ax_mps2": (0.2, "m/s2", "0.2 m/s2"),
    "ay_mps2": (0.2, "m/s2", "0.2 m/s2"),
}

#: A way of so many metres, and of so many times as far as all fixes lie apart, is none that a car has gone in them.
_WAY, _WAYS = 200.0, 20.0

_LABEL = {
    "position": "position",
    "alt_m": "height",
    "azimuth_rad": "azimuth",
    "speed_mps": "speed",
    "yaw_rate_radps": "yaw rate",
    "ax_mps2": "acceleration x",
    "ay_mps2": "acceleration y",
}
_ROLE = {"azimuth_rad": "azimuth", "speed_mps": "speed", "yaw_rate_radps": "yaw_rate"}
_UNIT_AS_TYPED = {"speed is in km/h": "km/h", "speed is in mph": "mph", "speed is in knots": "kn",
                  "speed is in m/s, not km/h": "m/s", "speed is in cm/s": "cm/s",
                  "time is in milliseconds": "ms", "time is in microseconds": "us",
                  "time is in nanoseconds": "ns"}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Basis:
    """What the points of a check were judged by, for its pictures.

    Parameters
    ----------
    log : Log
        Without spikes, frozen fixes and jumps, at the times at which its sensors spoke.
    fixes : Log
        The same with all fixes, as written.
    known : Calibration
        Of its sensors.
    stamps : Stamps
        From the times as written to those as said.
    doubted : Distrust
        Fixes that are frozen or jump, as rows of `fixes`.
    """

    log: Log
    fixes: Log
    known: Calibration
    stamps: Stamps
    doubted: Distrust


@dataclass(frozen=True)
class Check:
    """What was found in one log.

    Attributes
    ----------
    source : str
        The log.
    rows, fixes : int
    length_s : float
        From the first row to the last, s.
    items : tuple of Item
    notes : tuple of str
        What reading it recognised, repaired or dropped.
    basis : Basis or None
        What the sensors were judged by; None where positions or times have to be put right first.
    """

    source: str
    rows: int
    fixes: int
    length_s: float
    items: tuple[Item, ...]
    notes: tuple[str, ...]
    basis: Basis | None = field(default=None, repr=False, compare=False)

    @property
    def verdict(self) -> str:
        """The worst of all verdicts: ``"ok"``, ``"warn"`` or ``"bad"``."""
        found = {item.verdict for item in self.items}
        return "bad" if "bad" in found else "warn" if "warn" in found else "ok"

    def __getitem__(self, name: str) -> Item:
        """Give one point by its name."""
        for item in self.items:
            if item.name == name:
                return item
        raise KeyError(name)

    def summary(self) -> str:
        """Give everything as text, the worst first."""
        order = {"bad": 0, "warn": 1, "ok": 2, "not checked": 3}
        width = max((len(item.name) for item in self.items), default=0)
        lines = [
            f"{self.source}: {self.verdict}",
            f"{self.rows} rows, {self.length_s:.1f} s, {self.fixes} fixes",
            "",
        ]
        for item in sorted(self.items, key=lambda item: order[item.verdict]):
            lines.append(f"{item.verdict:<12}{item.name:<{width}}  {item.sentence}")
            if item.line:
                lines.append(f"{'':<{12 + width}}  type: {item.line}")
        if self.notes:
            lines += ["", "while reading:", *(f"  {note}" for note in self.notes)]
        return "\n".join(lines) + "\n"

    def to_dict(self) -> dict[str, Any]:
        """Give everything as plain data for JSON."""
        return {
            "schema_version": SCHEMA_VERSION,
            "source": self.source,
            "verdict": self.verdict,
            "rows": self.rows,
            "fixes": self.fixes,
            "length_s": self.length_s,
            "items": [item.to_dict() for item in self.items],
            "notes": list(self.notes),
        }

    def report(self, path: "str | os.PathLike[str]") -> Path:
        """Write the points and what they rest on, in pictures, as one HTML page that opens without a network.

        Parameters
        ----------
        path : str or path
            Where to; ``-`` is standard output. The file is replaced in one step.

        Returns
        -------
        Path
            Where it was written.
        """
        from halfwidth.vehicle.report_log import write_page

        return write_page(self, path)

    def __repr__(self) -> str:
        n = {verdict: sum(item.verdict == verdict for item in self.items) for verdict in ("bad", "warn", "ok")}
        return f"Check({self.source!r}: {self.verdict}, {n['bad']} bad, {n['warn']} warn, {n['ok']} ok)"


def check(log: Any) -> Check:
    """Say what is wrong with a log.

    Parameters
    ----------
    log : Log, path or table
        A path or table is read without putting units and signs right, so that they are reported.

    Returns
    -------
    Check

    Raises
    ------
    BadLog
        If it cannot be read.

    Examples
    --------
    >>> log = Log(t=range(20), lat_deg=[50.0] * 20, lon_deg=[14.0] * 20, speed_mps=[0.0] * 20)
    >>> check(log)["standstill"].value
    1.0
    """
    from halfwidth.vehicle.formats import from_frame, read

    if isinstance(log, str) or hasattr(log, "__fspath__"):
        log = read(log, repair=False)
    elif not isinstance(log, Log):
        log = from_frame(log, repair=False)
    leaping, log = _spikes(log)
    far, log = check_sensors.far_clock(log)
    lapsing, log = check_sensors.lapsing(log)
    swapped = _swapped(log)
    basis = None
    if swapped.verdict == "bad":
        first = "put latitude and longitude right first"
        names = ("outliers", "speed", "azimuth", "yaw rate", "trust", "stamps", *check_sensors.NAMES)
        moving = [Item(name, "not checked", first) for name in names]
    else:
        trust, doubted = _trust(log)
        believed = doubted.masked(log)
        moving = [_outliers(believed), _speed(log), _azimuth(log), _yaw(log)]
        row = matched_factor(evidence.speed_ratio(log))
        if row is not None and row[3] != 1:
            first = "put the time right first"
            moving += [trust, *(Item(name, "not checked", first) for name in ("stamps", *check_sensors.NAMES))]
        else:
            believed, _ = azimuth_put_right(believed)
            said, stamps = restamped(believed)
            known = calibrated(said)
            basis = Basis(said, log, known, stamps, doubted)
            moving += [trust, _stamps(believed, stamps), *check_sensors.items(said, known, stamps)]
    items = (
        _streams(log),
        _rates(log),
        _gaps(log),
        _pauses(log, () if basis is None else basis.stamps.leaps),
        leaping,
        far,
        lapsing,
        swapped,
        *moving,
        *_steps(log, steps_of(log)),
    )
    length = float(log.t[-1] - log.t[0]) if len(log) else 0.0
    return Check(log.source, len(log), int(log.fixed.sum()), length, items, log.notes, basis)


def _there(log: Log, name: str) -> bool:
    return bool(np.isfinite(getattr(log, name)).any())


def _typed(log: Log, name: str, unit: str, sign: str = "") -> str:
    role = _ROLE.get(name, name)
    column = log.columns.get(role, "COLUMN")
    return f"--columns '{role}={sign}{column}[{unit}]'"


def _streams(log: Log) -> Item:
    there = [_LABEL[name] for name in _LABEL if name == "position" or _there(log, name)]
    lacking = [_LABEL[name] for name in ("speed_mps", "yaw_rate_radps") if not _there(log, name)]
    text = f"found {', '.join(there)}"
    if not log.fixed.any():
        return Item("streams", "bad", "there is no position", 0.0)
    if lacking:
        return Item(
            "streams",
            "warn",
            f"{text}; no {' and no '.join(lacking)}, so gaps are bridged from the fixes around them alone",
            float(len(there)),
            line="--columns " + ",".join(f"{name.replace(' ', '_')}=COLUMN" for name in lacking),
        )
    return Item("streams", "ok", text, float(len(there)))


def _rates(log: Log) -> Item:
    rates = log.rates()
    said = ", ".join(f"{_LABEL[name]} {rate:.3g} Hz" for name, rate in rates.items() if rate)
    position = rates["position"]
    slow = [name for name in ("speed_mps", "yaw_rate_radps") if (rate := rates[name]) is not None and rate < 0.5]
    if slow:
        return Item("rates", "warn", f"{said}; below 0.5 Hz a turn is over between two samples", rates[slow[0]], "Hz")
    return Item("rates", "ok", said or "no stream has two samples", position, "Hz")


def _gaps(log: Log) -> Item:
    gaps = log.gaps()
    if not gaps:
        return Item("gaps", "ok", "no gaps between fixes", 0.0, "s")
    lengths = [stop - start for start, stop in gaps]
    k = int(np.argmax(lengths))
    share = sum(lengths) / float(log.t[-1] - log.t[0])
    return Item(
        "gaps",
        "ok",
        f"{len(gaps)} gap{'s' * (len(gaps) > 1)} between fixes, {100 * share:.2g} % of the time, the longest"
        f" {lengths[k]:.1f} s from {gaps[k][0]:.1f} s on",
        lengths[k],
        "s",
    )


def _pauses(log: Log, leaps: Sequence[tuple[float, float]]) -> Item:
    """Look for times at which the sensors that bridge a gap are silent as well; leaps of the clock are none."""
    worst: tuple[float, float, str] | None = None
    for name in ("speed_mps", "yaw_rate_radps"):
        t = log.stream(name)[0]
        if t.size < 2:
            continue
        step = np.diff(t)
        for when, seconds in leaps:
            step -= np.where((t[:-1] < when) & (t[1:] >= when), seconds, 0.0)
        k = int(np.argmax(step))
        if step[k] > max(1.5, 5 * float(np.median(step))) and (worst is None or step[k] > worst[0]):
            worst = (float(step[k]), float(t[k]), _LABEL[name])
    if worst is None:
        return Item("pauses", "ok", "speed and yaw rate arrive without long pauses", 0.0, "s")
    length, start, name = worst
    dead = any(a < start + length and start < b for a, b in log.gaps())
    also = ", and no fix came either: nothing is known there" if dead else ""
    return Item("pauses", "warn", f"no {name} for {length:.1f} s from {start:.1f} s on{also}", length, "s")


def _spikes(log: Log) -> tuple[Item, Log]:
    """Look for speeds and yaw rates that leap away and come back; return the log without them."""
    found = spikes(log)
    if not len(found):
        return Item("spikes", "ok", "no speed or yaw rate leaps away and comes back, or is stuck", 0.0), log
    said = "; ".join(words.removesuffix(": not used") for words in found.words(log))
    item = Item("spikes", "warn", said, float(len(found)), line=check_sensors.fill_line(log))
    return item, found.masked(log)


def _swapped(log: Log) -> Item:
    name = "latitude, longitude"
    if swapped_columns(log):
        lat, lon = log.columns.get("lat", "COLUMN"), log.columns.get("lon", "COLUMN")
        return Item(
            name,
            "bad",
            "swapped: only so do speed and course fit the fixes",
            line=f"--columns 'lat={lon},lon={lat}'",
        )
    if not log.fixed.any():
        return Item(name, "not checked", "there is no position")
    lat_deg, lon_deg = float(np.nanmedian(log.lat_deg)), float(np.nanmedian(log.lon_deg))
    ns, ew = "N" if lat_deg >= 0 else "S", "E" if lon_deg >= 0 else "W"
    return Item(name, "ok", f"around {abs(lat_deg):.4f} {ns}, {abs(lon_deg):.4f} {ew}")


def _outliers(log: Log) -> Item:
    """Look for jumps that neither the speed nor the scatter of the fixes explains."""
    t, position = log.stream("position")
    if t.size < 3:
        return Item("outliers", "not checked", "too few fixes")
    speed = log.stream("speed_mps")[1]
    found = evidence.speed_ratio(log)
    trusted = speed.size > 0 and found.enough and abs(np.log(max(found.value, 1e-9))) < 0.2
    top = 1.3 * float(np.max(np.abs(speed))) + 3.0 if trusted else 70.0
    bad = evidence.impossible_fixes(t, position[:, 0], position[:, 1], top, 12.0)
    share = float(bad.mean())
    if not bad.any():
        return Item("outliers", "ok", "no fix jumps further than speed and fix error explain", 0.0)
    when = evidence.times_of(t, bad, evidence.off_line(t, position[:, 0], position[:, 1], bad))
    return Item(
        "outliers",
        "bad" if share > 0.05 else "warn",
        f"{int(bad.sum())} of {bad.size} fixes jump further than a speed of {top:.0f} m/s explains, at {when}",
        float(bad.sum()),
        line=check_sensors.fill_line(log),
    )


def _trust(log: Log) -> tuple[Item, Distrust]:
    """Look for fixes that were frozen or jumped; return which.

    Where speed and yaw rate speak, it is they that show jumps: see `check_sensors`.
    """
    n = int(log.fixed.sum())
    if n < 10:
        return Item("trust", "not checked", "too few fixes"), NOTHING
    sensed = _there(log, "speed_mps") and _there(log, "yaw_rate_radps")
    found = distrusted(log, jumps=not sensed)
    if not len(found):
        return Item("trust", "ok", "no fix is frozen" + (" or jumps" * (not sensed)), 0.0), found
    said = "; ".join(words.removesuffix(": not used") for words in found.words(log))
    line = check_sensors.fill_line(log)
    item = Item("trust", "bad" if len(found) > 0.05 * n else "warn", said, float(len(found)), line=line)
    return item, found


def _stamps(log: Log, stamps: Stamps) -> Item:
    """Say whether a logger wrote late."""
    if stamps.moved:
        late = max([float(stamps.late.max()), *(seconds for _, seconds in stamps.leaps)])
        return Item("stamps", "warn", stamps.words(), late, "s", check_sensors.fill_line(log))
    if not _there(log, "speed_mps"):
        return Item("stamps", "not checked", "there is no speed to tell when the fixes were taken")
    if not delays(log.t[log.fixed])[1]:
        return Item("stamps", "not checked", "fixes are too few, or come at no regular rate")
    return Item("stamps", "ok", "no row was written so late that fixes and speed tell", 0.0, "s")


def _speed(log: Log) -> Item:
    if not _there(log, "speed_mps"):
        return Item("speed", "not checked", "there is no speed")
    found = evidence.speed_ratio(log)
    if not found.enough:
        return _unmoved(log)
    row = matched_factor(found)
    shown = {"windows": found.n, "spread": found.spread}
    text = f"speed is {found.value:.3f} times the distance between fixes over time"
    if row is not None:
        name = "speed_mps" if row[3] == 1 else "time"
        return Item(
            "speed", "bad", f"{text}: {row[1]}", found.value, "", _typed(log, name, _UNIT_AS_TYPED[row[1]]), shown
        )
    if abs(found.value - 1) > 0.1:
        text += ", 1 is expected and no known unit explains it: another column?"
        return Item("speed", "bad", text, found.value, "", "--columns speed=COLUMN", shown)
    if abs(found.value - 1) > 0.04:
        # a scale that `fill` finds
        return Item("speed", "warn", f"{text}, 1 is expected", found.value, "", check_sensors.fill_line(log), shown)
    return Item("speed", "ok", text, found.value, "", "", shown)


def _unmoved(log: Log) -> Item:
    """Judge the speed of a car whose fixes hardly move: it stands, or they are no positions."""
    t, speed = log.stream("speed_mps")
    way = float(np.sum(np.diff(t) * np.abs(speed[:-1])))
    fixed = log.fixed
    east, north = evidence.local_metres(log.lat_deg[fixed], log.lon_deg[fixed])
    wide = float(np.hypot(np.ptp(east), np.ptp(north))) if east.size else 0.0
    if way < _WAY or way < _WAYS * wide:
        return Item("speed", "not checked", "the car hardly moves between fixes")
    text = f"the speed adds up to {way:,.0f} m while all fixes lie within {wide:.3g} m"
    as_degrees = log
    if np.abs(log.lat_deg[fixed]).max() <= np.pi / 2 and np.abs(log.lon_deg[fixed]).max() <= np.pi:
        as_degrees = replace(log, lat_deg=np.degrees(log.lat_deg), lon_deg=np.degrees(log.lon_deg))
    turned = evidence.speed_ratio(as_degrees)
    if turned.enough and abs(np.log(max(turned.value, 1e-9))) < 0.2:
        lat, lon = (log.columns.get(role, "COLUMN") for role in ("lat", "lon"))
        line = f"--columns 'lat={lat}[rad],lon={lon}[rad]'"
        return Item("speed", "bad", f"{text}: positions are in radians", way, "m", line)
    line = "--columns lat=COLUMN,lon=COLUMN"
    return Item("speed", "bad", f"{text}: are these the columns of the position?", way, "m", line)


def _azimuth(log: Log) -> Item:
    if not _there(log, "azimuth_rad"):
        return Item("azimuth", "not checked", "there is no azimuth")
    ours = evidence.course_errors(log)["radians clockwise from north"]
    if not ours.enough:
        return Item("azimuth", "not checked", "the car hardly moves between fixes")
    degrees = float(np.degrees(ours.value))
    shown = {"windows": ours.n, "spread": float(np.degrees(ours.spread))}
    text = f"azimuth and course between fixes differ by {degrees:.1f} degrees in the middle"
    convention = contradicted_convention(log)
    if convention is not None:
        degrees_given = convention.startswith("degrees")
        line = check_sensors.fill_line(log)  # which turns what is counted from east
        if convention.endswith("clockwise from north"):
            sign = "-" if "counter" in convention else ""
            line = _typed(log, "azimuth_rad", "deg" if degrees_given else "rad", sign)
        return Item("azimuth", "bad", f"{text}: it is in {convention}", degrees, "deg", line, shown)
    if degrees > 20:
        text += ", no known convention explains it: another column?"
        return Item("azimuth", "bad", text, degrees, "deg", "--columns azimuth=COLUMN", shown)
    if degrees > 6:
        return Item("azimuth", "warn", text, degrees, "deg", "", shown)
    return Item("azimuth", "ok", text, degrees, "deg", "", shown)


def _yaw(log: Log) -> Item:
    if not _there(log, "yaw_rate_radps"):
        return Item("yaw rate", "not checked", "there is no yaw rate")
    found = evidence.turning(log)
    if not found.enough:
        return Item("yaw rate", "not checked", "the car hardly turns between fixes", None)
    shown = {"turns": found.n, "correlation": found.correlation}
    text = f"the course changes {found.slope:.3f} times as much as the yaw rate says"
    factor = contradicted_yaw(found)
    if factor is not None:
        unit = "deg/s" if abs(factor) < 0.5 else "rad/s"
        wrong = [] if abs(factor) == 1 else [f"it is in {unit}"]
        wrong += ["its sign is that of a turn to the right"] if factor < 0 else []
        line = _typed(log, "yaw_rate_radps", unit, "-" if factor < 0 else "")
        return Item("yaw rate", "bad", f"{text}: {' and '.join(wrong)}", found.slope, "", line, shown)
    if abs(found.slope - 1) > 0.25:
        text += ", 1 is expected: another column?"
        return Item("yaw rate", "warn", text, found.slope, "", "--columns yaw_rate=COLUMN", shown)
    return Item("yaw rate", "ok", text, found.slope, "", "", shown)


def _steps(log: Log, found: Mapping[str, float]) -> list[Item]:
    """Look at the quantisation of each stream."""
    items = []
    for name in STREAMS:
        values = log.stream(name)[1]
        if name not in _COARSE or values.size < 20:
            continue
        limit, unit, words = _COARSE[name]
        step = found.get(name)
        title = f"step of {name}"
        if step is None:
            items.append(Item(title, "ok", "no quantisation step found", None, unit))
        elif step > limit:
            items.append(
                Item(
                    title,
                    "warn",
                    f"values come in steps of {step:.4g} {unit}, coarser than {words}: an error of up to"
                    f" {step / 2:.2g} {unit} is built in",
                    step,
                    unit,
                )
            )
        else:
            items.append(Item(title, "ok", f"values come in steps of {step:.4g} {unit}", step, unit))
    return items
