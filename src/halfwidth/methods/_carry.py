"""What a window of `Posterior` hands on when rows leave it: knowledge of half-widths and of the state at its edge.

Half-widths are constant or drift slowly, so what a row told of them stays true after the row has left. The evidence of
window i is, about its posterior, a quadratic in u = s^(1/2),

    log Z_i(u) ~ pull_i' u - u' H_i u / 2,    H_i = -Cov(g, u) Cov(u)^-1,    pull_i = E g + H_i E u,

where g is the slope of log Z_i and the moments are those of the posterior over u (the nodes of `Posterior`). A row lies
in as many windows as a window has rows, N: each window counts 1 / N, and only once **all** of its rows have left, so no
row speaks twice and the prior of the newest window holds none of its own data. The sum of overlapping window
likelihoods is a composite likelihood: its slope has mean 0 at the truth as each window's own has. The sum fades by
exp(-1 / rows) a row.

Bounds are a condition on what is carried: as a mere factor of the evidence they count as an event that small
half-widths make likely, and over many windows that adds up. A quadratic of log P(inside | u), the evidence of the
chain with its bounds alone, is taken off for every N-th window, N times as heavy.

The state before the first row of a window is what the sites of the rows that have left make of it: the forwards message
of expectation propagation, a Gaussian.

References
----------
Varin, Reid and Firth (2011), An overview of composite likelihood methods, Statistica Sinica 21. Minka (2001), UAI.
"""

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.methods._sites import CONTAMINATED, Sites
from halfwidth.spread import Normal

if TYPE_CHECKING:
    from halfwidth.methods.posterior import Answer

#: Power of a half-width in which its posterior is nearly Gaussian: 0 is no tail there.
WARP = 0.5
#: Sweeps of the chain with its bounds alone, and the log share of a cavity inside a bound from which it is believed.
_SWEEPS, _WORST = 50, -60.0


#: Rows in which staying inside the bounds counts as an event: a prior against half-widths so wide that bounds alone
#: shape the path. In longer records bounds are a condition in the others.
EVENT = 26


def condition(rows: float) -> float:
    """Return the power of the evidence of the bounds alone that the evidence of so many rows is divided by."""
    return max(0.0, 1.0 - EVENT / max(rows, 1.0))


class Known(NamedTuple):
    """What is known of half-widths (q, r): the logarithm pull' u - u' precision u / 2 in u = s^(1/2)."""

    pull: Array
    precision: Array

    @classmethod
    def none(cls, p: int) -> "Known":
        """Nothing is known of p half-widths."""
        return cls(np.zeros(p), np.zeros((p, p)))

    def plus(self, other: "Known", weight: float = 1.0) -> "Known":
        """Add what other rows told."""
        return Known(self.pull + weight * other.pull, self.precision + weight * other.precision)

    def times(self, weight: float) -> "Known":
        """Return it weighted."""
        return Known(weight * self.pull, weight * self.precision)

    def of(self, free: NDArray[np.bool_]) -> "Known":
        """Return what is known of the free ones alone, whatever the others are, as a proper Gaussian."""
        f, rest = np.flatnonzero(free), np.flatnonzero(~free)
        H, h = self.precision[np.ix_(f, f)], self.pull[f]
        if rest.size and self.precision[rest].any():
            gain = self.precision[np.ix_(f, rest)] @ np.linalg.pinv(self.precision[np.ix_(rest, rest)], hermitian=True)
            H, h = H - gain @ self.precision[np.ix_(rest, f)], h - gain @ self.pull[rest]
        found = Known.none(len(free))
        value, vector = np.linalg.eigh(H / (unit := _unit(H)) / unit[:, None])
        keep = value > 0  # a direction that only curves the other way says nothing
        basis = vector[:, keep] * unit[:, None]
        found.precision[np.ix_(f, f)] = (basis * value[keep]) @ basis.T
        found.pull[f] = basis @ (vector[:, keep].T @ (h / unit))
        return found


def _unit(H: Array) -> Array:
    """Return a scale of each coordinate, so that eigenvalues compare."""
    d = np.sqrt(np.abs(np.diagonal(H)))
    return np.where(d > 0, d, 1.0)


