"""The report: one HTML page on one track, that opens anywhere without a network.

The verdict comes first, then the map, the charts, the gaps, the faults of the log, the outage
benchmark of this very log, and the settings with the command that makes the page again. Everything
is drawn as SVG by `picture` before the page is opened; the script only looks closer (zoom, a moving
time, keys). All text is escaped, all numbers travel as inert JSON, and the page's own policy forbids
every request and every script and style but its own two, which it names by their SHA-256.

The same track gives the same page, byte for byte: it holds no time of writing.
"""

import base64
import hashlib
import json
import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from halfwidth import __version__
from halfwidth.store import atomic_write
from halfwidth.vehicle import picture
from halfwidth.vehicle.check import Item, check
from halfwidth.vehicle.picture import CHART_HEIGHT, CHART_WIDTH, Floats, Plane, Rows, View
from halfwidth.vehicle.track import Gap, Track, runs, steps_m

#: Rows of a table behind a chart, gaps in the table of gaps and pins on the map, at most.
_BEHIND, _MOST_GAPS, _MOST_PINS = 60, 500, 20

#: Gaps that are listed before a line that opens all of them.
_FEW_GAPS = 20

#: How the verdicts of a check look, the worst first: a sign as well as a colour.
_VERDICTS = {
    "bad": ("bad", "✗ bad"),
    "warn": ("warn", "! warning"),
    "ok": ("ok", "✓ ok"),
    "not checked": ("none", "– not checked"),
}

#: A dot and a dash of the legend.
_DOT, _DASH = "M15 6h0", "M3 6h24"

#: Width over height of the map on narrow screens.
_NARROW = 1.15

#: Every other mark of the time axis, which narrow screens leave out.
_ODD = ("", " odd")

#: Marks the row of a table that matters most.
_WORST = ' class="worst"'

_COMPASS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")


def write_report(track: Track, path: "str | os.PathLike[str]", *, command: str | None = None) -> Path:
    """Write the page of a track in one step; see `page`.

    Parameters
    ----------
    track : Track
        What to report.
    path : str or path
        Where to; ``-`` is standard output.
    command : str, optional
        The command that made the track.

    Returns
    -------
    Path
        Where it was written.
    """
    content = page(track, command=command).encode()
    with atomic_write(path) as file:
        file.write(content)
    return Path(path)


def verdict(track: Track) -> str:
    """Say in one or two sentences what was filled and how well the worst of it is known."""
    if not track.gaps:
        return (
            "No gaps to fill: every row has a fix, and each is where the receiver saw it to within"
            f" {_size(float(track.half_m.max()))} east and north."
        )
    count = len(track.gaps)
    time = sum(gap.duration_s for gap in track.gaps)
    way = sum(gap.distance_m for gap in track.gaps)
    worst = max(track.gaps, key=lambda gap: gap.max_half_m)
    filled = f"{_count(count, 'gap')} filled: {_span(time)} and {_way(way)} without a fix."
    if worst.quality == "bridged":
        where = f"in the {_span(worst.duration_s)} gap that starts at {_time(track, worst.start)}"
    elif worst.start > track.t_s[0]:
        where = f"{_span(worst.duration_s)} after the last fix"
    else:
        where = f"{_span(worst.duration_s)} before the first fix"
    return f"{filled} At worst the position is known to within {_size(worst.max_half_m)} east and north, {where}."


def kind_of_bound(track: Track) -> str:
    """Say what kind of bound the half-widths are, and what the log itself says about that."""
    share = f"{100 * track.level:g}\u00a0%"
    words = {
        "proven": (
            "proven bound",
            "it holds as long as the noise stays within the stated half-widths.",
        ),
        "credible": (
            f"{share} credible interval",
            f"east and north each lie inside with probability {share} under the model that was fitted to this log. That"
            " is not a guarantee, and an error that all fixes of the drive share cannot be seen in its log.",
        ),
        "none": ("indication of size", "no probability is claimed for it."),
    }[track.guarantee]
    return f"The bound is {_article(words[0])} {words[0]}: {words[1]}"


