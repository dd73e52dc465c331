"""Faults that logs have: each is found and named, or survived, and the gaps are filled as well as without it.

A drive with known truth and two tunnels is spoiled in one way at a time; `fill` gets it as it is.
"""

from dataclasses import replace

import numpy as np
import pytest

from halfwidth.vehicle import check, fill, simulate_drive
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.check_sensors import items
from halfwidth.vehicle.formats import from_frame, read
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.judged import judged
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.stray import strays

GAPS = ((100.0, 125.0), (220.0, 235.0))
DRIVE = {"duration": 330.0, "outages": GAPS, "fix_noise": 0.1, "fix_offset": 0.1}


@pytest.fixture(scope="module")
def drive():
    return simulate_drive(seed=4, **DRIVE)


@pytest.fixture(scope="module")
def clean(drive):
    truth, log = drive
    return in_gaps(truth, fill(log))


def in_gaps(truth, track, spans=GAPS, late=0.0):
    """Return the largest distance to the truth in the gaps, m."""
    worst = 0.0
    for first, last in spans:
        inside = (track.t_s >= first) & (track.t_s <= last)
        assert inside.any()
        off = truth.error_m(track.t_s[inside] - late, track.lat_deg[inside], track.lon_deg[inside])
        worst = max(worst, float(np.hypot(*off).max()))
    return worst


def shifted(log, rows, east):
    lon = log.lon_deg.copy()
    lon[rows] += east / (111_320 * np.cos(np.radians(50.09)))
    return replace(log, lon_deg=lon)


def after(log, t, seconds):
    return np.flatnonzero(log.fixed & (log.t > t) & (log.t <= t + seconds))


def said(track, words):
    return any(words in message for message in track.messages)


def test_without_a_fault_nothing_is_left_out(drive, clean):
    _, log = drive
    assert clean < 1.5
    known = calibrated(log)
    assert strays(sampled(log, sensors=known), known).at.size == 0


def test_a_frozen_receiver_is_named_and_bridged(drive, clean):
    truth, log = drive
    rows = after(log, 160, 8)
    lat, lon = log.lat_deg.copy(), log.lon_deg.copy()
    lat[rows], lon[rows] = lat[rows[0]], lon[rows[0]]
    track = fill(replace(log, lat_deg=lat, lon_deg=lon))
    assert said(track, "repeat the fix before while the car moved")
    assert in_gaps(truth, track, ((160.5, 167.5), *GAPS)) < 2 * clean + 0.5


@pytest.mark.parametrize(("seconds", "east"), [(0.1, 40.0), (4.0, 15.0)])
def test_a_jump_is_named_and_left_out(drive, clean, seconds, east):
    truth, log = drive
    track = fill(shifted(log, after(log, 170, seconds), east))
    assert said(track, "where the vehicle cannot have been") or said(track, "far from where")
    assert in_gaps(truth, track) < 2 * clean + 0.5


@pytest.mark.parametrize(("seconds", "east"), [(0.1, 10.0), (0.1, 100.0), (3.0, 20.0)])
def test_wrong_first_fixes_after_a_gap_do_not_bend_it(drive, clean, seconds, east):
    truth, log = drive
    wrong = shifted(log, np.concatenate([after(log, last, seconds) for _, last in GAPS]), east)
    track = fill(wrong)
    assert said(track, "where the vehicle cannot have been")
    assert in_gaps(truth, track) < 2 * clean + 0.5
    then = judged(wrong)
    grid = sampled(then.log, sensors=then.sensors)
    found = strays(grid, then.sensors)
    times = grid.t[found.at]
    for _, last in GAPS:
        near = (times > last) & (times < last + seconds + 1)
        assert near.any()
        assert found.size[near].max() == pytest.approx(east, rel=0.2)  # named with its size
    (item,) = (one for one in items(then) if one.name == "stray fixes")
    assert item.verdict == "warn"
    assert item.evidence["off_m"]


