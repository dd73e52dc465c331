"""A linear model with bounded and Gaussian noise laid out row by row, outputs made independent of each other.

With E and F folded in, ``x[t] = A x[t-1] + b + w + G d`` with w ~ N(0, Q) and ``|d_j| <= 1``. The outputs that were
seen in a row, ``F^-1 (C x + e)``, are turned by a matrix M that makes the Gaussian part of their errors independent;
what is bounded in a turned output is the sum of what it holds of each entry, taken as a bound of its own. Where all
outputs are seen and the covariance of e is diagonal, M is F and nothing is lost by it.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.noise import Gaussian, Mixed, Noise, Uniform, unknown_variances
from halfwidth.record import Record
from halfwidth.spread import Box
from halfwidth.varying import Index, Varying

Stack = tuple[Array, Index | None]


class MixedRows(NamedTuple):
    """What the filter takes: stacks (K, ., .) and which of them each row uses."""

    A: Stack  # (nx, nx)
    b: Array | None  # (T, nx)
    Q: Stack  # (nx, nx)
    G: Stack  # (nx, ng)
    C: Stack  # (ny, nx)
    r: Stack  # (1, ny) variances
    half: Stack  # (1, ny) half-widths
    y: Array  # (T, ny)
    seen: NDArray[np.bool_]  # (T, ny)
    B: Stack | None  # (nx, nu), with which b is made
    M: Stack  # (ny, ny), with which y is made


def refuses(model: Model, name: str) -> str | None:
    """Return why a filter for mixed noise cannot take a model, with a hint, or None."""
    if isinstance(model, Nonlinear):
        return f"`{name}` needs a linear model but this one is `Nonlinear`\nhint: use `ParticleFilter()`"
    if (reason := unknown_variances(model.w, model.e, name)) is not None:
        return reason
    if not model.w.known or not model.e.known:
        return f"`{name}` needs known half-widths but `w` or `e` has unknown ones\nhint: use `BatchLP()`, or Uniform(q)"
    if isinstance(model.x0, Box) and not np.isfinite([model.x0.lo, model.x0.hi]).all():
        return f"`{name}` needs a prior with ends but `x0` is an infinite box\nhint: x0=Box(lo, hi) or Normal(mean, P)"
    if model.bounds is not None:
        return f"`{name}` cannot keep states inside `bounds`\nhint: `ParticleFilter()`, or leave `bounds` away"
    if model.loss is not None:
        return f"`{name}` takes every seen output as received but the model has `loss`\nhint: use `GPB(depth=5)`"
    if model.theta_entries:
        e = model.theta_entries[0]
        return (
            f"`{name}` needs every entry of the model but `{e.matrix}[{e.row}, {e.column}]` is unknown (NaN)\n"
            "hint: put numbers in place of NaN"
        )
    return None


def parts(noise: Noise, n: int) -> tuple[Array, Varying | None]:
    """Return the half-widths (n,) of a noise and the covariance of its Gaussian part, None where it has none."""
    if isinstance(noise, Uniform):
        return np.atleast_1d(noise.q), None
    if isinstance(noise, Mixed):
        return np.atleast_1d(noise.uniform.q), noise.gaussian.cov()
    assert isinstance(noise, Gaussian)
    return np.zeros(n), noise.cov()


def mixed_rows(model: Linear, record: Record) -> MixedRows:
    """Lay a model out for the rows of a record."""
    T, nx, ny = len(record), model.nx, model.ny
    t, dt = record.t, record.steps(model.dt)
    q, Q = parts(model.w, nx)
    r, R = parts(model.e, ny)
    zero = np.zeros(T, dtype=np.int64)

    def rows(matrix: Varying | None, otherwise: Array) -> tuple[Array, NDArray[np.int64]]:
        if matrix is None:
            return otherwise[None], zero
        stack, index = matrix.stack(t, dt)
        if index is not None:
            return stack, index.astype(np.int64)
        return stack, zero if len(stack) == 1 else np.arange(T)

    (A, iA), (E, iE), (Qs, iQ) = rows(model.A, q), rows(model.E, np.eye(nx)), rows(Q, np.zeros((nx, nx)))
    (C, iC), (F, iF), (Rs, iR) = rows(model.C, r), rows(model.F, np.eye(ny)), rows(R, np.zeros((ny, ny)))
    B, iB = rows(model.B, np.zeros((nx, 0)))
    kinds, of = _kinds(np.column_stack([iA, iE, iQ, iB]))
    motion = []
    for k in kinds:
        f = np.linalg.inv(E[k[1]])
        motion.append((f @ A[k[0]], _symmetric(f @ Qs[k[2]] @ f.T), f[:, q > 0] * q[q > 0], f @ B[k[3]]))
    which = None if len(kinds) == 1 else of.astype(np.int32)
    a, Qa, g, bb = (np.ascontiguousarray(np.array(part)) for part in zip(*motion, strict=True))
    b = None if record.u is None else np.einsum("tij,tj->ti", bb[of], record.u)

    seen = record.seen
    out, of_out = _kinds(np.column_stack([iC, iF, iR, seen]))
    turned = [_turned(C[k[0]], F[k[1]], Rs[k[2]], r, k[3:].astype(bool)) for k in out]
    c, v, h, M, used = (np.array(part) for part in zip(*turned, strict=True))
    y = np.einsum("tij,tj->ti", M[of_out], np.where(seen, record.y, 0.0))
    w = of_out.astype(np.int32)
    return MixedRows(
        (a, which), b, (Qa, which), (g, which), (c, w), (v[:, None], w), (h[:, None], w), y, used[of_out],
        None if model.B is None else (bb, which), (M, w),
    )  # fmt: skip


def _kinds(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the distinct rows of an array of small numbers, and which of them each row is."""
    code, room = np.zeros(len(keys), dtype=np.int64), 1
    for column in keys.T:
        base = int(column.max(initial=0)) + 1
        if base > 1:
            code, room = code * base + column, room * base
        if room > 2**62:  # too many combinations to number: the rows themselves are compared
            found, index = np.unique(keys, axis=0, return_inverse=True)
            return found, index.reshape(-1)
    _, first, index = np.unique(code, return_index=True, return_inverse=True)
    return keys[first], index.reshape(-1)


