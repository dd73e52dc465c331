"""A clock of the sensors that is seconds to hours off that of the fixes."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from tests.vehicle.test_faults import in_gaps

from halfwidth.vehicle import check, fill, simulate_drive
from halfwidth.vehicle.adrift import adrift, moved
from halfwidth.vehicle.formats import from_frame, read
from halfwidth.vehicle.log import Log

GAPS = ((100.0, 125.0), (220.0, 235.0))
DRIVE = {"duration": 330.0, "outages": GAPS, "fix_noise": 0.3, "fix_offset": 0.3}


@pytest.fixture(scope="module")
def drive():
    return simulate_drive(seed=11, **DRIVE)


def apart(log, seconds, factor=1.0):
    """A table with a row for each fix, and one for each sample of the sensors, stamped so many seconds later."""
    fixes = pd.DataFrame({"time": log.t, "lat": log.lat_deg, "lon": log.lon_deg}).dropna()
    sensed = pd.DataFrame({"time": log.t + seconds, "speed": log.speed_mps, "yaw_rate": factor * log.yaw_rate_radps})
    return pd.concat([fixes, sensed]).sort_values("time", kind="stable")


@pytest.mark.parametrize("seed", range(5))
def test_a_clock_that_is_near_is_left_to_the_calibration(seed):
    how = {"fix_noise": 0.1 * 3.0**seed, "rate": 10.0, "fix_rate": 1.0, "clock_offset": 0.4 * seed}
    _, log = simulate_drive(duration=300.0, outages=((100.0, 130.0),), seed=seed, **how)
    assert adrift(log) is None


def test_the_clocks_of_real_drives_are_near_and_found_where_they_are_not(data):
    for path in sorted(data.glob("*.csv.gz")):
        log = read(path)
        assert adrift(log) is None, path.name
        assert adrift(moved(log, -60.0)) == pytest.approx(60.0, abs=1.0), path.name


@pytest.mark.parametrize("seconds", [-150.0, -7.3, 3.2, 45.0, 7200.0])
def test_a_clock_that_is_off_is_found(drive, seconds):
    _, log = drive
    # beyond the length of the drive the two do not meet in the log's time at all
    wrong = from_frame(apart(log, seconds))
    assert adrift(wrong) == pytest.approx(-seconds, abs=0.6)


def test_sensors_on_a_clock_minutes_away_and_turned_round_bridge_a_gap_as_well(drive):
    truth, log = drive
    wrong = from_frame(apart(log, 180.0, -180 / np.pi), repair=False)
    track = fill(wrong)
    assert any("stamped 180.0 s later than the fixes" in message for message in track.messages)
    assert in_gaps(truth, track, GAPS) < 1.5  # 22 m where the clock is believed
    assert set(track.quality) == {"fix", "bridged"}  # what only that clock stamped is no row of the drive
    item = check(wrong)["sensor clock"]
    assert item.verdict == "bad"
    assert item.value == pytest.approx(-180.0, abs=0.5)
    assert item.line


def test_rows_that_fixes_and_sensors_share_stay(drive):
    _, log = drive
    back = moved(moved(log, 40.0), -40.0)
    assert np.array_equal(back.t, log.t)
    same = (log.t > 1.0) & (log.t < 289.0)
    assert np.allclose(back.speed_mps[same], log.speed_mps[same])
    assert np.array_equal(back.lat_deg, log.lat_deg, equal_nan=True)


def test_what_says_nothing_moves_nothing(drive):
    _, log = drive
    for speed in (np.zeros(len(log)), np.full(len(log), 9.0), np.full(len(log), np.nan)):
        assert adrift(replace(log, speed_mps=speed)) is None
    rng = np.random.default_rng(2)
    assert adrift(replace(log, speed_mps=rng.permutation(log.speed_mps))) is None
    assert adrift(Log(t=[0.0, 1.0], lat_deg=[50.0, 50.0], lon_deg=[14.0, 14.0], speed_mps=[1.0, 2.0])) is None
    assert adrift(Log(t=[0.0, 1.0], speed_mps=[1.0, 2.0])) is None
