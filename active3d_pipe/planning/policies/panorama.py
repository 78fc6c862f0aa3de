"""The Gaussians seen in every direction from one place: six square images, and an equirectangular one made of them."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from active3d_pipe.planning.policies.context import MapView
from active3d_pipe.structures import Camera

# Rotations R_world_camera of the faces: four around, one down, one up. Columns: right, down, forward.
_FORWARD = np.array([(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (0, 0, -1), (0, 0, 1)], dtype=np.float64)
_DOWN = np.array([(0, 0, -1)] * 4 + [(-1, 0, 0), (1, 0, 0)], dtype=np.float64)
FACES = np.stack([np.cross(_DOWN, _FORWARD), _DOWN, _FORWARD], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Panorama:
    """Equirectangular images (H, W), rows from the zenith down, columns by azimuth from -pi.

    Attributes:
        alpha: rendered opacity. distance_m: along the ray, 0 where nothing is rendered (alpha < 0.5).
        rays: (H, W, 3) unit directions, world. solid_angle: (H, W) sr.
    """

    alpha: np.ndarray
    distance_m: np.ndarray
    rays: np.ndarray
    solid_angle: np.ndarray


def sphere_rays(degrees_per_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Directions (H, W, 3) and solid angles (H, W) of an equirectangular image."""
    rows, columns = round(180 / degrees_per_px), round(360 / degrees_per_px)
    edges = np.linspace(np.pi / 2, -np.pi / 2, rows + 1)
    elevation = 0.5 * (edges[1:] + edges[:-1])
    azimuth = (np.arange(columns) + 0.5) * (2 * np.pi / columns) - np.pi
    el, az = np.meshgrid(elevation, azimuth, indexing="ij")
    rays = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], axis=-1)
    band = (np.sin(edges[:-1]) - np.sin(edges[1:])) * (2 * np.pi / columns)
    return rays, np.repeat(band[:, None], columns, axis=1)


def panorama(view: MapView, position: np.ndarray, degrees_per_px: float, camera: Camera) -> Panorama:
    """Render the map around a position; `camera` gives near and far."""
    rays, solid_angle = sphere_rays(degrees_per_px)
    size = max(8, round(90 / degrees_per_px))
    face_camera = Camera.from_fov(size, size, 90.0, near=camera.near, far=camera.far)
    alpha, distance = np.zeros(rays.shape[:2], np.float32), np.zeros(rays.shape[:2], np.float32)
    owner = np.argmax(rays @ _FORWARD.T, axis=-1)
    T = np.eye(4)
    T[:3, 3] = position
    for f, R in enumerate(FACES):
        T[:3, :3] = R
        image = view.render(face_camera, T)
        mine = owner == f
        local = rays[mine] @ R
        u = np.clip((local[:, 0] / local[:, 2] * face_camera.fx + face_camera.cx).astype(int), 0, size - 1)
        v = np.clip((local[:, 1] / local[:, 2] * face_camera.fy + face_camera.cy).astype(int), 0, size - 1)
        alpha[mine] = image.alpha[v, u]
        distance[mine] = image.depth[v, u] / local[:, 2]
    return Panorama(alpha, distance, rays, solid_angle)


def members(rays: np.ndarray, rotations: np.ndarray, camera: Camera) -> np.ndarray:
    """(V, M) float32, 1 where a ray of (M, 3) lies in the image of a camera with rotation (V, 3, 3)."""
    local = np.einsum("mi,vij->vmj", rays, rotations)
    z = np.maximum(local[..., 2], 1e-9)
    u, v = camera.fx * local[..., 0] / z + camera.cx, camera.fy * local[..., 1] / z + camera.cy
    inside = (local[..., 2] > 1e-6) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return inside.astype(np.float32)


def pixel_clusters(mask: np.ndarray, radius_px: float, least: int) -> tuple[np.ndarray, int]:
    """DBSCAN on the pixels of an equirectangular mask: labels (H, W) int (0 = none) and how many there are.

    A pixel is a core pixel when at least `least` masked pixels lie within `radius_px`; core pixels within the radius
    of each other belong together. Columns wrap around.
    """
    r = max(1, int(np.ceil(radius_px)))
    yy, xx = np.mgrid[-r : r + 1, -r : r + 1]
    disk = xx * xx + yy * yy <= max(radius_px, 1.0) ** 2
    wide = np.pad(mask, ((0, 0), (r, r)), mode="wrap")
    count = ndimage.convolve(wide.astype(np.int32), disk.astype(np.int32), mode="constant")[:, r:-r]
    core = mask & (count >= least)
    half = disk if r == 1 else xx * xx + yy * yy <= (radius_px / 2) ** 2
    grown = ndimage.binary_dilation(np.pad(core, ((0, 0), (r, r)), mode="wrap"), half)[:, r:-r]
    labels, _n = ndimage.label(grown, np.ones((3, 3)))
    # Columns wrap: what touches both borders is one.
    for row in range(mask.shape[0]):
        a, b = labels[row, 0], labels[row, -1]
        if a and b and a != b:
            labels[labels == b] = a
    labels = np.where(core, labels, 0)
    names, compact = np.unique(labels, return_inverse=True)
    compact = compact.reshape(labels.shape) + (0 if names[0] == 0 else 1)
    return compact, int(compact.max())
