import numpy as np
import pytest
from scipy.spatial import cKDTree

from active3d_pipe.errors import ConfigError, InputError
from active3d_pipe.export.config import MeshSettings
from active3d_pipe.export.isosurface import (
    colour_mesh,
    cull_unseen,
    drop_small_components,
    extract_mesh,
    keep_faces,
    near_surface,
)
from active3d_pipe.geometry import projection, se3
from active3d_pipe.structures import Camera, Frame, TriangleMesh, VoxelGrid

CENTRE, RADIUS = np.array([0.03, -0.02, 0.05]), 0.3
LOW, HIGH = np.full(3, -0.5), np.full(3, 0.5)
SETTINGS = MeshSettings(voxel_size_m=0.025, block_cells=16)


def ball_sdf(points):
    return np.clip(np.linalg.norm(points - CENTRE, axis=1) - RADIUS, -0.1, 0.1).astype(np.float32)


def edges_by_count(faces):
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


def normals_of(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a), (a + b + c) / 3


@pytest.fixture(scope="module")
def ball():
    return extract_mesh(ball_sdf, LOW, HIGH, SETTINGS)


def test_ball_is_accurate_closed_and_turned_outwards(ball):
    assert np.abs(np.linalg.norm(ball.vertices - CENTRE, axis=1) - RADIUS).max() < 1e-3
    assert ball.area_m2 == pytest.approx(4 * np.pi * RADIUS**2, rel=0.01)
    # Welded over all block borders: every edge has exactly two faces, and Euler's formula holds.
    assert (edges_by_count(ball.faces) == 2).all()
    assert len(ball.vertices) - len(edges_by_count(ball.faces)) + len(ball.faces) == 2
    normal, centroid = normals_of(ball)
    assert ((normal * (centroid - CENTRE)).sum(axis=1) > 0).all()


def test_a_room_is_turned_inwards():
    def room(points):
        return (0.4 - np.abs(points).max(axis=1)).astype(np.float32)

    normal, centroid = normals_of(extract_mesh(room, LOW, HIGH, SETTINGS))
    assert ((normal * centroid).sum(axis=1) < 0).mean() > 0.999


def test_blocks_do_not_change_the_surface(ball):
    one = extract_mesh(ball_sdf, LOW, HIGH, SETTINGS.model_copy(update={"block_cells": 64}))
    assert len(one.vertices) == len(ball.vertices) and len(one.faces) == len(ball.faces)
    assert cKDTree(one.vertices).query(ball.vertices)[0].max() < 1e-5


def test_coarse_pass_evaluates_little():
    asked = []

    def counting(points):
        asked.append(len(points))
        return ball_sdf(points)

    extract_mesh(counting, LOW, HIGH, MeshSettings(voxel_size_m=0.0125, block_cells=16))
    assert sum(asked) < 0.45 * 81**3


def test_no_surface_outside_of_what_was_observed():
    grid = VoxelGrid.from_bounds(LOW, HIGH, 0.1)
    hit = np.zeros(grid.shape, np.float32)
    top = CENTRE + np.array([0, 0, RADIUS])
    hit[tuple(grid.index_of(top))] = 3
    mesh = extract_mesh(ball_sdf, LOW, HIGH, SETTINGS, grid=grid, observed=near_surface(hit, 1))
    assert len(mesh.faces) > 50
    distance = np.abs(mesh.vertices - grid.centre_of(grid.index_of(top))).max(axis=1)
    assert distance.max() < 0.15 + 2 * SETTINGS.voxel_size_m + 1e-6
    empty = extract_mesh(ball_sdf, LOW, HIGH, SETTINGS, grid=grid, observed=np.zeros(grid.shape, bool))
    assert len(empty.faces) == 0


def test_field_without_surface_gives_an_empty_mesh():
    mesh = extract_mesh(lambda p: np.full(len(p), 0.01, np.float32), LOW, HIGH, SETTINGS)
    assert mesh.vertices.shape == (0, 3) and mesh.faces.shape == (0, 3)
    assert colour_mesh(mesh, lambda p: np.zeros((len(p), 3))).colors.shape == (0, 3)
    assert cull_unseen(mesh, [], SETTINGS) is mesh


