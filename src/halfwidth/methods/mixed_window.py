"""The optimal affine estimator for mixed noise, over a sliding window.

`halfwidth.methods._affine_gains` finds the gains of one window, which depend on no data: they are found once for each
pattern of seen outputs, and in a time-invariant model nearly all rows share a few. What is known before the window,
(m, P, X), is the belief of `MixedFilter`; gains are found for P and X rounded to a grid, and half-widths then
computed for those gains with the belief itself, so they hold exactly for what is reported.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.array import Array
from halfwidth.errors import BadValue, Refused, hinted
from halfwidth.methods._affine_gains import Window, design, root
from halfwidth.methods._mixed_rows import MixedRows, Stack, mixed_rows, refuses
from halfwidth.methods._protocol import typed
from halfwidth.methods.mixed import MixedBelief, MixedFilter, Pushed, newest_kind, prior
from halfwidth.model import Linear, Model
from halfwidth.noise import Gaussian
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Both


@dataclass(frozen=True)
class MixedWindow:
    """Centre, covariance and set of each state by the optimal affine estimator over the newest rows.

    Needs the library clarabel (``pip install 'halfwidth[mixed]'``). A design takes some milliseconds a state, so a
    record in which every row has its own pattern of missing outputs takes as long as many designs; `MixedFilter` takes
    microseconds, at half-widths a few per cent larger.

    Parameters
    ----------
    memory : int
        Rows in the window; what is known before them comes from `MixedFilter`.
    lag : int
        Row t uses the outputs up to row t + lag, so this is also the smoother for mixed noise.
    kappa : float
        Standard deviations that count as much as a half-width.

    Raises
    ------
    BadValue
        If a setting is out of its domain.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Gaussian(0.01), hw.Uniform(1) + hw.Gaussian(0.1), hw.Normal([0.0], 1.0))
    >>> est = hw.estimate(walk, hw.Record(range(60), np.zeros(60)), MixedWindow(memory=20, lag=5))
    >>> filtered = hw.estimate(walk, hw.Record(range(60), np.zeros(60)), hw.MixedFilter())
    >>> [round(float(one.interval(0.9)[1][30, 0]), 2) for one in (est, filtered)]
    [1.16, 1.21]
    """

    memory: int = 40
    lag: int = 0
    kappa: float = 3.0

    def __post_init__(self) -> None:
        for name, least in (("memory", 1), ("lag", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
                raise BadValue(f"`{name}` is {value!r}, a whole number from {least} was expected")
        if self.memory <= self.lag:
            raise BadValue(
                f"`memory` is {self.memory} rows but `lag` is {self.lag}, so the row would lie before its window",
                hint=f"memory={4 * self.lag}",
            )
        if not 0.0 < self.kappa < np.inf:
            raise BadValue(f"`kappa` is {self.kappa!r}, a positive number was expected", hint="kappa=3.0")

    def refuses(self, model: Model) -> str | None:
        """Return why the model cannot be taken, or None."""
        reason = refuses(model, type(self).__name__)
        if reason is None and isinstance(model.w, Gaussian) and isinstance(model.e, Gaussian):
            return "`MixedWindow` is for bounded noise but `w` and `e` are `Gaussian`\nhint: KalmanSmoother()"
        return reason

    def run(self, model: Linear, record: Record, *, seed: int | None = None) -> Estimate:  # noqa: ARG002
        """Estimate every row from the window about it."""
        n = model.nx
        rows, start = mixed_rows(model, record), prior(model)
        out = MixedFilter(form="ellipsoid", kappa=self.kappa).rows(rows, start)
        filtered = MixedBelief(out["m"], out["P"], out["X"], np.zeros((0, n)))
        x, P, half = out["m"].copy(), out["P"].copy(), out["half"].copy()
        groups = list(self._groups(rows, start, filtered))
        failed = []
        for at, window, arrival in groups:
            found = design(window, arrival, self.kappa)
            if found is None:
                failed.extend(at.tolist())
                continue
            first = at - window.target
            if first[0] == 0:  # the prior stands before the window
                before = _single(start, start.Z)
            else:
                k = first - 1
                before = MixedBelief(filtered.m[k], filtered.P[k], filtered.X[k], start.Z[:0])
            inside = first[:, None] + np.arange(window.rows)
            y = rows.y[inside].reshape(len(at), -1)[:, window.seen.ravel()]
            b = None if rows.b is None else rows.b[inside].reshape(len(at), -1)
            x[at], P[at], half[at] = found.apply(before, y, b)
        info: dict[str, Any] = {"designs": len(groups)}
        status = Status.OK
        if out["broken"] >= 0:
            status = Status.COLLAPSED
            info["message"] = f"the state left the range of floating point at t = {record.t[out['broken']]:.6g} s"
        elif failed:
            status = Status.REDUCED
            info["message"] = f"{len(failed)} rows have the filter's estimate, first t = {record.t[min(failed)]:.6g} s"
        return Estimate(
            record.t, x, Both(x, P, half), status, typed(self),
            names=model.names.x, labels=record.labels, info=info,
        )  # fmt: skip

    def stream(self, model: Linear, t: float = 0.0) -> "WindowStream":
        """Return the online form; each push gives the estimate of `lag` rows ago."""
        return WindowStream(self, model, t)

    def _groups(
        self, rows: MixedRows, start: MixedBelief, filtered: MixedBelief
    ) -> Iterator[tuple[NDArray[np.int64], "Window", MixedBelief]]:
        """Give the rows that share a design, their window, and the belief before it that the design is made for."""
        T = len(rows.y)
        end = np.minimum(np.arange(T) + self.lag, T - 1)
        first = np.maximum(end - self.memory + 1, 0)
        motion, output = (_index(stack, T) for stack in (rows.A, rows.C))
        kind = motion * (int(output.max()) + 1) + output
        inside = first[:, None] + np.arange(self.memory)
        kinds = np.where(inside <= end[:, None], kind[np.minimum(inside, T - 1)], -1)
        unit = _unit(filtered.P[0], filtered.X[0], self.kappa)
        rounded = np.concatenate([_grid(S, unit) for S in filtered[1:3]], axis=1)
        arrival = np.where(first[:, None] > 0, rounded[np.maximum(first - 1, 0)], _NONE)
        keys = np.column_stack([np.arange(T) - first, kinds, arrival])
        _, one, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        order = np.argsort(which.reshape(-1), kind="stable")
        for at in np.split(order, np.flatnonzero(np.diff(which.reshape(-1)[order])) + 1):
            t = int(one[which.reshape(-1)[at[0]]])
            a, e = int(first[t]), int(end[t])
            belief = start
            if a > 0:
                belief = _rounded(rounded[a - 1], unit, start)
            yield at, _window(rows, motion, output, a, e, t - a), belief


_NONE = np.iinfo(np.int64).min


def _window(
    rows: MixedRows, motion: NDArray[np.int64], output: NDArray[np.int64], a: int, e: int, target: int
) -> Window:
    m, o = motion[a : e + 1], output[a : e + 1]
    return Window(
        rows.A[0][m], rows.Q[0][m], rows.G[0][m], rows.C[0][o], rows.r[0][o, 0], rows.half[0][o, 0],
        rows.seen[a : e + 1], target,
    )  # fmt: skip


def _index(stack: Stack, T: int) -> NDArray[np.int64]:
    return np.zeros(T, dtype=np.int64) if stack[1] is None else stack[1].astype(np.int64)


def _single(belief: MixedBelief, Z: Array) -> MixedBelief:
    """Return one belief as a stack of one, with other generators."""
    return MixedBelief(belief.m[None], belief.P[None], belief.X[None], Z)


def _unit(P: Array, X: Array, kappa: float) -> Array:
    """Return the sizes after the first row, in whose units beliefs are rounded: the user's units do not matter."""
    size = np.sqrt(np.maximum(np.diagonal(kappa**2 * P + X), 0.0))
    return np.where(size > 0, size, 1.0)


