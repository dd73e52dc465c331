import dataclasses
import importlib
import sys
import time

import numpy as np
import pytest
from tests.vehicle.known import FRAME, known, real_log

import halfwidth as hw
from halfwidth.errors import BadLog, BadValue
from halfwidth.vehicle import estimators, widening
from halfwidth.vehicle.fill import fill
from halfwidth.vehicle.frames import Frame
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.track import Track

NAN = np.nan


def drive(**change):
    return known(**({"duration": 150.0, "noise": 0.2, "speed_noise": 0.05, "yaw_noise": 0.005} | change))


def sound(track):
    """What must hold of every track."""
    assert isinstance(track, Track)
    for name in ("lat_deg", "lon_deg", "east_half_m", "north_half_m"):
        assert np.isfinite(getattr(track, name)).all(), name
    assert (track.half_m >= 0).all()
    assert track.guarantee != "proven"
    fixed = np.isin(track.t_s, track.log.t[track.log.fixed])
    np.testing.assert_array_equal(track.quality == "fix", fixed)
    assert fixed.sum() == track.log.fixed.sum()
    return track


def test_a_gap_is_filled_near_the_truth_and_says_how_near():
    made = drive()
    track = sound(fill(made.log.without(60, 80)))
    assert track.method == "em"
    gap = track.quality == "bridged"
    t = track.t_s[gap]
    np.testing.assert_array_equal(t, made.t[(made.t >= 60) & (made.t <= 80)])
    assert made.error(track.t_s, track.lat_deg, track.lon_deg).max() < 1.5
    assert track.half_m[gap].max() > 1.1 * track.half_m[~gap].max()
    assert len(track.gaps) == 1
    assert track.gaps[0].duration_s == pytest.approx(20.2, abs=0.11)
    at = np.searchsorted(made.t, track.t_s)
    np.testing.assert_allclose(track.speed_mps, made.speed[at], atol=0.5)
    np.testing.assert_allclose(np.cos(track.azimuth_rad - made.azimuth[at]), 1.0, atol=0.02)
    assert np.nanmax(track.since_fix_s) == pytest.approx(20.1, abs=0.11)
    np.testing.assert_allclose(track.alt_m, 200.0)


def test_a_slow_error_of_the_receiver_is_named_and_in_the_half_widths_about_the_truth():
    inside, true, about = [], [], []
    for seed in range(4):
        size = (0.1, 0.3, 1.0, 3.0)[seed]
        made = drive(duration=240.0, offset=size, seed=seed)
        spans = [(60.0, 75.0), (150.0, 180.0)]
        track = fill(made.log.without(*spans[0]).without(*spans[1]))
        inside.append(_against_hidden(made.log, track, spans)[2])
        found = track.settings["slow error of the fixes"]
        assert found < 2.5 * size
        assert size < 1.0 or found > 0.4 * size
        assert any("not where it was" in message for message in track.messages)
        assert size < 1.0 or any("for minutes at a time" in message for message in track.messages)
        at = np.searchsorted(made.t, track.t_s)
        off = np.abs(
            np.column_stack(FRAME.to_local(track.lat_deg, track.lon_deg))
            - np.column_stack((made.east[at], made.north[at]))
        )
        true.append(np.mean(off <= track.truth_half_m))
        about.append(np.mean(off <= np.column_stack((track.east_half_m, track.north_half_m))))
        assert (track.truth_half_m >= np.column_stack((track.east_half_m, track.north_half_m))).all()
    assert 0.75 < np.mean(inside) <= 1.0
    assert np.mean(true) > 0.75  # the log tells the size of the error, not how long it lasts
    assert np.mean(about[2:]) < 0.5  # what the half-widths do not promise


def test_fixes_without_a_slow_error_have_none():
    made = drive(duration=240.0, noise=0.3)
    track = fill(made.log.without(100, 120))
    assert track.settings["slow error of the fixes"] < 0.15
    assert track.truth_half_m.max() < 1.5 * track.half_m.max()


