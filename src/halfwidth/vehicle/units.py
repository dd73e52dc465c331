"""What the fixes say of units and signs: which mistake makes a stream contradict them."""

from dataclasses import replace

import numpy as np

from halfwidth.vehicle import evidence
from halfwidth.vehicle.log import Log

#: Speed over fix distance, what it means, and what makes it right: (factor of speed, factor of time).
SPEED_FACTORS: tuple[tuple[float, str, float, float], ...] = (
    (3.6, "speed is in km/h", 1 / 3.6, 1.0),
    (1 / 0.44704, "speed is in mph", 0.44704, 1.0),
    (3600 / 1852, "speed is in knots", 1852 / 3600, 1.0),
    (1 / 3.6, "speed is in m/s, not km/h", 3.6, 1.0),
    (100.0, "speed is in cm/s", 0.01, 1.0),
    (1e3, "time is in milliseconds", 1.0, 1e-3),
    (1e6, "time is in microseconds", 1.0, 1e-6),
    (1e9, "time is in nanoseconds", 1.0, 1e-9),
)

#: How near (as a logarithm) a factor must be, and how little windows may scatter around it.
FACTOR_NEAR, FACTOR_SCATTER = 0.06, 0.15


def matched_factor(found: evidence.Finding) -> tuple[float, str, float, float] | None:
    """Name the unit mistake that a ratio of speeds points to, None if it points to none."""
    if not found.enough or not found.value > 0:
        return None
    if found.spread > FACTOR_SCATTER * found.value:
        return None
    for row in SPEED_FACTORS:
        if abs(np.log(found.value / row[0])) < FACTOR_NEAR:
            return row
    return None


def misfit(found: evidence.Finding) -> float:
    """Return how far a ratio of speeds is from 1, as a logarithm; a speed of zero is far."""
    return abs(float(np.log(max(found.value, 1e-9))))


def contradicted_yaw(found: evidence.Turning) -> float | None:
    """Give the factor that makes the yaw rate fit the courses, None if it fits or nothing is sure."""
    if not found.enough:
        return None
    sign = 1.0 if found.slope > 0 else -1.0
    for factor in (1.0, np.pi / 180, 180 / np.pi):
        if abs(np.log(abs(found.slope) / factor)) < 0.7:
            return None if sign * factor == 1 else sign * factor
    return None


def contradicted_convention(log: Log) -> str | None:
    """Name the convention of the azimuth if another than ours fits the courses far better."""
    errors = evidence.course_errors(log)
    ours = errors["radians clockwise from north"]
    best = min(errors, key=lambda name: errors[name].value if errors[name].n else np.inf)
    if not ours.enough or ours.value < 0.5 or errors[best].value > 0.15:
        return None
    # a straight drive cannot tell a mirrored azimuth from a right one
    close = [name for name in errors if errors[name].n and errors[name].value < errors[best].value + 0.1]
    return best if len(close) == 1 else None


def azimuth_put_right(log: Log) -> tuple[Log, str]:
    """Return a log whose azimuth is in our convention and what it was in, "" if nothing contradicts it."""
    convention = contradicted_convention(log)
    if convention is None:
        return log, ""
    turned = evidence.CONVENTIONS[convention](log.azimuth_rad)
    return replace(log, azimuth_rad=turned % (2 * np.pi)), f"azimuth is in {convention}, as courses between fixes say"


def swapped_columns(log: Log) -> bool:
    """Say whether speed and course fit the fixes only with latitude and longitude swapped."""
    if not log.fixed.any() or float(np.nanmax(np.abs(log.lon_deg))) > 90:
        return False
    given, other = evidence.speed_ratio(log), evidence.speed_ratio(log, swapped=True)
    fits = other.enough and misfit(other) < 0.1 and other.spread < 0.08
    # swapped degrees stretch one direction only, so ratios scatter with the course
    stretched = given.enough and given.spread > 2 * other.spread + 0.02
    name = "radians clockwise from north"
    course, other_course = evidence.course_errors(log)[name], evidence.course_errors(log, swapped=True)[name]
    if course.enough and other_course.enough:
        by_speed = fits and (stretched or misfit(given) > 0.2)
        return course.value > 0.4 and other_course.value < 0.15 and (by_speed or not given.enough)
    # a wrong scale of the speed looks alike on a straight road: the stretch alone decides
    return fits and stretched
