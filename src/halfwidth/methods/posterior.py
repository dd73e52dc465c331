"""Posterior: mean and credible intervals over states, half-widths and unknown entries, by expectation propagation.

The joint mode of states and half-widths drives half-widths to zero; the posterior integrates the states out. Every
factor of the model acts on one linear functional of the trajectory: a row of the dynamics, a seen output, a bound.
Expectation propagation replaces each by a Gaussian with the moments it leaves (core/ep.hpp), at the price of a few
smoother passes. Its evidence log Z finds what is unknown:

    p(s | y) ~ Z(s) p(s),    p(log s) = s^power told(s),    told^2 = mean (1 - posterior / prior variance of a row)^2

Staying inside `bounds` is an event that small half-widths make likely: over many rows it would shrink them. So beyond
26 rows bounds are a condition: Z is divided by the evidence that the bounds alone have (core/ep_learn.hpp).
The prior has no scale: where a noise drowns in the others told ~ s^2 and the prior falls to 0, where it is seen told
is 1 and the prior is a power. `power` is what a study of coverage gave in windows of 6, 26 and 51
rows (benchmarks/posterior.py).
Weighted nodes carry what is not known of s into the intervals: stages of normal points, the first about the mode,
each later one with the moments of all before it, weighted by evidence over the mixture of the stages
(core/ep_learn.hpp). The evidence of a node has what expectation propagation leaves out of it to second order, without
which half-widths are learned with a bias. First-order corrections of skewness and kurtosis bend the Gaussian marginals
to the light tails that bounded noise has.

References
----------
Minka (2001), Expectation propagation for approximate Bayesian inference, UAI. Opper, Paquet and Winther (2013),
Perturbative corrections for approximate inference in Gaussian latent variable models, JMLR 14. Durbin and Koopman
(2001), ch. 4: the disturbance smoother that gives every cavity. Cornuet, Marin, Mira and Robert (2012), Adaptive
multiple importance sampling, Scandinavian Journal of Statistics 39. Model: Pavelková and Kárný (2013), eqs. (1), (2).
"""

import functools
import math
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Literal

import numpy as np

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.errors import BadShape, BadValue
from halfwidth.loss import Bernoulli
from halfwidth.methods._answer import Answer
from halfwidth.methods._carry import Carried, Known, Start, condition
from halfwidth.methods._noise_parts import gaussian_part, uniform_part, unknowns
from halfwidth.methods._sites import Frame, Sites, frames_of, sites
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.noise import Gaussian
from halfwidth.record import Record
from halfwidth.result import Estimate

#: Power of the half-widths' prior; see above.
POWER = 0.4
#: Nodes of a stage, and most stages (core/ep_learn.hpp).
_STAGE, _STAGES = 16, 8
#: Power of a half-width in which its posterior is nearly Gaussian: 0 is no tail there.
WARP = 0.5
#: Numbers that the beliefs of all nodes may take up; one stage is always had.
_ROOM = 4e6
#: Of the search and the nodes. A window's nodes lie about the centre that the window before handed on: its own, or the
#: mean of its nodes where that lies further off than `near`, in standard deviations.
_LIMITS = {
    "steps": 14, "few": 2, "many": 6, "most": 5, "tol": 2e-2, "tol_nodes": 2e-2, "close": 0.05, "near": 0.8,
    "least": 2.0, "narrow": 0.03, "damping": 0.7, "warp": WARP, "reference": 1.0,
    "stage": _STAGE, "enough": 0.06, "usable": 0.1,
}  # fmt: skip
#: The evidence of many rows tells half-widths so sharply that its own error, which adds up over the rows, must shrink
#: with them; there is less left to integrate.
_LONG = 2000
_FIRST = 2000
_OF_LONG = {"few": 12, "many": 25, "most": 20, "steps": 30, "narrow": 0.15}
#: A window takes over centre and nodes of the one before, where it would search for its mode, at most so often in a row
#: and in an eighth of its rows.
_AGAIN = 4
#: With everything known there is time for more: at most so many sweeps, to this agreement of moments.
_KNOWN = {"most": 200, "tol_nodes": 1e-7}
#: Outliers and losses have two explanations for a row: their sites move in smaller steps and need more of them.
_MIXED = {"most": 20, "few": 8, "damping": 0.5}
#: Beta prior of a contamination rate that is learned.
_RATE = (1.0, 30.0)
_MOST_STATES = 16
_MOST_UNKNOWN = 16


