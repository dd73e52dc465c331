"""The simulated drive: its truth obeys physics, its log shows the faults that were asked for."""

import numpy as np
import pytest

from halfwidth.errors import BadValue
from halfwidth.vehicle.drive import length_m, simulate_drive
from halfwidth.vehicle.track import steps_m

FIELDS = ("lat_deg", "lon_deg", "alt_m", "azimuth_rad", "speed_mps", "yaw_rate_radps")


@pytest.fixture(scope="module")
def drive():
    return simulate_drive(seed=4)


def test_same_seed_same_drive_and_another_seed_another():
    a, b, c = (simulate_drive(duration=60, tunnels=[5], seed=s) for s in (7, 7, 8))
    for name in FIELDS:
        assert np.array_equal(getattr(a[1], name), getattr(b[1], name), equal_nan=True)
        assert not np.array_equal(getattr(a[1], name), getattr(c[1], name), equal_nan=True)


def test_distance_agrees_with_speed_and_turning_with_yaw_rate(drive):
    truth, _ = drive
    step = np.diff(truth.t)
    went = steps_m(truth.lat_deg, truth.lon_deg)
    assert np.abs(went - (truth.speed_mps[1:] + truth.speed_mps[:-1]) / 2 * step).max() < 2e-3
    assert went.sum() == pytest.approx(np.trapezoid(truth.speed_mps, truth.t), abs=0.05)
    turned = np.diff(np.unwrap(truth.azimuth_rad))
    rate = (truth.yaw_rate_radps[1:] + truth.yaw_rate_radps[:-1]) / 2
    assert np.abs(turned + rate * step).max() < 1e-3


def test_car_points_where_it_goes(drive):
    truth, _ = drive
    lat, lon = truth.lat_deg, truth.lon_deg
    east = np.diff(lon) * np.cos(np.radians(lat[1:]))
    moving = steps_m(lat, lon) > 0.3
    course = np.arctan2(east, np.diff(lat))[moving]
    middle = truth.azimuth_rad[:-1][moving]
    assert np.abs(np.angle(np.exp(1j * (course - middle)))).max() < 0.06


def test_drive_is_that_of_a_car_in_a_city(drive):
    truth, _ = drive
    assert 12 < truth.speed_mps.max() < 15.5
    assert truth.speed_mps[truth.speed_mps > 5].std() > 1
    assert truth.speed_mps.min() == 0
    assert 0.03 < np.mean(truth.speed_mps == 0) < 0.4  # it stops, but not for long
    assert np.abs(np.diff(truth.speed_mps)).max() < 0.3  # 3 m/s^2 at 10 Hz
    assert np.abs(truth.speed_mps * truth.yaw_rate_radps).max() < 3.5
    assert np.abs(truth.yaw_rate_radps).max() > 0.2  # it turns corners
    assert np.abs(np.diff(truth.alt_m)).max() < 0.1


def test_speed_is_quantised_and_scaled():
    truth, log = simulate_drive(duration=100, tunnels=[], speed_step=0.25, speed_scale=1.03)
    steps = log.speed_mps / 0.25
    assert np.abs(steps - steps.round()).max() < 1e-9
    assert np.abs(log.speed_mps - 1.03 * truth.speed_mps).max() <= 0.125 + 1e-9
    assert truth.speed_scale == 1.03
    exact = simulate_drive(duration=100, tunnels=[], speed_step=0)[1]
    assert np.unique(exact.speed_mps).size > 500


def test_gyro_is_biased_and_the_bias_drifts(drive):
    truth, log = drive
    wrong = log.yaw_rate_radps - truth.yaw_rate_radps - truth.yaw_bias_radps
    assert abs(wrong.mean()) < 3e-4
    assert wrong.std() == pytest.approx(0.004, rel=0.1)
    assert np.ptp(truth.yaw_bias_radps) > 3e-4


