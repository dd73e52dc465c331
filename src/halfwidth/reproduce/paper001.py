"""Zhang and You (2016), Kalman filtering with unknown sensor measurement losses: accuracy against cost.

The text at hand ends before the paper's target-tracking example, and its parameters are in no public text found, so
four scenarios stand in for it, easy and hard, independent and bursty:

====  =======================================================================================================
S1    scalar, A = 0.95, C = Q = R = 1, 70 % received, independent: one can hardly tell what was lost
S2    the same with bursts, 95 % stay received, 85 % stay lost
S3    a target in the plane at nearly constant velocity that crosses the origin, 70 % received, independent
S4    the same with bursts
====  =======================================================================================================

The error is compared with the exact posterior (short records, every history enumerated) and with a pseudo-Bayes filter
of depth 10. Two negative controls: the chi-square gate, which is today's practice, and the best linear filter, which
knows only how often samples are lost (Nahi 1969, IEEE Transactions on Information Theory 15).
"""

import pathlib
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import halfwidth as hw
from halfwidth.array import Array
from halfwidth.reproduce import Table, canvas, saved

BURSTS = (0.95, 0.85)


class Scenario(NamedTuple):
    """One of S1 to S4: a model whose `x0` is the prediction of the first row, and what is scored of its state."""

    name: str
    model: Any
    position: tuple[int, ...]


class Run(NamedTuple):
    """One simulated record with its truth."""

    x: Array  # (T, nx)
    received: NDArray[np.bool_]  # (T,)
    record: Any


class Score(NamedTuple):
    """Root mean square error, error of the detected losses, distance of the mean to the reference, time a step."""

    rmse: float
    gamma: float
    distance: float
    microseconds: float


def scenarios() -> dict[str, Scenario]:
    """Return S1 to S4."""
    independent, bursts = hw.Bernoulli(0.7), hw.Markov(*BURSTS)
    block = 0.1 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    plane: dict[str, Any] = {
        "A": np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]]),
        "B": None,
        "C": np.kron(np.eye(2), [[1.0, 0.0]]),
        "w": hw.Gaussian(np.kron(np.eye(2), block)),
        "e": hw.Gaussian([100.0, 100.0]),
        "x0": hw.Normal([-60.0, 2.0, -30.0, 1.0], [100.0, 1.0, 100.0, 1.0]),
    }
    scalar: dict[str, Any] = {
        "A": [[0.95]],
        "B": None,
        "C": [[1.0]],
        "w": hw.Gaussian(1.0),
        "e": hw.Gaussian(1.0),
        "x0": hw.Normal([0.0], 10.0),
    }
    found = [
        Scenario("S1", hw.Linear(**scalar, loss=independent), (0,)),
        Scenario("S2", hw.Linear(**scalar, loss=bursts), (0,)),
        Scenario("S3", hw.Linear(**plane, loss=independent), (0, 2)),
        Scenario("S4", hw.Linear(**plane, loss=bursts), (0, 2)),
    ]
    return {s.name: s for s in found}


def simulate(scenario: Scenario, T: int, seed: int) -> Run:
    """Draw one record; the first state is drawn from the prior itself."""
    model, rng = scenario.model, np.random.default_rng(seed)
    A, C = model.A.single, model.C.single
    t = np.arange(T, dtype=np.float64)
    w, e = model.w.sample(rng, t, np.ones(T)), model.e.sample(rng, t, np.ones(T))
    x = np.empty((T, model.nx))
    x[0] = model.x0.sample(rng)
    for k in range(1, T):
        x[k] = A @ x[k - 1] + w[k]
    y, received = model.loss.apply(model, x @ C.T + e, e, rng)
    return Run(x, received[:, 0], hw.Record(t, y))


def oracle(scenario: Scenario, run: Run) -> Array:
    """Return the intermittent Kalman filter's means, which is told every loss."""
    known = _with(scenario.model, hw.Bernoulli(run.received[:, None].astype(float)))
    return np.asarray(hw.BKF1(prior="predicted").run(known, run.record).x)


def kalman(scenario: Scenario, run: Run) -> Array:
    """Return the Kalman filter's means, which believes everything."""
    return np.asarray(hw.BKF1(prior="predicted").run(_with(scenario.model, None), run.record).x)


