"""Tracks for maps: GPX 1.1, GeoJSON and KML, each with its times and qualities.

Every row appears exactly once and carries its quality: as one segment (GPX) or one track (KML) for each run of rows of
equal quality, or as one feature for each such run plus one for each gap (GeoJSON). All three speak of absolute time; a
log that has none counts from 1970-01-01T00:00:00Z unless `start` says otherwise, and the file says which.

Formats: the GPX 1.1 schema, RFC 7946 for GeoJSON, KML 2.2 with Google's ``gx:Track``.
"""

import json
import os
import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.errors import BadValue
from halfwidth.vehicle.track import GUARANTEES, Track, runs

Start = datetime | str | float | None

#: Colours of the qualities that a colour-blind reader can tell apart, as red, green, blue.
COLOURS = {"fix": "0072b2", "bridged": "d55e00", "extrapolated": "882255"}
_NAMESPACE = "urn:halfwidth:track:1"
_UNIX = datetime(1970, 1, 1, tzinfo=UTC)

#: What XML 1.0 cannot hold, not even escaped.
_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def absolute(track: Track, start: Start = None) -> tuple[NDArray[np.float64], str | None]:
    """Give the rows' absolute times.

    Parameters
    ----------
    track : Track
        What has the rows.
    start : datetime, str or float, optional
        Absolute time of ``t_s = 0``: a datetime, an ISO 8601 text (both UTC where they name no
        zone) or Unix seconds. Without it the log's own `epoch_s`, else 0.

    Returns
    -------
    unix_s : (M,) array
        Seconds since 1970-01-01T00:00:00Z.
    note : str or None
        What to tell the reader where no absolute time was known; None where it was.

    Raises
    ------
    BadValue
        If `start` is not a time, or a row falls outside of the years 1 to 9999.
    """
    zero = _seconds(start)
    note = None
    if zero is None:
        zero = track.log.epoch_s
    if zero is None:
        zero = 0.0
        # times that are themselves Unix seconds need no note
        if track.t_s[0] < 1e8:
            note = "the log has no absolute time: times count from 1970-01-01T00:00:00Z at t_s = 0"
    unix = track.t_s + zero
    low = (datetime(1, 1, 1, tzinfo=UTC) - _UNIX).total_seconds()
    high = (datetime(9999, 12, 31, tzinfo=UTC) - _UNIX).total_seconds()
    if not (low <= unix[0] and unix[-1] <= high):
        raise BadValue(
            f"`start` puts the rows {unix[0]:.0f} s to {unix[-1]:.0f} s after 1970, which no calendar can name",
            hint='say the time of `t_s = 0`, such as start="2024-05-01T08:00:00Z"',
        )
    return unix, note


def _seconds(start: Start) -> float | None:
    """Read a start time as Unix seconds."""
    if start is None:
        return None
    if isinstance(start, str):
        try:
            start = datetime.fromisoformat(start)
        except ValueError as error:
            raise BadValue(f"`start` is {start!r}, a time such as 2024-05-01T08:00:00Z is expected") from error
    if isinstance(start, datetime):
        return (start if start.tzinfo else start.replace(tzinfo=UTC)).timestamp()
    if not np.isfinite(start):
        raise BadValue(f"`start` is {start}, Unix seconds are expected")
    return float(start)


def stamps(unix_s: NDArray[np.float64]) -> list[str]:
    """Write Unix seconds as ISO 8601 in UTC, to the millisecond, or finer where rows need it."""
    digits = 3 if unix_s.size < 2 or float(np.diff(unix_s).min()) >= 1e-3 else 6
    ticks = np.round(unix_s * 10.0**digits).astype(np.int64)
    if digits == 6 or abs(unix_s[0]) > 9e9:  # years that 64 bits of nanoseconds cannot reach
        moments = [_UNIX + timedelta(microseconds=int(k) * 10 ** (6 - digits)) for k in ticks]
        unit = "milliseconds" if digits == 3 else "microseconds"
        return [m.isoformat(timespec=unit).replace("+00:00", "Z") for m in moments]
    return [f"{stamp}Z" for stamp in ticks.astype("datetime64[ms]").astype(str).tolist()]


def longitudes(lon_deg: ArrayLike) -> NDArray[np.float64]:
    """Bring longitudes to at least -180 and less than 180 degrees, as all formats want them."""
    # rounded first: 179.9999999999 would be written as 180
    lon = np.round(np.asarray(lon_deg, dtype=np.float64), 9)
    return np.where((lon >= -180) & (lon < 180), lon, np.mod(lon + 180, 360) - 180)


def texts(values: NDArray[np.float64], decimals: int) -> list[str]:
    """Write numbers with a fixed count of decimals, empty where NaN."""
    pattern = f"%.{decimals}f"
    return [pattern % x if x == x else "" for x in values.tolist()]


