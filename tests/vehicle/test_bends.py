"""Which way a car went round in gaps without a yaw rate: guesses, what fits of them, and what it is good for."""

from dataclasses import replace

import numpy as np
import pytest

from halfwidth.vehicle import bends, chain
from halfwidth.vehicle.frames import Frame
from halfwidth.vehicle.grid import Grid

GAP = (70.0, 90.0)


def town(seed, silent=True):
    """A drive round the corners of a town, with a gap in which the yaw rate is silent; its nodes, and the truth."""
    rng = np.random.default_rng(seed)
    h = 0.2
    t = np.arange(0, 160, h)
    rate, k = np.zeros(t.size), 0
    while k < t.size:
        k += int(rng.uniform(2, 10) / h)
        n = int(rng.uniform(3, 5) / h)
        rate[k : k + n] = rng.choice([-1, 1]) * np.pi / 2 / (n * h)
        k += n
    speed = 8 + 2 * np.sin(t / 9)
    azimuth = 1 - np.cumsum(rate) * h
    middle = azimuth + 0.5 * rate * h
    truth = np.cumsum(speed * np.array([np.sin(middle), np.cos(middle)]), axis=1) * h
    east, north = truth + 0.1 * rng.standard_normal((2, t.size))
    none, all_ = np.zeros(t.size), np.ones(t.size, dtype=bool)
    gyro = rate + 0.002 * rng.standard_normal(t.size)
    grid = Grid(t, east, north, all_, none + np.nan, speed, gyro, none, none, True, True, Frame(52.0, 13.0))
    inside = (t > GAP[0]) & (t < GAP[1])
    return grid.masked(inside, ("yaw_rate",) if silent else ()), inside, truth, azimuth


def worst(fit, inside, truth):
    return float(np.hypot(fit.path.east - truth[0], fit.path.north - truth[1])[inside].max())


def test_gaps_without_a_yaw_rate_are_found():
    grid = town(0)[0]
    ((a, b),) = bends.unturned(grid)
    assert grid.seen[a]
    assert grid.seen[b]
    assert not grid.seen[a + 1 : b].any()
    assert grid.t[a] <= GAP[0]
    assert grid.t[b] >= GAP[1]
    assert bends.unturned(town(0, silent=False)[0]) == []
    # a log without the sensor lacks it in each gap; one whose fixes are all there has none
    assert bends.unturned(replace(town(0, silent=False)[0], has_yaw_rate=False)) == [(a, b)]
    assert bends.unturned(replace(grid, seen=np.ones(len(grid), dtype=bool))) == []
    assert bends.unturned(replace(grid, seen=np.arange(len(grid)) == 5)) == []
    # one fix a second and five nodes: only the gap is one
    sparse = replace(grid, seen=grid.seen & (np.arange(len(grid)) % 5 == 0), has_yaw_rate=False)
    ((a, b),) = bends.unturned(sparse)
    assert (grid.t[a], grid.t[b]) == pytest.approx(GAP)


@pytest.mark.parametrize("turn", [-1.5, -0.2, 0.0, 1.2, 2.5])
def test_a_cubic_path_follows_an_arc(turn):
    # constant speed about a circle, the yaw rate missing for eight seconds
    t = np.arange(0, 48, 0.2)
    azimuth = 0.4 + turn * np.clip((t - 20) / 8, 0, 1)
    middle = np.concatenate((azimuth[:1], 0.5 * (azimuth[1:] + azimuth[:-1])))
    step = 10 * 0.2 * np.array([np.sin(middle), np.cos(middle)])
    east, north = np.cumsum(step, axis=1)
    none = np.zeros(t.size)
    seen = (t <= 20) | (t >= 28)
    gyro = -np.gradient(azimuth, t) * seen
    grid = Grid(t, east, north, seen, none + np.nan, none + 10, gyro, none, none, True, True, Frame(52.0, 13.0))
    a, b = 100, 140
    found = bends.curved(grid, a, b, azimuth)
    assert found.shape == (41,)
    assert np.abs(np.diff(found)).max() < 0.3
    assert np.abs(found - azimuth[a : b + 1]).max() < 0.1 + 0.2 * abs(turn)
    assert found[-1] - found[0] == pytest.approx(turn, abs=0.15)


