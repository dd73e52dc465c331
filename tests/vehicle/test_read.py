"""One drive in many layouts gives one log; what is repaired is said."""

import gzip
import re
import sys

import numpy as np
import pytest
from tests.vehicle.drives import drive, save, text

import halfwidth as hw
from halfwidth.errors import BadLog
from halfwidth.vehicle import evidence
from halfwidth.vehicle.formats import layout
from halfwidth.vehicle.log import STREAMS

TRUE = drive()


def iso(seconds, zone="Z"):
    return [str(np.datetime64("2024-05-01T12:00:00") + np.timedelta64(round(s * 1e3), "ms")) + zone for s in seconds]


def clock(seconds, start=86_390.0):
    day = (np.asarray(seconds) + start) % 86_400
    return [f"{int(s // 3600):02d}:{int(s // 60) % 60:02d}:{s % 60:06.3f}" for s in np.round(day, 3)]


def with_columns(**new):
    """Replace or rename columns: `new=(old, function)`; an old name alone is taken away."""
    columns = dict(TRUE)
    for name, (old, change) in new.items():
        columns[name] = change(columns.pop(old))
    return columns


def same(value):
    return value


UNITS = {
    "Time [s]": ("t_s", same),
    "Latitude (deg)": ("lat_deg", same),
    "Longitude (deg)": ("lon_deg", same),
    "GPS Altitude (ft)": ("alt_m", lambda v: v / 0.3048),
    "Heading [°]": ("azimuth_rad", np.degrees),
    "Vehicle Speed (km/h)": ("speed_mps", lambda v: v * 3.6),
    "gyro_z_dps": ("yaw_rate_radps", np.degrees),
}

