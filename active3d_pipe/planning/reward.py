"""The reward of candidate views: eq. nbv_reward and nbv_eig over many poses at once.

Two evaluations of the same sum. `sphere_rewards` casts one sphere of rays for a position and adds up every view
direction from it: thousands of views in the time of some hundred positions. `exact_terms` casts the dense ray fan
of single views and returns their `GainTerms`. Unknown space lets rays pass, but not for ever: each open voxel takes
the share 1 - exp(-size / free path), so a voxel counts with the probability that it is visible at all.
"""

from dataclasses import dataclass, replace

import numpy as np

from active3d_pipe.geometry.voxel_traversal import fan_stride, ray_fan
from active3d_pipe.information.gain import SURFACE, GainTerms, classify, information_volumes
from active3d_pipe.planning import kernels_distance, kernels_sight, kernels_volumes
from active3d_pipe.planning import kernels_reward as kernels
from active3d_pipe.planning.candidates import Directions
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.structures.camera import Camera
from active3d_pipe.structures.uncertainty_volume import UncertaintyVolume
from active3d_pipe.structures.voxel_grid import VoxelGrid

# Longest jump of a ray through seen free space, voxels.
LONGEST_SKIP = 12
# Poses of one place that make one look: steps are short.
POSES_A_LOOK = 2


@dataclass(frozen=True, slots=True, eq=False)
class RewardField:
    """Everything a view's reward is computed from, flat in C order where kernels read it."""

    grid: VoxelGrid
    quality_range_m: float
    enough_quality: float
    max_range_m: float
    kind: np.ndarray
    opaque: np.ndarray
    skip: np.ndarray
    value: np.ndarray
    through: np.ndarray
    log_through: np.ndarray
    surface_value: np.ndarray
    quality: np.ndarray
    normal: np.ndarray
    clear: np.ndarray
    open_bits: np.ndarray
    cell_value: np.ndarray
    gain_imp: np.ndarray
    gain_exp: np.ndarray

    def after(self, T_world_camera: np.ndarray, camera: Camera) -> "RewardField":
        """The same field after a view from pose (4, 4): nothing is left to gain in what it sees."""
        grid = self.grid
        seen, cells = np.zeros(grid.size, np.uint8), np.zeros(grid.size, np.uint8)
        origin, rotation = (a[0] for a in _in_voxels(grid, T_world_camera[None]))
        fan = ray_fan(camera, fan_stride(camera, grid.voxel_size, self.max_range_m))[2].astype(np.float32)
        kernels.mark_seen(
            origin, rotation, fan, self.opaque, self.skip, self.clear, grid.shape, np.float32(grid.voxel_size),
            np.float32(self.max_range_m), seen, cells,
        )
        changed = {name: getattr(self, name).copy() for name in ("value", "surface_value", "gain_imp", "gain_exp")}
        for a in changed.values():
            a[seen > 0] = 0
        return replace(self, **changed, open_bits=self.open_bits & ~cells)


