"""The two-antenna estimator: its equations, missing data, wrap, floors, limits, roads, height, and the on-line form."""

import json
from dataclasses import replace

import numpy as np
import pytest

import halfwidth as hw
from halfwidth.vehicle import antennas, models
from halfwidth.vehicle.antennas import TwoAntennas, limits_of, parsed_limits
from halfwidth.vehicle.drive import simulate_drive
from halfwidth.vehicle.estimators import with_limits
from halfwidth.vehicle.fill import fill
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.roads import Roads

CLEAN = {"fix_noise": 0.02, "fix_offset": 0.05, "yaw_bias": 1e-3, "yaw_drift": 1e-5}


@pytest.fixture(scope="module")
def drive():
    return simulate_drive(duration=60, seed=4, tunnels=[12], second=(0.0, 1.2), **CLEAN)


def off(grid, path, truth):
    """Return the distance to the truth inside the first outage, m."""
    east, north = grid.frame.to_local(*truth.at(grid.t))
    a, b = truth.outages[0]
    inside = (grid.t >= a) & (grid.t <= b)
    return np.hypot(path.east - east, path.north - north)[inside]


def turning(T=40, h=0.2, start=3.0, rate=-0.5):
    """A car with two antennas that turns right through azimuth pi, and its record without noise."""
    car = models.two_antenna(
        hw.Uniform.unknown(at_least=0.01), hw.Uniform.unknown(at_least=0.01), x0=hw.Box(-1e6, 1e6), baseline=(1.0, 0.0)
    )
    x = np.array([0.0, 0, np.sin(start), np.cos(start), start, 8.0, rate])
    rows = []
    for _ in range(T):
        x = car.move(x, None, h)
        x[2:4] = x[:2] + [np.sin(x[4]), np.cos(x[4])]
        rows.append(car.output(x))
    y = np.array(rows)
    y[:, 4] = np.angle(np.exp(1j * y[:, 4]))
    return car, hw.Record(h * np.arange(T), y), np.array(rows)


def test_the_equations_are_those_of_the_slides():
    car = models.two_antenna(np.full(7, 0.1), np.full(7, 0.1), x0=hw.Box(-1, 1), baseline=(0, -1.2), euler=True)
    x, h = np.array([1.0, 2, 3, 4, 0.3, 10, 0.2]), 0.1
    east, north = h * 10 * np.sin(0.3), h * 10 * np.cos(0.3)
    np.testing.assert_allclose(car.move(x, None, h), [1 + east, 2 + north, 3 + east, 4 + north, 0.3 - h * 0.2, 10, 0.2])
    # antenna 2 lies to the right: the line points a quarter to the right of the car
    np.testing.assert_allclose(car.output(x), [1, 2, 3, 4, np.arctan2(2, 2) - np.pi / 2, 10, 0.2])


def test_a_rigid_line_turns_with_the_car():
    car = models.two_antenna(np.full(7, 0.1), np.full(7, 0.1), x0=hw.Box(-1, 1), baseline=(2.0, 0.0), rigid=True)
    x = car.move(np.array([0, 0, 0, 2, 0, 5, -np.pi / 2]), None, 1.0)  # a quarter turn to the right
    np.testing.assert_allclose(x[2:4] - x[:2], [2, 0], atol=1e-12)
    assert car.output(x)[4] == pytest.approx(x[4])


def test_height_and_acceleration_extend_them():
    car = models.two_antenna(
        np.full(8, 0.1), np.full(6, 0.1), x0=hw.Box(-1, 1), antennas=1, height=True, acceleration=True
    )
    x, h = np.array([0.0, 0, 0, 10, 0, 200, 0.1, 2]), 0.5
    way = 5
    np.testing.assert_allclose(car.move(x, None, h), [0, way * np.cos(0.1), 0, 11, 0, 200 + way * np.sin(0.1), 0.1, 2])
    assert car.names.y == ("east", "north", "azimuth", "speed", "yaw_rate", "altitude")


