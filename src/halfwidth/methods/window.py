"""Window: any batch method on a sliding window of the record, one estimate a row.

At row t the method sees rows ``start(t)`` to t only, so the cost of a row does not grow and old data are forgotten. A
window holds ``memory + 1`` rows, and **stretches**: it reaches further back until every output that is ever seen has
``fixes`` seen entries in it, so that during and after an outage longer than the memory the window still holds a fix
on the far side. A row whose window ends in unseen outputs **extrapolates**; ``info["extrapolated"]`` says so.

Every state is estimated by several windows. The paper takes the least and the largest of these estimates, s_lo and
s_hi, for its interval

    mu +- kappa rho,    mu = (s_hi + s_lo) / 2,    rho = n / (n - 2) (s_hi - s_lo) / 2          (27)-(31)

with n + 1 the number of estimates; `ensemble_interval` returns it. Its kappa has no calibrated level: use
``Posterior`` where a probability is wanted. With ``carry=kappa`` the interval of the state that has just left the
window bounds the first state of the next one.

References
----------
Pavelková and Kárný (2013), secs. 2, 5.1, 5.2. Rao, Rawlings and Mayne (2003), IEEE TAC 48(2): moving horizons.
"""

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.errors import BadValue, Refused
from halfwidth.methods._protocol import Estimator, pushed_row, typed
from halfwidth.methods._residuals import reference, residuals
from halfwidth.methods.map import BatchLP
from halfwidth.methods.sequential import (
    LinearRows,
    SequentialLP,
    half_width_bounds,
    scaled_costs,
    start_theta,
)
from halfwidth.model import Linear, Model
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.solvers.banded import POINTS, Chain, chain_of, solve
from halfwidth.spread import Box, Cloud, Normal, Shaped, Spread

_STATUS = (Status.OK, Status.REDUCED, Status.INFEASIBLE, Status.STALLED)
#: Rows, in units of the window, from which the scales of `SequentialLP` are found.
_FIRST = 4


