"""The factor on a standard deviation: right for any size, near the wanted share from few stretches, never absurd."""

import numpy as np
import pytest

from halfwidth.vehicle import calibrate
from halfwidth.vehicle.calibrate import factor_for, inflation, quantile

LEVEL, Z = 0.9, 1.6448536


def one(length, *groups):
    return calibrate.Tested(length, 9, 0.1, 0.2, 0.95, 1.0, asked=groups)


def test_without_a_test_there_is_a_floor():
    np.testing.assert_allclose(inflation([], 5.0, np.array([1.0, 2.0]), LEVEL), calibrate.UNTESTED)


def test_many_stretches_are_believed_and_few_make_it_wide():
    many, few = (inflation([one(10.0, (1.0, 2.0, n))], 10.0, np.ones(1), LEVEL)[0] for n in (1e5, 4.0))
    assert many == pytest.approx(2.0, rel=0.01)
    assert 2.0 < few < 4.0


def test_the_size_of_the_error_counts_and_the_length_less():
    found = [one(5.0, (0.2, 1.0, 200.0), (2.0, 3.0, 200.0)), one(40.0, (0.3, 1.1, 50.0), (5.0, 3.2, 50.0))]
    small, large = inflation(found, 10.0, np.array([0.2, 3.0]), LEVEL)
    assert small == pytest.approx(1.05, rel=0.1)
    assert large == pytest.approx(3.1, rel=0.1)
    near, far = inflation(found, 300.0, np.array([5.0, 500.0]), LEVEL)
    assert 2.0 < far < 6.0
    assert near == pytest.approx(3.2, rel=0.3)


def test_what_is_stated_to_be_less_sure_is_not_shown_as_surer():
    sd = np.array([3.0, 0.1, 1.0, 0.5])
    half = inflation([one(5.0, (0.5, 4.0, 300.0), (3.0, 0.3, 300.0))], 5.0, sd, LEVEL, least=0.0) * sd
    assert (np.diff(half[np.argsort(sd)]) >= 0).all()


def test_no_narrower_than_asked_for():
    found = [one(5.0, (1.0, 0.01, 500.0))]
    assert inflation(found, 5.0, np.ones(1), LEVEL)[0] == 1.0
    assert calibrate.LEAST <= inflation(found, 5.0, np.ones(1), LEVEL, least=0.0)[0] < 0.2


@pytest.mark.parametrize("level", [0.5, 0.9, 0.99])
@pytest.mark.parametrize("n", [3, 8, 40])
def test_the_next_stretch_lies_inside_as_often_as_promised(n, level):
    rng = np.random.default_rng(n)
    z, inside = calibrate._z(level), []
    for _ in range(2000):
        scale = np.exp(rng.normal(0, 0.5))
        hidden = [np.abs(rng.standard_normal(4)) * scale / z for _ in range(n)]
        inside.append(abs(rng.standard_normal()) * scale <= z * factor_for(hidden, 10.0, level, 1e6))
    assert -0.02 < np.mean(inside) - level < 0.08 * (1 if n < 8 else 0.6)


def test_a_quantile_of_few_errors_is_enlarged_and_of_many_is_their_own():
    rng = np.random.default_rng(1)
    errors = np.abs(rng.standard_normal(20_000))
    assert quantile(errors, np.ones(errors.size), LEVEL, errors.size) == pytest.approx(Z, rel=0.03)
    few = [quantile(errors[k : k + 2], np.ones(2), LEVEL, 2) for k in range(0, 4000, 2)]
    assert np.median(few) == pytest.approx(Z, rel=0.1)
    assert quantile(np.zeros(3), np.ones(3), LEVEL, 3) == 0.0


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
    assert calibrate._independent(4, 60.0, np.ptp(calibrate._runs(grid, 60.0)[0].fixes), 2) == pytest.approx(8 / 2.4)


def test_between_many_gaps_shorter_stretches_are_hidden(made_grid):
    grid = made_grid(600.0)
    grid = grid.masked(grid.t % 50 > 20)  # 20 s of fixes, 30 s without
    lengths = calibrate.lengths_to_test([grid], np.array([30.0]))
    assert lengths[-1] == 30.0
    assert calibrate._hidden(grid, 30.0, 0.0, ()) is None
    assert len(calibrate._hidden(grid, lengths[0], 0.0, ())[1]) >= 8
