"""`Posterior`: limits where the answer is known, coverage, what it learns, and how it fails."""

import dataclasses

import numpy as np
import pytest

import halfwidth as hw
from halfwidth.reproduce import paper003

A = np.array([[1, -0.5, 0.2], [0.5, 0.1, 0], [0.3, 0, -0.1]])
C = np.array([[1, 0, 0.5], [0, 1, 0.5]])
BOX = hw.Box(-2 * np.ones(3), 2 * np.ones(3))


def paper(w, e, x0=BOX, **more):
    return hw.Linear(A, [[0.1], [0.6], [0.3]], C, w, e, x0, **more)


def drawn(T, seed):
    """Return the states, x0 first, and a record of the true system, half-widths .1 and .3."""
    true = paper(hw.Uniform(0.1), hw.Uniform(0.3), hw.Box(-0.3 * np.ones(3), 0.3 * np.ones(3)))
    rng = np.random.default_rng(seed)
    return hw.simulate(true, rng.uniform(-1, 1, (T, 1)), seed=seed)


UNKNOWN = hw.Uniform.unknown(at_most=3.0)


@pytest.mark.parametrize("missing", [0.0, 0.4])
def test_gaussian_noise_is_the_smoother(missing):
    rng = np.random.default_rng(1)
    R = [[0.5, 0.2], [0.2, 0.4]]
    model = paper(hw.Gaussian([[0.3, 0.1, 0], [0.1, 0.2, 0], [0, 0, 0.1]]), hw.Gaussian(R), hw.Normal(np.zeros(3), 1.0))
    model = dataclasses.replace(model, E=hw.Linear(A, None, C, UNKNOWN, UNKNOWN, None, E=np.eye(3)).E, F=None)
    _, record = hw.simulate(model, rng.standard_normal((50, 1)), seed=1)
    y = record.y.copy()
    y[rng.random(y.shape) < missing] = np.nan
    record = hw.Record(record.t, y, record.u)
    one, two = hw.estimate(model, record, hw.Posterior()), hw.estimate(model, record, hw.KalmanSmoother())
    np.testing.assert_allclose(one.x, two.x, atol=1e-9)
    np.testing.assert_allclose(one.P, two.P, atol=1e-9)
    assert one.loglik == pytest.approx(two.loglik, abs=1e-9)
    assert isinstance(one.spread, hw.Normal)


def test_known_half_widths_agree_with_draws():
    truth, record = drawn(12, 2)
    model = paper(hw.Uniform(0.1), hw.Uniform(0.3), bounds=BOX)
    est = hw.estimate(model, record, hw.Posterior())
    drawn_est = hw.estimate(model, record, hw.Posterior(method="sample"), seed=1)
    assert drawn_est.status is hw.Status.OK
    x = np.moveaxis(drawn_est.spread.points, 1, 0)
    sd = x.std(axis=0)
    assert np.abs((est.x - x.mean(axis=0)) / sd).mean() < 0.05
    assert np.abs(est.spread.sd / sd - 1).max() < 0.12
    for level in (0.5, 0.9):
        lo, hi = est.interval(level)
        assert ((x >= lo) & (x <= hi)).mean() == pytest.approx(level, abs=0.02)
    assert np.asarray(truth).shape == est.x.shape


def test_half_widths_are_learned_without_bias():
    q, r = [], []
    for seed in range(6):
        _, record = drawn(150, seed)
        est = hw.estimate(paper(UNKNOWN, UNKNOWN), record)
        assert est.method.startswith("Posterior")
        assert est.status.good
        q.append(est.q)
        r.append(est.r)
        widths = est.info["half_widths"]
        assert np.all(widths["lo"] <= widths["mean"])
        assert np.all(widths["mean"] <= widths["hi"])
    # one record tells q to 40 %, six to 17: twice that
    np.testing.assert_allclose(np.mean(q, axis=0)[:2], 0.1, rtol=0.33)
    np.testing.assert_allclose(np.mean(r, axis=0), 0.3, rtol=0.1)


