"""A linear model over one record as a chain with factors on linear functionals: what `halfwidth._core.ep_*` take.

``x[t] = E^-1 (A x[t-1] + B u[t] + w[t])`` carries one factor on each w that has a uniform part; the rows of a stage are
its seen outputs, ``h'x - y = e``, and the bounds (`_factors`). What no data are in is a `Frame`, which windows with the
same outputs seen have in common.
"""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.methods._factors import EXACT, GAUSSIAN, MAYBE_LOST, TRUNCATION, bounds, first_bounds, outputs
from halfwidth.methods._noise_parts import all_groups, ends_of, gaussian_part, given, uniform_part
from halfwidth.methods._residuals import felt, reference, residuals
from halfwidth.model import Linear
from halfwidth.record import Record
from halfwidth.spread import Box, Normal
from halfwidth.varying import Varying

#: Standard deviation of an outlier in half-widths.
WIDE = 10.0
#: ... and so a standard deviation that is to be found stays above this share of it.
_LEAST = 1e-6


@dataclass(frozen=True, eq=False)
class Frame:
    """What the chains of one model have in common in all windows of the same rows seen.

    There are p = nx + ny groups, the half-widths (q, r), or twice as many: then the other half are the standard
    deviations of Gaussian parts of w and e whose variances are unknown.

    Parameters
    ----------
    problem : dict
        The entries of `Sites.problem` that no data are in.
    free : (p,) bool array
        Groups that are unknown and have rows.
    floor, cap, count : (p,) arrays
        Bounds, and number of rows of each.
    uniform : (p,) bool array
        Which entries have a half-width at all.
    fitted : (p,) bool array
        Which entries belong to a noise with unknown variances; `free` says which are.
    row, output : (K,) int arrays
        Row of the record and output of each row of the chain; -1 where it is a bound.
    B : (nu, nx) array or None
        Inputs to what is added to the state; None: as the rows of the record have it.
    Y : (K, ny) or (K,) array
        Seen outputs of its row to the target of each row of the chain; (K,) where that is one output.
    at : (K,) array
        That row, or the place of that output in y (T, ny); 0 where it is a bound, whose target is 0.
    whole : bool
        Whether every output is seen.
    felt : (ny, nx) array
        As `felt` in `_residuals`.
    R : (ny,) array or None
        Variances of Gaussian outputs; None where the noise has a bounded part.
    gaussian : bool
        Whether no factor but that of x0 may be bounded.
    """

    problem: dict[str, Any]
    free: NDArray[np.bool_]
    floor: Array
    cap: Array
    count: Array
    uniform: NDArray[np.bool_]
    fitted: NDArray[np.bool_]
    row: NDArray[np.intp]
    output: NDArray[np.intp]
    B: Array | None
    Y: Array
    at: NDArray[np.intp]
    whole: bool
    felt: Array
    R: Array | None
    gaussian: bool
    #: Such chains as the core takes them, by what was asked of it.
    learners: dict[Any, _core.EpFrame] = field(default_factory=dict)

    def fits(self, scale: Array, y: Array) -> bool:
        """Say whether no variance is so small beside the outputs y (T, ny), of scale (p,), that it is lifted."""
        if self.R is None:
            return True
        size = np.maximum(scale[-len(self.R) :], math.sqrt(EXACT) * np.abs(y).max())
        return bool((2.0 * EXACT * size**2 < self.R).all())

    def targets(self, y: Array) -> Array:
        """Return the targets (K,) of the rows of the chain; y (T, ny) is 0 where unseen."""
        if self.Y.ndim == 1:
            return np.asarray(self.Y * y.take(self.at))
        return np.asarray((self.Y * y.take(self.at, axis=0)).sum(axis=1))

    @cached_property
    def outside(self) -> dict[str, Any] | None:
        """The chain with its bounds alone, None where there are none; see core/ep_learn.hpp."""
        p, keep = self.problem, self.problem["kind"] == TRUNCATION
        if not keep.any():
            return None
        rows = {k: np.ascontiguousarray(p[k][keep]) for k in ("h", "kind", "group", "R", "lo", "hi")}
        before = np.concatenate([[0], np.cumsum(keep)])
        return p | rows | {"lost": None, "mix": None, "group_R": None, "start": before[p["start"]].astype(np.int32)}

    @cached_property
    def bounded(self) -> bool:
        """Whether every entry has a half-width."""
        return bool(self.uniform.all())

    @cached_property
    def unseen(self) -> bool:
        """Whether a group has no row."""
        return not self.count.all()

    @cached_property
    def q(self) -> int:
        """Number of free groups."""
        return int(self.free.sum())


