"""Rigid transforms. `T_dst_src` maps src coordinates to dst; quaternions are (w, x, y, z)."""

import math
from collections.abc import Sequence

import numpy as np


def inverse(T: np.ndarray) -> np.ndarray:
    """T_src_dst of a rigid T_dst_src; (..., 4, 4)."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    out = np.zeros_like(T)
    Rt = np.swapaxes(R, -1, -2)
    out[..., :3, :3] = Rt
    out[..., :3, 3] = -(Rt @ t[..., None])[..., 0]
    out[..., 3, 3] = 1
    return out


def transform_points(T_dst_src: np.ndarray, points_src: np.ndarray) -> np.ndarray:
    """Map (..., 3) points from src to dst."""
    return points_src @ T_dst_src[:3, :3].T + T_dst_src[:3, 3]


def look_at(position: np.ndarray, target: np.ndarray, up: Sequence[float] = (0.0, 0.0, 1.0)) -> np.ndarray:
    """T_world_camera (4, 4) of a camera at `position` that looks at `target`, image y axis away from `up`.

    When the viewing direction is parallel to `up`, the world x axis stands in for `up`.
    """
    position = np.asarray(position, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = right, down, forward, position
    return T


def pose_from_yaw_pitch(position: np.ndarray, yaw_rad: float, pitch_rad: float) -> np.ndarray:
    """T_world_camera of a level camera: yaw counter-clockwise about +z from +x, pitch upwards."""
    c = math.cos(pitch_rad)
    forward = np.array([c * math.cos(yaw_rad), c * math.sin(yaw_rad), math.sin(pitch_rad)])
    right = np.array([math.sin(yaw_rad), -math.cos(yaw_rad), 0.0])
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = right, np.cross(forward, right), forward, position
    return T


def yaw_pitch(T_world_camera: np.ndarray) -> tuple[float, float]:
    """(yaw, pitch) in rad of the viewing direction; inverse of `pose_from_yaw_pitch` for level cameras."""
    f = T_world_camera[:3, 2]
    return math.atan2(f[1], f[0]), math.asin(float(np.clip(f[2], -1, 1)))


def quat_from_matrix(R: np.ndarray) -> np.ndarray:
    """(4,) unit quaternion (w, x, y, z), w >= 0, of a rotation matrix (3, 3)."""
    m = np.asarray(R, dtype=np.float64)
    K = np.array([
        [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
        [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
        [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], 0],
        [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
    ]) / 3.0
    values, vectors = np.linalg.eigh(K)
    x, y, z, w = vectors[:, np.argmax(values)]
    q = np.array([w, x, y, z])
    return q if w >= 0 else -q


def matrix_from_quat(q: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotation matrices of quaternions (..., 4) wxyz, normalised first."""
    q = np.asarray(q)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2)


def rotation_angle(R_a: np.ndarray, R_b: np.ndarray) -> float:
    """Angle in rad between two rotations."""
    c = (np.trace(R_a.T @ R_b) - 1) / 2
    return math.acos(float(np.clip(c, -1, 1)))


def slerp(R_a: np.ndarray, R_b: np.ndarray, s: float) -> np.ndarray:
    """Rotation at fraction `s` of the shortest way from R_a to R_b, (3, 3)."""
    qa, qb = quat_from_matrix(R_a), quat_from_matrix(R_b)
    dot = float(qa @ qb)
    if dot < 0:
        qb, dot = -qb, -dot
    theta = math.acos(min(dot, 1.0))
    if theta < 1e-8:
        return np.array(R_b, dtype=np.float64) if s >= 1 else np.array(R_a, dtype=np.float64)
    q = (math.sin((1 - s) * theta) * qa + math.sin(s * theta) * qb) / math.sin(theta)
    return matrix_from_quat(q)
