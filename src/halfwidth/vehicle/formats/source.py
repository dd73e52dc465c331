"""The bytes of a log, bounded: plain or gzip, from a file or standard input.

Whatever arrives is untrusted. Bytes are handed out in blocks, so no size is ever taken on trust;
a gzip stream is refused as soon as it has expanded further than any real log does, and one that
breaks off keeps what came before the break, with a note; one that is damaged is refused.
"""

import os
import sys
import zlib
from dataclasses import dataclass
from typing import BinaryIO, Protocol

from halfwidth.errors import BadLog, LogTooBig

BLOCK = 1 << 20


@dataclass(frozen=True)
class Limits:
    """How much of a log is read before it is refused.

    Parameters
    ----------
    line_bytes : int
        Longest line.
    columns : int
        Most columns.
    rows : int
        Most rows.
    total_bytes : int
        Most bytes after decompression.
    ratio : float
        Most bytes out for each byte in, once `ratio_from` bytes are out.
    ratio_from : int
        Bytes after which the ratio is looked at.
    """

    line_bytes: int = 1 << 20
    columns: int = 4096
    rows: int = 20_000_000
    total_bytes: int = 8 << 30
    ratio: float = 100.0
    ratio_from: int = 1 << 19


#: First bytes of what is often mistaken for a log, and what to do about it.
_FOREIGN: tuple[tuple[bytes, str, str], ...] = (
    (b"PK\x03\x04", "a zip archive or a spreadsheet", "unpack it, or export the sheet as CSV"),
    (b"BZh", "a bzip2 file", "decompress it with `bunzip2` first"),
    (b"\xfd7zXZ\x00", "an xz file", "decompress it with `unxz` first"),
    (b"\x28\xb5\x2f\xfd", "a zstd file", "decompress it with `unzstd` first"),
    (b"\x89HDF", "an HDF5 or MATLAB file", "export the signals as CSV or Parquet"),
    (b"MATLAB 5", "a MATLAB file", "export the signals as CSV or Parquet"),
    (b"MDF ", "an MDF measurement file", "export the signals as CSV or Parquet"),
    (b"LOGG", "a CAN log (BLF)", "decode it and export the signals as CSV or Parquet"),
    (b"#ROSBAG", "a ROS bag", "export the topics as CSV or Parquet"),
    (b"\x89MCAP", "an MCAP file", "export the topics as CSV or Parquet"),
    (b"SQLite format 3", "an SQLite database", "export the table as CSV"),
    (b"%PDF", "a PDF document", "give the log itself"),
    (b"\x89PNG", "a picture", "give the log itself"),
)


