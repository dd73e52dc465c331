"""A window that takes a record row by row: what `Window` does off line and on line, and the rows it keeps for it.

A row whose outputs are all unseen says nothing new: the estimate moves on along the model, and no program is solved.
Any other row ends a window. It is solved

- as one linear program for ``BatchLP``; an optimal point begins at the well-centred iterate of the window before,
- by linearisation about the window before, its states and theta, for ``SequentialLP``: one program a row with
  ``rounds=1``,
- by the method's own `run` for any other method.

References
----------
Pavelková and Kárný (2013), secs. 2, 5.1, 5.2.
"""

import json
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.array import Array
from halfwidth.methods._carry import Carried
from halfwidth.methods._linearised import (
    expected,
    filled,
    growth,
    rows_of,
    scaled_costs,
    start_theta,
)
from halfwidth.methods._protocol import Estimator, pushed_row, typed
from halfwidth.methods._residuals import half_width_bounds, reference, residuals
from halfwidth.methods._sites import groups
from halfwidth.methods.map import BatchLP
from halfwidth.methods.posterior import Posterior
from halfwidth.methods.sequential import SequentialLP
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.solvers.banded import Start, chain_of, solve
from halfwidth.spread import Both, Box, Cloud, Normal, Shaped, Spread
from halfwidth.spread import part as rows_of_spread

if TYPE_CHECKING:
    from halfwidth.methods.window import Window

#: Relative gap of a window's optimum.
TOL = 1e-8


class Solved(NamedTuple):
    """One window: states (rows + 1, nx), theta, half-widths (nx + ny,), how it went, the spread of its rows, variances.

    Variances (nx + ny,) are None where none is unknown; NaN stands for an entry that has none, as in half-widths.
    """

    x: Array
    theta: Array
    s: Array
    status: Status
    iterations: int
    info: dict[str, Any]
    spread: Spread | None = None
    variances: Array | None = None


class Forecasts:
    """Where the newest windows expect the state to be now.

    Each window's newest state moves along with the model. The half-widths are estimates of what the state may stray by
    in a step: since the last fix their largest among these windows adds up, as bounds do. Where they are 0, as optimal
    ones often are, nothing adds up.

    Attributes
    ----------
    x, q : (n, nx) arrays
        Expected states, half-widths of the state noise.
    grown : (nx,) array
        What has added up.
    """

    def __init__(self, nx: int) -> None:
        self.x, self.q, self.grown = np.zeros((0, nx)), np.zeros((0, nx)), np.zeros(nx)

    def move(self, model: Model, record: Record, k: int, x: Array) -> Array:
        """Move on to row k; returns what is expected after x, the estimate of the row before."""
        moved = expected(model, record, k, np.concatenate((x[None], self.x)))
        if len(self.q):
            self.grown = growth(model, record, k, x, self.grown, self.q.max(axis=0))
        if isinstance(model.bounds, Box):
            moved = np.minimum(np.maximum(moved, model.bounds.lo), model.bounds.hi)
        self.x = moved[1:]
        return np.asarray(moved[0])

    def take(self, x: Array, q: Array, memory: int) -> None:
        """Add the estimate of a window that ends in a fix."""
        self.x, self.q = (
            np.concatenate((self.x, x[None]))[-memory - 1 :],
            np.concatenate((self.q, q[None]))[-memory - 1 :],
        )
        self.grown = np.zeros_like(self.grown)

    def bounds(self) -> tuple[Array, Array, int]:
        """Return the least and the largest, and of how many windows."""
        if not len(self.x):
            return np.full_like(self.grown, -np.inf), np.full_like(self.grown, np.inf), 0
        return self.x.min(axis=0) - self.grown, self.x.max(axis=0) + self.grown, len(self.x)


