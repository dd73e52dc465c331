"""The structured interior point beside PIQP, HiGHS (simplex and interior point) and Clarabel; windows beside linprog.

Run ``python benchmarks/lp.py [--quick]``, ``--windows``, ``--failures`` for the windows of 2,500 rows that are not
solved, or ``--agreement N`` for N random problems against HiGHS. Times are medians of CPU time; n = 4, m = 2, 20 % of
the rows in outages. The last column of the first table counts what an iteration must at least move and compute, and how
far we are from it.
"""

import statistics
import sys
import time

import numpy as np
import scipy.optimize

from halfwidth import _core
from halfwidth.methods.map import BatchLP
from halfwidth.methods.window import window_chain
from halfwidth.reproduce import paper003
from halfwidth.result import Status
from halfwidth.solvers.banded import solve
from halfwidth.solvers.chain import Chain
from halfwidth.solvers.stock import PIQP, highs

H = 0.1


def drive(T, seed=0, lost=20):
    """Return the vehicle of paper 000 over T rows as a chain."""
    rng = np.random.default_rng(seed)
    A = np.eye(4)
    A[0, 2] = A[1, 3] = H
    B = np.array([[H * H / 2, 0], [0, H * H / 2], [H, 0], [0, H]])
    C = np.eye(2, 4)
    k = np.arange(T)
    u = np.c_[np.sin(k / 30), np.cos(k / 40)]
    w = rng.uniform(-1, 1, (T, 4)) * [0.02, 0.02, 0.05, 0.05]
    x = np.zeros((T + 1, 4))
    for t in range(T):
        x[t + 1] = A @ x[t] + B @ u[t] + w[t]
    y = x[1:, :2] + rng.uniform(-0.5, 0.5, (T, 2))
    seen = np.ones((T, 2), bool)
    for start in range(40, T - lost, 5 * lost):
        seen[start : start + lost] = False
    return Chain(
        A=A, C=C, bx=u @ B.T, by=y, seen=seen, group=np.arange(6, dtype=np.int32), h=np.ones(6), c=np.ones(6),
        floor=np.zeros(6), cap=np.full(6, np.inf),
    )  # fmt: skip


def cpu(work, runs):
    times, result = [], None
    for _ in range(runs):
        start = time.process_time()
        result = work()
        times.append(time.process_time() - start)
    return statistics.median(times), result


def clarabel(program):
    import clarabel as cl
    import scipy.sparse as sp

    G, m = program.G, program.G.shape[0]
    upper, lower = np.flatnonzero(np.isfinite(program.row_hi)), np.flatnonzero(np.isfinite(program.row_lo))
    n = program.c.size
    low = np.flatnonzero(np.isfinite(program.lo))
    box = sp.csr_array((np.ones(low.size), (np.arange(low.size), low)), shape=(low.size, n))
    K = sp.csc_matrix(sp.vstack([G[upper], -G[lower], -box]))
    b = np.r_[program.row_hi[upper], -program.row_lo[lower], -program.lo[low]]
    settings = cl.DefaultSettings()
    settings.verbose = False
    del m
    found = cl.DefaultSolver(sp.csc_matrix((n, n)), program.c, K, b, [cl.NonnegativeConeT(len(b))], settings).solve()
    return found.obj_val


def floor_of(n=4, m=2, p=6):
    """Return (bytes, flops) an iteration moves and computes at least, per stage."""
    g, q = n + m, n + p
    state = n + 4 * g + 4 * g + g + n  # x; w, l, u, v; b; base
    factor = 2 * n * n + n * q + 2 * n  # L, O, Z; f, dx
    doubles = (state + 2 * g * 2) + factor + (factor + 3 * g * 2) + (factor + 4 * g) + (factor + 6 * g)
    tri = n * (n + 1) // 2
    assemble = tri * (n + m) + n * n + p * n
    eliminate = n**3 // 3 + n * n * n + tri * n + q * (n * n + n * n // 2) + q * (q + 1) // 2 * n
    sweep = n * n * 2 + n * q + 2 * g * n
    return 8 * doubles, 2 * (assemble + eliminate + 4 * sweep) + 2 * g * 40


