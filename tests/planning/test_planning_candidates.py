"""Views on a sphere of rays, and the kernels that thin positions and spread their values."""

import numpy as np
import pytest
from scipy.ndimage import correlate1d

from active3d_pipe.planning.candidates import view_directions
from active3d_pipe.planning.kernels_candidates import best_of_blocks, spread_values
from active3d_pipe.structures import Camera


@pytest.mark.parametrize("hfov", [3.0, 8.0, 15.0, 90.0])
def test_views_of_any_camera_hold_rays_of_about_their_solid_angle(hfov):
    f = 300 / np.tan(np.radians(hfov) / 2)
    d = view_directions(Camera(600, 340, f, f, 300, 170, 0.1, 10.0), 12, (-60.0, 0.0, 60.0))
    a, b = 300 / f, 170 / f
    whole = 4 * np.arcsin(a * b / np.sqrt((1 + a * a) * (1 + b * b)))
    found = d.members @ d.solid_angles
    assert (found > 0).all() and found.mean() == pytest.approx(whole, rel=0.25)


def test_best_of_blocks_is_the_clearest_then_the_middle_then_the_first():
    rng = np.random.default_rng(3)
    allowed = (rng.random((11, 7, 6)) < 0.3).astype(np.uint8)
    clearance = rng.integers(0, 3, allowed.shape).astype(np.float32)
    for block in (1, 2, 3, 5):
        slow: dict[tuple, tuple] = {}
        for v in map(tuple, np.argwhere(allowed).tolist()):
            away = sum(abs(c % block - (block - 1) / 2) for c in v)
            rank = (-clearance[v], away, v)
            key = tuple(c // block for c in v)
            slow[key] = min(slow.get(key, rank), rank)
        found = best_of_blocks(allowed, clearance, block)
        assert [tuple(v) for v in found.tolist()] == [slow[key][2] for key in sorted(slow)]
    assert best_of_blocks(np.zeros((3, 3, 3), np.uint8), np.zeros((3, 3, 3), np.float32), 2).shape == (0, 3)


def test_spread_is_a_truncated_filter_over_sparse_values():
    shape = (12, 9, 8)
    positions = np.array([[0, 0, 0], [6, 4, 3], [11, 8, 7], [6, 5, 3]])
    values = np.array([2.0, 1.0, 5.0, 0.5], np.float32)
    kernel = np.array([0.1, 0.2, 0.4, 0.2, 0.1], np.float32)
    total, weight = spread_values(positions, values, kernel, shape)
    for found, source in ((total, values), (weight, np.ones(4, np.float32))):
        dense = np.zeros(shape, np.float64)
        dense[tuple(positions.T)] = source
        for axis in range(3):
            dense = correlate1d(dense, kernel.astype(np.float64), axis=axis, mode="constant")
        np.testing.assert_allclose(found, dense, atol=1e-6)


def test_views_hold_the_rays_in_their_frustum():
    camera = Camera.from_fov(600, 340, 90)
    d = view_directions(camera, 24, (0.0,))
    assert d.solid_angles.sum() == pytest.approx(4 * np.pi, rel=1e-4)
    # Solid angle of a rectangular pyramid (textbook formula).
    a, b = 300 / 300, 170 / 300
    want = 4 * np.arctan(a * b / np.sqrt(1 + a * a + b * b))
    np.testing.assert_allclose(d.members @ d.solid_angles, want, rtol=0.08)
    along = d.rays @ d.rotations[3][:, 2]
    assert d.members[3][along.argmax()] == 1
    assert d.members[3][along < 0].sum() == 0
    assert d.angles[0, 1] == pytest.approx(np.radians(15), abs=1e-5)


def test_the_rays_of_the_sphere_are_as_far_apart_at_its_poles_as_elsewhere():
    d = view_directions(Camera.from_fov(600, 340, 90), 4, (0.0,))
    cos = np.sort(d.rays.astype(np.float64) @ d.rays.T.astype(np.float64), axis=1)[:, -2]
    apart = np.degrees(np.arccos(cos))
    assert apart.min() > 5 and apart.max() < 8
    assert d.solid_angles.max() < 1.5 * d.solid_angles.min()
