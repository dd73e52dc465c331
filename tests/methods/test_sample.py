"""The sampler is the truth for others, so it is held against enumeration: rejection and importance sampling."""

import numpy as np
import pytest

import halfwidth as hw
from halfwidth.methods import _sample
from halfwidth.methods._convergence import convergence
from halfwidth.methods._sample import sample

NAN = float("nan")
A, Q, R = np.array([[0.9, 0.2], [0.0, 0.8]]), np.array([0.5, 0.4]), np.array([0.3, 0.5])
Y = np.array([[0.3, NAN], [NAN, 0.2], [0.4, 0.1]])
SCALAR = np.array([[0.5], [0.1], [0.6]])


def record(y, u=None):
    return hw.Record(np.arange(float(len(y))), y, u)


def close(draws, truth, sd, sigmas=4.5):
    """Means agree within the Monte Carlo error of `draws` effective samples (and as many of the truth)."""
    assert np.all(np.abs(np.asarray(draws) - truth) <= sigmas * np.asarray(sd) * np.sqrt(2.0 / 4000))


def test_gaussian_rows_give_the_smoother():
    rng = np.random.default_rng(1)
    model = hw.Linear(
        [[1, 0.1], [0, 0.9]], None, [[1, 0], [0.5, 1]],
        hw.Gaussian([[0.02, 0.005], [0.005, 0.03]]), hw.Gaussian([[0.1, 0.04], [0.04, 0.2]]), hw.Normal([0, 0], 1.0),
    )  # fmt: skip
    y = rng.normal(size=(12, 2))
    y[3, 0] = y[5] = y[7, 1] = NAN
    exact = hw.estimate(model, record(y), hw.KalmanSmoother())
    d = sample(model, record(y), draws=1500, thin=8, seed=1)
    x = d.x.reshape(-1, 13, 2)[:, 1:]
    sd = exact.spread.sd
    close(x.mean(0), exact.x, sd)
    np.testing.assert_allclose(x.std(0), sd, rtol=0.08)
    assert d.rhat < 1.01
    assert np.isnan(d.s).all()


def test_correlated_noise_with_unseen_partners_equals_rejection():
    E, F = np.array([[1, 0.4], [0, 1]]), np.array([[1, 0.6], [0, 1]])
    model = hw.Linear(A, None, np.eye(2), hw.Uniform(Q), hw.Uniform(R), hw.Box([-1, -1], [1, 1]), E=E, F=F)
    d = sample(model, record(Y), draws=1500, thin=8, seed=2)
    g, n = np.random.default_rng(0), 400_000
    x = g.uniform(-1, 1, (n, 2))
    path, ok = [x], np.ones(n, bool)
    for t in range(3):
        x = (x @ A.T + g.uniform(-Q, Q, (n, 2))) @ np.linalg.inv(E).T
        path.append(x)
        second = x[:, 1] + g.uniform(-R[1], R[1], n) if t == 0 else np.full(n, Y[t, 1])
        if t != 1:
            ok &= np.abs(Y[t, 0] + F[0, 1] * second - x[:, 0]) <= R[0]
        if t > 0:
            ok &= np.abs(Y[t, 1] - x[:, 1]) <= R[1]
    truth = np.array(path)[:, ok]
    close(d.x.reshape(-1, 4, 2).mean(0), truth.mean(1), truth.std(1))
    np.testing.assert_allclose(d.x.reshape(-1, 4, 2).std(0), truth.std(1), rtol=0.06)
    np.testing.assert_array_equal(d.s, np.broadcast_to(np.r_[Q, R], d.s.shape))


