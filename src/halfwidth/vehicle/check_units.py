"""Units, signs and conventions of a log, judged against its fixes: a point each, with what to type."""

from dataclasses import replace

import numpy as np

from halfwidth.vehicle import evidence
from halfwidth.vehicle.check_sensors import Item, fill_line, has
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.units import contradicted_convention, contradicted_yaw, matched_factor, swapped_columns

#: A way of so many metres, and of so many times as far as all fixes lie apart, is none that a car has gone in them.
_WAY, _WAYS = 200.0, 20.0

_ROLE = {"azimuth_rad": "azimuth", "speed_mps": "speed", "yaw_rate_radps": "yaw_rate"}
_UNIT_AS_TYPED = {"speed is in km/h": "km/h", "speed is in mph": "mph", "speed is in knots": "kn",
                  "speed is in m/s, not km/h": "m/s", "speed is in cm/s": "cm/s",
                  "time is in milliseconds": "ms", "time is in microseconds": "us",
                  "time is in nanoseconds": "ns"}  # fmt: skip


def swapped(log: Log) -> Item:
    """Ask whether latitude and longitude are exchanged."""
    name = "latitude, longitude"
    if swapped_columns(log):
        lat, lon = log.columns.get("lat", "COLUMN"), log.columns.get("lon", "COLUMN")
        return Item(
            name,
            "bad",
            "swapped: only so do speed and course fit the fixes",
            line=f"--columns 'lat={lon},lon={lat}'",
        )
    if not log.fixed.any():
        return Item(name, "not checked", "there is no position")
    lat_deg, lon_deg = float(np.nanmedian(log.lat_deg)), float(np.nanmedian(log.lon_deg))
    ns, ew = "N" if lat_deg >= 0 else "S", "E" if lon_deg >= 0 else "W"
    return Item(name, "ok", f"around {abs(lat_deg):.4f} {ns}, {abs(lon_deg):.4f} {ew}")


def speed(log: Log) -> Item:
    """Ask which unit the speed, or the time, is in."""
    if not has(log, "speed_mps"):
        return Item("speed", "not checked", "there is no speed")
    found = evidence.speed_ratio(log)
    if not found.enough:
        return _unmoved(log)
    row = matched_factor(found)
    shown = {"windows": found.n, "spread": found.spread}
    text = f"speed is {found.value:.3f} times the distance between fixes over time"
    if row is not None:
        name = "speed_mps" if row[3] == 1 else "time"
        return Item(
            "speed", "bad", f"{text}: {row[1]}", found.value, "", _typed(log, name, _UNIT_AS_TYPED[row[1]]), shown
        )
    if abs(found.value - 1) > 0.1:
        text += ", 1 is expected and no known unit explains it: another column?"
        return Item("speed", "bad", text, found.value, "", "--columns speed=COLUMN", shown)
    if abs(found.value - 1) > 0.04:
        # a scale that `fill` finds
        return Item("speed", "warn", f"{text}, 1 is expected", found.value, "", fill_line(log), shown)
    return Item("speed", "ok", text, found.value, "", "", shown)


def _unmoved(log: Log) -> Item:
    """Judge the speed of a car whose fixes hardly move: it stands, or they are no positions."""
    t, values = log.stream("speed_mps")
    way = float(np.sum(np.diff(t) * np.abs(values[:-1])))
    fixed = log.fixed
    east, north = evidence.local_metres(log.lat_deg[fixed], log.lon_deg[fixed])
    wide = float(np.hypot(np.ptp(east), np.ptp(north))) if east.size else 0.0
    if way < _WAY or way < _WAYS * wide:
        return Item("speed", "not checked", "the car hardly moves between fixes")
    text = f"the speed adds up to {way:,.0f} m while all fixes lie within {wide:.3g} m"
    as_degrees = log
    if np.abs(log.lat_deg[fixed]).max() <= np.pi / 2 and np.abs(log.lon_deg[fixed]).max() <= np.pi:
        as_degrees = replace(log, lat_deg=np.degrees(log.lat_deg), lon_deg=np.degrees(log.lon_deg))
    turned = evidence.speed_ratio(as_degrees)
    if turned.enough and abs(np.log(max(turned.value, 1e-9))) < 0.2:
        lat, lon = (log.columns.get(role, "COLUMN") for role in ("lat", "lon"))
        line = f"--columns 'lat={lat}[rad],lon={lon}[rad]'"
        return Item("speed", "bad", f"{text}: positions are in radians", way, "m", line)
    line = "--columns lat=COLUMN,lon=COLUMN"
    return Item("speed", "bad", f"{text}: are these the columns of the position?", way, "m", line)


def azimuth(log: Log) -> Item:
    """Ask from where, which way round and in which unit the azimuth counts."""
    if not has(log, "azimuth_rad"):
        return Item("azimuth", "not checked", "there is no azimuth")
    ours = evidence.course_errors(log)["radians clockwise from north"]
    if not ours.enough:
        return Item("azimuth", "not checked", "the car hardly moves between fixes")
    degrees = float(np.degrees(ours.value))
    shown = {"windows": ours.n, "spread": float(np.degrees(ours.spread))}
    text = f"azimuth and course between fixes differ by {degrees:.1f} degrees in the middle"
    convention = contradicted_convention(log)
    if convention is not None:
        degrees_given = convention.startswith("degrees")
        line = fill_line(log)  # which turns what is counted from east
        if convention.endswith("clockwise from north"):
            sign = "-" if "counter" in convention else ""
            line = _typed(log, "azimuth_rad", "deg" if degrees_given else "rad", sign)
        return Item("azimuth", "bad", f"{text}: it is in {convention}", degrees, "deg", line, shown)
    if degrees > 20:
        text += ", no known convention explains it: another column?"
        return Item("azimuth", "bad", text, degrees, "deg", "--columns azimuth=COLUMN", shown)
    if degrees > 6:
        return Item("azimuth", "warn", text, degrees, "deg", "", shown)
    return Item("azimuth", "ok", text, degrees, "deg", "", shown)


def yaw(log: Log) -> Item:
    """Ask for unit and sign of the yaw rate."""
    if not has(log, "yaw_rate_radps"):
        return Item("yaw rate", "not checked", "there is no yaw rate")
    found = evidence.turning(log)
    if not found.enough:
        return Item("yaw rate", "not checked", "the car hardly turns between fixes", None)
    shown = {"turns": found.n, "correlation": found.correlation}
    text = f"the course changes {found.slope:.3f} times as much as the yaw rate says"
    factor = contradicted_yaw(found)
    if factor is not None:
        unit = "deg/s" if abs(factor) < 0.5 else "rad/s"
        wrong = [] if abs(factor) == 1 else [f"it is in {unit}"]
        wrong += ["its sign is that of a turn to the right"] if factor < 0 else []
        line = _typed(log, "yaw_rate_radps", unit, "-" if factor < 0 else "")
        return Item("yaw rate", "bad", f"{text}: {' and '.join(wrong)}", found.slope, "", line, shown)
    if abs(found.slope - 1) > 0.25:
        text += ", 1 is expected: another column?"
        return Item("yaw rate", "warn", text, found.slope, "", "--columns yaw_rate=COLUMN", shown)
    return Item("yaw rate", "ok", text, found.slope, "", "", shown)


def _typed(log: Log, name: str, unit: str, sign: str = "") -> str:
    role = _ROLE.get(name, name)
    column = log.columns.get(role, "COLUMN")
    return f"--columns '{role}={sign}{column}[{unit}]'"
