# mypy: ignore-errors
"""TSDF fusion over sparse blocks of voxels, and trilinear queries of it.

A block holds BLOCK^3 voxels; `index` (X, Y, Z) int32 has its row in `values` (B, BLOCK^3, 6) or -1. A voxel is tsdf (in
truncations), weight, r, g, b (0..1), weight of the colour; its centre lies at low + (ijk + 0.5) * voxel. Every block is
one task.
"""

import math

import numpy as np
from numba import njit, prange

F0, F1, HALF = np.float32(0), np.float32(1), np.float32(0.5)
BLOCK = 8
TINY = np.float32(1e-6)
CHUNK = 128


@njit(cache=True)
def mark_blocks(depth, R, t, camera, low, block_m, truncation, stride, marks):
    """Set marks (X, Y, Z) of the blocks within the truncation of the readings; `camera` = fx, fy, cx, cy."""
    steps = math.ceil(np.float32(2) * truncation / (HALF * block_m)) + 1
    for r in range(0, depth.shape[0], stride):
        for c in range(0, depth.shape[1], stride):
            d = depth[r, c]
            if not d > F0:
                continue
            x, y = (np.float32(c) + HALF - camera[2]) / camera[0], (np.float32(r) + HALF - camera[3]) / camera[1]
            for s in range(steps):
                z = d - truncation + np.float32(2) * truncation * np.float32(s) / np.float32(steps - 1)
                inside = True
                i = math.floor((R[0, 0] * x * z + R[0, 1] * y * z + R[0, 2] * z + t[0] - low[0]) / block_m)
                j = math.floor((R[1, 0] * x * z + R[1, 1] * y * z + R[1, 2] * z + t[1] - low[1]) / block_m)
                k = math.floor((R[2, 0] * x * z + R[2, 1] * y * z + R[2, 2] * z + t[2] - low[2]) / block_m)
                cell = (i, j, k)
                for a in range(3):
                    inside = inside and 0 <= cell[a] < marks.shape[a]
                if inside:
                    marks[cell] = True


@njit(parallel=True, fastmath=True, cache=True)
def integrate(depth, rgb, R, t, camera, low, voxel, truncation, blocks, rows, values):
    """Running mean of truncated projective distance and colour; R (3, 3), t (3,) world to camera.

    `blocks` (M, 3) block coordinates, `rows` (M,) their rows in `values`; rgb (H, W, 3) uint8.
    """
    height, width = depth.shape
    byte = np.float32(1 / 255)
    for m in prange(len(blocks)):
        row = rows[m]
        for v in range(BLOCK * BLOCK * BLOCK):
            i, j, k = v // (BLOCK * BLOCK), (v // BLOCK) % BLOCK, v % BLOCK
            x = low[0] + (np.float32(blocks[m, 0] * BLOCK + i) + HALF) * voxel
            y = low[1] + (np.float32(blocks[m, 1] * BLOCK + j) + HALF) * voxel
            z = low[2] + (np.float32(blocks[m, 2] * BLOCK + k) + HALF) * voxel
            zc = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
            if zc <= F0:
                continue
            u = camera[0] * (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) / zc + camera[2]
            w = camera[1] * (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) / zc + camera[3]
            if not (F0 <= u < np.float32(width) and F0 <= w < np.float32(height)):
                continue
            c, r = int(u), int(w)
            d = depth[r, c]
            gap = d - zc
            if d <= F0 or gap < -truncation:
                continue
            old = values[row, v, 1]
            share = F1 / (old + F1)
            values[row, v, 0] += (min(gap / truncation, F1) - values[row, v, 0]) * share
            values[row, v, 1] = old + F1
            if gap > truncation:
                continue  # a ray that passes in front of another surface carries that one's colour
            old = values[row, v, 5]
            values[row, v, 5] = old + F1
            for a in range(3):
                values[row, v, 2 + a] += (np.float32(rgb[r, c, a]) * byte - values[row, v, 2 + a]) / (old + F1)


@njit(parallel=True, fastmath=True, cache=True)
def interpolate(points, low, voxel, index, values, out):
    """Means (N, 5) of the eight voxels around points (N, 3): tsdf and weight of those that were observed, colour of
    those that have one. Weight 0 = none was observed."""
    n = len(points)
    chunks = (n + CHUNK - 1) // CHUNK
    for chunk in prange(chunks):
        for p in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            gx = (points[p, 0] - low[0]) / voxel - HALF
            gy = (points[p, 1] - low[1]) / voxel - HALF
            gz = (points[p, 2] - low[2]) / voxel - HALF
            i, j, k = math.floor(gx), math.floor(gy), math.floor(gz)
            fx, fy, fz = gx - np.float32(i), gy - np.float32(j), gz - np.float32(k)
            total, colored = F0, F0
            for a in range(5):
                out[p, a] = F0
            for corner in range(8):
                di, dj, dk = corner >> 2, (corner >> 1) & 1, corner & 1
                x, y, z = i + di, j + dj, k + dk
                bx, by, bz = x // BLOCK, y // BLOCK, z // BLOCK
                if not (
                    0 <= bx < index.shape[0] and 0 <= by < index.shape[1] and 0 <= bz < index.shape[2]
                ):
                    continue
                row = index[bx, by, bz]
                if row < 0:
                    continue
                v = ((x - bx * BLOCK) * BLOCK + y - by * BLOCK) * BLOCK + z - bz * BLOCK
                w = (fx if di else F1 - fx) * (fy if dj else F1 - fy) * (fz if dk else F1 - fz)
                if values[row, v, 1] > F0:
                    total += w
                    for a in range(2):
                        out[p, a] += w * values[row, v, a]
                if values[row, v, 5] > F0:
                    colored += w
                    for a in range(2, 5):
                        out[p, a] += w * values[row, v, a]
            if total > TINY:
                out[p, 0] /= total
                out[p, 1] /= total
            else:
                out[p, 0], out[p, 1] = F1, F0
            for a in range(2, 5):
                out[p, a] = out[p, a] / colored if colored > TINY else F0
