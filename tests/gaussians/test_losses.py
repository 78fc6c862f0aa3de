"""SSIM and frame loss against scikit-image, torch autograd and finite arithmetic."""

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from active3d_pipe.errors import InputError
from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.losses import frame_loss, loss_gradient
from active3d_pipe.gaussians.raster_pass import Workspace
from active3d_pipe.gaussians.rasteriser import Rendered
from active3d_pipe.gaussians.ssim import ssim


def image_pair(height: int, width: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = rng.random((height, width, 3)).astype(np.float32)
    y = np.clip(0.6 * x + 0.4 * rng.random(x.shape), 0, 1).astype(np.float32)
    return x, y


def torch_ssim(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Float64 reference by five 2D convolutions."""
    taps = torch.exp(-0.5 * (torch.arange(11, dtype=torch.float64) - 5) ** 2 / 1.5**2)
    window = torch.outer(taps, taps)[None, None] / taps.sum() ** 2

    def mean(a: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(a.permute(2, 0, 1)[:, None], window)

    mx, my = mean(x), mean(y)
    sxx, syy, sxy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return ((2 * mx * my + c1) * (2 * sxy + c2) / ((mx * mx + my * my + c1) * (sxx + syy + c2))).mean()


@pytest.mark.parametrize(("height", "width"), [(40, 56), (11, 11), (12, 31), (101, 17)])
def test_ssim_equals_scikit_image_and_autograd(height: int, width: int) -> None:
    x, y = image_pair(height, width)
    wanted = structural_similarity(
        x.astype(np.float64), y.astype(np.float64), channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False,
    )
    xt = torch.from_numpy(x).requires_grad_()
    value = ssim(xt, torch.from_numpy(y))
    assert float(value.detach()) == pytest.approx(wanted, abs=2e-6)
    (3 * value).backward()
    exact = torch.from_numpy(x.astype(np.float64)).requires_grad_()
    (3 * torch_ssim(exact, torch.from_numpy(y.astype(np.float64)))).backward()
    error = np.linalg.norm(xt.grad.numpy() - exact.grad.numpy()) / np.linalg.norm(exact.grad.numpy())
    assert error < 1e-5


def test_ssim_of_equal_and_of_tiny_images_is_one() -> None:
    x, y = image_pair(20, 20)
    assert float(ssim(torch.from_numpy(x), torch.from_numpy(x))) == pytest.approx(1, abs=1e-5)
    tiny = torch.from_numpy(x[:8].copy()).requires_grad_()
    value = ssim(tiny, torch.from_numpy(y[:8].copy()))
    value.backward()
    assert float(value.detach()) == 1 and not tiny.grad.any()


def test_ssim_refuses_images_of_different_size() -> None:
    with pytest.raises(InputError, match="ssim"):
        ssim(torch.zeros(12, 12, 3), torch.zeros(12, 13, 3))


def torch_loss(
    image: torch.Tensor, rgb: np.ndarray, depth: np.ndarray, settings: GaussianSettings, mask: np.ndarray
) -> torch.Tensor:
    m = torch.from_numpy(mask)
    x, y = image[:3].permute(1, 2, 0), torch.from_numpy(rgb.astype(np.float64))
    y = torch.where(m[..., None], y, x.detach())
    x = torch.where(m[..., None], x, x.detach())
    d = torch.from_numpy(depth.astype(np.float64))
    valid = m & (d > 0)
    w = settings.ssim_weight
    color = (x - y).abs().sum() / (3 * m.sum())
    loss = (1 - w) * color + w * (1 - torch_ssim(x, y)) + settings.depth_weight * (image[3] - d)[valid].abs().mean()
    return loss + settings.sight_weight * image[5][valid].mean() if len(image) == 6 else loss


@pytest.mark.parametrize("sight", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_frame_loss_matches_torch(masked: bool, sight: bool) -> None:
    rng = np.random.default_rng(3)
    x, rgb = image_pair(33, 45, 1)
    depth = rng.uniform(1, 3, (33, 45)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0
    mask = rng.random(depth.shape) < 0.8 if masked else np.ones(depth.shape, bool)
    z = (depth + rng.normal(size=depth.shape) * 0.2).astype(np.float32)
    settings = GaussianSettings(ssim_weight=0.3, depth_weight=0.7, sight_weight=1.7)
    planes = np.concatenate([x.transpose(2, 0, 1), z[None], np.ones_like(z)[None]])
    if sight:
        planes = np.concatenate([planes, rng.uniform(0, 0.3, (1, *z.shape)).astype(np.float32)])

    exact = torch.from_numpy(planes.astype(np.float64)).requires_grad_()
    wanted = torch_loss(exact, rgb, depth, settings, mask)
    wanted.backward()

    leaf = torch.from_numpy(planes.copy()).requires_grad_()
    rendered = Rendered(leaf[:3].permute(1, 2, 0), leaf[3], leaf[4], leaf[5] if sight else None)
    loss, terms = frame_loss(rendered, rgb, depth, settings, mask if masked else None)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(float(wanted.detach()), rel=1e-5)
    assert terms["loss"] == pytest.approx(float(wanted.detach()), rel=1e-5)
    error = np.linalg.norm(leaf.grad.numpy() - exact.grad.numpy()) / np.linalg.norm(exact.grad.numpy())
    assert error < 1e-5
    assert not leaf.grad.numpy()[:, ~mask].any()
    squared = ((x - rgb).astype(np.float64) ** 2)[mask].mean()
    assert terms["psnr"] == pytest.approx(-10 * np.log10(squared), abs=1e-3)


def test_frame_loss_of_the_observation_itself_is_zero() -> None:
    x, _ = image_pair(24, 24)
    depth = np.full((24, 24), 2, np.float32)
    planes = np.concatenate([x.transpose(2, 0, 1), depth[None], np.ones_like(depth)[None]])
    terms, grad = loss_gradient(planes, x, depth, GaussianSettings(), Workspace())
    assert terms["loss"] == pytest.approx(0, abs=1e-6) and terms["psnr"] > 100
    assert np.abs(grad).max() < 1e-6


def test_frame_loss_without_any_valid_depth_is_finite() -> None:
    x, y = image_pair(24, 24)
    depth = np.zeros((24, 24), np.float32)
    planes = np.concatenate([x.transpose(2, 0, 1), depth[None] + 1, np.ones_like(depth)[None]])
    terms, grad = loss_gradient(planes, y, depth, GaussianSettings(), Workspace())
    assert terms["depth_l1"] == 0 and not grad[3].any() and np.isfinite(grad).all()


def test_frame_loss_refuses_bytes_and_wrong_sizes() -> None:
    planes, depth = np.zeros((5, 12, 12), np.float32), np.ones((12, 12), np.float32)
    with pytest.raises(InputError, match="float32"):
        loss_gradient(planes, np.zeros((12, 12, 3), np.uint8), depth, GaussianSettings(), Workspace())
    with pytest.raises(InputError, match="do not fit"):
        loss_gradient(planes, np.zeros((12, 11, 3), np.float32), depth, GaussianSettings(), Workspace())
