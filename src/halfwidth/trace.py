"""Record a NumPy function once as a tape that the core runs at C++ speed.

The function is called with object arrays whose entries record every operation made with them; NumPy hands
element-wise functions, products and sums through to the entries. What comes out is a straight-line program, a
`Tape`: values at many points at once, and the exact Jacobian by forward mode [1]_. Where the function branches on a
value (``if``, ``max``, ``sorted``) it is called once for each way it can go, and the answers are joined by choices. A
function that turns a value into a float (``math.sin``, a float array written entry by entry, SciPy), or loops until
something is small, cannot be recorded: `trace` raises `Untraceable`, and the caller keeps to Python. A tape is compared
with its function at points before anything is built on it (`Tape.agrees`).

References
----------
.. [1] Griewank and Walther (2008), Evaluating Derivatives, ch. 2 and 3.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from halfwidth.recording import BRANCHED, Recorder, entries
from halfwidth.tape import Tape, Untraceable

#: Calls of a function to follow its branches.
_CALLS = 64


def trace(f: Callable[..., Any], sizes: Sequence[int | None]) -> Tape:
    """Record `f` as a tape.

    Parameters
    ----------
    f : callable
        Takes one array (or number) for each of `sizes` and returns an array or a number.
    sizes : sequence of int or None
        Numbers of entries of the arguments; None for a plain number; 0 for an argument that is None.

    Returns
    -------
    Tape

    Raises
    ------
    Untraceable
        If `f` leaves NumPy, branches in too many ways, or fails.

    Examples
    --------
    >>> tape = trace(lambda x: np.array([np.hypot(x[0], x[1]), x[0] * x[1]]), (2,))
    >>> tape([3.0, 4.0])
    array([[ 5., 12.]])
    >>> tape.jacobian([3.0, 4.0])[1]
    array([[[0.6, 0.8],
            [4. , 3. ]]])
    """
    record = Recorder()
    calls = 0

    def call() -> list[int]:
        nonlocal calls
        calls += 1
        if calls > _CALLS:
            raise Untraceable(BRANCHED)
        arguments: list[Any] = []
        entry = 0
        for n in sizes:
            variables = [record.step("input", entry + i) for i in range(1 if n is None else n)]
            entry += len(variables)
            arguments.append(variables[0] if n is None else entries(variables) if n else None)
        try:
            with np.errstate(all="ignore"):
                answer = f(*arguments)
            return [record.slot(a) for a in np.asarray(answer, dtype=object).ravel()]
        except Untraceable:
            raise
        except Exception as error:  # whatever NumPy or the function says to entries that are not numbers
            raise Untraceable(f"{type(error).__name__}: {error}") from error

    def explore(way: list[tuple[int, bool]]) -> list[int]:
        # The answer on a way through the branches and on all that leave it later.
        record.follow(way)
        slots, taken = call(), list(record.taken)
        for k in range(len(taken) - 1, len(way) - 1, -1):
            condition, decision = taken[k]
            other = explore([*taken[:k], (condition, not decision)])
            if len(other) != len(slots):
                raise Untraceable("its answer changes its size")
            slots = [record.chosen(condition, a, b) for a, b in zip(slots, other, strict=True)]
        return slots

    slots = explore([])
    if not slots:
        raise Untraceable("it returns nothing")
    widths = tuple(1 if n is None else n for n in sizes)
    return record.tape(slots, widths)


def compiled(f: Callable[..., Any], sizes: Sequence[int | None], points: Iterable[tuple[Any, ...]]) -> Tape:
    """Record `f` and compare the tape with it at `points`.

    Raises
    ------
    Untraceable
        If `f` cannot be recorded, or gives something else than its tape: it is random, keeps state, or is not finite
        at any of the points.
    """
    tape = trace(f, sizes)
    if not tape.agrees(f, points):
        raise Untraceable(
            "what was recorded gives other values than the function itself; is it random, or does it count?"
        )
    return tape
