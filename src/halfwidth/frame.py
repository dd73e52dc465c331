"""Frames of pandas, polars and pyarrow in and out, through narwhals; index and names are kept."""

import importlib
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from halfwidth.array import Array
from halfwidth.errors import BadRecord, Missing
from halfwidth.record import Labels

if TYPE_CHECKING:
    from halfwidth.result import Estimate


class Columns(NamedTuple):
    """What a frame holds: times (T,), outputs (T, ny), inputs (T, nu) or None, and where they came from."""

    t: Array
    y: Array
    u: Array | None
    labels: Labels


def read_frame(frame: Any, time: str | None, outputs: tuple[str, ...] | None, inputs: tuple[str, ...]) -> Columns:
    """Split a frame into times, outputs and inputs."""
    import narwhals as nw

    try:
        table = nw.from_native(frame, eager_only=True)
    except TypeError:
        raise BadRecord(
            f"`frame` is a {type(frame).__name__}, a frame of pandas, polars or pyarrow was expected",
            hint="Record(t, y, u) for arrays",
        ) from None
    indexed = time is None
    if time is None:
        index = getattr(frame, "index", None)
        if index is None:
            raise BadRecord(
                f"`time` is not given and a frame of {table.implementation} has no index; "
                f"its columns are {table.columns}",
                hint=f"time={table.columns[0]!r}" if table.columns else None,
            )
        clock = index.to_numpy()
        name = "" if index.name is None else str(index.name)
    else:
        _present(table.columns, (time,), "time")
        clock = table[time].to_numpy()
        name = time
    if outputs is None:
        outputs = tuple(c for c in table.columns if c != time and c not in inputs)
    _present(table.columns, outputs, "outputs")
    _present(table.columns, inputs, "inputs")
    if not outputs:
        raise BadRecord(f"no column is left for the outputs; the columns are {table.columns}")
    y = np.column_stack([_numbers(table[c], c) for c in outputs])
    u = np.column_stack([_numbers(table[c], c) for c in inputs]) if inputs else None
    labels = Labels(name, outputs, inputs, table.implementation.to_native_namespace(), clock, indexed)
    return Columns(_seconds(clock, name), y, u, labels)


def write_frame(estimate: "Estimate", level: float | None) -> Any:
    """Return an estimate as a frame of the library its record came from."""
    labels = estimate.labels
    fits = labels.clock is not None and len(labels.clock) == len(estimate.t)
    names = estimate.names or tuple(f"x{i}" for i in range(estimate.x.shape[1]))
    columns: dict[str, Any] = {} if labels.indexed else {labels.time: labels.clock if fits else estimate.t}
    columns |= {name: estimate.x[:, i] for i, name in enumerate(names)}
    if level is not None and estimate.spread is not None:
        lo, hi = estimate.interval(level)
        for i, name in enumerate(names):
            columns |= {f"{name}_lo": lo[:, i], f"{name}_hi": hi[:, i]}
    native = labels.native or _installed()
    if native.__name__ == "pandas" and labels.indexed:
        index = native.Index(labels.clock if fits else estimate.t, name=labels.time or None)
        return native.DataFrame(columns, index=index)
    return make(native, columns)


def make(native: Any, columns: dict[str, Any]) -> Any:
    """Return a frame of a library from named columns."""
    import narwhals as nw

    return nw.from_dict(columns, backend=native).to_native()


def _installed() -> Any:
    for name in ("pandas", "polars", "pyarrow"):
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    raise Missing(
        "no frame library is installed: pandas, polars or pyarrow was expected",
        hint="pip install pandas, or read `estimate.t` and `estimate.x`",
    )


def _present(columns: list[str], wanted: tuple[str, ...], argument: str) -> None:
    lost = [c for c in wanted if c not in columns]
    if lost:
        raise BadRecord(f"`{argument}` names {lost}, but the columns are {columns}")


def _numbers(series: Any, name: str) -> Array:
    import narwhals as nw

    if not (series.dtype.is_numeric() or series.dtype == nw.Boolean):
        if series.dtype != nw.Object and series.null_count() != len(series):
            raise BadRecord(f"column {name!r} has dtype {series.dtype}, numbers were expected")
        values = [None if v is None else v for v in series.to_list()]
        try:
            return np.array([np.nan if v is None else float(v) for v in values])
        except (TypeError, ValueError):
            raise BadRecord(f"column {name!r} holds something that is no number") from None
    values = series.cast(nw.Float64).to_numpy()
    return np.asarray(values, dtype=np.float64)


def _seconds(clock: Any, name: str) -> Array:
    """Return times in seconds; date-times count from the first row."""
    if np.issubdtype(clock.dtype, np.datetime64) or np.issubdtype(clock.dtype, np.timedelta64):
        if np.isnat(clock).any():
            raise BadRecord(f"the time column {name!r} is missing at row {int(np.argmax(np.isnat(clock)))}")
        if np.issubdtype(clock.dtype, np.datetime64):
            clock = clock - clock[0]
        return np.asarray(clock.astype("timedelta64[ns]").astype(np.int64) * 1e-9)
    if clock.dtype == object and len(clock) and hasattr(clock[0], "timestamp"):
        return np.array([(v - clock[0]).total_seconds() for v in clock])
    try:
        return np.asarray(clock, dtype=np.float64)
    except (TypeError, ValueError):
        raise BadRecord(
            f"the time column {name!r} has dtype {clock.dtype}, seconds or date-times were expected",
            hint="convert it first, for example pandas.to_datetime(frame[...])",
        ) from None
