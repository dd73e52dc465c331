"""A simulated drive with known truth, and the log a car would have kept of it.

A road is drawn as straights and curves whose curvature changes along a transition, with lights that
stop the car. The speed is the fastest that keeps the limit, the lateral acceleration in curves and
the car's own acceleration and braking, found by one pass forwards and one backwards along the road.
The sensors then see it as cheap ones do: a speed in steps of the bus, a gyro with a drifting bias,
fixes that are wrong mostly by a slowly varying offset, and nothing at all from the receiver in a
tunnel:

    speed  = round(scale * v / step) * step
    gyro   = yaw rate + bias + white,           bias a random walk
    fix    = position + offset + white,         d offset = -offset / time * dt + ..., both axes
             + multipath * exp(-s / time)       s seconds after the end of a tunnel

Each stream has its own clock. The fixes are those of an antenna, which may sit anywhere on the car;
the car turns about the middle of its rear axle, whose speed the odometer counts. A second antenna
gives a second log of fixes, and an azimuth that does not need the car to move.

The road is integrated on the ellipsoid, so that distances and turns agree with the speed and the
yaw rate to rounding.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.errors import BadValue
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.track import radii_m, steps_m

Floats = NDArray[np.float64]

#: Steps in time and along the road on which the drive is laid out, in seconds and metres.
_DT, _DS = 0.01, 0.25

#: Speeds that drivers want on a stretch of road, m/s.
_LIMITS = (30 / 3.6, 40 / 3.6, 50 / 3.6)

_SPEED_UP, _BRAKE, _SIDEWAYS = 1.6, 2.0, 2.5  # m/s^2


@dataclass(frozen=True, eq=False)
class Truth:
    """What really happened, at every row of the log.

    Parameters
    ----------
    t : (N,) array
        Time in seconds, the rows of the log.
    lat_deg, lon_deg, alt_m : (N,) arrays
        Position of the antenna in degrees and metres.
    azimuth_rad : (N,) array
        Direction of travel in radians, clockwise from north.
    speed_mps : (N,) array
        Speed in metres per second.
    yaw_rate_radps : (N,) array
        Yaw rate in radians per second, positive to the left.
    yaw_bias_radps : (N,) array
        What the gyro added.
    fix_east_m, fix_north_m : (N,) arrays
        The slowly varying offset of the fixes.
    outages : tuple of (float, float)
        First and last time without a fix, for each tunnel.
    clock_offset : float
        Seconds by which the fixes came late.
    speed_scale : float
        What the odometer multiplied the speed by.
    speed_delay, yaw_delay : float
        Seconds by which the speed and the yaw rate came late: `clock_offset` less these is what has to be added to
        their time stamps for them to agree with the fixes.
    antenna : (float, float)
        Where the antenna sits, in metres ahead of the middle of the rear axle and to the left of it.
    second : Log or None
        What a second antenna recorded: its fixes, at the times of the first one's.
    """

    t: Floats
    lat_deg: Floats
    lon_deg: Floats
    alt_m: Floats
    azimuth_rad: Floats
    speed_mps: Floats
    yaw_rate_radps: Floats
    yaw_bias_radps: Floats
    fix_east_m: Floats
    fix_north_m: Floats
    outages: tuple[tuple[float, float], ...]
    clock_offset: float
    speed_scale: float
    speed_delay: float = 0.0
    yaw_delay: float = 0.0
    antenna: tuple[float, float] = (0.0, 0.0)
    second: Log | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    def at(self, t: ArrayLike) -> tuple[Floats, Floats]:
        """Give latitude and longitude in degrees at any times of the drive."""
        when = np.asarray(t, dtype=np.float64)
        return np.interp(when, self.t, self.lat_deg), np.interp(when, self.t, self.lon_deg)

    def error_m(self, t: ArrayLike, lat_deg: ArrayLike, lon_deg: ArrayLike) -> tuple[Floats, Floats]:
        """Measure how far positions are from the truth.

        Parameters
        ----------
        t, lat_deg, lon_deg : (M,) arrays
            Times in seconds and positions in degrees.

        Returns
        -------
        east, north : (M,) arrays
            Position minus truth in metres.
        """
        lat, lon = self.at(t)
        meridian, normal = radii_m(np.radians(lat))
        east = np.radians(np.asarray(lon_deg) - lon) * normal * np.cos(np.radians(lat))
        return east, np.radians(np.asarray(lat_deg) - lat) * meridian


def simulate_drive(
    *,
    duration: float = 600.0,
    seed: int = 1,
    rate: float = 10.0,
    fix_rate: float | None = None,
    tunnels: Sequence[float] = (10.0, 25.0, 45.0),
    outages: Sequence[tuple[float, float]] | None = None,
    fix_noise: float = 0.3,
    fix_offset: float = 1.0,
    fix_offset_time: float = 60.0,
    speed_step: float = 0.25 / 3.6,
    speed_scale: float = 1.0,
    yaw_noise: float = 0.004,
    yaw_bias: float = 0.004,
    yaw_drift: float = 1e-4,
    yaw_step: float = 0.0,
    clock_offset: float = 0.0,
    speed_delay: float = 0.0,
    yaw_delay: float = 0.0,
    multipath: float = 0.0,
    multipath_time: float = 3.0,
    antenna: tuple[float, float] = (0.0, 0.0),
    second: tuple[float, float] | None = None,
    start: tuple[float, float] = (50.0872, 14.4208),
    epoch_s: float | None = None,
) -> tuple[Truth, Log]:
    """Simulate a drive and the log that was kept of it.

    Parameters
    ----------
    duration : float
        Length of the drive in seconds.
    seed : int
        The same seed gives the same drive, bit for bit.
    rate : float
        Rows per second: speed, yaw rate and acceleration.
    fix_rate : float, optional
        Fixes per second, at most `rate`; without it every row has one.
    tunnels : sequence of float
        Length of each tunnel in seconds. They are placed where the car moves, apart from each
        other and from both ends.
    outages : sequence of (float, float), optional
        First and last time of each outage instead, in seconds.
    fix_noise : float
        Standard deviation of the white part of a fix's error, in metres, each axis.
    fix_offset, fix_offset_time : float
        Standard deviation in metres and correlation time in seconds of its slow part.
    speed_step : float
        Step of the odometer's speed in metres per second; 0 for none.
    speed_scale : float
        What the odometer multiplies the speed by.
    yaw_noise, yaw_bias, yaw_drift : float
        The gyro's white noise and first bias (standard deviations in radians per second), and the
        increments of the bias in radians per second per root second.
    yaw_step : float
        Step of the gyro in radians per second; 0 for none.
    clock_offset : float
        Seconds by which fixes come late: the row at t has the position of t minus this.
    speed_delay, yaw_delay : float
        Seconds by which the speed and the yaw rate come late.
    multipath, multipath_time : float
        By how many metres the first fix after a tunnel is wrong, in a direction drawn for each tunnel, and the time
        constant in seconds with which that fades.
    antenna : (float, float)
        Where the antenna sits, in metres ahead of the middle of the rear axle and to the left of it.
    second : (float, float), optional
        Where a second antenna sits, likewise. The azimuth is then that of the line between the two, also while
        standing, and `Truth.second` is the log of its fixes: the slow error is the same for both antennas, the white
        one is not.
    start : (float, float)
        Latitude and longitude of the start in degrees.
    epoch_s : float, optional
        Unix time of the start, where the log is to have one.

    Returns
    -------
    truth : Truth
        What really happened, at every row.
    log : Log
        What was recorded, with NaN where nothing arrived.

    Raises
    ------
    BadValue
        If a number is out of range, or the tunnels do not fit into the drive.

    Examples
    --------
    >>> truth, log = simulate_drive(duration=120, tunnels=[20])
    >>> len(log), len(log.gaps())
    (1201, 1)
    """
    if not 10 <= duration <= 1e5:
        raise BadValue(f"`duration` is {duration} s, between 10 s and 100000 s is expected")
    if not 0.1 <= rate <= 100:
        raise BadValue(f"`rate` is {rate} Hz, between 0.1 Hz and 100 Hz is expected")
    if fix_rate is not None and not 0 < fix_rate <= rate:
        raise BadValue(f"`fix_rate` is {fix_rate} Hz, above 0 and at most `rate` is expected")
    for name, value in (
        ("fix_noise", fix_noise),
        ("fix_offset", fix_offset),
        ("speed_step", speed_step),
        ("yaw_noise", yaw_noise),
        ("yaw_bias", yaw_bias),
        ("yaw_drift", yaw_drift),
        ("yaw_step", yaw_step),
        ("multipath", multipath),
    ):
        if not 0 <= value < np.inf:
            raise BadValue(f"`{name}` is {value}, 0 or more is expected")
    for name, value in (("clock_offset", clock_offset), ("speed_delay", speed_delay), ("yaw_delay", yaw_delay)):
        if not abs(value) <= 60:
            raise BadValue(f"`{name}` is {value} s, at most a minute either way is expected")
    if not multipath_time > 0:
        raise BadValue(f"`multipath_time` is {multipath_time} s, a positive number is expected")
    if second is not None and np.hypot(second[0] - antenna[0], second[1] - antenna[1]) < 0.1:
        raise BadValue(f"`second` is {second}, at least 0.1 m from `antenna` at {antenna} is expected")
    rng, more = np.random.default_rng(seed), np.random.default_rng([seed, 2])
    lead = max(abs(clock_offset), abs(speed_delay), abs(yaw_delay)) + 1.0
    fine, speed, azimuth, axle_lat, axle_lon = _motion(rng, duration + 2 * lead, start)
    fine = fine - lead
    lat, lon = _moved(axle_lat, axle_lon, *_ahead(azimuth, antenna))

    t = np.arange(int(np.floor(duration * rate + 1e-9)) + 1) / rate
    v = np.interp(t, fine, speed)
    turning = -np.gradient(azimuth, _DT)
    yaw_rate = np.interp(t, fine, turning)
    bias = yaw_bias * rng.standard_normal() + np.cumsum(yaw_drift * rng.standard_normal(t.size) / np.sqrt(rate))
    measured = _stepped(speed_scale * np.interp(t - speed_delay, fine, speed), speed_step)
    slow = _gauss_markov(rng, t.size, 1 / rate, fix_offset, fix_offset_time)

    then = t - clock_offset
    white = fix_noise * rng.standard_normal((2, t.size))
    alt = 220 + 12 * np.sin(2 * np.pi * t / 400) + 3 * np.sin(2 * np.pi * t / 90)
    course = np.interp(then, fine, azimuth)
    v_fix = np.interp(then, fine, speed)
    w_fix = np.interp(then, fine, turning)
    course = course - np.arctan2(w_fix * antenna[0], v_fix - w_fix * antenna[1])  # the way the antenna goes
    course = course + 0.15 / np.maximum(v_fix, 1.0) * rng.standard_normal(t.size)
    height = alt + 1.5 * rng.standard_normal(t.size)

    v_fine = np.interp(t, fine, np.gradient(speed, _DT))
    forward = v_fine + 0.15 * rng.standard_normal(t.size)
    left = v * yaw_rate + 0.15 * rng.standard_normal(t.size)
    if outages is None:
        outages = _place(rng, t, v, tunnels)
    seen = np.ones(t.size, dtype=bool)
    if fix_rate is not None:
        turn = np.floor(t * fix_rate + 1e-9)
        seen = np.r_[True, np.diff(turn) > 0]
    for first, last in outages:
        if not first <= last:
            raise BadValue(f"`outages` holds ({first}, {last}), first <= last is expected")
        seen &= ~((t >= first) & (t <= last))
    shared = slow + _multipath(more, t, outages, multipath, multipath_time)
    gyro = np.interp(t - yaw_delay, fine, turning) + bias + yaw_noise * rng.standard_normal(t.size)

    def fixed(values: Floats) -> Floats:
        return np.where(seen, values, np.nan)

    fix_lat, fix_lon = _moved(np.interp(then, fine, lat), np.interp(then, fine, lon), *(shared + white))
    other: Log | None = None
    if second is None:
        course = np.where(v_fix > 1, course, np.nan)
    else:
        beside = np.array(_ahead(np.interp(then, fine, azimuth), second))
        white2 = fix_noise * more.standard_normal((2, t.size))
        at2 = _moved(np.interp(then, fine, axle_lat), np.interp(then, fine, axle_lon), *(beside + shared + white2))
        other = Log(t=t, lat_deg=fixed(at2[0]), lon_deg=fixed(at2[1]), source=f"second antenna, seed {seed}")
        line = beside - np.array(_ahead(np.interp(then, fine, azimuth), antenna)) + white2 - white
        course = np.arctan2(*line) + np.arctan2(second[1] - antenna[1], second[0] - antenna[0])
    log = Log(
        t=t,
        lat_deg=fixed(fix_lat),
        lon_deg=fixed(fix_lon),
        alt_m=fixed(height),
        azimuth_rad=fixed(np.mod(course, 2 * np.pi)),
        speed_mps=measured,
        yaw_rate_radps=_stepped(gyro, yaw_step),
        ax_mps2=forward,
        ay_mps2=left,
        source=f"simulated drive, seed {seed}",
        epoch_s=epoch_s,
    )
    truth = Truth(
        t=t,
        lat_deg=np.interp(t, fine, lat),
        lon_deg=np.interp(t, fine, lon),
        alt_m=alt,
        azimuth_rad=np.mod(np.interp(t, fine, azimuth), 2 * np.pi),
        speed_mps=v,
        yaw_rate_radps=yaw_rate,
        yaw_bias_radps=bias,
        fix_east_m=slow[0],
        fix_north_m=slow[1],
        outages=tuple((float(first), float(last)) for first, last in outages),
        clock_offset=float(clock_offset),
        speed_scale=float(speed_scale),
        speed_delay=float(speed_delay),
        yaw_delay=float(yaw_delay),
        antenna=(float(antenna[0]), float(antenna[1])),
        second=other,
    )
    return truth, log


def _stepped(values: Floats, step: float) -> Floats:
    """Round to whole steps; 0 for none."""
    return np.round(values / step) * step if step > 0 else values


def _ahead(azimuth: Floats, place: tuple[float, float]) -> tuple[Floats, Floats]:
    """Return how far east and north of the axle a place (ahead, to the left) on the car is, in metres."""
    ahead, left = place
    sin, cos = np.sin(azimuth), np.cos(azimuth)
    return ahead * sin - left * cos, ahead * cos + left * sin


def _moved(lat_deg: Floats, lon_deg: Floats, east: Floats, north: Floats) -> tuple[Floats, Floats]:
    """Move positions in degrees by some metres east and north."""
    meridian, normal = radii_m(np.radians(lat_deg))
    lon = lon_deg + np.degrees(east / (normal * np.cos(np.radians(lat_deg))))
    return lat_deg + np.degrees(north / meridian), lon


def _multipath(
    rng: np.random.Generator, t: Floats, outages: Sequence[tuple[float, float]], size: float, time: float
) -> Floats:
    """Return the error (2, N) that fades after each outage, in metres."""
    wrong = np.zeros((2, t.size))
    for _, last in outages:
        toward = rng.uniform(0, 2 * np.pi)
        since = np.where(t > last, t - last, np.inf)
        wrong += size * np.array([[np.sin(toward)], [np.cos(toward)]]) * np.exp(-since / time)
    return wrong


def _motion(
    rng: np.random.Generator, duration: float, start: tuple[float, float]
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Drive a random road: time, speed, unwrapped azimuth, latitude and longitude, 100 a second."""
    curvature, wanted, halts = _road(rng, duration * _LIMITS[-1] + 200)
    along = np.arange(curvature.size) * _DS
    # nobody holds a speed: a few per cent up and down, every hundred metres or so
    mood = 1 + 0.04 * np.sqrt(400) * _smooth(rng.standard_normal(along.size), 400)
    fastest = np.minimum(wanted * np.clip(mood, 0.85, 1.1), np.sqrt(_SIDEWAYS / np.maximum(np.abs(curvature), 1e-6)))
    halt_rows = np.array(sorted(halts), dtype=int)
    fastest[halt_rows] = 0.0
    fastest[0] = 0.0
    v = _profile(fastest)
    step = 2 * _DS / np.maximum(v[1:] + v[:-1], 1e-3)
    wait = np.zeros(along.size)
    wait[halt_rows] = [halts[row] for row in halt_rows.tolist()]
    wait[0] = 3.0
    arrive = np.r_[0.0, np.cumsum(step + wait[:-1])]
    leave = arrive + wait
    clock = np.arange(int(np.ceil(duration / _DT)) + 1) * _DT
    # a halt is two knots at one place; elsewhere both knots fall together
    knots = np.column_stack((arrive, leave)).ravel()
    # smoothed, as nobody steps on the pedals in no time
    speed: Floats = np.maximum(_smooth(np.interp(clock, knots, np.repeat(v, 2)), 60), 0.0)
    speed[speed < 0.02] = 0.0
    place = np.r_[0.0, np.cumsum((speed[1:] + speed[:-1]) / 2 * _DT)]
    turned = np.r_[0.0, np.cumsum((curvature[1:] + curvature[:-1]) / 2 * _DS)]
    azimuth: Floats = np.add(np.interp(place, along, turned), rng.uniform(0, 2 * np.pi))
    middle = (azimuth[1:] + azimuth[:-1]) / 2
    moved = np.diff(place)
    lat: Floats = np.full(clock.size, np.radians(start[0]))
    for _ in range(2):  # the radii change so little that two rounds are exact to rounding
        meridian, normal = radii_m(lat[:-1])
        lat[1:] = lat[0] + np.cumsum(np.cos(middle) * moved / meridian)
    _, normal = radii_m((lat[1:] + lat[:-1]) / 2)
    across = normal * np.cos((lat[1:] + lat[:-1]) / 2)
    lon: Floats = np.radians(start[1]) + np.r_[0.0, np.cumsum(np.sin(middle) * moved / across)]
    return clock.astype(np.float64), speed, azimuth, np.degrees(lat), np.degrees(lon)


