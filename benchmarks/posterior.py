"""Accuracy and coverage of `Posterior` on the system of Pavelková and Kárný (2013), sec. 6.

    python benchmarks/posterior.py [table] [windows] [streams] [known] [nodes] [variances] [priors] [ensemble] [outliers]
                                   [robust] [calibration] [pictures] [slopes]

Paths stay inside the boxes by rejection of whole paths. The Kalman filter is told the true covariances and is clipped to
the boxes. `windows`: each window of `Delta` + 1 rows on its own, told no half-width and nothing of the past, of which the
Kalman filter sees 15 rows. `streams`: long paths by `Window(Posterior())`, which carries what it has learned, against the
Kalman filter on the same rows, after a burn-in of 200 rows; whole paths of that length cannot be rejected, so one is the
genealogy of a particle among 5,000 that are resampled from those inside at every row. `table` is both; without arguments
it is printed. `nodes`: what fewer nodes leave of the integral over half-widths. `outliers` redraws disturbances that would
leave the boxes, which is another law. `calibration` draws half-widths from the prior that is used, without bounds.
`slopes`: whether the evidence that streams learn half-widths from is unbiased. `WINDOWS=500` sets the number of windows;
streams have twelve times as many. `PICTURES=folder` writes the diagrams of `calibration` and `pictures` there.
"""

import dataclasses
import os
import sys
import time

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import halfwidth._core as _core  # noqa: E402
import numpy as np  # noqa: E402
from scipy.special import ndtr  # noqa: E402

import halfwidth as hw  # noqa: E402
from halfwidth.methods import posterior  # noqa: E402
from halfwidth.methods._carry import Known  # noqa: E402
from halfwidth.methods._sites import sites  # noqa: E402
from halfwidth.methods._sliding import Sliding, stacked  # noqa: E402
from halfwidth.reproduce.paper003 import BOX, KAPPA, A, B, C, E, F, Q, R  # noqa: E402
from halfwidth.spread import part as rows_of  # noqa: E402

LEVELS = (0.5, 0.8, 0.9, 0.95)
WINDOWS = int(os.environ.get("WINDOWS", "500"))


def drawn(rng, rows, *, correlated=False, missing=0.0):
    """Return states (rows + 1, 3), x0 first, and a record; every state inside the box."""
    G = np.linalg.inv(E) if correlated else np.eye(3)
    x, X, U = np.zeros(3), [], []
    for _ in range(rows + 30):
        for attempt in range(10_000):
            if attempt % 100 == 0:  # no disturbance keeps this input inside: another input
                u = rng.uniform(-1, 1, 1)
            new = G @ (A @ x + B @ u + rng.uniform(-Q, Q, 3))
            if BOX.contains(new):
                break
        x = new
        X.append(x)
        U.append(u)
    X, u = np.array(X)[29:], np.array(U)[30:]
    y = X[1:] @ C.T + rng.uniform(-R, R, (rows, 2))
    if correlated:
        y = y @ np.linalg.inv(F).T
    y[rng.random(y.shape) < missing] = np.nan
    return X, hw.Record(np.arange(1.0, rows + 1), y, u)


def system(w, e, x0=BOX, *, correlated=False, bounds=BOX):
    """Return the model of the paper."""
    return hw.Linear(A, B, C, w, e, x0, E=E if correlated else None, F=F if correlated else None, bounds=bounds)


HISTORY = 15


def inside(rng, rows, *, correlated=False):
    """Return states (rows + 1, 3) and inputs of one path: whole paths are drawn until one stays inside the box."""
    G = np.linalg.inv(E) if correlated else np.eye(3)
    many = 512
    while True:
        x = rng.uniform(BOX.lo, BOX.hi, (many, 3))
        u, w = rng.uniform(-1, 1, (many, rows, 1)), rng.uniform(-Q, Q, (many, rows, 3))
        X, kept = np.empty((many, rows + 1, 3)), np.ones(many, dtype=bool)
        X[:, 0] = x
        for t in range(rows):
            x = (x @ A.T + u[:, t] @ B.T + w[:, t]) @ G.T
            X[:, t + 1] = x
            kept &= BOX.contains(x)
        if kept.any():
            k = int(np.argmax(kept))
            return X[k], u[k]


