"""What is handed to a function in place of numbers, so that every operation with them is recorded.

Entries (`_Variable`) stand in object arrays (`_Array`); NumPy hands element-wise functions, products and sums through
to them. A branch on an entry is answered as the `Recorder` is told, so that the function can be called once for each
way; what would turn an entry into a plain number ends the recording.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np

from halfwidth.tape import Tape, Untraceable

_TURNED = (
    "a traced value was turned into a plain number; write `np.sin` rather than `math.sin`, and build arrays with "
    "`np.array([...])` or `np.zeros_like(x)` rather than filling a float array"
)
#: What is said of a function with more branches than are followed.
BRANCHED = "it branches on values in too many ways; a loop with a fixed number of rounds can be traced"

#: Branches on one way through a function.
_BRANCHES = 24


@cache
def _codes() -> dict[str, int]:
    from halfwidth._core import tape_operations

    return {name: code for code, (name, _) in enumerate(tape_operations())}


# What NumPy's functions are called on the tape, where the name is another one.
_NAMES = {
    "abs": "absolute", "fabs": "absolute", "acos": "arccos", "acosh": "arccosh", "asin": "arcsin",
    "asinh": "arcsinh", "atan": "arctan", "atan2": "arctan2", "atanh": "arctanh", "pow": "power",
    "true_divide": "divide", "mod": "remainder", "fmax": "maximum", "fmin": "minimum",
}  # fmt: skip
_TWO = {
    "add", "subtract", "multiply", "divide", "power", "arctan2", "hypot", "maximum", "minimum", "remainder", "fmod",
    "floor_divide", "less", "less_equal", "equal", "not_equal",
}  # fmt: skip
_COMMUTING = frozenset({"add", "multiply", "hypot", "equal", "not_equal"})
_SPLIT: dict[str, Callable[..., Any]] = {
    "positive": lambda a: a,
    "conjugate": lambda a: a,
    "deg2rad": lambda a: a * (np.pi / 180.0),
    "radians": lambda a: a * (np.pi / 180.0),
    "rad2deg": lambda a: a * (180.0 / np.pi),
    "degrees": lambda a: a * (180.0 / np.pi),
    "greater": lambda a, b: b < a,
    "greater_equal": lambda a, b: b <= a,
    "isnan": lambda a: a != a,
    "isfinite": lambda a: (a - a) == 0,
    "logical_and": lambda a, b: (a != 0) * (b != 0),
    "logical_or": lambda a, b: ((a != 0) + (b != 0)) != 0,
    "logical_xor": lambda a, b: (a != 0) != (b != 0),
    "logical_not": lambda a: a == 0,
    "logaddexp": lambda a, b: np.maximum(a, b) + np.log1p(np.exp(-abs(a - b))),
    "bitwise_and": lambda a, b: a & b,
    "bitwise_or": lambda a, b: a | b,
    "bitwise_xor": lambda a, b: a ^ b,
    "invert": lambda a: ~a,
}


class Recorder:
    """The steps recorded so far; equal steps share one slot."""

    def __init__(self) -> None:
        self.steps: list[tuple[str, tuple[int, ...], float]] = []
        self.known: dict[tuple[str, tuple[int, ...], float, float], int] = {}
        self.way: list[tuple[int, bool]] = []
        self.taken: list[tuple[int, bool]] = []

    def follow(self, way: list[tuple[int, bool]]) -> None:
        """Start a call that decides its first conditions as `way` says."""
        self.way, self.taken = way, []

    def decide(self, slot: int) -> bool:
        """Answer a branch: the way to follow, true beyond it, and the same again for the same condition."""
        number = self.value(slot)
        if number is not None:
            return number != 0.0
        for condition, decision in self.taken:
            if condition == slot:
                return decision
        k = len(self.taken)
        if k >= _BRANCHES:
            raise Untraceable(BRANCHED)
        decision = True
        if k < len(self.way):
            condition, decision = self.way[k]
            if condition != slot:
                raise Untraceable("it does not do the same twice")
        self.taken.append((slot, decision))
        return decision

    def chosen(self, condition: int, a: int, b: int) -> int:
        """Return the slot of a choice."""
        return a if a == b else self.step("where", condition, a, b).slot

    def step(self, name: str, *arguments: int, value: float = 0.0) -> "_Variable":
        """Return the entry of a step, the same one for the same step."""
        # The sign belongs to the key: 0.0 == -0.0, but 1 / x tells them apart.
        key = (name, arguments, value, float(np.copysign(1.0, value)))
        slot = self.known.get(key)
        if slot is None:
            slot = self.known[key] = len(self.steps)
            self.steps.append((name, arguments, value))
        return _Variable(self, slot, boolean=name in _BOOLEAN)

    def slot(self, a: Any) -> int:
        """Slot of a variable, or of a constant."""
        if isinstance(a, _Variable):
            if a.record is not self:
                raise Untraceable("it keeps a value from another call")
            return a.slot
        if isinstance(a, np.ndarray) and a.ndim == 0:
            return self.slot(a[()])
        if isinstance(a, bool | int | float | np.bool_ | np.integer | np.floating):
            value = float(a)
            if value != value:
                raise Untraceable("it computes with NaN")
            return self.step("constant", value=value).slot
        raise Untraceable(f"it computes with a {type(a).__name__}")

    def value(self, slot: int) -> float | None:
        """Return the number in a slot if it is a constant."""
        name, _, value = self.steps[slot]
        return value if name == "constant" else None

    def apply(self, name: str, *given: Any) -> "_Variable":
        """Return the entry of an operation, simplified where its arguments allow it."""
        arguments = tuple(self.slot(a) for a in given)
        numbers = [self.value(a) for a in arguments]
        if all(n is not None for n in numbers):
            return self.step("constant", value=_folded(name, numbers))
        simpler = self._simpler(name, arguments, numbers)
        if simpler is not None:
            return simpler
        if name in _COMMUTING:
            arguments = tuple(sorted(arguments))
        return self.step(name, *arguments)

    def _simpler(self, name: str, arguments: tuple[int, ...], numbers: list[float | None]) -> "_Variable | None":
        """Neutral and zero factors, and small powers: what products with sparse matrices leave behind."""

        def here(slot: int) -> _Variable:
            return _Variable(self, slot)

        match name:
            case "add" if numbers[0] == 0.0:
                return here(arguments[1])
            case "add" | "subtract" if numbers[1] == 0.0:
                return here(arguments[0])
            case "multiply" if 0.0 in numbers:
                return self.step("constant", value=0.0)
            case "multiply" if numbers[0] == 1.0:
                return here(arguments[1])
            case "multiply" | "divide" if numbers[1] == 1.0:
                return here(arguments[0])
            case "multiply" if arguments[0] == arguments[1]:
                return self.step("square", arguments[0])
            case "subtract" if numbers[0] == 0.0:
                return self.step("negative", arguments[1])
            case "power" if numbers[1] == 1.0:
                return here(arguments[0])
            case "power" if numbers[1] == 2.0:
                return self.step("square", arguments[0])
            case "power" if numbers[1] == 3.0:
                return self.apply("multiply", self.step("square", arguments[0]), here(arguments[0]))
            case "power" if numbers[1] == 0.5:
                return self.step("sqrt", arguments[0])
            case "power" if numbers[1] == -1.0:
                return self.step("reciprocal", arguments[0])
        return None

    def tape(self, slots: list[int], sizes: tuple[int, ...]) -> Tape:
        """Keep the steps the answer needs, renumbered."""
        needed: set[int] = set()
        waiting = list(slots)
        while waiting:
            slot = waiting.pop()
            if slot not in needed:
                needed.add(slot)
                name, arguments, _ = self.steps[slot]
                if name != "input":
                    waiting.extend(arguments)
        order = {slot: k for k, slot in enumerate(sorted(needed))}
        code = np.zeros((len(order), 4), dtype=np.int32)
        constant = np.zeros(len(order))
        for slot, k in order.items():
            name, arguments, value = self.steps[slot]
            code[k, 0] = _codes()[name]
            for i, a in enumerate(arguments, start=1):
                code[k, i] = a if name == "input" else order[a]
            constant[k] = value
        return Tape(code, constant, np.array([order[s] for s in slots], dtype=np.int32), sizes)


_BOOLEAN = frozenset({"less", "less_equal", "equal", "not_equal"})


def _folded(name: str, numbers: list[Any]) -> float:
    """Value of an operation on constants."""
    f = np.where if name == "where" else getattr(np, name)
    with np.errstate(all="ignore"):
        value = float(f(*numbers))
    if value != value:
        raise Untraceable("it computes with NaN")
    return value


def entries(variables: Sequence["_Variable"]) -> "_Array":
    """Return entries as an array that records."""
    array = np.empty(len(variables), dtype=object)
    array[:] = variables
    return array.view(_Array)


def _plain(a: Any) -> Any:
    """Without our types around it, so that NumPy's own object loops run."""
    if isinstance(a, _Variable):
        box = np.empty((), dtype=object)
        box[()] = a
        return box
    if isinstance(a, _Array):
        return a.view(np.ndarray)
    if isinstance(a, tuple | list):
        return type(a)(_plain(b) for b in a)
    return a


