"""Roads from a GeoJSON file, and where a position stands to them: the corridor that a track may be kept in.

A road is a line with a half-width. Of a position, what counts is the signed distance to the nearest road in units of
that road's half-width: within -1 and 1 the position is on the road. Near means near in place and in direction, so that
at a crossing the road that the vehicle drives along is taken and not the one it crosses:

    distance^2 + (20 m sin(azimuth - direction of the road))^2   is least
"""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.errors import BadValue
from halfwidth.vehicle.frames import Frame

Floats = NDArray[np.float64]

#: Half-width of a road that says nothing of its own, m: a carriageway, and what fixes are off by.
USUAL = 5.0

#: How much a road is further away that is at right angles to the way the vehicle goes, m.
_CROSSWISE = 20.0


class Nearest(NamedTuple):
    """Where positions stand to the roads near them.

    `offset` (n,) is the signed distance over the half-width, positive to the right of the line as it is drawn;
    `slope` (n, 2) its derivative by east and north, 1/m; `distance` and `half_width` (n,) are in metres.
    """

    offset: Floats
    slope: Floats
    distance: Floats
    half_width: Floats


@dataclass(frozen=True, eq=False)
class Roads:
    """Straight pieces of road in degrees of WGS-84.

    Parameters
    ----------
    start, stop : (n, 2) arrays
        Latitude and longitude of the ends of each piece.
    half_width : (n,) array
        Metres.

    Examples
    --------
    >>> line = {"type": "LineString", "coordinates": [[14.0, 50.0], [14.0, 50.01]]}
    >>> Roads.of({"type": "Feature", "geometry": line, "properties": {"width": 6}}).half_width
    array([3.])
    """

    start: Floats
    stop: Floats
    half_width: Floats

    @classmethod
    def read(cls, path: str | os.PathLike[str], *, usual: float = USUAL) -> "Roads":
        """Read a GeoJSON file; see `of`.

        Parameters
        ----------
        path : str or path
        usual : float
            As for `of`.

        Raises
        ------
        BadValue
            If the file cannot be read, is no GeoJSON or has no line.
        """
        try:
            with open(path, encoding="utf-8") as file:
                given = json.load(file)
        except OSError as error:
            words = (error.strerror or str(error)).lower()
            raise BadValue(f"the map `{os.fspath(path)}` cannot be read: {words}", hint="check the spelling") from error
        except (UnicodeDecodeError, json.JSONDecodeError) as error:
            raise BadValue(f"the map `{os.fspath(path)}` is no JSON: {error}", hint="a GeoJSON file") from error
        return cls.of(given, usual=usual)

    @classmethod
    def of(cls, given: Any, *, usual: float = USUAL) -> "Roads":
        """Take the lines of a GeoJSON object.

        Parameters
        ----------
        given : dict
            FeatureCollection, Feature or geometry. LineString and MultiLineString are taken, what else there is not.
        usual : float
            Half-width where a feature's properties have neither `half_width` nor `width`, both in metres.

        Raises
        ------
        BadValue
            If there is no line, a coordinate is off the Earth, or a width is not positive.
        """
        start, stop, half = [], [], []
        for line, width in _lines(given, usual):
            try:
                points = np.array([point[:2] for point in line], dtype=float)[:, ::-1]
            except (TypeError, ValueError, IndexError) as error:
                raise BadValue(f"a line of the map is {str(line)[:80]}, pairs of numbers are expected") from error
            if points.ndim != 2 or points.shape[1:] != (2,) or not np.isfinite(points).all():
                raise BadValue(f"a line of the map is {str(line)[:80]}, pairs of finite numbers are expected")
            if np.any(np.abs(points[:, 0]) > 90) or np.any(np.abs(points[:, 1]) > 360):
                raise BadValue(
                    f"a line of the map has a point off the Earth near {points[0, ::-1].tolist()}",
                    hint="coordinates are [longitude, latitude] in degrees",
                )
            ahead = np.any(np.diff(points, axis=0) != 0, axis=1)
            start.append(points[:-1][ahead])
            stop.append(points[1:][ahead])
            half.append(np.full(int(ahead.sum()), width))
        if not sum(len(one) for one in start):
            raise BadValue("the map has no line, a GeoJSON of LineStrings is expected")
        return cls(np.concatenate(start), np.concatenate(stop), np.concatenate(half))

    def local(self, frame: Frame) -> "Streets":
        """Return the roads in metres of a frame."""
        ends = [np.column_stack(frame.to_local(p[:, 0], p[:, 1])) for p in (self.start, self.stop)]
        return Streets(ends[0], ends[1] - ends[0], self.half_width)

    def __len__(self) -> int:
        return len(self.half_width)