@pytest.mark.parametrize("prior", [None, 0.6, [[-1.5, -1.0], [0.5, 0.7]]])
@pytest.mark.parametrize("scale_every", [1, 10**9], ids=["scale moves", "plain"])
def test_unknown_half_widths_equal_importance_sampling(prior, scale_every):
    """The scale move changes the speed, not the answer: its Jacobian is right."""
    unknown = hw.Uniform.unknown(at_most=1.0)
    model = hw.Linear([[0.8]], None, [[1]], unknown, unknown, hw.Box(-1, 1))
    d = sample(
        model, record(SCALAR), draws=1500, thin=15, seed=3, scale_every=scale_every,
        prior=np.array(prior) if isinstance(prior, list) else None, power=prior if isinstance(prior, float) else 1.0,
    )  # fmt: skip
    g, n = np.random.default_rng(0), 1_000_000
    if not isinstance(prior, list):
        q, r = g.uniform(0, 1, (2, n)) ** (1.0 / (prior or 1.0))
    else:
        q, r = np.exp(g.normal(prior[0][0], prior[1][0], n)), np.exp(g.normal(prior[0][1], prior[1][1], n))
    weight = ((q <= 1) & (r <= 1)).astype(float)
    x = g.uniform(-1, 1, n)
    path = [x]
    for t in range(3):
        x = 0.8 * x + g.uniform(-1, 1, n) * q
        path.append(x)
        weight *= (np.abs(SCALAR[t, 0] - x) <= r) / (2 * r)
    weight /= weight.sum()
    values = np.array([q, r, *path])
    mean = values @ weight
    sd = np.sqrt(values**2 @ weight - mean**2)
    got = np.concatenate([d.s, d.x[..., 0]], axis=2).reshape(-1, 6)
    assert np.all(np.abs(got.mean(0) - mean) <= 6 * sd * np.sqrt(weight @ weight + 1 / 3000))
    np.testing.assert_allclose(got.std(0), sd, rtol=0.1)
    assert d.rhat < 1.01


def test_unknown_entries_equal_rejection():
    model = hw.Linear(
        A, None, [[1, 0], [NAN, 1]], hw.Uniform(Q), hw.Uniform(R), hw.Box([-1, -1], [1, 1]),
        E=[[1, NAN], [0, 1]], F=[[1, NAN], [0, 1]], theta_bounds=([-1, -1, -1], [1, 1, 1]),
    )  # fmt: skip
    d = sample(model, record(Y), draws=1500, thin=20, seed=2)
    g, n = np.random.default_rng(0), 600_000
    c, e, f = g.uniform(-1, 1, (3, n))
    x, ok = g.uniform(-1, 1, (n, 2)), np.ones(n, bool)
    for t in range(3):
        v = x @ A.T + g.uniform(-Q, Q, (n, 2))
        x = np.c_[v[:, 0] - e * v[:, 1], v[:, 1]]
        h = c * x[:, 0] + x[:, 1]
        second = h + g.uniform(-R[1], R[1], n) if t == 0 else np.full(n, Y[t, 1])
        if t != 1:
            ok &= np.abs(Y[t, 0] + f * second - x[:, 0]) <= R[0]
        if t > 0:
            ok &= np.abs(Y[t, 1] - h) <= R[1]
    truth = np.array([c, e, f, x[:, 0], x[:, 1]])[:, ok]
    got = np.concatenate([d.theta, d.x[:, :, -1]], axis=2).reshape(-1, 5)
    close(got.mean(0), truth.mean(1), truth.std(1))
    np.testing.assert_allclose(got.std(0), truth.std(1), rtol=0.06)


def test_unknown_drive_and_transition_equal_rejection():
    """The start is found although no linearisation about its first guess fits the known half-widths."""
    u = np.array([[1.0], [0.0], [-1.0]])
    model = hw.Linear(
        [[NAN]], [[NAN]], [[1]], hw.Uniform(0.2), hw.Uniform(0.3), hw.Box(-1, 1), theta_bounds=([0, -1], [1, 1])
    )
    d = sample(model, record(SCALAR, u), draws=1500, thin=20, seed=3)
    g, n = np.random.default_rng(0), 1_000_000
    a, b, x, ok = g.uniform(0, 1, n), g.uniform(-1, 1, n), g.uniform(-1, 1, n), np.ones(n, bool)
    for t in range(3):
        x = a * x + b * u[t, 0] + g.uniform(-0.2, 0.2, n)
        ok &= np.abs(SCALAR[t, 0] - x) <= 0.3
    truth = np.array([a, b, x])[:, ok]
    got = np.concatenate([d.theta, d.x[:, :, -1]], axis=2).reshape(-1, 3)
    close(got.mean(0), truth.mean(1), truth.std(1))


def test_a_half_width_without_rows_keeps_its_prior():
    unknown = hw.Uniform.unknown(at_most=2.0)
    model = hw.Linear([[1]], None, [[1]], hw.Uniform(0.1), unknown, hw.Box(-1, 1))
    d = sample(model, record([[NAN], [NAN]]), draws=2000, seed=1)
    assert abs(d.s[..., 1].mean() - 1.0) < 0.05
    open_end = hw.Linear([[1]], None, [[1]], hw.Uniform(0.1), hw.Uniform.unknown(), hw.Box(-1, 1))
    with pytest.raises(hw.BadValue, match="1 rows, no upper bound"):
        sample(open_end, record([[0.1], [NAN]]), draws=10, seed=1)
    est = hw.estimate(open_end, record([[NAN], [NAN]]), hw.Posterior(method="sample", draws=200), seed=1)
    assert "bound not identifiable" in est.info["notes"][0]
    assert np.isfinite(est.r).all()


