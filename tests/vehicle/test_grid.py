import dataclasses

import numpy as np
import pytest
from tests.vehicle.known import FRAME, known

from halfwidth.errors import BadLog, BadValue
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.log import Log


def line(t, **streams):
    """A log of a drive to the north at 10 m/s."""
    lat, lon = FRAME.to_geodetic(0 * t, 10 * t)
    return Log(t=t, **({"lat_deg": lat, "lon_deg": lon} | streams))


def test_nodes_are_fixes_at_least_a_fifth_of_a_second_apart():
    grid = sampled(known(20.0, rate=50.0).log)
    assert np.diff(grid.t).min() >= 0.19
    assert grid.seen.all()
    assert len(grid) == 101


def test_means_over_steps_are_integrals():
    t = np.arange(0, 20.01, 0.05)
    fast = line(t, speed_mps=t**1, yaw_rate_radps=np.full(t.size, 0.3))
    grid = sampled(fast)
    np.testing.assert_allclose(grid.speed[1:], 0.5 * (grid.t[1:] + grid.t[:-1]), atol=1e-9)
    np.testing.assert_allclose(grid.yaw_rate, 0.3)
    assert not grid.speed_sd.any()


def test_the_clock_offset_moves_the_sensors_later():
    t = np.arange(0, 20.01, 0.05)
    grid = sampled(line(t, speed_mps=t, yaw_rate_radps=0 * t), clock_offset=0.5)
    inner = grid.t > 1
    np.testing.assert_allclose(grid.speed[inner], 0.5 * (grid.t[inner] + grid.t[np.flatnonzero(inner) - 1]) - 0.5)
    with pytest.raises(BadValue, match="clock_offset"):
        sampled(line(t), clock_offset=np.nan)


def test_a_silent_yaw_rate_goes_back_to_zero_and_a_silent_speed_lasts():
    t = np.arange(0, 90.01, 0.1)
    heard = (t < 30) | (t > 60)
    log = line(t, speed_mps=np.where(heard, 10.0, np.nan), yaw_rate_radps=np.where(heard, 0.3, np.nan))
    grid = sampled(log)
    middle = (grid.t > 40) & (grid.t < 50)
    assert np.abs(grid.yaw_rate[middle]).max() < 0.02
    np.testing.assert_allclose(grid.speed[middle], 10.0)
    assert np.abs(grid.yaw_rate[middle][::-1] - grid.yaw_rate[middle]).max() < 1e-3  # the same from both sides
    # the same where it is hidden, and beyond the last sample
    whole = sampled(line(t, speed_mps=np.full(t.size, 10.0), yaw_rate_radps=np.full(t.size, 0.3)))
    hidden = whole.masked((whole.t > 30) & (whole.t < 60), ("speed", "yaw_rate"))
    np.testing.assert_allclose(hidden.yaw_rate[middle], grid.yaw_rate[middle], atol=2e-3)
    np.testing.assert_allclose(hidden.speed, 10.0)
    open_end = sampled(line(t, speed_mps=np.full(t.size, 10.0), yaw_rate_radps=np.where(t < 30, 0.3, np.nan)))
    assert np.abs(open_end.yaw_rate[-1]) < 1e-6
    np.testing.assert_allclose(open_end.yaw_rate[1:100], 0.3)


def test_a_short_silence_is_bridged_straight():
    t = np.arange(0, 20.01, 0.1)
    rate = np.where(np.abs(t - 10) < 0.4, np.nan, 0.02 * t)
    grid = sampled(line(t, yaw_rate_radps=rate))
    np.testing.assert_allclose(grid.yaw_rate[1:], 0.02 * 0.5 * (grid.t[1:] + grid.t[:-1]), atol=3e-3)


def test_pauses_get_nodes_and_streams_keep_their_clocks():
    made = known(60.0, rate=10.0)
    grid = sampled(made.log.without(20.05, 40.05))
    assert np.diff(grid.t).max() < 0.31
    hidden = (grid.t > 20.05) & (grid.t < 40.05)
    assert not grid.seen[hidden].any()
    assert hidden.sum() > 90
    once = sampled(known(60.0, rate=1.0).log)
    assert np.diff(once.t).min() == pytest.approx(1.0)


