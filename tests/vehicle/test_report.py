"""The report: what it says, that it is inert and asks nothing, and how it behaves in a browser."""

import base64
import dataclasses
import hashlib
import html
import io
import json
import re
import sys
import threading
import time
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise

import numpy as np
import pytest
from tests.vehicle.browser import CHROMIUM, Browser
from tests.vehicle.made_tracks import made_track

from halfwidth.vehicle import fill, picture
from halfwidth.vehicle.drive import simulate_drive
from halfwidth.vehicle.report import notebook, page, verdict
from halfwidth.vehicle.track import Track, gaps_of, since_fix_of

EVIL = [
    "</script><script>window.pwned=1</script>",
    "<img src=x onerror=window.pwned=1>",
    "\"'><svg onload=window.pwned=1>",
    "</style><style>*{display:none}</style>",
    "</title><base href=https://evil.test/>",
    "<!--<script>",
    "]]>&lt;\u2028\u2029\x00\ud800 ${1} {{x}} javascript:alert(1)",
]


def evil_track() -> Track:
    """Put hostile text wherever a string can go."""
    import dataclasses

    track = made_track(
        source=EVIL[1],
        method=EVIL[0],
        messages=tuple(EVIL),
        settings={text: text for text in EVIL} | {"list": EVIL, "nested": {EVIL[0]: EVIL[1]}},
        benchmark=[{EVIL[0]: EVIL[2], "mean": 1.0}],
    )
    return dataclasses.replace(track, log=dataclasses.replace(track.log, notes=tuple(EVIL)))


def simulated(rows: int, seed: int = 1) -> Track:
    """A track of a simulated drive with half-widths that grow in its tunnels."""
    truth, log = simulate_drive(duration=(rows - 1) / 10, seed=seed)
    quality = np.where(log.fixed, "fix", "bridged")
    half = 0.5 + 0.1 * since_fix_of(log.t, quality)
    lat, lon = truth.lat_deg, truth.lon_deg
    return Track(
        log.t, lat, lon, truth.alt_m, truth.azimuth_rad, truth.speed_mps, half, 0.9 * half, quality,
        since_fix_of(log.t, quality), 0.9, "em_chain", log, gaps_of(log.t, lat, lon, half, quality),
    )  # fmt: skip


