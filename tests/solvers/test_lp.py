"""Programs with known answers, twenty lying solvers, and every verdict proved."""

import dataclasses

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st

from halfwidth.errors import BadShape, BadValue
from halfwidth.solvers import lp
from halfwidth.solvers.lp import solve
from halfwidth.solvers.program import Claim, Program, Solver, Verdict
from halfwidth.solvers.proof import certifies, judge
from halfwidth.solvers.stock import HIGHS, PIQP, highs

INF = np.inf


def program(c, G, row_lo, row_hi, lo, hi, P=None, **more):
    def vector(v):
        return np.asarray(v, float)

    G = sp.csr_array(np.asarray(G, float))
    P = None if P is None else sp.csr_array(np.asarray(P, float))
    return Program(vector(c), G, vector(row_lo), vector(row_hi), vector(lo), vector(hi), P, **more)


def random_program(rng, kind, spread=0.0):
    """Draw a program whose answer is known: ("OPTIMAL", value), ("INFEASIBLE", None) or ("UNBOUNDED", None)."""
    n, m = int(rng.integers(1, 15)), int(rng.integers(1, 25))
    G = np.where(rng.random((m, n)) < 0.5, rng.normal(size=(m, n)), 0.0)
    x = rng.normal(size=n)
    lo = np.where(rng.random(n) < 0.5, x - rng.exponential(size=n), -INF)
    hi = np.where(rng.random(n) < 0.5, x + rng.exponential(size=n) * (rng.random(n) < 0.8), INF)
    value = G @ x
    row_lo = np.where(rng.random(m) < 0.6, value - rng.exponential(size=m) * (rng.random(m) < 0.6), -INF)
    row_hi = np.where(rng.random(m) < 0.4, value + rng.exponential(size=m) * (rng.random(m) < 0.6), INF)
    c, best = rng.normal(size=n), None
    if kind == "OPTIMAL":
        # Multipliers on whatever is tight at x make it optimal.
        z = np.where(row_lo == value, rng.exponential(size=m), 0.0) - np.where(
            row_hi == value, rng.exponential(size=m), 0.0
        )
        d = np.where(lo == x, rng.exponential(size=n), 0.0) - np.where(hi == x, rng.exponential(size=n), 0.0)
        c = G.T @ z + d
        best = float(c @ x)
    elif kind == "INFEASIBLE":
        # One more row that contradicts a combination of the others.
        row_lo[0] = value[0] if row_lo[0] == -INF else row_lo[0]
        row_hi = np.maximum(row_hi, row_lo)
        z = rng.exponential(size=m) * np.isfinite(row_lo)
        G = np.vstack([G, -(z @ G)])
        least = -float(z @ np.where(np.isfinite(row_lo), row_lo, 0.0)) + rng.exponential() + 1e-3
        row_lo, row_hi, m = np.r_[row_lo, least], np.r_[row_hi, INF], m + 1
    else:
        ray = rng.normal(size=n)
        move = G @ ray
        lo, hi = np.where(ray >= 0, lo, -INF), np.where(ray <= 0, hi, INF)
        row_lo, row_hi = np.where(move >= 0, row_lo, -INF), np.where(move <= 0, row_hi, INF)
        c = c - ray * (c @ ray + abs(rng.normal()) + 0.1) / (ray @ ray)
    row_hi = np.maximum(row_hi, row_lo)
    r, k = 10.0 ** rng.uniform(-spread, spread, m), 10.0 ** rng.uniform(-spread, spread, n)
    return program(c * k, G * r[:, None] * k, row_lo * r, row_hi * r, lo / k, hi / k), best


@pytest.mark.parametrize("spread", [0.0, 3.0, 6.0, 9.0])
@pytest.mark.parametrize("kind", ["OPTIMAL", "INFEASIBLE", "UNBOUNDED"])
def test_random_programs_never_get_a_wrong_verdict(kind, spread):
    rng = np.random.default_rng([int(spread), len(kind)])
    proved, runs = 0, 300 if kind == "OPTIMAL" else 100
    for _ in range(runs):
        p, best = random_program(rng, kind, spread)
        got = solve(p)
        # A badly scaled program may stay unsolved, but what is said is true.
        assert got.verdict.name in (kind, "FAILED", "REDUCED"), got
        if got.verdict is Verdict.OPTIMAL:
            assert got.check.worst <= 1e-7
            assert got.objective == pytest.approx(best, rel=1e-6, abs=1e-6 * np.abs(p.c) @ np.abs(got.x))
            assert np.all((p.lo <= got.x) & (got.x <= p.hi))
        proved += got.verdict.name == kind
    assert proved >= runs * {0.0: 1.0, 3.0: 0.98, 6.0: 0.97, 9.0: 0.93}[spread]


