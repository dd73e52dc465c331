"""BatchLP against HiGHS on the literal program of the paper, its refusals, and the degenerate cases."""

import dataclasses

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

import halfwidth as hw
from halfwidth.methods._residuals import residuals
from halfwidth.methods.map import BatchLP

INF = np.inf


def draw(seed, *, nx=3, ny=2, T=30, lost=0.2, E=True, F=True, boxes=False, caps=INF, floors=0.0):
    """A stable model with an input, a record drawn from it, and unknown half-widths."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(nx, nx))
    A *= 0.95 / max(np.abs(np.linalg.eigvals(A)))
    fold = np.eye(nx) + np.triu(rng.normal(size=(nx, nx)), 1) * 0.3 if E else np.eye(nx)
    true = hw.Linear(
        fold @ A,
        rng.normal(size=(nx, 1)),
        rng.normal(size=(ny, nx)),
        hw.Uniform(rng.uniform(0.05, 0.3, nx)),
        hw.Uniform(rng.uniform(0.1, 0.5, ny)),
        hw.Box(-np.ones(nx), np.ones(nx)),
        E=fold if E else None,
        F=np.eye(ny) + np.triu(rng.normal(size=(ny, ny)), 1) * 0.3 if F else None,
    )
    truth, record = hw.simulate(true, rng.normal(size=(T, 1)), seed=seed)
    y = record.y.copy()
    y[rng.random(y.shape) < lost] = np.nan
    unknown = hw.Uniform.unknown(at_least=floors, at_most=caps)
    top = np.abs(truth.x).max() + 0.1
    model = dataclasses.replace(
        true, w=unknown, e=unknown, x0=None, bounds=hw.Box(np.full(nx, -top), np.full(nx, top)) if boxes else None
    )
    return model, hw.Record(record.t, y, record.u), truth


def literal(model, record, cost, caps=INF, floors=0.0):
    """The program row by row as printed, solved by HiGHS: value, q, r; rows with an unseen partner are dropped."""
    import highspy

    T, nx, ny = len(record), model.nx, model.ny
    n, p = (T + 1) * nx, nx + ny
    E = np.eye(nx) if model.E is None else model.E.single
    F = np.eye(ny) if model.F is None else model.F.single
    A, B, C = model.A.single, model.B.single, model.C.single
    rows, ends = [], []
    for t in range(T):
        for i in range(nx):
            a = np.zeros(n + p)
            a[(t + 1) * nx : (t + 2) * nx] = E[i]
            a[t * nx : (t + 1) * nx] = -A[i]
            for sign in (1.0, -1.0):
                row = sign * a
                row[n + i] = -1.0
                rows.append(row)
                ends.append(sign * (B[i] @ record.u[t]))
        for j in range(ny):
            if not record.seen[t][F[j] != 0].all():
                continue
            a = np.zeros(n + p)
            a[(t + 1) * nx : (t + 2) * nx] = C[j]
            for sign in (1.0, -1.0):
                row = sign * a
                row[n + nx + j] = -1.0
                rows.append(row)
                ends.append(sign * (F[j, F[j] != 0] @ record.y[t, F[j] != 0]))
    box = model.bounds or hw.Box(np.full(nx, -INF), np.full(nx, INF))
    lo = np.r_[model.x0.lo, np.tile(box.lo, T), np.full(p, floors)]
    hi = np.r_[model.x0.hi, np.tile(box.hi, T), np.full(p, caps)]
    engine = highspy.Highs()
    engine.setOptionValue("output_flag", False)
    engine.setOptionValue("presolve", "off")
    lp = highspy.HighsLp()
    G = sp.csr_array(np.array(rows))
    lp.num_col_, lp.num_row_ = n + p, len(rows)
    lp.col_cost_, lp.col_lower_, lp.col_upper_ = np.r_[np.zeros(n), cost], lo, hi
    lp.row_lower_, lp.row_upper_ = np.full(len(rows), -INF), np.array(ends)
    lp.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
    lp.a_matrix_.num_col_, lp.a_matrix_.num_row_ = n + p, len(rows)
    lp.a_matrix_.start_, lp.a_matrix_.index_, lp.a_matrix_.value_ = G.indptr, G.indices, G.data
    engine.passModel(lp)
    engine.run()
    if engine.getModelStatus() == highspy.HighsModelStatus.kInfeasible:
        return None
    assert engine.getModelStatus() == highspy.HighsModelStatus.kOptimal
    s = np.array(engine.getSolution().col_value)[n:]
    return float(cost @ s), s[:nx], s[nx:]


def holds(model, record, est, slack=1e-7):
    """Whether the trajectory needs no more noise than the half-widths returned, and stays in its boxes."""
    rows = residuals(model, record)
    X = np.r_[est.info["x0"], est.x.ravel()]
    s = np.r_[est.q, est.r]
    size = 1.0 + np.abs(rows.at(X)).max()
    box = model.bounds or hw.Box(np.full(model.nx, -INF), np.full(model.nx, INF))
    inside = np.all((box.lo <= est.x) & (est.x <= box.hi)) and np.all(
        (model.x0.lo <= est.info["x0"]) & (est.info["x0"] <= model.x0.hi)
    )
    return bool(inside and np.all(np.abs(rows.at(X)) <= rows.S @ s + slack * size))


@pytest.mark.parametrize("seed", range(12))
def test_the_objective_is_that_of_highs_on_the_printed_program(seed):
    model, record, _ = draw(
        seed,
        E=seed % 2 == 0,
        F=False,
        boxes=seed % 3 == 0,
        floors=0.02 * (seed % 4 == 0),
        caps=INF if seed % 2 else 3.0,
    )
    floors, caps = 0.02 * (seed % 4 == 0), INF if seed % 2 else 3.0
    best, _, _ = literal(model, record, np.ones(5), caps, floors)
    for point in ("optimal", "least_squares"):
        est = hw.estimate(model, record, BatchLP(objective="paper", point=point)).check()
        # The least-squares stage may spend 1e-6 of each group's scale.
        assert est.info["objective"] == pytest.approx(best, rel=1e-7 if point == "optimal" else 1e-5)
        assert est.info["objective"] == pytest.approx(est.q.sum() + est.r.sum(), rel=1e-12)
        assert holds(model, record, est)
    scaled = hw.estimate(model, record, BatchLP(point="optimal")).check()
    weight = scaled.info["rows"] / scaled.info["rows"].mean() / scaled.info["sigma"]
    best, _, _ = literal(model, record, weight, caps, floors)
    assert scaled.info["objective"] == pytest.approx(best, rel=1e-7)
    assert holds(model, record, scaled)


@pytest.mark.parametrize("seed", range(4))
def test_both_solvers_give_the_same_objective(seed):
    model, record, _ = draw(seed, T=60, boxes=True)
    one = hw.estimate(model, record, BatchLP(point="optimal", solver="piqp"))
    two = hw.estimate(model, record, BatchLP(point="optimal", solver="highs"))
    assert one.info["solver"] == "piqp"
    assert two.info["solver"] == "highs"
    assert one.info["objective"] == pytest.approx(two.info["objective"], rel=1e-7)
    assert max(one.info["check"].values()) <= 1e-7
    assert max(two.info["check"].values()) <= 1e-7


def test_correlated_outputs_without_losses_are_the_printed_rows():
    model, record, _ = draw(3, lost=0.0)
    best, _, _ = literal(model, record, np.ones(5))
    est = hw.estimate(model, record, BatchLP(objective="paper", point="optimal"))
    assert est.info["objective"] == pytest.approx(best, rel=1e-7)


def test_an_unseen_correlated_output_is_eliminated_not_dropped():
    """With y2 never seen, y1 still bounds the state: |y1 - (C1 - F12 C2) x| <= r1 + |F12| r2."""
    model = hw.Linear(
        [[1.0]], None, [[1.0], [0.5]], hw.Uniform(0.0), hw.Uniform([0.2, 0.1]), None, F=[[1.0, 0.4], [0.0, 1.0]]
    )
    y = np.array([[1.0, np.nan], [1.1, np.nan], [0.9, np.nan]])
    rows = residuals(model, hw.Record([0.0, 1.0, 2.0], y))
    np.testing.assert_allclose(rows.M.toarray()[3:, 1:], (1.0 - 0.4 * 0.5) * np.eye(3))
    np.testing.assert_allclose(rows.S.toarray()[3:], [[0, 1, 0.4]] * 3)
    est = hw.estimate(model, hw.Record([0.0, 1.0, 2.0], y), BatchLP(point="least_squares")).check()
    np.testing.assert_allclose(est.x[:, 0], 1.0 / 0.8, atol=1e-6)


def test_least_squares_stays_inside_the_optimal_half_widths():
    model, record, _ = draw(5, T=80)
    vertex = hw.estimate(model, record, BatchLP(point="optimal"))
    smooth = hw.estimate(model, record, BatchLP(point="least_squares"))
    sigma = vertex.info["sigma"]

    def size(est):
        return np.nansum((est.info["w"] / sigma[:3]) ** 2) + np.nansum((est.info["e"] / sigma[3:]) ** 2)

    assert size(smooth) <= size(vertex) * (1 + 1e-9)
    room = 1e-5 * np.maximum(sigma, np.r_[vertex.q, vertex.r])
    assert np.all(np.r_[smooth.q, smooth.r] <= np.r_[vertex.q, vertex.r] + room)


def test_known_and_unknown_half_widths_together():
    model, record, _ = draw(6, F=False, T=60)
    true_q = np.array([0.3, 0.3, 0.3])
    known = dataclasses.replace(model, w=hw.Uniform(true_q))
    est = hw.estimate(known, record, BatchLP(point="least_squares")).check()
    np.testing.assert_array_equal(est.q, true_q)
    assert np.all(np.abs(est.info["w"]) <= true_q * (1 + 1e-7))
    free = hw.estimate(model, record, BatchLP(objective="paper")).check()
    assert np.all(est.r < free.r + 0.5)
    both = dataclasses.replace(known, e=hw.Uniform(1.0))
    est = hw.estimate(both, record, BatchLP(point="least_squares")).check()
    np.testing.assert_array_equal(est.r, [1.0, 1.0])
    assert holds(both, record, est)
    one = dataclasses.replace(model, e=hw.Uniform.unknown([0.5, 0.0], [0.5, 9.0]))
    assert hw.estimate(one, record, BatchLP(point="least_squares")).r[0] == 0.5


def test_matrices_that_follow_the_step():
    """Irregular rows: the position after a long step is what speed and acceleration say."""
    t = np.array([0.0, 0.1, 0.5, 0.6, 1.6])
    model = hw.Linear(
        lambda dt: [[1.0, dt], [0.0, 1.0]],
        lambda dt: [[dt * dt / 2], [dt]],
        [[1.0, 0.0]],
        hw.Uniform.unknown(at_most=1.0),
        hw.Uniform.unknown(at_most=1.0),
        None,
        dt=0.1,
    )
    u = np.full((5, 1), 2.0)
    position = 1.0 + 3.0 * t + t**2
    est = hw.estimate(
        model, hw.Record(t, np.where(t == 0.6, np.nan, position)[:, None], u), BatchLP(point="least_squares")
    ).check()
    np.testing.assert_allclose(est.x[:, 0], position, atol=1e-7)
    np.testing.assert_allclose(est.x[:, 1], 3.0 + 2.0 * t, atol=1e-6)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10**6),
    nx=st.integers(1, 4),
    ny=st.integers(1, 3),
    T=st.integers(1, 25),
    lost=st.sampled_from([0.0, 0.3, 0.9, 1.0]),
    boxes=st.booleans(),
    objective=st.sampled_from(["scaled", "paper"]),
    point=st.sampled_from(["optimal", "least_squares"]),
)
def test_every_answer_holds(seed, nx, ny, T, lost, boxes, objective, point):
    model, record, _ = draw(seed, nx=nx, ny=ny, T=T, lost=lost, boxes=boxes)
    est = hw.estimate(model, record, BatchLP(objective=objective, point=point)).check()
    assert np.isfinite(est.x).all()
    assert holds(model, record, est, 1e-6)
    assert not est.guaranteed
    with pytest.raises(hw.Refused, match="without a spread"):
        est.interval()


@settings(max_examples=20)
@given(
    seed=st.integers(0, 10**6), scales=st.lists(st.sampled_from([1e-6, 1e-3, 1.0, 1e3, 1e6]), min_size=5, max_size=5)
)
def test_units_of_each_state_and_output_do_not_matter(seed, scales):
    """Metres beside radians: every state and output in a unit of its own, the same trajectory."""
    model, record, _ = draw(seed, T=40, boxes=True, caps=50.0)
    d, k = np.array(scales[:3]), np.array(scales[3:])
    m = model
    other = dataclasses.replace(
        m,
        A=d[:, None] * m.A.single / d,
        B=d[:, None] * m.B.single,
        C=k[:, None] * m.C.single / d,
        E=d[:, None] * m.E.single / d,
        F=k[:, None] * m.F.single / k,
        w=hw.Uniform.unknown(0.0, 50.0 * d),
        e=hw.Uniform.unknown(0.0, 50.0 * k),
        bounds=hw.Box(d * m.bounds.lo, d * m.bounds.hi),
    )
    one = hw.estimate(m, record, BatchLP(point="least_squares")).check()
    two = hw.estimate(other, hw.Record(record.t, k * record.y, record.u), BatchLP(point="least_squares")).check()
    np.testing.assert_allclose(two.x / d, one.x, rtol=1e-6, atol=1e-6 * np.abs(one.x).max())
    assert two.info["objective"] == pytest.approx(one.info["objective"], rel=1e-6)


# --- refusals -------------------------------------------------------------------------------------


def test_what_it_refuses():
    unknown = hw.Uniform.unknown(at_most=1.0)
    walk = hw.Linear([[1.0]], None, [[1.0]], unknown, unknown, None)
    method = BatchLP(point="least_squares")
    assert method.refuses(walk) is None
    for change, word in (
        ({"w": hw.Gaussian(1.0)}, "`w` is `Gaussian`"),
        ({"e": hw.Uniform(1.0) + hw.Gaussian(1.0)}, "`e` is `Mixed`"),
        ({"x0": hw.Normal([0.0], 1.0)}, "`x0` is `Normal`"),
        ({"A": [[np.nan]], "theta_bounds": (0.0, 1.0)}, "`A[0, 0]` is unknown"),
        ({"loss": object()}, "hidden loss"),
    ):
        reason = method.refuses(dataclasses.replace(walk, **change))
        assert word in reason
        assert "\nhint: " in reason
    bent = hw.Nonlinear(np.sin, lambda x: x, unknown, unknown, hw.Box([0.0], [1.0]))
    assert "nonlinear" in method.refuses(bent)
    assert "floor above 0" in BatchLP(objective="log").refuses(walk)
    for bad in ({"objective": "sum"}, {"point": "middle"}, {"solver": "cplex"}):
        with pytest.raises(hw.BadValue, match="was expected"):
            BatchLP(**bad)


def test_log_objective_descends():
    model, record, _ = draw(7, T=60, floors=0.05, caps=20.0, F=False)
    log = hw.estimate(model, record, BatchLP(objective="log", point="optimal")).check()
    scaled = hw.estimate(model, record, BatchLP(point="optimal")).check()

    def value(est):
        return float(est.info["rows"] @ np.log(np.r_[est.q, est.r]))

    assert log.info["objective"] == pytest.approx(value(log))
    assert value(log) <= value(scaled) + 1e-6
    assert np.all(np.r_[log.q, log.r] >= 0.05)
    assert holds(model, record, log)
    assert any("on its floor" in n for n in log.info["notes"])


def test_log_objective_has_a_central_point():
    """It is the central point of the program whose optimum the logarithm's is."""
    model, record, _ = draw(7, T=60, floors=0.05, caps=20.0, F=False)
    best = hw.estimate(model, record, BatchLP(objective="log", point="optimal")).check()
    est = hw.estimate(model, record, BatchLP(objective="log")).check()
    assert est.info["gap"] <= 0.3
    assert est.info["solver"] == "banded"
    assert holds(model, record, est)
    cost = best.info["rows"] / np.r_[best.q, best.r]
    assert cost @ np.r_[best.q, best.r] < cost @ np.r_[est.q, est.r] < 1.5 * (cost @ np.r_[best.q, best.r])
    assert est.info["objective"] > best.info["objective"]


