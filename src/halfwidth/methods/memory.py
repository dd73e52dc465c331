"""How long a window should be: the memory that foretells the next output best.

Pavelková and Kárný (2013) leave the choice of the memory open. Where a method has an evidence Z, a window of memory m
that ends in row t says how probable the outputs of that row were given the m rows before it,

    log p(y_t | y_t-m .. y_t-1) = log of the mean of Z(with y_t) / Z(without y_t) over the half-widths,

weighted by what the window without y_t knows of them; where y_t lies beyond all of that, the ratio of both evidences
with half-widths integrated out. The sum over the rows is the evidence of the memory: with windows as
long as the record it is log Z of the whole, and shorter ones win where half-widths or the model drift.

References
----------
Dawid (1984), Statistical theory: the prequential approach, JRSS A 147(2).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import halfwidth._core as _core
from halfwidth.array import Array, wrapped
from halfwidth.errors import BadValue, Refused, hinted
from halfwidth.methods._answer import Answer
from halfwidth.methods._linearised import expected, filled
from halfwidth.methods._protocol import Estimator
from halfwidth.methods._sites import Sites, sites
from halfwidth.methods._sliding import Sliding, Solved
from halfwidth.methods.map import BatchLP
from halfwidth.methods.posterior import Posterior
from halfwidth.methods.window import Window
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.record import Record
from halfwidth.show import pyplot

#: Sweeps, agreement of moments and damping at nodes, where the evidence of two chains is compared.
_SWEEPS, _CLOSE, _DAMPING = 100, 1e-4, 0.7
#: With fewer effective nodes than this the newest outputs lie beyond what the window before had expected.
_FEW = 4.0


@dataclass(frozen=True, eq=False)
class MemoryChoice:
    """How well windows of several lengths foretell the next output.

    Parameters
    ----------
    memories : tuple of int
    score : (candidates,) array
        Mean absolute one-step prediction error in units of each output's own scale, lower is better.
    error : (candidates, ny) array
        The same by output, in its unit.
    evidence : (candidates,) array or None
        Mean log density of a row's outputs given the window before it, higher is better; None where the method has no
        evidence. Minus infinity: a row that no trajectory fits.
    spread : (candidates,) array
        Standard error of the difference from the best one, of the evidence where there is one and of the score else.
    best : int
        The shortest memory that is within one standard error of the best.
    """

    memories: tuple[int, ...]
    score: Array
    error: Array
    evidence: Array | None
    spread: Array
    best: int

    def __str__(self) -> str:
        none = np.full(len(self.memories), np.nan) if self.evidence is None else self.evidence
        lines = ["memory  log evidence a row  prediction error  standard error"]
        lines += [
            f"{m:6d}  {a:18.4f}  {b:16.4f}  {c:14.4f}{'  best' if m == self.best else ''}"
            for m, a, b, c in zip(self.memories, none, self.score, self.spread, strict=True)
        ]
        return "\n".join(lines)

    def plot(self, ax: Any = None) -> Any:
        """Draw evidence, or the score where there is none, against memory; returns the axes.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            New ones if absent.

        Raises
        ------
        Missing
            If matplotlib is not installed.
        """
        if ax is None:
            _, ax = pyplot().subplots()
        value = self.score if self.evidence is None else self.evidence
        ax.errorbar(self.memories, value, yerr=self.spread, marker="o", capsize=3)
        ax.axvline(self.best, linestyle="--", color="grey")
        ax.set_xlabel("memory, rows")
        ax.set_ylabel("one-step prediction error, scaled" if self.evidence is None else "log evidence a row")
        ax.set_title(f"memory {self.best}")
        return ax


def choose_memory(
    model: Model,
    record: Record,
    method: Estimator | None = None,
    *,
    memories: Sequence[int] = (5, 10, 15, 25, 35, 50),
    recall: float = 40.0,
) -> MemoryChoice:
    """Choose the memory of `Window` by how well each candidate foretells the next seen output.

    Every candidate runs over the record once; its newest state is carried one step forwards by the model and compared
    with the output that comes. With ``Posterior()`` the candidates are judged by their evidence, beside which the error
    stands. The rows of the longest window, at most half the record, are left out for all.

    Parameters
    ----------
    model : Linear or Nonlinear
        Without unknown entries, or with a method that estimates them. There, and with a nonlinear model, memories are
        judged by their errors alone.
    record : Record
    method : estimator, optional
        ``BatchLP()`` if absent.
    memories : sequence of int
    recall : float
        As in `Window`: 0 takes every window on its own, so that its memory is all it knows.

    Raises
    ------
    BadValue
        If there are no memories, or no row is left to be foretold.
    Refused
        If the method cannot work on the model.
    """
    method = BatchLP() if method is None else method
    if not len(memories):
        raise BadValue("`memories` is empty, numbers of rows were expected", hint="memories=(5, 15, 50)")
    reason = Window(method, min(memories), recall=recall).refuses(model)
    if reason is not None:
        message, hint = hinted(reason)
        raise Refused(message, hint=hint)
    first = min(max(memories), len(record) // 2)
    if not record.seen[max(first, 1) :].any():
        raise BadValue(f"`record` has no output to foretell after its first {first} rows", hint="a longer record")
    plain = isinstance(model, Linear) and not model.theta_entries
    told = plain and isinstance(method, Posterior) and method.method == "ep"
    errors, densities = [], []
    for memory in memories:
        window = Window(method, memory, recall=recall)
        if told and isinstance(model, Linear):
            x, density = _foretold(window, model, record)
            densities.append(density[first:])
            errors.append(np.abs([output_errors(model, record, k, x[k]) for k in range(first, len(record))]))
        else:
            est = window.run(model, record)
            errors.append(np.abs(prediction_errors(model, record, est.x, est.info.get("theta")))[first:])
    scale = np.nanmean(errors[0], axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    count_y = np.maximum(np.count_nonzero(~np.isnan(errors[0]), axis=1), 1)
    lost = np.isnan(errors[0]).all(axis=1)
    each = np.array([np.where(lost, np.nan, np.nansum(e / scale, axis=1) / count_y) for e in errors])
    score = np.nanmean(each, axis=1)
    evidence = None
    judged = -each
    if told:
        judged = np.array(densities)
        judged = judged[:, ~np.isnan(judged).any(axis=0)]
        evidence = judged.mean(axis=1) if judged.size else np.full(len(memories), np.nan)
        if not np.isfinite(evidence).any():
            judged = -each
    value = np.nanmean(judged, axis=1)
    top = int(np.argmax(value))
    count = max(1, int(np.count_nonzero(~np.isnan(judged[top]))))
    # Neighbouring errors share most of a window: one independent value a memory's length.
    with np.errstate(invalid="ignore"):
        spread = np.array(
            [np.nanstd(d) / math.sqrt(max(1.0, count / m)) for d, m in zip(judged - judged[top], memories, strict=True)]
        )
        good = np.flatnonzero(value >= value[top] - spread)
    best = int(memories[int(good[0])]) if len(good) else int(memories[top])
    mean = np.array([np.nanmean(e, axis=0) for e in errors])
    return MemoryChoice(tuple(int(m) for m in memories), score, mean, evidence, spread, best)


class _Foretelling(Sliding):
    """A window that says of each row what was expected of it given the rows before, and how probable its outputs were.

    Attributes
    ----------
    expected : (nx,) array
    density : float
    """

    def __init__(self, window: Window, model: Model, t: float) -> None:
        super().__init__(window, model, t)
        self.expected, self.density = np.asarray(model.x0.mean, dtype=float), math.nan
        self._near: Array | None = None  # half-widths of the row before: a good start

    def _solve(self, model: Model, part: Record, a: int) -> Solved:
        assert isinstance(model, Linear)
        method, held = self.window.method, self.carried
        assert isinstance(method, Posterior)
        solved = None if held is None else super()._solve(model, part, a)
        known = None if held is None else held.given
        y = part.y.copy()
        y[-1] = np.nan
        before = method.answer(model, Record(part.t, y, part.u), start=self._near, known=known)
        est = before.estimate
        self.expected, self.density = est.x[-1], math.nan
        if est.status.good:
            self._near = before.start.s
            if part.seen[-1].any():
                self.density, surely = _density(method, before, model, part)
                if not surely:
                    self.density = _ratio(method.answer(model, part, known=known), before)
        if solved is None:  # nothing is handed on, so the newest row need not be solved
            s = np.full(model.nx + model.ny, np.nan)
            solved = Solved(np.vstack([est.info["x0"], est.x]), np.zeros(0), s, est.status, 0, {})
        return solved


def _density(method: Posterior, before: Answer, model: Linear, part: Record) -> tuple[float, bool]:
    """Return log p(newest outputs | rows before), and whether the nodes of the window before reach that far."""
    chain = sites(model, part, outliers=bool(method.outliers))
    if np.any(chain.free != before.chain.free):  # the first output of its kind: nothing foretells it
        return math.nan, True
    for name in ("m0", "P0", "half0"):  # where x0 is free, its wide prior is made from the rows there are
        chain.problem[name] = before.chain.problem[name]
    found = before.found
    log_weight = found["log_weight"][: int(found["nodes"])]
    with np.errstate(invalid="ignore"):
        log_w = log_weight - log_weight.max() + _at_nodes(chain, before)[0] - _at_nodes(before.chain, before)[0]
    log_w = np.where(np.isfinite(log_w), log_w, -np.inf)
    if not np.isfinite(log_w.max()):
        return -math.inf, not chain.free.any()
    w = np.exp(log_w - log_w.max())
    density = float(log_w.max() + math.log(w.sum() / np.exp(log_weight - log_weight.max()).sum()))
    return density, len(w) == 1 or float(w.sum() ** 2 / (w @ w)) > _FEW


def _ratio(after: Answer, before: Answer) -> float:
    """Return the same from the evidence with and without the newest outputs, under the prior of the window without."""
    if not after.estimate.status.good:
        return -math.inf
    log_weight = after.found["log_weight"][: int(after.found["nodes"])]
    told = [_at_nodes(chain, after)[1] for chain in (after.chain, before.chain)]
    w = np.exp(log_weight - log_weight.max())
    shift = math.log(float(w @ np.exp(told[1] - told[0])) / float(w.sum()))
    wide = [np.diagonal(a.chain.problem["P0"]) for a in (after, before)]
    shift += 0.5 * float(np.log(wide[0][wide[0] > 0]).sum() - np.log(wide[1][wide[1] > 0]).sum())
    return float(after.found["log_evidence"]) - float(before.found["log_evidence"]) + shift


def _at_nodes(chain: Sites, answer: Answer) -> tuple[Array, Array]:
    """Return log Z of a chain and the logarithm of its prior's factor `told` at the nodes of an answer, each (K,)."""
    found, free = answer.found, np.flatnonzero(chain.free)
    phi = found["phi"][: int(found["nodes"])]
    s = np.tile(answer.start.s, (len(phi), 1))
    s[:, free] = np.exp(phi[:, : free.size])
    eps = 1.0 / (1.0 + np.exp(-phi[:, -1])) if phi.shape[1] > free.size else np.full(len(phi), answer.rate)
    run = _core.ep_run(chain.problem, s, eps, _SWEEPS, _CLOSE, _DAMPING, None)
    told = np.clip(run["learned"][:, free] / np.maximum(chain.count[free], 1.0), 1e-12, 1.0)
    second = np.where(np.isfinite(run["second"]), run["second"], 0.0)  # as the core takes it
    return run["log_z"] + second, 0.5 * np.log(told).sum(axis=1)


