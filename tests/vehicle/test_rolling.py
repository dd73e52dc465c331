"""Wheels ahead of the rear axle: found where the log shows them, nowhere else, and the path is nearer for it."""

from dataclasses import replace

import numpy as np
import pytest

from halfwidth.vehicle import outages, simulate_drive
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.sensors import AS_LOGGED


def _drive(seed, wheels=0.0, **settings):
    """A drive with fixes good to centimetres whose speed is that of wheels ahead of the axle."""
    truth, log = simulate_drive(
        seed=seed, duration=240.0, rate=10.0, fix_noise=0.02, fix_offset=0.02, outages=(), **settings
    )
    rate = np.interp(log.t, *log.stream("yaw_rate_radps")) - 0.004
    rolled = np.sqrt(log.speed_mps**2 + (wheels * np.where(log.speed_mps > 0.2, rate, 0.0)) ** 2)
    return replace(log, speed_mps=rolled), truth


@pytest.mark.parametrize("seed", [1, 2])
def test_front_wheels_are_found(seed):
    log, _ = _drive(seed, 2.7, yaw_bias=0.004, yaw_drift=0.0)
    known = calibrated(log)
    assert known.wheels == pytest.approx(2.7, abs=max(0.3, 4.0 * known.wheels_sd))
    assert any("wheels" in word for word in known.words())
    assert known.to_dict()["wheels"] == known.wheels


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_wheels_of_the_rear_axle_are_left_there(seed):
    log, _ = _drive(seed)
    known = calibrated(log)
    assert known.wheels == 0.0
    assert known.wheels_sd == np.inf


def test_poor_fixes_show_no_wheels():
    _, log = simulate_drive(seed=4, duration=240.0, fix_noise=1.0, fix_offset=2.0)
    assert calibrated(log).wheels == 0.0


def test_the_speed_is_taken_back_to_the_axle():
    log, _ = _drive(1, 2.7, yaw_bias=0.004, yaw_drift=0.0)
    plain = _drive(1, 0.0, yaw_bias=0.004, yaw_drift=0.0)[0]
    known = replace(AS_LOGGED, bias=0.004, wheels=2.7, wheels_sd=0.1)
    back, axle = sampled(log, sensors=known), sampled(plain)
    moving = axle.speed > 1.0
    assert np.abs(back.speed - axle.speed)[moving].max() < 0.02
    assert np.isfinite(back.speed).all()


def test_outages_are_bridged_better():
    log, _ = _drive(1, 2.7, yaw_bias=0.004, yaw_drift=0.0)
    known = calibrated(log)
    assert known.wheels > 0
    cell = outages(log, (10.0,), 4, 3, ("em",)).cell("em", 10.0)
    plain = outages(_drive(1, 0.0, yaw_bias=0.004, yaw_drift=0.0)[0], (10.0,), 4, 3, ("em",)).cell("em", 10.0)
    assert cell.mean < 1.5 * plain.mean + 0.02
