"""Sliding windows: what they see, what they say, and that the online form is the same."""

import dataclasses

import numpy as np
import pytest

import halfwidth as hw
from halfwidth.methods._rows import rows_since_fix, window_starts
from halfwidth.reproduce import paper003

UNKNOWN = hw.Uniform.unknown(at_most=10.0)
H = 0.1
CART = hw.Linear([[1, H], [0, 1]], [[H * H / 2], [H]], [[1, 0]], UNKNOWN, UNKNOWN, None, dt=H)


def cart(T, seed=0, q=(0.002, 0.005), r=0.3):
    true = dataclasses.replace(CART, w=hw.Uniform(q), e=hw.Uniform(r), x0=hw.Box([0, 0], [0, 0]))
    return hw.simulate(true, np.sin(np.arange(T) / 30), seed=seed)


def test_a_window_is_the_batch_on_its_rows():
    _, record = cart(60)
    method = hw.BatchLP(objective="paper", point="optimal")
    est = hw.estimate(CART, record, hw.Window(method, memory=10)).check()
    for t in (0, 5, 20, 59):
        a = max(0, t - 10)
        part = hw.Record(record.t[a : t + 1], record.y[a : t + 1], record.u[a : t + 1])
        alone = hw.estimate(CART, part, method)
        assert est.info["q"][t].sum() + est.info["r"][t].sum() == pytest.approx(
            alone.info["objective"], rel=1e-6, abs=1e-9
        )


def test_the_general_way_and_the_fast_way_agree():
    _, record = cart(40)
    method = hw.BatchLP(objective="paper", point="optimal")
    window = hw.Window(method, memory=8)
    fast = window.run(CART, record)
    slow = window._each(CART, record)
    np.testing.assert_allclose(
        fast.info["q"].sum(axis=1) + fast.info["r"].sum(axis=1), slow.s.sum(axis=1), rtol=1e-6, atol=1e-9
    )


def test_windows_stretch_until_every_output_has_fixes():
    seen = np.ones((40, 2), bool)
    seen[10:30, 0] = False
    seen[:, 1] = np.arange(40) % 7 == 0
    start = window_starts(seen, 5, fixes=3)
    some = seen.any(axis=1)
    for t in range(40):
        held = seen[start[t] : t + 1].sum(axis=0)
        before = seen[: t + 1].sum(axis=0)
        assert np.all(held >= np.minimum(3, before))
        assert some[start[t] : t + 1].sum() >= min(6, some[: t + 1].sum())
        assert start[t] <= max(0, t - 5)
    assert np.all(np.diff(start) >= 0)
    full = np.ones((40, 2), bool)
    for fixes in (0, 10):
        np.testing.assert_array_equal(window_starts(full, 5, fixes=fixes), np.maximum(0, np.arange(40) - 5))
    assert np.all(window_starts(~full, 5) == 0)
    # Rows that nothing is seen in do not count, rows in which another output is lost do.
    some = window_starts(seen[:, :1], 5, fixes=0)
    np.testing.assert_array_equal(some[[29, 30, 34, 35]], [4, 5, 9, 30])
    assert np.all(np.arange(40) - window_starts(seen, 5, stretch=8) < 8)
    np.testing.assert_array_equal(rows_since_fix(np.array([[False], [True], [False], [False]])), [1, 0, 1, 2])


