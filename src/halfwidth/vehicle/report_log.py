"""What is wrong with a log, as a section of a page."""

from collections.abc import Iterable

from halfwidth.vehicle import markup
from halfwidth.vehicle.check import Item, check
from halfwidth.vehicle.track import Track

#: How the verdicts of a check look, the worst first: a sign as well as a colour.
_VERDICTS = {
    "bad": ("bad", "✗ bad"),
    "warn": ("warn", "! warning"),
    "ok": ("ok", "✓ ok"),
    "not checked": ("none", "– not checked"),
}


def section(track: Track) -> str:
    """Say what is wrong with the log, and what its reader did about it."""
    items = check(track.log).items
    told = sorted(
        (item for item in items if item.verdict != "ok"), key=lambda item: list(_VERDICTS).index(item.verdict)
    )
    right = [item for item in items if item.verdict == "ok"]
    faults = sum(item.verdict != "not checked" for item in told)
    notes = "".join(f"<li>{markup.text(note)}</li>" for note in track.log.notes)
    return (
        '<section>\n<h2>The log</h2>\n<p class="about">'
        f"{markup.count(len(track.log), 'row')}."
        f" <strong>{markup.count(faults, 'fault') if faults else 'No fault'} found.</strong></p>"
        + (_item_table(told) if told else "")
        + (
            f"<details><summary>{markup.count(len(right), 'point')} in order</summary>{_item_table(right)}</details>"
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
            markup.text(item.name.replace("_", " ")),
            markup.text(item.sentence),
            f"<code>{markup.text(item.line)}</code>" if item.line else "",
        ]
        for item in items
    ]
    used = 4 if any(row[3] for row in body) else 3
    head = ["verdict", "looked at", "found", "to type"][:used]
    return markup.table(head, [row[:used] for row in body], words=range(4))