def test_the_rest_follows_by_whole_turns():
    own = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
    found = bends.joined(own, np.array([0.1, 3.0, 6.5]) + 4 * np.pi, 1, 3)
    np.testing.assert_allclose(found, [0.0, 0.1, 3.0, 6.5, 0.4 + 2 * np.pi])


def test_the_likelier_way_is_taken():
    grid, _, _, azimuth = town(0)
    ((a, b),) = bends.unturned(grid)
    asked = []

    def trial(which, parts, starts):
        asked.append((list(which), [len(part) for part in parts], starts))
        return [(0.0, starts[0]), (1.0, starts[1] + 0.01)]

    own = azimuth + np.where(np.arange(len(grid)) >= b, 2 * np.pi, 0) + np.linspace(0, 1.0, len(grid))
    (found,) = bends.started([grid], [own], trial)
    ((which, sizes, starts),) = asked
    assert which == [0, 0]
    assert sizes[0] == sizes[1] < len(grid)
    first = a - int(np.searchsorted(grid.t, grid.t[a] - 20))
    np.testing.assert_allclose(found[a : b + 1], starts[1][first : first + b - a + 1] + 0.01)
    np.testing.assert_array_equal(found[:a], own[:a])
    np.testing.assert_allclose(np.exp(1j * found[b + 1 :]), np.exp(1j * own[b + 1 :]))
    for usual, other in ((1.0, 0.0), (0.0, np.nan), (0.0, -np.inf)):
        kept = bends.started([grid], [own], lambda _, __, s, u=usual, o=other: [(u, s[0]), (o, s[1])])
        assert kept[0] is own
    # an azimuth that is near the other guess is not tried at all
    near = bends.joined(own, bends.curved(grid, a, b, own), a, b)
    assert bends.started([grid], [near], None)[0] is near


def test_gaps_without_a_yaw_rate_are_not_solved_from_the_wrong_side(monkeypatch):
    off, loglik = {}, {}
    for way in ("usual", "both"):
        if way == "usual":
            monkeypatch.setattr(chain, "started", lambda drives, azimuths, trial: azimuths)
        else:
            monkeypatch.undo()
        cases = [town(seed) for seed in (0, 2, 6, 9, 10, 18)]
        fits = chain.solve([case[0] for case in cases])
        off[way] = np.array([worst(fit, *case[1:3]) for fit, case in zip(fits, cases, strict=True)])
        loglik[way] = np.array([fit.loglik for fit in fits])
    assert (loglik["both"] >= loglik["usual"]).all()
    assert (loglik["both"] > loglik["usual"] + 5).sum() >= 3
    assert off["both"].mean() < 0.4 * off["usual"].mean()
    assert (off["both"] < off["usual"] + 1).all()


def test_hidden_fixes_are_filled_from_the_better_side_as_well():
    cases = [town(seed) for seed in (2, 6, 18)]
    sigma = np.array([chain.solve([town(seed, silent=False)[0]])[0].sigma for seed in (2, 6, 18)])
    settings = chain.Chain(rounds=10)
    both = chain.solve([case[0] for case in cases], settings, sigma=sigma, learn=False)
    usual = [chain.azimuth_of(case[0]) for case in cases]
    one = chain.solve([case[0] for case in cases], settings, sigma=sigma, azimuth=usual, learn=False)
    assert sum(both[k].loglik > one[k].loglik + 5 for k in range(3)) >= 2
    for k, case in enumerate(cases):
        assert both[k].loglik > one[k].loglik
        assert worst(both[k], *case[1:3]) < 0.5 * worst(one[k], *case[1:3])
