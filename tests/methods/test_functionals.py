"""Functionals of several rows: a state of its own that sums them up, through E."""

import numpy as np

import halfwidth as hw

A, C = np.array([[0.9, 0.2], [-0.2, 0.9]]), np.eye(2)
WEIGHT = np.array([[0.0, 0.0], [1.0, 0.5], [0.0, 0.0], [-1.0, 0.0], [0.0, 2.0], [0.3, 0.0], [0.0, 0.0], [0.0, -1.0]])


def summing(w, e, x0):
    """s[t] = s[t-1] + WEIGHT[t] x[t], ahead of the two states."""
    E = np.broadcast_to(np.eye(3), (len(WEIGHT), 3, 3)).copy()
    E[:, 0, 1:] = -WEIGHT
    F = np.zeros((3, 3))
    F[0, 0], F[1:, 1:] = 1.0, A
    return hw.Linear(F, None, np.c_[[0, 0], C], w, e, x0, E=E)


def record():
    true = hw.Linear(A, None, C, hw.Uniform(0.1), hw.Uniform(0.3), hw.Box([-1, -1], [1, 1]))
    return hw.simulate(true, T=len(WEIGHT), seed=1)[1].without(3, 5)


def test_of_gaussian_noise_it_is_that_of_the_joint_covariance():
    plain = hw.Linear(A, None, C, hw.Gaussian(0.01), hw.Gaussian(0.09), hw.Normal([0, 0], 1.0))
    rec, T = record(), len(WEIGHT)
    # the joint precision of x0 .. xT
    K, h = np.zeros((2 * T + 2, 2 * T + 2)), np.zeros(2 * T + 2)
    K[:2, :2] = np.eye(2)
    for t in range(T):
        rows = np.zeros((2, 2 * T + 2))
        rows[:, 2 * t : 2 * t + 2], rows[:, 2 * t + 2 : 2 * t + 4] = -A, np.eye(2)
        K += rows.T @ rows / 0.01
        for j in np.flatnonzero(rec.seen[t]):
            K[2 * t + 2 + j, 2 * t + 2 + j] += 1 / 0.09
            h[2 * t + 2 + j] += rec.y[t, j] / 0.09
    a = np.r_[0, 0, WEIGHT.ravel()]
    cov = np.linalg.inv(K)
    model = summing(hw.Gaussian([0, 0.01, 0.01]), plain.e, hw.Normal([0, 0, 0], [0, 1, 1]))
    for method in (hw.Posterior(), hw.KalmanSmoother()):
        est = hw.estimate(model, rec, method)
        np.testing.assert_allclose(est.x[-1, 0], a @ cov @ h, atol=1e-9)
        np.testing.assert_allclose(est.P[-1, 0, 0], a @ cov @ a, atol=1e-9)


def test_of_bounded_noise_it_is_what_draws_say_and_the_states_stay_as_they_are():
    plain = hw.Linear(A, None, C, hw.Uniform(0.1), hw.Uniform(0.3), hw.Box([-1, -1], [1, 1]))
    rec = record()
    est = hw.estimate(summing(hw.Uniform([0, 0.1, 0.1]), plain.e, hw.Box([0, -1, -1], [0, 1, 1])), rec, hw.Posterior())
    alone = hw.estimate(plain, rec, hw.Posterior())
    np.testing.assert_allclose(est.x[:, 1:], alone.x, atol=1e-6)
    draws = hw.estimate(plain, rec, hw.Posterior(method="sample"), seed=1).spread.points
    value = np.einsum("tj,tkj->k", WEIGHT, draws)
    assert abs(est.x[-1, 0] - value.mean()) < 0.06 * value.std()
    for level in (0.5, 0.9):
        lo, hi = est.interval(level)
        assert abs(np.mean((lo[-1, 0] <= value) & (value <= hi[-1, 0])) - level) < 0.03
