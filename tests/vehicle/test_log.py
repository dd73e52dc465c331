"""The log as a value: what it refuses, and what its methods say."""

import pickle

import numpy as np
import pytest
from tests.vehicle.drives import drive

import halfwidth as hw
from halfwidth.vehicle.log import COLUMNS, STREAMS, Log


def a_log(**more):
    columns = drive(every=2)
    return Log(**{COLUMNS[name]: values for name, values in columns.items()}, **more)


def test_absent_streams_are_nan_and_nothing_can_be_changed():
    log = Log(t=[0, 1], lat_deg=[50, 50], lon_deg=[14, 14])
    assert np.isnan(log.speed_mps).all()
    for name in ("t", *STREAMS):
        with pytest.raises(ValueError, match="read-only"):
            getattr(log, name)[0] = 1


def test_the_arrays_given_stay_as_they_were():
    t = np.array([0.0, 1.0])
    log = Log(t=t, lat_deg=[50, 50], lon_deg=[14, 14])
    t[0] = -5
    assert log.t[0] == 0


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"t": [0, 0]}, hw.BadValue, "strictly increasing"),
        ({"t": [1, 0]}, hw.BadValue, "goes from 1 s to 0 s in row 1"),
        ({"t": [0, np.nan]}, hw.BadValue, "is nan in row 1"),
        ({"t": ["a", "b"]}, hw.BadValue, "not a number"),
        ({"t": [[0, 1]]}, hw.BadShape, r"shape \(1, 2\)"),
        ({"speed_mps": [1, 2, 3]}, hw.BadShape, "3 rows but `t` has 2"),
        ({"speed_mps": [1, np.inf]}, hw.BadValue, "infinite in row 1"),
        ({"lat_deg": [50, np.nan]}, hw.BadValue, "only one of `lat_deg` and `lon_deg`"),
        ({"lat_deg": [50, 91]}, hw.BadValue, "is 91 in row 1"),
    ],
)
def test_what_it_refuses(changes, error, words):
    given = {"t": [0, 1], "lat_deg": [50, 50], "lon_deg": [14, 14]} | changes
    with pytest.raises(error, match=words):
        Log(**given)


def test_a_stream_comes_on_its_own_clock():
    log = a_log()
    t, position = log.stream("position")
    np.testing.assert_array_equal(t, log.t[::2])
    assert position.shape == (600, 2)
    assert log.stream("speed_mps")[0].size == 1200
    assert log.stream("ax_mps2")[1].size == 0
    with pytest.raises(hw.BadValue, match="one of position"):
        log.stream("speed")


def test_a_tunnel_takes_position_height_and_course_and_leaves_the_rest():
    log = a_log()
    cut = log.without(20, 30)
    inside = (log.t >= 20) & (log.t <= 30)
    for name in ("lat_deg", "lon_deg", "alt_m", "azimuth_rad"):
        assert np.isnan(getattr(cut, name)[inside]).all()
        np.testing.assert_array_equal(getattr(cut, name)[~inside], getattr(log, name)[~inside])
    np.testing.assert_array_equal(cut.yaw_rate_radps, log.yaw_rate_radps)
    assert cut.gaps() == [(19.8, 30.2)]
    with pytest.raises(hw.BadValue, match="t0 <= t1"):
        log.without(30, 20)


def test_gaps_are_longer_than_usual_and_rounding_makes_none():
    t = np.arange(50) * 0.1
    log = Log(t=t, lat_deg=np.full(50, 50.0), lon_deg=np.full(50, 14.0))
    assert log.gaps() == []
    assert Log(t=[0], lat_deg=[1], lon_deg=[1]).gaps() == []
    late = Log(t=[0, 1, 2.4, 3.4, 5], lat_deg=[1] * 5, lon_deg=[1] * 5)
    assert late.gaps() == []
    later = Log(t=[0, 1, 2, 3, 4.6], lat_deg=[1] * 5, lon_deg=[1] * 5)
    assert later.gaps() == [(3.0, 4.6)]


def test_rates():
    rates = a_log().rates()
    assert rates["position"] == pytest.approx(5)
    assert rates["speed_mps"] == pytest.approx(10)
    assert rates["ax_mps2"] is None


@pytest.mark.parametrize("native", ["pandas", "polars", "pyarrow"])
def test_a_table_goes_out_and_comes_back(native):
    log = a_log()
    back = hw.vehicle.from_frame(log.frame(native))
    for name in ("t", *STREAMS):
        np.testing.assert_array_equal(getattr(back, name), getattr(log, name))


def test_an_unknown_table_library_is_refused():
    with pytest.raises(hw.BadValue, match="one of pandas, polars, pyarrow"):
        a_log().frame("excel")


def test_it_can_be_sent_elsewhere():
    log = a_log(notes=("one",), columns={"lat": "Breite"})
    back = pickle.loads(pickle.dumps(log))
    np.testing.assert_array_equal(back.lat_deg, log.lat_deg)
    assert back.notes == ("one",)
    assert dict(back.columns) == {"lat": "Breite"}


def test_its_text_is_short():
    assert repr(a_log(source="a.csv")).startswith("Log('a.csv': 1200 rows, 119.9 s, 600 fixes, streams: ")


def test_rows_of_nothing_can_be_added():
    log = Log(t=[0.0, 1.0, 4.0], lat_deg=[50.0, 50.1, 50.4], lon_deg=[14.0, 14.0, 14.0])
    more = log.with_rows([2.0, 3.0])
    assert more.t.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert more.fixed.tolist() == [True, True, False, False, True]
    with pytest.raises(hw.BadValue):
        log.with_rows([1.0])
