"""Kernels of sight against plain twins, on random volumes: normals, open cells, what views see and saw in vain."""

import multiprocessing
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import distance_transform_cdt

from active3d_pipe.geometry import se3
from active3d_pipe.geometry.voxel_traversal import ray_fan
from active3d_pipe.information.gain import FREE, OPEN, SURFACE
from active3d_pipe.planning import kernels_reward, kernels_sight, reference_reward
from active3d_pipe.structures import Camera, VoxelGrid

GRID = VoxelGrid(np.array([-0.3, 0.2, 0.1]), 0.1, (20, 18, 16))
CAMERA = Camera.from_fov(40, 30, 90)
FAN = ray_fan(CAMERA, 3)[2]


def random_kinds(seed, shares=(0.3, 0.3, 0.4), shape=GRID.shape):
    return np.random.default_rng([seed, 1]).choice([FREE, OPEN, SURFACE], shape, p=shares).astype(np.uint8)


def test_surface_normals_equal_the_reference():
    kind = random_kinds(0, (0.02, 0.58, 0.4))  # few free voxels, so that some see none and some few
    kind[:5, :5, :5] = FREE
    kind[2, 2, 2] = SURFACE  # free all around: no side is the clear one
    got = np.zeros((*kind.shape, 3), np.int8)
    kernels_sight.surface_normals(kind, got)
    want = np.zeros(got.shape)
    free = np.argwhere(kind == FREE)
    for v in np.argwhere(kind == SURFACE):
        offset = (free - v)[np.abs(free - v).max(axis=1) <= 2].astype(float)
        total = (offset / np.linalg.norm(offset, axis=1, keepdims=True)).sum(axis=0)
        if np.linalg.norm(total) > 1e-3:
            want[tuple(v)] = 127 * total / np.linalg.norm(total)
    assert not want[2, 2, 2].any()
    assert 50 < (~want.any(axis=-1) & (kind == SURFACE)).sum() < 0.8 * (kind == SURFACE).sum()
    np.testing.assert_allclose(got, want, atol=0.51)


def as_cells(bits):
    """(2 X, 2 Y, 2 Z) bool of the bits 4 a + 2 b + c of half-size cells, uint8 (X, Y, Z)."""
    out = np.zeros(2 * np.array(bits.shape), bool)
    for cell in range(8):
        out[cell >> 2 :: 2, cell >> 1 & 1 :: 2, cell & 1 :: 2] = bits >> cell & 1
    return out


def test_open_cells_equal_the_reference():
    """On the grid of cells: of surface, met by no ray, and one of the six neighbours is clear."""
    rng, kind = np.random.default_rng(1), random_kinds(1)
    # A voxel in three has no clear cell, a voxel in three none that was not met.
    clear, unmet = (rng.integers(0, 256, kind.shape) * (rng.random(kind.shape) < 0.7) for _ in range(2))
    clear, unmet = (clear & ~unmet).astype(np.uint8), unmet.astype(np.uint8)
    got = np.zeros(kind.shape, np.uint8)
    kernels_sight.open_cells(kind, clear, unmet, got)
    around = np.pad(as_cells(clear), 1)
    beside = np.zeros(as_cells(clear).shape, bool)
    for axis in range(3):
        for shift in (-1, 1):
            beside |= np.roll(around, shift, axis)[1:-1, 1:-1, 1:-1]
    want = beside & as_cells(unmet) & as_cells(np.where(kind == SURFACE, 255, 0))
    assert 0.05 < want.mean() < 0.5
    np.testing.assert_array_equal(as_cells(got), want)


def random_field(seed):
    """What the kernels read of a `RewardField`, empty in the middle, so that rays jump.

    `stops` also holds open and free voxels.
    """
    rng = np.random.default_rng(seed)
    kind = random_kinds(seed, (0.84, 0.09, 0.07))
    stops = (kind == SURFACE) | (rng.random(kind.shape) < np.where(kind == OPEN, 0.4, 0.01))
    kind[5:15, 4:14, 3:13] = FREE
    stops[5:15, 4:14, 3:13] = False
    of_interest = (kind != FREE) | stops
    return SimpleNamespace(
        grid=GRID, max_range_m=1.5, enough_quality=0.5, quality_range_m=0.4, kind=kind.ravel(),
        stops=stops.astype(np.uint8).ravel(),
        skip=distance_transform_cdt(~of_interest, "chessboard").clip(0, 12).astype(np.uint8).ravel(),
        clear=rng.integers(0, 256, GRID.size).astype(np.uint8), open_bits=rng.integers(0, 256, GRID.size, np.uint8),
        quality=rng.uniform(0, 0.6, GRID.size).astype(np.float32),
        normal=rng.integers(-80, 80, (GRID.size, 3)).astype(np.int8),
    )


def random_poses(seed, count):
    """Poses in the empty middle: (origins (N, 3) voxels, rotations (N, 3, 3))."""
    rng = np.random.default_rng(seed)
    poses = [
        se3.pose_from_yaw_pitch(rng.uniform(6.5, 11.5, 3), rng.uniform(-3, 3), rng.uniform(-1, 1)) for _ in range(count)
    ]
    return np.array([T[:3, 3] for T in poses], np.float32), np.array([T[:3, :3] for T in poses], np.float32)