def windows(delta, count, seed, *, correlated=False, missing=0.0):
    """Return windows with a past: states, the record of past and window, and the window's own record."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        X, u = inside(rng, HISTORY + delta + 1, correlated=correlated)
        y = X[1:] @ C.T + rng.uniform(-R, R, (len(u), 2))
        if correlated:
            y = y @ np.linalg.inv(F).T
        y[rng.random(y.shape) < missing] = np.nan
        t = np.arange(1.0, len(u) + 1)
        a = HISTORY
        found.append((X[a:], hw.Record(t, y, u), hw.Record(t[a:], y[a:], u[a:])))
    return found


def stays(rng, rows, *, correlated=False, many=5_000):
    """Return states (rows + 1, 3) and inputs of one long path of those that stay inside the box."""
    G = np.linalg.inv(E) if correlated else np.eye(3)
    x = rng.uniform(BOX.lo, BOX.hi, (many, 3))
    X, U, parent = [x], [], []
    for _ in range(rows):
        u = rng.uniform(-1, 1, (many, 1))
        x = (x @ A.T + u @ B.T + rng.uniform(-Q, Q, (many, 3))) @ G.T
        alive = np.flatnonzero(((x >= BOX.lo) & (x <= BOX.hi)).all(axis=1))
        from_ = alive[rng.integers(len(alive), size=many)]
        x = x[from_]
        X.append(x)
        U.append(u[from_])
        parent.append(from_)
    k, path, inputs = 0, [], []
    for t in range(rows, 0, -1):
        path.append(X[t][k])
        inputs.append(U[t - 1][k])
        k = parent[t - 1][k]
    path.append(X[0][k])
    return np.array(path[::-1]), np.array(inputs[::-1])


def told_the_truth(record, *, correlated):
    """Kalman filter with the true covariances, clipped to the boxes."""
    noise = hw.Gaussian(np.full(3, Q**2 / 3)), hw.Gaussian(np.full(2, R**2 / 3))
    model = system(*noise, hw.Normal(BOX.mean, (BOX.hi - BOX.lo) ** 2 / 12), correlated=correlated, bounds=None)
    return np.clip(hw.estimate(model, record, hw.KalmanFilter()).x, BOX.lo, BOX.hi)


def one_case(delta, *, correlated=False, missing=0.0, count=WINDOWS, seed=7, model=None):
    """Return filter and mid-window errors over those of the Kalman filter, coverage and learned half-widths."""
    found = windows(delta, count, seed, correlated=correlated, missing=missing)
    unknown = hw.Uniform.unknown(at_most=1.0)
    model = system(unknown, unknown, correlated=correlated) if model is None else model
    method = hw.Posterior()
    error, theirs, covered, s, status, ends = [], [], [], [], [], []
    seconds = 0.0
    for x, whole, part in found:
        kf = told_the_truth(whole, correlated=correlated)[HISTORY:]
        start = time.process_time()
        est = hw.estimate(model, part, method)
        seconds += time.process_time() - start
        status.append(est.status)
        mid = (delta + 1) // 2 - 1
        error.append([np.abs(est.x[k] - x[1:][k]).mean() for k in (-1, mid)])
        theirs.append([np.abs(kf[k] - x[1:][k]).mean() for k in (-1, mid)])
        hit = np.array([(x[1:] >= lo) & (x[1:] <= hi) for lo, hi in (est.interval(q) for q in LEVELS)])
        covered.append(hit.mean(axis=(1, 2)))
        ends.append(hit[:, -1].mean(axis=1))
        if est.q is not None:
            s.append(np.r_[est.q, est.r])
    error, theirs = np.array(error), np.array(theirs)
    ratio = error.mean(axis=0) / theirs.mean(axis=0)
    spread = np.std(np.array(covered), axis=0) / np.sqrt(count)
    return {
        "filter": error[:, 0].mean(), "kf": theirs[:, 0].mean(), "ratio": ratio[0],
        "mid": error[:, 1].mean(), "kf mid": theirs[:, 1].mean(), "mid ratio": ratio[1],
        "coverage": 100 * np.mean(covered, axis=0), "error of it": 100 * spread, "at the end": 100 * np.mean(ends, axis=0),
        "s": np.mean(s, axis=0), "bad": sum(not q.good for q in status), "ms": 1e3 * seconds / count,
    }  # fmt: skip


def show(name, c):
    """Print one row of the table."""
    cover = " ".join(f"{v:5.1f}" for v in c["coverage"])
    print(
        f"{name:<31} {c['filter']:.4f} {c['kf']:.4f} {c['ratio']:5.2f}  {c['mid']:.4f} {c['kf mid']:.4f} {c['mid ratio']:5.2f}"
        f"  {cover}  (+-{c['error of it'].max():.1f})  {' '.join(f'{v:.3f}' for v in c['s'])}  {c['bad']:3d}  {c['ms']:6.1f}",
        flush=True,
    )


BURN_IN, LONG = 200, 700


def stream_case(delta, *, correlated=False, missing=0.0, seed=11, model=None, recall=40.0):
    """Return the same of windows along long paths, at the filter's end and at mid-window."""
    unknown = hw.Uniform.unknown(at_most=1.0)
    model = system(unknown, unknown, correlated=correlated) if model is None else model
    mid = (delta + 1) // 2
    kept = slice(BURN_IN + mid, LONG)
    error, theirs, covered, s, seconds, bad = [], [], [], [], 0.0, 0
    paths = max(1, round(12 * WINDOWS / (LONG - BURN_IN)))
    for path in range(paths):
        X, record = along(path, seed, correlated=correlated, missing=missing)
        kf = told_the_truth(record, correlated=correlated)
        rows = Sliding(hw.Window(hw.Posterior(), delta, recall=recall, lag=mid), model, 0.0)
        off, hit, learned = [], [], []
        for t in range(LONG):  # what `lag=0` and `lag=mid` give, in one run
            start = time.process_time()
            solved = rows.push(record.y[t], record.u[t], 1.0)
            seconds += time.process_time() - start
            bad += not solved.status.good
            if t < BURN_IN + mid:
                continue
            ends = [solved.spread.interval(q) for q in LEVELS]
            pairs = [(-1, X[t + 1]), (-1 - mid, X[t + 1 - mid])]
            off.append([np.abs(solved.x[k] - x).mean() for k, x in pairs])
            hit.append([[((x >= lo[k]) & (x <= hi[k])).mean() for lo, hi in ends] for k, x in pairs])
            learned.append(solved.s)
        both = list(zip(np.mean(off, axis=0), np.mean(hit, axis=0), strict=True))
        error.append([e for e, _ in both])
        theirs.append(np.abs(kf - X[1:])[kept].mean())
        covered.append([h for _, h in both])
        s.append(np.nanmean(learned, axis=0))
    error, theirs, covered = np.array(error), np.mean(theirs), np.array(covered)
    middle = covered.mean(axis=1)
    return {
        "filter": error[:, 0].mean(), "kf": theirs, "ratio": error[:, 0].mean() / theirs,
        "mid": error[:, 1].mean(), "kf mid": theirs, "mid ratio": error[:, 1].mean() / theirs,
        "coverage": 100 * middle.mean(axis=0), "error of it": 100 * middle.std(axis=0) / np.sqrt(paths),
        "at the end": 100 * covered[:, 0].mean(axis=0), "s": np.mean(s, axis=0), "bad": bad,
        "ms": 1e3 * seconds / (paths * LONG),
    }  # fmt: skip


