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
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(self._fd)
                raise RunLockedError(
                    f"{self.path.parent}: process {holder(self.path.parent, patience=1.0) or 'unknown'} works on this "
                    "run; wait for it, or end it and run the command again"
                ) from None
            os.ftruncate(self._fd, 0)
            os.write(self._fd, f"{os.getpid()}\n".encode())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._fd)


def holder(folder: Path, patience: float = 0.0) -> int | None:
    """Process id of whoever holds the lock of a run folder; None if nobody does or it is not written yet."""
    until = time.monotonic() + patience
    while True:
        try:
            fd = os.open(folder / LOCK, os.O_RDONLY)
        except OSError:
            return None
        try:
            fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return None
        except BlockingIOError:
            # The holder writes its id right after taking the lock: an empty file is a matter of microseconds.
            text = os.read(fd, 32).strip()
            if text.isdigit() or time.monotonic() > until:
                return int(text) if text.isdigit() else None
            time.sleep(0.01)
        finally:
            os.close(fd)
