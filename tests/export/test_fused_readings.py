"""Noisy readings are fused where there are many; exact ones leave the field alone."""

import numpy as np
import pytest

from active3d_pipe.export import fused_readings
from active3d_pipe.export.config import MeshSettings
from active3d_pipe.export.fused_readings import fused_if_noisy
from active3d_pipe.geometry import projection, se3
from active3d_pipe.geometry.sensor_noise import sensor_noise, typical_noise
from active3d_pipe.structures import Camera, Frame

CAMERA = Camera.from_fov(120, 90, 70.0, far=8)
LOW, HIGH = np.array([-3.0, -0.5, -2.5], np.float32), np.array([3.0, 2.5, 2.5], np.float32)
SETTINGS = MeshSettings()
WALL_Y = 2.0


def frames(noise_m: float, count: int = 30) -> list[Frame]:
    """Views of the wall y = WALL_Y from places in a row."""
    rng, out = np.random.default_rng(1), []
    for i, x in enumerate(np.linspace(-0.5, 0.5, count)):
        T = se3.look_at(np.array([x, 0.0, 0.1]), np.array([0.2 * x, WALL_Y, 0.0]))
        rays = projection.pixel_rays(CAMERA).astype(np.float64) @ T[:3, :3].T
        depth = (WALL_Y - T[1, 3]) / rays[..., 1] + rng.normal(0, noise_m, rays.shape[:2])
        out.append(Frame(i, i, CAMERA, T, np.zeros((*depth.shape, 3), np.uint8), depth.astype(np.float32)))
    return out


def biased(points: np.ndarray) -> np.ndarray:
    """A field whose wall stands a centimetre off."""
    return (WALL_Y + 0.01 - points[:, 1]).astype(np.float32)


def test_noisy_readings_outvote_the_field_where_there_are_many() -> None:
    noisy = frames(0.02)
    assert typical_noise(sensor_noise(noisy), noisy) == pytest.approx(0.02, rel=0.1)
    query = fused_if_noisy(biased, LOW, HIGH, noisy, SETTINGS)
    at_wall = np.random.default_rng(0).uniform([-0.4, WALL_Y, -0.4], [0.4, WALL_Y, 0.4], (500, 3)).astype(np.float32)
    assert np.abs(query(at_wall)).mean() < 0.004  # the field says 1 cm, one reading 2 cm
    unseen = at_wall + np.float32([0, 0.3, 0])
    assert np.array_equal(query(unseen), biased(unseen))


def test_exact_or_few_readings_leave_the_field_alone() -> None:
    exact = frames(0.0)
    assert typical_noise(sensor_noise(exact), exact) < 1e-4
    assert fused_if_noisy(biased, LOW, HIGH, frames(0.0), SETTINGS) is biased
    assert fused_if_noisy(biased, LOW, HIGH, [], SETTINGS) is biased
    never = SETTINGS.model_copy(update={"fuse_noise_m": 0.0})
    assert fused_if_noisy(biased, LOW, HIGH, frames(0.02), never) is biased
    few = fused_if_noisy(biased, LOW, HIGH, frames(0.02, count=4), SETTINGS)
    points = np.random.default_rng(0).uniform([-0.4, 1.9, -0.4], [0.4, 2.1, 0.4], (100, 3)).astype(np.float32)
    assert np.array_equal(few(points), biased(points))


def test_a_scene_too_large_to_fuse_keeps_the_field(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fused_readings, "MOST_MEGABYTES", 0.5)
    assert fused_if_noisy(biased, LOW, HIGH, frames(0.02), SETTINGS) is biased


def test_without_a_reading_there_is_no_noise() -> None:
    nothing = frames(0.02, count=2)
    for frame in nothing:
        frame.depth[:] = 0
    assert typical_noise(sensor_noise(nothing), nothing) == 0.0
