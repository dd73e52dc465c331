"""Speeds that leap away out of a car's reach and come back, or say 0 and leap: not used where fixes say otherwise.

A leap alone is no fault: after a pause of the logger the car goes as fast as it goes. So the fixes beside the samples
are asked whether they move as these say or as those before and after them, and where there are no fixes, as in a
tunnel, how far the way along the yaw rate leads from the last fix to the next.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import evidence
from halfwidth.vehicle.lapse import Lapse
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.spikes import BLIND, LIMIT
from halfwidth.vehicle.units import contradicted_yaw, matched_factor

Floats = NDArray[np.float64]

#: Samples that are needed.
_FEWEST = 20

#: A speed that leaps away comes back within so many seconds.
_AWAY = 30.0

#: A way between two fixes is reckoned in so many steps a second, and so many at most.
_RECKONED, _NODES = 10.0, 10_000


def leaping_speed(log: Log) -> list[Lapse]:
    """Return where the speed leaps away out of a car's reach and comes back, or says 0 and leaps, against the fixes.

    Of a 0 that leaps at one end only and that fixes confirm elsewhere, what lies between that end and them is not used.
    """
    name = "speed_mps"
    t, values = log.stream(name)
    if t.size < _FEWEST:
        return []
    row = matched_factor(evidence.speed_ratio(log))
    values = values * (row[2] if row is not None and row[3] == 1 else 1.0)
    change = np.diff(values)
    at = np.flatnonzero(np.abs(change) > LIMIT[name][0] + LIMIT[name][1] * np.diff(t) + BLIND[name]) + 1
    new = np.flatnonzero(change != 0) + 1
    fixes = log.t[log.fixed]
    unseen = max(1.0, 2.0 * float(np.median(np.diff(fixes)))) if fixes.size > 1 else 1.0
    rows = np.flatnonzero(np.isfinite(getattr(log, name)))
    judge = _Judge.of(log, t, values) if at.size else None
    found: list[Lapse] = []
    done = -1
    for i, a in enumerate(at.tolist()):
        if a <= done:
            continue
        before = values[a - 1]
        ends = at[i + 1 : int(np.searchsorted(t[at], t[a] + _AWAY, side="right"))]
        back = (change[a - 1] * change[ends - 1] < 0) & (np.abs(values[ends] - before) < abs(change[a - 1]) / 2)
        k = int(np.searchsorted(new, a))  # `new[k]` is `a`
        if back.any():
            stop = int(ends[np.argmax(back)])
            parts, pace = [(a, stop)], float(min(abs(before), abs(values[stop])))
        elif values[a] == 0:
            stop = int(new[k + 1]) if k + 1 < new.size else t.size
            parts, pace = [(a, stop), (a, min(stop, _before(t, fixes, a)))], abs(float(before))
        elif before == 0:
            first = int(new[k - 1]) if k else 0
            parts, pace = [(first, a), (max(first, _after(t, fixes, a)), a)], abs(float(values[a]))
        else:
            continue
        if judge is not None and judge.confirms(*parts[0], pace):
            # what no fix sees may be wrong nevertheless
            parts = [(b, c) for b, c in parts[1:] if c > b and t[c - 1] - t[b] > unseen]
        if not parts:
            continue
        first, stop = parts[0]
        says = float(np.median(values[first:stop]))
        found.append(Lapse(name, int(rows[first]), int(rows[stop - 1]), 0.0, 1.0, says, pace, False))
        done = stop
    return found


def _before(t: Floats, fixes: Floats, a: int) -> int:
    """Return the first sample that is not before the first fix from sample a on."""
    k = int(np.searchsorted(fixes, t[a]))
    return int(np.searchsorted(t, fixes[k])) if k < fixes.size else t.size


def _after(t: Floats, fixes: Floats, a: int) -> int:
    """Return the first sample after the last fix before sample a."""
    k = int(np.searchsorted(fixes, t[a])) - 1
    return int(np.searchsorted(t, fixes[k], side="right")) if k >= 0 else 0


@dataclass(frozen=True, eq=False)
class _Judge:
    """What says whether a speed that leaps is right: samples, fixes, m, and the yaw rate in rad/s, put right."""

    t: Floats
    values: Floats
    fixes: Floats
    east: Floats
    north: Floats
    clock: Floats
    rate: Floats

    @classmethod
    def of(cls, log: Log, t: Floats, values: Floats) -> "_Judge":
        east, north = evidence.local_metres(log.lat_deg[log.fixed], log.lon_deg[log.fixed])
        clock, rate = log.stream("yaw_rate_radps")
        factor = contradicted_yaw(evidence.turning(log)) or 1.0
        return cls(t, values, log.t[log.fixed], east, north, clock, rate * factor)

    def confirms(self, first: int, stop: int, pace: float) -> bool:
        """Return whether the fixes beside some samples move as these say, and not at a pace.

        Where there are none, those around them are asked how far the way along the yaw rate leads.
        """
        a = int(np.searchsorted(self.fixes, self.t[first]))
        b = int(np.searchsorted(self.fixes, self.t[stop - 1], side="right")) - 1
        if b <= a:
            return self._nearer(first, stop, pace)
        shown = self._apart(a, b) / float(self.fixes[b] - self.fixes[a])
        return abs(shown - float(np.abs(self.values[first:stop]).mean())) < abs(shown - pace)

    def _nearer(self, first: int, stop: int, pace: float) -> bool:
        """Return whether dead reckoning between the fixes around samples comes nearer with them than at a pace."""
        begin, end = self.t[first], self.t[stop - 1]
        a, b = int(np.searchsorted(self.fixes, begin)) - 1, int(np.searchsorted(self.fixes, end))
        if a < 0 or b >= self.fixes.size:
            return False
        apart, length = self._apart(a, b), float(self.fixes[b] - self.fixes[a])
        when = np.linspace(self.fixes[a], self.fixes[b], 2 + int(min(_RECKONED * length, _NODES)))
        turning = np.interp(when, self.clock, self.rate) if self.clock.size else np.zeros(when.size)
        step = np.diff(when)
        azimuth = np.concatenate(([0.0], np.cumsum(step * 0.5 * (turning[1:] + turning[:-1]))))
        speed = np.abs(np.interp(when, self.t, self.values))
        at_pace = np.where((when >= begin) & (when <= end), pace, speed)
        off = []
        for v in (speed, at_pace):
            way = v * np.exp(1j * azimuth)
            off.append(abs(abs(complex(np.sum(step * 0.5 * (way[1:] + way[:-1])))) - apart))
        return off[0] < off[1]

    def _apart(self, a: int, b: int) -> float:
        """Return how far two fixes are apart, m."""
        return float(np.hypot(self.east[b] - self.east[a], self.north[b] - self.north[a]))
