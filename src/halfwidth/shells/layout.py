"""Answers laid out as JSON, as tables and as text, and the one file that is read here: a model in TOML."""

import sys
from collections.abc import Mapping
from typing import Any

from halfwidth.errors import BadValue

SCHEMA_VERSION = 1


def about(log: Any) -> dict[str, Any]:
    """Say of a log what every command says."""
    return {
        "source": log.source,
        "rows": len(log),
        "length_s": float(log.t[-1] - log.t[0]),
        "fixes": int(log.fixed.sum()),
        "gaps": [list(gap) for gap in log.gaps()],
        "rates_hz": log.rates(),
        "notes": list(log.notes),
    }


def track_json(track: Any, written: Mapping[str, str | None], command: str, seconds: float) -> dict[str, Any]:
    """Lay out a track."""
    names = ("fix", "bridged", "extrapolated")
    return {
        "schema_version": SCHEMA_VERSION,
        "command": "fill",
        "typed": command,
        "seconds": round(seconds, 3),
        "log": about(track.log),
        "method": track.method,
        "level": track.level,
        "guarantee": track.guarantee,
        "rows": {name: int((track.quality == name).sum()) for name in names},
        "gaps": [
            {
                name: getattr(gap, name)
                for name in ("start", "stop", "duration_s", "distance_m", "max_half_m", "quality")
            }
            for gap in track.gaps
        ],
        "guaranteed": None
        if track.proven is None
        else {"acceleration": track.proven.acceleration, "fix": track.proven.fix, "rests_on": track.proven.words},
        "settings": dict(track.settings),
        "messages": list(track.messages),
        "written": dict(written),
    }


def estimate_json(answer: Any, level: float, output: str | None) -> dict[str, Any]:
    """Lay out an estimate and its intervals."""
    lo, hi = answer.interval(level) if answer.spread is not None else (None, None)
    return {
        "schema_version": SCHEMA_VERSION,
        "command": "estimate",
        "method": answer.method,
        "status": answer.status.name,
        "guaranteed": answer.guaranteed,
        "level": level,
        "names": list(answer.names),
        "t": answer.t,
        "x": answer.x,
        "lo": lo,
        "hi": hi,
        "q": answer.q,
        "r": answer.r,
        "Q": answer.Q,
        "R": answer.R,
        "theta": answer.theta,
        "loglik": answer.loglik,
        "written": output,
    }


def states(answer: Any, level: float, time_name: str) -> dict[str, Any]:
    """Lay out the answer as columns: time, states, and their intervals."""
    names = answer.names or tuple(f"x{k}" for k in range(answer.x.shape[1]))
    if time_name in names:
        raise BadValue(
            f"a state is called {time_name!r} as the time column is, so the answer would lack one of them",
            hint="other names in `states`",
        )
    columns = {time_name: answer.t} | {name: answer.x[:, k] for k, name in enumerate(names)}
    if answer.spread is not None:
        lo, hi = answer.interval(level)
        for k, name in enumerate(names):
            columns |= {f"{name}_lo": lo[:, k], f"{name}_hi": hi[:, k]}
    return columns


def table_bytes(columns: Mapping[str, Any], path: str) -> bytes:
    """Write columns as the format that the name of a file says."""
    if path.lower().endswith(".parquet"):
        from halfwidth.errors import Missing

        try:
            import pyarrow
            from pyarrow import parquet
        except ImportError:
            raise Missing(
                "Parquet needs pyarrow, which is not installed", hint="pip install 'halfwidth[formats]'"
            ) from None
        sink = pyarrow.BufferOutputStream()
        parquet.write_table(pyarrow.table(dict(columns)), sink)
        whole: bytes = sink.getvalue().to_pybytes()
        return whole
    import csv
    import io

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*(values.tolist() for values in columns.values()), strict=True):
        writer.writerow(["" if value != value else repr(value) for value in row])
    plain = text.getvalue().encode()
    if path.lower().endswith(".gz"):
        import gzip

        return gzip.compress(plain, mtime=0)
    return plain


def model_file(path: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a model and its optional table `[method]` from TOML."""
    import tomllib

    try:
        raw = sys.stdin.buffer.read(1 << 24) if path == "-" else _small(path)
        spec = tomllib.loads(raw.decode("utf-8-sig"))
    except OSError as error:
        raise BadValue(
            f"`{path}` cannot be read: {(error.strerror or str(error)).lower()}", hint="check the spelling"
        ) from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BadValue(f"`{path}` is no TOML: {error}", hint="A = [[1, 0.1], [0, 1]]") from error
    settings = spec.pop("method", {})
    if isinstance(settings, str):
        settings = {"name": settings}
    if not isinstance(settings, dict):
        raise BadValue(f"the key `method` is {settings!r}, a name or a table with `name` is expected")
    return spec, dict(settings)


def _small(path: str) -> bytes:
    with open(path, "rb") as file:
        raw = file.read((1 << 24) + 1)
    if len(raw) > 1 << 24:
        raise BadValue(f"`{path}` is longer than 16 MiB, a model is expected")
    return raw