class Source:
    """Bytes of one log in blocks, decompressed, counted and limited.

    Attributes
    ----------
    name : str
        Path, or ``"-"``.
    kind : str
        ``"parquet"`` or ``"text"``, told from the first bytes.
    damage : str or None
        Why the bytes ended early, once they have.
    """

    def __init__(self, stream: BinaryIO, name: str, limits: Limits) -> None:
        self.name = name
        self.limits = limits
        self.damage: str | None = None
        self._stream: _Readable = stream
        self._n_in = self._n_out = 0
        self._zip: zlib._Decompress | None = None
        self._tail = b""
        self._head = self._raw(BLOCK)
        if self._head[:2] == b"\x1f\x8b":
            self._zip, self._n_out = zlib.decompressobj(wbits=31), 0
            self._tail, self._head = self._head, b""
            self._head = self._inflate()
            if self._head[:2] == b"\x1f\x8b":
                raise BadLog(f"`{name}` is compressed twice, gzip once is expected", hint="`gunzip` it first")
            if self._head[:4] == b"PAR1":
                raise BadLog(
                    f"`{name}` is a Parquet file inside gzip, Parquet alone is expected", hint="`gunzip` it first"
                )
        self.kind = "parquet" if self._head[:4] == b"PAR1" else "text"
        for magic, what, way_out in _FOREIGN:
            if self._head.startswith(magic):
                raise BadLog(f"`{name}` is {what}, CSV, gzip CSV or Parquet is expected", hint=f"{way_out}")

    @property
    def head(self) -> bytes:
        """The first block, which the next `read` gives again."""
        return self._head

    def read(self) -> bytes:
        """Give the next block, empty at the end."""
        if self._head:
            block, self._head = self._head, b""
            return block
        return self._inflate() if self._zip is not None else self._raw(BLOCK)

    def _raw(self, size: int) -> bytes:
        try:
            block = self._stream.read(size)
        except OSError as error:
            raise BadLog(f"`{self.name}` cannot be read: {_reason(error)}") from error
        self._n_in += len(block)
        if self._zip is None:
            self._count(len(block))
        return block

    def _inflate(self) -> bytes:
        """Decompress until something comes out; at a break, remember why and end."""
        while True:
            if not self._tail:
                self._tail = self._raw(BLOCK >> 3)
            if not self._tail:
                if self._zip is not None and not self._zip.eof:
                    self.damage = "the gzip stream breaks off"
                return b""
            assert self._zip is not None
            try:
                block = self._zip.decompress(self._tail, BLOCK)
            except zlib.error as error:
                # what was decoded so far may be wrong without looking wrong: nothing is kept
                words = str(error).rpartition(": ")[2]
                raise BadLog(
                    f"`{self.name}` is a damaged gzip file ({words}, near byte {self._n_in - len(self._tail)})",
                    hint="copy it again from where it came from",
                ) from error
            self._tail = self._zip.unconsumed_tail
            if self._zip.eof:
                rest = self._zip.unused_data or self._raw(BLOCK >> 3)
                if rest[:2] == b"\x1f\x8b":  # the next member of the same file
                    self._zip, self._tail = zlib.decompressobj(wbits=31), rest
                else:
                    if rest.strip(b"\0"):
                        self.damage = "bytes after the end of the gzip stream are ignored"
                    self._tail, self._stream = b"", _Empty()
            self._count(len(block))
            if block or (self._zip.eof and not self._tail):
                return block

    def _count(self, n: int) -> None:
        self._n_out += n
        if self._n_out > self.limits.total_bytes:
            raise LogTooBig(
                f"`{self.name}` holds more than {self.limits.total_bytes >> 20} MiB, which is the limit",
                hint="cut it, or pass `limits=` to `halfwidth.vehicle.read`",
            )
        if (
            self._zip is not None
            and self._n_out > self.limits.ratio_from
            and self._n_out > self.limits.ratio * max(self._n_in - len(self._tail), 1)
        ):
            raise LogTooBig(
                f"`{self.name}` expands more than {self.limits.ratio:g} times, which no real log does",
                hint="if it is one, `gunzip` it first",
            )


class _Readable(Protocol):
    """What a source reads from."""

    def read(self, size: int, /) -> bytes:
        """Give up to `size` bytes, none at the end."""
        ...


class _Empty:
    """A stream at its end."""

    def read(self, _size: int, /) -> bytes:
        return b""


def open_source(path: str | os.PathLike[str], limits: Limits) -> tuple[Source, BinaryIO]:
    """Open a path or standard input.

    Parameters
    ----------
    path : str or path
        A file, or ``"-"`` for standard input.
    limits : Limits
        When to refuse.

    Returns
    -------
    source : Source
        The bytes.
    stream : binary file
        To be closed by the caller, unless it is standard input.

    Raises
    ------
    BadLog
        If it is not there, is a directory, cannot be read, or is no log.
    """
    name = os.fspath(path)
    if name == "-":
        stream: BinaryIO = sys.stdin.buffer
        return Source(stream, "-", limits), stream
    if "\0" in name:
        raise BadLog(f"`path` is {name!r}, a path without NUL is expected")
    if os.path.isdir(name):
        raise BadLog(
            f"`{name}` is a directory, a log file is expected",
            hint="give one file; a folder of logs is a shell loop away",
        )
    try:
        stream = open(name, "rb")  # noqa: SIM115 - the caller closes it
    except OSError as error:
        hint = "check the spelling" if isinstance(error, FileNotFoundError) else None
        raise BadLog(f"`{name}` cannot be read: {_reason(error)}", hint=hint) from error
    try:
        return Source(stream, name, limits), stream
    except BaseException:
        stream.close()
        raise


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
