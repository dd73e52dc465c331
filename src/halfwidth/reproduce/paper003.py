"""Tables I to III of the on-line estimator for correlated uniform noise, and its comparison with a Kalman filter.

The simulated system of the paper, section 6: three states, two outputs, half-widths .1 and .3, inputs uniform on
[-1, 1], T = 2500 rows, boxes on all states. The estimator is ``Window(SequentialLP(rounds=1))``, one linear program a
row about the last window's estimate, or ``Window(BatchLP())`` where E and F are known.

References
----------
Pavelková and Kárný (2013), State and parameter estimation of state-space model with entry-wise correlated uniform
noise, Int. J. Adapt. Control Signal Process.
"""

import math
import pathlib
import time
from typing import Any, NamedTuple

import numpy as np

from halfwidth.array import Array
from halfwidth.methods.constrain import Constrained
from halfwidth.methods.map import BatchLP
from halfwidth.methods.memory import prediction_errors
from halfwidth.methods.sequential import SequentialLP
from halfwidth.methods.window import Window, ensemble_interval
from halfwidth.model import Linear
from halfwidth.noise import Gaussian, Uniform
from halfwidth.record import Record
from halfwidth.reproduce import Table, canvas, saved
from halfwidth.result import Estimate
from halfwidth.spread import Box, Normal

A = np.array([[1, -0.5, 0.2], [0.5, 0.1, 0], [0.3, 0, -0.1]])
B = np.array([[0.1], [0.6], [0.3]])
C = np.array([[1, 0, 0.5], [0, 1, 0.5]])
E = np.array([[1, 0.5, 0.25], [0, 1, 0.3], [0, 0, 1]])
F = np.array([[1, 0.4], [0, 1]])
Q, R = 0.1, 0.3
BOX = Box([-0.80, -0.61, -0.40], [0.76, 0.66, 0.44])
KAPPA = (1.0, 1.5, 2.0)
T = 2500

#: Table I of the paper: V x 1e3, N % at each kappa.
TABLE_I = {
    5: (17, 34, 12, 5), 10: (8, 46, 16, 7), 15: (6, 51, 17, 6), 20: (6, 53, 17, 6), 25: (5, 53, 17, 6),
    30: (5, 53, 16, 6), 35: (5, 53, 16, 5), 40: (5, 53, 16, 5), 45: (5, 53, 16, 5), 50: (5, 54, 16, 5),
}  # fmt: skip
#: Table II: mean absolute errors of the three states and two outputs.
TABLE_II = {
    "LSU, memory 5": (0.15, 0.10, 0.06, 0.10, 0.10),
    "LSU, memory 25": (0.09, 0.07, 0.05, 0.13, 0.11),
    "KF, right": (0.07, 0.06, 0.05, 0.13, 0.15),
    "KF, wrong": (0.10, 0.11, 0.08, 0.50, 0.51),
}
#: Table III: V, N % at each kappa.
TABLE_III = {
    "LSU, memory 5": (1.7e-2, 30, 11, 4),
    "LSU, memory 25": (5.6e-3, 49, 14, 5),
    "KF, right": (7.1e-7, 67, 9, 1),
    "KF, wrong": (7.1e-4, 10, 1, 0),
}


class Drawn(NamedTuple):
    """A simulated experiment: states (T, 3), outputs and inputs."""

    x: Array
    record: Record


class Scores(NamedTuple):
    """What the tables show of one run."""

    V: float
    joint: Array
    entry: Array
    error: Array
    residual: Array
    predicted: Array
    seconds: float
    unsolved: int