def streams():
    """Print errors, coverage and learned half-widths of windows that carry what they have learned."""
    known = system(hw.Uniform(Q), hw.Uniform(R))
    print(
        f"along {max(1, round(12 * WINDOWS / (LONG - BURN_IN)))} paths of {LONG} rows, the first {BURN_IN} left out; "
        "coverage: mean of the filter's end and mid-window"
    )
    for delta in (5, 25, 50):
        show(f"stream, Delta {delta}", stream_case(delta))
        show(f"stream, Delta {delta}, told q, r", stream_case(delta, model=known))
    for name, more in (("20 % missing", {"missing": 0.2}), ("E and F", {"correlated": True})):
        show(f"stream, Delta 25, {name}", stream_case(25, **more))
        told = system(hw.Uniform(Q), hw.Uniform(R), correlated="correlated" in more)
        show("  the same, told q, r", stream_case(25, model=told, **more))


def against_draws():
    """Compare with the sampler where half-widths are known."""
    model = system(hw.Uniform(Q), hw.Uniform(R))
    count = min(WINDOWS, 50)
    off, ratio, held = [], [], []
    for k, (_, _, part) in enumerate(windows(25, count, 7)):
        est = hw.estimate(model, part, hw.Posterior())
        draws = hw.estimate(model, part, hw.Posterior(method="sample", draws=1000), seed=k)
        points = draws.spread.points
        sd = points.std(axis=1)
        off.append(np.abs(est.x - points.mean(axis=1)) / sd)
        ratio.append(est.spread.sd / sd)
        ends = [est.interval(q) for q in LEVELS]
        held.append([((points >= lo[:, None]) & (points <= hi[:, None])).mean() for lo, hi in ends])
    off, ratio = np.array(off), np.array(ratio)
    low, high = np.percentile(ratio, [2.5, 97.5])
    print(
        f"{count} windows of Delta 25 with known half-widths against draws: means off by {off.mean():.3f} sd on average, "
        f"{off.max():.3f} at most; sd ratio {ratio.mean():.3f}, 95 % of them {low:.3f} to {high:.3f}, all "
        f"{ratio.min():.3f} to {ratio.max():.3f}; share of draws inside intervals of 50 80 90 95 %: "
        + " ".join(f"{100 * v:.1f}" for v in np.mean(held, axis=0))
    )


