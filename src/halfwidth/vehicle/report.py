"""The report: one HTML page on one track, that opens anywhere without a network.

The verdict comes first, then the map, the charts, the gaps, the faults of the log, the outage
benchmark of this very log, and the settings with the command that makes the page again. Everything
is drawn as SVG by `picture` before the page is opened; the script only looks closer (zoom, a moving
time, keys). All text is escaped, all numbers travel as inert JSON, and the page's own policy forbids
every request and every script and style but its own two, which it names by their SHA-256.

The same track gives the same page, byte for byte: it holds no time of writing.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from halfwidth import __version__
from halfwidth.store import atomic_write
from halfwidth.vehicle import markup, picture, report_charts, report_log, report_tables
from halfwidth.vehicle.picture import Floats, Plane, Rows, View
from halfwidth.vehicle.track import Track, runs, steps_m

#: A dot and a dash of the legend.
_DOT, _DASH = "M15 6h0", "M3 6h24"

#: Width over height of the map on narrow screens.
_NARROW = 1.15


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
            f" {markup.size(float(track.half_m.max()))} east and north."
        )
    count = len(track.gaps)
    time = sum(gap.duration_s for gap in track.gaps)
    way = sum(gap.distance_m for gap in track.gaps)
    worst = max(track.gaps, key=lambda gap: gap.max_half_m)
    filled = f"{markup.count(count, 'gap')} filled: {markup.span(time)} and {markup.way(way)} without a fix."
    if worst.quality == "bridged":
        where = f"in the {markup.span(worst.duration_s)} gap that starts at {markup.time(track, worst.start)}"
    elif worst.start > track.t_s[0]:
        where = f"{markup.span(worst.duration_s)} after the last fix"
    else:
        where = f"{markup.span(worst.duration_s)} before the first fix"
    return f"{filled} At worst the position is known to within {markup.size(worst.max_half_m)} east and north, {where}."


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
    return f"The bound is {markup.article(words[0])} {words[0]}: {words[1]}"


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
    charts = report_charts.layout(track)
    numbers = _data(track, plane, view, rows, charts)
    log = report_log.section(track)
    sections = [
        _map_section(track, plane, view, rows, limits),
        report_charts.section(track, charts),
        report_tables.gap_section(track, limits),
        log.html,
        report_tables.benchmark_section(track),
        report_tables.settings_section(track, command),
    ]
    style = markup.part("page.css") + _placing(track, plane, view, charts) + log.rules
    script = markup.part("page.js")
    policy = (
        f"default-src 'none'; script-src {markup.policy_hash(script)}; style-src {markup.policy_hash(style)};"
        " img-src data:;"
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
        f"<title>{markup.text(title)}: track report</title>\n<style>{style}</style>\n</head>\n<body>\n"
        '<a class="skip" href="#map-section">To the map</a>\n'
        f"<header>\n<h1>Track report · {markup.text(title)}</h1>\n"
        f'<p class="verdict">{markup.text(verdict(track))}</p>\n'
        f'<p class="kind">{markup.text(kind_of_bound(track))}{markup.text(report_tables.tested(track))}</p>\n'
        f"{_messages(track)}{_keys(track)}</header>\n"
        f"<main>\n{''.join(sections)}</main>\n"
        f"<footer>Written by halfwidth {markup.text(__version__)}. This page holds everything it shows and"
        " asks nothing of any network.</footer>\n"
        f'<script type="application/json" id="data">{markup.inert_json(numbers)}</script>\n'
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
    body = [report_tables.gap_cells(track, gap, numbers[id(gap)]) for gap in sorted(shown, key=lambda gap: gap.start)]
    more = len(track.gaps) - len(shown)
    return (
        f"<div><p><b>{markup.text(_title(track))}</b>: {markup.text(verdict(track))}</p>"
        f'<svg viewBox="{view.box()}" width="360" role="img" aria-label="map of the track">'
        f'<path d="{picture.line(x, y)}" fill="none" stroke="#0072b2" stroke-width="1.5"'
        f' vector-effect="non-scaling-stroke"/>{filled}</svg>'
        + (markup.table(report_tables.GAP_HEAD, body) if body else "")
        + (f"<p>and {more} gaps with smaller half-widths</p>" if more > 0 else "")
        + "</div>"
    )


def _title(track: Track) -> str:
    """Name the page after the log's file."""
    name = os.path.basename(track.log.source.rstrip("/"))
    return name if name not in ("", "-", "frame") else "a vehicle's log"


def _messages(track: Track) -> str:
    """List what a reader must know."""
    pauses = picture.pauses_of(track.t_s)
    known = [
        *track.messages,
        *(
            f"the log has no rows for {markup.span(float(track.t_s[k + 1] - track.t_s[k]))} from"
            f" {markup.time(track, float(track.t_s[k]))}: nothing is filled there"
            for k in pauses[:5].tolist()
        ),
    ]
    if pauses.size > 5:
        known.append(f"and {markup.count(int(pauses.size) - 5, 'pause')} more of this kind")
    if not known:
        return ""
    items = "".join(f"<li>{markup.text(message)}</li>" for message in known)
    return f'<ul class="flags">{items}</ul>\n'


