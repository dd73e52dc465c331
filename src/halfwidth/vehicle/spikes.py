"""Samples of speed and yaw rate that no car can have had: they leap away and come back, or are stuck and then leap.

A broken telegram gives a speed of 120 m/s for a tenth of a second; a bus that hangs repeats the same value for seconds
and leaps to the true one afterwards. Either bends the path by metres and spoils the calibration of the sensor, and no
test of fixes names it. One or two samples are a spike if they are further from the median of five neighbours than a car
can change in that time, and than ten times what is usual. Equal samples for a second or more are stuck if the value
before or after them leaps: out of a car's reach, or by three times what all but a hundredth of the log's changes are,
or, where the samples stay equal for three times as long as anywhere else, by more than the log's usual change. A car
that cruises ends that smoothly. Shorter runs are stuck too, as those of a slow sensor, where a log has hardly one such
run with such a leap by chance: as many as there are others, or as follow from how often its samples repeat at all. A
speed of 0 is never stuck, as a car stands for as long as it likes, and of a leap to or from 0 what a sensor may be
blind for does not count.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle.log import Log

Floats = NDArray[np.float64]

#: What a sample may differ by at once and by how much more for each second, the stream's name and its unit.
LIMIT = {"speed_mps": (1.0, 12.0, "speed", "m/s"), "yaw_rate_radps": (0.4, 3.0, "yaw rate", "rad/s")}

_NONE = np.empty(0, dtype=np.intp)

#: How many times the usual distance from the median is not usual; the share of samples that is no exception any more.
_UNUSUAL, _MANY, _MANY_STUCK = 10.0, 0.02, 0.3

#: Samples looked at together.
_WINDOW = 5

#: Equal samples are stuck from so many of them and so many seconds on.
_STUCK, _STUCK_S = 5, 1.0

#: A leap is so many times what all but a hundredth of the changes are; where samples stay equal for so many times as
#: long as anywhere else, so many times the usual change; a log needs so many changes to say what is usual.
_OFTEN, _LONGER, _MORE, _CHANGES = 3.0, 3.0, 1.5, 50

#: Fewer equal samples, from so many on, are stuck where a log has so few such runs with such a leap by chance; the leap
#: must be larger than such a share of the changes.
_FEW, _CHANCE, _LARGE = 3, 0.01, 0.95

#: Below this a sensor may say 0: so much of a leap to or from 0 proves nothing.
BLIND = {"speed_mps": 2.0, "yaw_rate_radps": np.inf}

#: No car turns like this for a twentieth of the time, rad/s: the stream is in degrees.
_IN_DEGREES = 2.0


@dataclass(frozen=True, eq=False)
class Spikes:
    """Which samples of a log are spikes, and which are stuck.

    Parameters
    ----------
    rows : mapping of str to (n,) int array
        Rows of spikes by field of the log.
    stuck : mapping of str to list of (n,) int array
        Rows of each stretch that is stuck.
    """

    rows: Mapping[str, NDArray[np.intp]]
    stuck: Mapping[str, list[NDArray[np.intp]]]

    def __len__(self) -> int:
        return sum(self._gone(name).size for name in LIMIT)

    def _gone(self, name: str) -> NDArray[np.intp]:
        return np.concatenate([self.rows.get(name, _NONE), *self.stuck.get(name, [])])

    def masked(self, log: Log) -> Log:
        """Return the log without these samples."""
        changed: dict[str, Any] = {}
        for name in {*self.rows, *self.stuck}:
            values = getattr(log, name).copy()
            values[self._gone(name)] = np.nan
            changed[name] = values
        return replace(log, **changed) if changed else log

    def words(self, log: Log) -> list[str]:
        """Say what was found, with times and sizes."""
        found = []
        for name, (_, _, label, unit) in LIMIT.items():
            values, rows, stuck = getattr(log, name), self.rows.get(name, _NONE), self.stuck.get(name, [])
            if rows.size:
                listed = ", ".join(f"{log.t[k]:.1f} s ({values[k]:.3g} {unit})" for k in rows[:5].tolist())
                some = "1 sample" if rows.size == 1 else f"{rows.size} samples"
                more = ", ..." if rows.size > 5 else ""
                found.append(f"{some} of the {label} that no car can have had, at {listed}{more}: not used")
            if stuck:
                spans = [f"{log.t[one[0]]:.1f} to {log.t[one[-1]]:.1f} s" for one in stuck]
                more = ", ..." if len(stuck) > 5 else ""
                found.append(f"the {label} is stuck and then leaps, {', '.join(spans[:5])}{more}: not used")
        return found


def spikes(log: Log) -> Spikes:
    """Find samples of speed and yaw rate that leap away and come back, or are stuck.

    Parameters
    ----------
    log : Log

    Returns
    -------
    Spikes
        None of a stream in which they are no exception.
    """
    found: dict[str, NDArray[np.intp]] = {}
    stuck: dict[str, list[NDArray[np.intp]]] = {}
    for name, (at_once, rate, _, _) in LIMIT.items():
        rows = np.flatnonzero(np.isfinite(getattr(log, name)))
        if rows.size < 2 * _WINDOW:
            continue
        t, values = log.t[rows], getattr(log, name)[rows]
        if name == "yaw_rate_radps" and np.quantile(np.abs(values), 0.95) > _IN_DEGREES:
            values = np.radians(values)
        edge = _WINDOW // 2
        around = np.lib.stride_tricks.sliding_window_view(np.pad(values, edge, mode="edge"), _WINDOW)
        times = np.lib.stride_tricks.sliding_window_view(np.pad(t, edge, mode="edge"), _WINDOW)
        off = np.abs(values - np.median(around, axis=1))
        far = off > at_once + rate * np.maximum(times[:, -1] - t, t - times[:, 0])
        spike = far & (off > _UNUSUAL * float(np.quantile(off, 0.9)))
        if 0 < spike.sum() <= max(1.0, _MANY * rows.size):
            found[name] = rows[spike]
            rows, t, values = rows[~spike], t[~spike], values[~spike]
        begin, end = _stuck(t, values, at_once + rate * float(np.median(np.diff(t))), BLIND[name])
        runs = [rows[a : b + 1] for a, b in zip(begin, end, strict=True)]
        if runs and sum(run.size for run in runs) <= _MANY_STUCK * rows.size:
            stuck[name] = runs
    return Spikes(found, stuck)


def _stuck(t: Floats, values: Floats, reach: float, blind: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and last of each run of equal samples that is stuck; a change beyond reach is out of a car's."""
    begin = np.flatnonzero(np.concatenate(([True], np.diff(values) != 0)))
    end = np.concatenate((begin[1:], [values.size])) - 1
    number, held, moving = end - begin + 1, t[end] - t[begin], values[begin] != 0
    long = (number >= _STUCK) & (held >= _STUCK_S)
    change = np.abs(np.diff(values))
    still = (values[1:] == 0) | (values[:-1] == 0)
    leap = np.where(still, np.maximum(change - blind, 0.0), change)
    leap = np.concatenate(([0.0], leap, [0.0]))
    leap = np.where(moving, np.maximum(leap[begin], leap[end + 1]), 0.0)
    changes = change[change > 0]
    if changes.size < _CHANGES:
        odd = long & (leap > reach)
        return begin[odd], end[odd]
    more = _MORE * float(np.median(changes))
    other = np.partition(held[moving], -2)[-2] if moving.sum() > 1 else np.inf
    alone = held > _LONGER * max(other, _STUCK_S)
    odd = long & ((leap > min(reach, _OFTEN * float(np.quantile(changes, 0.99)))) | (alone & (leap > more)))
    large = float(np.quantile(changes, _LARGE))
    for k in np.flatnonzero((number >= _FEW) & (held >= _STUCK_S) & (leap > max(more, large)) & ~odd).tolist():
        odd[k] = _expected(number[moving], int(number[k]), changes, float(leap[k])) < _CHANCE
    return begin[odd], end[odd]


def _expected(number: NDArray[np.intp], n: int, changes: Floats, leap: float) -> float:
    """Return how many runs of n equal samples with such a leap at an end a log has by chance, one such run apart.

    Runs: as many as there are that long and one more, or, if that is fewer, what comes of how often samples are equal
    at all and of how often they then stay so. Leaps: as many as there are that large and one more, at both ends.
    """
    others = np.delete(number, int(np.argmax(number == n)))
    samples, equal = float(others.sum() + 1), float((others - 1).sum())
    again = float(np.maximum(others - 2, 0).sum())
    share = (equal + 1) / samples
    # that they stay equal is known from those that were, and before from the share of all
    stay = (again + share) / (float((others > 1).sum()) + again + 1)
    runs = min(1.0 + float((others >= n).sum()), samples * share * stay ** (n - 2))
    return runs * min(1.0, 2.0 * (1.0 + float((changes >= leap).sum() - 1)) / changes.size)
