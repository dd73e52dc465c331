"""The two simulations of the mixed-noise estimator, and the tables about its parts."""

import numpy as np

from halfwidth import reproduce
from halfwidth.reproduce import paper004


def test_example_one():
    """The half-width of the set stays 1, sigma falls with the root of k, the interval goes to [10.5, 12.5]."""
    found = paper004.same_source(6).found
    np.testing.assert_allclose(np.sqrt(found.E), 1.0, atol=1e-9)
    k = np.arange(1, 1001)
    np.testing.assert_allclose(np.sqrt(found.S[-1]), 3 / np.sqrt(1000), rtol=0.01)
    lo, hi = found.interval()
    wider = 9 / np.sqrt(1000)
    assert np.abs(lo[-1] - (10.5 - wider)).max() < 0.3
    assert np.abs(hi[-1] - (12.5 + wider)).max() < 0.3
    assert np.mean((lo <= paper004.Z) & (hi >= paper004.Z)) >= 0.99
    assert np.all(np.sqrt(found.S[9:]) <= 3.03 / np.sqrt(k[9:])[:, None])


def test_example_two():
    found = paper004.different_sources(6).found
    half = np.sqrt(found.E[-1])
    assert np.all((half >= 0.5) & (half <= 0.65))
    lo, hi = found.interval()
    assert np.mean((lo <= paper004.Z) & (hi >= paper004.Z)) >= 0.99


def test_tables():
    assert reproduce.paper("004") is paper004
    borders = paper004.borders()
    assert all(abs(v) < 1e-12 for row in borders.rows for v in row[1:] if v is not None)
    rows = {row[0]: row for row in paper004.sums(quick=True).rows}
    assert rows["21 terms"][2] <= 0.01
    assert rows["81 terms"][2] <= 0.001
    assert rows["3 steps, mean and variance alone"][4] < 2e-3
    assert "40 heaviest" in paper004.sums(quick=True).text()
