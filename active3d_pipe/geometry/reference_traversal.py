"""Slow, obvious twins of `kernels_traversal.py`, float64; what the tests compare the kernels against."""

import math
from itertools import pairwise

import numpy as np


def traverse(
    opaque: np.ndarray, origin: np.ndarray, direction: np.ndarray, length: float
) -> list[tuple[int, int, int]]:
    """Voxels (i, j, k) that a ray crosses in order, up to `length` or the first opaque voxel (included).

    opaque (X, Y, Z) bool; origin in voxel units inside or outside the box; direction of unit length,
    `length` in voxels. Every crossing of a grid plane is computed from scratch and sorted.
    """
    cuts = [0.0, length]
    for axis in range(3):
        if abs(direction[axis]) > 1e-12:
            for plane in range(opaque.shape[axis] + 1):
                t = (plane - origin[axis]) / direction[axis]
                if 0 < t < length:
                    cuts.append(t)
    cuts.sort()
    voxels: list[tuple[int, int, int]] = []
    for a, b in pairwise(cuts):
        middle = np.asarray(origin) + 0.5 * (a + b) * np.asarray(direction)
        i, j, k = (math.floor(c) for c in middle)
        inside = 0 <= i < opaque.shape[0] and 0 <= j < opaque.shape[1] and 0 <= k < opaque.shape[2]
        if not inside or (voxels and voxels[-1] == (i, j, k)):
            continue
        voxels.append((i, j, k))
        if opaque[i, j, k]:
            break
    return voxels


def visible(opaque: np.ndarray, origin: np.ndarray, directions: np.ndarray, length: float) -> np.ndarray:
    """(X, Y, Z) bool, voxels that at least one ray of a fan crosses; arguments as `traverse`."""
    seen = np.zeros(opaque.shape, bool)
    for direction in directions:
        for v in traverse(opaque, origin, direction, length):
            seen[v] = True
    return seen


def carve(
    shape: tuple[int, int, int], origin: np.ndarray, directions: np.ndarray, lengths: np.ndarray, longest: float
) -> tuple[np.ndarray, np.ndarray]:
    """(free, hit) counts of depth rays; lengths in voxels, <= 0 = no return, > longest = carve only."""
    free, hit = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
    clear = np.zeros(shape, bool)
    for direction, length in zip(directions, lengths, strict=True):
        if length <= 0:
            continue
        end = None
        if length <= longest:
            end = tuple(math.floor(c) for c in np.asarray(origin) + length * np.asarray(direction))
            if all(0 <= c < n for c, n in zip(end, shape, strict=True)):
                hit[end] += 1
        for v in traverse(clear, origin, direction, min(length, longest)):
            if v != end:
                free[v] += 1
    return free, hit
