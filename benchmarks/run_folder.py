"""A finished run folder, opened for a benchmark: configuration, frames, map, ground truth. Nothing is written."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from active3d_pipe.pipeline.config import Config, load_run_config
from active3d_pipe.pipeline.stage import NodeId
from active3d_pipe.storage import meshes
from stages import shared

if TYPE_CHECKING:
    from active3d_pipe.evaluation.geometry_metrics import TruthSurface
    from active3d_pipe.mapping.hybrid_map import HybridMap
    from active3d_pipe.sim.simulator import Simulator
    from active3d_pipe.structures import Frame, TriangleMesh


@dataclass(frozen=True)
class FinishedRun:
    """Reads what it is asked for, once; `settings` are `a.b=value` texts on top of the run's own."""

    path: Path
    settings: tuple[str, ...] = ()

    @cached_property
    def config(self) -> Any:
        return load_run_config(self.path / "run.toml", Config, self.settings)

    @cached_property
    def last_round(self) -> int:
        return len(sorted((self.path / "capture").glob("round_*/capture.json"))) - 1

    @cached_property
    def inputs(self) -> dict[NodeId, Path]:
        return {n: self.path / "capture" / f"round_{n.round:04d}" for n in shared.captures(self.last_round)}

    @cached_property
    def frames(self) -> "list[Frame]":
        return [f for folder in self.inputs.values() for f in shared.load_frames(folder)]

    @cached_property
    def map(self) -> "HybridMap":
        return shared.load_map(self.path / "export", self.inputs, self.config, to_train=False)

    @cached_property
    def mesh(self) -> "TriangleMesh":
        return meshes.read_mesh(self.path / "export" / "mesh.ply")

    @cached_property
    def simulator(self) -> "Simulator":
        return shared.make_simulator(self.config, self.config.run.seed)

    def held_out(self, views: int | None = None) -> "list[Frame]":
        """The held-out views of the evaluation, or so many of them, ground truth included."""
        from active3d_pipe.sim.observable import held_out_poses

        settings, scene = self.config.evaluation, self.simulator.scene
        poses = held_out_poses(
            self.simulator, views or settings.num_views, scene.name, min_clearance_m=settings.view_clearance_m
        )
        return [self.simulator.render(T, step=i) for i, T in enumerate(poses)]

    def truth(self, *, floors: bool = True) -> "TruthSurface":
        """The true surface, prepared as the evaluation does."""
        from active3d_pipe.evaluation.geometry_metrics import prepare_truth

        return prepare_truth(self.simulator.scene.surface, self.config.evaluation, self.observable, floors=floors)

    def observable(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool, whether a reachable pose can see each point; the same draw as in the evaluation."""
        from active3d_pipe.sim.observable import observable_points

        rng, motion = np.random.default_rng(self.config.evaluation.seed), self.config.motion
        return observable_points(self.simulator, points, rng, radius_m=motion.agent_radius_m, planar=motion.planar)
