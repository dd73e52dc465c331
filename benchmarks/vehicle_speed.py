"""How long a drive takes: one gap, whole processes on ten minutes and an hour, and the methods that are asked for.

    python benchmarks/vehicle_speed.py [--method ep,tube,cvar]

CPU times, beside what is promised, and the peak of memory. One gap of a minute, with a minute of fixes on both sides, is
filled by the default chain alone (with its learning), the clocks known, and by `fill` with everything that it finds and
tests. The whole processes are `halfwidth check` and `halfwidth fill` with a report and a track, start-up included, on a
simulated drive at 10 Hz with a gap in every three minutes. Methods are timed on five minutes with one gap of half a
minute.
"""

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

from startup import compiled, measure

import halfwidth as hw
from halfwidth.vehicle import chain
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.grid import sampled


def took(call, repeats):
    """Return the median CPU time of a call, s."""
    times = []
    for _ in range(repeats):
        clock = time.process_time()
        call()
        times.append(time.process_time() - clock)
    return statistics.median(times)


def row(what, seconds, promised=None, peak=None):
    """Print one line."""
    more = ("" if peak is None else f"{peak:>8.0f} MB") + ("" if promised is None else f"   promised {promised:g} s")
    print(f"{what:58}{seconds:>8.2f} s{more}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", default="ep,tube,cvar")
    parser.add_argument("--runs", type=int, default=3)
    asked, _ = parser.parse_known_args([one for one in sys.argv[1:] if one != "vehicle"])
    _, log = hw.vehicle.simulate_drive(duration=180.0, rate=10.0, fix_rate=10.0, outages=((60.0, 120.0),), seed=1)
    hw.vehicle.fill(log)
    drive = sampled(log, sensors=calibrated(log))
    row("a gap of 60 s, a minute on both sides: the chain", took(lambda: chain.solve([drive]), 5))
    row("the same: fill", took(lambda: hw.vehicle.fill(log), asked.runs), 0.5)
    compiled()
    for minutes, promised in ((10, 5.0), (60, 30.0)):
        gaps = tuple((t + 60.0, t + 90.0) for t in range(60, 60 * minutes - 120, 180))
        _, log = hw.vehicle.simulate_drive(duration=60.0 * minutes, rate=10.0, fix_rate=10.0, outages=gaps, seed=2)
        with tempfile.TemporaryDirectory() as folder:
            path, track, report = (str(Path(folder) / name) for name in ("drive.csv", "track.gpx", "report.html"))
            log.frame().to_csv(path, index=False)
            halfwidth, runs = [sys.executable, "-m", "halfwidth"], asked.runs if minutes < 60 else 1
            _, checked, peak = measure([*halfwidth, "check", path], runs)
            row(f"{minutes} minutes at 10 Hz: halfwidth check", checked, peak=peak)
            fill = [*halfwidth, "fill", path, "-o", track, "--report", report, "--force", "-q"]
            _, filled, peak = measure(fill, runs)
            row(f"{minutes} minutes at 10 Hz: halfwidth fill with report", filled, peak=peak)
        row(f"{minutes} minutes at 10 Hz: both", checked + filled, promised)
    _, log = hw.vehicle.simulate_drive(duration=283.0, rate=5.0, fix_rate=5.0, outages=((100.0, 130.0),), seed=3)
    for name in filter(None, asked.method.split(",")):
        row(f"283 s at 5 Hz: fill --method {name}", took(lambda name=name: hw.vehicle.fill(log, method=name), 1))


if __name__ == "__main__":
    main()
