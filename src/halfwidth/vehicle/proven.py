"""A band that must contain the vehicle, from two declared half-widths: of its acceleration and of its fixes.

On each axis the position p and the speed v after a step of h seconds, with an acceleration that never leaves +-q,

    v' = v + h a,    p' = p + h v + h^2 / 2 a + h^2 / 4 b,    |a| <= q, |b| <= q,

contain every motion: a is the mean acceleration of the step, and |p' - p - h v - h^2 / 2 a| <= q h^2 / 4 whatever the
acceleration does inside it. Fixes are within r of the truth, per axis. A cheap set goes over all fixes first, since
where they contradict the two numbers there is no band. `Hull` bounds p in and around every gap; a fix elsewhere is
its own bound. Between two bounded rows, s seconds after the one and s' before the other, p is within q s s' / 2 of
the chord. Nothing is learnt from the log and no other sensor is used, so the band is as true as the two numbers, and
far wider than a calibrated one.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.errors import BadShape, BadValue
from halfwidth.estimate import estimate
from halfwidth.methods import load
from halfwidth.model import Linear
from halfwidth.noise import Uniform
from halfwidth.record import Record
from halfwidth.spread import Box

Floats = NDArray[np.float64]

#: Fixes before one that contradicts which are asked again for the least growth that reconciles them.
_ASKED = 200
#: Fixes around a gap that count for it, rows of a gap that are solved for, and what is no gap, s; other rows follow
#: from their neighbours.
_CONTEXT, _NODES, _SHORT = 20, 30, 3.0

_AXES = ("east", "north")

#: Columns of the band as a table.
COLUMNS: tuple[str, ...] = ("proven_west_m", "proven_east_m", "proven_south_m", "proven_north_m")


@dataclass(frozen=True, eq=False)
class Proven:
    """How far the vehicle can be from a track's positions at most, in each direction.

    Parameters
    ----------
    acceleration : float
        Declared bound of the acceleration east and north, m/s^2.
    fix : float
        Declared bound of a fix's error east and north, m.
    proven_west_m, proven_east_m, proven_south_m, proven_north_m : (M,) arrays
        Metres from the track's position to each side of the box; negative where the position lies outside the box,
        infinite where nothing bounds it.
    """

    acceleration: float
    fix: float
    proven_west_m: Floats
    proven_east_m: Floats
    proven_south_m: Floats
    proven_north_m: Floats

    def __post_init__(self) -> None:
        sizes = {getattr(self, name).shape for name in COLUMNS}
        if len(sizes) != 1:
            raise BadShape(f"the sides of a band have shapes {sorted(sizes)}, one was expected")

    @property
    def columns(self) -> dict[str, Floats]:
        """The four sides by the names of their columns, rounded outwards to a millimetre."""
        return {name: np.ceil(getattr(self, name) * 1e3 + 1e-6) / 1e3 for name in COLUMNS}

    @property
    def half_m(self) -> Floats:
        """(M, 2) array: half of the box, east and north, m."""
        east, north = self.proven_west_m + self.proven_east_m, self.proven_south_m + self.proven_north_m
        return np.column_stack((0.5 * east, 0.5 * north))

    @property
    def words(self) -> str:
        """What the band rests on."""
        return (
            f"holds while the acceleration stays within {self.acceleration:g} m/s\u00b2 and every fix within"
            f" {self.fix:g} m of the truth, each east and north"
        )


def about(east: Floats, north: Floats, lo: Floats, hi: Floats, q: float, r: float) -> Proven:
    """Return the band lo, hi (M, 2) as distances from a track's positions, local metres."""
    return Proven(q, r, east - lo[:, 0], hi[:, 0] - east, north - lo[:, 1], hi[:, 1] - north)


def declared(given: Any) -> tuple[float, float]:
    """Judge the two declared half-widths: acceleration, m/s^2, and fix, m.

    Raises
    ------
    BadValue
    """
    try:
        q, r = (float(v) for v in given)
    except (TypeError, ValueError):
        raise BadValue(
            f"`guaranteed` is {given!r}, two numbers are expected: the acceleration that is never passed, m/s^2,"
            " and the error that no fix passes, m",
            hint="guaranteed=(4, 3)",
        ) from None
    if not (np.isfinite(q) and np.isfinite(r) and q > 0 and r > 0):
        raise BadValue(f"`guaranteed` is {given!r}, two positive numbers are expected", hint="guaranteed=(4, 3)")
    return q, r


