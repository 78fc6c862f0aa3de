# mypy: ignore-errors
"""Numba kernels of sight: how far a ray sees in voxels that are partly filled, and what a look at a surface brings.

Points are in voxel units, directions unit vectors / voxel_size, ray parameters in metres (as in
`geometry.kernels_traversal`). A voxel that surface was seen in need not be full: of its eight half-size cells, `clear`
holds those that rays passed and none ended in, `open` those that no ray met though they border on clear ones, uint8
bits 4 a + 2 b + c of the upper cell in x, y, z. Sight goes on through clear cells and ends in any other.
"""

import numpy as np
from numba import njit, prange

from active3d_pipe.geometry.kernels_traversal import (
    cell_bit,
    entry_parameter,
    next_border,
    start_voxel,
    voxel_length,
)

ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
# Shorter jumps cost more than the steps they save.
LEAST_JUMP = 3


@njit(fastmath=True, cache=True)
def surface_share(normal, v, dx, dy, dz, voxel_size, t, quality, enough, quality_range):
    """(share of the improvement to `enough` that this look brings, |cos| of its incidence angle).

    `normal` holds components * 127; where it is zero the surface has no clear side and is taken at 45 degrees.
    """
    a, b, c = np.float32(normal[v, 0]), np.float32(normal[v, 1]), np.float32(normal[v, 2])
    norm = np.sqrt(a * a + b * b + c * c)
    cos = np.float32(0.7)
    if norm > np.float32(1.0):
        cos = min(ONE, abs(a * dx + b * dy + c * dz) * voxel_size / norm)
    new = cos * min(ONE, quality_range / max(t, np.float32(1e-3)))
    return max(ZERO, min(new, enough) - quality[v]) / enough, cos


@njit(fastmath=True, cache=True)
def blocked_cell(clear_bits, px, py, pz, dx, dy, dz, t0, t1):
    """Bit of the first cell in which sight ends on its way from t0 to t1 through one voxel; 0 = it passes."""
    for m in range(3):
        t = t0 + (t1 - t0) * np.float32((2 * m + 1) / 6)
        bit = cell_bit(max(px + t * dx, ZERO), max(py + t * dy, ZERO), max(pz + t * dz, ZERO))
        if not clear_bits & bit:
            return bit
    return np.uint8(0)


@njit(fastmath=True, cache=True)
def walk_sight(stops, clear, skip, voxel_size, px, py, pz, dx, dy, dz, t_end, shape, ids):
    """Voxels of interest that a ray crosses, in order, up to t_end or the first in which it ends.

    Returns (how many, bit of the cell in which it ends, 0 = nowhere). `skip` (flat uint8) is the Chebyshev distance of
    a voxel to the nearest one of interest, 0 for those themselves; the others are jumped over. A ray ends in a voxel
    of `stops` (flat uint8) unless all that it crosses of it is clear; such voxels are left out of `ids` (int32 buffer
    of at least nx + ny + nz + 3). Traversal after Amanatides and Woo (1987).
    """
    nx, ny, nz = shape
    t = entry_parameter(px, py, pz, dx, dy, dz, nx, ny, nz)
    if t < ZERO or t > t_end:
        return 0, np.uint8(0)
    i, j, k = start_voxel(px, py, pz, dx, dy, dz, t, nx, ny, nz)
    si, sj, sk = (1 if dx > 0 else -1), (1 if dy > 0 else -1), (1 if dz > 0 else -1)
    ex, ey, ez = voxel_length(dx), voxel_length(dy), voxel_length(dz)
    tx, ty, tz = next_border(i, px, dx), next_border(j, py, dy), next_border(k, pz, dz)
    n = 0
    while True:
        v = (i * ny + j) * nz + k
        if skip[v] > LEAST_JUMP:
            # So far no voxel of interest can be: from any point of this one, and not farther than to the next but one.
            t += np.float32(skip[v] - 1) * voxel_size
            if t > t_end:
                return n, np.uint8(0)
            i, j, k = (
                np.int32(np.floor(px + t * dx)), np.int32(np.floor(py + t * dy)), np.int32(np.floor(pz + t * dz))
            )
            if i < 0 or j < 0 or k < 0 or i >= nx or j >= ny or k >= nz:
                return n, np.uint8(0)
            tx, ty, tz = next_border(i, px, dx), next_border(j, py, dy), next_border(k, pz, dz)
            continue
        # Never back: from a point on a border, a ray that goes down leaves its voxel at 0, and a jump finds it again.
        t_out = max(t, min(tx, min(ty, tz)))
        if stops[v] != 0:
            bit = blocked_cell(clear[v], px, py, pz, dx, dy, dz, t, t_out)
            if bit:
                ids[n] = v
                return n + 1, bit
        elif skip[v] == 0:
            ids[n] = v
            n += 1
        if t_out > t_end:
            return n, np.uint8(0)
        t = t_out
        if tx <= ty and tx <= tz:
            i += si
            if i < 0 or i >= nx:
                return n, np.uint8(0)
            tx += ex
        elif ty <= tz:
            j += sj
            if j < 0 or j >= ny:
                return n, np.uint8(0)
            ty += ey
        else:
            k += sk
            if k < 0 or k >= nz:
                return n, np.uint8(0)
            tz += ez