def page(track: Track, *, command: str | None = None) -> str:
    """Build the page of a track.

    Parameters
    ----------
    track : Track
        What to report.
    command : str, optional
        The command that made the track; without it one is put together from the track.

    Returns
    -------
    str
        A whole HTML document, the same for the same track.
    """
    plane, view = picture.plane_of(track)
    rows = picture.shown_rows(track)
    inside = track.quality != "fix"
    limits = picture.limits_of(track.half_m[inside])
    charts = _charts(track)
    numbers = _data(track, plane, view, rows, charts)
    sections = [
        _map_section(track, plane, view, rows, limits),
        _chart_section(track, charts),
        _gap_section(track, limits),
        _fault_section(track),
        _benchmark_section(track),
        _settings_section(track, command),
    ]
    style = _part("page.css") + _placing(track, plane, view, charts)
    script = _part("page.js")
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(style)}; img-src data:;"
        " base-uri 'none'; form-action 'none'; require-trusted-types-for 'script';"
        " trusted-types 'none'"
    )
    title = _title(track)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        '<meta name="referrer" content="no-referrer">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{_t(title)}: track report</title>\n<style>{style}</style>\n</head>\n<body>\n"
        '<a class="skip" href="#map-section">To the map</a>\n'
        f"<header>\n<h1>Track report · {_t(title)}</h1>\n"
        f'<p class="verdict">{_t(verdict(track))}</p>\n'
        f'<p class="kind">{_t(kind_of_bound(track))}{_t(_tested(track))}</p>\n'
        f"{_messages(track)}{_keys(track)}</header>\n"
        f"<main>\n{''.join(sections)}</main>\n"
        f"<footer>Written by halfwidth {_t(__version__)}. This page holds everything it shows and"
        " asks nothing of any network.</footer>\n"
        f'<script type="application/json" id="data">{_json(numbers)}</script>\n'
        f"<script>{script}</script>\n</body>\n</html>\n"
    )


def notebook(track: Track) -> str:
    """Give a verdict, a small map and the gaps, for notebooks."""
    plane, view = picture.plane_of(track)
    rows = picture.shown_rows(track, 1500)
    x, y = plane.units(track.lat_deg[rows], track.lon_deg[rows])
    filled = "".join(
        f'<path d="{picture.line(x[max(a - 1, 0) : b + 1], y[max(a - 1, 0) : b + 1])}"'
        ' fill="none" stroke="#d4640f" stroke-width="3" vector-effect="non-scaling-stroke"/>'
        for a, b, gap in runs(track.quality[rows] != "fix")
        if gap
    )
    shown = sorted(track.gaps, key=lambda gap: -gap.max_half_m)[:8]
    numbers = {id(gap): k for k, gap in enumerate(track.gaps)}
    body = [_gap_cells(track, gap, numbers[id(gap)]) for gap in sorted(shown, key=lambda gap: gap.start)]
    more = len(track.gaps) - len(shown)
    return (
        f"<div><p><b>{_t(_title(track))}</b>: {_t(verdict(track))}</p>"
        f'<svg viewBox="{view.box()}" width="360" role="img" aria-label="map of the track">'
        f'<path d="{picture.line(x, y)}" fill="none" stroke="#0072b2" stroke-width="1.5"'
        f' vector-effect="non-scaling-stroke"/>{filled}</svg>'
        + (_table(_GAP_HEAD, body) if body else "")
        + (f"<p>and {more} gaps with smaller half-widths</p>" if more > 0 else "")
        + "</div>"
    )


# --- words ----------------------------------------------------------------------------------------


def _t(text: object) -> str:
    """Escape a text for HTML, content or attribute; what cannot be encoded is marked."""
    plain = str(text).encode("utf-8", "replace").decode().replace("\x00", "\ufffd")
    return escape(plain, quote=True)


def _json(value: object) -> str:
    """Write JSON that cannot end its script element, whatever the strings hold."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for sign in "<>&\u2028\u2029":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


def _part(name: str) -> str:
    """Read a part of the page that comes with the package."""
    return (files("halfwidth.vehicle") / "page" / name).read_text(encoding="utf-8")


def _hash(content: str) -> str:
    """Name an inline script or style the way a content security policy does."""
    digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
    return f"'sha256-{digest}'"


def _title(track: Track) -> str:
    """Name the page after the log's file."""
    name = os.path.basename(track.log.source.rstrip("/"))
    return name if name not in ("", "-", "frame") else "a vehicle's log"


def _article(words: str) -> str:
    """Choose a or an."""
    return "an" if words[0] in "aeiou8" else "a"


def _count(number: int, word: str) -> str:
    """Write a count with its noun."""
    return f"{number:,} {word}{'' if number == 1 else 's'}"


def _size(metres: float) -> str:
    """Write a half-width: ± with two figures or so, never broken between lines."""
    return f"±\u00a0{metres:.2f}\u00a0m" if metres < 1 else f"±\u00a0{metres:,.{1 if metres < 10 else 0}f}\u00a0m"


def _span(seconds: float) -> str:
    """Write a length of time."""
    if 0 < seconds < 1:
        return f"{seconds:.2g}\u00a0s"
    if seconds < 100:
        return f"{seconds:.1f}\u00a0s".replace(".0\u00a0", "\u00a0")
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes:,}\u00a0min" + (f" {rest}\u00a0s" if rest else "")


