import numpy as np
import pytest

from active3d_pipe.errors import InputError
from active3d_pipe.sim import observable
from active3d_pipe.sim.check import check_scene
from active3d_pipe.sim.config import CameraSettings, SceneSettings, SensorSettings
from active3d_pipe.sim.raycast import RaycastSimulator
from active3d_pipe.sim.scene import load_scene
from stages.evaluation import _true_view
from tests.sim.scenes import FURNITURE, ROOM, Box, Room, write_glb

CLOSET = Box((0.2, 3.0, 0), (1.0, 3.8, 2.0))  # closed on all sides: its inside cannot be seen


@pytest.fixture(scope="module")
def sim(tmp_path_factory):
    """The room, with a wall at x = 5 behind which a second room lies that no door leads to."""
    boxes = [ROOM, *FURNITURE, CLOSET, Box((5.2, 0, 0), (8, 4, 2.6), inward=True)]
    path = write_glb(tmp_path_factory.mktemp("two") / "two.glb", Room(boxes=boxes))
    settings = SceneSettings(file=str(path), up_axis="Z", start_position=(2.5, 2.0, 1.3))
    return RaycastSimulator(load_scene(settings), CameraSettings(width=60, height=40).camera(), SensorSettings())


@pytest.fixture(scope="module")
def space(sim):
    return observable.reachable_space(sim, 0.2, 0.1)


def test_reachable_space_stays_in_the_room_of_the_start(sim, space):
    centres = space.grid.centres()[space.reachable]
    assert (centres > 0.2).all() and (centres < np.array([4.8, 3.8, 2.4]) + 1e-6).all()
    assert (sim.clearance(centres) > 0.2).all()
    # Volume by sampling: the room less what is within 0.2 m of a surface. Voxel centres fall on the limits here, so
    # each side may lose half a voxel: 2 % in x, 3 % in y, 5 % in z.
    points = np.random.default_rng(0).uniform([0, 0, 0], [5, 4, 2.6], (20000, 3))
    expected = (sim.clearance(points) > 0.2).mean() * 5 * 4 * 2.6
    inside_closet = 0.4 * 0.4 * 1.6  # clear, but closed
    assert space.volume_m3 == pytest.approx(expected - inside_closet, rel=0.10)


def test_a_robot_on_the_ground_reaches_one_height_and_sees_less(sim, space):
    flat = observable.reachable_space(sim, 0.2, 0.1, planar=True)
    layers = np.flatnonzero(flat.reachable.any(axis=(0, 1)))
    assert layers.tolist() == [int(flat.grid.index_of(sim.scene.start_pose[:3, 3])[2])]
    assert (space.reachable | ~flat.reachable).all()


def test_a_sphere_that_fits_nowhere(sim):
    with pytest.raises(InputError, match="no free space"):
        observable.reachable_space(sim, 2.0)


def test_free_positions_are_uniform_and_clear(sim, space):
    points = observable.free_positions(sim, 400, 0.3, np.random.default_rng(0), space)
    assert points.shape == (400, 3)
    assert (sim.clearance(points) >= 0.3).all()
    # Compared with rejection sampling of the whole box: the same mean within three standard errors.
    other = np.random.default_rng(1).uniform([0, 0, 0], [5, 4, 2.6], (20000, 3))
    in_closet = ((other > CLOSET.low) & (other < CLOSET.high)).all(axis=1)
    other = other[(sim.clearance(other) >= 0.3) & ~in_closet]
    assert points.mean(axis=0) == pytest.approx(other.mean(axis=0), abs=3 * other.std() / 20)
    again = observable.free_positions(sim, 400, 0.3, np.random.default_rng(0), space)
    assert np.array_equal(points, again)
    with pytest.raises(InputError, match="found no"):
        observable.free_positions(sim, 1, 1.4, np.random.default_rng(0), space)


