"""Mixed noise: half-widths, worst-case coverage and speed.

    python benchmarks/mixed.py [--quick]      the table and the speed
    python benchmarks/speed.py mixed          the speed alone

A cart with constant velocity whose acceleration and position fixes carry Gaussian noise (variances q, r) and a bounded part
(|d|, |e|). Adversaries drive the bounded parts: constant, random, switching, half. Coverage is that of the position, at the
nominal 99.73 %, the worst over adversaries; the half-width is bound plus three standard deviations of a filter in its
steady state; the optimum is the best affine estimate from 40 rows (one second-order cone program).
"""

import dataclasses
import sys
import time

import numpy as np

import halfwidth as hw

SETTINGS = [(0.01, 0.05, 1.0, 1.0), (0.01, 0.02, 0.04, 1.0), (0.01, 0.02, 4.0, 0.3)]
LEVEL = 0.9973
ROWS = 80
#: What a step of the filter may cost with four states and two outputs, in microseconds.
LIMIT = 5.0


def cart(q, d, r, e):
    """Return the cart; E turns (0, d) into the bounded acceleration d [1/2, 1]."""
    E = np.array([[1.0, -0.5], [0.0, 1.0]])
    Q = q * E @ np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]) @ E.T
    w, noise = hw.Uniform([0.0, d]) + hw.Gaussian(0.5 * (Q + Q.T)), hw.Uniform(e) + hw.Gaussian(r)
    return hw.Linear(E @ [[1.0, 1.0], [0.0, 1.0]], None, [[1.0, 0.0]], w, noise, hw.Normal(np.zeros(2), 1.0), E=E)


