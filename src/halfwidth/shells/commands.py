"""The commands: each reads its flags, builds one job, runs it and says what came out.

Plain help without colours, so that `--help` starts fast and pipes well; everything heavy is
imported by the command that needs it.
"""

import json
import math
import os
import shlex
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from halfwidth.errors import BadValue, DataQualityWarning
from halfwidth.shells import cli

SCHEMA_VERSION = 1

#: Typer brings its own click in some versions and uses the installed one in others.
_UsageError: Any = typer.BadParameter.__bases__[0]
_ClickError: Any = _UsageError.__bases__[0]

app = typer.Typer(
    name="halfwidth",
    help="Fill the gaps in a vehicle's track, and say how far off it may be.",
    epilog="Exit codes: 0 good, 1 internal error, 2 usage, 3 bad input, 4 no estimate, 6 a resource limit,"
    " 130 interrupted.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    add_completion=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


def _warned(message: Warning | str, category: type[Warning], *_where: object, **_more: object) -> None:
    """Say a warning about the data as a note; what libraries warn of is no news to a user."""
    if issubclass(category, DataQualityWarning):
        print(f"note: {message}", file=sys.stderr)


def call(args: list[str]) -> int:
    """Run the commands on these arguments and give the exit code."""
    command = typer.main.get_command(app)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warned
            code = command.main(args=args, prog_name="halfwidth", standalone_mode=False)
    except typer.Abort:
        raise KeyboardInterrupt from None
    except _ClickError as error:
        error.show(file=sys.stderr)
        return cli.USAGE
    return code if isinstance(code, int) else cli.GOOD


# --- flags that several commands share ---------------------------------------------------------

LogPath = Annotated[
    str, typer.Argument(metavar="LOG", help="CSV, gzip CSV or Parquet; - for standard input.", show_default=False)
]
Columns = Annotated[
    str | None,
    typer.Option(
        metavar="ROLE=NAME,...",
        help="Which column is which: lat=Breite,speed=v[km/h],yaw_rate=-gyro_z. Roles: time, lat, lon, alt,"
        " azimuth, speed, yaw_rate, ax, ay, date, week, valid.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite existing files.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing unless something is wrong.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Say more; show where an internal error comes from.")]
NoProgress = Annotated[bool, typer.Option("--no-progress", help="Show no progress on long work.")]
Level = Annotated[float, typer.Option(metavar="P", help="Probability of the intervals, between 0 and 1.")]
ClockOffset = Annotated[
    float | None,
    typer.Option(
        metavar="S", help="Seconds to add to the clock of speed and yaw rate so that it agrees with the fixes'."
    ),
]


def _version(wanted: bool) -> None:
    if wanted:
        from halfwidth import __version__

        print(f"halfwidth {__version__}")
        raise typer.Exit


@app.callback()
def _top(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


# --- fill ---------------------------------------------------------------------------------------


@app.command(epilog="Example: halfwidth fill drive.csv -o drive.gpx --report drive.html")
def fill(
    log: LogPath,
    output: Annotated[
        str | None,
        typer.Option(
            "--output",
            "-o",
            metavar="OUT",
            help="Track to write: .csv, .csv.gz, .parquet, .gpx, .geojson or .kml; - for CSV on standard output.",
            show_default=False,
        ),
    ] = None,
    format_: Annotated[
        str | None, typer.Option("--format", metavar="NAME", help="Format of the track, where its name does not say.")
    ] = None,
    report: Annotated[str | None, typer.Option(metavar="HTML", help="Report to write: one HTML page.")] = None,
    method: Annotated[str | None, typer.Option(metavar="NAME", help="Estimator; the default needs no tuning.")] = None,
    level: Level = 0.9,
    guaranteed: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--guaranteed",
            metavar="ACCELERATION FIX",
            help="Add a band that must contain the vehicle while its acceleration stays within ACCELERATION m/s^2 and"
            " every fix within FIX m of the truth, each east and north; in columns of its own.",
            show_default=False,
        ),
    ] = None,
    clock_offset: ClockOffset = None,
    second: Annotated[
        str | None, typer.Option(metavar="LOG", help="Fixes of a second antenna on the same clock (method paper002).")
    ] = None,
    map_: Annotated[
        str | None, typer.Option("--map", metavar="GEOJSON", help="Roads that gaps are kept on (method paper002).")
    ] = None,
    limits: Annotated[
        str | None,
        typer.Option(
            metavar="NAME=MOST,...",
            help="Limits of speed, acceleration, yaw_rate, altitude, pitch (method paper002):"
            " speed=0:30,acceleration=4,yaw_rate=0.8 in m/s, m/s^2, rad/s, m, rad.",
        ),
    ] = None,
    columns: Columns = None,
    json_: Json = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Read and check everything, write nothing.")] = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    no_progress: NoProgress = False,
) -> int:
    """Fill the gaps of a vehicle's log and write the track."""
    from halfwidth.job import Job, run
    from halfwidth.vehicle.formats import read
    from halfwidth.vehicle.formats.layout import parse_columns

    if output is None and report is None and not json_ and not dry_run:
        raise _usage("fill has nowhere to put the track", "-o OUT, or -o - for standard output")
    if not 0 < level < 1:
        raise _usage(f"`--level` is {level:g}, a probability between 0 and 1 is expected", "--level 0.9")
    _finite("--clock-offset", clock_offset)
    if json_ and "-" in (output, report):
        raise _usage("`--json` and an output of `-` both claim standard output", "-o FILE")
    if output == "-" and report == "-":
        raise _usage("`-o` and `--report` both claim standard output", "--report FILE")
    if output is not None and report is not None and os.path.abspath(output) == os.path.abspath(report):
        raise _usage(f"`-o` and `--report` both claim `{output}`", "--report drive.html")
    _method_known(method)
    for path in (output, report):
        _writable(path, log, force)
    if output is not None:
        _ending_known(output, format_)
    if guaranteed is not None and not all(0 < v < math.inf for v in guaranteed):
        raise _usage(f"`--guaranteed` is {guaranteed[0]:g} {guaranteed[1]:g}, two positive numbers are expected",
                     "--guaranteed 4 3")  # fmt: skip
    settings: dict[str, Any] = {"clock_offset": clock_offset}
    settings |= {name: value for name, value in (("second", second), ("roads", map_)) if value is not None}
    if guaranteed is not None:
        settings["guaranteed"] = list(guaranteed)
    if limits is not None:
        from halfwidth.vehicle.antennas import parsed_limits

        settings["limits"] = parsed_limits(limits)
    job = Job("fill", log, method=method, level=level, settings=settings, columns=parse_columns(columns or ""))
    if dry_run:
        found = read(log, columns=job.columns)
        outputs = [path for path in (output, report) if path is not None]
        plan = {
            "schema_version": SCHEMA_VERSION,
            "command": "fill",
            "dry_run": True,
            "log": _about(found),
            "would_write": outputs,
        }
        if json_:
            _print_json(plan)
        else:
            _words(f"would fill {found!r}", quiet)
            for note in found.notes:
                _words(f"note: {note}", quiet)
            for path in outputs:
                _words(f"would write {path}", quiet)
        return cli.GOOD
    started = time.perf_counter()
    with _working("filling", quiet or no_progress):
        track: Any = run(job)
    command = "halfwidth " + shlex.join(_again())
    # the report first: were the track there and the report not, the run would look finished
    with _reader():
        if report is not None:
            track.report(report, command=command)
        if output is not None:
            track.write(output, format=format_)
    if json_:
        written = {"track": output, "report": report}
        _print_json(_track_json(track, written, command, time.perf_counter() - started))
    if verbose:
        for note in track.log.notes:
            _words(f"  {note}", quiet)
    if not quiet:
        for note in track.log.notes:
            if not verbose and not note.startswith("columns"):
                _words(f"note: {note}", quiet)
        for message in track.messages:
            _words(f"note: {message}", quiet)
        _words(track.summary(), quiet)
        for path in (output, report):
            if path not in (None, "-"):
                _words(f"wrote {path}", quiet)
    return cli.GOOD