def draw(seed: int, *, correlated: bool = True, rows: int = T) -> Drawn:
    """Simulate the paper's system: all inputs first, then all w, then all e; x[0] = 0, paths are not clipped."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, rows + 1)
    w = rng.uniform(-Q, Q, (rows, 3))
    e = rng.uniform(-R, R, (rows + 1, 2))
    left = np.linalg.inv(E) if correlated else np.eye(3)
    x = np.zeros((rows + 1, 3))
    for t in range(1, rows + 1):
        x[t] = left @ (A @ x[t - 1] + B[:, 0] * u[t] + w[t - 1])
    y = x @ C.T + e
    if correlated:
        y = y @ np.linalg.inv(F).T
    return Drawn(x[1:], Record(np.arange(1.0, rows + 1), y[1:], u[1:, None]))


def system(*, unknown: bool, correlated: bool = True, theta: tuple[float, float] = (0.0, 1.0)) -> Linear:
    """Return the paper's model with unknown half-widths; `unknown` makes the correlations theta."""
    e, f = (E.copy(), F.copy()) if correlated else (np.eye(3), np.eye(2))
    if unknown:
        e[0, 1] = e[0, 2] = e[1, 2] = f[0, 1] = math.nan
    noise = Uniform.unknown(at_most=1.0)
    bounds = theta if unknown else None
    plain = not unknown and not correlated
    return Linear(
        A, B, C, noise, noise, BOX, E=None if plain else e, F=None if plain else f, bounds=BOX, theta_bounds=bounds
    )


def lsu(drawn: Drawn, memory: int, model: Linear, *, point: str = "optimal") -> Estimate:
    """Run the paper's estimator."""
    inner: Any
    if model.theta_entries:
        inner = SequentialLP(rounds=1, objective="paper", point=point)  # type: ignore[arg-type]
    else:
        inner = BatchLP(objective="paper", point=point)  # type: ignore[arg-type]
    return Window(inner, memory, fixes=0).run(model, drawn.record)


def score(drawn: Drawn, est: Estimate, memory: int, model: Linear, seconds: float) -> Scores:
    """Return the paper's criteria (32) to (35), over rows whose interval is complete."""
    n = len(drawn.x)
    done = slice(memory, n - memory)
    sigma = 0.5 * (est.info["high"] - est.info["low"])[done]
    volume = (2 * memory / (memory - 2)) ** 3 * float(np.mean(np.prod(sigma, axis=1)))
    joint, entry = [], []
    for kappa in KAPPA:
        lo, hi = (v[done] for v in ensemble_interval(est, kappa))
        out = (drawn.x[done] < lo) | (drawn.x[done] > hi)
        joint.append(100 * out.any(axis=1).mean())
        entry.append(100 * out.mean())
    f = F if model.F is not None and not model.theta_entries else None
    y = est.x @ C.T if f is None else np.linalg.solve(f, (est.x @ C.T).T).T
    return Scores(
        volume,
        np.array(joint),
        np.array(entry),
        np.abs(est.x - drawn.x)[memory:].mean(axis=0),
        np.abs(drawn.record.y - y)[memory:].mean(axis=0),
        np.nanmean(np.abs(prediction_errors(model, drawn.record, est.x, est.info.get("theta")))[memory:], axis=0),
        seconds,
        len(est.info["unsolved"]),
    )


def experiment(memory: int, seeds: range, *, unknown: bool, correlated: bool, rows: int = T, point: str = "optimal",
               theta: tuple[float, float] = (0.0, 1.0)) -> list[Scores]:  # fmt: skip
    """Run and score one setting over seeds."""
    model = system(unknown=unknown, correlated=correlated, theta=theta)
    found = []
    for seed in seeds:
        drawn = draw(seed, correlated=correlated, rows=rows)
        begin = time.process_time()
        est = lsu(drawn, memory, model, point=point)
        found.append(score(drawn, est, memory, model, (time.process_time() - begin) / rows))
    return found


def truncated_kalman(drawn: Drawn, factor: float) -> tuple[Array, Array]:
    """Run the truncated Kalman filter with `factor` times the true covariances: means (T, 3) and covariances.

    After each correction the density is cut at the bounds and replaced by the normal one of the same mean and variance
    (Simon and Simon 2010), one state after the other; the filter goes on from there.
    """
    w, e = (Gaussian(factor * half**2 / 3) for half in (Q, R))
    model = Linear(A, B, C, w, e, Normal(np.zeros(3), 1e-6), bounds=BOX)
    est = Constrained(by="truncate", feedback=True).run(model, drawn.record)
    assert est.P is not None
    return est.x, est.P


