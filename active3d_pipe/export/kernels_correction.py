# mypy: ignore-errors
"""Where logged readings contradict an SDF, and the truncated signed distance that the readings themselves give.

`rotations` (F, 3, 3) are camera -> world, `centres` (F, 3) m, `lenses` (F, 4) fx fy cx cy, all float32.
"""

import numpy as np
from numba import njit, prange

from active3d_pipe.export.kernels_views import bounding_sphere, flat_cell, meets_frustum, to_cells

CHUNK = 256  # neighbouring points, of which a frame whose frustum misses them all is not asked
SLACK = np.float32(1.001)  # times the radius of a chunk, for rounding


@njit(cache=True)
def open_readings(rotation, centre, lens, depth, stride, reach, origin, inv_cell, counts, most, points):
    """World points of every `stride`-th reading of depth (H, W) whose cell of `counts` holds less than `most`.

    reach: (near, far), m, between which a reading counts. Into points (N, 3) f32; returns how many.
    """
    height, width = depth.shape
    turn, shift = to_cells(rotation, centre, origin, inv_cell)
    flat, half, count = counts.reshape(-1), np.float32(0.5), 0
    inv_x, inv_y = np.float32(1) / lens[0], np.float32(1) / lens[1]
    for i in range(stride // 2, height, stride):
        y = (np.float32(i) + half - lens[3]) * inv_y
        for j in range(stride // 2, width, stride):
            d = depth[i, j]
            if not (d > reach[0] and d < reach[1]):
                continue
            x = (np.float32(j) + half - lens[2]) * inv_x
            cell = flat_cell(turn, shift, x, y, d, counts.shape)
            if cell >= 0 and flat[cell] < most:
                for c in range(3):
                    ray = rotation[c, 0] * x + rotation[c, 1] * y + rotation[c, 2]
                    points[count, c] = ray * d + centre[c]
                count += 1
    return count


@njit(cache=True)
def add_readings(points, values, noise, origin, inv_cell, sums, below, squares, noises, counts):
    """Add values (N,) f32, those below zero, their squares, noise (N,) f32 and 1 to the cells of points (N, 3).

    sums, below, squares, noises (X, Y, Z) f32 and counts i32.
    """
    nx, ny, nz = counts.shape
    for n in range(points.shape[0]):
        x = np.int64(np.floor((points[n, 0] - origin[0]) * inv_cell))
        y = np.int64(np.floor((points[n, 1] - origin[1]) * inv_cell))
        z = np.int64(np.floor((points[n, 2] - origin[2]) * inv_cell))
        if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
            sums[x, y, z] += values[n]
            below[x, y, z] += min(values[n], np.float32(0))
            squares[x, y, z] += values[n] * values[n]
            noises[x, y, z] += noise[n]
            counts[x, y, z] += 1


@njit(parallel=True, cache=True)
def one_sided(sums, below, cells, reach, share, keep):
    """keep (N,) bool: whether around cells (N, 3) the values have the sign of the cell's sum, but for a share of them.

    Of all values within `reach` cells along each axis, those of the other sign sum to at most `share` of the others.
    """
    nx, ny, nz = sums.shape
    for n in prange(cells.shape[0]):
        i, j, k = cells[n, 0], cells[n, 1], cells[n, 2]
        total, negative = 0.0, 0.0
        for a in range(max(i - reach, 0), min(i + reach + 1, nx)):
            for b in range(max(j - reach, 0), min(j + reach + 1, ny)):
                for c in range(max(k - reach, 0), min(k + reach + 1, nz)):
                    total += sums[a, b, c]
                    negative -= below[a, b, c]
        positive = total + negative
        keep[n] = negative <= share * positive if sums[i, j, k] > 0 else positive <= share * negative


@njit(cache=True)
def points_in(points, origin, inv_cell, marks, chosen):
    """Indices of the points (N, 3) in marked cells into chosen (N,) i64; returns how many."""
    nx, ny, nz = marks.shape
    count = 0
    for n in range(points.shape[0]):
        x = np.int64(np.floor((points[n, 0] - origin[0]) * inv_cell))
        y = np.int64(np.floor((points[n, 1] - origin[1]) * inv_cell))
        z = np.int64(np.floor((points[n, 2] - origin[2]) * inv_cell))
        if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz and marks[x, y, z]:
            chosen[count] = n
            count += 1
    return count


@njit(parallel=True, cache=True)
def projective_sdf(points, depths, rotations, centres, lenses, fars, near, truncation, sdf):
    """Mean over frames of depth reading minus depth of the point, clipped to the truncation; NaN where none counts.

    A frame counts where the point is in its image, has a reading, and lies less than `truncation` behind it
    (Curless and Levoy 1996). Near views weigh more, by 1 / z^2: their pixels are smaller. The farther behind its
    reading, the less a frame weighs: on the far side of a thin sheet the views of that side decide.
    fars (F,) float32: the deepest reading of each frame, m. The nearer consecutive points, the fewer frames are asked.
    """
    height, width = depths.shape[1], depths.shape[2]
    for c in prange((points.shape[0] + CHUNK - 1) // CHUNK):
        first, last = c * CHUNK, min((c + 1) * CHUNK, points.shape[0])
        sphere = np.empty(4, np.float32)
        bounding_sphere(points[first:last], sphere)
        sphere[3] *= SLACK
        totals, weights = np.zeros(last - first), np.zeros(last - first)
        for f in range(depths.shape[0]):  # points within: they read neighbouring pixels
            if not meets_frustum(sphere, rotations[f], centres[f], lenses[f], width, height, fars[f] + truncation):
                continue
            for n in range(first, last):
                dx, dy, dz = points[n, 0] - centres[f, 0], points[n, 1] - centres[f, 1], points[n, 2] - centres[f, 2]
                z = rotations[f, 0, 2] * dx + rotations[f, 1, 2] * dy + rotations[f, 2, 2] * dz
                if z < near:
                    continue
                x = rotations[f, 0, 0] * dx + rotations[f, 1, 0] * dy + rotations[f, 2, 0] * dz
                y = rotations[f, 0, 1] * dx + rotations[f, 1, 1] * dy + rotations[f, 2, 1] * dz
                j = np.int64(np.floor(lenses[f, 0] * x / z + lenses[f, 2]))
                i = np.int64(np.floor(lenses[f, 1] * y / z + lenses[f, 3]))
                if i < 0 or j < 0 or i >= height or j >= width:
                    continue
                d = depths[f, i, j]
                ahead = d - z
                if not d > 0.0 or ahead <= -truncation:
                    continue
                w = 1.0 / (z * z)
                if ahead < 0.0:
                    w *= (1.0 + ahead / truncation) ** 2
                totals[n - first] += w * min(ahead, truncation)
                weights[n - first] += w
        for n in range(first, last):
            sdf[n] = totals[n - first] / weights[n - first] if weights[n - first] > 0.0 else np.nan
