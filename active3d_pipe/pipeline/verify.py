"""Is every committed byte still what was committed?"""

from dataclasses import dataclass
from pathlib import Path

from active3d_pipe.errors import ArtifactError
from active3d_pipe.pipeline.commit import OLD, TMP
from active3d_pipe.pipeline.journal import spent
from active3d_pipe.pipeline.record import PRUNED, RECORD, damage
from active3d_pipe.pipeline.runner import Runner
from active3d_pipe.pipeline.stage import NodeId


@dataclass(frozen=True, slots=True)
class Verified:
    """What `verify` looked at, and one line for each damage; `remarks` are harmless."""

    artifacts: int
    files: int
    bytes: int
    damage: tuple[str, ...]
    remarks: tuple[str, ...]


def verify(runner: Runner, deep: bool) -> Verified:
    """Check every artifact: records and sizes, and with `deep` the digest of every file. Changes nothing."""
    store, registry = runner.run_dir.store, runner.registry
    events, torn = runner.run_dir.journal.read()
    remarks = [f"journal.jsonl: {torn} line(s) torn by a crash"] if torn else []
    found: list[str] = []
    artifacts = files = size = 0
    newest = {str(e.get("node")): e["event"] for e in events if e["event"] in ("commit", "remove")}
    expected = {node for node in spent(events) if newest[str(node)] == "commit"}
    on_disk = {NodeId(s.name, k) for s in registry.loop for k in store.rounds(s.name)}
    on_disk |= {node for node in registry.finish_nodes() if store.folder(node).exists()}
    known = {stage.name for stage in registry.stages}
    for node in sorted((expected | on_disk), key=lambda n: (n.round is None, n.round or 0, n.stage)):
        folder = store.folder(node)
        if node.stage not in known:
            remarks.append(f"{node}: belongs to a stage that is not installed")
            continue
        if not folder.exists():
            found.append(f"{node}: is missing")
            continue
        try:
            record = store.record(node)
        except ArtifactError as error:
            found.append(str(error))
            continue
        if record is None:
            found.append(f"{node}: has no {RECORD}")
            continue
        artifacts += 1
        if store.is_pruned(node):
            found += _check_mark(folder, node, record.content)
            continue
        files, size = files + len(record.files), size + record.size
        found += [f"{node}: {wrong}" for wrong in damage(folder, record, deep)]
    remarks += [f"{name}: unfinished, the next run removes it" for name in _leftovers(runner.run_dir.path)]
    return Verified(artifacts, files, size, tuple(found), tuple(remarks))


def _check_mark(folder: Path, node: NodeId, content: str) -> list[str]:
    try:
        text = (folder / PRUNED).read_text("ascii")
    except (OSError, UnicodeDecodeError) as error:
        return [f"{node}: {PRUNED} cannot be read ({type(error).__name__})"]
    wrong = [] if f'"content": "{content}"' in text and text.startswith("{") else [f"{node}: {PRUNED} is damaged"]
    names = sorted(path.name for path in folder.iterdir() if path.name not in (PRUNED, RECORD))
    return wrong + [f"{node}: {name} does not belong to a pruned artifact" for name in names]


def _leftovers(root: Path) -> list[str]:
    folders = [root, *(p for p in sorted(root.iterdir()) if p.is_dir())]
    return [
        path.relative_to(root).as_posix()
        for folder in folders if not folder.name.startswith(".")
        for path in sorted(folder.iterdir()) if path.name.startswith((TMP, OLD))
    ]