def _way(metres: float) -> str:
    """Write a distance."""
    return f"{metres:,.0f}\u00a0m" if metres < 2000 else f"{metres / 1000:,.1f}\u00a0km"


def _zero(track: Track) -> float:
    """Choose where the page's times count from: 0, or the first row if times are absolute."""
    return float(track.t_s[0]) if abs(float(track.t_s[0])) >= 1e8 else 0.0


def _time(track: Track, t: float) -> str:
    """Write a moment of the drive."""
    return f"{t - _zero(track):,.1f}\u00a0s".replace(".0\u00a0", "\u00a0")


def _moment(track: Track, t: float) -> str:
    """Write a moment of the drive in a table."""
    return f"{t - _zero(track):,.1f}"


def _metres(value: float) -> str:
    """Write a half-width in a table."""
    return f"{value:.2f}" if value < 100 else f"{value:,.0f}"


def _known(value: float, pattern: str) -> str:
    """Write a number, or a dash where it is unknown."""
    return pattern.format(value) if np.isfinite(value) else "–"


def _table(
    head: Sequence[str],
    body: Iterable[Sequence[str]],
    *,
    caption: str = "",
    words: Iterable[int] = (),
    marked: Iterable[int] = (),
) -> str:
    """Write a table of finished cells; `words` are its left-aligned columns, `marked` its rows."""
    left, bold = set(words), set(marked)

    def cells(row: Sequence[str], tag: str) -> str:
        scope = ' scope="col"' if tag == "th" else ""
        kinds = [' class="w"' if k in left else "" for k in range(len(row))]
        return "".join(f"<{tag}{kind}{scope}>{cell}</{tag}>" for kind, cell in zip(kinds, row, strict=True))

    lines = [f"<tr{_WORST if k in bold else ''}>{cells(row, 'td')}</tr>\n" for k, row in enumerate(body)]
    named = f"<caption>{caption}</caption>" if caption else ""
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="table"><table>{named}'
        f"<thead><tr>{cells(head, 'th')}</tr></thead><tbody>\n{''.join(lines)}</tbody></table></div>\n"
    )


# --- the head -------------------------------------------------------------------------------------


def _messages(track: Track) -> str:
    """List what a reader must know."""
    pauses = picture.pauses_of(track.t_s)
    known = [
        *track.messages,
        *(
            f"the log has no rows for {_span(float(track.t_s[k + 1] - track.t_s[k]))} from"
            f" {_time(track, float(track.t_s[k]))}: nothing is filled there"
            for k in pauses[:5].tolist()
        ),
    ]
    if pauses.size > 5:
        known.append(f"and {_count(int(pauses.size) - 5, 'pause')} more of this kind")
    if not known:
        return ""
    items = "".join(f"<li>{_t(message)}</li>" for message in known)
    return f'<ul class="flags">{items}</ul>\n'


def _keys(track: Track) -> str:
    """Give the figures of the verdict once more, in a row."""
    total = float(track.t_s[-1] - track.t_s[0])
    fixed = int(np.count_nonzero(track.quality == "fix"))
    way = float(steps_m(track.lat_deg, track.lon_deg).sum())
    figures = [
        ("drive", _span(total), _way(way)),
        ("with a fix", f"{100 * fixed / len(track):.3g} %", f"{fixed:,} of {len(track):,} rows"),
        ("gaps filled", f"{len(track.gaps):,}", f"{_span(sum(gap.duration_s for gap in track.gaps))} in all"),
    ]
    if track.gaps:
        longest = max(track.gaps, key=lambda gap: gap.duration_s)
        worst = max(track.gaps, key=lambda gap: gap.max_half_m)
        figures += [
            ("longest gap", _span(longest.duration_s), _way(longest.distance_m)),
            ("worst half-width", _size(worst.max_half_m), f"gap from {_time(track, worst.start)}"),
        ]
    if fixed:
        at_fix = track.half_m[track.quality == "fix"]
        figures.append(("at fixes", _size(float(np.median(at_fix))), f"at most {_size(float(at_fix.max()))[2:]}"))
    items = "".join(
        f'<div><dt>{_t(name)}</dt><dd>{_t(value)} <span class="sub">{_t(more)}</span></dd></div>'
        for name, value, more in figures
    )
    return f'<dl class="keys">{items}</dl>\n'


# --- the map --------------------------------------------------------------------------------------


def _pins(track: Track) -> list[int]:
    """Choose the gaps that are numbered on the map: those known worst."""
    order = sorted(range(len(track.gaps)), key=lambda k: -track.gaps[k].max_half_m)
    return sorted(order[:_MOST_PINS])