@pytest.mark.parametrize("q", [(0.002, 0.005), (0.02, 0.05)])
def test_an_outage_longer_than_the_memory(q):
    """60 s at 10 Hz with a memory of 25 rows: completes, says that it extrapolates, and takes up again."""
    for seed in range(6):
        truth, record = cart(1000, seed=seed, q=q)
        lost = record.without(20.0, 80.0)
        est = hw.estimate(CART, lost, hw.Window(hw.BatchLP(), memory=25)).check()
        out = est.info["extrapolated"]
        np.testing.assert_array_equal(out, ~lost.seen[:, 0])
        assert "extrapolate" in est.message
        gap = np.flatnonzero(out)
        back = gap[-1] + 1
        error = np.abs(est.x - truth.x)
        assert error[back : back + 5, 0].mean() < 0.25
        assert error[back + 30 :, 0].mean() < 0.1
        # Without a fix nothing is learned: the estimate moves on along the model.
        A, B = np.array([[1, H], [0, 1]]), np.array([H * H / 2, H])
        np.testing.assert_allclose(est.x[gap], est.x[gap - 1] @ A.T + lost.u[gap] * B, atol=1e-12)
        assert np.all(est.info["iterations"][gap] == 0)
        # The jump on re-acquisition is within the interval that the last row without a fix states, on line ...
        jump = np.abs(est.x[back] - est.x[back - 1])
        lo, hi = hw.ensemble_interval(est, newest=True)
        assert np.all(jump <= (hi - lo)[back - 1])
        assert np.all((est.x[back] >= lo[back - 1] - 1) & (est.x[back] <= hi[back - 1] + 1))
        # ... and within the one that the windows on its far side leave of it.
        lo, hi = hw.ensemble_interval(est)
        step = np.abs(est.info["smoothed"][back] - est.info["smoothed"][back - 1])
        assert np.all(jump <= (hi - lo)[back - 1] + step + 0.5)
        assert np.all(est.info["windows"][gap] > back - gap)


def test_an_interval_in_an_outage_grows_and_mostly_holds():
    held = []
    for seed in range(8):
        truth, record = cart(600, seed=seed)
        lost = record.without(20.0, 50.0)
        est = hw.estimate(CART, lost, hw.Window(hw.BatchLP(), memory=25))
        lo, hi = hw.ensemble_interval(est, newest=True)
        gap = np.flatnonzero(est.info["extrapolated"])
        assert np.all(np.diff((hi - lo)[gap], axis=0) > 0)
        held.append(((truth.x >= lo) & (truth.x <= hi))[gap].mean())
    assert np.mean(held) > 0.9


@pytest.mark.parametrize("carry", [None, 2.0])
@pytest.mark.parametrize(
    "method",
    [
        hw.BatchLP(), hw.BatchLP(point="optimal"), hw.BatchLP(objective="paper", point="optimal"),
        hw.SequentialLP(rounds=1), hw.SequentialLP(rounds=2, point="optimal"),
    ],
)  # fmt: skip
def test_stream_follows_the_batch_and_resumes(method, carry):
    _, record = cart(70)
    lost = record.without(3.0, 4.5)
    window = hw.Window(method, memory=10, carry=carry)
    est = hw.estimate(CART, lost, window)
    live = hw.stream(CART, window)
    lo, hi = hw.ensemble_interval(est, newest=True)
    flat = isinstance(method, hw.BatchLP) and method.point == "optimal"  # optimal points are no single point
    for t in range(70):
        newest = live.push(lost.y[t], lost.u[t])
        assert newest.info["extrapolated"] == est.info["extrapolated"][t]
        total = est.info["q"][t].sum() + est.info["r"][t].sum()
        assert newest.q.sum() + newest.r.sum() == pytest.approx(total, rel=1e-3 if carry and flat else 1e-6, abs=1e-7)
        if not flat:
            np.testing.assert_allclose(newest.x[0], est.x[t], rtol=1e-6, atol=1e-8)
            ends = hw.ensemble_interval(newest, newest=True)
            np.testing.assert_allclose(ends, (lo[t : t + 1], hi[t : t + 1]), rtol=1e-5, atol=1e-7)
        if t in (5, 35, 50):
            live = hw.resume(live.snapshot(), CART)
            again = hw.resume(live.snapshot(), CART)
            for k in range(t + 1, t + 4):
                np.testing.assert_array_equal(again.push(lost.y[k], lost.u[k]).x, live.push(lost.y[k], lost.u[k]).x)
            live = hw.resume(hw.stream(CART, window).snapshot(), CART)
            for k in range(t + 1):
                live.push(lost.y[k], lost.u[k])
    assert newest.x.shape == (1, 2)


