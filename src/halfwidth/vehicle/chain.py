"""The chain that fills gaps: dead reckoning between fixes, with all noise scales learnt from the drive itself.

The state is z = [east, north, azimuth, offset east, offset north, speed scale, yaw bias, drift east, drift north]. A
step of h seconds with measured speed v and yaw rate w moves along the azimuth in its middle, S its sine and C its
cosine:

==============  =======================================================  ==========================================
group           residual                                                 standard deviation
==============  =======================================================  ==========================================
longitudinal    S dE + C dN - scale v h                                  sigma_1 sqrt(h max(min(1, abs v), 0.02))
lateral         C dE - S dN (a car does not move sideways)               sigma_2 sqrt(h) max(abs v, 0.05)
slip            part of the same residual: in turns it does              sigma_3 sqrt(h) abs(v w)
yaw             d azimuth + h (w - bias)                                 sigma_4 sqrt(h), a tenth below 0.1 m/s
fix offset      offset[k] - exp(-h / 60 s) offset[k-1] - h drift[k-1]    sigma_5 sqrt(h), heavy-tailed
fix drift       drift[k] - exp(-h / 10 s) drift[k-1], both axes          sigma_6 sqrt(h)
fix             E + offset E - fix E, and north                          sigma_7
==============  =======================================================  ==========================================

Scale and bias are nearly constant: increments of 1e-4 and 1e-5 rad/s per root second, priors 1 +- 0.03 and
0 +- 0.01 rad/s. What a receiver is wrong by is mostly no white noise: it is an offset that lasts for a minute
(without it the path would start a whole fix error off at the edge of a gap), that drifts for some seconds at a time
(the receiver's own filter, reflections that come and go) and that jumps (a correction arrives, a satellite is lost).
The jumps are why increments of the offset have Student's distribution: each has its own weight, learnt with the
scales (Lange, Little and Taylor 1989). In a gap, where nothing tells which increments are jumps, all have the mean
square of those outside.

The residuals are solved for the new state, which makes a linear model ``z[k] = A z[k-1] + b + w`` whose noise is
rotated with the car: a Rauch-Tung-Striebel smoother (the core's) gives the path, and the scales are those of the
largest likelihood. At its maximum a scale is the mean of squared residuals of the path, each residual counted by how
much of it the fixes tell (Harville 1977, MacKay 1992; `_learnt`): twice the logarithmic step of a rule that never
lowers the likelihood (Zhou, Hu, Zhou and Lange 2019), and where the likelihood falls a drive takes half of it from then
on. It comes near the maximum in some 20 rounds; expectation maximisation is as near after hundreds, since a scale that
is too large explains any path. Each round re-linearises about its own path first; the last one goes back to the best of
the late ones where the likelihood has fallen since. Many drives (outages of one log) are solved side by side.

Where a yaw rate is silent for a while its residual has no noise of its own: the yaw rate is what the log's own are
like, and how it deviates from what is expected between the samples on both sides is one more state (`turning`). A gap
without a yaw rate is solved from two sides, since a car may have gone round either way (`bends`).
Without a speed sensor the speed is that of the fixes, with a large variance between them; without a gyro the yaw rate
is taken as 0 and the scale of the yaw residual learns how much the car turns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from halfwidth import _core
from halfwidth.result import Status
from halfwidth.vehicle.bends import Trial, started
from halfwidth.vehicle.chain_rows import Rows, rows_of
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path
from halfwidth.vehicle.pointing import azimuth_of, with_speed

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Names of the learnt scales, in order.
GROUPS: tuple[str, ...] = ("longitudinal", "lateral", "slip", "yaw", "offset", "drift", "fix")

#: Where learning starts: standard deviations in the units of the table above.
_START = np.array([0.1, 0.05, 0.05, 0.01, 0.3, 0.1, 0.3])

#: A scale is not believed below the first or above the second.
_FLOOR = np.array([1e-3, 1e-4, 1e-4, 1e-5, 1e-4, 1e-4, 3e-3])
_CEILING = np.array([30.0, 3.0, 30.0, 3.0, 30.0, 30.0, 1e3])

#: What re-linearising may take from the log-likelihood.
_SLACK = 0.5

LONGITUDINAL, LATERAL, SLIP, YAW, OFFSET, DRIFT, FIX = range(7)

#: Rows of all drives that are solved side by side at most, but for a single longer drive.
_BATCH = 20_000

#: Rounds in which a gap without a yaw rate is tried from another side.
_TRIAL = 6

E, N, AZIMUTH, OFFSET_E, OFFSET_N, SCALE, BIAS, DRIFT_E, DRIFT_N, TURN = range(10)

#: Number of states. Where a yaw rate was silent one more says how it deviates from what is expected; it is not given.
SIZE = 9


@dataclass(frozen=True)
class Chain:
    """Settings of the chain; none of them is tuned to a log.

    Parameters
    ----------
    rounds : int
        Rounds of re-linearising, smoothing and learning.
    memory, drift_memory : float
        Time constants of the fix offset and of its drift, s.
    tail : float
        Degrees of freedom of the increments of the offset; infinite makes them Gaussian.
    slow, drifting : bool
        Whether fixes have an offset at all, and whether it drifts. Without an offset they are wrong by white noise.
    scale_sd, bias_sd : float
        Prior standard deviations of the speed scale and of the yaw bias, rad/s.
    scale_walk, bias_walk : float
        Their increments per root second.
    """

    rounds: int = 24
    memory: float = 60.0
    drift_memory: float = 10.0
    tail: float = 4.0
    slow: bool = True
    drifting: bool = True
    scale_sd: float = 0.03
    bias_sd: float = 0.01
    scale_walk: float = 1e-4
    bias_walk: float = 1e-5

    @property
    def learns(self) -> Mask:
        """(7,) array: whether each scale is learnt; the others stay at their least."""
        return np.array([True] * OFFSET + [self.slow, self.slow and self.drifting, True])


@dataclass(frozen=True, eq=False)
class Fit:
    """The solved chain of one drive.

    Parameters
    ----------
    sigma : (7,) array
        The learnt scales, in the order of `GROUPS`.
    weight : (T,) array
        Weight of the increment of the offset before each node: below 1 where it is taken for a jump.
    z, P : (T, 9) and (T, 9, 9) arrays
        Posterior mean and covariance of the states.
    loglik : float
        Log-likelihood of the fixes, given the weights.
    gained : float
        By how much the last round of learning raised the likelihood: next to 0 where it is at its maximum.
    path : Path
    """

    sigma: Floats
    weight: Floats = field(repr=False)
    z: Floats = field(repr=False)
    P: Floats = field(repr=False)
    loglik: float
    gained: float
    path: Path = field(repr=False)


def solve(
    drives: Sequence[Grid],
    settings: Chain = Chain(),
    *,
    sigma: Floats | None = None,
    azimuth: Sequence[Floats] | None = None,
    weight: Sequence[Floats] | None = None,
    learn: bool = True,
) -> list[Fit]:
    """Solve the chain for several drives side by side.

    Parameters
    ----------
    drives : sequence of Grid
        Each with at least two nodes and one fix.
    settings : Chain
    sigma : (7,) or (n, 7) array, optional
        Scales to start from, or to keep.
    azimuth : sequence of (T,) arrays, optional
        Azimuths to linearise about first; if absent `azimuth_of` each drive, in gaps without a yaw rate what fits
        (`started`).
    weight : sequence of (T,) arrays, optional
        Weights of the increments of the offset to start from; 1 if absent.
    learn : bool
        Whether the scales are learnt; else the rounds only re-linearise and weight.

    Returns
    -------
    list of Fit
        With ``path.status`` STALLED where the numbers broke down; such a path is not to be used.
    """
    given = [with_speed(drive) for drive in drives]
    scales = np.broadcast_to(_START if sigma is None else sigma, (len(given), len(GROUPS)))
    shares = [np.ones(len(drive)) for drive in given] if weight is None else list(weight)
    if azimuth is not None:
        return _batched(given, settings, scales, azimuth, shares, learn)
    first = [azimuth_of(drive) for drive in given]
    if not learn:
        return _batched(given, settings, scales, started(given, first, _trial(settings, scales)), shares, learn)
    fits = _batched(given, settings, scales, first, shares, learn)
    # now that it is known how large the noise is, gaps without a yaw rate are tried from another side
    found = [fit.z[:, AZIMUTH] for fit in fits]
    other = started(given, found, _trial(settings, np.array([fit.sigma for fit in fits]).reshape(scales.shape)))
    which = [i for i in range(len(given)) if other[i] is not found[i]]
    again = _batched(
        [given[i] for i in which], settings, scales[which], [other[i] for i in which], [shares[i] for i in which], learn
    )
    for i, fit in zip(which, again, strict=True):
        if fit.path.status is Status.OK and not fit.loglik < fits[i].loglik:
            fits[i] = fit
    return fits


def _trial(settings: Chain, sigma: Floats) -> Trial:
    """Return what solves parts of drives with scales (n, 7) that are known."""
    quick = replace(settings, rounds=_TRIAL)

    def solved(which: Sequence[int], parts: Sequence[Grid], azimuth: Sequence[Floats]) -> list[tuple[float, Floats]]:
        fits = _batched(parts, quick, sigma[list(which)], azimuth, [np.ones(len(part)) for part in parts], False)
        return [(fit.loglik if fit.path.status is Status.OK else -np.inf, fit.z[:, AZIMUTH]) for fit in fits]

    return solved


def _batched(
    drives: Sequence[Grid],
    settings: Chain,
    sigma: Floats,
    azimuth: Sequence[Floats],
    weight: Sequence[Floats],
    learn: bool,
) -> list[Fit]:
    """Solve drives side by side, so many at a time that a day of driving fits into memory."""
    fits: list[Fit] = []
    rows = np.cumsum([len(drive) for drive in drives])
    for batch in np.unique(rows // _BATCH):
        which = np.flatnonzero(rows // _BATCH == batch).tolist()
        fits += _solved(
            [drives[i] for i in which],
            settings,
            sigma[which],
            [azimuth[i] for i in which],
            [weight[i] for i in which],
            learn,
        )
    return fits


def _solved(
    drives: Sequence[Grid],
    settings: Chain,
    sigma: Floats,
    azimuth: Sequence[Floats],
    weight: Sequence[Floats],
    learn: bool,
) -> list[Fit]:
    rows = rows_of(drives)
    psi, share = np.concatenate(azimuth), np.concatenate(weight)
    learns = settings.learns
    jumps = settings.slow and bool(np.isfinite(settings.tail))
    s2 = np.where(learns, sigma, _FLOOR) ** 2
    # of each drive: the scales before its last step, the likelihood there, and what share of a step is taken
    start, reached, stride, gained = s2, np.full(len(drives), -np.inf), np.ones(len(drives)), np.zeros(len(drives))
    best, most = (s2, share, psi), reached
    for k in range(settings.rounds):
        last = k == settings.rounds - 1
        if last:  # from the best of the late rounds, where learning has lost its way since
            lost = most > reached + _SLACK
            s2 = np.where(lost[:, None], best[0], s2)
            mine = lost[rows.drive]
            share, psi = np.where(mine, best[1], share), np.where(mine, best[2], psi)
        line = _linearised(rows, psi)
        out = _smoothed(rows, line, s2, share, settings, squares=not last and (learn or jumps), covariances=last)
        worth = out.loglik + _cost(rows, share, settings.tail) if jumps else out.loglik
        gained = np.where(np.isfinite(reached), worth - reached, 0.0)
        if last:
            break
        if 2 * k >= settings.rounds:  # likelihoods from afar are those of another line
            better = worth > most
            most = np.where(better, worth, most)
            mine = better[rows.drive]
            best = (
                np.where(better[:, None], s2, best[0]),
                np.where(mine, share, best[1]),
                np.where(mine, psi, best[2]),
            )
        # azimuths go on all the same: from afar their way to what fits may lead through what does not
        psi = np.where(np.isfinite(out.x[:, AZIMUTH]), out.x[:, AZIMUTH], psi)
        fell, reached = ~(worth > reached - _SLACK), worth
        stride = np.where(fell, 0.5, stride)
        new = s2
        if learn:
            ratio = np.where(learns, _learnt(rows, out, s2, share), 1.0)
            new = np.clip(s2 * ratio ** stride[:, None], _FLOOR**2, _CEILING**2)
        if jumps:
            share = _shares(rows, out, s2, settings.tail)
        s2, start = np.where(fell[:, None], np.sqrt(s2 * start), new), np.where(fell[:, None], start, s2)
    return [_fit(rows, out, s2[i], share, i, drive, settings, float(gained[i])) for i, drive in enumerate(drives)]


@dataclass(frozen=True, eq=False)
class _Line:
    """The azimuths that a linear model is about, in the middle of the steps, (R,), with their sines and cosines."""

    middle: Floats
    S: Floats
    C: Floats


def _linearised(rows: Rows, psi: Floats) -> _Line:
    """Linearise the residuals about the azimuths psi."""
    middle = psi.copy()
    middle[1:] = 0.5 * (psi[1:] + psi[:-1])
    middle[rows.first] = psi[rows.first]
    return _Line(middle, np.sin(middle), np.cos(middle))


@dataclass(frozen=True, eq=False)
class _Smoothed:
    """What the core returns, one drive below the other."""

    x: Floats  # (R, 9)
    P: Floats  # (R, 9, 9), and
    squares: Floats  # (R, 5) squares of the residuals of the path: empty where they are not asked for
    spread: Floats  # (R, 5) and the variances of the residuals, given all fixes
    misfit: Floats  # (n,) sums of the squares of what fixes are off the path, both axes
    unsure: Floats  # (n,) sums of the variances of that
    counted: Floats  # (n,) number of fixes
    loglik: Floats  # (n,)
    code: Sequence[int]  # (n,)


def _smoothed(
    rows: Rows, line: _Line, s2: Floats, share: Floats, settings: Chain, *, squares: bool, covariances: bool
) -> _Smoothed:
    """Run the smoother of the core over all drives; s2 (n, 7) are squared scales, share (R,) weights of increments."""
    h, n = rows.h, len(rows.origin)
    own = s2[rows.drive]
    along, aside, yaw = _variances(rows, own)
    size = SIZE + (rows.turn is not None)
    start = rows.offsets[:-1]
    x0, P0 = np.zeros((n, size)), np.zeros((n, size))
    x0[:, SCALE] = 1.0
    x0[:, AZIMUTH] = np.arctan2(line.S[start], line.C[start])
    offset, drift = _stationary(s2, settings)
    P0[:, E] = P0[:, N] = rows.far**2
    P0[:, AZIMUTH] = 10.0
    P0[:, OFFSET_E] = P0[:, OFFSET_N] = offset
    P0[:, DRIFT_E] = P0[:, DRIFT_N] = drift
    P0[:, SCALE], P0[:, BIAS] = settings.scale_sd**2, settings.bias_sd**2
    turn = {}
    if rows.turn is not None:
        P0[:, TURN] = 1.0
        turn = {"turn": rows.turn.size, "stay": rows.turn.keep, "q_turn": rows.turn.q}
    return _Smoothed(
        **{"P": np.empty(0), "squares": np.empty(0), "spread": np.empty(0)}
        | _core.drive_smooth(
            offsets=rows.offsets,
            order=rows.order,
            h=h,
            d=rows.v * h,
            w=rows.w,
            middle=line.middle,
            S=line.S,
            C=line.C,
            along=along,
            aside=aside,
            yaw=yaw,
            keep=np.exp(-h / settings.memory),
            fade=np.exp(-h / settings.drift_memory),
            q_offset=own[:, OFFSET] * h / share,
            q_drift=own[:, DRIFT] * h,
            scale_walk=settings.scale_walk**2,
            bias_walk=settings.bias_walk**2,
            y=rows.y,
            seen=rows.seen,
            r=np.ascontiguousarray(s2[:, FIX]),
            x0=x0,
            P0=P0,
            covariances=covariances,
            squares=squares,
            **turn,
        )
    )


def _variances(rows: Rows, own: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the variances (R,) of the longitudinal, lateral and yaw residuals; own (R, 7) are squared scales."""
    d = own[:, : YAW + 1] * rows.weight2
    return d[:, 0] + rows.extra[:, 0], d[:, LATERAL] + d[:, SLIP] + rows.extra[:, 1], d[:, YAW] + rows.extra[:, 2]


