"""The filter and the window for mixed noise: their limits, what they promise under adversaries, and the optimum."""

import dataclasses
import zlib

import numpy as np
import pytest
from tests.cases import CASES, constant_velocity, oscillator

import halfwidth as hw
from halfwidth import fusion
from halfwidth.methods._affine_gains import design
from halfwidth.methods._mixed_rows import mixed_rows
from halfwidth.methods.mixed import MixedBelief, prior

FORMS = ("combined", "ellipsoid", "zonotope")
LEVEL = 0.9973

#: Cart of one axis: (variance density of the noise of its acceleration, its bounded part, variance and bound of e).
SETTINGS = [(0.01, 0.05, 1.0, 1.0), (0.01, 0.02, 0.04, 1.0), (0.01, 0.02, 4.0, 0.3)]
#: Half-width, bound plus three standard deviations, of the best affine estimate of position from 40 rows.
OPTIMUM = [3.312, 1.572, 3.825]


def cart(q, d, r, e, prior=1.0):
    """Constant velocity; E turns (0, d) into the bounded acceleration d [1/2, 1]."""
    E = np.array([[1.0, -0.5], [0.0, 1.0]])
    Q = q * E @ np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]) @ E.T
    w, noise = hw.Uniform([0.0, d]) + hw.Gaussian(0.5 * (Q + Q.T)), hw.Uniform(e) + hw.Gaussian(r)
    return hw.Linear(E @ [[1.0, 1.0], [0.0, 1.0]], None, [[1.0, 0.0]], w, noise, hw.Normal(np.zeros(2), prior), E=E)


def drawn(model, d, e, seed):
    """States and record of a cart whose bounded noises are the sequences d and e."""
    rng, T = np.random.default_rng(seed), len(d)
    fold = np.linalg.inv(model.E.single)
    A = fold @ model.A.single
    w = model.w.gaussian.sample(rng, np.arange(T), np.ones(T)) + np.column_stack([np.zeros(T), d])
    noise = model.e.gaussian.sample(rng, np.arange(T), np.ones(T))[:, 0] + e
    x, state = np.empty((T, 2)), model.x0.sample(rng)
    for k in range(T):
        state = A @ state + fold @ w[k]
        x[k] = state
    return x, hw.Record(np.arange(1.0, T + 1), x[:, 0] + noise)


