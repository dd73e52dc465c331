"""The functions that a user gives as a model: how many arguments they take, and what they return."""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from halfwidth.array import Array, real
from halfwidth.errors import BadValue


def arity(function: Callable[..., Any], most: int) -> int:
    """Return how many positional arguments `function` takes, at most `most`."""
    if isinstance(function, np.ufunc):
        return min(function.nin, most)
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return 1
    if any(p.kind is p.VAR_POSITIONAL for p in parameters):
        return most
    return min(
        most,
        sum(p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.default is p.empty for p in parameters),
    )


def takes_step_second(function: Callable[..., Any]) -> bool:
    """Return whether the second argument of `function` is called `dt`."""
    try:
        return list(inspect.signature(function).parameters)[1:2] == ["dt"]
    except (TypeError, ValueError):
        return False


def called(function: Callable[..., Any], name: str, arguments: tuple[Any, ...]) -> Array:
    """Return what `function` gives as a vector at least; an error of its own, or what is no number, is a `BadValue`."""
    try:
        value = function(*arguments)
    except Exception as exc:
        raise BadValue(
            f"`{name}` failed with {type(exc).__name__}: {exc}",
            hint=f"call {name}({', '.join(np.array2string(np.asarray(a)) for a in arguments)})",
        ) from exc
    return np.atleast_1d(real(value, f"{name}(...)"))