def _stationary(s2: Floats, settings: Chain) -> tuple[Floats, Floats]:
    """Return the variances of offset and drift of fixes over a long time; s2 (..., 7) are squared scales."""
    m, d = settings.memory, settings.drift_memory
    drift = 0.5 * d * s2[..., DRIFT]
    return 0.5 * m * s2[..., OFFSET] + drift * m * m * d / (m + d), drift


def _shares(rows: Rows, out: _Smoothed, s2: Floats, tail: float) -> Floats:
    """Return the weights (R,) of the increments of the offset from their expected squares, under scales s2."""
    square = 0.5 * (out.squares + out.spread)[:, 3] / rows.h
    scale = s2[rows.drive, OFFSET]
    share = (tail + 2.0) / (tail + 2.0 * square / scale)
    n = len(rows.origin)
    known = _told(rows) & np.isfinite(square)
    count = np.bincount(rows.drive[known], minlength=n)
    mean = np.bincount(rows.drive[known], square[known], n) / np.maximum(count, 1)
    # where fixes are too rare to tell, an increment is as large as Student's distribution makes it
    usual = np.where(count > 0, s2[:, OFFSET] / np.maximum(mean, 1e-12), max(1.0 - 2.0 / tail, 0.1))
    return np.clip(np.where(rows.gap, usual[rows.drive], np.where(np.isfinite(share), share, 1.0)), 1e-6, 1e6)


