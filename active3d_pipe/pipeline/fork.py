"""Another future from the same past: a new run that begins with another run's rounds 0..k."""

import os
import shutil
from pathlib import Path
from typing import Any

from active3d_pipe.errors import ArtifactError, ConfigError, OutputError
from active3d_pipe.pipeline import files
from active3d_pipe.pipeline.lock import RunLock
from active3d_pipe.pipeline.record import PRUNED
from active3d_pipe.pipeline.run_dir import Inherited, RunDir, new_manifest
from active3d_pipe.pipeline.runner import Runner
from active3d_pipe.pipeline.stage import NodeId


def fork(parent: Runner, round: int, target: Path, config: Any, toml: str) -> RunDir:
    """Make `target` a run that inherits rounds 0..`round` of `parent` and goes on with `config`.

    Files are hard-linked where the file system can (artifacts are never written to), else copied. The inherited
    rounds stay up to date although `config` differs: the manifest remembers what they were made with.
    """
    last = parent.last_whole_round()
    if not 0 <= round <= last:
        have = f"0 to {last}" if last >= 0 else "none that is complete"
        raise ConfigError(f"--round {round}: {parent.run_dir.path} has rounds {have}")
    run_dir = RunDir.prepare(target, may_hold=[stage.name for stage in parent.registry.loop])
    if run_dir.exists:
        raise OutputError(f"{target}: is a run already; choose a new folder with --to")
    lineage = [past for past in parent.run_dir.manifest().lineage if past.until_round < round]
    made_with = parent.surveyor.config_of(NodeId(parent.registry.loop[0].name, round))
    lineage.append(Inherited(round, made_with.model_dump(mode="json")))
    with RunLock(parent.run_dir.path), RunLock(target):
        for text in run_dir.store.clean():
            parent.watcher.say(text)
        for k in range(round + 1):
            for node in parent.registry.round_nodes(k):
                _link(parent, node, run_dir)
        # The manifest comes last: until then the folder is no run, and the command can be given again.
        manifest = new_manifest(config.run.seed, config.run.threads, tuple(lineage))
        run_dir.journal.append("fork", source=str(parent.run_dir.path.resolve()), round=round)
        run_dir.write(toml, manifest)
    return run_dir


def _link(parent: Runner, node: NodeId, run_dir: RunDir) -> None:
    source = parent.run_dir.store.folder(node)
    record = parent.run_dir.store.record(node)
    if record is None:
        raise ArtifactError(f"{source}: is missing; `active3d resume {parent.run_dir.path}` makes it")
    if _is_linked(run_dir, node, record.content):
        return  # an earlier, interrupted call came this far
    aside = run_dir.store.begin(node)
    names = [PRUNED] if parent.run_dir.store.is_pruned(node) else list(record.files)
    with files.writing(aside):
        for name in names:
            target = aside / name
            target.parent.mkdir(parents=True, exist_ok=True)
            _link_or_copy(source / name, target)
    run_dir.store.commit(aside, record)
    run_dir.journal.append(
        "commit", node=str(node), key=record.key, content=record.content, bytes=record.size, seconds=0.0, timings={},
        inherited=True,
    )


def _is_linked(run_dir: RunDir, node: NodeId, content: str) -> bool:
    try:
        there = run_dir.store.record(node)
    except ArtifactError:
        return False
    return there is not None and there.content == content


def _link_or_copy(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:
        try:
            shutil.copyfile(source, target)
        except FileNotFoundError:
            raise ArtifactError(f"{source}: is missing; `active3d resume` of that run makes it again") from None
