"""Inputs are left alone, and the same seed gives the same bytes."""

import numpy as np
import pytest
from tests.cases import IDS, PAIRS

import halfwidth as hw


@pytest.mark.parametrize(("method", "case"), PAIRS, ids=IDS)
def test_same_seed_same_bytes_and_inputs_untouched(method, case):
    before = case.record.y.copy(), case.record.t.copy()
    first = hw.estimate(case.model, case.record, method, seed=3)
    second = hw.estimate(case.model, case.record, method, seed=3)
    assert first.x.tobytes() == second.x.tobytes()
    np.testing.assert_array_equal(case.record.y, before[0])
    np.testing.assert_array_equal(case.record.t, before[1])
    assert not case.record.y.flags.writeable
