"""core/hull.hpp: the bound is never inside what rational arithmetic says, whoever proposes the multipliers."""

import numpy as np
import pytest
from scipy.optimize import linprog
from tests import naive_hull
from tests.core.test_box import chain

from halfwidth import _core


def window(rng, K, n, m, *, interval=0.0, stacked=False):
    (E, A, C, bx, by, *_), x = chain(rng, K, n, m, interval=interval, stacked=stacked)
    reach = np.abs(x).max(axis=1, keepdims=True) * rng.uniform(0.1, 2.0)
    return (E, A, C, bx, by, x - reach, x + reach), x


def asked(parts, c, k, **more):
    E, A, C, bx, by, lo, hi = parts
    return _core.hull_window(
        E, A[0], C[0], *bx, *by, lo, hi, np.ascontiguousarray(c), np.asarray(k, dtype=np.int32),
        A_hi=None if (A[0] == A[1]).all() else A[1], C_hi=None if (C[0] == C[1]).all() else C[1], **more,
    )  # fmt: skip


def exact_rows(parts):
    E, A, C, bx, by, lo, _ = parts
    K, n = lo.shape
    return naive_hull.window_rows((E, E), A, C, bx, by, K - 1, n, by[0].shape[1])


@pytest.mark.parametrize("interval", [0.0, 0.02])
@pytest.mark.parametrize("stacked", [False, True])
def test_any_multipliers_give_the_dual_bound_from_outside(interval, stacked):
    rng = np.random.default_rng(1)
    for case in range(25):
        K, n, m = 1 + case % 4, 1 + case % 3, case % 3
        parts, _ = window(rng, K, n, m, interval=interval, stacked=stacked)
        scale = 10.0 ** rng.integers(-6, 7)
        y = scale * rng.standard_normal((1, K, n + m)) * (rng.random((1, K, n + m)) < 0.8)
        y = np.where(np.concatenate((np.ones((K, n)), np.isfinite(parts[4][0])), axis=1)[None] > 0, y, 0.0)
        c, k = rng.standard_normal((1, n)), int(rng.integers(0, K + 1))
        bound = asked(parts, c, [k], y=y, sweeps=0)[0][0]
        cost = np.zeros((K + 1, n))
        cost[k] = c[0]
        want = naive_hull.dual_bound(exact_rows(parts), parts[5].ravel(), parts[6].ravel(), cost.ravel(), y.ravel())
        assert bound >= want
        assert bound - want <= 1e-11 * (abs(float(want)) + scale * np.abs(parts[6] - parts[5]).max() * K * n)


def test_the_rational_simplex_is_right():
    rng = np.random.default_rng(7)
    for _ in range(10):
        parts, _ = window(rng, 2, 2, 1)
        rows, cost = exact_rows(parts), rng.standard_normal(6)
        M = np.array([[float(a[0]) for a in row] for row, *_ in rows])
        low, high = (np.array([float(row[end]) for row in rows]) for end in (1, 2))
        there = np.isfinite(low)
        found = linprog(
            -cost, np.vstack((M, -M))[np.r_[there, there]], np.r_[high, -low][np.r_[there, there]],
            bounds=np.c_[parts[5].ravel(), parts[6].ravel()], method="highs",
        )  # fmt: skip
        want = naive_hull.largest(rows, parts[5].ravel(), parts[6].ravel(), cost)
        np.testing.assert_allclose(float(want), -found.fun, rtol=1e-7)