def told(answer: "Answer") -> Known:
    """Return what the rows of one window tell of its half-widths."""
    chain, found = answer.chain, answer.found
    free = np.flatnonzero(chain.free)
    q, K = free.size, int(found["nodes"])
    known = Known.none(len(chain.free))
    if not q:
        return known
    log_weight = found["log_weight"][:K]
    phi, slope = found["phi"][:K, :q], found["slope"][:K, :q]
    u = np.exp(WARP * phi)
    g = slope / (WARP * u)
    if K == 1:
        H = found["H"][:q, :q] / (WARP**2 * u[0][:, None] * u[0])
        if answer.known is not None:
            H = H - answer.known.precision[np.ix_(free, free)]
        pull = g[0] + H @ u[0]
    else:
        sound = np.isfinite(log_weight) & np.isfinite(g).all(axis=1)
        u, g, log_weight, second = u[sound], g[sound], log_weight[sound], found["second"][:K][sound]
        if len(u) < q + 2:
            return known
        for flat in (1.0, 0.5, 0.25, 0.0):  # few nodes carry the weight: they alone cannot tell a slope
            w = np.exp(flat * (log_weight - log_weight.max()))
            w /= w.sum()
            if 1.0 / (w @ w) > 2 * q + 2:
                break
        mean, level = w @ u, w @ g
        du, dg = u - mean, g - level
        S = (w[:, None] * du).T @ du
        S[np.diag_indices(q)] *= 1.0 + 1e-6
        H = -np.linalg.solve(S, (w[:, None] * du).T @ dg)
        H = 0.5 * (H + H.T)
        # what log Z lacks has no slope of its own: that of a line through the nodes
        pull = level + np.linalg.solve(S, du.T @ (w * second)) + H @ mean
    if np.isfinite(H).all() and np.isfinite(pull).all():
        known.precision[np.ix_(free, free)] = H
        known.pull[free] = pull
    return known


def inside(chain: Sites, s: Array) -> Known:
    """Return the logarithm of the evidence of the bounds alone, to second order about half-widths s (p,)."""
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
    u = s[free] ** WARP
    slope = g[0] / (WARP * u)
    H = -(0.5 * (column + column.T) - np.diag(WARP * g[0])) / (WARP**2 * u[:, None] * u)
    known.precision[np.ix_(free, free)] = H
    known.pull[free] = slope + H @ u
    return known


def messages(chain: Sites, sites: tuple[Array, ...], stages: int) -> list[tuple[Array, Array]]:
    """Return mean and covariance of x_0 .. x_stages, each given what lies up to it, by the sites of a solved chain."""
    p = chain.problem
    n = len(p["m0"])
    m, D = (np.asarray(v).reshape(-1, n) for v in sites[:2])
    tau, nu = (np.ravel(v) for v in sites[2:])

    def at(name: str, t: int) -> Any:
        stack = p.get(name)
        if stack is None:
            return None
        index = p.get(f"{name}_index")
        return stack[index[t] if index is not None else t if len(stack) > 1 else 0]

    x, P = p["m0"] + m[0], p["P0"] + np.diag(D[0])
    found = []
    for t in range(stages + 1):
        if t:
            A, G, Q = at("A", t - 1), at("G", t - 1), at("Q", t - 1)
            x = A @ x + p["b"][t - 1] + (m[t] if G is None else G @ m[t])
            P = A @ P @ A.T + (np.diag(D[t]) if G is None else (G * D[t]) @ G.T)
            if Q is not None:
                P = P + Q
        for k in range(int(p["start"][t]), int(p["start"][t + 1])):
            h = p["h"][k]
            Ph = P @ h
            left = 1.0 + tau[k] * float(h @ Ph)
            if left > 1e-9:
                x = x + Ph * ((nu[k] - tau[k] * float(h @ x - p["y"][k])) / left)
                P = P - np.outer(Ph, Ph) * (tau[k] / left)
        found.append((x, 0.5 * (P + P.T)))
    return found


class Warm(NamedTuple):
    """Sites of a solved window: half-widths (p,), first row of each stage (T + 2,), (m, D, tau, nu) of `Sites`."""

    s: Array
    start: Array
    sites: tuple[Array, ...]

    def moved(self, chain: Sites, a: int) -> tuple[Array, Array, Array, Array] | None:
        """Return sites of the chain that begins `a` rows later: its new ones are the Gaussians of their variances.

        None where the two do not hold the same rows in common.
        """
        p = chain.problem
        n, start = len(p["m0"]), p["start"]
        m_, D_ = (v.reshape(-1, n) for v in self.sites[:2])
        tau_, nu_ = (np.ravel(v) for v in self.sites[2:])
        common, stages = len(m_) - 1 - a, len(start) - 1
        if common < 1 or common + 1 > stages:
            return None
        here, there = slice(start[1], start[common + 1]), slice(self.start[a + 1], self.start[-1])
        if here.stop - here.start != there.stop - there.start:
            return None
        m, D = np.zeros((1, stages, n)), np.empty((1, stages, n))
        D[0, 0] = p["half0"] ** 2 / 3.0
        D[0, 1:] = np.where(p["group_w"] >= 0, self.s[p["group_w"]] ** 2 / 3.0, 0.0)
        m[0, 1 : common + 1], D[0, 1 : common + 1] = m_[1 + a :], D_[1 + a :]
        kind, R = p["kind"], p["R"]
        box = np.where(p["group"] >= 0, self.s[p["group"]], 0.0)
        tau = np.where(kind < CONTAMINATED, 1.0 / np.maximum(box**2 / 3.0 + R, 1e-300), 0.0)[None]
        nu = np.zeros((1, len(kind)))
        tau[0, here], nu[0, here] = tau_[there], nu_[there]
        return m, D, tau, nu