def gate(scenario: Scenario, run: Run, quantile: float = 0.99) -> tuple[Array, Array]:
    """Return means and decisions of a Kalman filter that drops what fails a chi-square test of the innovation."""
    from scipy.stats import chi2

    model = scenario.model
    A, C = model.A.single, model.C.single
    Q, R = model.w.cov().single, model.e.cov().single
    x, P = model.x0.mean, model.x0.P
    limit = float(chi2.ppf(quantile, model.ny))
    means, kept = np.empty_like(run.x), np.zeros(len(run.x))
    for t, y in enumerate(run.record.y):
        if t:
            x, P = A @ x, A @ P @ A.T + Q
        e, S = y - C @ x, C @ P @ C.T + R
        if e @ np.linalg.solve(S, e) <= limit:
            K = np.linalg.solve(S, C @ P).T
            x, P = x + K @ e, P - K @ S @ K.T
            kept[t] = 1.0
        means[t] = x
    return means, kept


def linear(scenario: Scenario, run: Run) -> Array:
    """Return the best linear filter's means (Nahi 1969), which knows only the share of received samples."""
    model = scenario.model
    A, C = model.A.single, model.C.single
    Q, R = model.w.cov().single, model.e.cov().single
    Pi, p0 = model.loss.chain(len(run.x), 1)
    p = p0 if len(Pi) == 1 else Pi[0]
    q = float(p[1])
    x, P = model.x0.mean, model.x0.P
    D = P + np.outer(x, x)
    means = np.empty_like(run.x)
    for t, y in enumerate(run.record.y):
        if t:
            x, P, D = A @ x, A @ P @ A.T + Q, A @ D @ A.T + Q
        S = q * q * C @ P @ C.T + q * (1 - q) * C @ D @ C.T + R
        K = q * np.linalg.solve(S, C @ P).T
        x, P = x + K @ (y - q * C @ x), P - K @ S @ K.T
        means[t] = x
    return means


def methods() -> dict[str, Any]:
    """Return the filters of the paper and those beyond it."""
    first: Any = {"prior": "predicted"}
    return {
        "BKF-I": hw.BKF1(**first),
        "BKF-II, no spread": hw.BKF2(spread=False, **first),
        "BKF-II": hw.BKF2(**first),
        "GPB depth 1": hw.GPB(1, **first),
        "GPB depth 3": hw.GPB(3, **first),
        "GPB depth 5": hw.GPB(5, **first),
        "Runnalls 8": hw.Runnalls(8, **first),
        "RBPF 10": hw.RBPF(10, **first),
        "RBPF 50": hw.RBPF(50, **first),
        "RBPF 100": hw.RBPF(100, **first),
        "RBPF 500": hw.RBPF(500, **first),
        "Fearnhead-Clifford 10": hw.FearnheadClifford(10, **first),
        "Fearnhead-Clifford 100": hw.FearnheadClifford(100, **first),
        "beam 8": hw.BeamSearch(8, **first),
        "beam 100": hw.BeamSearch(100, **first),
    }


def accuracy(
    scenario: Scenario, *, runs: int = 150, T: int = 60, seed: int = 1, depth: int = 10, only: Sequence[str] = ()
) -> dict[str, Score]:
    """Score every filter on the same records; the distance is to the pseudo-Bayes filter of depth `depth`."""
    records = [simulate(scenario, T, 1000 * seed + i) for i in range(runs)]
    chosen = {name: m for name, m in methods().items() if not only or name in only}
    reference = hw.GPB(depth, prior="predicted")
    truth = np.stack([r.x for r in records])[..., scenario.position]
    received = np.stack([r.received for r in records])
    best = np.stack([reference.run(scenario.model, r.record).x for r in records])[..., scenario.position]

    def score(x: Any, gamma: Any = None, seconds: float = np.nan) -> Score:
        position = np.stack(x)[..., scenario.position]
        wrong = np.nan if gamma is None else float(np.mean((np.stack(gamma) > 0.5) != received))
        return Score(_rms(position - truth), wrong, _rms(position - best), 1e6 * seconds / (runs * T))

    gated = [gate(scenario, r) for r in records]
    found = {
        "losses known": score([oracle(scenario, r) for r in records], received),
        "Kalman, all received": score([kalman(scenario, r) for r in records], np.ones_like(received)),
        "gate 99 %": score([x for x, _ in gated], [kept for _, kept in gated]),
        "linear (Nahi)": score([linear(scenario, r) for r in records]),
    }
    for name, method in chosen.items():
        start = time.process_time()
        answers = [method.run(scenario.model, r.record, seed=i) for i, r in enumerate(records)]
        seconds = time.process_time() - start
        found[name] = score([a.x for a in answers], [a.gamma for a in answers], seconds)
    return found


def exact(model: Any, record: Any, *, smooth: bool = False) -> tuple[Array, Array]:
    """Return mean (T, nx) and P(received) (T,) with every history of losses enumerated: pseudo-Bayes of depth T - 1.

    A filter that merges only what agrees on all modes merges nothing.
    """
    answer = hw.GPB(len(record) - 1, smooth=smooth, prior="predicted").run(model, record)
    assert answer.gamma is not None
    return answer.x, answer.gamma


