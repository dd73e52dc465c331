"""A model of known half-widths as rows with two ends, rounded outward: what every method that must contain starts from.

    E x[t] - A x[t-1]  in  [bx_lo, bx_hi] = B u[t] -+ q          C x[t]  in  [by_lo, by_hi] = F y[t] -+ r

A matrix whose ends differ is an interval matrix: its unknown entries (NaN) lie within ``theta_bounds``. Outputs that
are not seen have infinite ends. An unseen output that seen ones are correlated with through F is eliminated: a seen row
then holds a multiple N of the rows of F y = C x + e, its half-width is |N| r, and N itself is an interval, since the
elimination rounds.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from halfwidth.array import Array
from halfwidth.methods._residuals import eliminate
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.noise import Uniform
from halfwidth.spread import Box
from halfwidth.varying import Varying

_EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of T times over nx states; a matrix is (rows, nx), or (T, rows, nx) where it moves.

    Parameters
    ----------
    A_lo, C_lo, E_lo : arrays, E None for identity
        Lower ends.
    A_hi, C_hi, E_hi : arrays or None
        Upper ends; None where the matrix is exact.
    bx_lo, bx_hi : (T, nx) arrays
    by_lo, by_hi : (T, ny) arrays
    """

    A_lo: Array
    C_lo: Array
    bx_lo: Array
    bx_hi: Array
    by_lo: Array
    by_hi: Array
    E_lo: Array | None = None
    E_hi: Array | None = None
    A_hi: Array | None = None
    C_hi: Array | None = None


def refuses(model: Model, name: str) -> str | None:
    """Return why a method for known half-widths cannot take a model, or None."""
    for symbol, noise in (("w", model.w), ("e", model.e)):
        if not isinstance(noise, Uniform):
            kind = type(noise).__name__
            return f"`{name}` needs uniform noise but `{symbol}` is `{kind}`\nhint: {symbol}=Uniform(half_widths)"
        if not noise.known:
            return (
                f"`{name}` needs known half-widths but those of `{symbol}` are not\n"
                "hint: `BatchLP()` estimates them; give what it finds, with a margin, as Uniform(...)"
            )
    if not isinstance(model.x0, Box):
        return f"`{name}` needs a box as prior but `x0` is `Normal`\nhint: x0=Box(lo, hi), or None for no bounds"
    if model.loss is not None:
        return f"`{name}` takes lost outputs as NaN in the record but the model has a hidden loss\nhint: loss=None"
    if isinstance(model, Nonlinear):
        return None
    if model.theta_entries:
        entry = model.theta_entries[0]
        bounds = model.theta_bounds
        if bounds is None or not (np.isfinite(bounds.lo).all() and np.isfinite(bounds.hi).all()):
            return (
                f"`{name}` needs every entry within bounds but `{entry.matrix}[{entry.row}, {entry.column}]` has none\n"
                "hint: theta_bounds=(lo, hi)"
            )
        wrong = [e for e in model.theta_entries if e.matrix == "F"]
        if wrong:
            return (
                f"`{name}` needs a known F but `F[{wrong[0].row}, {wrong[0].column}]` is unknown\nhint: give it a value"
            )
    return None


def linear_rows(model: Linear, t: Array, dt: Array, y: Array, u: Array | None, *, first: int = 0) -> Rows:
    """Return the rows of a linear model.

    Parameters
    ----------
    model : Linear
        One that `refuses` takes.
    t, dt : (T,) arrays
        Times and the steps before them, s.
    y, u : (T, ny) and (T, nu) arrays
        NaN in y is not seen.
    first : int
        Number of the first row, where the matrices are stacked.
    """
    T = len(t)
    ends = {name: _ends(model, name, matrix, t, dt, first) for name, matrix in model.matrices.items()}
    bx_lo, bx_hi = np.zeros((T, model.nx)), np.zeros((T, model.nx))
    if model.B is not None and u is not None:
        low, high = ends["B"]
        low = np.broadcast_to(low, (T, model.nx, model.nu))
        one, two = low * u[:, None, :], (low if high is None else high) * u[:, None, :]
        slack = (model.nu + 2) * _EPS * np.maximum(np.abs(one), np.abs(two)).sum(axis=2)
        bx_lo, bx_hi = np.minimum(one, two).sum(axis=2) - slack, np.maximum(one, two).sum(axis=2) + slack
    q, r = np.asarray(_half_widths(model.w)), np.asarray(_half_widths(model.e))
    bx_lo, bx_hi = grown(bx_lo, bx_hi, q)
    seen = ~np.isnan(y)
    A, A_hi = ends["A"]
    C, C_hi = ends["C"]
    E, E_hi = ends.get("E", (None, None))
    z, half = np.where(seen, y, 0.0), np.broadcast_to(r, y.shape)
    z_lo = z_hi = z
    if "F" in ends:
        C, C_hi, z_lo, z_hi, half = _correlated(ends["F"][0], C, C_hi, z, half, seen)
    by_lo, by_hi = grown(z_lo, z_hi, half)
    by = np.where(seen, by_lo, -np.inf), np.where(seen, by_hi, np.inf)
    return Rows(A, C, bx_lo, bx_hi, *by, E, E_hi, A_hi, C_hi)


