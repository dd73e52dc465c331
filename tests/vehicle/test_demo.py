"""The demonstration does what it says, on any seed, and its score is the truth's."""

import json
import re
import time

import gpxpy
import numpy as np
import pytest

from halfwidth.errors import BadValue
from halfwidth.vehicle import demo
from halfwidth.vehicle.drive import simulate_drive
from halfwidth.vehicle.formats import read


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    start = time.process_time()
    found = demo.run(tmp_path_factory.mktemp("demo") / "new" / "folder", seed=1)
    return found, time.process_time() - start


def test_demo_is_quick(shown):
    found, cpu = shown
    assert cpu < 15
    assert found.seconds > 0


def test_files_are_there_and_readable(shown):
    found, _ = shown
    assert sorted(path.name for path in found.log.parent.iterdir()) == ["drive.csv", "report.html", "track.gpx"]
    gpx = gpxpy.parse(found.output.read_text())
    assert len(gpx.tracks[0].segments) == 7  # four stretches of fixes around three tunnels
    text = found.report.read_text()
    assert "3 gaps filled" in text
    assert f"halfwidth fill {found.log} -o {found.output}" in re.sub(r"<[^>]+>", "", text)
    assert len(text.encode()) < 1_500_000


def test_log_is_the_simulated_drive(shown):
    found, _ = shown
    _, simulated = simulate_drive(seed=1, fix_offset=0.4, **demo.FAULTS)
    log = read(found.log)
    assert np.array_equal(log.t, simulated.t)
    for name in ("lat_deg", "lon_deg", "speed_mps", "yaw_rate_radps", "azimuth_rad", "ax_mps2"):
        np.testing.assert_allclose(getattr(log, name), getattr(simulated, name), atol=6e-5, equal_nan=True)


def test_score_is_measured_against_the_truth(shown):
    found, _ = shown
    truth, _ = simulate_drive(seed=1, **demo.FAULTS)
    assert [(tunnel.start, tunnel.stop) for tunnel in found.tunnels] == list(truth.outages)
    for tunnel in found.tunnels:
        inside = (found.track.t_s >= tunnel.start) & (found.track.t_s <= tunnel.stop)
        assert (found.track.quality[inside] == "bridged").all()
        east, north = truth.error_m(found.track.t_s[inside], found.track.lat_deg[inside], found.track.lon_deg[inside])
        assert tunnel.max_error_m == pytest.approx(np.hypot(east, north).max())
        assert tunnel.half_m == found.track.half_m[inside].max()
        assert 0 < tunnel.mean_error_m <= tunnel.max_error_m


def test_tunnels_are_filled_far_better_than_by_a_straight_line(shown):
    found, _ = shown
    assert max(tunnel.max_error_m for tunnel in found.tunnels) < 4
    assert max(tunnel.line_error_m for tunnel in found.tunnels) > 20
    # half-widths are about where the receiver would have seen the vehicle, which is 0.5 m off by itself
    assert np.mean([tunnel.inside for tunnel in found.tunnels]) > 0.5


def test_summary_names_files_and_every_tunnel(shown):
    found, _ = shown
    text = found.summary()
    for path in (found.log, found.output, found.report):
        assert str(path) in text
    rows = [line for line in text.splitlines() if re.match(r"\s+\d  ", line)]
    assert len(rows) == 3
    assert "straight line" in text
    assert max(map(len, rows)) <= 100


def test_plain_data_goes_through_json(shown):
    found, _ = shown
    back = json.loads(json.dumps(found.to_dict()))
    assert len(back["tunnels"]) == 3
    assert back["tunnels"][0]["max_error_m"] == found.tunnels[0].max_error_m
    assert back["report"] == str(found.report)


def test_same_seed_same_files(shown, tmp_path):
    again = demo.run(tmp_path, seed=1)
    found = shown[0]
    assert again.output.read_bytes() == found.output.read_bytes()
    assert again.log.read_bytes() == found.log.read_bytes()
    assert again.tunnels == found.tunnels


def test_another_drive(tmp_path):
    found = demo.run(tmp_path, seed=7, duration=150, tunnels=[20])
    (tunnel,) = found.tunnels
    assert tunnel.length_s == pytest.approx(20)
    assert tunnel.max_error_m < tunnel.line_error_m + 2


def test_impossible_tunnels_leave_no_folder(tmp_path):
    with pytest.raises(BadValue, match="tunnels"):
        demo.run(tmp_path / "new", duration=60, tunnels=[100])
    assert not (tmp_path / "new").exists()
