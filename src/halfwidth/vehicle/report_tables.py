"""The tables of a track's page: its gaps, the outages made in its own log, the settings."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from halfwidth.vehicle import markup, picture
from halfwidth.vehicle.track import Gap, Track

#: Gaps in the table of gaps at most, and those that are listed before a line that opens all of them.
_MOST_GAPS, _FEW_GAPS = 500, 20

GAP_HEAD = ("gap", "from, s", "to, s", "length, s", "distance, m", "half-width, m", "kind")


def gap_cells(track: Track, gap: Gap, number: int) -> list[str]:
    """Write a gap as cells."""
    return [
        str(number + 1),
        markup.moment(track, gap.start),
        markup.moment(track, gap.stop),
        f"{gap.duration_s:.1f}",
        f"{gap.distance_m:,.{0 if gap.distance_m >= 10 else 1}f}",
        markup.metres(gap.max_half_m),
        markup.text(gap.quality),
    ]


def gap_section(track: Track, limits: Sequence[float]) -> str:
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
        cells = gap_cells(track, gap, number)
        index = int(np.searchsorted(np.asarray(limits), gap.max_half_m, side="right"))
        cells[5] = f'<span class="swatch h{picture.colour_of(index, len(limits) + 1)}"></span>{cells[5]}'
        cells.append(
            f'<button type="button" class="live hide" data-gap="{number}"'
            f' aria-label="show gap {number + 1} on the map">show</button>'
        )
        body.append(cells)
    marked = [k for k, gap in enumerate(ordered) if gap.max_half_m == worst]
    return markup.table([*GAP_HEAD, ""], body, caption=caption, words=[6], marked=marked)


def benchmark_section(track: Track) -> str:
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
    head = ["hidden for, s", "stretches", "mean error, m", "largest error, m"]
    head += [f"inside the {100 * track.level:g} % interval", "then widened"]
    kinds = [_kind(track, row) for row in rows]
    several = set(kinds) != {"between fixes"}
    if several:
        head.insert(1, "where")
        for line, kind in zip(body, kinds, strict=True):
            line.insert(1, markup.text(kind))
    return markup.table(
        head,
        body,
        words=[1] if several else [],
        caption="Mean error, and the mean over the stretches of the largest error in each. Half-widths in gaps are"
        " widened or narrowed until the promised share of hidden fixes lies inside, all lengths read together.",
    )


def _kind(track: Track, row: Mapping[str, Any]) -> str:
    """Say what kind of stretch was hidden, and how it was filled if not by the track's method."""
    where = "beyond the fixes" if row.get("side") == "one" else "between fixes"
    silent = " and ".join(str(name).replace("_", " ") for name in row.get("silent") or ())
    by = row.get("by") or track.method
    return where + (f" without {silent}" if silent else "") + (f", by {by}" if by != track.method else "")


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
        body.append([markup.text(cell) for cell in line])
    return markup.table(
        [markup.text(name) for name in head],
        body,
        caption="Mean error, and the mean over the starts of the largest error in each outage.",
    )


def tested(track: Track) -> str:
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
    body = [[markup.text(_cell(row.get(key))) for key in head] for row in rows]
    return markup.table([markup.text(key.replace("_", " ")) for key in head], body, words=words)


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
        pairs = any(isinstance(item, list | tuple) for item in value)
        return ("; " if pairs else ", ").join(_cell(item) for item in value) or "–"
    return str(value)


def _rows(name: str, value: object) -> Iterator[list[str]]:
    """Write a setting as rows of a table: one, or one for each entry of what it holds."""
    if isinstance(value, Mapping) and value:
        for key, item in value.items():
            yield from _rows(f"{name}, {key}", item)
    else:
        yield [markup.text(name.replace("_", " ")), markup.text(_cell(value))]


def settings_section(track: Track, command: str | None) -> str:
    """List the settings and give the command that makes the page again."""
    settings = {"method": track.method, "level": track.level, **track.settings}
    body = [row for name, value in settings.items() for row in _rows(name, value)]
    again = command if command is not None else _command(track)
    # an option is not to be broken at its hyphens
    parts = [
        f'<span class="nb">{markup.text(word)}</span>' if word.startswith("-") else markup.text(word)
        for word in again.split(" ")
    ]
    return (
        "<section>\n<h2>Make it again</h2>\n"
        f"<pre><code>{' '.join(parts)}</code></pre>\n"
        f"<details><summary>{markup.count(len(body), 'setting')}</summary>"
        f"{markup.table(['setting', 'value'], body, words=[0, 1])}</details></section>\n"
    )


def _command(track: Track) -> str:
    """Put together a command line that fills the same log the same way."""
    words = ["halfwidth", "fill", track.log.source or "LOG", "-o", "track.gpx"]
    words += ["--report", "report.html", "--method", track.method, "--level", f"{track.level:g}"]
    return shlex.join(words)
