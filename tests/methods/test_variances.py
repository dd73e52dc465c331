"""Unknown variances in `Posterior`: maximum likelihood without a prior, slopes, coverage, windows, and how it fails."""

import dataclasses

import halfwidth._core as _core
import numpy as np
import pytest
from scipy.optimize import minimize
from tests import naive

import halfwidth as hw
from halfwidth.methods import load, posterior
from halfwidth.methods._sites import sites

A, C = np.array([[0.9, 0.2], [0, 0.8]]), np.array([[1, 0], [0.3, 1]])
TRUE = hw.Linear(A, None, C, hw.Gaussian([0.04, 0.09]), hw.Gaussian([0.25, 0.16]), hw.Normal(np.zeros(2), 1.0))
UNKNOWN = hw.Gaussian.unknown(at_most=100.0)


def asked(w=UNKNOWN, e=UNKNOWN, **more):
    return dataclasses.replace(TRUE, w=w, e=e, **more)


def drawn(T, seed, model=TRUE, missing=0.2):
    truth, record = hw.simulate(model, T=T, seed=seed)
    y = record.y.copy()
    y[np.random.default_rng(seed).random(y.shape) < missing] = np.nan
    return truth, hw.Record(record.t, y)


def run(chain, s):
    return _core.ep_run(chain.problem, s[None], np.zeros(1), 300, 1e-10, 1.0, None)


@pytest.mark.parametrize("seed", [0, 2])  # of 1 the likelihood has its maximum where a variance is 0
def test_mode_without_a_prior_is_maximum_likelihood(seed):
    _, record = drawn(120, seed)
    chain = sites(asked(), record)
    z = posterior.nodes(4, 1)
    limits = posterior._LIMITS | {"condition": 0.0, "close": 1e-10, "steps": 60, "reference": 0.0, "again": 0}
    learner = _core.EpFrame(
        chain.frame.problem, chain.free, chain.cap, chain.count, chain.frame.fitted, False, 0.0, -14.0, posterior.WARP, 1.0,
        1.0, z, limits,
    )  # fmt: skip
    found, _ = learner.learn(chain.floor, chain.scale, chain.guess, **chain.data)

    def cost(phi):
        v = np.exp(2 * phi)
        given = hw.KalmanFilter().run(asked(hw.Gaussian(v[:2]), hw.Gaussian(v[2:])), record)
        return -given.loglik

    best = minimize(cost, found["mode"], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12})
    np.testing.assert_allclose(found["mode"], best.x, atol=1e-6)
    # and the likelihood is that of a textbook filter
    v = np.exp(2 * found["mode"])
    own = naive.kf(A, None, C, np.diag(v[:2]), np.diag(v[2:]), record.y, record.seen, np.zeros(2), np.eye(2))
    assert -best.fun == pytest.approx(own[-1].sum(), abs=1e-8)
    assert run(chain, np.r_[np.zeros(4), np.exp(found["mode"])])["log_z"][0] == pytest.approx(own[-1].sum(), abs=1e-8)


SUMS = {
    "gaussian": (UNKNOWN, UNKNOWN),
    "told box": (UNKNOWN, hw.Uniform(0.5) + UNKNOWN),
    "told variance": (hw.Uniform(0.3) + hw.Gaussian([0.04, 0.09]), hw.Uniform.unknown(at_most=5.0) + hw.Gaussian(0.05)),
    "in the dynamics": (hw.Uniform([0.3, 0.2]) + UNKNOWN, UNKNOWN),
    "both": (hw.Uniform.unknown(at_most=5.0) + UNKNOWN, hw.Uniform.unknown(at_most=5.0) + UNKNOWN),
    "one of two": (hw.Gaussian.unknown([0.04, 0.0], [0.04, 9.0]), hw.Gaussian.unknown([0.0, 0.16], [9.0, 0.16])),
}


