"""Unknown losses: limits, exactness, order of the filters, smoothing, learning, kinds, sensors, streams."""

import dataclasses

import numpy as np
import pytest
from tests import naive_loss as naive

import halfwidth as hw
from halfwidth.methods._loss_modes import last_reported
from halfwidth.methods._loss_rows import linear_rows, outputs_and_modes
from halfwidth.methods._loss_stream import LossStream
from halfwidth.reproduce import paper001 as paper

CASES = paper.scenarios()
FIRST = {"prior": "predicted"}
EVERY = [
    hw.BKF1(), hw.BKF2(), hw.BKF2(spread=False), hw.GPB(0), hw.GPB(1), hw.GPB(3), hw.RBPF(20), hw.FearnheadClifford(20),
    hw.Runnalls(4), hw.BeamSearch(4),
]  # fmt: skip
SMOOTHERS = [
    hw.BKF1(smooth=True), hw.BKF2(smooth=True), hw.GPB(2, smooth=True), hw.GPB(1, lag=30), hw.BKF1(lag=3), hw.GPB(1, lag=3),
]  # fmt: skip


def with_loss(model, loss):
    return dataclasses.replace(model, loss=loss)


def car(loss=None, R=None, seed=0, T=80):
    """Two axes of position and velocity with holes; returns model, truth and a record without unknown losses."""
    dt = 0.5
    model = hw.Linear(
        np.kron(np.eye(2), [[1.0, dt], [0.0, 0.98]]), [[0.0], [dt], [0.0], [0.0]], np.kron(np.eye(2), [[1.0, 0.0]]),
        hw.Gaussian(np.kron(np.eye(2), [[0.01, 0.0], [0.0, 0.2]])), hw.Gaussian(np.diag([1.0, 2.0]) if R is None else R),
        hw.Normal([30.0, 1.0, -20.0, 0.5], [4.0, 1.0, 4.0, 1.0]), F=[[1.0, 0.3], [0.0, 1.0]], loss=loss, dt=dt,
    )  # fmt: skip
    truth, record = hw.simulate(model, np.sin(np.arange(T) / 7)[:, None], seed=seed)
    y = record.y.copy()
    y[np.random.default_rng(seed + 1).random(y.shape) < 0.15] = np.nan
    return model, truth, hw.Record(record.t, y, record.u)


def problem(model, record, loss):
    """The arrays of the naive twins."""
    rows = linear_rows(model, record)
    y, modes = outputs_and_modes(rows, loss, record)
    return {
        "A": rows.A, "b": np.zeros((1, model.nx)) if rows.b is None else rows.b, "Q": rows.Q, "C": modes.C,
        "d": np.zeros((1, *modes.C.shape[1:3])) if modes.d is None else modes.d, "R": modes.R, "Pi": modes.Pi,
        "pi0": modes.pi0, "y": y, "seen": record.seen, "x0": model.x0.mean, "P0": model.x0.P,
    }  # fmt: skip


# ---- A1: known losses