def test_an_azimuth_that_wraps_is_no_residual():
    car, record, _ = turning()
    assert np.abs(np.diff(record.y[:, 4])).max() > 5  # it wraps within the record
    est = hw.estimate(car, record, hw.SequentialLP(objective="log", start=np.vstack([
        [0, 0, np.sin(3.0), np.cos(3.0), 3.0, 8, -0.5], np.c_[record.y[:, :4], np.unwrap(record.y[:, 4]), record.y[:, 5:]]
    ]))).check()  # fmt: skip
    assert np.nanmax(np.abs(est.info["e"][:, 4])) < 0.2
    assert est.r[4] < 0.2


def test_a_clean_gap_is_bridged_to_centimetres_and_floors_are_named(drive):
    truth, log = drive
    for second in (None, truth.second):
        grid = sampled(log, second=second)
        (path,) = antennas.solve([grid])
        assert path.status.good
        assert off(grid, path, truth).max() < 0.6
        assert path.info["on_floor"]
        assert any("on their floor" in note for note in path.info["notes"])
        for name, value in {**path.info["q"], **path.info["r"]}.items():
            kind = name.rstrip("12")
            floors = (antennas.STATE_FLOORS, antennas.OUTPUT_FLOORS)
            assert value >= 0.999 * min(one[kind] for one in floors if kind in one)
    assert path.info["second"].shape == (len(grid), 2)


def test_quantisation_raises_the_floor(drive):
    grid = replace(sampled(drive[1]), steps={"speed_mps": 0.5})
    model, *_ = antennas.problem(grid, TwoAntennas())
    assert model.e.at_least[model.names.y.index("speed")] == 0.25


def test_missing_sensor_rows_are_missing_inequalities(drive):
    truth, log = drive
    grid = sampled(log)
    a = truth.outages[0][0]
    silent = (grid.t > a + 4) & (grid.t < a + 5)
    holed = replace(grid, speed=np.where(silent, 1e3, grid.speed), speed_sd=np.where(silent, 1.0, 0.0))
    model, _, start, _ = antennas.problem(grid, TwoAntennas())
    _, part, _, _ = antennas.problem(holed, TwoAntennas())
    k = model.names.y.index("speed")
    assert np.isnan(part.y[:, k]).sum() == silent.sum()
    est = hw.SequentialLP(objective="log", point="optimal", start=start).run(model, part).check()
    assert np.abs(est.x[:, k] - grid.speed).max() < 3


def test_limits_are_kept(drive):
    truth, log = drive
    grid = sampled(log)
    limits = {"speed": (0.0, 12.0), "acceleration": (-2.5, 2.0), "yaw_rate": (-0.3, 0.3)}
    settings = TwoAntennas(limits=limits)
    part = grid.between(truth.outages[0][0] - 10, truth.outages[0][1] + 10)
    found = antennas.window(part, settings)
    assert found.estimate.status.good
    for name, (lo, hi) in limits.items():
        x = found.estimate.x[:, found.names.index(name)]
        assert x.min() >= lo - 1e-6
        assert x.max() <= hi + 1e-6
    assert np.abs(np.diff(found.estimate.x[:, 3])).max() <= 2.5 * grid.h.max() + 0.03


def test_limits_as_typed():
    assert parsed_limits("speed=0:30, acceleration=4") == {"speed": (0.0, 30.0), "acceleration": (-4.0, 4.0)}
    for bad in ("speed", "speed=a", "speed=1:2:3", "altitude=5:5", "weight=3", "speed=nan"):
        with pytest.raises(hw.BadValue):
            parsed_limits(bad)
    with pytest.raises(hw.BadValue):
        limits_of({"speed": "fast"})


