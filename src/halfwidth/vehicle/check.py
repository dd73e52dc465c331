"""What is wrong with a log, each point with a verdict, the number it rests on and what to type.

Nothing is repaired here. Units, signs and conventions are judged against the fixes (`evidence`),
times against themselves, values against what a car does. What `fill` would do of its own is done here in
the same order before the sensors are judged: leaps, frozen fixes and late stamps spoil a calibration. What the
log cannot tell is said to be not checked, never guessed.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import check_sensors, check_units, evidence
from halfwidth.vehicle.align import calibrated, steps_of
from halfwidth.vehicle.check_sensors import Item as Item
from halfwidth.vehicle.distrust import NOTHING, Distrust, distrusted
from halfwidth.vehicle.log import STREAMS, Log
from halfwidth.vehicle.sensors import Calibration
from halfwidth.vehicle.spikes import spikes
from halfwidth.vehicle.stamps import Stamps, delays, restamped
from halfwidth.vehicle.units import azimuth_put_right, matched_factor

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

_LABEL = {
    "position": "position",
    "alt_m": "height",
    "azimuth_rad": "azimuth",
    "speed_mps": "speed",
    "yaw_rate_radps": "yaw rate",
    "ax_mps2": "acceleration x",
    "ay_mps2": "acceleration y",
}


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
    swapped = check_units.swapped(log)
    basis = None
    if swapped.verdict == "bad":
        first = "put latitude and longitude right first"
        names = ("outliers", "speed", "azimuth", "yaw rate", "trust", "stamps", *check_sensors.NAMES)
        moving = [Item(name, "not checked", first) for name in names]
    else:
        trust, doubted = _trust(log)
        believed = doubted.masked(log)
        moving = [_outliers(believed), check_units.speed(log), check_units.azimuth(log), check_units.yaw(log)]
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


def _streams(log: Log) -> Item:
    there = [_LABEL[name] for name in _LABEL if name == "position" or check_sensors.has(log, name)]
    lacking = [_LABEL[name] for name in ("speed_mps", "yaw_rate_radps") if not check_sensors.has(log, name)]
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
    sensed = check_sensors.has(log, "speed_mps") and check_sensors.has(log, "yaw_rate_radps")
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
    if not check_sensors.has(log, "speed_mps"):
        return Item("stamps", "not checked", "there is no speed to tell when the fixes were taken")
    if not delays(log.t[log.fixed])[1]:
        return Item("stamps", "not checked", "fixes are too few, or come at no regular rate")
    return Item("stamps", "ok", "no row was written so late that fixes and speed tell", 0.0, "s")


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
