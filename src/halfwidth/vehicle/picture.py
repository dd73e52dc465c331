"""The drawings of the report: a map in local metres and charts against time, as plain SVG.

Everything is drawn here, once, so that the page shows it without a script and on paper; the page's
script only looks closer. The map is a plane tangent to the ellipsoid at the middle of the track,
north up, in whole units of a centimetre or more (`Plane.unit_m`), which keeps paths short. A long
track is thinned to a few thousand rows for the page, gaps first; nothing is thinned in the files.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.vehicle.track import Track, radii_m, runs

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

#: Rows of a track that the page holds at most, and dots of measured fixes.
MOST_ROWS, MOST_DOTS = 8000, 8000

#: Width over height of the map: no flatter and no steeper than these.
_FLATTEST, _STEEPEST = 2.2, 1.5

#: Size of a chart's own coordinates; it is stretched to the page.
CHART_WIDTH, CHART_HEIGHT = 2000, 400


@dataclass(frozen=True)
class Plane:
    """Local plane of a map: metres east and north of a middle, in whole units.

    Parameters
    ----------
    lat_deg, lon_deg : float
        The middle in degrees.
    east_m, north_m : float
        Metres for a degree of longitude and of latitude there.
    unit_m : float
        Metres for one unit of the drawing.
    """

    lat_deg: float
    lon_deg: float
    east_m: float
    north_m: float
    unit_m: float

    def units(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> tuple[Floats, Floats]:
        """Place positions: x to the east, y to the south, in units, not rounded."""
        turn = np.mod(np.asarray(lon_deg, float) - self.lon_deg + 180, 360) - 180
        climb = np.asarray(lat_deg, float) - self.lat_deg
        return turn * self.east_m / self.unit_m, -climb * self.north_m / self.unit_m


@dataclass(frozen=True)
class View:
    """Part of a plane that a map shows: left, top, width and height in units."""

    x: float
    y: float
    width: float
    height: float

    def box(self) -> str:
        """Write it as a view box."""
        return f"{self.x:.0f} {self.y:.0f} {self.width:.0f} {self.height:.0f}"

    def percent(self, x: float, y: float) -> tuple[float, float]:
        """Say where a point is: percent from the left and from the top."""
        return 100 * (x - self.x) / self.width, 100 * (y - self.y) / self.height


def plane_of(track: Track) -> tuple[Plane, View]:
    """Choose the plane of a track and the view that shows all of it, with a margin."""
    lon = np.degrees(np.unwrap(np.radians(track.lon_deg)))
    lat_mid = float(track.lat_deg.min() + track.lat_deg.max()) / 2
    lon_mid = float(lon.min() + lon.max()) / 2
    meridian, normal = radii_m(np.radians(lat_mid))
    east_m = float(np.radians(normal * np.cos(np.radians(lat_mid))))
    north_m = float(np.radians(meridian))
    wide = float(np.ptp(lon)) * east_m
    high = float(np.ptp(track.lat_deg)) * north_m
    margin = 0.06 * max(wide, high) + 2 * float(track.half_m.max()) + 5
    wide, high = wide + 2 * margin, high + 2 * margin
    aspect = min(max(wide / high, _STEEPEST), _FLATTEST)
    wide, high = max(wide, aspect * high), max(high, wide / aspect)
    unit = 10.0 ** max(np.ceil(np.log10(wide / 1e6)), -2)
    view = View(-wide / 2 / unit, -high / 2 / unit, wide / unit, high / unit)
    return Plane(lat_mid, lon_mid, east_m, north_m, unit), view


def shown_rows(track: Track, most: int = MOST_ROWS) -> Rows:
    """Choose the rows that the page holds: all, or an even share of the gaps and of the rest.

    Parameters
    ----------
    track : Track
        What is shown.
    most : int
        About how many rows are wanted.

    Returns
    -------
    (n,) array of int
        Rows in order; both ends of every run of equal quality are among them while there is room.
    """
    rows = len(track)
    if rows <= most:
        return np.arange(rows)
    inside = track.quality != "fix"
    edges = np.array([k for a, b, _ in runs(inside) for k in (a, b - 1)], dtype=np.int64)
    edges = edges[:: max(1, -(-4 * edges.size // most))]
    chosen = [edges, np.array([0, rows - 1, int(np.argmax(track.half_m))])]
    for where in (np.flatnonzero(inside), np.flatnonzero(~inside)):
        if where.size:
            chosen.append(where[:: max(1, -(-where.size * 5 // (2 * most)))])
    return np.unique(np.concatenate(chosen))


def steps(low: float, high: float, about: int) -> Floats:
    """Choose round numbers between two values: multiples of 1, 2 or 5 times a power of ten."""
    step = round_step((high - low) / max(about, 1))
    first = np.ceil(low / step - 1e-9)
    return np.arange(first, np.floor(high / step + 1e-9) + 1) * step + 0.0  # no negative nought


def round_step(size: float) -> float:
    """Give the smallest of 1, 2, 5 times a power of ten that is not below a size."""
    power = 10.0 ** np.floor(np.log10(max(size, 1e-12)))
    return float(power * min(k for k in (1, 2, 5, 10) if k * power >= size * (1 - 1e-9)))


def pause_of(t: Floats) -> float:
    """Choose the step in time, in seconds, beyond which rows are not joined by a line."""
    return max(5 * float(np.median(np.diff(t))), 2.0) if t.size > 1 else 2.0


def pauses_of(t: Floats) -> Rows:
    """Find the rows after which the log pauses."""
    return np.flatnonzero(np.diff(t) > pause_of(t)).astype(np.int64)


def limits_of(half_m: Floats, most: int = 5) -> list[float]:
    """Choose the limits between the colours in metres: 1, 2, 5, 10 and so on, or even ones if they are alike."""
    if half_m.size == 0:
        return []
    low, high = float(half_m.min()), float(half_m.max())
    series = [m * 10.0**k for k in range(-3, 7) for m in (1, 2, 5)]
    limits = [x for x in series if low < x < high][-most:]
    if len(limits) < 3 and high > 1.15 * low:
        limits = [x for x in steps(low, high, most - 1).tolist() if low < x < high]
    return [float(f"{x:.3g}") for x in limits]


def legend_of(limits: Sequence[float]) -> list[str]:
    """Name the classes that limits in metres make."""
    if not limits:
        return ["all of them"]
    between = [f"{a:g} to {b:g} m" for a, b in pairwise(limits)]
    return [f"below {limits[0]:g} m", *between, f"above {limits[-1]:g} m"]


def line(x: Iterable[float], y: Iterable[float]) -> str:
    """Write a path through points in whole units: one move, then relative steps."""
    px = np.round(np.fromiter(x, float)).astype(np.int64)
    py = np.round(np.fromiter(y, float)).astype(np.int64)
    if px.size == 0:
        return ""
    dx, dy = np.diff(px), np.diff(py)
    moved = (dx != 0) | (dy != 0)
    steps = [f"{a},{b}" for a, b in zip(dx[moved].tolist(), dy[moved].tolist(), strict=True)]
    # a path of one point is a dot, with round ends
    return f"M{px[0]},{py[0]}l" + " ".join(steps or ["0,0"])


def dots(x: Floats, y: Floats) -> str:
    """Write points as a path of zero lengths, drawn with round ends."""
    px, py = np.round(x).astype(np.int64), np.round(y).astype(np.int64)
    if px.size == 0:
        return ""
    dx, dy = np.diff(px).tolist(), np.diff(py).tolist()
    first = f"M{px[0]},{py[0]}h0"
    return first + "".join(f"m{a},{b}h0" for a, b in zip(dx, dy, strict=True))


def corridor(track: Track, plane: Plane, rows: Rows) -> str:
    """Outline what the half-widths allow across the direction of travel, as a closed path."""
    x, y = plane.units(track.lat_deg[rows], track.lon_deg[rows])
    azimuth = _directions(track, rows, x, y)
    # the half-width of the box east x north across the direction of travel
    across = (
        np.abs(np.cos(azimuth)) * track.east_half_m[rows] + np.abs(np.sin(azimuth)) * track.north_half_m[rows]
    ) / plane.unit_m
    side_x, side_y = np.cos(azimuth) * across, np.sin(azimuth) * across
    outline = line(
        np.r_[x + side_x, (x - side_x)[::-1]],
        np.r_[y + side_y, (y - side_y)[::-1]],
    )
    return outline + "z" if outline else ""


def _directions(track: Track, rows: Rows, x: Floats, y: Floats) -> Floats:
    """Give the direction of travel of rows: as told, else from the line itself."""
    azimuth = track.azimuth_rad[rows].copy()
    many = rows.size > 1
    drawn = np.arctan2(np.gradient(x), -np.gradient(y)) if many else np.zeros(rows.size)
    unknown = ~np.isfinite(azimuth)
    azimuth[unknown] = drawn[unknown]
    return azimuth


def spans(values: NDArray[np.int64], first: int) -> list[tuple[int, int, int]]:
    """Split classes into runs that share their ends, so that lines join: first, stop, class."""
    joined = []
    for a, b, kind in runs(values):
        joined.append((first + a, first + min(b + 1, values.size), int(kind)))
    return joined


def classes(track: Track, limits: Sequence[float]) -> NDArray[np.int64]:
    """Give the class of each row's half-width, stretched over the five colours of the page."""
    index = np.searchsorted(np.asarray(limits, float), track.half_m, side="right")
    return np.asarray(index, dtype=np.int64)


