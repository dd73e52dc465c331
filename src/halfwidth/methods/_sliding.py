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
from numpy.typing import ArrayLike

from halfwidth.array import Array
from halfwidth.methods._ahead import Forecasts
from halfwidth.methods._carry import Carried
from halfwidth.methods._linearised import (
    filled,
    rows_of,
    scaled_costs,
    start_theta,
)
from halfwidth.methods._noise_parts import groups
from halfwidth.methods._protocol import Estimator, pushed_row, typed
from halfwidth.methods._residuals import half_width_bounds, reference, residuals
from halfwidth.methods._rows import Rows
from halfwidth.methods.map import BatchLP
from halfwidth.methods.posterior import Posterior
from halfwidth.methods.sequential import SequentialLP
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.solvers.banded import Start, solve
from halfwidth.solvers.chain import chain_of
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


_NONE = np.zeros(0)


class Sliding:
    """A window fed row by row: it keeps the rows that the next window may need, nothing else.

    Attributes
    ----------
    held : Rows
    pushed : int
        Rows that came in so far.
    t : float
        Time of the newest row.
    since : int
        Rows since any output was seen.
    """

    def __init__(self, window: "Window", model: Model, t: float, seed: int | None = None) -> None:
        self.window, self.model, self.seed = window, model, seed
        self.t, self.pushed, self.since = t, 0, 0
        self.held = Rows(np.array(model.x0.mean, dtype=float), model.ny, model.nu, t)
        entries = getattr(model, "theta_entries", ())
        self.knows = not entries or isinstance(window.method, SequentialLP)
        self.ahead = Forecasts(model, window.memory)
        self.theta = np.zeros(0)
        self.costs: Array | None = None
        self.start: Start | None = None
        self.last: Solved | None = None
        self.carried = carried_of(window, model)
        matrices = model.matrices if isinstance(model, Linear) else {}
        self._stacks = {k: m.value for k, m in matrices.items() if m.value is not None and m.value.ndim == 3}
        self._always = not isinstance(window.method, BatchLP | SequentialLP)

    @property
    def first(self) -> int:
        """Number of the first row held."""
        return self.held.first

    @property
    def x(self) -> Array:
        """Newest estimates of the states held, (n + 1, nx); `low` and `high` are the least and the largest."""
        return self.held.x

    @property
    def low(self) -> Array:
        """As `x`."""
        return self.held.low

    @property
    def high(self) -> Array:
        """As `x`."""
        return self.held.high

    def push(self, y: Array, u: Array | None, dt: float) -> Solved:
        """Fold one row in: solve the window that ends in it."""
        window, held, method = self.window, self.held, self.window.method
        self.t += dt
        self.pushed += 1
        self.since = 0 if held.append(self.t, y, u) else self.since + 1
        a = held.start(window.memory, window.fixes, window.stretch)
        part = Record.of(held.times[a:], held.y[a:], held.u[a:] if self.model.nu else None, held.seen[a:])
        if self.carried is not None:
            self.carried.leave(a)
        local = self._local(a)
        if self.last is None and isinstance(method, SequentialLP):
            self.theta = start_theta(rows_of(local, part, method.drift), method.theta)
        known = local
        if isinstance(local, Linear) and isinstance(method, SequentialLP):
            known = filled(local, self.theta[: len(local.theta_entries)])
        newest, x = len(part) - 1, held.x[-2]
        held.x[-1] = self.ahead.move(known, part, newest, x) if self.knows else x
        taken = False
        if self.since == 0 or self.last is None or self._always:
            x = x.copy()
            solved = self._solve(local, part, a)
            held.note(a, solved.x, window.memory)
            if self.since == 0 and self.knows and solved.status.good:
                self.ahead.take(solved.x[-1], half_widths_of(solved.s, self.model.nx))
                taken = True
        else:
            assert self.last is not None
            solved = self.last._replace(x=held.x[a:].copy(), iterations=0)
            held.note_newest(held.x[-1])
        if self.knows and not taken:
            self.ahead.grow(known, part, newest, x)
        self.last = solved
        held.forget(a)
        return solved

    def back(self) -> int:
        """Return how many rows ago the state is that is asked for: `lag`, or that of the first row."""
        return min(self.window.lag, self.pushed - 1)

    def _local(self, a: int) -> Model:
        """Return the model of the rows from a on: stacked matrices cut, the box of its first state."""
        held, model = self.held, self.model
        rows = slice(held.first + a, held.first + len(held))
        changes: dict[str, Any] = {k: value[rows] for k, value in self._stacks.items()}
        changes["dt"] = float(held.times[a]) - (float(held.times[a - 1]) if a else held.before)
        if rows.start > 0 and self.carried is not None and self.carried.first is not None:
            changes["x0"] = self.carried.first
        elif rows.start > 0 and (isinstance(model.x0, Box) or self.carried is not None):
            free = Box(np.full(model.nx, -np.inf), np.full(model.nx, np.inf))
            box = model.bounds if isinstance(model.bounds, Box) else free
            memory, carry = self.window.memory, self.window.carry
            finished = carry is not None and held.over(len(held), memory) > a
            given = interval(held.low[a], held.high[a], memory, carry) if finished else None
            changes["x0"] = box if given is None else meet(box, given)
        if not self._stacks:  # both judged already
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
            return self._posterior(model, part, a)
        else:
            est = method.run(model, part, seed=self.seed)
        told = ("solver", "objective", "notes", "message", "gap", "half_widths", "variances")
        info = {k: v for k, v in est.info.items() if k in told}
        s = _both(est.q, est.r, model)
        variances = None if est.Q is None and est.R is None else _both(est.Q, est.R, model)
        return Solved(
            np.concatenate((est.info.get("x0", self.held.x[a])[None], est.x)),
            np.zeros(0) if est.theta is None else est.theta, s,
            est.status, int(est.info.get("iterations", 0) or 0), info, est.spread, variances,
        )  # fmt: skip

    def _posterior(self, model: Model, part: Record, a: int) -> Solved:
        """Solve one window with what the rows before it told."""
        held, method = self.carried, self.window.method
        assert held is not None
        assert isinstance(method, Posterior)
        shaped = max(len(part) - self.window.lag, 0)
        answer = method.resumed(model, part, held, self.held.first + a, a, shaped, self.held.x[a:])
        newest = self.held.first + len(self.held) - 1
        rows = max(int(np.count_nonzero(part.seen.any(axis=1))), self.window.memory + 1)
        held.take(answer, newest, rows, counts=self.since == 0)
        return Solved(answer.x, _NONE, answer.s, answer.status, 0, answer.said, answer.spread, answer.variances)

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
        x, theta = self.held.x[a:].copy(), self.theta
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

        last, held = self.last, self.held
        return {
            "t": self.t, "before": held.before, "first": held.first, "pushed": self.pushed,
            "times": held.times.tolist(),
            "y": plain(held.y), "u": plain(held.u), "x": plain(held.x), "low": plain(held.low),
            "high": plain(held.high), "used": held.used.tolist(),
            "edge": held.edge.tolist(), "since": self.since, "ahead": self.ahead.save(),
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

        held, nx, ny, nu = self.held, self.model.nx, self.model.ny, self.model.nu
        self.t, self.pushed, self.since = float(saved["t"]), int(saved["pushed"]), int(saved["since"])
        held.before, held.first = float(saved["before"]), int(saved["first"])
        held.used, held.edge = np.array(saved["used"], dtype=bool), np.array(saved["edge"], dtype=bool)
        y, u = (np.array(arrays(saved[k])).reshape(len(saved[k]), n) for k, n in (("y", ny), ("u", nu)))
        states = [np.array(arrays(saved[k], v)) for k, v in (("x", math.nan), ("low", math.inf), ("high", -math.inf))]
        held.put(np.array(saved["times"], dtype=float), y, u, ~np.isnan(y), *states)
        self.ahead.load(saved["ahead"])
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
                held.x.copy(), np.array(theta, dtype=float), arrays([s])[0], Status[status], 0, {}, None, variances
            )


