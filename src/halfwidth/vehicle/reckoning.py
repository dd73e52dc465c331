"""Dead reckoning with all that is unknown of the sensors as states: what their clocks, scale, bias and antenna must be.

The state is that of `chain` and four more that stay as they are: the clocks of speed and yaw rate (s, as a correction
of the offsets that the streams were sampled with) and the place of the antenna (ahead, to the left, m). A step of h
seconds moves the axle by V along the middle azimuth and turns it by -W, with

    V = scale * (integral of the speed)    + (clock of the speed) * dV/d(clock)
    W = integral of the yaw rate - h bias  + (clock of the yaw rate) * dW/d(clock)
    fix = axle + (ahead, left) turned by the azimuth + slow offset + white

where the derivatives are differences of the integrals a tenth of a second sooner and later. While the car stands it
does not turn, and the yaw rate is the bias. A smoother (the core's) gives the most probable state; the streams are
sampled again with the offsets it found, and so on: Gauss-Newton on the whole piece, so the covariance at the end is the
inverse curvature of the posterior. The five noise scales are learnt in the same rounds as in `chain`; each fix, and
each step of the slow offset, has the weight of Student's t in them, so that stray fixes and multipath do not count.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from halfwidth import _core
from halfwidth.vehicle.grid import DRIFT, Grid, bridged, means, silence, silent_from
from halfwidth.vehicle.pointing import azimuth_of

Floats = NDArray[np.float64]

E, N, AZIMUTH, OFFSET_E, OFFSET_N, SCALE, BIAS, SPEED_CLOCK, YAW_CLOCK, AHEAD, LEFT = range(11)

#: The unknowns of the sensors, in the order of `Piece.mean`.
UNKNOWN = (SCALE, SPEED_CLOCK, YAW_CLOCK, AHEAD, LEFT)

#: Names of the learnt scales, as in `chain`.
GROUPS = ("longitudinal", "lateral", "yaw", "offset", "fix")

#: Prior standard deviations of speed scale, clocks (s) and antenna (m), and of the bias (rad/s).
PRIOR, BIAS_SD = np.array([0.05, 0.5, 0.5, 1.0, 1.0]), 0.02

#: Where learning starts, floor and ceiling of the five scales.
_START = np.array([0.1, 0.05, 0.01, 0.3, 0.3])
_FLOOR = np.array([1e-3, 1e-4, 1e-5, 1e-4, 3e-3])
_CEILING = np.array([30.0, 3.0, 3.0, 30.0, 1e3])

#: Degrees of freedom of the fixes, time constant of their slow offset, s.
_FREEDOM, _MEMORY = 4.0, 60.0

#: Walks of scale and bias a root second.
_SCALE_WALK, BIAS_WALK = 1e-4, 1e-4

#: Half the distance of the samples that give the derivatives, and how far a clock moves in one round at most, s.
_APART, _STEP = 0.1, 0.4

#: No clock is further off, s.
_FARTHEST = 5.0

#: Power of the change of a squared scale from round to round: below 2 it still converges.
_HASTE = 1.8

#: Rounds at least, and the change of a squared scale below which no further one is needed.
_LEAST, _SETTLED = 4, 0.3

Streams = Mapping[str, tuple[Floats, Floats]]


@dataclass(frozen=True, eq=False)
class Piece:
    """What one piece of a drive says of the sensors.

    Parameters
    ----------
    t : (T,) array
        Nodes, s.
    mean : (5,) array
        Speed scale, offset of the speed's and of the yaw rate's clock (s), antenna ahead and to the left (m).
    information : (5, 5) array
        Inverse covariance of these, without what the prior added.
    bias : (T,) array
        rad/s.
    bias_sd : float
        Standard deviation of its mean, rad/s.
    azimuth : (T,) array
        rad.
    sigma : (5,) array
        The learnt scales, in the order of `GROUPS`.
    loglik : float
    sound : bool
        Whether the numbers can be used.
    """

    t: Floats
    mean: Floats
    information: Floats = field(repr=False)
    bias: Floats = field(repr=False)
    bias_sd: float
    azimuth: Floats = field(repr=False)
    sigma: Floats
    loglik: float
    sound: bool


def solve(
    grid: Grid,
    streams: Streams,
    still: NDArray[np.bool_],
    clocks: tuple[float, float],
    *,
    antenna: bool = False,
    fixed_clocks: bool = False,
    rounds: int = 12,
    start: Piece | None = None,
) -> Piece:
    """Find what the sensors of one piece of a drive must be.

    Parameters
    ----------
    grid : Grid
        Nodes and fixes; its own speed and yaw rate are not used.
    streams : mapping
        ``"speed"`` and ``"yaw_rate"``: times and samples; a missing one has none.
    still : (T,) bool array
        Steps over which the car surely stands.
    clocks : (float, float)
        Offsets of speed and yaw rate that are tried first, and about which the prior lies, s.
    antenna : bool
        Whether the antenna may sit off the axle.
    fixed_clocks : bool
        Whether the clocks are as given.
    rounds : int
    start : Piece, optional
        An earlier answer for the same nodes, from which to go on.

    Returns
    -------
    Piece
    """
    T = len(grid)
    clock = np.array(clocks if start is None else start.mean[1:3], dtype=np.float64)
    s2 = _START**2 if start is None else start.sigma**2
    azimuth = None if start is None else start.azimuth
    place, weight, slow_weight = np.zeros(2), np.ones(T), np.ones(T)
    prior = PRIOR * np.array([1, *((1e-6,) * 2 if fixed_clocks else (1, 1)), *((1, 1) if antenna else (1e-6,) * 2)])
    seen = np.column_stack((grid.seen, grid.seen, still))
    k = int(np.argmax(grid.seen))
    origin = np.array([grid.east[k], grid.north[k]])
    y = np.column_stack((grid.east, grid.north, np.zeros(T)))
    y[:, :2] -= origin
    y[~grid.seen, :2] = 0.0
    heard = {name: _Heard.of(*streams[name], name, grid) for name in ("speed", "yaw_rate")}
    found: tuple[Floats, Floats, Floats] | None = None
    sigma, loglik = np.sqrt(s2), -np.inf
    n = 11 if antenna else 9  # states; the core has these two sizes compiled
    for k in range(rounds):
        steps = _steps(grid, heard, clock, still)
        if azimuth is None:
            azimuth = azimuth_of(replace(grid, speed=steps.v, yaw_rate=steps.w))
        A, b, Q, S, C = _motion(grid, steps, azimuth, s2, s2[3] * grid.h / slow_weight, still, n)
        H, d = _output(azimuth, place, n)
        y[:, 2] = steps.w_raw
        R = np.zeros((T, 3, 3))
        R[:, 0, 0] = R[:, 1, 1] = s2[4] / weight
        R[:, 2, 2] = steps.gyro_variance
        x0 = np.zeros(n)
        x0[[AZIMUTH, SCALE]] = azimuth[0], 1.0
        x0[[SPEED_CLOCK, YAW_CLOCK]] = np.array(clocks) - clock
        slow = 0.5 * _MEMORY * s2[3]
        P0 = np.diag([1e6, 1e6, 10.0, slow, slow, prior[0] ** 2, BIAS_SD**2, *prior[1:] ** 2])[:n, :n].copy()
        out = _core.kalman_run("smooth", A, None, H, Q, R, y, seen, x0, P0, b=b, d=d, sums=True, threads=1)
        x, P = out["x"], out["P"]
        if int(np.max(out["code"])) >= 3 or not (np.isfinite(x).all() and np.isfinite(P).all()):
            break
        azimuth = x[:, AZIMUTH].copy()
        place = x[-1, AHEAD:].copy() if antenna else place
        fixes = H[:, :2]
        error = y[:, :2] - (fixes @ x[:, :, None])[:, :, 0] - d[:, :2]
        square = np.sum(error**2, axis=1) + np.sum((fixes @ P) * fixes, axis=(1, 2))
        found, sigma, loglik = (x, P, clock), np.sqrt(s2), float(np.ravel(out["loglik"])[0])
        moved = np.clip(x[-1, [SPEED_CLOCK, YAW_CLOCK]], -_STEP, _STEP)
        clock = np.clip(clock + moved, -_FARTHEST, _FARTHEST)
        weight = (_FREEDOM + 2) / (_FREEDOM + square / s2[4])
        W, before = out["W"], s2
        wander = (W[:, OFFSET_E, OFFSET_E] + W[:, OFFSET_N, OFFSET_N]) / grid.h
        slow_weight = (_FREEDOM + 2) / (_FREEDOM + np.maximum(wander, 0.0) / s2[3])
        s2 = _learnt(grid, steps, W, S, C, float(np.sum((weight * square)[grid.seen])), slow_weight * wander, s2)
        still_moving = np.abs(moved) > 0.1 * np.sqrt(P[-1, [SPEED_CLOCK, YAW_CLOCK], [SPEED_CLOCK, YAW_CLOCK]])

        if k >= _LEAST and not still_moving.any() and np.abs(np.log(s2 / before)).max() < _SETTLED:
            break
    if found is None:
        nothing = np.array([1.0, *clocks, 0.0, 0.0])
        return Piece(grid.t, nothing, np.zeros((5, 5)), np.zeros(T), np.inf, np.zeros(T), sigma, loglik, False)
    return _answer(grid, *found, prior, sigma, loglik)


@dataclass(frozen=True, eq=False)
class _Steps:
    """The sensors over each step."""

    v: Floats  # (T,) mean speed, m/s
    w: Floats  # mean yaw rate, 0 while standing, rad/s
    w_raw: Floats  # the same as logged
    speed_shift: Floats  # derivative of the distance by the clock of the speed, m/s
    yaw_shift: Floats  # derivative of the turn by the clock of the yaw rate, rad/s
    weight2: Floats  # (T, 3) squared weights of longitudinal, lateral and yaw residual
    extra: Floats  # (T, 3) variance added where a sensor was silent
    gyro_variance: float  # of the mean yaw rate while standing


@dataclass(frozen=True, eq=False)
class _Heard:
    """What a sensor said about a piece, wherever its clock may be, with one more sample on either side."""

    t: Floats
    values: Floats
    clock: Floats  # times of the samples without those that bridge silences
    limit: float  # from how long a step on it is a silence, s

    @classmethod
    def of(cls, clock: Floats, values: Floats, name: str, grid: Grid) -> "_Heard":
        limit = silent_from(np.diff(clock)) if clock.size > 1 else np.inf
        t, values = (clock, values) if name == "speed" else bridged(clock, values)
        room = _FARTHEST + _APART
        near, own = (_around(times, float(grid.t[0]) - room, float(grid.t[-1]) + room) for times in (t, clock))
        return cls(t[near], values[near], clock[own], limit)


def _around(t: Floats, first: float, last: float) -> slice:
    """Return the samples from one before a time to one after another."""
    return slice(max(int(np.searchsorted(t, first)) - 1, 0), int(np.searchsorted(t, last, side="right")) + 1)


def _steps(grid: Grid, heard: Mapping[str, _Heard], clock: Floats, still: NDArray[np.bool_]) -> _Steps:
    h = grid.h

    def mean(name: str, offset: float) -> Floats:
        return means(grid.t, heard[name].t + offset, heard[name].values)

    def lost(name: str, offset: float) -> Floats:
        return h * silence(grid.t, heard[name].clock + offset, *DRIFT[name], heard[name].limit)

    def shift(name: str, offset: float) -> Floats:
        return h * (mean(name, offset + _APART) - mean(name, offset - _APART)) / (2 * _APART)

    v, w = mean("speed", clock[0]), mean("yaw_rate", clock[1])
    pace = np.abs(v)
    weight2 = np.column_stack((h * np.clip(pace, 0.02, 1.0), h * np.maximum(pace, 0.05) ** 2, h))
    lost_v, lost_w = lost("speed", clock[0]), lost("yaw_rate", clock[1])
    extra = np.column_stack((lost_v**2, (0.02 * lost_v) ** 2, lost_w**2))
    noise = 1e-3
    if still.sum() > 4:
        noise = max(1.4826 * float(np.median(np.abs(w[still] - np.median(w[still])))), 1e-4)
    return _Steps(
        v,
        np.where(still, 0.0, w),
        w,
        shift("speed", clock[0]),
        np.where(still, 0.0, -shift("yaw_rate", clock[1])),
        weight2,
        extra,
        noise**2,
    )


def _motion(
    grid: Grid, steps: _Steps, azimuth: Floats, s2: Floats, slow: Floats, still: NDArray[np.bool_], n: int
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return ``z[k] = A z[k-1] + b + w`` about the azimuths, cov w, and sine and cosine of the middle azimuth."""
    h, v, w = grid.h, steps.v, steps.w
    middle = azimuth.copy()
    middle[1:] = 0.5 * (azimuth[1:] + azimuth[:-1])
    S, C, vh = np.sin(middle), np.cos(middle), v * h
    turns = np.where(still, 0.0, h)  # what a bias adds to the turn
    T = h.size
    A = np.zeros((T, n, n))
    A[:, range(n), range(n)] = 1.0
    for row, along, aside in ((E, S, C), (N, C, -S)):
        A[:, row, AZIMUTH] = aside * vh
        A[:, row, SCALE] = along * vh
        A[:, row, SPEED_CLOCK] = along * steps.speed_shift
        A[:, row, BIAS] = 0.5 * aside * vh * turns
        A[:, row, YAW_CLOCK] = 0.5 * aside * vh * steps.yaw_shift
    A[:, AZIMUTH, BIAS], A[:, AZIMUTH, YAW_CLOCK] = turns, steps.yaw_shift
    A[:, OFFSET_E, OFFSET_E] = A[:, OFFSET_N, OFFSET_N] = np.exp(-h / _MEMORY)
    b = np.zeros((T, n))
    off = vh * (-0.5 * h * w - middle)
    b[:, E], b[:, N], b[:, AZIMUTH] = C * off, -S * off, -h * w
    d = s2[:3] * steps.weight2 + steps.extra
    d[still, 2] = 1e-8 * h[still]
    half = 0.5 * vh
    across = d[:, 1] + half**2 * d[:, 2]
    Q = np.zeros((T, n, n))
    Q[:, E, E] = S * S * d[:, 0] + C * C * across
    Q[:, N, N] = C * C * d[:, 0] + S * S * across
    Q[:, E, N] = Q[:, N, E] = S * C * (d[:, 0] - across)
    Q[:, E, AZIMUTH] = Q[:, AZIMUTH, E] = C * half * d[:, 2]
    Q[:, N, AZIMUTH] = Q[:, AZIMUTH, N] = -S * half * d[:, 2]
    Q[:, AZIMUTH, AZIMUTH] = d[:, 2]
    Q[:, OFFSET_E, OFFSET_E] = Q[:, OFFSET_N, OFFSET_N] = slow
    Q[:, SCALE, SCALE], Q[:, BIAS, BIAS] = _SCALE_WALK**2 * h, BIAS_WALK**2 * h
    A[0], b[0], Q[0] = np.eye(n), 0.0, 0.0
    return A, b, Q, S, C


