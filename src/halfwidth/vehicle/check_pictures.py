"""What the verdicts of a check look like: the curve behind each number, with the number and its uncertainty in it.

Each picture shows what the fixes say, window by window, and what was concluded from it, so that a person can see
whether the conclusion follows. Nothing is estimated here: the numbers are those of the `Calibration` that was judged.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle import evidence
from halfwidth.vehicle.check import Basis, Check
from halfwidth.vehicle.rough import FEWEST, agreement
from halfwidth.vehicle.sensors import Offset

Floats = NDArray[np.float64]

#: Points that a picture holds at most.
_MOST = 1500

#: Distances between fixes so far apart, s, and so long at least, m, are compared with the speed; in a turn sharper than
#: this, rad, the straight line between two fixes is no measure of the way.
_APART, _FAR, _STRAIGHT = 5.0, 12.0, 0.15

#: Courses of fixes so far apart, s, are compared after so many seconds for the bias of the yaw rate.
_CHORD, _LATER = 2.0, 30.0

#: Share of the points on each side that may lie beyond the edge of a picture.
_BEYOND = 0.04


@dataclass(frozen=True, eq=False)
class Layer:
    """One kind of mark in a picture.

    Parameters
    ----------
    kind : str
        ``"line"``, ``"dots"``, ``"level"`` (a line across the picture), ``"upright"``, ``"band"`` (upright between two
        values of x) or ``"ribbon"`` (between y and `to` along x).
    words : str
        What it is.
    x, y : (n,) arrays
        Where; an upright and a band have no y.
    to : (n,) array, optional
        The other edge of a ribbon.
    colour : int
        Which of the colours, 0 to 2.
    """

    kind: str
    words: str
    x: Floats
    y: Floats
    to: Floats | None = None
    colour: int = 0


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture of a check.

    Parameters
    ----------
    points : tuple of str
        Which points of the check it belongs to.
    title, along, up : str
        What is shown, along and up with their units.
    layers : tuple of Layer
        From the back to the front.
    timed : bool
        Whether x is the time of the drive.
    """

    points: tuple[str, ...]
    title: str
    along: str
    up: str
    layers: tuple[Layer, ...]
    timed: bool = True

    def limits(self) -> tuple[float, float, float, float]:
        """Return where the picture begins and ends, along and up: all lines, and all but a few of the dots."""
        x = np.concatenate([layer.x for layer in self.layers])
        lows, highs = [], []
        for layer in self.layers:
            y = layer.y if layer.to is None else np.concatenate((layer.y, layer.to))
            y = y[np.isfinite(y)]
            if y.size:
                rare = _BEYOND if layer.kind == "dots" and y.size > 20 else 0.0
                lows.append(float(np.quantile(y, rare)))
                highs.append(float(np.quantile(y, 1 - rare)))
        low, high = min(lows), max(highs)
        room = 0.06 * (high - low) if high > low else max(abs(high), 1e-3)
        left, right = float(x.min()), float(x.max())
        return left, max(right, left + 1e-3), low - room, high + room


@dataclass(frozen=True, eq=False)
class Places:
    """Where fixes are left out: metres east and north of all fixes, and rows of those left out, by reason."""

    east: Floats
    north: Floats
    out: dict[str, NDArray[np.intp]]


def pictures(check: Check) -> list[Picture]:
    """Return the pictures of a check: of clocks, scale, bias, late stamps and fixes left out, where there are any."""
    basis = check.basis
    if basis is None:
        return []
    found = [*_clocks(check, basis), _scale(basis), _bias(basis), _late(basis), _left_out(check, basis)]
    return [one for one in found if one is not None]


def places(check: Check) -> Places | None:
    """Return where fixes are left out, None where none is."""
    if check.basis is None:
        return None
    log = check.basis.fixes
    rows = np.flatnonzero(log.fixed)
    out = {why: np.searchsorted(rows, at) for why, at, _ in _without(check, check.basis) if at.size}
    if not out:
        return None
    return Places(*evidence.local_metres(log.lat_deg[rows], log.lon_deg[rows]), out)


