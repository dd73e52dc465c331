"""Seeded cases shared by all tests: models × gaps × noises, and every exported estimator."""

import dataclasses
from dataclasses import dataclass

import numpy as np

import halfwidth as hw
from halfwidth.methods import ESTIMATORS, load


@dataclass(frozen=True)
class Case:
    """A model with a record drawn from it."""

    name: str
    model: object
    truth: object
    record: hw.Record

    def __repr__(self):
        return self.name


def constant_velocity(dt=0.1, *, w=None, e=None, x0=None, correlated=True):
    """Two axes of position and velocity with correlated output noise, as functions of dt where dt is None."""

    def A(dt):
        return np.kron(np.eye(2), [[1.0, dt], [0.0, 1.0]])

    def Q(dt):
        return np.kron(np.eye(2), 0.5 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])) + 1e-6 * np.eye(4)

    C = np.kron(np.eye(2), [[1.0, 0.0]])
    R = np.array([[0.5, 0.2], [0.2, 0.8]]) if correlated else np.diag([0.5, 0.8])
    if dt is None:
        return hw.Linear(A, None, C, w or hw.Gaussian(Q), e or hw.Gaussian(R), x0 or hw.Normal(np.zeros(4), 4.0))
    return hw.Linear(
        A(dt), None, C, w or hw.Gaussian(Q(dt)), e or hw.Gaussian(R), x0 or hw.Normal(np.zeros(4), 4.0), dt=dt
    )


def oscillator(w, e, x0, **more):
    """A damped oscillator with an input, seen through a mixing C; E and F make entries correlated."""
    return hw.Linear(
        [[0.9, 0.2, 0.0], [-0.2, 0.85, 0.1], [0.0, 0.0, 0.7]],
        [[0.0], [1.0], [0.5]],
        [[1.0, 0.0, 0.3], [0.0, 1.0, 0.0]],
        w,
        e,
        x0,
        E=[[1.0, 0.2, -0.1], [0.0, 1.0, 0.3], [0.0, 0.0, 1.0]],
        F=[[1.0, -0.4], [0.0, 1.0]],
        **more,
    )


def holes(record, seed, share=0.3, outage=None):
    """Lose entries at random, and one outage whole."""
    rng = np.random.default_rng(seed)
    y = record.y.copy()
    y[rng.random(y.shape) < share] = np.nan
    record = hw.Record(record.t, y, record.u)
    return record if outage is None else record.without(*outage)