def test_what_a_window_forgets_it_forgets():
    """An optimum must not depend on the windows before, beyond its tolerance."""
    drawn = paper003.draw(4, correlated=False, rows=400)
    model = paper003.system(unknown=False, correlated=False)
    window = hw.Window(hw.BatchLP(objective="paper", point="optimal"), memory=25, fixes=0)
    whole = window.run(model, drawn.record)
    for a in (100, 173):
        late = hw.Record(drawn.record.t[a:], drawn.record.y[a:], drawn.record.u[a:])
        free = dataclasses.replace(model, x0=paper003.BOX)
        part = window.run(free, late)
        total = [np.hstack([e.info["q"], e.info["r"]]).sum(axis=1) for e in (whole, part)]
        np.testing.assert_allclose(total[1][25:], total[0][a + 25 :], rtol=1e-7, atol=1e-9)


def test_unknown_entries_on_line():
    drawn = paper003.draw(0, rows=300)
    est = hw.estimate(
        paper003.system(unknown=True), drawn.record, hw.Window(hw.SequentialLP(rounds=1, objective="paper"), memory=25)
    ).check()
    assert est.theta.shape == (4,)
    assert np.all((est.info["theta"][30:] >= 0) & (est.info["theta"][30:] <= 1))
    assert abs(np.mean(est.info["theta"][30:, 3]) - 0.4) < 0.2
    assert np.abs(est.x - drawn.x)[30:].mean() < 0.1


def test_ensemble_interval():
    drawn = paper003.draw(0, correlated=False, rows=300)
    model = paper003.system(unknown=False, correlated=False)
    est = paper003.lsu(drawn, 25, model)
    lo, hi = hw.ensemble_interval(est, kappa=2.0)
    narrow = hw.ensemble_interval(est, kappa=1.0)
    done = slice(0, 300 - 25)
    assert np.all(hi[done] >= lo[done])
    np.testing.assert_allclose((hi - lo)[done], 2 * (narrow[1] - narrow[0])[done], atol=1e-12)
    inside = (drawn.x[done] >= lo[done]) & (drawn.x[done] <= hi[done])
    assert inside.mean() > 0.8
    assert np.isnan(lo[-1]).all()
    with pytest.raises(hw.Refused):
        hw.ensemble_interval(hw.estimate(model, drawn.record, hw.BatchLP()))


def test_carry_bounds_the_first_state():
    drawn = paper003.draw(0, correlated=False, rows=200)
    model = paper003.system(unknown=False, correlated=False)
    free = hw.Window(hw.BatchLP(point="optimal"), memory=10).run(model, drawn.record)
    held = hw.Window(hw.BatchLP(point="optimal"), memory=10, carry=3.0).run(model, drawn.record).check()
    width = [np.mean((e.info["high"] - e.info["low"])[:-12]) for e in (free, held)]
    assert width[1] < width[0]
    assert np.abs(held.x - drawn.x).mean() < 0.12


def test_every_window_is_solved():
    for memory in (5, 25):
        drawn = paper003.draw(3, correlated=False, rows=1000)
        est = paper003.lsu(drawn, memory, paper003.system(unknown=False, correlated=False))
        assert est.info["unsolved"] == []