def _foretold(window: Window, model: Linear, record: Record) -> tuple[Array, Array]:
    """Return what is expected of each row (T, nx) given the window before, and the log density of its outputs, (T,)."""
    dt = record.steps(model.dt)
    rows = _Foretelling(window, model, float(record.t[0] - dt[0]))
    x, density = np.empty((len(record), model.nx)), np.full(len(record), np.nan)
    for t in range(len(record)):
        rows.push(record.y[t], None if record.u is None else record.u[t], float(dt[t]))
        x[t], density[t] = rows.expected, rows.density
    return x, density


def output_errors(model: Model, record: Record, k: int, x: Array) -> Array:
    """Return y of row k minus what the state x (nx,) makes of it, (ny,); NaN where unseen."""
    if isinstance(model, Nonlinear):
        return wrapped(np.where(record.seen[k], record.y[k] - model.output(x), np.nan), model.y_angles)
    t, step = float(record.t[k]), float(record.steps(model.dt)[k])
    y: Array = model.C.at(t, step, k) @ x
    if model.F is not None:
        y = np.asarray(np.linalg.solve(model.F.at(t, step, k), y))
    return np.asarray(np.where(record.seen[k], record.y[k] - y, np.nan))


def prediction_errors(model: Model, record: Record, x: Array, thetas: Array | None = None) -> Array:
    """Return y minus its one-step prediction from the newest state x (T, nx) one row before, (T, ny); NaN where unseen.

    `thetas` holds the unknown entries that each row's window found, (T, n_theta).
    """
    errors = np.full((len(record), model.ny), np.nan)
    for k in range(1, len(record)):
        known = model
        if isinstance(model, Linear) and thetas is not None and np.size(thetas):
            known = filled(model, thetas[k - 1])
        errors[k] = output_errors(known, record, k, expected(known, record, k, x[k - 1][None])[0])
    return errors