def fewer_nodes():
    """Compare what some nodes give with what 1024 give."""
    model = system(*(hw.Uniform.unknown(at_most=1.0),) * 2)
    parts = [part for _, _, part in windows(25, min(WINDOWS, 50), 7)]
    many = [hw.estimate(model, part, hw.Posterior(nodes=1024)) for part in parts]
    print(f"{len(parts)} windows of Delta 25, five unknown half-widths, against 1024 nodes")
    for count in (16, 32, 64, 128):
        some = [hw.estimate(model, part, hw.Posterior(nodes=count)) for part in parts]
        off = np.mean([np.abs(a.x - b.x) / b.spread.sd for a, b in zip(some, many, strict=True)])
        ratio = np.array([a.spread.sd / b.spread.sd for a, b in zip(some, many, strict=True)])
        print(
            f"  {count:4d} nodes: means off by {off:.3f} sd on average; sd ratio {ratio.mean():.3f}, "
            f"root mean square {np.sqrt(np.mean((ratio - 1) ** 2)):.3f} from 1"
        )


def table():
    """Print both tables."""
    windows_alone()
    streams()


def windows_alone():
    """Print errors, coverage and learned half-widths of windows on their own."""
    known = system(hw.Uniform(Q), hw.Uniform(R))
    print(
        f"{WINDOWS} windows on their own; half-widths unknown (truth .1 .1 .1 .3 .3); mean absolute errors over the three states"
    )
    print(
        " " * 31, "filter    KF ratio     mid     KF ratio   covered at 50 80 90 95 %          learned s   bad  CPU ms"
    )
    for delta in (5, 25, 50):
        show(f"Delta {delta}", one_case(delta))
        show(f"Delta {delta}, told q and r", one_case(delta, model=known))
    show("Delta 25, 20 % missing", one_case(25, missing=0.2))
    show("Delta 25, E and F", one_case(25, correlated=True))
    show("Delta 25, E, F, missing", one_case(25, correlated=True, missing=0.2))


def variances():
    """Print coverage and bias where variances are unknown, alone and beside half-widths, told and not."""
    from_ = (0.04, 0.09), (0.25, 0.16)
    own, box, free = hw.Gaussian.unknown(at_most=100.0), hw.Uniform.unknown(at_most=10.0), hw.Gaussian
    cases = {
        "Gaussian, both unknown": (free(from_[0]), free(from_[1]), own, own),
        "Uniform and Gaussian unknown": (hw.Uniform([0.3, 0.5]), free(from_[1]), box, own),
        "e: Uniform told, Gaussian unknown": (
            free(from_[0]),
            hw.Uniform(0.5) + free(from_[1]),
            own,
            hw.Uniform(0.5) + own,
        ),
        "e: Uniform unknown, Gaussian told": (free(from_[0]), hw.Uniform(1.0) + free(0.05), own, box + free(0.05)),
        "e: sum of two unknown": (free(from_[0]), hw.Uniform(1.0) + free(0.05), own, box + own),
        "w: Uniform told, Gaussian unknown": (
            hw.Uniform(0.3) + free(from_[0]),
            free(from_[1]),
            hw.Uniform(0.3) + own,
            own,
        ),
    }
    model = np.array([[0.9, 0.2], [0, 0.8]]), None, np.eye(2)
    count = min(WINDOWS, 200)
    for rows in (6, 26, 51):
        for name, (w, e, asked_w, asked_e) in cases.items():
            rng, hit, learned, bad = np.random.default_rng(11), [], [], 0
            for _ in range(count):
                x0 = hw.Normal(np.zeros(2), 1.0)
                truth, record = hw.simulate(hw.Linear(*model, w, e, x0), T=rows, seed=int(rng.integers(2**31)))
                est = hw.estimate(hw.Linear(*model, asked_w, asked_e, x0), record, hw.Posterior())
                bad += not est.status.good
                hit.append([np.mean((lo <= truth.x) & (truth.x <= hi)) for lo, hi in map(est.interval, LEVELS)])
                learned.append([v for v in (est.q, est.r, est.Q, est.R) if v is not None])
            error = 100 * np.std(hit, axis=0).max() / np.sqrt(count)
            print(
                f"{rows:3d} rows  {name:<34} {' '.join(f'{100 * v:5.1f}' for v in np.mean(hit, axis=0))}  (+-{error:.1f})  "
                f"learned {' '.join(np.array2string(v, precision=3) for v in np.mean(learned, axis=0))}  bad {bad}",
                flush=True,
            )