def test_fixes_are_wrong_by_a_slow_offset_and_white_noise(drive):
    truth, log = drive
    seen = log.fixed
    east, north = truth.error_m(log.t[seen], log.lat_deg[seen], log.lon_deg[seen])
    for wrong, slow in ((east, truth.fix_east_m), (north, truth.fix_north_m)):
        assert (wrong - slow[seen]).std() == pytest.approx(0.3, rel=0.1)
        assert abs((wrong - slow[seen]).mean()) < 0.03
    assert np.abs(np.diff(truth.fix_east_m)).max() < 0.35  # it moves slowly,
    assert 0.3 < np.hypot(truth.fix_east_m, truth.fix_north_m).mean() < 3  # but is not small


def test_three_tunnels_take_the_receiver_and_nothing_else(drive):
    truth, log = drive
    assert sorted(round(b - a) for a, b in truth.outages) == [10, 25, 45]
    inside = np.zeros(len(log), dtype=bool)
    for first, last in truth.outages:
        assert first > 20
        assert last < 580
        inside |= (log.t >= first) & (log.t <= last)
        assert length_m(truth, first, last) > 5 * (last - first)  # the car moves in it
    assert np.array_equal(log.fixed, ~inside)
    assert np.isnan(log.alt_m[inside]).all()
    assert np.isnan(log.azimuth_rad[inside]).all()
    assert np.isfinite(log.speed_mps).all()
    assert np.isfinite(log.yaw_rate_radps).all()
    assert len(log.gaps()) == 3


def test_course_is_missing_when_standing(drive):
    truth, log = drive
    assert np.isnan(log.azimuth_rad[truth.speed_mps < 0.5]).all()
    moving = log.fixed & (truth.speed_mps > 2)
    wrong = np.angle(np.exp(1j * (log.azimuth_rad - truth.azimuth_rad)[moving]))
    assert abs(wrong.mean()) < 0.01
    assert wrong.std() < 0.1


@pytest.mark.parametrize("late", [0.15, -0.3])
def test_late_fixes_are_where_the_car_was(late):
    clean = {"fix_noise": 0.0, "fix_offset": 0.0, "tunnels": [], "duration": 100}
    truth, log = simulate_drive(clock_offset=late, **clean)
    inside = (log.t > 1) & (log.t < 99)
    lat, lon = truth.at(log.t[inside] - late)
    assert np.abs(log.lat_deg[inside] - lat).max() * 111e3 < 0.01
    assert np.abs(log.lon_deg[inside] - lon).max() * 111e3 < 0.01
    assert truth.clock_offset == late


def test_slower_fixes_and_given_outages():
    truth, log = simulate_drive(duration=60, fix_rate=1, rate=10, outages=[(20.0, 30.0)])
    assert truth.outages == ((20.0, 30.0),)
    assert log.fixed.sum() == 61 - 11
    assert np.allclose(log.t[log.fixed] % 1, 0)
    assert log.gaps() == [(19.0, 31.0)]
    assert simulate_drive(duration=60, tunnels=[], epoch_s=1.7e9)[1].epoch_s == 1.7e9


@pytest.mark.parametrize("rate", [1, 5, 50])
def test_other_rates(rate):
    _, log = simulate_drive(duration=60, rate=rate, tunnels=[10])
    assert len(log) == 60 * rate + 1
    assert log.rates()["speed_mps"] == pytest.approx(rate)


CLEAN = {"fix_noise": 0.0, "fix_offset": 0.0, "tunnels": [], "duration": 100, "yaw_noise": 0.0, "yaw_bias": 0.0,
         "yaw_drift": 0.0, "speed_step": 0.0}  # fmt: skip


def test_each_stream_has_its_own_delay():
    truth, log = simulate_drive(clock_offset=0.1, speed_delay=0.3, yaw_delay=-0.2, **CLEAN)
    inside = (log.t > 1) & (log.t < 99)
    at = log.t[inside]
    assert np.abs(log.speed_mps[inside] - np.interp(at - 0.3, truth.t, truth.speed_mps)).max() < 0.02
    assert np.abs(log.yaw_rate_radps[inside] - np.interp(at + 0.2, truth.t, truth.yaw_rate_radps)).max() < 0.01
    assert (truth.clock_offset, truth.speed_delay, truth.yaw_delay) == (0.1, 0.3, -0.2)


