"""Speed of `Posterior`: a sweep, a window from cold, a push of a stream, a long record, and error against CPU time
beside the sampler.

    python benchmarks/posterior_speed.py [table] [sampler]

A window from cold: the median over 20 windows of the least of 9 runs each; they differ in how far a search goes. A push:
median and mean along one path of 700 rows, each row pushed once, while half-widths are learned (rows 30 to 200) and from
then on, where `benchmarks/posterior.py streams` judges errors and coverage. 32 nodes are the default.
"""

import os
import sys
import time

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

import halfwidth as hw  # noqa: E402
from halfwidth import _core  # noqa: E402
from halfwidth.methods import posterior as engine  # noqa: E402
from halfwidth.methods._sites import sites  # noqa: E402


def spent(call, repeats):
    """Smallest CPU time of one call, s."""
    least = float("inf")
    for _ in range(repeats):
        start = time.process_time()
        call()
        least = min(least, time.process_time() - start)
    return least


def table():
    """Print what each piece costs."""
    import posterior as study

    unknown = hw.Uniform.unknown(at_most=1.0)
    _, record = study.drawn(np.random.default_rng(1), 700)
    window = hw.Record(record.t[:26], record.y[:26], record.u[:26])
    model = study.system(unknown, unknown)
    chain = sites(study.system(hw.Uniform(study.Q), hw.Uniform(study.R)), window)
    s = np.tile(np.r_[np.full(3, study.Q), np.full(2, study.R)], (8, 1))

    def sweeps(count, members):
        return lambda: _core.ep_run(chain.problem, s[:members], np.zeros(members), count, 0.0, 1.0, None)

    print("Posterior: CPU time")
    for members in (1, 4, 8):
        one = (spent(sweeps(220, members), 15) - spent(sweeps(20, members), 15)) / 200
        print(
            f"  a sweep of 26 stages, n = 3, {members} chain(s) side by side   {one * 1e6:8.1f} us   {one / members * 1e6:6.1f} us a chain"
        )
    parts = [part for _, _, part in study.windows(25, 20, 7)]
    for nodes in (64, 32, 16):
        method = hw.Posterior(nodes=nodes)
        cold = [1e3 * spent(lambda p=part, m=method: hw.estimate(model, p, m), 9) for part in parts]
        print(
            f"  a window of 26 rows from cold, {nodes} nodes          {np.median(cold):8.2f} ms (median of {len(cold)} windows, "
            f"{min(cold):.2f} to {max(cold):.2f})"
        )
    for nodes in (32, 16):
        live = hw.stream(model, hw.Window(hw.Posterior(nodes=nodes), memory=25))
        took = []
        for y, u in zip(record.y, record.u, strict=True):
            start = time.process_time()
            live.push(y, u)
            took.append(1e3 * (time.process_time() - start))
        early, later = took[30:200], took[200:]
        print(
            f"  a push of a stream, Delta 25, {nodes} nodes, from row 200 {np.median(later):6.2f} ms (median), {np.mean(later):.2f} ms (mean); "
            f"rows 30 to 200 {np.median(early):.2f}, {np.mean(early):.2f}"
        )
    h = 0.1
    A, C = np.kron(np.eye(2), [[1, h], [0, 1]]), np.kron(np.eye(2), [[1.0, 0.0]])
    box = hw.Box(-np.ones(4), np.ones(4))
    q, r = [0.02, 0.05, 0.02, 0.05], [0.5, 0.5]
    _, long = hw.simulate(hw.Linear(A, None, C, hw.Uniform(q), hw.Uniform(r), box), T=36000, seed=1)
    y = long.y.copy()
    y[np.arange(36000) % 100 < 20] = np.nan
    free = hw.Uniform.unknown(at_most=50.0)
    start = time.process_time()
    est = hw.estimate(hw.Linear(A, None, C, free, free, box), hw.Record(long.t, y), hw.Posterior())
    print(
        f"  T = 36,000, n = 4, with learning                  {time.process_time() - start:8.2f} s   q {est.q.round(3)} r {est.r.round(3)}"
    )


def off(x, truth, sd):
    """Root mean square distance of posterior means, in posterior standard deviations."""
    return float(np.sqrt(np.mean(((x - truth) / sd) ** 2)))


def sampler(windows=3, draws=(50, 200, 800), long=5_000):
    """Print the error of posterior means against CPU time, for expectation propagation and for draws.

    Truth is a long run of the sampler. Half-widths that are learned have the sampler's prior in both, the power alone.
    The error of draws falls with the root of their number, so the time to reach a given error follows from a run of any
    length; that of expectation propagation is its own bias.
    """
    import posterior as study

    def mean_sd(est):
        points = np.moveaxis(est.spread.points, 1, 0)
        return points.mean(axis=0), points.std(axis=0)

    unknown = hw.Uniform.unknown(at_most=1.0)
    models = {
        "half-widths told": study.system(hw.Uniform(study.Q), hw.Uniform(study.R)),
        "half-widths learned": study.system(unknown, unknown),
    }
    parts = [part for _, _, part in study.windows(25, windows, 11)]
    kept = engine._LIMITS["reference"]
    engine._LIMITS["reference"] = 0.0
    print(f"error of posterior means, in posterior sd, {windows} windows of 26 rows; truth: 4 chains of {long} draws")
    for name, model in models.items():
        rows = {count: [] for count in draws}
        ours, agree = [], []
        for part in parts:
            true = hw.estimate(model, part, hw.Posterior(method="sample", draws=long), seed=1)
            truth, sd = mean_sd(true)
            agree.append(true.info["rhat"])
            hw.estimate(model, part, hw.Posterior())
            start = time.process_time()
            est = hw.estimate(model, part, hw.Posterior())
            ours.append((off(est.x, truth, sd), time.process_time() - start))
            for count in draws:
                start = time.process_time()
                est = hw.estimate(model, part, hw.Posterior(method="sample", draws=count), seed=2)
                rows[count].append((off(mean_sd(est)[0], truth, sd), time.process_time() - start))
        mine, cost = np.sqrt(np.mean(np.square([o[0] for o in ours]))), np.median([o[1] for o in ours])
        print(f"  {name}: R-hat of the truth {max(agree):.3f}")
        print(f"    expectation propagation        error {mine:.4f}  {1e3 * cost:9.2f} ms")
        for count in draws:
            error = np.sqrt(np.mean(np.square([r[0] for r in rows[count]])))
            seconds = np.median([r[1] for r in rows[count]])
            needed = seconds * (error / mine) ** 2
            print(
                f"    sampler, 4 chains of {count:5d}      error {error:.4f}  {1e3 * seconds:9.2f} ms; "
                f"to the same error {1e3 * needed:9.1f} ms: {needed / cost:6.0f} times"
            )
    engine._LIMITS["reference"] = kept


def main():
    """Run what is asked for."""
    sys.path.insert(0, os.path.dirname(__file__))
    names = [name for name in sys.argv[1:] if name in ("table", "sampler")]
    for name in names or ["table", "sampler"]:
        {"table": table, "sampler": sampler}[name]()


if __name__ == "__main__":
    main()
