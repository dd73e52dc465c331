"""What is known of a state: a box, half-spaces, a Gaussian, both, or a cloud. Priors of x0, bounds, spreads of answers.

Each has ``interval(level) -> (lo, hi)`` and the flag ``guaranteed``, so that scores, plots and reports never ask which
estimator ran.
"""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.array import Array, covariance, extended, frozen, real
from halfwidth.errors import BadShape, BadValue


class Spread(Protocol):
    """What `Estimate.spread` can do."""

    @property
    def guaranteed(self) -> bool:
        """Whether the interval must contain the state."""
        ...

    def interval(self, level: float = 0.9) -> tuple[Array, Array]:
        """Return (lo, hi), each shaped as the state."""
        ...

    def through(self, D: Array) -> "Spread":
        """Return what is known of ``D x``, D of shape (k, nx)."""
        ...


@dataclass(frozen=True, eq=False)
class Box:
    """The state lies between `lo` and `hi`.

    Parameters
    ----------
    lo, hi : scalar, (nx,) or (T, nx) array_like
        Entry-wise bounds in the units of the state; infinite where there is none.
    guaranteed : bool
        Whether an answer's box is proved to contain the state.

    Raises
    ------
    BadShape, BadValue
        If the shapes differ, an entry is NaN, or `lo` exceeds `hi`.

    Examples
    --------
    >>> Box(-1, [1, 2]).hi
    array([1., 2.])
    """

    lo: Array
    hi: Array
    guaranteed: bool = False

    def __init__(self, lo: ArrayLike, hi: ArrayLike, *, guaranteed: bool = False) -> None:
        a, b = extended(lo, "lo"), extended(hi, "hi")
        try:
            a, b = (np.array(v) for v in np.broadcast_arrays(a, b))
        except ValueError:
            raise BadShape(f"`lo` has shape {a.shape} but `hi` has shape {b.shape}") from None
        if np.any(a > b) or np.any(a == np.inf) or np.any(b == -np.inf):
            k = int(np.argmax((a > b).ravel()))
            raise BadValue(f"`lo` exceeds `hi` at entry {k}: {a.ravel()[k]:g} > {b.ravel()[k]:g}")
        object.__setattr__(self, "lo", frozen(a))
        object.__setattr__(self, "hi", frozen(b))
        object.__setattr__(self, "guaranteed", guaranteed)

    def sized(self, n: int, name: str) -> "Box":
        """Return the box with `n` entries, repeating a scalar."""
        if self.lo.ndim == 0:
            return Box(np.full(n, float(self.lo)), np.full(n, float(self.hi)))
        if self.lo.shape != (n,):
            raise BadShape(f"`{name}` is a box of shape {self.lo.shape}, ({n},) was expected")
        return self

    @property
    def mean(self) -> Array:
        """Midpoint; 0 or the finite end where an end is infinite."""
        lo = np.where(np.isfinite(self.lo), self.lo, np.where(np.isfinite(self.hi), self.hi, 0.0))
        hi = np.where(np.isfinite(self.hi), self.hi, lo)
        return np.asarray(0.5 * lo + 0.5 * hi)

    def contains(self, x: Array) -> NDArray[np.bool_]:
        """Return which of the states (..., nx) lie in the box."""
        return np.asarray(((x >= self.lo) & (x <= self.hi)).all(axis=-1))

    @property
    def rows(self) -> tuple[Array, Array, Array]:
        """The same as ``lo <= D x <= hi``: D, lo, hi."""
        return np.eye(self.lo.shape[-1]), self.lo, self.hi

    def interval(self, level: float = 0.9) -> tuple[Array, Array]:
        """Return the box itself, whatever the level."""
        _level(level)
        return self.lo, self.hi

    def through(self, D: Array) -> "Box":
        """Return what is known of ``D x``."""
        plus, minus = np.maximum(D, 0.0), np.minimum(D, 0.0)
        with np.errstate(invalid="ignore"):
            lo = np.nansum(plus * self.lo[..., None, :], axis=-1) + np.nansum(minus * self.hi[..., None, :], axis=-1)
            hi = np.nansum(plus * self.hi[..., None, :], axis=-1) + np.nansum(minus * self.lo[..., None, :], axis=-1)
        return Box(lo, hi, guaranteed=self.guaranteed)

    def sample(self, rng: np.random.Generator) -> Array:
        """Draw one state (nx,) uniformly.

        Raises
        ------
        BadValue
            If a side has no end.
        """
        if not (np.isfinite(self.lo).all() and np.isfinite(self.hi).all()):
            raise BadValue(
                "`x0` is an infinite box, so no state can be drawn from it",
                hint="give a finite Box(lo, hi) or Normal(mean, P)",
            )
        return rng.uniform(self.lo, self.hi)


