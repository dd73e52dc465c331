"""Track files: CSV and Parquet here, GPX, GeoJSON and KML in `halfwidth.vehicle.maps`.

Each writer turns a `Track` into the bytes of one format and `write` puts them in place in one step. Every row appears
exactly once and carries its quality.
"""

import gzip
import io
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from halfwidth.errors import BadValue, Missing
from halfwidth.store import atomic_write
from halfwidth.vehicle.log import COLUMNS as LOG_COLUMNS
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.maps import Start, about, geojson, gpx, kml, texts
from halfwidth.vehicle.track import COLUMNS, Track

#: Decimals of each column in text formats: finer than any of them is known.
_DECIMALS = {
    "lat_deg": 9,
    "lon_deg": 9,
    "alt_m": 3,
    "azimuth_rad": 6,
    "speed_mps": 4,
    "east_half_m": 4,
    "north_half_m": 4,
    "since_fix_s": 3,
}

#: Decimals of each column of a log.
_LOGGED = {**_DECIMALS, "yaw_rate_radps": 6, "ax_mps2": 4, "ay_mps2": 4}


def write(
    track: Track,
    path: "str | os.PathLike[str]",
    *,
    format: str | None = None,  # noqa: A002 - the word users look for
    start: Start = None,
) -> Path:
    """Write a track, in the format that the ending of the path names.

    Parameters
    ----------
    track : Track
        What to write.
    path : str or path
        Where to; ``-`` is standard output.
    format : str, optional
        The ending to go by instead, such as ``"gpx"``; for ``-`` without it CSV is written.
    start : datetime, str or float, optional
        Absolute time of ``t_s = 0``; see `absolute`.

    Returns
    -------
    Path
        Where it was written.

    Raises
    ------
    BadValue
        If the ending is not known, or `start` is not a time.
    Missing
        If a library for the format is not installed.
    OSError
        If the file cannot be written; what was there before is still there.
    """
    name = os.fspath(path)
    make = _FORMATS[ending(name, format)]
    content = make(track, start)
    with atomic_write(name) as file:
        file.write(content)
    return Path(name)


def write_log(log: Log, path: "str | os.PathLike[str]") -> Path:
    """Write a log as CSV with the columns that `halfwidth.vehicle.read` knows, empty where nothing arrived.

    Parameters
    ----------
    log : Log
        What to write.
    path : str or path
        Where to; ``-`` is standard output.

    Returns
    -------
    Path
        Where it was written.
    """
    columns = [
        [repr(t) for t in np.round(log.t, 9).tolist()]
        if column == "t_s"
        else texts(getattr(log, name), _LOGGED[column])
        for column, name in LOG_COLUMNS.items()
    ]
    lines = [",".join(LOG_COLUMNS), *map(",".join, zip(*columns, strict=True)), ""]
    with atomic_write(path) as file:
        file.write("\n".join(lines).encode())
    return Path(os.fspath(path))


def ending(path: str, format: str | None = None) -> str:  # noqa: A002
    """Find which format a path or an explicit format means.

    Parameters
    ----------
    path : str
        The file's name.
    format : str, optional
        The ending to go by instead, with or without its dot.

    Returns
    -------
    str
        An ending of `endings`.

    Raises
    ------
    BadValue
        If it is none of them.
    """
    if format is not None:
        known = "." + format.lower().lstrip(".")
        if known in _FORMATS:
            return known
        raise BadValue(f"`format` is {format!r}, one of {', '.join(endings())} is expected")
    if path == "-":
        return ".csv"
    # the longest first, so that .csv.gz is not taken for .gz
    for known in sorted(_FORMATS, key=len, reverse=True):
        if path.lower().endswith(known):
            return known
    raise BadValue(
        f"`path` is {path!r}, a name ending in one of {', '.join(endings())} is expected",
        hint="name the file track.gpx, or say `format=`",
    )


def endings() -> tuple[str, ...]:
    """List the endings that can be written."""
    return tuple(_FORMATS)


# --- tables ---------------------------------------------------------------------------------------


def _csv(track: Track, _: Start) -> bytes:
    """One header line, one line a row, empty where unknown; the columns of `Track.frame`."""
    columns: list[list[str]] = []
    for name in COLUMNS:
        if name == "quality":
            columns.append(track.quality.tolist())
        elif name == "t_s":
            # the shortest text that reads back as the same number, so that rows can be joined
            columns.append([repr(t) for t in np.round(track.t_s, 9).tolist()])
        else:
            columns.append(texts(getattr(track, name), _DECIMALS[name]))
    proven = track.proven_columns
    columns += [texts(values, 3) for values in proven.values()]
    lines = [",".join((*COLUMNS, *proven)), *map(",".join, zip(*columns, strict=True)), ""]
    return "\n".join(lines).encode()


def _csv_gz(track: Track, start: Start) -> bytes:
    """Compress the CSV; no time stamp inside, so that equal tracks give equal bytes."""
    return gzip.compress(_csv(track, start), compresslevel=6, mtime=0)


def _parquet(track: Track, _: Start) -> bytes:
    """Write the columns of `Track.frame`, with method, level and kind of bound as metadata."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise Missing(
            "a Parquet file needs pyarrow, which is not installed",
            hint="pip install 'halfwidth[formats]', or write .csv.gz",
        ) from error
    table = track.frame("pyarrow")
    for name in ("alt_m", "azimuth_rad", "speed_mps", "since_fix_s"):
        # unknown is null in Parquet, which every reader tells from a number
        values = pyarrow.array(getattr(track, name), from_pandas=True)
        table = table.set_column(COLUMNS.index(name), name, values)
    metadata = {f"halfwidth.{key}": str(value) for key, value in about(track).items()}
    sink = io.BytesIO()
    pyarrow.parquet.write_table(table.replace_schema_metadata(metadata), sink, compression="zstd")
    return sink.getvalue()


_FORMATS: dict[str, Callable[[Track, Start], bytes]] = {
    ".csv": _csv,
    ".csv.gz": _csv_gz,
    ".parquet": _parquet,
    ".gpx": gpx,
    ".geojson": geojson,
    ".kml": kml,
}
