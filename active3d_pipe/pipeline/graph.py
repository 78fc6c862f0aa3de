"""The unrolled loop: which nodes there are, and in which order they run."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from active3d_pipe.errors import ConfigError
from active3d_pipe.pipeline.nearest import did_you_mean
from active3d_pipe.pipeline.stage import NodeId, Stage


@dataclass(frozen=True, slots=True)
class Registry:
    """The stages of a pipeline in execution order: those of every round, then those that finish a run."""

    loop: tuple[Stage, ...]
    finish: tuple[Stage, ...]

    @property
    def stages(self) -> tuple[Stage, ...]:
        """All stages in execution order."""
        return (*self.loop, *self.finish)

    def stage(self, name: str) -> Stage:
        """The stage of that name; ConfigError names the nearest one."""
        for stage in self.stages:
            if stage.name == name:
                return stage
        names = [stage.name for stage in self.stages]
        raise ConfigError(f"{name!r} is no stage{did_you_mean(name, names)}; the stages are {', '.join(names)}")

    def rank(self, node: NodeId) -> tuple[int, int]:
        """Sort key of execution order."""
        position = [stage.name for stage in self.stages].index(node.stage)
        return (2**62 if node.round is None else node.round, position)

    def round_nodes(self, k: int) -> tuple[NodeId, ...]:
        """The nodes of round `k`."""
        return tuple(NodeId(stage.name, k) for stage in self.loop)

    def finish_nodes(self) -> tuple[NodeId, ...]:
        """The nodes that finish a run."""
        return tuple(NodeId(stage.name) for stage in self.finish)

    def nodes(self, last_round: int) -> Iterator[NodeId]:
        """Every node up to and including `last_round`, then the finishing ones."""
        for k in range(last_round + 1):
            yield from self.round_nodes(k)
        yield from self.finish_nodes()

    def inputs(self, node: NodeId, last_round: int, config: Any) -> tuple[NodeId, ...]:
        """The nodes that `node` reads when it is made with `config`."""
        stage, k = self.stage(node.stage), last_round if node.round is None else node.round
        extra = () if stage.extra_inputs is None else stage.extra_inputs(config, k)
        return (*stage.inputs(k), *extra)
