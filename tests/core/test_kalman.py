"""The Kalman kernels against their naive twins: random models, masks, degenerate sizes, singular matrices."""

import numpy as np
import pytest
from tests import naive

from halfwidth import _core

SIZES = [(n, m) for n in range(1, 10) for m in range(1, 6)] + [(11, 3)]


def spd(rng, n):
    a = rng.normal(size=(n, n))
    return a @ a.T + 0.5 * n * np.eye(n)


def case(seed, *, T=None, nx=None, ny=None, varying=None):
    """One random stable model with a record: (arguments, keywords) of the twins."""
    rng = np.random.default_rng(seed)
    n0, m0 = SIZES[seed % len(SIZES)]
    nx, ny = nx or n0, ny or m0
    T = T or int(rng.integers(1, 12))
    varying = bool(rng.random() < 0.3) if varying is None else varying
    K = (T,) if varying else ()
    a = rng.normal(size=(*K, nx, nx))
    A = a * (0.95 / np.abs(np.linalg.eigvals(a)).max(axis=-1))[..., None, None]
    C = rng.normal(size=(*K, ny, nx))
    Q = np.array([spd(rng, nx) for _ in range(T)]) if varying else spd(rng, nx)
    R = np.array([spd(rng, ny) for _ in range(T)]) if varying else spd(rng, ny)
    nu = int(rng.integers(0, 3))
    B = rng.normal(size=(*K, nx, nu))
    more = {"u": rng.normal(size=(T, nu)) if nu else None}
    if rng.random() < 0.3:
        more |= {"b": rng.normal(size=(T, nx)), "d": rng.normal(size=(T, ny))}
    y = 3 * rng.normal(size=(T, ny))
    seen = rng.random((T, ny)) < rng.choice([0.0, 0.3, 0.7, 1.0])
    return (A, B, C, Q, R, y, seen, rng.normal(size=nx), spd(rng, nx)), more


def run(mode, args, more, **wanted):
    A, B, C, Q, R, y, seen, x0, P0 = args
    y = np.where(seen, y, 7e77)  # what stands in an unseen entry must not matter
    B = B if more.get("u") is not None else None
    return _core.kalman_run(mode, A, B, C, Q, R, y, seen, x0, P0, **more, **wanted)


def close(a, b, tol=1e-11):
    scale = max(np.abs(b).max(initial=0.0), 1e-300)
    assert np.abs(np.asarray(a) - b).max(initial=0.0) <= tol * scale


@pytest.mark.parametrize("block", range(10))
def test_filter_and_smoother_equal_the_twins_on_a_thousand_models(isa, block):
    first, count = (0, 50) if isa == "base" else (1000, 100)
    for seed in range(first + count * block, first + count * (block + 1)):
        args, more = case(seed)
        A, Q, x0, P0 = args[0], args[3], args[7], args[8]
        x, P, xp, Pp, ll = naive.kf(*args, **more)
        f = run("filter", args, more, predicted=True, outputs=True, rows=True)
        close(f["x"], x)
        close(f["P"], P)
        close(f["xp"], xp)
        close(f["Pp"], Pp)
        close(f["ll"], ll)
        close(f["loglik"][0], ll.sum())
        assert f["n_seen"] == [args[6].sum()]
        assert f["code"] == [0]
        xs, Ps, x0s, P0s, lag_one = naive.rts(A, Q, x, P, xp, Pp, x0, P0)
        s = run("smooth", args, more, initial=True, lag_one=True)
        close(s["x"], xs)
        close(s["P"], Ps)
        close(s["x0"][0], x0s)
        close(s["P0"][0], P0s)
        close(s["Pl"], lag_one)
        assert (s["P"] == s["P"].swapaxes(1, 2)).all()
        assert (f["P"] == f["P"].swapaxes(1, 2)).all()


def test_smoother_equals_one_dense_gaussian(isa):
    for seed in range(60):
        args, more = case(seed, T=6)
        nx = len(args[7])
        mean, cov, loglik = naive.dense(*args, **more)
        s = run("smooth", args, more, initial=True, lag_one=True)
        close(s["x"], mean[1:], 1e-9)
        close(s["x0"][0], mean[0], 1e-9)
        close(s["loglik"][0], loglik, 1e-9)
        for t in range(6):
            i, j = slice(t * nx, (t + 1) * nx), slice((t + 1) * nx, (t + 2) * nx)
            close(s["P"][t], cov[j, j], 1e-9)
            close(s["Pl"][t], cov[j, i], 1e-8)


