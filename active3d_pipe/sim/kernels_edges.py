"""Numba kernels for the pixels at edges: their samples are shaded once for every face among them.

As in multisample anti-aliasing, but at the middle of a face's samples (centroid sampling). Every output element is
written by one iteration of a parallel loop: same input, same bytes.
"""
# mypy: ignore-errors

import numpy as np
from numba import njit, prange

_ZERO = np.float32(0.0)


@njit(parallel=True, cache=True)
def group_samples(seen, offsets, counts, members, places):
    """Distinct faces of every chosen pixel: `counts` (P,), and in each row of `members` (P, K) uint32 and `places`
    (P, K, 3) float32 the face, the mean of its samples' offsets and its share of the pixel."""
    samples = seen.shape[1]
    share = np.float32(1 / samples)
    for p in prange(len(seen)):
        count = 0
        for s in range(samples):
            f = seen[p, s]
            g = 0
            while g < count and members[p, g] != f:
                g += 1
            if g == count:
                members[p, g] = f
                places[p, g, 0], places[p, g, 1], places[p, g, 2] = _ZERO, _ZERO, _ZERO
                count += 1
            places[p, g, 0] += np.float32(offsets[s, 0])
            places[p, g, 1] += np.float32(offsets[s, 1])
            places[p, g, 2] += share
        for g in range(count):
            k = share / places[p, g, 2]
            places[p, g, 0] *= k
            places[p, g, 1] *= k
        counts[p] = count


@njit(parallel=True, cache=True)
def group_rays(pixels, ends, counts, members, places, width, T, inv_fx, inv_fy, cx, cy, rays, face):
    """A ray (N, 6) and the face (N,) of every group; `ends` (P,) is the running sum of `counts`."""
    for p in prange(len(pixels)):
        i, j = pixels[p] // width, pixels[p] % width
        for g in range(counts[p]):
            n = ends[p] - counts[p] + g
            x = (j + places[p, g, 0] - cx) * inv_fx
            y = (i + places[p, g, 1] - cy) * inv_fy
            for c in range(3):
                rays[n, c] = T[c, 3]
                rays[n, 3 + c] = T[c, 0] * x + T[c, 1] * y + T[c, 2]
            face[n] = members[p, g]


@njit(parallel=True, cache=True)
def sum_groups(ends, counts, places, colours, samples, centre, total, spread):
    """Sum (P, 3) of each pixel's samples, and spread (P,), the largest range over the channels, 0..255.

    `colours` (N, 3) of the groups, each of which stands for its share of the `samples` a pixel has; `centre` (P, 3),
    the colour at the pixel's centre, counts for the spread alone.
    """
    for p in prange(len(counts)):
        widest = _ZERO
        for c in range(3):
            low = high = centre[p, c]
            value = _ZERO
            for g in range(counts[p]):
                x = colours[ends[p] - counts[p] + g, c]
                value += places[p, g, 2] * x
                low, high = min(low, x), max(high, x)
            total[p, c] = value * np.float32(samples)
            widest = max(widest, high - low)
        spread[p] = widest
