"""A file is the old one or the new one, whatever fails and whenever the writer dies."""

import errno
import hashlib
import io
import os
import resource
import signal
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from halfwidth import store
from halfwidth.store import atomic_write

OLD = b"the old content"
NEW = b"the new content, " * 5000

#: Loads the module by its path, so that a writer starts in milliseconds.
LOAD = f"""
import importlib.util, sys
spec = importlib.util.spec_from_file_location("store", {store.__file__!r})
store = importlib.util.module_from_spec(spec)
spec.loader.exec_module(store)
"""


@pytest.fixture(autouse=True)
def _fresh_sweep():
    store._sweep.cache_clear()
    yield
    store._sweep.cache_clear()


@pytest.fixture
def target(tmp_path):
    path = tmp_path / "out.bin"
    path.write_bytes(OLD)
    return path


def left_over(folder: Path) -> list[str]:
    return [name for name in os.listdir(folder) if name.startswith(".halfwidth-")]


def write_new(path) -> None:
    with atomic_write(path) as file:
        for start in range(0, len(NEW), 8192):
            file.write(NEW[start : start + 8192])


def test_new_content_replaces_the_old(target):
    write_new(target)
    assert target.read_bytes() == NEW
    assert os.listdir(target.parent) == ["out.bin"]


def test_text_is_utf8_with_line_ends_as_written(tmp_path):
    with atomic_write(tmp_path / "a.txt", "w") as file:
        file.write("Köln\r\n")
        file.write("Łódź\n")
    assert (tmp_path / "a.txt").read_bytes() == "Köln\r\nŁódź\n".encode()


def test_unknown_mode_is_refused(tmp_path):
    with pytest.raises(ValueError, match='\'a\', "wb" or "w" is expected'):
        atomic_write(tmp_path / "a", "a")


def test_reader_sees_the_old_file_until_the_block_ends(target):
    with atomic_write(target) as file:
        file.write(NEW)
        file.flush()
        assert target.read_bytes() == OLD
    assert target.read_bytes() == NEW


@pytest.mark.parametrize("error", [RuntimeError("no"), KeyboardInterrupt(), SystemExit(3)])
def test_exception_in_the_block_leaves_the_old_file(target, error):
    def fail():
        with atomic_write(target) as file:
            file.write(NEW)
            raise error

    with pytest.raises(type(error)):
        fail()
    assert target.read_bytes() == OLD
    assert not left_over(target.parent)


def test_exception_in_a_text_block_leaves_the_old_file(target):
    with pytest.raises(UnicodeEncodeError), atomic_write(target, "w") as file:
        file.writelines(["half of it", "\ud800"])
    assert target.read_bytes() == OLD
    assert not left_over(target.parent)


def test_error_of_another_file_keeps_its_name(target, tmp_path):
    with pytest.raises(FileNotFoundError) as caught, atomic_write(target):
        (tmp_path / "absent").read_bytes()
    assert caught.value.filename == str(tmp_path / "absent")


def test_permissions_of_an_existing_file_stay(target):
    target.chmod(0o640)
    write_new(target)
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_permissions_of_a_new_file_follow_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        write_new(tmp_path / "new")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o640


def test_symbolic_link_stays_a_link(target, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(target)
    write_new(link)
    assert link.is_symlink()
    assert target.read_bytes() == NEW


def test_dangling_link_is_followed(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "sub" / "new")
    write_new(tmp_path / "link")
    assert (tmp_path / "sub" / "new").read_bytes() == NEW


def test_relative_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_new("bare-name")
    assert (tmp_path / "bare-name").read_bytes() == NEW


def test_longest_name(tmp_path):
    write_new(tmp_path / ("n" * 255))
    assert (tmp_path / ("n" * 255)).read_bytes() == NEW


def test_device_stays_a_device():
    write_new("/dev/null")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_pipe_receives_everything_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    got = []
    reader = threading.Thread(target=lambda: got.append((tmp_path / "pipe").read_bytes()))
    reader.start()
    write_new(tmp_path / "pipe")
    reader.join()
    assert got == [NEW]


def standard_output(monkeypatch) -> io.BytesIO:
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="utf-8"))
    return raw


