import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import halfwidth as hw


def test_missing_in_every_spelling():
    for y in ([1.0, None, 3.0], [1.0, np.nan, 3.0], np.ma.masked_array([1, 2, 3], [0, 1, 0])):
        record = hw.Record([0.0, 1.0, 2.0], y)
        assert record.seen.ravel().tolist() == [True, False, True]
        np.testing.assert_array_equal(record.y[record.seen], [1.0, 3.0])


def test_masked_floats_are_missing_whatever_stands_under_the_mask():
    y = np.ma.masked_array([[1.0, np.inf], [2.0, 3.0]], [[0, 1], [0, 0]])
    assert hw.Record([0.0, 1.0], y).seen.tolist() == [[True, False], [True, True]]


@given(hnp.arrays(bool, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=30)))
def test_gaps_are_the_runs_without_outputs(seen):
    T = len(seen)
    record = hw.Record(np.arange(T) * 0.5, np.where(seen, 1.0, np.nan))
    lost = np.zeros(T, dtype=bool)
    for gap in record.gaps():
        assert gap.start == record.t[gap.first]
        assert gap.stop == record.t[gap.last]
        lost[gap.first : gap.last + 1] = True
        assert gap.first == 0 or seen[gap.first - 1].any()
        assert gap.last == T - 1 or seen[gap.last + 1].any()
    np.testing.assert_array_equal(lost, ~seen.any(axis=1))


def test_without_takes_both_ends_and_only_the_outputs_named():
    record = hw.Record(np.arange(5.0), np.ones((5, 2)))
    assert record.without(1.0, 3.0).seen[:, 0].tolist() == [True, False, False, False, True]
    assert record.without(1.0, 3.0, outputs=[1]).seen.all(axis=0).tolist() == [True, False]
    assert record.seen.all()


@given(st.lists(st.tuples(st.integers(0, 5), st.floats(-5, 5) | st.none()), min_size=1, max_size=20))
def test_merged_keeps_the_last_seen_entry_of_a_time(rows):
    t = [float(a) for a, _ in rows]
    record = hw.Record.merged(t, [b for _, b in rows])
    assert record.t.tolist() == sorted(set(t))
    for k, when in enumerate(record.t):
        seen = [b for a, b in rows if a == when and b is not None]
        assert record.seen[k, 0] == bool(seen)
        if seen:
            assert record.y[k, 0] == seen[-1]


def test_merged_keeps_the_last_input():
    record = hw.Record.merged([1.0, 0.0, 1.0], [1.0, 2.0, None], [5.0, 6.0, 7.0])
    assert record.u.ravel().tolist() == [6.0, 7.0]
    assert record.y.ravel().tolist() == [2.0, 1.0]


def test_extended_adds_missing_rows_at_the_median_step():
    record = hw.Record([0.0, 0.1, 0.2, 0.35], np.ones(4), np.zeros(4)).extended(2, u=[1.0, 2.0])
    np.testing.assert_allclose(record.t[-2:], [0.45, 0.55])
    assert not record.seen[-2:].any()
    assert record.u[-2:].ravel().tolist() == [1.0, 2.0]
    assert hw.Record([3.0], [1.0]).extended(1, dt=0.5).t.tolist() == [3.0, 3.5]


def test_steps_begin_with_the_models_own():
    np.testing.assert_allclose(hw.Record([2.0, 2.5, 4.0], np.ones(3)).steps(0.1), [0.1, 0.5, 1.5])


def test_it_is_frozen():
    record = hw.Record([0.0], [1.0])
    with pytest.raises(ValueError, match="read-only"):
        record.y[0] = 2.0
    with pytest.raises(AttributeError):
        record.y = 1
    assert "1 rows" in repr(record)
    assert "<table" in record._repr_html_()


def test_the_caller_keeps_his_arrays():
    y = np.ones(3)
    record = hw.Record([0.0, 1.0, 2.0], y)
    y[0] = 7.0
    assert record.y[0, 0] == 1.0