# --- check --------------------------------------------------------------------------------------


@app.command(epilog="Example: halfwidth check drive.csv --report check.html")
def check(
    log: LogPath,
    report: Annotated[
        str | None, typer.Option(metavar="HTML", help="Page to write: the points, and what they rest on in pictures.")
    ] = None,
    columns: Columns = None,
    json_: Json = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,  # noqa: ARG001 - read by the error report
) -> int:
    """Say what is wrong with a log: columns, units, signs, gaps, outliers."""
    from halfwidth.vehicle import check as examine
    from halfwidth.vehicle import read

    if report == "-":
        raise _usage("the page and the words of `check` both claim standard output", "--report check.html")
    _writable(report, log, force)
    found = examine(read(log, columns=columns, repair=False))
    if report is not None:
        found.report(report)
        _words(f"wrote {report}", quiet)
    if json_:
        _print_json({"command": "check", **found.to_dict()})
    else:
        _out(_printable(found.summary()))
    return cli.GOOD


# --- outages ------------------------------------------------------------------------------------


@app.command(epilog="Example: halfwidth outages drive.csv --lengths 1,5,30")
def outages(
    log: LogPath,
    lengths: Annotated[
        str, typer.Option(metavar="S,...", help="Lengths of the outages in seconds.")
    ] = "1,2,5,10,20,30,60",
    starts: Annotated[int, typer.Option(metavar="N", min=1, max=10_000, help="Outages of each length.")] = 20,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seed of the random starts.")] = 1,
    methods: Annotated[str | None, typer.Option(metavar="NAME,...", help="Methods to compare; all if absent.")] = None,
    clock_offset: ClockOffset = None,
    plot: Annotated[
        str | None, typer.Option(metavar="FILE", help="Figure to write: error against length, as .png, .svg or .pdf.")
    ] = None,
    columns: Columns = None,
    json_: Json = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,  # noqa: ARG001 - read by the error report
    no_progress: NoProgress = False,
) -> int:
    """Cut outages into a log and compare methods by their error against the removed fixes."""
    from halfwidth.vehicle import outages as benchmark
    from halfwidth.vehicle import read

    wanted = _numbers("--lengths", lengths)
    _finite("--clock-offset", clock_offset)
    names = [name.strip() for name in methods.split(",") if name.strip()] if methods else None
    for name in names or ():
        _method_known(name)
    if plot is not None:
        _writable(plot, log, force)
    found = read(log, columns=columns)
    with _working("outages", quiet or no_progress) as progress:
        result = benchmark(
            found,
            lengths=wanted,
            starts=starts,
            seed=seed,
            methods=names,
            clock_offset=clock_offset,
            progress=progress,
        )
    if plot is not None:
        result.plot().figure.savefig(plot)
    if json_:
        _print_json({"schema_version": SCHEMA_VERSION, "command": "outages", "log": _about(found), **result.to_dict()})
    else:
        _out(_printable(result.table()) + "\n")
    return cli.GOOD


