"""What a track promises: its columns, its checks, its gaps."""

import dataclasses

import numpy as np
import pandas
import polars
import pyarrow
import pytest
from tests.vehicle.made_tracks import made_track

from halfwidth.errors import BadShape, BadValue
from halfwidth.vehicle.track import COLUMNS, Gap, gaps_of, runs, since_fix_of, steps_m

CONTRACT = [
    "t_s",
    "lat_deg",
    "lon_deg",
    "alt_m",
    "azimuth_rad",
    "speed_mps",
    "east_half_m",
    "north_half_m",
    "quality",
    "since_fix_s",
]


def test_columns_are_those_of_the_contract():
    assert list(COLUMNS) == CONTRACT


@pytest.mark.parametrize(
    ("native", "kind"),
    [("pandas", pandas.DataFrame), ("polars", polars.DataFrame), ("pyarrow", pyarrow.Table)],
)
def test_frame_comes_back_in_the_library_that_came_in(native, kind):
    track = made_track(native=native)
    frame = track.frame()
    assert isinstance(frame, kind)
    names = frame.column_names if native == "pyarrow" else list(frame.columns)
    assert names == CONTRACT
    assert np.array_equal(np.asarray(frame["lat_deg"]), track.lat_deg)
    assert list(np.asarray(frame["quality"]).tolist()) == track.quality.tolist()


def test_frame_in_another_library_on_request():
    assert isinstance(made_track().frame("polars"), polars.DataFrame)
    with pytest.raises(BadValue, match="one of pandas, polars, pyarrow"):
        made_track().frame("excel")


def test_a_track_cannot_be_changed():
    track = made_track()
    with pytest.raises(dataclasses.FrozenInstanceError):
        track.level = 0.5
    with pytest.raises(ValueError, match="read-only"):
        track.lat_deg[0] = 0
    with pytest.raises(TypeError):
        track.settings["level"] = 1


def test_arrays_are_copied():
    given = np.full(120, 7.0)
    track = made_track(speed_mps=given)
    given[:] = 0
    assert (track.speed_mps == 7).all()


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"lat_deg": np.zeros(3)}, BadShape, r"`lat_deg` has shape \(3,\), \(120,\)"),
        ({"lat_deg": np.full(120, np.nan)}, BadValue, "`lat_deg` is nan in row 0"),
        ({"east_half_m": np.full(120, np.inf)}, BadValue, "`east_half_m` is inf in row 0"),
        ({"north_half_m": np.full(120, -1.0)}, BadValue, "`north_half_m` is -1 m in row 0"),
        ({"speed_mps": np.full(120, np.inf)}, BadValue, "`speed_mps` is inf"),
        ({"quality": np.full(120, "good")}, BadValue, "'good', one of fix, bridged, extrap"),
        ({"quality": np.full(2, "fix")}, BadShape, r"`quality` has shape \(2,\)"),
        ({"t_s": np.zeros(120)}, BadValue, "from 0 s to 0 s in row 1"),
        ({"level": 1.0}, BadValue, "`level` is 1.0, between 0"),
        ({"guarantee": "surely"}, BadValue, "`guarantee` is 'surely'"),
        ({"t_s": np.zeros(0)}, BadShape, "`t_s` is empty"),
    ],
)
def test_impossible_tracks_are_refused_by_name(change, error, words):
    with pytest.raises(error, match=words):
        made_track(**change)


def test_unknown_height_azimuth_and_speed_are_allowed():
    nothing = np.full(120, np.nan)
    track = made_track(height=False, azimuth_rad=nothing, speed_mps=nothing)
    assert np.isnan(track.frame()["alt_m"]).all()


def test_gaps_are_measured_from_fix_to_fix():
    track = made_track()
    assert [gap.quality for gap in track.gaps] == ["bridged", "bridged", "extrapolated"]
    first = track.gaps[0]
    assert first.start == track.t_s[29]
    assert first.stop == track.t_s[45]
    assert first.duration_s == pytest.approx(1.6)
    assert first.distance_m == pytest.approx(16, rel=2e-3)  # 10 m/s
    assert first.max_half_m == pytest.approx(0.4 + 0.3 * 1.5)
    assert track.gaps[-1].stop == track.t_s[-1]


def test_gap_at_the_start_is_extrapolated():
    quality = np.array(["extrapolated"] * 2 + ["fix"] * 2)
    gaps = gaps_of(np.arange(4.0), np.full(4, 50.0), np.full(4, 14.0), np.ones(4), quality)
    assert gaps == (Gap(0.0, 2.0, 2.0, 0.0, 1.0, "extrapolated"),)
    assert gaps_of(np.arange(4.0), np.full(4, 50.0), np.full(4, 14.0), np.ones(4), quality, at_least_s=3) == ()


def test_track_without_any_fix_is_one_gap():
    quality = np.full(3, "extrapolated")
    (gap,) = gaps_of(np.arange(3.0), [50, 50, 50], [14, 14, 14], [1, 2, 1], quality)
    assert (gap.start, gap.stop, gap.max_half_m) == (0, 2, 2)


def test_since_fix_counts_from_the_last_fix_and_is_unknown_before_the_first():
    quality = np.array(["extrapolated", "fix", "bridged", "bridged", "fix", "extrapolated"])
    since = since_fix_of([0, 1, 2, 4, 5, 7], quality)
    assert np.array_equal(since, [np.nan, 0, 1, 3, 0, 2], equal_nan=True)


def test_runs():
    assert runs(np.array([1, 1, 0, 1])) == [(0, 2, 1), (2, 3, 0), (3, 4, 1)]
    assert runs(np.array([])) == []


def test_rows_of_a_gap_include_the_fixes_at_its_ends():
    track = made_track()
    assert track.rows_of(track.gaps[0]) == (29, 46)
    assert track.rows_of(Gap(99.0, 99.5, 0.5, 0.0, 1.0, "bridged")) == (119, 120)


def test_distance_against_a_geodesic():
    pymap3d = pytest.importorskip("pymap3d")
    rng = np.random.default_rng(3)
    lat = rng.uniform(-80, 80, 50)
    lon = rng.uniform(-180, 180, 50)
    for a, o in zip(lat, lon, strict=True):
        b, p = a + rng.uniform(-1e-3, 1e-3), o + rng.uniform(-1e-3, 1e-3)
        chord = np.subtract(pymap3d.geodetic2ecef(a, o, 0), pymap3d.geodetic2ecef(b, p, 0))
        assert steps_m([a, b], [o, p])[0] == pytest.approx(np.linalg.norm(chord), rel=1e-6)


def test_distance_across_the_date_line():
    assert steps_m([0, 0], [179.9999, -179.9999])[0] == pytest.approx(22.26, abs=0.01)
    assert steps_m([0, 0], [359.9999, 0.0001])[0] == pytest.approx(22.26, abs=0.01)


def test_summary_fits_twelve_lines():
    many = tuple((10 * k + 3, 10 * k + 5) for k in range(40))
    text = made_track(400, outages=many).summary()
    assert len(text.splitlines()) <= 12
    assert "33 gaps with smaller half-widths" in text
    assert "not a guarantee" in text
    assert "no gaps" in made_track(outages=()).summary()
    assert repr(made_track()) == made_track().summary()