# --- degenerate cases -----------------------------------------------------------------------------

UNKNOWN = hw.Uniform.unknown(at_most=100.0)
DRIFT = hw.Linear([[1.0, 1.0], [0.0, 1.0]], None, [[1.0, 0.0]], UNKNOWN, UNKNOWN, None, names=["p", "v"])


def drift(T=40, seed=0, q=(0.05, 0.02), r=0.3):
    true = dataclasses.replace(DRIFT, w=hw.Uniform(q), e=hw.Uniform(r), x0=hw.Box(-1.0, 1.0))
    return hw.simulate(true, None, T=T, seed=seed)


def test_unobservable_state():
    model = hw.Linear(np.diag([0.9, 0.8]), None, [[1.0, 0.0]], UNKNOWN, UNKNOWN, None, names=["seen", "hidden"])
    _, record = hw.simulate(
        dataclasses.replace(model, w=hw.Uniform(0.1), e=hw.Uniform(0.2), x0=hw.Box(-1, 1)), None, T=40, seed=1
    )
    est = hw.estimate(model, record, BatchLP(point="least_squares")).check()
    assert np.isfinite(est.x).all()
    np.testing.assert_allclose(np.abs(est.info["unobservable"]), [[0.0, 1.0]], atol=1e-9)
    assert any(n == "not observable: hidden" for n in est.info["notes"])
    assert any(n == "bound not identifiable: q[hidden]" for n in est.info["notes"])
    assert est.q[1] <= 1e-9
    assert "not observable" in est.message


