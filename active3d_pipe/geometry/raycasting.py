"""Rays and distances against a triangle mesh, by Open3D's RaycastingScene (Embree)."""

import ctypes
import sys
from types import ModuleType
from typing import Any

import numpy as np

from active3d_pipe.errors import Active3dError

NO_HIT = 0xFFFFFFFF
"""Face index of a ray that meets nothing."""


def import_open3d() -> ModuleType:
    """Import Open3D, also where the system has no libusb.

    Open3D's Linux wheel is linked against libusb-1.0, which many machines lack; the `libusb-package` wheel brings
    that library, and loading it with global symbols before the import satisfies the linker.

    Raises:
        Active3dError: Open3D cannot be imported even so.
    """
    if "open3d" in sys.modules:
        return sys.modules["open3d"]
    if sys.platform == "linux":
        _load_libusb()
    try:
        import open3d
    except ImportError as error:
        raise Active3dError(f"open3d cannot be imported ({error}); install open3d-cpu and libusb-package") from error
    return open3d


def _load_libusb() -> None:
    try:
        ctypes.CDLL("libusb-1.0.so.0", ctypes.RTLD_GLOBAL)
        return
    except OSError:
        pass
    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        # Open3D's own import error, raised next, names what is missing.
        return


class SurfaceIndex:
    """A static triangle mesh that answers ray and distance queries; both sides of a face are hit."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Build the index of `vertices` (V, 3) float, m, and `faces` (F, 3) int."""
        o3d = import_open3d()
        self._core = o3d.core
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._core.Tensor(np.ascontiguousarray(vertices, dtype=np.float32)),
            self._core.Tensor(np.ascontiguousarray(faces, dtype=np.uint32)),
        )

    def _tensor(self, array: np.ndarray) -> Any:
        return self._core.Tensor.from_numpy(np.ascontiguousarray(array, dtype=np.float32))

    def cast(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First intersections of `rays` (N, 6) = origin and direction (of any length).

        Returns:
            t (N,) float32 in units of the direction's length (inf = no hit), face (N,) uint32 (`NO_HIT` = none),
            barycentric coordinates (N, 2) float32 of the face's second and third vertex.
        """
        answer = self._scene.cast_rays(self._tensor(rays))
        return answer["t_hit"].numpy(), answer["primitive_ids"].numpy(), answer["primitive_uvs"].numpy()

    def occluded(self, start: np.ndarray, end: np.ndarray, tolerance_m: float = 0.0) -> np.ndarray:
        """(N,) bool, whether a surface lies between points `start` and `end` (N, 3).

        The last `tolerance_m` before `end` do not count, so that an end on a surface does not hide itself.
        """
        start, end = np.broadcast_arrays(np.asarray(start, np.float32), np.asarray(end, np.float32))
        delta = end - start
        length = np.linalg.norm(delta, axis=-1, keepdims=True)
        direction = delta / np.maximum(length, 1e-9)
        rays = np.concatenate([start, direction], axis=-1).astype(np.float32)
        return self.cast(rays)[0] < length[:, 0] - tolerance_m

    def distance(self, points: np.ndarray) -> np.ndarray:
        """(N,) float32 unsigned distance, m, of points (N, 3) to the nearest surface."""
        if len(points) == 0:
            return np.zeros(0, np.float32)
        return self._scene.compute_distance(self._tensor(points)).numpy()