def _pin_places(track: Track, plane: Plane) -> dict[int, tuple[float, float]]:
    """Place the numbers beside the middle of their gaps, in units."""
    places = {}
    for number in _pins(track):
        first, stop = track.rows_of(track.gaps[number])
        middle = (first + stop) // 2 if stop - first > 2 else first
        middle = min(middle, len(track) - 1)
        x, y = plane.units(track.lat_deg[middle], track.lon_deg[middle])
        places[number] = (float(x), float(y))
    return places


def _map_section(track: Track, plane: Plane, view: View, rows: Rows, limits: Sequence[float]) -> str:
    """Draw the map with its tools, legend and the time that moves."""
    length, _ = picture.scale_bar(view, plane)
    drawn = picture.map_svg(track, plane, view, rows, limits)
    pins = "".join(
        f'<button type="button" class="pin p{number}" data-gap="{number}"'
        f' aria-label="gap {number + 1}: show">{number + 1}</button>'
        for number in _pins(track)
    )
    count = len(limits) + 1
    classes = [
        (f"h{picture.colour_of(k, count)}", f"filled, half-width {name}")
        for k, name in enumerate(picture.legend_of(limits))
    ]
    if track.gaps and not limits:
        classes = [("h5", f"filled, half-width {_size(track.gaps[0].max_half_m)[2:]}")]
    stroke = '<svg viewBox="0 0 30 12" aria-hidden="true"><path class="{}" d="{}"/></svg>{}'
    items = [
        stroke.format("fix", _DOT, "measured fix"),
        stroke.format("way", _DASH, "track"),
        *(stroke.format(name, _DASH, words) for name, words in classes if track.gaps),
    ]
    if any(gap.quality == "extrapolated" for gap in track.gaps):
        items.append(stroke.format("dash", _DASH, "extrapolated: fixes on one side only"))
    if track.gaps:
        items.append(stroke.format("band", _DASH, "half-width across the way"))
    items += [stroke.format("ends", _DOT, "start"), stroke.format("ends square", "M15 6h.1", "end")]
    step = picture.round_step(view.width * plane.unit_m / 12)
    tools = [("closer", "+", "Zoom in"), ("wider", "−", "Zoom out"), ("all", "Whole drive", "")]
    tools += [("previous", "‹ Gap", "Previous gap"), ("next", "Gap ›", "Next gap")]
    buttons = "".join(_tool(track, *tool) for tool in tools)
    thinned = (
        ""
        if rows.size == len(track)
        else f" The page shows {rows.size:,} of {len(track):,} rows, gaps first; the track file has all."
    )
    return (
        '<section id="map-section" aria-labelledby="map-title">\n<h2 id="map-title">Map</h2>\n'
        '<p class="about">Local metres, north up, grid of <span id="gridsize">'
        f'{_length(step)}</span>.{thinned} <span class="live hide">Drag to move; click, then turn the'
        " wheel to zoom; keys: arrows, + − 0, n and p for the next and previous gap, comma and full"
        " stop to step in time.</span></p>\n"
        f'<div class="tools live hide">{buttons}</div>\n'
        '<div class="map" id="frame" tabindex="0" role="application" aria-roledescription="map"'
        f' aria-label="{_t(_map_words(track))}">\n'
        f'<svg id="map" viewBox="{view.box()}" aria-hidden="true">{drawn}'
        '<rect id="box" class="live hide"/><path id="here" class="live hide"/></svg>\n'
        f'{pins}<div class="tip live hide" id="tip" aria-hidden="true"></div>\n'
        '<div class="north" aria-hidden="true"><svg viewBox="0 0 20 26"><path d="M10 0l8 26-8-6-8 6z"/>'
        "</svg>N</div>\n"
        f'<div class="bar" id="bar"><span id="barlength">{_length(length)}</span></div>\n</div>\n'
        f'<ul class="legend">{"".join(f"<li>{item}</li>" for item in items)}</ul>\n'
        '<div class="cursor live hide"><label for="when">moment</label>'
        f'<input type="range" id="when" min="0" max="{rows.size - 1}" step="1" value="0">'
        '<output id="now" for="when"></output></div>\n'
        '<fieldset class="layers live hide"><legend>Show</legend>'
        '<label><input type="checkbox" data-layer="fixes" checked> fixes</label>'
        '<label><input type="checkbox" data-layer="bands" checked> half-widths</label>'
        '<label><input type="checkbox" data-layer="filled" checked> filled gaps</label>'
        '<label><input type="checkbox" data-layer="grid" checked> grid</label></fieldset>\n'
        f"{_behind_map(track)}</section>\n"
    )


