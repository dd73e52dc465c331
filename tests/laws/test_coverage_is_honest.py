"""On data drawn from the model, an interval covers what it says: within binomial limits, or always if guaranteed."""

import numpy as np
import pytest
from tests.cases import CASES, METHODS, holes, point_only

import halfwidth as hw

MODELS = [c for c in CASES if c.name in ("cv", "oscillator", "walk", "turn", "oscillator uniform", "oscillator mixed")]
KNOWN = [(m, c) for m in METHODS for c in MODELS if m.refuses(c.model) is None and not point_only(m)]


@pytest.mark.parametrize(("method", "case"), KNOWN, ids=str)
def test_coverage(method, case):
    level, runs = 0.9, 60
    hits = []
    for seed in range(runs):
        truth, record = hw.simulate(
            case.model, case.record.u, T=30 if case.record.u is None else None, seed=1000 + seed
        )
        est = hw.estimate(case.model, holes(record, seed, 0.3), method, seed=seed)
        lo, hi = est.interval(level)
        # One row a run, so that the draws are independent.
        hits.append((lo[20] <= truth.x[20]) & (truth.x[20] <= hi[20]))
    share = np.mean(hits)
    if est.guaranteed:
        assert share == 1.0
        return
    # Entries of one state are dependent, so the limit is that of `runs` draws.
    limit = 4.0 * np.sqrt(level * (1 - level) / runs)
    assert abs(share - level) < limit
