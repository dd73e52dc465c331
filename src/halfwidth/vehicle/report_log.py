"""What is wrong with a log, in words and pictures: a section of a track's page, and a page of its own.

The pictures are drawn as plain SVG under labels in HTML, as the charts of a track are, and need no script.
"""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from halfwidth import __version__
from halfwidth.store import atomic_write
from halfwidth.vehicle import markup, picture
from halfwidth.vehicle.check import Check, Item, check
from halfwidth.vehicle.check_pictures import Floats, Layer, Picture, Places, pictures, places
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.picture import CHART_HEIGHT, CHART_WIDTH
from halfwidth.vehicle.track import Track

#: How the verdicts of a check look, the worst first: a sign as well as a colour.
_VERDICTS = {
    "bad": ("bad", "✗ bad"),
    "warn": ("warn", "! warning"),
    "ok": ("ok", "✓ ok"),
    "not checked": ("none", "– not checked"),
}

#: How the layers of a picture look, by kind and colour.
_LINES, _DOTS = ("one", "two"), ("dot", "dot other", "dot third")

#: Size of the map of fixes that are left out, in its own coordinates, and points of it at most.
_WIDE, _HIGH, _MOST = 2000, 900, 4000


@dataclass(frozen=True)
class Section:
    """A section of a page, and the style rules that its labels need."""

    html: str
    rules: str


def section(track: Track) -> Section:
    """Say what is wrong with the log of a track, and what its reader did about it."""
    found = check(track.log, track.found)
    shown = _pictures(found)
    drawn = (
        f"<details><summary>What this rests on, in {markup.count(len(shown.titles), 'picture')}</summary>{shown.html}"
        "</details>"
        if shown.titles
        else ""
    )
    return Section(f"<section>\n<h2>The log</h2>\n{_words(found)}{drawn}</section>\n", shown.rules)


def write_page(found: Check, path: "str | os.PathLike[str]") -> Path:
    """Write the page of a check in one step; see `page`."""
    content = page(found).encode()
    with atomic_write(path) as file:
        file.write(content)
    return Path(path)


def page(found: Check) -> str:
    """Build the page of a check: its points, worst first, and what they rest on in pictures.

    Parameters
    ----------
    found : Check

    Returns
    -------
    str
        A whole HTML document, the same for the same check.
    """
    shown = _pictures(found)
    style = markup.part("page.css") + shown.rules
    title = markup.text(os.path.basename(found.source.rstrip("/")) or "a vehicle's log")
    faults = sum(item.verdict in ("bad", "warn") for item in found.items)
    said = f"{markup.count(faults, 'point')} to look at" if faults else "Nothing is wrong with this log"
    fixes = "1 fix" if found.fixes == 1 else f"{found.fixes:,} fixes"
    about = f"{markup.count(found.rows, 'row')}, {markup.span(found.length_s)}, {fixes}."
    what = (
        f'<section>\n<h2>What this rests on</h2>\n<p class="about">Gaps between fixes are shaded.</p>{shown.html}'
        "</section>\n"
        if shown.titles
        else ""
    )
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\';'
        f" style-src {markup.policy_hash(style)}; img-src data:; base-uri 'none'; form-action 'none'\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n<meta name="referrer" content="no-referrer">\n'
        f'<link rel="icon" href="data:,">\n<title>{title}: check</title>\n<style>{style}</style>\n</head>\n<body>\n'
        f'<header>\n<h1>Check · {title}</h1>\n<p class="verdict">{said}.</p>\n<p class="kind">{about}</p>\n</header>\n'
        f"<main>\n<section>\n<h2>The log</h2>\n{_words(found)}</section>\n{what}</main>\n"
        f"<footer>Written by halfwidth {markup.text(__version__)}. This page holds everything it shows and"
        " asks nothing of any network.</footer>\n</body>\n</html>\n"
    )


def _words(found: Check) -> str:
    """Write the points of a check, the worst first, and what reading did."""
    told = sorted(
        (item for item in found.items if item.verdict != "ok"), key=lambda item: list(_VERDICTS).index(item.verdict)
    )
    right = [item for item in found.items if item.verdict == "ok"]
    faults = sum(item.verdict != "not checked" for item in told)
    notes = "".join(f"<li>{markup.text(note)}</li>" for note in found.notes)
    return (
        f'<p class="about">{markup.count(found.rows, "row")}.'
        f" <strong>{markup.count(faults, 'fault') if faults else 'No fault'} found.</strong></p>"
        + (_item_table(told) if told else "")
        + (
            f"<details><summary>{markup.count(len(right), 'point')} in order</summary>{_item_table(right)}</details>"
            if right
            else ""
        )
        + (f"<details><summary>While reading</summary><ul>{notes}</ul></details>" if notes else "")
    )


