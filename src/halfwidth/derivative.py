"""Jacobian by finite differences, for functions that cannot be compiled.

Five points along each axis: the error is of the fourth order in the step, so the step can be long enough to keep
rounding small, and the Jacobian of a smooth function is good to about eleven digits.
"""

from collections.abc import Callable

import numpy as np

from halfwidth.array import Array

#: The step, in units of the scale of each entry: where truncation h^4 and rounding eps / h balance.
_STEP = float(np.finfo(np.float64).eps) ** 0.2


def differences(
    f: Callable[[Array], Array], x: Array, scale: Array | None = None, angles: tuple[int, ...] = ()
) -> Array:
    """Return the Jacobian (m, n) of `f` at `x`.

    Parameters
    ----------
    f : function (n,) -> (m,)
    x : (n,) array
    scale : (n,) array, optional
        Length over which `f` changes along each entry, such as a standard deviation; the size of the entry, or 1 for
        an entry that is 0, if absent.
    angles : tuple of int
        Entries of the value that jump by 2 pi.

    Examples
    --------
    >>> differences(lambda x: x**2, np.array([1.0, 3.0])).round(9) + 0.0
    array([[2., 0.],
           [0., 6.]])
    """
    size = np.abs(x) if scale is None else np.asarray(scale)
    h = _STEP * np.where(size > 0.0, size, np.where(x != 0.0, np.abs(x), 1.0))
    wraps = list(angles)

    def change(step: Array) -> Array:
        d = np.asarray(f(x + step) - f(x - step))
        d[wraps] = np.remainder(d[wraps] + np.pi, 2.0 * np.pi) - np.pi
        return d

    columns = []
    for j in range(len(x)):
        step = np.zeros(len(x))
        step[j] = h[j]
        columns.append((8.0 * change(step) - change(2.0 * step)) / (12.0 * h[j]))
    return np.column_stack(columns)
