"""Renders of a coloured mesh by ray casting: what a viewer shows of it, without light."""

import numpy as np

from active3d_pipe.geometry import projection
from active3d_pipe.geometry.raycasting import NO_HIT, SurfaceIndex
from active3d_pipe.structures import Camera, TriangleMesh


class MeshRenderer:
    """Ray caster of one mesh with vertex colours, `samples` x `samples` rays a pixel."""

    def __init__(self, mesh: TriangleMesh, samples: int = 2) -> None:
        self.mesh, self.samples = mesh, samples
        self.colors = mesh.colors.astype(np.float32) / 255
        self.index = SurfaceIndex(mesh.vertices, mesh.faces)

    def __call__(self, camera: Camera, T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """rgb (H, W, 3) 0..1, z-depth (H, W) m with 0 = nothing, alpha (H, W)."""
        n = self.samples
        fine = Camera(
            camera.width * n, camera.height * n, camera.fx * n, camera.fy * n, camera.cx * n, camera.cy * n,
            camera.near, camera.far,
        )
        directions = projection.pixel_rays(fine).reshape(-1, 3) @ T[:3, :3].T
        origins = np.broadcast_to(T[:3, 3], directions.shape)
        # The rays have z = 1 in the camera frame, so the ray parameter is the z-depth.
        t, face, uv = self.index.cast(np.concatenate([origins, directions], axis=1).astype(np.float32))
        hit = face != NO_HIT
        corners = self.colors[self.mesh.faces[face[hit]]]
        u, v = uv[hit, :1], uv[hit, 1:]
        rgb = np.zeros((len(t), 3), np.float32)
        rgb[hit] = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        shape = (camera.height, n, camera.width, n)
        depth = np.where(hit, t, 0).reshape(shape)[:, n // 2, :, n // 2]
        rgb, alpha = rgb.reshape(*shape, 3).mean((1, 3)), hit.reshape(shape).mean((1, 3), dtype=np.float32)
        return rgb / np.maximum(alpha, 1e-6)[..., None], depth.astype(np.float32), alpha
