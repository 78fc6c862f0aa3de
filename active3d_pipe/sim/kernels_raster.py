"""Numba kernels that find the face seen at pixel centres and at samples of chosen pixels, by scan conversion.

Homogeneous rasterisation (Olano and Greer 1997): with camera-space corners v0, v1, v2 of a face, the ray d = (X, Y, 1)
meets it where n_i . d >= 0 for n_0 = v1 x v2 and so on (signed by det = v0 . n_0), and 1 / depth is linear over the
image. So nothing is clipped, and the answer is that of a ray test. Bands of rows are independent, and in each the faces
come from front to back, in the order of their index where they are as far: same input, same bytes. Twin: Open3D's
ray caster.
"""
# mypy: ignore-errors

import math

import numpy as np
from numba import njit, prange

from active3d_pipe.sim.kernels import NO_HIT

BANDS = 8
CHUNKS = 64
_FIXED = 256  # image bounds are kept in 1/256 px
_NEAREST = np.float32(1e-3)  # m in front of the camera; nothing nearer is seen
_SLACK = np.float32(1e-4)  # px by which an edge is widened, so that no ray slips between two faces
_SMALL = 64  # px of a face's box, up to which it is tested whether all of it is hidden
_NEARER = np.float32(1 + 2e-6)  # of two coincident faces the first is seen
_ZERO, _HALF = np.float32(0.0), np.float32(0.5)


@njit(parallel=True, cache=True)
def to_camera(vertices, T, out):
    """Vertices (V, 3) float32 in the camera's frame; `T` (4, 4) float64 T_camera_world."""
    for n in prange(len(vertices)):
        x, y, z = vertices[n, 0], vertices[n, 1], vertices[n, 2]
        for c in range(3):
            out[n, c] = T[c, 0] * x + T[c, 1] * y + T[c, 2] * z + T[c, 3]


@njit(inline="always")
def _grow(low_x, high_x, low_y, high_y, x, y, z, fx, fy, cx, cy):
    u, v = fx * x / z + cx, fy * y / z + cy
    return min(low_x, u), max(high_x, u), min(low_y, v), max(high_y, v)


@njit(parallel=True, cache=True)
def visible_faces(points, faces, fx, fy, cx, cy, width, height, found, bounds, nearest, counts):
    """Faces whose image meets the picture, chunk by chunk.

    `points` (V, 3) camera frame; `found` (F,) int32 and `bounds` (F, 4) int32 (x low, high, y low, high in 1/256 px)
    and `nearest` (F,) float32, the largest 1 / depth of a corner, are filled from the start of every chunk of
    ceil(F / CHUNKS) faces; `counts` (CHUNKS,) says how far.
    """
    size = (len(faces) + CHUNKS - 1) // CHUNKS
    for chunk in prange(CHUNKS):
        n = chunk * size
        for f in range(chunk * size, min((chunk + 1) * size, len(faces))):
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            za, zb, zc = points[a, 2], points[b, 2], points[c, 2]
            if max(za, zb, zc) <= _NEAREST:
                continue
            lx, hx, ly, hy = np.float32(1e9), np.float32(-1e9), np.float32(1e9), np.float32(-1e9)
            for k in range(3):
                i = a if k == 0 else b if k == 1 else c
                j = b if k == 0 else c if k == 1 else a
                zi, zj = points[i, 2], points[j, 2]
                if zi > _NEAREST:
                    lx, hx, ly, hy = _grow(lx, hx, ly, hy, points[i, 0], points[i, 1], zi, fx, fy, cx, cy)
                if (zi > _NEAREST) != (zj > _NEAREST):
                    s = (_NEAREST - zi) / (zj - zi)
                    x, y = points[i, 0] + s * (points[j, 0] - points[i, 0]), points[i, 1] + s * (
                        points[j, 1] - points[i, 1])
                    lx, hx, ly, hy = _grow(lx, hx, ly, hy, x, y, _NEAREST, fx, fy, cx, cy)
            if hx < _ZERO or hy < _ZERO or lx > width or ly > height:
                continue
            found[n] = f
            nearest[n] = np.float32(1) / max(min(za, zb, zc), _NEAREST)
            bounds[n, 0] = np.int32(math.floor(max(lx, _ZERO) * _FIXED))
            bounds[n, 1] = np.int32(math.ceil(min(hx, np.float32(width)) * _FIXED))
            bounds[n, 2] = np.int32(math.floor(max(ly, _ZERO) * _FIXED))
            bounds[n, 3] = np.int32(math.ceil(min(hy, np.float32(height)) * _FIXED))
            n += 1
        counts[chunk] = n - chunk * size


