"""A NumPy function as a straight-line program that the core runs: values at many points, and exact Jacobians.

The Jacobian is forward mode, Griewank and Walther (2008), Evaluating Derivatives, ch. 2 and 3. `halfwidth.trace` makes
tapes.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Untraceable(Exception):
    """The function cannot be recorded; the message says why."""


@dataclass(frozen=True, eq=False)
class Tape:
    """A function as a straight-line program of elementary operations.

    Parameters
    ----------
    code : (n, 4) int32 array
        Operation and argument slots of every step; the core numbers the operations.
    constant : (n,) array
        Value of the steps that are constants.
    out : (n_out,) int32 array
        Slots of the answer.
    sizes : tuple of int
        Numbers of entries of the arguments, in order.
    """

    code: NDArray[np.int32]
    constant: NDArray[np.float64]
    out: NDArray[np.int32]
    sizes: tuple[int, ...]

    def _points(self, arguments: Sequence[Any]) -> NDArray[np.float64]:
        # Arguments with the same number of rows, or one row repeated, side by side: (N, n_in).
        given = zip(arguments, self.sizes, strict=True)
        blocks = [np.asarray(a, dtype=np.float64).reshape(-1, n) for a, n in given if n]
        rows = max((len(b) for b in blocks), default=1)
        return np.concatenate([np.broadcast_to(b, (rows, b.shape[1])) for b in blocks], axis=1)

    def __call__(self, *arguments: Any) -> NDArray[np.float64]:
        """Values at N points.

        Parameters
        ----------
        *arguments : (N, size) or (size,) arrays
            One for each of `sizes`; a single row serves all points.

        Returns
        -------
        (N, n_out) array
        """
        from halfwidth._core import tape_evaluate

        return tape_evaluate(self.code, self.constant, self.out, self._points(arguments))  # type: ignore[no-any-return]

    def jacobian(self, *arguments: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values (N, n_out) and exact Jacobians (N, n_out, n) along the n entries of the first argument."""
        from halfwidth._core import tape_jacobian

        points = self._points(arguments)
        value, slope = tape_jacobian(self.code, self.constant, self.out, points, self.sizes[0])
        return value, slope

    def agrees(self, f: Callable[..., Any], points: Iterable[tuple[Any, ...]]) -> bool:
        """Return whether the tape and the function give the same at every point where the function is finite.

        Each entry may differ by what rounding of the arguments makes of it, 1e-12 relative; one finite point at least
        is needed to say yes.
        """
        from halfwidth._core import tape_jacobian

        tested = False
        for arguments in points:
            with np.errstate(all="ignore"):
                try:
                    expected = np.asarray(f(*_called(arguments, self.sizes)))
                except Exception:  # where it fails is for the caller to meet, and to name
                    return False
                if expected.dtype.kind not in "biuf" or expected.size != len(self.out):
                    return False
                expected = expected.astype(np.float64).ravel()
                if not np.isfinite(expected).all():
                    continue
                point = self._points(arguments)
                slope = tape_jacobian(self.code, self.constant, self.out, point, point.shape[1])[1][0]
                felt = np.abs(slope) @ np.abs(point[0])
                size = np.abs(expected) + np.where(np.isfinite(felt), felt, 0.0)
                if not np.all(np.abs(self(*arguments)[0] - expected) <= 1e-12 * size + 1e-300):
                    return False
            tested = True
        return tested


def _called(arguments: Sequence[Any], sizes: Sequence[int]) -> list[Any]:
    """Give arguments as the function expects them: None for none, fresh arrays so that it may write into them."""
    return [
        None if n == 0 else float(a) if np.ndim(a) == 0 else np.array(a, dtype=np.float64)
        for a, n in zip(arguments, sizes, strict=True)
    ]