# --- demo ---------------------------------------------------------------------------------------


@app.command(epilog="Example: halfwidth demo -o demo")
def demo(
    output: Annotated[
        str, typer.Option("--output", "-o", metavar="FOLDER", help="Where to put log, track and report.")
    ] = "halfwidth-demo",
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seed of the simulated drive.")] = 1,
    json_: Json = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,  # noqa: ARG001 - read by the error report
    no_progress: NoProgress = False,
) -> int:
    """Simulate a drive with tunnels, fill it, score it, and write track and report."""
    from halfwidth.vehicle import demo as drive

    folder = Path(output)
    if folder.exists() and not folder.is_dir():
        raise _usage(f"`{output}` is a file, a folder is expected", "-o FOLDER")
    held = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    # a demonstration is made anew, so that the same command can be typed twice; anything else is kept
    if held and held != {"drive.csv", "track.gpx", "report.html"} and not force:
        raise _usage(
            f"`{output}` holds other files already", "--force to overwrite them, or -o FOLDER for another place"
        )
    with _working("demo", quiet or no_progress):
        result = drive.run(folder, seed=seed)
    if json_:
        _print_json({"schema_version": SCHEMA_VERSION, "command": "demo", **result.to_dict()})
    else:
        _out(_printable(result.summary().rstrip("\n")) + "\n")
    return cli.GOOD


