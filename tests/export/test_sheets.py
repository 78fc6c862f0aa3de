"""Faces through readings off the mesh: leaves are laid, noise around a wall is not, and every cell comes once."""

import numpy as np
import pytest

from active3d_pipe.export import kernels_sheets as kernels
from active3d_pipe.export.config import MeshSettings
from active3d_pipe.export.sheets import with_sheets
from active3d_pipe.geometry import projection, se3
from active3d_pipe.geometry.raycasting import SurfaceIndex
from active3d_pipe.structures import Camera, Frame, TriangleMesh

CAMERA = Camera.from_fov(120, 90, 70.0, far=8)
FINE = Camera.from_fov(480, 360, 70.0, far=8)
WALL_Y, LEAF_Y, LEAF = 2.0, 1.2, 0.12  # planes across y; half the side of the leaf, around the origin of x and z
SETTINGS = MeshSettings()
BOX = np.array([-3.0, -0.5, -2.5]), np.array([3.0, 2.5, 2.5])


def wall(step: float = 0.02) -> TriangleMesh:
    """The plane y = WALL_Y as triangles the size of marching cubes'."""
    xs, zs = np.arange(-2.5, 2.5, step), np.arange(-2, 2, step)
    x, z = np.meshgrid(xs, zs, indexing="ij")
    vertices = np.stack([x, np.full_like(x, WALL_Y), z], -1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(len(xs) - 1)[:, None] * len(zs) + np.arange(len(zs) - 1)).ravel()
    a, b, c, d = corner, corner + 1, corner + len(zs), corner + len(zs) + 1
    return TriangleMesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)]).astype(np.int32))


def frames(leaf: bool = True, noise: float = 0.0, count: int = 8) -> list[Frame]:
    """Views of the wall, and of a leaf before it that the mesh has not, from places in a row."""
    rng, out = np.random.default_rng(0), []
    for i, x in enumerate(np.linspace(-0.5, 0.5, count)):
        T = se3.look_at(np.array([x, 0.0, 0.1]), np.array([0.2 * x, WALL_Y, 0.0]))
        rays = projection.pixel_rays(CAMERA).astype(np.float64) @ T[:3, :3].T
        depth = (WALL_Y - T[1, 3]) / rays[..., 1]
        if leaf:
            nearer = (LEAF_Y - T[1, 3]) / rays[..., 1]
            at = T[:3, 3] + nearer[..., None] * rays
            depth = np.where((np.abs(at[..., 0]) < LEAF) & (np.abs(at[..., 2]) < LEAF), nearer, depth)
        depth = (depth * (1 + noise * rng.standard_normal(depth.shape))).astype(np.float32)
        out.append(Frame(i, i, CAMERA, T, np.zeros((*depth.shape, 3), np.uint8), depth))
    return out


def distances(mesh: TriangleMesh, points: np.ndarray) -> np.ndarray:
    return SurfaceIndex(mesh.vertices, mesh.faces).distance(points.astype(np.float32))


def test_a_leaf_is_laid_where_it_was_read_and_nothing_else_changes() -> None:
    before = wall()
    after = with_sheets(before, frames(), *BOX, SETTINGS)
    assert np.array_equal(after.vertices[: len(before.vertices)], before.vertices)
    assert np.array_equal(after.faces[: len(before.faces)], before.faces)
    new = after.vertices[len(before.vertices) :]
    assert len(new) > 50
    assert np.abs(new[:, 1] - LEAF_Y).max() < 1e-4 and np.abs(new[:, [0, 2]]).max() < LEAF + 0.01
    x, z = np.meshgrid(*[np.linspace(-LEAF, LEAF, 15)] * 2)
    leaf = np.stack([x, np.full_like(x, LEAF_Y), z], -1).reshape(-1, 3)
    assert distances(before, leaf).min() > 0.5
    assert np.quantile(distances(after, leaf), 0.95) < 0.02
    area = TriangleMesh(after.vertices, after.faces[len(before.faces) :]).area_m2
    assert 0.7 * (2 * LEAF) ** 2 < area < 1.3 * (2 * LEAF) ** 2  # once, though eight frames saw it
    corners = after.vertices[after.faces[len(before.faces) :]].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 1] < 0).all()  # towards the cameras


@pytest.mark.parametrize(("few", "frames_needed"), [(2, 3), (8, 0), (0, 3)])
def test_too_few_frames_lay_nothing(few: int, frames_needed: int) -> None:
    before = wall()
    settings = SETTINGS.model_copy(update={"sheet_frames": frames_needed})
    assert len(with_sheets(before, frames(count=max(few, 1))[:few], *BOX, settings).faces) == len(before.faces)


@pytest.mark.parametrize(("noise", "share"), [(0.005, 0.0001), (0.01, 0.002), (0.02, 0.01)])
def test_noise_around_a_wall_is_no_surface(noise: float, share: float) -> None:
    before = wall()
    after = with_sheets(before, frames(leaf=False, noise=noise, count=24), *BOX, SETTINGS)
    area = TriangleMesh(after.vertices, after.faces[len(before.faces) :]).area_m2
    assert area < share * before.area_m2


def test_without_a_mesh_everything_is_laid() -> None:
    nothing = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    after = with_sheets(nothing, frames(), *BOX, SETTINGS)
    assert np.abs(after.vertices[:, 1] - WALL_Y).min() < 1e-3 and len(after.faces) > 5000


