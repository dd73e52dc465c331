"""Speed of `Posterior`: a sweep, a window from cold, a push of a stream, a long record with learning."""

import os
import sys
import time

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

import halfwidth as hw  # noqa: E402
from halfwidth import _core  # noqa: E402
from halfwidth.methods._sites import sites  # noqa: E402


def spent(call, repeats):
    """Smallest CPU time of one call, s."""
    least = float("inf")
    for _ in range(repeats):
        start = time.process_time()
        call()
        least = min(least, time.process_time() - start)
    return least


def main():
    """Print the table."""
    sys.path.insert(0, os.path.dirname(__file__))
    import posterior as study

    unknown = hw.Uniform.unknown(at_most=1.0)
    _, record = study.drawn(np.random.default_rng(1), 60)
    window = hw.Record(record.t[:26], record.y[:26], record.u[:26])
    model = study.system(unknown, unknown)
    chain = sites(study.system(hw.Uniform(study.Q), hw.Uniform(study.R)), window)
    s = np.tile(np.r_[np.full(3, study.Q), np.full(2, study.R)], (4, 1))

    def sweeps(count, members):
        return lambda: _core.ep_run(chain.problem, s[:members], np.zeros(members), count, 0.0, 1.0, None)

    print("Posterior: CPU time")
    for members in (1, 4):
        one = (spent(sweeps(220, members), 15) - spent(sweeps(20, members), 15)) / 200
        print(
            f"  a sweep of 26 stages, n = 3, {members} chain(s) side by side   {one * 1e6:8.1f} us   {one / members * 1e6:6.1f} us a chain"
        )
    for nodes in (64, 32, 16):
        method = hw.Posterior(nodes=nodes)
        print(
            f"  a window of 26 rows from cold, {nodes} nodes          {spent(lambda m=method: hw.estimate(model, window, m), 15) * 1e3:8.2f} ms"
        )
    live = hw.stream(model, hw.Window(hw.Posterior(nodes=16), memory=25))
    took = []
    for y, u in zip(record.y, record.u, strict=True):
        start = time.process_time()
        live.push(y, u)
        took.append(time.process_time() - start)
    print(f"  a push of a stream, Delta 25, 16 nodes            {np.median(took[30:]) * 1e3:8.2f} ms (median)")
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


if __name__ == "__main__":
    main()
