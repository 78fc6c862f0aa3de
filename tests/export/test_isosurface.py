import numpy as np
import pytest
from scipy.spatial import cKDTree

from active3d_pipe.errors import ConfigError, InputError
from active3d_pipe.export.config import MeshSettings
from active3d_pipe.export.isosurface import drop_small_components, extract_mesh, keep_faces, near_surface
from active3d_pipe.export.kernels_marching import (
    EDGES,
    TRIANGLE_COUNT,
    TRIANGLE_EDGES,
    component_areas,
    component_labels,
)
from active3d_pipe.export.view_fusion import colour_mesh, cull_unseen
from active3d_pipe.structures import TriangleMesh, VoxelGrid

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
        return (0.4 - np.abs(np.asarray(points)).max(axis=1)).astype(np.float32)

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


def test_every_case_separates_solid_from_free_corners():
    for case in range(256):
        solid = [bool(case >> c & 1) for c in range(8)]
        triangles = TRIANGLE_EDGES[case, : TRIANGLE_COUNT[case]]
        cut = {i for i, (a, b) in enumerate(EDGES) if solid[a] != solid[b]}
        assert set(triangles.reshape(-1).tolist()) == cut
        # Edges of triangles inside the cell are shared by two of them in opposite directions; the others lie on the
        # cell's faces, where the neighbour goes on, and close to loops: one leaves and one enters every vertex.
        ways = [(int(t[k]), int(t[(k + 1) % 3])) for t in triangles for k in range(3)]
        assert len(set(ways)) == len(ways)
        rim = [w for w in ways if w[::-1] not in ways]
        assert sorted(a for a, _ in rim) == sorted(b for _, b in rim) == sorted(cut)


def test_any_signs_give_a_surface_without_cracks():
    values = np.random.default_rng(1).normal(size=(41, 41, 41)).astype(np.float32)
    values[[0, 1, -2, -1]] = values[:, [0, 1, -2, -1]] = values[:, :, [0, 1, -2, -1]] = 1

    def noise(points):
        return 0.01 * values[tuple(np.rint((np.asarray(points) + 0.5) * 40).astype(int).T)]

    mesh = extract_mesh(noise, LOW, HIGH, SETTINGS.model_copy(update={"min_component_m2": 0.0}))
    assert len(mesh.faces) > 1e5 and (edges_by_count(mesh.faces) % 2 == 0).all()


def test_small_pieces_are_dropped():
    def two(points):
        speck = np.linalg.norm(np.asarray(points) - [0.42, 0.42, 0.42], axis=1) - 0.03
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


def test_areas_of_pieces_are_those_of_their_faces():
    def two(points):
        balls = [np.linalg.norm(np.asarray(points) - [x, 0, 0], axis=1) - r for x, r in ((-0.2, 0.15), (0.3, 0.1))]
        return np.minimum(*balls).astype(np.float32)

    mesh = extract_mesh(two, LOW, HIGH, SETTINGS.model_copy(update={"min_component_m2": 0.0}))
    labels, areas = np.empty(len(mesh.vertices), np.int64), np.zeros(len(mesh.vertices))
    component_labels(mesh.faces, labels)
    component_areas(mesh.vertices, mesh.faces, labels, areas)
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    slow = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    left = a[:, 0] < 0.1
    assert np.count_nonzero(areas) == 2
    assert sorted(areas[areas > 0]) == pytest.approx(sorted([slow[left].sum(), slow[~left].sum()]), rel=1e-9)
