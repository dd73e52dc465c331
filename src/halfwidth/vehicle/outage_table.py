"""The table of the outage benchmark: errors of each method at each length, as text, frame, plot and plain data."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadValue, Missing
from halfwidth.vehicle.calibrate import FEWEST
from halfwidth.vehicle.log import to_frame
from halfwidth.vehicle.widening import factor_for

Floats = NDArray[np.float64]

#: Error that is tolerated, m: the band of Pavelková's slides on GPS and CAN data.
TOLERANCE = 0.5


@dataclass(frozen=True, eq=False)
class Cell:
    """Errors of one method at one length of outage.

    Parameters
    ----------
    method : str
    length : float
        Length of the outages, s.
    start : (n,) array
        Time at which each outage begins, s.
    mean_error, max_error : (n,) arrays
        Mean and largest distance to the hidden fixes of each outage, m.
    n_fixes : (n,) int array
        Hidden fixes of each outage.
    needed : tuple of (2 n_fixes,) arrays
        For each hidden fix of each outage and each axis, the factor on the method's interval that just reaches it.
    claims : bool
        Whether the method claims an interval by itself; else its shape is the time to the nearest fix.
    level : float
        Level of the interval.
    half : (n,) array
        Mean half-width at the hidden fixes before it is sized, m.
    failed : int
        Outages in which the method found no usable path; there the straight line was counted instead.
    seconds : float
        Time the method took for all outages, s.
    """

    method: str
    length: float
    start: Floats
    mean_error: Floats = field(repr=False)
    max_error: Floats = field(repr=False)
    n_fixes: NDArray[np.int64] = field(repr=False)
    needed: tuple[Floats, ...] = field(repr=False)
    claims: bool
    level: float
    half: Floats = field(repr=False)
    failed: int
    seconds: float

    @property
    def n(self) -> int:
        """Number of outages."""
        return int(self.start.size)

    @property
    def mean(self) -> float:
        """Mean error over all hidden fixes, m."""
        return float(np.average(self.mean_error, weights=self.n_fixes))

    @property
    def max(self) -> float:
        """Mean over the outages of the largest error, m."""
        return float(self.max_error.mean())

    @property
    def worst(self) -> float:
        """Largest error of all, m."""
        return float(self.max_error.max())

    @property
    def mean_se(self) -> float:
        """Standard error of `mean` over the starts, m; NaN with one start."""
        return _standard_error(self.mean_error)

    @property
    def max_se(self) -> float:
        """Standard error of `max` over the starts, m; NaN with one start."""
        return _standard_error(self.max_error)

    @property
    def coverage(self) -> float | None:
        """Share of hidden fixes inside the method's own interval, before it is sized; None where it claims none."""
        return float(np.mean(np.concatenate(self.needed) <= 1.0)) if self.claims else None

    @property
    def factors(self) -> Floats:
        """(n,) array: factor on the interval of each outage that the other ones ask for; NaN with too few of them."""
        found = np.full(self.n, np.nan)
        for k in range(self.n):
            others = np.flatnonzero(np.abs(self.start - self.start[k]) > self.length)
            if others.size >= FEWEST:
                room = float(np.ptp(self.start[others])) + self.length
                found[k] = factor_for([self.needed[i] for i in others], self.length, self.level, room)
        return found

    @property
    def held(self) -> float | None:
        """Share of hidden fixes inside intervals sized by the other outages; None with too few of them."""
        shares = [n <= f for n, f in zip(self.needed, self.factors, strict=True) if np.isfinite(f)]
        return float(np.mean(np.concatenate(shares))) if shares else None

    @property
    def half_width(self) -> float | None:
        """Mean half-width of the intervals so sized, m; None with too few outages."""
        sized_to = self.factors * self.half
        known = np.isfinite(sized_to)
        return float(sized_to[known].mean()) if known.any() else None


