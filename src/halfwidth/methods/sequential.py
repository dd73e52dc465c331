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
from halfwidth.methods._protocol import typed
from halfwidth.methods._residuals import reference, residuals, unseen_directions
from halfwidth.model import Entry, Linear, Model, Nonlinear, arity, needs_a_box
from halfwidth.noise import Gaussian, Uniform
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.solvers.banded import Answer, Chain, chain_of, solve, squares
from halfwidth.spread import Box, Normal
from halfwidth.trace import Tape, Untraceable, compiled

#: Shares of a step that are tried, the whole one first.
_STEPS = (1.0, 0.5, 0.25, 0.1, 0.03)
#: Times that slack is used to find a point which fits the caps.
_RESTORATIONS = 3
#: Rounds in which the scale of each group is found for a nonlinear model.
_SCALINGS = 3
#: Total excess of rows over their caps, in units of the caps, that counts as none.
_NONE = 1e-6
#: A half-width within this factor of its floor sits on it.
_ON_FLOOR = 1.0 + 1e-3
#: Gauss-Newton steps to a state that gives the first outputs.
_FITTING = 6
#: A scale stays above this share of the cap (or of the first residuals): a smooth fit must not make one vanish.
_LEAST = 0.03


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

    def descend(self, rows: "Rows", x: Array, theta: Array, c: Array) -> "Descent":
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

    def _descended(self, rows: "Rows", at: "Descent", point: Any, *, log: bool = False) -> "Descent":
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


def _fits(rows: "Rows", x: Array, theta: Array) -> bool:
    """Whether a point is finite and its rows lie within their caps."""
    if not (np.isfinite(x).all() and np.isfinite(theta).all()):
        return False
    return bool(np.all(largest(rows.residuals(x, theta), np.zeros(rows.groups)) <= rows.cap * (1.0 + 1e-6)))


def _given(start: Any, T: int, nx: int) -> Array:
    x = real(start, "start")
    if x.shape != (T + 1, nx):
        raise BadShape(f"`start` has shape {x.shape}, ({T + 1}, {nx}) was expected from the record and the model")
    return x.copy()


def _over(rows: "Rows", x: Array, theta: Array, unit: Array) -> float:
    """Return the total excess of the rows over their caps, in units of the caps."""
    return float(np.nansum(np.maximum(np.abs(rows.residuals(x, theta)) - rows.cap, 0.0) / unit))


def _restored(rows: "Rows", x: Array, theta: Array, rounds: int) -> tuple[Array, Array, bool]:
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


def _centred(rows: "Rows", at: "Descent") -> "Descent":
    """Move to the central point of the last program, where states are estimated best."""
    answer = solve(rows.chain(at.x, at.theta, at.c), point="central", fallback=False)
    if answer.status is not Status.OK:
        return at._replace(status=Status.REDUCED)
    return at._replace(x=answer.x, theta=answer.theta, answer=answer)


def _squared(rows: "Rows", at: "Descent") -> "Descent":
    """Move to the least squares of the rows inside the half-widths of this point."""
    s = largest(rows.residuals(at.x, at.theta), rows.floor)
    found = squares(rows.chain(at.x, at.theta, at.c), s)
    if found is None:
        return at._replace(status=Status.REDUCED)
    return at._replace(x=found[0], theta=found[1])


class _Worth:
    """What both kinds of rows are worth."""

    floor: Array
    cap: Array
    nx: int

    def residuals(self, x: Array, theta: Array) -> Array:
        """Return the true residuals (T, groups), NaN where no row is."""
        raise NotImplementedError

    def worth(self, x: Array, theta: Array, c: Array) -> float:
        """Return ``sum c_j max|rho_j|``."""
        return float(c @ largest(self.residuals(x, theta), self.floor))

    def shares(self, rho: Array) -> Array:
        """Return N_j over the sum of all N of the half-widths sought, 0 of a known one."""
        count = np.where(self.floor < self.cap, np.isfinite(rho).sum(axis=0), 0.0)
        return np.asarray(count / max(float(count.sum()), 1.0))

    def log_worth(self, x: Array, theta: Array) -> float:
        """Return the mean of ``ln s_j`` over all rows."""
        rho = self.residuals(x, theta)
        share = self.shares(rho)
        return float(share[share > 0] @ np.log(largest(rho, self.floor)[share > 0]))

    def tangent(self, x: Array, theta: Array) -> Array:
        """Return the costs of the program that lies above the logarithm and touches it here."""
        rho = self.residuals(x, theta)
        s = largest(rho, self.floor)
        c = self.shares(rho) / np.where(s > 0, s, 1.0)
        return c / max(float(c.max(initial=0.0)), 1e-300)


