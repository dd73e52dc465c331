"""Draws from the posterior by Markov chains: the truth that faster estimators are held against.

The posterior of a linear model is sampled over the whole trajectory, the half-widths (q, r) that are unknown and the
unknown entries theta of its matrices. Half-widths are integrated out of every move, so a chain does not stick where
one is small; a move along random directions whitened by the least-squares look-alike, a move that rescales all
disturbances of one state together with their half-width, and a move for each unknown entry are each a slice along a
line. Several chains start scattered; they are trusted when the rank-normalised split R-hat of every half-width, entry
and of states over the record says that they agree.

References
----------
Posterior of the bounded-noise model: Pavelková and Kárný (2013), eqs. (10)-(12), integrated instead of maximised.
Slice moves: Neal (2003), Annals of Statistics 31(3). R-hat and effective sample size: Vehtari, Gelman, Simpson,
Carpenter and Bürkner (2021), Bayesian Analysis 16(2), eqs. (4), (9)-(13), (14).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import halfwidth._core as _core
from halfwidth.array import Array, generator
from halfwidth.errors import BadValue
from halfwidth.methods._linearised import filled
from halfwidth.methods._protocol import typed
from halfwidth.methods._residuals import Residuals, reference, residuals
from halfwidth.methods.map import BatchLP
from halfwidth.methods.sequential import SequentialLP
from halfwidth.model import Linear, Model, needs_a_box
from halfwidth.noise import Gaussian, Noise, Uniform, unknown_variances
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Box, Cloud, Normal

#: A matrix entry that is unknown stands at this value while the pattern of the rows is built: any number but 0 and 1.
_PLACE = 0.7310585786300049

#: Chains that agree this well are good, and good enough to be used.
_FINE, _USABLE = 1.01, 1.05
#: Numbers of the cloud up to which every draw is returned.
_KEPT = 20_000_000


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws of several chains, and whether they agree.

    Parameters
    ----------
    x : (chains, draws, T + 1, nx) array
        Trajectories, x0 first.
    s : (chains, draws, nx + ny) array
        Half-widths (q, r); NaN for groups without a half-width (Gaussian noise).
    theta : (chains, draws, n_theta) array
        Unknown entries, in the order of ``model.theta_entries``.
    rhat : float
        The largest rank-normalised split R-hat of log half-widths, entries, and the states of up to 50 rows.
    ess : float
        The smallest effective sample size (bulk) of the same.
    """

    x: Array
    s: Array
    theta: Array
    rhat: float
    ess: float


def refuses(model: Model) -> str | None:
    """Return why a model cannot be sampled, or None."""
    if not isinstance(model, Linear):
        return "the sampler needs a linear model but the model is nonlinear\nhint: the posterior by linearisation"
    if (reason := needs_a_box(model, "the sampler")) is not None:
        return reason
    for name, noise in (("w", model.w), ("e", model.e)):
        if not isinstance(noise, Uniform | Gaussian):
            return (
                f"the sampler takes uniform or Gaussian noise but `{name}` is `{type(noise).__name__}`"
                "\nhint: ParticleFilter(smooth=True) draws from sums of both"
            )
    if (reason := unknown_variances(model.w, model.e, "the sampler")) is not None:
        return reason
    if model.loss is not None:
        return "the sampler takes lost outputs as NaN in the record but the model has a hidden loss\nhint: loss=None"
    for entry in model.theta_entries:
        if not model.matrices[entry.matrix].constant:
            return f"the sampler needs constant unknown entries but `{entry.matrix}` varies with time"
    return None