LAYOUTS = {
    "our own": (TRUE, {}),
    "units in the names": (with_columns(**UNITS), {}),
    "camel case": (
        with_columns(
            timestampMs=("t_s", lambda v: v * 1000),
            gpsLatitude=("lat_deg", same),
            gpsLongitude=("lon_deg", same),
            vehicleSpeedKmh=("speed_mps", lambda v: v * 3.6),
            yawRate=("yaw_rate_radps", same),
            headingDeg=("azimuth_rad", np.degrees),
        ),
        {},
    ),
    "German": (
        with_columns(
            Zeit=("t_s", same),
            Breitengrad=("lat_deg", same),
            Längengrad=("lon_deg", same),
            Kurs=("azimuth_rad", np.degrees),
            **{
                "Geschwindigkeit [km/h]": ("speed_mps", lambda v: v * 3.6),
                "Gierrate [°/s]": ("yaw_rate_radps", np.degrees),
            },
        ),
        {"delimiter": ";", "decimal": ","},
    ),
    "mph": (with_columns(speed_mph=("speed_mps", lambda v: v / 0.44704)), {}),
    "knots": (with_columns(**{"SOG [kn]": ("speed_mps", lambda v: v * 3600 / 1852)}), {}),
    "no unit, km/h": (with_columns(speed=("speed_mps", lambda v: v * 3.6)), {}),
    "no unit, degrees": (with_columns(heading=("azimuth_rad", np.degrees), gyro_z=("yaw_rate_radps", np.degrees)), {}),
    "tabs": (TRUE, {"delimiter": "\t"}),
    "bars": (TRUE, {"delimiter": "|"}),
    "u-blox integers": (
        with_columns(lat=("lat_deg", lambda v: np.round(v * 1e7)), lon=("lon_deg", lambda v: np.round(v * 1e7))),
        {"digits": 12},
    ),
    "semicircles": (
        with_columns(
            position_lat=("lat_deg", lambda v: np.round(v * 2**31 / 180)),
            position_long=("lon_deg", lambda v: np.round(v * 2**31 / 180)),
        ),
        {"digits": 12},
    ),
    "degrees and minutes": (
        with_columns(
            lat=("lat_deg", lambda v: np.floor(v) * 100 + v % 1 * 60),
            lon=("lon_deg", lambda v: np.floor(v) * 100 + v % 1 * 60),
        ),
        {"digits": 12},
    ),
    "milliseconds": (with_columns(time=("t_s", lambda v: v * 1000)), {}),
    "microseconds": (with_columns(time=("t_s", lambda v: v * 1e6)), {}),
    "Unix seconds": (with_columns(timestamp=("t_s", lambda v: v + 1.7e9)), {"digits": 14}),
    "Unix milliseconds": (with_columns(timestamp=("t_s", lambda v: (v + 1.7e9) * 1e3)), {"digits": 14}),
    "Unix nanoseconds": (
        with_columns(timestamp=("t_s", lambda v: [f"{1_700_000_000_000 + round(s * 1000)}000000" for s in v])),
        {},
    ),
    "ISO 8601": (with_columns(time=("t_s", iso)), {}),
    "ISO 8601 with a zone": (with_columns(datetime=("t_s", lambda v: iso(v, "+02:00"))), {}),
    "ISO 8601 with a blank": (with_columns(time=("t_s", lambda v: [s.replace("T", " ") for s in iso(v, "")])), {}),
    "dates with points": (
        with_columns(Zeitstempel=("t_s", lambda v: [f"01.05.2024 {s[11:]}" for s in iso(v, "")])),
        {},
    ),
    "time of day past midnight": (with_columns(utc_time=("t_s", clock)), {}),
    "dates with names of months": (
        with_columns(**{"Device Time": ("t_s", lambda v: [f"01-May-2024 {s[11:]}" for s in iso(v, "")])}),
        {},
    ),
    "date and time apart": (
        {"date": ["2024-05-01"] * 1200} | with_columns(time=("t_s", lambda v: clock(v, 3600.0))),
        {},
    ),
    "GPS week": (
        {"gps_week": np.full(1200, 2300.0)} | with_columns(tow=("t_s", lambda v: v + 604_700)),
        {"digits": 12},
    ),
    "swapped": (TRUE | {"lat_deg": TRUE["lon_deg"], "lon_deg": TRUE["lat_deg"]}, {}),
    "everything wrong": (
        TRUE
        | {
            "speed_mps": TRUE["speed_mps"] * 3.6,
            "yaw_rate_radps": -np.degrees(TRUE["yaw_rate_radps"]),
            "azimuth_rad": np.degrees(TRUE["azimuth_rad"]),
            "t_s": TRUE["t_s"],
        },
        {},
    ),
}


@pytest.mark.parametrize(("columns", "how"), LAYOUTS.values(), ids=LAYOUTS)
def test_every_layout_gives_the_same_log(columns, how, tmp_path):
    log = hw.vehicle.read(save(tmp_path / "log.csv", columns, **how))
    expected = {"alt_m": 1e-4, "lat_deg": 2e-7, "lon_deg": 2e-7, "speed_mps": 1e-5, "yaw_rate_radps": 1e-6}
    assert len(log) == 1200
    np.testing.assert_allclose(log.t - log.t[0], TRUE["t_s"], atol=2e-6)
    for name, tolerance in expected.items():
        np.testing.assert_allclose(getattr(log, name), TRUE[name], atol=tolerance, err_msg=name)
    turn = (log.azimuth_rad - TRUE["azimuth_rad"] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turn, 0, atol=1e-6)


@pytest.mark.parametrize("name", ["Unix seconds", "Unix milliseconds", "Unix nanoseconds"])
def test_absolute_time_is_kept(name, tmp_path):
    columns, how = LAYOUTS[name]
    log = hw.vehicle.read(save(tmp_path / "log.csv", columns, **how))
    assert log.epoch_s == pytest.approx(1.7e9, abs=1e-6)
    assert log.t[0] == 0


