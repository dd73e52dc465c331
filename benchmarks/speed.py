"""Speed beside the peers and beside a hand-written C++ loop.

    python benchmarks/speed.py [kalman] [growth] [many] [stream] [nonlinear] [learn] [losses] [lp] [hull] [constrained] [sets] [mixed] [posterior] [vehicle]

Without arguments everything runs. Outputs are compared before anything is timed. Times are CPU times of this process,
the minimum of repeats, except where wall time is said; a ratio divides two times taken in turns in the same process. A
peer that is not installed is left out.
"""

import ctypes
import importlib
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time
import warnings

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

import halfwidth as hw  # noqa: E402

HERE = pathlib.Path(__file__).parent


def best(*runs, repeats=7, clock=time.process_time):
    """Smallest time of each run, taken in turns."""
    found = [float("inf")] * len(runs)
    for _ in range(repeats):
        for k, run in enumerate(runs):
            start = clock()
            run()
            found[k] = min(found[k], clock() - start)
    return found


def difference(a, b):
    """Largest difference relative to the largest entry."""
    return float(np.abs(a - b).max() / np.abs(b).max())


def table(title, rows):
    print(f"\n{title}")
    width = max(len(row[0]) for row in rows)
    for name, *cells in rows:
        print(f"  {name:<{width}}  " + "  ".join(f"{c:>12}" for c in cells))


def peer(name):
    """Import an optional peer, or None."""
    try:
        return __import__(name, fromlist=["_"])
    except ImportError:
        print(f"  ({name} is not installed: left out)")
        return None


def limit():
    """Compile the hand-written loop."""
    folder = tempfile.mkdtemp()
    library = os.path.join(folder, "limit.so")
    subprocess.run(["g++", "-O3", "-shared", "-fPIC", "-o", library, str(HERE / "kalman_limit.cpp")], check=True)
    call = ctypes.CDLL(library).kf_rts
    call.restype = ctypes.c_double
    return call


class Loop:
    """The hand-written loop with its buffers, already touched."""

    def __init__(self, model, y, rows):
        T = y.shape[0]
        single = (model.A.single, model.C.single, model.w.cov().single, model.e.cov().single)
        self.call = limit()
        self.rows = rows.astype(np.uint8)
        self.y = np.ascontiguousarray(np.nan_to_num(y))
        self.x = [np.zeros((T, 4)) for _ in range(3)]
        self.P = [np.zeros((T, 4, 4)) for _ in range(3)]
        self.x0, self.P0 = np.array(model.x0.mean), np.array(model.x0.P)
        self.single = [np.ascontiguousarray(m) for m in single]

    def __call__(self, first=0, rows=None):
        """Filter and smooth `rows` rows from `first` on and return the log-likelihood."""

        def at(a):
            return ctypes.c_void_p(a.ctypes.data + first * a.strides[0])

        A, C, Q, R = (ctypes.c_void_p(m.ctypes.data) for m in self.single)
        prior = ctypes.c_void_p(self.x0.ctypes.data), ctypes.c_void_p(self.P0.ctypes.data)
        x, P = self.x, self.P
        n = ctypes.c_long(len(self.y) if rows is None else rows)
        out = (at(x[0]), at(P[0]), at(x[1]), at(P[1]), at(x[2]), at(P[2]))
        return self.call(n, A, C, Q, R, at(self.y), at(self.rows), *prior, *out)


def constant_velocity(dt=1.0):
    """Two positions and two velocities, correlated output noise."""
    A = np.kron([[1.0, dt], [0.0, 1.0]], np.eye(2))
    Q = 0.05 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
    R = [[1.0, 0.3], [0.3, 2.0]]
    return hw.Linear(A, None, np.eye(2, 4), hw.Gaussian(Q), hw.Gaussian(R), hw.Normal(np.zeros(4), 10.0), dt=dt)


def drawn(model, T, seed=0, lost=0.3):
    """Draw a record with a share of its rows missing."""
    _, record = hw.simulate(model, T=T, seed=seed)
    rows = np.random.default_rng(seed + 1).random(T) >= lost
    return hw.Record(record.t, np.where(rows[:, None], record.y, np.nan)), rows


