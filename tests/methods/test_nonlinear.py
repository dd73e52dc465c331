"""Extended and unscented Kalman: against the Kalman filter, filterpy, their own claims, and everything that goes wrong."""

import dataclasses
import math

import numpy as np
import pytest
from tests import naive

import halfwidth as hw
from halfwidth.methods.nonlinear import ExtendedKalman, UnscentedKalman

FILTERS = [ExtendedKalman(), UnscentedKalman(), UnscentedKalman(alpha=0.3, kappa=1.0), ExtendedKalman(iterations=3)]
SMOOTHERS = [dataclasses.replace(m, smooth=True) for m in FILTERS]
IN_PYTHON = [dataclasses.replace(m, compiled=False) for m in (FILTERS[0], FILTERS[1], SMOOTHERS[0], SMOOTHERS[1])]
ALL = FILTERS + SMOOTHERS + IN_PYTHON


def ctrv_step(x, u, dt):
    """Constant turn rate and velocity: position, speed, heading, turn rate; the input is an acceleration."""
    px, py, v, a, w = x
    w = np.where(np.abs(w) > 1e-5, w, 1e-5)
    return np.array(
        [
            px + v / w * (np.sin(a + w * dt) - np.sin(a)),
            py + v / w * (np.cos(a) - np.cos(a + w * dt)),
            v + u[0] * dt,
            a + w * dt,
            x[4],
        ]
    )


def ctrv(**more):
    settings = {
        "w": hw.Gaussian(lambda dt: np.diag([1e-3, 1e-3, 0.05, 1e-4, 2e-4]) * dt),
        "e": hw.Gaussian([[0.5, 0.2], [0.2, 0.4]]),
        "x0": hw.Normal([0.0, 0.0, 8.0, 3.0, 0.3], [1.0, 1.0, 1.0, 0.02, 0.001]),
        "nu": 1,
        "dt": 0.2,
        "x_angles": (3,),
    }
    return hw.Nonlinear(ctrv_step, lambda x: x[:2], **(settings | more))


def drive(model, seed, T=150, outage=(12.0, 15.0)):
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.1, 0.3, T))
    truth, record = hw.simulate(model, np.sin(np.arange(T) / 20)[:, None], t=t, seed=seed)
    y = record.y.copy()
    y[rng.random(y.shape) < 0.3] = np.nan
    return truth, hw.Record(record.t, y, record.u).without(*outage)