def _tool(track: Track, name: str, sign: str, words: str) -> str:
    """Make a button of the map; those for gaps are hidden where there is none."""
    kind = "tool hide" if name in ("previous", "next") and not track.gaps else "tool"
    label = f' aria-label="{words}"' if words else ""
    return f'<button type="button" class="{kind}" id="{name}"{label}>{sign}</button>'


def _length(metres: float) -> str:
    """Write a round length."""
    return f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"


def _map_words(track: Track) -> str:
    """Say what the map shows to who cannot see it."""
    return (
        f"Map of the track: {_count(len(track.gaps), 'gap')} filled, listed in the table of gaps"
        " below. Use the moment slider to read positions one by one."
    )


def _sampled(track: Track) -> Rows:
    """Choose the rows of the tables behind map and charts: even in time, and each gap's worst."""
    even = np.unique(np.linspace(0, len(track) - 1, min(_BEHIND, len(track))).round().astype(int))
    worst = []
    for number in _pins(track):
        first, stop = track.rows_of(track.gaps[number])
        worst.append(first + int(np.argmax(track.half_m[first:stop])))
    return np.unique(np.r_[even, np.array(worst, dtype=int)]).astype(np.int64)


def _behind(head: Sequence[str], body: Iterable[Sequence[str]], words: Iterable[int]) -> str:
    """Hide a table behind a line that opens it."""
    return f"<details><summary>Table behind this picture</summary>{_table(head, body, words=words)}</details>\n"


def _behind_map(track: Track) -> str:
    """Give positions as a table."""
    body = [
        [
            _moment(track, track.t_s[k]),
            f"{track.lat_deg[k]:.6f}",
            f"{track.lon_deg[k]:.6f}",
            _metres(float(track.east_half_m[k])),
            _metres(float(track.north_half_m[k])),
            str(track.quality[k]),
        ]
        for k in _sampled(track)
    ]
    head = ["time, s", "latitude, °", "longitude, °", "± east, m", "± north, m", "quality"]
    return _behind(head, body, [5])


# --- the charts -----------------------------------------------------------------------------------


def _charts(track: Track) -> dict[str, dict[str, Any]]:
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


def _chart_section(track: Track, charts: Mapping[str, Mapping[str, Any]]) -> str:
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
    start = "" if _zero(track) == 0 else " from the first row"
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
    marks = "".join(f'<span class="ty {name}{k}">{_t(label)}</span>' for k, (_, label) in enumerate(chart["marks"]))
    ticks = "".join(f'<span class="tx x{k}{_ODD[k % 2]}">{label}</span>' for k, (_, label) in enumerate(_ticks(track)))
    return (
        f'<figure><figcaption>{title} <span class="unit">{_t(unit)}</span>{key}</figcaption>\n'
        f'<div class="plot" data-chart="{name}"><svg viewBox="0 0 {CHART_WIDTH} {CHART_HEIGHT}"'
        f' preserveAspectRatio="none" role="img" aria-label="{_t(title)} against time, values in the'
        f' table below">{shades}<path class="lines" d="{rules}"/>{paths}</svg>{marks}'
        f'<div class="axis">{ticks}</div></div>\n'
        f"{behind}</figure>\n"
    )


def _ticks(track: Track) -> list[tuple[float, str]]:
    """Choose the marks of the time axis: percent of its length, and seconds."""
    t0, t1, zero = float(track.t_s[0]), float(track.t_s[-1]), _zero(track)
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
            _moment(track, track.t_s[k]),
            *(_known(float(column[k]), pattern) for column in columns),
            str(track.quality[k]),
        ]
        for k in _sampled(track)
    ]
    return _behind(["time, s", *head, "quality"], body, [len(head) + 1])


# --- the tables -----------------------------------------------------------------------------------

_GAP_HEAD = ("gap", "from, s", "to, s", "length, s", "distance, m", "half-width, m", "kind")


def _gap_cells(track: Track, gap: Gap, number: int) -> list[str]:
    """Write a gap as cells."""
    return [
        str(number + 1),
        _moment(track, gap.start),
        _moment(track, gap.stop),
        f"{gap.duration_s:.1f}",
        f"{gap.distance_m:,.0f}",
        _metres(gap.max_half_m),
        _t(gap.quality),
    ]


