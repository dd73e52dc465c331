"""Taking data away never makes a Gaussian answer or a guaranteed box narrower.

A belief cut at bounds is left out: the further outside its mean is, the less of it is left. So is the posterior of
bounded noise: an output at the edge of what is possible narrows it less than one in the middle.
"""

import numpy as np
import pytest
from tests.cases import PAIRS, point_only, stochastic, weighs

import halfwidth as hw

SPREAD = [
    (m, c)
    for m, c in PAIRS
    if isinstance(c.model, hw.Linear)
    and not stochastic(m)
    and not weighs(m)
    and not point_only(m)
    and c.model.bounds is None
    and (type(m).__name__ != "Posterior" or all(isinstance(v, hw.Gaussian) for v in (c.model.w, c.model.e)))
    and c.model.w.known
    and c.model.e.known
    # the gain of these makes a set small, not its box: with fewer outputs another coordinate may gain
    and type(m).__name__ not in ("ZonotopeFilter", "ConstrainedZonotopeFilter", "EllipsoidFilter")
]


@pytest.mark.parametrize(("method", "case"), SPREAD, ids=str)
def test_a_longer_gap(method, case):
    middle = case.record.t[len(case.record) // 2]
    step = case.record.t[1] - case.record.t[0]
    widths = []
    for half in (2, 5, 9):
        est = hw.estimate(case.model, case.record.without(middle - half * step, middle + half * step), method)
        lo, hi = est.interval(0.9)
        widths.append(hi - lo)
    assert np.all(widths[1] >= widths[0] * (1 - 1e-9) - 1e-12)
    assert np.all(widths[2] >= widths[1] * (1 - 1e-9) - 1e-12)