def test_multipath_that_fades_does_not_bend_a_gap(clean):
    truth, log = simulate_drive(seed=4, multipath=30.0, multipath_time=2.0, **DRIVE)
    track = fill(log)
    assert said(track, "where the vehicle cannot have been")
    assert in_gaps(truth, track) < 2 * clean + 1
    assert in_gaps(truth, fill(log, distrust=False)) > 15


def test_a_jump_does_not_hide_multipath_that_fades(clean):
    truth, log = simulate_drive(seed=4, multipath=30.0, multipath_time=3.0, **DRIVE)
    track = fill(shifted(log, after(log, 170, 2.5), 200.0))
    assert in_gaps(truth, track) < 2 * clean + 1


def test_a_clock_of_the_sensors_that_steps_is_named_and_followed(drive, clean):
    truth, log = drive
    late = {
        name: np.where(log.t > 170, np.interp(log.t - 0.6, log.t, getattr(log, name)), getattr(log, name))
        for name in ("speed_mps", "yaw_rate_radps")
    }
    wrong = replace(log, **late)
    track = fill(wrong)
    assert said(track, " s, then -0.")
    assert in_gaps(truth, track) < 2 * clean + 0.5
    for name in ("clock of speed", "clock of yaw rate"):
        item = check(wrong)[name]
        assert item.verdict == "warn"
        assert "steps at about" in item.sentence


def test_a_clock_that_jumps_for_all_streams_is_found(drive, clean):
    truth, log = drive
    moved = replace(log, t=np.where(log.t > 170, log.t + 2.0, log.t))
    track = fill(moved)
    assert said(track, "the clock leaps by 2.0")
    found = check(moved)
    assert found["stamps"].value == pytest.approx(2.0, abs=0.1)
    assert found["pauses"].verdict == "ok"
    assert in_gaps(truth, track, GAPS[:1]) < 2 * clean + 0.5
    assert in_gaps(truth, track, ((222.0, 237.0),), late=2.0) < 2 * clean + 0.5


def test_fixes_that_come_late_are_put_in_time(clean):
    truth, log = simulate_drive(seed=4, clock_offset=0.3, **DRIVE)
    track = fill(log)
    assert said(track, "clocks against the fixes: speed +0.3")
    assert in_gaps(truth, track, late=0.3) < 2 * clean + 0.5


@pytest.mark.parametrize(
    ("field", "factor", "words"),
    [
        ("yaw_rate_radps", -1.0, "positive to the right"),
        ("yaw_rate_radps", 180 / np.pi, "in deg/s"),
        ("speed_mps", 3.6, "speed is in km/h"),
    ],
)
def test_a_wrong_sign_or_unit_is_named_and_put_right(drive, clean, field, factor, words):
    truth, log = drive
    wrong = replace(log, **{field: factor * getattr(log, field)})
    track = fill(wrong)
    assert said(track, words)
    assert in_gaps(truth, track) < 2 * clean + 0.5
    item = check(wrong)["speed" if field == "speed_mps" else "yaw rate"]
    assert item.verdict == "bad"
    assert item.line


def test_an_azimuth_that_points_elsewhere_is_named_and_turned(drive, clean):
    truth, log = drive
    track = fill(replace(log, azimuth_rad=(log.azimuth_rad + np.pi) % (2 * np.pi)))
    assert said(track, "clockwise from south")
    assert in_gaps(truth, track) < 1.2 * clean + 0.1
    aside = calibrated(replace(log, azimuth_rad=(log.azimuth_rad + np.pi / 2) % (2 * np.pi)))
    assert "the azimuth points +90 degrees off" in aside.messages[-1]
    assert aside.course_error == pytest.approx(np.pi / 2, abs=0.02)


