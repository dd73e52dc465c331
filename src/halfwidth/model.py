"""Models: how a state moves and what is seen of it.

``E x[t] = A x[t-1] + B u[t] + w[t]``,  ``F y[t] = C x[t] + e[t]``  for the rows t of a record; the prior `x0` is of the
state one step before the first row. E and F are unit upper triangular and make the noise of different entries
correlated (Pavelková and Kárný 2013, eqs. 1 and 2); absent means identity.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from halfwidth.array import Array, Function, real
from halfwidth.call import arity, called, takes_step_second
from halfwidth.derivative import differences
from halfwidth.errors import BadShape, BadValue, Refused
from halfwidth.noise import Gaussian, Mixed, Noise, Uniform
from halfwidth.spread import Box, Halfspaces, Normal
from halfwidth.tape import Untraceable
from halfwidth.trace import compiled
from halfwidth.varying import Varying, varying

Prior = Box | Normal


class Names(NamedTuple):
    """Names of the entries of x, y and u."""

    x: tuple[str, ...]
    y: tuple[str, ...]
    u: tuple[str, ...]


class Entry(NamedTuple):
    """One unknown entry of a model matrix."""

    matrix: str
    row: int
    column: int


class Linearised(NamedTuple):
    """Values and Jacobians of a nonlinear model at one point."""

    g: Array
    g_x: Array
    h: Array
    h_x: Array


@dataclass(frozen=True, eq=False)
class Linear:
    """Linear model ``E x[t] = A x[t-1] + B u[t] + w[t]``, ``F y[t] = C x[t] + e[t]``.

    Every matrix is constant (rows, columns), stacked (T, rows, columns), or a function of `t` or `dt` (by the name of
    its argument). NaN entries are unknown parameters theta.

    Parameters
    ----------
    A : (nx, nx)
    B : (nx, nu) or None
    C : (ny, nx)
    w, e : Uniform, Gaussian or their sum
        Noise of the state (nx) and of the output (ny), in their units.
    x0 : Box or Normal, or None
        Prior of the state one step before the first row; None is a box without ends.
    E : (nx, nx) unit upper triangular, optional
    F : (ny, ny) unit upper triangular, optional
    bounds : Box, (lo, hi) or Halfspaces, optional
        Hard bounds on every x[t].
    loss : optional
        A loss process that the estimator is not told of.
    names : sequence of str or mapping, optional
        Names of the states, or a mapping with the keys x, y, u.
    dt : float
        Step before the first row, s.
    theta_bounds : Box or (lo, hi), optional
        Bounds of the unknown entries in the order of `theta_entries`.

    Raises
    ------
    BadShape, BadValue
        If shapes do not fit each other or a number is out of its domain.

    Examples
    --------
    >>> walk = Linear([[1]], None, [[1]], Gaussian(0.1), Gaussian(1.0), Normal([0.0], 1.0))
    >>> walk.nx, walk.ny, walk.nu
    (1, 1, 0)
    """

    A: Varying
    B: Varying | None
    C: Varying
    w: Noise
    e: Noise
    x0: Prior
    _: dataclasses.KW_ONLY
    E: Varying | None = None
    F: Varying | None = None
    bounds: Box | Halfspaces | None = None
    loss: Any = None
    names: Names = None  # type: ignore[assignment]
    dt: float = 1.0
    theta_bounds: Box | None = None

    def __init__(
        self,
        A: ArrayLike | Function | Varying,
        B: ArrayLike | Function | Varying | None,
        C: ArrayLike | Function | Varying,
        w: Noise,
        e: Noise,
        x0: Prior | None,
        *,
        E: ArrayLike | Function | Varying | None = None,
        F: ArrayLike | Function | Varying | None = None,
        bounds: Box | Halfspaces | tuple[ArrayLike, ArrayLike] | None = None,
        loss: Any = None,
        names: Sequence[str] | Mapping[str, Sequence[str]] | Names | None = None,
        dt: float = 1.0,
        theta_bounds: Box | tuple[ArrayLike, ArrayLike] | None = None,
    ) -> None:
        a = _matrix(A, "A", (None, None), "")
        nx = a.shape[1]
        if a.shape[0] != nx:
            raise BadShape(f"`A` has shape {a.shape}, a square matrix (nx, nx) was expected")
        c = _matrix(C, "C", (None, nx), f"`A` {a.shape}")
        ny = c.shape[0]
        b = None if B is None else _matrix(B, "B", (nx, None), f"`A` {a.shape}")
        ee = None if E is None else _matrix(E, "E", (nx, nx), f"`A` {a.shape}", _triangular)
        ff = None if F is None else _matrix(F, "F", (ny, ny), f"`C` {c.shape}", _triangular)
        put = object.__setattr__
        put(self, "A", a)
        put(self, "B", b)
        put(self, "C", c)
        put(self, "E", ee)
        put(self, "F", ff)
        put(self, "loss", loss)
        put(self, "names", _names(names, nx, ny, 0 if b is None else b.shape[1]))
        _common(self, nx, ny, w, e, x0, bounds, dt)
        n_theta = len(self.theta_entries)
        put(self, "theta_bounds", _box(theta_bounds, n_theta, "theta_bounds"))

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return self.C.shape[0]

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return 0 if self.B is None else self.B.shape[1]

    @property
    def matrices(self) -> dict[str, Varying]:
        """The matrices that are given, by symbol, in the order A, B, C, E, F."""
        found = {"A": self.A, "B": self.B, "C": self.C, "E": self.E, "F": self.F}
        return {name: matrix for name, matrix in found.items() if matrix is not None}

    @cached_property
    def theta_entries(self) -> tuple[Entry, ...]:
        """Unknown entries of the constant matrices, in the order A, B, C, E, F, row by row."""
        return tuple(
            Entry(name, int(i), int(j))
            for name, matrix in self.matrices.items()
            if matrix.value is not None
            for i, j in np.argwhere(np.isnan(matrix.value).reshape(-1, *matrix.shape).any(axis=0))
        )

    def as_gaussian(self) -> "Linear":
        """Return the model with Gaussian noise of the same covariances, ``q**2 / 3``.

        A finite box prior becomes a Gaussian of its mean and covariance. Bounds on the state have no Gaussian
        counterpart and are dropped.

        Raises
        ------
        Refused
            If half-widths are unknown or the prior box is infinite.
        """
        return dataclasses.replace(self, **_matched(self))

    def __repr__(self) -> str:
        return _repr(self)


@dataclass(frozen=True, eq=False)
class Nonlinear:
    """Nonlinear model ``x[t] = g(x[t-1], u[t]) + w[t]``, ``y[t] = h(x[t]) + e[t]``.

    Parameters
    ----------
    g : function (x, u) -> (nx,), or (x, u, dt), or (x)
        Motion over one step of `dt` seconds. Written with functions of NumPy (not of `math`) it runs compiled.
    h : function (x) -> (ny,)
        Output.
    w, e : Uniform, Gaussian or their sum
    x0 : Box or Normal
        Prior of the state one step before the first row.
    nu : int
        Number of inputs.
    g_x, h_x : functions, optional
        Jacobians (nx, nx) and (ny, nx) with the arguments of `g` and `h`; found automatically if absent.
    bounds, loss, names, dt
        As in `Linear`.
    x_angles, y_angles : sequences of int
        Entries of x and y that are angles in radians: differences of them are wrapped to (-pi, pi].

    Raises
    ------
    BadShape, BadValue
        If `g` or `h` fails, or returns another shape or NaN at the prior's mean.

    Examples
    --------
    >>> clock = Nonlinear(lambda x: x, np.sin, Gaussian(1e-3), Gaussian(0.1), Normal([0.0], 1.0))
    >>> clock.nx, clock.ny
    (1, 1)
    """

    g: Callable[..., Any]
    h: Callable[..., Any]
    w: Noise
    e: Noise
    x0: Prior
    _: dataclasses.KW_ONLY
    nu: int = 0
    g_x: Callable[..., Any] | None = None
    h_x: Callable[..., Any] | None = None
    bounds: Box | Halfspaces | None = None
    loss: Any = None
    names: Names = None  # type: ignore[assignment]
    dt: float = 1.0
    x_angles: tuple[int, ...] = ()
    y_angles: tuple[int, ...] = ()
    nx: int = dataclasses.field(init=False)
    ny: int = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        put = object.__setattr__
        if not isinstance(self.x0, Box | Normal):
            raise BadValue(f"`x0` is {self.x0!r}, Box(lo, hi) or Normal(mean, P) was expected")
        mean = np.atleast_1d(self.x0.mean)
        nx = len(mean)
        put(self, "nx", nx)
        if takes_step_second(self.g):
            raise BadValue(
                "the second argument of `g` is called `dt`, but it is the input", hint="g = lambda x, u, dt: ..."
            )
        moved = self.move(mean, np.zeros(self.nu) if self.nu else None, float(self.dt))
        if moved.shape != (nx,):
            raise BadShape(f"`g` returned shape {moved.shape}, ({nx},) was expected from `x0`")
        seen = called(self.h, "h", (mean.copy(),))
        if seen.ndim != 1:
            raise BadShape(f"`h` returned shape {seen.shape}, a vector (ny,) was expected")
        put(self, "ny", len(seen))
        put(self, "names", _names(self.names, nx, len(seen), self.nu))
        for name, angles, n in (
            ("x_angles", self.x_angles, nx),
            ("y_angles", self.y_angles, self.ny),
        ):
            if any(not 0 <= int(i) < n for i in angles):
                raise BadValue(f"`{name}` is {angles!r}, indices from 0 to {n - 1} were expected")
            put(self, name, tuple(int(i) for i in angles))
        _common(self, nx, len(seen), self.w, self.e, self.x0, self.bounds, self.dt)

    def move(self, x: Array, u: Array | None, dt: float) -> Array:
        """Return ``g(x, u, dt)``, (nx,), calling `g` with as many arguments as it takes.

        Raises
        ------
        BadValue
            If `g` fails or returns something that is not finite and real.
        """
        return called(self.g, "g", (x.copy(), u, dt)[: arity(self.g, 3)])

    def output(self, x: Array) -> Array:
        """Return ``h(x)``, (ny,)."""
        return called(self.h, "h", (x.copy(),))

    def linearise(
        self, x: ArrayLike, u: ArrayLike | None = None, dt: float | None = None, *, by: str | None = None
    ) -> "Linearised":
        """Return values and Jacobians of `g` and `h` at one point.

        Parameters
        ----------
        x : (nx,) array_like
        u : (nu,) array_like, optional
            Zero if absent.
        dt : float, optional
            Step, s; the model's if absent.
        by : {"user", "tape", "differences"}, optional
            Where Jacobians come from; the user's where given, else exact from a tape, else finite differences.

        Returns
        -------
        Linearised
            Named tuple of g (nx,), g_x (nx, nx), h (ny,), h_x (ny, nx).

        Raises
        ------
        BadShape, BadValue
            If a function fails, or `by` cannot be had.

        Examples
        --------
        >>> from halfwidth import Gaussian, Normal
        >>> swing = Nonlinear(np.sin, lambda x: x**2, Gaussian(0.1), Gaussian(0.1), Normal([0.0], 1.0))
        >>> swing.linearise([2.0]).h_x
        array([[4.]])
        """
        if by not in (None, "user", "tape", "differences"):
            raise BadValue(f"`by` is {by!r}, one of 'user', 'tape', 'differences' was expected")
        point = real(x, "x")
        if point.shape != (self.nx,):
            raise BadShape(f"`x` has shape {point.shape}, ({self.nx},) was expected from the model")
        given = (np.zeros(self.nu) if u is None else real(u, "u")) if self.nu else None
        if given is not None and given.shape != (self.nu,):
            raise BadShape(f"`u` has shape {given.shape}, ({self.nu},) was expected from the model")
        step = self.dt if dt is None else float(dt)
        rows = [*self.slope("g", point, given, step, by), *self.slope("h", point, given, step, by)]
        return Linearised(*rows)

    def slope(self, name: str, x: Array, u: Array | None, dt: float, by: str | None = None) -> tuple[Array, Array]:
        """Return value and Jacobian of `g` or `h` alone, of arguments that are known to be right; see `linearise`.

        Parameters
        ----------
        name : {"g", "h"}
        x : (nx,) array
        u : (nu,) array or None
        dt : float
            Step, s.
        by : {"user", "tape", "differences"}, optional
            As for `linearise`.
        """
        f = getattr(self, name)
        more = (u, dt)[: arity(f, 3 if name == "g" else 1) - 1]
        size, angles = (self.nx, self.x_angles) if name == "g" else (self.ny, self.y_angles)
        return self._linearised(name, f, x, more, size, angles, by)

    def _linearised(
        self,
        name: str,
        f: Callable[..., Any],
        x: Array,
        more: tuple[Any, ...],
        size: int,
        angles: tuple[int, ...],
        by: str | None,
    ) -> tuple[Array, Array]:
        user = getattr(self, f"{name}_x")
        value = called(f, name, (x.copy(), *more))
        if by == "user" and user is None:
            raise BadValue(f"`by` is 'user' but the model has no `{name}_x`", hint="Nonlinear(..., g_x=..., h_x=...)")
        if user is not None and by in (None, "user"):
            wanted = arity(user, 3 if name == "g" else 1)
            slope = np.atleast_2d(called(user, f"{name}_x", (x.copy(), *more)[:wanted]))
            if slope.shape != (size, self.nx):
                raise BadShape(f"`{name}_x` returned shape {slope.shape}, ({size}, {self.nx}) was expected")
            return value, slope
        if by != "differences":
            sizes = (self.nx, self.nu, None)[: 1 + len(more)]
            try:
                tape = compiled(f, sizes, [(x, *more)])
            except Untraceable as reason:
                if by == "tape":
                    raise BadValue(f"`{name}` cannot be compiled: {reason}", hint="by='differences'") from reason
            else:
                return value, tape.jacobian(x, *more)[1][0]
        return value, differences(lambda at: called(f, name, (at, *more)), x, angles=angles)

    def as_gaussian(self) -> "Nonlinear":
        """Return the model with Gaussian noise of the same covariances; see `Linear.as_gaussian`."""
        return dataclasses.replace(self, **_matched(self))

    def __repr__(self) -> str:
        return _repr(self)


Model = Linear | Nonlinear


def needs_a_box(model: Model, name: str) -> str | None:
    """Return why a method that takes bounds entry by entry cannot take the model's, with a hint, or None."""
    if isinstance(model.bounds, Halfspaces):
        return (
            f"`{name}` keeps each state between two numbers but `bounds` is `Halfspaces`"
            "\nhint: bounds=Box(lo, hi), or a Gaussian model and Constrained()"
        )
    return None


