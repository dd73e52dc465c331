"""`Hull` on nonlinear models: guaranteed, inside the cheap set it starts from, refusing what cannot be enclosed."""

import dataclasses
import math

import numpy as np
import pytest

import halfwidth as hw


def pendulum(**more):
    """A damped pendulum seen through the sine of its angle."""
    return hw.Nonlinear(
        lambda x, u, dt: np.array([x[0] + dt * x[1], x[1] - dt * (9.81 * np.sin(x[0]) + 0.3 * x[1] * np.abs(x[1]))]),
        lambda x: np.array([np.sin(x[0])]),
        hw.Uniform([1e-3, 5e-3]),
        hw.Uniform([0.05]),
        hw.Box([0.3, -0.3], [0.7, 0.3]),
        dt=0.05,
        **more,
    )


def cornered(model, T, seed):
    """A trajectory whose noise stands in the corners of its boxes, three in ten outputs and ten rows missing."""
    rng = np.random.default_rng(seed)
    x, states, y = rng.uniform(model.x0.lo, model.x0.hi), [], []
    for _ in range(T):
        x = model.move(x, None, model.dt) + (1 - 1e-9) * rng.choice([-1, 1], 2) * model.w.q
        states.append(x)
        y.append(model.output(x) + (1 - 1e-9) * rng.choice([-1, 1], 1) * model.e.q)
    y = np.array(y)
    y[rng.random(y.shape) < 0.3] = np.nan
    y[T // 2 : T // 2 + 10] = np.nan
    return np.array(states), hw.Record(model.dt * np.arange(1, T + 1), y)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("method", [hw.Hull(), hw.Hull(lag=0), hw.Hull(lag=3)], ids=repr)
def test_the_truth_is_inside_and_the_box_inside_the_zonotopes(method, seed):
    model = pendulum()
    truth, record = cornered(model, 60, seed)
    est = hw.estimate(model, record, method).check()
    assert est.guaranteed
    lo, hi = est.interval()
    assert np.all((lo <= truth) & (truth <= hi))
    low, high = hw.estimate(model, record, hw.ZonotopeFilter()).interval()
    assert np.all(low <= lo)
    assert np.all(hi <= high)
    assert np.mean(hi - lo) < 0.9 * np.mean(high - low)


def test_a_linear_function_gives_the_linear_hull():
    A, C = np.array([[0.9, 0.3], [-0.2, 0.8]]), np.array([[1.0, 0.5]])
    q, r, x0 = hw.Uniform([0.1, 0.05]), hw.Uniform(0.4), hw.Box([-1.0, -1.0], [1.0, 1.0])
    linear = hw.Linear(A, None, C, q, r, x0)
    _, record = hw.simulate(linear, T=30, seed=0)
    bent = hw.Nonlinear(lambda x: A @ x, lambda x: C @ x, q, r, x0)
    for a, b in zip(*(hw.estimate(m, record, hw.Hull()).interval() for m in (linear, bent)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_a_contradiction_is_named():
    model = pendulum()
    _, record = cornered(model, 40, 1)
    y = record.y.copy()
    y[35] = 0.999
    est = hw.estimate(model, hw.Record(record.t, y), hw.Hull())
    assert est.status is hw.Status.INFEASIBLE
    assert est.spread is None
    assert "t = " in est.message


def test_it_is_the_default_and_on_line_the_zonotope():
    model = pendulum()
    _, record = cornered(model, 5, 0)
    assert hw.estimate(model, record).guaranteed
    assert isinstance(hw.stream(model).method, hw.ZonotopeFilter)


def test_what_it_refuses():
    model = pendulum()
    assert "ZonotopeFilter()" in hw.Hull(memory=5).refuses(model)
    bent = dataclasses.replace(model, h=lambda x: np.array([math.sin(float(x[0]))]))
    reason = hw.Hull().refuses(bent)
    assert "`Hull`" in reason
    assert "`h` cannot be recorded" in reason
    with pytest.raises(hw.Refused, match="linear"):
        hw.bound(model, hw.Record([0.05], [0.1]), [1.0, 0.0])
