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
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.derivative import differences
from halfwidth.errors import BadRecord, BadValue, HalfwidthError, Refused
from halfwidth.loss import Bernoulli, Loss, Markov, Modes, revised
from halfwidth.methods._protocol import typed
from halfwidth.model import Linear, Model, Nonlinear, arity
from halfwidth.noise import Gaussian, unknown_variances
from halfwidth.record import Record
from halfwidth.result import Estimate, Newest, Status
from halfwidth.spread import Normal

#: Rules of the kernel, core/loss.hpp.
_DECIDE, _AVERAGE, _SAMPLE, _RESAMPLE, _MERGE, _BEAM = range(6)
_OK, _VOID, _BAD_NOISE, _NOT_FINITE = range(4)
_CLIP = 1e-6
_MOST_CELLS = 4096
_MOST_BYTES = 4 << 30

Prior = Literal["filtered", "predicted"]


class _Rows(NamedTuple):
    """A linear model laid out for the rows of one record."""

    A: Array  # (1 or T, nx, nx)
    b: Array | None  # (T, nx)
    Q: Array  # (1 or T, nx, nx)
    C: Array  # (1 or T, ny, nx)
    R: Array  # (1 or T, ny, ny)
    d: Array | None  # (T, ny) what the output adds to C x


@dataclass(frozen=True)
class _LossMethod:
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
            message, _, hint = reason.partition("\nhint: ")
            raise Refused(message, hint=hint or None)
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
                rows = _about(model, record, rows, out["x"])
        return self._estimate(model, record, loss, out, {"seed": number} | learned)

    def stream(self, model: Model, t: float = 0.0) -> "LossStream":
        """Return the online form, which `halfwidth.stream` wraps; methods that draw use the seed 0.

        Raises
        ------
        Refused
            If the method smooths or the model varies in another way than with the step.
        """
        return LossStream(self, model, t=t)

    def _kernel(self, rows: _Rows, loss: Loss | None, model: Model, record: Record, seed: int) -> dict[str, Any]:
        y, modes = _modes(rows, loss, record)
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
            info |= {"law": out["law"], "loss": _now(loss, out["law"][-1])}
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

    def _linearised(self, model: Nonlinear, record: Record, seed: int) -> _Rows:
        """Filter row by row, linearising about the mixture's mean; return the linear model of every row."""
        stream = LossStream(self._filter(), model, seed=seed)
        dt = record.steps(model.dt)
        rows = [
            stream.linear_row(record.y[k], None if record.u is None else record.u[k], float(dt[k]))
            for k in range(len(record))
        ]
        A, b, Q, C, R, d = (np.ascontiguousarray(np.stack(part)) for part in zip(*rows, strict=True))
        return _Rows(A, b, Q, C, R, d)

    def _filter(self) -> "_LossMethod":
        """Return the method without smoothing."""
        changes = {"smooth": False, "lag": None}
        kept: dict[str, Any] = {k: v for k, v in changes.items() if hasattr(self, k)}
        return dataclasses.replace(self, **kept)