def _common(
    model: Model,
    nx: int,
    ny: int,
    w: Noise,
    e: Noise,
    x0: Prior | None,
    bounds: Box | Halfspaces | tuple[ArrayLike, ArrayLike] | None,
    dt: float,
) -> None:
    put = object.__setattr__
    for name, noise, n in (("w", w, nx), ("e", e, ny)):
        if not isinstance(noise, Uniform | Gaussian | Mixed):
            raise BadValue(
                f"`{name}` is {noise!r}, a noise was expected",
                hint=f"{name}=Uniform(q) or {name}=Gaussian(Q)",
            )
        put(model, name, noise.sized(n, name))
    if x0 is None:
        x0 = Box(np.full(nx, -np.inf), np.full(nx, np.inf))
    if isinstance(x0, Box):
        x0 = x0.sized(nx, "x0")
    elif not isinstance(x0, Normal):
        raise BadValue(f"`x0` is {x0!r}, Box(lo, hi) or Normal(mean, P) was expected")
    elif x0.mean.shape != (nx,):
        raise BadShape(f"`x0` has a mean of shape {x0.mean.shape}, ({nx},) was expected from the model")
    put(model, "x0", x0)
    put(model, "bounds", bounds.sized(nx, "bounds") if isinstance(bounds, Halfspaces) else _box(bounds, nx, "bounds"))
    if not isinstance(dt, int | float | np.number) or not np.isfinite(dt) or dt <= 0:
        raise BadValue(f"`dt` is {dt!r}, a positive number of seconds was expected")
    put(model, "dt", float(dt))


