"""The second paper's numbers, with the set-up of its section 6, against our own means within three deviations."""

import numpy as np
import pytest

from halfwidth import reproduce
from halfwidth.reproduce import paper000, paper003

#: Mean and standard deviation over seeds of the interval's volume, theta estimated in [0, 1].
VOLUME = {5: (18.5e-3, 0.45e-3), 10: (8.5e-3, 0.35e-3), 25: (6.1e-3, 0.14e-3)}


@pytest.mark.parametrize("memory", VOLUME)
def test_volume_of_table_one(memory):
    found = paper003.experiment(memory, range(2), unknown=True, correlated=True)
    mean, sd = VOLUME[memory]
    assert abs(np.mean([s.V for s in found]) - mean) < 3 * sd
    assert all(s.unsolved == 0 for s in found)


def test_the_right_kalman_filter_of_table_two():
    errors = []
    for seed in range(2):
        drawn = paper003.draw(seed, correlated=False)
        errors.append(np.abs(paper003.truncated_kalman(drawn, 1.0)[0] - drawn.x)[25:].mean(axis=0))
    np.testing.assert_allclose(np.mean(errors, axis=0), [0.069, 0.059, 0.050], atol=0.003)


def test_the_central_point_beats_the_vertex():
    table = paper003.central_gain(quick=True)
    gain = {row[0]: row[-1] for row in table.rows}
    assert gain["central"] >= 1.2  # 1.37 over all seeds


def test_every_table_prints():
    text = paper000.figure_two(quick=True).text()
    assert "Kalman smoother" in text
    assert reproduce.paper("003") is paper003
    with pytest.raises(ValueError, match="no paper"):
        reproduce.tables("999")
