# mypy: ignore-errors
"""Numba kernels of the expected gain, voxel by voxel in one pass; `reference.py` is their slow twin.

Most voxels are seen free or were never seen, and whole arrays would pass through memory some thirty times.
"""

import numpy as np
from numba import njit, prange

F = np.float32
ZERO, ONE = F(0), F(1)


@njit(parallel=True, cache=True)
def classify(free, hit, occupancy, settled_rays, thin_share, out):
    """out (X, Y, Z) uint8: 0 seen free, 1 open, 2 surface (`gain.classify`)."""
    nx, ny, nz = free.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                f, h = free[i, j, k], hit[i, j, k]
                if h > ZERO and (occupancy[i, j, k] > F(0.5) or h >= max(F(2), thin_share * (f + h))):
                    out[i, j, k] = 2
                else:
                    out[i, j, k] = 0 if f >= settled_rays else 1


@njit(parallel=True, cache=True)
def information(
    kind, free, hit, occupancy, u, entropy, entropy_imp, entropy_exp, quality, credit, level, alpha, beta,
    surface_weight, residual_bits, settled_rays, enough, value, surface_value, gain_imp, gain_exp,
):
    """Fill the last four (X, Y, Z) float32, given as zeros (`gain.information_volumes`).

    `level`: what U is measured by, 0 = it is nothing anywhere.
    """
    nx, ny, nz = kind.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                what = kind[i, j, k]
                if what == 0:
                    continue
                trust = credit[i, j, k]
                size = min(max(u[i, j, k], ZERO) / level, F(2)) if level > ZERO else ZERO
                if what == 1:
                    rest = max(ZERO, ONE - (free[i, j, k] + hit[i, j, k]) / settled_rays)
                    weight = alpha * size + beta * entropy[i, j, k]
                    value[i, j, k] = weight * (ONE - occupancy[i, j, k]) * rest * trust
                else:
                    rest = max(ZERO, ONE - quality[i, j, k] / enough)
                    surface_value[i, j, k] = (alpha * size + beta) * surface_weight * trust
                gain_imp[i, j, k] = max(ZERO, entropy_imp[i, j, k] - residual_bits) * (rest * trust)
                gain_exp[i, j, k] = max(ZERO, entropy_exp[i, j, k] - residual_bits) * (rest * trust)
