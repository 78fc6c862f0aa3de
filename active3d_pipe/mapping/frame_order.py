"""In which order the refinement visits frames: what is seen from many places must not be what is learnt least."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import distance_transform_edt

from active3d_pipe.geometry.random_looks import random_looks, ray_ends
from active3d_pipe.geometry.voxel_traversal import carve, ray_fan
from active3d_pipe.mapping.keyframes import depth_samples
from active3d_pipe.structures import Frame, VoxelGrid

READING_STRIDE = 8  # px between the rays that say what a frame shows
CELL_M = 0.1  # rays that end in the same cell of this edge show the same surface ...
MOST_CELLS = 8_000_000  # ... or of a larger one, where the scene has more of them
CLEARANCE_M = 0.25  # of the places from which anyone may look, to what is not known to be free
PLACES, GLANCES = 1000, 200  # random views: so many places, so many directions from each
LEAST, MOST = 0.2, 8.0  # bounds of the weights, which are 1 or so on the mean: no frame is forgotten, none dominates


def exposure(frames: Sequence[Frame], rng: np.random.Generator) -> np.ndarray:
    """How much more of what a frame shows is to be seen from anywhere than `frames` show of it: (F,), 1 on the mean.

    For every cell of surface, the rays of random views from the free space that end in it over the rays of the frames
    that do; for a frame, the mean of that over its rays. Visits in proportion to it learn the surface in the
    proportions in which it will be looked at, where visiting all frames alike learns it in those of the walk, which
    lingered here and passed there. All 1 when there is no free space to look from.
    """
    grid = _grid_around(frames)
    if grid is None:
        return np.ones(len(frames))
    free, hit = (np.zeros(grid.shape, np.int32) for _ in range(2))
    for frame in frames:
        carve(grid, frame.T_world_camera, frame.camera, frame.depth, ray_stride=READING_STRIDE, counts=(free, hit))
    opaque = ((free == 0) | (hit > 0)).view(np.uint8).ravel()  # a look ends at what is not known
    surface, shown = hit.ravel() > 0, []
    for frame in frames:
        T, fan = frame.T_world_camera, ray_fan(frame.camera, READING_STRIDE)[2]
        ends = ray_ends(grid, opaque, T[None, :3, 3], (fan @ T[:3, :3].T)[None], frame.camera.far)
        shown.append(ends[surface[ends]])
    by_frames = np.bincount(np.concatenate(shown), minlength=grid.size)
    clearance = distance_transform_edt(opaque.reshape(grid.shape) == 0, sampling=grid.voxel_size)
    places, longest = np.argwhere(clearance >= CLEARANCE_M), float(np.linalg.norm(grid.high - grid.low))
    by_looks = np.bincount(random_looks(grid, opaque, places, PLACES, GLANCES, longest, rng), minlength=grid.size)
    by_looks *= by_frames > 0
    if not by_looks.any():
        return np.ones(len(frames))
    # One look more in every cell, of either kind: few looks say little.
    looks_per_ray = by_looks.sum() / by_frames.sum()
    ratio = (by_looks + 1) / (by_frames * looks_per_ray + 1)
    weights = np.array([ratio[ends].mean() if len(ends) else np.nan for ends in shown])
    weights = np.where(np.isnan(weights), np.nanmean(weights), weights)
    return weights / weights.mean()


def visiting_order(weights: np.ndarray, visits: int, rng: np.random.Generator) -> np.ndarray:
    """(visits,) indices of the frames to visit, each about as often as its weight (F,) says, evenly spread.

    Frame f is due at the times (k + u_f) / p_f with a random phase u_f and its share p_f of the visits: where weights
    are equal, a random order that comes back.
    """
    share = np.clip(weights, LEAST, MOST)
    share = share / share.sum()
    times = np.ceil(visits * share).astype(int) + 1
    frame = np.repeat(np.arange(len(share)), times)
    turn = np.arange(times.sum()) - np.repeat(np.cumsum(times) - times, times)
    due = (turn + rng.random(len(share))[frame]) / share[frame]
    return frame[np.argsort(due, kind="stable")][:visits]


def _grid_around(frames: Sequence[Frame]) -> VoxelGrid | None:
    """The cells of everything that the frames read, and of their cameras; None without a reading."""
    points = [depth_samples(frame, READING_STRIDE) for frame in frames]
    if not any(len(p) for p in points):
        return None
    points += [frame.T_world_camera[None, :3, 3] for frame in frames]
    low, high = np.min([p.min(0) for p in points if len(p)], 0), np.max([p.max(0) for p in points if len(p)], 0)
    edge = max(CELL_M, float(np.prod(high - low + CELL_M) / MOST_CELLS) ** (1 / 3))
    return VoxelGrid.from_bounds(low - edge / 2, high + edge / 2, edge)
