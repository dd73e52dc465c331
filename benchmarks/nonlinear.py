"""Speed of the nonlinear filters: `python benchmarks/nonlinear.py`.

A car turning at constant rate (five states, position seen, CTRV), filtered by filterpy's unscented filter and by ours
with the same sigma points. The answers are compared before anything is timed. CPU time, least of the repeats, one core.
"""

import dataclasses
import statistics
import time

import numpy as np

import halfwidth as hw

DT = 0.1


def step(x, u, dt):
    """Move a car one step: position, speed, heading, turn rate; the input is its acceleration."""
    px, py, v, a, w = x
    w = np.where(np.abs(w) > 1e-5, w, 1e-5)
    return np.array(
        [
            px + v / w * (np.sin(a + w * dt) - np.sin(a)),
            py + v / w * (np.cos(a) - np.cos(a + w * dt)),
            v + u[0] * dt,
            a + w * dt,
            x[4],
        ]
    )


def plain_step(x, dt, u):
    """Move one point as users of filterpy write it: with Python's math module, which is fastest for one point."""
    from math import cos, sin

    px, py, v, a, w = x
    s = w if abs(w) > 1e-5 else 1e-5
    b = a + s * dt
    return np.array([px + v / s * (sin(b) - sin(a)), py + v / s * (cos(a) - cos(b)), v + u[0] * dt, b, w])


def see(x):
    """Return the position."""
    return x[:2]


def model():
    """Return a car whose position is seen with correlated noise."""
    return hw.Nonlinear(
        step,
        see,
        hw.Gaussian([1e-4, 1e-4, 1e-2, 1e-5, 1e-5]),
        hw.Gaussian([[0.2, 0.05], [0.05, 0.2]]),
        hw.Normal([0.0, 0.0, 8.0, 0.3, 0.2], [1.0, 1.0, 1.0, 0.01, 0.001]),
        nu=1,
        dt=DT,
    )


def drive(rows, *, share=0.0):
    """Return a simulated drive with a share of the rows missing."""
    _, record = hw.simulate(model(), 0.3 * np.sin(np.arange(rows) / 20)[:, None], seed=1)
    y = record.y.copy()
    y[np.random.default_rng(0).random(rows) < share] = np.nan
    return hw.Record(record.t, y, record.u)


def peer(record, settings):
    """Filterpy's unscented filter over a record; means and covariances."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    car = model()
    points = MerweScaledSigmaPoints(5, **settings)
    ukf = UnscentedKalmanFilter(5, 2, DT, fx=plain_step, hx=see, points=points)
    ukf.x, ukf.P = car.x0.mean.copy(), car.x0.P.copy()
    ukf.Q, ukf.R = car.w.cov().single, car.e.cov().single
    x, P = np.empty((len(record), 5)), np.empty((len(record), 5, 5))
    for k in range(len(record)):
        ukf.predict(u=record.u[k])
        ukf.update(None if np.isnan(record.y[k, 0]) else record.y[k])
        x[k], P[k] = ukf.x, ukf.P
    return x, P


def least(run, repeats):
    """Return the least CPU time of some repeats, s."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return min(times)


def main():
    """Compare, then time."""
    settings = {"alpha": 0.5, "beta": 2.0, "kappa": 0.0}
    ours = hw.UnscentedKalman(**settings)
    short, long = drive(1000, share=0.3), drive(20_000, share=0.3)
    x, P = peer(short, settings)
    est = hw.estimate(model(), short, ours)
    worst = max(np.abs(est.x - x).max() / np.abs(x).max(), np.abs(est.P - P).max() / np.abs(P).max())
    print(f"nonlinear: CTRV, n=5, m=2, 30 % of rows missing; agreement with filterpy {worst:.1e} relative")
    if not worst < 1e-9:
        raise SystemExit("the answers differ, so nothing is timed")

    theirs = least(lambda: peer(short, settings), 3) / len(short)
    rows = [("filterpy UKF", theirs)]
    methods = [
        ("UnscentedKalman", ours),
        ("UnscentedKalman, smoothed", dataclasses.replace(ours, smooth=True)),
        ("ExtendedKalman", hw.ExtendedKalman()),
        ("ExtendedKalman, smoothed", hw.ExtendedKalman(smooth=True)),
    ]
    for name, method in methods:
        rows.append((name, least(lambda method=method: hw.estimate(model(), long, method), 5) / len(long)))
    in_python = dataclasses.replace(ours, compiled=False)
    rows.append(
        ("UnscentedKalman, not compiled", least(lambda: hw.estimate(model(), short, in_python), 2) / len(short))
    )
    rows.append(
        ("ParticleFilter, 1000", least(lambda: hw.estimate(model(), short, hw.ParticleFilter(), seed=1), 2) / 1000)
    )
    print(f"{'':32}{'us/step':>10}{'x faster':>10}")
    for name, seconds in rows:
        print(f"{name:32}{1e6 * seconds:>10.2f}{theirs / seconds:>10.1f}")

    one = drive(1)
    overhead = least(lambda: hw.estimate(model(), one, ours), 20)
    print(f"one call with one row (recording g and h included): {1e3 * overhead:.2f} ms")
    live = hw.stream(model(), ours)
    wall = []
    for k in range(2000):
        start = time.perf_counter()
        live.push(long.y[k], long.u[k])
        wall.append(time.perf_counter() - start)
    print(f"stream.push, unscented: median {1e6 * statistics.median(wall):.0f} us")
    ratio = theirs / dict(rows)["UnscentedKalman"]
    print(f"unscented against filterpy: {ratio:.0f} times faster (aim: 20)")
    return ratio


if __name__ == "__main__":
    main()