@dataclass(frozen=True)
class Window:
    """A batch method on a sliding window.

    Parameters
    ----------
    method : estimator
        Such as ``BatchLP()`` or ``SequentialLP(rounds=1)``.
    memory : int
        The window holds the newest row and `memory` rows before it; `choose_memory` finds it from data.
    carry : float or None
        kappa with which a finished interval bounds the state that a window starts from; None leaves it free in the
        model's box.
    fixes : int
        Seen entries that a window holds of every output, by reaching further back where it must.
    stretch : int or None
        Most rows of a stretched window; None is no limit.

    Notes
    -----
    ``x[k]`` is the newest state of the window that ends at row k. In ``info``: ``smoothed`` (T, nx), the last
    estimate of each state; ``low``, ``high`` and ``windows``, what `ensemble_interval` needs; ``q``, ``r``, ``theta``
    of every window; ``start``, ``extrapolated``, ``statuses`` of every row. Those of the estimate
    itself are the last window's; its status is the worst of all windows.

    Raises
    ------
    BadValue
        If a setting is out of its domain.

    Examples
    --------
    >>> import halfwidth as hw
    >>> unknown = hw.Uniform.unknown(at_most=10.0)
    >>> walk = hw.Linear([[1]], None, [[1]], unknown, unknown, None)
    >>> est = hw.estimate(walk, hw.Record(range(8), [0, 1, 2, 3, None, None, 6, 7]), hw.Window(hw.BatchLP(), memory=3))
    >>> est.info["extrapolated"].nonzero()[0]
    array([4, 5])
    """

    method: Estimator = dataclasses.field(default_factory=BatchLP)
    memory: int = 25
    carry: float | None = None
    fixes: int = 3
    stretch: int | None = None

    def __post_init__(self) -> None:
        if isinstance(self.method, type) or not isinstance(self.method, Estimator) or isinstance(self.method, Window):
            raise BadValue(f"`method` is {self.method!r}, a batch estimator such as BatchLP() was expected")
        if not isinstance(self.memory, int | np.integer) or self.memory < 1:
            raise BadValue(f"`memory` is {self.memory!r}, a positive whole number of rows was expected")
        if self.carry is not None and not self.carry > 0:
            raise BadValue(f"`carry` is {self.carry!r}, a positive number or None was expected")
        if self.fixes < 0:
            raise BadValue(f"`fixes` is {self.fixes!r}, 0 or more was expected")
        if self.stretch is not None and self.stretch < self.memory + 1:
            raise BadValue(f"`stretch` is {self.stretch!r}, at least memory + 1 = {self.memory + 1} was expected")

    def refuses(self, model: Model) -> str | None:
        """Return why the method inside cannot take the model, or None."""
        reason = self.method.refuses(model)
        return None if reason is None else f"inside `Window`, {reason}"

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:
        """Estimate the newest state at every row."""
        start = window_starts(record.seen, self.memory, fixes=self.fixes, stretch=self.stretch)
        found: _Found | None = None
        if isinstance(model, Linear) and isinstance(self.method, BatchLP) and not model.theta_entries:
            found = self._batch(model, record, start)
        elif isinstance(model, Linear) and isinstance(self.method, SequentialLP):
            found = self._sequential(model, record, start)
        if found is None:
            found = self._any(model, record, start, seed)
        return self._estimate(model, record, start, found)

    def stream(self, model: Model, t: float) -> "_Live":
        """Return the on-line form, for `halfwidth.stream`."""
        return _Live(self, model, t)

    # ---- the three ways through a record --------------------------------------------------------------------------

    def _batch(self, model: Linear, record: Record, start: NDArray[np.int32]) -> "_Found | None":
        """All windows in one call of the core."""
        method = cast(BatchLP, self.method)
        if method.objective == "log" or method.point == "least_squares":
            return None
        chain = window_chain(method, model, record, self.memory)
        if chain is None:
            return None
        assert isinstance(model.x0, Box)
        c = chain
        filtered, smoothed, s, low, high, codes, seconds = _core.lp_windows(
            c.E, c.A, c.C, c.bx, c.by, c.seen, c.lo, c.hi, c.x0_lo, c.x0_hi, c.group, c.h, c.c, c.floor, c.cap,
            start, self.memory, self.carry or 0.0, POINTS[method.point],
        )  # fmt: skip
        found = _Found(filtered, smoothed, s, low, high, [_STATUS[k] for k in codes[0]], codes[1], None, seconds)
        if method.objective == "scaled":
            # Before the first full window the scales are those of the rows there are.
            for t in range(min(self.memory, len(record))):
                early = replace(chain.part(0, t + 1), c=first_costs(model, record, t + 1))
                answer = solve(early, point=method.point)
                found.statuses[t], found.filtered[t], found.s[t] = answer.status, answer.x[-1], answer.s
                codes[0][t] = 0
        for t in np.flatnonzero(codes[0] >= 2).tolist():
            # What the core does not certify is asked of the stock solvers, which also prove infeasibility.
            answer = solve(chain.part(int(start[t]), t + 1), point=method.point)
            found.statuses[t] = answer.status
            if answer.status.good:
                found.filtered[t], found.s[t] = answer.x[-1], answer.s
        return found

    def _sequential(self, model: Linear, record: Record, start: NDArray[np.int32]) -> "_Found":
        """One or a few linearisations a row, about the last window's estimate."""
        method = cast(SequentialLP, self.method)
        rows = LinearRows(model, record, method.drift)
        theta = start_theta(rows, method.theta)
        T, nx = len(record), model.nx
        c = np.ones(rows.groups)
        if method.objective == "scaled":
            first = Record(record.t[: _FIRST * (self.memory + 1)], record.y[: _FIRST * (self.memory + 1)],
                           None if record.u is None else record.u[: _FIRST * (self.memory + 1)])  # fmt: skip
            some = LinearRows(model, first, None)
            c = some.weights(some.start(theta), theta)
        x = np.zeros((T + 1, nx))
        assert isinstance(model.x0, Box)
        x[0] = model.x0.mean
        found = _Found.empty(T, nx, rows.groups, len(rows.entries))
        box = model.bounds
        for t in range(T):
            a = int(start[t])
            if t > 0 or rows.entries:
                x[t + 1] = self._predicted(rows, x[t], theta, t)
            if box is not None:
                x[t + 1] = np.clip(x[t + 1], box.lo, box.hi)
            answer = None
            for _ in range(method.rounds):
                chain = rows.chain(x[a : t + 2], theta, c, a, t + 1)
                chain = self._carried(chain, found, a, t)
                answer = solve(chain, point=method.point)
                if not answer.status.good:
                    break
                gain = np.abs(answer.x - x[a : t + 2]).max(initial=0.0)
                x[a : t + 2] = answer.x
                theta = np.clip(answer.theta, rows.lo, rows.hi) if len(rows.lo) else theta
                if gain <= method.tol * max(float(np.abs(answer.x).max(initial=0.0)), 1e-300):
                    break
            assert answer is not None
            found.take(t, a, x, theta, answer.s, answer.status, answer.iterations, self.memory)
        return found

    def _predicted(self, rows: LinearRows, x: Array, theta: Array, t: int) -> Array:
        new = rows.matrices(theta[: len(rows.entries)])
        model, record = rows.known, rows.record
        dt = float(record.t[t] - record.t[t - 1]) if t else model.dt
        A = new.get("A", None)
        A = model.A.at(float(record.t[t]), dt, t) if A is None else A
        moved = A @ x
        if model.B is not None and record.u is not None:
            B = new.get("B", None)
            moved = moved + (model.B.at(float(record.t[t]), dt, t) if B is None else B) @ record.u[t]
        E = new.get("E", None)
        if E is None and model.E is not None:
            E = model.E.at(float(record.t[t]), dt, t)
        return np.asarray(moved if E is None else np.linalg.solve(E, moved), dtype=np.float64)

    def _any(self, model: Model, record: Record, start: NDArray[np.int32], seed: int | None) -> "_Found":
        """Run the method on each window's own record."""
        T = len(record)
        found = _Found.empty(T, model.nx, model.nx + model.ny, len(getattr(model, "theta_entries", ())))
        x = np.zeros((T + 1, model.nx))
        costs: Array | None = None
        for t in range(T):
            a = int(start[t])
            part = Record(record.t[a : t + 1], record.y[a : t + 1], None if record.u is None else record.u[a : t + 1])
            local = self._local(model, record, found, a, t)
            if shares_costs(self.method, model) and t <= self.memory:
                assert isinstance(local, Linear)
                costs = first_costs(local, part, self.memory + 1)
            est = window_estimate(self.method, local, part, costs, seed)
            x[a + 1 : t + 2] = est.x
            x[a] = est.info.get("x0", x[a])
            s = np.full(model.nx + model.ny, np.nan)
            if est.q is not None and est.r is not None:
                s = np.r_[est.q, est.r]
            theta = np.zeros(0) if est.theta is None else est.theta
            found.take(t, a, x, theta, s, est.status, int(est.info.get("iterations", 0) or 0), self.memory)
            found.spreads.append(newest(est.spread))
        return found

    def _local(self, model: Model, record: Record, found: "_Found", a: int, t: int) -> Model:
        """Return the model of rows a to t: stacked matrices cut, the box of its first state."""
        if a == 0 and t + 1 == len(record):
            return model
        changes: dict[str, Any] = {}
        if isinstance(model, Linear):
            for name, matrix in model.matrices.items():
                if matrix.value is not None and matrix.value.ndim == 3:
                    changes[name] = matrix.value[a : t + 1]
            changes["dt"] = float(record.t[a] - record.t[a - 1]) if a else model.dt
        if a > 0 and isinstance(model.x0, Box):
            free = Box(np.full(model.nx, -np.inf), np.full(model.nx, np.inf))
            box = model.bounds if isinstance(model.bounds, Box) else free
            bounds = self._interval(found, a, t)
            changes["x0"] = box if bounds is None else _meet(box, bounds)
        return replace(model, **changes)

    def _interval(self, found: "_Found", a: int, t: int) -> Box | None:
        """Return the finished interval of state a, if it is to be carried."""
        if self.carry is None or a == 0 or t - a < self.memory:
            return None
        lo, hi = found.low[a], found.high[a]
        if not np.all(hi > lo):
            return None
        factor = self.carry * (self.memory / (self.memory - 2.0) if self.memory > 2 else 1.0)
        mid, half = 0.5 * (lo + hi), 0.5 * factor * (hi - lo)
        return Box(mid - half, mid + half)

    def _carried(self, chain: Chain, found: "_Found", a: int, t: int) -> Chain:
        bounds = self._interval(found, a, t)
        if bounds is None:
            return chain
        nx = chain.bx.shape[1]
        lo = np.full(nx, -np.inf) if chain.lo is None else np.atleast_2d(chain.lo)[0]
        hi = np.full(nx, np.inf) if chain.hi is None else np.atleast_2d(chain.hi)[0]
        met = _meet(Box(lo, hi), bounds)
        return replace(chain, x0_lo=np.array(met.lo), x0_hi=np.array(met.hi))

    def _estimate(self, model: Model, record: Record, start: NDArray[np.int32], found: "_Found") -> Estimate:
        order = [Status.OK, Status.REDUCED, Status.COLLAPSED, Status.STALLED, Status.INFEASIBLE]
        worst = max(found.statuses, key=order.index)
        T, nx = len(record), model.nx
        since = rows_since_fix(record.seen)
        count = np.array([np.count_nonzero((start <= k) & (np.arange(T) >= k)) for k in range(T)]) if T < 2000 else None
        if count is None:
            count = np.minimum(self.memory + 1, T - np.arange(T))
        unsolved = [k for k, s in enumerate(found.statuses) if not s.good]
        info: dict[str, Any] = {
            "x0": found.smoothed[0].copy(),
            "smoothed": found.smoothed[1:],
            "low": found.low[1:],
            "high": found.high[1:],
            "windows": np.minimum(count, self.memory + 1),
            "q": found.s[:, :nx],
            "r": found.s[:, nx:],
            "theta": found.theta,
            "start": start,
            "extrapolated": since > 0,
            "since_fix": since,
            "statuses": found.statuses,
            "iterations": found.iterations,
            "seconds": found.seconds,
            "unsolved": unsolved,
            "notes": [],
        }
        if unsolved:
            info["message"] = f"{worst.value}: {len(unsolved)} of {T} windows, the first at row {unsolved[0]}"
        if np.any(since > 0) and "message" not in info:
            info["message"] = f"{worst.value}; {int(np.count_nonzero(since > 0))} rows extrapolate beyond the last fix"
        spread = _stacked(found.spreads) if len(found.spreads) == T else None
        theta = found.theta[-1] if found.theta is not None and found.theta.shape[1] else None
        s = found.s[-1]
        known = np.isfinite(s).all() and found.statuses[-1].good
        return Estimate(
            record.t,
            found.filtered,
            spread,
            worst,
            typed(self),
            q=s[:nx].copy() if known else None,
            r=s[nx:].copy() if known else None,
            theta=None if theta is None else theta.copy(),
            names=model.names.x,
            labels=record.labels,
            info=info,
        )


