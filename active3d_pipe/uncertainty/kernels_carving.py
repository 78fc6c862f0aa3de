"""Compiled loops along rays: carving, looks in vain. Slow references live in the tests.

Work is split over a fixed number of chunks (`CHUNKS`), each with volumes of its own that are summed in chunk order:
the same bytes come out whatever the number of threads. No fastmath: depth may hold NaN, and must be told apart.
"""

# mypy: disable-error-code=no-untyped-def

import math

import numpy as np
from numba import njit, prange

from active3d_pipe.geometry.kernels_traversal import cell_bit

CHUNKS = 2


@njit(cache=True, inline="always")
def _nearer_difference(d, before, after):
    """Depth change towards the side that continues the surface, and the sign of that side (0: neither valid)."""
    has_before, has_after = before > 0.0, after > 0.0
    if has_after and (not has_before or abs(after - d) <= abs(d - before)):
        return after - d, 1
    if has_before:
        return before - d, -1
    return 0.0, 0


@njit(cache=True)
def _incidence_cosine(depth, i, j, step, camera):
    """Cosine between the ray of pixel (i, j) and the surface normal, from neighbours `step` pixels away."""
    fx, fy, cx, cy = camera
    height, width = depth.shape
    d = depth[i, j]
    left = depth[i, j - step] if j >= step else np.float32(0.0)
    right = depth[i, j + step] if j + step < width else np.float32(0.0)
    up = depth[i - step, j] if i >= step else np.float32(0.0)
    down = depth[i + step, j] if i + step < height else np.float32(0.0)
    dzx, sx = _nearer_difference(d, left, right)
    dzy, sy = _nearer_difference(d, up, down)
    if sx == 0 or sy == 0:
        return 0.0
    rx, ry = (j + 0.5 - cx) / fx, (i + 0.5 - cy) / fy
    # tangents: points of the neighbouring pixels minus this one, camera frame
    du, dv = sx * step / fx, sy * step / fy
    ax, ay, az = rx * dzx + du * (d + dzx), ry * dzx, dzx
    bx, by, bz = rx * dzy, ry * dzy + dv * (d + dzy), dzy
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    norm = math.sqrt((nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + 1.0))
    if norm <= 0.0:
        return 0.0
    return abs(nx * rx + ny * ry + nz) / norm


@njit(cache=True, inline="always")
def _pixel_end(i, j, d, camera, pose, origin, inv_voxel):
    """End of the ray of pixel (i, j) at depth d, in voxel units."""
    fx, fy, cx, cy = camera
    x, y = (j + 0.5 - cx) / fx * d, (i + 0.5 - cy) / fy * d
    ex = (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * d + pose[0, 3] - origin[0]) * inv_voxel
    ey = (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * d + pose[1, 3] - origin[1]) * inv_voxel
    ez = (pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * d + pose[2, 3] - origin[2]) * inv_voxel
    return ex, ey, ez


@njit(cache=True, inline="always")
def _clip(o, d, n, t0, t1):
    """Clip the parameter range [t0, t1] of o + t d to the slab [0, n]."""
    if d == 0.0:
        if o < 0.0 or o >= n:
            return 1.0, 0.0
        return t0, t1
    ta, tb = -o / d, (n - o) / d
    if ta > tb:
        ta, tb = tb, ta
    return max(t0, ta), min(t1, tb)


@njit(cache=True, inline="always")
def _start(o, d, n, t0, pitch):
    """Along one axis: first index, memory step, steps left in the grid, parameter of the first border, of a voxel."""
    i = min(max(math.floor(o + t0 * d), 0), n - 1)
    if d > 0.0:
        return i, pitch, n - 1 - i, (i + 1 - o) / d, 1.0 / d
    if d < 0.0:
        return i, -pitch, i, (i - o) / d, -1.0 / d
    return i, 0, 0, math.inf, math.inf


@njit(cache=True, inline="always")
def _enter(ox, oy, oz, ex, ey, ez, shape):
    """Where the segment o -> e (voxel units) enters the grid; the state of the walk that `_advance` carries on.

    Incremental traversal of Amanatides and Woo (1987) on flat volumes of `shape`. Returns (flat id of the voxel, -1
    when the segment misses the grid; parameters at which it is entered and at which the segment ends; for the three
    axes: memory steps, voxels left before the grid ends, parameters of the next border, parameters a voxel is long).
    """
    nx, ny, nz = shape
    dx, dy, dz = ex - ox, ey - oy, ez - oz
    t0, t1 = _clip(ox, dx, nx, 0.0, 1.0)
    t0, t1 = _clip(oy, dy, ny, t0, t1)
    t0, t1 = _clip(oz, dz, nz, t0, t1)
    i, si, left_i, ti, gi = _start(ox, dx, nx, t0, ny * nz)
    j, sj, left_j, tj, gj = _start(oy, dy, ny, t0, nz)
    k, sk, left_k, tk, gk = _start(oz, dz, nz, t0, 1)
    v = (i * ny + j) * nz + k if t0 < t1 else -1
    return v, t0, t1, (si, sj, sk), (left_i, left_j, left_k), (ti, tj, tk), (gi, gj, gk)