def build_reward_field(
    volume: UncertaintyVolume,
    walked_poses: np.ndarray,
    camera: Camera,
    settings: PlanningSettings,
) -> RewardField:
    """Prepare the volumes. `walked_poses` (N, 4, 4) tell which open voxels were looked at in vain."""
    grid, information = volume.grid, settings.information
    enough = information.enough_quality(camera.fx)
    reach = min(settings.max_range_m, camera.far)
    kind = classify(volume.arrays, information)
    hit, passed, ended = volume["hit_evidence"], volume["cells_passed"], volume["cells_hit"]
    half_seen, clear, unmet, of_interest, opaque, open_bits = (np.zeros(grid.shape, np.uint8) for _ in range(6))
    through, log_through = (np.empty(grid.shape, np.float32) for _ in range(2))
    normal = np.zeros((*grid.shape, 3), np.int8)
    passes = np.float32(np.exp(-grid.voxel_size / settings.unknown_free_path_m))
    kernels_volumes.sight(kind, hit, volume["occupancy"], passed, ended, passes, through, log_through, clear, unmet)
    kernels_sight.surface_normals(kind, normal)
    # A voxel is larger than what is in it: the underside of a table, the edge of a frame, the gap behind a sofa lie in
    # voxels that count as surface seen, from the other side. A volume without cells has no open ones, and its surface
    # stops sight everywhere.
    if ended.any():
        kernels_sight.open_cells(kind, clear, unmet, open_bits)
    # Rays over and under a chair's seat meet in one voxel, and the seat may lie between them: it is to be looked at,
    # and sight goes on through it, as far as it is known. Where an open voxel is beside, that one draws the looks: at
    # the border of what was seen most voxels are seen by halves.
    kernels_volumes.half_seen(kind, passed, half_seen)
    kernels_volumes.open_half_seen(half_seen, hit, kind, of_interest, opaque)
    skip = kernels_distance.distance_transform(of_interest, LONGEST_SKIP, True).astype(np.uint8).ravel()
    quality = np.ascontiguousarray(volume["view_quality"]).ravel()
    cells = clear.ravel(), open_bits.ravel()
    looks = _looks(volume, (skip, kind.ravel(), quality, normal.reshape(-1, 3)), cells, walked_poses, camera, settings)
    credit, cell_credit = (kernels_volumes.powers(np.float32(settings.credit_factor), n) for n in looks)
    # An eighth of what an open voxel is worth that may turn out either way, times the weight.
    whole = settings.cell_weight * (information.alpha + information.beta) / 16
    volumes = information_volumes(volume.arrays, information, enough, credit.reshape(grid.shape), kind)
    # Four of its cells are open; that most are empty all the same is learnt by looks in vain.
    at = half_seen.view(bool)
    volumes.value[at] = 4 * np.float32(whole) * credit.reshape(grid.shape)[at]
    return RewardField(
        grid, information.quality_range_m(camera.fx), enough, reach, kind.ravel(), opaque.ravel(), skip,
        volumes.value.ravel(), through.ravel(), log_through.ravel(), volumes.surface_value.ravel(), quality,
        normal.reshape(-1, 3), *cells, np.float32(whole) * cell_credit,
        volumes.gain_imp.ravel(), volumes.gain_exp.ravel(),
    )


