# mypy: ignore-errors
"""Numba kernel: first surface along the rays of a camera through an SDF sampled on a grid."""

import math

import numpy as np
from numba import njit, prange

F0, F1, HALF = np.float32(0), np.float32(1), np.float32(0.5)
RELAX = np.float32(0.9)  # of the distance is stepped: between the grid's nodes the SDF is only about right


@njit(fastmath=True, cache=True)
def _sample(sdf, x, y, z):
    """Trilinear value at grid coordinates (nodes at whole numbers), inside the grid."""
    i, j, k = min(int(x), sdf.shape[0] - 2), min(int(y), sdf.shape[1] - 2), min(int(z), sdf.shape[2] - 2)
    fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(k)
    a = (sdf[i, j, k] * (F1 - fz) + sdf[i, j, k + 1] * fz) * (F1 - fy)
    a += (sdf[i, j + 1, k] * (F1 - fz) + sdf[i, j + 1, k + 1] * fz) * fy
    b = (sdf[i + 1, j, k] * (F1 - fz) + sdf[i + 1, j, k + 1] * fz) * (F1 - fy)
    b += (sdf[i + 1, j + 1, k] * (F1 - fz) + sdf[i + 1, j + 1, k + 1] * fz) * fy
    return a * (F1 - fx) + b * fx


@njit(parallel=True, fastmath=True, cache=True)
def trace(sdf, low, spacing, R, t, camera, near, far, depth):
    """Depth (H, W), m along the optical axis, where rays first go from positive to negative SDF; 0 = nowhere.

    sdf (X, Y, Z), m, at low + ijk * spacing. R, t camera to world; `camera` = fx, fy, cx, cy.
    """
    height, width = depth.shape
    least = np.float32(0.25) * spacing
    for r in prange(height):
        for c in range(width):
            x, y = (np.float32(c) + HALF - camera[2]) / camera[0], (np.float32(r) + HALF - camera[3]) / camera[1]
            length = math.sqrt(x * x + y * y + F1)
            dx = R[0, 0] * x + R[0, 1] * y + R[0, 2]
            dy = R[1, 0] * x + R[1, 1] * y + R[1, 2]
            dz = R[2, 0] * x + R[2, 1] * y + R[2, 2]
            z, before, last = near, F0, near
            depth[r, c] = F0
            while z < far:
                gx = (t[0] + dx * z - low[0]) / spacing
                gy = (t[1] + dy * z - low[1]) / spacing
                gz = (t[2] + dz * z - low[2]) / spacing
                inside = (
                    F0 <= gx <= np.float32(sdf.shape[0] - 1) and F0 <= gy <= np.float32(sdf.shape[1] - 1)
                    and F0 <= gz <= np.float32(sdf.shape[2] - 1)
                )
                s = _sample(sdf, gx, gy, gz) if inside else spacing
                if s <= F0 and before > F0 and inside:
                    depth[r, c] = last + (z - last) * before / (before - s)
                    break
                before, last = s, z
                z += max(RELAX * abs(s), least) / length
