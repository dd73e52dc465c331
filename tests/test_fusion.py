"""The scalar estimator for mixed noise: closed forms against sampling, quadrature and the border cases."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from halfwidth import fusion
from halfwidth.errors import BadShape, BadValue
from halfwidth.fusion import Source, fuse

LAMBDA = np.linspace(-0.5, 0.5, 11)


def case(seed):
    """Two random sources whose sets meet with a fair probability, and lambda."""
    rng = np.random.default_rng(seed)
    x = Source(rng.normal(), rng.random() * 2, rng.random() * 2 + 0.01)
    y = Source(rng.normal() * 1.5, rng.random() * 2, rng.random() * 2 + 0.01)
    return x, y, float(rng.uniform(-0.5, 0.5))


@pytest.mark.parametrize("seed", range(20))
def test_mean_and_variance_against_sampling(seed):
    """Equations (29), (30) within four standard errors of 1e6 draws, kept where the two sets meet."""
    x, y, lam = case(seed)
    rng = np.random.default_rng(100 + seed)
    a, b = (rng.normal(s.m, np.sqrt(s.S), 1_000_000) for s in (x, y))
    w = fusion.weights(x.E, y.E, lam)
    z = (w.x * a + w.y * b)[np.abs(a - b) <= np.sqrt(x.E) + np.sqrt(y.E)]
    found = fuse(x, y, lam)
    assert abs(z.mean() - found.m) <= 4 * z.std() / np.sqrt(len(z))
    fourth = np.sqrt(np.mean((z - z.mean()) ** 4) - z.var() ** 2)
    assert abs(z.var() - found.S) <= 4 * fourth / np.sqrt(len(z))


@pytest.mark.parametrize("seed", range(20))
def test_density(seed):
    """It integrates to one, its moments are the closed ones, and the paper's Q_z lies where it must."""
    x, y, lam = case(seed)
    found = fuse(x, y, lam)
    z, h = np.linspace(found.m - 14 * np.sqrt(found.S), found.m + 14 * np.sqrt(found.S), 20_001, retstep=True)
    f = fusion.density(x, y, lam, z)
    assert f.sum() * h == pytest.approx(1.0, abs=1e-5)
    assert (f @ z) * h == pytest.approx(float(found.m), abs=1e-4)
    assert (f @ z**2) * h - ((f @ z) * h) ** 2 == pytest.approx(float(found.S), abs=1e-4)
    w = fusion.weights(x.E, y.E, lam)
    s0, c, S = w.x**2 * x.S + w.y**2 * y.S, w.x * x.S - w.y * y.S, x.S + y.S
    Q = (s0 - found.S) / c**2
    assert -1e-12 <= Q <= (1 + 1e-12) / S
    assert float(found.S) >= 0


@pytest.mark.parametrize("lam", [-0.5, 0.5])
def test_density_where_one_source_has_no_weight(lam):
    """The paper divides by w_x; the density does not need it."""
    x, y = Source(0.2, 1.0, 0.5), Source(-0.4, 0.7, 0.8)
    found = fuse(x, y, lam)
    z, h = np.linspace(-12, 12, 40_001, retstep=True)
    f = fusion.density(x, y, lam, z)
    assert f.sum() * h == pytest.approx(1.0, abs=1e-6)
    assert (f @ z) * h == pytest.approx(float(found.m), abs=1e-6)


def paper_term(x, y, w, m_g, S_g):
    """Means and variance of one Gaussian of the sum in the form that is printed, eqs. (22) and (23)."""
    S = S_g + x.S + y.S
    mean = (
        S_g * (w.x * x.m + w.y * y.m) + x.S * (w.x * (m_g + y.m) + w.y * y.m) + y.S * (w.y * (-m_g + x.m) + w.x * x.m)
    )
    return mean / S, (S_g * (w.x**2 * x.S + w.y**2 * y.S) + (w.x + w.y) ** 2 * x.S * y.S) / S