def _gap_section(track: Track, limits: Sequence[float]) -> str:
    """List the gaps, the worst in bold."""
    if not track.gaps:
        return '<section>\n<h2>Gaps</h2>\n<p class="about">None: every row has a fix.</p></section>\n'
    numbers = {id(gap): k for k, gap in enumerate(track.gaps)}
    by_size = sorted(track.gaps, key=lambda gap: -gap.max_half_m)
    few = by_size if len(by_size) <= _FEW_GAPS + 5 else by_size[:_FEW_GAPS]
    caption = (
        "From the last fix before to the first fix after. Half-width: the largest in the gap, east or north, at level"
        f" {track.level:g}."
    )
    text = _gap_table(track, few, numbers, limits, caption)
    if len(few) < len(track.gaps):
        listed = by_size[:_MOST_GAPS]
        which = "All" if len(listed) == len(track.gaps) else f"The {_MOST_GAPS} known worst of"
        text = (
            f'<p class="about">The {len(few)} known worst.</p>{text}<details><summary>{which} {len(track.gaps):,} gaps'
            f"</summary>{_gap_table(track, listed, numbers, limits, '')}</details>"
        )
    return f"<section>\n<h2>Gaps</h2>\n{text}</section>\n"


def _gap_table(
    track: Track, gaps: Sequence[Gap], numbers: Mapping[int, int], limits: Sequence[float], caption: str
) -> str:
    """Write gaps as a table in the order of time, the worst in bold."""
    worst = max(gap.max_half_m for gap in gaps)
    ordered = sorted(gaps, key=lambda gap: numbers[id(gap)])
    body = []
    for gap in ordered:
        number = numbers[id(gap)]
        cells = _gap_cells(track, gap, number)
        index = int(np.searchsorted(np.asarray(limits), gap.max_half_m, side="right"))
        cells[5] = f'<span class="swatch h{picture.colour_of(index, len(limits) + 1)}"></span>{cells[5]}'
        cells.append(
            f'<button type="button" class="live hide" data-gap="{number}"'
            f' aria-label="show gap {number + 1} on the map">show</button>'
        )
        body.append(cells)
    marked = [k for k, gap in enumerate(ordered) if gap.max_half_m == worst]
    return _table([*_GAP_HEAD, ""], body, caption=caption, words=[6], marked=marked)


def _fault_section(track: Track) -> str:
    """Say what is wrong with the log, and what its reader did about it."""
    items = check(track.log).items
    told = sorted(
        (item for item in items if item.verdict != "ok"), key=lambda item: list(_VERDICTS).index(item.verdict)
    )
    right = [item for item in items if item.verdict == "ok"]
    faults = sum(item.verdict != "not checked" for item in told)
    notes = "".join(f"<li>{_t(note)}</li>" for note in track.log.notes)
    return (
        '<section>\n<h2>The log</h2>\n<p class="about">'
        f"{_count(len(track.log), 'row')}."
        f" <strong>{_count(faults, 'fault') if faults else 'No fault'} found.</strong></p>"
        + (_item_table(told) if told else "")
        + (
            f"<details><summary>{_count(len(right), 'point')} in order</summary>{_item_table(right)}</details>"
            if right
            else ""
        )
        + (f"<details><summary>While reading</summary><ul>{notes}</ul></details>" if notes else "")
        + "</section>\n"
    )


def _item_table(items: Iterable[Item]) -> str:
    """Write the points of a check as a table."""
    body = [
        [
            '<span class="{}">{}</span>'.format(*_VERDICTS[item.verdict]),
            _t(item.name.replace("_", " ")),
            _t(item.sentence),
            f"<code>{_t(item.line)}</code>" if item.line else "",
        ]
        for item in items
    ]
    used = 4 if any(row[3] for row in body) else 3
    head = ["verdict", "looked at", "found", "to type"][:used]
    return _table(head, [row[:used] for row in body], words=range(4))


def _benchmark_section(track: Track) -> str:
    """Show how far off the method was on this log's own fixes, hidden and filled again."""
    rows = _records(track.benchmark)
    if not rows:
        return ""
    if all({"method", "length_s", "mean_m", "max_m", "coverage"} <= row.keys() for row in rows):
        table = _outage_table(track, rows)
    elif all({"length_s", "stretches", "mean_m", "max_m", "coverage", "inflation"} <= row.keys() for row in rows):
        table = _own_table(track, rows)
    else:
        table = _record_table(rows)
    return (
        '<section>\n<h2>Outages made in this very log</h2>\n<p class="about">Fixes of this log were hidden and filled'
        " again. Errors are distances to the hidden fixes, so they include the fixes’ own errors.</p>"
        f"{table}</section>\n"
    )


