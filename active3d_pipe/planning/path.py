"""From a polyline and looking directions to one pose for every step."""

import math

import numpy as np

from active3d_pipe.geometry import se3
from active3d_pipe.structures.motion import MotionSettings

# Rounding must never push a step over its limit.
SLACK = 1 - 1e-6


def turn_towards(R: np.ndarray, R_goal: np.ndarray, limit_rad: float) -> np.ndarray:
    """The rotation at most `limit_rad` away from R on the way to R_goal.

    Level cameras stay level: yaw and pitch are interpolated. A camera with roll takes the shortest rotation.
    """
    angle = se3.rotation_angle(R, R_goal)
    if angle <= limit_rad:
        return np.array(R_goal, dtype=np.float64)
    if max(abs(R[2, 0]), abs(R_goal[2, 0])) > 1e-6:
        return se3.slerp(R, R_goal, limit_rad / angle * SLACK)
    yaw, pitch = _yaw_pitch(R)
    yaw_goal, pitch_goal = _yaw_pitch(R_goal)
    turn = math.remainder(yaw_goal - yaw, 2 * math.pi)
    s = 1.0
    while True:
        out = se3.pose_from_yaw_pitch(np.zeros(3), yaw + s * turn, pitch + s * (pitch_goal - pitch))[:3, :3]
        angle = se3.rotation_angle(R, out)
        if angle <= limit_rad:
            return out
        s *= min(0.999, limit_rad / angle * SLACK)


def resample(points: np.ndarray, step_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions along a polyline at equal arc length <= step_m, and that arc length; start excluded, end included."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    arc = np.concatenate([[0], np.cumsum(lengths)])
    n = math.ceil(arc[-1] / (step_m * SLACK) - 1e-12)
    s = arc[-1] * np.arange(1, n + 1) / max(n, 1)
    return np.stack([np.interp(s, arc, points[:, i]) for i in range(3)], axis=-1).reshape(-1, 3), s


def step_path(
    T_start: np.ndarray,
    points: np.ndarray,
    looks: list[tuple[float, np.ndarray]],
    motion: MotionSettings,
    max_steps: int | None = None,
) -> np.ndarray:
    """One pose a step along `points` (M, 3), the start excluded.

    Args:
        T_start: (4, 4) current pose; points[0] is its position.
        looks: (arc length m, rotation (3, 3)) in rising order: which way to look from there on; the last one is the
            goal's. On the way to a look the camera turns in time to be there when its arc length is reached, as far
            as the turn limit allows. Turning left over at the end happens on the spot.
        max_steps: cut after this many.

    Returns:
        (N, 4, 4) float64; consecutive poses (from T_start) obey `motion`.
    """
    limit = math.radians(motion.max_turn_deg) * SLACK
    positions, arcs = resample(points, motion.max_step_m)
    R = np.array(T_start[:3, :3], dtype=np.float64)
    out: list[np.ndarray] = []

    def emit(position: np.ndarray, R: np.ndarray) -> None:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, position
        out.append(T)

    target = 0
    for n, (position, s) in enumerate(zip(positions, arcs, strict=True)):
        while target < len(looks) - 1 and looks[target][0] < s - 1e-9:
            target += 1
        if looks:
            # Spread the turn over the steps that remain until the look is due.
            left = 1 + int(np.searchsorted(arcs[n + 1 :], looks[target][0] + 1e-9))
            angle = se3.rotation_angle(R, looks[target][1])
            R = turn_towards(R, looks[target][1], min(limit, angle / left + 1e-6))
        emit(position, R)
    end = points[-1]
    while looks and se3.rotation_angle(R, looks[-1][1]) > 1e-6 and (max_steps is None or len(out) < max_steps):
        R = turn_towards(R, looks[-1][1], limit)
        emit(end, R)
    return np.array(out[:max_steps]).reshape(-1, 4, 4)


def look_around(T_start: np.ndarray, turn_deg: float, pitch_deg: float, motion: MotionSettings) -> np.ndarray:
    """A turn on the spot, nodding up and down twice a revolution; (N, 4, 4), start excluded.

    Nodding widens what a camera of limited vertical field of view sees of floor and ceiling, and so the free space
    around the agent. Yaw advances as fast as the turn limit allows beside the nodding.
    """
    limit = math.radians(motion.max_turn_deg) * SLACK
    yaw0, pitch0 = se3.yaw_pitch(T_start)
    position = T_start[:3, 3]

    def pose(turned: float) -> np.ndarray:
        # Starts at the present pitch and swings about the horizon.
        fade = math.exp(-turned)
        pitch = pitch0 * fade - math.radians(pitch_deg) * math.sin(2 * turned)
        return se3.pose_from_yaw_pitch(position, yaw0 + turned, pitch)

    total = math.radians(turn_deg)
    R = np.array(T_start[:3, :3], dtype=np.float64)
    out: list[np.ndarray] = []
    if total <= 0:
        return np.zeros((0, 4, 4))
    # A camera with roll is levelled first.
    while se3.rotation_angle(R, pose(0.0)[:3, :3]) > 1e-6:
        R = turn_towards(R, pose(0.0)[:3, :3], limit)
        T = pose(0.0)
        T[:3, :3] = R
        out.append(T)
    turned = 0.0
    while turned < total - 1e-9:
        ahead = min(limit / max(math.cos(math.radians(pitch_deg)), 0.2), total - turned)
        while se3.rotation_angle(R, pose(turned + ahead)[:3, :3]) > limit:
            ahead *= 0.97
        turned += ahead
        out.append(pose(turned))
        R = out[-1][:3, :3]
    return np.array(out)


def _yaw_pitch(R: np.ndarray) -> tuple[float, float]:
    """Yaw from the right axis: it stays defined when the camera looks straight up or down."""
    return math.atan2(R[0, 0], -R[1, 0]), math.atan2(R[2, 2], -R[2, 1])