@dataclass(eq=False)
class _Found:
    """What the windows found, filled row by row."""

    filtered: Array
    smoothed: Array
    s: Array
    low: Array
    high: Array
    statuses: list[Status]
    iterations: NDArray[np.int_]
    theta: Array | None = None
    seconds: Array | None = None
    spreads: list[Spread | None] = dataclasses.field(default_factory=list)

    @classmethod
    def empty(cls, T: int, nx: int, groups: int, p: int) -> "_Found":
        return cls(
            np.zeros((T, nx)),
            np.zeros((T + 1, nx)),
            np.full((T, groups), np.nan),
            np.full((T + 1, nx), np.inf),
            np.full((T + 1, nx), -np.inf),
            [Status.OK] * T,
            np.zeros(T, dtype=int),
            np.full((T, p), np.nan),
        )

    def take(
        self, t: int, a: int, x: Array, theta: Array, s: Array, status: Status, iterations: int, memory: int
    ) -> None:
        """Record the window a..t whose states are x[a : t + 2]."""
        self.filtered[t], self.s[t], self.statuses[t], self.iterations[t] = x[t + 1], s, status, iterations
        if self.theta is not None and self.theta.shape[1]:
            self.theta[t] = theta[: self.theta.shape[1]]
        self.smoothed[a : t + 2] = x[a : t + 2]
        b = max(a, t + 1 - memory)
        self.low[b : t + 2] = np.minimum(self.low[b : t + 2], x[b : t + 2])
        self.high[b : t + 2] = np.maximum(self.high[b : t + 2], x[b : t + 2])


