# mypy: ignore-errors
"""Numba kernel that finds places from which given voxels can be seen; its slow twin is in the tests."""

import numpy as np
from numba import njit, prange

ZERO, ONE = np.float32(0.0), np.float32(1.0)


@njit(parallel=True, cache=True)
def best_viewpoints(targets, places, opaque, through, normal, shape, nearest, farthest, falloff, steps, view_steps):
    """For every target voxel the places with the best look and with the best look per step to get there.

    targets (T, 3), places (P, 3) int32 voxels; `opaque` (flat uint8) stops sight, `through` (flat float32) is the
    transmittance of a voxel; `normal` (size, 3) int8 the side that a surface target is seen from, zero = any.
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
        best, best_rate = np.float32(0.05), ZERO
        for p in range(places.shape[0]):
            x, y, z = np.float32(places[p, 0] - ti), np.float32(places[p, 1] - tj), np.float32(places[p, 2] - tk)
            distance = np.sqrt(x * x + y * y + z * z)
            if distance < nearest or distance > farthest:
                continue
            look = min(ONE, falloff / distance)
            if norm > ONE:
                cos = (a * x + b * y + c * z) / (norm * distance)
                if cos <= ZERO:
                    continue
                look *= cos
            if look <= best and look <= best_rate * (steps[p] + view_steps):
                continue
            m = int(np.ceil(distance))
            passed = ONE
            last = -1
            for s in range(1, m):
                f = np.float32(s) / np.float32(m)
                i, j, k = (
                    int(np.floor(ti + f * x + np.float32(0.5))), int(np.floor(tj + f * y + np.float32(0.5))),
                    int(np.floor(tk + f * z + np.float32(0.5))),
                )  # fmt: skip
                v = (i * ny + j) * nz + k
                if v == target or v == last:  # noqa: SIM109  (plain comparisons compile to nothing)
                    continue
                last = v
                if opaque[v]:
                    passed = ZERO
                else:
                    passed *= through[v]
                if passed < np.float32(0.05):
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
