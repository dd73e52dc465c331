"""Kalman filter and Rauch-Tung-Striebel smoother for linear models with Gaussian noise.

With E and F folded in, ``x[t] = E^-1 A x[t-1] + E^-1 B u[t] + N(0, E^-1 Q E^-T)`` and ``y[t] = F^-1 C x[t] +
N(0, F^-1 R F^-T)``, the kernels of core/kalman.hpp do the rest: any entry of any y may be missing, every matrix may
vary, and many series run side by side over the cores. With missing rows this is the intermittent Kalman filter of
Sinopoli et al. (2004, IEEE TAC 49(9)); the smoother is that of Rauch, Tung and Striebel (1965, AIAA J. 3(8)).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.errors import BadRecord, BadValue
from halfwidth.methods._protocol import typed
from halfwidth.model import Linear, Model, Nonlinear
from halfwidth.noise import Gaussian, Uniform, unknown_variances
from halfwidth.record import Record
from halfwidth.result import Estimate, Newest, Status
from halfwidth.spread import Box, Normal
from halfwidth.varying import Index, Varying


@dataclass(frozen=True)
class KalmanFilter:
    """Mean and covariance of each state given the outputs up to its row.

    Parameters
    ----------
    details : bool
        Whether ``info`` also holds the predictions: ``x_predicted``, ``P_predicted``, ``y_predicted``, ``S`` (its
        covariance), ``innovation`` (NaN where y is missing), ``nis`` (its normalised square, chi-square with
        ``n_seen`` degrees of freedom if the model is right) and ``loglik_rows``.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0.0], 1.0))
    >>> hw.estimate(walk, hw.Record([0.0, 1.0], [1.0, None]), hw.KalmanFilter()).x.round(3).ravel()
    array([0.667, 0.667])
    """

    details: bool = False

    def refuses(self, model: Model) -> str | None:
        """Return why the model is not linear and Gaussian, or None."""
        return not_gaussian(model, type(self).__name__)

    def run(self, model: Linear, record: Record, *, seed: int | None = None) -> Estimate:
        """Filter one record."""
        return self.run_many(model, [record], seed=seed)[0]

    def run_many(self, model: Linear, records: Sequence[Record], *, seed: int | None = None) -> list[Estimate]:  # noqa: ARG002
        """Filter several records side by side over the cores."""
        wanted = {"predicted": True, "outputs": True, "rows": True} if self.details else {}
        return _run("filter", self, model, records, wanted)

    def stream(self, model: Linear, t: float = 0.0) -> Any:
        """Return the kernel's online object, its belief one step before the first push being that of time `t`."""
        return _stream(self, model, t, 0)

    def init(self, model: Linear) -> "Belief":
        """Return the belief one step before the first row."""
        x0 = model.x0
        assert isinstance(x0, Normal)
        return Belief(x0.mean, x0.P, 0.0, 0, 0)

    def step(self, model: Linear, state: "Belief", y: Array, u: Array | None, t: float, dt: float) -> "Belief":
        """Return the belief after one row, for a method that changes it in between; a stream does without."""
        A, B, C, Q, R = _folded(model, {**model.matrices, "Q": model.w.cov(), "R": model.e.cov()}, state.row, t, dt)
        more = {} if u is None else {"u": np.ascontiguousarray(u[None])}
        out = _core.kalman_run(
            "filter",
            A[None],
            B[None] if model.nu else None,
            C[None],
            Q[None],
            R[None],
            np.ascontiguousarray(y[None]),
            ~np.isnan(y[None]),
            np.ascontiguousarray(state.x),
            np.ascontiguousarray(state.P),
            **more,
        )
        return Belief(
            out["x"][0], out["P"][0], state.loglik + float(out["loglik"][0]), state.row + 1, int(out["code"][0])
        )

    def belief(self, model: Linear, state: "Belief") -> tuple[Array, Array, float]:  # noqa: ARG002
        """Return mean, covariance and log-likelihood."""
        return state.x, state.P, state.loglik


class Belief(NamedTuple):
    """What `KalmanFilter.step` hands on: moments, log-likelihood, the number of rows and the kernel's code."""

    x: Array
    P: Array
    loglik: float
    row: int
    code: int