def _matrix(
    value: ArrayLike | Function | Varying,
    name: str,
    shape: tuple[int | None, int | None],
    expected: str,
    check: Callable[[Array, str], Array] | None = None,
) -> Varying:
    if isinstance(value, Varying):
        return value
    return varying(value, name, shape, expected=expected, unknown=True, check=check)


def _triangular(matrix: Array, name: str) -> Array:
    if np.any(np.tril(matrix, -1) != 0) or np.any(np.diagonal(matrix, axis1=-2, axis2=-1) != 1):
        raise BadValue(f"`{name}` is not unit upper triangular: ones on the diagonal, zeros below")
    return matrix


def _box(value: Box | tuple[ArrayLike, ArrayLike] | None, n: int, name: str) -> Box | None:
    if value is None or isinstance(value, Box):
        return None if value is None else value.sized(n, name)
    if not isinstance(value, Sequence) or len(value) != 2:
        raise BadValue(f"`{name}` is {value!r}, Box(lo, hi) or a pair (lo, hi) was expected")
    return Box(*value).sized(n, name)


def _names(given: Sequence[str] | Mapping[str, Sequence[str]] | Names | None, nx: int, ny: int, nu: int) -> Names:
    sizes = {"x": nx, "y": ny, "u": nu}
    if isinstance(given, Names):
        given = given._asdict()
    if isinstance(given, Mapping):
        if set(given) - set(sizes):
            raise BadValue(f"`names` has the keys {sorted(given)}, some of x, y, u were expected")
        parts = dict(given)
    else:
        parts = {} if given is None else {"x": given}
    for key, n in sizes.items():
        found = tuple(str(v) for v in parts.get(key, ())) or tuple(f"{key}{i}" for i in range(n))
        if len(found) != n:
            raise BadShape(f"`names` has {len(found)} names for {key}, {n} were expected")
        if len(set(found)) != n:
            raise BadValue(f"`names` repeats a name of {key}: {found}")
        parts[key] = found
    return Names(**{key: tuple(parts[key]) for key in sizes})


