"""Bootstrap particle filter and smoother: any model, any noise that can be drawn; slow, and true in the limit.

Particles are moved by the model with noise drawn from it and weighted by the density of what was seen [1]_. Gaussian
output noise weights with its density and uniform noise keeps or drops. Of mixed noise the bounded part is drawn with
the particle and the Gaussian part weights, since the expectation of that weight is the density of the sum; where its
entries are independent that expectation is taken exactly. Independent outputs are taken from the last to the first,
``y_i = C_i x + e_i - sum_j>i F_ij y_j``, and an unseen one that matters is drawn, so that any entry may be missing.
Weights are logarithms; particles are redrawn, systematically [2]_, when less than half of them count. The smoother
draws trajectories backwards [3]_.

References
----------
.. [1] Gordon, Salmond and Smith (1993), IEE Proc. F 140(2).
.. [2] Carpenter, Clifford and Fearnhead (1999), IEE Proc. Radar 146(1).
.. [3] Godsill, Doucet and West (2004), JASA 99(465), algorithm 1.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from halfwidth.array import Array, generator
from halfwidth.call import arity
from halfwidth.errors import BadValue
from halfwidth.methods._protocol import typed
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.noise import Gaussian, Mixed, Noise, Uniform, unknown_variances
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Box, Cloud, Halfspaces
from halfwidth.tape import Untraceable
from halfwidth.trace import compiled

#: Entries (rows x particles x states) up to which every particle is returned; beyond, each row is thinned.
_KEPT = 20_000_000
_LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class ParticleFilter:
    """Bootstrap particle filter, or smoother by backward simulation.

    The reference for what has no closed form: bounded, Gaussian and mixed noise, bounds on the state, nonlinear models.
    The error of a mean falls with ``1 / sqrt(particles)``, and particles run out when the outputs are much sharper than
    the prediction; then the status is COLLAPSED, the row's outputs are passed over, and the message names the time.

    Parameters
    ----------
    particles : int
    smooth : bool
        Draw `trajectories` backwards through the particles; needs state noise with a density.
    trajectories : int
        Number of smoothed trajectories.
    compiled : bool
        Move particles by compiled functions where `g` and `h` allow it.

    Raises
    ------
    BadValue
        If a setting is out of its domain.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Uniform(0.1), hw.Uniform(1.0), hw.Box(-1, 1))
    >>> est = hw.estimate(walk, hw.Record([0.0, 1.0], [1.5, None]), ParticleFilter(particles=500), seed=1)
    >>> lo, hi = est.interval(0.9)
    >>> bool(lo[0, 0] >= 0.5 - 1e-12), bool(hi[0, 0] <= 1.1 + 1e-12)
    (True, True)
    """

    particles: int = 1000
    smooth: bool = False
    trajectories: int = 200
    compiled: bool = True

    def __post_init__(self) -> None:
        for name in ("particles", "trajectories"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 2:
                raise BadValue(f"`{name}` is {value!r}, a whole number from 2 was expected")

    def refuses(self, model: Model) -> str | None:
        """Return why the model cannot be taken, or None."""
        if (reason := unknown_variances(model.w, model.e, "ParticleFilter")) is not None:
            return reason
        if not model.w.known or not model.e.known:
            return "`ParticleFilter` needs known half-widths but `w` or `e` has unknown ones\nhint: Uniform(q)"
        if isinstance(model.x0, Box) and not np.isfinite([model.x0.lo, model.x0.hi]).all():
            return "`ParticleFilter` cannot draw from a prior without ends\nhint: x0=Box(lo, hi) or Normal(mean, P)"
        if isinstance(model, Linear) and model.theta_entries:
            return (
                "`ParticleFilter` needs a known model but some entries are NaN\nhint: give every entry of A, B, C, E, F"
            )
        if isinstance(model.bounds, Halfspaces) and np.any(model.bounds.lo == model.bounds.hi):
            return (
                "`ParticleFilter` cannot keep an equality: no particle falls on it"
                "\nhint: a Gaussian model and Constrained(KalmanFilter())"
            )
        if model.loss is not None:
            return "`ParticleFilter` cannot tell losses from outputs\nhint: RBPF(), or a model without `loss`"
        if self.smooth and not _has_density(model.w):
            return (
                "`ParticleFilter(smooth=True)` needs state noise with a density but `w` is "
                f"{'mixed' if isinstance(model.w, Mixed) else 'zero along some direction'}\nhint: ParticleFilter()"
            )
        return None

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:
        """Estimate the states; see `halfwidth.estimate`."""
        entropy = generator(seed).bit_generator.seed_seq.entropy  # type: ignore[attr-defined]
        rng = np.random.default_rng(entropy)
        T, N, nx = len(record), self.particles, model.nx
        dt = record.steps(model.dt)
        motion = _motion(model, record, dt, compiled_=self.compiled)
        noise_w = _Drawn(model.w, record.t, dt)
        weigh = _weigher(model, record, dt, motion.output)
        kept = N if self.smooth or T * N * nx <= _KEPT else max(2, _KEPT // (T * nx))

        if isinstance(model.x0, Box):
            x = rng.uniform(model.x0.lo, model.x0.hi, (N, nx))
        else:
            x = model.x0.mean + rng.standard_normal((N, nx)) @ _root(model.x0.P).T
        logw = np.zeros(N)
        mean = np.empty((T, nx))
        points, weights = np.empty((T, kept, nx)), np.empty((T, kept))
        ess, steps = np.empty(T), np.zeros(T)
        collapsed: list[int] = []
        angles = list(model.x_angles) if isinstance(model, Nonlinear) else []
        w = np.full(N, 1.0 / N)
        first: Array | None = None
        for k in range(T):
            if w @ w > 2.0 / N:  # fewer than half of the particles count
                x, logw = x[_systematic(w, N, rng)], np.zeros(N)
            if k == 0:
                first = x
            x = motion.move(x, k) + noise_w.draw(k, N, rng)
            if motion.fold is not None:
                x = x @ motion.fold(k).T
            gain = weigh(x, k, rng) + _inside(model, x)
            gain[~np.isfinite(x).all(axis=1)] = -np.inf
            before = _log_sum(logw)
            after = logw + gain
            top = after.max()
            if np.isfinite(top):
                logw = after
                steps[k] = _log_sum(after) - before
            else:
                collapsed.append(k)
                x = np.where(np.isfinite(x), x, 0.0)
            logw = logw - logw.max()
            w = np.exp(logw)
            w /= w.sum()
            ess[k] = 1.0 / (w @ w)
            if angles:  # around their mean, so that mean and quantiles mean something
                a = x[:, angles]
                centre = a[np.argmax(w)] + w @ _wrapped(a - a[np.argmax(w)])
                x[:, angles] = _wrapped(centre) + _wrapped(a - centre)
            mean[k] = w @ x
            if kept == N:
                points[k], weights[k] = x, w
            else:
                points[k], weights[k] = x[_systematic(w, kept, rng)], 1.0 / kept
        status, message = _judged(collapsed, ess, record.t)
        info: dict[str, Any] = {"seed": entropy, "ess": ess, "evaluated": motion.evaluated, "kept": kept}
        if message:
            info["message"] = message
        cloud = Cloud(points, weights)
        if self.smooth:
            assert first is not None
            density = _Density(model.w, record.t, dt, angles)
            paths = _backward(motion, density, points, weights, self.trajectories, rng)
            cloud = Cloud(paths, np.full(paths.shape[:2], 1.0 / self.trajectories))
            mean = paths.mean(axis=1)
        return Estimate(
            record.t,
            mean,
            cloud,
            status,
            typed(self),
            loglik=float(steps.sum()),
            names=model.names.x,
            labels=record.labels,
            info=info,
        )


def _judged(collapsed: list[int], ess: Array, t: Array) -> tuple[Status, str | None]:
    if collapsed:
        k = collapsed[0]
        return Status.COLLAPSED, (
            f"no particle explains row {k}, t = {t[k]:.6g} s ({len(collapsed)} of {len(t)} rows); "
            "its outputs were passed over"
        )
    k = int(np.argmin(ess))
    if ess[k] < 2.0:
        return Status.REDUCED, f"one particle alone explains row {k}, t = {t[k]:.6g} s; more particles are needed"
    return Status.OK, None


def _systematic(w: Array, n: int, rng: np.random.Generator) -> Any:
    """Return `n` indices, each particle taken n w times up to one."""
    edges = np.cumsum(w)
    found = np.searchsorted(edges / edges[-1], (rng.random() + np.arange(n)) / n, side="right")
    return np.minimum(found, len(w) - 1)


def _log_sum(a: Array) -> float:
    top = a.max()
    return float(top + np.log(np.exp(a - top).sum()))


def _wrapped(a: Array) -> Array:
    """Into [-pi, pi)."""
    return np.asarray(np.remainder(a + np.pi, 2.0 * np.pi) - np.pi)


def _inside(model: Model, x: Array) -> Any:
    if model.bounds is None:
        return 0.0
    return np.where(model.bounds.contains(x), 0.0, -np.inf)


def _parts(noise: Noise) -> tuple[Array | None, Gaussian | None]:
    """Half-widths and Gaussian part of a noise, None where it has not the part."""
    if isinstance(noise, Uniform):
        return np.atleast_1d(noise.q), None
    if isinstance(noise, Mixed):
        return np.atleast_1d(noise.uniform.q), noise.gaussian
    assert isinstance(noise, Gaussian)
    return None, noise


def _rows(matrix: Any, t: Array, dt: Array) -> Callable[[int], Array]:
    """Return a function of the row that gives its matrix."""
    stack, index = matrix.stack(t, dt)
    if index is not None:
        return lambda k: np.asarray(stack[index[k]])
    return lambda k: np.asarray(stack[k if len(stack) > 1 else 0])


def _root(S: Array) -> Array:
    value, vector = np.linalg.eigh(S)
    return np.asarray(vector * np.sqrt(np.maximum(value, 0.0)))


class _Drawn:
    """Draws of one noise, many to a row."""

    def __init__(self, noise: Noise, t: Array, dt: Array) -> None:
        self.q, part = _parts(noise)
        self.cov = None if part is None else _rows(part.cov(), t, dt)
        self.roots: dict[bytes, Array] = {}

    def draw(self, k: int, n: int, rng: np.random.Generator) -> Array:
        """Return (n, size)."""
        total: Array | float = 0.0
        if self.q is not None:
            total = rng.uniform(-self.q, self.q, (n, len(self.q)))
        if self.cov is not None:
            S = self.cov(k)
            root = self.roots.get(S.tobytes())
            if root is None:
                root = self.roots[S.tobytes()] = _root(S)
            total = total + rng.standard_normal((n, len(root))) @ root.T
        return np.asarray(total)


class _Motion(NamedTuple):
    """The model over all particles: ``E x = move(x-, k) + w``; fold(k) is E^-1, output(x, k) is C x or h(x)."""

    move: Callable[[Array, int], Array]
    output: Callable[[Array, int], Array]
    fold: Callable[[int], Array] | None
    evaluated: str


def _motion(model: Model, record: Record, dt: Array, *, compiled_: bool) -> _Motion:
    t, u = record.t, record.u
    if isinstance(model, Linear):
        A, C = _rows(model.A, t, dt), _rows(model.C, t, dt)
        B = None if model.B is None else _rows(model.B, t, dt)
        E = None if model.E is None else _rows(model.E, t, dt)

        def move(x: Array, k: int) -> Array:
            shift = 0.0 if B is None or u is None else B(k) @ u[k]
            return np.asarray(x @ A(k).T + shift)

        fold = None if E is None else lambda k: np.asarray(np.linalg.inv(E(k)))
        return _Motion(move, lambda x, k: np.asarray(x @ C(k).T), fold, "matrices")
    return _nonlinear(model, record, dt, compiled_=compiled_)


def _nonlinear(model: Nonlinear, record: Record, dt: Array, *, compiled_: bool) -> _Motion:
    u = record.u

    def more(k: int) -> tuple[Any, ...]:
        return (None if u is None else u[k], float(dt[k]))[: arity(model.g, 3) - 1]

    sd = np.sqrt(np.diag(model.x0.P)) if not isinstance(model.x0, Box) else 0.5 * (model.x0.hi - model.x0.lo)
    rng = np.random.default_rng(0)
    tests = [model.x0.mean + s * sd * rng.standard_normal(model.nx) for s in (0.0, 0.5, 1.0, 1.0, 2.0)]
    try:
        sizes = (model.nx, model.nu, None)[: arity(model.g, 3)]
        g = compiled(model.g, sizes, [(x, *more(0)) for x in tests])
        h = compiled(model.h, (model.nx,), [(x,) for x in tests])
    except Untraceable:
        compiled_ = False
    if not compiled_:
        return _Motion(
            lambda x, k: np.array([_finite(model.g, (p.copy(), *more(k)), model.nx) for p in x]),
            lambda x, k: np.array([_finite(model.h, (p.copy(),), model.ny) for p in x]),  # noqa: ARG005
            None,
            "python",
        )
    return _Motion(lambda x, k: g(x, *more(k)), lambda x, k: h(x), None, "compiled")  # noqa: ARG005


def _finite(f: Callable[..., Any], arguments: tuple[Any, ...], size: int) -> Array:
    """One particle through a user's function; what is not finite makes it weigh nothing later."""
    with np.errstate(all="ignore"):
        return np.asarray(f(*arguments), dtype=np.float64).reshape(size)


