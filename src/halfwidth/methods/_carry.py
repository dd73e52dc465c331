"""What a window of `Posterior` hands on when rows leave it: knowledge of half-widths and of the state at its edge.

Half-widths are constant or drift slowly, so what a row told of them stays true after the row has left. The evidence of
window i is, about its posterior, a power beside a Gaussian,

    log Z_i(s) ~ sum_j power_ij log s_j + pull_i' s - s' H_i s / 2,
    H_i = -Cov(g - power_i / s, s) Cov(s)^-1,    pull_i = E (g - power_i / s) + H_i E s,

where g is the slope of log Z_i in s, power_ij >= 0 what g_j has along 1 / s_j beside a line, and the moments are those
of the posterior over s (the nodes of `Posterior`). A half-width that is well seen leaves a power and a falling line;
one that drowns in other noise is felt through s^2 and leaves a parabola about 0. A quadratic in log s or s^(1/2) fits
the first alone: early windows, whose posterior is wide, would make the second smaller than it is. A row lies in as
many windows as a window has rows, N: each window counts 1 / N, and only once **all** of its rows have left, so no row
speaks twice and the prior of the newest window holds none of its own data. A light window has too few nodes to tell a
slope: the next that can speaks for it. The sum of overlapping window likelihoods
is a composite likelihood: its slope has mean 0 at the truth as each window's own has. The sum fades by exp(-1 / rows)
a row.

As a factor of the evidence bounds count as an event that small half-widths make likely, and over many windows that adds
up. So they are a condition in all rows but 26, those of the newest window and those that have left alike
(`condition`): a quadratic of log P(inside | s), the evidence of the chain with its bounds alone, is taken off. It is
found anew in every N-th window. Its slope has what expectation propagation leaves out to second order: the windows'
evidence has it, and the difference would add up over many windows. What is left out beyond that is about the same in
both: with the bounds' slope by particles in its place the slope at the truth is no nearer to 0
(`benchmarks/posterior.py slopes`).

The state before the first row of a window is what the sites of the rows that have left make of it: the forwards message
of expectation propagation, a Gaussian.

References
----------
Varin, Reid and Firth (2011), An overview of composite likelihood methods, Statistica Sinica 21. Minka (2001), UAI.
"""

import base64
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.methods._sites import Frame, Sites
from halfwidth.spread import Normal

if TYPE_CHECKING:
    from halfwidth.methods._answer import Answer

#: Sweeps of the chain with its bounds alone, and the log share of a cavity inside a bound from which it is believed.
_SWEEPS, _WORST = 50, -60.0


#: Rows in which staying inside the bounds counts as an event: a prior against half-widths so wide that bounds alone
#: shape the path. In longer records bounds are a condition in the others.
EVENT = 26


def condition(rows: float) -> float:
    """Return the power of the evidence of the bounds alone that the evidence of so many rows is divided by."""
    return max(0.0, 1.0 - EVENT / max(rows, 1.0))


class Known:
    """What is known of half-widths s = (q, r): a factor s^power exp(pull' s - s' precision s / 2).

    Parameters
    ----------
    pull, precision, power : (p,), (p, p), (p,) arrays

    Attributes
    ----------
    values : (p (p + 2),) array
        All of it, one after the other.
    """

    __slots__ = ("values",)
    values: Array

    def __init__(self, pull: Array, precision: Array, power: Array) -> None:
        self.values = np.concatenate((pull, np.ravel(precision), power), dtype=float)

    @classmethod
    def of(cls, values: Array) -> "Known":
        """Wrap what the core found."""
        known = object.__new__(cls)
        known.values = values
        return known

    @classmethod
    def none(cls, p: int) -> "Known":
        """Nothing is known of p half-widths."""
        return cls.of(np.zeros(p * (p + 2)))

    @property
    def _p(self) -> int:
        return math.isqrt(self.values.size + 1) - 1

    @property
    def pull(self) -> Array:
        """(p,)."""
        return self.values[: self._p]

    @property
    def precision(self) -> Array:
        """(p, p)."""
        p = self._p
        return self.values[p : -p or None].reshape(p, p)

    @property
    def power(self) -> Array:
        """(p,)."""
        return self.values[self.values.size - self._p :]

    def __iter__(self) -> Iterator[Array]:
        return iter((self.pull, self.precision, self.power))

    def plus(self, other: "Known", weight: float = 1.0) -> "Known":
        """Add what other rows told."""
        return Known.of(self.values + weight * other.values)

    def times(self, weight: float) -> "Known":
        """Return it weighted."""
        return Known.of(weight * self.values)


def inside(chain: Sites, s: Array) -> Known:
    """Return the logarithm of the evidence of the bounds alone as a quadratic about half-widths s (p,)."""
    known, problem = Known.none(len(s)), chain.outside
    free = np.flatnonzero(chain.free)
    if problem is None or not free.size:
        return known
    h = 0.02
    steps = np.exp(h * np.eye(len(s))[free])
    members = np.concatenate([s[None], s * steps, s / steps])
    found = _core.ep_run(problem, members, np.zeros(len(members)), _SWEEPS, 1e-4, 1.0, None)
    g = found["slope"][:, free]
    q = free.size
    column = (g[1 : q + 1] - g[q + 1 :]) / (2.0 * h)
    if not (np.isfinite(found["log_z"]).all() and np.isfinite(column).all() and (found["worst"] > _WORST).all()):
        return known
    s = s[free]
    H = -(0.5 * (column + column.T) - np.diag(g[0])) / (s[:, None] * s)
    more = (found["second"][1 : q + 1] - found["second"][q + 1 :]) / (2.0 * h)
    more[~np.isfinite(more)] = 0.0  # so sharp a box that its cumulants overflow
    known.precision[np.ix_(free, free)] = H
    known.pull[free] = (g[0] + more) / s + H @ s
    return known


