"""What an estimator of a drive gives back: a path on the nodes of its grid, with how well it is known."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.result import Status

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Path:
    """Where the receiver would have seen the vehicle, node by node.

    Parameters
    ----------
    t : (T,) array
        Times of the nodes, s.
    east, north : (T,) arrays
        Position as the receiver would have reported it without the white part of its error, m.
    azimuth : (T,) array
        Direction of travel, rad, continuous; NaN where the method does not know it.
    speed : (T,) array
        Speed at the nodes, m/s; NaN where the method does not know it.
    variance : (T, 2) array or None
        Variance of east and north, m^2; None where the method claims none.
    fix_variance : float
        Variance of a fix about the position, m^2: what is added when a path is compared with fixes.
    status : Status
    info : mapping
        What the method found besides: noise scales, speed scale, yaw bias, rounds.
    """

    t: Floats
    east: Floats
    north: Floats
    azimuth: Floats
    speed: Floats
    variance: Floats | None
    fix_variance: float = 0.0
    status: Status = Status.OK
    info: Mapping[str, Any] = field(default_factory=dict)

    @property
    def finite(self) -> bool:
        """Whether every position and variance is a number."""
        arrays = [self.east, self.north] + ([] if self.variance is None else [self.variance])
        return all(bool(np.isfinite(a).all()) for a in arrays)
