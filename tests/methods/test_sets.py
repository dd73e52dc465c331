"""What is particular to the set recursions: they contain, in floating point, and name what contradicts."""

import dataclasses
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.cases import CASES, METHODS

import halfwidth as hw

SETS = [m for m in METHODS if type(m).__module__ == "halfwidth.methods.sets"]
EVERY = pytest.mark.parametrize("method", SETS, ids=repr)
OSCILLATOR = next(c for c in CASES if c.name == "oscillator uniform")


def walk(q=0.1, r=0.5, x0=None):
    return hw.Linear([[1.0]], None, [[1.0]], hw.Uniform(q), hw.Uniform(r), x0 or hw.Box(-1, 1))


def cornered(model, T, seed, lost=0.3, u=None):
    """A trajectory whose noise stands in the corners of its boxes, and its record with entries missing."""
    rng = np.random.default_rng(seed)
    E = np.eye(model.nx) if model.E is None else model.E.single
    F = np.eye(model.ny) if model.F is None else model.F.single
    x = rng.uniform(model.x0.lo, model.x0.hi)
    states, outputs = np.empty((T, model.nx)), np.empty((T, model.ny))
    for k in range(T):
        shift = 0.0 if u is None else model.B.single @ u[k]
        w, e = rng.choice([-1.0, 1.0], model.nx) * model.w.q, rng.choice([-1.0, 1.0], model.ny) * model.e.q
        # a hair inside, since this sum is rounded too
        x = np.linalg.solve(E, model.A.single @ x + shift + (1 - 1e-12) * w)
        states[k], outputs[k] = x, np.linalg.solve(F, model.C.single @ x + (1 - 1e-12) * e)
    outputs[rng.random(outputs.shape) < lost] = np.nan
    return states, hw.Record(np.arange(T) + 1.0, outputs, u)


def contains(est, truth):
    lo, hi = est.check().interval()
    return bool(np.all((lo <= truth) & (truth <= hi)))


@EVERY
def test_noise_in_the_corners_with_entries_missing(method):
    u = np.random.default_rng(0).normal(size=(400, 1))
    for seed in range(3):
        truth, record = cornered(OSCILLATOR.model, 400, seed, u=u)
        assert contains(hw.estimate(OSCILLATOR.model, record, method), truth)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    nx=st.integers(1, 5),
    ny=st.integers(1, 3),
    unit=st.sampled_from([1e-12, 1.0, 1e12]),
    share=st.sampled_from([0.0, 0.3, 0.9]),
    quiet=st.sampled_from(["neither", "w", "e", "both"]),
)
def test_drawn_models_of_all_scales(seed, nx, ny, unit, share, quiet):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(nx, nx))
    A *= rng.uniform(0.2, 1.1) / max(np.abs(np.linalg.eigvals(A)).max(), 1e-3)
    E = np.eye(nx) + (seed % 2) * np.triu(rng.normal(size=(nx, nx)), 1)
    A = E @ A  # so that E^-1 A is what grows or decays
    scale = unit * 10.0 ** rng.uniform(-2, 2, nx)  # units differ from state to state
    q = np.where(quiet in ("w", "both"), 0.0, scale * rng.uniform(0, 1, nx))
    C = rng.normal(size=(ny, nx)) / scale
    r = np.where(quiet in ("e", "both"), 0.0, rng.uniform(0, 1, ny))
    model = hw.Linear(
        scale[:, None] * A / scale, None, C, hw.Uniform(q), hw.Uniform(r), hw.Box(-scale, scale),
        E=scale[:, None] * E / scale if seed % 2 else None,
    )  # fmt: skip
    # without output noise the simulated outputs themselves are rounded, so a hair is declared
    hair = 1e-12 * (np.abs(C) @ scale + 1.0) * (1e3 if quiet in ("e", "both") else 1.0)
    declared = dataclasses.replace(model, w=hw.Uniform(q + 1e-11 * scale), e=hw.Uniform(r + hair))
    truth, record = cornered(model, 25, seed, share)
    for method in SETS:
        assert contains(hw.estimate(declared, record, method), truth), method