def test_rows_between_usual_fixes_are_not_asked_for():
    made = drive(fix_every=5)
    track = sound(fill(made.log.without(60, 70)))
    assert set(track.quality) == {"fix", "bridged"}
    bridged = track.t_s[track.quality == "bridged"]
    assert bridged.min() > 59
    assert bridged.max() < 71
    assert np.diff(bridged).max() < 0.11


def test_both_ends_are_extrapolated_with_growing_half_widths():
    made = drive(duration=100.0)
    track = sound(fill(made.log.without(0, 10).without(90, 100)))
    assert (track.quality[[0, -1]] == "extrapolated").all()
    before, after = track.half_m[track.t_s < 9.9], track.half_m[track.t_s > 90.1]
    assert (np.diff(before) <= 1e-6).all()
    assert (np.diff(after) >= -1e-6).all()
    assert np.isnan(track.since_fix_s[0])
    assert {gap.quality for gap in track.gaps} == {"extrapolated"}
    assert made.error(track.t_s, track.lat_deg, track.lon_deg).max() < 10


def test_a_higher_level_is_wider():
    log = drive().log.without(60, 80)
    low, high = fill(log, level=0.5), fill(log, level=0.99)
    assert (high.half_m > low.half_m).all()
    np.testing.assert_array_equal(low.lat_deg, high.lat_deg)


@pytest.mark.parametrize("name", ["linear", "cv", "gpsins", "ctrv", "em", "paper000+ls", "paper002", "ep", "cvar"])
def test_every_method_makes_a_track(name):
    made = known(80.0, rate=5.0, noise=0.1, speed_noise=0.05, yaw_noise=0.005)
    track = sound(fill(made.log.without(40, 44), method=name))
    assert track.method == name
    assert track.half_m[track.quality == "bridged"].max() > 0.05
    assert made.error(track.t_s, track.lat_deg, track.lon_deg).max() < 6


@pytest.mark.parametrize(
    ("missing", "method", "word"),
    [
        (("speed_mps",), "em", "no speed"),
        (("yaw_rate_radps",), "em", "no yaw rate"),
        (("speed_mps", "yaw_rate_radps"), "cv", "neither"),
    ],
)
def test_without_sensors_it_does_what_it_can_and_says_so(missing, method, word):
    made = drive()
    log = dataclasses.replace(made.log.without(60, 66), **{name: np.full(len(made.log), NAN) for name in missing})
    track = sound(fill(log))
    assert track.method == method
    assert any(word in message for message in track.messages)
    assert made.error(track.t_s, track.lat_deg, track.lon_deg).max() < 8
    asked = sound(fill(log, method="gpsins"))
    assert any("needs the" in message for message in asked.messages)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 8])
def test_few_fixes_are_enough(n):
    made = drive(duration=60.0)
    keep = np.zeros(len(made.log), dtype=bool)
    keep[np.linspace(100, 500, n).astype(int)] = True
    log = dataclasses.replace(
        made.log, lat_deg=np.where(keep, made.log.lat_deg, NAN), lon_deg=np.where(keep, made.log.lon_deg, NAN)
    )
    track = sound(fill(log))
    assert (track.quality == "fix").sum() == n
    assert (np.diff(track.half_m[track.t_s > 52]) >= 0).all()


def test_no_gaps_no_filling():
    made = drive(duration=60.0)
    track = sound(fill(made.log))
    assert (track.quality == "fix").all()
    assert not track.gaps
    # the path is better than the fixes it rests on
    assert (
        made.error(track.t_s, track.lat_deg, track.lon_deg).mean()
        < made.error(made.t, made.log.lat_deg, made.log.lon_deg).mean()
    )


def test_a_gap_of_minutes():
    made = drive(duration=900.0, rate=5.0)
    track = sound(fill(made.log.without(300, 600)))
    gap = track.quality == "bridged"
    off = made.error(track.t_s, track.lat_deg, track.lon_deg)
    assert off[gap].max() < 3 * track.half_m[gap].max()
    assert track.half_m[gap].max() < 500


def test_one_hertz_everything():
    made = known(400.0, rate=1.0, noise=0.5, speed_noise=0.1, yaw_noise=0.003)
    track = sound(fill(made.log.without(200, 220)))
    assert made.error(track.t_s, track.lat_deg, track.lon_deg).max() < 6


