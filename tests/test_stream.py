"""stream, push, snapshot and resume."""

import dataclasses
import json
from typing import NamedTuple

import numpy as np
import pytest
from tests import naive
from tests.cases import constant_velocity, oscillator

import halfwidth as hw


def walk(**more):
    return hw.Linear([[1.0]], None, [[1.0]], hw.Gaussian(0.1), hw.Gaussian(1.0), hw.Normal([0.0], 1.0), **more)


def drive(model, T=40, seed=0):
    u = None if model.nu == 0 else np.random.default_rng(seed).normal(size=(T, model.nu))
    _, record = hw.simulate(model, u, T=T, seed=seed)
    y = record.y.copy()
    y[np.random.default_rng(seed + 1).random(y.shape) < 0.3] = np.nan
    return hw.Record(record.t, y, record.u)


DRIVEN = oscillator(hw.Gaussian([0.1, 0.2, 0.1]), hw.Gaussian([0.3, 0.4]), hw.Normal(np.zeros(3), 1.0))


@pytest.mark.parametrize("model", [constant_velocity(), DRIVEN, walk()], ids=["cv", "driven", "walk"])
@pytest.mark.parametrize("lag", [0, 1, 5])
def test_push_equals_the_batch(model, lag):
    record = drive(model)
    method = hw.KalmanSmoother(lag=lag) if lag else hw.KalmanFilter()
    batch = hw.estimate(model, record, method)
    live = hw.stream(model, method, t=record.t[0] - model.dt)
    for k, y in enumerate(record.y):
        newest = live.push(y, None if record.u is None else record.u[k])
        if k >= lag:
            np.testing.assert_allclose(newest.x[0], batch.x[k - lag], rtol=1e-12, atol=1e-13)
            np.testing.assert_allclose(newest.P[0], batch.P[k - lag], rtol=1e-10, atol=1e-13)
            assert newest.t[0] == pytest.approx(record.t[k - lag])
    assert newest.loglik == pytest.approx(batch.loglik, rel=1e-12)
    assert live.rows == 40


def test_the_newest_estimate_is_an_estimate():
    live = hw.stream(constant_velocity(), hw.KalmanFilter())
    newest = live.push([0.1, None])
    assert isinstance(newest, hw.Estimate)
    assert newest.x.shape == (1, 4)
    assert newest.P.shape == (1, 4, 4)
    assert newest.status is hw.Status.OK
    assert newest.method == "KalmanFilter()"
    assert newest.names == ("x0", "x1", "x2", "x3")
    assert not newest.guaranteed
    assert "90 %" in newest.summary()
    lo, hi = newest.interval(0.9)
    assert (lo < newest.x).all()
    assert (newest.x < hi).all()
    assert newest.check() is newest
    first = newest.x.copy()
    live.push([5.0, 5.0])
    np.testing.assert_array_equal(newest.x, first)  # a value, not a window on the stream
    with pytest.raises(AttributeError):
        newest.x = 0


@pytest.mark.parametrize(
    "row",
    [
        [1.0, 2.0],
        (1.0, 2.0),
        (1, 2),
        np.array([1.0, 2.0]),
        np.array([1, 2]),
        np.array([1.0, 2.0], dtype=np.float32),
        np.array([[1.0, 9.0], [2.0, 9.0]])[:, 0],
        [np.float64(1.0), 2],
        np.ma.masked_array([1.0, 2.0]),
        memoryview(np.array([1.0, 2.0])),
        range(1, 3),
    ],
    ids=lambda row: type(row).__name__,
)
def test_rows_of_any_kind(row):
    want = hw.stream(constant_velocity(), hw.KalmanFilter()).push([1.0, 2.0]).x
    np.testing.assert_array_equal(hw.stream(constant_velocity(), hw.KalmanFilter()).push(row).x, want)


@pytest.mark.parametrize("value", [1.5, np.float64(1.5), [1.5], np.array(1.5), np.array([1.5]), np.array([[1.5]])])
def test_one_output_may_be_a_number(value):
    want = hw.stream(walk(), hw.KalmanFilter()).push(1.5).x
    np.testing.assert_array_equal(hw.stream(walk(), hw.KalmanFilter()).push(value).x, want)


