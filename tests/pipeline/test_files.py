"""Files and locks when more than one process is at work."""

import errno
import fcntl
import os
import threading
import time
from pathlib import Path

import pytest

from active3d_pipe.errors import OutputError, RunLockedError
from active3d_pipe.pipeline import files
from active3d_pipe.pipeline.lock import LOCK, RunLock, holder
from active3d_pipe.pipeline.run_dir import RunDir


def test_two_that_replace_one_file_both_succeed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "sweep.json"
    write, both = files.write_file, threading.Barrier(2, timeout=30)
    said: list[BaseException] = []

    def write_together(path: Path, data: bytes) -> None:
        write(path, data)
        both.wait()

    def replace(data: bytes) -> None:
        try:
            files.replace_file(file, data)
        except BaseException as error:
            said.append(error)

    monkeypatch.setattr(files, "write_file", write_together)
    threads = [threading.Thread(target=replace, args=(data,)) for data in (b"a" * 99, b"b" * 99)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert said == [] and file.read_bytes() in (b"a" * 99, b"b" * 99)
    assert [p.name for p in tmp_path.iterdir()] == ["sweep.json"]


def test_a_file_that_cannot_be_replaced_is_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(source: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, "no space")

    files.replace_file(tmp_path / "a", b"old")
    monkeypatch.setattr(files.os, "replace", full)
    with pytest.raises(OSError):
        files.replace_file(tmp_path / "a", b"new")
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a", b"old")]


def test_what_a_crash_left_of_a_replacement_is_removed(run_path: Path) -> None:
    (run_path / ".tmp-0a1b2c3d-run.toml").touch()
    assert RunDir.open(run_path).store.clean() == ["removed the unfinished .tmp-0a1b2c3d-run.toml"]


def test_a_look_at_the_lock_is_no_writer(tmp_path: Path) -> None:
    (tmp_path / LOCK).touch()
    fd = os.open(tmp_path / LOCK, os.O_RDONLY)
    fcntl.flock(fd, fcntl.LOCK_SH)  # what `status` does, for an instant
    threading.Timer(0.2, os.close, (fd,)).start()
    with RunLock(tmp_path):
        assert holder(tmp_path) == os.getpid()
        with pytest.raises(RunLockedError, match=f"process {os.getpid()} works on this run"), RunLock(tmp_path):
            pass
    assert holder(tmp_path) is None


def test_whoever_looks_never_disturbs_and_is_never_told_wrong(tmp_path: Path) -> None:
    found: set[int | None] = set()
    stop = threading.Event()

    def look() -> None:
        while not stop.is_set():
            found.add(holder(tmp_path))

    lookers = [threading.Thread(target=look) for _ in range(2)]
    for thread in lookers:
        thread.start()
    for _ in range(100):
        with RunLock(tmp_path):
            time.sleep(0.001)
    stop.set()
    for thread in lookers:
        thread.join()
    assert found <= {None, os.getpid()}


def test_the_next_holder_is_not_taken_for_the_one_before(tmp_path: Path) -> None:
    with RunLock(tmp_path):
        assert (tmp_path / LOCK).read_text() == f"{os.getpid()}\n"
    assert (tmp_path / LOCK).read_text() == ""


def test_a_name_that_is_too_long_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"cannot create .*: File name too long; choose another folder with --out"):
        RunDir.prepare(tmp_path / ("x" * 300))
