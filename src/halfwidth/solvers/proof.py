"""What is believed of a solver's answer: how far a point is from optimal, and what proves that there is none.

Everything here is our own arithmetic on the program as it stands; `halfwidth.solvers.lp` says what an answer has to be.

References
----------
Farkas certificates and weak duality: Boyd & Vandenberghe (2004), Convex Optimization, 5.5, 5.8.
"""

from dataclasses import dataclass

import numpy as np

from halfwidth.array import Array
from halfwidth.solvers.program import TINY, TOLERANCE, Program

# Below this share of its own terms the objective is compared absolutely.
_FLOOR = 1e-6
# A row's violation is judged relative to its terms plus this.
_SMALL = 1e-4
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
        worth = float(broken @ np.abs(z)) + float(wrong @ np.abs(x)) + _FAR * largest(wrong)
        off = abs(primal - dual) + worth
        slack = max(
            _largest_product(z, value, program.row_lo, program.row_hi),
            _largest_product(d, x, program.lo, program.hi),
        )
        check = Check(
            primal=largest(broken / (_SMALL + abs(program.G) @ np.abs(x))),
            dual=largest(wrong / (1.0 + terms)),
            gap=_no_nan(off / unit),
            complementarity=_no_nan(slack / unit),
        )
    return x, z, check


def polished(program: Program, x: Array, z: Array, check: Check) -> tuple[Array, Array, Check]:
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
    top = largest(np.abs(z))
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


def proof(program: Program, z: Array) -> Array | None:
    """Return multipliers that certify infeasibility, z itself or z cleaned of its rounding, or None."""
    if certifies(program, z):
        return z
    top = largest(np.abs(z))
    if not 0.0 < top < np.inf:
        return None
    exact = cleaned(program, np.where(np.abs(z) > 1e-9 * top, z, 0.0) / top, np.zeros(program.c.size))
    return exact if exact is not None and certifies(program, exact) else None


def cleaned(program: Program, z: Array, slope: Array) -> Array | None:
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


def descends(program: Program, ray: Array) -> bool:
    """Say whether the objective falls for ever along a ray that no row or box stops."""
    ray = np.where(np.isfinite(program.lo), np.maximum(ray, 0.0), ray)
    ray = np.where(np.isfinite(program.hi), np.minimum(ray, 0.0), ray)
    size = np.abs(ray)
    if not 0.0 < largest(size) < np.inf:
        return False
    move, rounding = program.G @ ray, 1e-11 * (abs(program.G) @ size)
    stopped = np.any((move < -rounding) & np.isfinite(program.row_lo)) or np.any(
        (move > rounding) & np.isfinite(program.row_hi)
    )
    flat = program.P is None or np.all(np.abs(program.P @ ray) <= 1e-12 * (abs(program.P) @ size))
    return bool(not stopped and flat and program.c @ ray < -TOLERANCE * (np.abs(program.c) @ size))


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
    return largest(np.abs(z) * np.abs(value - np.where(np.isfinite(ends), ends, value)))


def largest(values: Array) -> float:
    """Return the largest entry, 0 of nothing, and infinity where one is NaN."""
    return _no_nan(float(np.max(values, initial=0.0)))


def _no_nan(value: float) -> float:
    return value if value == value else float("inf")