def _cases():
    found = []

    def add(name, model, *, T=60, u=None, seed=0, share=0.3, outage=None, t=None):
        truth, record = hw.simulate(model, u, T=T, t=t, seed=seed)
        found.append(Case(name, model, truth, holes(record, seed + 1, share, outage)))

    rng = np.random.default_rng(7)
    u = rng.standard_normal((60, 1))
    ball = hw.Normal(np.zeros(3), 1.0)
    box = hw.Box(-np.ones(3), np.ones(3))
    add("cv", constant_velocity(), outage=(2.0, 3.0))
    steps = np.cumsum(rng.uniform(0.05, 0.4, 60))
    add("cv irregular", constant_velocity(None), t=steps, T=None)
    add("oscillator", oscillator(hw.Gaussian([0.1, 0.2, 0.1]), hw.Gaussian([0.3, 0.4]), ball), u=u, outage=(20, 30))
    add(
        "oscillator uniform", oscillator(hw.Uniform([0.1, 0.2, 0.1]), hw.Uniform([0.6, 0.8]), box), u=u, outage=(20, 26)
    )
    add("oscillator mixed", oscillator(hw.Gaussian(0.05), hw.Uniform(0.3) + hw.Gaussian(0.1), ball), u=u)
    unknown = oscillator(hw.Uniform([0.1, 0.2, 0.1]), hw.Uniform([0.6, 0.8]), box)
    truth, record = hw.simulate(unknown, u, seed=5)
    model = dataclasses.replace(unknown, w=hw.Uniform.unknown(at_most=5.0), e=hw.Uniform.unknown(at_most=5.0))
    found.append(Case("oscillator unknown", model, truth, holes(record, 6, 0.2)))
    truth, record = hw.simulate(oscillator(hw.Gaussian([0.1, 0.2, 0.1]), hw.Gaussian([0.3, 0.4]), ball), u, seed=8)
    unknown = hw.Gaussian.unknown(at_most=25.0)
    found.append(Case("oscillator unknown variances", oscillator(unknown, unknown, ball), truth, holes(record, 9, 0.2)))
    bounded = dataclasses.replace(
        oscillator(hw.Gaussian([0.1, 0.2, 0.1]), hw.Gaussian([0.3, 0.4]), ball),
        bounds=hw.Box([-2.7, -2.7, -2.1], [0.6, 3.2, np.inf]),
    )
    add("oscillator in a box", bounded, u=u, outage=(20, 30))
    # x0 + x2 between two numbers, x1 from below, and an equality
    rows = hw.Halfspaces([[1, 0, 1], [0, 1, 0], [1, -1, 0.5]], [-2, -1, 0.2], [1, np.inf, 0.2])
    add("oscillator on a plane", dataclasses.replace(bounded, bounds=rows), u=u)
    walk = hw.Linear([[1.0]], None, [[1.0]], hw.Gaussian(0.1), hw.Gaussian(1.0), hw.Normal([0.0], 1.0))
    add("walk", walk, T=40)
    turn = hw.Nonlinear(
        lambda x, u, dt: np.array(
            [x[0] + dt * x[2] * np.cos(x[3]), x[1] + dt * x[2] * np.sin(x[3]), x[2] + dt * u[0], x[3] + dt * u[1]]
        ),
        lambda x: x[:2],
        hw.Gaussian([1e-4, 1e-4, 1e-2, 1e-3]),
        hw.Gaussian([[0.2, 0.05], [0.05, 0.2]]),
        hw.Normal([0.0, 0.0, 5.0, 0.3], [0.1, 0.1, 0.1, 0.01]),
        nu=2,
        dt=0.2,
    )
    add("turn", turn, u=np.c_[np.sin(np.arange(60) / 9), 0.4 * np.cos(np.arange(60) / 15)], outage=(4.0, 6.0))
    return found


CASES = _cases()


def _settings():
    """Every exported estimator with its defaults, and the variants that a family adds."""
    variants = {
        "GPB": [{"depth": 3, "smooth": True}],
        "BKF1": [{"smooth": True}],
        "KalmanSmoother": [{"lag": 4}],
        "ExtendedKalman": [{"smooth": True}],
        "UnscentedKalman": [{"smooth": True}],
        "Hull": [{"memory": 10}, {"memory": 5, "lag": 4}, {"lag": 0}],
        "Constrained": [
            {"by": "truncate", "feedback": True},
            {"by": "project", "method": hw.KalmanSmoother()},
            {"by": "nearest", "method": hw.GPB()},
            {"method": hw.UnscentedKalman(), "feedback": True},
        ],
        "MixedFilter": [{"form": "ellipsoid", "gain": "set"}, {"form": "zonotope", "lag": 4}],
    }
    quick = {"MixedWindow": {"memory": 2}}  # a small window: each row of a record with holes is a design of its own
    found = []
    for name in ESTIMATORS:
        found.append(load(name)(**quick.get(name, {})))
        found += [load(name)(**extra) for extra in variants.get(name, [])]
    return found


METHODS = _settings()

#: Every exported estimator on every case that it does not refuse.
PAIRS = [(m, c) for m in METHODS for c in CASES if m.refuses(c.model) is None]
IDS = [f"{m!r} on {c.name}" for m, c in PAIRS]


def stochastic(method):
    """Whether a method draws random numbers."""
    return any(f.name in ("particles", "sweeps") for f in dataclasses.fields(method))


def point_only(method):
    """Whether a method gives a point without a spread."""
    return type(method).__name__ in ("BatchLP", "SequentialLP", "Window")


def weighs(method):
    """Whether a method weighs the states up against each other at each row: one may widen while the others narrow."""
    return type(method).__name__ in ("MixedFilter", "MixedWindow")