def adversaries(T, seed):
    """What a bounded noise may do, in units of its bound: for the state and for the output."""
    rng = np.random.default_rng(seed)
    one, wave = np.ones(T), np.where(np.arange(T) // 20 % 2 == 0, 1.0, -1.0)
    return {
        "constant": (one, one), "random": (rng.uniform(-1, 1, T), rng.uniform(-1, 1, T)), "switching": (wave, wave),
        "half": (one, 0.5 * one),
    }  # fmt: skip


# ---- limits ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kappa", [0.5, 3.0, 30.0])
@pytest.mark.parametrize("case", [c for c in CASES if c.name in ("cv", "cv irregular", "oscillator", "walk")], ids=str)
def test_without_sets_it_is_the_kalman_filter(case, form, kappa):
    want = hw.estimate(case.model, case.record, hw.KalmanFilter())
    variants = [{}] if form == "zonotope" else [{}, {"gain": "set"}, {"criterion": "width"}]
    for more in variants:
        for truncate in (False, True):
            est = hw.estimate(
                case.model, case.record, hw.MixedFilter(form=form, kappa=kappa, truncate=truncate, **more)
            )
            np.testing.assert_allclose(est.x, want.x, rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(est.spread.P, want.P, rtol=1e-10, atol=1e-10)
            np.testing.assert_array_equal(est.spread.half, 0.0)
            for a, b in zip(est.interval(), want.interval(), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("form", FORMS)
def test_tiny_sets_change_nothing(form):
    model = oscillator(hw.Gaussian([0.1, 0.2, 0.1]), hw.Gaussian([0.3, 0.4]), hw.Normal(np.zeros(3), 1.0))
    u = np.sin(np.arange(50.0))[:, None]
    _, record = hw.simulate(model, u, seed=1)
    want = hw.estimate(model, record, hw.KalmanFilter())
    near = dataclasses.replace(model, w=hw.Uniform(1e-9) + model.w, e=hw.Uniform(1e-9) + model.e)
    est = hw.estimate(near, record, hw.MixedFilter(form=form))
    np.testing.assert_allclose(est.x, want.x, atol=1e-7)
    assert est.spread.half.max() < 1e-7
    # with the gain of the sets alone the truncation brings the Kalman filter back
    if form == "ellipsoid":
        est = hw.estimate(near, record, hw.MixedFilter(form=form, gain="set", truncate=True))
        np.testing.assert_allclose(est.x, want.x, atol=1e-7)


def schweppe(rows, a_used, m, X):
    """The bounding-ellipsoid filter in information form, X+^-1 = a X^-1 + (1-a) c c' / half^2, with d = 1."""
    A, G, C, half = rows.A[0][0], rows.G[0][0], rows.C[0][0], rows.half[0][0, 0]
    means, shapes = [], []
    for t, y in enumerate(rows.y):
        moved = A @ X @ A.T
        weight = 1 / (np.diag(moved) + (G**2).sum(axis=1))
        terms = [moved, *(np.outer(g, g) for g in G.T)]
        size = [np.sqrt(weight @ np.diag(term)) for term in terms]
        m, X = (
            A @ m + (0 if rows.b is None else rows.b[t]),
            sum(size) * sum(term / s for term, s in zip(terms, size, strict=True)),
        )
        for i in range(len(y)):
            a = a_used[t, i]
            information = a * np.linalg.inv(X) + (1 - a) * np.outer(C[i], C[i]) / half[i] ** 2
            right = a * np.linalg.solve(X, m) + (1 - a) * C[i] * y[i] / half[i] ** 2
            X = np.linalg.inv(information)
            m = X @ right
        means.append(m)
        shapes.append(X)
    return np.array(means), np.array(shapes)


def bounded(T, seed=3):
    """A bounded model with its states and record."""
    model = oscillator(hw.Uniform([0.1, 0.2, 0.1]), hw.Uniform([0.6, 0.8]), hw.Box(-np.ones(3), np.ones(3)))
    truth, record = hw.simulate(model, np.sin(np.arange(T) / 5.0)[:, None], seed=seed)
    return model, truth, record


def test_without_covariances_it_is_the_filter_of_bounding_ellipsoids():
    model, _, record = bounded(40)
    for gain in ("both", "set"):
        est = hw.estimate(model, record, hw.MixedFilter(form="ellipsoid", gain=gain))
        m, X = schweppe(mixed_rows(model, record), est.info["a"], np.zeros(3), 3 * np.eye(3))
        np.testing.assert_allclose(est.x, m, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(est.info["X"], X, rtol=1e-9, atol=1e-10)
        np.testing.assert_array_equal(est.spread.P, 0.0)


@pytest.mark.parametrize("method", [hw.MixedFilter(form=f) for f in FORMS] + [
    hw.MixedFilter(form="ellipsoid", gain="set", shrink=True), hw.MixedFilter(truncate=True),
    hw.MixedFilter(form="zonotope", lag=3)], ids=repr)  # fmt: skip
def test_bounded_noise_never_leaves_the_set(method):
    """Adversaries at the corners of the box, 1e4 steps: every state lies inside, whatever the level."""
    model = oscillator(hw.Uniform([0.1, 0.2, 0.1]), hw.Uniform([0.6, 0.8]), hw.Box(-np.ones(3), np.ones(3)))
    for seed in range(4):
        rng = np.random.default_rng(seed)
        T = 2500
        hold = 1 + 30 * (seed % 2)  # corners that change at every row, or stay
        w, e = ((rng.integers(0, 2, (T // hold + 1, n)) * 2.0 - 1.0).repeat(hold, axis=0)[:T] for n in (3, 2))
        u = rng.standard_normal((T, 1))
        x, y, state = np.empty((T, 3)), np.empty((T, 2)), np.ones(3)
        for t in range(T):
            state = np.linalg.solve(model.E.single, model.A.single @ state + model.B.single @ u[t] + w[t] * model.w.q)
            x[t], y[t] = state, np.linalg.solve(model.F.single, model.C.single @ state + e[t] * model.e.q)
        y[rng.random(y.shape) < 0.2] = np.nan
        est = hw.estimate(model, hw.Record(np.arange(1.0, T + 1), y, u), method)
        lo, hi = est.interval(0.5)
        assert est.status is hw.Status.OK
        assert np.all(lo <= x + 1e-9)
        assert np.all(hi >= x - 1e-9)


def test_shrinking_makes_the_ellipsoids_smaller():
    model, truth, record = bounded(400)
    plain, shrunk = (
        hw.estimate(model, record, hw.MixedFilter(form="ellipsoid", gain="set", shrink=s)) for s in (False, True)
    )
    assert shrunk.spread.half.mean() < 0.99 * plain.spread.half.mean()
    lo, hi = shrunk.interval()
    assert np.all((lo <= truth.x) & (truth.x <= hi))


@pytest.mark.parametrize("a", [0.1, 0.35, 0.5, 0.8, None])
def test_the_scalar_case_is_the_scalar_estimator(a):
    """Set gain, truncation on: the vector code on a constant equals `halfwidth.fusion` row by row."""
    rng = np.random.default_rng(5)
    n, E, S = 60, 0.7, 1.9
    y = 3 + np.sqrt(E) * rng.uniform(-1, 1, n) + np.sqrt(S) * rng.standard_normal(n)
    belief = fusion.Source(y[0], E, S)
    for k in range(1, n):
        belief = fusion.fuse(belief, fusion.Source(y[k], E, S), None if a is None else 0.5 - a)
    noise = hw.Uniform(np.sqrt(E)) + hw.Gaussian(S)
    model = hw.Linear([[1]], None, [[1]], hw.Gaussian(0.0), noise, hw.Normal([0.0], 1.0))
    method = hw.MixedFilter(form="ellipsoid", gain="set", truncate=True, criterion="width", a=a)
    start = MixedBelief(y[:1], np.array([[S]]), np.array([[E]]), np.zeros((0, 1)))
    out = method.rows(mixed_rows(model, hw.Record(np.arange(1.0, n), y[1:])), start)
    tol = 1e-10 if a is not None else 1e-6  # a search ends where the criterion is flat
    assert out["m"][-1, 0] == pytest.approx(float(belief.m), rel=tol, abs=tol)
    assert out["P"][-1, 0, 0] == pytest.approx(float(belief.S), rel=tol)
    assert out["X"][-1, 0, 0] == pytest.approx(float(belief.E), rel=tol)


# ---- promises --------------------------------------------------------------------------------------------------------


def coverage(model, method, setting, seeds, T=80):
    """Share of rows whose position is inside, by adversary."""
    _, d, _, e = setting
    shares = {}
    for seed in seeds:
        for name, (in_state, in_output) in adversaries(T, seed).items():
            x, record = drawn(model, d * in_state, e * in_output, seed)
            lo, hi = method(model, record).interval(LEVEL)
            shares.setdefault(name, []).append(np.mean((lo[:, 0] <= x[:, 0]) & (x[:, 0] <= hi[:, 0])))
    return {name: float(np.mean(s)) for name, s in shares.items()}


@pytest.mark.parametrize("setting", SETTINGS, ids=str)
def test_coverage_under_adversaries(setting):
    """No less than the level whatever the bounded noises do; a Kalman filter that ignores them fails where they matter."""
    model, seeds, T = cart(*setting), range(12), 80
    error = 3 * np.sqrt(LEVEL * (1 - LEVEL) / (len(seeds) * T))
    for method in [hw.MixedFilter(form=f) for f in FORMS]:
        found = coverage(model, lambda m, r, method=method: method.run(m, r), setting, seeds)
        assert min(found.values()) >= LEVEL - error, (method, found)
    plain = dataclasses.replace(model, w=model.w.gaussian, e=model.e.gaussian)
    found = coverage(model, lambda _, r: hw.KalmanFilter().run(plain, r), setting, seeds)
    if setting[3] >= 1.0:
        assert min(found.values()) < LEVEL - error, found


@pytest.mark.parametrize(("setting", "optimum"), list(zip(SETTINGS, OPTIMUM, strict=True)), ids=str)
def test_half_width_beside_the_affine_optimum(setting, optimum):
    model = cart(*setting)
    record = hw.Record(np.arange(1.0, 101), np.zeros(100))

    def width(method):
        return float(hw.estimate(model, record, method).spread.plain()[1][-1, 0]) / optimum

    window = width(hw.MixedWindow(memory=40))
    assert 0.999 <= window <= 1.03
    assert window * 0.9999 <= width(hw.MixedFilter()) <= 1.05
    assert window * 0.9999 <= width(hw.MixedFilter(form="ellipsoid")) <= 1.10
    assert window * 0.9999 <= width(hw.MixedFilter(form="ellipsoid", criterion="width")) <= 1.10
    assert window * 0.9999 <= width(hw.MixedFilter(form="zonotope")) <= 1.25


def test_an_output_never_makes_the_weighted_sum_wider():
    """One state may widen, the sum of all relative to their predicted sizes does not."""
    model = oscillator(
        hw.Uniform(0.1) + hw.Gaussian(0.02), hw.Uniform(0.3) + hw.Gaussian(0.1), hw.Normal(np.zeros(3), 1.0)
    )
    model = dataclasses.replace(model, C=[[1.0, 0.0, 0.3]], e=hw.Uniform(0.3) + hw.Gaussian(0.1), F=None, names=None)
    y = np.zeros(30)
    c = model.C.single[0]
    for last in range(1, 30):
        u = np.zeros((last, 1))
        t = np.arange(1.0, last + 1)
        kept, lost = y[:last].copy(), y[:last].copy()
        lost[-1] = np.nan
        sums = []
        for record in (hw.Record(t, lost, u), hw.Record(t, kept, u)):
            est = hw.estimate(model, record, hw.MixedFilter(form="ellipsoid"))
            M = 9 * est.spread.P[-1] + est.info["X"][-1]
            if not sums:
                size, along = np.diag(M), c @ M @ c
            sums.append(np.sum(np.diag(M) / size) + 2 * (c @ M @ c) / along)
        assert sums[1] <= sums[0] * (1 + 1e-9)


def test_the_lag_narrows_the_past():
    setting = SETTINGS[0]
    model = cart(*setting)
    record = hw.Record(np.arange(1.0, 81), np.zeros(80))
    filtered = hw.estimate(model, record, hw.MixedFilter(form="zonotope"))
    for lag in (3, 10):
        smoothed = hw.estimate(model, record, hw.MixedFilter(form="zonotope", lag=lag))
        assert np.all(smoothed.spread.plain()[1][20:-lag] < 0.9 * filtered.spread.plain()[1][20:-lag])
        np.testing.assert_allclose(smoothed.x[-1], filtered.x[-1], atol=1e-12)
        np.testing.assert_allclose(smoothed.spread.half[-1], filtered.spread.half[-1], rtol=0.02)
        best = hw.estimate(model, record, hw.MixedWindow(memory=40, lag=lag))
        ratio = smoothed.spread.plain()[1][50, 0] / best.spread.plain()[1][50, 0]
        assert 1.0 - 1e-6 <= ratio <= 1.15


def test_smoothing_covers_under_adversaries():
    setting = SETTINGS[1]
    model, seeds = cart(*setting), range(6)
    for method in (hw.MixedFilter(form="zonotope", lag=8), hw.MixedWindow(memory=30, lag=8), hw.MixedWindow(memory=30)):
        found = coverage(model, lambda m, r, method=method: method.run(m, r), setting, seeds)
        assert min(found.values()) >= LEVEL - 3 * np.sqrt(LEVEL * (1 - LEVEL) / (len(seeds) * 80)), (method, found)


def test_lag_without_sets_is_the_fixed_lag_smoother():
    model = constant_velocity()
    _, record = hw.simulate(model, T=40, seed=2)
    record = record.without(2.0, 2.5)
    want = hw.estimate(model, record, hw.KalmanSmoother(lag=5))
    est = hw.estimate(model, record, hw.MixedFilter(form="zonotope", lag=5))
    np.testing.assert_allclose(est.x, want.x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(est.spread.P, want.P, rtol=1e-8, atol=1e-9)


# ---- the window ------------------------------------------------------------------------------------------------------


def errors_of(window, before, L):
    """Covariance and half-widths of x[target] - L y, from the response of everything to every noise, written out."""
    n, N = window.A.shape[1], window.rows
    response = np.zeros((n, n * (N + 1)))
    response[:, :n] = np.eye(n)
    outputs, target = [], None
    for j in range(N):
        response = window.A[j] @ response
        response[:, n * (j + 1) : n * (j + 2)] = np.eye(n)
        outputs += list((window.C[j] @ response)[window.seen[j]])
        target = response.copy() if j == window.target else target
    D = target - L @ np.array(outputs).reshape(-1, n * (N + 1))
    blocks = [D[:, n * j : n * (j + 1)] for j in range(N + 1)]
    r, half = window.r[window.seen], window.half[window.seen]
    P = blocks[0] @ before.P @ blocks[0].T + (L * r) @ L.T
    P = P + sum(d @ Q @ d.T for d, Q in zip(blocks[1:], window.Q, strict=True))
    reach = np.sqrt(np.maximum(np.diag(blocks[0] @ before.X @ blocks[0].T), 0)) + np.abs(L) @ half
    return P, reach + sum(np.abs(d @ G).sum(axis=1) for d, G in zip(blocks[1:], window.G, strict=True))


@pytest.mark.parametrize("lag", [0, 3])
def test_gains_of_the_window_are_optimal_and_its_errors_are_what_it_says(lag):
    model = oscillator(
        hw.Uniform(0.1) + hw.Gaussian(0.02), hw.Uniform(0.3) + hw.Gaussian(0.1), hw.Normal(np.zeros(3), 1.0)
    )
    y = np.random.default_rng(0).standard_normal((30, 2))
    y[[3, 17, 20]] = np.nan
    y[8, 0] = np.nan
    record = hw.Record(np.arange(1.0, 31), y, np.zeros((30, 1)))
    method = hw.MixedWindow(memory=10, lag=lag)
    est = hw.estimate(model, record, method)
    filtered = hw.MixedFilter(form="ellipsoid").rows(mixed_rows(model, record), prior(model))
    beliefs = MixedBelief(filtered["m"], filtered["P"], filtered["X"], np.zeros((0, 3)))
    rng, checked = np.random.default_rng(1), 0
    for at, window, before in method._groups(mixed_rows(model, record), prior(model), beliefs):
        found = design(window, before, 3.0)
        P, half = errors_of(window, before, found.L)
        np.testing.assert_allclose(found.P + found.D0 @ before.P @ found.D0.T, P, rtol=1e-9, atol=1e-12)
        least = half + 3 * np.sqrt(np.diag(P))
        for size in (1e-3, 1e-2, 0.1):
            P, half = errors_of(window, before, found.L + size * rng.standard_normal(found.L.shape))
            assert np.all(half + 3 * np.sqrt(np.diag(P)) >= least * (1 - 1e-7))
        # what is reported is of the belief itself, not of the rounded one
        t = int(at[0])
        if t - window.target > 0:
            k = t - window.target - 1
            before = MixedBelief(beliefs.m[k], beliefs.P[k], beliefs.X[k], before.Z)
        P, half = errors_of(window, before, found.L)
        np.testing.assert_allclose(est.spread.P[t], P, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(est.spread.half[t], half, rtol=1e-9)
        checked += 1
    assert checked > 10


def test_the_window_needs_few_designs():
    model = cart(*SETTINGS[0])
    rng = np.random.default_rng(0)
    record = hw.Record(np.arange(1.0, 401), rng.standard_normal(400))
    est = hw.estimate(model, record, hw.MixedWindow(memory=20))
    assert est.info["designs"] < 45
    y = record.y.copy()
    y[200] = np.nan
    est = hw.estimate(model, hw.Record(record.t, y), hw.MixedWindow(memory=20))
    assert est.info["designs"] < 80


# ---- models ----------------------------------------------------------------------------------------------------------


def test_full_rows_undo_F():
    """With all outputs seen and a diagonal covariance nothing of the bounds is lost to correlation."""
    model = oscillator(hw.Gaussian(0.1), hw.Uniform([0.5, 0.25]) + hw.Gaussian([0.3, 0.4]), hw.Normal(np.zeros(3), 1.0))
    rows = mixed_rows(model, hw.Record([1.0, 2.0], [[1.0, 2.0], [3.0, None]], np.zeros((2, 1))))
    C, r, half = (stack[0][stack[1]] for stack in (rows.C, rows.r, rows.half))
    np.testing.assert_allclose(C[0], model.C.single, atol=1e-12)
    np.testing.assert_allclose(r[0, 0], [0.3, 0.4])
    np.testing.assert_allclose(half[0, 0], [0.5, 0.25])
    np.testing.assert_allclose(rows.y[0], model.F.single @ [1.0, 2.0])
    fold = np.linalg.inv(model.F.single)[0]
    np.testing.assert_allclose(C[1, 0], fold @ model.C.single)
    np.testing.assert_allclose(r[1, 0, 0], fold**2 @ [0.3, 0.4])
    np.testing.assert_allclose(half[1, 0, 0], np.abs(fold) @ [0.5, 0.25])
    assert rows.seen.tolist() == [[True, True], [True, False]]


def test_any_covariance_of_the_outputs_is_made_diagonal():
    rng = np.random.default_rng(4)
    for _ in range(30):
        ny = int(rng.integers(1, 5))
        root = rng.standard_normal((ny, int(rng.integers(1, ny + 1))))
        F = np.eye(ny) + np.triu(rng.standard_normal((ny, ny)), 1)
        e = hw.Uniform(rng.random(ny)) + hw.Gaussian(root @ root.T)
        model = hw.Linear(
            np.eye(2), None, rng.standard_normal((ny, 2)), hw.Gaussian(1.0), e, hw.Normal(np.zeros(2), 1.0), F=F
        )
        y = np.where(rng.random(ny) < 0.7, 1.0, np.nan)
        rows = mixed_rows(model, hw.Record([1.0], y[None]))
        M, seen = rows.M[0][0], ~np.isnan(y)
        fold = np.linalg.inv(F)
        S = M @ np.where(np.outer(seen, seen), fold @ (root @ root.T) @ fold.T, 0.0) @ M.T
        np.testing.assert_allclose(S, np.diag(rows.r[0][0, 0]), atol=1e-10 * max(np.abs(S).max(), 1.0))
        np.testing.assert_allclose(
            rows.half[0][0, 0][seen], (np.abs(M[:, seen] @ fold[seen]) @ model.e.uniform.q)[seen]
        )


def test_the_default_for_mixed_noise():
    case = next(c for c in CASES if c.name == "oscillator mixed")
    est = hw.estimate(case.model, case.record)
    assert est.method == "MixedFilter()"
    assert isinstance(est.spread, hw.Both)
    assert est.P is None
    assert est.loglik is None
    assert not est.guaranteed
    assert hw.stream(case.model).push(case.record.y[0], case.record.u[0]).method == "MixedFilter()"
    ahead = hw.forecast(case.model, case.record, 3, u=np.zeros((3, 1)))
    assert isinstance(ahead.spread, hw.Both)
    assert ahead.spread.half.shape == (3, 3)
    np.testing.assert_array_equal(ahead.interval()[0].shape, (3, 3))


def test_what_is_refused():
    model = cart(*SETTINGS[0])
    for method in (hw.MixedFilter(), hw.MixedWindow()):
        for change, hint in (
            ({"w": hw.Uniform.unknown()}, "BatchLP"), ({"x0": None}, "Normal"), ({"bounds": (-1, 1)}, "ParticleFilter"),
            ({"loss": hw.Bernoulli(0.5)}, "GPB"), ({"C": [[1.0, np.nan]]}, "numbers"),
        ):  # fmt: skip
            reason = method.refuses(dataclasses.replace(model, **change))
            assert type(method).__name__ in reason
            assert hint in reason
    assert "KalmanSmoother" in hw.MixedWindow().refuses(constant_velocity())


@pytest.mark.parametrize(
    "settings",
    [{"form": "box"}, {"kappa": 0.0}, {"a": 1.0}, {"a": -0.1}, {"gain": "best"}, {"shrink": True}, {"generators": 0},
     {"lag": 2}, {"lag": 1.5, "form": "zonotope"}, {"form": "zonotope", "a": 0.5}, {"criterion": "area"}],
    ids=str,
)  # fmt: skip
def test_bad_settings(settings):
    with pytest.raises(hw.BadValue):
        hw.MixedFilter(**settings)


def test_bad_settings_of_the_window():
    for settings in ({"memory": 0}, {"memory": 5, "lag": 5}, {"kappa": -1.0}, {"lag": -1}):
        with pytest.raises(hw.BadValue):
            hw.MixedWindow(**settings)


def test_an_outlier_is_told():
    model = dataclasses.replace(cart(*SETTINGS[0]), e=hw.Uniform(1.0))
    y = np.zeros(30)
    y[20] = 1e6
    est = hw.estimate(model, hw.Record(np.arange(1.0, 31), y), hw.MixedFilter())
    assert est.status is hw.Status.REDUCED
    assert "row 20" in est.message
    live = hw.stream(model, hw.MixedFilter())
    live.push(0.0)
    assert live.push(1e9).status is hw.Status.REDUCED
    assert live.push(None).status is hw.Status.OK


def test_stream_with_a_model_that_follows_the_step():
    def A(dt):
        return [[1.0, dt], [0.0, 1.0]]

    w, e = hw.Uniform([0.0, 0.1]) + hw.Gaussian([0.01, 0.01]), hw.Uniform(0.5) + hw.Gaussian(0.2)
    model = hw.Linear(A, None, [[1.0, 0.0]], w, e, hw.Normal(np.zeros(2), 1.0))
    t = np.cumsum(np.random.default_rng(0).uniform(0.5, 2.0, 20))
    y = np.sin(t)
    batch = hw.estimate(model, hw.Record(t, y), hw.MixedFilter())
    live = hw.stream(model, hw.MixedFilter())
    steps = np.diff(t, prepend=t[0] - model.dt)
    for k in range(20):
        newest = live.push(y[k], dt=steps[k])
    np.testing.assert_allclose(newest.x[0], batch.x[-1], rtol=1e-12)
    np.testing.assert_allclose(newest.spread.half[0], batch.spread.half[-1], rtol=1e-12)
    again = hw.resume(live.snapshot(), model)
    np.testing.assert_array_equal(again.push(0.3).x, live.push(0.3).x)
    body = live.snapshot()[:-4].replace(b'"m": [', b'"m": [0.0, ')
    with pytest.raises(hw.BadValue, match="does not fit"):
        hw.resume(body + zlib.crc32(body).to_bytes(4, "little"), model)


@pytest.mark.parametrize("lag", [0, 3])
def test_the_window_on_line(lag):
    """Row by row as in the batch, with missing entries and across a restart; what fits no model is told."""
    case = next(c for c in CASES if c.name == "oscillator mixed")
    method = hw.MixedWindow(memory=6, lag=lag)
    batch = hw.estimate(case.model, case.record, method)
    live = hw.stream(case.model, method)
    for k, (y, u) in enumerate(zip(case.record.y, case.record.u, strict=True)):
        if k == 20:
            live = hw.resume(live.snapshot(), case.model)
        newest = live.push(y, u)
        if k >= lag:
            np.testing.assert_allclose(newest.x[0], batch.x[k - lag], rtol=1e-9, atol=1e-10)
            np.testing.assert_allclose(newest.spread.half[0], batch.spread.half[k - lag], rtol=1e-9)
            np.testing.assert_allclose(newest.spread.P[0], batch.spread.P[k - lag], rtol=1e-9, atol=1e-12)
            assert newest.t[0] == pytest.approx(case.record.t[k - lag])
    other = dataclasses.replace(case.model, C=np.eye(3)[:2], E=None)
    assert hw.resume(live.snapshot(), other).rows == 60
    with pytest.raises(hw.Refused, match="KalmanSmoother"):
        hw.stream(constant_velocity(), method)
