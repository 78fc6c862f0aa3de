"""kill -9: whenever it comes, what was committed is intact and `resume` ends at the same bytes."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from active3d_pipe.pipeline import files
from active3d_pipe.pipeline.gc import gc
from active3d_pipe.pipeline.record import read_record
from active3d_pipe.pipeline.verify import verify
from tests.pipeline.conftest import open_runner, snapshot
from tests.pipeline.toy import REGISTRY, SLEEP

DRIVE = Path(__file__).resolve().parents[1] / "pipeline" / "drive.py"
ROUND = ("run.steps=3", "run.keep.every=1")  # one round and the finishing stages


def _in_child(work: Callable[[], object], crash_at: int) -> int:
    """Run `work` in a forked child that ends before its `crash_at`-th file operation; returns its exit code."""
    pid = os.fork()
    if pid == 0:
        try:
            os.environ[files.CRASH_AT] = str(files.operations() + crash_at)
            work()
            os._exit(0)
        except BaseException:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def _committed(path: Path) -> dict[str, bytes]:
    """All bytes of the artifacts that have a record now."""
    found: dict[str, bytes] = {}
    for stage in REGISTRY.stages:
        folders = sorted((path / stage.name).glob("round_*")) if stage.loop else [path / stage.name]
        for folder in folders:
            if not stage.volatile and (folder / "record.json").is_file():
                assert read_record(folder) is not None
                found |= {str(p.relative_to(path)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    return found


def _every_crash_heals(
    tmp_path: Path, prepare: Callable[[Path], object], work: Callable[[Path], object], expected: dict[str, bytes],
    stride: int = 1,
) -> int:
    """Crash `work` before every `stride`-th of its file operations in turn; returns how many there are."""
    crash_at = 1 - stride
    while True:
        crash_at += stride
        path = tmp_path / f"run{crash_at}"
        prepare(path)
        code = _in_child(lambda path=path: work(path), crash_at)
        assert code in (0, files.CRASH_EXIT_CODE)
        before = _committed(path)
        assert all(expected[name] == data for name, data in before.items() if name in expected)
        work(path)
        assert snapshot(path) == expected
        assert verify(open_runner(path, *ROUND, write=False), deep=True).damage == ()
        assert not [p for p in path.rglob(".tmp-*")] + [p for p in path.rglob(".old-*")]
        shutil.rmtree(path)
        if code == 0:
            return crash_at - 1


@pytest.mark.parametrize("stride", [5, pytest.param(1, marks=pytest.mark.crash)])
def test_a_crash_before_every_file_operation_of_a_run(tmp_path: Path, stride: int) -> None:
    def run(path: Path) -> None:
        open_runner(path, *ROUND).run()

    run(tmp_path / "whole")
    count = _every_crash_heals(tmp_path, lambda path: None, run, snapshot(tmp_path / "whole"), stride)
    assert count > 60


@pytest.mark.parametrize("swap", [True, False], ids=["exchange", "two renames"])
def test_a_crash_before_every_file_operation_of_a_replacement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, swap: bool
) -> None:
    if not swap:
        monkeypatch.setattr(files, "_renameat2", None)
    whole = tmp_path / "whole"
    open_runner(whole, *ROUND).run()

    def force(path: Path) -> None:
        open_runner(path, *ROUND).run_stage("mapping", 0, force=True)

    count = _every_crash_heals(tmp_path, lambda path: shutil.copytree(whole, path), force, snapshot(whole))
    assert count > 8


def test_a_crash_before_every_file_operation_of_pruning(tmp_path: Path) -> None:
    settings = ("run.steps=10", "run.keep.every=0")
    whole, pruned = tmp_path / "whole", tmp_path / "pruned"
    open_runner(whole, "run.steps=10", "run.keep.every=1").run()
    shutil.copytree(whole, pruned)

    def collect(path: Path) -> None:
        gc(open_runner(path, *settings))

    collect(pruned)
    expected = {name: data for name, data in snapshot(pruned).items() if name != "run.toml"}
    for crash_at in range(1, 12):
        path = tmp_path / f"run{crash_at}"
        shutil.copytree(whole, path)
        _in_child(lambda path=path: collect(path), crash_at)
        assert verify(open_runner(path, *settings, write=False), deep=True).damage == ()
        collect(path)
        assert {name: data for name, data in snapshot(path).items() if name != "run.toml"} == expected


def _start(path: Path, tmp_path: Path, sleep: float, *more: str) -> subprocess.Popen:
    (tmp_path / "room.glb").touch()
    command = [
        sys.executable, str(DRIVE), "run", "default", "--out", str(path),
        "--set", f"scene.file={tmp_path / 'room.glb'}", "--set", "run.steps=10",
        "--set", "camera.height=8", "--set", "run.name=crash", *more,
    ]
    environment = {**os.environ, SLEEP: str(sleep)}
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("kills", [5, pytest.param(25, marks=pytest.mark.crash)])
def test_kill_at_random_moments(tmp_path: Path, kills: int) -> None:
    rng = random.Random(kills)
    path, whole = tmp_path / "run", tmp_path / "whole"
    assert _start(whole, tmp_path, 0).wait() == 0
    killed = 0
    while killed < kills:
        process = _start(path, tmp_path, 0.05)
        while not (path / "run.lock").exists() and process.poll() is None:
            time.sleep(0.005)
        time.sleep(rng.uniform(0.0, 0.25))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        if process.returncode == 0:
            shutil.rmtree(path)  # it was done already: begin again
            continue
        killed += 1
        _committed(path)
    assert _start(path, tmp_path, 0).wait() == 0
    assert snapshot(path) == snapshot(whole)


def test_a_torn_journal_line_is_skipped_and_closed(tmp_path: Path) -> None:
    path = tmp_path / "run"
    open_runner(path, *ROUND).run()
    expected = snapshot(path)
    journal = path / "journal.jsonl"
    for cut in (1, 10, 60):
        whole = journal.read_bytes()
        journal.write_bytes(whole[:-cut])
        found = verify(open_runner(path, *ROUND), deep=True)
        assert found.damage == ()
        assert found.remarks == (() if cut == 1 else ("journal.jsonl: 1 line(s) torn by a crash",))
        open_runner(path, *ROUND).run_stage("mapping", 0, force=True)
        events, torn = open_runner(path, *ROUND).run_dir.journal.read()
        assert torn == (0 if cut == 1 else 1)
        assert events[-1]["node"] == "mapping/round_0000"
        assert snapshot(path) == expected
        journal.write_bytes(whole)


def test_one_writer(tmp_path: Path) -> None:
    path = tmp_path / "run"
    first = _start(path, tmp_path, 600)
    while not (path / "capture").exists():
        time.sleep(0.01)
    others = [_start(path, tmp_path, 0) for _ in range(3)]
    for other in others:
        _, said = other.communicate()
        assert other.returncode == 75
        assert said == (
            f"active3d: {path}: process {first.pid} works on this run; wait for it, or end it and run the command "
            "again\n"
        )
    first.kill()
    first.communicate()
    again = _start(path, tmp_path, 0)  # the kernel dropped the lock with the process
    again.communicate()
    assert again.returncode == 0