def test_sensors_at_several_rates():
    """A slow sensor's entries stay in the window, and each of the rows between is an estimate."""
    both = hw.Linear(CART.A.value, CART.B.value, np.eye(2), UNKNOWN, UNKNOWN, None, dt=H)
    true = dataclasses.replace(both, w=hw.Uniform([0.002, 0.005]), e=hw.Uniform([0.3, 0.05]), x0=hw.Box([0, 0], [0, 0]))
    truth, record = hw.simulate(true, np.sin(np.arange(300) / 30), seed=4)
    y = record.y.copy()
    y[np.arange(300) % 10 != 0, 0] = np.nan  # fixes at 1 Hz
    y[np.arange(300) % 2 != 0, 1] = np.nan  # speed at 5 Hz
    slow = hw.Record(record.t, y, record.u)
    window = hw.Window(hw.BatchLP(), memory=10, fixes=4)
    est = hw.estimate(both, slow, window).check()
    for t in range(60, 300):
        held = slow.seen[est.info["start"][t] : t + 1].sum(axis=0)
        assert held[0] >= 4
        assert held[1] >= 11
    np.testing.assert_array_equal(est.info["extrapolated"], np.arange(300) % 2 == 1)
    assert np.abs(est.x - truth.x)[60:, 0].mean() < 0.15
    live = hw.stream(both, window)
    for t in range(120):
        newest = live.push(slow.y[t], slow.u[t])
        np.testing.assert_allclose(newest.x[0], est.x[t], rtol=1e-6, atol=1e-8)


def test_theta_drifts_through_a_window():
    T = 160
    true = np.linspace(0.3, 0.7, T)
    x, u, rng = np.zeros(T + 1), np.random.default_rng(0).uniform(-1, 1, T), np.random.default_rng(1)
    for t in range(T):
        x[t + 1] = true[t] * x[t] + u[t] + rng.uniform(-0.01, 0.01)
    small = hw.Uniform.unknown(at_most=1.0)
    model = hw.Linear([[np.nan]], [[1]], [[1]], small, small, None, theta_bounds=(0, 1))
    record = hw.Record(np.arange(float(T)), x[1:] + rng.uniform(-0.01, 0.01, T), u)
    error = []
    for drift in (None, 0.2):
        inner = hw.SequentialLP(rounds=1, drift=drift)
        est = hw.estimate(model, record, hw.Window(inner, memory=40)).check()
        error.append(np.abs(est.info["theta"][50:, 0] - true[50:]).mean())
    assert error[1] < 0.7 * error[0]  # the newest value, not the mean of the window
    assert error[1] < 0.04


def test_choose_memory():
    _, record = cart(200)
    choice = hw.choose_memory(CART, record, memories=(3, 10, 20))
    assert choice.best in (3, 10, 20)
    assert np.isfinite(choice.score).all()
    pytest.importorskip("matplotlib").use("Agg")
    assert choice.plot() is not None


@pytest.mark.parametrize(
    "settings",
    [{"memory": 0}, {"carry": -1.0}, {"fixes": -1}, {"memory": 5, "stretch": 3}, {"method": hw.BatchLP}],
)
def test_bad_settings(settings):
    with pytest.raises(hw.BadValue):
        hw.Window(**({"method": hw.BatchLP()} | settings))


def test_refuses_what_the_method_inside_refuses():
    gaussian = dataclasses.replace(CART, w=hw.Gaussian(1.0), e=hw.Gaussian(1.0))
    with pytest.raises(hw.Refused, match="uniform"):
        hw.estimate(gaussian, cart(5)[1], hw.Window(hw.BatchLP()))


@pytest.mark.parametrize("nonlinear", [False, True])
def test_outputs_near_the_largest_number_fit_nothing_and_warn_of_nothing(nonlinear):
    unknown = hw.Uniform.unknown(at_most=3.0)
    y = 1e300 * np.sin(np.arange(20.0))
    if nonlinear:
        model = hw.Nonlinear(lambda x: 0.9 * x, lambda x: x**2, unknown, unknown, hw.Normal([1.0], 1.0))
        est = hw.estimate(model, hw.Record(np.arange(20.0), y), hw.Posterior(nodes=8))
    else:
        model = hw.Linear([[0.9]], None, [[1]], unknown, unknown, hw.Box([-1], [1]))
        est = hw.estimate(model, hw.Record(np.arange(20.0), y), hw.Window(hw.Posterior(nodes=8), memory=5))
    assert est.status is hw.Status.INFEASIBLE
    assert np.isfinite(est.x).all()
