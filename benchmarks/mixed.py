"""Mixed noise: half-widths, worst-case coverage and speed.

    python benchmarks/mixed.py [--quick]      the table and the speed
    python benchmarks/speed.py mixed          the speed alone

A cart with constant velocity whose acceleration and position fixes carry Gaussian noise (variances q, r) and a bounded part
(|d|, |e|), in three settings, and the car of examples/20_mixed_noise.py with its lane map beside fixes. Adversaries drive the bounded parts: constant, random, switching, half. Coverage is that of the position, at the
nominal 99.73 %, the worst over adversaries; the half-width is bound plus three standard deviations of a filter in its
steady state; the optimum is the best affine estimate from 40 rows (one second-order cone program for each design).
"""

import dataclasses
import sys
import time

import numpy as np

import halfwidth as hw
from halfwidth.methods._mixed_rows import parts

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


def lane():
    """Return a car between fixes and a lane map; see examples/20_mixed_noise.py."""
    dt = 0.2
    Q = 0.02 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    e = hw.Uniform([0.0, 0.6]) + hw.Gaussian([1.44, 0.0225])
    C = [[1.0, 0.0], [1.0, 0.0]]
    return hw.Linear([[1.0, dt], [0.0, 1.0]], None, C, hw.Gaussian(Q), e, hw.Normal(np.zeros(2), [4.0, 0.25]), dt=dt)


def models():
    """Return the models of the table by name."""
    found = {"cart: q, |d|, r, |e| = {:g}, {:g}, {:g}, {:g}".format(*s): cart(*s) for s in SETTINGS}
    return found | {"lane map: fixes good to 1.2 m, map to .6 m and .15 m of noise": lane()}


def drawn(model, d, e, seed):
    """Return positions (T,) and record of a model under given bounded noises, in units of their bounds."""
    rng = np.random.default_rng(seed)
    (q, Q), (half, R) = parts(model.w, model.nx), parts(model.e, model.ny)
    fold = np.eye(model.nx) if model.E is None else np.linalg.inv(model.E.single)
    A, k = fold @ model.A.single, np.arange(ROWS)
    w = hw.Gaussian(Q).sample(rng, k, np.ones(ROWS)) + np.outer(d, q)
    noise = hw.Gaussian(R).sample(rng, k, np.ones(ROWS)) + np.outer(e, half)
    x, state = np.empty((ROWS, model.nx)), model.x0.sample(rng)
    for t in range(ROWS):
        state = x[t] = A @ state + fold @ w[t]
    return x[:, 0], hw.Record(model.dt * (k + 1.0), x @ model.C.single.T + noise)


def methods(model):
    """Return the estimators of the table by name: (model, method)."""
    half, R = parts(model.e, model.ny)
    plain = dataclasses.replace(model, w=hw.Gaussian(parts(model.w, model.nx)[1].single), e=hw.Gaussian(R.single))
    third, whole = (dataclasses.replace(plain, e=hw.Gaussian(R.single + s * np.diag(half**2))) for s in (1 / 3, 1.0))
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
    for title, model in models().items():
        quiet = hw.Record(model.dt * np.arange(1.0, 301), np.zeros((300, model.ny)))
        optimum = plain(hw.estimate(model, quiet, hw.MixedWindow(memory=40)))
        print(f"\n{title}")
        print(f"  {'':38}{'worst':>9}{'interval':>10}{'b + 3 s':>9}{'/ optimum':>11}{'rmse':>8}")
        runs = [(s, a, *drawn(model, d, e, s)) for s in seeds for a, (d, e) in adversaries(s).items()]
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
    from halfwidth.methods import _affine_gains

    est = None

    def window():
        nonlocal est
        _affine_gains._held.clear()
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
