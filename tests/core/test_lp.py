"""The structured interior point against its dense twin and against HiGHS."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from tests.naive_lp import central, dense, problem

from halfwidth import _core
from halfwidth.result import Status
from halfwidth.solvers.banded import BANDED, solve
from halfwidth.solvers.chain import Chain
from halfwidth.solvers.lp import solve as proved
from halfwidth.solvers.program import Verdict
from halfwidth.solvers.stock import HIGHS, PIQP


def plain(seed, n=None):
    """Return a random chain without boxes and caps."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 11)) if n is None else n
    m, T = int(rng.integers(1, 4)), int(rng.integers(1, 40))
    A = rng.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    return Chain(
        A=A, C=rng.standard_normal((m, n)), bx=rng.standard_normal((T, n)), by=rng.standard_normal((T, m)) * 3,
        seen=rng.random((T, m)) < 0.8, group=np.arange(n + m, dtype=np.int32), h=np.ones(n + m), c=np.ones(n + m),
        floor=np.zeros(n + m), cap=np.full(n + m, np.inf),
        E=np.eye(n) + np.triu(rng.uniform(-0.5, 0.5, (n, n)), 1) if seed % 2 else None,
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(30))
def test_central_point_is_the_twins(seed):
    chain = plain(seed)
    if chain.T * 2 < 12:
        chain = plain(seed + 1000, 2)
    ours = solve(chain, point="central", fallback=False)
    if ours.scale < 1e-5 * max(np.abs(chain.bx).max(), np.abs(chain.by[chain.seen]).max(initial=0.0)):
        return  # fitted but for rounding: there is no path to follow
    x, s, iterations = central(chain)
    assert ours.status is Status.OK
    assert ours.iterations == iterations
    np.testing.assert_allclose(ours.s, s, rtol=1e-6, atol=1e-8 * s.max() + 1e-12)
    M, b, _ = dense(chain)
    np.testing.assert_allclose(M @ ours.x.ravel() - b, M @ x.ravel() - b, atol=1e-6 * s.max() + 1e-10)


@pytest.mark.parametrize("seed", range(10))
def test_least_squares_point(seed):
    chain = plain(seed)
    M, b, _ = dense(chain)
    best = np.linalg.lstsq(M, b, rcond=None)[0]
    ours = solve(chain, point="least_squares").x.ravel()
    # a small ridge holds back what the rows hardly see
    assert np.linalg.norm(M @ ours - b) <= np.linalg.norm(M @ best - b) + 1e-4 * np.linalg.norm(b)


def worth(chain, x, theta):
    """Return c's of the least half-widths that hold every residual of (x, theta), in rational arithmetic."""
    M, b, kind = dense(chain)
    given = [Fraction(float(v)) for v in np.r_[x.ravel(), theta]]
    s = [Fraction(float(v)) for v in chain.floor]
    for row, right, k in zip(M, b, kind, strict=True):
        rho = sum((Fraction(float(row[j])) * given[j] for j in np.flatnonzero(row)), -Fraction(float(right)))
        s[chain.group[k]] = max(s[chain.group[k]], abs(rho) / Fraction(float(chain.h[k])))
    return float(sum(Fraction(float(c)) * v for c, v in zip(chain.c, s, strict=True)))


def judged(seed):
    """Return (kind, what is wrong or None, whether the core needed help)."""
    kind, chain, reference, factor = problem(seed)
    truth = proved(reference.program(), (HIGHS, PIQP))
    ours = solve(chain, point="optimal")
    helped = ours.by != "banded" and ours.status is not Status.INFEASIBLE
    if truth.verdict is Verdict.INFEASIBLE:
        return kind, None if ours.status is Status.INFEASIBLE else f"{ours.status} for infeasible", helped
    if not ours.status.good:
        # Said honestly where no solver proves its answer either.
        if ours.status is Status.STALLED and truth.verdict in (Verdict.FAILED, Verdict.REDUCED):
            return kind, None, helped
        return kind, f"{ours.status} for {truth.verdict}", helped
    best = factor * float(reference.c @ truth.x[-len(reference.c) :])
    if truth.verdict is not Verdict.OPTIMAL and ours.status is Status.OK:
        # What is feasible in exact arithmetic and lower than what no stock solver proves is closer to the truth.
        exact = worth(chain, ours.x, ours.theta)
        if exact <= best * (1.0 + 1e-7) and abs(exact - ours.objective) <= 1e-7 * exact:
            return kind, None, helped
    # An objective of 0 is met up to rounding of the data.
    data = np.abs(np.where(chain.seen, chain.by, 0.0)).max(axis=0, initial=0.0)
    size = np.r_[np.abs(chain.bx).max(axis=0), data] * chain.c[chain.group] if kind != "shared" else np.ones(1)
    # Where neither stock solver proves its optimum to 1e-7, agreement is asked for to what it does prove.
    reach = max(1e-7, truth.check.gap if truth.verdict is not Verdict.OPTIMAL else 0.0)
    if abs(ours.objective - best) > reach * abs(best) + 1e-10 * size.max():
        return kind, f"{ours.objective} for {best}, {ours.status} by {ours.by}", helped
    return kind, None, helped


