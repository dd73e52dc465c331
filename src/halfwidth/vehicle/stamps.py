"""Time stamps of a logger that falls behind: the times at which the sensors spoke, not those at which it wrote.

Many loggers stamp a sample when it arrives. A busy one writes late and catches up later: the fixes of a 10 Hz receiver
then stand 0.3 s apart for a while and 0.08 s apart after that, and every path that multiplies a speed by such a step is
wrong by metres. But a sensor with a clock of its own speaks every T seconds, and nothing is written before it was said.
So the latest times that allow for both,

    said[k] = min(written[k], said[k + 1] - T),

are those at which the samples were taken, up to one delay that they all share, which is the clock offset of
`halfwidth.vehicle.align`. T is taken a little too short, so that a clock that runs fast cannot add up. Lost samples do
no harm: where nothing presses, the stamp stays as it is.

The log decides: its rows are moved only if its fixes then fit its own speed better.

A clock that is set while the logger runs leaps: nothing comes for a while, and then everything goes on where it was.
The car tells that from a pause: in a pause of P seconds it moves on by the speed times P, in a leap it does not.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import evidence
from halfwidth.vehicle.log import STREAMS, Log

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Samples that a stream needs, and over how many of them its period is measured.
FEWEST, SPAN = 100, 50

#: Share by which the period is taken too short, and share of the time in which samples must come at their usual rate.
SLACK, REGULAR = 2e-3, 0.9

#: Steps between fixes that must have changed, by this share of the period, for the log to decide; how much nearer the
#: speed must come to the fixes there.
CHANGED, BY, BETTER = 20, 0.05, 0.9

#: A row is punctual if it is late by less than this share of the usual step; so large a share of the rows must be where
#: no fixes tell whether the others were late.
PUNCTUAL, MOSTLY = 0.05, 0.75

#: Where fixes are further apart than this, s, so many distances are enough.
SLOW, CHANGED_SLOW = 0.5, 8

#: Fixes that are compared lie so far apart, s, neighbours at least; a logger hangs for so long at most, s; none of the
#: distances may say the contrary by this share.
APART, LATEST, NO_WORSE = (0.0, 1.0, 3.0), 20.0, 1.05

#: Rows may not pass fixes; where they would have to by more than this share of the period the streams are late each by
#: itself, and stay as they are.
_CROSSING = 1.0

#: A leap of the clock lasts so many usual steps of the log at least and so long, s, and leaves the fixes that many
#: metres and usual misfits short of where the speed would have brought a car faster than this, m/s; fixes so far on
#: either side are asked, s, and what they say of the time that passed is off by so much of the leap at most.
LEAP, LEAP_S, LEAP_M, LEAP_MISFITS, FAST, BESIDE, NEAR = 1.4, 0.3, 2.0, 6.0, 3.0, 3.0, 0.3

_FIX = ("lat_deg", "lon_deg", "alt_m", "azimuth_rad")


@dataclass(frozen=True, eq=False)
class Stamps:
    """Times of the rows of a log as written, and as said.

    Parameters
    ----------
    written, said : (N,) arrays
        Strictly increasing, s; equal where nothing was moved.
    leaps : tuple of (float, float)
        When the clock leapt, as written, and by how much, s.
    why : str
        What told that rows were late; empty where none was.
    """

    written: Floats
    said: Floats
    leaps: tuple[tuple[float, float], ...] = ()
    why: str = ""

    @property
    def late(self) -> Floats:
        """How late each row was written, (N,), s: leaps of the clock apart."""
        late = self.written - self.said
        for when, seconds in self.leaps:
            late = np.where(self.written >= when, late - seconds, late)
        return late

    @property
    def moved(self) -> bool:
        """Whether any row was."""
        return bool(np.any(self.written != self.said))

    def back(self, t: Floats) -> Floats:
        """Return the stamps of times (n,) as said: exactly those of the log at its rows."""
        if not self.moved:
            return t
        late = np.interp(t, self.said, self.written - self.said)
        at = np.minimum(np.searchsorted(self.said, t), self.said.size - 1)
        return np.where(self.said[at] == t, self.written[at], t + late)

    def words(self) -> str:
        """Say what was done; empty where nothing was."""
        said = [
            f"the clock leaps by {seconds:.2f} s at {when:.1f} s: the car did not move on meanwhile, so no time passed"
            for when, seconds in self.leaps
        ]
        late = self.late
        worst = int(np.argmax(late))
        if self.why:
            said.append(
                f"the log was written up to {late[worst]:.2f} s late (at {self.written[worst]:.0f} s): samples are"
                f" taken at the regular times of their sensors, as {self.why}"
            )
        return "; ".join(said)


def restamped(log: Log) -> tuple[Log, Stamps]:
    """Put the rows of a log at the times at which its sensors spoke.

    Parameters
    ----------
    log : Log

    Returns
    -------
    log : Log
        The same rows; the same log where its streams are not regular, its stamps are, or its fixes and speed do not
        speak for moving them.
    stamps : Stamps
        The way back.
    """
    said = _said(log)
    why = "" if said is None else _told(log, said)
    if said is None or not why:
        said = log.t
    found = leaps(log if said is log.t else replace(log, t=said))
    if said is log.t and not found:
        return log, Stamps(log.t, log.t)
    passed = said - sum(np.where(said >= when, seconds, 0.0) for when, seconds in found)
    written = tuple((float(log.t[np.searchsorted(said, when)]), seconds) for when, seconds in found)
    return replace(log, t=passed), Stamps(log.t, passed, written, why)


def leaps(log: Log) -> tuple[tuple[float, float], ...]:
    """Find where the clock of a log leaps ahead.

    Parameters
    ----------
    log : Log

    Returns
    -------
    tuple of (float, float)
        Time of the first row after each leap and how long it is, s; empty where the log has no speed to tell a leap
        from a pause.
    """
    rows = np.flatnonzero(log.fixed)
    clock, speed = log.stream("speed_mps")
    if rows.size < FEWEST or clock.size < FEWEST:
        return ()
    step = np.diff(log.t)
    usual = float(np.median(step))
    fixes = log.t[rows]
    every = float(np.median(np.diff(fixes)))
    pauses = np.flatnonzero((step > LEAP * usual) & (step - usual > LEAP_S))
    pauses = pauses[(log.t[pauses] > fixes[0]) & (log.t[pauses + 1] < fixes[-1])]
    if not 0 < pauses.size <= 0.01 * len(log):  # else it is how this log comes
        return ()
    east, north = evidence.local_metres(log.lat_deg[rows], log.lon_deg[rows])
    way = np.concatenate(([0.0], np.cumsum(np.diff(clock) * np.abs(speed[1:] + speed[:-1]) / 2)))

    def misfit(a: NDArray[np.intp], b: NDArray[np.intp]) -> Floats:
        """Return by how much fixes b are nearer to fixes a than the speed says, m."""
        went = np.interp(fixes[b], clock, way) - np.interp(fixes[a], clock, way)
        return np.asarray(went - np.hypot(east[b] - east[a], north[b] - north[a]))

    beside = max(1, round(BESIDE / every))
    all_a = np.arange(rows.size - beside)
    whole = fixes[all_a + beside] - fixes[all_a] < 1.5 * beside * every
    if whole.sum() < FEWEST:
        return ()
    usually = misfit(all_a[whole], all_a[whole] + beside)
    size = 1.4826 * float(np.median(np.abs(usually - np.median(usually))))
    found = []
    for k in pauses.tolist():
        last, first = np.searchsorted(rows, k, side="right") - 1, np.searchsorted(rows, k + 1)
        near = (log.t[k] - fixes[last] < every + usual) and (fixes[first] - log.t[k + 1] < every + usual)
        pairs = np.arange(min(beside, last + 1, rows.size - first))
        # across another gap the car may have turned, and a straight line is shorter than its way
        far = np.maximum(log.t[k] - fixes[last - pairs], fixes[first + pairs] - log.t[k + 1])
        pairs = pairs[far < 1.5 * beside * every]
        pace = float(np.interp(log.t[[k, k + 1]], clock, np.abs(speed)).mean())
        if not near or not pairs.size or pace < FAST:
            continue
        leap = float(step[k]) - usual
        short = float(np.median(misfit(last - pairs, first + pairs)))
        clear = short > max(LEAP_M, LEAP_MISFITS * size) and abs(short / pace - leap) < NEAR * leap
        # what no car does between two samples was a pause after all; a logger that hung works off what waits
        steady = abs(float(np.diff(np.interp(log.t[[k, k + 1]], clock, np.abs(speed)))[0])) < 1.0 + 12.0 * usual
        rows_after = min(k + 1 + max(3, round(BESIDE / usual)), len(log) - 1) - k - 1
        takes_its_time = log.t[k + 1 + rows_after] - log.t[k + 1] > 0.95 * rows_after * usual
        if clear and steady and takes_its_time:
            found.append((float(log.t[k + 1]), leap))
    return tuple(found)


def delays(t: Floats) -> tuple[Floats, float]:
    """Return how late each sample of a stream was written, (n,), s, and the period of the stream.

    Zero, and a period of zero, where the stream is not regular.
    """
    nothing = np.zeros(t.size), 0.0
    if t.size < FEWEST:
        return nothing
    period = float(np.quantile((t[SPAN:] - t[:-SPAN]) / SPAN, 0.25))
    # single steps jitter; ten in a row take ten periods
    ten = (t[10:] - t[:-10]) / (10.0 * period)
    if np.mean(np.abs(ten - 1.0) < 0.25) < REGULAR:
        return nothing
    return t - _latest(t, period), period


def _latest(written: Floats, period: float) -> Floats:
    """Return the latest times (n,), s, that are a period apart and not after those written."""
    ramp = np.arange(written.size) * period * (1.0 - SLACK)
    said: Floats = np.minimum.accumulate((written - ramp)[::-1])[::-1] + ramp
    return np.minimum(said, written)


def _said(log: Log) -> Floats | None:
    """Return the times at which the rows of a log were said, strictly increasing; None where nothing is to move."""
    fixed = np.flatnonzero(log.fixed)
    late_fix, period = delays(log.t[fixed])
    if not period:
        return None
    late, known = np.full(len(log), np.inf), np.zeros(len(log), dtype=bool)
    for name in STREAMS:
        rows = np.flatnonzero(np.isfinite(getattr(log, name)))
        if name not in _FIX and rows.size >= FEWEST:
            late[rows] = np.minimum(late[rows], delays(log.t[rows])[0])
            known[rows] = True
    if not known.any():
        known[fixed], late[fixed] = True, late_fix
    late = np.interp(log.t, log.t[known], late[known])
    # beside a gap the fixes that are missing press no longer: there the others say how late the logger was
    pressed = np.where(late[fixed] > late_fix + 0.5 * period, late[fixed], 0.0)
    said = log.t - late
    said[fixed] = _latest(log.t[fixed] - pressed, period)
    if np.max(log.t - said) < BY * period:
        return None
    # the rows between two fixes stay between them, in their order
    after = np.searchsorted(fixed, np.arange(len(log)))
    ends = np.concatenate(([-np.inf], said[fixed], [np.inf]))
    room = 0.01 * period
    held = np.clip(said, ends[after] + room, np.maximum(ends[after + 1] - room, ends[after] + room))
    held[fixed] = said[fixed]
    if np.abs(held - said).max() > _CROSSING * period:
        return None
    held = np.maximum.accumulate(held)
    first = np.concatenate(([True], np.diff(held) > 0))
    run = np.arange(held.size) - np.maximum.accumulate(np.where(first, np.arange(held.size), 0))
    held = held + run * (room / (10.0 * (run.max() + 1.0)))
    return held if bool((np.diff(held) > 0).all()) else None


def _told(log: Log, said: Floats) -> str:
    """Return what tells that rows were late: distances between fixes are nearer to speed times time once all is moved.

    Neighbours show a jitter of every stamp; fixes some seconds apart a logger that hangs, where the error of the fixes
    hides it from neighbours. One of them must say so clearly, and none the contrary.
    """
    rows = np.flatnonzero(log.fixed)
    clock, speed = log.stream("speed_mps")
    if clock.size < FEWEST:
        return ""
    east, north = evidence.local_metres(log.lat_deg[rows], log.lon_deg[rows])
    t, new = log.t[rows], said[rows]
    usual = float(np.median(np.diff(t)))
    pace = np.interp(t, clock, np.abs(speed))
    gains = []
    for apart in sorted({max(1, round(seconds / usual)) for seconds in APART}):
        if apart >= rows.size:
            break
        moved = np.hypot(east[apart:] - east[:-apart], north[apart:] - north[:-apart])
        # the distance is that of the fixes in between, too, where the speed changes
        mean = np.convolve(pace, np.r_[0.5, np.ones(apart - 1), 0.5] / apart, mode="valid")
        before, after = t[apart:] - t[:-apart], new[apart:] - new[:-apart]
        # neither standing nor across a gap
        moving = (mean > 1.0) & (before < 2.0 * apart * usual + LATEST)
        told = (np.abs(after - before) > BY * usual * apart) & moving
        if int(told.sum()) < (CHANGED if usual < SLOW else CHANGED_SLOW):
            continue

        gains.append(
            _misfit(moved, mean * after, moving, told) / max(_misfit(moved, mean * before, moving, told), 1e-12)
        )
    if not gains:
        return "all others come like clockwork" if _like_clockwork(log, said) else ""
    return "the fixes then fit the speed better" if min(gains) < BETTER and max(gains) < NO_WORSE else ""


def _like_clockwork(log: Log, said: Floats) -> bool:
    """Whether the rows that were written in time come so regularly that the others can only have been late.

    Asked where no fixes tell, as when the logger hung in a gap between them.
    """
    late = log.t - said
    usual = float(np.median(np.diff(log.t)))
    punctual = late < PUNCTUAL * usual
    step = np.diff(log.t)[punctual[1:] & punctual[:-1]]
    alike = np.abs(step - usual) < PUNCTUAL * usual
    return bool(late.max() > LEAP_S and punctual.mean() > MOSTLY and alike.size > 0 and alike.mean() > REGULAR)


def _misfit(moved: Floats, reckoned: Floats, moving: Mask, told: Mask) -> float:
    """Return by how much distances usually differ from those reckoned, up to one scale."""
    scale = float(np.median(moved[moving] / reckoned[moving]))
    return float(np.median(np.abs(moved - scale * reckoned)[told]))
