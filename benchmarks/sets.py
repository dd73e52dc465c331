"""Sets that contain the state, how wide and how fast: `python benchmarks/sets.py [long]`.

Three states, two outputs (Pavelková and Kárný 2013, E = F = I), half-widths 0.1 and 0.3, three in ten entries missing,
prior box +-1. Width is that of the box beside the exact hull, found by linear programs over all rows so far; `outside`
is how far a box is cut into the truth-bearing exact hull at worst, so that anything above rounding means that a method
does not contain. Peers: Codac (interval contractors), ZonoOpt (constrained zonotopes; its box by ADMM at its default and
at a tightened tolerance), and exact polytopes by Qhull. A peer that is not installed is left out. Processor time.

`long` draws ten million state-steps with the noise in the corners of its box, and whole outages, instead of 1e5.
"""

import sys
import time

import numpy as np

import halfwidth as hw

A = np.array([[1.0, -0.5, 0.2], [0.5, 0.1, 0.0], [0.3, 0.0, -0.1]])
B = np.array([[0.1], [0.6], [0.3]])
C = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]])
Q, R = np.full(3, 0.1), np.full(2, 0.3)
MODEL = hw.Linear(A, B, C, hw.Uniform(Q), hw.Uniform(R), hw.Box(-np.ones(3), np.ones(3)))
ROWS, RUNS = 60, 3
#: What a step of each may cost with three states as it comes, in microseconds.
DEFAULTS = (hw.IntervalFilter(), hw.ZonotopeFilter(), hw.EllipsoidFilter(), hw.ConstrainedZonotopeFilter())
LIMITS = {repr(method): 10.0 for method in DEFAULTS}
OURS = [
    hw.IntervalFilter(),
    hw.EllipsoidFilter(),
    hw.ZonotopeFilter(order=4),
    hw.ZonotopeFilter(order=10),
    hw.ZonotopeFilter(),
    hw.ConstrainedZonotopeFilter(order=8, constraints=1),
    hw.ConstrainedZonotopeFilter(),
    hw.ConstrainedZonotopeFilter(order=20, constraints=3, rounds=8),
    hw.ConstrainedZonotopeFilter(order=20, constraints=6, rounds=16),
]