@dataclass(frozen=True, eq=False)
class Outages:
    """What the benchmark found; prints as a table.

    Parameters
    ----------
    source : str
        Where the log came from.
    cells : tuple of Cell
        Method by method, length by length.
    level : float
        Level of the intervals.
    seed : int
    clock_offset : float
        Seconds added to the time stamps of speed and yaw rate; NaN where each has its own, found from the log.
    skipped : mapping of str to str
        Methods and lengths that could not be tried, and why.
    sensors : mapping
        What was found of the sensors and applied, see `Calibration.to_dict`.
    messages : tuple of str
        What was put right or left out of the log before.
    """

    source: str
    cells: tuple[Cell, ...]
    level: float
    seed: int
    clock_offset: float
    skipped: Mapping[str, str] = field(default_factory=dict)
    sensors: Mapping[str, Any] = field(default_factory=dict)
    messages: tuple[str, ...] = ()

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods, in the order of the table."""
        return tuple(dict.fromkeys(cell.method for cell in self.cells))

    @property
    def lengths(self) -> tuple[float, ...]:
        """Lengths of the outages, s."""
        return tuple(sorted({cell.length for cell in self.cells}))

    def cell(self, method: str, length: float) -> Cell:
        """Return the cell of one method and length.

        Raises
        ------
        BadValue
            If it was not tried.
        """
        for cell in self.cells:
            if cell.method == method and cell.length == length:
                return cell
        raise BadValue(f"`{method}` at {length:g} s is not in the table, one of {', '.join(self.methods)} is expected")

    def frame(self, native: str = "pandas") -> Any:
        """Return the table as a data frame, one row a cell.

        Parameters
        ----------
        native : {"pandas", "polars", "pyarrow"}

        Returns
        -------
        DataFrame or Table
            ``method, length_s, starts, mean_m, mean_se_m, max_m, max_se_m, worst_m, coverage, held, half_m, failed,
            seconds``.
        """
        return to_frame({name: np.array(values) for name, values in self._columns().items()}, native)

    def rows(self) -> list[dict[str, Any]]:
        """Return the table as plain data, one mapping a cell; None where a number is not known."""
        columns = self._columns()
        return [{name: _plain(values[k]) for name, values in columns.items()} for k in range(len(self.cells))]

    def _columns(self) -> dict[str, list[Any]]:
        cells = self.cells
        return {
            "method": [c.method for c in cells],
            "length_s": [c.length for c in cells],
            "starts": [c.n for c in cells],
            "mean_m": [c.mean for c in cells],
            "mean_se_m": [c.mean_se for c in cells],
            "max_m": [c.max for c in cells],
            "max_se_m": [c.max_se for c in cells],
            "worst_m": [c.worst for c in cells],
            "coverage": [_number(c.coverage) for c in cells],
            "held": [_number(c.held) for c in cells],
            "half_m": [_number(c.half_width) for c in cells],
            "failed": [c.failed for c in cells],
            "seconds": [c.seconds for c in cells],
        }

    def table(self) -> str:
        """Return the table as text: mean / mean of maxima in metres, then coverage."""
        lengths, name = self.lengths, max(len(m) for m in (*self.methods, "coverage"))
        head = f"{'':{name}}" + "".join(f"{f'{length:g} s':>16}" for length in lengths)
        starts = [max(c.n for c in self.cells if c.length == length) for length in lengths]
        lines = [
            f"outages of {self.source or 'the log'}: metres, mean / mean of maxima",
            head,
            f"{'starts':{name}}" + "".join(f"{n:>16}" for n in starts),
        ]
        for m in self.methods:
            row = [self._found(m, length) for length in lengths]
            lines.append(f"{m:{name}}" + "".join(f"{_pair(c):>16}" for c in row))
        percent = f"{100 * self.level:g} %"
        for what, words in (
            ("coverage", f"share of hidden fixes inside the methods' own {percent} interval, before it is sized"),
            ("held", f"share of hidden fixes inside {percent} intervals sized by the other outages"),
        ):
            covered = [c.method for c in self.cells if getattr(c, what) is not None]
            if not covered:
                continue
            lines += ["", words, head]
            for m in dict.fromkeys(covered):
                row = [self._found(m, length) for length in lengths]
                found = [None if c is None else getattr(c, what) for c in row]
                lines.append(f"{m:{name}}" + "".join(f"{'' if v is None else f'{v:.2f}':>16}" for v in found))
        lines += ["", f"longest outage whose mean largest error is within {TOLERANCE:g} m, s"]
        lines += [f"{m:{name}}{found:>16.3g}" for m, found in self.within().items()]
        return "\n".join([*lines, *self._notes()])

    def _found(self, name: str, length: float) -> Cell | None:
        return next((c for c in self.cells if c.method == name and c.length == length), None)

    def _notes(self) -> list[str]:
        errors = [c.mean_se / c.mean for c in self.cells if c.n > 1 and c.mean > 0]
        notes = [*self.messages, *(f"{what}: {why}" for what, why in self.skipped.items())]
        notes += [
            f"{c.method} at {c.length:g} s found no path in {c.failed} of {c.n} outages: straight line counted"
            for c in self.cells
            if c.failed
        ]
        if errors:
            notes.append(
                f"standard error of a mean: {100 * float(np.median(errors)):.0f} % of it (median of the cells)"
            )
        return ["", *notes] if notes else []

    def within(self, tolerance: float = TOLERANCE) -> dict[str, float]:
        """Return for each method how long an outage may last before its mean largest error exceeds a tolerance.

        Between the lengths that were tried it is interpolated in the logarithms of length and error.

        Parameters
        ----------
        tolerance : float
            m.

        Returns
        -------
        dict of str to float
            Seconds; 0 where the shortest outage is beyond the tolerance, the longest tried where none is.
        """
        found = {}
        for m in self.methods:
            cells = sorted((c for c in self.cells if c.method == m), key=lambda c: c.length)
            beyond = next((k for k, c in enumerate(cells) if c.max > tolerance), None)
            if beyond is None:
                found[m] = cells[-1].length
            elif beyond == 0:
                found[m] = 0.0
            else:
                a, b = cells[beyond - 1], cells[beyond]
                share = np.log(tolerance / max(a.max, 1e-9)) / np.log(b.max / max(a.max, 1e-9))
                found[m] = float(np.exp(np.log(a.length) + share * np.log(b.length / a.length)))
        return found

    def plot(self, ax: Any = None, *, tolerance: float = TOLERANCE) -> Any:
        """Plot error against the length of the outage: the mean, thin lines the mean of the largest.

        With one length there is a row for each method instead: a dot at the mean, a line to the mean of the largest.
        The nearest method comes first.

        Parameters
        ----------
        ax : matplotlib Axes, optional
        tolerance : float
            Where the line of the tolerated error is drawn, m (Pavelková's slides on GPS and CAN data: 0.5 m).

        Returns
        -------
        matplotlib Axes

        Raises
        ------
        Missing
            If matplotlib is not installed.
        """
        try:
            import matplotlib.pyplot as plt
            from matplotlib.ticker import LogLocator, NullFormatter
        except ImportError as exc:
            raise Missing("`plot` needs matplotlib", hint="pip install 'halfwidth[plot]'") from exc
        one = len(self.lengths) == 1
        size = (8, 1.6 + 0.24 * len(self.methods)) if one else (8, 5)
        ax = plt.figure(figsize=size, layout="constrained").add_subplot() if ax is None else ax
        cells = {m: sorted((c for c in self.cells if c.method == m), key=lambda c: c.length) for m in self.methods}
        order = sorted(self.methods, key=lambda m: cells[m][-1].mean if cells[m] else np.inf)
        map_, shades = ("tab20", 20) if len(order) > 10 else ("tab10", 10)
        colours = [plt.get_cmap(map_)(k) for k in range(shades)]
        for k, m in enumerate(order):
            mean, largest = ([max(getattr(c, what), 1e-4) for c in cells[m]] for what in ("mean", "max"))
            style = {"color": colours[k % len(colours)], "marker": "osD^v"[k // len(colours) % 5], "label": m}
            if one:
                ax.plot([*mean, *largest], [k] * 2 * len(mean), linewidth=2, markersize=6, markevery=[0], **style)
                ax.plot(largest, [k] * len(largest), color=style["color"], marker="|", markersize=9)
            else:
                t = [c.length for c in cells[m]]
                ax.plot(t, mean, markersize=3, **style)
                ax.plot(t, largest, color=style["color"], linewidth=0.6, linestyle="--")
        words, said = f"tolerance {tolerance:g} m", "error, m: mean, {} mean of the largest"
        error = ax.xaxis if one else ax.yaxis
        if one:
            ax.set_xscale("log")
            ax.axvline(tolerance, color="black", linewidth=0.8, label=words)
            ax.set_yticks(range(len(order)), order)
            ax.set_ylim(len(order) - 0.5, -0.5)
            ax.set_title(f"outages of {self.lengths[0]:g} s", fontsize="medium")
            ax.set_xlabel(f"{said.format('line to the')}; {words}")
        else:
            ax.loglog()
            ax.axhline(tolerance, color="black", linewidth=0.8, label=words)
            ax.set_xticks(self.lengths, [f"{length:g}" for length in self.lengths])
            ax.xaxis.minorticks_off()
            ax.set_xlabel("length of the outage, s")
            ax.set_ylabel(said.format("dashed the"))
            ax.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        error.set_major_locator(LogLocator(subs=(1, 2, 5)))
        error.set_major_formatter("{x:g}")
        error.set_minor_formatter(NullFormatter())
        ax.grid(axis="x" if one else "both", linewidth=0.4, alpha=0.6)
        return ax

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the single errors as plain data, for JSON.

        `coverage` of a cell is that of the method's own interval; `held` that of intervals sized by the other outages.
        """
        return {
            "level": self.level,
            "interval": "coverage: of the method itself; held: sized by the other outages",
            "seed": self.seed,
            "clock_offset": _plain(self.clock_offset),
            "sensors": dict(self.sensors),
            "messages": list(self.messages),
            "tolerance_m": TOLERANCE,
            "longest_within_s": self.within(),
            "skipped": dict(self.skipped),
            "cells": self.rows(),
        }

    def summary(self) -> str:
        """Return the table as text."""
        return self.table()

    def __str__(self) -> str:
        return self.table()

    def __repr__(self) -> str:
        return self.table()


def _standard_error(values: Floats) -> float:
    return float(values.std(ddof=1) / np.sqrt(values.size)) if values.size > 1 else float("nan")


def _pair(cell: Cell | None) -> str:
    return "" if cell is None else f"{cell.mean:.2f} / {cell.max:.2f}"


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value
