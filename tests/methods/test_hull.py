"""Hull: as tight as the exact linear program over all data, never inside it, and honest where there is nothing."""

import dataclasses
import json
import pathlib
import subprocess
import sys

import numpy as np
import pytest
from scipy.optimize import linprog
from tests.cases import holes, oscillator

import halfwidth as hw
from halfwidth.methods import hull as family
from halfwidth.methods._bounds import interval_rows
from halfwidth.methods._boxes import stock

ROOT = pathlib.Path(__file__).parents[2]


def exact(model, record, state, upto=None):
    """Return the hull (lo, hi) of x at one state from rows 0 .. upto - 1, by one dense linear program a side."""
    T, n, m = len(record) if upto is None else upto, model.nx, model.ny
    E = np.eye(n) if model.E is None else model.E.single
    F = np.eye(m) if model.F is None else model.F.single
    rows, low, high = [], [], []
    for t in range(T):
        M = np.zeros((n + m, (T + 1) * n))
        M[:n, t * n : (t + 1) * n], M[:n, (t + 1) * n : (t + 2) * n] = -model.A.single, E
        M[n:, (t + 1) * n : (t + 2) * n] = model.C.single
        drive = np.zeros(n) if record.u is None else model.B.single @ record.u[t]
        out = F @ np.nan_to_num(record.y[t])
        use = np.r_[np.ones(n, bool), [not np.any(np.isnan(record.y[t]) & (F[j] != 0)) for j in range(m)]]
        rows.append(M[use])
        low.append(np.r_[drive - model.w.q, out - model.e.q][use])
        high.append(np.r_[drive + model.w.q, out + model.e.q][use])
    M, low, high = np.vstack(rows), np.concatenate(low), np.concatenate(high)
    box = [*zip(model.x0.lo, model.x0.hi, strict=True), *[(None, None)] * (T * n)]
    ends = []
    for sign in (1.0, -1.0):
        for j in range(n):
            c = np.zeros((T + 1) * n)
            c[state * n + j] = sign
            ends.append(sign * linprog(c, np.vstack((M, -M)), np.r_[high, -low], bounds=box, method="highs").fun)
    return np.array(ends[:n]), np.array(ends[n:])


def plant(T=40, seed=0, F=True):
    """The oscillator with bounded noise at the corners of its box, an outage and 30 % missing."""
    model = oscillator(hw.Uniform([0.1, 0.2, 0.1]), hw.Uniform([0.6, 0.8]), hw.Box(-np.ones(3), np.ones(3)))
    model = model if F else dataclasses.replace(model, F=None)
    u = np.random.default_rng(seed).standard_normal((T, 1))
    truth, record = hw.simulate(model, u, seed=seed)
    return model, truth, holes(record, seed + 1, 0.3, (15, 20))


def test_smoothed_equals_the_program_of_all_data():
    model, truth, record = plant(F=False)
    lo, hi = hw.estimate(model, record, hw.Hull()).interval()
    for state in (1, 7, 17, 25, 40):
        low, high = exact(model, record, state)
        width = high - low
        np.testing.assert_allclose(lo[state - 1], low, atol=1e-4 * width.min())
        np.testing.assert_allclose(hi[state - 1], high, atol=1e-4 * width.min())
        assert np.all(hi[state - 1] - lo[state - 1] <= 1.0001 * width)
    assert np.all((lo <= truth.x) & (truth.x <= hi))


@pytest.mark.parametrize(("method", "ratio"), [(hw.Hull(lag=0), 1.00001), (hw.Hull(10), 1.0001), (hw.Hull(5), 1.005)])
def test_filtered_is_as_tight_as_its_window_promises(method, ratio):
    model, truth, record = plant(F=False)
    lo, hi = hw.estimate(model, record, method).interval()
    widths, best = [], []
    for state in (3, 12, 18, 24, 33, 40):
        low, high = exact(model, record, state, state)
        assert np.all(lo[state - 1] <= low + 1e-8)
        assert np.all(hi[state - 1] >= high - 1e-8)
        widths.append(hi[state - 1] - lo[state - 1])
        best.append(high - low)
    assert np.mean(widths) <= ratio * np.mean(best)
    assert np.all((lo <= truth.x) & (truth.x <= hi))