def test_dash_is_standard_output(monkeypatch):
    raw = standard_output(monkeypatch)
    sys.stdout.write("before ")
    write_new("-")
    assert raw.getvalue() == b"before " + NEW


def test_standard_output_gets_nothing_of_a_failed_block(monkeypatch):
    raw = standard_output(monkeypatch)
    with pytest.raises(ZeroDivisionError), atomic_write("-") as file:
        file.writelines(NEW if part else 1 // part for part in (1, 0))
    assert raw.getvalue() == b""


# --- faults ---------------------------------------------------------------------------------------


def test_full_device_says_so():
    with pytest.raises(OSError) as caught:
        write_new("/dev/full")
    assert caught.value.errno == errno.ENOSPC
    assert caught.value.filename == "/dev/full"


def test_disk_that_fills_up_while_writing(target, monkeypatch):
    real = store._create

    def on_full_device(folder):
        fd, name = real(folder)
        os.dup2(full, fd)
        return fd, name

    with open("/dev/full", "wb", buffering=0) as device:
        full = device.fileno()
        monkeypatch.setattr(store, "_create", on_full_device)
        with pytest.raises(OSError) as caught:
            write_new(target)
    assert caught.value.errno == errno.ENOSPC
    assert caught.value.filename == str(target)
    assert target.read_bytes() == OLD
    assert not left_over(target.parent)


def test_file_size_limit(target):
    """A real limit of the kernel, in a process of its own."""
    code = LOAD + "with store.atomic_write(sys.argv[1]) as file:\n    file.write(bytes(1_000_000))\n"
    run = subprocess.run(
        [sys.executable, "-S", "-c", code, str(target)],
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000)),
    )
    assert run.returncode == 1
    assert "File too large" in run.stderr.splitlines()[-1]
    assert str(target) in run.stderr.splitlines()[-1]
    assert target.read_bytes() == OLD
    assert not left_over(target.parent)


CALLS = ("open", "fchmod", "fsync", "replace", "fstat", "stat", "scandir", "unlink", "close")


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC, errno.EROFS])
def test_every_system_call_fails_once(target, monkeypatch, number):
    """Fail the k-th call into the system for every k: old or new, nothing between, nothing left."""
    met, k = set(), 0
    while True:
        target.write_bytes(OLD)
        store._sweep.cache_clear()
        count = 0

        def failing(name, real):
            def call(*args, **kwargs):
                nonlocal count
                count += 1
                if count == k + 1:
                    met.add(name)
                    if name == "close":
                        real(*args, **kwargs)  # the descriptor is gone even when close fails
                    raise OSError(number, os.strerror(number))
                return real(*args, **kwargs)

            return call

        with monkeypatch.context() as patch:
            for name in CALLS:
                patch.setattr(store.os, name, failing(name, getattr(os, name)))
            try:
                write_new(target)
                failed = False
            except OSError as error:
                failed = True
                named = (error.errno, error.filename)
        if count <= k:  # one call more than there are: nothing was failed
            assert not failed
            break
        if failed:
            assert named == (number, str(target))
        content = target.read_bytes()
        assert content in (OLD, NEW)
        assert failed or content == NEW
        assert not left_over(target.parent)
        k += 1
    assert {"open", "fsync", "replace", "fstat", "stat", "scandir"} <= met


def test_rename_failure_leaves_the_old_file(target, monkeypatch):
    def refuse(*_):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(store.os, "replace", refuse)
    with pytest.raises(PermissionError, match=r"out\.bin"):
        write_new(target)
    assert target.read_bytes() == OLD
    assert not left_over(target.parent)


