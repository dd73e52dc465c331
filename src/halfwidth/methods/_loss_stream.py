"""Filters of unknown losses, row by row."""

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.errors import BadRecord, HalfwidthError, Refused, hinted
from halfwidth.loss import Bernoulli
from halfwidth.methods._loss_modes import Modes
from halfwidth.methods._loss_rows import Rows, linear_rows, outputs_and_modes, received, tangent
from halfwidth.methods._protocol import typed
from halfwidth.model import Linear, Model
from halfwidth.record import Record
from halfwidth.result import Newest

if TYPE_CHECKING:
    from halfwidth.methods.loss import LossMethod


class _Belief:
    """What one push found, in the form that `halfwidth.result.Newest` reads."""

    __slots__ = ("P", "_loss", "_modes", "_y", "code", "loglik", "rows", "t", "x")

    def __init__(self, stream: "LossStream", found: Any, y: Array) -> None:
        self.x, self.P, self._modes, _, code, _ = found
        self.code = _CODES[code]
        self.rows, self.t, self.loglik = stream.pushed, stream.t, stream.loglik
        self._loss, self._y = stream.model.loss, y

    @property
    def gamma(self) -> Array | None:
        """Probability that y was received."""
        gamma = received(self._loss, self._modes[None], ~np.isnan(self._y)[None])[0]
        return None if gamma is None else gamma[0]


#: Codes of a pushed row: 2 the row was left unused, 3 the numbers left the range of floating point.
_CODES = (0, 2, 2, 3)


