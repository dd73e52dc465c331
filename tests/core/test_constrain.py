"""The cuts and projections of core/constrain.hpp beside their naive twins, in the tails and in degenerate shapes."""

import math

import halfwidth._core as _core
import numpy as np
import pytest
from tests import naive_constrain as naive

EP, TRUNCATE, PROJECT, NEAREST = range(4)
inf = math.inf


def run(by, x, P, D, lo, hi):
    """One belief through the core."""
    D = np.atleast_2d(np.asarray(D, dtype=float))
    lo, hi = (np.array(np.broadcast_to(v, len(D)), dtype=float) for v in (lo, hi))
    x, P = np.atleast_1d(np.asarray(x, dtype=float)), np.atleast_2d(np.asarray(P, dtype=float))
    X, S, distance, code, row = _core.constrain_run(by, x[None].copy(), P[None].copy(), D, lo, hi)
    return X[0], S[0], float(distance[0]), int(code[0]), int(row[0])


def drawn(rng, n, m, *, sides=True):
    A = rng.standard_normal((n, n))
    P = A @ A.T + 0.1 * np.eye(n)
    D = rng.standard_normal((m, n))
    x = rng.standard_normal(n)
    inside = rng.standard_normal(n)  # a point that obeys everything
    s = D @ inside
    lo, hi = s - rng.uniform(0.1, 2, m), s + rng.uniform(0.1, 2, m)
    if sides:
        open_ = rng.integers(0, 3, m)
        lo[open_ == 1], hi[open_ == 2] = -inf, inf
    return x, P, D, lo, hi


@pytest.mark.parametrize("n", [1, 2, 3, 4, 7])
def test_one_cut_is_that_of_the_paper(n):
    rng = np.random.default_rng(n)
    for trial in range(20):
        x, P, D, lo, hi = drawn(rng, n, 1, sides=trial % 2 == 0)
        one = naive.simon(x, P, D[0], lo[0], hi[0])
        for by in (EP, TRUNCATE):
            X, S, _, code, _ = run(by, x, P, D, lo, hi)
            assert code == 0
            np.testing.assert_allclose(X, one[0], rtol=1e-12, atol=1e-12 * np.abs(one[0]).max())
            np.testing.assert_allclose(S, one[1], rtol=1e-12, atol=1e-12 * np.abs(P).max())


@pytest.mark.parametrize("by", [EP, TRUNCATE])
def test_a_single_cut_is_exact_far_into_the_tails(by):
    cases = [
        (a, b) for a in (-40.0, -6.0, -1.0, 0.0, 2.0, 8.0, 20.0, 29.9, 35.0) for b in (a + 1e-3, a + 0.5, a + 7, inf)
    ]
    for lo, hi in [*cases, *[(-b, -a) for a, b in cases]]:
        for c in (1.0, 1e-12, 1e12):
            s = math.sqrt(c)
            x, P, distance, _, _ = run(by, 0.0, c, [[1.0]], lo * s, hi * s)
            mean, var = naive.cut(lo, hi)
            assert abs(x[0] / s - mean) <= 1e-10 * max(1.0, abs(mean)), (lo, hi)
            assert abs(P[0, 0] / c - var) <= 1e-10 * var + 1e-14, (lo, hi)
            assert distance == pytest.approx(max(lo, -hi, 0.0), rel=1e-12)


def test_cuts_and_expectation_propagation_equal_their_twins():
    rng = np.random.default_rng(5)
    for n, m in ((2, 2), (3, 3), (3, 6), (4, 6)):
        for _ in range(4):
            x, P, D, lo, hi = drawn(rng, n, m)
            sd = np.sqrt(np.diag(P))
            X, S, _, code, _ = run(EP, x, P, D, lo, hi)
            mean, C = naive.ep(x, P, D, lo, hi, sweeps=60)
            assert code == 0
            # the core stops when a sweep moves less than 1e-5 of a standard deviation
            assert np.abs((X - mean) / sd).max() < 1e-4
            assert np.abs((S - C) / np.outer(sd, sd)).max() < 1e-4
            mean, C = naive.truncate(x, P, D, lo, hi)
            X, S, *_ = run(TRUNCATE, x, P, D, lo, hi)
            np.testing.assert_allclose(S, C, rtol=1e-9, atol=1e-11 * np.abs(P).max())
            if np.all(D @ mean >= lo) and np.all(D @ mean <= hi):
                np.testing.assert_allclose(X, mean, rtol=1e-9, atol=1e-11)


