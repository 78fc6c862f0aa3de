# mypy: ignore-errors
"""Numba kernels of voxel traversal; `reference_traversal.py` is the slow, obvious twin.

All kernels work in voxel units: a point is (world - grid.origin) / voxel_size, so voxel (i, j, k) is the cube
[i, i+1) x [j, j+1) x [k, k+1). Ray parameters t stay in metres: a direction is a unit vector / voxel_size.
Flat voxel ids are C order: (i * ny + j) * nz + k.
"""

import numpy as np
from numba import njit, prange

# Stands for infinity: fastmath kernels must not meet a real one.
FAR = np.float32(1e30)
# A direction component below this does not move along its axis.
TINY = np.float32(1e-12)
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@njit(fastmath=True, cache=True)
def entry_parameter(px, py, pz, dx, dy, dz, nx, ny, nz):
    """Smallest t >= 0 at which the ray is inside the box, or -1 when it never is, or only touches it from outside."""
    t0, t1 = ZERO, FAR
    for axis in range(3):
        p = px if axis == 0 else (py if axis == 1 else pz)
        d = dx if axis == 0 else (dy if axis == 1 else dz)
        n = np.float32(nx if axis == 0 else (ny if axis == 1 else nz))
        if abs(d) < np.float32(1e-12):
            if p < ZERO or p >= n:
                return np.float32(-1.0)
            continue
        a, b = -p / d, (n - p) / d
        if a > b:
            a, b = b, a
        t0, t1 = max(t0, a), min(t1, b)
    return t0 if t0 < t1 else np.float32(-1.0)


@njit(fastmath=True, cache=True, inline="always")
def start_voxel(px, py, pz, dx, dy, dz, t, nx, ny, nz):
    """Voxel (i, j, k) of a ray at parameter t, the nearest of the grid when rounding puts it outside."""
    i = min(max(np.int32(np.floor(px + t * dx)), 0), nx - 1)
    j = min(max(np.int32(np.floor(py + t * dy)), 0), ny - 1)
    k = min(max(np.int32(np.floor(pz + t * dz)), 0), nz - 1)
    return i, j, k


@njit(fastmath=True, cache=True, inline="always")
def voxel_length(d):
    """Ray parameter that one voxel is long along an axis, FAR when the ray does not move along it."""
    return ONE / abs(d) if abs(d) > TINY else FAR


@njit(fastmath=True, cache=True, inline="always")
def next_border(i, p, d):
    """Ray parameter at which voxel i of an axis is left, FAR when the ray does not move along it."""
    return (np.float32(i + (1 if d > 0 else 0)) - p) / d if abs(d) > TINY else FAR


@njit(fastmath=True, cache=True, inline="always")
def cell_bit(x, y, z):
    """Bit 4 a + 2 b + c, uint8, of the half-size cell of a voxel in which a point lies (voxel units, x, y, z >= 0)."""
    a, b, c = np.int32(x + x) & 1, np.int32(y + y) & 1, np.int32(z + z) & 1
    return np.uint8(1 << (4 * a + 2 * b + c))


@njit(fastmath=True, cache=True)
def walk_ray(opaque, px, py, pz, dx, dy, dz, t_end, nx, ny, nz, ids):
    """Voxels that a ray crosses, in order, up to t_end or the first opaque one, which is included.

    Amanatides and Woo, "A fast voxel traversal algorithm for ray tracing" (1987). `opaque` is flat uint8;
    `ids` is an int32 buffer of at least nx + ny + nz + 3. Returns how many ids were written.
    """
    t = entry_parameter(px, py, pz, dx, dy, dz, nx, ny, nz)
    if t < ZERO or t > t_end:
        return 0
    i, j, k = start_voxel(px, py, pz, dx, dy, dz, t, nx, ny, nz)
    si, sj, sk = (1 if dx > 0 else -1), (1 if dy > 0 else -1), (1 if dz > 0 else -1)
    ex, ey, ez = voxel_length(dx), voxel_length(dy), voxel_length(dz)
    tx, ty, tz = next_border(i, px, dx), next_border(j, py, dy), next_border(k, pz, dz)
    n = 0
    while True:
        v = (i * ny + j) * nz + k
        ids[n] = v
        n += 1
        if opaque[v] != 0:
            return n
        if tx <= ty and tx <= tz:
            if tx > t_end:
                return n
            i += si
            if i < 0 or i >= nx:
                return n
            tx += ex
        elif ty <= tz:
            if ty > t_end:
                return n
            j += sj
            if j < 0 or j >= ny:
                return n
            ty += ey
        else:
            if tz > t_end:
                return n
            k += sk
            if k < 0 or k >= nz:
                return n
            tz += ez


