"""Compiled loops: ray carving, back-projection of residuals, opacity mass. Slow references live in the tests.

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
def _scatter_view(residual, depth, camera, pose, start, stride, origin, inv_voxel, value, weight, touched):
    """Distribute the residuals of one view over the eight voxels around each observed point (trilinear).

    Returns how many voxels have weight now; their flat ids are in `touched`.
    """
    nx, ny, nz = value.shape
    count = 0
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            d = depth[i, j]
            if not d > 0.0:
                continue
            ex, ey, ez = _pixel_end(start + i * stride, start + j * stride, d, camera, pose, origin, inv_voxel)
            ex -= 0.5
            ey -= 0.5
            ez -= 0.5
            x, y, z = math.floor(ex), math.floor(ey), math.floor(ez)
            if x < -1 or y < -1 or z < -1 or x >= nx or y >= ny or z >= nz:
                continue
            fx, fy, fz = np.float32(ex - x), np.float32(ey - y), np.float32(ez - z)
            e = residual[i, j]
            for a in range(2):
                if x + a < 0 or x + a >= nx:
                    continue
                wx = fx if a else np.float32(1.0) - fx
                for b in range(2):
                    if y + b < 0 or y + b >= ny:
                        continue
                    wxy = wx * (fy if b else np.float32(1.0) - fy)
                    for c in range(2):
                        if 0 <= z + c < nz:
                            w = wxy * (fz if c else np.float32(1.0) - fz)
                            if w <= 0.0:
                                continue
                            if weight[x + a, y + b, z + c] == 0.0:
                                touched[count] = ((x + a) * ny + y + b) * nz + z + c
                                count += 1
                            value[x + a, y + b, z + c] += w * e
                            weight[x + a, y + b, z + c] += w
    return count


@njit(parallel=True, cache=True)
def backproject_views(residuals, depths, cameras, poses, start, stride, origin, inv_voxel, min_weight, total, views):
    """Sum over views of the mean residual of each view in each voxel, and the number of views that saw it.

    residuals, depths (V, h, w) f32, already thinned to every `stride`-th pixel from `start`; total f32 and views i32
    are (CHUNKS, X, Y, Z), added to in place; view v belongs to chunk v % CHUNKS.
    """
    for c in prange(CHUNKS):
        value = np.zeros(total.shape[1:], np.float32)
        weight = np.zeros(total.shape[1:], np.float32)
        touched = np.empty(min(value.size, 8 * depths.shape[1] * depths.shape[2]), np.int64)
        for v in range(c, depths.shape[0], CHUNKS):
            camera = (cameras[v, 0], cameras[v, 1], cameras[v, 2], cameras[v, 3])
            count = _scatter_view(
                residuals[v], depths[v], camera, poses[v], start, stride, origin, inv_voxel, value, weight, touched
            )
            flat_value, flat_weight = value.ravel(), weight.ravel()
            flat_total, flat_views = total[c].ravel(), views[c].ravel()
            for t in range(count):
                n = np.uintp(touched[t])
                if flat_weight[n] >= min_weight:
                    flat_total[n] += flat_value[n] / flat_weight[n]
                    flat_views[n] += 1
                flat_value[n] = 0.0
                flat_weight[n] = 0.0


@njit(cache=True)
def _add_mass(x, y, z, m, mass):
    nx, ny, nz = mass.shape
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
        mass[i, j, k] += m


@njit(parallel=True, cache=True)
def splat_opacity(means, log_scales, quats, logits, origin, inv_voxel, mass):
    """Opaque area of the Gaussians per voxel, in units of a voxel face; mass (CHUNKS, X, Y, Z) f32 in place.

    The effective area of a disc with standard deviations a, b is 2 pi a b. It is shared out over the five points of a
    degree-3 cubature of the disc: the centre (1/3) and sqrt(3) a, sqrt(3) b to either side (1/6 each).
    """
    root3 = math.sqrt(3.0)
    n = means.shape[0]
    per_chunk = (n + CHUNKS - 1) // CHUNKS
    for c in prange(CHUNKS):
        for g in range(c * per_chunk, min(n, (c + 1) * per_chunk)):
            w, x, y, z = quats[g, 0], quats[g, 1], quats[g, 2], quats[g, 3]
            inv = 1.0 / math.sqrt(w * w + x * x + y * y + z * z + 1e-20)
            w, x, y, z = w * inv, x * inv, y * inv, z * inv
            thin = 0
            for a in range(1, 3):
                if log_scales[g, a] < log_scales[g, thin]:
                    thin = a
            mx = (means[g, 0] - origin[0]) * inv_voxel
            my = (means[g, 1] - origin[1]) * inv_voxel
            mz = (means[g, 2] - origin[2]) * inv_voxel
            m = 2.0 * math.pi / (1.0 + math.exp(-logits[g]))
            for a in range(3):
                if a != thin:
                    m *= math.exp(log_scales[g, a]) * inv_voxel
            _add_mass(mx, my, mz, m / 3.0, mass[c])
            for a in range(3):
                if a == thin:
                    continue
                if a == 0:
                    rx, ry, rz = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)
                elif a == 1:
                    rx, ry, rz = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)
                else:
                    rx, ry, rz = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
                r = root3 * math.exp(log_scales[g, a]) * inv_voxel
                _add_mass(mx + r * rx, my + r * ry, mz + r * rz, m / 6.0, mass[c])
                _add_mass(mx - r * rx, my - r * ry, mz - r * rz, m / 6.0, mass[c])


@njit(cache=True)
def _mark_path(ox, oy, oz, ex, ey, ez, shape, blocked, stamp, frame_id, vain, seen_id):
    """Stamp the voxels of the segment o -> e up to the first blocked one; with `vain`, stamp only what is unstamped.

    `stamp` holds 2 * frame + 1 where a reading passed in this frame and 2 * frame + 2 where only lost rays did.
    """
    v, _, t1, pitch, left, border, length = _enter(ox, oy, oz, ex, ey, ez, shape)
    while v >= 0:
        if vain and blocked[np.uintp(v)]:
            return
        if not vain or stamp[np.uintp(v)] != seen_id:
            stamp[np.uintp(v)] = frame_id
        v, _, left, border = _advance(v, t1, pitch, left, border, length)


@njit(cache=True)
def mark_vain(depth, camera, pose, reach, start, stride, origin, inv_voxel, range_m, blocked, stamp, frame, vain):
    """vain = 1 in voxels up to depth `range_m` that only rays without a reading crossed in this frame.

    blocked, vain (X, Y, Z) uint8, stamp (X, Y, Z) i32 that starts below 0; see `_mark_path`.
    """
    near, far = reach
    seen_id, lost_id = 2 * frame + 1, 2 * frame + 2
    ox, oy, oz = _pixel_end(0, 0, 0.0, camera, pose, origin, inv_voxel)
    flat_stamp, flat_blocked, flat_vain = stamp.ravel(), blocked.ravel(), vain.ravel()
    for lost in range(2):
        for i in range(start[0], depth.shape[0], stride):
            for j in range(start[1], depth.shape[1], stride):
                d = depth[i, j]
                has_reading = d >= near and d > 0.0 and d < math.inf
                if has_reading == (lost == 1):
                    continue
                e = range_m if lost else min(d, far)
                ex, ey, ez = _pixel_end(i, j, e, camera, pose, origin, inv_voxel)
                _mark_path(
                    ox, oy, oz, ex, ey, ez, stamp.shape, flat_blocked, flat_stamp, lost_id if lost else seen_id,
                    lost == 1, seen_id,
                )
    for v in range(flat_stamp.size):
        if flat_stamp[v] == lost_id:
            flat_vain[v] = 1


@njit(parallel=True, cache=True)
def mean_between(low, high, table, reach, out):
    """out = (I(high) - I(low)) / (high - low) for an integral I tabulated evenly over [-reach, reach], flat f32."""
    last = table.size - 1
    scale = last / (2.0 * reach)
    for n in prange(out.size):
        value = 0.0
        for side in range(2):
            z = min(max((low[n] if side == 0 else high[n]) + reach, 0.0), 2.0 * reach) * scale
            i = min(int(z), last - 1)
            at = table[i] + (z - i) * (table[i + 1] - table[i])
            value += at if side == 1 else -at
        out[n] = value / (high[n] - low[n])
