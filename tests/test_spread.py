import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import halfwidth as hw
from halfwidth.spread import Shaped


def test_normal_interval_is_the_two_sided_quantile():
    lo, hi = hw.Normal([[1.0, 2.0]], [[[4.0, 0.0], [0.0, 1.0]]]).interval(0.95)
    np.testing.assert_allclose(hi - lo, 2 * 1.959963984540054 * np.array([[2.0, 1.0]]))


def test_box_is_its_own_interval():
    box = hw.Box(-1, [1, 2])
    assert box.interval(0.5)[1].tolist() == [1.0, 2.0]
    assert not box.guaranteed
    np.testing.assert_allclose(hw.Box([-np.inf, 0, -np.inf], [3, np.inf, np.inf]).mean, [3, 0, 0])


@given(st.integers(0, 2**31), st.floats(0.05, 0.99))
def test_cloud_interval_leaves_the_same_weight_on_either_side(seed, level):
    rng = np.random.default_rng(seed)
    points, weights = rng.standard_normal((3, 200, 2)), rng.random((3, 200))
    weights /= weights.sum(axis=1, keepdims=True)
    cloud = hw.Cloud(points, weights)
    lo, hi = cloud.interval(level)
    for end, out in ((lo, points < lo[:, None]), (hi, points > hi[:, None])):
        share = np.sum(weights[..., None] * out, axis=1)
        assert np.all(share <= 0.5 - 0.5 * level + 1e-9)
        assert np.isin(end, points).all()
    np.testing.assert_allclose(cloud.mean, np.einsum("tn,tni->ti", weights, points))


def test_priors_can_be_drawn_from():
    rng = np.random.default_rng(0)
    draws = np.array([hw.Normal([1.0, 0.0], [[1.0, 0.5], [0.5, 2.0]]).sample(rng) for _ in range(4000)])
    np.testing.assert_allclose(np.cov(draws.T), [[1.0, 0.5], [0.5, 2.0]], atol=0.15)
    assert np.all(np.abs(hw.Box([-1, -2], [1, 2]).sample(rng)) <= [1, 2])


def test_bent_quantiles_are_those_of_a_beta_law():
    from scipy.stats import beta

    for a, b in ((1.0, 1.0), (2.0, 2.0), (1.5, 4.0), (30.0, 20.0)):
        mean, var, skew, kurt = (np.array([[float(v)]]) for v in beta.stats(a, b, moments="mvsk"))
        for level in (0.5, 0.9, 0.99):
            lo, hi = Shaped(mean, var[..., None], skew, kurt).interval(level)
            np.testing.assert_allclose(
                [lo[0, 0], hi[0, 0]], beta.ppf([0.5 - level / 2, 0.5 + level / 2], a, b), atol=1e-9
            )


def test_bent_quantiles_without_bend_are_gaussian():
    from statistics import NormalDist

    for skew, kurt in ((0.0, 0.0), (1e-9, -1e-9), (-1e-4, -1e-4), (0.0, 1e-6)):
        spread = Shaped(np.zeros((1, 1)), np.ones((1, 1, 1)), np.array([[skew]]), np.array([[kurt]]))
        assert spread.interval(0.9)[1][0, 0] == pytest.approx(NormalDist().inv_cdf(0.95), abs=2e-3)


def test_bent_quantiles_nest_and_are_finite_whatever_the_moments():
    skew, kurt = np.meshgrid(np.linspace(-3, 3, 41), np.linspace(-3, 6, 41))
    spread = Shaped(np.zeros(skew.shape), np.broadcast_to(np.eye(41), (41, 41, 41)), skew, kurt)
    last = spread.interval(0.01)
    for level in (0.3, 0.5, 0.9, 0.999):
        ends = spread.interval(level)
        assert np.isfinite(ends).all()
        assert np.all(ends[0] <= last[0] + 1e-12)
        assert np.all(ends[1] >= last[1] - 1e-12)
        last = ends


@pytest.mark.parametrize("level", [0, 1, -0.5, np.nan, "0.9", None, [0.5, 0.9]])
def test_a_level_is_a_probability(level):
    with pytest.raises(hw.errors.BadValue, match=r"`level` is .*, a number between 0 and 1 was expected"):
        hw.Normal([0.0], 1.0).interval(level)
