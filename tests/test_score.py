import numpy as np
import pytest

import halfwidth as hw
from halfwidth.result import Estimate


def answer(x, lo, hi, guaranteed=False):
    return Estimate(np.arange(1.0, len(x) + 1), x, hw.Box(lo, hi, guaranteed=guaranteed), hw.Status.OK, "Made()")


def test_figures_are_what_they_say():
    truth = np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])
    est = answer(truth + [3.0, 4.0], truth - 1.0, truth + np.array([[1.0, 1.0], [2.0, 1.0], [-0.5, 1.0]]))
    row = hw.score(est, truth)[0]
    assert row.max_error == pytest.approx(5.0)
    assert row.rmse == pytest.approx(5.0)
    assert row.inside == pytest.approx(5 / 6)
    assert row.widest == pytest.approx(3.0)
    assert hw.score(est, truth, during=(1.0, 2.0))[0].inside == 1.0
    assert hw.score(est, truth, states=[0])[0].max_error == pytest.approx(3.0)


def test_the_table_names_the_kind_of_bound():
    truth = np.zeros((2, 1))
    text = repr(hw.score([answer(truth, truth - 1, truth + 1, True), answer(truth, truth - 1, truth + 1)], truth))
    assert "guaranteed" in text
    assert "90 %" in text
    point = Estimate(np.arange(2.0), truth, None, hw.Status.OK, "Point()")
    assert hw.score(point, truth)[0].inside is None
    with pytest.raises(hw.Refused):
        point.interval()