@pytest.mark.parametrize("seed", range(10))
def test_terms_of_the_sum_are_the_printed_ones(seed):
    x, y, lam = case(seed)
    L, c = 4, 0.85
    found = fusion.fuse_sums(x, y, lam, L=L, c=c)
    B, w = np.sqrt(x.E) + np.sqrt(y.E), fusion.weights(x.E, y.E, lam)
    for i, mean in zip(range(-L, L + 1), found.m, strict=True):
        want, variance = paper_term(x, y, w, 2 * B * i / (2 * L + 1), (c * B / (2 * L + 1)) ** 2)
        assert mean == pytest.approx(float(want), abs=1e-12)
        assert float(found.S) == pytest.approx(float(variance), abs=1e-12)
    i = np.arange(-L, L + 1)
    off = x.m - y.m - 2 * B * i / (2 * L + 1)
    weight = np.exp(-0.5 * off**2 / (x.S + y.S + (c * B / (2 * L + 1)) ** 2))
    np.testing.assert_allclose(found.weight, weight / weight.sum(), atol=1e-12)


def test_the_sum_comes_closer_with_the_square_of_its_terms():
    worst = {}
    for seed in range(6):
        x, y, lam = case(seed)
        exact = fuse(x, y, lam)
        z, h = np.linspace(exact.m - 12 * np.sqrt(exact.S), exact.m + 12 * np.sqrt(exact.S), 4001, retstep=True)
        f = fusion.density(x, y, lam, z)
        for L in (3, 10, 40, 160):
            found = fusion.fuse_sums(x, y, lam, L=L)
            worst[L] = max(worst.get(L, 0.0), 0.5 * np.abs(found.density(z) - f).sum() * h)
    assert worst[10] <= 0.01
    assert worst[40] <= 0.001
    assert worst[160] <= 1e-4
    assert worst[10] / worst[40] > 4
    assert fusion.best_spread(3) == pytest.approx(0.82, abs=0.03)
    assert fusion.best_spread(10) == pytest.approx(0.90, abs=0.03)


