"""Slow, obvious twins of the kernels, in float64; the tests compare values."""

import math

import numpy as np


def bilinear(level: np.ndarray, u: float, v: float) -> np.ndarray:
    """(3,) colour at (u, v) of one mip level (h, w, 3+) that repeats."""
    height, width = level.shape[:2]
    x, y = (u - math.floor(u)) * width - 0.5, (v - math.floor(v)) * height - 0.5
    i, j = math.floor(y), math.floor(x)
    b, a = y - i, x - j
    corner = [[level[(i + di) % height, (j + dj) % width, :3].astype(np.float64) for dj in (0, 1)] for di in (0, 1)]
    top = (1 - a) * corner[0][0] + a * corner[0][1]
    low = (1 - a) * corner[1][0] + a * corner[1][1]
    return (1 - b) * top + b * low


def filtered_texture(
    mips: tuple[np.ndarray, ...], uv: np.ndarray, du_dv: np.ndarray, bias: float, max_probes: int, single_level: float
) -> np.ndarray:
    """(3,) colour of a texture over a footprint; twin of `kernels.filtered_texture`.

    `uv` (2,) its centre; `du_dv` (2, 2), columns = change of (u, v) over one pixel to the right and downwards.
    """
    height, width = mips[0].shape[:2]
    left, stretch, _ = np.linalg.svd(np.diag([width, height]) @ du_dv)
    long, short = stretch
    if long <= 1:
        return bilinear(mips[0], *uv)
    probes = max(min(math.ceil(long / max(short, 1.0) - 1e-3), max_probes), 1)
    extent = max(short, long / probes, 1.0)
    lod = min(max(math.log2(extent) + bias, 0.0), len(mips) - 1)
    level, blend = int(lod), lod - int(lod)
    if blend > 1 - single_level:
        level, blend = level + 1, 0.0
    elif blend <= single_level:
        blend = 0.0
    step = left[:, 0] * long / np.array([width, height])
    total = np.zeros(3)
    for i in range(probes):
        u, v = uv + ((i + 0.5) / probes - 0.5) * step
        color = bilinear(mips[level], u, v)
        if blend > 0:
            color = (1 - blend) * color + blend * bilinear(mips[level + 1], u, v)
        total += color
    return total / probes


def box_filtered_texture(image: np.ndarray, uv: np.ndarray, du_dv: np.ndarray, samples: int = 24) -> np.ndarray:
    """(3,) what a supersampled pixel shows: the mean of `samples`^2 bilinear lookups over the footprint."""
    s = (np.arange(samples) + 0.5) / samples - 0.5
    return np.mean([bilinear(image, *(uv + du_dv @ (x, y))) for x in s for y in s], axis=0)


def corner_normals(vertices: np.ndarray, faces: np.ndarray, crease_deg: float) -> np.ndarray:
    """(F, 3, 3) unit corner normals; twin of `shading.corner_normals` for meshes of a few faces."""
    p = vertices.astype(np.float64)[faces]
    cross = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normal = cross / np.linalg.norm(cross, axis=1, keepdims=True)
    out = np.zeros((len(faces), 3, 3))
    for f in range(len(faces)):
        for c in range(3):
            total = 0.5 * cross[f]
            for g in range(len(faces)):
                touches = (np.linalg.norm(p[g] - p[f, c], axis=1) < 1e-5).any()
                dot = normal[f] @ normal[g]
                if g != f and touches and abs(dot) > math.cos(math.radians(crease_deg)):
                    total = total + np.sign(dot) * 0.5 * cross[g]
            out[f, c] = total / np.linalg.norm(total)
    return out
