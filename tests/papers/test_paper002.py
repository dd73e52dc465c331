"""The slides on two antennas: the shape of their results on simulated drives."""

import numpy as np

from halfwidth import reproduce
from halfwidth.reproduce import paper002


def test_an_outage_of_twenty_seconds_stays_within_the_tolerance():
    _, found = paper002.errors(1, paper002.LENGTH)
    two = found["nonlinear, two antennas"]
    assert two.shape[1] == 4
    assert np.abs(two).max() < paper002.TOLERANCE
    assert np.abs(two).mean() < np.abs(found["linearised"]).mean()
    assert np.hypot(*found["nonlinear, one antenna"].T).max() < 0.1 * np.hypot(*found["straight line"].T).max()


def test_tables_and_figures(tmp_path):
    paper002_tables = reproduce.tables("002", quick=True)
    titles = [table.title for table in paper002_tables]
    assert any("tolerance" in table.text() for table in paper002_tables), titles
    assert len(reproduce.paper("002").figures(tmp_path, quick=True)) == 2
    assert len(list(tmp_path.glob("*.png"))) == 2
    assert reproduce.tables("000", quick=True)[2].header == ("estimator", "px", "py", "within")
