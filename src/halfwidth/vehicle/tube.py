"""The tube of all paths that bounded noise allows, and its centre as the path.

The half-widths of the bounded chain (`halfwidth.vehicle.bounded`: along and across the way, yaw rate, fix; scale and
bias within their bounds) are learnt by linear programming, and are the smallest that explain the drive. They are
inflated by a factor that hiding stretches of the same log has shown (`inflation_of`), and `halfwidth.bound` gives the
box, east and north, that the position must lie in with them, from the fixes on both sides. Its middle is the path, its
half-width the band. The band is as good as learnt half-widths are: it is no guarantee, and `fill` sizes it like any
other. What is declared instead of learnt is in `halfwidth.vehicle.proven`.

A set knows no averages, so neighbouring fixes tell it little that is new: it is computed on nodes about a second
apart, whose speed is that of the chord between them, asked for at every third of these and beside each end of a gap,
and carried to the nodes of the drive along the path of the bounded chain in its elastic form, which also leaves out
fixes that nothing explains.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from halfwidth.bound import bound
from halfwidth.errors import Unsolved
from halfwidth.noise import Uniform
from halfwidth.record import Record
from halfwidth.result import Status
from halfwidth.vehicle import bounded
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path
from halfwidth.vehicle.pointing import with_speed

Floats = NDArray[np.float64]

#: Inflations that are tried, the least first.
INFLATIONS: tuple[float, ...] = (1.05, 1.2, 1.5, 2.0, 3.0)

#: Share of hidden fixes that must lie in the tube, and the standard deviations that a Gaussian interval of as much has.
SHARE, _DEVIATIONS = 0.9, 1.645

#: Stretches that are hidden to find the inflation: how many at most, how long, and fixes left around each, s.
_STRETCHES, _HIDDEN, _CONTEXT = 8, 15.0, 20.0

#: Share of the worst rows whose mean counts where fixes are screened.
_ELASTIC = 0.1

#: Nodes with a fix that count on each side of a node; of nodes every so many is asked for.
_NEAR, _EVERY = 20, 3

#: Programs that learn again where sensors are hidden, from azimuths between those on both sides.
_AFRESH = 2

#: Times that a tube without any path is inflated further, and by how much.
_FURTHER, _MORE = 3, 1.5


@dataclass(frozen=True)
class Tube:
    """Settings of the tube.

    Parameters
    ----------
    inflation : float
        Factor on the learnt half-widths.
    step : float
        Seconds between the nodes of the tube, about.
    base : Bounded
        How half-widths are learnt; without an offset of the fixes.
    """

    inflation: float = 1.2
    step: float = 1.0
    base: bounded.Bounded = field(default_factory=lambda: bounded.Bounded(slow=False))


def solve(drives: Sequence[Grid], settings: Tube = Tube()) -> list[Path]:
    """Return the centre of the tube for each drive.

    Parameters
    ----------
    drives : sequence of Grid
        Each with at least two nodes and one fix.
    settings : Tube

    Returns
    -------
    list of Path
        Its variance is that of which a Gaussian interval of 90 % has the half-width of the tube. ``info`` has the
        learnt ``half_widths`` of a step of the tube, and the ``inflation`` they were taken with. Where no tube is
        found the path is that of the bounded chain, without a variance, and ``notes`` says so.
    """
    return [_solved(with_speed(drive), settings) for drive in drives]


def again(
    drives: Sequence[Grid], paths: Sequence[Path], settings: Tube = Tube(), *, afresh: bool = False
) -> list[Path]:
    """Return the centre of the tube for drives of which fixes were hidden, with what was learnt with all fixes.

    The half-widths, the azimuths to linearise about and, within each step of the tube, the shape of the path are those
    of the paths given, and so is the tube itself where fixes are left; elsewhere its nodes are new.

    Parameters
    ----------
    drives : sequence of Grid
    paths : sequence of Path
        What `solve` found for each with all fixes.
    settings : Tube
    afresh : bool
        Whether the half-widths, and shape and azimuths between the fixes that are left, are learnt again without the
        others: where sensors are hidden as well, the path given would tell what they said.

    Returns
    -------
    list of Path
    """
    both = zip(drives, paths, strict=True)
    return [_again(with_speed(drive), path, settings, afresh) for drive, path in both]


def _again(drive: Grid, path: Path, settings: Tube, afresh: bool) -> Path:
    if "inflation" not in path.info or path.variance is None:
        return _solved(drive, settings)
    left_out = path.info.get("left_out", ())
    kept = _apart(drive.masked(np.isin(drive.t, [t for t, _ in left_out])), settings.step)
    rough = _coarse(drive, kept)
    fine = path
    if afresh:
        start = np.interp(rough.t, rough.t[rough.seen], path.azimuth[kept][rough.seen])
        found = bounded.solve([rough], replace(settings.base, rounds=_AFRESH), azimuth=[start])[0]
        if found.status is Status.STALLED or "half_widths" not in found.info:
            return _solved(drive, settings)
        names = ("east", "north", "azimuth", "speed")
        own = {name: np.interp(drive.t, rough.t, getattr(found, name)) for name in names}
        fine = replace(path, **{name: np.where(drive.seen, getattr(path, name), own[name]) for name in names})
    else:
        found = replace(path, azimuth=path.azimuth[kept], info={**path.info, "left_out": left_out})
    half = _DEVIATIONS * np.sqrt(path.variance[kept])
    return _centred(drive, fine, rough, kept, found, replace(settings, inflation=path.info["inflation"]), half)


def inflation_of(drive: Grid, settings: Tube = Tube()) -> float:
    """Return the least inflation with which the tube holds nine of ten hidden fixes of a drive; the largest if none.

    Parameters
    ----------
    drive : Grid
    settings : Tube

    Returns
    -------
    float
    """
    cases = []
    if not drive.seen.any():
        return settings.inflation
    drive = _screened(with_speed(drive), settings)[1]
    for whole, hidden, _ in bounded.stretches(drive, _HIDDEN, _STRETCHES, _CONTEXT):
        kept = _apart(hidden, settings.step)
        rough = _coarse(hidden, kept)
        found = bounded.solve([rough], settings.base)[0]
        out = whole.seen[kept] & ~rough.seen
        if out.any() and "half_widths" in found.info and found.finite:
            cases.append((rough, found, np.column_stack((whole.east, whole.north))[kept], out))
    for inflation in INFLATIONS if cases else ():
        tried = replace(settings, inflation=inflation)
        held = [
            _held(*_band(rough, found, tried, np.zeros(fixes.shape)), found, fixes)[out]
            for rough, found, fixes, out in cases
        ]
        if np.mean(np.concatenate(held)) >= SHARE:
            return inflation
    return INFLATIONS[-1] if cases else settings.inflation


def _screened(drive: Grid, settings: Tube) -> tuple[Path, Grid]:
    """Return the path of the elastic program, and the drive without the fixes that it cannot explain.

    One wrong fix would set the half-width of all.
    """
    path = bounded.solve([drive], replace(settings.base, nu=_ELASTIC))[0]
    return path, drive.masked(np.isin(drive.t, [t for t, _ in path.info.get("left_out", ())]))


def _held(band: tuple[Floats, Floats] | None, inflation: float, found: Path, fixes: Floats) -> NDArray[np.bool_]:
    """Return which fixes lie in the tube, (n, 2); none where there is no tube."""
    if band is None:
        return np.zeros(fixes.shape, dtype=bool)
    return np.asarray(np.abs(band[0] - fixes) <= band[1] + inflation * float(found.info["half_widths"]["fix"]))


def _solved(drive: Grid, settings: Tube) -> Path:
    fine, drive = _screened(drive, settings)
    kept = _apart(drive, settings.step)
    rough = _coarse(drive, kept)
    found = bounded.solve([rough], settings.base)[0]
    if found.status is Status.STALLED or fine.status is Status.STALLED or "half_widths" not in found.info:
        return fine
    return _centred(drive, fine, rough, kept, found, settings)


def _centred(
    drive: Grid,
    fine: Path,
    rough: Grid,
    kept: NDArray[np.intp],
    found: Path,
    settings: Tube,
    known: Floats | None = None,
) -> Path:
    """Return a fine path moved to the centre of the tube of half-widths that were found on some of its nodes.

    Where fixes are `known` (n, 2) is half of the tube there, and the path its centre, if given.
    """
    half_widths = found.info["half_widths"]
    ahead = np.column_stack((fine.east, fine.north))
    band, inflation = _band(rough, replace(found, east=ahead[kept, 0], north=ahead[kept, 1]), settings, known)
    info = {**found.info, "notes": list(fine.info.get("notes", ())), "inflation": inflation}
    info["left_out"] = tuple(dict.fromkeys((*fine.info.get("left_out", ()), *found.info.get("left_out", ()))))
    if band is None:
        words = "no path fits the learnt half-widths, inflated: the path of the bounded chain"
        return replace(fine, status=Status.REDUCED, info={**info, "notes": [*info["notes"], words]})
    centre, half = band
    # the fine path moved by what the tube's centre is off it at the nodes of the tube
    t, at = drive.t, rough.t
    moved = [ahead[:, j] + np.interp(t, at, centre[:, j] - ahead[kept, j]) for j in (0, 1)]
    spread = np.column_stack([np.interp(t, at, half[:, j]) for j in (0, 1)])
    words = (
        f"the band is a tube of half-widths learnt from the log and inflated {inflation:.3g} times:"
        " sized by hidden fixes, not guaranteed"
    )
    info["notes"] = [*info["notes"], words]
    variance = (spread / _DEVIATIONS) ** 2
    fix = float(half_widths["fix"]) * inflation / np.sqrt(3.0)
    return replace(fine, east=moved[0], north=moved[1], variance=variance, fix_variance=fix**2, info=info)


def _band(
    rough: Grid, found: Path, settings: Tube, known: Floats | None = None
) -> tuple[tuple[Floats, Floats] | None, float]:
    """Return centre and half-width (n, 2) of the tube, east and north, and the inflation that it took.

    `found` is a path on the nodes of the tube; where fixes are it is the centre and `known` the half-width, if given.
    """
    half_widths, inflation = found.info["half_widths"], settings.inflation
    model, u, turn = bounded.linearised(rough, found.azimuth, settings.base)
    y = np.column_stack((rough.east, rough.north))
    origin = y[int(np.argmax(rough.seen))].copy()
    y = y - origin
    place = np.column_stack((found.east, found.north)) - origin
    y[~rough.seen | np.isin(rough.t, [t for t, _ in found.info.get("left_out", ())])] = np.nan
    assert isinstance(model.w, Uniform)
    most = model.w.at_most.tolist()
    step = np.array([half_widths.get(name, cap) for name, cap in zip(model.names.x, most, strict=True)])
    grows = np.array([name in half_widths for name in model.names.x])
    asked = _asked(rough, fixes=known is None)
    told = np.isin(np.arange(len(rough)), asked)
    if known is not None:
        told |= ~_in_gaps(rough)
    both, axes = np.repeat(asked, 2), np.zeros((2 * asked.size, model.nx))
    axes[:, :2] = turn[asked].reshape(-1, 2)
    for _ in range(_FURTHER):
        w = Uniform(step * np.where(grows, inflation, 1.0))
        e = Uniform(np.full(2, half_widths["fix"] * inflation))
        try:
            box = bound(replace(model, w=w, e=e), Record(rough.t, y, u), axes, at=both, reach=_NEAR)
        except Unsolved:  # no path fits
            inflation *= _MORE
            continue
        lo, hi = (np.reshape(side, (-1, 2)) for side in (box.lo, box.hi))
        if not (np.isfinite(lo).all() and np.isfinite(hi).all()):
            break
        centre, half = 0.5 * (lo + hi), 0.5 * (hi - lo)
        off, wide = np.zeros(place.shape), np.zeros(place.shape) if known is None else known.copy()
        off[asked], wide[asked] = centre - place[asked], half
        # what is not asked for moves with the path of the chain, and is about as uncertain as its neighbours
        off, wide = (
            np.column_stack([np.interp(rough.t, rough.t[told], one[told, j]) for j in (0, 1)]) for one in (off, wide)
        )
        return (place + off + origin, wide), inflation
    return None, inflation


def _in_gaps(rough: Grid) -> NDArray[np.bool_]:
    """Return the nodes without a fix, and the fixes beside them."""
    lone = np.concatenate(([False], ~rough.seen, [False]))
    return lone[:-2] | lone[1:-1] | lone[2:]


def _asked(rough: Grid, *, fixes: bool) -> NDArray[np.intp]:
    """Return the nodes that are asked for: some of those in gaps and all at their ends; with `fixes`, of the others."""
    gaps = _in_gaps(rough)
    edge = np.concatenate(([False], gaps, [False]))
    inner = edge[:-2] & edge[1:-1] & edge[2:]
    beside = np.concatenate(([False], inner, [False]))
    # the first and last nodes of a gap, the ones next to them, and every so many between
    wanted = gaps & ~(beside[:-2] & beside[1:-1] & beside[2:])
    some = np.arange(len(rough)) % _EVERY == 0
    wanted |= some & gaps
    if fixes:
        wanted |= some
        wanted[-1] = True
    return np.flatnonzero(wanted)


def _apart(drive: Grid, step: float) -> NDArray[np.intp]:
    """Return nodes at least a step apart, and among them both ends of the drive and of each gap between fixes."""
    t, seen = drive.t, drive.seen
    lone = np.concatenate(([False], seen[1:-1] & ~(seen[:-2] & seen[2:]), [False]))
    lone[[0, -1]] = True
    kept = [0]
    for k in range(1, t.size):
        if lone[k] or t[k] - t[kept[-1]] >= step * (1 - 1e-6):
            kept.append(k)
    return np.array(kept)


def _coarse(drive: Grid, kept: NDArray[np.intp]) -> Grid:
    """Return a drive on some of its nodes: each step has the speed along its chord and the mean yaw rate."""
    turned = np.concatenate(([0.0], np.cumsum(-(drive.yaw_rate * drive.h)[1:])))
    middle = turned.copy()
    middle[1:] = 0.5 * (turned[1:] + turned[:-1])
    way = drive.speed * drive.h
    place = np.concatenate(([0.0], np.cumsum((way * np.exp(1j * middle))[1:])))
    gone = np.concatenate(([0.0], np.cumsum(way[1:])))
    h = np.diff(drive.t[kept])
    chord = np.copysign(np.abs(np.diff(place[kept])), np.diff(gone[kept])) / h
    rate = -np.diff(turned[kept]) / h
    columns = {name: getattr(drive, name)[kept] for name in ("t", "east", "north", "seen", "course")}
    # silence lasts: what is the worst of the steps is that of the whole
    for name in ("speed_sd", "yaw_rate_sd"):
        worst = np.maximum.reduceat(getattr(drive, name), kept[:-1] + 1)
        columns[name] = np.concatenate((worst[:1], worst))
    columns |= {"speed": np.concatenate((chord[:1], chord)), "yaw_rate": np.concatenate((rate[:1], rate))}
    return replace(drive, second=None, height=None, **columns)
