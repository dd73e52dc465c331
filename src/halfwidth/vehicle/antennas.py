"""The estimator of Pavelková's slides on GPS and CAN data: two antennas, nonlinear, half-widths unknown, by MAP.

Seven states (two positions, azimuth, speed, yaw rate; `models.two_antenna`) and their outputs at the rates at which
they arrive; a missing entry is a missing inequality. What is sought is the trajectory with the half-widths of least

    sum ln q_i + (K / T) sum ln r_j,          T rows, K of them with a fix,

each not below its floor: half a quantisation step where the log has one, the sensors' usual data sheet elsewhere. One
outage at a time, with some seconds of data on both sides:

1. azimuth from courses and fixes where there are any, reckoned from both sides where not;
2. the linearised model, whose input is the displacement reckoned with that azimuth, by linear programming;
3. the nonlinear model from there, by `SequentialLP` with the logarithmic objective.

Added to the slides: one antenna where there is no second, the azimuth in the middle of a step, the line between the
antennas that turns with the vehicle, the receiver's azimuth as an output of the state as well as of that line, states
held within limits (speed, acceleration, yaw rate), altitude and pitch, and roads that the track stays on inside
outages. A road is an output: the distance from its middle in units of its half-width, known to be within 1.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadValue
from halfwidth.methods import load
from halfwidth.model import Nonlinear
from halfwidth.noise import Uniform
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Box
from halfwidth.tape import Tape
from halfwidth.trace import compiled
from halfwidth.vehicle import models
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path
from halfwidth.vehicle.pointing import azimuth_of
from halfwidth.vehicle.roads import Streets

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Least half-widths of the state noise over a step, by state: what a car's body and a road do to a step.
STATE_FLOORS: Mapping[str, float] = {
    "east": 0.005, "north": 0.005, "azimuth": 2e-4, "speed": 0.01, "yaw_rate": 1e-3,
    "altitude": 0.005, "pitch": 2e-4, "acceleration": 0.02,
}  # fmt: skip

#: Least half-widths of the outputs: a differential receiver's centimetres, 0.1 km/h, a cheap gyro.
OUTPUT_FLOORS: Mapping[str, float] = {
    "east": 0.01, "north": 0.01, "azimuth": 0.005, "heading": 0.005, "speed": 0.1 / 7.2, "yaw_rate": 5e-4,
    "altitude": 0.05,
}  # fmt: skip

#: Streams of a log whose quantisation step raises the floor of an output; those of latitude and longitude do it too.
_STREAM = {"speed": "speed_mps", "yaw_rate": "yaw_rate_radps", "altitude": "alt_m"}

#: Speed above which the course of a single antenna is the azimuth, m/s.
_MOVING = 2.0

#: A gap is kept on the roads if the fixes around it are this near to them, beyond the half-width, m.
_STRAY = 3.0

#: States that limits can be set for.
LIMITED = ("speed", "acceleration", "yaw_rate", "altitude", "pitch")


@dataclass(frozen=True, kw_only=True)
class TwoAntennas:
    """Settings of the estimator.

    Parameters
    ----------
    context : float
        Seconds of data on each side of an outage.
    limits : mapping of str to (float, float)
        Least and largest value of a state, of `LIMITED`; in m/s, m/s^2, rad/s, m, rad. See `limits_of`.
    roads : Streets or None
        Roads in metres of the drive's frame.
    height : bool
        Estimate altitude and pitch too.
    euler : bool
        Move along the azimuth at the start of each step, as the slides do.
    rigid : bool
        Turn the line between the antennas with the vehicle; the slides move both alike.
    nonlinear : bool
        False stops after the linearised model.
    objective, point
        Of `SequentialLP`.
    """

    context: float = 10.0
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    roads: Streets | None = None
    height: bool = False
    euler: bool = False
    rigid: bool = True
    nonlinear: bool = True
    objective: Literal["log", "scaled", "paper"] = "log"
    point: Literal["central", "least_squares", "optimal"] = "optimal"


def limits_of(given: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Return limits as pairs: a single number is the largest size in both directions.

    Raises
    ------
    BadValue
        If a name is none of `LIMITED`, or a limit is no number or pair of numbers with room between them.

    Examples
    --------
    >>> limits_of({"speed": (0, 30), "yaw_rate": 0.6})
    {'speed': (0.0, 30.0), 'yaw_rate': (-0.6, 0.6)}
    """
    found: dict[str, tuple[float, float]] = {}
    for name, value in given.items():
        if name not in LIMITED:
            raise BadValue(f"`limits` has {name!r}, one of {', '.join(LIMITED)} is expected")
        try:
            ends = np.atleast_1d(np.asarray(value, dtype=float))
        except (TypeError, ValueError):
            ends = np.zeros(0)
        lo, hi = (-abs(float(ends[0])), abs(float(ends[0]))) if ends.shape == (1,) else (np.nan, np.nan)
        if ends.shape == (2,):
            lo, hi = float(ends[0]), float(ends[1])
        if not (np.isfinite([lo, hi]).all() and lo < hi):
            raise BadValue(
                f"the limit of `{name}` is {value!r}, a size or a pair (least, largest) of finite numbers is expected",
                hint=f'limits={{"{name}": (-1.0, 5.0)}}',
            )
        found[name] = (lo, hi)
    return found


