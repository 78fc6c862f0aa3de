import numpy as np
import pytest

from active3d_pipe.export import correction
from active3d_pipe.export import kernels_correction as kernels
from active3d_pipe.export.config import MeshSettings
from active3d_pipe.export.correction import corrected_sdf
from active3d_pipe.export.isosurface import extract_mesh
from active3d_pipe.geometry import projection, se3
from active3d_pipe.geometry.sensor_noise import sensor_noise
from active3d_pipe.structures import Camera, Frame

LOW, HIGH = np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, 1.0])
SETTINGS = MeshSettings(voxel_size_m=0.02, block_cells=32, min_component_m2=0.0)
HALF = 0.008  # of the thickness of the board, which is thinner than a marching-cubes cell


def board(points):
    """SDF of an upright board of 0.6 m x 0.6 m across the x axis."""
    q = np.abs(np.asarray(points, np.float64)) - np.array([HALF, 0.3, 0.3])
    return (np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)).astype(np.float32)


def washed_out(points):
    """What a field makes of the board: free space everywhere, a little less of it at the board."""
    return np.maximum(board(points), 0) + np.float32(0.03)


def view(position, noise=0.0, rng=None):
    """Exact depth of the board, with Gaussian noise on request."""
    camera = Camera.from_fov(120, 120, 60)
    T = se3.look_at(position, [0, 0, 0])
    rays = projection.pixel_rays(camera).reshape(-1, 3) @ T[:3, :3].T
    depth = np.zeros(len(rays), np.float32)
    t = np.full(len(rays), 0.05)
    for _ in range(80):  # sphere tracing
        t = np.minimum(t + board(T[:3, 3] + t[:, None] * rays / np.linalg.norm(rays, axis=1, keepdims=True)), 5)
    hit = t < 4
    depth[hit] = (t / np.linalg.norm(rays, axis=1))[hit]
    if noise:
        depth[hit] += rng.normal(0, noise, int(hit.sum())).astype(np.float32)
    shape = (camera.height, camera.width)
    return Frame(0, 0, camera, T, np.zeros((*shape, 3), np.uint8), depth.reshape(shape))


def both_sides(noise=0.0):
    rng = np.random.default_rng(0)
    places = [(x, y, z) for x in (-0.9, 0.9) for y in (-0.4, 0.0, 0.4) for z in (-0.2, 0.3)]
    return [view(p, noise, rng) for p in places]


def test_a_board_that_the_field_lost_comes_back():
    frames = both_sides()
    assert len(extract_mesh(washed_out, LOW, HIGH, SETTINGS).faces) == 0
    mesh = extract_mesh(corrected_sdf(washed_out, LOW, HIGH, frames, SETTINGS), LOW, HIGH, SETTINGS)
    inner = np.abs(mesh.vertices[:, 1:]).max(axis=1) < 0.25
    assert np.abs(np.abs(mesh.vertices[inner, 0]) - HALF).max() < 0.006
    for side in (-1, 1):  # both faces, about 0.36 m2 each
        faces = mesh.faces[(side * mesh.vertices[mesh.faces, 0] > 0).all(axis=1)]
        a, b, c = (mesh.vertices[faces[:, i]] for i in range(3))
        assert 0.3 < 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() < 0.45


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_field_that_is_right_is_left_alone(noise):
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (4000, 3)).astype(np.float32)
    query = corrected_sdf(board, LOW, HIGH, both_sides(noise), SETTINGS)
    changed = query(points) != board(points)
    assert changed.mean() < (1e-9 if noise == 0 else 0.03)


def test_what_noise_scatters_about_a_wall_is_no_contradiction(monkeypatch):
    """A field that is right before the wall and, like any, flat behind it; noise of up to ten marching-cubes cells."""

    def wall(points):
        return np.maximum(np.asarray(points)[:, 0] + 0.5, -0.05).astype(np.float32)

    rng, camera, frames = np.random.default_rng(4), Camera.from_fov(120, 120, 60), []
    for y in np.linspace(-0.3, 0.3, 12):
        T = se3.look_at([0.9, y, 0.1], [-0.5, 0.5 * y, 0])
        rays = projection.pixel_rays(camera).astype(np.float64) @ T[:3, :3].T
        depth = (-0.5 - T[0, 3]) / rays[..., 0] + rng.normal(0, 0.04, rays.shape[:2])
        frames.append(Frame(0, 0, camera, T, np.zeros((120, 120, 3), np.uint8), depth.astype(np.float32)))
    noise = sensor_noise(frames)
    assert noise[1] == pytest.approx(0.04, rel=0.05)
    points = rng.uniform([-0.7, -0.4, -0.4], [-0.2, 0.4, 0.4], (4000, 3)).astype(np.float32)

    def changed():
        return (corrected_sdf(wall, LOW, HIGH, frames, SETTINGS)(points) != wall(points)).mean()

    assert changed() < 0.02
    monkeypatch.setattr(correction, "BY_NOISE", 0.0)
    assert changed() > 0.3  # what it would be otherwise


