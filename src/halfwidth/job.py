"""One job as plain data, and the one way to run it.

A job names its log or table, its model and its method; everything in it can be written as TOML or
JSON, so a job is its own log line and its own bug report. `run` reads what the job names and gives
the answer; it writes nothing. The command line, and later the live stream and the fleet, are thin
skins around it.

A model as plain data has the keys of `hw.Linear`::

    time = "t"                       # column names of the table
    outputs = ["position"]
    inputs = ["acceleration"]
    states = ["position", "speed"]   # names of the answer's columns
    dt = 0.1                         # step before the first row, s; from the times if absent
    A = [[1, 0.1], [0, 1]]
    B = [[0.005], [0.1]]
    C = [[1, 0]]
    w = { gaussian = [1e-4, 1e-3] }  # or uniform = [...], or both, or at_least/at_most = [...]; unknown: gaussian = {}
    e = { uniform = 0.5 }
    x0 = { mean = [0, 0], covariance = [[1, 0], [0, 1]] }   # or { lo = [...], hi = [...] }
    bounds = { lo = [...], hi = [...] }                     # of every state, or of D x with D = [[...]]; optional
    E = [[...]]                      # optional, unit upper triangular, as is F
    theta_bounds = { lo = [...], hi = [...] }               # of the nan entries of A, B, C
"""

import difflib
import inspect
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from halfwidth import methods
from halfwidth.errors import BadValue, HalfwidthError

if TYPE_CHECKING:
    from halfwidth.model import Linear
    from halfwidth.noise import Noise
    from halfwidth.result import Estimate
    from halfwidth.spread import Box, Halfspaces, Normal
    from halfwidth.vehicle.track import Track

_MODEL_KEYS = (
    "A", "B", "C", "E", "F", "w", "e", "x0", "bounds", "theta_bounds", "dt",
    "time", "outputs", "inputs", "states",
)  # fmt: skip
_NOISE_KEYS = ("gaussian", "uniform", "at_least", "at_most")


