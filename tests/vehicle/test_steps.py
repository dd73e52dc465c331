"""Wrong fixes that step to the right ones are found without any other sensor; what a car does is left in peace."""

from dataclasses import replace

import numpy as np
import pytest

from halfwidth.vehicle import evidence, fill, simulate_drive
from halfwidth.vehicle.formats import read
from halfwidth.vehicle.steps import stepped

GAPS = ((100.0, 120.0), (200.0, 215.0))


def drive(seed=4, **how):
    truth, log = simulate_drive(
        duration=300.0, outages=GAPS, seed=seed, **({"fix_noise": 0.1, "fix_offset": 0.3} | how)
    )
    return truth, replace(log, speed_mps=np.full(len(log), np.nan))


def shifted(log, first, last, north, east):
    """The log with fixes in (first, last] moved, and which rows these are."""
    rows = np.flatnonzero(log.fixed & (log.t > first) & (log.t <= last))
    lat, lon = log.lat_deg.copy(), log.lon_deg.copy()
    lat[rows] += north / 111_229
    lon[rows] += east / (111_320 * np.cos(np.radians(50.09)))
    return replace(log, lat_deg=lat, lon_deg=lon), rows


def found(log):
    rows = np.flatnonzero(log.fixed)
    return rows[stepped(log.t[rows], np.column_stack(evidence.local_metres(log.lat_deg[rows], log.lon_deg[rows])))]


@pytest.mark.parametrize("rate", [10.0, 1.0])
@pytest.mark.parametrize(("seconds", "metres"), [(1.1, 25.0), (4.0, 40.0), (15.0, 60.0)])
def test_the_first_fixes_after_a_gap_are_found(rate, seconds, metres):
    _, log = drive(fix_rate=rate)
    wrong, every = log, []
    for _, last in GAPS:
        wrong, rows = shifted(wrong, last, last + seconds, 0.6 * metres, -0.8 * metres)
        every.append(rows)
    np.testing.assert_array_equal(found(wrong), np.concatenate(every))


def test_the_last_fixes_before_a_gap_and_a_jump_away_and_back_are_found():
    _, log = drive()
    wrong, before = shifted(log, GAPS[0][0] - 3.0, GAPS[0][0], 20.0, 0.0)
    wrong, between = shifted(wrong, 150.0, 158.0, 0.0, 15.0)
    np.testing.assert_array_equal(found(wrong), np.sort(np.concatenate((before, between))))


def test_a_step_between_two_long_stretches_proves_neither_wrong():
    _, log = drive()
    wrong, _ = shifted(log, 160.0, 200.0, 30.0, 0.0)
    assert found(wrong).size == 0


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("rate", "noise"), [(10.0, 0.03), (10.0, 2.0), (1.0, 0.5)])
def test_good_fixes_are_left_in_peace(seed, rate, noise):
    assert found(drive(seed, fix_rate=rate, fix_noise=noise, fix_offset=2 * noise)[1]).size == 0


@pytest.mark.parametrize("name", ["smartloc", "balzer", "driveplotr"])
def test_real_logs_are_left_in_peace(data, name):
    assert found(read(next(data.glob(f"{name}*.csv.gz")))).size == 0


def test_strange_fixes_are_survived():
    t = np.arange(40.0)
    rng = np.random.default_rng(1)
    wild = 1e7 * rng.standard_normal((40, 2))
    for y in (np.zeros((40, 2)), wild, np.where(t[:, None] % 2, 0.0, 1e5) * np.ones(2)):
        assert stepped(t, y).shape == (40,)
    assert not stepped(t, np.zeros((40, 2))).any()
    assert not stepped(t[:3], wild[:3]).any()
    assert not stepped(10.0 * t, wild).all()


def test_without_a_speed_wrong_first_fixes_do_not_bend_a_gap():
    truth, log = drive()
    wrong = log
    for _, last in GAPS:
        wrong, _ = shifted(wrong, last, last + 2.0, 36.0, 48.0)

    def worst(track):
        inside = np.zeros(len(track), dtype=bool)
        for first, last in GAPS:
            inside |= (track.t_s > first) & (track.t_s < last)
        off = truth.error_m(track.t_s[inside], track.lat_deg[inside], track.lon_deg[inside])
        return float(np.hypot(*off).max())

    track = fill(wrong)
    assert any("lie off the path of the others" in message for message in track.messages)
    assert worst(track) < 1.5 * worst(fill(log)) + 1.0


def test_integrals_are_exact_and_say_what_they_cannot_tell():
    rng = np.random.default_rng(4)
    t = np.cumsum(rng.uniform(0.05, 0.2, 200))
    t[100:] += 5.0  # a pause
    values = rng.normal(size=200)
    start = rng.uniform(-1, t[-1] + 1, 300)
    stop = start + rng.uniform(0, 4, 300)
    late = np.array([-0.7, 0.0, 1.3])
    got = evidence.integrals(t, values, start, stop, late)
    for k, by in enumerate(late):
        clock = t + by
        for a, b, one in zip(start, stop, got[:, k], strict=True):
            paused = (a < clock[100]) and (b > clock[99])
            if a < clock[0] or b > clock[-1] or paused:
                assert np.isnan(one)
            else:
                inside = clock[(clock > a) & (clock < b)]
                x = np.concatenate(([a], inside, [b]))
                assert one == pytest.approx(np.trapezoid(np.interp(x, clock, values), x), abs=1e-12)
    assert np.isnan(evidence.integral(t[:1], values[:1], start, stop)).all()
