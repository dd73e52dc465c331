"""Fixes that lie where the vehicle cannot have been: after a tunnel, before one, and wherever they jump.

A receiver that finds its satellites again may be off by tens of metres for many seconds, and a path that believes it is
bent all the way through the gap. Dead reckoning over a few seconds is far better than that. So wherever there is reason
to doubt (the first seconds after a gap, the last ones before it, and what follows a jump that the sensors did not see)
the doubtful fixes are hidden, and the chain, with the noise that the drive was found to have, says where they should
have been: after a gap from the fixes after them alone, before it from those before them, so that a gap badly bridged
proves nothing. What is further off than that can be wrong goes, up to the first fix that agrees again. If none agrees
the fixes are believed: then the reckoning is wrong, or they are all that is known. So they are where the sides of a
jump contradict each other by more than the fixes are off, and where a jump of the receiver's own slow error explains
the drive as well (a correction arrives, a satellite is lost): without them the path would be bent all the way through
the gap. An error that fades (reflections, until enough satellites are back)
never steps and is easily taken for a drift of the slow error: it is looked for by itself (`fade`). Of a fade the fixes
go that it moves by more than the receiver's own errors would in that time; from its tail what is left of it is taken
off, so that the other fixes stay.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import chain
from halfwidth.vehicle.answers import FEWEST_CONTROLS, Answer, apart_of, furthest, off_path, unusual, wrong_of
from halfwidth.vehicle.doubts import DOUBTED, Doubt, after_jumps, at_gaps, stretches
from halfwidth.vehicle.fade import JUDGE, Fade, fades, jumped, likely
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path
from halfwidth.vehicle.sensors import Calibration

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: What is around doubtful fixes for so long is asked where they should have been, s.
AROUND = 40.0

#: Doubts that are looked into at most, in one drive; how often, as what fades is seen bit by bit; rounds of the chain.
_MOST, _LOOKS, _ROUNDS = 150, 4, 5

#: Share of what is unusual that is enough for fixes that follow wrong ones: a fault that came fades.
_AGAIN = 0.5

#: Places where nobody doubts that show what is usual: about so many.
_CONTROLS = 20

#: Scale of what the calibration takes to be without noise.
_NO_NOISE = 1e-4

#: Fixes that follow wrong ones for so long, away from the gap, are what the other side of the gap is compared with, s.
_FOLLOW = 8.0

#: How much of the drive on each side of a gap tells wrong fixes from a jump, s; how far wrong fixes may be off, m, and
#: with how many numbers an axis; the logarithm of the odds against them: one gap in ten.
_SIDE, _WIDE, _SHAPE, _RARE = 60.0, 10.0, 3, 2.2

#: Errors that fade are looked for so long from a gap, s, and felt while they exceed the noise of a fix and this, m; of
#: what they begin with this share must not be left then, or it is the slow error that goes its way.
_FADING, _FELT_M, _OVER = 30.0, 0.05, 0.1

#: A gap that lacks a sensor for so long has no reckoning to see a fade by, s.
_SILENT = 1.0

#: Scale and bias are known to this many of their standard deviations, and no better than this.
_KNOWN, _SCALE, _BIAS = 3.0, 0.003, 0.001

#: Fixes that a doubt needs besides those it hides.
_FEWEST = 5


@dataclass(frozen=True, eq=False)
class Strays:
    """Which nodes of a grid have a fix that is not to be used.

    Parameters
    ----------
    at : (n,) int array
        Nodes.
    size : (n,) array
        How far each fix is off, m.
    tail : (m,) int array
        Nodes whose fix has the tail of an error that fades.
    moved : (m, 2) array
        By how much these are put right, m east and north.
    """

    at: NDArray[np.intp]
    size: Floats
    tail: NDArray[np.intp]
    moved: Floats

    def masked(self, grid: Grid) -> Grid:
        """Return the grid without these fixes, and with tails taken off."""
        if not self.at.size:
            return grid
        hidden = np.zeros(len(grid), dtype=bool)
        hidden[self.at] = True
        east, north = grid.east.copy(), grid.north.copy()
        east[self.tail] += self.moved[:, 0]
        north[self.tail] += self.moved[:, 1]
        return replace(grid, east=east, north=north).masked(hidden)

    def words(self, grid: Grid) -> str:
        """Say which fixes go, when they were and how far they are off; empty if none goes."""
        if not self.at.size:
            return ""
        run = np.concatenate(([0], np.cumsum(np.diff(self.at) > 1)))
        spans = []
        for k in range(int(run[-1]) + 1):
            t, size = grid.t[self.at[run == k]], self.size[run == k]
            when = f"{t[0]:.1f}" if t.size == 1 else f"{t[0]:.1f} to {t[-1]:.1f}"
            spans.append(f"{when} s by up to {size.max():.1f} m")
        more = f" and {len(spans) - 5} more" if len(spans) > 5 else ""
        some = "1 fix lies" if self.at.size == 1 else f"{self.at.size} fixes lie"
        tail = ""
        if self.tail.size:
            most = float(np.hypot(*self.moved.T).max())
            tail = f"; as the error fades, {self.tail.size} beside them are put right, by up to {most:.2g} m"
        return (
            f"{some} where the vehicle cannot have been and {'is' if self.at.size == 1 else 'are'} left out: "
            + ", ".join(spans[:5])
            + more
            + tail
        )


_NONE = Strays(np.empty(0, dtype=np.intp), np.empty(0), np.empty(0, dtype=np.intp), np.empty((0, 2)))


def strays(grid: Grid, sensors: Calibration) -> Strays:
    """Find fixes that dead reckoning from the fixes around them contradicts.

    Parameters
    ----------
    grid : Grid
        With the sensors put right.
    sensors : Calibration
        What is known of them.

    Returns
    -------
    Strays
        None where the drive has too few fixes, or no speed or yaw rate to reckon with.
    """
    if int(grid.seen.sum()) < 2 * _FEWEST or not (grid.has_speed and grid.has_yaw_rate and sensors.noise):
        return _NONE
    settings = chain.Chain(
        rounds=_ROUNDS,
        drifting=False,
        tail=np.inf,
        scale_sd=float(np.clip(_KNOWN * sensors.scale_sd, _SCALE, 0.03)),
        bias_sd=float(np.clip(_KNOWN * sensors.bias_sd, _BIAS, 0.01)),
    )
    noise = np.array([sensors.noise.get(name, _NO_NOISE) for name in chain.GROUPS])
    search = _Search(grid, np.flatnonzero(grid.seen), settings, noise)
    gaps, jumps = at_gaps(grid, search.seen), after_jumps(grid, search.seen)
    # what jumps away and back would hide the errors that fade
    search.look(jumps[:_MOST])
    doubts = [replace(doubt, first=first) for doubt in gaps[:_MOST] if (first := search.first(doubt)) is not None]
    search.fade(doubts)
    for k in range(_LOOKS):
        doubts = search.look(doubts, 1.0 if k == 0 else _AGAIN)
    # what a stray stretch begins or ends with is a jump, too
    near = np.convolve(search.gone[search.seen], np.ones(3), mode="same") > 0
    search.look([doubt for doubt in jumps if not near[doubt.first]][:_MOST])
    at = np.flatnonzero(search.gone)
    moved = np.column_stack((search.grid.east - grid.east, search.grid.north - grid.north))
    tail = np.flatnonzero(moved.any(axis=1) & grid.seen & ~search.gone)
    return Strays(at, search.size[at], tail, moved[tail]) if at.size <= 0.3 * search.seen.size else _NONE


@dataclass(frozen=True, eq=False)
class _Wrong:
    """Fixes that are wrong by what was said about one doubt."""

    clear: float  # how many standard deviations the furthest is off; of a fade, the logarithm of its odds
    nodes: NDArray[np.intp]
    distance: Floats


class _Search:
    """One drive, and what was found in it so far."""

    def __init__(self, grid: Grid, seen: NDArray[np.intp], settings: chain.Chain, noise: Floats) -> None:
        self.grid, self.seen, self.settings, self.noise = grid, seen, settings, noise
        self.size = np.zeros(len(grid))
        self.gone = np.zeros(len(grid), dtype=bool)
        self._asked: dict[tuple[bool, bool, float], Floats] = {}

    def look(self, doubts: Sequence[Doubt], share: float = 1.0) -> list[Doubt]:
        """Find which of the doubtful fixes are wrong; return the doubts that had some, moved on to the next fix.

        A share of what is unusual is enough after fixes that were wrong.
        """
        clearest = self._clearest(doubts, share)
        odds = self._odds(clearest)
        left = []
        for doubt in [doubt for doubt in clearest if odds[doubt] >= 0]:
            stray = clearest[doubt]
            self.size[stray.nodes], self.gone[stray.nodes] = stray.distance, True
            first = self.first(doubt)
            if first is not None:
                left.append(replace(doubt, first=first, known=True))
        return left

    def first(self, doubt: Doubt) -> int | None:
        """Return the first fix of a doubt that is not gone, the last one if it looks backwards; None if all are."""
        rest = np.flatnonzero(~self.gone[self.seen[doubt.block[0] : doubt.block[1]]]) + doubt.block[0]
        rest = rest[rest <= doubt.first] if doubt.backwards else rest[rest >= doubt.first]
        return int(rest[-1 if doubt.backwards else 0]) if rest.size else None

    def _clearest(self, doubts: Sequence[Doubt], share: float = 1.0) -> dict[Doubt, "_Wrong"]:
        """Find which of the doubtful fixes are further off than others are, at the length that says so the clearest."""
        clearest: dict[Doubt, _Wrong] = {}
        for answer in self._ask(doubts, DOUBTED):
            doubt, nodes = answer.doubt, answer.nodes
            if not wrong_of(answer, share).any():
                continue
            usual = self._usual(doubt, answer.length)
            wrong = wrong_of(answer, share * unusual(usual)) & ~self.gone[nodes]
            if wrong.any():
                distance, sd = answer.off[-1]
                clear = float((distance / sd)[wrong].max())
                if doubt not in clearest or clear > clearest[doubt].clear:
                    clearest[doubt] = _Wrong(clear, nodes[wrong], distance[wrong])
        return clearest

    def fade(self, doubts: Sequence[Doubt]) -> None:
        """Find errors that fade away from a gap, where one explains the drive better than a jump of the slow error.

        A wrong end of a gap makes the other end look wrong, too: the clearer one goes first, and the other is asked
        again without those fixes.
        """
        for _ in range(2):
            found = self._fading([d for d in doubts if self._beside(d).size >= _FEWEST and not self._silent(d)])
            clearest: dict[int, Doubt] = {}
            for doubt, (_, clear) in found.items():
                if doubt.gap not in clearest or clear > found[clearest[doubt.gap]][1]:
                    clearest[doubt.gap] = doubt
            for doubt in clearest.values():
                self._faded(doubt, found[doubt][0])
            doubts = [doubt for doubt in doubts if clearest.get(doubt.gap, doubt) != doubt]

    def _faded(self, doubt: Doubt, fade: Fade) -> None:
        """Leave out the fixes that a fade moves by more than the receiver's own errors would; take it off the others.

        What the slow error does in the time constant of the fade hides what is left of it.
        """
        nodes = self._beside(doubt)
        since = self._since(doubt, nodes)
        left = fade.left(since)
        own = np.hypot(self.noise[chain.FIX], self.noise[chain.OFFSET] * np.sqrt(fade.tau))
        large = left > max(float(own), _FELT_M)
        self.size[nodes[large]], self.gone[nodes[large]] = left[large], True
        self.grid = fade.removed(self.grid, nodes[~large], since[~large])

    def _since(self, doubt: Doubt, nodes: NDArray[np.intp]) -> Floats:
        """Return how many seconds from the gap nodes are."""
        return np.asarray(np.abs(self.grid.t[nodes] - self.grid.t[self.seen[doubt.first]]))

    def _fading(self, doubts: Sequence[Doubt]) -> dict[Doubt, tuple[Fade, float]]:
        """Find the doubts in which an error that fades explains some fixes best, and the logarithm of its odds.

        Where reckoning is so many times worse than the chain takes it to be, likelihoods say less by the square of it.
        """
        beside = [self._beside(doubt) for doubt in doubts]
        parts = [self._around(doubt, nodes) for doubt, nodes in zip(doubts, beside, strict=True)]
        since = [self._since(doubt, nodes) for doubt, nodes in zip(doubts, beside, strict=True)]
        found = fades(
            [self.grid.rows(part).masked(self.gone[part]) for part in parts],
            [nodes - part.start for nodes, part in zip(beside, parts, strict=True)],
            since,
        )
        felt = max(float(self.noise[chain.FIX]), _FELT_M)
        hope: dict[Doubt, tuple[Fade, _Wrong]] = {}
        for doubt, nodes, s, fade in zip(doubts, beside, since, found, strict=True):
            left = fade.left(s)
            odds = fade.gain - fade.worth - fade.rival - _RARE
            if odds > 0 and left.max() > felt and left.min() < max(_OVER * left.max(), felt):
                hope[doubt] = fade, _Wrong(odds, nodes[left > felt], left[left > felt])
        against = self._against(list(hope), [wrong.nodes for _, wrong in hope.values()])
        rival = self._odds(self._clearest(list(hope)))
        better = {}
        for (doubt, (fade, wrong)), less in zip(hope.items(), against, strict=True):
            times = unusual(self._usual(doubt, DOUBTED[1]))
            likely = (fade.gain - fade.rival - less) / times**2 > fade.worth + _RARE
            # of two that are about as likely, the one that leaves nothing behind
            if likely and wrong.clear - less > rival.get(doubt, 0.0) - _RARE:
                better[doubt] = fade, wrong.clear
        return better

    def _silent(self, doubt: Doubt) -> bool:
        """Return whether the gap lacks a sensor for a while: reckoning through it then says nothing about a fade."""
        gap = slice(int(self.seen[doubt.gap - 1]) + 1, int(self.seen[doubt.gap]) + 1)
        silent = (self.grid.speed_sd[gap] > 0) | (self.grid.yaw_rate_sd[gap] > 0)
        return bool(self.grid.h[gap][silent].sum() > _SILENT)

    def _beside(self, doubt: Doubt) -> NDArray[np.intp]:
        """Return the nodes of the fixes in which an error may fade away from a gap."""
        t = self.grid.t[self.seen]
        half = float(t[doubt.block[1] - 1] - t[doubt.block[0]]) / 2
        lo, hi = np.searchsorted(t, t[doubt.first] + np.array([-1.0, 1.0]) * min(half, _FADING) * (1 + 1e-9))
        nodes = self.seen[lo : doubt.first + 1] if doubt.backwards else self.seen[doubt.first : hi]
        return np.asarray(nodes[~self.gone[nodes]])

    def _ask(self, doubts: Sequence[Doubt], lengths: Sequence[float]) -> list[Answer]:
        """Ask the fixes before, or after, or both, where the doubtful ones should have been."""
        t, seen = self.grid.t[self.seen], self.seen
        asked: list[tuple[Doubt, float, NDArray[np.intp], list[slice]]] = []
        hidden = []
        for doubt in doubts:
            for length in lengths:
                lo, hi = np.searchsorted(t, t[doubt.first] + np.array([-length, length]) * (1 + 1e-9)).tolist()
                lo = max(lo, doubt.block[0]) if doubt.backwards else doubt.first
                hi = doubt.first + 1 if doubt.backwards else min(hi, doubt.block[1])
                start = max(doubt.block[0], int(np.searchsorted(t, t[lo] - AROUND)))
                stop = min(doubt.block[1], int(np.searchsorted(t, t[hi - 1] + AROUND)))
                enough = lo - start >= _FEWEST or not doubt.before, stop - hi >= _FEWEST or not doubt.after
                if length > doubt.most or not all(enough):
                    break
                sides = [(start, hi)] * doubt.before + [(lo, stop)] * doubt.after
                parts = [slice(int(seen[a]), int(seen[b - 1]) + 1) for a, b in sides]
                mask = self.gone.copy()
                mask[seen[lo:hi]] = True
                asked.append((doubt, length, seen[lo:hi], parts))
                hidden += [self.grid.rows(part).masked(mask[part]) for part in parts]
        if not hidden:
            return []
        fits = iter(chain.solve(hidden, self.settings, sigma=self.noise, learn=False))
        answers = []
        for doubt, length, nodes, parts in asked:
            said = [next(fits) for _ in parts]
            off = [off_path(self.grid, nodes, part, fit) for part, fit in zip(parts, said, strict=True)]
            answers.append(Answer(doubt, length, nodes, off, apart_of(nodes, parts, said)))
        return answers

    def _odds(self, found: dict[Doubt, "_Wrong"]) -> dict[Doubt, float]:
        """Return how much better wrong fixes explain the drive than a jump of the receiver's slow error, as logarithms.

        The chain that knows such jumps learns from the drive around the gap as it is, and from the same with the
        doubtful fixes put back by as much as they are off: by a constant, a trend and a bend, as far as they are
        enough. The likelihood must grow by more than what these numbers are worth, each the logarithm of how little of
        `_WIDE` is left for it, and by how rare wrong fixes are; a jump inside the gap is a rival as well (`jumped`).
        Next to some that are wrong it need only grow. What the other side of the gap says against it counts as well.
        In the middle of fixes both sides were asked before, and the odds are 0.
        """
        asked = [doubt for doubt in found if doubt.before != doubt.after]
        parts = [self._around(doubt, found[doubt].nodes) for doubt in asked]
        here = [self.grid.rows(part).masked(self.gone[part]) for part in parts]
        own = [found[doubt].nodes - part.start for doubt, part in zip(asked, parts, strict=True)]
        hidden = [drive.masked(np.isin(np.arange(len(drive)), k)) for drive, k in zip(here, own, strict=True)]
        without = chain.solve(hidden, JUDGE) if asked else []
        moved = [_put_back(drive, k, fit.path) for drive, k, fit in zip(here, own, without, strict=True)]
        jumps = jumped(here, own, [doubt.after for doubt in asked], without)
        said = likely([*here, *moved, *(drive for drive, _ in jumps)])
        usual, wrong, other = np.array(said).reshape(3, len(asked))
        against = self._against(asked, [found[doubt].nodes for doubt in asked])
        odds = dict.fromkeys(found, 0.0)
        for i, (doubt, k, fit) in enumerate(zip(asked, own, without, strict=True)):
            spread = fit.path.variance
            left = np.nan if spread is None else float(np.sqrt(np.median(spread[k])))
            worth = _RARE + 2 * min(k.size, _SHAPE) * max(np.log(_WIDE / left), 0.0)
            rival = max(float(usual[i]), float(other[i]) - jumps[i][1])
            odds[doubt] = float(wrong[i]) - rival - against[i] - (0.0 if doubt.known else worth)
        return odds

    def _against(self, doubts: Sequence[Doubt], wrong: Sequence[NDArray[np.intp]]) -> list[float]:
        """Return by how much the other side of each gap, alone, comes nearer to the doubtful fixes than to those that
        follow, as a logarithm of likelihoods, 0 if it does not.

        Both are off by what reckoning through the gap is, so the two distances share one deviation.
        """
        t = self.grid.t[self.seen]
        parts, sides, hidden = [], [], []
        for doubt, nodes in zip(doubts, wrong, strict=True):
            first, stop = doubt.block
            at = np.searchsorted(self.seen, nodes)
            mask = self.gone.copy()
            if doubt.backwards:
                begin = max(first, int(np.searchsorted(t, t[at[0]] - _FOLLOW)))
                end = int(np.searchsorted(t, t[min(stop, t.size - 1)] + _SIDE))
                following = self.seen[begin : at[0]]
                mask[self.seen[:stop]] = True
            else:
                begin = int(np.searchsorted(t, t[max(first - 1, 0)] - _SIDE))
                end = min(stop, int(np.searchsorted(t, t[at[-1]] + _FOLLOW)))
                following = self.seen[at[-1] + 1 : end]
                mask[self.seen[first:]] = True
            part = slice(int(self.seen[begin]), int(self.seen[end - 1]) + 1)
            parts.append(part)
            sides.append((nodes, following[~self.gone[following]]))
            hidden.append(self.grid.rows(part).masked(mask[part]))
        able = [i for i, drive in enumerate(hidden) if sides[i][1].size and drive.seen.any()]
        fits = chain.solve([hidden[i] for i in able], self.settings, sigma=self.noise, learn=False) if able else []
        found = [0.0] * len(hidden)
        for i, fit in zip(able, fits, strict=True):
            (own, sd), (other, _) = (np.median(off_path(self.grid, nodes, parts[i], fit), axis=1) for nodes in sides[i])
            found[i] = max(0.0, 0.5 * float(other**2 - own**2) / float(sd) ** 2)
        return found

    def _around(self, doubt: Doubt, nodes: NDArray[np.intp]) -> slice:
        """Return the nodes around a gap with doubtful fixes at one of its ends."""
        t, at = self.grid.t[self.seen], np.searchsorted(self.seen, nodes)
        first, last = (doubt.block[0] - 1, at[-1] + 1) if doubt.after else (at[0] - 1, doubt.block[1])
        begin = int(np.searchsorted(t, t[max(int(first), 0)] - _SIDE))
        end = int(np.searchsorted(t, t[min(int(last), t.size - 1)] + _SIDE))
        return slice(int(self.seen[begin]), int(self.seen[end - 1]) + 1)

    def _usual(self, doubt: Doubt, length: float) -> Floats:
        """Return how many standard deviations fixes are off at most that nobody doubts, at places all along the drive.

        The chain's own deviations are too small on a log whose errors are not as it takes them; these say by how much.
        """
        kind = doubt.before, doubt.after, length
        if kind not in self._asked:
            room = length + AROUND / 2
            t = self.grid.t[self.seen]
            controls = []
            blocks = [(a, b) for a, b in stretches(self.grid, self.seen) if t[b - 1] - t[a] > 2 * room]
            space = sum(float(t[b - 1] - t[a]) - 2 * room for a, b in blocks)
            # on a short drive they overlap, sooner than being too few
            apart = min(max(length, (t[-1] - t[0]) / _CONTROLS), max(space / (2 * FEWEST_CONTROLS), 1.0))
            for a, b in blocks:
                times = np.arange(t[a] + room, t[b - 1] - room, apart)
                firsts = np.searchsorted(t, times)
                controls += [
                    replace(doubt, first=int(k), most=np.inf, block=(a, b))
                    for k in firsts
                    if not self.gone[self.seen[k]]
                ]
            self._asked[kind] = np.array([furthest(one) for one in self._ask(controls, (length,))])
        return self._asked[kind]


def _put_back(drive: Grid, own: NDArray[np.intp], path: Path) -> Grid:
    """Return a drive with the fixes of some nodes moved by the smooth part of what they are off a path."""
    t = drive.t[own] - drive.t[own].mean()
    shape = np.vander(t / max(float(np.ptp(t)), 1e-9), min(own.size, _SHAPE))
    off = np.column_stack((drive.east - path.east, drive.north - path.north))[own]
    if not np.isfinite(off).all():
        return drive
    smooth = shape @ np.linalg.lstsq(shape, off, rcond=None)[0]
    east, north = drive.east.copy(), drive.north.copy()
    east[own], north[own] = east[own] - smooth[:, 0], north[own] - smooth[:, 1]
    return replace(drive, east=east, north=north)
