"""What shapes the primitives may take: one scale for all axes (SplaTAM), or a pull towards it (MonoGS)."""

import numpy as np

from active3d_pipe.gaussians.parameters import LOG_SCALES, QUATS


def tie_scales(gradient: np.ndarray) -> None:
    """Make dL/dvalues (N, 14) that of spheres, in place: one shared log-scale, no rotation.

    With equal scales to start from, every axis then takes the same steps; the gradient of the shared log-scale is
    the sum over its three copies.
    """
    gradient[:, LOG_SCALES] = gradient[:, LOG_SCALES].sum(axis=1, keepdims=True)
    gradient[:, QUATS] = 0


def isotropy_gradient(values: np.ndarray, weight: float) -> tuple[float, np.ndarray]:
    """Energy that keeps primitives round, and its gradient with respect to the log-scales (N, 3) float32.

    E_iso = weight * mean over primitives i and axes j of |s_ij - mean_j s_ij|, s in m (Matsuki et al. 2024, Gaussian
    Splatting SLAM). `values` (N, 14), see `GaussianParameters`.
    """
    scales = np.exp(values[:, LOG_SCALES])
    apart = scales - scales.mean(axis=1, keepdims=True)
    sign = np.sign(apart)
    factor = np.float32(weight / max(apart.size, 1))
    return float(factor * np.abs(apart).sum()), factor * scales * (sign - sign.mean(axis=1, keepdims=True))
