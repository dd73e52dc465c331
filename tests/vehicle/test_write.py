"""Track files, read back by readers that are not ours."""

import gzip
import io
import json
import re
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import gpxpy
import numpy as np
import pandas
import pyarrow.parquet
import pytest
from lxml import etree
from tests.vehicle.made_tracks import made_track

from halfwidth.errors import BadValue, Missing
from halfwidth.vehicle import write as module
from halfwidth.vehicle.maps import absolute, stamps
from halfwidth.vehicle.write import ending, endings

EPOCH = datetime(2024, 5, 1, 8, 0, 0, tzinfo=UTC)
GPX = "{http://www.topografix.com/GPX/1/1}"
HW = "{urn:halfwidth:track:1}"
KML = "{http://www.opengis.net/kml/2.2}"
GX = "{http://www.google.com/kml/ext/2.2}"
#: Not one of these may come out as markup.
NASTY = "a/<&>\"' ]]> </name></gpx> \x00\x0b\ud83d.csv".encode("utf-8", "replace").decode()


def parts(track) -> list[tuple[str, int]]:
    cuts = np.flatnonzero(track.quality[1:] != track.quality[:-1]) + 1
    return [(str(part[0]), part.size) for part in np.split(track.quality, cuts)]


# --- which format ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "known"),
    [
        ("a.csv", ".csv"),
        ("a.CSV", ".csv"),
        ("a.csv.gz", ".csv.gz"),
        ("b.x/a.gpx", ".gpx"),
        ("a.parquet", ".parquet"),
        ("a.geojson", ".geojson"),
        ("a.kml", ".kml"),
        ("-", ".csv"),
    ],
)
def test_ending_names_the_format(path, known):
    assert ending(path) == known


@pytest.mark.parametrize("path", ["track", "track.gz", "track.doc", "csv", "track.gpx.bak"])
def test_unknown_ending_lists_the_known_ones(path, tmp_path):
    with pytest.raises(BadValue) as caught:
        made_track().write(tmp_path / path)
    for known in endings():
        assert known in str(caught.value)
    assert "hint:" in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_format_overrules_the_ending(tmp_path):
    made_track().write(tmp_path / "a.txt", format="gpx")
    assert (tmp_path / "a.txt").read_bytes().startswith(b"<?xml")
    with pytest.raises(BadValue, match="`format` is 'docx'"):
        made_track().write(tmp_path / "a", format="docx")


def test_dash_writes_to_standard_output(capfdbinary):
    made_track().write("-")
    assert capfdbinary.readouterr().out.startswith(b"t_s,lat_deg,lon_deg")


@pytest.mark.parametrize("name", endings())
def test_same_track_same_bytes_and_old_file_kept_on_failure(tmp_path, monkeypatch, name):
    path = tmp_path / f"a{name}"
    track = made_track()
    assert track.write(path) == path
    first = path.read_bytes()
    made_track().write(path)
    assert path.read_bytes() == first

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("halfwidth.store.os.fsync", fail)
    with pytest.raises(OSError, match="No space"):
        made_track(60).write(path)
    assert path.read_bytes() == first
    assert len(list(tmp_path.iterdir())) == 1


# --- tables ---------------------------------------------------------------------------------------


def same_as_frame(table: pandas.DataFrame, track) -> None:
    assert list(table.columns) == list(track.frame().columns)
    assert np.array_equal(table["t_s"], track.t_s)
    assert table["quality"].tolist() == track.quality.tolist()
    for name, tolerance in [("lat_deg", 6e-10), ("lon_deg", 6e-10), ("azimuth_rad", 6e-7)]:
        assert np.abs(table[name] - getattr(track, name)).max() <= tolerance
    for name in ("alt_m", "speed_mps", "east_half_m", "north_half_m", "since_fix_s"):
        np.testing.assert_allclose(table[name], getattr(track, name), atol=6e-4)


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz", "a.parquet"])
def test_tables_read_back(tmp_path, name):
    track = made_track(height=False)
    track.write(tmp_path / name)
    read = pandas.read_parquet if name.endswith("parquet") else pandas.read_csv
    same_as_frame(read(tmp_path / name), track)