class Sliding:
    """A window fed row by row: it keeps the rows that the next window may need, nothing else.

    Attributes
    ----------
    first : int
        Number of the first row held.
    times, y, u : (n,), (n, ny), (n, nu) arrays
        The rows held.
    x, low, high : (n + 1, nx) arrays
        Newest, least and largest estimate of each state held: the one before the first row, then one a row.
    """

    def __init__(self, window: "Window", model: Model, t: float, seed: int | None = None) -> None:
        self.window, self.model, self.seed = window, model, seed
        self.t, self.before = t, t  # time of the newest row, and of the one before the first held
        self.first = self.pushed = 0
        self.times, self.y, self.u = np.zeros(0), np.zeros((0, model.ny)), np.zeros((0, model.nu))
        self.seen = np.zeros((0, model.ny), dtype=bool)
        self.x = np.array(model.x0.mean, dtype=float)[None]
        self.low, self.high = np.full((1, model.nx), np.inf), np.full((1, model.nx), -np.inf)
        self.knows = not getattr(model, "theta_entries", ()) or isinstance(window.method, SequentialLP)
        self.used = np.zeros(model.ny, dtype=bool)  # outputs seen before the first row held
        self.edge = np.ones(model.ny, dtype=bool)  # ... and in the row right before it
        self.since = 0  # rows since any output was seen
        self.ahead = Forecasts(model.nx)
        self.theta = np.zeros(0)
        self.costs: Array | None = None
        self.start: Start | None = None
        self.last: Solved | None = None
        self.carried = carried_of(window, model)

    def push(self, y: Array, u: Array | None, dt: float) -> Solved:
        """Fold one row in: solve the window that ends in it."""
        window, model = self.window, self.model
        self.t += dt
        self.times = np.concatenate((self.times, (self.t,)))
        self.y = np.concatenate((self.y, y[None]))
        self.seen = seen = np.concatenate((self.seen, ~np.isnan(y)[None]))
        if u is not None:
            self.u = np.concatenate((self.u, u[None]))
        self.pushed += 1
        a = int(window_starts(seen, window.memory, fixes=window.fixes, stretch=window.stretch)[-1])
        last = window_lasts(seen, window.memory, self.used, self.edge)  # by place: the first is before the rows held
        part = Record.of(self.times[a:], self.y[a:], self.u[a:] if model.nu else None, seen[a:])
        if self.carried is not None:
            self.carried.leave(a)
        local = self._local(a, len(self.times) - 1 >= last[a])
        self.since = 0 if seen[-1].any() else self.since + 1
        method = window.method
        if self.last is None and isinstance(method, SequentialLP):
            self.theta = start_theta(rows_of(local, part, method.drift), method.theta)
        known = local
        if isinstance(local, Linear) and isinstance(method, SequentialLP):
            known = filled(local, self.theta[: len(local.theta_entries)])
        newest = self.ahead.move(known, part, len(part) - 1, self.x[-1]) if self.knows else self.x[-1]
        self.x = np.concatenate((self.x, newest[None]))
        fresh = self.since == 0 or self.last is None or not isinstance(method, BatchLP | SequentialLP)
        if fresh:
            solved = self._solve(local, part, a)
            self._note_all(a, solved.x, last)
            if self.since == 0 and self.knows and solved.status.good:
                q = solved.s[: model.nx]
                self.ahead.take(solved.x[-1], np.where(np.isnan(q), 0.0, q), window.memory)
        else:
            assert self.last is not None
            solved = self.last._replace(x=self.x[a:].copy(), iterations=0)
            self._note(len(self.x) - 1, self.x[-1], last)
        self.last = solved
        self._forget(a)
        return solved

    def back(self) -> int:
        """Return how many rows ago the state is that is asked for: `lag`, or that of the first row."""
        return min(self.window.lag, self.pushed - 1)

    def _note_all(self, a: int, x: Array, last: NDArray[np.int32]) -> None:
        """Note the estimates x of the states from a on; the newest one has none so far."""
        held = len(self.low) - a
        low, high = self.low[a:], self.high[a:]
        if len(self.times) - 1 <= last[a : a + held].min():
            low, high = np.minimum(low, x[:held]), np.maximum(high, x[:held])
        else:
            open_ = (len(self.times) - 1 <= last[a : a + held])[:, None]
            low, high = (
                np.where(open_, np.minimum(low, x[:held]), low),
                np.where(open_, np.maximum(high, x[:held]), high),
            )
        self.low = np.concatenate((self.low[:a], low, x[held:]))
        self.high = np.concatenate((self.high[:a], high, x[held:]))
        self.x[a:] = x

    def _note(self, k: int, x: Array, last: NDArray[np.int32]) -> None:
        self.x[k] = x
        if k == len(self.low):
            self.low, self.high = np.concatenate((self.low, x[None])), np.concatenate((self.high, x[None]))
        elif len(self.times) - 1 <= last[k]:
            self.low[k], self.high[k] = np.minimum(self.low[k], x), np.maximum(self.high[k], x)

    def _forget(self, a: int) -> None:
        """Let go of the first a rows held: starts never move back."""
        if a == 0:
            return
        self.before = float(self.times[a - 1])
        self.used, self.edge = self.used | self.seen[:a].any(axis=0), self.seen[a - 1]
        self.first += a
        self.times, self.y, self.u, self.seen = self.times[a:], self.y[a:], self.u[a:], self.seen[a:]
        self.x, self.low, self.high = self.x[a:], self.low[a:], self.high[a:]

    def _local(self, a: int, finished: bool) -> Model:
        """Return the model of the rows from a on: stacked matrices cut, the box of its first state."""
        changes: dict[str, Any] = {"dt": float(self.times[a] - (self.times[a - 1] if a else self.before))}
        model, rows = self.model, slice(self.first + a, self.first + len(self.times))
        if isinstance(model, Linear):
            for name, matrix in model.matrices.items():
                if matrix.value is not None and matrix.value.ndim == 3:
                    changes[name] = matrix.value[rows]
        if rows.start > 0 and self.carried is not None and self.carried.first is not None:
            changes["x0"] = self.carried.first
        elif rows.start > 0 and (isinstance(model.x0, Box) or self.carried is not None):
            free = Box(np.full(model.nx, -np.inf), np.full(model.nx, np.inf))
            box = model.bounds if isinstance(model.bounds, Box) else free
            held = interval(self.low[a], self.high[a], self.window.memory, self.window.carry) if finished else None
            changes["x0"] = box if held is None else meet(box, held)
        if changes.keys() <= {"dt", "x0"}:  # both judged already
            local = object.__new__(type(model))
            local.__dict__.update(model.__dict__, **changes)
            return local
        return replace(model, **changes)

    def _solve(self, model: Model, part: Record, a: int) -> Solved:
        method = self.window.method
        if isinstance(method, SequentialLP):
            return self._linearised(method, model, part, a)
        costs = self._costs(model, part) if shares_costs(method, model) else None
        if isinstance(method, BatchLP) and isinstance(model, Linear):
            solved = self._program(method, model, part, a, costs)
            if solved is not None:
                return solved
            est = method.answer(model, part, contradiction=False)
        elif self.carried is not None:
            est = self._posterior(model, part, a)
        else:
            est = method.run(model, part, seed=self.seed)
        told = ("solver", "objective", "notes", "message", "gap", "half_widths", "variances")
        info = {k: v for k, v in est.info.items() if k in told}
        s = _both(est.q, est.r, model)
        variances = None if est.Q is None and est.R is None else _both(est.Q, est.R, model)
        return Solved(
            np.concatenate((est.info.get("x0", self.x[a])[None], est.x)),
            np.zeros(0) if est.theta is None else est.theta, s,
            est.status, int(est.info.get("iterations", 0) or 0), info, est.spread, variances,
        )  # fmt: skip

    def _posterior(self, model: Model, part: Record, a: int) -> Estimate:
        """Estimate one window with what the rows before it told."""
        held, method = self.carried, self.window.method
        assert held is not None
        assert isinstance(method, Posterior)
        seen = np.asarray(part.seen.any(axis=1))
        answer = method.resumed(model, part, held, self.first + a, a, max(len(part) - self.window.lag, 0))
        newest = self.first + len(self.times) - 1
        rows = max(int(seen.sum()), self.window.memory + 1)
        held.take(answer, newest, rows, counts=bool(seen[-1]))
        return answer.estimate

    def _costs(self, model: Model, part: Record) -> Array:
        """Return the scales of the first full window, or of the rows there are."""
        if self.costs is not None:
            return self.costs
        assert isinstance(model, Linear)
        costs = first_costs(model, part, self.window.memory + 1)
        self.costs = costs if self.pushed > self.window.memory else None
        return costs

    def _program(self, method: BatchLP, model: Linear, part: Record, a: int, costs: Array | None) -> Solved | None:
        """Solve the linear program of one window, or return None where the method is more than that."""
        floor, cap = half_width_bounds(model)
        if method.objective == "log" or method.point == "least_squares":
            return None
        chain = chain_of(model, part, np.ones(len(floor)), floor, cap)
        if chain is None:
            return None
        if costs is not None:
            chain = replace(chain, c=costs)
        keep = method.point == "optimal"
        found = solve(chain, point=method.point, tol=TOL, start=self.start if keep else None, drop=a, keep=keep)
        self.start = found.start
        info = {"solver": found.by, "objective": found.objective}
        s = found.s if found.status.good else np.full(len(found.s), np.nan)
        return Solved(found.x, np.zeros(0), s, found.status, found.iterations, info)

    def _linearised(self, method: SequentialLP, model: Model, part: Record, a: int) -> Solved:
        """Solve the window about the one before: its states, the newest one as the model expects it, and its theta."""
        rows: Any = rows_of(model, part, method.drift)
        x, theta = self.x[a:].copy(), self.theta
        c = np.ones(rows.groups)
        if isinstance(model, Nonlinear) or method.objective == "log" or method.point == "least_squares":
            early = self.pushed <= self.window.memory
            x = rows.start(theta) if early else x
            if method.objective != "paper":
                c = rows.weights(x, theta) if self.costs is None else self.costs
                self.costs = None if early else c
            step = method.descend(rows, x, theta, c)
            x, theta, status, answer = step[:4]
            count = 0 if answer is None else answer.iterations
        else:
            if method.objective == "scaled":
                c = self._costs(filled(model, theta[: len(rows.entries)]), rows.clean)
            keep, count = method.point == "optimal", 0
            for again in range(method.rounds):
                answer = solve(
                    rows.chain(x, theta, c), point=method.point, tol=TOL, start=self.start if keep else None,
                    drop=0 if again else a, keep=keep,
                )  # fmt: skip
                self.start, status, count = answer.start, answer.status, count + answer.iterations
                if not status.good:
                    break
                gain, x = float(np.abs(answer.x - x).max()), answer.x
                theta = np.clip(answer.theta, rows.lo, rows.hi)
                if gain <= method.tol * max(float(np.abs(x).max()), 1e-300):
                    break
        good = answer is not None and status.good
        self.theta = theta
        s = answer.s if answer is not None and good else np.full(rows.groups, np.nan)
        info = {} if answer is None else {"solver": answer.by, "objective": answer.objective}
        return Solved(x, theta[: len(rows.entries)], s, status, count, info)

    # ---- as plain numbers -----------------------------------------------------------------------------------------

    def save(self) -> dict[str, Any]:
        """Return all that the next push needs, as plain numbers."""

        def plain(rows: Any) -> Any:
            return [[None if not math.isfinite(v) else v for v in row] for row in rows]

        last = self.last
        return {
            "t": self.t, "before": self.before, "first": self.first, "pushed": self.pushed,
            "times": self.times.tolist(),
            "y": plain(self.y), "u": plain(self.u), "x": plain(self.x), "low": plain(self.low),
            "high": plain(self.high), "used": self.used.tolist(),
            "edge": self.edge.tolist(), "since": self.since,
            "ahead": [plain(self.ahead.x), plain(self.ahead.q), self.ahead.grown.tolist()],
            "theta": self.theta.tolist(), "costs": None if self.costs is None else self.costs.tolist(),
            "start": None if self.start is None else [part.tolist() for part in self.start],
            "carried": None if self.carried is None else self.carried.save(),
            "last": None
            if last is None
            else [
                last.theta.tolist(), plain([last.s])[0], last.status.name,
                None if last.variances is None else plain([last.variances])[0],
            ],
        }  # fmt: skip

    def load(self, saved: dict[str, Any]) -> None:
        """Take up what `save` returned."""

        def arrays(rows: Any, lost: float = math.nan) -> list[Array]:
            return [np.array([lost if v is None else v for v in row], dtype=float) for row in rows]

        self.t, self.before = float(saved["t"]), float(saved["before"])
        self.first, self.pushed = int(saved["first"]), int(saved["pushed"])
        self.times = np.array(saved["times"], dtype=float)
        nx, ny, nu = self.model.nx, self.model.ny, self.model.nu
        self.y, self.u = (np.array(arrays(saved[k])).reshape(len(saved[k]), n) for k, n in (("y", ny), ("u", nu)))
        self.seen = ~np.isnan(self.y)
        self.x, self.low, self.high = (
            np.array(arrays(saved[k], lost)) for k, lost in (("x", math.nan), ("low", math.inf), ("high", -math.inf))
        )
        self.used, self.edge = np.array(saved["used"], dtype=bool), np.array(saved["edge"], dtype=bool)
        self.since = int(saved["since"])
        x, q, grown = saved["ahead"]
        self.ahead.x, self.ahead.q = np.array(x, dtype=float).reshape(-1, nx), np.array(q, dtype=float).reshape(-1, nx)
        self.ahead.grown = np.array(grown, dtype=float)
        self.theta = np.array(saved["theta"], dtype=float)
        self.costs = None if saved["costs"] is None else np.array(saved["costs"], dtype=float)
        self.start = None
        if saved["start"] is not None:
            kinds = nx + self.model.ny
            x, theta, s, lam, box, ends = (np.array(part, dtype=float) for part in saved["start"])
            self.start = (
                x.reshape(-1, nx), theta, s, lam.reshape(-1, kinds, 2), box.reshape(-1, nx, 2), ends.reshape(-1, 2)
            )  # fmt: skip
        if self.carried is not None:
            self.carried.load(saved["carried"])
        self.last = None
        if saved["last"] is not None:
            theta, s, status, v = saved["last"]
            variances = None if v is None else arrays([v])[0]
            self.last = Solved(
                np.array(self.x), np.array(theta, dtype=float), arrays([s])[0], Status[status], 0, {}, None, variances
            )


