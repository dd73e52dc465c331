"""KalmanFilter and KalmanSmoother: statsmodels as independent reference, long runs, varying models, refusals."""

import dataclasses

import numpy as np
import pytest
from tests import naive
from tests.cases import constant_velocity, oscillator

import halfwidth as hw

STATSMODELS = pytest.importorskip("statsmodels.tsa.statespace.kalman_smoother")


def spd(rng, n):
    a = rng.normal(size=(n, n))
    return a @ a.T + 0.3 * n * np.eye(n)


def drawn(seed):
    """A random model with inputs, correlated noise, E and F, and a record with 30 % of its entries missing."""
    rng = np.random.default_rng(seed)
    nx, ny, nu = int(rng.integers(1, 7)), int(rng.integers(1, 4)), int(rng.integers(0, 3))
    a = rng.normal(size=(nx, nx))
    A = 0.97 * a / np.abs(np.linalg.eigvals(a)).max()
    more = {}
    if seed % 3 == 0:
        more["E"] = np.eye(nx) + np.triu(0.3 * rng.normal(size=(nx, nx)), 1)
    if seed % 4 == 0:
        more["F"] = np.eye(ny) + np.triu(0.3 * rng.normal(size=(ny, ny)), 1)
    model = hw.Linear(
        more.get("E", np.eye(nx)) @ A,  # stable with E taken out
        rng.normal(size=(nx, nu)) if nu else None,
        rng.normal(size=(ny, nx)),
        hw.Gaussian(spd(rng, nx)),
        hw.Gaussian(spd(rng, ny)),
        hw.Normal(rng.normal(size=nx), spd(rng, nx)),
        **more,
    )
    T = int(rng.integers(30, 80))
    _, record = hw.simulate(model, rng.normal(size=(T, nu)) if nu else None, T=T, seed=seed)
    return model, hw.Record(record.t, np.where(rng.random(record.y.shape) < 0.3, np.nan, record.y), record.u)


def folded(model):
    """A, B, C, Q, R with E and F folded in, by plain inverses."""
    Ei = np.eye(model.nx) if model.E is None else np.linalg.inv(model.E.single)
    Fi = np.eye(model.ny) if model.F is None else np.linalg.inv(model.F.single)
    Q, R = Ei @ model.w.cov().single @ Ei.T, Fi @ model.e.cov().single @ Fi.T
    B = np.zeros((model.nx, 1)) if model.B is None else Ei @ model.B.single
    return Ei @ model.A.single, B, Fi @ model.C.single, Q, R


def reference(model, record):
    """What statsmodels says, its first prediction being our prior moved one step."""
    A, B, C, Q, R = folded(model)
    drive = np.zeros((len(record), model.nx)) if record.u is None else record.u @ B.T
    ss = STATSMODELS.KalmanSmoother(model.ny, model.nx, tolerance=0)
    ss.bind(np.asfortranarray(record.y.T))
    ss["transition"], ss["design"], ss["selection"] = A, C, np.eye(model.nx)
    ss["state_cov"], ss["obs_cov"] = Q, R
    ss["state_intercept"] = np.asfortranarray(np.vstack((drive[1:], drive[:1] * 0)).T)
    ss.initialize_known(A @ model.x0.mean + drive[0], A @ model.x0.P @ A.T + Q)
    return ss.smooth()


def close(a, b, tol=1e-9):
    assert np.abs(a - b).max() <= tol * np.abs(b).max()


@pytest.mark.parametrize("seed", range(48))
def test_equal_to_statsmodels(seed):
    model, record = drawn(seed)
    want = reference(model, record)
    filtered = hw.estimate(model, record, hw.KalmanFilter(details=True))
    close(filtered.x, want.filtered_state.T)
    close(filtered.P, want.filtered_state_cov.T)
    close(filtered.info["x_predicted"], want.predicted_state[:, :-1].T)
    close(filtered.info["P_predicted"], want.predicted_state_cov[:, :, :-1].T)
    close(filtered.loglik, want.llf_obs.sum())
    close(filtered.info["loglik_rows"], want.llf_obs)
    smoothed = hw.estimate(model, record, hw.KalmanSmoother())
    close(smoothed.x, want.smoothed_state.T)
    close(smoothed.P, want.smoothed_state_cov.T)
    assert smoothed.loglik == filtered.loglik