def _clocks(check: Check, basis: Basis) -> list[Picture]:
    """Show how well each offset of a clock fits, and the one that was found."""
    offsets = {name: one for name, one in basis.known.offsets.items() if not one.given}
    if not offsets or int(basis.log.fixed.sum()) < FEWEST:
        return []
    cut = next((one.at[1][0] for one in offsets.values() if one.change == "step"), None)
    curves = agreement(basis.log, basis.known, cut)
    units = {"speed": ("m/s", 1.0), "yaw_rate": ("degrees in 5 s", float(np.degrees(1.0)))}
    shown = []
    for name in ("speed", "yaw_rate"):
        if name not in offsets or not curves.get(name):
            continue
        words = name.replace("_", " ")
        unit, factor = units[name]
        sides = curves[name]
        split = len(sides) > 1
        layers = []
        for k, (at, sd, when) in enumerate(_found(offsets[name], cut, split)):
            band = np.array([max(at - 2 * sd, -2.5), min(at + 2 * sd, 2.5)])
            layers += [
                Layer("band", "" if k else "two standard deviations", band, np.zeros(0)),
                Layer("upright", f"found{when}: {at:+.3f} s", np.array([at]), np.zeros(0), colour=k),
            ]
        for k, (lags, misfit) in enumerate(sides):
            when = "" if not split else f" before {cut:.0f} s" if k == 0 else f" from {cut:.0f} s on"
            layers.append(Layer("line", f"misfit{when}", lags, factor * misfit, colour=k))
        item = check[f"clock of {words}"]
        title = f"Clock of the {words}" + (": not observable" if item.verdict == "not checked" else "")
        along, up = "s, added to its stamps", f"usual misfit to the fixes, {unit}"
        shown.append(Picture((item.name,), title, along, up, tuple(layers), timed=False))
    return shown


def _found(one: Offset, cut: float | None, split: bool) -> list[tuple[float, float, str]]:
    """Return the offsets that were found, their standard deviations and when they hold."""
    if not np.isfinite(one.sd):
        return []
    if one.change == "":
        return [(one.seconds, one.sd, "")]
    (first, before), (last, after) = one.at[0], one.at[-1]
    if one.change == "step" and split:
        return [(before, one.sd, f" before {cut:.0f} s"), (after, one.sd, f" from {cut:.0f} s on")]
    return [(before, one.sd, f" at {first:.0f} s"), (after, one.sd, f" at {last:.0f} s")]


