"""The photometric and depth loss of one frame (E_photo of eq. sw_energy) and its gradient images."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from active3d_pipe.errors import InputError
from active3d_pipe.gaussians import kernels_loss
from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.raster_pass import Workspace
from active3d_pipe.gaussians.rasteriser import Rendered
from active3d_pipe.gaussians.ssim import ssim_gradient


def loss_gradient(
    out: np.ndarray,
    rgb: np.ndarray,
    depth: np.ndarray,
    settings: GaussianSettings,
    workspace: Workspace,
    mask: np.ndarray | None = None,
) -> tuple[dict[str, float], np.ndarray]:
    """Loss terms of a rendered image `out` (5, H, W) and dL/dout.

    L = (1 - w) mean|colour error| + w (1 - SSIM) + v mean|sum w z - depth| + s mean(sum w min(|z - depth|, limit)),
    where the colour mean runs over the pixels of `mask`, the others over those of them with a valid depth. The rendered
    depth is not normalised by alpha, so that holes in the model cost as much as a wrong depth. It is right as well when
    half of a pixel is drawn too near and half too far, which another view will show; the last term is not (the line of
    sight loss of Rematas et al., Urban Radiance Fields, 2022, in its first power).

    Args:
        out: rendered r, g, b, sum w z, alpha, float32, and `RasterPass.forward`'s sixth plane; without it s = 0.
        rgb, depth: observed (H, W, 3) in 0..1 and (H, W) m, 0 = invalid; float32.
        settings: weights w (`ssim_weight`), v (`depth_weight`) and s (`sight_weight`).
        workspace: buffers; the returned array lives in it.
        mask: (H, W) bool, pixels that count, default all. In SSIM windows the others count as equal.

    Returns:
        {loss, l1, ssim, depth_l1 (m), off_sight (m), psnr (dB)} and an array like `out`.
    """
    height, width = depth.shape
    planes = len(out)
    if planes not in (5, 6) or out.shape[1:] != (height, width) or rgb.shape != (height, width, 3):
        raise InputError(f"loss: rendered {out.shape}, rgb {rgb.shape}, depth {depth.shape} do not fit each other")
    if rgb.dtype != np.float32 or depth.dtype != np.float32:
        raise InputError(f"loss: rgb is {rgb.dtype}, depth is {depth.dtype}, expected float32 (colour 0..1)")
    valid = depth > 0 if mask is None else (depth > 0) & mask
    num_depth = max(int(np.count_nonzero(valid)), 1)
    num_color = 3 * max(height * width if mask is None else int(np.count_nonzero(mask)), 1)
    w = settings.ssim_weight
    weights = np.array([(1 - w) / num_color, settings.depth_weight / num_depth], np.float32)
    target = workspace.get("loss_target", (3, height, width), np.float32)
    grad = workspace.get("loss_grad", (planes, height, width), np.float32)
    sums = workspace.get("loss_sums", (kernels_loss.BANDS, 3), np.float64)
    kernels_loss.absolute_errors(
        out, rgb, depth, np.zeros((1, 1), bool) if mask is None else mask, mask is not None, weights, target, grad, sums
    )
    off_sight = 0.0
    if planes == 6:
        np.multiply(valid, np.float32(settings.sight_weight / num_depth), out=grad[5])
        off_sight = float(out[5].sum(where=valid, dtype=np.float64)) / num_depth
    similarity = 1.0
    if w > 0:
        similarity = ssim_gradient(out[:3], target, workspace, grad, -w)
    if mask is not None:
        kernels_loss.clear_masked(mask, grad)
    abs_color, sq_color, abs_depth = sums.sum(axis=0)
    l1, depth_l1 = abs_color / num_color, abs_depth / num_depth
    loss = (1 - w) * l1 + w * (1 - similarity) + settings.depth_weight * depth_l1 + settings.sight_weight * off_sight
    psnr = -10 * math.log10(max(sq_color / num_color, 1e-12))
    terms = {"loss": loss, "l1": l1, "ssim": similarity, "depth_l1": depth_l1, "off_sight": off_sight, "psnr": psnr}
    return {name: float(value) for name, value in terms.items()}, grad


class _FrameLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, terms: dict[str, float], *observation: Any) -> Tensor:
        rgb, depth, settings, mask = observation
        found, grad = loss_gradient(image.numpy(), rgb, depth, settings, Workspace(), mask)
        terms.update(found)
        ctx.grad = torch.from_numpy(grad)
        return torch.tensor(found["loss"], dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.grad * grads[0], None, None, None, None, None


def frame_loss(
    rendered: Rendered,
    rgb: np.ndarray,
    depth: np.ndarray,
    settings: GaussianSettings,
    mask: np.ndarray | None = None,
) -> tuple[Tensor, dict[str, float]]:
    """Differentiable form of `loss_gradient`: (scalar loss, its terms)."""
    planes = [rendered.rgb.permute(2, 0, 1), rendered.depth[None], rendered.alpha[None]]
    image = torch.cat(planes if rendered.off_sight is None else [*planes, rendered.off_sight[None]])
    terms: dict[str, float] = {}
    loss = _FrameLoss.apply(image, terms, rgb, depth, settings, mask)
    return loss, terms
