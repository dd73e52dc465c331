"""core/noise.hpp against quadrature, and at its edges."""

import itertools
import math

import numpy as np
import pytest
from tests import naive_noise as naive

from halfwidth import _core


def truncated(*numbers):
    return [float(v[0]) for v in _core.noise_truncated(*(np.array([float(q)]) for q in numbers))]


def boxes(rng, kind):
    """Return mu, c, lo, hi of one random box."""
    mu, c, lo = 3 * rng.normal(), 10 ** rng.uniform(-2, 2), 3 * rng.normal()
    if kind == "any":
        return mu, c, lo, lo + 10 ** rng.uniform(-3, 1.5)
    if kind == "narrow":
        return 0.0, 1.0, lo, lo + 10 ** rng.uniform(-9, -1)
    if kind == "tail":
        a = 10 ** rng.uniform(0, 6)
        return 0.0, 1.0, a, a + 10 ** rng.uniform(-6, 3) / a
    if kind == "below":
        a = 10 ** rng.uniform(0, 6)
        return 0.0, 1.0, -a - 10 ** rng.uniform(-6, 3) / a, -a
    return (mu, c, lo, math.inf) if kind == "above lo" else (mu, c, -math.inf, lo)


@pytest.fixture(params=["base", "avx2", "avx512"])
def isa(request):
    """Each instruction set that this machine has, in turn."""
    wide = _core.wide()
    if not _core.use_isa(request.param != "base") or not _core.use_wide(request.param == "avx512"):
        pytest.skip(f"no {request.param} here")
    yield request.param
    _core.use_isa(True)
    _core.use_wide(wide)


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("kind", ["any", "narrow", "tail", "below", "above lo", "below hi"])
def test_a_box_equals_quadrature(kind):
    rng = np.random.default_rng(3)
    for _ in range(150):
        mu, c, lo, hi = boxes(rng, kind)
        got, want = truncated(mu, c, lo, hi), naive.truncated(mu, c, lo, hi)
        sd = math.sqrt(want[2])
        assert got[0] == pytest.approx(want[0], rel=1e-13, abs=1e-13)
        assert abs(got[1] - want[1]) < 1e-10 * sd + 4e-16 * abs(want[1])
        assert got[2] == pytest.approx(want[2], rel=1e-10)
        density = want[3] + want[4]
        if 1e-300 < density < math.inf:
            assert abs(got[3] - want[3]) + abs(got[4] - want[4]) < 1e-12 * density
        if math.isfinite(hi - lo):
            assert got[5] == pytest.approx(want[5], rel=1e-12, abs=1e-12)


def test_lanes_do_not_meet():
    rng = np.random.default_rng(1)
    cases = np.array([boxes(rng, "any") for _ in range(23)])
    together = _core.noise_truncated(*np.ascontiguousarray(cases.T))
    for k, case in enumerate(cases):
        np.testing.assert_allclose([float(v[k]) for v in together], truncated(*case), rtol=1e-10)


EDGES = [
    (0.0, 0.0, -1.0, 1.0),  # no variance, inside
    (0.0, 0.0, 1.0, 2.0),  # no variance, outside
    (1.0, 0.0, 1.0, 1.0),  # a point on a point
    (5.0, 1.0, 5.0, 5.0),  # no width
    (0.0, 1.0, 30.0, 31.0),
    (0.0, 1.0, 1e6, 2e6),
    (0.0, 1.0, -math.inf, -1e6),
    (0.0, 1.0, -math.inf, math.inf),
    (0.0, math.inf, -1.0, 2.0),
    (0.0, 1e-300, 1e300, math.inf),
    (1e9, 1e-18, 1e9 - 1, 1e9 + 1),
    (0.0, 1e300, -1e-300, 1e-300),
    (0.0, 1.0, -1e-300, 1e308),
]


@pytest.mark.parametrize("case", EDGES, ids=str)
def test_edges_stay_in_the_box(case):
    _, c, lo, hi = case
    log_z, mean, var, at_lo, at_hi, log_mean = truncated(*case)
    assert lo <= mean <= hi
    assert 0.0 <= var <= max(c, 0.0)
    assert log_z <= 1e-15
    assert at_lo >= 0
    assert at_hi >= 0
    assert not math.isnan(log_mean)


def test_limits():
    log_z, mean, var, *_ = truncated(0, 1, 1e6, math.inf)  # exponential of rate 1e6
    assert mean - 1e6 == pytest.approx(1e-6, rel=1e-3)
    assert var == pytest.approx(1e-12, rel=1e-11)
    assert log_z == pytest.approx(-0.5e12, rel=1e-10)
    _, mean, var, *_ = truncated(0, 1, 2.0, 2.0 + 1e-6)  # uniform
    assert mean - 2 == pytest.approx(5e-7, rel=1e-5)
    assert var == pytest.approx(1e-12 / 12, rel=1e-11)
    assert truncated(0.3, 2.0, -math.inf, math.inf)[:3] == [0.0, 0.3, pytest.approx(2.0)]


