# mypy: ignore-errors
"""Numba kernels over candidate positions: one of every block of voxels, and a smooth spread of their values."""

import numpy as np
from numba import njit


@njit(cache=True)
def best_of_blocks(allowed, clearance, block):
    """Of every cubic block the allowed voxel with the most clearance, then nearest to its middle, then lowest id.

    allowed (uint8) and clearance (float32) are [X, Y, Z]; `block` is in voxels. Returns (P, 3) int64, in C order of
    the blocks.
    """
    nx, ny, nz = allowed.shape
    by, bz = -(-ny // block), -(-nz // block)
    blocks = -(-nx // block) * by * bz
    found = np.full(blocks, -1, np.int64)
    best = np.zeros(blocks, np.float32)
    off = np.zeros(blocks, np.int64)
    count = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if allowed[i, j, k] == 0:
                    continue
                a, b, c = i // block, j // block, k // block
                n = (a * by + b) * bz + c
                # Twice the distance to the middle, so that it is a whole number.
                away = (
                    abs(2 * (i - a * block) - block + 1) + abs(2 * (j - b * block) - block + 1)
                    + abs(2 * (k - c * block) - block + 1)
                )
                here = clearance[i, j, k]
                if found[n] < 0:
                    count += 1
                elif here < best[n] or (here == best[n] and away >= off[n]):
                    continue
                found[n], best[n], off[n] = (i * ny + j) * nz + k, here, away
    out = np.empty((count, 3), np.int64)
    m = 0
    for n in range(blocks):
        if found[n] >= 0:
            out[m, 0], out[m, 1], out[m, 2] = found[n] // (ny * nz), found[n] // nz % ny, found[n] % nz
            m += 1
    return out


@njit(cache=True)
def spread_values(positions, values, kernel, shape):
    """Sums of `values` (P,) and of 1 at voxels `positions` (P, 3), each spread with the separable `kernel` (2 r + 1,).

    Returns two float32 [X, Y, Z]. Positions are few and the kernel is short: a tenth of the cost of filtering.
    """
    nx, ny, nz = shape
    r = len(kernel) // 2
    total, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for p in range(len(positions)):
        x, y, z = positions[p]
        for i in range(max(0, x - r), min(nx, x + r + 1)):
            for j in range(max(0, y - r), min(ny, y + r + 1)):
                w = kernel[i - x + r] * kernel[j - y + r]
                for k in range(max(0, z - r), min(nz, z + r + 1)):
                    share = w * kernel[k - z + r]
                    total[i, j, k] += share * values[p]
                    weight[i, j, k] += share
    return total, weight