def sample(
    model: Linear,
    record: Record,
    *,
    draws: int = 1000,
    chains: int = 4,
    warm: int | None = None,
    thin: int = 50,
    whitened: int = 4,
    scale_every: int = 4,
    prior: Array | None = None,
    power: float = 1.0,
    seed: int | None = None,
) -> Draws | None:
    """Draw trajectories, half-widths and unknown entries from their posterior.

    Parameters
    ----------
    model : Linear
        One that `refuses` takes.
    record : Record
    draws, chains : int
        Draws kept of each chain, and chains.
    warm : int, optional
        Draws thrown away first; half of `draws` if absent.
    thin : int
        Sweeps from one draw to the next.
    whitened, scale_every : int
        Whitened moves every fourth sweep, and sweeps from one scale move of a state to the next.
    prior : (2, nx + ny) array, optional
        Mean and standard deviation of a normal prior of the log half-widths; an infinite deviation, as their absence,
        means a prior s^(power - 1).
    power : float
        Above 0; 1 is a prior flat in the half-width, small ones are nearly flat in its logarithm.
    seed : int, optional

    Returns
    -------
    Draws, or None if no trajectory fits the bounds.

    Raises
    ------
    BadValue
        If neither the rows of a half-width nor its prior bound it from above.
    """
    rng = generator(seed)
    rows = _rows(model, record)
    start = _start(model, record, rows)
    if start is None:
        return None
    x0, theta, sd = start
    rows.set(theta)
    N, nx = rows.N, model.nx
    floor, cap, kind = _ends(model)
    p = floor.size
    count = np.bincount(rows.group[rows.group >= 0], minlength=p)
    scale = np.array([float(sd[rows.group == j].max(initial=0.0)) for j in range(p)])
    # Below this a half-width is nothing beside its group: exact data would draw a chain to 0 for ever.
    tiny = 1e-9 * np.minimum(np.maximum(scale, 1e-290), np.where(cap > 0, cap, np.inf))
    if prior is None:
        prior = np.array([np.zeros(p), np.full(p, np.inf)])
    loose = (kind > 0) & (floor < cap) & np.isinf(cap) & np.isinf(prior[1])
    if np.any(loose & (count > 0) & (count <= power)):
        j = int(np.argmax(loose & (count > 0) & (count <= power)))
        name = [*model.names.x, *model.names.y][j]
        raise BadValue(
            f"the half-width of `{name}` has {count[j]} rows, no upper bound and a prior of power {power:g}, so its"
            " posterior has no total",
            hint="Uniform.unknown(at_most=...), or a lower power",
        )
    normal = np.array([prior[0], np.where(np.isfinite(prior[1]), prior[1], 0.0)])
    place, first, weight = _places(rows.group, p, sd)
    at = rows.M.copy()
    at.data = np.arange(at.nnz)
    at = at.tocsc()
    width = rows.M.indptr[1:] - rows.M.indptr[:-1]
    spans = [np.ptp(rows.M.indices[a : a + w]) for a, w in zip(rows.M.indptr, width, strict=False) if w]
    band = int(max(spans, default=0))
    s0 = np.where(kind > 0, np.clip(2.0 * scale, floor, cap), 1.0)
    warm = draws // 2 if warm is None else warm
    xs, ss, thetas = [], [], []
    for child in rng.integers(0, 2**63, size=chains):
        X, s, th, code = _core.sampler_run(
            rows.M.indptr.astype(np.int64), rows.M.indices.astype(np.int64), rows.M.data, rows.b,
            place, first, rows.state, weight, count.astype(np.int64), np.array([floor, cap, tiny]), normal, power,
            np.array([rows.lo, rows.hi]),
            at.indptr.astype(np.int64), at.data.astype(np.int64), place[at.indices], x0, s0,
            rows.theta_start, rows.theta_row, rows.theta_at, rows.theta_slope,
            np.array([rows.theta_lo, rows.theta_hi]), theta,
            nx, band, min(2 * N, 400), warm, draws, thin, whitened, scale_every, int(child),
        )  # fmt: skip
        if code:
            return None
        s[:, (count == 0) & (kind > 0)] = _from_prior(rng, draws, floor, cap, normal, power, (count == 0) & (kind > 0))
        s[:, kind == 0] = np.nan
        xs.append(X[:, rows.states].reshape(draws, -1, nx))
        ss.append(s)
        thetas.append(th)
    x, s, th = np.array(xs), np.array(ss), np.array(thetas)
    watched = [np.log(s[:, :, j]) for j in np.flatnonzero((kind > 0) & (floor < cap) & (count > 0))]
    watched += [th[:, :, m] for m in range(th.shape[2])]
    for t in np.unique(np.linspace(0, x.shape[2] - 1, 50).astype(int)):
        watched += [x[:, :, t, i] for i in range(nx) if np.ptp(x[:, :, t, i]) > 0]
    found = [convergence(v) for v in watched] or [(1.0, float(draws * chains))]
    return Draws(x, s, th, max(f[0] for f in found), min(f[1] for f in found))


