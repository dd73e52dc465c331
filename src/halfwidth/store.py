"""Files that are either the old one or the new one, never part of one.

`atomic_write` collects what is written in a temporary file beside the target, forces it to the disk
and renames it over the target in one step; whatever fails or is killed before the rename leaves the
target as it was. A temporary file carries a lock for as long as its writer lives, which the system
drops when the writer dies in whatever way, so the next run can tell a dead run's temporary files
from a living one's and removes only those. What is not a regular file (standard output, a pipe, a
device) cannot be renamed over: there the content is collected in memory and handed over only once
it is complete.
"""

import errno
import fcntl
import io
import os
import secrets
import stat
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import lru_cache
from typing import IO, Any, BinaryIO, Literal, TextIO, overload

_PREFIX, _SUFFIX = ".halfwidth-", ".tmp"

#: What a file system says that cannot force a folder to the disk, or needs no such thing.
_NO_FOLDER_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EACCES, errno.EPERM)


@overload
def atomic_write(path: "str | os.PathLike[str]", mode: Literal["wb"] = "wb") -> AbstractContextManager[BinaryIO]: ...
@overload
def atomic_write(path: "str | os.PathLike[str]", mode: Literal["w"]) -> AbstractContextManager[TextIO]: ...
def atomic_write(path: "str | os.PathLike[str]", mode: str = "wb") -> Any:
    """Open a file that appears under its name only when it is complete.

    Parameters
    ----------
    path : str or path
        The file to write; ``-`` is standard output. A symbolic link is followed. An existing file
        keeps its permissions.
    mode : {"wb", "w"}
        Bytes, or text in UTF-8 with line ends as written.

    Returns
    -------
    context manager
        Gives the open file. Leaving the block replaces the target; an exception in it leaves the
        target as it was.

    Raises
    ------
    ValueError
        If `mode` is neither of the two.
    OSError
        If anything cannot be written; its ``filename`` is `path`.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> target = pathlib.Path(tempfile.mkdtemp()) / "out.txt"
    >>> with atomic_write(target, "w") as file:
    ...     _ = file.write("all of it")
    >>> target.read_text()
    'all of it'
    """
    if mode not in ("wb", "w"):
        raise ValueError(f'`mode` is {mode!r}, "wb" or "w" is expected')
    return _write(os.fspath(path), text=mode == "w")


@contextmanager
def _write(path: str, *, text: bool) -> Iterator[Any]:
    """Choose the way: a rename, or a hand-over of what is complete."""
    try:
        target = path if path == "-" else os.path.realpath(path)
        mode = None if path == "-" else _mode_of(target)
        if path == "-" or (mode is not None and not stat.S_ISREG(mode)):
            way = _hand_over(target)
        else:
            way = _replace(target, mode)
        with way as file:
            if not text:
                yield file
                return
            words = io.TextIOWrapper(file, encoding="utf-8", newline="", write_through=True)
            try:
                yield words
                words.flush()
            finally:
                with suppress(ValueError, OSError):
                    words.detach()
    except OSError as error:
        named = os.path.basename(str(error.filename or ""))
        if error.errno is None or (named and not named.startswith(_PREFIX)):
            raise
        # the name of a temporary file, or none at all, would tell the reader nothing
        raise OSError(error.errno, os.strerror(error.errno), path) from error


def _mode_of(target: str) -> int | None:
    """Kind and permissions of a file; None if there is none."""
    try:
        return os.stat(target).st_mode
    except FileNotFoundError:
        return None


@contextmanager
def _replace(target: str, mode: int | None) -> Iterator[BinaryIO]:
    """Write beside the target, then rename over it."""
    folder = os.path.dirname(target) or "."
    _sweep(folder)
    fd, temporary = _create(folder)
    try:
        with os.fdopen(fd, "w+b") as file:
            if mode is not None:
                os.fchmod(fd, stat.S_IMODE(mode))
            yield file
            file.flush()
            os.fsync(fd)
            os.replace(temporary, target)
    except BaseException:
        with suppress(OSError):
            os.unlink(temporary)
        raise
    _sync_folder(folder)


@contextmanager
def _hand_over(target: str) -> Iterator[BinaryIO]:
    """Collect everything, then write it at once to what cannot be renamed over."""
    if os.path.isdir(target):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), target)
    memory = io.BytesIO()
    yield memory
    if target == "-":
        sys.stdout.flush()
        out: IO[bytes] = sys.stdout.buffer
        out.write(memory.getbuffer())
        out.flush()
        return
    with open(target, "wb", buffering=0) as device:
        left = memory.getbuffer()
        while left:
            left = left[device.write(left) :]


def _create(folder: str) -> tuple[int, str]:
    """Create a locked temporary file: its descriptor and name."""
    while True:
        name = os.path.join(folder, f"{_PREFIX}{secrets.token_hex(8)}{_SUFFIX}")
        fd = os.open(name, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_CLOEXEC, 0o666)
        try:
            with suppress(OSError):  # a file system without locks: such files are never swept
                fcntl.flock(fd, fcntl.LOCK_EX)
            # another run's sweep may have taken it between its creation and its lock
            if os.fstat(fd).st_nlink:
                return fd, name
        except BaseException:
            os.unlink(name)
            os.close(fd)
            raise
        os.close(fd)


@lru_cache(maxsize=1024)
def _sweep(folder: str) -> None:
    """Remove the temporary files that dead runs left in a folder, once in a run."""
    with suppress(OSError), os.scandir(folder) as entries:
        left = [e.path for e in entries if e.name.startswith(_PREFIX) and e.name.endswith(_SUFFIX)]
        for name in left:
            _remove_if_dead(name)


def _remove_if_dead(name: str) -> None:
    """Remove a temporary file unless its writer still holds the lock."""
    with suppress(OSError):
        fd = os.open(name, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.unlink(name)
        finally:
            os.close(fd)


def _sync_folder(folder: str) -> None:
    """Force the rename itself to the disk."""
    try:
        fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        if error.errno in _NO_FOLDER_SYNC:
            return
        raise
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno not in _NO_FOLDER_SYNC:
            raise
    finally:
        os.close(fd)