def test_observable_model_has_no_such_note():
    for T in (2, 3, 40, 1000):
        _, record = drift(T)
        est = hw.estimate(DRIFT, record, BatchLP(point="least_squares")).check()
        assert est.info["unobservable"].shape == (0, 2)


@pytest.mark.parametrize("case", ["one row", "one row unseen", "nothing seen", "as many rows as states"])
def test_what_data_cannot_know_is_said(case):
    _, record = drift()
    y = record.y.copy()
    if case == "nothing seen":
        y[:] = np.nan
    T = {"one row": 1, "one row unseen": 1, "nothing seen": 40, "as many rows as states": 2}[case]
    if case == "one row unseen":
        y[:1] = np.nan
    est = hw.estimate(DRIFT, hw.Record(record.t[:T], y[:T]), BatchLP(point="least_squares")).check()
    assert est.status is hw.Status.OK
    assert np.isfinite(est.x).all()
    assert np.all(np.r_[est.q, est.r] < 1e-6)
    assert any(n.startswith("bound not identifiable: q[p], q[v], r[y0]") for n in est.info["notes"]), est.info["notes"]


def test_noiseless_data_give_zero_half_widths_and_say_so():
    t = np.arange(40.0)
    est = hw.estimate(DRIFT, hw.Record(t, (2.0 + 0.5 * t)[:, None]), BatchLP(point="least_squares")).check()
    assert est.status is hw.Status.OK
    np.testing.assert_allclose(est.x, np.c_[2.0 + 0.5 * t, np.full(40, 0.5)], atol=1e-9)
    assert np.all(np.r_[est.q, est.r] < 1e-9)
    zeros = hw.estimate(DRIFT, hw.Record(t, np.zeros((40, 1))), BatchLP(point="least_squares")).check()
    np.testing.assert_allclose(zeros.x, 0.0, atol=1e-12)