def test_a_million_steps_of_constant_velocity_stay_symmetric_and_semidefinite():
    T = 1_000_000
    rng = np.random.default_rng(0)
    y = np.cumsum(rng.normal(size=(T, 2)), axis=0)
    y[rng.random(T) < 0.3] = np.nan
    y[400_000:401_000] = np.nan
    model = constant_velocity(1.0)
    record = hw.Record(np.arange(1.0, T + 1), y)
    for method in (hw.KalmanFilter(), hw.KalmanSmoother()):
        est = hw.estimate(model, record, method)
        P = est.P
        assert est.status is hw.Status.OK
        np.testing.assert_array_equal(P, P.swapaxes(1, 2))
        part = np.concatenate((P[::97], P[399_990:401_010]))  # every 97th, and the long gap
        value = np.linalg.eigvalsh(part)
        assert (value[:, 0] >= -1e-12 * value[:, -1]).all()


def test_huge_prior_beside_small_noise_stays_accurate():
    model = constant_velocity(0.1, x0=hw.Normal(np.zeros(4), 1e10))
    _, record = hw.simulate(dataclasses.replace(model, x0=hw.Normal(np.zeros(4), 1.0)), T=200, seed=1)
    est = hw.estimate(model, record)
    nearly = hw.estimate(dataclasses.replace(model, x0=hw.Normal(np.zeros(4), 1e6)), record)
    np.testing.assert_allclose(est.x, nearly.x, atol=1e-4)
    value = np.linalg.eigvalsh(est.P)
    assert (value[:, 0] > 0).all()


@pytest.mark.parametrize("kind", ["dt", "t", "stacked"])
def test_varying_matrices_equal_the_twin(kind):
    rng = np.random.default_rng(4)
    T = 40
    t = np.cumsum(rng.choice([0.1, 0.25, 1.0], T))
    dt = np.diff(t, prepend=t[0] - 0.1)
    by_dt = constant_velocity(None)
    rows = {
        "A": by_dt.A.stack(t, dt)[0][by_dt.A.stack(t, dt)[1]],
        "Q": by_dt.w.cov().stack(t, dt)[0][by_dt.w.cov().stack(t, dt)[1]],
    }
    C = by_dt.C.single * (1 + np.sin(t))[:, None, None] if kind == "t" else by_dt.C.single
    model = {
        "dt": lambda: dataclasses.replace(by_dt, dt=0.1),
        "t": lambda: dataclasses.replace(by_dt, C=lambda t: by_dt.C.single * (1 + np.sin(t)), dt=0.1),
        "stacked": lambda: hw.Linear(rows["A"], None, C, hw.Gaussian(rows["Q"]), by_dt.e, by_dt.x0, dt=0.1),
    }[kind]()
    y = rng.normal(size=(T, 2))
    y[rng.random((T, 2)) < 0.3] = np.nan
    record = hw.Record(t, y)
    args = rows["A"], None, C, rows["Q"], by_dt.e.cov().single, y, record.seen, model.x0.mean, model.x0.P
    x, P, xp, Pp, ll = naive.kf(*args)
    xs, Ps, x0s, P0s, _ = naive.rts(rows["A"], rows["Q"], x, P, xp, Pp, model.x0.mean, model.x0.P)
    est = hw.estimate(model, record, hw.KalmanSmoother())
    close(est.x, xs, 1e-11)
    close(est.P, Ps, 1e-11)
    close(est.info["x0"], x0s, 1e-11)
    close(est.info["P0"], P0s, 1e-11)
    assert est.loglik == pytest.approx(ll.sum(), rel=1e-12)
    several = hw.estimate(model, [record, record])
    np.testing.assert_array_equal(several[1].x, est.x)


def test_varying_E_and_F_equal_their_rows():
    rng = np.random.default_rng(8)
    model = oscillator(hw.Gaussian([0.1, 0.2, 0.1]), hw.Gaussian([0.3, 0.4]), hw.Normal(np.zeros(3), 1.0))
    u = rng.normal(size=(30, 1))
    _, record = hw.simulate(model, u, seed=2)
    want = hw.estimate(model, record)
    many = dataclasses.replace(
        model, E=np.repeat(model.E.single[None], 30, 0), F=lambda t: model.F.single + 0 * t, A=lambda dt: model.A.single
    )
    np.testing.assert_allclose(hw.estimate(many, record).x, want.x, rtol=1e-12, atol=1e-13)


def test_lag_zero_is_the_filter_and_a_long_lag_the_smoother():
    model, record = drawn(3)
    f, s = hw.estimate(model, record, hw.KalmanFilter()), hw.estimate(model, record, hw.KalmanSmoother())
    np.testing.assert_array_equal(hw.estimate(model, record, hw.KalmanSmoother(lag=0)).x, f.x)
    np.testing.assert_allclose(hw.estimate(model, record, hw.KalmanSmoother(lag=500)).x, s.x, rtol=1e-9, atol=1e-10)