def _told(rows: Rows) -> Mask:
    """Return the rows (R,) whose increment of the offset has a weight of its own."""
    return ~rows.gap & ~rows.first


def _cost(rows: Rows, share: Floats, tail: float) -> Floats:
    """Return what weights cost (n,): with the likelihood given them the logarithm of Student's but for a constant."""
    each = np.where(_told(rows), np.log(share) - share + 1.0, 0.0)
    return np.asarray(0.5 * tail * np.bincount(rows.drive, each, len(rows.origin)))


def _learnt(rows: Rows, out: _Smoothed, s2: Floats, share: Floats) -> Floats:
    """Return by what the squared scales (n, 7) are to be multiplied.

    The slope of the log-likelihood in the logarithm of a group's variance is (a - b) / 2: a sums the squared residuals
    m^2 of the path over their variances V, and b how much of each residual the fixes tell, 1 - v / V, v its variance
    given them. At the maximum they are equal. Where a residual belongs to two groups each has its part of V.

    Rows where a sensor was silent are left out. One pseudo-row at the present value keeps a short drive from learning
    that it has no noise.
    """
    own, r = s2[rows.drive], s2[:, FIX]
    along, aside, yaw = _variances(rows, own)
    prior = np.column_stack((along, aside, yaw, own[:, OFFSET] * rows.h / share, own[:, DRIFT] * rows.h))
    axes = np.array([1.0, 1.0, 1.0, 2.0, 2.0])
    which = [LONGITUDINAL, LATERAL, LATERAL, 2, 3, 4]  # the residual of each group
    part = np.ones((len(own), FIX))
    part[:, [LATERAL, SLIP]] = own[:, [LATERAL, SLIP]] * rows.weight2[:, [LATERAL, SLIP]] / aside[:, None]
    a, b = out.squares / (axes * prior), 1.0 - out.spread / (axes * prior)
    keep = rows.counted & np.isfinite(a + b)[:, which]
    sums = (np.where(keep, part * np.maximum(one, 0.0)[:, which], 0.0) for one in (a, b))
    tops, bottoms = (np.add.reduceat(one, rows.offsets[:-1]) for one in sums)
    tops = np.column_stack((tops, 0.5 * out.misfit / r))
    bottoms = np.column_stack((bottoms, np.maximum(out.counted - 0.5 * out.unsure / r, 0.0)))
    ratio = (tops + 1.0) / (bottoms + 1.0)
    return np.where(np.isfinite(ratio), ratio, 1.0)


