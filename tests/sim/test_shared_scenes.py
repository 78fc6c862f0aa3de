"""The real furnished scenes: they load by what their metadata says and by what their geometry says."""

import json

import numpy as np
import pytest

from active3d_pipe.geometry import se3
from active3d_pipe.sim import placement
from active3d_pipe.sim.config import CameraSettings, SceneSettings, SensorSettings
from active3d_pipe.sim.raycast import RaycastSimulator
from active3d_pipe.sim.scene import load_scene

NAMES = ["aws_bookstore", "aws_small_house", "greywhite_livingroom", "hotel_room", "white_livingroom"]


def load(folder, name):
    path = folder / name / "scene.glb"
    if not path.is_file():
        pytest.skip(f"no scene at {path}")
    return load_scene(SceneSettings(file=str(path))), json.loads(path.with_name("scene.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_geometry_alone_tells_axis_unit_and_a_start(shared_scenes, name):
    scene, document = load(shared_scenes, name)
    assert scene.name == name and len(scene.faces) <= document["triangles"]
    for axis in ("Y", "Z"):
        turned = scene.vertices @ placement.UP_AXES[axis]
        assert placement.find_up_axis(turned, scene.faces, prior="Y") == axis
        assert placement.find_unit_scale(scene.vertices * 1000, "") == 0.001
    from active3d_pipe.geometry.raycasting import SurfaceIndex

    surface = SurfaceIndex(scene.vertices, scene.faces)
    T, notes = placement.find_start_pose(surface, scene.bounds_low, scene.bounds_high, scene.floor_z, "scene")
    assert notes == ()
    assert surface.distance(T[None, :3, 3])[0] > 0.25


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_colour_is_anti_aliased(shared_scenes, name):
    scene, document = load(shared_scenes, name)
    view = document["preview_views"][0]
    T = se3.look_at(view["position"], view["look_at"])
    small, large = CameraSettings(width=150, height=85), CameraSettings(width=900, height=510)
    frame = RaycastSimulator(scene, small.camera(), SensorSettings()).render(T)
    fine = RaycastSimulator(scene, large.camera(), SensorSettings(edge_samples=0))
    hits = fine._primary(T)
    truth = fine._shade(T, hits, 1e-3)[0].reshape(85, 6, 150, 6, 3).mean(axis=(1, 3))
    # A quarter of the usual resolution, so all detail is four times finer against the pixels.
    assert 10 * np.log10(255**2 / np.mean((frame.rgb - truth) ** 2)) > 36