def _both(of_w: Array | None, of_e: Array | None, model: Model) -> Array:
    """Return what belongs to states and outputs side by side, NaN where there is none."""
    parts = [np.full(n, np.nan) if part is None else part for part, n in ((of_w, model.nx), (of_e, model.ny))]
    return np.concatenate(parts)


def if_found(values: Array, status: Status) -> Array | None:
    """Return a copy of half-widths or variances that a window found, None where it found none."""
    return values.copy() if status.good and bool(np.isfinite(values).all()) else None


def stacked(spreads: list[Spread | None]) -> Spread | None:
    """Return the spreads of single rows as one, None where they differ in kind."""
    first = spreads[0]
    if isinstance(first, Box) and all(isinstance(s, Box) for s in spreads):
        lo, hi = (np.concatenate([getattr(s, end) for s in spreads]) for end in ("lo", "hi"))
        return Box(lo, hi, guaranteed=all(s is not None and s.guaranteed for s in spreads))
    if all(isinstance(s, Normal | Shaped) for s in spreads):
        bent = [s if isinstance(s, Shaped) else _unbent(s) for s in spreads]
        mean, P, skew, kurt = (np.concatenate([getattr(s, f) for s in bent]) for f in ("mean", "P", "skew", "kurt"))
        return Shaped(mean, P, skew, kurt, bent[-1].within)
    if isinstance(first, Both) and all(isinstance(s, Both) for s in spreads):
        return Both(*(np.concatenate([getattr(s, f) for s in spreads]) for f in ("mean", "P", "half")))
    if isinstance(first, Cloud) and all(isinstance(s, Cloud) for s in spreads):
        points, weights = (np.concatenate([getattr(s, f) for s in spreads]) for f in ("points", "weights"))
        return Cloud(points, weights)
    return None