class Reader(HTMLParser):
    """Collects what a page is made of."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.blocks: dict[str, list[str]] = {"script": [], "style": []}
        self.words: list[str] = []
        self._inside: str | None = None
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self._inside = tag if tag in self.blocks else None
        if self._inside:
            self.blocks[tag].append("")

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        self._inside = None

    def handle_data(self, data):
        if self._inside:
            self.blocks[self._inside][-1] += data
        else:
            self.words.append(data)

    def numbers(self) -> dict:
        return json.loads(self.blocks["script"][0])

    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


# --- what the page says ---------------------------------------------------------------------------


def test_verdict_says_how_much_was_filled_and_the_worst():
    track = made_track()
    text = verdict(track).replace("\u00a0", " ")
    time_s = sum(gap.duration_s for gap in track.gaps)
    assert text.startswith(f"3 gaps filled: {time_s:.1f} s and ")
    worst = max(gap.max_half_m for gap in track.gaps)
    assert f"± {worst:.2f} m east and north" in text
    assert "starts at 2.9 s" in text
    assert track.verdict() == verdict(track)


def test_one_gap_is_singular_and_no_gap_says_so():
    assert verdict(made_track(outages=((50, 60),), gaps=made_track().gaps[:1])).startswith("1 gap filled")
    assert "No gaps to fill" in verdict(made_track(gaps=()))


@pytest.mark.parametrize(
    ("guarantee", "words"),
    [
        (
            "credible",
            "90 % credible interval: east and north each lie inside with probability 90 %",
        ),
        ("proven", "proven bound: it holds as long as the noise stays within"),
        ("none", "an indication of size: no probability is claimed"),
    ],
)
def test_kind_of_bound_is_said_first(guarantee, words):
    text = Reader(page(made_track(guarantee=guarantee))).text().replace("\u00a0", " ")
    assert words in text
    assert text.index("gaps filled") < text.index(words) < text.index("Local metres")
    assert ("not a guarantee" in text) == (guarantee == "credible")


def test_sections_come_in_the_order_that_was_promised():
    text = page(made_track(benchmark=[{"length_s": 5.0, "mean_m": 0.4}]))
    heads = re.findall(r"<h2[^>]*>([^<]+)</h2>", text)
    assert heads == ["Map", "Along the drive", "Gaps", "The log", "Outages made in this very log", "Make it again"]


def test_table_of_gaps_has_every_gap():
    track = made_track()
    text = page(track)
    table = text[text.index("<h2>Gaps") : text.index("<h2>The log")]
    rows = re.findall(r"<tr[^>]*>(.*?)</tr>", table, re.S)[1:]
    assert len(rows) == 3
    for row, gap in zip(rows, track.gaps, strict=True):
        cells = [re.sub(r"<[^>]+>", "", cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", row, re.S)]
        assert cells[1:7] == [
            f"{gap.start:.1f}",
            f"{gap.stop:.1f}",
            f"{gap.duration_s:.1f}",
            f"{gap.distance_m:.{0 if gap.distance_m >= 10 else 1}f}",
            f"{gap.max_half_m:.2f}",
            gap.quality,
        ]


class Result:
    """What the outage benchmark gives."""

    def rows(self):
        cell = {"starts": 10, "mean_se_m": 0.1, "failed": 0}
        return [
            {"method": "linear", "length_s": 5.0, "mean_m": 1.2, "max_m": 2.0, "coverage": None, **cell},
            {"method": "linear", "length_s": 30.0, "mean_m": 17.0, "max_m": 33.0, "coverage": None, **cell},
            {"method": "em_chain", "length_s": 5.0, "mean_m": 0.17, "max_m": 0.33, "coverage": 1.0, **cell},
            {"method": "em_chain", "length_s": 30.0, "mean_m": 0.42, "max_m": 0.89, "coverage": 0.79, **cell},
        ]


def test_benchmark_of_this_very_log_is_shown_and_said_first():
    text = Reader(page(made_track(benchmark=Result()))).text().replace("\u00a0", " ")
    # (5 * 1 + 30 * 0.79) / 35
    assert "fixes hidden for 5 to 30 s and filled again, 82 % of them lay inside" in text
    assert text.index("82 %") < text.index("Local metres")
    assert "em_chain: mean / largest, m inside the 90 % interval linear: mean / largest, m" in text
    assert "30 10 0.42 / 0.89 79 % 17.00 / 33.00" in text
    assert "Tested on this very log" not in Reader(page(made_track())).text()


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        ((0.31, 0.63), "before half-widths were narrowed, to 0.31 times, so that 90 % do."),
        ((1.0, 2.04), "before half-widths were widened, up to 2.0 times, so that 90 % do."),
        ((0.5, 1.5), "before half-widths were narrowed or widened, 0.5 to 1.5 times, so that 90 % do."),
        ((0.98, 1.02), "90 % of them lay inside."),
    ],
)
def test_it_is_said_what_hidden_fixes_made_of_the_half_widths(factors, words):
    rows = [
        {"method": "em_chain", "length_s": 10.0 * k, "stretches": 9, "mean_m": 0.2, "coverage": 0.9, "inflation": f}
        for k, f in enumerate(factors, 1)
    ]
    assert words in Reader(page(made_track(benchmark=rows))).text().replace("\u00a0", " ")


def test_faults_of_the_log_are_named():
    t = np.arange(120) / 10
    text = Reader(page(made_track())).text()
    assert "looked at" in text
    assert "While reading" not in text
    track = made_track()
    track = dataclasses.replace(track, log=dataclasses.replace(track.log, notes=("2 rows dropped",)))
    assert "2 rows dropped" in Reader(page(track)).text()
    assert t.size == len(track)


def test_command_and_settings_are_there():
    text = Reader(page(made_track(), command="halfwidth fill x.csv -o y.gpx")).text()
    assert "halfwidth fill x.csv -o y.gpx" in text
    assert "context s 60" in text.replace("\n", "")
    own = Reader(page(made_track(source="my drive.csv"))).text()
    assert "halfwidth fill 'my drive.csv' -o track.gpx --report report.html --method em_chain --level 0.9" in own


def test_same_track_same_page():
    assert page(made_track()) == page(made_track())


def test_numbers_for_the_script_are_those_of_the_track():
    track = simulated(2000)
    numbers = Reader(page(track)).numbers()
    assert np.allclose(np.cumsum(numbers["t"]) / 1000, track.t_s, atol=6e-4)
    north = -np.cumsum(numbers["y"]) * numbers["unit"]
    assert np.allclose(numbers["lat"] + north / numbers["northm"], track.lat_deg, atol=1e-7)
    east = np.cumsum(numbers["x"]) * numbers["unit"]
    assert np.allclose(numbers["lon"] + east / numbers["eastm"], track.lon_deg, atol=2e-7)
    assert np.allclose(np.array(numbers["e"]) / 100, track.east_half_m, atol=6e-3)
    spelled = "".join(kind * count for kind, count in numbers["q"])
    assert spelled == "".join({"fix": "f", "bridged": "b"}[q] for q in track.quality)
    for (a, b), gap in zip(numbers["gaps"], track.gaps, strict=True):
        assert (track.t_s[a], track.t_s[b]) == (gap.start, gap.stop)


# --- odd tracks -----------------------------------------------------------------------------------


def standing_still() -> Track:
    same = np.full(120, 50.0)
    return made_track(lat_deg=same, lon_deg=same, azimuth_rad=np.full(120, np.nan))


def one_row() -> Track:
    from halfwidth.vehicle.log import Log

    one, nothing = np.ones(1), np.full(1, np.nan)
    log = Log(t=[0.0], lat_deg=[50.0], lon_deg=[14.0])
    return Track(0 * one, 50 * one, 14 * one, nothing, nothing, nothing, one, one, ["fix"], 0 * one, 0.9, "x", log)


def nothing_known() -> Track:
    nothing = np.full(120, np.nan)
    return made_track(height=False, azimuth_rad=nothing, speed_mps=nothing)


ODD = {
    "one row": one_row,
    "standing still": standing_still,
    "nothing but positions": nothing_known,
    "no gaps": lambda: made_track(outages=(), quality=np.full(120, "fix"), gaps=()),
    "no fix at all": lambda: made_track(quality=np.full(120, "extrapolated"), since_fix_s=np.full(120, np.nan)),
    "date line": lambda: made_track(lon=179.9999),
    "longitude 359.9": lambda: made_track(lon=359.999),
    "near the pole": lambda: made_track(lat=89.5),
    "unix time": lambda: made_track(t_s=1.7e9 + np.arange(120) / 10, gaps=()),
    "negative time": lambda: made_track(t_s=np.arange(120) / 10 - 300, gaps=()),
    "half-widths of nought": lambda: made_track(east_half_m=np.zeros(120), north_half_m=np.zeros(120)),
    "half-widths of 1000 km": lambda: made_track(east_half_m=np.full(120, 1e6)),
    "driving backwards": lambda: made_track(speed_mps=np.full(120, -3.0)),
    "hostile": evil_track,
}


@pytest.mark.parametrize("name", ODD)
def test_odd_tracks_have_a_page(name):
    text = page(ODD[name]())
    reader = Reader(text)
    assert reader.numbers()["t"]
    drawn = re.sub(r"<script.*?</script>", "", text, flags=re.S)
    for wrong in ("nan", "inf"):
        assert not re.search(rf'd="[^"]*{wrong}', drawn)
        assert not re.search(rf">-?{wrong}\b", drawn)
    assert "-0<" not in drawn
    notebook(ODD[name]())


# --- size -----------------------------------------------------------------------------------------


def test_page_of_6000_points_is_small_and_quick():
    track = simulated(6000)
    start = time.process_time()
    text = page(track)
    assert time.process_time() - start < 1.5
    assert len(text.encode()) <= 1_500_000


@pytest.mark.parametrize("many", ["rows", "gaps"])
def test_page_of_a_huge_track_is_bounded(many):
    if many == "rows":
        track = simulated(40_000)
    else:
        track = made_track(60_000, outages=tuple((10 * k + 5, 10 * k + 8) for k in range(5900)))
    text = page(track)
    assert len(text.encode()) <= 1_500_000
    assert f"of {len(track):,} rows, gaps first" in text
    assert ("The 500 known worst of" in text) == (many == "gaps")


def test_a_long_list_of_gaps_starts_with_the_worst():
    track = made_track(1000, outages=tuple((10 * k + 3, 10 * k + 4 + k % 3) for k in range(60)))
    text = page(track)
    assert "The 20 known worst." in text
    assert f"All {len(track.gaps)} gaps" in text
    assert "The 20 known worst." not in page(made_track())


def test_thinning_keeps_the_ends_of_gaps_and_the_worst_row():
    track = simulated(20_000)
    rows = picture.shown_rows(track, 3000)
    assert rows.size < 4000
    assert {0, 19_999, int(np.argmax(track.half_m))} <= set(rows.tolist())
    for gap in track.gaps:
        first, stop = track.rows_of(gap)
        assert {first + 1, stop - 2} <= set(rows.tolist())
    inside = np.isin(rows, np.flatnonzero(track.quality != "fix"))
    assert inside.mean() > 0.3  # gaps are drawn finer than the rest


def test_pauses_of_the_log_are_named_and_not_drawn_across():
    t = np.arange(120) / 10 + np.where(np.arange(120) >= 70, 45.0, 0.0)
    text = page(made_track(t_s=t, gaps=(), outages=(), quality=np.full(120, "fix")))
    assert "the log has no rows for 45.1 s from 6.9 s: nothing is filled there" in Reader(text).text().replace(
        "\u00a0", " "
    )
    assert re.search(r'class="way" d="([^"]*)"', text)[1].count("M") == 2
    assert re.search(r'id="l-speed" d="([^"]*)"', text)[1].count("M") == 2
    assert "has no rows" not in page(made_track())


def test_worst_half_width_beyond_the_last_fix_is_said_so():
    track = made_track(gaps=made_track().gaps[-1:])
    assert verdict(track).replace("\u00a0", " ").endswith("1 s after the last fix.")


# --- drawing --------------------------------------------------------------------------------------


def test_round_steps():
    assert [picture.round_step(x) for x in (0.7, 1.0, 1.1, 3, 6, 90)] == [1, 1, 2, 5, 10, 100]
    assert picture.steps(0, 1, 4).tolist() == pytest.approx([0, 0.5, 1])


def test_limits_and_legend_cover_the_half_widths():
    half = np.array([0.3, 4.0])
    limits = picture.limits_of(half)
    assert limits == [0.5, 1, 2]
    assert picture.legend_of(limits) == ["below 0.5 m", "0.5 to 1 m", "1 to 2 m", "above 2 m"]
    assert len(picture.limits_of(np.array([0.01, 5000.0]))) == 5
    assert picture.limits_of(np.array([1.5, 1.6])) == []
    assert picture.limits_of(np.array([1.9, 3.35])) == [2, 2.5, 3]
    assert [picture.colour_of(k, 4) for k in range(4)] == [0, 2, 3, 5]


def places(path: str) -> np.ndarray:
    """Follow a path of one move and relative steps."""
    move, steps = path.removeprefix("M").split("l")
    points = [move.split(","), *(step.split(",") for step in steps.split())]
    return np.cumsum(np.array(points, dtype=float), axis=0)


def test_line_gives_the_points_back():
    x, y = np.array([3.2, 3.3, 10.6, -4.0]), np.array([0.0, 0.0, 2.0, 2.0])
    assert places(picture.line(x, y)).tolist() == [[3, 0], [11, 2], [-4, 2]]
    assert picture.line([], []) == ""
    assert picture.line([1], [2]) == "M1,2l0,0"


def test_plane_is_metric_and_north_is_up():
    track = made_track()
    plane, view = picture.plane_of(track)
    x, y = plane.units(track.lat_deg, track.lon_deg)
    drawn = np.hypot(np.diff(x), np.diff(y)) * plane.unit_m
    assert drawn == pytest.approx(1.0, rel=3e-3)  # 10 m/s at 10 Hz
    assert plane.units(track.lat_deg.max(), track.lon_deg[0])[1] < plane.units(track.lat_deg.min(), track.lon_deg[0])[1]
    assert view.x < x.min() < x.max() < view.x + view.width
    assert view.y < y.min() < y.max() < view.y + view.height


def test_chart_keeps_extremes_and_breaks_at_unknown_values():
    t = np.arange(100_000) / 10
    y = np.sin(t / 100)
    y[54_321] = 7.0
    path = picture.chart_path(t, y, 0, t[-1], -1, 8)
    assert len(path) < 30_000
    assert places(path)[:, 1].min() == pytest.approx(400 * (1 - 8 / 9), abs=1)
    y[500:600] = np.nan
    assert picture.chart_path(t, y, 0, t[-1], -1, 8).count("M") == 2
    assert picture.chart_path(t, np.full(t.size, np.nan), 0, 1, 0, 1) == ""


def test_azimuth_breaks_at_north_instead_of_crossing_the_chart():
    t = np.arange(4.0)
    assert picture.turning_path(t, np.array([350.0, 359.0, 3.0, 10.0]), 0, 3).count("M") == 2


# --- inert and alone ------------------------------------------------------------------------------


@pytest.mark.parametrize("track", [made_track, evil_track])
def test_page_is_inert(track):
    reader = Reader(page(track()))
    names = [tag for tag, _ in reader.tags]
    assert names.count("script") == 2
    assert names.count("style") == 1
    assert not {"base", "iframe", "object", "embed", "form", "img", "image", "use", "foreignobject"} & set(names)
    for tag, attributes in reader.tags:
        for name, value in attributes.items():
            assert not name.startswith("on"), (tag, name)
            assert name != "style", "the policy forbids style attributes"
            if name in ("href", "src", "xlink:href", "action"):
                assert value in ("data:,", "#map-section"), value
    assert "@import" not in reader.blocks["style"][0]
    assert "url(" not in reader.blocks["style"][0]


@pytest.mark.parametrize("track", [made_track, evil_track])
def test_policy_names_exactly_our_script_and_style(track):
    text = page(track())
    (policy,) = [a["content"] for tag, a in Reader(text).tags if a.get("http-equiv") == "Content-Security-Policy"]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    blocks = Reader(text).blocks
    for kind, content in (("script-src", blocks["script"][1]), ("style-src", blocks["style"][0])):
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert rules[kind] == f"'sha256-{digest}'"
    assert rules["default-src"] == "'none'"
    assert rules["base-uri"] == rules["form-action"] == "'none'"
    assert "unsafe" not in policy
    assert text.index("Content-Security-Policy") < text.index("<style") < text.index("<script")


def test_hostile_words_are_shown_as_they_are():
    words = Reader(page(evil_track())).text()
    assert EVIL[1] in words
    assert "window.pwned=1</script>" in words


def test_hostile_words_are_inert_in_notebooks():
    tags = [tag for tag, _ in Reader(notebook(evil_track())).tags]
    assert "script" not in tags
    assert "img" not in tags
    assert made_track()._repr_html_() == notebook(made_track())
    assert html.escape("monday.csv") in notebook(made_track())


def test_report_is_written_in_one_step(tmp_path, monkeypatch):
    path = tmp_path / "a.html"
    assert made_track().report(path) == path
    before = path.read_bytes()

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("halfwidth.store.os.fsync", fail)
    with pytest.raises(OSError, match="No space"):
        made_track(60).report(path)
    assert path.read_bytes() == before


def test_report_to_standard_output(monkeypatch):
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw))
    made_track().report("-")
    assert raw.getvalue().startswith(b"<!DOCTYPE html>")


# --- in a browser ---------------------------------------------------------------------------------

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
pytestmark = pytest.mark.xdist_group("browser")

SHOWN = "[...document.querySelectorAll('{}')].filter(e => e.getBoundingClientRect().width > 0).length"
BOX = "document.getElementById('map').getAttribute('viewBox').split(' ').map(Number)"


@pytest.fixture(scope="module")
def browser():
    browser = Browser()
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A simulated drive's track and its page."""
    track, path = simulated(6000), tmp_path_factory.mktemp("page") / "drive.html"
    track.report(path)
    return track, path


