"""core/chain.hpp against dense algebra."""

import numpy as np
import pytest

from halfwidth import _core


def system(rng, T, n, q):
    """Return a positive definite bordered chain and the dense matrix it stands for."""
    size = T * n + q
    M, off = np.zeros((T, n, n)), np.zeros((T, n, n))
    B, K = np.zeros((T, q, n)), np.zeros((q, q))
    dense = np.zeros((size, size))
    for t in range(T):
        for _ in range(n + q + 2):  # rows that touch t, t-1 and the border, as a residual does
            row = np.zeros(size)
            row[t * n : (t + 1) * n] = rng.standard_normal(n)
            if t:
                row[(t - 1) * n : t * n] = rng.standard_normal(n)
            row[T * n :] = rng.standard_normal(q)
            dense += rng.uniform(0.1, 10) * np.outer(row, row)
    for t in range(T):
        M[t] = dense[t * n : (t + 1) * n, t * n : (t + 1) * n]
        B[t] = dense[T * n :, t * n : (t + 1) * n]
        if t:
            off[t] = dense[t * n : (t + 1) * n, (t - 1) * n : t * n]
    K[:] = dense[T * n :, T * n :]
    return M, off, B, K, dense


@pytest.mark.parametrize("n", range(1, 11))
@pytest.mark.parametrize(("T", "q"), [(1, 0), (1, 3), (2, 1), (7, 0), (23, 4)])
def test_solution_and_inverse_blocks(n, T, q):
    rng = np.random.default_rng(100 * n + T + q)
    M, off, B, K, dense = system(rng, T, n, q)
    rhs = rng.standard_normal(T * n + q)
    f, k = rhs[: T * n].reshape(T, n), rhs[T * n :]
    given = [a.copy() for a in (M, off, B, K, f, k)]
    x, z, S, C, H, Ki, code = _core.chain_solve(M, off, B, K, f, np.ascontiguousarray(k), inverse=True)
    assert code == 0
    inverse = np.linalg.inv(dense)
    scale = np.abs(inverse).max() * np.linalg.cond(dense) * 1e-15 + 1e-11 * np.abs(inverse).max()
    expected = np.linalg.solve(dense, rhs)
    np.testing.assert_allclose(np.r_[x.ravel(), z], expected, rtol=1e-8, atol=1e-11 * np.abs(expected).max() + scale)
    for t in range(T):
        here = slice(t * n, (t + 1) * n)
        np.testing.assert_allclose(S[t], inverse[here, here], rtol=1e-8, atol=scale)
        np.testing.assert_allclose(H[t], inverse[here, T * n :], rtol=1e-8, atol=scale)
        if t:
            np.testing.assert_allclose(C[t], inverse[here, (t - 1) * n : t * n], rtol=1e-8, atol=scale)
    np.testing.assert_allclose(Ki, inverse[T * n :, T * n :], rtol=1e-8, atol=scale)
    for before, after in zip(given, (M, off, B, K, f, k), strict=True):
        np.testing.assert_array_equal(before, after)


def test_instruction_sets_agree():
    rng = np.random.default_rng(0)
    M, off, B, K, _ = system(rng, 20, 4, 3)
    f, k = rng.standard_normal((20, 4)), rng.standard_normal(3)
    best = _core.chain_solve(M, off, B, K, f, k)
    try:
        _core.use_isa(False)
        plain = _core.chain_solve(M, off, B, K, f, k)
    finally:
        _core.use_isa(True)
    np.testing.assert_allclose(best[0], plain[0], rtol=1e-9, atol=1e-11)