def _unbent(spread: Any) -> Shaped:
    none = np.zeros(spread.mean.shape)
    return Shaped(spread.mean, spread.P, none, none, spread._within)


class Live:
    """The on-line form of `Window`, for `halfwidth.stream`."""

    def __init__(self, window: "Window", model: Model, t: float) -> None:
        self._rows = Sliding(window, model, t)
        self.method = typed(window)

    @property
    def pushed(self) -> int:
        """Number of rows pushed so far."""
        return self._rows.pushed

    @property
    def t(self) -> float:
        """Time of the newest row, s."""
        return self._rows.t

    def push(self, y: ArrayLike | None, u: ArrayLike | None = None, dt: float | None = None) -> Estimate:
        """Fold one row in and return the newest estimate."""
        held = self._rows
        model = held.model
        solved = held.push(*pushed_row(model, y, u, dt))
        low, high, windows = held.ahead.bounds()
        nx, v = model.nx, solved.variances
        back = held.back()
        ago = slice(-1 - back, -back or None)
        return Estimate(
            held.times[ago].copy(),
            held.x[-1 - back][None].copy(),
            None if solved.spread is None else rows_of_spread(solved.spread, ago),
            solved.status,
            self.method,
            q=if_found(solved.s[:nx], solved.status),
            r=if_found(solved.s[nx:], solved.status),
            Q=None if v is None else if_found(v[:nx], solved.status),
            R=None if v is None else if_found(v[nx:], solved.status),
            theta=solved.theta.copy() if solved.theta.size else None,
            names=model.names.x,
            info=solved.info
            | {
                "iterations": solved.iterations, "extrapolated": held.since > 0, "since_fix": held.since,
                "rows": len(held.times),
                "newest_low": low[None], "newest_high": high[None], "newest_windows": np.array([windows]),
            },
        )  # fmt: skip

    def snapshot(self) -> bytes:
        """Return the rows held, as bytes."""
        return json.dumps(self._rows.save()).encode()

    def restore(self, saved: bytes) -> None:
        """Take up the rows of a snapshot."""
        self._rows.load(json.loads(saved))


