"""Two antennas, GPS and CAN: position through outages by the nonlinear MAP estimate with unknown half-widths.

The slides' logs are not public, so drives are simulated with known truth: differential fixes of centimetres, CAN speed
in steps of 0.1 km/h, a yaw rate with bias, two antennas 1.2 m apart, one outage each. What the slides show is shown:
the course of the absolute error with the tolerance of 0.5 m, and max and mean of it for each part of a trajectory
("TR"); and what they do not: error against the length of the outage, and the linearised model beside the nonlinear.

References
----------
Pavelková, Estimation of Moving Vehicle Position, slides of ÚTIA with Škoda Auto.
"""

import pathlib
from collections.abc import Sequence
from functools import cache

import numpy as np

from halfwidth.array import Array
from halfwidth.reproduce import Table, canvas, saved
from halfwidth.reproduce.drives import TOLERANCE, log_table, tolerance_row
from halfwidth.vehicle import simulate_drive
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.antennas import TwoAntennas, solve
from halfwidth.vehicle.estimators import METHODS
from halfwidth.vehicle.grid import sampled

#: The second antenna, as seen from the first: metres ahead, metres to the left.
SECOND = (0.0, 1.2)
LENGTH = 20.0
LENGTHS = (2.0, 5.0, 10.0, 20.0, 30.0, 60.0)
ESTIMATORS = ("straight line", "linearised", "nonlinear, one antenna", "nonlinear, two antennas")
LOG_METHODS = ("linear", "gpsins", "paper002lin", "paper002")


@cache
def errors(seed: int, length: float) -> tuple[Array, dict[str, Array]]:
    """Return seconds into one outage, and by estimator the error (rows, 2 or 4) of east and north, m, inside it."""
    truth, log = simulate_drive(
        duration=80.0 + length, seed=seed, tunnels=[length], fix_noise=0.02, fix_offset=0.05, second=SECOND,
        speed_step=0.1 / 3.6, yaw_noise=0.002, yaw_bias=0.003,
    )  # fmt: skip
    sensors = calibrated(log)
    one, two = sampled(log, sensors=sensors), sampled(log, sensors=sensors, second=truth.second)
    first, last = truth.outages[0]
    inside = (one.t >= first) & (one.t <= last) & ~one.seen
    arm = np.column_stack(sensors.arm(one.t))
    true = np.column_stack(one.frame.to_local(*truth.at(one.t)))
    azimuth = np.interp(one.t, truth.t, np.unwrap(truth.azimuth_rad))
    ahead, left = SECOND
    beside = np.column_stack(
        (ahead * np.sin(azimuth) - left * np.cos(azimuth), ahead * np.cos(azimuth) + left * np.sin(azimuth))
    )
    paths = {
        "straight line": METHODS["linear"].run([one], {})[0],
        "linearised": solve([two], TwoAntennas(nonlinear=False))[0],
        "nonlinear, one antenna": solve([one])[0],
        "nonlinear, two antennas": solve([two])[0],
    }
    found = {}
    for name, path in paths.items():
        off = np.column_stack((path.east, path.north)) + arm - true
        if "second" in path.info:
            off = np.hstack((off, path.info["second"] + arm - true - beside))
        found[name] = off[inside]
    return one.t[inside] - first, found


def tolerance(*, quick: bool = False) -> Table:
    """Max and mean of the absolute error of both antennas, part by part, with the share within tolerance."""
    seeds = range(2) if quick else range(8)
    name = "nonlinear, two antennas"
    rows = [tolerance_row(f"TR {seed + 1}", errors(seed, LENGTH)[1][name]) for seed in seeds]
    for other in ("linearised", name):
        rows.append(tolerance_row(f"all, {other}", np.vstack([errors(seed, LENGTH)[1][other] for seed in seeds])))
    return Table(
        f"Outages of {LENGTH:g} s: max (mean) of the absolute error, m, and share of rows within {TOLERANCE:g} m",
        ("part", "px1", "py1", "px2", "py2", "within"),
        tuple(rows),
        (
            "The slides print these for parts of one real drive with differential GPS; the log is not public and the"
            " slides' own numbers are in figures, so simulated drives stand for it.",
            "Rows are 0.2 s apart (the grid of `fill`) where the slides have 0.1 s; the azimuth is that in the middle"
            " of a step where the slides have that at its start, and the line between the antennas turns with the car.",
        ),
    )


