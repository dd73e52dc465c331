"""Metres or kilometres, an early clock or a late one, this basis or that: the same car."""

import dataclasses

import numpy as np
import pytest
from tests.cases import PAIRS, stochastic

import halfwidth as hw

LINEAR = [(m, c) for m, c in PAIRS if isinstance(c.model, hw.Linear) and c.model.A.constant and not stochastic(m)]


@pytest.mark.parametrize(("method", "case"), LINEAR, ids=str)
@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_scaled_states_and_outputs(method, case, scale):
    m = case.model
    scaled = dataclasses.replace(
        m,
        B=None if m.B is None else scale * m.B.single,
        w=_scaled(m.w, scale),
        e=_scaled(m.e, scale),
        x0=_scaled(m.x0, scale),
        bounds=_scaled(m.bounds, scale),
    )
    record = hw.Record(case.record.t, scale * case.record.y, case.record.u)
    one = hw.estimate(m, case.record, method, seed=1)
    two = hw.estimate(scaled, record, method, seed=1)
    np.testing.assert_allclose(two.x / scale, one.x, rtol=1e-6, atol=1e-6 * np.abs(one.x).max())
    if one.spread is not None:
        for a, b in zip(one.interval(), two.interval(), strict=True):
            np.testing.assert_allclose(b / scale, a, rtol=1e-5, atol=1e-5 * np.abs(a[np.isfinite(a)]).max())


@pytest.mark.parametrize(("method", "case"), PAIRS, ids=str)
def test_a_later_clock(method, case):
    # A shift that is a power of two keeps the steps exact.
    record = hw.Record(case.record.t + 65536.0, case.record.y, case.record.u)
    one = hw.estimate(case.model, case.record, method, seed=1)
    two = hw.estimate(case.model, record, method, seed=1)
    np.testing.assert_allclose(two.x, one.x, rtol=1e-6, atol=1e-6 * np.abs(one.x).max())


# `by="nearest"` measures distance in the units and the basis of x.
GAUSSIAN = [
    (m, c)
    for m, c in LINEAR
    if isinstance(c.model.w, hw.Gaussian) and isinstance(c.model.e, hw.Gaussian) and getattr(m, "by", "") != "nearest"
    if c.model.w.known
]


@pytest.mark.parametrize(("method", "case"), GAUSSIAN, ids=str)
def test_another_basis(method, case):
    """With x' = M x everything turns with it; only for Gaussian noise, since a box does not stay a box."""
    m = case.model
    M = np.eye(m.nx) + 0.3 * np.random.default_rng(0).standard_normal((m.nx, m.nx))
    inverse = np.linalg.inv(M)
    E = np.eye(m.nx) if m.E is None else m.E.single
    fold = np.linalg.inv(E)
    turned = dataclasses.replace(
        m,
        A=M @ fold @ m.A.single @ inverse,
        B=None if m.B is None else M @ fold @ m.B.single,
        C=m.C.single @ inverse,
        w=hw.Gaussian(_symmetric(M @ fold @ m.w.cov().single @ fold.T @ M.T)),
        x0=hw.Normal(M @ m.x0.mean, _symmetric(M @ m.x0.P @ M.T)),
        E=None,
        bounds=None if m.bounds is None else hw.Halfspaces(m.bounds.rows[0] @ inverse, *m.bounds.rows[1:]),
    )
    one = hw.estimate(m, case.record, method)
    two = hw.estimate(turned, case.record, method)
    np.testing.assert_allclose(two.x @ inverse.T, one.x, rtol=1e-7, atol=1e-8)
    if one.loglik is not None:
        np.testing.assert_allclose(two.loglik, one.loglik, rtol=1e-8)


def _symmetric(P):
    return 0.5 * (P + P.T)


def _scaled(thing, s):
    if thing is None:
        return None
    if isinstance(thing, hw.Halfspaces):
        return hw.Halfspaces(thing.D, s * thing.lo, s * thing.hi)
    if isinstance(thing, hw.Gaussian) and not thing.known:
        return hw.Gaussian.unknown(s**2 * thing.at_least, s**2 * thing.at_most)
    if isinstance(thing, hw.Gaussian):
        return hw.Gaussian(s**2 * thing.cov().single)
    if isinstance(thing, hw.Uniform):
        return hw.Uniform.unknown(s * thing.at_least, s * thing.at_most)
    if isinstance(thing, hw.Normal):
        return hw.Normal(s * thing.mean, s**2 * thing.P)
    if isinstance(thing, hw.Box):
        return hw.Box(s * thing.lo, s * thing.hi)
    return _scaled(thing.uniform, s) + _scaled(thing.gaussian, s)