def test_absent_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        write_new(tmp_path / "absent" / "out")
    assert caught.value.filename == str(tmp_path / "absent" / "out")


def test_folder_as_target(tmp_path):
    with pytest.raises(IsADirectoryError):
        write_new(tmp_path)
    assert os.listdir(tmp_path) == []


def test_folder_that_cannot_be_synced_is_no_failure(target, monkeypatch):
    real = os.fsync

    def only_files(fd):
        if stat.S_ISDIR(os.fstat(fd).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        real(fd)

    monkeypatch.setattr(store.os, "fsync", only_files)
    write_new(target)
    assert target.read_bytes() == NEW


# --- killed writers -------------------------------------------------------------------------------

WRITER = (
    LOAD
    + """
import hashlib
print("ready", flush=True)
number = 0
while True:
    body = (b"%d " % number) * 40000
    with store.atomic_write(sys.argv[1]) as file:
        file.write(hashlib.sha256(body).digest())
        for start in range(0, len(body), 16384):
            file.write(body[start : start + 16384])
    number += 1
"""
)


def test_kill_9_at_50_instants_leaves_a_whole_file(tmp_path):
    rng = np.random.default_rng(9)
    target = tmp_path / "out"
    dead = 0
    for _ in range(50):
        target.write_bytes(hashlib.sha256(OLD).digest() + OLD)
        writer = subprocess.Popen([sys.executable, "-S", "-c", WRITER, str(target)], stdout=subprocess.PIPE)
        writer.stdout.readline()
        time.sleep(rng.uniform(0, 0.015))
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        writer.stdout.close()
        content = target.read_bytes()
        assert hashlib.sha256(content[32:]).digest() == content[:32]
        dead += bool(left_over(tmp_path))
        store._sweep.cache_clear()
        write_new(tmp_path / "another")
        assert not left_over(tmp_path)
    assert dead > 10  # the instants did fall inside a write


def test_temporary_file_of_a_living_writer_stays(tmp_path):
    with atomic_write(tmp_path / "slow") as slow:
        slow.write(NEW)
        store._sweep.cache_clear()
        write_new(tmp_path / "quick")
        assert len(left_over(tmp_path)) == 1
    assert (tmp_path / "slow").read_bytes() == NEW
    assert not left_over(tmp_path)


def test_sweep_touches_nothing_else(tmp_path):
    for name in (".halfwidth-notes", "halfwidth-1.tmp", ".other-1.tmp"):
        (tmp_path / name).write_text("mine")
    (tmp_path / ".halfwidth-link.tmp").symlink_to(tmp_path / "halfwidth-1.tmp")
    write_new(tmp_path / "out")
    assert (tmp_path / "halfwidth-1.tmp").read_text() == "mine"
    assert {".halfwidth-notes", "halfwidth-1.tmp", ".other-1.tmp"} <= set(os.listdir(tmp_path))


def test_creation_raced_by_a_sweep_starts_again(tmp_path, monkeypatch):
    """A file swept between its creation and its lock has no name left, so another is made."""
    real, taken = store.fcntl.flock, []

    def swept_first(fd, how):
        if not taken:
            taken.extend(left_over(tmp_path))
            os.unlink(tmp_path / taken[0])
        return real(fd, how)

    monkeypatch.setattr(store.fcntl, "flock", swept_first)
    write_new(tmp_path / "out")
    assert len(taken) == 1
    assert (tmp_path / "out").read_bytes() == NEW


def test_without_locks_nothing_is_swept_and_everything_written(tmp_path, monkeypatch):
    def unsupported(*_):
        raise OSError(errno.ENOTSUP, "Operation not supported")

    (tmp_path / ".halfwidth-00.tmp").write_text("whose?")
    monkeypatch.setattr(store.fcntl, "flock", unsupported)
    write_new(tmp_path / "out")
    assert (tmp_path / "out").read_bytes() == NEW
    assert left_over(tmp_path) == [".halfwidth-00.tmp"]