@dataclass(frozen=True)
class Posterior:
    """Posterior moments of the states, and of the half-widths where they are unknown.

    Parameters
    ----------
    method : {"ep", "sample"}
        Expectation propagation, or draws by Markov chains: slow, and the truth that the first is held against. Draws
        take linear models of uniform or Gaussian noise; ``info["rhat"]`` says whether the chains agree. Their prior of
        a half-width is the power alone, without `told`.
    nodes : int
        Most points over which unknown half-widths are integrated: no more are taken than what is left in doubt asks
        for, and no fewer than six and two for each unknown. With five half-widths of 26 rows 32 leave the means .05
        standard deviations off on average, 128 a seventh of that. 1 takes their mode as if it were the truth.
    outliers : float or bool
        Share of outputs that are outliers, whose noise is ten half-widths wide; True learns it. Each output noise needs
        a bounded part.
    rounds : int
        Most linearisations of a nonlinear model.
    iterations : int
        Most sweeps of one evaluation with everything known.
    draws, chains : int
        Draws kept of each chain, and chains, of "sample".

    Notes
    -----
    Of "sample" the spread is a `Cloud`, and ``info`` has ``rhat``, the largest rank-normalised split R-hat of states,
    half-widths and entries, and ``ess``, their smallest effective number of draws; the status is REDUCED above an R-hat
    of 1.01 and STALLED above 1.05. Of "ep":

    ``q``, ``r`` are posterior means, ``Q``, ``R`` those of unknown variances. ``loglik`` is the logarithm of the
    evidence, half-widths and standard deviations integrated out under a prior one unit of log s wide around their mode,
    so that models with more unknowns do not win by that alone; bounds count as a factor in 26 rows and as a condition
    in the others. In ``info``: ``x0``; ``half_widths``, a mapping with ``mean``, ``sd``, ``lo`` and ``hi`` (5 and 95 %)
    of (q, r); ``variances``, the same of (Q, R) where some are unknown; ``outliers``, the named outputs with a
    probability above one half; ``residual``, the disagreement of moments in standard deviations, the largest of each
    node; ``sweeps``; ``nodes`` and their ``effective`` number.

    Raises
    ------
    BadValue
        If a setting is out of its domain.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Uniform(1.0), hw.Uniform(0.5), hw.Box(-10, 10))
    >>> est = hw.estimate(walk, hw.Record([0.0, 1.0, 2.0], [0.0, None, 2.0]), hw.Posterior())
    >>> est.x[1].round(3)  # the missing one, halfway
    array([1.])
    """

    method: Literal["ep", "sample"] = "ep"
    nodes: int = 32
    outliers: float | bool = False
    rounds: int = 20
    iterations: int = 200
    draws: int = 1000
    chains: int = 4

    def __post_init__(self) -> None:
        if self.method not in ("ep", "sample"):
            raise BadValue(f"`method` is {self.method!r}, 'ep' or 'sample' was expected")
        if not isinstance(self.nodes, int | np.integer) or self.nodes < 1:
            raise BadValue(f"`nodes` is {self.nodes!r}, a positive whole number was expected")
        if not isinstance(self.outliers, bool) and not 0 <= self.outliers < 1:
            raise BadValue(f"`outliers` is {self.outliers!r}, a share from 0 below 1, or True, was expected")
        for name, least in (("rounds", 1), ("iterations", 1), ("draws", 8), ("chains", 1)):
            if not isinstance(getattr(self, name), int | np.integer) or getattr(self, name) < least:
                raise BadValue(f"`{name}` is {getattr(self, name)!r}, a whole number from {least} was expected")

    def refuses(self, model: Model) -> str | None:
        """Return why the model is none of this method, with a hint, or None."""
        reason, hint = self._reason(model)
        return None if reason is None else f"`Posterior` {reason}\nhint: {hint}"

    def _reason(self, model: Model) -> tuple[str | None, str]:
        if self.method == "sample":
            from halfwidth.methods._sample import refuses

            reason = refuses(model)
            if self.outliers:
                reason = "the sampler knows no outliers\nhint: method='ep'"
            why, _, hint = (reason or "").partition("\nhint: ")
            return (f"cannot draw: {why}", hint) if reason else (None, "")
        if model.nx > _MOST_STATES:
            return f"takes at most {_MOST_STATES} states but the model has {model.nx}", "a smaller model"
        unknown = unknowns(model) + (self.outliers is True or (model.loss is not None and not model.loss.known))
        if unknown > _MOST_UNKNOWN:
            return (
                f"finds at most {_MOST_UNKNOWN} half-widths and variances but {unknown} are unknown",
                "BatchLP(), or known ones such as Uniform.unknown(at_least=q, at_most=q)",
            )
        if isinstance(model, Nonlinear) and model.loss is not None:
            return "takes no loss of a nonlinear model", "RBPF() or ParticleFilter()"
        if model.bounds is not None:
            _, lo, hi = model.bounds.rows
            if np.any(lo == hi):
                return "has no equalities among `bounds`", "Constrained(KalmanSmoother()), or a model with fewer states"
        part = gaussian_part(model.e)
        if part is not None and uniform_part(model.e) is not None and not _diagonal(part):
            return "needs independent outputs where noise is mixed but `e` has a full covariance", "variances (ny,)"
        if self.outliers and (uniform_part(model.e) is None or isinstance(model, Nonlinear) or model.loss is not None):
            return (
                "finds outliers of bounded output noise in a linear model without loss",
                "e=Uniform(r) or Uniform(r) + Gaussian(R), or outliers=False",
            )
        if model.loss is not None:
            return self._loss_reason(model)
        if isinstance(model, Linear) and model.theta_entries:
            for entry in model.theta_entries:
                if not model.matrices[entry.matrix].constant:
                    return f"needs constant unknown entries but `{entry.matrix}` varies with time", "a constant matrix"
        return None, ""

    def _loss_reason(self, model: Model) -> tuple[str | None, str]:
        loss = model.loss
        single = isinstance(loss, Bernoulli) and all(len(g) == 1 for g in loss.groups(model.ny))
        if not isinstance(loss, Bernoulli) or loss.kind != ("noise",) or not single or loss.received.size != 1:
            return (
                "takes losses of single outputs with one probability, replaced by noise, but `loss` is "
                f"{loss!r} on {model.ny} outputs",
                "BKF2(), GPB() or RBPF()",
            )
        if getattr(loss, "learn_noise", False) or (isinstance(model, Linear) and model.F is not None):
            return "takes losses of known noise and outputs without `F`", "BKF2() or RBPF()"
        if loss.noise is None and not model.e.known:
            return "needs the noise of lost samples where half-widths are unknown", "Bernoulli(p, noise=...)"
        part = gaussian_part(model.e)
        if part is not None and not _diagonal(part):
            return "needs independent outputs where they may be lost but `e` has a full covariance", "RBPF()"
        return None, ""

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:
        """Estimate the states of one record; `seed` is that of "sample"."""
        if self.method == "sample":
            from halfwidth.methods._sample import sampled

            assert isinstance(model, Linear)
            return sampled(self, model, record, draws=self.draws, chains=self.chains, power=POWER, seed=seed)
        if isinstance(model, Nonlinear):
            from halfwidth.methods._relinearise import relinearised

            return relinearised(self, model, record).estimate
        if model.theta_entries:
            from halfwidth.methods._entries import with_entries

            return with_entries(self, model, record)
        return self.answer(model, record).estimate

    def resumed(
        self, model: Model, record: Record, held: Carried, first: int, drop: int, shaped: int = 0,
        path: Array | None = None,
    ) -> "Answer":  # fmt: skip
        """Return the answer of one window of a stream.

        `held` is what earlier windows handed on, `first` the number of the window's first row, which lies `drop` rows
        after that of the window before; skewness and kurtosis are asked for from stage `shaped` on. `path` are the
        newest states of the window's rows, about which a nonlinear model may be linearised.
        """
        known = held.known(first, len(record))
        if isinstance(model, Nonlinear):
            from halfwidth.methods._relinearise import relinearised

            s = None if held.start is None else held.start.s
            return relinearised(self, model, record, s=s, known=known, path=path)
        return self.answer(model, record, start=held.start, drop=drop, known=known, frames=held.frames, shaped=shaped)

    def answer(
        self,
        model: Linear,
        record: Record,
        *,
        start: Start | Array | None = None,
        drop: int = 0,
        known: Known | None = None,
        frames: dict[bytes, Frame] | None = None,
        shaped: int = 0,
    ) -> "Answer":
        """Return the estimate of a model without unknown entries, and what the next one may start from.

        `start` holds half-widths (p,), with the sites of a chain that begins `drop` rows earlier if there is one;
        `known` is what other rows told of half-widths; `frames` as in `sites`; `shaped` as in `resumed`.
        """
        if isinstance(start, np.ndarray):
            start = Start(start)
        outliers = self.outliers is not False and self.outliers != 0
        if frames is None:
            frames = frames_of(model, record, outliers)
        problem = sites(model, record, outliers=outliers, frames=frames)
        if start is None and len(record) > 2 * _FIRST and problem.free.any():
            # The first rows alone say where to look.
            cut = {k: v.value[:_FIRST] for k, v in model.matrices.items() if v.value is not None and v.value.ndim == 3}
            short: Linear = replace(model, **cut) if cut else model  # type: ignore[arg-type]
            begin = Record(record.t[:_FIRST], record.y[:_FIRST], None if record.u is None else record.u[:_FIRST])
            try:
                quick = replace(self, nodes=1).answer(short, begin)
            except BadShape:  # a noise stacked row by row
                quick = None
            if quick is not None and quick.code < 2:
                start = Start(np.where(quick.chain.free, quick.start.s, problem.guess))
        found, handed, code = self._solve(problem, model, start, drop, known, shaped)
        return Answer(self, model, record, problem, found, handed, code, self._rate(model)[0])

    def _solve(
        self, chain: Sites, model: Linear, start: Start | None, drop: int, known: Known | None, shaped: int
    ) -> tuple[_core.EpFound, _core.EpHanded, int]:
        """Return what the core found, what it hands on, and how it went."""
        data = (
            chain.floor, chain.scale, chain.guess if start is None else start.s,
            chain.m0, chain.P0, chain.half0, chain.b, chain.y,
            None if start is None else start.before, drop, shaped, None if known is None else known.values,
        )  # fmt: skip
        found, handed = self._learner(chain, model, known is None).learn(*data)
        code = found["code"]
        if code == 2 and self.nodes > 1 and found["mode"].size:
            # A mode in the corner of its bounds may have no node inside them: then it stands alone.
            found, handed = self._learner(chain, model, known is None, alone=True).learn(*data)
            code = max(found["code"], 1)
        return found, handed, code

    def _learner(self, chain: Sites, model: Linear, first: bool, alone: bool = False) -> _core.EpFrame:
        """Return the chain as the core takes it, `first` where nothing is known of it yet, `alone` with one node."""
        frame, asked = chain.frame, (self, first, alone, chain.exact)
        learner = frame.learners.get(asked)
        if learner is None:
            learner = frame.learners[asked] = self._made(frame, model, first, alone, chain.exact)
        return learner

    def _made(self, frame: Frame, model: Linear, first: bool, alone: bool, exact: bool) -> _core.EpFrame:
        rate, learn_rate, beta = self._rate(model)
        stages, q = len(frame.problem["start"]) - 1, frame.q + learn_rate
        limits = dict(_LIMITS)
        limits["condition"] = condition(stages - 1) if first else 0.0  # `known` sees to it
        limits["again"] = min((stages - 1) // 8, _AGAIN)
        rows = max(float(frame.count.sum()), 1.0)
        limits["tol"] = min(limits["tol"], 0.3 / math.sqrt(rows))
        limits["tol_nodes"] = min(limits["tol_nodes"], 0.1 / math.sqrt(rows))
        if rows > _LONG:
            limits |= _OF_LONG
        room = int(_ROOM / ((stages + 1) * model.nx * (model.nx + 3)))
        single = q == 0 or self.nodes == 1 or alone
        count = 1 if single else max(min(self.nodes, max(room, _STAGE)), 2 * q + 6)
        if q == 0:
            limits |= _KNOWN | {"most": self.iterations}
        if rate > 0 and q:
            limits |= _MIXED
        if exact:
            limits["most"] = 1
        return _core.EpFrame(
            frame.problem, frame.free, frame.cap, frame.count, frame.fitted, learn_rate, rate,
            math.log(rate / (1 - rate)) if rate > 0 else -14.0, POWER, *beta, nodes(q, count), limits,
            frame.outside if limits["condition"] > 0 else None,
        )  # fmt: skip

    def _rate(self, model: Linear) -> tuple[float, bool, tuple[float, float]]:
        """Return the rate of outliers or losses, whether it is learned, and its prior."""
        loss = model.loss
        if loss is not None:
            lost = 1.0 - float(np.ravel(loss.received)[0])
            if loss.known:
                return min(max(lost, 1e-12), 1 - 1e-12), False, (1.0, 1.0)
            worth = float(loss.worth)
            return min(max(lost, 1e-3), 1 - 1e-3), True, (max(lost * worth, 1e-3), max((1 - lost) * worth, 1e-3))
        if self.outliers is True:
            return 0.01, True, _RATE
        return float(self.outliers), False, (1.0, 1.0)


@functools.lru_cache(maxsize=64)
def nodes(q: int, count: int) -> Array:
    """Return `count` standard normal points (count, q), the same for every window.

    Each stage of them is a piece of one additive recurrence, in pairs z, -z, with the mean 0 and, where there are
    enough of them, the covariance 1.
    """
    if count == 1 or q == 0:
        return np.zeros((1, q))
    root = 2.0
    for _ in range(64):
        root = (1.0 + root) ** (1.0 / (q + 1))
    normal = NormalDist()
    found, at = [], 0
    for size in _stages(count):
        half = (size + 1) // 2
        grid = (0.5 + np.outer(np.arange(at, at + half), root ** -np.arange(1.0, q + 1))) % 1.0
        at += half
        z = np.vectorize(normal.inv_cdf)(np.clip(grid, 1e-6, 1 - 1e-6))
        if half > q:
            z = np.linalg.solve(np.linalg.cholesky(z.T @ z / half), z.T).T
        found.append(np.concatenate([z, -z])[:size])
    return np.ascontiguousarray(np.concatenate(found))


def _stages(count: int) -> list[int]:
    """Return the sizes of the core's stages of so many nodes."""
    sizes: list[int] = []
    while count:
        sizes.append(count if count < 2 * _STAGE or len(sizes) == _STAGES - 1 else _STAGE)
        count -= sizes[-1]
    return sizes


def _diagonal(part: Gaussian) -> bool:
    if not part.known:
        return True
    R = part.cov()
    if not R.constant:
        return False
    return bool(np.count_nonzero(R.single - np.diag(np.diagonal(R.single))) == 0)


__all__ = ["Answer", "Posterior", "Start"]
