"""One optimisation step of the explicit branch: what the mapper calls thousands of times."""

from typing import NamedTuple

import numpy as np

from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.losses import loss_gradient
from active3d_pipe.gaussians.parameters import LOG_SCALES, WIDTH, GaussianParameters
from active3d_pipe.gaussians.raster_pass import RasterPass
from active3d_pipe.gaussians.shape import isotropy_gradient, tie_scales
from active3d_pipe.structures import Camera


class RowGradient(NamedTuple):
    """dE/dvalues of some primitives: `rows` (M,) int32, all different, `grads` (M, 14) float32."""

    rows: np.ndarray
    grads: np.ndarray

    def plus(self, other: "RowGradient", count: int) -> "RowGradient":
        """The sum, of `count` primitives in all."""
        place = np.full(count, -1, np.int32)
        place[self.rows] = np.arange(len(self.rows), dtype=np.int32)
        at = place[other.rows]
        self.grads[at[at >= 0]] += other.grads[at >= 0]
        return RowGradient(
            np.concatenate([self.rows, other.rows[at < 0]]), np.concatenate([self.grads, other.grads[at < 0]])
        )


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
    extra_gradient: RowGradient | None = None,
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
        extra_gradient: added to the gradient (E_geo; see `sdf_coupling`), of primitives that `params.rows` gave out.

    Returns:
        {loss, l1, ssim, depth_l1 (m), off_sight (m), psnr (dB), visible} of the frame before the step.
    """
    raster = RasterPass(
        dilation_px2=settings.dilation_px2, compensate=settings.opacity_compensation, workspace=params.workspace
    )
    values, may_be_seen = params.near(camera, T_world_camera, settings.dilation_px2)
    seen = depth if settings.sight_weight else None
    out = raster.forward(values, camera, T_world_camera, seen=seen, which=may_be_seen)
    terms, out_grad = loss_gradient(out, rgb, depth, settings, params.workspace, mask)
    gradient = RowGradient(*raster.backward_rows(out_grad))
    if extra_gradient is not None:
        gradient = gradient.plus(extra_gradient, len(params))
    if settings.isotropy_weight > 0:
        energy, pull = isotropy_gradient(params.values.numpy(), settings.isotropy_weight)
        everywhere = np.zeros((len(params), WIDTH), np.float32)
        everywhere[:, LOG_SCALES] = pull
        gradient = gradient.plus(RowGradient(np.arange(len(params), dtype=np.int32), everywhere), len(params))
        terms["loss"] += energy
    if settings.isotropic:
        tie_scales(gradient.grads)
    params.step(
        gradient.grads, settings, learning_rate_scale, gradient.rows, settings.largest_scale_m(camera)
    )
    terms["visible"] = float(raster.num_visible)
    return terms
