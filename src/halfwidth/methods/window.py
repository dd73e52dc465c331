"""Window: any batch method on a sliding window of the record, one estimate a row.

At row t the method sees rows ``start(t)`` to t only: the cost of a row does not grow and old data are forgotten. A
window holds the newest ``memory + 1`` rows in which anything is seen: it **stretches** over a gap, and reaches further
back until every output that is ever seen has ``fixes`` seen entries in it. A row in which nothing is seen says nothing
new: the estimate moves on along the model, which ``info["extrapolated"]`` says, and the first fix after an outage of
any length meets as many rows on its far side as the memory holds.

An optimal point (``BatchLP(point="optimal")``) begins at a well-centred iterate of the window before, moved by a row:
the optimum is the same within its tolerance, in fewer steps. A central point begins afresh in every window: it is where
the path from least squares stops, so a start elsewhere would make it depend on history.

Every state is estimated by several windows. The paper takes the least and the largest of these estimates, s_lo and
s_hi, for its interval

    mu +- kappa rho,    mu = (s_hi + s_lo) / 2,    rho = n / (n - 2) (s_hi - s_lo) / 2          (27)-(31)

with n + 1 the number of estimates; `ensemble_interval` returns it. States in a gap count the windows until ``memory``
rows after its end, since those inside it all miss the same. On line the windows up to now are carried on by the model
to the newest row, and an outage adds what their half-widths can add up to. Kappa has no calibrated level: use
``Posterior`` where a probability is wanted. With ``carry=kappa`` the interval of the state that has just left the
window bounds the first state of the next one.

References
----------
Pavelková and Kárný (2013), secs. 2, 5.1, 5.2. Rao, Rawlings and Mayne (2003), IEEE TAC 48(2): moving horizons.
"""

import dataclasses
import math
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.errors import BadValue, Refused
from halfwidth.methods._ahead import Forecasts
from halfwidth.methods._linearised import expected
from halfwidth.methods._protocol import Estimator, typed
from halfwidth.methods._residuals import half_width_bounds
from halfwidth.methods._rows import rows_since_fix, window_lasts, window_starts
from halfwidth.methods._sliding import TOL, Live, Sliding, first_costs, if_found, stacked
from halfwidth.methods.map import BatchLP
from halfwidth.model import Linear, Model
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.solvers.banded import POINTS, STATUSES, solve
from halfwidth.solvers.chain import Chain, chain_of
from halfwidth.spread import Box, Spread, part


