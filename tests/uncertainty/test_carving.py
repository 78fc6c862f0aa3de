"""Ray evidence against exact segment / voxel intersection."""

import numpy as np
import pytest
from uncertainty_room import CAMERA, SIZE, frame, frames, pose, room_grid, trace

from active3d_pipe.geometry import projection, se3, voxel_traversal
from active3d_pipe.structures import Camera, Frame, VoxelGrid
from active3d_pipe.uncertainty import kernels_carving
from active3d_pipe.uncertainty.carving import integrate_depth, looks_in_vain
from active3d_pipe.uncertainty.config import UncertaintySettings

EVERY_PIXEL = UncertaintySettings(ray_stride=1)


def crossing_length(grid, o, e):
    """(X, Y, Z) length of the segment o -> e (voxel units, as a share of it) inside every voxel: slab test."""
    d = e - o
    t0, t1 = np.zeros(grid.shape), np.ones(grid.shape)
    for axis in range(3):
        low = np.arange(grid.shape[axis], dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (low - o[axis]) / d[axis], (low + 1 - o[axis]) / d[axis]
        shape = [1, 1, 1]
        shape[axis] = -1
        t0 = np.maximum(t0, np.minimum(a, b).reshape(shape))
        t1 = np.minimum(t1, np.maximum(a, b).reshape(shape))
    return t1 - t0


def slow_evidence(grid, f):
    """Free counts, hit counts, and voxels that some ray touches by less than rounding can tell."""
    free, hit, unsure = (np.zeros(grid.shape, int) for _ in range(3))
    ends, rays = [], []
    points = se3.transform_points(f.T_world_camera, projection.pixel_rays(f.camera).astype(float) * f.depth[..., None])
    o = (f.T_world_camera[:3, 3] - grid.origin) / grid.voxel_size
    for point, d in zip(points.reshape(-1, 3), f.depth.ravel()):
        if d <= 0:
            continue
        e = (point - grid.origin) / grid.voxel_size
        rays.append(crossing_length(grid, o, e))
        ijk = np.floor(e).astype(int)
        if grid.contains_index(ijk):
            hit[tuple(ijk)] += 1
            ends.append(e)
    for length in rays:
        free += (length > 0) & (hit == 0)
        unsure += np.abs(length) < 1e-5
    for e in ends:
        if np.abs(e - np.round(e)).min() < 1e-4:
            unsure[tuple(np.floor(e - 1e-3).astype(int))] += 1
            unsure[tuple(np.floor(e + 1e-3).astype(int))] += 1
    return free, hit, unsure > 0


@pytest.mark.parametrize(
    ("yaw", "position"), [(17.0, (0.9, 1.1, 1.2)), (-140.0, (1.2, 1.9, 0.6)), (0.0, (-0.9, 1.1, 1.2))]
)
def test_counts_equal_exact_intersection(yaw, position):
    grid = room_grid(0.19)
    camera = Camera.from_fov(16, 12, 90)
    T = pose(yaw, position)
    depth = trace(T, camera)
    depth[3, 4] = 0
    f = Frame(0, 0, camera, T, np.zeros((12, 16, 3), np.uint8), depth)
    got = integrate_depth(grid, [f], EVERY_PIXEL)
    free, hit, unsure = slow_evidence(grid, f)
    assert hit.sum() > 50
    assert free.sum() > 300
    assert unsure.mean() < 0.05
    np.testing.assert_array_equal(got.free[~unsure], free[~unsure])
    np.testing.assert_array_equal(got.hit[~unsure], hit[~unsure])


def test_looks_in_vain_equal_exact_intersection():
    """Voxels up to a range that only lost rays cross, up to the first solid one, in any of three frames."""
    grid, camera, rng = room_grid(0.19), Camera.from_fov(16, 12, 90), np.random.default_rng(2)
    settings = UncertaintySettings(ray_stride=1, vain_range_m=1.1)
    solid = np.zeros(grid.shape, bool)
    solid[6:8, :, 5] = True
    taken, want, unsure = [], np.zeros(grid.shape, bool), np.zeros(grid.shape, bool)
    for n, yaw in enumerate((17.0, -140.0, 80.0)):
        T = pose(yaw, (0.9, 1.1, 1.2))
        depth = trace(T, camera)
        depth[rng.random(depth.shape) < 0.5] = 0
        depth[2:9, 4:12] = 0
        taken.append(Frame(n, 0, camera, T, np.zeros((12, 16, 3), np.uint8), depth))
        o = (T[:3, 3] - grid.origin) / grid.voxel_size
        ends = np.where(depth > 0, depth, settings.vain_range_m)[..., None] * projection.pixel_rays(camera)
        lengths = [
            crossing_length(grid, o, (p - grid.origin) / grid.voxel_size)
            for p in se3.transform_points(T, ends.astype(float)).reshape(-1, 3)
        ]
        read = np.zeros(grid.shape, bool)
        for length, d in zip(lengths, depth.ravel()):
            unsure |= np.abs(length) < 1e-5
            if d > 0:
                read |= length > 0
        for length, d in zip(lengths, depth.ravel()):
            if d > 0:
                continue
            crossed = [v for v in map(tuple, np.argwhere(length > 0))]
            crossed.sort(key=lambda v: np.linalg.norm(np.array(v) + 0.5 - o))
            walls = [m for m, v in enumerate(crossed) if solid[v]]
            for v in crossed[: walls[0]] if walls else crossed:
                want[v] |= not read[v]
            if walls:  # the order of the voxels by their centres is not quite that of the ray
                for v in crossed[walls[0] - 1 :]:
                    unsure[v] = True
    got = looks_in_vain(grid, taken, solid, settings) > 0
    assert want.sum() > 100
    assert unsure.mean() < 0.2
    np.testing.assert_array_equal(got[~unsure], want[~unsure])


def test_agrees_with_the_traversal_of_the_planner():
    """Two implementations: there grazing rays count as free in hit voxels, else the counts are the same."""
    grid, f = room_grid(0.09), frame(0, pose(17.0, (0.93, 1.12, 1.23)))
    got = integrate_depth(grid, [f], EVERY_PIXEL)
    free, hit = voxel_traversal.carve(grid, f.T_world_camera, f.camera, f.depth)
    assert np.abs(got.hit - hit).sum() <= 0.002 * hit.sum()
    elsewhere = (got.hit == 0) & (hit == 0)
    assert np.abs(got.free - free)[elsewhere].sum() <= 0.002 * free.sum()


def test_the_rays_that_are_cast_do_not_depend_on_the_resolution():
    """A voxel of 0.1 m, an image of 90 degrees: 1 / 0.02 = 50 rays from its middle to its edge, and no fewer."""
    counts = []
    for width in (100, 200, 600):
        camera = Camera.from_fov(width, width * 3 // 4, 90, far=10)
        got = integrate_depth(room_grid(), [frame(0, pose(17.0), camera)], UncertaintySettings())
        counts.append((got.hit.sum(), got.free.sum()))
    np.testing.assert_allclose(counts, np.tile(counts[0], (3, 1)), rtol=0.02)
    assert counts[0][0] == pytest.approx(100 * 75, rel=0.02)
    narrow = Camera.from_fov(64, 48, 2)
    assert integrate_depth(room_grid(), [frame(0, pose(17.0), narrow)], UncertaintySettings()).hit.sum() >= 8 * 8


def test_a_hit_voxel_is_not_free_in_the_same_frame():
    got = integrate_depth(room_grid(), frames((10,)), EVERY_PIXEL)
    assert got.free[got.hit > 0].max() == 0


def test_invalid_depth_says_nothing_and_far_depth_hits_nothing():
    grid, T = room_grid(), pose(0)
    rgb = np.zeros((60, 80, 3), np.uint8)
    for bad in (0.0, np.nan, np.inf, -1.0):
        f = Frame(0, 0, CAMERA, T, rgb, np.full((60, 80), bad, np.float32))
        got = integrate_depth(grid, [f], EVERY_PIXEL)
        assert not got.free.any()
        assert not got.hit.any()
    near = Camera.from_fov(80, 60, 90, far=1.0)
    got = integrate_depth(grid, [Frame(0, 0, near, T, rgb, trace(T) + 5)], EVERY_PIXEL)
    assert not got.hit.any()
    z = projection.project(grid.centres(), T, near)[1]
    assert got.free.sum() > 100
    assert z[got.free > 0].max() < 1.0 + grid.voxel_size


def test_free_space_is_free_and_walls_are_hit():
    grid = room_grid()
    got = integrate_depth(grid, frames(range(0, 360, 40)), UncertaintySettings(ray_stride=2))
    centres = grid.centres()
    beyond = (centres < -0.1).any(-1) | (centres > SIZE + 0.1).any(-1)
    assert not got.free[beyond].any()
    assert not got.hit[beyond].any()
    assert got.hit.sum() > 5000


def test_counts_only_grow_add_up_and_do_not_depend_on_order():
    grid, fs = room_grid(), frames((-40, 0, 20, 90, 170))
    s = UncertaintySettings()
    both, first, second = (integrate_depth(grid, part, s) for part in (fs, fs[:2], fs[2:]))
    joined = first.joined(second)
    for name in ("free", "hit", "quality"):
        np.testing.assert_array_equal(getattr(both, name), getattr(joined, name))
        assert (getattr(both, name) >= getattr(first, name)).all()
        assert getattr(integrate_depth(grid, fs[::-1], s), name).tobytes() == getattr(both, name).tobytes()


def random_evidence(rng, shape, dtype):
    """Free and hit counts, quality, and bits of two kinds; nothing at all in half of the voxels."""
    seen = rng.random(shape) < 0.5
    counts = [(rng.integers(0, 4, shape) * seen).astype(dtype) for _ in range(2)]
    quality = (rng.random(shape) * (counts[1] > 0)).astype(np.float32)
    bits = [(rng.integers(0, 256, shape) * seen).astype(np.uint8) for _ in range(2)]
    return [*counts, quality, *bits]


def test_chunks_are_gathered_and_evidence_is_joined_as_numpy_does_it():
    rng = np.random.default_rng(3)
    shape = (7, 5, 6)
    chunks = random_evidence(rng, (4, *shape), np.int32)
    got = [np.zeros(shape, a.dtype) for a in random_evidence(rng, shape, np.float32)]
    kernels_carving.gather(*chunks, *got)
    ways = (np.sum, np.sum, np.max, np.bitwise_or.reduce, np.bitwise_or.reduce)
    gathered = [way(a, axis=0) for way, a in zip(ways, chunks, strict=True)]
    for a, expected in zip(got, gathered, strict=True):
        np.testing.assert_array_equal(a, expected)

    newer, got = random_evidence(rng, shape, np.float32), [a.copy() for a in got]
    kernels_carving.join(*newer, *got)
    joins = (np.add, np.add, np.maximum, np.bitwise_or, np.bitwise_or)
    for a, join, old, new in zip(got, joins, gathered, newer, strict=True):
        np.testing.assert_array_equal(a, join(old, new))


def test_frames_of_several_cameras_mix():
    grid = room_grid()
    small = Camera.from_fov(40, 30, 70)
    fs = [frame(0, pose(0)), frame(1, pose(60), small), frame(2, pose(-60))]
    s = UncertaintySettings()
    got = integrate_depth(grid, fs, s)
    alone = [integrate_depth(grid, [f], s) for f in fs]
    np.testing.assert_array_equal(got.free, sum(a.free for a in alone))


@pytest.mark.parametrize(("angle", "distance"), [(0, 1.0), (0, 2.01), (45, 1.0), (60, 1.51)])
def test_quality_is_incidence_times_resolution(angle, distance):
    """A plane at `distance` along the optical axis, turned by `angle` about the vertical."""
    camera = Camera.from_fov(81, 61, 60)
    n = np.array([np.sin(np.radians(angle)), 0, np.cos(np.radians(angle))])
    rays = projection.pixel_rays(camera)
    depth = (distance * n[2] / np.maximum(rays @ n, 0.05)).astype(np.float32)
    grid = VoxelGrid(np.array([-0.05, -0.05, 0.0]), 0.02, (5, 5, 150))
    s = UncertaintySettings(ray_stride=1, reference_footprint_m=0.01)
    f = Frame(0, 0, camera, np.eye(4), np.zeros((61, 81, 3), np.uint8), depth)
    got = integrate_depth(grid, [f], s)
    middle = got.quality[2, 2].max()
    expected = np.cos(np.radians(angle)) * min(1, 0.01 * camera.fx / distance)
    assert middle == pytest.approx(expected, rel=0.03)
    assert ((got.quality > 0) == (got.hit > 0)).all()
    assert got.quality.max() <= 1


def test_cells_tell_what_part_of_a_voxel_was_passed_and_hit():
    """Rays towards a wall in the middle of voxels pass their near halves, end in their far halves, and no more."""
    grid = VoxelGrid(np.zeros(3), 0.2, (10, 10, 10))
    camera = Camera.from_fov(64, 64, 60)
    T = se3.pose_from_yaw_pitch(np.array([0.31, 1.01, 1.01]), 0.0, 0.0)
    f = Frame(0, 0, camera, T, np.zeros((64, 64, 3), np.uint8), np.full((64, 64), 1.24, np.float32))
    got = integrate_depth(grid, [f], EVERY_PIXEL)
    wall = got.hit > 0
    assert wall.sum() > 20
    assert set(np.argwhere(wall)[:, 0]) == {7}
    lower, upper = np.uint8(0b00001111), np.uint8(0b11110000)
    assert (got.ended[wall] & lower == 0).all()
    assert (got.ended[7, 4:6, 4:6] == upper).all()
    assert (got.passed[7, 4:6, 4:6] & lower == lower).all()
    assert not got.ended[~wall].any()
    assert not got.passed[8:].any()
