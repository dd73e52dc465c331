"""Extended and unscented Kalman filter and smoother for nonlinear models with Gaussian noise.

``x[t] = g(x[t-1], u[t]) + w[t]``, ``y[t] = h(x[t]) + e[t]``. The extended filter linearises g and h at the estimate
[1]_; the unscented filter carries sigma points through them [2]_. With ``smooth=True`` a Rauch-Tung-Striebel pass
uses the whole record. ``g`` and ``h`` are recorded once a run and then run compiled, the whole record in C++; where
that is not possible the same algorithm runs in NumPy. ``info["evaluated"]`` says which, ``info["reason"]`` why;
``info["nis"]`` is the normalised square of each row's innovation, ``info["x0"]`` and ``info["P0"]`` the smoothed
state one step before the first row.

References
----------
.. [1] Bell and Cathey (1993), IEEE TAC 38(2); Bell (1994), SIAM J. Optimization 4(3), for the iterations.
.. [2] Julier and Uhlmann (2004), Proc. IEEE 92(3); Wan and van der Merwe (2000), eq. (15), for the scaling.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from halfwidth import methods
from halfwidth.array import Array
from halfwidth.call import arity
from halfwidth.derivative import differences
from halfwidth.errors import BadShape, BadValue, HalfwidthError, Refused, hinted
from halfwidth.methods._deviations import Function, Spread, scan
from halfwidth.methods._protocol import typed
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.noise import Gaussian, unknown_variances
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Normal
from halfwidth.tape import Tape, Untraceable
from halfwidth.trace import compiled
from halfwidth.varying import Varying

#: Points where a tape is compared with its function before a run, and rows of the answer after it.
_CHECKS = 8


@dataclass(frozen=True)
class ExtendedKalman:
    """Extended Kalman filter, or smoother: g and h are linearised at the estimate.

    Parameters
    ----------
    smooth : bool
        Use the whole record at every row.
    iterations : int
        Linearisations. The filter repeats each correction at its own answer, the smoother the whole pass at its own
        trajectory (Gauss-Newton); more than 1 helps where h bends within the standard deviation of the prediction.
    compiled : bool
        Run compiled where `g` and `h` allow it; False keeps to Python.

    Raises
    ------
    BadValue
        If a setting is out of its domain.

    Examples
    --------
    >>> import halfwidth as hw
    >>> range_only = hw.Nonlinear(
    ...     lambda x: x,
    ...     lambda x: np.hypot(x[0], x[1]),
    ...     hw.Gaussian(1e-4),
    ...     hw.Gaussian(0.01),
    ...     hw.Normal([3.0, 4.0], 0.1),
    ... )
    >>> hw.estimate(range_only, hw.Record([0.0, 1.0], [5.1, None]), ExtendedKalman()).x.round(3)
    array([[3.055, 4.073],
           [3.055, 4.073]])
    """

    smooth: bool = False
    iterations: int = 1
    compiled: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.iterations, int) or self.iterations < 1:
            raise BadValue(f"`iterations` is {self.iterations!r}, a whole number from 1 was expected")

    def refuses(self, model: Model) -> str | None:
        """Return why the model cannot be taken, or None."""
        return _refuses(self, model)

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:  # noqa: ARG002
        """Estimate the states; see `halfwidth.estimate`."""
        return _run(self, model, record, Spread(0.0, 0.0, 0.0), self.iterations)

    def init(self, model: Model) -> "Belief":
        """Return the belief one step before the first row, for a stream."""
        return _init(self, model)

    def step(self, model: Model, state: "Belief", y: Array, u: Array | None, t: float, dt: float) -> "Belief":
        """Return the belief after one row."""
        return _step(model, state, y, u, t, dt, Spread(0.0, 0.0, 0.0), self.iterations)

    def belief(self, model: Model, state: "Belief") -> tuple[Array, Array, float]:  # noqa: ARG002
        """Return mean, covariance and log-likelihood."""
        return state.x, state.P, state.loglik


@dataclass(frozen=True)
class UnscentedKalman:
    """Unscented Kalman filter, or smoother: 2 nx + 1 sigma points are carried through g and h.

    The defaults put the points ``sqrt(nx)`` standard deviations out and give no point a negative weight, so covariances
    cannot turn indefinite. Small `alpha` (such as 1e-3) gathers the points at the mean and gives the centre a large
    negative weight; where that would make a covariance indefinite the negative part is left out and the status is
    REDUCED.

    Parameters
    ----------
    smooth : bool
        Use the whole record at every row.
    alpha, beta, kappa : float
        Scaled sigma points: distance ``alpha * sqrt(nx + kappa)``; `beta` adds to the covariance weight of the centre,
        2 is best for Gaussian states.
    compiled : bool
        Run compiled where `g` and `h` allow it; False keeps to Python.

    Raises
    ------
    BadValue
        If a setting is out of its domain.
    """

    smooth: bool = False
    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0
    compiled: bool = True

    def __post_init__(self) -> None:
        if not 0.0 < self.alpha < np.inf:
            raise BadValue(f"`alpha` is {self.alpha!r}, a positive number was expected", hint="alpha=1.0")
        for name in ("beta", "kappa"):
            if not np.isfinite(getattr(self, name)):
                raise BadValue(f"`{name}` is {getattr(self, name)!r}, a finite number was expected")

    def refuses(self, model: Model) -> str | None:
        """Return why the model cannot be taken, or None."""
        if model.nx + self.kappa <= 0:
            return (
                f"`UnscentedKalman` needs nx + kappa > 0 but nx is {model.nx} and kappa {self.kappa:g}\n"
                f"hint: UnscentedKalman(kappa={3 - model.nx if model.nx < 3 else 0})"
            )
        return _refuses(self, model)

    def spread(self, nx: int) -> Spread:
        """Return distance and weights of the sigma points of `nx` states."""
        square = self.alpha**2 * (nx + self.kappa)
        return Spread(float(np.sqrt(square)), 2.0 - nx / square - self.alpha**2 + self.beta, 0.5 / square)

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:  # noqa: ARG002
        """Estimate the states; see `halfwidth.estimate`."""
        return _run(self, model, record, self.spread(model.nx), 1)

    def init(self, model: Model) -> "Belief":
        """Return the belief one step before the first row, for a stream."""
        return _init(self, model)

    def step(self, model: Model, state: "Belief", y: Array, u: Array | None, t: float, dt: float) -> "Belief":
        """Return the belief after one row."""
        return _step(model, state, y, u, t, dt, self.spread(model.nx), 1)

    def belief(self, model: Model, state: "Belief") -> tuple[Array, Array, float]:  # noqa: ARG002
        """Return mean, covariance and log-likelihood."""
        return state.x, state.P, state.loglik


Method = ExtendedKalman | UnscentedKalman


class Belief(NamedTuple):
    """What a stream remembers between rows: moments, log-likelihood, and the tapes of g and h if there are any."""

    x: Array
    P: Array
    loglik: float
    g: Tape | None
    h: Tape | None


class _Rows(NamedTuple):
    """A record as the filters want it: rows of the inputs of g, and the noise of each row."""

    t: Array
    y: Array
    seen: Any
    more: tuple[Any, ...]  # further arguments of g: u (T, nu) or None, dt (T,)
    Q: tuple[Array, Any]
    R: tuple[Array, Any]

    def arguments(self, k: int) -> tuple[Any, ...]:
        """Further arguments of g in row k."""
        return tuple(None if a is None else float(a[k]) if a.ndim == 1 else a[k] for a in self.more)

    def columns(self) -> Array:
        """Return the same as one matrix (T, number of inputs)."""
        blocks = [a.reshape(len(self.t), -1) for a in self.more if a is not None]
        return np.ascontiguousarray(np.concatenate(blocks, axis=1)) if blocks else np.empty((len(self.t), 0))


def _refuses(method: Method, model: Model) -> str | None:
    name = type(method).__name__
    if isinstance(model, Linear):
        loaded = methods.load("KalmanSmoother" if method.smooth else "KalmanFilter")()
        reason: str | None = loaded.refuses(model)
        return None if reason is None else reason.replace(type(loaded).__name__, name)
    if not isinstance(model.w, Gaussian) or not isinstance(model.e, Gaussian):
        given = f"`w` is {type(model.w).__name__}, `e` is {type(model.e).__name__}"
        return f"`{name}` needs Gaussian noise but {given}\nhint: model.as_gaussian(), or ParticleFilter()"
    if (reason := unknown_variances(model.w, model.e, name)) is not None:
        return reason
    if not isinstance(model.x0, Normal):
        return f"`{name}` needs a Gaussian prior but `x0` is a {type(model.x0).__name__}\nhint: x0=Normal(mean, P)"
    if model.bounds is not None:
        return f"`{name}` cannot keep `bounds`\nhint: Constrained({name}()), or ParticleFilter()"
    if model.loss is not None:
        return f"`{name}` cannot tell losses from outputs\nhint: a model without `loss`, and NaN where y was lost"
    return None


def _rows(model: Nonlinear, t: Array, dt: Array, y: Array, u: Array | None) -> _Rows:
    more = (u, dt)[: arity(model.g, 3) - 1]
    return _Rows(t, y, ~np.isnan(y), more, _stack(model.w.cov(), t, dt), _stack(model.e.cov(), t, dt))


def _stack(matrix: Varying, t: Array, dt: Array) -> tuple[Array, Any]:
    stack, index = matrix.stack(t, dt)
    return np.ascontiguousarray(stack), index


def _run(method: Method, model: Model, record: Record, spread: Spread, iterations: int) -> Estimate:
    if isinstance(model, Linear):  # a linear function is its own linearisation: this is the Kalman filter
        name = "KalmanSmoother" if method.smooth else "KalmanFilter"
        estimate: Estimate = methods.load(name)().run(model, record)
        return dataclasses.replace(estimate, method=typed(method))
    rows = _rows(model, record.t, record.steps(model.dt), record.y, record.u)
    tapes, reason = _tapes(model, rows, exact=spread.distance == 0.0, wanted=method.compiled)
    found, rounds = _iterated(model, rows, tapes, spread, iterations, method.smooth)
    if tapes is not None and not _holds(model, rows, tapes, found["x"]):
        reason = "what was recorded gives other values than the functions at the states found"
        tapes = None
        found, rounds = _iterated(model, rows, tapes, spread, iterations, method.smooth)
    status, message = _judged(found, record.t)
    info: dict[str, Any] = {"evaluated": "python" if tapes is None else "compiled", "iterations": rounds}
    info |= {"nis": found["nis"], "message": message, "reason": reason}
    if method.smooth:
        info |= {"x0": found["x0"], "P0": found["P0"]}
    return Estimate(
        record.t,
        found["x"],
        Normal.of(found["x"], found["P"]),
        status,
        typed(method),
        loglik=float(found["loglik"].sum()),
        names=model.names.x,
        labels=record.labels,
        info={k: v for k, v in info.items() if v is not None},
    )


def _iterated(
    model: Nonlinear, rows: _Rows, tapes: tuple[Tape, Tape] | None, spread: Spread, iterations: int, smooth: bool
) -> tuple[dict[str, Any], int]:
    """Run a pass, and for the iterated smoother more passes about its own trajectory."""
    prior = model.x0
    assert isinstance(prior, Normal)
    found = _pass(model, rows, tapes, prior.mean, prior.P, spread, iterations, None, smooth)
    if not smooth or iterations == 1:
        return found, iterations
    angles = np.isin(np.arange(model.nx), model.x_angles)
    for k in range(2, iterations + 1):
        about = np.vstack([found["x0"], found["x"]])
        sd = np.sqrt(np.diagonal(found["P"], axis1=1, axis2=2)) + np.abs(found["x"]) * 1e-12
        loglik, nis = found["loglik"], found["nis"]
        found = _pass(model, rows, tapes, prior.mean, prior.P, spread, 1, about, smooth)
        # The likelihood of the outputs is that of the first pass: later ones have seen the future.
        found["loglik"], found["nis"] = loglik, nis
        change = np.abs(found["x"] - about[1:])
        change[:, angles] = np.minimum(change[:, angles], 2.0 * np.pi - change[:, angles])
        if np.all(change <= 1e-9 * sd):
            return found, k
    return found, iterations


def _pass(
    model: Nonlinear,
    rows: _Rows,
    tapes: tuple[Tape, Tape] | None,
    x0: Array,
    P0: Array,
    spread: Spread,
    iterations: int,
    about: Array | None,
    smooth: bool,
) -> dict[str, Any]:
    wrap_x = np.isin(np.arange(model.nx), model.x_angles)
    wrap_y = np.isin(np.arange(model.ny), model.y_angles)
    if tapes is None:
        g = _function(model, "g", rows, wrap_x)
        h = _function(model, "h", rows, wrap_y)
        return scan(
            g, h, _at(rows.Q), _at(rows.R), x0, P0, rows.y, rows.seen, spread,
            iterations=iterations, about=about, smooth=smooth,
        )  # fmt: skip
    from halfwidth._core import nonlinear_run

    programs = [(tape.code, tape.constant, tape.out) for tape in tapes]
    y = np.where(rows.seen, rows.y, 0.0)
    return nonlinear_run(  # type: ignore[no-any-return]
        *programs, rows.columns(), np.empty((len(y), 0)), *rows.Q, *rows.R, x0, P0, y, rows.seen, wrap_x, wrap_y,
        *spread, iterations, about, smooth,
    )  # fmt: skip


def _at(stack: tuple[Array, Any]) -> Callable[[int], Array]:
    matrices, index = stack
    if index is not None:
        return lambda k: np.asarray(matrices[index[k]])
    return lambda k: np.asarray(matrices[k if len(matrices) > 1 else 0])


def _function(model: Nonlinear, name: str, rows: _Rows, wrap: Any) -> Function:
    """Return g or h, and its Jacobian, as calls of the user's functions in row k."""
    f, user = getattr(model, name), getattr(model, f"{name}_x")
    size = model.nx if name == "g" else model.ny
    most = 3 if name == "g" else 1

    def more(k: int) -> tuple[Any, ...]:
        return rows.arguments(k) if name == "g" else ()

    def value(x: Array, k: int) -> Array:
        return _valued(f, name, (size,), (x.copy(), *more(k)), rows.t[k])

    def jacobian(x: Array, k: int, P: Array) -> Array:
        if user is not None:
            wanted = arity(user, most)
            return _valued(user, f"{name}_x", (size, model.nx), (x.copy(), *more(k))[:wanted], rows.t[k])
        angles = model.x_angles if name == "g" else model.y_angles
        sd = np.sqrt(np.maximum(np.diag(P), 0.0))
        # No longer than the spread of the belief, no shorter than rounding in x allows.
        scale = np.maximum(sd, 1e-3 * np.abs(x))
        return differences(lambda at: value(at, k), x, scale, angles)

    return Function(value, jacobian, wrap)


