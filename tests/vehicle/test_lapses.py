"""Speed and yaw rate that are wrong by a factor for a part of a drive: named, put right or left out, and no others."""

from dataclasses import replace

import numpy as np
import pytest
from tests.vehicle.test_faults import in_gaps

from halfwidth.vehicle import check, fill, simulate_drive
from halfwidth.vehicle.formats import read
from halfwidth.vehicle.lapse import put_right, words
from halfwidth.vehicle.lapses import lapses
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.spikes import spikes

GAPS = ((100.0, 125.0), (220.0, 240.0))
DRIVE = {"duration": 400.0, "outages": GAPS, "fix_noise": 0.3, "fix_offset": 0.3, "clock_offset": 0.12}


@pytest.fixture(scope="module")
def drive():
    return simulate_drive(seed=11, **DRIVE)


def times(log, name, factor, first, last=np.inf):
    """The log with a stream multiplied between two times."""
    inside = (log.t > first) & (log.t < last)
    return replace(log, **{name: np.where(inside, factor * getattr(log, name), getattr(log, name))})


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("rate", "noise"), [(10.0, 0.05), (5.0, 1.0), (1.0, 0.3)])
def test_nothing_is_held_against_a_healthy_drive(seed, rate, noise):
    how = {"fix_noise": noise, "fix_offset": noise, "multipath": 30.0 * (seed % 2), "clock_offset": 0.4}
    _, log = simulate_drive(duration=300.0, outages=((100.0, 130.0),), seed=seed, rate=rate, fix_rate=1.0, **how)
    assert lapses(log) == ()


def test_nothing_is_held_against_real_drives(data):
    for path in sorted(data.glob("*.csv.gz")):
        log = read(path)
        assert lapses(log) == (), path.name
        assert lapses(log.without(log.t[-1] / 2, log.t[-1] / 2 + 40.0)) == (), path.name


@pytest.mark.parametrize(
    ("name", "factor", "first", "unit"),
    [
        ("speed_mps", 3.6, 200.0, "in km/h"),
        ("speed_mps", 1 / 3.6, 300.0, "km/h elsewhere"),
        ("speed_mps", 1 / 0.44704, 300.0, "in mph"),
        ("yaw_rate_radps", -1.0, 250.0, "turned round"),
        ("yaw_rate_radps", 180 / np.pi, 250.0, "in deg/s"),
    ],
)
def test_a_unit_or_sign_that_changes_is_named_and_put_right(drive, name, factor, first, unit):
    _, log = drive
    wrong = times(log, name, factor, first)
    (lapse,) = lapses(wrong)
    assert lapse.right
    assert unit in lapse.words(wrong) or lapse.first == 0  # either side may be the one that is wrong
    edge = wrong.t[lapse.first if lapse.first else lapse.last]
    # on a straight road nobody knows the sign of a yaw rate
    assert edge == pytest.approx(first, abs=15.0 if factor == -1 else 1.0)
    rows = np.abs(log.t - first) > 15.0
    rows &= getattr(log, name) != 0
    ratio = getattr(put_right(wrong, [lapse]), name)[rows] / getattr(log, name)[rows]
    assert np.allclose(ratio, ratio[0])


def test_a_speed_that_is_halved_is_named_and_not_used(drive):
    _, log = drive
    wrong = times(log, "speed_mps", 0.5, 260.0)
    (lapse,) = lapses(wrong)
    assert lapse.words(wrong).endswith("not used")
    assert lapse.reads == pytest.approx(0.5, rel=0.05)
    assert np.isnan(put_right(wrong, [lapse]).speed_mps[log.t > 262.0]).all()


@pytest.mark.parametrize(("first", "last"), [(60.0, 68.0), (105.0, 111.0)])
def test_a_speed_that_drops_to_0_among_fixes_or_in_a_gap_is_not_used(drive, first, last):
    _, log = drive
    for unit in (1.0, 3.6):
        wrong = times(times(log, "speed_mps", 0.0, first, last), "speed_mps", unit, -1.0)
        (lapse,) = lapses(wrong)
        assert "says 0" in lapse.words(wrong)
        assert wrong.t[[lapse.first, lapse.last]] == pytest.approx([first, last], abs=0.3)


def test_a_speed_that_is_held_at_0_through_a_gap_and_leaps_at_its_end_is_not_used(drive):
    truth, log = drive
    inside = (log.t > 219.9) & (log.t < 240.0)  # the car stands as the gap begins: a receiver's own speed stays there
    held = replace(log, speed_mps=np.where(inside, 0.0, log.speed_mps))
    (lapse,) = lapses(held)
    assert not lapse.right
    assert held.t[lapse.last] == pytest.approx(240.0, abs=0.2)
    assert (truth.speed_mps[lapse.first : lapse.last] > 1.0).mean() > 0.5


def test_wheels_that_spin_in_a_gap_are_not_used(drive):
    _, log = drive
    wrong = times(log, "speed_mps", 2.0, 110.0, 113.0)
    (lapse,) = lapses(wrong)
    assert wrong.t[[lapse.first, lapse.last]] == pytest.approx([110.0, 113.0], abs=0.2)


