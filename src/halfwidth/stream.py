"""The one object that holds state: rows go in, the newest estimate comes out; saved as bytes, resumed anywhere.

`stream` gives the online form of a method that has one. The Kalman family runs in a C++ object with its own buffers;
other recursive methods are stepped through `Recursive.step`, with the same numbers as their offline form. A snapshot
holds plain numbers and names with a version and a check sum, never code, so bytes from elsewhere are safe to read.
"""

import base64
import dataclasses
import json
import math
import zlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from halfwidth import methods
from halfwidth.array import Array
from halfwidth.errors import BadValue, Refused, hinted
from halfwidth.estimate import choose
from halfwidth.methods._protocol import pushed_row, typed
from halfwidth.model import Linear, Model
from halfwidth.noise import Gaussian
from halfwidth.result import Estimate, Newest
from halfwidth.spread import Normal

_MAGIC = b"HWSTREAM"
_VERSION = 1


class Stream:
    """A method running on line. Made by `stream` or `resume`.

    Attributes
    ----------
    push : callable
        ``push(y, u=None, dt=None)`` folds one row in and returns the newest estimate, an `Estimate` of one row. None or
        NaN in `y` is a missing entry, ``push(None)`` a row without any output; `dt` is the step before the row in s,
        ``model.dt`` if absent.
    model : Linear or Nonlinear
    method : estimator
    """

    __slots__ = ("_core", "method", "model", "push")

    def __init__(self, model: Model, method: Any, core: Any) -> None:
        self.model = model
        self.method = method
        self._core = core
        self.push = core.push  # the bound method itself: one look-up less at each row

    @property
    def rows(self) -> int:
        """Number of rows pushed so far."""
        return int(self._core.pushed)

    @property
    def t(self) -> float:
        """Time of the newest row, s."""
        return float(self._core.t)

    def bound(self, c: ArrayLike, u: ArrayLike | None = None, dt: float | None = None) -> Any:
        """Return the guaranteed `Bound` of c'x at the next row, before its outputs are seen.

        Its `excess` says whether an output can be at all, and by how much it cannot.

        Parameters
        ----------
        c : (nx,) array_like
        u, dt
            Inputs of the next row and the step to it, as in `push`.

        Raises
        ------
        Refused
            If the stream is not one of `Hull`.
        Unsolved
            If no trajectory fits the rows pushed so far.
        """
        if not hasattr(self._core, "bound"):
            raise Refused(f"`{typed(self.method)}` guarantees nothing", hint="stream(model, Hull(memory=10))")
        return self._core.bound(c, u, dt)

    def snapshot(self) -> bytes:
        """Return everything `resume` needs, as bytes.

        A linear Gaussian model of constant matrices is part of it; any other model is given to `resume` again.
        """
        head = {
            "method": [type(self.method).__name__, _settings(self.method)],
            "model": _model_to_json(self.model),
            "sizes": [self.model.nx, self.model.ny, self.model.nu],
        }
        body = json.dumps(head).encode()
        state = self._core.snapshot()
        parts = _MAGIC + _VERSION.to_bytes(4, "little") + len(body).to_bytes(8, "little") + body + state
        return bytes(parts + zlib.crc32(parts).to_bytes(4, "little"))

    def __repr__(self) -> str:
        return f"Stream({typed(self.method)}, {self.rows} rows, t = {self.t:g} s)"


def stream(model: Model, method: Any = None, *, t: float = 0.0) -> Stream:
    """Return the online form of a method.

    Parameters
    ----------
    model : Linear or Nonlinear
    method : estimator, optional
        One with an online form, such as ``KalmanFilter()`` or ``KalmanSmoother(lag=10)``; chosen if absent.
    t : float
        Time of the prior, one step before the first row, s.

    Raises
    ------
    Refused
        If the method cannot work on the model or has no online form.

    Examples
    --------
    >>> import halfwidth as hw
    >>> walk = hw.Linear([[1]], None, [[1]], hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0.0], 1.0))
    >>> live = hw.stream(walk, hw.KalmanFilter())
    >>> float(live.push(1.0).x[0, 0].round(3)), float(live.push(None).x[0, 0].round(3))
    (0.667, 0.667)
    """
    method = _default(model) if method is None else choose(model, method)
    if not math.isfinite(t):
        raise BadValue(f"`t` is {t!r}, a finite time in seconds was expected")
    if hasattr(method, "stream"):
        return Stream(model, method, method.stream(model, float(t)))
    if hasattr(method, "step"):
        return Stream(model, method, _Stepped(model, method, float(t)))
    raise Refused(f"`{typed(method)}` has no online form", hint="KalmanFilter(), or Window(method) for a batch method")


