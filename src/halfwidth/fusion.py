"""Fusion of two sources whose errors are partly bounded and partly Gaussian: the scalar estimator in full.

``x = z + e_x + c_x`` with ``e_x^2 <= E_x`` and ``c_x ~ N(0, S_x)``, and y likewise: eq. (1) of Hanebeck, Horn and
Schmidt [1]_. Of the bounded errors nothing else is known, so their sets are fused by a convex combination with a
scalar lambda; the midpoint ``w_x x + w_y y`` of the fused set is uncertain through the Gaussian errors, given that
the two sets meet. Its density is known exactly (`density`), as a sum of Gaussians (`fuse_sums`), and by its mean and
variance (`fuse`), which is what the recursive estimator uses (`recursion`). Where no source has a set it is the
Kalman filter, where none has a Gaussian error the set estimator. `halfwidth.MixedFilter` is the form for vectors and
motion.

The paper's ``erf`` is the normal distribution function minus 1/2, its eq. (20). Formulas that its print has lost are
derived anew; they agree with those that stand, to rounding.

References
----------
.. [1] Hanebeck, Horn and Schmidt, On combining statistical and set theoretic estimation.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

import halfwidth._core as _core
from halfwidth.array import Array, real
from halfwidth.errors import BadShape, BadValue

#: What lambda is chosen by: sqrt(E) + kappa sqrt(S), eq. (32); E + kappa^2 S; the set alone; the variance alone.
Measure = Literal["width", "square", "set", "variance"] | Callable[[Array, Array], Array]
_GRID = 21
_GOLDEN = 34  # to 1e-8: the measure is flat beyond


@dataclass(frozen=True, eq=False)
class Source:
    """What is known of a scalar: a midpoint m, a squared half-width E and a variance S; arrays are many at once.

    Parameters
    ----------
    m : array_like
        Midpoint.
    E : array_like
        Square of the half-width of the bounded part, in squared units of m.
    S : array_like
        Variance of the Gaussian part of the midpoint.

    Raises
    ------
    BadShape, BadValue
        If they do not broadcast, are not finite, or E or S is negative.

    Examples
    --------
    >>> lo, hi = Source(12.0, E=1.0, S=0.01).interval()
    >>> float(lo), round(float(hi), 9)
    (10.7, 13.3)
    """

    m: Array
    E: Array
    S: Array

    def __init__(self, m: ArrayLike, E: ArrayLike, S: ArrayLike) -> None:
        given = [real(v, name) for v, name in ((m, "m"), (E, "E"), (S, "S"))]
        try:
            parts = np.broadcast_arrays(*given)
        except ValueError:
            raise BadShape(f"`m`, `E` and `S` have shapes {', '.join(str(v.shape) for v in given)}") from None
        for name, part in zip("mES", parts, strict=True):
            if name != "m" and np.any(part < 0):
                raise BadValue(f"`{name}` holds {np.min(part):g}, no number below 0 was expected")
            object.__setattr__(self, name, np.array(part))

    def interval(self, kappa: float = 3.0) -> tuple[Array, Array]:
        """Return the midpoint minus and plus ``sqrt(E) + kappa sqrt(S)``."""
        half = np.sqrt(self.E) + kappa * np.sqrt(self.S)
        return self.m - half, self.m + half


@dataclass(frozen=True, eq=False)
class Fused(Source):
    """A fused source, and the lambda it was fused with."""

    lam: Array

    def __init__(self, m: ArrayLike, E: ArrayLike, S: ArrayLike, lam: ArrayLike) -> None:
        super().__init__(m, E, S)
        object.__setattr__(self, "lam", np.array(lam, dtype=np.float64))


class Weights(NamedTuple):
    """Weights of the two midpoints and the squared half-width of the fused set."""

    x: Array
    y: Array
    E: Array


def weights(E_x: ArrayLike, E_y: ArrayLike, lam: ArrayLike) -> Weights:
    """Return the convex combination of two sets, eqs. (10) and (11).

    A source without a set takes all the weight; where neither has one both weights are NaN, for no choice is better.

    Parameters
    ----------
    E_x, E_y : array_like
        Squared half-widths.
    lam : array_like
        From -1/2 (all x) to 1/2 (all y).
    """
    return _combined(_lambda(lam), real(E_x, "E_x"), real(E_y, "E_y"))


def _combined(lam: Array, Ex: Array, Ey: Array) -> Weights:
    a, b, Ex, Ey = np.broadcast_arrays(0.5 - lam, 0.5 + lam, Ex, Ey)
    # scaled, so that no product leaves the range of floating point
    top = np.maximum(Ex, Ey)
    ex, ey = (np.divide(E, top, out=np.zeros(top.shape), where=top > 0) for E in (Ex, Ey))
    left, right = a * ey, b * ex
    total = left + right
    some = total > 0
    # at the far end of lambda the exact source keeps its weight, as it does for every other lambda
    exact = np.where(top > 0, np.where(ex == 0, 1.0, 0.0), np.nan)
    w = np.divide(left, total, out=np.array(exact), where=some)
    E = np.divide(ex * Ey, total, out=np.zeros(top.shape), where=some)
    return Weights(w, 1.0 - w, E)


def fuse_sets(x: Source, y: Source, lam: ArrayLike = 0.0) -> Fused:
    """Fuse two sources without Gaussian errors, with the d of eqs. (6), (7): the set shrinks where they lie apart.

    Raises
    ------
    BadValue
        If a source has a Gaussian part, or the two sets do not meet.
    """
    if np.any(x.S > 0) or np.any(y.S > 0):
        raise BadValue("a source has a Gaussian part", hint="fuse(x, y)")
    w = weights(x.E, y.E, lam)
    apart = np.abs(x.m - y.m)
    if np.any(apart > (np.sqrt(x.E) + np.sqrt(y.E)) * (1 + 1e-12)):
        raise BadValue("the two sets do not meet")
    lam = _lambda(lam)
    room = (0.5 + lam) * x.E + (0.5 - lam) * y.E  # E_x E_y / P_z
    share = np.divide(apart**2, room, out=np.zeros(room.shape), where=room > 0)
    d = np.clip(1.0 - (0.25 - lam**2) * share, 0.0, 1.0)
    wx = np.where(np.isnan(w.x), 0.5, w.x)
    return Fused(wx * x.m + (1.0 - wx) * y.m, d * w.E, np.zeros(d.shape), lam)


def fuse(
    x: Source, y: Source, lam: ArrayLike | None = None, *, measure: Measure = "width", kappa: float = 3.0
) -> Fused:
    """Fuse two sources by the exact mean and variance of the midpoint, eqs. (29) to (31).

    Parameters
    ----------
    x, y : Source
        Independent in their Gaussian parts.
    lam : array_like, optional
        From -1/2 (all x) to 1/2 (all y); chosen by the measure if absent.
    measure : {"width", "square", "set", "variance"} or function (E, S) -> values
        Of eq. (32) is "width", ``sqrt(E) + kappa sqrt(S)``. The measure may have several minima and its least value at
        an end, so 21 values of lambda with both ends are compared before the best is refined between its neighbours.
    kappa : float

    Returns
    -------
    Fused

    Examples
    --------
    >>> both = fuse(Source(0.0, E=1.0, S=4.0), Source(1.0, E=1.0, S=1.0))
    >>> round(float(both.E), 9), round(float(both.S), 4), round(float(both.m), 4)
    (1.0, 0.8, 0.8)
    """
    pair = _Pair(x, y)
    if lam is not None:
        given = np.broadcast_to(_lambda(lam), np.broadcast_shapes(pair.shape, np.shape(lam)))
        return Fused(*_moments(pair, given), given)

    def judged(lam: Array) -> Array:
        _, E, S = _moments(pair, lam)
        return _measured(E, S, measure, kappa)

    nodes = np.linspace(-0.5, 0.5, _GRID)
    at = np.array([judged(np.full(pair.shape, node)) for node in nodes])
    best = np.argmin(at, axis=0)
    least, found = np.take_along_axis(at, best[None], axis=0)[0], nodes[best]
    lo, hi = nodes[np.maximum(best - 1, 0)], nodes[np.minimum(best + 1, _GRID - 1)]
    golden = (np.sqrt(5.0) - 1.0) / 2.0
    left, right = hi - golden * (hi - lo), lo + golden * (hi - lo)
    f_left, f_right = judged(left), judged(right)
    for _ in range(_GOLDEN):
        down = f_left <= f_right
        lo, hi = np.where(down, lo, left), np.where(down, right, hi)
        kept, f_kept = np.where(down, left, right), np.where(down, f_left, f_right)
        new = np.where(down, hi - golden * (hi - lo), lo + golden * (hi - lo))
        f_new = judged(new)
        left, right = np.where(down, new, kept), np.where(down, kept, new)
        f_left, f_right = np.where(down, f_new, f_kept), np.where(down, f_kept, f_new)
    inner, f_inner = np.where(f_left <= f_right, left, right), np.minimum(f_left, f_right)
    chosen = np.where(f_inner < least, inner, found)
    return Fused(*_moments(pair, chosen), chosen)


def recursion(
    y: ArrayLike,
    E: ArrayLike,
    S: ArrayLike,
    *,
    lam: float | None = None,
    measure: Measure = "width",
    kappa: float = 3.0,
) -> Fused:
    """Fuse measurements of one constant, one after the other: the recursive estimator, eqs. (39) to (43).

    Parameters
    ----------
    y : (n,) or (n, runs) array_like
        Measurements; the runs are independent experiments side by side.
    E, S : broadcastable to y
        Squared half-widths and variances of their errors.
    lam, measure, kappa
        As in `fuse`.

    Returns
    -------
    Fused
        Of shape (n,) or (n, runs): row k has used the measurements up to k.
    """
    seen = Source(y, E, S)
    if seen.m.ndim not in (1, 2) or not len(seen.m):
        raise BadShape(f"`y` has shape {seen.m.shape}, (n,) or (n, runs) was expected")
    rows = [Source(m, e, s) for m, e, s in zip(seen.m, seen.E, seen.S, strict=True)]
    found = [Fused(rows[0].m, rows[0].E, rows[0].S, np.full(rows[0].m.shape, 0.5))]
    for row in rows[1:]:
        found.append(fuse(found[-1], row, lam, measure=measure, kappa=kappa))
    return Fused(*(np.array([getattr(one, name) for one in found]) for name in ("m", "E", "S", "lam")))


def density(x: Source, y: Source, lam: float, z: ArrayLike) -> Array:
    """Return the exact density of the fused midpoint at z, eqs. (18) and (19), for every weight.

    The midpoint is Gaussian, weighted by the probability that the sets meet given where it lies.

    Raises
    ------
    BadValue
        If the midpoint has no density, since no source that is weighted has a Gaussian part.
    """
    from scipy.special import log_ndtr

    z = np.asarray(real(z, "z"))
    wx, wy = (float(w) for w in _pair_weights(_Pair(x, y), _lambda(lam))[:2])
    Sx, Sy = float(x.S), float(y.S)
    S, s2 = Sx + Sy, wx**2 * Sx + wy**2 * Sy
    if s2 <= 0:
        raise BadValue("the midpoint has no density: no source that is weighted has a Gaussian part")
    c = wx * Sx - wy * Sy
    md, mu, B = float(x.m - y.m), float(wx * x.m + wy * y.m), float(np.sqrt(x.E) + np.sqrt(y.E))
    t = np.sqrt((wx + wy) ** 2 * Sx * Sy / s2)  # sd of x - y given the midpoint
    m = md + c / s2 * (z - mu)
    meets = _log_between(log_ndtr, (-B - m) / t, (B - m) / t) if t > 0 else np.where(np.abs(m) <= B, 0.0, -np.inf)
    ever = _log_between(log_ndtr, np.array((-B - md) / np.sqrt(S)), np.array((B - md) / np.sqrt(S)))
    return np.asarray(np.exp(-0.5 * (z - mu) ** 2 / s2 - 0.5 * np.log(2 * np.pi * s2) + meets - ever))


@dataclass(frozen=True, eq=False)
class GaussianSum:
    """A midpoint as a sum of Gaussians of one variance, beside its set.

    Parameters
    ----------
    weight, m : (terms,) arrays
        Weights, which sum to one, and means.
    S : float
        Their common variance.
    E : float
        Squared half-width of the set.
    """

    weight: Array
    m: Array
    S: float
    E: float

    @classmethod
    def of(cls, source: Source) -> "GaussianSum":
        """Return a source as a sum of one term."""
        return cls(np.ones(1), np.atleast_1d(source.m), float(source.S), float(source.E))

    @property
    def mean(self) -> float:
        """Mean of the midpoint, eq. (24)."""
        return float(self.weight @ self.m)

    @property
    def variance(self) -> float:
        """Variance of the midpoint, from eq. (25)."""
        return float(self.S + self.weight @ (self.m - self.mean) ** 2)

    def density(self, z: ArrayLike) -> Array:
        """Return the density at z; zero variance has none."""
        if self.S <= 0:
            raise BadValue("a sum of points has no density")
        z = np.asarray(real(z, "z"))
        f = np.exp(-0.5 * (z[..., None] - self.m) ** 2 / self.S) / np.sqrt(2 * np.pi * self.S)
        return np.asarray(f @ self.weight)


def fuse_sums(
    x: Source | GaussianSum, y: Source, lam: float, *, L: int = 10, c: float | None = None, terms: int | None = None
) -> GaussianSum:
    """Fuse a source, or a sum of Gaussians, with a source by eqs. (21) to (23): the constraint as 2 L + 1 Gaussians.

    Parameters
    ----------
    x, y : Source or GaussianSum, and Source
    lam : float
    L : int
        The rectangle of the constraint becomes 2 L + 1 Gaussians at the spacing 2 B / (2 L + 1).
    c : float, optional
        Their standard deviation in units of B / (2 L + 1); the best in the mean square if absent, about 0.8 for L = 3
        and 0.9 for L = 10.
    terms : int, optional
        Keep this many, the heaviest, as the paper does; all if absent. The light terms are the tails, so dropping them
        loses variance (a fifth of it at 40 terms); `fuse`, which keeps mean and variance alone, does not.
    """
    if not isinstance(L, int | np.integer) or L < 0:
        raise BadValue(f"`L` is {L!r}, a whole number from 0 was expected")
    if terms is not None and terms < 1:
        raise BadValue(f"`terms` is {terms!r}, a positive whole number was expected")
    prior = x if isinstance(x, GaussianSum) else GaussianSum.of(x)
    S_x, S_y, m_y = prior.S, float(y.S), float(y.m)
    wx, wy, E = (float(v) for v in _pair_weights(_Pair(Source(prior.mean, prior.E, S_x), y), _lambda(lam)))
    B = float(np.sqrt(prior.E) + np.sqrt(y.E))
    i = np.arange(-L, L + 1)
    m_g, S_g = 2 * B * i / (2 * L + 1), ((best_spread(L) if c is None else c) * B / (2 * L + 1)) ** 2
    S = S_x + S_y + S_g
    mu, md = wx * prior.m + wy * m_y, prior.m - m_y
    s2, cov = wx**2 * S_x + wy**2 * S_y, wx * S_x - wy * S_y
    if S <= 0:  # nothing is uncertain: the sets meet or not
        return GaussianSum(prior.weight, mu, 0.0, E)
    off = md[:, None] - m_g  # (terms, 2L + 1)
    log_w = np.log(np.maximum(prior.weight, 1e-300))[:, None] - 0.5 * off**2 / S
    w = np.exp(log_w - log_w.max()).ravel()
    z = (mu[:, None] - cov * off / S).ravel()
    variance = max(float(s2 - cov**2 / S), 0.0)  # == [S_g (wx^2 Sx + wy^2 Sy) + (wx + wy)^2 Sx Sy] / S
    if terms is not None and len(w) > terms:
        kept = np.sort(np.argpartition(w, -terms)[-terms:])
        w, z = w[kept], z[kept]
    return GaussianSum(w / w.sum(), z, variance, E)


def best_spread(L: int) -> float:
    """Return the c of eq. (21) that comes closest to the rectangle in the mean square."""
    from scipy.optimize import minimize_scalar
    from scipy.special import ndtr

    # over the rectangle of half-width 1: int (rect - sum)^2 = 2 - 2 int_rect sum + int sum^2, all in closed form
    n = 2 * L + 1
    m = 2 * np.arange(-L, L + 1) / n

    def distance(c: float) -> float:
        s = c / n
        inside = (2 / n) * np.sum(ndtr((1 - m) / s) - ndtr((-1 - m) / s))
        d = (m[:, None] - m) / (np.sqrt(2) * s)
        pairs = np.exp(-0.5 * d**2) / (np.sqrt(2 * np.pi) * np.sqrt(2) * s)
        return float(2 - 2 * inside + (2 / n) ** 2 * pairs.sum())

    return float(minimize_scalar(distance, bounds=(0.3, 3.0), method="bounded", options={"xatol": 1e-9}).x)


class _Pair:
    """Two sources broadcast against each other, and the moments of their difference, which do not depend on lambda."""

    def __init__(self, x: Source, y: Source) -> None:
        try:
            parts = np.broadcast_arrays(x.m, y.m, x.E, y.E, x.S, y.S)
        except ValueError:
            raise BadShape(f"the sources have shapes {x.m.shape} and {y.m.shape}") from None
        self.m_x, self.m_y, self.E_x, self.E_y, self.S_x, self.S_y = parts
        self.shape = self.m_x.shape
        self.S = self.S_x + self.S_y
        self.m = self.m_x - self.m_y
        self.B = np.sqrt(self.E_x) + np.sqrt(self.E_y)
        flat = [np.ascontiguousarray(v, dtype=np.float64).reshape(-1) for v in (self.m, self.S, -self.B, self.B)]
        _, mean, variance, *_ = _core.noise_truncated(*flat)
        self.mean, self.variance = mean.reshape(self.shape), variance.reshape(self.shape)
        some = self.S > 0
        self.share = np.divide(self.S_x, self.S, out=np.zeros(self.shape), where=some)
        self.mean, self.variance = np.where(some, self.mean, self.m), np.where(some, self.variance, 0.0)
        self.kalman = np.where(some, 1.0 - self.share, 0.5)  # weight of x in the Kalman filter


def _pair_weights(pair: _Pair, lam: Array) -> Weights:
    """Return the weights of the sets; where there is none, those of the Kalman filter."""
    w = _combined(lam, pair.E_x, pair.E_y)
    wx = np.where(np.isnan(w.x), pair.kalman, w.x)
    return Weights(wx, 1.0 - wx, w.E)


def _moments(pair: _Pair, lam: Array) -> tuple[Array, Array, Array]:
    """Mean, squared half-width and variance of the midpoint given that the sets meet, eqs. (28) to (31).

    The midpoint is the Kalman estimate, which is free of the difference x - y, plus g times that difference; of eq.
    (30) ``S_z = S_x S_y / S + g^2 Var(x - y)`` is left, a sum without cancellation.
    """
    w = _pair_weights(pair, lam)
    g = pair.share - w.y
    return pair.m_x - pair.share * pair.m + g * pair.mean, w.E, pair.share * pair.S_y + g**2 * pair.variance


def _measured(E: Array, S: Array, measure: Measure, kappa: float) -> Array:
    if callable(measure):
        return np.asarray(measure(E, S), dtype=np.float64)
    if measure == "width":
        return np.asarray(np.sqrt(E) + kappa * np.sqrt(S))
    if measure == "square":
        return E + kappa**2 * S
    if measure == "set":
        return E
    if measure == "variance":
        return S
    raise BadValue(f"`measure` is {measure!r}, width, square, set, variance or a function of E and S was expected")


def _lambda(lam: ArrayLike) -> Array:
    found = real(lam, "lam")
    if np.any(np.abs(found) > 0.5):
        raise BadValue(f"`lam` holds {found.ravel()[np.argmax(np.abs(found))]:g}, -1/2 to 1/2 was expected")
    return found


def _log_between(log_ndtr: Callable[[Array], Array], a: Array, b: Array) -> Array:
    """Return log(Phi(b) - Phi(a)) for a <= b, from the side where both are small."""
    flip = a + b > 0
    lo, hi = np.where(flip, -b, a), np.where(flip, -a, b)
    top, low = log_ndtr(hi), log_ndtr(lo)
    with np.errstate(divide="ignore"):
        return np.asarray(top + np.log(-np.expm1(np.minimum(low - top, 0.0))))