@dataclass(eq=False)
class Sites:
    """A chain with its data: `m0`, `P0`, `half0` of x0, `b` (T, nx) and the targets `y` (K,).

    `scale` (p,) is the order of size of each group by these data, and `floor` (p,) the least that it may be.
    """

    frame: Frame
    floor: Array
    scale: Array
    m0: Array
    P0: Array
    half0: Array
    b: Array
    y: Array

    @property
    def free(self) -> NDArray[np.bool_]:
        """As in `Frame`."""
        return self.frame.free

    @property
    def cap(self) -> Array:
        """As in `Frame`."""
        return self.frame.cap

    @property
    def count(self) -> Array:
        """As in `Frame`."""
        return self.frame.count

    @cached_property
    def problem(self) -> dict[str, Any]:
        """All of it, for the core's `ep_run`."""
        return self.frame.problem | self.data

    @property
    def data(self) -> dict[str, Array]:
        """What is in no frame."""
        return {"m0": self.m0, "P0": self.P0, "half0": self.half0, "b": self.b, "y": self.y}

    @property
    def outside(self) -> dict[str, Any] | None:
        """The chain with its bounds alone, None where there are none."""
        bounds = self.frame.outside
        return None if bounds is None else bounds | self.data | {"y": np.zeros(len(bounds["kind"]))}

    @property
    def guess(self) -> Array:
        """Generous first values of all groups from the data's scale, (p,)."""
        fitted = self.frame.fitted
        size = np.where(fitted, self.scale, math.sqrt(3.0) * self.scale)
        return np.where(self.frame.uniform | fitted, size.clip(self.floor, self.cap), 0.0)

    @property
    def exact(self) -> bool:
        """Whether every factor is Gaussian, so that one sweep is the answer."""
        return self.frame.gaussian and not self.half0.any()


#: Frames that are kept of one model, each of at most so many rows.
_FRAMES, _SHORT = 64, 512
_kept: WeakKeyDictionary[Linear, dict[bool, dict[bytes, Frame]]] = WeakKeyDictionary()


def frames_of(model: Linear, record: Record, outliers: bool) -> dict[bytes, Frame] | None:
    """Return what other short records of the same model have left, None for a long one."""
    if len(record) > _SHORT:
        return None
    return _kept.setdefault(model, {}).setdefault(outliers, {})


def sites(model: Linear, record: Record, *, outliers: bool = False, frames: dict[bytes, Frame] | None = None) -> Sites:
    """Build the chain of a model without unknown entries.

    `frames` keeps what windows of one model have in common, where its matrices are constant.
    """
    kept, frame = b"", None
    if frames is not None and not _half_open(model.x0):
        kept = record.seen.tobytes()
        frame = frames.get(kept)
    y = record.y if frame is not None and frame.whole else np.where(record.seen, record.y, 0.0)
    effect = felt(model) if frame is None else frame.felt
    whole = frame is not None and frame.whole
    scale = _core.window_sizes(
        effect, list(y.T) if whole else [v[there] for v, there in zip(y.T, record.seen.T, strict=True)]
    )
    if frame is None or not frame.fits(scale, y):
        made = None
        if frames is not None and kept and _constant(model):
            made = _of_rows(model, record, scale, outliers, frames)
        if made is not None and frames is not None and made.fits(scale, y):
            _keep(frames, kept, made)
        frame = _frame(model, record, scale, outliers) if made is None else made
    if frame.B is None:
        b = _added(model, record)
    else:
        b = np.zeros((len(record), model.nx)) if record.u is None else record.u @ frame.B
    floor, cap, fitted = frame.floor, frame.cap, frame.fitted
    if len(fitted) > len(scale):
        scale = np.resize(scale, len(fitted))
        floor = np.where(fitted & (floor < cap), np.minimum(np.maximum(floor, _LEAST * scale), cap), floor)
    return Sites(frame, floor, scale, *_first_state(model, record), b, frame.targets(y))


def _half_open(x0: Any) -> bool:
    """Say whether a box has an end without the other: a bound of the first state, which is in the frame."""
    return isinstance(x0, Box) and bool((np.isfinite(x0.lo) ^ np.isfinite(x0.hi)).any())


def _constant(model: Linear) -> bool:
    """Say whether a frame of the model serves other rows."""
    noises = [part for part in (gaussian_part(model.w), gaussian_part(model.e)) if part is not None]
    covs = [part.cov() for part in noises if part.known]
    return (
        model.loss is None
        and all(m.value is not None and m.value.ndim == 2 for m in (*model.matrices.values(), *covs))
        and all(part.known or bool(np.less(*ends_of(part, 1)).all()) for part in noises)
    )


