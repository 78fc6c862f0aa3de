"""Residuals and their back-projection."""

import numpy as np
import pytest
from uncertainty_room import CAMERA, frame, frames, pose, residual, room_grid

from active3d_pipe.errors import InputError
from active3d_pipe.geometry import projection
from active3d_pipe.structures import Camera
from active3d_pipe.uncertainty.config import UncertaintySettings
from active3d_pipe.uncertainty.explicit import (
    MIN_WEIGHT,
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


def test_c_high_holds_the_worst_views():
    fs = frames((0, 20, 40, 60))
    views = [residual(f, depth_error=e) for f, e in zip(fs, (0.01, 0.2, 0.0, 0.05))]
    assert most_uncertain(views, UncertaintySettings(top_k_views=2)) == [1, 3]
    assert most_uncertain(views, S) == [1, 3, 0, 2]


def test_worst_views_decide_and_the_rest_fills_in():
    grid = room_grid()
    worst, other, twin = frame(0, pose(0)), frame(1, pose(180)), frame(2, pose(0))
    views = [residual(worst, 0.2), residual(other, 0.02), residual(twin, 0.0)]
    s = UncertaintySettings(top_k_views=1)
    u = explicit_uncertainty(grid, views, None, s)
    ahead, behind = (backproject(grid, [v], s)[1] > 0 for v in views[:2])
    expected_worst, expected_other = -np.expm1(-0.2 / 0.05) / 2, -np.expm1(-0.02 / 0.05) / 2
    np.testing.assert_allclose(u[ahead], expected_worst, atol=1e-3)
    np.testing.assert_allclose(u[behind & ~ahead], expected_other, atol=1e-3)
    kept = explicit_uncertainty(grid, [], u, s)
    np.testing.assert_array_equal(kept, u)


def test_malformed_views_are_refused():
    f = frame(0, pose(0))
    with pytest.raises(InputError, match="NaN"):
        view_residuals(f.rgb / 255, f.depth * np.nan, np.ones_like(f.depth), f.rgb, f.depth, CAMERA, f.T_world_camera)
    with pytest.raises(InputError, match="depth_error"):
        type(residual(f))(CAMERA, f.T_world_camera, f.depth, f.depth[:3], f.depth)
