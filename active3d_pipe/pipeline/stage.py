"""What a stage is. The pipeline knows stages only through this page; it knows no 3D."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import numpy as np


class NodeId(NamedTuple):
    """One node of the unrolled loop: a stage at a round, or a finishing stage (round None)."""

    stage: str
    round: int | None = None

    def __str__(self) -> str:
        return self.stage if self.round is None else f"{self.stage}/round_{self.round:04d}"


@dataclass(slots=True)
class StageContext:
    """All that a stage may see while it runs.

    Attributes:
        node: which node runs.
        last_round: the last round of the loop (finishing stages), else the node's own round.
        inputs: folder of every committed input artifact.
        out: empty folder to write into; it becomes the artifact when `run` returns.
        config: the sections of the configuration that the stage declared; reading any other raises.
        parameters: what the stage's `parameters` hook returned.
        seed: seed of this node, derived from (run seed, stage, round).
        threads: number of threads that numeric libraries use.
        progress: call with a short text while long work goes on.
        notes: numbers and flags for the record, the status line and the loop (`steps`, `stop`, ...);
            JSON values, deterministic.
        timings: seconds by module; they go to the journal, never into the artifact.
        runs_seconds: for finishing stages, the seconds of every committed node, from the journal.
    """

    node: NodeId
    last_round: int
    inputs: Mapping[NodeId, Path]
    out: Path
    config: Any
    parameters: dict[str, Any]
    seed: int
    threads: int
    progress: Callable[[str], None]
    notes: dict[str, Any] = field(default_factory=dict)
    timings: dict[str, float] = field(default_factory=dict)
    runs_seconds: Mapping[NodeId, dict[str, float]] = field(default_factory=dict)

    @property
    def round(self) -> int:
        """The node's round; for finishing stages the last one."""
        return self.last_round if self.node.round is None else self.node.round

    def input(self, stage: str, round: int | None = None) -> Path:
        """Folder of an input artifact; KeyError if the stage did not declare it."""
        return self.inputs[NodeId(stage, round)]

    def rng(self, purpose: str) -> "np.random.Generator":
        """A generator of this node for one purpose; the same on every run."""
        import numpy as np  # not before the number of its threads is set

        words = [int.from_bytes(purpose.encode()[i : i + 4], "little") for i in range(0, len(purpose), 4)]
        return np.random.default_rng(np.random.SeedSequence([self.seed, *words]))


@dataclass(frozen=True, slots=True)
class Stage:
    """A stage of the pipeline.

    Attributes:
        name: stage = room = verb = artifact folder.
        version: raise it when the stage's output changes for the same inputs and configuration.
        config: dotted sections of the configuration that it reads; they enter its key.
        inputs: the nodes it reads, given its round (loop) or the last round (finish).
        run: reads `context.inputs`, writes into `context.out`.
        loop: True for the stages of a round, False for the finishing ones.
        parameters: values derived from the whole configuration and the input folders that enter the key
            (digest of the scene file, effective step limit); called before `run` and before a key is known.
        extra_inputs: further nodes that it reads, given the configuration and its round; they enter the key like the
            others.
        unkeyed: dotted settings of those sections that enter the key only through `parameters` (of a file's path, what
            matters is the digest of the file).
        volatile: True when the output holds wall-clock times and so differs between equal runs.
    """

    name: str
    version: int
    config: tuple[str, ...]
    inputs: Callable[[int], tuple[NodeId, ...]]
    run: Callable[[StageContext], None]
    loop: bool
    parameters: Callable[[Any, Mapping[NodeId, Path]], dict[str, Any]] | None = None
    volatile: bool = False
    unkeyed: tuple[str, ...] = ()
    extra_inputs: Callable[[Any, int], tuple[NodeId, ...]] | None = None
