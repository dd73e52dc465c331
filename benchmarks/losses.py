"""Speed and accuracy of the filters for unknown losses: `python benchmarks/losses.py`.

Four states, two outputs, 10,000 rows, 30 % of the samples replaced by noise. Peers: filterpy's IMM with the modes H = 0
and H = C (what one would build by hand today), and a bootstrap particle filter on the same model with the package
`particles`, if it is installed. The accuracy of each stands beside its time. Processor time, least of the repeats.
"""

import time
import warnings

import numpy as np

import halfwidth as hw

ROWS = 10_000
#: What each of ours may cost a row, in microseconds.
LIMITS = {"GPB(1)": 2.0, "GPB(3)": 8.0, "RBPF(100)": 5.0, "stream.push of GPB(1)": 4.0}


def model():
    """Return two damped oscillators whose positions are seen."""
    return hw.Linear(
        np.kron(np.eye(2), [[1.0, 0.1], [-0.1, 0.9]]),
        None,
        np.kron(np.eye(2), [[1.0, 0.0]]),
        hw.Gaussian(np.kron(np.eye(2), [[0.01, 0.0], [0.0, 0.1]])),
        hw.Gaussian([0.5, 0.5]),
        hw.Normal(np.zeros(4), np.ones(4)),
        loss=hw.Bernoulli(0.7),
    )


def least(run, repeats):
    """Return the last answer and the least processor time in microseconds a row."""
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        found = run()
        best = min(best, time.process_time() - start)
    return found, 1e6 * best / ROWS


def filterpy_imm(car, record):
    """Run filterpy's IMM with one filter that sees and one that does not; returns the means."""
    from filterpy.kalman import IMMEstimator, KalmanFilter

    filters = []
    for H in (np.zeros((2, 4)), car.C.single):
        f = KalmanFilter(4, 2)
        f.x, f.P = car.x0.mean[:, None].copy(), car.x0.P.copy()
        f.F, f.Q, f.R, f.H = car.A.single, car.w.cov().single, car.e.cov().single, H
        filters.append(f)
    imm = IMMEstimator(filters, [0.3, 0.7], np.array([[0.3, 0.7], [0.3, 0.7]]))
    x = np.empty((len(record), 4))
    for k, y in enumerate(record.y):
        imm.predict()
        imm.update(y[:, None])
        x[k] = imm.x[:, 0]
    return x


def particles_filter(car, record, N=100):
    """Run a bootstrap particle filter of the package `particles`; returns the means, or None if it is not there."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import particles
            from particles import distributions as dists
            from particles.collectors import Moments
            from particles.core import FeynmanKac
    except ImportError:
        return None
    A, C = car.A.single, car.C.single
    noise = dists.MvNormal(cov=car.w.cov().single)
    R = np.diag(car.e.cov().single)

    class Lossy(FeynmanKac):
        def M0(self, N):
            return self.M(0, car.x0.mean + dists.MvNormal(cov=np.eye(4)).rvs(size=N))

        def M(self, t, xp):  # noqa: ARG002
            return xp @ A.T + noise.rvs(size=len(xp))

        def logG(self, t, xp, x):  # noqa: ARG002
            y = record.y[t]
            kept = np.log(0.7) - 0.5 * np.sum((y - x @ C.T) ** 2 / R, axis=1)
            lost = np.log(0.3) - 0.5 * np.sum(y**2 / R)
            return np.logaddexp(kept, lost)

    run = particles.SMC(fk=Lossy(len(record)), N=N, collect=[Moments()])
    run.run()
    return np.array([m["mean"] for m in run.summaries.moments])


def push(car, record):
    """Feed a stream row by row; returns the means, and the microseconds a push without keeping the answers."""
    rows = list(record.y)
    live = hw.stream(car, hw.GPB(1))
    start = time.process_time()
    for y in rows:
        live.push(y)
    seconds = time.process_time() - start
    live = hw.stream(car, hw.GPB(1))
    return np.array([live.push(y).x[0] for y in rows]), 1e6 * seconds / len(rows)


def main(rows=ROWS):
    """Print the table; returns it as a list of (name, microseconds a row, RMSE)."""
    car = model()
    truth, record = hw.simulate(car, T=rows, seed=1)
    position = [0, 2]
    table = []

    def add(name, x, cost):
        rmse = float(np.sqrt(np.mean(np.sum((x - truth.x)[:, position] ** 2, axis=1))))
        table.append((name, cost, rmse))
        limit = next((v for k, v in LIMITS.items() if k == name), None)
        mark = "" if limit is None else f"   (limit {limit:g})"
        print(f"{name:36s} {cost:10.2f} {rmse:9.4f}{mark}", flush=True)

    print(f"{'unknown losses, n = 4, m = 2':36s} {'us/row':>10s} {'RMSE':>9s}")
    methods = {
        "BKF1()": hw.BKF1(),
        "BKF2()": hw.BKF2(),
        "GPB(1)": hw.GPB(1),
        "GPB(3)": hw.GPB(3),
        "GPB(5)": hw.GPB(5),
        "Runnalls(8)": hw.Runnalls(8),
        "RBPF(100)": hw.RBPF(100),
        "FearnheadClifford(100)": hw.FearnheadClifford(100),
        "GPB(5, smooth=True)": hw.GPB(5, smooth=True),
        "GPB(3, lag=3)": hw.GPB(3, lag=3),
    }
    for name, method in methods.items():
        est, cost = least(lambda m=method: m.run(car, record, seed=1), 7)
        add(name, est.x, cost * ROWS / rows)
    pushed = [push(car, record) for _ in range(3)]
    add("stream.push of GPB(1)", pushed[0][0], min(cost for _, cost in pushed))
    x, cost = least(lambda: filterpy_imm(car, record), 1)
    add("filterpy IMM, modes 0 and C", x, cost * ROWS / rows)
    ours = {name: cost for name, cost, _ in table}
    print(f"  GPB(1) is {ours['filterpy IMM, modes 0 and C'] / ours['GPB(1)']:.0f} times faster than filterpy's IMM")
    x = particles_filter(car, hw.Record(record.t[:50], record.y[:50]))  # compiles
    if x is None:
        print("  `particles` is not installed: left out")
        return table
    x, cost = least(lambda: particles_filter(car, record), 1)
    add("particles, bootstrap, N = 100", x, cost * ROWS / rows)
    print(f"  RBPF(100) is {table[-1][1] / ours['RBPF(100)']:.0f} times faster than `particles`")
    return table


if __name__ == "__main__":
    main()