def test_a_stop_inside_a_gap():
    made = drive(stop=(62.0, 75.0))
    track = sound(fill(made.log.without(55, 85)))
    stood = (track.t_s > 63) & (track.t_s < 74)
    east, north = Frame.of(made.log).to_local(track.lat_deg[stood], track.lon_deg[stood])
    assert np.hypot(np.ptp(east), np.ptp(north)) < 1.0  # the receiver drifts on


def test_standing_still_for_the_whole_log():
    t = np.arange(0, 60.05, 0.1)
    rng = np.random.default_rng(0)
    lat, lon = 50 + 2e-6 * rng.standard_normal(t.size), 14 + 2e-6 * rng.standard_normal(t.size)
    log = Log(t=t, lat_deg=lat, lon_deg=lon, speed_mps=0 * t, yaw_rate_radps=1e-3 * rng.standard_normal(t.size))
    track = sound(fill(log.without(20, 40)))
    assert track.half_m.max() < 5
    assert track.gaps[0].distance_m < 5


def test_identical_fixes():
    t = np.arange(0, 30.0, 0.5)
    log = Log(t=t, lat_deg=np.full(t.size, 50.0), lon_deg=np.full(t.size, 14.0))
    track = sound(fill(log.without(10, 15)))
    np.testing.assert_allclose(track.lat_deg, 50.0, atol=1e-6)


def test_a_pause_of_the_log_is_not_bridged():
    made = drive(duration=400.0, rate=5.0)
    hole = (made.t > 100) & (made.t < 300)
    log = Log(
        **{
            f.name: getattr(made.log, f.name)[~hole]
            for f in dataclasses.fields(Log)
            if f.name in ("t", "lat_deg", "lon_deg", "speed_mps", "yaw_rate_radps")
        }
    )
    track = sound(fill(log.without(50, 60)))
    off = made.error(track.t_s, track.lat_deg, track.lon_deg)
    assert off.max() < 3.0


def test_a_long_log_is_cut_without_seams():
    made = known(2000.0, rate=5.0, noise=0.1, speed_noise=0.05, yaw_noise=0.003)
    track = sound(fill(made.log.without(590, 620).without(1195, 1215)))
    assert made.error(track.t_s, track.lat_deg, track.lon_deg).max() < 3.0
    east, north = Frame.of(made.log).to_local(track.lat_deg, track.lon_deg)
    step = np.hypot(np.diff(east), np.diff(north)) - 0.5 * (track.speed_mps[1:] + track.speed_mps[:-1]) * np.diff(
        track.t_s
    )
    assert np.abs(step).max() < 0.5


def test_a_method_that_fails_is_replaced_and_the_track_says_so(monkeypatch):
    broken = dataclasses.replace(
        estimators.METHODS["gpsins"],
        run=lambda drives, tuned: [
            dataclasses.replace(path, east=np.full(path.t.size, NAN))
            for path in estimators.METHODS["linear"].run(drives, {})
        ],
        tune=lambda drive: {},
    )
    monkeypatch.setattr(
        sys.modules["halfwidth.vehicle.fill"], "method_of", lambda name: broken
    )  # not the function of its name
    made = drive(duration=60.0, rate=5.0)
    track = sound(fill(made.log.without(20, 24), method="gpsins"))
    assert any("no usable path" in message for message in track.messages)
    assert made.error(track.t_s, track.lat_deg, track.lon_deg).max() < 6


def test_the_intervals_are_tested_on_the_log_itself():
    made = drive(duration=240.0)
    track = fill(made.log.without(100, 110))
    assert any("hidden stretches" in message for message in track.messages)
    rows = track.benchmark
    assert rows
    assert rows[0]["stretches"] >= 3
    assert rows[0]["inflation"] > 0
    assert any(name.startswith("inflation at") for name in track.settings)