def sight_of(field, stops, origin, rotation):
    """For every ray of the fan: (direction, flat ids of the voxels of interest, bit of the cell that ends it)."""
    solid = SimpleNamespace(**vars(field) | {"kind": np.where(stops, SURFACE, OPEN)})
    for ray in FAN:
        direction = rotation.astype(float) @ ray
        voxels, bit = reference_reward.sight(solid, origin.astype(float), direction)
        ids = [int(np.ravel_multi_index(v, GRID.shape)) for v in voxels]
        yield direction, [v for v in ids if field.skip[v] == 0], bit


def assert_nearly_equal(got, want):
    """Half way through a voxel a ray may lie on the border of its cells: rounding decides, seldom."""
    assert (want > 0).sum() > 15
    assert (got != want).sum() <= 0.04 * (want > 0).sum()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_mark_seen_equals_the_reference(seed):
    field = random_field(seed)
    surface = (field.kind == SURFACE).astype(np.uint8)
    seen, cells, want, want_cells = np.zeros((4, GRID.size), np.uint8)
    for origin, rotation in zip(*random_poses(seed, 6)):
        kernels_reward.mark_seen(
            origin, rotation, FAN.astype(np.float32), surface, field.skip, field.clear, GRID.shape,
            np.float32(0.1), np.float32(field.max_range_m), seen, cells,
        )
        for _, ids, bit in sight_of(field, surface, origin, rotation):
            want[ids] = 1
            if bit:
                want_cells[ids[-1]] |= bit
    assert_nearly_equal(seen, want)
    assert_nearly_equal(cells, want_cells)


def reference_looks(field, origins, rotations, weights):
    """What `count_looks` says of itself, view by view and ray by ray."""
    looks, size = np.zeros((2, GRID.size)), GRID.voxel_size
    for origin, rotation, weight in zip(origins, rotations, weights):
        promised, cell_promised = set(), set()
        for direction, ids, bit in sight_of(field, field.stops, origin, rotation):
            for v in ids:
                centre = np.array(np.unravel_index(v, GRID.shape)) + 0.5
                distance = size * float(np.linalg.norm(centre - origin))
                if field.kind[v] == OPEN and not field.stops[v]:
                    promised.add(v)
                if field.kind[v] == SURFACE:
                    share, _ = reference_reward.surface_share(field, v, direction, distance)
                    if share > 0.5 * (1 - field.quality[v] / field.enough_quality):
                        promised.add(v)
                    if field.open_bits[v] & bit and reference_reward.cell_share(field, distance) >= 1:
                        cell_promised.add(v)
        looks[0, list(promised)] += weight
        looks[1, list(cell_promised)] += weight
    return looks


@pytest.mark.parametrize("seed", [3, 4])
def test_count_looks_equals_the_reference(seed):
    field = random_field(seed)
    origins, rotations = random_poses(seed, 8)
    weights = 2.0 ** np.arange(-2, 6, dtype=np.float32)
    got = kernels_reward.count_looks(
        origins, rotations, weights, FAN.astype(np.float32), field.stops, field.skip, field.kind, field.quality,
        field.normal, field.clear, field.open_bits, GRID.shape, np.float32(0.1), np.float32(field.max_range_m),
        np.float32(field.enough_quality), np.float32(field.quality_range_m),
    )
    want = reference_looks(field, origins, rotations, weights)
    settled = (want[0] > 0) & (field.kind == SURFACE)
    assert settled.sum() > 20 and field.skip.max() > kernels_sight.LEAST_JUMP and len(np.unique(want)) > 6
    assert_nearly_equal(got[0], want[0])
    assert_nearly_equal(got[1], want[1])
    # Where a ray ended once, an open voxel need not be settled by the next.
    thick = (field.kind == OPEN) & (field.stops > 0)
    assert thick.any() and not got[0][thick].any()


def sight_along_a_border(done):
    """Up along z, a hair to the left of a border of voxels, three voxels from the nearest of interest on the right."""
    shape = (40, 8, 60)
    skip = np.broadcast_to(np.abs(np.arange(40) - 27).astype(np.uint8)[:, None, None], shape).ravel()
    stops, ids = np.zeros(skip.size, np.uint8), np.empty(sum(shape) + 3, np.int32)
    done.put(kernels_sight.walk_sight(
        stops, stops, skip, np.float32(0.1), *np.float32([24.0, 4.5, 2.5, -1e-7, 0, 10, 5.0]), shape, ids
    ))


def test_a_ray_along_a_border_comes_to_an_end():
    """Every jump used to lead back to where it began: a kernel holds the interpreter, so it runs in its own process."""
    spawn = multiprocessing.get_context("spawn")
    done = spawn.Queue()
    process = spawn.Process(target=sight_along_a_border, args=(done,))
    process.start()
    try:
        assert done.get(timeout=120)[0] == 0
    finally:
        process.kill()