@dataclass(frozen=True, eq=False)
class Halfspaces:
    """The state fulfils ``lo <= D x <= hi``, row by row; a row with equal ends is an equality. Bounds of a model.

    Parameters
    ----------
    D : (m, nx) array_like
        One constraint a row.
    lo, hi : scalar or (m,) array_like
        Ends in the units of ``D x``; infinite where there is none.

    Raises
    ------
    BadShape, BadValue
        If shapes do not fit, an entry is NaN, or `lo` exceeds `hi`.

    Examples
    --------
    >>> ahead = Halfspaces([[1, -1], [1, 1]], [0, 2], [np.inf, 2])  # x0 >= x1 and x0 + x1 = 2
    >>> ahead.contains(np.array([[1.5, 0.5], [0.5, 1.5]]))
    array([ True, False])
    """

    D: Array
    lo: Array
    hi: Array

    def __init__(self, D: ArrayLike, lo: ArrayLike = -np.inf, hi: ArrayLike = np.inf) -> None:
        d = real(D, "D")
        if d.ndim != 2:
            raise BadShape(f"`D` has shape {d.shape}, (m, nx) was expected: one constraint a row")
        ends = []
        for name, value in (("lo", extended(lo, "lo")), ("hi", extended(hi, "hi"))):
            if value.shape not in ((), (len(d),)):
                raise BadShape(f"`{name}` has shape {value.shape}, ({len(d)},) was expected from `D` {d.shape}")
            ends.append(np.array(np.broadcast_to(value, (len(d),))))
        wrong = (ends[0] > ends[1]) | (ends[0] == np.inf) | (ends[1] == -np.inf)
        if wrong.any():
            k = int(np.argmax(wrong))
            raise BadValue(f"row {k} of `D` has lo = {ends[0][k]:g} and hi = {ends[1][k]:g}, which nothing fulfils")
        object.__setattr__(self, "D", frozen(d))
        object.__setattr__(self, "lo", frozen(ends[0]))
        object.__setattr__(self, "hi", frozen(ends[1]))

    def sized(self, n: int, name: str) -> "Halfspaces":
        """Return the constraints themselves if they are on `n` states."""
        if self.D.shape[1] != n:
            raise BadShape(f"`{name}` has a `D` of shape {self.D.shape}, {n} columns were expected from the model")
        return self

    @property
    def rows(self) -> tuple[Array, Array, Array]:
        """D, lo, hi."""
        return self.D, self.lo, self.hi

    def contains(self, x: Array) -> NDArray[np.bool_]:
        """Return which of the states (..., nx) obey every row, to the last bit: rounding may leave a plane."""
        s = x @ self.D.T
        return np.asarray(((s >= self.lo) & (s <= self.hi)).all(axis=-1))


