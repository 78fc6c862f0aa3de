"""What could be seen and from where, by the ground truth: reachable space, observable surface, held-out views.

Only the evaluation asks: a planner that did would be cheating.
"""

import math
import zlib

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from active3d_pipe.errors import InputError
from active3d_pipe.geometry import se3
from active3d_pipe.geometry.raycasting import SurfaceIndex
from active3d_pipe.sim.simulator import Simulator
from active3d_pipe.structures import VoxelGrid

GRID_M = 0.1  # spacing of the flood fill
AGENT_RADIUS_M = 0.2
SPACING_M = 0.4  # spacing of the viewpoints that decide on observability
NEAREST_VIEWS, RANDOM_VIEWS = 40, 24  # viewpoints tried for every surface point
TOLERANCE_M = 0.003  # a surface this close in front of a point does not hide it
PITCH_DEG = (-40.0, 25.0)  # of held-out views, upwards positive
MAX_BAD_PIXELS = 0.1  # share of pixels without a return, or too near, at which a held-out view is rejected
TOO_NEAR_M = 0.3


def reachable_positions(simulator: Simulator, radius_m: float = AGENT_RADIUS_M) -> np.ndarray:
    """(N, 3) float64 centres of the grid cells that a sphere of `radius_m` can reach from the start pose, world m.

    Cells are joined over faces. Raises InputError when the start pose itself is too near a surface for any cell
    around it.
    """
    scene = simulator.scene
    grid = VoxelGrid.from_bounds(scene.bounds_low, scene.bounds_high, GRID_M)
    clear = simulator.clearance(grid.centres().reshape(-1, 3)).reshape(grid.shape) >= radius_m
    label, _ = ndimage.label(clear)
    start = scene.start_pose[:3, 3]
    ijk = np.argwhere(clear)
    if len(ijk) == 0:
        raise InputError(f"scene {scene.name}: no place is {radius_m} m away from all surfaces; is the unit right?")
    nearest = ijk[np.argmin(np.linalg.norm(grid.centre_of(ijk) - start, axis=1))]
    return grid.centre_of(np.argwhere(label == label[tuple(nearest)]))


def observable_points(simulator: Simulator, points: np.ndarray, radius_m: float = AGENT_RADIUS_M) -> np.ndarray:
    """(N,) bool, which surface points (N, 3) some reachable position can see within the camera's range.

    Every point is tried against its nearest viewpoints, then against random ones; directions do not matter, since
    the camera can turn.
    """
    places = _thinned(reachable_positions(simulator, radius_m), SPACING_M)
    index = SurfaceIndex(simulator.scene.vertices, simulator.scene.faces)
    points = np.asarray(points, dtype=np.float32)
    seen = np.zeros(len(points), bool)
    count = min(NEAREST_VIEWS, len(places))
    near = cKDTree(places).query(points, k=count)[1].reshape(len(points), count)
    rng = np.random.default_rng(zlib.crc32(simulator.scene.name.encode()))
    far = rng.integers(len(places), size=(len(points), RANDOM_VIEWS))
    for column in np.concatenate([near, far], axis=1).T:
        todo = np.flatnonzero(~seen)
        if len(todo) == 0:
            break
        eyes = places[column[todo]].astype(np.float32)
        in_range = np.linalg.norm(points[todo] - eyes, axis=1) <= simulator.camera.far
        seen[todo] = in_range & ~index.occluded(eyes, points[todo], TOLERANCE_M)
    return seen


def free_positions(
    simulator: Simulator, count: int, min_clearance_m: float, rng: np.random.Generator
) -> np.ndarray:
    """(count, 3) positions drawn uniformly from reachable space at least `min_clearance_m` away from surfaces."""
    cells = reachable_positions(simulator, max(min_clearance_m, AGENT_RADIUS_M))
    found: list[np.ndarray] = []
    for _ in range(1000):
        drawn = cells[rng.integers(len(cells), size=count)] + rng.uniform(-0.5, 0.5, (count, 3)) * GRID_M
        found += list(drawn[simulator.clearance(drawn.astype(np.float32)) >= min_clearance_m])
        if len(found) >= count:
            return np.array(found[:count])
    raise InputError(f"scene {simulator.scene.name}: too little space {min_clearance_m} m away from surfaces")


def held_out_poses(
    simulator: Simulator, count: int, seed_text: str, *, min_clearance_m: float = 0.3
) -> np.ndarray:
    """(count, 4, 4) T_world_camera: uniform free positions, any yaw, pitch uniform in PITCH_DEG.

    Views with more than a tenth of their pixels empty or nearer than 0.3 m are drawn anew. Seeded by `seed_text`
    (the scene's name): every run and every method is judged on the same views.
    """
    if count == 0:
        return np.zeros((0, 4, 4))
    rng = np.random.default_rng([zlib.crc32(seed_text.encode()), 1])
    poses: list[np.ndarray] = []
    for _ in range(200):
        for position in free_positions(simulator, count, min_clearance_m, rng):
            pitch = math.radians(rng.uniform(*PITCH_DEG))
            T = se3.pose_from_yaw_pitch(position, rng.uniform(-math.pi, math.pi), pitch)
            depth = simulator.depth(T)
            if np.mean((depth <= 0) | (depth < TOO_NEAR_M)) <= MAX_BAD_PIXELS:
                poses.append(T)
            if len(poses) == count:
                return np.array(poses)
    raise InputError(f"scene {simulator.scene.name}: found only {len(poses)} of {count} held-out views")


def _thinned(points: np.ndarray, spacing: float) -> np.ndarray:
    """One point for every occupied cell of edge `spacing`."""
    cells = np.floor(points / spacing).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return points[np.sort(first)]
