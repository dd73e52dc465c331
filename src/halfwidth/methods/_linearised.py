"""The rows of a model over a record, linearised about a trajectory and unknown entries: what `sequential.py` solves.

A linear model bends where its unknown entries multiply states, a nonlinear one everywhere; both give residuals, a chain
of linear rows about a point, and a start. Besides: what a model expects of its next row, and how far off it may be.
"""

import dataclasses
from dataclasses import replace
from typing import Any

import numpy as np

from halfwidth.array import Array, wrapped
from halfwidth.call import arity
from halfwidth.methods._residuals import half_width_bounds, reference, residuals
from halfwidth.model import Entry, Linear, Model, Nonlinear
from halfwidth.noise import Gaussian
from halfwidth.record import Record
from halfwidth.solvers.banded import solve
from halfwidth.solvers.chain import Chain, chain_of
from halfwidth.spread import Box, Normal
from halfwidth.tape import Tape, Untraceable
from halfwidth.trace import compiled

#: Rounds in which the scale of each group is found for a nonlinear model.
_SCALINGS = 3
#: Gauss-Newton steps to a state that gives the first outputs.
_FITTING = 6
#: A scale stays above this share of the cap (or of the first residuals): a smooth fit must not make one vanish.
_LEAST = 0.03


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

    def chain(self, x: Array, theta: Array, c: Array) -> Chain:  # noqa: ARG002
        """Return the linear program about x."""
        g, g_x, h, h_x = self._along(x)
        box, x0 = self.model.bounds, self.model.x0
        lo, hi = x0.interval(0.9999) if isinstance(x0, Normal) else (x0.lo, x0.hi)
        # Residuals as they are at x, wrapped where they are angles, then moved along the tangent.
        w = wrapped(x[1:] - g, self.model.x_angles)
        e = wrapped(h - self.y, self.model.y_angles)
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
        rho[:, : self.nx] = wrapped(rho[:, : self.nx], self.model.x_angles)
        rho[:, self.nx :] = wrapped(rho[:, self.nx :], self.model.y_angles)
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
            miss = wrapped((y - h)[None], self.model.y_angles)[0]
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
