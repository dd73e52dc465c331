"""Errors of fixes that fade from a gap: found with their size and time constant, or not at all."""

from dataclasses import replace

import numpy as np
import pytest

from halfwidth.vehicle import fill, simulate_drive
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.fade import fades
from halfwidth.vehicle.formats import read
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.stamps import restamped
from halfwidth.vehicle.stray import strays

GAP = (80.0, 100.0)


@pytest.fixture(scope="module")
def drive():
    _, log = simulate_drive(duration=180.0, outages=(GAP,), fix_noise=0.1, fix_offset=0.1, fix_rate=5.0, seed=6)
    sensors = calibrated(log)
    return sampled(log, sensors=sensors), sensors


def faded(grid, east, north, tau, *, backwards=False):
    """Return the grid with a fade on one end of the gap, the nodes that it may be in, and their seconds from the gap."""
    end = GAP[0] if backwards else GAP[1]
    nodes = np.flatnonzero(grid.seen & (np.abs(grid.t - end) <= 30) & ((grid.t <= end) == backwards))
    since = np.abs(grid.t[nodes] - grid.t[nodes[-1 if backwards else 0]])
    left = np.exp(-since / tau)
    x, y = grid.east.copy(), grid.north.copy()
    x[nodes] += east * left
    y[nodes] += north * left
    return replace(grid, east=x, north=y), nodes, since


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize(("east", "north", "tau"), [(6.0, -8.0, 3.0), (0.0, 40.0, 1.3), (5.0, 0.0, 6.0)])
def test_a_fade_is_found_with_its_size_and_time(drive, backwards, east, north, tau):
    grid, nodes, since = faded(drive[0], east, north, tau, backwards=backwards)
    (fade,) = fades([grid], [nodes], [since])
    assert fade.gain > fade.worth + 5
    assert np.hypot(fade.east - east, fade.north - north) < 0.25 * np.hypot(east, north)
    assert fade.tau == pytest.approx(tau, rel=0.4)
    back = fade.removed(grid, nodes, since)
    off = np.hypot(back.east - drive[0].east, back.north - drive[0].north)[nodes]
    assert off.max() < 0.25 * np.hypot(east, north)


def test_several_gaps_are_answered_as_each_alone(drive):
    spoiled = [faded(drive[0], 6.0, -8.0, 3.0), faded(drive[0], 0.0, 0.0, 1.0), faded(drive[0], 9.0, 0.0, 5.0)]
    together = fades(*(list(part) for part in zip(*spoiled, strict=True)))
    for found, (grid, nodes, since) in zip(together, spoiled, strict=True):
        (alone,) = fades([grid], [nodes], [since])
        assert (found.east, found.tau, found.gain) == pytest.approx((alone.east, alone.tau, alone.gain), rel=1e-6)
    assert together[1].gain < together[1].worth
    assert fades([], [], []) == []


def test_numbers_without_sense_are_no_fade(drive):
    grid, nodes, since = faded(drive[0], 6.0, -8.0, 3.0)
    for far in (1e200, np.nan):
        (fade,) = fades([replace(grid, north=np.where(grid.seen, far, grid.north))], [nodes], [since])
        assert fade.gain == 0
        assert not np.isnan(fade.worth)


@pytest.mark.parametrize("backwards", [False, True])
def test_only_the_end_that_fades_is_left_out(drive, backwards):
    grid, _, _ = faded(drive[0], 6.0, -8.0, 3.0, backwards=backwards)
    found = strays(grid, drive[1])
    times = grid.t[found.at]
    assert times.size
    assert ((times <= GAP[0]) == backwards).all()
    assert found.size.max() == pytest.approx(10.0, rel=0.25)
    assert np.ptp(np.concatenate((times, grid.t[found.tail]))) > 6.0  # down to what is felt no more
    # the tail stays, without what is left of the fade
    assert found.tail.size
    off = np.hypot(grid.east - drive[0].east, grid.north - drive[0].north)
    back = found.masked(grid)
    left = np.hypot(back.east - drive[0].east, back.north - drive[0].north)
    assert off[found.at].min() > off[found.tail].max()
    assert left[found.tail].max() < 0.75 * off[found.tail].max()
    assert back.seen[found.tail].all()
    assert "put right" in found.words(grid)


@pytest.mark.parametrize(("begin", "length"), [(120.4, 30.0), (117.4, 10.0), (80.3, 10.0)])
def test_where_reckoning_is_bad_no_fade_is_seen(data, begin, length):
    # the chain is 2.4 times too sure of this log, and takes its drifts for fades of 2 to 6 m
    log = restamped(read(next(data.glob("balzer*.csv.gz"))))[0]
    known = calibrated(log)
    grid = sampled(log, sensors=known).without(begin, begin + length)
    times = grid.t[strays(grid, known).at]
    assert not ((times > begin - 30) & (times < begin + length + 30)).any()


def test_a_wrong_speed_in_a_gap_is_no_fade_of_the_fixes(drive):
    grid, sensors = drive
    lost = (grid.t > GAP[0] + 5) & (grid.t < GAP[0] + 13)
    wrong = np.where(lost, 0.5 * grid.speed, grid.speed)
    # whether the sensor is known to be silent there or not: a jump of the slow error explains it as well
    for sd in (grid.speed_sd, np.where(lost, 0.5, grid.speed_sd)):
        assert not strays(replace(grid, speed=wrong, speed_sd=sd), sensors).at.size


@pytest.mark.parametrize("seed", [2, 4])
@pytest.mark.parametrize("tunnel", [10.0, 25.0])
def test_multipath_behind_a_tunnel_does_not_bend_the_way_through_it(seed, tunnel):
    truth, log = simulate_drive(duration=240, seed=seed, tunnels=[tunnel], fix_offset=0.4, multipath=4.0)
    track = fill(log)
    (begin, end), *_ = truth.outages
    inside = (track.t_s > begin) & (track.t_s < end)
    error = np.hypot(*truth.error_m(track.t_s, track.lat_deg, track.lon_deg))
    assert error[inside].max() < 1.5  # .3 m without multipath, 3 to 5 m where it is believed
