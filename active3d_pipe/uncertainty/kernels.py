"""Compiled loops: back-projection of residuals, opacity mass, means. Slow references live in the tests.

Work is split over a fixed number of chunks (`CHUNKS`), each with volumes of its own that are summed in chunk order:
the same bytes come out whatever the number of threads. No fastmath: depth may hold NaN, and must be told apart.
"""

# mypy: disable-error-code=no-untyped-def

import math

import numpy as np
from numba import njit, prange

from active3d_pipe.uncertainty.kernels_carving import CHUNKS, _pixel_end


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
def mean_at_readings(depth, camera, pose, first, stride, origin, size, values):
    """Mean of values (X, Y, Z) f32 in the voxels that a frame's readings lie in, each counted; 0 when none does.

    depth (H, W) f32, every `stride`-th pixel from `first` on; camera and pose as in `carve_frames`, of one frame.
    """
    fx, fy, cx, cy = camera
    nx, ny, nz = values.shape
    total, count = 0.0, 0
    for i in range(first, depth.shape[0], stride):
        for j in range(first, depth.shape[1], stride):
            d = depth[i, j]
            if not d > 0.0:
                continue
            x, y = (j + 0.5 - cx) / fx * d, (i + 0.5 - cy) / fy * d
            a = math.floor((pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * d + pose[0, 3] - origin[0]) / size)
            b = math.floor((pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * d + pose[1, 3] - origin[1]) / size)
            c = math.floor((pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * d + pose[2, 3] - origin[2]) / size)
            if 0 <= a < nx and 0 <= b < ny and 0 <= c < nz:
                total += values[a, b, c]
                count += 1
    return total / count if count else 0.0


@njit(parallel=True, cache=True)
def near_attention(attention, u):
    """u (X, Y, Z) f32 times the largest attention of the 3 x 3 x 3 voxels around, in place; most of u is 0."""
    nx, ny, nz = u.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                if u[i, j, k] == 0.0:
                    continue
                most = attention[i, j, k]
                for a in range(max(i - 1, 0), min(i + 2, nx)):
                    for b in range(max(j - 1, 0), min(j + 2, ny)):
                        for c in range(max(k - 1, 0), min(k + 2, nz)):
                            most = max(most, attention[a, b, c])
                u[i, j, k] *= most


@njit(parallel=True, cache=True)
def running_mean(total, seen, taps, least_views, memory, before, out):
    """out (X, Y, Z) f32: `before`, moved towards the mean residual of what views saw around (`explicit`).

    total f32 and seen i32 (CHUNKS, X, Y, Z) are sums over views of residuals and of 1; `taps` (2 r + 1,) f32 blurs
    both, along every axis, what lies outside being 0.
    """
    chunks, nx, ny, nz = total.shape
    r = len(taps) // 2
    blurred = np.zeros((2, nx, ny, nz), np.float32)  # along z and y
    for i in prange(nx):
        sums, along = np.zeros((2, nz), np.float32), np.zeros((2, ny, nz), np.float32)
        touched = np.zeros(ny, np.bool_)
        for j in range(ny):
            for k in range(nz):
                value, views = np.float32(0.0), 0
                for c in range(chunks):
                    value += total[c, i, j, k]
                    views += seen[c, i, j, k]
                sums[0, k], sums[1, k] = value, np.float32(views)
                touched[j] |= views > 0
            if touched[j]:
                for k in range(nz):
                    for m in range(max(k - r, 0), min(k + r + 1, nz)):
                        w = taps[m - k + r]
                        along[0, j, k] += w * sums[0, m]
                        along[1, j, k] += w * sums[1, m]
        for j in range(ny):
            for m in range(max(j - r, 0), min(j + r + 1, ny)):
                if touched[m]:
                    w = taps[m - j + r]
                    for k in range(nz):
                        blurred[0, i, j, k] += w * along[0, m, k]
                        blurred[1, i, j, k] += w * along[1, m, k]
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                value, count = np.float32(0.0), np.float32(0.0)
                for m in range(max(i - r, 0), min(i + r + 1, nx)):
                    value += taps[m - i + r] * blurred[0, m, j, k]
                    count += taps[m - i + r] * blurred[1, m, j, k]
                then = before[i, j, k]
                out[i, j, k] = then
                if count > least_views:
                    kept = memory if then > 0.0 else np.float32(0.0)
                    out[i, j, k] = then + count / (count + kept) * (value / count - then)
