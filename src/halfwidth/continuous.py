"""Models given in continuous time, sampled at whatever steps a record has.

``dx = (A x + B u) dt + dW`` with Wiener noise of spectral density Q becomes, over a step of dt with `u` held,
``x[t] = expm(A dt) x[t-1] + Bd u[t] + w[t]``; Bd and the covariance of w come from block exponentials (Van Loan 1978).
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from halfwidth.array import Array, covariance, real
from halfwidth.errors import BadShape, BadValue
from halfwidth.model import Linear, Prior
from halfwidth.noise import Gaussian, Noise


def from_continuous(
    A: ArrayLike, B: ArrayLike | None, C: ArrayLike, Q: ArrayLike, e: Noise, x0: Prior, **more: Any
) -> Linear:
    """Return a linear model whose matrices follow the step between rows.

    Parameters
    ----------
    A : (nx, nx) array_like
        Rates, 1/s.
    B : (nx, nu) array_like or None
        Effect of the inputs, which are held over each step, per second.
    C : (ny, nx) array_like
        Outputs, as in `Linear`.
    Q : (nx, nx) array_like
        Spectral density of the state noise, squared units of x per second.
    e, x0, **more
        As in `Linear`.

    Returns
    -------
    Linear
        With `A`, `B` and the covariance of `w` as functions of dt.

    Raises
    ------
    BadShape, BadValue
        If shapes do not fit or `Q` is asymmetric or indefinite.

    Examples
    --------
    >>> import halfwidth as hw
    >>> car = hw.from_continuous(
    ...     [[0, 1], [0, 0]], None, [[1, 0]], [[0, 0], [0, 2.0]], hw.Gaussian(1.0), hw.Normal([0, 0], 1.0)
    ... )
    >>> car.A.at(0.0, 0.5)
    array([[1. , 0.5],
           [0. , 1. ]])
    """
    if isinstance(Q, Gaussian):
        raise BadValue(f"`Q` is {Q!r}, the numbers of a spectral density were expected", hint="Q=[[0, 0], [0, 2.0]]")
    a, q = real(A, "A"), real(Q, "Q")
    if a.ndim != 2 or a.shape[0] != a.shape[1]:
        raise BadShape(f"`A` has shape {a.shape}, a square matrix (nx, nx) was expected")
    n = len(a)
    if q.shape != (n, n):
        raise BadShape(f"`Q` has shape {q.shape}, ({n}, {n}) was expected from `A`")
    q = covariance(q, "Q")
    b = None if B is None else real(B, "B")
    if b is not None and (b.ndim != 2 or len(b) != n):
        raise BadShape(f"`B` has shape {b.shape}, ({n}, nu) was expected from `A`")

    def Ad(dt: float) -> Array:
        return _expm(a * dt)

    def Bd(dt: float) -> Array:
        assert b is not None
        block = np.zeros((n + b.shape[1], n + b.shape[1]))
        block[:n, :n], block[:n, n:] = a, b
        return _expm(block * dt)[:n, n:]

    def Qd(dt: float) -> Array:
        # Halving the step until the exponentials are tame, then doubling back: Q(2h) = Q(h) + A(h) Q(h) A(h)'.
        halvings = max(0, int(np.ceil(np.log2(max(float(np.linalg.norm(a, 1)) * abs(dt), 1e-300)))))
        h = dt / 2**halvings
        block = np.block([[-a, q], [np.zeros((n, n)), a.T]]) * h
        exponential = _expm(block)
        step = exponential[n:, n:].T
        Q_step = step @ exponential[:n, n:]
        for _ in range(halvings):
            Q_step = Q_step + step @ Q_step @ step.T
            step = step @ step
        return 0.5 * (Q_step + Q_step.T)

    return Linear(Ad, None if b is None else Bd, C, Gaussian(Qd), e, x0, **more)


def _expm(matrix: Array) -> Array:
    from scipy.linalg import expm

    return np.asarray(expm(matrix))
