"""Bad input, one line a case: each a named exception that says what was expected and, where there is one, a hint."""

import numpy as np
import pytest

import halfwidth as hw

I2 = np.eye(2)
C = [[1.0, 0.0]]
G, S = hw.Gaussian(0.1), hw.Gaussian(1.0)
X0 = hw.Normal([0.0, 0.0], 1.0)
THREE = hw.Record([0.0, 1.0, 2.0], [1.0, None, 3.0])


def linear(**changes):
    given = {"A": I2, "B": None, "C": C, "w": G, "e": S, "x0": X0} | changes
    return hw.Linear(**given)


def nonlinear(**changes):
    given = {"g": lambda x: x, "h": lambda x: x[:1], "w": G, "e": S, "x0": X0} | changes
    return hw.Nonlinear(**given)


def one(value, where=0):
    out = np.ones(3)
    out[where] = value
    return out


class Odd:
    """Neither a number nor a noise."""

    def __repr__(self):
        return "Odd()"


CASES = {
    # matrices, one dimension at a time
    "A is a vector": (lambda: linear(A=[1.0, 2.0]), hw.BadShape, "matrix"),
    "A is a scalar": (lambda: linear(A=1.0), hw.BadShape, "np.atleast_2d"),
    "A has more rows": (lambda: linear(A=np.ones((3, 2))), hw.BadShape, "square"),
    "A has more columns": (lambda: linear(A=np.ones((2, 3))), hw.BadShape, "square"),
    "A has four axes": (lambda: linear(A=np.ones((1, 1, 2, 2))), hw.BadShape, "stack"),
    "A is ragged": (lambda: linear(A=[[1.0], [1.0, 2.0]]), hw.BadShape, "ragged"),
    "B has other rows": (lambda: linear(B=np.ones((3, 1))), hw.BadShape, "`B`"),
    "C has other columns": (lambda: linear(C=np.ones((1, 3))), hw.BadShape, "`C`"),
    "E has other size": (lambda: linear(E=np.eye(3)), hw.BadShape, "`E`"),
    "F has other size": (lambda: linear(F=np.eye(2)), hw.BadShape, "`F`"),
    "E is not triangular": (lambda: linear(E=[[1.0, 0.0], [0.5, 1.0]]), hw.BadValue, "unit upper triangular"),
    "F has no unit diagonal": (lambda: linear(F=[[2.0]]), hw.BadValue, "unit upper triangular"),
    "E as a function is not triangular": (
        lambda: linear(E=lambda t: [[1.0, 0.0], [0.5, 1.0]]),
        hw.BadValue,
        "unit upper",
    ),
    "F as a function of dt has no unit diagonal": (lambda: linear(F=lambda dt: [[2.0]]), hw.BadValue, "unit upper"),
    "A holds inf": (lambda: linear(A=[[np.inf, 0], [0, 1]]), hw.BadValue, "inf"),
    "A is complex": (lambda: linear(A=1j * I2), hw.BadValue, "complex"),
    "A is text": (lambda: linear(A=[["a", "b"], ["c", "d"]]), hw.BadValue, "numbers"),
    "A holds objects": (lambda: linear(A=[[Odd(), 0], [0, 1]]), hw.BadValue, "Odd()"),
    "A as a function of too much": (lambda: linear(A=lambda a, b, c: I2), hw.BadValue, "lambda dt"),
    "A as a function of another shape": (lambda: linear(A=lambda dt: np.eye(3), C=C), hw.BadShape, "`C`"),
    # noises
    "w has other size": (lambda: linear(w=hw.Gaussian([1.0, 2.0, 3.0])), hw.BadShape, "`w`"),
    "e has other size": (lambda: linear(e=hw.Uniform([1.0, 2.0])), hw.BadShape, "`e`"),
    "w is a number": (lambda: linear(w=0.1), hw.BadValue, "w=Uniform(q)"),
    "negative half-width": (lambda: hw.Uniform(-1.0), hw.BadValue, "-1"),
    "infinite half-width": (lambda: hw.Uniform(np.inf), hw.BadValue, "inf"),
    "half-width NaN": (lambda: hw.Uniform(np.nan), hw.BadValue, "NaN"),
    "half-widths as a matrix": (lambda: hw.Uniform(I2), hw.BadShape, "scalar or (n,)"),
    "ends crossed": (lambda: hw.Uniform.unknown(2.0, 1.0), hw.BadValue, "exceeds"),
    "negative least": (lambda: hw.Uniform.unknown(-2.0, 1.0), hw.BadValue, "at_least"),
    "negative variance": (lambda: hw.Gaussian([1.0, -1.0]), hw.BadValue, "-1"),
    "covariance NaN": (lambda: hw.Gaussian(np.nan), hw.BadValue, "NaN"),
    "covariance inf": (lambda: hw.Gaussian([[np.inf]]), hw.BadValue, "inf"),
    "covariance asymmetric": (lambda: hw.Gaussian([[1.0, 0.5], [0.2, 1.0]]), hw.BadValue, "symmetric"),
    "covariance indefinite": (lambda: hw.Gaussian([[1.0, 2.0], [2.0, 1.0]]), hw.BadValue, "indefinite"),
    "covariance indefinite in small units": (
        lambda: hw.Gaussian([[1e12, 0, 0], [0, 1e-12, 2e-12], [0, 2e-12, 1e-12]]),
        hw.BadValue,
        "indefinite",
    ),
    "covariance not square": (lambda: hw.Gaussian(np.ones((2, 3))), hw.BadShape, "`Q`"),
    "covariance complex": (lambda: hw.Gaussian([[1j]]), hw.BadValue, "complex"),
    "sum of two uniforms": (lambda: hw.Uniform(1.0) + hw.Uniform(1.0), hw.BadValue, "Uniform(q) + Gaussian(Q)"),
    # priors and bounds
    "x0 absent for a filter": (
        lambda: hw.estimate(linear(x0=None), hw.Record([0.0], [1.0]), hw.KalmanFilter()),
        hw.Refused,
        "x0",
    ),
    "x0 is a vector": (lambda: linear(x0=[0.0, 0.0]), hw.BadValue, "Normal(mean, P)"),
    "x0 has other size": (lambda: linear(x0=hw.Normal([0.0], 1.0)), hw.BadShape, "`x0`"),
    "x0 box of other size": (lambda: linear(x0=hw.Box([0, 0, 0], [1, 1, 1])), hw.BadShape, "`x0`"),
    "P of other size": (lambda: hw.Normal([0.0, 0.0], np.eye(3)), hw.BadShape, "`P`"),
    "P indefinite": (lambda: hw.Normal([0.0, 0.0], [[1.0, 2.0], [2.0, 1.0]]), hw.BadValue, "indefinite"),
    "P negative": (lambda: hw.Normal([0.0], -1.0), hw.BadValue, "-1"),
    "mean NaN": (lambda: hw.Normal([np.nan], 1.0), hw.BadValue, "NaN"),
    "box crossed": (lambda: hw.Box(1.0, 0.0), hw.BadValue, "exceeds"),
    "box NaN": (lambda: hw.Box(np.nan, 0.0), hw.BadValue, "NaN"),
    "box shapes differ": (lambda: hw.Box([0.0, 0.0], [1.0, 1.0, 1.0]), hw.BadShape, "shape"),
    "bounds of other size": (lambda: linear(bounds=([0, 0, 0], [1, 1, 1])), hw.BadShape, "bounds"),
    "bounds is one number": (lambda: linear(bounds=3), hw.BadValue, "Box(lo, hi)"),
    # other parts of a model
    "dt is zero": (lambda: linear(dt=0.0), hw.BadValue, "`dt`"),
    "dt is text": (lambda: linear(dt="1 s"), hw.BadValue, "`dt`"),
    "dt is NaN": (lambda: linear(dt=float("nan")), hw.BadValue, "`dt`"),
    "too few names": (lambda: linear(names=["a"]), hw.BadShape, "names"),
    "names repeated": (lambda: linear(names=["a", "a"]), hw.BadValue, "repeats"),
    "names with odd keys": (lambda: linear(names={"z": ["a"]}), hw.BadValue, "keys"),
    "theta_bounds without theta": (lambda: linear(theta_bounds=([0.0], [1.0])), hw.BadShape, "theta_bounds"),
    "g of another shape": (lambda: nonlinear(g=lambda x: x[:1]), hw.BadShape, "`g`"),
    "g fails": (lambda: nonlinear(g=lambda x: x[7]), hw.BadValue, "IndexError"),
    "g gives NaN": (lambda: nonlinear(g=lambda x: x * np.nan), hw.BadValue, "NaN"),
    "h is complex": (lambda: nonlinear(h=lambda x: x[:1] * 1j), hw.BadValue, "complex"),
    "h gives a matrix": (lambda: nonlinear(h=lambda x: np.outer(x, x)), hw.BadShape, "`h`"),
    "angle out of range": (lambda: nonlinear(x_angles=(5,)), hw.BadValue, "x_angles"),
    "nonlinear x0 absent": (lambda: nonlinear(x0=None), hw.BadValue, "`x0`"),
    # records
    "empty record": (lambda: hw.Record([], []), hw.BadRecord, "empty"),
    "t is a matrix": (lambda: hw.Record(I2, [1.0, 2.0]), hw.BadShape, "`t`"),
    "t NaN": (lambda: hw.Record(one(np.nan), one(1)), hw.BadRecord, "NaN"),
    "t inf": (lambda: hw.Record(one(np.inf), one(1)), hw.BadRecord, "inf"),
    "t backwards": (lambda: hw.Record([0.0, 2.0, 1.0], one(1)), hw.BadRecord, "backwards"),
    "t twice": (lambda: hw.Record([0.0, 1.0, 1.0], one(1)), hw.BadRecord, "Record.merged"),
    "t is text": (lambda: hw.Record(["a", "b", "c"], one(1)), hw.BadRecord, "numbers"),
    "y of other length": (lambda: hw.Record([0.0, 1.0], one(1)), hw.BadShape, "`y`"),
    "y has three axes": (lambda: hw.Record([0.0], np.ones((1, 1, 1))), hw.BadShape, "`y`"),
    "y inf": (lambda: hw.Record([0.0, 1.0, 2.0], one(-np.inf)), hw.BadRecord, "inf"),
    "y complex": (lambda: hw.Record([0.0], [1j]), hw.BadRecord, "complex"),
    "y of objects": (lambda: hw.Record([0.0], [Odd()]), hw.BadRecord, "Odd()"),
    "y of text in objects": (lambda: hw.Record([0.0, 1.0], np.array([1.0, "x"], dtype=object)), hw.BadRecord, "'x'"),
    "u NaN": (lambda: hw.Record([0.0, 1.0, 2.0], one(1), one(np.nan, 1)), hw.BadRecord, "t = 1 s"),
    "u of other length": (lambda: hw.Record([0.0], [1.0], one(1)), hw.BadShape, "`u`"),
    "without a span": (lambda: hw.Record([0.0], [1.0]).without(2.0, 1.0), hw.BadValue, "t0 <= t1"),
    "extended by nothing": (lambda: hw.Record([0.0], [1.0]).extended(0), hw.BadValue, "steps"),
    "extended by a step back": (lambda: hw.Record([0.0], [1.0]).extended(1, dt=-1.0), hw.BadValue, "`dt` is -1.0"),
    "extended by a step of NaN": (lambda: hw.Record([0.0], [1.0]).extended(1, dt=np.nan), hw.BadValue, "`dt` is nan"),
    "extended without inputs": (lambda: hw.Record([0.0], [1.0], [1.0]).extended(1), hw.BadRecord, "u="),
    # the front door
    "model is a matrix": (lambda: hw.estimate(I2, hw.Record([0.0], [1.0])), hw.BadValue, "Linear(...)"),
    "record is an array": (lambda: hw.estimate(linear(), one(1)), hw.BadRecord, "Record(t, y)"),
    "record has other outputs": (
        lambda: hw.estimate(linear(), hw.Record([0.0], [[1.0, 2.0]])),
        hw.BadShape,
        "`model.C` is (1, 2)",
    ),
    "record lacks inputs": (
        lambda: hw.estimate(linear(B=[[1.0], [0.0]]), hw.Record([0.0], [1.0])),
        hw.BadShape,
        "inputs",
    ),
    "record has inputs too many": (
        lambda: hw.estimate(linear(), hw.Record([0.0], [1.0], [1.0])),
        hw.BadShape,
        "inputs",
    ),
    "stack of other length": (
        lambda: hw.estimate(linear(A=np.array([I2, I2])), hw.Record([0.0], [1.0])),
        hw.BadShape,
        "stacked for 2 rows",
    ),
    "method is a class": (
        lambda: hw.estimate(linear(), hw.Record([0.0], [1.0]), hw.KalmanFilter),
        hw.BadValue,
        "KalmanFilter()",
    ),
    "method is text": (lambda: hw.estimate(linear(), hw.Record([0.0], [1.0]), "kalman"), hw.BadValue, "estimator"),
    "uniform noise for a Kalman filter": (
        lambda: hw.estimate(linear(w=hw.Uniform(1.0)), hw.Record([0.0], [1.0]), hw.KalmanFilter()),
        hw.Refused,
        "as_gaussian()",
    ),
    "unknown parameters for a Kalman filter": (
        lambda: hw.estimate(linear(A=[[np.nan, 0], [0, 1]]), hw.Record([0.0], [1.0]), hw.KalmanFilter()),
        hw.Refused,
        "A[0, 0]",
    ),
    "bounds for a Kalman filter": (
        lambda: hw.estimate(linear(bounds=(-1, 1)), hw.Record([0.0], [1.0]), hw.KalmanFilter()),
        hw.Refused,
        "bounds",
    ),
    "unknown half-widths as Gaussian": (
        lambda: linear(w=hw.Uniform.unknown()).as_gaussian(),
        hw.Refused,
        "w=Uniform(q)",
    ),
    "box without ends as Gaussian": (lambda: linear(x0=None).as_gaussian(), hw.Refused, "x0=Normal"),
    "simulate without a length": (lambda: hw.simulate(linear()), hw.BadValue, "T=100"),
    "simulate with a number for inputs": (lambda: hw.simulate(linear(), 100), hw.BadShape, "simulate(model, T=100)"),
    "simulate at a number": (lambda: hw.simulate(linear(), t=3.0), hw.BadShape, "`t` is 3, a row for each time"),
    "a density that is a noise": (lambda: hw.from_continuous(I2, None, C, G, S, X0), hw.BadValue, "spectral density"),
    "no memory to choose": (
        lambda: hw.choose_memory(linear(), THREE, memories=()),
        hw.BadValue,
        "memories=(5, 15, 50)",
    ),
    "a memory for a model that is refused": (lambda: hw.choose_memory(linear(), THREE), hw.Refused, "uniform noise"),
    "simulate unknown entries": (lambda: hw.simulate(linear(A=[[np.nan, 0], [0, 1]]), T=3), hw.BadValue, "unknown"),
    "simulate unknown half-widths": (lambda: hw.simulate(linear(w=hw.Uniform.unknown()), T=3), hw.Refused, "known"),
    "simulate from a box without ends": (lambda: hw.simulate(linear(x0=None), T=3), hw.BadValue, "finite Box"),
    "simulate with inputs of other size": (lambda: hw.simulate(linear(), one(1)), hw.BadShape, "`u`"),
    "score of other rows": (
        lambda: hw.score(hw.estimate(linear(), hw.Record([0.0], [1.0])), np.ones((2, 2))),
        hw.BadShape,
        "`truth`",
    ),
    "score of no row": (
        lambda: hw.score(hw.estimate(linear(), hw.Record([0.0], [1.0])), np.ones((1, 2)), during=(5, 6)),
        hw.BadValue,
        "no row",
    ),
    "score during one time": (
        lambda: hw.score(hw.estimate(linear(), THREE), np.ones((3, 2)), during=5.0),
        hw.BadValue,
        "two times in seconds",
    ),
    "score of no such state": (
        lambda: hw.score(hw.estimate(linear(), THREE), np.ones((3, 2)), states=[2]),
        hw.BadValue,
        "from 0 to 1",
    ),
    "kappa below 0": (lambda: hw.ensemble_interval(hw.estimate(linear(), THREE), -1.0), hw.BadValue, "kappa=1.0"),
    "models without names": (lambda: hw.compare([linear()], THREE), hw.BadValue, "models by name"),
    "a number for a model": (lambda: hw.compare({"a": linear(), "b": 3}, THREE), hw.BadValue, "`models` has 3 under"),
    "half-widths unknown on a stream": (
        lambda: hw.stream(linear(w=hw.Uniform.unknown(), e=hw.Uniform.unknown(), x0=None)),
        hw.Refused,
        "hint: stream(model, Window(Posterior(), memory=25))",
    ),
    "outputs that are not there": (
        lambda: hw.Record([0.0, 1.0], [1.0, 2.0]).without(0, 1, outputs=[3]),
        hw.BadValue,
        "columns from 0 to 0",
    ),
    "a seed below 0": (lambda: hw.simulate(linear(), T=3, seed=-1), hw.BadValue, "`seed` is -1"),
    "a seed that is text": (
        lambda: hw.estimate(linear(), hw.Record([0.0], [1.0]), hw.ParticleFilter(), seed="a"),
        hw.BadValue,
        "`seed` is 'a'",
    ),
    "learn from a number": (lambda: hw.learn(linear(), 5), hw.BadRecord, "holds no Record"),
    "g takes the step second": (
        lambda: hw.Nonlinear(
            lambda x, dt: x * dt, lambda x: x, hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0.0], 1.0)
        ),
        hw.BadValue,
        "lambda x, u, dt",
    ),
    "a function that fails at t": (lambda: linear(A=lambda t: {}[t]), hw.BadValue, "KeyError"),
    "R stacked for other rows": (
        lambda: hw.estimate(linear(e=hw.Gaussian(np.ones((2, 1, 1)))), hw.Record([0.0], [1.0])),
        hw.BadShape,
        "`e.Q` is stacked for 2 rows",
    ),
    "forecast with stacked matrices": (
        lambda: hw.forecast(linear(A=np.array([I2])), hw.Record([0.0], [1.0]), 3),
        hw.BadValue,
        "function of t",
    ),
    "push of text": (lambda: hw.stream(linear(), hw.KalmanFilter()).push("a"), hw.BadRecord, "no number"),
    "push of a complex number": (lambda: hw.stream(linear(), hw.KalmanFilter()).push(1j), hw.BadRecord, "no number"),
    "a step that is text": (
        lambda: hw.stream(linear(), hw.KalmanFilter()).push(1.0, dt="x"),
        hw.BadRecord,
        "no number",
    ),
    "resume of something else": (lambda: hw.resume(b"HWSTREAM" + bytes(40)), hw.BadValue, "snapshot"),
    "level out of range": (
        lambda: hw.estimate(linear(), hw.Record([0.0], [1.0])).interval(90),
        hw.BadValue,
        "level=0.9",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_bad_input_is_named(name):
    call, kind, words = CASES[name]
    with pytest.raises(hw.HalfwidthError) as caught:
        call()
    assert type(caught.value) is kind
    assert words in str(caught.value)
    assert not caught.value.message.endswith(".")


def test_errors_are_ordinary_exceptions_too():
    assert issubclass(hw.BadShape, ValueError)
    assert issubclass(hw.Refused, TypeError)
    assert issubclass(hw.Missing, ImportError)
    assert issubclass(hw.Unsolved, RuntimeError)


def test_an_error_survives_pickling():
    import pickle

    error = pickle.loads(pickle.dumps(hw.BadShape("`A` has shape (3,)", hint="np.atleast_2d(A)")))
    assert type(error) is hw.BadShape
    assert error.hint == "np.atleast_2d(A)"
    assert str(error).endswith("hint: np.atleast_2d(A)")
