"""The rows that a window holds: which it begins at, which states' intervals are finished, and the rows themselves.

Most streams bring rows in which every output is seen; while all rows held are such, every answer is plain arithmetic.
"""

import numpy as np
from numpy.typing import NDArray

import halfwidth._core as _core
from halfwidth.array import Array

#: Rows that there is room for beyond twice those held: when it is used up those held are moved to the front.
_ROOM = 64


class Rows:
    """The rows that the next window may need, and three values of each state of them.

    Attributes
    ----------
    first : int
        Number of the first row held.
    before : float
        Time of the row before it.
    times, y, u, seen : (n,), (n, ny), (n, nu), (n, ny) arrays
        The rows held, good until the next row comes.
    x, low, high : (n + 1, nx) arrays
        Newest, least and largest estimate of each state held: the one before the first row, then one a row. Those of
        the newest row are undefined until it has an estimate.
    """

    def __init__(self, x0: Array, ny: int, nu: int, t: float) -> None:
        self.first, self.before = 0, t
        self.used = np.zeros(ny, dtype=bool)  # outputs seen before the first row held
        self.edge = np.ones(ny, dtype=bool)  # ... and in the row right before it
        free = np.full((1, len(x0)), np.inf)
        self.put(
            np.zeros(0), np.zeros((0, ny)), np.zeros((0, nu)), np.zeros((0, ny), dtype=bool), x0[None], free, -free
        )

    def __len__(self) -> int:
        return self._to - self._from

    def put(self, times: Array, y: Array, u: Array, seen: NDArray[np.bool_], x: Array, low: Array, high: Array) -> None:
        """Hold these rows instead."""
        self._room, self._from, self._to = 2 * len(times) + _ROOM, 0, len(times)
        self._held = [
            np.empty((self._room + len(v) - len(times), *v.shape[1:]), v.dtype)
            for v in (times, y, u, seen, x, low, high)
        ]
        for to, of in zip(self._held, (times, y, u, seen, x, low, high), strict=True):
            to[: len(of)] = of
        self.lost = int(np.count_nonzero(~seen))  # entries held that are missing
        self._look()

    def _look(self) -> None:
        times, y, u, seen, x, low, high = self._held
        a, b = self._from, self._to
        self.times, self.y, self.u, self.seen = times[a:b], y[a:b], u[a:b], seen[a:b]
        self.x, self.low, self.high = x[a : b + 1], low[a : b + 1], high[a : b + 1]

    def append(self, t: float, y: Array, u: Array | None) -> int:
        """Add a row; returns how many of its outputs are seen."""
        if self._to == self._room:
            self.put(self.times, self.y, self.u, self.seen, self.x, self.low, self.high)
        k = self._to
        times, all_y, all_u, seen = self._held[:4]
        there: list[bool] = [v == v for v in y.tolist()]
        times[k], all_y[k], seen[k] = t, y, there
        if u is not None:
            all_u[k] = u
        self._to += 1
        self._look()
        count = sum(there)
        self.lost += len(there) - count
        return count

    def start(self, memory: int, fixes: int, stretch: int | None) -> int:
        """Return the first row, by place, of the window that ends at the newest one."""
        if self.lost == 0:
            return max(len(self) - 1 - memory, 0)
        return int(window_starts(self.seen, memory, fixes=fixes, stretch=stretch)[-1])

    def over(self, row: int, memory: int) -> int:
        """Return how many of the first states held lie in no window that ends at this row or later; `window_lasts`."""
        if self.lost == 0:
            count = max(row + 1 - memory, 0)
            return 0 if count == 1 and (self.used & ~self.edge).any() else count
        return int(np.searchsorted(window_lasts(self.seen, memory, self.used, self.edge), row))

    def note(self, a: int, x: Array, memory: int) -> None:
        """Take the estimates x of the states from a on; the newest one has none so far."""
        n = len(self)
        b = max(a, self.over(n - 1, memory))
        _core.window_note(x[b - a : n - a], self.low[b:n], self.high[b:n])
        self.x[a:] = x
        self.low[n] = self.high[n] = x[-1]

    def note_newest(self, x: Array) -> None:
        """Take the first estimate x of the newest state."""
        self.x[-1] = self.low[-1] = self.high[-1] = x

    def forget(self, a: int) -> None:
        """Let go of the first a rows held."""
        if a == 0:
            return
        self.before = float(self.times[a - 1])
        if self.lost:
            self.lost -= a * self.seen.shape[1] - int(np.count_nonzero(self.seen[:a]))
            self.used, self.edge = self.used | self.seen[:a].any(axis=0), self.seen[a - 1].copy()
        else:
            self.used.fill(True)
            self.edge.fill(True)
        self.first += a
        self._from += a
        self._look()


def window_starts(
    seen: NDArray[np.bool_], memory: int, *, fixes: int = 10, stretch: int | None = None
) -> NDArray[np.int32]:
    """Return the first row of the window that ends at each row, (T,).

    A window holds the newest `memory` + 1 rows in which any output is seen, and reaches further back until every output
    that has been seen so far has `fixes` (at most `memory` + 1) seen entries in it, but at most `stretch` rows.
    """
    T, ny = seen.shape
    rows = np.arange(T)
    if seen.all():
        return np.maximum(rows - memory, 0).astype(np.int32)
    places = np.flatnonzero(seen.any(axis=1))
    before = np.searchsorted(places, rows, side="right")  # rows with a seen output up to and with each row
    start = np.where(before > memory, np.r_[places, 0][np.maximum(before - memory - 1, 0)], 0)
    for j in range(ny if fixes else 0):
        places = np.flatnonzero(seen[:, j])
        before = np.searchsorted(places, rows, side="right")
        # An output with fewer entries than asked for is taken back to its first one.
        first = np.r_[places, 0][np.maximum(before - min(fixes, memory + 1), 0)]
        start = np.where(before > 0, np.minimum(start, first), start)
    if stretch is not None:
        start = np.maximum(start, rows - stretch + 1)
    return start.astype(np.int32)


def window_lasts(
    seen: NDArray[np.bool_],
    memory: int,
    used: NDArray[np.bool_] | None = None,
    edge: NDArray[np.bool_] | None = None,
) -> NDArray[np.int32]:
    """Return the row whose window is the last to be part of each state's interval, (T + 1,); state 0 is before row 0.

    It is `memory` rows after the state, and after the end of every gap that the state lies in: within a gap all windows
    extrapolate from the same rows and agree, whatever they miss. `used` says which outputs were seen before row 0,
    `edge` which of them in the row before it.
    """
    T, ny = seen.shape
    rows = np.arange(T)
    if seen.all():
        last = np.arange(memory - 1, T + memory, dtype=np.int32)
        if used is not None and edge is not None:
            last[0] += bool((used & ~edge).any())
        return last
    end, first = rows.copy(), -1
    for j in range(ny):
        later = np.minimum.accumulate(np.where(seen[:, j], rows, T - 1)[::-1])[::-1]
        there = np.logical_or.accumulate(seen[:, j]) | (used is not None and bool(used[j]))
        end = np.maximum(end, np.where(there, later, rows))
        if used is not None and edge is not None and used[j] and not edge[j]:
            first = max(first, int(later[0]))
    return np.asarray(np.r_[first, end] + memory, dtype=np.int32)


def rows_since_fix(seen: NDArray[np.bool_]) -> NDArray[np.int_]:
    """Return how many rows ago any output was last seen, (T,); 0 where one is seen now."""
    rows = np.arange(len(seen))
    last = np.maximum.accumulate(np.where(seen.any(axis=1), rows, -1))
    return rows - last
