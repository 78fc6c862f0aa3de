# mypy: ignore-errors
"""Numba kernels on the voxel grid: truncated distance transforms, geodesic distances."""

import math

import numpy as np
from numba import njit, prange

FAR = np.float32(1e30)


@njit(cache=True)
def _scan_line(line, out, n, reach):
    """Distance along a line to the nearest non-zero element, at most `reach`."""
    d = reach
    for i in range(n):
        d = 0 if line[i] != 0 else min(d + 1, reach)
        out[i] = d
    d = reach
    for i in range(n - 1, -1, -1):
        d = 0 if line[i] != 0 else min(d + 1, reach)
        out[i] = min(out[i], d)


@njit(cache=True)
def _combine(line, out, n, reach, chebyshev):
    """Minimum over offsets r of line[i +- r] joined with r: d2 + r^2, or max(d, r) for the Chebyshev metric."""
    for i in range(n):
        best = line[i]
        for r in range(1, reach + 1):
            floor = r if chebyshev else r * r
            if floor >= best:
                break
            if i - r >= 0:
                d = max(line[i - r], r) if chebyshev else line[i - r] + floor
                best = min(best, d)
            if i + r < n:
                d = max(line[i + r], r) if chebyshev else line[i + r] + floor
                best = min(best, d)
        out[i] = best


@njit(parallel=True, cache=True)
def distance_transform(source, reach, chebyshev):
    """Distance, in voxels, from every voxel to the nearest non-zero one of `source` (uint8 [X, Y, Z]).

    Euclidean: squared, at most reach^2. Chebyshev: at most `reach`. int32. What lies outside the grid counts
    as nothing. Separable, one pass an axis.
    """
    nx, ny, nz = source.shape
    d = np.empty((nx, ny, nz), np.int32)
    for i in prange(nx):
        a, b = np.empty(max(ny, nz), np.int32), np.empty(max(ny, nz), np.int32)
        for j in range(ny):
            _scan_line(source[i, j], a, nz, reach)
            for k in range(nz):
                d[i, j, k] = a[k] if chebyshev else a[k] * a[k]
        for k in range(nz):
            for j in range(ny):
                a[j] = d[i, j, k]
            _combine(a, b, ny, reach, chebyshev)
            for j in range(ny):
                d[i, j, k] = b[j]
    for j in prange(ny):
        a, b = np.empty(nx, np.int32), np.empty(nx, np.int32)
        for k in range(nz):
            for i in range(nx):
                a[i] = d[i, j, k]
            _combine(a, b, nx, reach, chebyshev)
            for i in range(nx):
                d[i, j, k] = b[i]
    return d


@njit(cache=True)
def _push(keys, ids, n, key, v):
    i = n
    while i > 0:
        parent = (i - 1) >> 1
        if keys[parent] <= key:
            break
        keys[i], ids[i] = keys[parent], ids[parent]
        i = parent
    keys[i], ids[i] = key, v
    return n + 1


@njit(cache=True)
def _pop(keys, ids, n):
    """Remove the root; the last element sinks from the top. Returns the new size."""
    n -= 1
    key, v = keys[n], ids[n]
    i = 0
    while True:
        child = 2 * i + 1
        if child >= n:
            break
        if child + 1 < n and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[i], ids[i] = keys[child], ids[child]
        i = child
    keys[i], ids[i] = key, v
    return n


@njit(nogil=True, cache=True)
def geodesic(passable, rate, start, voxel_size, planar, limit):
    """Dijkstra over the 26 neighbours (8 when `planar`) from the voxel `start` (3,).

    An edge costs its length (m) times the mean `rate` of its ends. No corners are cut: a diagonal needs every
    voxel of the box that it spans to be passable. Stops at cost `limit`. Returns cost (FAR = unreachable) and
    the flat id of each voxel's parent (-1 at the start and where unreachable).
    """
    nx, ny, nz = passable.shape
    cost = np.full((nx, ny, nz), FAR, np.float32)
    parent = np.full((nx, ny, nz), -1, np.int32)
    done = np.zeros((nx, ny, nz), np.uint8)
    capacity = 4096
    keys, ids = np.empty(capacity, np.float32), np.empty(capacity, np.int32)
    cost[start[0], start[1], start[2]] = 0
    n = _push(keys, ids, 0, np.float32(0), (start[0] * ny + start[1]) * nz + start[2])
    kz = 0 if planar else 1
    while n > 0:
        v = ids[0]
        n = _pop(keys, ids, n)
        i, j, k = v // (ny * nz), (v // nz) % ny, v % nz
        if done[i, j, k]:
            continue
        done[i, j, k] = 1
        c0 = cost[i, j, k]
        if c0 > limit:
            break
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-kz, kz + 1):
                    x, y, z = i + a, j + b, k + c
                    if x < 0 or y < 0 or z < 0 or x >= nx or y >= ny or z >= nz:
                        continue
                    if passable[x, y, z] == 0 or done[x, y, z]:
                        continue
                    steps = abs(a) + abs(b) + abs(c)
                    if steps > 1:
                        # All voxels of the spanned box: each offset either taken or not.
                        if passable[x, j, k] == 0 or passable[i, y, k] == 0 or passable[i, j, z] == 0:
                            continue
                        if steps == 3 and (
                            passable[x, y, k] == 0 or passable[x, j, z] == 0 or passable[i, y, z] == 0
                        ):
                            continue
                    edge = np.sqrt(np.float32(steps)) * voxel_size
                    new = c0 + edge * np.float32(0.5) * (rate[i, j, k] + rate[x, y, z])
                    if new < cost[x, y, z]:
                        cost[x, y, z] = new
                        parent[x, y, z] = v
                        if n == len(keys):
                            keys = np.concatenate((keys, np.empty(len(keys), np.float32)))
                            ids = np.concatenate((ids, np.empty(len(ids), np.int32)))
                        n = _push(keys, ids, n, new, (x * ny + y) * nz + z)
    return cost, parent


@njit(cache=True)
def mark_spheres(centres, radius, origin, size, out):
    """Set out (X, Y, Z) bool in every voxel whose centre lies within `radius` of one of the centres (N, 3) float64.

    origin (3,) float64 m, lowest corner of the grid; size: edge of a voxel, m.
    """
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(centres.shape[0]):
        for a in range(3):
            low[a] = max(math.floor((centres[n, a] - radius - origin[a]) / size), 0)
            high[a] = min(math.floor((centres[n, a] + radius - origin[a]) / size) + 1, out.shape[a])
        for i in range(low[0], high[0]):
            dx = origin[0] + (i + 0.5) * size - centres[n, 0]
            for j in range(low[1], high[1]):
                dy = origin[1] + (j + 0.5) * size - centres[n, 1]
                for k in range(low[2], high[2]):
                    dz = origin[2] + (k + 0.5) * size - centres[n, 2]
                    if math.sqrt(dx * dx + dy * dy + dz * dz) <= radius:
                        out[i, j, k] = True