def test_infeasible_records_have_no_draws():
    model = hw.Linear([[1]], None, [[1]], hw.Uniform(0.1), hw.Uniform(0.1), hw.Box(-1, 1))
    assert sample(model, record([[0.0], [5.0]]), draws=10, seed=1) is None


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("case", ["plain", "one row", "no noise", "all missing"])
def test_hard_cases_end_in_finite_draws(scale, case):
    rng = np.random.default_rng(5)
    rows = 1 if case == "one row" else 8
    y = np.cumsum(rng.uniform(-1, 1, (rows, 1)), axis=0)
    y = {"no noise": np.zeros_like(y), "all missing": np.full_like(y, NAN)}.get(case, y)
    cap = hw.Uniform.unknown(at_most=2.0 * scale)
    model = hw.Linear([[1]], None, [[1]], cap, cap, hw.Box(-10 * scale, 10 * scale))
    d = sample(model, record(y * scale), draws=60, thin=5, seed=1)
    assert np.isfinite(d.x).all()
    assert np.isfinite(d.s).all()
    assert np.all(d.s <= 2.0 * scale * (1 + 1e-9))
    w = np.abs(np.diff(d.x[..., 0], axis=2))
    assert np.all(w <= d.s[..., :1] * (1 + 1e-6) + 1e-9 * scale)


def test_refusals_name_the_way_out():
    mixed = hw.Linear([[1]], None, [[1]], hw.Uniform(1) + hw.Gaussian(1), hw.Uniform(1), hw.Box(-1, 1))
    assert "ParticleFilter" in _sample.refuses(mixed)
    bent = hw.Nonlinear(np.sin, np.sin, hw.Uniform(1), hw.Uniform(1), hw.Box(-1, 1))
    assert "nonlinear" in _sample.refuses(bent)


def test_convergence_tells_chains_apart():
    rng = np.random.default_rng(2)
    same = rng.normal(size=(4, 2000))
    rhat, ess = convergence(same)
    assert rhat < 1.01
    assert 6000 < ess < 10000
    assert convergence(same + np.arange(4)[:, None])[0] > 1.3
    assert convergence(same * np.array([1, 1, 1, 4])[:, None])[0] > 1.05
    slow = np.zeros((4, 5000))
    for k in range(1, 5000):
        slow[:, k] = 0.9 * slow[:, k - 1] + rng.normal(size=4)
    assert abs(convergence(slow)[1] / (20000 * 0.1 / 1.9) - 1) < 0.35


def test_posterior_by_draws_agrees_with_propagation():
    """The same posterior twice: with known half-widths nothing of the priors is left."""
    rng = np.random.default_rng(4)
    model = hw.Linear(
        [[1, 0.5], [0, 0.9]], None, [[1, 0]], hw.Uniform([0.1, 0.2]), hw.Uniform(0.5), hw.Box([-1, -1], [1, 1])
    )
    truth, rec = hw.simulate(model, None, T=15, seed=3)
    y = np.array(rec.y)
    y[4:7] = NAN
    rec = hw.Record(rec.t, y)
    drawn = hw.estimate(model, rec, hw.Posterior(method="sample", draws=1500), seed=int(rng.integers(100)))
    fast = hw.estimate(model, rec, hw.Posterior())
    sd = drawn.spread.points.std(axis=1)
    assert drawn.status is hw.Status.OK
    assert np.abs((fast.x - drawn.x) / sd).mean() < 0.08
    lo, hi = drawn.interval(0.9)
    assert np.mean((truth.x >= lo) & (truth.x <= hi)) > 0.7
    again = hw.estimate(model, rec, hw.Posterior(method="sample", draws=1500), seed=drawn.info["seed"])
    np.testing.assert_array_equal(again.x, drawn.x)


def test_posterior_by_draws_says_when_nothing_fits():
    model = hw.Linear([[1]], None, [[1]], hw.Uniform(0.1), hw.Uniform(0.1), hw.Box(-1, 1))
    est = hw.estimate(model, record([[0.0], [5.0]]), hw.Posterior(method="sample", draws=10), seed=1)
    assert est.status is hw.Status.INFEASIBLE
    assert np.isfinite(est.x).all()
    assert "BatchLP" in est.info["hint"]