@dataclass(frozen=True, eq=False)
class Normal:
    """The state is Gaussian.

    Parameters
    ----------
    mean : (nx,) or (T, nx) array_like
    P : scalar, (nx,) variances, (nx, nx), or (T, nx, nx) array_like
        Covariance in squared units of the state.

    Raises
    ------
    BadShape, BadValue
        If shapes do not fit or `P` is asymmetric or indefinite.

    Examples
    --------
    >>> lo, hi = Normal([0.0], 1.0).interval(0.95)
    >>> float(hi[0].round(2))
    1.96
    """

    mean: Array
    P: Array
    guaranteed = False
    _within: ClassVar[tuple[Array, Array] | None] = (
        None  # (lo, hi) that every state is known to lie in: intervals end there
    )

    def __init__(self, mean: ArrayLike, P: ArrayLike) -> None:
        m = np.atleast_1d(real(mean, "mean"))
        n = m.shape[-1]
        p = real(P, "P")
        if p.ndim == 0 or (p.ndim == 1 and p.shape == (n,)):
            if np.any(p < 0):
                raise BadValue(f"`P` holds the variance {np.min(p):g}, none below 0 was expected")
            p = np.diag(np.broadcast_to(p, (n,)))
        if p.shape != (*m.shape, n):
            raise BadShape(f"`P` has shape {p.shape}, {(*m.shape, n)} was expected from `mean`")
        object.__setattr__(self, "mean", frozen(m))
        object.__setattr__(self, "P", frozen(covariance(p, "P")))

    @classmethod
    def of(cls, mean: Array, P: Array, within: tuple[Array, Array] | None = None) -> "Normal":
        """Wrap a kernel's answer, (T, nx) and (T, nx, nx), without judging it again; intervals stay inside `within`."""
        answer = object.__new__(cls)
        object.__setattr__(answer, "mean", mean)
        object.__setattr__(answer, "P", P)
        if within is not None:
            object.__setattr__(answer, "_within", within)
        return answer

    @property
    def sd(self) -> Array:
        """Standard deviations, shaped as `mean`."""
        return np.sqrt(np.maximum(np.diagonal(self.P, axis1=-2, axis2=-1), 0.0))

    def interval(self, level: float = 0.9) -> tuple[Array, Array]:
        """Return mean minus and plus the two-sided quantile of `level`."""
        from statistics import NormalDist

        half = NormalDist().inv_cdf(0.5 + 0.5 * _level(level)) * self.sd
        lo, hi = self.mean - half, self.mean + half
        if self._within is not None:
            lo, hi = np.clip(lo, *self._within), np.clip(hi, *self._within)
        return lo, hi

    def through(self, D: Array) -> "Normal":
        """Return what is known of ``D x``; bounds of the state are left out."""
        return Normal.of(self.mean @ D.T, D @ self.P @ D.T)

    def sample(self, rng: np.random.Generator) -> Array:
        """Draw one state (nx,)."""
        return rng.multivariate_normal(self.mean, self.P, method="eigh")


@dataclass(frozen=True, eq=False)
class Both:
    """The state is a Gaussian centre plus something bounded: ``x = mean + N(0, P) + b``, ``|b_i| <= half_i``.

    Of b nothing is known but the bound: it may be a bias that never averages out. An interval of level p therefore
    holds the state with probability p at least, whatever b is.

    Parameters
    ----------
    mean : (nx,) or (T, nx) array
    P : (nx, nx) or (T, nx, nx) array
        Covariance of the centre, in squared units of the state.
    half : (nx,) or (T, nx) array
        Half-widths of the bounded part.

    Examples
    --------
    >>> both = Both(np.array([0.0]), np.array([[1.0]]), np.array([2.0]))
    >>> [float(end[0].round(3)) for end in (both.interval(0.95)[1], both.plain(2.0)[1])]
    [3.645, 4.0]
    """

    mean: Array
    P: Array
    half: Array
    guaranteed = False

    @property
    def sd(self) -> Array:
        """Standard deviations of the centre, shaped as `mean`."""
        return np.sqrt(np.maximum(np.diagonal(self.P, axis1=-2, axis2=-1), 0.0))

    def interval(self, level: float = 0.9) -> tuple[Array, Array]:
        """Return the shortest interval about the mean that holds the state with probability `level` for every b.

        Its half-width is ``sd * biased_quantile(half / sd, level)``, below ``half + z sd`` of the two-sided quantile z.
        """
        from statistics import NormalDist

        level, sd = _level(level), self.sd
        inside = self.half < 1e6 * sd  # beyond, one end of the interval is all that counts
        ratio = np.divide(self.half, sd, out=np.zeros_like(sd), where=inside)
        far = self.half + max(NormalDist().inv_cdf(level), 0.0) * sd
        size = np.where(inside, sd * biased_quantile(ratio, level), far)
        return self.mean - size, self.mean + size

    def through(self, D: Array) -> "Both":
        """Return what is known of ``D x``: the bounded parts add up in the worst way."""
        return Both(self.mean @ D.T, D @ self.P @ D.T, self.half @ np.abs(D).T)

    def plain(self, kappa: float = 3.0) -> tuple[Array, Array]:
        """Return mean minus and plus ``half + kappa * sd``, the interval of Hanebeck, Horn and Schmidt."""
        size = self.half + kappa * self.sd
        return self.mean - size, self.mean + size