def about(track: Track) -> dict[str, Any]:
    """Say what a file holds, for its metadata."""
    return {
        "source": track.log.source,
        "method": track.method,
        "level": track.level,
        "guarantee": track.guarantee,
    }


def _title(track: Track) -> str:
    """Name a track after the file it came from."""
    name = os.path.basename(track.log.source.rstrip("/"))
    return name if name not in ("", "-", "frame") else "halfwidth track"


def _words(track: Track, note: str | None) -> str:
    """Say in a sentence what the half-widths are, and what time it is."""
    words = f"Filled by {track.method}; half-widths at level {track.level:g}: {GUARANTEES[track.guarantee]}."
    return words if note is None else f"{words} {note[0].upper()}{note[1:]}."


def _xml(text: str) -> str:
    """Escape a text for the content of an XML element."""
    return escape(_NOT_XML.sub("\ufffd", text))


def gpx(track: Track, start: Start) -> bytes:
    """GPX 1.1: one segment for each run of rows of equal quality, every point with its time.

    A point says ``<fix>none</fix>`` where there was none, and its quality and half-widths as
    extensions in a namespace of our own.
    """
    unix, note = absolute(track, start)
    when = stamps(unix)
    lat = texts(track.lat_deg, 9)
    lon = texts(longitudes(track.lon_deg), 9)
    alt = texts(track.alt_m, 3)
    east = texts(track.east_half_m, 3)
    north = texts(track.north_half_m, 3)
    out = [
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<gpx version="1.1" creator="halfwidth" xmlns="http://www.topografix.com/GPX/1/1"'
        ' xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"'
        f" xmlns:hw={quoteattr(_NAMESPACE)}"
        ' xsi:schemaLocation="http://www.topografix.com/GPX/1/1'
        ' http://www.topografix.com/GPX/1/1/gpx.xsd">\n'
        f"<metadata><name>{_xml(_title(track))}</name><desc>{_xml(_words(track, note))}</desc>"
        f"<time>{when[0]}</time></metadata>\n"
        f"<trk><name>{_xml(_title(track))}</name><desc>{_xml(_words(track, note))}</desc>\n"
    ]
    for first, stop, quality in runs(track.quality):
        out.append("<trkseg>\n")
        for k in range(first, stop):
            fix = "none" if quality != "fix" else "3d" if alt[k] else "2d"
            height = f"<ele>{alt[k]}</ele>" if alt[k] else ""
            out.append(
                f'<trkpt lat="{lat[k]}" lon="{lon[k]}">{height}<time>{when[k]}</time>'
                f"<fix>{fix}</fix><extensions><hw:east_half_m>{east[k]}</hw:east_half_m>"
                f"<hw:north_half_m>{north[k]}</hw:north_half_m></extensions></trkpt>\n"
            )
        out.append(f"<extensions><hw:quality>{quality}</hw:quality></extensions>\n</trkseg>\n")
    out.append("</trk>\n</gpx>\n")
    return "".join(out).encode()


def geojson(track: Track, start: Start) -> bytes:
    """GeoJSON: a feature for each run of equal quality, then one for each gap.

    A run is a LineString (a Point if it has one row) with the times and half-widths of its
    coordinates; a gap is the filled line from the last fix before to the first fix after, with
    start, stop, duration, distance and largest half-width. Lines are cut at the date line.
    """
    unix, note = absolute(track, start)
    when = stamps(unix)
    lon = longitudes(track.lon_deg)
    columns = [lon.tolist(), track.lat_deg.round(9).tolist()]
    if np.isfinite(track.alt_m).all():  # a position has the same number of elements throughout
        columns.append(track.alt_m.round(3).tolist())
    points = [list(point) for point in zip(*columns, strict=True)]

    def feature(kind: str, first: int, stop: int, **properties: object) -> dict[str, Any]:
        return {
            "type": "Feature",
            "geometry": _geometry(points[first:stop]),
            "properties": {"kind": kind, **properties},
        }

    features = [
        feature(
            "track",
            first,
            stop,
            quality=str(quality),
            start_s=_plain(track.t_s[first]),
            stop_s=_plain(track.t_s[stop - 1]),
            coordTimes=when[first:stop],
            t_s=track.t_s[first:stop].round(9).tolist(),
            east_half_m=track.east_half_m[first:stop].round(4).tolist(),
            north_half_m=track.north_half_m[first:stop].round(4).tolist(),
            stroke=f"#{COLOURS[quality]}",
        )
        for first, stop, quality in runs(track.quality)
    ]
    for gap in track.gaps:
        first, stop = track.rows_of(gap)
        features.append(
            feature(
                "gap",
                first,
                stop,
                quality=gap.quality,
                start_s=_plain(gap.start),
                stop_s=_plain(gap.stop),
                duration_s=_plain(gap.duration_s),
                distance_m=round(gap.distance_m, 3),
                max_half_m=round(gap.max_half_m, 4),
            )
        )
    collection = {
        "type": "FeatureCollection",
        "name": _title(track),
        "description": _words(track, note),
        "halfwidth": about(track),
        "features": features,
    }
    return (json.dumps(collection, separators=(",", ":"), allow_nan=False) + "\n").encode()


