"""The on-line form of `Hull`: rows go in, the newest guaranteed box comes out."""

import dataclasses
import json
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.array import Array
from halfwidth.errors import BadValue
from halfwidth.methods._bounds import Rows, one_row
from halfwidth.methods._boxes import Boxes, far_back
from halfwidth.methods._conflict import conflict_of
from halfwidth.methods._functional import Bound, functional_of
from halfwidth.methods._protocol import pushed_row
from halfwidth.methods._rows import window_starts
from halfwidth.methods.hull import FIXES, PROPOSERS, STRETCH, Hull, answer, middle, names_of, outer
from halfwidth.model import Linear
from halfwidth.record import Labels
from halfwidth.result import Estimate, Status
from halfwidth.spread import Box


class Live:
    """A hull fed row by row: it keeps the rows and boxes that the next window may need, nothing else."""

    def __init__(self, hull: Hull, model: Linear, t: float) -> None:
        self.hull, self.model, self.t, self.pushed = hull, model, t, 0
        self.times: list[float] = []
        self.seen = np.zeros((0, model.ny), dtype=bool)
        lo, hi = outer(model, 1)
        self.free = lo[1:], hi[1:]
        self.lo, self.hi = lo[:1], hi[:1]
        self.rows: Rows | None = None
        self.empty: str | None = None

    def push(self, y: ArrayLike | None, u: ArrayLike | None = None, dt: float | None = None) -> Estimate:
        """Fold one row in and return the newest estimate, of `lag` rows ago."""
        model = self.model
        row, inputs, step = pushed_row(model, y, u, dt)
        t = self.t + step
        rows = self._with(row, inputs, t, step)
        self.t = t
        self.pushed += 1
        if self.empty is not None:
            return self._infeasible(self.empty)
        times, seen = [*self.times, t], np.vstack((self.seen, ~np.isnan(row)))
        lag, newest = 0 if self.hull.lag is None else int(self.hull.lag), len(times) - 1
        wanted = max(newest - lag, 0)
        start = self._starts(seen)
        boxes = Boxes(rows, np.vstack((self.lo, self.free[0])), np.vstack((self.hi, self.free[1])), PROPOSERS)
        given = boxes.lo.copy(), boxes.hi.copy()
        done = [wanted] if self.pushed > lag else []
        a = int(start[wanted]) if done else 0
        empty = boxes.sweep([(a, newest + 1, k + 1) for k in sorted({newest, *done}, reverse=True)])[3]
        if empty is not None:
            names = (names_of(model.names.x, "x", model.nx), names_of(model.names.y, "y", model.ny))
            self.empty = conflict_of(rows, *given, np.array(times), empty, names).message
            return self._infeasible(self.empty)
        self.rows, self.times, self.seen, self.lo, self.hi = rows, times, seen, boxes.lo, boxes.hi
        state = wanted + 1
        box = Box(self.lo[state : state + 1].copy(), self.hi[state : state + 1].copy(), guaranteed=True)
        when = np.array([self.times[wanted]])
        info = {"rows": self.pushed, "loose": boxes.loose, "sides": boxes.asked}
        self._forget(a)
        status = Status.REDUCED if boxes.loose else Status.OK
        return answer(self.hull, model, when, middle(box), box, status, info, Labels())

    def bound(self, c: ArrayLike, u: ArrayLike | None = None, dt: float | None = None) -> Bound:
        """Return the guaranteed interval of c'x at the next row, before its outputs are seen."""
        row, inputs, step = pushed_row(self.model, None, u, dt)
        c = functional_of(c, self.model.nx)
        if self.empty is not None:
            self._infeasible(self.empty).check()
        rows = self._with(row, inputs, self.t + step, step)
        boxes = Boxes(rows, np.vstack((self.lo, self.free[0])), np.vstack((self.hi, self.free[1])), PROPOSERS)
        last = rows.T
        boxes.narrow(max(0, last - int(self.hull.memory or last)), last, last)
        return Bound(*boxes.functional(0, last, c, last))

    def _with(self, y: Array, u: Array | None, t: float, dt: float) -> Rows:
        """Return the rows held and a new one after them."""
        for name, matrix in self.model.matrices.items():
            if matrix.stacked and matrix.value is not None and self.pushed >= len(matrix.value):
                raise BadValue(f"`{name}` is stacked for {len(matrix.value)} rows, and so many have been pushed")
        new = one_row(self.model, y, u, t, dt, self.pushed)
        return new if self.rows is None else self.rows.joined(new, self.rows.T)

    def _starts(self, seen: NDArray[np.bool_]) -> NDArray[np.int32]:
        memory = int(self.hull.memory or 1)
        return window_starts(seen, memory, fixes=FIXES, stretch=memory * STRETCH)

    def _forget(self, a: int) -> None:
        """Drop what lies before the window: starts never move back, but for states without a bound."""
        if not (np.isfinite(self.lo[a:]).all() and np.isfinite(self.hi[a:]).all()):
            a = min(a, max(0, len(self.times) - far_back(self.model.nx)))
        if a > 0 and self.rows is not None:
            self.rows = self.rows.part(a, self.rows.T)
            self.lo, self.hi, self.seen = self.lo[a:], self.hi[a:], self.seen[a:]
            del self.times[:a]

    def _infeasible(self, message: str) -> Estimate:
        """Return the answer of a stream whose rows contradict the bounds; it stays so: nothing is safe any more."""
        box = Box(self.lo[-1:], self.hi[-1:])
        model, x = self.model, np.nan_to_num(middle(box))
        info = {"rows": self.pushed, "message": message, "hint": "resume a snapshot from before, and push None instead"}
        return answer(self.hull, model, np.array([self.t]), x, None, Status.INFEASIBLE, info, Labels())

    def snapshot(self) -> bytes:
        """Return the rows and boxes held, as bytes; every number exactly."""
        arrays: dict[str, Any] = {"lo": self.lo, "hi": self.hi}
        if self.rows is not None:
            arrays |= {f.name: getattr(self.rows, f.name) for f in dataclasses.fields(self.rows) if f.name != "walls"}
        held = {name: _plain(v) for name, v in arrays.items()}
        plain = {
            "t": self.t.hex(), "pushed": self.pushed, "times": [v.hex() for v in self.times], "empty": self.empty,
            "seen": self.seen.astype(int).tolist(), "arrays": held,
            "walls": 0 if self.rows is None else self.rows.walls,
        }  # fmt: skip
        return json.dumps(plain).encode()

    def restore(self, saved: bytes) -> None:
        """Take up the rows and boxes of a snapshot."""
        plain = json.loads(saved)
        self.t, self.pushed, self.empty = float.fromhex(plain["t"]), int(plain["pushed"]), plain["empty"]
        self.times = [float.fromhex(v) for v in plain["times"]]
        self.seen = np.array(plain["seen"], dtype=bool).reshape(len(self.times), self.model.ny)
        arrays: dict[str, Any] = {
            name: None if v is None else np.array([float.fromhex(n) for n in v[1]]).reshape(v[0])
            for name, v in plain["arrays"].items()
        }
        self.lo, self.hi = arrays.pop("lo"), arrays.pop("hi")
        self.rows = Rows(**arrays, walls=int(plain["walls"])) if arrays else None
        if self.lo.shape != (len(self.times) + 1, self.model.nx) or self.hi.shape != self.lo.shape:
            raise ValueError("its boxes do not fit the model")


def _plain(array: Array | None) -> Any:
    """Return an array as its shape and its numbers in hexadecimal, which loses nothing."""
    return None if array is None else [list(array.shape), [float(v).hex() for v in array.ravel()]]
