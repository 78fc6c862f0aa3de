import numpy as np
import pytest

from active3d_pipe.export.config import MeshSettings
from active3d_pipe.export.final_mesh import final_mesh
from active3d_pipe.export.isosurface import extract_mesh
from active3d_pipe.export.view_fusion import colour_from_views, colour_mesh, cull_unseen, near_readings
from active3d_pipe.geometry import projection, se3
from active3d_pipe.structures import Camera, Frame

CENTRE, RADIUS = np.array([0.03, -0.02, 0.05]), 0.3
LOW, HIGH = np.full(3, -0.5), np.full(3, 0.5)
SETTINGS = MeshSettings(voxel_size_m=0.025, block_cells=16, cull_margin_m=0)


def ball_sdf(points):
    return np.clip(np.linalg.norm(points - CENTRE, axis=1) - RADIUS, -0.1, 0.1).astype(np.float32)


def normals_of(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a), (a + b + c) / 3


@pytest.fixture(scope="module")
def ball():
    return extract_mesh(ball_sdf, LOW, HIGH, SETTINGS)


def paint(points):
    """A smooth pattern, 0..1."""
    return 0.5 + 0.4 * np.sin(8 * np.asarray(points, np.float64))


def view_of_ball(direction, size=240):
    """Frame of the painted ball from 1 m away along `direction`, exact depth; black where there is nothing."""
    camera = Camera.from_fov(size, size, 60)
    T = se3.look_at(CENTRE + np.asarray(direction, float) / np.linalg.norm(direction), CENTRE)
    rays = projection.pixel_rays(camera)
    a = (rays**2).sum(axis=-1)
    disc = 1 - a * (1 - RADIUS**2)
    depth = np.where(disc > 0, (1 - np.sqrt(np.maximum(disc, 0))) / a, 0).astype(np.float32)
    points = depth[..., None] * rays @ T[:3, :3].T + T[:3, 3]
    rgb = np.where(depth[..., None] > 0, np.rint(255 * paint(points)), 0).astype(np.uint8)
    return Frame(0, 0, camera, T, rgb, depth)


def test_colour(ball):
    painted = colour_mesh(ball, lambda p: np.stack([p[:, 0] > 0, p[:, 1] * 0 + 0.5, p[:, 2] * 9], axis=1))
    assert painted.colors.dtype == np.uint8
    np.testing.assert_array_equal(painted.colors[:, 0], np.where(ball.vertices[:, 0] > 0, 255, 0))
    assert (painted.colors[:, 1] == 128).all() and painted.colors[:, 2].max() == 255


def frame_of(camera, T, depth):
    return Frame(0, 0, camera, T, np.zeros((*depth.shape, 3), np.uint8), depth.astype(np.float32))


def test_cull_keeps_what_a_frame_saw(ball):
    frame = view_of_ball([1, 0, 0])
    camera, T, depth = frame.camera, frame.T_world_camera, frame.depth
    seen = cull_unseen(ball, [frame], SETTINGS)
    _, centroid = normals_of(seen)
    side = (centroid - CENTRE)[:, 0] / RADIUS
    assert side.min() > 0.2  # the cap that looks at the camera, cos > R / distance = 0.3
    assert seen.area_m2 == pytest.approx(2 * np.pi * RADIUS**2 * (1 - 0.3), rel=0.05)
    # A reading in front hides everything.
    blocked = cull_unseen(ball, [frame_of(camera, T, np.where(depth > 0, 0.4, 0))], SETTINGS)
    assert len(blocked.faces) == 0
    # Readings far behind say that nothing is there.
    assert len(cull_unseen(ball, [frame_of(camera, T, depth + 0.1 * (depth > 0))], SETTINGS).faces) == 0


def test_cull_agrees_with_the_slow_formula(ball):
    rng = np.random.default_rng(0)
    camera = Camera.from_fov(40, 30, 80)
    T = se3.look_at(CENTRE + np.array([0.5, 0.6, 0.2]), CENTRE + np.array([0.1, 0, 0.1]))
    frame = frame_of(camera, T, rng.uniform(0, 1, (30, 40)) * (rng.random((30, 40)) < 0.8))
    normal, centroid = normals_of(ball)
    expected = np.zeros(len(ball.faces), bool)
    for k in range(len(expected)):
        uv, z = projection.project(centroid[k].astype(np.float64), T, camera)
        if projection.in_image(uv, z, camera):
            d = frame.depth[int(uv[1]), int(uv[0])]
            to_camera = T[:3, 3] - centroid[k]
            cosine = normal[k] @ to_camera / np.linalg.norm(normal[k]) / np.linalg.norm(to_camera)
            expected[k] = d > 0 and abs(z - d) <= 0.2 and cosine >= 0.2
    settings = SETTINGS.model_copy(update={"cull_facing_cosine": 0.2, "cull_tolerance_m": 0.2})
    kept = cull_unseen(ball, [frame], settings)
    assert 100 < expected.sum() < 0.5 * len(expected)
    # A face exactly on a pixel border may fall either way in float32.
    assert abs(len(kept.faces) - expected.sum()) <= 2


