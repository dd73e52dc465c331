"""Each rule of the loss kernel equals its naive twin: random models, modes, masks and degenerate sizes."""

import numpy as np
import pytest
from tests import naive_loss as naive

from halfwidth import _core

DECIDE, AVERAGE, SAMPLE, RESAMPLE, MERGE, BEAM = range(6)
TOL = 1e-11


def problem(seed, n=3, m=2, M=2, T=12, *, varying=False, holes=0.2, certain=False, predicted=False):
    """A random switching-measurement model: modes with and without the state, full covariances, offsets."""
    rng = np.random.default_rng(seed)
    K = T if varying else 1

    def cov(size, *shape):
        a = rng.standard_normal((*shape, size, size))
        return a @ np.swapaxes(a, -1, -2) / size + 0.3 * np.eye(size)

    A = rng.standard_normal((K, n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max(axis=-1)[:, None, None]
    C = rng.standard_normal((K, M, m, n)) * (rng.random((K, M, m, n)) < 0.7)
    C[:, 0] = 0.0
    Pi = rng.random((K, M, M)) + 0.1
    if certain:
        Pi = (rng.random((K, M, M)) < 0.5) + 0.0
        Pi[..., 0] += Pi.sum(axis=-1) == 0
    Pi /= Pi.sum(axis=-1, keepdims=True)
    pi0 = rng.random(M) + 0.1
    p = {
        "A": A,
        "b": rng.standard_normal((T, n)),
        "Q": 0.2 * cov(n, K),
        "C": C,
        "d": 0.5 * rng.standard_normal((T, M, m)),
        "R": cov(m, K, M),
        "Pi": Pi,
        "pi0": pi0 / pi0.sum(),
        "y": 2.0 * rng.standard_normal((T, m)),
        "seen": rng.random((T, m)) > holes,
        "x0": rng.standard_normal(n),
        "P0": cov(n),
        "prior_predicted": predicted,
    }
    return {k: np.ascontiguousarray(v) if isinstance(v, np.ndarray) else v for k, v in p.items()}


def kernel(
    p,
    rule,
    *,
    components=1,
    depth=0,
    spread=True,
    smooth=0,
    lag=0,
    seed=0,
    threshold=0.5,
    learn=0,
    count=None,
    groups=1,
):
    before = {k: v.copy() for k, v in p.items() if isinstance(v, np.ndarray)}
    out = _core.loss_filter(
        p["A"], p["b"], p["Q"], p["C"], p["d"], p["R"], p["Pi"], p["y"], p["seen"], p["x0"], p["P0"], p["pi0"], count,
        groups=groups, rule=rule, components=components, depth=depth, spread=spread, learn=learn, threshold=threshold,
        seed=seed, prior_predicted=bool(p["prior_predicted"]), smooth=smooth, lag=lag,
    )  # fmt: skip
    for k, v in before.items():
        np.testing.assert_array_equal(v, p[k])
    return out


def close(out, ref, tol=TOL):
    for key in ("x", "P", "modes", "loglik"):
        if key in ref:
            np.testing.assert_allclose(out[key], ref[key], rtol=tol, atol=tol, err_msg=key)


SHAPES = [
    {"n": 1, "m": 1}, {"n": 2, "m": 1, "M": 3}, {"n": 3, "m": 2, "varying": True}, {"n": 4, "m": 2}, {"n": 4, "m": 5, "M": 4},
    {"n": 5, "m": 1}, {"n": 6, "m": 2}, {"n": 7, "m": 3, "varying": True}, {"n": 2, "m": 2, "M": 1}, {"n": 2, "m": 2, "T": 1},
    {"n": 3, "m": 1, "certain": True}, {"n": 2, "m": 1, "holes": 1.0}, {"n": 2, "m": 2, "predicted": True},
]  # fmt: skip
IDS = [" ".join(f"{k}={v}" for k, v in s.items()) for s in SHAPES]


@pytest.mark.parametrize("shape", SHAPES, ids=IDS)
@pytest.mark.usefixtures("isa")
class TestTwin:
    @pytest.mark.parametrize("depth", [0, 1, 2, 3])
    def test_average(self, shape, depth):
        p = problem(depth, **shape)
        close(kernel(p, AVERAGE, depth=depth), naive.gpb(p, depth))

    def test_average_without_spread(self, shape):
        p = problem(10, **shape)
        close(kernel(p, AVERAGE, spread=False), naive.gpb(p, 0, spread=False))

    def test_decide(self, shape):
        p = problem(20, **shape)
        close(kernel(p, DECIDE), naive.beam(p, 1))

    def test_beam(self, shape):
        p = problem(30, **shape)
        close(kernel(p, BEAM, components=5), naive.beam(p, 5))

    def test_sample(self, shape):
        p = problem(40, **shape)
        close(kernel(p, SAMPLE, components=13, seed=7), naive.rbpf(p, 13, 7))

    def test_resample(self, shape):
        p = problem(50, **shape)
        close(kernel(p, RESAMPLE, components=6, seed=9), naive.fearnhead_clifford(p, 6, 9))

    def test_merge(self, shape):
        p = problem(60, **shape)
        close(kernel(p, MERGE, components=5), naive.runnalls(p, 5), 1e-9)

    @pytest.mark.parametrize("depth", [0, 1, 2])
    def test_smoother(self, shape, depth):
        p = problem(70, **shape)
        out = kernel(p, AVERAGE, depth=depth, smooth=1)
        close(out, naive.kim(p, depth), 1e-9)
        if depth:
            assert out["pairs"].sum() == pytest.approx(len(p["y"]) - 1, abs=1e-9)


@pytest.mark.parametrize("seed", range(100))
def test_random_sizes(seed):
    rng = np.random.default_rng(seed)
    p = problem(
        seed, n=int(rng.integers(1, 9)), m=int(rng.integers(1, 5)), M=int(rng.integers(1, 5)), T=int(rng.integers(1, 10)),
        varying=bool(rng.integers(2)), holes=rng.random(), certain=bool(rng.random() < 0.3),
    )  # fmt: skip
    depth = int(rng.integers(0, 3))
    close(kernel(p, AVERAGE, depth=depth), naive.gpb(p, depth))
    close(kernel(p, DECIDE), naive.beam(p, 1))


@pytest.mark.parametrize("lag", [1, 3, 20])
def test_fixed_lag_is_the_smoother_of_the_rows_so_far(lag):
    p = problem(5, n=2, m=1, T=9)
    out = kernel(p, AVERAGE, depth=2, smooth=2, lag=lag)
    for t in range(9):
        stop = min(t + lag + 1, 9)
        cut = {k: v[:stop] if k in ("b", "d", "y", "seen") else v for k, v in p.items()}
        ref = kernel(cut, AVERAGE, depth=2, smooth=1)
        for key in ("x", "P", "modes"):
            np.testing.assert_allclose(out[key][t], ref[key][t], rtol=TOL, atol=TOL)


def test_hard_decisions_smoothed_are_rauch_tung_striebel():
    p = problem(6, n=2, m=1, T=9)
    filtered = kernel(p, DECIDE)
    out = kernel(p, DECIDE, smooth=1)
    np.testing.assert_array_equal(out["modes"], filtered["modes"])
    known = {**p, "Pi": np.repeat(filtered["modes"][:, None, :], 2, axis=1), "pi0": filtered["modes"][0]}
    close(
        {k: out[k] for k in ("x", "P", "modes")} | {"loglik": 0}, {k: v for k, v in naive.kim(known, 1).items()}, 1e-10
    )


@pytest.mark.parametrize("N", [500, 900])
def test_exponential_and_logarithm_hold_over_their_range(N):
    """Log weights far apart: one row decides by N nats and nothing overflows."""
    p = problem(3, n=1, m=1, T=3, holes=0.0)
    p["y"][1] = np.sqrt(2 * N * p["R"][0, 0, 0, 0])
    close(kernel(p, AVERAGE, depth=2), naive.gpb(p, 2))


def test_a_row_that_nothing_explains_is_left_unused():
    p = problem(8, n=2, m=1, T=6, holes=0.0)
    p["y"][3] = 1e200
    out = kernel(p, AVERAGE, depth=1)
    assert out["code"] == 1 or out["void_rows"] == 1
    assert out["void_rows"] == 1
    for key in ("x", "P", "modes", "loglik"):
        assert np.isfinite(out[key]).all()


def test_singular_noise_is_reported():
    p = problem(9, n=2, m=2, T=4, holes=0.0)
    p["R"][:] = 1.0
    out = kernel(p, AVERAGE, depth=1)
    assert out["code"] == 2
    assert out["bad_row"] == 0


def test_overflow_ends_in_a_code():
    p = problem(11, n=2, m=1, T=400, holes=0.0)
    p["A"][:] = 1e10 * np.eye(2)
    out = kernel(p, AVERAGE, depth=1, smooth=1)
    assert out["code"] == 3
    assert 0 <= out["bad_row"] < 400
    for key in ("x", "P", "modes", "loglik"):
        assert np.isfinite(out[key]).all()


def stream(p, rule, *, components=1, depth=0, seed=0, learn=0, count=None):
    n, m, M = p["A"].shape[-1], p["y"].shape[1], p["C"].shape[1]
    s = _core.LossStream(
        n=n, m=m, modes=M, groups=1, rule=rule, components=components, depth=depth, spread=True, learn=learn, threshold=0.5,
        seed=seed, x0=p["x0"], P0=p["P0"], pi0=p["pi0"], count=count,
    )  # fmt: skip
    s.motion(p["A"][0], p["Q"][0])
    s.output(p["C"][0], p["R"][0])
    s.chain(p["Pi"][0])
    return s


@pytest.mark.parametrize(
    ("rule", "settings"),
    [
        (DECIDE, {}),
        (AVERAGE, {"depth": 2}),
        (SAMPLE, {"components": 9}),
        (RESAMPLE, {"components": 5}),
        (MERGE, {"components": 4}),
    ],
)
def test_stream_equals_record_and_survives_its_state(rule, settings):
    p = problem(12, n=3, m=2, T=14)
    ref = kernel(p, rule, seed=3, **settings)
    one = stream(p, rule, seed=3, **settings)
    y = np.where(p["seen"], p["y"], np.nan)
    for t in range(14):
        if t == 7:
            state = one.state()
            one = stream(p, rule, seed=99, **settings)
            one.restore(state)
        x, P, modes, loglik, code, law = one.push(y[t], p["b"][t], p["d"][t])
        np.testing.assert_allclose(x, ref["x"][t], rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(P, ref["P"][t], rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(modes, ref["modes"][t], rtol=1e-13, atol=1e-13)
        assert loglik == pytest.approx(ref["loglik"][t])
        assert code == 0
        assert law is None
    with pytest.raises(ValueError, match="another model"):
        one.restore(b"x" * 40)
