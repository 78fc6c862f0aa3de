# mypy: ignore-errors
"""Encoders of the implicit branch: OneBlob, multi-resolution tri-plane, dense feature grid.

Tables are channel-last, so that one node is one or two cache lines. Nodes sit on the corners of the cells:
node i of an axis lies at low + (first + i) * resolution. `low` is where the box of the field once began and never
moves; `first` is 0 at creation and negative after the box grew downwards, so that a point keeps its cell and its
fractions, bit by bit. Points outside the tables are clamped to their border.

The plane tables of all levels are one array (nodes, channels). `layout` (P, 8) int64 has one row a plane: first node
of the table, nodes along axis a, nodes along axis b, axis a, axis b, level, `first` along a and b. The three planes
of a level are summed.

Backward gives every plane to one task and splits the grid into slabs, so that no two tasks write one node:
the gradient has the same bits on every run and for every number of threads.
"""

import math

import numpy as np
from numba import njit, prange

F0, F1, HALF = np.float32(0), np.float32(1), np.float32(0.5)
C3, C5, C15_16 = np.float32(2 / 3), np.float32(0.2), np.float32(15 / 16)
CHUNK = 128
GRID_SLABS = 4
ONE, TWO, THREE = np.uintp(1), np.uintp(2), np.uintp(3)


@njit(inline="always", fastmath=True)
def _quartic_cdf(u):
    """Integral of the quartic kernel 15/16 (1 - u^2)^2 from -1 to u."""
    u = min(max(u, -F1), F1)
    u2 = u * u
    return C15_16 * u * (F1 - C3 * u2 + C5 * u2 * u2) + HALF


@njit(inline="always", fastmath=True)
def _cell(x, inv, first, n):
    """Lower node and fraction of coordinate x (m from `low`) on an axis of n nodes, the lowest of them `first`."""
    g = min(max(x * inv, np.float32(first)), np.float32(first + n - 1))
    i = min(np.int64(math.floor(g)), first + n - 2)
    return i - first, g - np.float32(i)


@njit(parallel=True, fastmath=True, cache=True)
def oneblob(points, low, inv_extent, bins, out):
    """OneBlob values (Mueller et al. 2019) of points (N, 3) into out[:, :3 * bins]."""
    n = points.shape[0]
    fbins = np.float32(bins)
    for p in prange(n):
        for a in range(3):
            x = (points[p, a] - low[a]) * inv_extent[a]
            x = min(max(x, F0), F1) * fbins
            previous = _quartic_cdf(-x)
            for j in range(bins):
                value = _quartic_cdf(np.float32(j + 1) - x)
                out[p, a * bins + j] = value - previous
                previous = value


@njit(parallel=True, fastmath=True, cache=True)
def planes_forward(points, low, planes, layout, inv_res, out, col):
    """Tri-plane features of points (N, 3) into out[:, col : col + levels * channels]."""
    n, channels = points.shape[0], planes.shape[1]
    levels = layout[-1, 5] + 1
    chunks = (n + CHUNK - 1) // CHUNK
    for k in prange(chunks):
        for p in range(k * CHUNK, min(n, (k + 1) * CHUNK)):
            for c in range(levels * channels):
                out[p, col + c] = F0
            for q in range(layout.shape[0]):
                nb = layout[q, 2]
                a, b = layout[q, 3], layout[q, 4]
                i, fa = _cell(points[p, a] - low[a], inv_res[q], layout[q, 6], layout[q, 1])
                j, fb = _cell(points[p, b] - low[b], inv_res[q], layout[q, 7], nb)
                node = layout[q, 0] + i * nb + j
                w11 = fa * fb
                w10 = fa - w11
                w01 = fb - w11
                w00 = F1 - fa - fb + w11
                o = col + layout[q, 5] * channels
                for c0 in range(0, channels, 8):
                    for c in range(8):
                        out[p, o + c0 + c] += (
                            w00 * planes[node, c0 + c] + w01 * planes[node + 1, c0 + c]
                            + w10 * planes[node + nb, c0 + c] + w11 * planes[node + nb + 1, c0 + c]
                        )