def test_a_lag_lies_between_filter_and_smoother():
    model, _, record = plant()
    width = [
        np.subtract(*hw.estimate(model, record, m).interval()[::-1]) for m in (hw.Hull(10), hw.Hull(10, 5), hw.Hull())
    ]
    assert np.all(width[1] <= width[0] * (1 + 1e-6))
    assert np.all(width[2] <= width[1] * (1 + 1e-6))
    low, high = exact(dataclasses.replace(model, F=None), plant(F=False)[2], 12, 17)
    lo, hi = hw.estimate(*(plant(F=False)[k] for k in (0, 2)), hw.Hull(10, 5)).interval()
    np.testing.assert_allclose((lo[11], hi[11]), (low, high), atol=1e-3 * (high - low).min())


def test_no_violation_in_a_hundred_thousand_state_steps(bench):
    bench = bench("hull")
    steps = wrong = loose = sides = 0
    seed = 0
    while steps < 100_000:
        model, _ = bench.KINDS[seed % len(bench.KINDS)](np.random.default_rng([8, seed]))
        found = bench.one(seed, T=400 if model.nx > 2 else 200, method=hw.Hull(3 + seed % 3))
        steps, wrong, loose, sides = steps + found[0], wrong + found[1], loose + found[2], sides + found[3]
        seed += 1
    assert wrong == 0
    assert loose <= 1e-3 * sides


def test_the_study_counts_the_same_series_in_any_number_of_processes_and_goes_on_where_it_stopped(tmp_path):
    def study(name, target, processes):
        command = [sys.executable, ROOT / "benchmarks" / "hull.py", "--violations", target, "--processes", processes]
        subprocess.run([str(c) for c in (*command, "--resume", tmp_path / name)], check=True, capture_output=True)
        return {k: v for k, v in json.loads((tmp_path / name).read_text()).items() if k != "cpu_s"}

    alone = study("alone", 1400, 1)
    assert study("two", 500, 2)["state_steps"] < 1400
    assert study("two", 1400, 2) == alone
    assert alone["seed"] >= 4
    assert alone["violations"] == 0


# ---- solvers that lie --------------------------------------------------------------------------------------------------


def honest(ask):
    from halfwidth.methods._boxes import bounded

    _, y, value, *_ = bounded(ask, None, contract=False)
    return y, value


def liar(change):
    def propose(ask):
        y, value = honest(ask)
        return change(y, value, np.random.default_rng(0))

    return propose


LIARS = {
    "silent": liar(lambda y, v, r: (np.zeros_like(y), np.zeros_like(v))),
    "random": liar(lambda y, v, r: (r.standard_normal(y.shape), v)),
    "huge": liar(lambda y, v, r: (1e300 * r.standard_normal(y.shape), v)),
    "tiny": liar(lambda y, v, r: (1e-300 * y, v)),
    "half": liar(lambda y, v, r: (0.5 * y, v)),
    "doubled": liar(lambda y, v, r: (2.0 * y, v)),
    "flipped": liar(lambda y, v, r: (-y, v)),
    "late": liar(lambda y, v, r: (np.roll(y, 1, axis=1), v)),
    "swapped functionals": liar(lambda y, v, r: (y[::-1], v)),
    "not a number": liar(lambda y, v, r: (np.full_like(y, np.nan), np.full_like(v, np.nan))),
    "infinite": liar(lambda y, v, r: (np.full_like(y, np.inf), v)),
    "one number lost": liar(lambda y, v, r: (np.where(np.arange(y.size).reshape(y.shape) == 3, np.nan, y), v)),
    "noisy": liar(lambda y, v, r: (y * (1 + 0.1 * r.standard_normal(y.shape)), v)),
    "noisy a little": liar(lambda y, v, r: (y + 1e-6 * r.standard_normal(y.shape), v)),
    "too tight": liar(lambda y, v, r: (y, v - 1.0)),
    "too proud": liar(lambda y, v, r: (y, v + 1.0)),
    "cut off": liar(lambda y, v, r: (y[:, :-1], v)),
    "wrong shape": liar(lambda y, v, r: (y[0, 0, 0], v[:1])),
    "text": liar(lambda y, v, r: ("optimal", v)),
    "dynamics forgotten": liar(lambda y, v, r: (np.where(np.arange(y.shape[2]) < 3, 0.0, y), v)),
}


