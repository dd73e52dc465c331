"""Shapes, finiteness and status of every estimator on every case it takes."""

import numpy as np
import pytest
from tests.cases import CASES, IDS, METHODS, PAIRS, point_only

import halfwidth as hw


@pytest.mark.parametrize(("method", "case"), PAIRS, ids=IDS)
def test_answer(method, case):
    est = hw.estimate(case.model, case.record, method, seed=1)
    T, nx, ny = len(case.record), case.model.nx, case.model.ny
    assert isinstance(est.status, hw.Status)
    assert est.check() is est
    assert est.x.shape == (T, nx)
    assert np.isfinite(est.x).all()
    np.testing.assert_array_equal(est.t, case.record.t)
    assert (est.spread is None) == point_only(method)
    if est.spread is not None:
        lo, hi = est.interval(0.9)
        assert lo.shape == hi.shape == (T, nx)
        assert not np.isnan(lo).any()
        assert np.all(lo <= hi)
        wider = est.interval(0.99)
        assert np.all(wider[0] <= lo + 1e-12)
        assert np.all(wider[1] >= hi - 1e-12)
    if est.loglik is not None:
        assert np.isfinite(est.loglik)
    for name, n in (("q", nx), ("r", ny)):
        value = getattr(est, name)
        assert value is None or value.shape == (n,)
    assert est.summary().count("\n") < 14
    assert "<table" in est._repr_html_()


@pytest.mark.parametrize("method", METHODS, ids=repr)
def test_it_takes_some_case_and_says_why_it_refuses_the_others(method):
    taken = 0
    for case in CASES:
        reason = method.refuses(case.model)
        if reason is None:
            taken += 1
            continue
        assert type(method).__name__ in reason
        assert "\nhint: " in reason
        with pytest.raises(hw.Refused):
            hw.estimate(case.model, case.record, method)
    assert taken
