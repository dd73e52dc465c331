"""Pieces of HTML that the pages are made of: escaped text, numbers with their units, tables, inert JSON."""

import base64
import hashlib
import json
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files

import numpy as np

from halfwidth.vehicle.track import Track

#: Marks the row of a table that matters most.
_WORST = ' class="worst"'


def text(text: object) -> str:
    """Escape a text for HTML, content or attribute; what cannot be encoded is marked."""
    plain = str(text).encode("utf-8", "replace").decode().replace("\x00", "\ufffd")
    return escape(plain, quote=True)


def inert_json(value: object) -> str:
    """Write JSON that cannot end its script element, whatever the strings hold."""
    content = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for sign in "<>&\u2028\u2029":
        content = content.replace(sign, f"\\u{ord(sign):04x}")
    return content


def part(name: str) -> str:
    """Read a part of the page that comes with the package."""
    return (files("halfwidth.vehicle") / "page" / name).read_text(encoding="utf-8")


def policy_hash(content: str) -> str:
    """Name an inline script or style the way a content security policy does."""
    digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
    return f"'sha256-{digest}'"


def article(words: str) -> str:
    """Choose a or an."""
    return "an" if words[0] in "aeiou8" else "a"


def count(number: int, word: str) -> str:
    """Write a count with its noun."""
    return f"{number:,} {word}{'' if number == 1 else 's'}"


def size(metres: float) -> str:
    """Write a half-width: ± with two figures or so, never broken between lines."""
    return f"±\u00a0{metres:.2f}\u00a0m" if metres < 1 else f"±\u00a0{metres:,.{1 if metres < 10 else 0}f}\u00a0m"


def span(seconds: float) -> str:
    """Write a length of time."""
    if 0 < seconds < 1:
        return f"{seconds:.2g}\u00a0s"
    if seconds < 100:
        return f"{seconds:.1f}\u00a0s".replace(".0\u00a0", "\u00a0")
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes:,}\u00a0min" + (f" {rest}\u00a0s" if rest else "")


def way(metres: float) -> str:
    """Write a distance."""
    if metres >= 2000:
        return f"{metres / 1000:,.1f}\u00a0km"
    return f"{metres:,.{1 if 0 < metres < 10 else 0}f}\u00a0m"


def length(metres: float) -> str:
    """Write a round length."""
    return f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"


def known(value: float, pattern: str) -> str:
    """Write a number, or a dash where it is unknown."""
    return pattern.format(value) if np.isfinite(value) else "–"


def metres(value: float) -> str:
    """Write a half-width in a table."""
    return f"{value:.2f}" if value < 100 else f"{value:,.0f}"


def zero(track: Track) -> float:
    """Choose where the page's times count from: 0, or the first row if times are absolute."""
    return zero_of(float(track.t_s[0]))


def zero_of(first: float) -> float:
    """Choose where times count from whose first one this is: 0, or the first if they are absolute."""
    return first if abs(first) >= 1e8 else 0.0


def time(track: Track, t: float) -> str:
    """Write a moment of the drive."""
    return f"{t - zero(track):,.1f}\u00a0s".replace(".0\u00a0", "\u00a0")


def moment(track: Track, t: float) -> str:
    """Write a moment of the drive in a table."""
    return f"{t - zero(track):,.1f}"


def table(
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


def behind(head: Sequence[str], body: Iterable[Sequence[str]], words: Iterable[int]) -> str:
    """Hide a table behind a line that opens it."""
    return f"<details><summary>Table behind this picture</summary>{table(head, body, words=words)}</details>\n"
