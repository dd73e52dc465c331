"""A guaranteed interval of a functional c'x, and what it says of a value."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from halfwidth.array import Array, real
from halfwidth.errors import BadShape


class Bound(NamedTuple):
    """Guaranteed interval of a functional c'x.

    Attributes
    ----------
    lo, hi : float or (T,) array
    """

    lo: Any
    hi: Any

    def excess(self, value: ArrayLike, half_width: ArrayLike = 0.0) -> Any:
        """Return how far ``value +- half_width`` lies outside, 0 where it does not.

        Above 0 it cannot be: no trajectory that obeys the bounds gives this value. So much wider would the half-width
        have to be.
        """
        below = np.nextafter(np.nextafter(np.asarray(self.lo) - value, -np.inf) - half_width, -np.inf)
        above = np.nextafter(np.nextafter(np.asarray(value) - self.hi, -np.inf) - half_width, -np.inf)
        found = np.maximum(np.maximum(below, above), 0.0)
        return float(found) if found.ndim == 0 else found


def functional_of(c: ArrayLike, nx: int) -> Array:
    """Judge a functional (nx,)."""
    row = np.atleast_1d(real(c, "c"))
    if row.shape != (nx,):
        raise BadShape(f"`c` has shape {row.shape}, ({nx},) was expected from the model")
    return row


def functionals_of(c: ArrayLike, n: int, nx: int) -> Array:
    """Judge n functionals (n, nx)."""
    rows = real(c, "c")
    if rows.shape != (n, nx):
        raise BadShape(f"`c` has shape {rows.shape}, ({nx},) or ({n}, {nx}) was expected from the model and the rows")
    return rows