def test_a_log_without_dates_has_no_absolute_time_and_keeps_its_own_zero(tmp_path):
    log = hw.vehicle.read(save(tmp_path / "log.csv", TRUE | {"t_s": TRUE["t_s"] + 100}))
    assert log.epoch_s is None
    assert log.t[0] == 100
    iso_log = hw.vehicle.read(save(tmp_path / "iso.csv", LAYOUTS["ISO 8601"][0]))
    assert iso_log.epoch_s == 1_714_564_800
    assert "time stamps without a zone taken as UTC" not in iso_log.notes
    naive = hw.vehicle.read(save(tmp_path / "naive.csv", LAYOUTS["ISO 8601 with a blank"][0]))
    assert "time stamps without a zone taken as UTC" in naive.notes


def test_comments_titles_units_and_trailing_delimiters(tmp_path):
    lines = text(TRUE).splitlines()
    body = [f"{line}," for line in lines[1:]]
    body.insert(30, "# the driver stops for coffee")
    path = tmp_path / "log.csv"
    head = ["Logger 7, version 2", "# made in spring", ",".join(name.partition("_")[0] for name in TRUE)]
    head[2] = "t,lat,lon,alt,azimuth,speed,yaw_rate"
    path.write_text("\n".join([*head, "s,deg,deg,m,rad,m/s,rad/s", *body]) + "\n")
    log = hw.vehicle.read(path)
    np.testing.assert_allclose(log.lat_deg, TRUE["lat_deg"], atol=1e-7)
    assert "lat from `lat` in deg" in log.notes[0]
    assert "1 line before the header skipped" in log.notes


def test_a_header_behind_a_hash(tmp_path):
    path = tmp_path / "log.txt"
    path.write_text("# " + text(TRUE, delimiter=" ", head="t_s lat lon alt azimuth_rad speed_mps yaw_rate"))
    np.testing.assert_allclose(hw.vehicle.read(path).speed_mps, TRUE["speed_mps"], atol=1e-7)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"])