@dataclass(frozen=True)
class Window:
    """A batch method on a sliding window.

    Parameters
    ----------
    method : estimator
        Such as ``BatchLP()`` or ``SequentialLP(rounds=1)``.
    memory : int
        The window holds the newest `memory` + 1 rows in which any output is seen; `choose_memory` finds it from data.
    carry : float or None
        kappa with which a finished interval bounds the state that a window starts from; None leaves it free in the
        model's box.
    fixes : int
        Seen entries that a window holds of every output, by reaching further back where it must; at most memory + 1.
    stretch : int or None
        Most rows of a stretched window; None is no limit.
    recall : float
        For ``Posterior``: what rows that have left the window told of half-widths and of the state at its edge is
        carried on; of half-widths it fades over `recall` times memory + 1 rows. 0 takes every window on its own.
    lag : int
        Row t uses the outputs up to row t + lag, at most `memory`: each push of a stream gives the estimate of `lag`
        rows ago.

    Notes
    -----
    ``x[k]`` is the state of row k in the window that ends at row k + `lag`, or at the last one. In ``info``:
    ``smoothed`` (T, nx), the last estimate of each state; ``low``, ``high`` and ``windows``, what `ensemble_interval`
    needs; ``q``, ``r``, ``theta`` of every window, and ``Q``, ``R`` where variances are unknown; ``start``,
    ``extrapolated``, ``since_fix``, ``statuses``, ``iterations`` and, of ``BatchLP``, ``seconds`` of CPU time of every
    row; ``newest_low``, ``newest_high``, ``newest_windows``, what ``ensemble_interval(newest=True)`` needs. Those of
    the estimate itself are the last window's; its status is the worst of all windows.

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
    fixes: int = 10
    stretch: int | None = None
    recall: float = 40.0
    lag: int = 0

    def __post_init__(self) -> None:
        if isinstance(self.method, type) or not isinstance(self.method, Estimator) or isinstance(self.method, Window):
            raise BadValue(f"`method` is {self.method!r}, a batch estimator such as BatchLP() was expected")
        if not isinstance(self.memory, int | np.integer) or self.memory < 1:
            raise BadValue(f"`memory` is {self.memory!r}, a positive whole number of rows was expected")
        if self.carry is not None and not self.carry > 0:
            raise BadValue(f"`carry` is {self.carry!r}, a positive number or None was expected")
        if self.fixes < 0:
            raise BadValue(f"`fixes` is {self.fixes!r}, 0 or more was expected")
        if not isinstance(self.lag, int | np.integer) or not 0 <= self.lag <= self.memory:
            raise BadValue(f"`lag` is {self.lag!r}, a whole number of rows up to memory = {self.memory} was expected")
        if not 0 <= self.recall < math.inf:
            raise BadValue(f"`recall` is {self.recall!r}, a number of windows from 0 was expected")
        if self.stretch is not None and self.stretch < self.memory + 1:
            raise BadValue(f"`stretch` is {self.stretch!r}, at least memory + 1 = {self.memory + 1} was expected")

    def refuses(self, model: Model) -> str | None:
        """Return why the method inside cannot take the model, or None."""
        reason = self.method.refuses(model)
        return None if reason is None else f"inside `Window`, {reason}"

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:
        """Estimate the newest state at every row."""
        start = window_starts(record.seen, self.memory, fixes=self.fixes, stretch=self.stretch)
        found = None
        if isinstance(model, Linear) and isinstance(self.method, BatchLP) and not self.lag:
            found = self._batch(model, record, start)
        return self._estimate(model, record, start, self._each(model, record, seed) if found is None else found)

    def stream(self, model: Model, t: float) -> Live:
        """Return the on-line form, for `halfwidth.stream`."""
        return Live(self, model, t)

    def _batch(self, model: Linear, record: Record, start: NDArray[np.int32]) -> "_Found | None":
        """All windows in one call of the core."""
        method, memory = cast(BatchLP, self.method), self.memory
        if method.objective == "log" or method.point == "least_squares":
            return None
        chain = window_chain(method, model, record, memory)
        if chain is None:
            return None
        early = [first_costs(model, record, t + 1) for t in range(min(memory, len(record)))]
        last = window_lasts(record.seen, memory)
        c = chain
        filtered, smoothed, s, low, high, codes, seconds = _core.lp_windows(
            c.E, c.A, c.C, c.bx, c.by, c.seen, c.lo, c.hi, c.x0_lo, c.x0_hi, c.group, c.h, c.c, c.floor, c.cap,
            np.array(early if method.objective == "scaled" else np.zeros((0, len(c.c)))), start, last, memory,
            self.carry or 0.0, POINTS[method.point], TOL,
        )  # fmt: skip
        found = _Found(filtered, smoothed, s, low, high, [STATUSES[k] for k in codes[0]], codes[1], None, seconds)
        seen = np.asarray(record.seen.any(axis=1))
        for t in np.flatnonzero((codes[0] >= 1) & (seen | (np.arange(len(record)) == 0))).tolist():
            # What the core does not certify is asked of the stock solvers, which also prove infeasibility.
            part = chain.part(int(start[t]), t + 1)
            if method.objective == "scaled" and t < memory:
                part = replace(part, c=early[t])
            answer = solve(part, point=method.point, tol=TOL)
            found.statuses[t] = answer.status
            if not answer.status.good:
                s[t] = np.nan
                continue
            filtered[t], s[t] = answer.x[-1], answer.s
            for k in range(t + 1, len(record)):  # rows without a fix follow
                if seen[k]:
                    break
                moved = expected(model, record, k, filtered[k - 1][None])[0]
                box = model.bounds
                filtered[k] = np.clip(moved, box.lo, box.hi) if isinstance(box, Box) else moved
                found.statuses[k], s[k] = answer.status, answer.s
        ahead = Forecasts(model, memory)
        for t in range(len(record)):
            if t:
                ahead.move(model, record, t, filtered[t - 1])
            if seen[t] and found.statuses[t].good:
                ahead.take(filtered[t], s[t, : model.nx])
            elif t:
                ahead.grow(model, record, t, filtered[t - 1])
            found.newest_low[t], found.newest_high[t], found.newest_windows[t] = ahead.bounds()
        return found

    def _each(self, model: Model, record: Record, seed: int | None = None) -> "_Found":
        """One window after the other, as on line."""
        T, nx = len(record), model.nx
        dt = record.steps(model.dt)
        rows = Sliding(self, model, float(record.t[0] - dt[0]), seed)
        found = _Found.empty(T, nx, nx + model.ny, len(getattr(model, "theta_entries", ())))
        for t in range(T):
            solved = rows.push(record.y[t], None if record.u is None else record.u[t], float(dt[t]))
            back = rows.back()
            done = slice(t - back, t + 1 if t == T - 1 else t - back + 1)  # the last window has nothing to wait for
            of_window = slice(done.start - t - 1, done.stop - t - 1 or None)
            found.filtered[done] = rows.x[of_window]
            found.s[t], found.statuses[t] = solved.s, solved.status
            found.iterations[t] = solved.iterations
            if solved.variances is not None:
                if found.variances is None:
                    found.variances = np.full((T, nx + model.ny), np.nan)
                found.variances[t] = solved.variances
            if found.theta is not None and found.theta.shape[1] == solved.theta.size:
                found.theta[t] = solved.theta
            found.newest_low[t], found.newest_high[t], found.newest_windows[t] = rows.ahead.bounds()
            held = slice(rows.first, t + 2)
            found.smoothed[held], found.low[held], found.high[held] = rows.x, rows.low, rows.high
            if t >= self.lag or t == T - 1:
                found.spreads.append(None if solved.spread is None else part(solved.spread, of_window))
        return found

    def _estimate(self, model: Model, record: Record, start: NDArray[np.int32], found: "_Found") -> Estimate:
        order = [Status.OK, Status.REDUCED, Status.COLLAPSED, Status.STALLED, Status.INFEASIBLE]
        worst = max(found.statuses, key=order.index)
        T, nx = len(record), model.nx
        since = rows_since_fix(record.seen)
        rows = np.arange(T)
        # A state is part of the windows from its own row to the last that starts at or before it.
        held = np.searchsorted(start, rows + 1, side="right") - 1
        count = np.minimum(np.minimum(window_lasts(record.seen, self.memory)[1:], held), T - 1) - rows + 1
        unsolved = [k for k, s in enumerate(found.statuses) if not s.good]
        info: dict[str, Any] = {
            "x0": found.smoothed[0].copy(),
            "smoothed": found.smoothed[1:],
            "low": found.low[1:],
            "high": found.high[1:],
            "windows": count,
            "newest_low": found.newest_low,
            "newest_high": found.newest_high,
            "newest_windows": found.newest_windows,
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
        spread = stacked(found.spreads) if found.spreads else None
        theta = found.theta[-1] if found.theta is not None and found.theta.shape[1] else None
        s, end, v = found.s[-1], found.statuses[-1], found.variances
        if v is not None:
            info |= {"Q": v[:, :nx], "R": v[:, nx:]}
        return Estimate(
            record.t,
            found.filtered,
            spread,
            worst,
            typed(self),
            q=if_found(s[:nx], end),
            r=if_found(s[nx:], end),
            Q=None if v is None else if_found(v[-1, :nx], end),
            R=None if v is None else if_found(v[-1, nx:], end),
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
    newest_low: Array = dataclasses.field(init=False)
    newest_high: Array = dataclasses.field(init=False)
    newest_windows: NDArray[np.int_] = dataclasses.field(init=False)
    spreads: list[Spread | None] = dataclasses.field(default_factory=list)
    variances: Array | None = None

    def __post_init__(self) -> None:
        self.newest_low, self.newest_high = np.empty_like(self.filtered), np.empty_like(self.filtered)
        self.newest_windows = np.zeros(len(self.filtered), dtype=int)

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


def ensemble_interval(estimate: Estimate, kappa: float = 1.0, *, newest: bool = False) -> tuple[Array, Array]:
    """Return the paper's interval of every state from the estimates of its windows, eqs. (27)-(31).

    Parameters
    ----------
    estimate : Estimate
        Of `Window`, or a row of a stream of one with ``newest=True``.
    kappa : float
        Multiple of the expected range; it has no calibrated level.
    newest : bool
        False, as in the paper: of the windows that hold the state, which end later; after an outage they see its far
        side. True: of the windows that end before or at the row, each carried on to it by the model, which is what is
        known on line; in an outage it is widened by what the largest half-widths of these windows can add up to.

    Returns
    -------
    lo, hi : (T, nx) arrays
        NaN where a state has too few estimates (n <= 2), as at the end of the record, or at its start with `newest`.

    Raises
    ------
    Refused
        If the estimate is not one of `Window`.
    BadValue
        If `kappa` is below 0 or not finite.
    """
    if not 0.0 <= kappa < np.inf:
        raise BadValue(f"`kappa` is {kappa!r}, a finite number from 0 was expected", hint="kappa=1.0")
    names = ("newest_low", "newest_high", "newest_windows") if newest else ("low", "high", "windows")
    if names[-1] not in estimate.info:
        raise Refused(f"`{estimate.method}` is no `Window`, so its states have one estimate each")
    lo, hi, count = (np.asarray(estimate.info[name], dtype=float) for name in names)
    n = count[:, None] - 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = np.where(n > 2, n / (n - 2.0) * 0.5 * (hi - lo), np.nan)
        mu = np.where(n > 2, 0.5 * (hi + lo), np.nan)
    return mu - kappa * rho, mu + kappa * rho


def window_chain(method: BatchLP, model: Linear, record: Record, memory: int) -> Chain | None:
    """Return the chain of a record with the costs that its windows share, or None if it is none.

    The scales are those of the first full window, so that a stream has them too.
    """
    floor, cap = half_width_bounds(model)
    chain = chain_of(model, record, np.ones(model.nx + model.ny), floor, cap)
    if chain is None or method.objective == "paper":
        return chain
    return replace(chain, c=first_costs(model, record, memory + 1))


__all__ = ["Window", "ensemble_interval", "window_chain"]