def _ours(a: Any) -> Any:
    if isinstance(a, np.ndarray) and a.dtype == object:
        return a.view(_Array) if a.ndim else a[()]
    if isinstance(a, tuple):
        return tuple(_ours(b) for b in a)
    return a


def _elementwise(name: str, inputs: Sequence[Any]) -> Any:
    """One ufunc, entry by entry, where an entry may be a variable or a number."""

    def one(*entries: Any) -> Any:
        for a in entries:
            if isinstance(a, _Variable):
                return a.record.apply(name, *entries)
        return getattr(np, name)(*entries)

    f = _SPLIT.get(name, one)
    return _ours(np.frompyfunc(f, len(inputs), 1)(*(_plain(a) for a in inputs)))


def _ufunc(ufunc: np.ufunc, method: str, inputs: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    name = _NAMES.get(ufunc.__name__, ufunc.__name__)
    out = kwargs.pop("out", None)
    if method == "__call__" and not kwargs and (name in _codes() or name in _SPLIT):
        result = _elementwise(name, inputs)
    elif name in _TWO | {"logical_and", "logical_or"} and method in {"reduce", "accumulate"}:
        # NumPy's own object loops of these compare and branch; ours do not.
        step = np.frompyfunc(lambda a, b: _elementwise(name, (a, b)), 2, 1)
        kwargs.pop("dtype", None)
        result = _ours(getattr(step, method)(*(_plain(a) for a in inputs), **kwargs))
    else:
        result = _ours(getattr(ufunc, method)(*(_plain(a) for a in inputs), **kwargs))
    if out is None:
        return result
    if not isinstance(out[0], _Array):
        raise Untraceable(_TURNED)
    out[0][...] = result
    return out[0]


def _where(condition: Any, *values: Any) -> Any:
    if len(values) != 2:
        return np.where(_plain(condition), *values)

    def one(c: Any, a: Any, b: Any) -> Any:
        if not isinstance(c, _Variable):
            return a if c else b
        return c.record.apply("where", c, a, b)

    return _ours(np.frompyfunc(one, 3, 1)(*(_plain(a) for a in (condition, *values))))


def _clip(a: Any, a_min: Any = None, a_max: Any = None, **named: Any) -> Any:
    low, high = named.pop("min", a_min), named.pop("max", a_max)
    if named:
        raise Untraceable("`np.clip` with " + ", ".join(named))
    if low is not None:
        a = _elementwise("maximum", (a, low))
    return a if high is None else _elementwise("minimum", (a, high))


def _function(f: Callable[..., Any], args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    if f is np.where:
        return _where(*args, **kwargs)
    if f is np.clip:
        return _clip(*args, **kwargs)
    if f in {np.max, np.amax, np.min, np.amin} and not kwargs.keys() - {"axis"}:
        step = np.maximum if f in {np.max, np.amax} else np.minimum
        axis = kwargs.get("axis", args[1] if len(args) > 1 else None)
        return _ufunc(step, "reduce", (_ours(_plain(args[0])),), {"axis": axis})
    plain = [_plain(a) for a in args]
    return _ours(f(*plain, **{k: _plain(a) for k, a in kwargs.items()}))


class _Array(np.ndarray):
    """An object array whose comparisons and choices are recorded, not decided."""

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        return _ufunc(ufunc, method, inputs, kwargs)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return _function(func, args, kwargs)

    def max(self, axis: Any = None, **kwargs: Any) -> Any:  # type: ignore[override]
        return _ufunc(np.maximum, "reduce", (self,), {"axis": axis, **kwargs})

    def min(self, axis: Any = None, **kwargs: Any) -> Any:  # type: ignore[override]
        return _ufunc(np.minimum, "reduce", (self,), {"axis": axis, **kwargs})

    def clip(self, a_min: Any = None, a_max: Any = None, **kwargs: Any) -> Any:  # type: ignore[override]
        return _clip(self, a_min, a_max, **kwargs)


class _Variable:
    """One number of the function being recorded."""

    __slots__ = ("boolean", "record", "slot")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, record: Recorder, slot: int, *, boolean: bool = False) -> None:
        self.record = record
        self.slot = slot
        self.boolean = boolean

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        return _ufunc(ufunc, method, inputs, kwargs)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return _function(func, args, kwargs)

    def __repr__(self) -> str:
        return f"<traced value {self.slot}>"

    # What would lose the value ends the trace; what asks it for a decision is called again for the other.
    def __bool__(self) -> bool:
        return self.record.decide(self.slot)

    def __float__(self) -> float:
        raise Untraceable(_TURNED)

    def __int__(self) -> int:
        raise Untraceable(_TURNED)

    def __index__(self) -> int:
        raise Untraceable(_TURNED)

    def __complex__(self) -> complex:
        raise Untraceable(_TURNED)

    def __invert__(self) -> Any:
        self._logical()
        return self.record.apply("equal", self, 0.0)

    def _logical(self, other: Any = True) -> None:
        # `&`, `|` and `~` of numbers are bit operations, which a tape has not.
        for a in (self, other):
            if not (a.boolean if isinstance(a, _Variable) else isinstance(a, bool | np.bool_)):
                raise Untraceable("it computes with the bits of a number")

    def __and__(self, other: Any) -> Any:
        self._logical(other)
        return _flag(self * other)

    def __or__(self, other: Any) -> Any:
        self._logical(other)
        return (self + other) != 0

    def __xor__(self, other: Any) -> Any:
        self._logical(other)
        return self != other

    __rand__ = __and__
    __ror__ = __or__
    __rxor__ = __xor__

    # Numbers and arrays as NumPy hands them over.
    def item(self) -> "_Variable":
        return self

    @property
    def shape(self) -> tuple[int, ...]:
        return ()

    @property
    def ndim(self) -> int:
        return 0

    @property
    def real(self) -> "_Variable":
        return self

    @property
    def T(self) -> "_Variable":
        return self


def _flag(a: _Variable) -> _Variable:
    return _Variable(a.record, a.slot, boolean=True)


def _operator(name: str, *, swapped: bool = False) -> Callable[[Any, Any], Any]:
    def operate(self: Any, other: Any) -> Any:
        if isinstance(other, np.ndarray) and other.ndim:
            return _elementwise(name, (other, self) if swapped else (self, other))
        try:
            pair = (other, self) if swapped else (self, other)
            if name in _SPLIT:
                return _SPLIT[name](*pair)
            return self.record.apply(name, *pair)
        except Untraceable:
            if isinstance(other, list | tuple):
                return _elementwise(name, (np.asarray(other), self) if swapped else (self, np.asarray(other)))
            raise

    return operate


def _unary(name: str) -> Callable[[Any], Any]:
    def operate(self: Any) -> Any:
        return _SPLIT[name](self) if name in _SPLIT else self.record.apply(name, self)

    return operate


for _symbol, _name in {
    "add": "add", "sub": "subtract", "mul": "multiply", "truediv": "divide", "floordiv": "floor_divide",
    "mod": "remainder", "pow": "power",
}.items():  # fmt: skip
    setattr(_Variable, f"__{_symbol}__", _operator(_name))
    setattr(_Variable, f"__r{_symbol}__", _operator(_name, swapped=True))
for _symbol, _name in {"lt": "less", "le": "less_equal", "eq": "equal", "ne": "not_equal"}.items():
    setattr(_Variable, f"__{_symbol}__", _operator(_name))
for _symbol, _name in {"gt": "less", "ge": "less_equal"}.items():
    setattr(_Variable, f"__{_symbol}__", _operator(_name, swapped=True))
for _symbol, _name in {"neg": "negative", "abs": "absolute", "pos": "positive", "floor": "floor", "ceil": "ceil",
                       "trunc": "trunc"}.items():  # fmt: skip
    setattr(_Variable, f"__{_symbol}__", _unary(_name))
# NumPy's object loops call methods of the entries by the name of the function.
_METHODS = (
    "sqrt", "cbrt", "square", "reciprocal", "sign", "exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "sin",
    "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh", "tanh", "arcsinh", "arccosh", "arctanh", "rint",
    "deg2rad", "rad2deg", "radians", "degrees", "conjugate",
)  # fmt: skip
for _name in _METHODS:
    setattr(_Variable, _name, _unary(_name))
for _name in ("arctan2", "hypot", "fmod"):
    setattr(_Variable, _name, _operator(_name))
