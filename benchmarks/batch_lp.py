"""BatchLP: CPU time by length of the record, and its objective beside HiGHS on random problems.

Run ``python benchmarks/batch_lp.py``; times are medians of process CPU time.
"""

import statistics
import sys
import time

import numpy as np

import halfwidth as hw

H = 0.2
A = [[1, 0, H, 0], [0, 1, 0, H], [0, 0, 1, 0], [0, 0, 0, 1]]
B = [[H * H / 2, 0], [0, H * H / 2], [H, 0], [0, H]]
C = [[1, 0, 0, 0], [0, 1, 0, 0]]


def drive(T, seed=0, lost=20):
    """Return the vehicle with unknown half-widths and a record of T rows, 20 % of it in outages of 20 rows."""
    k = np.arange(T)
    u = np.c_[np.sin(k / 30), np.cos(k / 40)]
    true = hw.Linear(A, B, C, hw.Uniform([0.02, 0.02, 0.05, 0.05]), hw.Uniform(0.5), hw.Box([-1] * 4, [1] * 4), dt=H)
    _, record = hw.simulate(true, u, seed=seed)
    y = record.y.copy()
    for start in range(40, T - lost, 100):
        y[start : start + lost] = np.nan
    unknown = hw.Uniform.unknown(at_most=10.0)
    return hw.Linear(A, B, C, unknown, unknown, None, dt=H), hw.Record(record.t, y, record.u)


def cpu(method, model, record, runs):
    times, est = [], None
    for _ in range(runs):
        start = time.process_time()
        est = hw.estimate(model, record, method)
        times.append(time.process_time() - start)
    return statistics.median(times), est.check()


def speed():
    print(f"{'rows':>6} {'point':>14} {'solver':>7} {'CPU s':>7} {'objective':>14} {'gap':>8}")
    for T in (100, 1000, 3000):
        model, record = drive(T)
        for point, solver in (("optimal", "piqp"), ("least_squares", "auto"), ("optimal", "highs")):
            if solver == "highs" and T > 1000:
                continue
            took, est = cpu(hw.BatchLP(point=point, solver=solver), model, record, 5 if solver != "highs" else 1)
            value, gap = est.info["objective"], est.info["check"]["gap"]
            print(f"{T:6d} {point:>14} {est.info['solver']:>7} {took:7.3f} {value:14.9f} {gap:8.1e}")


def agreement(problems=200):
    worst, status = 0.0, {}
    rng = np.random.default_rng(0)
    for seed in range(problems):
        nx, ny, T = int(rng.integers(1, 5)), int(rng.integers(1, 4)), int(rng.integers(5, 40))
        A = rng.normal(size=(nx, nx))
        A *= 0.95 / max(np.abs(np.linalg.eigvals(A)))
        w = hw.Uniform(rng.uniform(0.05, 0.3, nx))
        true = hw.Linear(A, None, rng.normal(size=(ny, nx)), w, hw.Uniform(0.3), hw.Box([-1] * nx, [1] * nx))
        _, record = hw.simulate(true, None, T=T, seed=seed)
        y = record.y.copy()
        y[rng.random(y.shape) < 0.2] = np.nan
        unknown = hw.Uniform.unknown(at_most=50.0)
        model = hw.Linear(A, None, true.C, unknown, unknown, None)
        one = hw.estimate(model, hw.Record(record.t, y), hw.BatchLP(point="optimal", solver="piqp"))
        two = hw.estimate(model, hw.Record(record.t, y), hw.BatchLP(point="optimal", solver="highs"))
        key = one.status.name, two.status.name
        status[key] = status.get(key, 0) + 1
        if one.status is hw.Status.OK and two.status is hw.Status.OK:
            a, b = one.info["objective"], two.info["objective"]
            worst = max(worst, abs(a - b) / max(abs(b), 1e-3))
    print(f"objective, PIQP against HiGHS on {problems} problems: largest relative difference {worst:.1e}; {status}")


if __name__ == "__main__":
    speed()
    agreement(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