def grown(lo: Array, hi: Array, half: Array) -> tuple[Array, Array]:
    """Return ``lo - half`` and ``hi + half``, rounded outward; exact where a half-width is 0."""
    with np.errstate(invalid="ignore"):
        return (
            np.where(half > 0, np.nextafter(lo - half, -np.inf), lo),
            np.where(half > 0, np.nextafter(hi + half, np.inf), hi),
        )


def _half_widths(noise: object) -> Array:
    assert isinstance(noise, Uniform)
    return noise.q


def _ends(model: Linear, name: str, matrix: Varying, t: Array, dt: Array, first: int) -> tuple[Array, Array | None]:
    """Return lower and upper ends of a matrix, the upper None where they are one."""
    if matrix.stacked and len(t) < len(matrix.value or ()):
        assert matrix.value is not None
        found = matrix.value[first : first + len(t)]
    else:
        stack, index = matrix.stack(t, dt)
        found = stack[0] if len(stack) == 1 else stack if index is None else stack[index]
    found = np.ascontiguousarray(found)
    entries = [(k, e) for k, e in enumerate(model.theta_entries) if e.matrix == name]
    if not entries:
        return found, None
    assert model.theta_bounds is not None
    lo, hi = found.copy(), found.copy()
    for k, e in entries:
        unknown = np.isnan(found[..., e.row, e.column])
        lo[..., e.row, e.column] = np.where(unknown, model.theta_bounds.lo[k], lo[..., e.row, e.column])
        hi[..., e.row, e.column] = np.where(unknown, model.theta_bounds.hi[k], hi[..., e.row, e.column])
    return lo, hi


def _correlated(
    F: Array, C: Array, C_hi: Array | None, z: Array, r: Array, seen: NDArray[np.bool_]
) -> tuple[Array, Array | None, Array, Array, Array]:
    """Fold F in: C and its upper ends, both ends of the left side, and the half-widths of the seen rows."""
    T, ny = z.shape
    F = np.array(np.broadcast_to(F, (T, ny, ny)))
    N = eliminate(F, seen)
    # The same elimination with every term of one sign bounds what rounding can be.
    most = np.abs(eliminate(2.0 * np.eye(ny) - np.abs(F), seen))
    off = 8 * ny * _EPS * np.where(np.any(N - np.eye(ny), axis=(1, 2))[:, None, None], most, 0.0)
    left = N @ F
    size = (most + off) @ np.abs(F) @ np.abs(z)[:, :, None]
    middle, slack = (left @ z[:, :, None])[:, :, 0], (16 * ny * _EPS) * size[:, :, 0]
    lo = np.broadcast_to(C, (T, *C.shape[-2:]))
    hi = lo if C_hi is None else np.broadcast_to(C_hi, lo.shape)
    moved = off.any() or bool(np.abs(N - np.eye(ny)).any())
    if moved:
        plus, minus = np.maximum(N, 0.0), np.minimum(N, 0.0)
        width = (off + 4 * ny * _EPS * most) @ np.maximum(np.abs(lo), np.abs(hi))
        exact = ~np.any(N - np.eye(ny), axis=(1, 2))[:, None, None]
        lo, hi = (
            np.where(exact, lo, plus @ lo + minus @ hi - width),
            np.where(exact, hi, plus @ hi + minus @ lo + width),
        )
    half = ((np.abs(N) + off) @ r[:, :, None])[:, :, 0] * (1.0 + 4 * ny * _EPS)
    C_new = np.ascontiguousarray(lo) if moved else C
    return C_new, (np.ascontiguousarray(hi) if moved else C_hi), middle - slack, middle + slack, half
