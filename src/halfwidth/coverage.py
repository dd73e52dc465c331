"""Do intervals hold what they say? Coverage at every level, and ranks of the truth, with bands of what chance does.

Rows of one record are alike, so they count for fewer trials than there are: the scatter between records, or between
blocks of rows of a few long ones, says for how many. The bands are those of a binomial law of that many trials.

References
----------
Talts, Betancourt, Simpson, Vehtari and Gelman (2018), Validating Bayesian inference algorithms with simulation-based
calibration, arXiv:1804.06788. Dawid (1984), Statistical theory: the prequential approach, JRSS A 147(2).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from halfwidth.array import Array, real
from halfwidth.errors import BadShape, BadValue, Refused
from halfwidth.result import Estimate
from halfwidth.show import pyplot

#: Probability of the bands.
_BAND = 0.99
#: Fewer records than this are cut into blocks of rows.
_PIECES = 20
#: The level whose two ends are both the median.
_NONE = 1e-9


@dataclass(frozen=True, eq=False)
class Coverage:
    """Share of true states inside intervals of several levels.

    Parameters
    ----------
    method : str
    levels, inside : (k,) arrays
        Asked, and found.
    lo, hi : (k,) arrays
        Between these an honest interval is found with probability .99.
    trials : int
        Independent trials that the entries are worth.
    guaranteed : bool
        Whether the intervals are to hold every state whatever the level.
    """

    method: str
    levels: Array
    inside: Array
    lo: Array
    hi: Array
    trials: int
    guaranteed: bool

    @property
    def honest(self) -> bool:
        """Whether every share lies in its band; of guaranteed intervals, whether all states are inside."""
        if self.guaranteed:
            return bool(np.all(self.inside == 1.0))
        return bool(np.all((self.lo <= self.inside) & (self.inside <= self.hi)))

    def plot(self, ax: Any = None, *, label: str | None = None) -> Any:
        """Draw found against asked with the band, and return the axes; several go into one `ax`.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            New ones if absent.
        label : str, optional
            In the legend; the method if absent.

        Raises
        ------
        Missing
            If matplotlib is not installed.
        """
        fresh, ax = ax is None, _axes(ax)
        if fresh or not ax.lines:
            ax.plot([0, 1], [0, 1], color="#222222", lw=0.8, ls="--", label="exact")
        (line,) = ax.plot(self.levels, self.inside, marker="o", ms=3, lw=1.2, label=label or self.method)
        if not self.guaranteed:
            ax.fill_between(self.levels, self.lo, self.hi, color=line.get_color(), alpha=0.15, lw=0)
        ax.set_xlim(0, 1)
        ax.set_ylim(0, 1.02)
        ax.set_xlabel("level asked")
        ax.set_ylabel("share of states inside; shaded: 99 % of honest ones")
        ax.legend(loc="lower right", fontsize="small")
        return ax

    def __repr__(self) -> str:
        if self.guaranteed:
            return f"{self.method}, guaranteed: {self.inside[0]:.1%} inside"
        lines = [f"{self.method}, worth {self.trials} trials", "level   inside   99 % of honest ones"]
        lines += [
            f"{p:5.0%}  {s:7.1%}   {a:6.1%} to {b:6.1%}"
            for p, s, a, b in zip(self.levels, self.inside, self.lo, self.hi, strict=True)
        ]
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class Ranks:
    """Histogram of where truths lie in their posteriors: flat if those are right.

    A hump in the middle means spreads too wide, two horns too narrow, a slope a bias.

    Parameters
    ----------
    shares : (bins,) array
        Share of the ranks in each bin.
    lo, hi : float
        Between these an honest share is found with probability .99, each bin by itself.
    trials : int
        Independent trials that the ranks are worth.
    """

    shares: Array
    lo: float
    hi: float
    trials: int

    @classmethod
    def of(cls, values: ArrayLike, bins: int = 20) -> "Ranks":
        """Return the histogram of ranks scaled to 0 .. 1, (n,) independent ones or (n, k) with k of each trial.

        Parameters
        ----------
        values : (n,) or (n, k) array_like
            Such as the share of the draws of a posterior that lie below the truth.
        bins : int
            Bars of the histogram, at least 2.

        Raises
        ------
        BadValue
            If there are no values, one is not in 0 .. 1, or bins are too few.
        """
        given = real(values, "values")
        table = given.reshape(len(given), -1)
        if not table.size or bins < 2:
            raise BadValue(
                f"`values` has {table.size} ranks and `bins` is {bins!r}: some, and at least 2, were expected"
            )
        if np.any((table < 0) | (table > 1)):
            raise BadValue(f"`values` runs from {table.min():g} to {table.max():g}, ranks from 0 to 1 were expected")
        place = np.minimum((table * bins).astype(int), bins - 1)
        counts = np.array([np.bincount(row, minlength=bins) for row in place]) / table.shape[1]
        return cls._from(counts, table.size)

    @classmethod
    def _from(cls, counts: Array, total: int) -> "Ranks":
        """Return the ranks of pieces whose shares of each bin are `counts` (pieces, bins)."""
        even = np.full(counts.shape[1], 1.0 / counts.shape[1])
        trials = _trials(counts, even, total)
        lo, hi = _band(even[:1], trials)
        return cls(counts.mean(axis=0), float(lo[0]), float(hi[0]), trials)

    @property
    def chi2(self) -> float:
        """Probability of a histogram at least as uneven if the posteriors are right."""
        from scipy.stats import chi2

        k = len(self.shares)
        return float(chi2.sf(self.trials * k * np.sum((self.shares - 1.0 / k) ** 2), k - 1))

    def plot(self, ax: Any = None, *, label: str | None = None) -> Any:
        """Draw the histogram with its band and return the axes.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            New ones if absent.
        label : str, optional
            In the legend.

        Raises
        ------
        Missing
            If matplotlib is not installed.
        """
        ax, k = _axes(ax), len(self.shares)
        ax.bar((np.arange(k) + 0.5) / k, self.shares, width=0.95 / k, color="#9ecae1", label=label)
        ax.axhspan(self.lo, self.hi, color="#08519c", alpha=0.15, lw=0, label="99 % of even ones")
        ax.axhline(1.0 / k, color="#08519c", lw=0.8)
        ax.set_xlim(0, 1)
        ax.set_xlabel("rank of the truth in its posterior")
        ax.set_ylabel("share")
        ax.legend(loc="lower center", fontsize="small")
        return ax

    def __repr__(self) -> str:
        shares = " ".join(f"{100 * s:.1f}" for s in self.shares)
        return (
            f"ranks worth {self.trials} trials, share of each bin, %: {shares}\n"
            f"99 % of even ones: {100 * self.lo:.1f} to {100 * self.hi:.1f}; chance of one as uneven {self.chi2:.2g}"
        )


def coverage(estimates: Estimate | Sequence[Estimate], truths: Any, *, levels: ArrayLike | None = None) -> Coverage:
    """Count how many true states lie inside intervals of several levels.

    Parameters
    ----------
    estimates : Estimate or sequence of Estimates
        Of one method; each of its own record.
    truths : (T, nx) array_like or Truth, or a sequence of them
    levels : (k,) array_like, optional
        .1, .2, ..., .9, .95 and .99 if absent.

    Raises
    ------
    BadShape
        If a truth does not have the rows and states of its estimate.
    Refused
        If an estimate has no spread.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Gaussian(0.1), hw.Gaussian(1.0), hw.Normal([0.0], 1.0))
    >>> drawn = [hw.simulate(walk, T=50, seed=seed) for seed in range(20)]
    >>> hw.coverage([hw.estimate(walk, record) for _, record in drawn], [truth for truth, _ in drawn]).honest
    True
    """
    ests, true = _pairs(estimates, truths)
    p = np.r_[np.arange(1, 10) / 10, 0.95, 0.99] if levels is None else np.atleast_1d(real(levels, "levels"))
    if np.any((p <= 0) | (p >= 1)):
        raise BadValue(f"`levels` runs from {p.min():g} to {p.max():g}, shares between 0 and 1 were expected")
    held = []  # (rows, k) of each record: share of its states inside
    for est, x in zip(ests, true, strict=True):
        ends = [est.interval(float(level)) for level in p]
        held.append(np.stack([((lo <= x) & (x <= hi)).mean(axis=1) for lo, hi in ends], axis=1))
    total = sum(x.size for x in true)
    trials = _trials(_pieces(held), p, total)
    lo, hi = _band(p, trials)
    inside = np.concatenate(held).mean(axis=0)
    return Coverage(ests[0].method, p, inside, lo, hi, trials, all(est.guaranteed for est in ests))


def ranks(estimates: Estimate | Sequence[Estimate], truths: Any, *, bins: int = 20) -> Ranks:
    """Return the rank histogram of true states in their posteriors: simulation-based calibration.

    The truths must come from the very prior that the estimates use; ranks of anything else are collected in
    `Ranks.of`.

    Parameters
    ----------
    estimates, truths
        As in `coverage`.
    bins : int

    Raises
    ------
    BadShape
        If a truth does not have the rows and states of its estimate.
    Refused
        If an estimate has no spread, or a box, in which there are no ranks.
    """
    ests, true = _pairs(estimates, truths)
    if bins < 2:
        raise BadValue(f"`bins` is {bins!r}, at least 2 were expected")
    edges = np.arange(1, bins) / bins
    counts = []
    for est, x in zip(ests, true, strict=True):
        if est.guaranteed:
            raise Refused(f"`{est.method}` gives a guaranteed box, in which a state has no rank", hint="coverage(...)")
        below = np.zeros(x.shape, dtype=int)
        for p in edges:
            lo, hi = est.interval(max(abs(2.0 * float(p) - 1.0), _NONE))
            below += x > (lo if p < 0.5 else hi)
        counts.append(np.stack([(below == k).mean(axis=1) for k in range(bins)], axis=1))
    return Ranks._from(_pieces(counts), sum(x.size for x in true))


def _pairs(estimates: Estimate | Sequence[Estimate], truths: Any) -> tuple[list[Estimate], list[Array]]:
    ests = [estimates] if isinstance(estimates, Estimate) else list(estimates)
    given = [truths] if isinstance(estimates, Estimate) else list(truths)
    if not ests or len(ests) != len(given):
        raise BadShape(f"`truths` has {len(given)} entries for {len(ests)} estimates, one each was expected")
    true = [real(np.asarray(x), "truths") for x in given]
    for est, x in zip(ests, true, strict=True):
        if x.shape != est.x.shape:
            raise BadShape(f"a truth has shape {x.shape}, {est.x.shape} was expected from its estimate")
        if est.spread is None:
            raise Refused(f"`{est.method}` gives a point without a spread, so nothing covers")
    return ests, true


def _pieces(held: list[Array]) -> Array:
    """Return the mean of each record, or of blocks of rows where there are few records, (pieces, k)."""
    each = -(-_PIECES // len(held))
    return np.array([block.mean(axis=0) for rows in held for block in np.array_split(rows, min(each, len(rows)))])


def _trials(pieces: Array, p: Array, total: int) -> int:
    """Return how many independent trials `total` alike ones are worth, from the scatter between pieces."""
    if len(pieces) < 2:
        return total
    alone = p * (1.0 - p)
    scatter = pieces.var(axis=0, ddof=1) / len(pieces)
    return max(1, round(total / max(1.0, float(scatter.sum() / alone.sum()) * total)))


def _band(p: Array, trials: int) -> tuple[Array, Array]:
    from scipy.stats import binom

    tail = 0.5 * (1.0 - _BAND)
    return binom.ppf(tail, trials, p) / trials, binom.ppf(1.0 - tail, trials, p) / trials


def _axes(ax: Any) -> Any:
    return pyplot().subplots(figsize=(5, 5), layout="constrained")[1] if ax is None else ax