def _plain(value: float) -> float:
    """Round away what binary fractions add."""
    return round(float(value), 9)


def _geometry(points: list[list[float]]) -> dict[str, Any] | None:
    """Make a Point, a LineString, or a MultiLineString where the date line is crossed."""
    if len(points) < 2:
        return {"type": "Point", "coordinates": points[0]} if points else None
    parts: list[list[list[float]]] = [[points[0]]]
    for a, b in pairwise(points):
        if abs(b[0] - a[0]) > 180:
            side = 180.0 if a[0] > 0 else -180.0
            share = (side - a[0]) / (b[0] + 2 * side - a[0])
            height = [x + share * (y - x) for x, y in zip(a[1:], b[1:], strict=True)]
            parts[-1].append([side, *height])
            parts.append([[-side, *height]])
        parts[-1].append(b)
    if len(parts) == 1:
        return {"type": "LineString", "coordinates": parts[0]}
    return {"type": "MultiLineString", "coordinates": parts}


def kml(track: Track, start: Start) -> bytes:
    """KML 2.2: one ``gx:Track`` with times for each run of equal quality, gaps as a folder."""
    unix, note = absolute(track, start)
    when = stamps(unix)
    lat = texts(track.lat_deg, 9)
    lon = texts(longitudes(track.lon_deg), 9)
    alt = [height or "0" for height in texts(track.alt_m, 3)]
    half = texts(track.half_m, 3)
    out = [
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">'
        f"\n<Document><name>{_xml(_title(track))}</name>"
        f"<description>{_xml(_words(track, note))}</description>\n"
    ]
    for quality, rgb in COLOURS.items():
        colour = "ff" + rgb[4:6] + rgb[2:4] + rgb[0:2]  # KML counts alpha, blue, green, red
        out.append(
            f'<Style id="{quality}"><LineStyle><color>{colour}</color><width>4</width></LineStyle>'
            "<IconStyle><scale>0</scale></IconStyle><LabelStyle><scale>0</scale></LabelStyle>"
            "</Style>\n"
        )
    out.append(
        '<Schema id="rows"><gx:SimpleArrayField name="half_m" type="float">'
        "<displayName>half-width, m</displayName></gx:SimpleArrayField></Schema>\n"
        "<Folder><name>track</name>\n"
    )
    for first, stop, quality in runs(track.quality):
        span = f"{quality} {track.t_s[first]:.1f} s to {track.t_s[stop - 1]:.1f} s"
        out.append(
            f"<Placemark><name>{span}</name><styleUrl>#{quality}</styleUrl>"
            "<gx:Track><altitudeMode>clampToGround</altitudeMode>\n"
        )
        out.extend(f"<when>{when[k]}</when>\n" for k in range(first, stop))
        out.extend(f"<gx:coord>{lon[k]} {lat[k]} {alt[k]}</gx:coord>\n" for k in range(first, stop))
        out.append('<ExtendedData><SchemaData schemaUrl="#rows"><gx:SimpleArrayData name="half_m">\n')
        out.extend(f"<gx:value>{half[k]}</gx:value>\n" for k in range(first, stop))
        out.append("</gx:SimpleArrayData></SchemaData></ExtendedData></gx:Track></Placemark>\n")
    out.append("</Folder>\n")
    out.extend(_kml_gaps(track, lat, lon, alt, when))
    out.append("</Document>\n</kml>\n")
    return "".join(out).encode()


def _kml_gaps(track: Track, lat: list[str], lon: list[str], alt: list[str], when: list[str]) -> Iterator[str]:
    """Draw each gap as a line with what is known of it, for readers without ``gx:Track``."""
    if not track.gaps:
        return
    yield "<Folder><name>gaps</name><visibility>0</visibility>\n"
    for number, gap in enumerate(track.gaps, start=1):
        first, stop = track.rows_of(gap)
        line = " ".join(f"{lon[k]},{lat[k]},{alt[k]}" for k in range(first, stop))
        yield (
            f"<Placemark><name>gap {number}</name><visibility>0</visibility>"
            f"<description>{gap.duration_s:.1f} s, {gap.distance_m:.0f} m, half-width up to"
            f" {gap.max_half_m:.2f} m, {gap.quality}</description>"
            f"<TimeSpan><begin>{when[first]}</begin><end>{when[stop - 1]}</end></TimeSpan>"
            f"<styleUrl>#{gap.quality}</styleUrl>"
            f"<LineString><tessellate>1</tessellate><coordinates>{line}</coordinates>"
            "</LineString></Placemark>\n"
        )
    yield "</Folder>\n"