def test_intervals_cover_what_they_say():
    inside = []
    for seed in range(100):
        truth, record = drawn(26, 100 + seed)
        est = hw.estimate(paper(UNKNOWN, UNKNOWN), record, hw.Posterior())
        inside.append(
            [((truth >= lo) & (truth <= hi)).mean() for lo, hi in (est.interval(p) for p in (0.5, 0.8, 0.95))]
        )
    np.testing.assert_allclose(np.mean(inside, axis=0), [0.5, 0.8, 0.95], atol=0.06)


def test_outliers_are_named_and_do_no_harm():
    truth, record = drawn(150, 3)
    rng = np.random.default_rng(0)
    y = record.y.copy()
    bad = rng.random(y.shape) < 0.01
    y[bad] += rng.choice([-3.0, 3.0], bad.sum())
    clean = hw.estimate(paper(UNKNOWN, UNKNOWN), record, hw.Posterior())
    est = hw.estimate(paper(UNKNOWN, UNKNOWN), hw.Record(record.t, y, record.u), hw.Posterior(outliers=True))
    assert est.status.good
    assert np.abs(est.x - truth).mean() <= 1.1 * np.abs(clean.x - truth).mean()
    assert {(o["row"], o["name"]) for o in est.info["outliers"]} == {
        (int(t), est.info["outliers"][0]["name"][:-1] + str(j)) for t, j in np.argwhere(bad)
    } or len(est.info["outliers"]) == bad.sum()
    assert 0.001 < est.info["rate"] < 0.05


def test_losses_are_found():
    loss = hw.Bernoulli(0.8, noise=4.0, sensors=[[0], [1]])
    model = paper(hw.Uniform(0.1), hw.Uniform(0.3), loss=loss)
    rng = np.random.default_rng(4)
    truth, record = hw.simulate(model, rng.uniform(-1, 1, (200, 1)), seed=4)
    est = hw.estimate(model, record, hw.Posterior())
    blind = hw.estimate(dataclasses.replace(model, loss=None).as_gaussian(), record, hw.KalmanSmoother())
    assert est.gamma.shape == record.y.shape
    assert np.abs(est.x - truth).mean() < 0.8 * np.abs(blind.x - truth).mean()
    learned = hw.estimate(
        dataclasses.replace(model, loss=hw.Bernoulli.unknown(0.5, noise=4.0, sensors=[[0], [1]])),
        record,
        hw.Posterior(),
    )
    assert learned.info["rate"] == pytest.approx(0.2, abs=0.08)


def test_unknown_entries():
    true = hw.Linear(
        [[0.9, 0.2], [-0.2, 0.8]], None, np.eye(2), hw.Uniform(0.1), hw.Uniform(0.2), hw.Box([-1, -1], [1, 1])
    )
    _, record = hw.simulate(true, T=60, seed=1)
    model = hw.Linear(
        [[np.nan, 0.2], [-0.2, 0.8]], None, np.eye(2), UNKNOWN, UNKNOWN, hw.Box([-1, -1], [1, 1]),
        theta_bounds=([0], [1.2]),
    )  # fmt: skip
    est = hw.estimate(model, record, hw.Posterior(nodes=16))
    assert est.status.good
    assert abs(est.theta[0] - 0.9) < 3 * est.info["theta_sd"][0] + 0.02
    assert 0.005 < est.info["theta_sd"][0] < 0.2


def test_nonlinear_equals_linear_where_it_is():
    model = paper(hw.Uniform(0.1), hw.Uniform(0.3))
    _, record = drawn(30, 5)
    bent = hw.Nonlinear(
        lambda x, u: np.array(A) @ x + np.array([0.1, 0.6, 0.3]) * u[0], lambda x: np.array(C) @ x, model.w, model.e, BOX,
        nu=1,
    )  # fmt: skip
    one, two = hw.estimate(model, record, hw.Posterior()), hw.estimate(bent, record, hw.Posterior())
    np.testing.assert_allclose(two.x, one.x, atol=1e-5)
    assert two.loglik == pytest.approx(one.loglik, abs=1e-3)