def ensemble_interval(estimate: Estimate, kappa: float = 1.0) -> tuple[Array, Array]:
    """Return the paper's interval of every state from the estimates of its windows, eqs. (27)-(31).

    Parameters
    ----------
    estimate : Estimate
        Of `Window`.
    kappa : float
        Multiple of the expected range; it has no calibrated level.

    Returns
    -------
    lo, hi : (T, nx) arrays
        NaN where a state has too few estimates (n <= 2), as at the end of the record.

    Raises
    ------
    Refused
        If the estimate is not one of `Window`.
    """
    if "windows" not in estimate.info:
        raise Refused(f"`{estimate.method}` is no `Window`, so its states have one estimate each")
    n = np.asarray(estimate.info["windows"], dtype=float)[:, None] - 1.0
    lo, hi = estimate.info["low"], estimate.info["high"]
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = np.where(n > 2, n / (n - 2.0), np.nan) * 0.5 * (hi - lo)
    mu = 0.5 * (hi + lo)
    return mu - kappa * rho, mu + kappa * rho


def window_starts(
    seen: NDArray[np.bool_], memory: int, *, fixes: int = 3, stretch: int | None = None
) -> NDArray[np.int32]:
    """Return the first row of the window that ends at each row, (T,).

    A window holds `memory` + 1 rows, or more: it reaches back until every output that has been seen so far has `fixes`
    seen entries in it, but at most `stretch` rows.
    """
    T, ny = seen.shape
    rows = np.arange(T)
    start = np.maximum(0, rows - memory)
    for j in range(ny if fixes else 0):
        places = np.flatnonzero(seen[:, j])
        before = np.searchsorted(places, rows, side="right")  # seen entries up to and with each row
        first = np.where(before >= fixes, places[np.maximum(before - fixes, 0)] if len(places) else 0, 0)
        # An output with fewer entries than that is taken back to its first one.
        few = (before > 0) & (before < fixes)
        first = np.where(few, places[0] if len(places) else 0, first)
        start = np.where(before > 0, np.minimum(start, first), start)
    if stretch is not None:
        start = np.maximum(start, rows - stretch + 1)
    return start.astype(np.int32)


