"""The source papers' tables beside ours: `tables(number)` returns them as plain values, `text` prints them.

Every paper is one module with ``tables(*, quick=False) -> tuple[Table, ...]`` and ``figures(folder)``. The numbers of
reference are those printed in the papers; notes say what cannot match and why.
"""

import importlib
import pathlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from halfwidth.errors import BadValue
from halfwidth.show import pyplot

#: Papers that are reproduced here, by number.
PAPERS: dict[str, str] = {"000": "paper000", "001": "paper001", "002": "paper002", "003": "paper003", "004": "paper004"}

#: Those whose experiments can also be run on a vehicle's logs.
ON_LOGS = ("000", "002")


@dataclass(frozen=True)
class Table:
    """One table: titles, rows of cells, and what has to be said about it."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    notes: tuple[str, ...] = ()

    def text(self) -> str:
        """Return the table as aligned text."""
        cells = [[_cell(c) for c in row] for row in (self.header, *self.rows)]
        width = [max(len(row[k]) for row in cells) for k in range(len(self.header))]
        lines = ["  ".join(c.rjust(w) if k else c.ljust(w) for k, (c, w) in enumerate(zip(row, width, strict=True)))
                 for row in cells]  # fmt: skip
        rule = "-" * len(lines[0])
        return "\n".join([self.title, rule, lines[0], rule, *lines[1:], *[f"* {note}" for note in self.notes]])


def paper(number: str) -> Any:
    """Return the module of a paper.

    Raises
    ------
    BadValue
        If the paper is not reproduced here.
    """
    if number not in PAPERS:
        raise BadValue(f"`{number}` is no paper that is reproduced here, one of {', '.join(PAPERS)} was expected")
    return importlib.import_module(f"halfwidth.reproduce.{PAPERS[number]}")


def tables(number: str, *, quick: bool = False, logs: Sequence[str] = ()) -> tuple[Table, ...]:
    """Return the tables of a paper; `quick` runs a small part of each experiment, `logs` are files of drives.

    Raises
    ------
    BadValue
        If the paper is not reproduced here, or there are logs and it is not about vehicles.
    """
    module = paper(number)
    if logs and number not in ON_LOGS:
        raise BadValue(f"paper {number} is not about vehicles, so `logs` has no use: {', '.join(ON_LOGS)} are")
    found: tuple[Table, ...] = module.tables(quick=quick, logs=tuple(logs)) if logs else module.tables(quick=quick)
    return found


def canvas(folder: str | pathlib.Path) -> tuple[Any, pathlib.Path]:
    """Return pyplot, drawing into files, and a folder for them, made where it is not there."""
    plt = pyplot()
    plt.switch_backend("Agg")
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    return plt, folder


def saved(figure: Any, path: pathlib.Path) -> pathlib.Path:
    """Write a figure and let it go; returns where it is."""
    figure.savefig(path, dpi=120, bbox_inches="tight")
    pyplot().close(figure)
    return path


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}"
    return str(value)