def test_a_very_long_pause_gets_few_nodes():
    t = np.r_[np.arange(0, 10, 0.1), 1e6 + np.arange(0, 10, 0.1)]
    lat, lon = np.full(t.size, 50.0), np.full(t.size, 14.0)
    grid = sampled(Log(t=t, lat_deg=lat, lon_deg=lon, speed_mps=0 * t, yaw_rate_radps=0 * t))
    assert len(grid) < 4000
    assert grid.speed_sd.max() > 1.0


def test_silence_of_a_sensor_is_told():
    t = np.arange(0, 60.01, 0.1)
    speed = np.where((t > 20) & (t < 30), np.nan, 10.0)
    grid = sampled(line(t, speed_mps=speed, yaw_rate_radps=0 * t))
    silent = (grid.t > 21) & (grid.t < 29)
    assert (grid.speed_sd[silent] > 0).all()
    assert (grid.speed_sd[grid.t < 19] == 0).all()
    assert grid.yaw_rate_sd.max() == 0
    np.testing.assert_allclose(grid.speed, 10.0)


def test_absent_sensors_are_absent():
    grid = sampled(line(np.arange(0, 20.0, 0.2)))
    assert not grid.has_speed
    assert not grid.has_yaw_rate
    assert not grid.speed.any()


def test_hiding_and_cutting():
    grid = sampled(known(40.0).log)
    part = grid.between(10.0, 20.0).without(12.0, 15.0)
    assert part.t[0] >= 10.0
    assert part.t[-1] <= 20.0
    assert not part.seen[(part.t >= 12) & (part.t <= 15)].any()
    assert part.seen.sum() == len(part) - ((part.t >= 12) & (part.t <= 15)).sum()
    assert grid.seen.all()


def test_rows_outside_the_fixes_have_nodes():
    grid = sampled(known(40.0).log.without(0, 10).without(35, 40))
    assert grid.t[0] == 0
    assert grid.t[-1] == pytest.approx(40.0)
    assert not grid.seen[0]
    assert not grid.seen[-1]


def test_one_fix_is_a_grid_and_none_is_not():
    t = np.arange(0, 5.0, 0.1)
    one = np.where(np.arange(t.size) == 20, 50.0, np.nan)
    grid = sampled(Log(t=t, lat_deg=one, lon_deg=one))
    assert grid.seen.sum() == 1
    with pytest.raises(BadLog, match="no fix"):
        sampled(Log(t=t))


def test_masking_may_silence_the_sensors_as_a_log_without_them_is():
    made = known(60.0, rate=5.0)
    inside = (made.t > 20.1) & (made.t < 29.9)
    lost = dataclasses.replace(made.log, speed_mps=np.where(inside, np.nan, made.log.speed_mps))
    real = sampled(lost.without(20.1, 29.9))
    whole = sampled(made.log)
    hidden = whole.masked((whole.t > 20.1) & (whole.t < 29.9), ("speed",))
    np.testing.assert_array_equal(hidden.seen, real.seen)
    np.testing.assert_array_equal(hidden.speed_sd > 0, real.speed_sd > 0)
    np.testing.assert_allclose(hidden.speed_sd, real.speed_sd, rtol=0.05, atol=0.05)
    np.testing.assert_allclose(hidden.speed, real.speed, atol=0.3)
    np.testing.assert_array_equal(hidden.yaw_rate, whole.yaw_rate)
    everything = whole.masked(np.ones(len(whole), dtype=bool), ("speed", "yaw_rate"))
    assert np.isfinite(everything.speed).all()


@pytest.mark.parametrize("name", ["speed", "yaw_rate"])
def test_one_sample_is_no_sensor(name):
    t = np.arange(0, 60.01, 0.5)
    unit = {"speed": "mps", "yaw_rate": "radps"}[name]
    once = {f"{name}_{unit}": np.where(t == 0, 0.4, np.nan)}
    grid = sampled(line(t, **once))
    assert not getattr(grid, f"has_{name}")
    assert not getattr(grid, name).any()