def test_a_road_holds_the_track_in_a_gap():
    truth, log = simulate_drive(duration=80, seed=4, tunnels=[30], **CLEAN)
    line = {"type": "LineString", "coordinates": np.c_[truth.lon_deg, truth.lat_deg][::10].tolist()}
    grid = sampled(log)
    wrong = 0.02 * np.sin(2 * np.pi * (grid.t - truth.outages[0][0]) / 30)
    grid = replace(grid, yaw_rate=grid.yaw_rate + np.where(grid.seen, 0.0, wrong))
    roads = Roads.of({"type": "Feature", "geometry": line, "properties": {"width": 2}})
    (free,) = antennas.solve([grid])
    (held,) = antennas.solve([grid], TwoAntennas(roads=roads.local(grid.frame)))
    near = roads.local(grid.frame).nearest(held.east, held.north, held.azimuth)
    a, b = truth.outages[0]
    inside = (grid.t > a) & (grid.t < b) & ~grid.seen
    assert roads.local(grid.frame).nearest(free.east, free.north).distance[inside].max() > 1.1
    assert near.distance[inside].max() < 1.02
    assert off(grid, held, truth).mean() < off(grid, free, truth).mean()


def test_a_map_without_this_road_is_left_aside(drive):
    truth, log = drive
    lon, lat = float(truth.lon_deg[0]) + 0.02, float(truth.lat_deg[0])
    roads = Roads.of({"type": "LineString", "coordinates": [[lon, lat], [lon, lat + 0.01]]})
    grid = sampled(log)
    (free,) = antennas.solve([grid])
    (same,) = antennas.solve([grid], TwoAntennas(roads=roads.local(grid.frame)))
    np.testing.assert_allclose(same.east, free.east, atol=0.02)
    assert any("not kept on the map" in note for note in same.info["notes"])


def test_the_nearest_road_is_the_one_driven_along():
    streets = Roads.of({"type": "MultiLineString", "coordinates": [[[14, 50], [14.01, 50]], [[14.005, 49.99], [14.005, 50.01]]]}).local(
        hw.vehicle.Frame(50.0, 14.005)
    )  # fmt: skip
    near = streets.nearest([3.0, 3.0], [2.0, 2.0], [np.pi / 2, 0.0])
    np.testing.assert_allclose(near.distance, [2, 3], atol=0.02)
    np.testing.assert_allclose(
        near.offset, [-2 / 5, 3 / 5], atol=0.01
    )  # left of the one to the east, right of the other
    for d in ([1e-3, 0], [0, 1e-3]):
        moved = streets.nearest(3.0 + d[0], 2.0 + d[1], [0.0]).offset - streets.nearest(3.0, 2.0, [0.0]).offset
        assert moved[0] == pytest.approx(near.slope[1] @ d, abs=1e-9)


@pytest.mark.parametrize("bad", [
    {"type": "Point", "coordinates": [14, 50]}, {"type": "LineString", "coordinates": [[14, 50]]}, [], None,
    {"type": "LineString", "coordinates": [[50, 14, 1], ["a", 2]]}, {"type": "LineString", "coordinates": [[14, 95], [14, 96]]},
    {"type": "Feature", "properties": {"width": -1}, "geometry": {"type": "LineString", "coordinates": [[14, 50], [14, 51]]}},
])  # fmt: skip
def test_a_bad_map_is_named(bad):
    with pytest.raises(hw.BadValue):
        Roads.of(bad)


def test_altitude_and_pitch_come_out(drive):
    truth, log = drive
    grid = sampled(log)
    (path,) = antennas.solve([grid], TwoAntennas(height=True))
    assert path.status.good
    true = np.interp(grid.t, truth.t, truth.alt_m)
    assert np.abs(path.info["altitude"] - true).mean() < 1.5
    assert np.abs(path.info["pitch"]).max() < 0.5
    (flat,) = antennas.solve([sampled(log.__class__(t=log.t, lat_deg=log.lat_deg, lon_deg=log.lon_deg, speed_mps=log.speed_mps,
                                                    yaw_rate_radps=log.yaw_rate_radps))], TwoAntennas(height=True))  # fmt: skip
    assert flat.status is hw.Status.STALLED


