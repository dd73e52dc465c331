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
from halfwidth.solvers.proof import Check, cleaned, descends, judge, largest, polished, proof
from halfwidth.solvers.stock import HIGHS, PIQP

REDUCED = 1e-5

# Points that polish end below _SHARP; others are compared with the next solver's where there are few rows.
_SHARP, _SMALL_ROWS = 1e-10, 3000
# A point this close to optimal is worth polishing.
_NEAR = 1e-3


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
        farkas = _elastic_proof(scaled.program, solvers, notes)
        found = found if farkas is None else farkas
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
    z = None if found.z is None else proof(program, elastic.z * found.z)
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
        top = max(largest(np.abs(c)), 0.0 if P is None else largest(np.abs(P.data)))
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
                x, z, check = polished(program, x, z, check)
                slope = program.c if program.P is None else program.c + program.P @ x
                exact = cleaned(program, z, slope) if check.worst > _SHARP else None
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
            farkas = proof(program, z)
            if farkas is not None:
                return _Found(Verdict.INFEASIBLE, None, farkas, None, solver.name, count)
        if ray is not None and descends(program, ray):
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