def test_encodings(encoding, tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(text(with_columns(**UNITS)).encode(encoding))
    np.testing.assert_allclose(hw.vehicle.read(path).azimuth_rad, TRUE["azimuth_rad"], atol=1e-7)


@pytest.mark.parametrize("end", ["\r\n", "\r"])
def test_line_ends(end, tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(text(TRUE).replace("\n", end).encode())
    assert len(hw.vehicle.read(path)) == 1200


def test_quoted_cells_with_decimal_commas(tmp_path):
    rows = [",".join(f'"{v:.8f}"'.replace(".", ",") for v in row) for row in zip(*TRUE.values(), strict=True)]
    path = tmp_path / "log.csv"
    path.write_text(",".join(TRUE) + "\n" + "\n".join(rows) + "\n")
    np.testing.assert_allclose(hw.vehicle.read(path).lon_deg, TRUE["lon_deg"], atol=1e-7)


def test_hemispheres(tmp_path):
    cells = {"lat": [f"{v:.8f} N" for v in TRUE["lat_deg"]], "lon": [f"{v:.8f}° W" for v in TRUE["lon_deg"]]}
    path = save(tmp_path / "log.csv", cells | {"t": TRUE["t_s"]})
    np.testing.assert_allclose(hw.vehicle.read(path).lon_deg, -TRUE["lon_deg"], atol=1e-7)


def test_longitudes_from_0_to_360(tmp_path):
    columns = drive(lon0=-105.0)
    west = columns["lon_deg"]
    log = hw.vehicle.read(save(tmp_path / "log.csv", columns | {"lon_deg": west + 360}))
    np.testing.assert_allclose(log.lon_deg, west, atol=1e-6)
    assert "longitudes beyond 180 degrees brought into -180 to 180" in log.notes


def test_gzip_of_several_parts(tmp_path):
    whole = text(TRUE).encode()
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(whole[:5000]) + gzip.compress(whole[5000:]))
    assert len(hw.vehicle.read(path)) == 1200


def test_standard_input(tmp_path, monkeypatch):
    path = save(tmp_path / "log.csv", TRUE)
    with open(path, "rb") as file:
        monkeypatch.setattr(sys, "stdin", type("Stdin", (), {"buffer": file}))
        log = hw.vehicle.read("-")
    assert (log.source, len(log)) == ("-", 1200)


def test_a_header_and_rows_over_block_borders(tmp_path):
    columns = drive(60_000, dt=0.01)
    path = save(tmp_path / "log.csv", columns)
    log = hw.vehicle.read(path)
    np.testing.assert_allclose(log.lat_deg, columns["lat_deg"], atol=1e-7)


def frame_of(library, columns):
    import pandas
    import polars
    import pyarrow

    return {"pandas": pandas.DataFrame, "polars": polars.DataFrame, "pyarrow": pyarrow.table}[library](columns)


@pytest.mark.parametrize("library", ["pandas", "polars", "pyarrow"])
def test_tables_in_memory(library):
    columns = drive(every=3)
    log = hw.vehicle.from_frame(frame_of(library, columns))
    for name in STREAMS[:2]:
        np.testing.assert_array_equal(getattr(log, name), columns[name])
    when = np.datetime64("2024-05-01T12:00:00", "us") + np.round(columns.pop("t_s") * 1e6).astype("timedelta64[us]")
    dated = hw.vehicle.from_frame(frame_of(library, {"when": when} | columns), columns={"time": "when"})
    np.testing.assert_allclose(dated.t, log.t, atol=1e-9)
    assert dated.epoch_s == 1_714_564_800


def test_the_index_of_a_table_is_the_time():
    import pandas

    frame = pandas.DataFrame(TRUE).drop(columns="t_s")
    frame.index = pandas.to_datetime(TRUE["t_s"] + 1.7e9, unit="s", utc=True).tz_convert("Europe/Berlin")
    log = hw.vehicle.from_frame(frame)
    np.testing.assert_allclose(log.t, TRUE["t_s"], atol=1e-6)
    assert log.epoch_s == pytest.approx(1.7e9)


@pytest.mark.parametrize("compression", ["snappy", "none", "zstd"])
def test_parquet(compression, tmp_path):
    import pyarrow
    from pyarrow import parquet

    columns = drive(every=5)
    table = pyarrow.table(columns | {"comment": ["x"] * 1200})
    parquet.write_table(table, tmp_path / "log.parquet", compression=compression)
    log = hw.vehicle.read(tmp_path / "log.parquet")
    np.testing.assert_array_equal(log.lat_deg, columns["lat_deg"])
    with open(tmp_path / "log.parquet", "rb") as file, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdin", type("Stdin", (), {"buffer": file}))
        assert len(hw.vehicle.read("-")) == 1200


def test_nothing_but_a_table_is_a_table():
    with pytest.raises(hw.BadLog, match="is a dict, a table of pandas"):
        hw.vehicle.from_frame({"t": [1]})


# --- what the user says wins --------------------------------------------------------------------


def test_named_columns_win_and_carry_unit_and_sign(tmp_path):
    columns = with_columns(w=("yaw_rate_radps", lambda v: -np.degrees(v)), v2=("speed_mps", lambda v: v * 3.6))
    path = save(tmp_path / "log.csv", columns | {"speed": np.full(1200, 3.0)})
    log = hw.vehicle.read(path, columns="yaw_rate=-w[deg/s],speed=v2[km/h]")
    np.testing.assert_allclose(log.speed_mps, TRUE["speed_mps"], atol=1e-6)
    np.testing.assert_allclose(log.yaw_rate_radps, TRUE["yaw_rate_radps"], atol=1e-6)
    assert log.columns["speed"] == "v2"


def test_a_unit_that_the_user_states_is_never_overruled(tmp_path):
    path = save(tmp_path / "log.csv", TRUE | {"speed_mps": TRUE["speed_mps"] * 3.6})
    log = hw.vehicle.read(path, columns={"speed": "speed_mps[m/s]"})
    np.testing.assert_allclose(log.speed_mps, TRUE["speed_mps"] * 3.6, atol=1e-6)


def test_fields_of_the_log_may_be_named_too(tmp_path):
    path = save(tmp_path / "log.csv", with_columns(a=("lat_deg", same)))
    assert hw.vehicle.read(path, columns={"lat_deg": "a"}).fixed.all()


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ("lat", "ROLE=COLUMN is expected"),
        ("lat=nope", "has no such column; found: t_s, lat_deg"),
        ("lta=x", "hint: --columns lat=NAME,lon=NAME"),
        ("lat=lat_deg[parsec]", "hint: --columns lat=lat_deg[deg]"),
        ("latitude=lat_deg", "names the role 'latitude', one of time, lat"),
        ("speed=speed_mps[furlong]", "gives the unit 'furlong' for speed"),
    ],
)
def test_a_wrong_name_is_refused(columns, words, tmp_path):
    with pytest.raises(hw.BadLog, match=re.escape(words)):
        hw.vehicle.read(save(tmp_path / "log.csv", TRUE), columns=columns)


