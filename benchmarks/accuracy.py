"""Print how far off each method fills outages of real logs, and how often the half-widths of `fill` hold.

    python benchmarks/accuracy.py [FOLDER OF LOGS] [--starts 20] [--seed 1] [--methods linear,em] [--lengths 1,5,30]
                                  [--tracks 20]

Nothing is told of a log: clocks, scale and bias of its sensors are found from it. The first table of each log is that
of `halfwidth outages`; the second one, where numbers are asked of the log, sets the chain beside them, in metres and as
a share of the error of a straight line on the same starts, since twenty random starts differ by more than methods do;
the third hides one stretch at a time from `fill` and compares its track with the hidden fixes. The last one sets that
track beside the single method that was best on the same starts, in hindsight, and beside straight lines: ratios of mean
errors and of means of maxima. The best of many methods on twenty starts is partly luck, so read a ratio with the
standard error of the differences from start to start behind it.
"""

import argparse
import time
from pathlib import Path

import hidden
import numpy as np

import halfwidth as hw
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.outage import LENGTHS
from halfwidth.vehicle.stamps import restamped

#: How much worse than the best single method `fill` may be.
WORSE = 1.05

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


def held(log, found, lengths, most):
    """Hide one stretch at a time from `fill`; print error, share inside, and width; return errors by length."""
    nodes = sampled(log, sensors=calibrated(log))
    times = nodes.t[nodes.seen]  # the fixes that `outages` compares with
    print(f"{'fill':12}{'tracks':>8}{'m':>16}{'inside':>9}{'half-width m':>14}{'s a track':>11}")
    errors = {}
    for length in lengths:
        begin = next((cell.start for cell in found.cells if cell.length == length), np.empty(0))[:most]
        means, largest, counts, inside, widths, seconds, which = [], [], [], [], [], [], []
        for k, t0 in enumerate(begin):
            clock = time.process_time()
            track = hw.vehicle.fill(hidden.without(log, [t0], length))
            seconds.append(time.process_time() - clock)
            off, half, _ = hidden.compared(log, track, t0, length, times)
            if not off.size:
                continue
            distance = np.hypot(off[:, 0], off[:, 1])
            means.append(distance.mean())
            largest.append(distance.max())
            counts.append(len(off))
            inside.append(np.mean(np.abs(off) <= half))
            widths.append(half.mean())
            which.append(k)
        if which:
            errors[length] = tuple(np.array(v) for v in (which, means, largest, counts))
            both = f"{np.average(means, weights=counts):.2f} / {np.mean(largest):.2f}"
            print(
                f"{length:>8g} s  {len(which):>8}{both:>16}{np.mean(inside):>9.2f}"
                f"{np.mean(widths):>14.2f}{np.median(seconds):>11.2f}",
                flush=True,
            )
    return errors


def compared(found, errors):
    """Print the track of `fill` beside the best single method and straight lines, on the same starts."""
    print(
        f"\n{'':10}{'starts':>7}{'fill':>16}{'best of the methods':>32}{'ratio':>15}{'s.e.':>7}{'linear':>18}{'ratio':>15}"
    )
    beyond = []
    for length, (which, mean, largest, n) in errors.items():
        cells = {name: found.cell(name, length) for name in found.methods}
        means = {name: float(np.average(c.mean_error[which], weights=n)) for name, c in cells.items()}
        tops = {name: float(c.max_error[which].mean()) for name, c in cells.items()}
        own, top = float(np.average(mean, weights=n)), float(largest.mean())
        best, best_top = min(means, key=means.get), min(tops, key=tops.get)
        ratio = own / means[best], top / tops[best_top]
        apart = mean - cells[best].mean_error[which]
        error = apart.std(ddof=1) / np.sqrt(apart.size) / means[best] if apart.size > 1 else float("nan")
        names = best if best == best_top else f"{best}, {best_top}"
        line = own / means["linear"], top / tops["linear"]
        print(
            f"{length:>8g} s{len(which):>7}{f'{own:.2f} / {top:.2f}':>16}"
            f"{f'{names} {means[best]:.2f} / {tops[best_top]:.2f}':>32}{f'{ratio[0]:.2f} / {ratio[1]:.2f}':>15}{error:>7.2f}"
            f"{means['linear']:>9.2f} /{tops['linear']:>7.2f}{f'{line[0]:.2f} / {line[1]:.2f}':>15}",
            flush=True,
        )
        if max(ratio) > WORSE or max(line) > 1.0:
            beyond.append(f"{length:g} s")
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
    asked = parser.parse_args()
    lengths = tuple(float(length) for length in asked.lengths.split(","))
    methods = None if asked.methods is None else asked.methods.split(",")
    logs = sorted(path for ending in ("*.csv", "*.csv.gz", "*.parquet") for path in asked.folder.glob(ending))
    if not logs:
        parser.error(f"{asked.folder} has no logs")
    for path in logs:
        # `outages` puts a log right that was written late; its starts are on that clock
        log = restamped(hw.vehicle.read(path))[0]
        print(f"\n=== {path.name}")
        found = hw.vehicle.outages(log, lengths, asked.starts, asked.seed, methods)
        print(found, end="\n\n", flush=True)
        asked_of(path.name, found)
        if asked.tracks:
            errors = held(log, found, lengths, asked.tracks)
            if "linear" in found.methods:
                compared(found, errors)


if __name__ == "__main__":
    main()