def test_two_hundred_small_programs_are_solved_from_outside():
    rng = np.random.default_rng(2)
    solved = 0
    for case in range(220):
        K, n = 1 + case % 3, 1 + (case // 3) % 2
        m = 1
        grid = 8.0 if case % 4 else 1e15  # numbers of few bits, and of all
        (E, A, C, bx, by, lo, hi), _ = window(rng, K, n, m)
        parts = tuple(
            tuple(np.round(np.clip(v, -1e6, 1e6) * grid) / grid if np.isfinite(v).all() else v for v in p)
            if isinstance(p, tuple) else np.round(p * grid) / grid for p in (E, A, C, bx, by, lo, hi)
        )  # fmt: skip
        c = np.vstack((np.eye(n), -np.eye(n)))
        out = asked(parts, c, [K] * (2 * n))
        for p in range(2 * n):
            cost = np.zeros((K + 1, n))
            cost[K] = c[p]
            want = naive_hull.largest(exact_rows(parts), parts[5].ravel(), parts[6].ravel(), cost.ravel())
            if want is None:
                assert out[-1] > 0 or out[0][p] + out[0][(p + n) % (2 * n)] < 0
                continue
            bound = min(out[0][p], float((out[5] if p < n else -out[4])[K, p % n]))
            other = naive_hull.largest(exact_rows(parts), parts[5].ravel(), parts[6].ravel(), (-cost).ravel())
            width = float(want + other)
            assert bound >= want
            assert bound - want <= 1e-6 * width + 1e-13 * abs(float(want)) + 1e-300
            solved += 1
    assert solved >= 300


def test_nothing_is_changed_and_what_is_no_number_is_no_multiplier():
    rng = np.random.default_rng(3)
    parts, x = window(rng, 4, 2, 1)
    before = [np.array(v, copy=True) for v in (parts[5], parts[6])]
    c, k = np.vstack((np.eye(2), -np.eye(2))), [4] * 4
    for junk in (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-320):
        bound, *_ = asked(parts, c, k, y=np.full((4, 4, 3), junk))
        assert not np.isnan(bound).any()
        assert np.all(bound[:2] >= x[4])
        assert np.all(bound[2:] >= -x[4])
    np.testing.assert_array_equal(parts[5], before[0])
    np.testing.assert_array_equal(parts[6], before[1])


def test_an_unbounded_state_that_the_multipliers_touch_gives_no_bound():
    walk, one = np.ones((1, 1)), np.array([[1.0]])
    c, k = np.array([[1.0], [-1.0]]), np.array([1, 1], np.int32)
    for end, fine in ((5.0, True), (np.inf, False)):
        lo, hi = np.array([[-np.inf], [-end]]), np.array([[np.inf], [end]])
        args = (None, walk, walk, -one, one, 2 * one, 3 * one, lo, hi, c, k)
        y = np.array([[[0.0, 1.0]], [[0.0, -1.0]]])
        bound = _core.hull_window(*args, y=y, sweeps=0)[0]
        np.testing.assert_allclose(bound, [3.0, -2.0] if fine else np.inf, rtol=1e-12)
        y[:, :, 0] = 1e-15
        assert np.all(_core.hull_window(*args, y=y, sweeps=0)[0] == np.inf)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 7])
def test_the_solver_is_tight(n):
    """Its bound and the objective of its own feasible point meet, which proves both to be optimal."""
    rng = np.random.default_rng(n)
    for stacked in (False, True):
        parts, x = window(rng, 12, n, 2, stacked=stacked)
        c = np.vstack((np.eye(n), -np.eye(n)))
        bound, _, value, _, lo, hi, iterations, bad = asked(parts, c, [7] * (2 * n))
        assert bad == 0
        assert iterations <= 60
        width = (hi - lo)[7]
        assert np.all(bound - value <= 1e-7 * np.tile(width, 2))
        assert np.all((-bound[n:] <= x[7]) & (x[7] <= bound[:n]))


def test_instruction_sets_agree():
    rng = np.random.default_rng(9)
    parts, _ = window(rng, 8, 3, 2, interval=0.01)
    y = rng.standard_normal((6, 8, 5))
    c, k = np.vstack((np.eye(3), -np.eye(3))), [8] * 6
    here, solved = asked(parts, c, k, y=y)[0], asked(parts, c, k)[0]
    try:
        _core.use_isa(False)
        there, again = asked(parts, c, k, y=y)[0], asked(parts, c, k)[0]
    finally:
        _core.use_isa(True)
    np.testing.assert_array_equal(here, there)
    np.testing.assert_allclose(solved, again, rtol=1e-7)


def test_misfits_are_refused():
    rng = np.random.default_rng(5)
    parts, _ = window(rng, 3, 2, 1)
    with pytest.raises(ValueError, match="out of range"):
        asked(parts, np.eye(2), [0, 4])
    with pytest.raises(ValueError, match="expected"):
        asked(parts, np.eye(3), [0, 0, 0])
    with pytest.raises(ValueError, match="y "):
        asked(parts, np.eye(2), [0, 0], y=np.zeros((1, 3, 3)))