class LinearRows(_Worth):
    """The rows of a linear model, linearised in theta; made by `rows_of`."""

    def __init__(self, model: Linear, record: Record, drift: float | None) -> None:
        self.model, self.record, self.drift = model, record, drift
        self.entries: tuple[Entry, ...] = model.theta_entries
        self.nx, self.ny = model.nx, model.ny
        self.groups = model.nx + model.ny
        n = len(self.entries)
        box = model.theta_bounds if model.theta_bounds is not None else Box(np.full(n, -np.inf), np.full(n, np.inf))
        self.lo, self.hi = np.broadcast_to(box.lo, n).astype(float), np.broadcast_to(box.hi, n).astype(float)
        # Rows whose F has an unknown or known entry at an unseen output are bounded by nothing we know.
        self.known = filled(model, np.zeros(n))
        seen = record.seen
        y = np.where(seen, record.y, 0.0)
        pattern = np.eye(self.ny, dtype=bool)
        if model.F is not None:
            single = model.F.single if model.F.constant else np.ones((self.ny, self.ny))
            pattern = np.isnan(single) | (single != 0)
        whole = np.where(seen, True, ~(pattern[None] & ~seen[:, None, :]).any(axis=2)) & seen
        if model.F is not None:
            whole &= ~(pattern[None] & ~seen[:, None, :]).any(axis=2)
        self.y = y
        self.clean = Record(record.t, np.where(whole, y, np.nan), record.u)
        self.floor, self.cap = half_width_bounds(model)
        if drift is not None and n:
            # The line's slope is one more parameter each, in units of change over the record.
            self.lo = np.r_[self.lo, np.full(n, -drift)]
            self.hi = np.r_[self.hi, np.full(n, drift)]
        full = chain_of(self.known, Record(record.t, y, record.u), np.ones(self.groups), self.floor, self.cap)
        assert full is not None
        self.base = replace(full, seen=np.ascontiguousarray(whole))

    def matrices(self, theta: Array) -> dict[str, Array]:
        """Return the matrices that hold unknown entries, filled."""
        found: dict[str, Array] = {}
        for entry, value in zip(self.entries, theta, strict=False):
            if entry.matrix not in found:
                found[entry.matrix] = np.where(
                    np.isnan(self.model.matrices[entry.matrix].single), 0.0, self.model.matrices[entry.matrix].single
                )
            found[entry.matrix][entry.row, entry.column] = value
        return found

    def columns(self, x: Array, a: int = 0, b: int | None = None) -> Array:
        """Return the derivative of rows a to b by theta at states x (rows + 1, nx): (rows, groups, p)."""
        y, u = self.y[a:b], None if self.record.u is None else self.record.u[a:b]
        G = np.zeros((len(y), self.groups, len(self.lo)))
        for k, (name, i, j) in enumerate(self.entries):
            if name == "A":
                G[:, i, k] = -x[:-1, j]
            elif name == "B" and u is not None:
                G[:, i, k] = -u[:, j]
            elif name == "C":
                G[:, self.nx + i, k] = x[1:, j]
            elif name == "E":
                G[:, i, k] = x[1:, j]
            elif name == "F":
                G[:, self.nx + i, k] = -y[:, j]
        if self.drift is not None and self.entries:
            n = len(self.entries)
            age = np.linspace(-1.0, 0.0, len(y)) if len(y) > 1 else np.zeros(1)
            G[:, :, n:] = G[:, :, :n] * age[:, None, None]
        return G

    def chain(self, x: Array, theta: Array, c: Array, a: int = 0, b: int | None = None) -> Chain:
        """Return the linear program about (x, theta), of rows a to b."""
        T = len(self.record)
        part = self.base if a == 0 and b in (None, T) else self.base.part(a, T if b is None else b)
        if not self.entries:
            return replace(part, c=c)
        n = len(self.entries)
        new = self.matrices(theta[:n])
        G = self.columns(x, a, b)
        u = None if self.record.u is None else self.record.u[a:b]
        bx, by = part.bx, part.by
        if "B" in new and u is not None:
            bx = u @ new["B"].T
        if "F" in new:
            by = self.y[a:b] @ new["F"].T
        at = G[:, :, :n] @ theta[:n]  # the drift is measured from theta itself
        return replace(
            part,
            A=np.ascontiguousarray(new.get("A", part.A)),
            C=np.ascontiguousarray(new.get("C", part.C)),
            E=np.ascontiguousarray(new["E"]) if "E" in new else part.E,
            bx=np.ascontiguousarray(bx + at[:, : self.nx]),
            by=np.ascontiguousarray(by + at[:, self.nx :]),
            G=G,
            theta_lo=self.lo,
            theta_hi=self.hi,
            c=c,
        )

    def residuals(self, x: Array, theta: Array) -> Array:
        """Return the true residuals (T, groups), NaN where no row is."""
        n = len(self.entries)
        one = self.chain(x, theta, np.ones(self.groups))
        A, C = one.A, one.C
        rho = np.empty((one.T, self.groups))
        E = np.eye(self.nx) if one.E is None else one.E
        rho[:, : self.nx] = (E @ x[1:, :, None] - A @ x[:-1, :, None])[..., 0] - one.bx
        rho[:, self.nx :] = np.where(one.seen, (C @ x[1:, :, None])[..., 0] - one.by, np.nan)
        if one.G is not None:
            full = theta if self.drift is not None else theta[:n]
            rho += one.G @ full
        return rho

    def start(self, theta: Array) -> Array:
        """Return the least-squares trajectory at theta."""
        fixed = filled(self.model, theta[: len(self.entries)])
        chain = chain_of(fixed, self.clean, np.ones(self.groups), self.floor, self.cap)
        assert chain is not None
        return solve(chain, point="least_squares", fallback=False).x

    def weights(self, x: Array, theta: Array) -> Array:  # noqa: ARG002
        """Return N_j / sigma_j of each group."""
        fixed = filled(self.model, theta[: len(self.entries)])
        known = np.where(self.floor == self.cap, self.floor / np.sqrt(3.0), 0.0)
        base = reference(residuals(fixed, self.clean), fixed, known)
        return scaled_costs(np.r_[np.full(self.nx, len(self.record)), self.base.seen.sum(axis=0)], base.sigma)