@needs_browser
def test_page_draws_and_asks_nothing(browser, drive):
    track, path = drive
    start = time.monotonic()
    browser.open(path)
    assert time.monotonic() - start < 10
    assert browser.complaints() == []
    assert browser.requests() == [path.as_uri()]
    assert browser.run("document.documentElement.dataset.ready") == "yes"
    assert browser.run("document.querySelectorAll('#filled > g').length") == len(track.gaps)
    assert browser.run("document.querySelector('.way').getTotalLength()") > 1000
    assert browser.run("document.querySelector('.way').getBoundingClientRect().width") > 300
    assert browser.run(SHOWN.format(".pin")) == 3
    for line in ("l-speed", "l-azimuth", "l-east", "l-north"):
        assert browser.run(f"document.getElementById('{line}').getBoundingClientRect().width") > 500


@needs_browser
@pytest.mark.parametrize("name", ODD)
def test_odd_tracks_open_without_a_complaint(browser, tmp_path, name):
    ODD[name]().report(tmp_path / "odd.html")
    browser.open(tmp_path / "odd.html")
    assert browser.complaints() == []
    assert browser.requests() == [(tmp_path / "odd.html").as_uri()]
    assert browser.run("document.documentElement.dataset.ready") == "yes"
    assert browser.run("typeof window.pwned") == "undefined"
    assert browser.run("document.querySelectorAll('script').length") == 2


