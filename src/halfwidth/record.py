"""One clock, rows of outputs and inputs; NaN in `y` is a missing entry.

Missing is NaN at this border and the boolean mask `seen` inside: kernels receive the mask and never ask for NaN.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.array import Array, frozen, real, times
from halfwidth.errors import BadRecord, BadShape, BadValue


class Gap(NamedTuple):
    """Rows without a seen output: times in s of the first and last such row, and their indices."""

    start: float
    stop: float
    first: int
    last: int


@dataclass(frozen=True)
class Labels:
    """Where a record came from, so that answers can go back in kind.

    Parameters
    ----------
    time : str
        Name of the time column, or of the index; empty where the index has none.
    outputs, inputs : tuple of str
    native : module or None
        The frame library, as narwhals names it; None for arrays.
    clock : object
        The original time values, one a row; None for arrays.
    indexed : bool
        Whether the time was the index of a pandas frame.
    """

    time: str = "t"
    outputs: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    native: Any = None
    clock: Any = field(default=None, repr=False)
    indexed: bool = False


_UNNAMED = Labels()


@dataclass(frozen=True, eq=False)
class Record:
    """Outputs and inputs on one clock; row k is time ``t[k]``.

    Parameters
    ----------
    t : (T,) array_like
        Strictly increasing times, s; steps may differ.
    y : (T, ny) or (T,) array_like
        Outputs; NaN, None or masked is missing, per entry.
    u : (T, nu) or (T,) array_like, optional
        Inputs, all present.
    labels : Labels, optional
        Names and times of a frame, which estimates are labelled with again; made by `from_frame`.

    Raises
    ------
    BadShape, BadRecord
        If shapes do not fit, times do not increase, or an entry is infinite, complex or no number.

    Examples
    --------
    >>> Record([0.0, 1.0, 2.0], [1.0, None, 3.0]).gaps()
    [Gap(start=1.0, stop=1.0, first=1, last=1)]
    """

    t: Array
    y: Array
    u: Array | None = None
    labels: Labels = field(default_factory=Labels, repr=False)
    seen: NDArray[np.bool_] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        t = times(self.t)
        if len(t) == 0:
            raise BadRecord("the record is empty, at least one row was expected")
        y = _columns(real(self.y, "y", error=BadRecord, missing=True), "y", len(t))
        put = object.__setattr__
        put(self, "t", frozen(t))
        put(self, "y", frozen(y))
        mask = ~np.isnan(y)
        mask.flags.writeable = False
        put(self, "seen", mask)
        if self.u is not None:
            u = _columns(real(self.u, "u", error=BadRecord, missing=True), "u", len(t))
            if np.isnan(u).any():
                k = int(np.argmax(np.isnan(u).any(axis=1)))
                raise BadRecord(
                    f"`u` is missing at t = {t[k]:.6g} s; only `y` may be missing",
                    hint="fill the input first: `Record(t, y, hold(u))`, for example with np.interp",
                )
            put(self, "u", frozen(u))

    @classmethod
    def of(cls, t: Array, y: Array, u: Array | None, seen: NDArray[np.bool_]) -> "Record":
        """Wrap rows that were judged already, such as some of a record's."""
        record = object.__new__(cls)
        record.__dict__.update(t=t, y=y, u=u, labels=_UNNAMED, seen=seen)
        return record

    def __len__(self) -> int:
        return len(self.t)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return int(self.y.shape[1])

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return 0 if self.u is None else int(self.u.shape[1])

    def steps(self, dt: float) -> Array:
        """Return the step before each row, (T,) s; `dt` stands before the first."""
        return np.diff(self.t, prepend=self.t[0] - dt)

    def gaps(self) -> list[Gap]:
        """Return the runs of rows in which no output was seen."""
        lost = ~self.seen.any(axis=1)
        edge = np.flatnonzero(np.diff(np.concatenate(([False], lost, [False])).astype(np.int8)))
        return [Gap(float(self.t[a]), float(self.t[b - 1]), int(a), int(b - 1)) for a, b in edge.reshape(-1, 2)]

    def without(self, t0: float, t1: float, *, outputs: Sequence[int] | None = None) -> "Record":
        """Return the record with the outputs of ``t0 <= t <= t1`` missing.

        Parameters
        ----------
        t0, t1 : float
            Times, s.
        outputs : sequence of int, optional
            Which outputs are lost; all if absent.

        Raises
        ------
        BadValue
            If t0 is after t1, or there is no such output.
        """
        if not t0 <= t1:
            raise BadValue(f"`t0` is {t0!r} and `t1` is {t1!r}, t0 <= t1 was expected")
        y = self.y.copy()
        rows = np.flatnonzero((self.t >= t0) & (self.t <= t1))
        columns = np.arange(self.ny) if outputs is None else np.asarray(outputs)
        if np.any((columns < 0) | (columns >= self.ny)):
            raise BadValue(f"`outputs` is {outputs!r}, columns from 0 to {self.ny - 1} were expected")
        y[np.ix_(rows, columns)] = np.nan
        return Record(self.t, y, self.u, self.labels)

    def extended(self, steps: int, *, dt: float | None = None, u: ArrayLike | None = None) -> "Record":
        """Return the record with `steps` rows of missing outputs at its end, to forecast.

        Parameters
        ----------
        steps : int
        dt : float, optional
            Step, s; the median step of the record if absent.
        u : (steps, nu) array_like, optional
            Inputs of the new rows; needed if the record has inputs.

        Raises
        ------
        BadValue, BadRecord, BadShape
            If `steps` is no whole number from 1, `dt` is not positive, or `u` does not go with the record.
        """
        if not isinstance(steps, int | np.integer) or steps < 1:
            raise BadValue(f"`steps` is {steps!r}, a whole number from 1 was expected")
        if dt is None:
            dt = float(np.median(np.diff(self.t))) if len(self) > 1 else 1.0
        if not 0.0 < dt < np.inf:
            raise BadValue(f"`dt` is {dt!r}, a positive number of seconds was expected", hint="extended(steps, dt=0.1)")
        t = np.concatenate((self.t, self.t[-1] + dt * np.arange(1, steps + 1)))
        y = np.concatenate((self.y, np.full((steps, self.ny), np.nan)))
        if (u is None) != (self.u is None):
            raise BadRecord(
                f"the record has {self.nu} inputs and `u` is {'absent' if u is None else 'given'}",
                hint="extended(steps, u=inputs of the new rows)" if u is None else "leave `u` away",
            )
        if u is None or self.u is None:
            return Record(t, y, None, Labels())
        more = _columns(real(u, "u", error=BadRecord), "u", steps)
        if more.shape[1] != self.nu:
            raise BadShape(f"`u` has {more.shape[1]} columns but the record has {self.nu} inputs")
        return Record(t, y, np.concatenate((self.u, more)), Labels())

    @classmethod
    def merged(cls, t: ArrayLike, y: ArrayLike, u: ArrayLike | None = None) -> "Record":
        """Return a record from rows in any order; rows that share a time become one.

        Of each output the last seen entry of a time is kept, of the inputs the last row.
        """
        when = real(t, "t", error=BadRecord)
        out = _columns(real(y, "y", error=BadRecord, missing=True), "y", len(when))
        order = np.argsort(when, kind="stable")
        unique, row = np.unique(when[order], return_inverse=True)
        kept = np.full((len(unique), out.shape[1]), np.nan)
        for j in range(out.shape[1]):
            column = out[order, j]
            there = ~np.isnan(column)
            kept[row[there], j] = column[there]
        if u is None:
            return cls(unique, kept)
        given = _columns(real(u, "u", error=BadRecord), "u", len(when))
        inputs = np.empty((len(unique), given.shape[1]))
        inputs[row] = given[order]
        return cls(unique, kept, inputs)

    @classmethod
    def from_frame(
        cls,
        frame: Any,
        time: str | None = None,
        outputs: Sequence[str] | str | None = None,
        inputs: Sequence[str] | str = (),
    ) -> "Record":
        """Return a record from a pandas, polars or pyarrow frame.

        Parameters
        ----------
        frame : frame of any library that narwhals knows
        time : str, optional
            Name of the time column: seconds, or date-times. If absent the index of a pandas frame is the time.
        outputs, inputs : str or sequence of str
            Columns of y (NaN and null are missing) and of u; all other columns are y if `outputs` is absent.

        Raises
        ------
        BadRecord
            If a column is absent or does not hold numbers.
        """
        from halfwidth.frame import read_frame

        columns = read_frame(frame, time, _strings(outputs), _strings(inputs) or ())
        return cls(columns.t, columns.y, columns.u, columns.labels)

    def _repr_html_(self) -> str:
        from halfwidth.show import record_html

        return record_html(self)

    def __repr__(self) -> str:
        share = 100 * (1 - self.seen.mean()) if self.seen.size else 0.0
        return (
            f"Record({len(self)} rows, t = {self.t[0]:g} to {self.t[-1]:g} s, ny={self.ny}, nu={self.nu}, "
            f"{share:.3g} % of y missing, {len(self.gaps())} gaps)"
        )


def _columns(value: Array, name: str, T: int) -> Array:
    if value.ndim == 1:
        value = value[:, None]
    if value.ndim != 2 or len(value) != T:
        raise BadShape(f"`{name}` has shape {value.shape}, ({T}, n) was expected from `t`")
    return value


def _strings(value: Sequence[str] | str | None) -> tuple[str, ...] | None:
    if value is None:
        return None
    return (value,) if isinstance(value, str) else tuple(value)
