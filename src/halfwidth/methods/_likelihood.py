"""The likelihood of records as a function of a linear model, and two ways up: what `hw.learn` runs.

One pass of the smoother gives the expected sums of ``w w'``, ``e e'`` and their companions given all seen outputs,
exact with any entry missing (core/kalman.hpp). Expectation maximisation (Shumway and Stoffer 1982, J. Time Series Anal.
3(4)) turns the sums into the next model; maximum likelihood hands the gradient that they give by Fisher's identity,
``d loglik / dQ = 1/2 Q^-1 (sum E w w' - n Q) Q^-1``, to a quasi-Newton search. Both climb the same likelihood.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.errors import Unsolved
from halfwidth.methods.kalman import matrices
from halfwidth.model import Linear
from halfwidth.noise import Gaussian
from halfwidth.record import Record
from halfwidth.result import Status
from halfwidth.spread import Normal
from halfwidth.varying import Varying


@dataclass(frozen=True, eq=False)
class Learned:
    """A model with what was learned in it.

    Parameters
    ----------
    model : Linear
    loglik : float
        Log-likelihood of the seen outputs under `model`.
    history : tuple of float
        Log-likelihood before each iteration.
    status : Status
        ``OK`` if converged, ``STALLED`` if the iterations ran out.
    info : mapping
        ``message``, ``iterations``, ``n_seen``.
    """

    model: Linear
    loglik: float
    history: tuple[float, ...]
    status: Status
    info: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def check(self) -> "Learned":
        """Return the value itself.

        Raises
        ------
        Unsolved
            If the status is not good.
        """
        if not self.status.good:
            raise Unsolved(f"Status.{self.status.name}: {self.info['message']}", hint="give more `iterations`")
        return self

    def __repr__(self) -> str:
        return f"Learned(loglik={self.loglik:.6g}, {len(self.history)} iterations, status={self.status.name})"


class Problem:
    """The records beside the current model; E-steps and the two searches."""

    def __init__(
        self,
        asked: Linear,
        model: Linear,
        records: list[Record],
        what: Sequence[str],
        free: dict[str, Any],
        kinds: dict[str, str],
    ) -> None:
        self.model, self.what, self.free, self.kinds = model, what, free, kinds
        self.entries, self.bounds = asked.theta_entries, asked.theta_bounds
        self.lengths = [len(r) for r in records]
        self.t = np.concatenate([r.t for r in records])
        self.dt = np.concatenate([r.steps(model.dt) for r in records])
        self.y = np.concatenate([r.y for r in records])
        self.seen = np.concatenate([r.seen for r in records])
        self.u = np.concatenate([r.u for r in records if r.u is not None]) if model.nu else None
        self.offsets = np.concatenate(([0], np.cumsum(self.lengths)))
        self.E = np.eye(model.nx) if model.E is None or not model.E.constant else model.E.single
        self.F = np.eye(model.ny) if model.F is None or not model.F.constant else model.F.single

    def expect(self, model: Linear) -> dict[str, Any]:
        """One smoothing pass: the log-likelihood and the expected sums, E and F taken out again."""
        m = matrices(model, self.t, self.dt, self.lengths)
        x0 = model.x0
        assert isinstance(x0, Normal)
        more = {} if self.u is None else {"u": self.u}
        out: dict[str, Any] = _core.kalman_run(
            "smooth",
            m.A,
            m.B if model.nu else None,
            m.C,
            m.Q,
            m.R,
            self.y,
            self.seen,
            np.ascontiguousarray(x0.mean),
            np.ascontiguousarray(x0.P),
            offsets=self.offsets,
            initial=True,
            sums=True,
            **more,
            **m.which,
        )
        E, F = self.E, self.F
        out["loglik"] = float(out["loglik"].sum())
        for name in ("W", "Wx", "Wu"):
            out[name] = E @ out[name]
        out["W"] = out["W"] @ E.T
        for name in ("V", "Vx"):
            out[name] = F @ out[name]
        out["V"] = out["V"] @ F.T
        out["ok"] = max(out["code"]) < 3
        return out

    # -- expectation maximisation --------------------------------------------------------------------------------------

    def em(self, iterations: int, tolerance: float, model: Linear | None = None) -> Learned:
        """Alternate smoothing passes and closed-form updates."""
        model = self.model if model is None else model
        history: list[float] = []
        status, message = Status.STALLED, f"the likelihood still rose after {iterations} iterations"
        best = model
        trail = [model]
        found = self.expect(model)
        while len(history) < iterations:
            if not found["ok"]:
                status, message = Status.COLLAPSED, "the smoother left the range of floating point"
                break
            gain = found["loglik"] - history[-1] if history else np.inf
            history.append(found["loglik"])
            best = model
            if abs(gain) <= tolerance * max(1.0, abs(found["loglik"])):
                status, message = Status.OK, f"converged after {len(history)} iterations"
                break
            model = self.maximise(model, found)
            found = self.expect(model)
            trail.append(model)
            if len(trail) == 3:
                trial = self.extrapolate(trail)
                there = None if trial is None else self.expect(trial)
                if trial is not None and there is not None and there["ok"] and there["loglik"] > found["loglik"]:
                    model, found = trial, there
                trail = [model]
        if found["ok"] and (not history or found["loglik"] >= history[-1]):
            best = model
        loglik = max(found["loglik"], history[-1]) if found["ok"] else history[-1] if history else float("-inf")
        info = {"message": message, "iterations": len(history), "n_seen": int(self.seen.sum())}
        return Learned(best, loglik, tuple(history), status, info)

    def extrapolate(self, trail: list[Linear]) -> Linear | None:
        """Return a long step along three models in a row, None where there is none.

        The squared extrapolation of Varadhan and Roland (2008, Scand. J. Stat. 35(2)), on Cholesky factors and
        logarithms so that covariances stay positive; the caller keeps it only if the likelihood rises.
        """
        parts = [name for name in ("Q", "R") if name in self.what]
        if set(self.what) - set(parts):
            return None
        try:
            maps = [_Map(self.kinds[name], _covariance(trail[0], name)) for name in parts]
            p = [
                np.concatenate([m.numbers(_covariance(at, n), self) for m, n in zip(maps, parts, strict=True)])
                for at in trail
            ]
        except np.linalg.LinAlgError:
            return None
        r, v = p[1] - p[0], p[2] - 2 * p[1] + p[0]
        length = float(np.linalg.norm(v))
        if length == 0.0:
            return None
        a = max(1.0, float(np.linalg.norm(r)) / length)
        far = p[0] + 2 * a * r + a**2 * v
        if not np.isfinite(far).all() or a == 1.0:
            return None
        new: dict[str, Any] = {}
        k = 0
        for m, name in zip(maps, parts, strict=True):
            new["w" if name == "Q" else "e"] = Gaussian(m.matrix(far[k : k + m.size]))
            k += m.size
        return dataclasses.replace(trail[2], **new)

    def maximise(self, model: Linear, s: dict[str, Any]) -> Linear:
        """Return the next model from the expected sums."""
        new: dict[str, Any] = {}
        W, V = s["W"], s["V"]
        Q, R = model.w.cov(), model.e.cov()
        if "A" in self.free or "B" in self.free:
            Wz = np.hstack((s["Wx"], s["Wu"]))
            Z = np.block([[s["Xx"], s["Xu"]], [s["Xu"].T, s["Uu"]]])
            nx, nu = model.nx, model.nu
            mask = np.zeros((nx, nx + nu), dtype=bool)
            mask[:, :nx] = self.free.get("A", False)
            if nu:
                mask[:, nx:] = self.free.get("B", False)
            lo, hi = self.room("A", model.A.single), self.room("B", None if model.B is None else model.B.single)
            step = _regression(Wz, Z, Q.single, mask, *(np.hstack(side) for side in zip(lo, hi, strict=True)))
            W = W - step @ Wz.T - Wz @ step.T + step @ Z @ step.T
            if "A" in self.free:
                new["A"] = model.A.single + step[:, :nx]
            if "B" in self.free and model.B is not None:
                new["B"] = model.B.single + step[:, nx:]
        if "C" in self.free:
            step = _regression(s["Vx"], s["Xy"], R.single, self.free["C"], *self.room("C", model.C.single))
            V = V - step @ s["Vx"].T - s["Vx"] @ step.T + step @ s["Xy"] @ step.T
            new["C"] = model.C.single + step
        if "Q" in self.what:
            new["w"] = Gaussian(self.covariance("Q", Q, W, s["nW"]))
        if "R" in self.what:
            new["e"] = Gaussian(self.covariance("R", R, V, s["nV"]))
        if "x0" in self.what:
            assert isinstance(model.x0, Normal)
            new["x0"] = Normal(s["x0"].mean(axis=0), model.x0.P)
        return dataclasses.replace(model, **new)

    def room(self, name: str, now: Array | None) -> tuple[Array, Array]:
        """Return how far the entries of a matrix may move down and up within ``theta_bounds``."""
        if now is None:
            return np.zeros((self.model.nx, 0)), np.zeros((self.model.nx, 0))
        lo, hi = np.full(now.shape, -np.inf), np.full(now.shape, np.inf)
        for k, entry in enumerate(self.entries):
            if entry.matrix == name and self.bounds is not None:
                lo[entry.row, entry.column] = self.bounds.lo[k]
                hi[entry.row, entry.column] = self.bounds.hi[k]
        return lo - now, hi - now

    def covariance(self, name: str, now: Varying, sums: Array, rows: Array) -> Array | Varying:
        """Return the covariance that maximises the expected likelihood within its structure."""
        kind, n = self.kinds[name], float(rows.sum())
        if kind == "scaled":
            return _scaled(now, _scale_of(self.stack(now), sums, rows))
        S = sums.sum(axis=0) / n
        S = 0.5 * (S + S.T)
        # an entry without noise stays without, whatever rounding says
        silent = (np.diagonal(now.single) == 0.0) | (np.diagonal(S) <= 0.0)
        S[silent] = S[:, silent] = 0.0
        S = _semidefinite(S)
        return np.diag(np.diagonal(S)) if kind == "diagonal" else S

    def stack(self, matrix: Varying) -> Array:
        """Return the distinct matrices behind the kernel's sums of Q or R."""
        if matrix.constant:
            return matrix.single[None]
        if matrix.value is not None:
            return matrix.value
        return matrix.stack(self.t, self.dt)[0]

    # -- maximum likelihood --------------------------------------------------------------------------------------------

    def ml(self, iterations: int, tolerance: float) -> Learned:
        """Search by a few rounds of expectation maximisation, then L-BFGS with the exact gradient."""
        from scipy.optimize import minimize

        warm = self.em(min(4, iterations), tolerance)
        if warm.status is Status.COLLAPSED:
            return warm
        start = warm.model
        parts = [name for name in ("Q", "R") if name in self.what]
        maps = {name: _Map(self.kinds[name], (start.w if name == "Q" else start.e).cov()) for name in parts}
        sizes = [maps[name].size for name in parts]
        n_seen = max(int(self.seen.sum()), 1)
        history: list[float] = list(warm.history)
        best: list[Any] = [warm.loglik, start]

        def model_at(p: Array) -> Linear:
            new: dict[str, Any] = {}
            k = 0
            for name, size in zip(parts, sizes, strict=True):
                new["w" if name == "Q" else "e"] = Gaussian(maps[name].matrix(p[k : k + size]))
                k += size
            return dataclasses.replace(start, **new)

        def objective(p: Array) -> tuple[float, Array]:
            model = model_at(p)
            s = self.expect(model)
            if not s["ok"] or not np.isfinite(s["loglik"]):
                return 1e10, np.zeros(len(p))
            gradient, k = [], 0
            for name, size in zip(parts, sizes, strict=True):
                now = (model.w if name == "Q" else model.e).cov()
                sums, rows = (s["W"], s["nW"]) if name == "Q" else (s["V"], s["nV"])
                gradient.append(maps[name].gradient(p[k : k + size], self.stack(now), sums, rows))
                k += size
            if s["loglik"] > best[0]:
                best[:] = [s["loglik"], model]
            return -s["loglik"] / n_seen, -np.concatenate(gradient) / n_seen

        def remember(_: Array) -> None:
            history.append(best[0])

        found = minimize(
            objective,
            np.concatenate([maps[name].start() for name in parts]),
            jac=True,
            method="L-BFGS-B",
            callback=remember,
            options={"maxiter": iterations, "ftol": tolerance * 1e-2, "gtol": 1e-7, "maxls": 40},
        )
        converged = bool(found.success) or "ABNORMAL" in str(found.message)
        status = Status.OK if converged else Status.STALLED
        message = f"converged after {found.nit} iterations" if converged else str(found.message)
        info = {"message": message, "iterations": int(found.nit), "n_seen": n_seen, "evaluations": int(found.nfev)}
        return Learned(best[1], float(best[0]), tuple(history), status, info)


