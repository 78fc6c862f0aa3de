"""Slow twin of `kernels_terms.py`: the same from the formulas over whole volumes; what the tests compare it against."""

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.special import expit

from active3d_pipe.information.entropy import bernoulli_entropy
from active3d_pipe.structures import UncertaintyVolume
from active3d_pipe.uncertainty import implicit, occupancy, temporal
from active3d_pipe.uncertainty.carving import RayEvidence
from active3d_pipe.uncertainty.config import UncertaintySettings
from active3d_pipe.uncertainty.terms import MASKED, VoxelTerms


def voxel_terms(
    evidence: RayEvidence, fresh: RayEvidence, vain: np.ndarray, mass: np.ndarray,
    geometry: tuple[np.ndarray, np.ndarray], previous: UncertaintyVolume | None, settings: UncertaintySettings,
    voxel_size: float,
) -> VoxelTerms:
    """See `terms.voxel_terms`."""
    sdf, sigma = geometry
    observed = occupancy.observation(evidence, settings)
    open_share = occupancy.resolvable(vain, observed, settings)
    attention = open_share * occupancy.attention(evidence, settings)
    support = implicit.cube_support(sdf, voxel_size)
    p_imp = implicit.implicit_occupancy(sdf, sigma, observed, support, settings)
    log_odds = occupancy.explicit_log_odds(evidence, mass, settings)
    known = implicit.knowledge(observed, evidence.hit, settings)
    u_time = np.zeros(sdf.shape, np.float32)
    if previous is not None:
        # What the field does in space known to be free is a phantom, unless this round's rays found it otherwise;
        # space that was not known to be free before the round, and is now, is news.
        found = np.where(fresh.free + fresh.hit > 0, occupancy.attention(fresh, settings), 0)
        cells = evidence.passed, evidence.ended
        before = RayEvidence(evidence.free - fresh.free, evidence.hit - fresh.hit, evidence.quality, *cells)
        relevant = observed * np.maximum(found, occupancy.attention(before, settings))
        u_time = temporal.temporal_uncertainty(sdf, previous["sdf"], previous["u_time"], relevant, settings)
    return VoxelTerms(
        attention,
        attention * implicit.implicit_uncertainty(sigma, known, settings),
        u_time,
        occupancy.hybrid_occupancy(log_odds, p_imp, evidence, settings),
        attention * implicit.implicit_entropy(sdf, sigma, observed, support, settings),
        open_share * bernoulli_entropy(expit(log_odds)),
    )


def open_to_the_field(evidence: RayEvidence, settings: UncertaintySettings) -> np.ndarray:
    """See `terms.open_to_the_field`."""
    unseen = (evidence.free + evidence.hit == 0).view(np.uint8)
    surely_free = (occupancy.attention(evidence, settings) < MASKED).view(np.uint8)
    settled = [minimum_filter(a, size=3, mode="nearest") for a in (unseen, surely_free)]
    return (settled[0] | settled[1]) == 0


def due_to_the_field(
    asked: np.ndarray, late: np.ndarray, fresh: RayEvidence, round: int, settings: UncertaintySettings
) -> np.ndarray:
    """See `terms.due_to_the_field`."""
    near = maximum_filter(fresh.free + fresh.hit > 0, size=3, mode="nearest")
    turn = (sum(axis // 8 for axis in np.indices(asked.shape)) + round) % settings.field_turns == 0
    return asked & (late | near | turn)