def _rounded(grid: NDArray[np.int64], unit: Array, start: MixedBelief) -> MixedBelief:
    """Return the belief of a point of the grid."""
    P, X = (_of_grid(part, unit) for part in np.split(grid, 2))
    return MixedBelief(start.m, P, X, start.Z[:0])


def _grid(S: Array, unit: Array) -> NDArray[np.int64]:
    """Return matrices (T, n, n) on a grid, (T, n + n n): sizes by steps of a fifth, correlations by eighths."""
    size = np.sqrt(np.maximum(np.diagonal(S, axis1=1, axis2=2), 0.0))
    some = size > 0
    size = np.where(some, size, unit)
    steps = np.where(some, np.round(4 * np.log2(size / unit)), _NONE / 2)
    correlation = np.round(8 * S / size[:, :, None] / size[:, None, :])
    return np.concatenate([steps, correlation.reshape(len(S), -1)], axis=1).astype(np.int64)


def _of_grid(grid: NDArray[np.int64], unit: Array) -> Array:
    """Return the matrix of a point of the grid, made positive semidefinite."""
    n = int((np.sqrt(1 + 4 * len(grid)) - 1) / 2)
    size = np.where(grid[:n] > _NONE // 4, unit * 2.0 ** (grid[:n].clip(-2000, 2000) / 4), 0.0)
    F = root(grid[n:].reshape(n, n) / 8.0)
    return np.asarray(size[:, None] * (F @ F.T) * size)


# ---- row by row ------------------------------------------------------------------------------------------------------


class WindowStream:
    """A `MixedWindow` that holds its newest rows, and the filter's beliefs before each."""

    def __init__(self, method: MixedWindow, model: Linear, t: float) -> None:
        reason = method.refuses(model)
        if reason is not None:
            message, hint = hinted(reason)
            raise Refused(message, hint=hint)
        self.method, self.model = method, model
        self.filter = MixedFilter(form="ellipsoid", kappa=method.kappa).stream(model, t)
        self.start = prior(model)
        self.unit: Array | None = None
        self.rows: list[tuple[MixedRows, MixedBelief, float]] = []  # laid out, the belief after, the time
        self._kind = newest_kind(typed(method), model)

    @property
    def t(self) -> float:
        """Time of the newest row, s."""
        return self.filter.t

    @property
    def pushed(self) -> int:
        """Number of rows pushed so far."""
        return self.filter.pushed

    def push(self, y: ArrayLike | None, u: ArrayLike | None = None, dt: float | None = None) -> Estimate:
        """Fold one row in and return the estimate of `lag` rows ago."""
        laid, out = self.filter.pushed_rows(y, u, dt)
        if self.unit is None:
            self.unit = _unit(out["P"][0], out["X"][0], self.method.kappa)
        self.rows = [*self.rows[-int(self.method.memory) :], (laid, self.filter.belief, self.filter.t)]
        first = 0 if self.pushed <= self.method.memory else 1  # of a full window the row before it is held too
        held = self.rows[first:]
        target = max(len(held) - 1 - int(self.method.lag), 0)
        rows = [one for one, _, _ in held]
        A, Q, G, C, r, half = (np.concatenate([getattr(one, name)[0] for one in rows]) for name in _LAID)
        seen = np.concatenate([one.seen for one in rows])
        window = Window(A, Q, G, C, r[:, 0], half[:, 0], seen, target)
        if first == 0:
            arrival, before = self.start, _single(self.start, self.start.Z)
        else:
            _, belief, _ = self.rows[0]
            grid = np.concatenate([_grid(S[None], self.unit)[0] for S in belief[1:3]])
            arrival = _rounded(grid, self.unit, self.start)
            before = _single(belief, self.start.Z[:0])
        found = design(window, arrival, self.method.kappa)
        code = self.filter.code
        if found is None:
            _, belief, _ = held[target]
            x, P, reach = belief.m, belief.P, np.sqrt(np.maximum(np.diagonal(belief.X), 0.0))
            code = max(code, 2)
        else:
            outputs = np.concatenate([one.y for one in rows])[window.seen]
            b = None if rows[0].b is None else np.concatenate([one.b[0] for one in rows if one.b is not None])[None]
            x, P, reach = (part[0] for part in found.apply(before, outputs[None], b))
        newest: Estimate = object.__new__(self._kind)
        object.__setattr__(newest, "_belief", Pushed(held[target][2], x, P, reach, code, self.pushed))
        return newest

    def snapshot(self) -> bytes:
        """Return the rows held and the filter's belief, as bytes."""
        rows = [
            {
                "t": t, "y": one.y.tolist(), "b": None if one.b is None else one.b.tolist(), "seen": one.seen.tolist(),
                "laid": {name: getattr(one, name)[0].tolist() for name in _LAID},
                "belief": [part.tolist() for part in belief[:3]],
            }
            for one, belief, t in self.rows
        ]  # fmt: skip
        unit = None if self.unit is None else self.unit.tolist()
        return json.dumps({"filter": self.filter.snapshot().decode(), "unit": unit, "rows": rows}).encode()

    def restore(self, saved: bytes) -> None:
        """Take up the rows of a snapshot."""
        held = json.loads(saved)
        self.filter.restore(held["filter"].encode())
        self.unit = None if held["unit"] is None else np.array(held["unit"], dtype=float)
        self.rows = []
        n, ny = self.model.nx, self.model.ny
        for row in held["rows"]:
            stacks = {name: np.array(row["laid"][name], dtype=float) for name in _LAID}
            stacks["G"] = stacks["G"].reshape(1, n, -1)
            if stacks["A"].shape != (1, n, n) or stacks["C"].shape != (1, ny, n):
                raise ValueError(f"it holds rows of another model than one with {n} states and {ny} outputs")
            b = None if row["b"] is None else np.array(row["b"], dtype=float)
            laid = MixedRows(
                **{name: (stack, None) for name, stack in stacks.items()}, b=b, y=np.array(row["y"], dtype=float),
                seen=np.array(row["seen"], dtype=bool), B=None, M=(np.eye(ny)[None], None),
            )  # fmt: skip
            m, P, X = (np.array(part, dtype=float) for part in row["belief"])
            belief = MixedBelief(m, P, X, np.zeros((0, n)))
            self.rows.append((laid, belief, float(row["t"])))


#: Parts of a row that a window reads.
_LAID = ("A", "Q", "G", "C", "r", "half")