def _weigher(
    model: Model, record: Record, dt: Array, output: Callable[[Array, int], Array]
) -> Callable[[Array, int, np.random.Generator], Array]:
    """Return the function (particles, row, rng) -> log-density of what was seen, up to nothing."""
    q, part = _parts(model.e)
    t, y, seen = record.t, record.y, record.seen
    F = _rows(model.F, t, dt) if isinstance(model, Linear) and model.F is not None else None
    angles = list(model.y_angles) if isinstance(model, Nonlinear) else []

    def wrap(v: Array, columns: Any) -> Array:
        turning = [i for i, c in enumerate(columns) if c in angles]
        v[:, turning] = _wrapped(v[:, turning])
        return v

    R = None if part is None else _rows(part.cov(), t, dt)

    def independent(x: Array, k: int, rng: np.random.Generator, variance: Array) -> Array:
        assert q is not None
        Cx = output(x, k)
        f = np.eye(len(q)) if F is None else F(k)
        used = f[: int(np.flatnonzero(seen[k]).max(initial=-1)) + 1]
        full = np.zeros_like(Cx)
        total = np.zeros(len(x))
        needed = seen[k] | (np.triu(used, 1) != 0).any(axis=0)
        for i in range(len(q) - 1, -1, -1):
            if not needed[i]:
                continue
            mean = Cx[:, i] - full[:, i + 1 :] @ f[i, i + 1 :]
            if seen[k, i]:
                full[:, i] = y[k, i]
                v = wrap((y[k, i] - mean)[:, None], [i])[:, 0]
                rounding = 8.0 * np.finfo(np.float64).eps * (abs(y[k, i]) + np.abs(mean))
                total += _log_sum_density(v, q[i], float(np.sqrt(variance[i])), rounding)
            else:
                full[:, i] = mean + rng.uniform(-q[i], q[i], len(x))
                full[:, i] += np.sqrt(variance[i]) * rng.standard_normal(len(x))
        return total

    def weigh(x: Array, k: int, rng: np.random.Generator) -> Array:
        there = np.flatnonzero(seen[k])
        if not len(there):
            return np.zeros(len(x))
        S = np.zeros((len(seen[k]),) * 2) if R is None else R(k)
        if q is not None and not np.any(S - np.diag(np.diag(S))):
            return independent(x, k, rng, np.diag(S))
        mean = output(x, k)
        if q is not None:
            mean = mean + rng.uniform(-q, q, mean.shape)
        if F is not None:
            unfold = np.linalg.inv(F(k))
            mean, S = mean @ unfold.T, unfold @ S @ unfold.T
        v = wrap(y[k, there] - mean[:, there], there)
        return _log_normal(v, S[np.ix_(there, there)])

    return weigh


