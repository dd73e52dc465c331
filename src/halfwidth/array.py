"""Checked conversion of what users pass into float64 arrays; the only place where input arrays are judged."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.errors import BadRecord, BadShape, BadValue, HalfwidthError

Array = NDArray[np.float64]
Kind = type[HalfwidthError]


def real(value: ArrayLike | None, name: str, *, error: Kind = BadValue, missing: bool = False) -> Array:
    """Return `value` as a float64 array of its own; NaN only where `missing` allows it, never infinite.

    None, masked entries and NaN are missing. Complex numbers, text and ragged lists are refused by name.
    """
    if isinstance(value, np.ma.MaskedArray):
        mask, value = np.ma.getmaskarray(value), np.ma.getdata(value).astype(object)
        value[mask] = None
    try:
        given = np.asarray(value)
    except ValueError:
        raise BadShape(f"`{name}` is ragged: its rows differ in length, a rectangle was expected") from None
    if given.dtype.kind == "O":
        try:
            given = np.array([_number(v) for v in given.ravel()]).reshape(given.shape)
        except (TypeError, ValueError):
            raise error(
                f"`{name}` holds {_first_not_number(given)!r}, numbers were expected",
                hint="use None or NaN for a missing entry",
            ) from None
    if given.dtype.kind == "c":
        raise error(f"`{name}` is complex, real numbers were expected", hint=f"{name}.real")
    if given.dtype.kind not in "fiub":
        raise error(f"`{name}` has dtype {given.dtype}, numbers were expected")
    array = np.array(given, dtype=np.float64, order="C")
    if np.isinf(array).any():
        raise error(f"`{name}` holds inf at {_where(np.isinf(array))}, finite numbers were expected")
    if not missing and np.isnan(array).any():
        raise error(f"`{name}` holds NaN at {_where(np.isnan(array))}, finite numbers were expected")
    return array


def extended(value: ArrayLike, name: str) -> Array:
    """Return `value` as a float64 array that may hold infinities but no NaN."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise BadValue(f"`{name}` is {value!r}, numbers were expected") from None
    if np.isnan(array).any():
        raise BadValue(f"`{name}` holds NaN at {_where(np.isnan(array))}")
    return array


def generator(seed: int | np.random.Generator | None) -> np.random.Generator:
    """Return the random generator of a seed, which is a whole number not below 0, or None for a fresh one."""
    try:
        return np.random.default_rng(seed)
    except (TypeError, ValueError):
        raise BadValue(f"`seed` is {seed!r}, a whole number not below 0 was expected", hint="seed=1") from None


def of_size(value: Array, n: int, name: str, expected: str) -> Array:
    """Return a scalar repeated or a vector checked to (n,)."""
    if value.ndim == 0:
        return np.full(n, float(value))
    if value.shape != (n,):
        raise BadShape(f"`{name}` has shape {value.shape}, ({n},) was expected from {expected}")
    return value


def frozen(array: Array) -> Array:
    """Mark an array read-only and return it."""
    array.flags.writeable = False
    return array


def covariance(value: Array, name: str) -> Array:
    """Check that (..., n, n) `value` is symmetric and positive semidefinite; return it symmetrised."""
    scale = np.max(np.abs(value), axis=(-2, -1), initial=0.0)
    skew = np.max(np.abs(value - np.swapaxes(value, -1, -2)), axis=(-2, -1), initial=0.0)
    if np.any(skew > 1e-9 * scale):
        raise BadValue(
            f"`{name}` is not symmetric: entries differ by up to {np.max(skew):.3g}",
            hint=f"({name} + {name}.T) / 2 if the difference is rounding",
        )
    value = value + 0.5 * (np.swapaxes(value, -1, -2) - value)
    # Each matrix is scaled by its own diagonal first, so that metres beside radians do not hide an indefinite block.
    d = np.sqrt(np.abs(np.diagonal(value, axis1=-2, axis2=-1)))
    d = np.where(d > 0, d, 1.0)
    lowest = np.linalg.eigvalsh(value / d[..., :, None] / d[..., None, :])[..., :1]
    if np.any(lowest < -1e-9):
        raise BadValue(
            f"`{name}` is indefinite: after scaling its diagonal to one it has the eigenvalue"
            f" {np.min(lowest):.3g}, a covariance has none below 0"
        )
    return value


def _number(entry: Any) -> float:
    if entry is None or entry is np.ma.masked:
        return float("nan")
    if isinstance(entry, str | bytes | complex):
        raise TypeError
    return float(entry)


def _first_not_number(given: NDArray[Any]) -> object:
    for entry in given.ravel():
        try:
            _number(entry)
        except (TypeError, ValueError):
            return entry
    return given


def _where(mask: NDArray[np.bool_]) -> str:
    index = tuple(int(i) for i in np.argwhere(mask)[0])
    return "entry " + (str(list(index)) if index else "0")


def times(value: ArrayLike, name: str = "t") -> Array:
    """Return strictly increasing finite times in seconds, shape (T,)."""
    t = real(value, name, error=BadRecord)
    if t.ndim != 1:
        raise BadShape(f"`{name}` has shape {t.shape}, (T,) was expected")
    step = np.diff(t)
    if np.any(step < 0):
        k = int(np.argmax(step < 0))
        raise BadRecord(
            f"`{name}` goes backwards from {t[k]:.9g} s to {t[k + 1]:.9g} s at row {k + 1}",
            hint="sort the rows: `order = np.argsort(t, kind='stable')`",
        )
    if np.any(step == 0):
        k = int(np.argmax(step == 0))
        raise BadRecord(
            f"`{name}` has the time {t[k]:.9g} s twice, at rows {k} and {k + 1}",
            hint="merge rows that share a time: `Record.merged(t, y, u)`",
        )
    return t


Function = Callable[..., ArrayLike]


def wrapped(difference: Array, angles: Sequence[int]) -> Array:
    """Return differences (..., n) with the entries that are angles in radians wrapped to a turn about 0."""
    if not len(angles):
        return difference
    out, k = np.array(difference), list(angles)
    out[..., k] = (out[..., k] + np.pi) % (2 * np.pi) - np.pi
    return out