# --- estimate -----------------------------------------------------------------------------------


@app.command(epilog="Example: halfwidth estimate model.toml data.csv -o states.csv")
def estimate(
    model: Annotated[
        str, typer.Argument(metavar="MODEL.toml", help="The model, see the guide for its keys.", show_default=False)
    ],
    data: Annotated[
        str, typer.Argument(metavar="DATA", help="CSV, gzip CSV or Parquet; - for standard input.", show_default=False)
    ],
    output: Annotated[
        str,
        typer.Option("--output", "-o", metavar="OUT", help="States to write: .csv or .parquet; - for standard output."),
    ] = "-",
    method: Annotated[
        str | None, typer.Option(metavar="NAME", help="Estimator; chosen from the model if absent.")
    ] = None,
    level: Level = 0.9,
    seed: Annotated[int | None, typer.Option(metavar="N", min=0, help="Seed of a method that draws numbers.")] = None,
    json_: Json = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,  # noqa: ARG001 - read by the error report
    no_progress: NoProgress = False,
) -> int:
    """Estimate the states of any linear model from a table."""
    from halfwidth.job import Job, run

    if not 0 < level < 1:
        raise _usage(f"`--level` is {level:g}, a probability between 0 and 1 is expected", "--level 0.9")
    if output != "-" and not output.lower().endswith((".csv", ".csv.gz", ".parquet")):
        raise _usage(f"`{output}` ends in no known format, .csv, .csv.gz or .parquet is expected", "-o states.csv")
    if model == "-" and data == "-":
        raise _usage("MODEL.toml and DATA both claim standard input", "give one of them as a file")
    _estimator_known(method)
    _writable(output, data, force)
    spec, settings = _model_file(model)
    name = settings.pop("name", None)
    name = name if method is None else method
    job = Job("estimate", data, model=spec, method=name, settings=settings, level=level, seed=seed)
    with _working("estimating", quiet or no_progress):
        answer: Any = run(job)
    answer.check()
    table = _states(answer, level, spec.get("time", "t"))
    if json_ and output == "-":
        output = ""
    if output:
        from halfwidth.store import atomic_write

        with _reader(), atomic_write(output) as file:
            file.write(_table_bytes(table, output))
    if json_:
        _print_json(_estimate_json(answer, level, output or None))
    if not quiet:
        _words(answer.summary(level), quiet)
        if output not in ("", "-"):
            _words(f"wrote {output}", quiet)
    return cli.GOOD


# --- doctor -------------------------------------------------------------------------------------


@app.command()
def doctor(json_: Json = False) -> int:
    """Print versions, the core's build, a self-test of the solvers, and the readers there are."""
    from halfwidth.shells.doctor import examine

    found = examine()
    if json_:
        _print_json({"schema_version": SCHEMA_VERSION, "command": "doctor", **found})
    else:
        _out(_doctor_text(found))
    return cli.GOOD if found["good"] else cli.INTERNAL


# --- reproduce ----------------------------------------------------------------------------------


