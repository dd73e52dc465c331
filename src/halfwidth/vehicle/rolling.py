"""Which wheels the speed is of: in a turn those ahead of the rear axle go further than it does.

A path is reckoned with the speed of the point that does not slip sideways, the middle of the rear axle. But many cars
log that of their front wheels, and a receiver's own speed is that of its antenna. At a distance L ahead of the axle
speed is sqrt(v^2 + L^2 w^2), nearly v + L^2 w^2 / 2v: in a city turn several per cent more, a few decimetres a turn. So
L^2 is a slope, of how much less than logged the fixes move by w^2 / 2v. A wrong scale, a clock that is off and the
speed of one side's wheel alone (which goes with w) are fitted beside it.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import reckoning
from halfwidth.vehicle.grid import Grid, means

Floats = NDArray[np.float64]

#: Wheels are believed to be ahead of the axle when the square of their distance is this many standard deviations above
#: zero, and their distance between these, m.
SIGMAS, LEAST, MOST = 5.0, 0.5, 8.0

#: They are looked for where the car is faster than this, m/s; steps that err alike; blocks of them that are needed.
FASTER, BLOCK, FEWEST = 1.0, 25, 20

#: Rounds in which steps that fit badly lose weight, beyond this many times the median.
_ROUNDS, _ODD = 20, 3.0


def wheels(solved: Sequence[tuple[Grid, reckoning.Piece]], streams: reckoning.Streams) -> tuple[float, float] | None:
    """Find how far ahead of the rear axle the wheels are whose speed is logged.

    Parameters
    ----------
    solved : sequence of (Grid, Piece)
        Pieces of a drive, and what each says of the sensors.
    streams : mapping
        ``"speed"`` and ``"yaw_rate"``: times and samples, as `reckoning.solve` had them.

    Returns
    -------
    (float, float) or None
        Distance and its standard deviation, m; None where the log does not show it.
    """
    rows = [_steps(part, piece, streams) for part, piece in solved]
    blocks = [block for of in rows for block in np.array_split(of, max(1, len(of) // BLOCK)) if len(block)]
    if len(blocks) < FEWEST:
        return None
    every = np.concatenate(blocks)
    X, y = every[:, :-1], every[:, -1]
    weight = np.ones(y.size)
    for _ in range(_ROUNDS):
        normal = (X * weight[:, None]).T @ X + 1e-9 * np.eye(X.shape[1])
        found = np.linalg.solve(normal, X.T @ (weight * y))
        rest = y - X @ found
        weight = 1.0 / (1.0 + (rest / (_ODD * float(np.median(np.abs(rest))) + 1e-9)) ** 2)
    # neighbouring steps err alike: the scatter of sums over blocks counts
    first = np.cumsum([0, *(len(block) for block in blocks[:-1])])
    scores = np.add.reduceat(X * (weight * rest)[:, None], first)
    inverse = np.linalg.inv((X * weight[:, None]).T @ X + 1e-9 * np.eye(X.shape[1]))
    square, sd = float(found[-1]), float(np.sqrt((inverse @ (scores.T @ scores) @ inverse)[-1, -1]))
    if not (np.isfinite(square) and square > SIGMAS * sd and LEAST**2 < square < MOST**2):
        return None
    return float(np.sqrt(square)), sd / (2.0 * float(np.sqrt(square)))


def _steps(part: Grid, piece: reckoning.Piece, streams: reckoning.Streams) -> Floats:
    """Return for each step between neighbouring fixes (n, 5): what explains how much less they move, and that, m/s."""
    speed, turn = (
        means(part.t, streams[name][0] + piece.mean[1 + k], streams[name][1])
        for k, name in enumerate(("speed", "yaw_rate"))
    )
    turn = turn - piece.bias
    steps = part.seen[1:] & part.seen[:-1] & (np.abs(speed[1:]) > FASTER)
    middle = 0.5 * (piece.azimuth[1:] + piece.azimuth[:-1])
    along = (np.sin(middle) * np.diff(part.east) + np.cos(middle) * np.diff(part.north)) / np.diff(part.t)
    v = speed[1:]
    less = piece.mean[0] * v - along
    change = np.gradient(speed, part.t)[1:]
    slope = turn[1:] ** 2 / (2.0 * piece.mean[0] * np.where(np.abs(v) > FASTER, v, FASTER))
    rows: Floats = np.column_stack((v, change, turn[1:], slope, less))[steps]
    return rows
