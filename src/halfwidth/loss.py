r"""Losses nobody told the estimator about: how often samples are lost, and what arrives in their place.

A loss process belongs to a model (``Linear(..., loss=Bernoulli(0.7))``); a loss that *is* known belongs to the record,
as NaN. Row by row, each sensor either delivers ``C x[t] + e[t]`` or, unflagged, one of these:

====================  ===========================================================================================
``kind="noise"``      pure noise around `center` [1]_; its covariance is `noise`, that of e if absent
``kind="stale"``      the value reported last, again, up to `noise`
``kind="garbage"``    the output plus wide noise: a jump, a multipath fix
====================  ===========================================================================================

Sensors are groups of outputs that are lost together; all outputs are one sensor unless `received` has an entry each.
What the kernel makes of a loss process is in `halfwidth.methods._loss_modes`.

References
----------
.. [1] Zhang and You (2016), Kalman filtering with unknown sensor measurement losses, IFAC-PapersOnLine.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.array import Array, covariance, frozen, real
from halfwidth.errors import BadShape, BadValue
from halfwidth.model import Linear, Model

KINDS = ("noise", "stale", "garbage")
#: Covariance of a lost sample relative to the diagonal of R, where `noise` is absent.
_STALE, _GARBAGE = 1e-6, 1e4
_MOST_MODES = 64


@dataclass(frozen=True, eq=False)
class _Loss:
    """What Bernoulli and Markov losses share: kinds, noise and sensors."""

    kind: tuple[str, ...]
    noise: Array | None
    noise_of: Mapping[str, Array]
    center: Array
    sensors: tuple[tuple[int, ...], ...] | None
    worth: float | None
    unknown_noise: bool

    @property
    def known(self) -> bool:
        """Whether the law is given; otherwise its numbers are the prior's means."""
        return self.worth is None

    @property
    def shape(self) -> tuple[int, ...]:  # pragma: no cover - overridden
        """Shape of the law's numbers: (), (G,) or (T, G)."""
        raise NotImplementedError

    def groups(self, ny: int) -> tuple[tuple[int, ...], ...]:
        """Return the outputs of each sensor.

        Raises
        ------
        BadShape, BadValue
            If sensors and outputs do not fit.
        """
        G = self.shape[-1] if self.shape else 1
        groups = self.sensors
        if groups is None:
            groups = (tuple(range(ny)),) if G == 1 else tuple((i,) for i in range(ny))
        if sorted(itertools.chain.from_iterable(groups)) != list(range(ny)):
            raise BadValue(
                f"`sensors` is {groups}, every output from 0 to {ny - 1} in exactly one sensor was expected",
                hint="sensors=[[0, 1], [2]]",
            )
        if G not in (1, len(groups)):
            raise BadShape(
                f"the loss law has {G} sensors but there are {len(groups)}",
                hint="one number a sensor, or sensors=[[0, 1], [2]] for outputs that are lost together",
            )
        if (1 + len(self.kind)) ** len(groups) > _MOST_MODES:
            raise BadValue(
                f"{len(groups)} sensors with {len(self.kind)} kinds of loss have {(1 + len(self.kind)) ** len(groups)}"
                f" patterns, at most {_MOST_MODES} were expected",
                hint="join outputs that are lost together: sensors=[[0, 1, 2], [3]]",
            )
        return groups

    def patterns(self, n_sensors: int) -> NDArray[np.int64]:
        """Return the state of each sensor in each mode, (M, G): 0 .. n_kinds-1 lost that way, n_kinds received."""
        base = 1 + len(self.kind)
        modes = np.arange(base**n_sensors)
        return np.stack([modes // base**g % base for g in range(n_sensors)], axis=1)

    def received_in(self, ny: int) -> NDArray[np.bool_]:
        """Return whether each sensor is received in each mode, (M, G)."""
        return np.asarray(self.patterns(len(self.groups(ny))) == len(self.kind))

    def cov(self, kind: str, R: Array) -> Array:
        """Return the covariance of what arrives when a sample is lost, shaped as R (..., ny, ny)."""
        ny = R.shape[-1]
        diagonal = np.diagonal(R, axis1=-2, axis2=-1)
        given = self.noise_of.get(kind, self.noise)
        if given is None:
            scale = {"noise": None, "stale": _STALE, "garbage": _GARBAGE}[kind]
            return R if scale is None else scale * diagonal[..., None] * np.eye(ny)
        if given.ndim < 2:
            given = np.diag(np.broadcast_to(given, (ny,)))
        if given.shape != (ny, ny):
            raise BadShape(f"`noise` of the loss has shape {given.shape}, ({ny}, {ny}) was expected from the model")
        return np.broadcast_to(given, R.shape)

    def chain(self, T: int, n_sensors: int) -> tuple[Array, Array]:
        """Return transition probabilities (1 or T, M, M) of the modes and their first probabilities (M,)."""
        between, first = self.sensor_chain()
        return _together(between, n_sensors, T), _together(first, n_sensors, T)[0]

    def sensor_chain(self) -> tuple[Array, Array]:  # pragma: no cover - overridden
        """Return (1 or T, 1 or G, S, S) transitions and (1, 1 or G, S) first probabilities of one sensor."""
        raise NotImplementedError

    def prior_counts(self, n_sensors: int) -> Array | None:  # pragma: no cover - overridden
        """Return pseudo-counts (G, 2, 2), before by after, of a law to be learned."""
        raise NotImplementedError

    def apply(self, model: Model, y: Array, e: Array, rng: np.random.Generator) -> tuple[Array, NDArray[np.bool_]]:
        """Lose samples of a simulated record.

        Parameters
        ----------
        model : Linear or Nonlinear
        y : (T, ny) array
            Outputs as they would all arrive.
        e : (T, ny) array
            The noise in them, before a matrix F of the model mixes it.
        rng : Generator

        Returns
        -------
        y : (T, ny) array
            With lost samples replaced.
        received : (T, ny) bool array
        """
        T, ny = y.shape
        groups = self.groups(ny)
        between, first = self.sensor_chain()
        S, G = between.shape[-1], len(groups)
        v = e
        if isinstance(model, Linear) and model.F is not None:
            F = model.F.each(model.dt * np.arange(T, dtype=np.float64), np.full(T, model.dt))
            v = np.asarray(np.linalg.solve(F, e[..., None])[..., 0], dtype=np.float64)
        R = np.cov(v.T).reshape(ny, ny) if T > 1 else np.eye(ny)
        draws = {kind: rng.multivariate_normal(np.zeros(ny), self.cov(kind, R), T, method="eigh") for kind in self.kind}
        if self.noise is None and "noise" in draws and "noise" not in self.noise_of:
            draws["noise"] = v
        out, received = y.copy(), np.ones((T, ny), dtype=bool)
        state = np.zeros(G, dtype=int)
        for t in range(T):
            for g, members in enumerate(groups):
                law = (
                    first[0, g % first.shape[1]]
                    if t == 0
                    else between[t % len(between), g % between.shape[1], state[g]]
                )
                state[g] = rng.choice(S, p=law)
                if state[g] == S - 1:
                    continue
                i = list(members)
                kind = self.kind[state[g]]
                if kind == "stale" and t == 0:  # nothing to repeat yet
                    continue
                received[t, i] = False
                base = {"noise": np.broadcast_to(self.center, (ny,)), "stale": out[t - 1], "garbage": y[t]}[kind]
                out[t, i] = base[i] + draws[kind][t, i]
        return out, received


@dataclass(frozen=True, eq=False)
class Bernoulli(_Loss):
    """Samples are lost independently.

    Parameters
    ----------
    received : scalar, (G,) or (T, G) array_like
        Probability that a sample is received: for all outputs together, for each sensor, or row by row. Where it is 0
        or 1 the loss is known.
    kind : str or sequence of str
        What arrives instead: "noise", "stale", "garbage", or several of them, equally likely.
    noise : scalar, (ny,) or (ny, ny) array_like, or mapping of kind to such, optional
        Covariance of what arrives instead. If absent: that of e for "noise", a millionth of its diagonal for "stale"
        (a thousandth of its standard deviation), ten thousand times its diagonal for "garbage". A mapping where there
        are several kinds.
    center : scalar or (ny,) array_like
        Mean of pure noise.
    sensors : sequence of sequences of int, optional
        Outputs that are lost together.

    Raises
    ------
    BadShape, BadValue
        If a probability is outside 0 to 1 or a shape does not fit.

    Examples
    --------
    >>> Bernoulli(0.7)
    Bernoulli(0.7)
    >>> Bernoulli([0.7, 0.8], kind="stale")
    Bernoulli([0.7, 0.8], kind='stale')
    >>> Bernoulli.unknown().known
    False
    """

    received: Array

    def __init__(
        self,
        received: ArrayLike,
        *,
        kind: str | Sequence[str] = "noise",
        noise: ArrayLike | Mapping[str, ArrayLike] | None = None,
        center: ArrayLike = 0.0,
        sensors: Sequence[Sequence[int]] | None = None,
    ) -> None:
        _common(self, kind, noise, center, sensors)
        object.__setattr__(self, "received", _probability(received, "received"))

    @classmethod
    def unknown(
        cls, received: ArrayLike = 0.5, *, worth: float = 2.0, learn_noise: bool = False, **more: Any
    ) -> "Bernoulli":
        """Return losses whose probability is to be learned.

        Parameters
        ----------
        received : scalar or (G,) array_like
            Prior mean.
        worth : float
            How many observed samples the prior is worth; 2 with a mean of one half is a flat prior.
        learn_noise : bool
            Whether a smoother also learns the covariance of lost samples, starting from `noise`.
        **more
            As for `Bernoulli`.
        """
        found: Bernoulli = _unknown(cls(received, **more), worth, learn_noise)
        return found

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of `received`."""
        return self.received.shape

    def sensor_chain(self) -> tuple[Array, Array]:
        """Return (1 or T, 1 or G, S, S) transitions and (1, 1 or G, S) first probabilities of one sensor."""
        p = np.atleast_1d(self.received)
        p = p[None] if p.ndim == 1 else p
        k = len(self.kind)
        law = np.concatenate([np.repeat((1 - p)[..., None] / k, k, axis=-1), p[..., None]], axis=-1)
        return np.repeat(law[..., None, :], k + 1, axis=-2), law[:1]

    def prior_counts(self, n_sensors: int) -> Array | None:
        """Return pseudo-counts (G, 2, 2), before by after, of a law to be learned."""
        if self.worth is None:
            return None
        p = np.broadcast_to(self.received, (n_sensors,))
        row = self.worth * np.stack([1 - p, p], axis=-1)
        return np.ascontiguousarray(np.stack([row, row], axis=1))

    def __repr__(self) -> str:
        return _show(self, [self.received])


@dataclass(frozen=True, eq=False)
class Markov(_Loss):
    """Samples are lost in bursts: whether one is lost depends on whether the one before was.

    Parameters
    ----------
    stay_received : scalar, (G,) or (T, G) array_like
        Probability that a sample is received when the one before was.
    stay_lost : scalar, (G,) or (T, G) array_like
        Probability that a sample is lost, in the same way, when the one before was.
    start : scalar or (G,) array_like, optional
        Probability that the first sample is received; the chain's long-run share if absent.
    kind, noise, center, sensors
        As for `Bernoulli`.

    Raises
    ------
    BadShape, BadValue
        If a probability is outside 0 to 1 or a shape does not fit.

    Examples
    --------
    >>> Markov(0.95, 0.85)
    Markov(0.95, 0.85)
    """

    stay_received: Array
    stay_lost: Array
    start: Array | None

    def __init__(
        self,
        stay_received: ArrayLike,
        stay_lost: ArrayLike,
        *,
        start: ArrayLike | None = None,
        kind: str | Sequence[str] = "noise",
        noise: ArrayLike | Mapping[str, ArrayLike] | None = None,
        center: ArrayLike = 0.0,
        sensors: Sequence[Sequence[int]] | None = None,
    ) -> None:
        _common(self, kind, noise, center, sensors)
        a, b = _probability(stay_received, "stay_received"), _probability(stay_lost, "stay_lost")
        try:
            a, b = (frozen(np.array(v)) for v in np.broadcast_arrays(a, b))
        except ValueError:
            raise BadShape(f"`stay_received` has shape {a.shape} but `stay_lost` has shape {b.shape}") from None
        object.__setattr__(self, "stay_received", a)
        object.__setattr__(self, "stay_lost", b)
        object.__setattr__(self, "start", None if start is None else _probability(start, "start"))

    @classmethod
    def unknown(
        cls,
        stay_received: ArrayLike = 0.7,
        stay_lost: ArrayLike = 0.6,
        *,
        worth: float = 2.0,
        learn_noise: bool = False,
        **more: Any,
    ) -> "Markov":
        """Return losses whose law is to be learned.

        Parameters
        ----------
        stay_received, stay_lost : scalar or (G,) array_like
            Prior means.
        worth, learn_noise
            As for `Bernoulli.unknown`.
        **more
            As for `Markov`.
        """
        found: Markov = _unknown(cls(stay_received, stay_lost, **more), worth, learn_noise)
        return found

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the probabilities."""
        return self.stay_received.shape

    def sensor_chain(self) -> tuple[Array, Array]:
        """Return (1 or T, 1 or G, S, S) transitions and (1, 1 or G, S) first probabilities of one sensor."""
        a, b = (np.atleast_1d(v) for v in (self.stay_received, self.stay_lost))
        a, b = (v[None] if v.ndim == 1 else v for v in (a, b))
        k = len(self.kind)
        Pi = np.zeros((*a.shape, k + 1, k + 1))
        Pi[..., k, k] = a
        for i in range(k):
            Pi[..., k, i] = (1 - a) / k
            Pi[..., i, i] = b
            Pi[..., i, k] = 1 - b
        if self.start is None:
            leave, enter = 1 - b[:1], 1 - a[:1]
            total = leave + enter
            p = np.where(total > 0, leave / np.where(total > 0, total, 1.0), 0.5)
        else:
            p = np.atleast_1d(self.start)[None]
        return Pi, np.concatenate([np.repeat((1 - p)[..., None] / k, k, axis=-1), p[..., None]], axis=-1)

    def prior_counts(self, n_sensors: int) -> Array | None:
        """Return pseudo-counts (G, 2, 2), before by after, of a law to be learned."""
        if self.worth is None:
            return None
        a, b = (np.broadcast_to(v, (n_sensors,)) for v in (self.stay_received, self.stay_lost))
        rows = [np.stack([b, 1 - b], axis=-1), np.stack([1 - a, a], axis=-1)]
        return np.ascontiguousarray(self.worth * np.stack(rows, axis=1))

    def __repr__(self) -> str:
        return _show(self, [self.stay_received, self.stay_lost])


Loss = Bernoulli | Markov


def _together(law: Array, n_sensors: int, T: int) -> Array:
    """Return the joint law of independent sensors, the first varying fastest: the axis of sensors goes."""
    if len(law) not in (1, T):
        raise BadShape(f"the loss law is given for {len(law)} rows but the record has {T}")
    parts = [law[:, g % law.shape[1]] for g in range(n_sensors)]
    joint = parts[0]
    for part in parts[1:]:
        if joint.ndim == 2:
            joint = (part[:, :, None] * joint[:, None, :]).reshape(len(joint), -1)
        else:
            size = part.shape[1] * joint.shape[1]
            joint = (part[:, :, None, :, None] * joint[:, None, :, None, :]).reshape(len(joint), size, size)
    return joint


def _common(
    loss: _Loss,
    kind: str | Sequence[str],
    noise: ArrayLike | Mapping[str, ArrayLike] | None,
    center: ArrayLike,
    sensors: Sequence[Sequence[int]] | None,
) -> None:
    put = object.__setattr__
    kinds = (kind,) if isinstance(kind, str) else tuple(kind)
    if not kinds or len(set(kinds)) != len(kinds) or any(k not in KINDS for k in kinds):
        raise BadValue(f"`kind` is {kind!r}, one or several of {', '.join(KINDS)} were expected", hint='kind="noise"')
    put(loss, "kind", kinds)
    several = noise if isinstance(noise, Mapping) else {}
    if set(several) - set(kinds) or (noise is not None and not several and len(kinds) > 1):
        raise BadValue(
            f"`noise` is {noise!r} for the kinds {kinds}, one kind or a mapping of some of them was expected",
            hint=f"noise={{{kinds[0]!r}: 1.0}}",
        )
    put(loss, "noise_of", {kind: _covariance(value) for kind, value in several.items()})
    put(loss, "noise", None if noise is None or several else _covariance(noise))  # type: ignore[arg-type]
    middle = real(center, "center")
    if middle.ndim > 1:
        raise BadShape(f"`center` has shape {middle.shape}, a scalar or (ny,) was expected")
    put(loss, "center", frozen(middle))
    put(loss, "sensors", None if sensors is None else tuple(tuple(int(i) for i in group) for group in sensors))
    put(loss, "worth", None)
    put(loss, "unknown_noise", False)


def _covariance(value: ArrayLike) -> Array:
    given = real(value, "noise")
    if given.ndim > 2 or (given.ndim == 2 and given.shape[0] != given.shape[1]):
        raise BadShape(f"`noise` has shape {given.shape}, a scalar, (ny,) or (ny, ny) was expected")
    given = covariance(given, "noise") if given.ndim == 2 else given
    lowest = float(np.linalg.eigvalsh(given)[0] if given.ndim == 2 else np.min(given))
    if lowest <= 0:
        raise BadValue(
            f"`noise` has the variance {lowest:.3g}, above 0 was expected: a sample is judged by its density",
            hint="noise=1e-6 for a repeat that is exact to a thousandth",
        )
    return frozen(given)


def _unknown(loss: Any, worth: float, learn_noise: bool) -> Any:
    if not worth > 0 or not np.isfinite(worth):
        raise BadValue(f"`worth` is {worth!r}, a positive number was expected")
    if len(loss.shape) > 1:
        raise BadShape(f"a law to be learned has shape {loss.shape}, a scalar or (G,) was expected")
    if len(loss.kind) > 1:
        raise BadValue(f"a law to be learned has the kinds {loss.kind}, one kind was expected")
    numbers = [loss.received] if isinstance(loss, Bernoulli) else [loss.stay_received, loss.stay_lost]
    if any(np.any((v <= 0) | (v >= 1)) for v in numbers):
        raise BadValue(f"the prior means are {numbers}, numbers between 0 and 1, ends excluded, were expected")
    if learn_noise and loss.kind != ("noise",):
        raise BadValue(f'`learn_noise` is True for kind {loss.kind[0]!r}, it needs "noise"')
    object.__setattr__(loss, "worth", float(worth))
    object.__setattr__(loss, "unknown_noise", bool(learn_noise))
    return loss


def revised(loss: Any, *, noise: Array | None = None, **law: Array) -> Any:
    """Return a learned loss: the same kind and sensors with new numbers."""
    new = object.__new__(type(loss))
    changed: dict[str, Any] = {name: _probability(value, name) for name, value in law.items()} | {"worth": None}
    if noise is not None:
        changed["noise"] = frozen(noise)
    for name in loss.__dataclass_fields__:
        object.__setattr__(new, name, changed.get(name, getattr(loss, name)))
    return new


def _probability(value: ArrayLike, name: str) -> Array:
    p = real(value, name)
    if p.ndim > 2:
        raise BadShape(f"`{name}` has shape {p.shape}, a scalar, (G,) or (T, G) was expected")
    if np.any((p < 0) | (p > 1)):
        wrong = float(p[(p < 0) | (p > 1)].ravel()[0])
        raise BadValue(f"`{name}` holds {wrong:g}, probabilities from 0 to 1 were expected")
    return frozen(p)


def _show(loss: _Loss, numbers: list[Array]) -> str:
    parts = [np.array2string(v, precision=4, separator=", ") if v.ndim < 2 else "varying" for v in numbers]
    if loss.kind != ("noise",):
        parts.append(
            f"kind={loss.kind[0] if len(loss.kind) == 1 else loss.kind!r}"
            if len(loss.kind) > 1
            else f"kind={loss.kind[0]!r}"
        )
    if loss.noise is not None:
        parts.append("noise=" + np.array2string(loss.noise, precision=4, separator=", ").replace("\n", ""))
    if loss.noise_of:
        parts.append("noise={...}")
    if loss.sensors is not None:
        parts.append(f"sensors={[list(g) for g in loss.sensors]}")
    name = type(loss).__name__
    return f"{name}({', '.join(parts)})" if loss.known else f"{name}.unknown({', '.join(parts)}, worth={loss.worth:g})"
