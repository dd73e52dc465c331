import sys

import numpy as np
import pytest

from halfwidth.errors import BadLog, BadShape, Missing
from halfwidth.vehicle.frames import Frame, mat_nb, wrapped
from halfwidth.vehicle.log import Log


@pytest.mark.parametrize("lat", [-70.0, 0.0, 50.0, 85.0])
@pytest.mark.parametrize("alt", [0.0, 800.0])
def test_there_and_back(lat, alt):
    frame = Frame(lat, 14.0, alt)
    east, north = np.random.default_rng(1).uniform(-1e5, 1e5, (2, 200))
    back = frame.to_local(*frame.to_geodetic(east, north))
    np.testing.assert_allclose(back, (east, north), atol=1e-3)
    near = frame.to_local(*frame.to_geodetic(east / 100, north / 100))
    np.testing.assert_allclose(near, (east / 100, north / 100), atol=1e-6)


def test_distances_agree_with_the_ellipsoid():
    pymap3d = pytest.importorskip("pymap3d.vincenty")
    frame = Frame(50.0, 14.0)
    lat, lon = frame.to_geodetic([300.0], [-400.0])
    distance, azimuth = pymap3d.vdist(50.0, 14.0, lat[0], lon[0])
    assert distance == pytest.approx(500.0, abs=1e-3)
    assert np.radians(azimuth) == pytest.approx(np.mod(np.arctan2(300.0, -400.0), 2 * np.pi), abs=1e-4)


def test_the_origin_is_the_middle_even_across_the_date_line():
    log = Log(t=[0.0, 1.0, 2.0], lat_deg=[10.0, np.nan, 10.2], lon_deg=[179.9, np.nan, -179.7])
    frame = Frame.of(log)
    assert frame.lat_deg == pytest.approx(10.1)
    assert frame.lon_deg == pytest.approx(-179.9)
    east, _ = frame.to_local(log.lat_deg, log.lon_deg)
    assert np.isnan(east[1])
    assert np.ptp(east[[0, 2]]) < 1e5


def test_a_log_without_fixes_has_no_frame():
    with pytest.raises(BadLog, match="no fix"):
        Frame.of(Log(t=[0.0, 1.0]))


def test_shapes_must_agree():
    with pytest.raises(BadShape, match="lat_deg"):
        Frame(0.0, 0.0).to_local([1.0, 2.0], [1.0])


def test_body_axes():
    a = np.linspace(-4, 4, 9)
    R = mat_nb(a, 0.1, -0.2)
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(mat_nb(0.3) @ [1, 0, 0], [np.sin(0.3), np.cos(0.3), 0], atol=1e-15)
    np.testing.assert_allclose(mat_nb(0.0) @ [0, 1, 0], [-1, 0, 0], atol=1e-15)  # heading north, left is west
    assert (mat_nb(1.0, pitch=0.1) @ [1, 0, 0])[2] > 0  # nose up
    assert (mat_nb(1.0, roll=0.1) @ [0, 1, 0])[2] > 0  # left side up


def test_angles_are_wrapped_to_a_half_open_turn():
    np.testing.assert_allclose(wrapped([np.pi, -np.pi, 3 * np.pi, 0.5, 7.0]), [np.pi, np.pi, np.pi, 0.5, 7 - 2 * np.pi])


def test_without_pymap3d_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymap3d", None)
    with pytest.raises(Missing, match="pip install"):
        Frame(0.0, 0.0).to_local([1.0], [1.0])