def test_the_window_form_ends_where_the_batch_ends():
    car, record, truth = turning(T=30)
    rng = np.random.default_rng(0)
    noisy = hw.Record(record.t, record.y + rng.uniform(-0.02, 0.02, record.y.shape))
    start = np.vstack([noisy.y[0], noisy.y])
    start[:, 4] = np.unwrap(start[:, 4])
    whole = hw.estimate(car, noisy, hw.SequentialLP(objective="log", point="optimal", start=start))
    window = hw.Window(hw.SequentialLP(objective="log", point="optimal"), memory=len(noisy) - 1, fixes=0)
    online = hw.estimate(car, noisy, window)
    assert online.status.good
    assert np.abs(online.x[-1] - whole.x[-1])[:4].max() < 0.1
    stream = hw.stream(car, hw.Window(hw.SequentialLP(objective="log", point="optimal"), memory=12), t=-0.2)
    for row in noisy.y:
        newest = stream.push(row, dt=0.2)
    assert np.abs(newest.x - truth[-1])[:4].max() < 0.3


def test_scales_and_degenerate_drives(drive):
    grid = sampled(drive[1])
    nothing = grid.masked(np.arange(len(grid)) > 3)
    (path,) = antennas.solve([nothing])
    assert path.finite
    one = grid.rows(slice(0, 2))
    (path,) = antennas.solve([one])
    assert path.finite
    still = grid.__class__(**{**vars(grid), "speed": 0 * grid.speed, "east": 0 * grid.east, "north": 0 * grid.north})
    (path,) = antennas.solve([still])
    assert path.finite
    assert np.abs(path.east).max() < 0.1
    far = grid.__class__(**{**vars(grid), "east": grid.east + 1e7})
    (there,), (here,) = antennas.solve([far]), antennas.solve([grid])
    np.testing.assert_allclose(there.east - 1e7, here.east, atol=0.05)


def test_fill_takes_them_all(tmp_path, drive):
    truth, log = drive
    line = {"type": "LineString", "coordinates": np.c_[truth.lon_deg, truth.lat_deg][::10].tolist()}
    (tmp_path / "roads.geojson").write_text(json.dumps(line))
    track = fill(log, roads=tmp_path / "roads.geojson", limits={"speed": (0, 25)}, second=truth.second)
    assert track.method == "paper002"
    east, north = truth.error_m(track.t_s, track.lat_deg, track.lon_deg)
    assert np.hypot(east, north).max() < 1.0
    assert any("on their floor" in message for message in track.messages)
    with pytest.raises(hw.BadValue, match="two-antenna"):
        fill(log, method="em", limits={"speed": 20})
    with pytest.raises(hw.BadValue, match="`paper002` does not estimate"):
        fill(log, method="paper002", limits={"altitude": (0, 500)})
    assert with_limits(None, {"altitude": (0, 500)}, None).name == "paper002-3d"
    with pytest.raises(hw.BadValue, match="map"):
        fill(log, roads=tmp_path / "none.geojson")


def test_a_step_of_latitude_and_longitude_is_the_floor_of_a_fix(drive):
    grid = sampled(drive[1])
    coarse = replace(grid, steps={**grid.steps, "lat_deg": 1e-6, "lon_deg": 2e-6})
    for given, lo in ((grid, 0.01), (coarse, 0.05)):
        model = antennas.problem(given.between(20, 50), TwoAntennas())[0]
        floor = dict(zip(model.names.y, model.e.at_least, strict=True))
        assert floor["north"] >= lo
    assert floor["north"] == pytest.approx(0.5e-6 * 111_200, rel=0.01)
    assert floor["east"] == pytest.approx(1e-6 * 111_300 * np.cos(np.radians(grid.frame.lat_deg)), rel=0.01)