def parsed_limits(text: str) -> dict[str, tuple[float, float]]:
    """Read limits as they are typed, ``speed=0:30,acceleration=4``; see `limits_of`.

    Raises
    ------
    BadValue
        If the text is not of that form.
    """
    given: dict[str, Any] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = part.partition("=")
        try:
            ends = [float(end) for end in value.split(":")]
        except ValueError:
            ends = []
        if len(ends) not in (1, 2):
            raise BadValue(
                f"the limit {part!r} is not NAME=SIZE or NAME=LEAST:MOST", hint="--limits speed=0:30,acceleration=4"
            )
        given[name.strip()] = ends
    return limits_of(given)


def solve(drives: Sequence[Grid], settings: TwoAntennas | None = None) -> list[Path]:
    """Estimate drives, outage by outage.

    Parameters
    ----------
    drives : sequence of Grid
    settings : TwoAntennas, optional

    Returns
    -------
    list of Path
        ``info`` has, over all outages of a drive, the largest half-widths ``q`` and ``r`` by name, ``on_floor`` (how
        many outages had which half-width on its floor), ``second`` (T, 2) where there are two antennas,
        ``altitude`` (T,) and ``pitch`` (T,) where asked for, ``notes``.
    """
    settings = TwoAntennas() if settings is None else settings
    return [_drive(drive, settings) for drive in drives]


def _drive(drive: Grid, settings: TwoAntennas) -> Path:
    seen = np.flatnonzero(drive.seen)
    columns = {"east": _through(drive, drive.east), "north": _through(drive, drive.north)}
    columns |= {"azimuth": azimuth_of(drive), "speed": drive.speed.copy()}
    extra: dict[str, Floats] = {}
    if settings.height:
        known = np.zeros(0) if drive.height is None else np.flatnonzero(np.isfinite(drive.height))
        if not len(known):
            line = columns["east"], columns["north"], columns["azimuth"], columns["speed"]
            return Path(drive.t, *line, None, 0.0, Status.STALLED, {"notes": ["no height to estimate from"]})
        assert drive.height is not None
        extra["altitude"], extra["pitch"] = (
            np.interp(drive.t, drive.t[known], drive.height[known]),
            np.zeros(len(drive)),
        )
    if drive.second is not None:
        extra["second"] = np.column_stack([_through(drive, p, np.isfinite(p)) for p in drive.second.T])
    status, notes = Status.OK, []
    q: dict[str, float] = {}
    r: dict[str, float] = {}
    on_floor: dict[str, int] = {}
    fits: list[Status] = []
    for a, b in _windows(drive, seen, settings.context):
        fit = window(drive.rows(slice(a, b)), settings)
        est, names = fit.estimate, fit.names
        fits.append(est.status)
        part = slice(a, b)
        for name in (*columns, *extra):
            if name == "second":
                extra[name][part] = est.x[:, 2:4]
            else:
                (columns if name in columns else extra)[name][part] = est.x[:, names.index(name)]
        for into, values, labels in ((q, est.q, fit.states), (r, est.r, fit.outputs)):
            for name, value in zip(labels, () if values is None else values, strict=False):
                into[name] = max(into.get(name, 0.0), float(value))
        for name in est.info.get("on_floor", ()):
            on_floor[name] = on_floor.get(name, 0) + 1
        notes += fit.notes
    if any(not one.good for one in fits):
        status = Status.REDUCED
        notes.append(f"{sum(not one.good for one in fits)} of {len(fits)} outages: the linearised model's path")
    elif any(one is Status.REDUCED for one in fits):
        status = Status.REDUCED
    if on_floor:
        words = ", ".join(f"{name} in {n}" for name, n in sorted(on_floor.items()))
        notes.append(f"half-widths on their floor, of {len(fits)} outage{'s' if len(fits) > 1 else ''}: {words}")
    info = {"q": q, "r": r, "on_floor": on_floor, "outages": len(fits), "notes": list(dict.fromkeys(notes)), **extra}
    return Path(
        drive.t, columns["east"], columns["north"], columns["azimuth"], columns["speed"], None, 0.0, status, info
    )


