"""How much a look is expected to tell: the knobs of `gain.py`."""

from pydantic import Field

from active3d_pipe.structures.settings import Settings

SETTLED_RAYS = 3.0


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
    settled_rays: float = Field(SETTLED_RAYS, gt=0, description="depth rays after which a voxel counts as seen")
    reference_footprint_m: float = Field(
        0.005, gt=0, description="width of a pixel on a frontal surface at which a look has quality 1, m (the scale of "
        "the volume view_quality)"
    )
    enough_distance_m: float = Field(
        3.0, gt=0, description="a surface seen frontally from here was seen well enough: closer looks earn nothing"
    )

    def quality_range_m(self, focal_px: float) -> float:
        """Distance up to which a frontal look has quality 1; beyond it quality falls with 1 / distance."""
        return self.reference_footprint_m * focal_px

    def enough_quality(self, focal_px: float) -> float:
        """View quality from which nothing is gained by a better look."""
        return min(1.0, self.quality_range_m(focal_px) / self.enough_distance_m)