def _item_table(items: Iterable[Item]) -> str:
    """Write the points of a check as a table."""
    body = [
        [
            '<span class="{}">{}</span>'.format(*_VERDICTS[item.verdict]),
            markup.text(item.name.replace("_", " ")),
            markup.text(item.sentence),
            f"<code>{markup.text(item.line)}</code>" if item.line else "",
        ]
        for item in items
    ]
    used = 4 if any(row[3] for row in body) else 3
    head = ["verdict", "looked at", "found", "to type"][:used]
    return markup.table(head, [row[:used] for row in body], words=range(4))


# --- the pictures ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Shown:
    """All pictures of a check: their titles, the figures and the rules that place their labels."""

    titles: list[str]
    html: str
    rules: str


def _pictures(found: Check) -> _Shown:
    """Draw all pictures of a check."""
    shown = pictures(found)
    where = places(found)
    figures, rules = [], []
    for k, one in enumerate(shown):
        html, style = _figure(one, f"k{k}", found)
        figures.append(html)
        rules.append(style)
        if "stray fixes" in one.points and where is not None:
            figures.append(_map(where))
    return _Shown([one.title for one in shown], "".join(figures), "".join(rules))


def _figure(one: Picture, name: str, found: Check) -> tuple[str, str]:
    """Put one picture together: caption with its verdict, shaded gaps, layers, marks."""
    left, right, low, high = one.limits()
    if one.timed and found.basis is not None:
        left, right = float(found.basis.fixes.t[0]), float(found.basis.fixes.t[-1])

    def across(x: Floats) -> Floats:
        return np.asarray((x - left) / (right - left) * CHART_WIDTH)

    def down(y: Floats) -> Floats:
        return np.asarray((1 - (np.clip(y, low, high) - low) / (high - low)) * CHART_HEIGHT)

    ups = picture.steps(low, high, 4).tolist()
    zero = markup.zero_of(left) if one.timed else 0.0
    alongs = picture.steps(left - zero, right - zero, 8).tolist()
    rules = [f".{name}y{k}{{bottom:{100 * (v - low) / (high - low):.2f}%}}" for k, v in enumerate(ups)]
    rules += [f".{name}x{k}{{left:{100 * (v + zero - left) / (right - left):.2f}%}}" for k, v in enumerate(alongs)]
    grid = "".join(f"M0,{h:.1f}H{CHART_WIDTH}" for h in down(np.array(ups)))
    marks = "".join(f'<span class="ty {name}y{k}">{v:.6g}</span>' for k, v in enumerate(ups))
    ticks = "".join(f'<span class="tx {name}x{k}{" odd" * (k % 2)}">{v:.10g}</span>' for k, v in enumerate(alongs))
    shades = _shades(found.basis.fixes, across) if one.timed and found.basis is not None else ""
    drawn = "".join(_layer(layer, across, down) for layer in one.layers)
    items = [item for item in found.items if item.name in one.points]
    worst = min((item.verdict for item in items), key=list(_VERDICTS).index)
    verdict = '<span class="{}">{}</span>'.format(*_VERDICTS[worst])
    words = markup.text("; ".join(item.sentence for item in items if item.verdict == worst))
    keys = "".join(_key(layer) for layer in one.layers if layer.words)
    return (
        f"<figure><figcaption>{markup.text(one.title)} {verdict}"
        f'<span class="unit">{markup.text(one.up)}; along: {markup.text(one.along)}</span>{keys}</figcaption>\n'
        f'<div class="plot"><svg viewBox="0 0 {CHART_WIDTH} {CHART_HEIGHT}" preserveAspectRatio="none" role="img"'
        f' aria-label="{markup.text(one.title)}: {words}">{shades}'
        f'<path class="lines" d="{grid}"/>{drawn}</svg>{marks}<div class="axis">{ticks}</div></div>\n'
        f'<p class="about">{words}</p></figure>\n',
        "".join(rules),
    )


