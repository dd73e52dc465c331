"""Where a drive points and how fast it goes before anything is solved: first guesses from fixes, courses and gyro."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle.grid import Grid, between

Floats = NDArray[np.float64]

#: What points somewhere counts by how near it is, as a Gaussian of this deviation, s, and so many of them off no more;
#: so many knots are looked at together.
_SPREAD, _REACH, _ABREAST = 15.0, 9.0, 32


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
    turn = _smooth(knots, when, pointing)
    first: Floats = turned + np.interp(t, knots, np.unwrap(np.angle(turn)))
    return first


def _smooth(knots: Floats, when: Floats, pointing: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return means of what is known at some times, weighted by how near they are to each knot, both ascending.

    Far from all data the nearest one decides: the weights are relative to the largest one of each knot.
    """
    order = np.argsort(when, kind="stable")
    when, pointing = when[order], pointing[order]
    after = np.clip(np.searchsorted(when, knots), 1, when.size)
    nearest = np.minimum(np.abs(knots - when[after - 1]), np.abs(knots - when[np.minimum(after, when.size - 1)]))
    # what is further off than this counts for nothing: a few knots at a time look at what is around them
    reach = np.hypot(nearest, _REACH * _SPREAD)
    turn = np.zeros(knots.size, dtype=np.complex128)
    for k in range(0, knots.size, _ABREAST):
        own = slice(k, k + _ABREAST)
        lo, hi = np.searchsorted(when, [(knots - reach)[own].min(), (knots + reach)[own].max()])
        near2 = (knots[own, None] - when[lo:hi]) ** 2 - nearest[own, None] ** 2
        turn[own] = np.exp(-0.5 / _SPREAD**2 * near2) @ pointing[lo:hi]
    return turn


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


def with_speed(drive: Grid) -> Grid:
    """Give a drive without a speed sensor the speed of its fixes, changing evenly where there are none.

    Where no fix is near, the guess may be off by 0.7 m/s for each second to the next one, at most by 5 m/s. Where a
    sensor is silent for a while the speed is that of the fixes that come meanwhile.

    Parameters
    ----------
    drive : Grid

    Returns
    -------
    Grid
        The same where it has a speed all along.
    """
    silent = drive.speed_sd > 0
    if drive.has_speed and not silent.any():
        return drive
    when, took, moved = _secants(drive)
    if when.size == 0:
        return drive if drive.has_speed else replace(drive, speed_sd=np.full(len(drive), 5.0), has_speed=True)
    middle = drive.t - 0.5 * drive.h
    sd, pause = between(middle, drive.h, when, 0.7, 5.0)
    lost = pause > 1.5 * float(np.median(took))
    speed = np.interp(middle, when, np.abs(moved) / took)
    if drive.has_speed:
        # how far off it may be stays: fixes that stray are not to be believed as a sensor is
        return replace(drive, speed=np.where(silent & ~lost, speed, drive.speed))
    return replace(drive, speed=speed, speed_sd=np.where(lost, sd, 0.0), has_speed=True)