def test_piqp_and_highs_agree_to_seven_digits():
    rng = np.random.default_rng(3)
    for _ in range(100):
        p, best = random_program(rng, "OPTIMAL")
        one, two = solve(p, (PIQP,)), solve(p, (HIGHS,))
        if one.verdict is Verdict.OPTIMAL:
            assert one.objective == pytest.approx(two.objective, rel=1e-7, abs=1e-7)
        assert two.objective == pytest.approx(best, rel=1e-7, abs=1e-7)


# --- liars ----------------------------------------------------------------------------------------

FEASIBLE, BEST = random_program(np.random.default_rng(8), "OPTIMAL")
TRUE = HIGHS.run(FEASIBLE)
IMPOSSIBLE, _ = random_program(np.random.default_rng(9), "INFEASIBLE")
PROOF = HIGHS.run(IMPOSSIBLE).z
ENDLESS, _ = random_program(np.random.default_rng(10), "UNBOUNDED")
O, I, U = Verdict.OPTIMAL, Verdict.INFEASIBLE, Verdict.UNBOUNDED  # noqa: E741


def _bent(v, by, k=0):
    v = v.copy()
    v[k] += by
    return v


def _crash(p):
    raise RuntimeError("out of memory")


def _nan(v):
    return _bent(v, np.nan)


x_, z_ = TRUE.x, TRUE.z
assert np.abs(z_).max() > 0.1

LIARS = {
    "wrong x": lambda p: Claim(O, x_ + 0.1, z_),
    "x slightly wrong": lambda p: Claim(O, _bent(x_, 1e-4, int(np.argmax(np.abs(p.c)))), z_),
    "x outside its box": lambda p: Claim(O, np.where(np.isfinite(p.hi), p.hi + 1.0, x_ + 1.0), z_),
    "wrong duals": lambda p: Claim(O, x_, z_ + 0.5),
    "duals slightly wrong": lambda p: Claim(O, x_, _bent(z_, 1e-4, int(np.argmax(np.abs(z_))))),
    "duals of the other sign": lambda p: Claim(O, x_, -z_),
    "no duals": lambda p: Claim(O, x_, None),
    "zero duals": lambda p: Claim(O, x_, np.zeros_like(z_)),
    "feasible but not optimal": lambda p: Claim(O, np.clip(np.zeros(p.c.size), p.lo, p.hi), z_),
    "all zero": lambda p: Claim(O, np.zeros_like(x_), np.zeros_like(z_)),
    "NaN in x": lambda p: Claim(O, _nan(x_), z_),
    "NaN in z": lambda p: Claim(O, x_, _nan(z_)),
    "infinite x": lambda p: Claim(O, _bent(x_, np.inf), z_),
    "truncated x": lambda p: Claim(O, x_[:-1], z_),
    "truncated z": lambda p: Claim(O, x_, z_[:-1]),
    "permuted x": lambda p: Claim(O, np.roll(x_, 1), z_),
    "permuted z": lambda p: Claim(O, x_, np.roll(z_, 1)),
    "a thousand times too large": lambda p: Claim(O, 1000 * x_, 1000 * z_),
    "claims infeasible": lambda p: Claim(I),
    "claims infeasible with a false proof": lambda p: Claim(I, z=np.ones_like(z_)),
    "claims infeasible with the optimal duals": lambda p: Claim(I, z=1e6 * z_),
    "claims unbounded": lambda p: Claim(U),
    "claims unbounded along a false ray": lambda p: Claim(U, ray=-p.c),
    "text for numbers": lambda p: Claim(O, np.array(["a"] * x_.size), z_),
    "nothing": lambda p: None,
    "crashes": _crash,
}
MENDED = ("x slightly wrong",)
INFEASIBLE_LIARS = {
    "optimal where nothing is feasible": lambda p: Claim(O, np.zeros(p.c.size), np.zeros(p.row_lo.size)),
    "optimal with the proof as duals negated": lambda p: Claim(O, np.zeros(p.c.size), -PROOF),
    "a least-squares point": lambda p: Claim(
        O, np.linalg.lstsq(p.G.toarray(), np.where(np.isfinite(p.row_lo), p.row_lo, 0.0))[0], np.zeros(p.row_lo.size)
    ),
    "unbounded where nothing is feasible": lambda p: Claim(U, ray=-p.c),
}


