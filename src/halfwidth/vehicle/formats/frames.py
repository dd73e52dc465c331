"""Tables in memory and Parquet files: typed columns, so nothing is guessed but names and units."""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadLog, LogTooBig, Missing
from halfwidth.vehicle.formats import layout
from halfwidth.vehicle.formats.cells import NO_TIME, Tally, Times, day_stamps, looks_numeric, numbers, stamps
from halfwidth.vehicle.formats.raw import Raw
from halfwidth.vehicle.formats.source import Limits, Source


def read_frame(
    frame: Any,
    asked: Mapping[str, str],
    source: str = "frame",
    choose: layout.Chooser = layout.recognise,
) -> Raw:
    """Read the columns of a pandas, polars or pyarrow table.

    Parameters
    ----------
    frame : frame of any library that narwhals knows
        The index of a pandas frame is the time when no column is.
    asked : mapping of str to str
        Columns the user named, by role.
    source : str
        For messages.
    choose : function
        Finds the columns among the names.

    Returns
    -------
    Raw

    Raises
    ------
    BadLog
        If it is no table, or time, latitude or longitude is not found.
    """
    import narwhals as nw

    try:
        table = nw.from_native(frame, eager_only=True)
    except TypeError:
        raise BadLog(
            f"`frame` is a {type(frame).__name__}, a table of pandas, polars or pyarrow is expected",
            hint="halfwidth.vehicle.read(path) for a file",
        ) from None
    names = [str(name) for name in table.columns]
    index = getattr(frame, "index", None)
    if index is not None and hasattr(index, "to_numpy") and "time" not in asked and "t" not in asked:
        known = {found[0] for found in map(layout.role_of, names) if found}
        if not known & {"time", "date"}:
            name = str(index.name) if index.name is not None else "time"
            frame = frame.reset_index(names=name)
            table = nw.from_native(frame, eager_only=True)
            names = [str(column) for column in table.columns]
    uses, notes = choose(names, asked, None, source)
    if len(table) == 0:
        raise BadLog(f"`{source}` has columns but no rows, at least two fixes are expected")
    raw = Raw(source, uses, {}, notes=notes)
    for role, use in uses.items():
        if role == "date":
            continue
        tally = raw.tallies[role] = Tally()
        found = _column(table[table.columns[use.index]], use.column)
        if role == "time" and isinstance(found, list) and not looks_numeric(found[:200]):
            if "date" in uses:
                date = _column(table[table.columns[uses["date"].index]], uses["date"].column)
                found = day_stamps([str(day) for day in date], found)
            raw.stamps = stamps(found, raw.times)
            raw.tallies["time"] = raw.times.tally
        elif isinstance(found, list):
            raw.values[role] = numbers(found, tally)
        elif found.dtype.kind == "M":
            if role != "time":
                raise BadLog(f"column {use.column!r} of `{source}` holds dates, numbers are expected for {role}")
            raw.stamps, raw.times = _nanoseconds(found), Times(absolute=True)
        else:
            raw.values[role] = found
            tally.n_cells = found.size
    return raw


def _column(series: Any, name: str) -> Any:
    """Give a column as float64 array, datetime64 array or list of str."""
    import narwhals as nw

    dtype = series.dtype
    if dtype.is_numeric() or dtype == nw.Boolean:
        return np.array(series.cast(nw.Float64).to_numpy(), dtype=np.float64)
    if dtype == nw.Datetime:
        if getattr(dtype, "time_zone", None) is not None:
            series = series.dt.convert_time_zone("UTC").dt.replace_time_zone(None)
        return np.asarray(series.to_numpy()).astype("datetime64[ns]")
    if dtype == nw.Duration:
        spans = np.asarray(series.to_numpy()).astype("timedelta64[ns]")
        return np.where(np.isnat(spans), np.nan, spans.astype(np.int64) / 1e9)
    if dtype in (nw.String, nw.Categorical, nw.Object, nw.Enum, nw.Date, nw.Time, nw.Unknown):
        return ["" if value is None or value != value else str(value) for value in series.to_list()]
    raise BadLog(f"column {name!r} holds {dtype}, numbers, dates or text are expected")


def _nanoseconds(moments: NDArray[Any]) -> NDArray[np.int64]:
    out = moments.astype("datetime64[ns]").astype(np.int64)
    return np.where(np.isnat(moments), NO_TIME, out)


def read_parquet(source: Source, asked: Mapping[str, str], choose: layout.Chooser = layout.recognise) -> Raw:
    """Read the columns of a Parquet file; only those that are used are decoded.

    Raises
    ------
    Missing
        If pyarrow is not installed.
    BadLog
        If the file is damaged or lacks time, latitude or longitude.
    LogTooBig
        If a limit is passed.
    """
    try:
        from pyarrow import parquet
    except ImportError:
        raise Missing(
            f"`{source.name}` is Parquet and pyarrow is not installed", hint="pip install 'halfwidth[formats]'"
        ) from None
    limits = source.limits
    try:
        # a file is mapped by name; only a pipe has to be held in memory
        file = parquet.ParquetFile(source.name if source.name != "-" else io.BytesIO(_whole(source)))
        about, schema = file.metadata, file.schema_arrow
    except LogTooBig:
        raise
    except Exception as error:  # whatever a damaged file makes of the decoder
        raise _damaged(source, error) from error
    _within(about.num_rows, limits.rows, "rows", source)
    _within(about.num_columns, limits.columns, "columns", source)
    names = list(schema.names)
    uses, _ = choose(names, asked, None, source.name)
    used = sorted({use.index for use in uses.values()})
    columns = [names[k] for k in used]
    try:
        n_bytes = _uncompressed(file, set(columns))
    except Exception as error:
        raise _damaged(source, error) from error
    if n_bytes > min(limits.total_bytes, limits.rows * 16 * len(used)):
        raise _too_big(source, limits)
    try:
        table = file.read(columns=columns)
    except Exception as error:
        raise _damaged(source, error) from error
    return read_frame(table, asked, source.name, choose)


def _uncompressed(file: Any, names: set[str]) -> int:
    about = file.metadata
    return sum(
        about.row_group(group).column(column).total_uncompressed_size
        for group in range(about.num_row_groups)
        for column in range(about.num_columns)
        if about.row_group(group).column(column).path_in_schema.split(".")[0] in names
    )


def _whole(source: Source) -> bytes:
    parts = []
    while block := source.read():
        parts.append(block)
        if sum(map(len, parts)) > 1 << 29:
            raise LogTooBig(
                f"`{source.name}` is a pipe with more than 512 MiB of Parquet", hint="give the file by its name"
            )
    return b"".join(parts)


def _within(value: int, most: int, what: str, source: Source) -> None:
    if value > most:
        raise LogTooBig(
            f"`{source.name}` has {value} {what}, at most {most} are read",
            hint="cut it, or pass `limits=` to `halfwidth.vehicle.read`",
        )


def _too_big(source: Source, limits: Limits) -> LogTooBig:
    return LogTooBig(
        f"`{source.name}` holds more than {limits.total_bytes >> 20} MiB, which is the limit",
        hint="cut it, or pass `limits=` to `halfwidth.vehicle.read`",
    )


def _damaged(source: Source, error: Exception) -> BadLog:
    words = " ".join(str(error).split())[:160]
    return BadLog(
        f"`{source.name}` is a damaged Parquet file ({words})",
        hint="write it again; a file that was cut off has lost its table of contents",
    )
