"""Differentiable rendering of Gaussians: colour, depth and alpha images of a posed camera."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from active3d_pipe.errors import InputError
from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.parameters import GaussianParameters
from active3d_pipe.gaussians.raster_pass import RasterPass
from active3d_pipe.structures import Camera, GaussianModel, check_pose


class Rendered(NamedTuple):
    """What the rasteriser returns: rgb (H, W, 3); depth (H, W) = sum w z, m, not normalised; alpha (H, W).

    And `off_sight` (H, W) = sum w min(|z - seen|, limit), m, when an observed depth was given.
    """

    rgb: Tensor
    depth: Tensor
    alpha: Tensor
    off_sight: Tensor | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """A finished view: rgb (H, W, 3), alpha (H, W), depth (H, W) m along the optical axis; all float32.

    `depth` is the mean depth of what is seen, sum w z / alpha; 0 where alpha < 0.5.
    """

    rgb: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, values: Tensor, camera: Camera, T: np.ndarray, settings: GaussianSettings, *images: Any
    ) -> Tensor:
        # Own buffers: several rendered images may wait for their backward at the same time.
        ctx.raster_pass = new_pass(settings)
        return torch.from_numpy(ctx.raster_pass.forward(values.numpy(), camera, T, *images))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        grad = ctx.raster_pass.backward(np.ascontiguousarray(grads[0].numpy(), dtype=np.float32))
        return torch.from_numpy(grad), None, None, None, None, None


def new_pass(settings: GaussianSettings) -> RasterPass:
    """A rasteriser pass with its own buffers."""
    return RasterPass(dilation_px2=settings.dilation_px2, compensate=settings.opacity_compensation)


def render(
    params: GaussianParameters | Tensor,
    camera: Camera,
    T_world_camera: np.ndarray,
    *,
    tiles: np.ndarray | None = None,
    settings: GaussianSettings | None = None,
    seen: np.ndarray | None = None,
) -> Rendered:
    """Differentiable view of the Gaussians, float32, black background.

    Args:
        params: the model, or its values (N, 14) float32 (`GaussianParameters.values` gives the columns);
            gradients flow to the values.
        camera, T_world_camera: intrinsics and pose; poses take no gradient.
        tiles: ids of the tiles to draw (`raster_pass.tile_grid`), default all; other pixels are 0.
        settings: dilation and opacity compensation, default `GaussianSettings()`.
        seen: observed depth (H, W) float32, m, for `off_sight`.
    """
    values = params.values if isinstance(params, GaussianParameters) else params
    if values.ndim != 2 or values.shape[1] != 14 or values.dtype != torch.float32:
        raise InputError(f"render: values are {tuple(values.shape)} {values.dtype}, expected (N, 14) float32")
    T = check_pose(T_world_camera, "render: T_world_camera")
    image = _Rasterise.apply(values.contiguous(), camera, T, settings or GaussianSettings(), tiles, seen)
    return Rendered(image[:3].permute(1, 2, 0), image[3], image[4], None if seen is None else image[5])


def render_view(
    model: GaussianModel | GaussianParameters,
    camera: Camera,
    T_world_camera: np.ndarray,
    settings: GaussianSettings | None = None,
) -> RenderedView:
    """The view as NumPy arrays, without gradients; see `RenderedView`."""
    params = model if isinstance(model, GaussianParameters) else GaussianParameters.from_model(model)
    T = check_pose(T_world_camera, "render_view: T_world_camera")
    raster = new_pass(settings or GaussianSettings())
    values, may_be_seen = params.near(camera, T, raster.dilation_px2)
    image = raster.forward(values, camera, T, which=may_be_seen)
    alpha = image[4].copy()
    depth = np.where(alpha >= 0.5, image[3] / np.maximum(alpha, 1e-6), 0).astype(np.float32)
    return RenderedView(np.ascontiguousarray(image[:3].transpose(1, 2, 0)), depth, alpha)
