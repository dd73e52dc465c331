"""Linear and convex quadratic programs, what a solver claims of them, and what a solver is.

A program finds the powers of two that balance its rows and columns when it is made.

References
----------
Balancing: Ruiz (2001), A scaling algorithm to equilibrate both rows and columns norms in matrices.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from halfwidth.array import Array
from halfwidth.errors import BadShape, BadValue

#: How far from optimal, in units of the balanced program, an answer may be.
TOLERANCE = 1e-7
#: Below this share of the balanced cost scale the objective is compared absolutely.
TINY = 1e-9


class Verdict(Enum):
    """What has been proved of a program."""

    OPTIMAL = "optimal"
    REDUCED = "optimal, but only to reduced accuracy"
    INFEASIBLE = "infeasible"
    UNBOUNDED = "unbounded"
    FAILED = "no solver gave an answer that passed the check"


class Scale(NamedTuple):
    """Powers of two that balance a program: ``x = size col x^``, ``z = cost row z^``."""

    row: Array
    col: Array


@dataclass(frozen=True, eq=False)
class Program:
    """``min x'P x / 2 + c'x`` with ``row_lo <= G x <= row_hi`` and ``lo <= x <= hi``.

    Parameters
    ----------
    c : (n,) array
    G : (m, n) scipy.sparse CSR array
    row_lo, row_hi : (m,) arrays
        Infinite where a side is free; equal where the row is an equation.
    lo, hi : (n,) arrays
    P : (n, n) scipy.sparse array, optional
        Symmetric positive semidefinite.
    floor : float
        Size of the objective below which it counts as 0; its gap is judged relative to itself plus
        this.
    chain : object, optional
        The time structure behind the rows, for solvers that exploit it.
    scale : Scale, optional
        Found on construction; `dataclasses.replace` keeps it, so costs and bounds change at no
        cost.

    Raises
    ------
    BadShape, BadValue
        If sizes differ, a number is NaN, or a cost or coefficient is infinite.
    """

    c: Array
    G: Any
    row_lo: Array
    row_hi: Array
    lo: Array
    hi: Array
    P: Any = None
    floor: float = 0.0
    chain: object = None
    scale: Scale | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        m, n = self.G.shape
        for name, size in (("c", n), ("row_lo", m), ("row_hi", m), ("lo", n), ("hi", n)):
            value = getattr(self, name)
            if value.shape != (size,):
                raise BadShape(f"`{name}` has shape {value.shape}, ({size},) was expected from `G`")
            if np.isnan(value).any():
                raise BadValue(f"`{name}` holds NaN at entry {int(np.argmax(np.isnan(value)))}")
        if not (np.isfinite(self.c).all() and np.isfinite(self.G.data).all()):
            raise BadValue("`c` or `G` holds a number that is not finite")
        if self.P is not None and self.P.shape != (n, n):
            raise BadShape(f"`P` has shape {self.P.shape}, ({n}, {n}) was expected from `G`")
        if self.scale is None:
            object.__setattr__(self, "scale", _balance(self.G))

    def objective(self, x: Array) -> float:
        """Return ``x'P x / 2 + c'x``."""
        quadratic = 0.0 if self.P is None else 0.5 * float(x @ (self.P @ x))
        return float(self.c @ x) + quadratic


@dataclass(frozen=True)
class Claim:
    """What a solver says, unchecked.

    Parameters
    ----------
    verdict : Verdict
    x : (n,) array or None
    z : (m,) array or None
        Row multipliers, ``c + P x = G'z + d``; of an infeasible program the multipliers of a proof,
        if known.
    ray : (n,) array or None
        Direction of descent of an unbounded program.
    iterations : int
    """

    verdict: Verdict
    x: Array | None = None
    z: Array | None = None
    ray: Array | None = None
    iterations: int = 0


class Solver(NamedTuple):
    """A library behind its adapter."""

    name: str
    run: Callable[[Program], Claim | None]
    balanced: bool = True


def _balance(G: Any, rounds: int = 8) -> Scale:
    """Return powers of two that bring the largest entry of every row and column near 1."""
    import scipy.sparse as sp

    m, n = G.shape
    if G.nnz == 0:
        return Scale(np.ones(m), np.ones(n))
    csr = sp.csr_array(G, copy=True)
    csr.eliminate_zeros()
    size = np.log2(np.abs(csr.data))
    i, j = np.repeat(np.arange(m), np.diff(csr.indptr)), csr.indices
    by_column = np.argsort(j, kind="stable")
    rows, row_at = np.unique(i, return_index=True)
    cols, col_at = np.unique(j[by_column], return_index=True)
    r, c = np.zeros(m), np.zeros(n)
    for _ in range(rounds):
        now = size + r[i] + c[j]
        r[rows] -= 0.5 * np.maximum.reduceat(now, row_at)
        c[cols] -= 0.5 * np.maximum.reduceat(now[by_column], col_at)
    return Scale(np.exp2(np.clip(np.round(r), -500, 500)), np.exp2(np.clip(np.round(c), -500, 500)))
