"""Sequential linear programs: unknown entries, drift, nonlinear models."""

import numpy as np
import pytest

import halfwidth as hw
from halfwidth.methods.sequential import LinearRows

NAN = float("nan")
SMALL = hw.Uniform.unknown(at_most=1.0)


def test_a_noise_free_parameter_is_exact():
    decay = hw.Linear([[NAN]], None, [[1]], SMALL, SMALL, None, theta_bounds=(0.0, 1.0))
    est = hw.estimate(
        decay, hw.Record(range(20), [0.9**k for k in range(20)]), hw.SequentialLP(point="optimal")
    ).check()
    assert est.theta == pytest.approx([0.9], abs=1e-6)
    assert est.q == pytest.approx([0], abs=1e-6)


@pytest.mark.parametrize("matrix", ["A", "B", "C", "E", "F"])
def test_an_unknown_entry_of_each_matrix(matrix):
    A, B, C = np.array([[0.8, 0.2], [-0.1, 0.7]]), np.array([[1.0], [0.5]]), np.array([[1.0, 0.3], [0.2, 1.0]])
    E, F = np.array([[1, 0.4], [0, 1.0]]), np.array([[1, 0.3], [0, 1.0]])
    matrices = {"A": A, "B": B, "C": C, "E": E, "F": F}
    entry = {"A": (0, 1), "B": (1, 0), "C": (0, 1), "E": (0, 1), "F": (0, 1)}[matrix]
    true = hw.Linear(A, B, C, hw.Uniform(0.02), hw.Uniform(0.02), hw.Box([0, 0], [0, 0]), E=E, F=F)
    _, record = hw.simulate(true, np.random.default_rng(0).uniform(-1, 1, 200), seed=1)
    record = record.without(50.0, 55.0)
    value = matrices[matrix][entry]
    matrices[matrix] = matrices[matrix].copy()
    matrices[matrix][entry] = NAN
    model = hw.Linear(
        matrices["A"], matrices["B"], matrices["C"], SMALL, SMALL, None, E=matrices["E"], F=matrices["F"],
        theta_bounds=(-1, 1),
    )  # fmt: skip
    est = hw.estimate(model, record, hw.SequentialLP()).check()
    assert est.theta == pytest.approx([value], abs=0.1)
    history = np.array(est.info["history"])
    assert history[-1] <= history[0]


def test_the_linearisation_is_the_derivative():
    model = hw.Linear(
        [[NAN, 0.2], [0.1, 0.5]],
        [[1], [NAN]],
        [[1, NAN]],
        SMALL,
        SMALL,
        None,
        E=[[1, NAN], [0, 1]],
        theta_bounds=(-1, 1),
    )
    rng = np.random.default_rng(0)
    record = hw.Record(np.arange(6.0), rng.normal(size=(6, 1)), rng.normal(size=(6, 1)))
    rows = LinearRows(model, record, None)
    x, theta = rng.normal(size=(7, 2)), rng.uniform(-1, 1, 4)
    chain = rows.chain(x, theta, np.ones(3))
    base = rows.residuals(x, theta)
    dx, dtheta = rng.normal(size=x.shape), rng.normal(size=4)
    E = chain.E
    for h in (1e-4, 1e-5):
        moved = rows.residuals(x + h * dx, theta + h * dtheta)
        X, th = x + h * dx, theta + h * dtheta
        linear = np.hstack([X[1:] @ E.T - X[:-1] @ chain.A.T - chain.bx, X[1:] @ chain.C.T - chain.by]) + chain.G @ th
        np.testing.assert_allclose(linear, moved, atol=20 * h * h)
    np.testing.assert_allclose(
        np.hstack([x[1:] @ E.T - x[:-1] @ chain.A.T - chain.bx, x[1:] @ chain.C.T - chain.by]) + chain.G @ theta, base
    )


def test_drift_follows_a_parameter_that_moves():
    T = 200
    true = np.linspace(0.2, 0.6, T)
    x, u, rng = np.zeros(T + 1), np.random.default_rng(0).uniform(-1, 1, T), np.random.default_rng(1)
    for t in range(T):
        x[t + 1] = true[t] * x[t] + u[t] + rng.uniform(-0.01, 0.01)
    record = hw.Record(np.arange(float(T)), x[1:] + rng.uniform(-0.01, 0.01, T), u)
    model = hw.Linear([[NAN]], [[1]], [[1]], SMALL, SMALL, None, theta_bounds=(0, 1))
    still = hw.estimate(model, record, hw.SequentialLP()).check()
    moving = hw.estimate(model, record, hw.SequentialLP(drift=1.0)).check()
    assert moving.theta == pytest.approx([0.6], abs=0.1)
    assert moving.info["drift"] == pytest.approx([0.4], abs=0.15)
    assert moving.info["objective"] < 0.8 * still.info["objective"]


def test_a_nonlinear_model():
    def g(x, u):
        return np.stack([x[0] + 0.1 * x[1], x[1] - 0.1 * np.sin(x[0]) + 0.1 * u[0]])

    model = hw.Nonlinear(g, lambda x: x[:1], hw.Uniform(0.005), hw.Uniform(0.1), hw.Box([0.9, -0.1], [1.1, 0.1]), nu=1)
    truth, record = hw.simulate(model, np.zeros(150), seed=0)
    unknown = hw.Nonlinear(
        g,
        lambda x: x[:1],
        hw.Uniform.unknown(at_most=0.1),
        hw.Uniform.unknown(at_most=1.0),
        hw.Box([0, -1], [2, 1]),
        nu=1,
    )
    est = hw.estimate(unknown, record.without(50.0, 60.0), hw.SequentialLP()).check()
    assert np.abs(est.x - truth.x).mean() < 0.06
    assert np.all(np.abs(est.info["w"]) <= est.q + 1e-9)


def test_refusals_and_settings():
    with pytest.raises(hw.BadValue):
        hw.SequentialLP(point="least_squares")
    with pytest.raises(hw.BadValue):
        hw.SequentialLP(rounds=0)
    with pytest.raises(hw.BadValue):
        hw.SequentialLP(drift=-1.0)
    gaussian = hw.Linear([[1]], None, [[1]], hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0], 1.0))
    with pytest.raises(hw.Refused):
        hw.estimate(gaussian, hw.Record([0], [0.0]), hw.SequentialLP())
