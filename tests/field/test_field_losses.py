"""Losses against slow formulas written ray by ray."""

import math

import numpy as np
import pytest
import torch

from active3d_pipe.field import losses


def slow_weights(s, z, bell, truncation):
    w = [1 / (1 + math.exp(-x / bell)) / (1 + math.exp(x / bell)) for x in s]
    for i in range(len(s) - 1):
        if s[i] * s[i + 1] < 0:
            w = [v if d < z[i] + truncation else 0 for v, d in zip(w, z)]
            break
    return [v / (sum(w) + 1e-8) for v in w]


def test_render_weights():
    rng = np.random.default_rng(0)
    z = np.sort(rng.uniform(0, 2, (50, 12)), axis=1)
    s = np.clip((1.0 - z) / 0.1, -1, 1) * rng.uniform(0.5, 1, (50, 1)) + rng.normal(0, 0.2, (50, 12))
    s[:5] = 0.3  # no change of sign
    w = losses.render_weights(torch.tensor(s), torch.tensor(z), 0.1, 0.1)
    np.testing.assert_allclose(w, [slow_weights(a, b, 0.1, 0.1) for a, b in zip(s, z)], atol=1e-9)
    np.testing.assert_allclose(w.sum(dim=1), 1, atol=1e-3)


def test_weights_find_the_first_surface():
    z = torch.linspace(0, 2, 401, dtype=torch.float64)[None]
    first, second = 0.7, 1.5
    s = torch.minimum((z - first).abs(), (z - second).abs()).clamp(max=0.1) / 0.1
    inside = ((z > first) & (z < first + 0.3)) | (z > second)
    s = torch.where(inside, -s, s)
    depth = (losses.render_weights(s, z, 0.1, 0.1) * z).sum().item()
    assert depth == pytest.approx(first, abs=0.005)


def test_sdf_and_free_space_loss():
    rng = np.random.default_rng(1)
    s, t = rng.normal(size=(2, 6, 5))
    mask = rng.random((6, 5)) < 0.5
    expected = np.mean([(s[i, j] - t[i, j]) ** 2 for i in range(6) for j in range(5) if mask[i, j]])
    args = torch.tensor(s), torch.tensor(t), torch.tensor(mask)
    assert losses.sdf_loss(*args, 0.1).item() == pytest.approx(expected * 0.01)
    assert losses.free_space_loss(*args).item() == pytest.approx(expected)
    none = torch.zeros(6, 5, dtype=torch.bool)
    assert losses.sdf_loss(args[0], args[1], none, 0.1).item() == 0


def test_rgb_and_depth_loss():
    rng = np.random.default_rng(2)
    a, b = rng.random((2, 7, 3))
    valid = np.array([1, 0, 1, 1, 0, 1, 1], bool)
    t = torch.tensor
    assert losses.rgb_loss(t(a), t(b), t(valid)).item() == pytest.approx(((a - b)[valid] ** 2).mean())
    expected = ((a - b)[valid, 0] ** 2).mean()
    assert losses.depth_loss(t(a[:, 0]), t(b[:, 0]), t(valid)).item() == pytest.approx(expected)


def test_uncertainty_loss_is_least_at_the_true_variance_and_leaves_geometry_alone():
    residual = torch.tensor(np.random.default_rng(3).normal(0, 0.2, 1000), requires_grad=True)
    log_var = torch.zeros((), dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([log_var], lr=0.1)
    mask = torch.ones(1000, dtype=torch.bool)
    for _ in range(200):
        optimiser.zero_grad()
        losses.uncertainty_loss(residual, log_var.exp().expand(1000), mask).backward()
        optimiser.step()
    assert math.exp(log_var.item() / 2) == pytest.approx(residual.std().item(), rel=0.02)
    assert residual.grad is None


def test_uncertainty_loss_takes_an_outlier_for_one_truncation():
    variance = torch.full((1,), 0.04, requires_grad=True)
    mask = torch.ones(1, dtype=torch.bool)
    far, near = (losses.uncertainty_loss(torch.tensor([e]), variance, mask) for e in (50.0, 1.0))
    assert far.item() == near.item() == pytest.approx(0.2 * (1 / 0.08 + 0.5 * math.log(0.04)))
    (gradient,) = torch.autograd.grad(near, variance)
    assert gradient.item() == pytest.approx(0.2 * (0.5 / 0.04 - 0.5 / 0.04**2))


def test_prior_and_smoothness_loss():
    sigma = torch.tensor([3.0, 1.0, 6.0])
    unseen = torch.tensor([True, False, True])
    assert losses.prior_loss(sigma, 3.0, unseen).item() == pytest.approx(math.log(2) ** 2 / 2)
    a, b = torch.tensor([0.0, 1.0]), torch.tensor([0.5, 1.0])
    assert losses.smoothness_loss(a, b).item() == pytest.approx(0.125)
