"""Calibration from the log itself: clocks, speed scale, yaw bias, antenna, units and signs, standstill, steps.

The fixes are the reference. Units and signs come first, as they are factors that no sensor error comes near. Then the
clock of each stream is looked for roughly, by sliding it along what fixes a second or a few apart show of it, and then
finely by dead reckoning (`reckoning`), piece by piece of some minutes. The pieces are independent, so their information
adds up, and their scatter about the common answer says whether it can be believed: standard deviations are widened by
it where it is larger than they say, a clock that drifts shows as pieces that disagree in order of time, and an offset
that stays vague is called not observable and not applied. A clock that steps shows already in the rough look, where two
offsets, one before and one after, fit much better than one: the drive is cut there. A wrong clock poisons scale and
bias, so all of them are unknowns of one problem.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import BadValue
from halfwidth.vehicle import evidence, reckoning, rolling
from halfwidth.vehicle.clocks import OBSERVABLE, alike, marginal, offset_of, suspected
from halfwidth.vehicle.frames import wrapped
from halfwidth.vehicle.grid import Grid, sampled
from halfwidth.vehicle.log import STREAMS, Log
from halfwidth.vehicle.rough import WIDEST, Rough, cut_of
from halfwidth.vehicle.sensors import AS_LOGGED, STREAM, Calibration, Offset
from halfwidth.vehicle.units import contradicted_yaw, matched_factor

Floats = NDArray[np.float64]

#: A piece lasts about this long, s; so many are looked at, at most; a pause of all streams ends one, s.
PIECE, MOST_PIECES, PAUSE = 150.0, 40, 30.0

#: Fixes that a piece needs, and metres that the car must have moved in it.
FEWEST, LEAST_WAY = 20, 30.0

#: An antenna off the axle is believed when it is this many standard deviations off, known to this many metres, and the
#: slow error of the fixes moves by less than this many metres in the time of a turn (10 s).
ANTENNA_SIGMAS, ANTENNA_SD, ANTENNA_SLOW = 5.0, 0.3, 0.3

#: Slower than this a car stands, m/s; times this near to moving are not counted, s; the least length, s.
STANDING, EDGE, SHORTEST = 0.1, 1.0, 1.0

#: The bias is told every so many seconds.
KNOT = 30.0

#: Rounds with the antenna on the axle, then off it.
_ROUNDS, _MORE = 12, 6

#: An azimuth that is further off than this is worth a word, rad.
_TURNED = 0.35

_SENSORS = ("speed", "yaw_rate")


def calibrated(log: Log, *, clock_offset: float | None = None) -> Calibration:
    """Find clocks, scale, bias, antenna, units and signs of a log from the log itself.

    Parameters
    ----------
    log : Log
    clock_offset : float, optional
        Seconds to add to the time stamps of speed and yaw rate, where they are known; found if absent.

    Returns
    -------
    Calibration
        Also for a log that tells nothing: then it says so and changes nothing.

    Raises
    ------
    BadValue
        If `clock_offset` is longer than the log, so that no fix and no sample of a sensor would meet.
    """
    length = float(log.t[-1] - log.t[0]) if len(log) else 0.0
    if clock_offset is not None and abs(clock_offset) > max(length, WIDEST):
        raise BadValue(
            f"`clock_offset` is {clock_offset:g} s but the log is only {length:.1f} s long: no fix would have a speed",
            hint="give seconds, or leave it away: it is found from the log",
        )
    known = replace(AS_LOGGED, steps=steps_of(log))
    fixes = int(log.fixed.sum())
    there = [name for name in _SENSORS if np.isfinite(getattr(log, STREAM[name])).any()]
    given = Offset() if clock_offset is None else Offset(float(clock_offset), 0.0, True, given=True)
    known = replace(known, offsets=dict.fromkeys(there, given))
    if fixes < FEWEST or not there:
        return known
    known = _units(log, known)
    rough = Rough.of(log, known)
    first = {name: given.seconds if given.given else rough.offset(name) for name in there}
    start = {name: Offset(seconds, 0.0, True) for name, seconds in first.items()}
    known = replace(known, still=standstills(log, replace(known, offsets=start)))
    grid = sampled(log)
    cut = None if given.given else cut_of(log, known, rough)
    plain = replace(known, offsets={}, still=AS_LOGGED.still)
    streams: reckoning.Streams = {name: plain.stream(log, name) for name in _SENSORS}
    if "speed" not in there:
        streams = {**streams, "speed": _speed_of_fixes(grid)}

    def asked(cut: float | None) -> tuple[list[Grid], list[reckoning.Piece], list[reckoning.Piece]]:
        parts = _parts(grid, cut)
        solved = [_solved(part, streams, known, rough, first, fixed=given.given) for part in parts]
        return parts, solved, [piece for piece in solved if piece.sound]

    parts, solved, pieces = asked(cut)
    if cut is None and not given.given:
        which = [1 + _SENSORS.index(name) for name in there]
        when, gain = suspected(pieces, which)
        for other in () if when is None else (rough.likeliest(), when):
            again = () if other is None else asked(other)
            if again and (cut is None or suspected(again[2], which)[1] > gain):
                cut, gain = other, suspected(again[2], which)[1]
                parts, solved, pieces = again
    if not pieces:
        return known
    known = _joined(known, pieces, there, given, cut)
    rolled = _wheels(log, parts, streams, known, solved, given, cut)
    if rolled is not None:
        known, streams, solved = rolled
        pieces = [piece for piece in solved if piece.sound]
    off = _antenna(parts, streams, known, solved, given, cut)
    if off is not None:
        known = off
    known = _azimuth(log, known, pieces)
    t, rate = replace(known, bias=0.0, bias_at=(), still=AS_LOGGED.still).stream(log, "yaw_rate")
    standing = rate[known.stands(t)]
    return replace(known, still_bias=float(np.median(standing))) if standing.size >= 5 else known


def steps_of(log: Log) -> dict[str, float]:
    """Return the quantisation step of each stream that has one, in units of the log."""
    found = {}
    for name in STREAMS:
        values = log.stream(name)[1]
        step = quantisation(values) if values.size >= 20 else None
        if step is not None:
            found[name] = step
    return found


def quantisation(values: Floats) -> float | None:
    """Give the step that all values are multiples of, None if they have none.

    Rounding of the step itself is allowed for: 5 km/h written as 1.3889 m/s counts.

    Parameters
    ----------
    values : (n,) array

    Returns
    -------
    float or None
    """
    distinct = np.unique(values)
    if distinct.size < 3:
        return None
    offset = distinct - distinct[0]
    step = np.diff(distinct)
    step = step[step > 1e-9 * max(1.0, float(np.abs(distinct).max()))]
    if step.size == 0:
        return None
    guess = float(np.quantile(step, 0.02, method="lower"))
    whole = np.round(offset / guess)
    # a wrong guess of a coarse step adds up: fit it over near multiples first
    near = (whole > 0) & (whole < 50)
    if near.any():
        guess = float(np.median(offset[near] / whole[near]))
        whole = np.round(offset / guess)
    off = np.abs(offset / guess - whole)
    return guess if float((off < 0.12).mean()) > 0.95 else None


def _units(log: Log, known: Calibration) -> Calibration:
    """Settle units and signs that the fixes contradict beyond doubt."""
    speed = matched_factor(evidence.speed_ratio(log)) if "speed" in known.offsets else None
    yaw = contradicted_yaw(evidence.turning(log)) if "yaw_rate" in known.offsets else None
    messages = []
    if speed is not None and speed[3] == 1:
        messages.append(f"{speed[1]}, as distances between fixes say (ratio {speed[0]:.3g}): taken so")
        known = replace(known, speed_factor=speed[2])
    if yaw is not None:
        words = "in deg/s" if abs(yaw) < 0.5 else "in rad/s, not deg/s" if abs(yaw) > 2 else ""
        words += (" and " if words and yaw < 0 else "") + ("positive to the right" if yaw < 0 else "")
        messages.append(f"yaw rate is {words}, as courses between fixes say: taken so")
        known = replace(known, yaw_factor=yaw)
    return replace(known, messages=tuple(messages))


def standstills(log: Log, known: Calibration) -> Floats:
    """Find the times at which the car surely stands, (n, 2), s: the speed is zero, and has been for a while."""
    t, speed = known.stream(log, "speed")
    if t.size < 3:
        return np.empty((0, 2))
    low = np.abs(speed) < max(STANDING, 0.5 * known.steps.get("speed_mps", 0.0) * abs(known.speed_factor))
    edge = np.flatnonzero(np.diff(np.concatenate(([0], low.astype(np.int8), [0]))))
    first, last = t[edge[::2]] + EDGE, t[edge[1::2] - 1] - EDGE
    long = last - first >= SHORTEST
    return np.column_stack((first[long], last[long]))


# ---- piece by piece ------------------------------------------------------------------------------------------------


def _parts(grid: Grid, cut: float | None) -> list[Grid]:
    """Cut a drive into pieces in which there is something to see, evenly spread if many; none passes `cut`."""
    fixes = grid.t[grid.seen]
    ends = np.flatnonzero(np.diff(fixes) > PAUSE)
    if cut is not None and fixes[0] < cut < fixes[-1]:
        ends = np.union1d(ends, int(np.searchsorted(fixes, cut)) - 1)
    blocks = zip(np.concatenate(([0], ends + 1)), np.concatenate((ends, [fixes.size - 1])), strict=True)
    parts = []
    for a, b in blocks:
        n = max(1, round((fixes[b] - fixes[a]) / PIECE))
        cuts = np.linspace(fixes[a], fixes[b], n + 1)
        parts += [grid.between(lo - 1e-9, hi + 1e-9) for lo, hi in pairwise(cuts)]
    able = [part for part in parts if int(part.seen.sum()) >= FEWEST and _way(part) >= LEAST_WAY]
    if len(able) > MOST_PIECES:
        able = [able[k] for k in np.linspace(0, len(able) - 1, MOST_PIECES).astype(int)]
    return able


def _way(part: Grid) -> float:
    """Return how far the car got, m: the longest way from the first fix."""
    east, north = part.east[part.seen], part.north[part.seen]
    return float(np.hypot(east - east[0], north - north[0]).max())


def _speed_of_fixes(grid: Grid) -> tuple[Floats, Floats]:
    """Return a speed for a log without one: that between fixes a second apart."""
    seen = np.flatnonzero(grid.seen)
    t = grid.t[seen]
    ahead = np.minimum(np.searchsorted(t, t + 1.0 - 1e-6), t.size - 1)
    took = t[ahead] - t
    good = took > 0
    way = np.hypot(grid.east[seen[ahead]] - grid.east[seen], grid.north[seen[ahead]] - grid.north[seen])
    middle = 0.5 * (t[ahead] + t)[good]
    new = np.concatenate(([True], np.diff(middle) > 1e-6))
    return middle[new], (way[good] / took[good])[new]


def _solved(
    part: Grid, streams: reckoning.Streams, known: Calibration, rough: Rough, first: dict[str, float], *, fixed: bool
) -> reckoning.Piece:
    """Solve one piece from its own rough offsets; from those of the drive if that fits better."""
    common = tuple(first.get(name, 0.0) for name in _SENSORS)
    own = tuple(
        rough.offset(name, part.t[0], part.t[-1]) if not fixed and name in first else common[k]
        for k, name in enumerate(_SENSORS)
    )
    still = _still(part, known)
    piece = reckoning.solve(part, streams, still, (common[0], common[1]), fixed_clocks=fixed, rounds=_ROUNDS)
    if max(abs(a - b) for a, b in zip(common, own, strict=True)) > 0.3:
        other = reckoning.solve(part, streams, still, (own[0], own[1]), fixed_clocks=fixed, rounds=_ROUNDS)
        if other.loglik > piece.loglik + 10.0:
            return other
    return piece


def _still(part: Grid, known: Calibration) -> NDArray[np.bool_]:
    """Return over which steps of a grid the car stands."""
    before = np.concatenate((part.t[:1], part.t[:-1]))
    return known.stands(part.t) & known.stands(before)


# ---- all pieces together -------------------------------------------------------------------------------------------


def _joined(
    known: Calibration, pieces: Sequence[reckoning.Piece], there: Sequence[str], given: Offset, cut: float | None
) -> Calibration:
    """Add up what the pieces say; find out whether a clock changes."""
    mean, sd, spread = _together(pieces)
    offsets = dict.fromkeys(there, given)
    if not given.given:
        for name in there:
            k = 1 + _SENSORS.index(name)
            size = float(sd[k] * max(1.0, spread[k]))
            offsets[name] = offset_of(pieces, k, Offset(float(mean[k]), size, size < OBSERVABLE), cut)
        stepping = next((one for one in offsets.values() if one.change == "step"), None)
        for name, one in offsets.items():
            if stepping is not None and one.change == "":
                offsets[name] = alike(pieces, 1 + _SENSORS.index(name), one, stepping)
    bias = np.array([piece.bias.mean() for piece in pieces])
    # a bias drifts: the pieces count by how long they are sure of it, not by how sure
    variance = np.array([piece.bias_sd**2 for piece in pieces])
    weight = 1.0 / (variance + max(float(np.var(bias)) - float(np.median(variance)), 0.0))
    shift = _steady(pieces) - bias
    knots = [(t, b + by) for piece, by in zip(pieces, shift.tolist(), strict=True) for t, b in _knots(piece)]
    some = float(weight @ bias / weight.sum())
    scale_known = bool(sd[0] < 0.5 * reckoning.PRIOR[0]) and "speed" in there
    yaw_known = "yaw_rate" in there
    return replace(
        known,
        offsets=offsets,
        scale=float(mean[0]) if scale_known else 1.0,
        scale_sd=float(sd[0] * max(1.0, spread[0])) if scale_known else float("inf"),
        bias=some if yaw_known else 0.0,
        bias_sd=float(weight.sum() ** -0.5) if yaw_known else float("inf"),
        bias_at=tuple(knots) if yaw_known else (),
        slip=float(np.median([piece.sigma[1] for piece in pieces])),
        noise=dict(zip(reckoning.GROUPS, np.median([piece.sigma for piece in pieces], axis=0).tolist(), strict=True)),
    )


def _steady(pieces: Sequence[reckoning.Piece]) -> Floats:
    """Return the mean bias (n,) of each piece, given the others: what a piece hardly tells its neighbours do.

    From piece to piece the bias walks as in `reckoning`, or by more where the pieces differ by more than they may.
    """
    bias = np.array([piece.bias.mean() for piece in pieces])
    variance = np.array([piece.bias_sd**2 for piece in pieces])
    if bias.size < 2:
        return bias
    apart = np.diff([piece.t.mean() for piece in pieces])
    excess = np.diff(bias) ** 2 - variance[1:] - variance[:-1]
    walk = np.maximum(reckoning.BIAS_WALK**2, max(float(excess.sum() / apart.sum()), 0.0)) * apart
    steps = np.diff(np.eye(bias.size), axis=0)
    return np.asarray(np.linalg.solve(np.diag(1 / variance) + steps.T @ (steps / walk[:, None]), bias / variance))


def _knots(piece: reckoning.Piece) -> list[tuple[float, float]]:
    """Return times, about `KNOT` apart, and the mean bias around each."""
    n = max(1, round(float(piece.t[-1] - piece.t[0]) / KNOT))
    parts = np.array_split(np.arange(piece.t.size), min(n, piece.t.size))
    return [(float(piece.t[part].mean()), float(piece.bias[part].mean())) for part in parts]


def _together(pieces: Sequence[reckoning.Piece]) -> tuple[Floats, Floats, Floats]:
    """Return mean, standard deviation and scatter over it, (5,) each, of independent pieces; strays count less."""
    prior = np.diag(reckoning.PRIOR**-2.0)
    centre = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    weight = np.ones(len(pieces))
    mean, own = centre, np.array([marginal(piece) for piece in pieces])
    for _ in range(10):
        total = prior + sum(w * piece.information for w, piece in zip(weight, pieces, strict=True))
        moment = prior @ centre + sum(
            w * piece.information @ piece.mean for w, piece in zip(weight, pieces, strict=True)
        )
        mean = np.linalg.solve(total, moment)
        far = np.array([np.abs(piece.mean - mean)[:3] for piece in pieces]) / own[:, :3]
        weight = np.minimum(1.0, (4.0 / np.maximum(far.max(axis=1), 1e-9)) ** 2)
    sd = np.sqrt(np.diag(np.linalg.inv(total)))
    squares = np.array([(piece.mean - mean) ** 2 for piece in pieces]) / own**2
    spread = np.sqrt(np.sum(weight[:, None] * squares, axis=0) / max(len(pieces) - 1, 1))
    return mean, sd, spread


def _wheels(
    log: Log,
    parts: Sequence[Grid],
    streams: reckoning.Streams,
    known: Calibration,
    solved: Sequence[reckoning.Piece],
    given: Offset,
    cut: float | None,
) -> tuple[Calibration, reckoning.Streams, list[reckoning.Piece]] | None:
    """Take the speed for that of wheels ahead of the rear axle; return what that gives if the log shows them."""
    if not {"speed", "yaw_rate"} <= set(known.offsets):
        return None
    ahead = rolling.wheels([(part, piece) for part, piece in zip(parts, solved, strict=True) if piece.sound], streams)
    if ahead is None:
        return None
    known = replace(known, wheels=ahead[0], wheels_sd=ahead[1])
    t, speed = streams["speed"]
    rolled = known.at_axle(log, known.offsets["speed"].moved(t), known.scale * speed) / known.scale
    streams = {**streams, "speed": (t, rolled)}
    again = [
        reckoning.solve(
            part,
            streams,
            _still(part, known),
            (float(piece.mean[1]), float(piece.mean[2])),
            fixed_clocks=given.given,
            rounds=_MORE,
            start=piece,
        )
        if piece.sound
        else piece
        for part, piece in zip(parts, solved, strict=True)
    ]
    sound = [piece for piece in again if piece.sound]
    return (_joined(known, sound, tuple(known.offsets), given, cut), streams, again) if sound else None


def _antenna(
    parts: Sequence[Grid],
    streams: reckoning.Streams,
    known: Calibration,
    solved: Sequence[reckoning.Piece],
    given: Offset,
    cut: float | None,
) -> Calibration | None:
    """Let the antenna sit off the axle; return what that gives if the log tells where."""
    clocks = [known.offsets[name].seconds if name in known.offsets else 0.0 for name in _SENSORS]
    good = [(part, piece) for part, piece in zip(parts, solved, strict=True) if piece.sound]
    slow = float(np.median([piece.sigma[3] for _, piece in good])) * np.sqrt(10.0)
    if "yaw_rate" not in known.offsets or "speed" not in known.offsets or slow > ANTENNA_SLOW:
        return None
    found = [
        reckoning.solve(
            part,
            streams,
            _still(part, known),
            (clocks[0], clocks[1]),
            antenna=True,
            fixed_clocks=given.given,
            rounds=_MORE,
            start=piece,
        )
        for part, piece in good
    ]
    found = [piece for piece in found if piece.sound]
    if not found:
        return None
    mean, sd, spread = _together(found)
    place, place_sd = mean[3:], (sd * np.maximum(spread, 1.0))[3:]
    known = replace(known, antenna_sd=(float(place_sd[0]), float(place_sd[1])))
    off = bool(np.hypot(*(place / place_sd)) > ANTENNA_SIGMAS and place_sd.max() < ANTENNA_SD)
    if not off:
        return known
    path = np.concatenate([np.column_stack((piece.t, piece.azimuth)) for piece in found])
    known = _joined(known, found, tuple(known.offsets), given, cut)
    return replace(known, antenna=(float(place[0]), float(place[1])), antenna_observable=True, path=_continuous(path))


def _continuous(path: Floats) -> Floats:
    """Put times in order and azimuths on one sheet."""
    path = path[np.concatenate(([True], np.diff(path[:, 0]) > 0))]
    return np.column_stack((path[:, 0], np.unwrap(path[:, 1])))


# ---- the receiver's azimuth ----------------------------------------------------------------------------------------


def _azimuth(log: Log, known: Calibration, pieces: Sequence[reckoning.Piece]) -> Calibration:
    """Find the clock of the receiver's azimuth and what it adds, from the azimuth of the path."""
    t, given = log.stream("azimuth_rad")
    if t.size < FEWEST:
        return known
    blocks = []
    for piece in pieces:
        inside = (t > piece.t[0] + 3) & (t < piece.t[-1] - 3)
        blocks += [np.flatnonzero(inside)[i : i + 200] for i in range(0, int(inside.sum()), 200)]
    path = _continuous(np.concatenate([np.column_stack((piece.t, piece.azimuth)) for piece in pieces]))
    rate = np.gradient(path[:, 1], path[:, 0])
    v = np.interp(t, *known.stream(log, "speed")) if "speed" in known.offsets else np.full(t.size, 10.0)
    # a receiver, or a pair of antennas, may sit turned round
    off = wrapped(given - np.interp(t, path[:, 0], path[:, 1]))[np.abs(v) > 2.0]
    mean = np.exp(1j * off).mean() if off.size else 1.0
    error = float(np.angle(mean)) if abs(mean) > 0.9 else 0.0
    offset, sd = 0.0, float("inf")
    for _ in range(5):
        off = wrapped(given - np.interp(t + offset, path[:, 0], path[:, 1]))
        turn = np.interp(t + offset, path[:, 0], rate)
        counted = (np.abs(v) > 2.0) & (np.abs(off - error) < 0.5)
        rows = [block[counted[block]] for block in blocks]
        rows = [block for block in rows if block.size >= 5]
        if sum(block.size for block in rows) < FEWEST:
            return known
        every = np.concatenate(rows)
        scale = 3.0 * 1.4826 * float(np.median(np.abs(off[every] - np.median(off[every])))) + 1e-4
        weight = np.minimum(1.0, scale / np.maximum(np.abs(off - error), 1e-9))
        columns = np.column_stack((turn, np.ones(t.size)))
        normal = np.einsum("n,ni,nj->ij", weight[every], columns[every], columns[every]) + 1e-9 * np.eye(2)
        found = np.linalg.solve(normal, columns[every].T @ (weight * off)[every])
        # neighbouring samples err alike: the scatter of sums over blocks counts, not that of samples
        rest = weight * (off - columns @ found)
        scores = np.array([columns[block].T @ rest[block] for block in rows])
        inverse = np.linalg.inv(normal)
        sd = float(np.sqrt((inverse @ (scores.T @ scores) @ inverse)[0, 0]))
        offset = float(np.clip(offset + np.clip(found[0], -0.4, 0.4), -WIDEST, WIDEST))
        error = float(found[1])
    observable = bool(sd < OBSERVABLE and len(rows) >= 3)
    offsets = {**known.offsets, "azimuth": Offset(offset, sd, observable)}
    said = f"the azimuth points {np.degrees(error):+.0f} degrees off the way that the fixes go: turned by that"
    messages = (*known.messages, said) if abs(error) > _TURNED else known.messages
    return replace(known, offsets=offsets, course_error=error, messages=messages)
