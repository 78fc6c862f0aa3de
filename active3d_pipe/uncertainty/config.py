"""Knobs of the uncertainty volume. Every length is metric, every scale physical; none is fitted to a scene."""

from typing import Literal, Self

from pydantic import Field, model_validator

from active3d_pipe.structures import Settings

Term = Literal["imp", "exp", "time"]


class UncertaintySettings(Settings):
    """How evidence is gathered and how the three terms are formed and fused (paper, sec. uncertainty_map)."""

    voxel_size_m: float = Field(0.1, gt=0, description="edge of a voxel of every volume, m")
    margin_m: float = Field(
        0.1, ge=0, description="border that the grid adds, so that walls on the border of the bounds lie inside it, m"
    )

    # Free and hit evidence from depth rays
    ray_stride: int = Field(
        0, ge=0, description="every n-th pixel in x and y casts a ray into the grid; 0 = so many that rays lie a voxel "
        "apart 5 m away, whatever the resolution"
    )
    free_log_odds: float = Field(0.5, gt=0, description="log-odds taken from a voxel by a ray that passed it")
    hit_log_odds: float = Field(2.5, gt=0, description="log-odds given to a voxel by a ray that ended in it")
    free_log_odds_max: float = Field(7.0, gt=0, description="most that passing rays together may take, log-odds")
    hit_log_odds_max: float = Field(9.0, gt=0, description="most that ending rays together may give, log-odds")
    gaussian_log_odds: float = Field(2.0, ge=0, description="log-odds of a voxel full of opaque Gaussians")
    sdf_log_odds_max: float = Field(1.5, ge=0, description="most that the field may say about occupancy, log-odds")
    observation_rays: float = Field(
        2.0, gt=0, description="number of rays after which a voxel counts as observed to 63 percent"
    )
    reference_footprint_m: float = Field(
        0.005, gt=0, description="width of a pixel on the surface at which an observation counts as close, m"
    )
    vain_range_m: float = Field(
        2.0, gt=0, description="a ray without a reading is a look in vain at voxels up to this depth, m"
    )
    vain_keep: float = Field(
        0.5, ge=0, le=1, description="share of a voxel's unseen uncertainty that a round of looks in vain leaves"
    )

    # Implicit term
    field_turns: int = Field(
        3, ge=1, description="rounds in which the field is asked once about all that matters; near the newest rays it "
        "is asked in every round"
    )
    sigma_scale_m: float = Field(0.5, gt=0, description="field sigma at which u_imp reaches 63 percent, m")
    surface_rays: float = Field(
        2.2, gt=0, description="number of rays that end in a voxel after which its surface is known to 63 percent"
    )
    sigma_floor_m: float = Field(0.01, gt=0, description="least field sigma believed for occupancy, m")

    # Explicit term
    top_k_views: int = Field(2, ge=0, description="size of C_high: most uncertain keyframes that are rendered again")
    render_every: int = Field(4, ge=1, description="every n-th new frame is rendered with the map of its round")
    predict_every: int = Field(5, ge=1, description="every n-th new frame is predicted by the map of the round before")
    render_stride: int = Field(4, ge=1, description="those renderings have this fraction of the camera's resolution")
    residual_blur_voxels: float = Field(
        0.7, ge=0, description="standard deviation of the neighbourhood over which residuals are averaged, voxels"
    )
    residual_memory: float = Field(
        1.0, ge=0, description="number of views that the u_exp of the last round counts for in the running mean"
    )
    residual_stride: int = Field(1, ge=1, description="every n-th pixel of a residual image is back-projected")
    depth_residual_scale_m: float = Field(0.05, gt=0, description="depth error that counts as 63 percent, m")
    color_residual_scale: float = Field(
        0.3, gt=0, description="colour error, summed over R, G, B in 0..1, that counts as 63 percent"
    )
    depth_residual_weight: float = Field(0.5, ge=0, le=1, description="share of depth in the joint residual")

    # Temporal term; lengths compare with the field's truncation distance (0.1 m)
    beta_1: float = Field(0.5, ge=0, le=1, description="weight of the SDF change, measured in sdf_range_m")
    beta_2: float = Field(0.5, ge=0, le=1, description="weight of belonging to a new, changed or freed surface")
    sdf_range_m: float = Field(0.1, gt=0, description="SDF is clipped to this range before it is compared, m")
    tau_s_m: float = Field(0.05, gt=0, description="tau_s: a voxel this close in front of a surface is surface, m")
    tau_n_m: float = Field(0.03, gt=0, description="tau_n: SDF rise that makes a surface new, m")
    tau_c_m: float = Field(0.05, gt=0, description="tau_c: SDF change of either sign that is a change, m")
    tau_f_m: float = Field(0.03, gt=0, description="tau_f: SDF beyond which space is free, or was solid, m")
    temporal_decay: float = Field(0.8, ge=0, lt=1, description="share of u_time kept a round when nothing changes")

    # Fusion and entropy
    terms: tuple[Term, ...] = Field(("imp", "exp", "time"), min_length=1, description="terms that enter u_final")
    fusion: Literal["evidence", "equal"] = Field("evidence", description="alphas by evidence maximisation, or equal")
    forgetting: float = Field(0.8, gt=0, le=1, description="share of the fusion statistics kept a round")
    fusion_min_rows: int = Field(200, ge=4, description="rows needed before the alphas leave equal weights")
    lambda_imp: float = Field(0.5, ge=0, le=1, description="lambda_imp: weight of the field's entropy")
    lambda_exp: float = Field(0.5, ge=0, le=1, description="lambda_exp: weight of the observed entropy")

    @model_validator(mode="after")
    def _check_sums(self) -> Self:
        if self.lambda_imp + self.lambda_exp > 1 + 1e-9:
            raise ValueError("lambda_imp + lambda_exp: expected at most 1, so that entropy stays within 1 bit")
        if self.beta_1 + self.beta_2 > 1 + 1e-9:
            raise ValueError("beta_1 + beta_2: expected at most 1, so that u_time stays within 0..1")
        if len(set(self.terms)) != len(self.terms):
            raise ValueError(f"terms {list(self.terms)}: expected each term at most once")
        return self