def test_a_speed_of_the_wrong_sign_is_turned(drive):
    _, log = drive
    wrong = replace(log, speed_mps=-log.speed_mps)
    (lapse,) = lapses(wrong)
    assert "negative all along" in lapse.words(wrong)
    assert np.array_equal(put_right(wrong, [lapse]).speed_mps, log.speed_mps)
    # a car that reverses out of a yard does go backwards
    slow = (log.t > 60.0) & (log.t < 75.0)
    assert lapses(replace(log, speed_mps=np.where(slow, -log.speed_mps, log.speed_mps))) == ()


def test_a_car_that_halts_at_once_is_believed_where_its_fixes_say_so(drive):
    _, log = drive
    stands = (log.t > 150.0) & (log.t < 160.0)
    k = np.flatnonzero(stands)[0]
    held = replace(
        times(log, "speed_mps", 0.0, 150.0, 160.0),
        lat_deg=np.where(stands, log.lat_deg[k] + 1e-6 * np.sin(log.t), log.lat_deg),
        lon_deg=np.where(stands, log.lon_deg[k], log.lon_deg),
    )
    assert not [lapse for lapse in lapses(held) if lapse.name == "speed_mps" and not lapse.reads]


@pytest.mark.parametrize(("name", "value"), [("speed_mps", 13.7), ("speed_mps", 0.0), ("yaw_rate_radps", 0.0)])
def test_a_channel_that_never_changes_is_named(drive, name, value):
    _, log = drive
    dead = replace(log, **{name: np.full(len(log), value)})
    (lapse,) = lapses(dead)
    assert f"says {value:g} from 0.0 s on" in lapse.words(dead)
    item = check(dead)["lapses"]
    assert item.verdict == "bad"
    assert not np.isfinite(getattr(put_right(dead, [lapse]), name)).any()


def test_a_yaw_rate_that_is_none_of_this_car_is_not_used(drive):
    _, log = drive
    rng = np.random.default_rng(3)
    for rate in (0.02 * rng.standard_normal(len(log)), np.clip(log.yaw_rate_radps, -0.05, 0.05)):
        (lapse,) = lapses(replace(log, yaw_rate_radps=rate))
        assert "does not follow the turns" in lapse.words(log)
        assert not np.isfinite(put_right(log, [lapse]).yaw_rate_radps).any()


def test_a_car_that_stands_has_no_lapse():
    rng = np.random.default_rng(1)
    n = 600
    still = {"speed_mps": np.zeros(n), "yaw_rate_radps": np.zeros(n)}
    lat, lon = 50 + 1e-6 * rng.standard_normal(n), 14 + 1e-6 * rng.standard_normal(n)
    assert lapses(Log(t=0.1 * np.arange(n), lat_deg=lat, lon_deg=lon, **still)) == ()


def test_a_log_of_few_rows_has_none():
    assert lapses(Log(t=[0.0, 1.0], lat_deg=[50, 50], lon_deg=[14, 14], speed_mps=[1, 2], yaw_rate_radps=[0, 0])) == ()


def test_units_and_dropouts_together_do_not_bend_a_gap(drive):
    truth, log = drive
    wrong = times(times(log, "speed_mps", 3.6, 200.0), "speed_mps", 0.0, 60.0, 68.0)
    wrong = times(wrong, "yaw_rate_radps", -1.0, 170.0)
    track = fill(wrong)
    assert sum("put right" in message for message in track.messages) == 2
    assert any("says 0 from 60." in message for message in track.messages)
    assert in_gaps(truth, track, GAPS, late=0.12) < 1.5  # .9 m without the faults, 54 m where they are believed
    found = check(wrong)
    assert found["lapses"].verdict == "bad"
    assert found["lapses"].value == 3
    assert found["lapses"].line


def test_what_is_left_of_spikes_is_no_lapse(drive):
    _, log = drive
    speed = log.speed_mps.copy()
    speed[[500, 900, 1500, 2600]] = 0.0
    wrong = replace(log, speed_mps=speed)
    assert lapses(spikes(wrong).masked(wrong)) == ()


def test_a_speed_that_leaps_all_the_time_is_told_in_few_words(drive):
    _, log = drive
    says = np.flatnonzero(np.isfinite(log.speed_mps))
    speed = log.speed_mps.copy()
    speed[says[::2]] = 0.0
    wrong = replace(log, speed_mps=speed)
    found = lapses(wrong)
    said = words(wrong, found)
    assert len(found) > 100
    assert len(said) == 6
    assert f"{len(found) - 5} more stretches from" in said[-1]
    assert " at " in said[0]  # one sample has one time


@pytest.mark.parametrize("left", [0, 1])
def test_a_negative_speed_without_fixes_is_no_lapse(drive, left):
    _, log = drive
    seen = np.isin(np.arange(len(log)), np.flatnonzero(log.fixed)[:left])
    none = {name: np.where(seen, getattr(log, name), np.nan) for name in ("lat_deg", "lon_deg")}
    assert lapses(replace(log, speed_mps=-np.abs(log.speed_mps) - 5.0, **none)) == ()


def test_a_speed_that_is_silent_among_fixes_is_that_of_the_fixes(drive):
    _, log = drive
    silent = (log.t > 270.0) & (log.t < 380.0)
    track = fill(replace(log, speed_mps=np.where(silent, np.nan, log.speed_mps)))
    inside = (track.t_s > 275.0) & (track.t_s < 375.0)
    says = np.isfinite(log.speed_mps)
    off = track.speed_mps[inside] - np.interp(track.t_s[inside], log.t[says], log.speed_mps[says])
    assert np.sqrt(np.mean(off**2)) < 1.0