def _regression(Wz: Array, Z: Array, Q: Array, mask: Any, lo: Array, hi: Array) -> Array:
    """Return the step D within its bounds that solves ``Q^-1 (Wz - D Z) = 0`` on the free entries of D, 0 elsewhere."""
    step = np.zeros(Wz.shape)
    weight = np.linalg.pinv(Q, hermitian=True)
    if not np.any(weight):
        weight = np.eye(len(Q))
    i, j = np.nonzero(mask)
    normal, right = weight[np.ix_(i, i)] * Z[np.ix_(j, j)], (weight @ Wz)[i, j]
    low, high = lo[i, j], hi[i, j]
    d, open_ = np.zeros(len(i)), np.ones(len(i), dtype=bool)
    while open_.any():
        rest = right[open_] - normal[np.ix_(open_, ~open_)] @ d[~open_]
        d[open_] = np.linalg.lstsq(normal[np.ix_(open_, open_)], rest, rcond=None)[0]
        out = open_ & ((d < low) | (d > high))
        if not out.any():
            break
        d[out] = np.clip(d[out], low[out], high[out])
        open_ &= ~out
    step[i, j] = d
    return step


def _semidefinite(S: Array) -> Array:
    """Return a symmetric matrix without the negative eigenvalues that rounding left, judged at unit diagonal."""
    d = np.sqrt(np.diagonal(S))
    d = np.where(d > 0, d, 1.0)
    value, vector = np.linalg.eigh(S / np.outer(d, d))
    if value[0] >= 0:
        return S
    return np.asarray((vector * np.maximum(value, 0.0)) @ vector.T * np.outer(d, d))


