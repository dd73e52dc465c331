"""What a log tells of its own sensors: on simulated drives, where it is known, and on real ones."""

import json
from dataclasses import replace

import numpy as np
import pytest

from halfwidth.errors import BadValue
from halfwidth.vehicle import Log, fill, simulate_drive
from halfwidth.vehicle.align import calibrated, standstills
from halfwidth.vehicle.check_sensors import items
from halfwidth.vehicle.formats import read
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.judged import judged
from halfwidth.vehicle.sensors import AS_LOGGED, Calibration, Offset

CLEAN = {"duration": 300.0, "tunnels": [], "fix_noise": 0.02, "fix_offset": 0.02}


@pytest.mark.parametrize(
    ("seed", "given"),
    [
        (1, {"clock_offset": 0.15, "speed_scale": 1.01}),
        (2, {"clock_offset": -0.2, "speed_delay": 0.45, "yaw_delay": -0.1, "speed_scale": 0.97}),
        (3, {"clock_offset": 0.3, "speed_delay": 1.9, "yaw_delay": -1.2}),  # far off, and not alike
        (4, {"clock_offset": 0.15, "fix_rate": 1.0, "rate": 20.0}),
    ],
)
def test_each_clock_is_found_with_scale_and_bias(seed, given):
    truth, log = simulate_drive(seed=seed, **CLEAN, **given)
    found = calibrated(log)
    for name, delay in (("speed", truth.speed_delay), ("yaw_rate", truth.yaw_delay)):
        one = found.offsets[name]
        assert one.observable
        assert one.change == ""
        assert one.seconds == pytest.approx(truth.clock_offset - delay, abs=0.02)
        assert abs(one.seconds - truth.clock_offset + delay) < 4 * one.sd + 0.002
        assert one.sd < 0.1
    assert found.offsets["azimuth"].seconds == pytest.approx(0.0, abs=0.03)
    assert found.scale * truth.speed_scale == pytest.approx(1, abs=0.003)
    assert found.bias == pytest.approx(truth.yaw_bias_radps.mean(), abs=0.001)
    assert found.bias_of(truth.t) == pytest.approx(truth.yaw_bias_radps, abs=0.003)
    assert not found.antenna_observable


def test_consumer_fixes_tell_less_and_say_so():
    sharp, rough = (
        calibrated(simulate_drive(duration=300, tunnels=[], seed=5, clock_offset=0.15, fix_noise=s, fix_offset=o)[1])
        for s, o in ((0.02, 0.02), (1.0, 2.0))
    )
    for name in ("speed", "yaw_rate"):
        assert rough.offsets[name].sd > 3 * sharp.offsets[name].sd
        if rough.offsets[name].observable:
            assert rough.offsets[name].seconds == pytest.approx(0.15, abs=4 * rough.offsets[name].sd)


def test_an_antenna_ahead_of_the_axle_is_found_and_does_not_bend_the_clock():
    truth, log = simulate_drive(seed=1, antenna=(1.4, -0.4), clock_offset=0.15, **CLEAN | {"duration": 600.0})
    found = calibrated(log)
    assert found.antenna_observable
    assert found.antenna == pytest.approx((1.4, -0.4), abs=0.3)
    assert found.offsets["speed"].seconds == pytest.approx(0.15, abs=0.02)
    assert found.offsets["yaw_rate"].seconds == pytest.approx(0.15, abs=0.06)
    # the nodes of the grid are those of the axle, and the arm leads back to the antenna
    grid, plain = sampled(log, sensors=found), sampled(log)
    east, north = found.arm(grid.t)
    assert np.hypot(east, north).mean() == pytest.approx(np.hypot(*found.antenna), abs=0.02)
    assert np.allclose(grid.east + east, plain.east)
    assert np.allclose(grid.north + north, plain.north)
    track = fill(log.without(200, 230))
    assert np.abs(truth.error_m(track.t_s - 0.15, track.lat_deg, track.lon_deg)).max() < 1.5


