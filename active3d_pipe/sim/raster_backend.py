"""The fast renderer: scan conversion on the processor. No graphics driver, the same bytes on every run."""

from typing import Any

import numpy as np

from active3d_pipe.geometry import se3
from active3d_pipe.sim import kernels_raster
from active3d_pipe.sim.config import SensorSettings
from active3d_pipe.sim.patterns import low_discrepancy_offsets
from active3d_pipe.sim.rendering import Hits, SurfaceRenderer
from active3d_pipe.sim.scene import Scene
from active3d_pipe.structures import Camera


class RasterSimulator(SurfaceRenderer):
    """A `Simulator` on the kernels of `kernels_raster`: which face is seen where; the rest is as in the ray caster."""

    def __init__(self, scene: Scene, camera: Camera, settings: SensorSettings, seed: int = 0) -> None:
        super().__init__(scene, camera, settings, seed)
        self._offsets = low_discrepancy_offsets(settings.edge_samples)
        a = self._packed.arrays
        self._vertices, self._faces = a[0], a[1]
        self._masks = (a[2], self._packed.cutoff, a[3], a[7], a[8], self._packed.alphas)
        self._points = np.empty_like(self._vertices)
        count = len(self._faces)
        # Twice: as they are found, and from front to back.
        self._tables = [
            (np.empty(count, np.int32), np.empty((count, 4), np.int32), np.empty(count, np.float32)) for _ in range(2)
        ]
        self._counts = np.zeros(kernels_raster.CHUNKS, np.int64)
        self._lens = (camera.fx, camera.fy, camera.cx, camera.cy)

    def _project(self, T: np.ndarray) -> tuple[Any, ...]:
        """What the raster kernels know of the faces in view of a pose."""
        camera = self._camera
        kernels_raster.to_camera(self._vertices, se3.inverse(T), self._points)
        lens = tuple(np.float32(v) for v in self._lens)
        found = (*lens, camera.width, camera.height, *self._tables[0], self._counts)
        kernels_raster.visible_faces(self._points, self._faces, *found)
        tables = (*self._tables[0], self._counts, *self._tables[1])
        total = kernels_raster.front_to_back(self._faces, *tables)
        self._in_view = (self._points, self._faces, total, *self._tables[1], *self._lens, *self._masks)
        return self._in_view

    def _primary(self, T: np.ndarray) -> Hits:
        shape = (self._camera.height, self._camera.width)
        seen = np.empty(shape, np.uint32)
        arguments = (*self._project(T), np.empty(shape, np.float32), seen)
        kernels_raster.faces_at_centres(*arguments)
        return self._on_planes(self._rays(T, self._all_pixels, self._centres), seen.reshape(-1))

    def _samples(self, T: np.ndarray, pixels: np.ndarray, part: int) -> tuple[np.ndarray, np.ndarray]:
        # `_primary` has just projected the faces for this pose.
        height, width = self._camera.height, self._camera.width
        chosen = np.zeros(height * width + 1, np.int32)
        chosen[pixels + 1] = 1
        count = np.cumsum(chosen, dtype=np.int32)
        rows = np.lib.stride_tricks.as_strided(count, (height, width + 1), (width * count.itemsize, count.itemsize))
        before = np.ascontiguousarray(rows)  # of each row also the count at its end
        shape = (len(pixels), len(self._offsets))
        seen = np.empty(shape, np.uint32)
        columns, farthest = (pixels % width).astype(np.int32), np.empty(len(pixels), np.float32)
        wanted = (before, columns, self._offsets, np.empty(shape, np.float32), farthest, seen)
        kernels_raster.faces_at_samples(*self._in_view, *wanted)
        return seen, self._offsets
