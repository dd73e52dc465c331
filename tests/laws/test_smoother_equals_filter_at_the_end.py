"""At the last row a smoother knows what its filter knows; before it, more."""

import numpy as np
import pytest
from tests.cases import CASES

import halfwidth as hw
from halfwidth.methods import ESTIMATORS, load


def pairs():
    found = []
    if "KalmanSmoother" in ESTIMATORS:
        found += [(load("KalmanFilter")(), load("KalmanSmoother")(**extra)) for extra in ({}, {"lag": 4})]
    for name in ("ExtendedKalman", "UnscentedKalman"):
        if name in ESTIMATORS:
            found.append((load(name)(), load(name)(smooth=True)))
    return [(f, s, c) for f, s in found for c in CASES if s.refuses(c.model) is None]


@pytest.mark.parametrize(("filtering", "smoothing", "case"), pairs(), ids=str)
def test_last_row(filtering, smoothing, case):
    f = hw.estimate(case.model, case.record, filtering)
    s = hw.estimate(case.model, case.record, smoothing)
    np.testing.assert_allclose(s.x[-1], f.x[-1], rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(s.P[-1], f.P[-1], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(s.loglik, f.loglik, rtol=1e-12)
    if isinstance(case.model, hw.Linear):
        assert np.all(s.spread.sd <= f.spread.sd * (1 + 1e-9))
