"""Knobs of the explicit branch."""

from typing import Literal

from pydantic import Field

from active3d_pipe.structures import Camera, Settings


class GaussianSettings(Settings):
    """Gaussian model: rendering, losses, optimisation, seeding, pruning."""

    max_count: int = Field(default=1_000_000, ge=1, description="most primitives the model may hold")

    # Shape
    max_growth: float = Field(
        default=1.5, ge=1, description="largest standard deviation, in units of that of the largest seed: one of the "
        "coarsest octree cell, or of the spacing of pixels at the far range"
    )
    isotropic: bool = Field(default=False, description="spheres: one scale for the three axes, no rotation")
    isotropy_weight: float = Field(
        default=0.0, ge=0, description="weight of the mean deviation of the scales from their mean, per metre"
    )

    # Rendering
    dilation_px2: float = Field(
        default=0.1, ge=0, description="variance added to every projected covariance, square pixels (anti-aliasing)"
    )
    opacity_compensation: bool = Field(
        default=True, description="scale opacity by the ratio of areas before and after the dilation (Mip-Splatting)"
    )

    # Losses
    ssim_weight: float = Field(default=0.2, ge=0, le=1, description="w of (1 - w) L1 + w (1 - SSIM)")
    depth_weight: float = Field(
        default=0.3, ge=0, description="weight of the mean absolute depth error, per metre"
    )
    sight_weight: float = Field(
        default=0.0, ge=0,
        description="weight, per metre, of how far what is drawn lies from the observed depth along the line of sight",
    )

    # Optimisation (Adam)
    lr_means_m: float = Field(default=8e-4, ge=0, description="learning rate of the means, m")
    lr_log_scales: float = Field(default=0.05, ge=0, description="learning rate of the logarithmic scales")
    lr_quats: float = Field(default=8e-3, ge=0, description="learning rate of the quaternions")
    lr_opacity_logits: float = Field(default=0.05, ge=0, description="learning rate of the opacity logits")
    lr_colors: float = Field(default=0.005, ge=0, description="learning rate of the colours")
    adam_beta1: float = Field(default=0.9, ge=0, lt=1, description="decay of Adam's first moment")
    adam_beta2: float = Field(default=0.999, ge=0, lt=1, description="decay of Adam's second moment")
    visible_only: bool = Field(
        default=False, description="let Adam touch only the primitives that the view shows (cheaper for large models)"
    )

    # Seeding from a frame
    seed_method: Literal["octree", "pixels"] = Field(
        default="octree", description="one disc for every octree leaf, or for every n-th pixel in x and y"
    )
    seed_stride: int = Field(default=1, ge=1, description="method pixels: n")
    seed_cell_m: float = Field(
        default=0.048, gt=0, description="edge of the coarsest octree cell that becomes one disc, m"
    )
    seed_levels: int = Field(default=4, ge=1, le=8, description="octree levels; every level halves the cell")
    seed_color_spread: float = Field(
        default=0.04, gt=0, description="split a cell when its colour deviates by more (standard deviation, 0..1)"
    )
    seed_normal_cos: float = Field(
        default=0.95, gt=0, le=1, description="split a cell when the mean of its unit normals is shorter than this"
    )
    seed_sigma_factor: float = Field(
        default=0.68, gt=0, description="in-plane sigma of a disc in units of its cell edge, or of the pixel spacing"
    )
    seed_flatness: float = Field(
        default=0.15, gt=0, le=1, description="sigma along the normal relative to in-plane sigma"
    )
    seed_opacity: float = Field(default=0.98, gt=0, lt=1, description="opacity of a new disc")
    seed_alpha: float = Field(
        default=0.5, gt=0, le=1, description="seed where the rendered alpha is below this"
    )
    seed_front_m: float = Field(
        default=0.05, ge=0, description="seed where the observation is nearer than the rendered depth by this, m ..."
    )
    seed_front_ratio: float = Field(default=0.03, ge=0, description="... plus this fraction of the depth")
    seed_depth_error_factor: float = Field(
        default=0.0, ge=0,
        description="above 0, seed where it is nearer by this many medians of the frame's depth error, instead",
    )
    depth_edge_ratio: float = Field(
        default=0.03, gt=0, description="relative depth step between neighbouring pixels that counts as a depth edge"
    )

    # Error-driven adding
    add_color_error: float = Field(
        default=0.05, gt=0, description="add discs where the colour error exceeds this (0..1 scale)"
    )
    add_depth_error_m: float = Field(
        default=0.05, gt=0, description="add discs where the depth error exceeds this, m"
    )
    add_sigma_px: float = Field(default=1.0, gt=0, description="in-plane sigma of an added disc, px")
    add_opacity: float = Field(default=0.5, gt=0, lt=1, description="opacity of an added disc")

    # Pruning
    prune_opacity: float = Field(
        default=0.02, ge=0, lt=1, description="drop primitives less opaque than this"
    )
    prune_scale_m: float = Field(
        default=1.0, gt=0, description="drop primitives with a standard deviation above this, m"
    )

    # Coupling with the signed distance field
    sdf_weight: float = Field(default=0.1, ge=0, description="weight of |SDF(mean)| in E_geo, per metre")
    sdf_normal_weight: float = Field(
        default=0.01, ge=0, description="weight of the normal alignment in E_geo"
    )
    sdf_band_m: float = Field(
        default=0.05, gt=0, description="only means with |SDF| below this are coupled, m"
    )

    def largest_scale_m(self, camera: Camera) -> float:
        """The standard deviation, m, that no primitive may grow beyond."""
        spacing = camera.far / camera.fx
        cell = self.seed_stride * spacing if self.seed_method == "pixels" else max(self.seed_cell_m, spacing)
        return self.max_growth * self.seed_sigma_factor * cell