def adversaries(seed):
    """Return what the bounded noises do, in units of their bounds."""
    rng = np.random.default_rng(seed)
    one, wave = np.ones(ROWS), np.where(np.arange(ROWS) // 20 % 2 == 0, 1.0, -1.0)
    return {
        "constant": (one, one),
        "random": (rng.uniform(-1, 1, ROWS), rng.uniform(-1, 1, ROWS)),
        "switching": (wave, wave),
        "half": (one, 0.5 * one),
    }


def drawn(model, d, e, seed):
    """Return positions (T,) and record of a cart under given bounded noises."""
    rng = np.random.default_rng(seed)
    fold = np.linalg.inv(model.E.single)
    A, k = fold @ model.A.single, np.arange(ROWS)
    w = model.w.gaussian.sample(rng, k, np.ones(ROWS)) + np.column_stack([np.zeros(ROWS), d])
    noise = model.e.gaussian.sample(rng, k, np.ones(ROWS))[:, 0] + e
    x, state = np.empty(ROWS), model.x0.sample(rng)
    for t in range(ROWS):
        state = A @ state + fold @ w[t]
        x[t] = state[0]
    return x, hw.Record(k + 1.0, x + noise)


def methods(model):
    """Return the estimators of the table by name: (model, method)."""
    plain = dataclasses.replace(model, w=model.w.gaussian, e=model.e.gaussian)
    e, r = float(model.e.uniform.q[0]), model.e.gaussian.cov().single
    third, whole = (dataclasses.replace(plain, e=hw.Gaussian(r + s * e * e)) for s in (1 / 3, 1.0))
    return {
        "KF, sets ignored": (plain, hw.KalmanFilter()),
        "KF, r + e^2/3": (third, hw.KalmanFilter()),
        "KF, r + e^2": (whole, hw.KalmanFilter()),
        "MixedFilter()": (model, hw.MixedFilter()),
        'form="ellipsoid"': (model, hw.MixedFilter(form="ellipsoid")),
        'form="ellipsoid", criterion="width"': (model, hw.MixedFilter(form="ellipsoid", criterion="width")),
        'form="ellipsoid", gain="set"': (model, hw.MixedFilter(form="ellipsoid", gain="set")),
        'form="ellipsoid", truncate=True': (model, hw.MixedFilter(form="ellipsoid", truncate=True)),
        'form="zonotope", generators=20': (model, hw.MixedFilter(form="zonotope", generators=20)),
        'form="zonotope", generators=60': (model, hw.MixedFilter(form="zonotope")),
        "MixedWindow(memory=40)": (model, hw.MixedWindow(memory=40)),
    }


def table(quick=False):
    """Print worst-case coverage, half-width, its ratio to the optimum, and the error beside the Kalman filter's."""
    seeds = range(3 if quick else 40)
    for setting in SETTINGS:
        model = cart(*setting)
        quiet = hw.Record(np.arange(1.0, 121), np.zeros(120))
        optimum = plain(hw.estimate(model, quiet, hw.MixedWindow(memory=40)))
        print("\nq, |d|, r, |e| = {:g}, {:g}, {:g}, {:g}".format(*setting))
        print(f"  {'':38}{'worst':>9}{'interval':>10}{'b + 3 s':>9}{'/ optimum':>11}{'rmse':>8}")
        runs = [(s, a, *drawn(model, setting[1] * d, setting[3] * e, s))
                for s in seeds for a, (d, e) in adversaries(s).items()]  # fmt: skip
        for name, (given, method) in methods(model).items():
            inside, size, error = {}, [], []
            for _, adversary, x, record in runs:
                est = method.run(given, record)
                lo, hi = (end[:, 0] for end in est.interval(LEVEL))
                inside.setdefault(adversary, []).append(np.mean((lo <= x) & (x <= hi)))
                size.append(0.5 * np.mean(hi - lo))
                error.append(np.mean((est.x[:, 0] - x) ** 2))
            width = plain(hw.estimate(given, quiet, method))
            worst = min(np.mean(v) for v in inside.values())
            print(f"  {name:38}{worst:9.4f}{np.mean(size):10.3f}{width:9.3f}{width / optimum:11.4f}"
                  f"{np.sqrt(np.mean(error)):8.3f}")  # fmt: skip
    print(f"\n{len(seeds)} seeds x 4 adversaries x {ROWS} rows; three standard errors of a coverage are "
          f"{3 * np.sqrt(LEVEL * (1 - LEVEL) / (len(seeds) * ROWS)):.4f} for independent rows")  # fmt: skip


def plain(est):
    """Return bound plus three standard deviations of the position in the last row."""
    half = getattr(est.spread, "half", np.zeros_like(est.x))
    return float(half[-1, 0] + 3 * est.spread.sd[-1, 0])


def main():
    """Time the filter on four states and two outputs, and the window's designs."""
    T = 20_000
    A, Q = np.kron(np.eye(2), [[1.0, 0.1], [0.0, 1.0]]), np.kron(np.eye(2), [[1e-4, 1e-3], [1e-3, 2e-2]])
    w, e = hw.Uniform([0.0, 0.02, 0.0, 0.02]) + hw.Gaussian(Q), hw.Uniform(0.5) + hw.Gaussian(0.2)
    model = hw.Linear(A, None, np.kron(np.eye(2), [[1.0, 0.0]]), w, e, hw.Normal(np.zeros(4), 1.0), dt=0.1)
    _, record = hw.simulate(model, T=T, seed=0)
    gaps = record.y.copy()
    gaps[np.random.default_rng(1).random(gaps.shape) < 0.3] = np.nan
    holes = hw.Record(record.t, gaps)
    kalman = dataclasses.replace(model, w=model.w.gaussian, e=model.e.gaussian)
    print("Mixed noise: four states, two outputs, microseconds of processor time a row (least of 5)")
    rows = [("KalmanFilter(), sets ignored", kalman, hw.KalmanFilter())]
    rows += [(name, model, method) for name, method in {
        "MixedFilter()": hw.MixedFilter(),
        'MixedFilter(form="ellipsoid")': hw.MixedFilter(form="ellipsoid"),
        'MixedFilter(form="ellipsoid", truncate=True)': hw.MixedFilter(form="ellipsoid", truncate=True),
        'MixedFilter(form="ellipsoid", criterion="width")': hw.MixedFilter(form="ellipsoid", criterion="width"),
        'MixedFilter(form="zonotope")': hw.MixedFilter(form="zonotope"),
    }.items()]  # fmt: skip
    for name, given, method in rows:
        full, part = (min(_time(lambda m=method, g=given, r=r: m.run(g, r)) for _ in range(5)) for r in (record, holes))
        limit = f"  (limit {LIMIT:g})" if method == hw.MixedFilter(form="ellipsoid") else ""
        print(f"  {name:50}{1e6 * full / T:8.2f}{1e6 * part / T:8.2f} with 30 % of the entries missing{limit}")
    live = hw.stream(model, hw.MixedFilter())
    pushes = 2000
    took = _time(lambda: [live.push(y) for y in record.y[:pushes]])
    print(f"  {'stream(model, MixedFilter()).push':50}{1e6 * took / pushes:8.1f}")
    from halfwidth.methods import mixed_window

    est = None

    def window():
        nonlocal est
        mixed_window._held.clear()
        est = hw.MixedWindow(memory=40).run(model, record)

    took = min(_time(window) for _ in range(2))
    designs = est.info["designs"]
    print(f"  {'MixedWindow(memory=40), ' + str(designs) + ' designs of 4 states':50}{1e6 * took / T:8.2f}"
          f"   {1e3 * took / designs:.1f} ms a design")  # fmt: skip


def _time(run):
    start = time.process_time()
    run()
    return time.process_time() - start


if __name__ == "__main__":
    table(quick="--quick" in sys.argv[1:])
    print()
    main()
