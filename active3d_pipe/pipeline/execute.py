"""Run one node and commit what it wrote; rebuild inputs that are pruned or damaged first."""

import errno
import json
import resource
import shutil
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from active3d_pipe.errors import Active3dError, ArtifactError, DiskError, InputError
from active3d_pipe.pipeline import files
from active3d_pipe.pipeline.events import Done, Watcher
from active3d_pipe.pipeline.journal import Journal
from active3d_pipe.pipeline.keys import canonical, digest
from active3d_pipe.pipeline.record import Record, damage, measure
from active3d_pipe.pipeline.stage import NodeId, Stage, StageContext
from active3d_pipe.pipeline.survey import Surveyor
from active3d_pipe.pipeline.threads import set_threads
from active3d_pipe.pipeline.versions import library_versions
from active3d_pipe.pipeline.view import ConfigView


class Executor:
    """Runs nodes of one run folder. The caller holds the run's lock."""

    def __init__(self, surveyor: Surveyor, journal: Journal, watcher: Watcher) -> None:
        self.surveyor = surveyor
        self.store = surveyor.store
        self.registry = surveyor.registry
        self.journal = journal
        self.watcher = watcher
        # Artifacts whose bytes this process wrote or has checked: they are not hashed again when they are read.
        self._trusted: set[NodeId] = set()

    def execute(self, node: NodeId, last_round: int, why: str) -> Record:
        """Run a node on the inputs that are on disk, commit, and return the new record."""
        inputs = self.surveyor.inputs(node, last_round)
        before = self._readable_record(node)
        self.provide(inputs, last_round)
        self.watcher.began(node, why)
        started = time.perf_counter()
        for attempt in (1, 2):
            parts = self.surveyor.parts(node, last_round)
            try:
                aside, context = self._run(node, parts, last_round)
                break
            except (ArtifactError, InputError):
                # A reader met damage that sizes did not show. Look closely, rebuild what is broken, try once more.
                self._trusted.difference_update(inputs)
                if attempt == 2 or not self.provide(inputs, last_round):
                    raise
        record = self._commit(node, aside, parts, context, time.perf_counter() - started)
        same = None if before is None else before.content == record.content
        seconds = time.perf_counter() - started
        self.watcher.done(Done(node, record.notes, record.size, seconds, same))
        return record

    def provide(self, nodes: Iterable[NodeId], last_round: int) -> int:
        """Make sure that the payload of `nodes` is there and whole; returns how many had to be rebuilt."""
        needed: dict[NodeId, str] = {}
        queue = list(nodes)
        while queue:
            node = queue.pop()
            if node in needed or node in self._trusted:
                continue
            why = self._lacks(node)
            if why is None:
                self._trusted.add(node)
                continue
            needed[node] = why
            queue += self.surveyor.inputs(node, last_round)
        for node in sorted(needed, key=self.registry.rank):
            self._rebuild(node, last_round, needed[node])
        return len(needed)

    def distrust(self, node: NodeId) -> None:
        """Look at the node's bytes again before they are read."""
        self._trusted.discard(node)
        self.surveyor.forget(node)

    def _lacks(self, node: NodeId) -> str | None:
        """Why the payload of a node cannot be read, or None; says damage aloud."""
        record = self._readable_record(node)
        if record is None:
            if not self.store.folder(node).exists():
                raise ArtifactError(
                    f"{self.store.folder(node)}: is missing; `active3d resume {self.store.root}` makes it"
                )
            wrong = ["its record is missing or damaged"]
        elif self.store.is_pruned(node):
            return "pruned"
        else:
            wrong = damage(self.store.folder(node), record, deep=True)
        if not wrong:
            return None
        more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
        self.watcher.say(f"{node} is damaged: {wrong[0]}{more}; it is made again from its inputs")
        return "damaged"

    def _rebuild(self, node: NodeId, last_round: int, why: str) -> None:
        recorded = self._readable_record(node)
        parts = self.surveyor.parts(node, last_round)
        if why == "pruned" and recorded is not None and digest(parts) != recorded.key:
            raise ArtifactError(
                f"{node} was pruned, and what it is made from changed since; `active3d resume {self.store.root}` makes "
                "everything up to date"
            )
        self.watcher.began(node, f"{why}, needed again")
        started = time.perf_counter()
        aside, context = self._run(node, parts, last_round)
        record = self._record(node, aside, parts, context)
        if recorded is not None and recorded.key == record.key and recorded.content == record.content:
            record = recorded  # the very bytes that were committed, whatever library made them this time
        elif recorded is not None and why == "pruned":
            self.store.discard(aside)
            changed = [name for name in recorded.files if record.files.get(name) != recorded.files[name]]
            raise ArtifactError(
                f"{node}: rebuilding it gave other bytes in {', '.join(changed[:3]) or 'its notes'} than were recorded "
                f"({_version_change(recorded, record)}); `active3d run-stage {node.stage} --round {node.round} "
                "--force` accepts the new ones"
            )
        elif recorded is not None:
            self.watcher.say(f"{node}: rebuilt with other content than was recorded; what follows is made again")
        seconds = time.perf_counter() - started
        self._store(node, aside, record, context, seconds, "rebuild" if record is recorded else "commit")
        self.watcher.done(Done(node, record.notes, record.size, seconds, record is recorded))

    def _run(self, node: NodeId, parts: dict[str, Any], last_round: int) -> tuple[Path, StageContext]:
        stage = self.registry.stage(node.stage)
        aside = self.store.begin(node)
        try:
            context = self._context(stage, node, parts, last_round, aside)
            set_threads(parts["threads"])
            stage.run(context)
            context.notes = _plain(context.notes, stage)
        except BaseException as error:
            shutil.rmtree(aside, ignore_errors=True)
            if isinstance(error, Active3dError):
                raise
            if isinstance(error, OSError):
                raise _explain(error, aside) from error
            if isinstance(error, Exception) and "no space left" in str(error).lower():
                raise files.explain(OSError(errno.ENOSPC, "no space"), aside) from error
            raise
        return aside, context

    def _context(self, stage: Stage, node: NodeId, parts: dict[str, Any], last_round: int, out: Path) -> StageContext:
        inputs = {name: self.store.folder(name) for name in self.surveyor.inputs(node, last_round)}
        seconds: dict[NodeId, dict[str, float]] = {}
        if node.round is None:
            seconds = {name: {"total": s.seconds, **s.timings} for name, s in self.journal.spent().items()}
        return StageContext(
            node=node, last_round=last_round if node.round is None else node.round, inputs=inputs, out=out,
            config=ConfigView(self.surveyor.config_of(node), stage), parameters=dict(parts["parameters"]),
            seed=parts["seed"], threads=parts["threads"],
            progress=lambda text: self.watcher.working(node, text), runs_seconds=seconds,
        )

    def _record(self, node: NodeId, aside: Path, parts: dict[str, Any], context: StageContext) -> Record:
        with files.writing(aside):
            entries = measure(aside)
        return Record(node, digest(parts), parts, entries, context.notes, library_versions())

    def _commit(
        self, node: NodeId, aside: Path, parts: dict[str, Any], context: StageContext, seconds: float
    ) -> Record:
        record = self._record(node, aside, parts, context)
        self._store(node, aside, record, context, seconds)
        return record

    def _store(
        self, node: NodeId, aside: Path, record: Record, context: StageContext, seconds: float, event: str = "commit"
    ) -> None:
        try:
            self.store.commit(aside, record)
        except DiskError:
            shutil.rmtree(aside, ignore_errors=True)
            raise
        self.surveyor.forget(node)
        self._trusted.add(node)
        self.journal.append(
            event, node=str(node), key=record.key, content=record.content, bytes=record.size,
            seconds=round(seconds, 4), timings={name: round(float(s), 4) for name, s in context.timings.items()},
            peak_memory_mb=round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        )

    def _readable_record(self, node: NodeId) -> Record | None:
        try:
            return self.surveyor.record(node)
        except ArtifactError:
            return None


def _explain(error: OSError, aside: Path) -> Active3dError:
    """An OSError inside a stage: of its output folder, or of something that it reads."""
    name = str(error.filename or aside)
    if error.errno == errno.ENOENT and not name.startswith(str(aside)):
        return ArtifactError(f"{name}: is missing; `active3d verify` tells what else is")
    return files.explain(error, aside)


def _plain(notes: dict[str, Any], stage: Stage) -> dict[str, Any]:
    try:
        return dict(json.loads(canonical(notes)))
    except (TypeError, ValueError) as error:
        raise RuntimeError(f"stage {stage.name!r} leaves notes that are no plain JSON values: {error}") from error


def _version_change(old: Record, new: Record) -> str:
    known = sorted({*old.versions, *new.versions})
    names = [name for name in known if old.versions.get(name) != new.versions.get(name)]
    if not names:
        return "the libraries are the same: another machine, or the artifact was not deterministic"
    return ", ".join(f"{name} {old.versions.get(name)} -> {new.versions.get(name)}" for name in names[:3])
