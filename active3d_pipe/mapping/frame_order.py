"""In which order the refinement visits frames: what few of them show must not be what is learnt least."""

from collections.abc import Sequence

import numpy as np

from active3d_pipe.mapping.keyframes import depth_samples
from active3d_pipe.structures import Frame

READING_STRIDE = 8  # px between the readings that say what a frame shows
CELL_M = 0.05  # readings in the same cell of this edge show the same surface
LEAST, MOST = 0.2, 8.0  # bounds of the weights, which are 1 or so on the mean: no frame is forgotten, none dominates


def rarity(frames: Sequence[Frame]) -> np.ndarray:
    """How rare it is what each frame shows: (F,) float64, 1 on the mean.

    The mean over a frame's depth readings of 1 / (frames that have a reading in the same cell of `CELL_M`). Visits in
    proportion to it give every cell about as many, where visiting all frames alike gives most to what most of them
    show: the middle of the scene, and places where the walk lingered. A frame without a reading counts as the mean.
    """
    cells = [_cells(frame) for frame in frames]
    seen_in = [np.unique(c) for c in cells]
    if not any(len(c) for c in cells):
        return np.ones(len(frames))
    known, frames_of = np.unique(np.concatenate(seen_in), return_counts=True)
    rare = np.array([np.mean(1 / frames_of[np.searchsorted(known, c)]) if len(c) else np.nan for c in cells])
    rare = np.where(np.isnan(rare), np.nanmean(rare), rare)
    return rare / rare.mean()


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


def _cells(frame: Frame) -> np.ndarray:
    """(N,) int64 names of the cells in which the frame's sparse readings lie."""
    x, y, z = np.floor(depth_samples(frame, READING_STRIDE) / CELL_M).astype(np.int64).T
    return (x << 42) + (y << 21) + z  # 21 bits an axis: 52 km either way
