"""The commands: each reads its flags, builds one job, runs it and says what came out.

Plain help without colours, so that `--help` starts fast and pipes well; everything heavy is
imported by the command that needs it.
"""

import math
import os
import shlex
import sys
import time
import warnings
from pathlib import Path
from typing import Annotated, Any

import typer

from halfwidth.errors import DataQualityWarning
from halfwidth.shells import cli
from halfwidth.shells.flags import (
    UsageError,
    ending_known,
    estimator_known,
    figure_known,
    finite,
    limits_known,
    method_known,
    numbers,
    usage,
    with_example,
    writable,
)
from halfwidth.shells.layout import (
    SCHEMA_VERSION,
    about,
    estimate_json,
    model_file,
    states,
    table_bytes,
    track_json,
)
from halfwidth.shells.say import out, print_json, printable, reader, words, working

_ClickError: Any = UsageError.__bases__[0]

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
        asked: Any = getattr(command, "commands", {}).get(args[0] if args else "")
        example = (getattr(asked, "epilog", None) or "").removeprefix("Example: ")
        with_example(error, args, example).show(file=sys.stderr)
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
        raise usage("fill has nowhere to put the track", "-o OUT, or -o - for standard output")
    if not 0 < level < 1:
        raise usage(f"`--level` is {level:g}, a probability between 0 and 1 is expected", "--level 0.9")
    finite("--clock-offset", clock_offset)
    if json_ and "-" in (output, report):
        raise usage("`--json` and an output of `-` both claim standard output", "-o FILE")
    if output == "-" and report == "-":
        raise usage("`-o` and `--report` both claim standard output", "--report FILE")
    if output is not None and report is not None and os.path.abspath(output) == os.path.abspath(report):
        raise usage(f"`-o` and `--report` both claim `{output}`", "--report drive.html")
    method_known(method)
    writable(output, log, force)
    writable(report, log, force, "--report {}/drive.html")
    if output is not None:
        ending_known(output, format_)
    if guaranteed is not None and not all(0 < v < math.inf for v in guaranteed):
        raise usage(f"`--guaranteed` is {guaranteed[0]:g} {guaranteed[1]:g}, two positive numbers are expected",
                     "--guaranteed 4 3")  # fmt: skip
    settings: dict[str, Any] = {"clock_offset": clock_offset}
    settings |= {name: value for name, value in (("second", second), ("roads", map_)) if value is not None}
    if guaranteed is not None:
        settings["guaranteed"] = list(guaranteed)
    if limits is not None:
        settings["limits"] = limits_known(limits)
    job = Job("fill", log, method=method, level=level, settings=settings, columns=parse_columns(columns or ""))
    if dry_run:
        found = read(log, columns=job.columns)
        outputs = [path for path in (output, report) if path is not None]
        plan = {
            "schema_version": SCHEMA_VERSION,
            "command": "fill",
            "dry_run": True,
            "log": about(found),
            "would_write": outputs,
        }
        if json_:
            print_json(plan)
        else:
            words(f"would fill {found!r}", quiet)
            for note in found.notes:
                words(f"note: {note}", quiet)
            for path in outputs:
                words(f"would write {path}", quiet)
        return cli.GOOD
    started = time.perf_counter()
    with working("filling", quiet or no_progress):
        track: Any = run(job)
    command = "halfwidth " + shlex.join(_again())
    # the report first: were the track there and the report not, the run would look finished
    with reader():
        if report is not None:
            track.report(report, command=command)
        if output is not None:
            track.write(output, format=format_)
    if json_:
        written = {"track": output, "report": report}
        print_json(track_json(track, written, command, time.perf_counter() - started))
    if verbose:
        for note in track.log.notes:
            words(f"  {note}", quiet)
    if not quiet:
        for note in track.log.notes:
            if not verbose and not note.startswith("columns"):
                words(f"note: {note}", quiet)
        for message in track.messages:
            words(f"note: {message}", quiet)
        words(track.summary(), quiet)
        for written_to in (output, report):
            if written_to not in (None, "-"):
                words(f"wrote {written_to}", quiet)
    return cli.GOOD


# --- check --------------------------------------------------------------------------------------


@app.command(
    short_help="Say what is wrong with a log.", epilog="Example: halfwidth check drive.csv --report check.html"
)
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
        raise usage("the page and the words of `check` both claim standard output", "--report check.html")
    writable(report, log, force, "--report {}/check.html")
    found = examine(read(log, columns=columns, repair=False))
    if report is not None:
        found.report(report)
        words(f"wrote {report}", quiet)
    if json_:
        print_json({"command": "check", **found.to_dict()})
    else:
        out(printable(found.summary()))
    return cli.GOOD


