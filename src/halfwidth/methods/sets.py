"""Cheap sets that contain the state: interval, zonotope, constrained zonotope and ellipsoid recursions.

For noise of known half-widths and a box as prior, each row moves a set through the dynamics, adds what the noise can do
and cuts it with the seen outputs. `IntervalFilter` keeps a box and contracts it forwards and backwards over the newest
step [1]_; `ZonotopeFilter` keeps generators and the gain that makes them least [2]_; `ConstrainedZonotopeFilter` also
keeps the newest outputs as constraints, and can be brought near the exact set [3]_; `EllipsoidFilter` keeps a centre
and a matrix [4]_. The box runs beside each of the others and both tighten each other, so their answers lie inside that
of `IntervalFilter`; all lie around the exact hull.

Rounding is accounted for, so the boxes contain in floating point. A row that contradicts the rows before it is named,
and the status is INFEASIBLE. Nonlinear models are taken where `g` and `h` can be
recorded: over the newest box they are replaced by affine functions with a proved distance, which widens the noise
(`halfwidth.enclosure`). Unknown entries of A, B, C, E within finite ``theta_bounds`` make an interval matrix.

References
----------
.. [1] Jaulin, Kieffer, Didrit and Walter (2001), Applied Interval Analysis; Benhamou et al. (1999), ICLP.
.. [2] Combastel (2015), Automatica 55; Alamo, Bravo and Camacho (2005), Automatica 41.
.. [3] Scott, Raimondo, Marseglia and Braatz (2016), Automatica 69.
.. [4] Schweppe (1968), IEEE TAC 13; Fogel and Huang (1982), Automatica 18.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.errors import BadValue, Refused, hinted
from halfwidth.methods._affine import motion, not_recorded, outputs
from halfwidth.methods._bounds import Rows, interval_rows, not_bounded, one_row
from halfwidth.methods._protocol import typed
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.noise import Uniform
from halfwidth.record import Labels, Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Box


@dataclass(frozen=True, eq=False)
class SetState:
    """What a set recursion remembers between rows.

    Parameters
    ----------
    lo, hi : (nx,) arrays
        Box of the newest state; infinite where nothing is known.
    x : (nx,) array
        Its middle.
    shape : array
        The kernel's own numbers.
    rows : int
        Rows taken so far.
    conflict : int
        0, or 1 + the number of the first row that contradicts those before it.
    which : int
        Which of its nx + ny equations, states first.
    """

    lo: Array
    hi: Array
    x: Array
    shape: Array
    rows: int
    conflict: int
    which: int


class _Recursion:
    """The recursion that all sets share; the kind of set is the kernel's business."""

    def refuses(self, model: Model) -> str | None:
        """Return why the model cannot be taken, or None."""
        name = type(self).__name__
        reason = not_bounded(model, name)
        return not_recorded(model, name) if reason is None and isinstance(model, Nonlinear) else reason

    def run(self, model: Model, record: Record, *, seed: int | None = None) -> Estimate:  # noqa: ARG002
        """Enclose the state at every row, from the rows up to it."""
        state = self.init(model)
        if isinstance(model, Linear):
            state, lo, hi, x = self._advance(model, state, interval_rows(model, record))
        else:
            dt = record.steps(model.dt)
            lo, hi, x = (np.empty((len(record), model.nx)) for _ in range(3))
            for k in range(len(record)):
                u = None if record.u is None else record.u[k]
                state = self.step(model, state, record.y[k], u, float(record.t[k]), float(dt[k]))
                lo[k], hi[k], x[k] = state.lo, state.hi, state.x
        return self._estimate(model, state, record.t, lo, hi, x, record.labels)

    def init(self, model: Model) -> SetState:
        """Return the set one step before the first row."""
        reason = self.refuses(model)
        if reason is not None:
            message, hint = hinted(reason)
            raise Refused(message, hint=hint)
        assert isinstance(model.x0, Box)
        kind, generators, constraints, _ = self._sizes(model)
        shape = _core.sets_start(kind, model.nx, model.ny, generators, constraints)
        return SetState(model.x0.lo, model.x0.hi, model.x0.mean, shape, 0, 0, 0)

    def step(self, model: Model, state: SetState, y: Array, u: Array | None, t: float, dt: float) -> SetState:
        """Return the set after one row; NaN in `y` is missing."""
        if isinstance(model, Linear):
            return self._advance(model, state, one_row(model, y, u, t, dt, state.rows))[0]
        return self._nonlinear(model, state, y, u, dt)

    def answer(self, model: Model, state: SetState, t: float) -> Estimate:
        """Return the estimate of the newest row, for a stream."""
        return self._estimate(model, state, np.array([t]), state.lo[None], state.hi[None], state.x[None], Labels())

    def _sizes(self, model: Model) -> tuple[str, int, int, int]:
        """Return kind of set, most generators, most constraints, and rounds of the search for their multipliers."""
        raise NotImplementedError

    def _advance(
        self, model: Model, state: SetState, rows: Rows, inside: tuple[Array, Array] | None = None
    ) -> tuple[SetState, Array, Array, Array]:
        """Run the kernel over some rows: the state after them, boxes and points of each; `inside` bounds all."""
        kind, generators, constraints, rounds = self._sizes(model)
        if inside is None and isinstance(model.bounds, Box):
            inside = model.bounds.lo, model.bounds.hi
        low, high = (None, None) if inside is None else inside
        lo, hi, x, shape, code = _core.sets_run(
            kind, rows.E_lo, rows.A_lo, rows.C_lo, rows.bx_lo, rows.bx_hi, rows.by_lo, rows.by_hi, state.lo, state.hi,
            state.x, state.shape, generators, constraints, rounds, low, high, rows.E_hi, rows.A_hi, rows.C_hi,
        )  # fmt: skip
        conflict, which = state.conflict, state.which
        if code and not conflict:
            row, which = divmod(code - 1, model.nx + model.ny)
            conflict = state.rows + row + 1
        new = SetState(lo[-1], hi[-1], x[-1], shape, state.rows + len(rows.bx_lo), conflict, which)
        return new, lo[1:], hi[1:], x[1:]

    def _nonlinear(self, model: Nonlinear, state: SetState, y: Array, u: Array | None, dt: float) -> SetState:
        """One row of a nonlinear model: affine over the box before it, the outputs over the box after it."""
        rows, inside = motion(model, u, dt, state.lo, state.hi)
        # The motion alone says where h is to be enclosed; what the outputs then say is where it is enclosed again.
        box = IntervalFilter()
        before = replace(state, shape=_core.sets_start("interval", model.nx, model.ny))
        after = box._advance(model, before, rows, inside)[0]
        if after.conflict > state.rows:
            return self._advance(model, state, rows, inside)[0]
        for _ in range(2):
            inside = after.lo, after.hi
            after = self._advance(model, state, outputs(model, rows, y, *inside), inside)[0]
            if after.conflict > state.rows:
                break
        return after

    def _estimate(
        self,
        model: Model,
        state: SetState,
        t: Array,
        lo: Array,
        hi: Array,
        x: Array,
        labels: Labels,
    ) -> Estimate:
        """Wrap boxes and points; where rows contradict there is no box."""
        assert isinstance(model.w, Uniform)
        assert isinstance(model.e, Uniform)
        info: dict[str, Any] = {"rows": state.rows}
        if not state.conflict:
            spread, status = Box(lo, hi), Status.OK
        else:
            spread, status = None, Status.INFEASIBLE
            row = state.conflict - 1
            output = state.which >= model.nx
            name = model.names.y[state.which - model.nx] if output else model.names.x[state.which]
            here = row - (state.rows - len(t))  # where it is in this answer
            when = f"t = {t[here]:.9g} s" if here >= 0 else f"row {row}"
            kind = "output" if output else "state"
            info["message"] = f"{status.value} at {when}: {kind} `{name}` contradicts the rows before it"
            info["conflict"] = [{"t": float(t[here]) if here >= 0 else None, "row": row, "kind": kind, "name": name}]
            info["hint"] = "leave what info['conflict'] names away, or declare wider half-widths"
        return Estimate(
            t, x, spread, status, typed(self), q=model.w.q, r=model.e.q, names=model.names.x, labels=labels, info=info
        )


