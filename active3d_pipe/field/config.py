"""Knobs of the implicit branch."""

from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from active3d_pipe.structures import Settings


class FieldSettings(Settings):
    """Encodings, decoders, ray sampling, losses and optimiser of the neural SDF field."""

    encoder: Literal["triplane", "hash", "grids", "none"] = Field(
        "triplane", description="gamma(x): tri-planes (the paper's), a hash grid, dense grids of some levels, nothing"
    )
    plane_resolutions_m: tuple[float, ...] = Field(
        (0.24, 0.06), min_length=1, description="node spacing of each tri-plane level of the geometry features, m"
    )
    color_plane_resolutions_m: tuple[float, ...] = Field(
        (0.24, 0.06), min_length=1, description="node spacing of each tri-plane level of the colour features, m"
    )
    plane_channels: int = Field(16, gt=0, multiple_of=8, description="features of a plane node")
    hash_levels: int = Field(16, ge=1, le=32, description="encoder hash: levels")
    hash_features: int = Field(2, ge=1, description="encoder hash: features of an entry")
    hash_log2_size: int = Field(16, ge=4, le=24, description="encoder hash: binary logarithm of the entries of a level")
    hash_coarsest_cells: int = Field(16, ge=1, description="encoder hash: cells along the longest side, coarsest level")
    hash_finest_m: float = Field(0.02, gt=0, description="encoder hash: cell of the finest level, m")
    level_resolutions_m: tuple[float, ...] = Field(
        (0.32, 0.16), min_length=1, description="encoder grids: node spacing of each level of the geometry, m"
    )
    color_level_resolutions_m: tuple[float, ...] = Field(
        (0.16,), min_length=1, description="encoder grids: node spacing of each level of the colour, m"
    )
    level_channels: int = Field(32, gt=0, multiple_of=4, description="encoder grids: features of a node")
    grid_voxel_m: float = Field(0.1, gt=0, description="node spacing of the dense feature grid V_alpha, m")
    grid_channels: int = Field(4, ge=0, multiple_of=4, description="features of a node of V_alpha; 0: there is none")
    oneblob_bins: int = Field(16, ge=2, description="bins per axis of the OneBlob encoding")
    hidden: int = Field(32, gt=0, multiple_of=8, description="width of the hidden layer of every decoder")
    geometry_features: int = Field(15, gt=0, description="features that the geometry decoder hands to the colour one")
    max_table_megabytes: float = Field(
        512.0, gt=0, description="refuse bounds and resolutions whose feature tables need more memory, MB"
    )

    truncation_m: float = Field(0.1, gt=0, description="distance at which the SDF is truncated, m")
    bell_width_m: float = Field(
        0.01, gt=0, description="width of the bell that turns SDF values into rendering weights, m of SDF"
    )
    sigma_prior_m: float = Field(0.3, gt=0, description="standard deviation of the SDF where nothing was seen, m")
    sigma_floor_m: float = Field(0.002, gt=0, description="smallest standard deviation of the SDF, m")

    rays: int = Field(512, gt=0, description="rays per iteration")
    surface_points: int = Field(
        4096, ge=0, description="and readings at which the SDF is held at zero: a sixteenth of what a ray costs, each"
    )
    free_samples: int = Field(6, ge=0, description="stratified samples a ray between camera and truncation band")
    surface_samples: int = Field(9, gt=1, description="stratified samples a ray within the truncation band")
    behind_fraction: float = Field(
        0.5, gt=0, le=1, description="part of the truncation band behind the surface that is sampled"
    )
    prior_points: int = Field(512, ge=0, description="random points per iteration that hold unseen space at its prior")

    rate_tables: float = Field(0.01, gt=0, description="Adam learning rate of planes and grid")
    rate_decoders: float = Field(0.01, gt=0, description="Adam learning rate of the decoders")
    beta1: float = Field(0.9, ge=0, lt=1, description="Adam decay of the first moment")
    beta2: float = Field(0.99, ge=0, lt=1, description="Adam decay of the second moment")
    adam_eps: float = Field(1e-15, gt=0, description="Adam denominator offset")

    weight_rgb: float = Field(5.0, ge=0, description="weight of the colour loss")
    weight_depth: float = Field(0.1, ge=0, description="weight of the rendered depth loss, 1/m2")
    weight_sdf: float = Field(1000.0, ge=0, description="weight of the SDF loss in the truncation band, 1/m2")
    weight_surface: float = Field(1000.0, ge=0, description="weight of the squared SDF at readings, 1/m2")
    weight_free: float = Field(10.0, ge=0, description="weight of the free-space loss, in truncation units")
    weight_uncertainty: float = Field(0.02, ge=0, description="weight of the uncertainty losses")
    weight_prior: float = Field(0.005, ge=0, description="weight of the uncertainty prior in unseen space")
    weight_smoothness: float = Field(0.001, ge=0, description="weight of the smoothness loss, in truncation units")
    smoothness_step_m: float = Field(0.05, gt=0, description="distance of the point pairs of the smoothness loss, m")

    @field_validator(
        "plane_resolutions_m", "color_plane_resolutions_m", "level_resolutions_m", "color_level_resolutions_m"
    )
    @classmethod
    def _positive(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if min(value) <= 0:
            raise ValueError("every resolution must be positive")
        return value

    @model_validator(mode="after")
    def _head_sees_something(self) -> Self:
        if self.encoder == "none" and self.grid_channels == 0:
            raise ValueError(
                "encoder none and grid_channels 0: expected one of them, or the uncertainty head sees nothing of places"
            )
        return self


class TsdfSettings(Settings):
    """TSDF fusion in place of the neural field (`mapping.geometry = "tsdf"`)."""

    voxel_m: float = Field(0.02, gt=0, description="edge of a voxel, m")
    truncation_m: float = Field(0.08, gt=0, description="distance at which the SDF is truncated, m")
    sigma_prior_m: float = Field(0.3, gt=0, description="standard deviation of the SDF where nothing was fused, m")
    max_megabytes: float = Field(2048.0, gt=0, description="refuse to hold more voxels than fit into this, MB")
