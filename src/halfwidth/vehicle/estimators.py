"""The estimators of a drive, by name: from the straight line to the chain that learns its own noise.

Each takes drives that were put on a `Grid`, several at once, and returns a `Path` for each. What it needs to know of
the log (noise levels of the Gaussian models) it learns in `tune`, once a log, by likelihood; nothing is set by hand.

============= ==================================================================================================
linear        straight line from fix to fix
cv            constant velocity, Rauch-Tung-Striebel smoother
gpsins        the linear GPS/INS model of Pavelková (2011) with that smoother, acceleration from speed and azimuth
ctrv          constant turn rate and velocity, extended Kalman smoother, with speed scale and yaw bias
em            the chain of `halfwidth.vehicle.chain`, the default of `fill`
em-slow       the same, the fix error a Gaussian offset without drift and jumps
em-white      the same, the fix error white noise
ep            the posterior of that chain where noise is partly bounded: half-widths by evidence (`credible`)
slp           the same with bounded noise by sequential linear programming, central point (`bounded`)
slp-white     the same, the fix error without an offset
slp-log       that with the logarithmic objective
cvar          slp-white that counts the mean of the worst rows in place of the worst one, how many by masking
tube          the centre of the set of all paths within learnt half-widths, inflated by masking (`tube`)
paper000      GPS/INS by linear programming, half-widths unknown, as printed in Pavelková (2011)
paper000+ls   the same, least squares inside the optimal half-widths
paper002      GPS and CAN of Pavelková's slides: nonlinear, two antennas or one, logarithmic objective, floors
paper002-3d   the same with altitude and pitch
paper002lin   its linearised model with one antenna, middle azimuth, least squares inside the optimal half-widths
============= ==================================================================================================
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadValue
from halfwidth.estimate import estimate
from halfwidth.methods import load
from halfwidth.model import Linear, Nonlinear
from halfwidth.noise import Gaussian
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Normal
from halfwidth.vehicle import antennas, bounded, chain, credible, models, tube
from halfwidth.vehicle.antennas import TwoAntennas
from halfwidth.vehicle.frames import wrapped
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path
from halfwidth.vehicle.pointing import azimuth_of
from halfwidth.vehicle.roads import Streets

Floats = NDArray[np.float64]
Tuned = Mapping[str, float]

_NOTHING: Tuned = MappingProxyType({})


@dataclass(frozen=True)
class Method:
    """A way to estimate a drive.

    Parameters
    ----------
    name : str
    about : str
        What it is, in a few words.
    context : float
        Seconds of data it gets on each side of an outage in the benchmark.
    needs : tuple of str
        Sensors it cannot do without: ``"speed"``, ``"yaw_rate"``.
    one_of : tuple of str
        Sensors of which it needs one.
    again : function (drives, paths, tuned) -> list of Path, optional
        Fills the same drives with fixes hidden, with what their paths with all fixes have learnt; `run`, which learns
        again, if absent.
    afresh : function (drives, paths, tuned) -> list of Path, optional
        The same where sensors are hidden as well, which the paths must not tell; `run` if absent.
    run : function (drives, tuned) -> list of Path
    tune : function (drive) -> mapping
        What it learns from the whole log, once.
    """

    name: str
    about: str
    context: float
    needs: tuple[str, ...]
    run: Callable[[Sequence[Grid], Tuned], list[Path]]
    tune: Callable[[Grid], Tuned] = lambda drive: _NOTHING  # noqa: ARG005
    one_of: tuple[str, ...] = ()
    again: Callable[[Sequence[Grid], Sequence[Path], Tuned], list[Path]] | None = None
    afresh: Callable[[Sequence[Grid], Sequence[Path], Tuned], list[Path]] | None = None

    def lacks(self, drive: Grid) -> str | None:
        """Return in words the sensor that the drive does not have, or None."""
        there = {"speed": drive.has_speed, "yaw_rate": drive.has_yaw_rate}
        missing = [name for name in self.needs if not there[name]]
        if not missing and self.one_of and not any(there[name] for name in self.one_of):
            missing = [" or ".join(self.one_of)]
        return missing[0].replace("_", " ") if missing else None


def method(name: str) -> Method:
    """Return an estimator by its name.

    Raises
    ------
    BadValue
        If there is none of this name.
    """
    if name not in METHODS:
        raise BadValue(f"`method` is {name!r}, one of {', '.join(METHODS)} is expected")
    return METHODS[name]


# ---- the straight line ---------------------------------------------------------------------------------------------


def _linear(drives: Sequence[Grid], tuned: Tuned) -> list[Path]:  # noqa: ARG001
    return [_line(drive) for drive in drives]


def _line(drive: Grid) -> Path:
    """Draw straight lines between fixes, and stay at the first and the last one.

    The error of a line is what acceleration makes it, ``a s (L - s) / 2`` at s seconds into L. The variance of a comes
    from the fixes: how far each is off the middle of two others that are about as far apart as the gap.
    """
    t, seen = drive.t, np.flatnonzero(drive.seen)
    east, north = (np.interp(t, t[seen], p[seen]) for p in (drive.east, drive.north))
    before = t[seen[np.maximum(np.searchsorted(seen, np.arange(t.size), side="right") - 1, 0)]]
    after = t[seen[np.minimum(np.searchsorted(seen, np.arange(t.size)), seen.size - 1)]]
    s, length = np.clip(t - before, 0.0, None), np.clip(after - before, 0.0, None)
    variance = np.zeros((t.size, 2))
    for L in np.unique(np.round(length[length > 0], 3)):
        a2 = _wander(drive, seen, float(L))
        here = np.abs(length - L) < 1e-3
        variance[here] = a2 * (0.5 * s[here] * (L - s[here]))[:, None] ** 2
    out = (t < t[seen[0]]) | (t > t[seen[-1]])
    away = np.where(t < t[seen[0]], t[seen[0]] - t, t - t[seen[-1]])
    pace = _pace(drive)
    variance[out] = (pace * away[out])[:, None] ** 2
    return Path(t, east, north, np.full(t.size, np.nan), np.full(t.size, np.nan), variance, 0.0)


def _wander(drive: Grid, seen: NDArray[np.intp], length: float) -> Floats:
    """Return the variance (2,) of the acceleration that bends a path of `length` seconds, m^2/s^4."""
    t = drive.t[seen]
    if seen.size < 3:
        return np.full(2, 1.0)
    length = float(np.clip(length, 2 * np.median(np.diff(t)), (t[-1] - t[0]) / 2))
    middle = np.arange(seen.size)
    a = np.searchsorted(t, t - length / 2)
    b = np.minimum(np.searchsorted(t, t + length / 2), seen.size - 1)
    ok = (a < middle) & (b > middle) & (t[b] - t[a] < 1.5 * length) & (t - t[a] > 0) & (t[b] - t > 0)
    if not ok.any():
        return np.full(2, 1.0)
    a, b, middle = a[ok], b[ok], middle[ok]
    share = (t[middle] - t[a]) / (t[b] - t[a])
    bend = 0.5 * (t[middle] - t[a]) * (t[b] - t[middle])
    p = np.column_stack((drive.east[seen], drive.north[seen]))
    off = p[middle] - (p[a] + share[:, None] * (p[b] - p[a]))
    squares: Floats = np.mean((off / bend[:, None]) ** 2, axis=0)
    return np.maximum(squares, 1e-6)


def _pace(drive: Grid) -> float:
    """Return the root mean square speed of a drive between its fixes, m/s, at least 1."""
    seen = np.flatnonzero(drive.seen)
    if seen.size < 2:
        return 10.0
    moved = np.hypot(np.diff(drive.east[seen]), np.diff(drive.north[seen]))
    return float(max(1.0, np.sqrt(np.mean((moved / np.diff(drive.t[seen])) ** 2))))


# ---- linear Gaussian models ----------------------------------------------------------------------------------------


def _acceleration(drive: Grid) -> Floats:
    """Return the acceleration (T, 2) over each step, in local axes, from speed and azimuth."""
    azimuth, v, h = azimuth_of(drive), drive.speed, drive.h
    at_node = 0.5 * (v + np.concatenate((v[1:], v[-1:])))
    velocity = at_node[:, None] * np.column_stack((np.sin(azimuth), np.cos(azimuth)))
    pushed: Floats = np.diff(velocity, axis=0, prepend=velocity[:1]) / h[:, None]
    return pushed


def _fixes(drive: Grid) -> tuple[Floats, Floats]:
    """Return the fixes (T, 2) about the first one, NaN where there is none, and the first one."""
    y = np.column_stack((drive.east, drive.north))
    origin = y[int(np.argmax(drive.seen))].copy()
    y = y - origin
    y[~drive.seen] = np.nan
    return y, origin


def _white(h: Floats, q: float) -> Floats:
    """Return the covariance (T, 4, 4) of position and velocity after steps of white acceleration of intensity q^2."""
    Q = np.zeros((h.size, 4, 4))
    for i in (0, 1):
        Q[:, i, i], Q[:, i + 2, i + 2] = h**3 / 3, h
        Q[:, i, i + 2] = Q[:, i + 2, i] = h**2 / 2
    return q**2 * Q


@dataclass(frozen=True, eq=False)
class _Case:
    """A drive as a record of fixes about its first one."""

    record: Record
    origin: Floats
    far: float  # how far the first node may be from the first fix, m


def _case(drive: Grid, u: Floats | None, *sensors: Floats) -> _Case:
    y, origin = _fixes(drive)
    far = 100.0 + _pace(drive) * float(drive.t[int(np.argmax(drive.seen))] - drive.t[0])
    return _Case(Record(drive.t, np.column_stack((y, *sensors)), u), origin, far)


def _path(drive: Grid, case: _Case, est: Estimate, azimuth: Floats, speed: Floats, tuned: Tuned) -> Path:
    """Return the path of an estimate whose first two states are east and north about the origin."""
    P = est.P
    variance = None if P is None else np.column_stack((P[:, 0, 0], P[:, 1, 1]))
    east, north = est.x[:, 0] + case.origin[0], est.x[:, 1] + case.origin[1]
    info = {**tuned, "q": est.q, "r": est.r}
    return Path(drive.t, east, north, azimuth, speed, variance, tuned.get("fix", 0.0) ** 2, est.status, info)


def _moving(drive: Grid, case: _Case, q: float, r: float) -> Linear:
    """Return the Gaussian constant-velocity model of a drive, with an acceleration where its record has one."""
    h = drive.h.copy()
    h[0] = 1e-3  # the prior is of the first node, not of one step before it
    x0 = Normal(np.zeros(4), np.array([case.far**2, case.far**2, 900.0, 900.0]))
    driven = case.record.u is not None
    return models.constant_velocity(h, Gaussian(_white(h, q)), Gaussian([r**2, r**2]), x0=x0, acceleration=driven)


def _smoothed(driven: bool) -> Callable[[Sequence[Grid], Tuned], list[Path]]:
    def run(drives: Sequence[Grid], tuned: Tuned) -> list[Path]:
        paths = []
        for drive in drives:
            case = _case(drive, _acceleration(drive) if driven else None)
            model = _moving(drive, case, tuned["acceleration"], tuned["fix"])
            est = estimate(model, case.record, load("KalmanSmoother")())
            velocity = est.x[:, 2:]
            azimuth = np.unwrap(np.arctan2(velocity[:, 0], velocity[:, 1]))
            paths.append(_path(drive, case, est, azimuth, np.hypot(velocity[:, 0], velocity[:, 1]), tuned))
        return paths

    return run


def _tuned(driven: bool) -> Callable[[Grid], Tuned]:
    def tune(drive: Grid) -> Tuned:
        case = _case(drive, _acceleration(drive) if driven else None)

        def loglik(log_scales: Floats) -> float:
            q, r = np.exp(log_scales)
            return _loglik(estimate(_moving(drive, case, float(q), float(r)), case.record, load("KalmanFilter")()))

        q, r = np.exp(_climb(loglik, np.log([0.5, 0.5]), np.log([1e-3, 1e-2]), np.log([10.0, 30.0])))
        return {"acceleration": float(q), "fix": float(r)}

    return tune


def _loglik(est: Estimate) -> float:
    return float(est.loglik) if est.status.good and est.loglik is not None else -np.inf


def _climb(f: Callable[[Floats], float], start: Floats, lo: Floats, hi: Floats) -> Floats:
    """Maximise f by trying each axis up and down with shrinking steps; rough, as scales need no more."""
    x, best = start.copy(), f(start)
    step = 1.4
    while step > 0.1:
        moved = False
        for i in range(x.size):
            for sign in (1.0, -1.0):
                trial = x.copy()
                trial[i] = np.clip(trial[i] + sign * step, lo[i], hi[i])
                value = f(trial) if trial[i] != x[i] else -np.inf
                if value > best:
                    x, best, moved = trial, value, True
                    break
        step = step if moved else step / 2
    return x


# ---- constant turn rate and velocity -------------------------------------------------------------------------------

_CTRV_START = {"speed": 0.5, "yaw_rate": 0.1, "fix": 0.3, "speed_sensor": 0.1, "yaw_sensor": 0.01}


def _ctrv(drive: Grid, case: _Case, tuned: Tuned) -> Nonlinear:
    """Return the seven-state model of a drive; its record has positions, speed and yaw rate."""
    h = float(np.median(drive.h))
    y = case.record.y[0]
    mean = [0.0, 0.0, tuned["azimuth"], y[2], y[3], 1.0, 0.0]
    x0 = Normal(mean, [case.far**2, case.far**2, 0.25, 4.0, 0.04, 9e-4, 1e-4])
    Q = np.array([1e-4, 1e-4, 1e-6, tuned["speed"] ** 2, tuned["yaw_rate"] ** 2, 1e-8, 1e-10]) * h
    R = np.array([tuned["fix"], tuned["fix"], tuned["speed_sensor"], tuned["yaw_sensor"]]) ** 2
    return models.ctrv(Gaussian(Q), Gaussian(R), x0=x0, theta=True)


def _ctrv_case(drive: Grid) -> _Case:
    # sensors are means over the step before: half a step old at the node, so the next step counts as well
    speed, turn = (0.5 * (s + np.concatenate((s[1:], s[-1:]))) for s in (drive.speed, drive.yaw_rate))
    return _case(drive, None, speed, turn)


def _turning(drives: Sequence[Grid], tuned: Tuned) -> list[Path]:
    paths = []
    for drive in drives:
        case = _ctrv_case(drive)
        model = _ctrv(drive, case, {**tuned, "azimuth": float(azimuth_of(drive)[0])})
        est = estimate(model, case.record, load("ExtendedKalman")(smooth=True))
        paths.append(_path(drive, case, est, est.x[:, 2], est.x[:, 3], tuned))
    return paths


def _tuned_ctrv(drive: Grid) -> Tuned:
    names, case = list(_CTRV_START), _ctrv_case(drive)
    azimuth = float(azimuth_of(drive)[0])

    def loglik(log_scales: Floats) -> float:
        scales = dict(zip(names, (float(v) for v in np.exp(log_scales)), strict=True))
        return _loglik(
            estimate(_ctrv(drive, case, {**scales, "azimuth": azimuth}), case.record, load("ExtendedKalman")())
        )

    start = np.log(list(_CTRV_START.values()))
    found = _climb(loglik, start, start - np.log(50.0), start + np.log(30.0))
    return dict(zip(names, (float(v) for v in np.exp(found)), strict=True))


# ---- unknown half-widths -------------------------------------------------------------------------------------------


def _programme(build: Callable[[Grid], tuple[Linear, Floats]], **settings: Any) -> Any:
    def run(drives: Sequence[Grid], tuned: Tuned) -> list[Path]:
        paths = []
        for drive in drives:
            model, u = build(drive)
            case = _case(drive, u)
            est = estimate(model, case.record, load("BatchLP")(**settings))
            paths.append(_path(drive, case, est, azimuth_of(drive), drive.speed, tuned))
        return paths

    return run


def _ins(drive: Grid) -> tuple[Linear, Floats]:
    return models.gps_ins(drive.h), _acceleration(drive)


def antennas_by(settings: TwoAntennas) -> Callable[[Sequence[Grid], Tuned], list[Path]]:
    """Return the two-antenna estimator with these settings, as a method runs it."""
    return lambda drives, tuned: antennas.solve(drives, settings)  # noqa: ARG005


def with_limits(asked: Method | None, limits: Mapping[str, Any] | None, roads: Streets | None) -> Method:
    """Return a method that keeps the track within limits and on roads: the two-antenna one, in 3D if asked for.

    Raises
    ------
    BadValue
        If another method was asked for, a limit is none, or is of altitude or pitch in two dimensions.
    """
    held = antennas.limits_of(limits or {})
    high = [name for name in ("altitude", "pitch") if name in held]
    chosen = METHODS["paper002-3d" if high else "paper002"] if asked is None else asked
    if chosen.name not in ("paper002", "paper002-3d"):
        raise BadValue(
            f"`method` is {chosen.name!r}, but limits, a map and a second antenna are for the two-antenna model",
            hint='method="paper002"',
        )
    if high and chosen.name == "paper002":
        raise BadValue(f"`limits` has {high[0]!r}, which `paper002` does not estimate", hint='method="paper002-3d"')
    settings = TwoAntennas(height=chosen.name == "paper002-3d", limits=held, roads=roads)
    return replace(chosen, run=antennas_by(settings))


def _two_antenna(drive: Grid) -> tuple[Linear, Floats]:
    moved = models.displacement(azimuth_of(drive), drive.speed, drive.h)
    return models.two_antenna_linear(antennas=1), moved


# ---- the chain -----------------------------------------------------------------------------------------------------


def _chain(settings: chain.Chain) -> Callable[[Sequence[Grid], Tuned], list[Path]]:
    return lambda drives, tuned: [fit.path for fit in chain.solve(drives, settings)]  # noqa: ARG005


def _bounded(settings: bounded.Bounded) -> Callable[[Sequence[Grid], Tuned], list[Path]]:
    return lambda drives, tuned: bounded.solve(drives, settings)  # noqa: ARG005


def _bounded_again(settings: bounded.Bounded) -> Callable[[Sequence[Grid], Sequence[Path], Tuned], list[Path]]:
    return lambda drives, paths, tuned: bounded.again(drives, paths, settings)  # noqa: ARG005


def _worst_share(tuned: Tuned) -> bounded.Bounded:
    return bounded.Bounded(slow=False, nu=tuned["nu"] or None)


def _tube(tuned: Tuned) -> tube.Tube:
    return tube.Tube(inflation=tuned["inflation"])


#: What the chain may take the error of a fix for; the first is the usual one.
COLOURS: Mapping[str, chain.Chain] = MappingProxyType(
    {
        "em": chain.Chain(),
        "em-slow": chain.Chain(tail=np.inf, drifting=False),
        "em-white": chain.Chain(slow=False),
    }
)

_SENSORS = ("speed", "yaw_rate")

#: All estimators, in the order of their tables.
METHODS: Mapping[str, Method] = MappingProxyType(
    {
        m.name: m
        for m in (
            Method("linear", "straight lines between fixes", 20.0, (), _linear),
            Method("cv", "constant velocity, RTS smoother", 20.0, (), _smoothed(False), _tuned(False)),
            Method("gpsins", "linear GPS/INS, RTS smoother", 20.0, _SENSORS, _smoothed(True), _tuned(True)),
            Method("ctrv", "constant turn rate and velocity, EKF + RTS", 20.0, _SENSORS, _turning, _tuned_ctrv),
            *(
                Method(
                    name, f"chain that learns its own noise{words}", 60.0, (), _chain(COLOURS[name]), one_of=_SENSORS
                )
                for name, words in (("em", ""), ("em-slow", ", slow fix error"), ("em-white", ", white fix error"))
            ),
            Method(
                "ep",
                "posterior of the chain, noise partly bounded",
                60.0,
                (),
                lambda drives, tuned: credible.solve(drives),  # noqa: ARG005
                one_of=_SENSORS,
                again=lambda drives, paths, tuned: credible.again(drives, paths),  # noqa: ARG005
            ),
            *(
                Method(
                    name,
                    f"chain with bounded noise{words}",
                    20.0,
                    (),
                    _bounded(settings),
                    one_of=_SENSORS,
                    again=_bounded_again(settings),
                )
                for name, words, settings in (
                    ("slp", "", bounded.Bounded()),
                    ("slp-white", ", no fix offset", bounded.Bounded(slow=False)),
                    ("slp-log", ", log objective", bounded.Bounded(objective="log", slow=False)),
                )
            ),
            Method(
                "cvar",
                "chain with bounded noise, mean of the worst rows",
                20.0,
                (),
                lambda drives, tuned: bounded.solve(drives, _worst_share(tuned)),
                lambda drive: {"nu": bounded.nu_of(drive, bounded.Bounded(slow=False)) or 0.0},
                one_of=_SENSORS,
                again=lambda drives, paths, tuned: bounded.again(drives, paths, _worst_share(tuned)),
            ),
            Method(
                "tube",
                "centre of the tube of bounded noise",
                20.0,
                (),
                lambda drives, tuned: tube.solve(drives, _tube(tuned)),
                lambda drive: {"inflation": tube.inflation_of(drive)},
                one_of=_SENSORS,
                again=lambda drives, paths, tuned: tube.again(drives, paths, _tube(tuned)),
                afresh=lambda drives, paths, tuned: tube.again(drives, paths, _tube(tuned), afresh=True),
            ),
            Method(
                "paper000",
                "GPS/INS by linear programming, as printed",
                10.0,
                _SENSORS,
                _programme(_ins, objective="paper", point="optimal"),
            ),
            Method(
                "paper000+ls",
                "the same, least squares inside the optimal half-widths",
                10.0,
                _SENSORS,
                _programme(_ins, objective="paper", point="least_squares"),
            ),
            Method("paper002", "two-antenna GPS/CAN model, MAP", 10.0, _SENSORS, antennas_by(TwoAntennas())),
            Method(
                "paper002-3d",
                "the same with altitude and pitch",
                10.0,
                _SENSORS,
                antennas_by(TwoAntennas(height=True)),
            ),
            Method(
                "paper002lin",
                "linearised two-antenna model, one antenna, least squares",
                10.0,
                _SENSORS,
                _programme(_two_antenna, point="least_squares"),
            ),
        )
    }
)


def heading_of(path: Path) -> Floats:
    """Return the azimuth of a path in (-pi, pi]; where the method gave none, that of its motion."""
    if np.isfinite(path.azimuth).all() or path.t.size < 2:
        return wrapped(path.azimuth)
    east, north = np.gradient(path.east, path.t), np.gradient(path.north, path.t)
    return np.where(np.hypot(east, north) > 0.3, np.arctan2(east, north), np.nan)


def usable(path: Path) -> bool:
    """Whether a path can be shown: it has numbers, and its method did not give up."""
    return path.finite and path.status not in (Status.STALLED, Status.COLLAPSED)
