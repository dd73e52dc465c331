"""Which way a car went round where its yaw rate was silent: two first azimuths, and which of them fits.

The chain is linearised about an azimuth. Where a yaw rate speaks the first guess is near enough; across a gap without
one a car may have gone round either way, early or late, and a solution that is found from one side of the truth may
stay there. So each gap of fixes in which a yaw rate is silent is solved by itself, with its surroundings, from two
guesses: the one that a drive starts from anyhow and the bend of a smooth path from one side to the other (`curved`).
The likelihood of the fixes about each solution is its share of the evidence (Laplace): the larger one is the start.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle.chain_rows import in_gap
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.pointing import azimuth_of

Floats = NDArray[np.float64]

#: What a gap is solved with of the drive on each side, s.
_AROUND = 20.0

#: Two guesses that differ by less than this everywhere are one, rad: the chain finds its way from there.
_NEAR = 0.5

#: Solves parts of drives from azimuths (T,) each; the first argument says which drive each is of. Returns a
#: log-likelihood and an azimuth for each; one that is not finite is no solution.
Trial = Callable[[Sequence[int], Sequence[Grid], Sequence[Floats]], list[tuple[float, Floats]]]


def unturned(drive: Grid) -> list[tuple[int, int]]:
    """Return the nodes of the fixes on both sides of each gap in which the yaw rate is silent for a step or more.

    Fixes that are as far apart as usual have no gap between them, however often the sensors speak.
    """
    lost = drive.yaw_rate_sd > 0 if drive.has_yaw_rate else np.ones(len(drive), dtype=bool)
    until = np.concatenate(([0], np.cumsum(lost)))
    seen = np.flatnonzero(drive.seen)
    a, b = seen[:-1], seen[1:]
    which = np.flatnonzero((b - a > 1) & (until[b + 1] > until[a + 1]) & in_gap(drive)[b])
    return [(int(a[k]), int(b[k])) for k in which]


def started(drives: Sequence[Grid], azimuths: Sequence[Floats], trial: Trial) -> list[Floats]:
    """Return first azimuths, each gap without a yaw rate from the side from which the fixes are the likelier.

    Parameters
    ----------
    drives : sequence of Grid
        Each with a speed.
    azimuths : sequence of (T,) arrays
        First azimuths of each, rad.
    trial : function
        As `Trial`.

    Returns
    -------
    list of (T,) arrays
        The very same arrays where nothing is better.
    """
    which: list[int] = []
    parts: list[tuple[slice, int, int]] = []
    cut: list[Grid] = []
    starts: list[Floats] = []
    for i, (drive, own) in enumerate(zip(drives, azimuths, strict=True)):
        gaps = unturned(drive)
        for k, (a, b) in enumerate(gaps):
            # neither into the gap before nor into the next one
            first = max(gaps[k - 1][1] if k else 0, int(np.searchsorted(drive.t, drive.t[a] - _AROUND)))
            stop = int(np.searchsorted(drive.t, drive.t[b] + _AROUND, side="right"))
            rows = slice(first, min(gaps[k + 1][0] + 1, stop) if k + 1 < len(gaps) else stop)
            other = curved(drive.rows(rows), a - first, b - first, own[rows])
            if np.abs(other - own[a : b + 1] - _whole_turns(other[0] - own[a])).max() < _NEAR:
                continue
            which += [i, i]
            parts.append((rows, a, b))
            cut += [drive.rows(rows)] * 2
            starts += [own[rows], joined(own, other, a, b)[rows]]
    found = list(azimuths)
    if not parts:
        return found
    solved = trial(which, cut, starts)
    for n, (rows, a, b) in enumerate(parts):
        (usual, _), (likelihood, azimuth) = solved[2 * n], solved[2 * n + 1]
        if likelihood > usual or (np.isfinite(likelihood) and not np.isfinite(usual)):
            i = which[2 * n]
            inside = slice(a - rows.start, b - rows.start + 1)
            found[i] = joined(found[i], azimuth[inside], a, b)
    return found


def curved(drive: Grid, a: int, b: int, own: Floats) -> Floats:
    """Return the azimuth of the cubic path between two fixes that keeps position and velocity at both.

    That is how constant velocity goes on from one side of a gap to the other.

    Parameters
    ----------
    drive : Grid
        With a speed.
    a, b : int
        Nodes of the fixes on both sides of the gap.
    own : (T,) array
        Azimuth where one side has no two fixes, rad.

    Returns
    -------
    (b - a + 1,) array
        Continuous, rad.
    """
    sides = (slice(0, a + 1), slice(b, len(drive)))
    ends = [azimuth_of(drive.rows(rows)) if drive.seen[rows].sum() > 1 else own[rows] for rows in sides]
    begin, end = float(ends[0][-1]), float(ends[1][0])
    length = float(drive.t[b] - drive.t[a])
    s = (drive.t[a : b + 1] - drive.t[a]) / length
    # north + i east: the argument is the azimuth
    chord = complex(drive.north[b] - drive.north[a], drive.east[b] - drive.east[a])
    leaves = drive.speed[a] * length * np.exp(1j * begin)
    comes = drive.speed[min(b + 1, len(drive) - 1)] * length * np.exp(1j * end)
    velocity = 6 * s * (1 - s) * chord + (1 - s) * (1 - 3 * s) * leaves - s * (2 - 3 * s) * comes
    return np.unwrap(np.angle(velocity))


def joined(own: Floats, other: Floats, a: int, b: int) -> Floats:
    """Put another azimuth (b - a + 1,) between two nodes, the rest turned by whole turns to meet it at both."""
    inside = other + _whole_turns(own[a] - other[0])
    after = own[b + 1 :] + _whole_turns(inside[-1] - own[b])
    return np.concatenate((own[:a], inside, after))


def _whole_turns(angle: float) -> float:
    """Return the whole turns next to an angle, rad."""
    return float(2 * np.pi * np.round(angle / (2 * np.pi)))
