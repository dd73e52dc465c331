"""Models of a moving vehicle, as plain `halfwidth.Linear` and `halfwidth.Nonlinear`.

`constant_velocity` and `gps_ins` are the linear model of Pavelková (2011), eqs. (21) to (23): position and velocity in
local metres, driven by acceleration. `two_antenna` is the seven-state model of Pavelková's slides on GPS and CAN data
(positions of two antennas, azimuth, speed, yaw rate) and `two_antenna_linear` its linearisation, whose input is the
displacement dead-reckoned from speed and azimuth. `ctrv` is the usual five-state model of constant turn rate and
velocity, optionally with a constant speed scale and yaw bias. Azimuth is clockwise from north, yaw rate positive to the
left, so that ``d azimuth / dt = -yaw rate``; a step moves along its *middle* azimuth (the papers' Euler step along the
first azimuth is 30 to 80 % worse within five seconds; ask for it with ``euler=True``).
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.errors import BadValue
from halfwidth.model import Linear, Names, Nonlinear, Prior
from halfwidth.noise import Gaussian, Mixed, Uniform
from halfwidth.spread import Box, Normal

Floats = NDArray[np.float64]
Given = ArrayLike | Uniform | Gaussian | Mixed | None

#: A prior that says nothing within 1000 km of the origin of the frame.
_FAR = 1e6


def constant_velocity(
    dt: ArrayLike | None = None,
    q: Given = None,
    r: Given = None,
    *,
    x0: Prior | None = None,
    acceleration: bool = True,
) -> Linear:
    """Return the model of a body that keeps its velocity but for a known acceleration.

    State: east, north (m), east_velocity, north_velocity (m/s); input: east and north acceleration (m/s^2); output:
    east and north (m). Pavelková (2011), eqs. (22) and (23).

    Parameters
    ----------
    dt : float or (T,) array, optional
        Step in seconds, one for all rows or one a row; without it every row of a record moves by its own step.
    q : (4,) half-widths, a noise, or None
        Noise of the state; numbers are half-widths of uniform noise, None is uniform noise of unknown half-widths.
    r : (2,) half-widths, a noise, or None
        Noise of the positions, likewise, m.
    x0 : Box or Normal, optional
        Prior; a box without ends if absent.
    acceleration : bool
        Whether there is an input.

    Returns
    -------
    Linear

    Examples
    --------
    >>> constant_velocity(0.1, q=[0.02, 0.02, 0.05, 0.05], r=[0.5, 0.5]).nu
    2
    """
    return Linear(
        _stepped(_cv_motion, dt),
        _stepped(_cv_push, dt) if acceleration else None,
        np.eye(2, 4),
        _noise(q),
        _noise(r),
        x0,
        names={
            "x": ("east", "north", "east_velocity", "north_velocity"),
            "y": ("east", "north"),
            "u": ("east_acceleration", "north_acceleration") if acceleration else (),
        },
        dt=1.0 if dt is None else float(np.ravel(dt)[0]),
    )


def gps_ins(dt: ArrayLike | None = None, q: Given = None, r: Given = None, *, x0: Prior | None = None) -> Linear:
    """Return the GPS/INS model of Pavelková (2011): `constant_velocity` with unknown half-widths.

    Parameters
    ----------
    dt, q, r, x0
        As in `constant_velocity`. The input is the acceleration in local axes, for a car from its speed and azimuth:
        the difference of ``speed * (sin azimuth, cos azimuth)`` over each step.

    Returns
    -------
    Linear
    """
    return constant_velocity(dt, q, r, x0=x0)


def two_antenna_linear(q: Given = None, r: Given = None, *, antennas: int = 2, x0: Prior | None = None) -> Linear:
    """Return the linearised two-antenna model: position moves by a displacement that is known up to noise.

    State and output: east and north of each antenna (m); input: displacement of the vehicle over the step (m), as
    `displacement` gives it. ``p[t] = p[t-1] + u[t] + w[t]``, ``p~[t] = p[t] + e[t]``.

    Parameters
    ----------
    q, r : half-widths, noise or None
        Noise of state and output, (2 * antennas,); None is uniform noise of unknown half-widths.
    antennas : {1, 2}
        With one antenna the first position only.
    x0 : Box or Normal, optional

    Returns
    -------
    Linear
    """
    names = tuple(f"{axis}{k + 1 if antennas > 1 else ''}" for k in range(antennas) for axis in ("east", "north"))
    return Linear(
        lambda dt: np.eye(2 * antennas),  # noqa: ARG005 - the input holds the step, whatever its length
        np.tile(np.eye(2), (antennas, 1)),
        np.eye(2 * antennas),
        _noise(q),
        _noise(r),
        x0,
        names={"x": names, "y": names, "u": ("east_moved", "north_moved")},
    )


def two_antenna(
    q: Given,
    r: Given,
    *,
    x0: Prior,
    baseline: tuple[float, float] | None = None,
    euler: bool = False,
    antennas: int = 2,
    rigid: bool = False,
    heading: bool = False,
    height: bool = False,
    acceleration: bool = False,
    bounds: Box | None = None,
) -> Nonlinear:
    """Return the seven-state model of a vehicle with two antennas, or one of its relatives.

    State: east1, north1, east2, north2 (m), azimuth (rad), speed (m/s), yaw_rate (rad/s). Output: the two positions,
    azimuth, speed and yaw rate. The azimuth output is that of the line from antenna 1 to antenna 2 plus what the line
    is turned from the vehicle's axis.

    Parameters
    ----------
    q, r : (nx,) and (ny,) half-widths, or a noise
        Noise of state and output.
    x0 : Box or Normal
        Prior of the state.
    baseline : (float, float), optional
        Antenna 2 as seen from antenna 1: metres forward, metres to the left. Only its direction enters. Without it
        the azimuth output is the azimuth state itself.
    euler : bool
        Move along the azimuth at the start of the step, as the slides do, instead of that in its middle.
    antennas : {1, 2}
        With one antenna the first position only, and no `baseline`.
    rigid : bool
        The line between the antennas turns with the vehicle. In the slides both move alike, and what a turn does to
        the second one is left to the noise.
    heading : bool
        A further output, last but for the altitude: the azimuth state itself, beside that of the line.
    height : bool
        Two further states, altitude (m) and pitch (rad, nose up): the vehicle climbs by ``sin pitch`` of the way it
        goes and moves across the map by ``cos pitch`` of it. A further output, the last: the altitude.
    acceleration : bool
        A further state, the last: acceleration (m/s^2), which the speed follows from one step to the next; the speed
        is that of the whole step that follows.
    bounds : Box, optional
        Restrictions on the states.

    Returns
    -------
    Nonlinear

    Raises
    ------
    BadValue
        If `antennas` is neither 2 nor 1 without a `baseline`.
    """
    if antennas not in (1, 2) or (antennas == 1 and baseline is not None):
        raise BadValue(f"`antennas` is {antennas!r}, 2, or 1 without a `baseline`, is expected")
    turned = None if baseline is None else float(np.arctan2(baseline[1], baseline[0]))
    a = 2 * antennas  # where the azimuth stands
    n = a + 3 + 2 * height

    def g(x: Any, u: Any, dt: Any) -> Any:  # noqa: ARG001 - the signature of a model
        azimuth = x[a] if euler else x[a] - 0.5 * dt * x[a + 2]
        way = dt * x[a + 1]
        flat = way * np.cos(x[a + 4]) if height else way
        moved = [x[k] + flat * (np.cos(azimuth) if k % 2 else np.sin(azimuth)) for k in range(a)]
        if rigid and antennas == 2:
            sin, cos = np.sin(-dt * x[a + 2]), np.cos(-dt * x[a + 2])
            line = x[2] - x[0], x[3] - x[1]
            moved[2:] = [moved[0] + line[0] * cos + line[1] * sin, moved[1] - line[0] * sin + line[1] * cos]
        moved += [x[a] - dt * x[a + 2], x[a + 1] + (dt * x[n] if acceleration else 0.0), x[a + 2]]
        moved += [x[a + 3] + way * np.sin(x[a + 4]), x[a + 4]] if height else []
        return np.array(moved + ([x[n]] if acceleration else []))

    def h(x: Any) -> Any:
        course = x[a] if turned is None else np.arctan2(x[2] - x[0], x[3] - x[1]) + turned
        seen = [*(x[k] for k in range(a)), course, x[a + 1], x[a + 2]]
        return np.array(seen + ([x[a]] if heading else []) + ([x[a + 3]] if height else []))

    numbers = ("1", "2") if antennas == 2 else ("",)
    x0 = x0.sized(n + acceleration, "x0") if isinstance(x0, Box) else x0
    places = tuple(f"{axis}{k}" for k in numbers for axis in ("east", "north"))
    states = (*places, "azimuth", "speed", "yaw_rate", *(("altitude", "pitch") if height else ()))
    outputs = (*states[: a + 3], *(("heading",) if heading else ()), *(("altitude",) if height else ()))
    return Nonlinear(
        g,
        h,
        _noise(q),
        _noise(r),
        x0,
        names=Names(states + (("acceleration",) if acceleration else ()), outputs, ()),
        bounds=bounds,
        x_angles=(a,),
        y_angles=(a, a + 3) if heading else (a,),
    )


def ctrv(q: Given, r: Given, *, x0: Prior | None = None, theta: bool = False, euler: bool = False) -> Nonlinear:
    """Return the model of constant turn rate and velocity.

    State: east, north (m), azimuth (rad), speed (m/s), yaw_rate (rad/s), and with `theta` the speed_scale and the
    yaw_bias (rad/s) of the sensors. Output: east, north, measured speed ``scale * speed`` and measured yaw rate
    ``yaw_rate + bias``.

    Parameters
    ----------
    q : (5,) or (7,) half-widths, or a noise
        Noise of the state over one step.
    r : (4,) half-widths, or a noise
        Noise of the outputs: m, m, m/s, rad/s.
    x0 : Box or Normal, optional
        Prior; if absent, unknown position and azimuth, 20 m/s, 0.5 rad/s, scale within 3 % and bias within 0.01 rad/s
        as standard deviations.
    theta : bool
        Whether speed scale and yaw bias are states.
    euler : bool
        Move along the azimuth at the start of the step instead of that in its middle.

    Returns
    -------
    Nonlinear
    """
    n = 7 if theta else 5

    def g(x: Any, u: Any, dt: Any) -> Any:  # noqa: ARG001 - the signature of a model
        azimuth = x[2] if euler else x[2] - 0.5 * dt * x[4]
        moved = [x[0] + dt * x[3] * np.sin(azimuth), x[1] + dt * x[3] * np.cos(azimuth), x[2] - dt * x[4]]
        return np.array([*moved, *(x[k] for k in range(3, n))])

    def h(x: Any) -> Any:
        if theta:
            return np.array([x[0], x[1], x[5] * x[3], x[4] + x[6]])
        return np.array([x[0], x[1], x[3], x[4]])

    if x0 is None:
        mean = [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
        variances = np.array([_FAR**2, _FAR**2, 10.0, 400.0, 0.25, 9e-4, 1e-4])
        x0 = Normal(mean[:n], variances[:n])
    names = ("east", "north", "azimuth", "speed", "yaw_rate", "speed_scale", "yaw_bias")[:n]
    outputs = ("east", "north", "speed", "yaw_rate")
    return Nonlinear(g, h, _noise(q), _noise(r), x0, names=Names(names, outputs, ()), x_angles=(2,))


def displacement(azimuth: ArrayLike, speed: ArrayLike, dt: ArrayLike, *, euler: bool = False) -> Floats:
    """Return the displacement over each step, dead-reckoned from speed and azimuth.

    Parameters
    ----------
    azimuth : (T,) array_like
        Azimuth at each row, rad, continuous.
    speed : (T,) array_like
        Mean speed over the step that ends in each row, m/s.
    dt : (T,) array_like
        That step, s.
    euler : bool
        Use the azimuth at the start of the step, as the papers do, instead of that in its middle.

    Returns
    -------
    (T, 2) array
        East and north in metres; the first row stays where it is.
    """
    a, v, h = np.asarray(azimuth, float), np.asarray(speed, float), np.asarray(dt, float)
    before = np.concatenate((a[:1], a[:-1]))
    along = before if euler else 0.5 * (before + a)
    moved: Floats = (h * v)[:, None] * np.column_stack((np.sin(along), np.cos(along)))
    moved[:1] = 0.0
    return moved


def _cv_motion(dt: ArrayLike) -> Floats:
    """Return A, (4, 4) or (T, 4, 4)."""
    h = np.asarray(dt, float)
    A = np.zeros((*h.shape, 4, 4))
    A[..., range(4), range(4)] = 1.0
    A[..., 0, 2] = A[..., 1, 3] = h
    return A


def _cv_push(dt: ArrayLike) -> Floats:
    """Return B, (4, 2) or (T, 4, 2)."""
    h = np.asarray(dt, float)
    B = np.zeros((*h.shape, 4, 2))
    B[..., 0, 0] = B[..., 1, 1] = 0.5 * h**2
    B[..., 2, 0] = B[..., 3, 1] = h
    return B


def _stepped(function: Callable[[ArrayLike], Floats], dt: ArrayLike | None) -> Any:
    """Return the matrices of these steps, or the function of the step that a model calls row by row."""
    return (lambda dt: function(dt)) if dt is None else function(dt)


def _noise(given: Given) -> Uniform | Gaussian | Mixed:
    """Take numbers as half-widths and None as unknown ones."""
    if given is None:
        return Uniform.unknown()
    return given if isinstance(given, Uniform | Gaussian | Mixed) else Uniform(given)
