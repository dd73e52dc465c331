"""How a car turns while its yaw rate is silent: the law, the bridge, and what a gap makes of it."""

from dataclasses import replace

import numpy as np
import pytest

from halfwidth.vehicle import chain, simulate_drive
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.estimators import METHODS
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.turning import LASTS, SIZE, Turning, bridged, bridges, turning


@pytest.mark.parametrize("tau", [0.7, 2.5, 40.0])
def test_a_bridge_is_a_gauss_markov_process_given_both_ends(tau):
    rng = np.random.default_rng(3)
    h = rng.uniform(0.1, 0.6, 14)
    silent = np.zeros(14, dtype=bool)
    silent[3:12] = True
    rate = np.where(silent, np.nan, 0.2)
    law = Turning(tau, np.array([0.0]), np.array([0.1]))
    out = bridges(h, np.full(14, 8.0), np.where(silent, 99.0, rate), silent, law)
    # dense: the process at the ends of the steps and in their middles, given 2 units at both ends
    ends = np.cumsum(h[3:12])
    at = np.concatenate(([0.0, ends[-1]], ends[:-1], ends - 0.5 * h[3:12]))
    cov = np.exp(-np.abs(at[:, None] - at) / tau)
    gain = np.linalg.solve(cov[:2, :2], cov[:2, 2:]).T
    mean, left = gain @ [2.0, 2.0], cov[2:, 2:] - gain @ cov[:2, 2:]
    np.testing.assert_allclose(out.yaw_rate[3:12], 0.1 * mean[8:], rtol=1e-6)
    np.testing.assert_allclose(out.yaw_rate[[0, 1, 2, 12, 13]], 0.2)
    variance = [0.0]
    for keep, q in zip(out.keep[3:12], out.q[3:12], strict=True):
        variance.append(keep**2 * variance[-1] + q)
    np.testing.assert_allclose(variance[1:-1], np.diag(left)[:8], rtol=1e-6, atol=1e-9)
    assert variance[-1] < 1e-6  # the last one is known
    np.testing.assert_allclose(np.diag(left[:7, 1:8]), out.keep[4:11] * np.diag(left)[:7], rtol=1e-6, atol=1e-9)
    assert not out.size[~silent].any()


def test_beyond_the_last_sample_a_turn_ends():
    h, speed = np.full(400, 0.2), np.full(400, 8.0)
    silent = np.arange(400) >= 100
    for one, order in ((silent, 1), (silent[::-1], -1)):
        out = bridges(h, speed, np.where(one, 0.0, 0.3), one, Turning())
        rate = out.yaw_rate[::order]
        assert rate[101] > 0.25
        assert abs(rate[-1]) < 1e-6
        assert (np.diff(rate[100:]) <= 0).all()


def test_the_law_is_that_of_the_log():
    rng = np.random.default_rng(5)
    h, tau = np.full(40_000, 0.2), 1.6
    u = np.zeros(h.size)
    for k in range(1, h.size):
        u[k] = np.exp(-0.2 / tau) * u[k - 1] + np.sqrt(1 - np.exp(-0.4 / tau)) * rng.normal()
    speed = 5.0 + 5.0 * np.sin(np.arange(h.size) / 300)
    law = turning(h, speed, np.where(speed > 5, 0.02, 0.2) * u, np.arange(h.size) % 5000 > 500)
    assert law.lasts == pytest.approx(tau, rel=0.25)
    np.testing.assert_allclose(law.of(np.array([9.0, -1.0])), [0.02, 0.2], rtol=0.2)


def test_little_is_learnt_of_little():
    one = np.ones(3)
    assert turning(one, one, one, one < 0).size == SIZE
    law = turning(one, one, 0 * one, one > 0)
    assert 0 < law.lasts <= 10 * LASTS
    assert 0 < law.of(np.array([1.0]))[0] < SIZE
    for rate in (1e-200, 1e150):
        law = turning(np.full(500, 0.2), np.full(500, 5.0), np.full(500, rate), np.full(500, True))
        assert np.isfinite(law.lasts)
        assert np.isfinite(law.size).all()


@pytest.fixture(scope="module")
def turns():
    """A drive with a corner in its gap, in which the yaw rate is silent."""
    gap = (70.0, 96.0)
    truth, log = simulate_drive(duration=260.0, outages=(gap,), fix_noise=0.1, fix_offset=0.1, fix_rate=5.0, seed=2)
    inside = (log.t > gap[0] + 3) & (log.t < gap[1] - 3)
    return truth, log, replace(log, yaw_rate_radps=np.where(inside, np.nan, log.yaw_rate_radps)), gap


def errors(truth, grid, first, last):
    """Return how far the chain is off the truth between two times, m."""
    path = chain.solve([grid])[0].path
    rows = (grid.t > first) & (grid.t < last)
    lat, lon = grid.frame.to_geodetic(path.east, path.north)
    return np.hypot(*truth.error_m(grid.t - truth.clock_offset, lat, lon))[rows]


def test_a_corner_without_yaw_rate_and_fixes_is_found_from_both_sides(turns):
    truth, _, log, gap = turns
    grid = sampled(log, sensors=calibrated(log))
    straight = METHODS["linear"].run([grid], {})[0]
    path = chain.solve([grid])[0].path
    assert np.hypot(path.east - straight.east, path.north - straight.north).max() > 20
    assert errors(truth, grid, *gap).max() < 3


def test_with_fixes_a_silent_yaw_rate_hardly_matters(turns):
    truth, log, _, _ = turns
    inside = (log.t > 120) & (log.t < 150)
    off = []
    for one in (log, replace(log, yaw_rate_radps=np.where(inside, np.nan, log.yaw_rate_radps))):
        grid = sampled(one)
        assert (bridged(grid).size > 0).any() == (one is not log)
        off.append(errors(truth, grid, 120, 150).max())
    assert off[1] < 1.5 * off[0] + 0.1