@dataclass(frozen=True, eq=False)
class Streets:
    """Roads in local metres: where each piece starts, (n, 2), where it leads, (n, 2), and its half-width, (n,)."""

    start: Floats
    way: Floats
    half_width: Floats

    def nearest(self, east: ArrayLike, north: ArrayLike, azimuth: ArrayLike | None = None) -> Nearest:
        """Return where positions stand to the roads near them.

        Parameters
        ----------
        east, north : (n,) array_like
            Metres.
        azimuth : (n,) array_like, optional
            The way the vehicle goes, rad; without it the nearest road counts.
        """
        p = np.column_stack((np.atleast_1d(np.asarray(east, float)), np.atleast_1d(np.asarray(north, float))))
        to = p[:, None, :] - self.start  # (n, pieces, 2)
        length = np.hypot(self.way[:, 0], self.way[:, 1])
        along = np.clip(np.einsum("nkd,kd->nk", to, self.way) / length**2, 0.0, 1.0)
        off = to - along[..., None] * self.way
        score = off[..., 0] ** 2 + off[..., 1] ** 2
        if azimuth is not None:
            bearing = np.arctan2(self.way[:, 0], self.way[:, 1])
            turned = np.sin(np.atleast_1d(np.asarray(azimuth, float))[:, None] - bearing)
            score = score + (_CROSSWISE * turned) ** 2
        k = np.argmin(score, axis=1)
        rows = np.arange(len(p))
        away, way = off[rows, k], self.way[k] / length[k][:, None]
        right = np.column_stack((way[:, 1], -way[:, 0]))
        side = np.einsum("nd,nd->n", away, right)
        distance = np.hypot(away[:, 0], away[:, 1])
        # beyond an end the nearest point is the end itself, and the way to it may lead along the road
        inside = np.abs(side) >= distance * (1 - 1e-9)
        sign = np.where(side < 0, -1.0, 1.0)
        normal = np.where(inside[:, None], right, sign[:, None] * away / np.maximum(distance, 1e-300)[:, None])
        half = self.half_width[k]
        return Nearest(sign * distance / half, normal / half[:, None], distance, half)


def roads_of(given: Any) -> Roads:
    """Return roads from a path to a GeoJSON file, its content as a dict, or roads."""
    if isinstance(given, Roads):
        return given
    return Roads.read(given) if isinstance(given, str | os.PathLike) else Roads.of(given)


def _lines(given: Any, usual: float) -> Iterator[tuple[Any, float]]:
    """Yield each line of a GeoJSON object, as lists of [longitude, latitude], with its half-width."""
    kind = given.get("type") if isinstance(given, dict) else None
    if kind == "FeatureCollection":
        for feature in given.get("features") or ():
            yield from _lines(feature, usual)
    elif kind == "Feature":
        yield from _lines(given.get("geometry") or {"type": "GeometryCollection"}, _half_width(given, usual))
    elif kind == "GeometryCollection":
        for geometry in given.get("geometries") or ():
            yield from _lines(geometry, usual)
    elif kind == "LineString":
        yield given.get("coordinates") or (), usual
    elif kind == "MultiLineString":
        for line in given.get("coordinates") or ():
            yield line, usual
    elif not isinstance(kind, str):
        raise BadValue(
            f"the map is {str(given)[:60]!r}, a GeoJSON object is expected", hint='{"type": "LineString", ...}'
        )


def _half_width(feature: dict[str, Any], usual: float) -> float:
    properties = feature.get("properties") or {}
    for name, share in (("half_width", 1.0), ("width", 0.5)):
        if properties.get(name) is not None:
            try:
                width = share * float(properties[name])
            except (TypeError, ValueError):
                width = float("nan")
            if not 0 < width < float("inf"):
                raise BadValue(f"`{name}` of a road is {properties[name]!r}, a positive number of metres is expected")
            return width
    return usual
