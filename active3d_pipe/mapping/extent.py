"""The box of the map when nobody gave one: found in the depth readings, and grown with them.

A reading is believed when its neighbours in the image agree with it, not when it is one of many: a thin far part is
few readings that agree, an outlier of the sensor is one that stands alone. The box holds every believed reading and
every camera, so it holds every ray between them too, and it reaches `margin_m` farther: around what was seen there is
always space that was not.
"""

from collections.abc import Sequence

import numpy as np

from active3d_pipe.mapping.config import ExtentSettings
from active3d_pipe.structures import Frame

STRIDE = 2  # every n-th pixel in x and y is looked at; which ones shifts with the step
REACH = 2  # half size of the neighbourhood of a reading, px
ENOUGH = 4  # readings of it that must agree: what a line of one pixel's width has
AGREEMENT = 0.03  # relative difference of depths that agree: along a row of the image a floor changes less, however far
AROUND_CAMERA_M = 0.5  # the box holds this much around every camera
FIRST_STEP_M = 0.1  # the first box fits what was seen to this length


def first_box(frames: Sequence[Frame], settings: ExtentSettings) -> np.ndarray:
    """(2, 3) float64 corners, world, m, of the box of the first frames: twice the margin around what they read."""
    centre = np.round(frames[0].T_world_camera[:3, 3], 3)
    seed = np.stack([centre - AROUND_CAMERA_M, centre + AROUND_CAMERA_M])
    seen = _seen(frames, seed)
    return _grown(seed, seen, 2 * settings.margin_m, FIRST_STEP_M, settings)


def grown_box(box: np.ndarray, frames: Sequence[Frame], settings: ExtentSettings) -> np.ndarray:
    """`box` (2, 3), or a larger one when readings of `frames` come nearer to its border than the margin.

    A side that must give way moves by whole chunks. The limits on edges and volume hold back the side that wants most.
    """
    inner = np.stack([box[0] + settings.margin_m, box[1] - settings.margin_m])
    return _grown(box, _seen(frames, inner), settings.margin_m, settings.chunk_m, settings)


def _grown(box: np.ndarray, seen: np.ndarray, margin: float, chunk: float, settings: ExtentSettings) -> np.ndarray:
    missing = np.stack([box[0] - (seen[0] - margin), seen[1] + margin - box[1]])
    chunks = np.maximum(np.ceil(missing / chunk - 1e-6), 0).astype(np.int64)
    while chunks.any():
        size = box[1] - box[0] + chunk * chunks.sum(axis=0)
        too_much = (chunks > 0) & (size > settings.max_extent_m + 1e-6)
        if not too_much.any() and np.prod(size) > settings.max_volume_m3:
            too_much = chunks > 0
        if not too_much.any():
            break
        chunks[np.unravel_index(np.argmax(np.where(too_much, chunks, 0)), chunks.shape)] -= 1
    return np.round(box + np.array([[-1.0], [1.0]]) * chunk * chunks, 6)


def _seen(frames: Sequence[Frame], inner: np.ndarray) -> np.ndarray:
    """(2, 3) float64 corners of the smallest box that holds `inner`, the cameras and the believed readings."""
    low, high = inner.copy()
    for frame in frames:
        position = frame.T_world_camera[:3, 3]
        low = np.minimum(low, position - AROUND_CAMERA_M)
        high = np.maximum(high, position + AROUND_CAMERA_M)
        points = _beyond(frame, low, high)
        if len(points):
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    return np.stack([low, high])


def _beyond(frame: Frame, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(N, 3) float64 world positions of the believed readings outside [low, high]; those beyond `far` count there."""
    c, R = frame.camera, frame.T_world_camera[:3, :3]
    i = np.arange(frame.step // STRIDE % STRIDE, c.height, STRIDE)
    j = np.arange(frame.step % STRIDE, c.width, STRIDE)
    z = _clipped(frame.depth[i[0] :: STRIDE, j[0] :: STRIDE], c.near, c.far)
    u, v = ((j + 0.5 - c.cx) / c.fx).astype(np.float32), ((i + 0.5 - c.cy) / c.fy).astype(np.float32)
    position = frame.T_world_camera[:3, 3]
    outside = np.zeros(z.shape, bool)
    for a in range(3):
        along = z * (np.float32(R[a, 0]) * u + (np.float32(R[a, 1]) * v + np.float32(R[a, 2]))[:, None])
        outside |= (along < low[a] - position[a]) | (along > high[a] - position[a])
    rows, columns = np.nonzero(outside & (z > 0))
    if not len(rows):
        return np.zeros((0, 3))
    z = z[rows, columns].astype(np.float64)
    believed = _agreeing(frame, i[rows], j[columns], z) >= ENOUGH
    z, u, v = z[believed], u[columns[believed]], v[rows[believed]]
    return np.stack([u * z, v * z, z], axis=-1) @ R.T + position


def _clipped(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth in m up to `far`, 0 where there is no reading."""
    reading = (depth > 0) & (depth >= np.float32(near)) & (depth < np.inf)  # a NaN is none either
    return np.where(reading, np.minimum(depth, np.float32(far)), np.float32(0))


def _agreeing(frame: Frame, rows: np.ndarray, columns: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(N,) number of neighbours of pixels whose readings agree with theirs, `z` (N,) m."""
    depth = np.pad(_clipped(frame.depth, frame.camera.near, frame.camera.far), REACH)
    count = np.zeros(len(z), np.int64)
    for di in range(2 * REACH + 1):
        for dj in range(2 * REACH + 1):
            if (di, dj) != (REACH, REACH):
                count += np.abs(depth[rows + di, columns + dj] - z) <= AGREEMENT * z
    return count