@pytest.mark.parametrize("name", LIARS)
def test_a_lying_solver_loosens_and_never_breaks(name):
    model, truth, record = plant(T=25)
    true_lo, true_hi = family.run(hw.Hull(5), model, record).interval()
    alone = family.run(hw.Hull(5), model, record, (LIARS[name],))
    lo, hi = alone.interval()
    assert np.all((lo <= truth.x) & (truth.x <= hi))
    slack = 1e-6 * (true_hi - true_lo).max()
    assert np.all(lo <= true_lo + slack)
    assert np.all(hi >= true_hi - slack)
    # With a second opinion it costs nothing but time, unless its claims agree with its multipliers.
    lo, hi = family.run(hw.Hull(5), model, record, (LIARS[name], stock)).interval()
    assert np.all((lo <= truth.x) & (truth.x <= hi))
    if name not in ("silent",):
        assert np.mean(hi - lo) <= 1.01 * np.mean(true_hi - true_lo)


def test_twenty_liars():
    assert len(LIARS) == 20


# ---- contradictions ----------------------------------------------------------------------------------------------------


def walk(**more):
    return hw.Linear([[1.0]], None, [[1.0]], hw.Uniform(0.25), hw.Uniform(0.5), more.pop("x0", hw.Box(-1, 1)), **more)


@pytest.mark.parametrize("method", [hw.Hull(), hw.Hull(3), hw.Hull(3, 2), hw.Hull(lag=0)])
@pytest.mark.parametrize("x0", [hw.Box(-1, 1), None])
def test_a_contradiction_names_the_rows_and_the_growth_that_reconciles(method, x0):
    y = np.zeros(12)
    y[4], y[6] = 0.5, -1.5  # two steps of 0.25 and two half-widths of 0.5 reach 1.5
    model, record = walk(x0=x0), hw.Record(np.arange(12.0), y)
    est = hw.estimate(model, record, method)
    assert est.status is hw.Status.INFEASIBLE
    assert est.spread is None
    assert not est.guaranteed
    assert np.isfinite(est.x).all()
    assert est.info["proved"]
    assert est.info["growth"] == pytest.approx(2.0 / 1.5, rel=1e-6)
    assert "between t = 4 s and t = 6 s" in est.message
    assert "grow 1.334 times" in est.message
    named = {(one.t, one.kind, one.name) for one in est.info["conflict"]}
    assert named == {
        (4.0, "output", "y0"), (5.0, "motion of", "x0"), (6.0, "motion of", "x0"), (6.0, "output", "y0")
    }  # fmt: skip
    with pytest.raises(hw.Unsolved, match="grow"):
        est.check()
    wider = dataclasses.replace(model, w=hw.Uniform(0.25 * 1.334), e=hw.Uniform(0.5 * 1.334))
    assert hw.estimate(wider, record, method).check().guaranteed
    tight = dataclasses.replace(model, w=hw.Uniform(0.25 * 1.333), e=hw.Uniform(0.5 * 1.333))
    assert hw.estimate(tight, record, method).status is hw.Status.INFEASIBLE


def test_touching_is_not_a_contradiction():
    """Numbers that binary fractions hold: the set is one point, and it is found."""
    y = [0.0, 0.5 + 0.25 + 0.5]
    est = hw.estimate(walk(), hw.Record([0.0, 1.0], y), hw.Hull())
    lo, hi = est.interval()
    assert est.status.good
    assert lo[1, 0] <= 0.75 <= hi[1, 0]
    assert hi[1, 0] - lo[1, 0] <= 1e-6
    over = hw.estimate(walk(), hw.Record([0.0, 1.0], [0.0, np.nextafter(1.25, 2)]), hw.Hull())
    assert over.status.good or over.info["proved"]


def test_without_any_half_width_nothing_reconciles():
    still = dataclasses.replace(walk(), w=hw.Uniform(0.0), e=hw.Uniform(0.0))
    est = hw.estimate(still, hw.Record([0.0, 1.0], [0.25, 0.5]), hw.Hull())
    assert est.status is hw.Status.INFEASIBLE
    assert est.info["growth"] is None
    assert hw.estimate(still, hw.Record([0.0, 1.0], [0.25, 0.25]), hw.Hull()).interval()[0][1, 0] == pytest.approx(0.25)


