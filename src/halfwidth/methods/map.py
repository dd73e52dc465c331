"""BatchLP: states and unknown half-widths of uniform noise at once, by linear programming over a whole record.

The joint posterior of a trajectory and the half-widths s = (q, r) is ``prod_j s_j^(-N_j)`` wherever every residual
lies within its half-width and every state in its box, and 0 elsewhere; N_j is the number of rows of group j, seen
outputs only. With the logarithm linearised, its maximum is the linear program

    minimise  sum_j c_j s_j     subject to    |E x[t] - A x[t-1] - B u[t]| <= q,   |F y[t] - C x[t]| <= r,
                                              lo <= x[t] <= hi,   floors <= (q, r) <= caps.

Three things are added to the paper. The objective is **scaled**: c_j = N_j / sigma_j with sigma_j the group's noise
level in a least-squares fit, so that metres and radians can be summed; the paper's plain sum is
``objective="paper"``. The optimum is a **face**, not a point: inside a gap the path is free within the bounds that the
worst step anywhere has set; by default the interior point stops on its central path, short of that face, and
``point="least_squares"`` returns the trajectory of least squares on it. And **what cannot be known is said**:
half-widths that leave no trace in the data, directions of the state that no output sees, and, where bounds contradict
the data, the rows that do so and the factor by which all half-widths would have to grow.

The optimal half-widths are the smallest that explain the data, often exactly 0 for one of them, so they are no bounds
of the noise to come: the estimate has no spread, and `interval` refuses.

References
----------
Pavelková (2011), State estimation with missing data and bounded uncertainty, ÚTIA report 2296: eqs. (12), (15)-(19),
algorithm 3.3.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from halfwidth.array import Array
from halfwidth.errors import BadValue
from halfwidth.methods._infeasible import elastic, inflation, named
from halfwidth.methods._protocol import typed
from halfwidth.methods._residuals import (
    half_width_bounds,
    reference,
    residuals,
)
from halfwidth.methods._task import Task
from halfwidth.model import Linear, Model, needs_a_box
from halfwidth.noise import Uniform
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.solvers.banded import BANDED
from halfwidth.solvers.banded import solve as structured
from halfwidth.solvers.lp import Solution, solve
from halfwidth.solvers.program import Solver, Verdict
from halfwidth.solvers.stock import HIGHS, PIQP, highs
from halfwidth.spread import Box

_SOLVERS: dict[str, tuple[Solver, ...]] = {
    "auto": (BANDED, PIQP, HIGHS),
    "banded": (BANDED,),
    "piqp": (PIQP,),
    "highs": (HIGHS,),
}
# HiGHS can be slow on quadratic programs; without that stage the estimate is still optimal.
_QUADRATIC: dict[str, tuple[Solver, ...]] = {
    "auto": (PIQP, highs(time_limit=2.0)),
    "banded": (PIQP,),
    "piqp": (PIQP,),
    "highs": (highs(time_limit=60.0),),
}
_STATUS = {
    Verdict.OPTIMAL: Status.OK,
    Verdict.REDUCED: Status.REDUCED,
    Verdict.INFEASIBLE: Status.INFEASIBLE,
}
#: Share of sigma, or of itself if larger, by which an optimal half-width is widened for the least-squares stage; the
#: second where the first leaves too little room.
_RELAX = (1e-6, 1e-4)
#: Price of a row beyond a known half-width, in units of the dearest one beyond an unknown half-width.
_DEAR = 1e3
#: Steps of majorise-minimise for the logarithmic objective.
_ROUNDS = 12


@dataclass(frozen=True, kw_only=True)
class BatchLP:
    """States and unknown half-widths by linear programming, the whole record at once.

    Parameters
    ----------
    objective : {"scaled", "paper", "log"}
        ``"scaled"``: ``sum N_j s_j / sigma_j`` with N_j rows and scale sigma_j of each group, the same for every
        choice of units. ``"paper"``: ``sum q + sum r`` as printed, which adds metres to radians. ``"log"``: ``sum N_j
        log s_j`` by majorise-minimise from the scaled optimum; it needs ``at_least`` above 0 for every unknown
        half-width, since it has no minimum otherwise.
    point : {"central", "least_squares", "optimal"}
        ``"central"``: the point of the central path at a relative gap of 0.3, short of the optimum, where states are
        estimated best; of the logarithm, of the program that ends at its optimum. Or a trajectory of the optimal face:
        that of least squares in units of sigma, inside the optimal half-widths widened by 1e-6 of sigma (1e-4 where
        that leaves too little room); or the one the solver happens to return.
    nu : float or None
        Elastic: every row may lie outside its half-width at a price, so that each group minimises the mean of its worst
        fraction `nu` of rows, ``s_j + sum_k max(|w_kj| - s_j, 0) / (nu N_j)``, in place of the worst one (nu near 0);
        1 is the mean absolute residual. The half-width is then that which 1 - nu of the rows keep;
        ``info["beyond"]`` names the others. Known half-widths are kept. Not for ``point="least_squares"`` or
        ``objective="log"``.
    grow_caps : bool
        Where the caps ``at_most`` of unknown half-widths leave no trajectory, double them until one fits (step 7 of
        the paper's algorithm); ``info["caps_grown"]`` says how often.
    solver : {"auto", "banded", "piqp", "highs"}
        "auto" asks the structured interior point first, then PIQP and HiGHS where an answer does not pass the check.

    Notes
    -----
    The estimate has ``x``, ``q``, ``r``, no spread (`interval` refuses: minimal half-widths are no guarantee), and in
    ``info``:

    ==================  ======================================================================
    x0                  state one step before the first row, (nx,)
    objective           value of the objective
    check               residuals and gap of the linear program by our own arithmetic, each relative; of a central
                        point there is ``gap`` instead, its distance from the optimum
    solver, iterations  who solved it
    w, e                residuals (T, nx) and (T, ny); e is NaN where y is not seen
    sigma               scale of each group, (nx + ny,)
    rows, redundancy    rows of each group, and how many rows' worth of its noise show in the data
    notes               what the numbers do not say themselves, as sentences
    unobservable        directions of x0 that no output sees, (k, nx)
    conflicts           if infeasible: the rows that cannot be kept, the worst first
    contradiction       if infeasible: rows that alone contradict each other, none of which can be left out
    inflation           if infeasible: factor on all half-widths that would reconcile them, or None
    caps_grown          factor on the caps, 1 where they were wide enough
    ==================  ======================================================================

    An infeasible record still gets a trajectory: the one that fits with all half-widths inflated, or else the one of
    least total excess.

    Raises
    ------
    BadValue
        If a setting is not one of those above.

    Examples
    --------
    >>> import halfwidth as hw
    >>> unknown = hw.Uniform.unknown(at_most=10.0)
    >>> car = hw.Linear([[1, 1], [0, 1]], None, [[1, 0]], unknown, unknown, None, names=["p", "v"])
    >>> est = hw.estimate(car, hw.Record([0, 1, 2, 3, 4], [1.0, 1.5, None, 2.5, 3.0]), hw.BatchLP())
    >>> est.x[:, 0].round(3)
    array([1. , 1.5, 2. , 2.5, 3. ])
    """

    objective: Literal["scaled", "paper", "log"] = "scaled"
    point: Literal["central", "least_squares", "optimal"] = "central"
    nu: float | None = None
    grow_caps: bool = False
    solver: Literal["auto", "banded", "piqp", "highs"] = "auto"

    def __post_init__(self) -> None:
        for name, allowed in (
            ("objective", ("scaled", "paper", "log")),
            ("point", ("central", "least_squares", "optimal")),
            ("solver", tuple(_SOLVERS)),
        ):
            if getattr(self, name) not in allowed:
                raise BadValue(f"`{name}` is {getattr(self, name)!r}, one of {', '.join(allowed)} was expected")
        if self.nu is not None:
            if not 0 < self.nu <= 1:
                raise BadValue(f"`nu` is {self.nu!r}, a share above 0 and up to 1, or None, was expected")
            if self.objective == "log" or self.point == "least_squares":
                raise BadValue(
                    f"`nu` was given with objective {self.objective!r} and point {self.point!r}",
                    hint='BatchLP(nu=0.3, objective="scaled", point="central")',
                )

    def refuses(self, model: Model) -> str | None:
        """Return why the model cannot be taken, or None."""
        if not isinstance(model, Linear):
            return (
                "`BatchLP` needs a linear model but the model is nonlinear"
                "\nhint: linearise it, or use a method for nonlinear models"
            )
        for name, noise in (("w", model.w), ("e", model.e)):
            if not isinstance(noise, Uniform):
                kind = type(noise).__name__
                return (
                    f"`BatchLP` needs uniform noise but `{name}` is `{kind}`\nhint: {name}=Uniform.unknown(at_most=...)"
                )
        if (reason := needs_a_box(model, type(self).__name__)) is not None:
            return reason
        if not isinstance(model.x0, Box):
            return "`BatchLP` needs a box as prior but `x0` is `Normal`\nhint: x0=Box(lo, hi), or None for no bounds"
        if model.theta_entries:
            entry = model.theta_entries[0]
            return (
                f"`BatchLP` needs known matrices but `{entry.matrix}[{entry.row}, {entry.column}]` is unknown"
                "\nhint: give it a value, or use a method that estimates theta"
            )
        if model.loss is not None:
            return "`BatchLP` takes lost outputs as NaN in the record but the model has a hidden loss\nhint: loss=None"
        if self.nu is not None and model.F is not None:
            return "`BatchLP(nu=...)` needs outputs of their own noise but the model has `F`\nhint: nu=None"
        floor, cap = half_width_bounds(model)
        if self.objective == "log" and np.any((floor < cap) & (floor <= 0)):
            return (
                "`BatchLP(objective='log')` needs a floor above 0 for every unknown half-width: the logarithm has no"
                " minimum at 0\nhint: Uniform.unknown(at_least=..., at_most=...)"
            )
        return None

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:  # noqa: ARG002
        """Estimate states and half-widths of one record."""
        assert isinstance(model, Linear)
        return self.answer(model, record)

    def answer(self, model: Linear, record: Record, *, contradiction: bool = True) -> Estimate:
        """Estimate one record; a window among many does without the search for a contradiction, a second or so."""
        rows = residuals(model, record)
        floor, cap = half_width_bounds(model)
        # A uniform noise of known half-width q has the standard deviation q / sqrt(3).
        base = reference(rows, model, np.where(floor == cap, floor / math.sqrt(3.0), 0.0))
        task = Task.build(rows, base, model, record)
        solvers = _SOLVERS[self.solver]
        info: dict[str, Any] = {"caps_grown": 1.0}

        if self.nu is not None and task.free.any():
            return self._elastic(model, record, task, self.nu, info)
        if self.point == "central" and self.objective != "log":
            est = self._central(model, record, task, task.weights(self.objective), info)
            if est is not None:
                return est

        found, weight = self._minimise(task, solvers)
        if found.verdict is Verdict.INFEASIBLE and self.grow_caps:
            factor, _ = inflation(task, solvers, task.free)
            if factor is not None:
                # The doublings of the paper's loop in one go: the first power of two that fits.
                info["caps_grown"] = 2.0 ** math.ceil(math.log2(factor * (1 + 1e-6)))
                task = task.grown(info["caps_grown"])
                found, weight = self._minimise(task, solvers)
        if found.verdict is Verdict.INFEASIBLE:
            return self._infeasible(model, record, task, solvers, found, info, contradiction)

        status = _STATUS.get(found.verdict, Status.STALLED)
        if found.x is None or not status.good:
            info |= {"solver": found.solver, "notes": list(found.notes), "iterations": found.iterations}
            info["message"] = f"{Status.STALLED.value}: {'; '.join(found.notes)}"
            return self._estimate(model, record, task.clipped(base.X), None, Status.STALLED, info)

        if self.point == "central" and self.objective == "log":
            est = self._central(model, record, task, weight, info)
            if est is not None:
                return est

        X, s = task.point(found.x), task.half_widths(found.x)
        if self.point != "optimal" and np.any(found.x[base.X.size :] > _RELAX[0]):
            for relax in _RELAX:
                second = solve(task.squares(found.x, relax), _QUADRATIC[self.solver])
                if second.solved and second.x is not None:
                    X = task.point(second.x)
                    status = _STATUS[second.verdict] if status is Status.OK else status
                    break
            else:
                status = Status.REDUCED
                info["message"] = "the least-squares stage failed, so this is the solver's own optimal trajectory"
        s = task.enough(X, s)
        info |= task.report(X, s, model, record, self._value(task, s), found)
        if "message" not in info and info["notes"]:
            info["message"] = "; ".join([status.value, *info["notes"]])
        return self._estimate(model, record, X, s, status, info)

    def _central(
        self, model: Linear, record: Record, task: Task, weight: Array, info: dict[str, Any]
    ) -> Estimate | None:
        """Return the central point of the program with these costs, or None where the structured solver has none."""
        central = task.central(weight)
        if central is None:
            return None
        X, s = task.clipped(central.x.ravel()), np.clip(central.s, task.floor, np.maximum(task.cap, task.floor))
        info |= task.report(X, s, model, record, self._value(task, s), None)
        info |= {"solver": central.by, "iterations": central.iterations, "gap": central.gap}
        if info["notes"]:
            info["message"] = "; ".join([Status.OK.value, *info["notes"]])
        return self._estimate(model, record, X, s, Status.OK, info)

    def _elastic(self, model: Linear, record: Record, task: Task, nu: float, info: dict[str, Any]) -> Estimate:
        """Minimise the mean of the worst fraction of each group: a row may exceed its half-width at a price."""
        shifted = task.shifted(task.weights(self.objective))
        assert shifted is not None  # there is no F
        cost = shifted.chain.c
        price = np.where(task.free, cost / (nu * np.maximum(task.rows.count, 1.0)), 0.0)
        price = np.where(task.free, price, _DEAR * float(price.max()))
        answer = structured(replace(shifted.chain, slack=price), point=self.point)
        if not answer.status.good or not np.isfinite(answer.x).all():
            info |= {"solver": answer.by, "notes": [], "iterations": answer.iterations}
            return self._estimate(model, record, task.clipped(task.base.X), None, Status.STALLED, info)
        X, s = task.clipped(answer.x.ravel()), np.clip(answer.s, task.floor, np.maximum(task.cap, task.floor))
        info |= task.report(X, s, model, record, self._value(task, s), None)
        excess = np.maximum(np.abs(task.rows.at(X)) - task.rows.S @ s, 0.0) / (task.rows.S @ task.base.sigma)
        info |= {"beyond": named(task, excess, model, record)}
        info |= {"solver": answer.by, "iterations": answer.iterations, "gap": answer.gap}
        if info["notes"]:
            info["message"] = "; ".join([answer.status.value, *info["notes"]])
        return self._estimate(model, record, X, s, answer.status, info)

    def _minimise(self, task: Task, solvers: Sequence[Solver]) -> tuple[Solution, Array]:
        """Return the optimal point of the chosen objective, and the costs that it is optimal for."""
        weight = task.weights("paper" if self.objective == "paper" else "scaled")
        program = task.program(weight)
        found = solve(program, solvers)
        if self.objective != "log" or found.x is None:
            return found, weight
        # The tangent of the logarithm lies above it, so each program lowers sum N log s.
        count = task.rows.count / max(float(task.rows.count.max()), 1.0)
        n = task.rows.M.shape[1]
        s = np.maximum(found.x[n:], task.lowest)
        for _ in range(_ROUNDS):
            cost = np.where(task.free, count / np.where(task.free, s, 1.0), 0.0)
            cost = cost / max(float(cost.max()), 1e-300)
            again = solve(replace(program, c=np.r_[np.zeros(n), cost]), solvers)
            if not again.solved or again.x is None:
                break
            last, s, found, weight = s, np.maximum(again.x[n:], task.lowest), again, cost
            if np.max(np.abs(s - last) / np.where(task.free, last, 1.0), initial=0.0) < 1e-6:
                break
        return found, weight

    def _value(self, task: Task, s: Array) -> float:
        """Return the objective in the units of its definition."""
        there = task.rows.count > 0
        if self.objective == "paper":
            return float(s[there].sum())
        if self.objective == "log":
            pick = task.free & there
            return float(task.rows.count[pick] @ np.log(s[pick]))
        return float(task.weights("scaled") @ (s / task.base.sigma))

    def _infeasible(
        self,
        model: Linear,
        record: Record,
        task: Task,
        solvers: Sequence[Solver],
        found: Solution,
        info: dict[str, Any],
        contradiction: bool,
    ) -> Estimate:
        """Say which rows conflict, and what would reconcile them."""
        factor, inflated = inflation(task, solvers, np.ones_like(task.free))
        capped = bool(np.any(task.free & np.isfinite(task.highest)))
        least, conflicts, core = elastic(task, solvers, model, record, contradiction)
        X = next((v for v in (inflated, least) if v is not None), task.base.X)
        message = Status.INFEASIBLE.value
        if conflicts:
            first, last = min(c["t"] for c in conflicts), max(c["t"] for c in conflicts)
            when = f"at t = {first:.9g} s" if first == last else f"between t = {first:.9g} s and t = {last:.9g} s"
            message = f"{message} {when}"
        if factor is not None:
            message = f"{message}; they fit if all half-widths grow {_up(factor):g} times"
        info |= {
            "message": message,
            "conflicts": conflicts,
            "contradiction": core,
            "inflation": factor,
            "solver": found.solver,
            "iterations": found.iterations,
            "notes": [],
            "hint": ("BatchLP(grow_caps=True), or " if capped and not self.grow_caps else "")
            + "make the outputs that info['conflicts'] names missing",
        }
        return self._estimate(model, record, task.clipped(X), None, Status.INFEASIBLE, info)

    def _estimate(
        self, model: Linear, record: Record, X: Array, s: Array | None, status: Status, info: dict[str, Any]
    ) -> Estimate:
        x = X.reshape(-1, model.nx)
        info["x0"] = x[0].copy()
        return Estimate(
            record.t,
            x[1:].copy(),
            None,
            status,
            typed(self),
            q=None if s is None else s[: model.nx].copy(),
            r=None if s is None else s[model.nx :].copy(),
            names=model.names.x,
            labels=record.labels,
            info=info,
        )


def _up(factor: float) -> float:
    """Round up to two digits."""
    step = 10.0 ** (math.floor(math.log10(factor)) - 1)
    return math.ceil(factor / step - 1e-9) * step
