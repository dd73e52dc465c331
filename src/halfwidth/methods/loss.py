"""Filters and smoothers for outputs that may have been lost without a word: BKF-I, BKF-II and what is better.

Given which samples were received everything is Gaussian, so the belief is a mixture of Kalman filters, one component
for each history of losses [1]_. Each row splits every component into received and lost, weighs the parts in the log
domain by how well they explain the output,

    log-odds of reception = log p / (1 - p) + log N(y; C x-, C P- C' + R) - log N(y; d, R_lost),

and the methods differ in how they bring the number of components down again: by a hard decision (`BKF1`), by averaging
(`BKF2`, `GPB`), by chance (`RBPF`, `FearnheadClifford`), by merging what is close (`Runnalls`), or by keeping the
likeliest histories (`BeamSearch`). Known losses (NaN, or a probability of 0 or 1) reduce each to the intermittent
Kalman filter. The paper's ``x_{k+1} = A x_k + w_k`` is shifted to our t; see `prior`.

References
----------
.. [1] Zhang and You (2016), Kalman filtering with unknown sensor measurement losses, IFAC-PapersOnLine.
.. [2] Fearnhead and Clifford (2003), J. Royal Statistical Society B 65.
.. [3] Runnalls (2007), IEEE Transactions on Aerospace and Electronic Systems 43(3).
.. [4] Kim (1994), J. Econometrics 60: the backward pass of the smoothers.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

import halfwidth._core as _core
from halfwidth.errors import BadValue, Refused, hinted
from halfwidth.loss import Bernoulli, Loss, Markov
from halfwidth.methods._loss_law import learn, updated
from halfwidth.methods._loss_rows import Rows, about, linear_rows, outputs_and_modes, received
from halfwidth.methods._loss_stream import LossStream
from halfwidth.methods._protocol import typed
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.noise import Gaussian, unknown_variances
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Normal

#: Rules of the kernel, core/loss.hpp.
_DECIDE, _AVERAGE, _SAMPLE, _RESAMPLE, _MERGE, _BEAM = range(6)
_OK, _VOID, _BAD_NOISE, _NOT_FINITE = range(4)
_MOST_CELLS = 4096
_MOST_BYTES = 4 << 30

Prior = Literal["filtered", "predicted"]


@dataclass(frozen=True)
class LossMethod:
    """What the methods share: what they refuse, and the way to the kernel and back."""

    _: dataclasses.KW_ONLY
    prior: Prior = "filtered"

    _rule: ClassVar[int]
    _smooths: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.prior not in ("filtered", "predicted"):
            raise BadValue(f'`prior` is {self.prior!r}, "filtered" or "predicted" was expected')
        for name in ("particles", "components", "width", "iterations"):
            _whole(self, name, 1)
        _whole(self, "depth", 0)
        if getattr(self, "lag", None) is not None:
            _whole(self, "lag", 1)

    @property
    def _smoothing(self) -> bool:
        return bool(getattr(self, "smooth", False)) or getattr(self, "lag", None) is not None

    @property
    def _settings(self) -> dict[str, Any]:
        """Settings of the kernel beside the model."""
        return {
            "rule": self._rule,
            "components": next(
                (int(getattr(self, n)) for n in ("particles", "components", "width") if hasattr(self, n)), 1
            ),
            "depth": int(getattr(self, "depth", 0)),
            "spread": bool(getattr(self, "spread", True)),
            "threshold": float(getattr(self, "threshold", 0.5)),
        }

    def refuses(self, model: Model) -> str | None:
        """Return why the method cannot work on this model, with a hint, or None."""
        name = type(self).__name__
        for symbol, noise in (("w", model.w), ("e", model.e)):
            if not isinstance(noise, Gaussian):
                return (
                    f"`{name}` needs Gaussian noise but `{symbol}` is {type(noise).__name__}\n"
                    "hint: use `model.as_gaussian()`"
                )
        if (reason := unknown_variances(model.w, model.e, name)) is not None:
            return reason
        if not isinstance(model.x0, Normal):
            return (
                f"`{name}` needs a Gaussian prior but `x0` is a box\nhint: x0=Normal(mean, P), or `model.as_gaussian()`"
            )
        if model.bounds is not None:
            return f"`{name}` knows no bounds on the state\nhint: Constrained({name}()), or leave `bounds` away"
        if isinstance(model, Linear) and model.theta_entries:
            return f"`{name}` needs a known model but it has unknown entries\nhint: put numbers in place of NaN"
        R = model.e.cov()
        if R.value is not None and np.any(np.linalg.eigvalsh(R.value)[..., 0] <= 0):
            return (
                f"`{name}` judges an output by its density, so the covariance of `e` must be positive definite\n"
                "hint: add the rounding of the outputs to the variances of `e`"
            )
        loss = model.loss
        if loss is None:
            return None
        if not isinstance(loss, Bernoulli | Markov):
            return f"`{name}` does not know the loss {loss!r}\nhint: loss=Bernoulli(0.7) or loss=Markov(0.95, 0.85)"
        modes = len(loss.patterns(len(loss.groups(model.ny))))
        cells = (
            modes ** (self._settings["depth"] + 1) if self._rule == _AVERAGE else modes * self._settings["components"]
        )
        if self._rule in (_AVERAGE, _MERGE) and cells > _MOST_CELLS:
            return f"`{typed(self)}` would carry {cells} components, at most {_MOST_CELLS} are possible\nhint: {name}()"
        if self._rule == _MERGE and self._settings["components"] < modes and isinstance(loss, Markov):
            return (
                f"`{typed(self)}` needs a component for each of the {modes} modes\nhint: {name}(components={2 * modes})"
            )
        if loss.unknown_noise and len(loss.groups(model.ny)) > 1:
            return (
                f"`{name}` learns the covariance of lost samples of one sensor, and the model has several\n"
                "hint: learn_noise=False, with noise=... where it is known"
            )
        if not loss.known:
            if self._rule == _AVERAGE and self._settings["depth"] == 0 and isinstance(loss, Markov):
                return (
                    f"`{name}` forgets what it must count to learn the loss\nhint: use `GPB(depth=1)`, or give the law"
                )
            if self._smoothing and self._rule != _AVERAGE:
                return f"`{name}` cannot learn the loss while it smooths\nhint: use `GPB(depth=3, smooth=True)`"
        return None

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:
        """Estimate the states of one record, and which samples were received.

        Parameters
        ----------
        model : Linear or Nonlinear
            With Gaussian noise, a Gaussian prior and a `loss`; without one every seen output counts as received.
        record : Record
        seed : int, optional
            Seed of the methods that draw; 0 if absent.

        Returns
        -------
        Estimate
            With ``gamma``, the probability that each output was received: (T,) for one sensor, (T, ny) for several, 0
            where it is missing. ``info`` holds ``lost_as`` (probability of each kind of loss, shaped as gamma) and,
            where the law was learned, ``loss`` and its path.

        Raises
        ------
        Refused, BadValue
        """
        reason = self.refuses(model)
        if reason is not None:
            message, hint = hinted(reason)
            raise Refused(message, hint=hint)
        number = 0 if seed is None else int(seed)
        loss = model.loss
        learned: dict[str, Any] = {}
        if isinstance(model, Linear):
            rows = linear_rows(model, record)
            if loss is not None and not loss.known and self._smoothing:
                loss, learned = learn(loss, lambda law: self._kernel(rows, law, model, record, number))
            out = self._kernel(rows, loss, model, record, number)
        else:
            rows = self._linearised(model, record, number)
            for _ in range(1 + (int(getattr(self, "iterations", 1)) if self._smoothing else 0)):
                if loss is not None and not loss.known and self._smoothing:
                    loss, learned = learn(model.loss, lambda law, r=rows: self._kernel(r, law, model, record, number))
                out = self._kernel(rows, loss, model, record, number)
                if not self._smoothing:
                    break
                rows = about(model, record, rows, out["x"])
        return self._estimate(model, record, loss, out, {"seed": number} | learned)

    def stream(self, model: Model, t: float = 0.0) -> LossStream:
        """Return the online form, which `halfwidth.stream` wraps; methods that draw use the seed 0.

        Raises
        ------
        Refused
            If the method smooths or the model varies in another way than with the step.
        """
        return LossStream(self, model, t=t)

    def _kernel(self, rows: Rows, loss: Loss | None, model: Model, record: Record, seed: int) -> dict[str, Any]:
        y, modes = outputs_and_modes(rows, loss, record)
        n, M = model.nx, modes.C.shape[1]
        smooth, lag = 0, 0
        if self._smoothing:
            given = getattr(self, "lag", None)
            smooth, lag = (1, 0) if given is None else (2, int(given))
            cells = 1 if self._rule == _DECIDE else M ** (self._settings["depth"] + 1)
            size = (len(record) if smooth == 1 else lag + 1) * cells * (1 + n + n * n) * 8
            if size > _MOST_BYTES:
                raise BadValue(
                    f"smoothing {len(record)} rows with {cells} components needs {size / 2**30:.1f} GiB",
                    hint=f"{type(self).__name__}(depth={self._settings['depth']}, lag=5) keeps only the lag",
                )
        learn_law = 0 if loss is None or loss.known or smooth else 1 if isinstance(loss, Bernoulli) else 2
        out: dict[str, Any] = _core.loss_filter(
            rows.A, rows.b, rows.Q, modes.C, modes.d, modes.R, modes.Pi, y, record.seen, model.x0.mean, model.x0.P,  # type: ignore[union-attr]
            modes.pi0, modes.prior,
            groups=1 if loss is None else len(loss.groups(record.ny)), learn=learn_law, seed=seed,
            prior_predicted=self.prior == "predicted", smooth=smooth, lag=lag, **self._settings,
        )  # fmt: skip
        if out["code"] == _BAD_NOISE:
            raise BadValue(
                f"the covariance of `e` or of a lost sample is singular at t = {record.t[out['bad_row']]:.6g} s",
                hint="add the rounding of the outputs to the variances of `e`",
            )
        return out | {"y": y, "seen": record.seen, "R0": modes.R[0, 0]}

    def _estimate(
        self, model: Model, record: Record, loss: Loss | None, out: dict[str, Any], info: dict[str, Any]
    ) -> Estimate:
        gamma, lost_as = received(loss, out["modes"], record.seen)
        info |= {"lost_as": lost_as, "increments": out["loglik"], "smoothed": self._smoothing}
        if "law" in out:
            info |= {"law": out["law"], "loss": updated(loss, out["law"][-1])}
        status = Status.OK
        if out["code"] == _NOT_FINITE:
            status = Status.COLLAPSED
            info["message"] = (
                f"the numbers overflowed at t = {record.t[out['bad_row']]:.6g} s; later rows repeat the last answer"
            )
        elif out["void_rows"]:
            status = Status.REDUCED
            info["message"] = f"{out['void_rows']} rows could be explained in no way and were left unused"
        return Estimate(
            record.t, out["x"], Normal.of(out["x"], out["P"]), status, typed(self), gamma=gamma,
            loglik=float(out["loglik"].sum()), names=model.names.x, labels=record.labels, info=info,
        )  # fmt: skip

    def _linearised(self, model: Nonlinear, record: Record, seed: int) -> Rows:
        """Filter row by row, linearising about the mixture's mean; return the linear model of every row."""
        stream = LossStream(self._filter(), model, seed=seed)
        dt = record.steps(model.dt)
        rows = [
            stream.linear_row(record.y[k], None if record.u is None else record.u[k], float(dt[k]))
            for k in range(len(record))
        ]
        A, b, Q, C, R, d = (np.ascontiguousarray(np.stack(part)) for part in zip(*rows, strict=True))
        return Rows(A, b, Q, C, R, d)

    def _filter(self) -> "LossMethod":
        """Return the method without smoothing."""
        changes = {"smooth": False, "lag": None}
        kept: dict[str, Any] = {k: v for k, v in changes.items() if hasattr(self, k)}
        return dataclasses.replace(self, **kept)