@pytest.mark.parametrize(("speed", "yaw"), [(3.6, 1.0), (1 / 0.44704, -1.0), (1.0, 180 / np.pi), (1.0, -1.0)])
def test_units_and_signs_are_put_right(speed, yaw):
    _, log = simulate_drive(seed=2, clock_offset=0.1, **CLEAN)
    wrong = replace(log, speed_mps=speed * log.speed_mps, yaw_rate_radps=yaw * log.yaw_rate_radps)
    found = calibrated(wrong)
    assert found.speed_factor == pytest.approx(1 / speed)
    assert found.yaw_factor == pytest.approx(1 / yaw)
    assert found.offsets["speed"].seconds == pytest.approx(0.1, abs=0.02)
    assert found.scale == pytest.approx(1, abs=0.003)
    said = " ".join(found.words())
    assert ("speed is in" in said) == (speed != 1)
    assert ("positive to the right" in said) == (yaw < 0)
    assert ("deg/s" in said) == (abs(yaw) > 2)


@pytest.mark.parametrize("late", [0.4, -1.5])
def test_a_clock_that_steps_is_found(late):
    shifted = simulate_drive(seed=3, speed_delay=late, yaw_delay=late, **CLEAN | {"duration": 900.0})[1]
    after = shifted.t > 450  # the road depends on the longest delay, so the whole log is that of the shifted drive
    base = simulate_drive(seed=3, speed_delay=late, yaw_delay=late, clock_offset=late, **CLEAN | {"duration": 900.0})[1]
    speed = np.where(after, base.speed_mps, shifted.speed_mps)
    yaw = np.where(after, base.yaw_rate_radps, shifted.yaw_rate_radps)
    stepped = replace(
        shifted,
        lat_deg=np.where(after, base.lat_deg, shifted.lat_deg),
        lon_deg=np.where(after, base.lon_deg, shifted.lon_deg),
        speed_mps=speed,
        yaw_rate_radps=yaw,
    )
    then = judged(stepped)
    found = then.sensors
    for name in ("speed", "yaw_rate"):
        one = found.offsets[name]
        assert one.change == "step"
        (_, before), (when, now) = one.at
        assert before == pytest.approx(-late, abs=0.05)
        assert now == pytest.approx(0, abs=0.05)
        assert when == pytest.approx(450, abs=160)
    (item,) = (one for one in items(then) if one.name == "clock of speed")
    assert item.verdict == "warn"
    assert "steps at about" in item.sentence


@pytest.mark.parametrize(("seed", "late", "when"), [(6, 0.5, 90.0), (7, -0.35, 190.0)])
def test_a_clock_that_steps_is_found_in_a_few_minutes(seed, late, when):
    _, log = simulate_drive(duration=280.0, seed=seed, outages=[(120.0, 135.0)], fix_noise=0.1, fix_offset=0.1)
    assert {one.change for one in calibrated(log).offsets.values()} == {""}
    moved = {
        name: np.where(log.t > when, np.interp(log.t - late, log.t, getattr(log, name)), getattr(log, name))
        for name in ("speed_mps", "yaw_rate_radps")
    }
    found = calibrated(replace(log, **moved))
    for name in ("speed", "yaw_rate"):
        one = found.offsets[name]
        assert one.change == "step"
        (_, before), (at, after) = one.at
        assert before == pytest.approx(0, abs=0.1)
        assert after == pytest.approx(-late, abs=0.1)
        assert at == pytest.approx(when, abs=25)


def test_a_piece_that_hardly_tells_the_bias_has_that_of_its_neighbours():
    _, log = simulate_drive(seed=5, yaw_bias=0.003, **CLEAN | {"duration": 600.0})
    rough = np.random.default_rng(1).normal(0, 3 / 111_229, (2, len(log)))
    early = log.t < 150
    lat, lon = log.lat_deg + np.where(early, rough[0], 0), log.lon_deg + np.where(early, rough[1], 0)
    at, bias = np.array(calibrated(replace(log, lat_deg=lat, lon_deg=lon)).bias_at).T
    assert bias == pytest.approx(calibrated(log).bias_of(at), abs=0.0015)


