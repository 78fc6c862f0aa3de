"""Structural similarity as a differentiable function."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from active3d_pipe.errors import InputError
from active3d_pipe.gaussians import kernels_ssim
from active3d_pipe.gaussians.raster_pass import Workspace


def ssim_gradient(
    x: np.ndarray, y: np.ndarray, workspace: Workspace, grad: np.ndarray | None = None, scale: float = 1.0
) -> float:
    """Mean SSIM of two images as planes (C, H, W) float32 in 0..1; adds scale * dSSIM/dx to `grad`.

    An image smaller than the 11x11 window has no window: SSIM is then 1 and its gradient 0.
    """
    planes, height, width = x.shape
    windows = planes * (height - 2 * kernels_ssim.RADIUS) * (width - 2 * kernels_ssim.RADIUS)
    if min(height, width) < kernels_ssim.WINDOW:
        return 1.0
    moments = workspace.get("ssim_moments", (2 * planes, height, width), np.float32)
    slopes = workspace.get("ssim_slopes", (3 * planes, height + 10, width + 10), np.float32)
    sums = workspace.get("ssim_sums", (planes, kernels_ssim.BANDS), np.float64)
    kernels_ssim.products(x, y, moments)
    kernels_ssim.similarity(x, y, moments, slopes, sums)
    if grad is not None:
        kernels_ssim.add_gradient(x, y, slopes, np.float32(scale / windows), grad)
    return float(sums.sum()) / windows


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor) -> Tensor:
        grad = np.zeros(tuple(x.shape), np.float32)
        value = ssim_gradient(x.numpy(), y.numpy(), Workspace(), grad)
        ctx.grad = torch.from_numpy(grad)
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        return ctx.grad * grads[0], None


def ssim(x: Tensor, y: Tensor) -> Tensor:
    """Mean SSIM of images (H, W, C) float32 in 0..1; the gradient flows to `x` only.

    Gaussian window 11x11, sigma 1.5, population covariance, K = (0.01, 0.03), data range 1, windows wholly inside
    the image: the value of scikit-image with `gaussian_weights=True, sigma=1.5, use_sample_covariance=False`.
    """
    if x.shape != y.shape or x.ndim != 3:
        raise InputError(f"ssim: images are {tuple(x.shape)} and {tuple(y.shape)}, expected equal (H, W, C)")
    return _Ssim.apply(x.permute(2, 0, 1).contiguous(), y.detach().permute(2, 0, 1).contiguous())