def _valued(f: Callable[..., Any], name: str, shape: tuple[int, ...], arguments: tuple[Any, ...], t: float) -> Array:
    """Call a user's function; its shape and type are judged, NaN is left to the filter."""
    try:
        with np.errstate(all="ignore"):
            found = np.asarray(f(*arguments))
    except Exception as error:
        called = ", ".join(np.array2string(np.asarray(a), precision=6) for a in arguments)
        message = f"`{name}` failed at t = {t:.6g} s with {type(error).__name__}: {error}"
        raise BadValue(message, hint=f"call {name}({called})") from error
    if found.dtype.kind not in "biuf":
        message = f"`{name}` returned {found.dtype} at t = {t:.6g} s, real numbers were expected"
        raise BadValue(message, hint=f"take the real part in `{name}`, or return np.array([...]) of floats")
    found = found.astype(np.float64)
    if found.shape != shape and found.size == int(np.prod(shape)) and found.ndim < len(shape):
        found = found.reshape(shape)
    if found.shape != shape:
        raise BadShape(f"`{name}` returned shape {found.shape} at t = {t:.6g} s, {shape} was expected")
    return found


def _tapes(model: Nonlinear, rows: _Rows, *, exact: bool, wanted: bool) -> tuple[tuple[Tape, Tape] | None, str | None]:
    """Record g and h and compare them with what the user wrote, or say why not."""
    if not wanted:
        return None, "`compiled=False`"
    g_points, h_points = _points(model, rows)
    sizes = (model.nx, model.nu, None)[: 1 + len(rows.more)]
    try:
        name = "g"
        g = compiled(model.g, sizes, g_points)
        name = "h"
        h = compiled(model.h, (model.nx,), h_points)
    except Untraceable as error:
        return None, f"`{name}` cannot be compiled: {error}"
    if len(g.out) != model.nx or len(h.out) != model.ny:
        return None, "`g` or `h` changes its size"
    if exact:
        for name, tape, points in (("g", g, g_points), ("h", h, h_points)):
            user = getattr(model, f"{name}_x")
            if user is not None and not _same_slope(user, name, tape, points):
                return None, f"`{name}_x` differs from the exact Jacobian of `{name}`, so the one given is used"
    return (g, h), None


