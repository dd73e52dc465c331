"""Tracks with known content, for the tests of what goes out."""

import numpy as np

from halfwidth.vehicle.log import Log
from halfwidth.vehicle.track import Track, gaps_of, since_fix_of


def made_track(
    rows: int = 120,
    *,
    source: str = "drives/monday.csv",
    epoch_s: float | None = None,
    lat: float = 50.1,
    lon: float = 14.4,
    height: bool = True,
    outages: tuple[tuple[int, int], ...] | None = None,
    **settings,
) -> Track:
    """Drive a circle at 10 m/s with one row every 0.1 s, two gaps inside and one at the end."""
    t = np.arange(rows) / 10
    turn = t / 30
    north, east = 300 * np.sin(turn), 300 * (1 - np.cos(turn))
    lat_deg = lat + north / 111_200
    lon_deg = lon + east / 111_200 / np.cos(np.radians(lat))
    quality = np.full(rows, "fix", dtype="<U12")
    if outages is None:
        outages = ((rows // 4, rows // 4 + rows // 8), (rows // 2, rows // 2 + 1))
        quality[rows - rows // 12 :] = "extrapolated"
    for first, stop in outages:
        quality[first:stop] = "bridged"
    fixed = quality == "fix"
    east_half = np.where(fixed, 0.4, 0.4 + 0.3 * since_fix_of(t, quality))
    north_half = 0.8 * east_half
    alt = 200 + t if height else np.full(rows, np.nan)
    log = Log(
        t=t,
        lat_deg=np.where(fixed, lat_deg + 1e-6 * np.sin(17 * t), np.nan),
        lon_deg=np.where(fixed, lon_deg + 1e-6 * np.cos(19 * t), np.nan),
        alt_m=np.where(fixed, alt, np.nan),
        speed_mps=np.full(rows, 10.0),
        yaw_rate_radps=np.full(rows, -1 / 30),
        source=source,
        epoch_s=epoch_s,
    )
    half = np.maximum(east_half, north_half)
    given = {
        "t_s": t,
        "lat_deg": lat_deg,
        "lon_deg": lon_deg,
        "alt_m": alt,
        "azimuth_rad": turn % (2 * np.pi),
        "speed_mps": np.full(rows, 10.0),
        "east_half_m": east_half,
        "north_half_m": north_half,
        "quality": quality,
        "since_fix_s": since_fix_of(t, quality),
        "level": 0.9,
        "method": "em_chain",
        "log": log,
        "gaps": gaps_of(t, lat_deg, lon_deg, half, quality),
        "settings": {"level": 0.9, "context_s": 60.0},
    }
    return Track(**{**given, **settings})