@njit(fastmath=True, cache=True)
def cast(stops, clear, skip, origin, R, ray, voxel_size, t_end, shape, ids):
    """`walk_sight` of a camera ray (unit): (how many voxels, bit of the last cell, direction, share of a voxel).

    The last is the length of an average piece of the ray in a voxel, relative to the voxel: a slanted ray crosses
    more of them, in shorter pieces.
    """
    x, y, z = ray[0], ray[1], ray[2]
    dx = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z) / voxel_size
    dy = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z) / voxel_size
    dz = (R[2, 0] * x + R[2, 1] * y + R[2, 2] * z) / voxel_size
    n, bit = walk_sight(
        stops, clear, skip, voxel_size, origin[0], origin[1], origin[2], dx, dy, dz, t_end, shape, ids
    )
    return n, bit, (dx, dy, dz), ONE / (voxel_size * (abs(dx) + abs(dy) + abs(dz)))


@njit(fastmath=True, cache=True)
def distance_to(origin, v, shape, voxel_size):
    """Distance (m) from a point to the centre of voxel `v`."""
    a = np.float32(v // (shape[1] * shape[2])) + HALF - origin[0]
    b = np.float32((v // shape[2]) % shape[1]) + HALF - origin[1]
    c = np.float32(v % shape[2]) + HALF - origin[2]
    return voxel_size * np.sqrt(a * a + b * b + c * c)


@njit(fastmath=True, cache=True, inline="always")
def cell_share(t, enough, quality_range):
    """What a look at an open cell from t metres away is worth: full up to enough distance, then falling as 1 / t."""
    return min(ONE, quality_range / (max(t, np.float32(1e-3)) * enough))


def _unit_offsets():
    """Unit vectors to the voxels of a block of 5 x 5 x 5 from the one in the middle, float32 [5, 5, 5, 3]."""
    offsets = np.stack(np.meshgrid(*[np.arange(-2, 3, dtype=np.float32)] * 3, indexing="ij"), axis=-1)
    length = np.sqrt((offsets * offsets).sum(axis=-1, keepdims=True))
    return offsets / np.maximum(length, ONE)


UNIT_OFFSETS = _unit_offsets()


@njit(cache=True, inline="always")
def _write_normal(x, y, z, i, j, k, out):
    n = np.sqrt(x * x + y * y + z * z)
    if n > np.float32(1e-3):
        out[i, j, k, 0] = np.int8(np.round(np.float32(127) * x / n))
        out[i, j, k, 1] = np.int8(np.round(np.float32(127) * y / n))
        out[i, j, k, 2] = np.int8(np.round(np.float32(127) * z / n))


@njit(parallel=True, cache=True)
def surface_normals(kind, out):
    """Direction from each surface voxel towards its seen-free neighbours, components * 127, int8 [X, Y, Z, 3]."""
    nx, ny, nz = kind.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                if kind[i, j, k] != 2:
                    continue
                x = y = z = ZERO
                if 2 <= i < nx - 2 and 2 <= j < ny - 2 and 2 <= k < nz - 2:
                    # The same sums without a test, for all but the border.
                    for a in range(5):
                        for b in range(5):
                            for c in range(5):
                                free = np.float32(kind[i + a - 2, j + b - 2, k + c - 2] == 0)
                                x += free * UNIT_OFFSETS[a, b, c, 0]
                                y += free * UNIT_OFFSETS[a, b, c, 1]
                                z += free * UNIT_OFFSETS[a, b, c, 2]
                    _write_normal(x, y, z, i, j, k, out)
                    continue
                for a in range(max(0, i - 2), min(nx, i + 3)):
                    for b in range(max(0, j - 2), min(ny, j + 3)):
                        for c in range(max(0, k - 2), min(nz, k + 3)):
                            if kind[a, b, c] == 0:
                                x += UNIT_OFFSETS[a - i + 2, b - j + 2, c - k + 2, 0]
                                y += UNIT_OFFSETS[a - i + 2, b - j + 2, c - k + 2, 1]
                                z += UNIT_OFFSETS[a - i + 2, b - j + 2, c - k + 2, 2]
                _write_normal(x, y, z, i, j, k, out)


@njit(parallel=True, cache=True)
def open_cells(kind, clear, unmet, out):
    """Cells of surface voxels that no ray met (`unmet` bits) and that share a face with a clear one; [X, Y, Z] u8."""
    nx, ny, nz = kind.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                if kind[i, j, k] != 2 or unmet[i, j, k] == 0:
                    continue
                bits = 0
                for cell in range(8):
                    if not unmet[i, j, k] & (1 << cell):
                        continue
                    for axis in range(3):
                        flip = 4 >> axis
                        upper = cell & flip
                        # Across one face lies the other half of the same voxel, across the other the next voxel.
                        a = i + (axis == 0) * (1 if upper else -1)
                        b = j + (axis == 1) * (1 if upper else -1)
                        c = k + (axis == 2) * (1 if upper else -1)
                        beside = clear[i, j, k]
                        if not beside & (1 << (cell ^ flip)) and 0 <= a < nx and 0 <= b < ny and 0 <= c < nz:
                            beside = clear[a, b, c]
                        if beside & (1 << (cell ^ flip)):
                            bits |= 1 << cell
                out[i, j, k] = bits
