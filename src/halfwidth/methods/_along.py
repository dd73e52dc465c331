"""A nonlinear model along a path of states: values, Jacobians, the linear model that they make, how well it fits."""

import numpy as np

from halfwidth.array import Array, wrapped
from halfwidth.call import arity
from halfwidth.model import Linear, Nonlinear
from halfwidth.record import Record
from halfwidth.tape import Untraceable
from halfwidth.trace import compiled


def linearised(model: Nonlinear, record: Record, X: Array) -> tuple[Linear, Record]:
    """Return the model along a path (T + 1, nx), x0 first, with what is left of `g` and `h` as inputs and outputs."""
    g, A = _along(model, "g", X[:-1], _inputs(model, record))
    off, C = _outputs(model, record, X)
    rest = g - np.einsum("tij,tj->ti", A, X[:-1])
    y = off + np.einsum("tij,tj->ti", C, X[1:])
    linear = Linear(
        A, np.eye(model.nx), C, model.w, model.e, model.x0, bounds=model.bounds, dt=model.dt,
        names={"x": model.names.x, "y": model.names.y},
    )  # fmt: skip
    return linear, Record(record.t, y, rest)


def _inputs(model: Nonlinear, record: Record) -> tuple[Array | None, Array]:
    return record.u if model.nu else None, record.steps(model.dt)


def _outputs(model: Nonlinear, record: Record, X: Array) -> tuple[Array, Array]:
    """Return outputs less those of a path (T, ny), angles wrapped, and the Jacobians of `h` along it."""
    h, C = outputs_along(model, X[1:])
    return wrapped(record.y - h, model.y_angles), C


def outputs_along(model: Nonlinear, x: Array) -> tuple[Array, Array]:
    """Return outputs (T, ny) of states x (T, nx), and the Jacobians of `h` (T, ny, nx)."""
    return _along(model, "h", x, ())


def _along(model: Nonlinear, name: str, X: Array, more: tuple[Array | None, ...]) -> tuple[Array, Array]:
    """Return values and Jacobians of `g` or `h` at every point of a path, compiled where the function allows it."""
    f = getattr(model, name)
    given = more[: arity(f, 3 if name == "g" else 1) - 1]
    if getattr(model, f"{name}_x") is None:
        sizes = (model.nx, model.nu, None)[: 1 + len(given)]
        try:
            tape = compiled(f, sizes, [(X[0], *(None if a is None else a[0] for a in given))])
            value, slope = tape.jacobian(X, *(np.zeros((len(X), 0)) if a is None else a for a in given))
            if np.isfinite(value).all() and np.isfinite(slope).all():
                return value, slope
        except Untraceable:
            pass
    both = [
        model.linearise(x, None if not more or more[0] is None else more[0][t], _step(more, t)) for t, x in enumerate(X)
    ]
    values, slopes = [getattr(b, name) for b in both], [getattr(b, f"{name}_x") for b in both]
    return np.array(values), np.array(slopes)


def _step(more: tuple[Array | None, ...], t: int) -> float | None:
    return None if not more or more[1] is None else float(more[1][t])


def misfit(model: Nonlinear, record: Record, X: Array, variance: Array) -> float:
    """Return the squared residuals of a path (T + 1, nx) over their variances (nx + ny,)."""
    off, _ = _outputs(model, record, X)
    moved, _ = _along(model, "g", X[:-1], _inputs(model, record))
    return squares(X[1:] - moved, off, variance)


def squares(w: Array, e: Array, variance: Array) -> float:
    """Return squared noises (T, nx) and (T, ny), NaN where missing, over their variances (nx + ny,)."""
    nx = w.shape[1]
    total = float(np.sum(w**2 / variance[:nx])) + float(np.nansum(e**2 / variance[nx:]))
    return total if np.isfinite(total) else np.inf
