import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import halfwidth as hw

S, X0 = hw.Gaussian(1.0), hw.Normal([0.0, 0.0], 1.0)
SLIDE = np.array([[0.0, 1.0], [0.0, 0.0]])


@given(st.floats(1e-6, 1e4))
def test_constant_velocity_in_closed_form(dt):
    model = hw.from_continuous(SLIDE, [[0.0], [1.0]], [[1.0, 0.0]], np.diag([0.0, 3.0]), S, X0)
    np.testing.assert_allclose(model.A.at(0, dt), [[1, dt], [0, 1]])
    np.testing.assert_allclose(model.B.at(0, dt), [[dt**2 / 2], [dt]])
    np.testing.assert_allclose(model.w.cov().at(0, dt), 3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))


def test_a_stiff_system_settles_at_its_stationary_covariance():
    model = hw.from_continuous(np.diag([-1e4, -1.0]), None, np.eye(2), np.diag([2e4, 2.0]), S, X0)
    np.testing.assert_allclose(model.w.cov().at(0, 50.0), np.eye(2), atol=1e-9)


def test_two_half_steps_are_one_step():
    A, Q = np.array([[-0.3, 1.0], [-1.0, -0.2]]), np.array([[0.5, 0.1], [0.1, 0.2]])
    model = hw.from_continuous(A, None, np.eye(2), Q, S, X0)
    half, cov = model.A.at(0, 0.7), model.w.cov().at(0, 0.7)
    np.testing.assert_allclose(model.A.at(0, 1.4), half @ half, rtol=1e-12)
    np.testing.assert_allclose(model.w.cov().at(0, 1.4), half @ cov @ half.T + cov, rtol=1e-12)


def test_a_step_of_nothing_moves_nothing():
    model = hw.from_continuous(SLIDE, None, [[1.0, 0.0]], np.eye(2), S, X0)
    np.testing.assert_array_equal(model.A.at(0, 0.0), np.eye(2))
    np.testing.assert_array_equal(model.w.cov().at(0, 0.0), np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"A": np.ones((2, 3))}, "`A`"),
        ({"Q": np.eye(3)}, "`Q`"),
        ({"B": np.ones((3, 1))}, "`B`"),
        ({"C": [[1.0]]}, "`C`"),
    ],
)
def test_bad_shapes(change, words):
    given = {"A": SLIDE, "B": None, "C": [[1.0, 0.0]], "Q": np.eye(2), "e": S, "x0": X0} | change
    with pytest.raises(hw.BadShape, match=words):
        hw.from_continuous(**given)
