"""core/ep.hpp against dense algebra, sampling and finite differences."""

import dataclasses

import numpy as np
import pytest
from tests import naive_ep as naive

import halfwidth as hw
from halfwidth import _core
from halfwidth.methods._sites import sites


def system(seed, n, ny, T, *, E=False, bounds=True, prior="box", e="uniform", w="uniform", missing=0.2):
    """Return a random model with known half-widths, a record of it, and the half-widths."""
    rng = np.random.default_rng(seed)
    A = rng.uniform(-1, 1, (n, n)) / np.sqrt(n)
    C = rng.uniform(-1, 1, (ny, n))
    q, r = rng.uniform(0.2, 1, n), rng.uniform(0.2, 1, ny)
    upper = np.eye(n) + np.triu(rng.uniform(-0.5, 0.5, (n, n)), 1)
    x0 = hw.Box(-np.ones(n), np.ones(n)) if prior == "box" else hw.Normal(np.zeros(n), 0.5)
    model = hw.Linear(
        A, None, C,
        hw.Uniform(q) if w == "uniform" else hw.Gaussian(q**2 / 3),
        hw.Uniform(r) if e == "uniform" else hw.Gaussian(r**2 / 3),
        x0, E=upper if E else None,
    )  # fmt: skip
    truth, record = hw.simulate(model, T=T, seed=seed)
    y = record.y.copy()
    y[rng.random(y.shape) < missing] = np.nan
    if bounds:
        top = np.abs(truth).max(axis=0) * 1.02
        model = dataclasses.replace(model, bounds=(-top, np.where(np.arange(n) == 0, np.inf, top)))
    found, fitted = np.r_[q, r], np.r_[np.full(n, w == "fitted"), np.full(ny, e == "fitted")]
    if fitted.any():  # the same sizes as standard deviations of unknown variances
        unknown = hw.Gaussian.unknown()
        model = dataclasses.replace(
            model, w=unknown if w == "fitted" else model.w, e=unknown if e == "fitted" else model.e
        )
        found = np.r_[np.where(fitted, 0.0, found), np.where(fitted, found / np.sqrt(3), 0.0)]
    return model, hw.Record(record.t, y), found


CASES = {
    "plain": {"n": 2, "ny": 1, "T": 4, "bounds": False},
    "bounds": {"n": 2, "ny": 2, "T": 4},
    "one state": {"n": 1, "ny": 1, "T": 6},
    "correlated": {"n": 3, "ny": 2, "T": 3, "E": True},
    "normal prior": {"n": 2, "ny": 2, "T": 4, "prior": "normal"},
    "gaussian outputs": {"n": 2, "ny": 2, "T": 4, "e": "gaussian"},
    "gaussian states": {"n": 2, "ny": 1, "T": 4, "w": "gaussian", "prior": "normal", "missing": 0.0},
    "deviations": {"n": 2, "ny": 2, "T": 4, "e": "fitted", "w": "fitted", "prior": "normal", "E": True},
    "deviations beside boxes": {"n": 2, "ny": 2, "T": 4, "e": "fitted", "bounds": False},
    "many states": {"n": 5, "ny": 2, "T": 3},
    "nothing seen": {"n": 2, "ny": 1, "T": 3, "missing": 1.0},
}


def run(chain, s, sweeps=100, tol=1e-11, given=None):
    s = np.ascontiguousarray(np.atleast_2d(s))
    return _core.ep_run(chain.problem, s, np.zeros(len(s)), sweeps, tol, 1.0, given)


@pytest.mark.parametrize("name", CASES)
def test_it_equals_the_dense_twin(name):
    model, record, s = system(3, **CASES[name])
    chain = sites(model, record)
    found = run(chain, s)
    x, P, log_z, second = naive.propagate(chain.problem, s)
    np.testing.assert_allclose(found["x"][0], x, atol=1e-8)
    np.testing.assert_allclose(found["P"][0], P, atol=1e-8)
    assert found["log_z"][0] == pytest.approx(log_z, abs=1e-7)
    assert found["second"][0] == pytest.approx(second, abs=1e-6)
    assert found["residual"][0] < 1e-9


@pytest.mark.parametrize("name", ["bounds", "correlated", "many states", "deviations", "deviations beside boxes"])
def test_slopes_are_derivatives_of_the_evidence(name):
    model, record, s = system(4, **CASES[name])
    chain = sites(model, record)
    h = 1e-4
    members = s * np.exp(np.concatenate([np.zeros((1, s.size)), h * np.eye(s.size), -h * np.eye(s.size)]))
    found = run(chain, members)
    numeric = (found["log_z"][1 : s.size + 1] - found["log_z"][s.size + 1 :]) / (2 * h)
    np.testing.assert_allclose(found["slope"][0, :-1], numeric, atol=1e-4)