@dataclass(frozen=True)
class IntervalFilter(_Recursion):
    """A box that contains the state: the cheapest set.

    The rows of the newest step are contracted forwards and backwards, twice. The prior may be without ends.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Uniform(0.1), hw.Uniform(0.5), hw.Box(-1, 1))
    >>> est = hw.estimate(walk, hw.Record([0.0, 1.0, 2.0], [0.9, None, 0.2]), hw.IntervalFilter())
    >>> [a.round(3).ravel().tolist() for a in est.interval()]
    [[0.4, 0.3, 0.2], [1.1, 1.2, 0.7]]
    """

    def _sizes(self, model: Model) -> tuple[str, int, int, int]:  # noqa: ARG002
        return "interval", 0, 0, 0


@dataclass(frozen=True)
class ZonotopeFilter(_Recursion):
    """A zonotope that contains the state: outputs enter with the gain that makes its generators least.

    Parameters
    ----------
    order : int
        Most generators a state between rows; more are tighter and slower.
    """

    order: int = 20

    def __post_init__(self) -> None:
        _whole(self.order, "order", 1)

    def _sizes(self, model: Model) -> tuple[str, int, int, int]:
        return "zonotope", self.order * model.nx, 0, 0


@dataclass(frozen=True)
class ConstrainedZonotopeFilter(_Recursion):
    """A zonotope cut by the newest outputs: more settings bring it as near to the exact set as one pays for.

    The outputs of the newest rows are kept as constraints; the oldest become part of the generators as in
    `ZonotopeFilter`. Each side of the box is a bound by multipliers of the constraints, safe whatever they are; a few
    rounds of reweighted least squares make them good.

    Parameters
    ----------
    order : int
        Most generators a state between rows.
    constraints : int
        Most outputs kept between rows.
    rounds : int
        Rounds of the search for multipliers; 4 are within 3 % of the least box of the same set, 16 within 0.3 %.
    """

    order: int = 16
    constraints: int = 2
    rounds: int = 4

    def __post_init__(self) -> None:
        _whole(self.order, "order", 1)
        _whole(self.constraints, "constraints", 1)
        _whole(self.rounds, "rounds", 1)

    def _sizes(self, model: Model) -> tuple[str, int, int, int]:
        return "constrained", self.order * model.nx, self.constraints, self.rounds


@dataclass(frozen=True)
class EllipsoidFilter(_Recursion):
    """An ellipsoid that contains the state: sums and intersections of least trace, each coordinate in its own width."""

    def _sizes(self, model: Model) -> tuple[str, int, int, int]:  # noqa: ARG002
        return "ellipsoid", 0, 0, 0


def _whole(value: object, name: str, least: int) -> None:
    if not isinstance(value, int | np.integer) or value < least:
        raise BadValue(f"`{name}` is {value!r}, a whole number from {least} was expected")
