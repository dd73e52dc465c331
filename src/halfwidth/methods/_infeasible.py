"""Why no trajectory keeps within the half-widths of `BatchLP`, and what would reconcile it with the record.

Three answers, each by linear programs over the rows whose half-widths are bounded:

- the **inflation**: the least common factor on the half-widths with which a trajectory fits,
- the **conflicts**: the rows that exceed their bounds when the total excess, in units of sigma, is least,
- the **contradiction**: rows that alone, with the boxes of the states, cannot be kept, none of which can be left out.
  The multipliers of the least excess prove such a set; bisection finds one place of it, and there every row is left out
  in turn, and for good where the rest still contradicts itself.

References
----------
Chinneck (2008), Feasibility and Infeasibility in Optimization: elastic programs and the deletion filter.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.methods._task import Task
from halfwidth.model import Linear
from halfwidth.record import Record
from halfwidth.solvers.lp import Solution, solve
from halfwidth.solvers.program import Program, Solver, Verdict
from halfwidth.solvers.stock import HIGHS

#: Excesses below this share of sigma count as 0.
_ZERO = 1e-5
#: Multipliers below this share of the largest (a row's is at most 1) are no part of a proof.
_PART = 1e-6
#: Most rows that are left out in turn.
_MOST = 200


def inflation(task: Task, solvers: Sequence[Solver], grow: NDArray[np.bool_]) -> tuple[float | None, Array | None]:
    """Return the least common factor on the half-widths that fits a trajectory, and that trajectory.

    The caps of unknown half-widths grow, and known ones where `grow` says so; half-widths without a cap bound nothing.
    """
    import scipy.sparse as sp

    limit = np.where(task.free, task.highest, task.lowest)
    rows = _bounded(task)
    finite = np.where(np.isfinite(limit), limit, 0.0)
    M, S, rho = task.M[rows], task.S[rows], task.rho[rows]
    growing, fixed = S @ (finite * grow), S @ (finite * ~grow)
    if not np.any(growing > 0):
        return None, None
    unit = float(np.median(growing[growing > 0]))
    column = sp.csr_array(growing[:, None] / unit)
    none = np.full(rho.size, np.inf)
    found = solve(
        Program(
            c=np.r_[np.zeros(M.shape[1]), 1.0],
            G=sp.csr_array(sp.vstack([sp.hstack([M, column]), sp.hstack([M, -column])])),
            row_lo=np.r_[-rho - fixed, -none],
            row_hi=np.r_[none, fixed - rho],
            lo=np.r_[task.lo, 0.0],
            hi=np.r_[task.hi, np.inf],
            floor=1e-3 * unit,
        ),
        solvers,
    )
    if not found.solved or found.x is None:
        return None, None
    return float(found.x[-1]) / unit, task.point(found.x)


def elastic(
    task: Task, solvers: Sequence[Solver], model: Linear, record: Record, contradiction: bool
) -> tuple[Array | None, list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the trajectory of least total excess, the rows that exceed there, and rows that contradict each other.

    The last are sought only if asked for: that takes many programs.
    """
    rows = _bounded(task)
    found = solve(_excess(task, rows), solvers)
    if not found.solved or found.x is None:
        return None, [], []
    excess = np.zeros(task.rho.size)
    excess[rows] = found.x[task.M.shape[1] :]
    core = _irreducible(task, _proof(rows, found)) if contradiction else ()
    return task.point(found.x), named(task, excess, model, record), [_named(task, int(k), model, record) for k in core]


def named(task: Task, excess: Array, model: Linear, record: Record) -> list[dict[str, Any]]:
    """Describe the rows that exceed their bounds, the worst first; `excess` (rows,) is in units of sigma."""
    over = np.argsort(-excess, kind="stable")
    return [_named(task, int(k), model, record, excess[k]) for k in over[excess[over] > _ZERO]]


def _bounded(task: Task) -> NDArray[np.intp]:
    """Return the rows whose half-widths all have a cap."""
    limit = np.where(task.free, task.highest, task.lowest)
    return np.flatnonzero(np.asarray(task.S @ np.isinf(limit).astype(float)) == 0)


def _excess(task: Task, rows: NDArray[np.intp]) -> Program:
    """Return the program of the least total excess of some rows over their caps, in units of sigma."""
    import scipy.sparse as sp

    limit = np.where(task.free, task.highest, task.lowest)
    n, k = task.M.shape[1], rows.size
    M, rho = task.M[rows], task.rho[rows]
    wide = task.S[rows] @ np.where(np.isfinite(limit), limit, 0.0)
    unit, none = sp.eye_array(k), np.full(k, np.inf)
    return Program(
        c=np.r_[np.zeros(n), np.ones(k)],
        G=sp.csr_array(sp.vstack([sp.hstack([M, unit]), sp.hstack([M, -unit])])),
        row_lo=np.r_[-wide - rho, -none],
        row_hi=np.r_[none, wide - rho],
        lo=np.r_[task.lo, np.zeros(k)],
        hi=np.r_[task.hi, none],
        floor=1e-3,
    )


def _proof(rows: NDArray[np.intp], found: Solution) -> NDArray[np.intp]:
    """Return the rows whose multipliers prove the excess, in the order of time."""
    if found.z is None:
        return rows
    y = np.abs(found.z[: rows.size] + found.z[rows.size :])
    return rows[y > _PART * max(float(y.max(initial=0.0)), 1e-300)]


def _irreducible(task: Task, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Leave out every row without which the others still contradict each other."""

    def contradict(some: NDArray[np.intp]) -> bool:
        claim = HIGHS.run(_excess(task, some))  # as it says: many are asked, and each only leaves a row in or out
        if claim is None or claim.verdict is not Verdict.OPTIMAL or claim.x is None:
            return False
        return bool(claim.x[task.M.shape[1] :].sum() > _ZERO)

    found = solve(_excess(task, rows), (HIGHS,))
    rows = _proof(rows, found) if found.solved else rows  # a vertex has fewer multipliers than an interior point
    # A record may contradict itself in many places: the shortest beginning that does so, and its shortest end, are one.
    for _ in range(2):
        few, many = 0, rows.size
        while many - few > 1:
            middle = (few + many) // 2
            few, many = (few, middle) if contradict(rows[:middle]) else (middle, many)
        rows = rows[:many][::-1]
    for k in rows[1:-1][:_MOST].copy():
        rest = rows[rows != k]
        if contradict(rest):
            rows = rest
    return rows


def _named(task: Task, k: int, model: Linear, record: Record, excess: float | None = None) -> dict[str, Any]:
    """Describe row k; its excess is in its own unit."""
    rows = task.rows
    j, t = int(rows.group[k]), int(rows.row[k])
    state = j < rows.nx
    row: dict[str, Any] = {
        "t": float(record.t[t]),
        "row": t,
        "kind": "state" if state else "output",
        "name": model.names.x[j] if state else model.names.y[j - rows.nx],
    }
    return row if excess is None else row | {"excess": float(excess * (rows.S[[k]] @ task.base.sigma)[0])}