def _through(drive: Grid, values: Floats, known: Mask | None = None) -> Floats:
    """Return values at the nodes that have them, straight lines in between."""
    k = np.flatnonzero(drive.seen if known is None else known)
    return np.interp(drive.t, drive.t[k], values[k]) if k.size else np.zeros(len(drive))


def _windows(drive: Grid, seen: NDArray[np.intp], context: float) -> list[tuple[int, int]]:
    """Return the nodes (a, b) of each outage with its context; outages that share data go together."""
    t = drive.t
    step = np.diff(seen)
    usual = np.median(np.diff(t[seen])) if seen.size > 1 else 1.0
    apart = np.flatnonzero((step > 1) | (np.diff(t[seen]) > 1.5 * usual))
    ends = [(float(t[seen[k]]), float(t[seen[k + 1]])) for k in apart]
    if seen.size and seen[0] > 0:
        ends.insert(0, (float(t[0]), float(t[seen[0]])))
    if seen.size and seen[-1] < len(t) - 1:
        ends.append((float(t[seen[-1]]), float(t[-1])))
    if not ends:
        return [(0, len(t))]
    found: list[tuple[int, int]] = []
    for start, stop in ends:
        a = int(np.searchsorted(t, start - context - 1e-9))
        b = int(np.searchsorted(t, stop + context + 1e-9, side="right"))
        if found and a < found[-1][1]:
            found[-1] = (found[-1][0], max(b, found[-1][1]))
        else:
            found.append((a, b))
    return found


class Window(NamedTuple):
    """One outage: its estimate, names of states (of both antennas alike), floors' labels, and what is to be said."""

    estimate: Estimate
    names: tuple[str, ...]
    states: tuple[str, ...]
    outputs: tuple[str, ...]
    notes: list[str]
    model: Nonlinear
    record: Record