def test_without_repair_stated_units_stand(tmp_path):
    path = save(tmp_path / "log.csv", TRUE | {"speed_mps": TRUE["speed_mps"] * 3.6})
    log = hw.vehicle.read(path, repair=False)
    assert evidence.speed_ratio(log).value == pytest.approx(3.6, rel=0.02)


@pytest.mark.parametrize(
    ("name", "role", "unit"),
    [
        ("t", "time", None), ("timestamp_ns", "time", "ns"), ("Time (ms)", "time", "ms"), ("lat", "lat", None),
        ("Latitude [°]", "lat", "deg"), ("gps_lon_deg", "lon", "deg"), ("location.lng", "lon", None),
        ("Speed (OBD)(km/h)", "speed", "km/h"), ("GPS Speed (Meters/second)", "speed", "m/s"),
        ("speed_m_s", "speed", "m/s"), ("vehicle_speed_kph", "speed", "km/h"), ("v [m/s]", "speed", "m/s"),
        ("yaw_rate_deg_s", "yaw_rate", "deg/s"), ("gyroZ[rad/s]", "yaw_rate", "rad/s"), ("wz", "yaw_rate", None),
        ("angular_velocity.z", "yaw_rate", None), ("ax_mps2", "ax", "m/s2"), ("accX (g)", "ax", "g"),
        ("field.header.stamp", "time", None), ("LOCATION Latitude : ", "lat", None), ("enhanced_speed", "speed", None),
        ("lat_acc", "ay", None), ("long_acc", "ax", None), ("course_over_ground", "azimuth", None),
        ("heading_rad", "azimuth", "rad"), ("altitude_ft", "alt", "ft"), ("fix_quality", "valid", None),
    ],
)  # fmt: skip
def test_names_and_units_are_recognised(name, role, unit):
    assert layout.role_of(name)[:2] == (role, unit)


@pytest.mark.parametrize(
    "name", ["speed_accuracy", "lat_std", "wheel_speed_fl", "yaw_rate_bias", "temperature", "", "#"]
)
def test_other_names_are_left_alone(name):
    assert layout.role_of(name) is None


def test_the_cars_own_speed_is_preferred(tmp_path):
    columns = TRUE | {"gps_speed [m/s]": np.full(1200, 1.0)}
    log = hw.vehicle.read(save(tmp_path / "log.csv", columns))
    np.testing.assert_allclose(log.speed_mps, TRUE["speed_mps"], atol=1e-6)
    assert "columns passed over for a better one: gps_speed [m/s]" in log.notes