# ---- which rows a window holds ---------------------------------------------------------------------------------------


def window_starts(
    seen: NDArray[np.bool_], memory: int, *, fixes: int = 10, stretch: int | None = None
) -> NDArray[np.int32]:
    """Return the first row of the window that ends at each row, (T,).

    A window holds the newest `memory` + 1 rows in which any output is seen, and reaches further back until every output
    that has been seen so far has `fixes` (at most `memory` + 1) seen entries in it, but at most `stretch` rows.
    """
    T, ny = seen.shape
    rows = np.arange(T)
    if seen.all():
        return np.maximum(rows - memory, 0).astype(np.int32)
    places = np.flatnonzero(seen.any(axis=1))
    before = np.searchsorted(places, rows, side="right")  # rows with a seen output up to and with each row
    start = np.where(before > memory, np.r_[places, 0][np.maximum(before - memory - 1, 0)], 0)
    for j in range(ny if fixes else 0):
        places = np.flatnonzero(seen[:, j])
        before = np.searchsorted(places, rows, side="right")
        # An output with fewer entries than asked for is taken back to its first one.
        first = np.r_[places, 0][np.maximum(before - min(fixes, memory + 1), 0)]
        start = np.where(before > 0, np.minimum(start, first), start)
    if stretch is not None:
        start = np.maximum(start, rows - stretch + 1)
    return start.astype(np.int32)