def test_known_zero_noise_is_an_equation():
    still = dataclasses.replace(DRIFT, w=hw.Uniform(0.0))
    _, record = drift(q=(0.0, 0.0))
    est = hw.estimate(still, record, BatchLP(point="least_squares")).check()
    np.testing.assert_allclose(np.diff(est.x[:, 0]), est.x[:-1, 1], atol=1e-7)
    assert est.r[0] <= 0.3 + 1e-6


@pytest.mark.parametrize("solver", ["auto", "highs", "piqp"])
def test_caps_too_small_name_the_outlier_and_the_inflation(solver):
    _, record = drift(seed=2)
    y = record.y.copy()
    y[17] += 3.0
    tight = dataclasses.replace(DRIFT, w=hw.Uniform([0.05, 0.02]), e=hw.Uniform.unknown(at_most=0.3))
    est = hw.estimate(tight, hw.Record(0.1 * record.t, y), BatchLP(solver=solver))
    assert est.status is hw.Status.INFEASIBLE
    assert np.isfinite(est.x).all()
    assert est.q is None
    worst = est.info["conflicts"][0]
    assert (worst["kind"], worst["name"], worst["row"]) == ("output", "y0", 17)
    when = 0.1 * record.t[17]
    assert worst["t"] == when
    assert 2.0 < worst["excess"] < 3.0
    factor = est.info["inflation"]
    assert f"at t = {when:.9g} s; they fit if all half-widths grow" in est.message
    with pytest.raises(hw.Unsolved, match=r"Status.INFEASIBLE: no trajectory fits the bounds at t = 1.[78] s"):
        est.check()
    # The factor is what it says: just enough.
    for grown, good in ((factor * 1.0001, True), (factor * 0.9999, False)):
        model = dataclasses.replace(
            tight, w=hw.Uniform(grown * np.array([0.05, 0.02])), e=hw.Uniform.unknown(at_most=grown * 0.3)
        )
        assert hw.estimate(model, hw.Record(0.1 * record.t, y), BatchLP(point="least_squares")).status.good is good