@needs_browser
def test_hostile_name_is_a_heading_and_nothing_else(browser, tmp_path):
    evil_track().report(tmp_path / "evil.html")
    browser.open(tmp_path / "evil.html")
    assert EVIL[1] in browser.run("document.querySelector('h1').textContent")
    assert browser.run("document.querySelectorAll('img, iframe, base, svg[onload]').length") == 0
    assert browser.run(SHOWN.format("section")) == 6  # the hostile style hid nothing


@needs_browser
def test_policy_stops_what_gets_in_anyway(browser, drive):
    browser.open(drive[1])
    browser.run(
        """(() => { window.blocked = [];
        document.addEventListener('securitypolicyviolation', e => blocked.push(e.effectiveDirective));
        const s = document.createElement('script');
        try { s.textContent = 'window.pwned = 1'; document.body.append(s); } catch (e) { blocked.push('trusted'); }
        const i = document.createElement('img'); i.src = 'https://evil.test/a.png'; document.body.append(i);
        fetch('https://evil.test/').catch(() => 0); })()"""
    )
    browser.settle()
    assert browser.run("typeof window.pwned") == "undefined"
    assert {"img-src", "connect-src"} <= set(browser.run("blocked"))


@needs_browser
def test_page_asks_nothing_of_a_server_either(browser, drive):
    """Served over HTTP, where browsers look for an icon beside the page."""
    asked = []

    class Server(SimpleHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.directory = str(drive[1].parent)
            super().do_GET()

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Server) as server:
        serving = threading.Thread(target=server.serve_forever)
        serving.start()
        browser.events.clear()
        browser("Page.navigate", url=f"http://127.0.0.1:{server.server_port}/{drive[1].name}")
        browser.settle(0.5)
        complaints = browser.complaints()
        server.shutdown()
        serving.join()
    assert asked == [f"/{drive[1].name}"]
    assert complaints == []
    assert browser.run("document.documentElement.dataset.ready") == "yes"


