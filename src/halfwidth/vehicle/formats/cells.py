"""Cells of text turned into numbers and times, with what did not fit counted.

The usual column converts in one pass of `float`; only a column that holds something else is gone
through cell by cell: words for "nothing", decimal commas, a hemisphere letter after a degree.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Words that mean "nothing arrived".
MISSING = frozenset({"", "nan", "na", "n/a", "#n/a", "null", "none", "nil", "-", "--", "---", "?", "missing"})

_HEMISPHERE = re.compile(r"^\s*([NSEWnsew])?\s*([+-]?[\d.,]+)\s*°?\s*([NSEWnsew])?\s*$")
_TIME_OF_DAY = re.compile(r"^\s*(\d{1,2}):(\d{2}):(\d{2})(?:[.,](\d+))?\s*$")
_NAMED_MONTH = re.compile(r"^\s*(\d{1,2})[ -]([A-Za-z]{3})[a-z]*[ -](\d{4})(.*)$")
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_DOTTED_DATE = re.compile(r"^\s*(\d{1,2})\.(\d{1,2})\.(\d{4})(.*)$")

#: Marks a cell without a time among nanoseconds.
NO_TIME = np.iinfo(np.int64).min


@dataclass
class Tally:
    """What one column held that is not a plain number, counted over all blocks."""

    n_text: int = 0
    first_text: str = ""
    first_row: int = 0
    n_comma: int = 0
    n_cells: int = 0

    def text(self, cell: str, row: int) -> None:
        """Count one cell that is no number."""
        if self.n_text == 0:
            self.first_text, self.first_row = cell, row
        self.n_text += 1


@dataclass
class Times:
    """What stamps had: a date (`absolute`), none (`of_day`), a date without a zone (`zoneless`)."""

    absolute: bool = False
    of_day: bool = False
    zoneless: bool = False
    tally: Tally = field(default_factory=Tally)


def numbers(cells: Sequence[str], tally: Tally, first_row: int = 0) -> Floats:
    """Turn cells into numbers, NaN where a cell is empty or no number.

    Parameters
    ----------
    cells : sequence of str
        One column of one block.
    tally : Tally
        Counts cells that are text.
    first_row : int
        Row of the first cell, for the tally.

    Returns
    -------
    (n,) array
    """
    tally.n_cells += len(cells)
    nan = float("nan")
    try:
        return np.array([float(cell) if cell else nan for cell in cells])
    except ValueError:
        pass
    out = np.full(len(cells), nan)
    for k, cell in enumerate(cells):
        try:
            out[k] = float(cell)
        except ValueError:
            value = _odd(cell, tally)
            if value is None:
                tally.text(cell, first_row + k)
            else:
                out[k] = value
    return out


def _odd(cell: str, tally: Tally) -> float | None:
    """Read a cell `float` refuses; None if it is text."""
    bare = cell.strip().strip("'\"").strip()
    if bare.lower() in MISSING:
        return float("nan")
    if "," in bare and "." not in bare and bare.count(",") == 1:
        try:
            value = float(bare.replace(",", "."))
        except ValueError:
            pass
        else:
            tally.n_comma += 1
            return value
    try:
        return float(bare)
    except ValueError:
        pass
    match = _HEMISPHERE.match(bare)
    if match and (match[1] or match[3] or "°" in bare):
        try:
            value = float(match[2].replace(",", "."))
        except ValueError:
            return None
        side = (match[1] or match[3] or "N").upper()
        return -abs(value) if side in "SW" else value
    return None


def looks_numeric(cells: Sequence[str]) -> bool:
    """Say whether most of the cells that hold anything hold numbers."""
    held = [cell for cell in cells if cell.strip().lower() not in MISSING]
    good = sum(not np.isnan(numbers([cell], Tally())[0]) for cell in held)
    return good * 2 >= len(held)


def stamps(cells: Sequence[str], times: Times, first_row: int = 0) -> NDArray[np.int64]:
    """Turn date-and-time cells into nanoseconds since 1970 (UTC where no zone is given).

    Times of day without a date count from midnight; the smallest int64 marks a cell that holds no
    time.
    """
    times.tally.n_cells += len(cells)
    # the common case in one call: 2024-05-01T12:00:00.123456789 with or without Z
    if cells and cells[0][:4].isdigit() and cells[0][4:5] == "-":
        plain = [cell[:-1] if cell[-1:] in "Zz" else cell for cell in cells]
        if all("+" not in cell and cell.count("-") == 2 for cell in plain):
            try:
                out: NDArray[np.int64] = np.array(plain, dtype="datetime64[ns]").astype(np.int64)
            except (ValueError, OverflowError):
                pass
            else:
                times.absolute = True
                times.zoneless |= plain[0] == cells[0]
                return out
    out = np.full(len(cells), NO_TIME, dtype=np.int64)
    for k, cell in enumerate(cells):
        value = _stamp(cell, times)
        if value is not None:
            out[k] = value
        elif cell.strip().lower() not in MISSING:
            times.tally.text(cell, first_row + k)
    return out


def _stamp(cell: str, times: Times) -> int | None:
    match = _TIME_OF_DAY.match(cell)
    if match:
        hour, minute, second = int(match[1]), int(match[2]), int(match[3])
        if hour > 23 or minute > 59 or second > 60:
            return None
        times.of_day = True
        fraction = int((match[4] or "0")[:9].ljust(9, "0"))
        return ((hour * 60 + minute) * 60 + second) * 1_000_000_000 + fraction
    bare = cell.strip().replace("/", "-")
    named = _NAMED_MONTH.match(bare)
    if named and named[2].lower() in _MONTHS:
        bare = f"{named[3]}-{_MONTHS.index(named[2].lower()) + 1:02d}-{int(named[1]):02d}{named[4]}"
    dotted = _DOTTED_DATE.match(bare)
    if dotted:
        bare = f"{dotted[3]}-{int(dotted[2]):02d}-{int(dotted[1]):02d}{dotted[4]}"
    if bare.upper().endswith(" UTC"):
        bare = bare[:-4] + "Z"
    try:
        moment = datetime.fromisoformat(bare)
        if moment.tzinfo is None:
            moment = moment.replace(tzinfo=UTC)
            times.zoneless = True
        whole = moment.timestamp()
    except (ValueError, OverflowError):
        return None
    times.absolute = True
    # seconds first: a float holds whole microseconds of today only barely
    return round(whole // 1) * 1_000_000_000 + moment.microsecond * 1000


def day_stamps(dates: Sequence[str], clocks: Sequence[str]) -> list[str]:
    """Join a date cell and a time-of-day cell into one stamp."""
    return [
        f"{date.strip()}T{clock.strip()}" if date.strip() and clock.strip() else ""
        for date, clock in zip(dates, clocks, strict=True)
    ]


def seconds(nanoseconds: NDArray[np.int64]) -> tuple[Floats, float]:
    """Turn nanoseconds into seconds since the first stamp, and give that stamp in seconds."""
    held = nanoseconds != NO_TIME
    base = int(nanoseconds[held][0]) if held.any() else 0
    t = np.where(held, (nanoseconds - base) / 1e9, np.nan)
    return t, base / 1e9
