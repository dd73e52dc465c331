"""learn: EM and maximum likelihood, against truth, twins and numerical derivatives."""

import dataclasses

import numpy as np
import pytest
from tests import naive
from tests.cases import constant_velocity, oscillator

import halfwidth as hw

Q, R = np.array([[0.4, 0.1], [0.1, 0.3]]), np.array([[1.0, 0.3], [0.3, 2.0]])


def truth():
    return hw.Linear([[0.9, 0.3], [-0.2, 0.8]], None, np.eye(2), hw.Gaussian(Q), hw.Gaussian(R), hw.Normal([0, 0], 1.0))


def gappy(model, T, seed, u=None, lost=0.3, entries=False):
    _, record = hw.simulate(model, u, T=T, seed=seed)
    rng = np.random.default_rng(seed + 1)
    mask = rng.random(record.y.shape) < lost if entries else rng.random((T, 1)) < lost
    return hw.Record(record.t, np.where(mask, np.nan, record.y), record.u)


def guess(model, **more):
    return dataclasses.replace(model, w=hw.Gaussian(1.0), e=hw.Gaussian(1.0), **more)


def found(learned):
    return learned.model.w.cov().single, learned.model.e.cov().single


def test_one_em_step_is_the_textbook_one():
    model = truth()
    record = gappy(model, 12, 3, entries=True)
    start = guess(model)
    s = naive.sums(model.A.single, None, np.eye(2), np.eye(2), np.eye(2), record.y, record.seen, np.zeros(2), np.eye(2))
    learned = hw.learn(start, record, iterations=1, tolerance=1e-12)
    q, r = found(learned)
    np.testing.assert_allclose(q, s["W"] / 12, rtol=1e-10)
    np.testing.assert_allclose(r, s["V"] / s["nV"], rtol=1e-10)


@pytest.mark.parametrize("method", ["em", "ml"])
def test_truth_is_found_with_structured_noise_and_gaps(method):
    """Constant velocity, T = 2,000, 30 % of the rows missing: within 15 % of the truth."""
    true = constant_velocity(1.0)
    record = gappy(true, 2000, 11)
    start = dataclasses.replace(true, w=hw.Gaussian(10 * true.w.cov().single), e=hw.Gaussian(5.0))
    learned = hw.learn(start, record, structure={"Q": "scaled"}, method=method).check()
    q, r = found(learned)
    assert abs(q[0, 0] / true.w.cov().single[0, 0] - 1) < 0.15
    np.testing.assert_allclose(r, true.e.cov().single, rtol=0.15)
    assert learned.loglik >= hw.estimate(true, record).loglik


def test_full_covariances_are_found_with_missing_entries():
    record = gappy(truth(), 20_000, 5, entries=True)
    learned = hw.learn(guess(truth()), record, tolerance=1e-9)
    q, r = found(learned)
    np.testing.assert_allclose(q, Q, atol=0.06)
    np.testing.assert_allclose(r, R, atol=0.1)


