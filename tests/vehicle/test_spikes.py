"""Samples no car can have had are named and left out; what a car can do is not."""

from dataclasses import replace

import numpy as np
import pytest
from tests.vehicle.known import known

from halfwidth.vehicle import check, simulate_drive
from halfwidth.vehicle.formats import read
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.spikes import spikes


def with_samples(log, name, rows, values):
    changed = getattr(log, name).copy()
    changed[rows] = values
    return replace(log, **{name: changed})


@pytest.mark.parametrize(("name", "value"), [("speed_mps", 80.0), ("speed_mps", 0.0), ("yaw_rate_radps", -6.0)])
@pytest.mark.parametrize("length", [1, 2])
def test_a_spike_is_named_with_time_and_size(name, value, length):
    log = known(noise=0.1, speed_noise=0.05, yaw_noise=0.005).log
    rows = np.arange(700, 700 + length)
    bad = with_samples(log, name, rows, value)
    found = spikes(bad)
    np.testing.assert_array_equal(found.rows[name], rows)
    assert len(found) == length
    (words,) = found.words(bad)
    assert "70.0 s" in words
    assert f"{value:.3g}" in words
    assert np.isnan(getattr(found.masked(bad), name)[rows]).all()
    item = check(bad)["spikes"]
    assert item.verdict == "warn"
    assert item.line.startswith("halfwidth fill")


def test_a_stuck_sensor_that_leaps_is_found_and_a_cruise_is_not():
    _, log = simulate_drive(duration=300, seed=3, tunnels=())
    assert len(spikes(log)) == 0  # it stands at lights and cruises at one step of the bus
    now, later = log.speed_mps[:-150], log.speed_mps[150:]
    moving = np.flatnonzero((now > 3) & (np.abs(later - now) > 3) & (later > 1))
    rows = np.arange(moving[0], moving[0] + 150)
    stuck = with_samples(log, "speed_mps", rows, log.speed_mps[rows[0]])
    (found,) = spikes(stuck).stuck["speed_mps"]
    assert abs(found[0] - rows[0]) < 20
    assert found[-1] == rows[-1]
    assert "the speed is stuck and then leaps" in spikes(stuck).words(stuck)[0]


@pytest.mark.parametrize("rate", [10.0, 1.0])
def test_a_sensor_is_stuck_for_longer_than_it_ever_holds_a_value(rate):
    """The leap at the end is one that a car can make."""
    _, log = simulate_drive(duration=400, seed=4, tunnels=(), rate=rate)
    assert len(spikes(log)) == 0
    n = round(10 * rate) if rate > 1 else 20
    change = np.abs(log.speed_mps[n:] - log.speed_mps[:-n])
    moving = np.flatnonzero((log.speed_mps[:-n] > 3) & (change > 1.5) & (change < 3.0))
    rows = np.arange(moving[0], moving[0] + n)
    stuck = with_samples(log, "speed_mps", rows, log.speed_mps[rows[0]])
    (found,) = spikes(stuck).stuck["speed_mps"]
    assert found[-1] == rows[-1]
    assert found.size >= 0.9 * n


def test_a_speed_that_is_stuck_until_the_car_stands_is_found_and_a_halt_at_once_is_not():
    _, log = simulate_drive(duration=300, seed=3, tunnels=())
    speed = log.speed_mps
    stands = np.flatnonzero((speed[1:] == 0) & (speed[:-1] > 0)) + 1
    end = int(stands[stands > 200][0])
    fast = np.flatnonzero(speed[:end] > 8)[-1]
    (found,) = spikes(with_samples(log, "speed_mps", slice(fast, end), speed[fast])).stuck["speed_mps"]
    assert found[-1] == end - 1
    moving = np.flatnonzero((speed[:-60] > 8) & (speed[60:] > 8))
    assert len(spikes(with_samples(log, "speed_mps", slice(moving[0], moving[0] + 60), 0.0))) == 0


@pytest.mark.parametrize("seed", range(20, 24))
@pytest.mark.parametrize(("rate", "step"), [(50.0, 1 / 3.6), (10.0, 0.25), (1.0, 1 / 3.6)])
def test_coarse_streams_hold_their_values_in_peace(seed, rate, step):
    _, log = simulate_drive(duration=400, seed=seed, tunnels=(), rate=rate, speed_step=step, yaw_step=0.01)
    assert len(spikes(log)) == 0


@pytest.mark.parametrize("name", ["smartloc", "balzer", "driveplotr"])
def test_real_logs_are_left_in_peace(data, name):
    log = read(next(data.glob(f"{name}*.csv.gz")))
    assert len(spikes(log)) <= 0.002 * len(log)


def test_a_yaw_rate_in_degrees_is_judged_in_its_own_unit():
    log = known(yaw_noise=0.005).log
    degrees = replace(log, yaw_rate_radps=np.degrees(log.yaw_rate_radps))
    assert len(spikes(degrees)) == 0
    assert len(spikes(with_samples(degrees, "yaw_rate_radps", [500], 300.0))) == 1


def test_strange_streams_are_not_judged():
    t = np.arange(40.0)
    rng = np.random.default_rng(1)
    for speed in (np.full(40, np.nan), np.zeros(40), 1e6 * rng.standard_normal(40), np.where(t % 2, 0.0, 90.0)):
        log = Log(t=t, lat_deg=np.full(40, 50.0), lon_deg=np.full(40, 14.0), speed_mps=speed)
        assert len(spikes(log)) == 0
        assert spikes(log).masked(log) is log


def slow_speeds(step, seed=8, n=300):
    """Return speeds of one sample a second that change by some dm/s, in steps."""
    rng = np.random.default_rng(seed)
    speed = 12.0 + 6.0 * np.sin(np.arange(n) / 11.0) + np.cumsum(rng.normal(0, 0.05, n))
    return np.round(speed / step) * step


@pytest.mark.parametrize(("step", "n"), [(1e-3, 4), (1e-3, 8), (0.1, 6)])
def test_a_slow_sensor_that_is_stuck_is_found(step, n):
    speed = slow_speeds(step)
    assert not spikes(log_of(speed)).stuck
    for first in (40, 130, 200):
        held = speed.copy()
        held[first : first + n] = held[first - 1]
        held[first + n :] += np.sign(held[first + n] - held[first]) * 2.5  # it has changed by 2.5 m/s meanwhile
        (run,) = spikes(log_of(held)).stuck["speed_mps"]
        assert set(range(first, first + n)) <= set(run.tolist())
        assert run.size <= n + 2


def test_a_slow_sensor_of_coarse_steps_that_repeats_itself_often_is_not_stuck():
    speed = slow_speeds(1.0)
    assert (np.diff(speed) == 0).mean() > 0.4
    assert not spikes(log_of(speed)).stuck
    speed[100:104] = speed[100]
    assert not spikes(log_of(speed)).stuck


def log_of(speed):
    n = speed.size
    return Log(t=np.arange(float(n)), lat_deg=np.full(n, 50.0), lon_deg=np.full(n, 14.0), speed_mps=speed)