def window_lasts(
    seen: NDArray[np.bool_],
    memory: int,
    used: NDArray[np.bool_] | None = None,
    edge: NDArray[np.bool_] | None = None,
) -> NDArray[np.int32]:
    """Return the row whose window is the last to be part of each state's interval, (T + 1,); state 0 is before row 0.

    It is `memory` rows after the state, and after the end of every gap that the state lies in: within a gap all windows
    extrapolate from the same rows and agree, whatever they miss. `used` says which outputs were seen before row 0,
    `edge` which of them in the row before it.
    """
    T, ny = seen.shape
    rows = np.arange(T)
    if seen.all():
        last = np.arange(memory - 1, T + memory, dtype=np.int32)
        if used is not None and edge is not None:
            last[0] += bool((used & ~edge).any())
        return last
    end, first = rows.copy(), -1
    for j in range(ny):
        later = np.minimum.accumulate(np.where(seen[:, j], rows, T - 1)[::-1])[::-1]
        there = np.logical_or.accumulate(seen[:, j]) | (used is not None and bool(used[j]))
        end = np.maximum(end, np.where(there, later, rows))
        if used is not None and edge is not None and used[j] and not edge[j]:
            first = max(first, int(later[0]))
    return np.asarray(np.r_[first, end] + memory, dtype=np.int32)