def test_both_methods_climb_to_the_same_top():
    record = gappy(truth(), 800, 2, entries=True)
    em = hw.learn(guess(truth()), record, tolerance=1e-11, iterations=3000)
    ml = hw.learn(guess(truth()), record, method="ml", tolerance=1e-11)
    assert em.loglik == pytest.approx(ml.loglik, abs=1e-3)
    np.testing.assert_allclose(found(em)[1], found(ml)[1], atol=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_the_likelihood_never_falls(seed):
    record = gappy(truth(), 200, seed, entries=True)
    for method in ("em", "ml"):
        history = hw.learn(guess(truth()), record, method=method, iterations=30).history
        assert np.all(np.diff(history) >= -1e-8)


@pytest.mark.parametrize("structure", ["full", "diagonal", "scaled"])
@pytest.mark.parametrize("method", ["em", "ml"])
def test_the_top_has_no_slope(structure, method):
    """Changing what was learned by a little, within its structure, does not raise the likelihood."""
    record = gappy(truth(), 400, 7)
    kinds = {"Q": structure, "R": structure}
    start = dataclasses.replace(truth(), w=hw.Gaussian(np.diag([1.0, 2.0])), e=hw.Gaussian(np.diag([2.0, 1.0])))
    learned = hw.learn(start, record, method=method, structure=kinds, tolerance=1e-12, iterations=3000)
    q, r = found(learned)
    if structure != "full":
        assert q[0, 1] == 0
    if structure == "scaled":
        assert q[1, 1] == pytest.approx(2 * q[0, 0])

    def loglik(q, r):
        return hw.estimate(dataclasses.replace(learned.model, w=hw.Gaussian(q), e=hw.Gaussian(r)), record).loglik

    for factor in (0.98, 1.02):
        assert loglik(factor * q, r) < learned.loglik + 1e-4
        assert loglik(q, factor * r) < learned.loglik + 1e-4


def test_gradient_by_fishers_identity_is_the_numerical_one():
    from halfwidth.methods._likelihood import Problem, _Map

    record = gappy(truth(), 100, 1, entries=True)
    start = guess(truth())
    problem = Problem(start, start, [record], ("Q", "R"), {}, {"Q": "full", "R": "full"})
    map_q = _Map("full", hw.Gaussian(Q).cov())
    p = map_q.start() + 0.1

    def loglik(p):
        return problem.expect(dataclasses.replace(start, w=hw.Gaussian(map_q.matrix(p))))["loglik"]

    s = problem.expect(dataclasses.replace(start, w=hw.Gaussian(map_q.matrix(p))))
    gradient = map_q.gradient(p, map_q.matrix(p)[None], s["W"], s["nW"])
    h = 1e-5
    numerical = [(loglik(p + h * e) - loglik(p - h * e)) / (2 * h) for e in np.eye(len(p))]
    np.testing.assert_allclose(gradient, numerical, rtol=1e-6, atol=1e-6)


def test_several_records_count_together():
    records = [gappy(truth(), 300, k) for k in range(6)]
    learned = hw.learn(guess(truth()), records, iterations=1)
    alone = [hw.learn(guess(truth()), r, iterations=1) for r in records]
    np.testing.assert_allclose(found(learned)[0], np.mean([found(a)[0] for a in alone], axis=0), rtol=1e-9)
    assert learned.history[0] == pytest.approx(sum(a.history[0] for a in alone))


def test_noise_that_depends_on_the_step_is_scaled():
    model = constant_velocity(None)
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.choice([0.1, 0.3, 0.9], 1500))
    _, record = hw.simulate(model, t=t, seed=4)
    Q0 = model.w.cov().function
    start = dataclasses.replace(model, w=hw.Gaussian(lambda dt: 8 * Q0(dt)), e=hw.Gaussian(2 * np.eye(2)))
    for method in ("em", "ml"):
        learned = hw.learn(start, record, method=method)
        q, r = learned.model.w.cov(), learned.model.e.cov().single
        assert q.at(0.0, 0.3)[0, 0] == pytest.approx(Q0(0.3)[0, 0], rel=0.15)
        np.testing.assert_allclose(r, model.e.cov().single, atol=0.1)


def test_E_and_F_are_taken_out_of_the_noise():
    model = oscillator(
        hw.Gaussian([[0.4, 0.1, 0.0], [0.1, 0.3, 0.0], [0.0, 0.0, 0.2]]),
        hw.Gaussian([[0.3, 0.1], [0.1, 0.4]]),
        hw.Normal(np.zeros(3), 1.0),
    )
    u = np.random.default_rng(1).normal(size=(6000, 1))
    _, record = hw.simulate(model, u, seed=2)
    learned = hw.learn(model, record, what=("R",), iterations=100)
    np.testing.assert_allclose(learned.model.e.cov().single, model.e.cov().single, atol=0.05)
    assert learned.model.w is model.w
    both = hw.learn(model, record, iterations=40)
    np.testing.assert_allclose(both.model.w.cov().single, model.w.cov().single, atol=0.15)