def test_fixes_that_no_car_could_reach_are_named_with_time_and_size(drive):
    _, log = drive
    away = (log.t >= 150) & (log.t < 190)
    there = from_frame(shifted(log, away, 1000.0).frame())
    assert any(
        "400 fixes dropped that no car could reach, at 150.0 to 189.9 s by up to 10" in one for one in there.notes
    )
    frozen_there = from_frame(frozen(log, 160, 168).frame())
    assert any("frozen while the car moved, at 16" in note for note in frozen_there.notes)
    # a base that is set anew in the last fifth is not put right, but named in the same way
    item = check(from_frame(shifted(log, log.t > 70, 1000.0).frame().iloc[:900]))["outliers"]
    assert item.verdict == "bad"
    assert "70.1 to 89.9 s by up to 10" in item.sentence


def test_few_fixes_are_counted_as_the_log_has_them():
    log = Log(t=[0.0, 0.1, 5.0, 5.1, 10.0], lat_deg=[50.0, 50.0, 50.0, 50.0, np.nan], lon_deg=[14, 14, 14, 14, np.nan])
    assert said(fill(log), "the log has only 4 fixes, 2 of them of use")


def test_without_a_speed_a_gap_is_still_bridged(drive):
    truth, log = drive
    track = fill(replace(log, speed_mps=np.full(len(log), np.nan)))
    assert said(track, "no speed")
    assert np.isfinite(track.lat_deg).all()
    assert in_gaps(truth, track) < 120  # no further than the car could go


def test_everything_at_one_hertz(data):
    log = read(data / "driveplotr_nds_drive18.csv.gz")
    hidden = log.without(500, 530)
    track = fill(hidden)
    inside = (track.t_s > 500) & (track.t_s < 530)
    real = np.isin(log.t, track.t_s[inside])
    north = (track.lat_deg[inside] - log.lat_deg[real]) * 111_000
    east = (track.lon_deg[inside] - log.lon_deg[real]) * 111_320 * np.cos(np.radians(41.26))
    assert np.hypot(east, north).max() < 10
    assert said(track, "clocks against the fixes: speed -0.")


def frozen(log, first, last):
    """The log with a receiver that repeats itself."""
    rows = np.flatnonzero(log.fixed & (log.t >= first) & (log.t <= last))
    lat, lon = log.lat_deg.copy(), log.lon_deg.copy()
    lat[rows], lon[rows] = lat[rows[0]], lon[rows[0]]
    return replace(log, lat_deg=lat, lon_deg=lon)


def at_one_hertz(log):
    """The log with one row in ten."""
    names = ("t", "lat_deg", "lon_deg", "alt_m", "azimuth_rad", "speed_mps", "yaw_rate_radps")
    return Log(**{name: getattr(log, name)[::10] for name in names}, source=log.source)


def first_fixes_wrong(log):
    return shifted(log, np.concatenate([after(log, last, 1.0) for _, last in GAPS]), 60.0)


FAULTS = {
    "sign": (lambda log: replace(log, yaw_rate_radps=-log.yaw_rate_radps), "positive to the right"),
    "degrees": (lambda log: replace(log, yaw_rate_radps=np.degrees(log.yaw_rate_radps)), "in deg/s"),
    "km/h": (lambda log: replace(log, speed_mps=3.6 * log.speed_mps), "speed is in km/h"),
    "freeze": (lambda log: frozen(log, 160, 168), "repeat the fix before"),
    "first fixes": (first_fixes_wrong, "where the vehicle cannot have been"),
    "clock step": (lambda log: replace(log, t=np.where(log.t > 270, log.t + 2.0, log.t)), "2.1 s in all"),
}


@pytest.mark.parametrize(
    "both",
    [
        ("sign", "km/h"),
        ("degrees", "km/h"),
        ("sign", "first fixes"),
        ("km/h", "freeze"),
        ("sign", "km/h", "first fixes", "clock step"),
    ],
    ids=" and ".join,
)
def test_faults_together_are_each_named_and_put_right(drive, clean, both):
    truth, log = drive
    for name in both:
        log = FAULTS[name][0](log)
    track = fill(log)
    for name in both:
        assert said(track, FAULTS[name][1]), name
    assert in_gaps(truth, track) < 2 * clean + 0.5


