"""The kernels of core/sets.hpp beside textbook twins and exact linear programs."""

import halfwidth._core as _core
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from tests import naive_sets as naive

import halfwidth as hw


def start(kind, n, m, generators=0, constraints=0):
    return _core.sets_start(kind, n, m, generators, constraints)


def run(kind, A, C, bx, by, lo, hi, state, generators=0, constraints=0):
    return _core.sets_run(
        kind, None, A, C, bx[0], bx[1], by[0], by[1], lo, hi, 0.5 * (lo + hi), state, generators, constraints
    )  # fmt: skip


def system(rng, n=3, m=2):
    A = rng.normal(size=(n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    return A, rng.normal(size=(m, n)), rng.uniform(0.01, 0.2, n), rng.uniform(0.2, 0.5, m)


def columns(n, m, generators):
    return generators + 3 * n + 2 * m


@pytest.mark.parametrize("seed", range(5))
def test_a_zonotope_moves_and_gains_as_in_the_book(seed):
    rng = np.random.default_rng(seed)
    A, C, q, r = system(rng)
    n, m, most = 3, 2, 40
    c, G = rng.normal(size=n), rng.normal(size=(n, n))
    state, cap = start("zonotope", n, m, most), columns(n, m, most)
    state[:2], state[2 : 2 + n] = (n, 0), c
    state[2 + n :].reshape(n, cap)[:, :n] = G
    lo, hi = np.full(n, -1e3), np.full(n, 1e3)  # a box so wide that only the zonotope speaks
    for _ in range(2):
        shift = rng.normal(size=n)
        before = c, G
        c, G = naive.zonotope_move(c, G, A, shift, q)
        y = C @ c + 0.1 * rng.normal(size=m)
        for i in range(m):
            c, G = naive.zonotope_gain(c, G, C[i], y[i], r[i])
        assert before[1].shape[1] < G.shape[1]
        bx = (shift - q)[None], (shift + q)[None]
        out = run("zonotope", A, C, bx, ((y - r)[None], (y + r)[None]), lo, hi, state, most)
        state = out[3]
        count = int(state[0])
        found = state[2 + n :].reshape(n, cap)[:, :count]
        np.testing.assert_allclose(state[2 : 2 + n], c, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(found[:, : G.shape[1]], G, rtol=1e-11, atol=1e-11)
        assert np.all(np.abs(found[:, G.shape[1] :]) < 1e-12)  # what rounding may have done
        G = found  # the twin carries these too
        half = np.abs(G).sum(axis=1)
        inside = (out[0][1] >= c - half - 1e-9) & (out[1][1] <= c + half + 1e-9)
        assert inside.all()


@pytest.mark.parametrize("seed", range(8))
def test_an_ellipsoid_takes_the_weight_of_least_trace_and_contains(seed):
    rng = np.random.default_rng(seed)
    n = 3
    h = rng.normal(size=(1, n))
    X, c = n * np.eye(n), np.zeros(n)
    state = start("ellipsoid", n, 1)
    state[1], state[2 + n :] = 0, X.ravel()
    lo, hi = np.full(n, -1e3), np.full(n, 1e3)  # a box so wide that only the ellipsoid speaks
    half = np.abs(h[0]).sum()
    z, r = 0.7 * half * rng.uniform(-1, 1), 0.2 * half
    zero = np.zeros((1, n))
    strip = np.array([[z - r]]), np.array([[z + r]])
    out = run("ellipsoid", np.eye(n), h, (zero, zero), strip, lo, hi, state)
    c1, X1 = out[3][2 : 2 + n], out[3][2 + n :].reshape(n, n)
    best = minimize_scalar(
        lambda a: np.trace(naive.ellipsoid_fold(c, X, h[0], z, r, a)[1]), bounds=(1e-6, 1 - 1e-9), method="bounded"
    )
    assert np.trace(X1) <= best.fun * (1 + 1e-4)
    points = rng.normal(size=(4000, n))
    points *= (rng.random(4000) ** (1 / n) / np.linalg.norm(points, axis=1))[:, None]
    points = points @ np.linalg.cholesky(X).T
    points = points[np.abs(points @ h[0] - z) <= r]
    inside = ((points >= out[0][1]) & (points <= out[1][1])).all(axis=1)
    assert len(points) > 30
    assert inside.all()
    d = points - c1
    assert np.all(np.einsum("ki,ij,kj->k", d, np.linalg.inv(X1), d) <= 1 + 1e-9)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), nx=st.integers(1, 3), ny=st.integers(1, 2))
def test_a_constrained_zonotope_that_forgets_nothing_is_the_exact_set(seed, nx, ny):
    rng = np.random.default_rng(seed)
    A, C, q, r = system(rng, nx, ny)
    model = hw.Linear(A, None, C, hw.Uniform(q), hw.Uniform(r), hw.Box(-np.ones(nx), np.ones(nx)))
    _, record = hw.simulate(model, T=7, seed=seed)
    record = hw.Record(record.t, np.where(rng.random(record.y.shape) < 0.2, np.nan, record.y))
    lo, hi = hw.estimate(model, record, hw.ConstrainedZonotopeFilter(40, 40, rounds=300)).check().interval()
    for k in (1, 4, 6):
        low, high = naive.exact_box(model, record, k)
        near = 5e-3 * (high - low)
        assert np.all((low - near <= lo[k]) & (lo[k] <= low + 1e-7))
        assert np.all((high + near >= hi[k]) & (hi[k] >= high - 1e-7))


def test_both_instruction_sets_contain_the_same():
    rng = np.random.default_rng(0)
    A, C, q, r = system(rng)
    model = hw.Linear(A, None, C, hw.Uniform(q), hw.Uniform(r), hw.Box(-np.ones(3), np.ones(3)))
    truth, record = hw.simulate(model, T=40, seed=0)
    had = _core.isa() == "avx2"
    try:
        for avx2 in (False, True):
            if not _core.use_isa(avx2):
                continue
            for method in (
                hw.ZonotopeFilter(),
                hw.ConstrainedZonotopeFilter(),
                hw.EllipsoidFilter(),
                hw.IntervalFilter(),
            ):
                lo, hi = hw.estimate(model, record, method).check().interval()
                assert np.all((lo <= truth.x) & (truth.x <= hi))
    finally:
        _core.use_isa(had)


def test_arguments_are_judged():
    one = np.zeros((1, 2))
    good = dict(A=np.eye(2), C=np.eye(2), bx=(one, one), by=(one, one), lo=np.zeros(2), hi=np.zeros(2))
    with pytest.raises(ValueError, match="kind"):
        start("sphere", 2, 2)
    with pytest.raises(ValueError, match="generators"):
        start("zonotope", 2, 2, 1)
    with pytest.raises(ValueError, match="state"):
        run("zonotope", **good, state=np.zeros(3), generators=10)
    with pytest.raises(ValueError, match="matrices"):
        run("interval", **{**good, "A": np.eye(3)}, state=start("interval", 2, 2))
    for k, value in ((0, 1e9), (0, np.nan), (1, 5.0), (1, np.nan)):
        state = start("constrained", 2, 2, 10, 4)
        state[:2] = 2, 0
        state[k] = value
        with pytest.raises(ValueError, match="sizes allow"):
            run("constrained", **good, state=state, generators=10, constraints=4)
