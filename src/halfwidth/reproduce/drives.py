"""What the papers on vehicles share: the tolerance of half a metre, and tables from logs whose fixes are hidden."""

from collections.abc import Sequence

import numpy as np

from halfwidth.array import Array
from halfwidth.reproduce import Table
from halfwidth.vehicle import outages, read

#: The tolerance of Pavelková's slides, m.
TOLERANCE = 0.5


def tolerance_row(name: str, errors: Array) -> tuple[object, ...]:
    """Return name, "max (mean)" of each column of |errors| (rows, columns), and the share of rows within tolerance."""
    off = np.abs(errors)
    cells = [f"{column.max():.2f} ({column.mean():.2f})" for column in off.T]
    return (name, *cells, f"{100 * float(np.mean(off.max(axis=1) <= TOLERANCE)):.0f} %")


def log_table(path: str, methods: Sequence[str], *, quick: bool = False) -> Table:
    """Return the error of methods against the length of outages hidden in a log: mean / mean of maxima, m.

    Clocks of speed and yaw rate are found from the log, as `outages` does.
    """
    lengths: tuple[float, ...] = (5.0, 30.0) if quick else (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0)
    log = read(path)
    found = outages(log, lengths, 3 if quick else 20, methods=list(methods))
    rows = []
    for name in found.methods:
        cells = [next((c for c in found.cells if c.method == name and c.length == L), None) for L in found.lengths]
        rows.append((name, *(None if c is None else f"{c.mean:.2f} / {c.max:.2f}" for c in cells)))
    return Table(
        f"Error against the length of the outage, {log.source.rpartition('/')[2]}: mean / mean of maxima, m",
        ("method", *(f"{L:g} s" for L in found.lengths)),
        tuple(rows),
    )
