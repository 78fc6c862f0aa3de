"""What every renderer must do. A backend's test module subclasses `SimulatorContract` and names the backend."""

import numpy as np
import pytest

from active3d_pipe.errors import Active3dError, InputError
from active3d_pipe.geometry import projection, se3
from active3d_pipe.sim.config import CameraSettings, SensorSettings
from active3d_pipe.sim.raycast import RaycastSimulator
from active3d_pipe.sim.simulator import open_simulator
from tests.sim.scenes import FURNITURE, ROOM

POSES = [
    se3.look_at([2.5, 2.0, 1.3], [4.5, 3.0, 0.6]),
    se3.look_at([0.6, 3.3, 1.9], [2.0, 1.0, 0.5]),
    se3.pose_from_yaw_pitch(np.array([2.6, 2.2, 1.1]), 2.4, 0.7),
]


def box_depth(camera, T) -> np.ndarray:
    """(H, W) exact depth of the generated room: ray against boxes, float64."""
    rays = projection.pixel_rays(camera).astype(np.float64) @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        inverse = 1 / rays
    best = np.full(rays.shape[:2], np.inf)
    for box in (ROOM, *FURNITURE):
        t0, t1 = ((np.array(side) - T[:3, 3]) * inverse for side in (box.low, box.high))
        near, far = np.minimum(t0, t1).max(axis=-1), np.maximum(t0, t1).min(axis=-1)
        t = far if box.inward else np.where((near <= far) & (near > 0), near, np.inf)
        best = np.minimum(best, t)
    return best


class SimulatorContract:
    backend = ""

    @pytest.fixture(scope="class")
    @classmethod
    def sim(cls, room_scene, small_camera):
        try:
            return open_simulator(room_scene, small_camera, SensorSettings(backend=cls.backend))
        except Active3dError as error:
            pytest.skip(str(error))

    @pytest.mark.parametrize("T", POSES)
    def test_depth_is_exact_at_pixel_centres(self, sim, T):
        expected = box_depth(sim.camera, T)
        depth = sim.depth(T)
        # A pixel centre within rounding of an edge may fall on either side of it.
        assert (np.abs(depth - expected) < 1e-3).mean() > 0.998
        frame = sim.render(T)
        assert (np.abs(frame.depth - expected) < 1e-3).mean() > 0.998

    def test_depth_steps_are_multiples_of_the_quantum(self, sim):
        depth = sim.render(POSES[0]).depth.astype(np.float64)
        assert (depth * 8192 == np.rint(depth * 8192)).all()

    def test_same_pose_same_bytes(self, sim):
        first = sim.render(POSES[1], step=3)
        sim.render(POSES[0])
        second = sim.render(POSES[1], step=3)
        assert first.rgb.tobytes() == second.rgb.tobytes()
        assert first.depth.tobytes() == second.depth.tobytes()

    def test_frame_carries_step_time_pose_and_camera(self, sim):
        frame = sim.render(POSES[2], step=7, stamp_ns=123)
        assert (frame.step, frame.stamp_ns) == (7, 123)
        assert frame.camera == sim.camera
        assert np.array_equal(frame.T_world_camera, POSES[2])

    def test_image_is_upright_and_not_mirrored(self, sim):
        # Looking along +x from the middle: +y is on the left, the floor below. The tall box fills the right.
        frame = sim.render(se3.look_at([3.0, 2.0, 1.3], [5.0, 2.0, 1.3]))
        assert np.median(frame.depth[:, -20:-10]) < np.median(frame.depth[10:40, 10:20])
        # The floor is 1.3 m below the camera and shows 39.5 px below the middle, the ceiling 1.3 m above it.
        assert frame.depth[-1, 60] == pytest.approx(1.3 * sim.camera.fy / 39.5, rel=1e-3)
        up = sim.render(se3.look_at([3.0, 2.0, 0.6], [5.0, 2.0, 0.6]))
        assert up.depth[-1, 60] == pytest.approx(0.6 * sim.camera.fy / 39.5, rel=1e-3)
        assert up.depth[0, 60] == pytest.approx(2.0, rel=1e-3)

    def test_base_colour_is_a_display_value(self, sim):
        # The box top of colour (51, 102, 153): shading changes brightness, never the ratio of the channels.
        frame = sim.render(se3.look_at([4.1, 3.1, 1.5], [4.1, 3.1, 0.5], up=(0, 1, 0)))
        r, g, b = frame.rgb[40, 60].astype(float)
        assert g / r == pytest.approx(2, abs=0.06) and b / r == pytest.approx(3, abs=0.09)
        assert 0.6 < g / 102 < 1.1

    def test_light_does_not_depend_on_the_view(self, sim):
        target = np.array([4.1, 3.1, 0.5])
        seen = []
        for position in ([3.4, 2.4, 1.4], [4.6, 2.5, 1.8], [3.9, 3.6, 2.2]):
            T = se3.look_at(position, target)
            uv, _ = projection.project(target, T, sim.camera)
            seen.append(sim.render(T).rgb[int(uv[1]), int(uv[0])].astype(int))
        assert np.ptp(seen, axis=0).max() <= 2

    def test_edges_are_anti_aliased(self, sim, room_scene, small_camera):
        # Reference: the ray caster's point samples on an 8 x 8 grid in every pixel, averaged.
        T = POSES[0]
        camera = CameraSettings(width=8 * small_camera.width, height=8 * small_camera.height)
        fine = RaycastSimulator(room_scene, camera.camera(), SensorSettings(edge_samples=0))
        shape = (small_camera.height, 8, small_camera.width, 8, 3)
        truth = fine.render(T).rgb.reshape(shape).astype(float).mean(axis=(1, 3))
        error = np.mean((sim.render(T).rgb - truth) ** 2)
        assert 10 * np.log10(255**2 / error) > 41

    def test_clearance(self, sim):
        points = np.array([[2.8, 2.0, 2.0], [0.3, 2.0, 1.0], [1.5, 1.3, 0.9]])
        assert sim.clearance(points) == pytest.approx([0.6, 0.3, 0.1], abs=1e-5)

    def test_segment_clearance_finds_the_narrowest_place(self, sim):
        # Passes 0.2 m over the edge of the box that ends at x = 2, z = 0.8.
        assert sim.segment_clearance([0.5, 1.3, 1.0], [3.0, 1.3, 1.0]) == pytest.approx(0.2, abs=1e-4)
        assert sim.segment_clearance([0.5, 1.3, 0.5], [3.0, 1.3, 0.5]) == 0
        assert sim.segment_clearance([2.8, 2, 2], [2.8, 2, 2]) == pytest.approx(0.6, abs=1e-5)

    def test_noise_depends_on_seed_and_step_alone(self, room_scene, small_camera):
        settings = SensorSettings(backend=self.backend, depth_noise_base_m=0.01, dropout=0.1)
        try:
            a, b = (open_simulator(room_scene, small_camera, settings, seed) for seed in (1, 2))
        except Active3dError as error:
            pytest.skip(str(error))
        first = a.render(POSES[0], step=5).depth
        a.render(POSES[1], step=6)
        assert np.array_equal(first, a.render(POSES[0], step=5).depth)
        assert not np.array_equal(first, a.render(POSES[0], step=6).depth)
        assert not np.array_equal(first, b.render(POSES[0], step=5).depth)

    def test_bad_pose(self, sim):
        with pytest.raises(InputError, match="finite 4x4"):
            sim.render(np.full((4, 4), np.nan))
