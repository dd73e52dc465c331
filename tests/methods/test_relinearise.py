"""`Posterior` of nonlinear models: the linearisation settles, windows go on from one another, and models compare."""

import numpy as np
import pytest

import halfwidth as hw

UNKNOWN = hw.Uniform.unknown(at_most=5.0)
X0 = hw.Box([-1, -1], [1, 1])


def swing(x, u):
    return np.array([x[0] + 0.2 * x[1], x[1] - 0.4 * np.sin(x[0]) + u[0]])


def seen(x):
    return np.array([np.sin(x[0]) + 0 * x[1]])


def pendulum(w, e, x0=X0, h=seen):
    """A pendulum that is pushed and may turn over; of its angle the sine is seen."""
    return hw.Nonlinear(swing, h, w, e, x0, nu=1)


def drawn(seed, T=50):
    u = np.random.default_rng(seed).uniform(-0.3, 0.3, (T, 1))
    return hw.simulate(pendulum(hw.Uniform(0.05), hw.Uniform(0.3)), u, seed=seed)


def test_a_whole_record_settles_though_nothing_but_a_sine_is_seen():
    for seed in (10, 11, 12):
        truth, record = drawn(seed)
        est = hw.estimate(pendulum(UNKNOWN, UNKNOWN), record)
        assert est.method == "Posterior()"
        assert est.status is hw.Status.OK
        assert est.info["moved"] < 1e-3
        told = hw.estimate(pendulum(hw.Uniform(0.05), hw.Uniform(0.3)).as_gaussian(), record)
        assert np.abs(est.x - truth.x).mean() < 1.1 * np.abs(told.x - truth.x).mean()


def test_windows_that_do_not_settle_do_not_lose_the_way():
    """Where the angle is hardly seen ten rows do not fix the path: what follows begins at the windows before."""
    truth, record = drawn(12, 35)
    est = hw.estimate(pendulum(UNKNOWN, UNKNOWN), record, hw.Window(hw.Posterior(), memory=10))
    off = np.abs(est.x - truth.x)
    assert np.median(off) < 0.4
    assert off.max() < 4.0
    assert np.mean([status.good for status in est.info["statuses"]]) > 0.8
    assert est.interval()[0].shape == est.x.shape


def test_about_a_prior_that_says_nothing_the_first_path_is_found():
    truth, record = drawn(12)
    both = pendulum(
        UNKNOWN,
        UNKNOWN,
        hw.Box([-1e3, -1e3], [1e3, 1e3]),
        h=lambda x: np.array([np.sin(x[0]), np.cos(x[0]) + 0 * x[1]]),
    )
    y = np.column_stack((np.sin(truth.x[:, 0]), np.cos(truth.x[:, 0])))
    y += np.random.default_rng(1).uniform(-0.3, 0.3, y.shape)
    est = hw.estimate(both, hw.Record(record.t, y, record.u))
    assert est.status.good
    turns = 2 * np.pi * np.round((est.x[:, 0] - truth.x[:, 0]).mean() / (2 * np.pi))
    assert np.abs(est.x[:, 0] - turns - truth.x[:, 0]).mean() < 0.15


def test_nonlinear_models_compare_and_foretell():
    _, record = drawn(12)
    told = pendulum(hw.Uniform(0.05), hw.Uniform(0.3))
    straight = hw.Nonlinear(
        lambda x, u: np.array([x[0] + 0.2 * x[1], x[1] - 0.4 * x[0] + u[0]]), seen, UNKNOWN, UNKNOWN, X0, nu=1
    )
    found = hw.compare({"swings": pendulum(UNKNOWN, UNKNOWN), "linear spring": straight, "told": told}, record, seed=1)
    assert found.loglik[0] > found.loglik[1] + 5
    assert found.score[0] > found.score[1]
    assert found.score[2] > found.score[0] - 0.1
    ahead = hw.forecast(told, record, 3, u=np.zeros((3, 1)), method=hw.Posterior())
    np.testing.assert_allclose(ahead.info["y"][:, 0], np.sin(ahead.x[:, 0]))
    slope = np.cos(ahead.x[:, 0])
    np.testing.assert_allclose(ahead.info["S"][:, 0, 0], slope**2 * ahead.P[:, 0, 0] + 0.03)


def test_an_angle_that_is_foretold_is_wrapped():
    """A wheel that turns on: its angle is seen modulo a turn, and hidden ones are off by less than the noise."""
    model = hw.Nonlinear(
        lambda x: np.array([x[0] + x[1], x[1]]), lambda x: np.array([x[0]]), hw.Uniform([0.01, 0.001]), hw.Uniform(0.1),
        hw.Box([-0.1, 0.65], [0.1, 0.75]), y_angles=(0,),
    )  # fmt: skip
    truth, record = hw.simulate(model, T=60, seed=1)
    assert truth.x[-1, 0] > 30
    y = np.mod(record.y + np.pi, 2 * np.pi) - np.pi
    found = hw.compare({"wheel": model}, hw.Record(record.t, y), seed=1)
    assert found.error[0] * y.std() < 0.1


def test_a_model_that_is_refused_is_named():
    lossy = hw.Nonlinear(swing, seen, UNKNOWN, hw.Uniform(0.3), X0, nu=1, loss=hw.Bernoulli(0.9))
    with pytest.raises(hw.Refused, match="the model 'lossy'"):
        hw.compare({"lossy": lossy}, drawn(10, 5)[1])