def test_wrong_arguments():
    log = drive(duration=20.0).log
    for wrong, kind in (
        ({"level": 1.0}, BadValue),
        ({"method": "none"}, BadValue),
        ({"clock_offset": np.inf}, BadValue),
        ({"level": "a"}, BadValue),
        ({"level": None}, BadValue),
        ({"clock_offset": "a"}, BadValue),
        ({"clock_offset": []}, BadValue),
    ):
        with pytest.raises(kind, match=next(iter(wrong))) as caught:
            fill(log, **wrong)
        assert caught.value.hint or "method" in wrong
    with pytest.raises(BadLog, match="no fix"):
        fill(Log(t=[0.0, 1.0, 2.0]))


def test_paths_and_frames_are_logs_too(tmp_path):
    pandas = pytest.importorskip("pandas")
    log = drive(duration=40.0).log.without(20, 23)
    frame = log.frame()
    path = tmp_path / "drive.csv"
    frame.to_csv(path, index=False)
    from_frame, from_path = hw.vehicle.fill(frame), hw.vehicle.fill(path)
    assert isinstance(from_frame.frame(), pandas.DataFrame)
    np.testing.assert_allclose(from_frame.lat_deg, from_path.lat_deg, atol=1e-9)
    polars = pytest.importorskip("polars")
    assert isinstance(hw.vehicle.fill(polars.DataFrame(log.frame("polars"))).frame(), polars.DataFrame)


def test_ten_minutes_at_ten_hertz_take_a_few_seconds():
    log = drive(duration=600.0).log.without(100, 130).without(300, 310).without(450, 510)
    fill(log.without(0, 590))
    clock = time.process_time()
    fill(log)
    assert time.process_time() - clock < 4.0  # 1.6 s on an idle machine


@pytest.mark.parametrize("name", ["smartloc", "balzer", "driveplotr"])
def test_half_widths_hold_hidden_fixes_of_real_logs(data, name):
    log = real_log(data, name)
    frame, inside = Frame.of(log), []
    for t0 in np.linspace(log.t[0] + 40, log.t[-1] - 60, 5):
        track = sound(fill(log.without(t0, t0 + 15)))
        rows = np.flatnonzero(log.fixed & (log.t >= t0) & (log.t <= t0 + 15))
        if not rows.size:
            continue
        at = np.searchsorted(track.t_s, log.t[rows])
        true, found = (
            frame.to_local(log.lat_deg[rows], log.lon_deg[rows]),
            frame.to_local(track.lat_deg[at], track.lon_deg[at]),
        )
        inside += [
            np.mean(np.abs(true[0] - found[0]) <= track.east_half_m[at]),
            np.mean(np.abs(true[1] - found[1]) <= track.north_half_m[at]),
        ]
    assert np.mean(inside) > 0.75


def test_a_receivers_own_log_is_filled_where_it_pauses():
    """Nothing at all arrives in the tunnel: rows are added at the rate of the fixes."""
    t = np.arange(0.0, 120.0)
    lat, lon = 50 + 1e-4 * t, 14 + 2e-4 * np.sin(t / 30)
    keep = (t < 50) | (t > 75)
    track = hw.vehicle.fill(hw.vehicle.Log(t=t[keep], lat_deg=lat[keep], lon_deg=lon[keep]))
    np.testing.assert_allclose(track.t_s, t)
    assert np.all((track.quality == "bridged") == ~keep)
    assert np.abs(track.lat_deg - lat).max() * 111e3 < 1.0
    assert any("26 rows were added" in message for message in track.messages)


def test_a_pause_longer_than_a_minute_is_left_open():
    t = np.r_[np.arange(0.0, 60.0), np.arange(130.0, 190.0)]
    track = hw.vehicle.fill(hw.vehicle.Log(t=t, lat_deg=50 + 1e-5 * t, lon_deg=np.full(t.size, 14.0)))
    np.testing.assert_array_equal(track.t_s, t)
    assert any("left open" in message for message in track.messages)


@pytest.mark.parametrize("jump", [20.0, 1000.0])
def test_two_stray_fixes_do_not_set_the_noise_of_the_drive(jump):
    made = drive()
    lat = np.array(made.log.lat_deg)
    lat[700:702] += jump / 111e3
    clean = fill(made.log.without(100, 115))
    track = sound(fill(dataclasses.replace(made.log, lat_deg=lat).without(100, 115)))
    assert any("left out: 70.0" in m for m in track.messages)
    # 5 Hz nodes: the second fix may not be looked at at all
    off = made.error(track.t_s, track.lat_deg, track.lon_deg)
    assert off.max() < 2.0
    assert track.half_m.max() < 1.2 * clean.half_m.max()


