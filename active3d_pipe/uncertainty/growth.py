"""Volumes whose grid grows with the known extent of the world."""

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.structures import UncertaintyVolume, VoxelGrid

# What a voxel holds that no ray reached. The field takes the values of its border outside its box, and so the SDF does.
UNSEEN = {"u_imp": 1.0, "occupancy": 0.5, "entropy_imp": 1.0, "entropy_exp": 1.0, "entropy": 1.0}


def grown_grid(grid: VoxelGrid, low: np.ndarray, high: np.ndarray) -> VoxelGrid:
    """`grid`, or a larger one that covers [low, high] (world, m) too, whose voxels coincide with those of `grid`."""
    below = np.maximum(np.ceil((grid.low - low) / grid.voxel_size - 1e-6), 0).astype(int)
    above = np.maximum(np.ceil((high - grid.high) / grid.voxel_size - 1e-6), 0).astype(int)
    if not (below.any() or above.any()):
        return grid
    return VoxelGrid(grid.origin - below * grid.voxel_size, grid.voxel_size, tuple(np.add(grid.shape, below + above)))


def on_grid(volume: UncertaintyVolume, grid: VoxelGrid) -> UncertaintyVolume:
    """The volume on a larger grid of the same voxels; what is new was never seen.

    Raises:
        InputError: `grid` does not hold the volume's grid, or its voxels lie elsewhere.
    """
    old = volume.grid
    offset = (old.origin - grid.origin) / grid.voxel_size
    below = np.rint(offset).astype(int)
    above = np.asarray(grid.shape) - below - old.shape
    if old.voxel_size != grid.voxel_size or np.abs(offset - below).max() > 1e-3 or min(below.min(), above.min()) < 0:
        raise InputError(
            f"uncertainty: the volume of round {volume.round} is on grid {old.shape} at {old.origin.tolist()}, "
            f"which does not lie in grid {grid.shape} at {grid.origin.tolist()} voxel by voxel"
        )
    if not (below.any() or above.any()):
        return UncertaintyVolume(grid, volume.round, volume.arrays, volume.fusion, volume.drop_bits)
    pad = list(zip(below, above, strict=True))
    arrays = {
        name: np.pad(a, pad, mode="edge") if name == "sdf" else np.pad(a, pad, constant_values=UNSEEN.get(name, 0.0))
        for name, a in volume.arrays.items()
    }
    return UncertaintyVolume(grid, volume.round, arrays, volume.fusion, volume.drop_bits)
