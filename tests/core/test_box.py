"""core/box.hpp: never inside the exact rational contraction, and hardly outside it."""

import numpy as np
import pytest
from tests import naive_box

from halfwidth import _core


def chain(rng, T, n, m, *, interval, stacked):
    """Return arrays of a random chain that a random trajectory obeys, and the trajectory."""
    lead = (T,) if stacked else ()
    E = np.triu(rng.standard_normal((*lead, n, n)), 1) + np.eye(n)
    A, C = rng.standard_normal((*lead, n, n)), rng.standard_normal((*lead, m, n))
    A[rng.random(A.shape) < 0.3] = 0.0
    C[rng.random(C.shape) < 0.3] = 0.0
    dA, dC = (interval * rng.random(X.shape) * (X != 0) for X in (A, C))
    x = rng.standard_normal((T + 1, n)) * 10.0 ** rng.integers(-3, 4)
    at = (lambda X, t: X[t]) if stacked else (lambda X, t: X)
    mx = np.array([at(E, t) @ x[t + 1] - at(A, t) @ x[t] for t in range(T)]).reshape(T, n)
    my = np.array([at(C, t) @ x[t + 1] for t in range(T)]).reshape(T, m)
    scale = np.abs(x).max()
    q, r = 0.3 * scale * rng.random((T, n)), 0.3 * scale * rng.random((T, m))
    lost = rng.random((T, m)) < 0.3
    by = np.where(lost, -np.inf, my - r), np.where(lost, np.inf, my + r)
    lo, hi = np.full((T + 1, n), -np.inf), np.full((T + 1, n), np.inf)
    lo[0], hi[0] = x[0] - scale, x[0] + scale
    return (E, (A - dA, A + dA), (C - dC, C + dC), (mx - q, mx + q), by, lo, hi), x


def both(parts, sweeps):
    E, A, C, bx, by, lo, hi = parts
    got = _core.box_contract(
        E, A[0], C[0], *bx, *by, lo, hi, sweeps=sweeps, A_hi=None if (A[0] == A[1]).all() else A[1], C_hi=C[1]
    )
    T = len(bx[0])

    def vectors(X):
        ends = (map(naive_box.exact, np.ravel(end)) for end in X)
        return np.array([*zip(*ends, strict=True)], dtype=object).reshape(*X[0].shape, 2).tolist()

    def rows(X):
        return [vectors([end if end.ndim == 2 else end[t] for end in X]) for t in range(T)]

    want = naive_box.contract(rows((E, E)), rows(A), rows(C), vectors(bx), vectors(by), vectors((lo, hi)), sweeps)
    return got, want


@pytest.mark.parametrize("sweeps", [0, 1])
@pytest.mark.parametrize("interval", [0.0, 0.05])
@pytest.mark.parametrize("stacked", [False, True])
def test_exact_contraction_is_inside(sweeps, interval, stacked):
    rng = np.random.default_rng(10 * sweeps + stacked)
    for k in range(12):
        parts, x = chain(rng, k % 5, 1 + k % 4, k % 3, interval=interval, stacked=stacked)
        given = [np.array(a, copy=True) for a in (parts[5], parts[6])]
        (lo, hi, code), want = both(parts, sweeps)
        assert code == 0
        np.testing.assert_array_equal(parts[5], given[0])
        for t, exact in enumerate(want):
            for j, (low, high) in enumerate(exact):
                assert lo[t, j] <= low <= x[t, j] <= high <= hi[t, j]
                scale = 1e-11 * (abs(float(low)) + abs(float(high)) + np.abs(x).max())
                assert lo[t, j] == low or low - lo[t, j] <= scale
                assert hi[t, j] == high or hi[t, j] - high <= scale


def test_more_sweeps_only_tighten():
    rng = np.random.default_rng(3)
    (E, A, C, bx, by, lo, hi), x = chain(rng, 30, 3, 2, interval=0.0, stacked=False)
    for sweeps in (0, 1, 2, 50):
        a, b, code = _core.box_contract(E, A[0], C[0], *bx, *by, lo, hi, sweeps=sweeps)
        assert code == 0
        assert np.all((a <= x) & (x <= b))
        assert np.all((a >= lo) & (b <= hi))
        lo, hi = a, b


@pytest.mark.parametrize("sweeps", [0, 3])
def test_the_row_at_fault_is_named(sweeps):
    rng = np.random.default_rng(4)
    (E, A, C, bx, by, lo, hi), _ = chain(rng, 6, 2, 1, interval=0.0, stacked=False)
    C = np.ones((1, 2))
    by[0][:], by[1][:] = -np.inf, np.inf
    by[0][3], by[1][3] = 1e6, 1e6 + 1
    lo[:], hi[:] = -1e3, 1e3
    lo[4], hi[4] = -10.0, 10.0
    bx = (np.full((6, 2), -1e9), np.full((6, 2), 1e9))
    _, _, code = _core.box_contract(E, A[0], C, *bx, *by, lo, hi, sweeps=sweeps)
    assert code == 1 + 3 * 3 + 2


@pytest.mark.parametrize("scale", [1e-300, 1e-12, 1.0, 1e12, 1e300])
def test_extreme_scales_stay_outside(scale):
    walk = np.ones((1, 1))
    lo, hi = np.array([[-1.0], [-np.inf], [-np.inf]]) * scale, np.array([[1.0], [np.inf], [np.inf]]) * scale
    none = np.zeros((2, 1))
    y = np.array([[0.1], [0.1]]) * scale
    a, b, code = _core.box_contract(None, walk, walk, none, none, y, y, lo, hi, sweeps=4)
    assert code == 0
    assert np.all((a <= y[0]) & (y[0] <= b))
    assert np.all(b - a <= 1e-12 * scale)


def test_overflow_is_infinite_not_wrong():
    huge, none = np.full((1, 1), 1e200), np.zeros((2, 1))
    lo, hi = np.array([[1e200], [-np.inf], [-np.inf]]), np.array([[1e200], [np.inf], [np.inf]])
    a, b, code = _core.box_contract(None, huge, huge, none, none, none - np.inf, none + np.inf, lo, hi, sweeps=0)
    assert code == 0
    assert not np.isnan(a).any()
    assert a[1] <= 1.8e308
    assert np.all(b[1:] == np.inf)


def test_no_width_at_all():
    """Numbers that binary fractions cannot hold: the box of zero width still contains the exact result."""
    A = np.array([[0.1]])
    zero = np.zeros((40, 1))
    one = np.full((41, 1), np.inf)
    lo, hi = -one, one.copy()
    lo[0] = hi[0] = 1.0
    a, b, code = _core.box_contract(None, A, A, zero, zero, zero - np.inf, zero + np.inf, lo, hi, sweeps=0)
    assert code == 0
    exact = naive_box.Fraction(1)
    for t in range(1, 41):
        exact *= naive_box.Fraction(0.1)
        assert a[t, 0] < exact < b[t, 0]
        assert b[t, 0] - a[t, 0] <= 1e-13 * abs(b[t, 0])


def test_instruction_sets_agree():
    rng = np.random.default_rng(8)
    parts, _ = chain(rng, 9, 3, 2, interval=0.02, stacked=True)
    here = both(parts, 1)[0]
    try:
        _core.use_isa(False)
        there = both(parts, 1)[0]
    finally:
        _core.use_isa(True)
    for a, b in zip(here, there, strict=True):
        np.testing.assert_array_equal(a, b)