# ---- models ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [hw.Hull(), hw.Hull(8)])
def test_a_prior_without_ends_is_found_from_the_data(method):
    """Nothing bounds the speed alone: two positions do, and a mixing C keeps contraction from seeing either."""
    mix = np.array([[1.0, 0.7], [0.4, -1.0]])
    for C in (np.eye(1, 2), mix):
        model = hw.Linear(
            [[1, 0.5], [0, 1]],
            None,
            C,
            hw.Uniform(0.05),
            hw.Uniform(0.2),
            hw.Box(-3 * np.ones(2), 3 * np.ones(2)),
            dt=0.5,
        )
        truth, record = hw.simulate(model, T=30, seed=1)
        record = holes(record, 1, 0.2)
        free = dataclasses.replace(model, x0=hw.Box(-np.inf * np.ones(2), np.inf * np.ones(2)))
        est = hw.estimate(free, record, method)
        lo, hi = est.interval()
        assert est.status.good
        assert np.isfinite(est.x).all()
        assert np.all((lo <= truth.x) & (truth.x <= hi))
        assert np.isfinite(hi - lo)[8:].all()
        wide = hw.estimate(dataclasses.replace(model, x0=hw.Box(-1e6 * np.ones(2), 1e6 * np.ones(2))), record, method)
        a, b = wide.interval()
        np.testing.assert_allclose((lo[12:], hi[12:]), (a[12:], b[12:]), atol=2e-3)


def test_entries_known_to_an_interval():
    rng = np.random.default_rng(3)
    nan = np.nan
    for seed in range(6):
        box = hw.Box([-1, -1], [1, 1])
        theta_lo, theta_hi = np.array([0.85, 0.4, 0.9, -0.02]), np.array([0.95, 0.6, 1.1, 0.02])
        uncertain = hw.Linear(
            [[nan, 0.1], [-0.1, 0.8]], [[nan], [0.0]], [[nan, 0.2]], hw.Uniform(0.05), hw.Uniform(0.2), box,
            E=[[1.0, nan], [0.0, 1.0]], theta_bounds=(theta_lo, theta_hi),
        )  # fmt: skip
        # a new number at every row
        th = np.where(rng.random((40, 4)) < 0.5, theta_lo, theta_hi)
        A = np.array([[[a, 0.1], [-0.1, 0.8]] for a in th[:, 0]])
        B = np.array([[[b], [0.0]] for b in th[:, 1]])
        C = np.array([[[c, 0.2]] for c in th[:, 2]])
        E = np.array([[[1.0, e], [0.0, 1.0]] for e in th[:, 3]])
        known = hw.Linear(A, B, C, hw.Uniform(0.05), hw.Uniform(0.2), box, E=E)
        truth, record = hw.simulate(known, rng.uniform(-1, 1, (40, 1)), seed=seed)
        record = holes(record, seed, 0.3)
        for method in (hw.Hull(), hw.Hull(6)):
            lo, hi = hw.estimate(uncertain, record, method).check().interval()
            assert np.all((lo <= truth.x) & (truth.x <= hi))
            a, b = hw.estimate(known, record, method).interval()
            assert np.all(lo <= a + 1e-9)
            assert np.all(hi >= b - 1e-9)
        # intervals of no width are numbers
        fixed = dataclasses.replace(uncertain, theta_bounds=(theta_lo, theta_lo))
        plain = dataclasses.replace(
            uncertain, A=[[0.85, 0.1], [-0.1, 0.8]], B=[[0.4], [0.0]], C=[[0.9, 0.2]], E=[[1, -0.02], [0, 1]],
            theta_bounds=None,
        )  # fmt: skip
        truth, record = hw.simulate(plain, rng.uniform(-1, 1, (30, 1)), seed=seed)
        one, two = (hw.estimate(m, record, hw.Hull()).interval() for m in (fixed, plain))
        np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-9)