def against_exact(
    scenario: Scenario, *, runs: int = 30, T: int = 12, seed: int = 7, extra: Any = None
) -> dict[str, tuple[float, float]]:
    """Return for each filter the rms distance to the exact mean over the RMSE, and the largest error of gamma."""
    records = [simulate(scenario, T, 1000 * seed + i) for i in range(runs)]
    truth = np.stack([r.x for r in records])[..., scenario.position]
    x, gamma = (np.stack(v) for v in zip(*[exact(scenario.model, r.record) for r in records], strict=True))
    x = x[..., scenario.position]
    rmse = _rms(x - truth)
    found = {}
    for name, method in (methods() | (extra or {})).items():
        answers = [method.run(scenario.model, r.record, seed=i) for i, r in enumerate(records)]
        far = _rms(np.stack([a.x for a in answers])[..., scenario.position] - x)
        found[name] = (far / rmse, float(np.max(np.abs(np.stack([np.asarray(a.gamma) for a in answers]) - gamma))))
    return found


def smoothing_against_exact(
    scenario: Scenario, depths: Sequence[int] = (1, 3, 5, 8), *, runs: int = 30, T: int = 12, seed: int = 3
) -> dict[int, tuple[float, float]]:
    """Return the same for smoothers of several depths."""
    records = [simulate(scenario, T, 1000 * seed + i) for i in range(runs)]
    truth = np.stack([r.x for r in records])[..., scenario.position]
    x, gamma = (np.stack(v) for v in zip(*[exact(scenario.model, r.record, smooth=True) for r in records], strict=True))
    x = x[..., scenario.position]
    rmse = _rms(x - truth)
    found = {}
    for depth in depths:
        method = hw.GPB(depth, smooth=True, prior="predicted")
        answers = [method.run(scenario.model, r.record) for r in records]
        far = _rms(np.stack([a.x for a in answers])[..., scenario.position] - x)
        found[depth] = (far / rmse, float(np.max(np.abs(np.stack([np.asarray(a.gamma) for a in answers]) - gamma))))
    return found


def lags(
    scenario: Scenario, *, runs: int = 40, T: int = 100, depth: int = 5, seed: int = 4
) -> dict[str, tuple[float, float]]:
    """Return (error of the detected losses, RMSE of the whole state) filtered, with a lag of 1 and 3, and smoothed."""
    records = [simulate(scenario, T, 1000 * seed + i) for i in range(runs)]
    truth, received = np.stack([r.x for r in records]), np.stack([r.received for r in records])
    found = {}
    for name, settings in {
        "filter": {},
        "lag 1": {"lag": 1},
        "lag 3": {"lag": 3},
        "smoother": {"smooth": True},
    }.items():
        method = hw.GPB(depth, prior="predicted", **settings)  # type: ignore[arg-type]
        answers = [method.run(scenario.model, r.record) for r in records]
        wrong = float(np.mean((np.stack([np.asarray(a.gamma) for a in answers]) > 0.5) != received))
        found[name] = (wrong, _rms(np.stack([a.x for a in answers]) - truth))
    return found


def learned(*, T: int = 2000, runs: int = 8, depth: int = 3, seed: int = 6) -> dict[str, Array]:
    """Return the laws that expectation maximisation finds in S1 (p) and S2 (stay received, stay lost), (runs, .)."""
    cases = scenarios()
    p, stay, drops = [], [], []
    for i in range(runs):
        for name, prior in (("S1", hw.Bernoulli.unknown()), ("S2", hw.Markov.unknown(0.7, 0.6))):
            run = simulate(cases[name], T, 1000 * seed + i)
            est = hw.GPB(depth, smooth=True, prior="predicted").run(_with(cases[name].model, prior), run.record)
            law = est.info["loss"]
            if name == "S1":
                p.append([float(law.received)])
            else:
                stay.append([float(law.stay_received), float(law.stay_lost)])
            drops.append([max(0.0, float(-np.diff(est.info["loglik_path"]).min(initial=0.0)))])
    return {"S1": np.array(p), "S2": np.array(stay), "drops": np.array(drops)}


