"""What a vehicle recorded: one value that every reader ends in.

A log is a set of streams (position, course, speed, yaw rate, acceleration), each with its own
clock. They are kept on one row axis, the union of all arrival times, with NaN where a stream has no
new sample: nothing is interpolated, and two streams share a row only when they carry the same time
stamp. Units are SI; latitude and longitude are degrees of WGS-84, because that is what every
receiver, map and track file speaks.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.errors import BadShape, BadValue

Floats = NDArray[np.float64]

#: Column names of a log as a table, in order, and the field each one fills.
COLUMNS: Mapping[str, str] = {
    "t_s": "t",
    "lat_deg": "lat_deg",
    "lon_deg": "lon_deg",
    "alt_m": "alt_m",
    "azimuth_rad": "azimuth_rad",
    "speed_mps": "speed_mps",
    "yaw_rate_radps": "yaw_rate_radps",
    "ax_mps2": "ax_mps2",
    "ay_mps2": "ay_mps2",
}

#: The streams: every field that may be missing.
STREAMS: tuple[str, ...] = tuple(name for name in COLUMNS.values() if name != "t")

#: What disappears in a tunnel: the position, and the course that the same receiver derives.
_FIX = ("lat_deg", "lon_deg", "alt_m", "azimuth_rad")

#: A pause between two fixes is a gap when it is this much longer than the usual one.
GAP_FACTOR = 1.5


def _nothing() -> Floats:
    return np.empty(0)


@dataclass(frozen=True, eq=False)
class Log:
    """Streams of one drive on one row axis, NaN where nothing arrived.

    Parameters
    ----------
    t : (N,) array
        Time in seconds, finite and strictly increasing.
    lat_deg, lon_deg : (N,) arrays
        Position in degrees of WGS-84; a row has both or neither.
    alt_m : (N,) array
        Height in metres, as the source gives it.
    azimuth_rad : (N,) array
        Course over ground in radians, clockwise from north.
    speed_mps : (N,) array
        Forward speed in metres per second; negative when driving backwards.
    yaw_rate_radps : (N,) array
        Yaw rate in radians per second, positive when turning left (counter-clockwise seen from
        above), so that ``d azimuth / dt = -yaw_rate``.
    ax_mps2, ay_mps2 : (N,) arrays
        Acceleration, x forward and y left.
    source : str
        Where the log came from: a path, ``"-"`` for standard input, ``"frame"``.
    notes : tuple of str
        What was recognised, repaired or dropped while reading, with counts.
    epoch_s : float, optional
        Unix time of ``t = 0`` where the source has absolute time; None where it has not.
    columns : mapping of str to str
        Which column of the source each role (time, lat, speed, ...) was read from.

    Raises
    ------
    BadShape
        If the streams differ in length from `t`.
    BadValue
        If `t` is not finite and strictly increasing, a stream holds an infinity, only one of
        latitude and longitude is there, or a position is off the Earth.

    Notes
    -----
    An absent stream may be left out; it is filled with NaN. All arrays are copied once and made
    read-only.

    Examples
    --------
    >>> log = Log(t=[0, 1, 2, 5], lat_deg=[50, 50, 50, 50], lon_deg=[14.0, 14.1, 14.2, 14.5])
    >>> log.gaps()
    [(2.0, 5.0)]
    """

    t: Floats
    lat_deg: Floats = field(default_factory=_nothing)
    lon_deg: Floats = field(default_factory=_nothing)
    alt_m: Floats = field(default_factory=_nothing)
    azimuth_rad: Floats = field(default_factory=_nothing)
    speed_mps: Floats = field(default_factory=_nothing)
    yaw_rate_radps: Floats = field(default_factory=_nothing)
    ax_mps2: Floats = field(default_factory=_nothing)
    ay_mps2: Floats = field(default_factory=_nothing)
    source: str = ""
    notes: tuple[str, ...] = ()
    epoch_s: float | None = None
    columns: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        t = _frozen("t", self.t)
        if not np.isfinite(t).all():
            row = int(np.flatnonzero(~np.isfinite(t))[0])
            raise BadValue(f"`t` is {t[row]} in row {row}, every row of a log needs a time")
        if t.size > 1 and not (np.diff(t) > 0).all():
            row = int(np.flatnonzero(np.diff(t) <= 0)[0]) + 1
            raise BadValue(
                f"`t` goes from {t[row - 1]:.10g} s to {t[row]:.10g} s in row {row}, strictly"
                " increasing times are expected",
                hint="`halfwidth.vehicle.from_frame` sorts rows and joins those with equal times",
            )
        object.__setattr__(self, "t", t)
        for name in STREAMS:
            given = getattr(self, name)
            values = _frozen(name, np.full(t.size, np.nan)) if np.size(given) == 0 else _frozen(name, given)
            if values.shape != t.shape:
                raise BadShape(
                    f"`{name}` has {values.size} rows but `t` has {t.size}, one value a row (NaN"
                    " where nothing arrived) is expected"
                )
            if np.isinf(values).any():
                row = int(np.flatnonzero(np.isinf(values))[0])
                raise BadValue(f"`{name}` is infinite in row {row}, a number or NaN is expected")
            object.__setattr__(self, name, values)
        if not np.array_equal(np.isnan(self.lat_deg), np.isnan(self.lon_deg)):
            row = int(np.flatnonzero(np.isnan(self.lat_deg) != np.isnan(self.lon_deg))[0])
            raise BadValue(f"row {row} has only one of `lat_deg` and `lon_deg`, both or neither are expected")
        for name, limit in (("lat_deg", 90.0), ("lon_deg", 360.0)):
            wrong = np.abs(getattr(self, name)) > limit
            if wrong.any():
                row = int(np.flatnonzero(wrong)[0])
                raise BadValue(
                    f"`{name}` is {getattr(self, name)[row]:.10g} in row {row}, at most {limit:g}"
                    " degrees either way are expected"
                )
        object.__setattr__(self, "source", str(self.source))
        object.__setattr__(self, "notes", tuple(str(note) for note in self.notes))
        if self.epoch_s is not None:
            object.__setattr__(self, "epoch_s", float(self.epoch_s))

    def __len__(self) -> int:
        """Count the rows."""
        return int(self.t.size)

    def __repr__(self) -> str:
        """Say in one line what is there."""
        there = ", ".join(name for name in STREAMS if np.isfinite(getattr(self, name)).any())
        length = self.t[-1] - self.t[0] if self.t.size else 0.0
        return (
            f"Log({self.source!r}: {self.t.size} rows, {length:.1f} s,"
            f" {int(self.fixed.sum())} fixes, streams: {there or 'none'})"
        )

    @property
    def fixed(self) -> NDArray[np.bool_]:
        """(N,) bool array: the rows that have a position."""
        seen: NDArray[np.bool_] = ~np.isnan(self.lat_deg)
        return seen

    def stream(self, name: str) -> tuple[Floats, Floats]:
        """Give one stream on its own clock.

        Parameters
        ----------
        name : str
            A field name such as ``"speed_mps"``, or ``"position"`` for latitude and longitude side
            by side.

        Returns
        -------
        t : (n,) array
            Arrival times in seconds.
        values : (n,) array, or (n, 2) array for ``"position"``
            What arrived, without NaN.

        Raises
        ------
        BadValue
            If there is no such stream.
        """
        if name == "position":
            seen = self.fixed
            return self.t[seen], np.column_stack((self.lat_deg[seen], self.lon_deg[seen]))
        if name not in STREAMS:
            raise BadValue(f"`name` is {name!r}, one of position, {', '.join(STREAMS)} is expected")
        values: Floats = getattr(self, name)
        seen = ~np.isnan(values)
        return self.t[seen], values[seen]

    def without(self, t0: float, t1: float) -> "Log":
        """Blank position, height and course between two times, both included: a tunnel.

        Parameters
        ----------
        t0, t1 : float
            First and last time of the outage, in seconds.

        Returns
        -------
        Log
            The same log with NaN there; speed, yaw rate and acceleration stay.

        Raises
        ------
        BadValue
            If `t0` is after `t1`.
        """
        if not t0 <= t1:
            raise BadValue(f"`t0` is {t0} s and `t1` is {t1} s, t0 <= t1 is expected")
        inside = (self.t >= t0) & (self.t <= t1)
        blank: dict[str, Any] = {name: np.where(inside, np.nan, getattr(self, name)) for name in _FIX}
        return replace(self, **blank)

    def gaps(self) -> list[tuple[float, float]]:
        """List the times between consecutive fixes that are further apart than usual.

        Returns
        -------
        list of (float, float)
            Time of the last fix before each gap and of the first one after it, in seconds. A pause
            is a gap when it is longer than 1.5 times the median interval between fixes. Rows before
            the first and after the last fix are not between fixes and are not listed.
        """
        t = self.t[self.fixed]
        if t.size < 2:
            return []
        step = np.diff(t)
        # the slack keeps rounding of time stamps (0.1 * 3 against 0.3) from making a gap
        wide = step > GAP_FACTOR * np.median(step) * (1 + 1e-9)
        return [(float(t[k]), float(t[k + 1])) for k in np.flatnonzero(wide)]

    def with_rows(self, times: ArrayLike) -> "Log":
        """Return the log with further rows at which nothing arrived, where a position is wanted.

        Parameters
        ----------
        times : (K,) array_like
            Times in seconds, none of them a time of the log.

        Raises
        ------
        BadValue
            If a time is not finite, or is one of the log already.
        """
        more = np.atleast_1d(np.asarray(times, dtype=np.float64))
        t = np.concatenate((self.t, more))
        order = np.argsort(t, kind="stable")
        streams: dict[str, Any] = {
            name: np.concatenate((getattr(self, name), np.full(more.size, np.nan)))[order] for name in STREAMS
        }
        return replace(self, t=t[order], **streams)

    def rates(self) -> dict[str, float | None]:
        """Give the usual rate of each stream.

        Returns
        -------
        dict of str to float or None
            One over the median interval between arrivals, in hertz, for ``"position"`` and every
            stream but latitude and longitude; None where fewer than two samples arrived.
        """
        rates: dict[str, float | None] = {}
        for name in ("position", *STREAMS[2:]):
            t = self.stream(name)[0]
            rates[name] = float(1 / np.median(np.diff(t))) if t.size > 1 else None
        return rates

    def frame(self, native: str = "pandas") -> Any:
        """Give the log as a data frame with the columns of `COLUMNS`.

        Parameters
        ----------
        native : {"pandas", "polars", "pyarrow"}
            The library whose frame is wanted; it must be installed.

        Returns
        -------
        DataFrame or Table
            One row per row of the log, NaN where nothing arrived.

        Raises
        ------
        BadValue
            If `native` is none of the three.
        Missing
            If that library is not installed.
        """
        return to_frame({column: getattr(self, name) for column, name in COLUMNS.items()}, native)


def to_frame(columns: Mapping[str, Any], native: str) -> Any:
    """Make a pandas, polars or pyarrow table of named columns."""
    from importlib import import_module

    from halfwidth.errors import Missing

    if native not in ("pandas", "polars", "pyarrow"):
        raise BadValue(f"`native` is {native!r}, one of pandas, polars, pyarrow is expected")
    try:
        library = import_module(native)
    except ImportError as error:
        raise Missing(f"`native` is {native!r} but {native} is not installed", hint=f"pip install {native}") from error
    table = {name: np.array(values) for name, values in columns.items()}
    return library.table(table) if native == "pyarrow" else library.DataFrame(table)


def _frozen(name: str, values: ArrayLike) -> Floats:
    """Copy to a read-only float64 vector."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BadValue(f"`{name}` holds something that is not a number ({error})") from error
    if array.ndim != 1:
        raise BadShape(f"`{name}` has shape {array.shape}, one value a row is expected")
    array.setflags(write=False)
    return array
