"""CSV and its relatives: delimiter, header, comments, units and encoding found from the text itself.

Blocks of about a megabyte are decoded, cut into lines, split and converted, so memory holds the
numbers of the columns that are used and one block of text, whatever the size of the file. A line
longer than the limit ends the reading before it is ever in memory.
"""

import codecs
import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadLog, LogTooBig
from halfwidth.vehicle.formats import layout
from halfwidth.vehicle.formats.cells import (
    MISSING,
    Tally,
    Times,
    day_stamps,
    looks_numeric,
    numbers,
    stamps,
)
from halfwidth.vehicle.formats.raw import Floats, Raw
from halfwidth.vehicle.formats.source import Limits, Source

#: Tried in this order; None is "any white space".
_DELIMITERS: tuple[str | None, ...] = (",", ";", "\t", "|", None)

_COMMENT = ("#", "%", "//")

#: Lines looked at for the header.
_HEAD_LINES = 60

#: What to type to see a log that can be read.
_EXAMPLE = "halfwidth demo -o demo writes a log to compare with"

#: More rows of the wrong length than this share of all, and the file is not what it seems.
_MOST_RAGGED = 0.2


@dataclass(frozen=True)
class _Header:
    delimiter: str | None
    line: int
    names: tuple[str, ...]
    text: str


def read_delimited(source: Source, asked: Mapping[str, str], choose: layout.Chooser = layout.recognise) -> Raw:
    """Read the columns of a text log.

    Parameters
    ----------
    source : Source
        Its bytes.
    asked : mapping of str to str
        Columns the user named, by role.
    choose : function
        Finds the columns among the names.

    Returns
    -------
    Raw

    Raises
    ------
    BadLog
        If it is no text, is empty, has no header, or lacks time, latitude or longitude.
    LogTooBig
        If a limit is passed.
    """
    blocks = _lines(source)
    first = next(blocks, [])
    if not any(line.strip() for line in first):
        raise BadLog(
            f"`{source.name}` is empty, a header and at least two fixes are expected"
            + (f" ({source.damage})" if source.damage else ""),
            hint=_EXAMPLE,
        )
    header = _header(first, asked, source)
    start = header.line + 1
    if header.delimiter is None and all(
        len(line.split(" ")) == len(header.names) for line in first[start:] if _holds_data(line)
    ):
        header = replace(header, delimiter=" ")  # one space is one delimiter: two of them hold an empty cell
    units: list[str] | None = None
    n_units_line = next((k for k in range(start, min(start + 5, len(first))) if _holds_data(first[k])), None)
    if n_units_line is not None:
        cells = _split([first[n_units_line]], header.delimiter)[0]
        held = [cell for cell in cells if cell.strip().lower() not in MISSING]
        if held and not any(_is_number(cell) for cell in held) and any(map(layout.is_unit, held)):
            units, start = cells, n_units_line + 1
    uses, notes = choose(header.names, asked, units, source.name)
    body = _Body(source, header, uses)
    if header.line > 0:
        skipped = sum(_holds_data(line) for line in first[: header.line])
        if skipped:
            notes.append(f"{_n(skipped, 'line')} before the header skipped")
    body.take(first[start:])
    del first
    for block in blocks:
        body.take(block)
    raw = body.raw(notes)
    if source.damage:
        raw.notes.append(f"{source.damage}; the {raw.n_rows} rows before that are kept")
    return raw


