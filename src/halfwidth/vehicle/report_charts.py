"""The charts of a track's page: speed, azimuth and half-width against time, gaps shaded, tables behind."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halfwidth.vehicle import markup, picture
from halfwidth.vehicle.picture import CHART_HEIGHT, CHART_WIDTH, Floats, Rows
from halfwidth.vehicle.track import Track

#: Rows of a table behind a chart, shaded gaps and pins on the map, at most.
_BEHIND, _MOST_GAPS, _MOST_PINS = 60, 500, 20

#: Every other mark of the time axis, which narrow screens leave out.
_ODD = ("", " odd")

_COMPASS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")


def pins(track: Track) -> list[int]:
    """Choose the gaps that are numbered on the map: those known worst."""
    order = sorted(range(len(track.gaps)), key=lambda k: -track.gaps[k].max_half_m)
    return sorted(order[:_MOST_PINS])


def sampled(track: Track) -> Rows:
    """Choose the rows of the tables behind map and charts: even in time, and each gap's worst."""
    even = np.unique(np.linspace(0, len(track) - 1, min(_BEHIND, len(track))).round().astype(int))
    worst = []
    for number in pins(track):
        first, stop = track.rows_of(track.gaps[number])
        worst.append(first + int(np.argmax(track.half_m[first:stop])))
    return np.unique(np.r_[even, np.array(worst, dtype=int)]).astype(np.int64)


def layout(track: Track) -> dict[str, dict[str, Any]]:
    """Lay out the charts: what they draw, from where to where, and their marks."""
    speed = track.speed_mps[np.isfinite(track.speed_mps)]
    measured = track.log.speed_mps[np.isfinite(track.log.speed_mps)]
    both = np.r_[speed, measured]
    top = _top(float(both.max()) if both.size else 1.0)
    bottom = -_top(-float(both.min())) if both.size and both.min() < -0.05 else 0.0
    half = _top(float(track.half_m.max()))
    proven: dict[str, dict[str, Any]] = {}
    if track.proven is not None:
        sides = track.proven.half_m[np.isfinite(track.proven.half_m)]
        wide = _top(float(sides.max()) if sides.size else 1.0)
        marks = [(v, f"{v:g}") for v in picture.steps(0, wide, 4).tolist()]
        proven["proven"] = {"low": 0.0, "high": wide, "lines": [], "marks": marks}
    return {
        "speed": {
            "low": bottom,
            "high": top,
            "lines": [["speed", "l-speed"]],
            "marks": [(v, f"{v:g}") for v in picture.steps(bottom, top, 4).tolist()],
        },
        "azimuth": {
            "low": 0.0,
            "high": 360.0,
            "lines": [["azimuth", "l-azimuth"]],
            "marks": [(90.0 * k, _COMPASS[2 * k % 8]) for k in range(5)],
        },
        "half": {
            "low": 0.0,
            "high": half,
            "lines": [["east", "l-east"], ["north", "l-north"]],
            "marks": [(v, f"{v:g}") for v in picture.steps(0, half, 4).tolist()],
        },
        **proven,
    }


def _top(value: float) -> float:
    """Choose a round end for an axis that starts at nought."""
    step = picture.round_step(max(value, 1e-3) * 1.04 / 4)
    return float(np.ceil(max(value, 1e-3) * 1.04 / step) * step)


def section(track: Track, charts: Mapping[str, Mapping[str, Any]]) -> str:
    """Draw speed, azimuth and half-width against time, the gaps shaded."""
    t, t0, t1 = track.t_s, float(track.t_s[0]), float(track.t_s[-1])
    degrees = np.degrees(np.mod(track.azimuth_rad, 2 * np.pi))
    low, high = charts["speed"]["low"], charts["speed"]["high"]
    lt, lv = track.log.stream("speed_mps")
    inside = (lt >= t0) & (lt <= t1)
    raw = picture.chart_path(lt[inside], lv[inside], t0, t1, low, high)
    speed = picture.chart_path(t, track.speed_mps, t0, t1, low, high)
    top = charts["half"]["high"]
    east = picture.chart_path(t, track.east_half_m, t0, t1, 0.0, top)
    north = picture.chart_path(t, track.north_half_m, t0, t1, 0.0, top)
    turning = picture.turning_path(t, degrees, t0, t1)
    key = '<span class="key"><svg viewBox="0 0 26 8" aria-hidden="true"><path class="{}" d="M0 4h26"/></svg>{}</span>'
    figures = [
        _figure(
            track,
            "speed",
            charts,
            "Speed",
            "m/s",
            f'<path class="raw" d="{raw}"/><path class="one" id="l-speed" d="{speed}"/>',
            key.format("one", "track") + key.format("raw", "measured"),
            _behind_chart(track, ["speed, m/s"], [track.speed_mps], "{:.2f}"),
        ),
        _figure(
            track,
            "azimuth",
            charts,
            "Azimuth",
            "direction of travel",
            f'<path class="one" id="l-azimuth" d="{turning}"/>',
            "",
            _behind_chart(track, ["azimuth, °"], [degrees], "{:.1f}"),
        ),
        _figure(
            track,
            "half",
            charts,
            "Half-width",
            f"m, at level {track.level:g}",
            f'<path class="one" id="l-east" d="{east}"/><path class="two" id="l-north" d="{north}"/>',
            key.format("one", "east") + key.format("two", "north"),
            _behind_chart(
                track,
                ["± east, m", "± north, m"],
                [track.east_half_m, track.north_half_m],
                "{:.2f}",
            ),
        ),
    ]
    if track.proven is not None:
        figures.append(_proven_figure(track, charts, key))
    start = "" if markup.zero(track) == 0 else " from the first row"
    return (
        '<section aria-labelledby="chart-title">\n<h2 id="chart-title">Along the drive</h2>\n'
        f'<p class="about">Time in seconds{start}; gaps are shaded. <span class="live hide">Showing a'
        " gap zooms into its time here too; “Whole drive” returns.</span></p>\n"
        f"{''.join(figures)}</section>\n"
    )