@njit(fastmath=True, cache=True)
def mark_visible(opaque, origin, directions, t_end, shape, seen):
    """Set seen[v] = 1 for every voxel that some ray crosses; directions (M, 3) unit / voxel_size, t_end m."""
    nx, ny, nz = shape
    ids = np.empty(nx + ny + nz + 3, np.int32)
    for r in range(directions.shape[0]):
        n = walk_ray(
            opaque, origin[0], origin[1], origin[2], directions[r, 0], directions[r, 1], directions[r, 2],
            t_end, nx, ny, nz, ids,
        )
        for m in range(n):
            seen[ids[m]] = 1


@njit(fastmath=True, cache=True)
def carve_rays(clear, origin, directions, t_hit, t_max, shape, free, hit):
    """Count, for every voxel, the rays that passed it and those that ended in it.

    `clear` is an all-zero opaque array; t_hit (M,) m along each ray, <= 0 = no return: the ray says nothing.
    Returns beyond t_max carve up to t_max and end nowhere. `free` and `hit` (flat int32) are added to.
    """
    nx, ny, nz = shape
    ids = np.empty(nx + ny + nz + 3, np.int32)
    for r in range(directions.shape[0]):
        t = t_hit[r]
        if t <= ZERO:
            continue
        dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
        end = np.int32(-1)
        if t <= t_max:
            i = np.int32(np.floor(origin[0] + t * dx))
            j = np.int32(np.floor(origin[1] + t * dy))
            k = np.int32(np.floor(origin[2] + t * dz))
            if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
                end = (i * ny + j) * nz + k
                hit[end] += 1
        n = walk_ray(clear, origin[0], origin[1], origin[2], dx, dy, dz, min(t, t_max), nx, ny, nz, ids)
        for m in range(n):
            if ids[m] != end:
                free[ids[m]] += 1


@njit(fastmath=True, cache=True)
def first_voxel(opaque, origin, dx, dy, dz, t_end, nx, ny, nz, ids):
    """Flat id of the first opaque voxel on a ray, -1 when it meets none before t_end; `ids` as in `walk_ray`."""
    n = walk_ray(opaque, origin[0], origin[1], origin[2], dx, dy, dz, t_end, nx, ny, nz, ids)
    return ids[n - 1] if n > 0 and opaque[ids[n - 1]] != 0 else np.int32(-1)


@njit(fastmath=True, cache=True)
def first_hits(opaque, origin, directions, t_end, shape, out_t):
    """Distance (m) at which each ray enters the first opaque voxel, 0 when it meets none before t_end."""
    nx, ny, nz = shape
    ids = np.empty(nx + ny + nz + 3, np.int32)
    for r in range(directions.shape[0]):
        dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
        v = first_voxel(opaque, origin, dx, dy, dz, t_end, nx, ny, nz, ids)
        out_t[r] = ZERO
        if v < 0:
            continue
        i, j, k = v // (ny * nz), (v // nz) % ny, v % nz
        # Entry into that voxel alone: the box test, shifted to its corner.
        t = entry_parameter(
            origin[0] - np.float32(i), origin[1] - np.float32(j), origin[2] - np.float32(k), dx, dy, dz, 1, 1, 1
        )
        out_t[r] = max(t, np.float32(1e-6))


@njit(parallel=True, fastmath=True, cache=True)
def first_voxels(opaque, origins, directions, t_end, shape, out_id):
    """`first_voxel` of each ray of fans of their own: origins (P, 3), directions (P, M, 3), out_id (P, M)."""
    nx, ny, nz = shape
    for p in prange(origins.shape[0]):
        ids = np.empty(nx + ny + nz + 3, np.int32)
        for r in range(directions.shape[1]):
            dx, dy, dz = directions[p, r, 0], directions[p, r, 1], directions[p, r, 2]
            out_id[p, r] = first_voxel(opaque, origins[p], dx, dy, dz, t_end, nx, ny, nz, ids)
