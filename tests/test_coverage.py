"""`coverage` and `ranks`: honest intervals pass, others fail, and rows that are alike count for less."""

import dataclasses

import matplotlib as mpl
import numpy as np
import pytest

import halfwidth as hw

mpl.use("Agg")

WALK = hw.Linear([[0.9]], None, [[1]], hw.Gaussian(0.2), hw.Gaussian(1.0), hw.Normal([0.0], 1.0))


def solved(model, count=60, T=30, method=None):
    found = []
    for seed in range(count):
        truth, record = hw.simulate(WALK, T=T, seed=seed)
        found.append((hw.estimate(model, record, method), truth))
    return [e for e, _ in found], [x for _, x in found]


HONEST, TRUE = solved(WALK)


def test_honest_intervals_lie_in_the_band():
    found = hw.coverage(HONEST, TRUE)
    assert found.honest
    assert found.method == "KalmanSmoother()"
    np.testing.assert_allclose(found.inside, found.levels, atol=0.05)
    assert 60 < found.trials < 60 * 30  # neighbouring rows are alike
    assert hw.ranks(HONEST, TRUE).chi2 > 0.01


@pytest.mark.parametrize("factor", [0.3, 4.0])
def test_wrong_spreads_are_seen(factor):
    model = dataclasses.replace(WALK, w=hw.Gaussian(0.2 * factor), e=hw.Gaussian(factor))
    ests, true = solved(model)
    assert not hw.coverage(ests, true).honest
    found = hw.ranks(ests, true, bins=10)
    assert found.chi2 < 1e-3
    horns, middle = found.shares[[0, -1]].mean(), found.shares[4:6].mean()
    assert (horns > middle) == (factor < 1)


def test_a_bias_slopes_the_ranks():
    found = hw.ranks(HONEST, [np.asarray(x) + 0.5 for x in TRUE], bins=10)
    assert found.shares[-3:].sum() > 2 * found.shares[:3].sum()


def test_one_long_record_is_cut_into_blocks():
    truth, record = hw.simulate(WALK, T=2000, seed=1)
    found = hw.coverage(hw.estimate(WALK, record), truth, levels=[0.5, 0.9])
    assert found.honest
    assert found.trials < 2000
    assert found.inside.shape == (2,)


def test_a_guarantee_holds_everything():
    box = hw.Linear([[0.9]], None, [[1]], hw.Uniform(0.2), hw.Uniform(1.0), hw.Box([-1], [1]))
    truth, record = hw.simulate(box, T=50, seed=2)
    est = hw.estimate(box, record)
    found = hw.coverage(est, truth)
    assert found.guaranteed
    assert found.honest
    assert np.all(found.inside == 1.0)
    with pytest.raises(hw.Refused, match="box"):
        hw.ranks(est, truth)
    assert not hw.coverage(est, np.asarray(truth) + 5.0).honest


def test_single_rows_and_exact_answers():
    truth, record = hw.simulate(WALK, T=1, seed=3)
    est = hw.estimate(WALK, record)
    assert hw.coverage(est, truth).trials == 1
    assert hw.ranks(est, truth, bins=4).shares.sum() == pytest.approx(1.0)
    still = dataclasses.replace(WALK, w=hw.Gaussian(0.0), x0=hw.Normal([0.0], [[0.0]]))
    est = hw.estimate(still, record)  # no spread at all, and right
    assert hw.coverage(est, np.zeros((1, 1))).inside.min() == 1.0


def test_ranks_of_anything():
    rng = np.random.default_rng(0)
    assert hw.Ranks.of(rng.random(2000)).chi2 > 0.01
    assert hw.Ranks.of(rng.random(2000) ** 1.3).chi2 < 1e-3
    copies = np.repeat(rng.random((200, 1)), 10, axis=1)  # ten times the same is one
    assert hw.Ranks.of(copies).trials < 400
    with pytest.raises(hw.BadValue, match="0 to 1"):
        hw.Ranks.of([0.2, 1.5])
    with pytest.raises(hw.BadValue, match="bins"):
        hw.Ranks.of([0.2], bins=1)
    assert "bin" in repr(hw.Ranks.of([0.2, 0.7]))


def test_what_does_not_fit_is_named():
    with pytest.raises(hw.BadShape, match="shape"):
        hw.coverage(HONEST[0], np.zeros((3, 1)))
    with pytest.raises(hw.BadShape, match="one each"):
        hw.coverage(HONEST, TRUE[:3])
    with pytest.raises(hw.BadValue, match="levels"):
        hw.coverage(HONEST[0], TRUE[0], levels=[1.0])
    unknown = dataclasses.replace(WALK, w=hw.Uniform.unknown(), e=hw.Uniform.unknown(), x0=None)
    truth, record = hw.simulate(WALK, T=20, seed=0)
    with pytest.raises(hw.Refused, match="point"):
        hw.coverage(hw.estimate(unknown, record, hw.BatchLP()), truth)


def test_plots():
    import matplotlib.pyplot as plt

    ax = hw.coverage(HONEST, TRUE).plot(label="told the truth")
    assert hw.coverage(HONEST, TRUE).plot(ax) is ax
    assert len(ax.lines) == 3  # one line of the exact ones
    ax = hw.ranks(HONEST, TRUE).plot()
    assert len(ax.patches) >= 20
    plt.close("all")