@njit(cache=True, inline="always")
def _advance(v, t1, pitch, left, t, length):
    """(next voxel of the walk or -1 at its end, where it is entered, voxels left, next borders); see `_enter`."""
    if t[0] <= t[1] and t[0] <= t[2]:
        v = -1 if t[0] >= t1 or left[0] == 0 else v + pitch[0]
        return v, t[0], (left[0] - 1, left[1], left[2]), (t[0] + length[0], t[1], t[2])
    if t[1] <= t[2]:
        v = -1 if t[1] >= t1 or left[1] == 0 else v + pitch[1]
        return v, t[1], (left[0], left[1] - 1, left[2]), (t[0], t[1] + length[1], t[2])
    v = -1 if t[2] >= t1 or left[2] == 0 else v + pitch[2]
    return v, t[2], (left[0], left[1], left[2] - 1), (t[0], t[1], t[2] + length[2])


@njit(cache=True)
def _count_free(ox, oy, oz, ex, ey, ez, shape, free, passed, stamp, frame_id):
    """Add 1 to every voxel that the segment o -> e (voxel units) crosses and that no ray of this frame hit.

    In all of them, mark the half-size cells in which the segment is at one and at three quarters of its way through.
    """
    dx, dy, dz = ex - ox, ey - oy, ez - oz
    v, t, t1, pitch, left, border, length = _enter(ox, oy, oz, ex, ey, ez, shape)
    while v >= 0:
        if stamp[np.uintp(v)] != frame_id:
            free[np.uintp(v)] += np.int32(1)
        here = v
        t0 = t
        v, t, left, border = _advance(v, t1, pitch, left, border, length)
        if passed[np.uintp(here)] != 255:
            out = min(t, t1)
            a, b = 0.75 * t0 + 0.25 * out, 0.25 * t0 + 0.75 * out
            bits = cell_bit(ox + a * dx, oy + a * dy, oz + a * dz)
            passed[np.uintp(here)] |= bits | cell_bit(ox + b * dx, oy + b * dy, oz + b * dz)


@njit(cache=True)
def _carve_frame(depth, camera, pose, reach, start, stride, grid, footprint, out, stamp, frame_id):
    """One frame: mark the voxels that rays end in, then count the voxels that rays pass on their way there."""
    origin, inv_voxel = grid
    near, far = reach
    free, hit, quality, passed, ended = out
    height, width = depth.shape
    nx, ny, nz = free.shape
    for i in range(start[0], height, stride):
        for j in range(start[1], width, stride):
            d = depth[i, j]
            if not (d >= near and d <= far and d > 0.0):
                continue
            ex, ey, ez = _pixel_end(i, j, d, camera, pose, origin, inv_voxel)
            x, y, z = math.floor(ex), math.floor(ey), math.floor(ez)
            if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
                hit[x, y, z] += 1
                ended[x, y, z] |= cell_bit(ex, ey, ez)
                stamp[x, y, z] = frame_id
                # A hit voxel was seen, so its quality is never zero, even where no normal can be measured.
                cosine = max(_incidence_cosine(depth, i, j, stride, camera), 0.1)
                q = np.float32(cosine * min(1.0, footprint * camera[0] / d))
                quality[x, y, z] = max(quality[x, y, z], q)
    ox, oy, oz = _pixel_end(0, 0, 0.0, camera, pose, origin, inv_voxel)
    flat_free, flat_stamp, flat_passed = free.ravel(), stamp.ravel(), passed.ravel()
    for i in range(start[0], height, stride):
        for j in range(start[1], width, stride):
            d = depth[i, j]
            if d >= near and d > 0.0 and d < math.inf:
                ex, ey, ez = _pixel_end(i, j, min(d, far), camera, pose, origin, inv_voxel)
                _count_free(ox, oy, oz, ex, ey, ez, free.shape, flat_free, flat_passed, flat_stamp, frame_id)


@njit(parallel=True, cache=True)
def carve_frames(
    depths, cameras, poses, reaches, starts, stride, origin, inv_voxel, footprint, free, hit, quality, passed, ended
):
    """Free and hit counts and best view quality of a stack of frames; frame f belongs to chunk f % CHUNKS.

    depths (F, H, W) f32; cameras (F, 4) fx fy cx cy; poses (F, 3, 4) camera -> world; reaches (F, 2) near, far;
    starts (F, 2) first row and column; free, hit (CHUNKS, X, Y, Z) i32, quality f32 and the half-size cells that
    rays passed and ended in, u8 bits (`cell_bit`), are added to in place.
    """
    stamp = np.full(free.shape, -1, np.int32)
    for c in prange(CHUNKS):
        for f in range(c, depths.shape[0], CHUNKS):
            camera = (cameras[f, 0], cameras[f, 1], cameras[f, 2], cameras[f, 3])
            _carve_frame(
                depths[f], camera, poses[f], (reaches[f, 0], reaches[f, 1]), (starts[f, 0], starts[f, 1]), stride,
                (origin, inv_voxel), footprint, (free[c], hit[c], quality[c], passed[c], ended[c]), stamp[c], f,
            )