@njit(cache=True)
def front_to_back(faces, found, bounds, nearest, counts, to_found, to_bounds, to_nearest):
    """Join the chunks of `visible_faces`, faces near the camera first (in 256 classes), then by index; their number."""
    size = (len(faces) + CHUNKS - 1) // CHUNKS
    starts = np.zeros(257, np.int64)
    for chunk in range(CHUNKS):
        for n in range(chunk * size, chunk * size + counts[chunk]):
            starts[_depth_class(nearest[n]) + 1] += 1
    for k in range(256):
        starts[k + 1] += starts[k]
    for chunk in range(CHUNKS):
        for n in range(chunk * size, chunk * size + counts[chunk]):
            k = _depth_class(nearest[n])
            at = starts[k]
            starts[k] += 1
            to_found[at], to_nearest[at] = found[n], nearest[n]
            for c in range(4):
                to_bounds[at, c] = bounds[n, c]
    return starts[255]


@njit(inline="always")
def _depth_class(nearness):
    return np.int64(min(np.float32(12.8) / max(nearness, np.float32(1e-6)), np.float32(255)))


@njit(inline="always")
def _edges(points, i0, i1, i2, fx, fy, cx, cy, plane, scale):
    """Fill `plane` (4, 3) float64 = a, b, c of three edge distances in px and of 1 / depth, at (x, y): a x + b y + c.

    `scale` (3,): distance i times scale i times depth is the barycentric coordinate of corner i. False = edge-on.
    """
    x0, y0, z0 = np.float64(points[i0, 0]), np.float64(points[i0, 1]), np.float64(points[i0, 2])
    x1, y1, z1 = np.float64(points[i1, 0]), np.float64(points[i1, 1]), np.float64(points[i1, 2])
    x2, y2, z2 = np.float64(points[i2, 0]), np.float64(points[i2, 1]), np.float64(points[i2, 2])
    ax, ay, az = y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2
    bx, by, bz = y2 * z0 - z2 * y0, z2 * x0 - x2 * z0, x2 * y0 - y2 * x0
    ex, ey, ez = y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1
    det = x0 * ax + y0 * ay + z0 * az
    if abs(det) < 1e-15:
        return False
    sign, inv = (1.0, 1.0 / det) if det > 0 else (-1.0, -1.0 / det)
    plane[0, 0], plane[0, 1], plane[0, 2] = sign * ax / fx, sign * ay / fy, sign * az
    plane[1, 0], plane[1, 1], plane[1, 2] = sign * bx / fx, sign * by / fy, sign * bz
    plane[2, 0], plane[2, 1], plane[2, 2] = sign * ex / fx, sign * ey / fy, sign * ez
    plane[3, 0] = (plane[0, 0] + plane[1, 0] + plane[2, 0]) * inv
    plane[3, 1] = (plane[0, 1] + plane[1, 1] + plane[2, 1]) * inv
    plane[3, 2] = (plane[0, 2] + plane[1, 2] + plane[2, 2]) * inv
    plane[3, 2] -= plane[3, 0] * cx + plane[3, 1] * cy
    for k in range(3):
        norm = max(math.sqrt(plane[k, 0] * plane[k, 0] + plane[k, 1] * plane[k, 1]), 1e-30)
        plane[k, 2] = (plane[k, 2] - plane[k, 0] * cx - plane[k, 1] * cy) / norm
        plane[k, 0], plane[k, 1] = plane[k, 0] / norm, plane[k, 1] / norm
        scale[k] = norm * inv
    return True


@njit(inline="always")
def _span(plane, y, slack, x0, x1):
    """Pixels first..last (last < first: none) in x0..x1 whose centre lies inside all edges widened by `slack` (3,)."""
    low, high = np.float64(x0), np.float64(x1)
    for k in range(3):
        a, r = plane[k, 0], plane[k, 1] * y + plane[k, 2] + slack[k]
        if a > 1e-9:
            low = max(low, math.ceil(-r / a - 0.5))
        elif a < -1e-9:
            high = min(high, math.floor(-r / a - 0.5))
        elif r < 0:
            high = -1.0
    return np.int64(low), np.int64(high)