def rows_since_fix(seen: NDArray[np.bool_]) -> NDArray[np.int_]:
    """Return how many rows ago any output was last seen, (T,); 0 where one is seen now."""
    rows = np.arange(len(seen))
    last = np.maximum.accumulate(np.where(seen.any(axis=1), rows, -1))
    return rows - last


def window_chain(method: BatchLP, model: Linear, record: Record, memory: int) -> Chain | None:
    """Return the chain of a record with the costs that its windows share, or None if it is none.

    The scales are those of the first full window, so that a stream has them too.
    """
    floor, cap = half_width_bounds(model)
    chain = chain_of(model, record, np.ones(model.nx + model.ny), floor, cap)
    if chain is None or method.objective == "paper":
        return chain
    return replace(chain, c=first_costs(model, record, memory + 1))


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


def shares_costs(method: Estimator, model: Model) -> bool:
    """Say whether all windows of a method are given the scales of the first full one."""
    return isinstance(method, BatchLP) and method.objective == "scaled" and isinstance(model, Linear)


def newest(spread: Spread | None) -> Spread | None:
    """Return what is known of the last row alone."""
    if isinstance(spread, Box):
        return Box(spread.lo[-1:], spread.hi[-1:], guaranteed=spread.guaranteed)
    if isinstance(spread, Normal):
        return Normal.of(spread.mean[-1:], spread.P[-1:], spread._within)
    if isinstance(spread, Shaped):
        return Shaped(spread.mean[-1:], spread.P[-1:], spread.skew[-1:], spread.kurt[-1:], spread.within)
    if isinstance(spread, Cloud):
        return Cloud(spread.points[-1:], spread.weights[-1:])
    return None


