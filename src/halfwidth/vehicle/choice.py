"""Choose how each stretch of a drive is filled, by hiding fixes of the drive itself."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import calibrate, widening
from halfwidth.vehicle.estimators import METHODS, Method
from halfwidth.vehicle.frames import wrapped
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path
from halfwidth.vehicle.pieces import Piece, Span
from halfwidth.vehicle.running import FEWEST, Rerun, plausible, ran, spare, words
from halfwidth.vehicle.slow import Slow

Floats = NDArray[np.float64]

#: Another way than the chain fills gaps if its error times its half-width is below this share of the chain's: the
#: nearer path with the narrower interval that holds, as a single one of them may be luck.
_BETTER = 0.8

#: Shares of two paths that are tried where what the vehicle did is guessed, and for how many hidden stretches it counts
#: that both are worth the same.
_SHARES, _EVEN = np.linspace(0.0, 1.0, 21), 4.0


@dataclass(frozen=True, eq=False)
class Bridge:
    """How one stretch is filled, and what hiding fixes showed of it."""

    span: Span
    by: str
    tested: Sequence[widening.Tested]
    least: float
    share: float = 1.0  # of the other way, where it is not the usual one


@dataclass(frozen=True, eq=False)
class _Rival:
    """Another way to fill: its paths by piece, and how to run it again."""

    paths: Mapping[int, Path]
    rerun: Rerun


@dataclass(frozen=True, eq=False)
class Answers:
    """Paths of the pieces, what hiding fixes showed, and what was found on the way."""

    paths: list[Path]
    bridges: list[Bridge]
    settings: dict[str, object]
    slow: Slow | None

    @property
    def tested(self) -> list[widening.Tested]:
        """All tests that a half-width rests on."""
        return list(dict.fromkeys(one for bridge in self.bridges for one in bridge.tested))


def estimated(
    pieces: Sequence[Piece],
    chosen: Method,
    spans: Sequence[Span],
    level: float,
    messages: list[str],
    *,
    free: bool,
) -> Answers:
    """Estimate every piece, with simpler methods where the chosen one fails, and test the intervals."""
    grids = [piece.grid for piece in pieces]  # of which the chain takes away the fixes it cannot believe
    able = [i for i, grid in enumerate(grids) if chosen.name == "linear" or int(grid.seen.sum()) >= FEWEST]
    found, rerun, settings, slow = ran(chosen, grids, able, messages)
    messages.extend(dict.fromkeys(note for path in found.values() for note in path.info.get("notes", ())))
    failed = [i for i in range(len(grids)) if i not in found or not plausible(found[i], grids[i])]
    if failed and chosen.name != "linear":
        messages.append(_failed_words(chosen, [pieces[i] for i in failed], len(pieces)))
    paths = [spare(grid, chosen) if i in failed else found[i] for i, grid in enumerate(grids)]
    good = [i for i in range(len(grids)) if i not in failed]
    sensed = all(grid.has_speed and grid.has_yaw_rate for grid in grids)
    # where sensors are lacking the chain guesses what they would have said, constant velocity guesses otherwise, and
    # the mean of both is nearer than either; where they speak, fixes may be wrong by white noise and nothing else
    rivals: dict[str, _Rival] = {}
    if free and chosen.name == "em" and good:
        blind = any(span.silent or not sensed for span in spans)
        names = [
            *(["em-white"] if any(not span.silent for span in spans) and sensed else []),
            *(["cv"] if blind else []),
        ]
        for name in names:
            own, again, _, _ = ran(METHODS[name], grids, good, None)
            if all(plausible(path, grids[i]) for i, path in own.items()):
                rivals[name] = _Rival(own, again)
    bridges: list[Bridge] = []
    for silent, part in sorted({(span.silent, span.part) for span in spans}):
        alike = [span for span in spans if (span.silent, span.part) == (silent, part)]
        guessed = bool(silent) or not sensed
        against = {name: one for name, one in rivals.items() if (name == "cv") == guessed}

        shares: dict[float, float] = {}

        def filled(
            which: Sequence[int],
            hidden: Sequence[Grid],
            guessed: bool = guessed,
            against: Mapping[str, _Rival] = against,
            shares: dict[float, float] = shares,
        ) -> dict[str, list[Path]]:
            own = [good[k] for k in which]
            first = rerun(own, hidden, guessed)
            ways = {chosen.name: first}
            for name, rival in against.items():
                both = list(zip(first, rival.rerun(own, hidden, guessed), hidden, strict=True))
                ways[name] = [_bridged(a, b, grid, _even(_pauses(grid), 1.0), guessed) for a, b, grid in both]
                if guessed:
                    length, share = _share(first, ways[name], [grids[i] for i in own], hidden)
                    shares[length] = share
                    ways[_mixed(chosen.name, name)] = [
                        _bridged(a, b, grid, _even(_pauses(grid), share), guessed) for a, b, grid in both
                    ]
            return ways

        tests: dict[str, list[widening.Tested]] = {}
        if good:
            whole = [grids[i] for i in good]
            lengths = calibrate.lengths_to_test(whole, np.array([span.length for span in alike]))
            z = NormalDist().inv_cdf(0.5 + level / 2)
            tests = calibrate.tested(whole, filled, lengths, level, z, silent, guessed=guessed, part=part)
        fixes = [grid.t[grid.seen] for grid in grids if grid.seen.any()]
        first_fix, last_fix = min(t[0] for t in fixes), max(t[-1] for t in fixes)
        inner = [s for s in alike if s.start >= first_fix - 1e-6 and s.stop <= last_fix + 1e-6]
        outer = [span for span in alike if span not in inner]
        ends = _end_tests(chosen.name, [grids[i] for i in good], good, rerun, outer, level)
        mine = []
        for span in inner:
            by, share = nearest(tests, chosen.name, span.length), 1.0
            if guessed and against:
                by, share = _mixed(chosen.name, *against), _interpolated(shares, span.length)
            by = by if by in tests else chosen.name
            mine.append(Bridge(span, by, tuple(tests.get(by, [])), 0.0, share))
        for span in outer:
            # without a test of its own, an end is at least as uncertain as a model says
            own_test = ends or tests.get(chosen.name, [])
            mine.append(Bridge(span, chosen.name, tuple(own_test), 0.0 if ends else 1.0))
        bridges += mine
        messages.extend(_choice_words(tests, mine, shares))
        messages.extend(_test_words(mine, level, chosen.name))
    for name, rival in rivals.items():
        both = (name, _mixed(chosen.name, name))
        taken = [(bridge.span.start, bridge.span.stop, bridge.share) for bridge in bridges if bridge.by in both]
        for i, path in rival.paths.items():
            paths[i] = _bridged(paths[i], path, grids[i], taken, name == "cv")
    answers = Answers(paths, bridges, settings, slow)
    settings.update(
        {
            f"inflation at {one.length_s:.3g} s{_beyond(one)}{_without(one)}{_by(one.by, chosen.name)}": round(
                one.inflation, 3
            )
            for one in answers.tested
        }
    )
    return answers


def _end_tests(
    name: str, grids: Sequence[Grid], good: Sequence[int], rerun: Rerun, spans: Sequence[Span], level: float
) -> list[widening.Tested]:
    """Test half-widths beyond the first and the last fix of a log."""
    if not spans or not good:
        return []
    lengths = calibrate.lengths_to_test(grids, np.array([span.length for span in spans]))
    z = NormalDist().inv_cdf(0.5 + level / 2)
    return calibrate.tested_ends(
        grids,
        lambda which, hidden: rerun([good[k] for k in which], hidden, True),
        lengths,
        level,
        z,
        spans[0].silent,
        by=name,
    )


def _mixed(name: str, other: str) -> str:
    """Return the name of the mean of two ways."""
    return f"{name} and {other}"


def _even(spans: Sequence[tuple[float, float]], share: float) -> list[tuple[float, float, float]]:
    return [(start, stop, share) for start, stop in spans]


def _share(
    first: Sequence[Path], second: Sequence[Path], drives: Sequence[Grid], hidden: Sequence[Grid]
) -> tuple[float, float]:
    """Return how long hidden stretches are, and the share of a second path that comes nearest to what was hidden.

    The mean error of each share, over that of the best one, counts for as many stretches as there are; half of each is
    the guess beforehand.
    """
    offs, lengths = [], []
    for a, b, drive, left in zip(first, second, drives, hidden, strict=True):
        out = drive.seen & ~left.seen
        fixes = np.column_stack((drive.east, drive.north))[out]
        offs.append([np.column_stack((path.east, path.north))[out] - fixes for path in (a, b)])
        known = set(_pauses(drive))
        lengths += [stop - start for start, stop in _pauses(left) if (start, stop) not in known]
    own, other = (np.concatenate([off[k] for off in offs]) for k in (0, 1))
    errors = np.array([np.hypot(*((1 - share) * own + share * other).T).mean() for share in _SHARES])
    worth = len(lengths) * errors / max(float(errors.min()), 1e-12) + _EVEN * (_SHARES - 0.5) ** 2
    worth = np.where(np.isfinite(worth), worth, np.inf)
    return float(np.median(lengths)), float(_SHARES[int(np.argmin(worth))])


def _interpolated(shares: Mapping[float, float], length: float) -> float:
    """Return the share of the other way in a gap of some length."""
    lengths = sorted(shares)
    return float(np.interp(np.log(length), np.log(lengths), [shares[one] for one in lengths])) if lengths else 0.0


def nearest(tests: Mapping[str, Sequence[widening.Tested]], usual: str, length: float) -> str:
    """Return which way came nearest to hidden fixes, and was surest, where the sensors speak.

    Another way than the usual one has to be clearly better in stretches about as long as this, and in those of all
    lengths together: what fixes are wrong by is the same in all, and a few long ones are soon luck.
    """
    size = {name: {one.length_s: one.mean_m * one.half_m for one in row} for name, row in tests.items()}
    if usual not in size:
        return min(size, key=lambda name: min(size[name].values()), default=usual)

    def share(name: str) -> float:
        common = [(at, own / max(size[usual][at], 1e-12)) for at, own in size[name].items() if at in size[usual]]
        if not common:
            return np.inf
        near = min(common, key=lambda one: abs(np.log(one[0] / max(length, 1e-3))))[1]
        return max(near, float(np.exp(np.mean(np.log([max(r, 1e-12) for _, r in common])))))

    best = min((name for name in size if name != usual), key=share, default=usual)
    return best if best != usual and share(best) < _BETTER else usual


def _pauses(grid: Grid) -> list[tuple[float, float]]:
    """Return the stretches of a grid between fixes that are not neighbours."""
    seen = np.flatnonzero(grid.seen)
    apart = np.flatnonzero(np.diff(seen) > 1)
    return [(float(grid.t[seen[k]]), float(grid.t[seen[k + 1]])) for k in apart]


def _bridged(path: Path, other: Path, grid: Grid, spans: Sequence[tuple[float, float, float]], guessed: bool) -> Path:
    """Take a share of another path between the fixes on both sides of some stretches, where it is shifted to meet this.

    Each stretch is its beginning, its end and the share. Errors of the two may be alike, so deviations are averaged.
    Where what the vehicle did is `guessed` the other path is taken from the first to the last node at which a sensor is
    silent: up to there this one is carried by the sensors.
    """
    seen = np.flatnonzero(grid.seen)
    t = grid.t[seen]
    silent = np.flatnonzero(_silent(grid)) if guessed else np.arange(len(grid))
    columns: dict[str, Any] = {name: np.array(getattr(path, name)) for name in ("east", "north", "azimuth", "speed")}
    if path.variance is None or other.variance is None:
        return path
    variance = path.variance.copy()
    for start, stop, part in spans:
        left = int(np.searchsorted(t, start + 1e-6, side="right")) - 1
        right = int(np.searchsorted(t, stop - 1e-6))
        if left < 0 or right >= seen.size or seen[right] - seen[left] < 2:
            continue
        lost = silent[(silent > seen[left]) & (silent <= seen[right])]
        if not lost.size:
            continue
        # between fixes all of it; elsewhere the first and the last of the steps are silent only in part
        a = seen[left] if lost[0] == seen[left] + 1 else lost[0]
        b = seen[right] if lost[-1] == seen[right] else lost[-1] - 1
        if b - a < 2:
            continue
        inside = slice(a + 1, b)
        share = (grid.t[inside] - grid.t[a]) / (grid.t[b] - grid.t[a])

        def between(variance: Floats, share: Floats = share, a: int = a, b: int = b) -> Floats:
            return np.asarray(variance[a] + share[:, None] * (variance[b] - variance[a]))

        for name, own in columns.items():
            new = getattr(other, name)
            before, after = own[a] - new[a], own[b] - new[b]
            if name == "azimuth":
                before, after = float(wrapped(before)), float(wrapped(after))
            apart = new[inside] + (1 - share) * before + share * after - own[inside]
            own[inside] += part * (wrapped(apart) if name == "azimuth" else apart)
        if guessed:  # what the other is less sure of between its ends, on top of what this one is not sure of there
            more = np.maximum(other.variance[inside] - between(other.variance), 0.0)
            wide = between(path.variance) + more
        else:  # a path says by itself how far fixes lie about it; what is kept is the sum
            wide = np.maximum(other.variance[inside] + other.fix_variance - path.fix_variance, 0.0)
        variance[inside] = ((1 - part) * np.sqrt(variance[inside]) + part * np.sqrt(wide)) ** 2
    return replace(path, **columns, variance=variance)


def _silent(grid: Grid) -> NDArray[np.bool_]:
    """Return to which nodes the step lacks a sensor, (T,)."""
    lost = [
        getattr(grid, f"{name}_sd") > 0 if getattr(grid, f"has_{name}") else np.ones(len(grid), dtype=bool)
        for name in ("speed", "yaw_rate")
    ]
    return np.asarray(lost[0] | lost[1])


def _failed_words(chosen: Method, pieces: Sequence[Piece], n: int) -> str:
    spans = ", ".join(f"{piece.start:.0f} to {piece.stop:.0f} s" for piece in pieces[:3])
    more = f" and {len(pieces) - 3} more" if len(pieces) > 3 else ""
    return (
        f"`{chosen.name}` found no usable path in {len(pieces)} of {n} parts of the log ({spans}{more}):"
        " a simpler method filled them"
    )


def _choice_words(
    tests: Mapping[str, Sequence[widening.Tested]], bridges: Sequence[Bridge], shares: Mapping[float, float]
) -> list[str]:
    """Say how near each way came to hidden fixes, where there was a choice, and which was taken."""
    if len(tests) < 2:
        return []
    found = "; ".join(
        f"{row[0].length_s:.3g} s " + ", ".join(f"{one.by} {one.mean_m:.2f} m" for one in row)
        for row in zip(*tests.values(), strict=False)
    )
    taken = " and ".join(dict.fromkeys(bridge.by for bridge in bridges))
    parts = ", ".join(f"{100 * shares[length]:.0f} % at {length:.3g} s" for length in sorted(shares))
    of = f" ({parts} of the second)" if any(bridge.share < 1.0 for bridge in bridges) else ""
    return [f"chosen by hiding fixes{_without(bridges[0].span)}: {taken}{of}; mean errors {found}"]


def _test_words(bridges: Sequence[Bridge], level: float, usual: str) -> list[str]:
    """Say what hiding fixes showed about gaps of one kind."""
    found = []
    without = _without(bridges[0].span)
    groups: dict[object, list[Bridge]] = {}
    for bridge in bridges:
        groups.setdefault((bridge.by, bridge.tested), []).append(bridge)
    for mine in groups.values():
        by, tested, least = mine[0].by, mine[0].tested, min(bridge.least for bridge in mine)
        beyond = _beyond(tested[0]) if tested else ""
        if not tested:
            found.append(
                f"too few fixes to test the half-widths{without} on this log: they are the model's own,"
                f" widened {widening.UNTESTED:g} times"
            )
            continue
        words = "; ".join(
            f"{one.length_s:.3g} s: {100 * one.coverage:.0f} % of hidden fixes inside, {_change(one.inflation, least)}"
            for one in tested
        )
        which = f"{beyond}{without}{_by(by, usual)}"
        stretches = sum(one.stretches for one in tested)
        found.append(f"{100 * level:g} % intervals{which} tested on {stretches} hidden stretches: {words}")
        longest, most = tested[-1].length_s, max(bridge.span.length for bridge in mine)
        if most > 1.2 * longest:
            found.append(
                f"the longest gap{without} lasts {most:.0f} s but this log can test intervals only up to"
                f" {longest:.0f} s"
            )
    return found


def _change(inflation: float, least: float) -> str:
    factor = max(inflation, least, widening.LEAST)
    return f"widened {factor:.2f} times" if factor >= 1 else f"narrowed to {factor:.2f} times"


def _beyond(one: widening.Tested) -> str:
    return " beyond the fixes" if one.side == "one" else ""


def _without(one: Span | widening.Tested) -> str:
    """Say which sensors are silent, and where."""
    if not one.silent:
        return ""
    where = "" if one.part == (0.0, 1.0) else f" from {100 * one.part[0]:.0f} to {100 * one.part[1]:.0f} % of it"
    return f" without {' and '.join(words(name) for name in one.silent)}{where}"


def _by(name: str, usual: str) -> str:
    return f" bridged by {name}" if name != usual else ""