def table_one(*, quick: bool = False) -> Table:
    """Volume and reliability of the interval against memory."""
    rows, seeds = (400, range(1)) if quick else (T, range(5))
    body = []
    for memory in (5, 25) if quick else (5, 10, 15, 25, 50):
        found = experiment(memory, seeds, unknown=True, correlated=True, rows=rows)
        V = np.array([s.V for s in found]) * 1e3
        paper = TABLE_I[memory]
        body.append(
            (
                memory, paper[0], round(V.mean(), 2), round(float(V.std(ddof=1)), 2) if len(V) > 1 else None,
                "/".join(map(str, paper[1:])),
                "/".join(f"{v:.0f}" for v in np.mean([s.joint for s in found], axis=0)),
                "/".join(f"{v:.0f}" for v in np.mean([s.entry for s in found], axis=0)),
                round(1e3 * float(np.mean([s.seconds for s in found])), 2), sum(s.unsolved for s in found),
            )
        )  # fmt: skip
    return Table(
        "Table I: interval of the LSU estimator against memory (E, F estimated, theta in [0, 1])",
        ("memory", "V paper x1e-3", "V", "sd", "N paper", "N joint", "N entry", "ms a row", "unsolved"),
        tuple(body),
        (
            "N is the share of states outside the interval at kappa 1/1.5/2. Definition (35) does not say whether one"
            " entry outside counts: 'joint' counts any, 'entry' each. Neither gives the paper's column.",
            "V depends on the solver: simplex vertices give nearly twice the volume of interior points at memory 25.",
            "The paper states no prior of theta; [0, 1] comes closest of those tried.",
        ),
    )


def table_two(*, quick: bool = False) -> Table:
    """Errors of states and outputs beside the truncated Kalman filter, on uncorrelated noise."""
    rows, seeds = (400, range(1)) if quick else (T, range(5))
    body: list[tuple[Any, ...]] = []

    def add(name: str, what: str, values: Array) -> None:
        body.append((name, what, *[round(float(v), 3) for v in values]))

    for memory in (5, 25):
        name = f"LSU, memory {memory}"
        body.append((name, "paper", *TABLE_II[name]))
        for unknown, point, what in (
            (True, "optimal", "theta estimated"),
            (False, "optimal", "theta known"),
            (False, "central", "theta known, central"),
        ):
            found = experiment(memory, seeds, unknown=unknown, correlated=False, rows=rows, point=point)
            mean = [np.mean([getattr(s, k) for s in found], axis=0) for k in ("error", "residual", "predicted")]
            add(name, what, np.concatenate(mean))
    for name, factors in (("KF, right", (1,)), ("KF, wrong", (3, 9, 20))):
        body.append((name, "paper", *TABLE_II[name]))
        for factor in factors:
            error, residual, predicted = [], [], []
            for seed in seeds:
                drawn = draw(seed, correlated=False, rows=rows)
                x, _ = truncated_kalman(drawn, factor)
                error.append(np.abs(x - drawn.x)[25:].mean(axis=0))
                residual.append(np.abs(drawn.record.y - x @ C.T)[25:].mean(axis=0))
                assert drawn.record.u is not None
                ahead = (x[:-1] @ A.T + drawn.record.u[1:] @ B.T) @ C.T
                predicted.append(np.abs(drawn.record.y[1:] - ahead)[25:].mean(axis=0))
            means = [np.mean(v, axis=0) for v in (error, residual, predicted)]
            add(name, f"{factor} x covariance", np.concatenate(means))
    return Table(
        "Table II: mean absolute errors of states x and outputs y",
        ("estimator", "which", "x1", "x2", "x3", "y1", "y2", "y1 ahead", "y2 ahead"),
        tuple([(*row, *[None] * (9 - len(row))) for row in body]),
        (
            "y1, y2 are residuals at the filtered state: the paper's 'prediction errors' are smaller than the mean of"
            " |e| alone, so no prediction can reach them. 'ahead' is the true one-step prediction.",
            "The paper's wrong covariances, three times in standard deviation, fit 18 to 20 times the covariance;"
            " its errors of .50 and .51 fit no reading.",
        ),
    )