def _matched(model: Model) -> dict[str, Any]:
    """Return what a model with Gaussian noise of the same covariances has instead."""
    return {"w": _gaussian(model.w, "w"), "e": _gaussian(model.e, "e"), "x0": _normal(model.x0), "bounds": None}


def _gaussian(noise: Noise, name: str) -> Gaussian:
    part = noise.gaussian if isinstance(noise, Mixed) else noise
    if isinstance(part, Gaussian) and not part.known:
        raise Refused(f"`{name}` has unknown variances, so it has no covariance", hint=f"give {name}=Gaussian(Q)")
    if isinstance(noise, Gaussian):
        return noise
    if not noise.known:
        raise Refused(
            f"`{name}` is uniform with unknown half-widths, so it has no covariance",
            hint=f"give {name}=Uniform(q), or estimate the half-widths with a method for unknown ones",
        )
    return Gaussian(noise.cov())


def _normal(x0: Prior) -> Normal:
    if isinstance(x0, Normal):
        return x0
    half = 0.5 * (x0.hi - x0.lo)
    if not np.isfinite(half).all():
        raise Refused(
            "`x0` is a box without ends, so it has no covariance",
            hint="x0=Normal(mean, P) or a finite Box",
        )
    return Normal(x0.mean, half**2 / 3.0)


def _repr(model: Model) -> str:
    head = f"{type(model).__name__}(nx={model.nx}, ny={model.ny}, nu={model.nu}, w={model.w!r}, e={model.e!r}"
    extra = [name for name in ("bounds", "loss") if getattr(model, name) is not None]
    return head + "".join(f", {name}=..." for name in extra) + ")"
