"""Which of many logged frames stand for all of them: what few frames show must not be lost."""

import heapq
from collections.abc import Sequence

import numpy as np

from active3d_pipe.geometry.sampling import spread
from active3d_pipe.mapping.keyframes import depth_samples
from active3d_pipe.structures import Frame

READING_STRIDE = 8  # px between the readings that say what a frame shows
CELL_M = 0.1  # readings in one cell of this edge show the same surface
VIEWS = 3  # frames that should show every cell, if so many do
EVEN_SHARE = 0.6  # of the chosen frames, evenly spread over the walk whatever they show
_REACH = 1 << 20  # cells to either side of the origin that have a number


def surface_cells(frame: Frame) -> np.ndarray:
    """Ascending int64 numbers of the cells of space, world, that hold readings of a frame."""
    i, j, k = (np.floor(depth_samples(frame, READING_STRIDE) / CELL_M).astype(np.int64) + _REACH).T
    return np.unique((i * 2 * _REACH + j) * 2 * _REACH + k)


def covering(cells: Sequence[np.ndarray], most: int) -> list[int]:
    """Ascending indices of at most `most` frames; `cells` are the `surface_cells` of each.

    Most of them are evenly spread; the others are taken one by one, each the frame with the most cells that fewer than
    `VIEWS` of the chosen ones show (the first of equals), until nothing is left to gain, then evenly again. Frames of
    equal distance in the walk alone would leave out what the camera saw in passing.
    """
    count = len(cells)
    if count <= most:
        return list(range(count))
    _, cell = np.unique(np.concatenate(cells), return_inverse=True)
    shown = np.split(cell.ravel(), np.cumsum([len(c) for c in cells])[:-1])
    missing = np.minimum(np.bincount(cell.ravel()), VIEWS)
    chosen = set(spread(range(count), int(EVEN_SHARE * most)))
    for frame in chosen:
        missing[shown[frame]] -= 1

    def gain(frame: int) -> int:
        return int((missing[shown[frame]] > 0).sum())

    # A frame's gain never grows, so an old value is a bound: only the leader's is computed again.
    leaders = [(-gain(frame), frame) for frame in range(count) if frame not in chosen]
    heapq.heapify(leaders)
    while leaders and leaders[0][0] < 0 and len(chosen) < most:
        frame = heapq.heappop(leaders)[1]
        now = gain(frame)
        if leaders and (-now, frame) > leaders[0]:
            heapq.heappush(leaders, (-now, frame))
        else:
            chosen.add(frame)
            missing[shown[frame]] -= 1
    left = [frame for frame in range(count) if frame not in chosen]
    return sorted(chosen.union(spread(left, most - len(chosen))))
