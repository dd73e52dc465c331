"""Enclosures of tapes over boxes hold every value, slope and affine distance, and are tight where theory says so."""

import halfwidth._core as _core
import numpy as np
import pytest

from halfwidth.enclosure import affine
from halfwidth.trace import trace

ONE = [
    "negative",
    "absolute",
    "sqrt",
    "cbrt",
    "square",
    "reciprocal",
    "sign",
    "exp",
    "exp2",
    "expm1",
    "log",
    "log2",
    "log10",
    "log1p",
    "sin",
    "cos",
    "tan",
    "arcsin",
    "arccos",
    "arctan",
    "sinh",
    "cosh",
    "tanh",
    "arcsinh",
    "arccosh",
    "arctanh",
    "floor",
    "ceil",
    "rint",
    "trunc",
]
TWO = [
    "add",
    "subtract",
    "multiply",
    "divide",
    "power",
    "arctan2",
    "hypot",
    "maximum",
    "minimum",
    "remainder",
    "fmod",
    "floor_divide",
    "less",
    "less_equal",
    "equal",
    "not_equal",
]
MORE = {
    "powers": (lambda x: np.array([x[0] ** p for p in (-3, -1.5, -1, -0.5, 0.5, 1.5, 2, 3, 4, 7)]), 1),
    "choice": (lambda x: np.where(x[0] < x[1], x[0] * x[1], np.sin(x[0])), 2),
    "wrap": (lambda x: (x[0] + np.pi) % (2 * np.pi), 1),
    "radar": (lambda x: np.array([np.hypot(x[0], x[1]), np.arctan2(x[1], x[0]), x[2] * np.cos(x[0])]), 3),
    "bell": (lambda x: np.sin(x[0]) * np.exp(-(x[1] ** 2)) / (1 + x[2] ** 2) + np.abs(x[0] - x[1]) ** 3, 3),
    "shared": (lambda x: (x[0] * x[1] - x[1] * x[0]) + np.sqrt(x[0] ** 2 + 1.0) * x[1], 2),
}


def boxes(rng, n, count):
    """Boxes of all sizes, points among them."""
    for _ in range(count):
        middle = rng.normal(size=n) * 10 ** rng.uniform(-2, 1.5)
        half = 10 ** rng.uniform(-6, 0.7, n) * rng.integers(0, 2, n)
        yield middle - half, middle + half


def judged(f, n, count=25):
    tape = trace(f, (n,))
    rng = np.random.default_rng(0)
    for lo, hi in boxes(rng, n, count):
        value, slope, bend = _core.tape_derivatives(tape.code, tape.constant, tape.out, lo, hi, n)
        near = affine(tape, lo, hi)
        for array in (value, slope, bend, *near):
            assert not np.isnan(array).any()
        corners = rng.integers(0, 5, (60, n)) / 4.0
        X = np.clip(lo + (hi - lo) * corners, lo, hi)
        y, d = tape.jacobian(X)
        there = np.isfinite(y).all(axis=1)
        X, y, d = X[there], y[there], d[there]
        assert np.all(value[:, 0] <= y)
        assert np.all(y <= value[:, 1])
        rounding = 1e-13 * np.abs(d)
        assert np.all((slope[..., 0] <= d + rounding) | ~np.isfinite(d))
        assert np.all((d - rounding <= slope[..., 1]) | ~np.isfinite(d))
        distance = np.abs(y - X @ near.J.T - near.k)
        size = np.abs(y) + np.abs(X) @ np.abs(near.J.T) + np.abs(near.k)
        assert np.all(distance <= near.half + 1e-14 * size)


@pytest.mark.parametrize("name", ONE)
def test_functions_of_one_argument(name):
    with np.errstate(all="ignore"):
        judged(lambda x: getattr(np, name)(x[0]), 1)


@pytest.mark.parametrize("name", TWO)
def test_functions_of_two_arguments(name):
    with np.errstate(all="ignore"):
        judged(lambda x: getattr(np, name)(x[0], x[1]), 2)


