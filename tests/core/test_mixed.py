"""The mixed-noise kernel against its naive twin: random models, masks, degenerate sizes, every form."""

import numpy as np
import pytest
from tests import naive_mixed

from halfwidth import _core

FORMS = ("ellipsoid", "zonotope", "combined")


def spd(rng, n, scale=1.0):
    a = rng.normal(size=(n, n))
    return scale * (a @ a.T + 0.1 * np.eye(n))


def case(seed):
    """One random model with a record, some of its noises zero."""
    rng = np.random.default_rng(seed)
    n, ny, ng, T = int(rng.integers(1, 6)), int(rng.integers(1, 4)), int(rng.integers(0, 4)), int(rng.integers(1, 12))
    A = rng.normal(size=(n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    args = {
        "A": A, "b": 0.3 * rng.normal(size=(T, n)), "Q": spd(rng, n, 0.1) * (rng.random() < 0.8),
        "G": rng.normal(size=(n, ng)) * (rng.random(ng) < 0.8), "C": rng.normal(size=(ny, n)),
        "r": rng.random(ny) * (rng.random(ny) < 0.8), "half": rng.random(ny) * (rng.random(ny) < 0.8),
        "y": 0.5 * rng.normal(size=(T, ny)), "seen": rng.random((T, ny)) < rng.choice([0.0, 0.5, 1.0], p=[0.1, 0.4, 0.5]),
        "m": 0.3 * rng.normal(size=n), "P": spd(rng, n),
    }  # fmt: skip
    X, Z = spd(rng, n), rng.normal(size=(int(rng.integers(0, 4)), n))
    if rng.random() < 0.3:
        X, Z = np.zeros((n, n)), np.zeros((0, n))
    return args | {"X": X, "Z": Z}, n + int(rng.integers(0, 5))


def kernel(
    args, *, form, capacity=60, kappa=3.0, a=np.nan, criterion="trace", set_gain=False, truncate=False, shrink=False
):
    y = np.where(args["seen"], args["y"], 7e77)  # what stands in an unseen entry must not matter
    one = {k: (np.ascontiguousarray(args[k][None]), None) for k in ("A", "Q", "G", "C")}
    rows = {k: (args[k][None, None].copy(), None) for k in ("r", "half")}
    return _core.mixed_run(
        one["A"], args["b"], one["Q"], one["G"], one["C"], rows["r"], rows["half"], y, args["seen"], args["m"], args["P"],
        args["X"], args["Z"], FORMS.index(form), ("trace", "width").index(criterion), set_gain, truncate, shrink,
        max(capacity, len(args["m"]), len(args["Z"])), kappa, a, 3.0,
    )  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("seed", range(28))
def test_kernel_equals_twin(isa, seed, form):
    args, capacity = case(seed)
    capacity = max(capacity, len(args["Z"]))
    rng = np.random.default_rng(seed)
    more = {"truncate": bool(rng.random() < 0.5 and args["r"].min() > 0)}
    if form != "zonotope":
        more["set_gain"] = bool(rng.random() < 0.3)
        more["shrink"] = form == "ellipsoid" and more["set_gain"]
    out = kernel(args, form=form, capacity=capacity, **more)
    want = naive_mixed.run(**args, form=form, kappa=3.0, a_used=out["a"], capacity=capacity, **more)
    for got, twin in zip((out["m"], out["P"], out["half"]), (want[0], want[1], want[3]), strict=True):
        scale = max(np.abs(twin).max(), 1e-3)
        assert np.abs(got - twin).max() <= 1e-11 * scale * (100 if more["truncate"] else 1)
    if form != "zonotope":
        assert np.abs(out["X"] - want[2]).max() <= 1e-11 * max(np.abs(want[2]).max(), 1e-3)
    np.testing.assert_array_equal(out["P"], np.swapaxes(out["P"], 1, 2))
    np.testing.assert_array_equal(out["X"], np.swapaxes(out["X"], 1, 2))


@pytest.mark.parametrize("settings", [{}, {"criterion": "width"}, {"set_gain": True}, {"criterion": "width", "set_gain": True},
                                      {"criterion": "width", "set_gain": True, "truncate": True}], ids=str)  # fmt: skip
def test_the_scalar_is_the_best(settings):
    """No a of a fine grid does better than the one that is chosen; where the criterion is convex, by derivatives too."""
    found = 0
    for seed in range(60):
        args, _ = case(seed)
        args |= {"y": args["y"][:1], "seen": np.ones_like(args["seen"][:1]), "b": args["b"][:1]}
        args |= {k: args[k][:1] for k in ("C", "r", "half")} | {"y": args["y"][:, :1], "seen": args["seen"][:, :1]}
        out = kernel(args, form="ellipsoid", **settings)
        a = out["a"][0, 0]
        if not 0.0 < a < 1.0:
            continue
        found += 1
        A, c, r, half = args["A"], args["C"][0], args["r"][0], args["half"][0]
        P, moved = A @ args["P"] @ A.T + args["Q"], A @ args["X"] @ A.T
        size = np.diag(9 * P + moved) + (args["G"] ** 2).sum(axis=1)
        X = naive_mixed.ellipsoid_sum(moved, args["G"], 1 / size)
        S = c @ P @ c + r
        more = {k: settings[k] for k in ("criterion", "set_gain") if k in settings}
        if settings.get("truncate"):
            nu = args["y"][0, 0] - c @ (A @ args["m"] + args["b"][0])
            B = np.sqrt(c @ X @ c) + half
            more["tau"] = naive_mixed.truncated(nu, S, -B, B)[2] / S**2
        at = [naive_mixed.cost(P, X, c, r, half, 3.0, v, **more) for v in np.linspace(1e-6, 1 - 1e-6, 400)]
        mine = naive_mixed.cost(P, X, c, r, half, 3.0, a, **more)
        assert mine <= min(at) * (1 + 1e-9)
    assert found > 20


def test_the_least_sums_of_ellipsoids_hold_their_terms():
    rng = np.random.default_rng(1)
    for _ in range(20):
        n = int(rng.integers(1, 5))
        X, G, direction = spd(rng, n), rng.normal(size=(n, 3)), rng.normal(size=(50, n))
        E = naive_mixed.ellipsoid_sum(X, G, rng.random(n) + 0.1)
        reach = np.sqrt(np.einsum("ki,ij,kj->k", direction, X, direction)) + np.abs(direction @ G).sum(axis=1)
        assert np.all(np.sqrt(np.einsum("ki,ij,kj->k", direction, E, direction)) >= reach * (1 - 1e-12))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_hard_numbers(form, scale):
    """Wild scales, nothing uncertain, a singular set: finite, symmetric, positive."""
    for seed in range(12):
        args, _ = case(seed)
        for s, v in ((scale, 1.0), (1.0, scale), (0.0, 1.0), (1.0, 0.0), (0.0, 0.0)):
            changed = args | {k: args[k] * s for k in ("G", "half", "Z")} | {k: args[k] * v for k in ("Q", "r", "P")}
            changed["X"] = args["X"] * s**2
            for truncate in (False, True):
                out = kernel(changed, form=form, truncate=truncate)
                assert out["broken"] == -1
                for key in ("m", "P", "X", "half"):
                    assert np.isfinite(out[key]).all()
                for key in ("P", "X"):
                    low = np.linalg.eigvalsh(out[key])
                    assert low[:, 0].min() >= -1e-12 * low[:, -1].max()


def test_overflow_is_named_and_the_last_belief_is_repeated():
    args, _ = case(3)
    args["A"] = args["A"] * 1e200
    out = kernel(args | {"b": np.zeros((8, len(args["m"]))), "y": np.zeros((8, len(args["r"]))),
                         "seen": np.zeros((8, len(args["r"])), dtype=bool)}, form="combined")  # fmt: skip
    assert 0 <= out["broken"] <= 2
    assert np.isfinite(out["half"]).all()
    assert np.isfinite(out["m"]).all()


def test_bad_sizes_are_refused():
    args, _ = case(2)
    with pytest.raises(ValueError, match="mixed_run"):
        kernel(args | {"P": np.eye(len(args["m"]) + 1)}, form="ellipsoid")
    with pytest.raises(ValueError, match="mixed_run"):
        kernel(args | {"seen": args["seen"][:, :0]}, form="ellipsoid")
