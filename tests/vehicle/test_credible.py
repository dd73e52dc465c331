"""The posterior of the chain: as good as the chain, honest intervals, and the chain's path where it does not settle."""

import dataclasses

import numpy as np
import pytest
from tests.vehicle.known import known

from halfwidth.methods.posterior import Posterior
from halfwidth.result import Status
from halfwidth.vehicle import chain, credible
from halfwidth.vehicle.credible import Credible
from halfwidth.vehicle.grid import sampled

QUICK = Credible(shares=(0.4,), nodes=8)


def a_drive(**change):
    return sampled(known(50.0, **({"rate": 5.0, "noise": 0.1, "speed_noise": 0.05, "yaw_noise": 0.003} | change)).log)


def bare(drive, keep):
    return dataclasses.replace(drive, seen=np.isin(np.arange(len(drive)), keep))


def test_it_is_as_near_as_the_gaussian_chain_and_its_interval_holds():
    errors, inside = [], []
    for seed in (1, 2, 3):
        drive = a_drive(seed=seed)
        hidden = drive.without(20, 28)
        out = drive.seen & ~hidden.seen
        path, own = credible.solve([hidden], QUICK)[0], chain.solve([hidden])[0].path
        assert path.status.good
        off = np.column_stack((path.east - drive.east, path.north - drive.north))[out]
        errors.append([np.hypot(*off.T).mean(), np.hypot(own.east - drive.east, own.north - drive.north)[out].mean()])
        inside.append(np.mean(np.abs(off) <= 1.645 * np.sqrt(path.variance[out] + path.fix_variance)))
    mine, usual = np.mean(errors, axis=0)
    assert mine < 1.3 * usual
    assert np.mean(inside) > 0.7
    assert all(value >= 0 for value in path.info["half_widths"].values())
    assert path.info["half_width_sds"].keys() == path.info["half_widths"].keys()


def test_the_share_of_most_evidence_is_taken():
    path = credible.solve([a_drive().without(20, 24)], Credible(shares=(0.2, 0.9), nodes=8))[0]
    evidence = path.info["evidence"]
    assert set(evidence) == {0.2, 0.9}
    assert path.info["gaussian_share"] == max(evidence, key=evidence.get)


def test_one_linearisation_about_the_chain_is_a_gaussian_smoother_without_bounded_noise():
    """With next to no room for half-widths and the whole Gaussian part it is the chain itself."""
    drive = a_drive().without(20, 26)
    settings = Credible(shares=(1.0,), most=1e-3, nodes=1, rounds=1)
    fit = chain.solve([drive])[0]
    again = chain.solve(
        [drive], chain.Chain(rounds=2), sigma=fit.sigma, azimuth=[fit.z[:, chain.AZIMUTH]], weight=[fit.weight],
        learn=False,
    )[0].path  # fmt: skip
    path = credible.solve([drive], settings)[0]
    sd = np.sqrt(again.variance)
    for mine, usual, one in ((path.east, again.east, sd[:, 0]), (path.north, again.north, sd[:, 1])):
        assert np.max(np.abs(mine - usual) / one) < 0.05
    np.testing.assert_allclose(np.sqrt(path.variance), sd, rtol=0.02)


def test_a_scale_and_a_bias_are_found():
    path = credible.solve([a_drive(scale=1.02, bias=0.005).without(20, 24)], QUICK)[0]
    assert path.info["speed_scale"] == pytest.approx(1 / 1.02, abs=0.01) or path.info["speed_scale"] == pytest.approx(
        1.02, abs=0.01
    )
    assert abs(path.info["yaw_bias"]) == pytest.approx(0.005, abs=0.002)


@pytest.mark.parametrize(
    "change",
    [
        lambda d: bare(d, [10, 120]),
        lambda d: bare(d, [10]),
        lambda d: d.rows(slice(0, 2)),
        lambda d: dataclasses.replace(d, has_speed=False, speed=np.zeros(len(d))),
        lambda d: dataclasses.replace(d, has_yaw_rate=False, yaw_rate=np.zeros(len(d))),
        lambda d: dataclasses.replace(d, **{name: 0 * d.t for name in ("east", "north", "speed", "yaw_rate")}),
        lambda d: dataclasses.replace(d, east=1e6 * d.east + 1e9, north=1e6 * d.north),
    ],
    ids=["two fixes", "one fix", "two nodes", "no speed", "no yaw rate", "standing", "a million times"],
)
def test_a_path_comes_out_of_anything(change):
    path = credible.solve([change(a_drive()).without(20, 22)], QUICK)[0]
    assert path.finite
    assert (path.variance >= 0).all()
    assert path.status.good or path.status is Status.STALLED


def test_where_it_does_not_settle_the_path_is_the_chains_and_says_so(monkeypatch):
    drive = a_drive().without(20, 24)
    usual = Posterior.answer

    def stalled(self, model, record, *, start=None):
        found = usual(self, model, record, start=start)
        return found.amended(dataclasses.replace(found.estimate, status=Status.STALLED))

    monkeypatch.setattr(Posterior, "answer", stalled)
    path = credible.solve([drive], QUICK)[0]
    np.testing.assert_array_equal(path.east, chain.solve([drive])[0].path.east)
    assert path.status is Status.REDUCED
    assert any("did not settle" in note for note in path.info["notes"])