@dataclass(frozen=True)
class Job:
    """What to estimate, from what, and how; plain data throughout.

    Parameters
    ----------
    task : {"fill", "estimate"}
        A vehicle's log to be filled, or a table and a linear model.
    record : str
        Path of the log or table; ``"-"`` is standard input.
    model : mapping, optional
        The model as plain data, for ``"estimate"``.
    method : str, optional
        Name of the method; the default of the task if absent.
    settings : mapping
        Settings of the method (``"estimate"``), or ``clock_offset`` in seconds (``"fill"``).
    columns : mapping of str to str
        Which column of a log is which, where names are not recognised.
    level : float
        Probability of the intervals.
    seed : int, optional
        Seed of a method that draws random numbers.

    Raises
    ------
    BadValue
        If the task is unknown, the level no probability, or the model absent or superfluous.
    """

    task: str
    record: str
    model: Mapping[str, Any] | None = None
    method: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    columns: Mapping[str, str] = field(default_factory=dict)
    level: float = 0.9
    seed: int | None = None

    def __post_init__(self) -> None:
        if self.task not in ("fill", "estimate"):
            raise BadValue(f'`task` is {self.task!r}, "fill" or "estimate" is expected')
        if not 0 < self.level < 1:
            raise BadValue(f"`level` is {self.level}, a probability between 0 and 1 is expected", hint="0.9")
        if (self.model is None) == (self.task == "estimate"):
            raise BadValue(f"a job to {self.task} {'needs a' if self.model is None else 'takes no'} `model`")

    def to_dict(self) -> dict[str, Any]:
        """Give the job as plain data."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "Job":
        """Make a job of plain data.

        Raises
        ------
        BadValue
            If a key is unknown.
        """
        _known(data, tuple(cls.__dataclass_fields__), "the job")
        return cls(**data)


def run(job: Job) -> "Track | Estimate":
    """Run a job.

    Parameters
    ----------
    job : Job

    Returns
    -------
    Track
        For ``"fill"``.
    Estimate
        For ``"estimate"``.

    Raises
    ------
    HalfwidthError
        If the record cannot be read, the model is wrong, or the method refuses it.
    """
    if job.task == "fill":
        from halfwidth.vehicle import fill, read

        log = read(job.record, columns=job.columns or None)
        track: Track = fill(log, method=job.method, level=job.level, **job.settings)
        return track
    return _estimate(job)


def _estimate(job: Job) -> "Estimate":
    from halfwidth.estimate import estimate
    from halfwidth.record import Record
    from halfwidth.vehicle.formats import read_columns

    assert job.model is not None
    linear(job.model)  # a wrong model is told before a long table is read
    outputs, inputs = (list(_names(job.model, key)) for key in ("outputs", "inputs"))
    time = job.model.get("time", "t")
    t, columns = read_columns(job.record, time, [*outputs, *inputs])
    import numpy as np

    dt = float(np.median(np.diff(t))) if t.size > 1 else 1.0
    model = linear({"dt": dt, **job.model})
    y = np.column_stack([columns[name] for name in outputs])
    u = np.column_stack([columns[name] for name in inputs]) if inputs else None
    return estimate(model, Record(t, y, u), method(job.method, job.settings), seed=job.seed)


def method(name: str | None, settings: Mapping[str, Any]) -> Any:
    """Make an estimator of its name and settings; None for the default.

    Raises
    ------
    BadValue
        If there is no such estimator or setting.
    """
    if name is None:
        if settings:
            raise BadValue(f"`settings` are {dict(settings)} but no `method` is named")
        return None
    if name not in methods.ESTIMATORS:
        near = difflib.get_close_matches(name, methods.ESTIMATORS, n=1)
        raise BadValue(
            f"`method` is {name!r}, one of {', '.join(methods.ESTIMATORS) or 'none installed'} is expected",
            hint=near[0] if near else None,
        )
    kind = methods.load(name)
    _known(settings, tuple(inspect.signature(kind).parameters), f"the settings of {name}")
    return kind(**settings)


def linear(data: Mapping[str, Any]) -> "Linear":
    """Make a linear model of plain data; see the head of this module for the keys.

    Raises
    ------
    BadValue, BadShape
        With the key at fault.
    """
    from halfwidth.model import Linear

    _known(data, _MODEL_KEYS, "the model")
    for key in ("A", "C", "w", "e", "outputs"):
        if key not in data:
            raise BadValue(f"the model has no key `{key}`", hint=_EXAMPLES[key])
    outputs, inputs = _names(data, "outputs"), _names(data, "inputs")
    if bool(inputs) != ("B" in data):
        lacking, given = ("B", "inputs") if inputs else ("inputs", "B")
        raise BadValue(f"the model has the key `{given}` but not `{lacking}`", hint=_EXAMPLES[lacking])
    n_states = len(data["A"]) if isinstance(data["A"], list) else 0
    states = _names(data, "states") or tuple(f"x{k}" for k in range(n_states))
    return Linear(
        _matrix(data, "A"),
        _matrix(data, "B") if "B" in data else None,
        _matrix(data, "C"),
        _noise(data, "w"),
        _noise(data, "e"),
        _prior(data, "x0"),
        E=_matrix(data, "E") if "E" in data else None,
        F=_matrix(data, "F") if "F" in data else None,
        bounds=_bounds(data),
        names={"x": states, "y": outputs, "u": inputs},
        dt=_number(data, "dt", 1.0),
        theta_bounds=_box(data, "theta_bounds"),
    )


_EXAMPLES = {
    "A": "A = [[1, 0.1], [0, 1]]",
    "B": "B = [[0.005], [0.1]]",
    "C": "C = [[1, 0]]",
    "w": "w = { gaussian = [1e-4, 1e-3] }",
    "e": "e = { uniform = 0.5 }",
    "outputs": 'outputs = ["position"]',
    "inputs": 'inputs = ["acceleration"]',
}


def _known(data: Mapping[str, Any], keys: tuple[str, ...], where: str) -> None:
    for key in data:
        if key not in keys:
            near = difflib.get_close_matches(key, keys, n=1)
            raise BadValue(
                f"{where} has the unknown key `{key}`, one of {', '.join(keys)} is expected",
                hint=f"`{near[0]}`" if near else None,
            )


def _names(data: Mapping[str, Any], key: str) -> tuple[str, ...]:
    value = data.get(key, [])
    if not isinstance(value, list | tuple) or not all(isinstance(name, str) for name in value):
        raise BadValue(f"the key `{key}` is {value!r}, a list of names is expected")
    return tuple(value)


def _number(data: Mapping[str, Any], key: str, default: float) -> float:
    value = data.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadValue(f"the key `{key}` is {value!r}, a number is expected")
    return float(value)


def _matrix(data: Mapping[str, Any], key: str) -> Any:
    import numpy as np

    rows = data[key]
    flat = rows if isinstance(rows, list) else [rows]
    good = bool(flat) and all(isinstance(row, list) and len(row) == len(flat[0]) for row in flat)
    if not good or not all(_is_number(value) for row in flat for value in row):
        raise BadValue(f"the key `{key}` is {_short(rows)}, a list of rows of numbers is expected")
    return np.array(rows, dtype=np.float64)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:59] + "…"


def _table(data: Mapping[str, Any], key: str, keys: tuple[str, ...]) -> Mapping[str, Any]:
    value = data[key]
    if not isinstance(value, Mapping):
        raise BadValue(
            f"the key `{key}` is {_short(value)}, a table with {' or '.join(keys)} is expected",
            hint=f"{key} = {{ {keys[0]} = ... }}",
        )
    _known(value, keys, f"the key `{key}`")
    return value


def _noise(data: Mapping[str, Any], key: str) -> "Noise":
    from halfwidth.noise import Gaussian, Uniform

    table = _table(data, key, _NOISE_KEYS)
    parts: list[Any] = []
    with _at(key):
        if "uniform" in table:
            parts.append(Uniform(table["uniform"]))
        if "at_least" in table or "at_most" in table:
            if parts:
                raise BadValue("`uniform` and `at_least`, `at_most` are both given, one is expected")
            parts.append(Uniform.unknown(table.get("at_least", 0.0), table.get("at_most", float("inf"))))
        if "gaussian" in table:
            own = table["gaussian"]
            if isinstance(own, Mapping):
                ends = _table(table, "gaussian", ("at_least", "at_most"))
                parts.append(Gaussian.unknown(ends.get("at_least", 0.0), ends.get("at_most", float("inf"))))
            else:
                parts.append(Gaussian(own))
        if not parts:
            raise BadValue(f"the table is empty, one of {', '.join(_NOISE_KEYS)} is expected")
        noise: Noise = parts[0] if len(parts) == 1 else parts[0] + parts[1]
    return noise


def _prior(data: Mapping[str, Any], key: str) -> "Normal | Box | None":
    from halfwidth.spread import Box, Normal

    if key not in data:
        return None
    table = _table(data, key, ("mean", "covariance", "lo", "hi"))
    with _at(key):
        if {"mean", "covariance"} == set(table):
            return Normal(table["mean"], table["covariance"])
        if {"lo", "hi"} == set(table):
            return Box(table["lo"], table["hi"])
        raise BadValue(f"it has {', '.join(table) or 'nothing'}, mean and covariance or lo and hi are expected")


def _bounds(data: Mapping[str, Any]) -> "tuple[Any, Any] | Halfspaces | None":
    """Return a box, or half-spaces where the table has a D."""
    from halfwidth.spread import Halfspaces

    given = data.get("bounds")
    if not isinstance(given, Mapping) or "D" not in given:
        return _box(data, "bounds")
    table = _table(data, "bounds", ("D", "lo", "hi"))
    with _at("bounds"):
        return Halfspaces(**table)


def _box(data: Mapping[str, Any], key: str) -> "tuple[Any, Any] | None":
    if key not in data:
        return None
    table = _table(data, key, ("lo", "hi"))
    with _at(key):
        if {"lo", "hi"} != set(table):
            raise BadValue(f"it has {', '.join(table) or 'nothing'}, lo and hi are expected")
    return table["lo"], table["hi"]


class _at:  # noqa: N801 - reads as a word: with _at("w")
    """Say which key an error comes from."""

    def __init__(self, key: str) -> None:
        self.key = key

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, HalfwidthError):
            raise type(error)(f"the key `{self.key}`: {error.message}", hint=error.hint) from error