def test_sums_equal_the_dense_ones(isa):
    for seed in range(90):
        args, more = case(seed, T=7, varying=False)
        want = naive.sums(*args, **more)
        got = run("smooth", args, more, sums=True)
        scale = np.abs(want["W"]).max() + np.abs(want["Xx"]).max()
        for name, value in want.items():
            value = np.asarray(value)
            error = np.abs(got[name].reshape(value.shape) - value).max(initial=0.0)
            assert error <= 1e-9 * scale, name
        assert got["nW"] == [7]


@pytest.mark.parametrize("lag", [0, 1, 3, 50])
def test_fixed_lag_equals_the_smoother_cut_off(isa, lag):
    for seed in range(20):
        args, more = case(seed, T=9, varying=False)
        x, P = naive.fixed_lag(*args, lag, **more) if lag else naive.kf(*args, **more)[:2]
        got = run("lag", args, more, lag=lag)
        close(got["x"], x, 1e-10)
        close(got["P"], P, 1e-10)


def test_predicted_outputs_and_nis():
    args, more = case(7, T=20, nx=3, ny=2, varying=False)
    C, R, y, seen = args[2], args[4], args[5], args[6]
    seen[:] = True
    f = run("filter", args, more, predicted=True, outputs=True, rows=True)
    d = more.get("d", np.zeros_like(y))
    close(f["yp"], f["xp"] @ C.T + d)
    close(f["S"], C @ f["Pp"] @ C.T + R)
    v = y - f["yp"]
    close(f["nis"], np.einsum("ti,tij,tj->t", v, np.linalg.inv(f["S"]), v), 1e-10)


def test_an_index_picks_from_a_stack():
    args, more = case(3, T=10, nx=4, ny=2, varying=True)
    index = np.random.default_rng(0).integers(0, 4, 10).astype(np.int32)
    want = run("smooth", tuple(M[:4][index] for M in args[:5]) + args[5:], more, sums=True)
    which = dict.fromkeys(("iA", "iB", "iC", "iQ", "iR"), index)
    got = run("smooth", tuple(M[:4] for M in args[:5]) + args[5:], more, sums=True, **which)
    assert (want["x"] == got["x"]).all()
    assert (want["P"] == got["P"]).all()
    close(got["W"], np.array([want["W"][index == k].sum(axis=0) for k in range(4)]))
    assert (got["nW"] == np.bincount(index, minlength=4)).all()


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_many_series_equal_one_by_one(threads):
    rng = np.random.default_rng(0)
    args, more = case(11, T=100, nx=4, ny=2, varying=False)
    A, B, C, Q, R, y, seen, *_ = args
    cut = np.array([0, 7, 7, 40, 99, 100])
    x0s, P0s = rng.normal(size=(5, 4)), np.array([spd(rng, 4) for _ in range(5)])
    many = (A, B, C, Q, R, y, seen, x0s, P0s)
    got = run("smooth", many, more, offsets=cut, threads=threads, sums=True, initial=True)
    W = 0
    for i in range(5):
        s = slice(cut[i], cut[i + 1])
        part = {k: (None if v is None else v[s]) for k, v in more.items()}
        one = (A, B, C, Q, R, y[s], seen[s], x0s[i], P0s[i])
        one = run("smooth", one, part, sums=True, initial=True)
        assert (one["x"] == got["x"][s]).all()
        assert (one["P0"][0] == got["P0"][i]).all()
        assert one["loglik"][0] == got["loglik"][i]
        W = W + one["W"]
    close(got["W"], W, 1e-14)


def test_nothing_given_is_changed():
    args, more = case(21, T=8)
    before = [a.copy() for a in args]
    run("smooth", args, more, sums=True, initial=True)
    for a, b in zip(args, before, strict=True):
        assert (a == b).all()


#: Factors of A, C, Q, R, P0 that take variances or whole maps away.
ZERO = {
    "R": (1, 1, 1, 0, 1),
    "Q": (1, 1, 0, 1, 1),
    "P0": (1, 1, 1, 1, 0),
    "Q, P0": (1, 1, 0, 1, 0),
    "Q, R": (1, 1, 0, 0, 1),
    "Q, R, P0": (1, 1, 0, 0, 0),
    "A": (0, 1, 1, 1, 1),
    "C": (1, 0, 1, 1, 1),
    "rank one Q": (1, 1, "one", 1, 1),
    "equal outputs": (1, "equal", 1, 0, 1),
}


