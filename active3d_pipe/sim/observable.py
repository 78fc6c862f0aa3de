"""What an agent could reach and see at best: the yardstick that evaluation holds a run against.

Ground truth: only evaluation and `scene check` may use it.
"""

import hashlib
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from active3d_pipe.errors import InputError
from active3d_pipe.geometry import se3
from active3d_pipe.sim.simulator import Simulator
from active3d_pipe.structures import VoxelGrid

_MAX_CELLS = 4_000_000
_VIEWPOINT_SPACING_M = 0.3
_NEAREST_VIEWPOINTS, _RANDOM_VIEWPOINTS = 32, 96
_SURFACE_TOLERANCE_M = 0.01
_MAX_INVALID = 0.10


@dataclass(frozen=True, slots=True, eq=False)
class FreeSpace:
    """The free space that a sphere can reach from the start without touching a surface.

    Attributes:
        grid: voxels over the scene's bounds.
        reachable: (X, Y, Z) bool, whether the sphere's centre can get to the voxel's centre.
        clearance: (X, Y, Z) float32 distance of voxel centres to the nearest surface, m.
    """

    grid: VoxelGrid
    reachable: np.ndarray
    clearance: np.ndarray

    @property
    def volume_m3(self) -> float:
        """Volume of the reachable voxels."""
        return float(self.reachable.sum()) * self.grid.voxel_size**3

    @property
    def floor_area_m2(self) -> float:
        """Area of the reachable voxels seen from above."""
        return float(self.reachable.any(axis=2).sum()) * self.grid.voxel_size**2


def reachable_space(
    sim: Simulator, radius_m: float = 0.2, voxel_m: float = 0.1, *, planar: bool = False
) -> FreeSpace:
    """Flood fill of free space from the start pose through faces of voxels whose centres are `radius_m` clear.

    `planar`: at the height of the start only, as a robot on the ground. The voxel is `voxel_m`, or more where the
    scene would need over four million. Raises InputError when the start itself is not clear.
    """
    scene = sim.scene
    voxel_m = max(voxel_m, float(np.cbrt(np.prod(scene.bounds_high - scene.bounds_low) / _MAX_CELLS)))
    grid = VoxelGrid.from_bounds(scene.bounds_low, scene.bounds_high, voxel_m)
    clearance = sim.clearance(grid.centres().reshape(-1, 3)).reshape(grid.shape)
    free = clearance > radius_m
    if planar:
        free &= np.arange(grid.shape[2]) == grid.index_of(scene.start_pose[:3, 3])[2]
    labels, _ = ndimage.label(free)
    start = scene.start_pose[:3, 3]
    # The start need not fall on a free voxel centre: take the nearest free voxel in a clear line from it.
    near = np.argwhere(free & (np.linalg.norm(grid.centres() - start, axis=-1) < max(0.5, 3 * voxel_m)))
    if len(near) == 0:
        raise InputError(
            f"scene {scene.name}: no free space for a sphere of {radius_m} m around the start "
            f"{np.round(start, 2).tolist()}; give another scene.start_position"
        )
    centres = grid.centre_of(near)
    order = np.argsort(np.linalg.norm(centres - start, axis=1), kind="stable")
    clear = ~sim.surface.occluded(np.broadcast_to(start, centres.shape), centres)[order]
    first = near[order[int(np.argmax(clear))]]
    return FreeSpace(grid, labels == labels[tuple(first)], clearance)


def free_positions(
    sim: Simulator, n: int, min_clearance_m: float, rng: np.random.Generator, space: FreeSpace | None = None
) -> np.ndarray:
    """(n, 3) float64 positions uniform in reachable free space, at least `min_clearance_m` from every surface.

    Raises InputError when the reachable space has no such place.
    """
    space = reachable_space(sim) if space is None else space
    margin = space.grid.voxel_size * np.sqrt(3) / 2
    cells = np.argwhere(space.reachable & (space.clearance > min_clearance_m - margin))
    found: list[np.ndarray] = []
    count = 0
    for _ in range(200):
        if count >= n or len(cells) == 0:
            break
        picked = cells[rng.integers(len(cells), size=max(2 * n, 64))]
        points = space.grid.centre_of(picked) + (rng.random((len(picked), 3)) - 0.5) * space.grid.voxel_size
        points = points[sim.clearance(points) >= min_clearance_m]
        found.append(points)
        count += len(points)
    if count < n:
        raise InputError(f"scene {sim.scene.name}: found no {n} reachable positions {min_clearance_m} m from surfaces")
    return np.concatenate(found)[:n] if n else np.zeros((0, 3))


