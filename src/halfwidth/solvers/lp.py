"""Linear and convex quadratic programs: a library solves, and nothing is believed that we have not checked.

::

    minimise  x'P x / 2 + c'x     subject to     row_lo <= G x <= row_hi,   lo <= x <= hi

`solve(program)` balances rows and columns by powers of two, asks the solvers in turn and judges
what each of them claims with our own arithmetic. A point is **optimal** only if rows and boxes
hold, the reduced costs

    d = c + P x - G'z

have the signs that the boxes allow, and the dual objective meets the primal one, all within 1e-7
of the balanced program. A program is **infeasible** only with a Farkas certificate: multipliers z
of the rows whose combination z'G x stays below what the rows demand wherever x is in its box;
where no solver hands one over, the multipliers of the elastic program (least total violation of
the rows, always solvable, judged the same way) are one. It is **unbounded** only with a feasible
point and a direction of descent that no row stops. Otherwise the next solver is asked, and in the
end the verdict says `FAILED`, or `REDUCED` for a point that is good to 1e-5 only. So a sloppy,
broken or lying solver can cost time, never a wrong answer.

A point that is nearly optimal is polished first: the equations of the rows and boxes that look
active are solved, and the better point is kept. A small program whose optimum is too flat to
polish gets the opinion of the next solver, too.

Adding a solver: write a function, as in `stock.py`, from a `Program` to a `Claim` and put
``Solver(name, function)`` into the tuple given to `solve`. Its multipliers follow the sign above:
z > 0 prices a row at its lower end, z < 0 at its upper end. With ``balanced=False`` it is given the
program as it was built, in particular `Program.chain`, the time structure that a structured solver
exploits and the others ignore; it returns None where it does not know the structure. The answer is
judged like any other.

References
----------
Farkas certificates and weak duality: Boyd & Vandenberghe (2004), Convex Optimization, 5.5, 5.8.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from halfwidth.array import Array
from halfwidth.solvers.program import TINY, TOLERANCE, Claim, Program, Scale, Solver, Verdict
from halfwidth.solvers.stock import HIGHS, PIQP

REDUCED = 1e-5

# Below this share of its own terms the objective is compared absolutely.
_FLOOR = 1e-6
# A row's violation is judged relative to its terms plus this.
_SMALL = 1e-4
# Points that polish end below _SHARP; others are compared with the next solver's where there are few rows.
_SHARP, _SMALL_ROWS = 1e-10, 3000
# A point this close to optimal is worth polishing.
_NEAR = 1e-3
# Where a column has no box, an optimum up to this size is excluded by the reduced costs.
_FAR = 1e5
# A Farkas certificate excludes every x within this many times the program's own size.
_REACH = 1e12


@dataclass(frozen=True)
class Check:
    """How far a point is from optimal, in units of the balanced program; 0 for an exact answer.

    Parameters
    ----------
    primal : float
        Largest violation of a row, relative to 1e-4 + the size of its terms; boxes hold exactly.
    dual : float
        Largest reduced cost of forbidden sign, relative to 1 + the size of its terms.
    gap : float
        |primal - dual objective| plus the first-order effect of all violations on the objective,
        relative to the objective.
    complementarity : float
        Largest product of a multiplier and the slack of its row or box, likewise.
    """

    primal: float
    dual: float
    gap: float
    complementarity: float

    @property
    def worst(self) -> float:
        """The largest of the four."""
        return max(self.primal, self.dual, self.gap, self.complementarity)


@dataclass(frozen=True)
class Solution:
    """A checked answer, in the units of the program.

    Parameters
    ----------
    verdict : Verdict
    x, z : (n,) and (m,) arrays or None
        Point inside its box and row multipliers; of an infeasible program x is None and z the
        Farkas certificate.
    objective : float
        `inf` if infeasible, `-inf` if unbounded or unknown; never NaN.
    check : Check or None
    solver : str
        Who found it.
    iterations : int
    notes : tuple of str
        What was tried before, and how it failed.
    """

    verdict: Verdict
    x: Array | None
    z: Array | None
    objective: float
    check: Check | None
    solver: str
    iterations: int
    notes: tuple[str, ...] = ()

    @property
    def solved(self) -> bool:
        """Whether `x` is an optimal point, perhaps to reduced accuracy."""
        return self.verdict in (Verdict.OPTIMAL, Verdict.REDUCED)


class _Found(NamedTuple):
    """A judged answer in the units of the balanced program."""

    verdict: Verdict
    x: Array | None
    z: Array | None
    check: Check | None
    solver: str
    iterations: int


def solve(program: Program, solvers: Sequence[Solver] | None = None) -> Solution:
    """Solve a program and prove the answer.

    Parameters
    ----------
    program : Program
    solvers : sequence of Solver, optional
        Asked in this order until one answer passes; PIQP, then HiGHS, unless given.

    Returns
    -------
    Solution
    """
    solvers = (PIQP, HIGHS) if solvers is None else solvers
    if np.any(program.lo > program.hi) or np.any(program.row_lo > program.row_hi):
        empty = ("presolve: a box is empty",)
        return Solution(Verdict.INFEASIBLE, None, None, np.inf, None, "presolve", 0, empty)
    scaled = _Scaled(program)
    notes: list[str] = []
    found = scaled.ask(solvers, notes)
    if found.verdict is Verdict.FAILED:
        proof = _elastic_proof(scaled.program, solvers, notes)
        found = found if proof is None else proof
    x = None if found.x is None else np.clip(scaled.x * found.x, program.lo, program.hi)
    return Solution(
        found.verdict,
        x,
        None if found.z is None else scaled.z * found.z,
        _objective(program, found.verdict, x),
        found.check,
        found.solver,
        found.iterations,
        tuple(notes),
    )


def judge(program: Program, x: Array, z: Array) -> tuple[Array, Array, Check]:
    """Measure how far a point is from optimal; trusts nothing but the program.

    Parameters
    ----------
    program : Program
        Balanced, so that 1 is an ordinary size.
    x, z : (n,) and (m,) arrays

    Returns
    -------
    x, z : arrays
        Moved where they must be: x into [lo, hi], z to the sign that a free side allows.
    check : Check
    """
    x, z = np.clip(x, program.lo, program.hi), _signed(program, z)
    with np.errstate(over="ignore", invalid="ignore"):
        value = program.G @ x
        Px = np.zeros_like(x) if program.P is None else program.P @ x
        d = program.c + Px - program.G.T @ z
        terms = np.abs(program.c) + np.abs(Px) + abs(program.G).T @ np.abs(z)

        broken = np.maximum(np.maximum(program.row_lo - value, value - program.row_hi), 0.0)
        wrong = np.maximum(d, 0.0) * np.isneginf(program.lo)
        wrong += np.maximum(-d, 0.0) * np.isposinf(program.hi)

        primal = float(0.5 * x @ Px + program.c @ x)
        price = _price(z, program.row_lo, program.row_hi) + _price(d, program.lo, program.hi)
        dual = float(price - 0.5 * x @ Px)
        unit = max(TINY, program.floor, _FLOOR * float(np.abs(program.c) @ np.abs(x))) + abs(primal)
        # What violations are worth to the objective; the optimum may lie far from x along a column without a box.
        worth = float(broken @ np.abs(z)) + float(wrong @ np.abs(x)) + _FAR * _largest(wrong)
        off = abs(primal - dual) + worth
        slack = max(
            _largest_product(z, value, program.row_lo, program.row_hi),
            _largest_product(d, x, program.lo, program.hi),
        )
        check = Check(
            primal=_largest(broken / (_SMALL + abs(program.G) @ np.abs(x))),
            dual=_largest(wrong / (1.0 + terms)),
            gap=_no_nan(off / unit),
            complementarity=_no_nan(slack / unit),
        )
    return x, z, check


def _polished(program: Program, x: Array, z: Array, check: Check) -> tuple[Array, Array, Check]:
    """Solve the equations of the rows and boxes that look active; return the better of both points.

    A gap of 1e-7 leaves x off by more where the objective is flat, by its square root if it is quadratic; the
    equations give x to rounding.
    """
    import scipy.sparse as sp
    from scipy.sparse.linalg import splu

    n = program.c.size
    P = sp.csr_array((n, n)) if program.P is None else program.P
    value, d = program.G @ x, program.c + P @ x - program.G.T @ z
    low, high = (z > 0) & (value - program.row_lo < z), (z < 0) & (program.row_hi - value < -z)
    active = np.flatnonzero(low | high | (program.row_lo == program.row_hi))
    at_lo, at_hi = (d > 0) & (x - program.lo < d), (d < 0) & (program.hi - x < -d)
    fixed = at_lo | at_hi | (program.lo == program.hi)
    free = np.flatnonzero(~fixed)
    base = np.where(at_hi, program.hi, program.lo)
    x0, z0 = np.where(fixed, base, x), np.zeros_like(z)
    z0[active] = z[active]
    ends = np.where(high, program.row_hi, program.row_lo)[active]
    A = program.G[active][:, free]
    small = sp.eye(free.size) * 1e-9, sp.eye(active.size) * 1e-9
    try:
        factor = splu(sp.csc_matrix(sp.bmat([[P[free][:, free] + small[0], A.T], [A, -small[1]]])))
        for _ in range(4):
            slope = (program.c + P @ x0 - program.G.T @ z0)[free]
            step = factor.solve(np.r_[-slope, ends - program.G[active] @ x0])
            x0[free] += step[: free.size]
            z0[active] -= step[free.size :]
    except RuntimeError:  # a singular system has no better point
        return x, z, check
    if not (np.isfinite(x0).all() and np.isfinite(z0).all()):
        return x, z, check
    found = judge(program, x0, z0)
    return found if found[2].worst < check.worst else (x, z, check)


def certifies(program: Program, z: Array) -> bool:
    """Say whether z proves that no x within reach satisfies the rows and the box.

    The rows demand ``z'G x >= z+'row_lo - z-'row_hi``. The certificate holds if the largest value
    of ``z'G x`` over the box stays below that by more than the violation a point is allowed.
    """
    z = _signed(program, z)
    top = _largest(np.abs(z))
    if not 0.0 < top < np.inf:
        return False
    z = z / top
    v = program.G.T @ z
    # On a side without a box rounding leaves a small coefficient: it is charged at the reach.
    hi = np.where(np.isfinite(program.hi), program.hi, _REACH)
    lo = np.where(np.isfinite(program.lo), program.lo, -_REACH)
    supply = float(np.maximum(v, 0.0) @ hi + np.minimum(v, 0.0) @ lo)
    ends = np.where(z == 0.0, 0.0, np.where(z > 0, program.row_lo, program.row_hi))
    allowed = TOLERANCE * float(np.abs(z) @ (1.0 + np.abs(ends)))
    return bool(float(z @ ends) - supply > allowed)


def _proof(program: Program, z: Array) -> Array | None:
    """Return multipliers that certify infeasibility, z itself or z cleaned of its rounding, or None."""
    if certifies(program, z):
        return z
    top = _largest(np.abs(z))
    if not 0.0 < top < np.inf:
        return None
    exact = _cleaned(program, np.where(np.abs(z) > 1e-9 * top, z, 0.0) / top, np.zeros(program.c.size))
    return exact if exact is not None and certifies(program, exact) else None


def _cleaned(program: Program, z: Array, slope: Array) -> Array | None:
    """Return multipliers with ``G'z = slope`` to rounding in columns without a box, or None.

    An interior point leaves ``G'z`` a little off there. The correction of least relative size, found by least squares
    with the weights z^2, keeps the signs.
    """
    import scipy.sparse as sp
    from scipy.sparse.linalg import splu

    free = np.flatnonzero(np.isneginf(program.lo) | np.isposinf(program.hi))
    if free.size == 0:
        return None
    z = _signed(program, z)
    lo, hi, G = program.lo[free], program.hi[free], program.G[:, free]
    try:
        for _ in range(3):
            v = G.T @ z - slope[free]
            # A reduced cost -v that a finite end can carry is no error.
            carried = (np.isfinite(lo) & (v <= 0.0)) | (np.isfinite(hi) & (v >= 0.0))
            W = sp.diags_array(z**2)
            H = sp.csc_matrix(G.T @ W @ G)
            ridge = 1e-12 * max(float(H.diagonal().max(initial=0.0)), 1e-300)
            step = splu(sp.csc_matrix(H + ridge * sp.eye(free.size))).solve(np.where(carried, 0.0, v))
            z = _signed(program, z - W @ (G @ step))
    except RuntimeError:  # singular: nothing to gain
        return None
    return z if np.isfinite(z).all() else None


def _descends(program: Program, ray: Array) -> bool:
    """Say whether the objective falls for ever along a ray that no row or box stops."""
    ray = np.where(np.isfinite(program.lo), np.maximum(ray, 0.0), ray)
    ray = np.where(np.isfinite(program.hi), np.minimum(ray, 0.0), ray)
    size = np.abs(ray)
    if not 0.0 < _largest(size) < np.inf:
        return False
    move, rounding = program.G @ ray, 1e-11 * (abs(program.G) @ size)
    stopped = np.any((move < -rounding) & np.isfinite(program.row_lo)) or np.any(
        (move > rounding) & np.isfinite(program.row_hi)
    )
    flat = program.P is None or np.all(np.abs(program.P @ ray) <= 1e-12 * (abs(program.P) @ size))
    return bool(not stopped and flat and program.c @ ray < -TOLERANCE * (np.abs(program.c) @ size))


def _elastic_proof(program: Program, solvers: Sequence[Solver], notes: list[str]) -> _Found | None:
    """Return a Farkas certificate from the least total violation of the rows, or None."""
    import scipy.sparse as sp

    m, n = program.G.shape
    up = np.flatnonzero(np.isfinite(program.row_lo))
    down = np.flatnonzero(np.isfinite(program.row_hi))
    k = up.size + down.size
    if k == 0:
        return None
    sign, row = np.r_[np.ones(up.size), -np.ones(down.size)], np.r_[up, down]
    lift = sp.csr_array((sign, (row, np.arange(k))), shape=(m, k))
    elastic = _Scaled(
        Program(
            c=np.r_[np.zeros(n), np.ones(k)],
            G=sp.csr_array(sp.hstack([program.G, lift])),
            row_lo=program.row_lo,
            row_hi=program.row_hi,
            lo=np.r_[program.lo, np.zeros(k)],
            hi=np.r_[program.hi, np.full(k, np.inf)],
        )
    )
    found = elastic.ask([s for s in solvers if s.balanced], notes)
    z = None if found.z is None else _proof(program, elastic.z * found.z)
    if z is None:
        return None
    return _Found(Verdict.INFEASIBLE, None, z, None, f"{found.solver}, elastic", found.iterations)


class _Scaled:
    """A program beside its balanced twin, whose answers it can be asked for.

    ``x`` and ``z`` are the factors from the balanced units back to the program's.
    """

    def __init__(self, original: Program) -> None:
        import scipy.sparse as sp

        assert original.scale is not None
        row, col = original.scale
        G = sp.csr_array(original.G, copy=True)
        G.data *= np.repeat(row, np.diff(G.indptr)) * col[G.indices]
        row_lo, row_hi = original.row_lo * row, original.row_hi * row
        lo, hi = original.lo / col, original.hi / col
        # The typical end sets the size: row ends first, boxes where every row end is 0 or free.
        size = 1.0
        for ends in (np.r_[row_lo, row_hi], np.r_[lo, hi]):
            there = np.abs(ends[np.isfinite(ends) & (ends != 0.0)])
            if there.size:
                size = float(np.exp2(np.round(np.log2(np.median(there)))))
                break
        c, P = original.c * col, None
        if original.P is not None:
            D = sp.diags_array(col)
            P = sp.csr_array(D @ original.P @ D) * size
        top = max(_largest(np.abs(c)), 0.0 if P is None else _largest(np.abs(P.data)))
        cost = float(np.exp2(np.round(np.log2(top)))) if 0.0 < top < np.inf else 1.0
        self.original = original
        self.program = Program(
            c / cost,
            G,
            row_lo / size,
            row_hi / size,
            lo / size,
            hi / size,
            None if P is None else P / cost,
            max(TINY, original.floor / (size * cost)),
            original.chain,
            Scale(np.ones(row.size), np.ones(col.size)),
        )
        self.x, self.z = size * col, cost * row

    def ask(self, solvers: Sequence[Solver], notes: list[str]) -> _Found:
        """Ask the solvers in turn; return the first proved answer, else the best point seen."""
        best = _Found(Verdict.FAILED, None, None, None, "none", 0)
        for solver in solvers:
            try:
                claim = solver.run(self.program if solver.balanced else self.original)
            except Exception as error:  # a library that breaks is one more that gave no answer
                notes.append(f"{solver.name}: raised {type(error).__name__}: {error}")
                continue
            if claim is None:
                continue
            back_x, back_z = (1.0, 1.0) if solver.balanced else (self.x, self.z)
            x = _vector(claim.x, self.program.c.size, back_x)
            z = _vector(claim.z, self.program.row_lo.size, back_z)
            ray = _vector(claim.ray, self.program.c.size, back_x)
            found = self._believe(claim, x, z, ray, solver, solvers, notes)
            if found.check is None and found.verdict is not Verdict.FAILED:
                return found
            if found.check is not None and found.check.worst <= TOLERANCE and not self.blunt(found.check):
                return found
            if best.check is None or (found.check is not None and found.check.worst < best.check.worst):
                best = found
        return best

    def blunt(self, check: Check) -> bool:
        """Say whether a small linear program deserves a second opinion: a flat optimum that did not polish."""
        small = self.program.row_lo.size <= _SMALL_ROWS and self.program.P is None
        return small and check.worst > _SHARP

    def _believe(
        self,
        claim: Claim,
        x: Array | None,
        z: Array | None,
        ray: Array | None,
        solver: Solver,
        solvers: Sequence[Solver],
        notes: list[str],
    ) -> _Found:
        """Return what a claim proves, whatever it says."""
        program, count = self.program, int(claim.iterations)
        found = _Found(Verdict.FAILED, None, None, None, solver.name, count)
        if x is not None and z is not None:
            x, z, check = judge(program, x, z)
            if check.worst < _NEAR:
                x, z, check = _polished(program, x, z, check)
                slope = program.c if program.P is None else program.c + program.P @ x
                exact = _cleaned(program, z, slope) if check.worst > _SHARP else None
                if exact is not None:
                    x, z, check = min((x, z, check), judge(program, x, exact), key=lambda point: point[2].worst)
            if check.worst <= TOLERANCE:
                return _Found(Verdict.OPTIMAL, x, z, check, solver.name, count)
            verdict = Verdict.REDUCED if check.worst <= REDUCED else Verdict.FAILED
            found = _Found(verdict, x, z, check, solver.name, count)
            seen = f"its point is off by {check.worst:.1e}"
        else:
            seen = "it gave no usable point"
        if z is not None and claim.verdict is not Verdict.OPTIMAL:
            proof = _proof(program, z)
            if proof is not None:
                return _Found(Verdict.INFEASIBLE, None, proof, None, solver.name, count)
        if ray is not None and _descends(program, ray):
            free = _Scaled(replace(program, c=np.zeros_like(program.c), P=None))
            if free.ask(solvers, []).verdict is Verdict.OPTIMAL:
                return _Found(Verdict.UNBOUNDED, None, None, None, solver.name, count)
        notes.append(f"{solver.name}: said {claim.verdict.name}, {seen}")
        return found


# --- small pieces ---------------------------------------------------------------------------------


def _objective(program: Program, verdict: Verdict, x: Array | None) -> float:
    if verdict is Verdict.INFEASIBLE:
        return float("inf")
    return float("-inf") if x is None else program.objective(x)


def _vector(value: Array | None, n: int, unit: Array | float) -> Array | None:
    """Return a finite float vector of size n in the given units, or None for anything else."""
    if value is None:
        return None
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return array / unit if array.shape == (n,) and np.isfinite(array).all() else None


def _signed(program: Program, z: Array) -> Array:
    """Drop the part of the multipliers that prices a free side of its row."""
    z = np.where(np.isfinite(program.row_lo), z, np.minimum(z, 0.0))
    return np.where(np.isfinite(program.row_hi), z, np.maximum(z, 0.0))


def _price(z: Array, lo: Array, hi: Array) -> float:
    """Return ``z+'lo - z-'hi`` over the finite ends."""
    ends = np.where(z > 0, lo, hi)
    return float(z @ np.where(np.isfinite(ends), ends, 0.0))


def _largest_product(z: Array, value: Array, lo: Array, hi: Array) -> float:
    """Return the largest |z| times the distance to the end that it prices, over finite ends."""
    ends = np.where(z > 0, lo, hi)
    return _largest(np.abs(z) * np.abs(value - np.where(np.isfinite(ends), ends, value)))


def _largest(values: Array) -> float:
    """Return the largest entry, 0 of nothing, and infinity where one is NaN."""
    return _no_nan(float(np.max(values, initial=0.0)))


def _no_nan(value: float) -> float:
    return value if value == value else float("inf")