@app.command(epilog="Example: halfwidth reproduce 003 --quick")
def reproduce(
    paper: Annotated[str, typer.Argument(metavar="PAPER", help="Number of the paper: 000 to 004.")],
    logs: Annotated[
        list[str] | None, typer.Argument(metavar="LOG...", help="Logs of drives to run papers 000 and 002 on as well.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A small part of each experiment.")] = False,
    json_: Json = False,
) -> int:
    """Print a source paper's tables beside ours, with notes on what cannot match and why."""
    from halfwidth import reproduce as papers

    if paper not in papers.PAPERS:
        known = ", ".join(papers.PAPERS)
        raise _usage(f"`{paper}` is no paper that is reproduced here, one of {known} is expected", "reproduce 003")
    if logs and paper not in papers.ON_LOGS:
        raise _usage(f"paper {paper} is not about vehicles, a log has no use", f"reproduce {papers.ON_LOGS[-1]} LOG")
    found = papers.tables(paper, quick=quick, logs=logs or ())
    if json_:
        tables = [
            {"title": t.title, "header": list(t.header), "rows": [list(r) for r in t.rows], "notes": list(t.notes)}
            for t in found
        ]
        _print_json({"schema_version": SCHEMA_VERSION, "command": "reproduce", "paper": paper, "tables": tables})
    else:
        _out("\n\n".join(table.text() for table in found) + "\n")
    return cli.GOOD


# --- small parts --------------------------------------------------------------------------------


def _usage(words: str, hint: str) -> Exception:
    error: Exception = _UsageError(f"{words}\nhint: {hint}")
    return error


def _finite(flag: str, value: float | None) -> None:
    if value is not None and not abs(value) < float("inf"):
        raise _usage(f"`{flag}` is {value}, a finite number of seconds is expected", f"{flag} 0.1")


