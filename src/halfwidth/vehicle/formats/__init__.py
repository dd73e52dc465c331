"""Reading a log: what kind of file it is, which column is which, and what had to be repaired.

Every reader turns its format into columns by role (`Raw`); what is common to all formats, order of
time, units, impossible values, happens once in `halfwidth.vehicle.repair`. What a file claims is
never trusted: blocks are bounded, lines are bounded, decompression is bounded.
"""

import os
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadLog, BadValue
from halfwidth.vehicle.formats.layout import parse_columns
from halfwidth.vehicle.formats.source import Limits, open_source
from halfwidth.vehicle.log import Log

__all__ = ["FORMATS", "Limits", "from_frame", "read", "read_columns"]

#: Formats by name; gzip is seen from the bytes.
FORMATS = ("csv", "parquet")


def read(
    path: str | os.PathLike[str],
    format: str | None = None,  # noqa: A002 - the word users know
    *,
    columns: Mapping[str, str] | str | None = None,
    repair: bool = True,
    limits: Limits | None = None,
) -> Log:
    r"""Read a vehicle's log.

    Columns are recognised by their names (``lat``, ``Latitude``, ``gps_lat_deg``, ...) and units
    from the names (``speed [km/h]``, ``gyro_z_dps``) or, where none is stated, from what the fixes
    say. Comments, a delimiter of any kind, decimal commas, ISO time stamps, Unix times in s, ms, us
    or ns and GPS weeks are understood. What was recognised, repaired or dropped is in the log's
    `notes`.

    Parameters
    ----------
    path : str or path
        A CSV file, a gzip CSV file or a Parquet file; ``"-"`` is standard input.
    format : {"csv", "parquet"}, optional
        Told from the first bytes if absent.
    columns : mapping of str to str, or str, optional
        Which column is which, where names are not recognised: ``{"lat": "Breite"}`` or
        ``"lat=Breite,speed=v[km/h],yaw_rate=-gyro_z"``. Roles: time, lat, lon, alt, azimuth, speed,
        yaw_rate, ax, ay, date, week, valid. A minus sign turns the sign around.
    repair : bool
        Whether units and signs that the file states but the fixes contradict are put right.
    limits : Limits, optional
        When to refuse a file as too big.

    Returns
    -------
    Log

    Raises
    ------
    BadLog
        If it cannot be read, is no log, or holds fewer than two fixes.
    LogTooBig
        If a limit is passed.
    Missing
        If it is Parquet and pyarrow is not installed.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "drive.csv"
    >>> _ = path.write_text("time;Breite;Länge\n0;52,5045;13,3736\n1;52,5046;13,3737\n")
    >>> read(path).lat_deg
    array([52.5045, 52.5046])
    """
    from halfwidth.vehicle.repair import to_log

    if format is not None and format not in FORMATS:
        raise BadValue(f"`format` is {format!r}, one of {', '.join(FORMATS)} is expected")
    asked = parse_columns(columns) if isinstance(columns, str) else dict(columns or {})
    source, stream = open_source(path, limits or Limits())
    try:
        kind = source.kind if format is None else {"csv": "text"}.get(format, format)
        if kind == "parquet" and source.kind != "parquet":
            raise BadLog(f"`{source.name}` is not Parquet", hint="leave `format` out")
        if kind == "parquet":
            from halfwidth.vehicle.formats.frames import read_parquet

            raw = read_parquet(source, asked)
        else:
            from halfwidth.vehicle.formats.delimited import read_delimited

            raw = read_delimited(source, asked)
    finally:
        if stream is not sys.stdin.buffer:
            stream.close()
    return to_log(raw, repair=repair)


def from_frame(
    frame: Any,
    *,
    columns: Mapping[str, str] | str | None = None,
    repair: bool = True,
) -> Log:
    """Take a log from a pandas, polars or pyarrow table.

    Columns are recognised as by `read`; the index of a pandas frame is the time when no column is.

    Parameters
    ----------
    frame : frame of any library that narwhals knows
    columns, repair
        As in `read`.

    Returns
    -------
    Log

    Raises
    ------
    BadLog
        If time, latitude or longitude is not found, or fewer than two fixes are there.
    """
    from halfwidth.vehicle.formats.frames import read_frame
    from halfwidth.vehicle.repair import to_log

    asked = parse_columns(columns) if isinstance(columns, str) else dict(columns or {})
    return to_log(read_frame(frame, asked), repair=repair)


def read_columns(
    path: str | os.PathLike[str],
    time: str,
    names: Sequence[str],
    *,
    limits: Limits | None = None,
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Read named columns of any table, in order of its rows, without looking at what they mean.

    Parameters
    ----------
    path : str or path
        CSV, gzip CSV or Parquet; ``"-"`` is standard input.
    time : str
        The column of times: numbers in seconds, or dates.
    names : sequence of str
        Columns of numbers; a cell that holds none is NaN.
    limits : Limits, optional
        When to refuse a file as too big.

    Returns
    -------
    t : (N,) array
        Times in seconds; since the first row where the file has dates.
    columns : dict of str to (N,) array

    Raises
    ------
    BadLog
        If a column is absent, or is mostly text.
    """
    from halfwidth.vehicle.formats import layout
    from halfwidth.vehicle.formats.cells import seconds

    source, stream = open_source(path, limits or Limits())
    wanted = {"time": time, **{f"column {k}": name for k, name in enumerate(names)}}
    choose = partial(layout.exactly, wanted)
    try:
        if source.kind == "parquet":
            from halfwidth.vehicle.formats.frames import read_parquet

            raw = read_parquet(source, wanted, choose)
        else:
            from halfwidth.vehicle.formats.delimited import read_delimited

            raw = read_delimited(source, wanted, choose)
    finally:
        if stream is not sys.stdin.buffer:
            stream.close()
    for role, tally in raw.tallies.items():
        if tally.n_text * 2 > tally.n_cells:
            raise BadLog(
                f"column `{raw.uses[role].column}` of `{source.name}` holds text in {tally.n_text} of"
                f" {tally.n_cells} rows, the first {tally.first_text[:40]!r} in row {tally.first_row};"
                f" {'times' if role == 'time' else 'numbers'} are expected"
            )
    t = raw.values["time"] if raw.stamps is None else seconds(raw.stamps)[0]
    return t, {name: raw.values[f"column {k}"] for k, name in enumerate(names)}