def test_several_outliers_give_a_span():
    _, record = drift(seed=3)
    y = record.y.copy()
    y[[10, 25]] += [[4.0], [-5.0]]
    tight = dataclasses.replace(DRIFT, w=hw.Uniform([0.05, 0.02]), e=hw.Uniform(0.3))
    est = hw.estimate(tight, hw.Record(record.t, y), BatchLP(point="least_squares"))
    assert [c["row"] for c in est.info["conflicts"][:2]] == [25, 10]
    assert "between t = " in est.message


def fits(model, record, rows):
    """Whether some trajectory of a model without boxes keeps these rows (kind, name, row), by linprog."""
    R = residuals(model, record)
    wide = np.full(R.b.size, np.inf)
    names = [*model.names.x, *model.names.y]
    half = np.r_[model.w.at_most * np.ones(R.nx), model.e.at_most * np.ones(R.ny)]
    for k in range(R.b.size):
        kind = "state" if R.group[k] < R.nx else "output"
        if (kind, names[R.group[k]], int(R.row[k])) in rows:
            wide[k] = half[R.group[k]]
    held = np.isfinite(wide)
    M = R.M.toarray()[held]
    found = scipy.optimize.linprog(
        np.zeros(M.shape[1]), np.vstack([M, -M]), np.r_[wide[held] + R.b[held], wide[held] - R.b[held]],
        bounds=(None, None),
    )  # fmt: skip
    return found.status == 0


def test_rows_that_contradict_each_other_are_the_fewest():
    for seed, spikes in ((3, {10: 4.0, 25: -5.0}), (2, {17: 3.0}), (4, {0: 2.0, 1: -2.0})):
        _, record = drift(seed=seed)
        y = record.y.copy()
        for row, size in spikes.items():
            y[row] += size
        tight = dataclasses.replace(DRIFT, w=hw.Uniform.unknown(at_most=[0.05, 0.02]), e=hw.Uniform(0.3))
        record = hw.Record(record.t, y)
        est = hw.estimate(tight, record, BatchLP())
        assert est.status is hw.Status.INFEASIBLE
        found = est.info["contradiction"]
        rows = [(c["kind"], c["name"], c["row"]) for c in found]
        assert [c["t"] for c in found] == [record.t[c["row"]] for c in found]
        assert any(kind == "output" and row in spikes for kind, _, row in rows)
        assert not fits(tight, record, rows)
        for left_out in rows:
            assert fits(tight, record, [row for row in rows if row != left_out])
    # rows far from the outliers are no part of it
    assert len(rows) < 12


def test_boxes_that_contradict_the_caps():
    model = dataclasses.replace(
        DRIFT, w=hw.Uniform.unknown(at_most=0.05), e=hw.Uniform.unknown(at_most=0.5), bounds=(1e3, 2e3)
    )
    _, record = drift()
    est = hw.estimate(model, record, BatchLP(point="least_squares"))
    assert est.status is hw.Status.INFEASIBLE
    assert est.info["inflation"] > 100
    assert np.all(est.x >= 1e3)
    nothing = dataclasses.replace(model, w=hw.Uniform(0.0), e=hw.Uniform(0.0))
    est = hw.estimate(nothing, record, BatchLP(point="least_squares"))
    assert est.status is hw.Status.INFEASIBLE
    assert est.info["inflation"] is None
    assert "grow" not in est.message