@pytest.mark.parametrize("correlated", [False, True])
@pytest.mark.parametrize("name", SUMS)
def test_slopes_are_those_of_the_evidence(name, correlated):
    _, record = drawn(15, 3)
    w, e = SUMS[name]
    more = {"E": [[1, 0.4], [0, 1]], "F": [[1, -0.3], [0, 1]]} if correlated else {}
    chain = sites(asked(w, e, **more), record)
    s = np.where(chain.free, 0.7 * np.maximum(chain.guess, 0.2), np.where(chain.floor < chain.cap, 0.0, chain.floor))
    slope = run(chain, s)["slope"][0]
    for j in np.flatnonzero(chain.free):
        up, down = s.copy(), s.copy()
        up[j], down[j] = s[j] * np.exp(1e-3), s[j] * np.exp(-1e-3)
        by_hand = (run(chain, up)["log_z"][0] - run(chain, down)["log_z"][0]) / 2e-3
        assert slope[j] == pytest.approx(by_hand, abs=1e-4 * max(1.0, abs(by_hand)))


@pytest.mark.parametrize("name", SUMS)
def test_told_variances_give_the_same_as_known_ones(name):
    _, record = drawn(20, 4)
    noise = SUMS[name]
    told = []
    for part in noise:
        box, own = (part.uniform, part.gaussian) if isinstance(part, hw.Mixed) else (None, part)
        given = own if own.known else hw.Gaussian(np.where(np.isin(own.at_least, (0.04, 0.16)), own.at_least, 0.1))
        told.append(given if box is None else (box if box.known else hw.Uniform(0.4)) + given)
    known = hw.estimate(asked(*told), record, hw.Posterior())
    chain = sites(asked(*noise), record)
    s = np.where(chain.frame.fitted, np.sqrt(0.1), np.where(chain.frame.uniform, 0.4, 0.0))
    s = np.where(chain.floor == chain.cap, chain.floor, s)
    found = run(chain, s)
    np.testing.assert_allclose(found["x"][0, 1:], known.x, atol=1e-6)
    assert found["log_z"][0] + found["second"][0] == pytest.approx(known.loglik, abs=1e-6)


@pytest.mark.parametrize("rows", [26, 51])
def test_intervals_cover_what_they_say(rows):
    hit, of_v = [], []
    for seed in range(40):
        truth, record = drawn(rows, 100 + seed, missing=0.0)
        est = hw.estimate(asked(), record)
        assert est.method == "Posterior()"
        hit.append([np.mean((lo <= truth.x) & (truth.x <= hi)) for lo, hi in (est.interval(p) for p in (0.5, 0.9))])
        v = est.info["variances"]
        np.testing.assert_allclose(np.r_[est.Q, est.R], v["mean"])
        of_v.append((v["lo"] <= [0.04, 0.09, 0.25, 0.16]) & (v["hi"] >= [0.04, 0.09, 0.25, 0.16]))
    assert np.mean(hit, axis=0) == pytest.approx([0.5, 0.9], abs=0.06)
    assert np.mean(of_v) > 0.82


def test_sums_share_the_noise_between_them():
    model = dataclasses.replace(TRUE, e=hw.Uniform(1.0) + hw.Gaussian(0.04))
    _, record = drawn(300, 5, model, missing=0.0)
    box = hw.estimate(asked(e=hw.Uniform(1.0) + UNKNOWN), record)
    bell = hw.estimate(asked(e=hw.Uniform.unknown(at_most=9.0) + hw.Gaussian(0.04)), record)
    both = hw.estimate(asked(e=hw.Uniform.unknown(at_most=9.0) + UNKNOWN), record)
    np.testing.assert_allclose(box.R, 0.04, atol=0.06)
    np.testing.assert_allclose(bell.r, 1.0, atol=0.2)
    np.testing.assert_allclose(both.r**2 / 3 + both.R, 1 / 3 + 0.04, rtol=0.25)
    for est in (box, bell, both):
        assert est.status.good
        lo, hi = est.info["half_widths"]["lo"], est.info["half_widths"]["hi"]
        assert np.all(lo <= hi)