def test_objectives_and_statuses_are_those_of_highs():
    wrong, helped = [], 0
    for seed in range(280):
        kind, fault, help_ = judged(seed)
        helped += help_
        if fault:
            wrong.append((seed, kind, fault))
    assert not wrong
    assert helped < 0.1 * 280


def test_the_core_alone_never_claims_what_is_wrong():
    for seed in range(0, 280, 3):
        _, chain, reference, factor = problem(seed)
        ours = solve(chain, point="optimal", fallback=False)
        truth = proved(reference.program(), (HIGHS, PIQP))
        if ours.status is Status.INFEASIBLE:
            assert truth.verdict is Verdict.INFEASIBLE
        elif ours.status is Status.OK and truth.x is not None:
            best = factor * float(reference.c @ truth.x[-len(reference.c) :])
            assert ours.objective >= best * (1 - 1e-7) - 1e-9 * factor
            assert ours.objective <= best * (1 + 1e-7) + 1e-9 * factor


def test_multipliers_prove_the_optimum():
    for seed in (0, 14, 28, 42):
        _, chain, _, _ = problem(seed)
        found = proved(chain.program(), (BANDED,))
        assert found.verdict is Verdict.OPTIMAL
        assert found.solver == "banded"


def test_slack_rows_are_the_elastic_program():
    for seed in (8, 9, 22, 23, 50):
        _, chain, _, _ = problem(seed)
        elastic = replace(chain, slack=np.full(len(chain.group), 3.0))
        truth = proved(elastic.program(), (HIGHS,))
        ours = solve(elastic, point="optimal")
        assert ours.status.good
        assert ours.objective == pytest.approx(truth.objective, rel=1e-6, abs=1e-9)
        M, b, kind = dense(elastic)
        e = np.concatenate([ours.slack[:, : chain.bx.shape[1]].ravel(), ours.slack[:, chain.bx.shape[1] :][chain.seen]])
        assert np.all(np.abs(M @ ours.x.ravel() - b) <= chain.h[kind] * ours.s[chain.group[kind]] + e + 1e-6)


def test_sizes_and_instruction_sets_agree():
    for n in (1, 2, 4, 5, 8, 9):
        chain = plain(7, n)
        best = solve(chain, point="optimal", fallback=False)
        try:
            _core.use_isa(False)
            other = solve(chain, point="optimal", fallback=False)
        finally:
            _core.use_isa(True)
        assert best.status.good
        assert other.status.good
        assert best.objective == pytest.approx(other.objective, rel=1e-8, abs=1e-10)


