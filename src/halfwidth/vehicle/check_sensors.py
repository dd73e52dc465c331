"""What the calibration of a log's sensors says, point by point.

Each point rests on a `Calibration`; `fill` applies all of it by itself, so what is to be typed is `fill`.
"""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from halfwidth.vehicle import adrift
from halfwidth.vehicle.align import EDGE
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.lapse import put_right, words
from halfwidth.vehicle.lapses import lapses
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.sensors import STREAM, Calibration, Offset
from halfwidth.vehicle.stamps import Stamps
from halfwidth.vehicle.stray import strays

#: The points, in order.
NAMES = (
    "clock of speed",
    "clock of yaw rate",
    "clock of azimuth",
    "speed scale",
    "yaw bias",
    "antenna",
    "standstill",
    "side slip",
    "fix error",
    "stray fixes",
)

#: An offset below this is none worth mentioning, s; nor is one below three of its standard deviations.
_CLOCK = 0.05

#: A scale further off than this is worth a warning, and known worse than this it is not known.
_SCALE, _SCALE_SD = 0.05, 0.02

#: Likewise the bias, rad/s.
_BIAS, _BIAS_SD = 0.02, 0.005

#: A car that moves sideways by more than this share of its speed does not point where it goes.
_SLIP = 0.1


@dataclass(frozen=True)
class Item:
    """One point of a check.

    Attributes
    ----------
    name : str
        What was looked at.
    verdict : str
        ``"ok"``, ``"warn"``, ``"bad"`` or ``"not checked"``.
    sentence : str
        What was found, in words.
    value : float or None
        The number it rests on.
    unit : str
        Its unit, empty for a ratio.
    line : str
        What to type, empty where there is nothing to do.
    evidence : mapping of str to number, text or list
        What the number itself rests on: spreads, counts, times.
    """

    name: str
    verdict: str
    sentence: str
    value: float | None = None
    unit: str = ""
    line: str = ""
    evidence: Mapping[str, Any] = field(default_factory=dict, repr=False, hash=False)

    def to_dict(self) -> dict[str, Any]:
        """Give the point as plain data."""
        return {
            "name": self.name,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "value": self.value,
            "unit": self.unit,
            "line": self.line or None,
            "evidence": dict(self.evidence),
        }


def has(log: Log, name: str) -> bool:
    """Return whether a field of a log has a value anywhere."""
    return bool(np.isfinite(getattr(log, name)).any())


def fill_line(log: Log) -> str:
    """Return the command that fills a log."""
    source = log.source or "LOG"
    return f"halfwidth fill {shlex.quote(source)} -o track.gpx"


def far_clock(log: Log) -> tuple[Item, Log]:
    """Look for a clock of the sensors that is far off; return the log with them moved."""
    seconds = adrift.adrift(log)
    if seconds is None:
        text = f"speed and fixes are within {adrift.NEAR:g} s of each other as far as stops and starts tell"
        return Item("sensor clock", "ok", text, 0.0, "s"), log
    said = adrift.words(seconds).removesuffix(": moved")
    item = Item("sensor clock", "bad", f"{said}; fill moves them", seconds, "s", fill_line(log))
    return item, adrift.moved(log, seconds)


def lapsing(log: Log) -> tuple[Item, Log]:
    """Look for stretches in which speed or yaw rate contradict the fixes; return the log with them put right."""
    found = lapses(log)
    if not found:
        return Item("lapses", "ok", "no stretch of the speed or yaw rate contradicts the fixes by a factor", 0.0), log
    said = "; ".join(words(log, found)).replace(": put right", "").replace(": not used", "")
    item = Item("lapses", "bad", said, float(len(found)), line=fill_line(log))
    return item, put_right(log, found)


def items(log: Log, known: Calibration, stamps: Stamps | None = None) -> list[Item]:
    """Give a verdict on each point.

    Parameters
    ----------
    log : Log
    known : Calibration
        Of this log.
    stamps : Stamps, optional
        How its rows were moved, so that times are named as written.

    Returns
    -------
    list of Item
        In the order of `NAMES`.
    """
    return [
        *(_clock(log, known, name) for name in STREAM),
        _scale(log, known),
        _bias(log, known),
        _antenna(known),
        _standstill(log, known),
        _slip(known),
        _fix_error(known),
        _strays(log, known, stamps),
    ]


def _clock(log: Log, known: Calibration, stream: str) -> Item:
    words = stream.replace("_", " ")
    name = f"clock of {words}"
    if not has(log, STREAM[stream]):
        return Item(name, "not checked", f"there is no {words}")
    one = known.offsets.get(stream, Offset())
    shown = {"sd": _number(one.sd), "change": one.change or None, "at": [list(pair) for pair in one.at]}
    if not one.observable:
        text = "not observable: too little of it shows against the fixes"
        if np.isfinite(one.sd):
            text += f" ({one.seconds:+.2f} s, give or take {one.sd:.2f} s)"
        return Item(name, "not checked", text, evidence=shown)
    if one.change == "step":
        (_, before), (when, after) = one.at
        text = f"steps at about {when:.0f} s: the {words} has to be moved by {before:+.2f} s, then by {after:+.2f} s,"
    elif one.change == "drift":
        text = (
            f"drifts: the {words} has to be moved by {one.at[0][1]:+.2f} s at first and {one.at[-1][1]:+.2f} s at last"
        )
    else:
        text = f"the {words} has to be moved by {one.seconds:+.3f} s (standard deviation {one.sd:.3f} s)"
        if abs(one.seconds) < max(_CLOCK, 3 * one.sd):
            text = (
                f"agrees with the fixes as far as they tell: {one.seconds:+.3f} s (standard deviation {one.sd:.3f} s)"
            )
            return Item(name, "ok", text, one.seconds, "s", evidence=shown)
    return Item(name, "warn", f"{text} to agree with the fixes; fill does", one.seconds, "s", fill_line(log), shown)