def slanted(degrees: float, gap: float) -> list[Frame]:
    """Views along a floor at so many degrees from it; from x = 0.5 on it lies `gap` m higher."""
    out, slope = [], np.tan(np.radians(degrees))
    for i, x in enumerate(np.linspace(-0.1, 0.1, 4)):
        T = se3.look_at(np.array([x - 1.5, 0.0, 1.5 * slope]), np.array([x, 0.0, 0.0]))
        rays = projection.pixel_rays(FINE).astype(np.float64) @ T[:3, :3].T
        depth = np.zeros(rays.shape[:2])
        for height in (0.0, gap):
            with np.errstate(divide="ignore"):
                t = (height - T[2, 3]) / rays[..., 2]
            at = T[:3, 3] + t[..., None] * rays
            side = at[..., 0] < 0.5 if height == 0.0 else at[..., 0] >= 0.5
            near = (t > 0) & (np.abs(at[..., 0] - 0.5) < 0.6) & (np.abs(at[..., 1]) < 0.4)
            depth = np.where(near & side & ((depth == 0) | (t < depth)), t, depth)
        out.append(Frame(i, i, FINE, T, np.zeros((*depth.shape, 3), np.uint8), depth.astype(np.float32)))
    return out


def test_a_floor_seen_at_a_slant_is_laid_and_a_step_in_it_is_not_bridged() -> None:
    nothing = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    views = slanted(12.0, gap=0.05)
    after = with_sheets(nothing, views, np.array([-1.0, -1, -0.5]), np.array([2.0, 1, 0.5]), SETTINGS)
    corners = after.vertices[after.faces]
    assert (np.ptp(corners[..., 2], axis=1) < 1e-3).all()  # level: none joins the floor with the step
    x, y = np.meshgrid(np.linspace(0.1, 0.4, 12), np.linspace(-0.2, 0.2, 9))
    floor = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    assert np.quantile(distances(after, floor), 0.9) < 0.04


def test_votes_match_a_plain_loop() -> None:
    rng = np.random.default_rng(3)
    frame = frames(noise=0.02)[2]
    points = rng.uniform([-1, 0.2, -1], [1, 2.5, 1], (400, 3)).astype(np.float32)
    agree, other = np.zeros(400, np.int32), np.zeros(400, np.int32)
    T = frame.T_world_camera.astype(np.float32)
    c = CAMERA
    intrinsics = np.array([c.fx, c.fy, c.cx, c.cy], np.float32)
    kernels.vote(
        points, np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]), intrinsics, frame.depth,
        np.float32(c.near), np.float32(0.05), np.float32(0.2), agree, other,
    )
    uv, z = projection.project(points, frame.T_world_camera, c)
    for n in range(400):
        column, row = np.floor(uv[n]).astype(int)
        if z[n] <= c.near or not (0 <= column < c.width and 0 <= row < c.height):
            assert agree[n] == other[n] == 0
            continue
        gap = frame.depth[row, column] - z[n]
        if min(abs(abs(gap) - 0.05), abs(gap + 0.2)) > 1e-4:
            assert agree[n] == (abs(gap) <= 0.05) and other[n] == (abs(gap) > 0.05 and gap > -0.2)


@pytest.mark.parametrize("stride", [1, 2])
def test_open_pixels_against_a_slow_reference(stride: int) -> None:
    frame, size = frames()[2], 0.107
    frame.depth[:20] = 0
    low = BOX[0].astype(np.float32)
    marks = np.random.default_rng(3).integers(0, 4, (60, 30, 40)).astype(np.uint8)
    c, T = frame.camera, frame.T_world_camera.astype(np.float32)
    pose = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
    lens = np.array([c.fx, c.fy, c.cx, c.cy], np.float32)
    lattice = np.float32(c.near), low, np.float32(1 / size), marks
    cells, pixels = np.empty(frame.depth.size, np.int64), np.empty(frame.depth.size, np.int32)
    count = kernels.open_pixels(*pose, lens, frame.depth, stride, *lattice, cells, pixels)
    at = (projection.unproject(frame.depth, frame.T_world_camera, c) - low) / size
    doubtful = (np.abs(at - np.rint(at)) < 1e-4).any(axis=-1)  # rounding may put them on either side
    index = np.floor(at).astype(int)
    inside = ((index >= 0) & (index < marks.shape)).all(axis=-1) & (frame.depth > 0)
    flat = np.ravel_multi_index(tuple(np.where(inside[..., None], index, 0).T), marks.shape).T
    want = np.where(inside & (marks.reshape(-1)[flat] & 1 == 0), flat, -1)
    taken = np.zeros(frame.depth.shape, bool)
    taken[::stride, ::stride] = True
    got = np.full(frame.depth.size, -1)
    got[pixels[:count]] = cells[:count]
    sure = ~doubtful & taken
    assert (got.reshape(want.shape)[sure] == want[sure]).all() and (got.reshape(want.shape)[~taken] == -1).all()
    assert (want[sure] >= 0).sum() > 200 and (np.diff(pixels[:count]) > 0).all()
    whole = np.empty(frame.depth.shape, np.int64)
    kernels.reading_cells(*pose, lens, frame.depth, *lattice, whole)
    assert (whole[~doubtful] == want[~doubtful]).all()
