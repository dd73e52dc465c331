"""The same numbers whether rows come at once, one by one, after a restart, or beside other series."""

import numpy as np
import pytest
from tests.cases import PAIRS

import halfwidth as hw


def online(method):
    """Whether a method has an online form; a smoother has one only with a lag, a hull with a memory, `Constrained`
    what it holds has.
    """
    if isinstance(method, hw.Constrained):
        return online(method.method) and hasattr(method.method, "step")
    smooths = getattr(method, "smooth", False) or (
        type(method).__name__ == "KalmanSmoother" and not getattr(method, "lag", None)
    )
    if type(method).__name__ == "Hull" and method.memory is None:
        return False
    return not smooths and (hasattr(method, "stream") or hasattr(method, "step"))


STREAMED = [(m, c) for m, c in PAIRS if online(m)]


@pytest.mark.parametrize(("method", "case"), STREAMED, ids=str)
def test_stream(method, case):
    lag = getattr(method, "lag", None) or 0
    batch = hw.estimate(case.model, case.record, method, seed=1)
    live = hw.stream(case.model, method)
    dt = case.record.steps(case.model.dt)
    for k, y in enumerate(case.record.y):
        if k == 25:
            live = hw.resume(live.snapshot(), case.model)
        newest = live.push(y, None if case.record.u is None else case.record.u[k], dt=dt[k])
        if k >= lag:
            np.testing.assert_allclose(newest.x[0], batch.x[k - lag], rtol=1e-10, atol=1e-11)
    assert isinstance(newest, hw.Estimate)
    if newest.loglik is not None:
        np.testing.assert_allclose(newest.loglik, batch.loglik, rtol=1e-10)


@pytest.mark.parametrize(("method", "case"), PAIRS, ids=str)
def test_many(method, case):
    half = len(case.record) // 2
    if isinstance(case.model, hw.Linear) and any(
        m.value is not None and m.value.ndim == 3 for m in case.model.matrices.values()
    ):
        pytest.skip("stacked matrices fit one length only")
    short = hw.Record(
        case.record.t[:half], case.record.y[:half], None if case.record.u is None else case.record.u[:half]
    )
    several = hw.estimate(case.model, [case.record, short], method, seed=1)
    for record, est in zip([case.record, short], several, strict=True):
        alone = hw.estimate(case.model, record, method, seed=1)
        np.testing.assert_array_equal(est.x, alone.x)
