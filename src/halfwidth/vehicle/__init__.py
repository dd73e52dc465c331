"""The vehicle: a drive with outages in, a track with honest half-widths out.

Conventions: times in seconds, angles in radians clockwise from north, yaw rate positive to the left, latitude and
longitude in degrees of WGS-84, local positions in metres east and north.
"""

from typing import TYPE_CHECKING

from halfwidth.lazy import lazy

#: Public names and the module of each, loaded when first used.
_HOME: dict[str, str] = {
    "Calibration": "sensors",
    "Check": "check",
    "Frame": "frames",
    "Gap": "track",
    "Limits": "formats",
    "Log": "log",
    "METHODS": "estimators",
    "Outages": "outage_table",
    "Roads": "roads",
    "Track": "track",
    "calibrated": "align",
    "check": "check",
    "constant_velocity": "models",
    "ctrv": "models",
    "fill": "fill",
    "from_frame": "formats",
    "gps_ins": "models",
    "mat_nb": "frames",
    "outages": "outage",
    "read": "formats",
    "simulate_drive": "drive",
    "two_antenna": "models",
    "two_antenna_linear": "models",
}

__all__ = sorted(_HOME)

if TYPE_CHECKING:
    from halfwidth.vehicle.align import calibrated as calibrated
    from halfwidth.vehicle.check import Check as Check
    from halfwidth.vehicle.check import check as check
    from halfwidth.vehicle.drive import simulate_drive as simulate_drive
    from halfwidth.vehicle.estimators import METHODS as METHODS
    from halfwidth.vehicle.fill import fill as fill
    from halfwidth.vehicle.formats import Limits as Limits
    from halfwidth.vehicle.formats import from_frame as from_frame
    from halfwidth.vehicle.formats import read as read
    from halfwidth.vehicle.frames import Frame as Frame
    from halfwidth.vehicle.frames import mat_nb as mat_nb
    from halfwidth.vehicle.log import Log as Log
    from halfwidth.vehicle.models import constant_velocity as constant_velocity
    from halfwidth.vehicle.models import ctrv as ctrv
    from halfwidth.vehicle.models import gps_ins as gps_ins
    from halfwidth.vehicle.models import two_antenna as two_antenna
    from halfwidth.vehicle.models import two_antenna_linear as two_antenna_linear
    from halfwidth.vehicle.outage import outages as outages
    from halfwidth.vehicle.outage_table import Outages as Outages
    from halfwidth.vehicle.roads import Roads as Roads
    from halfwidth.vehicle.sensors import Calibration as Calibration
    from halfwidth.vehicle.track import Gap as Gap
    from halfwidth.vehicle.track import Track as Track

lazy(__name__, _HOME)
