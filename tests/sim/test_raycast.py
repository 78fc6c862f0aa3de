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


class TestRaster(SimulatorContract):
    backend = "raster"

    def test_agrees_with_the_ray_caster(self, sim, room_scene, small_camera):
        other = RaycastSimulator(room_scene, small_camera.camera(), SensorSettings())
        for T in POSES:
            a, b = sim.render(T), other.render(T)
            assert ((a.depth > 0) != (b.depth > 0)).mean() < 0.0005
            assert (np.abs(a.depth - b.depth) < 2e-4).mean() > 0.999
            assert 10 * np.log10(255**2 / np.mean((a.rgb - b.rgb.astype(float)) ** 2)) > 40


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


def test_raster_sees_through_an_alpha_mask_what_the_ray_caster_sees(masked_scene, small_camera):
    sims = [open_simulator(masked_scene, small_camera, SensorSettings(backend=b)) for b in ("raycast", "raster")]
    T = se3.look_at([1.0, 1.5, 1.4], [5.0, 2.0, 1.0])
    a, b = (sim.depth(T) for sim in sims)
    assert (np.abs(a - b) < 1e-3).mean() > 0.998
    a, b = (sim.render(T).rgb.astype(float) for sim in sims)
    assert 10 * np.log10(255**2 / np.mean((a - b) ** 2)) > 36


def test_raster_finds_the_faces_of_small_and_large_triangles_behind_and_before_the_camera(small_camera):
    # Random triangles all round the camera, some through its plane: the ray caster is the twin.
    from active3d_pipe.geometry.raycasting import SurfaceIndex
    from active3d_pipe.sim import kernels_raster

    rng = np.random.default_rng(5)
    size = np.repeat([0.02, 0.2, 3.0], [700, 494, 6])[:, None, None]
    vertices = (rng.uniform(-4, 4, (1200, 1, 3)) + size * rng.normal(size=(1200, 3, 3))).reshape(-1, 3)
    vertices, faces = vertices.astype(np.float32), np.arange(3600, dtype=np.int32).reshape(-1, 3)
    camera = small_camera.camera()
    tables = [(np.empty(1200, np.int32), np.empty((1200, 4), np.int32), np.empty(1200, np.float32)) for _ in range(2)]
    counts = np.zeros(kernels_raster.CHUNKS, np.int64)
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    kernels_raster.visible_faces(vertices, faces, *lens, camera.width, camera.height, *tables[0], counts)
    total = kernels_raster.front_to_back(faces, *tables[0], counts, *tables[1])
    plain = (np.zeros(1200, np.int32), np.full(1, -1, np.float32), np.zeros((0, 3, 2), np.float32),
             np.zeros((1, 2), np.int64), np.zeros((0, 3), np.int64), np.zeros(1, np.uint8))
    seen, nearness = np.empty((80, 120), np.uint32), np.empty((80, 120), np.float32)
    kernels_raster.faces_at_centres(vertices, faces, total, *tables[1], *lens, *plain, nearness, seen)
    j, i = np.meshgrid(np.arange(120) + 0.5, np.arange(80) + 0.5)
    direction = np.stack([(j - camera.cx) / camera.fx, (i - camera.cy) / camera.fy, np.ones_like(j)], axis=-1)
    rays = np.concatenate([np.zeros((80 * 120, 3)), direction.reshape(-1, 3)], axis=1).astype(np.float32)
    t, face, _ = SurfaceIndex(vertices, faces).cast(rays)
    assert len(np.unique(face)) > 50
    same = seen.reshape(-1) == face
    assert same.mean() > 0.999
    hit = same & np.isfinite(t)
    assert 1 / nearness.reshape(-1)[hit] == pytest.approx(t[hit], rel=1e-4)
    before = np.arange(80 * 120 + 80).reshape(80, 121) - np.arange(80)[:, None]
    samples, columns = np.array([[0.5, 0.5], [0.1, 0.9]]), np.tile(np.arange(120, dtype=np.int32), 80)
    seen2, nearness2 = np.empty((80 * 120, 2), np.uint32), np.empty((80 * 120, 2), np.float32)
    kernels_raster.faces_at_samples(vertices, faces, total, *tables[1], *lens, *plain, before.astype(np.int32),
                                    columns, samples, nearness2, np.empty(80 * 120, np.float32), seen2)
    assert (seen2[:, 0] == face).mean() > 0.999
    rays[:, 3] += (0.1 - 0.5) / camera.fx
    rays[:, 4] += (0.9 - 0.5) / camera.fy
    assert (seen2[:, 1] == SurfaceIndex(vertices, faces).cast(rays)[1]).mean() > 0.999


def test_both_backends_see_the_same_through_an_alpha_mask(masked_scene, small_camera):
    try:
        sims = [open_simulator(masked_scene, small_camera, SensorSettings(backend=b)) for b in ("raycast", "pyrender")]
    except Active3dError as error:
        pytest.skip(str(error))
    T = se3.look_at([1.0, 1.5, 1.4], [5.0, 2.0, 1.0])
    a, b = (sim.depth(T) for sim in sims)
    assert (np.abs(a - b) < 2e-3).mean() > 0.995
