"""From the views on a short list to the poses of a round: the best one that can be walked to, and what follows it."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from active3d_pipe.planning.candidates import Directions
from active3d_pipe.planning.choice import Pool, glance, reward_density, utility_rate, view_cost_steps
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.looks import looks_along
from active3d_pipe.planning.path import step_path
from active3d_pipe.planning.reward import RewardField
from active3d_pipe.planning.rrt_star import PlannedPath, plan_path
from active3d_pipe.structures.camera import Camera
from active3d_pipe.structures.decision import Decision, Reason
from active3d_pipe.structures.motion import MotionSettings

# Views that are appended to a short path at most.
LONGEST_CHAIN = 4


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """What stays the same while one decision is taken."""

    round: int
    T: np.ndarray
    camera: Camera
    directions: Directions
    motion: MotionSettings
    settings: PlanningSettings
    rng: np.random.Generator

    @property
    def round_length_m(self) -> float:
        """How far one round can walk."""
        return self.settings.max_steps_per_round * self.motion.max_step_m


def go(task: Task, space: FreeSpace, pool: Pool, field: RewardField, reason: Reason) -> Decision | None:
    """Walk to the best candidate that can be walked to; None when there is none."""
    settings, T = task.settings, task.T
    density = reward_density(pool, space)
    tried: dict[int, bool] = {}
    for index in range(len(pool.terms)):
        if pool.terms[index].reward < settings.stop_reward:
            continue
        path = plan_path(space, T[:3, 3], pool.voxels[index], density, settings, task.rng)
        poses = _poses(task, path, T, pool.poses[index], field, None)
        tried[index] = len(poses) > 0
        if len(poses):
            break
        if len(tried) >= settings.num_ranked:
            return None
    else:
        return None
    goal_ahead = len(poses) > settings.max_steps_per_round
    chained = 0
    if len(poses) < settings.min_steps_per_round:
        poses, chained = _chain(task, poses, index, space, pool, field, density)
    chosen = pool.terms[index]
    ranking = pool.ranking(max(settings.num_ranked, index + 1), tried)
    terms: dict[str, Any] = {
        **space_terms(space),
        "reward": chosen.reward,
        "reward_surface": chosen.surface,
        "gain_imp": chosen.gain_imp,
        "gain_exp": chosen.gain_exp,
        "gain": chosen.gain,
        "num_visible": chosen.num_visible,
        "num_open": chosen.num_open,
        "utility": float(pool.utility[index]),
        "travel_m": float(pool.travel_m[index]),
        "best_reward": max(t.reward for t in pool.terms),
        "stop_reward": settings.stop_reward,
        "num_candidates": pool.num_candidates,
        "num_positions": len(pool.positions),
        "path_length_m": path.length_m,
        "path_cost": path.cost,
        "path_cost_grid": path.grid_cost,
        "path_steps": min(len(poses), settings.max_steps_per_round),
        "max_risk": path.max_risk,
        "min_clearance_m": path.min_clearance_m,
        "goal_ahead": goal_ahead,
        "committed": bool(pool.committed[index]),
        "chained_views": chained,
    }
    if reason is Reason.BEST_GAIN and len(tried) > 1:
        reason = Reason.FALLBACK
    return Decision(task.round, reason, False, poses[: settings.max_steps_per_round], ranking, index, terms)


def _poses(
    task: Task, path: PlannedPath, T: np.ndarray, T_goal: np.ndarray, field: RewardField, max_steps: int | None
) -> np.ndarray:
    """Step poses along a path from pose T, looking where the reward lies on the way."""
    spacing = task.settings.coarse_spacing_m
    looks = looks_along(path.points, T[:3, :3], T_goal, field, task.directions, task.motion, spacing)
    return step_path(T, path.points, looks, task.motion, max_steps)


def _chain(
    task: Task,
    poses: np.ndarray,
    index: int,
    space: FreeSpace,
    pool: Pool,
    field: RewardField,
    density: np.ndarray,
) -> tuple[np.ndarray, int]:
    """Continue a short path to the views that are best after the ones before it; (poses, number of views added).

    A round costs mapping and planning, however short its path. What the views so far will have seen counts no more.
    """
    settings = task.settings
    open_views = [i for i in range(len(pool.terms)) if i != index]
    added = 0
    while len(poses) < settings.min_steps_per_round and open_views and added < LONGEST_CHAIN:
        T = poses[-1]
        field = field.after(T, task.camera)
        here = space.moved_to(pool.voxels[index], settings, task.round_length_m)
        travel = here.cost[tuple(pool.voxels[open_views].T)]
        near = [i for i, c in zip(open_views, travel, strict=True) if c < task.round_length_m]
        if not near:
            break
        terms = glance(field, pool.poses[near], task.camera)
        rotations = pool.poses[near][:, :3, :3]
        cost = view_cost_steps(here.cost[tuple(pool.voxels[near].T)], T[:3, :3], rotations, task.motion)
        best = int(utility_rate(np.array([t.reward for t in terms]), cost, settings).argmax())
        if terms[best].reward < settings.stop_reward:
            break
        index = near[best]
        path = plan_path(here, T[:3, 3], pool.voxels[index], density, settings, task.rng)
        more = _poses(task, path, T, pool.poses[index], field, settings.max_steps_per_round)
        poses = np.concatenate([poses, more])
        open_views.remove(index)
        added += 1
    return poses, added


def space_terms(space: FreeSpace) -> dict[str, Any]:
    """What a decision reports of the free space."""
    return {
        "free_m3": float(space.free.sum() * space.grid.voxel_size**3),
        "reachable_m3": float(space.reachable.sum() * space.grid.voxel_size**3),
        "start_clearance_m": float(space.risk.clearance_m[tuple(space.start)]),
    }
