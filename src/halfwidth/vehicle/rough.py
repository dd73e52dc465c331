"""A rough look at the clocks: how well each offset of a stream fits what the fixes show, window by window.

The speed is held against distances between fixes a second apart, the yaw rate against the change of their course in
five seconds. Windows are independent of each other but for their overlap, so their misfits add up, for the whole drive
or for the part before and the part after some time: a clock that steps shows as two offsets that fit much better.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import evidence
from halfwidth.vehicle.frames import wrapped
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.sensors import Calibration

Floats = NDArray[np.float64]

#: Offsets are looked for this far either way, s.
WIDEST = 2.5

#: Windows that a statement rests on, at least.
FEWEST = 20

#: A step of the clocks has so much of the drive on either side, and is looked for at times so far apart, s.
STEP_SIDE, STEP_APART = 30.0, 1.0

#: Windows of so many seconds are asked for a step.
SPANS = (1.0, 2.0, 4.0)

#: How long after each other the courses lie that are compared with the yaw rate, s.
_TURN = 5.0


@dataclass(frozen=True, eq=False)
class Rough:
    """How badly each offset of a stream fits what the fixes show: medians over windows."""

    lags: Floats  # (L,)
    when: dict[str, Floats]  # middle of each window
    misfit: dict[str, Floats]  # (windows, L)
    span: dict[str, float]  # of each window, s

    @classmethod
    def of(cls, log: Log, known: Calibration, least: float = 1.0) -> "Rough":
        """Try every offset on the windows, of some seconds, of a log whose units are known, its clocks not."""
        t_fix = log.t[log.fixed]
        usual = float(np.median(np.diff(t_fix)))
        lags = np.arange(-WIDEST, WIDEST + 1e-9, max(0.1, min(usual, 1.0) / 4))
        when, misfit = {}, {}
        plain = replace(known, offsets={})
        span = evidence.baseline(log, least)
        spans = {"speed": span, "yaw_rate": _TURN}
        chord = evidence.windows(log, span)
        middle, took = 0.5 * (chord.start + chord.stop), chord.stop - chord.start
        t, v = plain.stream(log, "speed")
        if t.size > 2 and middle.size:
            found = np.abs(evidence.integrals(t, v, chord.start, chord.stop, lags)) / took[:, None]
            when["speed"] = middle
            pace = chord.distance / took
            usable = np.isfinite(found).all(axis=1) & (pace > 1.0)
            scale = (
                float(np.median(pace[usable] / np.maximum(np.median(found[usable], axis=1), 0.5)))
                if usable.any()
                else 1.0
            )
            misfit["speed"] = np.abs(scale * found - pace[:, None])
        t, w = plain.stream(log, "yaw_rate")
        if t.size > 2 and middle.size > 2:
            moving = chord.distance > np.maximum(2.0, 1.0 * took)
            at, course = middle[moving], chord.course[moving]
            later = np.searchsorted(at, at + _TURN)
            there = later < at.size
            there[there] &= at[later[there]] - at[there] < 8.0
            a, b = at[there], at[later[there]]
            turned = wrapped(course[later[there]] - course[there])
            found = -evidence.integrals(t, w, a, b, lags)
            when["yaw_rate"] = 0.5 * (a + b)
            misfit["yaw_rate"] = np.abs(wrapped(found - turned[:, None]))
        return cls(lags, when, misfit, spans)

    def offset(self, name: str, start: float = -np.inf, stop: float = np.inf) -> float:
        """Return the offset that fits best between two times, 0 where none is clearly better than none, s."""
        if name not in self.misfit:
            return 0.0
        inside = (self.when[name] >= start) & (self.when[name] <= stop)
        rows = self.capped(name)[1] if inside.all() else _capped(self.misfit[name][inside])
        if len(rows) < FEWEST:
            return 0.0
        cost = rows.mean(axis=0)
        k = int(np.argmin(cost))
        none = float(np.interp(0.0, self.lags, cost))
        return float(self.lags[k]) if cost[k] < 0.9 * none else 0.0

    def cut(self) -> float | None:
        """Return when the clocks step, s; None where one offset for the whole drive explains it about as well.

        Misfits are taken for Laplace's, as their absolute values are what is minimised, and windows that overlap count
        as one. Both streams are asked together: they mostly come by the same logger.
        """
        cuts, gain = self._gains()
        # so many steps were tried that one of them gains this much by chance
        chance = float(np.log(max(cuts.size, 1) * self.lags.size * len(SPANS)))
        return _middle(cuts, gain) if gain.max(initial=0.0) > chance else None

    def likeliest(self) -> float | None:
        """Return when the clocks step if they do, s."""
        cuts, gain = self._gains()
        return _middle(cuts, gain) if cuts.size else None

    def _gains(self) -> tuple[Floats, Floats]:
        """Return times and by how much offsets before and after each explain the drive better than one does."""
        found = [self._likely(name) for name in self.misfit]
        found = [(when, loglik) for when, loglik in found if len(when) >= FEWEST]
        if not found:
            return np.empty(0), np.empty(0)
        first, last = min(when[0] for when, _ in found), max(when[-1] for when, _ in found)
        cuts = np.arange(first + STEP_SIDE, last - STEP_SIDE, STEP_APART)
        gain = np.zeros(cuts.size)
        for when, loglik in found:
            before = loglik[np.searchsorted(when, cuts)]
            gain += before.max(axis=1) + (loglik[-1] - before).max(axis=1) - loglik[-1].max()
        return cuts, gain

    def _likely(self, name: str) -> tuple[Floats, Floats]:
        """Return the times (n,) of the windows of a stream and, for each offset, the log-likelihood up to each."""
        when, rows = self.capped(name)
        if len(rows) < FEWEST:
            return when, np.zeros((1, self.lags.size))
        size = max(float(rows.mean(axis=0).min()), 1e-9)
        overlap = max(1.0, self.span[name] / max(float(np.median(np.diff(when))), 1e-9))
        return when, -np.concatenate((np.zeros((1, self.lags.size)), np.cumsum(rows, axis=0))) / (size * overlap)

    def capped(self, name: str) -> tuple[Floats, Floats]:
        """Return the times and misfits of the windows in which every offset can be judged."""
        whole = np.isfinite(self.misfit[name]).all(axis=1)
        return self.when[name][whole], _capped(self.misfit[name])


def _middle(cuts: Floats, gain: Floats) -> float:
    """Return the middle of the times about the best one that are as good: where nothing tells, it is never far off."""
    alike = np.flatnonzero(gain > gain.max() - 0.5)
    same = np.cumsum(np.diff(alike, prepend=alike[0]) > 1)
    best = same[np.searchsorted(alike, np.argmax(gain))]
    return float(cuts[alike[same == best]].mean())


def cut_of(log: Log, known: Calibration, rough: Rough) -> float | None:
    """Return when the clocks step, s, by the shortest windows that tell it; None where one offset explains the drive.

    A speed has changed by more in a longer window, in which the error of the fixes matters less; but there are fewer,
    and they say less about when.
    """
    when = rough.cut()
    for span in SPANS[1:]:
        when = Rough.of(log, known, span).cut() if when is None else when
    return when


def _capped(rows: Floats) -> Floats:
    """Return misfits (windows, L) of whole windows; what no offset explains counts no more than what the best one does.

    The cap is four times what is usual.
    """
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        return rows
    return np.minimum(rows, 4.0 * max(float(np.median(rows.min(axis=1))), float(np.median(rows)), 1e-6))


def agreement(log: Log, known: Calibration, cut: float | None = None) -> dict[str, list[tuple[Floats, Floats]]]:
    """Return how badly each offset of a stream's clock fits what the fixes show.

    Parameters
    ----------
    log : Log
    known : Calibration
        Units and scale are put right by it, clocks are not.
    cut : float, optional
        Time before and after which it is asked separately, s.

    Returns
    -------
    dict of str to list of (offsets, misfits)
        For ``"speed"`` (m/s) and ``"yaw_rate"`` (rad in five seconds), of those that the log has: one curve for each
        side of the cut with enough windows.
    """
    rough = Rough.of(log, known)
    curves = {}
    for name in rough.misfit:
        when, rows = rough.capped(name)
        sides = [np.ones(when.size, dtype=bool)] if cut is None else [when < cut, when >= cut]
        curves[name] = [(rough.lags, rows[side].mean(axis=0)) for side in sides if side.sum() >= FEWEST]
    return curves
