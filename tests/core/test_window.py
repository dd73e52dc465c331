"""core/window.hpp against NumPy."""

import halfwidth._core as _core
import numpy as np
import pytest


@pytest.mark.parametrize("seed", range(6))
def test_forecasts_and_notes(seed):
    rng = np.random.default_rng(seed)
    rows, n, nu = rng.integers(1, 9, 3)
    x, A, B, u = rng.standard_normal((rows, n)), *(rng.standard_normal(s) for s in ((n, n), (n, nu), nu))
    box = (None, None) if seed % 2 else (-np.ones(n), np.ones(n))
    moved = x.copy()
    _core.window_forecast(moved, A, B, u, *box)
    expected = x @ A.T + B @ u
    np.testing.assert_allclose(moved, expected if seed % 2 else np.clip(expected, -1, 1), atol=1e-12)
    _core.window_forecast(moved, A, None, None, None, None)
    grown = rng.random(n)
    low, high = _core.window_ends(x, grown)
    np.testing.assert_allclose(low[0], x.min(axis=0) - grown)
    np.testing.assert_allclose(high[0], x.max(axis=0) + grown)
    low, high = rng.standard_normal((2, rows, n))
    twins = np.minimum(low, x), np.maximum(high, x)
    _core.window_note(x, low, high)
    np.testing.assert_array_equal((low, high), twins)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_sizes(scale):
    rng = np.random.default_rng(1)
    y = scale * rng.standard_normal((9, 4))
    y[:, 1] = 3.0 * scale  # never moves, nor varies
    seen = [y[:, 0], y[:, 1], y[:0, 2], y[::2, 3]]
    effect = rng.random((4, 3))
    effect[:, 2] = 0.0
    found = _core.window_sizes(effect, seen)
    steps = [np.abs(np.diff(v)).mean() for v in (seen[0], seen[3])]
    np.testing.assert_allclose(found[3:], [steps[0], 1.0, 1.0, steps[1]])
    gram = (effect[[0, 1, 3]] / found[[3, 4, 6], None] ** 2).sum(axis=0)
    np.testing.assert_allclose(found[:3], np.where(gram > 0, 1 / np.sqrt(np.where(gram > 0, gram, 1)), 1.0))
    one = _core.window_sizes(effect[:1], [y[:1, 0]])
    assert one[-1] == 1.0


def test_shapes_are_judged():
    x = np.zeros((2, 3))
    for wrong in (
        lambda: _core.window_forecast(x, np.eye(2), None, None, None, None),
        lambda: _core.window_forecast(x, np.eye(3), np.zeros((3, 2)), np.zeros(1), None, None),
        lambda: _core.window_ends(x, np.zeros(2)),
        lambda: _core.window_note(x[:1], x, x.copy()),
        lambda: _core.window_sizes(np.zeros((2, 3)), [np.zeros(4)]),
    ):
        with pytest.raises(ValueError, match=r"n,|rows,n|ny,nx"):
            wrong()
