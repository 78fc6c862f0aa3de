from pathlib import Path

import pytest

from active3d_pipe.sim.config import CameraSettings, SceneSettings, SensorSettings
from active3d_pipe.sim.scene import Scene, load_scene
from tests.sim.scenes import ROOM, Room, write_glb


@pytest.fixture(scope="session")
def room_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_glb(tmp_path_factory.mktemp("room") / "room.glb", Room())


@pytest.fixture(scope="session")
def room_scene(room_file: Path) -> Scene:
    return load_scene(SceneSettings(file=str(room_file)))


@pytest.fixture(scope="session")
def small_camera() -> CameraSettings:
    return CameraSettings(width=120, height=80)


@pytest.fixture(scope="session")
def room_sim(room_scene: Scene, small_camera: CameraSettings):
    from active3d_pipe.sim.raycast import RaycastSimulator

    return RaycastSimulator(room_scene, small_camera.camera(), SensorSettings())


@pytest.fixture(scope="session")
def masked_scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The room without furniture and a screen at x = 3 whose half y > 2 (left, seen along +x) is a hole."""
    import numpy as np
    import trimesh
    from PIL import Image

    path = write_glb(tmp_path_factory.mktemp("masked") / "masked.glb", Room(boxes=[ROOM]))
    scene = trimesh.load_scene(str(path), process=False)
    alpha = np.full((32, 32, 4), 255, np.uint8)
    alpha[:, :16, 3] = 0
    material = trimesh.visual.material.PBRMaterial(
        name="screen", baseColorTexture=Image.fromarray(alpha), alphaMode="MASK", alphaCutoff=0.5
    )
    corners = np.array([[3, 3.5, 0.2], [3, 0.5, 0.2], [3, 0.5, 1.8], [3, 3.5, 1.8]])
    visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    scene.add_geometry(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False))
    path.write_bytes(scene.export(file_type="glb"))
    return load_scene(SceneSettings(file=str(path), up_axis="Z", start_position=(1.0, 2.0, 1.0)))
