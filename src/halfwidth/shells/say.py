"""What the commands say: data on standard output, words and progress on standard error."""

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from halfwidth.shells import cli


def out(text: str) -> None:
    """Write data to standard output."""
    with reader():
        sys.stdout.write(text)
        sys.stdout.flush()


@contextmanager
def reader() -> Iterator[None]:
    """Tell the reader of our output closing it early from a failure."""
    try:
        yield
    except BrokenPipeError as error:
        raise cli.ReaderGone from error


def words(text: str, quiet: bool) -> None:
    """Write words to standard error, unless asked to be quiet."""
    if not quiet:
        print(printable(text), file=sys.stderr)


def printable(text: str) -> str:
    """Take control characters out of what came from a file, so that a name cannot steer a terminal."""
    return "".join(c if c.isprintable() or c in "\n\t" else "?" for c in text)


def print_json(data: Mapping[str, Any]) -> None:
    """Write plain data to standard output as JSON."""
    out(json.dumps(_plain(data), indent=2, allow_nan=False, ensure_ascii=False) + "\n")


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


@contextmanager
def working(what: str, quiet: bool) -> Iterator[Callable[[float, str], None] | None]:
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
