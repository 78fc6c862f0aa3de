from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from active3d_pipe.errors import InputError
from active3d_pipe.geometry import kernels_traversal as kernels
from active3d_pipe.geometry import reference_traversal as reference
from active3d_pipe.geometry import se3
from active3d_pipe.geometry.voxel_traversal import (
    carve,
    fan_stride,
    ray_fan,
    to_voxel_units,
    trace_depth,
    visible_voxels,
)
from active3d_pipe.structures import Camera, VoxelGrid

SHAPE = (7, 6, 5)


def walk(opaque, origin, direction, length):
    ids = np.empty(sum(opaque.shape) + 3, np.int32)
    n = kernels.walk_ray(
        opaque.astype(np.uint8).ravel(), *np.asarray(origin, np.float32), *np.asarray(direction, np.float32),
        np.float32(length), *opaque.shape, ids,
    )
    return [tuple(int(c) for c in np.unravel_index(v, opaque.shape)) for v in ids[:n]]


coordinate = st.floats(-3, 10, allow_nan=False, width=32)


def crossed_length(v, origin, direction, length):
    """How much of the ray up to `length` lies in voxel v."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (np.asarray(v) - origin) / direction, (np.asarray(v) + 1 - origin) / direction
    return min(np.maximum(a, b).min(), length) - max(np.minimum(a, b).max(), 0.0)


@settings(deadline=None, max_examples=150)
@given(st.tuples(coordinate, coordinate, coordinate), st.integers(0, 10**6), st.floats(0.1, 15))
@example((1.0, 0.0, 1.0), 0, 1.0)  # starts on an edge between voxels
@example((1.0, 0.0, 0.0), 0, 1.0)  # starts on an edge of the box and leads away from it
def test_walk_crosses_what_the_reference_crosses(origin, seed, length):
    rng = np.random.default_rng(seed)
    opaque = rng.random(SHAPE) < 0.1
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    got, want = walk(opaque, origin, direction, length), reference.traverse(opaque, origin, direction, length)

    def touched(v):
        return crossed_length(v, np.asarray(origin), direction, length) < 1e-4

    # Rays through an edge or a corner may touch voxels there or not, and may stop at one that is opaque.
    ends = [bool(path) and bool(opaque[path[-1]]) and touched(path[-1]) for path in (got, want)]
    assert ends[1] or all(touched(v) for v in set(got) - set(want))
    assert ends[0] or all(touched(v) for v in set(want) - set(got))
    for a, b in pairwise(got):
        assert sum(abs(x - y) for x, y in zip(a, b, strict=True)) == 1
    assert not any(opaque[v] for v in got[:-1])
    assert len(set(got)) == len(got)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_axis_parallel_rays(axis, sign):
    opaque = np.zeros(SHAPE, bool)
    direction = np.zeros(3)
    direction[axis] = sign
    origin = np.array([2.5, 2.5, 2.5])
    got = walk(opaque, origin, direction, 100)
    assert got == reference.traverse(opaque, origin, direction, 100)
    assert len(got) == (SHAPE[axis] - 2 if sign > 0 else 3)


def test_stops_at_the_first_opaque_voxel_and_includes_it():
    opaque = np.zeros(SHAPE, bool)
    opaque[4, 2, 2] = opaque[5, 2, 2] = True
    assert walk(opaque, (0.5, 2.5, 2.5), (1, 0, 0), 100)[-1] == (4, 2, 2)


def test_first_voxels_are_where_the_reference_stops():
    rng = np.random.default_rng(3)
    opaque = rng.random(SHAPE) < 0.1
    origin = np.array([3.3, 2.6, 2.2])
    opaque[3, 2, 2] = False
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = np.zeros((1, len(directions)), np.int64)
    kernels.first_voxels(
        opaque.view(np.uint8).ravel(), origin.astype(np.float32)[None], directions.astype(np.float32)[None],
        np.float32(3.0), SHAPE, found,
    )
    found = found[0]
    paths = [reference.traverse(opaque, origin, d, 3.0) for d in directions]
    wanted = [np.ravel_multi_index(path[-1], SHAPE) if opaque[path[-1]] else -1 for path in paths]
    assert np.count_nonzero(found != wanted) <= 2  # rays through an edge may pass on either side
    assert 20 < np.count_nonzero(found < 0) < 180


def test_ray_that_misses_the_grid_sees_nothing():
    assert walk(np.zeros(SHAPE, bool), (-2, -2, -2), (-1, 0, 0), 100) == []


@pytest.fixture
def grid():
    return VoxelGrid(np.array([-1.0, -2.0, 0.0]), 0.1, (14, 11, 9))


def test_visible_voxels_match_the_reference(grid):
    rng = np.random.default_rng(0)
    occupied = rng.random(grid.shape) < 0.05
    camera = Camera.from_fov(24, 16, 90)
    for _ in range(4):
        position = grid.low + rng.random(3) * (grid.high - grid.low)
        T = se3.pose_from_yaw_pitch(position, rng.random() * 6, rng.random() - 0.5)
        got = visible_voxels(occupied, grid, T, camera, max_range_m=1.0, ray_stride=2)
        origin, d = to_voxel_units(grid, T, ray_fan(camera, 2)[2])
        want = reference.visible(occupied, origin.astype(float), d.astype(float) * grid.voxel_size, 10.0)
        assert len(np.setxor1d(got, np.flatnonzero(want))) <= 1
        assert (np.diff(got) > 0).all()


def test_fan_leaves_no_gap_at_the_range():
    camera = Camera.from_fov(600, 340, 90)
    stride = fan_stride(camera, 0.1, 5.0)
    rows, columns, d = ray_fan(camera, stride)
    assert {0, camera.height - 1} <= set(rows.tolist()) and {0, camera.width - 1} <= set(columns.tolist())
    in_row = d[rows == rows[0]]
    gaps = np.linalg.norm(np.diff(d[rows == np.unique(rows)[len(np.unique(rows)) // 2]], axis=0), axis=1) * 5.0
    assert len(in_row) > 50
    assert gaps.max() <= 0.101


def test_occupancy_above_half_blocks_and_unknown_does_not(grid):
    camera = Camera.from_fov(24, 16, 60)
    T = se3.pose_from_yaw_pitch(np.array([-0.95, -1.45, 0.45]), 0.0, 0.0)
    occupancy = np.full(grid.shape, 0.5, np.float32)
    open_view = visible_voxels(occupancy, grid, T, camera, max_range_m=2.0)
    occupancy[5] = 0.9
    blocked_view = visible_voxels(occupancy, grid, T, camera, max_range_m=2.0)
    i_open, i_blocked = (np.unravel_index(v, grid.shape)[0].max() for v in (open_view, blocked_view))
    assert (i_open, i_blocked) == (13, 5)


def test_carve_matches_the_reference(grid):
    camera = Camera.from_fov(16, 12, 80, far=1.0)
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.0, 1.4, (12, 16)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0
    T = se3.pose_from_yaw_pitch(np.array([-0.42, -1.53, 0.41]), 0.7, -0.2)
    free, hit = carve(grid, T, camera, depth)
    rows, columns, unit = ray_fan(camera, 1)
    origin, d = to_voxel_units(grid, T, unit)
    lengths = depth[rows, columns] / unit[:, 2] / grid.voxel_size
    free_want, hit_want = reference.carve(
        grid.shape, origin.astype(float), d.astype(float) * grid.voxel_size, lengths, 10.0
    )
    assert np.abs(hit - hit_want).sum() <= 2
    assert np.abs(free - free_want).sum() <= 4
    assert hit_want.sum() > 20 and free_want.sum() > 200


def test_carve_adds_to_counts_and_ignores_rays_without_return(grid):
    camera = Camera.from_fov(16, 12, 80)
    T = se3.pose_from_yaw_pitch(np.array([-0.42, -1.53, 0.41]), 0.7, -0.2)
    free, hit = carve(grid, T, camera, np.zeros((12, 16), np.float32))
    assert free.sum() == hit.sum() == 0
    depth = np.full((12, 16), 0.4, np.float32)
    once = carve(grid, T, camera, depth)
    twice = carve(grid, T, camera, depth, counts=carve(grid, T, camera, depth))
    np.testing.assert_array_equal(twice[0], 2 * once[0])
    np.testing.assert_array_equal(twice[1], 2 * once[1])
    assert once[1].sum() == 12 * 16


def test_every_ray_ends_in_one_voxel_and_carving_agrees_with_tracing(grid):
    """Depth traced through a voxel world, carved back, puts hits into solid voxels only."""
    solid = np.zeros(grid.shape, bool)
    solid[10:, :, :] = solid[:, 8:, :] = True
    camera = Camera.from_fov(32, 20, 90)
    T = se3.pose_from_yaw_pitch(np.array([-0.73, -1.71, 0.43]), 0.6, 0.0)
    depth = trace_depth(solid, grid, T, camera, max_range_m=5.0)
    assert (depth > 0).mean() > 0.5
    free, hit = carve(grid, T, camera, depth + np.float32(1e-3) * (depth > 0))
    assert hit[~solid].sum() == 0
    assert free[solid].sum() <= 0.05 * free.sum()
    assert hit.sum() == (depth > 0).sum()


def test_wrong_shapes_are_refused_in_one_line(grid):
    camera = Camera.from_fov(16, 12, 80)
    with pytest.raises(InputError, match="carve: depth"):
        carve(grid, np.eye(4), camera, np.zeros((3, 3), np.float32))
    with pytest.raises(InputError, match="occupied volume"):
        visible_voxels(np.zeros((2, 2, 2), bool), grid, np.eye(4), camera, max_range_m=1.0)
