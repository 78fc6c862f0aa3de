"""Numba kernels on the mesh of a scene: ray and plane, holes of alpha masks, corner normals, texel packing."""
# mypy: ignore-errors

import math

import numpy as np
from numba import njit, prange

from active3d_pipe.sim.kernels import _BLUE, _GREEN, _ZERO, NO_HIT


@njit(inline="always")
def _wrap(i, n):
    i = i % n
    return i + n if i < 0 else i


@njit(parallel=True, cache=True)
def plane_hits(rays, face, vertices, faces, t, bary):
    """Exact t and barycentric coordinates of rays on the planes of the faces they are known to meet (float64)."""
    for n in prange(len(face)):
        f = face[n]
        if f == NO_HIT:
            t[n] = np.inf
            bary[n, 0] = _ZERO
            bary[n, 1] = _ZERO
            continue
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = float(vertices[a, 0]), float(vertices[a, 1]), float(vertices[a, 2])
        e1x, e1y, e1z = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
        e2x, e2y, e2z = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
        sx, sy, sz = rays[n, 0] - ax, rays[n, 1] - ay, rays[n, 2] - az
        dx, dy, dz = float(rays[n, 3]), float(rays[n, 4]), float(rays[n, 5])
        px, py, pz = dy * e2z - dz * e2y, dz * e2x - dx * e2z, dx * e2y - dy * e2x
        det = e1x * px + e1y * py + e1z * pz
        if abs(det) < 1e-18:
            det = 1e-18
        qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
        inv = 1.0 / det
        u, v = (sx * px + sy * py + sz * pz) * inv, (dx * qx + dy * qy + dz * qz) * inv
        t[n] = (e2x * qx + e2y * qy + e2z * qz) * inv
        bary[n, 0] = min(max(u, 0.0), 1.0)
        bary[n, 1] = min(max(v, 0.0), 1.0 - bary[n, 0])


@njit(parallel=True, cache=True)
def holes(face, bary, face_material, cutoff, uv, mip_range, levels, alphas, out):
    """(N,) bool, whether a hit falls on a texel whose alpha is below its material's cutoff (0..255, < 0 = none)."""
    for n in prange(len(face)):
        out[n] = False
        f = face[n]
        if f == NO_HIT:
            continue
        m = face_material[f]
        if cutoff[m] < 0 or mip_range[m, 1] <= mip_range[m, 0]:
            continue
        level = mip_range[m, 0]
        offset, width, height = levels[level, 0], levels[level, 1], levels[level, 2]
        b1, b2 = bary[n, 0], bary[n, 1]
        b0 = 1 - b1 - b2
        u = b0 * uv[f, 0, 0] + b1 * uv[f, 1, 0] + b2 * uv[f, 2, 0]
        v = b0 * uv[f, 0, 1] + b1 * uv[f, 1, 1] + b2 * uv[f, 2, 1]
        x = _wrap(np.int64(math.floor(u * width)), width)
        y = _wrap(np.int64(math.floor(v * height)), height)
        out[n] = alphas[offset + y * width + x] < cutoff[m]


@njit(parallel=True, cache=True)
def pack_texels(rgba, colours, alphas):
    """Spread texels (T, 4) uint8 into `colours` (T,) int64 of 21 bits a channel, and `alphas` (T,) uint8."""
    for n in prange(len(rgba)):
        colours[n] = np.int64(rgba[n, 0]) | (np.int64(rgba[n, 1]) << _GREEN) | (np.int64(rgba[n, 2]) << _BLUE)
        alphas[n] = rgba[n, 3]


@njit(cache=True)
def crease_normals(faces, starts, corners, merged, face_normal, face_area, cos_crease, out):
    """Corner normals (F, 3, 3) int16 (unit = 32767): area-weighted over adjacent faces within the crease angle.

    `merged` (F, 3) vertex ids after merging equal positions; `starts` (M + 1,), `corners`: the corners 3 f + c of every
    merged vertex (CSR). A neighbour wound the other way counts with its normal turned.
    """
    for f in range(len(faces)):
        for c in range(3):
            v = merged[f, c]
            begin, end = starts[v], starts[v + 1]
            x, y, z = face_normal[f, 0], face_normal[f, 1], face_normal[f, 2]
            x, y, z = x * face_area[f], y * face_area[f], z * face_area[f]
            if end - begin <= 256:
                for k in range(begin, end):
                    g = corners[k] // 3
                    if g == f:
                        continue
                    dot = (face_normal[f, 0] * face_normal[g, 0] + face_normal[f, 1] * face_normal[g, 1]
                           + face_normal[f, 2] * face_normal[g, 2])
                    if abs(dot) > cos_crease:
                        w = face_area[g] if dot > 0 else -face_area[g]
                        x, y, z = x + w * face_normal[g, 0], y + w * face_normal[g, 1], z + w * face_normal[g, 2]
            norm = math.sqrt(x * x + y * y + z * z)
            if norm > 0:
                out[f, c, 0] = np.int16(round(32767 * x / norm))
                out[f, c, 1] = np.int16(round(32767 * y / norm))
                out[f, c, 2] = np.int16(round(32767 * z / norm))
