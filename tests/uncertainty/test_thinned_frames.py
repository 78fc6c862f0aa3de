"""The smaller images that residuals are measured on: exact colours, and depth that planes do not lose."""

import numpy as np
import pytest
from uncertainty_room import pose

from active3d_pipe.geometry import projection
from active3d_pipe.geometry.thinning import thinned
from active3d_pipe.structures import Camera, Frame

CAMERA = Camera.from_fov(120, 68, 90, far=50)
HEIGHT_M = 1.2


def floor_depth(camera, T):
    """(H, W) float32 depth of the plane z = 0."""
    d = projection.pixel_rays(camera).astype(np.float64) @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        return np.where(d[..., 2] < -0.02, -T[2, 3] / d[..., 2], 0).astype(np.float32)


@pytest.mark.parametrize("stride", [1, 2, 3, 4])
def test_a_plane_stays_a_plane_and_colours_are_block_means(stride):
    T = pose(0, (0.0, 0.0, HEIGHT_M), -25)
    rgb = np.random.default_rng(0).integers(0, 256, (68, 120, 3), dtype=np.uint8)
    f = Frame(0, 0, CAMERA, T, rgb, floor_depth(CAMERA, T))
    small_rgb, depth, camera = thinned(f, stride)
    assert depth.shape == (camera.height, camera.width) == (68 // stride, 120 // stride)
    near = (depth > 0) & (depth < 2.5)  # farther off, rows of this small image differ like an edge
    assert near.mean() > 0.25
    points = projection.unproject(depth, T, camera)[near]
    assert np.abs(points[:, 2]).max() < 1e-4
    h, w = camera.height * stride, camera.width * stride
    slow = rgb[:h, :w].reshape(camera.height, stride, camera.width, stride, 3).mean(axis=(1, 3)) / 255
    np.testing.assert_allclose(small_rgb, slow, atol=1e-6)


def test_nothing_is_averaged_across_edges_or_holes():
    depth = np.full((68, 120), 2.0, np.float32)
    depth[:, 61:] = 4.0
    depth[33:35, 21] = 0.0
    f = Frame(0, 0, CAMERA, pose(0), np.zeros((68, 120, 3), np.uint8), depth)
    assert set(np.unique(thinned(f, 2)[1])) == {0.0, 2.0, 4.0}
