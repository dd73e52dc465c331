"""Size and time of what goes out: the report and every track format, for tracks of several lengths.

Run ``python benchmarks/outputs.py [ROWS ...]``; times are CPU seconds, the median of five. The track is a simulated
drive with three tunnels whose half-widths grow with the time since the last fix: what is written does not depend on how
it was estimated.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from halfwidth.vehicle.drive import simulate_drive
from halfwidth.vehicle.track import Track, gaps_of, since_fix_of
from halfwidth.vehicle.write import endings


def a_track(rows: int) -> Track:
    truth, log = simulate_drive(duration=(rows - 1) / 10)
    quality = np.where(log.fixed, "fix", "bridged")
    since = since_fix_of(log.t, quality)
    half = 0.5 + 0.1 * since
    lat, lon = truth.lat_deg, truth.lon_deg
    return Track(
        t_s=log.t,
        lat_deg=lat,
        lon_deg=lon,
        alt_m=truth.alt_m,
        azimuth_rad=truth.azimuth_rad,
        speed_mps=truth.speed_mps,
        east_half_m=half,
        north_half_m=0.9 * half,
        quality=quality,
        since_fix_s=since,
        level=0.9,
        method="benchmark",
        log=log,
        gaps=gaps_of(log.t, lat, lon, half, quality),
    )


def cpu_seconds(call, repeats: int = 5) -> float:
    taken = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        taken.append(time.process_time() - start)
    return float(np.median(taken))


def main() -> None:
    lengths = [int(word) for word in sys.argv[1:]] or [6_000, 60_000]
    print(f"{'rows':>8}  {'what':<9}{'seconds':>9}{'kB':>10}{'bytes a row':>13}")
    with tempfile.TemporaryDirectory() as folder:
        for rows in lengths:
            track = a_track(rows)
            outputs = {"report": Path(folder, "a.html"), **{end: Path(folder, f"a{end}") for end in endings()}}
            for name, path in outputs.items():
                taken = cpu_seconds(lambda t=track, p=path, n=name: t.report(p) if n == "report" else t.write(p))
                size = os.path.getsize(path)
                print(f"{rows:>8}  {name:<9}{taken:>9.3f}{size / 1000:>10.1f}{size / rows:>13.1f}")


if __name__ == "__main__":
    main()
