"""Smoothing a linear Gaussian model is weighted least squares over the whole trajectory, solved densely here."""

import numpy as np
import pytest
from tests.cases import PAIRS

import halfwidth as hw


def least_squares(model, record):
    """Mean (T, nx) of the trajectory given all seen outputs, by one dense solve."""
    t, dt, T, n = record.t, record.steps(model.dt), len(record), model.nx

    def rows(matrix, size):
        if matrix is None:
            return np.broadcast_to(np.eye(size), (T, size, size))
        stack, index = matrix.stack(t, dt)
        return stack[index] if index is not None else np.broadcast_to(stack, (T, *stack.shape[1:]))

    A, C = rows(model.A, n), rows(model.C, model.ny)
    E, F = rows(model.E, n), rows(model.F, model.ny)
    Q, R = rows(model.w.cov(), n), rows(model.e.cov(), model.ny)
    size = n * (T + 1)
    H, h = np.zeros((size, size)), np.zeros(size)

    def add(J, b, W):
        information = np.linalg.inv(W)
        H[:] += J.T @ information @ J
        h[:] += J.T @ information @ b

    J = np.zeros((n, size))
    J[:, :n] = np.eye(n)
    add(J, model.x0.mean, model.x0.P)
    for k in range(T):
        J = np.zeros((n, size))
        J[:, n * k : n * (k + 1)] = -A[k]
        J[:, n * (k + 1) : n * (k + 2)] = E[k]
        b = np.zeros(n) if record.u is None else rows(model.B, n)[k] @ record.u[k]
        add(J, b, Q[k])
        seen = record.seen[k]
        if seen.any():
            fold = np.linalg.inv(F[k])
            J = np.zeros((int(seen.sum()), size))
            J[:, n * (k + 1) : n * (k + 2)] = (fold @ C[k])[seen]
            add(J, record.y[k, seen], (fold @ R[k] @ fold.T)[np.ix_(seen, seen)])
    P = np.linalg.inv(H)
    x = P @ h
    blocks = [P[n * k : n * (k + 1), n * k : n * (k + 1)] for k in range(1, T + 1)]
    return x.reshape(T + 1, n)[1:], np.array(blocks)


SMOOTHERS = [
    (m, c)
    for m, c in PAIRS
    if repr(m) in ("KalmanSmoother(lag=None)", "KalmanSmoother()") or getattr(m, "smooth", False)
    if isinstance(c.model, hw.Linear) and isinstance(c.model.w, hw.Gaussian)
    if type(m).__name__ in ("KalmanSmoother", "ExtendedKalman", "UnscentedKalman")
]


@pytest.mark.parametrize(("method", "case"), SMOOTHERS, ids=str)
def test_smoother(method, case):
    if not isinstance(case.model.e, hw.Gaussian):
        pytest.skip("least squares weights are for Gaussian noise")
    x, P = least_squares(case.model, case.record)
    est = hw.estimate(case.model, case.record, method)
    np.testing.assert_allclose(est.x, x, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(est.P, P, rtol=1e-6, atol=1e-9)