@dataclass(frozen=True)
class BKF1(_LossMethod):
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
class BKF2(_LossMethod):
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
class GPB(_LossMethod):
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
class RBPF(_LossMethod):
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
    """

    particles: int = 100
    threshold: float = 0.5
    _rule = _SAMPLE

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.threshold <= 1.0:
            raise BadValue(f"`threshold` is {self.threshold!r}, a number from 0 to 1 was expected")


@dataclass(frozen=True)
class FearnheadClifford(_LossMethod):
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
class Runnalls(_LossMethod):
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
class BeamSearch(_LossMethod):
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


# ---- model and record to the kernel's arrays -------------------------------------------------------------------------


def linear_rows(model: Linear, record: Record) -> _Rows:
    """Lay out a linear model for the rows of a record, with E and F multiplied out."""
    dt = record.steps(model.dt)
    of = {name: _stacked(matrix.stack(record.t, dt)) for name, matrix in model.matrices.items()}
    A: Any = of["A"]
    C: Any = of["C"]
    b: Any = None
    Q, R = (_stacked(noise.cov().stack(record.t, dt)) for noise in (model.w, model.e))
    if record.u is not None:
        b = np.einsum("tij,tj->ti", np.broadcast_to(of["B"], (len(record), *of["B"].shape[1:])), record.u)
    if "E" in of:
        A, Q = np.linalg.solve(of["E"], A), _unmixed(of["E"], Q)
        b = None if b is None else np.linalg.solve(of["E"], b[..., None])[..., 0]
    if "F" in of:
        C, R = np.linalg.solve(of["F"], C), _unmixed(of["F"], R)
    inputs = None if b is None else np.ascontiguousarray(b)
    return _Rows(
        np.ascontiguousarray(A), inputs, np.ascontiguousarray(Q), np.ascontiguousarray(C), np.ascontiguousarray(R), None
    )


def _stacked(found: tuple[Array, NDArray[np.int32] | None]) -> Array:
    stack, index = found
    return stack if index is None else stack[index]


def _unmixed(E: Array, Q: Array) -> Array:
    """Return E^-1 Q E^-T."""
    half = np.linalg.solve(E, Q)
    out = np.linalg.solve(E, np.swapaxes(half, -1, -2))
    return np.asarray(0.5 * (out + np.swapaxes(out, -1, -2)))


def _modes(rows: _Rows, loss: Loss | None, record: Record) -> tuple[Array, Modes]:
    """Return outputs without NaN and the modes of every row."""
    y = np.where(record.seen, record.y, 0.0)
    if loss is None:
        one = np.ones((1, 1, 1))
        d = None if rows.d is None else rows.d[:, None]
        carries = np.ones((1, record.ny), dtype=bool)
        return y, Modes(rows.C[:, None], d, rows.R[:, None], one, one[0, 0], None, carries)
    modes = loss.modes(rows.C, rows.R, record.y, record.seen)
    if rows.d is not None:
        base = 0.0 if modes.d is None else modes.d
        modes = modes._replace(d=np.ascontiguousarray(np.where(modes.carries, rows.d[:, None] + base, base)))
    return y, modes


def received(loss: Loss | None, modes: Array, seen: NDArray[np.bool_]) -> tuple[Array | None, Mapping[str, Array]]:
    """Return gamma and the probability of each kind of loss from those of the modes, (T, M)."""
    ny = seen.shape[1]
    if loss is None:
        return np.asarray(seen.any(axis=1), dtype=np.float64), {}
    groups = loss.groups(ny)
    patterns = loss.patterns(len(groups))

    def of(state: int) -> Array:
        p = np.clip(modes @ (patterns == state), 0.0, 1.0)
        if len(groups) == 1:
            return np.where(seen.any(axis=1), p[:, 0], 0.0)
        out = np.empty(seen.shape)
        for g, members in enumerate(groups):
            out[:, list(members)] = p[:, [g]]
        return np.where(seen, out, 0.0)

    return of(len(loss.kind)), {kind: of(k) for k, kind in enumerate(loss.kind)}


# ---- the loss law, learned -------------------------------------------------------------------------------------------


def learn(loss: Any, smooth: Any, *, iterations: int = 50, tolerance: float = 1e-4) -> tuple[Any, dict[str, Any]]:
    """Learn a loss law, and the noise of lost samples where asked, by expectation maximisation.

    Parameters
    ----------
    loss : Bernoulli or Markov
        Made with ``unknown``; its numbers are the start, its `worth` the prior (2 at one half is flat).
    smooth : function (loss) -> kernel's answer
        With `modes`, `pairs`, `loglik`, and the record under "y", "seen".
    iterations : int
    tolerance : float
        Stop when no probability moves by more.

    Returns
    -------
    loss : Bernoulli or Markov
    info : dict
        ``loss``, ``loglik_path``, ``iterations``, ``converged``.
    """
    prior = loss
    path: list[float] = []
    converged = False
    for _ in range(iterations):
        out = smooth(loss)
        path.append(float(out["loglik"].sum()))
        new = _maximised(prior, loss, out)
        moved = max(float(np.max(np.abs(a - b))) for a, b in zip(_numbers(new), _numbers(loss), strict=True))
        loss = new
        if moved < tolerance:
            converged = True
            break
    return loss, {"loss": loss, "loglik_path": np.array(path), "iterations": len(path), "converged": converged}


def _numbers(loss: Any) -> list[Array]:
    numbers = [loss.received] if isinstance(loss, Bernoulli) else [loss.stay_received, loss.stay_lost]
    return numbers + ([loss.noise] if loss.unknown_noise and loss.noise is not None else [])


def _maximised(prior: Any, loss: Any, out: dict[str, Any]) -> Any:
    """Return the loss that the expected counts of a smoother make most probable."""
    seen = out["seen"]
    patterns = loss.received_in(seen.shape[1])  # (M, G)
    counts = np.maximum(prior.prior_counts(patterns.shape[1]) - 1.0, 0.0)  # a flat prior adds nothing
    groups = loss.groups(seen.shape[1])
    law: dict[str, Array] = {}
    if isinstance(loss, Bernoulli):
        there = np.stack([seen[:, list(g)].any(axis=1) for g in groups], axis=1)
        p = np.where(there, out["modes"] @ patterns, 0.0).sum(axis=0) + counts[:, 0, 1]
        total = there.sum(axis=0) + counts[:, 0].sum(axis=-1)
        law["received"] = np.clip(p / np.maximum(total, 1e-300), _CLIP, 1 - _CLIP)
    else:
        pairs = out["pairs"]
        for name, state in (("stay_received", 1), ("stay_lost", 0)):
            before = patterns == bool(state)
            stay = np.einsum("ig,ij,jg->g", before, pairs, before) + counts[:, state, state]
            total = np.einsum("ig,ij->g", before, pairs) + counts[:, state].sum(axis=-1)
            law[name] = np.clip(stay / np.maximum(total, 1e-300), _CLIP, 1 - _CLIP)
    noise = _noise_of_lost(loss, out) if loss.unknown_noise else None
    return revised(loss, noise=noise, **{name: _shaped(value, loss) for name, value in law.items()})


def _shaped(value: Array, loss: Any) -> Array:
    """Return one number a sensor, (G,), as a scalar where one number was given for a single sensor."""
    return value.reshape(()) if len(value) == 1 and not loss.shape else value


def _noise_of_lost(loss: Any, out: dict[str, Any]) -> Array:
    """Return the covariance of lost samples, entries that are missing filled by their conditional moments."""
    y, seen, R0 = out["y"], out["seen"], out["R0"]
    lost = np.where(seen.any(axis=1), out["modes"][:, 0], 0.0)
    ny = y.shape[1]
    total = np.zeros((ny, ny))
    for pattern in np.unique(seen, axis=0):
        rows = (seen == pattern).all(axis=1)
        if not pattern.any() or lost[rows].sum() == 0.0:
            continue
        i, j = np.flatnonzero(pattern), np.flatnonzero(~pattern)
        v = np.zeros((int(rows.sum()), ny))
        v[:, i] = y[np.ix_(rows, i)] - np.broadcast_to(loss.center, (ny,))[i]
        if len(j):
            gain = np.linalg.solve(R0[np.ix_(i, i)], R0[np.ix_(i, j)]).T
            v[:, j] = v[:, i] @ gain.T
            total[np.ix_(j, j)] += lost[rows].sum() * (R0[np.ix_(j, j)] - gain @ R0[np.ix_(i, j)])
        total += np.einsum("t,ti,tj->ij", lost[rows], v, v)
    # one pseudo-sample of the start keeps it positive definite when hardly anything was lost
    return np.asarray((total + R0) / (lost.sum() + 1.0))


def _now(loss: Any, law: Array) -> Any:
    """Return the loss with the law that the filter has learned by its last row; `law` is (G, 2)."""
    if isinstance(loss, Bernoulli):
        return revised(loss, received=_shaped(law[:, 1], loss))
    return revised(loss, stay_received=_shaped(law[:, 1], loss), stay_lost=_shaped(1 - law[:, 0], loss))


# ---- row by row ------------------------------------------------------------------------------------------------------


class _Belief:
    """What one push found, in the form that `halfwidth.result.Newest` reads."""

    __slots__ = ("P", "_loss", "_modes", "_y", "code", "loglik", "rows", "t", "x")

    def __init__(self, stream: "LossStream", found: Any, y: Array) -> None:
        self.x, self.P, self._modes, _, code, _ = found
        self.code = _CODES[code]
        self.rows, self.t, self.loglik = stream.pushed, stream.t, stream.loglik
        self._loss, self._y = stream.model.loss, y

    @property
    def gamma(self) -> Array | None:
        """Probability that y was received."""
        gamma = received(self._loss, self._modes[None], ~np.isnan(self._y)[None])[0]
        return None if gamma is None else gamma[0]


#: Codes of a pushed row: 2 the row was left unused, 3 the numbers left the range of floating point.
_CODES = (0, 2, 2, 3)


class LossStream:
    """A loss-aware filter that holds its belief: push rows, read the newest estimate.

    Parameters
    ----------
    method : BKF1, BKF2, GPB, RBPF, FearnheadClifford, Runnalls or BeamSearch
    model : Linear or Nonlinear
    t : float
        Time of the prior, s.
    seed : int, optional
    """

    def __init__(self, method: _LossMethod, model: Model, *, t: float = 0.0, seed: int | None = None) -> None:
        reason = method.refuses(model)
        if reason is None and method._smoothing:
            reason = f"`{typed(method)}` smooths, a stream filters\nhint: {type(method).__name__}()"
        loss = model.loss
        if reason is None and loss is not None and len(loss.shape) > 1:
            reason = "the loss law is given row by row, a stream does not know which row comes next\nhint: give one law"
        fixed = [m for m in (*_matrices(model), model.w.cov(), model.e.cov()) if m.value is not None and not m.constant]
        if reason is None and fixed:
            reason = f"`{fixed[0].name}` is stacked row by row\nhint: give it as a function of dt"
        if reason is not None:
            message, _, hint = reason.partition("\nhint: ")
            raise Refused(message, hint=hint or None)
        self.method, self.model = method, model
        self._seed = 0 if seed is None else int(seed)
        self.pushed, self.loglik, self.t = 0, 0.0, float(t)
        self._kind = type("NewestLoss", (Newest,), {"__slots__": (), "method": typed(method), "names": model.names.x})
        self._u = isinstance(model, Linear) and model.B is not None
        self._fixed = isinstance(model, Linear) and all(
            m.constant for m in (*_matrices(model), model.w.cov(), model.e.cov())
        )
        self._stale = loss is not None and "stale" in loss.kind
        self._quick = self._fixed and not self._stale
        self._none = np.full(model.ny, np.nan)
        self._shape = (model.ny,)
        self._last = np.full(model.ny, np.nan)
        self._x = np.array(model.x0.mean)
        self._P = np.array(model.x0.P)  # type: ignore[union-attr]
        self._B: Array | None = None
        self._modes: Modes | None = None
        self._core: Any = None

    def _begin(self, modes: Modes) -> Any:
        """Return the kernel's object, at the prior."""
        model, loss = self.model, self.model.loss
        return _core.LossStream(
            n=model.nx, m=model.ny, modes=modes.C.shape[1], groups=1 if loss is None else len(loss.groups(model.ny)),
            learn=0 if loss is None or loss.known else 1 if isinstance(loss, Bernoulli) else 2, seed=self._seed,
            x0=self._x, P0=self._P, pi0=modes.pi0, count=modes.prior, **self.method._settings,
        )  # fmt: skip

    def push(self, y: Any, u: Any = None, dt: float | None = None) -> Newest:
        """Fold one row in and return the newest estimate.

        Parameters
        ----------
        y : (ny,) array_like
            NaN is a known loss.
        u : (nu,) array_like, optional
        dt : float, optional
            Step since the row before, s; ``model.dt`` if absent.
        """
        row = self._none if y is None else np.array(y, dtype=np.float64, ndmin=1)
        if row.shape != self._shape:
            raise BadRecord(f"`y` is {y!r}, {self.model.ny} numbers were expected; None or NaN is missing")
        step = self.model.dt
        if dt is not None:
            step = float(dt)
            if not 0.0 < step < np.inf:
                raise BadRecord(f"`dt` is {dt!r}, a positive number of seconds was expected")
        try:
            if self._quick and self._modes is not None:
                b = self._input(u) if self._u else None
                found = self._core.push(row, b, self._offset, self.pushed > 0 or self.method.prior == "filtered")
                self._moved(found, step)
            else:
                given = None if u is None else np.array(u, dtype=np.float64, ndmin=1)
                if (0 if given is None else given.size) != self.model.nu:
                    raise BadRecord(f"`u` is {u!r}, {self.model.nu} finite numbers were expected")
                found = self._push_rows(self._prepare(given, step, row), row, step)
        except ValueError as exc:
            if isinstance(exc, HalfwidthError):
                raise
            raise BadRecord(f"`y` is {y!r} and `u` is {u!r}: {exc}") from None
        newest: Newest = object.__new__(self._kind)
        object.__setattr__(newest, "_belief", _Belief(self, found, row))
        return newest

    def linear_row(self, y: Array, u: Array | None, dt: float) -> tuple[Array, ...]:
        """Push a row and return the linear model (A, b, Q, C, R, d) that it was filtered with."""
        rows = self._prepare(u, dt, y)
        self._push_rows(rows, y, dt)
        return rows.A[0], rows.b[0], rows.Q[0], rows.C[0], rows.R[0], rows.d[0]  # type: ignore[index]

    def snapshot(self) -> bytes:
        """Return everything a later process needs to go on."""
        head = np.concatenate([[self.pushed, self.t, self.loglik], self._last, self._x, self._P.ravel()])
        return bytes(head.tobytes() + self._core.state())

    def restore(self, saved: bytes) -> None:
        """Go on from a state of the same model and method.

        Raises
        ------
        ValueError
            If it belongs to another.
        """
        n, ny = self.model.nx, self.model.ny
        size = 8 * (3 + ny + n + n * n)
        if len(saved) <= size:
            raise ValueError(f"it has {len(saved)} bytes, more than {size} were expected")
        head = np.frombuffer(saved[:size])
        if self._modes is None:
            self._set(self._prepare(None, self.model.dt), np.zeros(ny))
        self._core.restore(saved[size:])
        self.pushed, self.t, self.loglik = int(head[0]), float(head[1]), float(head[2])
        self._last, self._x = head[3 : 3 + ny].copy(), head[3 + ny : 3 + ny + n].copy()
        self._P = head[3 + ny + n :].reshape(n, n).copy()

    def _moved(self, found: Any, dt: float) -> None:
        self.pushed += 1
        self.t += dt
        self.loglik += found[3]
        self._x, self._P = found[0], found[1]

    def _push_rows(self, rows: _Rows, y: Array, dt: float) -> Any:
        modes = self._set(rows, y)
        found = self._core.push(y, None if rows.b is None else rows.b[0], None if modes.d is None else modes.d[0],
                                self.pushed > 0 or self.method.prior == "filtered")  # fmt: skip
        self._last = np.where(np.isnan(y), self._last, y)
        self._moved(found, dt)
        return found

    def _set(self, rows: _Rows, y: Array) -> Modes:
        modes = self._modes_of(rows, y)
        if self._core is None:
            self._core = self._begin(modes)
        self._core.motion(rows.A[0], rows.Q[0])
        self._core.output(modes.C[0], modes.R[0])
        self._core.chain(modes.Pi[-1])
        self._modes, self._offset = modes, None if modes.d is None else np.ascontiguousarray(modes.d[0])
        return modes

    def _modes_of(self, rows: _Rows, y: Array) -> Modes:
        """Return the modes of one row, the values reported before it standing above it."""
        above = [self._last] if self._stale and not np.isnan(self._last).all() else []
        outputs = np.stack([*above, y])
        found = _modes(rows, self.model.loss, Record(np.arange(len(outputs), dtype=np.float64), outputs))[1]
        return found._replace(d=None if found.d is None else found.d[-1:])

    def _input(self, u: Any) -> Array:
        given = np.array([] if u is None else u, dtype=np.float64, ndmin=1)
        if given.shape != (self.model.nu,) or not np.isfinite(given).all():
            raise BadRecord(f"`u` is {u!r}, {self.model.nu} finite numbers were expected", hint="push(y, u)")
        return np.ascontiguousarray(self._B @ given)  # type: ignore[operator]

    def _prepare(self, u: Array | None, dt: float, y: Array | None = None) -> _Rows:
        """Return the linear model of one row; a `Nonlinear` one is linearised about the mixture's mean."""
        model = self.model
        if isinstance(model, Linear):
            inputs = np.zeros((1, model.nu)) if u is None else u[None]
            at = np.array([self.t + dt])
            record = Record(at, np.zeros((1, model.ny)), inputs if model.B is not None else None)
            rows = linear_rows(dataclasses.replace(model, dt=dt), record)
            if self._u and self._B is None:
                unit = Record(np.arange(model.nu) + at, np.zeros((model.nu, model.ny)), np.eye(model.nu))
                if self._fixed:
                    self._B = np.ascontiguousarray(linear_rows(model, unit).b.T)  # type: ignore[union-attr]
            return rows
        u = np.zeros(model.nu) if u is None else u
        moves = self.pushed > 0 or self.method.prior == "filtered"
        return _tangent(
            model, self._x if moves else None, self._x, np.sqrt(np.diagonal(self._P)), u, dt, self.t + dt, y
        )