def statsmodels_smoother(model, y):
    """Return the smoother of statsmodels, its prior moved one step ahead."""
    from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

    A, Q = model.A.single, model.w.cov().single
    ss = KalmanSmoother(2, 4)
    ss.bind(np.asfortranarray(y.T))
    ss["transition"], ss["design"], ss["selection"] = A, model.C.single, np.eye(4)
    ss["state_cov"], ss["obs_cov"] = Q, model.e.cov().single
    ss.initialize_known(A @ model.x0.mean, A @ model.x0.P @ A.T + Q)
    return ss


def kalman():
    """KF + RTS over one long series with gaps."""
    T = 100_000
    model = constant_velocity()
    record, rows = drawn(model, T)
    loop = Loop(model, record.y, rows)
    method = hw.KalmanSmoother()
    loglik, est = loop(), hw.estimate(model, record, method)
    error = max(difference(est.x, loop.x[2]), difference(est.P, loop.P[2]), abs(est.loglik / loglik - 1.0))
    ours, hand = best(lambda: hw.estimate(model, record, method), loop, repeats=15)
    lines = [
        ("", "ms", "ns a step", "x C++ loop", "error"),
        ("C++ loop, fixed size, g++ -O3", f"{hand * 1e3:.1f}", f"{hand / T * 1e9:.0f}", "1", "-"),
        ("halfwidth", f"{ours * 1e3:.1f}", f"{ours / T * 1e9:.0f}", f"{ours / hand:.2f}", f"{error:.0e}"),
    ]
    only, _ = best(lambda: hw.estimate(model, record, hw.KalmanFilter()), loop, repeats=9)
    lines.append(("halfwidth, filter only", f"{only * 1e3:.1f}", f"{only / T * 1e9:.0f}", f"{only / hand:.2f}", ""))
    if peer("statsmodels"):
        ss = statsmodels_smoother(model, record.y)
        out = ss.smooth()
        error = max(difference(out.smoothed_state.T, loop.x[2]), difference(out.smoothed_state_cov.T, loop.P[2]))
        slow, hand = best(ss.smooth, loop, repeats=3)
        lines.append(
            ("statsmodels", f"{slow * 1e3:.0f}", f"{slow / T * 1e9:.0f}", f"{slow / hand:.1f}", f"{error:.0e}")
        )
        lines.append(("statsmodels / halfwidth", f"{slow / ours:.0f} x", "", "", ""))
    table(f"KF + RTS, T = {T:,}, n = 4, m = 2, 30 % of the rows missing", lines)


def many():
    """KF + RTS over many series; wall time, as threads are the point."""
    N, T = 1000, 1000
    model = constant_velocity()
    long, rows = drawn(model, N * T, seed=5)
    y = long.y.reshape(N, T, 2)
    t = np.arange(1.0, T + 1)
    records = [hw.Record(t, y[k]) for k in range(N)]
    loop = Loop(model, long.y, rows)

    def each():
        for k in range(N):
            loop(k * T, T)

    method = hw.KalmanSmoother()
    each()
    found = hw.estimate(model, records, method)
    x = np.array([est.x for est in found])
    P = np.array([est.P for est in found])
    error = max(difference(x, loop.x[2].reshape(x.shape)), difference(P, loop.P[2].reshape(P.shape)))
    del x, P, found
    wall = time.perf_counter
    ours, hand = best(lambda: hw.estimate(model, records, method), each, repeats=7, clock=wall)
    cpu, cpu_hand = best(lambda: hw.estimate(model, records, method), each, repeats=5)
    lines = [
        ("", "wall s", "x C++ loop", "CPU s", "error"),
        ("C++ loop, one thread", f"{hand:.3f}", "1", f"{cpu_hand:.3f}", "-"),
        (f"halfwidth, {os.cpu_count()} cores", f"{ours:.3f}", f"{ours / hand:.2f}", f"{cpu:.3f}", f"{error:.0e}"),
    ]
    if peer("simdkalman"):
        import simdkalman

        single = [m.single for m in (model.A, model.w.cov(), model.C, model.e.cov())]
        kf = simdkalman.KalmanFilter(*single)
        A, Q = single[0], single[1]
        prior = {"initial_value": A @ model.x0.mean, "initial_covariance": A @ model.x0.P @ A.T + Q}
        out = kf.compute(y, 0, smoothed=True, **prior)
        error = difference(out.smoothed.states.mean, loop.x[2].reshape(N, T, 4))
        (slow,) = best(lambda: kf.compute(y, 0, smoothed=True, **prior), repeats=2, clock=wall)
        lines.append(("simdkalman", f"{slow:.3f}", f"{slow / hand:.1f}", "", f"{error:.0e}"))
        lines.append(("simdkalman / halfwidth", f"{slow / ours:.0f} x", "", "", ""))
    table(f"{N:,} series of {T:,} steps, filter and smoother", lines)


