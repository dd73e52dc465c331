"""The nonlinear kernel against textbook formulas: sizes, masks, angles, stacks, both instruction sets."""

import numpy as np
import pytest
from tests.naive_nonlinear import filter_smoother

from halfwidth import _core
from halfwidth.methods import _deviations
from halfwidth.methods.nonlinear import ExtendedKalman, UnscentedKalman
from halfwidth.trace import trace

SIZES = [(n, m) for n in (1, 2, 3, 4, 5, 6, 7, 8, 9, 11) for m in (1, 2, 3, 5)]
SPREADS = {"extended": lambda n: (0.0, 0.0, 0.0), "unscented": lambda n: tuple(UnscentedKalman().spread(n)),
           "narrow": lambda n: tuple(UnscentedKalman(alpha=0.5, kappa=1.0).spread(n))}  # fmt: skip


def problem(n, m, seed, T=25, *, turning=False):
    """A random mildly nonlinear model with inputs, gaps and correlated noise, as arrays for the kernel."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n)) * 0.6 / np.sqrt(n)
    B = rng.normal(size=(n, 2))
    C = rng.normal(size=(m, n))

    def g(x, u):
        return A @ x + 0.3 * np.sin(x[::-1]) + B @ u

    def h(x):
        return C @ x + 0.2 * np.cos(x[0])

    def covariance(k):
        root = rng.normal(size=(k, k))
        return root @ root.T / k + 0.1 * np.eye(k)

    p = {
        "u": rng.normal(size=(T, 2)),
        "Q": np.array([covariance(n) for _ in range(T)]),
        "R": np.array([covariance(m) for _ in range(3)]),
        "R_index": rng.integers(0, 3, T).astype(np.int32),
        "x0": rng.normal(size=n),
        "P0": covariance(n),
        "y": rng.normal(size=(T, m)) * 2,
        "seen": rng.random((T, m)) > 0.35,
        "wrap_x": np.zeros(n, bool),
        "wrap_y": np.zeros(m, bool),
    }
    if turning:
        p["wrap_x"][0] = p["wrap_y"][-1] = True
    p["seen"][5:9] = False
    return g, h, p


def tapes(g, h, n):
    return [(t.code, t.constant, t.out) for t in (trace(g, (n, 2)), trace(h, (n,)))]


def run(g, h, p, spread, *, iterations=1, about=None, smooth=False, programs=None):
    n, T = len(p["x0"]), len(p["y"])
    return _core.nonlinear_run(
        *(programs or tapes(g, h, n)), p["u"], np.empty((T, 0)), p["Q"], None, p["R"], p["R_index"], p["x0"], p["P0"],
        p["y"], p["seen"], p["wrap_x"], p["wrap_y"], *spread, iterations, about, smooth,
    )  # fmt: skip


@pytest.mark.parametrize("kind", SPREADS)
@pytest.mark.parametrize(("n", "m"), SIZES)
def test_equals_the_textbook(n, m, kind, isa):
    for seed in range(2):
        g, h, p = problem(n, m, 100 * n + 10 * m + seed, turning=seed == 1)
        spread = SPREADS[kind](n)
        tape_g, tape_h = trace(g, (n, 2)), trace(h, (n,))
        angles = np.flatnonzero(p["wrap_x"]), np.flatnonzero(p["wrap_y"])
        filtered, smoothed, loglik = filter_smoother(
            lambda x, t, g=g, p=p: g(x, p["u"][t]), h, lambda t, p=p: p["Q"][t], lambda t, p=p: p["R"][p["R_index"][t]],
            p["x0"], p["P0"], p["y"], p["seen"], spread, angles,
            (lambda x, t, p=p: tape_g.jacobian(x, p["u"][t])[1][0], lambda x: tape_h.jacobian(x)[1][0]),
        )  # fmt: skip
        for smooth, expected in ((False, filtered), (True, smoothed[1:])):
            got = run(g, h, p, spread, smooth=smooth)
            x = np.array([e[0] for e in expected])
            away = got["x"] - x
            away[:, angles[0]] = np.remainder(away[:, angles[0]] + np.pi, 2 * np.pi) - np.pi
            assert np.abs(away).max() <= 1e-11 * max(1.0, np.abs(x).max())
            np.testing.assert_allclose(got["P"], [e[1] for e in expected], rtol=1e-10, atol=1e-11)
            np.testing.assert_allclose(got["loglik"].sum(), loglik, rtol=1e-11)
        np.testing.assert_allclose(got["x0"], smoothed[0][0], rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(got["P0"], smoothed[0][1], rtol=1e-10, atol=1e-11)
        assert all(got[k] == (0, -1) for k in ("bad_g", "bad_h", "repaired", "contradicted"))


@pytest.mark.parametrize("kind", SPREADS)
@pytest.mark.parametrize("smooth", [False, True])
def test_equals_the_same_algorithm_in_python(kind, smooth, isa):
    for n, m, iterations in ((1, 1, 1), (3, 2, 1), (4, 2, 3), (9, 4, 2)):
        g, h, p = problem(n, m, n, turning=True)
        spread = SPREADS[kind](n)
        tape_g, tape_h = trace(g, (n, 2)), trace(h, (n,))
        G = _deviations.Function(
            lambda x, k, g=g, p=p: g(x, p["u"][k]),
            lambda x, k, _, tape_g=tape_g, p=p: tape_g.jacobian(x, p["u"][k])[1][0],
            p["wrap_x"],
        )
        H = _deviations.Function(
            lambda x, _, h=h: h(x), lambda x, *_, tape_h=tape_h: tape_h.jacobian(x)[1][0], p["wrap_y"]
        )
        abouts = [None]
        if kind == "extended":
            first = run(g, h, p, spread, smooth=True)
            abouts.append(np.vstack([first["x0"], first["x"]]))
        for about in abouts:
            got = run(g, h, p, spread, iterations=iterations, about=about, smooth=smooth)
            want = _deviations.scan(
                G, H, lambda t, p=p: p["Q"][t], lambda t, p=p: p["R"][p["R_index"][t]], p["x0"], p["P0"], p["y"],
                p["seen"], _deviations.Spread(*spread), iterations=iterations, about=about, smooth=smooth,
            )  # fmt: skip
            for key in got:
                np.testing.assert_allclose(got[key], want[key], rtol=1e-11, atol=1e-11, err_msg=key)


def test_one_row_and_none():
    g, h, p = problem(3, 2, 0, T=1)
    one = run(g, h, p, SPREADS["unscented"](3), smooth=True)
    assert one["x"].shape == (1, 3)
    assert np.isfinite(one["x0"]).all()
    g, h, p = problem(3, 2, 0, T=0)
    p["Q"] = np.eye(3)[None]
    p["R_index"] = np.zeros(0, np.int32)
    none = run(g, h, p, SPREADS["extended"](3), smooth=True)
    assert none["x"].shape == (0, 3)


def test_unseen_values_are_never_read():
    g, h, p = problem(4, 3, 1)
    a = run(g, h, p, SPREADS["extended"](4), smooth=True)
    p["y"] = np.where(p["seen"], p["y"], np.nan)
    b = run(g, h, p, SPREADS["extended"](4), smooth=True)
    np.testing.assert_array_equal(a["x"], b["x"])
    assert np.isfinite(b["loglik"]).all()


def test_arrays_that_do_not_fit_are_refused():
    g, h, p = problem(3, 2, 0)
    programs = tapes(g, h, 3)
    for key, bad in {
        "u": p["u"][:-1], "Q": p["Q"][:-1], "R": np.eye(3)[None], "R_index": p["R_index"] + 7, "P0": np.eye(4),
        "seen": p["seen"][:, :1], "wrap_x": np.zeros(2, bool), "wrap_y": np.zeros(3, bool),
    }.items():  # fmt: skip
        with pytest.raises(ValueError, match=r"nonlinear_run|tape"):
            run(g, h, p | {key: bad}, SPREADS["extended"](3), programs=programs)
    with pytest.raises(ValueError, match="about"):
        run(g, h, p, SPREADS["extended"](3), about=np.zeros((3, 3)))


def test_settings_of_the_sigma_points():
    """Weights of the scaled transform: the covariance of the points is that of the state."""
    for n in (1, 4, 7):
        for settings in ({}, {"alpha": 1e-2}, {"alpha": 0.7, "beta": 1.0, "kappa": 2.0}):
            distance, centre, weight = UnscentedKalman(**settings).spread(n)
            assert np.isclose(2 * weight * distance**2, 1.0)
            a, b, k = (settings.get(s, d) for s, d in (("alpha", 1.0), ("beta", 2.0), ("kappa", 0.0)))
            lam = a**2 * (n + k) - n
            assert np.isclose(centre, lam / (n + lam) + 1 - a**2 + b)
    assert ExtendedKalman() == ExtendedKalman(smooth=False)
