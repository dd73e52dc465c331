"""Which rows of a log a track has, what is to be filled between them, and the pieces that a long drive is cut into."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle.estimators import Method
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.log import Log

Floats = NDArray[np.float64]

#: A piece is about this long, with this much context on both sides; a pause of the whole log ends a piece, s.
PIECE, CONTEXT, PAUSE = 600.0, 60.0, 60.0

#: A pause between fixes of this length is a gap even where it is usual in the log, s.
LONG = 5.0

#: A pause of the whole log of more than this many usual fix intervals, and of `PAUSE` at most, gets rows of its own.
ROWLESS = 2.5


def with_pauses_filled(log: Log, messages: list[str]) -> Log:
    """Add rows where nothing at all arrived between two fixes although at least two fixes were due."""
    fixes = log.t[log.fixed]
    if fixes.size < 3:
        return log
    usual = float(np.median(np.diff(fixes)))
    step = np.diff(log.t)
    pauses = np.flatnonzero((step > ROWLESS * usual) & (log.t[:-1] >= fixes[0]) & (log.t[1:] <= fixes[-1]))
    open_ = [k for k in pauses if step[k] > PAUSE]
    messages.extend(
        f"nothing arrived for {step[k]:.0f} s from {log.t[k]:.1f} s on: longer than {PAUSE:.0f} s, left open"
        for k in open_
    )
    added = [np.linspace(log.t[k], log.t[k + 1], round(step[k] / usual) + 1)[1:-1] for k in pauses if step[k] <= PAUSE]
    if not added:
        return log
    times = np.concatenate(added)
    total = sum(step[k] for k in pauses if step[k] <= PAUSE)
    messages.append(
        f"nothing arrived in {len(added)} pause{'s' if len(added) > 1 else ''} of the log, {total:.1f} s in all:"
        f" {times.size} rows were added there"
    )
    return log.with_rows(times)


def wanted_rows(log: Log) -> tuple[NDArray[np.intp], NDArray[np.str_]]:
    """Return the rows that a track has, and the quality of each."""
    t, fixed = log.t, log.fixed
    times = t[fixed]
    quality = np.where(fixed, "fix", "").astype("<U12")
    quality[~fixed & ((t < times[0]) | (t > times[-1]))] = "extrapolated"
    for start, stop in _gaps(log):
        a, b = np.searchsorted(t, start, side="right"), np.searchsorted(t, stop)
        quality[a:b] = "bridged"
    rows = np.flatnonzero(quality != "")
    return rows, quality[rows]


def _gaps(log: Log) -> list[tuple[float, float]]:
    """Return the log's gaps and every other pause between fixes that is long for any receiver."""
    times = log.t[log.fixed]
    long = np.flatnonzero(np.diff(times) > LONG)
    return sorted({*log.gaps(), *((float(times[k]), float(times[k + 1])) for k in long)})


#: Share of a quarter of a stretch that a silent sensor may reach into the next one.
_SLIP = 0.2


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of the drive: the span it answers for, and its grid, which reaches further."""

    start: float
    stop: float
    grid: Grid


def pieces_of(grid: Grid, log: Log) -> list[Piece]:
    """Cut a drive where the log pauses and, if it is long, every ten minutes at a fix."""
    rest = np.flatnonzero(np.diff(log.t) > PAUSE)
    blocks = [(log.t[a], log.t[b]) for a, b in zip([0, *(rest + 1)], [*rest, len(log) - 1], strict=True)]
    merged: list[tuple[float, float]] = []
    held = False
    for start, stop in blocks:
        has_fix = bool(grid.seen[(grid.t >= start) & (grid.t <= stop)].any())
        # a block without a fix cannot stand alone
        if merged and (held or not has_fix):
            merged[-1] = (merged[-1][0], stop)
            held = held and not has_fix
        else:
            merged.append((start, stop))
            held = not has_fix
    pieces = []
    for start, stop in merged:
        cuts = [start]
        fixes = grid.t[grid.seen & (grid.t > start) & (grid.t < stop)]
        while stop - cuts[-1] > 1.5 * PIECE:
            k = int(np.searchsorted(fixes, cuts[-1] + PIECE))
            if k >= fixes.size or stop - fixes[k] < 1.0:
                break
            cuts.append(float(fixes[k]))
        for a, b in zip(cuts, [*cuts[1:], stop], strict=True):
            part = grid.between(max(start, a - CONTEXT) - 1e-9, min(stop, b + CONTEXT) + 1e-9)
            pieces.append(Piece(a, b, part))
    return pieces


@dataclass(frozen=True)
class Span:
    """A stretch to be filled: between two fixes, or before the first or after the last one."""

    start: float
    stop: float
    silent: tuple[str, ...]  # sensors that the log has, but not there
    part: tuple[float, float] = (0.0, 1.0)  # from where to where they are silent, in quarters of the stretch

    @property
    def length(self) -> float:
        """How long it is, s."""
        return self.stop - self.start


def spans_of(log: Log, grid: Grid, chosen: Method, t: Floats, quality: NDArray[np.str_]) -> list[Span]:
    """Return the stretches to be filled, and which sensors are silent for most of each."""
    fixes = log.t[log.fixed]
    ends = [(start, stop) for start, stop in _gaps(log) if np.any((t > start) & (t < stop))]
    if np.any(quality == "extrapolated"):
        ends += [(a, b) for a, b in ((log.t[0], fixes[0]), (fixes[-1], log.t[-1])) if b > a]
    spans = []
    for start, stop in ends:
        steps = (grid.t > start) & (grid.t <= stop)
        took = grid.h[steps]
        lost = {
            name: getattr(grid, f"{name}_sd")[steps] > 0
            for name in chosen.needs + chosen.one_of
            if getattr(grid, f"has_{name}")
        }
        silent = tuple(name for name, rows in lost.items() if took @ rows > 0.5 * took.sum())
        part = (0.0, 1.0)
        if silent:
            rows = np.flatnonzero(np.any([lost[name] for name in silent], axis=0))
            share = np.concatenate(([0.0], np.cumsum(took))) / took.sum()
            part = float(np.floor(4 * share[rows[0]] + _SLIP) / 4), float(np.ceil(4 * share[rows[-1] + 1] - _SLIP) / 4)
        spans.append(Span(float(start), float(stop), silent, part))
    return spans
