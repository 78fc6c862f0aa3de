# mypy: ignore-errors
"""Numba kernels on the voxel grid: truncated distance transforms, geodesic distances."""

import math

import numpy as np
from numba import njit, prange

FAR = np.float32(1e30)
LOW = np.uint64(0xFFFFFFFF)
ALL_ROWS = (1 << 27) - 1
ALL_BUT_OLDEST = sum(0b110 << 3 * row for row in range(9))
ALL_MOVES = ALL_ROWS & ~(1 << 13)
LEVEL_MOVES = sum(1 << 3 * row + 1 for row in range(9)) & ~(1 << 13)


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
def _nearer(row, beside, step, chebyshev):
    """row = min(row, distance by way of `beside`, which lies `step` away): max(d, step), or d + step of squares."""
    if chebyshev:
        for k in range(row.size):
            row[k] = min(row[k], max(beside[k], step))
    else:
        for k in range(row.size):
            row[k] = min(row[k], row.dtype.type(beside[k] + step))


def distance_transform(source, reach, chebyshev):
    """Distance, in voxels, from every voxel to the nearest non-zero one of `source` (uint8 [X, Y, Z]).

    Euclidean: squared, at most reach^2. Chebyshev: at most `reach`. int16, or int32 where two squares of the reach
    would not fit. What lies outside the grid counts as nothing. Separable, one pass an axis, over whole planes of rows
    along z: the processor takes many voxels at a time.
    """
    dtype = np.int16 if 2 * reach * reach < 1 << 15 else np.int32
    steps = np.arange(reach + 1, dtype=dtype)
    along_z, along_yz = np.empty(source.shape, dtype), np.empty(source.shape, dtype)
    _distance_transform(source, steps if chebyshev else steps * steps, chebyshev, along_z, along_yz)
    return along_z


@njit(parallel=True, cache=True)
def _distance_transform(source, steps, chebyshev, along_z, along_yz):
    """`distance_transform` into `along_z`; `steps` (reach + 1,) what so many voxels along one axis are worth."""
    nx, ny, nz = source.shape
    reach = len(steps) - 1
    plane = ny * nz
    for i in prange(nx):
        line = np.empty(nz, np.int32)
        for j in range(ny):
            _scan_line(source[i, j], line, nz, reach)
            for k in range(nz):
                along_z[i, j, k] = line[k] if chebyshev else line[k] * line[k]
        here, out = along_z[i].ravel(), along_yz[i].ravel()
        out[:] = here
        for r in range(1, min(reach + 1, ny)):
            _nearer(out[r * nz :], here[: plane - r * nz], steps[r], chebyshev)
            _nearer(out[: plane - r * nz], here[r * nz :], steps[r], chebyshev)
    for i in prange(nx):
        out = along_z[i].ravel()
        out[:] = along_yz[i].ravel()
        for other in range(max(i - reach, 0), min(i + reach + 1, nx)):
            if other != i:
                _nearer(out, along_yz[other].ravel(), steps[abs(other - i)], chebyshev)


@njit(inline="always")
def _push(heap, n, entry):
    """Add an entry to the heap of n, whose every node has four children; returns the new size."""
    i = n
    while i > 0:
        above = (i - 1) >> 2
        if heap[np.uintp(above)] <= entry:
            break
        heap[np.uintp(i)] = heap[np.uintp(above)]
        i = above
    heap[np.uintp(i)] = entry
    return n + 1


@njit(inline="always")
def _pop(heap, n):
    """Remove the least entry, the root; the last one sinks from the top. Returns the new size."""
    n -= 1
    entry = heap[np.uintp(n)]
    i = 0
    while True:
        child = 4 * i + 1
        if child >= n:
            break
        least, value = child, heap[np.uintp(child)]
        for c in range(child + 1, min(child + 4, n)):
            if heap[np.uintp(c)] < value:
                least, value = c, heap[np.uintp(c)]
        if value >= entry:
            break
        heap[np.uintp(i)] = value
        i = least
    heap[np.uintp(i)] = entry
    return n


