"""Where the newest windows of a stream expect the state to be now."""

from typing import Any

import numpy as np

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.methods._linearised import expected, growth
from halfwidth.model import Linear, Model
from halfwidth.record import Record
from halfwidth.spread import Box


class Forecasts:
    """Where the newest windows expect the state to be now.

    Each window's newest state moves along with the model. The half-widths are estimates of what the state may stray by
    in a step: since the last fix their largest among these windows adds up, as bounds do. Where they are 0, as optimal
    ones often are, nothing adds up.
    """

    def __init__(self, model: Model, memory: int) -> None:
        nx = model.nx
        # row 0 is the newest estimate, the others those of windows, one written over the oldest when all are in use
        self._x, self._q = np.zeros((memory + 2, nx)), np.zeros((memory + 1, nx))
        self._taken = self._count = 0
        self.grown = self._none = np.zeros(nx)
        self._step = _constant_step(model)
        bounds = model.bounds
        self._box = (bounds.lo, bounds.hi) if isinstance(bounds, Box) else (None, None)

    def move(self, model: Model, record: Record, k: int, x: Array) -> Array:
        """Move on to row k; returns what is expected after x, the estimate of the row before."""
        held: Array = self._x[: self._count + 1]
        held[0] = x
        if self._step is None:
            moved = expected(model, record, k, held)
            if self._box[0] is not None:
                moved = np.minimum(np.maximum(moved, self._box[0]), self._box[1])
            held[:] = moved
        else:
            _core.window_forecast(held, *self._step, None if record.u is None else record.u[k], *self._box)
        return np.asarray(held[0])

    def grow(self, model: Model, record: Record, k: int, x: Array) -> None:
        """No window ends here: what states may stray by adds up; x as in `move`."""
        if self._count:
            self.grown = growth(model, record, k, x, self.grown, self._q[: self._count].max(axis=0))

    def take(self, x: Array, q: Array | list[float]) -> None:
        """Add the estimate of a window that ends in a fix, and its half-widths."""
        at = self._taken % len(self._q)
        self._x[1 + at], self._q[at] = x, q
        self._taken += 1
        self._count = min(self._taken, len(self._q))
        self.grown = self._none

    def bounds(self) -> tuple[Array, Array, int]:
        """Return the least and the largest, each (1, nx), and of how many windows."""
        n = self._count
        if n == 0:
            return np.full((1, len(self.grown)), -np.inf), np.full((1, len(self.grown)), np.inf), 0
        low, high = _core.window_ends(self._x[1 : n + 1], self.grown)
        return low, high, n

    def save(self) -> list[Any]:
        """Return all of it as plain numbers, the oldest window first."""
        first = self._taken % len(self._q) if self._count == len(self._q) else 0
        return [
            *(np.roll(v[: self._count], -first, axis=0).tolist() for v in (self._x[1:], self._q)), self.grown.tolist()
        ]  # fmt: skip

    def load(self, saved: list[Any]) -> None:
        """Take up what `save` returned."""
        x, q, grown = saved
        self._taken = self._count = len(x)
        if x:
            self._x[1 : len(x) + 1], self._q[: len(q)] = x, q
        self.grown = np.array(grown, dtype=float)


def _constant_step(model: Model) -> tuple[Array, Array | None] | None:
    """Return E^-1 A and E^-1 B of a model whose matrices are constant and known."""
    if not isinstance(model, Linear) or any(m is not None and not m.constant for m in (model.A, model.B, model.E)):
        return None
    given = [None if m is None else m.single for m in (model.A, model.B)]
    if model.E is not None:
        given = [None if m is None else np.asarray(np.linalg.solve(model.E.single, m)) for m in given]
    A, B = (None if m is None else np.ascontiguousarray(m, dtype=float) for m in given)
    if A is None or np.isnan(A).any() or (B is not None and np.isnan(B).any()):
        return None
    return A, B