def test_a_clock_that_drifts_is_found():
    _, log = simulate_drive(seed=3, clock_offset=0.1, **CLEAN | {"duration": 1500.0})
    moved = log.stream("speed_mps")[0] * 2.4e-4  # 0.36 s in 25 minutes
    speed = np.interp(log.t - moved, log.t, log.speed_mps)
    then = judged(replace(log, speed_mps=speed))
    found = then.sensors
    one = found.offsets["speed"]
    assert one.change == "drift"
    assert one.at[0][1] == pytest.approx(0.1, abs=0.05)
    assert one.at[-1][1] == pytest.approx(0.1 - 0.36, abs=0.05)
    assert found.offsets["yaw_rate"].change == ""
    assert "drifts" in items(then)[0].sentence


def test_what_is_given_is_not_looked_for():
    _, log = simulate_drive(seed=1, clock_offset=0.15, **CLEAN)
    found = calibrated(log, clock_offset=0.05)
    for name in ("speed", "yaw_rate"):
        assert found.offsets[name] == Offset(0.05, 0.0, True, given=True)
    track = fill(log, clock_offset=0.05)
    assert any("+0.05 s as given" in message for message in track.messages)
    assert track.settings["sensors"]["offsets"]["speed"]["given"]


def test_a_standing_car_tells_the_bias():
    truth, log = simulate_drive(seed=6, **CLEAN)
    still = standstills(log, AS_LOGGED)
    inside = AS_LOGGED.__class__(still=still).stands(truth.t)
    assert inside.any()
    assert truth.speed_mps[inside].max() == 0
    found = calibrated(log)
    assert found.still_bias == pytest.approx(truth.yaw_bias_radps[inside].mean(), abs=5e-4)
    t, rate = found.stream(log, "yaw_rate")
    assert (rate[found.stands(t)] == 0).all()


def test_without_a_sensor_the_other_one_is_calibrated_still():
    _, log = simulate_drive(seed=2, clock_offset=0.2, **CLEAN)
    no_yaw = calibrated(replace(log, yaw_rate_radps=np.full(len(log), np.nan)))
    assert no_yaw.offsets["speed"].seconds == pytest.approx(0.2, abs=0.03)
    assert "yaw_rate" not in no_yaw.offsets
    no_speed = calibrated(replace(log, speed_mps=np.full(len(log), np.nan)))
    assert no_speed.offsets["yaw_rate"].seconds == pytest.approx(0.2, abs=0.05)
    assert no_speed.scale == 1.0
    neither = calibrated(replace(log, speed_mps=np.full(len(log), np.nan), yaw_rate_radps=np.full(len(log), np.nan)))
    assert neither.offsets == {}


def test_a_log_that_tells_nothing_changes_nothing():
    t = np.arange(200.0)
    still = Log(t=t, lat_deg=np.full(200, 50.0), lon_deg=np.full(200, 14.0), speed_mps=0 * t, yaw_rate_radps=0 * t)
    few = Log(t=[0, 1], lat_deg=[50.0, 50.0], lon_deg=[14.0, 14.1], speed_mps=[7.0, 7.0])
    straight = Log(
        t=t, lat_deg=50 + 1e-4 * t, lon_deg=np.full(200, 14.0), speed_mps=0 * t + 11.12, yaw_rate_radps=0 * t
    )
    for log in (still, few, straight):
        found = calibrated(log)
        assert not any(one.observable for one in found.offsets.values())
        t_speed, speed = found.stream(log, "speed")
        assert np.array_equal(t_speed, log.t)
        assert np.allclose(speed, log.speed_mps, rtol=0.01)
        json.dumps(found.to_dict(), allow_nan=False)


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_absurd_sizes_do_no_harm(scale):
    _, log = simulate_drive(seed=2, **CLEAN | {"duration": 100.0})
    with np.errstate(all="raise"):
        found = calibrated(replace(log, speed_mps=scale * log.speed_mps, yaw_rate_radps=scale * log.yaw_rate_radps))
    assert np.isfinite([one.seconds for one in found.offsets.values()]).all()
    assert np.isfinite([found.scale, found.bias]).all()


