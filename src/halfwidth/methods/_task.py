"""The program of `BatchLP` in units of each group's scale: rows, boxes, floors and caps, and the way back."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.methods._residuals import (
    Reference,
    Residuals,
    half_width_bounds,
    unseen_directions,
)
from halfwidth.model import Linear
from halfwidth.record import Record
from halfwidth.result import Status
from halfwidth.solvers.banded import Answer, Shifted
from halfwidth.solvers.banded import solve as structured
from halfwidth.solvers.chain import Chain, chain_of
from halfwidth.solvers.lp import Solution
from halfwidth.solvers.program import Program
from halfwidth.spread import Box

#: Residuals, half-widths and excesses below this share of sigma count as 0.
_ZERO = 1e-5
#: Residuals of the reference below this share of sigma are rounding: where it fits exactly they would otherwise set the
#: size of the whole program.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Task:
    """The program in scaled form: ``X = X_ref + column xi``, ``s = sigma s^``, rows ``|M xi + rho| <= S s^``.

    Parameters
    ----------
    M : (K, n) CSR array
        Rows divided by their sigma, columns multiplied by theirs.
    rho : (K,) array
        Scaled residuals of the reference trajectory.
    S : (K, p) CSR array
    lo, hi : (n,) arrays
        Box of xi.
    lowest, highest : (p,) arrays
        Floors and caps in units of sigma.
    free : (p,) bool array
        Half-widths to be found.
    x_lo, x_hi : (n,) arrays
        Box of X in its own units.
    chain : Chain or None
        The same in the user's units, for the structured solver.
    floor, cap : (p,) arrays
        Ends of the half-widths in their own units.
    """

    rows: Residuals
    base: Reference
    M: Any
    rho: Array
    S: Any
    lo: Array
    hi: Array
    lowest: Array
    highest: Array
    free: NDArray[np.bool_]
    x_lo: Array
    x_hi: Array
    floor: Array
    cap: Array
    chain: Chain | None

    @classmethod
    def build(cls, rows: Residuals, base: Reference, model: Linear, record: Record) -> "Task":
        """Scale the rows, boxes, floors and caps."""
        import scipy.sparse as sp

        assert isinstance(model.x0, Box)
        scale = rows.S @ base.sigma
        back = sp.diags_array(1.0 / scale)
        rho = rows.at(base.X) / scale
        box = model.bounds or Box(np.full(rows.nx, -np.inf), np.full(rows.nx, np.inf))
        x_lo = np.r_[model.x0.lo, np.tile(box.lo, rows.T)]
        x_hi = np.r_[model.x0.hi, np.tile(box.hi, rows.T)]
        lo, hi = (x_lo - base.X) / base.column, (x_hi - base.X) / base.column
        # A box without room is a fixed value: an interior point needs an interior.
        narrow = np.flatnonzero(np.isfinite(lo) & np.isfinite(hi) & (hi - lo < 1e-9))
        lo[narrow] = hi[narrow] = 0.5 * (lo[narrow] + hi[narrow])
        floor, cap = half_width_bounds(model)
        free = (floor < cap) & (rows.count > 0)
        return cls(
            rows,
            base,
            sp.csr_array(back @ rows.M @ sp.diags_array(base.column)),
            np.where(np.abs(rho) > _ROUNDING, rho, 0.0),
            sp.csr_array(back @ rows.S @ sp.diags_array(base.sigma)),
            lo,
            hi,
            floor / base.sigma,
            cap / base.sigma,
            free,
            x_lo,
            x_hi,
            floor,
            cap,
            chain_of(model, record, np.ones_like(floor), floor, cap),
        )

    def weights(self, objective: str) -> Array:
        """Return the cost of each scaled half-width, (p,); 0 where it is known or has no row."""
        if objective == "paper":
            top = float(np.max(self.base.sigma[self.free], initial=0.0)) or 1.0
            return np.where(self.free, self.base.sigma / top, 0.0)
        count = self.rows.count
        mean = float(count[count > 0].mean()) if np.any(count > 0) else 1.0
        return np.where(self.free, count / mean, 0.0)

    def grown(self, factor: float) -> "Task":
        """Return the task with the caps of unknown half-widths multiplied."""
        more = np.where(self.free, factor, 1.0)
        return replace(self, highest=more * self.highest, cap=more * self.cap)

    def program(self, weight: Array) -> Program:
        """Return the linear program over (xi, s^)."""
        import scipy.sparse as sp

        n, p = self.M.shape[1], self.S.shape[1]
        top = np.where(self.free, self.highest, self.lowest)
        open_ = (self.S @ self.free.astype(float)) > 0
        one, two = np.flatnonzero(open_), np.flatnonzero(~open_)
        M, S, rho = self.M[one], self.S[one], self.rho[one]
        known = self.S[two] @ self.lowest
        none = np.full(one.size, np.inf)
        return Program(
            chain=self.shifted(weight),
            c=np.r_[np.zeros(n), weight],
            G=sp.csr_array(
                sp.vstack(
                    [
                        sp.hstack([M, S]),
                        sp.hstack([M, -S]),
                        sp.hstack([self.M[two], sp.csr_array((two.size, p))]),
                    ]
                )
            ),
            row_lo=np.r_[-rho, -none, -known - self.rho[two]],
            row_hi=np.r_[none, -rho, known - self.rho[two]],
            lo=np.r_[self.lo, self.lowest],
            hi=np.r_[self.hi, top],
            floor=1e-3,
        )

    def shifted(self, weight: Array) -> Shifted | None:
        """Return the program as a chain in time and where its variables stand to ours; None if it is no chain."""
        if self.chain is None:
            return None
        sigma = self.base.sigma
        top = np.where(self.free, self.highest, self.lowest)
        chain = replace(self.chain, c=weight / sigma, floor=self.lowest * sigma, cap=top * sigma)
        known = ~self.free[self.rows.group]
        return Shifted(chain, self.base.X, self.base.column, sigma, known)

    def central(self, weight: Array) -> Answer | None:
        """Return the central point of the program, or None where the structured solver has none."""
        shifted = self.shifted(weight)
        if shifted is None or not self.free.any():
            return None
        answer = structured(shifted.chain, point="central", fallback=False)
        return answer if answer.status is Status.OK else None

    def squares(self, v: Array, relax: float) -> Program:
        """Return the quadratic program of least squares inside the optimal half-widths, a little widened."""
        import scipy.sparse as sp

        n = self.M.shape[1]
        s = v[n:]
        wide = np.minimum(s + relax * np.maximum(s, 1.0), np.maximum(self.highest, s))
        limit = self.S @ np.where(self.free, wide, self.lowest)
        # Groups without noise stay where they are: a sliver of room would only make the program ill-conditioned.
        none = np.asarray(self.S @ (self.free & (s > relax) | (~self.free & (self.lowest > 0))).astype(float)) == 0
        still = np.asarray(self.M @ v[:n])
        return Program(
            c=np.asarray(self.M.T @ self.rho),
            G=self.M,
            row_lo=np.where(none, still, -limit - self.rho),
            row_hi=np.where(none, still, limit - self.rho),
            lo=self.lo,
            hi=self.hi,
            P=sp.csr_array(self.M.T @ self.M),
            floor=1e-3,
        )

    def clipped(self, X: Array) -> Array:
        """Return the trajectory moved into its boxes."""
        return np.clip(X, self.x_lo, self.x_hi)

    def point(self, v: Array) -> Array:
        """Return the trajectory X of a program's solution, in its own units."""
        n = self.M.shape[1]
        return self.clipped(self.base.X + self.base.column * v[:n])

    def half_widths(self, v: Array) -> Array:
        """Return the half-widths of a program's solution, in their own units."""
        return self.base.sigma * np.clip(v[self.M.shape[1] :], self.lowest, self.highest)

    def enough(self, X: Array, s: Array) -> Array:
        """Return half-widths that hold the residuals of X: the largest of each group, between floor and cap."""
        rho = np.abs(self.rows.at(X))
        if self.S.nnz == self.rho.size:
            tight = self.rows.largest(rho)
        else:
            tight = s + self.rows.largest(np.maximum(rho - self.rows.S @ s, 0.0))
        return np.where(self.free, np.clip(tight, self.floor, self.cap), self.floor)

    def report(
        self, X: Array, s: Array, model: Linear, record: Record, value: float, found: Solution | None
    ) -> dict[str, Any]:
        """Return what goes into `info` of a solved record."""
        rows, base = self.rows, self.base
        nx, T = rows.nx, rows.T
        rho = rows.at(X)
        # A row that stands for several entries of e, because of an unseen correlated output, tells none of them.
        e = np.full((T, rows.ny), np.nan)
        k = T * nx + np.flatnonzero(np.diff(rows.S.indptr)[T * nx :] == 1)
        e[rows.row[k], rows.group[k] - nx] = -rho[k]
        names = [f"q[{n}]" for n in model.names.x] + [f"r[{n}]" for n in model.names.y]
        blind = unseen_directions(rows, model, record)
        lost = self.free & base.traceless
        unseen = (self.floor < self.cap) & (rows.count == 0)
        zero = self.free & ~lost & (s <= _ZERO * base.sigma) & (self.lowest == 0)
        low = self.free & ~lost & (self.floor > 0) & (s <= self.floor * (1 + 1e-6))
        high = self.free & (s >= self.cap * (1 - 1e-6))
        notes = []
        for mask, what in (
            (lost | unseen, "bound not identifiable"),
            (zero, "half-width 0, which is a degenerate optimum and no bound of the noise"),
            (low, "half-width on its floor"),
            (high & ~lost, "half-width on its cap"),
        ):
            if mask.any():
                notes.append(f"{what}: {', '.join(n for n, m in zip(names, mask, strict=True) if m)}")
        if len(blind):
            involved = np.abs(blind).max(axis=0) > 1e-6
            notes.append("not observable: " + ", ".join(n for n, m in zip(model.names.x, involved, strict=True) if m))
        solved: dict[str, Any] = {}
        if found is not None and found.check is not None:
            check = {name: getattr(found.check, name) for name in ("primal", "dual", "gap", "complementarity")}
            solved = {"check": check, "solver": found.solver, "iterations": found.iterations}
        return solved | {
            "objective": value,
            "w": rho[: T * nx].reshape(T, nx),
            "e": e,
            "sigma": base.sigma.copy(),
            "rows": rows.count,
            "redundancy": base.redundancy.copy(),
            "notes": notes,
            "unobservable": blind,
        }