def test_colour(ball):
    painted = colour_mesh(ball, lambda p: np.stack([p[:, 0] > 0, p[:, 1] * 0 + 0.5, p[:, 2] * 9], axis=1))
    assert painted.colors.dtype == np.uint8
    np.testing.assert_array_equal(painted.colors[:, 0], np.where(ball.vertices[:, 0] > 0, 255, 0))
    assert (painted.colors[:, 1] == 128).all() and painted.colors[:, 2].max() == 255


def frame_of(camera, T, depth):
    return Frame(0, 0, camera, T, np.zeros((*depth.shape, 3), np.uint8), depth.astype(np.float32))


def test_cull_keeps_what_a_frame_saw(ball):
    camera = Camera.from_fov(240, 240, 60)
    T = se3.look_at(CENTRE + np.array([1.0, 0, 0]), CENTRE)
    v = np.linspace(-1, 1, 240) * (1 - 1 / 240) * np.tan(np.radians(30))
    x, y = np.meshgrid(v, v)
    a = x**2 + y**2 + 1
    disc = 1 - a * (1 - RADIUS**2)
    depth = np.where(disc > 0, (1 - np.sqrt(np.maximum(disc, 0))) / a, 0)
    seen = cull_unseen(ball, [frame_of(camera, T, depth)], SETTINGS)
    _, centroid = normals_of(seen)
    side = (centroid - CENTRE)[:, 0] / RADIUS
    assert side.min() > 0.2  # the cap that looks at the camera, cos > R / distance = 0.3
    assert seen.area_m2 == pytest.approx(2 * np.pi * RADIUS**2 * (1 - 0.3), rel=0.05)
    # A reading in front hides everything.
    blocked = cull_unseen(ball, [frame_of(camera, T, np.where(depth > 0, 0.4, 0))], SETTINGS)
    assert len(blocked.faces) == 0


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
            expected[k] = d > 0 and z <= d + 0.05 and cosine >= 0.2
    settings = SETTINGS.model_copy(update={"cull_facing_cosine": 0.2})
    kept = cull_unseen(ball, [frame], settings)
    assert 100 < expected.sum() < 0.5 * len(expected)
    # A face exactly on a pixel border may fall either way in float32.
    assert abs(len(kept.faces) - expected.sum()) <= 2


def test_small_pieces_are_dropped():
    def two(points):
        speck = np.linalg.norm(points - [0.42, 0.42, 0.42], axis=1) - 0.03
        return np.minimum(ball_sdf(points), speck).astype(np.float32)

    whole = extract_mesh(two, LOW, HIGH, SETTINGS.model_copy(update={"min_component_m2": 0.0}))
    assert whole.vertices.max() > 0.4
    cleaned = drop_small_components(whole, 0.05)
    assert 0 < len(cleaned.faces) < len(whole.faces) and cleaned.vertices.max() < 0.4


def test_keep_faces_keeps_colours_of_the_used_vertices():
    v = np.arange(12, dtype=np.float32).reshape(4, 3)
    mesh = TriangleMesh(v, np.array([[0, 1, 2], [1, 2, 3]], np.int32), np.arange(12, dtype=np.uint8).reshape(4, 3))
    part = keep_faces(mesh, np.array([False, True]))
    np.testing.assert_array_equal(part.vertices, v[1:])
    np.testing.assert_array_equal(part.faces, [[0, 1, 2]])
    np.testing.assert_array_equal(part.colors, mesh.colors[1:])


def test_bad_input():
    with pytest.raises(ConfigError, match="low < high"):
        extract_mesh(ball_sdf, HIGH, LOW, SETTINGS)
    grid = VoxelGrid.from_bounds(LOW, HIGH, 0.1)
    with pytest.raises(InputError, match="together"):
        extract_mesh(ball_sdf, LOW, HIGH, SETTINGS, grid=grid)