def tables(*, quick: bool = False) -> tuple[Table, ...]:
    """Return the tables; `quick` takes a tenth of the records."""
    runs, short = (15, 6) if quick else (150, 30)
    cases = scenarios()
    found = []
    for name, case in cases.items():
        rows = [
            (method, round(s.rmse, 4), _cell(100 * s.gamma, 2), round(s.distance, 4), _cell(s.microseconds, 2))
            for method, s in accuracy(case, runs=runs).items()
        ]
        found.append(
            Table(
                f"{name}: accuracy against cost, {runs} records of 60 rows",
                ("filter", "RMSE", "wrong %", "distance", "us/row"),
                tuple(rows),
                ("position; distance: of the mean to a pseudo-Bayes filter of depth 10; time: one record from Python",),
            )
        )
    more = {"RBPF 1000": hw.RBPF(1000, prior="predicted"), "GPB depth 11": hw.GPB(11, prior="predicted")}
    near = {name: against_exact(case, runs=short, extra=more) for name, case in cases.items()}
    found.append(_pairs(f"Against the exact posterior, T = 12, {short} records", "filter", near))
    smooth = {name: smoothing_against_exact(case, runs=short) for name, case in cases.items()}
    found.append(_pairs(f"Smoothers against exact smoothing, T = 12, {short} records", "depth", smooth))
    late = {name: lags(case, runs=8 if quick else 40) for name, case in cases.items()}
    found.append(
        Table(
            "Wrongly judged samples in % / RMSE of the state, depth 5, T = 100",
            ("", *cases),
            tuple((k, *(f"{100 * late[c][k][0]:.2f} / {late[c][k][1]:.3f}" for c in cases)) for k in late["S1"]),
        )
    )
    T = 500 if quick else 2000
    law = learned(T=T, runs=3 if quick else 8)
    laws = [
        ("received", 0.7, law["S1"][:, 0]),
        ("stay received", BURSTS[0], law["S2"][:, 0]),
        ("stay lost", BURSTS[1], law["S2"][:, 1]),
    ]
    found.append(
        Table(
            f"Laws learned by expectation maximisation, T = {T}, depth 3",
            ("", "true", "mean", "sd"),
            tuple((name, true, round(float(v.mean()), 4), round(float(v.std()), 4)) for name, true, v in laws),
            (f"largest fall of the log-likelihood between iterations: {law['drops'].max():.1e}",),
        )
    )
    return tuple(found)


def _pairs(title: str, first: str, found: dict[str, dict[Any, tuple[float, float]]]) -> Table:
    rows = [
        (str(key), *(f"{100 * part[key][0]:.3f} / {part[key][1]:.0e}" for part in found.values()))
        for key in next(iter(found.values()))
    ]
    return Table(
        title, (first, *found), tuple(rows), ("distance of the mean in % of the RMSE / largest error of P(received)",)
    )


def _cell(value: float, digits: int) -> float | None:
    return round(value, digits) if np.isfinite(value) else None


def figures(folder: str | pathlib.Path, *, quick: bool = False) -> list[pathlib.Path]:
    """Draw accuracy against cost, and one crossing target, into a folder; returns the files."""
    plt, folder = canvas(folder)
    files = [folder / "paper001_trade.png", folder / "paper001_crossing.png"]
    figure, axes = plt.subplots(2, 2, figsize=(9, 7), constrained_layout=True)
    for axis, (name, case) in zip(axes.flat, scenarios().items(), strict=True):
        for method, s in accuracy(case, runs=15 if quick else 150).items():
            if np.isfinite(s.microseconds):
                axis.loglog(s.microseconds, max(s.distance, 1e-5), "o")
                axis.annotate(method, (s.microseconds, max(s.distance, 1e-5)), fontsize=6)
        axis.set(title=name, xlabel="microseconds a row", ylabel="distance of the mean to depth 10")
    saved(figure, files[0])
    case = scenarios()["S4"]
    run = simulate(case, 60, 3)
    smooth = hw.GPB(5, smooth=True, prior="predicted").run(case.model, run.record)
    decided = hw.BKF1(prior="predicted").run(case.model, run.record)
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), constrained_layout=True)
    left.plot(*run.x[:, [0, 2]].T, "k-", label="truth")
    left.plot(*run.record.y[run.received].T, "g.", label="received")
    left.plot(*run.record.y[~run.received].T, "r.", label="noise")
    left.plot(*decided.x[:, [0, 2]].T, "--", label="BKF-I")
    left.plot(*smooth.x[:, [0, 2]].T, label="GPB depth 5, smoothed")
    left.legend(fontsize=7)
    left.set(xlabel="m", ylabel="m")
    right.step(run.record.t, run.received, "k", where="mid", label="truth")
    right.step(run.record.t, smooth.gamma, where="mid", label="P(received)")
    right.legend(fontsize=7)
    right.set(xlabel="s")
    saved(figure, files[1])
    return files


def _with(model: Any, loss: Any) -> Any:
    import dataclasses

    return dataclasses.replace(model, loss=loss)


def _rms(d: Array) -> float:
    """Root mean square of distances."""
    return float(np.sqrt(np.mean(np.sum(np.square(d), axis=-1))))
