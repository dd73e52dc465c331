import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest
from tests.cases import CASES

import halfwidth as hw
from halfwidth.result import Estimate


@pytest.fixture
def est():
    case = CASES[0]
    return hw.estimate(case.model, case.record), case


def test_check_raises_unless_the_status_is_good():
    made = Estimate(np.arange(2.0), np.zeros((2, 1)), None, hw.Status.INFEASIBLE, "Made()", info={"message": "no room"})
    with pytest.raises(hw.Unsolved, match="INFEASIBLE: no room"):
        made.check()
    good = Estimate(np.arange(2.0), np.zeros((2, 1)), None, hw.Status.REDUCED, "Made()")
    assert good.check() is good
    assert good.q is None
    assert good.theta is None


def test_plot_draws_estimate_band_and_truth(est):
    est, case = est
    axes = est.plot(case.truth)
    assert len(axes) == 4
    assert len(axes[0].lines) == 2
    assert len(axes[0].collections) == 1
    plt.close("all")
    figure, ax = plt.subplots()
    assert est.plot(states="x1", ax=ax) is ax
    plt.close(figure)


def test_plot_refuses_what_it_cannot_draw(est):
    est, _ = est
    with pytest.raises(hw.BadValue, match="'speed'"):
        est.plot(states="speed")
    with pytest.raises(hw.BadShape, match="truth"):
        est.plot(np.zeros((3, 4)))
    figure, axes = plt.subplots(3)
    with pytest.raises(hw.BadShape, match="axes"):
        est.plot(ax=axes)
    plt.close(figure)


def test_names_with_markup_are_inert():
    made = Estimate(
        np.arange(2.0), np.zeros((2, 1)), None, hw.Status.OK, "<script>", names=("<b>x</b>",), info={"message": "<i>"}
    )
    html = made._repr_html_()
    assert "<script>" not in html
    assert "<b>x" not in html
    assert "<i>" not in html


def test_long_answers_stay_short_in_text():
    made = Estimate(np.arange(2.0), np.zeros((2, 30)), None, hw.Status.OK, "Made()")
    assert made.summary().count("\n") <= 12
    assert "22 more states" in made.summary()
    assert "nx=30" in repr(made)
