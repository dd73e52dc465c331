"""The particle filter against what is known exactly: Kalman, dense quadrature, and its own bookkeeping."""

import dataclasses

import numpy as np
import pytest

import halfwidth as hw
from halfwidth.methods.particle import ParticleFilter, _log_normal, _log_sum_density, _systematic


def gaussian_walk(seed=0, T=40):
    model = hw.Linear(
        [[1.0, 0.3], [0.0, 0.9]], [[0.1], [1.0]], [[1.0, 0.0], [1.0, 1.0]], hw.Gaussian([[0.2, 0.05], [0.05, 0.1]]),
        hw.Gaussian([[0.5, 0.2], [0.2, 0.4]]), hw.Normal([0.0, 1.0], 1.0),
        E=[[1.0, 0.2], [0.0, 1.0]], F=[[1.0, -0.3], [0.0, 1.0]],
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    truth, record = hw.simulate(model, rng.normal(size=(T, 1)), seed=seed)
    y = record.y.copy()
    y[rng.random(y.shape) < 0.3] = np.nan
    return model, truth, hw.Record(record.t, y, record.u)


@pytest.mark.parametrize("smooth", [False, True])
def test_linear_gaussian_is_kalman_within_its_own_error(smooth):
    """Repeated runs scatter around the exact answer: mean, spread and likelihood."""
    model, _, record = gaussian_walk(T=25)
    kalman = hw.KalmanSmoother() if smooth else hw.KalmanFilter()
    want = hw.estimate(model, record, kalman)
    runs = [
        hw.estimate(model, record, ParticleFilter(particles=500, smooth=smooth, trajectories=200), seed=k)
        for k in range(10)
    ]
    x = np.array([e.x for e in runs])
    error, scatter = x.mean(axis=0) - want.x, x.std(axis=0) / np.sqrt(len(runs))
    assert np.sqrt(np.mean((error / scatter) ** 2)) < 1.8
    assert np.abs(error).max() < 0.15 * np.sqrt(want.P.max())
    var = np.mean(
        [np.einsum("tn,tni->ti", e.spread.weights, (e.spread.points - e.x[:, None]) ** 2) for e in runs], axis=0
    )
    ratio = var / np.diagonal(want.P, axis1=1, axis2=2)
    assert 0.9 < ratio.mean() < 1.1
    # E exp(loglik) is the likelihood itself.
    exact = want.loglik
    ratios = np.exp([e.loglik - exact for e in runs])
    assert abs(ratios.mean() - 1.0) < 4 * ratios.std() / np.sqrt(len(runs)) + 0.05
    assert all(e.status is hw.Status.OK for e in runs)


def quadrature(A, q, C, weigh, lo, hi, y, edges):
    """Filter of a scalar model on a dense grid: uniform state noise of half-width q."""
    x = 0.5 * (edges[1:] + edges[:-1])
    dx = x[1] - x[0]
    p = np.where((x >= lo) & (x <= hi), 1.0, 0.0)
    p /= p.sum() * dx
    means, variances, loglik = [], [], 0.0
    for value in y:
        # density of A x + U(-q, q): differences of the distribution function of A x
        cdf = np.concatenate([[0.0], np.cumsum(p) * dx])
        upper, lower = (np.interp((x + s * q) / A, edges, cdf) for s in (1, -1))
        p = (upper - lower) / (2 * q)
        if not np.isnan(value):
            p = p * weigh(value - C * x)
            total = p.sum() * dx
            loglik += np.log(total)
            p /= total
        mean = (p * x).sum() * dx
        means.append(mean)
        variances.append((p * (x - mean) ** 2).sum() * dx)
    return np.array(means), np.array(variances), loglik


def normal_cdf(z):
    from math import erf

    return 0.5 * (1 + np.vectorize(erf)(z / np.sqrt(2)))


NOISES = {
    "uniform": (hw.Uniform(0.7), lambda v: (np.abs(v) <= 0.7) / 1.4),
    "gaussian": (hw.Gaussian(0.25), lambda v: np.exp(-2 * v**2) / np.sqrt(0.5 * np.pi)),
    "mixed": (
        hw.Uniform(0.6) + hw.Gaussian(0.04),
        lambda v: (normal_cdf((v + 0.6) / 0.2) - normal_cdf((v - 0.6) / 0.2)) / 1.2,
    ),
}


@pytest.mark.parametrize("kind", NOISES)
def test_bounded_scalar_model_equals_dense_quadrature(kind):
    e, weigh = NOISES[kind]
    model = hw.Linear([[0.95]], None, [[1.3]], hw.Uniform(0.3), e, hw.Box(-1.0, 2.0))
    _, record = hw.simulate(model, T=25, seed=4)
    y = record.y.copy()
    y[[3, 4, 11]] = np.nan
    record = hw.Record(record.t, y)
    mean, var, loglik = quadrature(0.95, 0.3, 1.3, weigh, -1.0, 2.0, y[:, 0], np.linspace(-12, 12, 24_001))
    runs = [hw.estimate(model, record, ParticleFilter(particles=3000), seed=k) for k in range(6)]
    x = np.array([r.x[:, 0] for r in runs])
    assert np.abs(x.mean(axis=0) - mean).max() < 0.04 * np.sqrt(var.max())
    spread = np.mean(
        [np.einsum("tn,tn->t", r.spread.weights, (r.spread.points[..., 0] - r.x) ** 2) for r in runs], axis=0
    )
    np.testing.assert_allclose(spread, var, rtol=0.12)
    # the mean of the likelihoods, not of their logarithms
    assert np.log(np.mean(np.exp([r.loglik - loglik for r in runs]))) == pytest.approx(0.0, abs=0.15)
    lo, hi = runs[0].interval(0.9)
    assert np.all(hi - lo < 2 * 1.9 * np.sqrt(var)[:, None])
    assert np.all(hi - lo > 2 * 1.2 * np.sqrt(var)[:, None])


def test_bounded_outputs_with_a_full_F_and_any_entry_missing():
    """An unseen output between seen ones is drawn: the mean over it equals a long run of rejection."""
    F = [[1.0, 0.8, -0.5], [0.0, 1.0, 0.9], [0.0, 0.0, 1.0]]
    model = hw.Linear(
        [[1.0]], None, [[1.0], [0.5], [-1.0]], hw.Uniform(1.0), hw.Uniform([0.5, 0.6, 0.7]), hw.Box(0, 0.001), F=F
    )
    rng = np.random.default_rng(0)
    n = 400_000
    x = rng.uniform(-1, 1, n)
    e = rng.uniform(-1, 1, (n, 3)) * [0.5, 0.6, 0.7]
    y = np.linalg.solve(np.array(F), (x[:, None] * [1.0, 0.5, -1.0] + e).T).T
    for given in ([0.3, np.nan, 0.2], [np.nan, 0.1, np.nan], [0.2, np.nan, np.nan], [np.nan, np.nan, -0.4]):
        near = np.ones(n, bool)
        for j, v in enumerate(given):
            if not np.isnan(v):
                near &= np.abs(y[:, j] - v) < 0.05
        est = hw.estimate(model, hw.Record([0.0], [given]), ParticleFilter(particles=60_000), seed=1)
        assert est.x[0, 0] == pytest.approx(x[near].mean(), abs=0.02)
        volume = 0.1 ** int(np.isfinite(given).sum())
        assert est.loglik == pytest.approx(np.log(near.mean() / volume), abs=0.05)


def test_nonlinear_model_and_compiled_equals_python():
    model = hw.Nonlinear(
        lambda x, u, dt: np.array([x[0] + dt * np.cos(x[1]), x[1] + dt * u[0]]), lambda x: np.hypot(x[0], 1.0),
        hw.Uniform([0.05, 0.02]), hw.Uniform(0.2), hw.Box([0.0, -0.1], [0.2, 0.1]), nu=1, dt=0.1,
    )  # fmt: skip
    truth, record = hw.simulate(model, 0.3 * np.ones((40, 1)), seed=3)
    one = hw.estimate(model, record, ParticleFilter(particles=200), seed=5)
    two = hw.estimate(model, record, ParticleFilter(particles=200, compiled=False), seed=5)
    assert (one.info["evaluated"], two.info["evaluated"]) == ("compiled", "python")
    np.testing.assert_allclose(one.x, two.x, rtol=1e-9, atol=1e-12)
    lo, hi = hw.estimate(model, record, ParticleFilter(particles=2000), seed=5).interval(0.999)
    assert ((truth.x >= lo) & (truth.x <= hi)).mean() > 0.97
    # the Gaussian twin is followed by the unscented filter too
    gaussian = model.as_gaussian()
    close = hw.estimate(gaussian, record, ParticleFilter(particles=4000), seed=1)
    unscented = hw.estimate(gaussian, record, hw.UnscentedKalman())
    assert np.abs(close.x - unscented.x).max() < 0.35 * unscented.spread.sd.max()


def test_angles_are_averaged_on_the_circle():
    model = hw.Nonlinear(
        lambda x: np.array([np.remainder(x[0] + np.pi, 2 * np.pi) - np.pi]), lambda x: x, hw.Gaussian(0.01), hw.Gaussian(0.05),
        hw.Normal([3.1], 0.1), x_angles=(0,), y_angles=(0,),
    )  # fmt: skip
    record = hw.Record(np.arange(30.0), np.where(np.arange(30) % 2, 3.12, -3.12))
    for smooth in (False, True):
        est = hw.estimate(model, record, ParticleFilter(particles=500, smooth=smooth), seed=1)
        away = np.remainder(est.x - np.pi + np.pi, 2 * np.pi) - np.pi
        assert np.abs(away).max() < 0.5
        lo, hi = est.interval(0.9)
        assert np.all(hi - lo < 1.2)


def test_bounds_on_the_state_are_kept():
    model = hw.Linear(
        [[1.0]], None, [[1.0]], hw.Gaussian(0.5), hw.Gaussian(1.0), hw.Normal([0.5], 0.1), bounds=(0.0, 1.0)
    )
    record = hw.Record(np.arange(30.0), np.full(30, 3.0))
    for smooth in (False, True):
        est = hw.estimate(model, record, ParticleFilter(smooth=smooth), seed=2)
        assert est.status is hw.Status.OK
        assert np.all(est.spread.points[est.spread.weights > 0] <= 1.0)
        assert np.all((est.x >= 0) & (est.x <= 1))


def test_collapse_names_the_row_and_goes_on():
    model = hw.Linear([[1.0]], None, [[1.0]], hw.Uniform(0.1), hw.Uniform(0.2), hw.Box(-0.1, 0.1))
    y = np.zeros(20)
    y[7] = 50.0
    est = hw.estimate(model, hw.Record(10 + np.arange(20.0), y), ParticleFilter(), seed=1)
    assert est.status is hw.Status.COLLAPSED
    assert "row 7, t = 17 s (1 of 20 rows)" in est.info["message"]
    assert np.isfinite(est.x).all()
    assert np.abs(est.x).max() < 0.5
    assert np.isfinite(est.loglik)
    with pytest.raises(hw.Unsolved, match="row 7"):
        est.check()


def test_one_particle_alone_is_told():
    model = hw.Linear([[1.0]], None, [[1.0]], hw.Gaussian(1.0), hw.Gaussian(1e-12), hw.Normal([0.0], 1.0))
    est = hw.estimate(model, hw.Record([0.0], [0.3]), ParticleFilter(), seed=1)
    assert est.status is hw.Status.REDUCED
    assert "one particle alone" in est.info["message"]


def test_seed_is_kept_and_repeats():
    model, _, record = gaussian_walk(T=10)
    first = hw.estimate(model, record, ParticleFilter(particles=50))
    again = hw.estimate(model, record, ParticleFilter(particles=50), seed=first.info["seed"])
    np.testing.assert_array_equal(first.x, again.x)
    other = hw.estimate(model, record, ParticleFilter(particles=50))
    assert np.any(other.x != first.x)


def test_long_records_are_thinned_not_refused(monkeypatch):
    monkeypatch.setattr("halfwidth.methods.particle._KEPT", 4000)
    model, _, record = gaussian_walk(T=20)
    full = hw.estimate(model, record, ParticleFilter(particles=2000), seed=1)
    assert full.info["kept"] == 100
    assert full.spread.points.shape == (20, 100, 2)
    assert np.abs(full.spread.mean - full.x).max() < 0.2


def test_nothing_seen_is_the_prediction():
    model = hw.Linear([[0.5]], None, [[1.0]], hw.Uniform(1.0), hw.Uniform(1.0), hw.Box(3.0, 5.0))
    est = hw.estimate(model, hw.Record(np.arange(5.0), np.full(5, np.nan)), ParticleFilter(particles=20_000), seed=1)
    np.testing.assert_allclose(est.x[:, 0], 4.0 * 0.5 ** np.arange(1, 6), atol=0.03)
    assert est.loglik == 0.0


@pytest.mark.parametrize("e", [hw.Gaussian(0.0), hw.Uniform(0.0), hw.Uniform(0.0) + hw.Gaussian(0.0)])
def test_no_output_noise(e):
    """What no particle can hit exactly collapses; a certain state is hit."""
    model = hw.Linear([[1.0]], None, [[2.0]], hw.Uniform(0.0), e, hw.Box(1.5, 1.5))
    est = hw.estimate(model, hw.Record([0.0, 1.0], [3.0, 3.0]), ParticleFilter(particles=10), seed=1)
    assert est.status is hw.Status.OK
    np.testing.assert_allclose(est.x, 1.5, rtol=1e-15)
    spread = dataclasses.replace(model, x0=hw.Box(0.0, 1.0))
    assert hw.estimate(spread, hw.Record([0.0], [1.0]), ParticleFilter(), seed=1).status is hw.Status.COLLAPSED


def test_correlated_mixed_noise_draws_its_bounded_part():
    """Nearly diagonal noise, weighted by draws, against the exact weights of diagonal noise."""

    def model(c):
        e = hw.Uniform([0.5, 0.3]) + hw.Gaussian([[0.2, c], [c, 0.3]])
        return hw.Linear([[0.9]], None, [[1.0], [1.0]], hw.Gaussian(0.3), e, hw.Normal([0.0], 1.0))

    _, record = hw.simulate(model(0.0), T=15, seed=3)
    y = record.y.copy()
    y[4], y[7, 0] = np.nan, np.nan
    record = hw.Record(record.t, y)
    exact, drawn = (
        [hw.estimate(model(c), record, ParticleFilter(particles=4000), seed=k) for k in range(4)] for c in (0.0, 1e-6)
    )
    a, b = (np.mean([e.x for e in runs], axis=0) for runs in (exact, drawn))
    assert np.abs(a - b).max() < 0.06
    a, b = (np.log(np.mean(np.exp([e.loglik - exact[0].loglik for e in runs]))) for runs in (exact, drawn))
    assert abs(a - b) < 0.25


def test_density_of_the_sum_of_bounded_and_gaussian():
    from scipy.integrate import quad
    from scipy.stats import norm

    for r, sd in ((1.0, 0.3), (0.2, 2.0), (1e-5, 1.0), (1.0, 1e-3)):
        for v in (0.0, 0.4 * r, -1.1 * r, r + 3 * sd):
            lo, hi = max(-r, v - 12 * sd), min(r, v + 12 * sd)
            want = (
                quad(lambda b, v=v, sd=sd: norm.pdf(v - b, scale=sd), lo, hi, epsabs=1e-14)[0] / (2 * r)
                if lo < hi
                else 0.0
            )
            got = np.exp(_log_sum_density(np.array([v]), r, sd, np.zeros(1)))[0]
            assert got == pytest.approx(want, rel=1e-7, abs=1e-12)
    far = _log_sum_density(np.array([1e3, -1e6]), 1.0, 1.0, np.zeros(2))
    assert np.isfinite(far).all()
    assert far[0] == pytest.approx(-0.5 * 999.0**2, rel=1e-4)


def test_degenerate_covariances():
    v = np.array([[1.0, 1.0], [1.0, 1.1], [0.0, 0.0]])
    got = _log_normal(v, np.ones((2, 2)))
    assert np.isfinite(got[[0, 2]]).all()
    assert got[1] == -np.inf
    S = np.array([[1e-20, 0.0], [0.0, 1e20]])
    assert _log_normal(np.array([[0.0, 0.0]]), S)[0] == pytest.approx(-np.log(2 * np.pi))


def test_systematic_resampling_is_fair():
    rng = np.random.default_rng(0)
    w = np.array([0.5, 0.0, 0.3, 0.2])
    counts = np.mean([np.bincount(_systematic(w, 10, rng), minlength=4) for _ in range(500)], axis=0)
    np.testing.assert_allclose(counts, 10 * w, atol=0.1)
    one = np.bincount(_systematic(w, 10, rng), minlength=4)
    assert np.all(np.abs(one - 10 * w) < 1)


def test_refusals_and_settings():
    model = hw.Linear([[1.0]], None, [[1.0]], hw.Uniform(1.0), hw.Uniform(1.0), hw.Box(0.0, 1.0))
    assert ParticleFilter().refuses(model) is None
    assert ParticleFilter(smooth=True).refuses(model) is None
    cases = {
        "unknown ones": dataclasses.replace(model, w=hw.Uniform.unknown(at_most=1.0)),
        "without ends": dataclasses.replace(model, x0=None),
        "some entries are NaN": dataclasses.replace(model, A=[[np.nan]]),
    }
    for words, wrong in cases.items():
        reason = ParticleFilter().refuses(wrong)
        assert words in reason
        assert "\nhint: " in reason
    mixed = dataclasses.replace(model, w=hw.Uniform(1.0) + hw.Gaussian(1.0))
    assert "density" in ParticleFilter(smooth=True).refuses(mixed)
    assert ParticleFilter().refuses(mixed) is None
    still = dataclasses.replace(model, w=hw.Gaussian(0.0))
    assert "density" in ParticleFilter(smooth=True).refuses(still)
    for bad in ({"particles": 1}, {"particles": 10.5}, {"trajectories": 0}):
        with pytest.raises(hw.BadValue, match=next(iter(bad))):
            ParticleFilter(**bad)