@pytest.mark.parametrize("name", MORE)
def test_composed_functions(name):
    with np.errstate(all="ignore"):
        judged(*MORE[name], count=60)


def test_a_quadratic_is_enclosed_without_loss():
    near = affine(trace(np.square, (1,)), np.array([1.0]), np.array([3.0]))
    np.testing.assert_allclose((near.J[0, 0], near.k[0], near.half[0]), (4.0, -3.5, 0.5), rtol=1e-13)
    assert near.half[0] >= 0.5


def test_the_distance_falls_with_the_square_of_the_width():
    tape = trace(lambda x: np.array([np.sin(x[0]) * np.exp(x[1])]), (2,))
    middle = np.array([0.4, -0.3])
    halves = [affine(tape, middle - w, middle + w).half[0] for w in (0.1, 0.01, 0.001)]
    assert halves[0] / halves[1] == pytest.approx(100, rel=0.3)
    assert halves[1] / halves[2] == pytest.approx(100, rel=0.1)


def test_hessians_are_those_of_finite_differences():
    f = lambda x: np.array([np.sin(x[0]) * np.hypot(x[1], x[0]) / x[2], x[0] ** x[1] + np.arctan2(x[2], x[0])])  # noqa: E731
    tape = trace(f, (3,))
    x = np.array([0.7, 1.3, 0.9])
    _, _, bend = _core.tape_derivatives(tape.code, tape.constant, tape.out, x, x, 3)
    step = 1e-5
    rows, columns = np.triu_indices(3)
    for j in range(3):
        e = step * np.eye(3)[j]
        numeric = (tape.jacobian(x + e)[1][0] - tape.jacobian(x - e)[1][0]) / (2 * step)
        for k, (p, q) in enumerate(zip(rows, columns, strict=True)):
            if p == j:
                np.testing.assert_allclose(bend[:, k].mean(axis=1), numeric[:, q], rtol=1e-8, atol=1e-9)
                assert np.all(bend[:, k, 1] - bend[:, k, 0] <= 1e-12)


def test_a_box_without_ends_says_what_it_can():
    """A row that is linear in the unbounded entries stays what it is; of the others their range is known."""
    tape = trace(lambda x: np.array([np.sin(x[0]), 2.0 * x[0] + x[1] ** 2, np.exp(x[0])]), (2,))
    near = affine(tape, np.array([-np.inf, 1.0]), np.array([np.inf, 3.0]))
    np.testing.assert_allclose(near.J, [[0.0, 0.0], [2.0, 4.0], [0.0, 0.0]], rtol=1e-13)
    np.testing.assert_allclose(near.half, [1.0, 0.5, np.inf], rtol=1e-12)
    np.testing.assert_array_equal(near.lo, [-1.0, -np.inf, 0.0])
    one_sided = affine(trace(np.log, (1,)), np.array([1.0]), np.array([np.inf]))
    assert one_sided.lo[0] <= 0.0
    assert one_sided.half[0] == np.inf


def test_the_other_arguments_are_exact():
    tape = trace(lambda x, u, dt: np.array([x[0] + dt * u[0] ** 2]), (1, 1, None))
    near = affine(tape, np.array([0.0]), np.array([1.0]), np.array([3.0]), 0.5)
    assert near.lo[0] == pytest.approx(4.5)
    assert near.hi[0] == pytest.approx(5.5)
    assert near.half[0] < 1e-14


def test_arguments_are_judged():
    tape = trace(np.sin, (1,))
    for lo, hi, n in (([1.0], [0.0], 1), ([0.0], [1.0], 2), ([np.nan], [1.0], 1), ([0.0], [1.0, 2.0], 1)):
        with pytest.raises(ValueError, match="tape"):
            _core.tape_affine(tape.code, tape.constant, tape.out, np.array(lo), np.array(hi), n)