def test_an_unseen_output_that_F_couples_still_leaves_what_the_others_say():
    model, truth, record = plant()
    F = model.F.single
    y = record.y.copy()
    y[5, 0], y[5, 1] = F[0] @ np.zeros(2) + 0.3, np.nan
    rows = interval_rows(model, hw.Record(record.t, y, record.u))
    # row 0 minus F01 times row 1: the second output drops out
    C = model.C.single[0] - F[0, 1] * model.C.single[1]
    half = model.e.q[0] + abs(F[0, 1]) * model.e.q[1]
    np.testing.assert_allclose((rows.C_lo[5, 0] + rows.C_hi[5, 0]) / 2, C, rtol=1e-14)
    np.testing.assert_allclose((rows.by_lo[5, 0], rows.by_hi[5, 0]), (0.3 - half, 0.3 + half), rtol=1e-14)
    lo, hi = hw.estimate(model, record, hw.Hull()).check().interval()
    assert np.all((lo <= truth.x) & (truth.x <= hi))


def test_matrices_and_steps_that_vary():
    rng = np.random.default_rng(5)
    t = np.cumsum(rng.uniform(0.05, 0.5, 40))
    model = hw.Linear(
        lambda dt: np.array([[1.0, dt], [0.0, 1.0]]), lambda dt: np.array([[dt * dt / 2], [dt]]), [[1.0, 0.0]],
        hw.Uniform([0.01, 0.05]), hw.Uniform(0.3), hw.Box([-1, -1], [1, 1]), bounds=([-50, -2.5], [50, 2.5]),
    )  # fmt: skip
    truth, record = hw.simulate(model, rng.uniform(-0.3, 0.3, (40, 1)), t=t, seed=2)
    record = holes(record, 4, 0.3, (t[10], t[20]))
    for method in (hw.Hull(), hw.Hull(6), hw.Hull(6, 3)):
        lo, hi = hw.estimate(model, record, method).check().interval()
        inside = np.abs(truth.x[:, 1]) <= 2.5
        assert np.all(((lo <= truth.x) & (truth.x <= hi))[: int(np.argmin(inside)) if not inside.all() else None])
        assert np.all(np.abs(np.r_[lo[:, 1], hi[:, 1]]) <= 2.5)


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1.0, 1e6, 1e12])
def test_scales(scale):
    model, _, record = plant(T=25)
    s = hw.Uniform
    scaled = dataclasses.replace(
        model, B=scale * model.B.single, w=s(scale * model.w.q), e=s(scale * model.e.q),
        x0=hw.Box(scale * model.x0.lo, scale * model.x0.hi),
    )  # fmt: skip
    lo, hi = hw.estimate(scaled, hw.Record(record.t, scale * record.y, record.u), hw.Hull(6)).check().interval()
    a, b = hw.estimate(model, record, hw.Hull(6)).interval()
    np.testing.assert_allclose((lo / scale, hi / scale), (a, b), rtol=1e-6, atol=1e-6)


def test_states_of_very_different_size_far_from_zero():
    model = hw.Linear(
        [[1.0, 1e-6], [0.0, 1.0]], None, [[1.0, 0.0]], hw.Uniform([1e-4, 1e2]), hw.Uniform(1e-3),
        hw.Box([4e6 - 1, -1e5], [4e6 + 1, 1e5]),
    )  # fmt: skip
    truth, record = hw.simulate(model, T=40, seed=0)
    est = hw.estimate(model, record, hw.Hull()).check()
    lo, hi = est.interval()
    assert np.all((lo <= truth.x) & (truth.x <= hi))
    assert np.all((hi - lo)[:, 0] <= 2e-3 * (1 + 1e-5))


def test_states_without_noise_are_found_exactly():
    """A constant unknown speed: the hull is a polygon in (position, speed) that all rows cut."""
    model = hw.Linear(
        [[1.0, 1.0], [0.0, 1.0]], None, [[1.0, 0.0]], hw.Uniform(0.0), hw.Uniform(0.5), hw.Box([-1, -1], [1, 1])
    )
    truth, record = hw.simulate(model, T=30, seed=3)
    # the simulated truth obeys w = 0 up to its rounding only
    model = dataclasses.replace(model, w=hw.Uniform(1e-13))
    for method, ratio in ((hw.Hull(), 1.0001), (hw.Hull(lag=0), 1.0001)):
        est = hw.estimate(model, record, method).check()
        lo, hi = est.interval()
        assert np.all((lo <= truth.x) & (truth.x <= hi))
        low, high = exact(model, record, 30)
        assert np.all((hi - lo)[-1] <= ratio * (high - low) + 1e-9)


