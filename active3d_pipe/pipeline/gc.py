"""Free disk space by the stated policy `run.keep`."""

from dataclasses import dataclass

from active3d_pipe.pipeline.files import list_files
from active3d_pipe.pipeline.lock import RunLock
from active3d_pipe.pipeline.runner import Runner
from active3d_pipe.pipeline.stage import NodeId
from active3d_pipe.pipeline.status import beyond


@dataclass(frozen=True, slots=True)
class Freed:
    """One artifact whose payload went: `pruned` keeps its record, `removed` keeps nothing."""

    node: NodeId
    bytes: int
    how: str


def gc(runner: Runner, dry_run: bool = False) -> list[Freed]:
    """Prune what the policy does not keep, and remove what lies beyond the end of the loop.

    A pruned artifact is made again, to the same bytes, when something needs it.
    """
    if dry_run:
        return _candidates(runner)
    with RunLock(runner.run_dir.path):
        for text in runner.run_dir.store.clean():
            runner.watcher.say(text)
        freed = _candidates(runner)
        records = {record.node: record for record in runner.prunable(runner.last_round())}
        for item in freed:
            if item.how == "pruned":
                runner.prune(records[item.node])
            else:
                runner.run_dir.store.remove(item.node)
                runner.run_dir.journal.append("remove", node=str(item.node), bytes=item.bytes)
    return freed


def _candidates(runner: Runner) -> list[Freed]:
    surplus = beyond(runner)
    freed = [Freed(r.node, r.size, "pruned") for r in runner.prunable(runner.last_round()) if r.node not in surplus]
    for node in surplus:
        size = sum(path.lstat().st_size for path in list_files(runner.run_dir.store.folder(node)))
        freed.append(Freed(node, size, "removed"))
    return freed