def test_the_gyro_may_be_quantised():
    log = simulate_drive(duration=60, tunnels=[], yaw_step=0.002)[1]
    assert np.abs(log.yaw_rate_radps / 0.002 - np.round(log.yaw_rate_radps / 0.002)).max() < 1e-9


def test_an_antenna_swings_about_the_axle():
    axle = simulate_drive(**CLEAN)[0]
    truth, log = simulate_drive(antenna=(1.5, 0.4), **CLEAN)
    assert np.array_equal(truth.speed_mps, axle.speed_mps)
    east, north = axle.error_m(truth.t, truth.lat_deg, truth.lon_deg)
    azimuth = truth.azimuth_rad
    assert np.allclose(east * np.sin(azimuth) + north * np.cos(azimuth), 1.5, atol=1e-3)
    assert np.allclose(north * np.sin(azimuth) - east * np.cos(azimuth), 0.4, atol=1e-3)
    assert np.abs(truth.error_m(log.t, log.lat_deg, log.lon_deg)).max() < 1e-6  # the fixes are the antenna's


def test_two_antennas_know_the_azimuth_without_moving():
    given = CLEAN | {"fix_noise": 0.01, "fix_offset": 1.0}
    truth, log = simulate_drive(antenna=(0.2, 0.0), second=(1.2, 0.5), **given)
    other = truth.second
    assert np.array_equal(other.fixed, log.fixed)
    wrong = np.angle(np.exp(1j * (log.azimuth_rad - truth.azimuth_rad)))
    assert np.isfinite(wrong).all()
    assert (truth.speed_mps == 0).any()
    assert abs(wrong.mean()) < 1e-3
    assert wrong.std() == pytest.approx(0.01 * np.sqrt(2) / np.hypot(1.0, 0.5), rel=0.1)
    between = steps_m(np.ravel([log.lat_deg, other.lat_deg], "F"), np.ravel([log.lon_deg, other.lon_deg], "F"))[::2]
    assert between.mean() == pytest.approx(np.hypot(1.0, 0.5), abs=0.01)  # they share the slow error


def test_multipath_fades_after_a_tunnel():
    given = CLEAN | {"outages": [(40.0, 50.0)]}
    truth, log = simulate_drive(multipath=8.0, multipath_time=2.0, **given)
    seen = log.fixed
    off = np.hypot(*truth.error_m(log.t[seen], log.lat_deg[seen], log.lon_deg[seen]))
    since = log.t[seen] - 50.0
    assert np.allclose(off, np.where(since > 0, 8 * np.exp(-since / 2), 0), atol=1e-2)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"speed_delay": 1e3}, "`speed_delay` is 1000"),
        ({"clock_offset": np.nan}, "`clock_offset` is nan"),
        ({"multipath": -1}, "`multipath` is -1"),
        ({"multipath_time": 0}, "`multipath_time` is 0"),
        ({"second": (0.0, 0.0)}, "at least 0.1 m"),
        ({"duration": 1}, "`duration` is 1 s"),
        ({"rate": 0}, "`rate` is 0 Hz"),
        ({"fix_rate": 20}, "`fix_rate` is 20 Hz"),
        ({"fix_noise": -1}, "`fix_noise` is -1"),
        ({"duration": 60, "tunnels": [55]}, "a longer `duration`"),
        ({"tunnels": [-5]}, "positive lengths"),
        ({"outages": [(5, 2)]}, r"`outages` holds \(5, 2\)"),
    ],
)
def test_impossible_drives_are_refused(given, words):
    with pytest.raises(BadValue, match=words):
        simulate_drive(**given)