# --- what is not repaired -----------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_a_good_log_is_left_alone(seed, tmp_path):
    columns = drive(seed=seed, fix_noise=1.0)
    log = hw.vehicle.read(save(tmp_path / "log.csv", columns, digits=12))
    for name in ("speed_mps", "yaw_rate_radps", "azimuth_rad", "lat_deg", "lon_deg"):
        np.testing.assert_allclose(getattr(log, name), columns[name], rtol=1e-9, atol=1e-9)
    assert len(log.notes) == 1


@pytest.mark.parametrize(
    "name", ["balzer_dresden_2014_03_26", "driveplotr_nds_drive18", "smartloc_berlin_potsdamer_platz"]
)
def test_real_logs_are_left_alone(name, data):
    import pandas

    path = data / f"{name}.csv.gz"
    log, table = hw.vehicle.read(path), pandas.read_csv(path)
    assert len(log.notes) == 1, log.notes
    np.testing.assert_array_equal(log.t, table["t_s"])
    for column in STREAMS:
        np.testing.assert_array_equal(getattr(log, column), table[column], err_msg=column)


def test_a_standing_car_tells_nothing_and_nothing_is_changed(tmp_path):
    still = {"t_s": np.arange(300.0), "lat_deg": np.full(300, 50.0), "lon_deg": np.full(300, 14.0)}
    still |= {"speed_mps": np.zeros(300), "yaw_rate_radps": np.zeros(300)}
    log = hw.vehicle.read(save(tmp_path / "log.csv", still))
    assert log.fixed.all()
    assert len(log.notes) == 1


def test_a_speed_of_a_wrong_scale_on_a_straight_road_swaps_nothing(tmp_path):
    columns = drive(lat0=40.0, east_west=True)
    columns["speed_mps"] = columns["speed_mps"] / np.cos(np.radians(40.0))
    del columns["azimuth_rad"]
    log = hw.vehicle.read(save(tmp_path / "log.csv", columns))
    np.testing.assert_allclose(log.lat_deg, columns["lat_deg"], atol=1e-7)


def test_swapped_columns_are_seen_without_an_azimuth(tmp_path):
    columns = drive()
    columns["lat_deg"], columns["lon_deg"] = columns["lon_deg"], columns["lat_deg"]
    del columns["azimuth_rad"]
    log = hw.vehicle.read(save(tmp_path / "log.csv", columns))
    np.testing.assert_allclose(log.lat_deg, columns["lon_deg"], atol=1e-7)


def test_shuffled_rows_are_sorted(tmp_path):
    columns = drive()
    order = np.random.default_rng(1).permutation(1200)
    log = hw.vehicle.read(save(tmp_path / "log.csv", {name: values[order] for name, values in columns.items()}))
    assert log.t == pytest.approx(columns["t_s"])
    assert log.speed_mps == pytest.approx(columns["speed_mps"])
    assert any("no order" in note for note in log.notes)


def test_a_column_of_numbers_in_no_order_is_no_time(tmp_path):
    columns = drive()
    with pytest.raises(BadLog, match="clock"):
        hw.vehicle.read(save(tmp_path / "log.csv", columns | {"t_s": np.random.default_rng(1).normal(0, 500, 1200)}))


def test_one_space_is_one_delimiter_where_cells_are_empty(tmp_path):
    columns = drive(every=2)
    log = hw.vehicle.read(save(tmp_path / "log.txt", columns, delimiter=" "))
    assert log.speed_mps == pytest.approx(columns["speed_mps"])
    assert log.fixed.sum() == 600
    text = (tmp_path / "log.txt").read_text().replace("  ", " ")
    (tmp_path / "lost.txt").write_text(text)
    with pytest.raises(BadLog, match="which of them are empty is not known"):
        hw.vehicle.read(tmp_path / "lost.txt")


