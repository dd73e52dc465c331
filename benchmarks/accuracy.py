"""Print how far off each method fills outages of real logs, and how often the half-widths of `fill` hold.

    python benchmarks/accuracy.py [FOLDER OF LOGS] [--starts 20] [--seed 1] [--methods linear,em] [--lengths 1,5,30]

Every log is tried as it is and, where a clock offset is known of it, with that as well. The table is that of
`halfwidth outages`; the second one hides one stretch at a time from `fill` and compares its track with the hidden
fixes.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import halfwidth as hw
from halfwidth.vehicle.frames import Frame
from halfwidth.vehicle.outage import LENGTHS

#: Seconds that the sensors of a log must be moved, as far as is known, by the start of its name.
CLOCKS = {"balzer": 0.15}


def held(log, lengths, starts, seed, clock_offset):
    """Hide one stretch at a time from `fill`; print error, share inside, and width."""
    frame = Frame.of(log)
    print(f"{'fill':12}{'tracks':>8}{'mean m':>9}{'inside':>9}{'half-width m':>14}{'s a track':>11}")
    for length in lengths:
        begin = hw.vehicle.outages(log, (length,), starts, seed, ("linear",)).cells
        if not begin:
            continue
        errors, inside, widths, seconds = [], [], [], []
        for t0 in begin[0].start:
            clock = time.perf_counter()
            track = hw.vehicle.fill(log.without(t0, t0 + length), clock_offset=clock_offset)
            seconds.append(time.perf_counter() - clock)
            rows = np.flatnonzero(log.fixed & (log.t >= t0) & (log.t <= t0 + length))
            at = np.searchsorted(track.t_s, log.t[rows])
            # a hidden row that is no gap of its own has no row in the track
            there = (at < len(track)) & (track.t_s[np.minimum(at, len(track) - 1)] == log.t[rows])
            rows, at = rows[there], at[there]
            if not rows.size:
                continue
            off = np.column_stack(frame.to_local(track.lat_deg[at], track.lon_deg[at]))
            off -= np.column_stack(frame.to_local(log.lat_deg[rows], log.lon_deg[rows]))
            half = np.column_stack((track.east_half_m[at], track.north_half_m[at]))
            errors.append(np.hypot(off[:, 0], off[:, 1]).mean())
            inside.append(np.mean(np.abs(off) <= half))
            widths.append(half.mean())
        print(
            f"{length:>8g} s  {len(errors):>8}{np.mean(errors):>9.2f}{np.mean(inside):>9.2f}"
            f"{np.mean(widths):>14.2f}{np.median(seconds):>11.2f}"
        )


def main():
    root = Path(__file__).resolve().parents[1]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=root.parent / "shared" / "data")
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--methods", default=None)
    parser.add_argument("--lengths", default=",".join(f"{length:g}" for length in LENGTHS))
    asked = parser.parse_args()
    lengths = tuple(float(length) for length in asked.lengths.split(","))
    methods = None if asked.methods is None else asked.methods.split(",")
    logs = sorted(path for ending in ("*.csv", "*.csv.gz", "*.parquet") for path in asked.folder.glob(ending))
    if not logs:
        parser.error(f"{asked.folder} has no logs")
    for path in logs:
        log = hw.vehicle.read(path)
        known = [offset for name, offset in CLOCKS.items() if path.name.startswith(name)]
        for offset in (0.0, *known):
            print(f"\n=== {path.name}, clock offset {offset:g} s")
            print(hw.vehicle.outages(log, lengths, asked.starts, asked.seed, methods, clock_offset=offset))
            print()
            held(log, lengths, min(asked.starts, 10), asked.seed, offset)


if __name__ == "__main__":
    main()
