"""What a policy sees: the volume, the poses walked, the motion limits, the map if it asks for it. No ground truth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np

from active3d_pipe.errors import ConfigError, InputError
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.free_space import FreeSpace, build_free_space
from active3d_pipe.planning.reward import RewardField, build_reward_field
from active3d_pipe.structures import Camera, Decision, Frame, GaussianModel, UncertaintyVolume
from active3d_pipe.structures.frame import check_pose
from active3d_pipe.structures.motion import MotionSettings

if TYPE_CHECKING:
    from active3d_pipe.gaussians.config import GaussianSettings
    from active3d_pipe.gaussians.rasteriser import RenderedView
    from active3d_pipe.mapping.hybrid_map import HybridMap


class MapView:
    """The map of this round, to be looked at only. It is read from disk when something of it is asked for first.

    Args:
        load: returns a map that nobody else uses.
    """

    def __init__(self, load: "Callable[[], HybridMap]") -> None:
        self._load = load

    @cached_property
    def _hybrid(self) -> "HybridMap":
        return self._load()

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> "RenderedView":
        """The Gaussians seen from a pose: rgb (H, W, 3) 0..1, depth (H, W) m (0 where alpha < 0.5), alpha (H, W)."""
        return self._hybrid.render(camera, T_world_camera)

    def query_sdf(self, points_world: np.ndarray) -> np.ndarray:
        """(N,) float32 signed distance of the field, m, cut at +-truncation."""
        return self._hybrid.field.query_sdf(points_world)

    def query_geometry(self, points_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(sdf, sigma) of the field and its uncertainty head, (N,) float32 m each."""
        return self._hybrid.field.query_geometry(points_world)

    def normals(self, points_world: np.ndarray) -> np.ndarray:
        """(N, 3) float32 unit gradients of the field's SDF; zero where it is flat."""
        return self._hybrid.field.normals(points_world)

    @cached_property
    def gaussians(self) -> GaussianModel:
        """The explicit branch (a copy)."""
        return self._hybrid.gaussians.to_model()

    @property
    def gaussian_settings(self) -> "GaussianSettings":
        """How the Gaussians are rendered."""
        return self._hybrid.settings.gaussians

    @property
    def keyframes(self) -> Sequence[Frame]:
        """The observed frames that the map was made of, oldest first."""
        return tuple(k.frame for k in self._hybrid.keyframes)

    @property
    def keyframe_poses(self) -> np.ndarray:
        """(K, 4, 4) T_world_camera of the keyframes."""
        return np.array([k.frame.T_world_camera for k in self._hybrid.keyframes]).reshape(-1, 4, 4)

    def perturbed_sdf(
        self, points_world: np.ndarray, samples: int, rng: np.random.Generator, *, decoder_only: bool
    ) -> np.ndarray:
        """(samples, N) float32 SDF, m, of fields whose parameters differ by a random vector of unit norm.

        `decoder_only`: only the geometry decoder and the layer before it are perturbed, not the feature tables.
        """
        field = self._hybrid.field
        state = field.state()
        tables = ("planes", "grid")
        decoder = ("blob_weight", "feature_weight", "bias", "geometry_weight", "geometry_bias")
        names = [name for name in (decoder if decoder_only else (*decoder, *tables)) if name in state]
        if not names:
            raise ConfigError("planning.policy: it perturbs the weights of a neural field, mapping.geometry has none")
        out = np.empty((samples, len(points_world)), np.float32)
        try:
            for i in range(samples):
                noise = {name: rng.standard_normal(state[name].shape, dtype=np.float32) for name in names}
                norm = np.sqrt(sum(float((n.astype(np.float64) ** 2).sum()) for n in noise.values()))
                field.load_state({**state, **{name: state[name] + n / np.float32(norm) for name, n in noise.items()}})
                out[i] = field.query_sdf(points_world)
        finally:
            field.load_state(state)
        return out


@dataclass(frozen=True, eq=False)
class PolicyContext:
    """All that a policy may use for one decision.

    Attributes:
        volume: what is known, on the grid, after the newest round.
        walked_poses: (N, 4, 4) every pose captured so far, oldest first; the last one is the current pose.
        camera: its field of view and range; the resolution does not matter.
        motion: limits that `planning.path.step_path` keeps.
        settings: the section `planning`; free space, clearance and round length are the same for every policy.
        rng: the only source of randomness.
        previous: the decision before this one. What a policy wants to remember it writes into `Decision.terms`.
        map: the map, for policies with `needs_map`, else None.
        recorded: (M, 4, 4) poses of `planning.trajectory`, else None.
    """

    volume: UncertaintyVolume
    walked_poses: np.ndarray
    camera: Camera
    motion: MotionSettings
    settings: PlanningSettings
    rng: np.random.Generator
    previous: Decision | None = None
    map: MapView | None = None
    recorded: np.ndarray | None = None

    def __post_init__(self) -> None:
        poses = np.asarray(self.walked_poses, dtype=np.float64).reshape(-1, 4, 4)
        object.__setattr__(self, "walked_poses", poses)
        check_pose(poses[-1], "current pose")
        grid = self.volume.grid
        if not grid.contains_index(grid.index_of(poses[-1, :3, 3])):
            raise InputError(
                f"current position {poses[-1, :3, 3].round(2).tolist()} lies outside the volume "
                f"{grid.low.round(2).tolist()} .. {grid.high.round(2).tolist()}; enlarge the bounds"
            )

    @property
    def T_world_camera(self) -> np.ndarray:
        """(4, 4) current pose."""
        return self.walked_poses[-1]

    @property
    def reach_m(self) -> float:
        """How far a view is expected to see, m."""
        return min(self.settings.max_range_m, self.camera.far)

    def free_space(self, *, relaxed: bool = False) -> FreeSpace:
        """Known-free space seen from the current pose; the same for every policy."""
        return self._relaxed_space if relaxed else self._strict_space

    @cached_property
    def _strict_space(self) -> FreeSpace:
        return self._space(False)

    @cached_property
    def _relaxed_space(self) -> FreeSpace:
        return self._space(True)

    def _space(self, relaxed: bool) -> FreeSpace:
        walked = self.walked_poses[:, :3, 3]
        return build_free_space(
            self.volume, self.T_world_camera, walked, self.motion, self.settings, relaxed=relaxed
        )

    @cached_property
    def reward_field(self) -> RewardField:
        """What eq. nbv_reward would make of views: every decision is also reported on this common scale."""
        return build_reward_field(self.volume, self.walked_poses, self.camera, self.settings)

    @property
    def the_map(self) -> MapView:
        """The map; InputError when the policy did not say that it needs one."""
        if self.map is None:
            raise InputError("this policy looks at the map: set `needs_map = True` in its class")
        return self.map


class Policy(Protocol):
    """Anything that decides. `ViewPolicy` (base.py) is what most policies are made of."""

    needs_map: bool

    def decide(self, context: PolicyContext) -> Decision:
        """Where to go and look next, or stop; same context, same bytes."""
        ...