def table_three(*, quick: bool = False) -> Table:
    """Volumes and reliability beside the Kalman filter's."""
    rows, seeds = (400, range(1)) if quick else (T, range(5))
    body: list[tuple[Any, ...]] = []
    for memory in (5, 25):
        name = f"LSU, memory {memory}"
        paper = TABLE_III[name]
        found = experiment(memory, seeds, unknown=False, correlated=False, rows=rows)
        body.append(
            (
                name, paper[0], float(np.mean([s.V for s in found])), None, "/".join(map(str, paper[1:])),
                "/".join(f"{v:.0f}" for v in np.mean([s.joint for s in found], axis=0)),
            )
        )  # fmt: skip
    for name, factor in (("KF, right", 1), ("KF, wrong", 20)):
        paper = TABLE_III[name]
        volume, ball, out = [], [], []
        for seed in seeds:
            drawn = draw(seed, correlated=False, rows=rows)
            x, P = truncated_kalman(drawn, factor)
            det = np.linalg.det(P[25:])
            volume.append(det.mean())
            ball.append((4 / 3 * np.pi * np.sqrt(det)).mean())
            off = (x - drawn.x)[25:]
            distance = np.einsum("ti,tij,tj->t", off, np.linalg.inv(P[25:]), off)
            out.append([100 * (distance > kappa**3).mean() for kappa in KAPPA])
        body.append(
            (
                name, paper[0], float(np.mean(volume)), float(np.mean(ball)), "/".join(map(str, paper[1:])),
                "/".join(f"{v:.0f}" for v in np.mean(out, axis=0)),
            )
        )  # fmt: skip
    return Table(
        "Table III: volume and reliability of the intervals, E = F = I known",
        ("estimator", "V paper", "V", "V of the 1-sigma ellipsoid", "N paper", "N"),
        tuple(body),
        (
            "The paper's V of the filter is |P|, a squared volume; the ellipsoid's own volume is a quarter of the"
            " LSU box, not a ten-thousandth.",
            "The threshold kappa^3 of eq. (36) should be kappa^2.",
        ),
    )


def central_gain(*, quick: bool = False) -> Table:
    """Filter error of the central point beside the optimal point and a simplex vertex."""
    from halfwidth.methods._rows import window_starts
    from halfwidth.methods.window import window_chain
    from halfwidth.solvers.lp import solve
    from halfwidth.solvers.stock import HIGHS

    every, seeds = (40, range(1)) if quick else (40, range(3))
    memory, body = 25, []
    errors: dict[str, list[Array]] = {"simplex vertex": [], "optimal": [], "central": []}
    model = system(unknown=False, correlated=False)
    for seed in seeds:
        drawn = draw(seed, correlated=False, rows=1200 if quick else T)
        chain = window_chain(BatchLP(objective="paper"), model, drawn.record, memory)
        assert chain is not None
        start = window_starts(drawn.record.seen, memory, fixes=0)
        optimal = lsu(drawn, memory, model).x
        central = lsu(drawn, memory, model, point="central").x
        for t in range(memory + 5, len(drawn.x), every):
            vertex = solve(chain.part(int(start[t]), t + 1).program(), (HIGHS,))
            assert vertex.x is not None
            newest = vertex.x[(t + 1 - int(start[t])) * 3 :][:3]
            for name, x in (("simplex vertex", newest), ("optimal", optimal[t]), ("central", central[t])):
                errors[name].append(np.abs(x - drawn.x[t]))
    top = float(np.mean(errors["simplex vertex"]))
    for name, values in errors.items():
        body.append((name, len(values), round(float(np.mean(values)), 4), round(top / float(np.mean(values)), 2)))
    return Table(
        "Filter error by the point of the optimal face, memory 25",
        ("point", "windows", "mean |error|", "gain"),
        tuple(body),
    )


def tables(*, quick: bool = False) -> tuple[Table, ...]:
    """Return all tables."""
    return table_one(quick=quick), table_two(quick=quick), table_three(quick=quick), central_gain(quick=quick)