def _output(azimuth: Floats, place: Floats, n: int) -> tuple[Floats, Floats]:
    """Return the outputs ``H z + d``: fix east and north, and the yaw rate of a standing car."""
    H, d = np.zeros((azimuth.size, 3, n)), np.zeros((azimuth.size, 3))
    H[:, 0, [E, OFFSET_E]] = H[:, 1, [N, OFFSET_N]] = H[:, 2, BIAS, None] = 1.0
    if n > AHEAD:
        S, C = np.sin(azimuth), np.cos(azimuth)
        H[:, 0, AHEAD], H[:, 0, LEFT], H[:, 0, AZIMUTH] = S, -C, place[0] * C + place[1] * S
        H[:, 1, AHEAD], H[:, 1, LEFT], H[:, 1, AZIMUTH] = C, S, -place[0] * S + place[1] * C
        d[:, :2] = -H[:, :2, AZIMUTH] * azimuth[:, None]
    return H, d


def _answer(grid: Grid, x: Floats, P: Floats, clock: Floats, prior: Floats, sigma: Floats, loglik: float) -> Piece:
    mean = np.zeros(5)
    free = prior > 1e-5
    at = np.array(UNKNOWN)[free]
    mean[free] = x[-1, at]
    mean[1:3] += clock
    information = np.zeros((5, 5))
    inside = np.linalg.pinv(P[-1][np.ix_(at, at)]) - np.diag(prior[free] ** -2.0)
    # what the data say is never less than nothing
    values, vectors = np.linalg.eigh(0.5 * (inside + inside.T))
    information[np.ix_(free, free)] = (vectors * np.maximum(values, 0.0)) @ vectors.T
    k = len(grid) // 2
    return Piece(
        grid.t,
        mean,
        information,
        x[:, BIAS].copy(),
        float(np.sqrt(P[k, BIAS, BIAS])),
        x[:, AZIMUTH].copy(),
        sigma,
        loglik,
        True,
    )