def rows_since_fix(seen: NDArray[np.bool_]) -> NDArray[np.int_]:
    """Return how many rows ago any output was last seen, (T,); 0 where one is seen now."""
    rows = np.arange(len(seen))
    last = np.maximum.accumulate(np.where(seen.any(axis=1), rows, -1))
    return rows - last


def interval(low: Array, high: Array, memory: int, carry: float | None) -> Box | None:
    """Return the finished interval of a state, if it is to be carried."""
    if carry is None or not np.all(high > low):
        return None
    factor = carry * (memory / (memory - 2.0) if memory > 2 else 1.0)
    mid, half = 0.5 * (low + high), 0.5 * factor * (high - low)
    return Box(mid - half, mid + half)


def meet(box: Box, other: Box) -> Box:
    """Return the intersection; the first box where they do not meet."""
    lo, hi = np.maximum(box.lo, other.lo), np.minimum(box.hi, other.hi)
    empty = lo >= hi
    return Box(np.where(empty, box.lo, lo), np.where(empty, box.hi, hi))


# ---- what all windows share ------------------------------------------------------------------------------------------


def first_costs(model: Linear, record: Record, rows: int) -> Array:
    """Return N_j / sigma_j of each group from the first rows of a record."""
    b = min(len(record), rows)
    first = Record(record.t[:b], record.y[:b], None if record.u is None else record.u[:b])
    cut = {k: m.value[:b] for k, m in model.matrices.items() if m.value is not None and m.value.ndim == 3}
    short = replace(model, **cut) if cut else model  # type: ignore[arg-type]
    floor, cap = half_width_bounds(model)
    base = reference(residuals(short, first), short, np.where(floor == cap, floor / math.sqrt(3.0), 0.0))
    count = np.r_[np.full(model.nx, b), first.seen.sum(axis=0)]
    return scaled_costs(count, base.sigma)


def carried_of(window: "Window", model: Model) -> Carried | None:
    """Return what hands knowledge from window to window, for a method that can take it."""
    method = window.method
    if window.recall == 0 or not isinstance(method, Posterior) or method.method != "ep":
        return None
    if isinstance(model, Linear) and model.theta_entries:
        return None
    return Carried(groups(model), window.recall * (window.memory + 1))


def shares_costs(method: Estimator, model: Model) -> bool:
    """Say whether all windows of a method are given the scales of the first full one."""
    return isinstance(method, BatchLP) and method.objective == "scaled" and isinstance(model, Linear)