def test_expectation_propagation_does_not_ask_for_an_order():
    rng = np.random.default_rng(6)
    for _ in range(20):
        x, P, D, lo, hi = drawn(rng, 3, 5)
        p = rng.permutation(5)
        one, two = run(EP, x, P, D, lo, hi), run(EP, x, P, D[p], lo[p], hi[p])
        sd = np.sqrt(np.diag(P))
        assert np.abs((one[0] - two[0]) / sd).max() < 1e-4


@pytest.mark.parametrize("by", [PROJECT, NEAREST])
def test_projection_is_the_nearest_feasible_point(by):
    rng = np.random.default_rng(7)
    for n, m in ((1, 1), (2, 3), (3, 4), (4, 6)):
        for _ in range(15):
            x, P, D, lo, hi = drawn(rng, n, m)
            x = 3 * x
            M = P if by == PROJECT else np.eye(n)
            X, S, _, code, _ = run(by, x, P, D, lo, hi)
            expected = naive.project(x, M, D, lo, hi)
            np.testing.assert_allclose(X, expected, atol=1e-8 * (1 + np.abs(expected).max()))
            np.testing.assert_array_equal(S, P)
            assert code == 0


def test_projection_agrees_with_a_solver_on_larger_sets():
    piqp = pytest.importorskip("piqp")
    rng = np.random.default_rng(8)
    for n, m in ((6, 12), (8, 20), (10, 30)):
        for _ in range(5):
            x, P, D, lo, hi = drawn(rng, n, m)
            x = 5 * x
            X, *_, code, _ = run(PROJECT, x, P, D, lo, hi)
            assert code == 0
            W = np.linalg.inv(P)
            solver = piqp.DenseSolver()
            solver.settings.eps_abs = solver.settings.eps_rel = 1e-10
            big = 1e30
            solver.setup(W, -W @ x, None, None, D, np.maximum(lo, -big), np.minimum(hi, big))
            solver.solve()
            z = solver.result.x
            assert np.all(lo - 1e-9 <= D @ X)
            assert np.all(hi + 1e-9 >= D @ X)
            assert (X - x) @ W @ (X - x) <= (z - x) @ W @ (z - x) * (1 + 1e-6)
            np.testing.assert_allclose(X, z, atol=1e-4)


def test_equalities_are_perfect_measurements():
    rng = np.random.default_rng(9)
    for by in range(4):
        for n, m in ((2, 1), (4, 2), (5, 4)):
            x, P, D, *_ = drawn(rng, n, m)
            d = D @ rng.standard_normal(n)
            X, S, _, code, _ = run(by, x, P, D, d, d)
            M = np.eye(n) if by == NEAREST else P
            K = M @ D.T @ np.linalg.inv(D @ M @ D.T)
            np.testing.assert_allclose(X, x + K @ (d - D @ x), rtol=1e-8, atol=1e-9)
            left = np.eye(n) - K @ D
            np.testing.assert_allclose(S, left @ P @ left.T, rtol=1e-7, atol=1e-9 * np.abs(P).max())
            np.testing.assert_allclose(D @ X, d, rtol=1e-9, atol=1e-10)
            assert code == 0


