"""TSDF fusion against a slow reference, and views of a surface."""

from dataclasses import replace

import numpy as np
import pytest
from room_with_ball import HIGH, LOW, RADIUS, SPHERE, render, scene_color, scene_sdf, seen_by

from active3d_pipe.errors import ArtifactError, ConfigError
from active3d_pipe.field.config import TsdfSettings
from active3d_pipe.field.surface_view import SurfaceView
from active3d_pipe.field.tsdf import TsdfField
from active3d_pipe.geometry import projection, se3
from active3d_pipe.structures import Camera

SETTINGS = TsdfSettings(voxel_m=0.03, truncation_m=0.09)


@pytest.fixture(scope="module")
def fused(frames):
    tsdf = TsdfField(LOW - 0.2, HIGH + 0.2, SETTINGS)
    tsdf.integrate(frames)
    return tsdf


BLOCK_M = 8 * SETTINGS.voxel_m


def blocks_near(frame):
    """Set of the blocks that every second reading, or a truncation before or behind it, lies in."""
    z = frame.depth.astype(float)[..., None] + SETTINGS.truncation_m * np.array([-1, 0, 1])
    rays = projection.pixel_rays(frame.camera).astype(float) @ frame.T_world_camera[:3, :3].T
    points = (rays[..., None, :] * z[..., None] + frame.T_world_camera[:3, 3])[::2, ::2]
    return set(map(tuple, np.floor((points.reshape(-1, 3) - (LOW - 0.2)) / BLOCK_M).astype(int)))


def reference(frames, centres):
    """(N, 6) by the definition, voxel by voxel: mean distance, its weight, mean colour, its weight.

    A frame says something of the blocks near its readings.
    """
    out = np.zeros((len(centres), 6))
    block = list(map(tuple, np.floor((centres - (LOW - 0.2)) / BLOCK_M).astype(int)))
    for f in frames:
        near = blocks_near(f)
        uv, z = projection.project(centres, f.T_world_camera, f.camera)
        at = np.flatnonzero(projection.in_image(uv, z, f.camera) & [b in near for b in block])
        j, i = np.floor(uv[at]).astype(int).T
        gap = f.depth[i, j] - z[at]
        keep = (f.depth[i, j] > 0) & (gap >= -SETTINGS.truncation_m)
        at, i, j, gap = at[keep], i[keep], j[keep], gap[keep]
        w = out[at, 1]
        out[at, 0] = (out[at, 0] * w + np.minimum(gap / SETTINGS.truncation_m, 1)) / (w + 1)
        out[at, 1] += 1
        near = gap <= SETTINGS.truncation_m
        at, i, j = at[near], i[near], j[near]
        w = out[at, 5:]
        out[at, 2:5] = (out[at, 2:5] * w + f.rgb[i, j] / 255.0) / (w + 1)
        out[at, 5] += 1
    return out


def some_voxels(tsdf, count=4000):
    """(centres, values) of voxels in allocated blocks."""
    rng = np.random.default_rng(0)
    blocks, voxels = (tsdf.state()[n] for n in ("blocks", "voxels"))
    row, v = rng.integers(len(blocks), size=count), rng.integers(512, size=count)
    ijk = blocks[row] * 8 + np.stack(np.unravel_index(v, (8, 8, 8)), axis=1)
    return (LOW - 0.2 + (ijk + 0.5) * SETTINGS.voxel_m).astype(np.float64), voxels[row, v]


@pytest.mark.parametrize(("count", "most"), [(1, 1), (6, 4), (24, 7)])
def test_fused_frames_equal_the_reference(frames, count, most):
    """Means over the frames; every frame shows the room in another light."""
    lit = [replace(f, rgb=(f.rgb * (0.3 + 0.1 * (i % 7))).astype(np.uint8)) for i, f in enumerate(frames[:count])]
    tsdf = TsdfField(LOW - 0.2, HIGH + 0.2, SETTINGS)
    tsdf.integrate(lit)
    centres, found = some_voxels(tsdf)
    expected = reference(lit, centres)
    # float32 may put a voxel on the other side of a pixel's border
    same = (expected[:, 1] == found[:, 1]) & (expected[:, 5] == found[:, 5])
    assert same.mean() > 0.99 and (found[:, 1] > 0).sum() > 500 and found[:, 1].max() >= most
    close = np.abs(found - expected)[same].max(axis=1) < 1e-3
    assert close.mean() > 0.99


def test_surface_colour_and_free_space(fused, frames):
    rng = np.random.default_rng(1)
    d = rng.normal(size=(2000, 3))
    p = SPHERE + RADIUS * d / np.linalg.norm(d, axis=1, keepdims=True)
    p = p[seen_by(frames, p)]
    sdf, sigma = fused.query_geometry(p)
    assert np.abs(sdf).mean() < 0.02 and sigma.max() < 0.02
    assert np.abs(fused.query_color(p) - scene_color(p)).mean() < 0.1
    cosine = (fused.normals(p) * (p - SPHERE) / RADIUS).sum(axis=1)
    assert np.median(cosine) > 0.95
    free = rng.uniform(LOW, HIGH, (2000, 3))
    free = free[scene_sdf(free) > 0.2]
    assert (fused.query_sdf(free) > 0).mean() > 0.99
    outside = np.array([[50.0, 0, 0]])
    assert fused.query_sdf(outside)[0] == np.float32(SETTINGS.truncation_m)
    assert fused.query_geometry(outside)[1][0] == np.float32(SETTINGS.sigma_prior_m)


