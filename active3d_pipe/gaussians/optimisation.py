"""One optimisation step of the explicit branch: what the mapper calls thousands of times."""

import numpy as np

from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.losses import loss_gradient
from active3d_pipe.gaussians.parameters import LOG_SCALES, GaussianParameters
from active3d_pipe.gaussians.raster_pass import RasterPass
from active3d_pipe.gaussians.shape import isotropy_gradient, tie_scales
from active3d_pipe.structures import Camera


def optimise_step(  # noqa: PLR0913 - the frame's arrays come one by one
    params: GaussianParameters,
    camera: Camera,
    T_world_camera: np.ndarray,
    rgb: np.ndarray,
    depth: np.ndarray,
    settings: GaussianSettings,
    learning_rate_scale: float = 1.0,
    *,
    mask: np.ndarray | None = None,
    extra_gradient: np.ndarray | None = None,
) -> dict[str, float]:
    """Render one observed frame, compare, and take one Adam step on all Gaussians, in place.

    Same inputs, same bytes. It calls the kernels directly; `render` and `frame_loss` are the same computation
    under torch autograd.

    Args:
        params: the model; `params.values` and the optimiser state change.
        camera, T_world_camera: of the frame.
        rgb, depth: (H, W, 3) float32 0..1, (H, W) float32 m, 0 = invalid.
        settings: loss weights, learning rates.
        learning_rate_scale: factor on all learning rates.
        mask: (H, W) bool, pixels that count, default all.
        extra_gradient: (N, 14) float32 added to the gradient (E_geo, regularisers; see `sdf_coupling`).

    Returns:
        {loss, l1, ssim, depth_l1 (m), off_sight (m), psnr (dB), visible} of the frame before the step.
    """
    raster = RasterPass(
        dilation_px2=settings.dilation_px2, compensate=settings.opacity_compensation, workspace=params.workspace
    )
    out = raster.forward(params.values.numpy(), camera, T_world_camera, seen=depth if settings.sight_weight else None)
    terms, out_grad = loss_gradient(out, rgb, depth, settings, params.workspace, mask)
    grad = raster.backward(out_grad)
    if extra_gradient is not None:
        grad += extra_gradient
    if settings.isotropy_weight > 0:
        energy, pull = isotropy_gradient(params.values.numpy(), settings.isotropy_weight)
        grad[:, LOG_SCALES] += pull
        terms["loss"] += energy
    if settings.isotropic:
        tie_scales(grad)
    params.step(grad, settings, learning_rate_scale, raster.visible() if settings.visible_only else None)
    terms["visible"] = float(raster.num_visible)
    return terms
