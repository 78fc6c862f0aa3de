"""Global structure uncertainty: what the field says about itself (eq. global_uncertainty)."""

import numpy as np
from scipy.special import ndtr

from active3d_pipe.uncertainty.config import UncertaintySettings


def implicit_uncertainty(sigma: np.ndarray, observed: np.ndarray, settings: UncertaintySettings) -> np.ndarray:
    """u_imp in 0..1 before masking, any shape.

    The field's sigma saturates as 1 - exp(-sigma / sigma_scale_m). Where nothing was observed the head extrapolates
    and may say anything; there u_imp is 1, and it moves to the head's value as observation grows.

    Args:
        sigma: softplus output of the uncertainty head, m. observed: share of observation in 0..1.
    """
    known = -np.expm1(sigma * np.float32(-1 / settings.sigma_scale_m))
    return 1 - observed * (1 - known)


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
    sdf: np.ndarray, sigma: np.ndarray, observed: np.ndarray, voxel_size: float, settings: UncertaintySettings
) -> np.ndarray:
    """P(voxel holds surface or solid) by the field, float32 [X, Y, Z].

    SDF(centre) ~ N(sdf, sigma^2), so P = Phi((support - sdf) / sigma), see `cube_support`: depth rays that end in a
    voxel and the field then speak of the same event. A well known surface has P near 1 and little entropy; a band
    of fixed width would leave every surface voxel undecided for ever. Prior 0.5 where nothing was observed.
    """
    scale = np.maximum(sigma, np.float32(settings.sigma_floor_m))
    p = ndtr((cube_support(sdf, voxel_size) - sdf) / scale)
    return (0.5 + observed * (p - 0.5)).astype(np.float32)