def _fit(
    rows: Rows, out: _Smoothed, s2: Floats, share: Floats, i: int, drive: Grid, settings: Chain, gained: float
) -> Fit:
    part = slice(int(rows.offsets[i]), int(rows.offsets[i + 1]))
    z, P = out.x[part, :SIZE].copy(), out.P[part, :SIZE, :SIZE]
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
        "slow_sd": float(np.sqrt(_stationary(s2, settings)[0])) if settings.slow else 0.0,
    }
    path = Path(
        drive.t,
        east,
        north,
        z[:, AZIMUTH],
        speed,
        np.maximum(variance, 0.0) if sound else variance,
        float(s2[FIX]),
        Status.STALLED if broken else Status.OK,
        info,
    )
    return Fit(sigma, share[part].copy(), z, P, float(out.loglik[i]), gained, path)


def learnt_noise(drive: Grid, fit: Fit, settings: Chain = Chain()) -> tuple[Floats, Floats, Floats]:
    """Return the noise of each step that a fit found, for estimators that look at the same residuals otherwise.

    Parameters
    ----------
    drive : Grid
        The drive of the fit, with a speed (`with_speed`).
    fit : Fit
    settings : Chain

    Returns
    -------
    sd : (T, 9) array
        Standard deviations of the residuals along and across the way and of the yaw, of the increments of scale, bias,
        offset east and north, drift east and north.
    extra : (T, 3) array
        Variances that come on top of the first three where sensors were silent.
    start : (9,) array
        Variances of the same before the first node; of the position, of how far it may be.
    """
    rows, s2 = rows_of([drive]), fit.sigma[None] ** 2
    h, own = rows.h, s2[rows.drive]
    residuals = np.column_stack(_variances(rows, own)) - rows.extra
    walks = np.column_stack((settings.scale_walk**2 * h, settings.bias_walk**2 * h))
    offset = own[:, OFFSET] * h / fit.weight
    drift = own[:, DRIFT] * h
    sd = np.sqrt(np.column_stack((residuals, walks, offset, offset, drift, drift)))
    slow, drifts = (float(v[0]) for v in _stationary(s2, settings))
    far = float(rows.far[0]) ** 2
    start = np.array([far, far, 10.0, settings.scale_sd**2, settings.bias_sd**2, slow, slow, drifts, drifts])
    return sd, rows.extra, start


#: The core's code for a belief that left the range of floating point.
_BROKEN = 3
