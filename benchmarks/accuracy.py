"""Print how far off each method fills outages of real logs, and how `fill` does beside them.

    python benchmarks/accuracy.py [FOLDER OF LOGS] [--starts 20] [--seed 1] [--methods linear,em] [--lengths 1,5,30]
                                  [--tracks 20] [--fair] [--even] [--silent speed_mps]

Nothing is told of a log: clocks, scale and bias of its sensors are found from it. The first table of each log is that
of `halfwidth outages`; the second one, where numbers are asked of the log, sets the chain beside them, in metres and as
a share of the error of a straight line on the same starts, since twenty random starts differ by more than methods do.

The last table, the only one with `--fair`, hides the same stretches from the log before anything is learnt of it,
several far apart at a time, and fills what is left by `fill` and by each single method, `fill(method=...)`: mean and
mean of maxima of `fill`, how often its half-widths hold, how wide they are, the seconds a track takes, and the method
that was best on these starts in hindsight. Then ratios with their standard errors, from the differences start by start;
starts whose stretches overlap tell the same twice, and count for as much less:

    mean, maxima   `fill` over the best method, of means and of means of maxima. The best of many methods on twenty
                   starts is partly luck, so this is above 1 even where no method is better;
    others best    `fill` over the method that is best on all the other starts, which is no luck;
    linear         `fill` over straight lines, mean / maxima.

With `--even` the starts are spread evenly over all that could have been drawn, which leaves hardly any luck of starts:
on a short log twenty random stretches of a minute lie on top of each other, and leave half of it out. With `--silent`
the named streams are hidden in these stretches as well. The slowest methods, which never are the best, are
left out unless `--methods` has them.
"""

import argparse
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import hidden
import numpy as np

import halfwidth as hw
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.choice import estimated
from halfwidth.vehicle.estimators import method
from halfwidth.vehicle.fill import prepared, read_off
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.outage import LENGTHS
from halfwidth.vehicle.stamps import restamped

#: How much worse than the best single method `fill` may be.
WORSE = 1.05

#: Of so many random starts, in order, one is taken where they are to be spread evenly.
EVERY = 20

#: Name of `fill` among the methods, and those that it is set beside.
FILL = "fill"
BESIDE = (
    *("em", "em-slow", "em-white", "linear", "cv", "gpsins", "ctrv", "slp", "slp-white"),
    *("paper000", "paper000+ls", "paper002lin"),
)

#: Asked of the default method by the start of a log's name and by length: mean and mean of maxima, m, and those of a
#: straight line on the starts they were asked for.
ASKED = {
    "smartloc": {
        10.0: ((0.12, 0.25), (4.75, 7.83)),
        30.0: ((0.38, 0.90), (17.45, 33.02)),
        60.0: ((0.80, 1.70), (33.52, 68.62)),
    },
    "balzer": {
        1.0: ((0.18, 0.28), (0.23, 0.34)),
        5.0: ((0.60, 1.15), (1.56, 2.60)),
        10.0: ((1.7, 3.9), (9.04, 14.64)),
        30.0: ((4.0, 8.5), (34.30, 61.62)),
    },
}


def asked_of(name, found):
    """Print what was asked of a log beside what came out, in metres and as shares of a straight line's error."""
    rows = next((rows for start, rows in ASKED.items() if name.startswith(start)), {})
    rows = {length: row for length, row in rows.items() if length in found.lengths}
    if not rows or not {"em", "linear"} <= set(found.methods):
        return
    print(f"{'asked':10}{'starts':>8}{'m':>16}{'asked m':>16}{'of the line':>20}{'asked':>18}")
    for length, (wanted, line) in rows.items():
        em, straight = found.cell("em", length), found.cell("linear", length)
        share = f"{em.mean / straight.mean:.4f} / {em.max / straight.max:.4f}"
        share_asked = f"{wanted[0] / line[0]:.4f} / {wanted[1] / line[1]:.4f}"
        print(
            f"{length:>6g} s  {em.n:>8}{f'{em.mean:.3f} / {em.max:.3f}':>16}{f'{wanted[0]:g} / {wanted[1]:g}':>16}"
            f"{share:>20}{share_asked:>18}"
        )
    print()