@dataclass(frozen=True)
class KalmanSmoother:
    """Mean and covariance of each state given all outputs, or those of the next `lag` rows too.

    ``info["x0"]`` and ``info["P0"]`` are the smoothed state one step before the first row (without a lag).

    Parameters
    ----------
    lag : int, optional
        Row t uses the outputs up to row t + lag; all outputs if absent.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0.0], 1.0))
    >>> est = hw.estimate(walk, hw.Record([0.0, 1.0, 2.0], [0.0, None, 3.0]), hw.KalmanSmoother())
    >>> est.x.round(3).ravel()
    array([0.545, 1.364, 2.182])
    """

    lag: int | None = None

    def __post_init__(self) -> None:
        if self.lag is not None and (not isinstance(self.lag, int | np.integer) or self.lag < 0):
            raise BadValue(f"`lag` is {self.lag!r}, a whole number of rows from 0 was expected", hint="lag=None")

    def refuses(self, model: Model) -> str | None:
        """Return why the model is not linear and Gaussian, or None."""
        return not_gaussian(model, type(self).__name__)

    def run(self, model: Linear, record: Record, *, seed: int | None = None) -> Estimate:
        """Smooth one record."""
        return self.run_many(model, [record], seed=seed)[0]

    def run_many(self, model: Linear, records: Sequence[Record], *, seed: int | None = None) -> list[Estimate]:  # noqa: ARG002
        """Smooth several records side by side over the cores."""
        if self.lag is None:
            return _run("smooth", self, model, records, {"initial": True})
        return _run("lag", self, model, records, {"lag": int(self.lag)})

    def stream(self, model: Linear, t: float = 0.0) -> Any:
        """Return the kernel's online object; each push gives the estimate of `lag` rows ago.

        Raises
        ------
        BadValue
            Without a lag: the future has no end.
        """
        if self.lag is None:
            raise BadValue(
                "`KalmanSmoother()` needs all outputs, so it cannot run on a stream",
                hint="KalmanSmoother(lag=10), or KalmanFilter()",
            )
        return _stream(self, model, t, int(self.lag))


def not_gaussian(model: Model, name: str) -> str | None:
    """Return why a Kalman method cannot take a model, with a hint, or None."""
    if isinstance(model, Nonlinear):
        return f"`{name}` needs a linear model but this one is `Nonlinear`\nhint: use `UnscentedKalman()`"
    wrong = [s for s, noise in (("w", model.w), ("e", model.e)) if not isinstance(noise, Gaussian)]
    if wrong:
        noises = [model.w if s == "w" else model.e for s in wrong]
        if any(isinstance(noise, Uniform) and not noise.known for noise in noises):
            hint = "use `BatchLP()`, which estimates unknown half-widths"
        else:
            hint = "use `model.as_gaussian()`, or a method for bounded noise"
        kinds = ", ".join(dict.fromkeys(type(noise).__name__ for noise in noises))
        symbols = "`, `".join(wrong)
        verb = "are" if len(wrong) > 1 else "is"
        return f"`{name}` needs Gaussian noise but `{symbols}` {verb} `{kinds}`\nhint: {hint}"
    if (reason := unknown_variances(model.w, model.e, name)) is not None:
        return reason
    if isinstance(model.x0, Box):
        return f"`{name}` needs a Gaussian prior but `x0` is `Box`\nhint: x0=Normal(mean, P), or `model.as_gaussian()`"
    if model.bounds is not None:
        return (
            f"`{name}` cannot keep states inside `bounds`\n"
            f"hint: use `Constrained({name}())`, or `model.as_gaussian()`, which drops them"
        )
    if model.loss is not None:
        return f"`{name}` takes every seen output as received but the model has `loss`\nhint: use `BKF2()` or `RBPF()`"
    if model.theta_entries:
        e = model.theta_entries[0]
        return (
            f"`{name}` needs every entry of the model but `{e.matrix}[{e.row}, {e.column}]` is unknown (NaN)\n"
            'hint: use `learn(model, record, what=("theta",))` first'
        )
    return None


