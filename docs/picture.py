"""Draw the picture of the README: ``python docs/picture.py`` writes docs/first_gap.png."""

import pathlib

import numpy as np
from matplotlib.figure import Figure

import halfwidth as hw


def main():
    dt = 0.1
    step = np.array([[1.0, dt], [0.0, 1.0]])
    car = hw.Linear(
        np.kron(np.eye(2), step),
        np.kron(np.eye(2), [[dt**2 / 2], [dt]]),
        np.kron(np.eye(2), [[1.0, 0.0]]),
        hw.Uniform([0.02, 0.05, 0.02, 0.05]),
        hw.Uniform(0.5),
        hw.Box(-1.0, 1.0),
        dt=dt,
    )
    acceleration = np.c_[np.sin(np.arange(300) / 30), np.cos(np.arange(300) / 40)]
    truth, drive = hw.simulate(car, acceleration, seed=1)
    drive = drive.without(12.0, 17.0)
    figure = Figure(figsize=(8, 3.2), layout="constrained", dpi=120)
    ax = figure.subplots()
    for method, colour in ((hw.KalmanFilter(), "#e08214"), (hw.KalmanSmoother(), "#2166ac")):
        est = hw.estimate(car.as_gaussian(), drive, method)
        lo, hi = est.interval(0.9)
        base = truth.x[:, 0]
        ax.fill_between(est.t, lo[:, 0] - base, hi[:, 0] - base, color=colour, alpha=0.25, lw=0)
        ax.plot(est.t, est.x[:, 0] - base, color=colour, lw=1.5, label=f"{type(method).__name__}, 90 %")
    seen = drive.seen[:, 0]
    ax.plot(drive.t[seen], drive.y[seen, 0] - truth.x[seen, 0], ".", ms=2, color="0.5", label="fixes")
    gap = drive.gaps()[0]
    ax.axvspan(gap.start, gap.stop, color="0.93", zorder=0)
    ax.annotate("tunnel", ((gap.start + gap.stop) / 2, 1.85), ha="center", color="0.35")
    ax.axhline(0.0, color="0.2", lw=0.8)
    ax.set(xlabel="t [s]", ylabel="east, error [m]", xlim=(8, 22), ylim=(-1.7, 2.1))
    ax.legend(loc="lower left", fontsize="small", ncols=3, frameon=False)
    figure.savefig(pathlib.Path(__file__).with_name("first_gap.png"))


if __name__ == "__main__":
    main()
