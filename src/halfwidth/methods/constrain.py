"""Constrained: any Gaussian method, held inside the bounds of its model.

The belief N(x, P) of a row is cut at ``lo <= D x <= hi`` by core/constrain.hpp. Truncation takes one constraint f after
the other: with ``s^2 = f' P f`` and mean mu and variance v of a standard normal cut to the bounds of ``f' x``,

    x <- x + P f mu / s,    P <- P - (1 - v) P f f' P / s^2

which is Simon and Simon's form without its decompositions. Expectation propagation repeats it with each constraint's
own share taken out first, until all agree; then the order does not matter. Projection takes the nearest feasible point
and leaves P as it is, but for equalities.

By default the recursion itself stays unconstrained: a bound that always holds says the same at each row, and a filter
that is told the same again and again believes it too much.

References
----------
Simon and Simon (2010), Int. J. Systems Science 41(2), 159-171. Simon (2010), IET Control Theory Appl. 4(8): projection.
Cunningham, Hennig and Lacoste-Julien (2011), Gaussian probabilities and expectation propagation.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.errors import BadValue, Refused
from halfwidth.methods._protocol import Estimator, typed
from halfwidth.methods.kalman import KalmanFilter
from halfwidth.model import Model
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Box, Normal

By = Literal["ep", "truncate", "project", "nearest"]
_BY = ("ep", "truncate", "project", "nearest")  # in the order of the core's numbers
#: In place of a row of D: the cuts did not settle to the last digit; the method inside has something to say.
_UNSETTLED, _OF_THE_METHOD = -2, -3
#: Codes of the core, from good to bad; 1 (not settled) is told as 2.
_STATUS = {0: Status.OK, 2: Status.REDUCED, 3: Status.COLLAPSED, 4: Status.INFEASIBLE}


@dataclass(frozen=True)
class Constrained:
    """A Gaussian method whose estimates obey ``model.bounds``: a `Box`, or half-spaces and equalities (`Halfspaces`).

    Parameters
    ----------
    method : estimator
        Filter or smoother, such as ``KalmanFilter()``, ``KalmanSmoother()``, ``UnscentedKalman()`` or ``GPB()``.
    by : {"ep", "truncate", "project", "nearest"}
        ``"ep"`` and ``"truncate"`` give mean and covariance of the belief cut at the bounds: by expectation propagation
        over all constraints, or by one cut each, most broken first, which is faster and coarser where constraints
        meet. ``"project"`` takes the most probable feasible state, ``"nearest"`` the one nearest in the units of x;
        an estimate that breaks bounds then lies on them, and its covariance knows of equalities only.
    feedback : bool
        Whether the next row starts from the constrained belief. Covariances then become too small unless the
        constraint is news at each row.

    Notes
    -----
    ``info["distance"]`` (T,) says by how many standard deviations the unconstrained estimate breaks its worst bound, 0
    where it breaks none. A row more than 30 away is ``Status.REDUCED``; one whose bounds no state fulfils is
    ``INFEASIBLE`` and keeps its unconstrained estimate. The message names the bound. Intervals end at those of a box.

    Raises
    ------
    BadValue
        If a setting is out of its domain.

    Examples
    --------
    >>> import halfwidth as hw
    >>> tank = hw.Linear([[1]], None, [[1]], hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0.0], 1.0), bounds=(0, 5))
    >>> est = hw.estimate(tank, hw.Record([0.0, 1.0], [-1.0, None]), hw.Constrained(hw.KalmanFilter()))
    >>> est.x.round(3).ravel()
    array([0.46 , 0.822])
    """

    method: Any = dataclasses.field(default_factory=KalmanFilter)
    by: By = "ep"
    feedback: bool = False

    def __post_init__(self) -> None:
        if (
            isinstance(self.method, type)
            or not isinstance(self.method, Estimator)
            or isinstance(self.method, Constrained)
        ):
            raise BadValue(f"`method` is {self.method!r}, a Gaussian estimator such as KalmanFilter() was expected")
        if self.by not in _BY:
            raise BadValue(f"`by` is {self.by!r}, one of {', '.join(map(repr, _BY))} was expected")

    def refuses(self, model: Model) -> str | None:
        """Return why the method inside cannot take the model, or what there is not to do, or None."""
        inner = type(self.method).__name__
        if model.bounds is None:
            return f"`Constrained` keeps `bounds` but the model has none\nhint: bounds=Box(lo, hi), or {inner}() alone"
        if self.method.refuses(model) is None:
            return f"`{inner}` keeps `bounds` itself, so `Constrained` has nothing to do\nhint: use {inner}() alone"
        reason = self.method.refuses(replace(model, bounds=None))
        if reason is not None:
            return f"inside `Constrained`, {reason}"
        if self.feedback and (not hasattr(self.method, "step") or getattr(self.method, "smooth", False)):
            return (
                f"`Constrained` cannot feed back into `{typed(self.method)}`, which does not go forward row by row"
                "\nhint: feedback=False, or a filter"
            )
        return None

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:
        """Estimate one record."""
        if self.feedback:
            return self._fed_back(model, record)
        return self._kept(model, self.method.run(replace(model, bounds=None), record, seed=seed))

    def run_many(self, model: Model, records: Sequence[Record], *, seed: int | None = None) -> list[Estimate]:
        """Estimate several records, side by side where the method inside can."""
        many = getattr(self.method, "run_many", None)
        if self.feedback or many is None:
            return [self.run(model, record, seed=seed) for record in records]
        return [self._kept(model, est) for est in many(replace(model, bounds=None), records, seed=seed)]

    def init(self, model: Model) -> "Held":
        """Return the belief one step before the first row.

        Raises
        ------
        Refused
            If the method inside does not go forward row by row, or its state cannot be changed.
        """
        if not hasattr(self.method, "step") or getattr(self.method, "smooth", False):
            raise Refused(
                f"`{typed(self.method)}` inside `Constrained` has no online form", hint="Constrained(KalmanFilter())"
            )
        inner = self.method.init(replace(model, bounds=None))
        if self.feedback and not {"x", "P"} <= set(getattr(inner, "_fields", ())):
            raise Refused(
                f"the state of `{typed(self.method)}` is no named tuple with x and P, so nothing can be fed back",
                hint="Constrained(..., feedback=False)",
            )
        x, P, _ = self.method.belief(model, inner)
        return Held(inner, 0, x, P, 0, -1, 0.0)

    def step(self, model: Model, state: "Held", y: Array, u: Array | None, t: float, dt: float) -> "Held":
        """Return the belief after one row: the method's own state, and its belief inside the bounds."""
        inner = self.method.step(model, state.inner, y, u, t, dt)
        x, P, _ = self.method.belief(model, inner)
        held = hold(model, self.by, x[None], P[None])
        code, at = int(held.code[0]), int(held.row[0])
        if code == 0 and getattr(inner, "code", 0) >= 2:
            code, at = inner.code, _OF_THE_METHOD
        if self.feedback:
            inner = inner._replace(x=held.x[0], P=held.P[0])
        return Held(inner, state.rows + 1, held.x[0], held.P[0], code, at, float(held.distance[0]))

    def belief(self, model: Model, state: "Held") -> tuple[Array, Array, float]:
        """Return mean and covariance inside the bounds, and the log-likelihood of the outputs."""
        return state.x, state.P, float(self.method.belief(model, state.inner)[2])

    def verdict(self, model: Model, state: "Held") -> tuple[int, str | None, tuple[Array, Array] | None]:
        """Return the code of the newest row, what there is to say of it, and the ends of intervals."""
        said = None if state.code == 0 else _said(model, state.code, state.at, state.distance)
        return state.code, said, _ends(model)

    def _fed_back(self, model: Model, record: Record) -> Estimate:
        """Run row by row, each from the constrained belief of the one before."""
        state, dt, states = self.init(model), record.steps(model.dt), []
        for k in range(len(record)):
            u = None if record.u is None else record.u[k]
            state = self.step(model, state, record.y[k], u, float(record.t[k]), float(dt[k]))
            states.append(state)
        held = _Held(
            np.array([s.x for s in states]).reshape(len(record), model.nx),
            np.array([s.P for s in states]).reshape(len(record), model.nx, model.nx),
            np.array([s.distance for s in states]),
            np.array([s.code for s in states], dtype=np.int32),
            np.array([s.at for s in states], dtype=np.int32),
        )
        plain = Estimate(
            record.t,
            held.x,
            None,
            Status.OK,
            typed(self),
            loglik=self.belief(model, state)[2],
            names=model.names.x,
            labels=record.labels,
        )
        return self._finished(model, plain, held)

    def _kept(self, model: Model, est: Estimate) -> Estimate:
        """Hold the estimates of the method inside."""
        if not isinstance(est.spread, Normal):
            raise Refused(
                f"`{typed(self.method)}` gives no covariance, so `Constrained` cannot cut its belief",
                hint="Constrained(KalmanFilter())",
            )
        return self._finished(model, est, hold(model, self.by, est.x, est.spread.P))

    def _finished(self, model: Model, est: Estimate, held: "_Held") -> Estimate:
        status, info = est.status, dict(est.info) | {"distance": held.distance}
        code = int(held.code.max(initial=0))
        if code and (status.good or code == 4):
            rows = np.flatnonzero(held.code == code)
            k = int(rows[0])
            said = _said(model, code, int(held.row[k]), float(held.distance[k]))
            more = f" (and {len(rows) - 1} more rows)" if len(rows) > 1 else ""
            status = _STATUS[code]
            info["message"] = f"row {k} (t = {est.t[k]:.6g} s){more}: {said}"
            info["hint"] = "look for an outlier there, or for bounds that contradict the model or each other"
        spread = Normal.of(held.x, held.P, _ends(model))
        return replace(est, x=held.x, spread=spread, status=status, method=typed(self), info=info)


