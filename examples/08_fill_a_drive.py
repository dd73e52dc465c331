"""Fill a drive: a vehicle's log with tunnels in, a track and a report out."""

import pathlib

import numpy as np

import halfwidth as hw


def main():
    _, log = hw.vehicle.simulate_drive(duration=300.0, seed=3)  # or: log = hw.vehicle.read("drive.csv")
    print(hw.vehicle.check(log).summary().splitlines()[0])

    track = hw.vehicle.fill(log, level=0.9)
    print(track.summary())
    track.write("track.gpx")
    track.write("track.csv")
    track.report("track.html")
    print("wrote", ", ".join(sorted(p.name for p in pathlib.Path().glob("track.*"))))

    result = hw.vehicle.outages(log, lengths=[5, 20], starts=5, seed=1, methods=["linear", "em"])
    print(result.table())
    assert np.isfinite(track.lat_deg).all()


if __name__ == "__main__":
    main()
