"""The estimators without a chain: straight lines, smoothers of linear models and of CTRV, the papers' linear programs.

Noise levels of the Gaussian models are learnt once a log, by likelihood; `estimators` has their names.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.estimate import estimate
from halfwidth.methods import load
from halfwidth.model import Linear, Nonlinear
from halfwidth.noise import Gaussian
from halfwidth.record import Record
from halfwidth.result import Estimate
from halfwidth.spread import Normal
from halfwidth.vehicle import models
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path
from halfwidth.vehicle.pointing import azimuth_of

Floats = NDArray[np.float64]
Tuned = Mapping[str, float]

# ---- the straight line ---------------------------------------------------------------------------------------------


def straight_lines(drives: Sequence[Grid], tuned: Tuned) -> list[Path]:  # noqa: ARG001
    """Return straight lines between the fixes of each drive."""
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


def smoothed(driven: bool) -> Callable[[Sequence[Grid], Tuned], list[Path]]:
    """Return the smoother of constant velocity, or with the acceleration of speed and azimuth (Pavelková 2011)."""

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


def tuned_by_likelihood(driven: bool) -> Callable[[Grid], Tuned]:
    """Return what learns the noise levels of that smoother from a drive, by likelihood."""

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


def turning(drives: Sequence[Grid], tuned: Tuned) -> list[Path]:
    """Smooth drives by constant turn rate and velocity, with speed scale and yaw bias."""
    paths = []
    for drive in drives:
        case = _ctrv_case(drive)
        model = _ctrv(drive, case, {**tuned, "azimuth": float(azimuth_of(drive)[0])})
        est = estimate(model, case.record, load("ExtendedKalman")(smooth=True))
        paths.append(_path(drive, case, est, est.x[:, 2], est.x[:, 3], tuned))
    return paths


def tuned_ctrv(drive: Grid) -> Tuned:
    """Learn the noise levels of `turning` from a drive, by likelihood."""
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


def programme(build: Callable[[Grid], tuple[Linear, Floats]], **settings: Any) -> Any:
    """Return the estimator of a linear model by `BatchLP` with these settings."""

    def run(drives: Sequence[Grid], tuned: Tuned) -> list[Path]:
        paths = []
        for drive in drives:
            model, u = build(drive)
            case = _case(drive, u)
            est = estimate(model, case.record, load("BatchLP")(**settings))
            paths.append(_path(drive, case, est, azimuth_of(drive), drive.speed, tuned))
        return paths

    return run


def gps_ins(drive: Grid) -> tuple[Linear, Floats]:
    """Return the GPS/INS model of Pavelková (2011) of a drive, and its acceleration."""
    return models.gps_ins(drive.h), _acceleration(drive)


def two_antenna(drive: Grid) -> tuple[Linear, Floats]:
    """Return the linearised two-antenna model of a drive, with one antenna, and its displacement."""
    moved = models.displacement(azimuth_of(drive), drive.speed, drive.h)
    return models.two_antenna_linear(antennas=1), moved
