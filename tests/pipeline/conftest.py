"""Fixtures of the engine's tests."""

from collections.abc import Callable
from pathlib import Path

import pytest

from active3d_pipe.pipeline.config import load_config, resolve_toml
from active3d_pipe.pipeline.events import Done
from active3d_pipe.pipeline.graph import Registry
from active3d_pipe.pipeline.run_dir import RunDir, new_manifest
from active3d_pipe.pipeline.runner import Runner
from active3d_pipe.pipeline.stage import NodeId
from tests.pipeline.toy import REGISTRY

SMALL = ("run.steps=10", "camera.height=8", "run.keep.every=1")  # three rounds: 4 + 4 + 2 steps


class Recorder:
    """A watcher that remembers everything."""

    def __init__(self) -> None:
        self.ran: list[tuple[str, str]] = []
        self.hits: list[str] = []
        self.lines: list[str] = []
        self.dones: list[Done] = []

    def began(self, node: NodeId, why: str) -> None:
        self.ran.append((str(node), why))

    def working(self, node: NodeId, text: str) -> None:
        pass

    def done(self, done: Done) -> None:
        self.dones.append(done)
        if done.seconds is None:
            self.hits.append(str(done.node))

    def say(self, text: str) -> None:
        self.lines.append(text)


def open_runner(path: Path, *overrides: str, registry: Registry = REGISTRY, write: bool = True) -> Runner:
    """A runner over `path` with the small configuration and `overrides` on top."""
    config = load_config(None, (*SMALL, *overrides), environ={})
    run_dir = RunDir.prepare(path)
    manifest = run_dir.manifest() if run_dir.exists else None
    if write:
        lineage = manifest.lineage if manifest else ()
        run_dir.write(resolve_toml(config), new_manifest(config.run.seed, config.run.threads, lineage))
    return Runner(run_dir, registry, config, Recorder())


def snapshot(path: Path) -> dict[str, bytes]:
    """Every committed byte of a run: all files of the stage folders, and the manifest."""
    return {
        p.relative_to(path).as_posix(): p.read_bytes()
        for p in sorted(path.rglob("*"))
        if p.is_file() and p.name not in ("journal.jsonl", "run.lock") and p.relative_to(path).parts[0] != "report"
    }


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A complete toy run; tests copy it."""
    path = tmp_path_factory.mktemp("runs") / "finished"
    open_runner(path).run()
    return path


@pytest.fixture
def run_path(finished: Path, tmp_path: Path) -> Path:
    """A private copy of a complete toy run."""
    import shutil

    path = tmp_path / "run"
    shutil.copytree(finished, path)
    return path


@pytest.fixture
def runner_of() -> Callable[..., Runner]:
    return open_runner
