"""core/drive.hpp against its textbook twin: drives of all lengths, side by side and alone, and what breaks."""

import numpy as np
import pytest
from tests import naive_drive

from halfwidth import _core

ROWS = ("h", "d", "w", "middle", "S", "C", "along", "aside", "yaw", "keep", "fade", "q_offset", "q_drift", "y", "seen")
TURN = ("turn", "stay", "q_turn")
EACH = ("r", "x0", "P0")


def drive(rng, T, turn):
    """One random drive, arguments by name."""
    h = rng.uniform(0.1, 0.5, T)
    d = h * rng.uniform(0.0, 20.0, T) * (rng.random(T) > 0.2)
    w = 0.1 * rng.normal(size=T)
    psi = np.cumsum(-h * w) + rng.uniform(-3, 3)
    middle = psi.copy()
    middle[1:] = 0.5 * (psi[1:] + psi[:-1])
    size = 10 if turn else 9
    way = np.cumsum(d[:, None] * np.column_stack((np.sin(middle), np.cos(middle))), axis=0)
    x0 = np.zeros(size)
    x0[[2, 5]] = middle[0], 1.0
    made = {
        "h": h, "d": d, "w": w, "middle": middle, "S": np.sin(middle), "C": np.cos(middle),
        "along": 1e-2 * h * rng.uniform(0.02, 1, T), "aside": 1e-3 * h * (0.05 + rng.random(T)), "yaw": 1e-4 * h,
        "keep": np.exp(-h / 60), "fade": np.exp(-h / 10),
        "q_offset": 0.04 * h * rng.uniform(0.1, 10, T), "q_drift": 1e-3 * h,
        "y": way - way[0] + 0.3 * rng.normal(size=(T, 2)), "seen": rng.random(T) > 0.4,
        "r": np.array(0.1), "x0": x0,
        "P0": np.array([1e4, 1e4, 10.0, 1.0, 1.0, 1e-3, 1e-4, 0.01, 0.01, 1.0][:size]),
        "scale_walk": 1e-8, "bias_walk": 1e-10,
    }  # fmt: skip
    if turn:
        silent = rng.random(T) > 0.5
        made |= {"turn": 0.2 * silent, "stay": 0.9 * silent, "q_turn": 0.2 * silent + 1e-9}
    made["y"][~made["seen"]] = 0.0
    return made


def together(drives, **asked):
    """Run the kernel over several drives."""
    sizes = np.array([len(one["h"]) for one in drives])
    turn = TURN if "turn" in drives[0] else ()
    return _core.drive_smooth(
        offsets=np.concatenate(([0], np.cumsum(sizes))),
        order=np.argsort(-sizes, kind="stable").astype(np.int32),
        **{name: np.concatenate([one[name] for one in drives]) for name in (*ROWS, *turn)},
        **{name: np.array([one[name] for one in drives]) for name in EACH},
        scale_walk=1e-8,
        bias_walk=1e-10,
        **asked,
    )


def parts(drives):
    """Return where the rows of each drive begin and end."""
    ends = np.cumsum([len(one["h"]) for one in drives])
    return [slice(int(b) - len(one["h"]), int(b)) for one, b in zip(drives, ends, strict=True)]


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("turn", [False, True])
@pytest.mark.parametrize("lengths", [(1,), (2, 1), (40,), (30, 7, 60), (25, 25, 25, 25), (3, 50, 1, 20, 2, 33, 9)])
def test_drives_agree_with_the_textbook(lengths, turn):
    rng = np.random.default_rng(sum(lengths) + turn)
    drives = [drive(rng, T, turn) for T in lengths]
    out = together(drives)
    assert out["code"] == [0] * len(drives)
    for i, (one, part) in enumerate(zip(drives, parts(drives), strict=True)):
        want = naive_drive.smooth(one)
        sd = np.sqrt(np.diagonal(want["P"], axis1=1, axis2=2))
        assert np.max(np.abs(out["x"][part] - want["x"]) / sd) < 1e-9
        assert np.max(np.abs(out["P"][part] - want["P"]) / (sd[:, :, None] * sd[:, None])) < 1e-9
        for name in ("squares", "spread"):  # variances of the twin cancel
            np.testing.assert_allclose(out[name][part], want[name], rtol=1e-8, atol=1e-11)
        for name in ("misfit", "unsure", "loglik"):
            assert out[name][i] == pytest.approx(want[name], rel=1e-9, abs=1e-9)
        assert out["counted"][i] == want["counted"]


@pytest.mark.usefixtures("isa")
def test_a_drive_is_the_same_in_any_company():
    rng = np.random.default_rng(5)
    drives = [drive(rng, T, False) for T in (20, 33, 8, 15, 40)]
    out = together(drives)
    for i, (one, part) in enumerate(zip(drives, parts(drives), strict=True)):
        alone = together([one])
        for name in ("x", "P", "squares", "spread"):
            np.testing.assert_array_equal(out[name][part], alone[name])
        assert out["loglik"][i] == alone["loglik"][0]


def test_what_is_not_asked_is_not_given_and_changes_nothing():
    drives = [drive(np.random.default_rng(6), 30, True)]
    every, bare = together(drives), together(drives, covariances=False, squares=False)
    assert not {"P", "squares", "spread"} & set(bare)
    np.testing.assert_array_equal(every["x"], bare["x"])
    np.testing.assert_array_equal(every["misfit"], bare["misfit"])


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("what", ["no fix", "no noise", "no noise at all", "far", "still", "long"])
def test_edges_stay_finite(what):
    one = drive(np.random.default_rng(7), 60, False)
    if what == "no fix":
        one["seen"][:] = False
    if "no noise" in what:
        for name in naive_drive.SCALES:
            one[name] = np.zeros(60)
    if what == "no noise at all":
        one["r"], one["P0"] = np.array(0.0), np.zeros(9)
    if what == "far":
        one["P0"] = one["P0"] * 1e12
        one["y"] = one["y"] * 1e6
    if what == "still":
        one["d"] = np.zeros(60)
    if what == "long":
        one["h"] = np.full(60, 1e6)
        one["keep"] = one["fade"] = np.zeros(60)
    out = together([one])
    assert out["code"] == [0]
    for name in ("x", "P", "squares", "spread", "misfit", "unsure", "loglik"):
        assert np.isfinite(out[name]).all(), name
    diagonal = np.diagonal(out["P"], axis1=1, axis2=2)
    assert np.all(diagonal >= 0)
    assert np.all(out["squares"] >= 0)
    assert np.all(out["spread"] >= 0)


def test_a_broken_drive_says_so_and_harms_no_other():
    rng = np.random.default_rng(8)
    good, bad = drive(rng, 30, False), drive(rng, 30, False)
    bad["y"][7] = np.inf
    bad["seen"][7] = True
    out = together([good, bad])
    assert out["code"] == [0, 3]
    np.testing.assert_array_equal(out["x"][:30], together([good])["x"])


def test_shapes_that_do_not_fit_are_refused():
    one = drive(np.random.default_rng(9), 5, False)
    with pytest.raises(ValueError, match="one number for each row"):
        together([one | {"w": np.zeros(4)}])
    with pytest.raises(ValueError, match="fixes are"):
        together([one | {"seen": np.ones(4, dtype=bool)}])
    with pytest.raises(ValueError, match="P0 are"):
        together([one | {"P0": np.ones(10)}])
