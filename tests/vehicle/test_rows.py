"""Times that a coarse clock hid: the regular ones where they exist, else spread, and never invented."""

import numpy as np
import pandas as pd
import pytest
from tests.vehicle.known import known

from halfwidth.errors import BadLog
from halfwidth.vehicle import simulate_drive
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.formats import from_frame
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.rows import ruled_times
from halfwidth.vehicle.stamps import restamped
from halfwidth.vehicle.stray import strays


@pytest.mark.parametrize("period", [0.05, 0.1013, 0.25, 0.5, 0.497, 1.013, 0.97, 1.9])
@pytest.mark.parametrize("first", [0.0, 0.37, 0.99])
def test_regular_rows_are_found_to_what_the_stamps_leave_open(period, first):
    t = first + period * np.arange(400)
    t[200:] += 40.0  # a pause
    found = ruled_times(np.floor(t))
    assert found is not None
    assert (np.diff(found) > 0).all()
    assert ((found > np.floor(t) - 0.03) & (found < np.floor(t) + 1.03)).all()
    # how far a line may be shifted within all stamps is what the phases of the rows leave
    phases = np.sort(np.mod(t[:200], 1.0))
    room = np.diff(np.concatenate((phases, phases[:1] + 1))).max()
    assert np.ptp((found - t)[:200]) < 0.17
    assert np.abs(found - t).max() < max(1.1 * room, 0.2)


@pytest.mark.parametrize("lost", [0, 1, 2, 12])
def test_lost_rows_of_an_exact_clock_are_no_slow_clock(lost):
    keep = np.ones(300, dtype=bool)
    keep[np.random.default_rng(lost).choice(300, lost, replace=False)] = False
    assert ruled_times(np.arange(300.0)[keep]) is None


def test_strange_stamps_are_left():
    for stamps in (np.zeros(5), np.zeros(100), np.arange(3.0), np.cumsum(np.random.default_rng(1).uniform(0, 1, 200))):
        assert ruled_times(stamps) is None


def test_what_is_missing_in_the_first_second_is_its_beginning():
    made = known(60.0, rate=10.0)
    t = made.log.t + 0.37
    keep = np.random.default_rng(2).uniform(size=t.size) > 0.05
    table = {"time": np.floor(t), "lat": made.log.lat_deg, "lon": made.log.lon_deg, "speed": made.log.speed_mps}
    log = from_frame(pd.DataFrame(table)[keep])
    off = log.t - t[keep]
    off -= np.median(off)
    assert np.abs(off[:3]).max() < 0.2  # was 0.4: the rows began with the second
    assert off.std() < 0.04


@pytest.mark.parametrize("every", [1.013, 0.985])
def test_fixes_of_a_clock_of_whole_seconds_are_not_left_out(every):
    _, log = simulate_drive(duration=240.0, outages=((90.0, 110.0),), rate=1.0, fix_rate=1.0, fix_noise=0.1, seed=3)
    t = every * log.t + 0.37
    columns = {"time": np.floor(t), "lat": log.lat_deg, "lon": log.lon_deg}
    columns |= {"speed": log.speed_mps / every, "yaw_rate": log.yaw_rate_radps / every}
    read = from_frame(pd.DataFrame(columns))
    assert len(read) == len(log)
    assert any("coarse" in note or "counts" in note for note in read.notes)
    assert np.std(read.t - t) < 0.02
    same, stamps = restamped(read)
    assert not stamps.moved
    sensors = calibrated(same)
    assert not strays(sampled(same, sensors=sensors), sensors).at.size


def table(log):
    """A log as a table without its rows' order."""
    named = {
        "time": log.t,
        "lat": log.lat_deg,
        "lon": log.lon_deg,
        "speed": log.speed_mps,
        "yaw_rate": log.yaw_rate_radps,
    }
    return pd.DataFrame(named)


@pytest.mark.parametrize(("period", "name"), [(86_400.0, "day"), (604_800.0, "week"), (2**32 * 1e-6, "count of us")])
@pytest.mark.parametrize("late", [0, 1])
def test_a_clock_that_begins_anew_is_counted_on(period, name, late):
    _, log = simulate_drive(duration=60, seed=5, tunnels=())
    rows = table(log)
    rows["time"] = (rows.time + period - 25.0) % period
    order = np.arange(len(rows))
    k = int(np.flatnonzero(np.diff(rows.time) < 0)[0])
    order[k : k + 1 + late] = order[k : k + 1 + late][::-1]  # two rows that passed each other at the turn
    read = from_frame(rows.iloc[order])
    assert len(read) == len(log)
    assert np.allclose(np.diff(read.t), np.diff(log.t))
    assert any(f"begins anew with each {name}, 1 time" in note for note in read.notes)


def test_a_drive_over_midnight_that_was_sorted_is_counted_on():
    _, log = simulate_drive(duration=60, seed=5, tunnels=())
    rows = table(log)
    rows["time"] = (rows.time + 86_400.0 - 25.0) % 86_400.0
    read = from_frame(rows.sort_values("time"))
    assert np.allclose(np.diff(read.t), np.diff(log.t))
    assert any("begins anew with each day" in note for note in read.notes)


@pytest.mark.parametrize("times", [[0.0, 86_390.0], [0.0, 1.0, 86_390.0], [0.0, 0.1, 0.2, 86_380.0, 86_380.1]])
def test_rows_in_order_that_pause_for_most_of_a_day_are_left_as_they_are(times):
    read = from_frame(pd.DataFrame({"time[s]": times, "lat": np.linspace(50.0, 50.001, len(times)), "lon": 14.0}))
    assert read.t[-1] - read.t[0] == pytest.approx(times[-1], rel=1e-9)
    assert not any("begins anew" in note for note in read.notes)


def test_rows_that_are_there_twice_in_no_order_are_one_drive():
    _, log = simulate_drive(duration=60, seed=5, tunnels=())
    rows = table(log)
    twice = pd.concat([rows, rows.iloc[::7]]).sample(frac=1, random_state=1)
    for given in (twice, pd.concat([rows, rows])):
        read = from_frame(given)
        assert np.array_equal(read.t, log.t)
        assert np.array_equal(read.speed_mps, log.speed_mps)
        assert any("each there twice" in note for note in read.notes)


def test_two_drives_on_one_clock_are_still_refused():
    rows = table(simulate_drive(duration=60, seed=5, tunnels=())[1])
    other = table(simulate_drive(duration=60, seed=6, tunnels=())[1])
    with pytest.raises(BadLog, match="restarts its clock"):
        from_frame(pd.concat([rows, other]))