def _layer(layer: Layer, across: Callable[[Floats], Floats], down: Callable[[Floats], Floats]) -> str:
    """Draw one layer."""
    x = across(layer.x)
    if layer.kind == "band":
        return f'<rect class="sure" x="{x[0]:.1f}" y="0" width="{max(x[1] - x[0], 2.0):.1f}" height="{CHART_HEIGHT}"/>'
    if layer.kind == "upright":
        return "".join(f'<path class="{_LINES[layer.colour]} found" d="M{v:.1f},0V{CHART_HEIGHT}"/>' for v in x)
    y = down(layer.y)
    if layer.kind == "ribbon" and layer.to is not None:
        to = down(layer.to)
        return f'<path class="sure" d="{picture.line(np.r_[x, x[::-1]], np.r_[y, to[::-1]])}z"/>'
    if layer.kind == "dots":
        return f'<path class="{_DOTS[layer.colour]}" d="{picture.dots(x, y)}"/>'
    return f'<path class="{_LINES[layer.colour] if layer.words else "raw"}" d="{picture.line(x, y)}"/>'


def _key(layer: Layer) -> str:
    """Say what a layer is, beside a sample of it."""
    if layer.kind in ("band", "ribbon"):
        sample = '<path class="sure" d="M0 0h26v8h-26z"/>'
    elif layer.kind == "dots":
        sample = f'<path class="{_DOTS[layer.colour]}" d="M13 4h0"/>'
    elif layer.kind == "upright":
        sample = f'<path class="{_LINES[layer.colour]} found" d="M13 -2V10"/>'
    else:
        sample = f'<path class="{_LINES[layer.colour]}" d="M0 4h26"/>'
    return _sample(sample, layer.words)


def _sample(drawn: str, words: str) -> str:
    """Put a sample of a layer beside what it is."""
    return f'<span class="key"><svg viewBox="0 0 26 8" aria-hidden="true">{drawn}</svg>{markup.text(words)}</span>'


def _shades(log: Log, across: Callable[[Floats], Floats]) -> str:
    """Shade the gaps between fixes."""
    return "".join(
        f'<rect class="shade" x="{a:.1f}" y="0" width="{max(b - a, 1.0):.1f}" height="{CHART_HEIGHT}"/>'
        for a, b in (across(np.array(gap)) for gap in log.gaps()[:500])
    )


def _map(where: Places) -> str:
    """Draw all fixes, and those that are left out on top, north up."""
    every = np.unique(np.linspace(0, where.east.size - 1, min(_MOST, where.east.size)).astype(int))
    kept = np.setdiff1d(every, np.concatenate(list(where.out.values())))
    # what lies kilometres away is left at the edge: the drive is to be seen
    spread = [np.quantile(axis[kept], (0.0, 1.0)) for axis in (where.east, where.north)]
    wide, high = (max(float(b - a), 1.0) for a, b in spread)
    metre = 0.9 * min(_WIDE / wide, _HIGH / high)
    middle = [float(a + b) / 2 for a, b in spread]

    def placed(rows: NDArray[np.intp]) -> tuple[Floats, Floats]:
        x = _WIDE / 2 + (where.east[rows] - middle[0]) * metre
        y = _HIGH / 2 - (where.north[rows] - middle[1]) * metre
        return np.clip(x, 0, _WIDE), np.clip(y, 0, _HIGH)

    length = picture.round_step(_WIDE / metre / 12)
    marks = "".join(
        f'<path class="{_DOTS[k + 1]}" d="{picture.dots(*placed(rows))}"/>' for k, rows in enumerate(where.out.values())
    )
    keys = "".join(_sample(f'<path class="{_DOTS[k + 1]}" d="M13 4h0"/>', why) for k, why in enumerate(where.out))
    return (
        '<figure><figcaption>Where fixes are left out <span class="unit">north up; the bar is'
        f" {markup.length(length)}; what lies beyond is drawn at the edge</span>{keys}</figcaption>\n"
        f'<div class="sketch"><svg viewBox="0 0 {_WIDE} {_HIGH}" role="img" aria-label="map of the fixes that are left'
        f' out"><path class="trace" d="{picture.dots(*placed(kept))}"/>{marks}'
        f'<path class="rule" d="M40 {_HIGH - 40}h{length * metre:.1f}"/></svg></div></figure>\n'
    )
