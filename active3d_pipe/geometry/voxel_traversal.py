"""Casting rays through a voxel grid: what a view sees, and what a depth image carves.

Kernels: `kernels_traversal.py`; slow twin: `reference_traversal.py`.
"""

import math

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.geometry import kernels_traversal as kernels
from active3d_pipe.structures.camera import Camera
from active3d_pipe.structures.frame import check_pose
from active3d_pipe.structures.voxel_grid import VoxelGrid


def fan_stride(camera: Camera, voxel_size: float, max_range_m: float) -> int:
    """Pixel stride at which neighbouring rays are at most one voxel apart at `max_range_m`."""
    return max(1, math.floor(min(camera.fx, camera.fy) * voxel_size / max_range_m))


def ray_fan(camera: Camera, ray_stride: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every n-th pixel of an image as rays.

    Returns rows (M,), columns (M,) int64 and unit directions (M, 3) float64 in the camera frame. The pattern is
    centred, and the outermost pixels always belong to it, so that the frustum is covered up to its edges.
    """

    def lines(n: int) -> np.ndarray:
        count = max(1, math.ceil((n - 1) / ray_stride)) + 1
        return np.unique(np.round(np.linspace(0, n - 1, count)).astype(np.int64))

    rows, columns = (a.ravel() for a in np.meshgrid(lines(camera.height), lines(camera.width), indexing="ij"))
    x = (columns + 0.5 - camera.cx) / camera.fx
    y = (rows + 0.5 - camera.cy) / camera.fy
    d = np.stack([x, y, np.ones_like(x)], axis=-1)
    return rows, columns, d / np.linalg.norm(d, axis=-1, keepdims=True)


def to_voxel_units(
    grid: VoxelGrid, T_world_camera: np.ndarray, directions_camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(origin (3,), directions (M, 3)) float32 as the kernels take them, of rays given in the camera frame."""
    origin = (T_world_camera[:3, 3] - grid.origin) / grid.voxel_size
    directions = directions_camera @ T_world_camera[:3, :3].T / grid.voxel_size
    return origin.astype(np.float32), np.ascontiguousarray(directions, dtype=np.float32)


def as_opaque(blocked: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Flat uint8 of a volume that stops rays: bool / integer != 0, or float occupancy > 0.5."""
    if blocked.shape != grid.shape:
        raise InputError(f"voxel traversal: the occupied volume is {blocked.shape}, expected {grid.shape}")
    stops = blocked > 0.5 if blocked.dtype.kind == "f" else blocked != 0
    return np.ascontiguousarray(stops).view(np.uint8).ravel()


def visible_voxels(
    blocked: np.ndarray,
    grid: VoxelGrid,
    T_world_camera: np.ndarray,
    camera: Camera,
    *,
    max_range_m: float,
    ray_stride: int | None = None,
) -> np.ndarray:
    """V_c of eq. nbv_reward: flat ids (sorted, unique, int64) of the voxels that a camera can see.

    Args:
        blocked: (X, Y, Z) volume that stops rays (see `as_opaque`); unknown space lets them pass.
        T_world_camera: (4, 4); the camera may stand outside the grid.
        max_range_m: length of the rays, m.
        ray_stride: pixels between rays; by default neighbours are <= 1 voxel apart at `max_range_m`.
    """
    T = check_pose(T_world_camera, "visible voxels")
    opaque = as_opaque(blocked, grid)
    stride = ray_stride or fan_stride(camera, grid.voxel_size, max_range_m)
    origin, directions = to_voxel_units(grid, T, ray_fan(camera, stride)[2])
    seen = np.zeros(grid.size, np.uint8)
    kernels.mark_visible(opaque, origin, directions, np.float32(max_range_m), grid.shape, seen)
    return np.flatnonzero(seen)


def carve(
    grid: VoxelGrid,
    T_world_camera: np.ndarray,
    camera: Camera,
    depth: np.ndarray,
    *,
    max_range_m: float | None = None,
    ray_stride: int = 1,
    counts: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """What one depth image says about the grid: rays that passed each voxel, and rays that ended in it.

    Args:
        depth: (H, W) m along the optical axis, 0 = no return (such a ray says nothing).
        max_range_m: rays are cut at this length (default: camera.far) and then end nowhere.
        ray_stride: use every n-th pixel.
        counts: (free, hit) int32 [X, Y, Z] to add to, for many frames in a row; new arrays by default.

    Returns:
        free, hit: int32 [X, Y, Z].
    """
    if depth.shape != (camera.height, camera.width):
        raise InputError(f"carve: depth is {depth.shape}, expected {(camera.height, camera.width)}")
    T = check_pose(T_world_camera, "carve")
    if counts is None:
        counts = np.zeros(grid.shape, np.int32), np.zeros(grid.shape, np.int32)
    rows, columns, unit = ray_fan(camera, ray_stride)
    z = depth[rows, columns]
    valid = (z > 0) & np.isfinite(z)
    length = np.where(valid, z / unit[:, 2], 0).astype(np.float32)
    origin, directions = to_voxel_units(grid, T, unit)
    longest = np.float32(camera.far if max_range_m is None else max_range_m)
    clear = np.zeros(grid.size, np.uint8)
    free, hit = (a.reshape(-1) for a in counts)
    kernels.carve_rays(clear, origin, directions, length, longest, grid.shape, free, hit)
    return counts


def trace_depth(
    blocked: np.ndarray, grid: VoxelGrid, T_world_camera: np.ndarray, camera: Camera, *, max_range_m: float
) -> np.ndarray:
    """(H, W) float32 z-depth of a voxel model seen by a camera, 0 where nothing is met within the range."""
    T = check_pose(T_world_camera, "trace depth")
    _, _, unit = ray_fan(camera, 1)
    origin, directions = to_voxel_units(grid, T, unit)
    t = np.zeros(len(directions), np.float32)
    kernels.first_hits(as_opaque(blocked, grid), origin, directions, np.float32(max_range_m), grid.shape, t)
    return (t * unit[:, 2].astype(np.float32)).reshape(camera.height, camera.width)