def test_streams_put_right():
    log = Log(
        t=[0, 1, 2, 3],
        lat_deg=[50.0] * 4,
        lon_deg=[14.0] * 4,
        speed_mps=[1.0, 2.0, 3.0, 4.0],
        yaw_rate_radps=[0.1, 0.2, 0.3, 0.4],
    )
    step = Offset(0.0, 0.1, True, ((1.4, 0.0), (1.5, -1.2)), "step")
    known = Calibration(
        offsets={"speed": step, "yaw_rate": Offset(0.5, 0.1, False)}, scale=2.0, bias_at=((0.0, 0.0), (2.0, 0.2))
    )
    t, speed = known.stream(log, "speed")
    assert t.tolist() == pytest.approx([0, 1, 1.8])  # what the step back repeats is dropped
    assert speed.tolist() == [2, 4, 8]
    t, rate = known.stream(log, "yaw_rate")
    assert t.tolist() == [0, 1, 2, 3]  # not observable, so not moved
    assert rate == pytest.approx([0.1, 0.1, 0.1, 0.2])


@pytest.mark.parametrize(
    ("name", "speed", "yaw"),
    [
        ("balzer_dresden_2014_03_26", (-0.6, -0.3), (0.4, 0.7)),  # Doppler lags, the position lags the gyro
        ("smartloc_berlin_potsdamer_platz", (-0.03, 0.03), (-0.05, 0.08)),
        ("driveplotr_nds_drive18", (-1.0, -0.4), (-0.1, 0.5)),
    ],
)
def test_real_logs(name, speed, yaw, data):
    found = calibrated(read(data / f"{name}.csv.gz"))
    assert speed[0] < found.offsets["speed"].seconds < speed[1]
    assert yaw[0] < found.offsets["yaw_rate"].seconds < yaw[1]
    assert 0.001 < found.offsets["speed"].sd < 0.15
    assert found.scale == pytest.approx(1, abs=0.03)
    assert abs(found.bias) < 0.005
    assert not found.antenna_observable


@pytest.mark.parametrize("late", [0.0, 0.4])
def test_a_step_of_the_clocks_shows_on_poor_fixes_of_one_a_second(late):
    # the rough look sees none: the pieces of the drive disagree
    _, log = simulate_drive(
        duration=300.0, rate=10.0, fix_rate=1.0, fix_noise=0.6, fix_offset=0.8, outages=((70.0, 85.0),), seed=25
    )
    streams = {name: getattr(log, name) for name in ("speed_mps", "yaw_rate_radps")}
    stepped = {
        name: np.where(log.t > 160, np.interp(log.t - late, log.t, values), values) for name, values in streams.items()
    }
    offsets = calibrated(replace(log, **stepped)).offsets
    for name in ("speed", "yaw_rate"):
        assert offsets[name].change == ("step" if late else "")
        if late:
            (_, before), (when, after) = offsets[name].at
            assert when == pytest.approx(160, abs=5)
            assert before - after == pytest.approx(late, abs=0.12)


def test_a_clock_offset_longer_than_the_log_is_no_seconds():
    _, log = simulate_drive(duration=60.0, seed=1, tunnels=[])
    assert calibrated(log, clock_offset=-59.0).offsets["speed"].seconds == -59.0
    with pytest.raises(BadValue, match=r"`clock_offset` is 150 s but the log is only 60\.0 s long"):
        calibrated(log, clock_offset=150.0)
