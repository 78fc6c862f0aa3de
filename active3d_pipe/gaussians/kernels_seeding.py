# mypy: ignore-errors
"""Numba kernels: surface points of a depth image and the octree leaves that summarise them."""

import math

import numpy as np
from numba import njit, prange

F = np.float32
ZERO, ONE, TWO = F(0), F(1), F(2)
# Grazing pixels: the footprint grows with 1 / sqrt(cos), limited at this cosine.
COS_MIN = F(0.05)
# Columns of the leaf statistics.
LEAF_WIDTH = 11


@njit(fastmath=True, cache=True)
def _slope(depth, r, c, dr, dc, out):
    """Difference of inverse depth along (dr, dc) over 2 px, from the smoother side; False at isolated pixels."""
    height, width = depth.shape
    here = ONE / depth[r, c]
    best = F(1e30)
    for side in (-2, 2):
        rr, cc = r + side * dr, c + side * dc
        if 0 <= rr < height and 0 <= cc < width and depth[rr, cc] > ZERO:
            step = (ONE / depth[rr, cc] - here) / F(side)
            if abs(step) < abs(best):
                best = step
    if best < F(1e29):
        out[0] = best
        return True
    return False


@njit(parallel=True, fastmath=True, cache=True)
def surface(depth, fx, fy, cx, cy, R, t, edge_ratio, points, normals, footprint, edge):
    """World point, world normal towards the camera, footprint (m) and depth-edge flag of every valid pixel.

    A plane's inverse depth is linear in the image: its slope (a, b) gives the normal, its second difference,
    relative to itself, the depth edges and creases. `R` (3, 3), `t` (3,) camera to world. Where no neighbour is
    valid the normal points at the camera; invalid pixels have footprint 0.
    """
    height, width = depth.shape
    for r in prange(height):
        slope = np.zeros(1, np.float32)
        for c in range(width):
            d = depth[r, c]
            edge[r, c] = False
            footprint[r, c] = ZERO
            if not d > ZERO:
                continue
            x, y = (F(c) + F(0.5) - cx) / fx, (F(r) + F(0.5) - cy) / fy
            nx, ny, nz = -x, -y, -ONE
            known = _slope(depth, r, c, 0, 1, slope)
            a = slope[0] * fx
            known = _slope(depth, r, c, 1, 0, slope) and known
            b = slope[0] * fy
            # The plane n . p = k seen along rays (x, y, 1): 1 / z = (n . ray) / k, so n ~ (a, b, 1/z - a x - b y).
            if known:
                nx, ny, nz = -a, -b, -(ONE / d - a * x - b * y)
            length = ONE / math.sqrt(nx * nx + ny * ny + nz * nz)
            nx, ny, nz = nx * length, ny * length, nz * length
            cosine = -(nx * x + ny * y + nz) / math.sqrt(x * x + y * y + ONE)
            if cosine < ZERO:
                nx, ny, nz, cosine = -nx, -ny, -nz, -cosine
            footprint[r, c] = d / (fx * math.sqrt(max(cosine, COS_MIN)))
            px, py = x * d, y * d
            for j in range(3):
                points[r, c, j] = R[j, 0] * px + R[j, 1] * py + R[j, 2] * d + t[j]
                normals[r, c, j] = R[j, 0] * nx + R[j, 1] * ny + R[j, 2] * nz
            for axis in range(2):
                dr, dc = axis, 1 - axis
                if r >= dr and r + dr < height and c >= dc and c + dc < width:
                    before, after = depth[r - dr, c - dc], depth[r + dr, c + dc]
                    if before > ZERO and after > ZERO:
                        bend = (ONE / before + ONE / after) * d - TWO
                        edge[r, c] = edge[r, c] or abs(bend) > edge_ratio
                    else:
                        edge[r, c] = True


@njit(fastmath=True, cache=True)
def _spread_bits(v):
    """The 21 low bits of v, two zero bits between each."""
    x = np.uint64(v) & np.uint64(0x1FFFFF)
    x = (x | (x << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
    x = (x | (x << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
    x = (x | (x << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    x = (x | (x << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (x | (x << np.uint64(2))) & np.uint64(0x1249249249249249)


@njit(parallel=True, cache=True)
def morton_keys(points, cell, keys):
    """Interleaved bits of the world-aligned cell of every point (n, 3): a parent cell is a run of sorted keys."""
    for i in prange(len(points)):
        key = np.uint64(0)
        for j in range(3):
            index = math.floor(points[i, j] / cell) + (1 << 20)
            key |= _spread_bits(index) << np.uint64(j)
        keys[i] = key


@njit(cache=True)
def octree_leaves(
    keys, order, points, normals, colors, footprint, edge, levels, cell, color_spread, normal_length, leaves
):
    """Cut the points into octree leaves; returns their number (leaves beyond len(leaves) are only counted).

    A cell splits while its colours spread (standard deviation above `color_spread`), its normals disagree (their
    mean shorter than `normal_length`) or it holds a depth edge, but not below the pixel footprint. `order` sorts
    `keys` (Morton, finest level); `cell` edge of the coarsest cells, m. A leaf is mean point 0:3, mean normal 3:6,
    mean colour 6:9, cell edge 9, smallest footprint 10.
    """
    n = len(order)
    found = 0
    # Work stack of runs (first, last, level); a split pushes at most 8 runs.
    stack = np.empty((8 * (levels + 1), 3), np.int64)
    top_shift = np.uint64(3 * (levels - 1))
    sums = np.zeros(12)
    start = 0
    while start < n:
        stop = start + 1
        parent = keys[order[start]] >> top_shift
        while stop < n and keys[order[stop]] >> top_shift == parent:
            stop += 1
        stack[0, 0], stack[0, 1], stack[0, 2] = start, stop, 0
        depth_of_stack = 1
        while depth_of_stack > 0:
            depth_of_stack -= 1
            first, last, level = stack[depth_of_stack, 0], stack[depth_of_stack, 1], stack[depth_of_stack, 2]
            sums[:] = 0
            smallest = np.inf
            has_edge = False
            for at in range(first, last):
                i = order[at]
                for j in range(3):
                    sums[j] += points[i, j]
                    sums[3 + j] += normals[i, j]
                    sums[6 + j] += colors[i, j]
                    sums[9 + j] += colors[i, j] * colors[i, j]
                smallest = min(smallest, footprint[i])
                has_edge = has_edge or edge[i]
            count = last - first
            sums /= count
            spread = 0.0
            for j in range(3):
                spread += max(0.0, sums[9 + j] - sums[6 + j] * sums[6 + j])
            size = cell / (1 << level)
            length = math.sqrt(sums[3] * sums[3] + sums[4] * sums[4] + sums[5] * sums[5])
            wanted = has_edge or spread > 3 * color_spread * color_spread or length < normal_length
            if wanted and level + 1 < levels and 0.5 * size >= smallest:
                shift = np.uint64(3 * (levels - 2 - level))
                at = first
                while at < last:
                    child = keys[order[at]] >> shift
                    end = at + 1
                    while end < last and keys[order[end]] >> shift == child:
                        end += 1
                    stack[depth_of_stack, 0], stack[depth_of_stack, 1] = at, end
                    stack[depth_of_stack, 2] = level + 1
                    depth_of_stack += 1
                    at = end
                continue
            if found < len(leaves):
                for j in range(9):
                    leaves[found, j] = sums[j]
                leaves[found, 9] = size
                leaves[found, 10] = smallest
            found += 1
        start = stop
    return found