def test_a_forecast_only_grows():
    model, _, record = plant()
    ahead = hw.forecast(model, record, 12, u=np.zeros((12, 1)), method=hw.Hull())
    lo, hi = ahead.interval()
    assert ahead.guaranteed
    free = hw.Record(np.arange(1, 13) + record.t[-1], np.full((12, 2), np.nan), np.zeros((12, 1)))
    last = hw.estimate(model, record, hw.Hull())
    box = hw.Box(last.spread.lo[-1], last.spread.hi[-1])
    a, b = hw.estimate(dataclasses.replace(model, x0=box), free, hw.Hull()).interval()
    assert np.all(a <= lo + 1e-7)
    assert np.all(b >= hi - 1e-7)


# ---- functionals and streams -------------------------------------------------------------------------------------------


def test_a_functional_is_bounded_as_its_own_program_says():
    model, truth, record = plant(F=False)
    c = np.array([1.0, -0.5, 2.0])
    everywhere = hw.bound(model, record, c)
    assert np.all((everywhere.lo <= truth.x @ c) & (truth.x @ c <= everywhere.hi))
    box = hw.estimate(model, record, hw.Hull()).spread
    widest = 2 * (np.abs(c) * (box.hi - box.lo) / 2).sum(axis=1)
    assert np.all(everywhere.hi - everywhere.lo <= widest * (1 + 1e-6))
    assert np.mean(everywhere.hi - everywhere.lo) < 0.95 * widest.mean()
    unit = hw.bound(model, record, [0, 1.0, 0], at=-1)
    np.testing.assert_allclose((unit.lo, unit.hi), (box.lo[-1, 1], box.hi[-1, 1]), atol=1e-6)


def test_excess_says_that_a_fix_cannot_be_and_by_how_much():
    inside = hw.Bound(-1.0, 2.0)
    assert inside.excess(2.5, 0.5) == 0.0
    assert inside.excess(3.0, 0.5) == pytest.approx(0.5)
    assert inside.excess(-2.0, 0.25) == pytest.approx(0.75)
    assert inside.excess(1.0) == 0.0
    many = hw.Bound(np.array([0.0, 0.0]), np.array([1.0, 1.0]))
    np.testing.assert_allclose(many.excess([0.5, 2.0], 0.5), [0.0, 0.5])


def test_a_stream_refuses_a_fix_before_it_is_pushed():
    model = walk()
    live = hw.stream(model, hw.Hull(memory=5))
    for y in (0.0, 0.1, None, 0.2):
        assert live.push(y).guaranteed
    where = live.bound([1.0])
    assert where.lo <= live.push(None).x[0, 0] <= where.hi
    where = live.bound([1.0])
    assert where.excess(5.0, 0.5) > 3.0
    assert where.excess(0.2, 0.5) == 0.0
    saved = live.snapshot()
    bad = live.push(5.0)
    assert bad.status is hw.Status.INFEASIBLE
    assert bad.spread is None
    assert "t = 6 s" in bad.message
    again = live.push(0.2)
    assert again.status is hw.Status.INFEASIBLE
    assert np.isfinite(again.x).all()
    with pytest.raises(hw.Unsolved):
        live.bound([1.0])
    spoilt = hw.resume(live.snapshot(), model)
    assert spoilt.push(0.2).status is hw.Status.INFEASIBLE
    fresh = hw.resume(saved, model)
    assert fresh.push(None).guaranteed
    assert fresh.push(0.2).status.good