def truthful(lie, of):
    """Lie about one program only, be silent about the auxiliary ones."""
    return Solver("liar", lambda p: lie(p) if p.G.shape == of.G.shape and p.c.any() else None, balanced=False)


@pytest.mark.parametrize("name", LIARS)
def test_a_liar_is_caught_on_a_feasible_program(name):
    liar = truthful(LIARS[name], FEASIBLE)
    alone = solve(FEASIBLE, (liar,))
    if name in MENDED:
        # So close that polishing finds the truth; a verdict is about the point returned.
        assert alone.objective == pytest.approx(BEST, rel=1e-7)
        return
    assert alone.verdict is Verdict.FAILED
    saved = solve(FEASIBLE, (liar, HIGHS))
    assert saved.verdict is Verdict.OPTIMAL
    assert saved.solver == "highs"
    assert saved.objective == pytest.approx(BEST, rel=1e-7)
    assert name == "nothing" or any(n.startswith("liar:") for n in saved.notes)


@pytest.mark.parametrize("name", INFEASIBLE_LIARS)
def test_a_liar_is_caught_on_an_infeasible_program(name):
    liar = truthful(INFEASIBLE_LIARS[name], IMPOSSIBLE)
    assert solve(IMPOSSIBLE, (liar,)).verdict is Verdict.FAILED
    assert solve(IMPOSSIBLE, (liar, HIGHS)).verdict is Verdict.INFEASIBLE


def test_there_are_twenty_liars():
    assert len(LIARS) + len(INFEASIBLE_LIARS) >= 20


def test_a_liar_about_an_endless_program():
    liar = truthful(lambda p: Claim(O, np.zeros(p.c.size), np.zeros(p.row_lo.size)), ENDLESS)
    assert solve(ENDLESS, (liar,)).verdict is Verdict.FAILED
    assert solve(ENDLESS, (liar, HIGHS)).verdict is Verdict.UNBOUNDED


def test_the_truth_passes():
    for balanced in (True, False):
        honest = Solver("honest", lambda p: HIGHS.run(p), balanced=balanced)
        got = solve(FEASIBLE, (honest,))
        assert got.verdict is Verdict.OPTIMAL
        assert got.objective == pytest.approx(BEST, rel=1e-9)
        assert solve(IMPOSSIBLE, (honest,)).verdict is Verdict.INFEASIBLE


def test_infeasible_without_a_proof_is_proved_by_the_elastic_program():
    """A solver that knows optimal points only still ends in a certificate."""

    def shy(p):
        claim = HIGHS.run(p)
        return claim if claim.verdict is O else Claim(I)

    got = solve(IMPOSSIBLE, (Solver("shy", shy),))
    assert got.verdict is Verdict.INFEASIBLE
    assert got.solver == "shy, elastic"
    assert certifies(IMPOSSIBLE, got.z)
    assert got.x is None
    assert got.objective == INF


def test_reduced_accuracy_is_said(monkeypatch):
    """Between the two tolerances the verdict says so; polishing, which would mend it, is taken away."""
    monkeypatch.setattr(lp, "polished", lambda program, x, z, check: (x, z, check))
    monkeypatch.setattr(lp, "cleaned", lambda program, z, slope: None)

    def rough(p):
        claim = HIGHS.run(p)
        for step in 2.0 ** np.arange(-40, 0):
            x = claim.x + step
            if 1e-7 < judge(p, x, claim.z)[2].worst <= 1e-5:
                return dataclasses.replace(claim, x=x)
        raise AssertionError

    got = solve(FEASIBLE, (Solver("rough", rough),))
    assert got.verdict is Verdict.REDUCED
    assert got.solved
    assert 1e-7 < got.check.worst <= 1e-5
    better = solve(FEASIBLE, (Solver("rough", rough), HIGHS))
    assert (better.verdict, better.solver) == (Verdict.OPTIMAL, "highs")


# --- corners --------------------------------------------------------------------------------------


