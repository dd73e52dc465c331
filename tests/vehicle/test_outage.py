import dataclasses
import json

import numpy as np
import pytest
from tests.vehicle.known import known, real_log

import halfwidth as hw
from halfwidth.errors import BadLog, BadValue
from halfwidth.vehicle.drive import simulate_drive
from halfwidth.vehicle.estimators import METHODS
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.outage import outages
from halfwidth.vehicle.outage_table import Cell, Outages

FAST = ("linear", "cv", "em")


@pytest.fixture(scope="module")
def log():
    return known(150.0, noise=0.1, speed_noise=0.05, yaw_noise=0.003, rate=5.0, stop=(60.0, 70.0)).log


@pytest.fixture(scope="module")
def table(log):
    return outages(log, (1, 5, 20), 6, 3, FAST)


def test_all_methods_get_the_same_starts(table):
    for length in table.lengths:
        starts = [table.cell(m, length).start for m in table.methods]
        for other in starts[1:]:
            np.testing.assert_array_equal(starts[0], other)
        assert starts[0].size == 6


def test_a_seed_is_a_benchmark(log, table):
    again = outages(log, (5,), 6, 3, ("linear",))
    assert again.cell("linear", 5).mean == table.cell("linear", 5).mean
    assert outages(log, (5,), 6, 4, ("linear",)).cell("linear", 5).mean != again.cell("linear", 5).mean


def test_the_vehicle_moves_in_every_outage(log):
    start = outages(log, (5,), 40, 1, ("linear",)).cell("linear", 5).start
    assert not np.any((start > 60.5) & (start < 64.5))


def test_numbers_of_a_straight_line_are_those_of_a_straight_line():
    made = known(120.0, rate=5.0)
    cell = outages(made.log, (10,), 5, 1, ("linear",)).cell("linear", 10)
    for t0, mean, most, n in zip(cell.start, cell.mean_error, cell.max_error, cell.n_fixes, strict=True):
        seen = (made.t < t0) | (made.t > t0 + 10)
        off = np.hypot(*(np.interp(made.t, made.t[seen], p[seen]) - p for p in (made.east, made.north)))[~seen]
        assert (mean, most, n) == pytest.approx((off.mean(), off.max(), off.size), rel=1e-3)
    assert cell.max == pytest.approx(cell.max_error.mean())
    assert cell.worst == pytest.approx(cell.max_error.max())


def test_the_table_says_everything(table):
    text = str(table)
    for word in ("linear", "em", "20 s", "starts", "standard error", "interval"):
        assert word in text
    frame = table.frame()
    assert len(frame) == 9
    assert set(frame.columns) >= {"method", "length_s", "starts", "mean_m", "max_m", "coverage", "mean_se_m"}
    assert table.cell("em", 5).coverage is not None
    data = json.loads(json.dumps(table.to_dict(), allow_nan=False))
    assert len(data["cells"]) == 9
    assert table.summary() == text
    with pytest.raises(BadValue, match="not in the table"):
        table.cell("em", 7)


def test_what_cannot_be_tried_is_said(log):
    bare = dataclasses.replace(log, speed_mps=np.full(len(log), np.nan), yaw_rate_radps=np.full(len(log), np.nan))
    table = outages(bare, (5, 500), 3, 1)
    assert table.methods == ("linear", "cv")
    assert "no speed" in table.skipped["gpsins"]
    assert "500 s" in table.skipped
    assert "em: the log has no speed or yaw rate" in str(table)


def test_an_outage_that_has_no_place_is_an_error_that_says_what_has(log):
    with pytest.raises(BadValue, match=r"`lengths` is 500 s .* span 150 s.* 1, 2, 5, 10, 20, 30, 60 s can be tried"):
        outages(log, (500,), 3, 1)
    standing = Log(t=np.arange(200.0), lat_deg=np.full(200, 50.0), lon_deg=np.full(200, 14.0))
    with pytest.raises(BadLog, match="no place for an outage"):
        outages(standing, (5,), 3, 1)
    with pytest.raises(BadLog, match="`em`: the log has no speed or yaw rate"):
        outages(standing, (5,), 3, 1, ("em",))


def test_the_table_says_which_intervals_are_sized(table):
    assert "own 90 % interval, before it is sized" in str(table)
    assert "sized by the other outages" in str(table)
    assert "held" in table.to_dict()["interval"]
    cell = table.cell("cv", 5)
    assert cell.coverage is not None
    assert 0.5 < cell.held <= 1.0
    assert cell.half_width > 0
    assert outages_of_two(table).held is None


def outages_of_two(table):
    cell = table.cell("cv", 5)
    return dataclasses.replace(cell, start=cell.start[:2], needed=cell.needed[:2], half=cell.half[:2])


def test_an_interval_is_sized_by_outages_that_do_not_overlap_with_its_own():
    start = np.array([0.0, 2.0, 20.0, 40.0, 60.0])
    needed = tuple(np.full(4, v) for v in (9.0, 8.0, 1.0, 2.0, 3.0))
    zeros = np.zeros(5)
    cell = Cell("x", 5.0, start, zeros, zeros, np.full(5, 2), needed, True, 0.9, zeros + 1.0, 0, 0.0)
    # about the largest of those it may ask
    np.testing.assert_allclose(cell.factors, [3.0, 3.0, 8.5, 8.5, 8.5], rtol=0.03)
    assert cell.held == pytest.approx(12 / 20)
    assert cell.half_width == pytest.approx(cell.factors.mean())


