"""How much a look is expected to tell: the knobs of `gain.py`."""

from pydantic import Field

from active3d_pipe.structures.settings import Settings


class InformationSettings(Settings):
    """Weights and the observation model of the expected information gain."""

    alpha: float = Field(0.5, ge=0, description="weight of the uncertainty U(v) (eq. nbv_weight)")
    beta: float = Field(0.5, ge=0, description="weight of the hybrid entropy H(v) in bits (eq. nbv_weight)")
    surface_weight: float = Field(
        0.3, ge=0, description="weight of improving a surface seen poorly, against discovering a voxel"
    )
    residual_bits: float = Field(
        0.1, ge=0, le=1, description="entropy that a voxel keeps, per branch, after it has been seen, bits"
    )
    settled_rays: float = Field(3.0, gt=0, description="depth rays after which a voxel counts as seen")
    enough_quality: float = Field(
        0.35, gt=0, le=1, description="view quality from which a surface is seen well enough: closer looks earn nothing"
    )
    quality_range_m: float = Field(
        1.0, gt=0, description="distance up to which a frontal look has quality 1; beyond it falls with 1 / distance"
    )