def _numbers(flag: str, text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        values = []
    if not values or not all(0 < value < float("inf") for value in values):
        raise _usage(f"`{flag}` is {text!r}, positive numbers with commas in between are expected", f"{flag} 1,5,30")
    return values


def _method_known(name: str | None) -> None:
    """Refuse a method of the vehicle that is not there before any work is done."""
    if name is not None:
        from halfwidth.vehicle.estimators import METHODS

        _one_of(name, list(METHODS))


def _estimator_known(name: str | None) -> None:
    """Refuse an estimator that is not there before any work is done."""
    if name is not None:
        from halfwidth.methods import ESTIMATORS

        _one_of(name, list(ESTIMATORS))


def _one_of(name: str, known: list[str]) -> None:
    if name not in known:
        import difflib

        near = difflib.get_close_matches(name, known, n=1)
        raise _usage(
            f"there is no method {name!r}, one of {', '.join(known)} is expected",
            near[0] if near else "leave it away",
        )


def _ending_known(path: str, format_: str | None) -> None:
    """Refuse a format that is not there before any work is done."""
    from halfwidth.vehicle.write import ending

    try:
        ending(path, format_)
    except BadValue as error:
        raise _usage(error.message, error.hint or "-o track.csv") from error


def _writable(path: str | None, log: str, force: bool) -> None:
    """Refuse an output that cannot be written before any work is done."""
    if path is None or path == "-":
        return
    target = Path(path)
    folder = target.parent
    try:
        if os.path.isdir(target):
            raise _usage(f"`{path}` is a directory, a file is expected", f"-o {path.rstrip('/')}/track.csv")
        if log != "-" and os.path.exists(target) and os.path.exists(log) and os.path.samefile(target, log):
            raise _usage(f"`{path}` is the input itself", "give another name, the input is never overwritten")
        if os.path.isfile(target) and not force:
            raise _usage(f"`{path}` exists already", "--force overwrites it")
        if not os.path.isdir(folder):
            raise _usage(
                f"`{folder}` is no folder, so `{path}` cannot be written", f"mkdir -p {shlex.quote(str(folder))}"
            )
    except OSError as error:
        raise _usage(
            f"`{path}` cannot be written: {(error.strerror or str(error)).lower()}", "give another path"
        ) from error


def _out(text: str) -> None:
    """Write data to standard output."""
    with _reader():
        sys.stdout.write(text)
        sys.stdout.flush()


@contextmanager
def _reader() -> Iterator[None]:
    """Tell the reader of our output closing it early from a failure."""
    try:
        yield
    except BrokenPipeError as error:
        raise cli.ReaderGone from error


def _words(text: str, quiet: bool) -> None:
    if not quiet:
        print(_printable(text), file=sys.stderr)


def _printable(text: str) -> str:
    """Take control characters out of what came from a file, so that a name cannot steer a terminal."""
    return "".join(c if c.isprintable() or c in "\n\t" else "?" for c in text)


def _print_json(data: Mapping[str, Any]) -> None:
    _out(json.dumps(_plain(data), indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def _plain(value: Any) -> Any:
    """Turn arrays and numbers of any kind into what JSON has; NaN becomes null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if abs(value) < float("inf") else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


def _about(log: Any) -> dict[str, Any]:
    return {
        "source": log.source,
        "rows": len(log),
        "length_s": float(log.t[-1] - log.t[0]),
        "fixes": int(log.fixed.sum()),
        "gaps": [list(gap) for gap in log.gaps()],
        "rates_hz": log.rates(),
        "notes": list(log.notes),
    }


def _track_json(track: Any, written: Mapping[str, str | None], command: str, seconds: float) -> dict[str, Any]:
    names = ("fix", "bridged", "extrapolated")
    return {
        "schema_version": SCHEMA_VERSION,
        "command": "fill",
        "typed": command,
        "seconds": round(seconds, 3),
        "log": _about(track.log),
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


def _estimate_json(answer: Any, level: float, output: str | None) -> dict[str, Any]:
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


def _states(answer: Any, level: float, time_name: str) -> dict[str, Any]:
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


def _table_bytes(columns: Mapping[str, Any], path: str) -> bytes:
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


def _model_file(path: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a model and its optional table `[method]` from TOML."""
    import tomllib

    try:
        raw = sys.stdin.buffer.read(1 << 24) if path == "-" else _small(path)
        spec = tomllib.loads(raw.decode("utf-8-sig"))
    except OSError as error:
        raise BadValue(f"`{path}` cannot be read: {(error.strerror or str(error)).lower()}") from error
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


def _again() -> list[str]:
    """Give the arguments as typed."""
    return sys.argv[1:]


def _doctor_text(found: Mapping[str, Any]) -> str:
    lines = [f"halfwidth {found['version']}: {'all good' if found['good'] else 'something is wrong'}", ""]
    for title in ("platform", "core", "libraries", "self_test", "readers"):
        lines.append(title.replace("_", " "))
        lines += [f"  {name:<14}{value}" for name, value in found[title].items()]
    return "\n".join(lines) + "\n"


@contextmanager
def _working(what: str, quiet: bool) -> Iterator[Callable[[float, str], None] | None]:
    """Show progress on a terminal while something runs: a clock, or a share where it is known."""
    terminal = sys.stderr.isatty() and os.environ.get("TERM") != "dumb"
    if quiet or not terminal:
        yield None
        return
    import threading

    started, shown, done = time.monotonic(), [""], threading.Event()

    def draw(share: str) -> None:
        shown[0] = f"{what} {share}{time.monotonic() - started:.0f} s"
        print(f"\r{shown[0]:<70}", end="", file=sys.stderr, flush=True)

    latest = [""]

    def progress(share: float, words: str) -> None:
        latest[0] = f"{100 * share:.0f} %, {words}, "

    def tick() -> None:
        # short work shows nothing at all
        while not done.wait(0.5):
            draw(latest[0])

    thread = threading.Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield progress
    finally:
        done.set()
        thread.join()
        if shown[0]:
            print(f"\r{'':<70}\r", end="", file=sys.stderr, flush=True)
