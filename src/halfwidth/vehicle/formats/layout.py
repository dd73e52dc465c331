"""Which column is which: names and units as people write them.

A column name is cut into words, a unit is taken off its end (``speed [km/h]``, ``speed_kmh``,
``Speed (OBD)(km/h)``), words that say nothing here (``gps``, ``vehicle``, ``signal``) are dropped,
and the rest is looked up. What the user names (``lat=Breite``, ``yaw_rate=-gyro_z[deg/s]``) always
wins; a minus sign turns the sign around.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from halfwidth.errors import BadLog

#: Names a user may map, and the field of a log each one means.
ROLES: Mapping[str, str] = {
    "time": "t",
    "lat": "lat_deg",
    "lon": "lon_deg",
    "alt": "alt_m",
    "azimuth": "azimuth_rad",
    "speed": "speed_mps",
    "yaw_rate": "yaw_rate_radps",
    "ax": "ax_mps2",
    "ay": "ay_mps2",
    "date": "date",
    "week": "week",
    "valid": "valid",
}

_ROLE_OF = {field: role for role, field in ROLES.items()} | {field: field for field in ROLES}

#: Words for each role, the best first.
_WORDS: Mapping[str, tuple[str, ...]] = {
    "time": (
        "t", "time", "timestamp", "ts", "stamp", "datetime", "date_time", "utc_datetime",
        "utc_time", "time_utc", "utc", "epoch", "epoch_time", "unix", "unix_time", "unixtime",
        "unix_timestamp", "seconds", "sec", "secs", "elapsed", "elapsed_time", "time_elapsed",
        "seconds_elapsed", "iso_time", "log_time", "time_stamp", "header_stamp", "system_time",
        "tow", "time_of_week", "itow", "local_time", "time_of_day", "zeit", "zeitstempel", "cas",
        "time_since_start", "time_since_start_in", "millis", "milliseconds", "microseconds", "nanoseconds",
    ),
    "lat": ("lat", "latitude", "lati", "latit", "breite", "breitengrad"),
    "lon": (
        "lon", "lng", "long", "longitude", "longi", "longit", "laengengrad", "länge",
        "längengrad", "laenge",
    ),
    "alt": ("alt", "altitude", "ele", "elev", "elevation", "height", "hgt", "h", "hoehe", "höhe"),
    "azimuth": (
        "azimuth", "course", "cog", "course_over_ground", "track_angle", "track", "trk",
        "true_course", "heading", "hdg", "true_heading", "bearing", "direction",
        "motion_direction", "kurs", "yaw",
    ),
    "speed": (
        "speed", "velocity", "v", "vel", "wheel_speed", "wheelspeed", "odometer_speed",
        "odometry_speed", "odo_speed", "speed_over_ground", "sog", "ground_speed", "groundspeed",
        "forward_speed", "forward_velocity", "speed_forward", "longitudinal_speed",
        "longitudinal_velocity", "v_x", "vx", "geschwindigkeit", "speed_2d", "spd",
    ),
    "yaw_rate": (
        "yaw_rate", "yawrate", "gyro_z", "gyroz", "gyr_z", "gyroscope_z", "rotation_rate_z",
        "rot_rate_z", "angular_velocity_z", "angular_rate_z", "ang_vel_z", "omega_z", "omegaz",
        "wz", "w_z", "turn_rate", "yaw_velocity", "yaw_speed", "gierrate", "rate_z", "gyro_yaw",
    ),
    "ax": (
        "ax", "a_x", "acc_x", "accx", "accel_x", "accelx", "acceleration_x", "accelerometer_x",
        "linear_acceleration_x", "lin_acc_x", "longitudinal_acceleration", "long_acc",
        "long_accel", "acc_long", "acceleration_longitudinal",
    ),
    "ay": (
        "ay", "a_y", "acc_y", "accy", "accel_y", "accely", "acceleration_y", "accelerometer_y",
        "linear_acceleration_y", "lin_acc_y", "lateral_acceleration", "lat_acc", "lat_accel",
        "acc_lat", "acceleration_lateral",
    ),
    "date": ("date", "utc_date", "day", "datum"),
    "week": ("week", "wn", "week_number"),
    "valid": ("valid", "fix_valid", "fix_quality", "fix_type", "quality", "fix"),
}  # fmt: skip

_LOOKUP = {word: (role, rank) for role, words in _WORDS.items() for rank, word in enumerate(words)}

#: Words that say where a value comes from, not what it is.
_IDLE = frozenset(
    {
        "gps", "gnss", "can", "obd", "obd2", "obdii", "vehicle", "veh", "car", "ego", "imu", "ins",
        "location", "loc", "position", "pos", "navsatfix", "wgs84", "sensor", "data", "value",
        "signal", "current", "fused", "measured", "meas", "msl", "ellipsoidal", "hae", "wheel",
        "odo", "odometry", "oxts", "device", "phone", "calibrated", "nav", "pvt", "degree",
        "obs", "field", "enhanced",
    }
)  # fmt: skip

#: Of two speeds the car's own is better in a tunnel than the receiver's.
_OWN = frozenset({"can", "obd", "obd2", "obdii", "wheel", "odo", "odometry", "vehicle", "veh",
                  "car", "ego"})  # fmt: skip
_RECEIVER = frozenset({"gps", "gnss", "doppler", "nav", "pvt"})

_DEG = math.pi / 180

#: Degrees in one unit of the integers that FIT files hold.
SEMICIRCLE = 180 / 2**31

#: What one of each unit is in the unit of the log, by kind.
FACTORS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "position": {"deg": 1.0, "rad": 1 / _DEG, "1e-7 deg": 1e-7, "1e-6 deg": 1e-6,
                 "semicircles": SEMICIRCLE},
    "length": {"m": 1.0, "ft": 0.3048, "cm": 0.01, "mm": 1e-3, "km": 1e3},
    "angle": {"rad": 1.0, "deg": _DEG, "mrad": 1e-3},
    "speed": {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "kn": 1852 / 3600, "ft/s": 0.3048,
              "cm/s": 0.01, "mm/s": 1e-3},
    "rate": {"rad/s": 1.0, "deg/s": _DEG, "mrad/s": 1e-3, "mdeg/s": _DEG * 1e-3},
    "acceleration": {"m/s2": 1.0, "g": 9.80665, "mg": 9.80665e-3, "mm/s2": 1e-3},
}  # fmt: skip

#: Which kind of unit each role takes.
KIND: Mapping[str, str] = {
    "time": "time", "lat": "position", "lon": "position", "alt": "length", "azimuth": "angle",
    "speed": "speed", "yaw_rate": "rate", "ax": "acceleration", "ay": "acceleration",
}  # fmt: skip

_SPELLINGS: Mapping[str, Mapping[str, str]] = {
    "time": {"s": "s sec secs second seconds", "ms": "ms msec millisecond milliseconds millis",
             "us": "us µs μs usec microsecond microseconds micros",
             "ns": "ns nsec nanosecond nanoseconds nanos", "min": "min minutes", "h": "h hours"},
    "position": {"deg": "deg degree degrees ° wgs84 dd", "rad": "rad radian radians",
                 "1e-7 deg": "1e-7 1e7 e7 1e-7deg deg*1e-7 degx1e7",
                 "1e-6 deg": "1e-6 1e6 e6 1e-6deg deg*1e-6", "semicircles": "semicircles semicircle"},
    "length": {"m": "m meter meters metre metres", "ft": "ft feet foot", "cm": "cm", "mm": "mm",
               "km": "km"},
    "angle": {"rad": "rad radian radians", "deg": "deg degree degrees °", "mrad": "mrad"},
    "speed": {"m/s": "m/s ms mps m/sec meters/second metres/second meterspersecond m*s-1 ms-1 "
                     "ms^-1 m·s-1",
              "km/h": "km/h kmh kph kmph km/hr kmh-1 km*h-1",
              "mph": "mph mi/h mi/hr miles/hour", "kn": "kn kt kts knot knots kmhnm",
              "ft/s": "ft/s fps fts", "cm/s": "cm/s cms", "mm/s": "mm/s mms"},
    "rate": {"rad/s": "rad/s rads radps rad/sec radianspersecond radians/second rads-1",
             "deg/s": "deg/s degs degps dps °/s deg/sec degrees/second degreespersecond degs-1",
             "mrad/s": "mrad/s mrads mradps", "mdeg/s": "mdps mdeg/s mdegs"},
    "acceleration": {"m/s2": "m/s2 m/s^2 m/s² m/s**2 ms2 mps2 ms-2 m/ss mss mpss",
                     "g": "g g0 gee", "mg": "mg milli-g", "mm/s2": "mm/s2 mm/s^2"},
}  # fmt: skip

_UNITS = {
    kind: {spelling: unit for unit, line in units.items() for spelling in line.split()}
    for kind, units in _SPELLINGS.items()
}
_ANY_UNIT = frozenset(spelling for units in _UNITS.values() for spelling in units)

_BRACKET = re.compile(r"[\[({<]([^\[\](){}<>]*)[\])}>]")
_CAMEL = re.compile(r"(?<=[a-zäöü0-9])(?=[A-ZÄÖÜ])|(?<=[A-Z])(?=[A-Z][a-zäöü])")
_WORD = re.compile(r"[^0-9a-zäöüß°µμ]+")
_ASKED = re.compile(r"^\s*(-?)\s*(.*?)\s*(?:\[([^\[\]]*)\])?\s*$")


@dataclass(frozen=True)
class Use:
    """One column put to use.

    Attributes
    ----------
    role : str
        Key of `ROLES`.
    index : int
        Column number.
    column : str
        Column name in the file.
    unit : str or None
        Unit the file or the user states; None where neither does.
    sign : int
        -1 where the user asked for the opposite sign.
    asked : bool
        Whether the user named the column.
    """

    role: str
    index: int
    column: str
    unit: str | None = None
    sign: int = 1
    asked: bool = False


def unit_of(text: str, kind: str) -> str | None:
    """Read a unit as written, None if it is none of that kind."""
    bare = text.strip().lower().replace(" ", "").replace("_", "")
    return _UNITS[kind].get(bare)


def is_unit(text: str) -> bool:
    """Say whether a cell under the header is a unit, of whatever kind."""
    bare = text.strip().strip("[]()").lower().replace(" ", "").replace("_", "")
    return bare in _ANY_UNIT


def parse_columns(text: str) -> dict[str, str]:
    """Read what the user typed: ``lat=Breite,speed=v[km/h],yaw_rate=-gyro_z``.

    Raises
    ------
    BadLog
        If a part is not ROLE=COLUMN or the role is unknown.
    """
    asked: dict[str, str] = {}
    for part in (piece for piece in text.split(",") if piece.strip()):
        role, equals, column = part.partition("=")
        if not equals or not column.strip():
            raise BadLog(
                f"`columns` holds {part.strip()!r}, ROLE=COLUMN is expected", hint="lat=Breite,lon=Laenge,speed=v[km/h]"
            )
        asked[role.strip()] = column.strip()
    return asked


def _words(name: str) -> tuple[list[str], str | None]:
    """Cut a column name into lower-case words and what stands in its last bracket."""
    inside = _BRACKET.findall(name)
    unit = inside[-1] if inside else None
    if inside and unit is not None and unit.strip() and not is_unit(unit):
        unit = None
        bare = _BRACKET.sub(r" \1 ", name)
    else:
        bare = _BRACKET.sub(r" \1 ", name.rpartition(name[_last_open(name)])[0]) if inside else name
    bare = _CAMEL.sub("_", bare)
    return [word for word in _WORD.split(bare.lower()) if word], unit


def _last_open(name: str) -> int:
    return max(name.rfind(mark) for mark in "[({<")


def role_of(name: str) -> tuple[str, str | None, float] | None:
    """Recognise one column name.

    Returns
    -------
    role : str
    unit : str or None
    rank : float
        The smaller, the better the name says it.
        None instead of the three if the name is not recognised.
    """
    words, bracket = _words(name.strip().lstrip("\ufeff"))
    for n_unit in range(min(3, len(words)) + 1):
        stem = words[: len(words) - n_unit]
        tail = "".join(words[len(words) - n_unit :])
        for drop in (False, True):
            kept = [word for word in stem if word not in _IDLE] if drop else stem
            found = _LOOKUP.get("_".join(kept))
            if found is None:
                continue
            role, rank = found
            if role == "valid" and not drop and kept == ["fix"] and n_unit:
                continue
            kind = KIND.get(role)
            if n_unit:
                unit = unit_of(tail, kind) if kind else None
                if unit is None:
                    continue
            else:
                unit = unit_of(bracket, kind) if bracket and kind else None
            if role == "time" and unit is None:
                unit = {"millis": "ms", "milliseconds": "ms", "microseconds": "us", "itow": "ms",
                        "nanoseconds": "ns"}.get(kept[0])  # fmt: skip
            own = set(words)
            better = -50 if own & _OWN else 50 if own & _RECEIVER else 0
            return role, unit, rank + (better if role == "speed" else 0) + 0.5 * drop
    return None


def count_known(names: Iterable[str], asked: Mapping[str, str]) -> int:
    """Count the roles a line of cells would fill, the three that are needed three times."""
    wanted = {_asked(spec)[1] for spec in asked.values()} | set(asked.values())
    roles = set()
    n_asked = 0
    for name in names:
        if name.strip() in wanted:
            n_asked += 1
        found = role_of(name)
        if found:
            roles.add(found[0])
    return sum(3 if role in ("time", "lat", "lon") else 1 for role in roles) + 3 * n_asked


def _asked(spec: str) -> tuple[int, str, str | None]:
    """Read ``-gyro_z[deg/s]``; the whole text may also be a column name, brackets included."""
    match = _ASKED.match(spec)
    assert match is not None
    return (-1 if match[1] else 1), match[2], match[3]


def recognise(
    names: Sequence[str],
    asked: Mapping[str, str],
    units: Sequence[str] | None,
    source: str,
) -> tuple[dict[str, Use], list[str]]:
    """Find the columns of a log.

    Parameters
    ----------
    names : sequence of str
        Column names as in the file.
    asked : mapping of str to str
        What the user named: role (or field of `Log`) to column, with an optional sign and unit.
    units : sequence of str, optional
        Cells of a unit line under the header.
    source : str
        For messages.

    Returns
    -------
    uses : dict of str to Use
        By role.
    notes : list of str
        What was recognised, and what was passed over.

    Raises
    ------
    BadLog
        If time, latitude or longitude is not found, or the user names a column that is not there.
    """
    uses: dict[str, Use] = {}
    for key, spec in asked.items():
        role = key if key in ROLES else _ROLE_OF.get(key)
        if role is None or role not in ROLES:
            raise BadLog(
                f"`columns` names the role {key!r}, one of {', '.join(ROLES)} is expected",
                hint="--columns lat=NAME,lon=NAME",
            )
        uses[role] = _use_asked(role, spec, names, source)

    best: dict[str, tuple[float, Use]] = {}
    passed: list[str] = []
    taken = {use.index for use in uses.values()}
    for index, name in enumerate(names):
        if index in taken:
            continue
        found = role_of(name)
        if found is None or found[0] in uses:
            continue
        role, unit, rank = found
        if units is not None and unit is None and role in KIND and index < len(units):
            unit = unit_of(units[index].strip("[]() "), KIND[role])
        use = Use(role, index, name.strip(), unit)
        if role not in best:
            best[role] = (rank, use)
        elif rank < best[role][0]:
            passed.append(best[role][1].column)
            best[role] = (rank, use)
        else:
            passed.append(use.column)
    uses |= {role: use for role, (_, use) in best.items()}

    lacking = [role for role in ("time", "lat", "lon") if role not in uses]
    if lacking == ["time"] and "date" in uses:  # a column `date` may hold whole time stamps
        date = uses.pop("date")
        uses["time"] = Use("time", date.index, date.column)
        lacking = []
    if lacking:
        raise unknown_layout(names, lacking, source)
    said = ", ".join(
        f"{role} from `{_shown(use.column)}`" + (f" in {use.unit}" if use.unit else "") for role, use in uses.items()
    )
    notes = [f"columns: {said}"]
    if passed:
        notes.append(f"columns passed over for a better one: {', '.join(map(_shown, passed[:8]))}")
    absent = [role.replace("_", " ") for role in ("speed", "yaw_rate") if role not in uses]
    known = {use.index for use in uses.values()}
    strange = [name for k, name in enumerate(names) if k not in known and name.strip() not in passed]
    if absent and strange:
        notes.append(f"no column is read as {' or '.join(absent)}; what is not read: {_listed(strange, 8)}")
    return uses, notes


Chooser = Callable[[Sequence[str], Mapping[str, str], Sequence[str] | None, str], tuple[dict[str, Use], list[str]]]


def exactly(
    wanted: Mapping[str, str], names: Sequence[str], _asked: object, _units: object, source: str
) -> tuple[dict[str, Use], list[str]]:
    """Find columns by their very names, for tables that are no vehicle's log."""
    bare = [name.strip() for name in names]
    uses = {}
    for role, column in wanted.items():
        if column not in bare:
            raise BadLog(
                f"`{source}` has no column {column!r}; found: {_listed(names)}",
                hint="`time`, `outputs` and `inputs` of the model name the columns",
            )
        uses[role] = Use(role, bare.index(column), column)
    return uses, []