def latency(call, rows, repeats=7):
    """Median over blocks of the wall time of one call, us."""
    blocks = []
    for _ in range(repeats):
        for k in range(0, len(rows) - 999, 1000):
            block = rows[k : k + 1000]
            start = time.perf_counter()
            for row in block:
                call(row)
            blocks.append((time.perf_counter() - start) / len(block))
    return statistics.median(blocks) * 1e6


def stream():
    """One online step from Python."""
    model = constant_velocity()
    record, _ = drawn(model, 10_000, lost=0.0)
    lists = record.y.tolist()
    live = hw.stream(model, hw.KalmanFilter())
    for row in lists:
        newest = live.push(row)
    batch = hw.estimate(model, record, hw.KalmanFilter())
    error = difference(newest.x[0], batch.x[-1])
    gaps = [row if k % 3 else None for k, row in enumerate(lists)]
    lines = [("", "us", "error")]
    for name, rows in (("lists", lists), ("arrays", list(record.y)), ("lists, a third of the rows None", gaps)):
        lines.append((f"halfwidth, push of {name}", f"{latency(live.push, rows):.2f}", f"{error:.0e}"))
    lag = hw.stream(model, hw.KalmanSmoother(lag=10))
    lines.append(("halfwidth, push with a lag of 10 rows", f"{latency(lag.push, lists):.2f}", ""))

    def read(row):
        return live.push(row).x

    lines.append(("halfwidth, push and read x", f"{latency(read, lists):.2f}", ""))
    if peer("kalman"):  # the package fast-kalman
        import kalman as fast

        A, Q = model.A.single, model.w.cov().single
        flat = [m.ravel().tolist() for m in (A, Q, model.C.single, model.e.cov().single)]
        start = (A @ model.x0.mean).tolist(), (A @ model.x0.P @ A.T + Q).ravel().tolist()
        kf = fast.LinearKalmanFilter(4, 2, *start, *flat)
        # it updates first, so our prior is moved one step ahead and the update comes before the prediction
        for row in lists:
            kf.predict() if row is not lists[0] else None
            kf.correct(row)
        error = difference(np.ravel(kf.x), batch.x[-1])

        def theirs(row):
            kf.predict()
            kf.correct(row)

        lines.append(("fast-kalman, predict and correct of lists", f"{latency(theirs, lists):.2f}", f"{error:.0e}"))
        lines.append(("fast-kalman, update of lists", f"{latency(kf.update, lists):.2f}", ""))
    table("One online step, n = 4, m = 2: median of wall times", lines)


