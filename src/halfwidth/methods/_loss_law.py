"""The loss law, learned: by expectation maximisation from what a smoother counts, or from the counts of a filter."""

from typing import Any

import numpy as np

from halfwidth.array import Array
from halfwidth.loss import Bernoulli, revised

_CLIP = 1e-6


def learn(loss: Any, smooth: Any, *, iterations: int = 50, tolerance: float = 1e-4) -> tuple[Any, dict[str, Any]]:
    """Learn a loss law, and the noise of lost samples where asked, by expectation maximisation.

    Parameters
    ----------
    loss : Bernoulli or Markov
        Made with ``unknown``; its numbers are the start, its `worth` the prior (2 at one half is flat).
    smooth : function (loss) -> kernel's answer
        With `modes`, `pairs`, `loglik`, and the record under "y", "seen".
    iterations : int
    tolerance : float
        Stop when no probability moves by more.

    Returns
    -------
    loss : Bernoulli or Markov
    info : dict
        ``loss``, ``loglik_path``, ``iterations``, ``converged``.
    """
    prior = loss
    path: list[float] = []
    converged = False
    for _ in range(iterations):
        out = smooth(loss)
        path.append(float(out["loglik"].sum()))
        new = _maximised(prior, loss, out)
        moved = max(float(np.max(np.abs(a - b))) for a, b in zip(_numbers(new), _numbers(loss), strict=True))
        loss = new
        if moved < tolerance:
            converged = True
            break
    return loss, {"loss": loss, "loglik_path": np.array(path), "iterations": len(path), "converged": converged}


def _numbers(loss: Any) -> list[Array]:
    numbers = [loss.received] if isinstance(loss, Bernoulli) else [loss.stay_received, loss.stay_lost]
    return numbers + ([loss.noise] if loss.unknown_noise and loss.noise is not None else [])


def _maximised(prior: Any, loss: Any, out: dict[str, Any]) -> Any:
    """Return the loss that the expected counts of a smoother make most probable."""
    seen = out["seen"]
    patterns = loss.received_in(seen.shape[1])  # (M, G)
    counts = np.maximum(prior.prior_counts(patterns.shape[1]) - 1.0, 0.0)  # a flat prior adds nothing
    groups = loss.groups(seen.shape[1])
    law: dict[str, Array] = {}
    if isinstance(loss, Bernoulli):
        there = np.stack([seen[:, list(g)].any(axis=1) for g in groups], axis=1)
        p = np.where(there, out["modes"] @ patterns, 0.0).sum(axis=0) + counts[:, 0, 1]
        total = there.sum(axis=0) + counts[:, 0].sum(axis=-1)
        law["received"] = np.clip(p / np.maximum(total, 1e-300), _CLIP, 1 - _CLIP)
    else:
        pairs = out["pairs"]
        for name, state in (("stay_received", 1), ("stay_lost", 0)):
            before = patterns == bool(state)
            stay = np.einsum("ig,ij,jg->g", before, pairs, before) + counts[:, state, state]
            total = np.einsum("ig,ij->g", before, pairs) + counts[:, state].sum(axis=-1)
            law[name] = np.clip(stay / np.maximum(total, 1e-300), _CLIP, 1 - _CLIP)
    noise = _noise_of_lost(loss, out) if loss.unknown_noise else None
    return revised(loss, noise=noise, **{name: _shaped(value, loss) for name, value in law.items()})


def _shaped(value: Array, loss: Any) -> Array:
    """Return one number a sensor, (G,), as a scalar where one number was given for a single sensor."""
    return value.reshape(()) if len(value) == 1 and not loss.shape else value


def _noise_of_lost(loss: Any, out: dict[str, Any]) -> Array:
    """Return the covariance of lost samples, entries that are missing filled by their conditional moments."""
    y, seen, R0 = out["y"], out["seen"], out["R0"]
    lost = np.where(seen.any(axis=1), out["modes"][:, 0], 0.0)
    ny = y.shape[1]
    total = np.zeros((ny, ny))
    for pattern in np.unique(seen, axis=0):
        rows = (seen == pattern).all(axis=1)
        if not pattern.any() or lost[rows].sum() == 0.0:
            continue
        i, j = np.flatnonzero(pattern), np.flatnonzero(~pattern)
        v = np.zeros((int(rows.sum()), ny))
        v[:, i] = y[np.ix_(rows, i)] - np.broadcast_to(loss.center, (ny,))[i]
        if len(j):
            gain = np.linalg.solve(R0[np.ix_(i, i)], R0[np.ix_(i, j)]).T
            v[:, j] = v[:, i] @ gain.T
            total[np.ix_(j, j)] += lost[rows].sum() * (R0[np.ix_(j, j)] - gain @ R0[np.ix_(i, j)])
        total += np.einsum("t,ti,tj->ij", lost[rows], v, v)
    # one pseudo-sample of the start keeps it positive definite when hardly anything was lost
    return np.asarray((total + R0) / (lost.sum() + 1.0))


def updated(loss: Any, law: Array) -> Any:
    """Return the loss with the law that the filter has learned by its last row; `law` is (G, 2)."""
    if isinstance(loss, Bernoulli):
        return revised(loss, received=_shaped(law[:, 1], loss))
    return revised(loss, stay_received=_shaped(law[:, 1], loss), stay_lost=_shaped(1 - law[:, 0], loss))