@njit(cache=True)
def _moves_at(passable, i, j, k):
    """Bits of `open_moves` of one voxel, level or not."""
    nx, ny, nz = passable.shape
    bits = 0
    for m in range(27):
        x, y, z = i + m // 9 - 1, j + m // 3 % 3 - 1, k + m % 3 - 1
        steps = (x != i) + (y != j) + (z != k)
        if steps == 0 or x < 0 or y < 0 or z < 0 or x >= nx or y >= ny or z >= nz or passable[x, y, z] == 0:
            continue
        if steps > 1 and (passable[x, j, k] == 0 or passable[i, y, k] == 0 or passable[i, j, z] == 0):
            continue
        if steps == 3 and (passable[x, y, k] == 0 or passable[x, j, z] == 0 or passable[i, y, z] == 0):
            continue
        bits |= 1 << m
    return bits


@njit(parallel=True, cache=True)
def open_moves(passable, planar):
    """Which of its 26 neighbours (8 when `planar`) each passable voxel may be left for; int32 bits [X, Y, Z].

    Bit 9 (a + 1) + 3 (b + 1) + c + 1 stands for the step (a, b, c). No corners are cut: a diagonal needs every voxel of
    the box that it spans to be passable. passable: uint8 [X, Y, Z], 1 or 0.
    """
    nx, ny, nz = passable.shape
    out = np.zeros((nx, ny, nz), np.int32)
    allowed = LEVEL_MOVES if planar else ALL_MOVES
    for i in prange(nx):
        for j in range(ny):
            inside = 0 < i < nx - 1 and 0 < j < ny - 1
            around = 0  # nine rows along z of the voxels k - 1, k, k + 1, three bits each; the newest is the lowest
            for k in range(nz):
                if inside and k + 1 < nz:
                    newest = 0
                    for row in range(9):
                        newest |= np.int64(passable[i + row // 3 - 1, j + row % 3 - 1, k + 1]) << (3 * row)
                    around = (around << 1) & ALL_BUT_OLDEST | newest
                if passable[i, j, k] == 0:
                    continue
                if inside and 0 < k < nz - 1 and around == ALL_ROWS:
                    out[i, j, k] = allowed
                else:
                    out[i, j, k] = _moves_at(passable, i, j, k) & allowed
    return out


@njit(nogil=True, cache=True)
def geodesic(moves, rate, start, voxel_size, limit):
    """Dijkstra along `moves` (`open_moves`) from the voxel `start` (3,).

    An edge costs its length (m) times the mean `rate` of its ends. Voxels of equal cost are left in the order of their
    ids. Stops at cost `limit`. Returns cost (FAR = unreachable) and the flat id of each voxel's parent (-1 at the start
    and where unreachable).
    """
    nx, ny, nz = moves.shape
    cost, parent = np.full(nx * ny * nz, FAR, np.float32), np.full(nx * ny * nz, -1, np.int32)
    # Costs are not negative, so their bits have their order: a heap entry is (bits of the cost, voxel) in one integer.
    cost_bits = cost.view(np.uint32)
    bits, rates = moves.reshape(-1), rate.reshape(-1)
    offset, half_length = np.zeros(27, np.int64), np.zeros(27, np.float32)
    for m in range(27):
        a, b, c = m // 9 - 1, m // 3 % 3 - 1, m % 3 - 1
        offset[m] = (a * ny + b) * nz + c
        half_length[m] = np.sqrt(np.float32(abs(a) + abs(b) + abs(c))) * voxel_size * np.float32(0.5)
    heap = np.empty(4096, np.uint64)
    first = (start[0] * ny + start[1]) * nz + start[2]
    cost[first] = 0
    n = _push(heap, 0, np.uint64(first))
    while n > 0:
        entry = heap[0]
        n = _pop(heap, n)
        v = np.uintp(entry & LOW)
        if np.uint32(entry >> np.uint64(32)) > cost_bits[v]:
            continue  # a cheaper way was found after this one
        c0, moves_here, rate_here = cost[v], bits[v], rates[v]
        if c0 > limit:
            break
        if n + 27 > len(heap):
            heap = np.concatenate((heap, np.empty(len(heap), np.uint64)))
        for m in range(27):
            if moves_here >> m & 1 == 0:
                continue
            u = np.uintp(np.int64(v) + offset[m])
            if cost[u] <= c0:
                continue
            new = c0 + half_length[m] * (rate_here + rates[u])
            if new < cost[u]:
                cost[u], parent[u] = new, v
                n = _push(heap, n, np.uint64(cost_bits[u]) << np.uint64(32) | np.uint64(u))
    return cost.reshape(moves.shape), parent.reshape(moves.shape)


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
