"""Pushes of `Window(Posterior())`: what is kept from one to the next changes no answer."""

import gc
import tracemalloc

import numpy as np
import pytest
from tests.naive_stream import Twin

import halfwidth as hw
from halfwidth.methods._sites import sites

A = np.array([[1, -0.5, 0.2], [0.5, 0.1, 0], [0.3, 0, -0.1]])
B = np.array([[0.5], [-0.2], [0.1]])
C = np.array([[1, 0, 0.5], [0, 1, 0.5]])
E = np.array([[1, 0.3, 0.1], [0, 1, 0.2], [0, 0, 1]])
F = np.array([[1, 0.4], [0, 1]])
UNKNOWN = hw.Uniform.unknown(at_most=3.0)
BOX = hw.Box(-2 * np.ones(3), 2 * np.ones(3))
EPS = hw.Gaussian(0.001)
T = 26


def model(w=UNKNOWN, e=UNKNOWN, x0=BOX, bounds=BOX, A=A, **more):
    return hw.Linear(A, B, C, w, e, x0, bounds=bounds, **more)


def drawn(T, seed, missing=0.0):
    rng = np.random.default_rng(seed)
    x, y, u = np.zeros(3), [], rng.uniform(-1, 1, (T, 1))
    for t in range(T):
        x = A @ x + B @ u[t] + rng.uniform(-0.1, 0.1, 3)
        y.append(C @ x + rng.uniform(-0.3, 0.3, 2))
    y = np.array(y)
    y[rng.random(y.shape) < missing] = np.nan
    return y, u


def bent(x, u):
    return np.array([0.9 * x[0] - 0.5 * np.sin(x[1]) + 0.5 * u[0], 0.5 * x[0] + 0.1 * x[1], 0.3 * x[0] - 0.1 * x[2]])


def sometimes(y):
    y[:, 1] = np.where(np.arange(len(y)) % 4 == 0, y[:, 1], np.nan)


def gap(y):
    y[12:19] = np.nan


def wild(y):
    y[14, 0] += 4.0


def late(y):
    y[:3] = np.nan


