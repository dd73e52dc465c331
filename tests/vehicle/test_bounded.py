import dataclasses

import numpy as np
import pytest
from tests.vehicle.known import known

from halfwidth.result import Status
from halfwidth.vehicle import bounded
from halfwidth.vehicle.grid import sampled


def a_drive(**change):
    return sampled(known(50.0, **({"rate": 5.0, "noise": 0.1, "speed_noise": 0.05, "yaw_noise": 0.003} | change)).log)


@pytest.mark.parametrize("slow", [True, False])
def test_it_fills_a_gap_and_names_its_half_widths(slow):
    drive = a_drive(scale=1.02, bias=0.005)
    hidden = (drive.t >= 20) & (drive.t <= 28)
    path = bounded.solve([drive.without(20, 28)], bounded.Bounded(slow=slow))[0]
    assert path.status is Status.OK
    assert path.variance is None
    off = np.hypot(path.east - drive.east, path.north - drive.north)
    line = [np.interp(drive.t, drive.t[~hidden], p[~hidden]) for p in (drive.east, drive.north)]
    assert off[hidden].mean() < 0.2 * np.hypot(line[0] - drive.east, line[1] - drive.north)[hidden].mean()
    assert path.info["half_widths"].keys() >= {"along", "across", "azimuth", "fix"}
    assert ("offset_east" in path.info["half_widths"]) == slow
    assert path.info["speed_scale"] == pytest.approx(1.02, abs=0.02)


def test_every_residual_lies_within_its_half_width():
    drive = a_drive().without(20, 24)
    path = bounded.solve([drive], bounded.Bounded(slow=False))[0]
    half = path.info["half_widths"]["fix"]
    seen = drive.seen
    assert np.abs(path.east - drive.east)[seen].max() <= half * (1 + 1e-3)
    assert np.abs(path.north - drive.north)[seen].max() <= half * (1 + 1e-3)


def test_perfect_data_sit_on_the_floors():
    drive = a_drive(noise=0.0, speed_noise=0.0, yaw_noise=0.0)
    path = bounded.solve([drive.without(20, 25)], bounded.Bounded(slow=False, objective="log"))[0]
    assert path.finite
    assert np.hypot(path.east - drive.east, path.north - drive.north).max() < 0.3


def test_two_fixes_are_enough_and_a_drive_without_speed_too():
    drive = a_drive()
    few = dataclasses.replace(drive, seen=np.isin(np.arange(len(drive)), [10, 120]))
    blind = dataclasses.replace(drive, has_speed=False, speed=np.zeros(len(drive)))
    for path in bounded.solve([few, blind.without(20, 22)]):
        assert path.finite or path.status is Status.STALLED
