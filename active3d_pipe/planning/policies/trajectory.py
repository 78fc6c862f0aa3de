"""A recorded trajectory: the poses of a file or of another run, one after the other.

The passive reference of active methods (NARUTO's `predefined_traj`; the recorded Replica trajectories of passive
SLAM). The poses come from `planning.trajectory`. Poses farther apart than one step are joined by straight
interpolation; a first pose that is not where the agent stands is walked to through known space where that is
possible. Recorded poses are taken as they are, known space or not, since whoever recorded them was there: only those
whose body would touch something that is known to be solid are left out, and the true scene is checked when they are
walked as always. It stops after the last pose. How far it came is remembered in `Decision.terms`.
"""

from typing import Any

import numpy as np

from active3d_pipe.errors import ConfigError
from active3d_pipe.geometry import se3
from active3d_pipe.planning.path import step_path
from active3d_pipe.planning.policies.base import ViewPolicy, nearest_reachable
from active3d_pipe.planning.policies.context import PolicyContext
from active3d_pipe.planning.rrt_star import plan_path
from active3d_pipe.structures import Decision, Reason


class Trajectory(ViewPolicy):
    """See the module."""

    def decide(self, context: PolicyContext) -> Decision:
        """The next poses of the recording, as many as one round may have."""
        if context.recorded is None or not len(context.recorded):
            raise ConfigError(
                "planning.trajectory: is not given; the policy trajectory needs a file of poses or a run folder"
            )
        recorded, limit = context.recorded, context.settings.max_steps_per_round
        index = self._next(context, recorded)
        out: list[np.ndarray] = []
        skipped = 0
        T = context.T_world_camera
        while index < len(recorded) and len(out) < limit:
            goal = recorded[index]
            if self._touches(context, goal[:3, 3]):
                index, skipped = index + 1, skipped + 1
                continue
            steps = self._steps(context, T, goal, at_start=not out)
            out += list(steps[: limit - len(out)])
            if len(steps) and out and not np.allclose(out[-1], steps[-1]):
                break  # the round is full before this pose is reached
            T = out[-1] if out else T
            index += 1
        notes: dict[str, Any] = {"next_pose": index, "recorded_poses": len(recorded), "skipped_poses": skipped}
        terms = self._terms(context) | notes | {"path_steps": len(out)}
        k = context.volume.round
        if not out:
            return Decision(k, Reason.STOP_GAIN, True, np.zeros((0, 4, 4)), terms=terms)
        return Decision(k, Reason.BEST_GAIN, False, np.array(out), terms=terms)

    def _next(self, context: PolicyContext, recorded: np.ndarray) -> int:
        """Index of the next pose: as remembered, or after those that the bootstrap turn walked already."""
        before = context.previous
        if before is not None and "next_pose" in before.terms:
            return int(before.terms["next_pose"])
        n = 0
        for T in context.walked_poses:
            n += n < len(recorded) and np.allclose(T, recorded[n], atol=1e-6)
        return n

    def _steps(self, context: PolicyContext, T: np.ndarray, goal: np.ndarray, at_start: bool) -> np.ndarray:
        step = np.linalg.norm(goal[:3, 3] - T[:3, 3])
        turn = np.degrees(se3.rotation_angle(T[:3, :3], goal[:3, :3]))
        if step < 1e-9 and turn < 1e-6:
            return np.zeros((0, 4, 4))
        points = np.stack([T[:3, 3], goal[:3, 3]])
        if step <= context.motion.max_step_m and turn <= context.motion.max_turn_deg:
            return goal[None]
        if at_start and step > 5 * context.motion.max_step_m:
            points = self._through_known_space(context, points)
        length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
        return step_path(T, points, [(length, goal[:3, :3])], context.motion)

    def _through_known_space(self, context: PolicyContext, points: np.ndarray) -> np.ndarray:
        space = context.free_space()
        voxels, found = nearest_reachable(space, points[-1:], space.grid.voxel_size)
        if not found[0] or (voxels[0] == space.start).all():
            return points
        planned = plan_path(space, points[0], voxels[0], None, context.settings, context.rng)
        return np.concatenate([planned.points, points[-1:]])

    def _touches(self, context: PolicyContext, position: np.ndarray) -> bool:
        grid = context.volume.grid
        ijk = grid.index_of(position)
        if not grid.contains_index(ijk):
            return True
        volume = context.volume
        i = tuple(ijk)
        return bool(volume["hit_evidence"][i] > 0 and volume["occupancy"][i] > 0.5)
