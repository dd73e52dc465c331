"""The structured interior point that solves the chain of `halfwidth.solvers.chain`.

`solve` hands its arrays to `halfwidth._core` (core/banded_ipm.hpp), which eliminates time block by block: the cost of
an iteration is linear in T. Three points are on offer: the **optimal** one; the **central** one, a point of the central
path at a relative gap of 0.3, which estimates states better than any optimum does and costs a third; and the
**least_squares** start. Whatever the core does not certify (a gap above 1e-8, an infeasible program) is asked again of
the stock solvers, whose answers `halfwidth.solvers.lp` proves; a wrong "optimal" is the one thing that must not happen.

References
----------
Mehrotra (1992), On the implementation of a primal-dual interior point method. Gleixner, Steffy and Wolter (2016),
Iterative refinement for linear programming.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from halfwidth._core import lp_solve
from halfwidth.array import Array
from halfwidth.result import Status
from halfwidth.solvers.chain import Chain
from halfwidth.solvers.lp import Solution
from halfwidth.solvers.lp import solve as proved
from halfwidth.solvers.program import Claim, Program, Solver, Verdict
from halfwidth.solvers.stock import HIGHS, PIQP

Point = Literal["central", "optimal", "least_squares"]
POINTS: dict[str, int] = {"optimal": 0, "central": 1, "least_squares": 2}
#: What the core's codes mean.
STATUSES = (Status.OK, Status.REDUCED, Status.INFEASIBLE, Status.STALLED)
#: Rows beyond which HiGHS, which may take minutes, is asked only where there is no other answer.
_LONG = 500
#: Rows beyond which no stock solver is asked to better an answer that is good to 1e-6: it may take minutes, and all
#: the memory there is.
_LARGE = 50_000
#: A well-centred iterate: x (T + 1, nx), theta, s, multipliers of rows, of boxes, of the ends of theta and s.
Start = tuple[Array, Array, Array, Array, Array, Array]


class Answer(NamedTuple):
    """What was found: x (T + 1, nx), theta (p0,), s (ns,), multipliers (T, nx + ny, 2), and how it went.

    `objective` is ``c's``; `gap` its distance from the dual objective, relative; `scale` the size of the residuals at
    the least-squares start; `by` the solver; `start` where a similar program may begin.
    """

    x: Array
    theta: Array
    s: Array
    multipliers: Array | None
    slack: Array | None
    status: Status
    objective: float
    gap: float
    iterations: int
    scale: float
    by: str
    start: Start | None = None


def solve(
    chain: Chain,
    *,
    point: Point = "central",
    tol: float = 1e-9,
    central_gap: float = 0.3,
    max_iter: int = 100,
    multipliers: bool = False,
    fallback: bool = True,
    start: Start | None = None,
    drop: int = 0,
    keep: bool = False,
) -> Answer:
    """Solve the program.

    Parameters
    ----------
    chain : Chain
    point : {"central", "optimal", "least_squares"}
    tol : float
        Relative gap of the optimal point.
    central_gap : float
        Relative gap of the central point.
    max_iter : int
    multipliers : bool
        Return them too, in units of cost by residual.
    fallback : bool
        Ask the stock solvers where the core does not certify its answer.
    start : Start, optional
        Where an optimal point may begin: the `start` of a program of the same sizes that began `drop` rows earlier. The
        optimum does not depend on it; where it leads nowhere the program is solved from least squares.
    drop : int
    keep : bool
        Return a `start` for the next program.

    Returns
    -------
    Answer
        Its status is OK only with a relative gap of at most 1e-8 (or `central_gap`); INFEASIBLE only with a proof.
    """
    c = chain
    x, theta, s, lam, slack, info = lp_solve(
        *_arrays(c), POINTS[point], tol, central_gap, max_iter, multipliers, start, drop, keep
    )
    status = STATUSES[info["status"]]
    answer = Answer(
        x, theta, s, lam, slack, status, info["objective"], info["gap"], info["iterations"], info["scale"], "banded",
        info["start"],
    )  # fmt: skip
    if status is Status.OK or not fallback:
        return answer
    if status is Status.REDUCED:
        if point == "optimal":
            answer = _again(c, answer, tol, max_iter, multipliers)
        if answer.status is Status.OK or c.T > _LARGE:
            return answer
    return _proved(c, answer)


def _arrays(c: Chain) -> tuple[Any, ...]:
    return (
        c.E, c.A, c.C, c.G, c.bx, c.by, c.seen, c.lo, c.hi, c.x0_lo, c.x0_hi, c.theta_lo, c.theta_hi, c.group, c.h, c.c,
        c.floor, c.cap, c.slack,
    )  # fmt: skip


def _again(chain: Chain, answer: Answer, tol: float, max_iter: int, multipliers: bool) -> Answer:
    """Solve the program measured from an answer of reduced accuracy; return the better of the two.

    What rounding took from large states is gone there: the refinement of linear programs after Gleixner, Steffy and
    Wolter (2016).
    """
    c, x, theta = chain, answer.x, answer.theta
    E, A, C = (np.eye(x.shape[1]) if M is None else M for M in (c.E, c.A, c.C))
    at = np.zeros((c.T, len(c.h))) if c.G is None else c.G @ theta
    at[:, : x.shape[1]] += (E @ x[1:, :, None] - A @ x[:-1, :, None])[..., 0]
    at[:, x.shape[1] :] += (C @ x[1:, :, None])[..., 0]
    ends: dict[str, Any] = {
        name: None if end is None else end - place
        for name, end, place in (
            ("lo", c.lo, x), ("hi", c.hi, x), ("x0_lo", c.x0_lo, x[0]), ("x0_hi", c.x0_hi, x[0]),
            ("theta_lo", c.theta_lo, theta), ("theta_hi", c.theta_hi, theta),
        )
    }  # fmt: skip
    by = np.where(c.seen, c.by, 0.0) - np.where(c.seen, at[:, x.shape[1] :], 0.0)
    moved = replace(chain, bx=np.ascontiguousarray(c.bx - at[:, : x.shape[1]]), by=by, **ends)
    if not (np.isfinite(moved.bx).all() and np.isfinite(moved.by).all()):
        return answer
    more = solve(moved, point="optimal", tol=tol, max_iter=max_iter, multipliers=multipliers, fallback=False)
    if more.status is not Status.OK:
        return answer
    return more._replace(x=x + more.x, theta=theta + more.theta, iterations=answer.iterations + more.iterations)


def _proved(chain: Chain, answer: Answer) -> Answer:
    """Return the stock solvers' answer, or the structured one's if they have none that is better."""
    answer = answer._replace(start=None)
    found: Solution | None = None
    near = moved = _Near.of(chain, answer)
    given = _Near.as_given(chain, answer)  # better where nothing but rounding is left to explain
    # Half-widths without a cap can always grow, and a point that keeps within the caps has been found.
    feasible = answer.status is Status.REDUCED or not np.isfinite(chain.cap).any()
    value = answer.objective if answer.status is Status.REDUCED else np.inf
    for where, solver in ((moved, PIQP), (moved, HIGHS), (given, PIQP), (given, HIGHS)):
        if solver is HIGHS and chain.T > _LONG and value < np.inf:
            continue
        one = proved(where.chain.program(), (solver,))
        if one.verdict is Verdict.INFEASIBLE and not feasible:
            return answer._replace(status=Status.INFEASIBLE, by=one.solver)
        best = found is not None and found.verdict is Verdict.OPTIMAL
        lower = one.objective * where.size < value * (1.0 - 1e-9)
        if (one.verdict is Verdict.OPTIMAL and (lower or not best)) or (one.solved and lower and not best):
            near, found, value = where, one, one.objective * where.size
        # An interior point's dual residual is worth more than it says where states can be large: ask for a vertex too.
        if one.verdict is Verdict.OPTIMAL and (solver is HIGHS or chain.T > _LONG):
            break
    if found is None or found.x is None:
        return answer if answer.status is Status.REDUCED else answer._replace(status=Status.STALLED)
    T, nx = chain.bx.shape
    n, p0, ns = (T + 1) * nx, len(answer.theta), len(chain.c)
    x, theta, s, e = np.split(found.x, [n, n + p0, n + p0 + ns])
    s = np.clip(near.s * s, chain.floor, np.maximum(chain.cap, chain.floor))
    slack, value = answer.slack, float(chain.c @ s)
    if slack is not None and chain.slack is not None:
        slack = np.zeros_like(slack)
        slack[:, :nx] = e[: T * nx].reshape(T, nx)
        slack[:, nx:][chain.seen] = e[T * nx :]
        slack *= near.row
        value += float((slack @ chain.slack).sum())
    return answer._replace(
        x=near.point + near.x * x.reshape(T + 1, nx),
        theta=near.at + near.theta * theta,
        s=s,
        multipliers=None,
        slack=slack,
        status=Status.OK if found.verdict is Verdict.OPTIMAL else Status.REDUCED,
        objective=value,
        gap=found.check.gap if found.check is not None else answer.gap,
        by=found.solver,
    )


class _Near(NamedTuple):
    """A chain measured from a point close to its optimum, in units in which all its numbers are near 1.

    `x` (nx,), `theta` (p0,), `s` (ns,) and `row` (nx + ny,) are these units: states are ``point + x x'``, parameters
    ``at + theta theta'``, residuals ``row rho'``, the objective ``size`` times its.
    """

    chain: Chain
    point: Array
    at: Array
    x: Array
    theta: Array
    s: Array
    row: Array
    size: float

    @classmethod
    def of(cls, c: Chain, answer: Answer) -> "_Near":
        """Measure a chain from an answer."""
        (T, nx), ny = c.bx.shape, c.by.shape[1]
        size = answer.scale if answer.scale > 0 else 1.0
        known = np.where((c.cap > 0) & np.isfinite(c.cap), c.cap, 1.0)
        s = size * np.where(c.c > 0, 1.0 / np.where(c.c > 0, c.c, 1.0), known)
        row = c.h * s[c.group]
        A, C = np.broadcast_to(c.A, (T, nx, nx)), np.broadcast_to(c.C, (T, ny, nx))
        E = np.broadcast_to(np.eye(nx) if c.E is None else c.E, (T, nx, nx))
        A, E, C = A / row[:nx, None], E / row[:nx, None], np.where(c.seen[:, :, None], C / row[nx:, None], 0.0)
        x = _unit(np.concatenate([A, E, C], axis=1))
        G = None if c.G is None else c.G / row[:, None]
        if G is not None:
            G = np.concatenate([G[:, :nx], np.where(c.seen[:, :, None], G[:, nx:], 0.0)], axis=1)
        theta = np.zeros(0) if G is None else _unit(G)
        bx = c.bx / row[:nx] - (E @ answer.x[1:, :, None] - A @ answer.x[:-1, :, None])[..., 0]
        by = np.where(c.seen, c.by / row[nx:] - (C @ answer.x[1:, :, None])[..., 0], 0.0)
        if G is not None:
            bx, by = bx - G[:, :nx] @ answer.theta, by - np.where(c.seen, G[:, nx:] @ answer.theta, 0.0)
        ends = {
            name: None if end is None else (end - at) / unit
            for name, end, at, unit in (
                ("lo", c.lo, answer.x, x), ("hi", c.hi, answer.x, x),
                ("x0_lo", c.x0_lo, answer.x[0], x), ("x0_hi", c.x0_hi, answer.x[0], x),
                ("theta_lo", c.theta_lo, answer.theta, theta), ("theta_hi", c.theta_hi, answer.theta, theta),
            )
        }  # fmt: skip
        chain = Chain(
            A=A * x, C=C * x, E=E * x, bx=bx, by=by, seen=c.seen, group=c.group, h=np.ones(nx + ny),
            c=np.where(c.c > 0, 1.0, 0.0), floor=c.floor / s, cap=c.cap / s, G=None if G is None else G * theta,
            slack=None if c.slack is None else c.slack * row / size, **ends,
        )  # fmt: skip
        return cls(chain, answer.x, answer.theta, x, theta, s, row, size)

    @classmethod
    def as_given(cls, c: Chain, answer: Answer) -> "_Near":
        """Leave a chain in its own units."""
        one = np.ones(len(c.h))
        return cls(
            c, np.zeros_like(answer.x), np.zeros_like(answer.theta), np.ones(c.bx.shape[1]), np.ones_like(answer.theta),
            np.ones_like(c.c), one, 1.0,
        )  # fmt: skip


def _unit(columns: Array) -> Array:
    """Return what each column is multiplied by to be of size 1 in the mean row of time; columns are (T, rows, n)."""
    norm = np.sqrt(np.square(columns).sum(axis=1).mean(axis=0))
    fine = (norm > 1e-140) & (norm < 1e140)
    return np.asarray(np.where(fine, 1.0 / np.where(fine, norm, 1.0), 1.0))


@dataclass(frozen=True, eq=False)
class Shifted:
    """A chain, and where the variables of a program stand to its own: ``X = ref + column xi``, ``s = sigma s^``.

    Parameters
    ----------
    chain : Chain
    ref, column : ((T + 1) nx,) arrays
    sigma : (ns,) array
    known : (K,) bool array
        Rows of known half-width; the program holds them two-sided behind the others.
    """

    chain: Chain
    ref: Array
    column: Array
    sigma: Array
    known: NDArray[np.bool_]


def squares(chain: Chain, s: Array, relax: tuple[float, ...] = (1e-6, 1e-4)) -> tuple[Array, Array] | None:
    """Return states and theta of least squares inside given half-widths, each row in units of its own; None if none.

    Parameters
    ----------
    chain : Chain
        Its own costs, floors and caps are not looked at.
    s : (ns,) array
        Half-widths.
    relax : tuple of float
        Shares by which they are widened, the second where the first leaves too little room.
    """
    import scipy.sparse as sp

    given = chain.program()
    n, K = given.G.shape[1] - len(s), given.G.shape[0] // 2
    M = sp.csr_array(given.G)[:K, :n]
    S = -sp.csr_array(given.G)[:K, n:]
    b = given.row_hi[:K]
    limit = S @ s
    size = np.where(limit > 0, limit, max(float(limit.max(initial=0.0)), 1.0))
    M, b = sp.csr_array(sp.diags_array(1.0 / size) @ M), b / size
    for widened in relax:
        room = np.where(limit > 0, 1.0 + widened, widened)
        found = proved(
            Program(
                c=np.asarray(-(M.T @ b)), G=M, row_lo=b - room, row_hi=b + room,
                lo=given.lo[:n], hi=given.hi[:n], P=sp.csr_array(M.T @ M), floor=1e-3,
            ),
            (PIQP,),
        )  # fmt: skip
        if found.solved and found.x is not None:
            p0 = n - (chain.T + 1) * chain.bx.shape[1]
            return found.x[: n - p0].reshape(chain.T + 1, -1), found.x[n - p0 :]
    return None


def _claim(program: Program) -> Claim | None:
    """Adapter for `halfwidth.solvers.lp`: None unless the program carries the chain it was built from."""
    given = program.chain
    if program.P is not None or not isinstance(given, Chain | Shifted):
        return None
    chain = given.chain if isinstance(given, Shifted) else given
    if chain.slack is not None:
        return None
    if isinstance(given, Shifted):
        chain = replace(chain, c=program.c[len(given.ref) :] / given.sigma)
    found = solve(chain, point="optimal", multipliers=True, fallback=False)
    if found.status not in (Status.OK, Status.REDUCED) or found.multipliers is None:
        return None
    nx = chain.bx.shape[1]
    lam = np.concatenate([found.multipliers[:, :nx].reshape(-1, 2), found.multipliers[:, nx:][chain.seen]])
    upper, lower = -lam[:, 0], lam[:, 1]
    x, s = found.x.ravel(), found.s
    if isinstance(given, Shifted):
        x, s = (x - given.ref) / given.column, s / given.sigma
        kind = np.r_[np.tile(np.arange(nx), chain.T), nx + np.nonzero(chain.seen)[1]]
        size = given.sigma[kind]
        upper, lower, open_ = upper * size, lower * size, ~given.known
        z = np.r_[lower[open_], upper[open_], (upper + lower)[given.known]]
    else:
        z = np.r_[upper, lower]
    return Claim(Verdict.OPTIMAL, np.r_[x, found.theta, s], z, iterations=found.iterations)


#: The structured solver behind the checked interface; it takes programs made by `Chain.program`.
BANDED = Solver("banded", _claim, balanced=False)