def test_a_stream_keeps_no_more_than_it_needs():
    live = hw.stream(walk(), hw.Hull(memory=4, lag=2))
    sizes = set()
    for k in range(60):
        live.push(0.1 * (k % 3))
        if k > 20:
            sizes.add(len(live.snapshot()) // 500)
    assert max(sizes) - min(sizes) <= 1
    assert len(live._core.times) <= 8


def test_a_stream_of_stacked_matrices_ends_where_they_end():
    model = dataclasses.replace(walk(), A=np.ones((3, 1, 1)))
    live = hw.stream(model, hw.Hull(memory=4))
    for _ in range(3):
        assert live.push(0.0).status.good
    with pytest.raises(hw.BadValue, match="stacked for 3 rows"):
        live.push(0.0)


# ---- what it refuses ---------------------------------------------------------------------------------------------------


def test_refusals_name_the_reason():
    model, _, record = plant()
    ask = hw.Hull().refuses
    assert "any size" in ask(dataclasses.replace(model, w=hw.Gaussian(0.1)))
    assert "BatchLP" in ask(dataclasses.replace(model, e=hw.Uniform.unknown(at_most=1.0)))
    assert "Normal" in ask(dataclasses.replace(model, x0=hw.Normal(np.zeros(3), 1.0)))
    assert "theta_bounds" in ask(dataclasses.replace(model, A=np.full((3, 3), np.nan)))
    assert "hidden loss" in ask(dataclasses.replace(model, loss=hw.Bernoulli(0.9)))
    with pytest.raises(hw.Refused, match="no online form"):
        hw.stream(model, hw.Hull())
    with pytest.raises(hw.Refused, match="guarantees nothing"):
        hw.stream(dataclasses.replace(model.as_gaussian()), hw.KalmanFilter()).bound([1.0, 0, 0])
    for bad in ({"memory": 0}, {"memory": 2.5}, {"lag": -1}):
        with pytest.raises(hw.BadValue):
            hw.Hull(**bad)
    with pytest.raises(hw.BadShape, match="`c`"):
        hw.bound(model, record, [1.0])
    with pytest.raises(hw.BadValue, match="`at`"):
        hw.bound(model, record, [1.0, 0, 0], at=len(record))


def test_it_is_the_default_for_known_half_widths():
    model, _, record = plant()
    assert hw.estimate(model, record).method == "Hull()"
    assert hw.stream(model).push(record.y[0], record.u[0]).guaranteed


def test_half_spaces_are_rows_like_others():
    """Two cars on one road: the first stays ahead by one at least, which only the difference knows."""
    gap = hw.Halfspaces([[1.0, -1.0]], 1.0)
    model = hw.Linear(np.eye(2), None, np.eye(2), hw.Uniform(0.2), hw.Uniform(0.5), hw.Box([0, 0], [4, 4]), bounds=gap)
    y = np.array([[2.0, 1.2], [2.1, np.nan], [1.9, np.nan], [np.nan, 0.9]])
    est = hw.estimate(model, hw.Record(np.arange(4.0), y), hw.Hull()).check()
    lo, hi = est.interval()
    free = hw.estimate(dataclasses.replace(model, bounds=None), hw.Record(np.arange(4.0), y), hw.Hull())
    a, b = free.interval()
    assert np.all(lo >= a - 1e-9)
    assert np.all(hi <= b + 1e-9)
    assert np.mean(hi - lo) < 0.95 * np.mean(b - a)
    c = linprog_of_half_spaces(y)
    np.testing.assert_allclose((lo[1], hi[1]), c, atol=1e-6)
    y[2, 0], y[3, 1] = -1.0, 3.0
    bad = hw.estimate(model, hw.Record(np.arange(4.0), y), hw.Hull())
    assert bad.status is hw.Status.INFEASIBLE
    assert bad.info["proved"]


def linprog_of_half_spaces(y):
    """Return the hull of the second state by one dense program a side."""
    rows, high = [], []
    for t in range(4):
        for j in range(2):
            e = np.zeros(10)
            e[2 * (t + 1) + j], e[2 * t + j] = 1, -1
            rows += [e, -e]
            high += [0.2, 0.2]
            if np.isfinite(y[t, j]):
                e = np.zeros(10)
                e[2 * (t + 1) + j] = 1
                rows += [e, -e]
                high += [y[t, j] + 0.5, 0.5 - y[t, j]]
        e = np.zeros(10)
        e[2 * (t + 1)], e[2 * (t + 1) + 1] = -1, 1
        rows.append(e)
        high.append(-1.0)
    box = [(0, 4)] * 2 + [(None, None)] * 8
    ends = []
    for sign in (1, -1):
        for j in range(2):
            c = np.zeros(10)
            c[4 + j] = sign
            ends.append(sign * linprog(c, np.array(rows), high, bounds=box, method="highs").fun)
    return np.array(ends[:2]), np.array(ends[2:])