def test_sums_one_after_the_other():
    """All terms kept agree with mean and variance alone; the heaviest alone lose the tails and with them variance."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        every = few = exact = Source(0.3, 0.5, 1.0)
        for _ in range(3):
            y = Source(rng.normal(0, 0.7), 0.4, 0.6)
            every, few = fusion.fuse_sums(every, y, 0.1, L=6), fusion.fuse_sums(few, y, 0.1, L=6, terms=40)
            exact = fuse(exact, y, 0.1)
        assert len(every.weight) == 13**3
        assert len(few.weight) == 40
        assert every.weight.sum() == pytest.approx(1.0)
        assert few.weight.sum() == pytest.approx(1.0)
        assert every.mean == pytest.approx(float(exact.m), abs=2e-3)
        assert every.variance == pytest.approx(float(exact.S), abs=2e-3)
        assert abs(few.mean - every.mean) < 0.1
        assert 0.7 * every.variance < few.variance < every.variance
        assert pytest.approx(float(exact.E)) == every.E


@pytest.mark.parametrize("tiny", [0.0, 1e-28])
def test_without_sets_it_is_the_kalman_filter(tiny):
    """Equations (33) to (36) for every lambda."""
    x, y = Source(0.7, tiny, 0.5), Source(-1.1, tiny, 2.0)
    for lam in [*LAMBDA, None]:
        found = fuse(x, y, lam)
        assert found.m == pytest.approx((2.0 * 0.7 + 0.5 * -1.1) / 2.5, abs=1e-12)
        assert float(found.S) == pytest.approx(1 / (1 / 0.5 + 1 / 2.0), abs=1e-12)
        assert float(found.E) <= tiny * (1 + 1e-12)


def test_without_gaussian_errors_it_is_the_set_estimator():
    """Equations (37), (38), and (8) to (11)."""
    x, y = Source(0.7, 1.0, 0.0), Source(-0.4, 0.5, 0.0)
    for lam in LAMBDA:
        found, w = fuse(x, y, lam), fusion.weights(x.E, y.E, lam)
        assert found.m == pytest.approx(w.x * 0.7 - w.y * 0.4, abs=1e-12)
        assert float(found.S) == 0
        assert float(found.E) == pytest.approx(1 / ((0.5 - lam) / 1.0 + (0.5 + lam) / 0.5), rel=1e-12)
        smaller = fusion.fuse_sets(x, y, lam)
        assert smaller.m == pytest.approx(float(found.m), abs=1e-12)
        assert smaller.E <= found.E
        lo, hi = smaller.interval()
        assert lo <= max(0.7 - 1.0, -0.4 - np.sqrt(0.5)) + 1e-12  # it holds the intersection
        assert hi >= min(0.7 + 1.0, -0.4 + np.sqrt(0.5)) - 1e-12


def test_one_exact_source():
    for lam in LAMBDA:
        found = fuse(Source(0.7, 0.0, 0.5), Source(-1.1, 1.0, 2.0), lam)
        assert float(found.E) == 0
        found = fuse(Source(0.7, 0.0, 0.0), Source(0.1, 1.0, 0.0), lam)
        assert (found.m, found.E, found.S) == (pytest.approx(0.7), 0, 0)
    found = fuse(Source(0.7, 0.0, 0.0), Source(0.7, 0.0, 0.0))
    assert (found.m, found.E, found.S) == (pytest.approx(0.7), 0, 0)


@given(st.integers(0, 2**31), st.floats(-0.5, 0.5))
def test_the_set_never_gets_smaller_than_the_smallest_source(seed, lam):
    rng = np.random.default_rng(seed)
    E = rng.random(2) * 10.0 ** rng.integers(-8, 8, 2)
    found = fuse(Source(0.0, E[0], 1.0), Source(0.0, E[1], 1.0), lam)
    assert E.min() * (1 - 1e-12) <= found.E <= E.max() * (1 + 1e-12)


@pytest.mark.parametrize("measure", ["width", "square", "set", "variance", lambda E, S: np.sqrt(E + S)])
def test_lambda_is_the_best(measure):
    judge = {
        "width": lambda E, S: np.sqrt(E) + 3 * np.sqrt(S), "square": lambda E, S: E + 9 * S, "set": lambda E, S: E,
        "variance": lambda E, S: S,
    }.get(measure, measure)  # fmt: skip
    ends = 0
    for seed in range(12):
        x, y, _ = case(seed)
        found = fuse(x, y, measure=measure)
        at = [judge(o.E, o.S) for o in (fuse(x, y, lam) for lam in np.linspace(-0.5, 0.5, 201))]
        assert judge(found.E, found.S) <= min(at) * (1 + 1e-9)
        ends += abs(float(found.lam)) == 0.5
    assert measure not in ("set", "width") or ends  # the least value is at an end now and then


def test_extreme_numbers_stay_finite():
    for scale in (1e-150, 1e-12, 1.0, 1e12, 1e150):
        for off in (0.0, 1.0, 1e3):
            found = fuse(Source(off * scale, scale**2, 0.25 * scale**2), Source(0.0, 0.5 * scale**2, scale**2))
            assert np.isfinite([found.m, found.E, found.S]).all()
            assert float(found.S) >= 0


def test_bad_input_is_named():
    with pytest.raises(BadValue, match="`E`"):
        Source(0.0, -1.0, 1.0)
    with pytest.raises(BadValue, match="`lam`"):
        fuse(Source(0, 1, 1), Source(0, 1, 1), 0.6)
    with pytest.raises(BadValue, match="`measure`"):
        fuse(Source(0, 1, 1), Source(0, 1, 1), measure="area")
    with pytest.raises(BadShape, match="shapes"):
        fuse(Source(np.zeros(2), 1, 1), Source(np.zeros(3), 1, 1))
    with pytest.raises(BadValue, match="meet"):
        fusion.fuse_sets(Source(0, 1, 0), Source(9, 1, 0))
    with pytest.raises(BadValue, match="no density"):
        fusion.density(Source(0, 1, 0), Source(0, 1, 0), 0.0, 0.0)
    with pytest.raises(BadShape, match="`y`"):
        fusion.recursion(np.zeros((0, 2)), 1.0, 1.0)