def _keep(frames: dict[bytes, Frame], key: bytes, frame: Frame) -> None:
    if len(frames) >= _FRAMES:
        del frames[next(iter(frames))]
    frames[key] = frame


def _of_rows(model: Linear, record: Record, scale: Array, outliers: bool, frames: dict[bytes, Frame]) -> Frame | None:
    """Return the frame of a record from those of its rows, None where outputs lift a variance.

    Matrices are constant, so rows of one pattern differ in their data only.
    """
    y, keys = np.where(record.seen, record.y, 0.0), [seen.tobytes() for seen in record.seen]
    rows: dict[bytes, Frame] = {}
    for k, key in enumerate(keys):
        if key not in rows:
            found = frames.get(key)
            if found is None:
                one = slice(k, k + 1)
                part = Record.of(
                    record.t[one], record.y[one], None if record.u is None else record.u[one], record.seen[one]
                )
                found = _frame(model, part, scale, outliers)
                if not found.fits(scale, y):
                    return None
                _keep(frames, key, found)
            rows[key] = found
    each = [rows[key] for key in keys]
    T, ny, first = len(each), model.ny, each[0]
    sizes = [len(f.row) for f in each]
    row = np.repeat(np.arange(T), sizes)
    flat = all(f.Y.ndim == 1 for f in rows.values())
    problem = dict(first.problem, start=np.concatenate(([0, 0], np.cumsum(sizes)), dtype=np.int32))
    none: dict[str, Any] = {"mix": np.zeros(len(first.cap)), "group_R": np.int32(-1)}
    for name in ("h", "kind", "group", "R", "lo", "hi", "mix", "group_R"):
        parts = {key: f.problem[name] for key, f in rows.items()}
        if all(part is None for part in parts.values()):
            continue
        for key, f in rows.items():
            if parts[key] is None:
                parts[key] = np.repeat(none[name][None], len(f.row), axis=0)
        problem[name] = np.concatenate([parts[key] for key in keys])
    count = np.sum([f.count for f in each], axis=0)
    wide = {key: f.Y if flat or f.Y.ndim == 2 else _spread_out(f, ny) for key, f in rows.items()}
    at = np.concatenate([f.at if flat else np.zeros(len(f.row), dtype=np.intp) for f in each])
    free = (first.uniform | first.fitted) & (first.floor < first.cap) & (count > 0)
    return replace(
        first, problem=problem, free=free, count=count,
        row=row, output=np.concatenate([f.output for f in each]), Y=np.concatenate([wide[key] for key in keys]),
        at=at + row * (ny if flat else 1), whole=all(f.whole for f in rows.values()),
        gaussian=all(f.gaussian for f in rows.values()), learners={},
    )  # fmt: skip


def _spread_out(frame: Frame, ny: int) -> Array:
    """Return `Y` of the frame of one row as (K, ny)."""
    Y = np.zeros((len(frame.Y), ny))
    Y[np.arange(len(Y)), frame.at] = frame.Y
    return Y


def _frame(model: Linear, record: Record, scale: Array, outliers: bool) -> Frame:
    T, nx, ny = len(record), model.nx, model.ny
    dt = record.steps(model.dt)
    floor, cap, uniform, fitted = all_groups(model)
    p = len(floor)
    problem: dict[str, Any] = {"groups": p, "wide": WIDE}
    _dynamics(problem, model, record, dt)
    w_group = np.where(uniform[:nx] & (cap[:nx] > 0), np.arange(nx), -1)
    problem["group_w"] = w_group.astype(np.int32)
    of_w = (fitted & (floor < cap))[nx + ny :][:nx]
    problem["group_Q"] = np.where(of_w, nx + ny + np.arange(nx), -1).astype(np.int32) if of_w.any() else None
    rows = outputs(model, record, dt, scale, outliers)
    rows += bounds(model, T)
    rows += first_bounds(model)
    stage = np.concatenate([r.stage for r in rows]) if rows else np.zeros(0, dtype=np.intp)
    order = np.argsort(stage, kind="stable")
    problem["start"] = np.searchsorted(stage[order], np.arange(T + 2)).astype(np.int32)

    def joined(name: str, dtype: Any, shape: tuple[int, ...] = ()) -> Any:
        if not rows:
            return np.zeros((0, *shape), dtype=dtype)
        return np.ascontiguousarray(np.concatenate([getattr(r, name) for r in rows])[order], dtype=dtype)

    problem["h"] = joined("h", float, (nx,))
    for name, dtype in (("kind", np.int8), ("group", np.int32), ("R", float), ("lo", float), ("hi", float)):
        problem[name] = joined(name, dtype)
    problem["lost"] = joined("lost", float) if (problem["kind"] == MAYBE_LOST).any() else None
    problem["mix"] = joined("mix", float, (p,)) if any(r.mix.any() for r in rows) else None
    group_R = joined("deviation", np.int32)
    problem["group_R"] = group_R if (group_R >= 0).any() else None
    output = joined("output", np.intp)
    count = np.resize(np.r_[np.full(nx, float(T)), [float(np.count_nonzero(output == j)) for j in range(ny)]], p)
    free = (uniform | fitted) & (floor < cap) & (count > 0)
    B = None
    if all(m is None or m.constant for m in (model.B, model.E)):
        B = np.zeros((nx, model.nu)) if model.B is None else model.B.single
        B = np.ascontiguousarray((B if problem["G"] is None else problem["G"][0] @ B).T)
    part = gaussian_part(model.e)
    R = None
    if part is not None and uniform_part(model.e) is None and part.known and part.cov().constant:
        R = np.diagonal(part.cov().single)
    row = stage[order] - 1
    Y, at = joined("Y", float, (ny,)), np.maximum(row, 0)
    if (np.count_nonzero(Y, axis=1) <= 1).all():
        of = np.abs(Y).argmax(axis=1)
        Y, at = Y[np.arange(len(Y)), of], at * ny + of
    return Frame(
        problem, free, floor, cap, count, uniform, fitted, row, output, B, Y, at, bool(record.seen.all()), felt(model),
        R, bool((problem["kind"] == GAUSSIAN).all() and (w_group < 0).all()),
    )  # fmt: skip


