"""What is known of a log's sensors: clocks, scale, bias, where the antenna sits; and the streams put right by it.

A `Calibration` is what `halfwidth.vehicle.align` finds, as plain values. `Calibration.stream` gives a stream of a log
as it would be had the sensor been perfect:

    time      = stamp + offset(stamp)
    speed     = scale * factor * logged speed, and what it is at the rear axle: sqrt(speed^2 - (wheels * yaw rate)^2)
    yaw rate  = factor * logged yaw rate - bias(time),      0 while the car stands

Offsets and bias may change along the drive: they are given at some times and taken to go straight in between.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle.log import Log

Floats = NDArray[np.float64]

#: Streams that have a clock of their own, and the field of a log each one is.
STREAM: Mapping[str, str] = MappingProxyType(
    {"speed": "speed_mps", "yaw_rate": "yaw_rate_radps", "azimuth": "azimuth_rad"}
)


@dataclass(frozen=True)
class Offset:
    """The clock of one stream against that of the fixes.

    Parameters
    ----------
    seconds : float
        What is to be added to the stream's time stamps so that they agree with those of the fixes: positive where a
        fix comes later than a sample of the same moment. The mean over the drive, if it changes.
    sd : float
        Its standard deviation, s; infinite where nothing is known.
    observable : bool
        Whether the log tells it. An offset that is not observable is not applied.
    at : tuple of (float, float)
        Time stamp and offset, s, where the offset changes along the drive; empty where it does not.
    change : str
        ``""``, ``"step"`` or ``"drift"``.
    given : bool
        Whether it was given and not found.
    """

    seconds: float = 0.0
    sd: float = float("inf")
    observable: bool = False
    at: tuple[tuple[float, float], ...] = ()
    change: str = ""
    given: bool = False

    def moved(self, t: Floats) -> Floats:
        """Return time stamps (n,) on the clock of the fixes, s."""
        if not self.observable:
            return t
        if not self.at:
            return t + self.seconds
        when, seconds = np.array(self.at).T
        return np.asarray(t + np.interp(t, when, seconds))


@dataclass(frozen=True, eq=False)
class Calibration:
    """Clocks, scale, bias and antenna of one log.

    Parameters
    ----------
    offsets : mapping of str to Offset
        For ``"speed"``, ``"yaw_rate"`` and ``"azimuth"``, of those that the log has.
    speed_factor, yaw_factor : float
        What makes a wrong unit or sign right; 1 where it is right.
    scale, scale_sd : float
        What the speed is multiplied by so that it agrees with the fixes, and its standard deviation.
    bias, bias_sd : float
        What the gyro adds, rad/s: the mean over the drive and its standard deviation.
    bias_at : tuple of (float, float)
        Time on the clock of the fixes, s, and bias there, rad/s.
    antenna, antenna_sd : (float, float)
        Where the antenna sits, in metres ahead of the point that does not slip sideways (the middle of the rear axle)
        and to the left of it; standard deviations.
    antenna_observable : bool
        Whether the log tells it; if not it is taken to sit at that point.
    wheels, wheels_sd : float
        How far ahead of the rear axle the wheels are whose speed is logged, m: in turns they go further than it does;
        0 where the log does not show it. Standard deviation.
    course_error : float
        What the receiver's azimuth adds to that of the path, rad; NaN where there is none.
    steps : mapping of str to float
        Quantisation step of each stream that has one, in units of the log; half of it is the least half-width.
    still : (n, 2) array
        First and last time of each standstill, s.
    still_bias : float
        Mean yaw rate while the car stands, rad/s; NaN where it never stands for long.
    slip : float
        How far the car moves sideways, as learnt: standard deviation of the sideways speed over a second, as a share
        of the forward speed.
    noise : mapping of str to float
        Scales of the chain's residuals as learnt from the drive, stray fixes apart; empty where nothing could be
        learnt.
    path : (n, 2) array
        Time, s, and azimuth, rad, along the drive, where the antenna is observable.
    messages : tuple of str
        What was found, in words.
    """

    offsets: Mapping[str, Offset] = field(default_factory=dict)
    speed_factor: float = 1.0
    yaw_factor: float = 1.0
    scale: float = 1.0
    scale_sd: float = float("inf")
    bias: float = 0.0
    bias_sd: float = float("inf")
    bias_at: tuple[tuple[float, float], ...] = ()
    antenna: tuple[float, float] = (0.0, 0.0)
    antenna_sd: tuple[float, float] = (float("inf"), float("inf"))
    antenna_observable: bool = False
    wheels: float = 0.0
    wheels_sd: float = float("inf")
    course_error: float = float("nan")
    steps: Mapping[str, float] = field(default_factory=dict)
    still: Floats = field(default_factory=lambda: np.empty((0, 2)), repr=False)
    still_bias: float = float("nan")
    slip: float = float("nan")
    noise: Mapping[str, float] = field(default_factory=dict, repr=False)
    path: Floats = field(default_factory=lambda: np.empty((0, 2)), repr=False)
    messages: tuple[str, ...] = ()

    def stream(self, log: Log, name: str) -> tuple[Floats, Floats]:
        """Give a stream of a log as a perfect sensor would have logged it.

        Parameters
        ----------
        log : Log
        name : {"speed", "yaw_rate", "azimuth"}

        Returns
        -------
        t : (n,) array
            Times on the clock of the fixes, s, strictly increasing.
        values : (n,) array
            In units of the log.
        """
        t, values = log.stream(STREAM[name])
        if name in self.offsets:
            t = self.offsets[name].moved(t)
            # where the clock steps back, what the step repeats is dropped
            ahead = np.concatenate(([-np.inf], np.maximum.accumulate(t)[:-1]))
            t, values = t[t > ahead], values[t > ahead]
        if name == "speed":
            values = self.at_axle(log, t, self.speed_factor * self.scale * values)
        elif name == "yaw_rate":
            values = self.yaw_factor * values - self.bias_of(t)
            values = np.where(self.stands(t), 0.0, values)
        elif name == "azimuth" and np.isfinite(self.course_error):
            values = values - self.course_error
        return t, values

    def at_axle(self, log: Log, t: Floats, speed: Floats) -> Floats:
        """Return the speed of the rear axle at times (n,) on the clock of the fixes, from that of the wheels, m/s."""
        clock, rate = self.stream(log, "yaw_rate") if self.wheels else (t, t)
        if not self.wheels or clock.size == 0:
            return speed
        swing = self.wheels * np.interp(t, clock, rate)
        return np.asarray(np.sign(speed) * np.sqrt(np.maximum(speed**2 - swing**2, 0.0)))

    def bias_of(self, t: Floats) -> Floats:
        """Return the bias of the gyro at times (n,) on the clock of the fixes, rad/s."""
        if not self.bias_at:
            return np.full(np.shape(t), self.bias)
        when, bias = np.array(self.bias_at).T
        return np.asarray(np.interp(t, when, bias))

    def stands(self, t: Floats) -> NDArray[np.bool_]:
        """Return at which times (n,) the car surely stands."""
        if not len(self.still):
            return np.zeros(np.shape(t), dtype=bool)
        k = np.searchsorted(self.still[:, 0], t, side="right") - 1
        return np.asarray((k >= 0) & (t <= self.still[np.maximum(k, 0), 1]))

    def arm(self, t: Floats) -> tuple[Floats, Floats]:
        """Return how far east and north of the axle the antenna is at times (n,), m: 0 where it is not observable."""
        if not self.antenna_observable or not len(self.path):
            return np.zeros(np.shape(t)), np.zeros(np.shape(t))
        azimuth = np.interp(t, self.path[:, 0], self.path[:, 1])
        ahead, left = self.antenna
        sin, cos = np.sin(azimuth), np.cos(azimuth)
        return ahead * sin - left * cos, ahead * cos + left * sin

    def words(self) -> list[str]:
        """Say what was found and is applied."""
        said = list(self.messages)
        clocks = [f"{name.replace('_', ' ')} {_clock(one)}" for name, one in self.offsets.items()]
        if clocks:
            said.append(f"clocks against the fixes: {', '.join(clocks)}")
        found = []
        if np.isfinite(self.scale_sd):
            found.append(f"speed scale {self.scale:.4f} +- {self.scale_sd:.4f}")
        if np.isfinite(self.bias_sd):
            found.append(f"yaw bias {self.bias:+.4f} +- {self.bias_sd:.4f} rad/s")
        if self.wheels:
            found.append(f"speed of wheels {self.wheels:.2f} +- {self.wheels_sd:.2f} m ahead of the rear axle")
        if self.antenna_observable:
            ahead, left = self.antenna
            found.append(
                f"antenna {abs(ahead):.2f} m {'ahead of' if ahead >= 0 else 'behind'} the axle and {abs(left):.2f} m"
                f" {'left' if left >= 0 else 'right'} of the middle"
            )
        if found:
            said.append(f"found from the log and applied: {', '.join(found)}")
        return said

    def to_dict(self) -> dict[str, Any]:
        """Give everything as plain data; None where a number is not known."""
        return {
            "offsets": {
                name: {
                    "seconds": one.seconds,
                    "sd": _finite(one.sd),
                    "observable": one.observable,
                    "change": one.change or None,
                    "at": [list(pair) for pair in one.at],
                    "given": one.given,
                }
                for name, one in self.offsets.items()
            },
            "speed_factor": self.speed_factor,
            "yaw_factor": self.yaw_factor,
            "speed_scale": self.scale,
            "speed_scale_sd": _finite(self.scale_sd),
            "yaw_bias": self.bias,
            "yaw_bias_sd": _finite(self.bias_sd),
            "yaw_bias_at": [list(pair) for pair in self.bias_at],
            "antenna": list(self.antenna),
            "antenna_sd": [_finite(sd) for sd in self.antenna_sd],
            "antenna_observable": self.antenna_observable,
            "wheels": self.wheels,
            "wheels_sd": _finite(self.wheels_sd),
            "course_error": _finite(self.course_error),
            "steps": dict(self.steps),
            "standstill_s": float(np.sum(self.still[:, 1] - self.still[:, 0])),
            "standstill_bias": _finite(self.still_bias),
            "slip": _finite(self.slip),
        }


#: Nothing is known: the streams are taken as they are.
AS_LOGGED = Calibration()


def _clock(one: Offset) -> str:
    if one.given:
        return f"{one.seconds:+.3g} s as given"
    if not one.observable:
        return "not observable, taken to agree"
    if one.change == "step":
        (_, before), (when, after) = one.at
        return f"{before:+.2f} s up to {when:.0f} s, then {after:+.2f} s"
    if one.change == "drift":
        return f"from {one.at[0][1]:+.2f} s to {one.at[-1][1]:+.2f} s, +- {one.sd:.2g} s"
    return f"{one.seconds:+.2f} +- {one.sd:.2g} s"


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
