"""Where the agent may go: known-free space, clearance, and what of it can be reached."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from active3d_pipe.planning import kernels_distance as kernels
from active3d_pipe.planning import kernels_volumes
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.risk_field import RiskField, build_risk_field, joint_occupancy
from active3d_pipe.structures.motion import MotionSettings
from active3d_pipe.structures.uncertainty_volume import UncertaintyVolume
from active3d_pipe.structures.voxel_grid import VoxelGrid

UNREACHABLE = 1e29
# What an agent in a tight spot keeps at least, m.
LEAST_ESCAPE_M = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class FreeSpace:
    """Known-free space seen from the current pose.

    Attributes:
        risk: the risk field (owns the grid, the clearance and the joint occupancy).
        free: (X, Y, Z) bool, known to be free.
        checked_m: (X, Y, Z) float32, the clearance that paths are checked against: that of the risk field, but 0
            near a tight start where something solid is too close.
        passable: (X, Y, Z) bool, the agent's centre may be in this voxel.
        moves: (X, Y, Z) int32 bits, the neighbours that it may go on to (`kernels_distance.open_moves`).
        start: (3,) int64 voxel of the agent.
        required_m: clearance that `passable` demands away from the start.
        escape_m: clearance that it demands near the start; smaller when the agent stands in a tight spot.
        cost: (X, Y, Z) float32 geodesic cost from the start, metres weighted by risk; 1e30 = unreachable.
        parent: (X, Y, Z) int32 flat id of the predecessor on the cheapest way from the start.
        planar: motion is confined to the layer of the start voxel.
    """

    risk: RiskField
    free: np.ndarray
    checked_m: np.ndarray
    passable: np.ndarray
    moves: np.ndarray
    start: np.ndarray
    required_m: float
    escape_m: float
    cost: np.ndarray
    parent: np.ndarray
    planar: bool

    @property
    def grid(self) -> VoxelGrid:
        """The voxel grid."""
        return self.risk.grid

    @property
    def reachable(self) -> np.ndarray:
        """(X, Y, Z) bool."""
        return self.cost < UNREACHABLE

    def grid_path(self, goal: np.ndarray) -> np.ndarray:
        """(N, 3) int64 voxels of the cheapest way from the start to the reachable voxel `goal`, both included."""
        flat = self.parent.ravel()
        v = int(np.ravel_multi_index(tuple(int(c) for c in goal), self.grid.shape))
        ids = [v]
        while flat[v] >= 0:
            v = int(flat[v])
            ids.append(v)
        return np.stack(np.unravel_index(ids[::-1], self.grid.shape), axis=-1)


    def moved_to(self, voxel: np.ndarray, settings: PlanningSettings, longest: float) -> "FreeSpace":
        """The same space seen from another reachable voxel; costs up to `longest` only.

        A small clearance is accepted where the agent already is, not where it will begin its next way.
        """
        cost, parent = _geodesic(self.risk, self.moves, voxel, settings, longest)
        start = np.asarray(voxel, dtype=np.int64)
        return replace(self, start=start, cost=cost, parent=parent, escape_m=self.required_m)


def _geodesic(
    risk: RiskField, moves: np.ndarray, start: np.ndarray, settings: PlanningSettings, longest: float
) -> tuple[np.ndarray, np.ndarray]:
    rate = (1 + np.float32(settings.lambda_risk) * risk.risk).astype(np.float32)
    return kernels.geodesic(
        moves, rate, np.asarray(start, dtype=np.int64), np.float32(risk.grid.voxel_size), np.float32(longest)
    )


def known_free(
    volume: UncertaintyVolume, occupancy: np.ndarray, walked: np.ndarray, radius_m: float, settings: PlanningSettings
) -> np.ndarray:
    """(X, Y, Z) bool, voxels known to be free: rays passed them, none of weight ended in them, O is low.

    Beside what is not free both halves of a voxel must have been passed (`without_half_seen`). The agent's body is a
    sensor too: a sphere around every pose it stood at is free.
    """
    by_rays = np.empty(volume.grid.shape, bool)
    kernels_volumes.free_by_rays(
        volume["free_evidence"], volume["hit_evidence"], occupancy, np.float32(settings.min_free_rays),
        np.float32(settings.max_free_occupancy), by_rays,
    )
    out = without_half_seen(by_rays, volume["cells_passed"])
    mark_body(out, volume.grid, walked, radius_m)
    return out


def without_half_seen(free: np.ndarray, passed: np.ndarray) -> np.ndarray:
    """`free` without the voxels whose half towards a neighbour that is not free was passed by no ray.

    Rays along a wall pass the near half of its voxels and may end in none: such a voxel seems free with a wall in its
    middle. `passed`: float32 bits of the half-size cells [X, Y, Z]; a volume without any is left alone.
    """
    if not passed.any():
        return free
    out = np.empty_like(free)
    kernels_volumes.drop_half_seen(free, passed, out)
    return out


def mark_body(free: np.ndarray, grid: VoxelGrid, centres_world: np.ndarray, radius_m: float) -> None:
    """Set `free` in every voxel whose centre lies within the radius of one of the positions (N, 3), in place.

    And in the voxels that hold the positions, however small the body is.
    """
    centres = np.ascontiguousarray(centres_world, dtype=np.float64).reshape(-1, 3)
    own = grid.index_of(centres)
    free[tuple(own[grid.contains_index(own)].T)] = True
    kernels.mark_spheres(centres, radius_m, np.asarray(grid.origin, dtype=np.float64), grid.voxel_size, free)


def clearance(free: np.ndarray, voxel_size: float, longest_m: float) -> np.ndarray:
    """Distance (m, float32) from each voxel centre to the nearest face of a voxel that is not free, truncated.

    The outside of the grid counts as not free: nothing is known about it.
    """
    reach = int(np.ceil(longest_m / voxel_size)) + 1
    blocked = np.pad(~free, 1, constant_values=True).view(np.uint8)
    squared = kernels.distance_transform(blocked, reach, False)[1:-1, 1:-1, 1:-1]
    d = (np.sqrt(squared.astype(np.float32)) - np.float32(0.5)) * np.float32(voxel_size)
    return np.maximum(d, 0)


def _open_escape(
    passable: np.ndarray,
    clear: np.ndarray,
    solid: np.ndarray,
    grid: VoxelGrid,
    position: np.ndarray,
    limits_m: tuple[float, float],
    settings: PlanningSettings,
) -> np.ndarray:
    """Let the agent out of a tight spot: near it, unseen space may come as close as it does at the start.

    Only what is *unseen* may: from what is known to be solid the required clearance is kept. Extends `passable` in
    place and returns the clearance that paths are checked against.
    """
    required, escape = limits_m
    reach = int(settings.escape_m / grid.voxel_size) + 1
    start = np.clip(grid.index_of(position), 0, np.asarray(grid.shape) - 1)
    box = tuple(slice(max(0, c - reach), c + reach + 1) for c in start)
    centres = np.stack(np.meshgrid(*(grid.axis(i)[box[i]] for i in range(3)), indexing="ij"), axis=-1)
    near = np.linalg.norm(centres - position, axis=-1) <= settings.escape_m
    away = kernels.distance_transform(solid.view(np.uint8), int(required / grid.voxel_size) + 2, False)[box]
    safe = (np.sqrt(away, dtype=np.float64) - 0.5) * grid.voxel_size >= required - 1e-6
    passable[box] |= near & safe & (clear[box] >= escape - 1e-6)
    checked = clear.copy()
    checked[box] = np.where(near & ~safe & (clear[box] < required - 1e-6), 0, clear[box])
    return checked


def begin_free_space(
    volume: UncertaintyVolume,
    T_world_camera: np.ndarray,
    walked: np.ndarray,
    motion: MotionSettings,
    settings: PlanningSettings,
    *,
    relaxed: bool = False,
) -> Callable[[], FreeSpace]:
    """Known-free space, risk field and geodesic distances from the pose, those on a thread of their own.

    The distances are one long serial computation, a third of a decision: the caller has other work to do meanwhile.

    Args:
        walked: (N, 3) world positions of the poses walked so far, the current one included.
        relaxed: demand only the agent's radius as clearance, without the margin.

    Returns:
        a function that waits for the distances and returns the whole; to be called once.
    """
    grid = volume.grid
    occupancy = joint_occupancy(volume.arrays, settings)
    free = known_free(volume, occupancy, walked, motion.agent_radius_m, settings)
    preferred = max(settings.preferred_clearance_m, motion.agent_radius_m + settings.clearance_margin_m)
    clear = clearance(free, grid.voxel_size, preferred)
    risk = build_risk_field(grid, occupancy, clear, motion.agent_radius_m, preferred)
    required = motion.agent_radius_m + (0.0 if relaxed else settings.clearance_margin_m)
    position = T_world_camera[:3, 3]
    start = np.clip(grid.index_of(position), 0, np.asarray(grid.shape) - 1)
    passable = clear >= required - 1e-6
    # Never nothing: a clearance of zero is met inside walls too.
    escape, checked = min(required, max(float(clear[tuple(start)]), LEAST_ESCAPE_M)), clear
    if escape < required:
        solid = (volume["hit_evidence"] > 0) & ~free
        checked = _open_escape(passable, clear, solid, grid, position, (required, escape), settings)
    passable[tuple(start)] = True
    moves = kernels.open_moves(passable.view(np.uint8), motion.planar)
    pool = ThreadPoolExecutor(1)
    found = pool.submit(_geodesic, risk, moves, start, settings, UNREACHABLE)
    pool.shutdown(wait=False)
    return lambda: FreeSpace(
        risk, free, checked, passable, moves, start, required, escape, *found.result(), motion.planar
    )


def build_free_space(
    volume: UncertaintyVolume, T_world_camera: np.ndarray, walked: np.ndarray, motion: MotionSettings,
    settings: PlanningSettings, *, relaxed: bool = False,
) -> FreeSpace:
    """`begin_free_space`, waited for."""
    return begin_free_space(volume, T_world_camera, walked, motion, settings, relaxed=relaxed)()