def test_unknown_entries_and_whole_matrices():
    model = oscillator(hw.Gaussian(0.1), hw.Gaussian(0.2), hw.Normal(np.zeros(3), 1.0))
    u = np.random.default_rng(1).normal(size=(3000, 1))
    _, record = hw.simulate(model, u, seed=2)
    A, B = model.A.single.copy(), model.B.single.copy()
    A[0, 1], B[1, 0] = np.nan, np.nan
    asked = dataclasses.replace(model, A=A, B=B, theta_bounds=([-1.0, 0.0], [1.0, 2.0]))
    learned = hw.learn(asked, record, what=("theta",), iterations=200)
    assert learned.model.A.single[0, 1] == pytest.approx(0.2, abs=0.05)
    assert learned.model.B.single[1, 0] == pytest.approx(1.0, abs=0.05)
    known = ~np.isnan(A)
    np.testing.assert_array_equal(learned.model.A.single[known], A[known])
    low = dataclasses.replace(asked, theta_bounds=([-1.0, 0.0], [0.1, 2.0]))
    assert hw.learn(low, record, what=("theta",), iterations=50).model.A.single[0, 1] == pytest.approx(0.1)
    C = hw.learn(model, record, what=("C", "A", "B", "Q", "R", "x0"), iterations=20)
    assert C.loglik > hw.estimate(model, record).loglik


def test_iterations_that_run_out_are_told():
    learned = hw.learn(guess(truth()), gappy(truth(), 100, 1), iterations=2)
    assert learned.status is hw.Status.STALLED
    with pytest.raises(hw.Unsolved, match="still rose"):
        learned.check()
    assert "2 iterations" in repr(learned)


RECORD = hw.Record([0.0, 1.0, 2.0], np.ones((3, 2)))


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"what": ("S",)}, hw.BadValue, "`what`"),
        ({"what": ()}, hw.BadValue, "`what`"),
        ({"what": ("theta",)}, hw.BadValue, "no entry"),
        ({"what": ("B",)}, hw.BadValue, "no inputs"),
        ({"method": "magic"}, hw.BadValue, "`method`"),
        ({"method": "ml", "what": ("A",)}, hw.BadValue, "only Q and R"),
        ({"structure": {"Q": "round"}}, hw.BadValue, "`structure`"),
        ({"structure": {"P": "full"}}, hw.BadValue, "`structure`"),
        ({"iterations": 0}, hw.BadValue, "`iterations`"),
        ({"tolerance": 0.0}, hw.BadValue, "`tolerance`"),
        ({"record": []}, hw.BadRecord, "`record`"),
        ({"record": hw.Record([0.0], [[np.nan, np.nan]])}, hw.BadRecord, "nothing to learn"),
        ({"record": hw.Record([0.0], [[1.0]])}, hw.BadShape, "`record.y`"),
        ({"model": "w"}, hw.Refused, "Uniform"),
        ({"model": "nonlinear"}, hw.Refused, "Nonlinear"),
        ({"model": "nan"}, hw.BadValue, "unknown entries"),
        ({"model": "varying", "structure": {"Q": "full"}}, hw.BadValue, "varies"),
    ],
    ids=str,
)
def test_bad_arguments(change, error, words):
    change = dict(change)
    models = {
        "w": lambda: dataclasses.replace(truth(), w=hw.Uniform(1.0)),
        "nonlinear": lambda: hw.Nonlinear(
            lambda x: x, lambda x: x, hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0, 0], 1.0)
        ),
        "nan": lambda: dataclasses.replace(truth(), A=[[np.nan, 0.0], [0.0, 1.0]]),
        "varying": lambda: dataclasses.replace(truth(), w=hw.Gaussian(lambda dt: dt * Q)),
    }
    model = models[change.pop("model")]() if "model" in change else truth()
    with pytest.raises(error, match=words):
        hw.learn(model, change.pop("record", RECORD), **change)


@pytest.mark.parametrize("structure", ["full", "diagonal"])
def test_an_entry_without_noise_stays_without(structure):
    model = hw.Linear(
        [[1, 1], [0, 1]], None, [[1, 0]], hw.Gaussian([0.0, 0.2]), hw.Gaussian(2.0), hw.Normal([0, 0], 1.0)
    )
    record = gappy(model, 1000, 5)
    start = dataclasses.replace(model, w=hw.Gaussian([0.0, 1.0]), e=hw.Gaussian(1.0))
    for method in ("em", "ml"):
        q, r = found(hw.learn(start, record, structure={"Q": structure}, method=method))
        assert abs(q[0, 0]) < 0.01 * q[1, 1]
        np.testing.assert_allclose([q[1, 1], r[0, 0]], [0.2, 2.0], rtol=0.25)
