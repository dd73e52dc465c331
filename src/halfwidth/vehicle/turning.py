"""How a car turns while its yaw rate is silent, learnt from where it speaks.

A yaw rate lasts for some seconds and is gone then, and it is larger in slow bends than on fast roads. So while it is
silent it is taken to be ``s(v) u``: s is what the log's own yaw rates are at that speed (root mean square), and u is a
Gauss-Markov process of variance 1 whose time constant is the integral of the log's own autocorrelation. At the samples
on both sides of a silence u is known but for the gyro's noise. Given both it is a bridge (Doob's transform of the
Ornstein-Uhlenbeck process): its mean is ``(sinh((L - s) / tau) u_0 + sinh(s / tau) u_L) / sinh(L / tau)`` after s of L
seconds, and what it deviates by is Markov again, with

    keep = sinh((L - s - h) / tau) / sinh((L - s) / tau),     q = 2 sinh(h / tau) keep

as what is left of it after a step of h seconds and the variance that comes in. So the chain carries the deviation as
one more state, and the fixes, and the heading on both sides, say what it was.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle.grid import Grid

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: What is taken where a log says nothing: time constant, s, and size of a yaw rate, rad/s; it counts for one time
#: constant of driving.
LASTS, SIZE = 3.0, 0.15

#: Time constants of driving that a size is the mean of at least, and the number of sizes at most.
_WORTH, _MOST = 10.0, 12

#: A step is never taken to be the end of a bridge but for the last one: shorter than this is no time, s.
_INSTANT = 1e-6


@dataclass(frozen=True, eq=False)
class Turning:
    """How fast a car turns, and for how long.

    Parameters
    ----------
    lasts : float
        Time constant of the yaw rate, s.
    pace, size : (n,) arrays
        Speeds, m/s, and the root mean square yaw rate at each, rad/s.
    """

    lasts: float = LASTS
    pace: Floats = field(default_factory=lambda: np.zeros(1))
    size: Floats = field(default_factory=lambda: np.full(1, SIZE))

    def of(self, speed: Floats) -> Floats:
        """Return the root mean square yaw rate at speeds (n,), rad/s."""
        return np.asarray(np.sqrt(np.interp(np.abs(speed), self.pace, self.size**2)))


def turning(h: Floats, speed: Floats, yaw_rate: Floats, spoke: Mask) -> Turning:
    """Learn how a car turns.

    Parameters
    ----------
    h, speed, yaw_rate : (T,) arrays
        Steps, s, and mean speed, m/s, and yaw rate, rad/s, in them.
    spoke : (T,) bool array
        Steps in which both sensors spoke.

    Returns
    -------
    Turning
    """
    if spoke.sum() < 2:
        return Turning()
    lasts = _lasts(h, yaw_rate, spoke)
    order = np.flatnonzero(spoke)[np.argsort(np.abs(speed[spoke]), kind="stable")]
    took, pace, square = h[order], np.abs(speed[order]), yaw_rate[order] ** 2
    overall = (float(took @ square) + lasts * SIZE**2) / (float(took.sum()) + lasts)
    n = int(np.clip(took.sum() / (_WORTH * lasts), 1, _MOST))
    part = np.minimum((np.cumsum(took) / took.sum() * n).astype(int), n - 1)
    time = np.bincount(part, took, n)
    full = time > 0
    mean = np.bincount(part, took * pace, n)[full] / time[full]
    size2 = (np.bincount(part, took * square, n)[full] + lasts * overall) / (time[full] + lasts)
    return Turning(lasts, mean, np.sqrt(size2))


def _lasts(h: Floats, rate: Floats, spoke: Mask) -> float:
    """Return the integral of the autocorrelation up to where it ends, s."""
    usual = float(np.median(h[spoke]))
    alike = spoke & (np.abs(h - usual) < 0.5 * usual)
    left = np.where(alike, rate, 0.0)
    n = left.size
    room = 1 << (2 * n - 1).bit_length()

    def products(series: Floats) -> Floats:
        return np.asarray(np.fft.irfft(np.abs(np.fft.rfft(series, room)) ** 2, room)[:n])

    pairs = products(alike.astype(np.float64))
    mean = products(left) / np.maximum(pairs, 0.5)
    if not mean[0] > 0:
        return LASTS
    share = mean / mean[0]
    ends = np.flatnonzero((share <= 0) | (pairs < 0.5 * pairs[0]))
    stop = int(ends[0]) if ends.size else n
    found, known = usual * (0.5 + float(share[1:stop].sum())), usual * float(pairs[0])
    return float(np.clip((known * found + LASTS * LASTS) / (known + LASTS), 0.5 * usual, 10 * LASTS))


@dataclass(frozen=True, eq=False)
class Bridges:
    """Yaw rates that were silent: what is expected, and how what is not deviates.

    Parameters
    ----------
    yaw_rate : (T,) array
        Mean over each step, rad/s, of those that spoke and as expected of those that were silent.
    size : (T,) array
        What one unit of the deviation is, rad/s; 0 where the sensor spoke.
    keep, q : (T,) arrays
        What is left of the deviation after the step, and the variance that comes in.
    """

    yaw_rate: Floats
    size: Floats
    keep: Floats
    q: Floats


def bridges(h: Floats, speed: Floats, yaw_rate: Floats, silent: Mask, law: Turning) -> Bridges:
    """Bridge the steps in which a yaw rate was silent.

    Parameters
    ----------
    h, speed, yaw_rate : (T,) arrays
        Steps, s, and mean speed, m/s, and yaw rate, rad/s, in them; the yaw rate of silent ones is not used.
    silent : (T,) bool array
    law : Turning

    Returns
    -------
    Bridges
    """
    rate, keep, q = yaw_rate.copy(), np.zeros(h.size), np.zeros(h.size)
    size = np.where(silent, law.of(speed), 0.0)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], silent, [False]))))
    for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        steps, tau = slice(a, b), law.lasts
        since = np.cumsum(h[steps])
        length = float(since[-1])
        before, after = a > 0, b < h.size
        u0 = _unit(yaw_rate[a - 1], law.of(speed[a - 1 : a])) if before else 0.0
        u1 = _unit(yaw_rate[b], law.of(speed[b : b + 1])) if after else 0.0
        middle, left = since - 0.5 * h[steps], length - since + h[steps]
        if after:  # then the deviation ends in 0
            stays = _sinh_ratio(np.maximum(left - h[steps], 0.0), np.maximum(left, _INSTANT), tau)
            comes = 2 * np.sinh(np.minimum(h[steps] / tau, 50.0)) * stays
        else:
            stays = np.exp(-h[steps] / tau)
            comes = 1 - stays**2
        if before and after:
            mean = u0 * _sinh_ratio(length - middle, length, tau) + u1 * _sinh_ratio(middle, length, tau)
        else:
            mean = u0 * np.exp(-middle / tau) + u1 * np.exp(-(length - middle) / tau)
        rate[steps], keep[steps], q[steps] = size[steps] * mean, stays, comes
    return Bridges(rate, size, keep, q)


def bridged(drive: Grid) -> Bridges:
    """Return the yaw rates of a drive, with those that were silent bridged by the law of the others.

    Parameters
    ----------
    drive : Grid

    Returns
    -------
    Bridges
    """
    h, silent = drive.h, (drive.yaw_rate_sd > 0) & drive.has_yaw_rate
    law = turning(h, drive.speed, drive.yaw_rate, (drive.yaw_rate_sd == 0) & (drive.speed_sd == 0))
    return bridges(h, drive.speed, drive.yaw_rate, silent, law)


def joined(parts: Sequence[Bridges]) -> Bridges:
    """Put the bridges of drives one below the other."""
    return Bridges(*(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(Bridges)))


def _unit(rate: float, size: Floats) -> float:
    """Return what a yaw rate is in units of what is usual."""
    return float(rate / max(float(size[0]), 1e-6))


def _sinh_ratio(part: Floats, whole: Floats | float, tau: float) -> Floats:
    """Return sinh(part / tau) / sinh(whole / tau), however long."""
    return np.asarray(np.exp((part - whole) / tau) * np.expm1(-2 * part / tau) / np.expm1(-2 * np.asarray(whole) / tau))