def linear_functions(seed=0, n=4, m=2):
    """The same linear model as functions and as matrices, with gaps."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n)) * 0.5
    B, C = rng.normal(size=(n, 1)), rng.normal(size=(m, n))
    root_Q, root_R, root_P = rng.normal(size=(n, n)), rng.normal(size=(m, m)), rng.normal(size=(n, n))
    Q, R, P0 = root_Q @ root_Q.T, root_R @ root_R.T + 0.1 * np.eye(m), root_P @ root_P.T
    x0 = hw.Normal(rng.normal(size=n), P0)
    model = hw.Nonlinear(lambda x, u: A @ x + B @ u, lambda x: C @ x, hw.Gaussian(Q), hw.Gaussian(R), x0, nu=1)
    _, record = hw.simulate(model, rng.normal(size=(60, 1)), seed=seed)
    y = np.where(rng.random(record.y.shape) < 0.4, np.nan, record.y)
    return model, hw.Record(record.t, y, record.u), (A, B, C, Q, R)


@pytest.mark.parametrize("method", ALL, ids=repr)
def test_on_linear_functions_it_is_the_kalman_filter(method):
    for seed in range(3):
        model, record, (A, B, C, Q, R) = linear_functions(seed)
        y = np.where(record.seen, record.y, 0.0)
        prior = model.x0
        x, P, xp, Pp, ll = naive.kf(A, B, C, Q, R, y, record.seen, prior.mean, prior.P, u=record.u)
        if method.smooth:
            x, P, x0, P0, _ = naive.rts(A, Q, x, P, xp, Pp, prior.mean, prior.P)
        est = hw.estimate(model, record, method)
        assert est.status is hw.Status.OK
        np.testing.assert_allclose(est.x, x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(est.P, P, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(est.loglik, ll.sum(), rtol=1e-9)
        if method.smooth:
            np.testing.assert_allclose(est.info["x0"], x0, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(est.info["P0"], P0, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("smooth", [False, True])
def test_on_linear_models_it_is_the_kalman_filter(smooth):
    rng = np.random.default_rng(1)
    model = hw.Linear(
        lambda dt: [[1.0, dt], [0.0, 1.0]],
        None,
        [[1.0, 0.0]],
        hw.Gaussian(0.1),
        hw.Gaussian(1.0),
        hw.Normal([0.0, 0.0], 1.0),
    )
    record = hw.Record(np.cumsum(rng.uniform(0.5, 1.5, 30)), rng.normal(size=30))
    kalman = hw.KalmanSmoother() if smooth else hw.KalmanFilter()
    want = hw.estimate(model, record, kalman)
    for method in (ExtendedKalman(smooth=smooth), UnscentedKalman(smooth=smooth)):
        got = hw.estimate(model, record, method)
        np.testing.assert_allclose(got.x, want.x, rtol=1e-9)
        np.testing.assert_allclose(got.P, want.P, rtol=1e-9)
        np.testing.assert_allclose(got.loglik, want.loglik, rtol=1e-9)
        assert got.method.startswith(type(method).__name__)


@pytest.mark.parametrize("method", FILTERS + SMOOTHERS, ids=repr)
def test_compiled_equals_python(method):
    model = ctrv()
    _, record = drive(model, 3)
    one = hw.estimate(model, record, method)
    two = hw.estimate(model, record, dataclasses.replace(method, compiled=False))
    assert (one.info["evaluated"], two.info["evaluated"]) == ("compiled", "python")
    # The Python path differentiates numerically.
    np.testing.assert_allclose(one.x, two.x, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(one.P, two.P, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(one.loglik, two.loglik, rtol=1e-8)


def heading_error(est, truth):
    error = est.x - truth.x
    error[:, 3] = np.remainder(error[:, 3] + np.pi, 2 * np.pi) - np.pi
    return error


@pytest.mark.parametrize("method", FILTERS[:2] + SMOOTHERS, ids=repr)
def test_ctrv_with_gaps_claims_what_it_keeps(method):
    """Normalised squared errors average to nx, and the heading crosses pi all the time."""
    nees, crossed = [], 0
    for seed in range(25):
        truth, record = drive(ctrv(), seed)
        est = hw.estimate(ctrv(), record, method)
        assert est.status is hw.Status.OK
        assert np.all(np.abs(est.x[:, 3]) <= np.pi)
        crossed += int((np.abs(np.diff(est.x[:, 3])) > 3).sum())
        error = heading_error(est, truth)
        nees.append(np.einsum("ti,tij,tj->t", error, np.linalg.inv(est.P), error)[::10])
    assert crossed > 20
    nees = np.array(nees)
    assert 4.0 < nees.mean() < 6.5
    assert (nees > 20.5).mean() < 0.03  # 0.1 % of chi-square with 5 degrees of freedom


def test_smoothing_helps_most_in_the_outage():
    truth, record = drive(ctrv(), 5)
    filtered = hw.estimate(ctrv(), record, UnscentedKalman())
    smoothed = hw.estimate(ctrv(), record, UnscentedKalman(smooth=True))
    gap = (record.t >= 12.0) & (record.t <= 15.0)
    f, s = (np.abs(e.x[gap, :2] - truth.x[gap, :2]).max() for e in (filtered, smoothed))
    assert s < 0.7 * f
    assert np.all(smoothed.spread.sd[gap, :2] <= filtered.spread.sd[gap, :2] * (1 + 1e-9))


def test_angles_as_outputs():
    """A bearing that jumps between pi and -pi: with `y_angles` the jump is none."""
    rng = np.random.default_rng(0)
    T = 80
    x = np.column_stack([-10 + np.zeros(T), np.linspace(-3, 3, T)])
    y = np.arctan2(x[:, 1], x[:, 0]) + 0.01 * rng.normal(size=T)
    y = np.remainder(y + np.pi, 2 * np.pi) - np.pi
    assert np.ptp(y) > 6

    def model(**angles):
        return hw.Nonlinear(
            lambda s: np.array([s[0], s[1] + 6 / (T - 1)]), lambda s: np.arctan2(s[1], s[0]), hw.Gaussian(1e-4),
            hw.Gaussian(1e-4), hw.Normal([-10.0, -3.0], [1e-6, 0.1]), **angles,
        )  # fmt: skip

    record = hw.Record(np.arange(T), y)
    for method in ALL:
        good = hw.estimate(model(y_angles=(0,)), record, method)
        assert np.abs(good.x - x).max() < 0.4
        bad = hw.estimate(model(), record, method)
        assert np.abs(bad.x - x).max() > 1.0


def test_filterpy_agrees():
    kalman = pytest.importorskip("filterpy.kalman")
    model = ctrv(w=hw.Gaussian([1e-3, 1e-3, 0.05, 1e-3, 0.01]), x_angles=())
    _, record = hw.simulate(model, np.sin(np.arange(60) / 20)[:, None], seed=2)
    for settings in ({"alpha": 1.0, "beta": 2.0, "kappa": 0.0}, {"alpha": 0.1, "beta": 2.0, "kappa": -1.0}):
        points = kalman.MerweScaledSigmaPoints(5, **settings)
        peer = kalman.UnscentedKalmanFilter(
            5, 2, 0.2, fx=lambda x, dt, u: ctrv_step(x, u, dt), hx=lambda x: x[:2], points=points
        )
        peer.x, peer.P = model.x0.mean.copy(), model.x0.P.copy()
        peer.Q, peer.R = model.w.cov().single, model.e.cov().single
        x, P, loglik = [], [], 0.0
        for y, u in zip(record.y, record.u, strict=True):
            peer.predict(u=u)
            peer.update(y)
            x.append(peer.x.copy())
            P.append(peer.P.copy())
            loglik += peer.log_likelihood
        est = hw.estimate(model, record, UnscentedKalman(**settings))
        np.testing.assert_allclose(est.x, x, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(est.P, P, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(est.loglik, loglik, rtol=1e-8)


def square_root_sensor(**more):
    """A range seen from close by: one linearisation is not enough."""
    return hw.Nonlinear(
        lambda x: x,
        lambda x: np.hypot(x[0], x[1]),
        hw.Gaussian(1e-6),
        hw.Gaussian(1e-4),
        hw.Normal([1.0, 0.5], [0.5, 0.05]),
        **more,
    )


def log_posterior(model, record, x0, x):
    """Of a trajectory, up to a constant."""

    def half(v, S):
        return -0.5 * float(v @ np.linalg.solve(S, v))

    value = half(x0 - model.x0.mean, model.x0.P)
    before = x0
    for k, now in enumerate(x):
        value += half(now - np.asarray(model.g(before)), model.w.cov().single)
        if record.seen[k].any():
            value += half(record.y[k] - np.atleast_1d(model.h(now)), model.e.cov().single)
        before = now
    return value


def test_iterations_find_the_top_of_the_posterior():
    model = square_root_sensor()
    record = hw.Record(np.arange(3.0), [2.0, np.nan, 2.01])
    values = []
    for k in (1, 2, 5, 30):
        est = hw.estimate(model, record, ExtendedKalman(smooth=True, iterations=k))
        values.append(log_posterior(model, record, est.info["x0"], est.x))
    assert values[0] < values[1] <= values[2] + 1e-9
    assert est.info["iterations"] < 30  # it stops when it stands still
    rng = np.random.default_rng(0)
    for _ in range(50):
        x0, x = est.info["x0"] + 1e-3 * rng.normal(size=2), est.x + 1e-3 * rng.normal(size=est.x.shape)
        assert log_posterior(model, record, x0, x) < values[-1]
    one, many = (hw.estimate(model, record, ExtendedKalman(iterations=k)) for k in (1, 8))
    misfit = [abs(2.0 - np.hypot(*e.x[0])) for e in (one, many)]
    assert misfit[1] < 0.1 * misfit[0]


def test_why_it_ran_in_python_is_told():
    def with_math(x):
        return np.array([math.sin(x[0])])

    def model(h):
        return hw.Nonlinear(lambda x: 0.9 * x, h, hw.Gaussian(0.1), hw.Gaussian(0.1), hw.Normal([0.5], 1.0))

    record = hw.Record(np.arange(5.0), [0.4, 0.3, None, 0.1, 0.2])
    slow = hw.estimate(model(with_math), record, UnscentedKalman())
    assert slow.info["evaluated"] == "python"
    assert "`h` cannot be compiled" in slow.info["reason"]
    assert "np.sin" in slow.info["reason"]
    fast = hw.estimate(model(np.sin), record, UnscentedKalman())
    assert fast.info["evaluated"] == "compiled"
    np.testing.assert_allclose(fast.x, slow.x, rtol=1e-12)


def test_a_branch_met_only_on_the_way_is_found_out():
    """Recorded where it is one thing, it would be wrong where it is another: the answer is checked too."""

    def g(x):
        try:
            return x + 1.0 if float(x[0]) < 5 else x + 2.0
        except Exception:
            return x + 1.0

    model = hw.Nonlinear(g, lambda x: x, hw.Gaussian(1e-4), hw.Gaussian(1.0), hw.Normal([0.0], 1e-4))
    record = hw.Record(np.arange(10.0), np.full(10, np.nan))
    est = hw.estimate(model, record, ExtendedKalman())
    assert est.info["evaluated"] == "python"
    assert "states found" in est.info["reason"]
    assert est.x[-1, 0] == pytest.approx(15.0)


def test_branches_run_compiled():
    """The usual special case for driving straight on, as users write it."""

    def step(x, u, dt):
        px, py, v, a, w = x
        if abs(w) < 1e-4:
            return np.array([px + v * dt * np.cos(a), py + v * dt * np.sin(a), v + u[0] * dt, a, w])
        return ctrv_step(x, u, dt)

    model = dataclasses.replace(ctrv(), g=step)
    _, record = drive(ctrv(), 2)
    for method in (ExtendedKalman(smooth=True), UnscentedKalman()):
        est = hw.estimate(model, record, method)
        assert est.info["evaluated"] == "compiled"
        np.testing.assert_allclose(est.x, hw.estimate(ctrv(), record, method).x, rtol=1e-6, atol=1e-6)
    straight = model.linearise([0.0, 0.0, 8.0, 0.5, 0.0], [0.1], by="tape")
    np.testing.assert_allclose(straight.g[:2], [1.6 * np.cos(0.5), 1.6 * np.sin(0.5)])
    np.testing.assert_array_equal(straight.g_x[3], [0, 0, 0, 1, 0])


def test_jacobians_of_the_user():
    calls = []

    def g_x(x):
        calls.append(1)
        return np.array([[np.cos(x[0])]])

    def model(**jacobians):
        return hw.Nonlinear(
            np.sin, lambda x: x**2, hw.Gaussian(0.1), hw.Gaussian(0.1), hw.Normal([0.5], 1.0), **jacobians
        )

    record = hw.Record(np.arange(4.0), [0.4, 0.3, None, 0.1])
    plain = hw.estimate(model(), record, ExtendedKalman())
    right = hw.estimate(model(g_x=g_x, h_x=lambda x: [[2 * x[0]]]), record, ExtendedKalman())
    assert right.info["evaluated"] == "compiled"
    np.testing.assert_array_equal(plain.x, right.x)
    own = hw.estimate(model(h_x=lambda x: [[1.5 * x[0]]]), record, ExtendedKalman())
    assert own.info["evaluated"] == "python"
    assert "`h_x` differs" in own.info["reason"]
    assert np.abs(own.x - plain.x).max() > 1e-3
    in_python = hw.estimate(model(g_x=g_x, h_x=lambda x: [[2 * x[0]]]), record, ExtendedKalman(compiled=False))
    np.testing.assert_allclose(in_python.x, plain.x, rtol=1e-12)
    assert calls


@pytest.mark.parametrize("by", ["tape", "differences", "user", None])
def test_linearise(by):
    model = ctrv(
        g_x=lambda x, u, dt: ctrv().linearise(x, u, dt, by="tape").g_x,
        h_x=lambda x: np.eye(2, 5),
    )
    x, u = np.array([1.0, 2.0, 8.0, 3.0, 0.3]), np.array([0.4])
    exact = ctrv().linearise(x, u, 0.25, by="tape")
    got = model.linearise(x, u, 0.25, by=by)
    np.testing.assert_allclose(got.g, ctrv_step(x, u, 0.25), rtol=1e-15)
    np.testing.assert_allclose(got.h, x[:2])
    np.testing.assert_allclose(got.g_x, exact.g_x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(got.h_x, np.eye(2, 5), atol=1e-10)
    assert np.abs(model.linearise(x).g_x - got.g_x).max() > 1e-3  # dt of the model, no input


def test_linearise_says_what_it_cannot():
    model = hw.Nonlinear(
        lambda x: np.array([math.sin(x[0])]), lambda x: x, hw.Gaussian(1), hw.Gaussian(1), hw.Normal([0.3], 1)
    )
    np.testing.assert_allclose(model.linearise([0.3]).g_x, [[math.cos(0.3)]], rtol=1e-10)
    with pytest.raises(hw.BadValue, match="cannot be compiled"):
        model.linearise([0.3], by="tape")
    with pytest.raises(hw.BadValue, match="has no `g_x`"):
        model.linearise([0.3], by="user")
    with pytest.raises(hw.BadValue, match="'user', 'tape'"):
        model.linearise([0.3], by="guess")
    with pytest.raises(hw.BadShape, match="`x`"):
        model.linearise([0.3, 1.0])
    with pytest.raises(hw.BadShape, match="`u`"):
        ctrv().linearise(np.ones(5), [1.0, 2.0])


# ---- adversaries --------------------------------------------------------------------------------------------------


def hard(model, record):
    yield "nothing seen", model, hw.Record(record.t, np.full_like(record.y, np.nan), record.u)
    yield "one row", model, hw.Record(record.t[:1], record.y[:1], record.u[:1])
    yield "no noise at all", dataclasses.replace(model, w=hw.Gaussian(0.0), e=hw.Gaussian(0.0)), record
    yield (
        "no noise, certain start",
        dataclasses.replace(model, w=hw.Gaussian(0.0), e=hw.Gaussian(0.0), x0=hw.Normal(model.x0.mean, 0.0)),
        record,
    )
    yield "certain outputs", dataclasses.replace(model, e=hw.Gaussian(0.0)), record
    yield "vague prior", dataclasses.replace(model, x0=hw.Normal(model.x0.mean, 1e12)), record
    yield "far away", model, hw.Record(record.t, record.y + 1e9, record.u)
    for s in (1e-12, 1e12, 1e150, 1e300):
        yield f"outputs times {s:g}", model, hw.Record(record.t, s * record.y, record.u)
    yield "loud", dataclasses.replace(model, w=hw.Gaussian(1e24), e=hw.Gaussian(1e-24)), record
    yield "quiet", dataclasses.replace(model, w=hw.Gaussian(1e-24), e=hw.Gaussian(1e24)), record
    yield "enormous", dataclasses.replace(model, w=hw.Gaussian(1e300), e=hw.Gaussian(1e-300)), record


@pytest.mark.parametrize("method", [*ALL, UnscentedKalman(alpha=1e-3, smooth=True)], ids=repr)
def test_hard_cases_stay_finite_and_positive(method):
    model = ctrv()
    _, record = drive(model, 1, T=40)
    for name, m, r in hard(model, record):
        est = hw.estimate(m, r, method)
        assert np.isfinite(est.x).all(), name
        assert np.isfinite(est.P).all(), name
        assert np.isfinite(est.loglik), name
        np.testing.assert_array_equal(est.P, np.swapaxes(est.P, 1, 2), err_msg=name)
        low = np.linalg.eigvalsh(est.P)
        assert np.all(low[:, 0] >= -1e-12 * np.maximum(low[:, -1], 1e-300)), name
        assert est.status.good or est.info["message"], name


@pytest.mark.parametrize("method", ALL, ids=repr)
def test_small_and_large_units(method):
    """Kilometres or micrometres, the same car."""
    _, record = drive(ctrv(), 2, T=60)
    one = hw.estimate(ctrv(), record, method)
    for s in (1e-12, 1e12):
        scale = np.array([s, s, s, 1.0, 1.0])
        model = hw.Nonlinear(
            lambda x, u, dt, c=scale: c * ctrv_step(x / c, u, dt), lambda x: x[:2],
            hw.Gaussian(lambda dt, c=scale: np.diag(np.array([1e-3, 1e-3, 0.05, 1e-4, 2e-4]) * dt * c**2)),
            hw.Gaussian(s**2 * np.array([[0.5, 0.2], [0.2, 0.4]])),
            hw.Normal(scale * ctrv().x0.mean, np.diag(ctrv().x0.P) * scale**2), nu=1, dt=0.2, x_angles=(3,),
        )  # fmt: skip
        two = hw.estimate(model, hw.Record(record.t, s * record.y, record.u), method)
        np.testing.assert_allclose(two.x / scale, one.x, rtol=1e-6, atol=1e-7)
        assert two.status is one.status


def test_a_long_run_stays_positive():
    model = ctrv(w=hw.Gaussian([1e-9, 1e-9, 1e-5, 1e-9, 1e-7]))
    T = 30_000
    _, record = hw.simulate(model, np.zeros((T, 1)), seed=0)
    y = record.y.copy()
    y[np.random.default_rng(0).random(T) < 0.5] = np.nan
    for method in (ExtendedKalman(smooth=True), UnscentedKalman(smooth=True)):
        est = hw.estimate(model, hw.Record(record.t, y, record.u), method)
        assert est.status is hw.Status.OK
        low = np.linalg.eigvalsh(est.P[::50])
        assert np.all(low[:, 0] >= -1e-12 * low[:, -1])


@pytest.mark.parametrize("method", ALL, ids=repr)
def test_g_that_leaves_its_domain_is_held_and_told(method):
    model = hw.Nonlinear(
        lambda x: np.sqrt(x - 1.0), lambda x: x, hw.Gaussian(1e-4), hw.Gaussian(1e-2), hw.Normal([2.0], 1e-4), dt=1.0
    )
    est = hw.estimate(model, hw.Record(np.arange(1.0, 6.0), [1.0, None, None, 0.3, None]), method)
    assert est.status is hw.Status.COLLAPSED
    assert "`g` was not finite" in est.info["message"]
    assert "first at t = " in est.info["message"]
    assert np.isfinite(est.x).all()
    assert np.isfinite(est.P).all()
    with pytest.raises(hw.Unsolved):
        est.check()


@pytest.mark.parametrize("method", ALL, ids=repr)
def test_h_that_leaves_its_domain_leaves_the_output_out(method):
    model = hw.Nonlinear(lambda x: x - 1.0, np.log, hw.Gaussian(1e-6), hw.Gaussian(1e-2), hw.Normal([2.9], 1e-6))
    est = hw.estimate(model, hw.Record(np.arange(4.0), [0.6, -0.1, 0.0, 0.0]), method)
    assert est.status is hw.Status.REDUCED
    assert "`h` was not finite" in est.info["message"]
    assert "t = 2 s" in est.info["message"]
    assert est.x[-1, 0] == pytest.approx(-1.1, abs=0.1)


def test_negative_weights_that_break_a_covariance_are_repaired_and_told():
    model = hw.Nonlinear(
        lambda x: np.array([x[0] ** 2]), lambda x: x, hw.Gaussian(1e-6), hw.Gaussian(1e-2), hw.Normal([0.01], 1.0)
    )
    record = hw.Record(np.arange(3.0), [0.1, None, 0.2])
    for compiled in (True, False):
        est = hw.estimate(model, record, UnscentedKalman(beta=0.0, kappa=-0.5, compiled=compiled))
        assert est.status is hw.Status.REDUCED
        assert "negative weight" in est.info["message"]
        assert np.all(est.P >= 0)
        assert hw.estimate(model, record, UnscentedKalman(compiled=compiled)).status is hw.Status.OK


def test_contradicted_certainty_is_told():
    model = hw.Nonlinear(lambda x: x, lambda x: x, hw.Gaussian(0.0), hw.Gaussian(0.0), hw.Normal([1.0], 0.0))
    for method in ALL:
        est = hw.estimate(model, hw.Record([0.0, 1.0], [1.0, 2.0]), method)
        assert est.status is hw.Status.REDUCED
        assert "contradicts" in est.info["message"]
        np.testing.assert_allclose(est.x, 1.0)


def changes(value, when):
    """A g that is fine where the model is judged and returns `value` from the call `when` on."""
    calls = []

    def g(x):
        calls.append(1)
        return x if len(calls) < when else value

    return g


@pytest.mark.parametrize(
    ("g", "error", "words"),
    [
        (lambda x: np.ones(3), hw.BadShape, "`g` returned shape"),
        (lambda x: x * 1j, hw.BadValue, "complex"),
        (lambda x: x * np.nan, hw.BadValue, "NaN"),
        (lambda x: x[9], hw.BadValue, "IndexError"),
        (lambda x: "no", hw.BadValue, "number"),
        (lambda x: None, hw.BadValue, "g"),
    ],
)
def test_a_wrong_g_is_named_when_the_model_is_made(g, error, words):
    with pytest.raises(error, match=words):
        hw.Nonlinear(g, lambda x: x, hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0.0, 0.0], 1.0))


@pytest.mark.parametrize(
    ("value", "error", "words"),
    [
        (np.ones(3), hw.BadShape, "`g` returned shape"),
        (np.ones(2) * 1j, hw.BadValue, "complex"),
        ("no", hw.BadValue, "real numbers"),
    ],
)
@pytest.mark.parametrize("method", IN_PYTHON[:2], ids=repr)
def test_a_g_that_turns_wrong_later_is_named_with_its_time(value, error, words, method):
    model = hw.Nonlinear(
        changes(value, 40), lambda x: x, hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0.0, 0.0], 1.0)
    )
    with pytest.raises(error, match=words) as caught:
        hw.estimate(model, hw.Record(np.arange(40.0), np.zeros((40, 2))), method)
    assert "t = " in str(caught.value)


def test_a_g_that_raises_later_is_named_with_its_time():
    def g(x):
        if x[0] > 3:
            raise RuntimeError("too far")
        return x + 1

    model = hw.Nonlinear(g, lambda x: x, hw.Gaussian(1e-6), hw.Gaussian(1.0), hw.Normal([0.0], 1e-6))
    with pytest.raises(hw.BadValue, match=r"`g` failed at t = \d.* s with RuntimeError: too far\nhint: call g"):
        hw.estimate(model, hw.Record(np.arange(9.0), np.full(9, np.nan)), ExtendedKalman())


def test_functions_that_fail_far_away_do_no_harm():
    """Tapes are tried at points that a run never meets; what happens there is not the user's problem."""

    def g(x):
        if abs(x[0]) > 2.5:
            raise RuntimeError("too far")
        return 0.5 * x

    def h(x):
        try:
            far = abs(float(x[0])) > 2.5
        except Exception:
            far = False
        if far:
            raise RuntimeError("too far")
        return x

    def h_x(x):
        if abs(x[0]) > 2.5:
            raise RuntimeError("too far")
        return np.eye(1)

    record = hw.Record(np.arange(5.0), [0.1, None, 0.2, 0.1, 0.0])
    settings = (hw.Gaussian(0.1), hw.Gaussian(0.1), hw.Normal([0.5], 1.0))
    want = hw.estimate(hw.Nonlinear(lambda x: 0.5 * x, lambda x: x, *settings), record, ExtendedKalman())
    for model in (
        hw.Nonlinear(g, lambda x: x, *settings),
        hw.Nonlinear(lambda x: 0.5 * x, h, *settings),
        hw.Nonlinear(lambda x: 0.5 * x, lambda x: x, *settings, h_x=h_x),
    ):
        got = hw.estimate(model, record, ExtendedKalman())
        np.testing.assert_allclose(got.x, want.x, rtol=1e-9)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ExtendedKalman(iterations=0), "iterations"),
        (lambda: ExtendedKalman(iterations=1.5), "iterations"),
        (lambda: UnscentedKalman(alpha=0.0), "alpha"),
        (lambda: UnscentedKalman(alpha=np.nan), "alpha"),
        (lambda: UnscentedKalman(beta=np.inf), "beta"),
        (lambda: UnscentedKalman(kappa=np.nan), "kappa"),
    ],
)
def test_settings_are_judged(make, words):
    with pytest.raises(hw.BadValue, match=words):
        make()