def priors():
    """Print coverage and bias for other powers of the prior."""
    kept = posterior.POWER
    for power in (0.25, 0.5, 0.75):
        posterior.POWER = power
        for delta in (5, 25, 50):
            show(f"power {power}, Delta {delta}", one_case(delta, count=min(WINDOWS, 200)))
    posterior.POWER = kept


def ensemble():
    """Compare widths with the interval of the paper, eq. (31), each at the coverage that the paper's has."""
    paths = max(1, round(WINDOWS / 125))
    for correlated in (False, True):
        print(
            f"\n{paths} paths of {LONG} rows, the first {BURN_IN} and last {40} left out, Delta 25"
            + (", E and F" if correlated else "")
            + "; widths over that of the paper's ensemble interval at the coverage it has"
        )
        rows = slice(BURN_IN, LONG - 40)
        theirs, ours, states = [], {}, []
        for path in range(paths):
            X, record = along(path, 17, correlated=correlated)
            unknown = hw.Uniform.unknown(at_most=1.0)
            model = system(unknown, unknown, correlated=correlated)
            paper = hw.Window(hw.BatchLP(objective="paper", point="optimal"), 25, fixes=0)
            theirs.append(hw.estimate(model, record, paper))
            states.append(X[1:][rows])
            for name, spread in lagged(model, record).items():
                ours.setdefault(name, []).append(rows_of(spread, rows))
        for kappa in KAPPA:
            ends = [hw.ensemble_interval(est, kappa) for est in theirs]
            ends = [(lo[rows], hi[rows]) for lo, hi in ends]
            inside = _inside(ends, states)
            width = np.mean([hi - lo for lo, hi in ends])
            line = f"  kappa {kappa:g}: covers {inside:.1%}, width {width:.3f}; narrower by"
            for name, spreads in ours.items():
                level = _level(spreads, states, inside)
                own = np.mean([np.subtract(*s.interval(level)[::-1]) for s in spreads])
                line += f"  {name}: {width / own:.2f} (level {level:.3f})"
            print(line, flush=True)


def along(path, seed, *, correlated=False, missing=0.0):
    """Return states and record of one long path that stays inside the box."""
    rng = np.random.default_rng([seed, path])
    X, u = stays(rng, LONG, correlated=correlated)
    y = X[1:] @ C.T + rng.uniform(-R, R, (LONG, 2))
    if correlated:
        y = y @ np.linalg.inv(F).T
    y[rng.random(y.shape) < missing] = np.nan
    return X, hw.Record(np.arange(1.0, LONG + 1), y, u)


def lagged(model, record):
    """Return the spread of every row from windows that end so many rows later: carrying, alone, and told q and r."""
    told = dataclasses.replace(model, w=hw.Uniform(Q), e=hw.Uniform(R))
    found = {}
    for kind, asked, recall, lags in (
        ("", model, 40.0, (0, 12, 25)),
        ("alone", model, 0.0, (12,)),
        ("told", told, 40.0, (25,)),
    ):
        rows = Sliding(hw.Window(hw.Posterior(), 25, recall=recall, lag=max(lags)), asked, 0.0)
        names = {lag: f"{kind} lag {lag}".strip() for lag in lags}
        found |= {name: [] for name in names.values()}
        for t in range(len(record)):
            solved = rows.push(record.y[t], record.u[t], 1.0)
            for lag, name in names.items():
                if t >= lag:
                    found[name].append(rows_of(solved.spread, slice(-1 - lag, -lag or None)))
    return {name: stacked(spreads) for name, spreads in found.items()}


def _inside(ends, states):
    return float(np.mean([(x >= lo) & (x <= hi) for (lo, hi), x in zip(ends, states, strict=True)]))


def _level(spreads, states, share):
    """Return the level whose intervals cover this share."""
    lo, hi = 0.02, 0.9999
    for _ in range(20):
        mid = 0.5 * (lo + hi)
        inside = _inside([s.interval(mid) for s in spreads], states)
        lo, hi = (mid, hi) if inside < share else (lo, mid)
    return 0.5 * (lo + hi)


def outliers():
    """Replace 1 % of y by 10 r off, and name them."""
    unknown = hw.Uniform.unknown(at_most=1.0)
    model = system(unknown, unknown)
    errors, hits, misses, false = [], 0, 0, 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        X, record = drawn(rng, 200)
        y = record.y.copy()
        bad = rng.random(y.shape) < 0.01
        y[bad] += rng.choice([-10 * R, 10 * R], bad.sum())
        clean = hw.estimate(model, record, hw.Posterior())
        est = hw.estimate(model, hw.Record(record.t, y, record.u), hw.Posterior(outliers=True))
        errors.append([np.abs(e.x - X[1:]).mean() for e in (clean, est)])
        named = est.info["outlier_probability"] > 0.5
        hits, misses, false = hits + (named & bad).sum(), misses + (~named & bad).sum(), false + (named & ~bad).sum()
    one, two = np.mean(errors, axis=0)
    print(
        f"1 % outliers of 10 r, 20 records of 200 rows: error {two:.4f} against {one:.4f} without, ratio {two / one:.3f}"
    )
    print(f"  named {hits}, missed {misses}, named wrongly {false}")


