"""Pinhole projection and its inverse (OpenCV optical frame, pixel centres at +0.5)."""

import numpy as np

from active3d_pipe.geometry import se3
from active3d_pipe.structures import Camera


def pixel_rays(camera: Camera) -> np.ndarray:
    """(H, W, 3) float32 directions in the camera frame with z = 1, through pixel centres."""
    u = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    v = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    x, y = np.meshgrid(u, v)
    return np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float32)


def project(points_world: np.ndarray, T_world_camera: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """World points (..., 3) to pixel coordinates (..., 2) and depth z (...), m; z <= 0 is behind."""
    p = se3.transform_points(se3.inverse(T_world_camera), points_world)
    z = p[..., 2]
    safe = np.where(np.abs(z) < 1e-9, 1e-9, z)
    uv = np.stack([camera.fx * p[..., 0] / safe + camera.cx, camera.fy * p[..., 1] / safe + camera.cy], axis=-1)
    return uv, z


def unproject(depth: np.ndarray, T_world_camera: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W, 3) float32 world points of a z-depth image (H, W); pixels with depth 0 give the camera centre."""
    points_camera = pixel_rays(camera) * depth[..., None]
    return se3.transform_points(T_world_camera, points_camera).astype(np.float32)


def in_image(uv: np.ndarray, z: np.ndarray, camera: Camera) -> np.ndarray:
    """(...) bool, whether projected points fall on the image in front of the camera."""
    u, v = uv[..., 0], uv[..., 1]
    return (z > camera.near) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
