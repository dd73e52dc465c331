"""A filled track: one position, half-width and quality for every row that could have had a fix.

A `Track` is the answer of `halfwidth.vehicle.fill` and the only thing that is written, drawn and
reported. It holds arrays on one row axis, the gaps that were filled, the log it came from and what
is needed to reproduce it; it is a value and never changes. The half-widths are those of the
interval at `level`, separately for east and north: the position that the receiver would have
reported is claimed to lie within ``lat, lon`` plus or minus ``east_half_m, north_half_m`` with that
probability (or certainly, where `guarantee` is ``"proven"``). How far off the receiver itself is, for
minutes at a time, is `Track.slow_m`; with it the interval is about the truth: `Track.truth_half_m`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import NormalDist
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.errors import BadShape, BadValue
from halfwidth.vehicle.log import Log, to_frame

if TYPE_CHECKING:
    import os
    from datetime import datetime

    from halfwidth.vehicle.judged import Findings
    from halfwidth.vehicle.proven import Proven

Floats = NDArray[np.float64]

#: What a row can be: a row with a fix, a row between two fixes, a row before the first fix or after
#: the last one.
QUALITIES: tuple[str, ...] = ("fix", "bridged", "extrapolated")

#: What kind of bound the half-widths are, and the sentence that says so.
GUARANTEES: Mapping[str, str] = MappingProxyType(
    {
        "proven": "a proven bound: it holds whenever the noise stays within the stated half-widths",
        "credible": "a credible interval: a probability under the fitted model, not a guarantee",
        "none": "an indication of size only: no probability is claimed",
    }
)

#: Columns of a track as a table, in order, and the field each one comes from.
COLUMNS: tuple[str, ...] = (
    "t_s",
    "lat_deg",
    "lon_deg",
    "alt_m",
    "azimuth_rad",
    "speed_mps",
    "east_half_m",
    "north_half_m",
    "quality",
    "since_fix_s",
)

#: Columns that may be unknown (NaN): what no stream of the log told.
_MAY_BE_MISSING = ("alt_m", "azimuth_rad", "speed_mps", "since_fix_s")


@dataclass(frozen=True, slots=True)
class Gap:
    """A stretch of the track without fixes.

    Parameters
    ----------
    start, stop : float
        Time of the last fix before and of the first fix after it, in seconds; the first or last row
        of the track where there is no such fix.
    duration_s : float
        ``stop - start`` in seconds.
    distance_m : float
        Length of the filled path between the two, in metres.
    max_half_m : float
        Largest half-width in the gap, east or north, in metres.
    quality : {"bridged", "extrapolated"}
        Whether there are fixes on both sides or on one only.
    """

    start: float
    stop: float
    duration_s: float
    distance_m: float
    max_half_m: float
    quality: str


@dataclass(frozen=True, eq=False)
class Track:
    """Where the vehicle was, and how well that is known.

    Parameters
    ----------
    t_s : (M,) array
        Time in seconds on the log's clock, strictly increasing.
    lat_deg, lon_deg : (M,) arrays
        Position in degrees of WGS-84, never NaN.
    alt_m : (M,) array
        Height in metres as the log gives it; NaN where unknown.
    azimuth_rad : (M,) array
        Direction of travel in radians, clockwise from north; NaN where unknown.
    speed_mps : (M,) array
        Speed in metres per second; NaN where unknown.
    east_half_m, north_half_m : (M,) arrays
        Half-widths of the interval at `level` in metres, finite and not negative.
    quality : (M,) array of str
        ``"fix"``, ``"bridged"`` or ``"extrapolated"``, row by row.
    since_fix_s : (M,) array
        Seconds since the last fix, 0 on a fix; NaN before the first one.
    level : float
        Probability of the intervals, between 0 and 1.
    method : str
        Name of the estimator that filled the gaps.
    log : Log
        The log that was filled, as it was given: with what the messages say was left out or put right.
    gaps : tuple of Gap
        The stretches that were filled; see `gaps_of`.
    guarantee : {"proven", "credible", "none"}
        What kind of bound the half-widths are.
    benchmark : object, optional
        Outage benchmark of this very log, as `halfwidth.vehicle.outages` returns it.
    settings : mapping of str to object
        Every setting that was used, given or found from the log.
    messages : tuple of str
        What a reader of the track must know.
    native : {"pandas", "polars", "pyarrow"}
        The library whose frame `frame` returns: that of the frame that came in.
    slow_m : (M, 2) array, optional
        How far the receiver itself is off the truth, east and north, as a standard deviation in metres: what all fixes
        around a row share. The half-widths say where the receiver would have seen the vehicle; they do not have it.
    proven : Proven, optional
        A band of its own from declared half-widths, in columns of its own; never part of the half-widths.
    found : Findings, optional
        What was found in the log, so that a report need not look for it again.

    Raises
    ------
    BadShape
        If the arrays differ in length.
    BadValue
        If a position or half-width is not finite, or a quality is not one of the three.
    """

    t_s: Floats
    lat_deg: Floats
    lon_deg: Floats
    alt_m: Floats
    azimuth_rad: Floats
    speed_mps: Floats
    east_half_m: Floats
    north_half_m: Floats
    quality: NDArray[np.str_]
    since_fix_s: Floats
    level: float
    method: str
    log: Log
    gaps: tuple[Gap, ...] = ()
    guarantee: str = "credible"
    benchmark: Any = None
    settings: Mapping[str, object] = field(default_factory=dict)
    messages: tuple[str, ...] = ()
    native: str = "pandas"
    proven: "Proven | None" = None
    slow_m: Floats | None = None
    found: "Findings | None" = field(default=None, repr=False)

    def __post_init__(self) -> None:
        t = _column("t_s", self.t_s, None)
        object.__setattr__(self, "t_s", t)
        if t.size == 0:
            raise BadShape("`t_s` is empty, at least one row is expected")
        if not (np.diff(t) > 0).all():
            row = int(np.flatnonzero(~(np.diff(t) > 0))[0]) + 1
            raise BadValue(
                f"`t_s` goes from {t[row - 1]:.10g} s to {t[row]:.10g} s in row {row}, strictly"
                " increasing times are expected"
            )
        for name in COLUMNS[1:]:
            if name != "quality":
                object.__setattr__(self, name, _column(name, getattr(self, name), t.size))
        quality = np.array(self.quality, dtype=np.str_)
        if quality.shape != t.shape:
            raise BadShape(f"`quality` has shape {quality.shape} but `t_s` has {t.size} rows")
        strange = ~np.isin(quality, QUALITIES)
        if strange.any():
            raise BadValue(f"`quality` holds {str(quality[strange][0])!r}, one of {', '.join(QUALITIES)} is expected")
        quality.setflags(write=False)
        object.__setattr__(self, "quality", quality)
        for name in ("east_half_m", "north_half_m"):
            if (getattr(self, name) < 0).any():
                row = int(np.flatnonzero(getattr(self, name) < 0)[0])
                raise BadValue(
                    f"`{name}` is {getattr(self, name)[row]:.6g} m in row {row}, a half-width is not negative"
                )
        if not 0 < self.level < 1:
            raise BadValue(f"`level` is {self.level}, between 0 and 1 is expected", hint="level=0.9")
        if self.guarantee not in GUARANTEES:
            raise BadValue(f"`guarantee` is {self.guarantee!r}, one of {', '.join(GUARANTEES)} is expected")
        if self.slow_m is not None:
            slow = np.array(self.slow_m, dtype=np.float64)
            if slow.shape != (t.size, 2):
                raise BadShape(f"`slow_m` has shape {slow.shape}, ({t.size}, 2) is expected")
            if not (np.isfinite(slow).all() and (slow >= 0).all()):
                raise BadValue(
                    "`slow_m` holds a number that is not finite or negative, a standard deviation is neither"
                )
            slow.setflags(write=False)
            object.__setattr__(self, "slow_m", slow)
        if self.proven is not None and self.proven.proven_west_m.shape != t.shape:
            raise BadShape(f"`proven` has {self.proven.proven_west_m.size} rows but `t_s` has {t.size}")
        object.__setattr__(self, "gaps", tuple(self.gaps))
        object.__setattr__(self, "messages", tuple(str(message) for message in self.messages))
        object.__setattr__(self, "settings", MappingProxyType(dict(self.settings)))

    def __len__(self) -> int:
        """Count the rows."""
        return int(self.t_s.size)

    def __repr__(self) -> str:
        """Say what was filled."""
        return self.summary()

    @property
    def half_m(self) -> Floats:
        """(M,) array: the larger of the two half-widths, in metres."""
        larger: Floats = np.maximum(self.east_half_m, self.north_half_m)
        return larger

    @property
    def truth_half_m(self) -> Floats | None:
        """(M, 2) array: half-widths, east and north, about where the vehicle was, in metres; None if not known.

        Those of the receiver's position and `slow_m` at the same level, as independent errors:
        sqrt(half^2 + (z slow)^2). They rest on a model of the receiver's error, that it lasts for about two minutes,
        and nothing in a log can test that.
        """
        if self.slow_m is None:
            return None
        z = NormalDist().inv_cdf(0.5 + self.level / 2)
        half = np.column_stack((self.east_half_m, self.north_half_m))
        return np.asarray(np.hypot(half, z * self.slow_m))

    @property
    def proven_columns(self) -> dict[str, Floats]:
        """The columns of the guaranteed band, in metres from the position; none without it."""
        return {} if self.proven is None else self.proven.columns

    def rows_of(self, gap: Gap) -> tuple[int, int]:
        """Find the rows of a gap, the fixes at its ends included: first row, row after the last."""
        first = min(int(np.searchsorted(self.t_s, gap.start)), self.t_s.size - 1)
        return first, max(int(np.searchsorted(self.t_s, gap.stop, side="right")), first + 1)

    def frame(self, native: str | None = None) -> Any:
        """Give the track as a data frame.

        Parameters
        ----------
        native : {"pandas", "polars", "pyarrow"}, optional
            The library whose frame is wanted; without it that of the frame that came in.

        Returns
        -------
        DataFrame or Table
            The columns ``t_s, lat_deg, lon_deg, alt_m, azimuth_rad, speed_mps, east_half_m,
            north_half_m, quality, since_fix_s``, and those of `proven` where there is one.

        Raises
        ------
        Missing
            If that library is not installed.
        """
        columns = {name: getattr(self, name) for name in COLUMNS}
        columns["quality"] = self.quality.astype(object)
        columns.update(self.proven_columns)
        return to_frame(columns, self.native if native is None else native)

    def write(
        self,
        path: "str | os.PathLike[str]",
        *,
        format: str | None = None,  # noqa: A002 - the word users look for
        start: "datetime | str | float | None" = None,
    ) -> Path:
        """Write the track, in the format that the ending of the path names.

        Parameters
        ----------
        path : str or path
            Ends in ``.csv``, ``.csv.gz``, ``.parquet``, ``.gpx``, ``.geojson`` or ``.kml``; ``-``
            is standard output. The file is replaced in one step: it is never half written.
        format : str, optional
            The ending to go by instead, such as ``"gpx"``.
        start : datetime, str or float, optional
            Absolute time of ``t_s = 0`` for GPX, GeoJSON and KML: a datetime, an ISO 8601 text or
            Unix seconds. Without it the log's own; a log that has none counts from
            1970-01-01T00:00:00Z, and the file says so.

        Returns
        -------
        Path
            Where it was written.

        Raises
        ------
        BadValue
            If the ending is not known.
        Missing
            If a library for the format is not installed.
        OSError
            If the file cannot be written; what was there before is still there.
        """
        from halfwidth.vehicle.write import write

        return write(self, path, format=format, start=start)

    def report(self, path: "str | os.PathLike[str]", *, command: str | None = None) -> Path:
        """Write the report: one HTML page that opens without a network.

        Parameters
        ----------
        path : str or path
            Where to; ``-`` is standard output. The file is replaced in one step.
        command : str, optional
            The command that made this track, to be shown as the way to reproduce it.

        Returns
        -------
        Path
            Where it was written.
        """
        from halfwidth.vehicle.report import write_report

        return write_report(self, path, command=command)

    def verdict(self) -> str:
        """Say in plain words what was filled and how well it is known."""
        from halfwidth.vehicle.report import verdict

        return verdict(self)

    def summary(self) -> str:
        """Give the track in at most twelve lines of text."""
        rows = {name: int(np.count_nonzero(self.quality == name)) for name in QUALITIES}
        lines = [
            f"Track of {self.log.source or 'a log'}: {self.t_s.size} rows over"
            f" {self.t_s[-1] - self.t_s[0]:.1f} s, method {self.method}",
            "  " + ", ".join(f"{count} {name}" for name, count in rows.items() if count),
            f"  half-widths at level {self.level:g}, {GUARANTEES[self.guarantee]}",
        ]
        if self.proven is not None:
            half = self.proven.half_m
            wide = f"at most {half.max():.1f} m" if np.isfinite(half).all() else "without end in places"
            lines.append(f"  guaranteed band, half-width {wide}: {self.proven.words}")
        if self.gaps:
            lines.append("  gap         from s      to s   length s  distance m  half-width m")
            shown = sorted(self.gaps, key=lambda gap: -gap.max_half_m)[: 7 - (self.proven is not None)]
            lines += [
                f"  {gap.quality:<12}{gap.start:>7.1f}{gap.stop:>10.1f}{gap.duration_s:>11.1f}"
                f"{gap.distance_m:>12.{0 if gap.distance_m >= 10 else 1}f}{gap.max_half_m:>14.2f}"
                for gap in sorted(shown, key=lambda gap: gap.start)
            ]
            if len(self.gaps) > len(shown):
                lines.append(f"  and {len(self.gaps) - len(shown)} gaps with smaller half-widths")
        else:
            lines.append("  no gaps: every row has a fix")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """Give a small table and map for notebooks."""
        from halfwidth.vehicle.report import notebook

        return notebook(self)


def since_fix_of(t_s: ArrayLike, quality: ArrayLike) -> Floats:
    """Count the seconds since the last fix.

    Parameters
    ----------
    t_s : (M,) array
        Times in seconds.
    quality : (M,) array of str
        Quality of each row.

    Returns
    -------
    (M,) array
        0 on a fix, NaN before the first one.
    """
    t = np.asarray(t_s, dtype=np.float64)
    fixed = np.asarray(quality) == "fix"
    last = np.maximum.accumulate(np.where(fixed, np.arange(t.size), -1))
    return np.where(last >= 0, t - t[np.maximum(last, 0)], np.nan)


def gaps_of(
    t_s: ArrayLike,
    lat_deg: ArrayLike,
    lon_deg: ArrayLike,
    half_m: ArrayLike,
    quality: ArrayLike,
    *,
    at_least_s: float = 0.0,
) -> tuple[Gap, ...]:
    """Find the stretches of a track that have no fix.

    Parameters
    ----------
    t_s, lat_deg, lon_deg : (M,) arrays
        Time in seconds and position in degrees.
    half_m : (M,) array
        Half-width in metres, the larger of east and north.
    quality : (M,) array of str
        Quality of each row.
    at_least_s : float
        Shorter stretches are left out.

    Returns
    -------
    tuple of Gap
        In the order of time.
    """
    t, half = np.asarray(t_s, dtype=np.float64), np.asarray(half_m, dtype=np.float64)
    path = np.r_[0.0, np.cumsum(steps_m(lat_deg, lon_deg))]
    gaps = []
    for first, stop, kind in runs(np.asarray(quality) == "fix"):
        if kind:
            continue
        a, b = max(first - 1, 0), min(stop, t.size - 1)
        if t[b] - t[a] < at_least_s:
            continue
        gaps.append(
            Gap(
                start=float(t[a]),
                stop=float(t[b]),
                duration_s=float(t[b] - t[a]),
                distance_m=float(path[b] - path[a]),
                max_half_m=float(half[first:stop].max()),
                quality="bridged" if first > 0 and stop < t.size else "extrapolated",
            )
        )
    return tuple(gaps)


def runs(values: NDArray[Any]) -> list[tuple[int, int, Any]]:
    """Split a vector into runs of equal values: (first row, row after the last, value)."""
    edges = np.flatnonzero(values[1:] != values[:-1]) + 1
    starts = [0, *edges.tolist()]
    stops = [*edges.tolist(), values.size]
    return [(a, b, values[a]) for a, b in zip(starts, stops, strict=True) if b > a]


def steps_m(lat_deg: ArrayLike, lon_deg: ArrayLike) -> Floats:
    """Measure the distance from each position to the next, in metres.

    Local radii of the WGS-84 ellipsoid at the middle of each step; the error is below 1e-6 of a
    step of less than ten kilometres.

    Parameters
    ----------
    lat_deg, lon_deg : (M,) arrays
        Positions in degrees.

    Returns
    -------
    (M - 1,) array
        Distances in metres.
    """
    lat, lon = np.radians(np.asarray(lat_deg, float)), np.radians(np.asarray(lon_deg, float))
    middle = (lat[1:] + lat[:-1]) / 2
    meridian, normal = radii_m(middle)
    turn = np.mod(np.diff(lon) + np.pi, 2 * np.pi) - np.pi  # the short way round the date line
    distance: Floats = np.hypot(meridian * np.diff(lat), normal * np.cos(middle) * turn)
    return distance


def radii_m(lat_rad: ArrayLike) -> tuple[Floats, Floats]:
    """Give the radii of curvature of WGS-84 along the meridian and across it, in metres."""
    axis, eccentricity2 = 6378137.0, 6.69437999014e-3
    shrink = 1 - eccentricity2 * np.sin(lat_rad) ** 2
    return axis * (1 - eccentricity2) / shrink**1.5, axis / np.sqrt(shrink)


def _column(name: str, values: ArrayLike, rows: int | None) -> Floats:
    """Copy to a read-only float64 vector of the right length, finite where it must be."""
    array = np.array(values, dtype=np.float64)
    if array.ndim != 1 or (rows is not None and array.size != rows):
        expected = "one value a row" if rows is None else f"({rows},) as `t_s`"
        raise BadShape(f"`{name}` has shape {array.shape}, {expected} is expected")
    wrong = np.isinf(array) if name in _MAY_BE_MISSING else ~np.isfinite(array)
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        raise BadValue(f"`{name}` is {array[row]} in row {row}, a finite number is expected")
    array.setflags(write=False)
    return array