def _use_asked(role: str, spec: str, names: Sequence[str], source: str) -> Use:
    bare = [name.strip() for name in names]
    if spec in bare:
        sign, column, unit_text = 1, spec, None
    else:
        sign, column, unit_text = _asked(spec)
    if column not in bare:
        if sign < 0 and spec.lstrip("- ") in bare:
            column, unit_text = spec.lstrip("- "), None
        else:
            raise BadLog(
                f"`columns` names {column!r} for {role}, but `{source}` has no such column; found: {_listed(names)}",
                hint=f"--columns {role}=NAME with one of these",
            )
    unit = None
    if role in KIND:
        if unit_text is not None:
            unit = unit_of(unit_text, KIND[role])
            if unit is None:
                raise BadLog(
                    f"`columns` gives the unit {unit_text!r} for {role}, one of"
                    f" {', '.join(FACTORS[KIND[role]])} is expected",
                    hint=f"--columns {role}={column}[{next(iter(FACTORS[KIND[role]]))}]",
                )
        else:
            found = role_of(column)
            unit = found[1] if found and found[0] == role else None
    return Use(role, bare.index(column), column, unit, sign, asked=True)


def unknown_layout(names: Sequence[str], lacking: Sequence[str], source: str) -> BadLog:
    """Say what was found, what is needed and what to type."""
    words = {"time": "time", "lat": "latitude", "lon": "longitude"}
    typed = ",".join(f"{role}=NAME" for role in lacking)
    return BadLog(
        f"`{source}` has no column that is read as {', '.join(words[role] for role in lacking)};"
        f" found: {_listed(names)}; needed: time, latitude, longitude; used where there: speed, yaw rate, azimuth,"
        " height, acceleration",
        hint=f"say which column it is: --columns {typed} (with a unit where needed: speed=NAME[km/h])"
        if len(names) > 1
        else "put a comma, semicolon, tab, bar or space between the columns",
    )


def _listed(names: Sequence[str], most: int = 30) -> str:
    shown = ", ".join(_shown(name) for name in names[:most]) or "nothing"
    return shown + (f", and {len(names) - most} more" if len(names) > most else "")


def _shown(name: str) -> str:
    """Make a name from a file fit for a terminal: no control characters, not too long."""
    clean = "".join(c if c.isprintable() else "?" for c in name.strip())
    return clean if len(clean) <= 40 else clean[:39] + "…"