def _own_table(track: Track, rows: Sequence[Mapping[str, Any]]) -> str:
    """Write what the method itself found when it hid fixes to test its intervals."""
    body = [
        [
            f"{row['length_s']:.3g}",
            f"{row['stretches']}",
            f"{row['mean_m']:.2f}",
            f"{row['max_m']:.2f}",
            f"{100 * row['coverage']:.0f} %",
            _widened(float(row["inflation"])),
        ]
        for row in rows
    ]
    inside = f"inside the {100 * track.level:g} % interval"
    return _table(
        ["hidden for, s", "stretches", "mean error, m", "largest error, m", inside, "then widened"],
        body,
        caption="Mean error, and the mean over the stretches of the largest error in each. Half-widths in gaps are"
        " widened or narrowed until the promised share of hidden fixes lies inside, all lengths read together.",
    )


def _widened(inflation: float) -> str:
    """Say what a test made of an interval."""
    if inflation > 1.005:
        return f"{inflation:.2f} times"
    return f"narrowed to {inflation:.2f} times" if inflation < 0.995 else "not needed"


def _outage_table(track: Track, rows: Sequence[Mapping[str, Any]]) -> str:
    """Write one line for each length of outage, with the errors of each method side by side."""
    methods = list(dict.fromkeys(str(row["method"]) for row in rows))
    methods.sort(key=lambda name: name != track.method)
    cells = {(str(row["method"]), float(row["length_s"])): row for row in rows}
    tested = any(row["coverage"] is not None and row["method"] == track.method for row in rows)
    head = ["outage, s", "starts", *(f"{name}: mean / largest, m" for name in methods)]
    if tested:
        head.insert(3, f"inside the {100 * track.level:g} % interval")
    body = []
    for length in sorted({length for _, length in cells}):
        found = [cells.get((name, length)) for name in methods]
        line = [f"{length:g}", str(next((row["starts"] for row in found if row and "starts" in row), "–"))]
        line += ["–" if row is None else f"{row['mean_m']:.2f} / {row['max_m']:.2f}" for row in found]
        if tested:
            own = cells.get((track.method, length))
            share = None if own is None else own["coverage"]
            line.insert(3, "–" if share is None else f"{100 * share:.0f} %")
        body.append([_t(cell) for cell in line])
    return _table(
        [_t(name) for name in head],
        body,
        caption="Mean error, and the mean over the starts of the largest error in each outage.",
    )


def _tested(track: Track) -> str:
    """Say what hiding this log's own fixes showed about the bound."""
    rows = [
        row
        for row in _records(track.benchmark)
        if row.get("method", track.method) == track.method and row.get("coverage") is not None and row.get("length_s")
    ]
    if not rows:
        return ""
    weights = [float(row["length_s"]) * float(row.get("starts", row.get("stretches", 1))) for row in rows]
    share = sum(w * float(row["coverage"]) for w, row in zip(weights, rows, strict=True)) / sum(weights)
    low, high = (f"{pick(float(row['length_s']) for row in rows):.3g}" for pick in (min, max))
    lengths = low if low == high else f"{low} to {high}"
    factors = [float(row.get("inflation", 1.0)) for row in rows]
    least, most = min(factors), max(factors)
    said = (
        f" Tested on this very log: with its own fixes hidden for {lengths}\u00a0s and filled again,"
        f" {100 * share:.0f}\u00a0% of them lay inside"
    )
    if least > 0.95 and most < 1.05:
        return said + "."
    if most < 1.05:
        how = f"narrowed, to {least:.2g}"
    elif least > 0.95:
        how = f"widened, up to {most:.1f}"
    else:
        how = f"narrowed or widened, {least:.2g} to {most:.1f}"
    return f"{said} before half-widths were {how}\u00a0times, so that {100 * track.level:.3g}\u00a0% do."


def _records(value: Any) -> list[dict[str, Any]]:
    """Read a result as rows: a sequence of mappings, or something whose `rows` gives one."""
    rows = value.rows() if hasattr(value, "rows") else value
    return [{str(key): item for key, item in row.items()} for row in rows or () if isinstance(row, Mapping)]