def test_csv_cells_are_empty_where_unknown_and_times_exact(tmp_path):
    t = np.cumsum(np.full(120, 0.1)) + 1.7e9
    track = made_track(height=False, t_s=t)
    track.write(tmp_path / "a.csv")
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert len(lines) == 121
    assert lines[1].split(",")[3] == ""
    assert [float(line.split(",")[0]) for line in lines[1:]] == t.tolist()
    assert "nan" not in "".join(lines)


def test_gzip_holds_the_csv(tmp_path):
    made_track().write(tmp_path / "a.csv")
    made_track().write(tmp_path / "a.csv.gz")
    assert gzip.decompress((tmp_path / "a.csv.gz").read_bytes()) == (tmp_path / "a.csv").read_bytes()


def test_parquet_says_how_it_was_made_and_unknown_is_null(tmp_path):
    made_track(height=False).write(tmp_path / "a.parquet")
    table = pyarrow.parquet.read_table(tmp_path / "a.parquet")
    about = table.schema.metadata
    assert about[b"halfwidth.method"] == b"em_chain"
    assert about[b"halfwidth.level"] == b"0.9"
    assert about[b"halfwidth.guarantee"] == b"credible"
    assert table["alt_m"].null_count == 120


def test_parquet_without_pyarrow_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(Missing, match=r"pip install 'halfwidth\[formats\]'"):
        made_track().write(tmp_path / "a.parquet")
    assert list(tmp_path.iterdir()) == []


# --- GPX ------------------------------------------------------------------------------------------

#: Order of a point's children in the GPX 1.1 schema.
POINT = [
    "ele",
    "time",
    "magvar",
    "geoidheight",
    "name",
    "cmt",
    "desc",
    "src",
    "link",
    "sym",
    "type",
    "fix",
    "sat",
    "hdop",
    "vdop",
    "pdop",
    "ageofdgpsdata",
    "dgpsid",
    "extensions",
]
TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d+Z")


def check_gpx(content: bytes) -> etree._Element:
    """Hold a file against the rules of the GPX 1.1 schema for what we write."""
    root = etree.fromstring(content, etree.XMLParser(resolve_entities=False))
    assert root.tag == f"{GPX}gpx"
    assert root.get("version") == "1.1"
    assert root.get("creator")
    order = {"gpx": ["metadata", "wpt", "rte", "trk", "extensions"]}
    order["metadata"] = [
        "name",
        "desc",
        "author",
        "copyright",
        "link",
        "time",
        "keywords",
        "bounds",
        "extensions",
    ]
    order["trk"] = ["name", "cmt", "desc", "src", "link", "number", "type", "extensions", "trkseg"]
    order["trkseg"] = ["trkpt", "extensions"]
    order["trkpt"] = POINT
    for element in root.iter():
        name = etree.QName(element).localname
        if name not in order:
            continue
        places = [order[name].index(etree.QName(child).localname) for child in element]
        assert places == sorted(places), f"children of {name} out of order"
        once = [p for p in places if order[name][p] not in ("trkpt", "trkseg", "trk")]
        assert len(once) == len(set(once))
    for point in root.iter(f"{GPX}trkpt"):
        assert -90 <= float(point.get("lat")) <= 90
        assert -180 <= float(point.get("lon")) < 180
        assert point.find(f"{GPX}fix").text in ("none", "2d", "3d", "dgps", "pps")
        assert TIME.fullmatch(point.find(f"{GPX}time").text)
        for extension in point.find(f"{GPX}extensions"):
            assert etree.QName(extension).namespace not in (None, GPX[1:-1])
    return root


def gpx_of(track, tmp_path, **how) -> tuple[bytes, gpxpy.gpx.GPX]:
    track.write(tmp_path / "a.gpx", **how)
    content = (tmp_path / "a.gpx").read_bytes()
    check_gpx(content)
    return content, gpxpy.parse(content.decode())