def slid(seed, rows):
    """Return a random chain of `rows` windows, and the window of 30 rows that begins at each row."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    A = rng.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    T, C = rows + 30, rng.standard_normal((m, n))
    bx, x = rng.uniform(-1, 1, (T, n)), np.zeros((T + 1, n))
    for t in range(T):
        x[t + 1] = A @ x[t] + bx[t] + rng.uniform(-0.1, 0.1, n)
    whole = Chain(
        A=A, C=C, bx=bx, by=x[1:] @ C.T + rng.uniform(-0.3, 0.3, (T, m)),
        seen=rng.random((T, m)) < 0.8, group=np.arange(n + m, dtype=np.int32), h=np.ones(n + m), c=np.ones(n + m),
        floor=np.zeros(n + m), cap=np.full(n + m, 50.0), lo=np.full(n, -3.0) if seed % 2 else None,
        hi=np.full(n, 3.0) if seed % 2 else None,
        E=np.eye(n) + np.triu(rng.uniform(-0.5, 0.5, (n, n)), 1) if seed % 3 else None,
    )  # fmt: skip
    return [whole.part(a, a + 30) for a in range(rows)]


def test_a_start_changes_the_way_and_not_the_optimum():
    warm, cold = 0, 0
    for seed in range(6):
        start = None
        for part in slid(seed, 25):
            best = solve(part, point="optimal", fallback=False)
            ours = solve(part, point="optimal", fallback=False, start=start, drop=1, keep=True)
            if best.status is Status.OK and ours.status is Status.OK:
                assert ours.objective == pytest.approx(best.objective, rel=1e-7, abs=1e-10)
            assert ours.status.good
            start, warm, cold = ours.start, warm + ours.iterations, cold + best.iterations
    assert warm < 0.95 * cold


def test_a_start_of_another_problem_does_no_harm():
    parts = slid(1, 12)
    far = solve(parts[0], point="optimal", keep=True).start
    for part in (parts[0], parts[11], replace(parts[0], bx=1e6 * parts[0].bx)):
        alone = solve(part, point="optimal", fallback=False)
        ours = solve(part, point="optimal", fallback=False, start=far, drop=0, keep=True)
        assert ours.status.good == alone.status.good
        assert ours.objective == pytest.approx(alone.objective, rel=1e-7, abs=1e-10)
    wrong = (far[0], far[1], far[2][:1], *far[3:])
    with pytest.raises(ValueError, match="start"):
        solve(parts[0], point="optimal", start=wrong)


def test_nothing_is_mutated_and_nan_never_leaves():
    chain = plain(3)
    copies = {k: v.copy() for k, v in vars(chain).items() if isinstance(v, np.ndarray)}
    solve(chain, point="optimal")
    for name, value in copies.items():
        np.testing.assert_array_equal(getattr(chain, name), value)
    bad = replace(chain, bx=np.where(np.arange(chain.T)[:, None] == 0, 1e308, chain.bx))
    for point in ("optimal", "central", "least_squares"):
        found = solve(bad, point=point, fallback=False)
        assert np.isfinite(found.x).all()
        assert np.isfinite(found.s).all()
        if found.status.good:
            assert np.isfinite(found.objective)


def test_a_reduced_answer_is_solved_again_from_where_it_is(monkeypatch):
    """Of a long record too; what rounding left of large states is then gone."""
    rng = np.random.default_rng(0)
    T = 6000
    x = np.cumsum(rng.uniform(-0.1, 0.1, T))
    chain = Chain(
        A=np.eye(1), C=np.eye(1), bx=np.zeros((T, 1)), by=(x + rng.uniform(-0.3, 0.3, T))[:, None],
        seen=np.ones((T, 1), bool), group=np.arange(2, dtype=np.int32), h=np.ones(2), c=np.ones(2),
        floor=np.zeros(2), cap=np.full(2, np.inf),
    )  # fmt: skip
    best = solve(chain, point="optimal", multipliers=True, fallback=False)
    assert best.status is Status.OK
    asked = []

    def early(*args):
        """The first program is stopped at 1e-7, as one whose numbers hold no more."""
        asked.append(args)
        if len(asked) > 1:
            return _core.lp_solve(*args)
        *most, start, drop, keep = args
        most[20] = 1e-4
        x, theta, s, lam, slack, info = _core.lp_solve(*most, start, drop, keep)
        return x, theta, s, lam, slack, info | {"status": 1}

    monkeypatch.setattr("halfwidth.solvers.banded.lp_solve", early)
    ours = solve(chain, point="optimal", multipliers=True)
    assert len(asked) == 2
    assert (ours.status, ours.by) == (Status.OK, "banded")
    assert ours.objective == pytest.approx(best.objective, rel=1e-8)
    # multipliers in the caller's units: each half-width's add up to its cost
    np.testing.assert_allclose(ours.multipliers.sum(axis=(0, 2)), chain.c, rtol=1e-6)


def test_part_is_the_chain_of_those_rows():
    _, chain, _, _ = problem(2)
    part = chain.part(1, chain.T)
    alone = replace(
        chain, bx=chain.bx[1:], by=chain.by[1:], seen=chain.seen[1:], x0_lo=None, x0_hi=None,
        lo=None if chain.lo is None else chain.lo[1:] if chain.lo.ndim == 2 else chain.lo,
        hi=None if chain.hi is None else chain.hi[1:] if chain.hi.ndim == 2 else chain.hi,
    )  # fmt: skip
    assert solve(part, point="optimal").objective == solve(alone, point="optimal").objective
