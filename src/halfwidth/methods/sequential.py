"""SequentialLP: states, half-widths and unknown model entries, by linear programs about the last estimate.

Unknown entries theta of A, B, C, E, F multiply unknown states, and a nonlinear model bends them: either way a row is no
longer linear in what is sought. It is linearised about the newest estimate,

    E x  ~  E^ x + (E - E^) x^,        g(x)  ~  g(x^) + g_x (x - x^),

which makes the problem the linear program of known matrices with a few dense columns for theta. Its solution is the
next point; a step that does not lower the true objective ``sum c_j max|rho_j|`` is shortened. Bounds of theta hold
throughout. A parameter may **drift**: it is then a straight line over the record, whose end is reported and whose total
change is bounded. Where half-widths are known or capped the program about a poor point may have no solution although
the problem has: the rows are then given slack, whose total is brought to nothing first.

The **logarithmic** objective ``sum_j N_j ln s_j`` is the joint density itself, of which the others are linearisations:
with T rows of states and K seen rows of outputs it is T times ``sum ln q_i + (K / T) sum ln r_j``. Its tangent lies
above it, so that the linear program with costs ``N_j / s_j`` lowers it. It has no minimum at 0, hence every unknown
half-width needs a floor: what the sensor's step or its data sheet says.

``Window(SequentialLP(rounds=1), memory)`` is the on-line LSU estimator of the paper: one linear program a row, about
the last window's estimate.

References
----------
Pavelková and Kárný (2013), eqs. (11), (12), (24)-(26), appendix A.2; the sign of the block that F's entries enter with
is corrected (the coefficient of ``F[k, j]`` in row k is ``-y[j]``). Pavelková's slides on GPS and CAN data: the
logarithmic objective.
"""

import dataclasses
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from halfwidth.array import Array, real
from halfwidth.errors import BadShape, BadValue
from halfwidth.methods._linearised import LinearRows, Rows, filled, largest, rows_of, start_theta
from halfwidth.methods._protocol import typed
from halfwidth.methods._residuals import half_width_bounds, residuals, unseen_directions
from halfwidth.model import Linear, Model, needs_a_box
from halfwidth.noise import Uniform
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.solvers.banded import Answer, solve, squares
from halfwidth.spread import Box

#: Shares of a step that are tried, the whole one first.
_STEPS = (1.0, 0.5, 0.25, 0.1, 0.03)
#: Times that slack is used to find a point which fits the caps.
_RESTORATIONS = 3
#: Total excess of rows over their caps, in units of the caps, that counts as none.
_NONE = 1e-6
#: A half-width within this factor of its floor sits on it.
_ON_FLOOR = 1.0 + 1e-3


