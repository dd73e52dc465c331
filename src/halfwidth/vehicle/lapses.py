"""Stretches in which speed or yaw rate contradict the fixes by a factor: fallen silent at 0, in another unit or sign.

A channel that drops to 0 while the car drives, a logger that is set from km/h to m/s half-way, a gyro that is mounted
again upside down: such a stream is right for a part of the drive only, and no factor for the whole of it puts it right.
So the drive is cut into windows of a second or two, and for each window and each thing that a stream may be (as most of
it is, in another unit, turned round, silent) it is asked how badly that fits what the fixes show. The most probable
course of such states over the drive is that of a chain that seldom changes (Viterbi). It changes easily where the
stream leaps further than a car can, and only for much evidence where it does not: fixes that come back wrong after a
tunnel, or fade, contradict the speed for some seconds, too, but by no constant factor, and the speed does not leap.

What is in another unit or sign is put right, what is silent or wrong by a factor that is no unit's is not used.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import evidence
from halfwidth.vehicle.lapse import Lapse, put_right
from halfwidth.vehicle.leaping import leaping_speed
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.spikes import LIMIT
from halfwidth.vehicle.units import FACTOR_NEAR

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: What a stream may read of the truth: factors of units and signs; 0 is silent, NaN any other constant factor.
_FACTORS = {
    "speed_mps": (1.0, 3.6, 1 / 0.44704, 3600 / 1852, 1 / 3.6, 0.44704, 0.0, np.nan),
    "yaw_rate_radps": (1.0, -1.0, 180 / np.pi, -180 / np.pi, np.pi / 180, -np.pi / 180, 0.0),
}

#: Length of a window, s, by stream; windows that are needed, and that a stretch must have in which it is contradicted.
_SPAN = {"speed_mps": 1.0, "yaw_rate_radps": 2.0}
_FEWEST, _STRETCH = 20, 4

#: How far either way the clock is looked for, and how far it may be off that, s.
_LAGS, _LAG = 5.0, 0.25
_SLACK = {"speed_mps": 1.0, "yaw_rate_radps": 0.5}

#: What speed and turning of fixes are uncertain by besides their noise: so much, m/s and rad, and this share.
_SIZE = {"speed_mps": (0.3, 0.12), "yaw_rate_radps": (0.06, 0.15)}

#: A window costs so much at most, and if any factor is allowed; a change of state where the stream leaps and elsewhere.
_MOST, _ANY, _LEAP, _CHANGE = 6.0, 3.0, 6.0, 25.0

#: A factor that is no unit's is constant to this share, and off by this (logarithms); slower than this a car hardly
#: moves, m/s.
_CONSTANT, _OFF, _SLOW = 0.12, 0.25, 3.0

#: A leap is so many times what all but a hundredth of the changes are; so many changes say what is usual.
_OFTEN, _CHANGES = 3.0, 50

#: A turn is so much, rad, and so many times as large as it is uncertain; a yaw rate that contradicts such a share of
#: them is none of this car.
_TURN, _TURN_SIZES, _AGAINST = 0.25, 2.5, 0.6

#: Nobody drives backwards this fast, m/s.
_FORWARD = 6.0

#: Two states fit a window alike if they cost so little more.
_ALIKE = 0.5

#: Windows at most, so that a long drive takes no longer.
_WINDOWS = 20_000


def lapses(log: Log) -> tuple[Lapse, ...]:
    """Find stretches in which speed or yaw rate contradict the fixes.

    Parameters
    ----------
    log : Log

    Returns
    -------
    tuple of Lapse
        In order of time, those of the speed first; empty where the log lacks what tells.
    """
    believed = _without_repeats(log)
    turned = _backwards(believed)
    believed = put_right(believed, turned)
    leapt = leaping_speed(believed)
    believed = put_right(believed, leapt)
    found = {name: _of(believed, name) for name in _FACTORS}
    speed = sorted([*leapt, *found["speed_mps"]], key=lambda lapse: lapse.first)
    return (*turned, *speed, *found["yaw_rate_radps"])


def _backwards(log: Log) -> list[Lapse]:
    """Return the whole of a speed whose sign is wrong: no car drives backwards for most of its way, and fast."""
    t, values = log.stream("speed_mps")
    if t.size < _FEWEST:
        return []
    way = np.diff(t) * values[1:]
    fast = np.abs(values) > 0.5 * float(np.quantile(np.abs(values), 0.99))
    if not way.sum() < -0.5 * np.abs(way).sum() or not float(np.mean(values[fast] < 0)) > 0.9:
        return []
    seen = evidence.windows(log, evidence.baseline(log, 1.0))
    pace = float(np.quantile(seen.distance / (seen.stop - seen.start), 0.9)) if seen.start.size else 0.0
    if pace < _FORWARD:
        return []
    return [Lapse("speed_mps", 0, len(log) - 1, -1.0, 1.0, float(values[0]), pace, True)]


def _without_repeats(log: Log) -> Log:
    """Return a log without fixes that are exactly the one before: a frozen receiver says nothing of the speed."""
    rows = np.flatnonzero(log.fixed)
    same = np.concatenate(([False], (np.diff(log.lat_deg[rows]) == 0) & (np.diff(log.lon_deg[rows]) == 0)))
    if not same.any():
        return log
    gone = np.zeros(len(log), dtype=bool)
    gone[rows[same]] = True
    return replace(log, lat_deg=np.where(gone, np.nan, log.lat_deg), lon_deg=np.where(gone, np.nan, log.lon_deg))


@dataclass(frozen=True, eq=False)
class _Windows:
    """What fixes and a stream say of windows of a drive, (n,) each.

    Times on the clock of the fixes, what the fixes show, what the stream says at least and at most for a clock that is
    a little off, how uncertain what the fixes show is; by how much the stream's clock is off, s, and whether they turn.
    """

    start: Floats
    stop: Floats
    shown: Floats
    low: Floats
    high: Floats
    size: Floats
    lag: float
    turning: bool


def _of(log: Log, name: str) -> list[Lapse]:
    """Return the lapses of one stream."""
    t, values = log.stream(name)
    if t.size < _FEWEST or int(log.fixed.sum()) < _FEWEST:
        return []
    seen = _windows(log, name, t, values)
    if seen is None:
        return []
    rows = np.flatnonzero(np.isfinite(getattr(log, name)))
    if np.ptp(values) == 0 and float(np.std(seen.shown)) > 2 * float(np.median(seen.size)):
        pace = float(np.median(np.abs(seen.shown)))
        return [Lapse(name, 0, len(log) - 1, 0.0, 1.0, float(values[0]), pace, False)]
    factors = np.array(_FACTORS[name])
    cost = np.column_stack([_cost(seen, factor) for factor in factors])
    leaping = np.abs(np.diff(values)) > _reach(t, values, name)
    leap = np.flatnonzero(leaping)
    from_, to = seen.start[:-1] - seen.lag - _SLACK[name], seen.stop[1:] - seen.lag + _SLACK[name]
    # in degrees a rate leaps in each turn
    leaps = (not seen.turning) & (np.searchsorted(t[leap + 1], to, side="right") > np.searchsorted(t[leap], from_))
    state = _course(cost, np.where(leaps, _LEAP, _CHANGE))
    turns = np.abs(seen.shown) > np.maximum(_TURN, _TURN_SIZES * seen.size)
    wrong = cost[np.arange(state.size), state][turns] > 0.5 * _MOST
    if seen.turning and wrong.size >= 2 * _STRETCH and wrong.mean() > _AGAINST:
        pace = float(np.median(np.abs(seen.shown)))
        return [Lapse(name, 0, len(log) - 1, float("nan"), 1.0, float(values[0]), pace, False)]
    share = np.bincount(state, minlength=factors.size)
    usual = int(np.argmax(np.where(np.isfinite(factors) & (factors != 0), share, -1)))
    cuts = np.flatnonzero(np.diff(state)) + 1
    found = []
    for a, b in zip([0, *cuts.tolist()], [*cuts.tolist(), state.size], strict=True):
        if state[a] == usual:
            continue
        clear = np.zeros(state.size, dtype=bool)
        clear[a:b] = cost[a:b, usual] > 0.5 * _MOST
        reads = _reads(seen, clear, state == usual, float(factors[state[a]]), float(factors[usual]))
        if reads is None:
            continue
        told = None if seen.turning and abs(factors[state[a]]) != abs(factors[usual]) else leaping
        first = 0 if a == 0 else _edge(t, values, told, *_open(cost, state, a, from_, to))
        last = t.size - 1 if b == state.size else _edge(t, values, told, *_open(cost, state, b, from_, to)) - 1
        pace = float(np.median(np.abs(seen.shown[clear])))
        right = bool(reads == factors[state[a]] and reads != 0)
        if last >= first:
            ends = (0 if a == 0 else int(rows[first])), (len(log) - 1 if b == state.size else int(rows[last]))
            found.append(Lapse(name, *ends, reads, float(factors[usual]), float(values[first]), pace, right))
    return found


def _reach(t: Floats, values: Floats, name: str) -> Floats:
    """Return by how much a stream changes from each sample to the next (n-1,) without leaping."""
    step, change = np.diff(t), np.abs(np.diff(values))
    at_once, rate = LIMIT[name][:2]
    changes = change[change > 0]
    often = _OFTEN * float(np.quantile(changes, 0.99)) if changes.size >= _CHANGES else np.inf
    # a slow sensor may change by much, but it hardly does
    return np.minimum(at_once + rate * step, np.maximum(often, at_once + rate * float(step.min())))


def _windows(log: Log, name: str, t: Floats, values: Floats) -> _Windows | None:
    """Return windows in which fixes and a stream can be compared; None if they are too few."""
    span = evidence.baseline(log, _SPAN[name])
    chord = evidence.windows(log, span)
    took = chord.stop - chord.start
    if took.size < _FEWEST:
        return None
    apart = _thinned(chord.start, span)
    pace = (chord.distance / took)[apart]
    noise = 1.4826 * float(np.median(np.abs(np.diff(pace, 2)))) / np.sqrt(6) if pace.size > 2 else 0.0
    least, part = _SIZE[name]
    if name == "speed_mps":
        start, stop, shown = chord.start[apart], chord.stop[apart], pace
        size = np.hypot(noise, least + part * shown)
        values = np.abs(values)
        per = stop - start
    else:
        start, stop, turned = evidence.turns(log, span)
        apart = _thinned(start, span)
        start, stop, turned = start[apart], stop[apart], turned[apart]
        if start.size < _FEWEST:
            return None
        going = np.interp(start, 0.5 * (chord.start + chord.stop), chord.distance)
        size = np.hypot(np.sqrt(2) * noise * span / np.maximum(going, 1.0), least + part * np.abs(turned))
        shown, values, per = -turned, values, np.ones(start.size)
    lags = np.arange(-_LAGS, _LAGS + 1e-9, _LAG)
    said = np.stack([evidence.integral(t + lag, values, start, stop) / per for lag in lags])
    known = np.isfinite(said).all(axis=0)
    if int(known.sum()) < _FEWEST:
        return None
    start, stop, shown, size, said = start[known], stop[known], shown[known], size[known], said[:, known]
    misfit = np.full(lags.size, np.inf)
    for factor in _FACTORS[name]:
        if np.isfinite(factor) and factor:
            off = np.minimum(np.abs(shown - said / factor) / size, np.sqrt(2 * _MOST))
            misfit = np.minimum(misfit, off.mean(axis=1))
    best = int(np.argmin(misfit + 1e-3 * np.abs(lags)))
    near = np.abs(lags - lags[best]) <= _SLACK[name] + 1e-9
    low, high = said[near].min(axis=0), said[near].max(axis=0)
    return _Windows(start, stop, shown, low, high, size, float(lags[best]), name != "speed_mps")


def _thinned(start: Floats, span: float) -> NDArray[np.intp]:
    """Return windows that hardly overlap, and no more of them than are looked at."""
    kept, last = [], -np.inf
    for k, when in enumerate(start.tolist()):
        if when >= last + span * (1 - 1e-6):
            kept.append(k)
            last = when
    every = max(1, -(-len(kept) // _WINDOWS))
    return np.array(kept[::every], dtype=np.intp)


def _cost(seen: _Windows, factor: float) -> Floats:
    """Return how badly each window (n,) fits a stream that reads so many times the truth."""
    if np.isnan(factor):
        return np.full(seen.shown.size, _ANY)
    if factor == 0:
        # silent is what says 0 where it should not
        off = np.where((seen.low == 0) & (seen.high == 0), 0.0, np.inf)
    else:
        low, high = np.minimum(seen.low / factor, seen.high / factor), np.maximum(seen.low / factor, seen.high / factor)
        off = np.maximum(np.maximum(low - seen.shown, seen.shown - high), 0.0) / seen.size
    return np.asarray(np.minimum(0.5 * off**2, _MOST))


def _course(cost: Floats, change: Floats) -> NDArray[np.intp]:
    """Return the states (n,) of least cost (n, S), where a change between two windows costs `change` (n-1,)."""
    n, size = cost.shape
    total, came = cost[0].copy(), np.zeros((n, size), dtype=np.intp)
    for k in range(1, n):
        best = int(np.argmin(total))
        moved = total[best] + change[k - 1] < total
        came[k] = np.where(moved, best, np.arange(size))
        total = np.where(moved, total[best] + change[k - 1], total) + cost[k]
    state = np.empty(n, dtype=np.intp)
    state[-1] = int(np.argmin(total))
    for k in range(n - 1, 0, -1):
        state[k - 1] = came[k, state[k]]
    return state


def _reads(seen: _Windows, part: Mask, rest: Mask, factor: float, usual: float) -> float | None:
    """Return what a stretch reads of the truth, None if it does not show clearly.

    Its ratio to what the fixes show must be that factor times the ratio elsewhere, or else the same all along.
    """
    if int(part.sum()) < _STRETCH:
        return None
    if not seen.turning and float(np.median(seen.shown[part])) < _SLOW:
        return None
    if factor == 0 or seen.turning:
        return factor
    said = 0.5 * (seen.low + seen.high)
    moving = (seen.shown > _SLOW) & (said > 0)
    ratio = np.log(np.where(moving, said, 1.0) / np.where(moving, seen.shown, 1.0))
    if int((part & moving).sum()) < _STRETCH:
        return None
    elsewhere = float(np.median(ratio[rest & moving])) if int((rest & moving).sum()) >= _STRETCH else np.log(usual)
    low, middle, high = np.quantile(ratio[part & moving], (0.25, 0.5, 0.75))
    away = middle - elsewhere
    if np.isfinite(factor) and abs(away - np.log(factor / usual)) < FACTOR_NEAR:
        return factor
    steady = int((part & moving).sum()) >= 2 * _STRETCH and high - low < 2 * _CONSTANT and abs(away) > _OFF
    return usual * float(np.exp(away)) if steady else None


def _open(cost: Floats, state: NDArray[np.intp], k: int, from_: Floats, to: Floats) -> tuple[float, float]:
    """Return between which times the state changes before window k: where both states fit alike nothing tells."""
    alike = np.abs(cost[:, state[k - 1]] - cost[:, state[k]]) < _ALIKE
    a, b = k, k
    while a > 1 and alike[a - 1]:
        a -= 1
    while b < state.size - 1 and alike[b]:
        b += 1
    return float(from_[a - 1]), float(to[b - 1])


def _edge(t: Floats, values: Floats, leaping: Mask | None, first: float, last: float) -> int:
    """Return the first sample after a change between two times: where the stream leaps, or its noise changes."""
    a, b = int(np.searchsorted(t, first)), int(np.searchsorted(t, last, side="right"))
    if b - a < 2:
        return min(b, t.size - 1)
    step = np.abs(np.diff(values[a:b]))
    if b - a < _FEWEST or (leaping is not None and leaping[a : b - 1].any()):
        return a + 1 + int(np.argmax(step))
    # two scales of Laplace's law, as likely as can be
    total, n = np.cumsum(step), np.arange(1, step.size)
    usual = 0.1 * float(step.mean()) + 1e-12
    left, right = total[:-1] / n + usual, (total[-1] - total[:-1]) / (step.size - n) + usual
    return a + 1 + int(np.argmin(n * np.log(left) + (step.size - n) * np.log(right)))
