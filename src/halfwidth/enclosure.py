"""What a function can be over a box: proved, in floating point.

A function that `halfwidth.trace` recorded is evaluated in intervals rounded outward, together with its Jacobian and
Hessian. `affine` turns that into what a method for linear models can use: a matrix, a shift and a half-width with

    |f(x) - J x - k| <= half     for every x of the box,

by the mean value form or by the second-order form, whichever is narrower in a row [1]_. A nonlinear step
``x[t] = g(x[t-1]) + w[t]`` is then the linear step ``x[t] = J x[t-1] + k + w'[t]`` with half-widths ``q + half``, and
an output ``y = h(x) + e`` a row with half-width ``r + half``: the true state obeys both.

What is proved is about the recorded operations. The functions of the C library are taken to be right within eight
units in the last place (glibc states at most four).

References
----------
.. [1] Moore, Kearfott and Cloud (2009), Introduction to Interval Analysis, ch. 6.
"""

from typing import Any, NamedTuple

import numpy as np

from halfwidth._core import tape_affine
from halfwidth.array import Array
from halfwidth.tape import Tape


class Affine(NamedTuple):
    """An affine function near f over a box.

    Parameters
    ----------
    J : (m, n) array
    k : (m,) array
    half : (m,) array
        ``|f(x) - J x - k| <= half`` over the box; infinite where nothing is known.
    lo, hi : (m,) arrays
        ``lo <= f(x) <= hi`` over the box, by direct evaluation.
    """

    J: Array
    k: Array
    half: Array
    lo: Array
    hi: Array


def affine(tape: Tape, lo: Array, hi: Array, *more: Any) -> Affine:
    """Return an affine function near a recorded one, with a proved distance.

    Parameters
    ----------
    tape : Tape
        From `halfwidth.trace.trace` or `compiled`.
    lo, hi : (n,) arrays
        The box of its first argument; ends may be infinite.
    *more : arrays or numbers
        The other arguments, exact.

    Examples
    --------
    >>> from halfwidth.trace import trace
    >>> near = affine(trace(np.square, (1,)), np.array([1.0]), np.array([3.0]))
    >>> near.J.round(9), near.k.round(9), near.half.round(9)  # x^2 = 4 x - 3.5 +- 0.5 between 1 and 3
    (array([[4.]]), array([-3.5]), array([0.5]))
    """
    rest = [np.atleast_1d(np.asarray(a, dtype=np.float64)).ravel() for a in more if a is not None]
    low, high = np.concatenate([lo, *rest]), np.concatenate([hi, *rest])
    J, k, half, value = tape_affine(tape.code, tape.constant, tape.out, low, high, len(lo))
    return Affine(J, k, half, value[:, 0], value[:, 1])
