"""The benchmark that sets `fill` beside single methods: the same positions as theirs, and no luck in the last ratio."""

import numpy as np
import pytest
from tests.vehicle.known import known

from halfwidth.vehicle.fill import fill, prepared


@pytest.fixture(scope="module")
def accuracy(bench):
    return bench("accuracy")


@pytest.mark.parametrize("name", ["linear", "cv", "em"])
def test_a_method_alone_gives_the_positions_of_fill_with_that_method(accuracy, name):
    log = known(duration=80.0, noise=0.2, speed_noise=0.05, yaw_noise=0.005).log.without(30, 40)
    lat, lon = accuracy.by_method(prepared(log, []), name)
    track = fill(log, method=name)
    np.testing.assert_allclose(lat, track.lat_deg, rtol=0, atol=1e-12)
    np.testing.assert_allclose(lon, track.lon_deg, rtol=0, atol=1e-12)


def test_stretches_hidden_at_once_are_far_apart(accuracy):
    rng = np.random.default_rng(1)
    begins = rng.uniform(0, 600, 30)
    groups = accuracy.hidden.groups(begins, 10.0)
    assert sorted(np.concatenate(groups)) == sorted(begins)
    assert min(np.diff(sorted(group)).min() for group in groups if len(group) > 1) >= 10.0 + accuracy.hidden.APART


def test_a_stream_can_be_hidden_with_the_fixes(accuracy):
    log = known(duration=60.0).log
    left = accuracy.hidden.without(log, [20.0, 40.0], 5.0, ("speed_mps",))
    inside = ((log.t >= 20) & (log.t <= 25)) | ((log.t >= 40) & (log.t <= 45))
    np.testing.assert_array_equal(np.isnan(left.speed_mps), inside | np.isnan(log.speed_mps))
    assert not left.fixed[inside].any()
    np.testing.assert_array_equal(left.yaw_rate_radps, log.yaw_rate_radps)


def test_the_best_of_many_in_hindsight_is_lucky_and_that_of_the_other_starts_is_not(accuracy):
    rng = np.random.default_rng(2)
    means = {name: rng.exponential(1.0, 20) for name in "abcdefghij"}  # all as good as the other
    own, weight = rng.exponential(1.0, 20), np.ones(20)
    hindsight = min(v.mean() for v in means.values())
    fair = accuracy.others_best(means, weight)
    assert hindsight < 0.9 * own.mean()
    assert fair.mean() > 1.1 * hindsight
    # what is better everywhere is found without luck
    means["k"] = 0.1 * own
    np.testing.assert_allclose(accuracy.others_best(means, weight), means["k"])
    share, error = accuracy.ratio(own, means["k"], weight, np.eye(20))
    assert share == pytest.approx(10.0)
    assert error == pytest.approx(0.0, abs=1e-12)


def test_starts_whose_stretches_overlap_count_for_less(accuracy):
    rng = np.random.default_rng(3)
    length, n, seconds = 30, 40, 600
    shares, errors, apart = [], [], []
    for _ in range(300):
        start = rng.integers(0, seconds - length, n)
        wander = rng.normal(0.0, 1.0, seconds)  # what one method is off more than the other in each second
        own = 5.0 + np.array([wander[k : k + length].mean() for k in start])
        share, error = accuracy.ratio(own, np.full(n, 5.0), np.ones(n), accuracy.overlap(start, length))
        shares.append(share)
        errors.append(error)
        apart.append(accuracy.ratio(own, np.full(n, 5.0), np.ones(n), np.eye(n))[1])
    assert np.mean(errors) == pytest.approx(np.std(shares), rel=0.2)
    assert np.mean(apart) < 0.7 * np.std(shares)