class Start(NamedTuple):
    """Where a search may start: half-widths (p,), and what a solved chain hands on that they belong to."""

    s: Array
    before: _core.EpHanded | None = None


class Carried:
    """What the windows of a stream hand on.

    Parameters
    ----------
    p : int
        Number of groups, as in `Sites`.
    rows : float
        Rows over which what is known of half-widths fades to 1 / e.

    Attributes
    ----------
    start : Start or None
        Half-widths at the mode of the newest window, and its sites.
    frames : dict
        What windows with the same outputs seen have in common.
    """

    def __init__(self, p: int, rows: float) -> None:
        self.fade = math.exp(-1.0 / rows)
        self.gone, self.kept_in = Known.none(p), Known.none(p)  # by windows that have left, and their bounds alone
        self.rows = 0.0  # rows that have left, faded
        # newest row of a window, both of its own, weighted, and for how many windows it speaks
        self.waiting: list[tuple[int, Known, Known, int]] = []
        self.inside = Known.none(p)  # bounds alone of the last window asked
        self.given: Known | None = None  # what the newest window was told
        self.count = 0  # windows, of those with a new row
        self.unsaid = 0  # ... of which none has told anything yet
        self.start: Start | None = None
        self.first: Normal | None = None  # the state before the first row, once rows have left
        self.frames: dict[bytes, Frame] = {}
        self._newest: _core.EpHanded | None = None  # of the newest window; it has the messages at its edge

    def known(self, first: int, rows: int) -> Known | None:
        """Return what the windows tell that have no row from `first` on, for one of so many rows; None: nothing."""
        gone, kept_in, fade = self.gone.values, self.kept_in.values, self.fade
        gone *= fade
        kept_in *= fade
        self.rows *= fade
        while self.waiting and self.waiting[0][0] < first:
            _, told, bounds, windows = self.waiting.pop(0)
            gone += told.values
            kept_in += bounds.values
            self.rows += windows
        self.given = None
        if self.rows:
            self.given = Known.of(gone - condition(rows + self.rows) * (kept_in + self.inside.values))
        return self.given

    def leave(self, a: int) -> None:
        """Let go of the first a rows of the newest window: they tell the state that the next one begins at."""
        if a:
            state = None if self._newest is None else self._newest.state(a)
            self.first = None if state is None else Normal.of(*state)

    def take(self, answer: "Answer", newest: int, rows: int, *, counts: bool) -> None:
        """Keep what a window told: its newest row's number, its number of rows, and whether it told anything new."""
        if not answer.status.good:
            self._newest = None
            self.start = None if self.start is None else Start(self.start.s)
            return
        self.start = answer.start
        self._newest = answer.handed
        if not counts:
            return
        if self.count % rows == 0:
            self.inside = inside(answer.chain, self.start.s)
        self.count += 1
        self.unsaid += 1
        if answer.tells:
            share = self.unsaid / rows
            self.waiting.append((newest, answer.told.times(share), self.inside.times(share), self.unsaid))
            self.unsaid = 0

    def save(self) -> dict[str, Any]:
        """Return all of it as plain numbers."""
        start = self.start
        return {
            "gone": [_plain(self.gone), _plain(self.kept_in), _plain(self.inside), self.rows],
            "waiting": [[k, _plain(told), _plain(inside), windows] for k, told, inside, windows in self.waiting],
            "count": [self.count, self.unsaid],
            "s": None if start is None else start.s.tolist(),
            "before": None if start is None or start.before is None else _plain_handed(start.before),
            "first": None if self.first is None else [self.first.mean.tolist(), self.first.P.tolist()],
            "edge": self._newest is not None,
        }

    def load(self, saved: dict[str, Any]) -> None:
        """Take up what `save` returned."""
        *sums, rows = saved["gone"]
        self.gone, self.kept_in, self.inside = (_known(v) for v in sums)
        self.rows = float(rows)
        self.waiting = [
            (int(k), _known(told), _known(bounds), int(windows)) for k, told, bounds, windows in saved["waiting"]
        ]
        self.count, self.unsaid = map(int, saved["count"])
        self.start = None
        if saved["s"] is not None:
            before = None if saved["before"] is None else _handed(saved["before"])
            self.start = Start(np.array(saved["s"], dtype=float), before)
        self.first = None if saved["first"] is None else Normal(*saved["first"])
        self._newest = self.start.before if saved["edge"] and self.start is not None else None


def _plain(known: Known) -> list[Any]:
    return [float(v) for v in known.values]


def _known(saved: list[Any]) -> Known:
    return Known.of(np.array(saved, dtype=float))


def _plain_handed(handed: _core.EpHanded) -> list[Any]:
    *plain, arrays = handed.save()
    return [*plain, [base64.b64encode(np.ascontiguousarray(v, dtype="<f8").tobytes()).decode() for v in arrays]]


def _handed(saved: list[Any]) -> _core.EpHanded:
    *plain, arrays = saved
    return _core.EpHanded(*plain, [np.frombuffer(base64.b64decode(v), dtype="<f8").astype(float) for v in arrays])
