"""Stretches that are hidden: as long as the gaps they stand for, apart from each other and from gaps of the log."""

import numpy as np
import pytest

from halfwidth.vehicle import calibrate
from halfwidth.vehicle.widening import independent


def test_lengths_go_down_from_the_longest_until_there_are_enough_stretches(made_grid):
    grid = made_grid(400.0)
    lengths = calibrate.lengths_to_test([grid], np.array([60.0]))
    assert lengths[-1] == 60.0
    assert len(lengths) > 2
    assert calibrate.lengths_to_test([grid], np.array([1000.0]))[-1] == pytest.approx(400 / 3, rel=0.01)
    hour = calibrate.lengths_to_test([made_grid(3600.0)], np.array([30.0]))
    assert hour == [30.0]
    spread = calibrate.lengths_to_test([grid], np.array([1.0, 100.0]))
    assert (spread[0], spread[-1]) == (pytest.approx(1.0), pytest.approx(100.0))
    assert len(spread) <= calibrate.MOST_LENGTHS
    assert calibrate.lengths_to_test([grid], np.array([])) == []


@pytest.fixture
def made_grid():
    from halfwidth.vehicle.frames import Frame
    from halfwidth.vehicle.grid import sampled
    from halfwidth.vehicle.log import Log

    def made(duration):
        t = np.arange(0.0, duration + 0.1, 0.5)
        log = Log(t=t, lat_deg=50 + 1e-5 * t, lon_deg=np.full(t.size, 14.0), speed_mps=np.full(t.size, 1.1))
        return sampled(log, frame=Frame(50.0, 14.0))

    return made


@pytest.mark.parametrize("length", [5.0, 12.3, 40.0])
def test_a_hidden_stretch_is_as_long_as_the_gap_it_stands_for(made_grid, length):
    grid = made_grid(400.0)
    for phase in (0.0, 0.3, 0.8):
        hidden, stretches = calibrate._hidden(grid, length, phase, ())
        fixes = grid.t[hidden.seen]
        spans = np.diff(fixes)[np.diff(fixes) > 0.6]
        assert spans.size == len(stretches) > 2
        assert ((spans >= length - 1e-6) & (spans < length + 0.5)).all()
        # and has as many fixes between itself and the next one as it is long
        assert (np.diff([grid.t[part.start] for part in stretches]) >= 2 * length).all()


def test_no_hidden_stretch_runs_into_a_gap_of_the_log(made_grid):
    grid = made_grid(400.0).without(100.0, 130.0).without(300.0, 310.0)
    total = 0
    for phase in np.arange(calibrate.PHASES) / calibrate.PHASES:
        found = calibrate._hidden(grid, 20.0, phase, ())
        for part in found[1] if found else []:
            begin, end = grid.t[part.start], grid.t[part.stop - 1]
            assert all(end < a - 15 or begin > b + 15 for a, b in ((100, 130), (300, 310)))
            total += 1
    assert total > 10
    assert sum(np.ptp(run.fixes) for run in calibrate._runs(grid, 20.0)) == pytest.approx(400 - 31 - 11, abs=1.5)
    # a fix that is missing here and there is no gap
    holes = grid.masked(np.random.default_rng(0).uniform(size=len(grid)) < 0.05)
    assert len(calibrate._hidden(holes, 20.0, 0.0, ())[1]) == 7


def test_where_there_is_room_for_one_stretch_the_phases_move_it(made_grid):
    grid = made_grid(100.0)
    begins = [calibrate._hidden(grid, 60.0, phase, ())[1][0].start for phase in (0.0, 0.25, 0.5, 0.75)]
    assert len(set(begins)) == 4
    # which are one place of the log and not four
    assert independent(4, 60.0, np.ptp(calibrate._runs(grid, 60.0)[0].fixes), 2) == pytest.approx(8 / 2.4)


def test_between_many_gaps_shorter_stretches_are_hidden(made_grid):
    grid = made_grid(600.0)
    grid = grid.masked(grid.t % 50 > 20)  # 20 s of fixes, 30 s without
    lengths = calibrate.lengths_to_test([grid], np.array([30.0]))
    assert lengths[-1] == 30.0
    assert calibrate._hidden(grid, 30.0, 0.0, ()) is None
    assert len(calibrate._hidden(grid, lengths[0], 0.0, ())[1]) >= 8
