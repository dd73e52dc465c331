"""The chain that fills gaps: dead reckoning between fixes, with all noise scales learnt from the drive itself.

The state is z = [east, north, azimuth, offset east, offset north, speed scale, yaw bias]. A step of h seconds with
measured speed v and yaw rate w moves along the azimuth in its middle, S its sine and C its cosine:

==============  =======================================================  ==========================================
group           residual                                                 standard deviation
==============  =======================================================  ==========================================
longitudinal    S dE + C dN - scale v h                                  sigma_1 sqrt(h max(min(1, abs v), 0.02))
lateral         C dE - S dN (a car does not move sideways)               sigma_2 sqrt(h) max(abs v, 0.05)
yaw             d azimuth + h (w - bias)                                 sigma_3 sqrt(h), a tenth below 0.1 m/s
fix offset      offset[k] - exp(-h / 60 s) offset[k-1], both axes        sigma_4 sqrt(h)
fix             E + offset E - fix E, and north                          sigma_5
==============  =======================================================  ==========================================

Scale and bias are nearly constant: increments of 1e-4 and 1e-5 rad/s per root second, priors 1 +- 0.03 and
0 +- 0.01 rad/s. The offset is what a receiver is wrong by for a minute at a time; without it the path would start a
whole fix error off at the edge of a gap.

The residuals are solved for the new state, which makes a linear model ``z[k] = A z[k-1] + b + w`` whose noise is
rotated with the car: a Rauch-Tung-Striebel smoother (the core's) gives the path, and the five scales are the means of
posterior squared residuals (expectation maximisation, Shumway and Stoffer 1982). Each round re-linearises about its
own path first. Many drives (outages of one log) are solved side by side.

Without a speed sensor the speed is that of the fixes, with a large variance between them; without a gyro the yaw rate
is taken as 0 and the scale of the yaw residual learns how much the car turns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from halfwidth import _core
from halfwidth.result import Status
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Names of the five learnt scales, in order.
GROUPS: tuple[str, ...] = ("longitudinal", "lateral", "yaw", "offset", "fix")

#: Where learning starts: standard deviations in the units of the table above.
_START = np.array([0.1, 0.05, 0.01, 0.3, 0.3])

#: A scale is not believed below the first or above the second.
_FLOOR = np.array([1e-3, 1e-4, 1e-5, 1e-4, 3e-3])
_CEILING = np.array([30.0, 3.0, 3.0, 30.0, 1e3])

#: Rows of all drives that are solved side by side at most, but for a single longer drive.
_BATCH = 20_000

E, N, AZIMUTH, OFFSET_E, OFFSET_N, SCALE, BIAS = range(7)


@dataclass(frozen=True)
class Chain:
    """Settings of the chain; none of them is tuned to a log.

    Parameters
    ----------
    rounds : int
        Rounds of re-linearising, smoothing and learning.
    memory : float
        Time constant of the fix offset, s.
    scale_sd, bias_sd : float
        Prior standard deviations of the speed scale and of the yaw bias, rad/s.
    scale_walk, bias_walk : float
        Their increments per root second.
    """

    rounds: int = 24
    memory: float = 60.0
    scale_sd: float = 0.03
    bias_sd: float = 0.01
    scale_walk: float = 1e-4
    bias_walk: float = 1e-5


@dataclass(frozen=True, eq=False)
class Fit:
    """The solved chain of one drive.

    Parameters
    ----------
    sigma : (5,) array
        The learnt scales, in the order of `GROUPS`.
    z, P : (T, 7) and (T, 7, 7) arrays
        Posterior mean and covariance of the states.
    loglik : float
        Log-likelihood of the fixes.
    path : Path
    """

    sigma: Floats
    z: Floats = field(repr=False)
    P: Floats = field(repr=False)
    loglik: float
    path: Path = field(repr=False)


def solve(
    drives: Sequence[Grid],
    settings: Chain = Chain(),
    *,
    sigma: Floats | None = None,
    azimuth: Sequence[Floats] | None = None,
    learn: bool = True,
) -> list[Fit]:
    """Solve the chain for several drives side by side.

    Parameters
    ----------
    drives : sequence of Grid
        Each with at least two nodes and one fix.
    settings : Chain
    sigma : (5,) or (n, 5) array, optional
        Scales to start from, or to keep.
    azimuth : sequence of (T,) arrays, optional
        Azimuths to linearise about first; `azimuth_of` each drive if absent.
    learn : bool
        Whether the scales are learnt; else the rounds only re-linearise.

    Returns
    -------
    list of Fit
        With ``path.status`` STALLED where the numbers broke down; such a path is not to be used.
    """
    start = np.broadcast_to(_START if sigma is None else sigma, (len(drives), 5))
    first = [None] * len(drives) if azimuth is None else list(azimuth)
    fits: list[Fit] = []
    # so many at a time that a day of driving fits into memory
    rows = np.cumsum([len(drive) for drive in drives])
    for batch in np.unique(rows // _BATCH):
        which = np.flatnonzero(rows // _BATCH == batch).tolist()
        fits += _solved(
            [_with_speed(drives[i]) for i in which], settings, start[which], [first[i] for i in which], learn
        )
    return fits


def _solved(
    drives: Sequence[Grid], settings: Chain, sigma: Floats, azimuth: Sequence[Floats | None], learn: bool
) -> list[Fit]:
    rows = _rows(drives)
    given = zip(drives, azimuth, strict=True)
    psi = np.concatenate([azimuth_of(drive) if first is None else first for drive, first in given])
    s2 = sigma**2
    for k in range(settings.rounds):
        line = _linearised(rows, psi)
        out = _smoothed(rows, line, s2, settings)
        found = out.x[:, AZIMUTH]
        psi = np.where(np.isfinite(found), found, psi)
        if learn and k < settings.rounds - 1:
            s2 = _learnt(rows, line, out, s2)
    return [_fit(rows, out, s2[i], i, drive, settings) for i, drive in enumerate(drives)]


def azimuth_of(drive: Grid) -> Floats:
    """Return a first azimuth: the integrated yaw rate, turned to where fixes and courses point.

    The turn is a smooth function of time, so that a yaw bias of a few hundredths of a rad/s is absorbed.

    Parameters
    ----------
    drive : Grid

    Returns
    -------
    (T,) array
        Radians, clockwise from north, continuous.
    """
    if not drive.has_yaw_rate:
        return _direction(drive)
    t, h = drive.t, drive.h
    turned = np.concatenate(([0.0], np.cumsum(-(drive.yaw_rate * h)[1:])))
    seen = np.flatnonzero(drive.seen)
    # displacements over about two seconds: short enough to be straight, long enough to stand out of the noise
    stride = max(1, round(2.0 / max(float(np.median(np.diff(t[seen]))), 1e-3))) if seen.size > 1 else 1
    a, b = seen[:-stride], seen[stride:]
    near = t[b] - t[a] <= 2.0 * 2.0 + 1e-9
    a, b = a[near], b[near]
    moved = (drive.north[b] - drive.north[a]) + 1j * (drive.east[b] - drive.east[a])
    weight = np.abs(moved) if not drive.has_speed else np.abs(drive.speed[b]) * (t[b] - t[a])
    pointing = moved * weight * np.exp(-0.5j * (turned[a] + turned[b]))
    when = 0.5 * (t[a] + t[b])
    given = np.flatnonzero(np.isfinite(drive.course))
    straight = (2.0 * np.maximum(np.abs(drive.speed[given]), 1.0)) ** 2 * np.exp(
        1j * (drive.course[given] - turned[given])
    )
    when = np.concatenate((when, t[given]))
    pointing = np.concatenate((pointing, straight))
    if when.size == 0 or not np.any(pointing):
        return turned
    knots = np.linspace(t[0], t[-1], max(2, min(400, int((t[-1] - t[0]) / 5.0) + 2)))
    near2 = ((knots[:, None] - when) / 15.0) ** 2
    # far from all data the nearest one decides: the exponent is taken relative to the best of each knot
    turn = np.exp(-0.5 * (near2 - near2.min(axis=1, keepdims=True))) @ pointing
    first: Floats = turned + np.interp(t, knots, np.unwrap(np.angle(turn)))
    return first


def _secants(drive: Grid) -> tuple[Floats, Floats, NDArray[np.complex128]]:
    """Return middle times, lengths in time and displacements (north + i east) between fixes about a second apart."""
    seen = np.flatnonzero(drive.seen)
    t = drive.t[seen]
    if seen.size < 2:
        return np.empty(0), np.empty(0), np.empty(0, dtype=complex)
    stride = max(1, round(1.0 / max(float(np.median(np.diff(t))), 1e-3)))
    stride = min(stride, seen.size - 1)
    a, b = seen[:-stride], seen[stride:]
    took = drive.t[b] - drive.t[a]
    near = took <= max(3.0, 1.5 * float(np.median(took)))
    a, b, took = a[near], b[near], took[near]
    moved = (drive.north[b] - drive.north[a]) + 1j * (drive.east[b] - drive.east[a])
    return 0.5 * (drive.t[a] + drive.t[b]), took, moved


def _direction(drive: Grid) -> Floats:
    """Return an azimuth without a yaw rate: the direction in which the fixes move, turning evenly between them."""
    when, _, moved = _secants(drive)
    far = np.abs(moved) > 0.5
    if not far.any():
        return np.zeros(len(drive))
    turning: Floats = np.interp(drive.t, when[far], np.unwrap(np.angle(moved[far])))
    return turning


def _with_speed(drive: Grid) -> Grid:
    """Give a drive without a speed sensor the speed of its fixes, changing evenly where there are none.

    Where no fix is near, the guess may be off by 0.7 m/s for each second to the next one, at most by 5 m/s.
    """
    if drive.has_speed:
        return drive
    when, took, moved = _secants(drive)
    if when.size == 0:
        return replace(drive, speed_sd=np.full(len(drive), 5.0), has_speed=True)
    h = drive.h
    middle = drive.t - 0.5 * h
    k = np.searchsorted(when, middle)
    before, after = when[np.maximum(k - 1, 0)], when[np.minimum(k, when.size - 1)]
    outside = (k == 0) | (k == when.size)
    far = np.where(
        outside, np.abs(middle - np.where(k == 0, after, before)), np.minimum(middle - before, after - middle)
    )
    pause = np.where(outside, 2 * far, after - before)
    sd = np.minimum(0.7 * far, 5.0) * np.sqrt(np.maximum(pause / h, 1.0))
    lost = pause > 1.5 * float(np.median(took))
    return replace(
        drive, speed=np.interp(middle, when, np.abs(moved) / took), speed_sd=np.where(lost, sd, 0.0), has_speed=True
    )


@dataclass(frozen=True, eq=False)
class _Rows:
    """All nodes of all drives, one drive below the other; R rows, n drives."""

    offsets: NDArray[np.int64]  # (n + 1,)
    drive: NDArray[np.int32]  # (R,)
    first: Mask  # (R,)
    h: Floats
    v: Floats
    w: Floats
    weight2: Floats  # (R, 3) squared weights of the first three groups
    extra: Floats  # (R, 3) variance added to them where a sensor was silent
    y: Floats  # (R, 2) fixes, about the first of each drive
    seen: Mask  # (R, 2)
    origin: Floats  # (n, 2)
    far: Floats  # (n,) how far the first node may be from the first fix, m


def _rows(drives: Sequence[Grid]) -> _Rows:
    sizes = np.array([len(drive) for drive in drives])
    offsets = np.concatenate(([0], np.cumsum(sizes))).astype(np.int64)
    index = np.repeat(np.arange(len(drives), dtype=np.int32), sizes)

    def joined(name: str) -> Floats:
        return np.concatenate([getattr(drive, name) for drive in drives])

    h, v, w = joined("h"), joined("speed"), joined("yaw_rate")
    first = np.zeros(offsets[-1], dtype=bool)
    first[offsets[:-1]] = True
    pace = np.abs(v)
    still = (pace < 0.1) & np.repeat([drive.has_yaw_rate for drive in drives], sizes)
    weight2 = np.column_stack(
        (h * np.maximum(np.minimum(1.0, pace), 0.02), h * np.maximum(pace, 0.05) ** 2, h * np.where(still, 0.01, 1.0))
    )
    # a step of unknown speed may also slide: without this the lateral row would trust a wrong displacement
    lost_speed, lost_yaw = h * joined("speed_sd"), h * joined("yaw_rate_sd")
    extra = np.column_stack((lost_speed**2, (0.02 * lost_speed) ** 2, lost_yaw**2))
    seen = np.concatenate([drive.seen for drive in drives])
    origin, far = np.zeros((len(drives), 2)), np.zeros(len(drives))
    for i, drive in enumerate(drives):
        k = int(np.argmax(drive.seen))
        origin[i] = drive.east[k], drive.north[k]
        far[i] = 100.0 + 2.0 * float(np.sum((np.abs(drive.speed) * drive.h)[1 : k + 1]))
    y = np.column_stack((joined("east"), joined("north"))) - origin[index]
    y[~seen] = 0.0
    return _Rows(offsets, index, first, h, v, w, weight2, extra, y, np.column_stack((seen, seen)), origin, far)


@dataclass(frozen=True, eq=False)
class _Line:
    """The linear model about one azimuth: ``z[k] = A z[k-1] + b + w``."""

    A: Floats  # (R, 7, 7)
    b: Floats  # (R, 7)
    S: Floats  # (R,) sine and cosine of the middle azimuth
    C: Floats
    half: Floats  # (R,) v h / 2


def _linearised(rows: _Rows, psi: Floats) -> _Line:
    """Solve the residuals for the new state, about the azimuths psi."""
    h, v, w = rows.h, rows.v, rows.w
    middle = psi.copy()
    middle[1:] = 0.5 * (psi[1:] + psi[:-1])
    middle[rows.first] = psi[rows.first]
    S, C, vh = np.sin(middle), np.cos(middle), v * h
    A = np.zeros((h.size, 7, 7))
    A[:, range(7), range(7)] = 1.0
    A[:, E, AZIMUTH], A[:, E, SCALE], A[:, E, BIAS] = C * vh, S * vh, 0.5 * C * vh * h
    A[:, N, AZIMUTH], A[:, N, SCALE], A[:, N, BIAS] = -S * vh, C * vh, -0.5 * S * vh * h
    A[:, AZIMUTH, BIAS] = h
    aside = vh * (-0.5 * h * w - middle)
    b = np.zeros((h.size, 7))
    b[:, E], b[:, N], b[:, AZIMUTH] = C * aside, -S * aside, -h * w
    A[rows.first] = np.eye(7)
    b[rows.first] = 0.0
    return _Line(A, b, S, C, 0.5 * vh)


_OUT = np.zeros((2, 7))
_OUT[0, [E, OFFSET_E]] = _OUT[1, [N, OFFSET_N]] = 1.0


@dataclass(frozen=True, eq=False)
class _Smoothed:
    """What the core returns, one drive below the other."""

    x: Floats  # (R, 7)
    P: Floats  # (R, 7, 7)
    W: Floats  # (R, 7, 7) expected squares of the state noise, given all fixes
    V: Floats  # (n, 2, 2) their sums of the output noise
    counted: Floats  # (n,) and counts
    loglik: Floats  # (n,)
    code: NDArray[np.int64]  # (n,)


def _smoothed(rows: _Rows, line: _Line, s2: Floats, settings: Chain) -> _Smoothed:
    """Run the smoother of the core over all drives; s2 (n, 5) are squared scales."""
    h, n = rows.h, len(rows.origin)
    fade = np.exp(-h / settings.memory)
    A = line.A.copy()
    inner = ~rows.first
    A[inner, OFFSET_E, OFFSET_E] = A[inner, OFFSET_N, OFFSET_N] = fade[inner]
    own = s2[rows.drive]
    d = own[:, :3] * rows.weight2 + rows.extra
    # the noise of the rotated residuals, in the axes of the state
    across = d[:, 1] + line.half**2 * d[:, 2]
    Q = np.zeros((h.size, 7, 7))
    S, C = line.S, line.C
    Q[:, E, E] = S * S * d[:, 0] + C * C * across
    Q[:, N, N] = C * C * d[:, 0] + S * S * across
    Q[:, E, N] = Q[:, N, E] = S * C * (d[:, 0] - across)
    Q[:, E, AZIMUTH] = Q[:, AZIMUTH, E] = C * line.half * d[:, 2]
    Q[:, N, AZIMUTH] = Q[:, AZIMUTH, N] = -S * line.half * d[:, 2]
    Q[:, AZIMUTH, AZIMUTH] = d[:, 2]
    Q[:, OFFSET_E, OFFSET_E] = Q[:, OFFSET_N, OFFSET_N] = own[:, 3] * h
    Q[:, SCALE, SCALE] = settings.scale_walk**2 * h
    Q[:, BIAS, BIAS] = settings.bias_walk**2 * h
    Q[rows.first] = 0.0
    start = rows.offsets[:-1]
    x0, P0 = np.zeros((n, 7)), np.zeros((n, 7, 7))
    x0[:, SCALE] = 1.0
    x0[:, AZIMUTH] = np.arctan2(S[start], C[start])
    stationary = 0.5 * settings.memory * s2[:, 3]
    P0[:, E, E] = P0[:, N, N] = rows.far**2
    P0[:, AZIMUTH, AZIMUTH] = 10.0
    P0[:, OFFSET_E, OFFSET_E] = P0[:, OFFSET_N, OFFSET_N] = stationary
    P0[:, SCALE, SCALE], P0[:, BIAS, BIAS] = settings.scale_sd**2, settings.bias_sd**2
    # one drive at a time: the sums of the core are kept for each row of Q, so they cannot be shared between drives
    parts = []
    for i in range(n):
        part = slice(int(rows.offsets[i]), int(rows.offsets[i + 1]))
        parts.append(
            _core.kalman_run(
                "smooth",
                A[part],
                None,
                _OUT,
                Q[part],
                s2[i, 4] * np.eye(2),
                rows.y[part],
                rows.seen[part],
                x0[i],
                P0[i],
                b=line.b[part],
                sums=True,
                threads=1,
            )
        )
    return _Smoothed(
        *(np.concatenate([part[name] for part in parts]) for name in ("x", "P", "W", "V", "nV", "loglik", "code"))
    )


def _learnt(rows: _Rows, line: _Line, out: _Smoothed, s2: Floats) -> Floats:
    """Return the squared scales (n, 5): means of posterior squared residuals over squared weights.

    Rows where a sensor was silent are left out. One pseudo-row at the present value keeps a short drive from learning
    that it has no noise.
    """
    W, S, C, c = out.W, line.S, line.C, line.half
    squares = np.empty((rows.h.size, 4))
    squares[:, 0] = S * S * W[:, E, E] + 2 * S * C * W[:, E, N] + C * C * W[:, N, N]
    squares[:, 1] = (
        C * C * W[:, E, E]
        - 2 * S * C * W[:, E, N]
        + S * S * W[:, N, N]
        - 2 * c * (C * W[:, E, AZIMUTH] - S * W[:, N, AZIMUTH])
        + c * c * W[:, AZIMUTH, AZIMUTH]
    )
    squares[:, 2] = W[:, AZIMUTH, AZIMUTH]
    squares[:, :3] /= rows.weight2
    squares[:, 3] = 0.5 * (W[:, OFFSET_E, OFFSET_E] + W[:, OFFSET_N, OFFSET_N]) / rows.h
    used = np.ones((rows.h.size, 4), dtype=bool)
    used[:, :3] = rows.extra == 0
    used[rows.first] = False
    n = len(rows.origin)
    new = np.empty((n, 5))
    for g in range(4):
        keep = used[:, g] & np.isfinite(squares[:, g])
        total = np.bincount(rows.drive[keep], np.maximum(squares[keep, g], 0.0), n)
        new[:, g] = (total + s2[:, g]) / (np.bincount(rows.drive[keep], minlength=n) + 1.0)
    V = out.V
    new[:, 4] = (0.5 * (V[:, 0, 0] + V[:, 1, 1]) + s2[:, 4]) / (out.counted + 1.0)
    new = np.where(np.isfinite(new), new, s2)
    return np.clip(new, _FLOOR**2, _CEILING**2)


def _fit(rows: _Rows, out: _Smoothed, s2: Floats, i: int, drive: Grid, settings: Chain) -> Fit:
    part = slice(int(rows.offsets[i]), int(rows.offsets[i + 1]))
    z, P = out.x[part].copy(), out.P[part]
    z[:, [E, N]] += rows.origin[i]
    east, north = z[:, E] + z[:, OFFSET_E], z[:, N] + z[:, OFFSET_N]
    variance = np.column_stack([P[:, a, a] + 2 * P[:, a, o] + P[:, o, o] for a, o in ((E, OFFSET_E), (N, OFFSET_N))])
    mean = np.concatenate((drive.speed[1:], drive.speed[-1:]))
    speed = z[:, SCALE] * 0.5 * (drive.speed + mean)
    sound = bool(np.isfinite(z).all() and np.isfinite(variance).all() and (variance >= 0).all())
    broken = not sound or int(out.code[i]) >= _BROKEN
    sigma = np.sqrt(s2)
    info = {
        "sigma": dict(zip(GROUPS, (float(s) for s in sigma), strict=True)),
        "speed_scale": float(np.mean(z[:, SCALE])),
        "yaw_bias": float(np.mean(z[:, BIAS])),
        "slow_sd": float(np.sqrt(0.5 * settings.memory * s2[3])),
    }
    path = Path(
        drive.t,
        east,
        north,
        z[:, AZIMUTH],
        speed,
        np.maximum(variance, 0.0) if sound else variance,
        float(s2[4]),
        Status.STALLED if broken else Status.OK,
        info,
    )
    return Fit(sigma, z, P, float(out.loglik[i]), path)


#: The core's code for a belief that left the range of floating point.
_BROKEN = 3
