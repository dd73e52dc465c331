"""What `check` says of a good log, of each fault, and of what it cannot know."""

import json
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from tests.vehicle.drives import drive, save

import halfwidth as hw
from halfwidth.vehicle import Log, check, fill, simulate_drive
from halfwidth.vehicle.align import quantisation


def checked(tmp_path, **changes):
    columns = drive(every=2) | {"t_s": drive()["t_s"]}
    for name, change in changes.items():
        columns[name] = change(columns[name])
    return hw.vehicle.check(save(tmp_path / "log.csv", columns))


def test_a_good_log_is_good(tmp_path):
    found = checked(tmp_path)
    assert found.verdict == "ok"
    assert (found.rows, found.fixes) == (1200, 600)
    assert found["speed"].value == pytest.approx(1, abs=0.03)
    assert found["yaw rate"].value == pytest.approx(1, abs=0.1)
    assert found["azimuth"].value < 5
    assert found["standstill"].value == pytest.approx(10 / 120, abs=0.01)
    assert found["yaw bias"].value == pytest.approx(0, abs=0.002)


@pytest.mark.parametrize(
    ("changes", "item", "words", "line"),
    [
        ({"speed_mps": lambda v: v * 3.6}, "speed", "speed is in km/h", "--columns 'speed=speed_mps[km/h]'"),
        ({"speed_mps": lambda v: v / 0.44704}, "speed", "speed is in mph", "--columns 'speed=speed_mps[mph]'"),
        ({"speed_mps": lambda v: v / 0.514444}, "speed", "in knots", "--columns 'speed=speed_mps[kn]'"),
        ({"speed_mps": lambda v: v * 1.5}, "speed", "no known unit explains it", "--columns speed=COLUMN"),
        ({"t_s": lambda v: v * 1000}, "speed", "time is in milliseconds", "--columns 'time=t_s[ms]'"),
        ({"yaw_rate_radps": np.degrees}, "yaw rate", "it is in deg/s", "--columns 'yaw_rate=yaw_rate_radps[deg/s]'"),
        ({"yaw_rate_radps": lambda v: -v}, "yaw rate", "its sign", "--columns 'yaw_rate=-yaw_rate_radps[rad/s]'"),
        (
            {"yaw_rate_radps": lambda v: -np.degrees(v)},
            "yaw rate",
            "deg/s and its sign",
            "--columns 'yaw_rate=-yaw_rate_radps[deg/s]'",
        ),
        ({"azimuth_rad": np.degrees}, "azimuth", "in degrees clockwise", "--columns 'azimuth=azimuth_rad[deg]'"),
        (
            {"azimuth_rad": lambda v: -v},
            "azimuth",
            "radians counter-clockwise",
            "--columns 'azimuth=-azimuth_rad[rad]'",
        ),
        ({"azimuth_rad": lambda v: np.pi / 2 - v}, "azimuth", "counter-clockwise from east", "halfwidth fill"),
        ({"azimuth_rad": lambda v: v + 1.0}, "azimuth", "no known convention explains it", "--columns azimuth=COLUMN"),
    ],
)
def test_each_fault_is_named_with_what_to_type(changes, item, words, line, tmp_path):
    found = checked(tmp_path, **changes)
    assert found[item].verdict == "bad"
    assert words in found[item].sentence
    assert found[item].line[: len(line) or None] == line
    assert found.verdict == "bad"
    if line.startswith("--columns '"):
        # what is to be typed puts it right
        again = hw.vehicle.read(found.source, columns=line.split("'")[1], repair=False)
        assert hw.vehicle.check(again)[item].verdict == "ok"


def test_fixes_that_do_not_move_with_the_car_are_no_positions(tmp_path):
    columns = drive()
    wrong = columns | {name: np.radians(columns[name]) for name in ("lat_deg", "lon_deg")}
    item = hw.vehicle.check(save(tmp_path / "log.csv", wrong))["speed"]
    assert item.verdict == "bad"
    assert "in radians" in item.sentence
    read = hw.vehicle.read(tmp_path / "log.csv", columns=item.line.split("'")[1], repair=False)
    assert hw.vehicle.check(read)["speed"].verdict == "ok"
    rng = np.random.default_rng(1)
    parked = columns | {"lat_deg": 50 + 1e-6 * rng.random(1200), "lon_deg": 14 + 1e-6 * rng.random(1200)}
    item = hw.vehicle.check(save(tmp_path / "parked.csv", parked))["speed"]
    assert item.verdict == "bad"
    assert "columns of the position" in item.sentence
    standing = parked | {"speed_mps": np.zeros(1200)}
    assert hw.vehicle.check(save(tmp_path / "standing.csv", standing))["speed"].verdict == "not checked"