def test_gpx_has_one_segment_for_each_run_of_quality(tmp_path):
    track = made_track(epoch_s=EPOCH.timestamp())
    content, gpx = gpx_of(track, tmp_path)
    (drive,) = gpx.tracks
    assert [len(segment.points) for segment in drive.segments] == [n for _, n in parts(track)]
    said = [q.text for q in etree.fromstring(content).iter(f"{HW}quality")]
    assert said == [quality for quality, _ in parts(track)]
    points = [point for segment in drive.segments for point in segment.points]
    assert len(points) == len(track)
    for k in (0, 31, 60, 119):
        assert points[k].latitude == pytest.approx(track.lat_deg[k], abs=1e-9)
        assert points[k].longitude == pytest.approx(track.lon_deg[k], abs=1e-9)
        assert points[k].elevation == pytest.approx(track.alt_m[k], abs=1e-3)
        assert points[k].time == EPOCH + timedelta(seconds=track.t_s[k])
        assert points[k].type_of_gpx_fix == ("3d" if track.quality[k] == "fix" else "none")
        east = next(e for e in points[k].extensions if e.tag == f"{HW}east_half_m")
        assert float(east.text) == pytest.approx(track.east_half_m[k], abs=1e-3)


def test_gpx_without_height_is_two_dimensional(tmp_path):
    _, gpx = gpx_of(made_track(height=False), tmp_path)
    point = gpx.tracks[0].segments[0].points[0]
    assert point.elevation is None
    assert point.type_of_gpx_fix == "2d"


@pytest.mark.parametrize("name", ["a.gpx", "a.kml", "a.geojson"])
def test_relative_time_counts_from_1970_and_the_file_says_so(tmp_path, name):
    made_track().write(tmp_path / name)
    text = (tmp_path / name).read_text()
    assert "1970-01-01T00:00:03.000Z" in text
    assert "times count from 1970-01-01T00:00:00Z" in text
    made_track(epoch_s=EPOCH.timestamp()).write(tmp_path / name)
    assert "1970" not in (tmp_path / name).read_text()


@pytest.mark.parametrize(
    "start",
    [
        "2024-05-01T08:00:00Z",
        "2024-05-01T10:00:00+02:00",
        "2024-05-01 08:00",
        EPOCH,
        EPOCH.replace(tzinfo=None),
        EPOCH.timestamp(),
        int(EPOCH.timestamp()),
    ],
)
def test_start_gives_the_absolute_time(start, tmp_path):
    _, gpx = gpx_of(made_track(epoch_s=5.0), tmp_path, start=start)
    assert gpx.tracks[0].segments[0].points[0].time == EPOCH


@pytest.mark.parametrize("start", ["noon", float("nan"), 1e15])
def test_impossible_start_is_refused(start, tmp_path):
    with pytest.raises(BadValue, match="`start`"):
        made_track().write(tmp_path / "a.gpx", start=start)
    assert list(tmp_path.iterdir()) == []


def test_unix_times_need_no_start(tmp_path):
    track = made_track(t_s=EPOCH.timestamp() + np.arange(120) / 10)
    _, note = absolute(track)
    assert note is None
    _, gpx = gpx_of(track, tmp_path)
    assert gpx.tracks[0].segments[-1].points[-1].time == EPOCH + timedelta(seconds=11.9)


def test_time_stamps_are_distinct_and_exact():
    assert stamps(np.array([0.0, 0.5])) == ["1970-01-01T00:00:00.000Z", "1970-01-01T00:00:00.500Z"]
    assert stamps(np.array([0.0, 2e-4]))[1] == "1970-01-01T00:00:00.000200Z"
    assert stamps(np.array([-0.5]))[0] == "1969-12-31T23:59:59.500Z"
    assert stamps(np.array([2e11]))[0].startswith("8307-")


