"""A log that was written late: found where the fixes fit the speed better, left alone everywhere else."""

from dataclasses import replace

import numpy as np
import pytest

from halfwidth.vehicle import fill, outages
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.stamps import delays, leaps, restamped


def _drive(seconds=120.0, rate=10.0, seed=0, jitter=0.0):
    """A car on a winding road at a changing speed, everything at one rate, fixes good to some centimetres."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1 / rate)
    speed = 8.0 + 4.0 * np.sin(t / 7.0)
    yaw = 0.1 * np.sin(t / 11.0)
    azimuth = -np.concatenate(([0.0], np.cumsum(0.5 * (yaw[1:] + yaw[:-1]) / rate)))
    east, north = (np.concatenate(([0.0], np.cumsum(speed[1:] / rate * f(azimuth[1:])))) for f in (np.sin, np.cos))
    noise = 0.03 * rng.standard_normal((2, t.size))
    lat, lon = 50.0 + (north + noise[0]) / 111_229.0, 14.0 + (east + noise[1]) / 71_695.0
    late = jitter * rng.random(t.size)
    return Log(t=t + late, lat_deg=lat, lon_deg=lon, speed_mps=speed, yaw_rate_radps=yaw), t


def _hung(t, begin=40.0, most=1.5, recovery=8.0):
    """How late a logger writes that hangs and then works off what waits."""
    return np.where(t < begin, 0.0, np.clip(most * (1 - (t - begin) / recovery), 0.0, most))


def test_a_logger_that_hangs_is_found_and_put_right():
    log, said = _drive()
    written = replace(log, t=said + _hung(said))
    found, stamps = restamped(written)
    assert stamps.moved
    assert "late" in stamps.words()
    late = found.t - said
    # all that is left is one delay that all share, and what a period taken a little too short leaves
    assert np.ptp(late) < 0.05
    assert np.array_equal(stamps.back(found.t), written.t)
    between = 0.5 * (found.t[1:] + found.t[:-1])
    assert (np.diff(stamps.back(np.sort(np.concatenate((found.t, between))))) > 0).all()


@pytest.mark.parametrize("rate", [1.0, 10.0])
def test_a_clock_that_leaps_is_found_and_its_stamps_come_back(rate):
    log, _ = _drive(seconds=200.0, rate=rate)
    written = replace(log, t=np.where(log.t < 100, log.t, log.t + 2.5))
    (one,) = leaps(written)
    assert one == pytest.approx((102.5, 2.5), abs=0.06)
    found, stamps = restamped(written)
    assert stamps.moved
    assert found.t == pytest.approx(log.t, abs=1e-6)
    assert np.array_equal(stamps.back(found.t), written.t)
    assert stamps.late.max() == pytest.approx(0, abs=1e-9)
    assert "leaps by 2.50 s at 102.5 s" in stamps.words()
    assert "late" not in stamps.words()
    track = fill(written.without(120.0, 130.0))
    assert any("leaps" in message for message in track.messages)
    assert np.isin(track.t_s, written.t).all()


def test_a_pause_in_which_the_car_moves_on_is_none():
    log, t = _drive(seconds=200.0)
    kept = (t < 100) | (t > 102.5)
    paused = Log(
        **{name: getattr(log, name)[kept] for name in ("t", "lat_deg", "lon_deg", "speed_mps", "yaw_rate_radps")}
    )
    assert leaps(paused) == ()
    assert leaps(log) == ()
    assert leaps(replace(log, speed_mps=np.full(t.size, np.nan))) == ()
    assert leaps(Log(t=t[:3], lat_deg=log.lat_deg[:3], lon_deg=log.lon_deg[:3])) == ()


def test_a_logger_that_hangs_in_a_gap_is_found_by_its_clockwork():
    log, said = _drive(seconds=200.0)
    hidden = (said > 38) & (said < 52)  # no fix tells
    dark = replace(log, lat_deg=np.where(hidden, np.nan, log.lat_deg), lon_deg=np.where(hidden, np.nan, log.lon_deg))
    found, stamps = restamped(replace(dark, t=said + _hung(said)))
    assert np.ptp(found.t - said) < 0.1
    assert stamps.leaps == ()
    assert restamped(dark)[0] is dark


@pytest.mark.parametrize("turned", [162.0, 164.0, 166.0, 168.0])
def test_a_pause_beside_a_gap_in_which_the_car_turns_round_is_none(turned):
    t = np.arange(0.0, 400.0)
    t = t[(t < 100) | (t >= 145)]
    north = 10.0 * np.minimum(t, 2 * turned - t) + 0.03 * np.random.default_rng(0).standard_normal(t.size)
    log = Log(t=t, lat_deg=50.0 + north / 111_229.0, lon_deg=np.full(t.size, 14.0), speed_mps=np.full(t.size, 10.0))
    assert leaps(log) == ()
    # only the first fix after the pause is left
    assert leaps(log.without(145.5, 187.0)) == ()


def test_a_leap_and_a_logger_that_hangs_are_found_together():
    log, said = _drive(seconds=200.0)
    written = said + _hung(said)
    found, stamps = restamped(replace(log, t=np.where(said < 140, written, written + 3.0)))
    assert np.ptp(found.t - said) < 0.05
    assert "leaps" in stamps.words()
    assert "late" in stamps.words()


def test_arrival_jitter_is_taken_away():
    log, said = _drive(jitter=0.06)
    found, stamps = restamped(log)
    assert stamps.moved
    assert np.std(found.t - said) < 0.5 * np.std(log.t - said)


@pytest.mark.parametrize("rate", [1.0, 5.0, 10.0])
def test_regular_stamps_stay(rate):
    log, _ = _drive(seconds=200.0, rate=rate)
    found, stamps = restamped(log)
    assert found is log
    assert not stamps.moved
    assert stamps.words() == ""


def test_true_but_irregular_stamps_stay():
    """Sampled unevenly, and stamped rightly: regular times would fit the speed worse."""
    rng = np.random.default_rng(3)
    log, said = _drive(rate=50.0)
    keep = np.unique(
        np.clip(np.arange(0, said.size - 5, 5) + rng.integers(-2, 3, len(range(0, said.size - 5, 5))), 0, None)
    )
    uneven = Log(
        **{name: getattr(log, name)[keep] for name in ("t", "lat_deg", "lon_deg", "speed_mps", "yaw_rate_radps")}
    )
    found, stamps = restamped(uneven)
    assert found is uneven
    assert not stamps.moved


def test_lost_samples_are_no_delay():
    log, said = _drive()
    keep = (said < 50.0) | (said > 57.0)
    lost = Log(
        **{name: getattr(log, name)[keep] for name in ("t", "lat_deg", "lon_deg", "speed_mps", "yaw_rate_radps")}
    )
    assert restamped(lost)[0] is lost


def test_without_speed_or_with_few_fixes_nothing_moves():
    log, said = _drive()
    late = replace(log, t=said + _hung(said))
    assert not restamped(replace(late, speed_mps=np.full(said.size, np.nan)))[1].moved
    few = Log(t=late.t[:30], lat_deg=late.lat_deg[:30], lon_deg=late.lon_deg[:30], speed_mps=late.speed_mps[:30])
    assert not restamped(few)[1].moved
    assert not restamped(Log(t=[0.0, 1.0], lat_deg=[50.0, 50.0], lon_deg=[14.0, 14.0]))[1].moved


def test_delays_of_a_stream_that_is_not_regular_are_none():
    t = np.cumsum(np.random.default_rng(1).exponential(0.1, 400))
    late, period = delays(t)
    assert period == 0.0
    assert not late.any()


def test_a_track_keeps_the_stamps_of_the_log_and_is_nearer():
    log, said = _drive()
    written = replace(log, t=said + _hung(said))
    gap = (said > 41.0) & (said < 47.0)
    holed = written.without(written.t[gap][0], written.t[gap][-1])
    track = fill(holed)
    rows = np.flatnonzero(gap)
    at = np.searchsorted(track.t_s, written.t[rows])
    assert np.array_equal(track.t_s[at], written.t[rows])
    off = np.hypot((track.lat_deg[at] - log.lat_deg[rows]) * 111_229, (track.lon_deg[at] - log.lon_deg[rows]) * 71_695)
    assert off.max() < 2.0  # taken as written it is off by half of what the car drives in 1.5 s: 7 m
    assert any("late" in message for message in track.messages)
    assert np.isin(holed.t[holed.fixed], track.t_s).all()


def test_the_benchmark_measures_at_the_times_of_the_sensors():
    log, said = _drive()
    clean = outages(log, (5.0,), 5, 2, ("em",)).cell("em", 5.0)
    late = outages(replace(log, t=said + _hung(said)), (5.0,), 5, 2, ("em",)).cell("em", 5.0)
    assert late.mean < 2.0 * clean.mean + 0.05