def _default(model: Model) -> Any:
    """Return the first recursive method that takes the model."""
    reasons = []
    defaults: tuple[tuple[str, dict[str, Any]], ...] = (
        ("KalmanFilter", {}), ("Hull", {"memory": 10}), ("ZonotopeFilter", {}), ("UnscentedKalman", {}), ("GPB", {}),
        ("MixedFilter", {}),
    )  # fmt: skip
    for name, settings in defaults:
        method = methods.load(name)(**settings)
        reason = method.refuses(model)
        if reason is None:
            return method
        reasons.append(reason)
    message, hint = hinted(reasons[0])
    if methods.load("Window")(methods.load("Posterior")(), memory=25).refuses(model) is None:
        hint = "stream(model, Window(Posterior(), memory=25))"
    raise Refused(f"no default method runs on a stream of this model; {message}", hint=hint)


def resume(snapshot: bytes, model: Model | None = None) -> Stream:
    """Return a stream as it was when its snapshot was taken.

    Parameters
    ----------
    snapshot : bytes
    model : Linear or Nonlinear, optional
        Needed if the model holds functions or stacked matrices, which no snapshot keeps.

    Raises
    ------
    BadValue
        If the bytes are no snapshot, are damaged, or belong to a model of another size.
    """
    if not isinstance(snapshot, bytes | bytearray | memoryview):
        raise BadValue(f"`snapshot` is a {type(snapshot).__name__}, the bytes of `live.snapshot()` were expected")
    data = bytes(snapshot)
    if len(data) < 24 or data[:8] != _MAGIC:
        raise BadValue(f"`snapshot` of {len(data)} bytes is not one of a stream")
    version = int.from_bytes(data[8:12], "little")
    if version != _VERSION:
        raise BadValue(f"`snapshot` has version {version}, {_VERSION} was expected")
    if zlib.crc32(data[:-4]) != int.from_bytes(data[-4:], "little"):
        raise BadValue("`snapshot` is damaged: its check sum is wrong")
    size = int.from_bytes(data[12:20], "little")
    try:
        head = json.loads(data[20 : 20 + size])
        name, settings = head["method"]
        held, sizes = head["model"], head["sizes"]
    except (ValueError, KeyError, TypeError):
        raise BadValue("`snapshot` is not one of a stream: its head cannot be read") from None
    if name not in methods.ESTIMATORS:
        raise BadValue(f"`snapshot` is of `{name}`, which this version does not have")
    if model is None:
        if held is None:
            raise BadValue("`snapshot` does not hold its model", hint="resume(snapshot, model)")
        model = _model_from_json(held)
    if [model.nx, model.ny, model.nu] != sizes:
        raise BadValue(
            f"`snapshot` is of a model with nx, ny, nu = {sizes}, but `model` has {[model.nx, model.ny, model.nu]}"
        )
    live = stream(model, _method(name, settings))
    try:
        live._core.restore(data[20 + size : -4])
    except ValueError as exc:
        raise BadValue(f"`snapshot` does not fit: {exc}") from exc
    return live


# ---- any recursive method --------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, slots=True)
class _Belief:
    t: float
    x: Array
    P: Array
    loglik: float
    code: int
    rows: int
    message: str | None = None
    within: tuple[Array, Array] | None = None


class _Stepped:
    """A `Recursive` method held at its newest state."""

    def __init__(self, model: Model, method: Any, t: float) -> None:
        self.model, self.method, self.t, self.pushed = model, method, t, 0
        self.state = method.init(model)
        self.kind = type("NewestStep", (Newest,), {"__slots__": (), "method": typed(method), "names": model.names.x})

    def push(self, y: ArrayLike | None, u: ArrayLike | None = None, dt: float | None = None) -> Estimate:
        model = self.model
        row, inputs, step = pushed_row(model, y, u, dt)
        self.state = self.method.step(model, self.state, row, inputs, self.t + step, step)
        self.t += step
        self.pushed += 1
        answer = getattr(self.method, "answer", None)
        if answer is not None:
            return answer(model, self.state, self.t)  # type: ignore[no-any-return]
        x, P, loglik = self.method.belief(model, self.state)
        newest: Estimate = object.__new__(self.kind)
        verdict = getattr(self.method, "verdict", None)
        code, message, within = (0, None, None) if verdict is None else verdict(model, self.state)
        code = code if np.isfinite(x).all() else 3
        object.__setattr__(newest, "_belief", _Belief(self.t, x, P, float(loglik), code, self.pushed, message, within))
        return newest

    def snapshot(self) -> bytes:
        leaves = [base64.b64encode(np.ascontiguousarray(leaf).tobytes()).decode() for leaf in _leaves(self.state)]
        kinds = [np.asarray(leaf).dtype.str + str(np.shape(leaf)) for leaf in _leaves(self.state)]
        return json.dumps({"t": self.t.hex(), "pushed": self.pushed, "kinds": kinds, "leaves": leaves}).encode()

    def restore(self, saved: bytes) -> None:
        found = json.loads(saved)
        now = _leaves(self.state)
        if len(now) != len(found["kinds"]):
            raise ValueError(f"it holds {len(found['kinds'])} numbers or arrays, the method has {len(now)}")
        values = []
        for kind, leaf in zip(found["kinds"], found["leaves"], strict=True):
            dtype, _, shape = kind.partition("(")
            if dtype[1] not in "fiub":
                raise ValueError(f"it holds an array of kind {dtype}")
            sizes = [int(n) for n in shape.rstrip(")").split(",") if n.strip()]
            values.append(np.frombuffer(base64.b64decode(leaf), dtype=dtype).reshape(sizes).copy())
        self.state = _with_leaves(self.state, iter(values))
        self.t, self.pushed = float.fromhex(found["t"]), int(found["pushed"])


