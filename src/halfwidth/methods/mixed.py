"""Filters for noise that is partly bounded and partly Gaussian.

A bias, the error of a map or a quantiser is not noise: it need not average out. Each state is therefore known as a
Gaussian centre plus something bounded, ``x = m + N(0, P) + b`` with b in an ellipsoid or a zonotope, and each output is
folded in by the gain that serves both parts best. This is the estimator of Hanebeck, Horn and Schmidt [1]_, whose
scalar form is `halfwidth.fusion`, for vectors and with motion, with the gain of Noack and others [2]_ in place of the
sets' own, and the zonotopes of Combastel [3]_. Without bounded noise it is the Kalman filter, without Gaussian noise
the filter of bounding ellipsoids.

References
----------
.. [1] Hanebeck, Horn and Schmidt, On combining statistical and set theoretic estimation.
.. [2] Noack, Pfaff and Hanebeck (2012), Optimal Kalman gains for combined stochastic and set-membership state
estimation. .. [3] Combastel (2015), Zonotopes and Kalman observers: gain optimality under distinct uncertainty
paradigms.
"""

import json
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.errors import BadValue, Refused, hinted
from halfwidth.methods._mixed_rows import MixedRows, mixed_rows, parts, refuses
from halfwidth.methods._protocol import pushed_row, typed
from halfwidth.model import Linear, Model
from halfwidth.record import Record
from halfwidth.result import Estimate, Newest, Status
from halfwidth.spread import Both, Box, Spread

_FORMS = ("ellipsoid", "zonotope", "combined")
_CRITERIA = ("trace", "width")
#: Weight of the output's own direction beside the states', each measured by its predicted size: more narrows what is
#: seen and widens its rate. With 2 the ellipsoids of a cart stay within 1.10 of the optimum: `benchmarks/mixed.py`.
_OUTPUT = 2.0
#: Sets of seen outputs for which a stream keeps its row laid out.
_LAID = 256


class MixedBelief(NamedTuple):
    """What is known before a row: mean (nx,), covariance and ellipsoid (nx, nx), generators (count, nx)."""

    m: Array
    P: Array
    X: Array
    Z: Array