def test_what_reading_took_away_is_said_where_too_little_is_left(tmp_path):
    columns = drive()
    with pytest.raises(BadLog, match="1199 rows with the time of the row before"):
        hw.vehicle.read(save(tmp_path / "log.csv", columns | {"t_s": np.full(1200, 5.0)}))
    with pytest.raises(BadLog, match="1199 rows without a time dropped") as caught:
        hw.vehicle.read(save(tmp_path / "log.csv", columns | {"t_s": np.where(np.arange(1200) == 0, 0.0, 1e300)}))
    assert "--columns time=NAME" in caught.value.hint
    with pytest.raises(BadLog, match="only one row has a position") as caught:
        hw.vehicle.read(save(tmp_path / "log.csv", columns | {"lat_deg": np.where(np.arange(1200) == 0, 50.0, np.nan)}))
    assert "--columns lat=NAME,lon=NAME" in caught.value.hint


def test_what_stands_between_the_columns_is_asked_for_where_it_is_not_known(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(text(TRUE, delimiter="@"))
    with pytest.raises(BadLog, match="no column that is read as time") as caught:
        hw.vehicle.read(path)
    assert "comma, semicolon, tab, bar or space" in caught.value.hint


def test_a_column_that_is_not_known_is_named_where_the_speed_is_lacking(tmp_path):
    named = {("swiftness" if name == "speed_mps" else name): values for name, values in TRUE.items()}
    notes = hw.vehicle.read(save(tmp_path / "log.csv", named)).notes
    assert "no column is read as speed; what is not read: swiftness" in notes
    assert not any("not read" in note for note in hw.vehicle.read(save(tmp_path / "log.csv", TRUE)).notes)


def test_streams_one_after_the_other_are_sorted_together(tmp_path):
    nan = np.full(1200, np.nan)
    first = {name: TRUE[name] if name in ("t_s", "lat_deg", "lon_deg") else nan for name in TRUE}
    second = {name: TRUE[name] if name in ("t_s", "speed_mps", "yaw_rate_radps") else nan for name in TRUE}
    both = {name: np.concatenate((first[name], second[name])) for name in TRUE}
    log = hw.vehicle.read(save(tmp_path / "log.csv", both))
    assert len(log) == 1200
    np.testing.assert_allclose(log.speed_mps, TRUE["speed_mps"], atol=1e-7)


def test_coarse_stamps_are_spread(tmp_path):
    log = hw.vehicle.read(save(tmp_path / "log.csv", TRUE | {"t_s": np.floor(TRUE["t_s"])}))
    np.testing.assert_allclose(log.t, TRUE["t_s"], atol=1e-9)


def test_a_frozen_receiver_is_an_outage(tmp_path):
    columns = drive()
    frozen = (columns["t_s"] >= 70) & (columns["t_s"] < 90)
    for name in ("lat_deg", "lon_deg"):
        columns[name] = np.where(frozen, columns[name][699], columns[name])
    log = hw.vehicle.read(save(tmp_path / "log.csv", columns))
    ((start, stop),) = log.gaps()
    assert 69.5 < start < 71
    assert stop == 90


def test_held_fixes_become_the_receivers_own_rate(tmp_path):
    columns = drive(every=10)
    for name in ("lat_deg", "lon_deg", "azimuth_rad"):
        columns[name] = np.repeat(columns[name][::10], 10)
    log = hw.vehicle.read(save(tmp_path / "log.csv", columns))
    assert log.rates()["position"] == pytest.approx(1)
    assert log.gaps() == []


def test_fixes_marked_invalid_are_dropped(tmp_path):
    log = hw.vehicle.read(save(tmp_path / "log.csv", TRUE | {"fix_valid": (np.arange(1200) % 4 > 0) * 1.0}))
    assert log.fixed.sum() == 900


def test_it_reads_fast_without_any_table_library(tmp_path):
    """No optional library is even loaded; the time itself stands in the benchmarks."""
    import subprocess

    path = save(tmp_path / "log.csv", drive(6000))
    code = (
        "import sys, halfwidth as hw\n"
        f"hw.vehicle.read({path!r})\n"
        "print([name for name in ('pandas', 'polars', 'pyarrow', 'scipy', 'narwhals') if name in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