def against_length(*, quick: bool = False) -> Table:
    """Error against the length of the outage."""
    seeds, lengths = (range(2), (5.0, 20.0)) if quick else (range(8), LENGTHS)
    rows = []
    for length in lengths:
        runs = [errors(seed, length)[1] for seed in seeds]
        cells = []
        for name in ESTIMATORS:
            off = [np.hypot(run[name][:, 0], run[name][:, 1]) for run in runs]
            cells.append(f"{np.mean(np.concatenate(off)):.2f} / {np.mean([o.max() for o in off]):.2f}")
        rows.append((length, *cells))
    return Table(
        f"Error of the first antenna by length of the outage, {len(seeds)} drives: mean / mean of maxima, m",
        ("outage, s", *ESTIMATORS),
        tuple(rows),
        ("A second antenna fixes the heading at the edges of an outage; inside, speed and yaw rate count.",),
    )


def course(*, quick: bool = False) -> Table:
    """Course of the absolute error through one outage."""
    t, found = errors(0, LENGTH)
    off = np.abs(found["nonlinear, two antennas"])
    step = max(1, len(t) // (5 if quick else 10))
    rows = [(round(float(t[k]), 1), *(round(float(v), 3) for v in off[k])) for k in range(0, len(t), step)]
    return Table(
        "Course of the absolute error through an outage of 20 s (TR 1), m", ("s into it", "px1", "py1", "px2", "py2"),
        tuple(rows), (f"The tolerance of the slides is {TOLERANCE:g} m.",),
    )  # fmt: skip


def tables(*, quick: bool = False, logs: Sequence[str] = ()) -> tuple[Table, ...]:
    """Return the tables on simulated drives and on logs."""
    found = (tolerance(quick=quick), against_length(quick=quick), course(quick=quick))
    return (*found, *(log_table(path, LOG_METHODS, quick=quick) for path in logs))


def figures(folder: str | pathlib.Path, *, quick: bool = False) -> list[pathlib.Path]:
    """Draw the course of the errors and the error against length into a folder; returns the files."""
    plt, folder = canvas(folder)
    files = []
    t, found = errors(0, LENGTH)
    figure, axes = plt.subplots(2, 2, figsize=(7, 4), sharex=True, sharey=True)
    for k, (ax, label) in enumerate(zip(axes.T.ravel(), ("px1", "py1", "px2", "py2"), strict=True)):
        for name in ("linearised", "nonlinear, two antennas"):
            ax.plot(t, np.abs(found[name][:, k]), label=name)
        ax.axhline(TOLERANCE, color="grey", linestyle="--")
        ax.set(ylabel=f"|error of {label}|, m")
    axes[1, 0].set(xlabel="s into the outage")
    axes[1, 1].set(xlabel="s into the outage")
    axes[0, 0].legend(fontsize=7)
    files.append(saved(figure, folder / "paper002_course.png"))
    table = against_length(quick=quick)
    figure, ax = plt.subplots(figsize=(5, 3))
    for k, name in enumerate(ESTIMATORS, start=1):
        ax.loglog(
            [row[0] for row in table.rows], [float(str(row[k]).split(" / ")[1]) for row in table.rows], "o-", label=name
        )
    ax.axhline(TOLERANCE, color="grey", linestyle="--")
    ax.set(xlabel="outage, s", ylabel="mean of largest distances, m")
    ax.legend(fontsize=7)
    files.append(saved(figure, folder / "paper002_length.png"))
    return files