def test_refusals_say_what_to_type():
    model = ctrv()
    cases = {
        "Gaussian noise": dataclasses.replace(model, w=hw.Uniform(0.1)),
        "Gaussian prior": dataclasses.replace(model, x0=hw.Box(-np.ones(5), np.ones(5))),
        "bounds": dataclasses.replace(model, bounds=(-10 * np.ones(5), 10 * np.ones(5))),
    }
    for words, wrong in cases.items():
        for method in (ExtendedKalman(), UnscentedKalman()):
            reason = method.refuses(wrong)
            assert words in reason
            assert "\nhint: " in reason
            with pytest.raises(hw.Refused, match=words):
                method.init(wrong)
    assert "kappa" in UnscentedKalman(kappa=-5.0).refuses(model)


def test_row_by_row_equals_the_record():
    model = ctrv()
    _, record = drive(model, 4, T=50)
    dt = record.steps(model.dt)
    for method in (ExtendedKalman(iterations=2), UnscentedKalman(), UnscentedKalman(compiled=False)):
        batch = hw.estimate(model, record, method)
        state = method.init(model)
        for k in range(len(record)):
            state = method.step(model, state, record.y[k], record.u[k], record.t[k], dt[k])
        x, P, loglik = method.belief(model, state)
        np.testing.assert_allclose(x, batch.x[-1], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(P, batch.P[-1], rtol=1e-10, atol=1e-12)
        assert loglik == pytest.approx(batch.loglik, rel=1e-12)


def test_a_nonlinear_model_is_smoothed_by_default():
    _, record = drive(ctrv(), 4, T=30)
    est = hw.estimate(ctrv(), record)
    assert est.method == "UnscentedKalman(smooth=True)"
    np.testing.assert_array_equal(est.x, hw.estimate(ctrv(), record, UnscentedKalman(smooth=True)).x)


def test_many_records_and_frames():
    _, one = drive(ctrv(), 4, T=30)
    _, two = drive(ctrv(), 5, T=20)
    several = hw.estimate(ctrv(), [one, two], UnscentedKalman())
    for record, est in zip([one, two], several, strict=True):
        np.testing.assert_array_equal(est.x, hw.estimate(ctrv(), record, UnscentedKalman()).x)
