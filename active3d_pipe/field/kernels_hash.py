# mypy: ignore-errors
"""Multi-resolution hash grid (Mueller et al. 2022): trilinear features of hashed or directly indexed nodes.

All levels lie in one table (nodes, channels). `rows` (L, 3) int64 has one row a level: first entry, entries, nodes
along an axis of the cube when the level is small enough to be indexed directly, else 0. `inv_resolution` (L,) 1/m.

Backward gives every level to one task, so that no two tasks write one entry: the gradient has the same bits on every
run and for every number of threads.
"""

import numpy as np
from numba import njit, prange

F0, F1 = np.float32(0), np.float32(1)
PRIME_Y, PRIME_Z = np.int64(2654435761), np.int64(805459861)
CHUNK = 128


@njit(inline="always")
def _entry(i, j, k, first, size, side):
    """Entry of node (i, j, k) of a level. `size` of hashed levels is a power of two."""
    if side > 0:
        return first + (i * side + j) * side + k
    return first + ((i ^ (j * PRIME_Y) ^ (k * PRIME_Z)) & (size - 1))


@njit(inline="always", fastmath=True)
def _cell(x, inv, last):
    """Lower node and fraction of coordinate x (m from the low corner), clamped to the cube."""
    g = min(max(x * inv, F0), last)
    i = min(np.int64(g), np.int64(last) - 1)
    return i, g - np.float32(i)


@njit(parallel=True, fastmath=True, cache=True)
def hash_forward(points, low, table, rows, inv_res, last, out):
    """Features of points (N, 3) into out (N, levels * channels); `last` (L,) float32 index of the cube's last node."""
    n, channels, levels = points.shape[0], table.shape[1], rows.shape[0]
    chunks = (n + CHUNK - 1) // CHUNK
    for chunk in prange(chunks):
        for p in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            for q in range(levels):
                first, size, side = rows[q, 0], rows[q, 1], rows[q, 2]
                i, fx = _cell(points[p, 0] - low[0], inv_res[q], last[q])
                j, fy = _cell(points[p, 1] - low[1], inv_res[q], last[q])
                k, fz = _cell(points[p, 2] - low[2], inv_res[q], last[q])
                o = q * channels
                for c in range(channels):
                    out[p, o + c] = F0
                for di in range(2):
                    wx = fx if di else F1 - fx
                    for dj in range(2):
                        wxy = wx * (fy if dj else F1 - fy)
                        for dk in range(2):
                            w = wxy * (fz if dk else F1 - fz)
                            e = _entry(i + di, j + dj, k + dk, first, size, side)
                            for c in range(channels):
                                out[p, o + c] += w * table[e, c]


@njit(parallel=True, fastmath=True, cache=True)
def hash_backward(points, low, rows, inv_res, last, d_out, d_table):
    """Adds the gradient of `hash_forward` to d_table; one task a level."""
    n, channels = points.shape[0], d_table.shape[1]
    for q in prange(rows.shape[0]):
        first, size, side = rows[q, 0], rows[q, 1], rows[q, 2]
        o = q * channels
        for p in range(n):
            i, fx = _cell(points[p, 0] - low[0], inv_res[q], last[q])
            j, fy = _cell(points[p, 1] - low[1], inv_res[q], last[q])
            k, fz = _cell(points[p, 2] - low[2], inv_res[q], last[q])
            for di in range(2):
                wx = fx if di else F1 - fx
                for dj in range(2):
                    wxy = wx * (fy if dj else F1 - fy)
                    for dk in range(2):
                        w = wxy * (fz if dk else F1 - fz)
                        e = _entry(i + di, j + dj, k + dk, first, size, side)
                        for c in range(channels):
                            d_table[e, c] += w * d_out[p, o + c]
