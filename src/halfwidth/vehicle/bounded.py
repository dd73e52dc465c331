"""The chain with bounded noise: half-widths unknown, one for each group of residuals, by linear programs.

The model is that of `halfwidth.vehicle.chain` with another view of the noise: each residual lies within a half-width
that is sought with the path. The position is kept in axes that turn with the car, so that the half-widths along and
across the way are those of the residuals:

==============  ===================================================================================
state           increment over a step of h seconds, each within its own half-width
==============  ===================================================================================
along, across   scale v h and nothing, in axes along the middle azimuth of the step
azimuth         - h (w - bias)
offset          of the fixes, east and north: bounded increments, the bounded form of a slow fix error
scale, bias     constant; within 8 % and 0.02 rad/s (Pavelková and Kárný 2013: unknown parameters)
==============  ===================================================================================

Each round solves a linear program (`halfwidth.BatchLP`, through the core's interior point) about the azimuth of the
round before. One wrong fix sets the half-width of all fixes: with `nu` every row may exceed its half-width at a price,
and each group minimises the mean of its worst fraction nu (`halfwidth.BatchLP`), which `nu_of` chooses by hiding
stretches of the same log. Fixes that are then far beyond what the others keep within are named, and left out of the
rounds that follow. Half-widths have physical floors, half a quantisation step of the log or what sensors of the kind
have: without them the logarithmic objective has no minimum, and a half-width that sits on its floor is named in
``path.info``. Minimal half-widths guarantee nothing: the path has no
variance of its own, and `fill` gives it the size that hiding fixes shows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from halfwidth.estimate import estimate
from halfwidth.methods import load
from halfwidth.model import Linear
from halfwidth.noise import Uniform
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Box
from halfwidth.vehicle.antennas import half_steps
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path
from halfwidth.vehicle.pointing import azimuth_of, with_speed

Floats = NDArray[np.float64]

ALONG, ACROSS, AZIMUTH, SCALE, BIAS, OFFSET_E, OFFSET_N = range(7)

#: How far scale and bias change in a second, at most: the steps of the chain, three times.
_SCALE_WALK, _BIAS_WALK = 3e-4, 3e-5


#: A fix is left out beyond this many half-widths and metres, if no more than this share of the fixes are.
_FAR, _FAR_M, _MOST = 4.0, 3.0, 0.1

#: Shares that are compared by hiding stretches of a log, besides the worst row alone; lengths of the stretches, how
#: many of each, and what is left around them, s.
NUS: tuple[float, ...] = (0.03, 0.1, 0.3)
_HIDDEN, _STRETCHES, _CONTEXT = (5.0, 20.0), 8, 20.0


@dataclass(frozen=True)
class Bounded:
    """Settings of the bounded chain; none of them is tuned to a log.

    Parameters
    ----------
    objective : {"scaled", "log"}
        Of the linear program, see `halfwidth.BatchLP`.
    point : {"central", "least_squares"}
        Which of its points.
    slow : bool
        Whether fixes have an offset with bounded increments.
    rounds : int
        Linear programs, each about the azimuth of the one before.
    speed_floor, side_floor : float
        Least half-width of the speed along and across the way, m/s: a count of a wheel sensor, unless the log's own
        speed has steps that are more than twice as large. So with the others.
    yaw_floor : float
        Least half-width of the yaw rate, rad/s: a count of a gyro.
    fix_floor : float
        Least half-width of a fix and of a step of its offset, m.
    scale, bias : float
        Bounds of the speed scale about 1 and of the yaw bias about 0, rad/s.
    nu : float or None
        Share of the worst rows whose mean counts, in place of the worst one.
    """

    objective: Literal["scaled", "log"] = "scaled"
    point: Literal["central", "least_squares"] = "central"
    slow: bool = True
    rounds: int = 3
    speed_floor: float = 0.02
    side_floor: float = 0.005
    yaw_floor: float = 0.001
    fix_floor: float = 0.005
    scale: float = 0.08
    bias: float = 0.02
    nu: float | None = None


def solve(
    drives: Sequence[Grid], settings: Bounded = Bounded(), *, azimuth: Sequence[Floats] | None = None
) -> list[Path]:
    """Solve the bounded chain for each drive.

    Parameters
    ----------
    drives : sequence of Grid
        Each with at least two nodes and one fix.
    settings : Bounded
    azimuth : sequence of (T,) arrays, optional
        Azimuths to linearise about first; `azimuth_of` each drive if absent.

    Returns
    -------
    list of Path
        Without variance; ``info`` has the half-widths and which of them sit on their floors.
    """
    azimuths = [None] * len(drives) if azimuth is None else list(azimuth)
    return [_solved(with_speed(drive), settings, first) for drive, first in zip(drives, azimuths, strict=True)]


def again(drives: Sequence[Grid], paths: Sequence[Path], settings: Bounded = Bounded()) -> list[Path]:
    """Solve the bounded chain for drives of which fixes were hidden, once about the azimuths found with all fixes.

    Parameters
    ----------
    drives : sequence of Grid
    paths : sequence of Path
        What `solve` found for each with all fixes.
    settings : Bounded

    Returns
    -------
    list of Path
    """
    return solve(drives, replace(settings, rounds=1), azimuth=[path.azimuth for path in paths])


def nu_of(drive: Grid, settings: Bounded = Bounded()) -> float | None:
    """Return the share `nu` that fills hidden stretches of a drive best; None if none beats the worst row alone.

    Parameters
    ----------
    drive : Grid
    settings : Bounded

    Returns
    -------
    float or None
    """
    cases = [case for length in _HIDDEN for case in stretches(drive, length, _STRETCHES, _CONTEXT)]
    if not cases:
        return None

    def loss(nu: float | None) -> float:
        # errors of short and long stretches count alike, and so do those of easy and hard places
        paths = solve([hidden for _, hidden, _ in cases], replace(settings, nu=nu))
        off = [
            np.hypot(path.east - whole.east, path.north - whole.north)[out].mean()
            for path, (whole, _, out) in zip(paths, cases, strict=True)
        ]
        known = np.asarray([one if np.isfinite(one) else 1e3 for one in off])
        return float(np.mean(np.log(known + 0.01)))

    return min((None, *NUS), key=loss)


def stretches(drive: Grid, length: float, n: int, context: float) -> list[tuple[Grid, Grid, NDArray[np.bool_]]]:
    """Hide stretches of one length, evenly spread over a drive, in which the vehicle moves.

    Parameters
    ----------
    drive : Grid
    length : float
        s; shorter where the fixes span less than five times that.
    n : int
        How many at most.
    context : float
        Seconds of the drive kept on each side.

    Returns
    -------
    list of (Grid, Grid, (T,) bool array)
        Each as it is, with its fixes hidden, and which fixes those are.
    """
    fixes = drive.t[drive.seen]
    length = min(length, (fixes[-1] - fixes[0]) / 5) if fixes.size else 0.0
    if length < 1.0:
        return []
    found = []
    for begin in np.linspace(fixes[0] + length, fixes[-1] - 2 * length, n).tolist():
        whole = drive.between(begin - context, begin + length + context)
        hidden = whole.without(begin, begin + length)
        out = whole.seen & ~hidden.seen
        if out.any() and hidden.seen.sum() > 3 and (not drive.has_speed or np.abs(whole.speed[out]).mean() > 1.0):
            found.append((whole, hidden, out))
    return found


def _solved(drive: Grid, settings: Bounded, azimuth: Floats | None = None) -> Path:
    psi = azimuth_of(drive) if azimuth is None or not np.isfinite(azimuth).all() else azimuth
    y = np.column_stack((drive.east, drive.north))
    origin = y[int(np.argmax(drive.seen))].copy()
    y -= origin
    y[~drive.seen] = np.nan
    best: Path | None = None
    beyond = np.zeros(drive.t.size)
    method = load("BatchLP")(objective=settings.objective, point=settings.point, nu=settings.nu)
    for _ in range(settings.rounds):
        model, u, turn = linearised(drive, psi, settings)
        est = estimate(model, Record(drive.t, y, u), method)
        if est.status is Status.INFEASIBLE:
            # half-widths at their caps do not explain some fix: where every row may exceed them it stands out
            elastic = estimate(model, Record(drive.t, y, u), load("BatchLP")(nu=_MOST))
            if _leave_out(elastic, y, beyond):
                est = estimate(model, Record(drive.t, y, u), method)
        sound = bool(np.isfinite(est.x).all())
        if not sound or (best is not None and not est.status.good):
            break
        psi = est.x[:, AZIMUTH]
        place = np.einsum("kij,kj->ki", turn, est.x[:, :2]) + origin
        if settings.slow:
            place = place + est.x[:, OFFSET_E:]
        at_node = 0.5 * (drive.speed + np.concatenate((drive.speed[1:], drive.speed[-1:])))
        best = Path(
            drive.t,
            place[:, 0],
            place[:, 1],
            psi.copy(),
            est.x[:, SCALE] * at_node,
            None,
            status=est.status if est.status.good else Status.STALLED,
            info=_info(model, est.q, est.r, est.x) | _left_out(drive, beyond),
        )
        if settings.nu is not None:
            _leave_out(est, y, beyond)
    if best is None:
        nothing = np.full(drive.t.size, np.nan)
        return Path(drive.t, nothing, nothing, nothing, nothing, None, status=Status.STALLED)
    return best


def _leave_out(est: Estimate, y: Floats, beyond: Floats) -> bool:
    """Take away the fixes y (T, 2) that are far beyond their half-width, note how far, and return whether any are."""
    if not est.status.good or est.r is None:
        return False
    off = np.nan_to_num(np.abs(est.info["e"])).max(axis=1)
    wrong = off > max(_FAR * float(est.r.max()), _FAR_M)
    if not wrong.any() or wrong.sum() > _MOST * np.isfinite(y[:, 0]).sum():
        return False
    beyond[wrong], y[wrong] = off[wrong], np.nan
    return True


def _left_out(drive: Grid, beyond: Floats) -> dict[str, object]:
    """Return fixes that were left out, with time and how far off they are, m, the worst first."""
    k = np.argsort(-beyond)[: int((beyond > 0).sum())]
    if not k.size:
        return {}
    words = ", ".join(f"t = {drive.t[i]:.1f} s by {beyond[i]:.1f} m" for i in k[:5])
    more = f" and {k.size - 5} more" if k.size > 5 else ""
    found = tuple((float(drive.t[i]), float(beyond[i])) for i in k)
    return {"left_out": found, "notes": [f"no bounded noise explains these fixes, left out: {words}{more}"]}


def _info(model: Linear, q: Floats | None, r: Floats | None, x: Floats) -> dict[str, object]:
    """Return the half-widths of a step and of a fix by name, and which of them are on their floors."""
    w, e = model.w, model.e
    if q is None or r is None or not isinstance(w, Uniform) or not isinstance(e, Uniform):
        return {}
    entries = [ALONG, ACROSS, AZIMUTH, *range(OFFSET_E, q.size)]
    found = {model.names.x[k]: (float(q[k]), float(w.at_least[k])) for k in entries}
    found |= {"fix": (float(r.max()), float(e.at_least.max()))}
    return {
        "half_widths": {name: half for name, (half, _) in found.items()},
        "on_floor": tuple(name for name, (half, floor) in found.items() if half <= 1.01 * floor),
        "speed_scale": float(x[-1, SCALE]),
        "yaw_bias": float(x[-1, BIAS]),
    }


def linearised(drive: Grid, psi: Floats, settings: Bounded) -> tuple[Linear, Floats, Floats]:
    """Return the chain about azimuths psi, its input, and the matrices (T, 2, 2) from its axes to east and north."""
    h, v, w = drive.h, drive.speed, drive.yaw_rate
    T = h.size
    middle = psi.copy()
    middle[1:] = 0.5 * (psi[1:] + psi[:-1])
    S, C, vh = np.sin(middle), np.cos(middle), v * h
    turn = np.empty((T, 2, 2))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = S, C, C, -S  # east, north of along, across
    n = 7 if settings.slow else 5
    A = np.zeros((T, n, n))
    A[:, range(n), range(n)] = 1.0
    A[1:, :2, :2] = turn[1:].transpose(0, 2, 1) @ turn[:-1]
    # across: v h times what the azimuth is off the one linearised about
    A[:, ALONG, SCALE], A[:, ACROSS, AZIMUTH], A[:, ACROSS, BIAS] = vh, vh, 0.5 * vh * h
    A[:, AZIMUTH, BIAS] = h
    u = np.zeros((T, 2))
    u[:, 0], u[:, 1] = vh * (-0.5 * h * w - middle), -h * w
    A[0], u[0] = np.eye(n), 0.0
    B = np.zeros((n, 2))
    B[ACROSS, 0] = B[AZIMUTH, 1] = 1.0
    out = np.zeros((T, 2, n))
    out[:, :, :2] = turn
    out[:, range(2), range(n - 2, n)] += 1.0 if settings.slow else 0.0
    step = float(np.median(h))
    known = [_SCALE_WALK * step, _BIAS_WALK * step]
    offset = n - 5
    counts = half_steps(drive)
    speed, yaw = max(settings.speed_floor, counts["speed"]), max(settings.yaw_floor, counts["yaw_rate"])
    low = [speed * step, settings.side_floor * step, yaw * step, *known]
    high = [20.0 * step, 5.0 * step, 1.0 * step, *known]
    noise = Uniform.unknown(at_least=[*low, *[settings.fix_floor] * offset], at_most=[*high, *[30.0] * offset])
    fixes = [max(settings.fix_floor, counts[axis]) for axis in ("east", "north")]
    fix = Uniform.unknown(at_least=fixes, at_most=[200.0] * 2)
    # where the offset begins cannot be told from where the car does: it begins at 0
    far = 1e3 + float(np.sum(np.abs(vh)))
    x0 = Box(
        [-far, -far, psi[0] - 2.0, 1 - settings.scale, -settings.bias, *[0.0] * offset],
        [far, far, psi[0] + 2.0, 1 + settings.scale, settings.bias, *[0.0] * offset],
    )
    names = ("along", "across", "azimuth", "speed_scale", "yaw_bias", "offset_east", "offset_north")[:n]
    given = {"x": names, "y": ("east", "north"), "u": ("across_moved", "turned")}
    return Linear(A, B, out, noise, fix, x0, names=given), u, turn