@dataclass
class Beside:
    """Errors of the track of `fill` and of single methods at one length, start by start."""

    start: list = field(default_factory=list)
    count: list = field(default_factory=list)
    means: dict = field(default_factory=dict)
    maxima: dict = field(default_factory=dict)
    inside: list = field(default_factory=list)
    widths: list = field(default_factory=list)
    seconds: list = field(default_factory=list)

    def add(self, way, off):
        distance = np.hypot(off[:, 0], off[:, 1])
        self.means.setdefault(way, []).append(distance.mean())
        self.maxima.setdefault(way, []).append(distance.max())


def by_method(ready, name):
    """Return the positions (M, 2) of the rows of a track that one method fills; half-widths are not asked for."""
    answers = estimated(ready.pieces, method(name), (), 0.9, [], free=False)
    columns = read_off(answers, ready.pieces, ready.t)
    return ready.grid.frame.to_geodetic(*ready.antenna(columns.east, columns.north))


def beside(log, begins, length, methods, times, silent):
    """Hide stretches, several far apart at a time, and fill the very same logs by `fill` and by each method."""
    found = Beside()
    for group in hidden.groups(begins, length):
        left = hidden.without(log, group, length, silent)
        clock = time.process_time()
        track = hw.vehicle.fill(left)
        found.seconds.append(time.process_time() - clock)
        ready = prepared(left, [])
        ways = {name: by_method(ready, name) for name in methods}
        for t0 in group:
            off, half, _ = hidden.compared(log, track, t0, length, times)
            if not off.size:
                continue
            found.start.append(t0)
            found.count.append(len(off))
            found.add(FILL, off)
            found.inside.append(np.mean(np.abs(off) <= half))
            found.widths.append(half.mean())
            for name, (lat, lon) in ways.items():
                found.add(name, hidden.compared(log, replace(track, lat_deg=lat, lon_deg=lon), t0, length, times)[0])
    return found


def overlap(start, length):
    """Return the share (n, n) of stretches of one length that each has in common with each other."""
    return np.clip(1.0 - np.abs(start[:, None] - start) / length, 0.0, None)


def ratio(own, other, weight, alike):
    """Return the ratio of two means and the standard error of that from the differences, start by start.

    What two starts tell is alike by the share (n, n) of their stretches that is the same, `overlap` (Newey and West
    1987).
    """
    a, b, n = np.average(own, weights=weight), np.average(other, weights=weight), len(weight)
    apart = weight / weight.sum() * n * (own - a / b * other)
    left = n * n - alike.sum()  # differences from a mean of their own are smaller than those from the true one
    return a / b, np.sqrt(max(apart @ alike @ apart, 0.0) / left) / b if left > 0 else float("nan")


def others_best(errors, weight):
    """Return for each start the error of the method that is best on all the other starts."""
    names = list(errors)
    table = np.array([errors[name] for name in names])
    sums = (table * weight).sum(axis=1)
    return np.array([table[np.argmin(sums - table[:, k] * weight[k]), k] for k in range(len(weight))])


