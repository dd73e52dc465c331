"""The pictures of a check show what its verdicts rest on: the same numbers, in a page that asks nothing of anybody."""

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from tests.vehicle.drives import drive, save

import halfwidth as hw
from halfwidth.shells import cli
from halfwidth.vehicle.check_pictures import pictures, places
from halfwidth.vehicle.report_log import page


@pytest.fixture(scope="module")
def faulty():
    """A drive whose clocks step, whose receiver freezes and jumps."""
    _, log = hw.vehicle.simulate_drive(
        duration=300, seed=8, outages=[(200.0, 215.0)], fix_noise=0.1, fix_offset=0.1, clock_offset=0.1, yaw_bias=0.004
    )
    late = {
        name: np.where(log.t > 120, np.interp(log.t - 0.6, log.t, getattr(log, name)), getattr(log, name))
        for name in ("speed_mps", "yaw_rate_radps")
    }
    lat, lon = log.lat_deg.copy(), log.lon_deg.copy()
    rows = np.flatnonzero(log.fixed & (log.t > 60) & (log.t <= 66))
    lat[rows], lon[rows] = lat[rows[0]], lon[rows[0]]
    lat[log.fixed & (log.t > 150) & (log.t <= 152)] += 40 / 111_229
    return hw.vehicle.check(replace(log, lat_deg=lat, lon_deg=lon, **late))


def of(found, title):
    return next(one for one in pictures(found) if one.title.startswith(title))


def layers(picture, kind):
    return [layer for layer in picture.layers if layer.kind == kind]


def test_each_clock_has_its_curve_with_the_optimum_in_its_valley(faulty):
    for title, name in (("Clock of the speed", "speed"), ("Clock of the yaw rate", "yaw_rate")):
        one = of(faulty, title)
        offset = faulty.basis.known.offsets[name]
        assert offset.change == "step"
        curves, found = layers(one, "line"), layers(one, "upright")
        assert [float(layer.x[0]) for layer in found] == [seconds for _, seconds in offset.at]
        for curve, at in zip(curves, found, strict=True):
            assert abs(curve.x[np.argmin(curve.y)] - at.x[0]) < 0.3
        assert not one.timed


def test_scale_and_bias_lie_among_what_the_fixes_say(faulty):
    known = faulty.basis.known
    scale, bias = of(faulty, "Speed against"), of(faulty, "Bias of")
    dots, level = layers(scale, "dots")[0], layers(scale, "level")[0]
    assert level.y[0] == pytest.approx(100 * (1 / known.scale - 1))
    assert np.median(dots.y) == pytest.approx(level.y[0], abs=0.5)
    assert np.median(layers(bias, "dots")[0].y) == pytest.approx(known.bias, abs=0.001)
    low, high = layers(bias, "ribbon")[0].y, layers(bias, "ribbon")[0].to
    assert ((low < layers(bias, "line")[0].y) & (layers(bias, "line")[0].y < high)).all()


def test_fixes_that_are_left_out_are_shown_when_and_where(faulty):
    dots = {layer.words.split(":")[0]: layer for layer in layers(of(faulty, "Fixes that are left out"), "dots")}
    frozen, stray = dots["frozen"], dots["stray"]
    assert ((frozen.x > 60) & (frozen.x <= 66)).all()
    assert (np.diff(frozen.y) >= 0).mean() > 0.8  # a frozen fix is further off from step to step
    inside = (stray.x > 150) & (stray.x <= 152)
    assert inside.mean() > 0.9
    assert stray.y[inside] == pytest.approx(40, abs=3)
    where = places(faulty)
    assert where.out["frozen"].size == frozen.x.size
    assert np.ptp(where.east[where.out["frozen"]]) == 0


def test_a_picture_holds_all_its_lines(faulty):
    for one in pictures(faulty):
        left, right, low, high = one.limits()
        for layer in one.layers:
            if layer.kind in ("line", "level", "ribbon"):
                assert layer.x.min() >= left - 1e-9
                assert layer.x.max() <= right + 1e-9
                assert layer.y.min() >= low
                assert layer.y.max() <= high


def test_the_page_is_whole_and_inert(faulty):
    text = page(faulty)
    assert text == page(faulty)
    assert text.count("<figure>") == len(pictures(faulty)) + 1  # and the map
    assert "<script" not in text
    assert "style=" not in text
    assert "default-src 'none'" in text
    assert "http" not in re.sub("http-equiv", "", text)
    for svg in re.findall(r"<svg.*?</svg>", text, flags=re.DOTALL):
        ElementTree.fromstring(svg)
        assert "nan" not in svg.lower()
    for item in faulty.items:
        if item.verdict != "ok":
            assert item.name in text


def test_what_cannot_be_drawn_is_left_out(tmp_path):
    columns = drive()
    few = {{"t_s": "t"}.get(name, name): values for name, values in columns.items()}
    swapped = columns | {"lat_deg": columns["lon_deg"], "lon_deg": columns["lat_deg"]}
    for name, found in (
        ("swapped", hw.vehicle.check(save(tmp_path / "swapped.csv", swapped))),
        ("one", hw.vehicle.check(hw.vehicle.Log(t=[0.0], lat_deg=[50.0], lon_deg=[14.0]))),
        ("few", hw.vehicle.check(hw.vehicle.Log(**{name: values[:9] for name, values in few.items()}))),
        ("two", hw.vehicle.check(hw.vehicle.Log(t=[0.0, 1.0], lat_deg=[50.0, 50.0], lon_deg=[14.0, 14.0]))),
        ("still", hw.vehicle.check(save(tmp_path / "still.csv", columns | {"speed_mps": np.zeros(1200)}))),
        ("evil", replace(hw.vehicle.check(save(tmp_path / "e.csv", columns)), source="<script>alert(1)</script>")),
    ):
        text = page(found)
        assert text.endswith("</html>\n"), name
        assert "<script" not in text


def test_the_command_writes_the_page(tmp_path, capsys):
    log, out = save(tmp_path / "log.csv", drive()), tmp_path / "check.html"
    assert cli.run(["check", log, "--report", str(out)]) == 0
    assert "Clock of the speed" in out.read_text()
    assert "log.csv: ok" in capsys.readouterr().out
    assert cli.run(["check", log, "--report", str(out)]) == 2
    assert "--force" in capsys.readouterr().err
    assert cli.run(["check", log, "--report", "-"]) == 2


def test_the_report_of_a_track_has_the_pictures_too(tmp_path):
    track = hw.vehicle.fill(save(tmp_path / "log.csv", drive()))
    text = track.report(tmp_path / "track.html").read_text()
    assert "What this rests on" in text
    assert "Bias of the yaw rate" in text
