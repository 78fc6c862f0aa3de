"""One posed RGB-D observation S_k = [I_k, D_k, T, K]."""

from dataclasses import dataclass

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.structures.camera import Camera


def check_pose(T: np.ndarray, what: str) -> np.ndarray:
    """Return `T` as a (4, 4) float64 rigid transform, or raise InputError that names `what`."""
    T = np.asarray(T, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"{what}: expected a finite 4x4 transform, got shape {T.shape}")
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-4) or np.linalg.det(R) < 0:
        raise InputError(f"{what}: the upper-left 3x3 block is not a rotation")
    return T


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One captured frame.

    Attributes:
        step: exploration step at which it was captured, counted from 0 over the whole run.
        stamp_ns: simulated time, ns.
        camera: intrinsics.
        T_world_camera: (4, 4) float64, camera (OpenCV optical) to world (Z up, m).
        rgb: (H, W, 3) uint8, display values.
        depth: (H, W) float32, m along the optical axis, 0 = no return.
    """

    step: int
    stamp_ns: int
    camera: Camera
    T_world_camera: np.ndarray
    rgb: np.ndarray
    depth: np.ndarray

    def __post_init__(self) -> None:
        check_pose(self.T_world_camera, f"frame {self.step}")
        shape = (self.camera.height, self.camera.width)
        if self.rgb.shape != (*shape, 3) or self.rgb.dtype != np.uint8:
            got = f"{self.rgb.shape} {self.rgb.dtype}"
            raise InputError(f"frame {self.step}: rgb is {got}, expected {(*shape, 3)} uint8")
        if self.depth.shape != shape or self.depth.dtype != np.float32:
            got = f"{self.depth.shape} {self.depth.dtype}"
            raise InputError(f"frame {self.step}: depth is {got}, expected {shape} float32")
