"""The tape kernels: both instruction sets, any number of points, and no program can read outside its memory."""

import numpy as np
import pytest

from halfwidth import _core
from halfwidth.trace import trace

pytestmark = pytest.mark.usefixtures("isa")


def f(x):
    return np.array([np.sin(x[0]) * x[1], np.where(x[2] > 0, x[2] ** 2, -x[0]), np.hypot(x[0], x[1]), 4.0])


TAPE = trace(f, (3,))
CODES = {name: k for k, (name, _) in enumerate(_core.tape_operations())}


@pytest.mark.parametrize("n", [0, 1, 2, 15, 16, 17, 33, 100])
def test_any_number_of_points(n):
    points = np.random.default_rng(n).normal(size=(n, 3))
    values = _core.tape_evaluate(TAPE.code, TAPE.constant, TAPE.out, points)
    assert values.shape == (n, 4)
    if n:
        np.testing.assert_allclose(values, [f(p) for p in points], rtol=1e-14)
    again, slope = _core.tape_jacobian(TAPE.code, TAPE.constant, TAPE.out, points, 3)
    np.testing.assert_allclose(again, values, rtol=1e-14)
    assert slope.shape == (n, 4, 3)


def test_jacobian_along_the_first_inputs_only():
    points = np.random.default_rng(0).normal(size=(5, 3))
    whole = _core.tape_jacobian(TAPE.code, TAPE.constant, TAPE.out, points, 3)[1]
    for n in range(4):
        part = _core.tape_jacobian(TAPE.code, TAPE.constant, TAPE.out, points, n)[1]
        np.testing.assert_array_equal(part, whole[:, :, :n])


def test_no_input_is_changed():
    points = np.random.default_rng(0).normal(size=(5, 3))
    before = points.copy(), TAPE.code.copy()
    _core.tape_jacobian(TAPE.code, TAPE.constant, TAPE.out, points, 3)
    np.testing.assert_array_equal(points, before[0])
    np.testing.assert_array_equal(TAPE.code, before[1])


def slope_of(g, at):
    tape = trace(g, (len(at),))
    return tape.jacobian(at)[1][0]


def test_derivatives_where_formulas_divide_by_zero():
    np.testing.assert_array_equal(slope_of(lambda x: np.hypot(x[0], x[1]), [0.0, 0.0]), [[0.0, 0.0]])
    np.testing.assert_array_equal(slope_of(lambda x: x[0] ** 1.5, [0.0]), [[0.0]])
    np.testing.assert_array_equal(slope_of(lambda x: np.abs(x[0]), [0.0]), [[0.0]])
    np.testing.assert_array_equal(slope_of(lambda x: np.arctan2(x[0], x[1]), [0.0, 2.0]), [[0.5, 0.0]])
    # The other branch has no finite derivative there, and must not be asked.
    guarded = slope_of(lambda x: np.where(x[0] > 0, np.sqrt(np.where(x[0] > 0, x[0], 1.0)), x[0]), [0.0])
    np.testing.assert_array_equal(guarded, [[1.0]])
    assert np.isinf(slope_of(lambda x: np.sqrt(x[0]), [0.0])).all()  # this one is honest
    # sqrt(x^2 + y^2) at the origin: a zero direction stays zero beside an infinite factor
    np.testing.assert_array_equal(slope_of(lambda x: np.sqrt(x[0] ** 2 + x[1] ** 2), [0.0, 0.0]), [[0.0, 0.0]])


@pytest.mark.parametrize(
    ("code", "constant", "out", "words"),
    [
        ([[999, 0, 0, 0]], [0.0], [0], "unknown operation"),
        ([[-1, 0, 0, 0]], [0.0], [0], "unknown operation"),
        ([[CODES["input"], 7, 0, 0]], [0.0], [0], "no such input"),
        ([[CODES["input"], -1, 0, 0]], [0.0], [0], "no such input"),
        ([[CODES["sin"], 0, 0, 0]], [0.0], [0], "out of order"),
        ([[CODES["constant"], 0, 0, 0], [CODES["add"], 0, 1, 0]], [0.0, 0.0], [0], "out of order"),
        ([[CODES["constant"], 0, 0, 0], [CODES["sin"], 0, 5, 0]], [0.0, 0.0], [0], "out of order"),
        ([[CODES["constant"], 0, 0, 0], [CODES["where"], 0, 0, -3]], [0.0, 0.0], [0], "out of order"),
        ([[CODES["constant"], 0, 0, 0]], [0.0], [1], "no such slot"),
        ([[CODES["constant"], 0, 0, 0]], [0.0], [-1], "no such slot"),
        ([[CODES["constant"], 0, 0, 0]], [0.0, 1.0], [0], "sizes"),
        ([[CODES["constant"], 0, 0, 0]], [0.0], [], "sizes"),
    ],
)
def test_a_broken_program_is_refused(code, constant, out, words):
    program = np.array(code, np.int32), np.array(constant), np.array(out, np.int32)
    with pytest.raises(ValueError, match=words):
        _core.tape_evaluate(*program, np.zeros((2, 3)))
    with pytest.raises(ValueError, match=words):
        _core.tape_jacobian(*program, np.zeros((2, 3)), 3)


def test_all_operations_are_known_to_numpy_or_said():
    names = [name for name, _ in _core.tape_operations()]
    assert len(set(names)) == len(names)
    assert all(hasattr(np, name) for name in names if name not in ("constant", "input"))


def test_special_values_as_numpy():
    special = np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 1e308, 5e-324, 2.5, -2.5])
    a, b = (v.ravel() for v in np.meshgrid(special, special))
    with np.errstate(all="ignore"):
        for name, arity in _core.tape_operations():
            if name in ("constant", "input", "where"):
                continue
            code = [[CODES["input"], 0, 0, 0], [CODES["input"], 1, 0, 0], [CODES[name], 0, 1 if arity == 2 else 0, 0]]
            got = _core.tape_evaluate(
                np.array(code, np.int32), np.zeros(3), np.array([2], np.int32), np.column_stack([a, b])
            )[:, 0]
            expected = getattr(np, name)(*((a, b) if arity == 2 else (a,))).astype(float)
            if name == "floor_divide":  # NumPy's answers of a division by zero or infinity differ between its versions
                fine = np.isfinite(a) & np.isfinite(b) & (b != 0) & (np.abs(a) < 1e300) & (np.abs(b) > 1e-300)
                got, expected = got[fine], expected[fine]
            np.testing.assert_allclose(got, expected, rtol=1e-14, atol=0, err_msg=name)