def test_noiseless_depth_has_no_noise():
    noise = sensor_noise(both_sides())
    assert noise.dtype == np.float32 and noise.max() < 1e-4
    nothing = view((0.9, 0.0, 0.0))
    nothing.depth[:] = 0
    assert sensor_noise([nothing]).tolist() == [0.0]


def test_zero_means_never():
    settings = SETTINGS.model_copy(update={"dispute_m": 0.0})
    assert corrected_sdf(washed_out, LOW, HIGH, both_sides(), settings) is washed_out
    assert corrected_sdf(washed_out, LOW, HIGH, [], SETTINGS) is washed_out


def test_projective_sdf_against_a_slow_reference():
    frames = both_sides()
    points = np.random.default_rng(2).uniform(-0.4, 0.4, (300, 3)).astype(np.float32)
    poses = np.stack([f.T_world_camera for f in frames]).astype(np.float32)
    lenses = np.array([[f.camera.fx, f.camera.fy, f.camera.cx, f.camera.cy] for f in frames], np.float32)
    got = np.empty(len(points), np.float32)
    kernels.projective_sdf(
        points, np.stack([f.depth for f in frames]), np.ascontiguousarray(poses[:, :3, :3]),
        np.ascontiguousarray(poses[:, :3, 3]), lenses, np.array([f.depth.max() for f in frames], np.float32),
        np.float32(0.05), np.float32(0.06), got,
    )
    total, weight = np.zeros(len(points)), np.zeros(len(points))
    for frame in frames:
        pixels, z = projection.project(points, frame.T_world_camera, frame.camera)
        for n, ((u, v), depth) in enumerate(zip(pixels, z, strict=True)):
            i, j = int(np.floor(v)), int(np.floor(u))
            if depth < 0.05 or not (0 <= i < frame.camera.height and 0 <= j < frame.camera.width):
                continue
            reading = frame.depth[i, j]
            if reading > 0 and reading - depth > -0.06:
                w = min(1, 1 + (reading - depth) / 0.06) ** 2 / depth**2
                total[n] += w * min(reading - depth, 0.06)
                weight[n] += w
    expected = np.where(weight > 0, total / np.maximum(weight, 1e-30), np.nan)
    assert (np.isnan(got) == np.isnan(expected)).mean() > 0.99  # pixels on a border may round either way
    both = ~np.isnan(got) & ~np.isnan(expected)
    assert np.quantile(np.abs(got[both] - expected[both]), 0.98) < 1e-5
    assert both.sum() > 50


def test_readings_of_full_cells_are_left_out():
    frame = both_sides()[0]
    c, T = frame.camera, frame.T_world_camera.astype(np.float32)
    pose = (np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]), np.array([c.fx, c.fy, c.cx, c.cy], "f4"))
    origin, inv_cell = LOW.astype(np.float32), np.float32(1 / 0.08)
    counts = np.zeros(tuple(np.ceil((HIGH - LOW) / 0.08).astype(int)), np.int32)
    points = np.empty((frame.depth.size, 3), np.float32)

    def readings():
        reach = np.array([c.near, c.far], np.float32)
        n = kernels.open_readings(*pose, frame.depth, 2, reach, origin, inv_cell, counts, 5, points)
        return points[:n].copy()

    first = readings()
    valid = (frame.depth > c.near) & (frame.depth < c.far)
    whole = projection.unproject(frame.depth, frame.T_world_camera, c)[1::2, 1::2][valid[1::2, 1::2]]
    inside = ((whole >= LOW) & (whole < LOW + np.array(counts.shape) * 0.08)).all(axis=1)
    assert len(first) == inside.sum() > 50
    assert np.abs(first - whole[inside]).max() < 1e-4
    sums, below, squares, noises = (np.zeros(counts.shape, np.float32) for _ in range(4))
    values, noise = (np.full(len(first), a, np.float32) for a in (-0.5, 0.1))
    kernels.add_readings(first, values, noise, origin, inv_cell, sums, below, squares, noises, counts)
    assert counts.sum() == len(first) and np.allclose(noises, 0.1 * counts)
    assert np.allclose(sums, -0.5 * counts) and np.allclose(below, sums) and np.allclose(squares, 0.25 * counts)
    cells = tuple(np.floor((first - origin) * inv_cell).astype(int).T)
    assert len(readings()) == (counts[cells] < 5).sum()
