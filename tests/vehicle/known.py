"""A drive whose truth is known exactly, and the log of it: the material of the estimating tests."""

from dataclasses import dataclass

import numpy as np

from halfwidth.vehicle.frames import Frame
from halfwidth.vehicle.log import Log

FRAME = Frame(50.08, 14.42)


@dataclass(frozen=True)
class Known:
    """Truth at every row (metres of `FRAME`, radians, m/s) and the log."""

    t: np.ndarray
    east: np.ndarray
    north: np.ndarray
    azimuth: np.ndarray
    speed: np.ndarray
    log: Log

    def error(self, t, lat, lon):
        """Distances to the truth at rows of the log."""
        at = np.searchsorted(self.t, t)
        east, north = FRAME.to_local(lat, lon)
        return np.hypot(east - self.east[at], north - self.north[at])


def known(
    duration=200.0,
    *,
    rate=10.0,
    fix_every=1,
    noise=0.0,
    speed_noise=0.0,
    yaw_noise=0.0,
    scale=1.0,
    bias=0.0,
    offset=0.0,
    late=0.0,
    stop=None,
    seed=1,
):
    """Drive through bends at changing speed; `offset` is the sd of a slow fix error, fixes are `late` by that many s."""
    rng = np.random.default_rng(seed)
    fine = 20
    n = round(duration * rate)
    tf = np.arange(n * fine + 1) / (rate * fine)

    def pace(t):
        v = 10.0 + 4.0 * np.sin(t / 9.0)
        return v if stop is None else np.where((t > stop[0]) & (t < stop[1]), 0.0, v)

    def turn(t):
        return np.where(pace(t) > 0, 0.22 * np.sin(t / 5.0) * np.sin(t / 17.0), 0.0)

    v, w = pace(tf), turn(tf)
    step = np.diff(tf)
    azimuth = 0.6 + np.r_[0, np.cumsum(-0.5 * (w[1:] + w[:-1]) * step)]
    east = np.r_[0, np.cumsum(0.5 * ((v * np.sin(azimuth))[1:] + (v * np.sin(azimuth))[:-1]) * step)]
    north = np.r_[0, np.cumsum(0.5 * ((v * np.cos(azimuth))[1:] + (v * np.cos(azimuth))[:-1]) * step)]
    t = tf[::fine]
    slow = np.zeros((t.size, 2))
    if offset:
        fade = np.exp(-1 / (60.0 * rate))
        kick = offset * np.sqrt(1 - fade**2)
        slow[0] = offset * rng.standard_normal(2)
        for k in range(1, t.size):
            slow[k] = fade * slow[k - 1] + kick * rng.standard_normal(2)
    e_fix = np.interp(t - late, tf, east) + slow[:, 0] + noise * rng.standard_normal(t.size)
    n_fix = np.interp(t - late, tf, north) + slow[:, 1] + noise * rng.standard_normal(t.size)
    lat, lon = FRAME.to_geodetic(e_fix, n_fix)
    blank = np.arange(t.size) % fix_every != 0
    lat[blank] = lon[blank] = np.nan
    log = Log(
        t=t,
        lat_deg=lat,
        lon_deg=lon,
        alt_m=np.where(blank, np.nan, 200.0),
        speed_mps=v[::fine] / scale + speed_noise * rng.standard_normal(t.size),
        yaw_rate_radps=w[::fine] + bias + yaw_noise * rng.standard_normal(t.size),
        source="known drive",
    )
    return Known(t, east[::fine], north[::fine], azimuth[::fine], v[::fine], log)


def real_log(data, name):
    """One of the shared logs, by the start of its name."""
    from halfwidth.vehicle.formats import read

    return read(next(data.glob(f"{name}*.csv.gz")), repair=False)