def learn():
    """Q and R learned from a record with gaps."""
    T = 2000
    truth = constant_velocity()
    record, _ = drawn(truth, T, seed=11)
    Q0 = np.diag([0.1, 0.1, 0.2, 0.2])
    guess = hw.Linear(truth.A, None, truth.C, hw.Gaussian(Q0), hw.Gaussian(np.eye(2)), truth.x0)
    lines = [("", "CPU s", "loglik", "R", "largest error of R, Q")]

    def row(name, seconds, loglik, R, Q=None):
        worst = np.abs(R / truth.e.cov().single - 1).max()
        text = f"{100 * worst:.0f} %"
        if Q is not None:
            text += f", {100 * np.abs(Q / 0.05 - 1).max():.0f} %"
        lines.append((name, f"{seconds:.3f}", f"{loglik:.2f}", np.array2string(R.round(2)).replace("\n", ""), text))

    scaled = {"Q": "scaled"}
    start = hw.Linear(truth.A, None, truth.C, hw.Gaussian(20 * truth.w.cov().single), hw.Gaussian(np.eye(2)), truth.x0)
    for method in ("em", "ml"):
        found = hw.learn(start, record, method=method, structure=scaled)
        (seconds,) = best(lambda m=method: hw.learn(start, record, method=m, structure=scaled), repeats=2)
        Q = found.model.w.cov().single
        name = f"halfwidth, {method}, Q scaled, R full"
        row(name, seconds, found.loglik, found.model.e.cov().single, Q[Q > 0] / (truth.w.cov().single[Q > 0] / 0.05))
    if peer("pykalman"):
        from pykalman import KalmanFilter

        A, Q = truth.A.single, guess.w.cov().single
        masked = np.ma.masked_invalid(record.y)
        mean, cov = A @ truth.x0.mean, A @ truth.x0.P @ A.T + Q
        n_iter = 10

        def theirs():
            kf = KalmanFilter(
                A, truth.C.single, Q, np.eye(2), initial_state_mean=mean, initial_state_covariance=cov,
                em_vars=["transition_covariance", "observation_covariance"],
            )  # fmt: skip
            return kf.em(masked, n_iter=n_iter)

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            kf = theirs()
            (slow,) = best(theirs, repeats=1)
        at = hw.Linear(
            truth.A,
            None,
            truth.C,
            hw.Gaussian(kf.transition_covariance),
            hw.Gaussian(kf.observation_covariance),
            truth.x0,
        )
        reached = hw.estimate(at, record, hw.KalmanFilter()).loglik
        row(f"pykalman, {n_iter} EM iterations, Q and R full", slow, reached, np.asarray(kf.observation_covariance))
        n = next(n for n in range(1, 500) if hw.learn(guess, record, iterations=n, tolerance=1e-15).loglik >= reached)
        (fast,) = best(lambda: hw.learn(guess, record, iterations=n, tolerance=1e-15), repeats=3)
        found = hw.learn(guess, record, iterations=n, tolerance=1e-15)
        row(f"halfwidth, {n} EM iterations, Q and R full", fast, found.loglik, found.model.e.cov().single)
        lines.append(("pykalman / halfwidth at equal likelihood", f"{slow / fast:.0f} x", "", "", ""))
    table(f"Learning Q and R, T = {T:,}, 30 % of the rows missing", lines)


def growth():
    """Time and memory of ten times more rows."""
    model = constant_velocity()
    method = hw.KalmanSmoother()
    short, _ = drawn(model, 100_000, seed=3)
    long, _ = drawn(model, 1_000_000, seed=3)
    a, b = best(lambda: hw.estimate(model, short, method), lambda: hw.estimate(model, long, method), repeats=5)
    code = (
        f"import numpy as np, sys; sys.path.insert(0, {str(HERE)!r}); import speed, halfwidth as hw\n"
        "def status(key): return int(open('/proc/self/status').read().split(key)[1].split()[0]) * 1024\n"
        "m = speed.constant_velocity(); r, _ = speed.drawn(m, 10); hw.estimate(m, r)\n"
        "T = 1000000; r = hw.Record(np.arange(1.0, T + 1), np.zeros((T, 2)))\n"
        "before = status('VmRSS:'); e = hw.estimate(m, r); print((status('VmHWM:') - before) / T)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    table(
        "From T = 100,000 to T = 1,000,000",
        [
            ("time", f"{a * 1e3:.1f} ms", f"{b * 1e3:.0f} ms", f"x {b / a:.1f}"),
            ("peak memory of the estimate", f"{float(out.stdout):.0f} B", "a step", ""),
        ],
    )


def part(module):
    """The `main` of a benchmark that stands in a file of its own."""

    def run():
        sys.path.insert(0, str(HERE))
        print()
        importlib.import_module(module).main()

    return run


PARTS = {one.__name__: (one,) for one in (growth, many, stream, learn)}
PARTS |= {module: (part(module),) for module in ("nonlinear", "losses", "lp", "hull", "constrained", "sets", "mixed")}
PARTS["posterior"] = (part("posterior_speed"),)
PARTS["vehicle"] = (part("vehicle_speed"),)
PARTS["kalman"] = (kalman, growth, many, stream, *PARTS["nonlinear"], learn)


def main():
    names = sys.argv[1:] or ["kalman", "losses", "lp", "constrained", "hull", "sets", "mixed", "posterior", "vehicle"]
    unknown = [name for name in names if name not in PARTS]
    if unknown:
        sys.exit(f"no part {unknown}; there are {', '.join(PARTS)}")
    for name in names:
        for part in PARTS[name]:
            part()


if __name__ == "__main__":
    main()