class Matrices(NamedTuple):
    """What the kernels take: stacks (K, ., .) and, where K is neither 1 nor T, the index (T,) of each row."""

    A: Array
    B: Array | None
    C: Array
    Q: Array
    R: Array
    which: dict[str, Index]


def matrices(model: Linear, t: Array, dt: Array, lengths: Sequence[int] | None = None) -> Matrices:
    """Return the matrices of every row, E and F folded in.

    Parameters
    ----------
    model : Linear
    t, dt : (T,) arrays
        Times and steps, s; of several records one after the other.
    lengths : sequence of int, optional
        Rows of each record, if there are several.
    """
    A = _rows(model.A, t, dt, lengths)
    B = None if model.B is None else _rows(model.B, t, dt, lengths)
    C = _rows(model.C, t, dt, lengths)
    Q, R = _rows(model.w.cov(), t, dt, lengths), _rows(model.e.cov(), t, dt, lengths)
    if model.E is not None:
        E = _rows(model.E, t, dt, lengths)
        A, B = _paired(_left, E, A), None if B is None else _paired(_left, E, B)
        Q = _paired(_both, E, Q)
    if model.F is not None:
        F = _rows(model.F, t, dt, lengths)
        C, R = _paired(_left, F, C), _paired(_both, F, R)
    which = {f"i{s}": m[1] for s, m in zip("ABCQR", (A, B, C, Q, R), strict=True) if m is not None and m[1] is not None}
    a, c, q, r = (np.ascontiguousarray(m[0]) for m in (A, C, Q, R))
    return Matrices(a, None if B is None else np.ascontiguousarray(B[0]), c, q, r, which)


_Rows = tuple[Array, Index | None]


def _rows(matrix: Varying, t: Array, dt: Array, lengths: Sequence[int] | None) -> _Rows:
    if matrix.value is not None and matrix.value.ndim == 3 and lengths is not None and len(lengths) > 1:
        # stacked row by row: every record starts at row 0
        return matrix.value, np.concatenate([np.arange(n, dtype=np.int32) for n in lengths])
    return matrix.stack(t, dt)


def _left(E: Array, M: Array) -> Array:
    return np.asarray(np.linalg.solve(E, M), dtype=np.float64)


def _both(E: Array, Q: Array) -> Array:
    half = np.linalg.solve(E, Q)
    full = np.linalg.solve(E, np.swapaxes(half, -1, -2))
    return np.asarray(0.5 * (full + np.swapaxes(full, -1, -2)))


def _paired(f: Any, E: _Rows, M: _Rows) -> _Rows:
    """Apply f(E, M) to the matrices of each row, once for each distinct pair."""
    (e, ie), (m, im) = E, M
    if len(e) == 1 and ie is None:
        return f(e[0], m), im
    if len(m) == 1 and im is None:
        return f(e, np.broadcast_to(m[0], (len(e), *m.shape[1:]))), ie
    if ie is not None and im is not None and np.array_equal(ie, im):
        return f(e, m), im
    return f(e if ie is None else e[ie], m if im is None else m[im]), None