def _log_sum_density(v: Array, r: float, sd: float, rounding: Array) -> Array:
    """Log-density at v of U(-r, r) + N(0, sd^2); without noise v must be rounding, and the density counts as 1."""
    size = np.abs(v)
    if sd <= 1e-9 * r or (sd == 0.0 and r == 0.0):
        return np.asarray(np.where(size <= r + rounding, -np.log(2.0 * r) if r > 0 else 0.0, -np.inf))
    if r <= 1e-7 * sd:
        return np.asarray(-0.5 * (v / sd) ** 2 - np.log(sd) - 0.5 * _LOG_2PI)
    from scipy.special import log_ndtr

    near, far = log_ndtr((r - size) / sd), log_ndtr((-r - size) / sd)
    return np.asarray(near + np.log1p(-np.exp(far - near)) - np.log(2.0 * r))


def _log_normal(v: Array, S: Array) -> Array:
    """Log-density of N(0, S) at the rows of v; along a direction without variance v must be rounding."""
    d = np.sqrt(np.diag(S))
    scale = np.where(d > 0, d, 1.0)
    value, vector = np.linalg.eigh(S / scale[:, None] / scale)
    z = (v / scale) @ vector
    real = value > 1e-12
    with np.errstate(over="ignore"):
        total = -0.5 * (z[:, real] ** 2 / value[real]).sum(axis=1)
    total -= 0.5 * np.log(value[real]).sum() + np.log(scale[d > 0]).sum() + 0.5 * real.sum() * _LOG_2PI
    total[(np.abs(z[:, ~real]) > 1e-9).any(axis=1)] = -np.inf
    return np.asarray(np.where(np.isnan(total), -np.inf, total))


