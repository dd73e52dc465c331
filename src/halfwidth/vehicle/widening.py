"""What hidden fixes ask of an interval: the factor on a standard deviation with which it holds as often as wanted.

A model's variance in a gap is too small where its errors are not as independent as it takes them, and too large where
it takes them for larger than they are (measured on real logs: a 90 % interval held 45 to 98 % of hidden fixes). For
each hidden fix there is a factor on the standard deviation that would just have covered it; the wanted quantile of
these factors, each stretch counting the same, is what they ask for.

A log has room for few stretches of a minute and for many of five seconds, and a model may be right about the edges of a
gap, where the error of a fix counts, and wrong about its middle, where the sensors do. So the hidden fixes of each
length are divided into `GROUPS` by the standard deviation s that the model states, and all groups of all lengths are
read together: the logarithm of the factor is taken to be

    log factor(s, L) = a + b log s + c log L + f(log s) + g(log L)

with Gaussian a, b and c (`_SIZE`, `_SLOPE_BY_SD`, `_SLOPE_BY_LENGTH`), about the middle of what was tested, and
Ornstein-Uhlenbeck processes f and g (`_BEND`): a model whose errors grow faster or slower than it says goes on doing so
in gaps up to twice (`_BEYOND`) as long as the log can test. Each group shows it with the variance of a sample quantile
of n Gaussian errors, p (1 - p) / (2 z phi(z))^2 / n, times the square of how much further the quantiles about the
wanted one lie apart than those of a Gaussian (`Tested.tail`): where most stretches are easy and a few are hard, the
quantile is known much less well. For n a stretch counts as three in each group (errors at one place of it are alike),
or as one where a sensor is missing. These sizes make what hidden stretches of three real logs and of sixteen simulated
drives ask for about as probable as any do; they were not chosen by how often intervals then hold.

That gives the logarithm of the factor for any s and L, and its variance v. The interval is the one that holds as often
as wanted if the logarithm is Gaussian and errors are (`_widened`), so that few stretches give a wide interval and not a
lucky one. This is an observed frequency on this log, no guarantee.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Errors of one stretch that count as independent: where sensors carry the path through it (two axes, two halves),
#: those of them in one group (on real logs, by how much the shares inside differ between stretches: from 2 in the group
#: of the largest standard deviations to 5 in that of the smallest), and where what the vehicle did is guessed, so that
#: one wrong guess makes all of the stretch wrong.
PER_STRETCH, PER_GROUP, PER_GUESS = 4, 3, 1

#: Groups of hidden fixes of one length; one where what the vehicle did is guessed.
GROUPS = 4

#: Standard deviations of the logarithm of the factor before anything is tested: of its size, of its slopes by the
#: logarithms of standard deviation and length, and of how it bends about them, in either; where what the vehicle did is
#: guessed, of how it bends with the length; and the change in either's logarithm over which bends are felt.
_SIZE, _SLOPE_BY_SD, _SLOPE_BY_LENGTH, _BEND, _BEND_GUESSED, _FELT = 1.0, 0.4, 0.2, 0.1, 0.6, 1.5

#: Logarithm of how far beyond what was tested the slopes go on.
_BEYOND = float(np.log(2.0))

#: Factor on the standard deviation where a log has too few fixes to test it: on real logs thinned to 8 to 12 fixes a
#: model's own 90 % interval held 60 to 80 % of the rest.
UNTESTED = 2.0

#: A test narrows no interval further than by this factor.
LEAST = 0.1

#: Variances of a logarithm for which the widening is tabulated.
_VARIANCES = np.concatenate(([0.0], np.geomspace(1e-3, 4.0, 30)))


@dataclass(frozen=True)
class Tested:
    """What hiding fixes for one length showed.

    Parameters
    ----------
    length_s : float
        Length of the hidden stretches, s.
    stretches : int
        How many there were.
    mean_m, max_m : float
        Mean error, and mean over stretches of the largest one, m.
    coverage : float
        Share of hidden fixes inside the interval before it was widened, each axis by itself.
    inflation : float
        Factor on the standard deviation that makes the interval hold, all lengths read together; the mean over the
        hidden fixes.
    silent : tuple of str
        Sensors that were hidden together with the fixes.
    by : str
        What filled the stretches.
    half_m : float
        Mean half-width at the hidden fixes with the inflation, m.
    side : str
        ``"both"`` where fixes stand on both sides of the stretches, ``"one"`` beyond the first or last fix.
    asked : tuple of (float, float, float)
        For each group of hidden fixes its standard deviation, m, the factor that it asks for by itself, and how many
        independent errors that rests on.
    tail : float
        How many times further the quantiles about the wanted one lie apart, in logarithms, than those of a Gaussian; 1
        at least.
    guessed : bool
        Whether what the vehicle did was guessed for lack of a sensor: longer gaps are then another thing.
    part : (float, float)
        From where to where these sensors were hidden, as shares of a stretch.
    """

    length_s: float
    stretches: int
    mean_m: float
    max_m: float
    coverage: float
    inflation: float
    silent: tuple[str, ...] = ()
    by: str = ""
    half_m: float = 0.0
    side: str = "both"
    asked: tuple[tuple[float, float, float], ...] = ()
    tail: float = 1.0
    guessed: bool = False
    part: tuple[float, float] = (0.0, 1.0)


def asked(
    needed: Sequence[Floats], sds: Sequence[Floats], level: float, errors: float, groups: int
) -> tuple[tuple[float, float, float], ...]:
    """Divide hidden fixes by their standard deviations, and say what each group asks for; see `Tested.asked`.

    Parameters
    ----------
    needed, sds : sequences of arrays
        For each stretch the factors that just reach its fixes, and the standard deviations there, m.
    level : float
        Wanted share.
    errors : float
        How many of a group are independent.
    groups : int

    Returns
    -------
    tuple of (float, float, float)
    """
    sd, factor, weight = np.concatenate(sds), np.concatenate(needed), _weights(needed)
    order = np.argsort(sd, kind="stable")
    group = np.minimum(np.cumsum(weight[order]) * groups * (1 - 1e-9), groups - 1).astype(int)
    found = []
    for k in np.unique(group):
        mine = order[group == k]
        asks = quantile(factor[mine], weight[mine], level, errors)
        found.append((float(np.exp(np.log(sd[mine]).mean())), asks, errors))
    return tuple(found)


def _weights(needed: Sequence[Floats]) -> Floats:
    """Return how much each hidden fix counts: each stretch the same."""
    return np.concatenate([np.full(one.size, 1.0 / (len(needed) * one.size)) for one in needed])


def tail_of(needed: Sequence[Floats], level: float) -> float:
    """Return how heavy the tail of some factors is about the wanted quantile; see `Tested.tail`.

    Parameters
    ----------
    needed : sequence of arrays
        For each stretch the factors that just reach its fixes.
    level : float
        Wanted share.

    Returns
    -------
    float
    """
    factor, weight = np.concatenate(needed), _weights(needed)
    order = np.argsort(factor)
    below, above = max(2 * level - 1, level / 2), 1 - 0.3 * (1 - level)
    low, high = np.interp((below, above), np.cumsum(weight[order]), factor[order])
    apart = np.log(max(high, 1e-9) / max(low, 1e-9)) / np.log(_z(above) / _z(below))
    return max(1.0, float(apart))


def independent(n: int, length: float, room: float, each: int) -> float:
    """Return how many independent errors there are in n stretches in so many seconds, some of which may overlap."""
    return each * n / max(1.0, n * length / max(room, length))


def factor_for(needed: Sequence[Floats], length: float, level: float, room: float) -> float:
    """Return the factor that stretches of one length ask for in the next one of this length.

    Parameters
    ----------
    needed : sequence of arrays
        For each stretch the factors that just reach its fixes.
    length : float
        Of each stretch, s.
    level : float
        Wanted share.
    room : float
        How many seconds of the log they lie in.

    Returns
    -------
    float
    """
    errors = independent(len(needed), length, room, PER_STRETCH)
    asks = quantile(np.concatenate(needed), _weights(needed), level, errors)
    tail = tail_of(needed, level)
    one = Tested(length, len(needed), 0.0, 0.0, 0.0, 1.0, asked=((1.0, asks, errors),), tail=tail)
    return float(inflation([one], length, np.ones(1), level, least=0.0)[0])


def sized(found: Sequence[Tested], level: float) -> list[Tested]:
    """Give each test the factor that all of them together ask for."""
    every = []
    for one in found:
        sd = np.array([sd for sd, _, _ in one.asked])
        factor = float(inflation(found, one.length_s, sd, level, least=0.0) @ sd / sd.sum())
        every.append(replace(one, inflation=factor, half_m=one.half_m * factor))
    return every


def quantile(factor: Floats, weight: Floats, level: float, errors: float) -> float:
    """Return the factor that covers a share of the hidden fixes.

    The largest of few errors is no high quantile: it is then enlarged to the one that is wanted as if the errors were
    Gaussian.

    Parameters
    ----------
    factor, weight : (n,) arrays
        Factors that just reach the fixes, and how much each counts.
    level : float
        Wanted share.
    errors : float
        How many of them are independent.

    Returns
    -------
    float
    """
    order = np.argsort(factor)
    share = np.cumsum(weight[order])
    # the i-th of N errors has median rank (i - 0.3) / (N + 0.4)
    at, beyond = (level * (errors + 0.4) + 0.3) / errors, 1.0
    if at > 1.0:
        beyond = max(1.0, _z(level) / _z(max((errors - 0.3) / (errors + 0.4), 0.5)))
    return beyond * float(np.interp(at, share / share[-1], factor[order]))


def inflation(found: Sequence[Tested], length: float, sd: Floats, level: float, *, least: float = 1.0) -> Floats:
    """Return the factors on standard deviations in a gap.

    Below `least` none is taken. Without a test each is `UNTESTED`.

    Parameters
    ----------
    found : sequence of Tested
    length : float
        Length of the gap, s.
    sd : (n,) array
        Standard deviations, m.
    level : float
        Wanted share.
    least : float

    Returns
    -------
    (n,) array
    """
    groups = [(one.length_s, *asked) for one in found for asked in one.asked]
    if not groups:
        return np.full(np.shape(sd), UNTESTED)
    lengths, sds, factors, errors = np.array(groups).T
    at = np.log(np.column_stack((np.maximum(sds, 1e-9), lengths)))
    to = np.log(np.column_stack((np.maximum(sd, 1e-9), np.full(np.shape(sd), max(length, 1e-3)))))
    z = _z(level)
    tail = np.average([one.tail for one in found], weights=[one.stretches for one in found])
    noise = (tail / (2 * z * NormalDist().pdf(z))) ** 2 * level * (1 - level) / errors
    slopes = np.array([_SLOPE_BY_SD, _SLOPE_BY_LENGTH]) ** 2
    bends = np.array([_BEND, _BEND_GUESSED if any(one.guessed for one in found) else _BEND]) ** 2
    middle, low, high = at.mean(axis=0), at.min(axis=0) - _BEYOND, at.max(axis=0) + _BEYOND
    to = np.clip(to, low, high)

    def alike(x: Floats, y: Floats) -> Floats:
        """Return the covariance of the logarithm of the factor at (n, 2) and (m, 2), (n, m)."""
        bent = np.exp(-np.abs(x[:, None] - y) / _FELT) @ bends
        return np.asarray(_SIZE**2 + ((x - middle) * slopes) @ (y - middle).T + bent)

    cross = alike(at, to)
    known = np.linalg.solve(alike(at, at) + np.diag(noise), cross)
    before = _SIZE**2 + (to - middle) ** 2 @ slopes + bends.sum()
    variance = np.maximum(before - np.einsum("ij,ij->j", known, cross), 0.0)
    half = np.exp(np.log(np.maximum(factors, LEAST)) @ known) * _widened(level, variance)
    half = np.maximum(half, max(least, LEAST)) * sd
    # what is stated to be less sure is not shown as surer
    order = np.argsort(sd, kind="stable")
    half[order] = np.maximum.accumulate(half[order])
    return np.asarray(half / np.maximum(sd, 1e-300))


def _z(level: float) -> float:
    return NormalDist().inv_cdf(0.5 + level / 2)


def _widened(level: float, variance: Floats) -> Floats:
    """Return the factors with which Gaussian intervals hold as often as wanted.

    The logarithm of their size is known with some variances (n,), which count up to the largest of the table.
    """
    return np.asarray(np.interp(variance, _VARIANCES, _table(level)))


@lru_cache(maxsize=16)
def _table(level: float) -> Floats:
    """Return these factors for `_VARIANCES`, by bisection of what the mixture of intervals holds."""
    z, normal = _z(level), NormalDist()
    nodes, weight = np.polynomial.hermite_e.hermegauss(15)
    weight = weight / weight.sum()
    found = []
    for spread in np.sqrt(_VARIANCES):
        low, high = 1.0, 200.0  # few stretches narrow no interval
        for _ in range(24):
            tried = float(np.sqrt(low * high))
            held = sum(
                w * (2 * normal.cdf(z * tried * float(np.exp(-spread * u))) - 1)
                for u, w in zip(nodes, weight, strict=True)
            )
            low, high = (tried, high) if held < level else (low, tried)
        found.append(tried)
    return np.array(found)