def _stacked(spreads: list[Spread | None]) -> Spread | None:
    """Return the spreads of single rows as one, None where they differ in kind."""
    first = spreads[0]
    if isinstance(first, Box) and all(isinstance(s, Box) for s in spreads):
        lo, hi = (np.concatenate([getattr(s, end) for s in spreads]) for end in ("lo", "hi"))
        return Box(lo, hi, guaranteed=all(s is not None and s.guaranteed for s in spreads))
    if all(isinstance(s, Normal | Shaped) for s in spreads):
        bent = [s if isinstance(s, Shaped) else _unbent(s) for s in spreads]
        mean, P, skew, kurt = (np.concatenate([getattr(s, f) for s in bent]) for f in ("mean", "P", "skew", "kurt"))
        return Shaped(mean, P, skew, kurt, bent[-1].within)
    if isinstance(first, Cloud) and all(isinstance(s, Cloud) for s in spreads):
        points, weights = (np.concatenate([getattr(s, f) for s in spreads]) for f in ("points", "weights"))
        return Cloud(points, weights)
    return None


def _unbent(spread: Any) -> Shaped:
    none = np.zeros(spread.mean.shape)
    return Shaped(spread.mean, spread.P, none, none, spread._within)


def window_estimate(
    method: Estimator, model: Model, part: Record, costs: Array | None, seed: int | None = None
) -> Estimate:
    """Estimate one window: the linear program itself where the method is one, else the method's `run`."""
    if isinstance(method, BatchLP) and isinstance(model, Linear) and method.objective != "log":
        point = method.point
        floor, cap = half_width_bounds(model)
        chain = None if point == "least_squares" else chain_of(model, part, np.ones(len(floor)), floor, cap)
        if chain is not None and point != "least_squares":
            answer = solve(chain if costs is None else replace(chain, c=costs), point=point)
            good, nx = answer.status.good, model.nx
            return Estimate(
                part.t, answer.x[1:], None, answer.status, typed(method),
                q=answer.s[:nx] if good else None, r=answer.s[nx:] if good else None, names=model.names.x,
                info={
                    "iterations": answer.iterations, "solver": answer.by, "objective": answer.objective,
                    "x0": answer.x[0],
                },
            )  # fmt: skip
    return method.run(model, part, seed=seed)


def _meet(box: Box, other: Box) -> Box:
    """Return the intersection; the first box where they do not meet."""
    lo, hi = np.maximum(box.lo, other.lo), np.minimum(box.hi, other.hi)
    empty = lo >= hi
    return Box(np.where(empty, box.lo, lo), np.where(empty, box.hi, hi))