@dataclass(frozen=True)
class BKF1(LossMethod):
    """Bayesian Kalman filter I: decide for each row whether it was received, then filter as if that were known.

    Zhang and You (2016), (5) and (6). The decision maximises the posterior of this row's loss given the decisions
    before, so it is a beam search of width one. A tie counts as lost.

    Parameters
    ----------
    smooth : bool
        Smooth over the decisions taken.
    lag : int, optional
        Smooth each row with this many later rows only.
    prior : {"filtered", "predicted"}
        Whether ``x0`` is the state one step before the first row, or the prediction of the first row itself.

    Examples
    --------
    >>> import halfwidth as hw
    >>> noise = {"w": hw.Gaussian(0.1), "e": hw.Gaussian(1.0), "x0": hw.Normal([9.0], 1.0)}
    >>> walk = hw.Linear([[1]], None, [[1]], **noise, loss=hw.Bernoulli(0.7))
    >>> hw.estimate(walk, hw.Record([0.0, 1.0, 2.0], [9.2, -0.3, 8.9]), BKF1()).gamma
    array([1., 0., 1.])
    """

    smooth: bool = False
    lag: int | None = None
    _rule = _DECIDE
    _smooths = True


@dataclass(frozen=True)
class BKF2(LossMethod):
    """Bayesian Kalman filter II: weigh the correction by the probability that the row was received.

    Mean ``x- + p K e``, between the Kalman filter (p = 1) and the prediction (p = 0). The text of Zhang and You (2016)
    at hand ends before its covariance, so both readings are here.

    Parameters
    ----------
    spread : bool
        True: covariance ``P- - p K C P- + p (1 - p) K e e' K'``, the second moment of the two-part posterior. False:
        without its last term.
    smooth, lag, prior
        As for `BKF1`; smoothing leaves the probabilities of reception as the filter found them.
    """

    spread: bool = True
    smooth: bool = False
    lag: int | None = None
    _rule = _AVERAGE
    _smooths = True