@pytest.mark.parametrize("by", range(4))
def test_equalities_beside_inequalities(by):
    """On the line x0 + x1 = 1 what is left is a Gaussian of one variable."""
    P = np.array([[1.0, 0.3], [0.3, 2.0]])
    X, S, _, code, _ = run(by, [0.0, 0.0], P, [[1, 1], [1, 0]], [1, 0.9], [1, inf])
    assert code == 0
    assert X.sum() == pytest.approx(1.0, abs=1e-14)
    assert X[0] >= 0.9
    if by in (EP, TRUNCATE):
        f, along = np.array([1.0, 1.0]), np.array([1.0, 0.0])
        K = P @ f / (f @ P @ f)
        x, C = K, P - np.outer(K, f @ P)
        x, C = naive.simon(x, C, along, 0.9, inf)
        np.testing.assert_allclose(X, x, rtol=1e-10)
        np.testing.assert_allclose(S, C, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("by", range(4))
def test_a_direction_without_variance_is_left_alone_or_infeasible(by):
    P = np.diag([1.0, 0.0])
    X, S, _, code, _ = run(by, [0.0, 2.0], P, np.eye(2), [0.5, 1.0], [inf, 3.0])
    assert code == 0
    assert X[1] == 2.0
    assert X[0] >= 0.5
    assert S[1, 1] == 0.0
    if by != NEAREST:  # which knows distances, not variances
        X, S, _, code, row = run(by, [0.0, 5.0], P, np.eye(2), [-1.0, 1.0], [inf, 3.0])
        assert (code, row) == (4, 1)
        np.testing.assert_array_equal(X, [0.0, 5.0])
        np.testing.assert_array_equal(S, P)
    # a singular P that no axis shows: x0 = x1 for certain
    P = np.ones((2, 2))
    X, S, _, code, _ = run(by, [0.0, 0.0], P, [[1, 0], [1, -1]], [0.5, -1], [inf, 1])
    assert code == 0
    assert X[0] >= 0.5
    if by != NEAREST:
        assert X[0] == pytest.approx(X[1], abs=1e-14)
        assert run(by, [0.0, 0.0], P, [[1, -1]], [0.5], [inf])[3:] == (4, 0)
        assert run(by, [0.0, 0.0], P, [[1, -1]], [0.5], [0.5])[3:] == (4, 0)


@pytest.mark.parametrize("by", range(4))
def test_what_contradicts_itself_names_a_row(by):
    x, P = np.zeros(2), np.eye(2)
    for D, lo, hi, rows in (
        ([[1, 0], [1, 0]], [1, -inf], [inf, 0], (1,)),  # the same direction twice
        ([[1, 0], [-2, 0]], [1, 1], [inf, inf], (1,)),
        ([[1, 0], [0, 1], [1, 1]], [1, 1, -inf], [inf, inf, 1.5], (0, 1, 2)),
        ([[1, 0], [1, 0]], [1, 2], [1, 2], (1,)),  # equalities
        ([[1, 0], [0, 1], [1, 1]], [1, 1, 3], [1, 1, 3], (0, 1, 2)),
        ([[0, 0]], [1], [2], (0,)),
    ):
        X, S, _, code, row = run(by, x, P, D, np.array(lo, dtype=float), np.array(hi, dtype=float))
        assert code == 4, (D, lo, hi)
        assert row in rows
        np.testing.assert_array_equal(X, x)
        np.testing.assert_array_equal(S, P)


@pytest.mark.parametrize("by", range(4))
def test_saying_the_same_twice_changes_nothing(by):
    rng = np.random.default_rng(11)
    for _ in range(10):
        x, P, D, lo, hi = drawn(rng, 3, 2, sides=False)
        once = run(by, x, P, D, lo, hi)
        turned = np.vstack([D, D[:1], -3 * D[1:], np.zeros((1, 3)), D[:1]])
        again = run(by, x, P, turned, np.r_[lo, lo[0], -3 * hi[1], 0, -inf], np.r_[hi, hi[0] + 5, -3 * lo[1], 0, inf])
        np.testing.assert_allclose(again[0], once[0], rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(again[1], once[1], rtol=1e-12, atol=1e-13)
    twice = run(by, x, P, np.vstack([D[:1], D[:1]]), [0.1, 0.1], [0.1, 0.1 + 1e-17])
    assert twice[3] == 0


@pytest.mark.parametrize("by", range(4))
@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_units_do_not_matter(by, scale):
    rng = np.random.default_rng(12)
    s = np.array([1.0, scale, 1.0])
    for _ in range(10):
        x, P, D, lo, hi = drawn(rng, 3, 4)
        one = run(by, 2 * x, P, D, lo, hi)
        if by == NEAREST:
            s = np.full(3, scale)
        two = run(by, 2 * x * s, P * np.outer(s, s), D / s, lo, hi)
        np.testing.assert_allclose(two[0] / s, one[0], rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(two[1] / np.outer(s, s), one[1], rtol=1e-6, atol=1e-8)
        assert one[3] == two[3]


@pytest.mark.parametrize("by", range(4))
def test_far_away_is_said_and_still_feasible(by):
    P = np.array([[1.0, 0.9], [0.9, 1.0]])
    for far in (31.0, 1e3, 1e6, 1e9, 1e15):
        X, S, distance, code, row = run(by, [0.0, 0.0], P, [[0, 1], [1, 0]], [-1, far], [1, inf])
        assert (code, row) == (2, 1)
        assert distance == pytest.approx(far)
        assert np.isfinite(X).all()
        assert np.isfinite(S).all()
        assert X[0] >= far
        assert -1 <= X[1] <= 1
        assert np.linalg.eigvalsh(S)[0] >= -1e-12


@pytest.mark.parametrize("by", range(4))
def test_answers_are_feasible_symmetric_and_not_wider(by):
    rng = np.random.default_rng(13)
    for _ in range(300):
        n, m = int(rng.integers(1, 6)), int(rng.integers(1, 9))
        x, P, D, lo, hi = drawn(rng, n, m)
        if rng.random() < 0.3:  # singular
            w, T = np.linalg.eigh(P)
            w[0] = 0.0
            P = (T * w) @ T.T
            P = 0.5 * (P + P.T)
        X, S, distance, code, _ = run(by, x * 10.0 ** rng.integers(-1, 2), P, D, lo, hi)
        assert np.isfinite(X).all()
        assert np.isfinite(S).all()
        assert distance >= 0
        np.testing.assert_array_equal(S, S.T)
        assert np.linalg.eigvalsh(S)[0] >= -1e-12 * np.abs(P).max()
        if code == 4:
            continue
        slack = 1e-9 * (1 + np.abs(X).max())
        assert np.all(lo - slack <= D @ X)
        assert np.all(hi + slack >= D @ X)
        if by != NEAREST:
            assert np.linalg.eigvalsh(P - S)[0] >= -1e-9 * np.abs(P).max()


@pytest.mark.parametrize("by", [EP, TRUNCATE, PROJECT])
def test_ill_conditioned_beliefs_end_inside_or_say_so(by):
    """Singular or nearly singular P, thin slabs, equalities: a good code means feasible, whatever P allows."""
    rng = np.random.default_rng(14)
    kinds = {0: 0, 4: 0}
    for _ in range(1500):
        n, m = int(rng.integers(2, 4)), int(rng.integers(1, 5))
        B = rng.standard_normal((n, n)) * 10.0 ** rng.uniform(-6, 0, n)
        if rng.random() < 0.5:
            B[:, -1] = 0.0
        P, D, inside = B @ B.T, rng.standard_normal((m, n)), rng.standard_normal(n)
        s, width = D @ inside, 10.0 ** rng.uniform(-8, 1, m)
        lo, hi = s - width * rng.random(m), s + width * rng.random(m)
        lo[rng.random(m) < 0.3], hi[rng.random(m) < 0.3] = -inf, inf
        x = inside + (B @ rng.standard_normal(n) if rng.random() < 0.5 else rng.standard_normal(n))
        X, S, _, code, row = run(by, x, P, D, lo, hi)
        kinds[code] = kinds.get(code, 0) + 1
        assert np.isfinite(X).all()
        assert np.linalg.eigvalsh(S)[0] >= -1e-12 * np.abs(P).max()
        if code == 4:
            assert 0 <= row < m
            np.testing.assert_array_equal(X, x)
        else:
            out = np.maximum(lo - D @ X, D @ X - hi)
            slack = 1e-7 * np.sqrt(np.einsum("ij,jk,ik->i", D, P, D).clip(0)) + 1e-11 * (1 + np.abs(D) @ np.abs(X))
            assert np.all(out <= slack)
    assert min(kinds[0], kinds[4]) > 100


@pytest.mark.parametrize("by", [EP, TRUNCATE])
def test_narrow_slabs_are_nearly_equalities(by):
    P = np.array([[1.0, 0.5], [0.5, 2.0]])
    exact, C, *_ = run(by, [0.0, 0.0], P, [[1, 1]], [1], [1])
    for width in (1e-4, 1e-7, 1e-10, 1e-13, 1e-16):
        X, S, _, code, _ = run(by, [0.0, 0.0], P, [[1, 1], [1, -3]], [1 - width, -90], [1 + width, 90])
        assert code == 0
        np.testing.assert_allclose(X, exact, atol=max(2 * width, 1e-4))
        np.testing.assert_allclose(S, C, atol=max(10 * width, 1e-3))
        assert np.linalg.eigvalsh(S)[0] >= -1e-13


def test_a_belief_that_is_not_finite_is_left_alone():
    for x, P in (([math.nan], [[1.0]]), ([0.0], [[inf]])):
        X, S, _, code, _ = run(EP, x, P, [[1.0]], 0.0, 1.0)
        np.testing.assert_array_equal(X, x)
        np.testing.assert_array_equal(S, P)
        assert code == 0


def boxes(count, ridge, seed=0):
    """Random boxes with an acceptance of at least .01, and the exact moments in them; a small ridge correlates more."""
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        A = rng.standard_normal((3, 3))
        P = A @ A.T + ridge * np.eye(3)
        sd = np.sqrt(np.diag(P))
        x = sd * rng.standard_normal(3)
        lo, hi = -sd * rng.uniform(0.3, 2, 3), sd * rng.uniform(0.3, 2, 3)
        mean, C, mass = naive.box_moments(x, P, lo, hi)
        if mass >= 0.01:
            found.append((x, P, lo, hi, mean, C))
    return found


def ep_errors(ridge):
    """Error of the mean in standard deviations and of the covariance, relative, of 20 boxes each."""
    found = []
    for x, P, lo, hi, mean, C in boxes(20, ridge):
        X, S, *_ = run(EP, x, P, np.eye(3), lo, hi)
        found.append((np.abs((X - mean) / np.sqrt(np.diag(C))).max(), np.linalg.norm(S - C) / np.linalg.norm(C)))
    return np.array(found)


def test_expectation_propagation_is_near_the_truth_in_boxes():
    errors = ep_errors(1.0)
    assert errors[:, 0].max() <= 0.02
    assert errors[:, 1].max() <= 0.05
    # nearly singular covariances are what it finds hardest: some of them exceed these limits
    errors = ep_errors(0.1)
    assert np.quantile(errors[:, 0], 0.9) <= 0.02
    assert np.quantile(errors[:, 1], 0.9) <= 0.08
    assert errors.max() <= 0.2


def test_the_exact_moments_agree_with_sampling():
    x, P, lo, hi, mean, C = boxes(1, 0.5, seed=3)[0]
    rng = np.random.default_rng(0)
    z = rng.multivariate_normal(x, P, 400_000, method="cholesky")
    z = z[((z >= lo) & (z <= hi)).all(axis=1)]
    assert np.abs((z.mean(axis=0) - mean) / np.sqrt(np.diag(C) / len(z))).max() < 4
    np.testing.assert_allclose(np.cov(z.T), C, atol=6 * np.abs(C).max() / math.sqrt(len(z)))
