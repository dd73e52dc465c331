"""What a log tells of its own sensors: clocks, scale, bias, the antenna, and which fixes are wrong."""

import tempfile
from pathlib import Path

import halfwidth as hw


def main():
    # the speed comes 0.4 s late, the fixes 0.15 s; the odometer counts 1 % too much; reflections after the tunnel
    truth, log = hw.vehicle.simulate_drive(
        duration=300.0,
        seed=4,
        tunnels=[20.0],
        fix_noise=0.05,
        fix_offset=0.1,
        clock_offset=0.15,
        speed_delay=0.4,
        speed_scale=1.01,
        multipath=20.0,
    )
    found = hw.vehicle.calibrated(log)
    for name, clock in found.offsets.items():
        print(f"{name:9} {clock.seconds:+.3f} s, standard deviation {clock.sd:.3f} s")
    print(f"scale     {found.scale:.4f}, bias {found.bias:+.4f} rad/s")
    assert abs(found.offsets["speed"].seconds - (0.15 - 0.4)) < 0.03
    assert abs(found.scale * truth.speed_scale - 1) < 0.005

    report = hw.vehicle.check(log)
    print(report["clock of speed"].sentence)
    print(report["stray fixes"].sentence)
    with tempfile.TemporaryDirectory() as folder:  # a page with the pictures behind each number
        print(f"{report.report(Path(folder) / 'check.html').stat().st_size // 1000} kB of pictures")

    track = hw.vehicle.fill(log)  # applies all of it, and says so
    print("\n".join(track.messages))


if __name__ == "__main__":
    main()
