"""What disturbs: uniform noise with known or unknown half-widths, Gaussian with known or unknown variances, their sum.

A noise is a frozen value without an owner: a scalar parameter takes its size from the model it is given to.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from halfwidth.array import Array, Function, covariance, extended, frozen, of_size, real
from halfwidth.errors import BadShape, BadValue, Refused
from halfwidth.varying import Varying, varying


class Noise(Protocol):
    """What a model asks of a noise."""

    @property
    def known(self) -> bool:
        """Whether its parameters are given."""
        ...

    def sized(self, n: int, name: str) -> "Noise":
        """Return the noise with `n` entries."""
        ...

    def cov(self) -> Varying:
        """Return its covariance (n, n), constant or varying."""
        ...

    def sample(self, rng: np.random.Generator, t: Array, dt: Array) -> Array:
        """Draw one noise vector a row, (T, n), for rows at times `t` (T,) that follow steps `dt` (T,), s."""
        ...


@dataclass(frozen=True, eq=False)
class Uniform:
    """Uniform noise in a box, ``|w_i| <= q_i``, entries independent.

    Parameters
    ----------
    q : scalar or (n,) array_like
        Half-widths, in the units of the disturbed entries.

    Raises
    ------
    BadValue
        If a half-width is negative, infinite or NaN.

    Examples
    --------
    >>> Uniform([0.3, 0.6]).cov().single.diagonal().round(2)
    array([0.03, 0.12])
    >>> Uniform.unknown(at_most=5.0).known
    False
    """

    at_least: Array
    at_most: Array

    def __init__(self, q: ArrayLike) -> None:
        half = real(q, "q")
        if half.ndim > 1:
            raise BadShape(f"`q` has shape {half.shape}, a scalar or (n,) was expected")
        if np.any(half < 0):
            raise BadValue(f"`q` holds the half-width {np.min(half):g}, none below 0 was expected")
        object.__setattr__(self, "at_least", frozen(half))
        object.__setattr__(self, "at_most", self.at_least)

    @classmethod
    def unknown(cls, at_least: ArrayLike = 0.0, at_most: ArrayLike = np.inf) -> "Uniform":
        """Return uniform noise whose half-widths are to be estimated between these bounds.

        Parameters
        ----------
        at_least, at_most : scalar or (n,) array_like
            Equal ends mean a known half-width.
        """
        lo, hi = _between(at_least, at_most)
        noise = object.__new__(cls)
        object.__setattr__(noise, "at_least", lo)
        object.__setattr__(noise, "at_most", hi)
        return noise

    @property
    def known(self) -> bool:
        """Whether every half-width is given."""
        return bool(np.all(self.at_least == self.at_most))

    @property
    def q(self) -> Array:
        """Half-widths, scalar or (n,).

        Raises
        ------
        Refused
            If one is unknown.
        """
        if not self.known:
            raise Refused("the half-widths of `Uniform.unknown(...)` are not known", hint="Uniform(q)")
        return self.at_least

    def sized(self, n: int, name: str) -> "Uniform":
        """Return the noise with `n` entries."""
        return Uniform.unknown(
            of_size(self.at_least, n, name, "the model"),
            of_size(self.at_most, n, name, "the model"),
        )

    def cov(self) -> Varying:
        """Return the covariance diag(q^2 / 3)."""
        return varying(np.diag(np.atleast_1d(self.q) ** 2 / 3.0), "Q", (None, None))

    def sample(self, rng: np.random.Generator, t: Array, dt: Array) -> Array:  # noqa: ARG002
        """Draw (T, n)."""
        return rng.uniform(-self.q, self.q, (len(t), self.q.size))

    def __add__(self, other: "Gaussian") -> "Mixed":
        return _mixed(self, other)

    def __repr__(self) -> str:
        if self.known:
            return f"Uniform({_show(self.at_least)})"
        return f"Uniform.unknown(at_least={_show(self.at_least)}, at_most={_show(self.at_most)})"


@dataclass(frozen=True, eq=False)
class Gaussian:
    """Zero-mean Gaussian noise.

    Parameters
    ----------
    Q : scalar, (n,) variances, (n, n), (T, n, n) array_like, or function of t or dt
        Covariance in squared units of the disturbed entries.

    Raises
    ------
    BadShape, BadValue
        If `Q` is not square, symmetric and positive semidefinite.

    Examples
    --------
    >>> Gaussian([1.0, 4.0]).cov().single
    array([[1., 0.],
           [0., 4.]])
    >>> Gaussian.unknown(at_most=4.0).known
    False
    """

    Q: Varying | Array | None
    at_least: Array | None
    at_most: Array | None

    def __init__(self, Q: ArrayLike | Function | Varying) -> None:
        value: Varying | Array
        if Q is None:
            raise BadValue("`Q` is None, a covariance was expected", hint="Gaussian.unknown() has it estimated")
        if isinstance(Q, Varying):
            value = Q
        elif callable(Q):
            value = varying(Q, "Q", (None, None), check=covariance)
        else:
            value = real(Q, "Q")
            if value.ndim < 2:
                if np.any(value < 0):
                    raise BadValue(f"`Q` holds the variance {np.min(value):g}, none below 0 was expected")
                value = frozen(value) if value.ndim == 0 else varying(np.diag(value), "Q", (None, None))
            else:
                value = varying(value, "Q", (value.shape[-1], value.shape[-1]), check=covariance)
        self._set(value, None, None)

    def _set(self, Q: Varying | Array | None, at_least: Array | None, at_most: Array | None) -> None:
        for name, value in (("Q", Q), ("at_least", at_least), ("at_most", at_most)):
            object.__setattr__(self, name, value)

    @classmethod
    def unknown(cls, at_least: ArrayLike = 0.0, at_most: ArrayLike = np.inf) -> "Gaussian":
        """Return independent Gaussian noise whose variances are to be estimated between these bounds.

        Parameters
        ----------
        at_least, at_most : scalar or (n,) array_like
            Variances. Equal ends mean a known one.
        """
        lo, hi = _between(at_least, at_most)
        if np.all(lo == hi):
            return cls(lo)
        noise = object.__new__(cls)
        noise._set(None, lo, hi)
        return noise

    @property
    def known(self) -> bool:
        """Whether the covariance is given."""
        return self.Q is not None

    def sized(self, n: int, name: str) -> "Gaussian":
        """Return the noise with `n` entries."""
        if self.at_least is not None and self.at_most is not None:
            return Gaussian.unknown(
                of_size(self.at_least, n, name, "the model"), of_size(self.at_most, n, name, "the model")
            )
        if not isinstance(self.Q, Varying):
            return Gaussian(np.full(n, self.Q))
        if self.Q.shape != (n, n):
            raise BadShape(f"`{name}` has a covariance of shape {self.Q.shape}, ({n}, {n}) was expected")
        return self if self.Q.name == f"{name}.Q" else Gaussian(replace(self.Q, name=f"{name}.Q"))

    def cov(self) -> Varying:
        """Return the covariance (n, n).

        Raises
        ------
        Refused
            If it is unknown.
        """
        if self.Q is None:
            raise Refused("the variances of `Gaussian.unknown(...)` are not known", hint="Gaussian(Q), or Posterior()")
        if isinstance(self.Q, Varying):
            return self.Q
        return varying(np.atleast_2d(self.Q), "Q", (None, None))

    def sample(self, rng: np.random.Generator, t: Array, dt: Array) -> Array:
        """Draw (T, n)."""
        stack, index = self.cov().stack(t, dt)
        value, vector = np.linalg.eigh(stack)
        root = vector * np.sqrt(np.maximum(value, 0.0))[:, None, :]
        z = rng.standard_normal((len(t), stack.shape[-1]))
        rows = np.broadcast_to(root, (len(t), *root.shape[1:])) if index is None else root[index]
        return np.asarray(np.einsum("tij,tj->ti", rows, z))

    def __add__(self, other: Uniform) -> "Mixed":
        return _mixed(other, self)

    def __repr__(self) -> str:
        if self.at_least is not None and self.at_most is not None:
            return f"Gaussian.unknown(at_least={_show(self.at_least)}, at_most={_show(self.at_most)})"
        if isinstance(self.Q, Varying):
            return f"Gaussian({_show(self.Q.value) if self.Q.constant else 'varying'})"
        return f"Gaussian({_show(self.Q)})"


@dataclass(frozen=True, eq=False)
class Mixed:
    """Sum of bounded and Gaussian noise, written ``Uniform(q) + Gaussian(Q)``.

    Parameters
    ----------
    uniform : Uniform
    gaussian : Gaussian
        Of as many entries.
    """

    uniform: Uniform
    gaussian: Gaussian

    @property
    def known(self) -> bool:
        """Whether the half-widths and the covariance are given."""
        return self.uniform.known and self.gaussian.known

    def sized(self, n: int, name: str) -> "Mixed":
        """Return the noise with `n` entries."""
        return Mixed(self.uniform.sized(n, name), self.gaussian.sized(n, name))

    def cov(self) -> Varying:
        """Return the covariance of the sum, diag(q^2 / 3) + Q."""
        box = self.uniform.cov().single
        part = self.gaussian.cov()
        if part.value is not None:
            return varying(part.value + box, "Q", (None, None))
        function = part.function
        assert function is not None
        return Varying("Q", part.shape, None, lambda *a: np.asarray(function(*a)) + box, part.of)

    def sample(self, rng: np.random.Generator, t: Array, dt: Array) -> Array:
        """Draw (T, n)."""
        return self.uniform.sample(rng, t, dt) + self.gaussian.sample(rng, t, dt)

    def __repr__(self) -> str:
        return f"{self.uniform!r} + {self.gaussian!r}"


def _between(at_least: ArrayLike, at_most: ArrayLike) -> tuple[Array, Array]:
    """Return the two ends of what is unknown, of one shape, checked."""
    lo, hi = extended(at_least, "at_least"), extended(at_most, "at_most")
    if lo.ndim > 1 or hi.ndim > 1:
        raise BadShape(f"`at_least` and `at_most` have shapes {lo.shape}, {hi.shape}: scalar or (n,)")
    if np.any(lo < 0) or np.any(np.isinf(lo)):
        raise BadValue(f"`at_least` is {at_least!r}, finite numbers not below 0 were expected")
    if np.any(lo > hi):
        raise BadValue(f"`at_least` {at_least!r} exceeds `at_most` {at_most!r}")
    shape = np.broadcast_shapes(lo.shape, hi.shape)
    return frozen(np.array(np.broadcast_to(lo, shape))), frozen(np.array(np.broadcast_to(hi, shape)))


def unknown_variances(w: Noise, e: Noise, name: str) -> str | None:
    """Return why a method that is told all Gaussian noise cannot take this one, with a hint, or None."""
    for symbol, noise in (("w", w), ("e", e)):
        part = noise.gaussian if isinstance(noise, Mixed) else noise
        if isinstance(part, Gaussian) and not part.known:
            return (
                f"`{name}` needs known variances but those of `{symbol}` are unknown"
                f"\nhint: Posterior(), which finds them, or {symbol}=Gaussian(Q)"
            )
    return None


def _mixed(uniform: object, gaussian: object) -> Mixed:
    if not isinstance(uniform, Uniform) or not isinstance(gaussian, Gaussian):
        raise BadValue(f"the sum of {uniform!r} and {gaussian!r} was given, Uniform(q) + Gaussian(Q) was expected")
    return Mixed(uniform, gaussian)


def _show(value: Array | None) -> str:
    return "None" if value is None else np.array2string(value, precision=4, separator=", ").replace("\n", "")