@pytest.mark.parametrize("fault", ["sign", "km/h", "degrees", "first fixes"])
def test_faults_at_one_hertz(drive, clean, fault):
    truth, log = drive
    track = fill(at_one_hertz(FAULTS[fault][0](log)))
    assert in_gaps(truth, track) < 2 * clean + 1.0
    assert fault == "first fixes" or said(track, FAULTS[fault][1])


def hung(log):
    """The log with a logger that hangs before the first gap, and works off what waits."""
    late = np.where(log.t < 90.0, 0.0, np.clip(1.2 * (1 - (log.t - 90.0) / 12.0), 0.0, 1.2))
    return replace(log, t=log.t + late)


@pytest.mark.parametrize("both", [("degrees", "freeze"), ("km/h", "first fixes")], ids=" and ".join)
def test_a_logger_that_hangs_and_other_faults_are_survived_together(drive, clean, both):
    truth, log = drive
    wrong = log
    for name in both:
        wrong = FAULTS[name][0](wrong)
    track = fill(hung(wrong))
    assert said(track, "s late")
    for name in both:
        assert said(track, FAULTS[name][1]), name
    when = np.interp(track.t_s, hung(log).t, log.t)
    inside = np.zeros(when.size, dtype=bool)
    for first, last in GAPS:
        inside |= (when >= first) & (when <= last)
    off = truth.error_m(when[inside], track.lat_deg[inside], track.lon_deg[inside])
    assert float(np.hypot(*off).max()) < 2 * clean + 1.0


@pytest.mark.parametrize("seed", [3, 8])
def test_a_speed_that_is_stuck_below_a_cars_reach_is_named(seed):
    _, log = simulate_drive(seed=seed, **DRIVE)
    rows = np.flatnonzero((log.t > 101.0) & (log.t < 112.0))
    stuck = log.speed_mps.copy()
    # as fast as one second after the end, and 1.8 m/s more: a car of 12 m/s2 could do that in two samples
    stuck[rows] = stuck[rows[-1] + 1] + 1.8
    track = fill(replace(log, speed_mps=stuck))
    assert said(track, "the speed is stuck and then leaps")


def test_without_a_speed_a_jump_is_still_found(drive):
    truth, log = drive
    bare = replace(log, speed_mps=np.full(len(log), np.nan))
    track = fill(shifted(bare, after(log, 170, 1.0), 60.0))
    assert said(track, "lie off the path of the others")
    assert in_gaps(truth, track, ((171.5, 175.0),)) < 3


def test_spikes_of_the_sensors_are_left_out(drive, clean):
    truth, log = drive
    speed, yaw = log.speed_mps.copy(), log.yaw_rate_radps.copy()
    speed[[1050, 1120, 1700]], yaw[[1080, 2250]] = 110.0, (-9.0, 12.0)
    wrong = replace(log, speed_mps=speed, yaw_rate_radps=yaw)
    track = fill(wrong)
    assert said(track, "3 samples of the speed that no car can have had")
    assert said(track, "2 samples of the yaw rate that no car can have had")
    assert in_gaps(truth, track) < 1.2 * clean + 0.2
    assert in_gaps(truth, fill(wrong, distrust=False)) > 3 * clean


def test_a_speed_that_is_stuck_in_a_gap_is_taken_for_none(drive):
    truth, log = drive
    at = int(np.argmax(np.abs(truth.speed_mps[1020:1150] - truth.speed_mps[1200])))
    rows = np.arange(1020 + at, 1200)
    stuck = log.speed_mps.copy()
    stuck[rows] = stuck[rows[0]] + 9.0
    track = fill(replace(log, speed_mps=stuck))
    assert said(track, "the speed is stuck and then leaps")
    inside = (track.t_s >= GAPS[0][0]) & (track.t_s <= GAPS[0][1])
    off = np.abs(np.column_stack(truth.error_m(track.t_s[inside], track.lat_deg[inside], track.lon_deg[inside])))
    assert np.mean(off <= track.truth_half_m[inside]) > 0.7


