"""Spheres, the pull towards them, and seeding one primitive a pixel."""

import numpy as np
import pytest
import torch

from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.optimisation import optimise_step
from active3d_pipe.gaussians.parameters import LOG_SCALES, QUATS, GaussianParameters
from active3d_pipe.gaussians.rasteriser import RenderedView, render_view
from active3d_pipe.gaussians.seeding import discs, seed_frame
from active3d_pipe.gaussians.shape import isotropy_gradient
from active3d_pipe.geometry import se3
from active3d_pipe.structures import Camera

CAMERA = Camera.from_fov(64, 48, 80)
POSE = se3.look_at([0.0, 0.0, 1.0], [2.0, 0.3, 1.0])
SPHERES = GaussianSettings(isotropic=True, seed_method="pixels", seed_stride=2, seed_sigma_factor=0.8)


def wall() -> tuple[np.ndarray, np.ndarray]:
    rgb = np.full((48, 64, 3), 0.3, np.float32)
    rgb[:, ::8] = 0.8
    return rgb, np.full((48, 64), 2.0, np.float32)


def seeded(settings: GaussianSettings, rendered: RenderedView | None = None, most: int = 10**6):
    rgb, depth = wall()
    return seed_frame(rgb, depth, CAMERA, POSE, rendered, settings, most, np.random.default_rng(0))


def trained(settings: GaussianSettings, iterations: int = 12) -> GaussianParameters:
    params = GaussianParameters.from_model(seeded(settings))
    rgb, depth = wall()
    for _ in range(iterations):
        optimise_step(params, CAMERA, POSE, rgb, depth + np.float32(0.05), settings)
    return params


def test_spheres_stay_spheres_and_learn() -> None:
    start, params = GaussianParameters.from_model(seeded(SPHERES)), trained(SPHERES)
    scales = params.values.numpy()[:, LOG_SCALES]
    assert (scales == scales[:, :1]).all()
    assert np.array_equal(params.values.numpy()[:, QUATS], start.values.numpy()[:, QUATS])
    assert not np.array_equal(scales, start.values.numpy()[:, LOG_SCALES])
    free = trained(SPHERES.model_copy(update={"isotropic": False, "seed_flatness": 1.0}))
    assert np.ptp(free.values.numpy()[:, LOG_SCALES], axis=1).max() > 0.01


def test_isotropy_gradient_is_that_of_its_energy() -> None:
    values = np.random.default_rng(1).normal(size=(7, 14)).astype(np.float32)
    energy, gradient = isotropy_gradient(values, 3.0)
    logs = torch.from_numpy(values[:, LOG_SCALES]).double().requires_grad_()
    scales = logs.exp()
    expected = 3.0 * (scales - scales.mean(dim=1, keepdim=True)).abs().mean()
    expected.backward()
    np.testing.assert_allclose(energy, expected.item(), rtol=1e-5)
    np.testing.assert_allclose(gradient, logs.grad, atol=1e-6)
    assert isotropy_gradient(values[:0], 3.0)[0] == 0


def test_isotropy_weight_makes_primitives_rounder() -> None:
    flat = GaussianSettings(lr_log_scales=0.03)

    def elongation(settings: GaussianSettings) -> float:
        return float(np.ptp(trained(settings, 30).values.numpy()[:, LOG_SCALES], axis=1).mean())

    assert elongation(flat.model_copy(update={"isotropy_weight": 10.0})) < 0.8 * elongation(flat)


def test_pixel_seeds_are_one_for_every_nth_pixel_and_render_the_frame() -> None:
    model = seeded(SPHERES)
    assert len(model) == 24 * 32
    np.testing.assert_allclose(np.exp(model.log_scales), 0.8 * 2 * 2.0 / CAMERA.fx, rtol=1e-5)
    view = render_view(model, CAMERA, POSE, SPHERES)
    assert view.alpha[4:-4, 4:-4].min() > 0.8
    assert np.abs(view.depth - 2.0)[4:-4, 4:-4].max() < 0.1
    assert len(seeded(SPHERES, most=100)) == 100
    assert len(seeded(SPHERES, view)) < 0.2 * len(model)


def test_silhouette_rule_seeds_where_the_depth_error_stands_out() -> None:
    rgb, depth = wall()
    rule = SPHERES.model_copy(update={"seed_depth_error_factor": 50.0})
    shown = depth + 0.001
    shown[:, 32:40] += 0.3  # the map lies behind what was observed here
    shown[:, 40:48] -= 0.3  # and in front of it here
    view = RenderedView(rgb, shown.astype(np.float32), np.ones_like(depth))
    model = seeded(rule, view)
    assert len(model) == 24 * 4
    view = RenderedView(rgb, (depth + 0.3).astype(np.float32), np.ones_like(depth))
    assert len(seeded(rule, view)) == 0  # everything is equally wrong: nothing stands out
    assert len(seeded(SPHERES, view)) == 24 * 32  # the fixed gap does not care


def test_discs_of_spheres_have_three_equal_scales() -> None:
    one = discs(np.zeros((1, 3)), np.ones((1, 3)), np.ones((1, 3)), np.array([0.1]), 1.0, 0.5)
    np.testing.assert_allclose(np.exp(one.log_scales), 0.1, rtol=1e-6)


def test_primitives_may_grow_to_one_and_a_half_times_the_largest_seed() -> None:
    settings = GaussianSettings()
    assert settings.largest_scale_m(Camera.from_fov(600, 340, 90.0)) == pytest.approx(1.5 * 0.68 * 0.048)
    few = Camera.from_fov(60, 34, 90.0)  # far seeds of coarse images are wider than any cell
    assert settings.largest_scale_m(few) == pytest.approx(1.5 * 0.68 * 10 / 30)
    pixels = GaussianSettings(seed_method="pixels", seed_stride=2, max_growth=1.0)
    assert pixels.largest_scale_m(few) == pytest.approx(0.68 * 2 * 10 / 30)
    assert float(trained(settings, 30).values[:, LOG_SCALES].max()) <= np.log(settings.largest_scale_m(CAMERA)) + 1e-5
