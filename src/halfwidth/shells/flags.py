"""What commands ask of their flags before any work is done; a wrong one is a usage error with a hint."""

import os
import shlex
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import typer

from halfwidth.errors import BadValue

#: Typer brings its own click in some versions and uses the installed one in others.
UsageError: Any = typer.BadParameter.__bases__[0]


def usage(words: str, hint: str) -> Exception:
    """Return a usage error, to be raised."""
    error: Exception = UsageError(f"{words}\nhint: {hint}")
    return error


def finite(flag: str, value: float | None) -> None:
    """Refuse a number of seconds that is not finite."""
    if value is not None and not abs(value) < float("inf"):
        raise usage(f"`{flag}` is {value}, a finite number of seconds is expected", f"{flag} 0.1")


def numbers(flag: str, text: str) -> list[float]:
    """Read positive numbers with commas in between."""
    try:
        values = [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        values = []
    if not values or not all(0 < value < float("inf") for value in values):
        raise usage(f"`{flag}` is {text!r}, positive numbers with commas in between are expected", f"{flag} 1,5,30")
    return values


def method_known(name: str | None) -> None:
    """Refuse a method of the vehicle that is not there before any work is done."""
    if name is not None:
        from halfwidth.vehicle.estimators import METHODS

        _one_of(name, list(METHODS))


def estimator_known(name: str | None) -> None:
    """Refuse an estimator that is not there before any work is done."""
    if name is not None:
        from halfwidth.methods import ESTIMATORS

        _one_of(name, list(ESTIMATORS))


def _one_of(name: str, known: list[str]) -> None:
    if name not in known:
        import difflib

        near = difflib.get_close_matches(name, known, n=1)
        raise usage(
            f"there is no method {name!r}, one of {', '.join(known)} is expected",
            near[0] if near else "leave it away",
        )


def ending_known(path: str, format_: str | None) -> None:
    """Refuse a format that is not there before any work is done."""
    from halfwidth.vehicle.write import ending

    try:
        ending(path, format_)
    except BadValue as error:
        words = error.message.replace("`path`", "`--output`").replace("`format`", "`--format`")
        raise usage(words, "-o track.gpx, or --format gpx") from error


def figure_known(flag: str, path: str) -> None:
    """Refuse a figure that cannot be drawn before any work is done."""
    from importlib.util import find_spec

    if not path.lower().endswith((".png", ".svg", ".pdf")):
        raise usage(f"`{flag}` is {path!r}, a name ending in .png, .svg or .pdf is expected", f"{flag} outages.png")
    if find_spec("matplotlib") is None:
        raise usage(f"`{flag}` needs matplotlib, which is not installed", "pip install 'halfwidth[plot]'")


def limits_known(text: str) -> dict[str, tuple[float, float]]:
    """Read limits of states; wrong ones are a usage error."""
    from halfwidth.vehicle.antennas import parsed_limits

    try:
        return parsed_limits(text)
    except BadValue as error:
        raise usage(f"`--limits` is {text!r}: {error.message}", "--limits speed=0:30,acceleration=4") from error


def writable(path: str | None, log: str, force: bool, example: str = "-o {}/track.csv") -> None:
    """Refuse an output that cannot be written before any work is done; what to type instead goes by an example."""
    if path is None or path == "-":
        return
    target = Path(path)
    folder = target.parent
    try:
        if os.path.isdir(target):
            raise usage(f"`{path}` is a directory, a file is expected", example.format(path.rstrip("/")))
        if log != "-" and os.path.exists(target) and os.path.exists(log) and os.path.samefile(target, log):
            raise usage(f"`{path}` is the input itself", "give another name, the input is never overwritten")
        if os.path.isfile(target) and not force:
            raise usage(f"`{path}` exists already", "--force overwrites it")
        if not os.path.isdir(folder):
            raise usage(
                f"`{folder}` is no folder, so `{path}` cannot be written", f"mkdir -p {shlex.quote(str(folder))}"
            )
        if not os.access(folder, os.W_OK):
            raise usage(f"`{folder}` takes no files from you, so `{path}` cannot be written", "give another path")
    except OSError as error:
        raise usage(
            f"`{path}` cannot be written: {(error.strerror or str(error)).lower()}", "give another path"
        ) from error


def with_example(error: Any, args: Sequence[str], example: str) -> Any:
    """Add to what the parser of the command line says of a flag what was given, and what to type instead."""
    if "\nhint: " in error.message:
        return error
    flags = set(getattr(getattr(error, "param", None), "opts", ()))
    pairs = [(flag, value) for flag, value in pairwise(args) if flag in flags]
    pairs += [(flag, value) for flag, equals, value in (arg.partition("=") for arg in args) if equals and flag in flags]
    if pairs and pairs[-1][1] not in error.message:
        error.message = f"{pairs[-1][1]!r} was given. {error.message}"
    if example:
        error.message += f"\nhint: {example}"
    return error
