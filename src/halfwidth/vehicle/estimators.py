"""The estimators of a drive, by name: from the straight line to the chain that learns its own noise.

Each takes drives that were put on a `Grid`, several at once, and returns a `Path` for each. What it needs to know of
the log (noise levels of the Gaussian models) it learns in `tune`, once a log, by likelihood; nothing is set by hand.

============= ==================================================================================================
linear        straight line from fix to fix
cv            constant velocity, Rauch-Tung-Striebel smoother
gpsins        the linear GPS/INS model of Pavelková (2011) with that smoother, acceleration from speed and azimuth
ctrv          constant turn rate and velocity, extended Kalman smoother, with speed scale and yaw bias
em            the chain of `halfwidth.vehicle.chain`, the default of `fill`
em-slow       the same, the fix error a Gaussian offset without drift and jumps
em-white      the same, the fix error white noise
ep            the posterior of that chain where noise is partly bounded: half-widths by evidence (`credible`)
slp           the same with bounded noise by sequential linear programming, central point (`bounded`)
slp-white     the same, the fix error without an offset
slp-log       that with the logarithmic objective
cvar          slp-white that counts the mean of the worst rows in place of the worst one, how many by masking
tube          the centre of the set of all paths within learnt half-widths, inflated by masking (`tube`)
paper000      GPS/INS by linear programming, half-widths unknown, as printed in Pavelková (2011)
paper000+ls   the same, least squares inside the optimal half-widths
paper002      GPS and CAN of Pavelková's slides: nonlinear, two antennas or one, logarithmic objective, floors
paper002-3d   the same with altitude and pitch
paper002lin   its linearised model with one antenna, middle azimuth, least squares inside the optimal half-widths
============= ==================================================================================================
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadValue
from halfwidth.result import Status
from halfwidth.vehicle import antennas, bounded, chain, credible, simple, tube
from halfwidth.vehicle.antennas import TwoAntennas
from halfwidth.vehicle.frames import wrapped
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path
from halfwidth.vehicle.roads import Streets

Floats = NDArray[np.float64]
Tuned = Mapping[str, float]

_NOTHING: Tuned = MappingProxyType({})


@dataclass(frozen=True)
class Method:
    """A way to estimate a drive.

    Parameters
    ----------
    name : str
    about : str
        What it is, in a few words.
    context : float
        Seconds of data it gets on each side of an outage in the benchmark.
    needs : tuple of str
        Sensors it cannot do without: ``"speed"``, ``"yaw_rate"``.
    one_of : tuple of str
        Sensors of which it needs one.
    again : function (drives, paths, tuned) -> list of Path, optional
        Fills the same drives with fixes hidden, with what their paths with all fixes have learnt; `run`, which learns
        again, if absent.
    afresh : function (drives, paths, tuned) -> list of Path, optional
        The same where sensors are hidden as well, which the paths must not tell; `run` if absent.
    run : function (drives, tuned) -> list of Path
    tune : function (drive) -> mapping
        What it learns from the whole log, once.
    """

    name: str
    about: str
    context: float
    needs: tuple[str, ...]
    run: Callable[[Sequence[Grid], Tuned], list[Path]]
    tune: Callable[[Grid], Tuned] = lambda drive: _NOTHING  # noqa: ARG005
    one_of: tuple[str, ...] = ()
    again: Callable[[Sequence[Grid], Sequence[Path], Tuned], list[Path]] | None = None
    afresh: Callable[[Sequence[Grid], Sequence[Path], Tuned], list[Path]] | None = None

    def lacks(self, drive: Grid) -> str | None:
        """Return in words the sensor that the drive does not have, or None."""
        there = {"speed": drive.has_speed, "yaw_rate": drive.has_yaw_rate}
        missing = [name for name in self.needs if not there[name]]
        if not missing and self.one_of and not any(there[name] for name in self.one_of):
            missing = [" or ".join(self.one_of)]
        return missing[0].replace("_", " ") if missing else None


def method(name: str) -> Method:
    """Return an estimator by its name.

    Raises
    ------
    BadValue
        If there is none of this name.
    """
    if name not in METHODS:
        raise BadValue(f"`method` is {name!r}, one of {', '.join(METHODS)} is expected")
    return METHODS[name]


# ---- two antennas ----------------------------------------------------------------------------------------------------


def antennas_by(settings: TwoAntennas) -> Callable[[Sequence[Grid], Tuned], list[Path]]:
    """Return the two-antenna estimator with these settings, as a method runs it."""
    return lambda drives, tuned: antennas.solve(drives, settings)  # noqa: ARG005


def with_limits(asked: Method | None, limits: Mapping[str, Any] | None, roads: Streets | None) -> Method:
    """Return a method that keeps the track within limits and on roads: the two-antenna one, in 3D if asked for.

    Raises
    ------
    BadValue
        If another method was asked for, a limit is none, or is of altitude or pitch in two dimensions.
    """
    held = antennas.limits_of(limits or {})
    high = [name for name in ("altitude", "pitch") if name in held]
    chosen = METHODS["paper002-3d" if high else "paper002"] if asked is None else asked
    if chosen.name not in ("paper002", "paper002-3d"):
        raise BadValue(
            f"`method` is {chosen.name!r}, but limits, a map and a second antenna are for the two-antenna model",
            hint='method="paper002"',
        )
    if high and chosen.name == "paper002":
        raise BadValue(f"`limits` has {high[0]!r}, which `paper002` does not estimate", hint='method="paper002-3d"')
    settings = TwoAntennas(height=chosen.name == "paper002-3d", limits=held, roads=roads)
    return replace(chosen, run=antennas_by(settings))


# ---- the chain -----------------------------------------------------------------------------------------------------


def _chain(settings: chain.Chain) -> Callable[[Sequence[Grid], Tuned], list[Path]]:
    return lambda drives, tuned: [fit.path for fit in chain.solve(drives, settings)]  # noqa: ARG005


def _bounded(settings: bounded.Bounded) -> Callable[[Sequence[Grid], Tuned], list[Path]]:
    return lambda drives, tuned: bounded.solve(drives, settings)  # noqa: ARG005


def _bounded_again(settings: bounded.Bounded) -> Callable[[Sequence[Grid], Sequence[Path], Tuned], list[Path]]:
    return lambda drives, paths, tuned: bounded.again(drives, paths, settings)  # noqa: ARG005


def _worst_share(tuned: Tuned) -> bounded.Bounded:
    return bounded.Bounded(slow=False, nu=tuned["nu"] or None)


def _tube(tuned: Tuned) -> tube.Tube:
    return tube.Tube(inflation=tuned["inflation"])


#: What the chain may take the error of a fix for; the first is the usual one.
COLOURS: Mapping[str, chain.Chain] = MappingProxyType(
    {
        "em": chain.Chain(),
        "em-slow": chain.Chain(tail=np.inf, drifting=False),
        "em-white": chain.Chain(slow=False),
    }
)

_SENSORS = ("speed", "yaw_rate")

#: All estimators, in the order of their tables.
METHODS: Mapping[str, Method] = MappingProxyType(
    {
        m.name: m
        for m in (
            Method("linear", "straight lines between fixes", 20.0, (), simple.straight_lines),
            Method(
                "cv",
                "constant velocity, RTS smoother",
                20.0,
                (),
                simple.smoothed(False),
                simple.tuned_by_likelihood(False),
            ),
            Method(
                "gpsins",
                "linear GPS/INS, RTS smoother",
                20.0,
                _SENSORS,
                simple.smoothed(True),
                simple.tuned_by_likelihood(True),
            ),
            Method(
                "ctrv", "constant turn rate and velocity, EKF + RTS", 20.0, _SENSORS, simple.turning, simple.tuned_ctrv
            ),
            *(
                Method(
                    name, f"chain that learns its own noise{words}", 60.0, (), _chain(COLOURS[name]), one_of=_SENSORS
                )
                for name, words in (("em", ""), ("em-slow", ", slow fix error"), ("em-white", ", white fix error"))
            ),
            Method(
                "ep",
                "posterior of the chain, noise partly bounded",
                60.0,
                (),
                lambda drives, tuned: credible.solve(drives),  # noqa: ARG005
                one_of=_SENSORS,
                again=lambda drives, paths, tuned: credible.again(drives, paths),  # noqa: ARG005
            ),
            *(
                Method(
                    name,
                    f"chain with bounded noise{words}",
                    20.0,
                    (),
                    _bounded(settings),
                    one_of=_SENSORS,
                    again=_bounded_again(settings),
                )
                for name, words, settings in (
                    ("slp", "", bounded.Bounded()),
                    ("slp-white", ", no fix offset", bounded.Bounded(slow=False)),
                    ("slp-log", ", log objective", bounded.Bounded(objective="log", slow=False)),
                )
            ),
            Method(
                "cvar",
                "chain with bounded noise, mean of the worst rows",
                20.0,
                (),
                lambda drives, tuned: bounded.solve(drives, _worst_share(tuned)),
                lambda drive: {"nu": bounded.nu_of(drive, bounded.Bounded(slow=False)) or 0.0},
                one_of=_SENSORS,
                again=lambda drives, paths, tuned: bounded.again(drives, paths, _worst_share(tuned)),
            ),
            Method(
                "tube",
                "centre of the tube of bounded noise",
                20.0,
                (),
                lambda drives, tuned: tube.solve(drives, _tube(tuned)),
                lambda drive: {"inflation": tube.inflation_of(drive)},
                one_of=_SENSORS,
                again=lambda drives, paths, tuned: tube.again(drives, paths, _tube(tuned)),
                afresh=lambda drives, paths, tuned: tube.again(drives, paths, _tube(tuned), afresh=True),
            ),
            Method(
                "paper000",
                "GPS/INS by linear programming, as printed",
                10.0,
                _SENSORS,
                simple.programme(simple.gps_ins, objective="paper", point="optimal"),
            ),
            Method(
                "paper000+ls",
                "the same, least squares inside the optimal half-widths",
                10.0,
                _SENSORS,
                simple.programme(simple.gps_ins, objective="paper", point="least_squares"),
            ),
            Method("paper002", "two-antenna GPS/CAN model, MAP", 10.0, _SENSORS, antennas_by(TwoAntennas())),
            Method(
                "paper002-3d",
                "the same with altitude and pitch",
                10.0,
                _SENSORS,
                antennas_by(TwoAntennas(height=True)),
            ),
            Method(
                "paper002lin",
                "linearised two-antenna model, one antenna, least squares",
                10.0,
                _SENSORS,
                simple.programme(simple.two_antenna, point="least_squares"),
            ),
        )
    }
)


def heading_of(path: Path) -> Floats:
    """Return the azimuth of a path in (-pi, pi]; where the method gave none, that of its motion."""
    if np.isfinite(path.azimuth).all() or path.t.size < 2:
        return wrapped(path.azimuth)
    east, north = np.gradient(path.east, path.t), np.gradient(path.north, path.t)
    return np.where(np.hypot(east, north) > 0.3, np.arctan2(east, north), np.nan)


def usable(path: Path) -> bool:
    """Whether a path can be shown: it has numbers, and its method did not give up."""
    return path.finite and path.status not in (Status.STALLED, Status.COLLAPSED)