def window(drive: Grid, settings: TwoAntennas | None = None) -> Window:
    """Estimate one stretch of a drive; where the nonlinear problem has no answer, the linearised one's is given."""
    settings = TwoAntennas() if settings is None else settings
    model, record, start, notes = problem(drive, settings)
    bare = tuple(name.rstrip("12") for name in model.names.x)
    origin = _origin(drive)
    x = start[1:].copy()
    est = Estimate(record.t, x, None, Status.OK, "linearised", names=model.names.x, info={"x0": start[0]})
    if settings.nonlinear:
        method = load("SequentialLP")(objective=settings.objective, point=settings.point, start=start)
        found = method.run(model, record)
        if found.status.good and np.isfinite(found.x).all():
            est = found
        else:
            est = replace(est, status=found.status, info={**est.info, **found.info})
    shift = np.zeros(model.nx)
    places = 4 if "east2" in model.names.x else 2
    shift[:places] = np.tile(origin, places // 2)
    est = replace(est, x=est.x + shift)
    return Window(est, bare, model.names.x, model.names.y, notes, model, record)


def _origin(drive: Grid) -> Floats:
    return np.array([drive.east, drive.north])[:, int(np.argmax(drive.seen))]


def problem(drive: Grid, settings: TwoAntennas) -> tuple[Nonlinear, Record, Floats, list[str]]:
    """Return the nonlinear model of a stretch, its record about the first fix, where to start, and notes.

    The sensors of a row are their means over the step that follows it, which is what moves the state from there.
    """
    notes: list[str] = []
    origin, h = _origin(drive), drive.h
    phi = azimuth_of(drive)
    speed, turn = (np.concatenate((s[1:], s[-1:])) for s in (drive.speed, drive.yaw_rate))
    silent = [np.concatenate((s[1:], s[-1:])) > 0 for s in (drive.speed_sd, drive.yaw_rate_sd)]
    first = np.column_stack((drive.east, drive.north)) - origin
    first[~drive.seen] = np.nan
    second = None if drive.second is None else drive.second - origin
    both = second is not None and int(np.isfinite(second[:, 0] + first[:, 0]).sum()) >= 2
    places = [first, second] if both and second is not None else [first]
    baseline = _baseline(first, second, phi) if both and second is not None else None
    if second is not None and not both:
        notes.append("the second antenna has no fixes beside the first one's: one antenna")
    model = _model(drive, settings, baseline)
    # ---- what was measured
    course = drive.course.copy()
    if baseline is not None:
        line = np.arctan2(*(places[1] - first).T) + np.arctan2(baseline[1], baseline[0])
        course = np.where(np.isfinite(course) & ~np.isfinite(line), course, line)
    else:
        course[drive.speed < _MOVING] = np.nan
    y: dict[str, Floats] = {
        name: p[:, k] for i, p in enumerate(places) for k, name in enumerate(model.names.y[2 * i : 2 * i + 2])
    }
    y |= {"azimuth": course, "heading": course}
    y |= {"speed": np.where(silent[0], np.nan, speed), "yaw_rate": np.where(silent[1], np.nan, turn)}
    # ---- the linearised model, and the states that it leaves to the sensors
    line_u = models.displacement(phi, drive.speed, h, euler=settings.euler)
    seen_places = np.hstack(places)
    linear = models.two_antenna_linear(antennas=len(places))
    found = load("BatchLP")(point="least_squares").run(linear, Record(drive.t, seen_places, line_u))
    x = np.zeros((len(drive) + 1, model.nx))
    names = model.names.x
    n = 2 * len(places)
    x[1:, :n] = found.x
    x[1:, n], x[1:, n + 1], x[1:, n + 2] = phi, speed, turn
    if settings.height:
        assert drive.height is not None
        known = np.isfinite(drive.height)
        height = np.interp(drive.t, drive.t[known], drive.height[known]) if known.any() else np.zeros(len(drive))
        way = np.maximum(np.abs(speed) * np.concatenate((h[1:], h[-1:])), 0.1)
        x[1:, n + 3] = height
        x[1:, n + 4] = np.clip(np.diff(height, append=height[-1:]) / way, -0.3, 0.3)
        y["altitude"] = drive.height
    if "acceleration" in names:
        x[1:, -1] = np.diff(speed, append=speed[-1:]) / np.concatenate((h[1:], h[-1:]))
    x[0] = x[1]
    x[0, :n] -= np.tile(h[0] * speed[0] * np.array([np.sin(phi[0]), np.cos(phi[0])]), len(places))
    x[0, n] += h[0] * turn[0]
    if "road" in model.names.y:
        y["road"], said = _kept(drive, settings.roads, x[1:, :2] + origin, phi)
        notes += said
    if model.bounds is not None:
        assert isinstance(model.bounds, Box)
        x = np.clip(x, model.bounds.lo, model.bounds.hi)
    return model, Record(drive.t, np.column_stack([y[name] for name in model.names.y])), x, notes


def half_steps(drive: Grid) -> dict[str, float]:
    """Return half the quantisation step of each output that has one, in the output's unit."""
    found = {name: 0.5 * drive.steps.get(stream, 0.0) for name, stream in _STREAM.items()}
    frame = drive.frame
    lat, lon = (drive.steps.get(name, 0.0) for name in ("lat_deg", "lon_deg"))
    at = frame.to_local([frame.lat_deg, frame.lat_deg + lat], [frame.lon_deg, frame.lon_deg + lon])
    for name, p in zip(("east", "north"), at, strict=True):
        found[name] = 0.5 * float(np.ptp(p))
    return found


def _model(drive: Grid, settings: TwoAntennas, baseline: Floats | None) -> Nonlinear:
    """Return the model with its floors, limits and roads."""
    antennas = 1 if baseline is None else 2
    numbers = ("1", "2") if antennas == 2 else ("",)
    driven = "acceleration" in settings.limits
    states = [f"{axis}{k}" for k in numbers for axis in ("east", "north")] + ["azimuth", "speed", "yaw_rate"]
    outputs = states + (["heading"] if antennas == 2 else []) + (["altitude"] if settings.height else [])
    states += (["altitude", "pitch"] if settings.height else []) + (["acceleration"] if driven else [])
    q_lo = np.array([STATE_FLOORS[name.rstrip("12")] for name in states])
    q_hi = np.full(len(states), np.inf)
    if driven:
        # the speed follows the acceleration, whose limits would mean little if it could jump besides
        q_lo[states.index("speed")], q_hi[states.index("speed")] = 1e-3, 0.02
    steps = half_steps(drive)
    r_lo = np.array([max(OUTPUT_FLOORS[name.rstrip("12")], steps.get(name.rstrip("12"), 0.0)) for name in outputs])
    r_hi = np.full(len(outputs), np.inf)
    lo, hi = np.full(len(states), -np.inf), np.full(len(states), np.inf)
    for name, (least, most) in settings.limits.items():
        if name in states:
            lo[states.index(name)], hi[states.index(name)] = least, most
    middle = np.zeros(len(states))
    if antennas == 2 and baseline is not None:
        middle[2:4] = np.hypot(*baseline) * np.array([0.6, 0.8])  # where the two are apart the line has a direction
    middle = np.clip(middle, lo, hi)
    far = np.full(len(states), 1e7)
    w = Uniform.unknown(at_least=q_lo, at_most=q_hi)
    bounds = Box(lo, hi) if settings.limits else None

    def made(r_lo: Floats, r_hi: Floats) -> Nonlinear:
        return models.two_antenna(
            w,
            Uniform.unknown(at_least=r_lo, at_most=r_hi),
            x0=Box(np.maximum(middle - far, lo), np.minimum(middle + far, hi)),
            baseline=None if baseline is None else (float(baseline[0]), float(baseline[1])),
            euler=settings.euler,
            antennas=antennas,
            rigid=settings.rigid,
            heading=antennas == 2,
            height=settings.height,
            acceleration=driven,
            bounds=bounds,
        )

    model = made(r_lo, r_hi)
    if settings.roads is None:
        return model
    return _on_roads(model, settings.roads, _origin(drive), antennas, np.r_[r_lo, 1.0], np.r_[r_hi, 1.0])


@dataclass(frozen=True, eq=False)
class OnRoads:
    """Outputs of a model and one more: the distance from the middle of the road over the road's half-width.

    Parameters
    ----------
    plain : Tape
        The outputs without it.
    roads : Streets
    origin : (2,) array
        Where the states' own zero is, east and north, m.
    azimuth : int
        Which state the azimuth is.
    """

    plain: Tape
    roads: Streets
    origin: Floats
    azimuth: int

    def __call__(self, x: Floats) -> Floats:
        """Return the outputs at one state."""
        return np.asarray(self.rows(x[None])[0][0])

    def slope(self, x: Floats) -> Floats:
        """Return their Jacobian at one state."""
        return np.asarray(self.rows(x[None])[1][0])

    def rows(self, x: Floats) -> tuple[Floats, Floats]:
        """Return outputs (n, ny) and Jacobians (n, ny, nx) at states (n, nx)."""
        value, slope = self.plain.jacobian(x)
        near = self.roads.nearest(x[:, 0] + self.origin[0], x[:, 1] + self.origin[1], x[:, self.azimuth])
        more = np.zeros((len(x), 1, x.shape[1]))
        more[:, 0, :2] = near.slope
        return np.column_stack((value, near.offset)), np.concatenate((slope, more), axis=1)


def _on_roads(model: Nonlinear, roads: Streets, origin: Floats, antennas: int, r_lo: Floats, r_hi: Floats) -> Nonlinear:
    """Return the model with the road as one more output."""
    h = OnRoads(compiled(model.h, (model.nx,), [(model.x0.mean,)]), roads, origin, 2 * antennas)
    names = model.names._replace(y=(*model.names.y, "road"))
    return replace(model, h=h, h_x=h.slope, e=Uniform.unknown(at_least=r_lo, at_most=r_hi), names=names)


def _kept(drive: Grid, roads: Streets | None, at: Floats, phi: Floats) -> tuple[Floats, list[str]]:
    """Return 0 at the nodes that are to be kept on the roads, NaN elsewhere: outages between fixes near roads."""
    wanted = np.full(len(drive), np.nan)
    assert roads is not None
    seen = np.flatnonzero(drive.seen)
    near = roads.nearest(at[seen, 0], at[seen, 1], phi[seen])
    on = near.distance <= near.half_width + _STRAY
    notes = []
    for left, right in zip(np.flatnonzero(np.diff(seen) > 1), np.flatnonzero(np.diff(seen) > 1) + 1, strict=True):
        if on[left] and on[right]:
            wanted[seen[left] + 1 : seen[right]] = 0.0
        else:
            notes.append(
                f"the outage from {drive.t[seen[left]]:.1f} s is not kept on the map:"
                " the fixes beside it are off its roads"
            )
    return wanted, notes


def _baseline(first: Floats, second: Floats, phi: Floats) -> Floats:
    """Return where antenna 2 is as seen from antenna 1, metres forward and to the left: medians over the fixes."""
    d = second - first
    sin, cos = np.sin(phi), np.cos(phi)
    ahead, left = d[:, 0] * sin + d[:, 1] * cos, -d[:, 0] * cos + d[:, 1] * sin
    return np.array([np.nanmedian(ahead), np.nanmedian(left)])
