import numpy as np
import pytest

from active3d_pipe.errors import Active3dError
from active3d_pipe.geometry import se3
from active3d_pipe.sim.config import CameraSettings, SceneSettings, SensorSettings
from active3d_pipe.sim.raycast import RaycastSimulator, low_discrepancy_offsets
from active3d_pipe.sim.simulator import make_simulator, open_simulator
from tests.sim.contract import POSES, SimulatorContract


class TestRaycast(SimulatorContract):
    backend = "raycast"


class TestPyrender(SimulatorContract):
    backend = "pyrender"

    def test_agrees_with_the_ray_caster(self, sim, room_scene, small_camera):
        other = RaycastSimulator(room_scene, small_camera.camera(), SensorSettings())
        for T in POSES:
            a, b = sim.render(T), other.render(T)
            assert ((a.depth > 0) != (b.depth > 0)).mean() < 0.005
            assert np.median(np.abs(a.depth - b.depth)) < 0.002
            assert 10 * np.log10(255**2 / np.mean((a.rgb - b.rgb.astype(float)) ** 2)) > 36


@pytest.mark.parametrize("count", [1, 2, 5, 8, 10, 16])
def test_sample_pattern_hits_every_row_and_column_once(count):
    points = low_discrepancy_offsets(count)
    for axis in (0, 1):
        assert sorted(np.floor(points[:, axis] * count).astype(int)) == list(range(count))
    assert points.mean(axis=0) == pytest.approx([0.5, 0.5])


def test_make_simulator_from_settings(room_file):
    sim = make_simulator(SceneSettings(file=str(room_file)), CameraSettings(width=32, height=24), SensorSettings(), 3)
    assert sim.render(sim.scene.start_pose).rgb.shape == (24, 32, 3)


def test_supersampling_can_be_switched_off(room_scene, small_camera):
    sims = [open_simulator(room_scene, small_camera, SensorSettings(edge_samples=n)) for n in (0, 1, 10)]
    images = [sim.render(POSES[0]).rgb for sim in sims]
    assert not np.array_equal(images[0], images[2])
    assert np.array_equal(sims[0].depth(POSES[0]), sims[2].depth(POSES[0]))


def test_pyrender_without_a_context_says_so(room_scene, small_camera, monkeypatch):
    backend = pytest.importorskip("active3d_pipe.sim.pyrender_backend")

    class NoContext:
        def OffscreenRenderer(self, width, height):
            raise RuntimeError("no EGL device\nmore text")

    monkeypatch.setattr(backend, "import_pyrender", NoContext)
    backend._process_renderer.cache_clear()
    with pytest.raises(Active3dError, match=r"OpenGL context \(no EGL device\); install") as caught:
        open_simulator(room_scene, small_camera, SensorSettings(backend="pyrender"))
    assert "\n" not in str(caught.value)


def test_top_view_shows_the_furniture_and_not_the_ceiling(room_sim):
    image = room_sim.top_view(2.0, longest_side=100)
    assert image.shape == (80, 100, 3)
    # The box at x 3.6..4.6, y 2.6..3.6 is plain (51, 102, 153); +y is up in the picture.
    row, column = round(80 - (3.1 + 0.05) / 4.1 * 80), round((4.1 + 0.05) / 5.1 * 100)
    r, g, b = image[row, column].astype(float)
    assert g / r == pytest.approx(2, abs=0.1) and b / r == pytest.approx(3, abs=0.15)


def test_alpha_mask_lets_rays_pass(masked_scene, small_camera):
    # A screen whose left half is cut out stands before the wall x = 5.
    sim = RaycastSimulator(masked_scene, small_camera.camera(), SensorSettings())
    frame = sim.render(se3.look_at([1.0, 2.0, 1.0], [5.0, 2.0, 1.0]))
    left, right = frame.depth[40, 50], frame.depth[40, 70]
    assert (left, right) == (pytest.approx(4.0, abs=1e-3), pytest.approx(2.0, abs=1e-3))


def test_both_backends_see_the_same_through_an_alpha_mask(masked_scene, small_camera):
    try:
        sims = [open_simulator(masked_scene, small_camera, SensorSettings(backend=b)) for b in ("raycast", "pyrender")]
    except Active3dError as error:
        pytest.skip(str(error))
    T = se3.look_at([1.0, 1.5, 1.4], [5.0, 2.0, 1.0])
    a, b = (sim.depth(T) for sim in sims)
    assert (np.abs(a - b) < 2e-3).mean() > 0.995
