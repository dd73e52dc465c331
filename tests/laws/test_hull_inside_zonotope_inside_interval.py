"""The exact box of all data lies inside that of every set recursion, and each of these inside the interval's."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.cases import CASES, METHODS
from tests.naive_sets import exact_box

import halfwidth as hw

SETS = [m for m in METHODS if type(m).__module__ == "halfwidth.methods.sets"]
CASE = next(c for c in CASES if c.name == "oscillator uniform")


def ordered(model, record, rows):
    """Check the order at some rows; return the widths of each method beside the exact one."""
    boxes = {m: hw.estimate(model, record, m).check().interval() for m in SETS}
    cheapest = boxes[hw.IntervalFilter()]
    wide = {m: [] for m in SETS}
    for k in rows:
        low, high = exact_box(model, record, k)
        scale = 1e-7 * (1.0 + np.abs(low) + np.abs(high))  # what the linear programs are good to
        for m, (lo, hi) in boxes.items():
            assert np.all(lo[k] <= low + scale), m
            assert np.all(high <= hi[k] + scale), m
            assert np.all(cheapest[0][k] <= lo[k]), m
            assert np.all(hi[k] <= cheapest[1][k]), m
            wide[m].append(np.mean(hi[k] - lo[k]) / np.mean(high - low))
    return {m: np.mean(w) for m, w in wide.items()}


def test_on_the_oscillator_with_an_outage():
    wide = ordered(CASE.model, CASE.record, [0, 5, 18, 24, 27, 40, 59])
    named = {type(m).__name__: w for m, w in wide.items()}
    assert named["ConstrainedZonotopeFilter"] < named["ZonotopeFilter"] < named["IntervalFilter"]
    assert named["ConstrainedZonotopeFilter"] < 1.2


def test_the_guaranteed_hull_is_inside_too():
    low, high = hw.estimate(CASE.model, CASE.record, hw.Hull(lag=0)).check().interval()
    for m in SETS:
        lo, hi = hw.estimate(CASE.model, CASE.record, m).interval()
        assert np.all(lo <= low + 1e-5 * (hi - lo)), m
        assert np.all(high <= hi + 1e-5 * (hi - lo)), m


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    nx=st.integers(1, 3),
    ny=st.integers(1, 3),
    scale=st.sampled_from([1e-9, 1.0, 1e9]),
    share=st.sampled_from([0.0, 0.3, 0.8]),
)
def test_on_drawn_models(seed, nx, ny, scale, share):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(nx, nx))
    A *= rng.uniform(0.3, 1.1) / max(np.abs(np.linalg.eigvals(A)).max(), 1e-3)
    w, e = hw.Uniform(scale * rng.uniform(0, 1, nx)), hw.Uniform(scale * rng.uniform(0, 1, ny))
    model = hw.Linear(A, None, rng.normal(size=(ny, nx)), w, e, hw.Box(-scale * np.ones(nx), scale * np.ones(nx)))
    if seed % 2:
        upper = np.triu(rng.normal(size=(nx, nx)), 1) + np.eye(nx)
        model = dataclasses.replace(model, E=upper, F=np.triu(rng.normal(size=(ny, ny)), 1) + np.eye(ny))
    _, record = hw.simulate(model, T=6, seed=seed)
    y = np.where(rng.random(record.y.shape) < share, np.nan, record.y)
    unit = dataclasses.replace(
        model, w=hw.Uniform(w.q / scale), e=hw.Uniform(e.q / scale), x0=hw.Box(-np.ones(nx), np.ones(nx))
    )
    if scale == 1.0:
        ordered(model, hw.Record(record.t, y), [0, 3, 5])
    else:  # the linear programs are solved in natural units, the recursions in these
        for m in SETS:
            lo, hi = hw.estimate(model, hw.Record(record.t, y), m).check().interval()
            low, high = exact_box(unit, hw.Record(record.t, y / scale), 5)
            slack = 1e-7 * (1.0 + np.abs(low) + np.abs(high))
            assert np.all(lo[5] / scale <= low + slack)
            assert np.all(high <= hi[5] / scale + slack)


@pytest.mark.parametrize("method", SETS, ids=repr)
def test_it_claims_no_guarantee(method):
    assert not hw.estimate(CASE.model, CASE.record, method).guaranteed