def test_a_logger_that_hangs_is_named_and_the_clocks_are_judged_without_it(tmp_path):
    columns = drive()
    t = columns["t_s"]
    clean = hw.vehicle.check(save(tmp_path / "clean.csv", columns))
    assert clean["stamps"].verdict == "ok"
    columns["t_s"] = t + np.where(t < 60.0, 0.0, np.clip(1.5 * (1 - (t - 60.0) / 8.0), 0.0, 1.5))
    found = hw.vehicle.check(save(tmp_path / "log.csv", columns))
    item = found["stamps"]
    assert item.verdict == "warn"
    assert item.value == pytest.approx(1.5, abs=0.1)
    assert item.line == f"halfwidth fill {tmp_path / 'log.csv'} -o track.gpx"
    assert found["clock of speed"].verdict == clean["clock of speed"].verdict == "ok"


def test_stamps_without_speed_or_rate_are_not_checked(tmp_path):
    found = checked(tmp_path, speed_mps=lambda v: v * np.nan)
    assert found["stamps"].verdict == "not checked"
    assert "no speed" in found["stamps"].sentence


def test_swapped_positions_are_bad_and_nothing_is_judged_on_them(tmp_path):
    columns = drive()
    columns["lat_deg"], columns["lon_deg"] = columns["lon_deg"], columns["lat_deg"]
    found = hw.vehicle.check(save(tmp_path / "log.csv", columns))
    assert found["latitude, longitude"].verdict == "bad"
    assert found["speed"].verdict == "not checked"
    again = hw.vehicle.read(found.source, columns=found["latitude, longitude"].line.split("'")[1], repair=False)
    assert hw.vehicle.check(again).verdict == "ok"


def test_outliers_are_counted_and_placed(tmp_path):
    found = checked(tmp_path, lat_deg=lambda v: v + 4e-4 * (np.arange(1200) == 700))
    assert found["outliers"].verdict == "warn"
    assert found["outliers"].value == 1
    assert "at 70.0 s" in found["outliers"].sentence
    assert found["outliers"].line.startswith("halfwidth fill")


def test_what_follows_a_freeze_is_no_outlier(tmp_path):
    columns = drive(fix_noise=0.05)
    held = (columns["t_s"] > 60) & (columns["t_s"] < 68)
    for name in ("lat_deg", "lon_deg"):
        columns[name][held] = columns[name][held][0]
    found = hw.vehicle.check(save(tmp_path / "log.csv", columns))
    assert "repeat the fix before" in found["trust"].sentence
    assert found["outliers"].verdict == "ok"


def test_missing_streams_and_pauses_are_said(tmp_path):
    found = checked(tmp_path, yaw_rate_radps=lambda v: v * np.nan, speed_mps=lambda v: np.where(abs(v - 9) < 0.2, v, v))
    assert found["streams"].verdict == "warn"
    assert "no yaw rate" in found["streams"].sentence
    assert found["yaw rate"].verdict == "not checked"
    quiet = drive()
    quiet["speed_mps"][300:400] = np.nan
    pause = hw.vehicle.check(save(tmp_path / "pause.csv", quiet))["pauses"]
    assert pause.verdict == "warn"
    assert pause.value == pytest.approx(10.1)


def test_coarse_steps_are_measured(tmp_path):
    found = checked(tmp_path, speed_mps=lambda v: np.round(v * 3.6) / 3.6, yaw_rate_radps=lambda v: np.round(v, 2))
    assert found["step of speed_mps"].value == pytest.approx(1 / 3.6, rel=1e-3)
    assert found["step of speed_mps"].verdict == "warn"
    assert found["step of yaw_rate_radps"].value == pytest.approx(0.01)


@pytest.mark.parametrize(("step", "digits"), [(1 / 3.6, 4), (0.25, 8), (5 / 3.6, 2), (1e-6, 9), (0.01, 6)])
def test_quantisation_is_found_behind_rounding(step, digits):
    values = np.round(np.round(np.random.default_rng(1).uniform(0, 60 * step, 3000) / step) * step, digits)
    assert quantisation(values) == pytest.approx(step, rel=0.02)


def test_continuous_values_have_no_step():
    assert quantisation(np.random.default_rng(1).normal(size=3000)) is None
    assert quantisation(np.array([1.0, 1.0])) is None