def batch(lengths, quick):
    print(f"{'T':>8} {'solver':>16} {'CPU ms':>10} {'ratio':>7} {'objective':>14} {'it':>4} {'us/stage/it':>12}")
    for T in lengths:
        chain = drive(T)
        runs = 9 if T <= 1000 else 3
        took, ours = cpu(lambda chain=chain: solve(chain, point="optimal", fallback=False), runs)
        each = 1e6 * took / T / max(1, ours.iterations)
        print(
            f"{T:8d} {'banded optimal':>16} {1e3 * took:10.2f} {1:7.1f} {ours.objective:14.9f} {ours.iterations:4d} {each:12.3f}"
        )
        fast, middle = cpu(lambda chain=chain: solve(chain, fallback=False), runs)
        print(
            f"{'':8} {'banded central':>16} {1e3 * fast:10.2f} {fast / took:7.2f} {middle.objective:14.9f} {middle.iterations:4d}"
        )
        size, flops = floor_of()
        print(
            f"{'':8} an iteration moves {size} bytes and computes {flops} flops a stage:"
            f" {size / each / 1e3:.1f} GB/s and {flops / each / 1e3:.1f} Gflop/s reached"
        )
        program = chain.program()
        peers = [("piqp", lambda p=program: p.c @ PIQP.run(p).x)]
        if T <= 10_000 and not quick:
            peers.append(("clarabel", lambda p=program: clarabel(p)))
        if T <= 1000 or (T <= 10_000 and not quick):
            ipm = highs(solver="ipm", time_limit=120.0)
            peers.append(("highs ipm", lambda p=program, s=ipm: p.c @ s.run(p).x))
        if T <= 1000:
            simplex = highs(solver="simplex", time_limit=120.0)
            peers.append(("highs simplex", lambda p=program, s=simplex: p.c @ s.run(p).x))
        for name, work in peers:
            try:
                t, value = cpu(work, 3 if T <= 1000 else 1)
                print(f"{'':8} {name:>16} {1e3 * t:10.2f} {t / took:7.1f} {value:14.9f}", flush=True)
            except Exception as error:
                print(f"{'':8} {name:>16} failed: {error}")


def windows(rows):
    print(f"\n{'memory':>8} {'point':>10} {'median us':>10} {'p99/median':>11} {'it':>5} {'unsolved':>9}")
    model = paper003.system(unknown=False, correlated=False)
    step = {}
    for memory in (5, 10, 25, 50):
        for point in ("optimal", "central"):
            drawn = paper003.draw(0, correlated=False, rows=rows)
            est = paper003.lsu(drawn, memory, model, point=point)
            took = est.info["seconds"][memory:]
            step[memory, point] = middle = 1e6 * np.median(took)
            print(
                f"{memory:8d} {point:>10} {middle:10.1f} {np.quantile(1e6 * took, 0.99) / middle:11.1f}"
                f" {est.info['iterations'].mean():5.1f} {len(est.info['unsolved']):9d}"
            )
    peers(step[25, "optimal"], step[25, "central"])


