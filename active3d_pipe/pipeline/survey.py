"""The state of every node, from the disk alone: up to date, stale, missing, pruned, damaged, and why."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from active3d_pipe.errors import Active3dError, ArtifactError
from active3d_pipe.pipeline.commit import ArtifactStore
from active3d_pipe.pipeline.graph import Registry
from active3d_pipe.pipeline.keys import differences, digest, key_parts, node_seed
from active3d_pipe.pipeline.record import Record, damage
from active3d_pipe.pipeline.stage import NodeId, Stage
from active3d_pipe.pipeline.view import subset


class State(StrEnum):
    """What is known of a node without running anything."""

    FRESH = "up to date"
    PRUNED = "pruned"  # up to date, but only the record is kept
    STALE = "stale"
    MISSING = "missing"
    DAMAGED = "damaged"
    UNKNOWN = "unknown"  # its key cannot be computed (the scene file is gone, say)

    @property
    def is_hit(self) -> bool:
        """Whether nothing needs to run."""
        return self in (State.FRESH, State.PRUNED)


@dataclass(frozen=True, slots=True)
class NodeState:
    """A node's state, the reasons for it, its record if one can be read, and the parts of its present key."""

    node: NodeId
    state: State
    reasons: tuple[str, ...] = ()
    record: Record | None = None
    parts: dict[str, Any] | None = None


class Surveyor:
    """Finds the state of nodes; remembers records and configuration subsets, forgets them on `forget`."""

    def __init__(
        self, store: ArtifactStore, registry: Registry, config: Any, lineage: Iterable[tuple[int, Any]]
    ) -> None:
        self.store = store
        self.registry = registry
        self._config = config
        self._lineage = sorted(lineage, key=lambda past: past[0])
        self._subsets: dict[tuple[str, int], dict[str, Any]] = {}
        self._contents: dict[NodeId, tuple[Record, str]] = {}
        self._whole: set[NodeId] = set()

    def config_of(self, node: NodeId) -> Any:
        """The configuration that a node is made with: that of its ancestor run for inherited rounds."""
        if node.round is not None:
            for until_round, config in self._lineage:
                if node.round <= until_round:
                    return config
        return self._config

    def inputs(self, node: NodeId, last_round: int) -> tuple[NodeId, ...]:
        """The nodes that `node` reads with the configuration that it is made with."""
        return self.registry.inputs(node, last_round, self.config_of(node))

    @property
    def inherited_rounds(self) -> int:
        """Number of leading rounds that come from another run."""
        return self._lineage[-1][0] + 1 if self._lineage else 0

    def record(self, node: NodeId) -> Record | None:
        """The node's record, read once; ArtifactError when damaged."""
        known = self._contents.get(node)
        if known is not None:
            return known[0]
        record = self.store.record(node)
        if record is not None:
            self._contents[node] = (record, record.content)
        return record

    def content(self, node: NodeId) -> str:
        """Content digest of a committed node."""
        if self.record(node) is None:
            raise ArtifactError(f"{self.store.folder(node)}: is missing; `active3d resume` makes it")
        return self._contents[node][1]

    def forget(self, node: NodeId) -> None:
        """Read the node's record again next time."""
        self._contents.pop(node, None)
        self._whole.discard(node)

    def last_round_on_disk(self) -> int:
        """The highest round of which anything exists, or -1."""
        return max((max(self.store.rounds(stage.name), default=-1) for stage in self.registry.loop), default=-1)

    def parts(self, node: NodeId, last_round: int) -> dict[str, Any]:
        """The parts of a node's key, its inputs taken as they are on disk."""
        stage, config = self.registry.stage(node.stage), self.config_of(node)
        inputs = self.inputs(node, last_round)
        contents = {name: self.content(name) for name in inputs}
        return key_parts(
            stage, node_seed(config.run.seed, node), config.run.threads, self._subset(stage, config),
            self._parameters(node, stage, config, {name: self.store.folder(name) for name in inputs}), contents,
        )

    def assess(self, node: NodeId, last_round: int, *, deep: bool = False) -> NodeState:
        """The state of one node, its inputs taken as they are on disk.

        With `deep`, every byte is hashed once before the node counts as up to date: damage that leaves sizes as they
        were is found too, and before anything (a stage's `parameters` hook, say) reads it.
        """
        try:
            record = self.record(node)
        except ArtifactError as error:
            return NodeState(node, State.DAMAGED, (str(error),))
        if record is not None and deep and node not in self._whole and not self.store.is_pruned(node):
            wrong = damage(self.store.folder(node), record, deep=True)
            if wrong:
                return NodeState(node, State.DAMAGED, tuple(wrong), record)
            self._whole.add(node)
        try:
            parts = self.parts(node, last_round)
        except Active3dError as error:
            return NodeState(node, State.UNKNOWN, (str(error),), record)
        if record is None:
            return NodeState(node, State.MISSING, ("not made yet",), None, parts)
        if record.key != digest(parts):
            reasons = tuple(differences(record.parts, parts)) or ("its key changed",)
            return NodeState(node, State.STALE, reasons, record, parts)
        if self.store.is_pruned(node):
            return NodeState(node, State.PRUNED, (), record, parts)
        wrong = damage(self.store.folder(node), record, deep=False)
        return NodeState(node, State.DAMAGED if wrong else State.FRESH, tuple(wrong), record, parts)

    def survey(self, last_round: int) -> dict[NodeId, NodeState]:
        """The state of every node up to `last_round` and of the finishing ones, in execution order.

        What follows something that must be made again is stale, for its key cannot be known yet.
        """
        found: dict[NodeId, NodeState] = {}
        for node in self.registry.nodes(last_round):
            waiting = [name for name in self.inputs(node, last_round) if not _is_hit(found, name)]
            if waiting:
                found[node] = self._follower(node, waiting[0])
            else:
                found[node] = self.assess(node, last_round)
        return found

    def _follower(self, node: NodeId, cause: NodeId) -> NodeState:
        try:
            record = self.record(node)
        except ArtifactError as error:
            return NodeState(node, State.DAMAGED, (str(error),))
        state = State.MISSING if record is None else State.STALE
        return NodeState(node, state, (f"follows {cause}",), record)

    def _subset(self, stage: Stage, config: Any) -> dict[str, Any]:
        name = (stage.name, id(config))
        if name not in self._subsets:
            self._subsets[name] = subset(config, stage.config, stage.unkeyed)
        return self._subsets[name]

    def _parameters(
        self, node: NodeId, stage: Stage, config: Any, folders: Mapping[NodeId, Path]
    ) -> dict[str, Any]:
        if stage.parameters is None:
            return {}
        try:
            return stage.parameters(config, folders)
        except (Active3dError, OSError, ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
            # A pruned input cannot be asked; what was true when the artifact was made still is, for inputs enter
            # the key by their digest.
            record = self.record(node)
            if record is not None and any(self.store.is_pruned(name) for name in folders):
                return dict(record.parts["parameters"])
            if isinstance(error, Active3dError) or not folders:
                raise
            raise ArtifactError(
                f"{node}: what it is made from cannot be read ({type(error).__name__}: {error}); `active3d verify "
                f"--deep {self.store.root}` names the damage, `active3d resume {self.store.root}` makes it again"
            ) from error


def _is_hit(found: Mapping[NodeId, NodeState], node: NodeId) -> bool:
    return node in found and found[node].state.is_hit
