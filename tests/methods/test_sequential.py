"""Sequential linear programs: unknown entries, drift, nonlinear models."""

import numpy as np
import pytest

import halfwidth as hw
from halfwidth.methods._linearised import LinearRows

NAN = float("nan")
SMALL = hw.Uniform.unknown(at_most=1.0)


def test_a_noise_free_parameter_is_exact():
    decay = hw.Linear([[NAN]], None, [[1]], SMALL, SMALL, None, theta_bounds=(0.0, 1.0))
    est = hw.estimate(
        decay, hw.Record(range(20), [0.9**k for k in range(20)]), hw.SequentialLP(point="optimal")
    ).check()
    assert est.theta == pytest.approx([0.9], abs=1e-6)
    assert est.q == pytest.approx([0], abs=1e-6)


@pytest.mark.parametrize("matrix", ["A", "B", "C", "E", "F"])
def test_an_unknown_entry_of_each_matrix(matrix):
    A, B, C = np.array([[0.8, 0.2], [-0.1, 0.7]]), np.array([[1.0], [0.5]]), np.array([[1.0, 0.3], [0.2, 1.0]])
    E, F = np.array([[1, 0.4], [0, 1.0]]), np.array([[1, 0.3], [0, 1.0]])
    matrices = {"A": A, "B": B, "C": C, "E": E, "F": F}
    entry = {"A": (0, 1), "B": (1, 0), "C": (0, 1), "E": (0, 1), "F": (0, 1)}[matrix]
    true = hw.Linear(A, B, C, hw.Uniform(0.02), hw.Uniform(0.02), hw.Box([0, 0], [0, 0]), E=E, F=F)
    _, record = hw.simulate(true, np.random.default_rng(0).uniform(-1, 1, 200), seed=1)
    record = record.without(50.0, 55.0)
    value = matrices[matrix][entry]
    matrices[matrix] = matrices[matrix].copy()
    matrices[matrix][entry] = NAN
    model = hw.Linear(
        matrices["A"], matrices["B"], matrices["C"], SMALL, SMALL, None, E=matrices["E"], F=matrices["F"],
        theta_bounds=(-1, 1),
    )  # fmt: skip
    est = hw.estimate(model, record, hw.SequentialLP()).check()
    assert est.theta == pytest.approx([value], abs=0.1)
    history = np.array(est.info["history"])
    assert history[-1] <= history[0]


def test_the_linearisation_is_the_derivative():
    model = hw.Linear(
        [[NAN, 0.2], [0.1, 0.5]],
        [[1], [NAN]],
        [[1, NAN]],
        SMALL,
        SMALL,
        None,
        E=[[1, NAN], [0, 1]],
        theta_bounds=(-1, 1),
    )
    rng = np.random.default_rng(0)
    record = hw.Record(np.arange(6.0), rng.normal(size=(6, 1)), rng.normal(size=(6, 1)))
    rows = LinearRows(model, record, None)
    x, theta = rng.normal(size=(7, 2)), rng.uniform(-1, 1, 4)
    chain = rows.chain(x, theta, np.ones(3))
    base = rows.residuals(x, theta)
    dx, dtheta = rng.normal(size=x.shape), rng.normal(size=4)
    E = chain.E
    for h in (1e-4, 1e-5):
        moved = rows.residuals(x + h * dx, theta + h * dtheta)
        X, th = x + h * dx, theta + h * dtheta
        linear = np.hstack([X[1:] @ E.T - X[:-1] @ chain.A.T - chain.bx, X[1:] @ chain.C.T - chain.by]) + chain.G @ th
        np.testing.assert_allclose(linear, moved, atol=20 * h * h)
    np.testing.assert_allclose(
        np.hstack([x[1:] @ E.T - x[:-1] @ chain.A.T - chain.bx, x[1:] @ chain.C.T - chain.by]) + chain.G @ theta, base
    )


