"""Looks that nobody took yet: what rays of random views from free space end in."""

import numpy as np

from active3d_pipe.geometry import kernels_traversal as kernels
from active3d_pipe.structures.voxel_grid import VoxelGrid


def random_looks(
    grid: VoxelGrid, opaque: np.ndarray, places: np.ndarray, number: int, glances: int, reach_m: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """(N,) flat ids of the voxels of `opaque` (flat uint8) in which random rays end.

    From `number` of the voxels `places` (P, 3), drawn with repetition, `glances` directions each, even on the sphere.
    """
    if not len(places):
        return np.zeros(0, np.int64)
    origins = grid.centre_of(places[rng.integers(0, len(places), number)])
    directions = rng.normal(size=(number, glances, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return ray_ends(grid, opaque, origins, directions, reach_m)


def ray_ends(
    grid: VoxelGrid, opaque: np.ndarray, origins: np.ndarray, directions: np.ndarray, reach_m: float
) -> np.ndarray:
    """(N,) flat ids of the voxels of `opaque` in which rays end, of those that end in one.

    Rays start at origins (P, 3), m, in the directions (P, M, 3), unit vectors, world.
    """
    ids = np.zeros(directions.shape[:2], np.int64)
    starts = ((origins - grid.origin) / grid.voxel_size).astype(np.float32)
    kernels.first_voxels(
        opaque, starts, (directions / grid.voxel_size).astype(np.float32), np.float32(reach_m), grid.shape, ids
    )
    return ids[ids >= 0]