def peers(optimal, central):
    """Solve some of the same windows with PIQP and linprog, and one of them alone from Python."""
    import scipy.sparse as sp

    model = paper003.system(unknown=False, correlated=False)
    chain = window_chain(BatchLP(objective="paper"), model, paper003.draw(0, correlated=False, rows=400).record, 25)
    alone, piqp, lin = [], [], []
    for first in range(30, 370, 20):
        part = chain.part(first, first + 26)
        program = part.program()
        up = np.isfinite(program.row_hi)
        G = sp.csr_array(sp.vstack([program.G[up], -program.G[~up]]))
        b = np.r_[program.row_hi[up], -program.row_lo[~up]]
        bounds = np.c_[program.lo, program.hi]
        alone.append(cpu(lambda p=part: [solve(p, point="optimal", fallback=False) for _ in range(20)], 3)[0] / 20)
        piqp.append(cpu(lambda p=program: [PIQP.run(p) for _ in range(3)], 3)[0] / 3)
        lin.append(cpu(lambda p=program, g=G, h=b, e=bounds: scipy.optimize.linprog(p.c, g, h, bounds=e), 3)[0])
    alone, piqp, lin = (1e6 * statistics.median(v) for v in (alone, piqp, lin))
    print(
        f"memory 25, medians in us: a step of the window {optimal:.1f} (central {central:.1f}), a program alone from"
        f" Python {alone:.1f}, PIQP {piqp:.0f}, linprog {lin:.0f}"
    )
    print(
        f"a step is {lin / optimal:.0f} times as fast as linprog and {piqp / optimal:.1f} times as PIQP;"
        f" a program alone {lin / alone:.0f} and {piqp / alone:.1f} times"
    )


def failures(rows):
    """Count windows that were not solved: 5 seeds, 4 memories, theta known and estimated, both points."""
    print(f"{'memory':>8} {'theta':>10} {'point':>9} {'windows':>8} {'unsolved':>9} {'reduced':>8} {'us':>6}")
    for unknown in (False, True):
        model = paper003.system(unknown=unknown)
        for memory in (5, 10, 25, 50):
            for point in ("optimal", "central"):
                bad = reduced = 0
                start = time.process_time()
                for seed in range(5):
                    est = paper003.lsu(paper003.draw(seed, rows=rows), memory, model, point=point)
                    bad += len(est.info["unsolved"])
                    reduced += est.info["statuses"].count(Status.REDUCED)
                each = 1e6 * (time.process_time() - start) / (5 * rows)
                print(
                    f"{memory:8d} {'estimated' if unknown else 'known':>10} {point:>9} {5 * rows:8d} {bad:9d}"
                    f" {reduced:8d} {each:6.0f}",
                    flush=True,
                )


def memory_of(T):
    """Solve T rows and print the peak of resident memory."""
    import resource

    chain = drive(T)
    took, found = cpu(lambda: solve(chain, fallback=False), 1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"\nT = {T}: central point {took:.1f} s, {found.iterations} iterations, {found.status.name}, peak {peak:.2f} GB"
    )


def agreement(problems):
    """Compare objective and status with the stock solvers on random problems."""
    import pathlib

    sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))
    from tests.core.test_lp import judged
    from tests.naive_lp import problem

    wrong, helped, statuses = [], {}, {}
    for seed in range(problems):
        kind, fault, help_ = judged(seed)
        status = solve(problem(seed)[1], point="optimal").status.name
        statuses[status] = statuses.get(status, 0) + 1
        helped[kind] = helped.get(kind, 0) + help_
        if fault:
            wrong.append((seed, kind, fault))
            print(seed, kind, fault)
    print(f"{len(wrong)} of {problems} disagree; stock solvers were needed for {sum(helped.values())}: {helped}")
    print(f"statuses: {statuses}")


def main(quick=False):
    print(f"core: {_core.isa()}")
    batch((100, 1000) if quick else (100, 1000, 10_000, 36_000), quick)
    windows(500 if quick else 10_000)
    if not quick:
        memory_of(1_000_000)


if __name__ == "__main__":
    if "--agreement" in sys.argv:
        agreement(int(sys.argv[sys.argv.index("--agreement") + 1]))
    elif "--failures" in sys.argv:
        failures(250 if "--quick" in sys.argv else paper003.T)
    elif "--windows" in sys.argv:
        windows(500 if "--quick" in sys.argv else 10_000)
    else:
        main("--quick" in sys.argv)