def test_window_and_stream_carry_intervals():
    truth, record = drawn(20, 6)
    method = hw.Window(hw.Posterior(nodes=8), memory=6)
    est = hw.estimate(paper(UNKNOWN, UNKNOWN, bounds=BOX), record.without(8, 12), method)
    lo, hi = est.interval(0.9)
    assert lo.shape == est.x.shape == np.asarray(truth).shape
    live = hw.stream(paper(UNKNOWN, UNKNOWN, bounds=BOX), method)
    for t, (y, u) in enumerate(zip(record.without(8, 12).y, record.u, strict=True)):
        newest = live.push(y, u)
        np.testing.assert_allclose(newest.x[0], est.x[t], atol=1e-9)
        np.testing.assert_allclose(newest.interval(0.9)[0][0], lo[t], atol=1e-9)
    assert np.all(hi - lo > 0)


def test_linear_functionals():
    _, record = drawn(20, 7)
    est = hw.estimate(paper(hw.Uniform(0.1), hw.Uniform(0.3)), record, hw.Posterior())
    lo, hi = est.interval(0.8, of=np.eye(3))
    np.testing.assert_allclose((lo, hi), est.interval(0.8))
    lo, hi = est.interval(0.8, of=[1, 0, 0.5])
    assert lo.shape == (20, 1)
    inside = est.x @ [1, 0, 0.5]
    assert np.all((lo[:, 0] < inside) & (inside < hi[:, 0]))
    with pytest.raises(hw.BadShape):
        est.interval(0.8, of=[1, 0])


def test_no_trajectory_fits():
    _, record = drawn(20, 8)
    y = record.y.copy()
    y[10] += 50
    est = hw.estimate(paper(hw.Uniform(0.1), hw.Uniform(0.3)), hw.Record(record.t, y, record.u), hw.Posterior())
    assert est.status is hw.Status.INFEASIBLE
    assert np.isfinite(est.x).all()
    assert np.isfinite(est.interval()).all()
    assert est.loglik is None
    with pytest.raises(hw.Unsolved):
        est.check()


@pytest.mark.parametrize("seed", range(6))
def test_random_windows_never_give_nan(seed):
    rng = np.random.default_rng(seed)
    for _ in range(25):
        n, ny, T = rng.integers(1, 4), rng.integers(1, 3), rng.integers(1, 12)
        scale = 10 ** rng.uniform(-6, 6)
        noise = [
            hw.Uniform.unknown(at_most=rng.choice([1.0, 10.0]) * scale),
            hw.Uniform(scale * rng.choice([0.0, 1e-6, 0.1, 1.0])),
            hw.Gaussian((scale * rng.choice([0.0, 1e-3, 1.0])) ** 2),
            hw.Uniform.unknown() + hw.Gaussian((0.1 * scale) ** 2),
        ]
        model = hw.Linear(
            rng.uniform(-1, 1, (n, n)), None, rng.standard_normal((ny, n)), noise[rng.integers(4)], noise[rng.integers(4)],
            [hw.Box(-scale * np.ones(n), scale * np.ones(n)), None, hw.Normal(np.zeros(n), scale**2)][rng.integers(3)],
            bounds=[None, (-3 * scale * np.ones(n), 3 * scale * np.ones(n))][rng.integers(2)],
        )  # fmt: skip
        y = scale * rng.standard_normal((T, ny))
        y[rng.random(y.shape) < rng.choice([0.0, 0.3, 1.0])] = np.nan
        if rng.random() < 0.3:
            y[rng.integers(T)] *= 1e3
        est = hw.estimate(model, hw.Record(np.arange(1.0, T + 1), y), hw.Posterior(nodes=8))
        assert np.isfinite(est.x).all()
        lo, hi = est.interval(0.9)
        assert np.isfinite(lo).all()
        assert np.all(lo <= hi)
        for value in (est.q, est.r):
            assert value is None or np.isfinite(value).all()
        assert est.loglik is None or np.isfinite(est.loglik)


