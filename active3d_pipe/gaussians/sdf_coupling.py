"""E_geo of eq. sw_energy: the Gaussians agree with the signed distance field."""

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.parameters import LOG_SCALES, MEANS, QUATS, WIDTH
from active3d_pipe.geometry import se3


def sdf_gradient(
    values: np.ndarray, sdf: np.ndarray, sdf_grad: np.ndarray, settings: GaussianSettings
) -> tuple[dict[str, float], np.ndarray]:
    """Energy that pulls means to the zero level and shortest axes to the field's gradient.

    E_geo = mean over coupled i of [ w |SDF(mu_i)| + v (1 - (a_i . n_i)^2) ], a_i the axis of the smallest scale,
    n_i the unit gradient of the field; coupled are the means with |SDF| below `sdf_band_m` and a gradient.

    Args:
        values: (N, 14) float32 of the primitives that take part (`GaussianParameters`).
        sdf: (N,) field at the means, m. NaN where the field is not trusted: such means are not coupled.
        sdf_grad: (N, 3) its gradient with respect to the world position.
        settings: w = `sdf_weight`, v = `sdf_normal_weight`, `sdf_band_m`.

    Returns:
        {energy, sdf_l1 (m), normal, coupled} and dE/dvalues (N, 14) float32.
    """
    n = len(values)
    if sdf.shape != (n,) or sdf_grad.shape != (n, 3):
        raise InputError(f"sdf coupling: sdf {sdf.shape}, gradient {sdf_grad.shape}, expected {(n,)} and {(n, 3)}")
    gradient = np.zeros((n, WIDTH), np.float32)
    length = np.linalg.norm(sdf_grad, axis=1)
    with np.errstate(invalid="ignore"):
        i = np.flatnonzero((np.abs(sdf) < settings.sdf_band_m) & (length > 1e-6))
    if len(i) == 0:
        return {"energy": 0.0, "sdf_l1": 0.0, "normal": 0.0, "coupled": 0.0}, gradient
    normals = sdf_grad[i] / length[i, None]
    quats = values[i, QUATS].astype(np.float64)
    shortest = values[i, LOG_SCALES].argmin(axis=1)
    axes = np.take_along_axis(se3.matrix_from_quat(quats), shortest[:, None, None], axis=2)[..., 0]
    cosine = (axes * normals).sum(axis=1)

    gradient[i, MEANS] = settings.sdf_weight / len(i) * np.sign(sdf[i])[:, None] * sdf_grad[i]
    d_axis = (-2 * settings.sdf_normal_weight / len(i) * cosine)[:, None] * normals
    gradient[i, QUATS] = _axis_to_quat(quats, axes, d_axis)
    l1, normal = float(np.abs(sdf[i]).mean()), float((1 - cosine**2).mean())
    energy = settings.sdf_weight * l1 + settings.sdf_normal_weight * normal
    return {"energy": energy, "sdf_l1": l1, "normal": normal, "coupled": float(len(i))}, gradient


def _axis_to_quat(quats: np.ndarray, axes: np.ndarray, d_axis: np.ndarray) -> np.ndarray:
    """dE/dquats (M, 4) from dE/d(column of the rotation matrix) (M, 3).

    A rotation by the small vector w (world) changes the axis by w x axis, so dE/dw = axis x d_axis; and
    dq = 1/2 (0, w) q, whose pullback divided by |q| is free of a radial part.
    """
    size = np.linalg.norm(quats, axis=1, keepdims=True)
    w, v = quats[:, :1] / size, quats[:, 1:] / size
    torque = np.cross(axes, d_axis)
    # w as a function of a unit-quaternion change dq: w = 2 (dq q*)_vec; pull the torque back through it.
    d_w = -(torque * v).sum(axis=1, keepdims=True)
    d_v = w * torque + np.cross(torque, v)
    return 2 * np.concatenate([d_w, d_v], axis=1) / size
