"""How long a window should be: the memory that predicts the next output best.

Pavelková and Kárný (2013) leave the choice of the memory open.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from halfwidth.array import Array
from halfwidth.methods._protocol import Estimator
from halfwidth.methods.map import BatchLP
from halfwidth.methods.sequential import expected, filled
from halfwidth.methods.window import Window
from halfwidth.model import Linear
from halfwidth.record import Record
from halfwidth.result import Estimate


@dataclass(frozen=True, eq=False)
class MemoryChoice:
    """How well windows of several lengths predict the next output.

    Parameters
    ----------
    memories : tuple of int
    score : (candidates,) array
        Mean absolute one-step prediction error in units of each output's own scale, lower is better.
    error : (candidates, ny) array
        The same by output, in its unit.
    spread : (candidates,) array
        Standard error of the score's difference from the best one.
    best : int
        The shortest memory whose score is within one standard error of the best.
    """

    memories: tuple[int, ...]
    score: Array
    error: Array
    spread: Array
    best: int

    def plot(self, ax: Any = None) -> Any:
        """Draw score against memory; returns the axes.

        Raises
        ------
        Missing
            If matplotlib is not installed.
        """
        try:
            import matplotlib.pyplot as plt
        except ImportError as exc:
            from halfwidth.errors import Missing

            raise Missing("`plot` needs matplotlib", hint="pip install 'halfwidth[plot]'") from exc
        if ax is None:
            _, ax = plt.subplots()
        ax.errorbar(self.memories, self.score, yerr=self.spread, marker="o", capsize=3)
        ax.axvline(self.best, linestyle="--", color="grey")
        ax.set_xlabel("memory, rows")
        ax.set_ylabel("one-step prediction error, scaled")
        ax.set_title(f"memory {self.best}")
        return ax


def choose_memory(
    model: Linear, record: Record, method: Estimator | None = None, *, memories: Sequence[int] = (5, 10, 15, 25, 35, 50)
) -> MemoryChoice:
    """Choose the memory of `Window` by how well each candidate predicts the next seen output.

    Every candidate runs over the record once; its newest state is carried one step forwards by the model and compared
    with the output that comes. The paper leaves this choice open.

    Parameters
    ----------
    model : Linear
        Without unknown entries, or with a method that estimates them.
    record : Record
    method : estimator, optional
        ``BatchLP()`` if absent.
    memories : sequence of int
    """
    method = BatchLP() if method is None else method
    longest = max(memories)
    first = min(longest, len(record) // 2)
    scale: Array | None = None
    errors = []
    for memory in memories:
        est = Window(method, memory).run(model, record)
        error = np.abs(prediction_errors(model, record, est))[first:]
        scale = np.nanmean(error, axis=0) if scale is None else scale
        errors.append(error)
    assert scale is not None
    scale = np.where(scale > 0, scale, 1.0)
    count_y = np.maximum(np.count_nonzero(~np.isnan(errors[0]), axis=1), 1)
    lost = np.isnan(errors[0]).all(axis=1)
    each = np.array([np.where(lost, np.nan, np.nansum(e / scale, axis=1) / count_y) for e in errors])
    score = np.nanmean(each, axis=1)
    top = int(np.argmin(score))
    difference = each - each[top]
    count = max(1, int(np.count_nonzero(~np.isnan(each[top]))))
    # Neighbouring errors share most of a window: one independent value a memory's length.
    spread = np.array(
        [np.nanstd(d) / math.sqrt(max(1.0, count / m)) for d, m in zip(difference, memories, strict=True)]
    )
    good = np.flatnonzero(score <= score[top] + spread)
    best = int(memories[int(good[0])]) if len(good) else int(memories[top])
    return MemoryChoice(
        tuple(int(m) for m in memories), score, np.array([np.nanmean(e, axis=0) for e in errors]), spread, best
    )


def prediction_errors(model: Linear, record: Record, estimate: Estimate) -> Array:
    """Return y minus its one-step prediction from the newest state one row before, (T, ny); NaN where unseen."""
    errors = np.full((len(record), model.ny), np.nan)
    thetas = estimate.info.get("theta")
    dt = record.steps(model.dt)
    for k in range(1, len(record)):
        known = model if thetas is None or not np.size(thetas) else filled(model, thetas[k - 1])
        t, step = float(record.t[k]), float(dt[k])
        y = known.C.at(t, step, k) @ expected(known, record, k, estimate.x[k - 1][None])[0]
        if known.F is not None:
            y = np.linalg.solve(known.F.at(t, step, k), y)
        errors[k] = np.where(record.seen[k], record.y[k] - y, np.nan)
    return errors
