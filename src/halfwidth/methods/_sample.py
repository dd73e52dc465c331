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
Slice moves: Neal (2003), Annals of Statistics 31(3).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import halfwidth._core as _core
from halfwidth.array import Array, generator
from halfwidth.errors import BadValue
from halfwidth.methods._convergence import convergence
from halfwidth.methods._linearised import filled
from halfwidth.methods._noise_parts import bounded_only
from halfwidth.methods._protocol import typed
from halfwidth.methods._residuals import reference, residuals
from halfwidth.methods._sample_rows import Rows, laid_out
from halfwidth.methods.map import BatchLP
from halfwidth.methods.sequential import SequentialLP
from halfwidth.model import Linear, Model, needs_a_box
from halfwidth.noise import Gaussian, Noise, Uniform, unknown_variances
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Cloud

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
    rows = laid_out(model, record)
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


def _ends(model: Linear) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return floors and caps of the half-widths, and 1 for groups that have one, 0 for Gaussian ones; each (p,)."""

    def one(noise: Noise, n: int) -> tuple[Array, Array, Array]:
        if isinstance(noise, Uniform):
            return np.atleast_1d(noise.at_least), np.atleast_1d(noise.at_most), np.ones(n, int)
        return np.zeros(n), np.full(n, np.inf), np.zeros(n, int)

    w, e = one(model.w, model.nx), one(model.e, model.ny)
    return np.r_[w[0], e[0]], np.r_[w[1], e[1]], np.r_[w[2], e[2]].astype(np.int64)


def _bounded_point(model: Linear, record: Record) -> Estimate:
    """Return the trajectory of least excess over the bounds."""
    return (SequentialLP() if model.theta_entries else BatchLP()).run(bounded_only(model), record)


def _start(model: Linear, record: Record, rows: Rows) -> tuple[Array, Array, Array] | None:
    """Return a trajectory inside all bounds (N,), theta, and the standard deviation of each row (K,); or None."""
    floor, cap, kind = _ends(model)
    bounded = bounded_only(model)
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