@pytest.mark.parametrize("method", EVERY + SMOOTHERS, ids=repr)
def test_a_certain_prior_is_the_intermittent_kalman_filter(method):
    model, _, record = car()
    got = np.random.default_rng(3).random(len(record)) < 0.6
    law = hw.Bernoulli(got[:, None].astype(float))
    known = hw.Record(record.t, np.where(got[:, None], record.y, np.nan), record.u)
    est = hw.estimate(with_loss(model, law), record, method, seed=1).check()
    ref = hw.estimate(model, known, method)
    np.testing.assert_allclose(est.x, ref.x, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(est.P, ref.P, rtol=1e-10, atol=1e-10)
    there = record.seen.any(axis=1)
    np.testing.assert_allclose(est.gamma[there], got[there], atol=1e-12)
    if method in EVERY:
        twin = naive.gpb(problem(model, known, None), 0)
        np.testing.assert_allclose(est.x, twin["x"], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(est.P, twin["P"], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("method", EVERY, ids=repr)
@pytest.mark.parametrize("p", [0.0, 1.0])
def test_all_or_nothing(method, p):
    model, _, record = car()
    est = hw.estimate(with_loss(model, hw.Bernoulli(p)), record, method)
    kept = record if p == 1.0 else hw.Record(record.t, np.full_like(record.y, np.nan), record.u)
    ref = hw.estimate(model, kept, hw.BKF1())
    np.testing.assert_allclose(est.x, ref.x, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(est.P, ref.P, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("ours", "theirs"), [(hw.BKF1(), "KalmanFilter"), (hw.BKF1(smooth=True), "KalmanSmoother")])
def test_the_kalman_family_agrees(ours, theirs):
    model, _, record = car()
    a, b = hw.estimate(model, record, ours), hw.estimate(model, record, getattr(hw, theirs)())
    np.testing.assert_allclose(a.x, b.x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(a.P, b.P, rtol=1e-9, atol=1e-9)
    assert a.loglik == pytest.approx(b.loglik)


# ---- A2: exactness


LAWS = [
    hw.Bernoulli(0.7),
    hw.Markov(0.9, 0.8),
    hw.Bernoulli(0.6, kind="garbage"),
    hw.Markov(0.9, 0.7, kind=("noise", "stale")),
]


@pytest.mark.parametrize("loss", LAWS, ids=repr)
def test_deep_enough_is_exact(loss):
    T = 7 if len(loss.kind) == 1 else 5
    model, _, record = car(T=T)
    exact = naive.enumerate_all(problem(model, record, loss))
    there = record.seen.any(axis=1)
    for method in (hw.GPB(T - 1), hw.FearnheadClifford(2500), hw.BeamSearch(2500)):
        est = hw.estimate(with_loss(model, loss), record, method)
        np.testing.assert_allclose(est.x, exact["x"], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(est.P, exact["P"], rtol=1e-9, atol=1e-10)
        assert est.loglik == pytest.approx(exact["loglik"].sum(), abs=1e-9)
        np.testing.assert_allclose(est.gamma[there], exact["modes"][there, -1], atol=1e-10)
    smooth = naive.enumerate_all(problem(model, record, loss), smooth=True)
    est = hw.estimate(with_loss(model, loss), record, hw.GPB(T - 1, smooth=True))
    np.testing.assert_allclose(est.x, smooth["x"], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(est.P, smooth["P"], rtol=1e-9, atol=1e-9)


# ---- A3: distance to the exact posterior


@pytest.mark.parametrize("name", CASES)
def test_distance_to_the_exact_posterior(name):
    found = paper.against_exact(CASES[name], runs=30, extra={"RBPF 1000": hw.RBPF(1000, **FIRST)})
    assert found["GPB depth 1"][0] <= 0.02
    assert found["GPB depth 3"][0] <= 0.005
    assert found["GPB depth 5"][0] <= 0.001
    assert found["RBPF 100"][0] <= 0.06
    assert found["RBPF 1000"][0] <= 0.02
    assert found["Fearnhead-Clifford 100"][0] <= 0.003


# ---- A4, A5, A6: the order of the filters


@pytest.fixture(scope="module")
def scores():
    names = (
        "BKF-I",
        "BKF-II",
        "GPB depth 1",
        "GPB depth 5",
        "RBPF 50",
        "RBPF 100",
        "RBPF 500",
        "Fearnhead-Clifford 100",
    )
    return {name: paper.accuracy(case, runs=150, depth=8, only=names) for name, case in CASES.items()}


def test_order_of_the_filters_where_losses_can_hardly_be_told(scores):
    s = scores["S1"]
    best = s["GPB depth 1"].rmse
    assert s["losses known"].rmse < best
    assert s["RBPF 100"].rmse == pytest.approx(best, rel=0.01)
    assert best <= s["BKF-II"].rmse * 1.0001
    assert s["BKF-II"].rmse * 1.05 < s["BKF-I"].rmse
    assert s["BKF-I"].rmse < s["linear (Nahi)"].rmse < s["Kalman, all received"].rmse < s["gate 99 %"].rmse
    assert scores["S4"]["BKF-II"].rmse < scores["S4"]["BKF-I"].rmse


@pytest.mark.parametrize("name", CASES)
def test_particles_come_near_as_they_grow(scores, name):
    s = scores[name]
    assert s["RBPF 500"].distance <= 0.5 * s["RBPF 50"].distance
    assert s["Fearnhead-Clifford 100"].distance < s["RBPF 100"].distance
    assert s["RBPF 100"].rmse == pytest.approx(s["GPB depth 5"].rmse, rel=0.01)
    assert abs(s["RBPF 100"].gamma - s["GPB depth 5"].gamma) < 0.005


# ---- A7


def test_interacting_models_are_bkf2_when_losses_are_independent():
    model, _, record = car()
    loss = hw.Bernoulli(0.7)
    twin = naive.imm(problem(model, record, loss))
    est = hw.estimate(with_loss(model, loss), record, hw.BKF2())
    np.testing.assert_allclose(est.x, twin["x"], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(est.P, twin["P"], rtol=1e-12, atol=1e-12)


# ---- A8: smoothing


@pytest.mark.parametrize("name", CASES)
def test_smoother_against_exact_smoothing(name):
    assert paper.smoothing_against_exact(CASES[name], depths=(8,), runs=30)[8][0] <= 0.005


@pytest.mark.parametrize("name", ["S1", "S2", "S4"])
def test_three_rows_later_one_knows_better(name):
    found = paper.lags(CASES[name], runs=30)
    assert found["lag 3"][0] < found["filter"][0]
    assert found["smoother"][1] < found["lag 3"][1] < found["filter"][1]


# ---- A9: learning


def test_expectation_maximisation():
    found = paper.learned(runs=3)
    assert np.all(np.abs(found["S1"] - 0.7) <= 0.03)
    assert np.all(np.abs(found["S2"][:, 0] - 0.95) <= 0.02)
    assert np.all(np.abs(found["S2"][:, 1] - 0.85) <= 0.06)
    assert found["drops"].max() < 1e-2


ONLINE = [
    hw.FearnheadClifford(100, **FIRST),
    hw.RBPF(200, **FIRST),
    hw.GPB(3, **FIRST),
    hw.Runnalls(8, **FIRST),
    hw.BKF2(**FIRST),
]


@pytest.mark.parametrize("method", ONLINE, ids=repr)
def test_online_law_with_gaps(method):
    run = paper.simulate(CASES["S1"], 1500, 11)
    y = run.record.y.copy()
    y[::5] = np.nan
    record = hw.Record(run.record.t, y)
    model = with_loss(CASES["S1"].model, hw.Bernoulli.unknown())
    est = hw.estimate(model, record, method, seed=2).check()
    assert est.info["law"].shape == (1500, 1, 2)
    assert float(est.info["loss"].received) == pytest.approx(0.7, abs=0.08)
    known = hw.estimate(with_loss(model, hw.Bernoulli(0.7)), record, method, seed=2)
    error = [np.sqrt(np.mean((e.x - run.x) ** 2)) for e in (est, known)]
    assert error[0] < 1.03 * error[1]


def test_online_bursts():
    run = paper.simulate(CASES["S4"], 3000, 3)
    model = with_loss(CASES["S4"].model, hw.Markov.unknown(0.7, 0.6))
    law = hw.estimate(model, run.record, hw.FearnheadClifford(100, **FIRST)).info["loss"]
    assert float(law.stay_received) == pytest.approx(0.95, abs=0.03)
    assert float(law.stay_lost) == pytest.approx(0.85, abs=0.08)


def test_noise_of_lost_samples_is_learned_with_gaps():
    true = np.array([[9.0, 3.0], [3.0, 16.0]])
    model, _, _ = car(T=10)
    model = with_loss(model, hw.Bernoulli(0.7, noise=true))
    _, record = hw.simulate(model, np.zeros((3000, 1)), seed=5)
    y = record.y.copy()
    y[np.random.default_rng(0).random(y.shape) < 0.1] = np.nan
    free = with_loss(model, hw.Bernoulli.unknown(noise=np.diag([4.0, 4.0]), learn_noise=True))
    est = hw.estimate(free, hw.Record(record.t, y, record.u), hw.GPB(2, smooth=True))
    np.testing.assert_allclose(est.info["loss"].noise, true, rtol=0.25, atol=0.6)
    assert est.info["converged"]


# ---- A10: sensors lost one by one


def test_sensors_with_correlated_noise_are_judged_jointly():
    R = 100.0 * np.array([[1.0, 0.8], [0.8, 1.0]])
    model = dataclasses.replace(CASES["S3"].model, e=hw.Gaussian(R), loss=hw.Bernoulli([0.7, 0.8]))
    errors = {"oracle": [], "joint": [], "ignoring": [], "one": []}
    wrong = []
    for seed in range(12):
        run = paper.simulate(CASES["S3"]._replace(model=with_loss(model, hw.Bernoulli(1.0))), 60, seed)
        v = run.record.y - run.x[:, [0, 2]]
        got = np.random.default_rng(seed).random((60, 2)) < [0.7, 0.8]
        record = hw.Record(run.record.t, run.x[:, [0, 2]] * got + v)
        apart = dataclasses.replace(model, e=hw.Gaussian([100.0, 100.0]))
        models = {
            "oracle": with_loss(model, hw.Bernoulli(got.astype(float))),
            "joint": model,
            "ignoring": apart,
            "one": with_loss(model, hw.Bernoulli(0.75)),
        }
        for name, m in models.items():
            est = hw.estimate(m, record, hw.GPB(1, **FIRST))
            errors[name].append(np.sum((est.x - run.x)[:, [0, 2]] ** 2, axis=1))
            if name == "joint":
                assert est.gamma.shape == (60, 2)
                wrong.append(np.mean((est.gamma > 0.5) != got))
    rmse = {k: np.sqrt(np.mean(v)) for k, v in errors.items()}
    assert rmse["joint"] <= 1.1 * rmse["oracle"]
    assert rmse["ignoring"] > 1.1 * rmse["joint"]
    assert rmse["one"] > 1.5 * rmse["joint"]
    assert np.mean(wrong) < 0.08


@pytest.mark.parametrize(
    "loss",
    [hw.Bernoulli([0.7, 0.8]), hw.Markov([0.9, 0.8], [0.7, 0.6]), hw.Bernoulli([0.7, 0.8], kind="stale")],
    ids=repr,
)
def test_sensors_equal_the_enumeration(loss):
    model, _, record = car(T=4, R=np.array([[1.0, 0.4], [0.4, 2.0]]))
    exact = naive.enumerate_all(problem(model, record, loss))
    est = hw.estimate(with_loss(model, loss), record, hw.GPB(3))
    np.testing.assert_allclose(est.x, exact["x"], rtol=1e-9, atol=1e-9)
    assert est.gamma.shape == (4, 2)
    joined = exact["modes"] @ loss.received_in(2)
    np.testing.assert_allclose(est.gamma[record.seen], joined[record.seen], atol=1e-9)
    assert np.all(est.gamma[~record.seen] == 0.0)


# ---- A11: the log domain


@pytest.mark.parametrize("method", EVERY, ids=repr)
def test_far_from_the_origin_with_hardly_any_noise(method):
    model = hw.Linear(
        [[1.0, 1.0], [0.0, 1.0]], None, [[1.0, 0.0]], hw.Gaussian([0.01, 0.01]), hw.Gaussian(1e-6),
        hw.Normal([3000.0, 1.0], [1.0, 1.0]), loss=hw.Bernoulli(0.7),
    )  # fmt: skip
    truth, record = hw.simulate(model, T=400, seed=4)
    est = hw.estimate(model, record, method).check()
    assert np.isfinite(est.x).all()
    assert np.isfinite(est.P).all()
    assert np.isfinite(est.loglik)
    assert np.all((est.gamma > 0.5) == truth.received[:, 0])


# ---- kinds of loss


@pytest.mark.parametrize("law", [hw.Bernoulli(0.8, kind="stale"), hw.Markov(0.95, 0.8, kind="stale")], ids=repr)
def test_stale_repeats_are_found(law):
    model, _, _ = car()
    model = with_loss(model, law)
    truth, record = hw.simulate(model, np.zeros((300, 1)), seed=6)
    est = hw.estimate(model, record, hw.GPB(3, smooth=True)).check()
    assert np.mean((est.gamma > 0.5) != truth.received[:, 0]) < 0.02
    assert est.gamma[0] == pytest.approx(1.0)
    np.testing.assert_allclose(est.info["lost_as"]["stale"], 1 - est.gamma, atol=1e-12)
    believing = hw.estimate(with_loss(model, None), record, hw.BKF1(smooth=True)).x - truth.x
    assert np.sqrt(np.mean((est.x - truth.x) ** 2)) < 0.95 * np.sqrt(np.mean(believing**2))


def test_garbage_and_stale_are_told_apart():
    model, _, _ = car()
    model = with_loss(model, hw.Markov(0.95, 0.7, kind=("stale", "garbage")))
    truth, record = hw.simulate(model, np.zeros((400, 1)), seed=8)
    est = hw.estimate(model, record, hw.GPB(2)).check()
    lost = ~truth.received[:, 0]
    assert np.mean((est.gamma > 0.5) == lost) < 0.02
    repeat = np.r_[False, np.abs(np.diff(record.y, axis=0)).max(axis=1) < 0.02] & lost
    assert est.info["lost_as"]["stale"][repeat].mean() > 0.95
    assert est.info["lost_as"]["garbage"][lost & ~repeat].mean() > 0.9


def test_own_noise_of_lost_samples_matters():
    model = with_loss(CASES["S3"].model, hw.Bernoulli(0.7, noise=400.0))
    errors = {"right": [], "wrong": []}
    for seed in range(30):
        run = paper.simulate(CASES["S3"]._replace(model=model), 60, seed)
        for name, m in (("right", model), ("wrong", CASES["S3"].model)):
            errors[name].append((hw.estimate(m, run.record, hw.GPB(2, **FIRST)).x - run.x)[:, [0, 2]])
    assert np.sqrt(np.mean(np.square(errors["right"]))) < np.sqrt(np.mean(np.square(errors["wrong"])))


def test_each_kind_may_have_its_own_noise():
    law = hw.Bernoulli(0.7, kind=("stale", "garbage"), noise={"garbage": [4.0, 9.0]})
    R = np.diag([1.0, 2.0])
    np.testing.assert_allclose(law.cov("garbage", R), np.diag([4.0, 9.0]))
    np.testing.assert_allclose(law.cov("stale", R), 1e-6 * R)
    with pytest.raises(hw.BadValue, match="mapping"):
        hw.Bernoulli(0.7, kind="stale", noise={"noise": 1.0})


def test_last_reported_skips_missing_entries():
    y = np.array([[1.0], [np.nan], [3.0], [4.0]])
    np.testing.assert_array_equal(last_reported(y, ~np.isnan(y)), [[np.nan], [1.0], [1.0], [3.0]])


def test_center_of_pure_noise():
    model, _, _ = car()
    model = with_loss(model, hw.Bernoulli(0.7, center=[100.0, -50.0]))
    truth, record = hw.simulate(model, np.zeros((200, 1)), seed=2)
    est = hw.estimate(model, record, hw.GPB(1))
    assert np.mean((est.gamma > 0.5) != truth.received[:, 0]) < 0.01


# ---- nonlinear models


def turning(loss):
    def g(x, u, dt):
        return np.array(
            [x[0] + dt * x[2] * np.cos(x[3]), x[1] + dt * x[2] * np.sin(x[3]), x[2] + dt * u[0], x[3] + dt * u[1]]
        )

    return hw.Nonlinear(
        g, lambda x: x[:2], hw.Gaussian([1e-4, 1e-4, 1e-2, 1e-3]), hw.Gaussian([0.2, 0.2]),
        hw.Normal([40.0, -30.0, 5.0, 0.3], [0.1, 0.1, 0.1, 0.01]), nu=2, dt=0.2, loss=loss,
    )  # fmt: skip


U = np.c_[np.sin(np.arange(150) / 9), 0.4 * np.cos(np.arange(150) / 15)]


@pytest.mark.parametrize(
    "loss", [hw.Bernoulli(0.7), hw.Markov(0.9, 0.8, kind="stale"), hw.Bernoulli(0.8, kind="garbage")], ids=repr
)
def test_extended_form(loss):
    model = turning(loss)
    truth, record = hw.simulate(model, U, seed=3)
    filtered = hw.estimate(model, record, hw.GPB(2)).check()
    smoothed = hw.estimate(model, record, hw.GPB(2, smooth=True)).check()
    wrong = [np.mean((e.gamma > 0.5) != truth.received[:, 0]) for e in (filtered, smoothed)]
    assert max(wrong) < 0.06
    error = [np.sqrt(np.mean((e.x - truth.x)[:, :2] ** 2)) for e in (filtered, smoothed)]
    assert error[1] < error[0] < 0.5


@pytest.mark.parametrize("method", [hw.GPB(2), hw.GPB(2, smooth=True), hw.BKF1(), hw.RBPF(10)], ids=repr)
@pytest.mark.parametrize("law", [hw.Bernoulli(0.7), hw.Markov(0.9, 0.8, kind="stale")], ids=repr)
def test_extended_form_of_a_linear_model_is_the_linear_form(law, method):
    model, _, record = car(T=40)
    A, B, C = model.A.single, model.B.single, np.linalg.solve(model.F.single, model.C.single)
    R = np.linalg.solve(model.F.single, np.linalg.solve(model.F.single, model.e.cov().single).T)
    same = hw.Nonlinear(
        lambda x, u: A @ x + B @ u, lambda x: C @ x, model.w, hw.Gaussian(R), model.x0, nu=1, loss=law, dt=model.dt
    )
    a = hw.estimate(with_loss(model, law), record, method, seed=1)
    b = hw.estimate(same, record, method, seed=1)
    np.testing.assert_allclose(a.x, b.x, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(a.gamma, b.gamma, atol=1e-6)


def test_an_angle_is_compared_on_its_nearest_branch():
    model = hw.Nonlinear(
        lambda x: x + 0.2, lambda x: np.remainder(x + np.pi, 2 * np.pi) - np.pi, hw.Gaussian(1e-4), hw.Gaussian(1e-2),
        hw.Normal([0.0], 0.01), y_angles=(0,), loss=hw.Bernoulli(0.8, noise=3.0),
    )  # fmt: skip
    truth, record = hw.simulate(with_loss(model, None), T=100, seed=1)
    est = hw.estimate(model, record, hw.GPB(1)).check()
    assert est.gamma.min() > 0.3
    np.testing.assert_allclose(est.x, truth.x, atol=0.3)


# ---- streams


STREAMED = [
    None,
    hw.Bernoulli(0.7),
    hw.Markov([0.9, 0.95], [0.8, 0.7]),
    hw.Markov(0.9, 0.8, kind="stale"),
    hw.Bernoulli.unknown(),
]


@pytest.mark.parametrize("method", EVERY, ids=repr)
@pytest.mark.parametrize("loss", STREAMED, ids=repr)
def test_stream_equals_record(method, loss):
    model, _, record = car(T=40)
    model = with_loss(model, loss)
    reason = method.refuses(model)
    if reason is not None:
        assert "Runnalls" in reason or "4 modes" in reason
        return
    whole = hw.estimate(model, record, method, seed=5)
    stream = LossStream(method, model, seed=5)
    for k in range(40):
        if k == 20:
            saved = stream.snapshot()
            stream = LossStream(method, model, seed=77)
            stream.restore(saved)
        now = stream.push(record.y[k], record.u[k])
        np.testing.assert_allclose(now.x[0], whole.x[k], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(now.P[0], whole.P[k], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(now.gamma, np.atleast_1d(whole.gamma[k]), atol=1e-10)
    assert now.loglik == pytest.approx(whole.loglik)
    assert now.info["rows"] == 40


def test_stream_of_a_nonlinear_model():
    model = turning(hw.Bernoulli(0.7))
    _, record = hw.simulate(model, U, seed=3)
    whole = hw.estimate(model, record, hw.GPB(1))
    stream = LossStream(hw.GPB(1), model)
    for k in range(50):
        now = stream.push(record.y[k], record.u[k])
        np.testing.assert_allclose(now.x[0], whole.x[k], rtol=1e-8, atol=1e-8)


def test_the_public_stream():
    model, _, record = car(T=30)
    model = with_loss(model, hw.Markov(0.9, 0.8))
    live = hw.stream(model)
    for k in range(30):
        now = live.push(record.y[k], record.u[k])
        if k == 10:
            live = hw.resume(live.snapshot(), model)
    whole = hw.estimate(model, record, hw.GPB())
    np.testing.assert_allclose(now.x[0], whole.x[-1], rtol=1e-10)
    assert now.status is hw.Status.OK
    assert live.rows == 30
    missing = live.push(None, record.u[0])
    assert float(missing.gamma[0]) == 0.0
    for y, u, dt in (
        ([np.inf, 0.0], [0.0], None),
        ([1.0], [0.0], None),
        ([1.0, 2.0], None, None),
        ([1.0, 2.0], [0.0], 0.0),
    ):
        with pytest.raises(hw.BadRecord):
            live.push(y, u, dt)


# ---- the border


@pytest.mark.parametrize(
    ("make", "part"),
    [
        (lambda: hw.Bernoulli(1.2), "1.2"),
        (lambda: hw.Bernoulli(0.7, kind="frozen"), "frozen"),
        (lambda: hw.Bernoulli(0.7, noise=0.0), "above 0"),
        (lambda: hw.Bernoulli(0.7, noise=1.0, kind=("stale", "noise")), "one kind"),
        (lambda: hw.Bernoulli(np.zeros((2, 2, 2))), "shape"),
        (lambda: hw.Bernoulli(0.7, center=np.zeros((2, 2))), "center"),
        (lambda: hw.Markov(0.9, [0.1, 0.2, 0.3, 0.4]).groups(2), "sensor"),
        (lambda: hw.Markov([0.9, 0.8], [0.1, 0.2, 0.3]), "shape"),
        (lambda: hw.Bernoulli([0.7, 0.8], sensors=[[0], [0]]).groups(2), "exactly one sensor"),
        (lambda: hw.Bernoulli(np.full(8, 0.5)).groups(8), "patterns"),
        (lambda: hw.Bernoulli.unknown(1.0), "ends excluded"),
        (lambda: hw.Bernoulli.unknown(worth=0.0), "worth"),
        (lambda: hw.Bernoulli.unknown(kind=("noise", "stale")), "one kind"),
        (lambda: hw.Bernoulli.unknown(kind="stale", learn_noise=True), "learn_noise"),
        (lambda: hw.Bernoulli.unknown(np.full((3, 1), 0.5)), "shape"),
        (lambda: hw.GPB(-1), "depth"),
        (lambda: hw.RBPF(0), "particles"),
        (lambda: hw.RBPF(threshold=2.0), "threshold"),
        (lambda: hw.GPB(prior="before"), "prior"),
        (lambda: hw.GPB(lag=0), "lag"),
    ],
)
def test_bad_settings_are_named(make, part):
    with pytest.raises((hw.BadValue, hw.BadShape), match=part):
        make()


def test_what_is_refused():
    model, _, record = car()
    with pytest.raises(hw.Refused, match="positive definite"):
        hw.estimate(dataclasses.replace(model, e=hw.Gaussian([1.0, 0.0])), record, hw.GPB())
    with pytest.raises(hw.Refused, match="forgets"):
        hw.estimate(with_loss(model, hw.Markov.unknown()), record, hw.BKF2())
    with pytest.raises(hw.Refused, match="learn"):
        hw.estimate(with_loss(model, hw.Bernoulli.unknown()), record, hw.BKF1(smooth=True))
    with pytest.raises(hw.Refused, match="components"):
        hw.estimate(with_loss(model, hw.Bernoulli(0.7)), record, hw.GPB(12))
    with pytest.raises(hw.Refused, match="component for each"):
        hw.estimate(with_loss(model, hw.Markov(0.9, 0.8)), record, hw.Runnalls(1))
    with pytest.raises(hw.BadShape, match="10 rows"):
        hw.estimate(with_loss(model, hw.Bernoulli(np.full((10, 1), 0.5))), record, hw.GPB())
    with pytest.raises(hw.Refused, match="smooths"):
        LossStream(hw.GPB(smooth=True), model)


def test_repr():
    assert repr(hw.Markov([0.9, 0.8], 0.7, kind="stale")) == "Markov([0.9, 0.8], [0.7, 0.7], kind='stale')"
    assert repr(hw.Bernoulli.unknown(noise=2.0)) == "Bernoulli.unknown(0.5, noise=2., worth=2)"
    assert "kind=('stale', 'garbage')" in repr(hw.Bernoulli(0.5, kind=("stale", "garbage"), sensors=[[0, 1]]))


def test_the_noise_of_lost_samples_is_learned_for_one_sensor_only():
    two = hw.Bernoulli.unknown([0.7, 0.8], learn_noise=True)
    model = hw.Linear(np.eye(2), None, np.eye(2), hw.Gaussian(0.1), hw.Gaussian(1.0), hw.Normal([0, 0], 1.0), loss=two)
    with pytest.raises(hw.Refused, match="learn_noise=False"):
        hw.estimate(model, hw.Record([0.0], [[1.0, 2.0]]), hw.GPB(depth=2, smooth=True))
