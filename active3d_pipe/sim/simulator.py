"""What a simulator is, and how one is made."""

from typing import Protocol

import numpy as np

from active3d_pipe.errors import ConfigError
from active3d_pipe.geometry.raycasting import SurfaceIndex
from active3d_pipe.sim.config import CameraSettings, SceneSettings, SensorSettings
from active3d_pipe.sim.scene import Scene, load_scene
from active3d_pipe.structures import Camera, Frame


class Simulator(Protocol):
    """A world that can be looked at. Ground truth: only capture and evaluation may ask it."""

    @property
    def scene(self) -> Scene:
        """The scene."""

    @property
    def camera(self) -> Camera:
        """Intrinsics of every frame."""

    @property
    def surface(self) -> SurfaceIndex:
        """Ray and distance queries on the true surface."""

    def render(self, T_world_camera: np.ndarray, *, step: int = 0, stamp_ns: int = 0) -> Frame:
        """The frame that the agent's camera takes at a pose: anti-aliased colour, sensor depth at pixel centres.

        The same seed, step and pose give the same bytes. Raises InputError when the pose is no rigid transform.
        """

    def depth(self, T_world_camera: np.ndarray) -> np.ndarray:
        """(H, W) float32 true depth along the optical axis at pixel centres, m; 0 = no surface within near..far."""

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """(N,) float32 distance, m, of world points (N, 3) to the true surface."""

    def segment_clearance(self, a: np.ndarray, b: np.ndarray) -> float:
        """Smallest distance, m, from the straight segment a-b (world points) to the true surface; 0 = it crosses."""


def make_simulator(
    scene_settings: SceneSettings, camera_settings: CameraSettings, sensor_settings: SensorSettings, seed: int = 0
) -> Simulator:
    """Load the scene and open the renderer that `sensor_settings.backend` names.

    Raises:
        InputError: the scene cannot be used.
        Active3dError: the renderer is not available on this machine.
    """
    return open_simulator(load_scene(scene_settings), camera_settings, sensor_settings, seed)


def open_simulator(
    scene: Scene, camera_settings: CameraSettings, sensor_settings: SensorSettings, seed: int = 0
) -> Simulator:
    """`make_simulator` for a scene that is already loaded."""
    camera = camera_settings.camera()
    if sensor_settings.backend == "raster":
        from active3d_pipe.sim.raster_backend import RasterSimulator

        return RasterSimulator(scene, camera, sensor_settings, seed)
    if sensor_settings.backend == "raycast":
        from active3d_pipe.sim.raycast import RaycastSimulator

        return RaycastSimulator(scene, camera, sensor_settings, seed)
    if sensor_settings.backend == "pyrender":
        from active3d_pipe.sim.pyrender_backend import PyrenderSimulator

        return PyrenderSimulator(scene, camera, sensor_settings, seed)
    raise ConfigError(f"sensor.backend is {sensor_settings.backend!r}; expected raster, raycast or pyrender")
