"""Which way to look on the way to a view."""

import numpy as np

from active3d_pipe.planning.candidates import Directions
from active3d_pipe.planning.reward import RewardField, sphere_rewards
from active3d_pipe.structures.motion import MotionSettings


def looks_along(
    points: np.ndarray,
    R_start: np.ndarray,
    T_goal: np.ndarray,
    field: RewardField,
    directions: Directions,
    motion: MotionSettings,
    spacing_m: float,
) -> list[tuple[float, np.ndarray]]:
    """Which way to look along a path (M, 3): (arc length, rotation), the goal's last.

    The integral of the reward along the path (eq. risk_path) for the looking directions: dynamic programming over
    the view directions at waypoints, where consecutive directions lie within what the steps between them can turn.
    """
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    arc = np.concatenate([[0], np.cumsum(lengths)])
    goal = (float(arc[-1]), T_goal[:3, :3])
    n = int(arc[-1] / spacing_m)
    if n < 1:
        return [goal]
    s = arc[-1] * np.arange(1, n + 1) / (n + 1)
    waypoints = np.stack([np.interp(s, arc, points[:, i]) for i in range(3)], axis=-1)
    rewards = sphere_rewards(field, waypoints, directions).astype(np.float64)
    turn = np.radians(motion.max_turn_deg) * max(1.0, np.floor(arc[-1] / (n + 1) / motion.max_step_m))
    R = directions.rotations
    angle, flat = directions.angles, R.reshape(len(R), 9)

    def off(other: np.ndarray) -> np.ndarray:
        return np.arccos(np.clip((flat @ other.ravel() - 1) / 2, -1, 1))

    from_start, to_goal = off(R_start), off(T_goal[:3, :3])
    # Turning farther than the steps allow costs steps on the spot: forbidden unless nothing else is possible.
    penalty = 1e3 * (1 + rewards.max())

    def over(a: np.ndarray) -> np.ndarray:
        return penalty * np.maximum(0, a - turn - 1e-6)

    value = rewards[0] - over(from_start)
    back = []
    for w in range(1, n):
        reach = value[:, None] - over(angle)
        back.append(reach.argmax(axis=0))
        value = reach.max(axis=0) + rewards[w]
    v = int((value - over(to_goal)).argmax())
    chosen = [v]
    for pointer in reversed(back):
        v = int(pointer[v])
        chosen.append(v)
    views = [(float(a), R[v]) for a, v in zip(s, reversed(chosen), strict=True)]
    return [*views, goal]
