"""Surface that was looked at less than its share: what is left to do when nothing new is to be seen.

A map is rendered from views that nobody took. What they show oftenest must have been looked at most; a walk that only
seeks what is new lingers here and passes there. So the looks that each surface voxel had are compared with those that
random views from free space would give it, and what is short of them draws views.
"""

from dataclasses import replace

import numpy as np

from active3d_pipe.geometry.random_looks import random_looks
from active3d_pipe.information.gain import FREE, SURFACE
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.reward import RewardField
from active3d_pipe.structures.camera import Camera
from active3d_pipe.structures.voxel_grid import VoxelGrid

# Random views: so many places, so many rays from each. More places rather than more rays of each say what is due
# (docs/findings/spreading.md).
PLACES, GLANCES = 4000, 50


def spread_field(
    field: RewardField, hit_evidence: np.ndarray, space: FreeSpace, camera: Camera, block_m: float,
    rng: np.random.Generator,
) -> tuple[RewardField, float]:
    """`field` with nothing to gain but looks that surface is short of, and the share of all looks that is short.

    A look at a voxel is worth what it is short of, in units of the mean looks of a voxel, as far as it is near and
    frontal. The share lies in 0..1: half the sum of |looks had - looks due|, over all looks.

    Args:
        hit_evidence: (X, Y, Z), rays of all frames that ended in each voxel.
        block_m: edge of the blocks of voxels whose looks are counted together, m.
    """
    surface = field.kind == SURFACE
    had = np.where(surface, hit_evidence.ravel(), 0).astype(np.float64)
    opaque = (field.kind != FREE).view(np.uint8)  # a look ends at what is not known
    places = np.argwhere(space.reachable)
    ends = random_looks(field.grid, opaque, places, PLACES, GLANCES, camera.far, rng)
    due = np.bincount(ends, minlength=field.grid.size) * surface.astype(np.float64)
    if due.sum() == 0 or had.sum() == 0:
        return field, 0.0
    due *= had.sum() / due.sum()
    # Single voxels get few looks of either kind, which says little; those of a block together say more.
    block = _blocks(field.grid, block_m)
    short = np.maximum(np.bincount(block, due - had), 0)
    worth = short[block] / np.maximum(np.bincount(block, surface), 1)[block] / due[surface].mean() * surface
    nothing = np.zeros(field.grid.size, np.float32)
    left = replace(
        field, value=nothing, surface_value=worth.astype(np.float32), quality=nothing, cell_value=nothing,
        gain_imp=nothing, gain_exp=nothing,
    )
    return left, float(short.sum() / due.sum())


def _blocks(grid: VoxelGrid, edge_m: float) -> np.ndarray:
    """(size,) int64: the block that each voxel lies in, flat."""
    edge = max(1, round(edge_m / grid.voxel_size))
    i, j, k = (np.arange(n) // edge for n in grid.shape)
    return ((i[:, None, None] * (j[-1] + 1) + j[:, None]) * (k[-1] + 1) + k).ravel()