@njit(cache=True)
def _stamp_path(ox, oy, oz, ex, ey, ez, shape, stamp, frame_id):
    """Stamp the voxels of the segment o -> e (voxel units)."""
    v, _, t1, pitch, left, border, length = _enter(ox, oy, oz, ex, ey, ez, shape)
    while v >= 0:
        stamp[np.uintp(v)] = frame_id
        v, _, left, border = _advance(v, t1, pitch, left, border, length)


@njit(cache=True)
def _mark_lost(ox, oy, oz, ex, ey, ez, shape, blocked, stamp, frame_id, vain):
    """vain = 1 in the voxels of the segment o -> e up to the first blocked one that bear no stamp of this frame."""
    v, _, t1, pitch, left, border, length = _enter(ox, oy, oz, ex, ey, ez, shape)
    while v >= 0 and not blocked[np.uintp(v)]:
        if stamp[np.uintp(v)] != frame_id:
            vain[np.uintp(v)] = 1
        v, _, left, border = _advance(v, t1, pitch, left, border, length)


@njit(cache=True)
def _mark_vain(depth, camera, pose, reach, start, stride, grid, range_m, blocked, stamp, frame_id, vain):
    """One frame of `mark_vain`; volumes of `blocked.shape`, stamp and vain flat."""
    near, far = reach
    origin, inv_voxel = grid
    # Lost rays end at depth `range_m`: of the others no more is needed than the voxels that reach so near.
    longest = min(far, range_m + 2.0 / inv_voxel)
    shape, flat_blocked = blocked.shape, blocked.ravel()
    ox, oy, oz = _pixel_end(0, 0, 0.0, camera, pose, origin, inv_voxel)
    for lost in range(2):
        for i in range(start[0], depth.shape[0], stride):
            for j in range(start[1], depth.shape[1], stride):
                d = depth[i, j]
                if (d >= near and d > 0.0 and d < math.inf) == (lost == 1):
                    continue
                end = range_m if lost else min(d, longest)
                ex, ey, ez = _pixel_end(i, j, end, camera, pose, origin, inv_voxel)
                if lost:
                    _mark_lost(ox, oy, oz, ex, ey, ez, shape, flat_blocked, stamp, frame_id, vain)
                else:
                    _stamp_path(ox, oy, oz, ex, ey, ez, shape, stamp, frame_id)


@njit(parallel=True, cache=True)
def mark_vain(depths, cameras, poses, reaches, starts, stride, origin, inv_voxel, range_m, blocked, vain):
    """vain = 1 in voxels up to depth `range_m` that in some frame only rays without a reading crossed.

    blocked (X, Y, Z) uint8 stops such rays; vain (CHUNKS, X, Y, Z) uint8, in place; the rest as in `carve_frames`.
    """
    for c in prange(CHUNKS):
        stamp = np.full(blocked.size, -1, np.int32)
        flat_vain = vain[c].ravel()
        for f in range(c, depths.shape[0], CHUNKS):
            camera = (cameras[f, 0], cameras[f, 1], cameras[f, 2], cameras[f, 3])
            _mark_vain(
                depths[f], camera, poses[f], (reaches[f, 0], reaches[f, 1]), (starts[f, 0], starts[f, 1]), stride,
                (origin, inv_voxel), range_m, blocked, stamp, f, flat_vain,
            )


@njit(parallel=True, cache=True)
def gather(free, hit, quality, passed, ended, all_free, all_hit, all_quality, all_passed, all_ended):
    """Bring the chunks (CHUNKS, X, Y, Z) together: sums, the largest, bits; the last five are (X, Y, Z) zeros."""
    chunks, nx, ny, nz = free.shape
    for i in prange(nx):
        for c in range(chunks):
            for j in range(ny):
                for k in range(nz):
                    f, h, by, at = free[c, i, j, k], hit[c, i, j, k], passed[c, i, j, k], ended[c, i, j, k]
                    if f == 0 and h == 0 and by == 0 and at == 0:
                        continue
                    all_free[i, j, k] += np.float32(f)
                    all_hit[i, j, k] += np.float32(h)
                    all_quality[i, j, k] = max(all_quality[i, j, k], quality[c, i, j, k])
                    all_passed[i, j, k] |= by
                    all_ended[i, j, k] |= at


@njit(parallel=True, cache=True)
def join(free, hit, quality, passed, ended, all_free, all_hit, all_quality, all_passed, all_ended):
    """Add evidence, the first five, to the last five, in place: counts add up, the better view stays."""
    nx, ny, nz = free.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                if free[i, j, k] == 0 and hit[i, j, k] == 0 and passed[i, j, k] == 0 and ended[i, j, k] == 0:
                    continue
                all_free[i, j, k] += free[i, j, k]
                all_hit[i, j, k] += hit[i, j, k]
                all_quality[i, j, k] = max(quality[i, j, k], all_quality[i, j, k])
                all_passed[i, j, k] |= passed[i, j, k]
                all_ended[i, j, k] |= ended[i, j, k]