def biased_quantile(bias: Array, level: float) -> Array:
    """Return the c with ``P(|N(bias, 1)| <= c) = level``, shaped as `bias`, which is not negative.

    Newton's method between the one-sided and the two-sided quantile beside the bias, held by bisection.
    """
    from statistics import NormalDist

    from scipy.special import ndtr

    t = np.asarray(bias, dtype=np.float64)
    lo = np.maximum(t + NormalDist().inv_cdf(level), 0.0)
    hi = t + NormalDist().inv_cdf(0.5 + 0.5 * level)
    c = lo.copy()
    for _ in range(60):
        miss = ndtr(t - c) + ndtr(-t - c) - (1.0 - level)  # falls as c grows
        lo, hi = np.where(miss > 0, c, lo), np.where(miss > 0, hi, c)
        slope = (np.exp(-0.5 * (t - c) ** 2) + np.exp(-0.5 * (t + c) ** 2)) / np.sqrt(2.0 * np.pi)
        step = c + np.divide(miss, slope, out=np.zeros_like(c), where=slope > 0)
        new = np.where((step >= lo) & (step <= hi), step, 0.5 * (lo + hi))
        if np.all(np.abs(new - c) <= 1e-14 * np.maximum(c, 1.0)):
            break
        c = new
    return np.asarray(c)


@dataclass(frozen=True, eq=False)
class Shaped:
    """The state has these moments: a Gaussian bent by skewness and kurtosis.

    Quantiles are those of the beta law (Pearson's type I) with the same four moments: between two ends, as bounded
    noise leaves a state, and flatter than a Gaussian. Tails heavier than those of any beta law follow from the
    expansion of Cornish and Fisher (1938).

    Parameters
    ----------
    mean : (T, nx) array
    P : (T, nx, nx) array
        Covariance.
    skew, kurt : (T, nx) arrays
        Third and fourth standardised cumulants of each entry; 0 for a Gaussian.
    within : tuple of arrays or None
        (lo, hi) that every state is known to lie in: intervals end there.
    """

    mean: Array
    P: Array
    skew: Array
    kurt: Array
    within: tuple[Array, Array] | None = None
    guaranteed = False

    @property
    def sd(self) -> Array:
        """Standard deviations."""
        return np.asarray(np.sqrt(np.diagonal(self.P, axis1=-2, axis2=-1)))

    def interval(self, level: float = 0.9) -> tuple[Array, Array]:
        """Return the quantiles that leave the same probability outside on either side, each (T, nx)."""
        from statistics import NormalDist

        top = NormalDist().inv_cdf(0.5 + 0.5 * _level(level))
        a, b = np.clip(self.skew, -1.0, 1.0), np.clip(self.kurt, -1.2, 4.0)
        lo, hi = np.full(self.mean.shape, np.inf), np.full(self.mean.shape, -np.inf)
        # Far out the expansion may turn back; a wider level never gives a narrower interval.
        for z in np.linspace(0.0, top, 9):
            for sign in (-1.0, 1.0):
                q = sign * z
                bent = q + (q**2 - 1) * a / 6 + (q**3 - 3 * q) * b / 24 - (2 * q**3 - 5 * q) * a**2 / 36
                lo, hi = np.minimum(lo, bent), np.maximum(hi, bent)
        tail = 0.5 - 0.5 * level
        beta = _beta(a, b, tail), _beta(a, b, 1.0 - tail)
        lo, hi = np.where(np.isnan(beta[0]), lo, beta[0]), np.where(np.isnan(beta[1]), hi, beta[1])
        lo, hi = self.mean + self.sd * lo, self.mean + self.sd * hi
        if self.within is not None:
            lo, hi = np.clip(lo, *self.within), np.clip(hi, *self.within)
        return lo, hi

    def through(self, D: Array) -> "Shaped":
        """Return what is known of ``D x``; third and fourth cumulants add as those of independent entries do."""
        P = D @ self.P @ D.T
        sd = np.sqrt(np.maximum(np.diagonal(P, axis1=-2, axis2=-1), 1e-300))
        share = D * self.sd[..., None, :] / sd[..., None]
        return Shaped(
            self.mean @ D.T,
            P,
            np.asarray((share**3 @ self.skew[..., None])[..., 0]),
            np.asarray((share**4 @ self.kurt[..., None])[..., 0]),
        )