def _run(mode: str, method: Any, model: Linear, records: Sequence[Record], wanted: Mapping[str, Any]) -> list[Estimate]:
    if not records:
        return []
    one = len(records) == 1
    first, lengths = records[0], [len(r) for r in records]
    y = first.y if one else np.concatenate([r.y for r in records])
    seen = first.seen if one else np.concatenate([r.seen for r in records])
    if one or all(matrix.constant for matrix in (*model.matrices.values(), model.w.cov(), model.e.cov())):
        t, dt = first.t, first.steps(model.dt)
    else:
        t = np.concatenate([r.t for r in records])
        dt = np.concatenate([r.steps(model.dt) for r in records])
    u = None
    if model.nu:
        u = first.u if one else np.concatenate([r.u for r in records if r.u is not None])
    m = matrices(model, t, dt, lengths)
    x0 = model.x0
    assert isinstance(x0, Normal)
    more: dict[str, Any] = {} if u is None else {"u": np.ascontiguousarray(u)}
    if not one:
        more["offsets"] = np.concatenate(([0], np.cumsum(lengths)))
    out = _core.kalman_run(
        mode,
        m.A,
        m.B if model.nu else None,
        m.C,
        m.Q,
        m.R,
        np.ascontiguousarray(y),
        np.ascontiguousarray(seen),
        np.ascontiguousarray(x0.mean),
        np.ascontiguousarray(x0.P),
        **more,
        **m.which,
        **wanted,
    )
    name, found, row = typed(method), [], 0
    for k, record in enumerate(records):
        s = slice(row, row + len(record))
        row = s.stop
        x, P = out["x"][s], out["P"][s]
        status, info = _ended(out["code"][k], out["row"][k], record)
        info["n_seen"] = out["n_seen"][k]
        info["n_reduced"] = out["n_reduced"][k]
        if "x0" in out:
            info["x0"], info["P0"] = out["x0"][k], out["P0"][k]
        if "xp" in out:
            info |= {"x_predicted": out["xp"][s], "P_predicted": out["Pp"][s], "y_predicted": out["yp"][s]}
            info |= {"S": out["S"][s], "nis": out["nis"][s], "loglik_rows": out["ll"][s]}
            info["innovation"] = record.y - out["yp"][s]
        found.append(
            Estimate(
                record.t,
                x,
                Normal.of(x, P),
                status,
                name,
                loglik=float(out["loglik"][k]),
                names=model.names.x,
                labels=record.labels,
                info=info,
            )
        )
    return found


def _ended(code: int, row: int, record: Record) -> tuple[Status, dict[str, Any]]:
    """Translate the kernel's code, met at `row`."""
    if code < 2:
        return Status.OK, {}
    where = f"row {row} (t = {record.t[row]:.6g} s)"
    if code == 2:
        return Status.REDUCED, {
            "message": f"{where} contradicts what the model holds for certain",
            "hint": "give `w` or `e` some variance, or look for an outlier there",
        }
    return Status.COLLAPSED, {
        "message": f"the state left the range of floating point at {where}; its last finite value is repeated",
        "hint": "look for an unstable `A` or wrong units",
    }


def _folded(model: Linear, varying: Mapping[str, Varying], row: int, t: float, dt: float) -> tuple[Array, ...]:
    """Return A, B, C, Q, R of one row, E and F folded in."""
    for m in varying.values():
        if m.value is not None and m.value.ndim == 3 and row >= len(m.value):
            raise BadRecord(f"row {row} was pushed but `{m.name}` is stacked for {len(m.value)} rows")
    M = {name: matrix.at(t, dt, row) for name, matrix in varying.items()}
    A, B, C = M["A"], M.get("B", np.zeros((model.nx, 0))), M["C"]
    Q, R = M["Q"], M["R"]
    if "E" in M:
        A, B, Q = _left(M["E"], A), _left(M["E"], B), _both(M["E"], Q)
    if "F" in M:
        C, R = _left(M["F"], C), _both(M["F"], R)
    return tuple(np.ascontiguousarray(m) for m in (A, B, C, Q, R))


def _stream(method: Any, model: Linear, t: float, lag: int) -> Any:
    x0 = model.x0
    assert isinstance(x0, Normal)
    varying = {**model.matrices, "Q": model.w.cov(), "R": model.e.cov()}
    of = {name for m in varying.values() for name in m.of}
    stacked = [m for m in varying.values() if m.value is not None and m.value.ndim == 3]
    every_row = bool(stacked) or "t" in of

    def at(row: int, t: float, dt: float) -> tuple[Array, ...]:
        return _folded(model, varying, row, t, dt)

    newest = type("NewestKalman", (Newest,), {"__slots__": (), "method": typed(method), "names": model.names.x})

    return _core.KalmanStream(
        *at(0, t + model.dt, model.dt),
        np.ascontiguousarray(x0.mean),
        np.ascontiguousarray(x0.P),
        newest,
        lag=lag,
        dt=model.dt,
        t=t,
        matrices=at if of or stacked else None,
        every_row=every_row,
        error=BadRecord,
    )
