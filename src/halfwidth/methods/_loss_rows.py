"""Models and records as the kernels of `loss.py` take them: rows, modes, and tangents of nonlinear models."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.call import arity
from halfwidth.derivative import differences
from halfwidth.loss import Loss
from halfwidth.methods._loss_modes import Modes, modes_of
from halfwidth.model import Linear, Nonlinear
from halfwidth.record import Record


class Rows(NamedTuple):
    """A linear model laid out for the rows of one record."""

    A: Array  # (1 or T, nx, nx)
    b: Array | None  # (T, nx)
    Q: Array  # (1 or T, nx, nx)
    C: Array  # (1 or T, ny, nx)
    R: Array  # (1 or T, ny, ny)
    d: Array | None  # (T, ny) what the output adds to C x


def linear_rows(model: Linear, record: Record) -> Rows:
    """Lay out a linear model for the rows of a record, with E and F multiplied out."""
    dt = record.steps(model.dt)
    of = {name: _stacked(matrix.stack(record.t, dt)) for name, matrix in model.matrices.items()}
    A: Any = of["A"]
    C: Any = of["C"]
    b: Any = None
    Q, R = (_stacked(noise.cov().stack(record.t, dt)) for noise in (model.w, model.e))
    if record.u is not None:
        b = np.einsum("tij,tj->ti", np.broadcast_to(of["B"], (len(record), *of["B"].shape[1:])), record.u)
    if "E" in of:
        A, Q = np.linalg.solve(of["E"], A), _unmixed(of["E"], Q)
        b = None if b is None else np.linalg.solve(of["E"], b[..., None])[..., 0]
    if "F" in of:
        C, R = np.linalg.solve(of["F"], C), _unmixed(of["F"], R)
    inputs = None if b is None else np.ascontiguousarray(b)
    return Rows(
        np.ascontiguousarray(A), inputs, np.ascontiguousarray(Q), np.ascontiguousarray(C), np.ascontiguousarray(R), None
    )


def _stacked(found: tuple[Array, NDArray[np.int32] | None]) -> Array:
    stack, index = found
    return stack if index is None else stack[index]


def _unmixed(E: Array, Q: Array) -> Array:
    """Return E^-1 Q E^-T."""
    half = np.linalg.solve(E, Q)
    out = np.linalg.solve(E, np.swapaxes(half, -1, -2))
    return np.asarray(0.5 * (out + np.swapaxes(out, -1, -2)))


def outputs_and_modes(rows: Rows, loss: Loss | None, record: Record) -> tuple[Array, Modes]:
    """Return outputs without NaN and the modes of every row."""
    y = np.where(record.seen, record.y, 0.0)
    if loss is None:
        one = np.ones((1, 1, 1))
        d = None if rows.d is None else rows.d[:, None]
        carries = np.ones((1, record.ny), dtype=bool)
        return y, Modes(rows.C[:, None], d, rows.R[:, None], one, one[0, 0], None, carries)
    modes = modes_of(loss, rows.C, rows.R, record.y, record.seen)
    if rows.d is not None:
        base = 0.0 if modes.d is None else modes.d
        modes = modes._replace(d=np.ascontiguousarray(np.where(modes.carries, rows.d[:, None] + base, base)))
    return y, modes


def received(loss: Loss | None, modes: Array, seen: NDArray[np.bool_]) -> tuple[Array | None, Mapping[str, Array]]:
    """Return gamma and the probability of each kind of loss from those of the modes, (T, M)."""
    ny = seen.shape[1]
    if loss is None:
        return np.asarray(seen.any(axis=1), dtype=np.float64), {}
    groups = loss.groups(ny)
    patterns = loss.patterns(len(groups))

    def of(state: int) -> Array:
        p = np.clip(modes @ (patterns == state), 0.0, 1.0)
        if len(groups) == 1:
            return np.where(seen.any(axis=1), p[:, 0], 0.0)
        out = np.empty(seen.shape)
        for g, members in enumerate(groups):
            out[:, list(members)] = p[:, [g]]
        return np.where(seen, out, 0.0)

    return of(len(loss.kind)), {kind: of(k) for k, kind in enumerate(loss.kind)}


def tangent(
    model: Nonlinear,
    before: Array | None,
    at: Array | None,
    scale: Array,
    u: Array | None,
    dt: float,
    t: float,
    y: Array | None,
) -> Rows:
    """Return the model linearised about the state `before` the step and the state `at` the output.

    Without `before` the row has no step; the output is linearised about the predicted state unless the smoother knows
    better and passes `at` together with `before` of the row above.
    """
    n = model.nx
    if before is None:
        assert at is not None
        A, b, x = np.eye(n), np.zeros(n), at
    else:
        moved = model.move(before, u, dt)
        if model.g_x is None:
            A = differences(lambda v: model.move(v, u, dt), before, _lengths(scale, before), model.x_angles)
        else:
            A = np.asarray(model.g_x(*(before, u, dt)[: arity(model.g_x, 3)]), dtype=np.float64)
        b = moved - A @ before
        x = moved if at is before or at is None else at
    out = model.output(x)
    if model.h_x is None:
        C = differences(model.output, x, _lengths(scale, x), model.y_angles)
    else:
        C = np.asarray(model.h_x(x), dtype=np.float64)
    d = out - C @ x
    if y is not None and model.y_angles:  # an angle is compared on the branch nearest to the prediction
        i = list(model.y_angles)
        away = np.nan_to_num(y[i] - out[i])
        d[i] += away - (np.remainder(away + np.pi, 2 * np.pi) - np.pi)
    Q, R = (noise.cov().at(t, dt) for noise in (model.w, model.e))
    return Rows(*(np.ascontiguousarray(a)[None] for a in (A, b, Q, C, R, d)))


def _lengths(scale: Array, x: Array) -> Array:
    """Return steps for differences: standard deviations, but never so short that rounding rules."""
    return np.maximum(scale, 1e-3 * np.maximum(np.abs(x), 1e-3))


def about(model: Nonlinear, record: Record, rows: Rows, x: Array) -> Rows:
    """Linearise every row about smoothed states, (T, nx)."""
    dt = record.steps(model.dt)
    scale = np.maximum(np.abs(x).max(axis=0), 1.0) * 1e-2
    first = np.all(rows.A[0] == np.eye(model.nx)) and np.all(rows.b[0] == 0)  # type: ignore[index]
    found = []
    for k in range(len(record)):
        before = None if k == 0 and first else np.array(model.x0.mean) if k == 0 else x[k - 1]
        u = None if record.u is None else record.u[k]
        found.append(tangent(model, before, x[k], scale, u, float(dt[k]), float(record.t[k]), record.y[k]))
    return Rows(*(np.concatenate(part) for part in zip(*found, strict=True)))
