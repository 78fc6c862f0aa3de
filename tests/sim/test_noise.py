import numpy as np
import pytest

from active3d_pipe.sim.config import CameraSettings, SensorSettings
from active3d_pipe.sim.noise import apply_depth_sensor, frame_generator

CAMERA = CameraSettings(width=200, height=150, near=0.1, far=8.0).camera()


def reading(depth, seed=0, step=0, **settings):
    return apply_depth_sensor(depth.astype(np.float32), CAMERA, SensorSettings(**settings), frame_generator(seed, step))


def test_without_noise_only_rounding_changes_depth():
    depth = np.random.default_rng(0).uniform(0.2, 7, (150, 200))
    out = reading(depth)
    assert np.abs(out - depth).max() <= 0.5 / 8192 + 1e-6
    assert np.array_equal(reading(depth, depth_quantum_m=0), depth.astype(np.float32))


def test_noise_has_the_stated_spread():
    for z in (1.0, 3.0):
        out = reading(np.full((150, 200), z), depth_noise_base_m=0.002, depth_noise_per_m2=0.003)
        sigma = 0.002 + 0.003 * z**2
        assert out.std() == pytest.approx(sigma, rel=0.02)
        assert out.mean() == pytest.approx(z, abs=4 * sigma / np.sqrt(out.size))


def test_range_limits_of_camera_and_sensor():
    depth = np.tile([0.05, 0.3, 2.0, 5.0, 9.0, np.inf, 0.0, np.nan], (150, 25))
    assert (reading(depth)[0, :8] > 0).tolist() == [False, True, True, True, False, False, False, False]
    limited = reading(depth, min_range_m=0.5, max_range_m=4.0)
    assert (limited[0, :8] > 0).tolist() == [False, False, True, False, False, False, False, False]


def test_dropout_loses_the_stated_share():
    out = reading(np.full((150, 200), 2.0), dropout=0.25)
    assert (out == 0).mean() == pytest.approx(0.25, abs=0.01)
    assert (reading(np.full((150, 200), 2.0), dropout=1.0) == 0).all()


def test_seed_and_step_alone_decide():
    depth = np.full((150, 200), 2.0)
    settings = {"depth_noise_base_m": 0.01, "dropout": 0.1}
    first = reading(depth, 1, 2, **settings)
    assert np.array_equal(first, reading(depth, 1, 2, **settings))
    assert not np.array_equal(first, reading(depth, 1, 3, **settings))
    assert not np.array_equal(first, reading(depth, 2, 2, **settings))
