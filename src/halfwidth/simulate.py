"""Draw a trajectory and a record from a model."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from halfwidth.array import Array, generator, real
from halfwidth.errors import BadShape, BadValue
from halfwidth.model import Linear, Model
from halfwidth.record import Record


@dataclass(frozen=True, eq=False)
class Truth:
    """A simulated trajectory; usable as an array (T, nx).

    Parameters
    ----------
    t : (T,) array
        Times, s.
    x : (T, nx) array
        States.
    x0 : (nx,) array
        State one step before the first row.
    w, e : (T, nx) and (T, ny) arrays
        The noise that was drawn.
    received : (T, ny) bool array
        Whether each output carries the state; all true without a loss process.
    """

    t: Array
    x: Array
    x0: Array
    w: Array
    e: Array
    received: Any

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        return np.array(self.x, dtype=dtype, copy=copy)

    def __len__(self) -> int:
        return len(self.x)

    def __getitem__(self, key: Any) -> Any:
        return self.x[key]


def simulate(
    model: Model,
    u: ArrayLike | None = None,
    *,
    T: int | None = None,
    t: ArrayLike | None = None,
    seed: int | np.random.Generator | None = None,
) -> tuple[Truth, Record]:
    """Draw states and outputs from a model.

    Parameters
    ----------
    model : Linear or Nonlinear
        With known noise and a prior that can be drawn from.
    u : (T, nu) array_like, optional
        Inputs.
    T : int, optional
        Number of rows; taken from `u` or `t` if absent.
    t : (T,) array_like, optional
        Times of the rows, s; steps of ``model.dt`` from it if absent.
    seed : int or Generator

    Returns
    -------
    truth : Truth
    record : Record

    Raises
    ------
    BadShape, BadValue, Refused
        If sizes disagree or the model cannot be drawn from.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Uniform(0.1), hw.Uniform(1.0), hw.Box(0, 1))
    >>> truth, record = hw.simulate(walk, T=5, seed=1)
    >>> truth.x.shape, record.y.shape
    ((5, 1), (5, 1))
    """
    inputs = None if u is None else real(u, "u")
    if inputs is not None and inputs.ndim == 1:
        inputs = inputs[:, None]
    given = None if t is None else real(t, "t")
    for name, value in (("u", inputs), ("t", given)):
        if value is not None and value.ndim == 0:
            raise BadShape(f"`{name}` is {value:g}, a row for each time was expected", hint="simulate(model, T=100)")
    sized = inputs if inputs is not None else given
    if T is None and sized is None:
        raise BadValue("neither `u` nor `T` nor `t` is given", hint="simulate(model, T=100, seed=1)")
    rows = int(T) if T is not None else len(sized)  # type: ignore[arg-type]
    if rows < 1:
        raise BadValue(f"`T` is {rows}, at least one row was expected")
    when = np.asarray(model.dt * np.arange(1, rows + 1)) if given is None else given
    if inputs is not None and inputs.shape != (rows, model.nu):
        raise BadShape(f"`u` has shape {inputs.shape}, ({rows}, {model.nu}) was expected from the model")
    if inputs is None and model.nu:
        raise BadShape(f"`u` is absent but the model has {model.nu} inputs", hint="simulate(model, u, seed=1)")
    if len(when) != rows:
        raise BadShape(f"`t` has {len(when)} rows, {rows} were expected")
    if isinstance(model, Linear) and model.theta_entries:
        raise BadValue(f"the model has unknown entries {model.theta_entries}, numbers were expected to simulate")

    rng = generator(seed)
    dt = np.diff(when, prepend=when[0] - model.dt)
    x0 = np.atleast_1d(model.x0.sample(rng))
    w = model.w.sample(rng, when, dt)
    e = model.e.sample(rng, when, dt)
    x = np.empty((rows, model.nx))
    y = np.empty((rows, model.ny))
    if isinstance(model, Linear):
        _linear(model, inputs, when, dt, x0, w, e, x, y)
    else:
        state = x0
        for k in range(rows):
            state = model.move(state, None if inputs is None else inputs[k], float(dt[k])) + w[k]
            x[k] = state
            y[k] = model.output(state) + e[k]
    received = np.ones(y.shape, dtype=bool)
    if model.loss is not None:
        y, received = model.loss.apply(model, y, e, rng)
    return Truth(when, x, x0, w, e, received), Record(when, y, inputs)


def _linear(
    model: Linear,
    u: Array | None,
    t: Array,
    dt: Array,
    x0: Array,
    w: Array,
    e: Array,
    x: Array,
    y: Array,
) -> None:
    rows = {name: _row(matrix.stack(t, dt)) for name, matrix in model.matrices.items()}
    state = x0
    for k in range(len(t)):
        state = rows["A"](k) @ state + w[k]
        if u is not None:
            state = state + rows["B"](k) @ u[k]
        if "E" in rows:
            state = np.linalg.solve(rows["E"](k), state)
        x[k] = state
        y[k] = rows["C"](k) @ state + e[k]
        if "F" in rows:
            y[k] = np.linalg.solve(rows["F"](k), y[k])


def _row(stack: tuple[Array, Any]) -> Any:
    matrices, index = stack
    if index is not None:
        return lambda k: matrices[index[k]]
    return (lambda _: matrices[0]) if len(matrices) == 1 else (lambda k: matrices[k])
