"""Frames: latitude and longitude to local metres and back, body axes to local axes.

A `Frame` is the plane that touches the WGS-84 ellipsoid at one position: x east, y north, z up, in metres. Positions
in it are what every model of this package moves. Matrices are named by what they map: `mat_nb` takes a vector from the
body axes (x forward, y left, z up) to the local ones, ``v_n = mat_nb @ v_b``. Azimuth is the angle of the forward axis
from north, clockwise, so that forward is (sin azimuth, cos azimuth) and ``d azimuth / dt = -yaw rate``.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.errors import BadLog, BadShape, Missing
from halfwidth.vehicle.log import Log

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """Local east, north, up axes about one position.

    Parameters
    ----------
    lat_deg, lon_deg : float
        Origin in degrees of WGS-84.
    alt_m : float
        Height of the origin above the ellipsoid in metres.

    Examples
    --------
    >>> frame = Frame(50.0, 14.0)
    >>> east, north = frame.to_local([50.0, 50.001], [14.0, 14.0])
    >>> north.round(1).tolist()
    [0.0, 111.2]
    """

    lat_deg: float
    lon_deg: float
    alt_m: float = 0.0

    @classmethod
    def of(cls, log: Log) -> "Frame":
        """Return the frame at the middle of the range of a log's fixes, at height 0.

        The middle, not the first fix, keeps the plane close to the whole drive. A drive across the date line is put
        together on the side of its first fix.

        Raises
        ------
        BadLog
            If the log has no fix.
        """
        seen = log.fixed
        if not seen.any():
            raise BadLog("the log has no fix, at least one position is expected", hint="halfwidth check LOG")
        lon = _near(log.lon_deg[seen], float(log.lon_deg[seen][0]))
        lat = log.lat_deg[seen]
        middle = (float(lon.min()) + float(lon.max())) / 2
        return cls((float(lat.min()) + float(lat.max())) / 2, float(np.mod(middle + 180.0, 360.0) - 180.0))

    def to_local(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> tuple[Floats, Floats]:
        """Return east and north of positions on the ellipsoid at the origin's height.

        Parameters
        ----------
        lat_deg, lon_deg : (n,) array_like
            Degrees; NaN stays NaN.

        Returns
        -------
        east, north : (n,) arrays
            Metres.

        Raises
        ------
        BadShape
            If the two differ in shape.
        """
        lat, lon = np.asarray(lat_deg, float), np.asarray(lon_deg, float)
        if lat.shape != lon.shape:
            raise BadShape(f"`lat_deg` has shape {lat.shape} but `lon_deg` has {lon.shape}, equal ones are expected")
        map3d = _pymap3d()
        east, north, _ = map3d.geodetic2enu(
            lat, lon, np.full(lat.shape, self.alt_m), self.lat_deg, self.lon_deg, self.alt_m
        )
        return np.asarray(east, float), np.asarray(north, float)

    def to_geodetic(self, east: ArrayLike, north: ArrayLike) -> tuple[Floats, Floats]:
        """Return latitude and longitude of local positions: the inverse of `to_local`.

        The point of the plane is brought down to the origin's height along the plane's own normal, which is where
        `to_local` took it from; two corrections leave less than a millimetre within 100 km.

        Parameters
        ----------
        east, north : (n,) array_like
            Metres.

        Returns
        -------
        lat_deg, lon_deg : (n,) arrays
            Degrees; longitude in (-180, 180].
        """
        x, y = np.asarray(east, float), np.asarray(north, float)
        map3d = _pymap3d()
        down = -(x**2 + y**2) / (2 * 6371e3)
        for _ in range(3):
            lat, lon, alt = map3d.enu2geodetic(x, y, down, self.lat_deg, self.lon_deg, self.alt_m)
            down = down - (np.asarray(alt, float) - self.alt_m)
        return np.asarray(lat, float), np.asarray(lon, float)


def mat_nb(azimuth: ArrayLike, pitch: ArrayLike = 0.0, roll: ArrayLike = 0.0) -> Floats:
    """Return the matrix that takes body axes (forward, left, up) to local axes (east, north, up).

    Parameters
    ----------
    azimuth : float or (n,) array_like
        Radians from north, clockwise.
    pitch : float or (n,) array_like
        Radians, positive with the nose up.
    roll : float or (n,) array_like
        Radians, positive with the left side up.

    Returns
    -------
    (3, 3) or (n, 3, 3) array

    Examples
    --------
    >>> (mat_nb(np.pi / 2) @ [1.0, 0.0, 0.0]).round(3).tolist()  # heading east, forward is east
    [1.0, 0.0, 0.0]
    """
    a, p, r = np.broadcast_arrays(*(np.asarray(v, float) for v in (azimuth, pitch, roll)))
    sa, ca, sp, cp, sr, cr = np.sin(a), np.cos(a), np.sin(p), np.cos(p), np.sin(r), np.cos(r)
    forward = np.stack([cp * sa, cp * ca, sp], axis=-1)
    level_left = np.stack([-ca, sa, np.zeros_like(a)], axis=-1)
    level_up = np.stack([-sp * sa, -sp * ca, cp], axis=-1)
    left = cr[..., None] * level_left + sr[..., None] * level_up
    up = cr[..., None] * level_up - sr[..., None] * level_left
    return np.stack([forward, left, up], axis=-1)


def wrapped(angle: ArrayLike) -> Floats:
    """Return angles in (-pi, pi], radians."""
    return np.asarray(np.pi - np.mod(np.pi - np.asarray(angle, float), 2 * np.pi), float)


def _near(lon_deg: Floats, first: float) -> Floats:
    """Return longitudes within 180 degrees of the first."""
    return first + np.mod(lon_deg - first + 180.0, 360.0) - 180.0


def _pymap3d() -> Any:
    try:
        import pymap3d
    except ImportError as error:
        raise Missing(
            "local metres need pymap3d, which is not installed", hint='pip install "halfwidth[app]"'
        ) from error
    return pymap3d
