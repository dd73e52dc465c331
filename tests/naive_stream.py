"""A slow, obvious twin of a push of `Window(Posterior())`: each window a record and a model of its own, built anew."""

import dataclasses
import math

import numpy as np

import halfwidth as hw
from halfwidth.methods._carry import EVENT, Known
from halfwidth.methods._relinearise import relinearised


def first_row(seen, memory, fixes, stretch):
    """Return the first row of the window that ends at the newest of these rows (n, ny)."""
    n = len(seen)

    def back(rows, count):  # the row that holds the count-th newest of these, the first of all where they are fewer
        return rows[-count] if len(rows) >= count else rows[0]

    any_seen = [k for k in range(n) if seen[k].any()]
    start = any_seen[-memory - 1] if len(any_seen) > memory else 0
    for j in range(seen.shape[1]):
        rows = [k for k in range(n) if seen[k, j]]
        if fixes and rows:
            start = min(start, back(rows, min(fixes, memory + 1)))
    return start if stretch is None else max(start, n - stretch)


class Twin:
    """What the pushes of a stream should answer, each from what the stream itself carried before it.

    Streams amplify rounding: what is carried is taken from the stream before every push, and all else is done anew.
    """

    def __init__(self, live):
        self.live, self.window, self.model = live, live.method, live.model
        self.t, self.y, self.u = [0.0], [], []
        self.a, self.told, self.gone, self.count = 0, [], [0.0, 0.0], 0.0
        self.unsaid = 0
        self.x0 = None

    def push(self, y, u, dt):
        """Return the twin's answer and the stream's estimate."""
        carried = self.live._core._rows.carried
        start, inside = carried.start, carried.inside.values.copy()
        handed, waiting = carried._newest, len(carried.waiting)
        self.t.append(self.t[-1] + dt)
        self.y.append(y)
        self.u.append(u)
        seen = ~np.isnan(np.array(self.y))
        k, window, model = len(self.y) - 1, self.window, self.model
        a = first_row(seen, window.memory, window.fixes, window.stretch)
        drop, self.a = a - self.a, a
        record = hw.Record(self.t[a + 1 :], self.y[a:], self.u[a:] if model.nu else None)
        changes = {"dt": self.t[a + 1] - self.t[a]}
        for name, matrix in getattr(model, "matrices", {}).items():
            if matrix.value is not None and matrix.value.ndim == 3:
                changes[name] = matrix.value[a : k + 1]
        if drop:
            self.x0 = None
            if handed is not None and drop < len(handed["edge_x"]):
                P = handed["edge_P"][drop]
                self.x0 = hw.Normal(handed["edge_x"][drop], P + 1e-12 * np.diag(np.diagonal(P)))
        if a > 0:
            free = hw.Box(np.full(model.nx, -np.inf), np.full(model.nx, np.inf))
            changes["x0"] = self.x0 or (model.bounds if isinstance(model.bounds, hw.Box) else free)
        local = dataclasses.replace(model, **changes)
        known = self.known(a, len(record), inside)
        if isinstance(model, hw.Nonlinear):
            s = None if start is None else start.s
            answer = relinearised(window.method, local, record, s=s, known=known, path=self.path(a, u, dt))
        else:
            shaped = max(len(record) - window.lag, 0)
            answer = window.method.answer(local, record, start=start, drop=drop, known=known, frames={}, shaped=shaped)
        estimate = self.live.push(y, u, dt)
        if answer.estimate.status.good and seen[k].any():
            rows = max(int(seen[a:].any(axis=1).sum()), window.memory + 1)
            self.unsaid += 1
            if answer.tells:
                told, inside = (v.values.copy() for v in carried.waiting[-1][1:3])
                np.testing.assert_allclose(rows / self.unsaid * told, answer.told.values, rtol=1e-9, atol=1e-9)
                self.told.append([k, told, inside, self.unsaid])
                self.unsaid = 0
        else:
            assert len(carried.waiting) <= waiting
        return answer, estimate

    def path(self, a, u, dt):
        """Return the stream's newest states from the one before row a on, and what follows them."""
        held = self.live._core._rows.held
        new = self.model.move(held.x[-1], u, dt)
        if isinstance(self.model.bounds, hw.Box):
            new = np.clip(new, self.model.bounds.lo, self.model.bounds.hi)
        return np.concatenate([held.x[a - held.first :], new[None]])

    def known(self, a, rows, inside):
        """Return what windows tell all of whose rows have left, faded since they left."""
        fade = math.exp(-1.0 / (self.window.recall * (self.window.memory + 1)))
        self.gone, self.count = [fade * v for v in self.gone], fade * self.count
        for _, *told, windows in [window for window in self.told if window[0] < a]:
            self.gone, self.count = [v + more for v, more in zip(self.gone, told, strict=True)], self.count + windows
        self.told = [window for window in self.told if window[0] >= a]
        if not self.count:
            return None
        power = max(0.0, 1.0 - EVENT / (rows + self.count))
        return Known.of(self.gone[0] - power * (self.gone[1] + inside))