def test_how_long_an_outage_may_last():
    def cell(length, worst):
        one = np.array([worst])
        return Cell("x", length, one, one, one, np.array([1]), (one,), False, 0.9, one, 0, 0.0)

    table = Outages("", (cell(1.0, 0.1), cell(10.0, 1.0)), 0.9, 1, 0.0)
    assert table.within(0.1**0.5)["x"] == pytest.approx(10**0.5)
    assert table.within(0.05)["x"] == 0.0
    assert table.within(2.0)["x"] == 10.0


def test_the_plot_has_a_line_for_each_method_and_one_for_the_tolerance(table):
    pytest.importorskip("matplotlib").use("Agg")
    ax = table.plot(tolerance=0.5)
    assert len(ax.lines) == 2 * len(table.methods) + 1
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    longest = [table.cell(name, max(table.lengths)).mean for name in labels[:-1]]
    assert longest == sorted(longest)
    assert {*labels} == {*table.methods, "tolerance 0.5 m"}


def test_the_plot_of_one_length_has_a_row_for_each_method(log):
    pytest.importorskip("matplotlib").use("Agg")
    table = outages(log, (5,), 2, 1, ("linear", "cv"))
    ax = table.plot()
    rows = {label.get_text(): place for label, place in zip(ax.get_yticklabels(), ax.get_yticks(), strict=True)}
    for name in table.methods:
        cell = table.cell(name, 5)
        (line,) = (line for line in ax.lines if line.get_label() == name)
        np.testing.assert_allclose(line.get_xdata(), [cell.mean, cell.max])
        assert set(line.get_ydata()) == {rows[name]}


def test_clocks_are_found_if_none_is_given():
    log = known(200.0, rate=10.0, noise=0.02, late=0.3).log
    found = outages(log, (10,), 4, 1, ("em",))
    assert np.isnan(found.clock_offset)
    assert found.sensors
    assert found.cell("em", 10).mean < outages(log, (10,), 4, 1, ("em",), clock_offset=0.0).cell("em", 10).mean


def test_a_speed_that_drops_to_0_for_a_while_is_no_speed_for_any_method():
    _, log = simulate_drive(duration=400.0, seed=1, tunnels=())
    dead = (log.t >= 150) & (log.t < 200)  # the car goes 11 m/s
    wrong = dataclasses.replace(log, speed_mps=np.where(dead, 0.0, log.speed_mps))
    methods = ("em", "em-white", "linear")
    found = outages(wrong, (10.0,), 12, 1, methods)
    clean = outages(log, (10.0,), 12, 1, methods)
    for name in methods:
        assert found.cell(name, 10.0).mean < 1.5 * clean.cell(name, 10.0).mean
    assert any("the speed says 0 from 150.0 to 199.9 s" in one for one in found.messages)
    assert "the speed says 0" in found.table()
    assert found.to_dict()["messages"] == list(found.messages)
    assert not clean.messages


def test_progress_and_settings(log):
    told = []
    table = outages(
        log, (1, 5), 2, 1, ("linear", "cv"), clock_offset=0.1, progress=lambda share, words: told.append((share, words))
    )
    assert told[-1] == (1.0, "done")
    assert [share for share, _ in told] == [0, 0.25, 0.5, 0.75, 1]
    assert table.clock_offset == 0.1
    assert isinstance(table, Outages)


def test_a_right_clock_offset_helps():
    log = known(200.0, rate=10.0, noise=0.02, late=0.3).log
    table = [outages(log, (10,), 6, 1, ("em",), clock_offset=offset).cell("em", 10).mean for offset in (0.0, 0.3, -0.3)]
    assert table[1] < 0.7 * table[0] < table[2]


@pytest.mark.parametrize(
    "wrong",
    [
        {"lengths": ()},
        {"lengths": (-1,)},
        {"lengths": (np.nan,)},
        {"starts": 0},
        {"starts": 1.5},
        {"methods": ("x",)},
        {"level": 1.0},
        {"level": "a"},
        {"clock_offset": "a"},
        {"lengths": "a"},
        {"lengths": 5},
    ],
)
def test_wrong_arguments_are_named(log, wrong):
    with pytest.raises(BadValue):
        outages(log, **({"methods": ("linear",)} | wrong))


def test_too_few_fixes():
    with pytest.raises(BadLog, match="at least 3"):
        outages(Log(t=[0.0, 1.0], lat_deg=[1.0, 1.0], lon_deg=[1.0, 1.0]))


def test_it_is_public(log):
    assert hw.vehicle.outages(log, (2,), 2, 1, ("linear",)).cells[0].method == "linear"
    assert tuple(hw.vehicle.METHODS) == tuple(METHODS)


@pytest.mark.parametrize("name", ["smartloc", "balzer", "driveplotr"])
def test_the_chain_is_never_worse_than_a_straight_line(data, name):
    table = outages(real_log(data, name), (1, 2, 5, 10, 20, 30, 60), 3, 1, ("linear", "em"))
    for length in table.lengths:
        line, chain = table.cell("linear", length), table.cell("em", length)
        assert chain.mean <= line.mean
        assert chain.max <= line.max
        assert chain.failed == 0


@pytest.mark.parametrize(("name", "length", "row"), [("smartloc", 30, 0.38), ("balzer", 30, 4.0)])
def test_the_chain_is_near_what_is_known_of_it(data, name, length, row):
    """Means of other random starts, so within their standard errors of 15 to 25 %, both times."""
    cell = outages(real_log(data, name), (length,), 12, 1, ("em",)).cell("em", float(length))
    assert cell.mean < row * 1.1 + 2.5 * cell.mean_se
