"""How surfaces are lit, and the scene packed into flat arrays for the kernels.

The light is fixed in the world and independent of the view, so a surface point has one colour from everywhere (on each
of its sides), as a map without view-dependent colour assumes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from active3d_pipe.geometry.raycasting import SurfaceIndex
from active3d_pipe.sim import kernels_mesh
from active3d_pipe.sim.placement import face_areas
from active3d_pipe.sim.scene import Scene

# Rows (direction x, y, z, weight): brightness = first weight + sum of weight * (normal . direction), all terms signed,
# so that light falls off smoothly round a body and no side is black. First row: constant; second: sky above floor; then
# two lamps from different sides, so that the four walls of a room differ.
LIGHTS = np.array(
    [[0, 0, 0, 0.76], [0, 0, 1, 0.08], [0.80, 0.45, 0.40, 0.10], [-0.35, 0.85, 0.40, 0.07]], dtype=np.float32
)
# Rows (height above the surface in m, weight): ambient occlusion by the distance field (Evans 2006): at height h along
# the normal the nearest surface is h away in the open, and nearer in corners.
OCCLUSION = np.array([[0.15, 0.14], [0.4, 0.14], [1.0, 0.16]], dtype=np.float32)
CREASE_DEG = 40.0
_MAX_CELLS = 400_000
# Smallest error against 6 x 6 supersampling on three furnished scenes; -1 aliases, 0 blurs (1 to 4 dB either way).
TEXTURE_BIAS = -0.6
MAX_PROBES = 8
# For a face in a pixel at an edge: the part that it covers is some 0.7 px wide, and its neighbours blur it anyway.
GROUP_FOOTPRINT, GROUP_PROBES = 0.7, 2


@dataclass(frozen=True, slots=True, eq=False)
class PackedScene:
    """A scene as the kernels read it.

    Attributes:
        arrays: vertices (V, 3) f32, faces (F, 3) i32, face_material (F,) i32, uv (F, 3, 2) f32 or (0, 3, 2), corner
            normals (F, 3, 3) i16, vertex colours (V, 3) u8 or (0, 3), base colours (M, 3) f32 in 0..1, mip_range (M, 2)
            i64 rows of `levels`, levels (L, 3) i64 = offset, width, height, texels (T,) i64, lights (K, 4) f32,
            occlusion (K, 2) f32, distance grid [X, Y, Z] f32 m, its origin (3,) f32 and 1 / voxel size f32.
        cutoff: (M,) f32 alpha below which a texel is a hole, 0..255, -1 = none.
        alphas: (T,) u8 alpha of the texels.
    """

    arrays: tuple[Any, ...]
    cutoff: np.ndarray
    alphas: np.ndarray

    @property
    def has_holes(self) -> bool:
        """Whether any material is an alpha mask."""
        return bool((self.cutoff >= 0).any())


def pack(scene: Scene, surface: SurfaceIndex) -> PackedScene:
    """Pack materials, textures, normals and the occlusion grid of `scene`; `surface` is its index."""
    levels: list[tuple[int, int, int]] = []
    texels: list[np.ndarray] = []
    mip_range, offset = [], 0
    for material in scene.materials:
        first = len(levels)
        for image in material.mips:
            height, width = image.shape[:2]
            levels.append((offset, width, height))
            texels.append(image)
            offset += width * height
        mip_range.append((first, len(levels)))
    cutoff = [-1.0 if m.alpha_cutoff is None or not m.mips else 255 * m.alpha_cutoff for m in scene.materials]
    grid, origin, inv_voxel = distance_grid(surface, scene.bounds_low, scene.bounds_high)
    colours, alphas = pack_texels(texels)
    arrays = (
        np.ascontiguousarray(scene.vertices, dtype=np.float32),
        np.ascontiguousarray(scene.faces, dtype=np.int32),
        np.ascontiguousarray(scene.face_material, dtype=np.int32),
        np.zeros((0, 3, 2), np.float32) if scene.uv is None else np.ascontiguousarray(scene.uv),
        corner_normals(scene.vertices, scene.faces),
        np.zeros((0, 3), np.uint8) if scene.vertex_colors is None else np.ascontiguousarray(scene.vertex_colors),
        np.array([m.base_color for m in scene.materials], dtype=np.float32),
        np.array(mip_range, dtype=np.int64),
        np.array(levels, dtype=np.int64).reshape(-1, 3),
        colours,
        LIGHTS, OCCLUSION, grid, origin, inv_voxel,
    )
    return PackedScene(arrays, np.array(cutoff, dtype=np.float32), alphas)


def pack_texels(images: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Texels of RGBA images (h, w, 4) uint8, row by row: colours (T,) int64 (see `kernels`), alphas (T,) uint8."""
    if not images:
        return np.zeros(1, np.int64), np.full(1, 255, np.uint8)
    flat = np.concatenate([image.reshape(-1, 4) for image in images])
    colours, alphas = np.empty(len(flat), np.int64), np.empty(len(flat), np.uint8)
    kernels_mesh.pack_texels(flat, colours, alphas)
    return colours, alphas


def distance_grid(
    surface: SurfaceIndex, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.float32]:
    """Distance to the nearest surface, float32 [X, Y, Z] m, at voxel centres; its origin and 1 / voxel size.

    The voxel is 12.5 cm, or more where that would exceed 400 000 cells.
    """
    extent = high - low
    voxel = max(0.125, float(np.cbrt(np.prod(extent) / _MAX_CELLS)))
    shape = np.maximum(np.ceil(extent / voxel).astype(int), 2)
    axes = [low[i] + (np.arange(shape[i]) + 0.5) * voxel for i in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = surface.distance(points).reshape(tuple(shape))
    return np.ascontiguousarray(grid), low.astype(np.float32), np.float32(1 / voxel)


def corner_normals(vertices: np.ndarray, faces: np.ndarray, crease_deg: float = CREASE_DEG) -> np.ndarray:
    """(F, 3, 3) int16 normals of face corners, unit length = 32767; creases sharper than `crease_deg` stay sharp."""
    area, normal, _ = face_areas(vertices, faces)
    span = max(float(np.ptp(vertices, axis=0).max()), 1e-9)
    cells = np.rint((vertices - vertices.min(axis=0)) / span * (2**21 - 1)).astype(np.int64)
    keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    unique, inverse = np.unique(keys, return_inverse=True)
    merged = inverse.reshape(-1)[faces]
    corners = np.argsort(merged.reshape(-1), kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(merged.reshape(-1), minlength=len(unique)))])
    out = np.zeros((len(faces), 3, 3), np.int16)
    kernels_mesh.crease_normals(
        np.ascontiguousarray(faces), starts, corners, merged, normal, area, float(np.cos(np.radians(crease_deg))), out
    )
    return out