@njit(inline="always")
def _is_hole(f, b1, b2, m, uv, mip_range, levels, alphas, cutoff):
    level = mip_range[m, 0]
    offset, w, h = levels[level, 0], levels[level, 1], levels[level, 2]
    b0 = np.float32(1) - b1 - b2
    u = b0 * uv[f, 0, 0] + b1 * uv[f, 1, 0] + b2 * uv[f, 2, 0]
    v = b0 * uv[f, 0, 1] + b1 * uv[f, 1, 1] + b2 * uv[f, 2, 1]
    x = min(np.int64((u - math.floor(u)) * w), w - 1)
    y = min(np.int64((v - math.floor(v)) * h), h - 1)
    return alphas[offset + y * w + x] < cutoff


@njit(inline="always")
def _band(slot, height):
    # Numba gives contiguous slots to a thread: even bands first, so that floor and ceiling are shared out.
    band = 2 * slot if 2 * slot < BANDS else 2 * slot - BANDS + 1
    return band * height // BANDS, (band + 1) * height // BANDS


@njit(parallel=True, cache=True)
def faces_at_centres(points, faces, total, found, bounds, nearest, fx, fy, cx, cy, face_material, cutoff, uv, mip_range,
                     levels, alphas, nearness, seen):
    """Face (H, W) uint32 seen at every pixel centre (NO_HIT = none), and 1 / depth (H, W) float32 there."""
    height, width = seen.shape
    for slot in prange(BANDS):
        top, bottom = _band(slot, height)
        plane, scale = np.empty((4, 3)), np.empty(3)
        slack = np.full(3, np.float64(_SLACK))
        nearness[top:bottom] = _ZERO
        seen[top:bottom] = NO_HIT
        for n in range(total):
            y0, y1 = max((bounds[n, 2] + 126) >> 8, top), min((bounds[n, 3] - 126) >> 8, bottom - 1)
            x0, x1 = (bounds[n, 0] + 126) >> 8, min((bounds[n, 1] - 126) >> 8, width - 1)
            if y0 > y1 or x0 > x1:
                continue
            if (y1 - y0 + 1) * (x1 - x0 + 1) <= _SMALL:
                hidden = True
                for i in range(y0, y1 + 1):
                    for j in range(x0, x1 + 1):
                        hidden = hidden & (nearest[n] <= nearness[i, j])
                if hidden:
                    continue
            f = found[n]
            if not _edges(points, faces[f, 0], faces[f, 1], faces[f, 2], fx, fy, cx, cy, plane, scale):
                continue
            face = np.uint32(f)
            m = face_material[f]
            masked = cutoff[m] >= 0
            gradient = np.float32(plane[3, 0])
            for i in range(y0, y1 + 1):
                y = i + 0.5
                first, last = _span(plane, y, slack, x0, x1)
                start = np.float32(plane[3, 0] * (first + 0.5) + plane[3, 1] * y + plane[3, 2])
                if not masked:
                    row, ids = nearness[i, first:last + 1], seen[i, first:last + 1]
                    for j in range(last + 1 - first):
                        w = start + gradient * np.float32(j)
                        nearer = w > row[j] * _NEARER
                        row[j] = w if nearer else row[j]
                        ids[j] = face if nearer else ids[j]
                    continue
                for j in range(first, last + 1):
                    w = start + gradient * np.float32(j - first)
                    if w > nearness[i, j] * _NEARER:
                        x = j + 0.5
                        b1 = (plane[1, 0] * x + plane[1, 1] * y + plane[1, 2]) * scale[1] / w
                        b2 = (plane[2, 0] * x + plane[2, 1] * y + plane[2, 2]) * scale[2] / w
                        if not _is_hole(f, np.float32(b1), np.float32(b2), m, uv, mip_range, levels, alphas,
                                        cutoff[m]):
                            nearness[i, j] = w
                            seen[i, j] = face


