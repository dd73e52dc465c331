"""The nodes of drives as the chain's residuals need them: steps, sensors, weights, and where sensors were silent."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.turning import Bridges, bridged, joined

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Rows:
    """All nodes of all drives, one drive below the other; R rows, n drives."""

    offsets: NDArray[np.int64]  # (n + 1,)
    order: NDArray[np.int32]  # (n,) drives, the longest first: those that are solved side by side are about as long
    drive: NDArray[np.int32]  # (R,)
    first: Mask  # (R,)
    h: Floats
    v: Floats
    w: Floats
    weight2: Floats  # (R, 4) squared weights of the first four groups
    turn: Bridges | None  # how yaw rates that were silent deviate; None where all spoke
    extra: Floats  # (R, 3) variance added to longitudinal, lateral and yaw where a sensor was silent
    gap: Mask  # (R,) whether the step lies in a gap between fixes
    y: Floats  # (R, 2) fixes, about the first of each drive
    seen: Mask  # (R,)
    counted: Mask  # (R, 6) whether the scales of the first six groups are learnt from a row: no sensor was silent there
    origin: Floats  # (n, 2)
    far: Floats  # (n,) how far the first node may be from the first fix, m


def rows_of(drives: Sequence[Grid]) -> Rows:
    """Put drives, each with a fix, one below the other."""
    sizes = np.array([len(drive) for drive in drives])
    offsets = np.concatenate(([0], np.cumsum(sizes))).astype(np.int64)
    index = np.repeat(np.arange(len(drives), dtype=np.int32), sizes)

    def all_of(name: str) -> Floats:
        return np.concatenate([getattr(drive, name) for drive in drives])

    h, v, w = all_of("h"), all_of("speed"), all_of("yaw_rate")
    first = np.zeros(offsets[-1], dtype=bool)
    first[offsets[:-1]] = True
    pace = np.abs(v)
    still = (pace < 0.1) & np.repeat([drive.has_yaw_rate for drive in drives], sizes)
    weight2 = np.column_stack(
        (
            h * np.maximum(np.minimum(1.0, pace), 0.02),
            h * np.maximum(pace, 0.05) ** 2,
            h * (pace * w) ** 2,
            h * np.where(still, 0.01, 1.0),
        )
    )
    # a step of unknown speed may also slide: without this the lateral row would trust a wrong displacement
    lost_speed, lost_yaw = h * all_of("speed_sd"), h * all_of("yaw_rate_sd")
    extra = np.column_stack((lost_speed**2, (0.02 * lost_speed) ** 2, lost_yaw**2))
    spoke = (extra == 0) & ~first[:, None]
    counted = np.column_stack((spoke[:, [0, 1, 1, 2]], ~first, ~first))
    turn = None
    if any(drive.has_yaw_rate and (drive.yaw_rate_sd > 0).any() for drive in drives):
        turn = joined([bridged(drive) for drive in drives])
        w = turn.yaw_rate
        extra[turn.size > 0, 2] = 0.0
    seen = np.concatenate([drive.seen for drive in drives])
    origin, far = np.zeros((len(drives), 2)), np.zeros(len(drives))
    for i, drive in enumerate(drives):
        k = int(np.argmax(drive.seen))
        origin[i] = drive.east[k], drive.north[k]
        far[i] = 100.0 + 2.0 * float(np.sum((np.abs(drive.speed) * drive.h)[1 : k + 1]))
    y = np.column_stack((all_of("east"), all_of("north"))) - origin[index]
    y[~seen] = 0.0
    gap = np.concatenate([in_gap(drive) for drive in drives])
    return Rows(
        offsets,
        np.argsort(-sizes, kind="stable").astype(np.int32),
        index,
        first,
        h,
        v,
        w,
        weight2,
        turn,
        extra,
        gap,
        y,
        seen,
        counted,
        origin,
        far,
    )


def in_gap(drive: Grid) -> Mask:
    """Return the steps between fixes much further apart than usual, and before the first and after the last."""
    seen = np.flatnonzero(drive.seen)
    after = np.searchsorted(seen, np.arange(len(drive)))
    apart = np.concatenate(([np.inf], np.diff(drive.t[seen]), [np.inf]))
    usual = float(np.median(apart[1:-1])) if seen.size > 1 else np.inf
    gap: Mask = apart[after] > 1.5 * usual
    return gap