# ---- memory length from data -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class MemoryChoice:
    """How well windows of several lengths predict the next output.

    Parameters
    ----------
    memories : tuple of int
    score : (candidates,) array
        Mean absolute one-step prediction error in units of each output's own scale, lower is better.
    error : (candidates, ny) array
        The same by output, in its unit.
    spread : (candidates,) array
        Standard error of the score's difference from the best one.
    best : int
        The shortest memory whose score is within one standard error of the best.
    """

    memories: tuple[int, ...]
    score: Array
    error: Array
    spread: Array
    best: int

    def plot(self, ax: Any = None) -> Any:
        """Draw score against memory; returns the axes.

        Raises
        ------
        Missing
            If matplotlib is not installed.
        """
        try:
            import matplotlib.pyplot as plt
        except ImportError as exc:
            from halfwidth.errors import Missing

            raise Missing("`plot` needs matplotlib", hint="pip install 'halfwidth[plot]'") from exc
        if ax is None:
            _, ax = plt.subplots()
        ax.errorbar(self.memories, self.score, yerr=self.spread, marker="o", capsize=3)
        ax.axvline(self.best, linestyle="--", color="grey")
        ax.set_xlabel("memory, rows")
        ax.set_ylabel("one-step prediction error, scaled")
        ax.set_title(f"memory {self.best}")
        return ax