def test_corners():
    def verdict(p):
        return solve(p).verdict

    box = {"lo": [0.0, 0.0], "hi": [1.0, 1.0]}
    none = np.zeros((0, 2))
    assert solve(program([1.0, -1.0], none, [], [], **box)).objective == pytest.approx(-1.0)
    assert verdict(program([0.0, 0.0], none, [], [], **box)) is Verdict.OPTIMAL
    assert verdict(program([1.0, 0.0], none, [], [], [-INF, 0], [INF, 0])) is Verdict.UNBOUNDED
    assert verdict(program([1.0, 1.0], [[1, 1]], [3.0], [INF], **box)) is Verdict.INFEASIBLE
    assert verdict(program([1.0, 1.0], [[0, 0]], [1.0], [INF], **box)) is Verdict.INFEASIBLE
    assert verdict(program([1.0, 1.0], [[0, 0]], [0.0], [0.0], **box)) is Verdict.OPTIMAL
    assert verdict(program([1.0, 1.0], [[1, 1]], [1.0], [0.5], **box)) is Verdict.INFEASIBLE
    assert verdict(program([1.0, 1.0], [[1, 1]], [1.0], [2.0], [0, 1], [1, 0])) is Verdict.INFEASIBLE
    fixed = solve(program([1.0, 1.0], [[1, 1]], [1.0], [INF], [0.25, 0.0], [0.25, INF]))
    np.testing.assert_allclose(fixed.x, [0.25, 0.75], atol=1e-8)
    all_fixed = solve(program([1.0, 1.0], [[1, 1]], [0.0], [INF], [0.25, 0.5], [0.25, 0.5]))
    assert all_fixed.objective == pytest.approx(0.75)
    equation = solve(program([1.0, 2.0], [[1, 1]], [1.0], [1.0], [0, 0], [INF, INF]))
    np.testing.assert_allclose(equation.x, [1.0, 0.0], atol=1e-8)


@pytest.mark.parametrize("solvers", [(PIQP,), (HIGHS,), (highs(solver="simplex"),), (highs(solver="ipm"),)])
def test_a_quadratic_program(solvers):
    # Nearest point of a half-plane: (x - 2)^2 / 2 + (y - 1)^2 / 2 with x + y <= 1.
    p = program([-2.0, -1.0], [[1, 1]], [-INF], [1.0], [-INF, -INF], [INF, INF], P=np.eye(2), floor=1e-3)
    got = solve(p, solvers)
    assert got.verdict is Verdict.OPTIMAL
    np.testing.assert_allclose(got.x, [1.0, 0.0], atol=1e-7)
    assert got.z[0] == pytest.approx(-1.0, abs=1e-6)


def test_quadratic_programs_agree():
    rng = np.random.default_rng(5)
    for _ in range(20):
        p, _ = random_program(rng, "OPTIMAL")
        L = rng.normal(size=(p.c.size, p.c.size))
        p = dataclasses.replace(p, P=sp.csr_array(L @ L.T + 0.1 * np.eye(p.c.size)))
        one, two = solve(p, (PIQP,)), solve(p, (HIGHS,))
        assert one.verdict is Verdict.OPTIMAL
        if two.verdict is Verdict.OPTIMAL:
            assert one.objective == pytest.approx(two.objective, rel=1e-6, abs=1e-6)


@given(st.integers(-300, 300), st.integers(-300, 300))
def test_units_of_the_program_do_not_matter(a, b):
    """Scaling all of x or all of the cost, by up to 2^300, is undone exactly."""
    size, cost = 2.0**a, 2.0**b
    p = FEASIBLE
    scaled = dataclasses.replace(
        p, c=cost * p.c, row_lo=size * p.row_lo, row_hi=size * p.row_hi, lo=size * p.lo, hi=size * p.hi
    )
    one, two = solve(p), solve(scaled)
    assert two.verdict is one.verdict
    np.testing.assert_allclose(two.x / size, one.x, rtol=1e-9, atol=1e-12)


def test_what_is_no_program_is_refused():
    with pytest.raises(BadShape, match="`row_lo` has shape"):
        program([1.0], [[1.0]], [0.0, 1.0], [1.0], [0.0], [1.0])
    with pytest.raises(BadShape, match="`P` has shape"):
        program([1.0], [[1.0]], [0.0], [1.0], [0.0], [1.0], P=np.eye(2))
    with pytest.raises(BadValue, match="NaN"):
        program([1.0], [[1.0]], [np.nan], [1.0], [0.0], [1.0])
    with pytest.raises(BadValue, match="not finite"):
        program([np.inf], [[1.0]], [0.0], [1.0], [0.0], [1.0])


def test_solvers_print_nothing(capfd):
    rng = np.random.default_rng(0)
    for kind in ("OPTIMAL", "INFEASIBLE", "UNBOUNDED") * 20:
        solve(random_program(rng, kind)[0], (PIQP, HIGHS))
        solve(random_program(rng, kind)[0], (HIGHS,))
    out, err = capfd.readouterr()
    assert out == err == ""