def test_any_log_gets_a_track():
    rng = np.random.default_rng(11)
    for seed in range(60):
        made = known(
            float(rng.choice([3, 10, 40])),
            rate=float(rng.choice([1, 5, 10])),
            noise=float(rng.choice([0, 0.2, 3, 50])),
            speed_noise=float(rng.choice([0, 0.1, 5])),
            yaw_noise=float(rng.choice([0, 0.01, 0.5])),
            bias=float(rng.choice([0, 0.02, 1.0])),
            scale=float(rng.choice([1, 0.5, 3])),
            fix_every=int(rng.choice([1, 3, 10])),
            seed=seed,
        )
        columns = {
            name: np.array(getattr(made.log, name))
            for name in ("t", "lat_deg", "lon_deg", "speed_mps", "yaw_rate_radps")
        }
        n = columns["t"].size
        for name in ("speed_mps", "yaw_rate_radps"):
            fault = rng.integers(6)
            if fault == 0:
                columns[name][:] = NAN
            elif fault == 1:
                columns[name][rng.random(n) < 0.97] = NAN
            elif fault == 2:
                columns[name][:] = 0
            elif fault == 3:
                columns[name][rng.integers(n)] = 1e4
            elif fault == 4:
                columns[name] *= -1
        fault = rng.integers(5)
        if fault == 0:
            columns["t"] += np.where(np.arange(n) > n // 2, 1e5, 0)
        elif fault == 1:
            columns["t"] **= 1.5
        elif fault == 2:
            lost = rng.random(n) < 0.9
            columns["lat_deg"][lost] = columns["lon_deg"][lost] = NAN
        elif fault == 3:
            columns["lat_deg"] += 39.9
        first = columns["t"][rng.integers(n)]
        log = Log(**columns).without(first, first + 0.5 * np.ptp(columns["t"]) * rng.random())
        if log.fixed.any():
            sound(fill(log))


def test_half_widths_that_could_not_be_tested_claim_no_probability():
    made = drive()
    columns = {name: getattr(made.log, name).copy() for name in ("lat_deg", "lon_deg", "speed_mps", "yaw_rate_radps")}
    kept = np.flatnonzero(made.log.fixed)[::300]
    for name in ("lat_deg", "lon_deg"):
        columns[name][~np.isin(np.arange(len(made.log)), kept)] = NAN
    assert sound(fill(Log(t=made.t, **columns))).guarantee == "none"
    assert fill(made.log.without(60, 80)).guarantee == "credible"


def _hole(log, spans, *names):
    """The log without its fixes and without the sensors named in some spans of time."""
    inside = np.any([(log.t >= a) & (log.t <= b) for a, b in spans], axis=0)
    log = dataclasses.replace(log, **{name: np.where(inside, NAN, getattr(log, name)) for name in names})
    for a, b in spans:
        log = log.without(a, b)
    return log


def _against_hidden(log, track, spans):
    """Errors of hidden fixes, the half-widths there, and the share inside, each axis by itself."""
    rows = np.flatnonzero(log.fixed & np.any([(log.t >= a) & (log.t <= b) for a, b in spans], axis=0))
    at, frame = np.searchsorted(track.t_s, log.t[rows]), Frame.of(log)
    off = np.abs(
        np.array(frame.to_local(log.lat_deg[rows], log.lon_deg[rows]))
        - np.array(frame.to_local(track.lat_deg[at], track.lon_deg[at]))
    )
    half = np.array([track.east_half_m[at], track.north_half_m[at]])
    return np.hypot(*off), half, float(np.mean(off <= half))


@pytest.mark.parametrize("silent", [("speed_mps",), ("speed_mps", "yaw_rate_radps")])
def test_where_the_speed_is_lost_with_the_fixes_half_widths_are_of_the_size_of_the_errors(data, silent):
    log = real_log(data, "driveplotr")
    spans = [(a, a + 30) for a in np.linspace(60, 900, 8)]
    track = sound(fill(_hole(log, spans, *silent)))
    error, half, inside = _against_hidden(log, track, spans)
    assert inside > 0.85
    assert half.max() < 6 * error.max()  # a few guesses in what the other gaps have left are all there is to size it by
    assert any("without speed" in message and "tested on" in message for message in track.messages)


def test_a_hole_in_which_nothing_arrives_is_about_as_sure_as_constant_velocity(data):
    log = real_log(data, "driveplotr")
    widest = {name: max(gap.max_half_m for gap in fill(log, method=name).gaps) for name in (None, "cv")}
    assert widest[None] < 2 * widest["cv"]


def test_without_a_yaw_rate_one_gap_is_judged_by_others_that_do_not_know_the_way(data):
    log = real_log(data, "smartloc")
    bare = dataclasses.replace(log, yaw_rate_radps=np.full(len(log), NAN))
    shares = []
    for a in (30, 65, 100, 150, 200):
        track = sound(fill(bare.without(a, a + 30)))
        error, half, inside = _against_hidden(log, track, [(a, a + 30)])
        shares.append(inside)
        assert error.max() < 5 * half.max()
    assert np.mean(shares) > 0.75  # five gaps: 0.9 with a standard error of about 0.1


def test_silent_sensors_in_one_gap_do_not_widen_the_others():
    made = drive(duration=300.0)
    one = fill(made.log.without(60, 80))
    both = sound(fill(_hole(made.log.without(60, 80), [(200, 220)], "speed_mps")))
    near = (one.t_s > 60) & (one.t_s < 80)
    near_both = (both.t_s > 60) & (both.t_s < 80)
    assert both.half_m[near_both].max() < 1.5 * one.half_m[near].max()
    assert both.guarantee == "credible"
    assert {row["silent"] for row in both.benchmark} == {(), ("speed",)}


def test_a_gap_bridged_by_the_mean_of_two_methods_has_no_jumps():
    made = drive(duration=300.0)
    track = sound(fill(_hole(made.log, [(100, 120)], "speed_mps", "yaw_rate_radps")))
    assert any("bridged by em and cv" in message for message in track.messages)
    east, north = Frame.of(made.log).to_local(track.lat_deg, track.lon_deg)
    assert np.hypot(np.diff(east), np.diff(north)).max() < 3.0  # 0.1 s apart


def test_the_mean_of_two_methods_is_weighted_by_hidden_fixes():
    grid = sampled(drive(duration=100.0).log)
    line = estimators.METHODS["linear"].run([grid], {})[0]
    hidden = grid.without(20, 30).without(60, 70)
    right = dataclasses.replace(line, east=grid.east, north=grid.north)
    near, far = (dataclasses.replace(right, east=grid.east + by) for by in (-1.0, 3.0))
    share = importlib.import_module("halfwidth.vehicle.choice")._share
    length, third = share([near], [far], [grid], [hidden])
    assert 10 <= length <= 10.5
    assert 0.25 <= third <= 0.35  # a guess beforehand counts for little where one is clearly better
    assert share([right], [far], [grid], [hidden])[1] <= 0.05
    assert share([near], [near], [grid], [hidden])[1] == 0.5
    assert share([dataclasses.replace(near, east=grid.east * NAN)], [far], [grid], [hidden])[1] in (0.0, 1.0)


def test_a_sensor_that_is_silent_for_a_part_of_a_gap_is_hidden_for_that_part():
    made = drive(duration=300.0)
    inside = (made.log.t >= 100) & (made.log.t <= 123)
    log = dataclasses.replace(made.log, speed_mps=np.where(inside, NAN, made.log.speed_mps))
    track = sound(fill(log.without(100, 130)))
    assert {row["part"] for row in track.benchmark} == {(0.0, 0.75)}
    assert any("without speed from 0 to 75 % of it" in message for message in track.messages)
    whole = sound(fill(_hole(made.log, [(100, 130)], "speed_mps")))
    assert {row["part"] for row in whole.benchmark} == {(0.0, 1.0)}
    means = [max(row["mean_m"] for row in one.benchmark) for one in (track, whole)]
    assert means[0] < means[1]


def test_where_the_sensors_speak_no_other_path_is_mixed_in():
    made = drive(duration=300.0)
    inside = (made.log.t >= 100) & (made.log.t <= 120)
    grid = sampled(dataclasses.replace(made.log, speed_mps=np.where(inside, NAN, made.log.speed_mps)))
    grid = grid.without(92, 128)
    own = dataclasses.replace(estimators.METHODS["linear"].run([grid], {})[0], variance=np.ones((len(grid), 2)))
    bent = dataclasses.replace(own, east=own.east + np.sin(grid.t), variance=4 * np.ones((len(grid), 2)))
    mixed = importlib.import_module("halfwidth.vehicle.choice")._bridged
    half = mixed(own, bent, grid, [(91.9, 128.1, 0.5)], True)
    apart = np.abs(half.east - own.east)
    speaks = (grid.t < 99.5) | (grid.t > 120.5)
    assert apart[~speaks].max() > 0.3
    assert apart[speaks].max() == 0.0
    np.testing.assert_array_equal(half.variance[speaks], own.variance[speaks])
    # where the sensors speak throughout, and what the vehicle did is not guessed, all of the gap is
    all_of_it = mixed(own, bent, grid, [(91.9, 128.1, 0.5)], False)
    assert np.abs(all_of_it.east - own.east)[(grid.t > 93) & (grid.t < 99)].max() > 0.3


def test_untested_half_widths_have_a_floor(data):
    log = real_log(data, "driveplotr")
    shares = []
    for n in (8, 10, 12):
        keep = np.flatnonzero(log.fixed)[np.linspace(0, log.fixed.sum() - 1, n).astype(int)]
        lost = ~np.isin(np.arange(len(log)), keep)
        thin = dataclasses.replace(
            log, lat_deg=np.where(lost, NAN, log.lat_deg), lon_deg=np.where(lost, NAN, log.lon_deg)
        )
        track = sound(fill(thin))
        assert track.guarantee == "none"
        assert any("widened 2 times" in message for message in track.messages)
        shares.append(_against_hidden(log, track, [(log.t[0], log.t[-1])])[2])
    assert np.mean(shares) > 0.8


@pytest.mark.parametrize("name", ["ep", "slp"])
def test_what_a_method_has_learnt_is_kept_when_fixes_are_hidden(monkeypatch, name):
    made = known(70.0, rate=2.0, noise=0.1, speed_noise=0.05, yaw_noise=0.003)
    log = made.log.without(30, 36)
    usual = estimators.METHODS[name]
    calls = []

    def run(drives, tuned):
        calls.append(len(drives))
        return usual.run(drives, tuned)

    monkeypatch.setattr(estimators, "METHODS", {**estimators.METHODS, name: dataclasses.replace(usual, run=run)})
    track = fill(log, method=name)
    assert calls == [1]  # the drive with all its fixes; hidden ones are filled with what that gave
    assert track.benchmark
    assert track.method == name
    assert max(one["mean_m"] for one in track.benchmark) < 1.0
    assert made.error(track.t_s, track.lat_deg, track.lon_deg).max() < 2.0


def _shown(name, sizes):
    return [widening.Tested(length, 8, size, size, 0.9, 1.0, by=name, half_m=1.0) for length, size in sizes]


def test_another_way_must_be_better_at_all_lengths_where_the_sensors_speak():
    nearest = importlib.import_module("halfwidth.vehicle.choice").nearest
    usual = _shown("em", [(5.0, 1.0), (20.0, 4.0), (60.0, 16.0)])
    lucky = _shown("em-white", [(5.0, 1.3), (20.0, 5.0), (60.0, 8.0)])
    better = _shown("em-white", [(5.0, 0.6), (20.0, 2.0), (60.0, 8.0)])
    assert nearest({"em": usual, "em-white": lucky}, "em", 60.0) == "em"
    assert nearest({"em": usual, "em-white": better}, "em", 60.0) == "em-white"
    assert nearest({"em": usual}, "em", 60.0) == "em"
    assert nearest({}, "em", 60.0) == "em"