# --- outages ------------------------------------------------------------------------------------


@app.command(
    short_help="Compare methods on outages cut into a log.",
    epilog="Example: halfwidth outages drive.csv --lengths 1,5,30",
)
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

    wanted = numbers("--lengths", lengths)
    finite("--clock-offset", clock_offset)
    names = [name.strip() for name in methods.split(",") if name.strip()] if methods else None
    for name in names or ():
        method_known(name)
    if plot is not None:
        figure_known("--plot", plot)
        writable(plot, log, force, "--plot {}/outages.png")
    found = read(log, columns=columns)
    with working("outages", quiet or no_progress) as progress:
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
        print_json({"schema_version": SCHEMA_VERSION, "command": "outages", "log": about(found), **result.to_dict()})
    else:
        out(printable(result.table()) + "\n")
    return cli.GOOD


# --- demo ---------------------------------------------------------------------------------------


@app.command(short_help="Fill a simulated drive with tunnels.", epilog="Example: halfwidth demo -o demo")
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
        raise usage(f"`{output}` is a file, a folder is expected", "-o FOLDER")
    held = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    # a demonstration is made anew, so that the same command can be typed twice; anything else is kept
    if held and held != {"drive.csv", "track.gpx", "report.html"} and not force:
        raise usage(
            f"`{output}` holds other files already", "--force to overwrite them, or -o FOLDER for another place"
        )
    with working("demo", quiet or no_progress):
        result = drive.run(folder, seed=seed)
    if json_:
        print_json({"schema_version": SCHEMA_VERSION, "command": "demo", **result.to_dict()})
    else:
        out(printable(result.summary().rstrip("\n")) + "\n")
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
        raise usage(f"`--level` is {level:g}, a probability between 0 and 1 is expected", "--level 0.9")
    if output != "-" and not output.lower().endswith((".csv", ".csv.gz", ".parquet")):
        raise usage(f"`{output}` ends in no known format, .csv, .csv.gz or .parquet is expected", "-o states.csv")
    if model == "-" and data == "-":
        raise usage("MODEL.toml and DATA both claim standard input", "give one of them as a file")
    estimator_known(method)
    writable(output, data, force, "-o {}/states.csv")
    spec, settings = model_file(model)
    name = settings.pop("name", None)
    name = name if method is None else method
    job = Job("estimate", data, model=spec, method=name, settings=settings, level=level, seed=seed)
    with working("estimating", quiet or no_progress):
        answer: Any = run(job)
    answer.check()
    table = states(answer, level, spec.get("time", "t"))
    if json_ and output == "-":
        output = ""
    if output:
        from halfwidth.store import atomic_write

        with reader(), atomic_write(output) as file:
            file.write(table_bytes(table, output))
    if json_:
        print_json(estimate_json(answer, level, output or None))
    if not quiet:
        words(answer.summary(level), quiet)
        if output not in ("", "-"):
            words(f"wrote {output}", quiet)
    return cli.GOOD


# --- doctor -------------------------------------------------------------------------------------


@app.command(short_help="Print versions, readers and self-tests.")
def doctor(json_: Json = False) -> int:
    """Print versions, the core's build, a self-test of the solvers, and the readers there are."""
    from halfwidth.shells.doctor import examine, text

    found = examine()
    if json_:
        print_json({"schema_version": SCHEMA_VERSION, "command": "doctor", **found})
    else:
        out(text(found))
    return cli.GOOD if found["good"] else cli.INTERNAL


# --- reproduce ----------------------------------------------------------------------------------


@app.command(short_help="Print a source paper's tables beside ours.", epilog="Example: halfwidth reproduce 003 --quick")
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
        raise usage(f"`{paper}` is no paper that is reproduced here, one of {known} is expected", "reproduce 003")
    if logs and paper not in papers.ON_LOGS:
        raise usage(f"paper {paper} is not about vehicles, a log has no use", f"reproduce {papers.ON_LOGS[-1]} LOG")
    found = papers.tables(paper, quick=quick, logs=logs or ())
    if json_:
        tables = [
            {"title": t.title, "header": list(t.header), "rows": [list(r) for r in t.rows], "notes": list(t.notes)}
            for t in found
        ]
        print_json({"schema_version": SCHEMA_VERSION, "command": "reproduce", "paper": paper, "tables": tables})
    else:
        out("\n\n".join(table.text() for table in found) + "\n")
    return cli.GOOD


def _again() -> list[str]:
    """Give the arguments as typed."""
    return sys.argv[1:]
