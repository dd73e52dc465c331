"""Gaussian methods held inside the bounds of their model."""

import dataclasses
import math

import numpy as np
import pytest
from tests import naive_constrain as naive

import halfwidth as hw
from halfwidth.reproduce import paper003

inf = math.inf


def walk(bounds, **more):
    return hw.Linear(
        np.eye(2), None, np.eye(2), hw.Gaussian(0.1), hw.Gaussian([[1.0, 0.6], [0.6, 1.0]]), hw.Normal([0.5, 0.5], 1.0),
        bounds=bounds, **more,
    )  # fmt: skip


def seen(T=30, seed=0):
    rng = np.random.default_rng(seed)
    y = 0.5 + rng.standard_normal((T, 2))
    y[rng.random((T, 2)) < 0.2] = np.nan
    return hw.Record(np.arange(1.0, T + 1), y)


BY = ("ep", "truncate", "project", "nearest")
WEDGE = hw.Halfspaces([[1, -1], [1, 1]], [0.0, -inf], [inf, 1.5])


@pytest.mark.parametrize("by", BY)
@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.parametrize("bounds", [hw.Box(0, [1, 0.6]), hw.Box([0, -inf], inf), WEDGE, hw.Halfspaces([[1, 2]], 1, 1)])
def test_every_answer_obeys(by, feedback, bounds):
    model = walk(bounds)
    est = hw.estimate(model, seen(), hw.Constrained(by=by, feedback=feedback)).check()
    D, lo, hi = bounds.rows
    assert np.all(est.x @ D.T >= lo - 1e-12)
    assert np.all(est.x @ D.T <= hi + 1e-12)
    if isinstance(bounds, hw.Box):
        assert bounds.contains(est.x).all()
        for end in est.interval(0.99):
            assert bounds.contains(end).all()
    plain = hw.estimate(dataclasses.replace(model, bounds=None), seen(), hw.KalmanFilter())
    if not feedback:
        assert est.loglik == plain.loglik
        outside = ~bounds.contains(plain.x)
        if bounds.rows[1][0] != bounds.rows[2][0]:
            np.testing.assert_array_equal(est.info["distance"] > 0, outside)