def _beta(skew: Array, kurt: Array, p: float) -> Array:
    """Return the standardised p-quantile of the beta law with these cumulants, NaN where there is none."""
    from scipy.special import betaincinv

    b1, b2 = skew**2, kurt + 3.0
    left = 6.0 + 3.0 * b1 - 2.0 * b2
    some = left > 1e-2
    r = np.maximum(6.0 * (b2 - b1 - 1.0) / np.where(some, left, 1.0), 1e-2)
    root = np.sign(skew) * (r + 2.0) * np.sqrt(b1 / ((r + 2.0) ** 2 * b1 + 16.0 * (r + 1.0)))
    # shapes with a peak at an end, not two
    a, b = np.maximum(0.5 * r * (1.0 - root), 1.0), np.maximum(0.5 * r * (1.0 + root), 1.0)
    z = (betaincinv(a, b, p) - a / (a + b)) * (a + b) * np.sqrt((a + b + 1.0) / (a * b))
    return np.asarray(np.where(some, z, np.nan))


@dataclass(frozen=True, eq=False)
class Cloud:
    """The state is spread as weighted points.

    Parameters
    ----------
    points : (T, N, nx) array
    weights : (T, N) array
        Not negative, each row sums to one.
    """

    points: Array
    weights: Array
    guaranteed = False

    @property
    def mean(self) -> Array:
        """Weighted mean, (T, nx)."""
        return np.asarray(np.einsum("tn,tni->ti", self.weights, self.points))

    def through(self, D: Array) -> "Cloud":
        """Return what is known of ``D x``."""
        return Cloud(self.points @ D.T, self.weights)

    def interval(self, level: float = 0.9) -> tuple[Array, Array]:
        """Return the weighted quantiles that leave the same weight outside on either side, each (T, nx)."""
        tail = 0.5 - 0.5 * _level(level)
        order = np.argsort(self.points, axis=1)
        points = np.take_along_axis(self.points, order, axis=1)
        weights = np.take_along_axis(np.broadcast_to(self.weights[..., None], self.points.shape), order, axis=1)
        below = np.cumsum(weights, axis=1)
        below /= below[:, -1:]
        ends = []
        for share in (tail, 1.0 - tail):
            first = np.argmax(below >= share * (1 - 1e-12), axis=1)
            ends.append(np.take_along_axis(points, first[:, None], axis=1)[:, 0])
        return ends[0], ends[1]


def part(spread: Spread | None, rows: slice) -> Spread | None:
    """Return the spread of some rows of an answer, which does not hold the others in memory."""
    if isinstance(spread, Shaped):
        mean, P, skew, kurt = spread.mean[rows], spread.P[rows], spread.skew[rows], spread.kurt[rows]
        return Shaped(mean.copy(), P.copy(), skew.copy(), kurt.copy(), spread.within)
    if isinstance(spread, Normal):
        return Normal.of(spread.mean[rows].copy(), spread.P[rows].copy(), spread._within)
    if isinstance(spread, Box):
        return Box(spread.lo[rows], spread.hi[rows], guaranteed=spread.guaranteed)
    if isinstance(spread, Both):
        return Both(spread.mean[rows].copy(), spread.P[rows].copy(), spread.half[rows].copy())
    if isinstance(spread, Cloud):
        return Cloud(spread.points[rows].copy(), spread.weights[rows].copy())
    return None


def _level(level: float) -> float:
    if not isinstance(level, int | float | np.number) or not 0.0 < level < 1.0:
        raise BadValue(f"`level` is {level!r}, a number between 0 and 1 was expected", hint="level=0.9")
    return float(level)