class _Body:
    """The rows under the header, converted block by block."""

    def __init__(self, source: Source, header: _Header, uses: Mapping[str, layout.Use]) -> None:
        self.source, self.header, self.uses = source, header, uses
        self.n_names = len(header.names)
        self.chunks: dict[str, list[Floats]] = {role: [] for role in uses if role != "date"}
        self.moments: list[NDArray[np.int64]] = []
        self.tallies = {role: Tally() for role in self.chunks}
        self.times = Times()
        self.dated: bool | None = None  # whether the time column holds dates; None before any row
        self.n_rows = self.n_short = self.n_long = self.n_headers = 0
        self.cut = False

    def take(self, lines: Sequence[str]) -> None:
        """Convert one block of lines."""
        kept = [line for line in lines if line and line[0] not in "#%" and not line.isspace()]
        if not kept:
            return
        try:
            rows = _split(kept, self.header.delimiter)
        except csv.Error as error:
            raise LogTooBig(
                f"`{self.source.name}` has a quoted cell that does not end ({error})",
                hint="look for a stray double quote",
            ) from error
        # only the very last line of a file can lack its end
        self.n_rows += len(rows)
        if self.n_rows > self.source.limits.rows:
            raise LogTooBig(
                f"`{self.source.name}` has more than {self.source.limits.rows} rows, which is the limit",
                hint="cut it, or pass `limits=` to `halfwidth.vehicle.read`",
            )
        if any(len(row) != self.n_names for row in rows):
            rows = self._even(rows)
        if rows:
            self._convert(list(zip(*rows, strict=True)))

    def _even(self, rows: list[list[str]]) -> list[list[str]]:
        """Pad short rows, drop empty cells beyond the header and rows that hold more."""
        even = []
        for row in rows:
            if len(row) == self.n_names:
                even.append(row)
            elif len(row) < self.n_names:
                self.n_short += 1
                even.append(row + [""] * (self.n_names - len(row)))
            elif not any(cell.strip() for cell in row[self.n_names :]):
                even.append(row[: self.n_names])
            else:
                self.n_long += 1
        return even

    def _convert(self, columns: list[tuple[str, ...]]) -> None:
        first_row = self.n_rows - len(columns[0]) + 1
        for role, use in self.uses.items():
            cells = columns[use.index]
            if role == "date":
                continue
            if role == "time":
                if self.dated is None:
                    self.dated = not looks_numeric(cells[:200])
                if self.dated:
                    if "date" in self.uses:
                        cells = tuple(day_stamps(columns[self.uses["date"].index], cells))
                    self.moments.append(stamps(cells, self.times, first_row))
                    continue
            self.chunks[role].append(numbers(cells, self.tallies[role], first_row))

    def raw(self, notes: list[str]) -> Raw:
        """Put the blocks together."""
        name = self.source.name
        if self.n_rows == 0:
            raise BadLog(
                f"`{name}` has a header but no rows, at least two fixes are expected"
                + (f" ({self.source.damage})" if self.source.damage else ""),
                hint=_EXAMPLE,
            )
        if self.n_long > _MOST_RAGGED * self.n_rows:
            raise BadLog(
                f"`{name}` has {self.n_long} of {self.n_rows} rows with more cells than the header's {self.n_names}",
                hint="decimal commas need another delimiter, such as `;`, or quotes",
            )
        if self.header.delimiter is None and self.n_short > _MOST_RAGGED * self.n_rows:
            raise BadLog(
                f"`{name}` is separated by white space and {self.n_short} of {self.n_rows} rows have fewer cells than"
                f" the header's {self.n_names}: which of them are empty is not known",
                hint="separate cells by `,` or `;`",
            )
        if self.n_short:
            notes.append(f"{_n(self.n_short, 'row')} shorter than the header, the rest left empty")
        if self.n_long:
            notes.append(f"{_n(self.n_long, 'row')} longer than the header dropped")
        if self.dated:
            self.chunks.pop("time")
            self.tallies["time"] = self.times.tally
        return Raw(
            source=name,
            uses=self.uses,
            values={role: np.concatenate(parts) if parts else np.empty(0) for role, parts in self.chunks.items()},
            stamps=np.concatenate(self.moments) if self.moments else None,
            times=self.times,
            tallies=self.tallies,
            notes=notes,
        )


def _lines(source: Source) -> Iterator[list[str]]:
    """Decode blocks of bytes and cut them into lines, never holding more than one long line."""
    limit = source.limits.line_bytes
    head = source.head
    encoding = _encoding(head, source.name)
    decoder = codecs.getincrementaldecoder(encoding)(errors="replace")
    rest = ""
    while True:
        block = source.read()
        text = rest + decoder.decode(block, final=not block)
        if "\r" in text:
            # a carriage return at the very end may be half of a line end
            held = "\r" if text.endswith("\r") and block else ""
            text = text[: len(text) - len(held)].replace("\r\n", "\n").replace("\r", "\n") + held
        lines = text.split("\n")
        rest = lines.pop()
        if len(rest) > limit or any(len(line) > limit for line in lines):
            raise LogTooBig(
                f"`{source.name}` has a line longer than {limit >> 10} KiB, which is the limit"
                " (no table, or one with far too many columns)",
                hint="give a CSV with one sample a line",
            )
        if not block:
            if rest:
                lines.append(rest)
            if lines:
                yield lines
            return
        if lines:
            yield lines


