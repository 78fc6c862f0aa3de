# mypy: ignore-errors
"""Which faces one frame sees; `isosurface.cull_unseen` explains it."""

import numpy as np
from numba import njit, prange


@njit(parallel=True, fastmath=True, cache=True)
def mark_seen(pending, centroids, normals, rotation, centre, intrinsics, depth, near, tolerance, cosine, seen):
    """Set seen[k] for the faces k of `pending` (M,) that the frame sees.

    centroids, normals (F, 3) float32 world; rotation (3, 3) camera -> world, centre (3,), intrinsics (fx, fy, cx, cy),
    all float32; depth (H, W) float32 m. Every face is written by one task only.
    """
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for m in prange(pending.shape[0]):
        k = pending[m]
        dx, dy, dz = centroids[k, 0] - centre[0], centroids[k, 1] - centre[1], centroids[k, 2] - centre[2]
        z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
        if z <= near:
            continue
        u = fx * (rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz) / z + cx
        v = fy * (rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz) / z + cy
        if u < 0 or v < 0 or u >= width or v >= height:
            continue
        d = depth[int(v), int(u)]
        if d <= 0 or z > d + tolerance:
            continue
        towards = -(normals[k, 0] * dx + normals[k, 1] * dy + normals[k, 2] * dz)
        if towards >= cosine * np.sqrt(dx * dx + dy * dy + dz * dz):
            seen[k] = True