def _learnt(
    grid: Grid, steps: _Steps, W: Floats, S: Floats, C: Floats, fixes: float, wander: Floats, s2: Floats
) -> Floats:
    """Return the squared scales: means of posterior squared residuals over squared weights."""
    half = 0.5 * steps.v * grid.h
    squares = np.empty((len(grid), 4))
    squares[:, 0] = S * S * W[:, E, E] + 2 * S * C * W[:, E, N] + C * C * W[:, N, N]
    aside = C * C * W[:, E, E] - 2 * S * C * W[:, E, N] + S * S * W[:, N, N]
    turned = C * W[:, E, AZIMUTH] - S * W[:, N, AZIMUTH]
    squares[:, 1] = aside - 2 * half * turned + half**2 * W[:, AZIMUTH, AZIMUTH]
    squares[:, 2] = W[:, AZIMUTH, AZIMUTH]
    squares[:, :3] /= steps.weight2
    squares[:, 3] = 0.5 * wander
    used = np.ones((len(grid), 4), dtype=bool)
    used[:, :3] = steps.extra == 0
    used[:, 2] &= steps.w == steps.w_raw
    used[0] = False
    used &= np.isfinite(squares)
    new = s2.copy()
    total = np.where(used, np.maximum(squares, 0.0), 0.0).sum(axis=0)
    new[:4] = (total + s2[:4]) / (used.sum(axis=0) + 1.0)
    new[4] = (0.5 * fixes + s2[4]) / (grid.seen.sum() + 1.0)
    new = np.where(np.isfinite(new), new, s2)
    # a scale that the fixes hardly show creeps; a longer step the same way gets there sooner
    return np.asarray(np.clip(s2 * (new / s2) ** _HASTE, _FLOOR**2, _CEILING**2))