def test_caps_grow_until_a_trajectory_fits():
    _, record = drift(seed=4)
    tight = dataclasses.replace(DRIFT, w=hw.Uniform.unknown(at_most=[0.005, 0.002]), e=hw.Uniform.unknown(at_most=0.05))
    assert hw.estimate(tight, record, BatchLP(point="least_squares")).status is hw.Status.INFEASIBLE
    est = hw.estimate(tight, record, BatchLP(grow_caps=True)).check()
    factor = est.info["caps_grown"]
    assert np.log2(factor) == np.round(np.log2(factor))
    assert np.all(est.r <= factor * 0.05)
    # One doubling less would not have been enough.
    less = dataclasses.replace(
        tight,
        w=hw.Uniform.unknown(at_most=factor / 2 * np.array([0.005, 0.002])),
        e=hw.Uniform.unknown(at_most=factor / 2 * 0.05),
    )
    assert hw.estimate(less, record, BatchLP(point="least_squares")).status is hw.Status.INFEASIBLE
    wide = hw.estimate(DRIFT, record, BatchLP(grow_caps=True)).check()
    assert wide.info["caps_grown"] == 1.0
    # Known half-widths are facts: they do not grow.
    fact = dataclasses.replace(tight, e=hw.Uniform(1e-6), w=hw.Uniform.unknown(0.0, [1e-6, 0.0]))
    assert hw.estimate(fact, record, BatchLP(grow_caps=True)).status is hw.Status.OK
    stuck = dataclasses.replace(tight, e=hw.Uniform(1e-6), w=hw.Uniform(1e-6))
    assert hw.estimate(stuck, record, BatchLP(grow_caps=True)).status is hw.Status.INFEASIBLE


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1e6, 1e12])
def test_wild_scales(scale):
    _, record = drift(seed=5)
    base = hw.estimate(DRIFT, record, BatchLP(point="least_squares")).check()
    wide = hw.Uniform.unknown(at_most=100.0 * scale)
    model = dataclasses.replace(DRIFT, w=wide, e=wide)
    est = hw.estimate(model, hw.Record(record.t, scale * record.y), BatchLP(point="least_squares")).check()
    assert est.status is hw.Status.OK
    np.testing.assert_allclose(est.x / scale, base.x, rtol=1e-6, atol=1e-6)


def test_states_of_a_million_beside_a_thousandth():
    """Two walks, one in 1e6 and one in 1e-3: the same as two walks of size one."""
    rng = np.random.default_rng(0)
    T, unit = 60, np.array([1e6, 1e-3])
    y = np.cumsum(rng.uniform(-0.1, 0.1, (T, 2)), axis=0) + rng.uniform(-0.3, 0.3, (T, 2))
    free = hw.Uniform.unknown()
    model = hw.Linear(np.eye(2), None, np.eye(2), free, free, None)
    one = hw.estimate(model, hw.Record(np.arange(T), y), BatchLP(point="least_squares")).check()
    two = hw.estimate(model, hw.Record(np.arange(T), y * unit), BatchLP(point="least_squares")).check()
    np.testing.assert_allclose(two.x / unit, one.x, atol=1e-6)
    np.testing.assert_allclose(two.r / unit, one.r, atol=1e-6)
    assert np.all(two.r > 0)


def test_positions_far_from_the_origin():
    _, record = drift(seed=6)
    near = hw.estimate(DRIFT, record, BatchLP(point="least_squares")).check()
    far = hw.estimate(DRIFT, hw.Record(record.t, record.y + 1e7), BatchLP(point="least_squares")).check()
    np.testing.assert_allclose(far.x - [1e7, 0.0], near.x, atol=1e-6)
    assert far.info["objective"] == pytest.approx(near.info["objective"], rel=1e-6)


def test_zero_width_boxes():
    _, record = drift(seed=7)
    fixed = dataclasses.replace(DRIFT, x0=hw.Box([0.5, 0.1], [0.5, 0.1]))
    est = hw.estimate(fixed, record, BatchLP(point="least_squares")).check()
    np.testing.assert_allclose(est.info["x0"], [0.5, 0.1], atol=1e-12)
    thin = dataclasses.replace(DRIFT, bounds=([-INF, 0.1], [INF, 0.1 + 1e-13]))
    est = hw.estimate(thin, record, BatchLP(point="least_squares")).check()
    assert np.all(np.abs(est.x[:, 1] - 0.1) <= 1e-12)


def test_half_widths_on_a_cap_and_on_a_floor_are_named():
    _, record = drift(seed=8)
    model = dataclasses.replace(DRIFT, w=hw.Uniform.unknown(at_least=0.5), e=hw.Uniform.unknown(at_most=0.05))
    est = hw.estimate(model, record, BatchLP(point="least_squares")).check()
    notes = " | ".join(est.info["notes"])
    assert "half-width on its floor: q[p]" in notes or "half-width on its floor: q[p], q[v]" in notes
    assert np.all(est.q >= 0.5)
    assert est.r[0] <= 0.05


