"""Frames of three libraries go in, and come out with their names, clock and index."""

import datetime

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest

import halfwidth as hw

COLUMNS = {"time": [0.0, 1.0, 2.5], "river": [1.0, None, 2.0], "note": [0.0, 0.0, 0.0]}
WALK = hw.Linear(
    lambda dt: [[1.0]], None, [[1.0]], hw.Gaussian(0.1), hw.Gaussian(1.0), hw.Normal([0.0], 1.0),
    names={"x": ["level"]},
)  # fmt: skip


@pytest.mark.parametrize("make", [pd.DataFrame, pl.DataFrame, pa.table], ids=["pandas", "polars", "pyarrow"])
def test_round_trip(make):
    frame = make(COLUMNS)
    record = hw.Record.from_frame(frame, time="time", outputs="river")
    assert record.seen.ravel().tolist() == [True, False, True]
    est = hw.estimate(WALK, record)
    back = est.to_frame()
    assert type(back) is type(frame)
    columns = list(back.columns) if not isinstance(back, pa.Table) else back.column_names
    assert columns == ["time", "level", "level_lo", "level_hi"]
    np.testing.assert_array_equal(np.asarray(back["level"]), est.x[:, 0])
    np.testing.assert_array_equal(np.asarray(back["time"]), [0.0, 1.0, 2.5])


def test_pandas_index_of_dates_is_kept():
    index = pd.date_range("2026-03-01 12:00", periods=3, freq="2s", name="when", tz=None)
    record = hw.Record.from_frame(pd.DataFrame({"river": [1.0, np.nan, 2.0]}, index=index))
    np.testing.assert_allclose(record.t, [0.0, 2.0, 4.0])
    back = hw.estimate(WALK, record).to_frame(level=None)
    assert back.index.equals(index)
    assert back.index.name == "when"
    assert list(back.columns) == ["level"]


def test_an_index_without_a_name_stays_without():
    record = hw.Record.from_frame(pd.DataFrame({"y": [1.0, 2.0]}, index=[0.5, 1.5]))
    back = hw.estimate(WALK, record).to_frame(level=None)
    assert back.index.name is None
    assert back.index.tolist() == [0.5, 1.5]


def test_time_zones_and_polars_dates():
    index = pd.date_range("2026-03-01 12:00", periods=2, freq="s", tz="Europe/Berlin")
    record = hw.Record.from_frame(pd.DataFrame({"y": [1.0, 2.0]}, index=index))
    np.testing.assert_allclose(record.t, [0.0, 1.0])
    when = [datetime.datetime(2026, 1, 1), datetime.datetime(2026, 1, 1, 0, 0, 3)]
    record = hw.Record.from_frame(pl.DataFrame({"t": when, "y": [1, 2]}), time="t")
    np.testing.assert_allclose(record.t, [0.0, 3.0])
    back = hw.estimate(WALK, record).to_frame()
    assert back["t"].to_list() == when


def test_nullable_and_integer_columns():
    frame = pd.DataFrame({"t": [0, 1, 2], "y": pd.array([1, None, 3], dtype="Int64")})
    record = hw.Record.from_frame(frame, time="t")
    assert record.seen.ravel().tolist() == [True, False, True]
    assert record.labels.outputs == ("y",)


def test_arrays_in_frame_out_takes_an_installed_library():
    est = hw.estimate(WALK, hw.Record([0.0, 1.0], [1.0, 2.0]))
    assert list(est.to_frame().columns)[:2] == ["t", "level"]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: hw.Record.from_frame({"a": [1]}), "frame of pandas"),
        (lambda: hw.Record.from_frame(pl.DataFrame(COLUMNS)), "time='time'"),
        (lambda: hw.Record.from_frame(pl.DataFrame(COLUMNS), time="clock"), "clock"),
        (lambda: hw.Record.from_frame(pl.DataFrame(COLUMNS), time="time", outputs="sea"), "sea"),
        (lambda: hw.Record.from_frame(pl.DataFrame(COLUMNS), time="time", inputs=["sea"]), "sea"),
        (lambda: hw.Record.from_frame(pl.DataFrame({"t": [1.0]}), time="t"), "no column is left"),
        (lambda: hw.Record.from_frame(pd.DataFrame({"t": [0.0], "y": ["wet"]}), time="t"), "'y'"),
        (lambda: hw.Record.from_frame(pd.DataFrame({"t": ["noon"], "y": [1.0]}), time="t"), "to_datetime"),
        (lambda: hw.Record.from_frame(pd.DataFrame({"t": [pd.NaT], "y": [1.0]}), time="t"), "missing at row 0"),
    ],
)
def test_bad_frames(call, words):
    with pytest.raises(hw.BadRecord, match=words):
        call()