def test_normalised_innovations_are_chi_square():
    model = constant_velocity(0.1)
    _, record = hw.simulate(model, T=5000, seed=3)
    info = hw.estimate(model, record, hw.KalmanFilter(details=True)).info
    assert abs(info["nis"].mean() - 2.0) < 4 * 2 / np.sqrt(5000)
    assert info["n_seen"] == 10_000
    assert info["S"].shape == (5000, 2, 2)


def test_a_contradicted_certainty_is_told():
    model = hw.Linear(np.eye(1), None, np.ones((1, 1)), hw.Gaussian(0.0), hw.Gaussian(0.0), hw.Normal([0.0], 1.0))
    est = hw.estimate(model, hw.Record([0.0, 1.0, 2.0], [1.0, 1.0, 5.0]), hw.KalmanFilter())
    assert est.status is hw.Status.REDUCED
    assert "row 2 (t = 2 s)" in est.message
    assert np.allclose(est.x, 1.0)
    same = hw.estimate(model, hw.Record([0.0, 1.0, 2.0], [1.0, 1.0, 1.0]), hw.KalmanFilter())
    assert same.status is hw.Status.OK


def test_overflow_ends_in_a_status():
    model = hw.Linear([[1e80]], None, [[1.0]], hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([1.0], 1.0))
    est = hw.estimate(model, hw.Record(np.arange(9.0), np.full(9, np.nan)))
    assert est.status is hw.Status.COLLAPSED
    assert np.isfinite(est.x).all()
    assert np.isfinite(est.P).all()
    with pytest.raises(hw.Unsolved, match="floating point"):
        est.check()


GOOD = {"w": hw.Gaussian(1.0), "e": hw.Gaussian(1.0), "x0": hw.Normal([0.0], 1.0)}


@pytest.mark.parametrize("method", [hw.KalmanFilter(), hw.KalmanSmoother(), hw.KalmanSmoother(lag=2)], ids=repr)
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"w": hw.Uniform(1.0)}, "`w` is `Uniform`"),
        ({"w": hw.Uniform(1.0), "e": hw.Uniform.unknown()}, "`w`, `e` are `Uniform`"),
        ({"e": hw.Uniform(1.0) + hw.Gaussian(1.0)}, "`e` is `Mixed`"),
        ({"x0": hw.Box([0.0], [1.0])}, "`x0` is `Box`"),
        ({"bounds": (0.0, 1.0)}, "`bounds`"),
        ({"loss": object()}, "`loss`"),
        ({"A": [[np.nan]]}, r"`A\[0, 0\]` is unknown"),
    ],
)
def test_refusals(method, change, words):
    given = {"A": [[1.0]]} | GOOD | change
    model = hw.Linear(
        given["A"],
        None,
        [[1.0]],
        given["w"],
        given["e"],
        given["x0"],
        bounds=given.get("bounds"),
        loss=given.get("loss"),
    )
    with pytest.raises(hw.Refused, match=words) as caught:
        hw.estimate(model, hw.Record([0.0], [1.0]), method)
    assert type(method).__name__ in caught.value.message
    assert caught.value.hint


def test_a_nonlinear_model_is_refused():
    model = hw.Nonlinear(lambda x: x, lambda x: x, hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0.0], 1.0))
    with pytest.raises(hw.Refused, match="Nonlinear"):
        hw.estimate(model, hw.Record([0.0], [1.0]), hw.KalmanFilter())


@pytest.mark.parametrize("lag", [-1, 1.5, "two"])
def test_a_bad_lag_is_named(lag):
    with pytest.raises(hw.BadValue, match="`lag`"):
        hw.KalmanSmoother(lag=lag)


def test_forecast_equals_the_prediction():
    model, record = drawn(3)
    steps = 7
    u = None if record.u is None else np.ones((steps, model.nu))
    ahead = hw.forecast(model, record, steps, u=u)
    A, B, C, Q, R = folded(model)
    last = hw.estimate(model, record, hw.KalmanFilter())
    x, P = last.x[-1], last.P[-1]
    for k in range(steps):
        x, P = A @ x + (0 if u is None else B @ u[k]), A @ P @ A.T + Q
        close(ahead.x[k], x, 1e-12)
        close(ahead.P[k], P, 1e-12)
        close(ahead.info["y"][k], C @ x, 1e-12)
        close(ahead.info["S"][k], C @ P @ C.T + R, 1e-12)
    np.testing.assert_allclose(ahead.t, record.t[-1] + np.arange(1, steps + 1))


def test_a_bad_forecast_is_named():
    model, record = drawn(3)
    with pytest.raises(hw.BadValue, match="`steps`"):
        hw.forecast(model, record, 0)
    other = oscillator(hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal(np.zeros(3), 1.0))
    _, record = hw.simulate(other, np.ones((5, 1)), seed=0)
    with pytest.raises(hw.BadRecord, match="`u`"):
        hw.forecast(other, record, 3)