class NonlinearRows(_Worth):
    """The rows of a nonlinear model, linearised about a trajectory; made by `rows_of`.

    An `h` that cannot be recorded may offer ``rows(x)``, values and Jacobians at many states at once.
    """

    def __init__(self, model: Nonlinear, record: Record) -> None:
        self.model, self.record = model, record
        self.nx, self.ny = model.nx, model.ny
        self.groups = model.nx + model.ny
        self.entries: tuple[Entry, ...] = ()
        self.drift = None
        self.lo = self.hi = np.zeros(0)
        self.floor, self.cap = half_width_bounds(model)
        self.y = np.where(record.seen, record.y, 0.0)
        self.dt = record.steps(model.dt)
        self.tapes: dict[str, Tape | None] = {}

    def _tape(self, name: str, x: Array) -> Tape | None:
        """Return g or h recorded, or None where it is for Python to call row by row."""
        if name not in self.tapes:
            f = getattr(self.model, name)
            more = (self._inputs(slice(0, 1)), self.dt[:1])[: arity(f, 3 if name == "g" else 1) - 1]
            one = tuple(None if a is None else a[0] for a in more)
            sizes = (self.nx, self.model.nu, None)[: 1 + len(more)]
            picks = [x[0], x[len(x) // 2], x[-1]]
            try:
                self.tapes[name] = compiled(f, sizes, [(point, *one) for point in picks])
            except Untraceable:
                self.tapes[name] = None
        return self.tapes[name]

    def _inputs(self, rows: slice) -> Array | None:
        if not self.model.nu:
            return None
        return np.zeros((len(self.record), self.model.nu))[rows] if self.record.u is None else self.record.u[rows]

    def _values(self, name: str, x: Array) -> Array:
        """Return g or h at each row's state, (T, nx) or (T, ny)."""
        if name == "h" and hasattr(self.model.h, "rows"):
            return np.asarray(self.model.h.rows(x)[0])
        tape, u = self._tape(name, x), self._inputs(slice(None))
        if tape is not None:
            more = (u, self.dt[:, None])[: len(tape.sizes) - 1]
            return tape(x, *(np.zeros((1, 0)) if a is None else a for a in more))
        if name == "h":
            return np.array([self.model.output(row) for row in x])
        rows = zip(x, self.dt, strict=True)
        return np.array(
            [self.model.move(row, None if u is None else u[k], float(h)) for k, (row, h) in enumerate(rows)]
        )

    def _linearised(self, name: str, x: Array, u: Array | None, k: int) -> tuple[Array, Array]:
        """Return g or h and its Jacobian at one state, where nothing is recorded."""
        by = "differences" if getattr(self.model, f"{name}_x") is None else "user"
        return self.model.slope(name, x, u, float(self.dt[k]), by)

    def _along(self, x: Array, rows: int | None = None) -> tuple[Array, Array, Array, Array]:
        """Return g and g_x at the states before each row, h and h_x at those of the row; of the first rows."""
        found: list[Array] = []
        u, dt = self._inputs(slice(rows)), self.dt[:rows]
        for name, at in (("g", x[:-1]), ("h", x[1:])):
            if name == "h" and hasattr(self.model.h, "rows"):
                found += [np.ascontiguousarray(part) for part in self.model.h.rows(at)]
                continue
            tape = self._tape(name, at) if getattr(self.model, f"{name}_x") is None else None
            if tape is not None:
                more = (u, dt[:, None])[: len(tape.sizes) - 1]
                value, slope = tape.jacobian(at, *(np.zeros((1, 0)) if a is None else a for a in more))
            else:
                each = [self._linearised(name, row, None if u is None else u[k], k) for k, row in enumerate(at)]
                value, slope = np.array([row[0] for row in each]), np.array([row[1] for row in each])
            found += [np.ascontiguousarray(value), np.ascontiguousarray(slope)]
        return found[0], found[1], found[2], found[3]

    def _wrapped(self, difference: Array, angles: tuple[int, ...]) -> Array:
        if angles:
            k = list(angles)
            difference[:, k] = (difference[:, k] + np.pi) % (2 * np.pi) - np.pi
        return difference

    def chain(self, x: Array, theta: Array, c: Array) -> Chain:  # noqa: ARG002
        """Return the linear program about x."""
        g, g_x, h, h_x = self._along(x)
        box, x0 = self.model.bounds, self.model.x0
        lo, hi = x0.interval(0.9999) if isinstance(x0, Normal) else (x0.lo, x0.hi)
        # Residuals as they are at x, wrapped where they are angles, then moved along the tangent.
        w = self._wrapped(x[1:] - g, self.model.x_angles)
        e = self._wrapped(h - self.y, self.model.y_angles)
        tangent = (g_x @ x[:-1, :, None])[..., 0]
        return Chain(
            A=g_x,
            C=h_x,
            bx=np.ascontiguousarray(x[1:] - tangent - w),
            by=np.ascontiguousarray((h_x @ x[1:, :, None])[..., 0] - e),
            seen=np.ascontiguousarray(self.record.seen),
            group=np.arange(self.groups, dtype=np.int32),
            h=np.ones(self.groups),
            c=np.array(c, dtype=float),
            floor=self.floor,
            cap=self.cap,
            lo=None if box is None else np.array(box.lo, dtype=float),
            hi=None if box is None else np.array(box.hi, dtype=float),
            x0_lo=np.array(lo, dtype=float),
            x0_hi=np.array(hi, dtype=float),
        )

    def residuals(self, x: Array, theta: Array) -> Array:  # noqa: ARG002
        """Return the true residuals (T, groups), NaN where no row is."""
        rho = np.hstack([x[1:] - self._values("g", x[:-1]), self._values("h", x[1:]) - self.y])
        self._wrapped(rho[:, : self.nx], self.model.x_angles)
        rho[:, self.nx :] = self._wrapped(rho[:, self.nx :], self.model.y_angles)
        rho[:, self.nx :][~self.record.seen] = np.nan
        return rho

    def start(self, theta: Array) -> Array:  # noqa: ARG002
        """Return the trajectory of an extended Kalman smoother with the widest noise that the caps allow."""
        from halfwidth.methods.nonlinear import ExtendedKalman

        top = np.where(np.isfinite(self.cap), self.cap, 1.0) ** 2 / 3.0
        x0 = self.model.x0
        if isinstance(x0, Box):
            half = np.where(np.isfinite(x0.hi - x0.lo), 0.5 * (x0.hi - x0.lo), 1e3)
            x0 = Normal(self._fitting(x0), np.diag(np.maximum(half, 1e-9) ** 2 / 3.0))
        gaussian = dataclasses.replace(
            self.model, w=Gaussian(np.diag(top[: self.nx])), e=Gaussian(np.diag(top[self.nx :])), x0=x0, bounds=None
        )
        method = ExtendedKalman(smooth=True)
        found = method.run(gaussian, self.record)
        first = np.asarray(found.info.get("x0", x0.mean), dtype=float)
        x = np.vstack([first, found.x])
        if not np.isfinite(x).all():
            x = np.tile(x0.mean, (len(self.record) + 1, 1))
        return x if self.model.bounds is None else np.clip(x, self.model.bounds.lo, self.model.bounds.hi)

    def _fitting(self, box: Box) -> Array:
        """Return a state of the box that gives the first outputs seen, as nearly as Gauss-Newton finds one.

        The middle of a wide box may be where an output has no derivative, such as the azimuth of a line of no length.
        """
        seen = self.record.seen
        first = np.argmax(seen, axis=0)
        there = seen.any(axis=0)
        y = np.where(there, self.record.y[first, np.arange(self.ny)], 0.0)
        room = np.where(np.isfinite(box.hi - box.lo), box.hi - box.lo, 1.0)
        aside = np.clip(box.mean + 1e-3 * np.minimum(room, 1.0) * np.cos(np.arange(1.0, self.nx + 1)), box.lo, box.hi)
        x = aside
        for _ in range(_FITTING):
            h, h_x = (part[0] for part in self._along(np.vstack([x, x]), 1)[2:])
            if not (np.isfinite(h).all() and np.isfinite(h_x).all()):
                return np.asarray(box.mean)
            miss = self._wrapped((y - h)[None], self.model.y_angles)[0]
            step = np.linalg.lstsq(h_x[there], miss[there], rcond=None)[0]
            x = np.clip(x + step, box.lo, box.hi)
        return np.asarray(x if np.isfinite(x).all() else box.mean)

    def weights(self, x: Array, theta: Array) -> Array:
        """Return N_j / sigma_j with the noise level of a least-squares fit about x."""
        count = np.r_[np.full(self.nx, len(self.record)), self.record.seen.sum(axis=0)].astype(float)
        sigma = np.where(np.isfinite(self.cap), self.cap, self._level(self.residuals(x, theta)) + 1e-12)
        # what a start happens to fit exactly has a floor all the same
        sigma = np.maximum(sigma, self.floor)
        least = np.maximum(_LEAST * sigma, self.floor)
        for _ in range(_SCALINGS):
            chain = self.chain(x, theta, 1.0 / np.maximum(sigma, 1e-300))
            smooth = solve(chain, point="least_squares", fallback=False).x
            if not np.isfinite(smooth).all():
                break
            rho = chain_residuals(chain, smooth)
            sigma = np.maximum(self._level(rho), least)
        return scaled_costs(count, sigma)

    def _level(self, rho: Array) -> Array:
        """Return the root mean square of each group's residuals, 0 where it has none."""
        there = np.isfinite(rho)
        return np.asarray(np.sqrt((np.where(there, rho, 0.0) ** 2).sum(axis=0) / np.maximum(there.sum(axis=0), 1)))


Rows = LinearRows | NonlinearRows


def rows_of(model: Model, record: Record, drift: float | None = None) -> Rows:
    """Return the rows of a model over a record, ready to be linearised."""
    return LinearRows(model, record, drift) if isinstance(model, Linear) else NonlinearRows(model, record)


def expected(model: Model, record: Record, k: int, x: Array) -> Array:
    """Return the states of row k, (n, nx), that a model without unknown entries expects after x, (n, nx)."""
    u = None if record.u is None else record.u[k]
    dt = float(record.t[k] - record.t[k - 1]) if k else model.dt
    if not isinstance(model, Linear):
        return np.array([model.move(one, u, dt) for one in x], dtype=np.float64).reshape(x.shape)
    t = float(record.t[k])
    moved = x @ model.A.at(t, dt, k).T
    if model.B is not None and u is not None:
        moved = moved + model.B.at(t, dt, k) @ u
    return np.asarray(moved if model.E is None else np.linalg.solve(model.E.at(t, dt, k), moved.T).T, dtype=np.float64)


def growth(model: Model, record: Record, k: int, x: Array, half: Array, q: Array) -> Array:
    """Return how far a state within `half` of x may be from what is expected at row k, if its noise keeps within q."""
    dt = float(record.t[k] - record.t[k - 1]) if k else model.dt
    if not isinstance(model, Linear):
        u = None if record.u is None else record.u[k]
        return np.asarray(np.abs(model.linearise(x, u, dt).g_x) @ half + q)
    t = float(record.t[k])
    A = model.A.at(t, dt, k)
    if model.E is None:
        return np.asarray(np.abs(A) @ half + q)
    left = np.linalg.inv(model.E.at(t, dt, k))
    return np.asarray(np.abs(left @ A) @ half + np.abs(left) @ q)


def filled(model: Linear, theta: Array) -> Linear:
    """Return the model with its unknown entries set to theta."""
    entries = model.theta_entries
    if not entries:
        return model
    new: dict[str, Any] = {}
    for entry, value in zip(entries, theta, strict=True):
        if entry.matrix not in new:
            new[entry.matrix] = model.matrices[entry.matrix].single.copy()
        new[entry.matrix][entry.row, entry.column] = value
    return dataclasses.replace(model, **new, theta_bounds=None)


def start_theta(rows: Rows, given: tuple[float, ...] | None) -> Array:
    """Return the first theta: as given, or 0, moved into its bounds; drifts start at 0."""
    theta = np.zeros(len(rows.lo))
    if given is not None:
        theta[: len(given)] = given
    return np.clip(theta, rows.lo, rows.hi)


def half_width_bounds(model: Model) -> tuple[Array, Array]:
    """Return floors and caps of (q, r)."""
    assert isinstance(model.w, Uniform)
    assert isinstance(model.e, Uniform)
    return (
        np.r_[np.broadcast_to(model.w.at_least, model.nx), np.broadcast_to(model.e.at_least, model.ny)].astype(float),
        np.r_[np.broadcast_to(model.w.at_most, model.nx), np.broadcast_to(model.e.at_most, model.ny)].astype(float),
    )


def largest(rho: Array, floor: Array) -> Array:
    """Return the largest |rho| of each group, at least its floor."""
    top = np.max(np.where(np.isnan(rho), 0.0, np.abs(rho)), axis=0, initial=0.0)
    return np.asarray(np.maximum(top, floor))


def scaled_costs(count: Array, sigma: Array) -> Array:
    """Return N_j / sigma_j over the mean count; of a group without rows 1 / sigma_j."""
    count = np.asarray(count, dtype=float)
    mean = float(count[count > 0].mean()) if np.any(count > 0) else 1.0
    return np.where(count > 0, count / mean, 1.0) / np.where(sigma > 0, sigma, 1.0)


def chain_residuals(chain: Chain, x: Array) -> Array:
    """Return the residuals (T, nx + ny) of a chain without theta at x, NaN where no row is."""
    E = np.eye(x.shape[1]) if chain.E is None else chain.E
    w = (E @ x[1:, :, None] - chain.A @ x[:-1, :, None])[..., 0] - chain.bx
    e = np.where(chain.seen, (chain.C @ x[1:, :, None])[..., 0] - chain.by, np.nan)
    return np.hstack([w, e])


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