def _road(rng: np.random.Generator, length: float) -> tuple[Floats, Floats, dict[int, float]]:
    """Draw a road: every `_DS` metres its curvature (right is positive) and wanted speed; halts in seconds."""
    rows = int(length / _DS) + 1
    curvature, wanted = np.zeros(rows), np.full(rows, _LIMITS[-1])
    halts: dict[int, float] = {}
    row, heading = int(60 / _DS), 0.0
    while row < rows:
        row += int(rng.uniform(40, 260) / _DS)
        kind = rng.uniform()
        if kind < 0.35 and row < rows:
            halts[row] = float(rng.uniform(4, 20))
            row += int(12 / _DS)
        radius = rng.uniform(9, 25) if kind < 0.45 else rng.uniform(40, 300)
        angle = np.radians(rng.uniform(60, 100) if kind < 0.45 else rng.uniform(10, 60))
        # roads lead somewhere: turn back rather than run in circles
        side = -np.sign(heading) if abs(heading) > 1.5 else rng.choice([-1.0, 1.0])
        stop = min(row + max(int(radius * angle / _DS), 1), rows)
        curvature[row:stop] = side / radius
        heading += float(side * angle)
        wanted[row:] = rng.choice(_LIMITS, p=(0.15, 0.25, 0.6))
        row = stop
    return _smooth(curvature, 33), wanted, halts