def colour_of(index: int, count: int) -> int:
    """Choose one of the page's six colours, from the best class to the worst."""
    return 5 if count <= 1 else round(5 * index / (count - 1))


def map_svg(track: Track, plane: Plane, view: View, rows: Rows, limits: Sequence[float]) -> str:
    """Draw the map: grid, measured fixes, track, corridor and gaps coloured by half-width.

    Parameters
    ----------
    track : Track
        What is drawn.
    plane : Plane
        Where its units are.
    view : View
        What is shown of it.
    rows : (n,) array of int
        The rows that are drawn; see `shown_rows`.
    limits : sequence of float
        Limits between the colours in metres; see `limits_of`.

    Returns
    -------
    str
        Groups of paths, without the surrounding ``svg`` element.
    """
    x, y = plane.units(track.lat_deg[rows], track.lon_deg[rows])
    quality = track.quality[rows]
    kinds = classes(track, limits)[rows]
    count = len(limits) + 1
    log = track.log
    seen = np.flatnonzero(log.fixed)
    seen = seen[:: max(1, -(-seen.size // MOST_DOTS))]
    out = [f'<path id="grid" class="grid" d="{grid(view, plane)}"/>']
    bands, gaps = [], []
    for a, b, kind in runs(quality != "fix"):
        if not kind:
            continue
        first, stop = max(a - 1, 0), min(b + 1, rows.size)
        bands.append(f'<path d="{corridor(track, plane, rows[first:stop])}"/>')
        dashed = ' class="out"' if quality[a] == "extrapolated" else ""
        parts = [
            f'<path class="h{colour_of(k, count)}" d="{line(x[i:j], y[i:j])}"/>'
            for i, j, k in spans(kinds[first:stop], first)
        ]
        gaps.append(f"<g{dashed}>{''.join(parts)}</g>")
    out.append(f'<g id="bands" class="band">{"".join(bands)}</g>')
    # no line where the log has no rows: nobody knows how the vehicle went
    before = np.searchsorted(rows, pauses_of(track.t_s), side="right")
    pieces = np.split(np.arange(rows.size), before)
    out.append(f'<path class="way" d="{"".join(line(x[piece], y[piece]) for piece in pieces)}"/>')
    fx, fy = plane.units(log.lat_deg[seen], log.lon_deg[seen])
    out.append(f'<path id="fixes" class="fix" d="{dots(fx, fy)}"/>')
    out.append(f'<g id="filled" class="gap">{"".join(gaps)}</g>')
    out.append(f'<path class="start" d="{dots(x[:1], y[:1])}"/>')
    # a square needs a direction, so its path has a length
    out.append(f'<path class="end" d="M{x[-1]:.0f},{y[-1]:.0f}h.1"/>')
    return "".join(out)


def grid(view: View, plane: Plane) -> str:
    """Draw the lines of the metric grid, further than the view, as one path."""
    step = round_step(view.width * plane.unit_m / 12) / plane.unit_m
    columns = np.arange(np.floor(view.x / step) - 2, np.ceil((view.x + view.width) / step) + 3)
    lines = np.arange(np.floor(view.y / step) - 2, np.ceil((view.y + view.height) / step) + 3)
    left, top = columns[0] * step, lines[0] * step
    right, bottom = columns[-1] * step, lines[-1] * step
    path = [f"M{k * step:.0f},{top:.0f}V{bottom:.0f}" for k in columns]
    path += [f"M{left:.0f},{k * step:.0f}H{right:.0f}" for k in lines]
    return "".join(path)


def scale_bar(view: View, plane: Plane) -> tuple[float, float]:
    """Choose a round length for the scale bar: metres, and percent of the map's width."""
    wide = view.width * plane.unit_m
    length = round_step(wide / 12)
    return length, 100 * length / wide


def chart_path(t: Floats, y: Floats, t0: float, t1: float, y0: float, y1: float, pause: float | None = None) -> str:
    """Draw values against time; unknown values and pauses break the line.

    At most four points are kept in each of 500 slices of time, the first, the last, the smallest
    and the largest, which draws the same picture.
    """
    known = np.flatnonzero(np.isfinite(y))
    if known.size == 0:
        return ""
    slices = ((t[known] - t0) / max(t1 - t0, 1e-9) * 500).astype(np.int64)
    if known.size > 2500:
        keep = []
        for a, b, _ in runs(slices):
            part = known[a:b]
            keep += [part[0], part[int(np.argmin(y[part]))], part[int(np.argmax(y[part]))], part[-1]]
        kept = np.unique(np.array(keep, dtype=np.int64))
    else:
        kept = known
    px = (t[kept] - t0) / max(t1 - t0, 1e-9) * CHART_WIDTH
    py = CHART_HEIGHT - (np.clip(y[kept], y0, y1) - y0) / (y1 - y0) * CHART_HEIGHT
    # an unknown value in between breaks the line, and so does a pause
    breaks = np.cumsum(~np.isfinite(y))
    breaks[1:] += np.cumsum(np.diff(t) > (pause_of(t) if pause is None else pause))
    broken = np.diff(breaks[kept]) > 0
    pieces = np.split(np.arange(kept.size), np.flatnonzero(broken) + 1)
    return "".join(line(px[piece], py[piece]) for piece in pieces)


def turning_path(t: Floats, azimuth_deg: Floats, t0: float, t1: float) -> str:
    """Draw an azimuth from 0 to 360 degrees, broken where it passes north."""
    jump = np.flatnonzero(np.abs(np.diff(azimuth_deg)) > 180)
    parts = np.split(np.arange(t.size), jump + 1)
    pause = pause_of(t)
    return "".join(chart_path(t[part], azimuth_deg[part], t0, t1, 0.0, 360.0, pause) for part in parts)
