"""Views of the SDF itself, for maps that have no Gaussians: first surface along every ray, and its colour."""

from typing import Protocol

import numpy as np

from active3d_pipe.field import kernels_trace
from active3d_pipe.geometry import projection
from active3d_pipe.geometry.lattice import LatticePoints, Points
from active3d_pipe.structures import Camera

SPACING_M = 0.05  # of the nodes on which the SDF is sampled for the search along rays
SLAB = 16  # planes of nodes that are asked at a time, which bounds the memory
POLISH = 3  # steps with the SDF itself that bring a found depth onto its zero level


class Surface(Protocol):
    """An SDF with colour over the box [low, high], world, m."""

    low: np.ndarray
    high: np.ndarray

    def query_sdf(self, points: Points) -> np.ndarray:
        """(N,) SDF, m, at world points (N, 3)."""

    def query_color(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) colour in 0..1 at world points (N, 3)."""


class SurfaceView:
    """Renders one state of a surface; the SDF is sampled once, on a grid, when it is made.

    Search along rays in the trilinear SDF of the grid, then a few steps with the surface's own SDF, then its colour.
    Surfaces much thinner than the grid's spacing are missed.
    """

    def __init__(self, surface: Surface) -> None:
        self._surface = surface
        nodes = np.maximum(np.ceil((surface.high - surface.low) / SPACING_M).astype(int) + 1, 2)
        axes = [surface.low[a] + np.float32(SPACING_M) * np.arange(nodes[a], dtype=np.float32) for a in range(3)]
        sdf = np.empty(tuple(nodes), np.float32)
        for i in range(0, nodes[0], SLAB):
            part = sdf[i : i + SLAB]
            points = LatticePoints((axes[0][i : i + SLAB], axes[1], axes[2]), np.arange(part.size))
            part[:] = surface.query_sdf(points).reshape(part.shape)
        self._sdf = sdf

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """rgb (H, W, 3) 0..1, depth (H, W) m along the optical axis, alpha (H, W) 1 on surface, else 0; float32."""
        T = np.asarray(T_world_camera, np.float32)
        R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
        depth = np.empty((camera.height, camera.width), np.float32)
        kernels_trace.trace(
            self._sdf, self._surface.low, np.float32(SPACING_M), R, t,
            np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32), np.float32(camera.near),
            np.float32(camera.far), depth,
        )
        hit = depth > 0
        rays = projection.pixel_rays(camera)[hit].astype(np.float32)
        directions, length = rays @ R.T, np.linalg.norm(rays, axis=1)
        z = depth[hit]
        for _ in range(POLISH):
            step = self._surface.query_sdf(t + z[:, None] * directions) / length
            z = z + np.clip(step, -SPACING_M, SPACING_M).astype(np.float32)
        depth[hit] = np.maximum(z, camera.near)
        rgb = np.zeros((*depth.shape, 3), np.float32)
        if hit.any():
            rgb[hit] = np.clip(self._surface.query_color(t + z[:, None] * directions), 0, 1)
        return rgb, depth, hit.astype(np.float32)
