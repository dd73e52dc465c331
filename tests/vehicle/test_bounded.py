import dataclasses

import numpy as np
import pytest
from tests.vehicle.known import known

from halfwidth.result import Status
from halfwidth.vehicle import bounded
from halfwidth.vehicle.grid import sampled


def a_drive(**change):
    return sampled(known(50.0, **({"rate": 5.0, "noise": 0.1, "speed_noise": 0.05, "yaw_noise": 0.003} | change)).log)


@pytest.mark.parametrize("slow", [True, False])
def test_it_fills_a_gap_and_names_its_half_widths(slow):
    drive = a_drive(scale=1.02, bias=0.005)
    hidden = (drive.t >= 20) & (drive.t <= 28)
    path = bounded.solve([drive.without(20, 28)], bounded.Bounded(slow=slow))[0]
    assert path.status is Status.OK
    assert path.variance is None
    off = np.hypot(path.east - drive.east, path.north - drive.north)
    line = [np.interp(drive.t, drive.t[~hidden], p[~hidden]) for p in (drive.east, drive.north)]
    assert off[hidden].mean() < 0.2 * np.hypot(line[0] - drive.east, line[1] - drive.north)[hidden].mean()
    assert path.info["half_widths"].keys() >= {"along", "across", "azimuth", "fix"}
    assert ("offset_east" in path.info["half_widths"]) == slow
    assert path.info["speed_scale"] == pytest.approx(1.02, abs=0.02)


def test_every_residual_lies_within_its_half_width():
    drive = a_drive().without(20, 24)
    path = bounded.solve([drive], bounded.Bounded(slow=False))[0]
    half = path.info["half_widths"]["fix"]
    seen = drive.seen
    assert np.abs(path.east - drive.east)[seen].max() <= half * (1 + 1e-3)
    assert np.abs(path.north - drive.north)[seen].max() <= half * (1 + 1e-3)


def test_perfect_data_sit_on_the_floors():
    drive = a_drive(noise=0.0, speed_noise=0.0, yaw_noise=0.0)
    path = bounded.solve([drive.without(20, 25)], bounded.Bounded(slow=False, objective="log"))[0]
    assert path.finite
    assert np.hypot(path.east - drive.east, path.north - drive.north).max() < 0.3


def test_quantisation_of_the_log_raises_the_floors():
    drive = a_drive()
    step = float(np.median(drive.h))
    counts = {"speed_mps": 0.2, "yaw_rate_radps": 0.01, "lat_deg": 1e-6}
    for steps, along, azimuth, north in (({}, 0.02, 0.001, 0.005), (counts, 0.1, 0.005, 0.5e-6 * 111_200)):
        coarse = dataclasses.replace(drive, steps=steps)
        model, *_ = bounded.linearised(coarse, np.zeros(len(drive)), bounded.Bounded())
        assert model.w.at_least[[bounded.ALONG, bounded.AZIMUTH]] == pytest.approx([along * step, azimuth * step])
        assert model.e.at_least == pytest.approx([0.005, north], rel=0.01)
        assert model.w.at_least[bounded.OFFSET_E] == 0.005  # an offset is not rounded


def test_two_fixes_are_enough_and_a_drive_without_speed_too():
    drive = a_drive()
    few = dataclasses.replace(drive, seen=np.isin(np.arange(len(drive)), [10, 120]))
    blind = dataclasses.replace(drive, has_speed=False, speed=np.zeros(len(drive)))
    for path in bounded.solve([few, blind.without(20, 22)]):
        assert path.finite or path.status is Status.STALLED


def wrong_fix(drive, at, by):
    return dataclasses.replace(drive, east=drive.east + np.where(np.arange(len(drive)) == at, by, 0.0))


def test_a_wrong_fix_is_named_left_out_and_bends_nothing_where_the_worst_rows_share():
    drive = a_drive()
    wrong = wrong_fix(drive, 60, 12.0).without(20, 24)
    plain, elastic = (bounded.solve([wrong], bounded.Bounded(slow=False, nu=nu))[0] for nu in (None, 0.1))
    hidden = (drive.t >= 20) & (drive.t <= 24)
    off = [np.hypot(p.east - drive.east, p.north - drive.north)[hidden].mean() for p in (plain, elastic)]
    assert off[1] < 0.5
    assert off[1] < 0.5 * off[0]
    (t, by), = elastic.info["left_out"]  # fmt: skip
    assert (t, by) == (drive.t[60], pytest.approx(12.0, abs=1.0))
    assert "t = 12.0 s by 12" in elastic.info["notes"][0] or "t = 12.0 s by 11" in elastic.info["notes"][0]


def test_a_fix_beyond_all_caps_is_found_without_being_asked():
    path = bounded.solve([wrong_fix(a_drive(), 60, 2000.0)], bounded.Bounded(slow=False))[0]
    assert path.status.good
    assert [t for t, _ in path.info["left_out"]] == [12.0]


def test_clean_fixes_all_stay():
    path = bounded.solve([a_drive().without(20, 24)], bounded.Bounded(slow=False, nu=0.1))[0]
    assert "left_out" not in path.info


def test_the_share_is_chosen_by_hiding_and_none_where_nothing_can_be_hidden():
    drive = sampled(known(40.0, rate=2.0, noise=0.1, speed_noise=0.05, yaw_noise=0.003).log)
    found = bounded.nu_of(drive, bounded.Bounded(slow=False))
    assert found is None or found in bounded.NUS
    cases = bounded.stretches(drive, 5.0, 4, 10.0)
    assert len(cases) == 4
    for whole, hidden, out in cases:
        assert out.any()
        assert not hidden.seen[out].any()
        assert (whole.seen == (hidden.seen | out)).all()
    still = dataclasses.replace(drive, **{name: 0 * drive.t for name in ("east", "north", "speed", "yaw_rate")})
    assert bounded.nu_of(still) is None
    assert bounded.nu_of(drive.rows(slice(0, 2))) is None