@pytest.mark.parametrize("missing", [None, [None, None], [np.nan, None], np.full(2, np.nan)], ids=repr)
def test_missing_rows(missing):
    live = hw.stream(constant_velocity(), hw.KalmanFilter())
    newest = live.push(missing)
    np.testing.assert_array_equal(newest.x, np.zeros((1, 4)))
    assert newest.loglik == 0.0


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (([1.0],), hw.BadRecord),
        (([1.0, 2.0, 3.0],), hw.BadRecord),
        ((np.zeros(3),), hw.BadRecord),
        ((1.0,), hw.BadRecord),
        (([1.0, np.inf],), hw.BadRecord),
        (([1.0, "a"],), hw.BadRecord),
        (([1.0, 2j],), hw.BadRecord),
        (([1.0, 2.0], [1.0]), hw.BadRecord),
        (([1.0, 2.0], None, 0.0), hw.BadRecord),
        (([1.0, 2.0], None, -1.0), hw.BadRecord),
        (([1.0, 2.0], None, np.nan), hw.BadRecord),
        ((), TypeError),
        (([1.0, 2.0], None, 1.0, 1.0), TypeError),
    ],
    ids=str,
)
def test_bad_rows_are_named_and_change_nothing(arguments, error):
    live = hw.stream(constant_velocity(), hw.KalmanFilter())
    live.push([1.0, 2.0])
    before = live.snapshot()
    with pytest.raises(error):
        live.push(*arguments)
    assert live.snapshot() == before


def test_bad_keywords_and_inputs():
    live = hw.stream(DRIVEN, hw.KalmanFilter())
    with pytest.raises(TypeError, match="no argument"):
        live.push([1.0, 2.0], v=1)
    with pytest.raises(TypeError, match="two values"):
        live.push([1.0, 2.0], y=1)
    with pytest.raises(hw.BadRecord, match="`u` is missing"):
        live.push([1.0, 2.0])
    with pytest.raises(hw.BadRecord, match="not finite"):
        live.push([1.0, 2.0], [np.nan])
    assert live.push(y=[1.0, 2.0], u=1.0, dt=0.5).t[0] == 0.5


@pytest.mark.parametrize("lag", [0, 3])
def test_resume_goes_on_with_the_same_bytes(lag):
    method = hw.KalmanSmoother(lag=lag) if lag else hw.KalmanFilter()
    record = drive(DRIVEN)
    live = hw.stream(DRIVEN, method)
    for y, u in zip(record.y[:25], record.u[:25], strict=True):
        live.push(y, u)
    saved = live.snapshot()
    again = hw.resume(saved)
    assert again.snapshot() == saved
    for y, u in zip(record.y[25:], record.u[25:], strict=True):
        a, b = live.push(y, u), again.push(y, u)
        np.testing.assert_array_equal(a.x, b.x)
        np.testing.assert_array_equal(a.P, b.P)
        assert a.loglik == b.loglik


def test_a_varying_model_is_given_to_resume():
    model = constant_velocity(None)
    steps = [0.1, 0.2, 0.1, 0.5]
    live = hw.stream(model, hw.KalmanFilter())
    for dt in steps:
        live.push([1.0, 2.0], dt=dt)
    saved = live.snapshot()
    with pytest.raises(hw.BadValue, match="model"):
        hw.resume(saved)
    again = hw.resume(saved, model)
    np.testing.assert_array_equal(again.push(None, dt=0.3).x, live.push(None, dt=0.3).x)
    other = dataclasses.replace(model, dt=0.1)
    batch = hw.estimate(other, hw.Record(np.cumsum(steps), np.tile([1.0, 2.0], (4, 1))), hw.KalmanFilter())
    np.testing.assert_allclose(batch.x[-1], hw.resume(saved, other).push(None, dt=1e-9).x[0], atol=1e-6)


def test_matrices_of_each_row():
    C = [[[1.0 + k]] for k in range(3)]
    model = hw.Linear([[1.0]], None, C, hw.Gaussian(0.1), hw.Gaussian(1.0), hw.Normal([0.0], 1.0))
    record = hw.Record([1.0, 2.0, 3.0], [1.0, 2.0, 3.0])
    batch = hw.estimate(model, record, hw.KalmanFilter())
    live = hw.stream(model, hw.KalmanFilter())
    for k in range(3):
        np.testing.assert_allclose(live.push(record.y[k]).x[0], batch.x[k], rtol=1e-14)
    with pytest.raises(hw.BadRecord, match="row 3"):
        live.push(1.0)
    of_t = dataclasses.replace(model, C=lambda t: [[t]])
    live = hw.stream(of_t, hw.KalmanFilter())
    np.testing.assert_allclose([live.push(y).x[0, 0] for y in record.y], batch.x[:, 0], rtol=1e-14)


def test_a_failing_matrix_function_is_heard():
    def A(dt):
        if dt > 2:
            raise ZeroDivisionError("no such step")
        return [[1.0]]

    live = hw.stream(dataclasses.replace(walk(), A=A), hw.KalmanFilter())
    live.push(1.0, dt=1.5)
    with pytest.raises(hw.BadValue, match="no such step"):
        live.push(1.0, dt=3.0)
    assert live.push(1.0, dt=1.5).status is hw.Status.OK