@pytest.mark.parametrize("lon", [179.9995, -180.0, 359.99, 200.0])
@pytest.mark.parametrize("name", ["a.gpx", "a.kml", "a.geojson"])
def test_longitudes_stay_in_range_across_the_date_line(tmp_path, lon, name):
    track = made_track(lon=lon)
    track.write(tmp_path / name)
    content = (tmp_path / name).read_bytes()
    if name == "a.gpx":
        check_gpx(content)
        found = [p.longitude for s in gpxpy.parse(content.decode()).tracks[0].segments for p in s.points]
    elif name == "a.kml":
        found = [float(c.text.split()[0]) for c in etree.fromstring(content).iter(f"{GX}coord")]
    else:
        found = [
            p[0] for feature in json.loads(content)["features"] for line in lines_of(feature["geometry"]) for p in line
        ]
    assert min(found) >= -180
    assert max(found) <= 180
    wrapped = np.mod(track.lon_deg + 180, 360)
    assert np.mod(found[0] + 180, 360) == pytest.approx(wrapped[0], abs=1e-8)


@pytest.mark.parametrize("name", ["a.gpx", "a.kml", "a.geojson", "a.csv", "a.parquet"])
def test_hostile_source_names_are_inert(tmp_path, name):
    made_track(source=NASTY).write(tmp_path / name)
    content = (tmp_path / name).read_bytes()
    if name == "a.geojson":
        assert json.loads(content)["name"] == NASTY.split("/")[-1] or json.loads(content)["name"]
        return
    if name.endswith(("gpx", "kml")):
        root = etree.fromstring(content)
        names = [e.text for e in root.iter() if etree.QName(e).localname == "name"]
        assert any("</gpx>" in text or "gpx>" in text for text in names)


# --- GeoJSON --------------------------------------------------------------------------------------


def lines_of(geometry: dict) -> list:
    kind, where = geometry["type"], geometry["coordinates"]
    return {"Point": [[where]], "LineString": [where], "MultiLineString": where}[kind]


def check_geojson(content: bytes) -> dict:
    """Hold a file against RFC 7946."""
    collection = json.loads(content, parse_constant=pytest.fail)
    assert collection["type"] == "FeatureCollection"
    assert "crs" not in collection
    for feature in collection["features"]:
        assert feature["type"] == "Feature"
        assert set(feature) >= {"geometry", "properties"}
        for line in lines_of(feature["geometry"]):
            if feature["geometry"]["type"] != "Point":
                assert len(line) >= 2
            for lon, lat, *height in line:
                assert -180 <= lon <= 180
                assert -90 <= lat <= 90
                assert len(height) <= 1
    return collection


def test_geojson_parts_and_gaps(tmp_path):
    track = made_track(epoch_s=EPOCH.timestamp())
    track.write(tmp_path / "a.geojson")
    collection = check_geojson((tmp_path / "a.geojson").read_bytes())
    pieces = [f["properties"] for f in collection["features"] if f["properties"]["kind"] == "track"]
    assert [(p["quality"], len(p["t_s"])) for p in pieces] == parts(track)
    assert [t for p in pieces for t in p["t_s"]] == track.t_s.tolist()
    gaps = [f for f in collection["features"] if f["properties"]["kind"] == "gap"]
    assert len(gaps) == len(track.gaps)
    for feature, gap in zip(gaps, track.gaps, strict=True):
        said = feature["properties"]
        assert said["quality"] == gap.quality
        assert said["duration_s"] == pytest.approx(gap.duration_s)
        assert said["distance_m"] == pytest.approx(gap.distance_m, abs=1e-3)
        assert said["max_half_m"] == pytest.approx(gap.max_half_m, abs=1e-4)
        first, stop = track.rows_of(gap)
        line = feature["geometry"]["coordinates"]
        assert len(line) == stop - first
        assert line[0][:2] == pytest.approx([track.lon_deg[first], track.lat_deg[first]], abs=1e-9)
    single = [f for f in collection["features"] if f["geometry"]["type"] == "Point"]
    assert len(single) == 1  # the gap of one row