class LossStream:
    """A loss-aware filter that holds its belief: push rows, read the newest estimate.

    Parameters
    ----------
    method : BKF1, BKF2, GPB, RBPF, FearnheadClifford, Runnalls or BeamSearch
    model : Linear or Nonlinear
    t : float
        Time of the prior, s.
    seed : int, optional
    """

    def __init__(self, method: "LossMethod", model: Model, *, t: float = 0.0, seed: int | None = None) -> None:
        reason = method.refuses(model)
        if reason is None and method._smoothing:
            reason = f"`{typed(method)}` smooths, a stream filters\nhint: {type(method).__name__}()"
        loss = model.loss
        if reason is None and loss is not None and len(loss.shape) > 1:
            reason = "the loss law is given row by row, a stream does not know which row comes next\nhint: give one law"
        fixed = [m for m in (*_matrices(model), model.w.cov(), model.e.cov()) if m.value is not None and not m.constant]
        if reason is None and fixed:
            reason = f"`{fixed[0].name}` is stacked row by row\nhint: give it as a function of dt"
        if reason is not None:
            message, hint = hinted(reason)
            raise Refused(message, hint=hint)
        self.method, self.model = method, model
        self._seed = 0 if seed is None else int(seed)
        self.pushed, self.loglik, self.t = 0, 0.0, float(t)
        self._kind = type("NewestLoss", (Newest,), {"__slots__": (), "method": typed(method), "names": model.names.x})
        self._u = isinstance(model, Linear) and model.B is not None
        self._fixed = isinstance(model, Linear) and all(
            m.constant for m in (*_matrices(model), model.w.cov(), model.e.cov())
        )
        self._stale = loss is not None and "stale" in loss.kind
        self._quick = self._fixed and not self._stale
        self._none = np.full(model.ny, np.nan)
        self._shape = (model.ny,)
        self._last = np.full(model.ny, np.nan)
        self._x = np.array(model.x0.mean)
        self._P = np.array(model.x0.P)  # type: ignore[union-attr]
        self._B: Array | None = None
        self._modes: Modes | None = None
        self._core: Any = None

    def _begin(self, modes: Modes) -> Any:
        """Return the kernel's object, at the prior."""
        model, loss = self.model, self.model.loss
        return _core.LossStream(
            n=model.nx, m=model.ny, modes=modes.C.shape[1], groups=1 if loss is None else len(loss.groups(model.ny)),
            learn=0 if loss is None or loss.known else 1 if isinstance(loss, Bernoulli) else 2, seed=self._seed,
            x0=self._x, P0=self._P, pi0=modes.pi0, count=modes.prior, **self.method._settings,
        )  # fmt: skip

    def push(self, y: Any, u: Any = None, dt: float | None = None) -> Newest:
        """Fold one row in and return the newest estimate.

        Parameters
        ----------
        y : (ny,) array_like
            NaN is a known loss.
        u : (nu,) array_like, optional
        dt : float, optional
            Step since the row before, s; ``model.dt`` if absent.
        """
        row = self._none if y is None else np.array(y, dtype=np.float64, ndmin=1)
        if row.shape != self._shape:
            raise BadRecord(f"`y` is {y!r}, {self.model.ny} numbers were expected; None or NaN is missing")
        step = self.model.dt
        if dt is not None:
            step = float(dt)
            if not 0.0 < step < np.inf:
                raise BadRecord(f"`dt` is {dt!r}, a positive number of seconds was expected")
        try:
            if self._quick and self._modes is not None:
                b = self._input(u) if self._u else None
                found = self._core.push(row, b, self._offset, self.pushed > 0 or self.method.prior == "filtered")
                self._moved(found, step)
            else:
                given = None if u is None else np.array(u, dtype=np.float64, ndmin=1)
                if (0 if given is None else given.size) != self.model.nu:
                    raise BadRecord(f"`u` is {u!r}, {self.model.nu} finite numbers were expected")
                found = self._push_rows(self._prepare(given, step, row), row, step)
        except ValueError as exc:
            if isinstance(exc, HalfwidthError):
                raise
            raise BadRecord(f"`y` is {y!r} and `u` is {u!r}: {exc}") from None
        newest: Newest = object.__new__(self._kind)
        object.__setattr__(newest, "_belief", _Belief(self, found, row))
        return newest

    def linear_row(self, y: Array, u: Array | None, dt: float) -> tuple[Array, ...]:
        """Push a row and return the linear model (A, b, Q, C, R, d) that it was filtered with."""
        rows = self._prepare(u, dt, y)
        self._push_rows(rows, y, dt)
        return rows.A[0], rows.b[0], rows.Q[0], rows.C[0], rows.R[0], rows.d[0]  # type: ignore[index]

    def snapshot(self) -> bytes:
        """Return everything a later process needs to go on."""
        head = np.concatenate([[self.pushed, self.t, self.loglik], self._last, self._x, self._P.ravel()])
        return bytes(head.tobytes() + self._core.state())

    def restore(self, saved: bytes) -> None:
        """Go on from a state of the same model and method.

        Raises
        ------
        ValueError
            If it belongs to another.
        """
        n, ny = self.model.nx, self.model.ny
        size = 8 * (3 + ny + n + n * n)
        if len(saved) <= size:
            raise ValueError(f"it has {len(saved)} bytes, more than {size} were expected")
        head = np.frombuffer(saved[:size])
        if self._modes is None:
            self._set(self._prepare(None, self.model.dt), np.zeros(ny))
        self._core.restore(saved[size:])
        self.pushed, self.t, self.loglik = int(head[0]), float(head[1]), float(head[2])
        self._last, self._x = head[3 : 3 + ny].copy(), head[3 + ny : 3 + ny + n].copy()
        self._P = head[3 + ny + n :].reshape(n, n).copy()

    def _moved(self, found: Any, dt: float) -> None:
        self.pushed += 1
        self.t += dt
        self.loglik += found[3]
        self._x, self._P = found[0], found[1]

    def _push_rows(self, rows: Rows, y: Array, dt: float) -> Any:
        modes = self._set(rows, y)
        found = self._core.push(y, None if rows.b is None else rows.b[0], None if modes.d is None else modes.d[0],
                                self.pushed > 0 or self.method.prior == "filtered")  # fmt: skip
        self._last = np.where(np.isnan(y), self._last, y)
        self._moved(found, dt)
        return found

    def _set(self, rows: Rows, y: Array) -> Modes:
        modes = self._modes_of(rows, y)
        if self._core is None:
            self._core = self._begin(modes)
        self._core.motion(rows.A[0], rows.Q[0])
        self._core.output(modes.C[0], modes.R[0])
        self._core.chain(modes.Pi[-1])
        self._modes, self._offset = modes, None if modes.d is None else np.ascontiguousarray(modes.d[0])
        return modes

    def _modes_of(self, rows: Rows, y: Array) -> Modes:
        """Return the modes of one row, the values reported before it standing above it."""
        above = [self._last] if self._stale and not np.isnan(self._last).all() else []
        outputs = np.stack([*above, y])
        found = outputs_and_modes(rows, self.model.loss, Record(np.arange(len(outputs), dtype=np.float64), outputs))[1]
        return found._replace(d=None if found.d is None else found.d[-1:])

    def _input(self, u: Any) -> Array:
        given = np.array([] if u is None else u, dtype=np.float64, ndmin=1)
        if given.shape != (self.model.nu,) or not np.isfinite(given).all():
            raise BadRecord(f"`u` is {u!r}, {self.model.nu} finite numbers were expected", hint="push(y, u)")
        return np.ascontiguousarray(self._B @ given)  # type: ignore[operator]

    def _prepare(self, u: Array | None, dt: float, y: Array | None = None) -> Rows:
        """Return the linear model of one row; a `Nonlinear` one is linearised about the mixture's mean."""
        model = self.model
        if isinstance(model, Linear):
            inputs = np.zeros((1, model.nu)) if u is None else u[None]
            at = np.array([self.t + dt])
            record = Record(at, np.zeros((1, model.ny)), inputs if model.B is not None else None)
            rows = linear_rows(dataclasses.replace(model, dt=dt), record)
            if self._u and self._B is None:
                unit = Record(np.arange(model.nu) + at, np.zeros((model.nu, model.ny)), np.eye(model.nu))
                if self._fixed:
                    self._B = np.ascontiguousarray(linear_rows(model, unit).b.T)  # type: ignore[union-attr]
            return rows
        u = np.zeros(model.nu) if u is None else u
        moves = self.pushed > 0 or self.method.prior == "filtered"
        return tangent(model, self._x if moves else None, self._x, np.sqrt(np.diagonal(self._P)), u, dt, self.t + dt, y)


def _matrices(model: Model) -> list[Any]:
    return list(model.matrices.values()) if isinstance(model, Linear) else []
