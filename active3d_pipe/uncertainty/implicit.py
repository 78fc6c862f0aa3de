"""Global structure uncertainty: what the field says about itself (eq. global_uncertainty)."""

import numpy as np
from scipy.special import ndtr

from active3d_pipe.information.entropy import bernoulli_entropy
from active3d_pipe.uncertainty.config import UncertaintySettings


def implicit_uncertainty(sigma: np.ndarray, known: np.ndarray, settings: UncertaintySettings) -> np.ndarray:
    """u_imp in 0..1 before masking, any shape.

    The field's sigma saturates as 1 - exp(-sigma / sigma_scale_m). Where nothing was observed the head extrapolates
    and may say anything; there u_imp is 1, and it moves to the head's value as knowledge grows.

    Args:
        sigma: softplus output of the uncertainty head, m. known: share of knowledge in 0..1, see `knowledge`.
    """
    return 1 - known * np.exp(sigma * np.float32(-1 / settings.sigma_scale_m))


def knowledge(observed: np.ndarray, hits: np.ndarray, settings: UncertaintySettings) -> np.ndarray:
    """Share of what can be known of a voxel that was seen, float32 [X, Y, Z].

    A few rays settle that a voxel is free (`observed`, see `occupancy.observation`); the shape of a surface takes
    many that end on it. Their number falls with distance and grazing angle, so that surface seen from afar or
    along itself stays less known.
    """
    surface = -np.expm1(hits * np.float32(-1 / settings.surface_rays))
    return np.where(hits > 0, observed * surface, observed).astype(np.float32)


def cube_support(sdf: np.ndarray, voxel_size: float) -> np.ndarray:
    """(X, Y, Z) float32 distance from a voxel's centre to its border towards the surface, m.

    A voxel holds surface or solid exactly when SDF(centre) < this support of the cube along the SDF's gradient n:
    voxel_size / 2 x (|n_x| + |n_y| + |n_z|) for unit n. It lies between 0.5 and 0.87 voxels, and is 0.5 where the
    gradient vanishes (the field saturates at its truncation distance).
    """
    one_norm, square = np.zeros_like(sdf), np.zeros_like(sdf)
    for axis in range(3):
        if sdf.shape[axis] > 1:
            g = np.abs(np.gradient(sdf, axis=axis))
            one_norm += g
            square += g * g
    norm = np.sqrt(square)
    ratio = np.divide(one_norm, norm, out=np.ones_like(sdf), where=norm > 1e-6 * voxel_size)
    return np.float32(0.5 * voxel_size) * ratio


def implicit_occupancy(
    sdf: np.ndarray, sigma: np.ndarray, observed: np.ndarray, support: np.ndarray, settings: UncertaintySettings
) -> np.ndarray:
    """P(voxel holds surface or solid) by the field, float32 [X, Y, Z].

    SDF(centre) ~ N(sdf, sigma^2), so P = Phi((support - sdf) / sigma), see `cube_support`: depth rays that end in a
    voxel and the field then speak of the same event. Prior 0.5 where nothing was observed.
    """
    p = ndtr((support - sdf) / np.maximum(sigma, np.float32(settings.sigma_floor_m)))
    return (0.5 + observed * (p - 0.5)).astype(np.float32)


# Integral of H[Phi(z)] from 0 to z: the entropy of a sign whose mean lies z standard deviations from zero.
_Z = np.linspace(-8, 8, 4097)
_H = bernoulli_entropy(ndtr(_Z))
ENTROPY_INTEGRAL = np.concatenate([[0], np.cumsum((_H[1:] + _H[:-1]) / 2 * np.diff(_Z))])
ENTROPY_INTEGRAL = ENTROPY_INTEGRAL - ENTROPY_INTEGRAL[len(_Z) // 2]
ENTROPY_REACH = float(_Z[-1])


def implicit_entropy(
    sdf: np.ndarray, sigma: np.ndarray, observed: np.ndarray, support: np.ndarray, settings: UncertaintySettings
) -> np.ndarray:
    """H[p_F(v)] of eq. hybrid_entropy before masking, bits in 0..1, float32 [X, Y, Z].

    The mean over the voxel of the entropy of P(SDF(x) < 0) under N(SDF(x), sigma^2), taken along the surface normal,
    where the SDF runs through sdf - support .. sdf + support. It is near 2.2 sigma / voxel_size in a surface voxel
    and falls with sigma towards 0. The entropy of `implicit_occupancy` would not: where a wall runs along the border
    between two voxels, whether it touches one of them stays a coin toss that no view can settle.
    1 where nothing was observed.
    """
    scale = np.maximum(sigma, np.float32(settings.sigma_floor_m))
    low, high = ((sdf + sign * support) / scale for sign in (np.float32(-1), np.float32(1)))
    low_sum, high_sum = (np.interp(z, _Z, ENTROPY_INTEGRAL) for z in (low, high))
    h = np.clip((high_sum - low_sum) / (high - low), 0, 1)
    return (1 - observed * (1 - h)).astype(np.float32)
