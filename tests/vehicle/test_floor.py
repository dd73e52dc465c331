"""The floor of the error across gaps: nothing where fixes are right, a known amount where they jump."""

from dataclasses import replace

import numpy as np
import pytest

from halfwidth.vehicle import simulate_drive

#: Where the fixes jump, s, and by how much, m; the outage about it and one without.
AT, JUMP, OUTAGE, CALM, LENGTH = 120.0, 2.0, 115.0, 60.0, 10.0


@pytest.fixture(scope="module")
def floor(bench):
    return bench("floor")


@pytest.fixture(scope="module")
def fixes(floor):
    """Good fixes that jump north once and stay there."""
    _, log = simulate_drive(duration=240.0, seed=3, tunnels=(), fix_noise=0.002, fix_offset=0.0, multipath=0.0)
    later = log.t >= AT
    return floor.Fixes(replace(log, lat_deg=log.lat_deg + np.where(later, JUMP / 111_200.0, 0.0)))


def test_right_fixes_have_no_floor(floor, fixes):
    mean, largest = floor.both(*fixes.cell([CALM], LENGTH))
    assert mean < 0.05
    assert largest < 0.15
    assert not fixes.jumps([CALM], LENGTH)[0]


@pytest.mark.parametrize("kind", ["error", "reckoned"])
def test_a_jump_in_the_middle_costs_a_quarter_of_it(floor, fixes, kind):
    mean, largest = floor.both(*fixes.cell([OUTAGE], LENGTH, getattr(fixes, kind)))
    assert mean == pytest.approx(JUMP / 4, rel=0.15)
    assert largest == pytest.approx(JUMP / 2, rel=0.15)
    assert fixes.jumps([OUTAGE], LENGTH)[0]


def test_told_when_it_jumps_nothing_is_left(floor, fixes):
    mean, _ = floor.both(*fixes.cell([OUTAGE], LENGTH, told=True))
    assert mean < 0.2 * JUMP / 4


def test_hidden_fixes_lie_between_two_others(fixes):
    rows = fixes.hidden(OUTAGE, LENGTH)
    inside = fixes.t[rows[1:-1]]
    assert fixes.t[rows[0]] < OUTAGE <= inside[0]
    assert inside[-1] <= OUTAGE + LENGTH < fixes.t[rows[-1]]
