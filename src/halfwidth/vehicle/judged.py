"""What a log is found to have wrong, in the order in which it is put right: one judgement for `fill` and `check`.

First what the sensors say against themselves and against the fixes, which needs no model (`sensed`). Then, of a log
whose doubtful fixes are left out, when its rows were taken and what its sensors are like (`judged`). Which fixes dead
reckoning contradicts comes last (`strays`).
"""

from dataclasses import dataclass

from halfwidth.vehicle.adrift import adrift, moved
from halfwidth.vehicle.adrift import words as adrift_words
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.lapse import Lapse, put_right
from halfwidth.vehicle.lapse import words as lapse_words
from halfwidth.vehicle.lapses import lapses
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.pieces import with_pauses_filled
from halfwidth.vehicle.sensors import Calibration
from halfwidth.vehicle.spikes import Spikes, spikes
from halfwidth.vehicle.stamps import Stamps, restamped
from halfwidth.vehicle.stray import Strays


@dataclass(frozen=True, eq=False)
class Sensed:
    """What the sensors of a log say that cannot be.

    Parameters
    ----------
    spikes : Spikes or None
        Speeds and yaw rates that leap away and come back, of the log as given; None where they were not looked for.
    far : float or None
        By how many seconds the sensors' clock is far off.
    clocked : Log
        The log without its spikes and on one clock, before its lapses are put right.
    lapses : tuple of Lapse
        Stretches in which speed or yaw rate contradict the fixes.
    log : Log
        With all of that put right or left out.
    messages : tuple of str
        What a reader of a track must know.
    """

    spikes: Spikes | None
    far: float | None
    clocked: Log
    lapses: tuple[Lapse, ...]
    log: Log
    messages: tuple[str, ...]


def sensed(log: Log, *, clock: bool = True, distrust: bool = True) -> Sensed:
    """Look for what the sensors of a log say that cannot be, and put it right.

    Parameters
    ----------
    log : Log
    clock : bool
        Whether the sensors' clock is asked for; else it is known.
    distrust : bool
        Whether spikes and lapses are looked for.

    Returns
    -------
    Sensed
    """
    leaps = spikes(log) if distrust else None
    messages = [] if leaps is None else leaps.words(log)
    log = log if leaps is None else leaps.masked(log)
    far = adrift(log) if clock else None
    clocked = log if far is None else moved(log, far)
    messages += [] if far is None else [adrift_words(far)]
    lapsed = tuple(lapses(clocked)) if distrust else ()
    messages += lapse_words(clocked, lapsed)
    return Sensed(leaps, far, clocked, lapsed, put_right(clocked, lapsed), tuple(messages))


@dataclass(frozen=True, eq=False)
class Judged:
    """A log at the times at which its sensors spoke, and what these are like.

    Parameters
    ----------
    log : Log
        On the clock of its fixes, with rows where it pauses.
    stamps : Stamps
        Which times of the log as written its times are.
    sensors : Calibration
    messages : tuple of str
        What a reader of a track must know.
    """

    log: Log
    stamps: Stamps
    sensors: Calibration
    messages: tuple[str, ...]


def judged(log: Log, *, offset: float | None = None, stamped: bool = False) -> Judged:
    """Judge a log whose doubtful fixes are left out.

    Parameters
    ----------
    log : Log
    offset : float, optional
        Seconds to add to the stamps of the sensors; found from the log if absent.
    stamped : bool
        Whether the stamps of the log are kept: another log is on the same clock.

    Returns
    -------
    Judged
    """
    stamps = Stamps(log.t, log.t)
    if not stamped:
        log, stamps = restamped(log)
    messages = list(filter(None, [stamps.words()]))
    log = with_pauses_filled(log, messages)
    sensors = calibrated(log, clock_offset=offset)
    return Judged(log, stamps, sensors, (*messages, *sensors.words()))


@dataclass(frozen=True, eq=False)
class Findings:
    """What `fill` found in a log when nothing of it was told: `check` finds the same.

    Parameters
    ----------
    sensed : Sensed
    judged : Judged
    grid : Grid
        With all fixes that are not doubtful.
    stray : Strays
        Those of them that lie where the vehicle cannot have been.
    """

    sensed: Sensed
    judged: Judged
    grid: Grid
    stray: Strays