def test_drift_follows_a_parameter_that_moves():
    T = 200
    true = np.linspace(0.2, 0.6, T)
    x, u, rng = np.zeros(T + 1), np.random.default_rng(0).uniform(-1, 1, T), np.random.default_rng(1)
    for t in range(T):
        x[t + 1] = true[t] * x[t] + u[t] + rng.uniform(-0.01, 0.01)
    record = hw.Record(np.arange(float(T)), x[1:] + rng.uniform(-0.01, 0.01, T), u)
    model = hw.Linear([[NAN]], [[1]], [[1]], SMALL, SMALL, None, theta_bounds=(0, 1))
    still = hw.estimate(model, record, hw.SequentialLP()).check()
    moving = hw.estimate(model, record, hw.SequentialLP(drift=1.0)).check()
    assert moving.theta == pytest.approx([0.6], abs=0.1)
    assert moving.info["drift"] == pytest.approx([0.4], abs=0.15)
    assert moving.info["objective"] < 0.8 * still.info["objective"]


def test_what_the_numbers_do_not_say_is_said():
    low = hw.Uniform.unknown(at_most=[0.02, 5.0])
    model = hw.Linear(
        np.diag([NAN, 0.8]), None, [[1.0, 0.0], [1.0, 0.0]], low, SMALL, None, names=["seen", "hidden"],
        theta_bounds=(0.5, 1.0),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    x = np.zeros(61)
    for t in range(60):
        x[t + 1] = 0.9 * x[t] + rng.uniform(-0.2, 0.2)
    y = np.c_[x[1:] + rng.uniform(-0.1, 0.1, 60), np.full(60, NAN)]
    est = hw.estimate(model, hw.Record(np.arange(60.0), y), hw.SequentialLP(point="optimal")).check()
    assert est.info["on_cap"] == ["q[seen]"]
    notes = " | ".join(est.info["notes"])
    assert "bound not identifiable: r[y1]" in notes
    assert "not observable: hidden" in notes
    assert "half-width on its cap: q[seen]" in notes
    assert notes.split(" | ")[0] in est.message


def test_infeasible_names_the_rows_and_a_factor_that_is_enough():
    walk = hw.Linear([[NAN]], None, [[1.0]], hw.Uniform(0.1), hw.Uniform(0.2), None, theta_bounds=(0.9, 1.0))
    y = np.zeros(30)
    y[12] = 3.0
    record = hw.Record(np.arange(30.0), y)
    est = hw.estimate(walk, record, hw.SequentialLP())
    assert est.status is hw.Status.INFEASIBLE
    worst = est.info["conflicts"][0]
    assert (worst["kind"], worst["name"], worst["row"], worst["t"]) == ("output", "y0", 12, 12.0)
    assert worst["excess"] == pytest.approx(abs(est.x[12, 0] - 3.0) - 0.2)
    factor = est.info["inflation"]
    assert factor > 1.0
    wider = hw.Linear(
        [[NAN]], None, [[1.0]], hw.Uniform(1.001 * factor * 0.1), hw.Uniform(1.001 * factor * 0.2), None,
        theta_bounds=(0.9, 1.0),
    )  # fmt: skip
    assert hw.estimate(wider, record, hw.SequentialLP()).status.good


def test_a_nonlinear_model():
    def g(x, u):
        return np.stack([x[0] + 0.1 * x[1], x[1] - 0.1 * np.sin(x[0]) + 0.1 * u[0]])

    model = hw.Nonlinear(g, lambda x: x[:1], hw.Uniform(0.005), hw.Uniform(0.1), hw.Box([0.9, -0.1], [1.1, 0.1]), nu=1)
    truth, record = hw.simulate(model, np.zeros(150), seed=0)
    unknown = hw.Nonlinear(
        g,
        lambda x: x[:1],
        hw.Uniform.unknown(at_most=0.1),
        hw.Uniform.unknown(at_most=1.0),
        hw.Box([0, -1], [2, 1]),
        nu=1,
    )
    est = hw.estimate(unknown, record.without(50.0, 60.0), hw.SequentialLP()).check()
    assert np.abs(est.x - truth.x).mean() < 0.06
    assert np.all(np.abs(est.info["w"]) <= est.q + 1e-9)


def test_refusals_and_settings():
    with pytest.raises(hw.BadValue):
        hw.SequentialLP(point="middle")
    with pytest.raises(hw.BadValue):
        hw.SequentialLP(rounds=0)
    with pytest.raises(hw.BadValue):
        hw.SequentialLP(drift=-1.0)
    gaussian = hw.Linear([[1]], None, [[1]], hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0], 1.0))
    with pytest.raises(hw.Refused):
        hw.estimate(gaussian, hw.Record([0], [0.0]), hw.SequentialLP())