def drawn(seed, T=ROWS, corners=False, outage=None):
    """Draw states (T, 3) and a record with entries missing."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (T, 1))
    w, e = rng.uniform(-1, 1, (T, 3)), rng.uniform(-1, 1, (T, 2))
    if corners:
        # a hair inside, since the sums below are rounded
        w, e = (1 - 1e-12) * np.sign(w), (1 - 1e-12) * np.sign(e)
    states = np.empty((T, 3))
    x = rng.uniform(-1, 1, 3)
    for k in range(T):
        x = A @ x + B @ u[k] + Q * w[k]
        states[k] = x
    y = states @ C.T + R * e
    y[rng.random(y.shape) < 0.3] = np.nan
    if outage is not None:
        y[outage[0] : outage[1]] = np.nan
    return states, hw.Record(np.arange(T) + 1.0, y, u)


def exact(record, rows):
    """Least and largest value of each state at some rows, from the rows up to each, by linear programs of HiGHS."""
    import scipy.sparse as sp
    from scipy.optimize import linprog

    lo, hi = np.full((len(record), 3), np.nan), np.full((len(record), 3), np.nan)
    for k in rows:
        blocks, low, high = [], [], []
        n = 3 * (k + 2)
        for t in range(k + 1):
            move = sp.lil_array((3, n))
            move[:, 3 * t : 3 * t + 3], move[:, 3 * t + 3 : 3 * t + 6] = -A, np.eye(3)
            shift = B @ record.u[t]
            blocks.append(move)
            low.append(shift - Q)
            high.append(shift + Q)
            seen = record.seen[t]
            if seen.any():
                see = sp.lil_array((int(seen.sum()), n))
                see[:, 3 * t + 3 : 3 * t + 6] = C[seen]
                blocks.append(see)
                low.append(record.y[t, seen] - R[seen])
                high.append(record.y[t, seen] + R[seen])
        M = sp.csc_array(sp.vstack(blocks))
        limits = [(-1, 1)] * 3 + [(None, None)] * (n - 3)
        for j in range(3):
            for sign, ends in ((1.0, lo), (-1.0, hi)):
                c = np.zeros(n)
                c[n - 3 + j] = sign
                found = linprog(c, sp.vstack([M, -M]), np.r_[np.concatenate(high), -np.concatenate(low)], bounds=limits)
                ends[k, j] = sign * found.fun
    return lo, hi


def codac_box(record):
    """Forward box and inverse contractors, to a fixed point."""
    import codac

    x = codac.VectorVar(4)
    see = [codac.CtcInverse(codac.AnalyticFunction([x], float(c[0]) * x[0] + float(c[1]) * x[1] + float(c[2]) * x[2] - x[3]),
                            codac.Interval(0.0)) for c in C]  # fmt: skip
    matrix = codac.IntervalMatrix(codac.Matrix(A.tolist()))
    box = codac.IntervalVector([[-1, 1]] * 3)
    lo, hi = np.empty((len(record), 3)), np.empty((len(record), 3))
    for k in range(len(record)):
        shift = B @ record.u[k]
        box = matrix * box + codac.IntervalVector([[s - q, s + q] for s, q in zip(shift, Q, strict=True)])
        for _ in range(2):
            for i in np.flatnonzero(record.seen[k]):
                four = codac.IntervalVector([*[[box[j].lb(), box[j].ub()] for j in range(3)],
                                             [record.y[k, i] - R[i], record.y[k, i] + R[i]]])  # fmt: skip
                see[i].contract(four)
                box = codac.IntervalVector([four[j] for j in range(3)])
        lo[k], hi[k] = [box[j].lb() for j in range(3)], [box[j].ub() for j in range(3)]
    return lo, hi


def zonoopt_box(tolerance=None):
    """Constrained zonotope without reduction; its bounding box."""

    def run(record):
        import scipy.sparse as sp
        import zonoopt as zono

        move, settings = sp.csc_matrix(A), zono.OptSettings()
        if tolerance is not None:
            settings.eps_prim, settings.eps_dual, settings.k_max_admm = tolerance, 10 * tolerance, 100_000
        noise = zono.interval_2_zono(zono.Box(-Q, Q))
        one = zono.interval_2_zono(zono.Box(-np.ones(3), np.ones(3)))
        lo, hi = np.full((len(record), 3), np.nan), np.full((len(record), 3), np.nan)
        for k in range(min(len(record), 31)):
            one = zono.minkowski_sum(zono.affine_map(one, move, B @ record.u[k]), noise)
            seen = record.seen[k]
            if seen.any():
                strip = zono.interval_2_zono(zono.Box(record.y[k, seen] - R[seen], record.y[k, seen] + R[seen]))
                one = zono.intersection(one, strip, sp.csc_matrix(C[seen]))
            if k % 5 == 0 and k >= 10:
                box = one.bounding_box(settings=settings)
                lo[k], hi[k] = np.ravel(box.lower()), np.ravel(box.upper())
        return lo, hi

    return run


def qhull_box(record):
    """Exact polytope, by vertices for the motion and half-spaces for the outputs."""
    from scipy.optimize import linprog
    from scipy.spatial import ConvexHull, HalfspaceIntersection

    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
    points = corners.copy()
    lo, hi = np.empty((len(record), 3)), np.empty((len(record), 3))
    for k in range(len(record)):
        points = (points @ A.T + B @ record.u[k])[:, None, :] + Q * corners[None]
        hull = ConvexHull(points.reshape(-1, 3))
        faces = np.unique(hull.equations.round(12), axis=0)
        for i in np.flatnonzero(record.seen[k]):
            faces = np.vstack((faces, np.r_[C[i], -record.y[k, i] - R[i]], np.r_[-C[i], record.y[k, i] - R[i]]))
        norm = np.linalg.norm(faces[:, :3], axis=1)
        inner = linprog([0, 0, 0, -1], np.c_[faces[:, :3], norm], -faces[:, 3], bounds=[(None, None)] * 3 + [(0, None)])
        points = HalfspaceIntersection(faces, inner.x[:3]).intersections
        lo[k], hi[k] = points.min(axis=0), points.max(axis=0)
    return lo, hi


def ours(method):
    """Boxes of one of our methods."""

    def run(record):
        return hw.estimate(MODEL, record, method).interval()

    return run


def peers():
    """Names and functions of the peers that are installed, with the rows each is timed over."""
    found = []
    for module, name, run in (
        ("codac", "Codac, box and CtcInverse", codac_box),
        ("zonoopt", "ZonoOpt, its default box", zonoopt_box()),
        ("zonoopt", "ZonoOpt, tolerance 1e-6", zonoopt_box(1e-6)),
        ("scipy", "polytopes by Qhull", qhull_box),
    ):
        try:
            __import__(module)
        except ImportError:
            print(f"  ({module} is not installed: left out)")
            continue
        found.append((name, run))
    return found


def least(run, record, repeats):
    """Return the boxes, and the least processor time in microseconds a box."""
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        found = run(record)
        best = min(best, time.process_time() - start)
    return found, 1e6 * best / np.isfinite(found[0]).all(axis=1).sum()


def widths():
    """Print width, containment and time of every method."""
    rows = list(range(10, ROWS, 5))
    cases = []
    for seed in range(RUNS):
        states, record = drawn(seed)
        cases.append((states, record, *exact(record, rows)))
    methods = [(repr(m), ours(m), 5) for m in OURS] + [("Hull(memory=10)", ours(hw.Hull(memory=10)), 1)]
    methods += [(name, run, 0) for name, run in peers()]
    _, many = drawn(99, 1000)
    print(f"{'':62}{'width':>8}{'outside':>10}{'contained':>11}{'us a step':>11}")
    for name, run, repeats in methods:
        wide, outside, inside, times = [], [], [], []
        for states, record, low, high in cases:
            (lo, hi), took = least(run, record, 1)
            some = [k for k in rows if np.isfinite(lo[k]).all()]
            wide.append(np.mean(hi[some] - lo[some]) / np.mean(high[some] - low[some]))
            outside.append(max(np.max(lo[some] - low[some]), np.max(high[some] - hi[some]), 0.0))
            there = np.isfinite(lo).all(axis=1)
            inside.append(np.mean(np.all((lo <= states) & (states <= hi), axis=1)[there]))
            times.append(took)
        if repeats:
            times = [least(run, many, repeats)[1]]
        limit = LIMITS.get(name)
        over = "" if limit is None or min(times) <= limit else f"  (asked: {limit:g})"
        print(
            f"{name:62}{np.mean(wide):8.4f}{max(outside):10.1e}{100 * np.mean(inside):10.1f}%{min(times):11.1f}{over}",
            flush=True,
        )
    print(
        "  width: mean over the exact hull's; outside: how far a box is inside the exact hull at worst, whose every end"
    )
    print("  is reached by states that obey all bounds")


def nonlinear():
    """Print what the same sets give on a turning vehicle."""
    model = hw.Nonlinear(
        lambda x, u, dt: np.array(
            [x[0] + dt * x[2] * np.cos(x[3]), x[1] + dt * x[2] * np.sin(x[3]), x[2] + dt * u[0], x[3] + dt * u[1]]
        ),
        lambda x: np.array([x[0], x[1], np.hypot(x[0] - 50, x[1] - 20)]),
        hw.Uniform([0.01, 0.01, 0.01, 0.001]),
        hw.Uniform([0.5, 0.5, 0.2]),
        hw.Box([-0.5, -0.5, 4.5, 0.2], [0.5, 0.5, 5.5, 0.4]),
        nu=2,
        dt=0.2,
    )
    u = np.c_[np.sin(np.arange(200) / 9), 0.4 * np.cos(np.arange(200) / 15)]
    print(
        "\nA turning vehicle (4 states; position and a distance seen, an outage of 3 s); mean widths, microseconds a step"
    )

    for method in (*DEFAULTS, hw.Hull(lag=0), hw.Hull()):
        wide, inside, times = [], [], []
        for seed in range(3):
            truth, record = hw.simulate(model, u, seed=seed)
            record = record.without(20.0, 23.0)
            start = time.process_time()
            lo, hi = hw.estimate(model, record, method).interval()
            times.append(1e6 * (time.process_time() - start) / len(record))
            wide.append(np.mean(hi - lo, axis=0))
            inside.append(np.mean(np.all((lo <= truth.x) & (truth.x <= hi), axis=1)))
        means = "  ".join(f"{w:6.3f}" for w in np.mean(wide, axis=0))
        print(f"  {method!r:60}{means}   contained {100 * np.mean(inside):5.1f}%   {min(times):6.0f}")


def violations(steps):
    """Count the states outside their boxes, noise in the corners, entries missing and whole outages."""
    T = 2000
    print(f"\nStates outside their box, {steps:.0e} state-steps, noise in the corners, outages of 20 rows")
    for method in DEFAULTS:
        outside = done = 0
        seed = 0
        while done < steps:
            states, record = drawn(1000 + seed, T, corners=True, outage=(500, 520))
            lo, hi = hw.estimate(MODEL, record, method).check().interval()
            outside += int(np.sum(~np.all((lo <= states) & (states <= hi), axis=1)))
            done += 3 * T
            seed += 1
        print(f"  {method!r:60}{outside:8d} of {done}")


def main():
    """Print the tables."""
    widths()
    nonlinear()
    violations(1e7 if "long" in sys.argv[1:] else 1e5)


if __name__ == "__main__":
    main()