@dataclass(frozen=True)
class GPB(LossMethod):
    """Generalised pseudo-Bayes: one component for each of the last `depth` losses, partners merged by moments.

    ``2**depth`` components; exact for the first ``depth + 1`` rows, close to exact from depth 3 on (``halfwidth
    reproduce 001`` prints how close). Depth 0 is `BKF2`, depth 1 is what the literature calls GPB2.

    Parameters
    ----------
    depth : int
    smooth : bool
        Smooth states and probabilities of reception (Kim's backward pass; take a depth of 5 to 8). With a loss law
        that is not known this learns it by expectation maximisation.
    lag : int, optional
        Smooth each row with this many later rows only; 3 gains nearly everything for the probabilities.
    iterations : int
        For `Nonlinear` models, how often the smoother is linearised anew about its own answer.
    prior
        As for `BKF1`.

    Examples
    --------
    >>> import halfwidth as hw
    >>> noise = {"w": hw.Gaussian(0.1), "e": hw.Gaussian(1.0), "x0": hw.Normal([9.0], 1.0)}
    >>> walk = hw.Linear([[1]], None, [[1]], **noise, loss=hw.Bernoulli(0.7))
    >>> hw.estimate(walk, hw.Record([0.0, 1.0, 2.0], [9.2, -0.3, 8.9]), GPB(depth=2, smooth=True)).gamma.round(3)
    array([1., 0., 1.])
    """

    depth: int = 1
    smooth: bool = False
    lag: int | None = None
    iterations: int = 1
    _rule = _AVERAGE
    _smooths = True


