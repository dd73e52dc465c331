"""Start-up and whole-process costs: `python benchmarks/startup.py [--runs 7]`.

Prints, as medians over fresh processes, wall time, CPU time and peak memory of the imports, of
`--help`, and of `halfwidth fill` with a report on ten minutes at 10 Hz, beside what is promised.
The interpreter's own start and numpy's import are shown for scale. Also the reader alone, in a
process that is warm: 6,000 and 100,000 rows of CSV. The package is compiled to byte code first, as
an installed one is.
"""

import argparse
import compileall
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def measure(args: list[str], runs: int) -> tuple[float, float, float]:
    """Run a command in fresh processes; median wall s, CPU s and peak MB.

    A small process starts it: the peak that a child inherits from a large parent would hide its own.
    """
    starter = (
        "import os, resource, subprocess, sys, time\n"
        "t = time.perf_counter()\n"
        "subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True)\n"
        "wall = time.perf_counter() - t\n"
        "used = resource.getrusage(resource.RUSAGE_CHILDREN)\n"
        "print(wall, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)\n"
    )
    found = []
    for _ in range(runs):
        out = subprocess.run([sys.executable, "-S", "-c", starter, *args], capture_output=True, text=True, check=True)
        found.append([float(number) for number in out.stdout.split()])
    wall, cpu, peak = (statistics.median(column) for column in zip(*found, strict=True))
    return wall, cpu, peak


def compiled() -> None:
    """Write the byte code of the package, as installing it does."""
    compileall.compile_dir(ROOT / "src" / "halfwidth", quiet=1)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=7)
    runs = parser.parse_args().runs
    python = sys.executable
    compiled()
    with tempfile.TemporaryDirectory() as folder:
        log, track, report = (str(Path(folder) / name) for name in ("drive.csv", "track.gpx", "report.html"))
        subprocess.run([python, "-m", "halfwidth", "demo", "-o", folder, "--force", "-q"], check=True,
                       stdout=subprocess.DEVNULL)  # fmt: skip
        fill = [python, "-m", "halfwidth", "fill", log, "-o", track, "--force", "-q"]
        rows = [
            ("python -c pass", [python, "-c", "pass"], None, None),
            ("import numpy", [python, "-c", "import numpy"], None, None),
            ("import halfwidth", [python, "-c", "import halfwidth"], 0.15, None),
            ("import halfwidth, all names", [python, "-c", "from halfwidth import *"], None, None),
            ("halfwidth --help", [python, "-m", "halfwidth", "--help"], 0.4, None),
            ("halfwidth check, 10 min 10 Hz", [python, "-m", "halfwidth", "check", log], None, None),
            ("halfwidth fill, 10 min 10 Hz", fill, None, None),
            ("the same with a report", [*fill, "--report", report], 3.0, 350.0),
        ]  # fmt: skip
        print(f"{'':32}{'wall s':>8}{'CPU s':>8}{'MB':>8}   promised")
        for name, args, most_s, most_mb in rows:
            wall, cpu, peak = measure(args, runs)
            promised = ", ".join(
                text for text, given in ((f"{most_s} s", most_s), (f"{most_mb} MB", most_mb)) if given is not None
            )
            print(f"{name:32}{wall:8.2f}{cpu:8.2f}{peak:8.0f}   {promised}")
        readers(folder, runs)


def readers(folder: str, runs: int) -> None:
    """Time the reader alone."""
    sys.path.insert(0, str(ROOT))
    from tests.vehicle.drives import drive, save

    import halfwidth as hw

    for n in (6000, 100_000):
        path = save(Path(folder) / f"{n}.csv", drive(n, dt=0.02))
        spent = []
        for _ in range(runs):
            start = time.process_time()
            hw.vehicle.read(path)
            spent.append(time.process_time() - start)
        size = os.path.getsize(path) / 1e6
        print(f"{f'read {n} rows, {size:.1f} MB':32}{'':8}{statistics.median(spent):8.3f}")


if __name__ == "__main__":
    main()