def robust():
    """Estimate random windows: missing rows, boxes, outliers, zero noise, infeasible data."""
    rng = np.random.default_rng(0)
    count, bad = 20 * WINDOWS, 0
    status = {}
    for _ in range(count):
        n, ny, T = rng.integers(1, 4), rng.integers(1, 3), rng.integers(1, 15)
        scale = 10 ** rng.uniform(-6, 6)
        noise = [
            hw.Uniform.unknown(at_most=rng.choice([1.0, 10.0]) * scale),
            hw.Uniform(scale * rng.choice([0.0, 1e-6, 0.1, 1.0])),
            hw.Gaussian((scale * rng.choice([0.0, 1e-3, 1.0])) ** 2),
            hw.Uniform.unknown() + hw.Gaussian((0.1 * scale) ** 2),
            hw.Gaussian.unknown(),
            hw.Uniform(scale * rng.choice([0.0, 0.1])) + hw.Gaussian.unknown(),
            hw.Uniform.unknown() + hw.Gaussian.unknown(),
        ]
        prior = [hw.Box(-scale * np.ones(n), scale * np.ones(n)), None, hw.Normal(np.zeros(n), scale**2)][
            rng.integers(3)
        ]
        bounds = [None, (-3 * scale * np.ones(n), 3 * scale * np.ones(n))][rng.integers(2)]
        e = noise[rng.integers(7)]
        model = hw.Linear(
            rng.uniform(-1, 1, (n, n)),
            None,
            rng.standard_normal((ny, n)),
            noise[rng.integers(7)],
            e,
            prior,
            bounds=bounds,
        )
        y = scale * rng.standard_normal((T, ny))
        y[rng.random(y.shape) < rng.choice([0.0, 0.3, 1.0])] = np.nan
        if rng.random() < 0.3:
            y[rng.integers(T)] *= 1e3
        named = not isinstance(e, hw.Gaussian) and rng.random() < 0.3
        est = hw.estimate(model, hw.Record(np.arange(1.0, T + 1), y), hw.Posterior(nodes=8, outliers=bool(named)))
        numbers = [est.x, *est.interval(0.9), *(v for v in (est.q, est.r, est.Q, est.R, est.loglik) if v is not None)]
        bad += not all(np.isfinite(v).all() for v in numbers)
        status[est.status.name] = status.get(est.status.name, 0) + 1
    print(f"{count} random windows: {bad} with a number that is not finite; statuses {status}")


#: Middle of the half-widths' prior in calibration, and its standard deviation over the middle.
MIDDLE, SPREAD = np.array([0.1, 0.1, 0.1, 0.3, 0.3]), 0.3


def from_the_prior(rng):
    """Return half-widths (5,) of the density s^(power - 1) exp(-(s / middle - 1)^2 / 2 spread^2)."""
    v = np.geomspace(1e-6, 1.0 + 8 * SPREAD, 20_000)
    below = np.cumsum(v**posterior.POWER * np.exp(-0.5 * ((v - 1.0) / SPREAD) ** 2))
    return MIDDLE * np.interp(rng.random(5), below / below[-1], v)


def rank_of_s(found, s):
    """Return the posterior probability below half-widths s (5,): of the nodes, each with its share of the spread.

    The nodes of all windows have one pattern, whose steps would show in the ranks. So each is a Gaussian of s^(1/2) of
    the width that a density estimate has, drawn in to the mean so that the whole keeps its variance (West, 1993).
    """
    K = int(found["nodes"])
    weight = np.exp(found["log_weight"][:K] - found["log_weight"][:K].max())
    weight /= weight.sum()
    u, at = np.exp(0.5 * found["phi"][:K]), np.sqrt(s)
    mean = weight @ u
    sd = np.sqrt(weight @ (u - mean) ** 2)
    width = min(1.06 * (weight @ weight) ** 0.2, 1.0)
    centre = mean + np.sqrt(1.0 - width**2) * (u - mean)
    return weight @ ndtr((at - centre) / (width * sd))