def _symmetric(Q: Array) -> Array:
    return np.asarray(0.5 * (Q + Q.T))


def _turned(C: Array, F: Array, R: Array, half: Array, seen: NDArray[np.bool_]) -> tuple[Any, ...]:
    """Return rows of C, variances, half-widths, M (ny, ny) and which rows are used, for the outputs that were seen."""
    ny = len(half)
    s = np.flatnonzero(seen)
    M = np.zeros((ny, ny))
    fold = np.linalg.inv(F)[s]
    S = _symmetric(fold @ R @ fold.T)
    box = fold * half
    m = _whitener(S if S.any() else _symmetric(box @ box.T))
    M[np.ix_(s, s)] = m
    c, v, h = np.zeros((ny, C.shape[1])), np.zeros(ny), np.zeros(ny)
    c[s] = m @ fold @ C
    v[s] = np.maximum(np.diagonal(m @ S @ m.T), 0.0)
    h[s] = np.abs(m @ box).sum(axis=1)
    return c, v, h, M, seen


def _whitener(S: Array) -> Array:
    """Return the unit upper triangular m that makes m S m' diagonal; a direction without variance is left alone."""
    n = len(S)
    m, left = np.eye(n), S.copy()
    for j in range(n - 1, 0, -1):
        if left[j, j] > 1e-14 * S[j, j]:
            u = left[:j, j] / left[j, j]
            left[:j, :j] -= np.outer(u, u) * left[j, j]
            left[:j, j] = left[j, :j] = 0.0
            m[:j] -= np.outer(u, m[j])
    return m