def test_never_seen_output_is_named_and_costs_nothing():
    two = hw.Linear([[1.0]], None, [[1.0], [1.0]], UNKNOWN, UNKNOWN, None)
    y = np.c_[np.arange(20.0), np.full(20, np.nan)]
    est = hw.estimate(two, hw.Record(np.arange(20.0), y), BatchLP(point="least_squares")).check()
    assert "r[y1]" in " ".join(est.info["notes"])
    assert est.r[1] == 0.0


def test_info_is_complete():
    model, record, _ = draw(9)
    est = hw.estimate(model, record, BatchLP(point="least_squares"))
    info = est.info
    assert set(info["check"]) == {"primal", "dual", "gap", "complementarity"}
    assert info["solver"] == "piqp"
    assert info["iterations"] > 0
    assert info["w"].shape == est.x.shape
    assert info["e"].shape == record.y.shape
    np.testing.assert_allclose(
        info["e"][record.seen.all(axis=1)],
        (record.y @ model.F.single.T - est.x @ model.C.single.T)[record.seen.all(axis=1)],
        atol=1e-12,
    )
    assert np.all(np.isnan(info["e"][~record.seen]))
    np.testing.assert_array_equal(info["rows"], np.r_[[30.0] * 3, record.seen.sum(axis=0)])
    assert np.all(info["redundancy"] <= info["rows"])
    assert est.method == "BatchLP(point='least_squares')"


def test_redundancy_counts_the_degrees_of_freedom():
    """All groups together leave as many rows' worth of noise as there are outputs beyond the states."""
    totals = []
    for seed in range(30):
        model, record, _ = draw(seed, T=40, lost=0.0)
        totals.append(hw.estimate(model, record, BatchLP(point="optimal")).info["redundancy"].sum())
    assert np.mean(totals) == pytest.approx(2 * 40 - 3, rel=0.1)


def _by_highs(A, C, y, prior, box, cap):
    """The paper's program with a dense matrix and nothing scaled: its optimal value."""
    from scipy.optimize import linprog

    (T, ny), nx = y.shape, len(A)
    n = nx * (T + 1)
    rows, right = [], []
    for t in range(T):
        now, before = slice(nx * (t + 1), nx * (t + 2)), slice(nx * t, nx * (t + 1))
        blocks = [(np.eye(nx)[i], -A[i], n + i, 0.0) for i in range(nx)]
        blocks += [(C[j], np.zeros(nx), n + nx + j, y[t, j]) for j in np.flatnonzero(~np.isnan(y[t]))]
        for one, other, width, value in blocks:
            for sign in (1.0, -1.0):
                row = np.zeros(n + nx + ny)
                row[now], row[before], row[width] = sign * one, sign * other, -1.0
                rows.append(row)
                right.append(sign * value)
    ends = [(-end, end) for end in prior] + [(-box, box)] * (nx * T) + [(0, cap)] * (nx + ny)
    return linprog(np.r_[np.zeros(n), np.ones(nx + ny)], np.array(rows), np.array(right), bounds=ends).fun


def test_small_random_programs_also_of_growing_models_and_of_data_that_fit_exactly():
    rng = np.random.default_rng(5)
    unknown = hw.Uniform.unknown(0, 5)
    for _ in range(40):
        nx, ny, T = rng.integers(1, 4), rng.integers(1, 3), rng.integers(1, 8)
        A, C, y = rng.normal(size=(nx, nx)), rng.normal(size=(ny, nx)), rng.normal(size=(T, ny))
        y[rng.random(y.shape) < 0.3] = np.nan
        model = hw.Linear(A, None, C, unknown, unknown, hw.Box(-3, 3), bounds=(-10, 10))
        est = hw.estimate(model, hw.Record(np.arange(T), y), hw.BatchLP(objective="paper", point="optimal")).check()
        np.testing.assert_allclose(est.q.sum() + est.r.sum(), _by_highs(A, C, y, [3] * nx, 10, 5), rtol=1e-5, atol=1e-5)


def test_data_that_fit_exactly_outside_of_the_prior():
    unknown = hw.Uniform.unknown(0, 5)
    car = hw.Linear([[1, 1], [0, 1]], None, [[1, 0]], unknown, unknown, hw.Box([-3, -0.1], [3, 0.1]))
    y = 2.0 * np.arange(4.0)
    est = hw.estimate(car, hw.Record(np.arange(4), y), hw.BatchLP(objective="paper", point="optimal")).check()
    best = _by_highs(car.A.single, car.C.single, y[:, None], [3, 0.1], np.inf, 5)
    np.testing.assert_allclose(est.q.sum() + est.r.sum(), best, rtol=1e-5)
    assert best > 1.0