def _points(model: Nonlinear, rows: _Rows) -> tuple[list[tuple[Any, ...]], list[tuple[Any, ...]]]:
    """Return points around the prior, with arguments of rows of the record, where tapes are compared."""
    prior = model.x0
    assert isinstance(prior, Normal)
    rng = np.random.default_rng(0)
    sd = np.sqrt(np.diag(prior.P))
    picks = rng.integers(0, len(rows.t), _CHECKS)
    scales = np.resize([0.0, 0.3, 1.0, 3.0], _CHECKS)
    states = [prior.mean + s * sd * rng.standard_normal(model.nx) for s in scales]
    return [(x, *rows.arguments(k)) for x, k in zip(states, picks, strict=True)], [(x,) for x in states]


def _same_slope(user: Callable[..., Any], name: str, tape: Tape, points: list[tuple[Any, ...]]) -> bool:
    shape = (len(tape.out), tape.sizes[0])
    for arguments in points:
        wanted = arity(user, 3 if name == "g" else 1)
        try:
            given = _valued(user, f"{name}_x", shape, (np.array(arguments[0]), *arguments[1:])[:wanted], 0.0)
        except HalfwidthError:  # met on the way, it is named there
            return False
        exact = tape.jacobian(*arguments)[1][0]
        if np.isfinite(exact).all() and not np.allclose(given, exact, rtol=1e-6, atol=1e-9 * np.abs(exact).max()):
            return False
    return True