def _swing(r=(0.01, 0.02)):
    """A pendulum whose angle and its sine are seen, with floors."""

    def g(x):
        return np.stack([x[0] + 0.1 * x[1], x[1] - 0.1 * np.sin(x[0])])

    def h(x):
        return np.stack([x[0], np.sin(x[0]) * x[1]])

    low = hw.Uniform.unknown(at_least=[0.002, 0.005], at_most=5.0)
    return hw.Nonlinear(g, h, low, hw.Uniform.unknown(at_least=list(r), at_most=5.0), hw.Box([-2, -2], [2, 2]))


def _swung(T=25, seed=3):
    true = hw.Nonlinear(
        _swing().g, _swing().h, hw.Uniform([0.01, 0.02]), hw.Uniform([0.1, 0.15]), hw.Box([0.8, -0.1], [1.2, 0.1])
    )
    _, record = hw.simulate(true, None, T=T, seed=seed)
    y = record.y.copy()
    y[8:13, 0] = y[3:6, 1] = np.nan
    return hw.Record(record.t, y)


def test_the_logarithmic_objective_is_that_of_an_interior_point_for_nonlinear_programs():
    ca = pytest.importorskip("casadi")
    model, record = _swing(), _swung()
    ours = hw.estimate(model, record, hw.SequentialLP(objective="log", point="optimal", tol=1e-7)).check()
    T, N = len(record), ours.info["rows"]
    # K / T of the slides: outputs count by the rows in which they are seen
    assert N.tolist() == [T, T, T - 5, T - 3]
    X, s = ca.MX.sym("X", 2, T + 1), ca.MX.sym("s", 4)
    rows = []
    for k in range(T):
        a, b = X[:, k], X[:, k + 1]
        w = b - ca.vertcat(a[0] + 0.1 * a[1], a[1] - 0.1 * ca.sin(a[0]))
        e = ca.vertcat(b[0], ca.sin(b[0]) * b[1])
        for j, rho in enumerate((w[0], w[1], e[0] - record.y[k, 0], e[1] - record.y[k, 1])):
            if j < 2 or record.seen[k, j - 2]:
                rows += [s[j] - rho, s[j] + rho]
    program = {"x": ca.vertcat(ca.vec(X), s), "f": ca.dot(ca.DM(N.tolist()), ca.log(s)), "g": ca.vertcat(*rows)}
    low_s, box = np.r_[model.w.at_least, model.e.at_least], 2 * np.ones(2)
    quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.tol": 1e-9}
    near = {
        "ipopt.mu_init": 1e-10,
        "ipopt.bound_push": 1e-10,
        "ipopt.bound_frac": 1e-10,
        "ipopt.slack_bound_push": 1e-10,
    }
    first = hw.estimate(model, record, hw.SequentialLP())

    def oracle(est, options):
        solver = ca.nlpsol("oracle", "ipopt", program, quiet | options)
        found = solver(
            x0=np.r_[np.vstack([est.info["x0"], est.x]).ravel(), est.q, est.r], lbg=0, ubg=np.inf,
            lbx=np.r_[-box, np.full(2 * T, -np.inf), low_s], ubx=np.r_[box, np.full(2 * T, np.inf), np.full(4, 5.0)],
        )  # fmt: skip
        assert solver.stats()["success"]
        return float(found["f"])

    # ours is a minimum: begun there, the oracle stays; begun at the scaled optimum as ours was, it ends no lower
    assert oracle(ours, near) == pytest.approx(ours.info["objective"], abs=1e-3 * N.sum())
    assert oracle(first, {}) > ours.info["objective"] - 1e-3 * N.sum()