def _covariance(model: Linear, name: str) -> Varying:
    return (model.w if name == "Q" else model.e).cov()


def _scale_of(stack: Array, sums: Array, rows: Array) -> float:
    """Return the multiple of the given covariances that maximises the expected likelihood."""
    inverse = np.linalg.pinv(stack, hermitian=True)
    rank = np.linalg.matrix_rank(stack, hermitian=True)
    total = float((rows * rank).sum())
    return float(np.einsum("kij,kji->", inverse, sums)) / total if total > 0 else 1.0


def _scaled(matrix: Varying, factor: float) -> Array | Varying:
    if matrix.value is not None:
        return matrix.value * factor
    function: Callable[..., Any] | None = matrix.function
    assert function is not None
    return dataclasses.replace(matrix, function=lambda *a: factor * np.asarray(function(*a), dtype=float))


class _Map:
    """A covariance as free numbers: Cholesky factor with a logarithmic diagonal, log variances, or a log factor."""

    def __init__(self, kind: str, now: Varying) -> None:
        self.kind, self.now = kind, now
        self.n = now.shape[0]
        if kind == "full":
            S = now.single
            floor = 1e-8 * max(float(np.trace(S)) / self.n, 1e-300)
            self.L = np.linalg.cholesky(S + floor * np.eye(self.n))
            self.row, self.column = np.tril_indices(self.n)
            self.unit = np.sqrt(np.diagonal(S) + floor)  # off-diagonal numbers in units of their row
            self.size = len(self.row)
        elif kind == "diagonal":
            d = np.diagonal(now.single)
            self.d = np.maximum(d, 1e-8 * max(float(d.max()), 1e-300))
            self.size = self.n
        else:
            self.size = 1

    def start(self) -> Array:
        """Return the numbers of the covariance it was made from."""
        if self.kind == "full":
            return self._of_factor(np.asarray(self.L, dtype=np.float64))
        return np.log(self.d) if self.kind == "diagonal" else np.zeros(1)

    def numbers(self, matrix: Varying, problem: Problem) -> Array:
        """Return the numbers of another covariance of the same structure."""
        if self.kind == "full":
            return self._of_factor(np.asarray(np.linalg.cholesky(matrix.single), dtype=np.float64))
        if self.kind == "diagonal":
            return np.asarray(np.log(np.maximum(np.diagonal(matrix.single), 1e-300)))
        size = [max(float(np.trace(problem.stack(m)[0])), 1e-300) for m in (matrix, self.now)]
        return np.array([np.log(size[0] / size[1])])

    def _of_factor(self, L: Array) -> Array:
        p = L[self.row, self.column] / self.unit[self.row]
        diagonal = self.row == self.column
        p[diagonal] = np.log(p[diagonal])
        return np.asarray(p)

    def factor(self, p: Array) -> Array:
        L = np.zeros((self.n, self.n))
        diagonal = self.row == self.column
        L[self.row, self.column] = np.where(diagonal, np.exp(np.clip(p, -300, 300)), p) * self.unit[self.row]
        return L

    def matrix(self, p: Array) -> Array | Varying:
        if self.kind == "full":
            L = self.factor(p)
            return L @ L.T
        if self.kind == "diagonal":
            return np.diag(np.exp(np.clip(p, -600, 600)))
        return _scaled(self.now, float(np.exp(np.clip(p[0], -600, 600))))

    def gradient(self, p: Array, stack: Array, sums: Array, rows: Array) -> Array:
        """Return the derivative of the log-likelihood by p, by Fisher's identity."""
        if self.kind == "scaled":
            inverse = np.linalg.pinv(stack, hermitian=True)
            rank = np.linalg.matrix_rank(stack, hermitian=True)
            fit = float(np.einsum("kij,kji->", inverse, sums))
            return np.array([0.5 * (fit - float((rows * rank).sum()))])
        S, n = sums.sum(axis=0), float(rows.sum())
        if self.kind == "diagonal":
            d = np.diagonal(stack[0])
            return np.asarray(0.5 * (np.diagonal(S) / d - n))
        L = self.factor(p)
        half = np.linalg.solve(L, np.linalg.solve(L, S).T).T  # L^-1 S L^-T
        G = np.linalg.solve(L.T, half - n * np.eye(self.n))  # 2 dS L, as Q^-1 (S - n Q) Q^-1 L
        g = G[self.row, self.column] * self.unit[self.row]
        diagonal = self.row == self.column
        g[diagonal] *= np.exp(np.clip(p[diagonal], -300, 300))
        return np.asarray(g)
