"""Functionals from the rows nearby: guaranteed, nearly as narrow as from all rows, and honest where rows say nothing."""

import dataclasses

import numpy as np
import pytest
from tests.cases import holes, oscillator

import halfwidth as hw


def plant(T=60, seed=3, x0=1.0):
    box = hw.Box(-x0 * np.ones(3), x0 * np.ones(3))
    model = oscillator(hw.Uniform([0.1, 0.2, 0.1]), hw.Uniform([0.6, 0.8]), box)
    truth, record = hw.simulate(model, np.random.default_rng(seed).standard_normal((T, 1)), seed=seed)
    return model, truth, holes(record, seed + 1, 0.3, (25, 34))


@pytest.mark.parametrize("c", [[1.0, -0.5, 2.0], [0.0, 1.0, 0.0]])
def test_the_rows_nearby_contain_the_truth_and_all_that_more_rows_leave(c):
    model, truth, record = plant()
    exact, few, many = (hw.bound(model, record, c, reach=reach) for reach in (None, 4, 15))
    for near in (few, many):
        assert np.all((near.lo <= truth.x @ c) & (truth.x @ c <= near.hi))
        assert np.all((near.lo <= exact.lo + 1e-6) & (exact.hi - 1e-6 <= near.hi))
    width = np.mean(exact.hi - exact.lo)
    assert np.mean(many.hi - many.lo) < 1.02 * width
    assert np.mean(few.hi - few.lo) < 2 * width


def test_with_all_rows_in_reach_it_is_the_whole_record():
    model, _, record = plant(T=20)
    for near, exact in zip(
        hw.bound(model, record, [1.0, 1.0, 0], reach=50), hw.bound(model, record, [1.0, 1.0, 0]), strict=True
    ):
        np.testing.assert_allclose(near, exact, atol=1e-4)


def test_each_row_may_have_a_functional_of_its_own_in_any_order():
    model, _, record = plant()
    at, c = [40, 3, -1, 30, 30], np.random.default_rng(0).standard_normal((5, 3))
    for reach in (None, 60):
        found = hw.bound(model, record, c, at=at, reach=reach)
        for k, (row, one) in enumerate(zip(at, c, strict=True)):
            alone = hw.bound(model, record, one, at=row, reach=reach)
            np.testing.assert_allclose((found.lo[k], found.hi[k]), (alone.lo, alone.hi), atol=2e-3)


def test_where_nothing_is_known_the_interval_is_infinite_and_only_there():
    walk = hw.Linear([[1.0]], None, [[1.0]], hw.Uniform(1.0), hw.Uniform(0.5), hw.Box([-np.inf], [np.inf]))
    found = hw.bound(walk, hw.Record([0.0, 1.0, 2.0, 3.0], [None, None, 4.0, None]), [1.0], reach=2)
    np.testing.assert_allclose(np.column_stack(found), [[1.5, 6.5], [2.5, 5.5], [3.5, 4.5], [2.5, 5.5]], atol=1e-6)
    two = hw.Linear(
        np.eye(2), None, [[1.0, 0.0]], hw.Uniform(1.0), hw.Uniform(0.5), hw.Box([-np.inf] * 2, [np.inf] * 2)
    )
    never = hw.bound(two, hw.Record([0.0, 1.0], [0.0, 0.0]), [0.0, 1.0], reach=2)
    assert np.all(np.isneginf(never.lo) & np.isposinf(never.hi))
    nothing = hw.bound(walk, hw.Record([0.0, 1.0], [None, None]), [1.0], reach=1)
    assert np.all(np.isinf(nothing.lo) & np.isinf(nothing.hi))


def test_data_that_contradict_the_bounds_are_named_and_give_no_interval():
    walk = hw.Linear([[1.0]], None, [[1.0]], hw.Uniform(1.0), hw.Uniform(0.5), hw.Box([-9.0], [9.0]))
    record = hw.Record([0.0, 1.0, 2.0], [0.0, 0.5, 40.0])
    with pytest.raises(hw.errors.Unsolved, match="t = 2 s"):
        hw.bound(walk, record, [1.0], reach=3)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"reach": 0}, hw.BadValue, "`reach`"),
        ({"reach": 2.5}, hw.BadValue, "`reach`"),
        ({"at": [0, 60]}, hw.BadValue, "`at`"),
        ({"at": 0.5}, hw.BadValue, "`at`"),
        ({"c": np.ones((2, 3)), "at": [0, 1, 2]}, hw.BadShape, "`c`"),
        ({"c": [1.0]}, hw.BadShape, "`c`"),
    ],
)
def test_what_makes_no_sense_is_refused(change, error, words):
    model, _, record = plant()
    given = {"c": [1.0, 0, 0]} | change
    with pytest.raises(error, match=words):
        hw.bound(model, record, given.pop("c"), **given)


def test_scales_do_not_matter():
    model, _, record = plant(T=30)
    plain = hw.bound(model, record, [1.0, 0, 0], reach=8)
    for size in (1e-9, 1e9):
        scaled = dataclasses.replace(
            model,
            w=hw.Uniform(model.w.q * size),
            e=hw.Uniform(model.e.q * size),
            x0=hw.Box(model.x0.lo * size, model.x0.hi * size),
        )
        found = hw.bound(scaled, hw.Record(record.t, record.y * size, record.u * size), [1.0, 0, 0], reach=8)
        np.testing.assert_allclose(np.column_stack(found) / size, np.column_stack(plain), atol=1e-5)