@njit(parallel=True, fastmath=True, cache=True)
def grid_forward(points, low, first, grid, inv_res, out, col):
    """Trilinear features of the dense grid (X, Y, Z, channels) into out[:, col : col + channels]."""
    n = points.shape[0]
    nx, ny, nz, channels = grid.shape
    for p in prange(n):
        i, fx = _cell(points[p, 0] - low[0], inv_res, first[0], nx)
        j, fy = _cell(points[p, 1] - low[1], inv_res, first[1], ny)
        k, fz = _cell(points[p, 2] - low[2], inv_res, first[2], nz)
        for c0 in range(0, channels, 4):
            for c in range(4):
                out[p, col + c0 + c] = F0
        for di in range(2):
            wx = fx if di else F1 - fx
            for dj in range(2):
                wxy = wx * (fy if dj else F1 - fy)
                w0, w1 = wxy * (F1 - fz), wxy * fz
                for c0 in range(0, channels, 4):
                    for c in range(4):
                        out[p, col + c0 + c] += (
                            w0 * grid[i + di, j + dj, k, c0 + c] + w1 * grid[i + di, j + dj, k + 1, c0 + c]
                        )


@njit(fastmath=True, cache=True)
def _plane_backward(points, low, layout, inv_res, q, d_out, col, d_planes):
    channels = d_planes.shape[1]
    start, na, nb, a, b = layout[q, 0], layout[q, 1], layout[q, 2], layout[q, 3], layout[q, 4]
    o = col + layout[q, 5] * channels
    for p in range(points.shape[0]):
        i, fa = _cell(points[p, a] - low[a], inv_res[q], layout[q, 6], na)
        j, fb = _cell(points[p, b] - low[b], inv_res[q], layout[q, 7], nb)
        node = start + i * nb + j
        w11 = fa * fb
        w10 = fa - w11
        w01 = fb - w11
        w00 = F1 - fa - fb + w11
        for c0 in range(0, channels, 8):
            for c in range(8):
                g = d_out[p, o + c0 + c]
                d_planes[node, c0 + c] += w00 * g
                d_planes[node + 1, c0 + c] += w01 * g
                d_planes[node + nb, c0 + c] += w10 * g
                d_planes[node + nb + 1, c0 + c] += w11 * g


@njit(fastmath=True, cache=True)
def _grid_slab_backward(points, low, first, inv_res, start, stop, d_out, col, d_grid):
    """Adds to the nodes start <= i < stop along x only."""
    nx, ny, nz, channels = d_grid.shape
    for p in range(points.shape[0]):
        i, fx = _cell(points[p, 0] - low[0], inv_res, first[0], nx)
        if i + 1 < start or i >= stop:
            continue
        j, fy = _cell(points[p, 1] - low[1], inv_res, first[1], ny)
        k, fz = _cell(points[p, 2] - low[2], inv_res, first[2], nz)
        for di in range(2):
            if i + di < start or i + di >= stop:
                continue
            wx = fx if di else F1 - fx
            for dj in range(2):
                wxy = wx * (fy if dj else F1 - fy)
                w0, w1 = wxy * (F1 - fz), wxy * fz
                for c0 in range(0, channels, 4):
                    for c in range(4):
                        g = d_out[p, col + c0 + c]
                        d_grid[i + di, j + dj, k, c0 + c] += w0 * g
                        d_grid[i + di, j + dj, k + 1, c0 + c] += w1 * g


@njit(parallel=True, fastmath=True, cache=True)
def planes_backward(points, low, layout, inv_res, d_out, col, d_planes):
    """Adds the gradient of `planes_forward` to d_planes; one task a plane."""
    for q in prange(layout.shape[0]):
        _plane_backward(points, low, layout, inv_res, q, d_out, col, d_planes)


@njit(parallel=True, fastmath=True, cache=True)
def grid_backward(points, low, first, inv_res, d_out, col, d_grid):
    """Adds the gradient of `grid_forward` to d_grid; one task a slab along x."""
    nx = d_grid.shape[0]
    for s in prange(GRID_SLABS):
        _grid_slab_backward(
            points, low, first, inv_res, s * nx // GRID_SLABS, (s + 1) * nx // GRID_SLABS, d_out, col, d_grid
        )