def _leaves(state: Any) -> list[Any]:
    """Return the numbers and arrays of a nested state, in order."""
    if dataclasses.is_dataclass(state):
        return [leaf for f in dataclasses.fields(state) for leaf in _leaves(getattr(state, f.name))]
    if isinstance(state, tuple | list):
        return [leaf for part in state for leaf in _leaves(part)]
    if isinstance(state, dict):
        return [leaf for key in sorted(state) for leaf in _leaves(state[key])]
    if isinstance(state, np.ndarray | int | float | np.number | bool):
        return [state]
    if state is None:
        return []
    raise Refused(f"a state that holds a {type(state).__name__} cannot be saved")


def _with_leaves(state: Any, values: Any) -> Any:
    """Return a state of the same structure with other leaves."""
    if dataclasses.is_dataclass(state) and not isinstance(state, type):
        return dataclasses.replace(
            state, **{f.name: _with_leaves(getattr(state, f.name), values) for f in dataclasses.fields(state)}
        )
    if isinstance(state, tuple) and hasattr(state, "_fields"):
        return type(state)(*[_with_leaves(part, values) for part in state])
    if isinstance(state, tuple | list):
        return type(state)([_with_leaves(part, values) for part in state])
    if isinstance(state, dict):
        return {key: _with_leaves(state[key], values) for key in sorted(state)}
    if state is None:
        return None
    value = next(values)
    return value if isinstance(state, np.ndarray) else type(state)(value[()])


# ---- settings and models as plain data -------------------------------------------------------------------------------


def _settings(method: Any) -> dict[str, Any]:
    found = {f.name: getattr(method, f.name) for f in dataclasses.fields(method)}
    for name, value in found.items():
        if isinstance(value, np.integer | np.floating):
            found[name] = value.item()
        elif type(value).__name__ in methods.ESTIMATORS:  # a method inside a method
            found[name] = {"method": [type(value).__name__, _settings(value)]}
        elif value is not None and not isinstance(value, bool | int | float | str):
            raise Refused(
                f"the setting `{name}` of `{typed(method)}` is no plain number or word, so it cannot be saved"
            )
    return found


def _method(name: str, settings: dict[str, Any]) -> Any:
    """Return the method of a snapshot, and the methods inside it."""
    if name not in methods.ESTIMATORS:
        raise BadValue(f"`snapshot` is of `{name}`, which this version does not have")
    found = {k: _method(*v["method"]) if isinstance(v, dict) and "method" in v else v for k, v in settings.items()}
    return methods.load(name)(**found)


def _model_to_json(model: Model) -> dict[str, Any] | None:
    if not isinstance(model, Linear) or not isinstance(model.x0, Normal) or model.loss is not None:
        return None
    gaussian = isinstance(model.w, Gaussian) and isinstance(model.e, Gaussian)
    if not gaussian or not (model.w.known and model.e.known) or model.bounds is not None:
        return None
    varying = {**model.matrices, "Q": model.w.cov(), "R": model.e.cov()}
    if not all(m.constant for m in varying.values()):
        return None
    plain: dict[str, Any] = {name: m.single.tolist() for name, m in varying.items()}
    shapes = {name: list(m.shape) for name, m in varying.items()}
    return plain | {
        "shapes": shapes,
        "x0": [model.x0.mean.tolist(), model.x0.P.tolist()],
        "dt": model.dt,
        "names": model.names._asdict(),
    }


def _model_from_json(plain: dict[str, Any]) -> Linear:
    found = {name: np.array(plain[name], dtype=float).reshape(shape) for name, shape in plain["shapes"].items()}
    return Linear(
        found["A"],
        found.get("B"),
        found["C"],
        Gaussian(found["Q"]),
        Gaussian(found["R"]),
        Normal(*plain["x0"]),
        E=found.get("E"),
        F=found.get("F"),
        dt=plain["dt"],
        names=plain["names"],
    )