def _holds(model: Nonlinear, rows: _Rows, tapes: tuple[Tape, Tape], x: Array) -> bool:
    """Compare the tapes with the functions once more, at rows of the answer."""
    picks = np.unique(np.linspace(0, len(x) - 1, _CHECKS).astype(int))
    g_points = [(x[k - 1], *rows.arguments(int(k))) for k in picks if k > 0]
    for f, tape, points in ((model.g, tapes[0], g_points), (model.h, tapes[1], [(x[k],) for k in picks])):
        finite = [p for p in points if np.isfinite(tape(*p)).all()]
        if finite and not tape.agrees(f, finite):
            return False
    return True


def _judged(found: dict[str, Any], t: Array) -> tuple[Status, str | None]:
    """Turn the kernel's counts into a status and its message."""
    said = {
        "bad_g": (Status.COLLAPSED, "`g` was not finite, so the state was held, in"),
        "bad_h": (Status.REDUCED, "`h` was not finite, so the output was left out, in"),
        "contradicted": (Status.REDUCED, "an output without noise contradicts its certain prediction in"),
        "repaired": (Status.REDUCED, "a covariance that a negative weight or rounding made indefinite was repaired in"),
    }
    status, parts = Status.OK, []
    for key, (meaning, words) in said.items():
        n, first = found[key]
        if n:
            parts.append(f"{words} {n} of {len(t)} rows, first at t = {t[first]:.6g} s")
            status = Status.COLLAPSED if Status.COLLAPSED in (status, meaning) else Status.REDUCED
    return status, "; ".join(parts) or None