@njit(parallel=True, fastmath=True, cache=True)
def decode_points(
    points, low, blob_low, inv_extent, bins, planes, layout, inv_res, grid_first, grid, inv_grid, w1, b1, w2, b2, out
):
    """Encoding and a two-layer ReLU decoder in one pass, without gradients.

    w1 (3 bins + levels * channels + grid channels, hidden), b1 (hidden,), w2 (outputs, hidden), b2 (outputs,),
    out (N, outputs); hidden is a multiple of 8, channels of 8, grid channels of 4. At most three bins of an axis are
    not zero, so OneBlob costs nine rows of w1, not 3 bins.
    """
    n, hidden, outputs = points.shape[0], np.uintp(w1.shape[1]), np.uintp(w2.shape[0])
    channels, grid_channels = np.uintp(planes.shape[1]), np.uintp(grid.shape[3])
    nx, ny, nz = grid.shape[:3]
    width = np.uintp(layout[-1, 5] + 1) * channels
    fbins = np.float32(bins)
    chunks = (n + CHUNK - 1) // CHUNK
    for part in prange(chunks):
        h = np.empty(hidden, np.float32)
        f = np.empty(width + grid_channels, np.float32)
        for p in range(part * CHUNK, min(n, (part + 1) * CHUNK)):
            p = np.uintp(p)
            for c in range(width + grid_channels):
                f[np.uintp(c)] = F0
            for q in range(np.uintp(layout.shape[0])):
                q = np.uintp(q)
                nb = layout[q, 2]
                a, b = np.uintp(layout[q, 3]), np.uintp(layout[q, 4])
                i, fa = _cell(points[p, a] - low[a], inv_res[q], layout[q, 6], layout[q, 1])
                j, fb = _cell(points[p, b] - low[b], inv_res[q], layout[q, 7], nb)
                n00 = np.uintp(layout[q, 0] + i * nb + j)
                n10 = n00 + np.uintp(nb)
                n01, n11 = n00 + ONE, n10 + ONE
                w11 = fa * fb
                w10 = fa - w11
                w01 = fb - w11
                w00 = F1 - fa - fb + w11
                o = np.uintp(layout[q, 5]) * channels
                for c in range(channels):
                    c = np.uintp(c)
                    f[o + c] += (
                        w00 * planes[n00, c] + w01 * planes[n01, c] + w10 * planes[n10, c] + w11 * planes[n11, c]
                    )
            i, fx = _cell(points[p, 0] - low[0], inv_grid, grid_first[0], nx)
            j, fy = _cell(points[p, 1] - low[1], inv_grid, grid_first[1], ny)
            m, fz = _cell(points[p, 2] - low[2], inv_grid, grid_first[2], nz)
            i, j, m = np.uintp(i), np.uintp(j), np.uintp(m)
            for di in range(np.uintp(2)):
                wx = fx if di else F1 - fx
                for dj in range(np.uintp(2)):
                    wxy = wx * (fy if dj else F1 - fy)
                    below, above = wxy * (F1 - fz), wxy * fz
                    ii, jj = i + np.uintp(di), j + np.uintp(dj)
                    for c in range(grid_channels):
                        c = np.uintp(c)
                        f[width + c] += below * grid[ii, jj, m, c] + above * grid[ii, jj, m + ONE, c]

            for c in range(hidden):
                c = np.uintp(c)
                h[c] = b1[c]
            # Several rows at a time: adding to h is a chain of loads and stores, each waiting for the one before.
            for axis in range(3):
                x = (points[p, axis] - blob_low[axis]) * inv_extent[axis]
                x = min(max(x, F0), F1) * fbins
                j = min(max(np.int64(x) - 1, 0), bins - 2)
                e0, e1 = _quartic_cdf(np.float32(j) - x), _quartic_cdf(np.float32(j + 1) - x)
                e2, e3 = _quartic_cdf(np.float32(j + 2) - x), _quartic_cdf(np.float32(j + 3) - x)
                v0, v1, row = e1 - e0, e2 - e1, np.uintp(axis * bins + j)
                v2, last = (e3 - e2, row + TWO) if j + 2 < bins else (F0, row + ONE)
                for c in range(hidden):
                    c = np.uintp(c)
                    h[c] += v0 * w1[row, c] + v1 * w1[row + ONE, c] + v2 * w1[last, c]
            for r in range(np.uintp(0), width + grid_channels, np.uintp(4)):
                r = np.uintp(r)
                v0, v1, v2, v3 = f[r], f[r + ONE], f[r + TWO], f[r + THREE]
                row = np.uintp(3 * bins) + r
                for c in range(hidden):
                    c = np.uintp(c)
                    h[c] += (
                        v0 * w1[row, c] + v1 * w1[row + ONE, c] + v2 * w1[row + TWO, c] + v3 * w1[row + THREE, c]
                    )
            for o in range(outputs):
                o = np.uintp(o)
                s = b2[o]
                for c in range(hidden):
                    c = np.uintp(c)
                    s += max(h[c], F0) * w2[o, c]
                out[p, o] = s
