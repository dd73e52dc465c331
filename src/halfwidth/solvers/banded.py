"""The linear program of bounded noise as a chain in time, and the structured interior point that solves it.

::

    minimise  c's    over states x_0 .. x_T, parameters theta, half-widths s
    s.t.      |E x_k - A x_{k-1} + G theta - bx| <= h s,   |C x_k + G theta - by| <= h s,   boxes on x, theta, s

`Chain` holds the arrays, `solve` hands them to `halfwidth._core` (core/banded_ipm.hpp), which eliminates time block by
block: the cost of an iteration is linear in T. Three points are on offer: the **optimal** one; the **central** one, a
point of the central path at a relative gap of 0.3, which estimates states better than any optimum does and costs a
third; and the **least_squares** start. Whatever the core does not certify (a gap above 1e-8, an infeasible program) is
asked again of the stock solvers, whose answers `halfwidth.solvers.lp` proves; a wrong "optimal" is the one thing
that must not happen.

References
----------
Pavelková (2011), ÚTIA report 2296, eqs. (16)-(19); Pavelková and Kárný (2013), eqs. (22)-(26).
Mehrotra (1992), On the implementation of a primal-dual interior point method.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from halfwidth._core import lp_solve
from halfwidth.array import Array
from halfwidth.model import Linear
from halfwidth.record import Record
from halfwidth.result import Status
from halfwidth.solvers.lp import Solution
from halfwidth.solvers.lp import solve as proved
from halfwidth.solvers.program import Claim, Program, Solver, Verdict
from halfwidth.solvers.stock import HIGHS, PIQP
from halfwidth.spread import Box
from halfwidth.varying import Varying

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


@dataclass(frozen=True, eq=False)
class Chain:
    """The arrays of the program, in the user's units.

    Parameters
    ----------
    A, C : (nx, nx) and (ny, nx), or stacked (T, ., .)
    bx, by : (T, nx) and (T, ny)
        ``B u`` and ``F y``; unseen entries may hold any finite number.
    seen : (T, ny) bool
    group : (nx + ny,) int32
        Half-width that bounds the rows of each kind, states first.
    h : (nx + ny,)
        Factor on that half-width.
    c, floor, cap : (ns,)
        Cost, floor and cap of each half-width; where floor and cap agree it is known.
    E : (nx, nx) or (T, nx, nx), or None for the identity
    G : (T, nx + ny, p0) or None
        Columns of theta.
    lo, hi : (nx,) or (T + 1, nx), or None
        Box of the states.
    x0_lo, x0_hi : (nx,) or None
        Box of x_0 in place of `lo`, `hi` there.
    theta_lo, theta_hi : (p0,) or None
    slack : (nx + ny,) or None
        Cost of a slack of each row of a kind.
    """

    A: Array
    C: Array
    bx: Array
    by: Array
    seen: NDArray[np.bool_]
    group: NDArray[np.int32]
    h: Array
    c: Array
    floor: Array
    cap: Array
    E: Array | None = None
    G: Array | None = None
    lo: Array | None = None
    hi: Array | None = None
    x0_lo: Array | None = None
    x0_hi: Array | None = None
    theta_lo: Array | None = None
    theta_hi: Array | None = None
    slack: Array | None = None

    @property
    def T(self) -> int:
        """Number of rows of the record."""
        return len(self.bx)

    def part(self, a: int, b: int) -> "Chain":
        """Return the chain of rows a to b - 1; the box of x_0 stays with row 0 alone."""

        def cut(matrix: Any, rows: int = 3, more: int = 0) -> Any:
            return matrix if matrix is None or matrix.ndim < rows else matrix[a : b + more]

        return replace(
            self,
            A=cut(self.A),
            C=cut(self.C),
            E=cut(self.E),
            G=cut(self.G),
            bx=self.bx[a:b],
            by=self.by[a:b],
            seen=self.seen[a:b],
            lo=cut(self.lo, 2, 1),
            hi=cut(self.hi, 2, 1),
            x0_lo=self.x0_lo if a == 0 else None,
            x0_hi=self.x0_hi if a == 0 else None,
        )

    def program(self) -> Program:
        """Return the same program as sparse rows, for solvers that know nothing of time."""
        import scipy.sparse as sp

        T, nx = self.bx.shape
        ny, p0, ns = self.by.shape[1], 0 if self.G is None else self.G.shape[2], len(self.c)
        n = (T + 1) * nx
        A, C = np.broadcast_to(self.A, (T, nx, nx)), np.broadcast_to(self.C, (T, ny, nx))
        E = np.broadcast_to(np.eye(nx) if self.E is None else self.E, (T, nx, nx))
        t, i, j = (a.ravel() for a in np.meshgrid(range(T), range(nx), range(nx), indexing="ij"))
        seen_t, seen_j = np.nonzero(self.seen)
        K = T * nx + seen_t.size
        kind = np.r_[np.tile(np.arange(nx), T), nx + seen_j]
        rows = [t * nx + i, t * nx + i, np.repeat(np.arange(T * nx, K), nx)]
        columns = [t * nx + j, (t + 1) * nx + j, ((seen_t + 1)[:, None] * nx + np.arange(nx)).ravel()]
        values = [-A[t, i, j], E[t, i, j], C[seen_t, seen_j].ravel()]
        M = sp.csr_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(K, n))
        M.eliminate_zeros()
        b = np.r_[self.bx.ravel(), self.by[seen_t, seen_j]]
        if self.G is not None:
            Gk = np.concatenate([self.G[:, :nx].reshape(-1, p0), self.G[seen_t, nx + seen_j]])
            M = sp.csr_array(sp.hstack([M, sp.csr_array(Gk)]))
        S = sp.csr_array((self.h[kind], (np.arange(K), self.group[kind])), shape=(K, ns))
        free = np.full(n, np.inf)
        lo = -free if self.lo is None else np.broadcast_to(self.lo, (T + 1, nx)).ravel().copy()
        hi = free if self.hi is None else np.broadcast_to(self.hi, (T + 1, nx)).ravel().copy()
        if self.x0_lo is not None and self.x0_hi is not None:
            lo[:nx], hi[:nx] = self.x0_lo, self.x0_hi
        theta_lo = np.zeros(0) if self.theta_lo is None else self.theta_lo
        theta_hi = np.zeros(0) if self.theta_hi is None else self.theta_hi
        known = self.cap <= self.floor
        none = np.full(K, np.inf)
        c = np.r_[np.zeros(n + p0), np.where(known, 0.0, self.c)]
        lows, highs = [lo, theta_lo, self.floor], [hi, theta_hi, self.cap]
        upper, lower = [M, -S], [M, S]
        if self.slack is not None:
            upper.append(-sp.eye_array(K))
            lower.append(sp.eye_array(K))
            c = np.r_[c, self.slack[kind]]
            lows.append(np.zeros(K))
            highs.append(none)
        return Program(
            c=c,
            G=sp.csr_array(sp.vstack([sp.hstack(upper), sp.hstack(lower)])),
            row_lo=np.r_[-none, b],
            row_hi=np.r_[b, none],
            lo=np.concatenate(lows),
            hi=np.concatenate(highs),
            floor=1e-9 * float(np.abs(self.c).max(initial=0.0)),
            chain=self,
        )


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


def every(matrix: Varying, record: Record, dt: Array) -> Array:
    """Return a matrix as one (., .) or, if it moves, stacked (T, ., .); contiguous."""
    stack, index = matrix.stack(record.t, dt)
    if index is None:
        return np.ascontiguousarray(stack[0] if len(stack) == 1 and matrix.value is not None else stack)
    return np.ascontiguousarray(stack[index])


def chain_of(model: Linear, record: Record, c: Array, floor: Array, cap: Array) -> Chain | None:
    """Return the chain of a linear model without unknown entries over a record.

    None where F couples a seen output with an unseen one: such a row is bounded by a sum of half-widths, which the
    chain does not express.
    """
    dt = record.steps(model.dt)
    T, nx, ny = len(record), model.nx, model.ny
    seen = record.seen
    y = np.where(seen, record.y, 0.0)
    if model.F is not None:
        F = np.broadcast_to(every(model.F, record, dt), (T, ny, ny))
        off = np.where(np.eye(ny, dtype=bool), 0.0, F)
        if np.any((off != 0) & seen[:, :, None] & ~seen[:, None, :]):
            return None
        y = np.einsum("tij,tj->ti", F, y)
    drive = np.zeros((T, nx))
    if model.B is not None and record.u is not None:
        drive = np.einsum("tij,tj->ti", np.broadcast_to(every(model.B, record, dt), (T, nx, model.nu)), record.u)
    assert isinstance(model.x0, Box)
    box = model.bounds
    bounded = np.isfinite(model.x0.lo).any() or np.isfinite(model.x0.hi).any()
    return Chain(
        A=_whole(every(model.A, record, dt), T),
        C=_whole(every(model.C, record, dt), T),
        E=None if model.E is None else _whole(every(model.E, record, dt), T),
        bx=np.ascontiguousarray(drive),
        by=np.ascontiguousarray(y),
        seen=np.ascontiguousarray(seen),
        group=np.arange(nx + ny, dtype=np.int32),
        h=np.ones(nx + ny),
        c=np.array(c, dtype=float),
        floor=np.array(floor, dtype=float),
        cap=np.array(cap, dtype=float),
        lo=None if box is None else np.array(box.lo, dtype=float),
        hi=None if box is None else np.array(box.hi, dtype=float),
        x0_lo=np.array(model.x0.lo, dtype=float) if bounded or box is not None else None,
        x0_hi=np.array(model.x0.hi, dtype=float) if bounded or box is not None else None,
    )


def _whole(matrix: Array, T: int) -> Array:
    """Return a matrix constant (., .), or stacked for every row."""
    if matrix.ndim == 3 and len(matrix) == 1 and T > 1:
        return np.ascontiguousarray(matrix[0])
    return matrix
