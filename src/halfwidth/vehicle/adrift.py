"""Sensors whose clock is seconds to hours off that of the fixes: found from the course of the speed, and moved.

A logger of the bus that was never set, or whose stamps count from when it was switched on, is off by more than the
calibration looks for. But a car's stops and starts are like a fingerprint: the speed between fixes, laid along that of
the sensor at any offset, agrees at one only. The correlation at all offsets comes from six Fourier transforms. It is
believed where it is nearly one over a minute or more, far better than near no offset, and than anywhere else.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import evidence
from halfwidth.vehicle.log import STREAMS, Log

Floats = NDArray[np.float64]

#: Steps that speeds are laid out in, s, and so many of them at most.
_STEP, _MOST = 0.5, 400_000

#: Offsets up to this are found by the calibration, s; a peak is so wide, s.
NEAR, _PEAK = 2.0, 15.0

#: Seconds of moving and standing that must lie on each other at least; the correlation there, and how many times as far
#: from 1 those near no offset and at any other are.
_OVERLAP, _SURE, _CLEAR = 60.0, 0.95, 3.0

#: Fixes and samples that are needed.
_FEWEST = 50

_SENSED = ("speed_mps", "yaw_rate_radps", "ax_mps2", "ay_mps2")


def adrift(log: Log) -> float | None:
    """Find by how much the clock of the sensors is off that of the fixes, if by more than the calibration looks for.

    Parameters
    ----------
    log : Log

    Returns
    -------
    float or None
        Seconds to add to the stamps of the sensors; None where their clock is near, or nothing tells.
    """
    t, speed = log.stream("speed_mps")
    chord = evidence.windows(log, evidence.baseline(log, 1.0))
    if t.size < _FEWEST or chord.start.size < _FEWEST:
        return None
    middle, pace = 0.5 * (chord.start + chord.stop), chord.distance / (chord.stop - chord.start)
    first, last = min(float(middle[0]), float(t[0])), max(float(middle[-1]), float(t[-1]))
    step = max(_STEP, (last - first) / _MOST)
    shown, said = _laid_out(middle, pace, first, last, step), _laid_out(t, np.abs(speed), first, last, step)
    lag, alike = _correlations(shown, said, step)
    near = np.abs(lag) <= NEAR
    best = int(np.argmax(alike))
    if near[best] or alike[best] < _SURE:
        return None
    missing = _CLEAR * (1.0 - alike[best])
    away = np.abs(lag - lag[best]) > _PEAK
    other = max(alike[near].max(initial=-1.0), alike[away].max(initial=-1.0))
    if 1.0 - other < missing:
        return None
    return float(lag[best])


def moved(log: Log, seconds: float) -> Log:
    """Return a log whose sensors are stamped so many seconds later.

    Rows that stand near enough get what the sensors said at their time, and rows are added between the fixes where none
    stands. Rows beyond the fixes that are left without anything were stamped by the clock that is off: they go.
    """
    streams = {name: log.stream(name) for name in _SENSED if np.isfinite(getattr(log, name)).sum() > 1}
    fixes = log.t[log.fixed]
    times = log.t
    for t, _ in streams.values():
        usual = float(np.median(np.diff(t)))
        more = t[(t + seconds > fixes[0]) & (t + seconds < fixes[-1])] + seconds
        after = np.clip(np.searchsorted(times, more), 1, times.size - 1)
        apart = np.minimum(np.abs(more - times[after - 1]), np.abs(more - times[after]))
        times = np.union1d(times, more[apart > 0.75 * usual])
    place = np.searchsorted(times, log.t)
    changed: dict[str, Any] = {}
    for name in STREAMS:
        if name in streams:
            changed[name] = _at(*streams[name], times - seconds)
        else:
            changed[name] = np.full(times.size, np.nan)
            changed[name][place] = getattr(log, name)
    empty = ~np.any([np.isfinite(values) for values in changed.values()], axis=0)
    kept = ~(empty & ((times < fixes[0]) | (times > fixes[-1])))
    return replace(log, t=times[kept], **{name: values[kept] for name, values in changed.items()})


def words(seconds: float) -> str:
    """Say what was found."""
    when = "later" if seconds < 0 else "earlier"
    return (
        f"the clock of speed and yaw rate is off: they are stamped {abs(seconds):.1f} s {when} than the fixes of the"
        " same moment, as stops and starts show: moved"
    )


def _laid_out(t: Floats, values: Floats, first: float, last: float, step: float) -> Floats:
    """Return means of a stream in even steps; NaN where nothing came."""
    n = int((last - first) / step) + 1
    cell = np.minimum(((t - first) / step).astype(np.intp), n - 1)
    number = np.bincount(cell, minlength=n)
    total = np.bincount(cell, weights=values, minlength=n)
    out = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    # slow samples leave holes between them
    held = np.flatnonzero(number)
    gap = np.diff(held)
    few = max(2, 2 * int(np.median(gap))) if gap.size else 0
    between = np.interp(np.arange(n), held, out[held])
    wide = np.repeat(np.concatenate((gap > few, [False])), np.diff(np.concatenate((held, [n]))))
    hole = np.concatenate((np.ones(int(held[0]), dtype=bool), wide)) & (number == 0)
    hole[int(held[-1]) + 1 :] = True
    out = np.where(hole, np.nan, between)
    return np.asarray(out)


def _correlations(shown: Floats, said: Floats, step: float) -> tuple[Floats, Floats]:
    """Return all offsets, s, and the correlation at each: -1 where too little lies on each other, or stands still."""
    n = shown.size
    size = 1 << int(2 * n - 1).bit_length()
    known = [np.isfinite(one).astype(float) for one in (shown, said)]
    centre = [float(np.nanmean(one)) for one in (shown, said)]
    a, b = (np.where(np.isfinite(one), one - mean, 0.0) for one, mean in zip((shown, said), centre, strict=True))

    def turned(x: Floats) -> Any:
        return np.fft.rfft(x, size)

    def together(x: Any, y: Any) -> Floats:
        both: Floats = np.fft.irfft(x * np.conj(y), size)
        return np.concatenate((both[-(n - 1) :], both[:n])) if n > 1 else both[:1]

    fa, fb, fka, fkb = turned(a), turned(b), turned(known[0]), turned(known[1])
    count = np.maximum(together(fka, fkb), 1e-9)
    mean_a, mean_b = together(fa, fkb) / count, together(fka, fb) / count
    var_a = together(turned(a**2), fkb) / count - mean_a**2
    var_b = together(fka, turned(b**2)) / count - mean_b**2
    both = together(fa, fb) / count - mean_a * mean_b
    enough = (count * step > _OVERLAP) & (var_a > 0.1 * float(a.var())) & (var_b > 0.1 * float(b.var()))
    alike = np.where(enough, both / np.sqrt(np.maximum(var_a * var_b, 1e-12)), -1.0)
    return np.asarray(np.arange(-(n - 1), n) * step), np.asarray(alike, dtype=np.float64)


def _at(t: Floats, values: Floats, when: Floats) -> Floats:
    """Return a stream at other times, NaN where none of its samples is near."""
    usual = float(np.median(np.diff(t)))
    after = np.clip(np.searchsorted(t, when), 1, t.size - 1)
    apart = t[after] - t[after - 1]
    inside = (when >= t[0] - 1e-9) & (when <= t[-1] + 1e-9) & (apart < 3.0 * usual)
    return np.where(inside, np.interp(when, t, values), np.nan)
