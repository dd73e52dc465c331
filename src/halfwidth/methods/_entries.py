"""The posterior with unknown entries theta of A, B, C, E, F: evidence climbed over theta, then integrated.

Half-widths are found anew for every theta. The search begins in the middle of ``theta_bounds``, or where sequential
linear programming ends if that explains the record better. The prior of theta is flat within the bounds. Around the
mode the evidence is evaluated at weighted nodes, and the answer is the mixture of theirs.
"""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from halfwidth.array import Array
from halfwidth.methods._linearised import filled
from halfwidth.methods._noise_parts import bounded_only
from halfwidth.methods._protocol import typed
from halfwidth.model import Linear
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Shaped

if TYPE_CHECKING:
    from halfwidth.methods._answer import Answer
    from halfwidth.methods._carry import Start
    from halfwidth.methods.posterior import Posterior

_STEPS = 40
_NODES = 24
#: Points that are tried where nothing fits in the middle of the bounds.
_ELSEWHERE = 20


def with_entries(method: "Posterior", model: Linear, record: Record) -> Estimate:
    """Estimate states, half-widths and unknown entries of one record."""
    from halfwidth.methods.posterior import nodes

    search = _Search(method, model, record)
    theta, converged = search.climb()
    if search.best is None:
        return search.failed(typed(method))
    L = search.width(theta)
    p = len(theta)
    z = nodes(p, _NODES)
    log_proposal = -0.5 * (z**2).sum(axis=1) - 0.5 * p * math.log(2 * math.pi)
    inner = replace(method, nodes=max(1, method.nodes // 2))
    found: list[tuple[float, Array, Estimate]] = []
    for k in range(len(z)):
        at = theta + L @ z[k]
        if np.any(at < search.lo) or np.any(at > search.hi):
            continue
        answer = inner.answer(search.model(at), record, start=search.start)
        if answer.estimate.status.good:
            found.append((float(answer.found["log_evidence"]) - float(log_proposal[k]), at, answer.estimate))
    if not found:
        found = [(0.0, theta, search.best.estimate)]
    return _mixture(method, model, found, search, converged, L)


class _Search:
    """The evidence as a function of theta."""

    def __init__(self, method: "Posterior", model: Linear, record: Record) -> None:
        self.method, self.asked, self.record = replace(method, nodes=1), model, record
        p = len(model.theta_entries)
        box = model.theta_bounds
        self.lo = np.full(p, -np.inf) if box is None else np.array(box.lo)
        self.hi = np.full(p, np.inf) if box is None else np.array(box.hi)
        self.first = np.zeros(p) if box is None else np.array(box.mean)
        self.start: Start | None = None
        self.best: Answer | None = None
        self.value = -math.inf

    def model(self, theta: Array) -> Linear:
        """Return the model with its unknown entries filled in."""
        return filled(self.asked, theta)

    def at(self, theta: Array) -> float:
        """Return log evidence at the mode of the half-widths, and keep the best."""
        model = self.model(theta)
        answer = self.method.answer(model, self.record, start=self.start)
        if answer.code >= 2 and self.start is not None:
            # What was found elsewhere may lead astray here.
            answer = self.method.answer(model, self.record)
        if not np.isfinite(answer.found["log_mode"]) or answer.code >= 2:
            return -math.inf
        value = float(answer.found["log_mode"])
        if value > self.value:
            self.value, self.best, self.start = value, answer, answer.start
        return value

    def by_programs(self) -> list[Array]:
        """Return the theta that linear programs fit with bounded noise alone, if any: the middle may be far off."""
        from halfwidth.methods.sequential import SequentialLP

        model, method = bounded_only(self.asked), SequentialLP()
        if method.refuses(model) is not None:
            return []
        found = method.run(model, self.record)
        if found.theta is None or not found.status.good or not np.isfinite(found.theta).all():
            return []
        return [np.clip(found.theta, self.lo, self.hi)]

    def slope(self, theta: Array, size: Array) -> tuple[Array, Array]:
        """Return gradient and diagonal of the Hessian by central differences."""
        here, g, d = self.at(theta), np.zeros(len(theta)), np.zeros(len(theta))
        for k, h in enumerate(size):
            step = np.zeros(len(theta))
            step[k] = h
            up, down = self.at(theta + step), self.at(theta - step)
            if math.isinf(up) or math.isinf(down):
                g[k] = 0.0 if math.isinf(up) and math.isinf(down) else (1.0 if math.isinf(down) else -1.0) / h
                d[k] = -1.0 / h**2
            else:
                g[k], d[k] = (up - down) / (2 * h), (up + down - 2 * here) / h**2
        return g, d

    def climb(self) -> tuple[Array, bool]:
        """Climb by a quasi-Newton search within the bounds."""
        from scipy.optimize import minimize

        theta = max([self.first, *self.by_programs()], key=self.at)
        if math.isinf(self.value):
            # Nothing fits there, as where an unknown output gain is 0: look elsewhere between the bounds.
            width = np.where(np.isfinite(self.hi - self.lo), self.hi - self.lo, 2.0)
            points = np.random.default_rng(20260).uniform(-0.45, 0.45, (_ELSEWHERE, len(theta))) * width + theta
            values = [self.at(point) for point in points]
            if math.isinf(max(values)):
                return theta, False
            theta = points[int(np.argmax(values))]
        span = np.where(np.isfinite(self.hi - self.lo), self.hi - self.lo, 1.0)
        size = 1e-3 * span

        def cost(v: Array) -> tuple[float, Array]:
            value = self.at(v)
            if math.isinf(value):
                return 1e10, np.zeros(len(v))
            return -value, -self.slope(v, size)[0]

        bounds = list(zip(self.lo + size, self.hi - size, strict=True))
        found = minimize(
            cost, np.clip(theta, self.lo + size, self.hi - size), jac=True, method="L-BFGS-B", bounds=bounds,
            options={"maxiter": _STEPS, "ftol": 1e-7, "gtol": 1e-2},
        )  # fmt: skip
        return np.asarray(found.x), bool(found.success) or "ABNORMAL" in str(found.message)

    def width(self, theta: Array) -> Array:
        """Return a factor of the covariance of theta at the mode."""
        p = len(theta)
        span = np.where(np.isfinite(self.hi - self.lo), self.hi - self.lo, np.maximum(np.abs(theta), 1.0))
        _, d = self.slope(theta, 1e-3 * span)
        sd = 1.0 / np.sqrt(np.maximum(-d, 1.0 / span**2))
        h = 0.5 * sd  # steps that the evidence notices, whatever its rounding
        here = self.at(theta)
        H = np.zeros((p, p))
        for i in range(p):
            for j in range(i + 1):
                a, b = np.zeros(p), np.zeros(p)
                a[i], b[j] = h[i], h[j]
                if i == j:
                    v = (self.at(theta + a) + self.at(theta - a) - 2 * here) / h[i] ** 2
                else:
                    plus = self.at(theta + a + b) + self.at(theta - a - b)
                    v = (plus - self.at(theta + a - b) - self.at(theta - a + b)) / (4 * h[i] * h[j])
                H[i, j] = H[j, i] = -v if np.isfinite(v) else (1.0 / sd[i] ** 2 if i == j else 0.0)
        value, vector = np.linalg.eigh(H * np.outer(sd, sd))
        root = vector / np.sqrt(np.maximum(value, 0.1))
        return np.asarray(sd[:, None] * root)

    def failed(self, name: str) -> Estimate:
        """Return what is said where no value of theta that was tried fits."""
        est = self.method.answer(self.model(self.first), self.record).estimate
        return replace(est, theta=None, method=name)


def _mixture(
    method: "Posterior", model: Linear, found: list[tuple[float, Array, Estimate]], search: _Search, converged: bool,
    L: Array,
) -> Estimate:  # fmt: skip
    top = max(f[0] for f in found)
    weight = np.array([math.exp(f[0] - top) for f in found])
    total = float(weight.sum())
    weight /= total
    thetas = np.array([f[1] for f in found])
    first = search.best
    assert first is not None

    def mean(values: list[Any]) -> Array:
        return np.asarray(np.tensordot(weight, np.array(values), 1))

    ests = [f[2] for f in found]
    x = mean([e.x for e in ests])
    P, m3, m4 = np.zeros((*x.shape, x.shape[1])), np.zeros(x.shape), np.zeros(x.shape)
    for w, e in zip(weight, ests, strict=True):
        d = e.x - x
        cov = np.asarray(e.P)
        v = np.diagonal(cov, axis1=1, axis2=2)
        shape = e.spread if isinstance(e.spread, Shaped) else None
        k3, k4 = (shape.skew, shape.kurt) if shape is not None else (0.0, 0.0)
        P += w * (cov + d[:, :, None] * d[:, None, :])
        third = k3 * v**1.5
        m3 += w * (third + 3 * v * d + d**3)
        m4 += w * ((k4 + 3) * v**2 + 4 * third * d + 6 * v * d**2 + d**4)
    v = np.maximum(np.diagonal(P, axis1=1, axis2=2), 1e-300)
    est = first.estimate
    within = getattr(est.spread, "within", None)
    theta = weight @ thetas
    effective = float(1.0 / (weight @ weight))
    sd = np.sqrt(weight @ (thetas - theta) ** 2) if len(found) > 1 else np.sqrt((L**2).sum(axis=1))
    status = est.status
    if status.good and (not converged or effective < 2.0):
        status = Status.REDUCED
    info = dict(est.info) | {
        "theta_sd": sd,
        "theta_nodes": len(found),
        "theta_effective": effective,
        "x0": mean([e.info["x0"] for e in ests]),
    }
    for name in ("half_widths", "variances"):
        if name in info and all(e.status.good for e in ests):
            info[name] = {k: mean([e.info[name][k] for e in ests]) for k in ("mean", "sd", "lo", "hi")}
    return replace(
        est,
        x=x,
        spread=Shaped(x, P, m3 / v**1.5, m4 / v**2 - 3.0, within),
        status=status,
        method=typed(method),
        q=None if est.q is None else mean([e.q for e in ests]),
        r=None if est.r is None else mean([e.r for e in ests]),
        Q=None if est.Q is None else mean([e.Q for e in ests]),
        R=None if est.R is None else mean([e.R for e in ests]),
        theta=theta,
        loglik=float(top + math.log(total / _NODES) - np.linalg.slogdet(np.linalg.inv(L))[1]),
        names=model.names.x,
        info=info,
    )
