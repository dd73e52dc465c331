"""Memory by evidence: the chain rule, densities that integrate to 1, and which memory wins."""

import dataclasses

import numpy as np
import pytest

import halfwidth as hw
from halfwidth.methods.memory import _foretold

UNKNOWN = hw.Uniform.unknown(at_most=5.0)
WALK = hw.Linear([[0.9]], None, [[1]], hw.Uniform(0.2), hw.Uniform(0.5), hw.Box([-1], [1]))
ASKED = dataclasses.replace(WALK, w=UNKNOWN, e=UNKNOWN)
QUICK = hw.Posterior(nodes=16)


@pytest.mark.parametrize("noise", [hw.Uniform(0.5), hw.Gaussian(0.1), hw.Uniform(0.4) + hw.Gaussian(0.02)], ids=repr)
def test_with_everything_told_and_held_it_is_the_evidence(noise):
    model = dataclasses.replace(WALK, e=noise)
    _, record = hw.simulate(model, T=24, seed=1)
    choice = hw.choose_memory(model, record, hw.Posterior(), memories=(40,), recall=0.0)
    part = hw.Record(record.t[:12], record.y[:12])
    whole, first = (hw.estimate(model, r, hw.Posterior()).loglik for r in (record, part))
    assert 12 * choice.evidence[0] == pytest.approx(whole - first, abs=0.02)


@pytest.mark.parametrize(
    ("noise", "recall"), [(UNKNOWN, 40.0), (hw.Gaussian.unknown(at_most=9.0), 0.0)], ids=["carried", "alone"]
)
def test_densities_integrate_to_one(noise, recall):
    model = dataclasses.replace(ASKED, e=noise)
    _, record = hw.simulate(WALK, T=9, seed=2)
    window = hw.Window(hw.Posterior(nodes=64), 6, recall=recall)
    grid = np.r_[np.linspace(-9, -2.5, 5), np.linspace(-2, 2, 25), np.linspace(2.5, 9, 5)]
    found = []
    for value in grid:
        y = record.y.copy()
        y[-1] = value
        found.append(_foretold(window, model, hw.Record(record.t, y))[1][-1])
    total = np.trapezoid(np.exp(found), grid)
    assert total == pytest.approx(1.0, abs=0.05)


def drifting(T=140, every=20):
    rng = np.random.default_rng(3)
    r = np.where(np.arange(T) // every % 2, 0.1, 1.5)
    x, y = 0.0, []
    for t in range(T):
        x = 0.9 * x + rng.uniform(-0.2, 0.2)
        y.append(x + rng.uniform(-r[t], r[t]))
    return hw.Record(np.arange(1.0, T + 1), np.array(y)[:, None])


def test_short_windows_win_where_half_widths_drift_and_long_ones_where_they_do_not():
    drift = hw.choose_memory(ASKED, drifting(), QUICK, memories=(8, 40), recall=0.0)
    assert drift.best == 8
    assert drift.evidence[0] > drift.evidence[1]
    _, record = hw.simulate(WALK, T=100, seed=4)
    steady = hw.choose_memory(ASKED, record, QUICK, memories=(8, 40), recall=0.0)
    assert steady.evidence[1] > steady.evidence[0]
    assert "best" in str(steady)
    pytest.importorskip("matplotlib").use("Agg")
    assert "evidence" in steady.plot().get_ylabel()


def test_missing_rows_and_what_no_trajectory_fits():
    _, record = hw.simulate(WALK, T=40, seed=5)
    y = record.y.copy()
    y[30:33] = np.nan
    choice = hw.choose_memory(ASKED, hw.Record(record.t, y), QUICK, memories=(5, 10))
    assert np.isfinite(choice.evidence).all()
    y[35] = 50.0
    told = hw.choose_memory(WALK, hw.Record(record.t, y), QUICK, memories=(5, 10))
    assert np.all(told.evidence == -np.inf)
    assert told.best in (5, 10)
    lp = hw.choose_memory(ASKED, record, memories=(5, 10))
    assert lp.evidence is None
    with pytest.raises(hw.BadValue, match="foretell"):
        hw.choose_memory(ASKED, hw.Record(record.t, np.full((40, 1), np.nan)), QUICK)


@pytest.mark.parametrize("method", [hw.Posterior(nodes=8), hw.SequentialLP(rounds=1)], ids=repr)
def test_of_a_nonlinear_model_errors_alone_choose(method):
    bent = hw.Nonlinear(lambda x: 0.9 * np.sin(x), lambda x: x, UNKNOWN, UNKNOWN, hw.Box([-1], [1]))
    wound = hw.Nonlinear(bent.g, bent.h, UNKNOWN, UNKNOWN, bent.x0, y_angles=(0,))
    _, record = hw.simulate(WALK, T=24, seed=3)
    plain, turned = (
        hw.choose_memory(model, hw.Record(record.t, y), method, memories=(4, 8))
        for model, y in ((bent, record.y), (wound, record.y + 2 * np.pi))
    )
    assert plain.evidence is None
    assert plain.best in (4, 8)
    np.testing.assert_allclose(turned.score, plain.score, rtol=1e-3)