@pytest.mark.parametrize("seed", [22, 23])
def test_multipath_that_fades_on_consumer_fixes_does_not_bend_a_gap(seed):
    truth, log = simulate_drive(
        duration=330.0, outages=GAPS, fix_noise=0.5, fix_offset=1.0, seed=seed, multipath=15.0, multipath_time=3.0
    )
    assert in_gaps(truth, fill(log)) < 3  # 1.6 to 1.9 m without it, 12 to 13 m where it is believed


def test_on_the_command_line_each_fault_is_named_with_the_line_to_type(drive, tmp_path, capsys):
    from halfwidth.shells import cli

    _, log = drive
    for name in ("sign", "km/h", "freeze", "first fixes"):
        log = FAULTS[name][0](log)
    frame = log.frame()
    speed = frame["speed_mps"].to_numpy().copy()
    speed[600] = 500.0
    frame["speed_mps"] = speed
    path = tmp_path / "drive.csv"
    frame.to_csv(path, index=False)
    assert cli.run(["check", str(path)]) == 0
    out = capsys.readouterr().out
    assert "speed is in km/h" in out
    assert "--columns 'speed=speed_mps[km/h]'" in out
    assert "its sign is that of a turn to the right" in out
    assert "--columns 'yaw_rate=-yaw_rate_radps[rad/s]'" in out
    assert "repeat the fix before while the car moved" in out
    assert "1 sample of the speed that no car can have had" in out
    assert f"halfwidth fill {path} -o track.gpx" in out
    lines = "speed=speed_mps[km/h],yaw_rate=-yaw_rate_radps[rad/s]"
    assert cli.run(["fill", str(path), "-o", str(tmp_path / "track.csv"), "--columns", lines]) == 0
    said_there = "".join(capsys.readouterr())
    assert "where the vehicle cannot have been" in said_there
    assert "receiver would have seen the vehicle" in said_there


@pytest.mark.parametrize(("begin", "length"), [(96.7, 30.0), (135.4, 5.0), (165.7, 10.0)])
def test_a_jump_of_the_slow_error_beside_a_gap_is_no_fault(data, begin, length):
    # the reference of this log jumps by 1 to 2 m some seconds after the gap, or before it
    log = read(next(data.glob("smartloc*.csv.gz"))).without(begin, begin + length)
    known = calibrated(log)
    assert strays(sampled(log, sensors=known), known).at.size == 0


@pytest.mark.parametrize(("begin", "seconds", "factor"), [(30.0, 6.0, 0.4), (50.0, 4.0, 0.3), (170.0, 8.0, 0.6)])
def test_fixes_are_believed_where_the_speed_is_wrong(drive, begin, seconds, factor):
    _, log = drive
    inside = (log.t > begin) & (log.t <= begin + seconds)
    spoiled = replace(log, speed_mps=np.where(inside, factor * log.speed_mps, log.speed_mps))
    sensors = calibrated(spoiled)
    assert strays(sampled(spoiled, sensors=sensors), sensors).at.size == 0
    # a fix that is as far off as the speed is wrong shows nevertheless
    rows = after(log, begin + 40.0, 2.0)
    both = shifted(spoiled, rows, 40.0)
    grid = sampled(both, sensors=sensors)
    found = grid.t[strays(grid, sensors).at]
    there = grid.t[grid.seen & (grid.t > begin + 40.0) & (grid.t <= begin + 42.0)]
    assert np.isin(there, found).mean() >= 0.9
    assert np.all((found > begin + 39.7) & (found < begin + 42.3))
