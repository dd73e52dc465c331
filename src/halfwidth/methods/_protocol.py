"""What an estimator is, and the only Python time loop.

An estimator is a frozen value of settings with ``refuses(model)`` and one pure ``run(model, record)``. A recursive one
gives ``init`` and ``step`` instead; `scan` is its offline form and `halfwidth.stream` its online form.
"""

import math
from dataclasses import fields
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from halfwidth.array import Array
from halfwidth.errors import BadRecord
from halfwidth.model import Model
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Normal

State = TypeVar("State")


@runtime_checkable
class Estimator(Protocol):
    """Settings of a method; `run` does the work."""

    def refuses(self, model: Model) -> str | None:
        """Return why the method cannot work on this model, with a hint, or None."""
        ...

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:
        """Estimate the states of one record."""
        ...


class Recursive(Protocol[State]):
    """A method that takes one row at a time; a step returns a new state and changes nothing.

    One that has more to say of a row also gives ``verdict(model, state)``: the code of `Newest.status`, a message or
    None, and the (lo, hi) that intervals end at, or None.

    One whose answer is not Gaussian gives ``answer(model, state, t) -> Estimate`` of the newest row instead of
    `belief`, and its own `run`.
    """

    def init(self, model: Model) -> State:
        """Return the belief one step before the first row."""
        ...

    def step(self, model: Model, state: State, y: Array, u: Array | None, t: float, dt: float) -> State:
        """Return the belief after one row; NaN in `y` is missing."""
        ...

    def belief(self, model: Model, state: State) -> tuple[Array, Array, float]:
        """Return mean (nx,), covariance (nx, nx) and log-likelihood so far."""
        ...


def scan(method: Any, model: Model, record: Record) -> Estimate:
    """Run a recursive method over a record, row by row."""
    state = method.init(model)
    dt = record.steps(model.dt)
    x = np.empty((len(record), model.nx))
    P = np.empty((len(record), model.nx, model.nx))
    loglik = 0.0
    for k in range(len(record)):
        u = None if record.u is None else record.u[k]
        state = method.step(model, state, record.y[k], u, float(record.t[k]), float(dt[k]))
        x[k], P[k], loglik = method.belief(model, state)
    return Estimate(
        record.t,
        x,
        Normal.of(x, P),
        Status.OK,
        typed(method),
        loglik=loglik,
        names=model.names.x,
        labels=record.labels,
    )


def pushed_row(
    model: Model, y: ArrayLike | None, u: ArrayLike | None, dt: float | None
) -> tuple[Array, Array | None, float]:
    """Judge one row of a stream: outputs (ny,), NaN where missing; inputs (nu,) or None; the step before it, s."""
    step = model.dt if dt is None else float(dt)
    if not step > 0 or not math.isfinite(step):
        raise BadRecord(f"`dt` is {dt!r}, a positive number of seconds was expected")
    row = np.full(model.ny, np.nan) if y is None else np.array(y, dtype=float, ndmin=1)
    if row.shape != (model.ny,) or any(map(math.isinf, row.tolist())):
        raise BadRecord(f"`y` is {y!r}, {model.ny} numbers were expected; None or NaN is missing")
    if u is None and model.nu == 0:
        return row, None, step
    inputs = np.zeros(0) if u is None else np.array(u, dtype=float, ndmin=1)
    if inputs.size != model.nu or not all(map(math.isfinite, inputs.ravel().tolist())):
        raise BadRecord(f"`u` is {u!r}, {model.nu} finite numbers were expected")
    return row, None if u is None else inputs, step


def typed(method: Any) -> str:
    """Return a method as it would be typed: its name and the settings that are not defaults."""
    given = [
        f"{f.name}={getattr(method, f.name)!r}" for f in fields(method) if not _same(getattr(method, f.name), f.default)
    ]
    return f"{type(method).__name__}({', '.join(given)})"


def _same(value: Any, default: Any) -> bool:
    return value is default or (type(value) is type(default) and bool(np.all(value == default)))
