import dataclasses

import numpy as np
import pytest
from room_with_ball import scene_color, scene_sdf

from active3d_pipe.errors import InputError
from active3d_pipe.field.config import FieldSettings
from active3d_pipe.field.rays import points_on_rays, sample_depths, sample_rays, surface_points
from active3d_pipe.geometry import se3
from active3d_pipe.geometry.sensor_noise import sensor_noise
from active3d_pipe.structures import Camera, Frame


def test_rays_end_on_the_surface_they_saw(frames):
    b = sample_rays(frames, 500, np.random.default_rng(0))
    hits = points_on_rays(b, b.depth[:, None])
    assert b.valid.all() and len(b) == 500
    np.testing.assert_allclose(scene_sdf(hits), 0, atol=1e-5)
    np.testing.assert_allclose(b.color, scene_color(hits), atol=1 / 255 + 1e-6)


def test_surface_points_are_readings(frames):
    f = frames[0]
    hole = f.depth.copy()
    hole[:, :40] = 0
    for given, most in ((frames, 300), ([dataclasses.replace(f, depth=hole)], 400)):
        points = surface_points(given, most, np.random.default_rng(0))
        assert points.dtype == np.float32 and 0.8 * most < len(points) <= most
        np.testing.assert_allclose(scene_sdf(points), 0, atol=1e-5)
    assert surface_points([dataclasses.replace(f, depth=0 * hole)], 9, np.random.default_rng(0)).shape == (0, 3)
    assert surface_points(frames, 0, np.random.default_rng(0)).shape == (0, 3)


def test_slope_gives_the_distance_to_the_surface(frames):
    b = sample_rays(frames, 2000, np.random.default_rng(1))
    before = points_on_rays(b, b.depth[:, None] - 0.005)
    # Near the hit the distance is 5 mm times the slope, except next to corners and silhouettes.
    error = np.abs(scene_sdf(before) - 0.005 * np.maximum(b.slope, 0.1))
    assert np.quantile(error, 0.9) < 3e-4
    assert b.slope.std() > 0.1


def test_slopes_stand_noise_when_it_is_told(frames):
    rng, sigma = np.random.default_rng(5), 0.01
    noisy = [dataclasses.replace(f, depth=f.depth + rng.normal(0, sigma, f.depth.shape).astype(np.float32))
             for f in frames]
    found = sensor_noise(noisy)
    assert found[2] == pytest.approx(sigma, rel=0.15)
    exact = sample_rays(frames, 2000, np.random.default_rng(1)).slope
    near = sample_rays(noisy, 2000, np.random.default_rng(1)).slope
    far = sample_rays(noisy, 2000, np.random.default_rng(1), noise=found).slope
    assert np.abs(far - exact).mean() < 0.6 * np.abs(near - exact).mean()
    # Told that there is none, the neighbours are the next pixels, to the bit.
    told = sample_rays(frames, 2000, np.random.default_rng(1), noise=sensor_noise(frames)).slope
    assert np.array_equal(told, exact)


def test_pixels_without_reading_are_avoided_or_marked(frames):
    f = frames[0]
    hole = f.depth.copy()
    hole[:, :40] = 0
    b = sample_rays([dataclasses.replace(f, depth=hole)], 400, np.random.default_rng(0))
    assert b.valid.mean() > 0.85  # half are holes, four draws each
    assert (b.depth[~b.valid] == 0).all() and (b.depth[b.valid] > 0).all()
    b = sample_rays([dataclasses.replace(f, depth=np.zeros_like(f.depth))], 10, np.random.default_rng(0))
    assert not b.valid.any() and np.isfinite(b.slope).all()


def test_readings_beyond_the_range_do_not_count():
    camera = Camera.from_fov(20, 10, 90, far=2.0)
    f = Frame(0, 0, camera, se3.look_at([0, 0, 0], [1, 0, 0]), np.zeros((10, 20, 3), np.uint8),
              np.full((10, 20), 3.0, np.float32))
    assert not sample_rays([f], 5, np.random.default_rng(0)).valid.any()


def test_weights_choose_the_frames(frames):
    weights = np.zeros(len(frames))
    weights[3] = 1
    b = sample_rays(frames, 50, np.random.default_rng(0), weights)
    np.testing.assert_allclose(b.origins, np.tile(frames[3].T_world_camera[:3, 3], (50, 1)), atol=1e-6)


def test_depths_are_sorted_and_stay_in_front_of_the_truncation(frames):
    s = FieldSettings(behind_fraction=0.5)
    b = sample_rays(frames, 300, np.random.default_rng(0))
    free, near = sample_depths(b, s, np.random.default_rng(1))
    z = np.concatenate([free, near], axis=1)
    assert free.shape == (300, s.free_samples) and near.shape == (300, s.surface_samples)
    assert (np.diff(z, axis=1) >= 0).all() and (z >= 0).all()
    assert (near <= b.depth[:, None] + 0.5 * s.truncation_m + 1e-6).all()
    assert (free <= np.maximum(b.depth[:, None] - s.truncation_m, 0) + 1e-6).all()


def test_no_frames_is_an_error():
    with pytest.raises(InputError, match="key frame"):
        sample_rays([], 4, np.random.default_rng(0))