def test_margin_keeps_rings_around_what_was_seen(ball):
    frame = view_of_ball([1, 0, 0])
    seen = cull_unseen(ball, [frame], SETTINGS)
    more = cull_unseen(ball, [frame], SETTINGS.model_copy(update={"cull_margin_m": 0.05}))

    def least(mesh):
        return (normals_of(mesh)[1] - CENTRE)[:, 0].min()

    assert 0.02 < least(seen) - least(more) < 0.06
    assert len(seen.faces) < len(more.faces) < len(ball.faces)


def test_readings_mark_the_cells_they_lie_in():
    frame = view_of_ball([1, 0, 0])
    grid, marks = near_readings([frame], LOW, HIGH, 0.05, 0)
    rays, T = projection.pixel_rays(frame.camera), frame.T_world_camera
    on = frame.depth > 0
    points = (frame.depth[..., None] * rays @ T[:3, :3].T + T[:3, 3])[on]
    expected = np.zeros(grid.shape, bool)
    expected[tuple(grid.index_of(points).T)] = True
    assert not (marks & ~expected).sum() > 0.03 * expected.sum()
    _, grown = near_readings([frame], LOW, HIGH, 0.05, 1)
    assert not (expected & ~grown).any()
    at = np.argwhere(marks)
    for shift in ((1, 1, 1), (-1, 0, 1), (0, -1, 0)):
        near = np.clip(at + shift, 0, np.array(grid.shape) - 1)
        assert grown[tuple(near.T)].all()
    assert not near_readings([], LOW, HIGH, 0.05, 1)[1].any()


def test_colours_come_from_the_views_and_else_from_the_field(ball):
    frames = [view_of_ball(d) for d in ([1, 0, 0], [0.7, 0.7, 0.14], [0.7, -0.7, 0.14])]
    grey = colour_from_views(ball, frames, SETTINGS, lambda p: np.full((len(p), 3), 0.5))
    seen = np.flatnonzero((ball.vertices - CENTRE)[:, 0] > 0.6 * RADIUS)
    error = np.abs(grey.colors[seen] / 255 - paint(ball.vertices[seen]))
    assert error.mean() < 0.01 and error.max() < 0.05
    behind = (ball.vertices - CENTRE)[:, 0] < -0.5 * RADIUS
    assert (grey.colors[behind] == 128).all()


def test_a_view_that_differs_is_overruled(ball):
    frames = [view_of_ball([1, 0, y]) for y in (-0.02, 0.0, 0.02, 0.04)]
    frames[1] = Frame(1, 0, frames[1].camera, frames[1].T_world_camera, 255 - frames[1].rgb, frames[1].depth)
    painted = colour_from_views(ball, frames, SETTINGS, lambda p: np.full((len(p), 3), 0.5))
    seen = (ball.vertices - CENTRE)[:, 0] > 0.7 * RADIUS
    error = np.abs(painted.colors[seen] / 255 - paint(ball.vertices[seen]))
    plain = 0.25 * np.abs(1 - 2 * paint(ball.vertices[seen]))  # what a plain mean of the four would be off by
    assert error.mean() < 0.35 * plain.mean()


class Ball:
    low, high = LOW, HIGH

    @staticmethod
    def query_sdf(points):
        """The ball, and a sheet at the far side that nobody read."""
        points = np.asarray(points)
        return np.minimum(ball_sdf(points), np.abs(points[:, 0] + 0.45) - 0.02).astype(np.float32)

    @staticmethod
    def query_color(points):
        return np.full((len(points), 3), 0.25)


def test_final_mesh_is_near_readings_seen_and_coloured():
    frames = [view_of_ball([1, 0, 0]), view_of_ball([-0.2, 1, 0])]
    settings = SETTINGS.model_copy(update={"cull_margin_m": 0.05})
    mesh = final_mesh(Ball(), frames, settings)
    assert np.abs(np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS).max() < 2e-3
    assert mesh.colors.std() > 10
    again = final_mesh(Ball(), frames, settings)
    assert again.vertices.tobytes() == mesh.vertices.tobytes() and again.colors.tobytes() == mesh.colors.tobytes()
    plain = final_mesh(Ball(), frames, settings.model_copy(update={"colour": "field"}))
    assert (plain.colors == 64).all()
    empty = final_mesh(Ball(), [], settings)
    assert empty.vertices.shape == (0, 3) and empty.colors.shape == (0, 3)