def test_held_out_poses(sim, space):
    poses = observable.held_out_poses(sim, 60, "two rooms", space=space)
    assert poses.shape == (60, 4, 4)
    assert (sim.clearance(poses[:, :3, 3]) >= 0.3).all()
    forward = poses[:, :3, 2]
    assert np.abs(forward.mean(axis=0)).max() < 3 / np.sqrt(3 * 60)
    assert (np.abs(poses[:, 2, 0]) < 1e-9).all()  # level
    assert np.array_equal(poses, observable.held_out_poses(sim, 60, "two rooms", space=space))
    assert not np.array_equal(poses, observable.held_out_poses(sim, 60, "another", space=space))
    assert observable.held_out_poses(sim, 0, "two rooms", space=space).shape == (0, 4, 4)


def test_held_out_poses_refuse_views_without_depth(sim, space):
    blind = RaycastSimulator(
        sim.scene, CameraSettings(width=60, height=40, far=0.2, near=0.1).camera(), SensorSettings()
    )
    with pytest.raises(InputError, match="held-out views"):
        observable.held_out_poses(blind, 5, "x", space=space)


def test_observable_points(sim, space):
    walls = [[0, 2, 1.3], [2.5, 0, 1.0], [2.5, 2, 0], [2.5, 2, 2.6], [1.5, 1.3, 0.8]]
    hidden = [
        [0.3, 3.5, 0.0],  # floor inside the closet
        [8, 2, 1.3],  # the far wall of the other room
        [1.5, 1.3, 0.0],  # under a box that stands on the floor
    ]
    rng = np.random.default_rng(0)
    seen = observable.observable_points(sim, np.array(walls + hidden), rng, space=space)
    assert seen.tolist() == [True] * len(walls) + [False] * len(hidden)
    # Behind the low box at x = 3.6..4.6 the wall is seen only from above it.
    assert observable.observable_points(sim, np.array([[4.99, 3.1, 0.05]]), rng, space=space).tolist() == [True]


def test_observable_points_respect_the_range(sim, space):
    points = np.array([[0, 2, 1.3], [2.5, 2, 0.0]])
    rng = np.random.default_rng(0)
    assert observable.observable_points(sim, points, rng, space=space, max_range_m=0.1).tolist() == [False, False]
    assert observable.observable_points(sim, np.zeros((0, 3)), rng, space=space).shape == (0,)


def test_scene_check(room_file):
    found = check_scene(SceneSettings(file=str(room_file)), CameraSettings(width=60, height=40))
    summary = found.summary
    assert summary["up_axis"] == "Z" and summary["unit_scale"] == 1
    assert summary["triangles"] == 48 and summary["textured_materials"] == 1
    assert summary["extent_m"] == pytest.approx([5.1, 4.1, 2.7])
    assert summary["floor_area_m2"] == pytest.approx(20, abs=1.0)
    assert 8 < summary["reachable_floor_area_m2"] < 17
    assert summary["open_share"] == 0 and summary["warnings"] == []
    assert set(found.pictures) == {"start", "start_left", "start_back", "start_right", "top"}
    assert all(p.dtype == np.uint8 and p.ndim == 3 and p.std() > 5 for p in found.pictures.values())


def test_scene_check_warns_of_an_open_scene(tmp_path):
    floor = Box((0, 0, -0.5), (5, 4, 0))
    pole = Box((2, 1, 0), (2.2, 1.2, 2.5))
    path = write_glb(tmp_path / "open.glb", Room(boxes=[floor, pole]))
    found = check_scene(SceneSettings(file=str(path), up_axis="Z"), CameraSettings(width=30, height=20))
    assert any("not closed" in w for w in found.summary["warnings"])
    assert any("ceiling" in w for w in found.summary["warnings"])


def test_scene_check_of_a_missing_file():
    with pytest.raises(InputError, match="no such file"):
        check_scene(SceneSettings(file="/nowhere/scene.glb"))


def test_views_are_judged_against_depth_without_the_sensors_noise(sim):
    noisy = RaycastSimulator(sim.scene, sim.camera, SensorSettings(depth_noise_per_m2=0.01, dropout=0.2))
    view = _true_view(noisy, sim.scene.start_pose, 3)
    assert (view.depth == sim.depth(sim.scene.start_pose)).all() and (view.depth > 0).mean() > 0.99
    assert (noisy.render(sim.scene.start_pose, step=3).depth != view.depth).mean() > 0.5
