"""Culling: behind an occluder, outside the frustum, out of range."""

import numpy as np
import pytest

from active3d_pipe.evaluation.config import EvaluationSettings
from active3d_pipe.evaluation.culling import SeenBy, cull_unseen, render_depth, seen_vertices, submesh
from active3d_pipe.geometry import se3
from active3d_pipe.geometry.raycasting import SurfaceIndex
from active3d_pipe.structures import Camera, TriangleMesh

CAMERA = Camera.from_fov(80, 60, 90, far=5.0)
SETTINGS = EvaluationSettings(cull_stride=1, cull_scale=1.0)


def wall(x: float, half: float, color: int) -> TriangleMesh:
    """A square of side 2 half, facing the origin at distance x along +x, as a grid of 20x20 cells."""
    t = np.linspace(-half, half, 21, dtype=np.float32)
    y, z = np.meshgrid(t, t, indexing="ij")
    vertices = np.stack([np.full_like(y, x), y, z], axis=-1).reshape(-1, 3)
    i = np.arange(21 * 21).reshape(21, 21)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    return TriangleMesh(vertices, faces, np.full((441, 3), color, np.uint8))


def both(a: TriangleMesh, b: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(
        np.concatenate([a.vertices, b.vertices]), np.concatenate([a.faces, b.faces + len(a.vertices)]).astype(np.int32),
        np.concatenate([a.colors, b.colors]),
    )


LOOK_X = se3.pose_from_yaw_pitch(np.zeros(3), 0.0, 0.0)[None]


def test_rendered_depth_is_z_along_the_optical_axis():
    mesh = wall(2.0, 5.0, 0)
    depth = render_depth(SurfaceIndex(mesh.vertices, mesh.faces), CAMERA, LOOK_X[0])
    assert depth.shape == (60, 80)
    np.testing.assert_allclose(depth, 2.0, atol=1e-5)  # also in the corners, where the range is longer
    away = render_depth(SurfaceIndex(mesh.vertices, mesh.faces), CAMERA, se3.pose_from_yaw_pitch(np.zeros(3), np.pi, 0))
    assert np.isinf(away).all()


def test_a_wall_hides_what_is_behind_it():
    mesh = both(wall(1.0, 0.5, 1), wall(2.0, 0.5, 2))
    seen = seen_vertices(mesh, SeenBy(CAMERA, LOOK_X), SETTINGS)
    assert seen[:441].all() and not seen[441:].any()
    culled = cull_unseen(mesh, SeenBy(CAMERA, LOOK_X), SETTINGS)
    assert (culled.colors == 1).all() and len(culled.faces) == 800
    np.testing.assert_array_equal(culled.vertices[culled.faces], mesh.vertices[mesh.faces[:800]])


def test_a_larger_wall_behind_shows_its_rim_only():
    mesh = both(wall(1.0, 0.5, 1), wall(2.0, 1.4, 2))
    seen = seen_vertices(mesh, SeenBy(CAMERA, LOOK_X), SETTINGS)[441:]
    shadow = np.abs(mesh.vertices[441:, 1:]).max(axis=1) < 0.9  # the front wall's shadow reaches 1.0
    lit = np.abs(mesh.vertices[441:, 1:]).max(axis=1) > 1.1
    assert not seen[shadow].any() and seen[lit].all()


def test_a_second_camera_behind_sees_the_rest_and_range_and_frustum_count():
    mesh = both(wall(1.0, 0.5, 1), wall(2.0, 0.5, 2))
    behind = se3.pose_from_yaw_pitch(np.array([3.5, 0, 0]), np.pi, 0.0)
    assert seen_vertices(mesh, SeenBy(CAMERA, np.stack([LOOK_X[0], behind])), SETTINGS).all()
    assert not seen_vertices(wall(5.5, 0.5, 1), SeenBy(CAMERA, LOOK_X), SETTINGS).any()  # beyond far = 5 m
    assert not seen_vertices(wall(-1.0, 0.5, 1), SeenBy(CAMERA, LOOK_X), SETTINGS).any()  # behind the camera


def test_observed_depth_decides_when_given():
    mesh = wall(2.0, 0.5, 1)
    near = np.full((60, 80), 1.0, np.float32)  # the sensor saw something at 1 m
    assert not seen_vertices(mesh, SeenBy(CAMERA, LOOK_X, [near]), SETTINGS).any()
    assert seen_vertices(mesh, SeenBy(CAMERA, LOOK_X, [near * 2]), SETTINGS).all()
    assert not seen_vertices(mesh, SeenBy(CAMERA, LOOK_X, [near * 0]), SETTINGS).any()  # no return, nothing seen


def test_a_slanted_floor_is_not_culled_by_its_own_depth():
    floor = wall(0.0, 3.0, 1)
    floor = TriangleMesh(floor.vertices[:, [1, 2, 0]] + np.float32([3.2, 0, -0.3]), floor.faces, floor.colors)
    seen = seen_vertices(floor, SeenBy(CAMERA, LOOK_X), EvaluationSettings(cull_stride=1, cull_scale=0.5))
    uv_ok = np.abs(floor.vertices[:, 1]) < 0.9 * floor.vertices[:, 0]
    ahead = (floor.vertices[:, 0] > 0.5) & (floor.vertices[:, 0] < 4.9) & uv_ok
    assert ahead.sum() > 100 and seen[ahead].all()


def test_submesh_of_nothing_is_empty():
    empty = submesh(wall(1.0, 0.5, 1), np.zeros(800, bool))
    assert len(empty.vertices) == len(empty.faces) == 0
    assert len(cull_unseen(empty, SeenBy(CAMERA, LOOK_X), SETTINGS).faces) == 0


@pytest.mark.parametrize("stride", [1, 3])
def test_only_every_nth_frame_takes_part(stride):
    away = se3.pose_from_yaw_pitch(np.zeros(3), np.pi, 0.0)
    poses = np.stack([away, LOOK_X[0], away])
    settings = EvaluationSettings(cull_stride=stride)
    assert seen_vertices(wall(1.0, 0.5, 1), SeenBy(CAMERA, poses), settings).any() == (stride == 1)