def _init(method: Method, model: Model) -> Belief:
    reason = method.refuses(model)
    if reason is not None:
        message, hint = hinted(reason)
        raise Refused(message, hint=hint)
    prior = model.x0
    assert isinstance(prior, Normal)
    if isinstance(model, Linear):
        return Belief(prior.mean, prior.P, 0.0, None, None)
    u = np.zeros((1, model.nu)) if model.nu else None
    rows = _rows(model, np.zeros(1), np.full(1, model.dt), np.full((1, model.ny), np.nan), u)
    tapes, _ = _tapes(model, rows, exact=isinstance(method, ExtendedKalman), wanted=method.compiled)
    return Belief(prior.mean, prior.P, 0.0, *(tapes or (None, None)))


def _step(
    model: Model, state: Belief, y: Array, u: Array | None, t: float, dt: float, spread: Spread, iterations: int
) -> Belief:
    outputs = np.asarray(y, dtype=np.float64).reshape(1, model.ny)
    inputs = None if u is None else np.asarray(u, dtype=np.float64).reshape(1, model.nu)
    if isinstance(model, Linear):
        found = _linear_row(model, state, outputs, inputs, t, dt)
    else:
        rows = _rows(model, np.array([t]), np.array([dt]), outputs, inputs)
        tapes = None if state.g is None or state.h is None else (state.g, state.h)
        found = _pass(model, rows, tapes, state.x, state.P, spread, iterations, None, smooth=False)
    return Belief(found["x"][0], found["P"][0], state.loglik + float(found["loglik"][0]), state.g, state.h)


def _linear_row(model: Linear, state: Belief, y: Array, u: Array | None, t: float, dt: float) -> dict[str, Any]:
    """One row of a linear model, E and F folded into the other matrices."""
    at = {name: matrix.at(t, dt) for name, matrix in model.matrices.items()}
    E = np.linalg.inv(at["E"]) if "E" in at else np.eye(model.nx)
    F = np.linalg.inv(at["F"]) if "F" in at else np.eye(model.ny)
    A, C = E @ at["A"], F @ at["C"]
    shift = np.zeros(model.nx) if u is None else E @ at["B"] @ u[0]
    Q, R = E @ model.w.cov().at(t, dt) @ E.T, F @ model.e.cov().at(t, dt) @ F.T
    g = Function(lambda x, _: A @ x + shift, lambda *_: A, np.zeros(model.nx, bool))
    h = Function(lambda x, _: C @ x, lambda *_: C, np.zeros(model.ny, bool))
    exact = Spread(0.0, 0.0, 0.0)
    return scan(g, h, lambda _: Q, lambda _: R, state.x, state.P, y, ~np.isnan(y), exact)
