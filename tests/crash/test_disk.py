"""A disk that is full or may not be written: one line, the documented exit code, nothing lost."""

import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.crash.test_crash import DRIVE, _committed
from tests.pipeline.conftest import snapshot

BASE = ["--set", "camera.height=400", "--set", "run.steps=10", "--set", "run.name=disk"]


def _active3d(tmp_path: Path, *arguments: str, file_limit: int | None = None) -> subprocess.CompletedProcess:
    (tmp_path / "room.glb").touch()

    def limit() -> None:
        if file_limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_limit, file_limit))

    return subprocess.run(
        [sys.executable, str(DRIVE), *arguments], capture_output=True, text=True, check=False, preexec_fn=limit
    )


def _run(tmp_path: Path, path: Path, file_limit: int | None = None) -> subprocess.CompletedProcess:
    scene = ["--set", f"scene.file={tmp_path / 'room.glb'}"]
    return _active3d(tmp_path, "run", "default", "--out", str(path), *scene, *BASE, file_limit=file_limit)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 160 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=160k", "tmpfs", str(folder)], capture_output=True, check=False
    )
    if mount.returncode != 0:
        pytest.skip("mounting a small file system needs root; the file-size limit stands in for it")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_disk_full(tmp_path: Path, small_disk: Path) -> None:
    whole = tmp_path / "whole"
    assert _run(tmp_path, whole).returncode == 0
    path = small_disk / "run"
    failed = _run(tmp_path, path)
    assert failed.returncode == 74
    lines = [line for line in failed.stderr.splitlines() if line.startswith("active3d:")]
    assert len(lines) == 1
    assert "; free some space and go on with `active3d resume` (nothing that was committed is harmed)" in lines[0]
    kept = _committed(path)
    assert kept
    assert all(snapshot(whole)[name] == data for name, data in kept.items())
    subprocess.run(["mount", "-o", "remount,size=4m", str(small_disk)], check=True)
    resumed = _active3d(tmp_path, "resume", str(path))
    assert resumed.returncode == 0
    assert snapshot(path) == snapshot(whole)


def test_file_size_limit(tmp_path: Path) -> None:
    whole, path = tmp_path / "whole", tmp_path / "run"
    assert _run(tmp_path, whole).returncode == 0
    failed = _run(tmp_path, path, file_limit=40_000)  # the configuration is smaller, the frames of round 0 are larger
    assert failed.returncode == 74
    assert "Traceback" not in failed.stderr
    assert "cannot write" in failed.stderr
    assert not list((path / "capture").iterdir())
    assert _run(tmp_path, path).returncode == 0
    assert snapshot(path) == snapshot(whole)


def test_a_file_in_the_way(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for path in (tmp_path / "file", tmp_path / "file" / "run"):
        failed = _run(tmp_path, path)
        assert failed.returncode == 73
        assert failed.stderr.count("\n") == 1
    assert (tmp_path / "file").read_text() == "mine"


def test_a_folder_with_something_else(tmp_path: Path) -> None:
    (tmp_path / "papers").mkdir()
    (tmp_path / "papers/thesis.tex").write_text("mine")
    failed = _run(tmp_path, tmp_path / "papers")
    assert failed.returncode == 73
    assert failed.stderr == (
        f"active3d: {tmp_path / 'papers'}: holds 'thesis.tex' and is no run folder; choose an empty or new folder "
        "with --out\n"
    )
    assert sorted(p.name for p in (tmp_path / "papers").iterdir()) == ["thesis.tex"]


def test_a_read_only_file_system(tmp_path: Path) -> None:
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", "ro", "tmpfs", str(folder)], capture_output=True, check=False)
    if mount.returncode != 0:
        pytest.skip("mounting needs root")
    try:
        failed = _run(tmp_path, folder / "run")
        assert failed.returncode == 73
        assert "Read-only file system; choose another folder with --out" in failed.stderr
        assert "Traceback" not in failed.stderr
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def test_a_folder_without_permission(tmp_path: Path) -> None:
    # Mode bits do not stop root; sysfs refuses new folders to everybody.
    folder = Path("/sys")
    if os.geteuid() != 0:
        folder = tmp_path / "closed"
        folder.mkdir(mode=0o500)
    failed = _run(tmp_path, folder / "run")
    assert failed.returncode == 77
    assert "no permission to write" in failed.stderr


def test_permission_errors_are_told_from_others() -> None:
    from active3d_pipe.errors import AccessError
    from active3d_pipe.pipeline.files import explain

    error = explain(PermissionError(13, "Permission denied", "/closed/run"), "/closed")
    assert isinstance(error, AccessError)
    assert error.exit_code == 77
    assert str(error).startswith("no permission to write /closed/run")