@dataclass(frozen=True)
class MixedFilter:
    """Centre, covariance and set of each state given the outputs up to its row.

    The answer's spread is `Both`. Its interval holds the state with the level's probability whatever the bounded noises
    do within their half-widths, as long as `truncate` and `shrink` are off; it is not guaranteed, since the Gaussian
    part has no end. ``info["X"]`` (T, nx, nx) are the ellipsoids, ``info["a"]`` (T, ny) the scalar of each correction.

    Parameters
    ----------
    form : {"combined", "ellipsoid", "zonotope"}
        How the set is carried. An ellipsoid finds good gains and grows by every sum; a zonotope adds exactly, but its
        gain takes the bounded noises for independent. "combined" uses the gains of the ellipsoid and reports for each
        state the narrower of both.
    kappa : float
        Standard deviations that count as much as a half-width when the two parts are weighed up.
    criterion : {"trace", "width"}
        What the scalar `a` between the sets of the state and of the output is chosen by: the sum of variances and
        squared half-widths, which is convex, or eq. (32) of [1]_, half-widths plus `kappa` standard deviations.
    a : float, optional
        A fixed scalar, 0 < a < 1; ``1/2 - lambda`` in [1]_.
    gain : {"both", "set"}
        The gain for both parts, or that of the sets alone as in [1]_.
    truncate : bool
        Use that the sets of prediction and output must meet, which cuts the Gaussian part (eqs. (29), (30)). The
        covariance then holds given that they do, a Bayesian statement.
    shrink : bool
        Shrink the ellipsoid where prediction and output lie apart (Fogel and Huang 1982); needs ``gain="set"``.
    generators : int
        Generators that a zonotope keeps.
    lag : int
        Row t uses the outputs up to row t + lag; needs ``form="zonotope"``, since an ellipsoid of a whole stretch of
        states would grow with every row.

    Raises
    ------
    BadValue
        If a setting is out of its domain.

    Examples
    --------
    >>> import halfwidth as hw
    >>> biased = hw.Uniform(0.5) + hw.Gaussian(1.0)
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Gaussian(0.0), biased, hw.Normal([0.0], 1e6))
    >>> est = hw.estimate(walk, hw.Record(range(100), np.ones(100)), MixedFilter())
    >>> est.spread.half[-1].round(3), est.spread.sd[-1].round(3)
    (array([0.5]), array([0.1]))
    """

    form: Literal["combined", "ellipsoid", "zonotope"] = "combined"
    kappa: float = 3.0
    criterion: Literal["trace", "width"] = "trace"
    a: float | None = None
    gain: Literal["both", "set"] = "both"
    truncate: bool = False
    shrink: bool = False
    generators: int = 60
    lag: int = 0

    def __post_init__(self) -> None:
        for name, known in (("form", _FORMS), ("criterion", _CRITERIA), ("gain", ("both", "set"))):
            if getattr(self, name) not in known:
                raise BadValue(f"`{name}` is {getattr(self, name)!r}, one of {', '.join(known)} was expected")
        if not 0.0 < self.kappa < np.inf:
            raise BadValue(f"`kappa` is {self.kappa!r}, a positive number was expected", hint="kappa=3.0")
        if self.a is not None and not 0.0 < self.a < 1.0:
            raise BadValue(f"`a` is {self.a!r}, a number between 0 and 1 was expected", hint="a=None chooses it")
        for name, least in (("generators", 1), ("lag", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
                raise BadValue(f"`{name}` is {value!r}, a whole number from {least} was expected")
        if self.shrink and (self.gain != "set" or self.form != "ellipsoid"):
            raise BadValue("`shrink` is the overlap of two ellipsoids", hint='gain="set", form="ellipsoid"')
        if self.form == "zonotope" and (self.a is not None or self.gain != "both"):
            raise BadValue("a zonotope has no scalar `a` and one gain", hint='form="combined"')
        if self.lag and self.form != "zonotope":
            raise BadValue(
                f'`lag` is {self.lag} but `form` is "{self.form}"', hint='form="zonotope", or MixedWindow(lag=...)'
            )

    def refuses(self, model: Model) -> str | None:
        """Return why the model cannot be taken, or None."""
        return refuses(model, type(self).__name__)

    def run(self, model: Linear, record: Record, *, seed: int | None = None) -> Estimate:  # noqa: ARG002
        """Filter one record, or smooth it by the lag."""
        T, n, lag = len(record), model.nx, int(self.lag)
        out = self.rows(lagged(mixed_rows(model, record), lag), lagged_belief(prior(model), lag))
        # row t stands in block lag of row t + lag, and near the end in the blocks of the last row
        row = np.minimum(np.arange(T) + lag, T - 1)
        cells = n * (row - np.arange(T))[:, None] + np.arange(n)
        x, half = (np.take_along_axis(out[key][row], cells, axis=1) for key in ("m", "half"))
        P = out["P"][row[:, None, None], cells[:, :, None], cells[:, None, :]]
        status, info = _ended(out, record)
        info["a"] = out["a"]
        if self.form != "zonotope":
            info["X"] = out["X"]
        return Estimate(
            record.t, x, Both(x, P, half), status, typed(self), names=model.names.x, labels=record.labels, info=info
        )  # fmt: skip

    def rows(self, rows: MixedRows, at: MixedBelief) -> dict[str, Any]:
        """Run the kernel over rows laid out by `mixed_rows`, from a belief one step before the first."""
        # a lag's own axes come on top, or boxing would have the whole past to spend
        nx = at.m.size // (int(self.lag) + 1)
        capacity = max(int(self.generators) + nx * int(self.lag), at.m.size)
        found: dict[str, Any] = _core.mixed_run(
            *rows[:9], *at, _FORMS.index(self.form) if self.form != "combined" else 2, _CRITERIA.index(self.criterion),
            self.gain == "set", self.truncate, self.shrink, capacity, float(self.kappa),
            np.nan if self.a is None else float(self.a), _OUTPUT,
        )  # fmt: skip
        return found

    def stream(self, model: Linear, t: float = 0.0) -> "MixedStream":
        """Return the online form; each push gives the estimate of `lag` rows ago."""
        return MixedStream(self, model, t)


def prior(model: Linear) -> MixedBelief:
    """Return the prior of x0 as a belief: a covariance, or the box as ellipsoid and zonotope."""
    n, x0 = model.nx, model.x0
    if isinstance(x0, Box):
        half = 0.5 * (x0.hi - x0.lo)
        # of all ellipsoids around a box the one of least volume
        return MixedBelief(np.array(x0.mean), np.zeros((n, n)), n * np.diag(half**2), np.diag(half)[half > 0])
    return MixedBelief(np.array(x0.mean), np.array(x0.P), np.zeros((n, n)), np.zeros((0, n)))


def lagged(rows: MixedRows, lag: int) -> MixedRows:
    """Return the rows of the state with its `lag` predecessors stacked under it."""
    if lag == 0:
        return rows
    n = rows.A[0].shape[-1]
    wide = n * (lag + 1)

    def padded(stack: Array, shape: tuple[int, int]) -> Array:
        out = np.zeros((len(stack), *shape))
        out[:, : stack.shape[1], : stack.shape[2]] = stack
        return out

    A = padded(rows.A[0], (wide, wide))
    A[:, n:, :-n] = np.eye(wide - n)
    b = None if rows.b is None else np.pad(rows.b, ((0, 0), (0, wide - n)))
    return rows._replace(
        A=(A, rows.A[1]), b=b, Q=(padded(rows.Q[0], (wide, wide)), rows.Q[1]),
        G=(padded(rows.G[0], (wide, rows.G[0].shape[-1])), rows.G[1]),
        C=(padded(rows.C[0], (rows.C[0].shape[1], wide)), rows.C[1]),
    )  # fmt: skip


def lagged_belief(at: MixedBelief, lag: int) -> MixedBelief:
    """Return a belief with `lag` predecessors of which nothing is asked: they are never read before they are known."""
    n, wide = at.m.size, at.m.size * (lag + 1)
    m, P, X, Z = np.zeros(wide), np.zeros((wide, wide)), np.zeros((wide, wide)), np.zeros((len(at.Z), wide))
    m[:n], P[:n, :n], X[:n, :n], Z[:, :n] = at.m, at.P, at.X, at.Z
    return MixedBelief(m, P, X, Z)


def _ended(out: dict[str, Any], record: Record) -> tuple[Status, dict[str, Any]]:
    """Translate what the kernel met."""
    broken, (contradicted, first) = out["broken"], out["contradicted"]
    if broken >= 0:
        return Status.COLLAPSED, {
            "message": f"the state left the range of floating point at row {broken} (t = {record.t[broken]:.6g} s); "
            "its last finite value is repeated",
            "hint": "look for an unstable `A` or wrong units",
        }
    if contradicted:
        return Status.REDUCED, {
            "message": f"row {first} (t = {record.t[first]:.6g} s) lies where the model holds nothing possible"
            f" ({contradicted} outputs do)",
            "hint": "widen the bounds or variances of `w` or `e`, or look for an outlier there",
        }
    return Status.OK, {}


# ---- row by row ------------------------------------------------------------------------------------------------------


class _NewestMixed(Newest):
    """The newest row of a mixed stream."""

    __slots__ = ()

    @property
    def spread(self) -> Spread:
        """Gaussian centre and half-widths of the set."""
        return Both(self.x, self._belief.P[None], self._belief.half[None])

    @property
    def loglik(self) -> None:
        """None: what is only bounded has no likelihood."""
        return None


@dataclass(frozen=True, slots=True)
class Pushed:
    """What one push found, in the form that `halfwidth.result.Newest` reads."""

    t: float
    x: Array
    P: Array
    half: Array
    code: int
    rows: int


def newest_kind(method: str, model: Linear) -> type[Newest]:
    """Return the class of a stream's newest rows, with its method and names."""
    return type("NewestMixed", (_NewestMixed,), {"__slots__": (), "method": method, "names": model.names.x})


class MixedStream:
    """A `MixedFilter` that holds its belief: push rows, read the newest estimate."""

    def __init__(self, method: MixedFilter, model: Linear, t: float) -> None:
        reason = method.refuses(model)
        if reason is None and any(m.stacked for m in _varying(model)):
            reason = (
                "a matrix is stacked row by row, a stream does not know which row comes next\nhint: a function of dt"
            )
        if reason is not None:
            message, hint = hinted(reason)
            raise Refused(message, hint=hint)
        self.method, self.model, self.t, self.pushed = method, model, float(t), 0
        self.code = 0
        self.times: list[float] = []
        self.belief = lagged_belief(prior(model), int(method.lag))
        self._laid: dict[bytes, MixedRows] = {}
        self._fixed = all(m.constant for m in _varying(model))
        self._kind = type(
            "NewestMixed", (_NewestMixed,), {"__slots__": (), "method": typed(method), "names": model.names.x}
        )

    def push(self, y: ArrayLike | None, u: ArrayLike | None = None, dt: float | None = None) -> Estimate:
        """Fold one row in and return the estimate of `lag` rows ago."""
        _, out = self.pushed_rows(y, u, dt)
        self.times = [*self.times[-int(self.method.lag) :], self.t] if self.method.lag else [self.t]
        s = slice(self.model.nx * (len(self.times) - 1), self.model.nx * len(self.times))
        belief = Pushed(self.times[0], out["m"][0, s], out["P"][0, s, s], out["half"][0, s], self.code, self.pushed)
        newest: Estimate = object.__new__(self._kind)
        object.__setattr__(newest, "_belief", belief)
        return newest

    def pushed_rows(
        self, y: ArrayLike | None, u: ArrayLike | None, dt: float | None
    ) -> tuple[MixedRows, dict[str, Any]]:
        """Fold one row in; return it laid out, and what the kernel made of it."""
        row, inputs, step = pushed_row(self.model, y, u, dt)
        laid = self._rows(row, inputs, step)
        out = self.method.rows(laid, self.belief)
        self.belief = MixedBelief(out["m"][0], out["P"][0], out["X"][0], out["Z"])
        if self.code < 3:
            self.code = 3 if out["broken"] >= 0 else 2 if out["contradicted"][0] else 0
        self.t += step
        self.pushed += 1
        return laid, out

    def _rows(self, y: Array, u: Array | None, dt: float) -> MixedRows:
        """Lay one row out; of a constant model once for each set of outputs that are seen."""
        seen = ~np.isnan(y)
        key = seen.tobytes()
        laid = self._laid.get(key) if self._fixed else None
        if laid is None:
            one = Record(np.array([self.t + dt]), y[None], None if u is None else u[None])
            laid = lagged(mixed_rows(replace(self.model, dt=dt), one), int(self.method.lag))
            if not self._fixed:
                return laid
            if len(self._laid) >= _LAID:
                self._laid.clear()
            self._laid[key] = laid
        b = None
        if laid.B is not None and u is not None:
            b = np.pad(laid.B[0][0] @ u, (0, self.belief.m.size - self.model.nx))[None]
        return laid._replace(y=(laid.M[0][0] @ np.where(seen, y, 0.0))[None], b=b)

    def snapshot(self) -> bytes:
        """Return the belief, as bytes."""
        held: dict[str, Any] = {name: part.tolist() for name, part in self.belief._asdict().items()}
        return json.dumps(held | {"t": self.t, "pushed": self.pushed, "times": self.times, "code": self.code}).encode()

    def restore(self, saved: bytes) -> None:
        """Take up the belief of a snapshot."""
        held = json.loads(saved)
        n = self.belief.m.size
        found = {name: np.array(held[name], dtype=float) for name in MixedBelief._fields}
        found["Z"] = found["Z"].reshape(-1, n)
        if found["m"].shape != (n,) or found["P"].shape != (n, n) or found["X"].shape != (n, n):
            raise ValueError(f"it holds a belief of {found['m'].size} states, {n} were expected")
        self.belief = MixedBelief(**found)
        self.t, self.pushed, self.code = float(held["t"]), int(held["pushed"]), int(held["code"])
        self.times = [float(t) for t in held["times"]]


def _varying(model: Linear) -> list[Any]:
    return [*model.matrices.values(), *(S for S in (parts(model.w, model.nx)[1], parts(model.e, model.ny)[1]) if S)]
