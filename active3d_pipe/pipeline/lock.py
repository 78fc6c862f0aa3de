"""One writer for a run folder: an advisory lock that the kernel drops when its process ends, even by kill -9."""

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

from active3d_pipe.errors import RunLockedError
from active3d_pipe.pipeline.files import writing

LOCK = "run.lock"
PATIENCE_S = 1.0  # far longer than it takes to look at a lock, or to write an id after taking it


@contextmanager
def one_at_a_time(folder: Path) -> Iterator[None]:
    """Hold a folder, made if need be, against other processes that call this; waits for them."""
    folder.mkdir(parents=True, exist_ok=True)
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


class RunLock:
    """Held as a context manager; RunLockedError names the process that holds it already."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / LOCK
        self._fd = -1

    def __enter__(self) -> "RunLock":
        with writing(self.path):
            self._fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                self._take()
                os.ftruncate(self._fd, 0)
                os.write(self._fd, f"{os.getpid()}\n".encode())
            except BaseException:
                os.close(self._fd)
                raise
        return self

    def _take(self) -> None:
        until = time.monotonic() + PATIENCE_S
        while True:
            try:
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                writer = holder(self.path.parent)
                # Nobody writes: somebody only looks who does, for an instant, or has just let go.
                if writer is not None or time.monotonic() > until:
                    raise RunLockedError(
                        f"{self.path.parent}: process {writer or 'unknown'} works on this run; wait for it, or end it "
                        "and run the command again"
                    ) from None
                time.sleep(0.01)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            os.ftruncate(self._fd, 0)  # while it is still held: the next holder is never taken for this one
        finally:
            os.close(self._fd)


def holder(folder: Path) -> int | None:
    """Process id of whoever holds the lock of a run folder; None if nobody does, or does not say who it is."""
    until = time.monotonic() + PATIENCE_S
    while True:
        try:
            fd = os.open(folder / LOCK, os.O_RDONLY)
        except OSError:
            return None
        try:
            fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return None
        except BlockingIOError:
            # The holder writes its id right after taking the lock, and wipes it before: empty is for microseconds.
            text = os.read(fd, 32).strip()
            if text.isdigit() or time.monotonic() > until:
                return int(text) if text.isdigit() else None
            time.sleep(0.01)
        finally:
            os.close(fd)