STACK = A + 0.05 * np.random.default_rng(5).standard_normal((T, 3, 3))
CASES = {  # model, window, share missing, what happens
    "plain": (model(), {}, 0.0, None),
    "missing": (model(), {}, 0.2, None),
    "correlated": (model(E=E, F=F), {}, 0.0, None),
    "correlated, missing": (model(E=E, F=F), {}, 0.2, None),
    "mixed": (model(hw.Uniform(0.1), UNKNOWN + EPS, F=F), {}, 0.1, None),
    "variances": (model(UNKNOWN, hw.Gaussian.unknown(at_least=1e-6, at_most=1.0)), {}, 0.1, None),
    "known": (model(hw.Uniform(0.1), hw.Uniform(0.3)), {}, 0.0, None),
    "gaussian": (model(EPS, hw.Gaussian([[0.03, 0.01], [0.01, 0.03]]), hw.Normal(np.zeros(3), 1.0), None), {}, 0.2, None),
    "outliers": (model(), {"outliers": True}, 0.0, wild),
    "gap": (model(), {}, 0.0, gap),
    "late": (model(), {"stretch": 9}, 0.0, late),
    "sometimes": (model(), {"fixes": 5}, 0.0, sometimes),
    "infeasible": (model(hw.Uniform.unknown(at_most=0.12), hw.Uniform.unknown(at_most=0.4)), {}, 0.0, wild),
    "no bounds": (model(bounds=None), {}, 0.0, None),
    "no box": (model(x0=None, bounds=None), {"memory": 5}, 0.0, None),
    "half open": (model(x0=hw.Box([-1, -np.inf, -np.inf], [np.inf, np.inf, 2.0])), {"memory": 5}, 0.0, None),
    "half-spaces": (model(bounds=hw.Halfspaces([[1, 1, 0], [0, 1, -1]], [-3, -3], [3, np.inf])), {}, 0.0, None),
    "lag": (model(), {"lag": 4}, 0.1, None),
    "short recall": (model(), {"recall": 0.5}, 0.0, None),
    "varying": (model(A=STACK), {}, 0.0, None),
    "of dt": (model(A=lambda t, dt: A * dt), {"memory": 5}, 0.0, None),
    "nonlinear": (hw.Nonlinear(bent, lambda x: C @ x, UNKNOWN, UNKNOWN, BOX, nu=1, bounds=BOX), {"memory": 4}, 0.0, None),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_push_is_the_window_on_its_own(name):
    asked, settings, missing, happens = CASES[name]
    rows = 10 if name == "nonlinear" else T
    y, u = drawn(rows, 3, missing)
    if happens:
        happens(y)
    settings = {"memory": 8} | settings
    method = hw.Posterior(nodes=16, outliers=settings.pop("outliers", False))
    twin = Twin(hw.stream(asked, hw.Window(method, **settings)))
    dt = np.random.default_rng(1).uniform(0.8, 1.2, rows) if name == "of dt" else np.ones(rows)
    statuses = set()
    for k in range(rows):
        answer, newest = twin.push(y[k], u[k], dt[k])
        back = min(settings.get("lag", 0), k)
        whole = answer.estimate
        near = {"rtol": 1e-9, "atol": 1e-10}
        assert newest.status == whole.status
        statuses.add(newest.status)
        assert newest.t[0] == pytest.approx(twin.t[k + 1 - back])
        np.testing.assert_allclose(newest.x[0], whole.x[-1 - back], **near)
        np.testing.assert_allclose(newest.P[0], whole.P[-1 - back], **near)
        for ours, theirs in zip(newest.interval(0.8), whole.interval(0.8), strict=True):
            np.testing.assert_allclose(ours[0], theirs[-1 - back], **near)
        for ours, theirs in ((newest.q, whole.q), (newest.r, whole.r), (newest.Q, whole.Q), (newest.R, whole.R)):
            assert (ours is None) == (theirs is None or not whole.status.good)
            if ours is not None:
                np.testing.assert_allclose(ours, theirs, **near)
        for kind in ("half_widths", "variances"):
            assert (kind in newest.info) == (kind in whole.info)
            for one, of in newest.info.get(kind, {}).items():
                np.testing.assert_allclose(of, whole.info[kind][one], **near)
        assert newest.info.get("message") == whole.info.get("message")
        assert newest.info["notes"] == whole.info["notes"]
    assert (hw.Status.INFEASIBLE in statuses) == (name == "infeasible")


@pytest.mark.parametrize("name", CASES)
def test_a_frame_is_made_of_its_rows(name):
    asked, settings, missing, happens = CASES[name]
    if isinstance(asked, hw.Nonlinear):
        return
    y, u = drawn(T, 3, missing)
    if happens:
        happens(y)
    y[4] = np.nan
    record = hw.Record(np.arange(1.0, T + 1), y, u)
    outliers = settings.get("outliers", False)
    frames = {}
    for _ in range(2):  # made, and found again
        rows, whole = (sites(asked, record, outliers=outliers, frames=f) for f in (frames, None))
        for part in ("free", "floor", "cap", "count", "uniform", "fitted", "row", "output"):
            np.testing.assert_array_equal(getattr(rows.frame, part), getattr(whole.frame, part))
        assert rows.problem.keys() == whole.problem.keys()
        for part, value in rows.problem.items():
            np.testing.assert_array_equal(value, whole.problem[part], err_msg=part)
        assert rows.exact == whole.exact


def test_an_estimate_stays_as_it_was():
    y, u = drawn(80, 4)
    live = hw.stream(model(), hw.Window(hw.Posterior(nodes=16), memory=6, lag=2))

    def told(newest):
        lo, hi = newest.interval(0.9)
        widths = newest.info["half_widths"]
        parts = [newest.t, newest.x, newest.P, lo, hi, newest.q, newest.r, newest.info["newest_low"], *widths.values()]
        return np.concatenate([np.ravel(v) for v in parts])

    kept, then = [], []
    for k in range(80):
        kept.append(live.push(y[k], u[k]))
        then.append(told(kept[-1]).copy())
    np.testing.assert_array_equal([told(newest) for newest in kept], then)


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_a_stream_holds_no_more_with_time(missing):
    y, u = drawn(200, 5, missing)
    live = hw.stream(model(hw.Uniform(0.1), UNKNOWN), hw.Window(hw.Posterior(nodes=1), memory=4))
    size = []
    tracemalloc.start()
    for k in range(200):
        live.push(y[k], u[k])
        if k in (120, 199):
            gc.collect()
            size.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert size[1] < size[0] + 20_000
    rows = live._core._rows.held
    assert len(rows.times.base) < 200
    assert len(live.snapshot()) < 100_000


def test_a_snapshot_of_something_else_is_refused():
    from halfwidth import _core

    live = hw.stream(model(), hw.Window(hw.Posterior(nodes=8), memory=4))
    for y, u in zip(*drawn(6, 6), strict=True):
        live.push(y, u)
    *head, arrays = live._core._rows.carried.start.before.save()
    again = _core.EpHanded(*head, arrays)
    np.testing.assert_array_equal(again["lanes"], arrays[4])
    for wrong in ([*head, arrays[:-1]], [*head, [*arrays[:-1], arrays[0]]], [[0, 2, 1], *head[1:], arrays]):
        with pytest.raises(ValueError, match=r"`save` returned|must not fall"):
            _core.EpHanded(*wrong)