def _proven_figure(track: Track, charts: Mapping[str, Mapping[str, Any]], key: str) -> str:
    """Draw the guaranteed band, which is no half-width and shares nothing with them but the clock."""
    assert track.proven is not None
    t, t0, t1, top = track.t_s, float(track.t_s[0]), float(track.t_s[-1]), charts["proven"]["high"]
    half = np.where(np.isfinite(track.proven.half_m), track.proven.half_m, np.nan)
    east, north = (picture.chart_path(t, half[:, k], t0, t1, 0.0, top) for k in (0, 1))
    columns = track.proven.columns
    return _figure(
        track,
        "proven",
        charts,
        "Guaranteed band",
        f"m, half of the box that must contain the vehicle; {track.proven.words}",
        f'<path class="one" d="{east}"/><path class="two" d="{north}"/>',
        key.format("one", "east") + key.format("two", "north"),
        _behind_chart(
            track,
            ["to the west, m", "to the east, m", "to the south, m", "to the north, m"],
            list(columns.values()),
            "{:.2f}",
        ),
    )


def _figure(
    track: Track,
    name: str,
    charts: Mapping[str, Mapping[str, Any]],
    title: str,
    unit: str,
    paths: str,
    key: str,
    behind: str,
) -> str:
    """Put one chart together: caption, shaded gaps, lines, marks and the table behind."""
    chart = charts[name]
    t0, t1 = float(track.t_s[0]), float(track.t_s[-1])
    scale = CHART_WIDTH / max(t1 - t0, 1e-9)
    shades = "".join(
        f'<rect class="shade" x="{(gap.start - t0) * scale:.1f}" y="0"'
        f' width="{max(gap.duration_s * scale, 1.0):.1f}" height="{CHART_HEIGHT}"'
        f' data-from="{gap.start:.3f}" data-to="{gap.stop:.3f}"/>'
        for gap in track.gaps[:_MOST_GAPS]
    )
    height = [CHART_HEIGHT * (1 - (v - chart["low"]) / (chart["high"] - chart["low"])) for v, _ in chart["marks"]]
    rules = "".join(f"M0,{h:.1f}H{CHART_WIDTH}" for h in height)
    marks = "".join(
        f'<span class="ty {name}{k}">{markup.text(label)}</span>' for k, (_, label) in enumerate(chart["marks"])
    )
    times = "".join(f'<span class="tx x{k}{_ODD[k % 2]}">{label}</span>' for k, (_, label) in enumerate(ticks(track)))
    return (
        f'<figure><figcaption>{title} <span class="unit">{markup.text(unit)}</span>{key}</figcaption>\n'
        f'<div class="plot" data-chart="{name}"><svg viewBox="0 0 {CHART_WIDTH} {CHART_HEIGHT}"'
        f' preserveAspectRatio="none" role="img" aria-label="{markup.text(title)} against time, values in the'
        f' table below">{shades}<path class="lines" d="{rules}"/>{paths}</svg>{marks}'
        f'<div class="axis">{times}</div></div>\n'
        f"{behind}</figure>\n"
    )


def ticks(track: Track) -> list[tuple[float, str]]:
    """Choose the marks of the time axis: percent of its length, and seconds."""
    t0, t1, zero = float(track.t_s[0]), float(track.t_s[-1]), markup.zero(track)
    length = max(t1 - t0, 1e-9)
    usual = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600)
    step = next((float(s) for s in usual if length / s <= 10), picture.round_step(length / 8))
    if length <= 8:
        step = picture.round_step(length / 8)
    first, last = np.ceil((t0 - zero) / step - 1e-9), np.floor((t1 - zero) / step + 1e-9)
    values = np.arange(first, last + 1) * step + 0.0  # no negative nought
    return [(100 * (v + zero - t0) / length, f"{v:.10g}") for v in values.tolist()]


def _behind_chart(track: Track, head: Sequence[str], columns: Sequence[Floats], pattern: str) -> str:
    """Give a chart's values as a table."""
    body = [
        [
            markup.moment(track, track.t_s[k]),
            *(markup.known(float(column[k]), pattern) for column in columns),
            str(track.quality[k]),
        ]
        for k in sampled(track)
    ]
    return markup.behind(["time, s", *head, "quality"], body, [len(head) + 1])
