"""Knobs of the mapping room."""

from typing import Literal

from pydantic import Field

from active3d_pipe.field.config import FieldSettings, TsdfSettings
from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.structures import Settings


class KeyframeSettings(Settings):
    """Which frames become keyframes (eq. kf_selection)."""

    policy: Literal["uncertainty", "every_n"] = Field("uncertainty", description="eq. kf_selection, or every n-th")
    every_n: int = Field(5, ge=1, description="policy every_n: distance between keyframes, steps")
    tau_view: float = Field(0.18, ge=0, le=1, description="least viewpoint divergence delta_c from every keyframe")
    tau_info: float = Field(25.0, ge=0, description="least hybrid information gain of a frame, bits")
    tau_rho: float = Field(0.005, ge=0, le=1, description="least share of visible voxels that lie in V_high")
    tau_high: float = Field(0.15, ge=0, description="uncertainty above which a voxel belongs to V_high")
    high_branches: tuple[Literal["imp", "exp"], ...] = Field(
        ("imp", "exp"), min_length=1, description="branches whose uncertainty must exceed tau_high in V_high"
    )
    max_gap: int = Field(8, ge=1, description="a frame that diverges enough is promoted after this many steps anyway")


class WindowSettings(Settings):
    """Which keyframes are optimised together (eq. sw_energy)."""

    policy: Literal["viewpoint", "temporal"] = Field("viewpoint", description="nearest in viewpoint space or in time")
    size: int = Field(10, ge=1, description="number of keyframes in the window")
    replay: float = Field(0.3, ge=0, le=1, description="share of iterations on random older keyframes (E_reg)")
    submap_keyframes: int = Field(
        0, ge=0, description="so many keyframes later the Gaussians rest until the refinement, new ones begin; 0: never"
    )


class ExtentSettings(Settings):
    """The box of the map when `scene.bounds` is "auto": found in the depth readings, grown with them."""

    margin_m: float = Field(
        0.15, gt=0, description="the box reaches at least this far beyond every depth reading, else it grows, m"
    )
    chunk_m: float = Field(0.4, gt=0, description="a side of the box moves by multiples of this when it grows, m")
    max_extent_m: float = Field(40.0, gt=0, description="growth ends at this length of an edge of the box, m")
    max_volume_m3: float = Field(
        4000.0, gt=0, description="growth ends at this volume of the box, m3 (about 0.2 MB each at voxels of 0.1 m)"
    )


class MappingSettings(Settings):
    """The hybrid map and its optimisation."""

    representation: Literal["hybrid", "implicit_only", "explicit_only"] = Field(
        "hybrid", description="hybrid: branches coupled; the others are the variants of the paper's table `converge`"
    )
    geometry: Literal["neural", "tsdf"] = Field("neural", description="the SDF: neural field, or TSDF fusion")
    views: Literal["gaussians", "surface"] = Field(
        "gaussians", description="what renders views; surface: the SDF's zero level and its colour, without Gaussians"
    )
    gaussian_iterations_per_step: float = Field(0.5, ge=0, description="rasteriser iterations for every captured frame")
    field_iterations_per_step: float = Field(0.25, ge=0, description="field iterations for every captured frame")
    gaussian_iterations_per_keyframe: float = Field(1.5, ge=0, description="and for every keyframe")
    field_iterations_per_keyframe: float = Field(0.75, ge=0, description="and for every keyframe")
    round_stride: int = Field(
        2, ge=1, description="rounds train Gaussians on means of n x n pixels; the refinement on every pixel"
    )
    first_round_factor: float = Field(1.5, gt=0, description="iterations of round 0 are multiplied by this")
    coupling_every: int = Field(10, ge=1, description="E_geo is applied on every n-th Gaussian iteration")
    add_per_round: int = Field(6000, ge=0, description="most primitives that error-driven adding inserts in a round")
    adding_share: float = Field(0.5, gt=0, le=1, description="adding stops at this share of max_count in a round ...")
    seeding_share: float = Field(0.8, gt=0, le=1, description="... seeding at this; the rest is for the refinement")
    refinement_growth: float = Field(0.75, ge=0, description="primitives that refinement may add, relative to before")
    learning_rate_scale: float = Field(0.4, gt=0, description="scale on the Gaussians' learning rates while exploring")
    refinement_iterations: int = Field(4000, ge=0, description="annealed iterations over all logged frames, in export")
    refinement_balance: float = Field(
        0.5, ge=0, description="visits of the refinement to a frame go with this power of its exposure (frame_order)"
    )
    refinement_sight_weight: float = Field(
        1.0, ge=0, description="`gaussians.sight_weight` of the refinement: primitives gather at the observed depth"
    )
    refinement_field_iterations: int = Field(400, ge=0, description="annealed field iterations, in export")
    field: FieldSettings = Field(default_factory=FieldSettings, description="implicit branch")
    tsdf: TsdfSettings = Field(default_factory=TsdfSettings, description="implicit branch, with geometry tsdf")
    gaussians: GaussianSettings = Field(default_factory=GaussianSettings, description="explicit branch")
    keyframes: KeyframeSettings = Field(default_factory=KeyframeSettings, description="keyframe selection")
    window: WindowSettings = Field(default_factory=WindowSettings, description="viewpoint-space sliding window")
    extent: ExtentSettings = Field(default_factory=ExtentSettings, description="box of the map of an unknown scene")