@needs_browser
def test_scale_bar_is_true(browser, drive):
    browser.open(drive[1])
    for _ in range(3):
        label, share = browser.run(
            "[document.getElementById('barlength').textContent, document.getElementById('bar').getBoundingClientRect()"
            ".width / document.getElementById('map').getBoundingClientRect().width]"
        )
        size, unit = label.split()
        metres = float(size) * (1000 if unit == "km" else 1)
        numbers = browser.run("JSON.parse(document.getElementById('data').textContent).unit")
        assert share == pytest.approx(metres / (browser.run(BOX)[2] * numbers), rel=0.02)
        browser.run("document.getElementById('closer').click()")


@needs_browser
def test_keyboard_reaches_everything(browser, drive):
    browser.open(drive[1])
    reached, rings = [], []
    for _ in range(60):
        browser.press("Tab")
        name = browser.run(
            "(e => e.id || e.dataset.gap && 'gap' || e.dataset.layer || e.className || e.tagName)(document.activeElement)"
        )
        rings.append(browser.run("getComputedStyle(document.activeElement).outlineStyle"))
        reached.append(name)
    assert {"skip", "frame", "closer", "wider", "all", "previous", "next", "when", "gap"} <= set(reached)
    assert {"fixes", "bands", "filled", "grid", "SUMMARY", "scroll"} <= set(reached)
    assert "none" not in [r for r, name in zip(rings, reached, strict=True) if name not in ("BODY", "HTML")]