class Carried:
    """What the windows of a stream hand on.

    Parameters
    ----------
    p : int
        Number of half-widths (q, r).
    rows : float
        Rows over which what is known of half-widths fades to 1 / e.

    Attributes
    ----------
    s : (p,) array or None
        Half-widths at the mode of the newest window.
    warm : Warm or None
        Its sites.
    """

    def __init__(self, p: int, rows: float) -> None:
        self.fade = math.exp(-1.0 / rows)
        self.gone, self.kept_in = Known.none(p), Known.none(p)  # by windows that have left, and their bounds alone
        self.rows = 0.0  # rows that have left, faded
        self.waiting: list[tuple[int, Known, Known]] = []  # newest row of a window, and both, weighted
        self.inside = Known.none(p)  # bounds alone of the last window asked
        self.s: Array | None = None
        self.count = 0  # windows that told something
        self.warm: Warm | None = None
        self.first: Normal | None = None  # the state before the first row, once rows have left
        self._edge: list[tuple[Array, Array]] | None = None  # messages of the newest window's stages ...
        self._newest: Answer | None = None  # ... or what they are made of

    def known(self, first: int, rows: int) -> Known | None:
        """Return what the windows tell that have no row from `first` on, for one of so many rows; None: nothing."""
        self.gone, self.kept_in = self.gone.times(self.fade), self.kept_in.times(self.fade)
        self.rows *= self.fade
        while self.waiting and self.waiting[0][0] < first:
            _, told_, inside_ = self.waiting.pop(0)
            self.gone, self.kept_in = self.gone.plus(told_), self.kept_in.plus(inside_)
            self.rows += 1.0
        if not self.rows:
            return None
        return self.gone.plus(self.kept_in.plus(self.inside), -condition(rows + self.rows))

    def leave(self, a: int) -> None:
        """Let go of the first a rows of the newest window: they tell the state that the next one begins at."""
        self.first = self._state(a) if a else self.first

    def _state(self, a: int) -> Normal | None:
        if self._edge is None and self._newest is not None:
            self._edge = messages(self._newest.chain, self._newest.found["sites"], a)
        if self._edge is None or len(self._edge) <= a:
            return None
        x, P = self._edge[a]
        d = np.diagonal(P)
        if not (np.isfinite(x).all() and np.isfinite(P).all() and (d > 0).all()):
            return None
        return Normal.of(x, P + np.diag(1e-12 * d))

    def take(self, answer: "Answer", newest: int, rows: int, *, counts: bool) -> None:
        """Keep what a window told: its newest row's number, its number of rows, and whether it told anything new."""
        self._edge, self._newest, self.warm = None, None, None
        if not answer.estimate.status.good:
            return
        self.s, self._newest = answer.start.s, answer
        self.warm = Warm(self.s, answer.chain.problem["start"], answer.found["sites"])
        if not counts:
            return
        if self.count % rows == 0:
            self.inside = inside(answer.chain, self.s)
        self.count += 1
        self.waiting.append((newest, told(answer).times(1.0 / rows), self.inside.times(1.0 / rows)))

    def save(self) -> dict[str, Any]:
        """Return all of it as plain numbers."""
        edge = self._edge
        if self._newest is not None:
            stages = len(self._newest.chain.problem["start"]) - 2
            edge = messages(self._newest.chain, self._newest.found["sites"], stages)
        return {
            "gone": [v.tolist() for v in self.gone],
            "waiting": [[k, known.pull.tolist(), known.precision.tolist()] for k, known in self.waiting],
            "count": self.count,
            "s": None if self.s is None else self.s.tolist(),
            "warm": None
            if self.warm is None
            else [self.warm.start.tolist(), [np.ravel(v).tolist() for v in self.warm.sites]],
            "first": None if self.first is None else [self.first.mean.tolist(), self.first.P.tolist()],
            "edge": None if edge is None else [[x.tolist(), P.tolist()] for x, P in edge],
        }

    def load(self, saved: dict[str, Any]) -> None:
        """Take up what `save` returned."""
        self.gone = Known(*(np.array(v, dtype=float) for v in saved["gone"]))
        self.waiting = [
            (int(k), Known(np.array(h, dtype=float), np.array(H, dtype=float))) for k, h, H in saved["waiting"]
        ]
        self.count = int(saved["count"])
        self.s = None if saved["s"] is None else np.array(saved["s"], dtype=float)
        self.warm = None
        if saved["warm"] is not None and self.s is not None:
            start, sites = saved["warm"]
            self.warm = Warm(self.s, np.array(start, dtype=int), tuple(np.array(v, dtype=float) for v in sites))
        first, edge = saved["first"], saved["edge"]
        self.first = None if first is None else Normal(*first)
        self._newest = None
        self._edge = None if edge is None else [(np.array(x, dtype=float), np.array(P, dtype=float)) for x, P in edge]
