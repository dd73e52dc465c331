"""A stretch in which speed or yaw rate are not as the rest: what it is, how it is put right, and how it is said."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from halfwidth.vehicle.log import Log
from halfwidth.vehicle.rows import counted

_NAMES = {"speed_mps": "speed", "yaw_rate_radps": "yaw rate"}

#: What units are called by their factor.
_UNITS = {3.6: "km/h", 1 / 0.44704: "mph", 3600 / 1852: "knots", 180 / np.pi: "deg/s"}

#: Lapses of a stream that are said one by one.
_SAID = 5


@dataclass(frozen=True)
class Lapse:
    """A stretch of a stream that is not as the rest.

    Parameters
    ----------
    name : str
        Field of the log.
    first, last : int
        Its first and last row.
    reads : float
        What it reads of the truth in the stretch; 0 if it is silent, NaN if it has nothing to do with it.
    rest : float
        What it reads elsewhere.
    says : float
        What it says there at first.
    pace : float
        Median of what the fixes show there: speed, m/s, or yaw rate, rad/s.
    right : bool
        Whether it is put right; otherwise it is not used.
    """

    name: str
    first: int
    last: int
    reads: float
    rest: float
    says: float
    pace: float
    right: bool

    @property
    def factor(self) -> float:
        """What makes the stretch like the rest."""
        return self.rest / self.reads if self.right else float("nan")

    def words(self, log: Log) -> str:
        """Say what it is, with times."""
        label, t = _NAMES[self.name], log.t
        when = f"from {t[self.first]:.1f} s on" if self.last == len(log) - 1 else f"{t[self.last]:.1f} s"
        if self.last < len(log) - 1:
            when = f"from {t[self.first]:.1f} to {when}" if self.last > self.first else f"at {when}"
        if np.isnan(self.reads):
            return f"the {label} does not follow the turns that the fixes show: not used"
        if not self.reads:
            moves = f"the car goes {self.pace:.0f} m/s" if self.name == "speed_mps" else "the fixes turn"
            return f"the {label} says {self.says:.3g} {when} while {moves}: not used"
        ratio = self.reads / self.rest
        if self.name == "speed_mps" and ratio < 0:
            return "the speed is negative all along, and no car drives backwards like that: taken as positive"
        what = "what the fixes say" if self.rest == 1 else "what it reads elsewhere, as the fixes show,"
        units = [f"in {name}" for size, name in _UNITS.items() if abs(np.log(abs(ratio) / size)) < 1e-6]
        units += [f"{name} elsewhere" for size, name in _UNITS.items() if abs(np.log(abs(ratio) * size)) < 1e-6]
        units += ["turned round"] if ratio < 0 else []
        why = f" ({', '.join(units)})" if units and self.right else ""
        return f"the {label} reads {ratio:.3g} times {what} {when}{why}: " + ("put right" if self.right else "not used")


def put_right(log: Log, found: Sequence[Lapse]) -> Log:
    """Return a log with its lapses put right or left out."""
    changed: dict[str, Any] = {}
    for lapse in found:
        values = changed.setdefault(lapse.name, getattr(log, lapse.name).copy())
        values[lapse.first : lapse.last + 1] *= lapse.factor
    return replace(log, **changed) if changed else log


def words(log: Log, found: Sequence[Lapse]) -> list[str]:
    """Say what lapses are: the first ones of each stream, and of the others how many they are."""
    said: list[str] = []
    for name in _NAMES:
        for right, done in ((True, "put right"), (False, "not used")):
            own = [lapse for lapse in found if lapse.name == name and lapse.right == right]
            said += [lapse.words(log) for lapse in own[:_SAID]]
            if own[_SAID:]:
                when = f"from {log.t[own[_SAID].first]:.1f} to {log.t[own[-1].last]:.1f} s"
                more = counted(len(own) - _SAID, "more stretch")
                said.append(f"the {_NAMES[name]} contradicts the fixes in {more} {when}: {done}")
    return said