@needs_browser
def test_keys_move_the_map(browser, drive):
    browser.open(drive[1])
    whole = browser.run(BOX)
    browser.run("document.getElementById('frame').focus()")
    browser.press("+")
    closer = browser.run(BOX)
    assert closer[2] == pytest.approx(0.7 * whole[2])
    browser.press("ArrowRight")
    browser.press("ArrowUp")
    moved = browser.run(BOX)
    assert moved[0] > closer[0]
    assert moved[1] < closer[1]
    browser.press("n")
    gap = browser.run(BOX)
    assert gap[2] < 0.5 * whole[2]
    assert "bridged" in browser.run("document.getElementById('now').textContent")
    browser.press("p")
    assert browser.run(BOX) != gap
    before = browser.run("document.getElementById('when').value")
    browser.press(".")
    assert int(browser.run("document.getElementById('when').value")) == int(before) + 1
    browser.press("0")
    assert browser.run(BOX) == pytest.approx(whole)
    assert browser.complaints() == []


@needs_browser
def test_slider_reads_the_track_aloud(browser, drive):
    track, path = drive
    browser.open(path)
    browser.run(
        "(s => { s.value = 100; s.dispatchEvent(new Event('input')); s.focus(); })(document.getElementById('when'))"
    )
    browser.press("ArrowRight")
    words = browser.run("document.getElementById('when').getAttribute('aria-valuetext')")
    assert words == browser.run("document.getElementById('now').textContent")
    assert words.startswith("10.1 s · fix")
    assert f"± {track.east_half_m[101]:.2f} m east" in words
    lat, lon = re.search(r"(-?[\d.]+)°, (-?[\d.]+)°", words).groups()
    assert float(lat) == pytest.approx(track.lat_deg[101], abs=2e-6)
    assert float(lon) == pytest.approx(track.lon_deg[101], abs=2e-6)