def _record_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Write rows as a table."""
    head = list(dict.fromkeys(key for row in rows for key in row))
    words = [k for k, key in enumerate(head) if any(isinstance(row.get(key), str) for row in rows)]
    body = [[_t(_cell(row.get(key))) for key in head] for row in rows]
    return _table([_t(key.replace("_", " ")) for key in head], body, words=words)


def _cell(value: object) -> str:
    """Write a value of a result or of the settings."""
    if value is None:
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{value:.4g}" if np.isfinite(value) else "–"
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {_cell(item)}" for key, item in value.items())
    if isinstance(value, list | tuple | np.ndarray):
        return ", ".join(_cell(item) for item in value)
    return str(value)


def _settings_section(track: Track, command: str | None) -> str:
    """List the settings and give the command that makes the page again."""
    settings = {"method": track.method, "level": track.level, **track.settings}
    body = [[_t(name.replace("_", " ")), _t(_cell(value))] for name, value in settings.items()]
    again = command if command is not None else _command(track)
    # an option is not to be broken at its hyphens
    parts = [f'<span class="nb">{_t(word)}</span>' if word.startswith("-") else _t(word) for word in again.split(" ")]
    return (
        "<section>\n<h2>Make it again</h2>\n"
        f"<pre><code>{' '.join(parts)}</code></pre>\n"
        f"{_table(['setting', 'value'], body, words=[0, 1])}</section>\n"
    )


def _command(track: Track) -> str:
    """Put together a command line that fills the same log the same way."""
    words = ["halfwidth", "fill", track.log.source or "LOG", "-o", "track.gpx"]
    words += ["--report", "report.html", "--method", track.method, "--level", f"{track.level:g}"]
    return shlex.join(words)


# --- what the script needs ------------------------------------------------------------------------


def _placing(track: Track, plane: Plane, view: View, charts: Mapping[str, Mapping[str, Any]]) -> str:
    """Write the rules that depend on the track: a strict policy allows no style attributes."""
    rules = [f".map{{aspect-ratio:{view.width / view.height:.4f}}}"]
    narrow = [f".map{{aspect-ratio:{_NARROW}}}"]
    rules.append(f".bar{{width:{picture.scale_bar(view, plane)[1]:.3f}%}}")
    for number, (x, y) in _pin_places(track, plane).items():
        left, top = view.percent(x, y)
        rules.append(f".p{number}{{left:{left:.2f}%;top:{top:.2f}%}}")
        lower = 50 + (top - 50) * _NARROW * view.height / view.width
        narrow.append(f".p{number}{{top:{lower:.2f}%}}")
    for name, chart in charts.items():
        size = chart["high"] - chart["low"]
        for k, (value, _) in enumerate(chart["marks"]):
            rules.append(f".{name}{k}{{bottom:{100 * (value - chart['low']) / size:.2f}%}}")
    for k, (percent, _) in enumerate(_ticks(track)):
        rules.append(f".x{k}{{left:{percent:.2f}%}}")
    return "".join(rules) + f"@media (max-width:620px){{{''.join(narrow)}}}"


def _data(
    track: Track,
    plane: Plane,
    view: View,
    rows: Rows,
    charts: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """Give the script its numbers: whole numbers, differences where that is shorter."""
    x, y = plane.units(track.lat_deg[rows], track.lon_deg[rows])
    quality = track.quality[rows]
    letters = {"fix": "f", "bridged": "b", "extrapolated": "x"}
    gaps = []
    for gap in track.gaps:
        first, stop = track.rows_of(gap)
        a = int(np.clip(np.searchsorted(rows, first), 0, rows.size - 1))
        b = int(np.clip(np.searchsorted(rows, stop - 1), a, rows.size - 1))
        gaps.append([a, b])
    unix = track.log.epoch_s
    if unix is None and _zero(track):
        unix = 0.0
    azimuth = np.degrees(np.mod(track.azimuth_rad[rows], 2 * np.pi))
    return {
        "unit": plane.unit_m,
        "lat": plane.lat_deg,
        "lon": plane.lon_deg,
        "eastm": plane.east_m,
        "northm": plane.north_m,
        "view": [round(view.x), round(view.y), round(view.width), round(view.height)],
        "zero": _zero(track),
        "pause": picture.pause_of(track.t_s[rows]),
        "epoch": unix,
        "t": _differences(track.t_s[rows] * 1000),
        "x": _differences(x),
        "y": _differences(y),
        "e": _whole(track.east_half_m[rows] * 100),
        "n": _whole(track.north_half_m[rows] * 100),
        "v": _whole(track.speed_mps[rows] * 100),
        "a": _whole(azimuth * 10),
        "s": _whole(np.where(quality == "fix", np.nan, track.since_fix_s[rows] * 10)),
        "q": [[letters[str(kind)], b - a] for a, b, kind in runs(quality)],
        "gaps": gaps,
        "pins": {str(k): [round(a), round(b)] for k, (a, b) in _pin_places(track, plane).items()},
        "worst": int(np.argmax(track.half_m[rows])),
        "charts": {name: {key: chart[key] for key in ("low", "high", "lines")} for name, chart in charts.items()},
    }


def _differences(values: Floats) -> list[int]:
    """Round, then give the first and the steps from each to the next."""
    whole = np.round(values).astype(np.int64)
    return [int(whole[0]), *np.diff(whole).tolist()]


def _whole(values: Floats) -> list[int | None]:
    """Round; None where unknown."""
    return [round(v) if v == v else None for v in values.tolist()]