KINDS = ["gaussian", "uniform", "uniform_gaussian", "contaminated", "maybe_lost"]


def tilted(kind, mu, c, s, R, eps, extra):
    return [float(v[0]) for v in _core.noise_tilted(kind, *(np.array([float(q)]) for q in (mu, c, s, R, eps, extra)))]


def log_noise(kind, s, R, eps, extra):
    """Return log f of a residual."""
    from scipy.special import log_ndtr, ndtr

    def gauss(z, v):
        return -0.5 * z * z / v - 0.5 * math.log(2 * math.pi * v)

    def box(z):
        """Uniform plus Gaussian, from the nearer tail."""
        sd, d = math.sqrt(R), np.abs(z)
        near, off = (d - s) / sd, (d + s) / sd
        with np.errstate(divide="ignore"):
            far = log_ndtr(-near) + np.log1p(-np.exp(log_ndtr(-off) - log_ndtr(-near)))
            return np.where(near > 3, far, np.log(ndtr(off) - ndtr(near))) - math.log(2 * s)

    if kind == "gaussian":
        return lambda z: gauss(z, R)
    if kind == "uniform":
        return lambda z: np.where(np.abs(z) < s, -math.log(2 * s), -np.inf)
    if kind == "uniform_gaussian":
        return box
    if kind == "contaminated":
        return lambda z: np.logaddexp(math.log(1 - eps) + box(z), math.log(eps) + gauss(z, (extra * s) ** 2 + R))
    return lambda z: np.logaddexp(math.log(1 - eps) + box(z), math.log(eps) + extra)


@pytest.mark.parametrize("kind", KINDS)
def test_a_noise_equals_a_fine_sum(kind):
    rng = np.random.default_rng(5)
    for _ in range(12):
        mu, c = 1.5 * rng.normal(), 10 ** rng.uniform(-1, 1)
        s, R, eps = rng.uniform(0.3, 2), rng.uniform(0.05, 1), rng.uniform(0.01, 0.5)
        extra = rng.uniform(3, 8) if kind == "contaminated" else rng.uniform(-4, 0)
        reach = mu - 12 * math.sqrt(c), mu + 12 * math.sqrt(c)
        reach = (-s, s) if kind == "uniform" else reach
        log_f = log_noise(kind, s * (1 + 1e-12), R, eps, extra)
        got, want = tilted(kind, mu, c, s, R, eps, extra), naive.grid(mu, c, log_f, *reach)
        np.testing.assert_allclose(got[:3], want, rtol=2e-7, atol=2e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_slopes_are_derivatives(kind):
    rng = np.random.default_rng(6)
    for _ in range(20):
        mu, c = 1.5 * rng.normal(), 10 ** rng.uniform(-1, 1)
        log_s, log_R, logit = np.log([rng.uniform(0.3, 2), rng.uniform(0.05, 1), rng.uniform(0.1, 0.5)])
        extra = rng.uniform(3, 8) if kind == "contaminated" else rng.uniform(-4, 0)

        def at(p, mu=mu, c=c, extra=extra):
            return tilted(kind, mu, c, math.exp(p[0]), math.exp(p[1]), 1 / (1 + math.exp(-p[2])), extra)

        p = np.array([log_s, log_R, logit])
        h = 1e-5
        slope = [(at(p + h * e)[0] - at(p - h * e)[0]) / (2 * h) for e in np.eye(3)]
        np.testing.assert_allclose(at(p)[3:6], slope, atol=2e-9, rtol=1e-7)


def test_an_outlier_is_named():
    got = tilted("contaminated", 40.0, 1.0, 1.0, 0.0, 0.01, 10.0)
    assert got[6] > 0.999999
    assert got[1] == pytest.approx(40 * 100 / 101)  # the row is nearly ignored
    assert tilted("contaminated", 0.5, 1.0, 1.0, 0.0, 0.01, 10.0)[6] < 0.01


@pytest.mark.parametrize("kind", KINDS)
def test_no_noise_gives_nan(kind):
    given = itertools.product(
        [0.0, 1.0, 1e6, -1e150],  # mu
        [0.0, 1e-24, 1.0, 1e24],  # c
        [0.0, 1e-12, 1.0, 1e12],  # s
        [0.0, 1e-24, 1.0],  # R
        [0.0, 0.01, 1.0],  # eps
    )
    for mu, c, s, R, eps in given:
        got = tilted(kind, mu, c, s, R, eps, 10.0)
        assert not np.isnan(got).any(), (mu, c, s, R, eps, got)
        assert got[2] >= 0