@needs_browser
def test_pointer_reads_map_and_charts(browser, drive):
    track, path = drive
    browser.open(path, height=3000)
    first, stop = track.rows_of(track.gaps[0])
    middle = (first + stop) // 2
    spot = browser.run(
        f"""(() => {{ const d = JSON.parse(document.getElementById('data').textContent); let x = 0, y = 0;
        for (let k = 0; k <= {middle}; k++) {{ x += d.x[k]; y += d.y[k]; }}
        const b = document.getElementById('map').getBoundingClientRect(), v = {BOX};
        return [b.left + (x - v[0]) / v[2] * b.width, b.top + (y - v[1]) / v[3] * b.height]; }})()"""
    )
    browser.mouse("mouseMoved", *spot)
    browser.settle()
    words = browser.run("document.getElementById('now').textContent")
    assert "bridged" in words
    assert float(words.split()[0]) == pytest.approx(track.t_s[middle], abs=1.0)
    left, top, wide = browser.run(
        "(b => [b.left, b.top + 40, b.width])(document.querySelector('[data-chart=half] svg').getBoundingClientRect())"
    )
    browser.mouse("mouseMoved", left + wide / 2, top)
    browser.settle()
    words = browser.run("document.getElementById('now').textContent")
    assert float(words.split()[0]) == pytest.approx(track.t_s[-1] / 2, abs=1.0)
    assert browser.run("document.querySelectorAll('.plot .now').length") == 3


@needs_browser
def test_drag_and_wheel_move_the_map(browser, drive):
    browser.open(drive[1])
    x, y = browser.run(
        "(b => [b.left + b.width / 2, b.top + b.height / 2])(document.getElementById('map').getBoundingClientRect())"
    )
    whole = browser.run(BOX)
    browser.mouse("mouseWheel", x, y, deltaX=0, deltaY=0)
    assert browser.run(BOX) == whole
    browser.mouse("mousePressed", x, y, button="left", clickCount=1)
    browser.mouse("mouseMoved", x + 100, y, button="left", buttons=1)
    browser.mouse("mouseReleased", x + 100, y, button="left", clickCount=1)
    browser.settle()
    assert browser.run(BOX)[0] < whole[0]
    browser.mouse("mouseWheel", x, y, deltaX=0, deltaY=-300)
    browser.settle()
    assert browser.run(BOX)[2] < whole[2]


@needs_browser
def test_showing_a_gap_looks_closer_in_map_and_charts(browser, drive):
    track, path = drive
    browser.open(path)
    whole, line = browser.run(BOX), browser.run("document.getElementById('l-speed').getAttribute('d')")
    browser.run("document.querySelectorAll('td button')[1].click()")
    assert browser.run(BOX)[2] < whole[2]
    ticks = [
        float(v) for v in browser.run("[...document.querySelectorAll('.axis')[0].children].map(e => e.textContent)")
    ]
    gap = track.gaps[1]
    assert min(ticks) < gap.start + 5
    assert max(ticks) > gap.stop - 5
    assert max(ticks) - min(ticks) < 3 * gap.duration_s
    assert browser.run("document.getElementById('l-speed').getAttribute('d')") != line
    browser.run("document.getElementById('all').click()")
    assert browser.run("document.getElementById('l-speed').getAttribute('d')") == line
    assert browser.run(BOX) == pytest.approx(whole)
    assert browser.complaints() == []


@needs_browser
def test_tip_stays_on_the_map(browser, drive):
    browser.open(drive[1], width=360, height=800)
    for row in range(0, 6000, 400):
        browser.run(
            f"(s => {{ s.value = {row}; s.dispatchEvent(new Event('input')); }})(document.getElementById('when'))"
        )
        inside = browser.run(
            "(([a, b]) => a.left >= b.left && a.right <= b.right && a.top >= b.top && a.bottom <= b.bottom)"
            "(['tip', 'map'].map(id => document.getElementById(id).getBoundingClientRect()))"
        )
        assert inside, row


@needs_browser
def test_layers_can_be_hidden(browser, drive):
    browser.open(drive[1])
    for layer in ("fixes", "bands", "filled", "grid"):
        browser.run(f"document.querySelector('[data-layer={layer}]').click()")
        assert browser.run(f"getComputedStyle(document.getElementById('{layer}')).display") == "none"


@needs_browser
@pytest.mark.parametrize("width", [320, 390, 768, 1600])
def test_no_sideways_scrolling(browser, drive, width):
    browser.open(drive[1], width=width, height=800)
    assert browser.run("document.scrollingElement.scrollWidth") <= width
    assert browser.run("document.getElementById('map').getBoundingClientRect().height") > 180


