"""A nonlinear model of known half-widths as linear rows that its true states obey.

Over a box that contains the state before a step, ``|g(x) - J x - k| <= half`` (`halfwidth.enclosure`), so that

    x[t] - J x[t-1]  in  k -+ (q + half),        J_h x[t]  in  y[t] - k_h -+ (r + half_h),

and every method for linear rows can be used; the boxes must come from a method that contains.
"""

from dataclasses import replace
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from halfwidth.array import Array
from halfwidth.call import arity
from halfwidth.enclosure import affine
from halfwidth.methods._bounds import Rows, down, up
from halfwidth.model import Nonlinear
from halfwidth.noise import Uniform
from halfwidth.record import Record
from halfwidth.spread import Box
from halfwidth.tape import Tape, Untraceable
from halfwidth.trace import compiled

_TURN = 2.0 * np.pi


class Tapes(NamedTuple):
    """g and h of a model, recorded."""

    g: Tape
    h: Tape


_KNOWN: WeakKeyDictionary[Nonlinear, Tapes | str] = WeakKeyDictionary()


def tapes(model: Nonlinear) -> Tapes | str:
    """Return g and h of a model as tapes, or why they cannot be recorded."""
    found = _KNOWN.get(model)
    if found is None:
        found = _KNOWN[model] = _recorded(model)
    return found


def not_recorded(model: Nonlinear, name: str) -> str | None:
    """Return why a method cannot enclose a model, with a hint, or None."""
    why = tapes(model)
    if not isinstance(why, str):
        return None
    return (
        f"`{name}` needs `g` and `h` written with functions of NumPy but {why}\n"
        "hint: np.sin rather than math.sin; `ParticleFilter()` takes any function, without a guarantee"
    )


def _recorded(model: Nonlinear) -> Tapes | str:
    assert isinstance(model.x0, Box)
    rng = np.random.default_rng(0)
    middle = model.x0.mean
    half = np.where(np.isfinite(model.x0.hi - model.x0.lo), 0.5 * (model.x0.hi - model.x0.lo), 1.0)
    arguments = (np.zeros(model.nu) if model.nu else None, float(model.dt))[: arity(model.g, 3) - 1]
    points = [middle + s * half * rng.uniform(-1.0, 1.0, model.nx) for s in (0.0, 0.3, 1.0, 1.0)]
    name = "g"
    try:
        g = compiled(model.g, (model.nx, model.nu, None)[: 1 + len(arguments)], [(x, *arguments) for x in points])
        name = "h"
        h = compiled(model.h, (model.nx,), [(x,) for x in points])
    except Untraceable as error:
        return f"`{name}` cannot be recorded: {error}"
    return Tapes(g, h)


def motion(model: Nonlinear, u: Array | None, dt: float, lo: Array, hi: Array) -> tuple[Rows, tuple[Array, Array]]:
    """Return the row of one motion from a box (nx,), without outputs, and bounds of the state after it."""
    known = tapes(model)
    assert not isinstance(known, str)
    assert isinstance(model.w, Uniform)
    g = affine(known.g, lo, hi, *(u, dt)[: arity(model.g, 3) - 1])
    half = up(g.half + model.w.q)
    free = np.full((1, model.ny), np.inf)
    rows = Rows(g.J, np.zeros((model.ny, model.nx)), down(g.k - half)[None], up(g.k + half)[None], -free, free)
    inside = down(g.lo - model.w.q), up(g.hi + model.w.q)
    if isinstance(model.bounds, Box):
        inside = np.maximum(inside[0], model.bounds.lo), np.minimum(inside[1], model.bounds.hi)
    return rows, inside


def outputs(model: Nonlinear, rows: Rows, y: Array, lo: Array, hi: Array) -> Rows:
    """Return the row of one motion with its outputs (ny,), seen from a box (nx,) of the state after it."""
    known = tapes(model)
    assert not isinstance(known, str)
    assert isinstance(model.e, Uniform)
    h = affine(known.h, lo, hi)
    half = up(h.half + model.e.q)
    low, high = _turned(model, y, h.lo, h.hi)
    by_lo, by_hi = down(down(low - h.k) - half), up(up(high - h.k) + half)
    blind = np.isnan(by_lo) | np.isnan(by_hi)
    return replace(
        rows, C_lo=h.J, by_lo=np.where(blind, -np.inf, by_lo)[None], by_hi=np.where(blind, np.inf, by_hi)[None]
    )


def affine_rows(model: Nonlinear, record: Record, lo: Array, hi: Array) -> Rows:
    """Return the rows of a whole record over boxes (T + 1, nx) that contain its states, the prior first.

    A row whose distance is infinite says nothing; its entries are finite.
    """
    every = []
    for k, dt in enumerate(record.steps(model.dt)):
        u = None if record.u is None else record.u[k]
        row, _ = motion(model, u, float(dt), lo[k], hi[k])
        every.append(outputs(model, row, record.y[k], lo[k + 1], hi[k + 1]))
    A, C = np.array([row.A_lo for row in every]), np.array([row.C_lo for row in every])
    bx_lo, bx_hi, by_lo, by_hi = (
        np.concatenate([getattr(row, s) for row in every]) for s in ("bx_lo", "bx_hi", "by_lo", "by_hi")
    )
    return Rows(A, C, bx_lo, bx_hi, by_lo, by_hi)


def _turned(model: Nonlinear, y: Array, lo: Array, hi: Array) -> tuple[Array, Array]:
    """Return both ends of the outputs, angles on the turn that h may be on; NaN where that is more than one."""
    low, high = y.copy(), y.copy()
    assert isinstance(model.e, Uniform)
    for i in model.y_angles:
        reach = model.e.q[i] + 1e-12
        first, last = np.ceil((lo[i] - reach - y[i]) / _TURN), np.floor((hi[i] + reach - y[i]) / _TURN)
        if first == last:
            off = 1e-15 * abs(first * _TURN)  # a turn is no whole number of units
            low[i], high[i] = down(y[i] + first * _TURN - off), up(y[i] + first * _TURN + off)
        elif not first > last:
            low[i] = high[i] = np.nan
    return low, high