@dataclass(frozen=True, kw_only=True)
class SequentialLP:
    """States, half-widths and theta by a sequence of linear programs.

    Parameters
    ----------
    objective : {"scaled", "paper", "log"}
        ``sum N_j s_j / sigma_j`` with the noise level sigma_j of a least-squares fit, the paper's ``sum s_j``, or
        ``sum N_j ln s_j``, which starts at the scaled optimum and needs ``at_least`` above 0 for every unknown
        half-width; ``info["on_floor"]`` names those that end there, ``info["on_cap"]`` those at ``at_most``.
    point : {"central", "least_squares", "optimal"}
        Central points follow the central path to a relative gap of 0.3; they estimate better than optimal ones. For
        the logarithm the path is that of the program at its optimum. Least squares is taken inside the optimal
        half-widths, each row in units of its own.
    rounds : int
        Most linearisations of each objective.
    tol : float
        Relative decrease of the objective below which to stop; of the logarithm, of the half-widths' mean.
    drift : float or None
        Largest change of each theta over the record; None keeps it constant.
    theta : tuple of float or None
        Where to start; 0 moved into the bounds if absent.
    start : (T + 1, nx) array_like or None
        Trajectory to start from; of least squares, or of an extended Kalman smoother, if absent.

    Notes
    -----
    ``info["notes"]`` says what the numbers do not: half-widths on a floor or a cap or without a row, states that no
    output sees. Where no trajectory was found within the caps, ``info["conflicts"]`` lists the rows beyond them, the
    worst first, and ``info["inflation"]`` is the factor on all half-widths with which the trajectory returned fits.

    Raises
    ------
    BadValue
        If a setting is not one of those above.

    Examples
    --------
    >>> import halfwidth as hw
    >>> small = hw.Uniform.unknown(at_most=1.0)
    >>> decay = hw.Linear([[float("nan")]], None, [[1]], small, small, None, theta_bounds=(0.0, 1.0))
    >>> record = hw.Record(range(20), [0.9**k for k in range(20)])
    >>> hw.estimate(decay, record, hw.SequentialLP(point="optimal")).theta.round(3)
    array([0.9])
    """

    objective: Literal["scaled", "paper", "log"] = "scaled"
    point: Literal["central", "least_squares", "optimal"] = "central"
    rounds: int = 30
    tol: float = 1e-4
    drift: float | None = None
    theta: tuple[float, ...] | None = None
    start: Any = dataclasses.field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        for name, allowed in (
            ("objective", ("scaled", "paper", "log")),
            ("point", ("central", "least_squares", "optimal")),
        ):
            if getattr(self, name) not in allowed:
                raise BadValue(f"`{name}` is {getattr(self, name)!r}, one of {', '.join(allowed)} was expected")
        if self.rounds < 1:
            raise BadValue(f"`rounds` is {self.rounds!r}, a positive number was expected")
        if self.drift is not None and not self.drift > 0:
            raise BadValue(f"`drift` is {self.drift!r}, a positive number or None was expected")

    def refuses(self, model: Model) -> str | None:
        """Return why the model cannot be taken, or None."""
        for name, noise in (("w", model.w), ("e", model.e)):
            if not isinstance(noise, Uniform):
                return (
                    f"`SequentialLP` needs uniform noise but `{name}` is `{type(noise).__name__}`"
                    f"\nhint: {name}=Uniform.unknown(at_most=...)"
                )
        if model.loss is not None:
            return (
                "`SequentialLP` takes lost outputs as NaN in the record but the model has a hidden loss"
                "\nhint: loss=None"
            )
        if (reason := needs_a_box(model, type(self).__name__)) is not None:
            return reason
        if isinstance(model, Linear):
            if not isinstance(model.x0, Box):
                return "`SequentialLP` needs a box as prior but `x0` is `Normal`\nhint: x0=Box(lo, hi), or None"
            unknown = {entry.matrix for entry in model.theta_entries}
            moving = [name for name in unknown if not model.matrices[name].constant]
            if moving:
                return f"`SequentialLP` needs constant matrices where entries are unknown but `{moving[0]}` moves"
        floor, cap = half_width_bounds(model)
        if self.objective == "log" and np.any((floor < cap) & (floor <= 0)):
            return (
                "`SequentialLP(objective='log')` needs a floor above 0 for every unknown half-width: the logarithm has"
                " no minimum at 0\nhint: Uniform.unknown(at_least=..., at_most=...)"
            )
        if self.theta is not None and len(self.theta) != len(getattr(model, "theta_entries", ())):
            return f"`theta` has {len(self.theta)} entries, the model has {len(getattr(model, 'theta_entries', ()))}"
        return None

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:  # noqa: ARG002
        """Estimate states, half-widths and theta of one record."""
        rows = rows_of(model, record, self.drift)
        theta = start_theta(rows, self.theta)
        x = rows.start(theta) if self.start is None else _given(self.start, len(record), rows.nx)
        c = np.ones(rows.groups) if self.objective == "paper" else rows.weights(x, theta)
        return finished(self, model, record, rows, self.descend(rows, x, theta, c))

    def descend(self, rows: Rows, x: Array, theta: Array, c: Array) -> "Descent":
        """Follow linearisations from (x, theta) as long as they lower the true objective; go to the point asked for."""
        log = self.objective == "log"
        at = Descent(x, theta, Status.STALLED, None, [], c)
        # the logarithm is concave: where it ends depends on where it starts
        at = self._descended(rows, at, "optimal" if log or self.point == "least_squares" else self.point)
        if log and at.status.good:
            at = self._descended(rows, at, "optimal", log=True)
        if at.status.good and self.point == "least_squares":
            return _squared(rows, at)
        return _centred(rows, at) if at.status.good and log and self.point == "central" else at

    def _descended(self, rows: Rows, at: "Descent", point: Any, *, log: bool = False) -> "Descent":
        """Lower one objective, program by program, about the newest point."""
        x, theta, status, answer, history, c = at

        def worth(x: Array, theta: Array) -> float:
            return rows.log_worth(x, theta) if log else rows.worth(x, theta, c)

        best = worth(x, theta)
        history = [*history, best]
        first, restored, moved = not log, 0, False
        for _ in range(self.rounds):
            if log:
                c = rows.tangent(x, theta)
            chain = rows.chain(x, theta, c)
            if not all(np.isfinite(part).all() for part in (chain.A, chain.C, chain.bx, chain.by, chain.c)):
                status = Status.STALLED  # g or h has no derivative here
                break
            answer = solve(chain, point=point, fallback=False)
            status = answer.status
            if not status.good:
                # a step is judged by the true objective, so it need not be certified, and neither need be the last one
                if (
                    status is Status.STALLED
                    and _fits(rows, answer.x, answer.theta)
                    and (worth(answer.x, answer.theta) < best)
                ):
                    status = Status.REDUCED
                elif status is Status.STALLED and moved and _fits(rows, x, theta):
                    status = Status.REDUCED
                    break
                else:
                    answer = solve(chain, point=point)
                    status = answer.status
            if status is Status.INFEASIBLE and restored < _RESTORATIONS:
                restored += 1
                x, theta, fits = _restored(rows, x, theta, self.rounds)
                if fits:
                    best, first = worth(x, theta), True
                    history.append(best)
                    status = Status.REDUCED  # it fits as it is, should there be no rounds left to better it
                    continue
            if not status.good:
                break
            for share in _STEPS:
                x_new, theta_new = x + share * (answer.x - x), theta + share * (answer.theta - theta)
                value = worth(x_new, theta_new)
                # The first point comes from least squares, which a central point need not beat.
                if value < best or (first and value < 2.0 * best):
                    break
            else:
                break
            x, theta, gain, best, moved = x_new, theta_new, best - value, value, True
            history.append(value)
            if abs(gain) <= self.tol * (1.0 if log else max(abs(value), 1e-300)) and not first:
                break
            first = False
        return Descent(x, theta, status, answer, history, c)