def test_windows_carry_variances_and_streams_resume():
    truth, record = drawn(120, 6)
    window = hw.Window(hw.Posterior(nodes=16), memory=10)
    est = hw.estimate(asked(), record, window)
    alone = hw.estimate(asked(), record, dataclasses.replace(window, recall=0.0))
    assert est.status.good
    assert est.info["Q"].shape == est.info["R"].shape == (120, 2)
    np.testing.assert_allclose(est.Q, est.info["Q"][-1])
    # what is carried makes it surer than ten rows can
    late = slice(80, None)
    for name, size in (("Q", [0.04, 0.09]), ("R", [0.25, 0.16])):
        assert est.info[name][late].std(axis=0).mean() < alone.info[name][late].std(axis=0).mean()
        np.testing.assert_allclose(est.info[name][-1], size, rtol=1.5)
    lo, hi = est.interval(0.9)
    assert 0.8 < np.mean((lo <= truth.x) & (truth.x <= hi)) < 0.97
    live = hw.stream(asked(), window)
    for k, y in enumerate(record.y):
        if k == 60:
            live = hw.resume(live.snapshot(), asked())
        newest = live.push(y)
    np.testing.assert_allclose(newest.x[0], est.x[-1], rtol=1e-6)
    np.testing.assert_allclose(newest.R, est.R, rtol=1e-6)


def test_half_widths_of_one_noise_survive_a_window_beside_told_ones():
    _, record = drawn(30, 7)
    est = hw.estimate(asked(w=hw.Uniform.unknown(at_most=5.0), e=TRUE.e), record, hw.Window(hw.Posterior(nodes=8), 12))
    assert np.isfinite(est.q).all()
    assert est.r is None
    assert est.Q is None


def test_beside_unknown_entries_losses_outliers_and_curves():
    _, record = drawn(60, 8)
    entry = hw.Linear([[np.nan, 0.2], [0, 0.8]], None, C, UNKNOWN, UNKNOWN, TRUE.x0, theta_bounds=(0.0, 1.0))
    found = hw.estimate(entry, record, hw.Posterior(nodes=8))
    assert found.theta[0] == pytest.approx(0.9, abs=0.25)
    assert np.all(found.info["variances"]["mean"] > 0)
    lossy = asked(loss=hw.Bernoulli(0.9, noise=25.0, sensors=[[0], [1]]))
    y = record.y.copy()
    y[::9, 0] = 5.0
    est = hw.estimate(lossy, hw.Record(record.t, y), hw.Posterior())
    assert np.nanmean(est.gamma[::9, 0]) < 0.2
    assert np.isfinite(est.R).all()
    named = hw.estimate(
        asked(e=hw.Uniform(0.3) + UNKNOWN), hw.Record(record.t, y), hw.Posterior(outliers=True)
    )  # fmt: skip
    assert len(named.info["outliers"]) >= 5
    bent = hw.Nonlinear(lambda x: A @ x, lambda x: C @ x, UNKNOWN, UNKNOWN, TRUE.x0)
    one, two = hw.estimate(bent, record, hw.Posterior()), hw.estimate(asked(), record)
    np.testing.assert_allclose(one.R, two.R, rtol=1e-2)
    np.testing.assert_allclose(one.x, two.x, atol=1e-2)


