"""Print how well `fill` finds clocks, scale and bias on simulated drives, and how far off it then fills gaps.

    python benchmarks/calibration.py [--seeds 50] [--duration 600] [--fix-noise 0.02] [--fix-offset 0.02]

Every drive has an offset of 0.15 s between fixes and sensors, a speed scale of 1 %, a yaw bias of 0.003 rad/s, a gap of
30 s and one of 60 s. The truth is known, so errors are against it: of the offset of each stream, of scale and bias
(each beside the standard deviation that was stated), and of the track in the gaps, mean / mean of maxima in metres.
"""

import argparse
import time
from dataclasses import replace

import numpy as np

from halfwidth.vehicle import fill, simulate_drive
from halfwidth.vehicle.align import calibrated

OFFSET, SCALE, BIAS, GAPS = 0.15, 1.01, 0.003, (30.0, 60.0)


def drive(seed, asked):
    """Simulate one drive: a bias of known size, on top of the drift."""
    truth, log = simulate_drive(
        duration=asked.duration,
        seed=seed,
        tunnels=GAPS,
        fix_noise=asked.fix_noise,
        fix_offset=asked.fix_offset,
        clock_offset=OFFSET,
        speed_scale=SCALE,
        yaw_bias=0.0,
    )
    return truth, replace(log, yaw_rate_radps=log.yaw_rate_radps + BIAS)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--duration", type=float, default=600.0)
    parser.add_argument("--fix-noise", type=float, default=0.02)
    parser.add_argument("--fix-offset", type=float, default=0.02)
    parser.add_argument("--no-gaps", action="store_true", help="calibrate only")
    asked = parser.parse_args()
    names = ("speed clock s", "yaw rate clock s", "speed scale", "yaw bias rad/s")
    errors, stated, gaps, seconds = [], [], {length: [] for length in GAPS}, []
    for seed in range(1, asked.seeds + 1):
        truth, log = drive(seed, asked)
        clock = time.process_time()
        found = calibrated(log)
        seconds.append(time.process_time() - clock)
        speed, yaw = found.offsets["speed"], found.offsets["yaw_rate"]
        bias = BIAS + float(truth.yaw_bias_radps.mean())
        errors.append((speed.seconds - OFFSET, yaw.seconds - OFFSET, found.scale * SCALE - 1, found.bias - bias))
        stated.append((speed.sd, yaw.sd, found.scale_sd, found.bias_sd))
        if asked.no_gaps:
            continue
        track = fill(log)
        for first, last in truth.outages:
            inside = (track.t_s >= first) & (track.t_s <= last)
            at = track.t_s[inside] - OFFSET  # the track is on the clock of the fixes
            off = np.hypot(*truth.error_m(at, track.lat_deg[inside], track.lon_deg[inside]))
            gaps[min(GAPS, key=lambda length: abs(length - (last - first)))].append((off.mean(), off.max()))
    error, sd = np.abs(errors), np.array(stated)
    print(f"{asked.seeds} drives of {asked.duration:g} s, {np.median(seconds):.2f} s of CPU each to calibrate")
    print(f"{'':20}{'rms error':>12}{'largest':>12}{'stated sd':>12}")
    for k, name in enumerate(names):
        rms = np.sqrt(np.mean(error[:, k] ** 2))
        print(f"{name:20}{rms:>12.5f}{error[:, k].max():>12.5f}{np.median(sd[:, k]):>12.5f}")
    for length, found in gaps.items():
        if found:
            mean, most = np.array(found).T
            print(f"gap of {length:g} s: {mean.mean():.3f} / {most.mean():.3f} m, worst {most.max():.2f} m")


if __name__ == "__main__":
    main()