def test_evidence_and_left_out_score_choose_the_noise():
    _, record = drawn(80, 9)
    models = {
        "uniform": paper(hw.Uniform(0.1), hw.Uniform(0.3)),
        "too wide": paper(hw.Uniform(0.1), hw.Uniform(1.5)),
        "gaussian": paper(hw.Gaussian(0.1**2 / 3), hw.Gaussian(0.3**2 / 3), hw.Normal(np.zeros(3), 1.0)),
    }
    found = hw.compare(models, record, seed=1)
    assert found.best == "uniform"
    assert found.foretells in ("uniform", "gaussian")
    assert "too wide" in str(found)


@pytest.mark.parametrize(
    "settings",
    [{"nodes": 0}, {"outliers": -0.1}, {"outliers": 1.0}, {"rounds": 0}, {"iterations": 0}, {"method": "gibbs"}],
    ids=str,
)
def test_bad_settings(settings):
    with pytest.raises(hw.BadValue):
        hw.Posterior(**settings)


def test_refusals_say_what_to_do():
    full = hw.Uniform(0.1) + hw.Gaussian([[1.0, 0.5], [0.5, 1.0]])
    cases = [
        (hw.Posterior(), paper(hw.Uniform(0.1), full)),
        (hw.Posterior(outliers=True), paper(hw.Uniform(0.1), hw.Gaussian(0.1))),
        (hw.Posterior(), paper(hw.Uniform(0.1), hw.Uniform(0.3), loss=hw.Markov(0.9, 0.5))),
        (hw.Posterior(), paper(hw.Uniform(0.1), hw.Uniform(0.3), loss=hw.Bernoulli(0.9))),
    ]
    for method, model in cases:
        assert "hint: " in method.refuses(model)
        with pytest.raises(hw.Refused):
            hw.estimate(model, hw.Record([1.0], [[0.0, 0.0]], [[0.0]]), method)


def test_a_mode_in_the_corner_of_its_bounds_is_no_infeasibility():
    rng = np.random.default_rng(0)
    tight = hw.Uniform.unknown(0.04, 0.11), hw.Uniform.unknown(0.12, 0.31)
    inside = []
    for seed in range(8):
        u = rng.uniform(-1, 1, (26, 1))
        true = paper(hw.Uniform(0.109), hw.Uniform(0.309), hw.Box(-0.3 * np.ones(3), 0.3 * np.ones(3)))
        truth, record = hw.simulate(true, u, seed=seed)
        est = hw.estimate(paper(*tight, true.x0), record, hw.Posterior(nodes=16))
        assert est.status.good
        lo, hi = est.interval(0.95)
        inside.append(np.mean((lo <= truth.x) & (truth.x <= hi)))
    assert np.mean(inside) > 0.85


@pytest.mark.parametrize(("seed", "T"), [(25, 260), (26, 260), (23, 400)])
def test_hundreds_of_rows_between_bounds_are_no_infeasibility(seed, T):
    # The first steps of the search lead where no trajectory fits, and the moments run apart.
    lo, hi = np.array([-0.80, -0.61, -0.40]), np.array([0.76, 0.66, 0.44])
    rng, x, X, U = np.random.default_rng(seed), np.zeros(3), [], []
    for _ in range(T + 30):
        for attempt in range(10_000):
            if attempt % 100 == 0:
                u = rng.uniform(-1, 1, 1)
            new = A @ x + np.array([0.1, 0.6, 0.3]) * u + rng.uniform(-0.1, 0.1, 3)
            if np.all((lo <= new) & (new <= hi)):
                break
        x = new
        X.append(x)
        U.append(u)
    states, u = np.array(X)[30:], np.array(U)[30:]
    record = hw.Record(np.arange(1.0, T + 1), states @ C.T + rng.uniform(-0.3, 0.3, (T, 2)), u)
    own = hw.Uniform.unknown(at_most=1.0)
    est = hw.estimate(paper(own, own, hw.Box(lo, hi), bounds=hw.Box(lo, hi)), record, hw.Posterior(nodes=16))
    assert est.status.good
    low, high = est.interval(0.9)
    assert 0.8 < np.mean((low <= states) & (states <= high)) < 0.97