CONTRAST = """(() => {
  const probe = document.createElement('span'); document.body.append(probe);
  const value = name => { probe.style.color = `var(${name})`; return getComputedStyle(probe).color.match(/[\\d.]+/g).map(Number); };
  const light = c => { const [r, g, b] = c.slice(0, 3).map(v => (v /= 255) <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4);
    return .2126 * r + .7152 * g + .0722 * b; };
  const ratio = (a, b) => { const [x, y] = [light(value(a)), light(value(b))].sort((p, q) => q - p); return (x + .05) / (y + .05); };
  const out = {};
  for (const ink of ['--ink', '--soft', '--accent', '--warn', '--good', '--bad']) out[ink] = Math.min(ratio(ink, '--card'), ratio(ink, '--paper'));
  for (const line of ['--h0', '--h1', '--h2', '--h3', '--h4', '--h5', '--fix', '--way', '--second'])
    out[line] = Math.min(ratio(line, '--map'), ratio(line, '--card'));
  probe.remove(); return out; })()"""


@needs_browser
@pytest.mark.parametrize("dark", [False, True])
def test_colours_stand_out_in_light_and_dark(browser, drive, dark):
    """At least 4.5 to 1 for words and 3 to 1 for lines, but the mildest half-width, which may have 2.5."""
    browser.open(drive[1], dark=dark)
    paper = browser.run("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
    assert (max(paper) < 60) == dark
    for name, ratio in browser.run(CONTRAST).items():
        floor = 2.5 if name == "--h0" else 3.0
        if name in ("--ink", "--soft", "--accent", "--warn", "--good", "--bad"):
            floor = 4.5
        assert ratio >= floor, (name, ratio)


@needs_browser
def test_half_width_colours_differ_in_lightness(browser, drive):
    """Who sees no hues can still rank them: lightness falls, or rises in the dark, step by step."""
    for dark in (False, True):
        browser.open(drive[1], dark=dark)
        shades = [browser.run(CONTRAST)[f"--h{k}"] for k in range(6)]
        assert all(b > 1.1 * a for a, b in pairwise(shades)), shades


@needs_browser
def test_paper_shows_what_matters_and_no_controls(browser, drive, tmp_path):
    browser.open(drive[1])
    pdf = browser.paper(tmp_path / "a.pdf")
    assert pdf.startswith(b"%PDF")
    assert 1 <= len(re.findall(rb"/Type\s*/Page\b", pdf)) <= 6
    browser.open(drive[1], media="print")
    assert browser.run(SHOWN.format(".tools, .cursor, .layers, details, td button")) == 0
    assert browser.run(SHOWN.format("#map, .plot, table, .bar, .pin")) >= 8
    browser.look()


@needs_browser
def test_page_stands_without_its_script(browser, drive):
    browser("Emulation.setScriptExecutionDisabled", value=True)
    try:
        browser.open(drive[1])
        tree = browser("DOM.getDocument", depth=1)["root"]["nodeId"]
        seen = {}
        for name in (".way", "#map", ".verdict", ".bar", ".tools", ".cursor", ".p0"):
            node = browser("DOM.querySelector", nodeId=tree, selector=name)["nodeId"]
            try:
                seen[name] = browser("DOM.getBoxModel", nodeId=node)["model"]["width"]
            except AssertionError:
                seen[name] = 0
        assert seen["#map"] > 900
        assert seen[".verdict"] > 300
        assert seen[".bar"] > 20
        assert seen[".p0"] > 10
        assert seen[".tools"] == seen[".cursor"] == 0
    finally:
        browser("Emulation.setScriptExecutionDisabled", value=False)


def test_what_was_left_out_is_among_the_faults_of_the_log():
    _, log = simulate_drive(duration=120.0, rate=5.0, fix_rate=5.0, outages=((50.0, 60.0),), seed=3)
    speed = log.speed_mps.copy()
    speed[200] = 60.0
    track = fill(dataclasses.replace(log, speed_mps=speed))
    assert track.log.speed_mps[200] == 60.0
    text = Reader(page(track)).text().replace("\u00a0", " ")
    assert "1 fault found" in text
    assert text.count("1 sample of the speed that no car can have had") == 2  # a message, and a point of the log


def test_kinds_of_hidden_stretches_are_told_apart_and_settings_have_rows():
    row = {"length_s": 5.0, "stretches": 9, "mean_m": 1.0, "max_m": 2.0, "coverage": 0.9, "inflation": 1.2}
    rows = [row, row | {"side": "one", "silent": ("speed", "yaw_rate"), "by": "cv"}]
    text = Reader(page(made_track(benchmark=rows))).text().replace("\n", " ")
    assert "beyond the fixes without speed and yaw rate, by cv" in text
    assert "hidden for, s stretches" in Reader(page(made_track(benchmark=[row]))).text().replace("\n", " ")
    track = made_track()
    nested = dataclasses.replace(track, settings={"sensors": {"yaw_bias_at": [[1.0, 2.0], [3.0, 4.0]], "steps": {}}})
    text = Reader(page(nested)).text().replace("\n", " ")
    assert "sensors, yaw bias at 1, 2; 3, 4" in text