def test_overflow_is_a_status_and_the_belief_stays_finite():
    live = hw.stream(dataclasses.replace(walk(), A=[[1e120]]), hw.KalmanFilter())
    for _ in range(5):
        newest = live.push(None)
        assert np.isfinite(newest.x).all()
    assert newest.status is hw.Status.COLLAPSED


@pytest.mark.parametrize("place", [0, 9, 30, -20, -1])
def test_damaged_bytes_are_told(place):
    saved = bytearray(hw.stream(walk(), hw.KalmanFilter()).snapshot())
    saved[place] ^= 0x55
    with pytest.raises(hw.BadValue, match="`snapshot`"):
        hw.resume(bytes(saved))


@pytest.mark.parametrize("data", [b"", b"HWSTREAM", b"x" * 100, "text", None])
def test_other_bytes_are_told(data):
    with pytest.raises(hw.BadValue, match="`snapshot`"):
        hw.resume(data)


def test_a_model_of_another_size_is_told():
    saved = hw.stream(walk(), hw.KalmanFilter()).snapshot()
    with pytest.raises(hw.BadValue, match="nx, ny, nu"):
        hw.resume(saved, constant_velocity())


def test_what_cannot_run_on_a_stream():
    with pytest.raises(hw.BadValue, match="needs all outputs"):
        hw.stream(walk(), hw.KalmanSmoother())
    with pytest.raises(hw.Refused, match="Uniform"):
        hw.stream(dataclasses.replace(walk(), w=hw.Uniform(1.0)), hw.KalmanFilter())
    with pytest.raises(hw.Refused, match="no default method"):
        hw.stream(dataclasses.replace(walk(), w=hw.Uniform.unknown()))
    with pytest.raises(hw.BadValue, match="`t`"):
        hw.stream(walk(), t=np.inf)


def test_snapshot_holds_plain_data():
    saved = hw.stream(DRIVEN, hw.KalmanSmoother(lag=2)).snapshot()
    size = int.from_bytes(saved[12:20], "little")
    head = json.loads(saved[20 : 20 + size])
    assert head["method"] == ["KalmanSmoother", {"lag": 2}]
    assert head["sizes"] == [3, 2, 1]


class Belief(NamedTuple):
    x: np.ndarray
    P: np.ndarray
    loglik: float
    rows: int


@dataclasses.dataclass(frozen=True)
class Stepwise:
    """The filter as a recursive method in Python."""

    def refuses(self, model):
        return None

    def run(self, model, record, *, seed=None):
        from halfwidth.methods._protocol import scan

        return scan(self, model, record)

    def init(self, model):
        return Belief(model.x0.mean, model.x0.P, 0.0, 0)

    def step(self, model, state, y, u, t, dt):
        A, C = model.A.single, model.C.single
        s = ~np.isnan(y)
        args = A, None, C, model.w.cov().single, model.e.cov().single, y[None], s[None], state.x, state.P
        x, P, _, _, ll = naive.kf(*args)
        return Belief(x[0], P[0], state.loglik + float(ll[0]), state.rows + 1)

    def belief(self, model, state):
        return state.x, state.P, state.loglik


def test_any_recursive_method_runs_and_resumes(monkeypatch):
    from halfwidth import methods

    load = methods.load
    monkeypatch.setitem(methods.ESTIMATORS, "Stepwise", "nowhere")
    monkeypatch.setattr(methods, "load", lambda name: Stepwise if name == "Stepwise" else load(name))
    model = constant_velocity()
    record = drive(model)
    want = hw.estimate(model, record, hw.KalmanFilter())
    assert hw.estimate(model, record, Stepwise()).loglik == pytest.approx(want.loglik)
    live = hw.stream(model, Stepwise())
    for k, y in enumerate(record.y):
        if k == 20:
            live = hw.resume(live.snapshot())
        newest = live.push(y)
        np.testing.assert_allclose(newest.x[0], want.x[k], rtol=1e-9, atol=1e-12)
    assert newest.loglik == pytest.approx(want.loglik)
    assert newest.method == "Stepwise()"
    assert live.rows == 40
    for bad in ([1.0], [np.inf, 0.0]):
        with pytest.raises(hw.BadRecord):
            live.push(bad)
    with pytest.raises(hw.BadRecord, match="`dt`"):
        live.push(None, dt=-1.0)


def test_the_newest_estimate_can_be_copied_and_sent():
    import copy
    import pickle

    walk = hw.Linear([[1]], None, [[1]], hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0.0], 1.0))
    newest = hw.stream(walk, hw.KalmanFilter()).push(1.0)
    for twin in (copy.deepcopy(newest), pickle.loads(pickle.dumps(newest))):
        np.testing.assert_array_equal(twin.x, newest.x)
        np.testing.assert_array_equal(twin.P, newest.P)
        assert (twin.status, twin.loglik, twin.method, twin.names) == (
            newest.status, newest.loglik, newest.method, newest.names)  # fmt: skip
