"""kill -9 at random moments of a real run, resume each time: the same bytes as a run that was never interrupted."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.timeout(1800)

VOLATILE = ("logs/", "report/", "journal.jsonl", "run.lock")  # wall-clock times are in these, by design


def contents(run: Path) -> dict[str, bytes]:
    """Every committed file by its path in the run folder."""
    files = (p for p in sorted(run.rglob("*")) if p.is_file())
    named = {p.relative_to(run).as_posix(): p for p in files}
    return {n: p.read_bytes() for n, p in named.items() if not n.startswith(VOLATILE)}


def survive(config: Path, run: Path, kills: int, seed: int, tiny_seconds: float) -> int:
    """Start the run, kill it after a random time, again and again; returns how many kills hit it alive."""
    rng = random.Random(seed)
    hit = 0
    command = [sys.executable, "-m", "active3d_pipe.cli.main", "--quiet", "run", str(config), "--out", str(run)]
    for _ in range(kills):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(rng.uniform(0.2, tiny_seconds))
        if process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
            hit += 1
        process.wait()
    return hit


def check(config: Path, whole: Path, run: Path, cli: Callable[..., subprocess.CompletedProcess], kills: int) -> None:
    hit = survive(config, run, kills, seed=kills, tiny_seconds=12.0)
    assert hit > 0
    done = cli("run", config, "--out", run)
    assert done.returncode == 0, done.stderr
    expected, got = contents(whole), contents(run)
    assert sorted(expected) == sorted(got)
    # `manifest.json` may name when the run was made; everything else must be the same to the byte.
    different = [n for n in expected if expected[n] != got[n] and n != "manifest.json"]
    assert different == []


def test_killed_twice_ends_with_the_same_bytes(
    tiny_config: Path, tiny_run: Path, tmp_path: Path, run_cli: Callable[..., subprocess.CompletedProcess]
) -> None:
    check(tiny_config, tiny_run, tmp_path / "run", run_cli, kills=2)


@pytest.mark.crash
def test_killed_25_times_ends_with_the_same_bytes(
    tiny_config: Path, tiny_run: Path, tmp_path: Path, run_cli: Callable[..., subprocess.CompletedProcess]
) -> None:
    check(tiny_config, tiny_run, tmp_path / "run", run_cli, kills=25)