def test_fusion_in_parts_and_after_a_resume_has_the_same_bytes(fused, frames):
    first = TsdfField(LOW - 0.2, HIGH + 0.2, SETTINGS)
    first.integrate(frames[:10])
    second = TsdfField(LOW - 0.2, HIGH + 0.2, SETTINGS)
    second.load_state(first.state())
    for tsdf in (first, second):
        tsdf.integrate(frames[10:])
    assert all(a.tobytes() == second.state()[n].tobytes() for n, a in first.state().items())
    p = np.random.default_rng(2).uniform(LOW, HIGH, (3000, 3))
    assert np.array_equal(fused.query_sdf(p), first.query_sdf(p))


@pytest.fixture
def part(frames):
    """The first frames fused in a part of the room; points whose eight voxels lie in blocks of that part."""
    tsdf = TsdfField(LOW - 0.2, [0.4, *(HIGH[1:] + 0.2)], SETTINGS)
    tsdf.integrate(frames[:12])
    p = np.random.default_rng(3).uniform(LOW - 0.1, [0.4 - BLOCK_M, *HIGH[1:]], (3000, 3))
    return tsdf, p


def test_growth_leaves_what_was_fused(part):
    """At once and bit by bit, by no multiple of a block."""
    small, p = part
    before, color = small.query_geometry(p), small.query_color(p)
    assert before[0].std() > 0.01 and color.std() > 0.1
    low, high = LOW - [0.53, 0.2, 0.71], np.add(HIGH, [0.9, 0.2, 0.37])
    for grown in (small.grown(low, high), small.grown(LOW - 0.2, HIGH + 0.2).grown(low, high)):
        assert np.array_equal(grown.box, [low, high]) and np.array_equal(grown.anchor, small.box)
        assert len(grown.state()["blocks"]) == len(small.state()["blocks"])
        for old, new in zip(before, grown.query_geometry(p)):
            np.testing.assert_allclose(new, old, atol=1e-5)
        np.testing.assert_allclose(grown.query_color(p), color, atol=1e-4)
    assert np.array_equal(small.grown(LOW, HIGH - 1).box, [LOW - 0.2, [0.4, *(HIGH[1:] + 0.2)]])  # never smaller


def test_a_grown_field_fuses_on_as_if_it_had_been_whole(part, fused, frames):
    small, p = part
    grown = small.grown(LOW - [0.53, 0.2, 0.2], HIGH + 0.2)
    grown.integrate(frames[12:])
    for whole, new in zip(fused.query_geometry(p), grown.query_geometry(p)):
        # Rounding of the lowest corner puts a voxel in another pixel now and then.
        assert (np.abs(new - whole) < 1e-4).mean() > 0.99
    beyond = np.random.default_rng(4).uniform([0.7, *LOW[1:]], HIGH, (2000, 3))
    assert (small.query_geometry(beyond)[1] == SETTINGS.sigma_prior_m).all()
    assert (grown.query_geometry(beyond)[1] < SETTINGS.sigma_prior_m).mean() > 0.1
    again = TsdfField(*grown.box, SETTINGS, grown.anchor)
    again.load_state(grown.state())
    assert again.query_sdf(p).tobytes() == grown.query_sdf(p).tobytes()


def test_states_and_sizes_that_do_not_fit_are_refused(fused):
    with pytest.raises(ArtifactError, match="belongs to other bounds"):
        TsdfField(LOW, LOW + 0.5, SETTINGS).load_state(fused.state())
    with pytest.raises(ArtifactError):
        TsdfField(LOW, HIGH, SETTINGS).load_state({})
    with pytest.raises(ConfigError, match="low < high"):
        TsdfField(LOW, LOW, SETTINGS)


class Analytic:
    """The room itself, as a surface."""

    low, high = (LOW - 0.2).astype(np.float32), (HIGH + 0.2).astype(np.float32)

    def query_sdf(self, points):
        return np.clip(scene_sdf(points), -0.1, 0.1).astype(np.float32)

    def query_color(self, points):
        return scene_color(points)


def test_views_of_a_surface_are_those_of_the_scene(fused):
    camera = Camera.from_fov(80, 60, 90)
    T = se3.pose_from_yaw_pitch(np.array([-0.6, -0.7, 0.8]), 0.8, -0.1)
    truth = render(camera, T)
    rgb, depth, alpha = SurfaceView(Analytic()).render(camera, T)
    assert alpha.min() == 1 and rgb.dtype == depth.dtype == np.float32
    assert np.quantile(np.abs(depth - truth.depth), 0.98) < 2e-3
    assert np.abs(rgb - truth.rgb / 255).mean() < 0.01
    _, depth, alpha = SurfaceView(fused).render(camera, T)
    assert (alpha > 0).mean() > 0.9
    assert np.median(np.abs(depth - truth.depth)[alpha > 0]) < 0.01
    away = se3.pose_from_yaw_pitch(HIGH + 3.0, 0.8, 0.3)
    rgb, depth, alpha = SurfaceView(Analytic()).render(camera, away)
    assert not alpha.any() and not depth.any() and not rgb.any()