def test_geojson_lines_are_cut_at_the_date_line(tmp_path):
    track = made_track(300, lat=0.0, lon=179.999, outages=())
    track.write(tmp_path / "a.geojson")
    (feature, *_) = check_geojson((tmp_path / "a.geojson").read_bytes())["features"]
    assert feature["geometry"]["type"] == "MultiLineString"
    west, east = feature["geometry"]["coordinates"]
    assert west[-1][0] == 180
    assert east[0][0] == -180
    assert west[-1][1:] == east[0][1:]
    for line in (west, east):
        assert np.abs(np.diff([p[0] for p in line])).max() < 1e-3


def test_geojson_leaves_height_out_where_it_is_unknown(tmp_path):
    made_track(height=False).write(tmp_path / "a.geojson")
    collection = check_geojson((tmp_path / "a.geojson").read_bytes())
    assert len(lines_of(collection["features"][0]["geometry"])[0][0]) == 2


# --- KML ------------------------------------------------------------------------------------------


def test_kml_tracks_have_a_time_for_every_coordinate(tmp_path):
    track = made_track(epoch_s=EPOCH.timestamp())
    track.write(tmp_path / "a.kml")
    root = etree.parse(tmp_path / "a.kml").getroot()
    assert root.tag == f"{KML}kml"
    styles = {style.get("id") for style in root.iter(f"{KML}Style")}
    found = []
    for mark in root.iter(f"{KML}Placemark"):
        assert mark.find(f"{KML}styleUrl").text[1:] in styles
        part = mark.find(f"{GX}Track")
        if part is None:
            continue
        when, where = part.findall(f"{KML}when"), part.findall(f"{GX}coord")
        half = part.findall(f".//{GX}value")
        assert len(when) == len(where) == len(half)
        names = [etree.QName(child).localname for child in part]
        order = ["altitudeMode", "when", "coord", "ExtendedData"]
        assert [order.index(name) for name in names] == sorted(order.index(n) for n in names)
        found.append((mark.find(f"{KML}styleUrl").text[1:], len(when)))
        for moment in when:
            assert TIME.fullmatch(moment.text)
    assert found == parts(track)
    where = [c.text.split() for c in root.iter(f"{GX}coord")]
    np.testing.assert_allclose(np.array(where, float)[:, 0], track.lon_deg, atol=1e-9)
    np.testing.assert_allclose(np.array(where, float)[:, 1], track.lat_deg, atol=1e-9)
    lines = list(root.iter(f"{KML}LineString"))
    assert len(lines) == len(track.gaps)


def test_kml_without_gaps_has_no_gap_folder(tmp_path):
    made_track(outages=(), quality=np.full(120, "fix"), gaps=()).write(tmp_path / "a.kml")
    assert b"<name>gaps</name>" not in (tmp_path / "a.kml").read_bytes()


def test_writer_does_not_load_what_it_does_not_need(tmp_path):
    """A CSV or GPX file needs neither pandas nor pyarrow."""
    code = (
        "import sys; sys.path[:0] = sys.argv[2:]\n"
        "from tests.vehicle.made_tracks import made_track\n"
        "track = made_track()\n"
        "for end in ('csv', 'gpx', 'kml', 'geojson'): track.write(sys.argv[1] + '/a.' + end)\n"
        "print([m for m in ('pandas', 'polars', 'pyarrow', 'scipy') if m in sys.modules])"
    )
    here = str(module.__file__).rsplit("/halfwidth/", 1)[0]
    run = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path), here, str(Path(__file__).parents[2])],
        capture_output=True,
        text=True,
    )
    assert run.stdout.strip() == "[]", run.stderr


def test_bytes_written_are_those_made(monkeypatch):
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw))
    made_track().write("-", format=".kml")
    assert etree.fromstring(raw.getvalue()).tag == f"{KML}kml"