def _keys(track: Track) -> str:
    """Give the figures of the verdict once more, in a row."""
    total = float(track.t_s[-1] - track.t_s[0])
    fixed = int(np.count_nonzero(track.quality == "fix"))
    way = float(steps_m(track.lat_deg, track.lon_deg).sum())
    figures = [
        ("drive", markup.span(total), markup.way(way)),
        ("with a fix", f"{100 * fixed / len(track):.3g} %", f"{fixed:,} of {len(track):,} rows"),
        ("gaps filled", f"{len(track.gaps):,}", f"{markup.span(sum(gap.duration_s for gap in track.gaps))} in all"),
    ]
    if track.gaps:
        longest = max(track.gaps, key=lambda gap: gap.duration_s)
        worst = max(track.gaps, key=lambda gap: gap.max_half_m)
        figures += [
            ("longest gap", markup.span(longest.duration_s), markup.way(longest.distance_m)),
            ("worst half-width", markup.size(worst.max_half_m), f"gap from {markup.time(track, worst.start)}"),
        ]
    if fixed:
        at_fix = track.half_m[track.quality == "fix"]
        figures.append(
            ("at fixes", markup.size(float(np.median(at_fix))), f"at most {markup.size(float(at_fix.max()))[2:]}")
        )
    items = "".join(
        f"<div><dt>{markup.text(name)}</dt><dd>{markup.text(value)}"
        f' <span class="sub">{markup.text(more)}</span></dd></div>'
        for name, value, more in figures
    )
    return f'<dl class="keys">{items}</dl>\n'


def _pin_places(track: Track, plane: Plane) -> dict[int, tuple[float, float]]:
    """Place the numbers beside the middle of their gaps, in units."""
    places = {}
    for number in report_charts.pins(track):
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
        for number in report_charts.pins(track)
    )
    count = len(limits) + 1
    classes = [
        (f"h{picture.colour_of(k, count)}", f"filled, half-width {name}")
        for k, name in enumerate(picture.legend_of(limits))
    ]
    if track.gaps and not limits:
        classes = [("h5", f"filled, half-width {markup.size(track.gaps[0].max_half_m)[2:]}")]
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
        f'{markup.length(step)}</span>.{thinned} <span class="live hide">Drag to move; click, then turn the'
        " wheel to zoom; keys: arrows, + − 0, n and p for the next and previous gap, comma and full"
        " stop to step in time.</span></p>\n"
        f'<div class="tools live hide">{buttons}</div>\n'
        '<div class="map" id="frame" tabindex="0" role="application" aria-roledescription="map"'
        f' aria-label="{markup.text(_map_words(track))}">\n'
        f'<svg id="map" viewBox="{view.box()}" aria-hidden="true">{drawn}'
        '<rect id="box" class="live hide"/><path id="here" class="live hide"/></svg>\n'
        f'{pins}<div class="tip live hide" id="tip" aria-hidden="true"></div>\n'
        '<div class="north" aria-hidden="true"><svg viewBox="0 0 20 26"><path d="M10 0l8 26-8-6-8 6z"/>'
        "</svg>N</div>\n"
        f'<div class="bar" id="bar"><span id="barlength">{markup.length(length)}</span></div>\n</div>\n'
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


def _map_words(track: Track) -> str:
    """Say what the map shows to who cannot see it."""
    return (
        f"Map of the track: {markup.count(len(track.gaps), 'gap')} filled, listed in the table of gaps"
        " below. Use the moment slider to read positions one by one."
    )


def _behind_map(track: Track) -> str:
    """Give positions as a table."""
    body = [
        [
            markup.moment(track, track.t_s[k]),
            f"{track.lat_deg[k]:.6f}",
            f"{track.lon_deg[k]:.6f}",
            markup.metres(float(track.east_half_m[k])),
            markup.metres(float(track.north_half_m[k])),
            str(track.quality[k]),
        ]
        for k in report_charts.sampled(track)
    ]
    head = ["time, s", "latitude, °", "longitude, °", "± east, m", "± north, m", "quality"]
    return markup.behind(head, body, [5])


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
    for k, (percent, _) in enumerate(report_charts.ticks(track)):
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
    if unix is None and markup.zero(track):
        unix = 0.0
    azimuth = np.degrees(np.mod(track.azimuth_rad[rows], 2 * np.pi))
    return {
        "unit": plane.unit_m,
        "lat": plane.lat_deg,
        "lon": plane.lon_deg,
        "eastm": plane.east_m,
        "northm": plane.north_m,
        "view": [round(view.x), round(view.y), round(view.width), round(view.height)],
        "zero": markup.zero(track),
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