def test_what_a_log_cannot_tell_is_not_checked(tmp_path):
    still = {"t_s": np.arange(300.0), "lat_deg": np.full(300, 50.0), "lon_deg": np.full(300, 14.0)}
    found = hw.vehicle.check(save(tmp_path / "log.csv", still))
    for name in ("speed", "azimuth", "yaw rate", "speed scale", "yaw bias", "clock of speed", "standstill"):
        assert found[name].verdict == "not checked"


def test_plain_data_and_text(tmp_path):
    found = checked(tmp_path, speed_mps=lambda v: v * 3.6)
    data = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert data["schema_version"] == 1
    assert {item["verdict"] for item in data["items"]} <= {"ok", "warn", "bad", "not checked"}
    lines = found.summary().splitlines()
    assert lines[0] == f"{found.source}: bad"
    assert lines[3].startswith("bad         speed")
    assert (
        repr(found) == f"Check({found.source!r}: bad, 1 bad, 0 warn, {sum(i.verdict == 'ok' for i in found.items)} ok)"
    )
    with pytest.raises(KeyError):
        found["nothing"]


def test_a_log_and_a_table_are_taken_too(tmp_path):
    log = hw.vehicle.read(save(tmp_path / "log.csv", drive()))
    assert hw.vehicle.check(log)["speed"] == hw.vehicle.check(log.frame("polars"))["speed"]


@pytest.mark.parametrize(
    ("name", "verdict"),
    [
        ("balzer_dresden_2014_03_26", "warn"),  # its logger hangs
        ("driveplotr_nds_drive18", "warn"),
        ("smartloc_berlin_potsdamer_platz", "ok"),
    ],
)
def test_real_logs(name, verdict, data):
    found = hw.vehicle.check(data / f"{name}.csv.gz")
    assert found.verdict == verdict
    assert found["speed"].value == pytest.approx(1, abs=0.03)
    assert found["yaw rate"].value == pytest.approx(1, abs=0.06)
    assert found["outliers"].value == 0
    assert found["stamps"].verdict == ("warn" if name.startswith("balzer") else "ok")
    if name.startswith("driveplotr"):
        assert found["pauses"].value == 45.0
        assert found["step of lon_deg"].value == pytest.approx(2.0**-17, rel=1e-3)  # a float of 32 bits


def test_streams_that_are_not_there_are_not_checked(tmp_path):
    columns = {name: values for name, values in drive().items() if name in ("t_s", "lat_deg", "lon_deg")}
    found = hw.vehicle.check(save(tmp_path / "log.csv", columns))
    for name in ("pauses", "spikes", "sensor clock", "lapses", "speed"):
        assert found[name].verdict == "not checked"
        assert "there is no speed" in found[name].sentence


def test_what_fill_found_is_not_looked_for_again(tmp_path, monkeypatch):
    _, log = simulate_drive(duration=200.0, seed=4, tunnels=(20.0,), speed_delay=0.3)
    speed, lat = log.speed_mps.copy(), log.lat_deg.copy()
    speed[600:603] = 90.0
    fixes = np.flatnonzero(log.fixed)
    after = fixes[np.argmax(np.diff(log.t[fixes])) + 1]
    lat[after : after + 4] += 5e-4  # wrong first fixes after the tunnel
    log = replace(log, speed_mps=speed, lat_deg=lat)
    track, alone = fill(log), check(log)
    assert alone["lapses"].verdict == "bad"
    assert alone["stray fixes"].verdict == "warn"
    module = import_module("halfwidth.vehicle.check")
    for step in ("sensed", "judged"):
        monkeypatch.setattr(module, step, None)
    assert check(track.log, track.found).to_dict() == alone.to_dict()
    assert "the speed says 90" in track.report(tmp_path / "page.html").read_text()


def test_what_fill_was_told_is_no_finding():
    _, log = simulate_drive(duration=100.0, seed=4, tunnels=(20.0,))
    assert fill(log, clock_offset=0.0).found is None
    assert fill(log, distrust=False).found is None


def test_a_log_without_a_fix_is_judged_by_what_its_sensors_say():
    nothing = [float("nan")] * 20
    found = check(Log(t=range(20), lat_deg=nothing, lon_deg=nothing, speed_mps=[1.0] * 20, yaw_rate_radps=[0.1] * 20))
    assert found["streams"].verdict == "bad"
    assert found["standstill"].verdict == "ok"
    assert found["stray fixes"].verdict == "not checked"