def test_growing_caps_is_advised_only_where_there_are_caps():
    record = hw.Record([0, 1, 2], [0.0, 5.0, 0.0])
    for noise, advised in ((hw.Uniform(0.1), False), (hw.Uniform.unknown(at_most=0.1), True)):
        walk = hw.Linear([[1]], None, [[1]], noise, noise, hw.Box(-1, 1))
        est = hw.estimate(walk, record, hw.BatchLP())
        assert est.status is hw.Status.INFEASIBLE
        assert ("grow_caps" in est.info["hint"]) == advised


def worst_rows(model, record, cost, nu):
    """The elastic program row by row, solved by SciPy: sum c_j (s_j + sum_k max(|rho_k| - s_j, 0) / (nu N_j))."""
    from scipy.optimize import linprog

    rows = residuals(model, record)
    M, S = rows.M.toarray(), rows.S.toarray()
    K, n, p = *M.shape, S.shape[1]
    rho = rows.at(np.zeros(n))
    price = (S * (cost / (nu * np.maximum(rows.count, 1)))).sum(axis=1)
    G = np.block([[M, -S, -np.eye(K)], [-M, -S, -np.eye(K)]])
    ends = [(None, None)] * n + [(0, None)] * (p + K)
    found = linprog(np.r_[np.zeros(n), cost, price], A_ub=G, b_ub=np.r_[-rho, rho], bounds=ends, method="highs")
    assert found.status == 0
    return found.fun


@pytest.mark.parametrize("nu", [0.02, 0.1, 0.5, 1.0])
def test_the_mean_of_the_worst_rows_is_least(nu):
    model, record, _ = draw(3, F=False, T=25)
    est = hw.estimate(model, record, BatchLP(nu=nu, objective="paper", point="optimal"))
    assert est.status.good
    rows = residuals(model, record)
    s = np.r_[est.q, est.r]
    rho = np.abs(rows.at(np.r_[est.info["x0"], est.x.ravel()]))
    over = np.maximum(rho - rows.S @ s, 0.0)
    value = s.sum() + (over / (nu * (rows.S @ np.maximum(rows.count, 1)))).sum()
    assert value == pytest.approx(worst_rows(model, record, np.ones(s.size), nu), rel=1e-6)


def outlying(nu, point="central"):
    """A smooth walk with two outputs far off."""
    rng = np.random.default_rng(0)
    unknown = hw.Uniform.unknown(at_most=1000.0)
    model = hw.Linear([[1, 1], [0, 1]], None, [[1, 0]], unknown, unknown, None, names=["p", "v"])
    truth = np.cumsum(np.cumsum(rng.uniform(-0.1, 0.1, 80)))
    y = truth + rng.uniform(-0.5, 0.5, 80)
    y[[20, 50]] += 15.0
    est = hw.estimate(model, hw.Record(range(80), y), BatchLP(nu=nu, point=point))
    assert est.status.good
    return est, np.abs(est.x[:, 0] - truth).mean()


@pytest.mark.parametrize("point", ["central", "optimal"])
def test_outliers_are_named_and_do_not_set_the_half_width(point):
    plain, far = outlying(None, point)
    est, near = outlying(0.1, point)
    assert near < 0.3 * far
    assert est.r[0] < 0.4 * plain.r[0]
    worst = est.info["beyond"][:2]
    assert {row["row"] for row in worst} == {20, 50}
    assert all(row["kind"] == "output" and row["excess"] > 10 for row in worst)
    assert "beyond" not in plain.info


def test_a_tiny_share_is_the_worst_row():
    plain, tiny = outlying(None, "optimal")[0], outlying(1e-4, "optimal")[0]
    np.testing.assert_allclose(np.r_[tiny.q, tiny.r], np.r_[plain.q, plain.r], atol=1e-4)


def test_known_half_widths_are_kept_where_the_others_are_elastic():
    model, record, _ = draw(2, E=False, F=False, T=30)
    known = dataclasses.replace(model, w=hw.Uniform(np.full(3, 0.31)))
    est = hw.estimate(known, record, BatchLP(nu=0.2))
    assert est.status.good
    assert np.abs(est.info["w"]).max() <= 0.31 * (1 + 1e-3)


@pytest.mark.parametrize("T", [1, 2])
def test_elastic_programs_of_a_row_or_nothing_seen(T):
    model, record, _ = draw(1, E=False, F=False, T=T)
    blind = hw.Record(record.t, np.full_like(record.y, np.nan), record.u)
    for one in (record, blind):
        est = hw.estimate(model, one, BatchLP(nu=0.3))
        assert np.isfinite(est.x).all()


def test_what_elastic_programs_refuse():
    for wrong in ({"nu": 0.0}, {"nu": 1.5}, {"nu": 0.3, "objective": "log"}, {"nu": 0.3, "point": "least_squares"}):
        with pytest.raises(hw.errors.BadValue, match="`nu`"):
            BatchLP(**wrong)
    model, record, _ = draw(1)
    with pytest.raises(hw.errors.Refused, match="of their own noise"):
        hw.estimate(model, record, BatchLP(nu=0.3))