def _has_density(noise: Noise) -> bool:
    q, part = _parts(noise)
    if part is None:
        return bool(np.all(q > 0))  # type: ignore[operator]
    if q is not None:
        return False
    cov = part.cov()
    stack = cov.value if cov.value is not None else cov.at(1.0, 1.0)
    d = np.sqrt(np.diagonal(stack, axis1=-2, axis2=-1))
    if np.any(d == 0):
        return False
    return bool(np.linalg.eigvalsh(stack / d[..., :, None] / d[..., None, :]).min() > 1e-12)


class _Density:
    """Log-density of the state noise at many points, up to a constant."""

    def __init__(self, noise: Noise, t: Array, dt: Array, angles: list[int]) -> None:
        self.q, part = _parts(noise)
        self.cov = None if part is None else _rows(part.cov(), t, dt)
        self.angles = angles

    def __call__(self, after: Array, moved: Array, k: int) -> Array:
        """Of the noise between each of `moved` (N, nx) and each of `after` (M, nx); returns (M, N)."""
        if self.cov is None or self.angles:
            w = after[:, None, :] - moved[None, :, :]
            w[..., self.angles] = _wrapped(w[..., self.angles])
            if self.cov is None:
                assert self.q is not None
                return np.asarray(np.where((np.abs(w) <= self.q * (1.0 + 1e-9)).all(axis=-1), 0.0, -np.inf))
            z = np.linalg.solve(np.linalg.cholesky(self.cov(k)), w.reshape(-1, w.shape[-1]).T)
            return np.asarray(-0.5 * (z**2).sum(axis=0).reshape(w.shape[:2]))
        root = np.linalg.cholesky(self.cov(k))
        a, b = np.linalg.solve(root, after.T), np.linalg.solve(root, moved.T)  # (nx, M), (nx, N)
        total = np.zeros((len(after), len(moved)))
        for i in range(len(root)):
            total -= 0.5 * (a[i][:, None] - b[i][None, :]) ** 2
        return total


def _backward(
    motion: _Motion, density: _Density, points: Array, weights: Array, n: int, rng: np.random.Generator
) -> Array:
    """Draw `n` trajectories (T, n, nx) backwards through the filter's particles."""
    T = len(points)
    paths = np.empty((T, n, points.shape[2]))
    pick = _systematic(weights[-1], n, rng)
    paths[-1] = points[-1][pick]
    for k in range(T - 1, 0, -1):
        after = paths[k]
        if motion.fold is not None:
            after = np.linalg.solve(motion.fold(k), after.T).T  # E x
        with np.errstate(divide="ignore"):
            logw = density(after, motion.move(points[k - 1], k), k) + np.log(weights[k - 1])[None, :]
        # A row that collapsed may have left a trajectory without a parent: then any will do.
        lost = ~np.isfinite(logw.max(axis=1))
        with np.errstate(divide="ignore"):
            logw[lost] = np.log(weights[k - 1])
        logw -= logw.max(axis=1, keepdims=True)
        edges = np.cumsum(np.exp(logw), axis=1)
        draw = rng.random((n, 1)) * edges[:, -1:]
        paths[k - 1] = points[k - 1][np.minimum((edges < draw).sum(axis=1), edges.shape[1] - 1)]
    return paths
