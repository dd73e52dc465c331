"""A missing entry carries nothing: not its row, not its column, whatever stood there."""

import dataclasses

import numpy as np
import pytest
from tests.cases import CASES, IDS, PAIRS, constant_velocity, stochastic

import halfwidth as hw

TWO = [(m, c) for m, c in PAIRS if isinstance(c.model, hw.Linear) and c.model.ny > 1 and not stochastic(m)]


@pytest.mark.parametrize(("method", "case"), TWO, ids=str)
def test_an_output_never_seen_equals_a_model_without_it(method, case):
    model = dataclasses.replace(case.model, F=None)
    y = case.record.y.copy()
    y[:, 1] = np.nan
    both = hw.estimate(model, hw.Record(case.record.t, y, case.record.u), method)
    less = dataclasses.replace(model, C=model.C.single[:1], e=_first(model.e), names=None)
    one = hw.estimate(less, hw.Record(case.record.t, y[:, :1], case.record.u), method)
    np.testing.assert_allclose(both.x, one.x, rtol=1e-6, atol=1e-6 * np.abs(one.x).max())


def _first(noise):
    if isinstance(noise, hw.Gaussian) and not noise.known:
        return hw.Gaussian.unknown(noise.at_least[:1], noise.at_most[:1])
    if isinstance(noise, hw.Gaussian):
        return hw.Gaussian(noise.cov().single[:1, :1])
    if isinstance(noise, hw.Uniform):
        return hw.Uniform.unknown(noise.at_least[:1], noise.at_most[:1])
    return _first(noise.uniform) + _first(noise.gaussian)


@pytest.mark.parametrize(
    "method",
    # A lag counts rows, so with fewer rows it reaches further.
    [m for m, c in PAIRS if c.name == "cv irregular" and not stochastic(m) and getattr(m, "lag", None) is None],
    ids=repr,
)
def test_a_row_without_outputs_equals_no_row(method):
    """With matrices that follow the step, dropping the rows of a gap changes nothing at the other rows."""
    model = constant_velocity(None, w=hw.Gaussian(lambda dt: np.kron(np.eye(2), 0.5 * _wiener(dt))))
    case = next(c for c in CASES if c.name == "cv irregular")
    lost = case.record.without(case.record.t[20], case.record.t[29])
    keep = lost.seen.any(axis=1)
    full = hw.estimate(model, lost, method)
    thin = hw.estimate(model, hw.Record(lost.t[keep], lost.y[keep]), method)
    np.testing.assert_allclose(full.x[keep], thin.x, rtol=1e-7, atol=1e-8)


def _wiener(dt):
    return np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])


def test_ids_are_unique():
    assert len(set(IDS)) == len(IDS)