def _in_voxels(grid: VoxelGrid, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins (N, 3) in voxel units and rotations (N, 3, 3) of poses (N, 4, 4), as the kernels take them."""
    origins = np.ascontiguousarray((poses[:, :3, 3] - grid.origin) / grid.voxel_size, dtype=np.float32)
    return origins, np.ascontiguousarray(poses[:, :3, :3], dtype=np.float32)


def spread_poses(poses: np.ndarray, count: int) -> np.ndarray:
    """Indices of `count` well-spread poses (N, 4, 4): farthest-point order in position + viewing direction.

    The newest pose is the first; ties go to the newer one. Half a metre counts as much as 30 degrees.
    """
    x = np.concatenate([poses[:, :3, 3] / 0.5, poses[:, :3, 2] / 0.52], axis=1)[::-1]
    count = min(count, len(x))
    chosen = [0]
    distance = np.linalg.norm(x - x[0], axis=1)
    while len(chosen) < count:
        new = int(distance.argmax())
        chosen.append(new)
        distance = np.minimum(distance, np.linalg.norm(x - x[new], axis=1))
    return len(x) - 1 - np.asarray(chosen[:count], dtype=np.int64)


def repeated_poses(poses: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices of at most `count` poses that stand for all, and float32 how many looks each of them stands for.

    Half of them are well spread, half are those whose surroundings (half a metre, 30 degrees) were taken most often:
    an agent that keeps looking at what it cannot settle must notice it.
    """
    x = np.round(np.concatenate([poses[:, :3, 3] / 0.5, poses[:, :3, 2] / 0.52], axis=1)).astype(np.int64)
    _, newest, inverse, counts = np.unique(x[::-1], axis=0, return_index=True, return_inverse=True, return_counts=True)
    place = inverse.ravel()[::-1]
    crowded = len(x) - 1 - newest[np.lexsort((newest, -counts))[: count - count // 2]]
    chosen, taken = [], set()
    for i in [*crowded.tolist(), *spread_poses(poses, count // 2).tolist()]:
        if place[i] not in taken:
            taken.add(place[i])
            chosen.append(i)
    index = np.asarray(chosen, dtype=np.int64)
    return index, np.maximum(1, counts[place[index]] / np.float32(POSES_A_LOOK)).astype(np.float32)


def _looks(
    volume: UncertaintyVolume,
    seen: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    cells: tuple[np.ndarray, np.ndarray],
    poses: np.ndarray,
    camera: Camera,
    settings: PlanningSettings,
) -> np.ndarray:
    """How many past views promised something of each voxel, of its open cells, that did not come true, (2, size).

    seen: `skip`, `kind`, `quality` and `normal` of a `RewardField`.
    """
    grid, kind = volume.grid, seen[1]
    if len(poses) == 0 or settings.credit_views == 0:
        return np.zeros((2, grid.size), np.float32)
    reach = min(settings.max_range_m, camera.far)
    # Coarser rays than for scoring: a voxel that only a corner of the fan touches was not really looked at.
    fan = ray_fan(camera, 2 * fan_stride(camera, grid.voxel_size, reach))[2].astype(np.float32)
    stops = ((kind == SURFACE) | (volume["hit_evidence"].ravel() > 0)).view(np.uint8)
    chosen, looks = repeated_poses(poses, settings.credit_views)
    return kernels.count_looks(
        *_in_voxels(grid, poses[chosen]), looks, fan, stops, *seen, *cells, grid.shape,
        np.float32(grid.voxel_size), np.float32(reach),
        np.float32(settings.information.enough_quality(camera.fx)),
        np.float32(settings.information.quality_range_m(camera.fx)),
    )


def sphere_rewards(field: RewardField, positions_world: np.ndarray, directions: Directions) -> np.ndarray:
    """(P, V) float32 reward of every view direction from every position (P, 3)."""
    grid = field.grid
    origins = ((positions_world - grid.origin) / grid.voxel_size).astype(np.float32)
    rays = kernels.sphere_gain(
        np.ascontiguousarray(origins), directions.rays / np.float32(grid.voxel_size), directions.solid_angles,
        field.kind, field.skip, field.value, field.through, field.surface_value, field.quality, field.normal,
        field.clear, field.open_bits, field.cell_value, grid.shape, np.float32(grid.voxel_size),
        np.float32(field.max_range_m), np.float32(field.enough_quality), np.float32(field.quality_range_m),
    )
    return rays @ directions.members.T


def exact_terms(
    field: RewardField, poses: np.ndarray, camera: Camera, ray_stride: int | None = None
) -> list[GainTerms]:
    """`GainTerms` of every pose (C, 4, 4) over its unique visible voxels, unknown ones by their visibility."""
    if len(poses) == 0:
        return []
    grid = field.grid
    stride = ray_stride or fan_stride(camera, grid.voxel_size, field.max_range_m)
    sums = kernels.frustum_gain(
        *_in_voxels(grid, poses), ray_fan(camera, stride)[2].astype(np.float32),
        field.opaque, field.skip, field.kind, field.value, field.log_through,
        field.surface_value, field.quality, field.normal, field.clear, field.open_bits, field.cell_value,
        field.gain_imp, field.gain_exp, grid.shape, np.float32(grid.voxel_size), np.float32(field.max_range_m),
        np.float32(field.enough_quality), np.float32(field.quality_range_m),
    )
    return [GainTerms(s[0], s[1], s[2], s[3], round(s[4]), round(s[5])) for s in sums.tolist()]
