"""Occupancy O(v) of both branches and their Shannon entropy (eq. hybrid_entropy).

Alphabet: `p` probability that a voxel holds surface or solid, `h` entropy in bits, log-odds with natural logarithm.
"""

import numpy as np
from scipy.special import expit, logit

from active3d_pipe.structures import GaussianModel, VoxelGrid
from active3d_pipe.uncertainty import kernels
from active3d_pipe.uncertainty.carving import RayEvidence
from active3d_pipe.uncertainty.config import UncertaintySettings


def observation(evidence: RayEvidence, settings: UncertaintySettings) -> np.ndarray:
    """Share of observation, 0 where no ray went, towards 1 with the number of rays; float32 [X, Y, Z]."""
    return -np.expm1((evidence.free + evidence.hit) * np.float32(-1 / settings.observation_rays))


def ray_log_odds(evidence: RayEvidence, settings: UncertaintySettings) -> np.ndarray:
    """Log-odds of occupancy from depth rays; 0 where no ray went.

    Hits and passes are clamped apart, hits higher: a thin pole is passed by far more rays than end on it, and stays
    occupied from the third return on; a single stray return in space that many rays passed does not.
    """
    hits = np.minimum(evidence.hit * np.float32(settings.hit_log_odds), np.float32(settings.hit_log_odds_max))
    frees = np.minimum(evidence.free * np.float32(settings.free_log_odds), np.float32(settings.free_log_odds_max))
    return hits - frees


def attention(evidence: RayEvidence, settings: UncertaintySettings) -> np.ndarray:
    """1 where a voxel is unseen or occupied, towards 0 the surer rays say that it is free; float32 [X, Y, Z].

    It masks whatever the field invents in space that was seen to be free (phantom structure).
    """
    return np.minimum(1, 2 * expit(ray_log_odds(evidence, settings)))


def resolvable(vain_looks: np.ndarray, observed: np.ndarray, settings: UncertaintySettings) -> np.ndarray:
    """Share of a voxel's uncertainty that another look may still settle; float32 [X, Y, Z].

    Every round of looks in vain leaves `vain_keep` of what is unseen (mirrors, glass, missing depth); what rays did
    observe is not touched.
    """
    lost = 1 - np.float32(settings.vain_keep) ** vain_looks
    return 1 - (1 - observed) * lost


def opacity_mass(grid: VoxelGrid, gaussians: GaussianModel) -> np.ndarray:
    """Opaque area of the Gaussians in each voxel, in units of a voxel face; float32 [X, Y, Z]."""
    mass = np.zeros((kernels.CHUNKS, *grid.shape), np.float32)
    if len(gaussians):
        kernels.splat_opacity(
            gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, grid.origin,
            1 / grid.voxel_size, mass,
        )
    return mass.sum(0)


def explicit_log_odds(evidence: RayEvidence, mass: np.ndarray, settings: UncertaintySettings) -> np.ndarray:
    """Log-odds by rays and Gaussians; exactly 0 where no ray went."""
    from_gaussians = -np.expm1(-mass) * np.float32(settings.gaussian_log_odds)
    return ray_log_odds(evidence, settings) + np.where(evidence.free + evidence.hit > 0, from_gaussians, 0)


def hybrid_occupancy(
    log_odds_exp: np.ndarray, p_imp: np.ndarray, evidence: RayEvidence, settings: UncertaintySettings
) -> np.ndarray:
    """O(v): rays, Gaussians and the field together, float32 [X, Y, Z]; 0.5 where no ray went.

    The field may only tip what rays leave open (its say is clamped): it fills gaps between rays, and what it
    invents in seen free space stays free (paper, appendix on the risk field).
    """
    bound = settings.sdf_log_odds_max
    from_field = np.clip(logit(np.clip(p_imp, 1e-6, 1 - 1e-6)), -bound, bound)
    seen = evidence.free + evidence.hit > 0
    return expit(log_odds_exp + np.where(seen, from_field, 0)).astype(np.float32)
