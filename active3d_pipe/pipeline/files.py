"""File operations that survive a crash, and the one place where the engine touches the disk.

Every operation that changes a run folder passes through here, so that the crash tests can end the process
before any one of them (`ACTIVE3D_TEST_CRASH_AT=n`), and so that an OSError becomes one clear line.
"""

import ctypes
import errno
import hashlib
import os
import secrets
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from active3d_pipe.errors import AccessError, Active3dError, DiskError, OutputError

CRASH_AT = "ACTIVE3D_TEST_CRASH_AT"
CRASH_EXIT_CODE = 137
_operations = 0
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
_renameat2 = getattr(ctypes.CDLL(None), "renameat2", None) if sys.platform == "linux" else None
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


def failpoint() -> None:
    """Count one file operation; end the process here if the crash tests ask for it."""
    global _operations
    _operations += 1
    if os.environ.get(CRASH_AT) == str(_operations):
        os._exit(CRASH_EXIT_CODE)


def operations() -> int:
    """Number of file operations of this process so far."""
    return _operations


def explain(error: OSError, where: Path | str) -> Active3dError:
    """The error class and the line for an OSError met while writing at `where`."""
    if isinstance(error, Active3dError):
        return error
    place = error.filename or where
    if error.errno in _FULL or error.errno is None:  # without a number: NumPy's report of a short write
        what = error if error.errno is None else os.strerror(error.errno)
        return DiskError(
            f"cannot write {place}: {what}; free some space and go on with `active3d resume` "
            "(nothing that was committed is harmed)"
        )
    if error.errno in (errno.EACCES, errno.EPERM):
        return AccessError(f"no permission to write {place}; change its mode, or choose another folder with --out")
    if error.errno in (errno.EROFS, errno.ENOTDIR, errno.EEXIST, errno.EISDIR, errno.ENOENT, errno.ENAMETOOLONG):
        return OutputError(f"cannot create {place}: {os.strerror(error.errno)}; choose another folder with --out")
    return DiskError(f"cannot write {place}: {error.strerror or error}; check the disk, then `active3d resume`")


@contextmanager
def writing(where: Path | str) -> Iterator[None]:
    """Turn an OSError inside the block into an Active3dError that names the place."""
    try:
        yield
    except OSError as error:
        raise explain(error, where) from error


def make_folder(path: Path) -> None:
    """Create a folder and its missing parents."""
    failpoint()
    path.mkdir(parents=True, exist_ok=True)


def sync_folder(path: Path) -> None:
    """Make the names inside a folder durable."""
    failpoint()
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def sync_file(path: Path) -> None:
    """Make a file's bytes durable."""
    failpoint()
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def sync_tree(root: Path) -> None:
    """Make every file and folder below `root`, and `root` itself, durable."""
    for folder, _, names in os.walk(root, topdown=False):
        for name in sorted(names):
            sync_file(Path(folder) / name)
        sync_folder(Path(folder))


def write_file(path: Path, data: bytes) -> None:
    """Write a new file durably (its folder is not synced)."""
    failpoint()
    with open(path, "wb") as f:
        f.write(data)
        f.flush()
        os.fsync(f.fileno())


def replace_file(path: Path, data: bytes) -> None:
    """Write a file so that a reader, or a crash, sees either the old bytes or the new ones; of two writers one wins."""
    aside = path.with_name(f".tmp-{secrets.token_hex(4)}-{path.name}")
    try:
        write_file(aside, data)
        failpoint()
        os.replace(aside, path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def rename(source: Path, target: Path) -> None:
    """Rename within one folder; the folder is not synced."""
    failpoint()
    os.rename(source, target)


def exchange(first: Path, second: Path) -> bool:
    """Swap two names in one step, so that neither is ever absent; False where the system cannot."""
    failpoint()
    if _renameat2 is None:
        return False
    return _renameat2(_AT_FDCWD, os.fsencode(first), _AT_FDCWD, os.fsencode(second), _RENAME_EXCHANGE) == 0


def remove_tree(path: Path) -> None:
    """Remove a folder or a file if it is there."""
    failpoint()
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def sha256_file(path: Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes."""
    with open(path, "rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def list_files(root: Path) -> list[Path]:
    """Every entry below `root` that is not a folder, sorted by its relative name; links are not followed."""
    found = [Path(folder) / name for folder, _, names in os.walk(root) for name in names]
    found += [
        Path(folder) / name
        for folder, folders, _ in os.walk(root)
        for name in folders
        if (Path(folder) / name).is_symlink()
    ]
    return sorted(found, key=lambda p: p.relative_to(root).as_posix())
