"""Bounds on the state of a Gaussian filter, each way of keeping them: `python benchmarks/constrained.py`.

First the moments of a Gaussian in a random box of three dimensions against 4 million draws; then a filter on the system of
Pavelková and Kárný (2013), three states in a box, q = .25, r = 1 or .3, states drawn inside by rejection: root mean square
error, normalised squared error (1 is honest), share of rows that obey, microseconds a row. Last the core alone with six
constraints. Processor time, least of the repeats.
"""

import dataclasses
import functools
import math
import time

import halfwidth._core as _core
import numpy as np

import halfwidth as hw
from halfwidth.reproduce import paper003

BY = ("ep", "truncate", "project", "nearest")


def least(run, rows, repeats=5):
    """Return the last answer and the least processor time in microseconds a row."""
    best = math.inf
    for _ in range(repeats):
        start = time.process_time()
        found = run()
        best = min(best, time.process_time() - start)
    return found, 1e6 * best / rows


def held(by, x, P, D, lo, hi):
    """One belief through the core: mean and covariance."""
    found = _core.constrain_run(BY.index(by), x[None].copy(), P[None].copy(), D, lo, hi)
    return found[0][0], found[1][0]


def moments(draws=4_000_000, count=20, least_mass=0.01):
    """Print the errors of mean and covariance in random boxes, by how correlated their Gaussians are."""
    print("Moments in a random box of three dimensions, 20 boxes that hold 1 % or more, against sampling")
    print("  P = A A' + ridge I   method     mean error / sd: median, max     covariance error: median, max")
    for ridge in (1.0, 0.1):
        rng = np.random.default_rng(0)
        errors = {by: [] for by in BY[:3]}
        noise = []
        z = rng.standard_normal((draws, 3))
        while len(noise) < count:
            A = rng.standard_normal((3, 3))
            P = A @ A.T + ridge * np.eye(3)
            sd = np.sqrt(np.diag(P))
            x = sd * rng.standard_normal(3)
            lo, hi = -sd * rng.uniform(0.3, 2, 3), sd * rng.uniform(0.3, 2, 3)
            inside = x + z @ np.linalg.cholesky(P).T
            inside = inside[((inside >= lo) & (inside <= hi)).all(axis=1)]
            if len(inside) < least_mass * draws:
                continue
            mean, C = inside.mean(axis=0), np.cov(inside.T)
            noise.append(1.0 / math.sqrt(len(inside)))
            for by, found in errors.items():
                X, S = held(by, x, P, np.eye(3), lo, hi)
                worst = float(np.abs((X - mean) / np.sqrt(np.diag(C))).max())
                found.append((worst, float(np.linalg.norm(S - C) / np.linalg.norm(C))))
        for by, found in errors.items():
            m, c = np.array(found).T
            print(f"  {ridge:<18g}   {by:<9}  {np.median(m):17.4f} {m.max():9.4f} {np.median(c):25.4f} {c.max():9.4f}")
        print(f"  (the sampling's own error of a mean is up to {max(noise):.4f} sd)")


def system(q, r):
    """Return the paper's system with Gaussian noise of the same variances, and its box."""
    return hw.Linear(
        paper003.A,
        paper003.B,
        paper003.C,
        hw.Gaussian(q**2 / 3),
        hw.Gaussian(r**2 / 3),
        hw.Normal(np.zeros(3), 0.1),
        bounds=paper003.BOX,
    )


def drawn(model, q, r, T, seed):
    """Return states inside the box, their uniform noise drawn again until they are, and the record."""
    rng = np.random.default_rng(seed)
    u, x, state = rng.uniform(-1, 1, (T, 1)), np.empty((T, 3)), np.zeros(3)
    for k in range(T):
        tries = 0
        while True:
            new = paper003.A @ state + paper003.B @ u[k] + rng.uniform(-q, q, 3)
            if model.bounds.contains(new):
                break
            tries += 1
            if tries % 100 == 0:  # an input that leads out is drawn again too
                u[k] = rng.uniform(-1, 1)
        x[k] = state = new
    return x, hw.Record(np.arange(1.0, T + 1), x @ paper003.C.T + rng.uniform(-r, r, (T, 2)), u)


def filters(T=400, seeds=range(20)):
    """Print the table of the ways to keep a box."""
    methods = {"no bounds": None}
    for by in ("truncate", "ep", "project", "nearest"):
        for feedback in (False, True):
            methods[f"{by}, {'fed back' if feedback else 'output'}"] = hw.Constrained(by=by, feedback=feedback)
    for q, r in ((0.25, 1.0), (0.25, 0.3)):
        model = system(q, r)
        runs = [drawn(model, q, r, T, seed) for seed in seeds]
        print(f"\nThree states in a box, q = {q:g}, r = {r:g}, {len(runs)} runs of {T} rows")
        print("  Kalman filter           RMSE   NEES / 3   obeys   us a row")
        for name, method in methods.items():
            plain = dataclasses.replace(model, bounds=None)
            squares, nees, obeys, cost = [], [], [], math.inf
            for truth, record in runs:
                start = time.process_time()
                if method is None:
                    est = hw.estimate(plain, record, hw.KalmanFilter())
                else:
                    est = hw.estimate(model, record, method).check()
                cost = min(cost, time.process_time() - start)
                off = est.x - truth
                squares.append(np.mean(off**2))
                nees.append(np.mean(np.einsum("ti,tij,tj->t", off, np.linalg.inv(est.P), off)) / 3)
                obeys.append(model.bounds.contains(est.x).mean())
            print(
                f"  {name:<20} {math.sqrt(np.mean(squares)):7.4f} {np.mean(nees):10.3f} {100 * np.mean(obeys):6.1f} %"
                f" {1e6 * cost / T:10.1f}"
            )


def speed(T=5_000):
    """Print the time of the core alone, a belief with six constraints."""
    print("\nThe core, microseconds a belief")
    rng = np.random.default_rng(0)
    shapes = {
        "3 states, box (6 sides)": (3, np.eye(3), -1.0, 1.0),
        "4 states, 6 half-spaces": (4, rng.standard_normal((6, 4)), -1.0, np.inf),
        "4 states, 6 slabs": (4, rng.standard_normal((6, 4)), -1.0, 1.0),
    }
    print(f"  {'':<26}" + "".join(f"{by:>10}" for by in BY))
    for name, (n, D, lo, hi) in shapes.items():
        A = rng.standard_normal((T, n, n))
        x, P = rng.standard_normal((T, n)), A @ A.transpose(0, 2, 1) + 0.1 * np.eye(n)
        ends = np.full(len(D), lo), np.full(len(D), hi)
        costs = [least(functools.partial(_core.constrain_run, k, x, P, D, *ends), T)[1] for k in range(len(BY))]
        print(f"  {name:<26}" + "".join(f"{cost:10.2f}" for cost in costs))


def main():
    moments()
    filters()
    speed()


if __name__ == "__main__":
    main()
