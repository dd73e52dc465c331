"""The entry point of the command line: runs a command and turns whatever happens into an exit code.

Data go to standard output, words to standard error. Exit codes: 0 good; 1 internal error; 2 usage;
3 bad input; 4 no estimate; 6 a resource limit; 130 interrupted; 143 terminated.
"""

import errno
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from halfwidth.errors import BadRecord, BadShape, BadValue, HalfwidthError, LogTooBig, Missing, Refused, Unsolved

GOOD, INTERNAL, USAGE, BAD_INPUT, NO_ESTIMATE, LIMIT, INTERRUPTED = 0, 1, 2, 3, 4, 6, 130

#: What the system says when there is no room left.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class ReaderGone(Exception):
    """Whoever read our output has seen enough."""


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line and end the process with its exit code."""
    sys.exit(run(sys.argv[1:] if args is None else list(args)))


def run(args: Sequence[str]) -> int:
    """Run the command line.

    Parameters
    ----------
    args : sequence of str
        Arguments without the program's name.

    Returns
    -------
    int
        The exit code.
    """
    try:
        from halfwidth.shells.commands import call
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("typer", "click"):
            raise
        _say("the command line needs typer, which is not installed\nhint: pip install 'halfwidth[app]'")
        return USAGE
    if sys.stdout is None:  # closed by whoever started us: what nobody wants goes nowhere
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - as long as the process
    before: Any = None
    with suppress(ValueError):  # not the main thread: leave signals to whoever owns them
        # so that temporary files are cleared away when asked to stop
        before = signal.signal(signal.SIGTERM, _terminate)
    try:
        code = call(list(args))
        sys.stdout.flush()
    except (ReaderGone, BrokenPipeError):
        _silence()
        return GOOD
    except KeyboardInterrupt:
        _say("interrupted")
        return INTERRUPTED
    except MemoryError:
        _say("out of memory\nhint: give a shorter log")
        return LIMIT
    except HalfwidthError as error:
        _say(f"{type(error).__name__}: {error}")
        return code_of(error)
    except OSError as error:
        return _system(error, args)
    except Exception as error:
        return _internal(error, args)
    finally:
        if before is not None:
            signal.signal(signal.SIGTERM, before)
    return code


def code_of(error: HalfwidthError) -> int:
    """Give the exit code of an exception of the library."""
    if isinstance(error, LogTooBig):
        return LIMIT
    if isinstance(error, Unsolved):
        return NO_ESTIMATE
    if isinstance(error, Missing | Refused):
        return USAGE
    if isinstance(error, BadValue) and getattr(error, "usage", False):
        return USAGE
    if isinstance(error, BadShape | BadValue | BadRecord):
        return BAD_INPUT
    return BAD_INPUT


def _system(error: OSError, args: Sequence[str]) -> int:
    """Tell a full disk and an impossible path from a fault of ours."""
    where = f"`{error.filename}` " if error.filename else "the output "
    reason = (error.strerror or str(error)).lower()
    if error.filename is None:
        _silence()
    if error.errno in _FULL:
        _say(f"{where}cannot be written: {reason}; what was there before is still there")
        return LIMIT
    if error.filename is not None:
        _say(f"{where}cannot be written: {reason}\nhint: give another path")
        return USAGE
    return _internal(error, args)


def _internal(error: BaseException, args: Sequence[str]) -> int:
    if {"-v", "--verbose"} & set(args):
        import traceback

        traceback.print_exception(error, file=sys.stderr)
    words = " ".join(str(error).split())[:200]
    _say(f"internal error: {type(error).__name__}: {words}\nhint: -v shows where, please report it")
    return INTERNAL


def _say(words: str) -> None:
    """Print to standard error; a closed one is no reason to fail."""
    try:
        print(words, file=sys.stderr, flush=True)
    except (OSError, ValueError):
        return


def _silence() -> None:
    """Let nothing more reach a standard output that takes nothing, not even at exit."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _terminate(_number: int, _frame: Any) -> None:
    raise SystemExit(143)


if __name__ == "__main__":
    main()