def sbc(*, reference, delta=25, seed=5):
    """Return estimates, true states, and ranks of true half-widths (windows, 5) under the prior that they are drawn from.

    It is a power of s, as the default prior is, times a Gaussian of s, as other rows of a stream would tell it.
    `reference`: whether the estimates have the default prior's factor `told` besides, which nothing can be drawn from.
    """
    rng = np.random.default_rng(seed)
    x0 = hw.Box(0.3 * BOX.lo, 0.3 * BOX.hi)
    unknown = hw.Uniform.unknown(at_most=50.0)
    asked = system(unknown, unknown, x0, bounds=None)
    known = Known(1.0 / (MIDDLE * SPREAD**2), np.diag(1.0 / (MIDDLE * SPREAD) ** 2), np.zeros(5))
    kept = posterior._LIMITS["reference"]
    posterior._LIMITS["reference"] = kept if reference else 0.0
    ests, true, of_s = [], [], []
    for _ in range(WINDOWS):
        s = from_the_prior(rng)
        model = system(hw.Uniform(s[:3]), hw.Uniform(s[3:]), x0, bounds=None)
        truth, record = hw.simulate(model, rng.uniform(-1, 1, (delta + 1, 1)), seed=int(rng.integers(2**31)))
        answer = hw.Posterior(nodes=256).answer(asked, record, known=known)
        of_s.append(rank_of_s(answer.found, s))
        ests.append(answer.estimate)
        true.append(truth.x)
    posterior._LIMITS["reference"] = kept
    return ests, true, np.array(of_s)


def calibration():
    """Simulation-based calibration: ranks of the true states and half-widths in their posterior."""
    drawn_axes = _figure("calibration", 2, 2)
    for row, reference in enumerate((False, True)):
        print(
            "\nhalf-widths estimated with "
            + (
                "the default prior, which has the factor `told` besides"
                if reference
                else "the prior they are drawn from"
            )
        )
        ests, true, of_s = sbc(reference=reference)
        states, widths = hw.ranks(ests, true, bins=10), hw.Ranks.of(np.clip(of_s, 0, 1), bins=10)
        print(f"{WINDOWS} windows of 26 rows; states: {states}")
        for name, some in (("half-widths", of_s), ("q", of_s[:, :3]), ("r", of_s[:, 3:])):
            print(f"{name}: {hw.Ranks.of(np.clip(some, 0, 1), bins=10)}")
        if drawn_axes is not None:
            kind = "default prior" if reference else "prior drawn from"
            states.plot(drawn_axes[row, 0]).set_title(f"states, {kind}")
            widths.plot(drawn_axes[row, 1]).set_title(f"half-widths, {kind}")
    _save(drawn_axes, "calibration")


def pictures():
    """Draw coverage of windows told nothing, told all and Gaussian, and the band of a state over time."""
    found = windows(25, WINDOWS, 7)
    unknown = hw.Uniform.unknown(at_most=1.0)
    gaussian = hw.Gaussian(np.full(3, Q**2 / 3)), hw.Gaussian(np.full(2, R**2 / 3))
    prior = hw.Normal(BOX.mean, (BOX.hi - BOX.lo) ** 2 / 12)
    thrice = hw.Gaussian(np.full(3, Q**2)), hw.Gaussian(np.full(2, R**2))
    box = hw.Hull()
    asked = {
        "Posterior, told nothing": (system(unknown, unknown), hw.Posterior()),
        "Gaussian, told the covariances": (system(*gaussian, prior, bounds=None), hw.KalmanSmoother()),
        "Gaussian, told three times too much": (system(*thrice, prior, bounds=None), hw.KalmanSmoother()),
        "Hull, told the half-widths": (system(hw.Uniform(Q), hw.Uniform(R)), box),
    }
    axes = _figure("coverage", 1, 1)
    first = None
    for name, (model, method) in asked.items():
        ests = [hw.estimate(model, part, method) for _, _, part in found]
        share = hw.coverage(ests, [x[1:] for x, _, _ in found])
        print(f"\n{name}: {'honest' if share.honest else 'not honest'}\n{share}")
        first = ests[0] if first is None else first
        if axes is not None:
            share.plot(axes[0, 0], label=name)
    _save(axes, "coverage")
    axes = _figure("band", 3, 1)
    if axes is not None:
        first.plot(found[0][0][1:], ax=axes[:, 0])
    _save(axes, "band")


STEP = 0.1


