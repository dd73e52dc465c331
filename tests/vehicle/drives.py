"""A drive whose every stream is known, as columns and as files: the material of the reading tests."""

import io
from collections.abc import Mapping

import numpy as np


def drive(n=1200, dt=0.1, *, seed=1, fix_noise=0.3, lat0=52.5, lon0=13.4, every=1, east_west=False):
    """Columns of a drive through a town: turns both ways, a stop, `n` rows `dt` seconds apart."""
    rng = np.random.default_rng(seed)
    t = np.round(np.arange(n) * dt, 6)
    speed = 9 + 4 * np.sin(t / 11)
    if not east_west:
        speed[(t > 40) & (t < 50)] = 0
    yaw_rate = 0.25 * np.sin(t / 4) * np.sin(t / 15) * (speed > 0)
    if east_west:
        yaw_rate = 0.02 * np.sin(t / 4)
    azimuth = (np.pi / 2 if east_west else 0.7) - np.cumsum(yaw_rate) * dt
    east = np.cumsum(speed * np.sin(azimuth)) * dt
    north = np.cumsum(speed * np.cos(azimuth)) * dt
    lat = lat0 + (north + fix_noise * rng.standard_normal(n)) / 111_250
    lon = lon0 + (east + fix_noise * rng.standard_normal(n)) / (111_320 * np.cos(np.radians(lat0)))
    columns = {
        "t_s": t,
        "lat_deg": lat,
        "lon_deg": lon,
        "alt_m": np.full(n, 35.0),
        "azimuth_rad": azimuth % (2 * np.pi),
        "speed_mps": speed,
        "yaw_rate_radps": yaw_rate + 0.001 * rng.standard_normal(n),
    }
    if every > 1:
        blank = np.arange(n) % every != 0
        for name in ("lat_deg", "lon_deg", "alt_m", "azimuth_rad"):
            columns[name] = np.where(blank, np.nan, columns[name])
    return columns


def text(columns: Mapping, *, delimiter=",", decimal=".", head=None, digits=10) -> str:
    """Write columns as CSV; NaN becomes an empty cell, text stays as it is."""

    def cell(value):
        if isinstance(value, str):
            return value
        if value != value:
            return ""
        return f"{value:.{digits}g}".replace(".", decimal)

    out = io.StringIO()
    out.write(delimiter.join(columns) if head is None else head)
    out.write("\n")
    for row in zip(*columns.values(), strict=True):
        out.write(delimiter.join(cell(value) for value in row) + "\n")
    return out.getvalue()


def save(path, columns, **how):
    """Write columns to a file and give its path as text."""
    path.write_text(text(columns, **how), encoding="utf-8")
    return str(path)
