"""A matrix that is constant, stacked row by row, or a function of time or step, behind one accessor.

``Varying.stack(t, dt)`` returns the distinct matrices (K, rows, columns) and, unless K is 1 or T, the index (T,) of the
matrix that each row uses. A function of `dt` is called once for each distinct step, a function of `t` once a row.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.array import Array, Function, frozen, real
from halfwidth.errors import BadShape, BadValue

Index = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Varying:
    """One matrix of a model over time.

    Parameters
    ----------
    name : str
        The symbol, for messages.
    shape : tuple of int
        (rows, columns) of each matrix.
    value : (rows, columns) or (T, rows, columns) array, or None
        None where the matrix is a function.
    function : callable or None
        Takes the arguments named in `of`, a subset of ``("t", "dt")``.
    """

    name: str
    shape: tuple[int, int]
    value: Array | None
    function: Function | None = None
    of: tuple[str, ...] = ()
    check: Callable[[Array, str], Array] | None = None
    unknown: bool = False

    @property
    def constant(self) -> bool:
        """Whether one matrix serves every row."""
        return self.value is not None and self.value.ndim == 2

    @property
    def stacked(self) -> bool:
        """Whether every row has a matrix of its own."""
        return self.value is not None and self.value.ndim == 3

    @property
    def single(self) -> Array:
        """The constant matrix, (rows, columns)."""
        if self.value is None or self.value.ndim != 2:
            raise BadValue(f"`{self.name}` varies with time, a constant matrix was expected")
        return self.value

    def stack(self, t: Array, dt: Array) -> tuple[Array, Index | None]:
        """Return the distinct matrices (K, rows, columns) and the index (T,) of each row, None if K is 1 or T.

        Parameters
        ----------
        t, dt : (T,) arrays
            Time of each row and step to it from the row before, s.

        Raises
        ------
        BadShape
            If a stacked matrix does not have one entry a row.
        """
        T = len(t)
        if self.value is not None:
            if self.value.ndim == 2:
                return self.value[None], None
            if len(self.value) != T:
                raise BadShape(f"`{self.name}` is stacked for {len(self.value)} rows but the record has {T}")
            return self.value, None
        if self.of == ("dt",):
            steps, index = np.unique(dt, return_inverse=True)
            stack = np.array([self.at(float("nan"), float(h)) for h in steps]).reshape(-1, *self.shape)
            return stack, (None if len(steps) == 1 else index.astype(np.int32))
        rows = [self.at(float(a), float(h)) for a, h in zip(t, dt, strict=True)]
        return np.array(rows).reshape(-1, *self.shape), None

    def each(self, t: Array, dt: Array) -> Array:
        """Return the matrix of each row, (T, rows, columns), which may be a view; see `stack`."""
        stack, index = self.stack(t, dt)
        return np.broadcast_to(stack, (len(t), *stack.shape[1:])) if index is None else stack[index]

    def at(self, t: float, dt: float, row: int = 0) -> Array:
        """Return the matrix (rows, columns) at one row."""
        if self.function is None:
            assert self.value is not None
            return self.value if self.value.ndim == 2 else self.value[row]
        given = {"t": t, "dt": dt}
        matrix = _called(self.function, self.name, {a: given[a] for a in self.of}, self.unknown)
        if matrix.shape != self.shape:
            raise BadShape(f"`{self.name}` as a function returned shape {matrix.shape}, {self.shape} was expected")
        return matrix if self.check is None else self.check(matrix, self.name)


def varying(
    value: ArrayLike | Function,
    name: str,
    shape: tuple[int | None, int | None],
    *,
    expected: str = "",
    unknown: bool = False,
    check: Callable[[Array, str], Array] | None = None,
) -> Varying:
    """Judge one matrix of a model.

    Parameters
    ----------
    value : (rows, columns) or (T, rows, columns) array_like, or function of t or dt
    name : str
    shape : tuple of int or None
        Expected (rows, columns); None where any size will do.
    expected : str
        Where the expectation comes from, for the message.
    unknown : bool
        Whether NaN entries are allowed; they are unknown parameters.
    check : callable, optional
        Further judgement of each matrix, such as `halfwidth.array.covariance`.
    """
    if callable(value):
        of = _arguments(value, name)
        sample = _called(value, name, dict.fromkeys(of, 1.0), unknown)
        found = Varying(name, _two(sample, name), None, value, of, check, unknown)
        _fits(found.shape, shape, name, expected)
        found.at(1.0, 1.0)
        return found
    matrix = real(value, name, missing=unknown)
    if matrix.ndim not in (2, 3):
        raise BadShape(
            f"`{name}` has shape {matrix.shape}, a matrix (rows, columns) or a stack (T, rows, columns) was expected",
            hint=f"np.atleast_2d({name})",
        )
    _fits(matrix.shape[-2:], shape, name, expected)
    matrix = matrix if check is None else check(matrix, name)
    return Varying(name, (matrix.shape[-2], matrix.shape[-1]), frozen(matrix), unknown=unknown)


def _called(function: Function, name: str, given: dict[str, float], unknown: bool) -> Array:
    try:
        value = function(*given.values())
    except Exception as exc:
        at = ", ".join(f"{key} = {number:g}" for key, number in given.items())
        raise BadValue(
            f"`{name}` as a function failed at {at} with {type(exc).__name__}: {exc}",
            hint=f"it is tried at {name}(1.0) when the model is made",
        ) from exc
    return real(value, name, missing=unknown)


def _two(sample: Array, name: str) -> tuple[int, int]:
    if sample.ndim != 2:
        raise BadShape(f"`{name}` as a function returned shape {sample.shape}, a matrix was expected")
    return (sample.shape[0], sample.shape[1])


def _fits(found: tuple[int, ...], shape: tuple[int | None, int | None], name: str, expected: str) -> None:
    if any(s is not None and s != f for f, s in zip(found, shape, strict=True)):
        want = ", ".join("any" if s is None else str(s) for s in shape)
        source = f" from {expected}" if expected else ""
        raise BadShape(f"`{name}` has shape {tuple(found)}, ({want}) was expected{source}")


def _arguments(function: Function, name: str) -> tuple[str, ...]:
    """Return which of ``("t", "dt")`` a function of time wants, in its order; any one other name means t."""
    try:
        parameters = [
            p.name
            for p in inspect.signature(function).parameters.values()
            if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
        ]
    except (TypeError, ValueError):
        return ("t",)
    if set(parameters) <= {"t", "dt"} and parameters:
        return tuple(parameters)
    if len(parameters) == 1:
        return ("t",)
    raise BadValue(
        f"`{name}` is a function of ({', '.join(parameters)}), one of t or dt was expected",
        hint=f"{name} = lambda dt: ...",
    )