def slopes(*, delta=25, rows=360, every=6, seed=6):
    """Print the mean slope of the log evidence in log s at the true half-widths, as windows of a stream tell it.

    It is 0 on average where half-widths are learned without bias. The evidence of the bounds alone, which it is divided
    by, is also had from particles.
    """
    true = np.r_[np.full(3, Q), np.full(2, R)]
    moved = np.repeat(np.eye(5), 2, axis=0) * np.tile([STEP, -STEP], 5)[:, None]
    members = np.concatenate([true[None], true * np.exp(moved)])

    def slope(chain):  # of expectation propagation, to first order and what the second adds
        found = _core.ep_run(chain, members, np.zeros(len(members)), 60, 1e-5, 1.0, None)
        return [(v[1::2] - v[2::2]) / (2 * STEP) for v in (found["log_z"], found["second"])]

    unknown = hw.Uniform.unknown(at_most=1.0)
    for correlated in (False, True):
        found, particles = [], []
        for path in range(max(2, WINDOWS // 5)):
            rng = np.random.default_rng([seed, path])
            X, u = stays(rng, rows + delta, correlated=correlated, many=1_500)
            y = X[1:] @ C.T + rng.uniform(-R, R, (len(u), 2))
            y = y @ np.linalg.inv(F).T if correlated else y
            told = Sliding(
                hw.Window(hw.Posterior(), delta), system(hw.Uniform(Q), hw.Uniform(R), correlated=correlated), 0.0
            )
            own, off = [], []
            for t in range(rows):
                told.push(y[t], u[t], 1.0)
                if t < 60 or t % every:
                    continue
                part = slice(t - delta, t + 1)
                record = hw.Record(np.arange(1.0, delta + 2), y[part], u[part])
                chain = sites(system(unknown, unknown, told.carried.first, correlated=correlated), record)
                own.append([*slope(chain.problem), *slope(chain.outside)])
                if len(own) % 12 == 0:
                    exact = _by_particles(told.carried.first, u[part], correlated, int(rng.integers(2**31)))
                    off.append(exact - np.sum(own[-1][2:], axis=0)[:3])
            found.append(np.mean(own, axis=0))
            particles.append(np.mean(off, axis=0))
        found, particles = (100 / (delta + 1) * np.array(v) for v in (found, particles))
        sound = (np.abs(found) < 1e4).all(axis=(1, 2))  # so sharp a box that its cumulants overflow
        with_data, bounds = found[sound, :2].sum(axis=1), found[sound, 2:].sum(axis=1)
        print(
            f"\n{sound.sum()} paths of {rows} rows"
            + (", E and F" if correlated else "")
            + "; slopes in log s of 100 rows, +- one"
        )
        for name, value in (
            ("bounds alone", bounds[:, :3]),
            ("  what particles differ by", particles),
            ("data and bounds", with_data),
            ("the difference, 0 wanted", with_data - bounds),
            ("  bounds by particles", (with_data - bounds)[:, :3] - particles[sound]),
        ):
            error = value.std(axis=0) / np.sqrt(len(value))
            print(
                f"{name:<28}"
                + "  ".join(f"{m:6.2f} +-{e:4.2f}" for m, e in zip(value.mean(axis=0), error, strict=True)),
                flush=True,
            )


def _by_particles(first, u, correlated, seed, many=3_000):
    """Return the slope (3,) of log P(inside) in log q at the truth, of states that begin in a Gaussian."""
    G = np.linalg.inv(E) if correlated else np.eye(3)
    slope = np.empty(3)
    for j in range(3):
        total = 0.0
        for sign in (1.0, -1.0):
            rng, q = np.random.default_rng(seed), Q * np.exp(sign * STEP * np.eye(3)[j])
            x = rng.multivariate_normal(first.mean, first.P, 8 * many)
            x = x[((x >= BOX.lo) & (x <= BOX.hi)).all(axis=1)][:many]
            for row in u:
                x = (x @ A.T + row @ B.T + q * rng.uniform(-1, 1, x.shape)) @ G.T
                alive = ((x >= BOX.lo) & (x <= BOX.hi)).all(axis=1)
                total += sign * np.log(alive.mean())
                x = x[alive][rng.integers(alive.sum(), size=many)]
        slope[j] = total / (2 * STEP)
    return slope


def _figure(name, rows, columns):
    """Return axes (rows, columns) of a figure if `PICTURES` names a folder to put it in, else None."""
    if "PICTURES" not in os.environ:
        return None
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    size = {"band": (8, 6)}.get(name, (5 * columns, 4.2 * rows))
    return plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)[1]


def _save(axes, name):
    if axes is not None:
        path = os.path.join(os.environ["PICTURES"], f"{name}.png")
        axes[0, 0].figure.savefig(path, dpi=110)
        print("wrote", path)


def main():
    """Run what is asked for."""
    studies = {
        "table": table, "windows": windows_alone, "streams": streams, "known": against_draws, "nodes": fewer_nodes, "priors": priors, "ensemble": ensemble, "outliers": outliers, "robust": robust,
        "calibration": calibration, "pictures": pictures, "slopes": slopes, "variances": variances,
    }  # fmt: skip
    for name in sys.argv[1:] or ["table"]:
        studies[name]()


if __name__ == "__main__":
    main()