def _scale(basis: Basis) -> Picture | None:
    """Show by how much the speed exceeds the distance between fixes over time, window by window."""
    known = basis.known
    if "speed" not in known.offsets:
        return None
    t, speed = replace(known, scale=1.0).stream(basis.log, "speed")
    found = evidence.windows(basis.log, _APART)
    far = found.distance >= _FAR
    start, stop, distance = found.start[far], found.stop[far], found.distance[far]
    if "yaw_rate" in known.offsets:
        clock, rate = known.stream(basis.log, "yaw_rate")
        turned = np.abs(evidence.integral(clock, rate, start, stop))
        calm = ~(turned > _STRAIGHT)
        start, stop, distance = start[calm], stop[calm], distance[calm]
    percent = 100 * (evidence.integral(t, np.abs(speed), start, stop) / distance - 1)
    when = basis.stamps.back(0.5 * (start + stop))
    keep = np.flatnonzero(np.isfinite(percent))
    if keep.size < 5:
        return None
    keep = keep[:: max(1, -(-keep.size // _MOST))]
    ends = np.array([when[keep[0]], when[keep[-1]]])
    layers = [Layer("dots", f"{_APART:g} s between two fixes, straight ahead", when[keep], percent[keep])]
    if np.isfinite(known.scale_sd):
        at, sd = 100 * (1 / known.scale - 1), 200 * known.scale_sd
        layers = [
            Layer("ribbon", "two standard deviations", ends, np.full(2, at - sd), np.full(2, at + sd)),
            *layers,
            Layer("level", f"found: {at:+.2f} %", ends, np.full(2, at)),
        ]
    title = "Speed against the fixes"
    return Picture(("speed scale",), title, "time, s", "speed reads more than the way between fixes, %", tuple(layers))


def _bias(basis: Basis) -> Picture | None:
    """Show the bias of the yaw rate along the drive: as learnt, as the courses of fixes say, and while standing."""
    known = basis.known
    if "yaw_rate" not in known.offsets:
        return None
    t, rate = replace(known, bias=0.0, bias_at=(), still=np.empty((0, 2))).stream(basis.log, "yaw_rate")
    when, said = _course_bias(basis, t, rate)
    layers = [Layer("dots", f"courses between fixes {_LATER:g} s apart", when, said)]
    stands = [(0.5 * (a + b), rate[(t >= a) & (t <= b)]) for a, b in known.still.tolist()]
    still = np.array([(middle, float(values.mean())) for middle, values in stands if values.size >= 5]).reshape(-1, 2)
    if still.size:
        when = basis.stamps.back(still[:, 0])
        layers.append(Layer("dots", "while the car stands", when, still[:, 1], colour=1))
    if known.bias_at and np.isfinite(known.bias_sd):
        at, bias = np.array(known.bias_at).T
        at = basis.stamps.back(at)
        if at.size == 1:
            at, bias = np.array([basis.log.t[0], basis.log.t[-1]]), np.repeat(bias, 2)
        wide = 2 * known.bias_sd
        layers.insert(0, Layer("ribbon", "two standard deviations", at, bias - wide, bias + wide))
        layers.append(Layer("line", f"found: {known.bias:+.4f} rad/s in the mean", at, bias))
    if not any(layer.x.size for layer in layers):
        return None
    return Picture(("yaw bias",), "Bias of the yaw rate", "time, s", "rad/s", tuple(layers))


def _course_bias(basis: Basis, t: Floats, rate: Floats) -> tuple[Floats, Floats]:
    """Return times (n,) and what the yaw rate exceeds the change of course by there, rad/s."""
    found = evidence.windows(basis.log, _CHORD)
    far = found.distance >= 2.0 * _CHORD
    middle, course = 0.5 * (found.start + found.stop)[far], found.course[far]
    later = np.searchsorted(middle, middle + _LATER)
    first = np.flatnonzero(later < middle.size)
    second = later[first]
    near = middle[second] - middle[first] < 1.2 * _LATER
    first, second = first[near], second[near]
    took = middle[second] - middle[first]
    turned = evidence.wrapped(
        course[second] - course[first] + evidence.integral(t, rate, middle[first], middle[second])
    )
    keep = np.flatnonzero(np.isfinite(turned))
    keep = keep[:: max(1, -(-keep.size // _MOST))]
    return basis.stamps.back(0.5 * (middle[first] + middle[second]))[keep], (turned / took)[keep]


def _late(basis: Basis) -> Picture | None:
    """Show how late the rows were written, where any was."""
    if not basis.stamps.moved:
        return None
    late = basis.stamps.written - basis.stamps.said
    layer = Layer("line", "late", basis.stamps.written, late)
    return Picture(("stamps",), "How late the log was written", "time as written, s", "late by, s", (layer,))


def _left_out(check: Check, basis: Basis) -> Picture | None:
    """Show when fixes are left out and how far they are off."""
    found = [(why, rows, off) for why, rows, off in _without(check, basis) if rows.size]
    if not found:
        return None
    t = basis.fixes.t
    layers = [Layer("level", "", t[[0, -1]], np.zeros(2))]
    layers += [
        Layer("dots", f"{why}: {rows.size}", t[rows], off, colour=k + 1) for k, (why, rows, off) in enumerate(found)
    ]
    up = "m from where reckoning, or the line between the fixes that are kept, has them"
    return Picture(("trust", "stray fixes"), "Fixes that are left out", "time, s", up, tuple(layers))


def _without(check: Check, basis: Basis) -> list[tuple[str, NDArray[np.intp], Floats]]:
    """Return why fixes are left out, their rows, and how far off they are, m."""
    log = basis.fixes
    rows = np.flatnonzero(log.fixed)
    east, north = evidence.local_metres(log.lat_deg[rows], log.lon_deg[rows])
    kept = ~np.isin(rows, basis.doubted.rows)
    beside = [np.interp(log.t[rows], log.t[rows][kept], axis[kept]) for axis in (east, north)]
    away = np.hypot(east - beside[0], north - beside[1])
    found = []
    for why, words in (("frozen", "frozen"), ("jump", "off the path")):
        at = basis.doubted.of(why)
        found.append((words, at, away[np.searchsorted(rows, at)]))
    stray = check["stray fixes"].evidence
    times, off = np.array(stray.get("times", ())), np.array(stray.get("off_m", ()))
    at = np.clip(np.searchsorted(log.t, times - 1e-6), 0, len(log) - 1)
    found.append(("stray", at, off))
    return found
