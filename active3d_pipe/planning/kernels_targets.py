# mypy: ignore-errors
"""Numba kernels of targets: what is most worth seeing, and places from which it can be; slow twins in the tests."""

import numpy as np
from numba import njit, prange

from active3d_pipe.planning.kernels_sight import cell_bit

ZERO, QUARTER, HALF, ONE = np.float32(0.0), np.float32(0.25), np.float32(0.5), np.float32(1.0)


@njit(cache=True)
def best_of_each_block(worth, block):
    """(flat voxel of the most worth, sum of the worth) of each block of block^3 voxels of (X, Y, Z); int64, float64.

    What has no worth does not count; -1 where a block has none. Ties: the first voxel.
    """
    nx, ny, nz = worth.shape
    by, bz = ny // block + 1, nz // block + 1
    first = np.full((nx // block + 1) * by * bz, -1, np.int64)
    total, most = np.zeros(first.size), np.zeros(first.size, worth.dtype)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                w = worth[i, j, k]
                if not w > 0:
                    continue
                b = (i // block * by + j // block) * bz + k // block
                total[b] += w
                if w > most[b]:
                    most[b] = w
                    first[b] = (i * ny + j) * nz + k
    return first, total


@njit(parallel=True, cache=True)
def best_viewpoints(
    targets, cells, places, opaque, clear, through, normal, shape, nearest, farthest, falloff, steps, view_steps
):
    """For every target voxel the places with the best look and with the best look per step to get there.

    targets (T, 3), places (P, 3) int32 voxels; `cells` (T,) uint8 is the bit of the half-size cell that is meant, 0 =
    the whole voxel; `opaque` (flat uint8) stops sight outside the cells of `clear`, `through` (flat float32) is the
    transmittance of a voxel; `normal` (size, 3) int8 the side that a surface target is seen from, zero = any
    (of a cell, any that has sight).
    Distances in voxels: places `nearest`..`farthest` from the target are tried, beyond `falloff` a look loses with
    1 / distance. `steps` (P,) float32 until the place is reached. A look is worth its transmittance times that
    loss times |cos| of incidence. Returns (T, 2) int32 indices into `places`, -1 = none sees it; ties: the first.
    """
    ny, nz = shape[1], shape[2]
    out = np.full((targets.shape[0], 2), -1, np.int32)
    for n in prange(targets.shape[0]):
        ti, tj, tk = targets[n, 0], targets[n, 1], targets[n, 2]
        target = (ti * ny + tj) * nz + tk
        a, b, c = np.float32(normal[target, 0]), np.float32(normal[target, 1]), np.float32(normal[target, 2])
        norm = np.sqrt(a * a + b * b + c * c)
        ox, oy, oz = np.float32(ti) + HALF, np.float32(tj) + HALF, np.float32(tk) + HALF
        pieces = 1
        if cells[n]:
            norm, pieces = ZERO, 2
            cell = 0
            while cells[n] >> cell > 1:
                cell += 1
            ox += QUARTER if cell & 4 else -QUARTER
            oy += QUARTER if cell & 2 else -QUARTER
            oz += QUARTER if cell & 1 else -QUARTER
        best, best_rate = np.float32(0.05), ZERO
        for p in range(places.shape[0]):
            x = np.float32(places[p, 0]) + HALF - ox
            y = np.float32(places[p, 1]) + HALF - oy
            z = np.float32(places[p, 2]) + HALF - oz
            distance = np.sqrt(x * x + y * y + z * z)
            if distance < nearest or distance > farthest:
                continue
            look = min(ONE, falloff / distance)
            if norm > ONE:
                cos = (a * x + b * y + c * z) / (norm * distance)
                if cos <= ZERO:
                    continue
                look *= cos
            beaten = min(best, best_rate * (steps[p] + view_steps))  # a look worth no more changes nothing
            if look <= beaten:
                continue
            m = pieces * int(np.ceil(distance))
            passed = ONE
            last = -1
            for s in range(1, m):
                f = np.float32(s) / np.float32(m)
                fx, fy, fz = ox + f * x, oy + f * y, oz + f * z
                v = (int(fx) * ny + int(fy)) * nz + int(fz)
                if opaque[v]:
                    if v == target and (cells[n] == 0 or cell_bit(fx, fy, fz) == cells[n]):
                        continue
                    if not clear[v] or not clear[v] & cell_bit(fx, fy, fz):
                        passed = ZERO
                elif v != target and v != last:
                    last = v
                    passed *= through[v]
                if passed < np.float32(0.05) or look * passed <= beaten:
                    break
            look *= passed
            if passed >= np.float32(0.05):
                if look > best:
                    best = look
                    out[n, 0] = p
                if look > np.float32(0.05) and look / (steps[p] + view_steps) > best_rate:
                    best_rate = look / (steps[p] + view_steps)
                    out[n, 1] = p
    return out