def test_more_unknowns_than_it_finds_are_refused():
    n = 9
    many = hw.Linear(0.9 * np.eye(n), None, np.eye(n), UNKNOWN, UNKNOWN, hw.Box(-np.ones(n), np.ones(n)))
    assert "18 are unknown" in hw.Posterior().refuses(many)
    assert hw.estimate(many, hw.Record([1.0, 2.0], np.zeros((2, n)))).method == "BatchLP()"
    told = dataclasses.replace(many, e=hw.Uniform.unknown(np.full(n, 0.3), [0.3] * 5 + [1.0] * 4))
    assert hw.Posterior().refuses(told) is None


def test_an_output_gain_is_found_though_none_fits_in_the_middle():
    true = hw.Linear([[0.9]], None, [[1.0], [1.0]], hw.Uniform(0.2), hw.Uniform(0.3), hw.Box([-1], [1]))
    _, record = hw.simulate(true, T=60, seed=1)
    asked = dataclasses.replace(true, C=[[np.nan], [1.0]], w=UNKNOWN, e=UNKNOWN, theta_bounds=(-2.0, 2.0))
    est = hw.estimate(asked, record, hw.Posterior(nodes=8))
    assert est.theta[0] == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("huge", [1e8, 1e12])
def test_other_records_of_a_model_leave_no_trace(huge):
    """What records of one model have in common is kept, but not what the size of their outputs made of it."""
    model = hw.Linear([[1.0]], None, [[1.0]], hw.Gaussian(0.04), hw.Gaussian(0.01), hw.Normal([0.0], [[1.0]]))
    y = np.cumsum(np.random.default_rng(5).normal(size=(20, 1)), axis=0)
    first = hw.estimate(model, hw.Record(np.arange(20.0), y), hw.Posterior())
    fresh = hw.Linear([[1.0]], None, [[1.0]], hw.Gaussian(0.04), hw.Gaussian(0.01), hw.Normal([0.0], [[1.0]]))
    hw.estimate(fresh, hw.Record(np.arange(20.0), huge * y), hw.Posterior())
    again = hw.estimate(fresh, hw.Record(np.arange(20.0), y), hw.Posterior())
    np.testing.assert_array_equal(again.x, first.x)
    np.testing.assert_array_equal(again.P, first.P)


def test_the_search_of_a_long_batch_is_not_cut_short_by_steps_that_are_held_in_a_box():
    # a record of 700 rows between bounds: a Newton step that was cut where it reached too far led downhill from here, and
    # the search had ended at .06 .15 .18 .28 .25 with a third of the standard deviations
    rng, rows, x, X, U = np.random.default_rng(4), 700, np.zeros(3), [], []
    for _ in range(rows + 30):
        for attempt in range(10_000):
            if attempt % 100 == 0:
                u = rng.uniform(-1, 1, 1)
            new = paper003.A @ x + paper003.B @ u + rng.uniform(-0.1, 0.1, 3)
            if paper003.BOX.contains(new):
                break
        x = new
        X.append(x)
        U.append(u)
    y = np.array(X[30:]) @ paper003.C.T + rng.uniform(-0.3, 0.3, (rows, 2))
    record = hw.Record(np.arange(1.0, rows + 1), y, np.array(U[30:]))
    unknown = hw.Uniform.unknown(at_most=1.0)
    model = hw.Linear(paper003.A, paper003.B, paper003.C, unknown, unknown, paper003.BOX, bounds=paper003.BOX)
    found = hw.estimate(model, record, hw.Posterior()).info["half_widths"]
    truth = np.r_[np.full(3, 0.1), np.full(2, 0.3)]
    assert np.all(np.abs(found["mean"] - truth) < 2.5 * found["sd"])
