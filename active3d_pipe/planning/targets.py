"""Candidate positions that are sought from what there is to see, where a lattice would miss them."""

import numpy as np

from active3d_pipe.information.gain import FREE, OPEN, SURFACE
from active3d_pipe.planning import kernels_targets
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.reward import RewardField
from active3d_pipe.structures.motion import MotionSettings
from active3d_pipe.structures.voxel_grid import VoxelGrid

BIT_COUNT = np.array([bin(n).count("1") for n in range(256)], np.float32)


def target_positions(
    space: FreeSpace, field: RewardField, motion: MotionSettings, settings: PlanningSettings
) -> np.ndarray:
    """(P, 3) int64 reachable voxels from which the most valuable places that are left can be seen.

    A lattice of positions misses what can be seen through a gap only. Here one asks the other way round: blocks of
    `target_block_m` with the most that is still to be had, and from where each is seen best and soonest.
    """
    targets, cells = _targets(field, settings)
    return _viewpoints(space, field, motion, settings, targets, cells, space.start % 2)


def hidden_positions(
    space: FreeSpace, field: RewardField, motion: MotionSettings, settings: PlanningSettings, pairs: int, turn: int
) -> np.ndarray:
    """(P, 3) int64 reachable voxels from which something deep in unseen space can be seen, past all that is nearer.

    `target_positions` asks for the rim of what is unseen, which many places see; behind furniture the rest is seen
    from a few only. Every block of unseen space is asked about, or as many, evenly spread, as with all places of a
    lattice make up `pairs`; there are two lattices, one in the middle of the other's cells. Which of them is taken, and
    which blocks, changes with `turn`.
    """
    targets = _unseen_blocks(field, settings)
    offset = (space.start + turn) % 2
    every = -(-len(targets) * (int(space.reachable.sum()) // 8 + 1) // max(pairs, 1))
    targets = targets[turn % max(every, 1) :: max(every, 1)]
    return _viewpoints(space, field, motion, settings, targets, np.zeros(len(targets), np.uint8), offset)


def _viewpoints(
    space: FreeSpace, field: RewardField, motion: MotionSettings, settings: PlanningSettings, targets: np.ndarray,
    cells: np.ndarray, offset: np.ndarray,
) -> np.ndarray:
    """(P, 3) int64, of the reachable voxels `offset` + 2 (i, j, k) those that see a target (T, 3) best or soonest."""
    grid = space.grid
    lattice = tuple(slice(int(o), None, 2) for o in offset)
    places = np.argwhere(space.reachable[lattice]) * 2 + offset
    if len(targets) == 0 or len(places) == 0:
        return np.zeros((0, 3), np.int64)
    enough = settings.information.enough_distance_m
    near = kernels_targets.best_viewpoints(
        targets.astype(np.int32), cells, places.astype(np.int32), field.opaque, field.clear, field.through,
        field.normal, grid.shape, np.float32(1.5), np.float32(field.max_range_m / grid.voxel_size),
        np.float32(enough / grid.voxel_size), space.cost[tuple(places.T)] / np.float32(motion.max_step_m),
        np.float32(settings.view_steps),
    )
    chosen = np.unique(near[near >= 0])
    return places[chosen]


def _unseen_blocks(field: RewardField, settings: PlanningSettings) -> np.ndarray:
    """(T, 3) int64: of every block the open voxel with the most value."""
    grid = field.grid
    worth = np.where(field.kind == OPEN, field.value, 0)
    first, _ = _best_of_each_block(worth, grid, settings)
    return np.stack(np.unravel_index(first, grid.shape), axis=-1)


def _best_of_each_block(
    worth: np.ndarray, grid: VoxelGrid, settings: PlanningSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Flat voxels (B,) of the most worth in each block that has any, ties to the first, and the blocks' sums."""
    block = max(1, round(settings.target_block_m / grid.voxel_size))
    first, total = kernels_targets.best_of_each_block(worth.reshape(grid.shape), block)
    found = first >= 0
    return first[found], total[found]


def _targets(field: RewardField, settings: PlanningSettings) -> tuple[np.ndarray, np.ndarray]:
    """(T, 3) int64: of each of the most valuable blocks the voxel with the most value beside seen free space.

    And (T,) uint8, the bit of its first open cell where these are worth more than the rest of it, else 0.
    """
    grid = field.grid
    kind = field.kind.reshape(grid.shape)
    free = kind == FREE
    beside = np.zeros(grid.shape, bool)
    for axis in range(3):
        a, b = np.moveaxis(beside, axis, 0), np.moveaxis(free, axis, 0)
        a[1:] |= b[:-1]
        a[:-1] |= b[1:]
    rest = np.maximum(0, 1 - field.quality / np.float32(field.enough_quality))
    worth = np.where(field.kind == SURFACE, field.surface_value * rest, field.value) * beside.ravel()
    in_cells = BIT_COUNT[field.open_bits] * field.cell_value
    first_open = np.where(in_cells > worth, field.open_bits & (~field.open_bits + np.uint8(1)), 0).astype(np.uint8)
    worth = worth + in_cells
    first, total = _best_of_each_block(worth, grid, settings)
    chosen = first[np.argsort(-total, kind="stable")[: settings.max_targets]]
    return np.stack(np.unravel_index(chosen, grid.shape), axis=-1), first_open[chosen]
