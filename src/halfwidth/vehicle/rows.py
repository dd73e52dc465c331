"""The rows of a file while they are put in order of time: sorted, one for each time, and at times a coarse clock hid.

A clock that counts whole seconds says of each row only in which second it came. Rows that come regularly, one every T
seconds from some time on, leave no choice but that line which passes through all their seconds; where there is none,
rows are missing, and those of a second are spread evenly over it.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadLog

Floats = NDArray[np.float64]

#: Time steps beyond this are a clock being set (s).
_CLOCK_SET = 86_400.0

#: A clock that goes back further than this has been set, not jittered (s).
_JITTER = 5.0

#: Clocks that begin anew: after so many seconds, and what begins.
_ROUND = ((86_400.0, "day"), (604_800.0, "week"), (2**32 * 1e-3, "count of ms"), (2**32 * 1e-6, "count of us"))

#: Seconds from its end, and from its beginning, that a clock that begins anew is seen in.
_TURN = 60.0

#: Sorted rows of a clock that began anew have first and last next to each other, so many usual steps apart at most.
_NEXT = 3.0

#: Rows are shuffled if so many go back in time, and if so many come at the usual rate once they are sorted.
_DISORDER, _REGULAR = 0.3, 0.8

#: Rows that a stretch needs for a line; how much more than a count they may be off it, for arrival jitter; how many
#: periods a count must last at least; how many uneven steps cannot all be lost rows; rounds in which the period is
#: looked for; share of the rows that have the stream.
_FEWEST, _LEEWAY, _COARSE, _WRAPS, _ROUNDS, _WHOLE = 50, 1.05, 0.3, 3, 60, 0.9


def ruled_times(stamps: Floats) -> Floats | None:
    """Return the times of rows that come regularly, of which a coarse clock wrote only the beginning of its count.

    A row is written at the count before it, so one straight line passes through the counts of all rows of a stretch;
    the earliest is taken. Stamps that are regular themselves hide nothing.

    Parameters
    ----------
    stamps : (N,) array
        Not decreasing, s.

    Returns
    -------
    (N,) array or None
        Strictly increasing; None where the clock is not coarse or no line fits, as where rows are missing.
    """
    step = np.diff(stamps)
    count = float(step[step > 0].min()) if (step > 0).any() else 0.0
    if not count or np.abs(step / count - np.round(step / count)).max() > 1e-4:
        return None
    rate = stamps.size / float(stamps[-1] - stamps[0] + count)
    cuts = np.flatnonzero(step > 2.5 * max(count, 1 / rate)) + 1
    parts = list(pairwise([0, *cuts.tolist(), stamps.size]))
    longest = max(parts, key=lambda part: part[1] - part[0])
    period = _period(stamps[slice(*longest)], count)
    if period is None or count < _COARSE * period:
        return None
    out = np.empty(stamps.size)
    for a, b in parts:
        room = stamps[a:b] - period * np.arange(b - a)
        if np.ptp(room) > count * _LEEWAY:
            return None
        # the earliest of the lines that all stamps allow: they are as far apart as the phases of the rows
        out[a:b] = room.max() + period * np.arange(b - a)
    irregular = int(np.sum(np.abs(step - np.median(step)) > 0.25 * count))
    return out if (np.diff(out) > 0).all() and (period < count / 2 or irregular >= _WRAPS) else None


def _period(stamps: Floats, count: float) -> float | None:
    """Return the period of regular rows, None if they are too few.

    As many rows in each count, or else least squares, where that line passes through all counts; else the line that
    comes nearest to them, whose spread is convex in the period.
    """
    n = stamps.size - 1
    if n < _FEWEST:
        return None
    index, mean = np.arange(n + 1), float(stamps[-1] - stamps[0]) / n
    centred = index - 0.5 * n
    for period in (count / max(round(count / mean), 1), float(centred @ stamps) / float(centred @ centred)):
        if np.ptp(stamps - period * index) < count * (1 - 1e-9):
            return period
    low, high = mean - 1.1 * count / n, mean + 1.1 * count / n
    for _ in range(_ROUNDS):
        a, b = low + (high - low) / 3, high - (high - low) / 3
        if np.ptp(stamps - a * index) < np.ptp(stamps - b * index):
            high = b
        else:
            low = a
    return 0.5 * (low + high)


def counted(count: int, noun: str) -> str:
    """Say how many of something there are."""
    return f"{count} {noun}{'' if count == 1 else 'es' if noun[-1] in 'xh' else 's'}"


@dataclass
class Rows:
    """The rows while they are put in order of time."""

    source: str
    t: Floats
    streams: dict[str, Floats]
    notes: list[str] = field(default_factory=list)

    def _keep(self, rows: NDArray[Any]) -> None:
        self.t = self.t[rows]
        self.streams = {name: values[rows] for name, values in self.streams.items()}

    def drop_untimed(self) -> None:
        """Drop rows without a time."""
        held = np.isfinite(self.t)
        if not held.all():
            self.notes.append(f"{counted(int((~held).sum()), 'row')} without a time dropped")
            self._keep(held)
        if self.t.size == 0:
            raise BadLog(f"`{self.source}` has no row with a time")

    def unwrap(self) -> None:
        """Count on where a clock that counts a day, a week or 32 bits begins anew."""
        if self.t.size < 2 or self.t.min() < 0:
            return
        step, highest = np.diff(self.t), float(self.t.max())
        for period, name in _ROUND:
            turns = np.flatnonzero(np.abs(step) > period / 2)
            ends = np.sort(np.column_stack((self.t[turns], self.t[turns + 1])), axis=1)
            if not turns.size or highest > period or ends[:, 0].max() > _TURN or ends[:, 1].min() < period - _TURN:
                continue
            if (step >= 0).all():  # somebody sorted a drive over midnight, or it pauses for a day
                usual = np.median(np.delete(step, turns)) if step.size > turns.size else 0.0
                if self.t[0] + period - highest > _NEXT * usual:
                    continue
            count = np.zeros(self.t.size)
            count[turns + 1] = -np.sign(step[turns])
            self.t = self.t + period * np.cumsum(count)
            some = counted(max(int(count.sum()), 1), "time")
            self.notes.append(f"the time begins anew with each {name}, {some} in the log: counted on")
            return

    def drop_before_clock_was_set(self) -> None:
        """Keep the main block where the clock was set while the log ran."""
        cuts = np.flatnonzero(np.abs(np.diff(self.t)) > _CLOCK_SET) + 1
        if cuts.size == 0:
            return
        edges = np.concatenate(([0], cuts, [self.t.size]))
        # blocks of the same clock belong together: a single wild stamp does not split them
        centre = np.array([np.median(self.t[a:b]) for a, b in pairwise(edges)])
        size = np.diff(edges)
        main = centre[int(np.argmax(size))]
        near = np.abs(centre - main) <= 7 * _CLOCK_SET
        kept = np.repeat(near, size)
        if kept.mean() < 0.8:
            raise BadLog(
                f"`{self.source}` jumps by {float(np.abs(np.diff(self.t)).max()) / 86400:.3g} days in time and no part"
                f" holds most of its {self.t.size} rows, one drive is expected",
                hint="split it where the clock jumps",
            )
        if not kept.all():
            self.notes.append(f"{counted(int((~kept).sum()), 'row')} days away from the rest dropped (clock not set)")
            self._keep(kept)

    def sort(self) -> None:
        """Put rows in order of time, unless the clock restarted."""
        step = np.diff(self.t)
        back = step < 0
        if not back.any():
            return
        if (step <= 0).all():
            self._keep(np.arange(self.t.size)[::-1])
            self.notes.append("rows ran backwards in time: turned around")
            return
        restarts = np.flatnonzero(step < -_JITTER) + 1
        if restarts.size and self._drop_copies():
            self.sort()
            return
        if restarts.size and self._shuffled(back):
            self._keep(np.argsort(self.t, kind="stable"))
            self.notes.append("rows stood in no order of time: sorted")
            return
        if restarts.size:
            self._refuse_restart(restarts)
        order = np.argsort(self.t, kind="stable")
        self._keep(order)
        self.notes.append(f"time went backwards {counted(int(back.sum()), 'time')}: rows sorted")

    def _drop_copies(self) -> bool:
        """Drop rows that stand elsewhere again, value for value; return whether there were any."""
        order = np.argsort(self.t, kind="stable")
        same = np.diff(self.t[order]) == 0
        for values in self.streams.values():
            a, b = values[order[:-1]], values[order[1:]]
            same &= (a == b) | (np.isnan(a) & np.isnan(b))
        copies = order[1:][same]
        if not copies.size:
            return False
        kept = np.ones(self.t.size, dtype=bool)
        kept[copies] = False
        self._keep(kept)
        self.notes.append(f"{counted(copies.size, 'row')} dropped, each there twice")
        return True

    def _shuffled(self, back: NDArray[np.bool_]) -> bool:
        """Whether rows of one drive stand in no order: no two share a time, and once sorted they come regularly."""
        step = np.diff(np.sort(self.t))
        usual = float(np.median(step))
        return bool(back.mean() > _DISORDER and step.min() > 0 and np.mean(np.abs(step / usual - 1) < 0.5) > _REGULAR)

    def _refuse_restart(self, restarts: NDArray[Any]) -> None:
        """Refuse two drives on one clock; streams one after the other, or blocks in disorder, are fine."""
        if restarts.size > 1000:
            raise BadLog(
                f"`{self.source}` goes back in time by more than {_JITTER:g} s in {restarts.size} rows, one clock is"
                " expected",
                hint="is it the right column? --columns time=NAME names another",
            )
        edges = np.concatenate(([0], restarts, [self.t.size]))
        for name in ("lat_deg", "speed_mps", "yaw_rate_radps", "ax_mps2"):
            held = np.isfinite(self.streams[name])
            spans = []
            for a, b in pairwise(edges):
                t = self.t[a:b][held[a:b]]
                if t.size:
                    spans.append((float(t.min()), float(t.max()), int(a)))
            spans.sort()
            for (_, end, one), (start, _, other) in pairwise(spans):
                if start < end - _JITTER:
                    row = max(one, other)
                    raise BadLog(
                        f"`{self.source}` restarts its clock: row {row + 1} is at {self.t[row]:.6g} s after"
                        f" {self.t[row - 1]:.6g} s, and both parts hold {name} for the same times",
                        hint=f"split it before row {row + 1}: one drive a file",
                    )

    def spread_coarse_stamps(self) -> None:
        """Spread rows evenly where many samples share one stamp of a coarse clock."""
        starts = np.flatnonzero(np.concatenate(([True], np.diff(self.t) > 0)))
        size = np.diff(np.concatenate((starts, [self.t.size])))
        if starts.size < 3:
            return
        group = np.repeat(np.arange(starts.size), size)
        held = np.isfinite(self.streams["speed_mps"])
        for name in ("lat_deg", "yaw_rate_radps", "ax_mps2"):
            other = np.isfinite(self.streams[name])
            held = other if other.sum() > held.sum() else held
        several = float(np.median(size)) >= 2
        # only if the same stream comes several times a stamp: else rows merely share an instant
        if held.sum() < (1.5 * np.unique(group[held]).size if several else _WHOLE * self.t.size):
            return
        ruled = ruled_times(self.t)
        if ruled is not None:
            self.t = ruled
            self.notes.append(
                f"time stamps are of a clock that counts in {float(np.median(np.diff(self.t[starts]))):.3g} s and the"
                " rows regular: each is taken at the regular time that its stamp allows"
            )
            return
        if not several:
            return
        usual = float(np.median(np.diff(self.t[starts])))
        width = np.append(np.minimum(np.diff(self.t[starts]), usual), usual)
        place = np.arange(self.t.size) - np.repeat(starts, size)
        # a log begins within a stamp and ends within one; where rows are missing elsewhere nobody knows which
        missing = np.maximum(float(np.median(size)) - size, 0.0)[[0, -1]]
        share, ahead = size.astype(np.float64), np.zeros(size.size)
        share[[0, -1]] += missing
        ahead[0] = missing[0]
        self.t = self.t + np.repeat(width / share, size) * (place + np.repeat(ahead, size))
        self.notes.append(
            f"about {float(np.median(size)):g} rows share each time stamp of {usual:.3g} s: spread evenly in between"
        )

    def join_equal_times(self) -> None:
        """Make rows of one time one row: the first value of each stream stays."""
        new = np.concatenate(([True], np.diff(self.t) > 0))
        if new.all():
            return
        starts = np.flatnonzero(new)
        rows = np.arange(self.t.size)
        group = np.cumsum(new) - 1
        conflict = np.zeros(self.t.size, dtype=bool)
        lat = self.streams["lat_deg"]
        joined = {}
        for name, values in self.streams.items():
            held = np.isfinite(lat) if name == "lon_deg" else np.isfinite(values)
            first = np.minimum.reduceat(np.where(held, rows, self.t.size), starts)
            there = first < self.t.size
            out = np.full(starts.size, np.nan)
            out[there] = values[first[there]]
            joined[name] = out
            conflict |= held & (values != out[group])
        self.notes.append(
            f"{counted(int((~new).sum()), 'row')} with the time of the row before joined to it"
            + (f", {int(conflict.sum())} of them with other values, which are dropped" if conflict.any() else "")
        )
        self.t, self.streams = self.t[starts], joined