def figures(folder: str | pathlib.Path, *, quick: bool = False) -> list[pathlib.Path]:
    """Draw figures 1 to 3 and table I into a folder; returns the files.

    Figure 1 shows the estimate of F12 over time, figure 2 the interval of the third state, figure 3 the time of a row
    against the number of states; table I is drawn with the paper's values beside ours.
    """
    plt, folder = canvas(folder)
    rows = 400 if quick else T
    drawn, model = draw(0, rows=rows), system(unknown=True)
    runs = {memory: lsu(drawn, memory, model) for memory in (5, 25)}
    files = []

    figure, ax = plt.subplots(figsize=(8, 3))
    for memory, style in ((5, ":"), (25, "-")):
        ax.plot(runs[memory].info["theta"][:300, 3], style, label=f"memory {memory}")
    ax.axhline(F[0, 1], color="black", linewidth=0.8, label="true")
    ax.set(xlabel="row", ylabel="F12", title="Figure 1: estimate of F12")
    ax.legend()
    files.append(saved(figure, folder / "paper003_figure1.png"))

    figure, ax = plt.subplots(figsize=(8, 3))
    span = slice(100, 160)
    ax.plot(range(100, 160), drawn.x[span, 2], "o", markersize=3, label="true")
    for kappa, style in ((1.0, "-"), (1.5, "--"), (2.0, ":")):
        lo, hi = ensemble_interval(runs[25], kappa)
        for k, side in enumerate((lo, hi)):
            ax.plot(range(100, 160), side[span, 2], style, color="C1", label=f"kappa {kappa}" if k == 0 else None)
    ax.set(xlabel="row", ylabel="x3", title="Figure 2: interval of the third state, memory 25")
    ax.legend()
    files.append(saved(figure, folder / "paper003_figure2.png"))

    figure, ax = plt.subplots(figsize=(5, 3))
    rng = np.random.default_rng(0)
    sizes = (1, 2, 3, 4, 6, 8)
    for memory in (5, 25):
        took = []
        for nx in sizes:
            a = rng.normal(size=(nx, nx))
            a *= 0.9 / np.abs(np.linalg.eigvals(a)).max()
            noise = Uniform.unknown(at_most=10.0)
            some = Linear(a, np.ones((nx, 1)), np.ones((1, nx)), noise, noise, None)
            y = rng.normal(size=(200, 1))
            record = Record(np.arange(200.0), y, rng.uniform(-1, 1, (200, 1)))
            est = Window(BatchLP(objective="paper", point="optimal"), memory, fixes=0).run(some, record)
            took.append(1e3 * float(np.median(est.info["seconds"][memory:])))
        ax.semilogy(sizes, took, marker="o", label=f"memory {memory}")
    ax.set(xlabel="states", ylabel="ms a row", title="Figure 3: time of a row")
    ax.legend()
    files.append(saved(figure, folder / "paper003_figure3.png"))

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3))
    memories = (5, 10, 25) if quick else (5, 10, 15, 25, 50)
    ours = [experiment(memory, range(1), unknown=True, correlated=True, rows=rows)[0] for memory in memories]
    left.plot(TABLE_I.keys(), [row[0] for row in TABLE_I.values()], "ks", fillstyle="none", label="paper")
    left.plot(memories, [1e3 * one.V for one in ours], "o-", label="ours")
    left.set(xlabel="memory", ylabel="V x 1e3", title="Table I: volume", ylim=(0, None))
    for k, kappa in enumerate(KAPPA):
        right.plot(TABLE_I.keys(), [row[1 + k] for row in TABLE_I.values()], "s", color=f"C{k}", fillstyle="none")
        right.plot(memories, [one.joint[k] for one in ours], "-", color=f"C{k}", label=f"kappa {kappa}, any entry")
        right.plot(memories, [one.entry[k] for one in ours], ":", color=f"C{k}")
    right.set(
        xlabel="memory", ylabel="outside, %", title="Table I: N; squares: paper, dotted: by entry", ylim=(0, None)
    )
    left.legend()
    right.legend(fontsize=7)
    files.append(saved(figure, folder / "paper003_table1.png"))
    return files