def _one(matrix: Varying | None, record: Record, dt: Array) -> tuple[Array, NDArray[np.int32] | None]:
    """Return the distinct matrices and the index of each row, None where one serves all or each has its own."""
    assert matrix is not None
    return matrix.stack(record.t, dt)


def _dynamics(problem: dict[str, Any], model: Linear, record: Record, dt: Array) -> None:
    part = gaussian_part(model.w)
    problem["G"] = problem["G_index"] = problem["Q"] = problem["Q_index"] = None
    A, A_index = _one(model.A, record, dt)
    Q = None if part is None else given(part, model.nx)
    if Q is not None:
        problem["Q"], problem["Q_index"] = _one(Q, record, dt)
    if model.E is not None:
        if model.E.constant:
            G = np.linalg.inv(model.E.single)[None]
            A = G @ A
            if Q is not None:
                problem["Q"] = G @ problem["Q"] @ G[0].T
        else:
            G = np.linalg.inv(model.E.each(record.t, dt))
            A, A_index = G @ model.A.each(record.t, dt), None
            if Q is not None:
                problem["Q"], problem["Q_index"] = G @ Q.each(record.t, dt) @ np.swapaxes(G, 1, 2), None
        problem["G"] = np.ascontiguousarray(G, dtype=float)
    if problem["Q"] is not None:
        problem["Q"] = np.ascontiguousarray(problem["Q"], dtype=float)
    problem["A"], problem["A_index"] = np.ascontiguousarray(A, dtype=float), A_index


def _added(model: Linear, record: Record) -> Array:
    """Return what inputs add to the state of each row, (T, nx), where a matrix varies."""
    b: Array = np.zeros((len(record), model.nx))
    dt = record.steps(model.dt)
    if model.B is not None and record.u is not None:
        b = np.einsum("tij,tj->ti", model.B.each(record.t, dt), record.u)
    if model.E is not None:
        b = np.asarray(np.linalg.solve(model.E.each(record.t, dt), b[:, :, None])[:, :, 0])
    return np.ascontiguousarray(b)


def _first_state(model: Linear, record: Record) -> tuple[Array, Array, Array]:
    """Return mean, covariance and half-widths of x0: Gaussian, uniform in a box, or so wide that it says nothing."""
    x0, nx = model.x0, model.nx
    if isinstance(x0, Normal):
        return np.ascontiguousarray(x0.mean), np.ascontiguousarray(x0.P), np.zeros(nx)
    assert isinstance(x0, Box)
    finite = np.isfinite(x0.lo) & np.isfinite(x0.hi)
    m0, half = np.array(x0.mean), np.where(finite, 0.5 * (x0.hi - x0.lo), 0.0)
    P0 = np.zeros((nx, nx))
    if not finite.all():
        # Around a least-squares trajectory, a thousand times as wide as the data leave it.
        known = np.zeros(nx + model.ny)
        rows = residuals(model, record)
        base = reference(rows, model, known)
        wide = np.maximum(1e3 * base.column[:nx], 10.0 * np.abs(base.X[:nx]))
        m0 = np.where(finite, m0, base.X[:nx])
        P0 = np.diag(np.where(finite, 0.0, wide**2))
    return np.ascontiguousarray(m0, dtype=float), P0, half
