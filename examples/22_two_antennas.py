"""Two antennas, roads and limits: the estimator of GPS and CAN data with hard facts about the drive."""

import json
import pathlib

import numpy as np

import halfwidth as hw


def main():
    # a car with two antennas 1.2 m apart, fixes of centimetres, and one tunnel of 25 s
    truth, log = hw.vehicle.simulate_drive(
        duration=70.0, seed=6, tunnels=[25.0], fix_noise=0.02, fix_offset=0.05, second=(0.0, 1.2)
    )
    line = np.c_[truth.lon_deg, truth.lat_deg][::10].tolist()
    road = {"type": "Feature", "properties": {"width": 3.0}, "geometry": {"type": "LineString", "coordinates": line}}
    pathlib.Path("roads.geojson").write_text(json.dumps(road))
    limits = {"speed": (0.0, 20.0), "acceleration": 4.0, "yaw_rate": 0.8}

    for words, given in (
        ("one antenna", {"method": "paper002"}),
        ("two antennas", {"second": truth.second}),
        ("map and limits", {"roads": "roads.geojson", "limits": limits}),
        ("in 3D", {"method": "paper002-3d"}),
    ):
        track = hw.vehicle.fill(log, **given)
        inside = track.quality == "bridged"
        east, north = truth.error_m(track.t_s[inside], track.lat_deg[inside], track.lon_deg[inside])
        off = np.hypot(east, north)
        print(f"{words:15s}{track.method:12s} mean {off.mean():.2f} m, largest {off.max():.2f} m in the tunnel")
    print(next(message for message in track.messages if "floor" in message))

    # the same on line: the newest state from a window of rows
    car = hw.vehicle.two_antenna(
        hw.Uniform.unknown(at_least=[0.01, 0.01, 0.01, 0.01, 0.001, 0.02, 0.002]),
        hw.Uniform.unknown(at_least=[0.02, 0.02, 0.02, 0.02, 0.01, 0.02, 0.001]),
        x0=hw.Box(-1e6, 1e6),
        baseline=(0.0, 1.2),
        rigid=True,
    )
    live = hw.stream(car, hw.Window(hw.SequentialLP(objective="log", point="optimal"), memory=10))
    # a right-hand bend at 10 m/s; antenna 2 sits to the left, so the line points a quarter to the left of the car
    for k in range(20):
        azimuth, turn = 0.02 * k, -0.1
        place = 100.0 * np.array([1 - np.cos(azimuth), np.sin(azimuth)])
        beside = place + 1.2 * np.array([-np.cos(azimuth), np.sin(azimuth)])
        newest = live.push([*place, *beside, azimuth, 10.0, turn], dt=0.2)
    print("on line:", newest.x[0, :2].round(1), "m, azimuth", newest.x[0, 4].round(2), "rad")


if __name__ == "__main__":
    main()
