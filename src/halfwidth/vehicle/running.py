"""Run an estimator on the pieces of a drive, keep what it learnt, and put a simpler one in its place where it fails."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadLog
from halfwidth.vehicle import chain
from halfwidth.vehicle.estimators import COLOURS, METHODS, Method, usable
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path, sized
from halfwidth.vehicle.slow import Slow, slow_error

Floats = NDArray[np.float64]

#: Fixes that a method with a model of motion needs.
FEWEST = 5

#: Times that fixes are screened for strays at most.
_SCREENINGS = 3

#: The chain that screens fixes: one whose fixes neither drift nor jump, so that it does not follow strays.
_STIFF = chain.Chain(rounds=8, tail=np.inf, drifting=False)

#: Rounds in which the chain is solved again with hidden fixes, its scales kept: from the azimuths found with all fixes
#: or, where a gap has no yaw rate or speed to find them by, from what is known without the hidden ones.
_AGAIN, _AFRESH = 2, 10

#: Names of what the chain finds, as the settings of a track have them.
_WORDS = {"speed_scale": "speed scale", "yaw_bias": "yaw bias", "slow_sd": "slow error of the fixes"}

#: Fills drives of which fixes were hidden; the numbers say which grid each comes from, the last argument whether the
#: azimuths that were found with all fixes may be used.
Rerun = Callable[[Sequence[int], Sequence[Grid], bool], list[Path]]


def ran(
    chosen: Method, grids: list[Grid], able: Sequence[int], messages: list[str] | None
) -> tuple[dict[int, Path], Rerun, dict[str, object], Slow | None]:
    """Run a method on the pieces that have enough fixes."""
    if chosen.name in COLOURS:
        return _chain(chosen, grids, able, messages)
    return *_plain(chosen, grids, able), None


def _chain(
    chosen: Method, grids: list[Grid], able: Sequence[int], messages: list[str] | None
) -> tuple[dict[int, Path], Rerun, dict[str, object], Slow | None]:
    """Solve the chain without the fixes that it cannot believe; where `messages` is None they are gone already."""
    colour = COLOURS[chosen.name]
    stray: list[float] = []
    todo = list(able) if messages is not None else []
    messages = [] if messages is None else messages
    stiff: dict[int, chain.Fit] = {}
    for _ in range(_SCREENINGS):
        stiff.update(zip(todo, chain.solve([grids[i] for i in todo], _STIFF), strict=True))
        hidden = {i: _stray(stiff[i].path, grids[i]) for i in todo}
        todo = [i for i in todo if hidden[i].any()]
        for i in todo:
            stray += grids[i].t[hidden[i]].tolist()
            grids[i] = grids[i].masked(hidden[i])
    fits = dict(zip(able, chain.solve([grids[i] for i in able], colour), strict=True))
    if stray:
        times = sorted(set(stray))
        words = ", ".join(f"{t:.1f}" for t in times[:5]) + (" ..." if len(times) > 5 else "")
        some = "1 fix is" if len(times) == 1 else f"{len(times)} fixes are"
        messages.append(f"{some} far from where the vehicle can have been and left out: t = {words} s")

    def rerun(which: Sequence[int], hidden: Sequence[Grid], afresh: bool) -> list[Path]:
        return [
            fit.path
            for fit in chain.solve(
                hidden,
                replace(colour, rounds=_AFRESH if afresh else _AGAIN),
                sigma=np.array([fits[i].sigma for i in which]),
                azimuth=None if afresh else [fits[i].z[:, chain.AZIMUTH] for i in which],
                weight=None if afresh else [fits[i].weight for i in which],
                learn=False,
            )
        ]

    settings: dict[str, object] = {}
    if fits:
        weight = [len(grids[i]) for i in fits]
        sigma = np.sqrt(np.average([fit.sigma**2 for fit in fits.values()], axis=0, weights=weight))
        settings.update(
            {f"{name} noise": float(f"{value:.3g}") for name, value in zip(chain.GROUPS, sigma, strict=True)}
        )
        for name in ("speed_scale", "yaw_bias"):
            value = np.average([fit.path.info[name] for fit in fits.values()], weights=weight)
            settings[_WORDS[name]] = float(f"{value:.4g}")
    slow = None
    if stiff and colour.slow:
        slow = slow_error([grids[i] for i in fits], [stiff[i] for i in fits], list(fits.values()))
    if slow is not None:
        settings[_WORDS["slow_sd"]] = float(f"{slow.sd:.3g}")
        messages.append(_slow_words(slow))
    return {i: fit.path for i, fit in fits.items()}, rerun, settings, slow


def _slow_words(slow: Slow) -> str:
    """Say what the half-widths are about, and how far off that the truth may be."""
    promise = "the half-widths hold where the receiver would have seen the vehicle, not where it was"
    if not slow.seen:
        return f"{promise}; no error of the fixes that lasts for minutes shows in the drive"
    return (
        f"{promise}: the fixes are wrong by {slow.sd:.2g} m for minutes at a time (1 sigma, as they and the sensors"
        " disagree), which hiding fixes cannot show; `truth_half_m` of the track has it"
    )


def _stray(path: Path, grid: Grid) -> NDArray[np.bool_]:
    """Return the nodes whose fix is far off the path, (T,): one multipath fix must not set the noise of the drive.

    Far is beyond 8 times the median distance, 5 standard deviations of a fix and 3 m. Where more than a tenth of the
    fixes would go it is the path that is wrong, and none goes.
    """
    off = np.hypot(path.east - grid.east, path.north - grid.north)
    far = grid.seen & ~(off <= max(8 * float(np.median(off[grid.seen])), 5 * path.fix_variance**0.5, 3.0))
    return far if path.finite and far.sum() <= 0.1 * grid.seen.sum() else np.zeros(len(grid), dtype=bool)


def _plain(
    chosen: Method, grids: Sequence[Grid], able: Sequence[int]
) -> tuple[dict[int, Path], Rerun, dict[str, object]]:
    """Run a method that learns from the longest piece, and from each piece with all its fixes what it keeps of it."""
    tuned = chosen.tune(grids[max(able, key=lambda i: len(grids[i]))]) if able else {}

    whole: dict[int, Path] = {}

    def rerun(which: Sequence[int], hidden: Sequence[Grid], afresh: bool) -> list[Path]:
        kept = chosen.afresh if afresh else chosen.again
        if kept is None or not whole:
            paths = chosen.run(hidden, tuned)
        else:
            paths = kept(hidden, [whole[i] for i in which], tuned)
        return [sized(path, grid) for path, grid in zip(paths, hidden, strict=True)]

    whole.update(zip(able, rerun(able, [grids[i] for i in able], True), strict=True))
    settings: dict[str, object] = {f"{words(name)} noise": float(f"{value:.3g}") for name, value in tuned.items()}
    return whole, rerun, settings


def spare(grid: Grid, chosen: Method) -> Path:
    """Estimate a piece on which the chosen method failed."""
    if chosen.name not in ("cv", "linear") and int(grid.seen.sum()) >= FEWEST:
        cv = METHODS["cv"]
        path = cv.run([grid], cv.tune(grid))[0]
        if plausible(path, grid):
            return path
    if grid.seen.any():
        return METHODS["linear"].run([grid], {})[0]
    raise BadLog("a part of the log has no fix, at least one position is expected")


def plausible(path: Path, grid: Grid) -> bool:
    """Whether a path can be shown: it has numbers, keeps near the fixes and does not stray between them.

    The nodes must stay within what a vehicle can reach from the straight line between two fixes: half of the distance
    that the top speed would take in the pause, and some metres.
    """
    if not usable(path):
        return False
    seen = np.flatnonzero(grid.seen)
    t, fixes = grid.t, grid.t[seen]
    off = np.hypot(*(p - np.interp(t, fixes, q[seen]) for p, q in ((path.east, grid.east), (path.north, grid.north))))
    after = np.minimum(np.searchsorted(fixes, t), fixes.size - 1)
    before = np.maximum(np.searchsorted(fixes, t, side="right") - 1, 0)
    near = np.where(
        (t < fixes[0]) | (t > fixes[-1]),
        np.abs(t - fixes[before]) + np.abs(t - fixes[after]),
        fixes[after] - fixes[before],
    )
    reach = top_speed(grid) * near
    spread = np.median(off[seen])
    return bool(np.all(off <= 20.0 + 10.0 * spread + reach))


def top_speed(grid: Grid) -> float:
    """Return a speed that the vehicle of this log surely did not exceed by much, m/s."""
    seen = np.flatnonzero(grid.seen)
    fastest = float(np.abs(grid.speed).max()) if grid.has_speed else 0.0
    if seen.size > 1:
        step = np.maximum(np.diff(grid.t[seen]), 1.0)
        moved = np.hypot(np.diff(grid.east[seen]), np.diff(grid.north[seen]))
        fastest = max(fastest, float(np.quantile(moved / step, 0.99)))
    return max(1.5 * fastest, 10.0)


def words(name: str) -> str:
    """Return a name as it stands in a sentence."""
    return name.replace("_", " ")