def choose_memory(
    model: Linear, record: Record, method: Estimator | None = None, *, memories: Sequence[int] = (5, 10, 15, 25, 35, 50)
) -> MemoryChoice:
    """Choose the memory of `Window` by how well each candidate predicts the next seen output.

    Every candidate runs over the record once; its newest state is carried one step forwards by the model and compared
    with the output that comes. The paper leaves this choice open.

    Parameters
    ----------
    model : Linear
        Without unknown entries, or with a method that estimates them.
    record : Record
    method : estimator, optional
        ``BatchLP()`` if absent.
    memories : sequence of int
    """
    method = BatchLP() if method is None else method
    longest = max(memories)
    first = min(longest, len(record) // 2)
    scale: Array | None = None
    errors = []
    for memory in memories:
        est = Window(method, memory).run(model, record)
        error = np.abs(prediction_errors(model, record, est))[first:]
        scale = np.nanmean(error, axis=0) if scale is None else scale
        errors.append(error)
    assert scale is not None
    scale = np.where(scale > 0, scale, 1.0)
    count_y = np.maximum(np.count_nonzero(~np.isnan(errors[0]), axis=1), 1)
    lost = np.isnan(errors[0]).all(axis=1)
    each = np.array([np.where(lost, np.nan, np.nansum(e / scale, axis=1) / count_y) for e in errors])
    score = np.nanmean(each, axis=1)
    top = int(np.argmin(score))
    difference = each - each[top]
    count = max(1, int(np.count_nonzero(~np.isnan(each[top]))))
    # Neighbouring errors share most of a window: one independent value a memory's length.
    spread = np.array(
        [np.nanstd(d) / math.sqrt(max(1.0, count / m)) for d, m in zip(difference, memories, strict=True)]
    )
    good = np.flatnonzero(score <= score[top] + spread)
    best = int(memories[int(good[0])]) if len(good) else int(memories[top])
    return MemoryChoice(
        tuple(int(m) for m in memories), score, np.array([np.nanmean(e, axis=0) for e in errors]), spread, best
    )


def prediction_errors(model: Linear, record: Record, estimate: Estimate) -> Array:
    """Return y minus its one-step prediction from the newest state one row before, (T, ny); NaN where unseen."""
    errors = np.full((len(record), model.ny), np.nan)
    thetas = estimate.info.get("theta")
    rows = LinearRows(model, record, None)
    window = Window(SequentialLP())
    for t in range(1, len(record)):
        theta = np.zeros(0) if thetas is None or not np.size(thetas) else thetas[t - 1]
        x = window._predicted(rows, estimate.x[t - 1], theta, t)
        new = rows.matrices(theta)
        dt = float(record.t[t] - record.t[t - 1])
        C = new.get("C", rows.known.C.at(float(record.t[t]), dt, t))
        y = C @ x
        if model.F is not None:
            y = np.linalg.solve(new.get("F", rows.known.F.at(float(record.t[t]), dt, t)), y)  # type: ignore[union-attr]
        errors[t] = np.where(record.seen[t], record.y[t] - y, np.nan)
    return errors


# ---- on line ---------------------------------------------------------------------------------------------------------


class _Live:
    """A window fed row by row: it keeps the rows that the next window may need, nothing else."""

    def __init__(self, window: Window, model: Model, t: float) -> None:
        self.window, self.model, self.t, self.pushed = window, model, t, 0
        self.times: list[float] = []
        self.before = t  # time of the row before the first one held
        self.costs: Array | None = None
        self.y: list[Array] = []
        self.u: list[Array] = []
        self.method = typed(window)

    def push(self, y: ArrayLike | None, u: ArrayLike | None = None, dt: float | None = None) -> Estimate:
        """Fold one row in and return the newest estimate."""
        model = self.model
        row, inputs, step = pushed_row(model, y, u, dt)
        self.t += step
        self.times.append(self.t)
        self.y.append(row)
        if inputs is not None:
            self.u.append(inputs)
        first = self.pushed + 1 - len(self.times)
        self.pushed += 1
        seen = ~np.isnan(np.array(self.y))
        a = int(window_starts(seen, self.window.memory, fixes=self.window.fixes, stretch=self.window.stretch)[-1])
        part = Record(np.array(self.times[a:]), np.array(self.y[a:]), np.array(self.u[a:]) if model.nu else None)
        local = model
        if isinstance(model.x0, Box):
            free = Box(np.full(model.nx, -np.inf), np.full(model.nx, np.inf))
            changes: dict[str, Any] = {}
            if first + a > 0:
                changes["x0"] = model.bounds if isinstance(model.bounds, Box) else free
            gap = self.times[a] - (self.times[a - 1] if a else self.before)
            local = replace(model, dt=gap, **changes)
        est = self._solve(local, part)
        # Starts never move back, so rows before this window's are not needed again.
        if a > 0:
            self.before = self.times[a - 1]
            del self.times[:a], self.y[:a]
            if self.u:
                del self.u[:a]
        since = int(rows_since_fix(seen)[-1])
        info = {k: v for k, v in est.info.items() if k in ("iterations", "solver", "objective", "notes", "message")}
        return replace(
            est,
            t=est.t[-1:],
            x=est.x[-1:],
            spread=newest(est.spread),
            method=self.method,
            info=info | {"extrapolated": since > 0, "since_fix": since, "rows": len(part)},
        )

    def _solve(self, model: Model, part: Record) -> Estimate:
        """Estimate one window with the scales of the first full one."""
        memory, method = self.window.memory, self.window.method
        costs = self.costs
        if costs is None and shares_costs(method, model):
            assert isinstance(model, Linear)
            costs = first_costs(model, part, memory + 1)
            self.costs = costs if self.pushed > memory else None
        return window_estimate(method, model, part, costs)

    def snapshot(self) -> bytes:
        """Return the rows held, as bytes."""
        rows: dict[str, Any] = {"t": self.t, "pushed": self.pushed, "times": self.times, "before": self.before}
        rows["costs"] = None if self.costs is None else self.costs.tolist()
        rows |= {"y": [[None if math.isnan(v) else v for v in row] for row in self.y], "u": [list(r) for r in self.u]}
        return json.dumps(rows).encode()

    def restore(self, saved: bytes) -> None:
        """Take up the rows of a snapshot."""
        rows = json.loads(saved)
        self.t, self.pushed, self.times = float(rows["t"]), int(rows["pushed"]), [float(v) for v in rows["times"]]
        self.before = float(rows["before"])
        self.costs = None if rows["costs"] is None else np.array(rows["costs"], dtype=float)
        self.y = [np.array([np.nan if v is None else v for v in row], dtype=float) for row in rows["y"]]
        self.u = [np.array(row, dtype=float) for row in rows["u"]]


__all__ = [
    "MemoryChoice",
    "Window",
    "choose_memory",
    "ensemble_interval",
    "prediction_errors",
    "rows_since_fix",
    "window_starts",
]