def band(t: ArrayLike, fixes: ArrayLike, q: float, r: float) -> tuple[Floats, Floats] | str:
    """Bound the position at every row.

    Parameters
    ----------
    t : (M,) array
        Times, s.
    fixes : (M, 2) array
        East and north in local metres; NaN where there is no fix.
    q, r : float
        Declared half-widths, m/s^2 and m.

    Returns
    -------
    lo, hi : (M, 2) arrays
        Or, in words, why the log contradicts the two numbers.
    """
    t, fixes = np.asarray(t, dtype=np.float64), np.asarray(fixes, dtype=np.float64)
    for axis in (0, 1):
        against = _contradiction(t, fixes[:, axis], q, r)
        if against is not None:
            return f"{_AXES[axis]}: {against}"
    lo, hi = np.nextafter(fixes - r, -np.inf), np.nextafter(fixes + r, np.inf)
    seen = np.isfinite(fixes).all(axis=1)
    held = seen.copy()
    for a, b, kept in _pieces(t, seen):
        held[a:b] = False
        held[kept] = True
        for axis in (0, 1):
            est = estimate(_motion(q, r), Record(t[kept], fixes[kept, axis]), load("Hull")())
            if not est.status.good:
                return f"{_AXES[axis]}: {est.message}"
            ends = est.interval()
            lo[kept, axis], hi[kept, axis] = ends[0][:, 0], ends[1][:, 0]
    return _between(t, held, lo, hi, q)


def _contradiction(t: Floats, fixes: Floats, q: float, r: float) -> str | None:
    """Return in words which fixes (M,) of one axis no motion explains, wherever the gaps are, or None."""
    seen = np.isfinite(fixes)
    t, fixes = t[seen], fixes[seen]
    est = estimate(_motion(q, r), Record(t, fixes), load("ConstrainedZonotopeFilter")())
    if est.status.good:
        return None
    last = est.info["conflict"][0]["row"] + 1
    part = slice(max(0, last - _ASKED), last)
    exact = estimate(_motion(q, r), Record(t[part], fixes[part]), load("Hull")())
    return est.message if exact.status.good else exact.message


def _motion(q: float, r: float) -> Linear:
    """Return one axis: position, speed, and the two accelerations of the step."""

    def A(dt: float) -> Floats:
        return np.array([[1.0, dt, 0, 0], [0, 1.0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])

    def E(dt: float) -> Floats:
        return np.array([[1.0, 0, -dt * dt / 2, -dt * dt / 4], [0, 1.0, -dt, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])

    anywhere = Box([-np.inf, -np.inf, -q, -q], [np.inf, np.inf, q, q])
    return Linear(A, None, [[1.0, 0, 0, 0]], Uniform([0, 0, q, q]), Uniform(r), anywhere, E=E)


def _pieces(t: Floats, seen: NDArray[np.bool_]) -> list[tuple[int, int, NDArray[np.intp]]]:
    """Return every gap with the fixes around it, its rows a to b - 1, and which of them are solved for.

    Those are the fixes and some of the rows of each gap, its first and last ones among them. Gaps that share fixes are
    one.
    """
    edge = np.flatnonzero(np.diff(np.concatenate(([False], ~seen, [False])).astype(np.int8)))
    fixes, keep = np.flatnonzero(seen), seen.copy()
    found: list[tuple[int, int]] = []
    for first, stop in edge.reshape(-1, 2).tolist():
        inside = first > 0 and stop < t.size
        if inside and t[stop] - t[first - 1] <= _SHORT:
            continue
        keep[np.unique(np.linspace(first, stop - 1, min(_NODES, stop - first)).round().astype(int))] = True
        before, after = int(np.searchsorted(fixes, first)), int(np.searchsorted(fixes, stop))
        a = int(fixes[max(0, before - _CONTEXT)]) if before else first
        b = int(fixes[min(fixes.size, after + _CONTEXT) - 1]) + 1 if after < fixes.size else stop
        if found and a < found[-1][1]:
            found[-1] = (found[-1][0], max(b, found[-1][1]))
        else:
            found.append((a, b))
    return [(a, b, np.flatnonzero(keep[a:b]) + a) for a, b in found]


def _between(t: Floats, held: NDArray[np.bool_], lo: Floats, hi: Floats, q: float) -> tuple[Floats, Floats]:
    """Bound the rows between those that are held, by chords of their ends and what the acceleration can add."""
    at = np.flatnonzero(held)
    after = np.searchsorted(at, np.arange(t.size))
    k, j = at[np.maximum(after - 1, 0)], at[np.minimum(after, at.size - 1)]
    s, left = t - t[k], t[j] - t
    share = np.divide(s, t[j] - t[k], out=np.zeros_like(s), where=t[j] > t[k])[:, None]
    bend = (0.5 * q * s * left)[:, None]
    with np.errstate(invalid="ignore"):
        low, high = (1 - share) * lo[k] + share * lo[j], (1 - share) * hi[k] + share * hi[j]
        # rounded operations, each within 1.2e-16 of its terms
        room = bend * (1 + 1e-14) + 1e-14 * (np.abs(lo[k]) + np.abs(lo[j]) + np.abs(hi[k]) + np.abs(hi[j]))
        low, high = low - room, high + room
    low, high = np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)
    return np.where(held[:, None], lo, low), np.where(held[:, None], hi, high)
