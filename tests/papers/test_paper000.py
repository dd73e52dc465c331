"""The structure of the first paper: a vehicle with GPS positions and accelerations, an outage, half-widths unknown.

The paper's log is not public, so its set-up is simulated: positions at 10 Hz, acceleration as input, one outage of 5 s, the error
inside it compared with Kalman forward-backward filtering given the true covariances.
"""

import dataclasses

import numpy as np
import pytest

import halfwidth as hw
from halfwidth.methods.map import BatchLP

H = 0.1


def vehicle(w, e, x0, **more):
    """Equations (22) and (23) of the paper."""
    return hw.Linear(
        [[1, 0, H, 0], [0, 1, 0, H], [0, 0, 1, 0], [0, 0, 0, 1]],
        [[H * H / 2, 0], [0, H * H / 2], [H, 0], [0, H]],
        [[1, 0, 0, 0], [0, 1, 0, 0]],
        w,
        e,
        x0,
        names=["px", "py", "vx", "vy"],
        dt=H,
        **more,
    )


def drive(seed, T=200):
    """Twenty seconds of a curve, and the models with known and with unknown noise."""
    k = np.arange(T)
    u = np.c_[np.sin(k / 30), np.cos(k / 40)]
    true = vehicle(hw.Uniform([0.01, 0.01, 0.03, 0.03]), hw.Uniform(0.5), hw.Box([-1, -1, 4, 4], [1, 1, 6, 6]))
    truth, record = hw.simulate(true, u, seed=seed)
    unknown = vehicle(hw.Uniform.unknown(at_most=1.0), hw.Uniform.unknown(at_most=5.0), None)
    return true, unknown, truth, record


def test_the_outage_of_five_seconds():
    """Figure 3: five seconds without positions; errors like those of a Kalman smoother that knows the noise."""
    ratios, shape = [], []
    for seed in range(10):
        true, unknown, truth, record = drive(seed)
        lost = record.without(record.t[50], record.t[99])
        est = hw.estimate(unknown, lost, BatchLP(point="least_squares")).check()
        gaussian = dataclasses.replace(true.as_gaussian(), x0=hw.Normal([0, 0, 5, 5], 100.0))
        kalman = hw.estimate(gaussian, lost, hw.KalmanSmoother())
        error = np.abs(est.x - truth.x)[:, :2].max(axis=1)
        best = np.abs(kalman.x - truth.x)[:, :2].max(axis=1)
        ratios.append(error[50:100].mean() / best[50:100].mean())
        shape.append(error[50:100])
        rows = est.info["rows"]
        np.testing.assert_array_equal(rows, [200, 200, 200, 200, 150, 150])
    assert np.median(ratios) < 1.6
    # The error is largest in the middle of the outage.
    shape = np.mean(shape, axis=0)
    assert shape[15:35].mean() > 1.3 * np.r_[shape[:5], shape[-5:]].mean()


def test_the_half_widths_returned_hold_the_residuals_and_the_data():
    """Equation (14) holds with the half-widths of the answer, and they are of the size of the truth."""
    true, unknown, _, record = drive(3)
    for objective in ("paper", "scaled"):
        est = hw.estimate(unknown, record, BatchLP(objective=objective, point="least_squares")).check()
        x = np.vstack([est.info["x0"], est.x])
        w = x[1:] - x[:-1] @ true.A.single.T - record.u @ true.B.single.T
        e = record.y - est.x @ true.C.single.T
        assert np.all(np.abs(w) <= est.q + 1e-9)
        assert np.all(np.abs(e) <= est.r + 1e-9)
        # More is never needed than what made the data.
        weight = np.ones(6) if objective == "paper" else est.info["rows"] / est.info["rows"].mean() / est.info["sigma"]
        made = np.r_[true.w.at_least, true.e.at_least]
        assert est.info["objective"] <= weight @ made * (1 + 1e-5)
        assert np.all(est.r > 0.5 * 0.5)


def test_a_longer_outage_only_loosens_the_optimum():
    """Fewer rows, fewer constraints: the paper's objective never rises with the outage."""
    _, unknown, _, record = drive(4)
    values = [
        hw.estimate(
            unknown, record.without(record.t[50], record.t[50 + k]), BatchLP(objective="paper", point="optimal")
        ).info["objective"]
        for k in (0, 10, 30, 60, 100)
    ]
    assert np.all(np.diff(values) <= 1e-5)


def test_step_seven_grows_the_caps():
    """The algorithm of section 3.3: caps too tight are increased until the program can be solved."""
    _, unknown, _, record = drive(5)
    tight = dataclasses.replace(unknown, w=hw.Uniform.unknown(at_most=1e-3), e=hw.Uniform.unknown(at_most=0.1))
    assert hw.estimate(tight, record, BatchLP(objective="paper")).status is hw.Status.INFEASIBLE
    est = hw.estimate(tight, record, BatchLP(objective="paper", grow_caps=True)).check()
    assert est.info["caps_grown"] >= 2
    assert np.all(est.r <= 0.1 * est.info["caps_grown"])


def test_a_fast_state_is_held_by_its_box():
    """Physical bounds on the state are respected at every row, equation (10)."""
    _, unknown, truth, record = drive(6)
    top = truth.x.max(axis=0) * 0.98 + 0.02
    model = dataclasses.replace(unknown, bounds=hw.Box([-np.inf] * 2 + [0.0, 0.0], [np.inf, np.inf, *top[2:]]))
    est = hw.estimate(model, record, BatchLP(point="least_squares")).check()
    assert np.all(est.x[:, 2:] <= top[2:])
    assert np.all(est.x[:, 2:] >= 0.0)


@pytest.mark.parametrize("objective", ["paper", "scaled"])
def test_ten_minutes_at_five_hertz(objective):
    _, unknown, truth, record = drive(7, T=3000)
    y = record.y.copy()
    for start in range(100, 2900, 200):
        y[start : start + 20] = np.nan
    est = hw.estimate(
        unknown, hw.Record(record.t, y, record.u), BatchLP(objective=objective, point="least_squares")
    ).check()
    assert est.info["solver"] == "banded"
    assert max(est.info["check"].values()) <= 1e-7
    assert np.abs(est.x - truth.x)[:, :2].mean() < 0.2
