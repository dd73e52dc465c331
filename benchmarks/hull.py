"""Guaranteed boxes: how often they are wrong, how wide they are, how long they take.

    python benchmarks/hull.py                    speed and width beside HiGHS (Codac, ZonoOpt and Qhull: benchmarks/sets.py)
    python benchmarks/hull.py --violations N     N state-steps of simulated truth, counted while they run
    python benchmarks/hull.py --violations N --resume FILE     goes on where FILE stopped, and writes it
    python benchmarks/hull.py --violations 1e8 --resume FILE --processes 2     the same series, drawn in two processes

A state-step is one entry of one state checked against its box. The noise sits at the corners of its box most of the
time, 30 % of the outputs are missing, and every series has whole outages. The simulated noise is 1e-12 smaller than the
half-widths declared, because the simulation itself rounds.
"""

import argparse
import contextlib
import json
import multiprocessing
import os
import pathlib
import sys
import time

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

import halfwidth as hw  # noqa: E402

NAN = np.nan
BATCH = 256  # series a process draws between two lines of progress


def paper003(_):
    """The three-state system of paper 003 with E = F = I."""
    A = np.array([[1, -0.5, 0.2], [0.5, 0.1, 0], [0.3, 0, -0.1]])
    B, C = np.array([[0.1], [0.6], [0.3]]), np.array([[1, 0, 0.5], [0, 1, 0.5]])
    return hw.Linear(A, B, C, hw.Uniform(0.1), hw.Uniform(0.3), hw.Box(-np.ones(3), np.ones(3))), 3


def vehicle(_):
    """Position and speed on two axes."""
    car = hw.vehicle.constant_velocity(dt=0.1, q=[0.02, 0.02, 0.05, 0.05], r=[0.5, 0.5])
    box = hw.Box(-np.array([5.0, 5, 8, 8]), np.array([5.0, 5, 8, 8]))
    return hw.Linear(car.A, car.B, car.C, car.w, car.e, box, dt=car.dt), 4


def drawn(rng):
    """A random system of 1 to 5 states with E, F, bounds on the states or none, and half-widths of any size."""
    n = int(rng.integers(1, 6))
    m = int(rng.integers(1, n + 1))
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.3, 1.02) / np.abs(np.linalg.eigvals(A)).max()
    E = np.eye(n) + np.triu(0.3 * rng.standard_normal((n, n)), 1) if rng.random() < 0.5 else None
    F = np.eye(m) + np.triu(0.3 * rng.standard_normal((m, m)), 1) if rng.random() < 0.5 else None
    q = 10.0 ** rng.uniform(-4, 0, n) * (rng.random(n) < 0.9)
    size = 10.0 ** rng.uniform(-2, 2)
    x0 = hw.Box(-size * np.ones(n), size * np.ones(n)) if rng.random() < 0.8 else None
    r = 10.0 ** rng.uniform(-3, 0.5, m)
    return hw.Linear(
        A, rng.standard_normal((n, 1)), rng.standard_normal((m, n)), hw.Uniform(q), hw.Uniform(r), x0, E=E, F=F
    ), n


def corners(rng, T, half):
    """Noise at the corners of its box: kept there for a while, jumping, or anywhere."""
    n = half.size
    kind = rng.integers(4)
    if kind == 0:
        signs = rng.choice([-1.0, 1.0], (T, n))
    elif kind == 1:
        turns = rng.random((T, n)) < 0.1
        signs = np.where(np.cumsum(turns, axis=0) % 2 == 0, 1.0, -1.0) * rng.choice([-1.0, 1.0], n)
    elif kind == 2:
        signs = np.broadcast_to(rng.choice([-1.0, 1.0], n), (T, n))
    else:
        signs = np.where(rng.random((T, n)) < 0.5, rng.choice([-1.0, 1.0], (T, n)), rng.uniform(-1, 1, (T, n)))
    return signs * half * (1 - 1e-12)


