import dataclasses

import numpy as np
import pytest

import halfwidth as hw
from halfwidth.varying import varying

G, S = hw.Gaussian(0.1), hw.Gaussian(1.0)
T, DT = np.array([1.0, 3.0, 4.0, 6.0]), np.array([1.0, 2.0, 1.0, 2.0])


def test_a_function_of_dt_is_called_once_for_each_step():
    calls = []

    def A(dt):
        calls.append(dt)
        return [[dt]]

    matrix = varying(A, "A", (1, 1))
    calls.clear()
    stack, index = matrix.stack(T, DT)
    assert sorted(calls) == [1.0, 2.0]
    np.testing.assert_array_equal(stack[index][:, 0, 0], DT)


def test_a_function_of_t_is_called_for_each_row():
    stack, index = varying(lambda t: [[t]], "A", (1, 1)).stack(T, DT)
    assert index is None
    np.testing.assert_array_equal(stack[:, 0, 0], T)
    stack, _ = varying(lambda t, dt: [[t - dt]], "A", (1, 1)).stack(T, DT)
    np.testing.assert_array_equal(stack[:, 0, 0], T - DT)


def test_constant_and_stacked():
    stack, index = varying(np.eye(2), "A", (2, 2)).stack(T, DT)
    assert stack.shape == (1, 2, 2)
    assert index is None
    rows = np.arange(16.0).reshape(4, 2, 2)
    stack, index = varying(rows, "A", (2, 2)).stack(T, DT)
    np.testing.assert_array_equal(stack, rows)
    assert index is None
    with pytest.raises(hw.BadShape, match="4 rows but the record has 3"):
        varying(rows, "A", (2, 2)).stack(T[:3], DT[:3])


def test_unknown_entries_are_listed_in_the_order_of_the_contract():
    model = hw.Linear(
        [[1.0, np.nan], [0.0, np.nan]], None, [[1.0, np.nan]], G, S, None,
        E=[[1.0, np.nan], [0.0, 1.0]], theta_bounds=([0] * 4, [1] * 4),
    )  # fmt: skip
    assert [f"{e.matrix}[{e.row}, {e.column}]" for e in model.theta_entries] == [
        "A[0, 1]",
        "A[1, 1]",
        "C[0, 1]",
        "E[0, 1]",
    ]
    assert model.theta_bounds.hi.tolist() == [1.0] * 4


def test_as_gaussian_matches_covariances():
    model = hw.Linear(
        np.eye(2), None, [[1.0, 0.0]], hw.Uniform([0.3, 0.6]), hw.Uniform(3.0) + hw.Gaussian(1.0), hw.Box([-1, 0], [1, 6]),
        bounds=(-9, 9),
    )  # fmt: skip
    same = model.as_gaussian()
    np.testing.assert_allclose(np.diag(same.w.cov().single), [0.03, 0.12])
    np.testing.assert_allclose(same.e.cov().single, [[4.0]])
    np.testing.assert_allclose(same.x0.mean, [0, 3])
    np.testing.assert_allclose(np.diag(same.x0.P), [1 / 3, 3.0])
    assert same.bounds is None
    assert model.bounds is not None


def test_replace_keeps_the_rest():
    model = hw.Linear(np.eye(2), None, [[1.0, 0.0]], G, S, hw.Normal([0, 0], 1.0), names=["a", "b"])
    other = dataclasses.replace(model, A=2 * np.eye(2))
    assert other.names.x == ("a", "b")
    np.testing.assert_array_equal(other.A.single, 2 * np.eye(2))
    with pytest.raises(dataclasses.FrozenInstanceError):
        model.dt = 2.0


def test_nonlinear_takes_g_of_one_two_or_three_arguments():
    prior = hw.Normal([1.0, 2.0], 1.0)
    for g, want in (
        (lambda x: 2 * x, [2.0, 4.0]),
        (lambda x, u: x + u[0], [4.0, 5.0]),
        (lambda x, u, dt: x * dt + u[0], [3.5, 4.0]),
    ):
        model = hw.Nonlinear(g, lambda x: x[:1], G, S, prior, nu=1)
        np.testing.assert_allclose(model.move(prior.mean, np.array([3.0]), 0.5), want)


def test_a_function_may_write_on_its_argument():
    def g(x):
        x[0] = 5.0
        return x

    model = hw.Nonlinear(g, lambda x: x[:1], G, S, hw.Normal([1.0, 2.0], 1.0))
    x = np.array([1.0, 2.0])
    model.move(x, None, 1.0)
    assert x.tolist() == [1.0, 2.0]


def test_simulated_records_obey_the_model():
    model = hw.Linear(
        [[0.9, 0.1], [0.0, 0.8]], [[1.0], [0.0]], [[1.0, 1.0], [0.0, 1.0]], hw.Uniform([0.1, 0.2]), hw.Uniform(0.3),
        hw.Box(-1, 1), E=[[1.0, 0.4], [0.0, 1.0]], F=[[1.0, -0.3], [0.0, 1.0]], dt=0.5,
    )  # fmt: skip
    u = np.linspace(0, 1, 50)[:, None]
    truth, record = hw.simulate(model, u, seed=2)
    before = np.vstack([truth.x0, truth.x[:-1]])
    w = truth.x @ model.E.single.T - before @ model.A.single.T - u @ model.B.single.T
    e = record.y @ model.F.single.T - truth.x @ model.C.single.T
    np.testing.assert_allclose(w, truth.w, atol=1e-12)
    np.testing.assert_allclose(e, truth.e, atol=1e-12)
    assert np.all(np.abs(w) <= [0.1, 0.2])
    np.testing.assert_allclose(record.t, 0.5 * np.arange(1, 51))
    np.testing.assert_array_equal(np.asarray(truth), truth.x)
    again, _ = hw.simulate(model, u, seed=2)
    np.testing.assert_array_equal(again.x, truth.x)