@pytest.mark.parametrize(
    "method", [hw.KalmanFilter(), hw.KalmanSmoother(), hw.KalmanSmoother(lag=3), hw.UnscentedKalman()]
)
def test_by_default_the_recursion_knows_no_bounds(method):
    model, record = walk(hw.Box(0, 1)), seen()
    plain = hw.estimate(dataclasses.replace(model, bounds=None), record, method)
    est = hw.estimate(model, record, hw.Constrained(method, by="truncate"))
    D, lo, hi = model.bounds.rows
    for k in range(len(record)):
        x, P = naive.truncate(plain.x[k], plain.P[k], D, lo, hi)
        if model.bounds.contains(x):
            np.testing.assert_allclose(est.x[k], x, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(est.P[k], P, rtol=1e-8, atol=1e-11)


@pytest.mark.parametrize("method", [hw.KalmanFilter(), hw.ExtendedKalman(), hw.UnscentedKalman()])
def test_feedback_starts_each_row_from_the_belief_cut_before(method):
    model, record = walk(hw.Box(0, 1)), seen(12)
    est = hw.estimate(model, record, hw.Constrained(method, by="truncate", feedback=True))
    x, P = model.x0.mean, model.x0.P
    for k in range(len(record)):
        one = dataclasses.replace(model, bounds=None, x0=hw.Normal(x, P))
        step = hw.estimate(one, hw.Record(record.t[k : k + 1], record.y[k : k + 1]), hw.KalmanFilter())
        x, P = naive.truncate(step.x[0], step.P[0], *model.bounds.rows)
        x = np.clip(x, 0, 1)
        np.testing.assert_allclose(est.x[k], x, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(est.P[k], P, rtol=1e-7, atol=1e-9)


def test_a_matrix_a_row_goes_through_the_feedback():
    T = 8
    A = np.array([[[1.0, 0.1 * k], [0.0, 0.9]] for k in range(T)])
    model = hw.Linear(
        A, [[1.0], [0.5]], [[1.0, 0.0]], hw.Gaussian(0.1), hw.Gaussian(1.0), hw.Normal([0, 0], 1.0), bounds=(-9, 9),
        E=[[1.0, 0.3], [0.0, 1.0]],
    )  # fmt: skip
    record = hw.Record(np.arange(1.0, T + 1), np.ones(T), np.linspace(-1, 1, T)[:, None])
    plain = hw.estimate(dataclasses.replace(model, bounds=None), record, hw.KalmanFilter())
    fed = hw.estimate(model, record, hw.Constrained(feedback=True))
    np.testing.assert_allclose(fed.x, plain.x, rtol=1e-9)
    assert fed.loglik == pytest.approx(plain.loglik, rel=1e-12)


def test_a_nonlinear_model_with_bounds():
    pendulum = hw.Nonlinear(
        lambda x: np.array([x[0] + 0.1 * x[1], x[1] - 0.9 * np.sin(x[0])]), lambda x: x[:1],
        hw.Gaussian([1e-4, 1e-2]), hw.Gaussian(0.3), hw.Normal([0.3, 0.0], 0.1), bounds=hw.Box([-0.4, -inf], [0.4, inf]),
    )  # fmt: skip
    _, record = hw.simulate(pendulum, T=40, seed=3)
    for method in (hw.ExtendedKalman(), hw.UnscentedKalman(smooth=True)):
        est = hw.estimate(pendulum, record, hw.Constrained(method)).check()
        assert pendulum.bounds.contains(est.x).all()
        assert est.info["distance"].max() > 0


def test_bounds_that_contradict_the_data_are_said():
    model = walk(hw.Box([0, 0], [1, 1]), names=["level", "flow"])
    y = np.full((5, 2), 0.5)
    y[3, 1] = 1e3
    est = hw.estimate(model, hw.Record(np.arange(1.0, 6.0), y), hw.Constrained())
    assert est.status is hw.Status.REDUCED
    assert "row 3 (t = 4 s)" in est.message
    assert "outside the bounds of `flow`" in est.message
    assert model.bounds.contains(est.x).all()
    assert est.info["distance"][3] > 30


def test_bounds_that_nothing_fulfils_are_infeasible_and_name_the_row():
    for D, lo, hi in (([[1, 0], [0, 1], [1, 1]], [1, 1, -inf], [inf, inf, 0]), ([[1, 0], [2, 0]], [1, 3], [1, 3])):
        model = walk(hw.Halfspaces(D, lo, hi))
        for feedback in (False, True):
            est = hw.estimate(model, seen(5), hw.Constrained(feedback=feedback))
            assert est.status is hw.Status.INFEASIBLE
            assert "row " in est.message
            assert "of `bounds`" in est.message
            assert np.isfinite(est.x).all()
            with pytest.raises(hw.Unsolved):
                est.check()
        newest = hw.stream(model, hw.Constrained()).push([0.0, 0.0])
        assert newest.status is hw.Status.INFEASIBLE
        assert "of `bounds`" in newest.info["message"]


def test_a_state_known_for_certain_outside_is_infeasible():
    model = hw.Linear(
        np.eye(2),
        None,
        [[1, 0]],
        hw.Gaussian([1.0, 0.0]),
        hw.Gaussian(1.0),
        hw.Normal([0, 5], [1.0, 0.0]),
        bounds=(0, 1),
    )
    est = hw.estimate(model, hw.Record([1.0], [0.5]), hw.Constrained())
    assert est.status is hw.Status.INFEASIBLE
    assert "`x1`" in est.message


def test_a_stream_is_bounded_saved_and_resumed():
    model, record = walk(WEDGE), seen(20)
    method = hw.Constrained(hw.UnscentedKalman(), by="truncate", feedback=True)
    batch = hw.estimate(model, record, method)
    live = hw.stream(model, method)
    for k, y in enumerate(record.y):
        if k == 9:
            live = hw.resume(live.snapshot(), model)
            assert live.method == method
        newest = live.push(y)
        np.testing.assert_allclose(newest.x[0], batch.x[k], rtol=1e-12)
    box = walk(hw.Box(0, 1))
    newest = hw.stream(box, hw.Constrained()).push([3.0, None])
    assert newest.status is hw.Status.OK
    for end in newest.interval(0.999):
        assert box.bounds.contains(end).all()
    with pytest.raises(hw.Refused, match="no online form"):
        hw.stream(box, hw.Constrained(hw.KalmanSmoother()))


def test_several_records_side_by_side():
    model = walk(WEDGE)
    records = [seen(10, 1), seen(25, 2)]
    for method in (hw.Constrained(), hw.Constrained(feedback=True)):
        for est, record in zip(hw.estimate(model, records, method), records, strict=True):
            np.testing.assert_array_equal(est.x, hw.estimate(model, record, method).x)


def test_what_it_refuses():
    model, record = walk(hw.Box(0, 1)), seen(3)
    with pytest.raises(hw.Refused, match="`Constrained` keeps `bounds` but the model has none"):
        hw.estimate(dataclasses.replace(model, bounds=None), record, hw.Constrained())
    with pytest.raises(hw.Refused, match="keeps `bounds` itself"):
        hw.estimate(model, record, hw.Constrained(hw.ParticleFilter()))
    with pytest.raises(hw.Refused, match="cannot feed back"):
        hw.estimate(model, record, hw.Constrained(hw.KalmanSmoother(), feedback=True))
    with pytest.raises(hw.Refused, match="cannot feed back"):
        hw.estimate(model, record, hw.Constrained(hw.ExtendedKalman(smooth=True), feedback=True))
    with pytest.raises(hw.Refused, match=r"(?s)inside `Constrained`.*needs Gaussian noise"):
        hw.estimate(dataclasses.replace(model, w=hw.Uniform(1.0)), record, hw.Constrained())
    with pytest.raises(hw.Refused, match=r"Constrained\(KalmanFilter\(\)\)"):
        hw.estimate(model, record, hw.KalmanFilter())
    for method in (hw.Constrained(hw.GPB(), feedback=True),):
        with pytest.raises(hw.Refused, match="cannot feed back"):
            hw.estimate(model, record, method)
    with pytest.raises(hw.BadValue, match="`by` is 'clip'"):
        hw.Constrained(by="clip")
    for wrong in (hw.KalmanFilter, "kf", hw.Constrained()):
        with pytest.raises(hw.BadValue, match="`method` is"):
            hw.Constrained(wrong)


def test_half_spaces_are_judged():
    with pytest.raises(hw.BadShape, match="`D` has shape"):
        hw.Halfspaces([1.0, 2.0], 0)
    with pytest.raises(hw.BadShape, match="`lo` has shape"):
        hw.Halfspaces([[1.0, 2.0]], [0, 1])
    for lo, hi in ((2, 1), (inf, inf), (-inf, -inf)):
        with pytest.raises(hw.BadValue, match="row 0 of `D`"):
            hw.Halfspaces([[1.0, 2.0]], lo, hi)
    for D in ([[math.nan, 1]], [[inf, 1]], [["a", "b"]]):
        with pytest.raises(hw.BadValue):
            hw.Halfspaces(D, 0)
    with pytest.raises(hw.BadValue, match="`hi` holds NaN"):
        hw.Halfspaces([[1.0, 2.0]], 0, math.nan)
    with pytest.raises(hw.BadShape, match="2 columns were expected"):
        walk(hw.Halfspaces([[1.0, 2.0, 3.0]], 0))
    assert not WEDGE.D.flags.writeable


def test_methods_that_keep_boxes_only_say_so():
    unknown = hw.Uniform.unknown(at_most=1.0)
    model = hw.Linear(np.eye(2), None, np.eye(2), unknown, unknown, None, bounds=WEDGE)
    for method in (hw.BatchLP(), hw.SequentialLP(), hw.Window()):
        with pytest.raises(hw.Refused, match="`bounds` is `Halfspaces`"):
            hw.estimate(model, seen(3), method)
    particles = hw.ParticleFilter(particles=500)
    est = hw.estimate(walk(WEDGE), seen(5), particles, seed=1)
    assert WEDGE.contains(est.x).all()
    with pytest.raises(hw.Refused, match="cannot keep an equality"):
        hw.estimate(walk(hw.Halfspaces([[1, 1]], 1, 1)), seen(3), particles)


def test_cutting_the_output_does_not_hurt_in_the_box_of_paper_003():
    """States drawn inside the box by rejection, r = 1: all outputs feasible, no worse than the filter, NEES about 1."""
    model, runs = paper003_box(), 6
    errors = {"plain": [], "ep": [], "truncate": []}
    nees = {name: [] for name in errors}
    for seed in range(runs):
        truth, record = drawn_inside(model, 200, seed)
        for name in errors:
            if name == "plain":
                est = hw.estimate(dataclasses.replace(model, bounds=None), record, hw.KalmanFilter())
            else:
                est = hw.estimate(model, record, hw.Constrained(by=name)).check()
                assert model.bounds.contains(est.x).all()
            off = est.x - truth
            errors[name].append(np.mean(off**2))
            nees[name].append(np.mean(np.einsum("ti,tij,tj->t", off, np.linalg.inv(est.P), off)) / 3)
    rmse = {name: math.sqrt(np.mean(v)) for name, v in errors.items()}
    assert rmse["ep"] <= rmse["plain"]
    assert rmse["truncate"] <= rmse["plain"]
    assert 0.85 < np.mean(nees["ep"]) < 1.15


def paper003_box(r=1.0, q=0.25):
    return hw.Linear(
        paper003.A, paper003.B, paper003.C, hw.Gaussian(q**2 / 3), hw.Gaussian(r**2 / 3), hw.Normal(np.zeros(3), 0.1),
        bounds=paper003.BOX,
    )  # fmt: skip


def drawn_inside(model, T, seed):
    """States whose noise is drawn again until they lie in the box; uniform noise, as in the paper."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (T, 1))
    half = [np.sqrt(3 * np.diag(noise.cov().single)) for noise in (model.w, model.e)]
    x, state = np.empty((T, 3)), np.zeros(3)
    for k in range(T):
        while True:
            new = model.A.single @ state + model.B.single @ u[k] + rng.uniform(-half[0], half[0])
            if model.bounds.contains(new):
                break
            if rng.random() < 1e-3:  # an input that leads out is drawn again too
                u[k] = rng.uniform(-1, 1)
        x[k] = state = new
    y = x @ model.C.single.T + rng.uniform(-half[1], half[1], (T, 2))
    return x, hw.Record(np.arange(1.0, T + 1), y, u)