def series(model, rng, T):
    """Draw truth (T, nx) and a record with 30 % of the outputs missing and whole outages."""
    A, B, C = model.A.single, model.B.single, model.C.single
    E = np.eye(model.nx) if model.E is None else model.E.single
    F = np.eye(model.ny) if model.F is None else model.F.single
    u = rng.uniform(-1, 1, (T, model.nu))
    w, e = corners(rng, T, model.w.q), corners(rng, T, model.e.q)
    x = np.empty((T, model.nx))
    lo, hi = np.maximum(model.x0.lo, -1.0), np.minimum(model.x0.hi, 1.0)
    state = np.where(rng.random(model.nx) < 0.5, lo, hi) if rng.random() < 0.5 else rng.uniform(lo, hi)
    drive = u @ B.T + w
    for t in range(T):
        state = A @ state + drive[t]
        if model.E is not None:
            state = np.linalg.solve(E, state)
        x[t] = state
    y = np.linalg.solve(F, (x @ C.T + e).T).T
    y[rng.random(y.shape) < 0.3] = NAN
    for _ in range(max(1, T // 60)):
        start = int(rng.integers(0, T))
        y[start : start + int(rng.integers(3, 25))] = NAN
    return x, hw.Record(np.arange(1, T + 1) * model.dt, y, u)


#: Of ten series two are of systems drawn at random; they cost three times as much as the others.
KINDS = 4 * (paper003,) + 4 * (vehicle,) + 2 * (drawn,)
#: The long study counts with the cheapest method; every 64th round of ten takes one of these.
EVERY_METHOD = 64
METHODS = (hw.Hull(memory=10), hw.Hull(memory=5, lag=3), hw.Hull(), hw.Hull(lag=0))


def one(seed, T=100, method=None):
    """Run one series; return state-steps, violations, loose sides, sides, and the worst depth of a violation."""
    rng = np.random.default_rng([8, seed])
    model, _ = KINDS[seed % len(KINDS)](rng)
    if method is None:
        many, late = divmod(seed // len(KINDS), EVERY_METHOD)
        method = METHODS[many % len(METHODS)] if late == EVERY_METHOD - 1 else hw.Hull(memory=5)
    x, record = series(model, rng, T)
    # A solve with E rounds, too: the noise that the simulated truth really obeys is what is declared.
    model = declared(model, x, record)
    est = hw.estimate(model, record, method)
    if not est.status.good:
        return x.size, x.size, 0, 0, f"seed {seed}: {est.message}"
    lo, hi = est.interval()
    out = (x < lo) | (x > hi)
    worst = f"seed {seed}: by {float(np.maximum(lo - x, x - hi).max()):.3g}" if out.any() else ""
    return x.size, int(out.sum()), est.info["loose"], est.info["sides"], worst


def declared(model, x, record):
    """Widen the half-widths by what the simulation rounds: 1e-12 of the size of the terms."""
    size = np.abs(model.A.single) @ np.abs(x).max(axis=0) + np.abs(x).max() * 4 + np.abs(model.B.single).sum(axis=1)
    seen = np.where(record.seen, np.abs(np.nan_to_num(record.y)), 0.0).max(axis=0)
    outs = np.abs(model.C.single) @ np.abs(x).max(axis=0) + 4 * seen.max()
    w, e = hw.Uniform(model.w.q + 1e-13 * size), hw.Uniform(model.e.q + 1e-13 * outs)
    return hw.Linear(model.A, model.B, model.C, w, e, model.x0, E=model.E, F=model.F, dt=model.dt)


def timed(seed):
    """Run one series; return what it found and the processor time it took."""
    begin = time.process_time()
    return *one(seed), time.process_time() - begin


@contextlib.contextmanager
def mapping(processes):
    """Give a `map` that runs in this process, or in order over several."""
    if processes == 1:
        yield map
    else:
        with multiprocessing.Pool(processes) as pool:
            yield pool.imap


def violations(target, path, processes=1):
    """Count violations over at least `target` state-steps: series after series, whoever draws them."""
    total = {"seed": 0, "state_steps": 0, "violations": 0, "loose": 0, "sides": 0, "cpu_s": 0.0, "worst": []}
    if path is not None and path.exists():
        total = json.loads(path.read_text())
        print(f"resumed at {total['state_steps']:,} state-steps")
    with mapping(processes) as run:
        while total["state_steps"] < target:
            for steps, out, loose, sides, worst, cpu in run(
                timed, range(total["seed"], total["seed"] + BATCH * processes)
            ):
                if total["state_steps"] >= target:  # the last batch ends where the target is met
                    break
                total["seed"] += 1
                total["state_steps"] += steps
                total["violations"] += out
                total["loose"] += loose
                total["sides"] += sides
                total["cpu_s"] += cpu
                if worst:
                    total["worst"].append(worst)
                    print(worst, flush=True)
            report(total)
            save(path, total)
    return total["violations"]


def report(total):
    print(
        f"{total['state_steps']:>14,} state-steps in {total['seed']:,} series: {total['violations']} violations, "
        f"{total['loose']} of {total['sides']:,} sides loose, {total['cpu_s']:.0f} s",
        flush=True,
    )


def save(path, total):
    if path is not None:
        temporary = path.with_suffix(".part")
        temporary.write_text(json.dumps(total))
        temporary.replace(path)


# ---- speed and width ---------------------------------------------------------------------------------------------------


def least(run, repeats=5):
    times = []
    for _ in range(repeats):
        start = time.process_time()
        answer = run()
        times.append(time.process_time() - start)
    return min(times), answer


def programs(model, record, first, last, before, state):
    """The 2 nx sides of x at one state by HiGHS through SciPy, from rows first .. last - 1 and the box before them."""
    from scipy.optimize import linprog

    n, m, K = model.nx, model.ny, last - first
    M, low, high = [], [], []
    for t in range(K):
        row = np.zeros((n + m, (K + 1) * n))
        row[:n, t * n : (t + 1) * n], row[:n, (t + 1) * n : (t + 2) * n] = -model.A.single, np.eye(n)
        row[n:, (t + 1) * n : (t + 2) * n] = model.C.single
        drive, y = model.B.single @ record.u[first + t], record.y[first + t]
        use = np.r_[np.ones(n, bool), ~np.isnan(y)]
        M.append(row[use])
        low.append(np.r_[drive - model.w.q, y - model.e.q][use])
        high.append(np.r_[drive + model.w.q, y + model.e.q][use])
    M, low, high = np.vstack(M), np.concatenate(low), np.concatenate(high)
    G, h = np.vstack((M, -M)), np.r_[high, -low]
    box = [*zip(*before, strict=True), *[(None, None)] * (K * n)]
    ends = np.zeros((2, n))
    for j in range(n):
        for k, sign in enumerate((1.0, -1.0)):
            c = np.zeros((K + 1) * n)
            c[(state - first) * n + j] = sign
            ends[k, j] = sign * linprog(c, G, h, bounds=box, method="highs").fun
    return ends


def highs_windows(model, record, memory):
    lo, hi = [model.x0.lo], [model.x0.hi]
    for t in range(1, len(record) + 1):
        a = max(0, t - memory)
        ends = programs(model, record, a, t, (lo[a], hi[a]), t)
        lo.append(ends[0])
        hi.append(ends[1])
    return np.array(lo[1:]), np.array(hi[1:])


def table(title, rows):
    print(f"\n{title}")
    wide = max(len(row[0]) for row in rows)
    for name, *cells in rows:
        print(f"  {name:<{wide}}  " + "  ".join(f"{cell:>16}" for cell in cells))


def usual(model, T, seed):
    """Uniform noise, 30 % of the outputs missing, and one outage of eight rows."""
    rng = np.random.default_rng(seed)
    truth, record = hw.simulate(model, rng.uniform(-1, 1, (T, model.nu)), seed=seed)
    y = record.y.copy()
    y[rng.random(y.shape) < 0.3] = NAN
    y[T // 2 : T // 2 + 8] = NAN
    return truth.x, hw.Record(record.t, y, record.u)


def speed():
    rng = np.random.default_rng(0)
    model, _ = paper003(rng)
    x, record = usual(model, 60, 0)
    exact_s, exact = least(lambda: highs_windows(model, record, 60), 1)
    # Over the last rows, where every window is full.
    wide = lambda ends: ends[1] - ends[0]  # noqa: E731
    rows = [("", "ms a step", "mean width", "least ratio", "largest ratio")]

    def add(name, seconds, ends):
        ratio = (wide(ends) / wide(exact))[10:]
        width = np.mean(wide(ends)[10:]) / np.mean(wide(exact)[10:])
        rows.append(
            (name, f"{1e3 * seconds / 60:.3f}", f"{width:.7f}", f"1{ratio.min() - 1:+.1e}", f"1{ratio.max() - 1:+.1e}")
        )

    add("HiGHS, all rows", exact_s, exact)
    for memory in (5, 10, 20):
        seconds, est = least(lambda m=memory: hw.estimate(model, record, hw.Hull(m)))
        add(f"Hull(memory={memory})", seconds, est.interval())
        lo, hi = est.interval()
        assert np.all((lo <= x) & (x <= hi))
    seconds, est = least(lambda: hw.estimate(model, record, hw.Hull(lag=0)))
    add("Hull(lag=0)", seconds, est.interval())
    add("HiGHS, window 10", *least(lambda: highs_windows(model, record, 10), 1))
    table("a step, n = 3, m = 2, 30 % missing, one outage; ratios to the program of all rows", rows)

    live = hw.stream(model, hw.Hull(memory=10))
    times = []
    for y, u in zip(record.y, record.u, strict=True):
        start = time.process_time()
        live.push(y, u)
        times.append(time.process_time() - start)
    print(f"\n  stream, Hull(memory=10): {1e3 * np.median(times[15:]):.3f} ms a push, median")

    rows = [("", "s", "mean width", "largest ratio")]
    for name, (model, _) in (("fast: spectral radius 0.7", mixing()), ("slow: position and speed", vehicle(rng))):
        x, record = usual(model, 300, 1)
        seconds, est = least(lambda m=model, r=record: hw.estimate(m, r, hw.Hull()), 3)
        lo, hi = est.check().interval()
        assert np.all((lo <= x) & (x <= hi))
        some = [30, 101, 150, 222, 290]
        whole = [programs(model, record, 0, 300, (model.x0.lo, model.x0.hi), k + 1) for k in some]
        best = np.array([wide(one) for one in whole])
        found = (hi - lo)[some]
        rows.append((name, f"{seconds:.3f}", f"{found.mean() / best.mean():.7f}", f"1{(found / best).max() - 1:+.1e}"))
    table("smoothed whole, T = 300, n = 4; ratio to the program of all rows at five states", rows)


def mixing():
    """Four states, two outputs, forgetting a third of the past at each step."""
    rng = np.random.default_rng(4)
    A = rng.standard_normal((4, 4))
    A *= 0.7 / np.abs(np.linalg.eigvals(A)).max()
    B, C = rng.standard_normal((4, 1)), rng.standard_normal((2, 4))
    return hw.Linear(A, B, C, hw.Uniform(0.1), hw.Uniform(0.3), hw.Box(-np.ones(4), np.ones(4))), 4


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--violations", type=float, metavar="N")
    parser.add_argument("--resume", type=pathlib.Path, metavar="FILE")
    parser.add_argument("--processes", type=int, default=1, metavar="P")
    given = parser.parse_args([] if pathlib.Path(sys.argv[0]).name != pathlib.Path(__file__).name else None)
    if given.violations is not None:
        raise SystemExit(1 if violations(given.violations, given.resume, given.processes) else 0)
    speed()


if __name__ == "__main__":
    main()
