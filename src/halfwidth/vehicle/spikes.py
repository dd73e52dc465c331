"""Samples of speed and yaw rate that no car can have had: one or two that leap away and come back.

A broken telegram or a loose plug gives a speed of 120 m/s for a tenth of a second. It moves the path by metres, makes
the calibration of the sensor wrong, and is named by no test of fixes. A sample is a spike if it is further from the
median of itself and its four neighbours than a car can change in that time, and than ten times what is usual.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle.log import Log

Floats = NDArray[np.float64]

#: What a sample may differ by at once and what by more for each second, in units of the stream, and its name.
_LIMIT = {"speed_mps": (2.0, 12.0, "speed"), "yaw_rate_radps": (0.5, 3.0, "yaw rate")}

#: How many times the usual distance from the median is not usual; the share of samples that is no exception any more.
_UNUSUAL, _MANY = 10.0, 0.02

#: Samples looked at together.
_WINDOW = 5


@dataclass(frozen=True, eq=False)
class Spikes:
    """Which samples of a log are spikes.

    Parameters
    ----------
    rows : mapping of str to (n,) int array
        Rows by field of the log.
    """

    rows: dict[str, NDArray[np.intp]]

    def __len__(self) -> int:
        return sum(rows.size for rows in self.rows.values())

    def masked(self, log: Log) -> Log:
        """Return the log without these samples."""
        changed: dict[str, Any] = {}
        for name, rows in self.rows.items():
            values = getattr(log, name).copy()
            values[rows] = np.nan
            changed[name] = values
        return replace(log, **changed) if changed else log

    def words(self, log: Log) -> list[str]:
        """Say what was found, with times and sizes."""
        found = []
        for name, rows in self.rows.items():
            label, unit = _LIMIT[name][2], "m/s" if name == "speed_mps" else "rad/s"
            listed = ", ".join(f"{log.t[k]:.1f} s ({getattr(log, name)[k]:.3g} {unit})" for k in rows[:5].tolist())
            more = ", ..." if rows.size > 5 else ""
            some = "1 sample" if rows.size == 1 else f"{rows.size} samples"
            found.append(f"{some} of the {label} that no car can have had, at {listed}{more}: not used")
        return found


def spikes(log: Log) -> Spikes:
    """Find samples of speed and yaw rate that leap away and come back.

    Parameters
    ----------
    log : Log

    Returns
    -------
    Spikes
        None of a stream in which they are no exception.
    """
    found: dict[str, NDArray[np.intp]] = {}
    for name, (at_once, rate, _) in _LIMIT.items():
        rows = np.flatnonzero(np.isfinite(getattr(log, name)))
        if rows.size < 2 * _WINDOW:
            continue
        t, values = log.t[rows], getattr(log, name)[rows]
        edge = _WINDOW // 2
        around = np.lib.stride_tricks.sliding_window_view(np.pad(values, edge, mode="edge"), _WINDOW)
        times = np.lib.stride_tricks.sliding_window_view(np.pad(t, edge, mode="edge"), _WINDOW)
        off = np.abs(values - np.median(around, axis=1))
        far = off > at_once + rate * np.maximum(times[:, -1] - t, t - times[:, 0])
        spike = far & (off > _UNUSUAL * float(np.quantile(off, 0.9)))
        if 0 < spike.sum() <= max(1.0, _MANY * rows.size):
            found[name] = rows[spike]
    return Spikes(found)