@pytest.mark.parametrize("what", ZERO)
@pytest.mark.parametrize("scale", [1e-150, 1e-12, 1.0, 1e12, 1e150])
def test_singular_systems_never_give_nan(isa, what, scale):
    k = scale if 1e-100 < scale < 1e100 else np.sqrt(scale)  # variances are then 1e-150 and 1e150
    for seed in range(45):
        args, more = case(seed, varying=False, T=8)
        A, B, C, Q, R, y, seen, x0, P0 = args
        a, c, q, r, p = ZERO[what]
        Q = Q[:, :1] @ Q[:, :1].T if q == "one" else q * Q
        C, y = (C[:1].repeat(len(C), 0), y[:, :1].repeat(len(C), 1)) if c == "equal" else (c * C, y)
        args = (a * A, B, C, k**2 * Q, k**2 * r * R, k * y, seen, k * x0, k**2 * p * P0)
        more = {name: None if v is None else k * v for name, v in more.items()}
        for mode in ("filter", "smooth", "lag"):
            wanted = {"sums": True, "initial": True} if mode == "smooth" else {"lag": 2}
            got = run(mode, args, more, **wanted)
            for name, value in got.items():
                assert np.isfinite(value).all(), name
            assert got["code"][0] < 3
            low = np.linalg.eigvalsh(got["P"] / k**2)
            # a state known exactly leaves only rounding, which exact outputs then contradict
            tol = 1e-6 if what == "Q, R" else 1e-12
            assert (low[:, 0] >= -tol * np.maximum(low[:, -1], 1.0)).all()


def test_an_exact_output_is_obeyed_and_its_contradiction_told(isa):
    eye = np.eye(2)
    y = np.array([[1.0, 2.0], [1.0, 2.0], [5.0, 2.0]])
    seen = np.ones((3, 2), bool)
    got = _core.kalman_run("filter", eye, None, eye, 0 * eye, 0 * eye, y, seen, np.zeros(2), eye)
    assert np.allclose(got["x"], [1.0, 2.0])
    assert got["code"] == [2]
    assert got["row"] == [2]
    assert got["n_reduced"] == [2]


def test_a_belief_beyond_floating_point_stops_the_pass(isa):
    one = np.eye(1)
    y, seen = np.zeros((20, 1)), np.zeros((20, 1), bool)
    for mode in ("filter", "smooth"):
        got = _core.kalman_run(
            mode, 1e60 * one, None, one, one, one, y, seen, np.ones(1), one, predicted=True, outputs=True
        )
        assert got["code"] == [3]
        assert 0 < got["row"][0] < 20
        for value in got.values():
            assert np.isfinite(value).all()


def test_one_row():
    args, more = case(5, T=1, nx=8, ny=4)
    x, P, *_ = naive.kf(*args, **more)
    close(run("smooth", args, more)["x"], x)
    close(run("lag", args, more, lag=4)["P"], P)


def test_no_outputs_at_all():
    args, more = case(5, T=4, nx=3, ny=2, varying=False)
    A, B, C, Q, R, _, seen, x0, P0 = args
    none = np.zeros((4, 0))
    more.pop("d", None)
    got = _core.kalman_run(
        "smooth", A, B if more["u"] is not None else None, C[:0], Q, R[:0, :0], none, none > 0, x0, P0, **more
    )
    seen[:] = False
    close(got["x"], naive.kf(*args, **more)[0])
    assert got["loglik"] == [0.0]


@pytest.mark.parametrize(
    "change",
    [
        {"A": np.eye(3)},
        {"C": np.ones((2, 3))},
        {"Q": np.eye(3)},
        {"R": np.eye(3)},
        {"x0": np.zeros(3)},
        {"P0": np.eye(3)},
        {"seen": np.ones((4, 1), bool)},
        {"u": np.ones((5, 1))},
        {"offsets": np.array([0, 9])},
        {"iA": np.array([0, 0, 1, 0, 0], np.int32)},
        {"mode": "nothing"},
    ],
)
def test_wrong_sizes_are_named(change):
    eye = np.eye(2)
    good = {"mode": "filter", "A": eye, "B": None, "C": eye, "Q": eye, "R": eye, "P0": eye}
    good |= {"y": np.zeros((5, 2)), "seen": np.ones((5, 2), bool), "x0": np.zeros(2)}
    _core.kalman_run(**good)
    with pytest.raises((ValueError, TypeError)):
        _core.kalman_run(**(good | change))
