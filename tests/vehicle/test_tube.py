"""The tube of bounded noise: what it holds, where its centre is, and that nobody calls it a guarantee."""

import dataclasses

import numpy as np
import pytest
from tests.vehicle.known import known

from halfwidth.result import Status
from halfwidth.vehicle import bounded, fill, tube
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.tube import Tube


def a_drive(**change):
    return sampled(known(50.0, **({"rate": 5.0, "noise": 0.1, "speed_noise": 0.05, "yaw_noise": 0.003} | change)).log)


def half_of(path):
    """The half-width of the tube, without the error of a fix."""
    return 1.645 * np.sqrt(path.variance)


def test_the_tube_grows_into_the_gap_and_holds_the_vehicle():
    made = known(50.0, rate=5.0, noise=0.1, speed_noise=0.05, yaw_noise=0.003)
    drive = sampled(made.log)
    path = tube.solve([drive.without(20, 28)])[0]
    assert path.status.good
    gap = (drive.t > 20) & (drive.t < 28)
    off = np.column_stack((path.east - drive.east, path.north - drive.north))
    assert np.hypot(*off[gap].T).mean() < 1.0
    assert np.mean(np.abs(off[gap]) <= half_of(path)[gap]) > 0.9
    half = half_of(path).max(axis=1)
    assert half[gap].max() > 2 * np.median(half[~gap])
    assert 22 < drive.t[np.argmax(half)] < 26


def test_a_wider_inflation_is_a_wider_tube_about_as_good_a_centre():
    drive = a_drive().without(20, 26)
    low, high = (tube.solve([drive], Tube(inflation=k))[0] for k in (1.2, 3.0))
    gap = (drive.t > 20) & (drive.t < 26)
    assert (half_of(high)[gap] > half_of(low)[gap]).all()
    assert low.info["inflation"] == 1.2
    assert np.hypot(low.east - high.east, low.north - high.north).max() < half_of(low).max()


def test_the_inflation_is_the_least_that_holds_hidden_fixes():
    drive = a_drive(rate=2.0)
    assert tube.inflation_of(drive) in tube.INFLATIONS
    still = dataclasses.replace(drive, **{name: 0 * drive.t for name in ("east", "north", "speed", "yaw_rate")})
    assert tube.inflation_of(still) == Tube().inflation  # nothing can be tested where nothing moves
    assert tube.inflation_of(drive.rows(slice(0, 3))) == Tube().inflation


def test_a_wrong_fix_does_not_set_the_width_of_the_tube():
    drive = a_drive().without(30, 34)
    wrong = dataclasses.replace(drive, east=drive.east + np.where(np.arange(len(drive)) == 60, 300.0, 0.0))
    clean, found = tube.solve([drive, wrong])
    assert found.variance is not None
    assert half_of(found).max() < 3 * half_of(clean).max()
    assert found.info["left_out"] == ((drive.t[60], pytest.approx(300.0, abs=2.0)),)
    assert any("left out: t = 12.0 s by" in note for note in found.info["notes"])


@pytest.mark.parametrize(
    "change",
    [
        lambda d: dataclasses.replace(d, seen=np.isin(np.arange(len(d)), [10])),
        lambda d: d.rows(slice(0, 2)),
        lambda d: dataclasses.replace(d, has_speed=False, speed=np.zeros(len(d))),
        lambda d: dataclasses.replace(d, has_yaw_rate=False, yaw_rate=np.zeros(len(d))),
        lambda d: dataclasses.replace(d, east=1e6 * d.east + 1e9, north=1e6 * d.north),
    ],
    ids=["one fix", "two nodes", "no speed", "no yaw rate", "a million times"],
)
def test_numbers_or_a_status_come_out_of_anything(change):
    path = tube.solve([change(a_drive()).without(20, 22)])[0]
    assert path.finite or path.status is Status.STALLED


def test_where_no_tube_fits_the_bounded_chain_is_the_path(monkeypatch):
    drive = a_drive().without(20, 24)
    monkeypatch.setattr(tube, "_band", lambda *a: (None, 9.0))
    path = tube.solve([drive])[0]
    own = bounded.solve([drive], bounded.Bounded(slow=False, nu=0.1))[0]
    np.testing.assert_array_equal(path.east, own.east)
    assert path.variance is None
    assert any("no path fits" in note for note in path.info["notes"])


def test_fill_sizes_the_band_and_calls_it_no_guarantee():
    made = known(40.0, rate=2.0, noise=0.1, speed_noise=0.05, yaw_noise=0.003)
    track = fill(made.log.without(20, 24), method="tube")
    assert track.method == "tube"
    assert track.guarantee != "proven"
    assert track.proven is None
    assert any("not guaranteed" in message for message in track.messages)
    assert made.error(track.t_s, track.lat_deg, track.lon_deg).max() < 3.0


def test_a_tube_of_what_was_learnt_before_is_about_the_same():
    drive = a_drive()
    hidden = drive.without(20, 26)
    (whole,), (afresh,) = tube.solve([drive]), tube.solve([hidden])
    (again,) = tube.again([hidden], [whole])
    assert again.status.good
    assert again.info["half_widths"] == whole.info["half_widths"]
    gap = (drive.t > 20) & (drive.t < 26)
    apart = np.hypot(again.east - afresh.east, again.north - afresh.north)[gap]
    assert apart.max() < 0.5 * half_of(afresh)[gap].max()
    assert half_of(again)[gap].max() > 1.5 * half_of(whole)[gap].max()
    # without a tube nothing was learnt that could be kept
    failed = dataclasses.replace(whole, variance=None, info={})
    np.testing.assert_allclose(tube.again([hidden], [failed])[0].east, afresh.east)