@njit(parallel=True, cache=True)
def faces_at_samples(points, faces, total, found, bounds, nearest, fx, fy, cx, cy, face_material, cutoff, uv, mip_range,
                     levels, alphas, before, columns, offsets, nearness, farthest, seen):
    """Face (P, K) uint32 seen at the samples `offsets` (K, 2) of P chosen pixels, and 1 / depth (P, K) float32.

    `before` (H, W + 1) int32: number of chosen pixels before each, row by row; `columns` (P,) int32 their columns;
    `farthest` (P,) float32, the least 1 / depth of a pixel's samples.
    """
    height, width = before.shape[0], before.shape[1] - 1
    samples = len(offsets)
    for slot in prange(BANDS):
        top, bottom = _band(slot, height)
        plane, scale, slack = np.empty((4, 3)), np.empty(3), np.empty(3)
        shift0, shift1 = np.empty(samples, np.float32), np.empty(samples, np.float32)
        shift2, shift3 = np.empty(samples, np.float32), np.empty(samples, np.float32)
        first_pixel, end_pixel = before[top, 0], before[bottom - 1, width]
        nearness[first_pixel:end_pixel] = _ZERO
        farthest[first_pixel:end_pixel] = _ZERO
        seen[first_pixel:end_pixel] = NO_HIT
        for n in range(total):
            y0, y1 = max(bounds[n, 2] >> 8, top), min(bounds[n, 3] >> 8, bottom - 1)
            if y0 > y1:
                continue
            x0, x1 = min(bounds[n, 0] >> 8, width - 1), min(bounds[n, 1] >> 8, width - 1)
            if (y1 - y0 + 1) * (x1 - x0 + 1) <= _SMALL:
                # Most faces are small, and most of those touch no chosen pixel or are hidden.
                hidden = True
                for i in range(y0, y1 + 1):
                    for p in range(before[i, x0], before[i, x1 + 1]):
                        hidden = hidden & (nearest[n] <= farthest[p])
                if hidden:
                    continue
            f = found[n]
            if not _edges(points, faces[f, 0], faces[f, 1], faces[f, 2], fx, fy, cx, cy, plane, scale):
                continue
            face = np.uint32(f)
            m = face_material[f]
            masked = cutoff[m] >= 0
            for s in range(samples):
                dx, dy = offsets[s, 0] - 0.5, offsets[s, 1] - 0.5
                shift0[s], shift1[s] = plane[0, 0] * dx + plane[0, 1] * dy, plane[1, 0] * dx + plane[1, 1] * dy
                shift2[s], shift3[s] = plane[2, 0] * dx + plane[2, 1] * dy, plane[3, 0] * dx + plane[3, 1] * dy
            for k in range(3):
                slack[k] = 0.5 * (abs(plane[k, 0]) + abs(plane[k, 1]))
            for i in range(y0, y1 + 1):
                if before[i, x1 + 1] == before[i, x0]:
                    continue
                y = i + 0.5
                first, last = _span(plane, y, slack, x0, x1)
                if first > last:
                    continue
                r0 = plane[0, 1] * y + plane[0, 2] + _SLACK
                r1 = plane[1, 1] * y + plane[1, 2] + _SLACK
                r2 = plane[2, 1] * y + plane[2, 2] + _SLACK
                r3 = plane[3, 1] * y + plane[3, 2]
                for p in range(before[i, first], before[i, last + 1]):
                    x = columns[p] + 0.5
                    e0, e1 = np.float32(plane[0, 0] * x + r0), np.float32(plane[1, 0] * x + r1)
                    e2, w = np.float32(plane[2, 0] * x + r2), np.float32(plane[3, 0] * x + r3)
                    if nearest[n] <= farthest[p]:
                        continue
                    near_row, seen_row = nearness[p], seen[p]
                    if not masked:
                        for s in range(samples):  # without a branch, so that eight samples go at once
                            inside = min(e0 + shift0[s], e1 + shift1[s], e2 + shift2[s]) >= _ZERO
                            ws = w + shift3[s]
                            nearer = inside & (ws > near_row[s] * _NEARER)
                            near_row[s] = ws if nearer else near_row[s]
                            seen_row[s] = face if nearer else seen_row[s]
                        least = near_row[0]
                        for s in range(1, samples):
                            least = min(least, near_row[s])
                        farthest[p] = least
                        continue
                    for s in range(samples):
                        d1, d2, ws = e1 + shift1[s], e2 + shift2[s], w + shift3[s]
                        if min(e0 + shift0[s], d1, d2) >= _ZERO and ws > near_row[s] * _NEARER:
                            b1, b2 = d1 * np.float32(scale[1]) / ws, d2 * np.float32(scale[2]) / ws
                            if not _is_hole(f, b1, b2, m, uv, mip_range, levels, alphas, cutoff[m]):
                                near_row[s] = ws
                                seen_row[s] = face