def _scale(log: Log, known: Calibration) -> Item:
    name = "speed scale"
    if not known.scale_sd < _SCALE_SD:
        return Item(name, "not checked", "the fixes are too rough, or too few, to tell it")
    percent, sd = 100 * (1 / known.scale - 1), 100 * known.scale_sd
    warn = abs(percent) > 100 * _SCALE
    text = f"the speed reads {percent:+.2f} % of the truth (standard deviation {sd:.2f} %)"
    line = fill_line(log) if warn else ""
    return Item(name, "warn" if warn else "ok", text, 1 / known.scale, "", line, {"sd": known.scale_sd})


def _bias(log: Log, known: Calibration) -> Item:
    name = "yaw bias"
    if not known.bias_sd < _BIAS_SD:
        return Item(name, "not checked", "nothing tells it: neither fixes along turns nor a car that stands")
    values = [bias for _, bias in known.bias_at]
    text = f"{known.bias:+.4f} rad/s (standard deviation {known.bias_sd:.4f})"
    if len(values) > 1:
        text += f", from {min(values):+.4f} to {max(values):+.4f} along the drive"
    if np.isfinite(known.still_bias):
        text += f", {known.still_bias:+.4f} while the car stands"
    shown = {
        "sd": known.bias_sd,
        "standing": _number(known.still_bias),
        "at": [list(pair) for pair in known.bias_at],
    }
    warn = abs(known.bias) > _BIAS
    return Item(name, "warn" if warn else "ok", text, known.bias, "rad/s", fill_line(log) if warn else "", shown)


def _antenna(known: Calibration) -> Item:
    shown = {"sd": [_number(sd) for sd in known.antenna_sd], "ahead_left": list(known.antenna)}
    if known.antenna_observable:
        ahead, left = known.antenna
        text = (
            f"sits {abs(ahead):.2f} m {'ahead of' if ahead >= 0 else 'behind'} the rear axle and {abs(left):.2f} m"
            f" {'left' if left >= 0 else 'right'} of its middle; fill counts on it"
        )
        return Item("antenna", "ok", text, float(np.hypot(ahead, left)), "m", evidence=shown)
    text = "taken to sit over the rear axle: the log does not tell it from there"
    return Item("antenna", "not checked", text, evidence=shown)


def _standstill(log: Log, known: Calibration) -> Item:
    t = log.stream("speed_mps")[0]
    if t.size < 2:
        return Item("standstill", "not checked", "there is no speed")
    held = float(np.sum(known.still[:, 1] - known.still[:, 0] + 2 * EDGE))
    share = held / float(t[-1] - t[0])
    n = len(known.still)
    text = f"the car stands {n} time{'' if n == 1 else 's'}, {held:.0f} s or {100 * share:.0f} % of the time"
    return Item("standstill", "ok", text, share, "", evidence={"times": known.still.tolist()})


def _slip(known: Calibration) -> Item:
    if not np.isfinite(known.slip):
        return Item("side slip", "not checked", "nothing tells it")
    warn = known.slip > _SLIP
    text = f"the car moves sideways by {100 * known.slip:.1f} % of its speed over a second"
    text += ": is the yaw rate that of this car?" if warn else ""
    line = "--columns yaw_rate=COLUMN" if warn else ""
    return Item("side slip", "warn" if warn else "ok", text, known.slip, "", line)


def _fix_error(known: Calibration) -> Item:
    if "fix" not in known.noise:
        return Item("fix error", "not checked", "nothing tells it")
    quick, wander = known.noise["fix"], known.noise["offset"]
    text = f"fixes scatter by {quick:.2g} m and wander by {wander * np.sqrt(10):.2g} m in ten seconds, as learnt"
    return Item("fix error", "ok", text, quick, "m", evidence=dict(known.noise))


def _strays(log: Log, known: Calibration, stamps: Stamps | None) -> Item:
    if not known.noise or not {"speed", "yaw_rate"} <= set(known.offsets):
        return Item("stray fixes", "not checked", "it needs speed, yaw rate and fixes that agree with them")
    grid = sampled(log, sensors=known)
    found = strays(grid, known)
    if stamps is not None:
        grid = replace(grid, t=stamps.back(grid.t))
    if not found.at.size:
        return Item("stray fixes", "ok", "no fix lies where the vehicle cannot have been", 0.0)
    shown = {"times": grid.t[found.at].tolist(), "off_m": found.size.tolist()}
    text = found.words(grid).replace(" and is left out", "").replace(" and are left out", "")
    return Item("stray fixes", "warn", f"{text}; fill leaves them out", float(found.at.size), "", fill_line(log), shown)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
