"""What can go wrong with an input, as exceptions; what can go wrong with the numbers is a `Status`.

::

    HalfwidthError
    ├── BadShape     an array has the wrong shape                      (also a ValueError)
    ├── BadValue     a number or an argument is out of its domain      (also a ValueError)
    ├── BadRecord    times, outputs or inputs cannot be used           (also a ValueError)
    ├── BadLog       a vehicle's log cannot be read                    (also a ValueError)
    │   └── LogTooBig    it passes a limit of the reader
    ├── Refused      this method cannot work on this model             (also a TypeError)
    ├── Missing      an optional library is not installed              (also an ImportError)
    └── Unsolved     `Estimate.check()` met a status that is not good  (also a RuntimeError)

Every message says what was given and what was expected; `hint` is the next thing to type.
"""


class HalfwidthError(Exception):
    """Root of all exceptions of the library.

    Parameters
    ----------
    message : str
        What was given, by name and value, and what was expected.
    hint : str, optional
        The next thing to type.
    """

    def __init__(self, message: str, *, hint: str | None = None) -> None:
        super().__init__(message if hint is None else f"{message}\nhint: {hint}")
        self.message = message
        self.hint = hint

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (type(self), self.message, self.hint)


def _rebuild(kind: type[HalfwidthError], message: str, hint: str | None) -> HalfwidthError:
    return kind(message, hint=hint)


class BadShape(HalfwidthError, ValueError):
    """An array has the wrong shape."""


class BadValue(HalfwidthError, ValueError):
    """A number or an argument is out of its domain."""


class BadRecord(HalfwidthError, ValueError):
    """Times, outputs or inputs cannot be used."""


class BadLog(HalfwidthError, ValueError):
    """A vehicle's log cannot be read."""


class LogTooBig(BadLog):
    """A vehicle's log passes a limit of the reader."""


class Refused(HalfwidthError, TypeError):
    """A method cannot work on a model."""


class Missing(HalfwidthError, ImportError):
    """An optional library is not installed."""


class Unsolved(HalfwidthError, RuntimeError):
    """The estimate's status is not good."""


class DataQualityWarning(UserWarning):
    """The data can be used, but probably not as meant."""


def hinted(reason: str) -> tuple[str, str | None]:
    r"""Split ``"reason\\nhint: ..."`` into the reason and the hint."""
    head, _, hint = reason.partition("\nhint: ")
    return head, hint or None
