"""The vehicle of the first report: position through GPS outages of growing length, half-widths unknown.

The report's log is not public, so its set-up is simulated: GPS positions at 10 Hz, acceleration as input (eqs. (22),
(23)), outages that start at the same row and grow from 1 s to 10 s (figure 2), and one outage of 5 s between rows 50
and 100 (figure 3). The half-widths are unknown to the estimator; the Kalman smoother beside it is given the true
covariances, where the report tuned it by hand.

References
----------
Pavelková (2011), State estimation with missing data and bounded uncertainty, ÚTIA report 2296, sections 4 and 5.
"""

import dataclasses
import pathlib
from collections.abc import Sequence

import numpy as np

from halfwidth.array import Array
from halfwidth.methods.kalman import KalmanSmoother
from halfwidth.methods.map import BatchLP
from halfwidth.model import Linear
from halfwidth.noise import Noise, Uniform
from halfwidth.record import Record
from halfwidth.reproduce import Table, canvas, saved
from halfwidth.reproduce.drives import TOLERANCE, log_table, tolerance_row
from halfwidth.simulate import simulate
from halfwidth.spread import Box, Normal

H = 0.1
LENGTHS = (1, 2, 3, 4, 5, 6, 8, 10)
START = 50
ROWS = 250
LOG_METHODS = ("linear", "gpsins", "paper000", "paper000+ls")
POINTS = ("central", "least_squares", "optimal")


def vehicle(w: Noise, e: Noise, x0: Box | Normal | None) -> Linear:
    """Return the model of eqs. (22) and (23): position and velocity in the plane, acceleration as input."""
    return Linear(
        np.array([[1, 0, H, 0], [0, 1, 0, H], [0, 0, 1, 0], [0, 0, 0, 1]]),
        [[H * H / 2, 0], [0, H * H / 2], [H, 0], [0, H]],
        [[1, 0, 0, 0], [0, 1, 0, 0]],
        w,
        e,
        x0,
        names=["px", "py", "vx", "vy"],
        dt=H,
    )


def drive(seed: int) -> tuple[Linear, Array, Record]:
    """Return the true model, the true states and the complete record of 25 s of a curve."""
    k = np.arange(ROWS)
    u = np.c_[np.sin(k / 30), np.cos(k / 40)]
    true = vehicle(Uniform([0.01, 0.01, 0.03, 0.03]), Uniform(0.5), Box([-1, -1, 4, 4], [1, 1, 6, 6]))
    truth, record = simulate(true, u, seed=seed)
    return true, np.asarray(truth), record


def errors(seed: int, length: float) -> dict[str, Array]:
    """Return the position error (rows, 2) inside one outage, by estimator."""
    true, x, record = drive(seed)
    rows = slice(START, START + round(length / H))
    lost = record.without(record.t[rows.start], record.t[rows.stop - 1])
    unknown = vehicle(Uniform.unknown(at_most=1.0), Uniform.unknown(at_most=5.0), None)
    found = {f"LP, {p}": BatchLP(point=p).run(unknown, lost).x for p in POINTS}  # type: ignore[arg-type]
    gaussian = dataclasses.replace(true.as_gaussian(), x0=Normal([0, 0, 5, 5], 100.0))
    found["Kalman smoother"] = KalmanSmoother().run(gaussian, lost).x
    return {name: np.abs(est - x)[rows, :2] for name, est in found.items()}


def figure_two(*, quick: bool = False) -> Table:
    """Largest error against the length of the outage."""
    seeds, lengths = (range(2), (1, 5)) if quick else (range(20), LENGTHS)
    body = []
    names: list[str] = []
    for length in lengths:
        runs = [errors(seed, length) for seed in seeds]
        names = list(runs[0])
        body.append((length, *[round(float(np.mean([r[n].max() for r in runs])), 3) for n in names]))
    return Table(
        f"Figure 2: largest position error inside an outage, m, mean of {len(seeds)} drives",
        ("outage, s", *names),
        tuple(body),
        (
            "The report compares one real drive and finds its estimator slightly better than a Kalman smoother tuned by"
            " hand; here the smoother is given the true covariances, so it cannot be tuned better.",
        ),
    )


def figure_three(*, quick: bool = False) -> Table:
    """Error over time in the outage of 5 s."""
    seeds = range(2) if quick else range(20)
    runs = [errors(seed, 5.0) for seed in seeds]
    body = []
    for a in range(0, 50, 5):
        means = [round(float(np.mean([r[n][a : a + 5] for r in runs])), 3) for n in runs[0]]
        body.append((round(H * (a + 2), 1), *means))
    return Table(
        "Figure 3: mean position error in an outage of 5 s, m", ("s into it", *runs[0]), tuple(body),
        ("Largest in the middle, as in the report.",),
    )  # fmt: skip


def tolerance(*, quick: bool = False) -> Table:
    """Max and mean of the error in outages of 5 s, with the share of rows within half a metre."""
    runs = [errors(seed, 5.0) for seed in (range(2) if quick else range(20))]
    rows = [tolerance_row(name, np.vstack([run[name] for run in runs])) for name in runs[0]]
    return Table(
        f"Outages of 5 s, {len(runs)} drives: max (mean) of the absolute error, m, and share within {TOLERANCE:g} m",
        ("estimator", "px", "py", "within"),
        tuple(rows),
        ("The tolerance is that of the later slides; the report prints none.",),
    )


def tables(*, quick: bool = False, logs: Sequence[str] = ()) -> tuple[Table, ...]:
    """Return figures 2 and 3 as tables, the tolerance table, and the errors on logs."""
    found = (figure_two(quick=quick), figure_three(quick=quick), tolerance(quick=quick))
    return (*found, *(log_table(path, LOG_METHODS, quick=quick) for path in logs))


def figures(folder: str | pathlib.Path, *, quick: bool = False) -> list[pathlib.Path]:
    """Draw both figures into a folder; returns the files."""
    plt, folder = canvas(folder)
    files = []
    for number, table in ((2, figure_two(quick=quick)), (3, figure_three(quick=quick))):
        figure, ax = plt.subplots(figsize=(5, 3))
        at = [row[0] for row in table.rows]
        for k, name in enumerate(table.header[1:], start=1):
            ax.plot(at, [row[k] for row in table.rows], marker="o", markersize=3, label=name)
        ax.axhline(TOLERANCE, color="grey", linestyle="--")
        ax.set(xlabel=table.header[0], ylabel="m", title=table.title.split(",")[0])
        ax.legend(fontsize=7)
        files.append(saved(figure, folder / f"paper000_figure{number}.png"))
    return files