def _encoding(head: bytes, name: str) -> str:
    """Tell the encoding from the first block, refusing what is no text."""
    if head.startswith(codecs.BOM_UTF8):
        return "utf-8-sig"
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    start = head[:65536]
    for first, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):  # without a mark: every other byte of plain text is 0
        if len(start) > 3 and not any(start[first:4096:2]) and all(start[1 - first : 4096 : 2]):
            return encoding
    odd = sum(start.count(bytes([code])) for code in range(32) if code not in (9, 10, 12, 13))
    if b"\0" in start[:4096] or odd > 0.01 * len(start):
        raise BadLog(
            f"`{name}` is not text (binary bytes near the start), CSV, gzip CSV or Parquet is expected",
            hint="export the signals as CSV or Parquet",
        )
    for opening, what in ((b"<gpx", "GPX"), (b"<kml", "KML"), (b"<!doctype html", "a web page"),
                          (b"<html", "a web page")):  # fmt: skip
        if opening in start[:2048].lower():
            raise BadLog(
                f"`{name}` is {what}, CSV, gzip CSV or Parquet is expected",
                hint="export a table with time, latitude and longitude",
            )
    if start[:1] in b"{[" and start[:1]:
        raise BadLog(
            f"`{name}` is JSON, CSV, gzip CSV or Parquet is expected",
            hint="export a table with time, latitude and longitude",
        )
    if start.startswith((b"$GP", b"$GN", b"!AI")):
        raise BadLog(
            f"`{name}` is NMEA, CSV, gzip CSV or Parquet is expected",
            hint="convert it, for example with `gpsbabel -i nmea -o unicsv`",
        )
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def _header(lines: Sequence[str], asked: Mapping[str, str], source: Source) -> _Header:
    """Find the line and the delimiter that name the most of what is needed."""
    limits: Limits = source.limits
    best: tuple[int, _Header] | None = None
    widest: _Header | None = None
    for index, line in enumerate(lines[:_HEAD_LINES]):
        text = line.strip()
        if not text:
            continue
        commented = text.startswith(_COMMENT)
        bare = text.lstrip("#%/ \t") if commented else line
        for delimiter in _DELIMITERS:
            if delimiter is not None and delimiter not in bare:
                continue
            n_cells = bare.count(delimiter) + 1 if delimiter else len(bare.split())
            if n_cells > limits.columns:
                raise LogTooBig(
                    f"`{source.name}` has {n_cells} columns in line {index + 1}, at most {limits.columns} are read",
                    hint="give one sample a line, one signal a column",
                )
            cells = _split([bare], delimiter)[0]
            found = _Header(delimiter, index, tuple(cell.strip() for cell in cells), line)
            first = widest is None or widest.line == index
            if not commented and first and (widest is None or len(cells) > len(widest.names)):
                widest = found
            score = layout.count_known(cells, asked)
            if len(cells) >= 2 and score >= 2 and (best is None or score > best[0]):
                best = (score, found)
    if best is not None:
        return best[1]
    if widest is not None and sum(map(_is_number, widest.names)) * 2 > len(widest.names):
        raise BadLog(
            f"`{source.name}` has no header line (the first line is numbers), column names are expected",
            hint="put a first line such as t_s,lat_deg,lon_deg,speed_mps",
        )
    # which of them are lacking is for the chooser to say
    return widest if widest is not None else _Header(None, 0, (), "")


def _split(lines: Sequence[str], delimiter: str | None) -> list[list[str]]:
    if delimiter is None:
        return [line.split() for line in lines]
    if not any('"' in line for line in lines):
        return [line.split(delimiter) for line in lines]
    return list(csv.reader(lines, delimiter=delimiter, skipinitialspace=True))


def _holds_data(line: str) -> bool:
    return bool(line.strip()) and not line.strip().startswith(_COMMENT)


def _is_number(cell: str) -> bool:
    return not np.isnan(numbers([cell], Tally())[0])


def _n(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