@pytest.mark.parametrize("seed", [26, 421, 1345])
def test_noise_in_the_corners_that_leaves_hardly_any_room(seed):
    """Outputs in their corners pin the state down to 1e-11: programs of such sets end early, and must still contain."""
    rng = np.random.default_rng(seed)
    for nx, ny in ((1, 2), (2, 2), (2, 3), (3, 3)):
        A = rng.normal(size=(nx, nx))
        A *= rng.uniform(0.2, 1.1) / max(np.abs(np.linalg.eigvals(A)).max(), 1e-3)
        q, r = rng.uniform(0, 1, nx), rng.uniform(0, 1, ny)
        model = hw.Linear(A, None, rng.normal(size=(ny, nx)), hw.Uniform(q), hw.Uniform(r), hw.Box(-1, 1))
        model = dataclasses.replace(model, x0=hw.Box(-np.ones(nx), np.ones(nx)))
        truth, record = cornered(model, 60, seed, lost=0.0)
        for method in (*SETS, hw.ConstrainedZonotopeFilter(order=40, constraints=40)):
            assert contains(hw.estimate(model, record, method), truth), (method, nx, ny)


@EVERY
def test_exact_trajectories_are_inside_in_rational_arithmetic(method):
    """Noise that floats hold exactly, states as fractions: no rounding of a box may cut the exact state away."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        n = 1 + seed % 3
        A, C = rng.normal(size=(n, n)) * 0.7, rng.normal(size=(2, n))
        q, r = rng.uniform(0, 1e-3, n) * (seed % 2), rng.uniform(0.1, 0.2, 2)
        start = rng.uniform(-1, 1, n)
        model = hw.Linear(A, None, C, hw.Uniform(q), hw.Uniform(r), hw.Box(start, start))
        exact = [Fraction(v) for v in start]
        outputs, states = [], []
        for _ in range(12):
            w = [Fraction(float(v)) for v in q * rng.choice([-1.0, 0.0, 1.0], n)]
            exact = [sum((Fraction(A[i, j]) * exact[j] for j in range(n)), Fraction(0)) + w[i] for i in range(n)]
            clean = [sum((Fraction(C[i, j]) * exact[j] for j in range(n)), Fraction(0)) for i in range(2)]
            y = [float(c) + rng.choice([-1.0, 1.0]) * float(r[i]) for i, c in enumerate(clean)]
            y = [
                v if abs(Fraction(v) - c) <= Fraction(r[i]) else float(c)
                for i, (v, c) in enumerate(zip(y, clean, strict=True))
            ]
            outputs.append(y)
            states.append(exact)
        lo, hi = hw.estimate(model, hw.Record(range(12), outputs), method).check().interval()
        for k, state in enumerate(states):
            for j, v in enumerate(state):
                assert Fraction(lo[k, j]) <= v <= Fraction(hi[k, j]), (seed, k, j)


@EVERY
def test_a_contradiction_names_its_row_time_and_output(method):
    y = np.zeros((6, 1))
    y[3] = 5.0
    est = hw.estimate(walk(), hw.Record(10.0 + np.arange(6), y), method)
    assert est.status is hw.Status.INFEASIBLE
    assert est.spread is None
    assert est.info["conflict"] == [{"t": 13.0, "row": 3, "kind": "output", "name": "y0"}]
    assert "at t = 13 s: output `y0` contradicts" in est.message
    assert np.isfinite(est.x).all()
    with pytest.raises(hw.Unsolved, match="t = 13 s"):
        est.check()


@EVERY
def test_a_contradiction_with_the_bounds_of_the_state(method):
    model = dataclasses.replace(walk(), bounds=hw.Box(-2, 2))
    assert hw.estimate(model, hw.Record([0.0], [3.0]), method).status is hw.Status.INFEASIBLE
    lo, hi = hw.estimate(model, hw.Record(range(40), np.full(40, np.nan)), method).check().interval()
    assert np.all(lo >= -2)
    assert np.all(hi <= 2)


@EVERY
def test_a_stream_says_where_it_broke_and_resumes(method):
    live = hw.stream(walk(), method)
    assert live.push(0.0).status is hw.Status.OK
    bad = live.push(9.0)
    assert bad.status is hw.Status.INFEASIBLE
    assert "at t = 2 s" in bad.message
    live = hw.resume(live.snapshot(), walk())
    later = live.push(0.0)
    assert later.status is hw.Status.INFEASIBLE
    assert "at row 1" in later.message


@EVERY
def test_a_prior_without_ends(method):
    model = hw.Linear([[1.0, 1.0], [0.0, 1.0]], None, [[1.0, 0.0]], hw.Uniform(0.1), hw.Uniform(0.5), None)
    est = hw.estimate(model, hw.Record(range(5), [0.0, 1.0, np.nan, 3.0, 4.0]), method).check()
    lo, hi = est.interval()
    assert np.isinf(lo[0, 1])
    assert np.isfinite(lo[2:]).all()
    assert np.isfinite(est.x).all()
    assert lo[-1, 1] <= 1.0 <= hi[-1, 1]


@EVERY
def test_one_row_and_an_outage_from_the_start(method):
    lo, hi = hw.estimate(walk(), hw.Record([0.0], [0.9]), method).check().interval()
    np.testing.assert_allclose(np.r_[lo[0], hi[0]], [0.4, 1.1], rtol=1e-12)
    lo, hi = hw.estimate(walk(), hw.Record(range(50), np.full(50, np.nan)), method).check().interval()
    np.testing.assert_allclose(hi[:, 0], 1.0 + 0.1 * np.arange(1, 51), rtol=1e-12)
    np.testing.assert_allclose(lo, -hi, rtol=1e-12)


@EVERY
def test_zero_half_widths_give_the_solution_of_the_equations(method):
    model = hw.Linear([[0.5, 0.2], [0.1, 0.9]], None, [[1.0, 1.0]], hw.Uniform(0.0), hw.Uniform(0.0), hw.Box(-1, 1))
    x, y, truth = np.array([0.25, -0.5]), [], []
    for _ in range(6):
        x = model.A.single @ x
        truth.append(x)
        y.append(x.sum())
    declared = dataclasses.replace(model, e=hw.Uniform(1e-15))  # the sums above are rounded
    lo, hi = hw.estimate(declared, hw.Record(range(6), y), method).check().interval()
    assert np.all((lo <= truth) & (truth <= hi))
    if not isinstance(method, hw.IntervalFilter):
        # multipliers of a few rounds are good to 1e-4; what they leave goes when the first strips are folded in
        assert np.all(hi[1:] - lo[1:] < 1e-3)
        assert np.all(hi[3:] - lo[3:] < 1e-6)


@EVERY
def test_matrices_that_vary_with_the_step_or_are_stacked(method):
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.05, 0.3, 30))

    def A(dt):
        return [[1.0, dt], [0.0, 1.0]]

    q, r = hw.Uniform([0.01, 0.1]), hw.Uniform(0.3)
    model = hw.Linear(A, None, [[1.0, 0.0]], q, r, hw.Box(-1, 1), dt=0.1)
    truth, record = hw.simulate(model, T=None, t=t, seed=1)
    one = hw.estimate(model, record, method)
    assert contains(one, truth.x)
    stack = np.array([A(dt) for dt in record.steps(0.1)])
    two = hw.estimate(dataclasses.replace(model, A=stack), record, method)
    np.testing.assert_array_equal(one.interval()[0], two.interval()[0])
    live = hw.stream(dataclasses.replace(model, A=stack), method)
    for k, dt in enumerate(record.steps(0.1)):
        newest = live.push(record.y[k], dt=dt)
    np.testing.assert_allclose(newest.interval()[0][0], one.interval()[0][-1], rtol=1e-12)


@EVERY
def test_unknown_entries_within_bounds_are_intervals(method):
    rng = np.random.default_rng(0)
    q, r, x0 = hw.Uniform(0.05), hw.Uniform(0.2), hw.Box([-1, -1], [1, 1])
    model = hw.Linear(
        [[0.9, np.nan], [-0.3, 0.7]], None, [[np.nan, 0.5]], q, r, x0, theta_bounds=([0.1, 0.8], [0.3, 1.2])
    )
    for theta in ((0.1, 0.8), (0.3, 1.2), (0.2, 1.0)):
        real = hw.Linear([[0.9, theta[0]], [-0.3, 0.7]], None, [[theta[1], 0.5]], q, r, x0)
        truth, record = cornered(real, 60, int(rng.integers(1000)))
        wide = hw.estimate(model, record, method)
        assert contains(wide, truth)
        lo, hi = hw.estimate(real, record, method).interval()
        assert np.mean(hi - lo) < np.mean(np.subtract(*wide.interval()[::-1]))
    assert "theta_bounds" in method.refuses(dataclasses.replace(model, theta_bounds=None))


def test_more_generators_and_constraints_are_tighter():
    _, record = cornered(OSCILLATOR.model, 300, 5, u=np.zeros((300, 1)))
    width = {
        name: float(np.mean(np.subtract(*hw.estimate(OSCILLATOR.model, record, m).interval()[::-1])))
        for name, m in {
            "interval": hw.IntervalFilter(),
            "zonotope": hw.ZonotopeFilter(),
            "few": hw.ConstrainedZonotopeFilter(order=10, constraints=2),
            "many": hw.ConstrainedZonotopeFilter(order=40, constraints=12, rounds=30),
            "exact": hw.Hull(memory=10),
        }.items()
    }
    assert width["exact"] < width["many"] < width["few"] < width["interval"]
    assert width["zonotope"] < width["interval"]
    assert width["many"] < 1.1 * width["exact"]


@EVERY
def test_settings_and_models_are_refused_by_name(method):
    name = type(method).__name__
    model = walk()
    for wrong, word in (
        (dataclasses.replace(model, e=hw.Gaussian(1.0)), "Gaussian"),
        (dataclasses.replace(model, w=hw.Uniform.unknown()), "known half-widths"),
        (dataclasses.replace(model, x0=hw.Normal([0.0], 1.0)), "prior"),
        (dataclasses.replace(model, loss=hw.Bernoulli(0.9)), "loss"),
    ):
        reason = method.refuses(wrong)
        assert name in reason
        assert word in reason
        assert "\nhint: " in reason


@pytest.mark.parametrize(
    "wrong", [lambda: hw.ZonotopeFilter(order=0), lambda: hw.ConstrainedZonotopeFilter(constraints=0), lambda: hw.ZonotopeFilter(1.5)]
)  # fmt: skip
def test_settings_are_judged(wrong):
    with pytest.raises(hw.BadValue, match="whole number"):
        wrong()


# ---- nonlinear models ------------------------------------------------------------------------------------------------


def turning(**more):
    """A turning vehicle that sees its position and the distance to a mast."""
    return hw.Nonlinear(
        lambda x, u, dt: np.array(
            [x[0] + dt * x[2] * np.cos(x[3]), x[1] + dt * x[2] * np.sin(x[3]), x[2] + dt * u[0], x[3] + dt * u[1]]
        ),
        lambda x: np.array([x[0], x[1], np.hypot(x[0] - 50, x[1] - 20)]),
        hw.Uniform([1e-2, 1e-2, 1e-2, 1e-3]),
        hw.Uniform([0.5, 0.5, 0.2]),
        hw.Box([-0.5, -0.5, 4.5, 0.2], [0.5, 0.5, 5.5, 0.4]),
        nu=2,
        dt=0.2,
        **more,
    )


@EVERY
def test_a_turning_vehicle_is_contained_through_an_outage(method):
    model = turning()
    u = np.c_[np.sin(np.arange(60) / 9), 0.4 * np.cos(np.arange(60) / 15)]
    for seed in range(2):
        truth, record = hw.simulate(model, u, seed=seed)
        est = hw.estimate(model, record.without(4.0, 6.0), method)
        assert contains(est, truth.x)
        lo, hi = est.interval()
        assert np.all(hi - lo < [6.0, 5.0, 3.0, 0.5])  # and says something


@EVERY
def test_a_pendulum_and_a_range_with_noise_in_the_corners(method):
    model = hw.Nonlinear(
        lambda x, u, dt: np.array([x[0] + dt * x[1], x[1] - dt * (9.81 * np.sin(x[0]) + 0.3 * x[1] * np.abs(x[1]))]),
        lambda x: np.array([np.sin(x[0]), np.exp(-(x[1] ** 2) / 8)]),
        hw.Uniform([1e-4, 1e-3]),
        hw.Uniform([0.02, 0.05]),
        hw.Box([0.4, -0.2], [0.6, 0.2]),
        dt=0.02,
    )
    rng = np.random.default_rng(3)
    x, states, y = rng.uniform(model.x0.lo, model.x0.hi), [], []
    for _ in range(200):
        x = model.move(x, None, 0.02) + 0.999999 * rng.choice([-1, 1], 2) * model.w.q
        states.append(x)
        y.append(model.output(x) + 0.999999 * rng.choice([-1, 1], 2) * model.e.q)
    y = np.array(y)
    y[rng.random(y.shape) < 0.3] = np.nan
    est = hw.estimate(model, hw.Record(0.02 * np.arange(1, 201), y), method)
    assert contains(est, np.array(states))
    lo, hi = est.interval()
    assert np.mean(hi[100:] - lo[100:], axis=0)[0] < 0.2


@EVERY
def test_a_linear_function_costs_nothing(method):
    A, C = np.array([[0.9, 0.3], [-0.2, 0.8]]), np.array([[1.0, 0.5]])
    q, r, x0 = hw.Uniform([0.1, 0.05]), hw.Uniform(0.4), hw.Box([-1.0, -1.0], [1.0, 1.0])
    linear = hw.Linear(A, None, C, q, r, x0)
    bent = hw.Nonlinear(lambda x: A @ x, lambda x: C @ x, q, r, x0)
    truth, record = cornered(linear, 60, 0)
    one, two = hw.estimate(linear, record, method), hw.estimate(bent, record, method)
    assert contains(two, truth)
    widths = [np.mean(np.subtract(*est.interval()[::-1])) for est in (one, two)]
    assert widths[1] <= 1.02 * widths[0]


@EVERY
def test_an_output_that_is_an_angle_turns(method):
    model = hw.Nonlinear(
        lambda x: x, lambda x: np.array([x[0]]), hw.Uniform(0.3), hw.Uniform(0.1), hw.Box([-0.1], [0.1]), y_angles=(0,)
    )
    steps = 0.25 * np.arange(1, 60)
    y = np.remainder(steps + np.pi, 2 * np.pi) - np.pi
    est = hw.estimate(model, hw.Record(np.arange(59.0), y), method)
    assert contains(est, steps[:, None])
    lo, hi = est.interval()
    assert np.all(hi - lo < 0.21)


@EVERY
def test_a_contradiction_in_a_nonlinear_model(method):
    model = turning(bounds=hw.Box([-100, -100, 0, -4], [100, 100, 30, 4]))
    u = np.zeros((20, 2))
    _, record = hw.simulate(model, u, seed=0)
    y = record.y.copy()
    y[7, 2] += 3.0
    est = hw.estimate(model, hw.Record(record.t, y, u), method)
    assert est.status is hw.Status.INFEASIBLE
    assert est.info["conflict"][0]["row"] == 7
    away = hw.estimate(
        turning(bounds=hw.Box([-100, -100, 0, -4], [3, 100, 30, 4])),
        hw.Record(record.t, np.full_like(y, np.nan), u),
        method,
    )
    assert away.status is hw.Status.INFEASIBLE
    assert away.info["conflict"][0]["kind"] == "state"


@EVERY
def test_a_function_that_blows_up_says_nothing_rather_than_something_wrong(method):
    model = hw.Nonlinear(
        lambda x: np.array([x[0] + 1.0 / x[1], x[1]]),
        lambda x: np.array([x[0]]),
        hw.Uniform(0.01),
        hw.Uniform(0.1),
        hw.Box([0.0, -1.0], [0.0, 2.0]),
    )
    est = hw.estimate(model, hw.Record([0.0, 1.0], [None, 0.7]), method).check()
    lo, hi = est.interval()
    assert np.isinf(hi[0, 0])
    np.testing.assert_allclose([lo[1, 0], hi[1, 0]], [0.6, 0.8])
    assert np.isfinite(est.x).all()


@EVERY
def test_what_cannot_be_recorded_is_refused(method):
    model = hw.Nonlinear(
        lambda x: np.array([math.sin(float(x[0]))]), lambda x: x, hw.Uniform(0.1), hw.Uniform(0.1), hw.Box([0.0], [1.0])
    )
    reason = method.refuses(model)
    assert type(method).__name__ in reason
    assert "`g` cannot be recorded" in reason
    with pytest.raises(hw.Refused):
        hw.estimate(model, hw.Record([0.0], [0.1]), method)


@EVERY
def test_a_nonlinear_stream_equals_its_batch(method):
    model = turning()
    u = np.c_[np.ones(12), 0.1 * np.ones(12)]
    _, record = hw.simulate(model, u, seed=2)
    est = hw.estimate(model, record, method)
    live = hw.stream(model, method)
    for k in range(12):
        if k == 6:
            live = hw.resume(live.snapshot(), model)
        newest = live.push(record.y[k], u[k])
    np.testing.assert_allclose(newest.interval()[0][0], est.interval()[0][-1], rtol=1e-12)


def test_the_default_constrained_zonotope_is_narrower_than_the_zonotope():
    """Width is what its constraints are for: on each of these systems the mean is well below the zonotope's."""
    rng = np.random.default_rng(0)
    narrower = []
    for seed in range(12):
        nx, ny = 2 + seed % 3, 1 + seed % 2
        A = rng.normal(size=(nx, nx))
        A *= rng.uniform(0.5, 1.0) / np.abs(np.linalg.eigvals(A)).max()
        q, r = 10 ** rng.uniform(-1.5, -0.5, nx), 10 ** rng.uniform(-1, 0, ny)
        C, x0 = rng.normal(size=(ny, nx)), hw.Box(-np.ones(nx), np.ones(nx))
        model = hw.Linear(A, None, C, hw.Uniform(q), hw.Uniform(r), x0)
        _, record = hw.simulate(model, T=60, seed=seed)
        widths = []
        for method in (hw.ConstrainedZonotopeFilter(), hw.ZonotopeFilter()):
            lo, hi = hw.estimate(model, record, method).check().interval()
            widths.append(np.mean(hi[5:] - lo[5:]))
        narrower.append(widths[0] / widths[1])
    assert max(narrower) <= 1.0
    assert np.mean(narrower) < 0.95


def test_more_rounds_are_tighter_and_one_is_enough_to_contain():
    truth, record = cornered(OSCILLATOR.model, 300, 7, u=np.zeros((300, 1)))
    widths = []
    for rounds in (1, 4, 30):
        est = hw.estimate(OSCILLATOR.model, record, hw.ConstrainedZonotopeFilter(rounds=rounds))
        assert contains(est, truth)
        widths.append(np.mean(np.subtract(*est.interval()[::-1])))
    assert widths[2] < widths[1] < widths[0]
    with pytest.raises(hw.BadValue, match="rounds"):
        hw.ConstrainedZonotopeFilter(rounds=0)
