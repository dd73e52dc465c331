import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import halfwidth as hw

T = np.arange(1.0, 20001.0)
DT = np.ones_like(T)
RNG = 4


@pytest.mark.parametrize(
    "noise",
    [
        hw.Uniform([0.3, 2.0]),
        hw.Gaussian([[1.0, 0.4], [0.4, 0.5]]),
        hw.Gaussian([1.0, 0.0]),
        hw.Uniform([0.3, 2.0]) + hw.Gaussian([[1.0, 0.4], [0.4, 0.5]]),
        hw.Gaussian(0.3).sized(2, "w"),
    ],
    ids=repr,
)
def test_samples_have_the_covariance_that_is_stated(noise):
    draws = noise.sample(np.random.default_rng(RNG), T, DT)
    assert draws.shape == (len(T), 2)
    Q = noise.cov().single
    np.testing.assert_allclose(np.cov(draws.T), Q, atol=0.05 * max(1.0, np.max(Q)))
    np.testing.assert_allclose(draws.mean(axis=0), 0.0, atol=0.05)


def test_uniform_stays_in_its_box():
    draws = hw.Uniform([0.3, 2.0]).sample(np.random.default_rng(RNG), T, DT)
    assert np.all(np.abs(draws) <= [0.3, 2.0])


def test_noise_that_follows_the_step():
    noise = hw.Gaussian(lambda dt: [[dt]])
    draws = noise.sample(np.random.default_rng(RNG), T, np.where(T < 10000, 1.0, 4.0))
    assert abs(np.var(draws[:9000]) - 1.0) < 0.1
    assert abs(np.var(draws[11000:]) - 4.0) < 0.3


def test_a_stack_of_covariances():
    noise = hw.Gaussian(np.array([[[1.0]], [[4.0]]]))
    assert noise.sample(np.random.default_rng(RNG), T[:2], DT[:2]).shape == (2, 1)


def test_known_and_unknown():
    assert hw.Uniform(0.5).known
    assert not hw.Uniform.unknown().known
    assert hw.Uniform.unknown(0.5, 0.5).known
    assert not (hw.Uniform.unknown() + hw.Gaussian(1.0)).known
    partly = hw.Uniform.unknown(at_least=[0.1, 0.0], at_most=[0.1, 9.0])
    assert not partly.known
    with pytest.raises(hw.Refused):
        _ = partly.q
    assert "unknown" in repr(partly)


def test_the_sum_takes_either_order():
    one, two = hw.Uniform(1.0) + hw.Gaussian(2.0), hw.Gaussian(2.0) + hw.Uniform(1.0)
    assert repr(one) == repr(two)
    np.testing.assert_allclose(one.sized(1, "w").cov().single, [[2.0 + 1.0 / 3.0]])


@given(st.floats(1e-150, 1e150))
def test_scales_survive(s):
    assert hw.Gaussian(s * np.eye(2)).cov().single[0, 0] == s
    assert hw.Uniform(s).q == s