def held_out_poses(
    sim: Simulator, n: int, seed_text: str, min_clearance_m: float = 0.3, space: FreeSpace | None = None
) -> np.ndarray:
    """(n, 4, 4) float64 poses of held-out views: positions uniform in reachable space, directions on the sphere.

    The camera's x axis stays level. Views with more than 10 % of pixels without depth are drawn again. The same
    `seed_text` (by custom the scene's name) and scene give the same poses.
    """
    words = np.frombuffer(hashlib.sha256(seed_text.encode()).digest(), dtype=np.uint32)
    rng = np.random.default_rng(np.random.SeedSequence(words.tolist()))
    space = reachable_space(sim) if space is None else space
    poses: list[np.ndarray] = []
    for _ in range(20):
        positions = free_positions(sim, max(n, 1), min_clearance_m, rng, space)
        yaw = rng.uniform(-np.pi, np.pi, len(positions))
        pitch = np.arcsin(rng.uniform(-1, 1, len(positions)))
        for position, a, b in zip(positions, yaw, pitch):
            if len(poses) == n:
                return np.stack(poses) if poses else np.zeros((0, 4, 4))
            pose = se3.pose_from_yaw_pitch(position, float(a), float(b))
            if (sim.depth(pose) <= 0).mean() <= _MAX_INVALID:
                poses.append(pose)
        if len(poses) == n:
            return np.stack(poses)
    raise InputError(
        f"scene {sim.scene.name}: only {len(poses)} of {n} held-out views see surfaces in 90 % of their pixels; "
        "the scene is open or larger than camera.far"
    )


def viewpoints(space: FreeSpace, rng: np.random.Generator, spacing_m: float = _VIEWPOINT_SPACING_M) -> np.ndarray:
    """(M, 3) float64 a thinned set of reachable positions: a random one of every block of `spacing_m`."""
    cells = np.argwhere(space.reachable)
    block = cells // max(round(spacing_m / space.grid.voxel_size), 1)
    order = rng.permutation(len(cells))
    _, first = np.unique(block[order], axis=0, return_index=True)
    return space.grid.centre_of(cells[order[first]])


def observable_points(
    sim: Simulator, points: np.ndarray, rng: np.random.Generator, *, radius_m: float = 0.2,
    planar: bool = False, max_range_m: float | None = None, space: FreeSpace | None = None,
) -> np.ndarray:
    """(N,) bool, which surface points (N, 3) some reachable pose can see.

    A point counts as seen when a straight line of at most `max_range_m` (default: the camera's far limit) from a
    reachable position meets no surface before its last centimetre. Each point is tried from the nearest viewpoints and
    then from random ones; `rng` draws both.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    space = reachable_space(sim, radius_m, planar=planar) if space is None else space
    reach = sim.camera.far if max_range_m is None else max_range_m
    positions = viewpoints(space, rng)
    seen = np.zeros(len(points), bool)
    if len(points) == 0 or len(positions) == 0:
        return seen
    nearest = min(_NEAREST_VIEWPOINTS, len(positions))
    distance, index = cKDTree(positions).query(points, k=nearest)
    distance, index = distance.reshape(len(points), -1), index.reshape(len(points), -1)
    for k in range(nearest + _RANDOM_VIEWPOINTS):
        todo = np.flatnonzero(~seen)
        if len(todo) == 0:
            break
        if k < nearest:
            chosen = index[todo, k]
        else:
            chosen = rng.integers(len(positions), size=len(todo))
        start, end = positions[chosen], points[todo]
        near = np.linalg.norm(end - start, axis=1) <= reach
        todo, start, end = todo[near], start[near], end[near]
        if len(todo):
            seen[todo] = ~sim.surface.occluded(start, end, _SURFACE_TOLERANCE_M)
    return seen