class Held(NamedTuple):
    """What a row hands on: the method's state, its belief inside the bounds, and how the cut went."""

    inner: Any
    rows: int
    x: Array
    P: Array
    code: int
    at: int
    distance: float


class _Held(NamedTuple):
    """Beliefs inside bounds, one a row: see core/constrain_entry.hpp."""

    x: Array
    P: Array
    distance: Array
    code: NDArray[np.int32]
    row: NDArray[np.int32]


def hold(model: Model, by: By, x: Array, P: Array) -> _Held:
    """Return the beliefs N(x, P), (T, nx) and (T, nx, nx), held inside the bounds of the model."""
    assert model.bounds is not None
    D, lo, hi = (np.ascontiguousarray(a) for a in model.bounds.rows)
    found = _Held(*_core.constrain_run(_BY.index(by), np.ascontiguousarray(x), np.ascontiguousarray(P), D, lo, hi))
    loose = found.code == 1
    return found._replace(code=np.where(loose, 2, found.code), row=np.where(loose, _UNSETTLED, found.row))


def _said(model: Model, code: int, row: int, distance: float) -> str:
    if row == _UNSETTLED:
        return "bounds that nearly depend on each other were met with fewer digits than usual"
    if code == 3:
        return "the state left the range of floating point"
    if row == _OF_THE_METHOD:
        return "its outputs contradict what the model holds for certain"
    which = f"the bounds of `{model.names.x[row]}`" if isinstance(model.bounds, Box) else f"row {row} of `bounds`"
    if code == 4:
        return f"no state fulfils {which} beside the other bounds and what the model holds for certain"
    return f"the unconstrained estimate lies {distance:.3g} standard deviations outside {which}"


def _ends(model: Model) -> tuple[Array, Array] | None:
    return (model.bounds.lo, model.bounds.hi) if isinstance(model.bounds, Box) else None