class Descent(NamedTuple):
    """Where linearisations led: states, theta, how the last program went, its answer, the objective's course, costs."""

    x: Array
    theta: Array
    status: Status
    answer: Answer | None
    history: list[float]
    c: Array


def _fits(rows: Rows, x: Array, theta: Array) -> bool:
    """Whether a point is finite and its rows lie within their caps."""
    if not (np.isfinite(x).all() and np.isfinite(theta).all()):
        return False
    return bool(np.all(largest(rows.residuals(x, theta), np.zeros(rows.groups)) <= rows.cap * (1.0 + 1e-6)))


def _given(start: Any, T: int, nx: int) -> Array:
    x = real(start, "start")
    if x.shape != (T + 1, nx):
        raise BadShape(f"`start` has shape {x.shape}, ({T + 1}, {nx}) was expected from the record and the model")
    return x.copy()


def _over(rows: Rows, x: Array, theta: Array, unit: Array) -> float:
    """Return the total excess of the rows over their caps, in units of the caps."""
    return float(np.nansum(np.maximum(np.abs(rows.residuals(x, theta)) - rows.cap, 0.0) / unit))


def _restored(rows: Rows, x: Array, theta: Array, rounds: int) -> tuple[Array, Array, bool]:
    """Bring the rows under their caps by programs with slack; return where that ends and whether they fit there."""
    top = largest(rows.residuals(x, theta), rows.floor)
    top = np.where(top > 0, top, 1.0)
    unit = np.where(np.isfinite(rows.cap) & (rows.cap > 0), rows.cap, top)
    over = _over(rows, x, theta, unit)
    for _ in range(rounds):
        # a half-width without a cap costs next to nothing: only what a cap forbids counts
        chain = replace(rows.chain(x, theta, 1e-6 / top), slack=1.0 / unit)
        answer = solve(chain, point="optimal")
        if not np.isfinite(answer.x).all():
            break
        for share in _STEPS:
            x_new, theta_new = x + share * (answer.x - x), theta + share * (answer.theta - theta)
            value = _over(rows, x_new, theta_new, unit)
            if value < over:
                break
        else:
            break
        x, theta, gain, over = x_new, theta_new, over - value, value
        if over <= _NONE or gain <= 1e-3 * over:
            break
    return x, theta, over <= _NONE


def _centred(rows: Rows, at: "Descent") -> "Descent":
    """Move to the central point of the last program, where states are estimated best."""
    answer = solve(rows.chain(at.x, at.theta, at.c), point="central", fallback=False)
    if answer.status is not Status.OK:
        return at._replace(status=Status.REDUCED)
    return at._replace(x=answer.x, theta=answer.theta, answer=answer)