def _whole(method: Any, name: str, least: int) -> None:
    """Check a setting that counts something."""
    value = getattr(method, name, least)
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise BadValue(f"`{name}` is {value!r}, a whole number from {least} was expected")


def _matrices(model: Model) -> list[Any]:
    return list(model.matrices.values()) if isinstance(model, Linear) else []


def _tangent(
    model: Nonlinear,
    before: Array | None,
    at: Array | None,
    scale: Array,
    u: Array | None,
    dt: float,
    t: float,
    y: Array | None,
) -> _Rows:
    """Return the model linearised about the state `before` the step and the state `at` the output.

    Without `before` the row has no step; the output is linearised about the predicted state unless the smoother knows
    better and passes `at` together with `before` of the row above.
    """
    n = model.nx
    if before is None:
        assert at is not None
        A, b, x = np.eye(n), np.zeros(n), at
    else:
        moved = model.move(before, u, dt)
        if model.g_x is None:
            A = differences(lambda v: model.move(v, u, dt), before, _lengths(scale, before), model.x_angles)
        else:
            A = np.asarray(model.g_x(*(before, u, dt)[: arity(model.g_x, 3)]), dtype=np.float64)
        b = moved - A @ before
        x = moved if at is before or at is None else at
    out = model.output(x)
    if model.h_x is None:
        C = differences(model.output, x, _lengths(scale, x), model.y_angles)
    else:
        C = np.asarray(model.h_x(x), dtype=np.float64)
    d = out - C @ x
    if y is not None and model.y_angles:  # an angle is compared on the branch nearest to the prediction
        i = list(model.y_angles)
        away = np.nan_to_num(y[i] - out[i])
        d[i] += away - (np.remainder(away + np.pi, 2 * np.pi) - np.pi)
    Q, R = (noise.cov().at(t, dt) for noise in (model.w, model.e))
    return _Rows(*(np.ascontiguousarray(a)[None] for a in (A, b, Q, C, R, d)))


def _lengths(scale: Array, x: Array) -> Array:
    """Return steps for differences: standard deviations, but never so short that rounding rules."""
    return np.maximum(scale, 1e-3 * np.maximum(np.abs(x), 1e-3))


def _about(model: Nonlinear, record: Record, rows: _Rows, x: Array) -> _Rows:
    """Linearise every row about smoothed states, (T, nx)."""
    dt = record.steps(model.dt)
    scale = np.maximum(np.abs(x).max(axis=0), 1.0) * 1e-2
    first = np.all(rows.A[0] == np.eye(model.nx)) and np.all(rows.b[0] == 0)  # type: ignore[index]
    found = []
    for k in range(len(record)):
        before = None if k == 0 and first else np.array(model.x0.mean) if k == 0 else x[k - 1]
        u = None if record.u is None else record.u[k]
        found.append(_tangent(model, before, x[k], scale, u, float(dt[k]), float(record.t[k]), record.y[k]))
    return _Rows(*(np.concatenate(part) for part in zip(*found, strict=True)))
