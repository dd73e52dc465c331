"""What an estimator of a drive gives back: a path on the nodes of its grid, with how well it is known."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.result import Status
from halfwidth.vehicle.grid import Grid

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


def sized(path: Path, grid: Grid) -> Path:
    """Give a path without a variance the shape of one: it grows with the time to the nearest fix.

    The shape means nothing by itself; hiding fixes gives it its size.

    Parameters
    ----------
    path : Path
    grid : Grid
        The drive it is the path of.

    Returns
    -------
    Path
        The same where it has a variance.
    """
    if path.variance is not None:
        return path
    fixes = grid.t[grid.seen]
    k = np.clip(np.searchsorted(fixes, grid.t), 1, max(fixes.size - 1, 1))
    near = np.minimum(np.abs(grid.t - fixes[k - 1]), np.abs(grid.t - fixes[np.minimum(k, fixes.size - 1)]))
    sd = 0.3 + 0.5 * near
    seen = grid.seen
    off = np.concatenate(((path.east - grid.east)[seen], (path.north - grid.north)[seen]))
    return replace(path, variance=np.column_stack((sd**2, sd**2)), fix_variance=float(np.mean(off**2)))