def sampled(
    method: Any, model: Linear, record: Record, *, draws: int, chains: int, power: float, seed: int | None
) -> Estimate:
    """Return the estimate of a posterior by its draws.

    Parameters
    ----------
    method : estimator
        Named in the answer.
    """
    found = sample(model, record, draws=draws, chains=chains, power=power, seed=seed)
    floor, cap, kind = _ends(model)
    nx = model.nx
    info: dict[str, Any] = {"seed": seed, "notes": []}
    if found is None:
        point = _bounded_point(model, record)
        info |= {"x0": point.info["x0"], "hint": "BatchLP() names the rows in conflict"}
        return Estimate(
            record.t,
            point.x,
            None,
            Status.INFEASIBLE,
            typed(method),
            names=model.names.x,
            labels=record.labels,
            info=info,
        )
    x = found.x.reshape(-1, *found.x.shape[2:])
    s = found.s.reshape(-1, floor.size)
    theta = found.theta.reshape(len(x), -1)
    lo, hi = np.quantile(s[:, kind > 0], (0.05, 0.95), axis=0) if np.any(kind > 0) else (np.zeros(0), np.zeros(0))
    full = {name: np.zeros(floor.size) for name in ("mean", "sd", "lo", "hi")}
    for name, value in (("mean", s.mean(axis=0)), ("sd", s.std(axis=0))):
        full[name] = np.where(kind > 0, value, 0.0)
    full["lo"][kind > 0], full["hi"][kind > 0] = lo, hi
    status = Status.OK if found.rhat <= _FINE else Status.REDUCED if found.rhat <= _USABLE else Status.STALLED
    info |= {
        "x0": x[:, 0].mean(axis=0), "half_widths": full, "rhat": found.rhat, "ess": found.ess,
        "theta_sd": theta.std(axis=0),
    }  # fmt: skip
    if status is not Status.OK:
        info["message"] = (
            f"{status.value}: chains still differ, R-hat {found.rhat:.3f}, {found.ess:.0f} effective draws"
        )
        info["hint"] = f"draws={4 * draws}"
    count = np.r_[np.full(nx, len(record)), record.seen.sum(axis=0)]
    names = np.array([*model.names.x, *model.names.y])
    unseen = (kind > 0) & (floor < cap) & (count == 0)
    if unseen.any():
        info["notes"].append("bound not identifiable: " + ", ".join(names[unseen]))
    keep = slice(None, None, max(1, x[:, 1:].size // _KEPT))
    points = np.ascontiguousarray(x[keep, 1:].swapaxes(0, 1))
    return Estimate(
        record.t,
        x[:, 1:].mean(axis=0),
        Cloud(points, np.full(points.shape[:2], 1.0 / points.shape[1])),
        status,
        typed(method),
        q=full["mean"][:nx].copy() if kind[0] else None,
        r=full["mean"][nx:].copy() if kind[-1] else None,
        theta=theta.mean(axis=0) if theta.shape[1] else None,
        names=model.names.x,
        labels=record.labels,
        info=info,
    )


def convergence(v: Array) -> tuple[float, float]:
    """Return the rank-normalised split R-hat and the bulk effective sample size of draws (chains, draws).

    The larger R-hat of the ranks and of the ranks of distances from the median is returned, so that chains which agree
    in place but not in spread are found too.
    """
    half = v.shape[1] // 2
    split = np.concatenate([v[:, :half], v[:, -half:]])
    rhat = max(_rhat(_normal_scores(split)), _rhat(_normal_scores(np.abs(split - np.median(split)))))
    return rhat, _effective(_normal_scores(split))


def _normal_scores(v: Array) -> Array:
    from scipy.special import ndtri
    from scipy.stats import rankdata

    rank = rankdata(v, method="average").reshape(v.shape)
    return np.asarray(ndtri((rank - 0.375) / (v.size + 0.25)))


def _rhat(z: Array) -> float:
    n = z.shape[1]
    within = float(z.var(axis=1, ddof=1).mean())
    between = n * float(z.mean(axis=1).var(ddof=1))
    if within <= 0:
        return 1.0 if between <= 0 else float("inf")
    return float(np.sqrt((n - 1) / n + between / (n * within)))


def _effective(z: Array) -> float:
    """Return the effective sample size of chains (m, n) by Geyer's initial monotone sequence."""
    m, n = z.shape
    size = 2 ** int(np.ceil(np.log2(2 * n)))
    spectrum = np.fft.rfft(z - z.mean(axis=1, keepdims=True), size, axis=1)
    auto = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=1)[:, :n] / n
    within = float(auto[:, 0].mean()) * n / (n - 1)
    total = within * (n - 1) / n + float(z.mean(axis=1).var(ddof=1) if m > 1 else 0.0)
    if total <= 0:
        return float(m * n)
    rho = 1.0 - (within - auto.mean(axis=0) * n / (n - 1)) / total
    rho[0] = 1.0
    pairs = rho[: n // 2 * 2].reshape(-1, 2).sum(axis=1)
    below = np.flatnonzero(pairs < 0)
    pairs = np.minimum.accumulate(pairs[: below[0]] if below.size else pairs)
    tau = max(2.0 * float(pairs.sum()) - 1.0, 1.0 / np.log10(max(m * n, 10)))
    return float(m * n / tau)


class _Rows:
    """Rows of the sampler: sparse M, b, group of each row (-1: Gaussian, whitened), boxes, and the unknown entries."""

    M: Any
    b: Array
    group: NDArray[np.int64]
    lo: Array
    hi: Array
    state: NDArray[np.int64]
    states: NDArray[np.int64]
    base: Residuals
    theta_start: NDArray[np.int64]
    theta_row: NDArray[np.int64]
    theta_at: NDArray[np.int64]
    theta_slope: Array
    theta_lo: Array
    theta_hi: Array

    @property
    def N(self) -> int:
        """Number of unknowns."""
        return int(self.M.shape[1])

    def set(self, theta: Array) -> None:
        """Put the entries into M and b, which hold `_PLACE` for each."""
        for m, value in enumerate(theta):
            mine = slice(self.theta_start[m], self.theta_start[m + 1])
            at, slope, row = self.theta_at[mine], self.theta_slope[mine], self.theta_row[mine]
            inside = at >= 0
            np.add.at(self.M.data, at[inside], (value - _PLACE) * slope[inside])
            np.subtract.at(self.b, row[~inside], (value - _PLACE) * slope[~inside])


def _ends(model: Linear) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return floors and caps of the half-widths, and 1 for groups that have one, 0 for Gaussian ones; each (p,)."""

    def one(noise: Noise, n: int) -> tuple[Array, Array, Array]:
        if isinstance(noise, Uniform):
            return np.atleast_1d(noise.at_least), np.atleast_1d(noise.at_most), np.ones(n, int)
        return np.zeros(n), np.full(n, np.inf), np.zeros(n, int)

    w, e = one(model.w, model.nx), one(model.e, model.ny)
    return np.r_[w[0], e[0]], np.r_[w[1], e[1]], np.r_[w[2], e[2]].astype(np.int64)


def _rows(model: Linear, record: Record) -> _Rows:
    """Build the rows. Unseen outputs that a seen one is correlated with become unknowns of their own."""
    import scipy.sparse as sp

    T, nx, ny = len(record), model.nx, model.ny
    dt = record.steps(model.dt)
    entries = model.theta_entries
    fixed = filled(model, np.full(len(entries), _PLACE)) if entries else model
    F = np.broadcast_to(np.eye(ny), (T, ny, ny))
    if fixed.F is not None:
        stack, index = fixed.F.stack(record.t, dt)
        F = np.broadcast_to(stack, (T, ny, ny)) if index is None else stack[index]
    needed = _needed(F, record.seen, fixed.e, record)
    y = np.where(record.seen, record.y, np.where(needed, 0.0, np.nan))
    whole = replace(record, y=y)
    base = residuals(replace(fixed, F=None), whole)
    # Row (t, i) of F y: the seen entries go to the right-hand side, the needed ones are unknowns.
    there = record.seen | needed
    tj = np.argwhere(there)
    place = np.full((T, ny), -1)
    place[tj[:, 0], tj[:, 1]] = T * nx + np.arange(len(tj))
    b = base.b.copy()
    known = np.where(record.seen, record.y, 0.0)
    b[T * nx :] = np.einsum("tij,tj->ti", F, known)[there]
    latent = np.full((T, ny), -1)
    tl, jl = np.nonzero(needed)
    latent[tl, jl] = (T + 1) * nx + np.arange(tl.size)
    tf, i_f, jf = np.nonzero((F != 0) & needed[:, None, :] & there[:, :, None])
    extra = sp.coo_array((-F[tf, i_f, jf], (place[tf, i_f], latent[tf, jf])), shape=(b.size, (T + 1) * nx + tl.size))
    M = sp.coo_array(base.M)
    coords = np.hstack([np.array(M.coords), np.array(extra.coords)])
    M = sp.csr_array((np.r_[M.data, extra.data], (coords[0], coords[1])), shape=extra.shape)

    # Unknowns in the order of time, so that the look-alike has a band.
    when = np.r_[np.repeat(np.arange(T + 1), nx), tl + 1.5]
    order = np.argsort(when, kind="stable")
    back = np.argsort(order)
    M = sp.csr_array(M[:, order])
    M.sort_indices()
    free = Box(np.full(nx, -np.inf), np.full(nx, np.inf))
    box = model.bounds if isinstance(model.bounds, Box) else free
    prior = model.x0 if isinstance(model.x0, Box) else Box(np.full(nx, -np.inf), np.full(nx, np.inf))
    lo = np.r_[prior.lo, np.tile(box.lo, T), np.full(tl.size, -np.inf)][order]
    hi = np.r_[prior.hi, np.tile(box.hi, T), np.full(tl.size, np.inf)][order]

    rows = _Rows()
    rows.base, rows.lo, rows.hi = base, lo, hi
    rows.states = back[: (T + 1) * nx]
    rows.state = rows.states[nx:].astype(np.int64)
    rows.group = base.group.astype(np.int64)
    rows.M, rows.b = M, b
    _entries(rows, model, record, place, latent, back)
    for name, noise in (("w", model.w), ("e", model.e)):
        if isinstance(noise, Gaussian):
            _whiten(rows, noise, name, whole, dt, nx)
    if isinstance(model.x0, Normal):
        root = np.linalg.cholesky(_definite(model.x0.P))
        inverse = np.linalg.inv(root)
        i, j = np.nonzero(inverse)
        block = sp.csr_array((inverse[i, j], (i, rows.states[j])), shape=(nx, M.shape[1]))
        rows.M = sp.csr_array(sp.vstack([rows.M, block]))
        rows.b = np.r_[rows.b, inverse @ model.x0.mean]
        rows.group = np.r_[rows.group, np.full(nx, -1)]
    return rows


def _needed(F: Array, seen: NDArray[np.bool_], e: Noise, record: Record) -> NDArray[np.bool_]:
    """Return the unseen outputs that a seen one depends on, through F or through the covariance of e; (T, ny)."""
    ny = seen.shape[1]
    needed = np.zeros_like(seen)
    linked = (F != 0) & ~np.eye(ny, dtype=bool)
    if isinstance(e, Gaussian):
        stack, _ = e.cov().stack(record.t, record.steps(1.0))
        if np.any(stack * (1 - np.eye(ny)) != 0):
            linked = np.ones_like(linked)
    for _ in range(ny):
        needed = ~seen & np.einsum("tij,ti->tj", linked, seen | needed)
    return np.asarray(needed)


def _entries(
    rows: _Rows, model: Linear, record: Record, place: NDArray[Any], latent: NDArray[Any], back: NDArray[Any]
) -> None:
    """Find where each unknown entry stands in M, or that it stands in b."""
    T, nx = rows.base.T, rows.base.nx
    t = np.arange(T)
    start, row_of, at, slope = [0], [], [], []
    M = rows.M
    for entry in model.theta_entries:
        i, j = entry.row, entry.column
        if entry.matrix in "ABE":
            row = t * nx + i
            if entry.matrix == "B":
                column, value = np.full(T, -1), -np.asarray(record.u)[:, j]
            else:
                column = back[(t + (entry.matrix == "E")) * nx + j]
                value = np.full(T, 1.0 if entry.matrix == "E" else -1.0)
        else:
            there = np.flatnonzero(place[:, i] >= 0)
            row = place[there, i]
            if entry.matrix == "C":
                column, value = back[(there + 1) * nx + j], np.ones(there.size)
            else:
                inside = latent[there, j] >= 0
                column = np.where(inside, back[latent[there, j]], -1)
                value = np.where(inside, -1.0, -np.where(record.seen[there, j], record.y[there, j], 0.0))
        where = np.full(row.size, -1)
        for k, (a, c) in enumerate(zip(row, column, strict=True)):
            if c >= 0:
                where[k] = M.indptr[a] + np.searchsorted(M.indices[M.indptr[a] : M.indptr[a + 1]], c)
        start.append(start[-1] + row.size)
        row_of.append(row)
        at.append(where)
        slope.append(value)
    count = len(model.theta_entries)
    rows.theta_start = np.array(start, dtype=np.int64)
    rows.theta_row = np.concatenate([*row_of, np.zeros(0)]).astype(np.int64)
    rows.theta_at = np.concatenate([*at, np.zeros(0)]).astype(np.int64)
    rows.theta_slope = np.concatenate([*slope, np.zeros(0)])
    box = model.theta_bounds or Box(np.full(count, -np.inf), np.full(count, np.inf))
    rows.theta_lo, rows.theta_hi = np.array(box.lo, dtype=float), np.array(box.hi, dtype=float)


def _whiten(rows: _Rows, noise: Gaussian, name: str, record: Record, dt: Array, nx: int) -> None:
    """Turn the rows of a Gaussian noise into independent ones of variance 1."""
    import scipy.sparse as sp

    T, seen = rows.base.T, record.seen
    stack, index = noise.cov().stack(record.t, dt)
    Q = np.broadcast_to(stack, (T, *stack.shape[1:])) if index is None else stack[index]
    blocks = []
    for t in range(T):
        part = Q[t] if name == "w" else Q[t][np.ix_(seen[t], seen[t])]
        if part.size:
            blocks.append(np.linalg.inv(np.linalg.cholesky(_definite(part))))
    n_w = T * nx
    one = sp.block_diag(blocks) if blocks else sp.csr_array((0, 0))
    rest = rows.M.shape[0] - n_w
    white = sp.block_diag([one, sp.eye_array(rest)]) if name == "w" else sp.block_diag([sp.eye_array(n_w), one])
    rows.M = sp.csr_array(white @ rows.M)
    rows.M.sort_indices()
    rows.b = white @ rows.b
    mine = slice(0, n_w) if name == "w" else slice(n_w, None)
    rows.group[mine] = -1


def _definite(P: Array) -> Array:
    """Return a covariance with a floor under its eigenvalues, so that it has an inverse."""
    scale = np.sqrt(np.maximum(np.diagonal(P), 1e-300))
    return np.asarray(P + np.diag(1e-12 * scale**2))


def _bounded(model: Linear) -> Linear:
    """Return the model with bounded noise of unknown size instead of Gaussian noise, and a box as prior."""
    free = [
        noise if isinstance(noise, Uniform) else Uniform.unknown().sized(n, "noise")
        for noise, n in ((model.w, model.nx), (model.e, model.ny))
    ]
    prior = model.x0 if isinstance(model.x0, Box) else Box(np.full(model.nx, -np.inf), np.full(model.nx, np.inf))
    return replace(model, w=free[0], e=free[1], x0=prior)


def _bounded_point(model: Linear, record: Record) -> Estimate:
    """Return the trajectory of least excess over the bounds."""
    return (SequentialLP() if model.theta_entries else BatchLP()).run(_bounded(model), record)


def _start(model: Linear, record: Record, rows: _Rows) -> tuple[Array, Array, Array] | None:
    """Return a trajectory inside all bounds (N,), theta, and the standard deviation of each row (K,); or None."""
    floor, cap, kind = _ends(model)
    bounded = _bounded(model)
    if model.theta_entries:  # the warm-up finds its way into caps that no linearisation knows
        loose = [Uniform.unknown().sized(n, "noise") for n in (model.nx, model.ny)]
        found = SequentialLP().run(replace(bounded, w=loose[0], e=loose[1]), record)
    else:
        found = BatchLP().run(bounded, record)
    if not found.status.good:
        return None
    theta = np.zeros(0) if found.theta is None else np.array(found.theta)
    fixed = filled(bounded, theta) if theta.size else bounded
    p = floor.size
    known = np.where((floor == cap) & (kind > 0), floor / np.sqrt(3.0), 0.0)
    base = reference(residuals(fixed, record), fixed, known)
    sigma = np.where(known > 0, known, base.sigma)
    sd = np.where(rows.group >= 0, sigma[np.clip(rows.group, 0, p - 1)], 1.0)
    x = np.zeros(rows.N)
    x[rows.states] = np.r_[np.ravel(found.info["x0"]), found.x.ravel()]
    # Unseen outputs start at their prediction: the rows of each are solved for it in turn.
    others = np.setdiff1d(np.arange(rows.N), rows.states)
    if others.size:
        import scipy.sparse.linalg as sl

        rows_of = rows.M.tocsr()
        part = rows_of[:, others]
        x[others] = sl.lsqr(part, rows.b - rows_of @ x, atol=1e-12, btol=1e-12)[0]
    return np.clip(x, rows.lo, rows.hi), theta, np.maximum(sd, 1e-300)


def _places(group: NDArray[np.int64], p: int, sd: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Return where each row stands when rows are sorted by group, each group filled to four; and the weights there."""
    place, first, at = np.zeros(group.size, dtype=np.int64), np.zeros(p + 1, dtype=np.int64), 0
    for j in [*range(p), -1]:
        mine = np.flatnonzero(group == j)
        if j >= 0:
            first[j] = at
        else:
            first[p] = at
        place[mine] = at + np.arange(mine.size)
        at += -(-mine.size // 4) * 4
    weight = np.zeros(at)
    gaussian = group < 0
    weight[place[gaussian]] = 1.0 / sd[gaussian] ** 2
    return place, first, weight


def _from_prior(
    rng: np.random.Generator, draws: int, floor: Array, cap: Array, normal: Array, power: float, mine: NDArray[np.bool_]
) -> Array:
    """Draw the half-widths that no row speaks of, (draws, k): their prior, or the floor where that has no end."""
    out = np.zeros((draws, int(mine.sum())))
    for k, j in enumerate(np.flatnonzero(mine)):
        if normal[1, j] > 0:
            out[:, k] = np.clip(np.exp(rng.normal(normal[0, j], normal[1, j], draws)), floor[j], cap[j])
        elif np.isinf(cap[j]):
            out[:, k] = floor[j]
        else:
            lo, hi = floor[j] ** power, cap[j] ** power
            out[:, k] = (lo + (hi - lo) * rng.uniform(size=draws)) ** (1.0 / power)
    return out
