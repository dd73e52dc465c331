"""Zero noise, wild scales, nothing seen, one row: a status and finite numbers, never NaN, never a crash."""

import dataclasses

import numpy as np
import pytest
from tests.cases import PAIRS

import halfwidth as hw


def hard(case):
    """Return named (model, record) pairs made from one case."""
    m, r = case.model, case.record
    nothing = hw.Record(r.t, np.full_like(r.y, np.nan), r.u)
    one = hw.Record(r.t[:1], r.y[:1], None if r.u is None else r.u[:1])
    empty_one = hw.Record(r.t[:1], np.full_like(r.y[:1], np.nan), None if r.u is None else r.u[:1])
    found = {"nothing seen": (m, nothing), "one row": (m, one), "one row, nothing seen": (m, empty_one)}
    found["an output far away"] = (m, hw.Record(r.t, r.y + 1e9, r.u))
    if isinstance(m, hw.Linear) and m.w.known and m.e.known:
        quiet = dataclasses.replace(m, w=_quiet(m.w), e=_quiet(m.e))
        found["no noise at all"] = (quiet, r)
        found["no state noise"] = (dataclasses.replace(m, w=_quiet(m.w)), r)
    for s in (1e-12, 1e12):
        found[f"outputs times {s:g}"] = (m, hw.Record(r.t, s * r.y, r.u))
    return found


def _quiet(noise):
    if isinstance(noise, hw.Gaussian):
        return hw.Gaussian(0.0)
    if isinstance(noise, hw.Uniform):
        return hw.Uniform(0.0)
    return hw.Uniform(0.0) + hw.Gaussian(0.0)


@pytest.mark.parametrize(("method", "case"), PAIRS, ids=str)
def test_hard_cases(method, case):
    for name, (model, record) in hard(case).items():
        if method.refuses(model) is not None:
            continue
        est = hw.estimate(model, record, method, seed=1)
        assert isinstance(est.status, hw.Status), name
        if est.status.good:
            assert np.isfinite(est.x).all(), name
        assert not np.isnan(est.x).any(), name
        if est.spread is not None:
            lo, hi = est.interval(0.9)
            assert not np.isnan(lo).any(), name
            assert not np.isnan(hi).any(), name
            assert np.all(lo <= hi), name
        if isinstance(est.spread, hw.Normal):
            P = est.spread.P
            np.testing.assert_array_equal(P, np.swapaxes(P, -1, -2), err_msg=name)
            low = np.linalg.eigvalsh(P)
            assert np.all(low[:, 0] >= -1e-12 * np.maximum(low[:, -1], 1e-300)), name
