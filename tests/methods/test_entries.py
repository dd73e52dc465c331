"""`Posterior` with unknown entries of each matrix, held against draws of the same posterior."""

import dataclasses

import numpy as np
import pytest

import halfwidth as hw

NAN = float("nan")
TRUE = hw.Linear(
    [[0.9, 0.2], [-0.2, 0.8]], [[1.0], [0.5]], [[1, 0], [0.3, 1]], hw.Uniform(0.1), hw.Uniform(0.2),
    hw.Box([-1, -1], [1, 1]), E=[[1, 0.4], [0, 1]], F=[[1, -0.3], [0, 1]],
)  # fmt: skip
ASKED = {
    "A": [[NAN, 0.2], [-0.2, 0.8]],
    "B": [[1.0], [NAN]],
    "C": [[1, 0], [NAN, 1]],
    "E": [[1, NAN], [0, 1]],
    "F": [[1, NAN], [0, 1]],
}
TRUTH = {"A": 0.9, "B": 0.5, "C": 0.3, "E": 0.4, "F": -0.3}


def drawn(seed, T=30):
    u = np.random.default_rng(seed).uniform(-1, 1, (T, 1))
    truth, record = hw.simulate(TRUE, u, seed=seed)
    return truth, record.without(8.0, 11.0)


@pytest.mark.parametrize("name", ASKED)
def test_an_entry_is_as_sure_as_draws_say(name):
    _, record = drawn(3)
    model = dataclasses.replace(TRUE, **{name: ASKED[name]}, theta_bounds=(-2.0, 2.0))
    est = hw.estimate(model, record, hw.Posterior())
    draws = hw.estimate(model, record, hw.Posterior(method="sample", draws=300), seed=1)
    assert est.status is hw.Status.OK
    assert draws.status.good
    sd = draws.info["theta_sd"][0]
    assert abs(est.theta[0] - draws.theta[0]) < 0.3 * sd
    assert est.info["theta_sd"][0] == pytest.approx(sd, rel=0.25)
    assert abs(est.theta[0] - TRUTH[name]) < 3.5 * sd
    assert np.abs((est.x - draws.x) / est.spread.sd).mean() < 0.1


def test_entries_of_all_matrices_at_once_with_half_widths():
    _, record = drawn(4, 60)
    unknown = hw.Uniform.unknown(at_most=3.0)
    asked = {name: ASKED[name] for name in "BCE"}
    model = dataclasses.replace(TRUE, **asked, w=unknown, e=unknown, theta_bounds=(-2.0, 2.0))
    est = hw.estimate(model, record, hw.Posterior(nodes=16))
    assert est.method == "Posterior(nodes=16)"
    assert est.status.good
    truth = [TRUTH[entry.matrix] for entry in model.theta_entries]
    assert np.all(np.abs(est.theta - truth) < 3.5 * est.info["theta_sd"])
    assert np.all(est.info["theta_sd"] < 0.25)


def test_where_nothing_fits_there_is_no_theta():
    _, record = drawn(3)
    y = record.y.copy()
    y[20] += 50.0
    model = dataclasses.replace(TRUE, A=ASKED["A"], theta_bounds=(-2.0, 2.0))
    est = hw.estimate(model, hw.Record(record.t, y, record.u), hw.Posterior())
    assert est.status is hw.Status.INFEASIBLE
    assert est.theta is None
    assert est.method == "Posterior()"
    assert np.isfinite(est.x).all()