def compared(log, found, lengths, most, methods, silent, every=1):
    """Print the track of `fill` beside the single methods on the very same logs, with the same fixes hidden."""
    nodes = sampled(log, sensors=calibrated(log))
    times = nodes.t[nodes.seen]  # the fixes that `outages` compares with
    print(
        f"{'fill':8}{'starts':>7}{'m':>14}{'inside':>8}{'half m':>8}{'s':>6}   {'best method':>30}"
        f"{'mean':>14}{'maxima':>14}{'others best':>14}{'linear':>14}"
    )
    beyond = []
    for length in lengths:
        begins = next((cell.start for cell in found.cells if cell.length == length), np.empty(0))
        begins = np.sort(begins)[every // 2 :: every] if every > 1 else begins[:most]
        if not len(begins):
            continue
        one = beside(log, begins, length, methods, times, silent)
        if not one.start:
            continue
        n, start = np.array(one.count, dtype=float), np.array(one.start)
        same, once = overlap(start, length), np.ones(len(start))
        means = {name: np.array(v) for name, v in one.means.items()}
        maxima = {name: np.array(v) for name, v in one.maxima.items()}
        own, top = means.pop(FILL), maxima.pop(FILL)

        def shares(mean, largest, own=own, top=top, n=n):
            return np.average(own, weights=n) / np.average(mean, weights=n), top.mean() / largest.mean()

        best = min(means, key=lambda name: np.average(means[name], weights=n))
        best_top = min(maxima, key=lambda name: maxima[name].mean())
        pairs = {
            "mean": ratio(own, means[best], n, same),
            "maxima": ratio(top, maxima[best_top], once, same),
            "others": ratio(own, others_best(means, n), n, same),
        }
        line = shares(means["linear"], maxima["linear"]) if "linear" in means else (float("nan"),) * 2
        names = best if best == best_top else f"{best}, {best_top}"
        words = f"{names} {np.average(means[best], weights=n):.3f} / {maxima[best_top].mean():.3f}"
        print(
            f"{length:>6g} s{len(n):>7}{f'{np.average(own, weights=n):.3f} / {top.mean():.3f}':>14}"
            f"{np.mean(one.inside):>8.2f}{np.mean(one.widths):>8.2f}{np.median(one.seconds):>6.2f}   {words:>30}"
            + "".join(f"{f'{a:.2f} +- {e:.2f}':>14}" for a, e in pairs.values())
            + f"{f'{line[0]:.2f} / {line[1]:.2f}':>14}",
            flush=True,
        )
        if max(pairs["mean"][0], pairs["maxima"][0]) > WORSE or max(line) > 1.0:
            beyond.append(f"{length:g} s")
        if best != "em" and "em" in means:
            beside_em = shares(means["em"], maxima["em"])
            print(f"{'':8}em alone: fill is {beside_em[0]:.2f} / {beside_em[1]:.2f} of it")
    print(f"beyond {WORSE:g} times the best single method or worse than linear: {', '.join(beyond) or 'no cell'}")


def main():
    root = Path(__file__).resolve().parents[1]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=root.parent / "shared" / "data")
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--methods", default=None)
    parser.add_argument("--lengths", default=",".join(f"{length:g}" for length in LENGTHS))
    parser.add_argument("--tracks", type=int, default=20, help="stretches of each length hidden from fill")
    parser.add_argument("--fair", action="store_true", help="only the last table")
    parser.add_argument("--even", action="store_true", help="evenly spread starts, not random ones")
    parser.add_argument("--silent", help="streams hidden there as well: speed_mps,yaw_rate_radps")
    asked = parser.parse_args()
    if asked.even and not asked.fair:
        parser.error("--even is for the last table: --fair --even")
    every = EVERY if asked.even else 1
    lengths = tuple(float(length) for length in asked.lengths.split(","))
    methods = None if asked.methods is None else asked.methods.split(",")
    logs = sorted(path for ending in ("*.csv", "*.csv.gz", "*.parquet") for path in asked.folder.glob(ending))
    if not logs:
        parser.error(f"{asked.folder} has no logs")
    silent = asked.silent.split(",") if asked.silent else ()
    for path in logs:
        # `outages` puts a log right that was written late; its starts are on that clock
        log = restamped(hw.vehicle.read(path))[0]
        print(f"\n=== {path.name}: seed {asked.seed}")
        tried = ("linear",) if asked.fair else methods
        found = hw.vehicle.outages(log, lengths, asked.starts * every, asked.seed, tried)
        if not asked.fair:
            print(found, end="\n\n", flush=True)
            asked_of(path.name, found)
        if asked.tracks:
            compared(log, found, lengths, asked.tracks, methods or BESIDE, silent, every)


if __name__ == "__main__":
    main()