def test_forecast_and_comparison_use_what_was_found():
    _, record = drawn(60, 9)
    ahead = hw.forecast(asked(), record, 3)
    assert np.all(np.diagonal(ahead.info["S"], axis1=1, axis2=2) > ahead.R)
    still = asked(w=hw.Gaussian(0.0))
    found = hw.compare({"still": still, "moving": asked()}, record, seed=1)
    assert found.best == found.foretells == "moving"


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("name", SUMS)
def test_scale_does_not_matter(name, scale):
    _, record = drawn(12, 10)

    def scaled(noise):
        if isinstance(noise, hw.Mixed):
            return scaled(noise.uniform) + scaled(noise.gaussian)
        power = 1 if isinstance(noise, hw.Uniform) else 2
        if noise.known:
            return (
                hw.Uniform(noise.q * scale) if power == 1 else hw.Gaussian(noise.sized(2, "w").cov().single * scale**2)
            )
        return type(noise).unknown(noise.at_least * scale**power, noise.at_most * scale**power)

    w, e = SUMS[name]
    one = hw.estimate(asked(w, e), record, hw.Posterior(nodes=8))
    two = hw.estimate(
        asked(scaled(w), scaled(e), x0=hw.Normal(np.zeros(2), scale**2)), hw.Record(record.t, record.y * scale),
        hw.Posterior(nodes=8),
    )  # fmt: skip
    assert one.status == two.status
    np.testing.assert_allclose(two.x / scale, one.x, atol=1e-5)
    for name, power in (("half_widths", 1), ("variances", 2)):
        if name in one.info:
            np.testing.assert_allclose(two.info[name]["mean"] / scale**power, one.info[name]["mean"], rtol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_random_windows_never_give_nan(seed):
    rng = np.random.default_rng(seed)
    for _ in range(25):
        n, ny, T = rng.integers(1, 4), rng.integers(1, 3), rng.integers(1, 12)
        scale = 10 ** rng.uniform(-6, 6)
        kinds = [
            hw.Gaussian.unknown(),
            hw.Gaussian.unknown(at_most=rng.choice([1e-12, 1.0]) * scale**2),
            hw.Uniform(scale * rng.choice([0.0, 0.1])) + hw.Gaussian.unknown(),
            hw.Uniform.unknown() + hw.Gaussian.unknown(),
            hw.Gaussian(0.0),
        ]
        w, e = kinds[rng.integers(5)], kinds[rng.integers(4)]
        model = hw.Linear(
            rng.uniform(-1, 1, (n, n)), None, rng.standard_normal((ny, n)), w, e,
            [hw.Box(-scale * np.ones(n), scale * np.ones(n)), None, hw.Normal(np.zeros(n), scale**2)][rng.integers(3)],
            bounds=[None, (-3 * scale * np.ones(n), 3 * scale * np.ones(n))][rng.integers(2)],
        )  # fmt: skip
        y = scale * rng.standard_normal((T, ny)) * rng.choice([0.0, 1.0])  # zero: nothing disturbs at all
        y[rng.random(y.shape) < rng.choice([0.0, 0.3, 1.0])] = np.nan
        est = hw.estimate(model, hw.Record(np.arange(1.0, T + 1), y), hw.Posterior(nodes=8))
        numbers = [est.x, *est.interval(0.9), *(v for v in (est.q, est.r, est.Q, est.R, est.loglik) if v is not None)]
        assert all(np.isfinite(v).all() for v in numbers)
        for value in est.info.get("variances", {}).values():
            assert np.isfinite(value).all()


def test_an_output_that_is_never_seen_says_so():
    _, record = drawn(20, 11)
    y = record.y.copy()
    y[:, 1] = np.nan
    est = hw.estimate(asked(), hw.Record(record.t, y))
    assert "variance not identifiable: y1" in est.info["notes"]
    assert est.status.good


@pytest.mark.parametrize(
    "name",
    ["KalmanFilter", "KalmanSmoother", "ExtendedKalman", "UnscentedKalman", "GPB", "MixedFilter", "MixedWindow",
     "ParticleFilter"],
)  # fmt: skip
def test_methods_that_are_told_all_noise_say_what_finds_it(name):
    reason = load(name)().refuses(asked())
    assert "unknown" in reason
    assert "hint: Posterior()" in reason


def test_the_sampler_and_conversions_refuse():
    assert "variances" in hw.Posterior(method="sample").refuses(asked())
    with pytest.raises(hw.Refused, match="variances"):
        asked().as_gaussian()
    with pytest.raises(hw.Refused, match="variances"):
        hw.simulate(asked(), T=3, seed=1)
    with pytest.raises(hw.BadValue, match=r"Gaussian\.unknown"):
        hw.Gaussian(None)
    with pytest.raises(hw.BadValue):
        hw.Gaussian.unknown(2.0, 1.0)
    assert hw.Gaussian.unknown(2.0, 2.0).known
    assert "at_most" in repr(hw.Gaussian.unknown(at_most=2.0))
