"""The slow twin of `kernels.py`: the same formulas over whole volumes."""

from collections.abc import Mapping

import numpy as np

from active3d_pipe.information.config import InformationSettings
from active3d_pipe.information.gain import (
    FREE,
    OPEN,
    SURFACE,
    THIN_HIT_SHARE,
    InformationVolumes,
    hybrid_weight,
    normalised_uncertainty,
)


def classify(arrays: Mapping[str, np.ndarray], settings: InformationSettings) -> np.ndarray:
    """As `gain.classify`."""
    free, hit, occupancy = arrays["free_evidence"], arrays["hit_evidence"], arrays["occupancy"]
    rays = free + hit
    surface = (hit > 0) & ((occupancy > 0.5) | (hit >= np.maximum(2, THIN_HIT_SHARE * rays)))
    seen_free = ~surface & (free >= settings.settled_rays)
    return np.where(surface, SURFACE, np.where(seen_free, FREE, OPEN)).astype(np.uint8)


def information_volumes(
    arrays: Mapping[str, np.ndarray], settings: InformationSettings, enough_quality: float, credit: np.ndarray,
    kind: np.ndarray,
) -> InformationVolumes:
    """As `gain.information_volumes`."""
    rays = arrays["free_evidence"] + arrays["hit_evidence"]
    u = normalised_uncertainty(arrays["u_final"], rays > 0)
    weight = hybrid_weight(u, arrays["entropy"], settings)
    novelty = np.where(kind == OPEN, np.maximum(0, 1 - rays / np.float32(settings.settled_rays)), 0)
    # What a better look still brings to a surface, as a fraction of the whole improvement.
    rest = np.maximum(0, 1 - arrays["view_quality"] / np.float32(enough_quality))
    rest = np.where(kind == SURFACE, rest, 0)
    value = weight * (1 - arrays["occupancy"]) * novelty * credit
    surface_value = (settings.alpha * u + settings.beta) * (kind == SURFACE) * settings.surface_weight * credit
    fraction = (novelty + rest) * credit

    def reduction(entropy: np.ndarray) -> np.ndarray:
        return (np.maximum(0, entropy - settings.residual_bits) * fraction).astype(np.float32)

    return InformationVolumes(
        kind, value.astype(np.float32), surface_value.astype(np.float32), arrays["view_quality"],
        reduction(arrays["entropy_imp"]), reduction(arrays["entropy_exp"]),
    )