def _both(of_w: Array | None, of_e: Array | None, model: Model) -> Array:
    """Return what belongs to states and outputs side by side, NaN where there is none."""
    parts = [np.full(n, np.nan) if part is None else part for part, n in ((of_w, model.nx), (of_e, model.ny))]
    return np.concatenate(parts)


def half_widths_of(s: Array, nx: int) -> list[float]:
    """Return those of the states from all of a window, 0 where there is none."""
    return [v if v == v else 0.0 for v in s[:nx].tolist()]


def if_found(values: Array, status: Status) -> Array | None:
    """Return a copy of half-widths or variances that a window found, None where it found none."""
    return values.copy() if status.good and all(map(math.isfinite, values.tolist())) else None


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
        rows = self._rows
        model, held = rows.model, rows.held
        solved = rows.push(*pushed_row(model, y, u, dt))
        low, high, windows = rows.ahead.bounds()
        nx, v = model.nx, solved.variances
        back = rows.back()
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
                "iterations": solved.iterations, "extrapolated": rows.since > 0, "since_fix": rows.since,
                "rows": len(held),
                "newest_low": low, "newest_high": high, "newest_windows": np.array([windows]),
            },
        )  # fmt: skip

    def snapshot(self) -> bytes:
        """Return the rows held, as bytes."""
        return json.dumps(self._rows.save()).encode()

    def restore(self, saved: bytes) -> None:
        """Take up the rows of a snapshot."""
        self._rows.load(json.loads(saved))


# ---- the first state of a window -------------------------------------------------------------------------------------


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
