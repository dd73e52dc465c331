import dataclasses
import functools

import numpy as np
import pytest
from tests.vehicle.known import known, real_log

from halfwidth.errors import BadValue
from halfwidth.vehicle.estimators import METHODS, heading_of, method, usable
from halfwidth.vehicle.grid import sampled


@pytest.fixture(scope="module")
def drive():
    return sampled(known(140.0, noise=0.1, speed_noise=0.05, yaw_noise=0.003, rate=5.0).log)


@functools.lru_cache(maxsize=64)
def tuned(name, drive):
    return method(name).tune(drive)


def filled(name, drive, t0, t1):
    m = method(name)
    hidden = drive.between(t0 - m.context, t1 + m.context).without(t0, t1)
    whole = drive.between(t0 - m.context, t1 + m.context)
    path = m.run([hidden], tuned(name, drive))[0]
    out = whole.seen & ~hidden.seen
    return path, np.hypot(path.east - whole.east, path.north - whole.north)[out], out


@pytest.mark.parametrize("name", list(METHODS))
def test_every_method_fills_a_gap_and_keeps_near_the_fixes(name, drive):
    path, off, out = filled(name, drive, 60.0, 70.0)
    assert usable(path)
    limit = {"linear": 15.0, "cv": 8.0}.get(name, 1.5)
    assert off.max() < limit
    hidden = drive.between(path.t[0], path.t[-1])
    near = np.hypot(path.east - hidden.east, path.north - hidden.north)[~out]
    assert np.median(near) < 0.35
    assert path.east.shape == path.azimuth.shape == path.speed.shape == path.t.shape
    if path.variance is not None:
        assert (path.variance >= 0).all()
        assert path.variance[out].max() > path.variance[~out].mean()


@pytest.mark.parametrize("name", [n for n in METHODS if n not in ("linear", "cv")])
def test_methods_with_sensors_beat_the_straight_line(name, drive):
    line = filled("linear", drive, 30.0, 50.0)[1].mean()
    assert filled(name, drive, 30.0, 50.0)[1].mean() < 0.1 * line


def test_the_straight_line_is_exact_on_a_straight_line():
    t = np.arange(0, 30, 0.2)
    still = sampled(known(30.0, rate=5.0).log)
    straight = dataclasses.replace(still, east=2.0 * still.t, north=-3.0 * still.t)
    path, off, _ = filled("linear", straight, 10.0, 15.0)
    assert off.max() < 1e-9
    assert np.degrees(heading_of(path)).round(3).tolist() == pytest.approx(
        [np.degrees(np.arctan2(2, -3)).round(3)] * len(path.t)
    )
    assert t.size == 150


def test_a_tuned_model_knows_its_noise(drive):
    assert tuned("cv", drive)["fix"] == pytest.approx(0.1, rel=0.3)
    assert 0.3 < tuned("cv", drive)["acceleration"] < 10


def test_intervals_hold_most_hidden_fixes(drive):
    for name in ("linear", "cv", "gpsins", "em"):
        inside = []
        for t0 in (25.0, 45.0, 65.0, 85.0):
            m = method(name)
            hidden = drive.between(t0 - m.context, t0 + 5 + m.context).without(t0, t0 + 5)
            whole = drive.between(t0 - m.context, t0 + 5 + m.context)
            path = m.run([hidden], tuned(name, drive))[0]
            out = whole.seen & ~hidden.seen
            error = np.column_stack((path.east - whole.east, path.north - whole.north))[out]
            inside.append(np.mean(np.abs(error) <= 1.645 * np.sqrt(path.variance[out] + path.fix_variance)))
        assert np.mean(inside) > 0.6, name


def test_unknown_names_and_lacking_sensors():
    with pytest.raises(BadValue, match="one of linear"):
        method("kalmann")
    bare = sampled(
        dataclasses.replace(known(20.0).log, speed_mps=np.full(201, np.nan), yaw_rate_radps=np.full(201, np.nan))
    )
    assert method("em").lacks(bare) == "speed or yaw rate"
    assert method("gpsins").lacks(bare) == "speed"
    assert method("cv").lacks(bare) is None


@pytest.mark.parametrize(("log", "most"), [("smartloc", 1.2), ("balzer", 8.0)])
def test_papers_and_chain_on_real_logs(data, log, most):
    """Bounds far above the measured means at 30 s (0.5 to 0.9 m, and 4 to 6 m): a broken method is 10 times worse."""
    drive = sampled(real_log(data, log))
    for name in ("em", "paper000+ls", "paper002", "gpsins", "ctrv"):
        off = np.concatenate([filled(name, drive, t0, t0 + 30.0)[1] for t0 in (110.0, 150.0)])
        assert off.mean() < 1.5 * most, name