def test_slopes_with_unseen_correlated_outputs_and_mixed_noise():
    rng = np.random.default_rng(0)
    r = [0.5, 0.6, 0.7]
    F = [[1, 0.4, -0.3], [0, 1, 0.5], [0, 0, 1]]
    for e in (hw.Uniform(r), hw.Uniform(r) + hw.Gaussian([0.1, 0.2, 0.1])):
        model = hw.Linear(
            0.5 * np.eye(2), None, rng.standard_normal((3, 2)), hw.Uniform(0.4), e, hw.Box(-1, [1, 1]), F=F
        )
        _, record = hw.simulate(model, T=8, seed=2)
        y = record.y.copy()
        y[rng.random(y.shape) < 0.3] = np.nan
        chain = sites(model, hw.Record(record.t, y))
        s = np.r_[0.4, 0.4, r]
        h = 1e-4
        members = np.exp(np.log(s) + np.concatenate([np.zeros((1, 5)), h * np.eye(5), -h * np.eye(5)]))
        found = run(chain, members)
        numeric = (found["log_z"][1:6] - found["log_z"][6:]) / (2 * h)
        np.testing.assert_allclose(found["slope"][0, :-1], numeric, atol=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_evidence_equals_a_volume(seed):
    """log Z against the share of simulated paths that the outputs allow, T <= 4."""
    model, record, s = system(seed, 2, 1, 3, bounds=seed % 2 == 1, missing=0.0)
    log_z = run(sites(model, record), s)["log_z"][0]
    rng = np.random.default_rng(9)
    N = 2_000_000
    x = rng.uniform(-1, 1, (N, 2))
    weight = np.ones(N)
    for t in range(3):
        x = x @ model.A.single.T + rng.uniform(-s[:2], s[:2], (N, 2))
        weight *= np.abs(x @ model.C.single.T - record.y[t])[:, 0] < s[2]
        if model.bounds is not None:
            weight *= model.bounds.contains(x)
    assert log_z == pytest.approx(np.log(weight.mean()) - 3 * np.log(2 * s[2]), abs=0.1)


def test_members_do_not_meet_and_sites_can_be_taken_up():
    model, record, s = system(5, **CASES["bounds"])
    chain = sites(model, record)
    members = s * np.random.default_rng(0).uniform(0.8, 1.5, (7, s.size))
    together = run(chain, members)
    for k, member in enumerate(members):
        np.testing.assert_allclose(run(chain, member)["x"][0], together["x"][k], atol=1e-9)
    again = run(chain, members, sweeps=0, given=together["sites"])
    np.testing.assert_allclose(again["x"], together["x"], atol=1e-9)
    assert np.all(again["residual"] < 1e-9)


def test_shape_of_a_cut_gaussian():
    """One state, one step, one Gaussian output: the posterior is a Gaussian in a box, and every moment exact."""
    model = hw.Linear([[0.0]], None, [[1.0]], hw.Uniform(1.0), hw.Gaussian(0.3), hw.Normal([0.0], 1.0))
    found = run(sites(model, hw.Record([0.0], [0.7])), [1.0, 0.0])
    z = np.linspace(-1, 1, 200001)
    p = np.exp(-0.5 * (z - 0.7) ** 2 / 0.3)
    p /= p.sum()
    mean = p @ z
    var = p @ (z - mean) ** 2
    assert found["x"][0, 1, 0] == pytest.approx(mean, abs=1e-5)
    assert found["P"][0, 1, 0, 0] == pytest.approx(var, abs=1e-5)
    assert found["k3"][0, 1, 0] == pytest.approx(p @ (z - mean) ** 3 / var**1.5, abs=1e-3)
    assert found["k4"][0, 1, 0] == pytest.approx(p @ (z - mean) ** 4 / var**2 - 3, abs=1e-3)


@pytest.mark.parametrize("avx2", [True, False])
def test_nonsense_ends(avx2):
    """No trajectory fits: no evidence, and the other lanes do not notice."""
    if not _core.use_isa(avx2):
        pytest.skip("no AVX2 here")
    try:
        model, record, s = system(6, **CASES["bounds"])
        chain = sites(model, record)
        found = run(chain, np.array([s, 1e-3 * s, 1e-9 * s, 1e3 * s]), sweeps=50)
        assert found["log_z"][1] == found["log_z"][2] == -np.inf
        assert np.isfinite(found["log_z"][[0, 3]]).all()
        np.testing.assert_allclose(found["x"][0], run(chain, s)["x"][0], atol=1e-6)
    finally:
        _core.use_isa(True)


@pytest.mark.parametrize("name", ["bounds", "correlated", "many states"])
def test_eight_lanes_equal_four(name):
    wide = _core.wide()
    if not _core.use_wide(True):
        pytest.skip("no AVX-512 here")
    try:
        model, record, s = system(7, **CASES[name])
        chain = sites(model, record)
        members = s * np.random.default_rng(1).uniform(0.9, 1.4, (11, s.size))
        eight = run(chain, members)
        _core.use_wide(False)
        four = run(chain, members)
        for key in ("x", "P", "k3", "k4", "log_z", "slope"):
            np.testing.assert_allclose(eight[key], four[key], atol=1e-9)
    finally:
        _core.use_wide(wide)


def test_shapes_of_a_tilted_box_are_cumulants():
    """Deep in a tail, about the middle, nearly uniform: against a fine sum."""
    for mu, c, half in [(0.3, 1.0, 1.0), (4.0, 1.0, 1.0), (-30.0, 1.0, 1.0), (0.1, 100.0, 0.5), (0.9, 0.04, 1.0)]:
        model = hw.Linear([[0.0]], None, [[1.0]], hw.Uniform(half), hw.Gaussian(c), hw.Normal([0.0], 1.0))
        found = run(sites(model, hw.Record([0.0], [mu])), [half, 0.0])
        z = np.linspace(-half, half, 400_001)
        p = np.exp(-0.5 * (z - mu) ** 2 / c + 0.5 * min(0.0, half - abs(mu)) ** 2 / c)
        p /= p.sum()
        mean = p @ z
        var = p @ (z - mean) ** 2
        assert found["k3"][0, 1, 0] == pytest.approx(p @ (z - mean) ** 3 / var**1.5, abs=2e-3)
        assert found["k4"][0, 1, 0] == pytest.approx(p @ (z - mean) ** 4 / var**2 - 3, abs=5e-3)