def _profile(fastest: Floats) -> Floats:
    """Keep a speed below its limits with the car's acceleration and braking, along the road."""
    squared = (fastest**2).tolist()
    up, down = 2 * _SPEED_UP * _DS, 2 * _BRAKE * _DS
    for k in range(1, len(squared)):
        squared[k] = min(squared[k], squared[k - 1] + up)
    for k in range(len(squared) - 2, -1, -1):
        squared[k] = min(squared[k], squared[k + 1] + down)
    profile: Floats = np.sqrt(squared)
    return profile


def _smooth(values: Floats, width: int) -> Floats:
    """Average over a window, ends repeated."""
    padded = np.r_[np.full(width // 2, values[0]), values, np.full(width - width // 2, values[-1])]
    total = np.r_[0.0, np.cumsum(padded)]
    mean: Floats = (total[width:] - total[:-width]) / width
    return mean[: values.size]


def _gauss_markov(rng: np.random.Generator, rows: int, step: float, size: float, time: float) -> Floats:
    """Draw two first-order Gauss-Markov processes: a (2, rows) array."""
    keep = np.exp(-step / time)
    kicks = size * np.sqrt(1 - keep**2) * rng.standard_normal((2, rows))
    kicks[:, 0] = size * rng.standard_normal(2)
    out = np.empty((2, rows))
    value = np.zeros(2)
    for k in range(rows):
        value = keep * value + kicks[:, k]
        out[:, k] = value
    return out


def _place(rng: np.random.Generator, t: Floats, v: Floats, tunnels: Sequence[float]) -> list[tuple[float, float]]:
    """Place tunnels where the car moves, apart from each other and from both ends."""
    total = float(t[-1])
    room = total - sum(tunnels)
    if not tunnels:
        return []
    if min(tunnels) <= 0 or room < 5 * (len(tunnels) + 1):
        raise BadValue(
            f"`tunnels` is {list(tunnels)} s in a drive of {total:.0f} s, positive lengths with 5 s"
            " between them are expected",
            hint="a longer `duration`",
        )
    apart = min(60.0, 0.6 * room / (len(tunnels) + 1))
    went = np.r_[0.0, np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(t))]
    best: list[tuple[float, float]] = []
    slowest = -1.0
    for _ in range(200):
        free = rng.dirichlet(np.ones(len(tunnels) + 1)) * (room - apart * (len(tunnels) + 1))
        order = rng.permutation(len(tunnels))
        first = np.cumsum(free[:-1] + apart) + np.r_[0.0, np.cumsum(np.array(tunnels)[order])[:-1]]
        last = first + np.array(tunnels)[order]
        mean = (np.interp(last, t, went) - np.interp(first, t, went)) / (last - first)
        if mean.min() > slowest:
            slowest = float(mean.min())
            best = list(zip(first.round(1).tolist(), last.round(1).tolist(), strict=True))
        if slowest > 6:
            break
    return best


def length_m(truth: Truth, first: float, last: float) -> float:
    """Measure the distance driven between two times, in metres."""
    inside = (truth.t >= first) & (truth.t <= last)
    return float(steps_m(truth.lat_deg[inside], truth.lon_deg[inside]).sum())