def test_the_logarithmic_objective_against_every_vertex():
    # one state that stands still exactly, one output: r is the half range, whatever its unit
    still = hw.Linear([[1]], None, [[1]], hw.Uniform(0.0), hw.Uniform.unknown(at_least=0.1), None)
    for unit in (1.0, 1e-12, 1e12):
        model = hw.Linear([[1]], None, [[1]], hw.Uniform(0.0), hw.Uniform.unknown(at_least=0.1 * unit), None)
        y = unit * np.array([0.0, 1.0, 0.3, np.nan, 0.8])
        est = hw.estimate(model, hw.Record(range(5), y), hw.SequentialLP(objective="log", point="optimal")).check()
        assert est.r[0] == pytest.approx(0.5 * unit, rel=1e-6)
        assert est.info["objective"] == pytest.approx(4 * np.log(0.5 * unit), rel=1e-6)
    exact = hw.estimate(still, hw.Record(range(3), [1.0, 1.0, 1.0]), hw.SequentialLP(objective="log"))
    assert exact.r[0] == pytest.approx(0.1)
    assert exact.info["on_floor"] == ["r[y0]"]


def test_the_logarithm_needs_floors():
    open_ = hw.Linear([[1]], None, [[1]], hw.Uniform.unknown(), hw.Uniform.unknown(at_least=0.1), None)
    with pytest.raises(hw.Refused, match="floor"):
        hw.estimate(open_, hw.Record([0, 1], [0.0, 1.0]), hw.SequentialLP(objective="log"))


@pytest.mark.parametrize("point", ["central", "optimal", "least_squares"])
def test_known_half_widths_that_fit_only_another_theta(point):
    model = hw.Linear(
        [[NAN]], [[NAN]], [[1]], hw.Uniform(0.2), hw.Uniform(0.3), hw.Box(-1, 1), theta_bounds=([0, -1], [1, 1])
    )
    est = hw.estimate(model, hw.Record([0, 1, 2], [0.5, 0.1, 0.6], [1, 0, -1]), hw.SequentialLP(point=point)).check()
    assert np.abs(est.info["w"]).max() <= 0.2 + 1e-6
    assert np.abs(est.info["e"]).max() <= 0.3 + 1e-6


def test_what_cannot_fit_is_infeasible_with_the_least_excess():
    model = hw.Linear([[NAN]], None, [[1]], hw.Uniform(0.1), hw.Uniform(0.1), hw.Box(1, 1.5), theta_bounds=(0.5, 1))
    est = hw.estimate(model, hw.Record(range(4), [1.0, 0.9, 5.0, 0.8]), hw.SequentialLP())
    assert est.status is hw.Status.INFEASIBLE
    assert np.isfinite(est.x).all()
    assert est.q is None
    assert "least excess" in est.info["message"]


def test_a_start_is_checked_and_used():
    model, record = _swing(), _swung()
    with pytest.raises(hw.BadShape):
        hw.SequentialLP(start=np.zeros((3, 2))).run(model, record)
    est = hw.SequentialLP(objective="log", start=np.zeros((len(record) + 1, 2))).run(model, record)
    assert est.status.good
    nothing = hw.Record(record.t, np.full_like(record.y, np.nan))
    blind = hw.SequentialLP(objective="log").run(model, nothing)
    assert np.isfinite(blind.x).all()
