"""The default renderer: Open3D ray casting. No graphics driver, the same bytes on every run."""

import numpy as np

from active3d_pipe.sim.config import SensorSettings
from active3d_pipe.sim.patterns import low_discrepancy_offsets
from active3d_pipe.sim.rendering import Hits, SurfaceRenderer
from active3d_pipe.sim.scene import Scene
from active3d_pipe.structures import Camera

_MAX_LAYERS = 32  # alpha-masked surfaces that a ray may pass
_STEP_BEYOND = 1e-4  # share of t by which a ray restarts behind a hole


class RaycastSimulator(SurfaceRenderer):
    """A `Simulator` on Open3D's RaycastingScene."""

    def __init__(self, scene: Scene, camera: Camera, settings: SensorSettings, seed: int = 0) -> None:
        super().__init__(scene, camera, settings, seed)
        pattern = low_discrepancy_offsets(settings.edge_samples)
        self._offsets = (pattern[0::2], pattern[1::2])
        self._parts = 2 if settings.edge_samples > 1 else 1

    def _primary(self, T: np.ndarray) -> Hits:
        return self._cast(self._rays(T, self._all_pixels, self._centres))

    def _samples(self, T: np.ndarray, pixels: np.ndarray, part: int) -> tuple[np.ndarray, np.ndarray]:
        offsets = self._offsets[part]
        return self._cast(self._rays(T, pixels, offsets)).face.reshape(len(pixels), -1), offsets

    def top_view(self, cut_z: float, longest_side: int = 900) -> np.ndarray:
        """(H, W, 3) uint8 picture of the bounds from far above, +y upwards, without what lies over z = `cut_z`."""
        low, high = self._scene.bounds_low, self._scene.bounds_high
        extent, centre = high[:2] - low[:2], 0.5 * (low + high)
        scale = longest_side / float(extent.max())
        width, height = (max(round(float(e) * scale), 1) for e in extent)
        distance = 40.0 * float(extent.max())  # so far away that the perspective is nearly parallel
        camera = Camera(width, height, scale * distance, scale * distance, width / 2, height / 2, 0.0, 2 * distance)
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, 3] = [centre[0], centre[1], cut_z + distance]
        offsets = low_discrepancy_offsets(5)
        rays = self._rays(T, np.arange(width * height), offsets, camera)
        below = rays.copy()
        below[:, :3] += np.float32(distance) * below[:, 3:]
        hits = self._cast(below)
        hits.rays, hits.t = rays, hits.t + np.float32(distance)
        rgb, _ = self._shade(T, hits, 1 / np.sqrt(len(offsets)), camera=camera)
        return np.rint(rgb.reshape(height, width, len(offsets), 3).mean(axis=2)).astype(np.uint8)

    def _cast(self, rays: np.ndarray) -> Hits:
        """First hits of rays that is not a hole."""
        hits = Hits(rays, *self.surface.cast(rays))
        if not self._packed.has_holes:
            return hits
        todo = np.flatnonzero(self._holes(hits))
        for _ in range(_MAX_LAYERS):
            if len(todo) == 0:
                break
            skipped = hits.t[todo] * (1 + _STEP_BEYOND) + 1e-5
            onward = rays[todo].copy()
            onward[:, :3] += skipped[:, None] * onward[:, 3:]
            more = Hits(rays[todo], *self.surface.cast(onward))
            hits.t[todo], hits.face[todo], hits.bary[todo] = more.t + skipped, more.face, more.bary
            todo = todo[self._holes(more)]
        return hits