def _squared(rows: Rows, at: "Descent") -> "Descent":
    """Move to the least squares of the rows inside the half-widths of this point."""
    s = largest(rows.residuals(at.x, at.theta), rows.floor)
    found = squares(rows.chain(at.x, at.theta, at.c), s)
    if found is None:
        return at._replace(status=Status.REDUCED)
    return at._replace(x=found[0], theta=found[1])


def finished(method: SequentialLP, model: Model, record: Record, rows: Rows, at: Descent) -> Estimate:
    """Return the estimate at a point."""
    x, theta, status, answer, history, c = at
    rho = rows.residuals(x, theta)
    s = largest(rho, rows.floor)
    over = s > rows.cap * (1.0 + 1e-6)
    notes: list[str] = []
    refuted: dict[str, Any] = {}
    if status is Status.INFEASIBLE:
        notes.append("this is the trajectory of least excess over the caps that was found")
        refuted = _excess(model, record, rows, rho)
    if over.any() and status.good:
        status = Status.REDUCED
        notes.append("the linearisation leaves residuals beyond the caps")
    free = rows.floor < rows.cap
    kinds = [f"q[{name}]" for name in model.names.x] + [f"r[{name}]" for name in model.names.y]
    there = np.isfinite(rho).any(axis=0)
    low = free & (rows.floor > 0) & (s <= _ON_FLOOR * rows.floor) & there
    high = free & there & (s >= rows.cap * (1.0 - 1e-6))
    on_floor, on_cap, blind = (
        [name for name, here in zip(kinds, mask, strict=True) if here] for mask in (low, high, free & ~there)
    )
    for what, named in (
        ("bound not identifiable", blind), ("half-width on its floor", on_floor), ("half-width on its cap", on_cap),
        ("not observable", _unobservable(rows, model, theta) if status.good else []),
    ):  # fmt: skip
        if named:
            notes.append(f"{what}: {', '.join(named)}")
    n = len(rows.entries)
    count = np.where(free, np.isfinite(rho).sum(axis=0), 0)
    log = float(count[count > 0] @ np.log(s[count > 0])) if method.objective == "log" else None
    info: dict[str, Any] = {
        "x0": x[0].copy(),
        "objective": float(c @ s) if log is None else log,
        "rounds": len(history) - 1,
        "history": history,
        "w": rho[:, : rows.nx],
        "e": -rho[:, rows.nx :],
        "rows": count,
        "on_floor": on_floor,
        "on_cap": on_cap,
        "notes": notes,
        "iterations": 0 if answer is None else answer.iterations,
        "solver": "banded" if answer is None else answer.by,
    } | refuted
    if method.drift is not None and n:
        info["drift"] = theta[n:].copy()
    if notes:
        info["message"] = "; ".join([status.value, *notes])
    return Estimate(
        record.t,
        x[1:].copy(),
        None,
        status,
        typed(method),
        q=np.minimum(s, rows.cap)[: rows.nx] if status.good else None,
        r=np.minimum(s, rows.cap)[rows.nx :] if status.good else None,
        theta=theta[:n].copy() if n else None,
        names=model.names.x,
        labels=record.labels,
        info=info,
    )


def _unobservable(rows: Rows, model: Model, theta: Array) -> list[str]:
    """Return the states of a linear model that no seen output tells apart, at this theta."""
    if not isinstance(rows, LinearRows):
        return []
    fixed = filled(rows.model, theta[: len(rows.entries)])
    blind = unseen_directions(residuals(fixed, rows.clean), fixed, rows.clean)
    involved = np.abs(blind).max(axis=0, initial=0.0) > 1e-6
    return [name for name, lost in zip(model.names.x, involved, strict=True) if lost]


def _excess(model: Model, record: Record, rows: Rows, rho: Array) -> dict[str, Any]:
    """Return the rows beyond their caps, the worst in units of the cap first, and the factor with which they fit."""
    size = np.abs(np.where(np.isfinite(rho), rho, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(size > rows.cap, size / rows.cap, 0.0)
    t, j = np.nonzero(ratio > 1.0 + _NONE)
    names = [*model.names.x, *model.names.y]
    conflicts = [
        {
            "t": float(record.t[t[k]]), "row": int(t[k]), "kind": "state" if j[k] < rows.nx else "output",
            "name": names[j[k]], "excess": float(size[t[k], j[k]] - rows.cap[j[k]]),
        }
        for k in np.argsort(-ratio[t, j], kind="stable")
    ]  # fmt: skip
    factor = float(ratio.max(initial=0.0))
    return {"conflicts": conflicts, "inflation": factor if np.isfinite(factor) and factor > 1.0 else None}
