"""Fixes that are not what they claim: frozen, jumping, and the ones that are fine."""

import dataclasses

import numpy as np
import pytest

from halfwidth import vehicle
from halfwidth.vehicle.distrust import distrusted
from halfwidth.vehicle.drive import simulate_drive


def frozen(log, seed, n=20, length=3.0):
    """Insert `n` freezes, apart from each other; returns the log and which rows are frozen."""
    rng = np.random.default_rng(seed)
    rows = np.flatnonzero(log.fixed)
    t = log.t[rows]
    lat, lon = log.lat_deg.copy(), log.lon_deg.copy()
    bad = np.zeros(len(log), dtype=bool)
    while n:
        start = rng.uniform(t[0] + 5, t[-1] - length - 5)
        part = rows[(t > start) & (t <= start + length)]
        if bad[rows[(t > start - 1) & (t <= start + length + 1)]].any():
            continue
        held = rows[np.searchsorted(t, start, side="right") - 1]
        lat[part], lon[part], bad[part] = log.lat_deg[held], log.lon_deg[held], True
        n -= 1
    return dataclasses.replace(log, lat_deg=lat, lon_deg=lon), bad


def shares(log, bad):
    """Share of bad fixes that were found, and of good ones that were blamed."""
    flagged = np.zeros(len(log), dtype=bool)
    flagged[distrusted(log).rows] = True
    return flagged[bad].mean(), flagged[log.fixed & ~bad].mean()


def rms(track, truth, rows):
    """Error at rows of the log `truth`, m."""
    at = np.searchsorted(track.t_s, truth.t[rows])
    north = np.radians(track.lat_deg[at] - truth.lat_deg[rows]) * 6.37e6
    east = np.radians(track.lon_deg[at] - truth.lon_deg[rows]) * 6.37e6 * np.cos(np.radians(truth.lat_deg[rows]))
    return float(np.sqrt(np.mean(north**2 + east**2)))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_freezes_of_a_real_log(data, seed):
    log = vehicle.read(data / "smartloc_berlin_potsdamer_platz.csv.gz")
    bad_log, bad = frozen(log, seed)
    found, blamed = shares(bad_log, bad)
    assert found >= 0.95
    assert blamed <= 0.01
    removed = dataclasses.replace(
        log, lat_deg=np.where(bad, np.nan, log.lat_deg), lon_deg=np.where(bad, np.nan, log.lon_deg)
    )
    rows = np.flatnonzero(bad)
    track = vehicle.fill(bad_log)
    assert rms(track, log, rows) <= 1.2 * rms(vehicle.fill(removed), log, rows)
    assert any("repeat the fix before" in words for words in track.messages)
    believing = vehicle.fill(bad_log, distrust=False)
    assert rms(believing, log, rows) > 5 * rms(track, log, rows)


@pytest.mark.parametrize(
    "name", ["smartloc_berlin_potsdamer_platz", "balzer_dresden_2014_03_26", "driveplotr_nds_drive18"]
)
def test_real_logs_are_left_in_peace(data, name):
    log = vehicle.read(data / f"{name}.csv.gz")
    assert len(distrusted(log)) <= 0.005 * log.fixed.sum()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_freezes_of_a_simulated_drive(seed):
    _, log = simulate_drive(duration=600, seed=seed)
    bad_log, bad = frozen(log, seed)
    t_speed, speed = log.stream("speed_mps")
    found, blamed = shares(bad_log, bad & log.fixed & (np.interp(log.t, t_speed, speed) > 1.0))
    assert found >= 0.95
    assert blamed <= 0.01 + bad.mean()  # what stands still while frozen counts as good here


def test_jumps_of_a_simulated_drive():
    _, log = simulate_drive(duration=300, seed=3, tunnels=())
    rng = np.random.default_rng(0)
    rows = np.flatnonzero(log.fixed)
    jumped = rng.choice(rows[50:-50], 15, replace=False)
    lat = log.lat_deg.copy()
    lat[jumped] += rng.choice([-1, 1], 15) * rng.uniform(15, 60, 15) / 111_000
    bad_log = dataclasses.replace(log, lat_deg=lat)
    found = distrusted(bad_log)
    assert np.isin(jumped, found.of("jump")).mean() >= 0.95
    assert len(np.setdiff1d(found.rows, jumped)) <= 0.002 * rows.size
    item = vehicle.check(bad_log)["stray fixes"]  # as `fill` does: the sensors say it where there are any
    assert item.verdict == "warn"
    assert "cannot have been" in item.sentence
    item = vehicle.check(dataclasses.replace(bad_log, speed_mps=np.full(len(log), np.nan)))["trust"]
    assert item.verdict == "warn"
    assert "off the path" in item.sentence
    assert len(distrusted(log)) <= 0.002 * rows.size


def test_a_standing_car_may_repeat_itself():
    t = np.arange(0, 60, 0.5)
    here = vehicle.Log(t=t, lat_deg=np.full(t.size, 50.0), lon_deg=np.full(t.size, 14.0), speed_mps=np.zeros(t.size))
    assert len(distrusted(here)) == 0
    assert vehicle.check(here)["trust"].verdict == "ok"


def test_a_short_log_is_not_judged():
    few = vehicle.Log(t=[0, 1, 2], lat_deg=[50.0] * 3, lon_deg=[14.0] * 3)
    assert len(distrusted(few)) == 0
    assert vehicle.check(few)["trust"].verdict == "not checked"
