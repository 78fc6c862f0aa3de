"""Residuals and their back-projection."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, maximum_filter
from uncertainty_room import CAMERA, frame, frames, pose, residual, room_grid

from active3d_pipe.errors import InputError
from active3d_pipe.geometry import projection
from active3d_pipe.structures import Camera
from active3d_pipe.uncertainty import kernels
from active3d_pipe.uncertainty.config import UncertaintySettings
from active3d_pipe.uncertainty.explicit import (
    MIN_VIEWS,
    MIN_WEIGHT,
    ViewResidual,
    backproject,
    explicit_uncertainty,
    most_uncertain,
    view_residuals,
)

S = UncertaintySettings()


def slow_backproject(grid, views, s):
    total, seen = np.zeros(grid.shape), np.zeros(grid.shape)
    for view in views:
        value, weight = np.zeros(grid.shape), np.zeros(grid.shape)
        points = projection.unproject(view.depth, view.T_world_camera, view.camera).astype(np.float64)
        e = view.normalised(s)
        for i in range(s.residual_stride // 2, e.shape[0], s.residual_stride):
            for j in range(s.residual_stride // 2, e.shape[1], s.residual_stride):
                if view.depth[i, j] <= 0:
                    continue
                p = (points[i, j] - grid.origin) / grid.voxel_size - 0.5
                low = np.floor(p).astype(int)
                for corner in np.ndindex(2, 2, 2):
                    ijk = low + corner
                    w = np.prod(np.where(corner, p - low, 1 - (p - low)))
                    if grid.contains_index(ijk):
                        value[tuple(ijk)] += w * e[i, j]
                        weight[tuple(ijk)] += w
        clear = weight >= MIN_WEIGHT
        total[clear] += value[clear] / weight[clear]
        seen[clear] += 1
    return total / np.maximum(seen, 1), seen / len(views)


def varied(f, seed):
    """A residual whose errors differ from pixel to pixel."""
    rng = np.random.default_rng(seed)
    depth = f.depth + rng.normal(0, 0.05, f.depth.shape)
    rgb = f.rgb / 255 + rng.normal(0, 0.05, f.rgb.shape)
    alpha = rng.uniform(0.5, 1, f.depth.shape)
    return view_residuals(rgb, depth, alpha, f.rgb, f.depth, f.camera, f.T_world_camera)


def test_residuals_follow_the_equations():
    f = frame(0, pose(0))
    observed = f.depth.copy()
    observed[:5] = 0
    rendered = f.rgb.astype(np.float32) / 255 + np.array([0.1, 0, -0.05], np.float32)
    got = view_residuals(rendered, f.depth + 0.2, np.ones_like(f.depth), f.rgb, observed, CAMERA, f.T_world_camera)
    np.testing.assert_allclose(got.depth_error[5:], 0.2, atol=1e-5)
    np.testing.assert_allclose(got.color_error[5:], 0.15, atol=1e-5)
    assert not got.depth_error[:5].any()
    assert not got.color_error[:5].any()
    assert not got.depth[:5].any()


def test_a_hole_in_the_map_is_as_wrong_as_can_be():
    f = frame(0, pose(0))
    hole = view_residuals(
        np.zeros_like(f.rgb, np.float32), np.full_like(f.depth, np.nan), np.zeros_like(f.depth), f.rgb, f.depth, CAMERA,
        f.T_world_camera,
    )
    np.testing.assert_allclose(hole.depth_error, f.depth)
    assert hole.normalised(S).min() > 0.5


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_backprojection_equals_slow_reference(stride):
    grid, s = room_grid(0.2), UncertaintySettings(residual_stride=stride)
    small = Camera.from_fov(24, 18, 80)
    views = [varied(frame(i, pose(40 * i), small), i) for i in range(3)]
    got, coverage = backproject(grid, views, s)
    slow, slow_coverage = slow_backproject(grid, views, s)
    assert (slow > 0).sum() > 100
    # A voxel whose weight sits on the threshold may fall on either side by rounding.
    same = np.abs(coverage - slow_coverage) < 1e-6
    assert same.mean() > 0.999
    np.testing.assert_allclose(got[same], slow[same], atol=2e-5)


def test_backprojection_lands_on_the_surface_and_is_deterministic():
    grid, fs = room_grid(), frames()
    views = [varied(f, i) for i, f in enumerate(fs)]
    got, coverage = backproject(grid, views, S)
    surface = np.zeros(grid.shape, bool)
    for f in fs:
        ijk = grid.index_of(projection.unproject(f.depth, f.T_world_camera, f.camera).reshape(-1, 3))
        surface[tuple(ijk[grid.contains_index(ijk)].T)] = True
    near = surface.copy()
    for axis in range(3):
        near |= np.roll(near, 1, axis) | np.roll(near, -1, axis)
    assert not (coverage > 0)[~near].any()
    assert got.min() >= 0
    assert got.max() <= 1
    assert got.tobytes() == backproject(grid, views, S)[0].tobytes()


def test_c_high_looks_where_the_last_round_was_worst():
    grid, fs = room_grid(), frames((0, 90, 180, 270))
    u = np.zeros(grid.shape, np.float32)
    for f, level in zip(fs, (0.1, 0.8, 0.0, 0.4)):
        ijk = grid.index_of(projection.unproject(f.depth, f.T_world_camera, f.camera).reshape(-1, 3))
        u[tuple(ijk[grid.contains_index(ijk)].T)] = level
    assert most_uncertain(grid, fs, u, UncertaintySettings(top_k_views=2)) == [1, 3]
    assert most_uncertain(grid, fs, u, UncertaintySettings(top_k_views=9)) == [1, 3, 0, 2]
    blind = frame(9, pose(0))
    blind = type(blind)(9, 0, blind.camera, blind.T_world_camera, blind.rgb, np.zeros_like(blind.depth))
    assert most_uncertain(grid, [blind, fs[0]], u, S) == [1, 0]
    assert most_uncertain(grid, [], u, S) == []


def test_u_exp_is_a_running_mean_over_the_views_that_saw_a_voxel():
    grid, s = room_grid(), UncertaintySettings(residual_stride=1, residual_blur_voxels=0, residual_memory=3)
    here, there = frame(0, pose(0)), frame(1, pose(180))
    first = explicit_uncertainty(grid, [residual(here, 0.2), residual(there, 0.02)], None, s)
    ahead, behind = (backproject(grid, [residual(f)], s)[1] > 0 for f in (here, there))
    high, low = -np.expm1(-0.2 / 0.05) / 2, -np.expm1(-0.02 / 0.05) / 2
    np.testing.assert_allclose(first[ahead & ~behind], high, atol=1e-3)
    np.testing.assert_allclose(first[behind & ~ahead], low, atol=1e-3)
    assert not first[~ahead & ~behind].any()
    # The map became perfect there: one view against three remembered ones.
    second = explicit_uncertainty(grid, [residual(here)], first, s)
    np.testing.assert_allclose(second[ahead & ~behind], high * 3 / 4, atol=1e-3)
    np.testing.assert_array_equal(second[behind & ~ahead], first[behind & ~ahead])
    np.testing.assert_array_equal(explicit_uncertainty(grid, [], first, s), first)


def test_blurred_residuals_keep_their_mean_and_reach_the_neighbours():
    grid, f = room_grid(), frame(0, pose(0))
    sharp, blurred = (
        explicit_uncertainty(grid, [residual(f, 0.2)], None, UncertaintySettings(residual_blur_voxels=b))
        for b in (0, 0.7)
    )
    level = -np.expm1(-0.2 / 0.05) / 2
    assert (blurred > 0).sum() > (sharp > 0).sum()
    assert ((blurred > 0) | (sharp == 0)).all()
    np.testing.assert_allclose(blurred[blurred > 0], level, atol=1e-3)


def test_views_without_a_reading_change_nothing():
    nothing = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    grid, blind = room_grid(0.19), ViewResidual(CAMERA, pose(0.0, (0.9, 1.1, 1.2)), nothing, nothing, nothing)
    before = np.random.default_rng(0).random(grid.shape).astype(np.float32)
    np.testing.assert_array_equal(explicit_uncertainty(grid, [blind], before, S), before)


def test_the_running_mean_is_that_of_blurred_sums():
    """SciPy's blur adds up in float64, so float32 sums differ in the last digit."""
    grid = room_grid(0.09)
    view = varied(frame(0, pose(17.0, (0.93, 1.12, 1.23))), 3)
    found, coverage = backproject(grid, [view], S)
    total, count = (
        gaussian_filter(a, S.residual_blur_voxels, mode="constant", truncate=2.0) for a in (found * coverage, coverage)
    )
    want = np.where(count > MIN_VIEWS, total / np.maximum(count, MIN_VIEWS), 0)
    np.testing.assert_allclose(explicit_uncertainty(grid, [view], None, S), want, rtol=2e-6)
    before = np.where(np.random.default_rng(0).random(grid.shape) < 0.5, 0.7, 0).astype(np.float32)
    kept = S.residual_memory * (before > 0)
    gain = np.where(count > MIN_VIEWS, count / np.maximum(count + kept, MIN_VIEWS), 0)
    again = explicit_uncertainty(grid, [view], before, S)
    np.testing.assert_allclose(again, before + gain * (want - before), rtol=1e-5, atol=1e-6)
    assert 0.05 < (want > 0).mean() < 0.8


def test_malformed_views_are_refused():
    f = frame(0, pose(0))
    with pytest.raises(InputError, match="NaN"):
        view_residuals(f.rgb / 255, f.depth * np.nan, np.ones_like(f.depth), f.rgb, f.depth, CAMERA, f.T_world_camera)
    with pytest.raises(InputError, match="depth_error"):
        type(residual(f))(CAMERA, f.T_world_camera, f.depth, f.depth[:3], f.depth)


def test_u_exp_is_masked_by_the_largest_attention_around():
    rng = np.random.default_rng(0)
    attention, u = rng.random((6, 5, 4), np.float32), rng.random((6, 5, 4), np.float32)
    u[rng.random(u.shape) < 0.3] = 0
    want = u * maximum_filter(attention, size=3, mode="nearest")
    kernels.near_attention(attention, u)
    np.testing.assert_array_equal(u, want)