@dataclass(frozen=True)
class RBPF(LossMethod):
    """Rao-Blackwellised particle filter: losses are sampled, states are Kalman filtered.

    Each particle draws its loss from the optimal proposal, ``P(received | its history, y)``; its weight does not
    depend on the draw, and the answer is formed before the draw, so it carries no noise of this row's draw.
    Systematic resampling when the effective number of particles falls below `threshold` of all.

    Parameters
    ----------
    particles : int
    threshold : float
    prior
        As for `BKF1`.

    Raises
    ------
    BadValue
        If a setting is out of its domain.
    """

    particles: int = 100
    threshold: float = 0.5
    _rule = _SAMPLE

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.threshold <= 1.0:
            raise BadValue(f"`threshold` is {self.threshold!r}, a number from 0 to 1 was expected")


@dataclass(frozen=True)
class FearnheadClifford(LossMethod):
    """Particle filter for discrete losses: all children of all particles, thinned without bias.

    Children above a weight c stay as they are, the others survive with probability w / c and then weigh c [2]_. No two
    particles are alike, so the same number of them lies nearer to the posterior than with `RBPF`.

    Parameters
    ----------
    particles : int
    prior
        As for `BKF1`.
    """

    particles: int = 100
    _rule = _RESAMPLE


@dataclass(frozen=True)
class Runnalls(LossMethod):
    """Mixture of Kalman filters whose closest components are merged, by Runnalls' bound on the divergence.

    The most accurate for its number of components, above all in long ambiguous bursts; slower than `GPB`.

    Parameters
    ----------
    components : int
    prior
        As for `BKF1`.
    """

    components: int = 8
    _rule = _MERGE


@dataclass(frozen=True)
class BeamSearch(LossMethod):
    """Keep the likeliest histories of losses; width 1 is `BKF1`.

    Pruning forgets what merging would keep: for the state `GPB` is better at the same cost. This one is for the most
    probable history.

    Parameters
    ----------
    width : int
    prior
        As for `BKF1`.
    """

    width: int = 8
    _rule = _BEAM


def _whole(method: Any, name: str, least: int) -> None:
    """Check a setting that counts something."""
    value = getattr(method, name, least)
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise BadValue(f"`{name}` is {value!r}, a whole number from {least} was expected")
